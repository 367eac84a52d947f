"""What a solve costs by the size of the arm and of the batch: modules in series, muscles in a module, lanes at once."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from study import pattern
from study.method import warm_call
from study.pattern import COLOURS, Column, Study
from tca_envs.mechanics import TCA, Arm, Grid, Muscle, Rung
from tca_envs.robots import paper

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WARM = 60.0  # temperature of all TCAs but the first of each module at the known state [degC] ...
HOTTER = 10.0  # ... and by how much that one is hotter, so that the arm is bent [K].
CHANGE = 1.0  # from the known state to the one asked for [K]
GRID = Grid(1, 7)  # of each module, as of `paper.bending_arm`
TOLERANCE = 1e-6


class Sweep(NamedTuple):
    """What is varied, and the time of a call that solves everything."""

    name: str  # axis, and first column of the CSV file
    title: str
    sizes: Callable[[int], tuple[int, int, int]]  # value -> modules, muscles of a module, lanes
    values: tuple[int, ...]
    seconds: tuple[float, ...] = ()  # median time of a call at each
    iterations: tuple[float, ...] = ()  # of Newton, mean over the lanes

    @property
    def half(self) -> int:
        """Where the larger half of the values begins: with small ones, what does not grow hides what does."""
        return len(self.values) // 2

    @property
    def fit(self) -> tuple[float, float]:
        """Exponent, and time at a value of one [s], of the power law through the larger half."""
        slope, at_one = np.polyfit(np.log(self.values[self.half :]), np.log(self.seconds[self.half :]), 1)
        return float(slope), float(np.exp(at_one))


MODULES = Sweep("modules", "modules in series, 3 muscles each", lambda value: (value, 3, 1), (1, 2, 3, 4, 6, 8))
MUSCLES = Sweep("muscles", "muscles in one module", lambda value: (1, value, 1), (1, 2, 3, 4, 6, 8, 12, 16, 24))
LANES = Sweep("lanes", "lanes of one module in a call", lambda value: (1, 3, value), (1, 4, 16, 64, 256, 1024, 4096))
FULL_S, QUICK_S = 10.0, 2.0  # time for a sweep [s]


def chain(modules: int, muscles: int) -> Arm:
    """Return so many bending modules in series, hanging, with so many TCAs each around the section."""
    angles = 2.0 * np.pi * np.arange(muscles) / muscles
    around = [Muscle(paper.BENDING_OFFSET, angle, 0.0, TCA()) for angle in angles.tolist()]
    module = replace(paper.bending_module(), muscles=around)
    return Arm([module] * modules, paper.GRAVITY, None, [GRID] * modules, TOLERANCE)


def called(modules: int, muscles: int, lanes: int) -> Callable[[], tuple[float, Any]]:
    """Return a call of the solver that takes so many arms from a known state to one `CHANGE` hotter."""
    arm, drive = chain(modules, muscles), np.full(modules * muscles, WARM)
    drive[::muscles] += HOTTER
    return warm_call(arm, arm.restart(arm.equilibrium(drive)), drive + CHANGE, arm.load(), lanes)


def measure(sweep: Sweep, effort: float) -> Sweep:
    """Return a sweep with its times; calls take turns over the sizes, for about `effort` seconds in all."""
    calls = [called(*sweep.sizes(value)) for value in sweep.values]
    taken: list[list[float]] = [[] for _ in calls]
    iterations = [0.0] * len(calls)
    with pattern.no_collection():
        while any(sum(times) < effort / len(calls) for times in taken):
            for k, times in enumerate(taken):
                if sum(times) < effort / len(calls):
                    seconds, report = calls[k]()
                    if (report["rung"] == Rung.FAILED).any():
                        raise RuntimeError(f"no equilibrium of {sweep.values[k]} {sweep.name}")
                    times.append(seconds)
                    iterations[k] = float(report["iterations"].mean())
    return sweep._replace(seconds=tuple(float(np.median(times)) for times in taken), iterations=tuple(iterations))


def draw(sweeps: Sequence[Sweep]) -> "Iterator[tuple[str, Figure]]":
    """Draw a panel for each sweep."""
    from matplotlib.ticker import LogLocator, NullLocator

    figure, panels = pattern.new_figure(len(sweeps), 11.0, 3.8)
    for axes, sweep in zip(panels, sweeps, strict=True):
        exponent, at_one = sweep.fit
        fitted = np.array(sweep.values[sweep.half :], dtype=float)
        words = f"time ∝ {sweep.name}$^{{{exponent:.2f}}}$"
        axes.plot(fitted, at_one * fitted**exponent, color=COLOURS[1], linewidth=5.0, alpha=0.4, label=words)
        axes.plot(sweep.values, sweep.seconds, color="black", marker="o", linewidth=1.4, markersize=5.5, label="median")
        low, high = min(sweep.seconds), max(sweep.seconds)
        spare = max(1.25, np.sqrt(12.0 * low / high))  # so that a decade is seen
        axes.set(xscale="log", yscale="log", xlabel=sweep.name, ylim=(low / spare, high * spare))
        axes.set_title(sweep.title, fontsize=11)
        pattern.at_values(axes, sweep.values)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 100.0 else (1,)))
        axes.yaxis.set_minor_locator(NullLocator())
        pattern.with_units(axes, y="s")
        axes.legend(loc="upper left", frameon=False)
    panels[0].set_ylabel("time of a warm call, median")
    yield "size.png", figure


class Row(NamedTuple):
    """A value of a sweep."""

    sweep: str
    modules: int
    muscles: int
    lanes: int
    time: float
    iterations: float


def rows(sweeps: Sequence[Sweep]) -> list[Row]:
    """Return all values of all sweeps."""
    return [
        Row(sweep.name, *sweep.sizes(value), *measured)
        for sweep in sweeps
        for value, *measured in zip(sweep.values, sweep.seconds, sweep.iterations, strict=True)
    ]


COLUMNS = (
    Column("sweep", "varied"), Column("modules", "modules"), Column("muscles", "muscles_of_a_module"), Column("lanes", "lanes"),
    Column("time", "median_time_s"), Column(lambda row: row.time / row.lanes, "median_time_of_a_lane_s"),
    Column("iterations", "iterations"),
)  # fmt: skip
STUDY = Study(
    "size",
    "chart the time of a solve against modules, muscles and lanes",
    lambda quick: [measure(s, QUICK_S if quick else FULL_S) for s in pattern.progress((MODULES, MUSCLES, LANES), unit="sweep")],
    tables={"size.csv": (COLUMNS, rows)},
    figures=draw,
    findings=lambda sweeps: "\n".join(f"{sweep.title}: time ~ {sweep.name}^{sweep.fit[0]:.2f}" for sweep in sweeps),
)
