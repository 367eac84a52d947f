"""Scripted controllers solve their tasks from the observation; `evaluate` counts as documented."""

import gymnasium as gym
import numpy as np
import pytest

import tca_envs  # noqa: F401
from agents.evaluate import evaluate, wilson
from agents.scripted import (
    BENDING_STARTS,
    PickAndPlaceController,
    RandomPolicy,
    ReachController,
    Sight,
    TwistAlignController,
    plan,
    tip_and_yaw_at,
    tip_at,
    tool_at,
    yaw_gradient,
    yaw_of,
)
from tca_envs import presets
from tca_envs.mechanics import grasp
from tca_envs.mechanics.rotation import yaw_angle


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
    found = arm.equilibrium(plan(arm, tip_at(tip), BENDING_STARTS)).tip_pose[:3, 3]
    assert np.linalg.norm(found - tip) < 5e-5


def test_yaw_gradient_is_that_of_differences():
    arm = presets.whole_arm()
    here = arm.equilibrium([110.0, 60.0, 40.0, 80.0])
    gradient = yaw_gradient(here.tip_pose) @ here.tip_jacobian[3:]
    for i in range(4):
        step = 0.01 * np.eye(4)[i]
        up, down = (yaw_of(arm.equilibrium(here.drive + sign * step, start=here)) for sign in (1.0, -1.0))
        assert gradient[i] == pytest.approx((up - down) / 0.02, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("aim", ["tip and yaw", "tool", "tool and yaw"])
def test_jacobians_of_aims_are_those_of_differences(aim):
    arm = presets.whole_arm()
    make = {
        "tip and yaw": tip_and_yaw_at(np.zeros(3), 0.0),
        "tool": tool_at(np.zeros(2), None),
        "tool and yaw": tool_at(np.zeros(2), -1.0),
    }[aim]
    here = arm.equilibrium([110.0, 60.0, 40.0, 80.0])
    _, jacobian = make(here)
    for i in range(4 if aim != "tool" else 3):
        step = 0.01 * np.eye(4)[i]
        up, down = (make(arm.equilibrium(here.drive + sign * step, start=here))[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(jacobian[:, i], (down - up) / 0.02, rtol=2e-3, atol=2e-8)


def twist_align_success(episodes):
    return evaluate(TwistAlignController(), gym.make("TCATwistAlign-v0", split="held-out"), episodes, seed=50_000)


def test_twist_align_controller_solves_held_out_goals():
    report = twist_align_success(100)
    assert report.success_rate >= 0.99
    assert report.solver_failures == 0


@pytest.mark.slow
def test_twist_align_controller_solves_a_thousand_held_out_goals():
    assert twist_align_success(1000).success_rate >= 0.99


def pick_and_place_success(episodes):
    return evaluate(PickAndPlaceController(), gym.make("TCAPickAndPlace-v0", split="held-out"), episodes, seed=50_000)


def test_pick_and_place_controller_solves_held_out_episodes():
    report = pick_and_place_success(40)
    assert report.successes >= 39
    assert report.solver_failures == 0


@pytest.mark.slow
def test_pick_and_place_controller_solves_two_hundred_held_out_episodes():
    assert pick_and_place_success(200).success_rate >= 0.95


def test_pick_and_place_goes_through_the_papers_sequence():
    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, _ = env.reset(seed=1)
    phases = []
    for _ in range(300):
        phase = controller.phase(Sight.of(observation))
        if phases[-1:] != [phase]:
            phases.append(phase)
        observation, *_ = env.step(controller.predict(observation)[0])
    assert phases == ["align", "open", "lower", "close", "lift", "untwist", "carry", "release", "leave"]


def test_pick_and_place_begins_again_where_the_object_was_lost():
    """The object is knocked out of the jaws while it is carried, and lands elsewhere."""
    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, _ = env.reset(seed=1)
    knocked = False
    for _ in range(300):
        if not knocked and controller.phase(Sight.of(observation)) == "carry":
            scene = env.unwrapped.core.record.scene[0]
            scene[grasp.HELD], scene[grasp.DROP], scene[grasp.Z] = 0.0, 0.0, grasp.resting(presets.OBJECT, presets.SITE)
            scene[grasp.X] += 2e-3
            env.unwrapped.core.record.payload[:] = env.unwrapped.core.rest.payload
            knocked = True
        observation, *_, info = env.step(controller.predict(observation)[0])
    assert knocked and info["is_success"]


def test_what_pick_and_place_sees_is_what_there_is():
    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, _ = env.reset(seed=1)
    for _ in range(50):
        observation, *_ = env.step(controller.predict(observation)[0])
        sight, record = Sight.of(observation), env.unwrapped.core.record
        np.testing.assert_allclose(sight.temperature, record.temperature[0], atol=1e-4)
        assert sight.held == (record.scene[0, grasp.HELD] > 0.5)
        assert sight.yaw == pytest.approx(yaw_angle(record.tip[0]), abs=1e-6)
        np.testing.assert_allclose(sight.object, record.scene[0, [grasp.X, grasp.Y, grasp.Z]], atol=1e-7)
        assert np.sin(2.0 * (sight.object_yaw - record.scene[0, grasp.YAW])) == pytest.approx(0.0, abs=1e-6)


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
