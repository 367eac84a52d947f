"""Goals of Reach: reachable, held out where they should be, and the same for everybody."""

import gymnasium as gym
import numpy as np
import pytest

from tca_envs import registry
from tca_envs.mechanics import thermal
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.tasks.core import STEP_S
from tca_envs.tasks.task import held_out


def test_a_goal_is_the_tip_that_steady_powers_reach():
    task = registry.entry("reach").new()
    core = task.core(1)
    rng = np.random.default_rng(0)
    for _ in range(10):
        temperature = rng.uniform(AMBIENT, SOFT_LIMIT, 3)
        settled, good = core.settle(temperature[np.newaxis])
        assert good.all()
        core.reset(np.array([0]), np.zeros((1, 3)), np.zeros((1, 0)))
        action = 2.0 * thermal.steady_power(temperature, core.heating) / core.heating.max_power - 1.0
        for _ in range(int(40.0 / STEP_S)):
            core.step(action[np.newaxis])
        np.testing.assert_allclose(task.achieved(core.record), task.achieved(settled), atol=1e-5)


def test_splits_are_a_fifth_and_disjoint():
    rng = np.random.default_rng(0)
    share = np.mean([held_out(rng.uniform(AMBIENT, SOFT_LIMIT, 3), AMBIENT) for _ in range(20_000)])
    assert share == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("split", ["train", "held-out"])
def test_goals_come_from_their_split(split, monkeypatch):
    task = registry.entry("reach").new(split=split)
    core = task.core(1)
    drawn = []
    settle = core.settle

    def remember(temperature):
        drawn.extend(temperature)
        return settle(temperature)

    monkeypatch.setattr(core, "settle", remember)
    task.sample(core, np.random.default_rng(0).spawn(30))
    assert 30 <= len(drawn) <= 32  # where an arm could buckle, another one is drawn
    assert all(held_out(temperature, AMBIENT) == (split == "held-out") for temperature in drawn)


def test_held_out_goals_lie_apart_from_training_goals():
    """The nearest training goal of a grid is typically half a success radius away or more: a split for interpolation."""
    core = registry.entry("reach").new().core(1)
    grid = np.stack(np.meshgrid(*[AMBIENT + 6.25 + 12.5 * np.arange(10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    held = np.array([held_out(temperature, AMBIENT) for temperature in grid])
    tips = core.settle(grid)[0].tip[:, :3, 3]
    nearest = [np.linalg.norm(tips[~held] - tip, axis=1).min() for tip in tips[held]]
    assert np.median(nearest) > 5e-4


def test_goals_do_not_depend_on_the_episode_before():
    env = gym.make("TCAReach-v0", split="held-out")
    goals = [env.reset(seed=seed)[0]["desired_goal"] for seed in (1, 2, 1)]
    assert goals[0].tobytes() == goals[2].tobytes() != goals[1].tobytes()


def test_the_arm_hangs_straight_at_the_start_and_bends_towards_a_hot_tca():
    env = gym.make("TCAReach-v0")
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation["achieved_goal"][:2], 0.0, atol=1e-6)
    for _ in range(12):
        observation, *_ = env.step(np.array([1.0, -1.0, -1.0], np.float32))
    x, y, z = observation["achieved_goal"]
    assert x > 0.4 and abs(y) < 1e-4 and z < 4.6
    for _ in range(40):
        observation, *_ = env.step(np.array([1.0, -1.0, -1.0], np.float32))
    x, y, z = observation["achieved_goal"]
    assert x > 0.8 and abs(y) > 0.05, "above about 145 degC it buckles to a side"
