"""Newton's method for one pack of arms."""

import math

from tca_envs.mechanics.rungs import NEUTRAL
from tca_envs.mechanics.solver.cache import part
from tca_envs.mechanics.solver.fields import call
from tca_envs.mechanics.solver.simd import any_lane, turned, where

EVALUATE, ELIMINATE, SUBSTITUTE, NEWTON = range(4)
"""Places of the kernels' addresses in `arm.call`."""
MAX_ITERATIONS = 12
MAX_ROTATION_STEP = 1.0
"""[rad]"""
MAX_SHEAR_STEP = 0.5
CONTRACTION = 0.5
LONG = 0.1
"""Newton's first step, rotation [rad] and stretch, is long enough for another branch to be in reach."""
ROUND_OFF = 1e-8
"""A step that is shorter need not contract."""
REUSE = 0.3
"""Newton steps with old factors where the last step shrank the residual to less than this."""
KEPT = 3
"""Newton's factors serve for so many steps."""


def newton(arm, rod, certified):
    """Solve by Newton, in place, each arm on the branch of equilibria that it is near.

    Newton must go straight to the answer. It gives up where a step turns a section by more than MAX_ROTATION_STEP; where a step
    is not CONTRACTION times shorter than the one before; or if it takes long. For a solve that has to be steered may end on
    another branch. One that contracts finds the only equilibrium nearby (the theorem of Newton and Kantorovich in affine
    covariant form; Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 5.1). Where steps shrink to less than a
    quarter that holds for all the way from the start, so the answer is on the start's branch; where they do not, going back
    tells, `continuation.returns`. Where drive or load have `moved` a step is taken even if the start would do: a small change
    moves the arm a little, not in jerks.

    The answer must be stable by the count of `eliminate` there; not so a start that is the answer and `certified` already.
    Factors of an earlier step would not do, however well they serve for steps: the smallest eigenvalue changes by as much as
    the arm turns.

    The tangent is factorised for every KEPT-th step of all arms. In between a step with old factors gains almost as much as
    one with new ones, at a third of the cost; an arm for which it would not waits. An arm that is done, or lost, keeps its
    state. So what an arm does depends on itself alone. `converged`, `worst` and `iterations` tell the end, and `slowness` the
    largest ratio of a step to the one before, 0 where the first was not LONG.
    """
    worst, extent, slowness = math.inf, math.inf, 0.0
    iterations, first, converged, active = 0.0, 0.0, 0.0, 1.0
    for turn in range(KEPT * MAX_ITERATIONS):
        rod.active = active
        call(arm.call[EVALUATE], arm, rod, 1.0 * turn)
        before, worst = worst, rod.worst
        begun = where(iterations > 0.5, 1.0, 1.0 - rod.moved)
        there = where(worst < arm.tolerance, active * begun, 0.0)
        converged += there
        active = where((worst < math.inf) & (iterations < MAX_ITERATIONS - 0.5), active - there, 0.0)
        if not any_lane(active > 0.5):
            break
        going = active
        if turn % KEPT == 0:
            call(arm.call[ELIMINATE], arm, rod, NEUTRAL)
        else:
            going = where(worst < REUSE * before, active, 0.0)
            if not any_lane(going > 0.5):
                continue
        call(arm.call[SUBSTITUTE], arm, rod, 0.0)
        step = rod.rotated + rod.sheared
        good = (step < CONTRACTION * extent) | (step < ROUND_OFF)
        good = good & (rod.rotated < MAX_ROTATION_STEP) & (rod.sheared < MAX_SHEAR_STEP)
        active -= where(good, 0.0, going)
        going = where(good, going, 0.0)
        takes = going > 0.5
        first = where(takes & (iterations < 0.5), step, first)
        slowness = max(slowness, where(takes & (extent < math.inf), step / extent, 0.0))
        extent = where(takes, step, extent)
        iterations += going
        take_step(arm, rod, takes)
    counted = where(iterations > 0.5, 1.0, 1.0 - certified)
    if any_lane(converged * counted > 0.5):
        call(arm.call[ELIMINATE], arm, rod, NEUTRAL)
        converged = where(counted * rod.negative < 0.5, converged, 0.0)
    rod.converged = converged
    rod.iterations = iterations
    rod.slowness = where(first > LONG, slowness, 0.0)


@part
def take_step(arm, rod, takes):
    """Take a step in the lanes of a mask."""
    for g in range(arm.nodes):
        rod.h[g] = where(takes, turned(0.5 * rod.phi[g], rod.h[g]), rod.h[g])
        rod.u[g] = where(takes, rod.u[g] + rod.bend[g], rod.u[g])
        rod.v[g] = where(takes, rod.v[g] + rod.shear[g], rod.v[g])
    for i in range(arm.muscles):
        rod.tension[i] = where(takes, rod.tension[i] + rod.pull[i], rod.tension[i])
