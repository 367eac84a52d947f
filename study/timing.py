"""Time and tip error of a method at a setting on the cases of a scene: a point of the speed-accuracy chart."""

from collections.abc import Sequence
from math import nan
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from study.method import Answer, Array, Method, Solver, State
from study.pattern import no_collection
from study.reference import reference
from study.scenes import Case, Scene
from tca_envs.mechanics import Arm, Equilibrium, Grid

REPEATS, REPEAT_S = 21, 0.01
"""A solve is repeated until there are so many or until they have taken so long together [s]; it counts with the median."""
OTHER_EQUILIBRIUM = 0.1
"""A tip farther than this from the reference, relative to the arm's length, belongs to another equilibrium."""
SMALLEST_ERROR = 1e-13  # errors below this are raised to it [m]: a few units in the last place of the tip's coordinates

FAILS, REFUSES = "fails on all cases", "cannot model this arm"
NOT_INSTALLED, NOT_RUN = "not installed", "not run: it would take too long"  # notes of points that have nothing to show


class Effort(NamedTuple):
    """How much is measured."""

    cases: int  # of a scene
    budget: float  # time [s] after which a point takes no further case ...
    least: int  # ... unless it has fewer than this.
    patience: float  # time [s] that a method has on a scene; then its finer settings are left out
    building: float = np.inf
    """Time [s] that its solvers may take to build on a scene, likewise; with none, methods that build slowly are left out."""


FULL = Effort(cases=100, budget=2.0, least=3, patience=30.0, building=120.0)
QUICK = Effort(cases=12, budget=0.1, least=1, patience=0.6, building=0.0)


class Known(NamedTuple):
    """The reference of a case."""

    before: Equilibrium | None  # at the state before, where there is one; what `Solver.near` is told
    tip: Array  # position at the state (3,) [m]
    error: float  # bound of the error of `tip` [m]


class Point(NamedTuple):
    """A method at a setting on a scene; errors in metres, times in seconds, nan where nothing was measured."""

    scene: str
    method: str
    knob: str
    setting: str
    start: str  # "cold" or "warm"
    cases: int = 0  # on which it was tried
    failed: int = 0
    time: float = nan  # median over the cases that did not fail, as everything below
    time_q25: float = nan
    time_q75: float = nan
    error: float = nan  # median
    error_p95: float = nan
    error_max: float = nan
    own_error: float = nan
    """Median error against the method's own finest setting, of a method whose answers have a limit of their own."""
    floor: float = nan  # smallest error that the reference could tell
    note: str = ""

    @property
    def failure_rate(self) -> float:
        """Share of the cases that failed; nan if there was none."""
        return self.failed / self.cases if self.cases else nan

    @property
    def solved(self) -> bool:
        """Whether there is a time and an error to show."""
        return self.cases > self.failed


class Measured(NamedTuple):
    """What a solver did on the first cases of an order."""

    time: Array  # (k,) [s]; nan where the state before failed
    tip: Array  # (k, 3) [m]; nan where it failed
    error: Array  # (k,) [m]; nan where it failed
    spent: float  # time for all this [s]


class Referee:
    """Reference tips of a scene's cases, each computed when it is first asked for."""

    def __init__(self, scene: Scene) -> None:
        arm = scene.arm
        self.scene = scene
        self.known: dict[int, Known] = {}
        # Sampling an equilibrium takes long, so what methods start from is on a grid no finer than it must be.
        grids = [Grid(grid.elements, max(grid.nodes, 8)) for grid in arm.grids]
        self.near = Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-9)

    def __call__(self, index: int) -> Known:
        """Return the reference of a case."""
        if index not in self.known:
            before, state = self.scene.cases[index]
            start = None if before is None else equilibrium(self.near, before)
            found = reference(state, equilibrium(self.near, state, start))
            self.known[index] = Known(start, found.tip[:3, 3], max(found.error, SMALLEST_ERROR))
        return self.known[index]


def equilibrium(arm: Arm, state: State, start: Equilibrium | None = None) -> Equilibrium:
    """Return the equilibrium of an arm at a state; RuntimeError where there is none, because a scene's cases have one."""
    found = state.on(arm, start)
    if not found.converged:
        raise RuntimeError(f"no reference at drive {state.drive.tolist()}: {found.message}")
    return found


def spread(count: int) -> list[int]:
    """Return 0 to count - 1 in an order whose every beginning is spread evenly over them (van der Corput's)."""
    digits = max(count - 1, 1).bit_length()
    return [i for i in (int(f"{k:0{digits}b}"[::-1], 2) for k in range(2**digits)) if i < count]


def label(setting: Any) -> str:
    """Return a setting as text, powers of ten as 1e-6."""
    if not isinstance(setting, float) or 0.1 <= abs(setting) < 1e4:
        return f"{setting:g}" if isinstance(setting, float) else str(setting)
    mantissa, exponent = f"{setting:.5e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def measure(
    solver: Solver, cases: Sequence[Case], order: Sequence[int], referee: Referee, far: float, effort: Effort
) -> Measured:
    """Solve cases in an order, until the budget is spent; tips farther off than `far` [m] are failures."""
    times: list[float] = []
    tips: list[Array] = []
    errors: list[float] = []
    spent = 0.0
    for index in order:
        if spent > effort.budget and len(times) >= effort.least:
            break
        known, begun = referee(index), perf_counter()
        answer, taken = timed(solver, cases[index], known)
        tip = np.asarray(answer.tip, dtype=np.float64)[:3, 3] if answer.converged else np.full(3, nan)
        error = max(float(np.linalg.norm(tip - known.tip)), known.error)
        good = error <= far  # not so for nan
        times.append(taken)
        tips.append(tip if good else np.full(3, nan))
        errors.append(error if good else nan)
        spent += perf_counter() - begun
    return Measured(np.array(times), np.array(tips), np.array(errors), spent)


def timed(solver: Solver, case: Case, known: Known) -> tuple[Answer, float]:
    """Solve a case as often as there is time for; returns the answer and the median time [s]."""
    if case.before is None or known.before is None:
        guess = solver.cold()
    else:
        first = solver.solve(case.before, solver.near(known.before, case.before))
        if not first.converged:
            return first, nan
        guess = first.guess
    taken: list[float] = []
    with no_collection():
        while len(taken) < REPEATS and sum(taken) < REPEAT_S:
            begun = perf_counter()
            answer = solver.solve(case.state, guess)
            taken.append(perf_counter() - begun)
    return answer, float(np.median(taken))


def points(scene: Scene, method: Method, referee: Referee, effort: Effort) -> list[Point]:
    """Return a point for every setting of a method on a scene, coarse to fine; a note says why there is nothing to show."""
    order = spread(len(scene.cases))
    states = [state for case in scene.cases for state in case if state is not None]
    far = np.inf if method.reduced else OTHER_EQUILIBRIUM * scene.arm.length
    result: list[Point] = []
    tips: list[Array] = []
    spent, building, compiled = 0.0, 0.0, False
    for setting in method.settings:
        point = Point(scene.name, method.name, method.knob, label(setting), scene.start)
        measured = Measured(np.empty(0), np.empty((0, 3)), np.empty(0), 0.0)
        if not method.available():
            point = point._replace(note=NOT_INSTALLED)
        elif spent > effort.patience or (method.builds_slowly and building >= effort.building):
            point = point._replace(note=NOT_RUN)
        else:
            begun = perf_counter()
            try:
                solver = method.build(scene.arm, setting, states)
            except ValueError as error:
                point = point._replace(note=f"{REFUSES}: {error}")
            else:
                building += perf_counter() - begun
                if not compiled:
                    timed(solver, scene.cases[order[0]], referee(order[0]))
                    compiled = True
                measured = measure(solver, scene.cases, order, referee, far, effort)
                spent += measured.spent
                floor = max(referee(index).error for index in order[: measured.time.size])
                point = summary(point._replace(floor=floor), measured)
        result.append(point)
        tips.append(measured.tip)
    if method.own_limit:
        result = [p._replace(own_error=distance(tip, tips[-1])) for p, tip in zip(result, tips, strict=True)]
    return result


def summary(point: Point, measured: Measured) -> Point:
    """Return a point with what was measured."""
    good = np.isfinite(measured.error)
    point = point._replace(cases=good.size, failed=int((~good).sum()))
    if not good.any():
        return point._replace(note=FAILS)
    low, middle, high = np.quantile(measured.time[good], [0.25, 0.5, 0.75]).tolist()
    median, p95, worst = np.quantile(measured.error[good], [0.5, 0.95, 1.0]).tolist()
    return point._replace(time=middle, time_q25=low, time_q75=high, error=median, error_p95=p95, error_max=worst)


def distance(tip: Array, finest: Array) -> float:
    """Return the median distance [m] of tips (k, 3) and those at the finest setting (f, 3), of the cases that both solved."""
    both = min(len(tip), len(finest))
    apart = np.linalg.norm(tip[:both] - finest[:both], axis=1)
    return float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else nan
