"""Single shooting on the wrench form of the rod: the moment at the base and the muscles' tensions are all that is unknown.

The force is known beforehand, so 3 + n unknowns do where the paper's shooting has 6 + n; tendons' tensions are known and do not
count. The initial value problem of `study.wrench` goes from base to tip in fixed Runge-Kutta steps of order 4. A damped Newton
on the moment at the tip and the muscles' lengths keeps its inverse Jacobian from one solve to the next, updates it by
Broyden's formula and takes a new one by the tangent where it no longer serves. Where that fails, drive and load go from those
of the guess to the asked ones in substeps.
"""

from collections.abc import Sequence
from math import ceil, inf
from typing import NamedTuple

import numpy as np

from study.method import Answer, Array, Method, State

from study.notation import (  # isort: skip
    TENDON, Integers, between, inner, kernel, mismatch, moment_unit, most_turns, put, put1, put_pose, quat1,
    tip_moment, tip_moment_turned, vec, vec1,
)  # fmt: skip
from study.shooting import tension_units, wrench
from study.wrench import RK4, STATE, Rod, Scratch, march, rod, scratch
from tca_envs.mechanics import Arm, Equilibrium, Module, compiled
from tca_envs.mechanics.solver import Model
from tca_envs.mechanics.solver.simd import rotation, times

SETTLED = 0.02  # dimensionless imbalance of a section below which its strain is accepted
TOLERANCE = 1e-4  # norm of the residual that is an answer, times steps^4: a hundredth of the error of the integration, or less
SERVES = 0.3  # an old Jacobian serves as long as a step shrinks the residual to less than this
MAX_STEP = 1.0  # longest Newton step of the scaled unknowns
HALVINGS = 6
MAX_INTEGRATIONS = 60  # of one Newton
SMALLEST_SUBSTEP = 1.0 / 64.0
MAX_SUBSTEPS = 40
STEPS_PER_TURN = 0.4
"""Steps for each turn of a helical muscle, over those of a module without: the two kinds of module then err alike."""


class Guess(NamedTuple):
    """What a solve starts from."""

    moment: Array  # (3,) at the base [N m]
    tension: Array  # (n,) [N]
    strain: Array  # (M, 6) at the base of each module: where the sections' Newton starts
    inverse: Array  # (N, N) inverse of the scaled Jacobian; zeros where it is not known
    drive: Array  # (n,) where this is an equilibrium
    load: Array  # the same


class Problem(NamedTuple):
    """What stays the same from solve to solve."""

    arm: Model
    rod: Rod
    driven: Integers  # (n,) the unknown that is the tension of each muscle; -1 for a tendon
    unit: Array  # (N,) units of the unknowns: moment at the base [N m], tensions [N]


class Work(NamedTuple):
    """Arrays that the kernels share."""

    state: Array  # (STATE + m,)
    tension: Array  # (n,) [N]
    tangent: Array  # (N, 6 + m)
    matrix: Array  # (N, N) Jacobian
    march: Scratch


@kernel
def shoot(problem, x, drive, load, starts, differentiate, work, residual):
    """Integrate from base to tip; returns the norm of the residual, inf where there is no answer.

    `x` (N,) are moment at the base and tensions, over their units; `starts` (M, 6) are near the strains at the modules' bases
    and become those. `work` receives state at the tip, tensions and, if `differentiate`, the Jacobian. `residual` (N,) receives
    the moment at the tip less that applied, over its unit, and the muscles' length mismatch over their rest lengths.
    """
    arm, rod, driven, unit = problem
    state, tension, tangent, matrix = work.state, work.tension, work.tangent, work.matrix
    for i in range(tension.size):
        tension[i] = drive[i] if driven[i] < 0 else unit[driven[i]] * x[driven[i]]
    state[:] = 0.0
    state[0] = 1.0
    put1(state, 7, times(vec1(unit, 0), vec1(x, 0)))
    columns = 3 if differentiate else 0
    if differentiate:
        tangent[:] = 0.0
        for i in range(3):
            tangent[i, 3 + i] = 1.0
    station = np.int64(0)  # a literal would have `march` compiled twice
    for k in range(rod.steps.size):
        first, last = arm.first_muscle[k], arm.first_muscle[k + 1]
        state[STATE:] = 0.0
        if differentiate:
            tangent[:, 6:] = 0.0
            for i in range(first, last):
                columns = max(columns, driven[i] + 1)
        if not march(arm, rod, k, station, rod.steps[k], tension, load, state, starts[k], columns, driven, tangent, work.march):
            return inf
        station += rod.steps[k] * rod.b.size
        for i in range(first, last):
            row = driven[i]
            if row >= 0:
                residual[row], slope = mismatch(arm, i, state[STATE + i - first], tension[i], drive[i])
                if differentiate:
                    for j in range(unit.size):
                        matrix[row, j] = tangent[j, 6 + i - first] * unit[j] / arm.rest_length[i]
                    matrix[row, row] += slope * unit[row]
    turn = rotation(quat1(state, 0))
    # The three units of moments are equal.
    put1(residual, 0, 1.0 / unit[0] * (vec1(state, 7) - tip_moment(load, turn)))
    if differentiate:
        for j in range(unit.size):
            put(tangent, j, 3, vec(tangent, j, 3) - tip_moment_turned(load, turn, vec(tangent, j, 0)))
            for i in range(3):
                matrix[i, j] = tangent[j, 3 + i] * unit[j] / unit[i]
    total = 0.0
    for i in range(residual.size):
        total += residual[i] * residual[i]
    return np.sqrt(total) if total < inf else inf


@compiled
def newton(problem, x, drive, load, starts, inverse, tolerance, work):
    """Solve by Newton from x, in place; whether it got there.

    There is one call of `shoot` for all this, because the compiler inlines every call.
    """
    residual, moved, step, trial = np.empty(x.size), np.empty(x.size), np.empty(x.size), x.copy()
    known = inverse[0, :3].any()
    new = False  # whether `inverse` is that of the Jacobian at x
    size, part, halvings = inf, 0.0, 0  # part 0: the trial is x itself
    for _ in range(MAX_INTEGRATIONS):
        trial_size = shoot(problem, trial, drive, load, starts, not known, work, moved)
        if part == 0.0:
            size = trial_size
            residual[:] = moved
            if not size < inf:
                return False
        elif trial_size < (1.0 - 0.1 * part) * size:
            known = trial_size < SERVES * size
            step[:], moved[:] = trial - x, moved - residual
            residual += moved
            x[:] = trial
            # Broyden: the inverse now maps the change of the residual to the step.
            scale = 0.0
            for i in range(x.size):
                trial[i] = inner(inverse[i], moved)
                scale += step[i] * trial[i]
            if abs(scale) > 1e-300:
                for j in range(x.size):
                    row = inner(step, inverse[:, j]) / scale
                    for i in range(x.size):
                        inverse[i, j] += (step[i] - trial[i]) * row
            size, new = trial_size, False
        elif new:
            part *= 0.5
            halvings += 1
            if halvings == HALVINGS:
                return False
            trial[:] = x + part * step
            continue
        else:
            known = False
        if size < tolerance:
            return True
        if not known:
            if part != 0.0:
                trial[:], part = x, 0.0
                continue
            if not np.isfinite(work.matrix).all():
                return False
            inverse[:] = np.linalg.inv(work.matrix)
            known = new = True
        longest = 0.0
        for i in range(x.size):
            step[i] = -inner(inverse[i], residual)
            longest = max(longest, abs(step[i]))
        if not longest < inf:
            return False
        part, halvings = min(1.0, MAX_STEP / max(longest, 1e-300)), 0
        trial[:] = x + part * step
    return False


@compiled
def solve(problem, found, from_drive, from_load, tolerance, tip):
    """Find the equilibrium that continues a known one; returns whether there is one.

    `found` holds what to start from, an equilibrium at `from_drive` and `from_load`, and the drive and load that are asked for;
    it becomes the answer, with a residual below `tolerance`. `tip` (4, 4) becomes the tip's pose [m], but for the last row.
    """
    _, rod, driven, unit = problem
    moment, tension, starts, inverse, drive, load = found
    n, m = unit.size, rod.route.shape[1]
    work = Work(np.empty(STATE + m), tension, np.empty((n, 6 + m)), np.empty((n, n)), scratch(rod, n))
    x = np.empty(n)
    x[:3] = moment / unit[:3]
    for i in range(drive.size):
        if driven[i] >= 0:
            x[driven[i]] = tension[i] / unit[driven[i]]
    good_x, good_starts, good_inverse = x.copy(), starts.copy(), inverse.copy()
    done, substep = 0.0, 1.0
    for _ in range(MAX_SUBSTEPS):
        here = min(1.0, done + substep)
        drive_now, load_now = between(from_drive, drive, here), between(from_load, load, here)
        if newton(problem, x, drive_now, load_now, starts, inverse, tolerance, work):
            done, substep = here, 2.0 * substep
            if done == 1.0:
                break
            good_x[:], good_starts[:], good_inverse[:] = x, starts, inverse
        else:
            substep *= 0.25 if substep == 1.0 else 0.5
            if substep < SMALLEST_SUBSTEP:
                break
            x[:], starts[:], inverse[:] = good_x, good_starts, good_inverse
    moment[:] = unit[:3] * x[:3]
    put_pose(tip, rotation(quat1(work.state, 0)), vec1(work.state, 4))
    return done == 1.0


class WrenchShooting(NamedTuple):
    """The method made ready for one arm."""

    arm: Arm
    problem: Problem
    tolerance: float

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        _, tension, drive, load = self.arm.unloaded()
        n = len(self.problem.unit)
        return Guess(np.zeros(3), tension, self.problem.arm.reference.copy(), np.zeros((n, n)), drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the moment at the base and the tensions of a known equilibrium."""
        strain = known.strain(np.concatenate([[0.0], np.cumsum(self.problem.arm.length)[:-1]]))
        first, n = self.arm.modules[0], len(self.problem.unit)
        moment = wrench(first, 0.0, strain[0], known.tensions[: len(first.muscles)])[:3]
        return Guess(moment, known.tensions, strain, np.zeros((n, n)), *known.known)

    def solve(self, state: State, guess: Guess) -> Answer:
        """Solve for the equilibrium at `state`."""
        moment, tension, strain, inverse = (x.copy() for x in guess[:4])
        tip, found = np.eye(4), Guess(moment, tension, strain, inverse, state.drive, state.load)
        try:
            converged = solve(self.problem, found, guess.drive, guess.load, self.tolerance, tip)
        except np.linalg.LinAlgError:  # of an exactly singular Jacobian
            converged = False
        return Answer(converged, tip, found if converged else None)


def module_steps(module: Module, steps: int) -> int:
    """Return the steps of a module: `steps`, or more where helical muscles turn its strain."""
    return max(steps, ceil(STEPS_PER_TURN * most_turns(module.muscles) * steps))


def build(arm: Arm, steps: int, states: Sequence[State]) -> WrenchShooting:
    """Return the solver for a number of steps in each module, see `module_steps`."""
    made = rod(arm, RK4, [module_steps(module, steps) for module in arm.modules], SETTLED / steps**2)
    numbers = arm.model
    free = numbers.kind != TENDON
    driven = np.where(free, 2 + np.cumsum(free), -1)
    unit = np.concatenate([np.full(3, moment_unit(arm)), tension_units(arm)[free]])
    return WrenchShooting(arm, Problem(numbers, made, driven, unit), max(TOLERANCE / steps**4, 1e-11))


METHOD = Method("wrench shooting, RK4", "steps", (2, 4, 8, 16, 32, 64), build)
