"""The benchmark: every task by every algorithm with several seeds, as a table and a figure of learning curves.

`python train.py --benchmark` trains with the settings of `agents.hyperparameters`, exactly as `python train.py` does, and
evaluates each policy on held-out goals of its own seed, the scripted controller and a random policy on the same.
"""

import csv
import json
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import flatdim

import train
from agents import curve
from agents.evaluate import Episodes, Policy, lanes_for, run, summary, wilson
from agents.fastest import fastest
from agents.hyperparameters import DEFAULT_ALGORITHM, HYPERPARAMETERS
from agents.scripted import CONTROLLERS, Array, RandomPolicy
from tca_envs.study.output import markdown_table, save_figure, write_csv

REFERENCES = ("random", "scripted")
"""What stands beside the algorithms."""
GOALS_APART = 10_000
"""The held-out goals of seed s are drawn with seeds from `train.EVALUATION_SEED` + s times this on: no two share a goal."""
EPISODES, QUICK_EPISODES = 200, 10
"""Held-out episodes of each run."""
QUICK_SHARE = 0.01
"""Of the steps, in a quick look."""
TITLES = {"reach": "Reach", "twist-align": "TwistAlign", "pick-and-place": "PickAndPlace"}
NAMES = {"ppo": "PPO", "sac": "SAC", "her": "SAC + HER", "dagger": "DAgger"}


@dataclass(frozen=True)
class Run:
    """One training, or what it is compared with."""

    task: str
    policy: str
    """An algorithm or one of REFERENCES."""
    seed: int
    quick: bool
    out: Path

    @property
    def folder(self) -> Path:
        """Where it lands."""
        return self.out / "runs" / f"{self.task}-{self.policy}-seed{self.seed}"

    @property
    def report(self) -> Path:
        """What it leaves at last."""
        return self.folder / "report.json"

    @property
    def episodes(self) -> int:
        """Held-out episodes."""
        return QUICK_EPISODES if self.quick else EPISODES

    @property
    def goals(self) -> int:
        """First seed of the held-out goals."""
        return train.EVALUATION_SEED + GOALS_APART * self.seed


def benchmark(
    out: Path,
    tasks: Sequence[str],
    seeds: Sequence[int],
    jobs: int = 1,
    quick: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Train, evaluate and write the table and the figure; a run whose report is there already is not repeated.

    Parameters
    ----------
    out : pathlib.Path
        Gets `benchmark.md`, `benchmark.csv`, `runs.csv`, `curves.csv`, `curves.png`, and each run's folder under `runs`.
    tasks : sequence of str
        Of `agents.hyperparameters.HYPERPARAMETERS`.
    seeds : sequence of int
        Each algorithm is trained with each of them.
    jobs : int
        Runs at a time; they share the processor's threads.
    quick : bool
        A hundredth of the steps and few episodes: whether everything works.
    say : callable
        Called with a line for each run that is done.
    """
    runs = [Run(task, policy, seed, quick, out) for task in tasks for policy in policies(task) for seed in seeds]
    for task in tasks:
        for seed in seeds:
            say(f"least times of {task}, seed {seed}: {least_times(Run(task, 'scripted', seed, quick, out)).mean():.2f} s")
    # The longest ones, those of the last task, first: then no process is left alone with one at the end.
    missing = [one for one in reversed(runs) if not one.report.exists()]
    for done in each(perform, missing, jobs):
        say(line(done))
    write(out, runs, jobs)


def policies(task: str) -> list[str]:
    """Return the rows of a task's table."""
    return [*REFERENCES, *(name for name in NAMES if name in HYPERPARAMETERS[task])]


def each(work: Callable[[Run], Run], runs: list[Run], jobs: int) -> Iterable[Run]:
    """Yield what `work` returns for each run, in processes of their own if `jobs` > 1."""
    if jobs == 1:
        yield from map(work, runs)
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = str(threads)  # read as the processes begin
    try:
        with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
            for done in as_completed([pool.submit(work, one) for one in runs]):
                yield done.result()
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def perform(one: Run) -> Run:
    """Do a run; it leaves its report, and what it prints in `log.txt`."""
    one.folder.mkdir(parents=True, exist_ok=True)
    with (one.folder / "log.txt").open("w") as log, redirect_stdout(log), redirect_stderr(log):
        described = reference(one) if one.policy in REFERENCES else trained(one)
    one.report.write_text(json.dumps(described, indent=2) + "\n")
    return one


def reference(one: Run) -> dict[str, Any]:
    """Evaluate the scripted controller or a random policy; returns its report."""
    env = next(iter(HYPERPARAMETERS[one.task].values()))["env"]
    policy = (
        CONTROLLERS[one.task]()
        if one.policy == "scripted"
        else RandomPolicy(flatdim(gymnasium.make(env).action_space), one.seed)
    )
    return {"task": one.task, "algo": one.policy, "env": env, "seed": one.seed, **evaluated(one, policy, env)}


def trained(one: Run) -> dict[str, Any]:
    """Train as `python train.py` does and evaluate; returns the run's report."""
    settings = dict(HYPERPARAMETERS[one.task][one.policy])
    steps = max(1, int(settings["n_timesteps"] * (QUICK_SHARE if one.quick else 1.0)))
    arguments = ["--task", one.task, "--algo", one.policy, "--seed", str(one.seed), "--steps", str(steps)]
    options = train.parse([*arguments, "--out", str(one.folder)])
    torch.set_num_threads(options.threads)
    train.clear(one.folder)
    model = train.build(one.policy, settings, options)
    seconds, interrupted = train.train(model, one.task, one.policy, settings, options, one.folder, progress_bar=False)
    if interrupted:
        raise KeyboardInterrupt
    model = train.load(one.folder / "policy.zip", one.policy, settings, options)
    (one.folder / "replay_buffer.pkl").unlink(missing_ok=True)  # nobody goes on from here, and it is large
    return {
        **train.describe(model, one.task, one.policy, settings, options, seconds),
        "steps": steps,
        **evaluated(one, model, settings["env"]),
    }


def evaluated(one: Run, policy: Policy, env: str) -> dict[str, Any]:
    """Run a policy on its seed's held-out goals; returns what its report says of them."""
    vector = gymnasium.make_vec(env, lanes_for(one.episodes), split="held-out")
    episodes = run(policy, vector, one.episodes, one.goals)
    ratio = over_fastest(episodes, least_times(one))
    return {"evaluation_seed": one.goals, "held_out": {one.policy: {**asdict(summary(episodes)), "over_fastest": ratio}}}


def over_fastest(episodes: Episodes, least: Array) -> float | None:
    """Return the time to success of the episodes that succeed over the `least` that heaters allow (n,); None if none does."""
    time = least[episodes.success].sum()
    return float(episodes.held_since_s[episodes.success].sum() / time) if time > 0.0 else None


def least_times(one: Run) -> Array:
    """Return `agents.fastest.fastest` of a run's held-out goals (n,) [s]; every policy has the same, so they are kept."""
    path = one.out / "runs" / f"{one.task}-fastest-seed{one.seed}.json"
    if not path.exists():
        env = gymnasium.make(next(iter(HYPERPARAMETERS[one.task].values()))["env"], split="held-out")
        found = [fastest(one.task, env.reset(seed=one.goals + i)[0]) for i in range(one.episodes)]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found) + "\n")
    return np.array(json.loads(path.read_text()))


def line(one: Run) -> str:
    """Return what a run came to in one line."""
    found = held_out(one)
    seconds = json.loads(one.report.read_text()).get("training_seconds")
    time = "" if seconds is None else f", {seconds:.0f} s"
    return f"{one.folder.name}: success {100.0 * found['success_rate']:.1f} %, {found['final_distance_mm']:.2f} mm{time}"


def held_out(one: Run) -> dict[str, Any]:
    """Return what a run's report says of its held-out goals."""
    described: dict[str, Any] = json.loads(one.report.read_text())["held_out"][one.policy]
    return described


@dataclass(frozen=True)
class Row:
    """A line of the table: one policy on one task, over all seeds."""

    task: str
    policy: str
    default: bool
    """Whether `python train.py` trains so."""
    seeds: int
    episodes: int
    successes: int
    low: float
    high: float
    """95 % Wilson score interval of the success rate."""
    final_distance_mm: float
    final_yaw_error_deg: float
    """nan where the task has none."""
    time_to_success_s: float
    over_fastest: float
    """Time to success of the episodes that succeed over the least that heaters allow; nan, as the one before, if none does."""
    energy_J: float
    minutes: float
    """Of a training, mean over the seeds; nan if there is none."""
    steps: int
    """Of a training."""


def rows(runs: list[Run]) -> list[Row]:
    """Return the table of some runs, whose reports are there."""
    table = []
    for task, policy in dict.fromkeys((one.task, one.policy) for one in runs):
        reports = [json.loads(one.report.read_text()) for one in runs if (one.task, one.policy) == (task, policy)]
        found = [report["held_out"][policy] for report in reports]
        episodes, successes = (sum(part[name] for part in found) for name in ("episodes", "successes"))

        def mean(values: Iterable[float | None]) -> float:
            known = [value for value in values if value is not None]
            return float(np.mean(known)) if known else float("nan")

        table.append(
            Row(
                task,
                policy,
                DEFAULT_ALGORITHM[task] == policy,
                len(reports),
                episodes,
                successes,
                *wilson(successes, episodes),
                mean(part["final_distance_mm"] for part in found),
                mean(part["final_yaw_error_deg"] for part in found),
                mean(part["time_to_success_s"] for part in found),
                mean(part["over_fastest"] for part in found),
                mean(part["energy_J"] for part in found),
                mean(report["training_seconds"] / 60.0 if "training_seconds" in report else None for report in reports),
                reports[0].get("steps", 0),
            )
        )
    return table


HEADER = (
    "Policy",
    "Success rate (95 % interval)",
    "Final error",
    "Time to success",
    "over the fastest",
    "Energy",
    "Training",
    "Steps",
)


def cells(row: Row) -> list[str]:
    """Return a line of the table as text."""
    name = NAMES.get(row.policy, row.policy)
    error = f"{row.final_distance_mm:.2f} mm"
    if not np.isnan(row.final_yaw_error_deg):
        error += f", {row.final_yaw_error_deg:.1f}°"
    return [
        f"**{name}**" if row.default else name,
        f"{100.0 * row.successes / row.episodes:.1f} % ({100.0 * row.low:.1f}-{100.0 * row.high:.1f} %)",
        error,
        number(row.time_to_success_s, "{:.2f} s"),
        number(row.over_fastest, "{:.2f}"),
        f"{row.energy_J:.1f} J",
        number(row.minutes, "{:.1f} min"),
        f"{row.steps:,}" if row.steps else "--",
    ]


def number(value: float, form: str) -> str:
    """Return a number as text, nan as "--"."""
    return "--" if np.isnan(value) else form.format(value)


def write(out: Path, runs: list[Run], jobs: int) -> None:
    """Write the tables and the figure of some runs, whose reports are there."""
    table = rows(runs)
    names = list(Row.__dataclass_fields__)
    write_csv(out / "benchmark.csv", names, [[getattr(row, name) for name in names] for row in table])
    each_run = [rows([one])[0] for one in runs]
    seeded = [[one.seed, *(getattr(row, name) for name in names)] for one, row in zip(runs, each_run, strict=True)]
    write_csv(out / "runs.csv", ["seed", *names], seeded)
    curves = {one: curve.read(one.folder) for one in runs if one.policy not in REFERENCES}
    columns = ("steps", "seconds", "success_rate", "final_distance_mm")
    points = [[one.task, one.policy, one.seed, *(p[name] for name in columns)] for one, found in curves.items() for p in found]
    write_csv(out / "curves.csv", ["task", "policy", "seed", *columns], points)
    draw(out)
    (out / "benchmark.md").write_text(page(table, runs, jobs), encoding="utf-8")


def page(table: list[Row], runs: list[Run], jobs: int) -> str:
    """Return the page that shows the tables and the figure and says how they are measured."""
    seeds = list(dict.fromkeys(one.seed for one in runs))
    parts = [
        "# Trained policies",
        f"Made by `python train.py --benchmark`, {jobs} at a time on {os.cpu_count()} cores. Every algorithm was trained with "
        f"seeds {', '.join(map(str, seeds))} and evaluated on {runs[0].episodes} held-out goals for each seed, the scripted "
        "controller and a random policy on the same goals. In bold what `python train.py` trains by default.",
    ]
    for task in dict.fromkeys(row.task for row in table):
        parts += [f"## {TITLES[task]}", markdown_table(HEADER, [cells(row) for row in table if row.task == task])]
    parts += [
        "## Learning curves",
        "![Success against steps and time of training](curves.png)",
        f"*Success on {train.CURVE_EPISODES} goals of the training split, mean and range over the seeds.*",
        "## How it is measured",
        "An episode succeeds if its last step does: goals are to be held. Time to success is that from which on they are, mean "
        "over the episodes that succeed; over the fastest: summed over them, and divided by the least time in which heaters "
        "could do it, see `agents/fastest.py`. In PickAndPlace that leaves the stage and the release out, so nobody can come "
        "near 1. The final error is the distance from the goal at the end of the episode, mean over all episodes, and in "
        "TwistAlign that of the yaw. Training is the time of a whole training, the points of its learning curve included; the "
        "policy kept is the one that came nearest to the goals of its curve.",
        "`runs.csv` has the runs one by one, `curves.csv` the points of the curves.",
    ]
    return "\n\n".join(parts) + "\n"


def draw(out: Path) -> None:
    """Draw the learning curves that `curves.csv` holds as `curves.png`."""
    from matplotlib.figure import Figure

    with (out / "curves.csv").open(newline="", encoding="utf-8") as file:
        points = list(csv.DictReader(file))
    tasks = list(dict.fromkeys(point["task"] for point in points))
    figure = Figure(figsize=(4.0 * len(tasks), 5.6), layout="constrained")
    panels = figure.subplots(2, len(tasks), sharey=True, squeeze=False)
    for column, task in enumerate(tasks):
        mine = [point for point in points if point["task"] == task]
        for axes, quantity, unit in zip(panels[:, column], ("steps", "seconds"), (1e3, 60.0), strict=True):
            for name in dict.fromkeys(point["policy"] for point in mine):
                color = f"C{list(NAMES).index(name)}"
                at, low, mean, high = spread([point for point in mine if point["policy"] == name], quantity)
                axes.plot(at / unit, 100.0 * mean, color=color, label=NAMES[name])
                axes.fill_between(at / unit, 100.0 * low, 100.0 * high, color=color, alpha=0.2, linewidth=0.0)
            axes.set(xscale="log", ylim=(-3.0, 103.0))
            axes.grid(alpha=0.25, linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
        panels[0, column].set(title=TITLES[task], xlabel="environment steps [thousands]")
        panels[1, column].set(xlabel="time of training [min]")
        panels[0, column].legend(frameon=False, fontsize=8)
    for axes in panels[:, 0]:
        axes.set(ylabel="success rate [%]")
    save_figure(figure, out / "curves.png")


def spread(points: list[dict[str, str]], quantity: str) -> tuple[Array, Array, Array, Array]:
    """Return values of `quantity` that all seeds have come to, and the least, mean and largest success rate at them."""
    seeds = dict.fromkeys(point["seed"] for point in points)
    pairs = [(point["seed"], float(point[quantity]), float(point["success_rate"])) for point in points]
    curves = [np.array([pair[1:] for pair in pairs if pair[0] == seed]).T for seed in seeds]
    first, last = max(found[0, 0] for found in curves), min(found[0, -1] for found in curves)
    at = np.unique(np.clip(np.concatenate([found[0] for found in curves]), first, max(first, last)))
    success = np.array([np.interp(at, *found) for found in curves])
    return at, success.min(axis=0), success.mean(axis=0), success.max(axis=0)
