"""The paper's Fig. 6: the arm picks an object up and puts it down, as a sequence of equilibria.

Source: Sun & Zhao, section IV.B. The steps are the paper's: (a) straight, the object 10 mm under the gripper; (b) the twisting
module aligns the gripper; (c) the gripper opens; (d) the arm is lowered and the gripper closes; (e) the arm lifts the object;
(f) the twisting module cools; (g) the bending module bends to +x and the gripper opens again. Whether the object comes along
follows from gap, pinch force and friction (`tca_envs.mechanics.grasp`).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy.optimize import brentq

from study import pattern
from study.method import Array
from study.pattern import Column
from tca_envs import registry
from tca_envs.mechanics import TCA, Equilibrium, Gripper, grasp
from tca_envs.mechanics.thermal import AMBIENT as COLD
from tca_envs.mechanics.thermal import SOFT_LIMIT
from tca_envs.robots import paper
from tca_envs.rotation import yaw_angle

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

OPEN, BENT = 147.0, 110.0  # temperatures [degC] of the open gripper and of the TCA at +x in (g)
OBJECT_YAW = -60.0  # of the object [deg]
LOWERED = 10e-3  # [m] (paper, Fig. 6: the object is 10 mm under the gripper).
SUBSTEPS = 10  # of a change of temperatures or of the stage


@dataclass(frozen=True, eq=False)
class Frame:
    """A panel of Fig. 6."""

    label: str
    temperature: Array  # (5,) [degC]: bending TCAs, helical TCA, gripper's TCA
    scene: Array  # (SCENE,) as of `grasp`
    arm: Equilibrium
    gap: float  # of the jaws [m]; with the object between them at least its width
    pinch: float  # force on the object [N]
    converged: bool  # false where the arm stayed behind because no equilibrium was found on the way

    @property
    def yaw(self) -> float:
        """Of the gripper [deg]."""
        return float(np.degrees(yaw_angle(self.arm.tip_pose)))


class Rig:
    """The arm, its gripper and the object, moved step by step; all TCAs have the same parameter set."""

    def __init__(self, law: TCA) -> None:
        self.law = law
        self.gripper = paper.ring(law)
        self.temperature = np.full(5, COLD)
        self.grid = np.arange(COLD, SOFT_LIMIT + 1.0)
        self.pinch = self.gripper.pinch(self.grid, paper.OBJECT.width)
        self.converged = True
        self.site = registry.entry("pick-and-place").new().site
        self.scene = np.zeros((1, grasp.SCENE))
        self.scene[0, grasp.Z] = grasp.resting(paper.OBJECT, self.site)
        self.scene[0, grasp.YAW] = np.radians(OBJECT_YAW)
        self.model = paper.whole_arm(law)
        self.arm = self.model.equilibrium(self.temperature[:4])

    def move(self, bending: float = COLD, helix: float = COLD, jaws: float = COLD, lowered: float = 0.0) -> None:
        """Heat the TCA at +x, the helical one and the gripper's [degC], then move the stage by `lowered` [m], in substeps."""
        temperature = np.array([bending, COLD, COLD, helix, jaws])
        change = (temperature - self.temperature) / SUBSTEPS
        for step in range(2 * SUBSTEPS):
            heating = step < SUBSTEPS
            self.temperature = self.temperature + change if heating else self.temperature
            held = self.scene[0, grasp.HELD] > 0.5
            x, y, z = grasp.in_mount(self.scene[0], self.arm.tip_pose).tolist()
            payload = paper.with_object((x, y, z)) if held else None
            arm = self.model.equilibrium(self.temperature[:4], start=self.arm, payload=payload)
            self.converged &= arm.converged
            self.arm = arm if arm.converged else self.arm
            tool, heading = place(self.arm)
            self.scene = grasp.step(
                self.scene, tool[np.newaxis], np.array([heading]), self.gripper.gap(self.temperature[4:]), self._pinch(),
                np.array([0.0 if heating else lowered / SUBSTEPS]), paper.OBJECT, self.site,
            )  # fmt: skip
        self.temperature = temperature

    def _pinch(self) -> Array:
        """Return the force with which each jaw would press on the object between them (1,) [N]."""
        return np.interp(self.temperature[4:], self.grid, self.pinch)

    def frame(self, label: str) -> Frame:
        """Return what there is now."""
        between = bool(self.scene[0, grasp.HELD] > 0.5 or self.scene[0, grasp.ASTRIDE] > 0.5)
        gap = float(self.gripper.gap(self.temperature[4]))
        pinch = float(self._pinch()[0]) if between else 0.0
        opening = max(gap, paper.OBJECT.width) if between else gap
        converged, self.converged = self.converged, True
        return Frame(label, self.temperature.copy(), self.scene[0].copy(), self.arm, opening, pinch, converged)


def place(arm: Equilibrium) -> tuple[Array, float]:
    """Return the point between the jaws (3,) [m], with the stage up, and the direction in which they open [rad]."""
    return grasp.between_jaws(arm.tip_pose, paper.JAW_DEPTH), float(yaw_angle(arm.tip_pose))


def turns(law: TCA, temperature: Array) -> Array:
    """Return the gripper's yaw [deg], counted on beyond -180, at temperatures (k,) [degC] of the helical TCA alone."""
    arm, here, yaws = paper.whole_arm(law), None, []
    for value in temperature:
        here = arm.equilibrium([COLD, COLD, COLD, value], start=here)
        yaws.append(place(here)[1])
    return np.degrees(np.unwrap(yaws))


def figure6(law: TCA) -> list[Frame]:
    """Compute the frames of Fig. 6; where the helix cannot turn as far as the object lies, it turns as far as it can."""
    rig = Rig(law)
    grid = np.linspace(COLD, SOFT_LIMIT, 26)
    twisted = float(np.interp(-OBJECT_YAW, np.maximum.accumulate(-turns(law, grid)), grid))
    turned = {"helix": twisted}
    plan: tuple[tuple[str, tuple[dict[str, float], ...]], ...] = (
        ("start", ()), ("twist", (turned,)), ("open", ({**turned, "jaws": OPEN},)),
        ("lower, close", ({**turned, "jaws": OPEN, "lowered": LOWERED}, turned)), ("lift", ({**turned, "lowered": -LOWERED},)),
        ("untwist", ({},)), ("bend, open", ({"bending": BENT}, {"bending": BENT, "jaws": OPEN})),
    )  # fmt: skip
    frames = []
    for label, moves in plan:
        for move in moves:
            rig.move(**move)
        frames.append(rig.frame(label))
    return frames


COLUMNS = (
    Column(lambda row: row[0], "case"), Column(lambda row: row[1].label, "panel"),
    *(Column(lambda row, value=value: float(value(row[1])), name) for name, value in (  # type: ignore[misc]
        *((f"temperature_{i}_degC", lambda f, i=i: f.temperature[i]) for i in range(5)),
        ("stage_mm", lambda f: 1e3 * f.scene[grasp.STAGE]),
        *((f"tip_{x}_mm", lambda f, k=k: 1e3 * f.arm.tip_pose[k, 3]) for k, x in enumerate("xyz")),
        ("yaw_deg", lambda f: f.yaw), ("gap_mm", lambda f: 1e3 * f.gap), ("pinch_mN", lambda f: 1e3 * f.pinch),
        *((f"object_{x}_mm", lambda f, k=k: 1e3 * f.scene[grasp.X + k]) for k, x in enumerate("xyz")),
        ("object_yaw_deg", lambda f: np.degrees(f.scene[grasp.YAW]))
    )),
    Column(lambda row: int(row[1].scene[grasp.HELD]), "held"),
)  # fmt: skip


def rows(sequences: dict[str, list[Frame]]) -> list[tuple[str, Frame]]:
    """Return the frames of all cases."""
    return [(case, frame) for case, frames in sequences.items() for frame in frames]


def ring(gripper: Gripper, gap: float, side: float, points: int = 30) -> Array:
    """Return one half of the ring (points, 2) [m], across and below its mount, as an arc that ends at the jaw."""
    half = 0.5 * gripper.length
    angle = brentq(lambda x: 2.0 * half * np.sin(x) / x - gap, 0.5 * pi, pi) if gap > 0.0 else pi
    s = np.linspace(0.0, 1.0, points)
    return half / angle * np.column_stack([side * np.sin(s * angle), 1.0 - np.cos(s * angle)])


def draw6(sequences: dict[str, list[Frame]]) -> "Figure":
    """Draw Fig. 6: a row for each case, a panel for each step."""
    pattern.require("matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    columns, rows = len(next(iter(sequences.values()))), len(sequences)
    wide, high, side = 1.75, 4.7, 4.1  # panels and 3D views [inch]
    figure = Figure(figsize=(wide * columns + 0.3, high * rows + 0.35))
    for row, (case, frames) in enumerate(sequences.items()):
        bottom = 0.35 + high * (rows - 1 - row)
        for column, frame in enumerate(frames):
            middle = 0.3 + wide * (column + 0.5)
            # A 3D view is a square, so neighbours overlap.
            rectangle = (middle - 0.5 * side, bottom - 0.1, side, side)
            axes = figure.add_axes(tuple(inches(figure, rectangle)), projection="3d", computed_zorder=False)
            draw_frame(cast("Axes3D", axes), frame)
            holding = "held" if frame.scene[grasp.HELD] > 0.5 else "on the table"
            x, y = inches(figure, (middle, bottom + high - 0.1))
            figure.text(
                x, y,
                f"({'abcdefg'[column]}) {frame.label}\nyaw {round(frame.yaw)}°, gap {1e3 * frame.gap:.1f} mm\nobject {holding}",
                fontsize=9, ha="center", va="top",
            )  # fmt: skip
        x, y = inches(figure, (0.1, bottom + 0.5 * high))
        figure.text(x, y, case, rotation=90, va="center", fontsize=11)
    handles = [
        Line2D([], [], color="black", lw=3, label="centerline and gripper"),
        Line2D([], [], color="#D62728", lw=2, label="hot TCA"),
        Line2D([], [], color="#2CA02C", lw=2, label="cold TCA"),
        Line2D([], [], color="#1F77B4", lw=1.2, label="cross sections"),
        Line2D([], [], color="#E69F00", lw=5, label="object"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=5, frameon=False, fontsize=9)
    return figure


def inches(figure: "Figure", lengths: tuple[float, ...]) -> list[Any]:
    """Return x, y, or x, y, width, height, as fractions of the figure from inches."""
    return [length / size for length, size in zip(lengths, 2 * list(figure.get_size_inches()), strict=False)]


def draw_frame(axes: "Axes3D", frame: Frame) -> None:
    """Draw one panel, lengths in mm."""
    arm = paper.whole_arm()  # routes and lengths are those of every set
    base = np.array([0.0, 0.0, float(frame.scene[grasp.STAGE])])
    start = 0.0
    index = 0
    for module in arm.modules:
        s = np.linspace(0.0, module.length, 160 if index else 30)
        poses = frame.arm.poses(start + s)
        centre = poses[:, :3, 3] + base
        axes.plot(*(1e3 * centre.T), color="black", lw=3, zorder=3)
        for muscle in module.muscles:
            path = centre + np.einsum("kij,kj->ki", poses[:, :3, :2], muscle.route(module.length, s / module.length)[:, :2])
            hot = frame.temperature[index] > COLD + 5.0
            axes.plot(*(1e3 * path.T), color="#D62728" if hot else "#2CA02C", lw=1.6 if muscle.turns == 0 else 1.1, zorder=4)
            index += 1
        if module is arm.modules[0]:
            angle = np.linspace(0.0, 2.0 * pi, 33)
            circle = paper.BENDING_OFFSET * np.column_stack([np.cos(angle), np.sin(angle)])
            for pose in poses[::6]:
                loop = pose[:3, 3] + base + circle @ pose[:3, :2].T
                axes.plot(*(1e3 * loop.T), color="#1F77B4", lw=0.9, zorder=2)
        start += module.length
    tip = frame.arm.tip_pose
    for side in (-1.0, 1.0):
        points = tip[:3, 3] + base + ring(paper.ring(), frame.gap, side) @ tip[:3, [0, 2]].T
        axes.plot(*(1e3 * points.T), color="black", lw=3, zorder=5, solid_capstyle="butt")
    draw_box(axes, frame.scene)
    table = 1e3 * paper.TABLE
    x, y = np.meshgrid([-9.0, 19.0], [-9.0, 9.0])
    axes.plot_surface(x, y, np.full_like(x, table), color="0.75", alpha=0.5, zorder=0)
    axes.set(xlim=(-14, 24), ylim=(-14, 14), zlim=(table + 3.0, -3.0))
    axes.set_box_aspect((38, 28, table + 6.0), zoom=1.12)
    axes.patch.set_alpha(0.0)
    axes.view_init(elev=14, azim=-72)
    axes.set_axis_off()


def draw_box(axes: "Axes3D", scene: Array) -> None:
    """Draw the object."""
    box, yaw = paper.OBJECT, scene[grasp.YAW]
    across, along = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    corners = [0.5 * (a * box.width * across + b * box.length * along) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))]
    outline = 1e3 * (scene[grasp.X : grasp.Z] + np.array(corners))
    low, high = (1e3 * (scene[grasp.Z] + sign * 0.5 * box.height) for sign in (1.0, -1.0))
    x, y = np.tile(outline[:, 0], (2, 1)), np.tile(outline[:, 1], (2, 1))
    axes.plot_surface(x, y, np.repeat([[low], [high]], 5, axis=1), color="#E69F00", alpha=0.9, zorder=4, linewidth=0)


def gaps(sequences: dict[str, list[Frame]]) -> list[str]:
    """Return a line for each case in which the arm found no equilibrium on its way to a panel."""
    lines = []
    for case, frames in sequences.items():
        stuck = [letter for letter, frame in zip("abcdefg", frames, strict=True) if not frame.converged]
        lines += [f"Fig. 6, {case}: on the way to panels {', '.join(stuck)}"] if stuck else []
    return lines


def agreement(sequences: dict[str, list[Frame]], laws: Iterable[TCA]) -> list[tuple[str, str, str, bool]]:
    """Return what Fig. 6 shows, case, what the model says and whether it holds."""
    rows, width = [], 1e3 * paper.OBJECT.width
    for (case, frames), law in zip(sequences.items(), laws, strict=True):
        grid = np.arange(COLD, SOFT_LIMIT + 2.5, 2.5)
        yaws = turns(law, grid)
        back = grid[1:][np.diff(yaws) >= 0.0]
        other = f", the other way up to {back.max():g} °C" if back.size else ""
        yaw, gap, lifted, moved = frames[1].yaw, 1e3 * frames[2].gap, frames[5].scene, frames[6].scene
        held, placed = bool(lifted[grasp.HELD]), moved[grasp.X] > 3e-3 and not moved[grasp.HELD]
        pinched = f"pinched with {1e3 * frames[4].pinch:.0f} mN, lifted" if held else "not held"
        rows += [
            ("Fig. 6: the twisting module turns the gripper, one way only", case,
             f"from {COLD:g} to {SOFT_LIMIT:g} °C by {yaws[-1] - yaws[0]:.0f}°{other}", back.size == 0),
            ("Fig. 6b: it aligns the gripper", case, f"yaw {yaw:.0f}° for an object at {OBJECT_YAW:.0f}°",
             abs(yaw - OBJECT_YAW) < 5.0),
            ("Fig. 6c: the gripper opens wider than the object", case, f"gap {gap:.1f} mm for {width:g} mm", gap > width),
            ("Fig. 6d-f: it pinches and lifts the object", case, pinched, held),
            ("Fig. 6g: it puts the object down elsewhere, at +x", case, f"put down at x = {1e3 * moved[grasp.X]:.1f} mm",
             bool(placed)),
        ]  # fmt: skip
    return rows
