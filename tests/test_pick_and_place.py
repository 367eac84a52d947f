"""PickAndPlace: where object and target lie, what is observed, and what counts as placed."""

import gymnasium as gym
import numpy as np
import pytest

from agents.scripted import PickAndPlaceController
from tca_envs import registry
from tca_envs.mechanics import grasp
from tca_envs.robots import paper
from tca_envs.tasks.pick_and_place import APART_CM, heading

AT_REST_CM = 8.28


@pytest.fixture(scope="module")
def task():
    return registry.entry("pick-and-place").new()


def test_the_object_lies_10_mm_under_the_jaws_of_the_cold_arm(task):
    core = task.core(1)
    below = grasp.resting(task.box, task.site) - task.tool(core.rest)[0, 2]
    assert below == pytest.approx(10e-3, abs=0.1e-3)


@pytest.mark.parametrize("split", ["train", "held-out"])
def test_object_and_target_can_be_reached_and_come_from_their_split(split):
    task = registry.entry("pick-and-place").new(split=split)
    core = task.core(1)
    drawn, settle = [], core.settle

    def remember(temperature, payload):
        drawn.append((temperature, payload))
        return settle(temperature, payload)

    core.settle = remember
    goals, scenes = task.sample(core, np.random.default_rng(0).spawn(20))
    for temperature, payload in drawn:
        for first, last in zip(*np.split(temperature, 2), strict=True):
            assert task.of_this_split([*first, *last[:3]])
            assert (first[:3] <= 100.0).all() and first[3] <= 125.0 and (last[:3] <= 120.0).all() and last[3] == 25.0
        empty, full = np.split(payload, 2)
        np.testing.assert_array_equal(empty, np.repeat(core.rest.payload, len(empty), axis=0))
        np.testing.assert_allclose(full[:, 0], paper.GRIPPER_MASS + paper.OBJECT.mass)
    # The last pair drawn is that of the last episode to be accepted.
    (*_, first), (*_, last) = np.split(drawn[-1][0], 2)
    here, there = settle(first[np.newaxis])[0], settle(last[np.newaxis], drawn[-1][1][-1])[0]
    (which,) = np.flatnonzero(np.abs(scenes[:, grasp.X] - task.tool(here)[0, 0]) < 1e-12)
    np.testing.assert_allclose(scenes[which, [grasp.X, grasp.Y]], task.tool(here)[0, :2], atol=1e-12)
    np.testing.assert_allclose(goals[which, :2], 100.0 * task.tool(there)[0, :2], atol=1e-10)
    assert np.sin(2.0 * (scenes[which, grasp.YAW] - heading(here)[0])) == pytest.approx(0.0, abs=1e-9)
    assert (np.linalg.norm(goals[:, :2] - 100.0 * scenes[:, [grasp.X, grasp.Y]], axis=1) >= APART_CM).all()
    np.testing.assert_allclose(goals[:, 2], AT_REST_CM)
    assert (goals[:, 3] == 1.0).all() and (scenes[:, grasp.HELD] == 0.0).all()


@pytest.mark.parametrize(
    ("achieved", "success"),
    [
        ([0.0, 0.0, AT_REST_CM, 1.0], True),
        ([0.29, 0.0, AT_REST_CM, 1.0], True),
        ([0.0, 0.31, AT_REST_CM, 1.0], False),
        ([0.0, 0.0, AT_REST_CM, 0.0], False),
        ([0.0, 0.0, AT_REST_CM - 0.5, 1.0], False),
    ],
    ids=str,
)
def test_success_takes_the_place_and_the_gripper_away(task, achieved, success):
    desired = np.array([0.0, 0.0, AT_REST_CM, 1.0])
    assert bool(task.outcome(achieved, desired).success) is success
    assert gym.make("TCAPickAndPlace-v0").unwrapped.compute_reward(np.array(achieved), desired, {}) == success - 1.0
    distance = np.linalg.norm(np.array(achieved)[:3] - desired[:3])
    dense = gym.make("TCAPickAndPlaceDense-v0").unwrapped.compute_reward(np.array(achieved), desired, {})
    assert dense == pytest.approx(-distance)


def lowered(temperature, x, y, depth):
    """The environment with the jaws of the straight arm lowered to `depth` [m] over an object at x, y [m] that lies along x."""
    env = gym.make("TCAPickAndPlace-v0").unwrapped
    env.reset(seed=0)
    record = env.core.record
    record.temperature[0, 4] = temperature
    record.scene[0] = 0.0
    record.scene[0, [grasp.X, grasp.Y, grasp.Z]] = x, y, grasp.resting(env.task.box, env.task.site)
    record.goal[0, :2] = 100.0 * x, 100.0 * y
    power = (temperature - 25.0) * env.core.heating.loss[4] / env.core.heating.max_power[4]
    for _ in range(20):
        done = env.task.tool(record)[0, 2] + record.scene[0, grasp.STAGE] >= depth
        action = np.array([-1.0, -1.0, -1.0, -1.0, 2.0 * power - 1.0, 0.0 if done else 1.0])
        observation, reward, _, _, info = env.step(action)
    return observation, reward, info, record.scene[0]


@pytest.mark.parametrize(
    ("temperature", "x", "y", "free"),
    [
        (25.0, 0.0, 0.0, False),  # closed jaws stand on it
        (147.0, 0.0, 0.0, False),  # open jaws straddle it
        (147.0, 0.0, 4e-3, False),  # they are around one end of it
        (147.0, 0.0, 12e-3, True),  # they are beside it
    ],
    ids=["on top", "around", "around one end", "beside"],
)
def test_an_object_that_the_gripper_touches_is_not_placed(temperature, x, y, free):
    observation, reward, info, scene = lowered(temperature, x, y, depth=84e-3)
    top = paper.TABLE - paper.OBJECT.height
    jaws = 1e-2 * observation["observation"][12]
    assert jaws == pytest.approx(top, abs=1e-5) if temperature == 25.0 else jaws > top + 3e-3
    assert observation["achieved_goal"][3] == free and info["is_success"] is free and reward == free - 1.0
    assert info["distance_mm"] == pytest.approx(0.0, abs=1e-3) and scene[grasp.HELD] == 0.0


def test_a_held_object_weighs_where_it_hangs():
    """Through the tilts of an episode: the payload's centre is that of gripper and object as they are drawn, a step later."""
    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, _ = env.reset(seed=1)
    record, seen = env.unwrapped.core.record, 0
    for _ in range(150):
        observation, *_ = env.step(controller.predict(observation)[0])
        if record.scene[0, grasp.HELD] < 0.5:
            continue
        seen += 1
        pose, stage = record.tip[0], np.array([0.0, 0.0, record.scene[0, grasp.STAGE]])
        ring = pose[:3, 3] + pose[:3, :3] @ paper.GRIPPER_CENTRE + stage
        both = paper.GRIPPER_MASS * ring + paper.OBJECT.mass * record.scene[0, [grasp.X, grasp.Y, grasp.Z]]
        mass = paper.GRIPPER_MASS + paper.OBJECT.mass
        found = pose[:3, 3] + pose[:3, :3] @ record.payload[0, 1:] + stage
        np.testing.assert_allclose(found, both / mass, atol=1e-9)
    assert seen > 20


def test_the_observation_says_what_is_there():
    """Through an episode that the scripted controller solves, against the record, column by column."""
    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, info = env.reset(seed=1)
    core = env.unwrapped.core
    held = forces = 0
    for _ in range(150):
        observation, _, _, _, info = env.step(controller.predict(observation)[0])
        seen, record, scene = observation["observation"].astype(float), core.record, core.record.scene[0]
        np.testing.assert_allclose(25.0 + 125.0 * seen[:5], record.temperature[0], atol=1e-4)
        np.testing.assert_allclose(seen[5:10] * core.heating.max_power, record.power[0], atol=1e-5)
        point = env.unwrapped.task.tool(record)[0] + [0.0, 0.0, scene[grasp.STAGE]]
        np.testing.assert_allclose(seen[10:13], 100.0 * point, atol=1e-5)
        assert np.arctan2(seen[14], seen[13]) == pytest.approx(heading(record)[0], abs=1e-6)
        assert seen[15] * 15e-3 == pytest.approx(scene[grasp.STAGE], abs=1e-8)
        np.testing.assert_allclose(seen[18:21], 100.0 * scene[[grasp.X, grasp.Y, grasp.Z]], atol=1e-5)
        np.testing.assert_allclose(seen[18:21], observation["achieved_goal"][:3], atol=0.0)
        assert seen[21] == pytest.approx(np.cos(2.0 * scene[grasp.YAW]), abs=1e-6)
        assert seen[22] == pytest.approx(np.sin(2.0 * scene[grasp.YAW]), abs=1e-6)
        between = scene[grasp.HELD] + scene[grasp.ASTRIDE] > 0.5
        opening = float(paper.ring().gap(record.temperature[0, 4]))
        assert seen[16] == pytest.approx(100.0 * max(opening, 3e-3 * between), abs=1e-6)
        if scene[grasp.HELD] > 0.5:
            held += 1
            pinch = paper.ring().pinch(record.temperature[0, 4], paper.OBJECT.width)
            assert 0.05 * seen[17] == pytest.approx(float(pinch), abs=1e-5)
            assert record.payload[0, 0] == pytest.approx(paper.GRIPPER_MASS + paper.OBJECT.mass)
        elif not between:
            assert seen[17] == 0.0
            np.testing.assert_allclose(record.payload, core.rest.payload)
        forces += seen[17] > 0.0
        told = env.unwrapped.task.outcome(observation["achieved_goal"], observation["desired_goal"])
        assert info["is_success"] is bool(told.success)
    assert held > 20 and forces >= held and info["is_success"]


def test_the_tool_is_between_the_jaws_of_the_drawn_ring():
    """The jaws of the closed ring meet where the tool is."""
    ring = paper.ring()
    jaw = ring.half().equilibrium([25.0]).tip_pose[:3, 3]
    assert pytest.approx(jaw[0], abs=1e-6) == paper.JAW_DEPTH and jaw[2] == pytest.approx(0.0, abs=1e-6)
