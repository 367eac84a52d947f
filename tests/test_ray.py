"""Training with Ray: on a local cluster of two nodes with one processor each, so that two workers are two machines to it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import train
from agents.curve import read
from agents.evaluate import evaluate
from agents.sb3 import make

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Ray's own, at import
    ray = pytest.importorskip("ray", reason="needs the extra ray: pip install -e '.[train,ray]'")
    from ray.cluster_utils import Cluster

    from agents.ray_engine import BatchRunner, RayPPO, cluster, cut, run_trials

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
    pytest.mark.filterwarnings("ignore::FutureWarning:ray"),
    pytest.mark.filterwarnings("ignore:rich is experimental"),  # the progress bar
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # sockets and processes that Ray leaves to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

ROOT = Path(__file__).parents[1]
ID = "TCAReachDense-v0"
STORE = 100 * 2**20


@pytest.fixture(scope="module", autouse=True)
def quiet():
    """No telemetry, and nothing left outside a temporary folder, whose name must be short: sockets lie in it."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_TMPDIR", folder)
        patch.setenv("HOME", folder)
        patch.setenv("RAY_AUTH_TOKEN", "0123456789abcdef" * 4)
        yield
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def address():
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": STORE})
    nodes.add_node(num_cpus=1, object_store_memory=STORE)
    yield nodes.address
    nodes.shutdown()


def model(**options):
    settings = {
        "n_steps": 64,
        "batch_size": 1024,
        "n_epochs": 8,
        "gamma": 0.95,
        "gae_lambda": 0.9,
        "learning_rate": 1e-3,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.5},
    }
    return RayPPO("MultiInputPolicy", make(ID, 64, 0), env_id=ID, workers=2, seed=0, **settings | options)


def test_a_record_is_cut_where_episodes_end():
    """Three lanes: one goes on, one is truncated at step 1 and restarts at step 2, one terminates at the last step."""
    said = {"x": np.zeros((3, 1))}
    steps = []
    for t in range(4):
        seen = {"o": 10.0 * np.arange(3)[:, np.newaxis] + t}
        ends = np.array([False, False, t == 3]), np.array([False, t == 1, False])
        real = np.array([True, t != 2, True])
        steps.append((seen, np.full((3, 2), t), np.arange(3) + 0.5 * t, *ends, real, said))
    found = cut(steps, {"o": 10.0 * np.arange(3)[:, np.newaxis] + 4})
    assert [e.get_observations()["o"][:, 0].tolist() for e in found] == [
        [0, 1, 2, 3, 4],
        [10, 11, 12],
        [13, 14],
        [20, 21, 22, 23, 24],
    ]
    assert [e.get_rewards().tolist() for e in found] == [[0, 0.5, 1, 1.5], [1, 1.5], [2.5], [2, 2.5, 3, 3.5]]
    assert [e.get_actions()[:, 0].tolist() for e in found] == [[0, 1, 2, 3], [0, 1], [3], [0, 1, 2, 3]]
    assert [(e.is_terminated, e.is_truncated) for e in found] == [(False, False), (False, True), (False, False), (True, False)]


def test_a_worker_steps_what_the_single_environment_steps(address):
    """Two samples of 60 steps: the episode of 100 goes on in the second, ends and another one begins."""
    with cluster(address, 2):
        runner = BatchRunner(config=model().config(1000), worker_index=1)
        lanes = runner.num_envs
        first, second = (runner.sample(num_timesteps=60 * lanes) for _ in range(2))
        metrics = runner.get_metrics()
        third = runner.sample(num_timesteps=100 * lanes)
        later = runner.get_metrics()
    assert len(first) == lanes and len(second) == 2 * lanes
    lane = 5
    env = gym.make(ID)
    observation, _ = env.reset(seed=0 + 1 + lane)  # the seed of the run, the worker's number, the lane
    total = 0.0
    for part in (first[lane], second[2 * lane], second[2 * lane + 1]):
        for key, value in part.get_observations().items():
            np.testing.assert_array_equal(value[0], observation[key])
        assert len(part.get_extra_model_outputs("action_logp")) == len(part)
        for t, action in enumerate(part.get_actions()):
            observation, reward, _, truncated, _ = env.step(np.clip(action, -1, 1))
            total += reward
            for key, value in part.get_observations().items():
                np.testing.assert_array_equal(value[t + 1], observation[key])
            assert part.get_rewards()[t] == np.float32(reward)
        assert part.is_truncated == truncated
        if truncated:
            ended, total = total, 0.0
            observation, _ = env.reset()
    returns = [sum(e.get_return() for e in (first[i], second[2 * i])) for i in range(lanes)]
    np.testing.assert_allclose(returns[lane], ended, rtol=1e-6)
    np.testing.assert_allclose(metrics["episode_return_mean"].peek(), np.mean(returns), rtol=1e-5)
    returns = [second[2 * i + 1].get_return() + third[2 * i].get_return() for i in range(lanes)]
    np.testing.assert_allclose(later["episode_return_mean"].peek(), np.mean(returns), rtol=1e-5)
    assert later["episode_len_mean"].peek() == 100


class Stop(BaseCallback):
    """Note how many processors are free while it trains, and kill a worker on the way."""

    def __init__(self, algorithms, at):
        super().__init__()
        self.algorithms, self.at, self.free = algorithms, at, None

    def _on_step(self):
        if self.free is None and self.num_timesteps >= self.at:
            self.free = ray.available_resources().get("CPU", 0)
            self.algorithms[0].env_runner_group.foreach_env_runner(
                lambda runner: os.kill(os.getpid(), signal.SIGKILL),
                remote_worker_ids=[1],
                local_env_runner=False,
                timeout_seconds=0,
            )
        return True


def test_two_workers_learn_and_one_that_dies_is_replaced(address, monkeypatch, tmp_path):
    algorithms = []
    iterate = RayPPO._iterate

    def noted(self, algorithm, total, callbacks):
        algorithms.append(algorithm)
        iterate(self, algorithm, total, callbacks)

    monkeypatch.setattr(RayPPO, "_iterate", noted)
    learner = model()
    env = gym.make_vec(ID, 30)
    before = evaluate(learner, env, 30)
    callback = Stop(algorithms, 30_000)
    with cluster(address, 2):
        learner.learn(60_000, callback=callback)
    assert callback.free == 0  # both nodes' only processor is taken
    assert 60_000 <= learner.num_timesteps < 60_000 + 2 * 64 * 64
    assert not ray.is_initialized()
    after = evaluate(learner, env, 30)
    assert after.final_distance_mm < 0.6 * before.final_distance_mm
    learner.save(tmp_path / "policy.zip")
    plain = PPO.load(tmp_path / "policy.zip")
    assert evaluate(plain, env, 30) == after
    state = plain.policy.optimizer.state_dict()["state"]
    assert state[0]["step"] > 100 and state[0]["exp_avg"].abs().max() > 0.0  # so that going on is going on


def test_settings_become_rllibs():
    rate = {"learning_rate": lambda left: 1e-3 * left}
    learner = model(ent_coef=0.01, clip_range=0.1, vf_coef=0.7, max_grad_norm=0.3, **rate)
    learner.num_timesteps = 1000
    config = learner.config(3000)
    assert config.lr[0] == [0, pytest.approx(0.75e-3)] and config.lr[-1] == [3000, pytest.approx(0.0)]
    assert (config.gamma, config.lambda_, config.num_epochs, config.minibatch_size) == (0.95, 0.9, 8, 1024)
    assert (config.entropy_coeff, config.clip_param, config.vf_loss_coeff, config.grad_clip) == (0.01, 0.1, 0.7, 0.3)
    assert config.train_batch_size_per_learner == 64 * 64
    assert (config.num_env_runners, config.num_envs_per_env_runner, config.seed) == (2, 32, 0)
    assert model().config(3000).lr == 1e-3
    with pytest.raises(ValueError, match=r"clip_range = .*: expected a constant"):
        model(clip_range=lambda left: 0.2 * left).config(3000)


@pytest.mark.parametrize(
    ("name", "value"), [("target_kl", 0.1), ("use_sde", True), ("clip_range_vf", 0.2), ("normalize_advantage", False)]
)
def test_what_rllib_has_not_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} = .*: expected"):
        model(**{name: value})


def run(*arguments, **options):
    command = [sys.executable, str(ROOT / "train.py"), *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, **options
    )


def finish(process):
    out, errors = process.communicate(timeout=200)
    return process.returncode, out, errors


def test_the_command_line_trains_stops_goes_on_and_evaluates_without_ray(address, tmp_path):
    folder = tmp_path / "run"
    process = run("--engine", "ray", "--workers", 2, "--address", address, "--steps", 10_000_000, "--out", folder)
    # The first point of the curve is far: stop when the log says that something has been learnt.
    while not any(path.stat().st_size > 500 for path in folder.glob("events.*")):
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal's Ctrl-C does
    status, out, errors = finish(process)
    assert status == 130, errors
    assert f"go on with: python train.py --resume {folder}" in out
    done = PPO.load(folder / "last.zip").num_timesteps
    assert done > 0
    again = ["--workers", "2", "--address", address, "--steps", "100", "--episodes", "5"]
    assert train.main(["--resume", str(folder), *again]) == 0
    assert read(folder)[-1]["steps"] > done
    description, report = (json.loads((folder / name).read_text()) for name in ("policy.json", "report.json"))
    assert description["engine"] == "ray" and description["versions"]["ray"] == ray.__version__
    assert report["policy_steps"] > done
    code = "import sys; sys.modules['ray'] = None; import train; sys.exit(train.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "--eval-only", str(folder), "--episodes", "5"]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=100)
    assert json.loads((folder / "evaluation.json").read_text())["held_out"] == report["held_out"]


def test_seeds_train_side_by_side(address, tmp_path):
    options = "--steps", 100, "--episodes", 2, "--out", tmp_path, "--address", address
    status, out, errors = finish(run("--engine", "ray", "--seeds", 3, 4, *options))
    assert status == 0, errors
    for seed in (3, 4):
        assert json.loads((tmp_path / f"reach-ppo-ray-seed{seed}" / "report.json").read_text())["seed"] == seed
        assert f"seed {seed}: success" in out


def test_a_failed_trial_is_told(address):
    def trial(setting):
        if setting == 1:
            raise ValueError("no good")
        return {"setting": setting}

    with cluster(address, 1):
        assert run_trials(trial, [0, 2], 0) == [{"setting": 0}, {"setting": 2}]
        with pytest.raises(RuntimeError, match="the trial with 1 failed"):
            run_trials(trial, [0, 1], 0)
    assert not ray.is_initialized()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workers", "3"], "processors = 3: expected at most 2"),
        (["--workers", "2", "--seeds", "0", "1"], "processors = 3: expected at most 2"),
        (["--address", "127.0.0.1:1"], "address = '127.0.0.1:1': expected HOST:PORT of a Ray cluster, or 'auto'"),
        (["--address", "there"], "address = 'there': expected HOST:PORT of a Ray cluster, or 'auto'"),
    ],
)
def test_a_cluster_that_is_too_small_or_not_there_is_told(arguments, message, address, tmp_path, capsys):
    policy = tmp_path / "policy.zip"
    policy.write_text("of an earlier run")
    with pytest.raises(SystemExit) as stop:
        train.main(["--engine", "ray", "--address", address, "--out", str(tmp_path), *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert policy.read_text() == "of an earlier run"
    assert not ray.is_initialized()


@pytest.mark.slow
def test_settings_are_searched_side_by_side(address, tmp_path):
    optuna = pytest.importorskip("optuna", reason="needs the extra tune")
    options = "--steps", 100, "--out", tmp_path, "--address", address
    status, out, errors = finish(run("--engine", "ray", "--tune", 2, *options))
    assert status == 0, errors
    study = optuna.load_study(study_name="reach-ppo", storage=f"sqlite:///{tmp_path / 'study.db'}")
    first, second = study.trials
    assert first.state == second.state == optuna.trial.TrialState.COMPLETE
    assert first.params != second.params
    for trial in study.trials:
        assert f"trial {trial.number}: return {trial.value:.2f}" in out
    assert (tmp_path / "best.yml").exists()
