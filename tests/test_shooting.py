"""The paper's own method against closed forms and against `Arm.equilibrium`."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from agents.scripted import controller_of
from study import shooting
from study.method import lanes_at
from tca_envs.mechanics import TCA, Arm, Module, Muscle, Payload, Rung, Spring, Tendon, continuation, section, thermal
from tca_envs.mechanics.thermal import Heat, Heater
from tca_envs.robots.paper import bending_arm

E, G, LENGTH, RADIUS, DENSITY = 0.125e6, 0.125e6 / 3.0, 0.045, 0.0045, 1070.0
AREA = np.pi * RADIUS**2
EI, GA, EA = E * np.pi * RADIUS**4 / 4.0, G * AREA, E * AREA
GJ = G * np.pi * RADIUS**4 / 2.0


def rod(muscles=(), length=LENGTH, weighs=False, curvature=(0.0, 0.0, 0.0)):
    mass = DENSITY * AREA * length if weighs else 0.0
    return Module.cylinder(length, 2.0 * RADIUS, E, G, mass, muscles, curvature)


def straight(laws, offset=0.004):
    return [Muscle(offset, 2.0 * np.pi * i / 3.0, 0.0, law) for i, law in enumerate(laws)]


def rotation_vector(pose):
    return Rotation.from_matrix(pose[:3, :3]).as_rotvec()


def assert_same_tip(found, expected, length, position=1e-6, angle=1e-5):
    assert found.converged and expected.converged
    assert np.abs(found.tip_pose[:3, 3] - expected.tip_pose[:3, 3]).max() < position * length
    turn = Rotation.from_matrix(found.tip_pose[:3, :3] @ expected.tip_pose[:3, :3].T).magnitude()
    assert turn < angle


# Closed forms


def test_straight_tendon():
    found = shooting.equilibrium(Arm([rod(straight([Tendon()]))]), [0.3], rtol=1e-8)
    assert found.converged
    assert found.tip_pose[:3, 3] == pytest.approx([0.0249404116, 0.0, 0.0314365278], abs=2e-9)
    assert found.muscle_lengths == pytest.approx([0.0379369263], abs=1e-9)
    assert found.tensions == pytest.approx([0.3], abs=1e-9)
    constant = [0.0, 29.807894234, 0.0, 0.0, 0.0, 0.962274384]
    assert np.abs(found.strain([0.0, 0.0123, 0.04, LENGTH]) - constant).max() < 1e-6


@pytest.mark.parametrize(
    ("active", "tensions", "bend"),
    [
        ((0, 1, 2), (0.11526673, 0.30746311, 0.30746311), 0.859345402),
        ((1, 2), (0.2980622, 0.2980622), 1.332690980),
    ],
)
def test_springs(active, tensions, bend):
    muscles, rest = straight([Spring(50.0)] * 3), np.array([0.042, 0.033, 0.033])
    arm = Arm([rod([muscles[i] for i in active])])
    found = shooting.equilibrium(arm, rest[list(active)], rtol=1e-8)
    assert found.converged
    assert found.tensions == pytest.approx(tensions, abs=2e-8)
    assert np.linalg.norm(rotation_vector(found.tip_pose)) == pytest.approx(bend, abs=1e-7)
    assert found.muscle_lengths - rest[list(active)] == pytest.approx(found.tensions / 50.0, abs=1e-9)


def test_helix():
    length, radius, turns, tension = 0.016, 0.0035, 5.0, 0.2
    module = rod([Muscle(radius, 0.0, turns, Tendon())], length)
    found = shooting.equilibrium(Arm([module]), [tension], rtol=1e-8)
    # The strain is constant in the frame that turns with the muscle.
    rate = 2.0 * np.pi * turns / length
    route = np.array([[radius, 0.0, 0.0, radius * rate]])
    strain = section.solve(
        module.stiffness, module.reference_strain, route, np.array([tension]), np.zeros(6), module.reference_strain
    )
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = section.cross_matrix(strain[:3] + np.array([0.0, 0.0, rate])), strain[3:]
    tip = expm(length * twist)
    tip[:3, :3] = tip[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, -rate * length]).as_matrix()
    assert found.converged
    assert np.abs(found.tip_pose - tip).max() < 1e-7
    assert np.degrees(found.strain([0.0, 0.003, length])[:, 2] * length) == pytest.approx(-23.655144, abs=2e-5)
    assert found.muscle_lengths == pytest.approx([0.1084731904], abs=1e-9)


def test_small_loads():
    arm = Arm([rod()])
    across = shooting.equilibrium(arm, [], tip_force=(1e-5, 0.0, 0.0), rtol=1e-9)
    assert across.tip_pose[0, 3] / 1e-5 == pytest.approx(0.77148885, rel=1e-6)
    along = shooting.equilibrium(arm, [], tip_force=(0.0, 0.0, 0.1), tip_moment=(0.0, 0.0, 1e-4), rtol=1e-9)
    assert along.tip_pose[2, 3] == pytest.approx(LENGTH * (1.0 + 0.1 / EA), rel=1e-8)
    assert rotation_vector(along.tip_pose)[2] == pytest.approx(1e-4 * LENGTH / GJ, rel=1e-7)


def test_tip_moment_bends_to_a_half_circle():
    moment = np.pi * EI / LENGTH
    found = shooting.equilibrium(Arm([rod()]), [], tip_moment=(0.0, moment, 0.0), rtol=1e-8)
    assert found.converged
    assert found.tip_pose[:3, 3] == pytest.approx([2.0 * LENGTH / np.pi, 0.0, 0.0], abs=1e-8)


def test_bisshopp_drucker():
    hard = rod().stiffness * [1.0, 1.0, 1.0, 1e5, 1e5, 1e5]
    found = shooting.equilibrium(Arm([Module(LENGTH, hard)]), [], tip_force=(EI / LENGTH**2, 0.0, 0.0), rtol=1e-8)
    assert found.converged
    assert found.tip_pose[[0, 2], 3] / LENGTH == pytest.approx([0.3017207738, 0.9435667637], abs=1e-6)


# The other solver


def bending(gravity=(0.0, 0.0, 9.81), payload=None):
    return Arm([rod(straight([TCA()] * 3), weighs=True)], gravity, payload)


def two_modules():
    twisting = rod([Muscle(0.0035, 0.4, 1.7, TCA())], 0.016, weighs=True)
    return Arm([rod(straight([TCA(), Spring(40.0)]), weighs=True), twisting], (2.0, 0.0, 9.0))


CASES = {
    "tendon, weight and force across": (
        Arm([rod(straight([Tendon()]), weighs=True)], (9.81, 0.0, 0.0)),
        [0.3],
        {"tip_force": (0.0, 0.01, 0.005), "tip_moment": (1e-4, 0.0, 2e-4)},
    ),
    "three TCAs, one hot": (bending(), [110.0, 25.0, 25.0], {}),
    "three TCAs, two hot": (bending(), [25.0, 120.0, 90.0], {"tip_force": (0.002, 0.003, 0.0)}),
    "two modules": (two_modules(), [90.0, 0.04, 80.0], {}),
    "two modules, nothing in the first": (
        Arm([rod(weighs=True), rod(straight([TCA()], 0.003), 0.02, weighs=True)], (1.0, 0.0, 9.0)),
        [100.0],
        {},
    ),
    "ring": (
        Arm([rod([Muscle(0.0025, 0.0, 0.0, TCA())], 0.035, True, (0.0, 2.0 * np.pi / 0.035, 0.0))], (0.0, 1.0, 5.0)),
        [70.0],
        {},
    ),
    "payload off the axis": (bending(payload=Payload(1e-3, (0.004, -0.002, 0.01))), [80.0, 40.0, 25.0], {}),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES.keys())
def both(request):
    """An arm, its equilibrium by `Arm.equilibrium` and by shooting from a cold start."""
    arm, drive, load = request.param
    return arm, arm.equilibrium(drive, **load), shooting.equilibrium(arm, drive, **load, rtol=1e-8)


def test_agrees(both):
    arm, expected, found = both
    assert_same_tip(found, expected, arm.length)
    assert found.tensions == pytest.approx(expected.tensions, abs=1e-6)
    assert found.muscle_lengths == pytest.approx(expected.muscle_lengths, abs=1e-6 * arm.length)
    assert found.length == expected.length and (found.load == expected.load).all() and found.nodes is None


def test_agrees_along_the_arm(both):
    arm, expected, found = both
    joints = np.cumsum([module.length for module in arm.modules])
    s = np.concatenate([np.linspace(0.0, arm.length, 7), joints[:-1]])
    poses, unit = expected.poses(s), [1e-4 / arm.length] * 3 + [1e-4] * 3
    assert np.abs(found.poses(s)[:, :3, 3] - poses[:, :3, 3]).max() < 1e-6 * arm.length
    assert np.abs(found.poses(s)[:, :3, :3] - poses[:, :3, :3]).max() < 1e-5
    assert (np.abs(found.strain(s) - expected.strain(s)) < unit).all()
    assert (found.poses([0.0])[0] == np.eye(4)).all()


def test_total_force_is_the_load_beyond(both):
    """Rod and muscles together carry what hangs below: no solver in this test."""
    arm, _, found = both
    force = found.load[0:3] + (arm.payload.mass * arm.gravity if arm.payload else 0.0)
    first, end = len(arm.muscles), arm.length
    for module in reversed(arm.modules):
        first -= len(module.muscles)
        tension = found.tensions[first : first + len(module.muscles)]
        for fraction in (0.999, 0.7, 0.3, 0.0):
            s = end - module.length * (1.0 - fraction)
            route = np.array([muscle.route(module.length, fraction) for muscle in module.muscles]).reshape(-1, 4)
            inside, _ = section.balance(
                module.stiffness, module.reference_strain, route, tension, found.strain([s])[0], np.zeros(6)
            )
            weight = module.mass_per_length * (end - s) * arm.gravity
            assert found.poses([s])[0, :3, :3] @ inside[3:] == pytest.approx(force + weight, abs=1e-6)
        force = force + module.mass_per_length * module.length * arm.gravity
        end -= module.length


def test_tip_jacobian(both):
    arm, expected, found = both
    scale = np.abs(expected.tip_jacobian).max(axis=1, initial=1e-12).reshape(2, 3).max(axis=1).repeat(3)
    assert found.tip_jacobian.shape == (6, len(arm.muscles))
    assert (np.abs(found.tip_jacobian - expected.tip_jacobian) < 1e-4 * scale[:, np.newaxis]).all()


def test_accuracy_follows_rtol():
    arm = Arm([rod(straight([Tendon()]), weighs=True)], (9.81, 0.0, 0.0))
    expected = arm.equilibrium([0.3])
    errors = []
    for rtol in (1e-3, 1e-5, 1e-7):
        found = shooting.equilibrium(arm, [0.3], start=expected, rtol=rtol)
        assert found.converged and found.residual <= 10.0 * rtol
        errors.append(np.abs(found.tip_pose[:3, 3] - expected.tip_pose[:3, 3]).max())
    assert errors[0] > 10.0 * errors[1] > 100.0 * errors[2]


# Warm starts


def test_warm_start_from_the_other_solver():
    arm = bending()
    start = arm.equilibrium([100.0, 25.0, 25.0])
    cold = shooting.equilibrium(arm, [103.0, 26.0, 25.0])
    warm = shooting.equilibrium(arm, [103.0, 26.0, 25.0], start=start)
    assert_same_tip(warm, arm.equilibrium([103.0, 26.0, 25.0]), arm.length, 1e-5)
    assert warm.iterations < cold.iterations


def test_warm_start_from_itself_and_back():
    arm = two_modules()
    first = shooting.equilibrium(arm, [60.0, 0.043, 60.0])
    again = shooting.equilibrium(arm, [60.0, 0.043, 60.0], start=first)
    assert again.converged and again.iterations <= 18
    assert_same_tip(arm.equilibrium([60.0, 0.043, 60.0], start=first), again, arm.length, 1e-5)


def test_warm_start_of_the_heavy_arm():
    """Thin, and hung with a payload: errors at the base grow a hundredfold. Cold starts often fail here."""
    arm = Arm([Module.cylinder(LENGTH, 0.0045, E, G, 0.0039, straight([TCA()] * 3))], (0.0, 0.0, 9.81), Payload(0.0021))
    drive = [100.0, 25.0, 25.0]
    found = shooting.equilibrium(arm, drive, start=arm.equilibrium([97.0, 25.0, 25.0]))
    assert_same_tip(found, arm.equilibrium(drive), arm.length, 1e-5)


# Failure


def test_no_equilibrium_is_reported():
    arm = Arm([rod(straight([Tendon()]), weighs=True)], (9.81, 0.0, 0.0))
    found = shooting.equilibrium(arm, [4.0], rtol=1e-3)
    assert not found.converged and found.message.startswith("no equilibrium found")
    assert found.residual > 0.01 and found.iterations > 7
    # Without a start, the unloaded arm.
    assert found.drive == [4.0] and found.tensions == [0.0] and found.muscle_lengths == pytest.approx([LENGTH])
    assert found.tip_pose[:3, 3] == pytest.approx([0.0, 0.0, LENGTH])
    assert np.abs(found.strain([0.0, LENGTH]) - [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).max() < 1e-12
    assert np.isfinite(found.tip_jacobian).all()


def test_failure_keeps_the_shape_of_its_start():
    arm = Arm([rod(straight([Tendon()]))])
    start = shooting.equilibrium(arm, [0.2])
    found = shooting.equilibrium(arm, [0.2], tip_force=(1e9, 0.0, 0.0), start=start)
    assert not found.converged
    assert found.load[0] == 1e9 and found.nodes is None
    assert (found.tip_pose == start.tip_pose).all() and (found.tensions == start.tensions).all()
    assert (found.centerline(5) == start.centerline(5)).all()
    assert (found.tip_jacobian == start.tip_jacobian).all()
    # It is a start like any other.
    assert_same_tip(shooting.equilibrium(arm, [0.25], start=found), arm.equilibrium([0.25]), arm.length, 1e-5)


def test_first_integration_fails():
    found = shooting.equilibrium(Arm([rod(straight([Tendon()]))]), [1e300])
    assert not found.converged and found.iterations == 1 and found.residual == np.inf
    assert "an integration failed at the first guess" in found.message


@pytest.mark.parametrize(("tension", "force"), [(0.3, 1e200), (0.3, -1e5), (1e4, 1e4)])
def test_absurd_loads_neither_raise_nor_warn(tension, force):
    arm = Arm([rod(straight([Tendon()])), rod(straight([TCA()]))])
    found = shooting.equilibrium(arm, [tension, 100.0], tip_force=(force, 0.0, force), rtol=1e-3)
    assert not found.converged and found.tip_pose[:3, 3] == pytest.approx([0.0, 0.0, 2.0 * LENGTH])


def test_start_whose_muscle_is_a_point():
    """Its direction is 0/0: reported, without a warning."""
    arm = Arm([rod(straight([Tendon()]))])
    start = replace(arm.equilibrium([0.1]), sample=lambda s: (np.zeros((s.size, 4, 4)), np.zeros((s.size, 6))))
    found = shooting.equilibrium(arm, [0.1], start=start)
    assert not found.converged and "failed at the first guess: the strain diverges 0 m from" in found.message


def test_joint_without_an_answer():
    tension = np.array([0.1])
    with pytest.raises(shooting.IntegrationError, match="beyond a joint"):
        shooting.cross_joint(rod(), rod(straight([Tendon()])), np.full(6, np.nan), np.empty(0), tension)


def test_endless_integration_is_cut(monkeypatch):
    monkeypatch.setattr(shooting, "MAX_RATES", 1.0)
    arm = Arm([rod(straight([Tendon()]), weighs=True)], (9.81, 0.0, 0.0))
    found = shooting.equilibrium(arm, [0.3])
    assert not found.converged and "the strain diverges" in found.message


def test_trial_points_that_fail_are_refused(monkeypatch):
    """The dogleg steps back from them; where all fail it gives up."""
    arm, drive = bending(), [110.0, 25.0, 25.0]
    whole, calls, failing = shooting.integrate, 0, {12}  # the first trial after the differences

    def integrate(*arguments, **options):
        nonlocal calls
        calls += 1
        if calls in failing and not options:  # the root finder asks for no dense output
            raise shooting.IntegrationError("on purpose")
        return whole(*arguments, **options)

    monkeypatch.setattr(shooting, "integrate", integrate)
    assert_same_tip(shooting.equilibrium(arm, drive), arm.equilibrium(drive), arm.length, 1e-5)
    calls, failing = 0, set(range(12, 150))
    found = shooting.equilibrium(arm, drive)
    assert not found.converged and found.message.endswith("an integration failed: on purpose")


# Arguments


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"arm": "arm"}, "arm"),
        ({"arm": None}, "arm"),
        ({"drive": [0.1, 0.2]}, "drive"),
        ({"drive": [-0.1]}, "drive"),
        ({"drive": [np.nan]}, "drive"),
        ({"drive": "hot"}, "drive"),
        ({"tip_force": (1.0, 2.0)}, "tip_force"),
        ({"tip_moment": (np.inf, 0.0, 0.0)}, "tip_moment"),
        ({"start": 3}, "start"),
        ({"start": Arm([rod(straight([Tendon()] * 2))]).equilibrium([0.0, 0.0])}, "start"),
        ({"start": Arm([rod(straight([Tendon()]), 0.05)]).equilibrium([0.0])}, "start"),
        *(({"rtol": rtol}, "rtol") for rtol in (0.0, -1e-6, 1e-13, 0.2, np.nan, np.inf, "small", None, True)),
    ],
)
def test_bad_input(arguments, word):
    good = {"arm": Arm([rod(straight([Tendon()]))]), "drive": [0.1]}
    with pytest.raises(ValueError, match=word):
        shooting.equilibrium(**(good | arguments))


# As a solver of environments


def batch_of(arm, count):
    """So many lanes at rest, as `continuation.solve` brings them to equilibrium."""
    lanes = lanes_at(arm.unloaded(), count)
    drive, load = lanes.drive.copy(), np.repeat(arm.load()[np.newaxis], count, axis=0)
    assert (continuation.solve(arm, lanes, drive, load)["rung"] != Rung.FAILED).all()
    return lanes, load


def test_steps_an_environment_as_the_packages_solver_does():
    """Two heated arms over ten steps, each solver from its own last state; then each goes on from the other's."""
    arm = bending_arm(tolerance=1e-8)
    heating = Heater().scaled(arm.rest_lengths)
    constants = thermal.constants(0.1, 150.0, heating)
    ours, load = batch_of(arm, 2)
    paper = continuation.Lanes(*(values.copy() for values in ours))
    rng = np.random.default_rng(0)
    temperatures = [np.full((2, 3), 25.0), np.full((2, 3), 25.0)]
    for step in range(12):
        action = rng.uniform(-1.2, 1.2, (2, 3))
        action[0, 0] = 1.0  # up to the limit
        if step == 10:
            ours, paper = paper, ours
        tips = []
        for side, (solver, lanes) in enumerate(((continuation.solve, ours), (shooting.solve, paper))):
            heat = Heat(action, temperatures[side], np.full((2, 3), np.nan), constants)
            drive = np.full((2, 3), np.nan)
            report = solver(arm, lanes, drive, load, 1, heat)
            assert (report["rung"] != Rung.FAILED).all() and not report["jumped"].any()
            power = np.clip(0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * heating.max_power, 0.0, None)
            allowed = thermal.power_to_reach(temperatures[side], 150.0, 0.1, heating)
            np.testing.assert_allclose(heat.power, np.minimum(power, np.maximum(allowed, 0.0)), atol=1e-12)
            np.testing.assert_allclose(drive, thermal.step(temperatures[side], heat.power, 0.1, heating), atol=1e-9)
            np.testing.assert_array_equal(lanes.drive, drive)
            np.testing.assert_array_equal(lanes.load, load)
            temperatures[side] = drive
            tips.append(lanes.tip[:, :3, 3].copy())
        assert (report["iterations"] > 0).all() and (report["residual"] <= 1e-5).all()
        np.testing.assert_allclose(tips[1], tips[0], atol=1e-5)
        np.testing.assert_allclose(paper.length, ours.length, atol=1e-6)
        np.testing.assert_allclose(paper.strain, ours.strain, atol=5e-2)
        np.testing.assert_allclose(paper.tension, ours.tension, atol=1e-4)
    assert np.abs(tips[0][:, :2]).max() > 2e-3 and temperatures[0].max() > 100.0


def test_a_lane_without_an_answer_stays_as_it_was(monkeypatch):
    arm = bending_arm()
    lanes, load = batch_of(arm, 2)
    before = continuation.Lanes(*(values.copy() for values in lanes))
    monkeypatch.setattr(shooting, "MAX_EVALUATIONS", 20)
    drive = np.array([[30.0, 25.0, 25.0], [25.0, 25.0, 25.0]])
    load[1, 0] = 50.0
    report = shooting.solve(arm, lanes, drive, load)
    assert report["rung"].tolist() == [Rung.WARM, Rung.FAILED] and not report["jumped"].any()
    for values, kept in zip(lanes, before, strict=True):
        np.testing.assert_array_equal(values[1], kept[1])
        assert not np.array_equal(values[0], kept[0]) or values is lanes.load


def test_an_episode_is_the_same_with_either_solver():
    """A scripted episode of Reach, of five seconds; with shooting every step takes about 0.4 s, all of it some 20 s."""
    envs = [gymnasium.make("TCAReach-v0", solver=solver, max_episode_steps=50) for solver in ("collocation", "shooting")]
    observation, _ = (env.reset(seed=3)[0] for env in envs)
    controller, successes, over = controller_of("reach"), 0, False
    for _ in range(50):
        assert not over
        action, _ = controller.predict(observation)
        (observation, *_, over, told), (*_, paper_over, paper_told) = (env.step(action) for env in envs)
        tip, paper_tip = (env.unwrapped.core.record.tip[0, :3, 3] for env in envs)
        assert np.linalg.norm(paper_tip - tip) < 1e-5
        assert paper_told["is_success"] == told["is_success"] and paper_over == over
        assert paper_told["solver"]["iterations"] > told["solver"]["iterations"]  # residuals, where Newton takes few steps
        successes += told["is_success"]
    assert over and 0 < successes < 50
    assert np.linalg.norm(tip[:2]) > 1e-3
