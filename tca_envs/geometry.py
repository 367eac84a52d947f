"""What there is to see of a lane: surfaces of arm, coils, gripper, object, goal and stage, from the solver's own shape.

Plain arrays [m] in the base frame with the stage up, z down; `render` and `viewer` draw them. A surface of the same name keeps
its triangles, so that only vertices move.
"""

from functools import cache
from math import cos, hypot, pi, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs import batch, presets
from tca_envs.mechanics import Arm, grasp
from tca_envs.mechanics.ladder import Lane
from tca_envs.mechanics.muscle import REFERENCE_LENGTH
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.tasks import pick_and_place, reach, twist_align
from tca_envs.tasks.core import Core, Record
from tca_envs.tasks.task import Task

Array = NDArray[np.float64]
Triangles = NDArray[np.int32]

CIRCLE = 20
"""Sides of a round body."""
RINGS = 25
"""Cross sections drawn of a module."""
TURN, FIBRE = 8, 5
"""Points of a coil's turn, sides of its fibre."""
PLATE = 5.6e-3
"""Radius of the plates between which the coils hang [m]: just outside of them."""
PLATE_THICKNESS = 0.8e-3
"""[m]."""
HALF_OBJECT = (0.5 * presets.OBJECT.width, 0.5 * presets.OBJECT.length, 0.5 * presets.OBJECT.height)
"""Half edges of the object [m]."""
TABLE_HALF = 60e-3
"""Half an edge of the table [m]."""
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


def parts(task: Task, core: Core, lane: int = 0) -> dict[str, Part]:
    """Return all that is to be seen of a lane, by name.

    Parameters
    ----------
    task : Task
        Of the lane.
    core : Core
        Holds it.
    lane : int
        Which one.

    Returns
    -------
    dict of str to Part
        "module K" and "plate K" base to tip, "coil K" for every TCA of the arm, gripper's parts ("ring 0", "ring 1", and
        "gripper coil" where it is heated), "object", "goal" and what else marks it, "stage", "column" and "table".
    """
    record = core.record.rows(np.array([lane]))
    down = np.array([0.0, 0.0, record.scene[0, grasp.STAGE] if record.scene.size else 0.0])
    result = arm_parts(core.arm, Lane(record.strain[0], record.tension[0], record.drive[0], record.load[0]))
    result |= _below(task, record)
    result = {name: moved(part, down) for name, part in result.items()}
    result |= _goal(task, record) | site_parts(float(down[2]))
    if isinstance(task, pick_and_place.PickAndPlace):
        result["object"] = box(
            record.scene[0, grasp.X : grasp.Z + 1], HALF_OBJECT, OBJECT, turn=float(record.scene[0, grasp.YAW])
        )
    return result


def arm_parts(arm: Arm, lane: Lane) -> dict[str, Part]:
    """Return modules, plates at their ends and coils of an arm in equilibrium; drives are the coils' temperatures.

    A module is drawn with the round section that has its stiffness, EI/EA = radius^2/4.
    """
    turns = [coil_turns(module.rest_length(m)) for module in arm.modules for m in module.muscles]
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
            result[f"plate {k} {end}"] = disc(pose, PLATE, PLATE_THICKNESS, METAL)
        for muscle in module.muscles:
            frames = next(poses)
            route = module.route(muscle, np.linspace(0.0, 1.0, len(frames)))[:, :2]
            out = np.einsum("kij,kj->ki", frames[:, :3, :2], route)
            result[f"coil {number}"] = coil(frames[:, :3, 3] + out, out, turns[number], float(lane.drive[number]))
            number += 1
    return result


def ring_parts(mount: Array, gap: float, temperature: float | None) -> dict[str, Part]:
    """Return the gripper's two halves, arcs of constant curvature with ends `gap` apart, and its coil if it has a temperature.

    Parameters
    ----------
    mount : (4, 4) array
        Pose of the arm's tip: the jaws open along its x axis, its z axis points to them.
    gap : float
        [m].
    temperature : float, optional
        Of the gripper's TCA [degC].
    """
    half = 0.5 * presets.GRIPPER_LENGTH
    bend = _bend(gap / (2.0 * half))
    arc = np.linspace(0.0, half, RINGS)
    outline = rectangle(0.5 * presets.GRIPPER_THICKNESS, 0.5 * presets.GRIPPER_WIDTH)
    result: dict[str, Part] = {}
    paths: list[tuple[Array, Array]] = []
    for number, side in enumerate((-1.0, 1.0)):
        line, out = (_in(mount, part) for part in _arc(arc, bend / half, side))
        outwards = out - mount[:3, 3]
        across = np.broadcast_to(side * mount[:3, 1], line.shape)
        result[f"ring {number}"] = sweep(line, outwards, across, *outline, RING)
        paths.append((line, outwards))
    if temperature is not None:
        rest = presets.gripper().rest_length
        count = round(TURN * coil_turns(rest) / 2.0)
        fine = np.linspace(0.0, half, count + 1)
        lines, outs = zip(*(_arc(fine, bend / half, side) for side in (-1.0, 1.0)), strict=True)
        line = _in(mount, np.concatenate([lines[0][:0:-1], lines[1]]))
        out = _in(mount, np.concatenate([outs[0][:0:-1], outs[1]])) - mount[:3, 3]
        result["gripper coil"] = coil(line + presets.GRIPPER_OFFSET * out, out, coil_turns(rest), temperature)
    return result


def site_parts(lowered: float) -> dict[str, Part]:
    """Return stage, its column and the table; the stage is `lowered` so far [m]."""
    edge, deep, thick = 10e-3, 26e-3, 1.2e-3
    top = presets.SITE.table
    return {
        "stage": box(
            np.array([0.0, 0.5 * (edge - deep), lowered - thick - PLATE_THICKNESS]), (edge, 0.5 * (deep + edge), thick), METAL
        ),
        "column": box(np.array([0.0, -deep, 0.5 * top - 7e-3]), (2.5e-3, 2.5e-3, 0.5 * top + 7e-3), RAIL),
        "table": box(np.array([0.0, 0.0, top + 1e-3]), (TABLE_HALF, TABLE_HALF, 1e-3), TABLE),
    }


def coil_turns(rest_length: float) -> float:
    """Return how often a TCA of that rest length [m] winds around its axis."""
    pitch_angle = radians(presets.COIL_PITCH_DEG)
    return rest_length / REFERENCE_LENGTH * presets.FIBRE_LENGTH * cos(pitch_angle) / (2.0 * pi * presets.COIL_RADIUS)


def coil(axis: Array, out: Array, turns: float, temperature: float) -> Part:
    """Return a fibre wound around a line.

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
    fibre = axis + presets.COIL_RADIUS * radial
    outline = circle(0.5 * presets.FIBRE_DIAMETER, FIBRE)
    part = sweep(fibre, *_around(fibre, radial), *outline, BODY)
    return part._replace(temperature=temperature, axis=axis)


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


def _below(task: Task, record: Record) -> dict[str, Part]:
    """Return what hangs from the arm's tip."""
    tip = record.tip[0]
    if isinstance(task, pick_and_place.PickAndPlace):
        gap = float(task.gap(record)[0])
        if record.scene[0, grasp.HELD] + record.scene[0, grasp.ASTRIDE]:
            gap = max(gap, presets.OBJECT.width)
        return ring_parts(tip, gap, float(record.temperature[0, 4]))
    if isinstance(task, twist_align.TwistAlign):
        return ring_parts(tip, 0.0, None)
    beyond = tip.copy()  # Reach: twisting module and gripper are a rigid body
    beyond[:3, 3] += presets.TWISTING_LENGTH * tip[:3, 2]
    line = np.stack([tip[:3, 3], beyond[:3, 3]])
    first, second = (np.broadcast_to(tip[:3, i], (2, 3)) for i in (0, 1))
    body = sweep(line, first, second, *circle(0.5 * presets.BODY_DIAMETER, CIRCLE), DEAD)
    return {"dead weight": body} | {name: part._replace(colour=DEAD) for name, part in ring_parts(beyond, 0.0, None).items()}


def _goal(task: Task, record: Record) -> dict[str, Part]:
    """Return the goal as a ghost."""
    goal = record.goal[0]
    place = 1e-2 * goal[:3]
    colour = DONE if batch.outcome(task, task.achieved(record)[0], goal).success else GOAL
    if isinstance(task, pick_and_place.PickAndPlace):
        ghost = box(place, HALF_OBJECT, colour, turn=float(record.scene[0, grasp.YAW]))
        spot = np.eye(4)
        spot[:3, 3] = place[0], place[1], presets.SITE.table - 0.1e-3
        return {
            "goal": ghost._replace(opacity=0.55),
            "goal place": disc(spot, 1e-2 * pick_and_place.SUCCESS_CM, 0.1e-3, colour)._replace(opacity=0.6),
        }
    if isinstance(task, twist_align.TwistAlign):
        pose = np.eye(4)
        c, s = goal[3:5] / hypot(*goal[3:5])
        pose[:2, :2] = (c, -s), (s, c)
        pose[:3, 3] = place
        ghost_ring = ring_parts(pose, 0.0, None)
        return {
            "goal": ball(place, 1e-2 * twist_align.SUCCESS_CM, colour, 0.6),
            **{f"goal {name}": part._replace(colour=colour, opacity=0.5) for name, part in ghost_ring.items()},
        }
    return {"goal": ball(place, 1e-2 * reach.SUCCESS_CM, colour, 0.9), "goal halo": ball(place, PLATE, colour, 0.4)}


def heat_colour(temperature: Array | float) -> Array:
    """Return colours (..., 3), red, green and blue from 0 to 1, of coils at temperatures (...) [degC]: 25 to 160 degC."""
    share = (np.asarray(temperature) - AMBIENT) / (HARD_LIMIT - AMBIENT)
    at = np.linspace(0.0, 1.0, len(HEAT))
    return np.stack([np.interp(share, at, HEAT[:, i]) for i in range(3)], axis=-1)
