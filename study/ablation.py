"""Which physical effects each scene needs: the tip error that leaving one out makes, and the time that it saves."""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from math import isfinite, nan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from study import pattern
from study.effects import COOL, COUPLING, EFFECTS, NAMES, Effect, View
from study.method import Array, State, warm_call
from study.pattern import COLOURS, Column, Study
from study.scenes import SCENES, Case, Scene
from tca_envs.mechanics import Arm, Grid, Rung, discretise
from tca_envs.mechanics.arm import default_grid
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import TOLERANCE
from tca_envs.rotation import yaw_angle
from tca_envs.tasks import pick_and_place, reach, twist_align

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FULL, QUICK = 100, 12  # states of a scene
REPEATS = 15  # a solve is timed so often, in turns with and without the effect; it counts with the median
SHARE = 0.1
"""An effect is needed if without it the tip errs at the 95 % quantile by more than this share of success radius or angle."""
GAIN = 0.1  # an effect that is not needed is free if leaving it out saves less than this share of the time
NOTHING = 1e-9  # an arm whose tip moves by less [m] when an effect is left out did not have it
RADIUS = {
    "reach": 0.001 * reach.SUCCESS_MM,
    "twist-align": 0.001 * twist_align.SUCCESS_MM,
    "pick-and-place": 0.001 * pick_and_place.SUCCESS_MM,
    "helix": 0.001 * twist_align.SUCCESS_MM,
}  # Scene -> success radius [m]; of the twisting module alone that of the task that asks most of it
ANGLE = {name: twist_align.SUCCESS_DEG for name in ("twist-align", "pick-and-place", "helix")}
"""Scene -> how precisely the gripper is to be turned [deg]; Reach has no gripper to turn, and placing an object asks as much of
the jaws as aligning them does."""

NEEDED, FREE, SPARE = "needed", "free", "could be left out"
LEFT_OUT, MISSED, ABSENT = "left out", "left out, not negligible", "in no state"
"""Verdicts: of effects in the default model, of effects that are not, of effects that no state has."""


# Measuring


class Row(NamedTuple):
    """What an effect is worth in a scene; nan where no state has it."""

    scene: str
    effect: str
    states: int
    present: int = 0  # states that have the effect; everything below is over them
    unsolved: int = 0  # states where the model without it has no equilibrium: they enter nothing below
    error: float = nan  # median tip error without the effect [m]
    error_p95: float = nan
    error_max: float = nan
    turn_p95: float = nan  # error of the tip's yaw [deg]
    time: float = nan  # time of a warm solve without the effect over that with it: median over the states
    contained: bool = True  # whether the scene's default model has the effect

    @property
    def far(self) -> bool:
        """Whether leaving the effect out moves or turns the tip by more than the task can spare."""
        turned = self.turn_p95 > SHARE * ANGLE.get(self.scene, np.inf)
        return self.error_p95 > SHARE * RADIUS[self.scene] or turned or self.unsolved > 0.05 * self.present

    @property
    def verdict(self) -> str:
        """What follows for the default model."""
        if not self.present:
            return ABSENT
        if not self.contained:
            return MISSED if self.far else LEFT_OUT
        if self.far:
            return NEEDED
        return SPARE if self.time < 1.0 - GAIN else FREE


@lru_cache(maxsize=256)
def fine(arm: Arm) -> Arm:
    """Return an arm on grids whose error is far below what any effect makes."""
    grids = [Grid(2 * elements, nodes) for elements, nodes in map(default_grid, arm.modules)]
    return Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-10)


def pose(view: View) -> Array:
    """Return the pose (4, 4) of the compared point, reached over the state before; nan where there is no equilibrium."""
    arm = fine(view.now.arm)
    before = view.before.on(arm)
    found = view.now.on(arm, before if before.converged else None)
    return view.point(found) if found.converged else np.full((4, 4), nan)


def cheapest(views: Sequence[View]) -> dict[Arm, Arm]:
    """Return each arm on the cheapest grids that keep its tip within the default tolerance over the states asked of it."""
    groups: dict[Arm, list[State]] = {}
    for view in views:
        groups.setdefault(view.now.arm, []).extend([view.before, view.now])
    return {arm: discretise(arm, TOLERANCE, [s.drive for s in asked], [s.load for s in asked]) for arm, asked in groups.items()}


def solving(arm: Arm, view: View) -> Callable[[], float]:
    """Return what solves a view from its state before: the time [s], nan where it fails."""
    solve = warm_call(arm, arm.restart(view.before.on(arm)), view.now.drive, view.now.load)

    def call() -> float:
        taken, report = solve()
        return taken if report["rung"][0] != Rung.FAILED else nan

    return call


def time_ratio(complete: Sequence[View], without: Sequence[View], grids: Callable[[Arm], Arm]) -> float:
    """Return the median over the cases of the time without an effect over that with it; nan if no case can be solved."""
    ratios = []
    with pattern.no_collection():
        for pair in zip(complete, without, strict=True):
            calls = [solving(grids(view.now.arm), view) for view in pair]
            with_it, without_it = np.median([[call() for call in calls] for _ in range(REPEATS)], axis=0).tolist()
            ratios.append(without_it / with_it)
    good = [ratio for ratio in ratios if isfinite(ratio)]
    return float(np.median(good)) if good else nan


def measure(scene: str, effect: Effect, cases: Sequence[Case]) -> Row:
    """Leave an effect out of warm cases of a scene."""
    here = [case for case in cases if effect.present(case.state)]
    row = Row(scene, effect.name, len(cases), len(here), contained=effect.contained(cases[0]))
    if not here:
        return row
    complete, without = [effect.complete(case) for case in here], [effect.without(case) for case in here]
    poses = np.array([[pose(view) for view in views] for views in (complete, without)])
    good = np.isfinite(poses).all(axis=(0, 2, 3))
    row = row._replace(unsolved=int((~good).sum()))
    if not good.any():
        return row
    true, false = poses[:, good]
    error = np.linalg.norm(false[:, :3, 3] - true[:, :3, 3], axis=1)
    turn = np.degrees(yaw_angle(false) - yaw_angle(true))
    turn = np.abs((turn + 180.0) % 360.0 - 180.0)
    median, p95, worst = np.quantile(error, [0.5, 0.95, 1.0]).tolist()
    return row._replace(
        error=median, error_p95=p95, error_max=worst, turn_p95=float(np.quantile(turn, 0.95)),
        time=time_ratio(complete, without, cheapest(complete + without).__getitem__),
        contained=row.contained and worst > NOTHING,
    )  # fmt: skip


# Drawing and writing

LOOKS: dict[str, dict[str, Any]] = {
    NEEDED: {"color": COLOURS[0], "marker": "o"},
    FREE: {"color": COLOURS[2], "marker": "D"},
    SPARE: {"color": COLOURS[3], "marker": "s"},
    LEFT_OUT: {"color": COLOURS[4], "marker": "v"},
    MISSED: {"color": COLOURS[1], "marker": "^"},
}
RADIUS_LINE: dict[str, Any] = {"color": "0.15", "linewidth": 1.2}
SHARE_LINE: dict[str, Any] = {"color": "0.15", "linewidth": 1.0, "linestyle": "--"}
TOLERANCE_LINE: dict[str, Any] = {"color": "0.45", "linewidth": 1.0, "linestyle": ":"}
BEHIND: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}  # of words: they cover lines
SHORTEST = 1e-6  # where the axes begin [m]


class Found(NamedTuple):
    """What leaving out every effect of every scene does."""

    scenes: list[Scene]
    rows: list[Row]
    whole_arm_time: float  # of Reach's default model, over that of the whole arm as the robot discretises it


def draw(found: Found) -> "Iterator[tuple[str, Figure]]":
    """Draw the tip errors, a panel for each scene."""
    from matplotlib.lines import Line2D

    scenes, rows, _ = found
    figure, panels = pattern.new_figure(len(scenes), 2.9 * len(scenes) + 1.4, 4.5, sharex=True, sharey=True)
    for axes, scene in zip(panels, scenes, strict=True):
        draw_scene(axes, scene, [row for row in rows if row.scene == scene.name])
    panels[0].set_yticks(range(len(NAMES)), NAMES)
    panels[0].set_ylim(len(NAMES) - 0.5, -0.9)
    marks: dict[str, Any] = {"linestyle": "none", "markersize": 7}
    shown = [(verdict, look) for verdict, look in LOOKS.items() if any(row.verdict == verdict for row in rows)]
    entries = [
        Line2D([], [], color="0.3", marker="|", markersize=8, linewidth=1.6, label="median to largest error"),
        *(Line2D([], [], **look, **marks, label=f"95 %: {verdict}") for verdict, look in shown),
        Line2D([], [], **RADIUS_LINE, label="success radius"),
        Line2D([], [], **SHARE_LINE, label=f"{100 * SHARE:.0f} % of the success radius"),
        Line2D([], [], **TOLERANCE_LINE, label="default tolerance"),
        Line2D([], [], linestyle="none", label=f"yaw: 95 %, if above {100 * SHARE:.0f} % of its limit"),
        Line2D([], [], linestyle="none", label="time: without it, over with it"),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    yield "effects.png", figure


def remark(row: Row | None) -> str:
    """Return what to write where an effect has no mark in the figure."""
    if row is None:
        return "does not apply"
    if not row.present:
        return "in no state"
    if not isfinite(row.error):
        return "no equilibrium without it"
    return f"below {mm(SHORTEST)} mm" if row.error_max < SHORTEST else ""


def draw_scene(axes: "Axes", scene: Scene, rows: Sequence[Row]) -> None:
    """Draw a scene's effects; times stand to the right, what cannot be drawn stands in its line in words."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(xscale="log", xlabel="tip error without it [mm]", xlim=(1e3 * SHORTEST, 1e2))
    axes.set_title(scene.title.replace(": ", "\n"), fontsize=10)
    axes.xaxis.set_major_locator(LogLocator(numticks=10))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.tick_params(axis="y", length=0)
    radius = RADIUS[scene.name]
    for x, line in ((radius, RADIUS_LINE), (SHARE * radius, SHARE_LINE), (TOLERANCE, TOLERANCE_LINE)):
        axes.axvline(1e3 * x, **line, zorder=1)
    beside: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "va": "center", "fontsize": 8}
    axes.annotate("time", (1.0, -0.65), xytext=(3, 0), color="0.35", **beside)
    known = {row.effect: row for row in rows}
    for place, name in enumerate(NAMES):
        row = known.get(name)
        words = remark(row)
        if words:
            axes.annotate(words, (0.5, place), xytext=(0, 0), ha="center", color="0.5", style="italic", bbox=BEHIND, **beside)
        if row is None or not isfinite(row.error):
            continue
        look = LOOKS[row.verdict]
        extent = 1e3 * np.array([row.error, row.error_max])
        axes.plot(extent, [place, place], color=look["color"], marker="|", markersize=8, linewidth=1.6, zorder=3)
        axes.plot(1e3 * row.error_p95, place, **look, markersize=7, markeredgecolor="white", linestyle="none", zorder=4)
        axes.annotate(f"×{row.time:.2f}" if isfinite(row.time) else "--", (1.0, place), xytext=(3, 0), color="0.35", **beside)
        if row.turn_p95 > SHARE * ANGLE.get(scene.name, np.inf):
            axes.annotate(
                f"yaw {row.turn_p95:.0f}°", (1e3 * row.error_p95, place), xytext=(0, 8), textcoords="offset points",
                ha="center", fontsize=7.5, color=look["color"], bbox=BEHIND,
            )  # fmt: skip


def mm(length: float) -> str:
    """Return a length [m] in millimetres with three significant digits."""
    return rounded(1e3 * length, 3)


def rounded(value: float, digits: int) -> str:
    """Return a number with so many significant digits, -- where it is missing."""
    return f"{float(f'{value:.{digits}g}'):g}" if isfinite(value) else "--"


COLUMNS = (
    Column("scene", "scene"), Column("effect", "effect", "Left out"), Column("states", "states"),
    Column("present", "with_effect"), Column("unsolved", "unsolved"),
    Column(lambda r: f"{r.present} of {r.states}" + (f", {r.unsolved} unsolved" if r.unsolved else ""), "", "States"),
    Column("error", "median_error_m", "Median [mm]", mm), Column("error_p95", "p95_error_m", "95 % [mm]", mm),
    Column("error_max", "max_error_m", "Largest [mm]", mm),
    Column("turn_p95", "p95_yaw_error_deg", "Yaw, 95 % [°]", lambda angle: rounded(angle, 2)),
    Column("time", "time_ratio", "Time", pattern.fixed(".2f")),
    Column(lambda r: "yes" if r.contained else "no", "in_default_model", "In default"), Column("verdict", "verdict", "Verdict"),
)  # fmt: skip


def listed(rows: Sequence[Row], verdict: str) -> str:
    """Return the effects of a verdict, scene by scene, in words."""
    named: dict[str, list[str]] = {}
    for row in rows:
        if row.verdict == verdict:
            named.setdefault(row.scene, []).append(row.effect)
    return "; ".join(f"{scene}: {', '.join(effects)}" for scene, effects in named.items()) or "none"


def findings(rows: Sequence[Row], whole_arm_time: float) -> str:
    """Return what the default models contain and where the table agrees, in words."""
    everywhere = [name for name in NAMES if all(row.contained for row in rows if row.effect == name)]
    missing = "; ".join(f"{row.scene} leaves out {row.effect}" for row in rows if not row.contained)
    by_yaw = [row for row in rows if row.verdict == NEEDED and row.error_p95 <= SHARE * RADIUS[row.scene]]
    lines = [
        f"The default models contain {', '.join(everywhere)}; {missing or 'none leaves anything out'}.",
        "Every effect that the table calls needed is in the default model of its scene"
        + (f", but for {listed(rows, MISSED)}." if any(row.verdict == MISSED for row in rows) else "."),
        "",
        f"* Needed: {listed(rows, NEEDED)}. For the yaw alone: {listed(by_yaw, NEEDED)}.",
        f"* Free (not needed, but leaving it out saves less than {100 * GAIN:.0f} % of the time, so it is kept): "
        f"{listed(rows, FREE)}.",
        f"* Could be left out (not needed, and it costs time), but is kept: {listed(rows, SPARE)}.",
        f"* Left out, and it does not matter: {listed(rows, LEFT_OUT)}.",
        f"* Left out, although it is not negligible: {listed(rows, MISSED)}.",
        f"* In no state of the scene: {listed(rows, ABSENT)}.",
    ]
    return "\n".join(
        lines + [known_gap(row, whole_arm_time) for row in rows if row.scene == "reach" and row.effect == COUPLING]
    )


def known_gap(row: Row, whole_arm_time: float) -> str:
    """Return what Reach gives up by its default model, in words."""
    share, times = 100.0 * row.error_max / RADIUS[row.scene], row.error_max / TOLERANCE
    return (
        f"\nReach leaves the coupling out knowingly, by definition of the task: twisting module and gripper hang from the "
        f"bending module as dead weight. Against the whole arm with its elastic twisting module at {AMBIENT:g} °C the "
        f"bending module's tip errs by {mm(row.error)} mm (median), {mm(row.error_p95)} mm (95 %), {mm(row.error_max)} mm "
        f"(largest). That is up to {share:.0f} % of the success radius and {times:.0f} times the default tolerance: not "
        f"negligible; the tolerance of Reach is that of its own model. The time of a solve is {whole_arm_time:.2f} of that of "
        f"the whole arm on its default grids, which also serve a hot twisting module; it is {row.time:.2f} of it where the "
        f"whole arm has the cheapest grids for one that stays cold."
    )


def report(found: Found) -> str:
    """Return the page."""
    parts = [
        "# Which physical effects each scene needs", findings(found.rows, found.whole_arm_time),
        "![Tip error without each effect](effects.png)", "## How it was made", protocol(),
    ]  # fmt: skip
    for scene in found.scenes:
        angle = f" and a yaw of {ANGLE[scene.name]:g}°" if scene.name in ANGLE else ""
        parts += [
            f"## {scene.title[0].upper()}{scene.title[1:]}",
            f"{len(scene.cases)} states, judged by a success radius of {mm(RADIUS[scene.name])} mm{angle}.",
            pattern.table(COLUMNS, [row for row in found.rows if row.scene == scene.name]),
        ]
    return pattern.page(*parts)


def protocol() -> str:
    """Return what was done, in words."""
    lines = [
        "One effect at a time is left out. Models with and without it are solved for the same states of the scene, on grids so "
        "fine that only the effect remains; the error is the distance of their tips. Only states that have the effect count.",
        f"Needed: at the 95 % quantile the tip errs by more than {100 * SHARE:.0f} % of the success radius, or its yaw by more "
        "than that share of the success angle. The angle is that of TwistAlign wherever there is a gripper to turn: placing an "
        "object asks as much of the jaws. The twisting module alone is judged by TwistAlign's radius, too.",
        "Time: of a warm solve without the effect over that with it, median over the states; the solve alone, as a step of an "
        "environment calls it, both models in turns, each on the cheapest grids that keep its own tip within the default "
        "tolerance over these states. "
        "Shear and extension are left out by stiffness: the unknowns stay, so this solver gets no faster by itself.",
        "Gravity: nothing weighs anything. Weight at the tip: what hangs from the arm's end weighs nothing (gripper and "
        "object; in Reach the twisting module, too). Object's weight: the gripper hangs there empty. "
        f"Passive muscles: TCAs that do not pull by themselves are taken out; cool muscles: all below {COOL:g} °C, which "
        "stand for them where controllers leave no TCA unheated.",
        "Module coupling: what hangs from the bending module is a rigid body in its unloaded shape, not driven. In Reach, "
        "where that is the default model, with a centre of mass that is an estimate, it is held against the whole arm with "
        f"the twisting module at {AMBIENT:g} °C.",
    ]
    return "\n\n".join(lines)


def measure_all(quick: bool) -> Found:
    """Leave out every effect of every scene."""
    scenes = [SCENES[name](QUICK if quick else FULL) for name in EFFECTS]
    rows = [
        measure(scene.name, effect, scene.cases)
        for scene in pattern.progress(scenes, unit="scene")
        for effect in sorted(EFFECTS[scene.name], key=lambda effect: NAMES.index(effect.name))
    ]
    (coupling,) = (effect for effect in EFFECTS["reach"] if effect.name == COUPLING)
    alone, whole = ([view(case) for case in scenes[0].cases] for view in (coupling.complete, coupling.without))
    return Found(scenes, rows, time_ratio(alone, whole, lambda arm: arm))


STUDY = Study(
    "effects",
    "tell which physical effects each scene needs: tip error and time without each of them",
    measure_all,
    tables={"effects.csv": (COLUMNS, lambda found: found.rows)},
    figures=draw,
    page=("effects.md", report),
    findings=lambda found: findings(found.rows, found.whole_arm_time),
)
