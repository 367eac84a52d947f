"""The paper's robot as the three tasks use it: every number with its unit and source.

Sources: Sun & Zhao, "Modeling and Simulation of Soft Robots driven by Artificial Muscles" (the paper); masses are estimates
that add up to the arm's measured 6 g.
"""

from dataclasses import replace
from functools import cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Parts
from tca_envs.mechanics import TCA, Arm, Gripper, Module, Muscle, Payload
from tca_envs.mechanics.grasp import Box
from tca_envs.robots.robot import TOLERANCE, RingGripper, Robot, Stage

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
TABLE = 86.8e-3
"""Its depth under the base [m] puts the object's centre 10 mm under the jaws of the cold arm (paper, Fig. 6a)."""
STAGE = Stage(travel=15e-3, speed=10e-3)
"""Of the base: it lowers the arm by about 10 mm (paper, section IV.B); the speed is an estimate."""

BELOW_BENDING = Payload(TWISTING_MASS + GRIPPER_MASS, (0.0, 0.0, 12e-3))
"""Twisting module and gripper as a rigid body: centre of mass 12 mm below the bending module's tip (estimate)."""
EMPTY = Payload(GRIPPER_MASS, GRIPPER_CENTRE)
"""The gripper without an object."""

BENDING_REACH_CM, WHOLE_REACH_CM, CARRYING_REACH_CM = 7.0, 8.0, 10.0
"""No coordinate is larger: of the bending module's tip, of the whole arm's, and of jaws and object."""

MEASURED = TCA()
"""The set of TCA parameters that was measured."""


def bending_module(tca: TCA = MEASURED) -> Module:
    """Return the paper's 3D bending module: three straight TCAs around a soft cylinder."""
    muscles = [Muscle(BENDING_OFFSET, angle, 0.0, tca) for angle in BENDING_ANGLES]
    return Module.cylinder(BENDING_LENGTH, BODY_DIAMETER, YOUNGS_MODULUS, SHEAR_MODULUS, BENDING_MASS, muscles)


def twisting_module(tca: TCA = MEASURED) -> Module:
    """Return the paper's twisting module: one TCA wound around a soft cylinder."""
    muscle = Muscle(TWISTING_OFFSET, 0.0, TWISTING_TURNS, tca)
    return Module.cylinder(TWISTING_LENGTH, BODY_DIAMETER, YOUNGS_MODULUS, SHEAR_MODULUS, TWISTING_MASS, [muscle])


def ring(tca: TCA = MEASURED) -> Gripper:
    """Return the gripper's ring; the tape is taken to stiffen it in tension as much as in bending (estimate)."""
    area = GRIPPER_THICKNESS * GRIPPER_WIDTH
    elastomer = YOUNGS_MODULUS * area * GRIPPER_THICKNESS**2 / 12.0
    axial = YOUNGS_MODULUS * area * GRIPPER_STIFFNESS / elastomer
    return Gripper(GRIPPER_LENGTH, GRIPPER_STIFFNESS, axial, GRIPPER_OFFSET, tca)


def gripper(tca: TCA = MEASURED) -> RingGripper:
    """Return the paper's gripper."""
    return RingGripper(ring(tca), GRIPPER_WIDTH, GRIPPER_THICKNESS, GRIPPER_MASS, GRIPPER_CENTRE, JAW_DEPTH)


def with_object(place: tuple[float, float, float] | None = None) -> Payload:
    """Return the gripper with the object in its jaws as a payload of the whole arm; `place` as of `RingGripper.payload`."""
    return gripper().payload(OBJECT.mass, place)


@cache
def bending(tca: TCA) -> Robot:
    """Return the bending module with the rest of the arm hanging from it as a rigid body."""
    arm = Arm([bending_module(tca)], GRAVITY, BELOW_BENDING)
    return Robot(arm, reach_cm=BENDING_REACH_CM, tail=_rigid_rest, floor=TABLE)


@cache
def whole(tca: TCA, payload: Payload) -> Robot:
    """Return bending and twisting module in series, a payload and the closed gripper at the end."""
    arm = Arm([bending_module(tca), twisting_module(tca)], GRAVITY, payload)
    return Robot(arm, carries=with_object(), reach_cm=WHOLE_REACH_CM, tail=gripper().closed, floor=TABLE)


@cache
def gripping(tca: TCA) -> Robot:
    """Return the whole arm on its stage, with its gripper heated."""
    return replace(whole(tca, EMPTY), gripper=gripper(tca), stage=STAGE, reach_cm=CARRYING_REACH_CM)


def bending_arm(tca: TCA = MEASURED, tolerance: float = TOLERANCE) -> Arm:
    """Return the arm of `bending`, discretised for a tip error of at most `tolerance` [m]."""
    return bending(tca).built(tolerance)


def whole_arm(tca: TCA = MEASURED, payload: Payload = EMPTY, tolerance: float = TOLERANCE) -> Arm:
    """Return the arm of `whole`, discretised for a tip error of at most `tolerance` [m]."""
    return whole(tca, payload).built(tolerance)


def _rigid_rest(tip: NDArray[np.float64]) -> Parts:
    """Return the surfaces of twisting module and gripper at the pose (4, 4) of the bending module's tip."""
    beyond = tip.copy()
    beyond[:3, 3] += TWISTING_LENGTH * tip[:3, 2]
    body = geometry.rod(tip, beyond, 0.5 * BODY_DIAMETER, geometry.DEAD)
    rest = {name: part._replace(colour=geometry.DEAD) for name, part in gripper().closed(beyond).items()}
    return {"dead weight": body, **rest}


BENDING, WHOLE, GRIPPING = bending(MEASURED), whole(MEASURED, EMPTY), gripping(MEASURED)
"""The robots of Reach, TwistAlign and PickAndPlace."""
