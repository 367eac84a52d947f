"""The batch as SB3's learners see it: what single environments in SB3's own `DummyVecEnv` show, step by step."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

import tca_envs  # noqa: F401
from agents.sb3 import BatchVecEnv, make

SHORT = 12
"""Steps of an episode where its length does not matter."""


class Script(gym.Env):
    """Its steps are a script: "-" goes on, "s" too, with success, "T" terminates, "L" is truncated, "B" is both."""

    observation_space = gym.spaces.Dict({"a": gym.spaces.Box(-9, 9, (2,)), "b": gym.spaces.Box(-9, 9, (1,))})
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, script, render_mode=None):
        self.script = script
        self.render_mode = render_mode
        self.place = np.zeros(2, np.float32)
        self.level = 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.given = options
        self.t = 0
        self.place[:] = self.np_random.random(2)
        return self._observe(), {"first": float(self.place[0]), "options": str(options or None)}

    def step(self, action):
        mark = self.script[self.t]
        self.t += 1
        self.place += action[0]
        info = {"is_success": mark == "s", "deep": {"t": self.t}, "where": self.place.copy()}
        if mark in "TB":
            info["rare"] = 1.5
        return self._observe(), float(self.place[0]), mark in "TB", mark in "LB", info

    def _observe(self):
        return {"a": self.place.copy(), "b": self.place[:1].copy()}

    def render(self):
        return np.full((4, 6, 3), self.level, np.uint8)


SCRIPTS = ("--T", "---L", "-B", "-----T", "L")


def scripted(scripts=SCRIPTS, done_steps=None, render_mode=None, **options):
    vector = SyncVectorEnv(
        [lambda script=script: Script(script, render_mode) for script in scripts],
        autoreset_mode=AutoresetMode.DISABLED,
        **options,
    )
    return BatchVecEnv(vector, done_steps)


def assert_same(ours, theirs):
    """Numbers, arrays and what holds them are equal to the bit, and of the same types where SB3 makes them."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            assert_same(ours[key], theirs[key])
    elif isinstance(theirs, (list, tuple)):
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
    elif isinstance(theirs, np.ndarray):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert type(ours) is type(theirs) and ours == theirs


def march(ours, theirs, steps, seed=5):
    """Step both and compare all that they return; returns how many episodes ended."""
    for env in (ours, theirs):
        env.seed(seed)
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    rng, ends = np.random.default_rng(1), 0
    for _ in range(steps):
        action = rng.uniform(-1.0, 1.0, (ours.num_envs, *ours.action_space.shape)).astype(np.float32)
        mine, other = ours.step(action), theirs.step(action)
        assert_same(mine, other)
        assert_same(ours.reset_infos, theirs.reset_infos)
        ends += other[2].sum()
    return ends


@pytest.mark.parametrize("name", ["TCAReach-v0", "TCATwistAlignDense-v0", "TCAPickAndPlace-v0"])
def test_a_batch_shows_what_single_environments_show(name):
    options = {"max_episode_steps": SHORT, "split": "held-out"}
    theirs = DummyVecEnv([lambda: gym.make(name, **options) for _ in range(3)])
    assert march(make(name, 3, **options), theirs, 2 * SHORT + 3) == 6


def test_every_kind_of_end_is_that_of_single_environments():
    theirs = DummyVecEnv([lambda script=script: Script(script) for script in SCRIPTS])
    assert march(scripted(), theirs, 13) == 4 + 3 + 6 + 2 + 13


def test_seeds_are_those_of_make_vec_env():
    ours, theirs = make("TCAReach-v0", 3, seed=11), make_vec_env(lambda: gym.make("TCAReach-v0"), 3, 11)
    first = ours.reset()
    assert_same(first, theirs.reset())
    again = ours.reset()  # a seed is used once, then the generators go on
    assert_same(again, theirs.reset())
    assert not np.array_equal(first["desired_goal"], again["desired_goal"])
    ours.seed(11)
    assert_same(ours.reset(), first)


def test_nothing_that_was_returned_changes_later():
    env = scripted(copy=False)
    env.seed(0)
    kept = [env.reset()]
    for _ in range(9):
        before = deepcopy(kept)
        kept += env.step(np.full((5, 1), 0.1, np.float32))
        assert_same(kept[: len(before)], before)
    assert any("terminal_observation" in info for info in kept[4])


@pytest.mark.parametrize(("script", "ends"), [("--sss-L", [5]), ("-ss-sssL", [7]), ("ss-ss-L", [7]), ("sssL", [3, 6])])
def test_an_episode_ends_when_its_goal_was_held_long_enough(script, ends):
    env = scripted((script, "-------------T"), done_steps=3)
    env.reset()
    for step in range(1, ends[-1] + 1):
        *_, done, infos = env.step(np.zeros((2, 1), np.float32))
        assert done.tolist() == [step in ends, False]
        assert infos[0]["TimeLimit.truncated"] == done[0] and ("terminal_observation" in infos[0]) == done[0]


def test_a_goal_held_in_an_episode_that_was_left_does_not_count():
    env = scripted(("ss-L",), done_steps=3)
    env.reset()
    for _ in range(2):
        env.step(np.zeros((1, 1), np.float32))
    env.reset()
    assert not env.step(np.zeros((1, 1), np.float32))[2][0]


def test_attributes_and_methods():
    env = scripted()
    assert env.get_attr("level") == [1] * 5 and env.get_attr("script", indices=[3, 0]) == [SCRIPTS[3], SCRIPTS[0]]
    assert env.get_attr("script", indices=2) == [SCRIPTS[2]]
    env.set_attr("level", 4, indices=[1, 2])
    assert env.get_attr("level") == [1, 4, 4, 1, 1]
    env.set_attr("level", [7, 8])
    assert env.get_attr("level") == [[7, 8]] * 5
    assert env.has_attr("level") and not env.has_attr("depth")
    env.seed(3)
    env.reset()
    assert env.env_method("_observe", indices=1)[0]["a"].shape == (2,)
    assert env.env_is_wrapped(Monitor) == [False] * 5 and env.env_is_wrapped(Monitor, indices=0) == [False]


def test_attributes_and_methods_of_the_native_batch():
    env = make("TCAReach-v0", 3)
    assert env.get_attr("reward") == ["sparse"] * 3 and env.get_attr("arm", 1)[0].muscles
    assert env.has_attr("task") and not env.has_attr("depth") and env.render_mode is None
    near, far = np.zeros((4, 3)), np.full((4, 3), 1.0)
    for kind, expected in (("sparse", -1.0), ("dense", -(3.0**0.5))):
        env.set_attr("reward", kind)
        (reward,) = env.env_method("compute_reward", near, far, [{}] * 4, indices=[0])
        np.testing.assert_allclose(reward, [expected] * 4, rtol=1e-6)


def test_pictures_of_all_lanes_are_tiled():
    env = scripted(render_mode="rgb_array")
    assert env.render().shape == (3 * 4, 2 * 6, 3)
    assert [picture.shape for picture in env.get_images()] == [(4, 6, 3)] * 5


def test_without_a_render_mode_there_are_no_pictures():
    with pytest.warns(UserWarning, match="render_mode = None: pictures come from 'rgb_array' only"):
        assert scripted().get_images() == [None] * 5


def test_options_are_handed_on_once():
    env = scripted()
    env.set_options({"easy": 1})
    env.reset()
    assert [info["options"] for info in env.reset_infos] == ["{'easy': 1}"] * 5
    env.reset()
    assert [info["options"] for info in env.reset_infos] == ["None"] * 5


def test_options_that_differ_are_refused():
    env = make("TCAReach-v0", 2, seed=0)
    env.reset()
    env.set_options([{"a": 1}, {"a": 2}])
    with pytest.raises(ValueError, match=r"options = \[\{'a': 1\}, \{'a': 2\}\]: expected the same"):
        env.reset()


@pytest.mark.parametrize(
    ("env", "held", "message"),
    [
        (lambda: gym.make("TCAReach-v0"), None, r"expected a gymnasium\.vector\.VectorEnv"),
        (lambda: SyncVectorEnv([lambda: Script("L")]), None, r"autoreset_mode AutoresetMode\.NEXT_STEP: expected"),
        (lambda: scripted().env, 0, "done_steps = 0: expected a positive integer"),
        (lambda: scripted().env, 1.5, r"done_steps = 1\.5: expected a positive integer"),
    ],
)
def test_bad_arguments_are_refused(env, held, message):
    with pytest.raises(ValueError, match=message):
        BatchVecEnv(env(), held)


def test_observations_must_be_dictionaries():
    class Flat(Script):
        observation_space = gym.spaces.Box(-9, 9, (2,))

    with pytest.raises(ValueError, match="expected a dictionary"):
        BatchVecEnv(SyncVectorEnv([lambda: Flat("L")], autoreset_mode=AutoresetMode.DISABLED))


def test_a_bad_action_is_refused_and_changes_nothing():
    ours, theirs = make("TCAReach-v0", 2, seed=0), make("TCAReach-v0", 2, seed=0)
    for env in (ours, theirs):
        env.reset()
    for action in (np.array([[0.0] * 3, [np.nan] * 3]), np.zeros((2, 2)), np.zeros((3, 3))):
        with pytest.raises(ValueError):
            ours.step(action)
    action = np.ones((2, 3), np.float32)
    assert_same(ours.step(action), theirs.step(action))


def test_wrappers_of_sb3_show_what_they_show_of_single_environments():
    options = {"max_episode_steps": SHORT}
    wrapped = [
        VecNormalize(VecMonitor(VecCheckNan(env)))
        for env in (
            make("TCAReachDense-v0", 2, **options),
            DummyVecEnv([lambda: gym.make("TCAReachDense-v0", **options) for _ in range(2)]),
        )
    ]
    for env in wrapped:
        env.seed(4)
        env.reset()
    for step in range(SHORT + 2):
        (*ours, mine), (*theirs, others) = (env.step(np.full((2, 3), 0.3, np.float32)) for env in wrapped)
        assert_same(ours, theirs)
        for one, other in zip(mine, others, strict=True):
            assert ("episode" in one) == (step == SHORT - 1)
            if "episode" in one:
                one["episode"].pop("t"), other["episode"].pop("t")  # seconds
            assert_same(one, other)


def test_sb3s_evaluation_counts_the_episodes():
    env = VecMonitor(make("TCAReach-v0", 3, seed=0, max_episode_steps=SHORT))
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    rewards, lengths = evaluate_policy(model, env, n_eval_episodes=5, return_episode_rewards=True)
    assert lengths == [SHORT] * 5 and len(rewards) == 5


def test_ppo_learns_on_a_batch_as_on_single_environments(tmp_path):
    """The same seeds lead to the same parameters, and the evaluation on the way sees successes."""
    parameters, evaluated = [], []
    for env in (
        make("TCAReach-v0", 4, max_episode_steps=SHORT),
        DummyVecEnv([lambda: gym.make("TCAReach-v0", max_episode_steps=SHORT) for _ in range(4)]),
    ):
        watch = EvalCallback(
            VecMonitor(make("TCAReach-v0", 2, seed=9, max_episode_steps=SHORT)),
            n_eval_episodes=2,
            eval_freq=20,
            log_path=str(tmp_path),
            verbose=0,
        )
        model = PPO("MultiInputPolicy", VecMonitor(env), n_steps=20, batch_size=40, n_epochs=2, seed=2, device="cpu")
        model.learn(160, callback=watch)
        assert len(model.ep_info_buffer) == 4 * (40 // SHORT)
        parameters.append([value.detach().numpy() for value in model.policy.parameters()])
        with np.load(tmp_path / "evaluations.npz") as saved:
            evaluated.append({key: saved[key] for key in ("results", "successes", "ep_lengths")})
    assert_same(*parameters)
    assert_same(*evaluated)
    assert (evaluated[0]["ep_lengths"] == SHORT).all()


def test_relabelled_rewards_are_those_of_the_environment():
    env = VecMonitor(make("TCAReach-v0", 4, max_episode_steps=SHORT))
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        learning_starts=60,
        batch_size=16,
        policy_kwargs={"net_arch": [8]},
        seed=0,
        device="cpu",
    )
    model.learn(120)
    buffer = model.replay_buffer
    sample = buffer.sample(200)
    goals = np.unique(buffer.observations["desired_goal"].reshape(-1, 3), axis=0)
    achieved, desired = (sample.next_observations[key].numpy() for key in ("achieved_goal", "desired_goal"))
    relabelled = (desired[:, np.newaxis] != goals).any(axis=2).all(axis=1)
    assert 100 < relabelled.sum() < 200
    expected = gym.make("TCAReach-v0").unwrapped.compute_reward(achieved, desired, None)
    np.testing.assert_array_equal(sample.rewards.numpy()[:, 0], expected)
    assert (expected == 0.0).any() and (expected == -1.0).any()
    # Ends are time limits: the learner looks beyond them.
    assert (buffer.timeouts == buffer.dones).all() and buffer.dones.sum() == 4 * (30 // SHORT)
    ends = np.argwhere(buffer.dones[:30])
    assert not np.array_equal(
        buffer.next_observations["observation"][tuple(ends[0])], buffer.observations["observation"][ends[0][0] + 1, ends[0][1]]
    )
