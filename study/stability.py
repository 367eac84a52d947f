"""Where methods fail: maps, a table and a chart of who finds the right branch of equilibria, and in what time.

Families of cells (`stability_cells`) go from easy to hopeless: cold starts under large tensions and tip forces, long rods, the
paper's thin arm with gravity from down to up, large steps of temperature. Every method solves every cell, once made ready and
all in one run; failures are timed, too. What the tasks meet under random policies is in `torture`.
"""

import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from math import isfinite, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from study import pattern, torture
from study.chart import styles
from study.method import Answer, Method, Plain, State
from study.methods import bvp, paper, wrench_shooting
from study.pattern import Column, Study, bullets, in_seconds, percent
from study.stability_cells import FAMILIES, Cell, Family, Referee, Truth, grids
from study.stability_judge import WORDS, Outcome, apart, outcome
from study.timing import Known, label, timed
from tca_envs.mechanics import Arm, Equilibrium, Rung

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FULL, QUICK = 8, 2  # cells a side of each map
GRID = "elements of 15 mm, 8 nodes"


def ours(arm: Arm, grid: str, states: Sequence[State]) -> Plain:
    """Return the project's solver."""
    return Plain(Arm(arm.modules, arm.gravity, arm.payload, grids(arm.modules), residual_tolerance=1e-6), tells=True)


OURS = Method("this package", "grid", (GRID,), ours)
COMPARED: tuple[tuple[Method, object], ...] = (
    (OURS, GRID),
    (wrench_shooting.METHOD, 32),
    *((method, 1e-3) for method in paper.METHODS),
    (bvp.METHOD, 1e-3),
)  # Methods, each at a setting in the middle of its range


class Result(NamedTuple):
    """What a method did on a cell."""

    family: str
    x: float
    y: float
    method: str
    outcome: Outcome
    seconds: float  # nan where the state before a step already had no answer
    off: float  # distance of the tip from that of the right answer, over the arm's length; nan where one is missing
    jumps: int  # jumps on the way to the right answer
    lost: str  # why there is none in reach; empty if there is one
    doubt: str  # why that is not to be trusted; empty where it is
    note: str  # of this package: which rung answered, or why there is no answer

    @property
    def counts(self) -> bool:
        """Whether the cell has a right answer that is to be trusted."""
        return not self.lost and not self.doubt

    @property
    def right(self) -> bool:
        """Whether the method found it."""
        return self.outcome is Outcome.RIGHT


# Measuring


def measure(family: Family, methods: Sequence[tuple[Method, object]], referee: Referee) -> list[Result]:
    """Return what methods, at their settings, do on the cells of a family."""
    results: list[Result] = []
    warmed: set[str] = set()
    for cell in pattern.progress(family.cells, family.name, "cell"):
        state, truth = cell.case.state, referee(cell.case)
        fine = Arm(state.arm.modules, state.arm.gravity, state.arm.payload, grids(state.arm.modules, 1.5))
        for method, setting in methods:
            solver = method.build(state.arm, setting, [state])
            if method.name not in warmed:
                solver.solve(state, solver.cold())  # compiles
                warmed.add(method.name)
            if cell.case.before is not None and truth.before is None:
                answer, seconds = Answer(False, np.eye(4), None), nan
            else:
                answer, seconds = timed(solver, cell.case, Known(truth.before, np.zeros(3), 0.0))
            what = outcome(state, answer, truth.found, fine)
            results.append(result(family, cell, truth, method.name, answer, what, seconds))
    return results


def result(family: Family, cell: Cell, truth: Truth, name: str, answer: Answer, what: Outcome, seconds: float) -> Result:
    """Return the row of a method and a cell."""
    known = answer.converged and truth.found is not None
    off = apart(cell.case.state.arm, answer.tip, truth.found.tip_pose) if known and truth.found is not None else nan
    note = ""
    if name == OURS.name and isinstance(answer.guess, Equilibrium):
        note = Rung(answer.guess.rung).name if answer.converged else answer.guess.message
    return Result(family.name, cell.x, cell.y, name, what, seconds, off, truth.jumps, truth.lost, truth.doubt, note)


# Findings


def failure_rate(results: Sequence[Result]) -> float:
    """Return the share of the cells with a right answer on which it was not found; nan if there are none."""
    judged = [r for r in results if r.counts]
    return sum(not r.right for r in judged) / len(judged) if judged else nan


def times(results: Sequence[Result]) -> tuple[float, float]:
    """Return median and longest time of a solve [s]; nan if there is none."""
    taken = [r.seconds for r in results if isfinite(r.seconds)]
    return (float(np.median(taken)), max(taken)) if taken else (nan, nan)


def findings(results: Sequence[Result]) -> str:
    """Return what the cells say, as Markdown."""
    mine = [r for r in results if r.method == OURS.name]
    judged = [r for r in mine if r.counts]
    jumped, doubtful = sum(r.jumps > 0 for r in judged), sum(r.doubt != "" for r in mine)
    names = pattern.names(results, "method")
    rates = [f"{name} {percent(failure_rate([r for r in results if r.method == name]))}" for name in names]
    return "\n\n".join(
        [
            f"{len(mine)} cells, {len(judged)} with a right answer; on {jumped} of them the arm falls to it from the end of a "
            f"branch. {len(mine) - len(judged) - doubtful} have no equilibrium in reach, {doubtful} are in doubt: they count "
            "for nobody.",
            f"Not solved: {', '.join(rates)}.",
            verdict(results),
            soundness(mine),
        ]
    )


def verdict(results: Sequence[Result]) -> str:
    """Return whether this package finds the right branch wherever another method does, as Markdown."""
    finders: dict[tuple[str, float, float], list[str]] = {}
    for r in results:
        if r.counts and r.right and r.method != OURS.name:
            finders.setdefault((r.family, r.x, r.y), []).append(r.method)
    cells = f"of {len(finders)} cells where another method finds the right branch"
    missed = [r for r in results if r.method == OURS.name and not r.right and (r.family, r.x, r.y) in finders]
    if not missed:
        return f"On every one {cells}, so does this package."
    lines = [f"{place(r)}: {WORDS[r.outcome]} ({r.note}); found by {', '.join(finders[r.family, r.x, r.y])}" for r in missed]
    return f"On {len(lines)} {cells}, this package does not:\n\n{bullets(lines)}"


def soundness(mine: Sequence[Result]) -> str:
    """Return whether all answers of this package are stable equilibria, as Markdown."""
    answers = [r for r in mine if r.outcome is not Outcome.NOTHING]
    bad = [f"{place(r)}: {WORDS[r.outcome]}" for r in answers if r.outcome in (Outcome.UNSTABLE, Outcome.WRONG)]
    if bad:
        return f"{len(bad)} of {len(answers)} answers of this package are no stable equilibria:\n\n{bullets(bad)}"
    asked = sum(isfinite(r.seconds) for r in mine)
    silent = f"on {asked - len(answers)} cells it says that it has none, and why"
    unasked = f"; {len(mine) - asked} steps have nothing to start from" if asked < len(mine) else ""
    return f"All {len(answers)} answers of this package are stable equilibria; {silent}{unasked}."


def place(r: Result) -> str:
    """Return where a cell is."""
    return f"{r.family} at {r.x:.4g}, {r.y:.4g}"


def table(results: Sequence[Result]) -> str:
    """Return the table of success on the families, and times, for each method."""
    families, methods = pattern.names(results, "family"), pattern.names(results, "method")

    def right(family: str | None) -> Column:
        chosen = lambda name: [r for r in results if r.method == name and family in (None, r.family)]  # noqa: E731
        return Column(lambda name: 1.0 - failure_rate(chosen(name)), "", family or "all", percent)

    def spent(k: int, heading: str, failures: bool) -> Column:
        counts = lambda r: not failures or (r.counts and not r.right)  # noqa: E731
        return Column(lambda name: times([r for r in results if r.method == name and counts(r)])[k], "", heading, in_seconds)

    silent = (Outcome.OTHER, Outcome.UNSTABLE, Outcome.WRONG)
    columns = [
        Column(str, "", "Method"), *map(right, [*families, None]),
        Column(lambda name: sum(r.method == name and r.counts and r.outcome in silent for r in results), "",
               "wrong branch or none"),
        spent(0, "median time", False), spent(1, "longest", False), spent(0, "failures: median", True),
        spent(1, "longest", True),
    ]  # fmt: skip
    return pattern.table(columns, methods)


def reasons(results: Sequence[Result]) -> str:
    """Return why this package has no answer where it has none, as Markdown."""
    silent = [r for r in results if r.method == OURS.name and r.outcome is Outcome.NOTHING]
    lines = [
        f"{place(r)}: {r.lost or 'there is an equilibrium'}; it says: {r.note or 'nothing, for the step has no start'}"
        for r in silent
    ]
    return bullets(lines) or "It has an answer on every cell."


HOW = """\
The right answer is the equilibrium that a slow change reaches: drive and load go on a straight line from those of the
start, the unloaded arm for a cold start, in steps that move the tip by at most 1 % of the length; where the branch of
equilibria ends, the arm falls. That takes this package's solver, in tiny steps; so a walk in steps twice as long on a
coarser grid must end at the same place, and multiple shooting to round-off (`study.reference`) must confirm the
equilibrium, or the cell is in doubt. Where the section of a rod collapses under a muscle, whose path shrinks to a point,
there is no equilibrium in reach.

An answer is an equilibrium if multiple shooting, started from its shape, ends within 2 % of the length, and a stable one
if the second variation of the energy is positive; it is right if that equilibrium is the right one, or if its tip is
within 1 % of it. A step starts from the method's own answer at the state before; where it has none, the step has none.
Times are medians of repeated solves on one machine, of a single solve where that takes more than 10 ms."""


class Found(NamedTuple):
    """What the methods do on the cells of the families, and the runs under policies that no controller is."""

    families: list[Family]
    results: list[Result]
    runs: list[torture.Run]


def report(found: Found) -> str:
    """Return the page."""
    results = found.results
    mine = [r for r in results if r.method == OURS.name]
    doubts = Counter(re.sub(r"[-+.\d]+(e-\d+)?( ?%)?", "x", r.doubt) for r in mine if r.doubt)
    maps = [f"{f.name}: {' '.join(f.title.split())}; {f.x_label}, {f.y_label}" for f in found.families]
    return pattern.page(
        "# Where methods fail",
        findings(results),
        "![Who finds the right branch where](stability_map.png)",
        "![Failure rate, time, and what the answers are](failure_rate.png)",
        "Cells on which the right branch is found; number of answers that are another branch or no equilibrium; time of a "
        "solve on all cells and on those that are not solved:",
        table(results),
        "## Where this package has no answer",
        reasons(results),
        "## Cells in doubt",
        bullets(f"{count} x {reason}" for reason, count in doubts.items()) or "None.",
        "## How it was made",
        HOW,
        bullets(maps),
        "Settings:",
        bullets(f"{method.name}: {method.knob} {label(setting)}" for method, setting in COMPARED),
        torture.report(found.runs),
    )


# Figures

COLOURS = {
    Outcome.RIGHT: "#9ad0f5",
    Outcome.OTHER: "#E69F00",
    Outcome.UNSTABLE: "#D55E00",
    Outcome.WRONG: "#882255",
    Outcome.NOTHING: "#444444",
}  # Told apart by the colour-blind, and in grey by their lightness


def draw(found: Found) -> "Iterator[tuple[str, Figure]]":
    """Draw the maps, and failure rates over times."""
    yield "stability_map.png", draw_maps(found.results, found.families)
    yield "failure_rate.png", draw_rates(found.results)


def draw_maps(results: Sequence[Result], families: Sequence[Family]) -> "Figure":
    """Draw a map for each family and method."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    names = pattern.names(results, "method")
    figure = Figure(figsize=(2.0 * len(names) + 1.4, 1.75 * len(families) + 1.0), layout="constrained")
    panels = figure.subplots(len(families), len(names), squeeze=False)
    for row, family in enumerate(families):
        for column, name in enumerate(names):
            axes = panels[row, column]
            draw_map(axes, family, [r for r in results if r.family == family.name and r.method == name], column == 0)
            if row == 0:
                axes.set_title(wrapped(name), fontsize=9.5, fontweight="bold" if name == OURS.name else None)
        panels[row, -1].annotate(
            family.title, (1.05, 0.5), xycoords="axes fraction", rotation=-90, va="center", ha="left", fontsize=8.5
        )
    entries: list[Line2D | Patch] = [Patch(facecolor=COLOURS[kind], label=WORDS[kind]) for kind in Outcome]
    marks = (("o", 3, "the arm falls on its way"), ("x", 5, "right answer in doubt"), ("_", 6, "no equilibrium in reach"))
    for marker, size, text in marks:
        entries.append(Line2D([], [], color="black", linestyle="none", marker=marker, markersize=size, label=text))
    figure.legend(handles=entries, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_map(axes: "Axes", family: Family, group: Sequence[Result], labelled: bool) -> None:
    """Draw what a method does on a family: a square for each cell, in the order of their values."""
    from matplotlib.colors import ListedColormap

    xs, ys = family.xs, family.ys
    shown = np.full((len(ys), len(xs)), np.nan)
    for r in group:
        i, j = ys.index(r.y), xs.index(r.x)
        if r.counts or (not r.doubt and r.outcome is not Outcome.NOTHING):
            shown[i, j] = r.outcome
        if r.doubt:
            axes.plot(j, i, "x", color="black", markersize=3.5, markeredgewidth=0.8)
        elif r.lost:
            axes.plot(j, i, "_", color="black", markersize=5)
        elif r.jumps:
            colour = "white" if r.outcome is Outcome.NOTHING else "black"
            axes.plot(j, i, "o", color=colour, markersize=2)
    scheme = ListedColormap([COLOURS[kind] for kind in Outcome])
    edges = [np.arange(len(values) + 1) - 0.5 for values in (xs, ys)]
    axes.pcolormesh(*edges, shown, cmap=scheme, vmin=-0.5, vmax=len(Outcome) - 0.5, edgecolors="white", linewidth=0.5)
    for axis, values in ((axes.xaxis, xs), (axes.yaxis, ys)):
        places = sorted({round(p) for p in np.linspace(0, len(values) - 1, min(4, len(values)))})
        axis.set_ticks(places, [f"{values[p]:.2g}" if values[p] < 10.0 else f"{values[p]:.0f}" for p in places])
    axes.tick_params(labelsize=7.5, length=2, pad=1.5)
    axes.set_xlabel(family.x_label, fontsize=8, labelpad=1)
    if labelled:
        axes.set_ylabel(family.y_label, fontsize=8, labelpad=1)
    else:
        axes.set_yticklabels([])


def wrapped(name: str) -> str:
    """Return a method's name in lines of a column's width."""
    return "\n".join(textwrap.wrap(name, 22))


def draw_rates(results: Sequence[Result]) -> "Figure":
    """Draw each method's failure rate over its time, and what its answers are."""
    from matplotlib.ticker import PercentFormatter

    names = pattern.names(results, "method")
    figure, (left, right) = pattern.new_figure(2, 10.0, 4.4, width_ratios=[1.15, 1.0])
    for name, style in styles(names, OURS.name).items():
        of_method = [r for r in results if r.method == name]
        (median, longest), rate = times(of_method), failure_rate(of_method)
        left.plot([rate, rate], [median, longest], color=style["color"], linewidth=1.0, alpha=0.6)
        left.plot([rate], [longest], color=style["color"], marker="_", markersize=9)
        left.plot([rate], [median], label=name, **{**style, "linestyle": "none", "markersize": 9})
    left.set(yscale="log", xlabel="cells not solved", ylabel="time of a solve, median to longest")
    pattern.with_units(left, y="s")
    left.margins(x=0.08)
    for row, name in enumerate(names):
        judged = [r.outcome for r in results if r.method == name and r.counts]
        begin = 0.0
        for kind in Outcome:
            share = judged.count(kind) / max(len(judged), 1)
            right.barh(row, share, left=begin, height=0.6, color=COLOURS[kind], label=WORDS[kind] if row == 0 else None)
            begin += share
    right.set_yticks(range(len(names)), [wrapped(name) for name in names], fontsize=8.5)
    right.set(ylim=(len(names) - 0.5, -0.5), xlim=(0.0, 1.0), xlabel="cells")
    right.grid(visible=False)
    for axes in (left, right):
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=8, columnspacing=1.0)
    return figure


# The command


def measure_all(quick: bool) -> Found:
    """Let the methods solve all cells, and drive the tasks' arms."""
    families, referee = [build(QUICK if quick else FULL) for build in FAMILIES.values()], Referee()
    return Found(families, [r for family in families for r in measure(family, COMPARED, referee)], torture.measure(quick))


COLUMNS = (
    *(Column(name, name) for name in ("family", "x", "y", "method")),
    Column(lambda r: r.outcome.name.lower(), "outcome"), Column("seconds", "seconds"), Column("off", "tip_off_relative"),
    *(Column(name, name) for name in ("jumps", "lost", "doubt", "note")),
)  # fmt: skip
STUDY = Study(
    "stability",
    "map where methods find the equilibrium that the arm is on, and where and how they fail",
    measure_all,
    tables={
        "stability.csv": (COLUMNS, lambda found: found.results), "torture.csv": (torture.COLUMNS, lambda found: found.runs)
    },
    figures=draw,
    page=("stability.md", report),
    findings=lambda found: findings(found.results),
)  # fmt: skip
