"""Surfaces to draw with: those of an arm in equilibrium, and boxes, balls, discs, coils and rings.

Plain arrays [m] in the base frame with the stage up, z down. A robot and a task say by them what there is to see; `render` and
`viewer` draw it. A surface of the same name keeps its triangles, so that only vertices move.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import cos, pi, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import TCA, Arm, Gripper
from tca_envs.mechanics.continuation import Lane
from tca_envs.mechanics.laws import REFERENCE_LENGTH
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT

Array = NDArray[np.float64]
Triangles = NDArray[np.int32]

CIRCLE = 20
"""Sides of a round body."""
RINGS = 25
"""Cross sections drawn of a module."""
TURN, FIBRE = 8, 5
"""Points of a coil's turn, sides of its fibre."""
PLATE_EDGE = 1.6e-3
"""How far the plates between which the coils hang reach beyond the coils' axes [m]: just outside of the coils."""
PLATE_THICKNESS = 0.8e-3
"""[m]."""
TABLE_HALF = 60.0 / 86.8
"""Half an edge of the table as a share of its depth under the base."""
BODY, RING, OBJECT = "#efe9dc", "#a9cbdc", "#2f7d55"
"""Colours of soft body, gripper and object ..."""
GOAL, DONE = "#2a9df4", "#43c97a"
"""... of a goal, and of one that is reached ..."""
METAL, RAIL, DEAD, TABLE = "#6b7280", "#cfd4da", "#b4b9c1", "#e9ecef"
"""... of stage and plates, column, dead weight and table."""
HEAT = np.array(
    [[13, 8, 135], [76, 2, 161], [126, 3, 168], [170, 35, 149], [204, 71, 120], [230, 108, 92], [248, 149, 64], [253, 197, 39]]
) / 255.0  # fmt: skip
"""Colours from cold to hot, evenly spaced: Matplotlib's "plasma" without its palest end."""


class Part(NamedTuple):
    """A surface."""

    vertices: Array
    """(v, 3) [m]."""
    normals: Array
    """(v, 3) of unit length, outwards."""
    triangles: Triangles
    """(t, 3) indices of vertices, counter-clockwise as seen from outside."""
    colour: str
    """Of what has no temperature."""
    temperature: float | None = None
    """Of a coil [degC]."""
    opacity: float = 1.0
    axis: Array = np.empty((0, 3))
    """(k, 3) the line along which a body, coil or ring is swept [m]."""


Parts = Mapping[str, Part]
"""What there is to see, by name."""


@dataclass(frozen=True)
class Coil:
    """How a TCA's fibre is wound; by default that of the measured ones, whose values are those of `TCA.untwist_gain`.

    Parameters
    ----------
    fibre_length : float
        Of the fibre in a 45 mm TCA [m].
    radius : float
        Of the fibre's centerline around the coil's axis [m].
    pitch_deg : float
        Angle of the fibre against the coil's cross section.
    """

    fibre_length: float = 144.5e-3
    radius: float = 0.3725e-3
    pitch_deg: float = 18.14

    @property
    def fibre_diameter(self) -> float:
        """[m]: C = l r^2 cos^2(alpha)/J with J = pi d^4/32, of which `TCA.compliance_gain` was measured (paper, eq. (23))."""
        lever = self.radius * cos(radians(self.pitch_deg))
        return float((32.0 / pi * self.fibre_length * lever**2 / TCA.compliance_gain) ** 0.25)

    def turns(self, rest_length: float) -> float:
        """Return how often a TCA of that rest length [m] winds around its axis."""
        return rest_length / REFERENCE_LENGTH * self.fibre_length * cos(radians(self.pitch_deg)) / (2.0 * pi * self.radius)

    def part(self, axis: Array, out: Array, turns: float, temperature: float) -> Part:
        """Return the fibre wound around a line.

        Parameters
        ----------
        axis : (k, 3) array
            The coil's axis, evenly in its turns [m].
        out : (k, 3) array
            Directions that are not along the axis, of any length.
        turns : float
            How often it winds.
        temperature : float
            [degC].
        """
        first, second = _around(axis, out)
        angle = 2.0 * pi * turns * np.linspace(0.0, 1.0, len(axis))[:, np.newaxis]
        radial = np.cos(angle) * first + np.sin(angle) * second
        fibre = axis + self.radius * radial
        outline = circle(0.5 * self.fibre_diameter, FIBRE)
        return sweep(fibre, *_around(fibre, radial), *outline, BODY)._replace(temperature=temperature, axis=axis)


MEASURED_COIL = Coil()


def arm_parts(arm: Arm, lane: Lane, winding: Coil = MEASURED_COIL) -> dict[str, Part]:
    """Return modules, plates at their ends and coils of an arm in equilibrium; drives are the coils' temperatures.

    They are "module K", "plate K top" and "plate K bottom", base to tip, and "coil K" for every TCA. A module is drawn with the
    round section that has its stiffness, EI/EA = radius^2/4.
    """
    turns = [winding.turns(module.rest_length(m)) for module in arm.modules for m in module.muscles]
    plate = plate_radius(arm)
    places, base, number = [], 0.0, 0
    for module in arm.modules:
        counts = [RINGS, *(round(TURN * turns[number + i]) + 1 for i in range(len(module.muscles)))]
        places += [np.minimum(base + module.length * np.linspace(0.0, 1.0, count), arm.length) for count in counts]
        base, number = base + module.length, number + len(module.muscles)
    poses = iter(np.split(arm.poses(lane, np.concatenate(places)), np.cumsum([s.size for s in places])[:-1]))
    result: dict[str, Part] = {}
    number = 0
    for k, module in enumerate(arm.modules):
        body = next(poses)
        radius = 2.0 * float(np.sqrt(module.stiffness[0] / module.stiffness[5]))
        result[f"module {k}"] = sweep(body[:, :3, 3], body[:, :3, 0], body[:, :3, 1], *circle(radius, CIRCLE), BODY)
        for end, pose in (("top", body[0]), ("bottom", body[-1])):
            result[f"plate {k} {end}"] = disc(pose, plate, PLATE_THICKNESS, METAL)
        for muscle in module.muscles:
            frames = next(poses)
            route = muscle.route(module.length, np.linspace(0.0, 1.0, len(frames)))[:, :2]
            out = np.einsum("kij,kj->ki", frames[:, :3, :2], route)
            result[f"coil {number}"] = winding.part(frames[:, :3, 3] + out, out, turns[number], float(lane.drive[number]))
            number += 1
    return result


def plate_radius(arm: Arm) -> float:
    """Return the radius [m] of plates between which all coils of an arm hang."""
    fractions = np.linspace(0.0, 1.0, RINGS)
    routes = [muscle.route(module.length, fractions)[:, :2] for module in arm.modules for muscle in module.muscles]
    return max(float(np.linalg.norm(route, axis=1).max()) for route in routes) + PLATE_EDGE


def ring_parts(mount: Array, ring: Gripper, section: tuple[float, float], gap: float = 0.0) -> dict[str, Part]:
    """Return the two halves of a ring, arcs of constant curvature with ends `gap` apart, as "ring 0" and "ring 1".

    Parameters
    ----------
    mount : (4, 4) array
        Pose of the arm's tip: the jaws open along its x axis, its z axis points to them.
    ring : Gripper
        Whose length is drawn.
    section : tuple of float
        Of the ring, radial and axial [m].
    gap : float
        [m].
    """
    half, bend = 0.5 * ring.length, _bend(gap / ring.length)
    arc = np.linspace(0.0, half, RINGS)
    outline = rectangle(0.5 * section[0], 0.5 * section[1])
    result: dict[str, Part] = {}
    for number, side in enumerate((-1.0, 1.0)):
        line, out = (_in(mount, part) for part in _arc(arc, bend / half, side))
        across = np.broadcast_to(side * mount[:3, 1], line.shape)
        result[f"ring {number}"] = sweep(line, out - mount[:3, 3], across, *outline, RING)
    return result


def ring_coil(mount: Array, ring: Gripper, gap: float, temperature: float, winding: Coil = MEASURED_COIL) -> Part:
    """Return the coil around a ring, see `ring_parts`, at a temperature [degC]."""
    half, bend = 0.5 * ring.length, _bend(gap / ring.length)
    turns = winding.turns(ring.rest_length)
    fine = np.linspace(0.0, half, round(TURN * turns / 2.0) + 1)
    lines, outs = zip(*(_arc(fine, bend / half, side) for side in (-1.0, 1.0)), strict=True)
    line = _in(mount, np.concatenate([lines[0][:0:-1], lines[1]]))
    out = _in(mount, np.concatenate([outs[0][:0:-1], outs[1]])) - mount[:3, 3]
    return winding.part(line + ring.offset * out, out, turns, temperature)


def site_parts(floor: float, lowered: float = 0.0) -> dict[str, Part]:
    """Return the "stage", `lowered` so far [m], its "column", and the "table" at the depth `floor` [m]."""
    edge, deep, thick = 10e-3, 26e-3, 1.2e-3
    half = floor * TABLE_HALF
    return {
        "stage": box(
            np.array([0.0, 0.5 * (edge - deep), lowered - thick - PLATE_THICKNESS]), (edge, 0.5 * (deep + edge), thick), METAL
        ),
        "column": box(np.array([0.0, -deep, 0.5 * floor - 7e-3]), (2.5e-3, 2.5e-3, 0.5 * floor + 7e-3), RAIL),
        "table": box(np.array([0.0, 0.0, floor + 1e-3]), (half, half, 1e-3), TABLE),
    }


def sweep(line: Array, first: Array, second: Array, outline: Array, facing: Array, colour: str) -> Part:
    """Return the surface of an outline that is moved along a line, with its end faces.

    Parameters
    ----------
    line : (k, 3) array
        [m].
    first, second : (k, 3) arrays
        Axes of the outline along it; first x second points along the line.
    outline, facing : (m, 2) arrays
        A closed polygon, counter-clockwise [m], and its normals.
    colour : str
        Its colour.
    """

    def placed(flat: Array) -> Array:
        return flat[:, 0, np.newaxis] * first[:, np.newaxis] + flat[:, 1, np.newaxis] * second[:, np.newaxis]

    vertices, normals = line[:, np.newaxis] + placed(outline), placed(facing)
    along = np.cross(first[[0, -1]], second[[0, -1]]) * [[-1.0], [1.0]]
    ends = np.broadcast_to(along[:, np.newaxis], vertices[[0, -1]].shape)
    return Part(
        np.concatenate([vertices.reshape(-1, 3), vertices[[0, -1]].reshape(-1, 3)]),
        np.concatenate([normals.reshape(-1, 3), ends.reshape(-1, 3)]),
        _sweep_triangles(len(line), len(outline)),
        colour,
        axis=line,
    )


def rod(start: Array, end: Array, radius: float, colour: str) -> Part:
    """Return a round rod between two poses (4, 4) [m] that face along it."""
    line = np.stack([start[:3, 3], end[:3, 3]])
    first, second = (np.broadcast_to(start[:3, i], (2, 3)) for i in (0, 1))
    return sweep(line, first, second, *circle(radius, CIRCLE), colour)


def disc(pose: Array, radius: float, thickness: float, colour: str) -> Part:
    """Return a flat cylinder across a pose (4, 4), `thickness` towards its -z [m]."""
    line = pose[:3, 3] + np.array([[-thickness], [0.0]]) * pose[:3, 2]
    first, second = (np.broadcast_to(pose[:3, i], (2, 3)) for i in (0, 1))
    return sweep(line, first, second, *circle(radius, 2 * CIRCLE), colour)


def box(centre: Array, half: tuple[float, float, float], colour: str, turn: float = 0.0) -> Part:
    """Return a box of half edges `half` around `centre` (3,) [m], turned by `turn` about z [rad]."""
    line = centre + np.array([[0.0, 0.0, -half[2]], [0.0, 0.0, half[2]]])
    x, y = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
    first, second = (np.broadcast_to(axis, (2, 3)) for axis in (x, y))
    return sweep(line, first, second, *rectangle(half[0], half[1]), colour)


def ball(centre: Array, radius: float, colour: str, opacity: float) -> Part:
    """Return a sphere."""
    directions, triangles = _sphere()
    return Part(centre + radius * directions, directions, triangles, colour, opacity=opacity)


def moved(part: Part, shift: Array) -> Part:
    """Return a part elsewhere, by `shift` (3,) [m]."""
    return part._replace(vertices=part.vertices + shift, axis=part.axis + shift)


@cache
def circle(radius: float, sides: int) -> tuple[Array, Array]:
    """Return the outline (sides, 2) of a round section [m] and its normals."""
    angle = np.linspace(0.0, 2.0 * pi, sides, endpoint=False)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return radius * normals, normals


@cache
def rectangle(x: float, y: float) -> tuple[Array, Array]:
    """Return the outline (8, 2) of a rectangle of half edges x, y [m], each corner twice, and its normals."""
    corners = np.array([[x, -y], [x, y], [-x, y], [-x, -y]])
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return sides.reshape(8, 2), np.repeat(normals, 2, axis=0)


@cache
def _sweep_triangles(rings: int, sides: int) -> Triangles:
    """Return quadrilaterals between neighbouring outlines, each two triangles, and fans over the two ends."""
    here = np.arange((rings - 1) * sides).reshape(rings - 1, sides)
    beside = np.roll(here, -1, axis=1)
    quads = np.stack([here, beside, beside + sides, here, beside + sides, here + sides], axis=-1).reshape(-1, 3)
    fan = np.arange(1, sides - 1)
    fan = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    result = np.concatenate([quads, rings * sides + fan[:, ::-1], (rings + 1) * sides + fan]).astype(np.int32)
    result.setflags(write=False)
    return result


@cache
def _sphere() -> tuple[Array, Triangles]:
    """Return directions and triangles of a sphere, with its poles as bands of no size."""
    sides, bands = 24, 12
    polar, angle = np.linspace(0.0, pi, bands + 1), np.linspace(0.0, 2.0 * pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
    directions = np.sin(polar)[:, np.newaxis, np.newaxis] * ring - np.cos(polar)[:, np.newaxis, np.newaxis] * [0.0, 0.0, 1.0]
    directions = directions.reshape(-1, 3)
    directions.setflags(write=False)
    return directions, _sweep_triangles(bands + 1, sides)[: 2 * sides * bands]


def _around(line: Array, out: Array) -> tuple[Array, Array]:
    """Return unit vectors (k, 3) across a line: first as near to `out` as can be, first x second along the line."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = out - np.sum(out * tangent, axis=1, keepdims=True) * tangent
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(tangent, first)


def _in(pose: Array, points: Array) -> Array:
    """Return points (..., 3) of a pose's frame in the base frame."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _arc(along: Array, curvature: float, side: float) -> tuple[Array, Array]:
    """Return points (k, 3) of a half ring from its mount, and directions out of it, in the mount's frame."""
    angle = curvature * along
    flat = np.zeros(along.size)
    line = np.stack([side * np.sin(angle) / curvature, flat, (1.0 - np.cos(angle)) / curvature], axis=1)
    return line, np.stack([side * np.sin(angle), flat, -np.cos(angle)], axis=1)


def _bend(share: float) -> float:
    """Return the angle in (0, pi] of an arc whose end is `share` of its length off its mount's axis: sin(a)/a = share."""
    angle = pi
    for _ in range(60):  # from pi, where sin(a)/a falls towards 0; its slope there is -1/pi
        slope = (angle * np.cos(angle) - np.sin(angle)) / angle**2
        angle -= (np.sin(angle) / angle - share) / slope
    return float(angle)


def heat_colour(temperature: Array | float) -> Array:
    """Return colours (..., 3), red, green and blue from 0 to 1, of coils at temperatures (...) [degC]: 25 to 160 degC."""
    share = (np.asarray(temperature) - AMBIENT) / (HARD_LIMIT - AMBIENT)
    at = np.linspace(0.0, 1.0, len(HEAT))
    return np.stack([np.interp(share, at, HEAT[:, i]) for i in range(3)], axis=-1)
