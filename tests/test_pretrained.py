"""The policies that come along do what their reports say."""

import json
import shutil

import gymnasium as gym
import pytest

import train
from agents import training
from agents.evaluate import evaluate, lanes_for
from agents.hyperparameters import default_algorithm
from agents.policies import learner
from tca_envs import registry

FOLDERS = sorted(training.PRETRAINED.iterdir())
GOALS = 50


def test_there_is_one_for_every_task():
    assert {folder.name for folder in FOLDERS} == {entry.name for entry in registry.entries() if entry.settings is not None}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_it_solves_held_out_episodes_as_often_as_reported(folder):
    report = json.loads((folder / "report.json").read_text())
    algorithm = report["algo"]
    assert report["task"] == folder.name and algorithm == default_algorithm(folder.name)
    policy = learner(algorithm).load(folder / "policy.zip", device="cpu")
    env = gym.make_vec(report["env"], GOALS, split="held-out")
    found = evaluate(policy, env, GOALS, training.EVALUATION_SEED)
    # Some of the report's 200 episodes: four standard deviations of a binomial below, and one episode.
    rate = report["held_out"][algorithm]["success_rate"]
    assert found.success_rate >= rate - 4.0 * (rate * (1.0 - rate) / GOALS) ** 0.5 - 1.0 / GOALS
    assert rate >= {"reach": 0.95, "twist-align": 0.9, "pick-and-place": 0.8}[folder.name]


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_all_of_its_reports_episodes(folder):
    report = json.loads((folder / "report.json").read_text())
    policy = learner(report["algo"]).load(folder / "policy.zip", device="cpu")
    expected = report["held_out"][report["algo"]]
    env = gym.make_vec(report["env"], lanes_for(expected["episodes"]), split="held-out")
    found = evaluate(policy, env, expected["episodes"], report["evaluation_seed"])
    assert found.success_rate == pytest.approx(expected["success_rate"], abs=0.02)
    assert found.final_distance_mm == pytest.approx(expected["final_distance_mm"], rel=0.1)


def test_it_is_loaded_by_its_task(toy):
    assert type(training.pretrained("pick-and-place")) is learner("dagger")
    with pytest.raises(training.RunError, match="expected the folder of a run"):
        training.pretrained("toy:turn")


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_command_line_finds_it_by_its_task(folder, tmp_path, monkeypatch):
    copy = shutil.copytree(folder, tmp_path / folder.name)
    monkeypatch.setattr(training, "PRETRAINED", tmp_path)
    monkeypatch.setattr(training, "compare", lambda job, model, episodes: {})
    assert train.main(["--task", folder.name, "--eval-only", "pretrained"]) == 0
    assert json.loads((copy / "evaluation.json").read_text())["task"] == folder.name


def test_without_a_task_the_command_line_takes_reach(monkeypatch):
    told = []
    monkeypatch.setattr(training, "read_description", lambda folder: told.append(folder) or train.fail("enough"))
    with pytest.raises(SystemExit):
        train.main(["--eval-only", "pretrained"])
    assert told == [FOLDERS[0].parent / "reach"]
