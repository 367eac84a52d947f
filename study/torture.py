"""Whether the solver holds under policies that no controller is: the tasks' arms, driven a hundred thousand steps by each.

It goes through `Task.step`, as the environments do, with episodes of their length; only Gymnasium's wrappers are left out.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from study import pattern
from study.method import Array
from study.pattern import Column
from tca_envs import batch, registry
from tca_envs.mechanics import Arm, Rung, continuation, loads, thermal
from tca_envs.robots import CUT_OFF
from tca_envs.tasks.core import Core, solved

Integers = NDArray[np.int64]
Policy = Callable[[Core, Integers], Array]  # core and the steps since each lane's episode began (N,) -> actions (N, a)

FULL, QUICK = 130_000, 2_000  # steps of a task under a policy; in `constant`, a fifth of them lead to where it starts
LANES = 10  # arms that are driven at once; each solve is one arm's, and timed by itself
GOALS = 20  # episodes that are drawn for a task; they recur
SPANS = (1, 2, 3, 5, 8, 13, 21, 34)
"""Steps for which every second lane of `bang_bang` holds its powers; 34 take a TCA to either end of its range."""
CYCLE, LONGEST_START = 100, 40  # steps of a cycle of `constant`, and most of them that lead to its start
SATURATED = (0.5, 6.0)  # temperature step below which the adversary turns to other powers, drawn between these [K]
GREEDY = 0.2  # share of these turns before which the adversary makes the largest steps that it can make all the time
LIMIT = 20e-3  # longest time that a solve may take [s]: a fifth of a step
RUNGS = (Rung.WARM, Rung.SUBSTEPS, Rung.FINER, Rung.DESCENT)  # of the ladder: those that can answer where the arm is loaded
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
    power = np.clip(thermal.power_to_reach(temperature, CUT_OFF, core.step_s, heating), 0.0, heating.max_power)
    rise = thermal.step(temperature, power, core.step_s, heating) - temperature
    return rise, thermal.step(temperature, 0.0, core.step_s, heating) - temperature


POLICIES: dict[str, Callable[[np.random.Generator, int, int, int], Policy]] = {
    "random": random, "bang-bang": bang_bang, "all-on": partial(constant, 1.0), "all-off": partial(constant, -1.0),
    "adversary": adversary,
}  # fmt: skip


# What is watched


class Asked(NamedTuple):
    """What a solve started from and what it was asked for."""

    start: Array  # temperatures (n,) [degC]
    end: Array  # (n,) [degC]
    payload: float  # mass that hangs from the tip [kg]


class Watched:
    """The package's solver, called lane by lane, and what each solve took."""

    def __init__(self) -> None:
        self.cpu: list[int] = []
        """Of each solve, time on the processor [ns]: that of other work on the machine does not count."""
        self.wall: list[int] = []
        """Of each solve, time on the clock [ns]."""
        self.reports: list[Any] = []
        """Of each solve, see `continuation.solve`."""
        self.slowest: Asked | None = None
        self.longest = 0
        self.failed: list[Asked] = []

    def __call__(self, arm: Arm, lanes: Any, drive: Array, load: Array, threads: int = 1, heat: Any = None) -> Any:
        """Solve as `continuation.solve` does."""
        reports = []
        for lane in range(len(drive)):
            rows = slice(lane, lane + 1)
            start = lanes.drive[lane].copy()
            mine = heat and heat._replace(**{k: getattr(heat, k)[rows] for k in ("action", "temperature", "power")})
            one = continuation.Lanes(*(values[rows] for values in lanes))
            wall, cpu = time.perf_counter_ns(), time.thread_time_ns()
            report = continuation.solve(arm, one, drive[rows], load[rows], heat=mine)
            cpu, wall = time.thread_time_ns() - cpu, time.perf_counter_ns() - wall
            asked = Asked(start, drive[lane, : start.size].copy(), float(load[lane, loads.MASS]))
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
    report: Any  # (k, 4) see `Core.step`
    cpu: Array  # time of each solve on the processor (k,) [s]
    wall: Array  # time of each solve on the clock (k,) [s]
    change: Array  # change of the temperatures in each step (k,), Euclidean norm [K]
    finite: NDArray[np.bool_]  # whether the observation and all numbers of the arm were finite after each step (k,)
    stability: Array  # `Equilibrium.stability` of random states and of all that upper rungs found (s,)
    slowest: Asked  # of the solve with the longest time on the processor
    failed: Sequence[Asked]  # of the solves without an answer

    @property
    def rungs(self) -> Integers:
        """How many solves each of `RUNGS` answered."""
        return np.array([(self.report["rung"] == rung).sum() for rung in RUNGS])

    @property
    def jumps(self) -> int:
        """Solves in which the arm left its branch of equilibria."""
        return int(self.report["jumped"].sum())


def drive(name: str, policy: str, steps: int) -> Run:
    """Drive a registered task's arms with a policy of `POLICIES`; steps are rounded up to a multiple of `LANES`."""
    rng = np.random.default_rng(0)
    entry = registry.entry(name)
    task = entry.new()
    core = task.core(LANES)
    # One by one: a generator that they share has to finish one episode before the next.
    drawn = [task.sample(core, [rng]) for _ in range(GOALS)]
    goals, scenes = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    record, watched = core.record, Watched()
    core.solve = watched
    act = POLICIES[policy](rng, LANES, task.actions, record.temperature.shape[1])
    age, over = np.zeros(LANES, dtype=np.int64), np.ones(LANES, dtype=bool)
    change: list[Array] = []
    finite: list[NDArray[np.bool_]] = []
    stability: list[float] = []
    with pattern.no_collection():
        for i in pattern.progress(range(-(-steps // LANES)), f"{name}, {policy}", "round"):
            chosen = rng.integers(0, GOALS, over.sum())
            core.reset(np.flatnonzero(over), goals[chosen], scenes[chosen])
            age[over] = 0
            before = record.temperature.copy()
            told = task.step(core, act(core, age))
            age += 1
            over = (age == entry.steps) | ~solved(told)
            change.append(np.linalg.norm(record.temperature - before, axis=1))
            numbers = [*batch.look(task, core, told)[0].values(), *batch.snapshot(record).values()]
            finite.append(np.all([np.isfinite(n.reshape(LANES, -1)).all(axis=1) for n in numbers], axis=0))
            rare = np.isin(told["rung"], (Rung.FINER, Rung.DESCENT))
            if i % SAMPLED == 0:
                rare[rng.integers(LANES)] = True
            stability += [stability_of(core, lane) for lane in np.flatnonzero(rare).tolist()]
    assert watched.slowest is not None
    looked_at = np.array(stability)
    return Run(
        name, policy, np.concatenate(watched.reports), 1e-9 * np.array(watched.cpu), 1e-9 * np.array(watched.wall),
        np.concatenate(change), np.concatenate(finite), looked_at[np.isfinite(looked_at)], watched.slowest, watched.failed,
    )  # fmt: skip


def stability_of(core: Core, lane: int) -> float:
    """Return `Equilibrium.stability` of a lane's state, on the grid on which it was found; nan if not found again."""
    record = core.record
    known = continuation.Lane(*(x[lane].copy() for x in (record.strain, record.tension, record.drive, record.load)))
    for arm in (core.arm, core.arm.finer):
        found = continuation.solve_one(arm, core.arm.on(arm, known), known.drive, known.load)
        # What is no equilibrium on the arm's own grid is that of a finer one, carried to this one.
        if found.rung != Rung.FAILED and (arm is not core.arm or found.iterations == 0):
            return continuation.smallest_eigenvalue(found.arm.problem, found.lane)
    return np.nan


# What is written


def asked_for(name: str, of: Callable[[Run], Asked]) -> list[Column]:
    """Return the columns of what a solve of a run was asked for, temperatures to the last digit."""
    return [
        Column(lambda r: " ".join(map(repr, of(r).start.tolist())), f"{name}_from_degC"),
        Column(lambda r: " ".join(map(repr, of(r).end.tolist())), f"{name}_to_degC"),
        Column(lambda r: of(r).payload, f"{name}_payload_kg"),
    ]


micro, milli = pattern.fixed(".0f", 1e6), pattern.fixed(".2f", 1e3)
COLUMNS = (
    Column("task", "task", "Task"), Column("policy", "policy", "Policy"), Column(lambda r: r.cpu.size, "steps", "Steps"),
    Column(lambda r: len(r.failed), "failed", "Failed"), Column(lambda r: int((~r.finite).sum()), "not_finite", "Not finite"),
    Column("jumps", "jumped", "Jumped"),
    *(Column(lambda r, k=k: int(r.rungs[k]), rung.name.lower(), rung.name.lower()) for k, rung in enumerate(RUNGS)),  # type: ignore[misc]
    Column(lambda r: float(np.median(r.cpu)), "median_cpu_s", "Median [us]", micro),
    Column(lambda r: float(np.quantile(r.cpu, 0.999)), "p999_cpu_s", "99.9 % [us]", micro),
    Column(lambda r: float(r.cpu.max()), "max_cpu_s", "Worst [ms]", milli),
    Column(lambda r: float(r.wall.max()), "max_wall_s", "Worst, clock [ms]", milli),
    Column(lambda r: float(r.change.mean()), "mean_change_K", "Mean change [K]", pattern.fixed(".1f")),
    Column(lambda r: float(r.change.max()), "max_change_K", "Largest [K]", pattern.fixed(".1f")),
    Column(lambda r: float(r.stability.min()), "smallest_stability", "Least stable", pattern.fixed(".1g")),
    *asked_for("slowest", lambda r: r.slowest),
    *asked_for("failed", lambda r: r.failed[0] if r.failed else Asked(np.empty(0), np.empty(0), np.nan)),  # the first one
)  # fmt: skip


def report(runs: Sequence[Run]) -> str:
    """Return what the runs say, as Markdown."""
    worst = max(runs, key=lambda r: r.cpu.max())
    slow = sum(int((r.cpu >= LIMIT).sum()) for r in runs)
    return pattern.page(
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
        pattern.table(COLUMNS, runs),
    )


def measure(quick: bool) -> list[Run]:
    """Drive every task with every policy."""
    return [drive(entry.name, policy, QUICK if quick else FULL) for entry, policy in product(registry.entries(), POLICIES)]
