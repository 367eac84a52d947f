"""The rungs of the ladder of methods, and the numbers on which all of them agree."""

from enum import IntEnum


class Rung(IntEnum):
    """Which rung of the ladder answered; each is tried where the one before fails."""

    WARM = 0
    """Newton straight from the start."""
    SUBSTEPS = 1
    """Newton in substeps of drive and load."""
    FINER = 2
    """The same on a grid of twice the elements."""
    DESCENT = 3
    """The start's branch ends: a fall down the hill of the total energy, and on from there."""
    FAILED = 4
    """None."""


NEUTRAL = 1e-5
"""Smallest eigenvalues of the tangent (see `Equilibrium.stability`) above minus this are neutral, not unstable: an arm that can
turn about an axis of symmetry without any work has a zero among them, up to the grid's error. Newton adds so many times the
rod's stiffness to the tangent, or it would be singular there."""
SMALLEST_SUBSTEP = 1.0 / 1024.0
"""As a share of the way: where a shorter one would be needed the branch of equilibria ends."""
