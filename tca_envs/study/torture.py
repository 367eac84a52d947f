"""Whether the solver holds under policies that no controller is: the tasks' arms, driven a hundred thousand steps by each.

It goes through `Task.step`, as the environments do, with episodes of their length; only Gymnasium's wrappers are left out.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tca_envs import batch, presets
from tca_envs.mechanics import Rung, ladder, thermal
from tca_envs.mechanics.collocation import SHAPE, Heat, linearise, solve_lanes
from tca_envs.mechanics.kernels import REPORT
from tca_envs.mechanics.ladder import Lane
from tca_envs.study import output
from tca_envs.study.scenes import IDS
from tca_envs.study.timing import no_collection
from tca_envs.tasks import TASKS
from tca_envs.tasks.core import CUT_OFF, STEP_S, Core, Record, solved

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Policy = Callable[[Core, Integers], Array]
"""Core and the steps since each lane's episode began (N,) -> actions (N, a)."""

FULL, QUICK = 130_000, 2_000
"""Steps of a task under a policy; in `constant`, a fifth of them lead to where it starts."""
LANES = 10
"""Arms that are driven at once; each solve is one arm's, and timed by itself."""
GOALS = 20
"""Episodes that are drawn for a task; they recur."""
SPANS = (1, 2, 3, 5, 8, 13, 21, 34)
"""Steps for which every second lane of `bang_bang` holds its powers; 34 take a TCA to either end of its range."""
CYCLE, LONGEST_START = 100, 40
"""Steps of a cycle of `constant`, and most of them that lead to its start."""
SATURATED = (0.5, 6.0)
"""Temperature step below which the adversary turns to other powers, drawn between these [K]."""
GREEDY = 0.2
"""Share of these turns before which the adversary makes the largest steps that it can make all the time."""
LIMIT = 20e-3
"""Longest time that a solve may take [s]: a fifth of a step."""
RUNGS = (Rung.WARM, Rung.SUBSTEPS, Rung.FINER, Rung.DESCENT)
"""Of the ladder: those that can answer where the arm is loaded."""
SAMPLED = 25
"""One in so many rounds ends with a look at the stability of one lane; states that upper rungs found are all looked at."""


# Policies


def random(rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy that draws every number of an action uniformly."""
    return lambda core, age: rng.uniform(-1.0, 1.0, (lanes, actions))


def bang_bang(rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy that knows full power and none: drawn anew every step, and in every second lane held for a while."""
    action = np.empty((lanes, actions))
    left = np.zeros(lanes, dtype=np.int64)
    holds = np.arange(lanes) % 2 == 1

    def act(core: Core, age: Integers) -> Array:
        due = (left == 0) | (age == 0)
        action[due] = rng.choice([-1.0, 1.0], (due.sum(), actions))
        left[due] = np.where(holds, rng.choice(SPANS, lanes), 1)[due]
        left[:] -= 1
        return action

    return act


def constant(value: float, rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy of one action, from random states: full power for some TCAs and none for others, for a while."""
    action = np.empty((lanes, actions))
    start = np.empty(lanes, dtype=np.int64)

    def act(core: Core, age: Integers) -> Array:
        place = age % CYCLE
        due = place == 0
        action[due] = rng.choice([-1.0, 1.0], (due.sum(), actions))
        start[due] = rng.integers(0, LONGEST_START, due.sum(), endpoint=True)
        return np.where((place < start)[:, np.newaxis], action, value)

    return act


def all_on(rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy of full power, see `constant`."""
    return constant(1.0, rng, lanes, actions, heated)


def all_off(rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy of no power, see `constant`."""
    return constant(-1.0, rng, lanes, actions, heated)


def adversary(rng: np.random.Generator, lanes: int, actions: int, heated: int) -> Policy:
    """Return the policy that makes temperature steps as large as they come, with all TCAs against each other.

    Each TCA has full power or none until no temperature of the arm changes by much any more. Then those powers follow that
    change the temperatures most (Euclidean norm), among those that have least often followed the present ones: so every
    combination of hot and cold comes after every other. Before some of these changes each TCA has, for a while, in every
    step the one of full power and none that changes its own temperature more: no policy can do larger steps for longer. What
    an action holds beside powers is drawn with them, -1 or 1.
    """
    patterns = np.array(list(product((False, True), repeat=heated)))
    followed = np.zeros((len(patterns), len(patterns)))
    np.fill_diagonal(followed, np.inf)
    now, greedy = np.zeros(lanes, dtype=np.int64), np.zeros(lanes, dtype=np.int64)
    enough = rng.uniform(*SATURATED, lanes)
    others = np.ones((lanes, actions - heated))

    def act(core: Core, age: Integers) -> Array:
        now[age == 0] = greedy[age == 0] = 0
        rise, fall = extreme_steps(core)
        change = np.abs(np.where(patterns[now], rise, fall)).max(axis=1)
        for lane in np.flatnonzero((greedy == 0) & (change < enough)):
            size = np.linalg.norm(np.where(patterns, rise[lane], fall[lane]), axis=1)
            counts = followed[now[lane]]
            best = int(np.argmax(np.where(counts == counts.min(), size, -1.0)))
            counts[best] += 1.0
            now[lane], enough[lane] = best, rng.uniform(*SATURATED)
            greedy[lane] = rng.choice(SPANS) if rng.random() < GREEDY else 0
            others[lane] = rng.choice([-1.0, 1.0], actions - heated)
        on = np.where((greedy > 0)[:, np.newaxis], rise > -fall, patterns[now])
        greedy[:] = np.maximum(greedy - 1, 0)
        return np.hstack([np.where(on, 1.0, -1.0), others])

    return act


def extreme_steps(core: Core) -> tuple[Array, Array]:
    """Return the changes of the temperatures (N, m) [K] in a step at full power, up to the cut-off, and at none."""
    temperature, heating = core.record.temperature, core.heating
    power = np.clip(thermal.power_to_reach(temperature, CUT_OFF, STEP_S, heating), 0.0, heating.max_power)
    rise = thermal.step(temperature, power, STEP_S, heating) - temperature
    return rise, thermal.step(temperature, 0.0, STEP_S, heating) - temperature


POLICIES: dict[str, Callable[[np.random.Generator, int, int, int], Policy]] = {
    "random": random, "bang-bang": bang_bang, "all-on": all_on, "all-off": all_off, "adversary": adversary,
}  # fmt: skip


# What is watched


class Asked(NamedTuple):
    """What a solve started from and what it was asked for."""

    start: Array
    """Temperatures (n,) [degC]."""
    end: Array
    """(n,) [degC]."""
    payload: float
    """Mass that hangs from the tip [kg]."""


class Watched(Core):
    """A task's core that solves its lanes one by one and keeps what each solve took.

    Parameters
    ----------
    core : Core
        What to watch; it is taken over, not copied.
    """

    def __init__(self, core: Core) -> None:
        vars(self).update(vars(core))
        self.cpu: list[int] = []
        """Of each solve, time on the processor [ns]: that of other work on the machine does not count."""
        self.wall: list[int] = []
        """Of each solve, time on the clock [ns]."""
        self.reports: list[Array] = []
        """Of each solve, see `Core.step`."""
        self.slowest: Asked | None = None
        self.longest = 0
        self.failed: list[Asked] = []

    def _solve(self, record: Record, temperature: Array, external: Array, heat: Heat | None = None) -> Array:
        reports = []
        for lane in range(len(temperature)):
            rows = slice(lane, lane + 1)
            one = Record(*(getattr(record, f.name)[rows] for f in fields(Record)))
            start = one.drive[0].copy()
            warmth = (
                None
                if heat is None
                else heat._replace(action=heat.action[rows], temperature=heat.temperature[rows], power=heat.power[rows])
            )
            wall, cpu = time.perf_counter_ns(), time.thread_time_ns()
            report = super()._solve(one, temperature[rows], external, warmth)
            cpu, wall = time.thread_time_ns() - cpu, time.perf_counter_ns() - wall
            asked = Asked(start, temperature[lane, : start.size].copy(), float(one.payload[0, 0]))
            if self.slowest is None or cpu > self.longest:
                self.slowest, self.longest = asked, cpu
            if not solved(report).all():
                self.failed.append(asked)
            self.cpu.append(cpu)
            self.wall.append(wall)
            reports.append(report)
        self.reports += reports
        return np.concatenate(reports)


class Run(NamedTuple):
    """What a task's solver did under a policy in k steps, each with one solve."""

    task: str
    policy: str
    report: Array
    """(k, 4) see `Core.step`."""
    cpu: Array
    """Time of each solve on the processor (k,) [s]."""
    wall: Array
    """Time of each solve on the clock (k,) [s]."""
    change: Array
    """Change of the temperatures in each step (k,), Euclidean norm [K]."""
    finite: NDArray[np.bool_]
    """Whether the observation and all numbers of the arm were finite after each step (k,)."""
    stability: Array
    """`Equilibrium.stability` of random states and of all that upper rungs found (s,)."""
    slowest: Asked
    """Of the solve with the longest time on the processor."""
    failed: Sequence[Asked]
    """Of the solves without an answer."""

    @property
    def rungs(self) -> Integers:
        """How many solves each of `RUNGS` answered."""
        return np.array([(self.report[:, 0] == rung).sum() for rung in RUNGS])

    @property
    def jumps(self) -> int:
        """Solves in which the arm left its branch of equilibria."""
        return int(self.report[:, 3].sum())


def drive(name: str, policy: str, steps: int, progress: Callable[[Iterable[int]], Iterable[int]] = iter) -> Run:
    """Drive a task's arms with a policy.

    Parameters
    ----------
    name : str
        A key of `TASKS`.
    policy : str
        A key of `POLICIES`.
    steps : int
        How many; rounded up to a multiple of `LANES`.
    progress : callable
        Wraps the rounds of `LANES` steps, to show how far they are.
    """
    rng = np.random.default_rng(0)
    task = TASKS[name]("train", presets.TOLERANCE)
    plain = task.core(LANES)
    # One by one: a generator that they share has to finish one episode before the next.
    drawn = [task.draw(plain, [rng]) for _ in range(GOALS)]
    goals, scenes = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    core, record = Watched(plain), plain.record
    act = POLICIES[policy](rng, LANES, task.actions, record.temperature.shape[1])
    episode = gymnasium.spec(IDS[name]).max_episode_steps
    age = np.zeros(LANES, dtype=np.int64)
    over = np.ones(LANES, dtype=bool)
    change: list[Array] = []
    finite: list[NDArray[np.bool_]] = []
    stability: list[float] = []
    with no_collection():
        for i in progress(range(-(-steps // LANES))):
            chosen = rng.integers(0, GOALS, over.sum())
            core.reset(np.flatnonzero(over), goals[chosen], scenes[chosen])
            age[over] = 0
            before = record.temperature.copy()
            told = task.step(core, act(core, age))
            age += 1
            over = (age == episode) | ~solved(told)
            change.append(np.linalg.norm(record.temperature - before, axis=1))
            numbers = [*batch.look(task, core, told)[0].values(), *(getattr(record, f.name) for f in fields(Record))]
            finite.append(np.all([np.isfinite(n.reshape(LANES, -1)).all(axis=1) for n in numbers], axis=0))
            rare = np.isin(told[:, 0], (Rung.FINER, Rung.DESCENT))
            if i % SAMPLED == 0:
                rare[rng.integers(LANES)] = True
            stability += [stability_of(core, lane) for lane in np.flatnonzero(rare).tolist()]
    assert core.slowest is not None
    looked_at = np.array(stability)
    return Run(
        name, policy, np.concatenate(core.reports), 1e-9 * np.array(core.cpu), 1e-9 * np.array(core.wall),
        np.concatenate(change), np.concatenate(finite), looked_at[np.isfinite(looked_at)], core.slowest, core.failed,
    )  # fmt: skip


def stability_of(core: Core, lane: int) -> float:
    """Return `Equilibrium.stability` of a lane's state, on the grid on which it was found; nan if not found again."""
    arm, record = core.arm, core.record
    state = Lane(record.strain[lane], record.tension[lane], record.drive[lane], record.load[lane])
    here = linearise(arm.model, state.strain, state.tension.copy(), *state[2:], 0.0, False, SHAPE, state.strain)
    if here[0][0] > arm.model.tolerance:
        # The answer is that of a finer grid, carried to this one.
        strain, tension, drive, load = (values[np.newaxis].copy() for values in arm.on(arm.finer, state))
        tip, lengths, report = np.eye(4)[np.newaxis], np.empty_like(tension), np.empty((1, REPORT))
        solve_lanes(arm.finer.model, strain, tension, drive, load, drive.copy(), load.copy(), tip, lengths, report)
        if not solved(report).all():
            return np.nan
        return ladder.smallest_eigenvalue(arm.finer.model, strain[0], tension[0], drive[0], load[0])
    return ladder.smallest_eigenvalue(arm.model, *state)


# What is written


HEADER = (
    "task", "policy", "steps", "failed", "not_finite", "jumped", *(rung.name.lower() for rung in RUNGS), "median_cpu_s",
    "p999_cpu_s", "max_cpu_s", "max_wall_s", "mean_change_K", "max_change_K", "smallest_stability", "slowest_from_degC",
    "slowest_to_degC", "slowest_payload_kg", "failed_from_degC", "failed_to_degC", "failed_payload_kg",
)  # fmt: skip
"""The columns failed_... are of the first failure."""


def row(run: Run) -> list[object]:
    """Return a run's row of the table, as `HEADER` says."""
    median, p999, worst = np.quantile(run.cpu, [0.5, 0.999, 1.0]).tolist()
    first = run.failed[0] if run.failed else Asked(np.empty(0), np.empty(0), np.nan)
    return [
        run.task, run.policy, run.cpu.size, len(run.failed), int((~run.finite).sum()), run.jumps, *run.rungs.tolist(), median,
        p999, worst, float(run.wall.max()), float(run.change.mean()), float(run.change.max()), float(run.stability.min()),
        *written(run.slowest), *written(first),
    ]  # fmt: skip


def written(asked: Asked) -> list[object]:
    """Return a solve's temperatures, to the last digit, and its payload."""
    return [" ".join(map(repr, values.tolist())) for values in (asked.start, asked.end)] + [asked.payload]


def report(runs: Sequence[Run]) -> str:
    """Return what the runs say, as Markdown."""
    rows = [
        [r.task, r.policy, f"{r.cpu.size}", f"{len(r.failed)}", f"{(~r.finite).sum()}", f"{r.jumps}",
         *(f"{count}" for count in r.rungs), *(f"{1e6 * t:.0f}" for t in np.quantile(r.cpu, [0.5, 0.999])),
         f"{1e3 * r.cpu.max():.2f}", f"{1e3 * r.wall.max():.2f}", f"{r.change.mean():.1f}", f"{r.change.max():.1f}",
         f"{r.stability.min():.1g}"]
        for r in runs
    ]  # fmt: skip
    header = [
        "Task", "Policy", "Steps", "Failed", "Not finite", "Jumped", *(rung.name.lower() for rung in RUNGS), "Median [us]",
        "99.9 % [us]", "Worst [ms]", "Worst, clock [ms]", "Mean change [K]", "Largest [K]", "Least stable",
    ]  # fmt: skip
    worst = max(runs, key=lambda r: r.cpu.max())
    slow = sum(int((r.cpu >= LIMIT).sum()) for r in runs)
    return "\n\n".join(
        [
            "## Policies that no controller is",
            f"In {sum(r.cpu.size for r in runs)} steps, at least {min(r.cpu.size for r in runs)} of each task under each "
            f"policy: {sum(len(r.failed) for r in runs)} solves failed, {sum(int((~r.finite).sum()) for r in runs)} steps left "
            f"a number that is not finite, {sum(r.jumps for r in runs)} times the arm left its branch of equilibria. The "
            f"slowest solve took {1e3 * worst.cpu.max():.1f} ms ({worst.task}, {worst.policy}); {slow} took "
            f"{1e3 * LIMIT:g} ms or longer. Of {sum(r.stability.size for r in runs)} states, random ones and all those after "
            f"a rung beyond substeps, the least stable one has a stability of {min(r.stability.min() for r in runs):.1g}.",
            "Episodes are as long as the tasks', and a failure ends one. Policies: random powers, drawn uniformly every step; "
            f"bang-bang: full power or none, drawn every step and in half of the lanes held for up to {max(SPANS)} steps; all "
            f"on and all off, every {CYCLE} steps anew after up to {LONGEST_START} steps of full power for some TCAs and none "
            "for others; adversary: full power or none for each TCA until the temperatures hardly change any more, then the "
            "powers that change them most, until every combination has followed every other, now and then the largest steps "
            "that go on and on. warm to descent: which rung of the solver's ladder answered. Times are those of a solve alone, "
            "on the processor; those on the clock hold whatever else the machine did. The change is that of all temperatures "
            "in a step (Euclidean norm). torture.csv has the temperatures of the slowest solves and of failures.",
            output.markdown_table(header, rows),
            "",
        ]
    )


def run(out: Path, quick: bool = False) -> str:
    """Write torture.csv into the folder `out`; returns a section of Markdown."""
    from tqdm import tqdm

    runs = []
    for task, policy in product(TASKS, POLICIES):
        progress = partial(tqdm, desc=f"{task}, {policy}", unit="round")
        runs.append(drive(task, policy, QUICK if quick else FULL, progress))
    output.write_csv(out / "torture.csv", HEADER, map(row, runs))
    return report(runs)
