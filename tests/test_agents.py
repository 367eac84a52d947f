"""Scripted controllers solve their tasks from the observation; `evaluate` counts as documented."""

import gymnasium as gym
import numpy as np
import pytest

import tca_envs  # noqa: F401
from agents.evaluate import evaluate, wilson
from agents.scripted import RandomPolicy, ReachController, plan
from tca_envs import presets


def reach_success(episodes):
    return evaluate(ReachController(), gym.make("TCAReach-v0", split="held-out"), episodes, seed=50_000)


def test_reach_controller_solves_held_out_goals():
    report = reach_success(100)
    assert report.success_rate >= 0.99
    assert report.solver_failures == 0


@pytest.mark.slow
def test_reach_controller_solves_a_thousand_held_out_goals():
    assert reach_success(1000).success_rate >= 0.99


def test_reach_controller_keeps_no_memory_but_its_plan():
    """A fresh controller that is shown a copy of the observation acts like the one that was there from the start."""
    env = gym.make("TCAReach-v0")
    observation, _ = env.reset(seed=3)
    ours = ReachController()
    for _ in range(20):
        shown = {key: value.copy() for key, value in observation.items()}
        action, _ = ours.predict(observation)
        fresh, _ = ReachController().predict(shown)
        np.testing.assert_array_equal(action, fresh)
        observation, *_ = env.step(action)


def test_reach_controller_heats_a_hot_tca_less_and_plans_anew_for_a_new_goal():
    env = gym.make("TCAReach-v0")
    observation, _ = env.reset(seed=3)
    controller = ReachController()
    controller.predict(observation)
    target = controller.target.copy()
    warm = {**observation, "observation": observation["observation"].copy()}
    warm["observation"][:3] = (controller.target - 25.0) / 125.0
    assert (controller.predict(warm)[0] <= controller.predict(observation)[0] + 1e-6).all()
    np.testing.assert_array_equal(controller.target, target)
    other, _ = env.reset(seed=4)
    controller.predict(other)
    assert not np.array_equal(controller.target, target)


def test_plan_finds_the_temperatures_of_a_reachable_tip():
    arm = presets.bending_arm()
    tip = arm.equilibrium([60.0, 120.0, 30.0]).tip_pose[:3, 3]
    found = arm.equilibrium(plan(arm, tip)).tip_pose[:3, 3]
    assert np.linalg.norm(found - tip) < 5e-5


def test_a_random_policy_fails_and_repeats():
    env = gym.make("TCAReach-v0")
    first = evaluate(RandomPolicy(3, seed=1), env, 5, seed=0)
    assert first == evaluate(RandomPolicy(3, seed=1), env, 5, seed=0)
    assert first.successes <= 1


class Script:
    """Heats full power for some steps, then nothing."""

    def __init__(self, on):
        self.on, self.step = on, 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.step = self.step % 100 + 1
        return np.full(3, 1.0 if self.step <= self.on else -1.0, np.float32), None


class Countdown(gym.Env):
    """Succeeds at the steps in `wins`, of 5."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (3,))

    def __init__(self, wins):
        self.wins = wins

    converged = True

    def info(self):
        won = self.t in self.wins
        return {"is_success": won, "distance_mm": 0.0, "energy_J": 1.0 * self.t, "solver": {"converged": self.converged}}

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1), self.info()

    def step(self, action):
        self.t += 1
        return np.zeros(1), -1.0, False, self.t == 5, self.info()


@pytest.mark.parametrize(
    ("wins", "successes", "seconds"),
    [((3, 4, 5), 1, 0.3), ((1, 2, 4, 5), 1, 0.4), ((5,), 1, 0.5), ((0, 1, 2, 3, 4, 5), 1, 0.0), ((1, 2, 3, 4), 0, None)],
)
def test_success_is_that_of_the_last_step_and_its_time_is_since_when_it_is_held(wins, successes, seconds):
    report = evaluate(Script(0), Countdown(wins), 1)
    assert report.successes == successes
    assert report.time_to_success_s == pytest.approx(seconds)
    assert (report.episode_return, report.energy_J) == (-5.0, 5.0)


def test_an_episode_that_the_solver_ends_is_no_success():
    env = Countdown((5,))
    env.converged = False
    report = evaluate(Script(0), env, 2)
    assert (report.successes, report.solver_failures, report.time_to_success_s) == (0, 2, None)


def test_wilson_interval():
    # 95 of 100: (0.888, 0.978), Wilson 1927 as tabulated by Newcombe 1998.
    assert wilson(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson(0, 10)[0] == 0.0 and wilson(10, 10)[1] == 1.0


@pytest.mark.parametrize("episodes", [0, -1, 1.5])
def test_bad_episodes_are_refused(episodes):
    with pytest.raises(ValueError, match="episodes = "):
        evaluate(Script(0), Countdown(()), episodes)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 5), (6, 5)])
def test_bad_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match="successes = "):
        wilson(successes, trials)
