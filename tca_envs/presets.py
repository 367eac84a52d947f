"""The paper's arm: every number with its unit and source.

Sources: Sun & Zhao, "Modeling and Simulation of Soft Robots driven by Artificial Muscles" (the paper); masses are estimates
that add up to the arm's measured 6 g.
"""

from math import pi

from tca_envs.mechanics import TCA, Arm, Grid, Module, Muscle, Payload

YOUNGS_MODULUS = 0.125e6
"""Ecoflex 30 [Pa] (paper, section IV)."""
SHEAR_MODULUS = YOUNGS_MODULUS / 3.0
"""[Pa] (paper, section IV: G = E/3)."""
GRAVITY = (0.0, 0.0, 9.81)
"""[m/s2]: the arm hangs and its z axis points down (paper, eq. (9))."""

BODY_DIAMETER = 4.5e-3
"""Bending and twisting module [m] (paper, section IV): an effective value, the channels at 4 mm lie outside it."""

BENDING_LENGTH = 45e-3
"""[m] (paper, section IV.A)."""
BENDING_OFFSET = 4e-3
"""Distance of the TCAs from the centerline [m] (paper, section IV.A)."""
BENDING_ANGLES = (0.0, 2.0 * pi / 3.0, 4.0 * pi / 3.0)
"""[rad] (paper, section IV.A)."""
BENDING_MASS = 3.9e-3
"""[kg] (estimate)."""

TWISTING_MASS = 1.2e-3
"""[kg] (estimate)."""
GRIPPER_MASS = 0.9e-3
"""[kg] (estimate)."""
BELOW_BENDING = Payload(TWISTING_MASS + GRIPPER_MASS, (0.0, 0.0, 12e-3))
"""Twisting module and gripper as a rigid body: centre of mass 12 mm below the bending module's tip (estimate)."""


def bending_module(tca: TCA | None = None) -> Module:
    """Return the paper's 3D bending module: three straight TCAs around a soft cylinder."""
    law = tca or TCA()
    muscles = [Muscle(BENDING_OFFSET, angle, 0.0, law) for angle in BENDING_ANGLES]
    return Module.cylinder(BENDING_LENGTH, BODY_DIAMETER, YOUNGS_MODULUS, SHEAR_MODULUS, BENDING_MASS, muscles)


def bending_arm(tca: TCA | None = None) -> Arm:
    """Return the bending module with the rest of the arm hanging from it as a rigid body.

    One element of 7 Gauss nodes: the tip lies within 1 um of that of a grid ten times finer at all temperatures up to the
    hard limit (tests/test_benchmark.py).
    """
    return Arm([bending_module(tca)], GRAVITY, BELOW_BENDING, [Grid(1, 7)], tolerance=1e-6)
