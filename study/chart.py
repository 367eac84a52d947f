"""Work-precision charts: time of a solve over its tip error, a line for each method, a marker for each setting."""

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np

from study import pattern
from study.pattern import COLOURS
from study.scenes import Scene
from study.timing import NOT_INSTALLED, NOT_RUN, Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

MARKERS = ("s", "^", "D", "v", "p", "<", ">", "h", "d", "8", "*")
PROJECT: dict[str, Any] = {"color": "black", "marker": "o", "linewidth": 2.4, "markersize": 7.5, "zorder": 6}
EDGE = {"markeredgecolor": "white", "markeredgewidth": 0.6}
LABEL_PLACES = [(r, k * pi / 8.0) for r in (13.0, 20.0, 28.0) for k in (2, 14, 6, 10, 0, 8, 4, 12, 1, 15, 7, 9, 3, 13, 5, 11)]
"""Distance [points] and direction [rad] at which a percentage may stand from its marker, the best place first."""


def styles(names: Sequence[str], ours: str) -> dict[str, dict[str, Any]]:
    """Return how each method is drawn, the same in all figures that are given the same names."""
    others = [name for name in names if name != ours]
    drawn = {}
    for i, name in enumerate(others):
        again, colour = divmod(i, len(COLOURS))
        drawn[name] = {
            "color": COLOURS[colour], "marker": MARKERS[(i + again) % len(MARKERS)], "linestyle": "--" if again else "-",
            "linewidth": 1.3, "markersize": 5.5, "zorder": 4,
        }  # fmt: skip
    return {ours: PROJECT, **drawn}


def draw_scene(scene: Scene, group: Sequence[Point], names: Sequence[str], ours: str) -> "Figure":
    """Return the chart of a scene: methods and what is missing stand to the right."""
    figure, (axes, aside) = pattern.new_figure(2, 9.6, 5.4, width_ratios=[1.75, 1.0])
    chosen = styles(names, ours)
    draw(axes, group, chosen)
    axes.set_title(f"{scene.title}, {scene.start} start", fontsize=11)
    aside.set_axis_off()
    legend = aside.legend(
        handles=handles(group, chosen), loc="upper left", frameon=False, fontsize=8.5, borderaxespad=0.0, borderpad=0.0
    )
    text = absent(group, 52)
    if text:
        figure.draw_without_rendering()
        bottom = legend.get_window_extent().transformed(aside.transAxes.inverted()).y0
        aside.text(0.0, bottom - 0.03, text, transform=aside.transAxes, va="top", fontsize=7.5, linespacing=1.35)
    label_failures(figure, [(axes, group)], chosen)
    figure.set_layout_engine("none")  # nothing changes any more
    return figure


def draw_overview(scenes: Sequence[Scene], measured: Sequence[Point], names: Sequence[str], ours: str) -> "Figure":
    """Return several scenes side by side, one legend below."""
    groups = [[p for p in measured if p.scene == scene.name] for scene in scenes]
    figure, panels = pattern.new_figure(len(scenes), 3.1 * len(scenes) + 0.4, 5.4, sharex=True, sharey=True)
    chosen = styles(names, ours)
    for axes, scene, group in zip(panels, scenes, groups, strict=True):
        draw(axes, group, chosen)
        axes.set_title(scene.title.replace(": ", "\n"), fontsize=10)
        if axes is not panels[0]:
            axes.set_ylabel("")
        tried = [p for p in group if p.note not in (NOT_INSTALLED, NOT_RUN)]
        axes.annotate(
            absent(tried, 52), (0.0, 0.0), xycoords="axes fraction", xytext=(0, -36), textcoords="offset points", va="top",
            fontsize=7, color="0.25",
        )  # fmt: skip
    everything = [p for group in groups for p in group]
    entries = handles(everything, chosen)
    figure.legend(handles=entries, loc="outside lower center", ncols=min(2, len(entries)), frameon=False, fontsize=8.5)
    label_failures(figure, list(zip(panels, groups, strict=True)), chosen)
    figure.set_layout_engine("none")
    return figure


def draw(axes: "Axes", group: Sequence[Point], chosen: dict[str, dict[str, Any]]) -> None:
    """Draw the lines of a scene's methods."""
    from matplotlib.ticker import LogLocator, NullFormatter

    for name, style in chosen.items():
        points = [p for p in group if p.method == name and p.solved]
        axes.plot([p.error for p in points], [p.time for p in points], **{**style, "marker": "none"})
        for p in points:
            face = {"markerfacecolor": "white", "markeredgewidth": 1.4} if p.failed else EDGE
            axes.plot([p.error], [p.time], **{**style, "linestyle": "none", **face})
    axes.set(xscale="log", yscale="log", xlabel="tip error, median", ylabel="time of a solve, median")
    axes.margins(0.08)
    pattern.with_units(axes, "m", "s")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_locator(LogLocator(subs=(2, 3, 4, 5, 6, 7, 8, 9)))
        axis.set_minor_formatter(NullFormatter())
    low, high = axes.get_xlim()
    if high / low > 1e5:
        axes.xaxis.set_major_locator(LogLocator(base=1000.0, numticks=20))
        axes.xaxis.set_minor_locator(LogLocator(numticks=20))
    floor = max((p.floor for p in group if p.solved), default=0.0)
    if any(p.solved and p.error <= floor for p in group):
        axes.axvline(floor, color="0.6", linewidth=0.9, linestyle=":")
        axes.annotate(
            "reference's error", (floor, 0.99), xycoords=("data", "axes fraction"), xytext=(3, 0), textcoords="offset points",
            rotation=90, va="top", fontsize=7, color="0.45",
        )  # fmt: skip
    axes.annotate(
        "better", xy=(0.015, 0.02), xytext=(0.06, 0.075), xycoords="axes fraction", fontsize=8, color="0.45",
        arrowprops={"arrowstyle": "->", "color": "0.45"},
    )  # fmt: skip


def handles(group: Sequence[Point], chosen: dict[str, dict[str, Any]]) -> "list[Line2D]":
    """Return the legend's entries of the methods that are drawn."""
    from matplotlib.lines import Line2D

    result = []
    for name, style in chosen.items():
        points = [p for p in group if p.method == name and p.solved]
        if points:
            result.append(Line2D([], [], label=f"{name}: {span(points)}", **{**style, **EDGE}))
    if any(p.solved and p.failed for p in group):
        hollow: dict[str, Any] = {"marker": "o", "markerfacecolor": "white", "linestyle": "none"}
        result.append(Line2D([], [], color="0.3", label="hollow: fails on that share of the cases", **hollow))
    return result


def span(points: Sequence[Point]) -> str:
    """Return the knob with the range of settings, which stand from coarse to fine in each scene."""
    settings = max(([p.setting for p in points if p.scene == scene] for scene in {p.scene for p in points}), key=len)
    first, last = settings[0], settings[-1]
    return f"{points[0].knob} {first}" if first == last else f"{points[0].knob} {first} to {last}"


def absent(group: Sequence[Point], width: int) -> str:
    """Return what the chart cannot show, with its reason, wrapped."""
    reasons: dict[str, dict[str, list[str]]] = {}
    for p in group:
        if not p.solved:
            reasons.setdefault(p.note.split(":")[0], {}).setdefault(p.method, []).append(p.setting)
    lines = []
    for note, methods in reasons.items():
        lines.append(f"{note[0].upper()}{note[1:]}:")
        for method, settings in methods.items():
            which = "all settings" if len(settings) == sum(p.method == method for p in group) else ", ".join(settings)
            lines += textwrap.wrap(f"{method}: {which}", width, initial_indent="– ", subsequent_indent="   ")
    return "\n".join(lines)


def label_failures(
    figure: "Figure", drawn: "Sequence[tuple[Axes, Sequence[Point]]]", chosen: dict[str, dict[str, Any]]
) -> None:
    """Write the failure rates beside the hollow markers, where they cover nothing if that can be."""
    figure.draw_without_rendering()
    pixels = figure.dpi / 72.0
    for axes, group in drawn:
        bounds = axes.get_window_extent()
        outlines = [axes.transData.transform(line.get_xydata()) for line in axes.lines]
        # A cell for each marker, small ones along the lines between them.
        taken = [(*(xy - 4.0 * pixels), *(xy + 4.0 * pixels), 10) for line in outlines for xy in line]
        for line in outlines:
            for a, b in pairwise(line):
                steps = np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / (3.0 * pixels))))
                taken += [(*(xy - 0.5 * pixels), *(xy + 0.5 * pixels), 1) for xy in steps]
        for p in group:
            if not (p.solved and p.failed):
                continue
            text = f"{100.0 * p.failure_rate:.0f} %"
            half = np.array([2.3 * len(text), 4.0]) * pixels
            places = []
            for distance, angle in LABEL_PLACES:
                offset = (distance * cos(angle), 0.8 * distance * sin(angle))
                middle = axes.transData.transform((p.error, p.time)) + np.array(offset) * pixels
                box = (*(middle - half), *(middle + half))
                cost = sum(c for l, b, r, t, c in taken if box[0] < r and l < box[2] and box[1] < t and b < box[3])
                inside = box[0] > bounds.x0 and box[1] > bounds.y0 and box[2] < bounds.x1 and box[3] < bounds.y1
                places.append((cost + (0 if inside else 50), offset, box))
            _, offset, box = min(places, key=lambda place: place[0])
            taken.append((*box, 100))
            axes.annotate(
                text, (p.error, p.time), xytext=offset, textcoords="offset points", ha="center", va="center", fontsize=7,
                color=chosen[p.method]["color"],
            )  # fmt: skip
