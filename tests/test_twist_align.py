"""TwistAlign: goals that can be held, yaw that does not jump, success and reward as documented."""

import gymnasium as gym
import numpy as np
import pytest

from tca_envs import registry
from tca_envs.mechanics import thermal
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.tasks.core import STEP_S


def goal(x=0.0, y=0.0, z=6.0, yaw=0.0):
    return np.array([x, y, z, np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])


def test_a_goal_is_the_tip_and_yaw_that_steady_powers_reach():
    task = registry.entry("twist-align").new()
    core = task.core(1)
    rng = np.random.default_rng(0)
    for _ in range(5):
        temperature = rng.uniform(AMBIENT, SOFT_LIMIT, 4)
        settled, good = core.settle(temperature[np.newaxis])
        assert good.all()
        core.reset(np.array([0]), np.zeros((1, 5)), np.zeros((1, 0)))
        action = 2.0 * thermal.steady_power(temperature, core.heating) / core.heating.max_power - 1.0
        for _ in range(int(40.0 / STEP_S)):
            core.step(action[np.newaxis])
        np.testing.assert_allclose(task.achieved(core.record), task.achieved(settled), atol=1e-4)


@pytest.mark.parametrize("split", ["train", "held-out"])
def test_goals_come_from_their_split_and_are_all_reached_within_a_turn(split):
    task = registry.entry("twist-align").new(split=split)
    core = task.core(1)
    drawn = []
    settle = core.settle
    core.settle = lambda temperature: (drawn.extend(temperature), settle(temperature))[1]
    goals, scenes = task.sample(core, np.random.default_rng(0).spawn(40))
    assert scenes.shape == (40, 0)
    assert all(task.of_this_split(temperature) for temperature in drawn)
    np.testing.assert_allclose(np.hypot(goals[:, 3], goals[:, 4]), 1.0, atol=1e-12)
    # Counted from 60 degrees down, no yaw lies in the quarter that heating does not reach.
    yaw = 60.0 - (60.0 - np.degrees(np.arctan2(goals[:, 4], goals[:, 3]))) % 360.0
    assert yaw.max() < 45.0 and yaw.min() > -280.0


@pytest.mark.parametrize(
    ("achieved", "success"),
    [
        (goal(), True),
        (goal(x=0.149), True),
        (goal(y=0.1, z=6.12), False),
        (goal(x=0.151), False),
        (goal(yaw=4.9), True),
        (goal(yaw=-4.9), True),
        (goal(yaw=5.1), False),
        (goal(yaw=180.0), False),
        (goal(x=0.149, yaw=4.9), True),
    ],
    ids=str,
)
def test_success_takes_1_5_millimetres_and_5_degrees(achieved, success):
    task = registry.entry("twist-align").new()
    assert bool(task.outcome(achieved, goal()).success) is success
    sparse = gym.make("TCATwistAlign-v0").unwrapped
    assert sparse.compute_reward(achieved, goal(), {}) == (0.0 if success else -1.0)


@pytest.mark.parametrize("turn", [-359.0, -200.0, -179.0, 0.0, 91.0, 178.0])
def test_yaw_errors_do_not_depend_on_where_the_circle_is_cut(turn):
    task = registry.entry("twist-align").new()
    for error in (0.0, 3.0, -90.0, 179.0):
        found = task.outcome(goal(yaw=turn + error), goal(yaw=turn)).measures
        assert found["yaw_error_deg"] == pytest.approx(abs(error), abs=1e-9)


def test_the_dense_reward_weighs_both_tolerances_alike():
    env = gym.make("TCATwistAlignDense-v0").unwrapped
    assert env.compute_reward(goal(x=0.15), goal(), {}) == pytest.approx(-0.15)
    assert env.compute_reward(goal(yaw=5.0), goal(), {}) == pytest.approx(-0.15)
    assert env.compute_reward(goal(x=3.0, y=4.0, yaw=-10.0), goal(), {}) == pytest.approx(-5.3)


def test_heating_the_helix_turns_counter_clockwise_as_seen_from_above():
    """z points down, so a negative turn about it."""
    env = gym.make("TCATwistAlign-v0")
    observation, _ = env.reset(seed=0)
    sines = [observation["observation"][12]]
    for _ in range(8):
        observation, *_ = env.step(np.array([-1.0, -1.0, -1.0, 0.0], np.float32))
        sines.append(observation["observation"][12])
    assert (np.diff(sines) < 0.0).all()
    np.testing.assert_allclose(observation["observation"][8:13], observation["achieved_goal"], atol=0.0)
