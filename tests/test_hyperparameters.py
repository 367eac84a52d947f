"""The settings: complete, what learners take, and in RL-Zoo's format."""

import argparse
from pathlib import Path
from pydoc import locate

import gymnasium as gym
import pytest
import yaml

import train
from agents import hyperparameters
from agents.hyperparameters import ALGORITHMS, DEFAULT_ALGORITHM, HYPERPARAMETERS, for_learner, task_of
from agents.scripted import CONTROLLERS

FILES = sorted(Path(hyperparameters.__file__).parent.glob("*.yml"))
ENTRIES = [(task, algorithm) for task, entries in HYPERPARAMETERS.items() for algorithm in entries]
OURS = "done_steps"
"""What RL-Zoo does not know."""


def test_every_task_has_settings_of_every_algorithm():
    """`train.py` asks for no more than that both are known."""
    assert set(HYPERPARAMETERS) == set(CONTROLLERS) == set(DEFAULT_ALGORITHM)
    for task, entries in HYPERPARAMETERS.items():
        assert set(entries) == set(ALGORITHMS) == {path.stem for path in FILES}
        assert DEFAULT_ALGORITHM[task] in entries


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_are_by_environment_with_what_rl_zoo_needs(path):
    for env, entry in yaml.safe_load(path.read_text()).items():
        assert env in gym.registry
        assert locate(entry["policy"]) and entry["n_timesteps"] > 0 and entry["n_envs"] > 0
        # RL-Zoo splits strings at the "_", and YAML takes 1e-3 for a string.
        assert isinstance(entry["learning_rate"], float) or entry["learning_rate"].startswith("lin_")
        assert HYPERPARAMETERS[task_of(env)][path.stem] == {"env": env, **entry}


@pytest.mark.parametrize(("task", "algorithm"), ENTRIES)
def test_learners_take_them_and_what_they_learn_is_read_again(task, algorithm, tmp_path):
    settings = HYPERPARAMETERS[task][algorithm]
    before = repr(settings)
    options = argparse.Namespace(seed=0, device="cpu", engine="sb3")
    model = train.build(algorithm, settings, options)
    assert model.gamma == settings.get("gamma", 0.99) and model.n_envs == settings["n_envs"]
    assert repr(settings) == before
    model.save(tmp_path / "policy.zip")
    again = train.load(tmp_path / "policy.zip", algorithm, settings, options)
    assert type(again) is type(model) and again.n_envs == model.n_envs


def test_a_linear_schedule_falls_to_zero():
    made = for_learner({"learning_rate": "lin_0.002", "n_envs": 3, "env": "x", "policy": "P", "gamma": 0.9})
    assert [made["learning_rate"](left) for left in (1.0, 0.5, 0.0)] == [0.002, 0.001, 0.0]
    assert set(made) == {"learning_rate", "policy", "gamma"}


@pytest.mark.parametrize(("task", "algorithm"), [entry for entry in ENTRIES if entry[1] != "dagger"])
def test_rl_zoo_reads_the_same(task, algorithm, tmp_path, monkeypatch):
    """What it would give the learner's class is what train.py gives it."""
    pytest.importorskip("rl_zoo3", reason="rl_zoo3 is not installed")
    from rl_zoo3.exp_manager import ExperimentManager

    settings = HYPERPARAMETERS[task][algorithm]
    assert OURS not in settings
    path = next(path for path in FILES if path.stem == algorithm)
    learner = "sac" if algorithm == "her" else algorithm
    manager = ExperimentManager(argparse.Namespace(), learner, settings["env"], str(tmp_path), config=str(path))
    read, _ = manager.read_hyperparameters()
    found, *_ = manager._preprocess_hyperparams(read)
    expected = for_learner(settings)
    schedules = [(made.pop("learning_rate")) for made in (found, expected)]
    assert found == expected
    assert (manager.n_envs, manager.n_timesteps) == (settings["n_envs"], settings["n_timesteps"])
    for left in (1.0, 0.3):
        theirs, ours = (schedule(left) if callable(schedule) else schedule for schedule in schedules)
        assert theirs == pytest.approx(ours)
