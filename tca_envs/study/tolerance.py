"""Whether the environments keep the tip error that they are asked for, and what a looser one saves."""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import Arm, Equilibrium, Grid, Payload
from tca_envs.mechanics.arm import default_grid
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.study import output
from tca_envs.study.method import State
from tca_envs.study.reference import NoReference, reference
from tca_envs.study.scenes import IDS
from tca_envs.study.timing import no_collection
from tca_envs.tasks.core import CUT_OFF

Array = NDArray[np.float64]

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
"""Asked for [m]."""
KEPT = 0.999
"""Share of the states in which the tip is to stay within the tolerance."""
CHANGE = 8.0
"""Largest change of a temperature on the way to a state [K]: about that of a step at full power."""
HELD_WITHIN = 1e-3
"""Largest offset of a held object's centre from the jaws' middle [m]."""
SAME = 1e-7
"""Equilibria whose tips are within this distance [m] on a fine grid are the same."""
FULL, QUICK = 2000, 40
"""States of a task."""
REPEATS = 5
"""Of a timed solve."""
ROUNDS_FULL, ROUNDS_QUICK = 400, 40
"""Solves and steps that are timed, of each task and tolerance in turn."""


class Case(NamedTuple):
    """A random state and the one that the arm comes from."""

    before: Array
    """(n,) [degC]."""
    drive: Array
    """(n,) [degC]."""
    payload: Payload | None


class Kept(NamedTuple):
    """What a task's arm did at a tolerance."""

    task: str
    arm: Arm
    tolerance: float
    """[m]."""
    error: Array
    """(k,) true tip errors [m]; inf where no equilibrium was found."""
    solve: float
    """Median time of a warm solve [s]."""
    step: float
    """Median time of a step of the environment [s]."""

    @property
    def within(self) -> float:
        """Share of the states with a true tip error up to the tolerance."""
        return float((self.error <= self.tolerance).mean())


def random_cases(arm: Arm, held: bool, count: int) -> list[Case]:
    """Return states at temperatures drawn uniformly up to the heaters' cut-off; with an object in every second, if `held`."""
    rng = np.random.default_rng(2)
    cases = []
    for i in range(count):
        drive = rng.uniform(AMBIENT, CUT_OFF, len(arm.muscles))
        before = np.clip(drive + rng.uniform(-CHANGE, CHANGE, drive.size), AMBIENT, CUT_OFF)
        place = np.array([0.0, 0.0, presets.JAW_DEPTH]) + rng.uniform(-HELD_WITHIN, HELD_WITHIN, 3)
        cases.append(Case(before, drive, presets.with_object(place) if held and i % 2 else None))
    return cases


def solved(arm: Arm, case: Case) -> Equilibrium:
    """Return the equilibrium of a case, on a warm start from the state before."""
    before = arm.equilibrium(case.before, payload=case.payload)
    return arm.equilibrium(case.drive, start=before, payload=case.payload)


def finer(arm: Arm) -> Arm:
    """Return the arm on a grid on which references start."""
    grids = [Grid(default_grid(module).elements, 8) for module in arm.modules]
    return Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-9)


def true_errors(arms: Sequence[Arm], fine: Arm, case: Case) -> list[float]:
    """Return the distance [m] of each arm's tip to that at round-off, on the branch of equilibria that it is on."""
    known: list[tuple[Array, Array]] = []
    errors = []
    for arm in arms:
        found = solved(arm, case)
        if not found.converged:
            errors.append(np.inf)
            continue
        near = fine.equilibrium(case.drive, start=found, payload=case.payload)
        tip = near.tip_pose[:3, 3]
        exact = next((there for here, there in known if np.linalg.norm(tip - here) < SAME), None)
        if exact is None:
            try:
                exact = reference(State(fine, case.drive, payload=case.payload), near).tip[:3, 3]
            except NoReference:
                errors.append(np.inf)
                continue
            known.append((tip, exact))
        errors.append(float(np.linalg.norm(found.tip_pose[:3, 3] - exact)))
    return errors


def solve_times(arms: Sequence[Arm], cases: Sequence[Case]) -> list[float]:
    """Return the median time of a warm solve on each arm [s]; the arms take turns."""
    taken = np.empty((len(cases), len(arms)))
    with no_collection():
        for i, case in enumerate(cases):
            for j, arm in enumerate(arms):
                before = arm.equilibrium(case.before, payload=case.payload)
                begun = time.perf_counter()
                for _ in range(REPEATS):
                    arm.equilibrium(case.drive, start=before, payload=case.payload)
                taken[i, j] = (time.perf_counter() - begun) / REPEATS
    return np.median(taken, axis=0).tolist()


def step_times(task: str, steps: int) -> list[float]:
    """Return the median time of a step under random actions at each tolerance [s]; the environments take turns."""
    envs: list[gymnasium.Env[Any, Any]] = [gymnasium.make(IDS[task], tolerance=tolerance) for tolerance in TOLERANCES]
    rng = np.random.default_rng(0)
    taken = np.empty((steps, len(envs)))
    with no_collection():
        for i in range(steps):
            action = rng.uniform(-1.0, 1.0, envs[0].action_space.shape or ()).astype(np.float32)
            for j, env in enumerate(envs):
                if i % 50 == 0:
                    env.reset(seed=i)
                begun = time.perf_counter()
                env.step(action)
                taken[i, j] = time.perf_counter() - begun
    return np.median(taken, axis=0).tolist()


def measure(task: str, count: int, rounds: int, progress: Callable[[Iterable[Case]], Iterable[Case]] = iter) -> list[Kept]:
    """Return what a task's arm does at every tolerance.

    Parameters
    ----------
    task : str
        A key of `scenes.IDS`.
    count : int
        Random states.
    rounds : int
        Solves and steps that are timed.
    progress : callable
        Wraps the states, to show how far they are.
    """
    arms = [gymnasium.make(IDS[task], tolerance=tolerance).unwrapped.arm for tolerance in TOLERANCES]  # type: ignore[attr-defined]
    cases = random_cases(arms[0], task == "pick-and-place", count)
    fine = finer(arms[0])
    errors = np.array([true_errors(arms, fine, case) for case in progress(cases)])
    timed = random_cases(arms[0], task == "pick-and-place", rounds)
    columns = zip(arms, TOLERANCES, errors.T, solve_times(arms, timed), step_times(task, rounds), strict=True)
    return [Kept(task, *column) for column in columns]


HEADER = (
    "task", "tolerance_m", "grids", "residual_tolerance", "estimated_error_m", "states", "share_within", "median_error_m",
    "p999_error_m", "max_error_m", "solve_s", "step_s",
)  # fmt: skip


def write(kept: Sequence[Kept], path: Path) -> None:
    """Write everything as CSV."""
    rows = []
    for k in kept:
        chosen = k.arm.discretisation
        median, p999, largest = np.quantile(k.error, [0.5, KEPT, 1.0], method="higher").tolist()
        rows.append(
            (k.task, k.tolerance, written(k.arm), chosen.residual_tolerance, chosen.error, len(k.error), k.within, median,
             p999, largest, k.solve, k.step)
        )  # fmt: skip
    output.write_csv(path, HEADER, rows)


def written(arm: Arm) -> str:
    """Return the grids of an arm in words, such as "1 x 7 + 4 x 6"."""
    return " + ".join(f"{elements} x {nodes}" for elements, nodes in arm.grids)


def report(kept: Sequence[Kept]) -> str:
    """Return tolerance.md."""
    rows = []
    for k in kept:
        first = next(other for other in kept if other.task == k.task and other.tolerance == 1e-6)
        median, p999, largest = np.quantile(k.error, [0.5, KEPT, 1.0], method="higher").tolist()
        rows.append(
            [k.task, f"{k.tolerance:.0e}", written(k.arm), f"{k.arm.discretisation.error:.1e}", f"{median:.1e}", f"{p999:.1e}",
             f"{largest:.1e}", f"{100.0 * k.within:.2f} %", f"{1e6 * k.solve:.1f}", f"{k.solve / first.solve:.2f}",
             f"{1e6 * k.step:.0f}", f"{k.step / first.step:.2f}"]
        )  # fmt: skip
    header = [
        "Task", "Asked [m]", "Elements x nodes", "Estimated", "Median error", "99.9 %", "Largest", "Within", "Solve [us]",
        "to 1e-6", "Step [us]", "to 1e-6",
    ]  # fmt: skip
    few = min(k.within for k in kept)
    return "\n\n".join(
        [
            "# What a tolerance promises and what it costs",
            f"In {len(kept[0].error)} random states of each task the true tip error stays within the asked tolerance in at "
            f"least {100.0 * few:.2f} %.",
            "States are temperatures drawn uniformly from 25 degC to the heaters' cut-off, reached by a step of up to "
            f"{CHANGE:g} K; in every second state of pick-and-place the gripper holds the object. The truth is an equilibrium "
            "to round-off by multiple shooting (`tca_envs.study.reference`) on the branch that the arm is on; a state without "
            "equilibrium or reference would count as outside. Times are medians on one machine, in turns, of a warm "
            '`Arm.equilibrium` and of a whole step of the environment; columns "to 1e-6" compare with those at 1e-6 m.',
            "![True error and time against the tolerance](tolerance.png)",
            output.markdown_table(header, rows),
            "",
        ]
    )


def draw(kept: Sequence[Kept], path: Path) -> None:
    """Draw true errors and times against the tolerance."""
    from matplotlib.ticker import EngFormatter

    figure, (left, right) = output.new_figure(2, 10.0, 3.9)
    left.plot(TOLERANCES, TOLERANCES, color="black", linewidth=1.0, linestyle="--", label="asked")
    for shift, (task, colour) in enumerate(zip(dict.fromkeys(k.task for k in kept), COLOURS, strict=False)):
        of_task = [k for k in kept if k.task == task]
        asked = np.array([k.tolerance for k in of_task])
        quantiles = np.array([np.quantile(k.error, [0.5, KEPT], method="higher") for k in of_task])
        x = asked * 1.25 ** (shift - 1)
        left.vlines(x, quantiles[:, 0], quantiles[:, 1], color=colour, linewidth=2.0, alpha=0.5)
        left.plot(x, quantiles[:, 0], color=colour, marker="o", linestyle="", label=f"{task}: median")
        left.plot(x, quantiles[:, 1], color=colour, marker="_", markersize=9, markeredgewidth=2.0, linestyle="")
        right.plot(asked, [k.solve for k in of_task], color=colour, marker="o", label=task)
    left.plot([], [], color="grey", marker="_", markersize=9, markeredgewidth=2.0, linestyle="", label="99.9 % of the states")
    for axes in (left, right):
        axes.set(xscale="log", xlabel="tip error asked for")
        axes.xaxis.set_major_formatter(EngFormatter(unit="m", sep=" "))
        axes.legend(frameon=False, fontsize=9)
    left.set(yscale="log", ylabel="true tip error")
    right.set(ylabel="time of a warm solve, median", ylim=(0.0, None))
    for axes in (left, right):
        axes.yaxis.set_major_formatter(EngFormatter(unit="m" if axes is left else "s", sep=" "))
    output.save_figure(figure, path)


COLOURS = ("#0072B2", "#D55E00", "#009E73")
"""Of the tasks; told apart by the colour-blind, too (Okabe & Ito)."""


def run(out: Path, quick: bool = False, say: Callable[[str], object] = print) -> None:
    """Write tolerance.png, .csv and .md into the folder `out`."""
    from tqdm import tqdm

    kept: list[Kept] = []
    for task in IDS:
        count, rounds = (QUICK, ROUNDS_QUICK) if quick else (FULL, ROUNDS_FULL)
        kept += measure(task, count, rounds, lambda cases, task=task: tqdm(cases, desc=task, unit="state"))  # type: ignore[misc]
    write(kept, out / "tolerance.csv")
    (out / "tolerance.md").write_text(report(kept), encoding="utf-8")
    draw(kept, out / "tolerance.png")
    say(report(kept))
    say(f"wrote tolerance (.png, .csv, .md) in {out}")
