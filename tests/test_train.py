"""The command line of train.py: it learns, saves, goes on, evaluates, and says what is wrong."""

import csv
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from zipfile import ZipFile

import gymnasium as gym
import matplotlib.image
import pytest
from stable_baselines3 import PPO, SAC

import agents
import train
from agents import training
from agents.curve import shortfall

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.filterwarnings("ignore:rich is experimental")  # SB3's progress bar


def run(*arguments, cwd=ROOT, **options):
    command = [sys.executable, str(ROOT / "train.py"), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, **options)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run by the command line."""
    folder = tmp_path_factory.mktemp("runs") / "short"
    done = run("--algo", "sac", "--steps", 3264, "--seed", 3, "--episodes", 2, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_a_run_leaves_policy_curve_and_report(trained):
    folder, done = trained
    for name in ("policy.zip", "policy.json", "last.zip", "replay_buffer.pkl", "curve.csv", "curve.png", "report.json"):
        assert (folder / name).stat().st_size > 0
    assert matplotlib.image.imread(folder / "curve.png").shape[0] > 400
    assert steps_of(folder)[-1] == 3264
    report = json.loads((folder / "report.json").read_text())
    assert set(report["held_out"]) == {"sac", "scripted", "random"}
    assert report["held_out"]["scripted"]["success_rate"] == 1.0
    assert report["seed"] == 3 and report["versions"]["gymnasium"]
    for name in ("sac", "scripted", "random"):
        assert f"{name}: success" in done.stdout


def test_a_run_can_be_watched_in_tensorboard(trained):
    pytest.importorskip("tensorboard", reason="not installed: pip install tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder, _ = trained
    events = EventAccumulator(str(folder))
    events.Reload()
    points = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert {"train/actor_loss", "rollout/ep_rew_mean", "rollout/success_rate", "eval/success_rate"} <= set(points)
    with (folder / "curve.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    step, distance = points["eval/final_distance_mm"][-1]
    assert step == float(last["steps"]) and distance == pytest.approx(float(last["final_distance_mm"]))


def test_the_policy_kept_came_nearest_or_has_the_largest_return():
    rows = [{"final_distance_mm": d, "episode_return": r} for d, r in ((2.0, -2.0), (1.0, -3.0), (3.0, -1.0))]
    assert min(rows, key=shortfall) is rows[1]
    blank = [{**row, "final_distance_mm": float("nan")} for row in rows]
    assert min(blank, key=shortfall) is blank[2]


def test_progress_is_shown(trained):
    _, done = trained
    assert "3264/3,264" in (done.stdout + done.stderr).replace("3,264/3,264", "3264/3,264")


def test_eval_only_repeats_the_reports_numbers(trained):
    folder, _ = trained
    assert train.main(["--eval-only", str(folder), "--episodes", "2"]) == 0
    report, again = (json.loads((folder / name).read_text()) for name in ("report.json", "evaluation.json"))
    assert report["held_out"] == again["held_out"]


def test_resume_goes_on_with_its_seed(trained, tmp_path):
    folder = shutil.copytree(trained[0], tmp_path / "copy")
    assert train.main(["--resume", str(folder), "--steps", "384", "--episodes", "1"]) == 0
    steps = steps_of(folder)
    assert steps == sorted(steps) and steps[-1] == 3648
    assert json.loads((folder / "report.json").read_text())["seed"] == 3
    assert json.loads((folder / "policy.json").read_text())["seed"] == 3


@pytest.fixture
def quickly(monkeypatch):
    """The command line in this process; points of the learning curve cost one episode."""
    monkeypatch.setattr(training, "CURVE_EPISODES", 1)
    return lambda *arguments: train.main([*map(str, arguments), "--episodes", "1"])


def steps_of(folder):
    with (folder / "curve.csv").open() as file:
        return [int(float(row["steps"])) for row in csv.DictReader(file)]


def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint_to_its_end(quickly, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "killed"
    often = "import sys, train; t = train.training; t.CURVE_EPISODES = 1; t.CURVE_INTERVAL = 320; train.main(sys.argv[1:])"
    command = [sys.executable, "-c", often, "--algo", "sac", "--steps", "2240", "--seed", "5", "--out", str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            while not (folder / "curve.csv").exists() or len(steps_of(folder)) < 4:
                assert process.poll() is None
                time.sleep(0.02)
        finally:
            process.kill()
    left = steps_of(folder)
    assert left[:4] == [320, 640, 960, 1280] and left[-1] < 2240 and not (folder / "report.json").exists()
    assert quickly("--resume", folder) == 0
    assert f"for {2240 - left[-1]} steps, seed 5" in capsys.readouterr().out
    assert steps_of(folder) == [*left, 2240]
    assert SAC.load(folder / "last.zip", device="cpu").num_timesteps == 2240
    with (folder / "replay_buffer.pkl").open("rb") as file:
        assert pickle.load(file).size() >= 2240 // 32 - 1  # SB3 stores a step after it has told of it
    assert not list(folder.glob("new-*"))


def parameters(folder, name="policy.zip"):
    """The bytes of all weights in a saved policy."""
    with ZipFile(folder / name) as saved:
        return saved.read("policy.pth")


def test_the_same_command_makes_the_same_policy(trained, tmp_path):
    """Whatever else the process did before."""
    folder, again = trained[0], tmp_path / "again"
    assert train.main(["--algo", "sac", "--steps", "3264", "--seed", "3", "--episodes", "2", "--out", str(again)]) == 0
    assert parameters(folder) == parameters(again)
    rows = []
    for place in (folder, again):
        with (place / "curve.csv").open() as file:
            rows.append([{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)])
    assert rows[0] == rows[1]
    first, second = (json.loads((place / "report.json").read_text()) for place in (folder, again))
    assert first["held_out"] == second["held_out"]


def test_ppo_trains_and_goes_on_without_a_replay_buffer(quickly, tmp_path):
    folder = tmp_path / "ppo"
    for arguments in (["--algo", "ppo", "--out", folder], ["--resume", folder]):
        assert quickly(*arguments, "--steps", 6400) == 0
    assert steps_of(folder)[-1] == 12_800


def test_dagger_imitates_the_controller_and_goes_on_with_its_record(quickly, tmp_path):
    folder = tmp_path / "dagger"
    for arguments in (["--task", "pick-and-place", "--out", folder, "--steps", 2000], ["--resume", folder, "--steps", 1000]):
        assert quickly(*arguments) == 0
    assert json.loads((folder / "policy.json").read_text())["algo"] == "dagger"
    with (folder / "replay_buffer.pkl").open("rb") as file:
        record = pickle.load(file)
    assert sum(len(actions) for _, actions in record) == 3000
    report = json.loads((folder / "report.json").read_text())
    assert report["held_out"]["scripted"]["success_rate"] == 1.0


@pytest.fixture
def on_path(monkeypatch):
    """The folder of `toy.py`, a module of a user, is on the path of other processes."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT / "tests"), os.environ.get("PYTHONPATH")])))


def test_a_users_task_is_trained_with_default_settings_and_evaluated_without_a_controller(toy, on_path, tmp_path, capsys):
    folder = tmp_path / "turn"
    done = run("--task", "toy:turn", "--steps", 400, "--episodes", 2, "--out", folder)
    assert done.returncode == 0, done.stderr
    description, report = (json.loads((folder / name).read_text()) for name in ("policy.json", "report.json"))
    assert (description["task"], description["env"], description["algo"]) == ("toy:turn", "toy:ToyTurnDense-v0", "ppo")
    assert set(report["held_out"]) == {"ppo", "random"}
    assert report["held_out"]["ppo"]["final_distance_mm"] is None and "mm" not in done.stdout
    assert steps_of(folder)[-1] == 6400
    done = run("--eval-only", folder, "--episodes", 2)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "evaluation.json").read_text())["held_out"] == report["held_out"]
    with pytest.raises(SystemExit):
        train.main(["--task", "toy:turn", "--algo", "dagger"])
    message = "--algo dagger: toy:turn has no settings of it; it has those of her, ppo, sac"
    assert message in capsys.readouterr().err


def test_a_fresh_run_leaves_nothing_of_an_earlier_one(tmp_path, monkeypatch):
    folder = tmp_path / "again"
    folder.mkdir()
    for name in ("policy.zip", "last.zip", "replay_buffer.pkl", "curve.csv", "report.json", "events.out.tfevents.17.host.3.0"):
        (folder / name).write_text("old")
    monkeypatch.setattr(training, "train", lambda *arguments: (0.0, True))
    assert train.main(["--out", str(folder)]) == 130
    assert list(folder.iterdir()) == []


def test_ctrl_c_saves_what_there_is(tmp_path):
    folder = tmp_path / "stopped"
    command = [sys.executable, str(ROOT / "train.py"), "--steps", "1000000", "--out", str(folder)]
    # Background shells ignore SIGINT and hand that on; a person's terminal does not.
    with subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        while not (folder / "policy.json").exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.1)
        time.sleep(3.0)
        process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 130, err
    assert f"python train.py --resume {folder}" in out
    for name in ("policy.zip", "last.zip", "curve.csv"):
        assert (folder / name).exists()


def test_ray_is_needed_for_its_engine_only(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "agents.ray_engine", raising=False)
    monkeypatch.delattr(agents, "ray_engine", raising=False)
    with pytest.raises(SystemExit) as stop:
        train.main(["--engine", "ray"])
    assert stop.value.code == 2
    assert "--engine ray needs Ray: pip install -e '.[train,ray]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "juggle"], "--task juggle: unknown; the tasks are reach, twist-align, pick-and-place"),
        (["--task", "nowhere:juggle"], "--task nowhere:juggle: No module named 'nowhere'"),
        (["--algo", "dqn"], "--algo dqn: unknown; the algorithms are dagger, her, ppo, sac"),
        (["--steps", "0"], "--steps 0: expected a positive integer"),
        (["--episodes", "-3"], "--episodes -3: expected a positive integer"),
        (["--seed", "-1"], "--seed -1: expected an integer of at least 0"),
        (["--eval-only", "nowhere"], "nowhere: expected the folder of a run"),
        (["--resume", "a", "--eval-only", "b"], "exclude each other"),
        (["--engine", "steam"], "--engine steam: unknown; the engines are sb3, ray"),
        (["--engine", "ray", "--algo", "sac"], "--engine ray trains ppo on the cpu, not sac on cpu"),
        (["--engine", "ray", "--device", "cuda"], "--engine ray trains ppo on the cpu, not ppo on cuda"),
        (["--engine", "ray", "--workers", "0"], "--workers 0: expected a positive integer"),
        (["--engine", "ray", "--seeds", "1", "-2"], "--seeds -2: expected an integer of at least 0"),
        (["--seeds", "1", "2"], "--seeds needs --benchmark or --engine ray"),
        (["--video", "film.avi"], "--video film.avi: path = 'film.avi': expected a file name that ends with .mp4, .webp, .gif"),
        (["--video", "a.gif", "--benchmark"], "--video is for one policy"),
    ],
)
def test_bad_arguments_are_told(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        train.main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def checkpoint(folder, model, task="reach", algo="sac"):
    folder.mkdir()
    model.save(folder / "policy.zip")
    (folder / "policy.json").write_text(json.dumps({"task": task, "algo": algo}))
    return folder


@pytest.mark.parametrize(
    ("make", "described", "arguments", "message"),
    [
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1")), {}, [], "made for the observation_space"),
        (lambda: PPO("MlpPolicy", gym.make("Pendulum-v1"), device="cpu"), {}, [], "expected a sac policy"),
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1")), {"task": "juggle"}, [], "'juggle' with 'sac' is unknown"),
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1")), {}, ["--algo", "ppo"], "holds a policy of 'sac', not 'ppo'"),
    ],
)
def test_foreign_checkpoints_are_told(make, described, arguments, message, tmp_path, capsys):
    folder = checkpoint(tmp_path / "run", make(), **described)
    with pytest.raises(SystemExit) as stop:
        train.main(["--eval-only", str(folder), *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_a_broken_checkpoint_is_told(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "policy.json").write_text('{"task": "reach", "algo": "sac"}')
    (folder / "policy.zip").write_text("not a zip")
    with pytest.raises(SystemExit):
        train.main(["--eval-only", str(folder)])
    assert "expected a sac policy" in capsys.readouterr().err


def test_a_run_without_a_checkpoint_is_told(tmp_path, capsys):
    (tmp_path / "policy.json").write_text('{"task": "reach", "algo": "sac"}')
    with pytest.raises(SystemExit) as stop:
        train.main(["--resume", str(tmp_path)])
    assert stop.value.code == 2
    assert "last.zip: not there; a run that ended before its first checkpoint" in capsys.readouterr().err
