"""Bending and twisting module in series: closed forms, continuity of the wrench, symmetry, the paper's method."""

import itertools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from study import shooting
from tca_envs.mechanics import TCA, Arm, Module, Muscle, Payload, section
from tca_envs.robots import paper
from tca_envs.rotation import yaw, yaw_angle

LAWS = pytest.mark.parametrize("law", [TCA.hardware(), TCA.paper()], ids=["hardware", "paper"])


def straight_again(module):
    """Return K, xi* and the muscle's route in the frame that turns with the helix, where all of them are constant."""
    (muscle,) = module.muscles
    turning = 2.0 * np.pi * muscle.turns / module.length
    reference = module.reference_strain + np.array([0.0, 0.0, turning, 0.0, 0.0, 0.0])
    return module.stiffness, reference, np.array([[muscle.offset, 0.0, 0.0, 0.0]]), turning


def helix_strain(module, tension):
    """Six algebraic equations: the strain that carries no wrench."""
    stiffness, reference, route, _ = straight_again(module)
    return section.solve(stiffness, reference, route, np.array([tension]), np.zeros(6), reference)


def helix_length(module, strain):
    """Path length of the muscle at a constant strain."""
    r = np.array([module.muscles[0].offset, 0.0, 0.0])
    return module.length * np.linalg.norm(strain[3:] + np.cross(strain[:3], r))


def twisted(module, strain):
    """Pose of the end: exp(L xi^) Rz(-k L)."""
    u, v = strain[:3], strain[3:]
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = section.cross_matrix(u), v
    back = np.eye(4)
    back[:3, :3] = Rotation.from_rotvec([0.0, 0.0, -straight_again(module)[3] * module.length]).as_matrix()
    return expm(module.length * generator) @ back


@LAWS
@pytest.mark.parametrize("temperature", [25.0, 60.0, 100.0, 150.0])
def test_the_twisting_module_alone_is_its_closed_form(law, temperature):
    """Without load: one scalar equation for the tension around six algebraic ones."""
    module = paper.twisting_module(law)
    rest = module.rest_length(module.muscles[0])

    def mismatch(tension):
        return helix_length(module, helix_strain(module, tension)) - rest - law.elongation(tension, temperature, rest)

    tension = brentq(mismatch, -0.01, 0.4, xtol=1e-15)
    found = Arm([module]).equilibrium([temperature])
    assert found.converged
    assert found.tensions[0] == pytest.approx(tension, abs=1e-8)
    np.testing.assert_allclose(found.tip_pose, twisted(module, helix_strain(module, tension)), atol=2e-6)


def test_the_twist_is_that_of_the_prototype():
    """-82/-146/-239 degrees at 100/125/150 degC: a shooting prototype of the same module, to a degree."""
    arm, start, turned = paper.whole_arm(), None, []
    for temperature in range(25, 151, 5):
        start = arm.equilibrium([25.0, 25.0, 25.0, temperature], start=start)
        turned.append(float(yaw_angle(start.tip_pose)))
    degrees = np.degrees(np.unwrap(turned))
    np.testing.assert_allclose(degrees[[15, 20, 25]], [-82.0, -146.0, -239.0], atol=1.0)


@pytest.mark.parametrize("bending", [(25.0, 25.0, 25.0), (110.0, 25.0, 60.0), (90.0, 90.0, 90.0)], ids=str)
def test_heating_the_helix_turns_the_gripper_one_way_only(bending):
    arm, start, turned = paper.whole_arm(), None, []
    for temperature in np.arange(25.0, 151.0, 2.5):
        start = arm.equilibrium([*bending, temperature], start=start)
        assert start.converged
        turned.append(float(yaw_angle(start.tip_pose)))
    assert (np.diff(np.unwrap(turned)) < 0.0).all()


@pytest.mark.parametrize("drive", [(25.0, 25.0, 25.0, 25.0), (110.0, 60.0, 40.0, 80.0), (100.0, 100.0, 30.0, 140.0)], ids=str)
def test_the_wrench_is_continuous_across_the_joint_and_the_strain_is_not(drive):
    arm = paper.whole_arm()
    here = arm.equilibrium(drive)
    joint = arm.modules[0].length
    inside, beyond = here.strain([joint - 1e-9, joint])

    def carried(module, fraction, strain, tension):
        routes = np.array([muscle.route(module.length, fraction) for muscle in module.muscles])
        wrench, _ = section.balance(module.stiffness, module.reference_strain, routes, tension, strain, np.zeros(6))
        return wrench

    above = carried(arm.modules[0], 1.0, inside, here.tensions[:3])
    below = carried(arm.modules[1], 0.0, beyond, here.tensions[3:])
    np.testing.assert_allclose(above, below, atol=1e-7 * np.abs(above).max() + 1e-9)
    # It is the weight that hangs there.
    hanging = (paper.TWISTING_MASS + paper.GRIPPER_MASS) * 9.81
    np.testing.assert_allclose(np.linalg.norm(below[3:]), hanging, rtol=1e-9)
    if max(drive) > 25.0:
        assert np.abs(inside[:3] - beyond[:3]).max() > 1.0


def test_turning_arm_and_temperatures_turns_the_answer():
    """The bending TCAs lie 120 degrees apart: passing temperatures on and turning the helix along turns everything."""
    turn = Rotation.from_rotvec([0.0, 0.0, 2.0 * np.pi / 3.0]).as_matrix()
    arm = paper.whole_arm()
    helix = Muscle(paper.TWISTING_OFFSET, 2.0 * np.pi / 3.0, paper.TWISTING_TURNS, TCA())
    twisting = Module.cylinder(
        paper.TWISTING_LENGTH, paper.BODY_DIAMETER, paper.YOUNGS_MODULUS, paper.SHEAR_MODULUS, paper.TWISTING_MASS,
        [helix],
    )  # fmt: skip
    turned = Arm([paper.bending_module(), twisting], paper.GRAVITY, arm.payload, arm.grids, residual_tolerance=1e-9)
    arm = Arm(arm.modules, arm.gravity, arm.payload, arm.grids, residual_tolerance=1e-9)
    for a, b, c, d in ((110.0, 60.0, 40.0, 80.0), (25.0, 120.0, 25.0, 140.0)):
        first, second = arm.equilibrium([a, b, c, d]), turned.equilibrium([c, a, b, d])
        np.testing.assert_allclose(turn @ first.tip_pose[:3, 3], second.tip_pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(turn @ first.tip_pose[:3, :3] @ turn.T, second.tip_pose[:3, :3], atol=1e-6)


def test_the_papers_method_agrees_on_two_modules():
    arm = paper.whole_arm()
    for drive in ((40.0, 25.0, 25.0, 60.0), (100.0, 100.0, 30.0, 100.0)):
        ours = arm.equilibrium(drive)
        theirs = shooting.equilibrium(arm, drive, start=ours, rtol=1e-6)
        assert ours.converged and theirs.converged
        assert np.linalg.norm(ours.tip_pose[:3, 3] - theirs.tip_pose[:3, 3]) < 1e-6
        np.testing.assert_allclose(ours.tensions, theirs.tensions, atol=1e-5)


def test_jumps_from_anywhere_to_anywhere_find_an_equilibrium():
    """All corners of temperature space, cold and from each other."""
    arm = paper.whole_arm()
    corners = [np.array(corner) for corner in itertools.product((25.0, 158.0), repeat=4)]
    start = None
    for corner in np.random.default_rng(0).permutation(np.array(corners * 2)):
        assert arm.equilibrium(corner).converged
        start = arm.equilibrium(corner, start=start)
        assert start.converged


def test_an_object_in_the_jaws_hangs_at_its_place():
    """Weights add up, and the tangent of the straight arm's tip shows the lever of the object beside the axis."""
    empty, full = paper.whole_arm(), paper.whole_arm(payload=paper.with_object())
    cold = np.full(4, 25.0)
    assert full.equilibrium(cold).tip_pose[2, 3] > empty.equilibrium(cold).tip_pose[2, 3] + 1e-4
    held = paper.with_object((0.0, 2e-3, paper.JAW_DEPTH + 1e-3))
    assert held.mass == pytest.approx(2.4e-3)
    moment = paper.GRIPPER_MASS * np.array(paper.GRIPPER_CENTRE) + 1.5e-3 * np.array([0.0, 2e-3, paper.JAW_DEPTH + 1e-3])
    np.testing.assert_allclose(held.mass * np.array(held.centre), moment)
    aside = paper.whole_arm(payload=held).equilibrium(cold).tip_pose
    # The arm swings until the common centre hangs under the base.
    assert aside[1, 3] < -1e-4
    assert abs(aside[1, 3] + aside[1, :3] @ held.centre) < 0.5 * abs(aside[1, 3])
    same = Arm(empty.modules, empty.gravity, Payload(2.4e-3, (0.0, 0.0, held.centre[2])), empty.grids).equilibrium(cold)
    assert abs(same.tip_pose[1, 3]) < 1e-5


def test_yaw_is_the_turn_that_remains_when_the_tilt_is_undone():
    rng = np.random.default_rng(0)
    for _ in range(50):
        turn, tilt, way = rng.uniform(-3.1, 3.1), rng.uniform(0.0, 2.5), rng.uniform(-3.1, 3.1)
        pose = np.eye(4)
        swing = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0.0]))
        pose[:3, :3] = (swing * Rotation.from_rotvec([0.0, 0.0, turn])).as_matrix()
        cosine, sine = yaw(pose)
        assert (cosine, sine) == pytest.approx((np.cos(turn), np.sin(turn)), abs=1e-12)
        assert yaw_angle(pose) == pytest.approx(turn, abs=1e-12)
