"""Following branches of equilibria: the ladder of methods, from Newton to a fall off the end of a branch.

Newton and substeps are compiled. A branch that the grid cannot follow is tried on a finer grid. A branch that ends, at a fold
or where it turns unstable, is left as a real arm leaves it: it falls to the stable equilibrium down the hill of the total
energy, at the drive and load where the branch ends, and the way to those asked for goes on from there. All this is rare, so it
is Python around `solver.linearise`. Counted work bounds it, so that the same bits come out however busy the machine is.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import loads
from tca_envs.mechanics.rungs import NEUTRAL, SMALLEST_SUBSTEP, Rung
from tca_envs.mechanics.solver import REPORT as REPORT
from tca_envs.mechanics.solver import Lanes, Linearisation, Problem, linearise
from tca_envs.mechanics.solver import solve as solve_lanes
from tca_envs.mechanics.thermal import Heat

if TYPE_CHECKING:
    from tca_envs.mechanics.arm import Arm

Array = NDArray[np.float64]

MOST_WORK = 600_000
"""No solve does more: Newton iterations times nodes, more where a module has many muscles. About a second."""
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

    strain: Array  # (G, 6)
    tension: Array  # (n,) [N]
    drive: Array  # (n,)
    load: Array  # (loads.SIZE,)


class Climb(NamedTuple):
    """What the ladder says of a lane."""

    rung: Rung
    arm: "Arm"  # on whose grid the answer is
    lane: Lane
    tip: Array  # (4, 4) [m]
    lengths: Array  # (n,) path lengths [m]
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


@dataclass
class Effort:
    """What a solve may still do."""

    left: float = MOST_WORK
    """Newton iterations times nodes."""
    deadline: float = np.inf
    """By `time.perf_counter` [s], where a user limits the time."""

    def spend(self, iterations: int, problem: Problem) -> None:
        """Count iterations."""
        nodes, muscles = problem.model.route.shape[:2]
        self.left -= iterations * nodes * max(1, muscles // 4)

    @property
    def over(self) -> bool:
        """Whether nothing is left."""
        return self.left <= 0.0 or time.perf_counter() > self.deadline


def solve_one(arm: "Arm", start: Lane, drive: Array, load: Array, time_limit_s: float | None = None) -> Climb:
    """Find the equilibrium of one arm at a drive (n,) and a load by the whole ladder; the start's shape where there is none."""
    _compile(arm, start)
    begun = time.perf_counter()
    effort = Effort() if time_limit_s is None else Effort(deadline=begun + time_limit_s)
    lanes = _alone(start)
    report = solve_lanes(arm.problem, lanes, drive[np.newaxis], load[np.newaxis])[0]
    rung, residual, iterations, substep, slowness, _ = report.tolist()
    lane = Lane(*(values[0] for values in lanes[:4]))
    if rung == Rung.FAILED:
        if time_limit_s is not None:  # a call of the compiled rung, on the finer grid, may come between two looks at the clock
            effort.deadline = begun + 0.9 * time_limit_s - 2.0 * (time.perf_counter() - begun)
        found = climb(arm, start, lane, drive, load, substep, effort)
        found = found._replace(iterations=found.iterations + iterations)
        if found.rung == Rung.FAILED:
            tip, lengths = arm.tip_of(start)
            found = found._replace(arm=arm, lane=start, tip=tip, lengths=lengths)
        return found
    doubtful = rung == Rung.SUBSTEPS or slowness > DOUBT
    jumped = doubtful and not returns(arm.problem, lane, start, effort)
    return Climb(Rung(rung), arm, lane, lanes.tip[0], lanes.length[0], residual, iterations, jumped, "")


_compiled: list[bool] = []


def _compile(arm: "Arm", lane: Lane) -> None:
    """Compile everything or read it from the cache, so that this is no part of the time of a solve."""
    if not _compiled:
        linearise(arm.problem, *lane, "shape")
        _follow(arm.problem, lane, lane.drive, lane.load, Effort())
        _compiled.append(True)


def climb(arm: "Arm", start: Lane, stuck: Lane, drive: Array, load: Array, step: float, effort: Effort) -> Climb:
    """Find the equilibrium that the arm comes to beyond the end of what Newton can follow; FAILED if there is none in reach.

    `start` is where the way began, `stuck` how far it went; `step` is the substep to go on with, see `solver.solve`.
    """
    reasons: list[str] = []
    iterations = 0
    way = np.concatenate([drive - start.drive, load - start.load])
    unit = way / max(float(np.abs(way).max(initial=0.0)), 1e-150)

    def gone(lane: Lane) -> str:
        here = np.concatenate([lane.drive - start.drive, lane.load - start.load])
        return f"{100.0 * float(unit @ here) / max(float(unit @ way), 1e-300):.3g} % of the way"

    def end(rung: Rung, on: "Arm", found: _Followed, jumped: bool) -> Climb:
        return Climb(rung, on, found.lane, found.tip, found.lengths, found.residual, iterations, jumped, "; ".join(reasons))

    # A long way may only have run out of its budget.
    here = _follow(arm.problem, stuck, drive, load, effort, step)
    iterations += here.iterations
    if here.reached:
        return end(Rung.SUBSTEPS, arm, here, not returns(arm.problem, here.lane, start, effort))
    reasons.append(f"substeps end at {gone(here.lane)}")
    # Where a branch ends, a grid's error decides on much: from here on with less of it.
    finer, rung, jumped = arm.finer, Rung.FINER, False
    if finer is not arm:
        edge = arm.on(finer, here.lane)
        here = _follow(finer.problem, edge, drive, load, effort, CAREFUL)
        iterations += here.iterations
        if here.reached:
            jumped = not returns(finer.problem, here.lane, edge, effort)
        else:
            reasons.append(f"those on a finer grid at {gone(here.lane)}")
    if not here.reached:
        rung = Rung.DESCENT
        here, steps, jumped = _fall(finer.problem, here, drive, load, effort, gone, reasons)
        iterations += steps
    if not here.reached:
        if effort.over:
            reasons.append(f"the {'limit of work' if effort.left <= 0.0 else 'time limit'} is reached")
        return end(Rung.FAILED, finer, here, False)
    own = _follow(arm.problem, finer.on(arm, here.lane), drive, load, effort, substeps=False)
    iterations += own.iterations
    if own.reached and np.linalg.norm(own.tip[:3, 3] - here.tip[:3, 3]) < SAME * arm.length:
        return end(rung, arm, own, jumped)
    return end(rung, finer, here, jumped)


def _fall(
    problem: Problem,
    here: _Followed,
    drive: Array,
    load: Array,
    effort: Effort,
    gone: Callable[[Lane], str],
    reasons: list[str],
) -> tuple[_Followed, int, bool]:
    """Fall off the end of a branch and follow the next one, again and again; return where to, iterations and if it jumped."""
    iterations, jumped = 0, False
    for fall in range(MAX_FALLS):
        if here.reached or effort.over:
            break
        edge, share = here.lane, min(1.0, PAST * 2.0**fall)
        if _shortest(problem, edge) < COLLAPSED:
            reasons.append("there a muscle's path shrinks to a point: it collapses the rod")
            break
        past = (edge.drive + share * (drive - edge.drive), edge.load + share * (load - edge.load))
        fallen, steps = descend(problem, edge, *past, effort)
        iterations += steps
        if fallen is None:
            reasons.append(f"the fall from {gone(edge)} finds no equilibrium")
            break
        jump = not returns(problem, fallen, edge, effort)
        jumped |= jump
        reasons.append(f"{'fell' if jump else 'went down'} at {gone(edge)}")
        here = _follow(problem, fallen, drive, load, effort)
        iterations += here.iterations
    return here, iterations, jumped


def solve(arm: "Arm", lanes: Lanes, drive: Array, load: Array, threads: int = 1, heat: Heat | None = None) -> Any:
    """Bring N lanes of an arm to equilibrium, each by the whole ladder.

    Parameters
    ----------
    arm : Arm
        The arm.
    lanes : Lanes
        In: known equilibria. Out: the asked ones; lanes without an answer are left as they were. An answer on a finer grid is
        carried to the arm's own.
    drive, load : (N, n or more), (N, loads.SIZE) arrays
        What is asked; a lane's first n drives are the arm's.
    threads : int
        How many share the work; no number depends on it.
    heat : Heat, optional
        How `drive` comes about; it is overwritten then.

    Returns
    -------
    (N,) array of REPORT
        "rung" (see `Rung`), "residual" (dimensionless), "iterations" and "jumped" (see `Equilibrium`) of each lane.
    """
    start = [values.copy() for values in lanes[:4]]
    report = solve_lanes(arm.problem, lanes, drive, load, threads=threads, heat=heat)
    rung = report["rung"]
    if not (rung.any() or (report["slowness"] > DOUBT).any()):  # all are WARM, which is 0
        return report
    doubtful = (rung != Rung.FAILED) & ((rung == Rung.SUBSTEPS) | (report["slowness"] > DOUBT))
    for i in np.flatnonzero(doubtful):
        report["jumped"][i] = not returns(arm.problem, _lane(lanes[:4], i), _lane(start, i), Effort())
    n = lanes.tension.shape[1]
    for i in np.flatnonzero(rung == Rung.FAILED):
        known, stuck = _lane(start, i), _lane(lanes[:4], i)
        found = climb(arm, known, stuck, drive[i, :n], load[i], float(report["substep"][i]), Effort())
        report["rung"][i], report["residual"][i], report["jumped"][i] = found.rung, found.residual, found.jumped
        report["iterations"][i] += found.iterations
        answer = known
        if found.rung != Rung.FAILED:
            answer, lanes.tip[i], lanes.length[i] = found.arm.on(arm, found.lane), found.tip, found.lengths
        for values, new in zip(lanes[:4], answer, strict=True):
            values[i] = new
    return report


def _alone(lane: Lane) -> Lanes:
    """Return a copy of a lane as a batch of one."""
    strain, tension, drive, load = (values[np.newaxis].copy() for values in lane)
    return Lanes(strain, tension, drive, load, np.eye(4)[np.newaxis].copy(), np.empty_like(tension))


def _lane(known: Sequence[Array], i: Any) -> Lane:
    """Return a copy of one lane of strains, tensions, drives and loads."""
    return Lane(*(values[i].copy() for values in known))


def _shortest(problem: Problem, lane: Lane) -> float:
    """Return the smallest |p_a'| of the muscles at the nodes, eq. (13)."""
    (u_x, u_y, u_z, v_x, v_y, v_z), (x, y, dx, dy) = lane.strain.T[..., np.newaxis], np.moveaxis(problem.model.route, 2, 0)
    squares = (v_x - u_z * y + dx) ** 2 + (v_y + u_z * x + dy) ** 2 + (v_z + u_x * y - u_y * x) ** 2
    return float(np.sqrt(squares.min(initial=np.inf)))


def returns(problem: Problem, lane: Lane, start: Lane, effort: Effort) -> bool:
    """Return whether an arm that goes back to the drive and load of where it came from comes back to that state.

    If it does, it has not left its branch of equilibria. Where the effort ends on the way there is no verdict against it.
    """
    back = _follow(problem, lane, start.drive, start.load, effort)
    if not back.reached and effort.over:
        return True
    apart = np.abs(back.lane.strain - start.strain)
    return bool((apart[:, :3] * problem.model.length.sum()).max() < ALIKE and apart[:, 3:].max() < ALIKE)


def _follow(
    problem: Problem, lane: Lane, drive: Array, load: Array, effort: Effort, step: float = 1.0, substeps: bool = True
) -> _Followed:
    """Follow a branch by the compiled rungs, as far as it goes while there is effort left."""
    lanes = _alone(lane)
    iterations, reached, residual = 0, False, np.inf
    while step >= SMALLEST_SUBSTEP and not effort.over:
        report = solve_lanes(problem, lanes, drive[np.newaxis], load[np.newaxis], step, substeps)[0]
        iterations += int(report["iterations"])
        effort.spend(int(report["iterations"]) + 1, problem)
        reached, residual, step = bool(report["rung"] != Rung.FAILED), float(report["residual"]), float(report["substep"])
        if reached or not substeps:
            break
    here = Lane(*(values[0] for values in lanes[:4]))
    return _Followed(reached, here, lanes.tip[0], lanes.length[0], residual, iterations)


def descend(problem: Problem, lane: Lane, drive: Array, load: Array, effort: Effort) -> tuple[Lane | None, int]:
    """Go down the hill of the total energy to a stable equilibrium; return it, None where none was found, and the steps taken.

    The tensions follow from the path lengths, so the energy is a function of the strain alone. A step solves
    (T + damping K) dx = -g with T the tangent and g the imbalance, the damping large enough for a positive definite matrix:
    the minimiser of the energy's model in a trust region |dx|_K < r, r smaller the larger the damping. It is also a step of
    linearly implicit Euler, of length 1/damping, for a rod whose viscosity is proportional to K: the fall of a strongly damped
    arm. It begins at `lane` and happens at a drive (n,) and a load.
    """
    # Just beyond a fold the imbalance is small, too, where the equilibrium has been.
    model = problem.model
    end = min(model.tolerance, max(1e-3 * model.tolerance, 1e-10))
    flat = FLAT * float((model.stiffness[:, :3].min(axis=1) / model.length).min())

    def look(strain: Array, tension: Array, damping: float) -> Linearisation:
        effort.spend(1, problem)
        return linearise(problem, strain, tension, drive, load, "step", damping, slaved=True)

    strain, damping = lane.strain.copy(), FIRST_DAMPING
    here = look(strain, lane.tension, damping)
    for step in range(MAX_DESCENT):
        if not here.residual < np.inf or damping > MOST_DAMPING or effort.over:
            return None, step
        if here.residual < end:
            state = Lane(strain, here.tension, drive, load)
            if negative_eigenvalues(problem, state, NEUTRAL) == 0:
                return state, step
            if not here.negative and here.rotated < NUDGE:
                strain = _pushed_off(problem, state)
                here = look(strain, here.tension, damping)
                continue
        if not here.negative and np.isfinite(here.rotated):
            share = min(1.0, FALL_STEP / max(here.rotated, 1e-300), FALL_STEP / max(here.sheared, 1e-300))
            trial = strain + share * here.step
            there = look(trial, here.tension, EASING * damping)
            predicted = -share * here.work + 0.5 * share**2 * (here.work + damping * here.size)
            won = share * float(load[loads.MOMENT] @ here.tip[3:, 0])
            gained = here.energy - there.energy + won if there.residual < np.inf else -np.inf
            level = abs(gained) < flat and predicted < flat
            if gained > 0.5 * predicted or level:
                strain, damping, here = trial, EASING * damping, there
                continue
            if gained > 0.1 * predicted:
                strain, here = trial, there
        damping = max(4.0 * damping, 1e-3)
        here = look(strain, here.tension, damping)
    return None, MAX_DESCENT


def _pushed_off(problem: Problem, lane: Lane) -> Array:
    """Return strains (G, 6) a little off an unstable equilibrium, along its softest mode, which inverse iteration finds."""
    strain, model, damping = lane.strain, problem.model, 0.01
    while damping < MOST_DAMPING and negative_eigenvalues(problem, lane, damping):
        damping *= 2.0
    stiffness = np.repeat(model.stiffness, model.elements * model.nodes, axis=0)
    # A direction that no symmetric arm's softest mode is orthogonal to; so the side to which such an arm falls is settled.
    mode = np.tile([1.0, 0.27, 0.4, 0.0, 0.0, 0.0], (len(strain), 1)) * np.linspace(1.0, 0.5, len(strain))[:, np.newaxis]
    for _ in range(MODE_ITERATIONS):
        found = linearise(problem, *lane, "step", damping, given=-stiffness * mode)
        if not 0.0 < found.rotated < np.inf:  # no tangent to speak of: off along what there is
            break
        mode = NUDGE / found.rotated * found.step
    return np.asarray(strain + mode)


def negative_eigenvalues(problem: Problem, lane: Lane, damping: float = 0.0) -> int:
    """Return how many eigenvalues of T + damping K are negative, T being the tangent at a state, as a form in the strain."""
    return linearise(problem, *lane, "factors", damping).negative


def smallest_eigenvalue(problem: Problem, lane: Lane) -> float:
    """Return the smallest lambda of T x = lambda K x, x the strain, by counting the negative eigenvalues of T - lambda K.

    T is the second variation of the total energy, tensions following from the path lengths, and K the rod's stiffness: 1 for an
    unloaded rod, 0 at a fold or a bifurcation. To one part in ten million.
    """

    def below(value: float) -> bool:
        return negative_eigenvalues(problem, lane, -value) > 0

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
