"""Grasping: a box, the jaws that pinch it, a table under it, and the stage that lowers the arm; for N lanes at once.

Quasi-static like the arm: nothing swings, bounces or rolls. z points down. Jaws are vertical and open along their heading;
a box has a yaw modulo 180 degrees. All functions are pure.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import check

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE, X, Y, Z, YAW, HELD, ASTRIDE, TOUCHED, ALONG, DROP, LOW = range(11)
"""Columns of a scene: how far the stage is lowered [m]; the box's centre [m] and yaw [rad]; whether the jaws hold it,
whether it stands between them, whether they touch it or surround it in any way (0 or 1); of a held box, its place along the
jaws' width and below the jaws [m]; whether the jaws are lower than the top of a box on the table (0 or 1)."""
SCENE = 11
CONTACT = 1e-6
"""Jaws nearer to the top of a box than this stand on it [m]."""


@dataclass(frozen=True)
class Box:
    """What is grasped.

    Parameters
    ----------
    width, length, height : float
        [m]; the jaws pinch the width.
    mass : float
        [kg].
    friction : float
        Coefficient between jaw and box.
    """

    width: float
    length: float
    height: float
    mass: float
    friction: float

    def __post_init__(self) -> None:
        for name in ("width", "length", "height", "mass", "friction"):
            check.scalar(name, getattr(self, name), 0.0, above=True)


@dataclass(frozen=True)
class Site:
    """Where it is grasped.

    Parameters
    ----------
    table : float
        Depth of the table under the base when the stage is up [m].
    travel : float
        How far the stage lowers the base [m].
    jaw_width, jaw_thickness : float
        Of one jaw, across and along its heading [m].
    gravity : float
        [m/s2].
    """

    table: float
    travel: float
    jaw_width: float
    jaw_thickness: float
    gravity: float

    def __post_init__(self) -> None:
        for name in ("table", "travel", "jaw_width", "jaw_thickness", "gravity"):
            check.scalar(name, getattr(self, name), 0.0, above=True)


def resting(box: Box, site: Site) -> float:
    """Return the depth of the centre of a box on the table [m]."""
    return site.table - 0.5 * box.height


def holds(pinch: Array, box: Box, site: Site) -> Mask:
    """Return whether friction of two jaws pressing with `pinch` (N,) [N] carries the box: 2 mu N >= m g."""
    return np.asarray(2.0 * box.friction * pinch >= box.mass * site.gravity)


def half_extents(turn: Array, box: Box) -> tuple[Array, Array]:
    """Return half of what a box turned by `turn` (N,) [rad] against the jaws takes up along their heading and across [m]."""
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    return 0.5 * (box.width * c + box.length * s), 0.5 * (box.width * s + box.length * c)


def largest_turn(gap: Array, box: Box) -> Array:
    """Return the largest turn [rad] of a box between jaws `gap` (N,) [m] apart: width cos + length sin = gap; 0 if pinched."""
    diagonal = np.hypot(box.width, box.length)
    inside = np.clip(gap, box.width, diagonal)
    return np.where(gap >= diagonal, 0.5 * np.pi, np.arcsin(inside / diagonal) - np.arctan2(box.width, box.length))


def between_jaws(poses: Array, depth: float) -> Array:
    """Return the points between the jaws (..., 3) [m] of a gripper whose mount has `poses` (..., 4, 4): `depth` below it."""
    return np.asarray(poses[..., :3, 3] + depth * poses[..., :3, 2])


def in_mount(scene: Array, poses: Array) -> Array:
    """Return the centres of boxes (..., 3) [m] in the frames of the gripper mounts, `poses` (..., 4, 4) with the stage up."""
    away = scene[..., X : Z + 1] - poses[..., :3, 3]
    away[..., 2] -= scene[..., STAGE]
    return np.asarray(np.einsum("...ij,...i->...j", poses[..., :3, :3], away))


def half_turn(angle: Array) -> Array:
    """Return angles [rad] modulo 180 degrees, in [-pi/2, pi/2)."""
    return (angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi


def step(scene: Array, tool: Array, heading: Array, gap: Array, pinch: Array, lowering: Array, box: Box, site: Site) -> Array:
    """Move the stage and let jaws, box and table act on each other.

    The stage stops where the jaws or a held box meet the table, and where the jaws come down on a box that does not fit
    between them; it gives way where the arm sinks further. A box is between the jaws as long as its centre is within their
    width. Closing jaws push it to their middle and turn it into line; pinched firmly enough it is held and moves with them,
    otherwise it falls straight down.

    Parameters
    ----------
    scene : (N, SCENE) array
        Before.
    tool : (N, 3) array
        Point between the jaws' ends, with the stage up [m].
    heading : (N,) array
        Direction in which the jaws open [rad].
    gap : (N,) array
        Distance of the jaws without a box [m].
    pinch : (N,) array
        Force of a jaw on a box between them [N], see `Gripper.pinch`.
    lowering : (N,) array
        How far the stage is asked to go down [m].
    box, site : Box, Site
        What and where.

    Returns
    -------
    (N, SCENE) array
        After.
    """
    after = scene.copy()
    held, firm, rest = scene[:, HELD] > 0.5, holds(pinch, box, site), resting(box, site)
    top = rest - 0.5 * box.height
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = scene[:, X] - tool[:, 0], scene[:, Y] - tool[:, 1]
    across, along = c * dx + s * dy, c * dy - s * dx  # of the box's centre, in the jaws' frame
    turn = half_turn(scene[:, YAW] - heading)
    reach, extent = half_extents(turn, box)

    # The stage and its stops.
    above = ~held & (scene[:, LOW] < 0.5)
    met = np.abs(along) < 0.5 * site.jaw_width + extent
    met &= np.abs(across) < 0.5 * gap + site.jaw_thickness + reach
    under = above & met
    fits = np.abs(across) + reach <= 0.5 * gap
    stop = site.table - tool[:, 2]
    stop = np.where(held, np.minimum(stop, rest - scene[:, DROP] - tool[:, 2]), stop)
    blocked = under & ~fits
    stop = np.where(blocked, np.minimum(stop, top - tool[:, 2]), stop)
    stage = np.clip(scene[:, STAGE] + lowering, 0.0, np.clip(stop, 0.0, site.travel))
    jaws = tool[:, 2] + stage
    low = (jaws > top) & ~blocked

    # A box on the table between the jaws: it was there, they come down around it, or they let it go there.
    kept = held & firm
    astride = np.where(held, ~firm, (scene[:, ASTRIDE] > 0.5) | (under & fits))
    astride &= low & (np.abs(along) <= 0.5 * site.jaw_width)
    most = largest_turn(gap, box)
    turn = np.where(astride, np.clip(turn, -most, most), turn)
    play = np.maximum(0.5 * gap - half_extents(turn, box)[0], 0.0)
    across = np.where(astride, np.clip(across, -play, play), across)
    caught = astride & (gap <= box.width) & firm

    # A held box is carried; a lost one falls.
    along = np.where(kept, scene[:, ALONG], along)
    across = np.where(kept, 0.0, across)
    turn = np.where(kept, 0.0, turn)
    moved = kept | astride
    after[:, STAGE] = stage
    after[:, X] = np.where(moved, tool[:, 0] + c * across - s * along, scene[:, X])
    after[:, Y] = np.where(moved, tool[:, 1] + s * across + c * along, scene[:, Y])
    after[:, Z] = np.where(kept, np.minimum(jaws + scene[:, DROP], rest), rest)
    after[:, YAW] = np.where(moved, half_turn(heading + turn), scene[:, YAW])
    after[:, HELD] = kept | caught
    after[:, ASTRIDE] = astride & ~caught
    after[:, TOUCHED] = kept | caught | (met & (jaws > top - CONTACT))
    after[:, ALONG] = np.where(kept | caught, along, 0.0)
    after[:, LOW] = low
    after[:, DROP] = np.where(kept, scene[:, DROP], np.where(caught, rest - jaws, 0.0))
    return after
