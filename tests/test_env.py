"""Every registered environment: what Gymnasium, learners and people who publish expect of it."""

import copy
import pickle
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from tca_envs import batch
from tca_envs.mechanics import Rung, continuation, grasp
from tca_envs.mechanics.thermal import HARD_LIMIT, SOFT_LIMIT
from tca_envs.robots import CUT_OFF

IDS = sorted(name for name, spec in gym.registry.items() if "tca_envs" in str(spec.entry_point))


@pytest.fixture(params=IDS)
def env(request):
    made = gym.make(request.param)
    yield made
    made.close()


def actions(env, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def roll(env, chosen):
    """Return everything that the steps return."""
    return [env.step(action) for action in chosen]


def assert_same(first, second):
    """Bitwise: pickles of arrays, floats and dicts are equal only if every bit is."""
    for a, b in zip(first, second, strict=True):
        for x, y in zip(a, b, strict=True):
            if isinstance(x, dict) and "observation" in x:
                for key in x:
                    assert x[key].tobytes() == y[key].tobytes()
            else:
                assert x == y


def test_the_registry_holds_the_environments():
    assert (
        sorted(f"TCA{task}{reward}-v0" for task in ("Reach", "TwistAlign", "PickAndPlace") for reward in ("", "Dense")) == IDS
    )


def test_checkers_pass_without_a_warning(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)  # tests/test_render.py has a display for it
        check_env_sb3(env.unwrapped)


def test_spec_survives_json(env):
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert gym.make(spec).unwrapped.reward == env.unwrapped.reward


def test_time_limit_ends_the_episode_and_nothing_terminates(env):
    env.reset(seed=0)
    limit = 300 if "PickAndPlace" in env.spec.id else 100
    ends = [(terminated, truncated) for _, _, terminated, truncated, _ in roll(env, actions(env, limit))]
    assert ends == [(False, False)] * (limit - 1) + [(False, True)]


def test_reset_forgets_the_past_bitwise(env):
    chosen = actions(env, 100)
    first = env.reset(seed=5)
    expected = roll(env, chosen[:30])
    for seed, count in ((6, 100), (7, 3)):
        env.reset(seed=seed)
        roll(env, actions(env, count, seed))
    again = env.reset(seed=5)
    assert_same([first], [again])
    assert_same(expected, roll(env, chosen[:30]))
    fresh = gym.make(env.spec.id)
    fresh.reset(seed=5)
    assert_same(expected, roll(fresh, chosen[:30]))


def test_unseeded_resets_go_on_with_the_seeded_generator(env):
    env.reset(seed=5)
    goals = [env.reset()[0]["desired_goal"] for _ in range(3)]
    env.reset(seed=5)
    roll(env, actions(env, 10))
    for goal in goals:
        assert goal.tobytes() == env.reset()[0]["desired_goal"].tobytes()
    assert len({goal.tobytes() for goal in goals}) == 3


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_in_mid_episode_continue_bitwise(env, duplicate):
    chosen = actions(env, 60)
    env.reset(seed=1)
    roll(env, chosen[:20])
    twin = duplicate(env)
    expected = roll(env, chosen[20:])
    assert_same(expected, roll(twin, chosen[20:]))
    assert_same([env.reset()], [twin.reset()])


def test_state_continues_bitwise_in_another_environment(env):
    chosen = actions(env, 60)
    env.reset(seed=1)
    roll(env, chosen[:20])
    state = env.unwrapped.get_state()
    expected = roll(env.unwrapped, chosen[20:])
    other = gym.make(env.spec.id).unwrapped
    other.reset(seed=99)
    roll(other, chosen[:5])
    other.set_state(state)
    assert_same(expected, roll(other, chosen[20:]))
    assert_same([env.unwrapped.reset()], [other.reset()])


def test_a_foreign_state_is_refused_and_changes_nothing(env):
    env.reset(seed=1)
    unwrapped = env.unwrapped
    before = unwrapped.get_state()
    cold = {**before, "temperature": np.full_like(before["temperature"], np.nan)}
    for wrong, message in (
        ({}, "state has arrays"),
        ({**before, "tip": np.zeros((2, 4, 4))}, "state has arrays"),
        ({k: v for k, v in before.items() if k != "rng"}, "state has arrays"),
        (cold, r"state\['temperature'\] = "),
        ({**before, "rng": "dice"}, r"state\['rng'\] = 'dice'"),
    ):
        with pytest.raises(ValueError, match=message):
            unwrapped.set_state(wrong)
    after = unwrapped.get_state()
    assert all(np.array_equal(before[key], after[key]) for key in before if key != "rng")
    assert before["rng"] == after["rng"]


def test_observations_stay_in_their_finite_space(env):
    space = env.observation_space
    for box in space.values():
        assert np.isfinite(box.low).all() and np.isfinite(box.high).all() and box.dtype == np.float32
    size = env.action_space.shape[0]
    one_at_a_time = lambda k: np.where(np.arange(size) == k * size // 100, 1, -1)  # noqa: E731
    for policy in (lambda k: np.ones(size), lambda k: -np.ones(size), one_at_a_time):
        observation, _ = env.reset(seed=2)
        for k in range(100):
            assert observation in space
            observation, *_ = env.step(policy(k).astype(np.float32))
        assert observation in space


def test_rewards_are_those_of_compute_reward_for_one_goal_and_for_batches(env):
    observation, _ = env.reset(seed=0)
    rewards, achieved, desired = [], [], []
    for action in actions(env, 40):
        observation, reward, *_ = env.step(action)
        assert type(reward) is float
        rewards.append(reward)
        achieved.append(observation["achieved_goal"])
        desired.append(observation["desired_goal"])
    batch = env.unwrapped.compute_reward(np.array(achieved), np.array(desired), None)
    np.testing.assert_array_equal(batch, np.float32(rewards))
    shape = (8, 5, len(achieved[0]))
    grid = env.unwrapped.compute_reward(np.array(achieved).reshape(shape), np.array(desired).reshape(shape), [{}])
    np.testing.assert_array_equal(grid, np.float32(rewards).reshape(8, 5))


def test_sparse_reward_is_zero_within_a_millimetre_only():
    env = gym.make("TCAReach-v0").unwrapped
    goal = np.zeros(3)
    assert env.compute_reward(np.array([0.0999, 0.0, 0.0]), goal, {}) == 0.0
    assert env.compute_reward(np.array([0.0, 0.0, 0.1001]), goal, {}) == -1.0


def test_dense_reward_is_minus_the_distance_in_centimetres():
    env = gym.make("TCAReachDense-v0").unwrapped
    assert env.compute_reward(np.array([3.0, 4.0, 0.0]), np.zeros(3), {}) == -5.0


def test_info_says_the_same_as_the_observation(env):
    observation, info = env.reset(seed=0)
    keys = {"is_success", "distance_mm", "energy_J", "cost", "solver"}
    keys |= {"yaw_error_deg"} if "TwistAlign" in env.spec.id else set()
    muscles = env.unwrapped.core.record.temperature.shape[1]
    for action in [None, *actions(env, 20), *np.ones((30, *env.action_space.shape), np.float32)]:
        if action is not None:
            observation, _, _, _, info = env.step(action)
        assert set(info) == keys
        assert set(info["solver"]) == {"converged", "residual", "iterations", "rung", "jumped"}
        distance = np.linalg.norm(observation["achieved_goal"][:3].astype(float) - observation["desired_goal"][:3])
        assert info["distance_mm"] == pytest.approx(10.0 * distance, abs=1e-9)
        reward = gym.make(f"{env.spec.id.removesuffix('-v0').removesuffix('Dense')}-v0").unwrapped.compute_reward(
            observation["achieved_goal"], observation["desired_goal"], info
        )
        assert info["is_success"] is (reward == 0.0)
        assert info["solver"]["converged"] is True
        assert info["solver"]["residual"] < env.unwrapped.core.arm.residual_tolerance
    temperature = 25.0 + 125.0 * observation["observation"][:muscles].astype(float)
    assert info["cost"] == pytest.approx(np.maximum(temperature - SOFT_LIMIT, 0.0).sum(), abs=1e-3)
    assert info["cost"] > 0.0


def test_energy_is_power_times_time_from_the_start_of_the_episode(env):
    _, info = env.reset(seed=0)
    assert info["energy_J"] == 0.0
    full = env.unwrapped.core.heating.max_power
    np.testing.assert_allclose(full[:3], 2.0)
    *_, info = roll(env, np.zeros((5, *env.action_space.shape), np.float32))[-1]
    assert info["energy_J"] == pytest.approx(5 * 0.1 * 0.5 * full.sum())
    _, info = env.reset(seed=0)
    assert info["energy_J"] == 0.0


def test_the_cut_off_keeps_every_tca_below_the_hard_limit(env):
    env.reset(seed=0)
    roll(env, np.ones((100, *env.action_space.shape), np.float32))
    temperature = env.unwrapped.core.record.temperature
    np.testing.assert_allclose(temperature, CUT_OFF, rtol=1e-12)
    assert temperature.max() < HARD_LIMIT


@pytest.mark.parametrize("bad", [np.nan, np.inf, [0, 0], [[0, 0, 0]], 0.0, "abc", [[0], 0, 0], object()], ids=str)
def test_bad_actions_are_refused_and_leave_the_episode_as_it_was(env, bad):
    if isinstance(bad, float) and not np.isfinite(bad):
        bad = [*[0.0] * (env.action_space.shape[0] - 1), bad]
    env.reset(seed=3)
    roll(env, actions(env, 5))
    unwrapped, twin = env.unwrapped, copy.deepcopy(env.unwrapped)
    with pytest.raises(ValueError, match="action = "):
        unwrapped.step(bad)
    assert_same(roll(twin, actions(env, 5)), roll(unwrapped, actions(env, 5)))


def test_finite_actions_outside_the_box_are_clipped(env):
    env.reset(seed=3)
    twin = copy.deepcopy(env.unwrapped)
    rest = [0.3] * (env.action_space.shape[0] - 3)
    wild, tame = np.array([5.0, -1e30, *rest, 7.0], np.float32), np.array([1.0, -1.0, *rest, 1.0], np.float32)
    assert_same([env.unwrapped.step(wild)], [twin.step(tame)])


def test_a_failed_solve_keeps_the_last_good_state_and_truncates(env, monkeypatch):
    env.reset(seed=3)
    roll(env, actions(env, 5))
    unwrapped = env.unwrapped
    before = unwrapped.get_state()
    observation, *_ = batch.look(unwrapped.task, unwrapped.core, unwrapped.core.rest_report)

    def without_answer(arm, lanes, drive, *rest):
        report = np.zeros(len(drive), dtype=continuation.REPORT)
        report["rung"], report["residual"], report["iterations"] = Rung.FAILED, 1.0, 7
        return report

    monkeypatch.setattr(unwrapped.core, "solve", without_answer)
    after, reward, terminated, truncated, info = unwrapped.step(np.ones(env.action_space.shape, np.float32))
    assert (terminated, truncated) == (False, True)
    assert info["solver"] == {"converged": False, "residual": 1.0, "iterations": 7, "rung": Rung.FAILED, "jumped": False}
    assert np.isfinite(reward)
    for key in observation:
        assert observation[key][0].tobytes() == after[key].tobytes()
    state = unwrapped.get_state()
    before["steps"] += 1  # time goes on
    assert all(np.array_equal(before[key], state[key]) for key in before if key != "rng")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("task", "juggle"),
        ("reward", "golden"),
        ("split", "test"),
        ("tolerance", 1e-10),
        ("tolerance", 0.01),
        ("tolerance", "1e-5"),
    ],
)
def test_bad_arguments_are_refused(name, value):
    with pytest.raises(ValueError, match=re.escape(f"{name} = {value!r}: expected ")):
        gym.make("TCAReach-v0", **{name: value})


def test_metadata_belongs_to_the_instance():
    first, second = gym.make("TCAReach-v0").unwrapped, gym.make("TCAReach-v0").unwrapped
    first.metadata["mine"] = 1
    assert "mine" not in second.metadata


@pytest.mark.parametrize("action", ["random", "bang-bang"])
@pytest.mark.parametrize("name", ["TCAReach-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0"])
def test_long_rough_rides_never_fail(name, action):
    env = gym.make(name)
    rng = np.random.default_rng(0)
    shape = env.action_space.shape
    for seed in range(10):
        env.reset(seed=seed)
        if "PickAndPlace" in name and seed % 2:  # with the object in the closed jaws
            scene = env.unwrapped.core.record.scene[0]
            scene[[grasp.HELD, grasp.TOUCHED]] = 1.0
            scene[[grasp.ALONG, grasp.DROP]] = 2e-3, 1e-3
        for _ in range(100):
            command = rng.uniform(-1, 1, shape) if action == "random" else rng.choice([-1.0, 1.0], shape)
            observation, reward, _, _, info = env.step(command.astype(np.float32))
            assert info["solver"]["converged"]
            assert np.isfinite(reward) and all(np.isfinite(x).all() for x in observation.values())


@pytest.mark.parametrize("name", ["TCAReach-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0"])
def test_every_lane_of_a_batch_equals_the_single_environment_bitwise(name):
    env = gym.make(name).unwrapped
    task = env.task
    many, rng = task.core(7), np.random.default_rng(0)
    singles = [task.core(1) for _ in range(7)]
    goals, scenes = task.sample(many, rng.spawn(7))
    many.reset(np.arange(7), goals, scenes)
    for i, single in enumerate(singles):
        single.reset(np.array([0]), goals[i : i + 1], scenes[i : i + 1])
    for _ in range(20):
        command = rng.uniform(-1, 1, (7, task.actions))
        report = task.step(many, command)
        for i, single in enumerate(singles):
            alone = task.step(single, command[i : i + 1])
            assert alone.tolist() == report[i : i + 1].tolist()
            seen, seen_alone = batch.look(task, many, report)[0], batch.look(task, single, alone)[0]
            assert all(seen_alone[key].tobytes() == seen[key][i : i + 1].tobytes() for key in seen)
            assert single.record.strain.tobytes() == many.record.strain[i : i + 1].tobytes()
