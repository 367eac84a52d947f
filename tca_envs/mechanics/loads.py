"""Loads: what pulls on an arm from outside."""

from dataclasses import dataclass

from tca_envs.mechanics import check

FORCE, MOMENT, GRAVITY, MASS, CENTRE = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
"""Parts of a load (..., SIZE): tip force [N] and moment [N m] in the global frame, gravity [m/s2], payload mass [kg] and its
centre in the tip's frame [m]."""
PAYLOAD = slice(9, 13)
"""Mass and centre."""
SIZE = 13


@dataclass(frozen=True)
class Payload:
    """A rigid body that hangs from the tip.

    Parameters
    ----------
    mass : float
        [kg].
    centre : (3,) tuple
        Its centre of mass in the frame of the arm's last cross section [m].
    """

    mass: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check.scalar("mass", self.mass, 0.0)
        check.array("centre", self.centre, (3,))
