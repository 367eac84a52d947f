"""What stepping environments costs: steps per second against their number, memory, and the time until the first step."""

import gc
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium
import numba
import numpy as np
from numpy.typing import NDArray

from tca_envs.study import output
from tca_envs.study.scenes import IDS
from tca_envs.study.timing import no_collection

LANES = (1, 4, 16, 64, 256, 1024)
"""Environments in a batch."""
MOST = {"sync": 16, "async": 4}
"""In Gymnasium's vectors: beyond, more environments change nothing, and more processes only take memory."""
THREADS = (1, 2)
WINDOWS = 15
"""Episodes of a batch that are timed; the median counts ..."""
PATIENCE_S = 5.0
"""... but none is begun after so much time on a batch [s]."""
DIFFERENT = 64
"""Batches of random actions that take turns, so that drawing them costs nothing."""
FEW, MANY = 256, 1024
"""Batches whose memory is compared."""


class Rate(NamedTuple):
    """How fast a batch is stepped."""

    task: str
    kind: str
    """"native", "sync", "async", or "single": one environment, `gymnasium.make` with its wrappers."""
    threads: int
    """Of each process."""
    lanes: int
    seconds: tuple[float, ...]
    """Of each window: an episode of all lanes, reset included [s]."""
    steps: int
    """Environment steps of a window."""

    @property
    def rate(self) -> float:
        """Median environment steps per second."""
        return self.steps / float(np.median(self.seconds))


class Start(NamedTuple):
    """How long a fresh process takes [s]."""

    task: str
    imported: float
    """To import the package."""
    cold: float
    """To make the first step, import included, on a machine that never ran it."""
    warm: float
    """... and on one that has."""


class Effort(NamedTuple):
    """How much is measured."""

    lanes: tuple[int, ...]
    windows: int
    patience: float
    """[s]."""
    episode: int | None
    """Steps of an episode; None: as registered."""


FULL = Effort(LANES, WINDOWS, PATIENCE_S, None)
QUICK = Effort((1, 4, 64), 1, 0.0, 30)


def batches(name: str, lanes: int, episode: int) -> dict[tuple[str, int], Callable[[], Any]]:
    """Return by kind and threads how to make the environments of so many lanes."""
    make = partial(gymnasium.make_vec, name, num_envs=lanes, max_episode_steps=episode)
    usable: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # there, but only when it runs
    made: dict[tuple[str, int], Callable[[], Any]] = {
        ("native", threads): partial(make, threads=threads) for threads in THREADS if threads <= usable
    }
    if lanes <= MOST["sync"]:
        made["sync", 1] = partial(make, vectorization_mode="sync")
    if lanes <= MOST["async"]:
        # A process that has run threads of OpenMP must not be forked.
        made["async", 1] = partial(make, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    if lanes == 1:
        made["single", 1] = partial(gymnasium.make, name, max_episode_steps=episode)
    return made


def episode_time(env: Any, actions: NDArray[np.float32], episode: int) -> float:
    """Return the time [s] of a reset and an episode of all lanes."""
    begun = time.perf_counter()
    env.reset()
    for k in range(episode):
        env.step(actions[k % len(actions)])
    return time.perf_counter() - begun


def random_actions(env: Any) -> NDArray[np.float32]:
    """Return `DIFFERENT` actions of an environment, or of all in a batch."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (DIFFERENT, *env.action_space.shape)).astype(np.float32)


def rates(task: str, effort: Effort, done: Callable[[], object] = lambda: None) -> list[Rate]:
    """Return how fast a task's environments are stepped; batches of one size take turns.

    Parameters
    ----------
    task : str
        A key of `scenes.IDS`.
    effort : Effort
        How long to go on.
    done : callable
        Called after each size.
    """
    name = IDS[task]
    episode = effort.episode or gymnasium.spec(name).max_episode_steps or 1
    found: list[Rate] = []
    for lanes in effort.lanes:
        envs = {key: make() for key, make in batches(name, lanes, episode).items()}
        actions = {key: random_actions(env) for key, env in envs.items()}
        seconds: dict[tuple[str, int], list[float]] = {key: [] for key in envs}
        for key, env in envs.items():
            env.reset(seed=0)
            env.step(actions[key][0])
        with no_collection():
            for _ in range(effort.windows):
                for key, env in envs.items():
                    if not seconds[key] or sum(seconds[key]) < effort.patience:
                        seconds[key].append(episode_time(env, actions[key], episode))
        for env in envs.values():
            env.close()
        found += [Rate(task, *key, lanes, tuple(taken), episode * lanes) for key, taken in seconds.items()]
        done()
    return found


def memory(task: str, few: int = FEW, many: int = MANY) -> float:
    """Return the memory [byte] that each environment of a native batch takes at its peak, over resets and steps.

    That is the slope between two batches, of what Python and NumPy allocate.
    """
    peaks = []
    for lanes in (few, few, many):  # what only the first one allocates does not count
        gc.collect()
        tracemalloc.start()
        env = gymnasium.make_vec(IDS[task], num_envs=lanes, max_episode_steps=2)
        env.reset(seed=0)
        for _ in range(4):
            env.step(np.ones(env.action_space.shape, dtype=np.float32))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        env.close()
    return (peaks[2] - peaks[1]) / (many - few)


FIRST_STEP = """
import sys, time
begun = time.perf_counter()
import tca_envs
imported = time.perf_counter() - begun
import gymnasium
env = gymnasium.make(sys.argv[1])
env.reset(seed=0)
env.step(env.action_space.sample())
print(imported, time.perf_counter() - begun)
"""


def first_step(name: str, cache: Path) -> tuple[float, float]:
    """Return the time [s] of a fresh process to import the package, and to have made a step, with compiled code in `cache`."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", FIRST_STEP, name]
    said = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    imported, stepped = (float(word) for word in said.split())
    return imported, stepped


def start(task: str) -> Start:
    """Return how long a fresh process takes until a task's first step."""
    with TemporaryDirectory() as folder:
        _, cold = first_step(IDS[task], Path(folder))
        imported, warm = first_step(IDS[task], Path(folder))
    return Start(task, imported, cold, warm)


def write(found: Sequence[Rate], path: Path) -> None:
    """Write the rates as CSV."""
    header = [
        "task", "kind", "threads", "environments", "median_steps_per_s", "slowest_steps_per_s", "fastest_steps_per_s",
        "episodes",
    ]  # fmt: skip
    rows = [
        (r.task, r.kind, r.threads, r.lanes, r.rate, r.steps / max(r.seconds), r.steps / min(r.seconds), len(r.seconds))
        for r in found
    ]
    output.write_csv(path, header, rows)


def label(rate: Rate) -> str:
    """Return what a column or line is called."""
    if rate.kind == "native":
        return f"native, {rate.threads} thread{'s' if rate.threads > 1 else ''}"
    return {"sync": "Gymnasium sync", "async": "Gymnasium async", "single": "one, gym.make"}[rate.kind]


def report(found: Sequence[Rate], bytes_each: dict[str, float], starts: Sequence[Start]) -> str:
    """Return throughput.md."""
    columns = list(dict.fromkeys(label(r) for r in found if r.kind != "single"))
    rows = []
    for task in dict.fromkeys(r.task for r in found):
        for lanes in dict.fromkeys(r.lanes for r in found if r.task == task):
            here = {label(r): f"{r.rate:,.0f}" for r in found if (r.task, r.lanes) == (task, lanes)}
            rows.append([task, f"{lanes}", *(here.get(column, "") for column in columns)])
    single = {r.task: r.rate for r in found if r.kind == "single"}
    each = [
        [s.task, f"{single[s.task]:,.0f}", f"{1e-3 * bytes_each[s.task]:.1f}", *(f"{t:.2f}" for t in s[1:])] for s in starts
    ]
    header = [
        "Task",
        "One, gym.make [steps/s]",
        "Memory each [kB]",
        "Import [s]",
        "First step, cold [s]",
        "First step, cached [s]",
    ]
    return "\n\n".join(
        [
            "# What stepping environments costs",
            "Environment steps per second under random actions, resets included: medians over whole episodes of all "
            "environments, in turns. Native is `gymnasium.make_vec(id, num_envs=N)`; the others are N environments of "
            '`gymnasium.make` in its own vectors, the processes of the asynchronous one started by "spawn".',
            "![Environment steps per second against the number of environments](throughput.png)",
            output.markdown_table(["Task", "N", *columns], rows),
            "One environment with the wrappers that `gymnasium.make` puts around it; the memory that each environment of a "
            f"native batch adds at its peak, resets included (from {FEW} to {MANY} of them, what Python and NumPy allocate); "
            "and how long a fresh process takes to import the package and to have made its first step, without and with "
            "compiled code in Numba's cache.",
            output.markdown_table(header, each),
            "",
        ]
    )


def draw(found: Sequence[Rate], path: Path) -> None:
    """Draw steps per second against the number of environments, a panel for each task."""
    from matplotlib.ticker import EngFormatter, FixedLocator, NullLocator

    tasks = list(dict.fromkeys(r.task for r in found))
    figure, panels = output.new_figure(len(tasks), 3.7 * len(tasks), 3.9, sharey=True)
    for axes, task in zip(panels, tasks, strict=True):
        of_task = [r for r in found if r.task == task]
        for name in dict.fromkeys(label(r) for r in of_task):
            line = [r for r in of_task if label(r) == name]
            axes.plot([r.lanes for r in line], [r.rate for r in line], label=name, **STYLES[line[0].kind, line[0].threads > 1])
        lanes = sorted({r.lanes for r in of_task})
        axes.set(xscale="log", yscale="log", xlabel="environments", title=task)
        axes.xaxis.set_major_locator(FixedLocator(lanes))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:.0f}")
        axes.yaxis.set_major_formatter(EngFormatter(sep=" "))
    panels[0].set_ylabel("environment steps/s")
    panels[0].legend(frameon=False, fontsize=9)
    output.save_figure(figure, path)


STYLES: dict[tuple[str, bool], dict[str, Any]] = {
    ("native", True): {"color": "black", "marker": "o", "linewidth": 2.0},
    ("native", False): {"color": "black", "marker": "o", "linewidth": 1.2, "linestyle": "--", "markerfacecolor": "white"},
    ("sync", False): {"color": "#0072B2", "marker": "s", "linewidth": 1.2},
    ("async", False): {"color": "#D55E00", "marker": "^", "linewidth": 1.2},
    ("single", False): {"color": "#009E73", "marker": "D", "linestyle": ""},
}
"""By kind and whether there are threads; told apart by the colour-blind, too (Okabe & Ito)."""


def run(out: Path, quick: bool = False, say: Callable[[str], object] = print) -> None:
    """Write throughput.png, .csv and .md into the folder `out`."""
    from tqdm import tqdm

    effort = QUICK if quick else FULL
    found: list[Rate] = []
    with tqdm(total=len(IDS) * len(effort.lanes), unit="size") as bar:
        for task in IDS:
            found += rates(task, effort, bar.update)
    bytes_each = {task: memory(task) for task in IDS}
    starts = [start(task) for task in (list(IDS)[:1] if quick else IDS)]
    write(found, out / "throughput.csv")
    page = report(found, bytes_each, starts)
    (out / "throughput.md").write_text(page, encoding="utf-8")
    draw(found, out / "throughput.png")
    say(page)
    say(f"wrote throughput (.png, .csv, .md) in {out}")
