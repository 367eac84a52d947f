"""The upper rungs of the ladder: what is tried where the compiled one, Newton and substeps, comes to no answer.

A branch that the grid cannot follow goes on on a finer grid. A branch that ends, at a fold or where it turns unstable, is left
as a real arm leaves it: it falls to the stable equilibrium down the hill of the total energy, at the drive and load where the
branch ends, and the way to those asked for goes on from there. All this is rare, so it is Python around
`collocation.linearise`.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics.collocation import GIVEN, INERTIA, STEP, Heat, Model, compile_kernels, linearise, solve_lanes
from tca_envs.mechanics.kernels import DESCENT, FAILED, FINER, NEUTRAL, REPORT, SMALLEST_SUBSTEP, SUBSTEPS

if TYPE_CHECKING:
    from tca_envs.mechanics.arm import Arm

Array = NDArray[np.float64]

TIME_LIMIT_S = 1.0
"""No solve takes longer [s], unless another limit is asked for."""
CAREFUL = 1.0 / 32.0
"""First substep on the finer grid, as a share of what is left of the way."""
PAST = 1.0 / 256.0
"""A fall happens so far beyond the end of a branch, as a share of what is left of the way; the next one twice as far."""
MAX_FALLS = 12
ALIKE = 0.1
"""Strains that differ by less, curvature times the arm's length [rad] and stretch, are taken for those of the same branch."""
DOUBT = 0.2
"""A solve by long Newton steps that do not shrink by this factor, or by substeps, is checked by going back."""
MAX_DESCENT = 300
"""Steps of one fall."""
FALL_STEP = 0.3
"""Largest rotation [rad] and change of v in a step of a fall: it stays close to the way of the real, strongly damped arm."""
FIRST_DAMPING = 0.1
EASING = 0.2
"""The damping falls by this factor after a step that went as predicted."""
MOST_DAMPING = 1e8
"""No tangent of a configuration needs more."""
COLLAPSED = 0.01
"""A muscle's path that is shorter, per length of the rod, is about to become a point; there is no tangent then."""
NUDGE = 0.02
"""An arm that stands on an unstable equilibrium is pushed off it by this rotation [rad], unless it moves as much by itself."""
MODE_ITERATIONS = 6
FLAT = 1e-5
"""Differences of energy below this, over EI/L, do not tell up from down, as the grid's error may be as large; the gradient
does."""
SAME = 0.01
"""Tips that are closer, over the arm's length, are of the same equilibrium on two grids."""


class Lane(NamedTuple):
    """A known equilibrium on the grid of a model."""

    strain: Array
    """(G, 6)."""
    tension: Array
    """(n,) [N]."""
    drive: Array
    """(n,)."""
    load: Array
    """(LOAD,)."""


class Climb(NamedTuple):
    """What the ladder says of a lane."""

    rung: int
    """SUBSTEPS, FINER, DESCENT or FAILED."""
    arm: "Arm"
    """On whose grid the answer is."""
    lane: Lane
    tip: Array
    """(4, 4) [m]."""
    lengths: Array
    """(n,) path lengths [m]."""
    residual: float
    iterations: int
    jumped: bool
    message: str


class _Followed(NamedTuple):
    reached: bool
    lane: Lane
    tip: Array
    lengths: Array
    residual: float
    iterations: int


def climb(
    arm: "Arm", start: Lane, stuck: Lane, drive: Array, load: Array, step: float, begun: float, time_limit_s: float
) -> Climb:
    """Find the equilibrium that the arm comes to beyond the end of what Newton can follow.

    Parameters
    ----------
    arm : Arm
        The arm.
    start, stuck : Lane
        Where the way began and how far it went.
    drive, load : (n,), (LOAD,) arrays
        What is asked.
    step : float
        The substep to go on with, see `collocation.solve_lanes`.
    begun : float
        When the first rung began, by `time.perf_counter` [s].
    time_limit_s : float
        How long all rungs together may take [s].

    Returns
    -------
    Climb
        FAILED if there is no equilibrium in reach.
    """
    reasons: list[str] = []
    way = np.concatenate([drive - start.drive, load - start.load])
    scale = max(float(np.abs(way).max(initial=0.0)), 1e-150)
    unit = way / scale
    unit /= max(float(unit @ unit), 1e-150)
    iterations = 0
    # What may come between two looks at the clock: a call of the compiled rung, on the finer grid.
    deadline = begun + 0.9 * time_limit_s - 2.0 * (time.perf_counter() - begun)

    def gone(lane: Lane) -> str:
        share = unit @ (np.concatenate([lane.drive - start.drive, lane.load - start.load]) / scale)
        return f"{100.0 * share:.3g} % of the way"

    def late() -> bool:
        return time.perf_counter() > deadline

    def end(rung: int, on: "Arm", found: _Followed, jumped: bool) -> Climb:
        return Climb(rung, on, found.lane, found.tip, found.lengths, found.residual, iterations, jumped, "; ".join(reasons))

    # A long way may only have run out of its budget.
    here = _follow(arm.model, stuck, drive, load, deadline, step)
    iterations += here.iterations
    if here.reached:
        return end(SUBSTEPS, arm, here, not returns(arm.model, here.lane, start, deadline))
    reasons.append(f"substeps end at {gone(here.lane)}")
    # Where a branch ends, a grid's error decides on much: from here on with less of it.
    finer, rung, jumped = arm.finer, FINER, False
    if finer is not arm:
        edge = arm.on(finer, here.lane)
        here = _follow(finer.model, edge, drive, load, deadline, CAREFUL)
        iterations += here.iterations
        if here.reached:
            jumped = not returns(finer.model, here.lane, edge, deadline)
        else:
            reasons.append(f"those on a finer grid at {gone(here.lane)}")
    if not here.reached:
        rung = DESCENT
    for fall in range(MAX_FALLS):
        if here.reached or late():
            break
        edge, share = here.lane, min(1.0, PAST * 2.0**fall)
        if _shortest(finer.model, edge) < COLLAPSED:
            reasons.append("there a muscle's path shrinks to a point: it collapses the rod")
            break
        past = (edge.drive + share * (drive - edge.drive), edge.load + share * (load - edge.load))
        fallen, steps = descend(finer.model, edge, *past, late)
        iterations += steps
        if fallen is None:
            reasons.append(f"the fall from {gone(edge)} finds no equilibrium")
            break
        jump = not returns(finer.model, fallen, edge, deadline)
        jumped |= jump
        reasons.append(f"{'fell' if jump else 'went down'} at {gone(edge)}")
        here = _follow(finer.model, fallen, drive, load, deadline)
        iterations += here.iterations
    if not here.reached:
        if late():
            reasons.append("the time limit is reached")
        return end(FAILED, finer, here, False)
    own = _follow(arm.model._replace(ladder=False), finer.on(arm, here.lane), drive, load, deadline)
    iterations += own.iterations
    if own.reached and np.linalg.norm(own.tip[:3, 3] - here.tip[:3, 3]) < SAME * arm.length:
        return end(rung, arm, own, jumped)
    return end(rung, finer, here, jumped)


def solve(
    arm: "Arm", strain: Array, tension: Array, from_drive: Array, from_load: Array, drive: Array, load: Array, tip: Array,
    lengths: Array, report: Array, threads: int = 1, heat: Heat | None = None,
) -> None:  # fmt: skip
    """Solve N lanes of an arm, each by the whole ladder, within `TIME_LIMIT_S` each.

    Arguments as of `collocation.solve_lanes`; lanes without an answer are left as they were. An answer on a finer grid is
    carried to the arm's own.
    """
    compile_kernels()
    start = (strain.copy(), tension.copy(), from_drive.copy(), from_load.copy())
    lanes = (strain, tension, from_drive, from_load)
    solve_lanes(arm.model, *lanes, drive, load, tip, lengths, report, 1.0, threads, heat)
    if not (report[:, 0].any() or (report[:, 4] > DOUBT).any()):  # all are WARM, which is 0
        return
    long = (report[:, 0] == SUBSTEPS) | (report[:, 4] > DOUBT)
    for i in np.flatnonzero(long & (report[:, 0] != FAILED)):
        known, there = (Lane(*(values[i] for values in kind)) for kind in (start, lanes))
        report[i, 3] = not returns(arm.model, there, known, time.perf_counter() + TIME_LIMIT_S)
    n = tension.shape[1]
    for i in np.flatnonzero(report[:, 0] == FAILED):
        known, stuck = (Lane(*(values[i].copy() for values in kind)) for kind in (start, lanes))
        found = climb(arm, known, stuck, drive[i, :n], load[i], report[i, 3], time.perf_counter(), TIME_LIMIT_S)
        report[i, :4] = found.rung, found.residual, report[i, 2] + found.iterations, found.jumped
        answer = known
        if found.rung != FAILED:
            answer, tip[i], lengths[i] = found.arm.on(arm, found.lane), found.tip, found.lengths
        for values, new in zip(lanes, answer, strict=True):
            values[i] = new


def _shortest(model: Model, lane: Lane) -> float:
    """Return the smallest |p_a'| of the muscles at the nodes, eq. (13)."""
    (u_x, u_y, u_z, v_x, v_y, v_z), (x, y, dx, dy) = lane.strain.T[..., np.newaxis], np.moveaxis(model.route, 2, 0)
    squares = (v_x - u_z * y + dx) ** 2 + (v_y + u_z * x + dy) ** 2 + (v_z + u_x * y - u_y * x) ** 2
    return float(np.sqrt(squares.min(initial=np.inf)))


def returns(model: Model, lane: Lane, start: Lane, deadline: float) -> bool:
    """Return whether an arm that goes back to the drive and load of where it came from comes back to that state.

    If it does, it has not left its branch of equilibria.
    """
    back = _follow(model, lane, start.drive, start.load, deadline)
    apart = np.abs(back.lane.strain - start.strain)
    return bool((apart[:, :3] * model.length.sum()).max() < ALIKE and apart[:, 3:].max() < ALIKE)


def _follow(model: Model, lane: Lane, drive: Array, load: Array, deadline: float, step: float = 1.0) -> _Followed:
    """Follow a branch by the compiled ladder, as far as it goes before the deadline."""
    strain, tension, from_drive, from_load = (values[np.newaxis].copy() for values in lane)
    tip, lengths, report = np.eye(4)[np.newaxis], np.empty((1, drive.size)), np.full((1, REPORT), np.inf)
    report[0, 0] = FAILED
    iterations = 0
    while step >= SMALLEST_SUBSTEP and time.perf_counter() < deadline:
        solve_lanes(
            model, strain, tension, from_drive, from_load, drive[np.newaxis], load[np.newaxis], tip, lengths, report, step
        )
        iterations += int(report[0, 2])
        step = float(report[0, 3])
        if report[0, 0] != FAILED or not model.ladder:
            break
    here = Lane(strain[0], tension[0], from_drive[0], from_load[0])
    return _Followed(bool(report[0, 0] != FAILED), here, tip[0], lengths[0], float(report[0, 1]), iterations)


def descend(model: Model, lane: Lane, drive: Array, load: Array, late: Callable[[], bool]) -> tuple[Lane | None, int]:
    """Go down the hill of the total energy to a stable equilibrium.

    The tensions follow from the path lengths, so the energy is a function of the strain alone. A step solves
    (T + damping K) dx = -g with T the tangent and g the imbalance, the damping large enough for a positive definite matrix:
    the minimiser of the energy's model in a trust region |dx|_K < r, r smaller the larger the damping. It is also a step of
    linearly implicit Euler, of length 1/damping, for a rod whose viscosity is proportional to K: the fall of a strongly damped
    arm.

    Parameters
    ----------
    model : Model
        The arm.
    lane : Lane
        Where the fall begins.
    drive, load : (n,), (LOAD,) arrays
        At which it happens.
    late : callable
        Whether to give up.

    Returns
    -------
    tuple
        The equilibrium, None where none was found; steps.
    """
    # Just beyond a fold the imbalance is small, too, where the equilibrium has been.
    end = min(model.tolerance, max(1e-3 * model.tolerance, 1e-10))
    flat = FLAT * float((model.stiffness[:, :3].min(axis=1) / model.length).min())

    def look(strain: Array, tension: Array, damping: float) -> tuple[Array, Array, Array]:
        """Return the numbers of `linearise`, the step and the tip's turn; `tension` is overwritten with what follows."""
        numbers, *_, bend, shear, tips = linearise(model, strain, tension, drive, load, damping, True, STEP, strain)
        return numbers, np.hstack([bend, shear]), tips[3:, 0]

    strain, tension, damping = lane.strain.copy(), lane.tension.copy(), FIRST_DAMPING
    numbers, way, turn = look(strain, tension, damping)
    for step in range(MAX_DESCENT):
        residual, _, energy, index, rotation, slide, slope, size = numbers.tolist()
        if not residual < np.inf or damping > MOST_DAMPING or late():
            return None, step
        if residual < end:
            if negative_eigenvalues(model, strain, tension, drive, load, NEUTRAL) == 0:
                return Lane(strain, tension, drive, load), step
            if not index and rotation < NUDGE:
                strain = _pushed_off(model, strain, tension, drive, load)
                numbers, way, turn = look(strain, tension, damping)
                continue
        if not index and np.isfinite(rotation):
            share = min(1.0, FALL_STEP / max(rotation, 1e-300), FALL_STEP / max(slide, 1e-300))
            trial, pull = strain + share * way, tension.copy()
            there = look(trial, pull, EASING * damping)
            predicted = -share * slope + 0.5 * share**2 * (slope + damping * size)
            gained = energy - there[0][2] + share * float(load[3:6] @ turn) if there[0][0] < np.inf else -np.inf
            level = abs(gained) < flat and predicted < flat
            if gained > 0.5 * predicted or level:
                strain, tension, damping = trial, pull, EASING * damping
                numbers, way, turn = there
                continue
            if gained > 0.1 * predicted:
                strain, tension = trial, pull
        damping = max(4.0 * damping, 1e-3)
        numbers, way, turn = look(strain, tension, damping)
    return None, MAX_DESCENT


def _pushed_off(model: Model, strain: Array, tension: Array, drive: Array, load: Array) -> Array:
    """Return strains (G, 6) a little off an unstable equilibrium, along its softest mode, which inverse iteration finds."""
    damping = 0.01
    while damping < MOST_DAMPING and negative_eigenvalues(model, strain, tension, drive, load, damping):
        damping *= 2.0
    stiffness = np.repeat(model.stiffness, model.elements * model.nodes, axis=0)
    # A direction that no symmetric arm's softest mode is orthogonal to; so the side to which such an arm falls is settled.
    mode = np.tile([1.0, 0.27, 0.4, 0.0, 0.0, 0.0], (len(strain), 1)) * np.linspace(1.0, 0.5, len(strain))[:, np.newaxis]
    for _ in range(MODE_ITERATIONS):
        numbers, *_, bend, shear, _ = linearise(
            model, strain, tension.copy(), drive, load, damping, False, GIVEN, -stiffness * mode
        )
        if not 0.0 < numbers[4] < np.inf:  # no tangent to speak of: off along what there is
            break
        mode = np.hstack([bend, shear])
        mode *= NUDGE / numbers[4]
    return strain + mode


def negative_eigenvalues(model: Model, strain: Array, tension: Array, drive: Array, load: Array, damping: float = 0.0) -> int:
    """Return how many eigenvalues of T + damping K are negative, T being the tangent at a state, as a form in the strain."""
    return int(linearise(model, strain, tension.copy(), drive, load, damping, False, INERTIA, strain)[0][3])


def smallest_eigenvalue(model: Model, strain: Array, tension: Array, drive: Array, load: Array) -> float:
    """Return the smallest lambda of T x = lambda K x, x the strain, by counting the negative eigenvalues of T - lambda K.

    T is the second variation of the total energy, tensions following from the path lengths, and K the rod's stiffness: 1 for an
    unloaded rod, 0 at a fold or a bifurcation. To one part in ten million.
    """

    def below(value: float) -> bool:
        return negative_eigenvalues(model, strain, tension, drive, load, -value) > 0

    low, high = 0.0, 1.0
    while below(low):
        low, high = 2.0 * low - 1.0, low
        if low < -1e9:
            return -np.inf
    while not below(high):
        low, high = high, 2.0 * high
        if high > 1e9:
            return np.inf
    while high - low > 1e-7 * max(1.0, abs(low)):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if below(middle) else (middle, high)
    return low
