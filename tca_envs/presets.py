"""The paper's arm: every number with its unit and source.

Sources: Sun & Zhao, "Modeling and Simulation of Soft Robots driven by Artificial Muscles" (the paper); masses are estimates
that add up to the arm's measured 6 g.
"""

from collections.abc import Callable
from functools import cache
from itertools import product
from math import cos, pi, radians

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import TCA, Arm, Gripper, Module, Muscle, Payload, check, discretise
from tca_envs.mechanics.grasp import Box, Site
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT

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

TWISTING_LENGTH = 16e-3
"""[m] (paper, section IV.B)."""
TWISTING_OFFSET = 3.5e-3
"""Distance of the helical TCA from the centerline [m] (paper, section IV.B)."""
TWISTING_TURNS = 5.0
"""(paper, section IV.B)."""
TWISTING_MASS = 1.2e-3
"""[kg] (estimate)."""

FIBRE_LENGTH = 144.5e-3
"""Of the fibre in a 45 mm TCA [m] (as `TCA.untwist_gain`)."""
COIL_RADIUS = 0.3725e-3
"""Of the fibre's centerline around the coil's axis [m] (as `TCA.untwist_gain`)."""
COIL_PITCH_DEG = 18.14
"""Angle of the fibre against the coil's cross section (as `TCA.untwist_gain`)."""
FIBRE_DIAMETER = (32.0 / pi * FIBRE_LENGTH * (COIL_RADIUS * cos(radians(COIL_PITCH_DEG))) ** 2 / TCA.compliance_gain) ** 0.25
"""[m]: C = l r^2 cos^2(alpha)/J with J = pi d^4/32, of which `TCA.compliance_gain` was measured (paper, below eq. (23))."""

GRIPPER_LENGTH = 35e-3
"""Of the ring's centerline [m]: u* = 2 pi/L = 179.5 1/m."""
GRIPPER_THICKNESS, GRIPPER_WIDTH = 3e-3, 6e-3
"""Section of the ring, radial and axial [m] (paper, section IV)."""
GRIPPER_STIFFNESS = 2.1e-5
"""EI [N m2], measured: layers of tape stiffen the ring, 1.7e-6 would follow from the elastomer alone."""
GRIPPER_OFFSET = 2.5e-3
"""Distance of the TCA from the ring's centerline, outside [m] (paper, section IV.B)."""
GRIPPER_MASS = 0.9e-3
"""[kg] (estimate)."""
GRIPPER_CENTRE = (0.0, 0.0, GRIPPER_LENGTH / (2.0 * pi))
"""Centre of the gripper's mass in the frame of the twisting module's end [m]: the ring hangs from it."""
JAW_DEPTH = GRIPPER_LENGTH / pi
"""Distance of the jaws from the twisting module's end [m]: the ring's diameter, 0.5 to 1.3 mm less than when it is open."""

OBJECT = Box(width=3e-3, length=12e-3, height=8e-3, mass=1.5e-3, friction=1.1)
"""An upright circuit board with its parts: mass and friction as measured, sides as they fit the gripper (estimate)."""
STAGE_TRAVEL = 15e-3
"""Of the base's vertical stage [m] (paper, section IV.B: the arm is lowered by about 10 mm)."""
STAGE_SPEED = 10e-3
"""[m/s] (estimate)."""
SITE = Site(86.8e-3, STAGE_TRAVEL, GRIPPER_WIDTH, GRIPPER_THICKNESS, GRAVITY[2])
"""The table's depth puts the object's centre 10 mm under the jaws of the cold arm (paper, Fig. 6a)."""

BELOW_BENDING = Payload(TWISTING_MASS + GRIPPER_MASS, (0.0, 0.0, 12e-3))
"""Twisting module and gripper as a rigid body: centre of mass 12 mm below the bending module's tip (estimate)."""

TOLERANCE = 1e-5
"""Default tip error [m]: a hundredth of the smallest success radius."""
STATES = 160
"""So many states of a scene decide on its discretisation."""


def bending_module(tca: TCA | None = None) -> Module:
    """Return the paper's 3D bending module: three straight TCAs around a soft cylinder."""
    law = tca or TCA()
    muscles = [Muscle(BENDING_OFFSET, angle, 0.0, law) for angle in BENDING_ANGLES]
    return Module.cylinder(BENDING_LENGTH, BODY_DIAMETER, YOUNGS_MODULUS, SHEAR_MODULUS, BENDING_MASS, muscles)


def twisting_module(tca: TCA | None = None) -> Module:
    """Return the paper's twisting module: one TCA wound around a soft cylinder."""
    muscle = Muscle(TWISTING_OFFSET, 0.0, TWISTING_TURNS, tca or TCA())
    return Module.cylinder(TWISTING_LENGTH, BODY_DIAMETER, YOUNGS_MODULUS, SHEAR_MODULUS, TWISTING_MASS, [muscle])


def gripper(tca: TCA | None = None) -> Gripper:
    """Return the paper's gripper; the tape is taken to stiffen the ring in tension as much as in bending (estimate)."""
    area = GRIPPER_THICKNESS * GRIPPER_WIDTH
    elastomer = YOUNGS_MODULUS * area * GRIPPER_THICKNESS**2 / 12.0
    axial = YOUNGS_MODULUS * area * GRIPPER_STIFFNESS / elastomer
    return Gripper(GRIPPER_LENGTH, GRIPPER_STIFFNESS, axial, GRIPPER_OFFSET, tca or TCA())


def with_object(place: ArrayLike = (0.0, 0.0, JAW_DEPTH)) -> Payload:
    """Return the gripper with the object in its jaws as a payload of the whole arm.

    Parameters
    ----------
    place : (3,) array
        The object's centre in the frame of the twisting module's end [m].
    """
    mass, x, y, z = hanging(check.array("place", place, (3,))).tolist()
    return Payload(mass, (x, y, z))


def hanging(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return mass [kg] and centre of mass [m] (..., 4) of the gripper with the object, its centre at `place` (..., 3) [m]."""
    mass = GRIPPER_MASS + OBJECT.mass
    result = np.empty((*place.shape[:-1], 4))
    result[..., 0] = mass
    result[..., 1:] = (GRIPPER_MASS * np.array(GRIPPER_CENTRE) + OBJECT.mass * place) / mass
    return result


def whole_arm(tca: TCA | None = None, payload: Payload | None = None, tolerance: float = TOLERANCE) -> Arm:
    """Return bending and twisting module in series with the gripper's weight at the end, or another payload.

    Parameters
    ----------
    tca : TCA, optional
        Parameter set of all TCAs; the measured one by default.
    payload : Payload, optional
        What hangs from the twisting module's end instead of the empty gripper.
    tolerance : float
        Largest tip error [m], with this payload and with the object in the gripper's jaws; see `mechanics.discretise`.
    """
    modules = (bending_module, twisting_module)
    return _scene(modules, tca or TCA(), payload or Payload(GRIPPER_MASS, GRIPPER_CENTRE), with_object(), tolerance)


def bending_arm(tca: TCA | None = None, tolerance: float = TOLERANCE) -> Arm:
    """Return the bending module with the rest of the arm hanging from it as a rigid body; parameters as of `whole_arm`."""
    return _scene((bending_module,), tca or TCA(), BELOW_BENDING, BELOW_BENDING, tolerance)


@cache
def _scene(modules: tuple[Callable[[TCA], Module], ...], tca: TCA, payload: Payload, other: Payload, tolerance: float) -> Arm:
    """Return a hanging arm for all temperatures up to the hard limit, with either payload: corners and random ones."""
    arm = Arm([module(tca) for module in modules], GRAVITY, payload)
    rng = np.random.default_rng(0)
    corners = list(product((AMBIENT, HARD_LIMIT), repeat=len(arm.muscles)))
    drives = np.vstack([corners, rng.uniform(AMBIENT, HARD_LIMIT, (STATES - len(corners), len(arm.muscles)))])
    loads = [arm.load(payload=other if i % 2 else payload) for i in range(STATES)]
    return discretise(arm, tolerance, drives, np.array(loads))
