"""What a solve costs by the size of the arm and of the batch: modules in series, muscles in a module, lanes at once."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import TCA, Arm, Grid, Muscle
from tca_envs.mechanics.collocation import solve_lanes
from tca_envs.mechanics.kernels import FAILED, REPORT
from tca_envs.study import output
from tca_envs.study.timing import no_collection

Array = NDArray[np.float64]

WARM = 60.0
"""Temperature of all TCAs but the first of each module at the known state [degC] ..."""
HOTTER = 10.0
"""... and by how much that one is hotter, so that the arm is bent [K]."""
CHANGE = 1.0
"""From the known state to the one asked for [K]."""
GRID = Grid(1, 7)
"""Of each module, as of `presets.bending_arm`."""
TOLERANCE = 1e-6


class Sweep(NamedTuple):
    """What is varied, and the time of a call that solves everything."""

    name: str
    """Axis, and first column of the CSV file."""
    title: str
    sizes: Callable[[int], tuple[int, int, int]]
    """Value -> modules, muscles of a module, lanes."""
    values: tuple[int, ...]
    seconds: tuple[float, ...] = ()
    """Median time of a call at each."""
    iterations: tuple[float, ...] = ()
    """Of Newton, mean over the lanes."""

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
FULL_S, QUICK_S = 10.0, 2.0
"""Time for a sweep [s]."""


def chain(modules: int, muscles: int) -> Arm:
    """Return so many bending modules in series, hanging, with so many TCAs each around the section."""
    angles = 2.0 * np.pi * np.arange(muscles) / muscles
    around = [Muscle(presets.BENDING_OFFSET, angle, 0.0, TCA()) for angle in angles.tolist()]
    module = replace(presets.bending_module(), muscles=around)
    return Arm([module] * modules, presets.GRAVITY, None, [GRID] * modules, TOLERANCE)


class Call:
    """A call of the solver that takes arms from a known state to one `CHANGE` hotter.

    Parameters
    ----------
    modules, muscles, lanes : int
        Sizes.

    Raises
    ------
    RuntimeError
        Where there is no equilibrium.
    """

    def __init__(self, modules: int, muscles: int, lanes: int) -> None:
        self.arm = chain(modules, muscles)
        n = modules * muscles
        drive = np.full(n, WARM)
        drive[::muscles] += HOTTER
        self.load = np.repeat(self.arm.load()[np.newaxis], lanes, axis=0)
        self.tip, self.lengths = np.repeat(np.eye(4)[np.newaxis], lanes, axis=0), np.empty((lanes, n))
        self.report = np.empty((lanes, REPORT))
        self.state = [np.repeat(values[np.newaxis], lanes, axis=0) for values in self.arm.unloaded()]
        self._solve(np.repeat(drive[np.newaxis], lanes, axis=0))
        self.known = [values.copy() for values in self.state]
        self.asked = np.repeat(drive[np.newaxis] + CHANGE, lanes, axis=0)

    def _solve(self, drive: Array) -> float:
        strain, tension, from_drive, from_load = self.state
        begun = time.perf_counter()
        solve_lanes(
            self.arm.model, strain, tension, from_drive, from_load, drive, self.load, self.tip, self.lengths, self.report
        )
        taken = time.perf_counter() - begun
        if (self.report[:, 0] == FAILED).any():
            raise RuntimeError(f"no equilibrium of {len(self.arm.modules)} modules at {drive[0].tolist()} degC")
        return taken

    def __call__(self) -> float:
        """Return the time of the call [s]."""
        for values, known in zip(self.state, self.known, strict=True):
            values[:] = known
        return self._solve(self.asked)


def measure(sweep: Sweep, effort: float) -> Sweep:
    """Return a sweep with its times; calls take turns over the sizes, for about `effort` seconds in all."""
    calls = [Call(*sweep.sizes(value)) for value in sweep.values]
    taken: list[list[float]] = [[] for _ in calls]
    left = [effort / len(calls)] * len(calls)
    with no_collection():
        while any(budget > 0.0 for budget in left):
            for i, call in enumerate(calls):
                if left[i] > 0.0:
                    taken[i].append(call())
                    left[i] -= taken[i][-1]
    iterations = tuple(float(call.report[:, 2].mean()) for call in calls)
    return sweep._replace(seconds=tuple(float(np.median(times)) for times in taken), iterations=iterations)


def draw(sweeps: Sequence[Sweep], path: Path) -> None:
    """Draw a panel for each sweep into a PNG file."""
    from matplotlib.ticker import EngFormatter, FixedLocator, LogLocator, NullLocator

    figure, panels = output.new_figure(len(sweeps), 11.0, 3.8)
    for axes, sweep in zip(panels, sweeps, strict=True):
        exponent, at_one = sweep.fit
        fitted = np.array(sweep.values[sweep.half :], dtype=float)
        words = f"time ∝ {sweep.name}$^{{{exponent:.2f}}}$"
        axes.plot(fitted, at_one * fitted**exponent, color="#D55E00", linewidth=5.0, alpha=0.4, label=words)
        axes.plot(sweep.values, sweep.seconds, color="black", marker="o", linewidth=1.4, markersize=5.5, label="median")
        low, high = min(sweep.seconds), max(sweep.seconds)
        spare = max(1.25, np.sqrt(12.0 * low / high))  # so that a decade is seen
        axes.set(xscale="log", yscale="log", xlabel=sweep.name, title=sweep.title, ylim=(low / spare, high * spare))
        axes.title.set_fontsize(11)
        axes.xaxis.set_major_locator(FixedLocator(sweep.values))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:.0f}")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 100.0 else (1,)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(EngFormatter(unit="s", sep=" "))
        axes.legend(loc="upper left", frameon=False)
    panels[0].set_ylabel("time of a warm call, median")
    output.save_figure(figure, path)


def write(sweeps: Sequence[Sweep], path: Path) -> None:
    """Write all times as CSV."""
    header = ["varied", "modules", "muscles_of_a_module", "lanes", "median_time_s", "median_time_of_a_lane_s", "iterations"]
    rows = [
        (sweep.name, *sweep.sizes(value), taken, taken / sweep.sizes(value)[2], iterations)
        for sweep in sweeps
        for value, taken, iterations in zip(sweep.values, sweep.seconds, sweep.iterations, strict=True)
    ]
    output.write_csv(path, header, rows)


def run(out: Path, quick: bool = False, say: Callable[[str], object] = print) -> None:
    """Write size.png and size.csv into the folder `out`."""
    from tqdm import tqdm

    asked = tqdm((MODULES, MUSCLES, LANES), unit="sweep")
    sweeps = [measure(sweep, QUICK_S if quick else FULL_S) for sweep in asked]
    draw(sweeps, out / "size.png")
    write(sweeps, out / "size.csv")
    for sweep in sweeps:
        say(f"{sweep.title}: time ~ {sweep.name}^{sweep.fit[0]:.2f}")
    say(f"wrote size (.png, .csv) in {out}")
