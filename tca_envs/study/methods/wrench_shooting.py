"""Single shooting on the wrench form of the rod: the moment at the base and the muscles' tensions are all that is unknown.

The force is known beforehand, so 3 + n unknowns do where the paper's shooting has 6 + n; tendons' tensions are known and do not
count. The initial value problem of `study.wrench` goes from base to tip in fixed Runge-Kutta steps of order 4. A damped Newton
on the moment at the tip and the muscles' lengths keeps its inverse Jacobian from one solve to the next, updates it by
Broyden's formula and takes a new one by differences where it no longer serves. Where that fails, drive and load go from those
of the guess to the asked ones in substeps.
"""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, Equilibrium, Module
from tca_envs.mechanics.algebra import entry, inner, rotation_matrix
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.mechanics.shooting import tension_units
from tca_envs.study.method import Answer, Method, State
from tca_envs.study.wrench import (
    RK4,
    STATE,
    Rod,
    Scratch,
    march,
    moment_unit,
    rod,
    scratch,
    tip_moment,
    tip_moment_turned,
    wrench,
)

Array = NDArray[np.float64]

SETTLED = 0.02
"""Dimensionless imbalance of a section below which its strain is accepted."""
TOLERANCE = 1e-4
"""Norm of the residual that is an answer, times steps^4: a hundredth of the error of the integration, or less."""
SERVES = 0.3
"""An old Jacobian serves as long as a step shrinks the residual to less than this."""
MAX_STEP = 1.0
"""Longest Newton step of the scaled unknowns."""
HALVINGS = 6
MAX_INTEGRATIONS = 60
"""Of one Newton."""
SMALLEST_SUBSTEP = 1.0 / 64.0
MAX_SUBSTEPS = 40
STEPS_PER_TURN = 0.4
"""Steps for each turn of a helical muscle, over those of a module without: the two kinds of module then err alike."""


class Guess(NamedTuple):
    """What a solve starts from."""

    moment: Array
    """At the base (3,) [N m]."""
    tension: Array
    """(n,) [N]."""
    strain: Array
    """At the base of each module (M, 6): where the sections' Newton starts."""
    inverse: Array
    """Inverse of the scaled Jacobian (N, N); zeros where it is not known."""
    drive: Array
    """(n,): where this is an equilibrium."""
    load: Array
    """The same."""


class Problem(NamedTuple):
    """What stays the same from solve to solve."""

    rod: Rod
    driven: NDArray[np.int64]  # (n,) the unknown that is the tension of each muscle; -1 for a tendon
    unit: Array  # (N,) units of the unknowns: moment at the base [N m], tensions [N]


class Work(NamedTuple):
    """Arrays that the kernels share."""

    state: Array  # (STATE + m,)
    tension: Array  # (n,) [N]
    tangent: Array  # (N, 6 + m)
    matrix: Array  # (N, N) Jacobian
    march: Scratch


@inner
def shoot(problem, x, drive, load, starts, differentiate, work, residual):
    """Integrate from base to tip.

    Parameters
    ----------
    problem : Problem
        The arm.
    x : (N,) array
        Moment at the base and tensions, over their units.
    drive, load : (n,), (LOAD,) arrays
        Drives and external load.
    starts : (M, 6) array
        Near the strains at the modules' bases; out: those.
    differentiate : bool
        Whether to set the Jacobian.
    work : Work
        Out: state at the tip, tensions and, where it is asked for, the Jacobian.
    residual : (N,) array
        Out: moment at the tip less that applied, over its unit; length mismatch of the muscles over their rest lengths.

    Returns
    -------
    float
        Norm of the residual; inf where there is no answer.
    """
    rod, driven, unit = problem
    state, tension, tangent, matrix = work.state, work.tension, work.tangent, work.matrix
    for i in range(tension.size):
        tension[i] = drive[i] if driven[i] < 0 else unit[driven[i]] * x[driven[i]]
    state[:] = 0.0
    state[0] = 1.0
    for i in range(3):
        state[7 + i] = unit[i] * x[i]
    columns = 0
    if differentiate:
        tangent[:] = 0.0
        for i in range(3):
            tangent[i, 3 + i] = 1.0
        columns = 3
    station = np.int64(0)  # a literal would have `march` compiled twice
    for k in range(rod.steps.size):
        i0, i1 = rod.first_muscle[k], rod.first_muscle[k + 1]
        state[STATE:] = 0.0
        if differentiate:
            tangent[:, 6:] = 0.0
            for i in range(i0, i1):
                columns = max(columns, driven[i] + 1)
        if not march(rod, k, station, rod.steps[k], tension, load, state, starts[k], columns, driven, tangent, work.march):
            return np.inf
        station += rod.steps[k] * rod.b.size
        for i in range(i0, i1):
            row = driven[i]
            if row < 0:
                continue
            rest = rod.rest_length[i]
            delta, softness, _ = elongation(rod.kind[i], rod.parameters, i, rest, tension[i], drive[i])
            residual[row] = (state[STATE + i - i0] - rest - delta) / rest
            if differentiate:
                for j in range(unit.size):
                    matrix[row, j] = tangent[j, 6 + i - i0] * unit[j] / rest
                matrix[row, row] -= softness * unit[row] / rest
    r = rotation_matrix((state[0], state[1], state[2], state[3]))
    moment = tip_moment(load, r)
    total = 0.0
    for i in range(3):
        residual[i] = (state[7 + i] - moment[i]) / unit[i]
    for i in range(residual.size):
        total += residual[i] * residual[i]
    if differentiate:
        for j in range(unit.size):
            moment = tip_moment_turned(load, r, (tangent[j, 0], tangent[j, 1], tangent[j, 2]))
            for i in range(3):
                matrix[i, j] = (tangent[j, 3 + i] - moment[i]) * unit[j] / unit[i]
    return np.sqrt(total) if total < np.inf else np.inf


@inner
def assign(target, values):
    """Copy an array into another (compiles much faster than an assignment to a slice)."""
    flat, source = target.ravel(), values.ravel()
    for i in range(flat.size):
        flat[i] = source[i]


@inner
def invert(matrix, inverse):
    """Invert a matrix by Gauss-Jordan elimination with row exchanges; False where it is singular. `matrix` is lost."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    for j in range(n):
        p = j
        for i in range(j + 1, n):
            if abs(matrix[i, j]) > abs(matrix[p, j]):
                p = i
        if not 0.0 < abs(matrix[p, j]) < np.inf:
            return False
        for l in range(n):
            matrix[j, l], matrix[p, l] = matrix[p, l], matrix[j, l]
            inverse[j, l], inverse[p, l] = inverse[p, l], inverse[j, l]
        d = 1.0 / matrix[j, j]
        for l in range(n):
            matrix[j, l] *= d
            inverse[j, l] *= d
        for i in range(n):
            d = matrix[i, j]
            if i != j and d != 0.0:
                for l in range(n):
                    matrix[i, l] -= d * matrix[j, l]
                    inverse[i, l] -= d * inverse[j, l]
    return True


@inner
def update(inverse, step, change, product):
    """Let the inverse Jacobian map `change` of the residual to `step`, by Broyden's formula."""
    n = step.size
    scale = 0.0
    for i in range(n):
        product[i] = 0.0
        for j in range(n):
            product[i] += inverse[i, j] * change[j]
        scale += step[i] * product[i]
    if abs(scale) < 1e-300:
        return
    for j in range(n):
        row = 0.0
        for i in range(n):
            row += step[i] * inverse[i, j]
        row /= scale
        # Column j of the old inverse is used above, and only there.
        for i in range(n):
            inverse[i, j] += (step[i] - product[i]) * row


@inner
def newton(problem, x, drive, load, starts, inverse, tolerance, work):
    """Solve by Newton from x, in place; whether it got there.

    There is one call of `shoot` for all this, because the compiler inlines every call.
    """
    n = x.size
    residual, moved, step, trial = np.empty(n), np.empty(n), np.empty(n), x.copy()
    known = inverse[0, 0] != 0.0 or inverse[0, 1] != 0.0 or inverse[0, 2] != 0.0
    new = False  # whether `inverse` is that of the Jacobian at x
    size, part, halvings = np.inf, 0.0, 0  # part 0: the trial is x itself
    for _ in range(MAX_INTEGRATIONS):
        trial_size = shoot(problem, trial, drive, load, starts, not known, work, moved)
        if part == 0.0:
            size = trial_size
            assign(residual, moved)
            if not size < np.inf:
                return False
        elif trial_size < (1.0 - 0.1 * part) * size:
            known = trial_size < SERVES * size
            for i in range(n):
                step[i] = trial[i] - x[i]
                moved[i] -= residual[i]
                residual[i] += moved[i]
                x[i] = trial[i]
            update(inverse, step, moved, trial)
            size = trial_size
            new = False
        elif new:
            part *= 0.5
            halvings += 1
            if halvings == HALVINGS:
                return False
            for i in range(n):
                trial[i] = x[i] + part * step[i]
            continue
        else:
            known = False
        if size < tolerance:
            return True
        if not known:
            if part != 0.0:
                assign(trial, x)
                part = 0.0
                continue
            if not invert(work.matrix, inverse):
                return False
            known = new = True
        longest = 0.0
        for i in range(n):
            step[i] = 0.0
            for j in range(n):
                step[i] -= inverse[i, j] * residual[j]
            longest = max(longest, abs(step[i]))
        if not longest < np.inf:
            return False
        part, halvings = min(1.0, MAX_STEP / max(longest, 1e-300)), 0
        for i in range(n):
            trial[i] = x[i] + part * step[i]
    return False


@entry
def solve(problem, moment, tension, starts, inverse, from_drive, from_load, drive, load, tolerance, tip):
    """Find the equilibrium that continues a known one.

    Parameters
    ----------
    problem : Problem
        The arm.
    moment, tension, starts, inverse : arrays
        In: as in `Guess`; out: those of the answer.
    from_drive, from_load : (n,), (LOAD,) arrays
        Where the guess is an equilibrium.
    drive, load : (n,), (LOAD,) arrays
        What is asked.
    tolerance : float
        Norm of the residual below which it is an answer.
    tip : (4, 4) array
        Out: the tip's pose [m], but for the last row.

    Returns
    -------
    bool
        Whether there is an answer.
    """
    rod, driven, unit = problem
    n, m = unit.size, rod.route.shape[1]
    work = Work(np.empty(STATE + m), tension.copy(), np.empty((n, 6 + m)), np.empty((n, n)), scratch(rod, n))
    x = np.empty(n)
    for i in range(3):
        x[i] = moment[i] / unit[i]
    for i in range(tension.size):
        if driven[i] >= 0:
            x[driven[i]] = tension[i] / unit[driven[i]]
    good_x, good_starts, good_inverse = x.copy(), starts.copy(), inverse.copy()
    drive_now, load_now = drive.copy(), load.copy()
    done, substep = 0.0, 1.0
    for _ in range(MAX_SUBSTEPS):
        here = min(1.0, done + substep)
        for i in range(drive.size):
            drive_now[i] = drive[i] if here == 1.0 else from_drive[i] + here * (drive[i] - from_drive[i])
        for i in range(load.size):
            load_now[i] = load[i] if here == 1.0 else from_load[i] + here * (load[i] - from_load[i])
        if newton(problem, x, drive_now, load_now, starts, inverse, tolerance, work):
            if here == 1.0:
                done = 1.0
                break
            done, substep = here, 2.0 * substep
            assign(good_x, x)
            assign(good_starts, starts)
            assign(good_inverse, inverse)
        else:
            substep *= 0.25 if substep == 1.0 else 0.5
            if substep < SMALLEST_SUBSTEP:
                break
            assign(x, good_x)
            assign(starts, good_starts)
            assign(inverse, good_inverse)
    if done < 1.0:
        return False
    for i in range(3):
        moment[i] = unit[i] * x[i]
    assign(tension, work.tension)
    state = work.state
    r = rotation_matrix((state[0], state[1], state[2], state[3]))
    for i in range(3):
        for j in range(3):
            tip[i, j] = r[3 * i + j]
        tip[i, 3] = state[4 + i]
    return True


class WrenchShooting(NamedTuple):
    """The method made ready for one arm."""

    arm: Arm
    problem: Problem
    tolerance: float

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        _, tension, drive, load = self.arm.unloaded()
        n = len(self.problem.unit)
        return Guess(np.zeros(3), tension, self.problem.rod.reference.copy(), np.zeros((n, n)), drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the moment at the base and the tensions of a known equilibrium."""
        strain = known.strain(np.concatenate([[0.0], np.cumsum(self.problem.rod.length)[:-1]]))
        first = self.arm.modules[0]
        moment = wrench(first, 0.0, strain[0], known.tensions[: len(first.muscles)])[:3]
        n = len(self.problem.unit)
        return Guess(moment, known.tensions, strain, np.zeros((n, n)), known.known[0], known.known[1])

    def solve(self, state: State, guess: Guess) -> Answer:
        """Solve for the equilibrium at `state`."""
        drive, load, tip = state.drive, state.load, np.eye(4)
        moment, tension, strain, inverse = (x.copy() for x in guess[:4])
        found = Guess(moment, tension, strain, inverse, drive, load)
        converged = solve(self.problem, *found[:4], guess.drive, guess.load, drive, load, self.tolerance, tip)
        return Answer(converged, tip, found if converged else None)


def module_steps(module: Module, steps: int) -> int:
    """Return the steps of a module: `steps`, or more where helical muscles turn its strain."""
    turns = max((abs(muscle.turns) for muscle in module.muscles), default=0.0)
    return max(steps, ceil(STEPS_PER_TURN * turns * steps))


def build(arm: Arm, steps: int, states: Sequence[State]) -> WrenchShooting:
    """Return the solver for a number of steps in each module, see `module_steps`."""
    made = rod(arm, RK4, [module_steps(module, steps) for module in arm.modules], SETTLED / steps**2)
    free = made.kind != TENDON
    driven = np.where(free, 2 + np.cumsum(free), -1)
    unit = np.concatenate([np.full(3, moment_unit(arm)), tension_units(arm)[free]])
    return WrenchShooting(arm, Problem(made, driven, unit), max(TOLERANCE / steps**4, 1e-11))


METHOD = Method("wrench shooting, RK4", "steps", (2, 4, 8, 16, 32, 64), build)
