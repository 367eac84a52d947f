"""Whether the environments keep the tip error that they are asked for, and what a looser one saves."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from study import pattern
from study.method import Array, State
from study.pattern import COLOURS, Column, Study
from study.reference import NoReference, reference
from study.scenes import Case
from tca_envs import registry
from tca_envs.mechanics import Arm, Grid
from tca_envs.mechanics.arm import default_grid
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import CUT_OFF, paper

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)  # asked for [m]
KEPT = 0.999  # share of the states in which the tip is to stay within the tolerance
CHANGE = 8.0  # largest change of a temperature on the way to a state [K]: about that of a step at full power
HELD_WITHIN = 1e-3  # largest offset of a held object's centre from the jaws' middle [m]
SAME = 1e-7  # equilibria whose tips are within this distance [m] on a fine grid are the same
FULL, QUICK = (2000, 400), (40, 40)  # states of a task, and solves and steps that are timed, of each task and tolerance in turn
REPEATS = 5  # of a timed solve


class Kept(NamedTuple):
    """What a task's arm did at a tolerance."""

    task: str
    arm: Arm
    tolerance: float  # [m]
    error: Array  # (k,) true tip errors [m]; inf where no equilibrium was found
    solve: float  # median time of a warm solve [s]
    step: float  # median time of a step of the environment [s]

    @property
    def within(self) -> float:
        """Share of the states with a true tip error up to the tolerance."""
        return float((self.error <= self.tolerance).mean())

    @property
    def grids(self) -> str:
        """The grids of the arm in words, such as "1 x 7 + 4 x 6"."""
        return " + ".join(f"{elements} x {nodes}" for elements, nodes in self.arm.grids)

    def quantile(self, share: float) -> float:
        """Return a quantile of the errors [m]."""
        return float(np.quantile(self.error, share, method="higher"))


def random_cases(arm: Arm, held: bool, count: int) -> list[Case]:
    """Return states at temperatures drawn uniformly up to the heaters' cut-off; with an object in every second, if `held`."""
    rng = np.random.default_rng(2)
    cases = []
    for i in range(count):
        drive = rng.uniform(AMBIENT, CUT_OFF, len(arm.muscles))
        before = np.clip(drive + rng.uniform(-CHANGE, CHANGE, drive.size), AMBIENT, CUT_OFF)
        x, y, z = rng.uniform(-HELD_WITHIN, HELD_WITHIN, 3).tolist()
        payload = paper.with_object((x, y, paper.JAW_DEPTH + z)) if held and i % 2 else None
        cases.append(Case(State(arm, before, payload=payload), State(arm, drive, payload=payload)))
    return cases


def finer(arm: Arm) -> Arm:
    """Return the arm on a grid on which references start."""
    grids = [Grid(default_grid(module).elements, 8) for module in arm.modules]
    return Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-9)


def true_errors(arms: Sequence[Arm], fine: Arm, case: Case) -> list[float]:
    """Return the distance [m] of each arm's tip to that at round-off, on the branch of equilibria that it is on."""
    known: list[tuple[Array, Array]] = []
    errors = []
    for arm in arms:
        found = case.state.on(arm, case.start(arm))
        near = case.state.on(fine, found) if found.converged else None
        try:
            if near is None:
                raise NoReference("no equilibrium")
            tip = near.tip_pose[:3, 3]
            exact = next((there for here, there in known if np.linalg.norm(tip - here) < SAME), None)
            if exact is None:
                exact = reference(replace(case.state, arm=fine), near).tip[:3, 3]
                known.append((tip, exact))
            errors.append(float(np.linalg.norm(found.tip_pose[:3, 3] - exact)))
        except NoReference:
            errors.append(np.inf)
    return errors


def solve_times(arms: Sequence[Arm], cases: Sequence[Case]) -> list[float]:
    """Return the median time of a warm solve on each arm [s]; the arms take turns."""
    taken = np.empty((len(cases), len(arms)))
    with pattern.no_collection():
        for i, case in enumerate(cases):
            for j, arm in enumerate(arms):
                before = case.start(arm)
                call = partial(case.state.on, arm, before)
                taken[i, j] = pattern.seconds(lambda call=call: [call() for _ in range(REPEATS)]) / REPEATS  # type: ignore[misc]
    return np.median(taken, axis=0).tolist()


def step_times(task: str, steps: int) -> list[float]:
    """Return the median time of a step under random actions at each tolerance [s]; the environments take turns."""
    name = registry.entry(task).ids["sparse"]
    envs: list[gymnasium.Env[Any, Any]] = [gymnasium.make(name, tolerance=tolerance) for tolerance in TOLERANCES]
    rng = np.random.default_rng(0)
    taken = np.empty((steps, len(envs)))
    with pattern.no_collection():
        for i in range(steps):
            action = rng.uniform(-1.0, 1.0, envs[0].action_space.shape or ()).astype(np.float32)
            for j, env in enumerate(envs):
                if i % 50 == 0:
                    env.reset(seed=i)
                taken[i, j] = pattern.seconds(partial(env.step, action))
    return np.median(taken, axis=0).tolist()


def measure(task: str, count: int, rounds: int) -> list[Kept]:
    """Return what a task's arm does at every tolerance in so many random states; so many solves and steps are timed."""
    robot = registry.entry(task).new().robot
    arms = [robot.built(tolerance) for tolerance in TOLERANCES]
    fine = finer(arms[0])
    cases, timed = (random_cases(arms[0], task == "pick-and-place", number) for number in (count, rounds))
    errors = np.array([true_errors(arms, fine, case) for case in pattern.progress(cases, task, "state")])
    columns = zip(arms, TOLERANCES, errors.T, solve_times(arms, timed), step_times(task, rounds), strict=True)
    return [Kept(task, *column) for column in columns]


def columns(kept: Sequence[Kept]) -> list[Column]:
    """Return the columns of the table; times are compared with those at 1e-6 m."""
    first = {k.task: k for k in kept if k.tolerance == 1e-6}
    length = "{:.1e}".format
    return [
        Column("task", "task", "Task"), Column("tolerance", "tolerance_m", "Asked [m]", "{:.0e}".format),
        Column("grids", "grids", "Elements x nodes"),
        Column(lambda k: k.arm.discretisation.residual_tolerance, "residual_tolerance"),
        Column(lambda k: k.arm.discretisation.error, "estimated_error_m", "Estimated", length),
        Column(lambda k: len(k.error), "states"), Column("within", "share_within"),
        Column(lambda k: k.quantile(0.5), "median_error_m", "Median error", length),
        Column(lambda k: k.quantile(KEPT), "p999_error_m", "99.9 %", length),
        Column(lambda k: k.quantile(1.0), "max_error_m", "Largest", length),
        Column("within", "", "Within", lambda share: f"{100.0 * share:.2f} %"),
        Column("solve", "solve_s", "Solve [us]", pattern.fixed(".1f", 1e6)),
        Column(lambda k: k.solve / first[k.task].solve, "", "to 1e-6", pattern.fixed(".2f")),
        Column("step", "step_s", "Step [us]", pattern.fixed(".0f", 1e6)),
        Column(lambda k: k.step / first[k.task].step, "", "to 1e-6", pattern.fixed(".2f")),
    ]  # fmt: skip


def report(kept: Sequence[Kept]) -> str:
    """Return the page."""
    return pattern.page(
        "# What a tolerance promises and what it costs",
        f"In {len(kept[0].error)} random states of each task the true tip error stays within the asked tolerance in at "
        f"least {100.0 * min(k.within for k in kept):.2f} %.",
        "States are temperatures drawn uniformly from 25 degC to the heaters' cut-off, reached by a step of up to "
        f"{CHANGE:g} K; in every second state of pick-and-place the gripper holds the object. The truth is an equilibrium "
        "to round-off by multiple shooting (`study.reference`) on the branch that the arm is on; a state without "
        "equilibrium or reference would count as outside. Times are medians on one machine, in turns, of a warm "
        '`Arm.equilibrium` and of a whole step of the environment; columns "to 1e-6" compare with those at 1e-6 m.',
        "![True error and time against the tolerance](tolerance.png)",
        pattern.table(columns(kept), kept),
    )


def draw(kept: Sequence[Kept]) -> "Iterator[tuple[str, Figure]]":
    """Draw true errors and times against the tolerance."""
    figure, (left, right) = pattern.new_figure(2, 10.0, 3.9)
    left.plot(TOLERANCES, TOLERANCES, color="black", linewidth=1.0, linestyle="--", label="asked")
    high = {"marker": "_", "markersize": 9, "markeredgewidth": 2.0, "linestyle": ""}
    for shift, (task, colour) in enumerate(zip(pattern.names(kept, "task"), COLOURS, strict=False)):
        of_task = [k for k in kept if k.task == task]
        asked = np.array([k.tolerance for k in of_task])
        median, p999 = ([k.quantile(share) for k in of_task] for share in (0.5, KEPT))
        x = asked * 1.25 ** (shift - 1)
        left.vlines(x, median, p999, color=colour, linewidth=2.0, alpha=0.5)
        left.plot(x, median, color=colour, marker="o", linestyle="", label=f"{task}: median")
        left.plot(x, p999, color=colour, **high)  # type: ignore[arg-type]
        right.plot(asked, [k.solve for k in of_task], color=colour, marker="o", label=task)
    left.plot([], [], color="grey", label="99.9 % of the states", **high)  # type: ignore[arg-type]
    for axes in (left, right):
        axes.set(xscale="log", xlabel="tip error asked for")
        axes.legend(frameon=False, fontsize=9)
    left.set(yscale="log", ylabel="true tip error")
    right.set(ylabel="time of a warm solve, median", ylim=(0.0, None))
    for axes, unit in ((left, "m"), (right, "s")):
        pattern.with_units(axes, "m", unit)
    yield "tolerance.png", figure


STUDY = Study(
    "tolerance",
    "check that tasks keep the tip error that they are asked for, and what a looser one saves",
    lambda quick: [kept for entry in registry.entries() for kept in measure(entry.name, *(QUICK if quick else FULL))],
    tables={"tolerance.csv": (columns([]), lambda kept: kept)},
    figures=draw,
    page=("tolerance.md", report),
    findings=report,
)
