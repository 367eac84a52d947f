"""The gripper: a soft ring that its TCA opens, apart from the arm.

The ring is cut opposite to where it is mounted; its two ends are the jaws. The TCA runs around the outside, so that its
contraction takes curvature away and the jaws part. It is small and light: gravity and the arm's motion do not change its
shape, and each half is a rod of constant curvature, mounted at one end.
"""

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.arm import Arm
from tca_envs.mechanics.laws import TCA, coil
from tca_envs.mechanics.module import Module
from tca_envs.mechanics.muscle import Muscle
from tca_envs.mechanics.solver import compiled

Array = NDArray[np.float64]

ITERATIONS = 50


@compiled
def ring_tension(law, length, rest_length, compliance, temperature, tension):
    """Write the tension of the ring's muscle [N] at each temperature.

    Without load the strain is uniform, K (xi - xi*) = -F [r x t; t], and the path changes by -F length compliance with
    compliance = 1/EA + r^2/EI. So elongation(F, T) + F length compliance = 0, which rises with F and bends down: Newton from
    F = 0 comes from the left and cannot overshoot. For F < 0 (slack) the law is linear and one step is exact.
    """
    for i in range(tension.size):
        force = 0.0
        for _ in range(ITERATIONS):
            delta, softness, _ = coil(law, 0, rest_length, force, temperature[i])
            step = (delta + force * length * compliance) / (softness + length * compliance)
            force -= step
            if abs(step) < 1e-14:
                break
        tension[i] = force


@dataclass(frozen=True)
class Gripper:
    """A ring of length L, precurved to a full circle, with a TCA at `offset` outside its centerline.

    Parameters
    ----------
    length : float
        L [m].
    bending_stiffness, axial_stiffness : float
        EI [N m2] in the ring's plane, EA [N].
    offset : float
        Distance of the TCA from the centerline [m].
    law : TCA
        The muscle.

    Raises
    ------
    ValueError
        For numbers that are not positive, or a law that is no TCA.
    """

    length: float
    bending_stiffness: float
    axial_stiffness: float
    offset: float
    law: TCA

    def __post_init__(self) -> None:
        for name in ("length", "bending_stiffness", "axial_stiffness", "offset"):
            check.scalar(name, getattr(self, name), 0.0, above=True)
        if not isinstance(self.law, TCA):
            raise ValueError(f"law = {self.law!r}: expected a TCA")

    @property
    def radius(self) -> float:
        """Radius of the closed ring's centerline [m]."""
        return self.length / (2.0 * pi)

    @property
    def rest_length(self) -> float:
        """Path length of the TCA around the closed ring [m]."""
        return self.length * (1.0 + self.offset / self.radius)

    def tension(self, temperature: ArrayLike) -> Array:
        """Return the TCA's tension [N], without an object, at temperatures (...) [degC]."""
        given = self._checked(temperature)
        result = np.empty(given.size)
        compliance = 1.0 / self.axial_stiffness + self.offset**2 / self.bending_stiffness
        ring_tension(self.law.parameters()[np.newaxis], self.length, self.rest_length, compliance, given.ravel(), result)
        return result.reshape(given.shape)

    def gap(self, temperature: ArrayLike) -> Array:
        """Return the distance between the ring's ends, the jaws [m], without an object, at temperatures (...) [degC].

        An arc of curvature kappa = 2 pi/L - F r/EI and length l = L/2 (1 - F/EA) per half: gap = 2 sin(angle)/(angle/l), with
        angle = kappa L/2; 0 where the jaws press on each other.
        """
        force = self.tension(temperature)
        angle = pi - 0.5 * self.length * self.offset / self.bending_stiffness * force
        half = 0.5 * self.length * (1.0 - force / self.axial_stiffness)
        return np.maximum(2.0 * half * np.sinc(angle / pi), 0.0)

    def half(self) -> Arm:
        """Return one half as an arm: from the mount, z along the ring, x towards its centre, the jaw at the tip."""
        # G = E/3; shear enters only where an object is pinched, bending and torsion out of the plane never.
        shear = self.axial_stiffness / 3.0
        bending = self.bending_stiffness
        stiffness = np.array([bending, bending, bending, shear, shear, self.axial_stiffness])
        reference = np.array([0.0, 1.0 / self.radius, 0.0, 0.0, 0.0, 1.0])
        muscle = Muscle(self.offset, pi, 0.0, self.law)
        return Arm([Module(0.5 * self.length, stiffness, 0.0, [muscle], reference)], residual_tolerance=1e-10)

    def pinch(self, temperature: ArrayLike, width: float) -> Array:
        """Return the force of each jaw on an object [N] at temperatures (...) [degC]; 0 where the jaws are wider apart.

        The equilibrium of one half under the object's force, by `Arm.equilibrium`; the force is found by a secant method.

        Parameters
        ----------
        temperature : (...) array
            [degC].
        width : float
            Distance of the jaws that the object forces [m], up to L/4.

        Raises
        ------
        ValueError
            For a width outside (0, L/4] or temperatures that the TCA's law does not accept.
        """
        from scipy.optimize import root_scalar  # takes as long to import as all else

        width = check.scalar("width", width, 0.0, 0.25 * self.length, above=True)
        given = self._checked(temperature)
        result = np.zeros(given.size)
        arm = self.half()
        stiffness = self.bending_stiffness / (3.0 * pi * self.radius**3)  # of a closed ring without its muscle
        free = self.gap(given).ravel()
        for i in np.flatnonzero(free < width):
            start = arm.equilibrium([given.ravel()[i]])

            def excess(force: float, start: Any = start) -> float:
                jaw = arm.equilibrium(start.drive, tip_force=(0.0, 0.0, force), start=start)
                if not jaw.converged:
                    raise RuntimeError(f"the gripper has no equilibrium at {start.drive[0]:g} degC under {force:g} N")
                return 2.0 * float(jaw.tip_pose[2, 3]) - width

            guess = stiffness * (width - free[i])
            found = root_scalar(excess, x0=guess, x1=0.9 * guess + 1e-6, xtol=1e-9)
            if not found.converged:
                raise RuntimeError(f"no pinch force found at {start.drive[0]:g} degC and a width of {width:g} m: {found.flag}")
            result[i] = found.root
        return result.reshape(given.shape)

    def _checked(self, temperature: ArrayLike) -> Array:
        try:
            given = np.asarray(temperature)
        except ValueError:  # ragged
            given = np.empty(0, dtype=object)
        low, high = self.law.drive_range()
        if given.dtype.kind not in "iuf" or not ((given >= low) & (given <= high)).all():
            raise ValueError(f"temperature = {temperature!r}: expected numbers in [{low:g}, {high:g}] degC")
        return given.astype(np.float64)
