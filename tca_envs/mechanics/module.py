"""A module: a soft rod with muscles in it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.grid import legendre_nodes
from tca_envs.mechanics.muscle import Muscle

Array = NDArray[np.float64]

STRAIGHT = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""Strain of a straight unloaded rod."""
MOST_MUSCLES = 32
"""Of a module: a few iterations of Newton still fit into a second."""


@dataclass(frozen=True, eq=False)
class Module:
    """A soft rod with muscles in it.

    Parameters
    ----------
    length : float
        Length of the unloaded centerline [m].
    stiffness : (6,) array
        Diagonal of K: EI_x, EI_y, GJ [N m2], GA, GA, EA [N], eq. (3).
    mass_per_length : float
        [kg/m].
    muscles : sequence of Muscle
        Each runs from the module's base to its end.
    reference_strain : (6,) array
        xi* = [u*; v*], uniform: strain of the unloaded rod [1/m, 1].

    Raises
    ------
    ValueError
        For a non-positive length or stiffness, a negative mass, non-finite numbers, wrong shapes, or a muscle whose path
        shrinks to a point in the unloaded rod.
    """

    length: float
    stiffness: Array
    mass_per_length: float = 0.0
    muscles: Sequence[Muscle] = ()
    reference_strain: Array = field(default_factory=lambda: np.array(STRAIGHT))

    def __post_init__(self) -> None:
        object.__setattr__(self, "length", check.scalar("length", self.length, 0.0, above=True))
        stiffness = check.array("stiffness", self.stiffness, (6,))
        if not (stiffness > 0.0).all():
            raise ValueError(f"stiffness = {self.stiffness!r}: expected six positive numbers EI_x, EI_y, GJ, GA, GA, EA")
        reference = check.array("reference_strain", self.reference_strain, (6,))
        if not reference[5] > 0.0:
            raise ValueError(f"reference_strain = {self.reference_strain!r}: expected v*_z > 0, the rod's own direction")
        object.__setattr__(self, "mass_per_length", check.scalar("mass_per_length", self.mass_per_length, 0.0))
        try:
            muscles = tuple(self.muscles)
        except TypeError:
            raise ValueError(f"muscles = {self.muscles!r}: expected a sequence of Muscle") from None
        for i, muscle in enumerate(muscles):
            if not isinstance(muscle, Muscle):
                raise ValueError(f"muscles[{i}] = {muscle!r}: expected a Muscle")
        if len(muscles) > MOST_MUSCLES:
            raise ValueError(f"muscles = {self.muscles!r}: expected at most {MOST_MUSCLES} in a module")
        for values in (stiffness, reference):
            values.setflags(write=False)
        object.__setattr__(self, "stiffness", stiffness)
        object.__setattr__(self, "reference_strain", reference)
        object.__setattr__(self, "muscles", muscles)
        fractions = np.linspace(0.0, 1.0, 181)
        for i, muscle in enumerate(muscles):
            shortest = self._stretch(muscle, fractions).min()
            if not shortest > 1e-3:
                raise ValueError(
                    f"muscles[{i}] = {muscle!r}: expected a path that runs along the module; with reference_strain "
                    f"{reference.tolist()} it shrinks to {shortest:.3g} m per metre of centerline"
                )

    @classmethod
    def cylinder(
        cls,
        length: float,
        diameter: float,
        youngs_modulus: float,
        shear_modulus: float,
        mass: float = 0.0,
        muscles: Sequence[Muscle] = (),
        curvature: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "Module":
        """Return a module of round section: EI = E pi d^4/64, GJ = G pi d^4/32, GA, EA with A = pi d^2/4.

        Parameters
        ----------
        length, diameter : float
            [m].
        youngs_modulus, shear_modulus : float
            [Pa].
        mass : float
            Of the whole module [kg].
        muscles : sequence of Muscle
            Each runs from the module's base to its end.
        curvature : (3,) array
            u* [1/m]: curvature of the unloaded rod about x, y and its twist.
        """
        length = check.scalar("length", length, 0.0, above=True)
        diameter = check.scalar("diameter", diameter, 0.0, above=True)
        e = check.scalar("youngs_modulus", youngs_modulus, 0.0, above=True)
        g = check.scalar("shear_modulus", shear_modulus, 0.0, above=True)
        mass = check.scalar("mass", mass, 0.0)
        u = check.array("curvature", curvature, (3,))
        area, inertia = np.pi * diameter**2 / 4.0, np.pi * diameter**4 / 64.0
        stiffness = np.array([e * inertia, e * inertia, 2.0 * g * inertia, g * area, g * area, e * area])
        return cls(length, stiffness, mass / length, muscles, np.array([*u, 0.0, 0.0, 1.0]))

    def _stretch(self, muscle: Muscle, fractions: Array) -> Array:
        """Return |p_a'| of the unloaded rod, eq. (13)."""
        x, y, dx, dy = muscle.route(self.length, fractions).T
        u, v = self.reference_strain[:3], self.reference_strain[3:]
        return np.linalg.norm([v[0] - u[2] * y + dx, v[1] + u[2] * x + dy, v[2] + u[0] * y - u[1] * x], axis=0)

    def rest_length(self, muscle: Muscle) -> float:
        """Return the path length of a muscle in the unloaded rod [m], l* of eq. (24), by Gauss quadrature."""
        points, weights = legendre_nodes(64)
        return 0.5 * self.length * float(weights @ self._stretch(muscle, 0.5 * (points + 1.0)))
