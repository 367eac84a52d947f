"""Scripted controllers solve their tasks from the observation; `evaluate` counts as documented."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import tca_envs  # noqa: F401
from agents.evaluate import MOST_LANES, evaluate, lanes_for, wilson
from agents.scripted import (
    PickAndPlaceController,
    RandomPolicy,
    ReachController,
    Sight,
    TwistAlignController,
    plan,
    starts,
    tip_and_yaw_at,
    tip_at,
    tool_at,
    yaw_gradient,
    yaw_of,
)
from tca_envs.mechanics import grasp
from tca_envs.robots import paper
from tca_envs.rotation import yaw_angle


def held_out(name, episodes):
    return gym.make_vec(name, lanes_for(episodes), split="held-out")


def reach_success(episodes):
    return evaluate(ReachController(), held_out("TCAReach-v0", episodes), episodes, seed=50_000)


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
    arm = paper.BENDING.built()
    tip = arm.equilibrium([60.0, 120.0, 30.0]).tip_pose[:3, 3]
    found = arm.equilibrium(plan(paper.BENDING, tip_at(tip), starts(paper.BENDING))).tip_pose[:3, 3]
    assert np.linalg.norm(found - tip) < 5e-5


def test_yaw_gradient_is_that_of_differences():
    arm = paper.WHOLE.built()
    here = arm.equilibrium([110.0, 60.0, 40.0, 80.0])
    gradient = yaw_gradient(here.tip_pose) @ here.tip_jacobian[3:]
    for i in range(4):
        step = 0.01 * np.eye(4)[i]
        up, down = (yaw_of(arm.equilibrium(here.drive + sign * step, start=here)) for sign in (1.0, -1.0))
        assert gradient[i] == pytest.approx((up - down) / 0.02, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("aim", ["tip and yaw", "tool", "tool and yaw"])
def test_jacobians_of_aims_are_those_of_differences(aim):
    arm = paper.WHOLE.built()
    make = {
        "tip and yaw": tip_and_yaw_at(np.zeros(3), 0.0),
        "tool": tool_at(paper.GRIPPING, np.zeros(2), None),
        "tool and yaw": tool_at(paper.GRIPPING, np.zeros(2), -1.0),
    }[aim]
    here = arm.equilibrium([110.0, 60.0, 40.0, 80.0])
    _, jacobian = make(here)
    for i in range(4 if aim != "tool" else 3):
        step = 0.01 * np.eye(4)[i]
        up, down = (make(arm.equilibrium(here.drive + sign * step, start=here))[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(jacobian[:, i], (down - up) / 0.02, rtol=2e-3, atol=2e-8)


def twist_align_success(episodes):
    return evaluate(TwistAlignController(), held_out("TCATwistAlign-v0", episodes), episodes, seed=50_000)


def test_twist_align_controller_solves_held_out_goals():
    report = twist_align_success(100)
    assert report.success_rate >= 0.99
    assert report.solver_failures == 0


@pytest.mark.slow
def test_twist_align_controller_solves_a_thousand_held_out_goals():
    assert twist_align_success(1000).success_rate >= 0.99


def pick_and_place_success(episodes):
    return evaluate(PickAndPlaceController(), held_out("TCAPickAndPlace-v0", episodes), episodes, seed=50_000)


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
        phase = controller.phase(Sight.of(observation, controller.task))
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
        if not knocked and controller.phase(Sight.of(observation, controller.task)) == "carry":
            scene = env.unwrapped.core.record.scene[0]
            scene[grasp.HELD], scene[grasp.DROP], scene[grasp.Z] = 0.0, 0.0, grasp.resting(paper.OBJECT, controller.task.site)
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
        sight, record = Sight.of(observation, controller.task), env.unwrapped.core.record
        np.testing.assert_allclose(sight.temperature, record.temperature[0], atol=1e-4)
        assert sight.held == (record.scene[0, grasp.HELD] > 0.5)
        assert sight.yaw == pytest.approx(yaw_angle(record.tip[0]), abs=1e-6)
        np.testing.assert_allclose(sight.object, record.scene[0, [grasp.X, grasp.Y, grasp.Z]], atol=1e-7)
        assert np.sin(2.0 * (sight.object_yaw - record.scene[0, grasp.YAW])) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("name", "controller"), [("TCAReach-v0", ReachController), ("TCATwistAlign-v0", TwistAlignController)])
def test_controllers_solve_a_task_with_another_robot_and_other_steps(toy, name, controller):
    env = gym.make(name, split="held-out", robot=toy.ROBOT, step_s=0.2, max_episode_steps=50)
    report = evaluate(controller(env.unwrapped.task), env, 5, seed=7)
    assert report.success_rate == 1.0


def test_a_random_policy_fails_and_repeats():
    env = gym.make("TCAReach-v0")
    first = evaluate(RandomPolicy(3, seed=1), env, 5, seed=0)
    assert first == evaluate(RandomPolicy(3, seed=1), env, 5, seed=0)
    assert first.successes <= 1


class Idle:
    def predict(self, observation, deterministic):
        return np.zeros((len(observation), 3), np.float32), None


class Countdown(gym.Env):
    """Succeeds at some of its steps; what else is told is the seed times steps done."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (3,))
    converged = True

    def __init__(self, wins, steps=5):
        self.wins, self.steps = wins, steps
        self.seeds = []

    def info(self):
        number = float(self.seeds[-1] * self.t)
        solver = {"converged": self.converged}
        return {"is_success": self.t in self.wins, "distance_mm": number, "energy_J": 10.0 * number, "solver": solver}

    def reset(self, *, seed=None, options=None):
        self.t = 0
        self.seeds.append(1 if seed is None else seed)
        return np.zeros(1, np.float32), self.info()

    def step(self, action):
        self.t += 1
        return np.zeros(1, np.float32), -1.0, False, self.t == self.steps, self.info()


@pytest.mark.parametrize(
    ("wins", "successes", "seconds"),
    [
        ((3, 4, 5), 1, 0.3),
        ((1, 2, 4, 5), 1, 0.4),
        ((5,), 1, 0.5),
        ((0, 1, 2, 3, 4, 5), 1, 0.0),
        ((1, 2, 3, 4), 0, None),
        ((1, 2, 3, 4, 5), 1, 0.1),
    ],
)
def test_success_is_that_of_the_last_step_and_its_time_is_since_when_it_is_held(wins, successes, seconds):
    report = evaluate(Idle(), Countdown(wins), 1, seed=1)
    assert report.successes == successes
    assert report.time_to_success_s == pytest.approx(seconds)
    assert (report.episode_return, report.final_distance_mm, report.energy_J) == (-5.0, 5.0, 50.0)


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: SyncVectorEnv([lambda: env])], ids=["single", "batch"])
def test_time_to_success_counts_in_steps_of_the_task(wrap):
    env = Countdown((3, 4, 5))
    env.task = SimpleNamespace(step_s=0.2)
    assert evaluate(Idle(), wrap(env), 1).time_to_success_s == pytest.approx(0.6)


def test_an_episode_that_the_solver_ends_is_no_success():
    env = Countdown((5,))
    env.converged = False
    report = evaluate(Idle(), env, 2)
    assert (report.successes, report.solver_failures, report.time_to_success_s) == (0, 2, None)


def test_each_lane_runs_its_own_episodes_to_their_ends():
    """Lane 1 ends early and begins anew before the others are done; nothing of that counts."""
    envs = [Countdown((5,)), Countdown((2, 3), 3), Countdown((4,))]
    done = []
    report = evaluate(Idle(), SyncVectorEnv([lambda env=env: env for env in envs]), 5, seed=100, progress=done.append)
    assert envs[0].seeds == [100, 103] and envs[2].seeds == [102, 105]
    assert envs[1].seeds[0] == 101 and 104 in envs[1].seeds
    assert done == [1, 3, 4, 5]
    assert report.successes == 4 and report.solver_failures == 0
    assert report.time_to_success_s == pytest.approx((0.5 + 0.2 + 0.5 + 0.2) / 4)
    assert report.final_distance_mm == (500 + 303 + 510 + 515 + 312) / 5
    assert report.energy_J == 10 * report.final_distance_mm and report.episode_return == -(5 + 3 + 5 + 5 + 3) / 5


def test_a_batch_finds_what_single_episodes_find():
    for name, policy in (("TCAReach-v0", ReachController), ("TCAPickAndPlace-v0", PickAndPlaceController)):
        options = {"split": "held-out", "max_episode_steps": 40}
        batch = evaluate(policy(), gym.make_vec(name, 3, **options), 4, seed=7)
        assert batch == evaluate(policy(), gym.make(name, **options), 4, seed=7)


def test_a_controller_of_a_batch_remembers_each_lane(monkeypatch):
    """Actions are those of one controller for each lane; only a new goal is planned for, be it another lane's."""
    plans = []
    make_plan = ReachController.plan
    monkeypatch.setattr(ReachController, "plan", lambda self, goal: (plans.append(goal), make_plan(self, goal))[1])
    env = gym.make_vec("TCAReach-v0", 3)
    batch, single = ReachController(), [ReachController() for _ in range(3)]
    observation, _ = env.reset(seed=3)
    for step in range(4):
        if step == 2:
            observation["desired_goal"][1] = observation["desired_goal"][0]
        plans.clear()
        action, _ = batch.predict(observation)
        assert len(plans) == {0: 3, 1: 0, 2: 1, 3: 1}[step]
        assert action.shape == (3, 3) and action.dtype == np.float32
        for lane, controller in enumerate(single):
            row = {key: value[lane] for key, value in observation.items()}
            np.testing.assert_array_equal(action[lane], controller.predict(row)[0])
        observation, *_ = env.step(action)


def test_lanes_are_as_many_as_there_are_episodes_or_share_them_evenly():
    assert [lanes_for(count) for count in (1, 30, MOST_LANES)] == [1, 30, MOST_LANES]
    assert lanes_for(MOST_LANES + 1) == MOST_LANES // 2 + 1 and lanes_for(4 * MOST_LANES) == MOST_LANES


def test_wilson_interval():
    # 95 of 100: (0.888, 0.978), Wilson 1927 as tabulated by Newcombe 1998.
    assert wilson(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson(0, 10)[0] == 0.0 and wilson(10, 10)[1] == 1.0


@pytest.mark.parametrize("episodes", [0, -1, 1.5])
def test_bad_episodes_are_refused(episodes):
    with pytest.raises(ValueError, match="episodes = "):
        evaluate(Idle(), Countdown(()), episodes)


def test_another_way_to_restart_is_refused():
    env = SyncVectorEnv([lambda: Countdown(())], autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(ValueError, match=r"autoreset_mode AutoresetMode\.SAME_STEP: expected AutoresetMode\.NEXT_STEP"):
        evaluate(Idle(), env, 1)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 5), (6, 5)])
def test_bad_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match="successes = "):
        wilson(successes, trials)
