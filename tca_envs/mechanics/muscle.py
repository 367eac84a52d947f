"""A muscle's place in the arm: its route in a module and its law."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.laws import KINDS, Law

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Muscle:
    """A muscle's route in its module, r(s) = offset (cos a, sin a, 0) with a = angle + 2 pi turns s/L, and its law.

    Parameters
    ----------
    offset : float
        Distance from the centerline [m].
    angle : float
        Angle at the module's base [rad].
    turns : float
        Helical turns over the module, signed; 0 is a straight muscle.
    law : Law
        `TCA`, `Tendon` or `Spring`.
    """

    offset: float
    angle: float
    turns: float
    law: Law

    def __post_init__(self) -> None:
        check.scalar("offset", self.offset, 0.0)
        check.scalar("angle", self.angle)
        check.scalar("turns", self.turns, -1000.0, 1000.0)
        if isinstance(self.law, type) or getattr(self.law, "kind", None) not in KINDS:
            raise ValueError(f"law = {self.law!r}: expected a muscle law such as TCA(), Tendon() or Spring(rate)")

    def route(self, length: float, fraction: ArrayLike) -> Array:
        """Return x, y [m] in the section and their derivatives in s, at s = fraction * length of a module; (..., 4)."""
        rate = 2.0 * np.pi * self.turns / length
        angle = self.angle + rate * length * np.asarray(fraction)
        x, y = self.offset * np.cos(angle), self.offset * np.sin(angle)
        return np.stack([x, y, -rate * y, rate * x], axis=-1)
