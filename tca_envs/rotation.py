"""How far poses are turned about the vertical."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def yaw(poses: Array) -> tuple[Array, Array]:
    """Return cosine and sine (...) of the turn of poses (..., 4, 4) about z.

    It is the twist of the swing-twist decomposition: what remains when the tilt is undone the shortest way. It does not jump,
    for tilts below 180 degrees.
    """
    c, s = poses[..., 0, 0] + poses[..., 1, 1], poses[..., 1, 0] - poses[..., 0, 1]
    norm = np.hypot(c, s)
    return c / norm, s / norm


def yaw_angle(poses: Array) -> Array:
    """Return that turn as an angle (...) [rad] in (-pi, pi]."""
    cosine, sine = yaw(poses)
    return np.arctan2(sine, cosine)
