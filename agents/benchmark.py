"""The benchmark: every task by every algorithm with several seeds, as a table and a figure of learning curves.

`python train.py --benchmark` trains with the settings of `agents.hyperparameters`, as `python train.py` does. Each policy is
evaluated on the held-out goals of its seed; the scripted controller and a random policy are evaluated on the same goals.
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
from gymnasium.spaces import flatdim

from agents import curve, training
from agents.evaluate import Episodes, Policy, lanes_for, run, summary, wilson
from agents.fastest import fastest
from agents.hyperparameters import default_algorithm, settings_of
from agents.output import markdown_table, save_figure, write_csv
from agents.scripted import Array, RandomPolicy, controller_of
from agents.training import Job
from tca_envs import registry
from tca_envs.registry import Entry

REFERENCES = ("random", "scripted")
"""Policies that the algorithms are compared with."""
GOALS_APART = 10_000
"""The held-out goals of seed s are drawn with seeds from `training.EVALUATION_SEED` + s times this on: no two share a goal."""
EPISODES, QUICK_EPISODES = 200, 10
"""Held-out episodes of each run."""
QUICK_SHARE = 0.01
"""Share of the steps that a quick benchmark trains."""
NAMES = {"ppo": "PPO", "sac": "SAC", "her": "SAC + HER", "dagger": "DAgger"}


@dataclass(frozen=True)
class Run:
    """One training, or the evaluation of a reference."""

    task: str
    policy: str
    """An algorithm or one of REFERENCES."""
    seed: int
    quick: bool
    out: Path

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.out / "runs" / f"{self.entry.name}-{self.policy}-seed{self.seed}"

    @property
    def entry(self) -> Entry:
        """What belongs to the task."""
        return registry.entry(self.task)

    @property
    def env(self) -> str:
        """Id of the environment in which controllers are evaluated."""
        return str(next(iter(settings_of(self.task).values()))["env"])

    @property
    def report(self) -> Path:
        """Path of its report, which is written last."""
        return self.folder / "report.json"

    @property
    def episodes(self) -> int:
        """Number of held-out episodes."""
        return QUICK_EPISODES if self.quick else EPISODES

    @property
    def goals(self) -> int:
        """First seed of the held-out goals."""
        return training.EVALUATION_SEED + GOALS_APART * self.seed


def benchmark(
    out: Path,
    tasks: Sequence[str],
    seeds: Sequence[int],
    jobs: int = 1,
    quick: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Train, evaluate and write the table and the figure; runs that have a report are not repeated.

    Parameters
    ----------
    out : pathlib.Path
        Folder of `benchmark.md`, `benchmark.csv`, `runs.csv`, `curves.csv`, `curves.png`, and of each run under `runs`.
    tasks : sequence of str
        Names in `tca_envs.registry`.
    seeds : sequence of int
        Each algorithm is trained with each of them.
    jobs : int
        Runs at a time; they share the processor's threads.
    quick : bool
        Train a hundredth of the steps and evaluate few episodes, as a check.
    say : callable
        Called with a line of text after each run.
    """
    runs = [Run(task, policy, seed, quick, out) for task in tasks for policy in policies(task) for seed in seeds]
    for task in (task for task in tasks if registry.entry(task).fastest is not None):
        for seed in seeds:
            say(f"least times of {task}, seed {seed}: {least_times(Run(task, 'scripted', seed, quick, out)).mean():.2f} s")
    # The longest runs, those of the last task, start first, so that all processes end at about the same time.
    missing = [one for one in reversed(runs) if not one.report.exists()]
    for done in each(perform, missing, jobs):
        say(line(done))
    write(out, runs, jobs)


def policies(task: str) -> list[str]:
    """Return the policies of a task's table."""
    known, controlled = settings_of(task), registry.entry(task).controller is not None
    return ["random", *(["scripted"] if controlled else []), *(name for name in NAMES if name in known)]


def each(work: Callable[[Run], Run], runs: list[Run], jobs: int) -> Iterable[Run]:
    """Yield the result of `work` for each run, in separate processes if `jobs` > 1."""
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
    """Do a run and write its report; output goes to `log.txt`."""
    one.folder.mkdir(parents=True, exist_ok=True)
    with (one.folder / "log.txt").open("w") as log, redirect_stdout(log), redirect_stderr(log):
        described = reference(one) if one.policy in REFERENCES else trained(one)
    one.report.write_text(json.dumps(described, indent=2) + "\n")
    return one


def reference(one: Run) -> dict[str, Any]:
    """Evaluate the scripted controller or a random policy; returns its report."""
    size = flatdim(gymnasium.make(one.env).action_space)
    policy = controller_of(one.task) if one.policy == "scripted" else RandomPolicy(size, one.seed)
    return {"task": one.task, "algo": one.policy, "env": one.env, "seed": one.seed, **evaluated(one, policy, one.env)}


def trained(one: Run) -> dict[str, Any]:
    """Train as `python train.py` does and evaluate; returns the run's report."""
    job = Job(one.task, one.policy, settings_of(one.task)[one.policy], one.seed)
    steps = max(1, int(job.settings["n_timesteps"] * (QUICK_SHARE if one.quick else 1.0)))
    training.set_threads(job.threads)
    training.clear(one.folder)
    model = training.build(job)
    seconds, interrupted = training.train(job, model, one.folder, steps, progress_bar=False)
    if interrupted:
        raise KeyboardInterrupt
    model = training.load(job, one.folder / "policy.zip")
    (one.folder / "replay_buffer.pkl").unlink(missing_ok=True)  # nobody resumes it, and it is large
    return {**training.describe(job, model, seconds), "steps": steps, **evaluated(one, model, job.settings["env"])}


def evaluated(one: Run, policy: Policy, env: str) -> dict[str, Any]:
    """Run a policy on its seed's held-out goals; returns that part of the report."""
    vector = gymnasium.make_vec(env, lanes_for(one.episodes), split="held-out")
    episodes = run(policy, vector, one.episodes, one.goals)
    ratio = over_fastest(episodes, least_times(one))
    return {"evaluation_seed": one.goals, "held_out": {one.policy: {**asdict(summary(episodes)), "over_fastest": ratio}}}


def over_fastest(episodes: Episodes, least: Array) -> float | None:
    """Return the ratio of the time to success to the `least` possible (n,), over successful episodes; None without any."""
    time = least[episodes.success].sum()
    return float(episodes.held_since_s[episodes.success].sum() / time) if time > 0.0 else None


def least_times(one: Run) -> Array:
    """Return `agents.fastest.fastest` of a run's held-out goals (n,) [s]; they are stored for all policies of the seed."""
    path = one.out / "runs" / f"{one.entry.name}-fastest-seed{one.seed}.json"
    if not path.exists():
        env = gymnasium.make(one.env, split="held-out")
        found = [fastest(one.task, env.reset(seed=one.goals + i)[0]) for i in range(one.episodes)]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found) + "\n")
    return np.array(json.loads(path.read_text()))


def line(one: Run) -> str:
    """Return the result of a run in one line."""
    found = held_out(one)
    seconds = json.loads(one.report.read_text()).get("training_seconds")
    time = "" if seconds is None else f", {seconds:.0f} s"
    distance = "" if found["final_distance_mm"] is None else f", {found['final_distance_mm']:.2f} mm"
    return f"{one.folder.name}: success {100.0 * found['success_rate']:.1f} %{distance}{time}"


def held_out(one: Run) -> dict[str, Any]:
    """Return the results of a run on its held-out goals."""
    described: dict[str, Any] = json.loads(one.report.read_text())["held_out"][one.policy]
    return described


@dataclass(frozen=True)
class Row:
    """A line of the table: one policy on one task, over all seeds."""

    task: str
    policy: str
    default: bool
    """Whether this is the task's default algorithm."""
    seeds: int
    episodes: int
    successes: int
    low: float
    high: float
    """95 % Wilson score interval of the success rate."""
    final_distance_mm: float
    final_yaw_error_deg: float
    """nan, as the distance, where the task has none."""
    time_to_success_s: float
    over_fastest: float
    """Ratio of the time to success to the least possible, over successful episodes; nan, as the time, without any."""
    energy_J: float
    minutes: float
    """Duration of a training, mean over the seeds; nan for references."""
    steps: int
    """Of a training; 0 for references."""


def rows(runs: list[Run]) -> list[Row]:
    """Return the table of finished runs."""
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
                default_algorithm(task) == policy,
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
    error = number(row.final_distance_mm, "{:.2f} mm")
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
    """Write the tables and the figure of finished runs."""
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
    """Return the page with the tables, the figure and how they were measured."""
    seeds = list(dict.fromkeys(one.seed for one in runs))
    parts = [
        "# Trained policies",
        f"Made by `python train.py --benchmark`, {jobs} at a time on {os.cpu_count()} cores. Every algorithm was trained with "
        f"seeds {', '.join(map(str, seeds))} and evaluated on {runs[0].episodes} held-out goals for each seed. The scripted "
        "controller and a random policy were evaluated on the same goals. Bold: the task's default algorithm.",
    ]
    for task in dict.fromkeys(row.task for row in table):
        parts += [f"## {registry.entry(task).title}", markdown_table(HEADER, [cells(row) for row in table if row.task == task])]
    parts += [
        "## Learning curves",
        "![Success against steps and time of training](curves.png)",
        f"*Success on {training.CURVE_EPISODES} goals of the training split, mean and range over the seeds.*",
        "## How it is measured",
        "An episode succeeds if its last step does: goals have to be held. Time to success is the time from which on the goal "
        'is held, mean over successful episodes. "Over the fastest" is the sum of these times divided by the sum of the least '
        "possible times, see `agents/fastest.py`. The least time of PickAndPlace leaves out stage and release, so no policy "
        "comes near 1. The final error is the distance from the goal at the end of the episode, mean over all episodes; in "
        "TwistAlign the yaw error, too. Training is the duration of a whole training with the points of its learning curve. "
        "The policy kept is the one that came nearest to the goals of its curve.",
        "`runs.csv` lists the runs, `curves.csv` the points of the curves.",
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
        panels[0, column].set(title=registry.entry(task).title, xlabel="environment steps [thousands]")
        panels[1, column].set(xlabel="time of training [min]")
        panels[0, column].legend(frameon=False, fontsize=8)
    for axes in panels[:, 0]:
        axes.set(ylabel="success rate [%]")
    save_figure(figure, out / "curves.png")


def spread(points: list[dict[str, str]], quantity: str) -> tuple[Array, Array, Array, Array]:
    """Return values of `quantity` that all seeds have reached, and the least, mean and largest success rate there."""
    seeds = dict.fromkeys(point["seed"] for point in points)
    pairs = [(point["seed"], float(point[quantity]), float(point["success_rate"])) for point in points]
    curves = [np.array([pair[1:] for pair in pairs if pair[0] == seed]).T for seed in seeds]
    first, last = max(found[0, 0] for found in curves), min(found[0, -1] for found in curves)
    at = np.unique(np.clip(np.concatenate([found[0] for found in curves]), first, max(first, last)))
    success = np.array([np.interp(at, *found) for found in curves])
    return at, success.min(axis=0), success.mean(axis=0), success.max(axis=0)
