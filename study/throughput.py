"""What stepping environments costs: steps per second against their number, memory, and the time until the first step."""

import gc
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numba
import numpy as np
from numpy.typing import NDArray

from study import pattern
from study.pattern import COLOURS, Column, Study
from tca_envs import registry

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = {"sync": 16, "async": 4}
"""In Gymnasium's vectors: beyond, more environments change nothing, and more processes only take memory."""
THREADS = (1, 2)
DIFFERENT = 64  # batches of random actions that take turns, so that drawing them costs nothing
FEW, MANY = 256, 1024  # batches whose memory is compared


class Rate(NamedTuple):
    """How fast a batch is stepped."""

    task: str
    kind: str  # "native", "sync", "async", or "single": one environment, `gymnasium.make` with its wrappers
    threads: int  # of each process
    lanes: int
    seconds: tuple[float, ...]  # of each window: an episode of all lanes, reset included [s]
    steps: int  # environment steps of a window

    @property
    def rate(self) -> float:
        """Median environment steps per second."""
        return self.steps / float(np.median(self.seconds))

    @property
    def label(self) -> str:
        """What a column or line is called."""
        native = f"native, {self.threads} thread{'s' if self.threads > 1 else ''}"
        return {"native": native, "sync": "Gymnasium sync", "async": "Gymnasium async", "single": "one, gym.make"}[self.kind]


class Start(NamedTuple):
    """How long a fresh process takes [s]."""

    task: str
    imported: float  # to import the package
    cold: float  # to make the first step, import included, on a machine that never ran it
    warm: float  # ... and on one that has


class Effort(NamedTuple):
    """How much is measured."""

    lanes: tuple[int, ...]  # environments in a batch
    windows: int  # episodes of a batch that are timed; the median counts ...
    patience: float  # ... but none is begun after so much time on a batch [s]
    episode: int | None  # steps of an episode; None: as registered


FULL = Effort((1, 4, 16, 64, 256, 1024), 15, 5.0, None)
QUICK = Effort((1, 4, 64), 1, 0.0, 30)


class Found(NamedTuple):
    """All that is measured."""

    rates: list[Rate]
    memory: dict[str, float]
    starts: list[Start]


def batches(name: str, lanes: int, episode: int) -> dict[tuple[str, int], Callable[[], Any]]:
    """Return by kind and threads how to make the environments of so many lanes."""
    make = partial(gymnasium.make_vec, name, num_envs=lanes, max_episode_steps=episode)
    usable: int = numba.config.NUMBA_NUM_THREADS
    made: dict[tuple[str, int], Callable[[], Any]] = {("native", k): partial(make, threads=k) for k in THREADS if k <= usable}
    if lanes <= MOST["sync"]:
        made["sync", 1] = partial(make, vectorization_mode="sync")
    if lanes <= MOST["async"]:
        # A process that has run threads of OpenMP must not be forked.
        made["async", 1] = partial(make, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    if lanes == 1:
        made["single", 1] = partial(gymnasium.make, name, max_episode_steps=episode)
    return made


def id_of(task: str) -> str:
    """Return the id of a task's environments."""
    return registry.entry(task).ids["sparse"]


def play(env: Any, actions: NDArray[np.float32], episode: int) -> None:
    """Reset, and step through an episode of all lanes."""
    env.reset()
    for k in range(episode):
        env.step(actions[k % len(actions)])


def rates(task: str, lanes: int, effort: Effort) -> list[Rate]:
    """Return how fast so many environments of a task are stepped; batches of one size take turns."""
    name = id_of(task)
    episode = effort.episode or gymnasium.spec(name).max_episode_steps or 1
    envs = {key: make() for key, make in batches(name, lanes, episode).items()}
    shapes = {key: (DIFFERENT, *env.action_space.shape) for key, env in envs.items()}
    actions = {key: np.random.default_rng(0).uniform(-1.0, 1.0, s).astype(np.float32) for key, s in shapes.items()}
    taken: dict[tuple[str, int], list[float]] = {key: [] for key in envs}
    for key, env in envs.items():
        env.reset(seed=0)
        env.step(actions[key][0])
    with pattern.no_collection():
        for _ in range(effort.windows):
            for key, env in envs.items():
                if not taken[key] or sum(taken[key]) < effort.patience:
                    taken[key].append(pattern.seconds(partial(play, env, actions[key], episode)))
    for env in envs.values():
        env.close()
    return [Rate(task, *key, lanes, tuple(times), episode * lanes) for key, times in taken.items()]


def memory(task: str, few: int = FEW, many: int = MANY) -> float:
    """Return the memory [byte] that each environment of a native batch takes at its peak, over resets and steps.

    That is the slope between two batches, of what Python and NumPy allocate.
    """
    peaks = []
    for lanes in (many, few, many):  # what only the first one allocates, such as compiled code, does not count
        gc.collect()
        tracemalloc.start()
        env = gymnasium.make_vec(id_of(task), num_envs=lanes, max_episode_steps=2)
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
        _, cold = first_step(id_of(task), Path(folder))
        imported, warm = first_step(id_of(task), Path(folder))
    return Start(task, imported, cold, warm)


def measure(quick: bool) -> Found:
    """Measure all tasks."""
    effort, tasks = QUICK if quick else FULL, [entry.name for entry in registry.entries()]
    sizes = pattern.progress([(task, lanes) for task in tasks for lanes in effort.lanes], unit="size")
    found = [rate for task, lanes in sizes for rate in rates(task, lanes, effort)]
    return Found(found, {task: memory(task) for task in tasks}, [start(task) for task in (tasks[:1] if quick else tasks)])


def report(found: Found) -> str:
    """Return the page."""
    measured, each, starts = found
    single = {r.task: r.rate for r in measured if r.kind == "single"}
    kinds = pattern.names((r for r in measured if r.kind != "single"), "label")
    rows = [(task, n) for task in pattern.names(measured, "task") for n in pattern.names(measured, "lanes")]
    by_size = {(r.task, r.lanes, r.label): f"{r.rate:,.0f}" for r in measured}
    cells = [[task, f"{n}", *(by_size.get((task, n, kind), "") for kind in kinds)] for task, n in rows]
    columns = [
        Column("task", "", "Task"), Column(lambda s: single[s.task], "", "One, gym.make [steps/s]", pattern.fixed(",.0f")),
        Column(lambda s: each[s.task], "", "Memory each [kB]", pattern.fixed(".1f", 1e-3)),
        *(Column(name, "", heading, pattern.fixed(".2f")) for name, heading in (
            ("imported", "Import [s]"), ("cold", "First step, cold [s]"), ("warm", "First step, cached [s]"))),
    ]  # fmt: skip
    return pattern.page(
        "# What stepping environments costs",
        "Environment steps per second under random actions, resets included: medians over whole episodes of all "
        "environments, in turns. Native is `gymnasium.make_vec(id, num_envs=N)`; the others are N environments of "
        '`gymnasium.make` in its own vectors, the processes of the asynchronous one started by "spawn".',
        "![Environment steps per second against the number of environments](throughput.png)",
        pattern.markdown_table(["Task", "N", *kinds], cells),
        "One environment with the wrappers that `gymnasium.make` puts around it; the memory that each environment of a "
        f"native batch adds at its peak, resets included (from {FEW} to {MANY} of them, what Python and NumPy allocate); "
        "and how long a fresh process takes to import the package and to have made its first step, without and with "
        "compiled code in Numba's cache.",
        pattern.table(columns, starts),
    )


def draw(found: Found) -> "Iterator[tuple[str, Figure]]":
    """Draw steps per second against the number of environments, a panel for each task."""
    tasks = pattern.names(found.rates, "task")
    figure, panels = pattern.new_figure(len(tasks), 3.7 * len(tasks), 3.9, sharey=True)
    for axes, task in zip(panels, tasks, strict=True):
        of_task = [r for r in found.rates if r.task == task]
        for name in pattern.names(of_task, "label"):
            line = [r for r in of_task if r.label == name]
            axes.plot([r.lanes for r in line], [r.rate for r in line], label=name, **STYLES[line[0].kind, line[0].threads > 1])
        axes.set(xscale="log", yscale="log", xlabel="environments", title=task)
        pattern.at_values(axes, sorted({r.lanes for r in of_task}))
        pattern.with_units(axes, y=" ")
    panels[0].set_ylabel("environment steps/s")
    panels[0].legend(frameon=False, fontsize=9)
    yield "throughput.png", figure


STYLES: dict[tuple[str, bool], dict[str, Any]] = {
    ("native", True): {"color": "black", "marker": "o", "linewidth": 2.0},
    ("native", False): {"color": "black", "marker": "o", "linewidth": 1.2, "linestyle": "--", "markerfacecolor": "white"},
    ("sync", False): {"color": COLOURS[0], "marker": "s", "linewidth": 1.2},
    ("async", False): {"color": COLOURS[1], "marker": "^", "linewidth": 1.2},
    ("single", False): {"color": COLOURS[2], "marker": "D", "linestyle": ""},
}  # By kind and whether there are threads
COLUMNS = (
    Column("task", "task"), Column("kind", "kind"), Column("threads", "threads"), Column("lanes", "environments"),
    Column("rate", "median_steps_per_s"), Column(lambda r: r.steps / max(r.seconds), "slowest_steps_per_s"),
    Column(lambda r: r.steps / min(r.seconds), "fastest_steps_per_s"), Column(lambda r: len(r.seconds), "episodes"),
)  # fmt: skip
STUDY = Study(
    "throughput",
    "chart environment steps per second against the number of environments; tell memory and the time of a first step",
    measure,
    tables={"throughput.csv": (COLUMNS, lambda found: found.rates)},
    figures=draw,
    page=("throughput.md", report),
    findings=report,
)
