"""What the networks of Reach and TwistAlign are shown; of PickAndPlace see test_dagger.py."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import tca_envs  # noqa: F401
from agents.features import Features
from agents.hyperparameters import for_learner, settings_of
from agents.policies import learner
from agents.sb3 import make


@pytest.mark.parametrize("task", ["reach", "twist-align"])
def test_ways_left_are_added_plainly_and_sharply(task):
    env = gym.make({"reach": "TCAReach-v0", "twist-align": "TCATwistAlign-v0"}[task])
    observation, _ = env.reset(seed=1)
    for _ in range(5):
        observation, *_ = env.step(np.ones(env.action_space.shape, np.float32))
    features = Features(env.observation_space, task)
    found = features({key: torch.as_tensor(value[None]) for key, value in observation.items()}).numpy()[0]
    assert found.shape == (features.features_dim,)
    achieved, desired = (observation[key].astype(float) for key in ("achieved_goal", "desired_goal"))
    way = list(desired[:3] - achieved[:3])
    if task == "twist-align":
        yaw, goal = (np.arctan2(place[4], place[3]) for place in (achieved, desired))
        assert abs(goal - yaw) > 0.1
        way.append(np.sin(goal - yaw))
    plain = np.concatenate([observation[key] for key in ("observation", "achieved_goal", "desired_goal")])
    np.testing.assert_allclose(found, [*plain, *way, *np.tanh(5.0 * np.array(way))], atol=1e-5)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_policies_are_shown_them_and_are_saved_with_them(algorithm, tmp_path):
    made = for_learner({**settings_of("reach")[algorithm], "n_envs": 64})
    model = learner(algorithm)(env=make("TCAReachDense-v0", 64), **made)
    model.save(tmp_path / "policy.zip")
    again = learner(algorithm).load(tmp_path / "policy.zip")
    assert any(isinstance(module, Features) for module in again.policy.modules())
    observation, _ = gym.make("TCAReachDense-v0").reset(seed=0)
    np.testing.assert_array_equal(*(one.predict(observation, deterministic=True)[0] for one in (model, again)))
