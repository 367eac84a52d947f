"""The vector environment: step by step what Gymnasium's own makes of single environments, whatever their number."""

import copy
import pickle
import re
import subprocess
import sys

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from tca_envs import batch, registry
from tca_envs.mechanics import Rung, continuation, grasp
from tca_envs.tasks import core
from tca_envs.tasks.reach import Reach
from tca_envs.vector import ArmVectorEnv

IDS = sorted(name for name, spec in gym.registry.items() if "tca_envs" in str(spec.entry_point))
LANES = 3
EPISODE = 5
MODES = list(AutoresetMode)


def native(name="TCAReach-v0", lanes=LANES, **options):
    return gym.make_vec(name, num_envs=lanes, **{"max_episode_steps": EPISODE, **options})


def sync(name="TCAReach-v0", lanes=LANES, autoreset_mode=AutoresetMode.NEXT_STEP, **options):
    options = {"max_episode_steps": EPISODE, **options}
    return SyncVectorEnv([lambda: gym.make(name, **options)] * lanes, autoreset_mode=autoreset_mode)


def actions(env, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def assert_same(first, second, where="result"):
    """Same types, keys, dtypes and shapes, and every bit."""
    assert type(first) is type(second), where
    if isinstance(first, dict):
        assert set(first) == set(second), where
        for key in first:
            assert_same(first[key], second[key], f"{where}[{key!r}]")
    elif isinstance(first, tuple | list) or (isinstance(first, np.ndarray) and first.dtype == object):
        assert len(first) == len(second), where
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    elif isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape), where
        assert first.tobytes() == second.tobytes(), where
    else:
        assert first == second, where


@pytest.fixture
def failing(monkeypatch):
    """A solver that has no answer where the first TCA is hotter than 50 degC; goals are drawn without one."""
    solve = continuation.solve

    def solve_or_fail(arm, lanes, asked, *rest):
        before = [values.copy() for values in lanes]
        report = solve(arm, lanes, asked, *rest)
        bad = asked[:, 0] > 50.0
        for values, kept in zip(lanes, before, strict=True):
            values[bad] = kept[bad]
        report["rung"][bad], report["residual"][bad], report["iterations"][bad], report["jumped"][bad] = (
            Rung.FAILED,
            1.0,
            7,
            False,
        )
        return report

    def sample(task, core, generators):
        return np.array([generator.random(3) for generator in generators]), np.empty((len(generators), 0))

    monkeypatch.setattr(batch, "new_solver", lambda solver: solve_or_fail)
    monkeypatch.setattr(Reach, "sample", sample)


def test_every_id_has_its_native_vector_environment():
    assert len(IDS) == 6
    for name in IDS:
        env = gym.make_vec(name, num_envs=2)
        assert type(env) is ArmVectorEnv
        assert env.max_episode_steps == gym.spec(name).max_episode_steps
        assert repr(env) == f"ArmVectorEnv({name}, num_envs=2)"
        single, other = gym.make(name), gym.make_vec(name, num_envs=2, vectorization_mode="sync")
        assert env.single_action_space == single.action_space and env.single_observation_space == single.observation_space
        assert env.action_space == other.action_space and env.observation_space == other.observation_space
        assert env.metadata == other.metadata | {"render_modes": ["rgb_array", "depth_array"]}  # a window is for one arm
        assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
        assert env.reset(seed=0)[0] in env.observation_space
        again = gym.make_vec(env.spec)
        assert type(again) is ArmVectorEnv and (again.num_envs, again.reward) == (2, env.reward)


def test_metadata_belongs_to_the_instance():
    first, second = native(autoreset_mode="SameStep"), native()
    first.metadata["mine"] = 1
    assert "mine" not in second.metadata and second.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@pytest.mark.parametrize("name", IDS)
def test_it_is_gymnasiums_own_vector_environment_step_by_step(name, mode):
    ours, theirs = native(name, autoreset_mode=mode), sync(name, autoreset_mode=mode)
    assert_same(ours.reset(seed=3), theirs.reset(seed=3))
    ends = 0
    for k, action in enumerate(actions(ours, 3 * EPISODE + 4)):
        found = ours.step(action)
        assert_same(found, theirs.step(action))
        ended = found[3]
        ends += int(ended.sum())
        # Some lanes start anew before their time, so that they do not all end together.
        early = np.arange(LANES) == 1 if k == 2 else np.zeros(LANES, dtype=bool)
        mask = early | (ended & (mode is AutoresetMode.DISABLED))
        if mask.any():
            assert_same(ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask.copy()}))
    assert ends >= 2 * LANES
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.np_random_seed, theirs.np_random_seed)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP], ids=lambda mode: mode.value)
def test_lanes_without_equilibrium_are_truncated_as_gymnasiums_own(mode, failing):
    ours, theirs = native(autoreset_mode=mode), sync(autoreset_mode=mode)
    assert_same(ours.reset(seed=3), theirs.reset(seed=3))
    ends, failed = 0, 0
    for action in actions(ours, 24):
        found = ours.step(action)
        assert_same(found, theirs.step(action))
        solver = found[4].get("final_info", found[4])["solver"]
        failed += int((solver["_converged"] & ~solver["converged"]).sum())
        ends += int(found[3].sum())
    assert 0 < failed < ends


def test_seeds_may_be_an_integer_or_a_list_with_gaps():
    ours, theirs = native(), sync()
    for seed in (7, [5, 5, 9], [1, None, 2], (4, None, None)):
        assert_same(ours.reset(seed=seed), theirs.reset(seed=seed))
        assert_same(ours.np_random_seed, theirs.np_random_seed)
    mask = np.array([True, False, True])
    assert_same(ours.reset(seed=11, options={"reset_mask": mask}), theirs.reset(seed=11, options={"reset_mask": mask.copy()}))
    assert_same(ours.reset(), theirs.reset())
    assert len({generator.random() for generator in native().np_random}) == LANES  # without a seed, each has its own
    assert mask.tolist() == [True, False, True]
    options = {"reset_mask": mask}
    ours.reset(options=options)
    assert "reset_mask" in options


@pytest.mark.parametrize("name", ["TCAReachDense-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0"])
@pytest.mark.parametrize("lanes", [1, 2, 9])
def test_each_lane_is_the_single_environment_whatever_their_number(name, lanes):
    """Every lane is seeded alike, so that for any N the rows are compared with the same few single environments."""
    many = gym.make_vec(name, num_envs=lanes, threads=1, autoreset_mode="SameStep", max_episode_steps=12)
    seeds = [20 + i % 3 for i in range(lanes)]
    singles = [gym.make(name, max_episode_steps=12) for _ in range(min(lanes, 3))]
    observation, info = many.reset(seed=seeds)
    chosen, as_list = actions(singles[0], 30), DictInfoToList(many)
    told = [single.reset(seed=20 + i) for i, single in enumerate(singles)]
    if "PickAndPlace" in name:  # with the object in the closed jaws
        for scene in (many.core.record.scene, *(single.unwrapped.core.record.scene for single in singles)):
            scene[:, [grasp.HELD, grasp.TOUCHED]] = 1.0
            scene[:, [grasp.ALONG, grasp.DROP]] = 2e-3, 1e-3
    for action in chosen:
        for lane in range(lanes):
            for key, values in observation.items():
                assert values[lane].tobytes() == told[lane % 3][0][key].tobytes()
        listed = as_list._convert_info_to_list({key: value for key, value in info.items() if "final" not in key})
        for lane in range(lanes):
            assert pickle.dumps(plain(listed[lane])) == pickle.dumps(plain(told[lane % 3][1]))
        observation, reward, terminated, truncated, info = many.step(np.repeat(action[np.newaxis], lanes, axis=0))
        told = [single.step(action) for single in singles]
        for lane in range(lanes):
            assert (reward[lane], terminated[lane], truncated[lane]) == told[lane % 3][1:4]
        told = [
            single.reset() if ended else (seen, info) for single, (seen, _, _, ended, info) in zip(singles, told, strict=True)
        ]


def plain(info):
    """Return an info as Python's own types, sorted by key."""
    return {key: plain(info[key]) if isinstance(info[key], dict) else np.asarray(info[key]).item() for key in sorted(info)}


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="there is one thread only")
@pytest.mark.parametrize("name", ["TCAReach-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0"])
def test_the_number_of_threads_changes_nothing(name):
    one, two = (native(name, 45, threads=threads) for threads in (1, 2))
    assert_same(one.reset(seed=8), two.reset(seed=8))
    for action in actions(one, 2 * EPISODE + 2):
        assert_same(one.step(action), two.step(action))
    assert_same(one.get_state(), two.get_state())


def arrays(result):
    """Yield all arrays of numbers in it."""
    if isinstance(result, np.ndarray) and result.dtype != object:
        yield result
    elif isinstance(result, dict | tuple | list | np.ndarray):
        for part in result.values() if isinstance(result, dict) else result:
            yield from arrays(part)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_is_returned_belongs_to_the_caller(mode):
    env = native(autoreset_mode=mode)
    chosen = actions(env, 3 * EPISODE)
    kept = [env.reset(seed=0), *(env.step(action) for action in chosen)]
    before, twin = copy.deepcopy(kept), copy.deepcopy(env)
    env.step(chosen[0])
    twin.step(chosen[0])
    assert_same(kept, before)
    for result in kept:
        mine = list(arrays(result))
        assert all(values.base is None for values in mine)
        for i, values in enumerate(mine):
            assert not any(np.shares_memory(values, other) for other in mine[:i])
            values[:] = 1
    assert_same(env.step(chosen[1]), twin.step(chosen[1]))


def test_lanes_that_start_anew_rest_meanwhile():
    """Nothing that their past makes hard to solve is asked of the solver again."""
    env = native()
    env.reset(seed=0)
    seen, step = [], env.task.step
    env.task.step = lambda core, action: (seen.append((core.record.temperature.max(), action.max())), step(core, action))[1]
    for action in actions(env, EPISODE + 1):
        env.step(action)
    assert min(seen[1:EPISODE])[0] > 25.0 and seen[EPISODE] == (25.0, -1.0)


def test_each_lane_draws_until_it_is_content_and_then_no_more(monkeypatch):
    """Drawn in rounds with others, each episode is what its generator makes of it alone, for all tasks."""
    for name, split in (("reach", "train"), ("twist-align", "held-out"), ("pick-and-place", "train")):
        task = registry.entry(name).new(split=split)
        arms, settle, rejected = task.core(1), core.Core.settle, []

        def cool(arms, temperature, payload=None, settle=settle, rejected=rejected):
            record, good = settle(arms, temperature, payload)
            rejected.append((temperature[:, 0] > 70.0).sum())
            return record, good & (temperature[:, 0] <= 70.0)

        monkeypatch.setattr(core.Core, "settle", cool)
        together, alone = ([np.random.default_rng(i) for i in range(12)] for _ in range(2))
        goals, scenes = task.sample(arms, together)
        assert len(rejected) > 1 and sum(rejected) > 3
        for i, generator in enumerate(alone):
            goal, scene = task.sample(arms, [generator])
            assert goal.tobytes() == goals[i].tobytes() and scene.tobytes() == scenes[i].tobytes()
            assert generator.random() == together[i].random()
        monkeypatch.setattr(core.Core, "settle", settle)


def test_an_arm_that_falls_on_the_way_is_not_settled(monkeypatch):
    arms, solve, calls = registry.entry("reach").new().core(1), continuation.solve, []

    def falls_once(*arguments):
        report = solve(*arguments)
        calls.append(arguments)
        report["jumped"][1] = len(calls) == 2
        return report

    monkeypatch.setattr(arms, "solve", falls_once)
    record, good = arms.settle(np.full((3, 3), 60.0))
    assert good.tolist() == [True, False, True] and len(calls) == len(core.RAMP)
    np.testing.assert_array_equal(record.temperature, 60.0)


@pytest.mark.parametrize("name", ["TCAReach-v0", "TCAPickAndPlace-v0"])
@pytest.mark.parametrize("way", ["deepcopy", "pickle", "state"])
def test_copies_in_mid_episode_continue_bitwise(name, way):
    env = native(name)
    chosen = actions(env, 20)
    env.reset(seed=1)
    for action in chosen[: EPISODE + 2]:
        env.step(action)
    if way == "state":
        twin = native(name)
        twin.reset(seed=77)
        twin.set_state(pickle.loads(pickle.dumps(env.get_state())))
    else:
        twin = copy.deepcopy(env) if way == "deepcopy" else pickle.loads(pickle.dumps(env))
    for action in chosen[EPISODE + 2 :]:
        assert_same(env.step(action), twin.step(action))
    assert_same(env.reset(), twin.reset())


def test_a_foreign_state_is_refused_and_changes_nothing():
    env = native()
    env.reset(seed=1)
    before = env.get_state()
    for wrong, message in (
        (gym.make("TCAReach-v0").unwrapped.get_state(), "state has arrays"),
        (native(lanes=2).get_state(), "state has arrays"),
        ({**before, "tip": np.full_like(before["tip"], np.nan)}, r"state\['tip'\] = "),
        ({**before, "rng": before["rng"][:2]}, r"state\['rng'\] = "),
        ({**before, "rng": [*before["rng"][:2], "dice"]}, r"state\['rng'\] = "),
    ):
        with pytest.raises(ValueError, match=message):
            env.set_state(wrong)
    assert_same(env.get_state(), before)


BAD_ACTIONS = [np.zeros((LANES, 2)), np.zeros(3), [[0.0]], "abc", None, [[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]]


@pytest.mark.parametrize("bad", BAD_ACTIONS, ids=str)
def test_bad_actions_are_refused_and_leave_the_episodes_as_they_were(bad):
    env = native()
    env.reset(seed=3)
    for action in actions(env, 2):
        env.step(action)
    before = env.get_state()
    with pytest.raises(ValueError, match="actions = "):
        env.step(bad)
    assert_same(env.get_state(), before)


def test_actions_of_lanes_that_start_anew_do_not_matter():
    env = native()
    env.reset(seed=3)
    env.reset(options={"reset_mask": np.array([False, True, True])})
    for action in actions(env, EPISODE - 1):
        env.step(action)
    env.reset(options={"reset_mask": np.array([False, True, True])})
    env.step(action)
    twin = copy.deepcopy(env)
    wild = action.copy()
    wild[0] = np.nan
    assert_same(env.step(wild), twin.step(action))
    with pytest.raises(ValueError, match="actions = "):
        env.step(wild)


def test_steps_before_a_reset_are_refused():
    env = native()
    with pytest.raises(ResetNeeded):
        env.step(actions(env, 1)[0])
    with pytest.raises(ResetNeeded, match="all lanes"):
        env.reset(options={"reset_mask": np.array([True, False, True])})
    env = native(autoreset_mode="Disabled")
    env.reset(seed=0)
    for action in actions(env, EPISODE):
        env.step(action)
    before = env.get_state()
    with pytest.raises(ResetNeeded, match=re.escape("lanes [0, 1, 2]")):
        env.step(action)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match=re.escape("lanes [1]")):
        env.step(action)
    assert_same(env.get_state()["temperature"][1], before["temperature"][1])


@pytest.mark.parametrize(
    "mask", [[True, False, True], np.array([1, 0, 1]), np.ones(2, dtype=bool), np.zeros(LANES, dtype=bool), None], ids=str
)
def test_bad_masks_are_refused_and_change_nothing(mask):
    env = native()
    env.reset(seed=1)
    before = env.get_state()
    with pytest.raises(ValueError, match=re.escape("options['reset_mask'] = ")):
        env.reset(seed=2, options={"reset_mask": mask})
    assert_same(env.get_state(), before)


@pytest.mark.parametrize("seed", [-1, 1.5, "1", [1, 2], [1, 2, -3], [1, 2, 3.0], True, {}], ids=str)
def test_bad_seeds_are_refused_and_change_nothing(seed):
    env = native()
    env.reset(seed=1)
    before = env.get_state()
    with pytest.raises(ValueError, match=re.escape(f"seed = {seed!r}: expected ")):
        env.reset(seed=seed)
    assert_same(env.get_state(), before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("num_envs", 2.0),
        ("max_episode_steps", 0),
        ("max_episode_steps", "5"),
        ("autoreset_mode", "sometimes"),
        ("autoreset_mode", None),
        ("threads", 0),
        ("threads", True),
        ("threads", 10_000),
        ("task", "juggle"),
        ("reward", "golden"),
        ("split", "test"),
        ("tolerance", 1e-10),
    ],
)
def test_bad_arguments_are_refused(name, value):
    with pytest.raises(ValueError, match=re.escape(f"{name} = {value!r}: expected ")):
        ArmVectorEnv(**{"num_envs": 2, name: value})


def test_without_a_time_limit_episodes_do_not_end():
    for endless in ({}, {"max_episode_steps": None}, {"max_episode_steps": -1}):
        env = ArmVectorEnv(2, **endless)
        env.reset(seed=0)
        assert not any(env.step(action)[3].any() for action in actions(env, 102))


def test_arguments_reach_the_task_and_the_solver():
    env = gym.make_vec("TCAReach-v0", num_envs=2, split="held-out", tolerance=1e-3, reward="dense", threads=1)
    assert (env.task.split, env.task.tolerance, env.reward, env.core.threads) == ("held-out", 1e-3, "dense", 1)
    assert native().core.threads == native().threads == numba.config.NUMBA_NUM_THREADS
    assert gym.make("TCAReach-v0").unwrapped.core.threads == 1


def test_attributes_and_methods_of_lanes():
    ours, theirs = native("TCAReachDense-v0"), sync("TCAReachDense-v0")
    assert_same(ours.reset(seed=0), theirs.reset(seed=0))
    for name in ("reward", "render_mode", "action_space", "observation_space", "np_random_seed"):
        assert ours.get_attr(name) == theirs.get_attr(name)
    assert ours.call("render") == theirs.call("render") == (None,) * LANES
    assert ours.get_attr("metadata") == ({"render_modes": ["rgb_array", "depth_array"], "render_fps": 10},) * LANES
    goals = np.random.default_rng(0).normal(size=(2, 6, 3)).astype(np.float32)
    assert_same(ours.call("compute_reward", *goals, None), theirs.call("compute_reward", *goals, None))
    assert_same(ours.compute_reward(*goals, None), theirs.call("compute_reward", *goals, None)[0])
    generators = [np.random.default_rng(i) for i in range(LANES)]
    ours.set_attr("np_random", generators)
    theirs.set_attr("np_random", copy.deepcopy(generators))
    assert_same(ours.np_random_seed, theirs.np_random_seed)
    assert_same(ours.reset(), theirs.reset())
    ours.set_attr("reward", "sparse")
    assert set(ours.step(actions(ours, 1)[0])[1]) <= {-1.0, 0.0}
    with pytest.raises(AttributeError, match="'colour'"):
        ours.get_attr("colour")
    for name, values in (("colour", 1), ("reward", ["dense", "sparse", "dense"]), ("reward", ["dense"]), ("np_random", 1)):
        with pytest.raises(ValueError, match=" = "):
            ours.set_attr(name, values)
    assert ours.reward == "sparse"


def test_gymnasiums_wrappers_take_it():
    env = RecordEpisodeStatistics(native("TCAReachDense-v0"))
    _, _ = env.reset(seed=0)
    total = np.zeros(LANES)
    for action in actions(env, EPISODE):
        _, reward, _, _, info = env.step(action)
        total += reward
    np.testing.assert_allclose(info["episode"]["r"], total)
    env.close()
    assert env.unwrapped.closed


def test_a_fork_of_a_process_that_used_threads_goes_on_with_one(tmp_path):
    """OpenMP's threads are not there in a fork: a parallel loop would wait for them for ever."""
    script = """
import os, sys
import gymnasium as gym, numpy as np
import tca_envs
env = gym.make_vec("TCAReach-v0", num_envs=64, threads=2)
env.reset(seed=0)
actions = np.ones((64, 3), dtype=np.float32)
env.step(actions)
child = os.fork()
expected = env.step(actions)[0]["observation"] if child else None
if not child:
    np.save(sys.argv[1], env.step(actions)[0]["observation"])
    os._exit(0)
os.waitpid(child, 0)
assert np.array_equal(np.load(sys.argv[1]), expected)
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, str(tmp_path / "seen.npy")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
