"""The policies that come along do what their reports say."""

import json
from pathlib import Path

import gymnasium as gym
import pytest

import train
from agents.evaluate import evaluate
from agents.hyperparameters import DEFAULT_ALGORITHM

FOLDERS = sorted((Path(train.__file__).parent / "agents" / "pretrained").iterdir())


def test_there_is_one_for_every_task():
    assert {folder.name for folder in FOLDERS} == set(DEFAULT_ALGORITHM)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_it_solves_held_out_episodes_as_often_as_reported(folder):
    report = json.loads((folder / "report.json").read_text())
    algorithm = report["algo"]
    assert report["task"] == folder.name and algorithm == DEFAULT_ALGORITHM[folder.name]
    policy = train.learner(algorithm).load(folder / "policy.zip", device="cpu")
    env = gym.make(report["env"], split="held-out")
    found = evaluate(policy, env, 20, train.EVALUATION_SEED)
    # 20 of the report's 200 episodes: four standard deviations of a binomial below, and one episode.
    rate = report["held_out"][algorithm]["success_rate"]
    assert found.success_rate >= rate - 4.0 * (rate * (1.0 - rate) / 20) ** 0.5 - 0.05
    assert rate >= {"reach": 0.95, "twist-align": 0.9, "pick-and-place": 0.8}[folder.name]


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_all_of_its_reports_episodes(folder):
    report = json.loads((folder / "report.json").read_text())
    policy = train.learner(report["algo"]).load(folder / "policy.zip", device="cpu")
    env = gym.make(report["env"], split="held-out")
    expected = report["held_out"][report["algo"]]
    found = evaluate(policy, env, expected["episodes"], report["evaluation_seed"])
    assert found.success_rate == pytest.approx(expected["success_rate"], abs=0.02)
    assert found.final_distance_mm == pytest.approx(expected["final_distance_mm"], rel=0.1)
