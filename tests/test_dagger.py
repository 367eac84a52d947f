"""Imitation: who drives, what is recorded, what the network sees, and that it fits."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import tca_envs  # noqa: F401
from agents import dagger
from agents.dagger import DAgger
from agents.features import Features
from agents.sb3 import make
from agents.scripted import PickAndPlaceController


def test_the_network_sees_the_differences():
    env = gym.make("TCAPickAndPlace-v0")
    controller = PickAndPlaceController()
    observation, _ = env.reset(seed=3)
    for _ in range(4):  # twisted, and not yet there
        observation, *_ = env.step(controller.predict(observation)[0])
    features = Features(env.observation_space, "pick-and-place")
    batch = {key: torch.as_tensor(np.stack([value, value])) for key, value in observation.items()}
    found = features(batch).numpy()
    assert found.shape == (2, features.features_dim)
    np.testing.assert_array_equal(found[0], found[1])
    seen = observation["observation"].astype(float)
    yaw, twice = np.arctan2(seen[14], seen[13]), np.arctan2(seen[22], seen[21])
    away = seen[18:21] - seen[10:13]
    assert abs(yaw) > 0.1 and abs(away[0]) > 0.05 and abs(away[1]) > 0.05
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    to_target = observation["desired_goal"][:3].astype(float) - observation["achieved_goal"][:3]
    differences = np.concatenate([away, turn @ away[:2], to_target])
    relative = [np.cos(twice - 2.0 * yaw), np.sin(twice - 2.0 * yaw)]
    expected = np.concatenate([seen, observation["achieved_goal"], observation["desired_goal"], differences])
    expected = np.concatenate([expected, np.tanh(5.0 * differences), relative])
    np.testing.assert_allclose(found[0], expected, atol=1e-5)


@pytest.fixture
def learner():
    envs = make("TCAPickAndPlace-v0", 2)
    return DAgger("MultiInputPolicy", envs, controller="pick-and-place", n_steps=40, batch_size=80, n_epochs=20, seed=0)


def error(model):
    return float(np.mean([(model.predict(seen, deterministic=True)[0] - wanted) ** 2 for seen, wanted in model.record]))


@pytest.mark.parametrize("by_controller", [True, False], ids=["controller", "policy"])
def test_the_controller_is_recorded_whoever_drives(learner, by_controller, monkeypatch):
    monkeypatch.setattr(dagger, "EXPERT_STEPS", 80 if by_controller else 0)
    driven = []
    step = learner.env.step
    monkeypatch.setattr(learner.env, "step", lambda action: (driven.append(np.array(action)), step(action))[1])
    predicted = []
    predict = learner.predict
    monkeypatch.setattr(
        learner, "predict", lambda *given, **options: (predicted.append(predict(*given, **options)), predicted[-1])[1]
    )
    learner.learn(80)
    assert learner.num_timesteps == 80 and len(learner.record) == len(driven) == 40
    fresh = [PickAndPlaceController(), PickAndPlaceController()]
    for k, (seen, wanted) in enumerate(learner.record):
        for i, controller in enumerate(fresh):
            lane = {key: value[i] for key, value in seen.items()}
            np.testing.assert_allclose(controller.predict(lane)[0], wanted[i], atol=1e-6)
        np.testing.assert_array_equal(driven[k], wanted if by_controller else predicted[k][0])


def test_learning_goes_on_where_it_stopped(learner):
    learner.learn(80)
    left = {key: value.copy() for key, value in learner._last_obs.items()}
    learner.learn(80, reset_num_timesteps=False)
    for key, value in learner.record[40][0].items():
        np.testing.assert_array_equal(value, left[key])


def test_the_policy_is_fitted_to_the_record(learner):
    learner.learn(80)
    before = error(learner)
    for _ in range(10):
        learner._fit()
    assert error(learner) < 0.5 * before


def test_a_saved_policy_acts_alike_and_leaves_the_record_behind(learner, tmp_path):
    learner.learn(80)
    learner.save(tmp_path / "policy.zip")
    again = DAgger.load(tmp_path / "policy.zip", device="cpu")
    assert again.record == [] and again.controller == "pick-and-place"
    seen = learner.record[-1][0]
    np.testing.assert_array_equal(learner.predict(seen, deterministic=True)[0], again.predict(seen, deterministic=True)[0])
    learner.save_replay_buffer(tmp_path / "record.pkl")
    again.load_replay_buffer(tmp_path / "record.pkl")
    assert len(again.record) == 40


def test_a_controller_is_asked_for():
    env = make("TCAReach-v0", 1)
    with pytest.raises(ValueError, match="controller = 'juggle': expected one of 'reach', "):
        DAgger("MultiInputPolicy", env, controller="juggle", n_steps=2, batch_size=2)
    with pytest.raises(ValueError, match="controller = None: expected one of 'reach', "):
        DAgger("MultiInputPolicy", env, n_steps=2, batch_size=2).learn(2)


def test_other_controllers_can_be_imitated():
    env = make("TCAReach-v0", 1)
    model = DAgger("MultiInputPolicy", env, controller="reach", n_steps=20, batch_size=20, n_epochs=1)
    assert len(model.learn(20).record) == 20
