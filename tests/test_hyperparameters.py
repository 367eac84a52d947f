"""The settings: complete, what learners take, and in RL-Zoo's format."""

import argparse
from dataclasses import replace
from pathlib import Path
from pydoc import locate

import gymnasium as gym
import pytest
import yaml

from agents import hyperparameters, training
from agents.hyperparameters import ALGORITHMS, default_algorithm, for_learner, settings_of
from agents.training import Job
from tca_envs import registry
from tca_envs.registry import Entry

FILES = sorted(Path(hyperparameters.__file__).parent.glob("*.yml"))
TASKS = [entry.name for entry in registry.entries() if entry.settings is not None]
ENTRIES = [(task, algorithm) for task in TASKS for algorithm in settings_of(task)]
OURS = "done_steps"
"""What RL-Zoo does not know."""


def test_every_task_has_settings_of_every_algorithm():
    assert TASKS == ["reach", "twist-align", "pick-and-place"]
    for task in TASKS:
        assert set(settings_of(task)) == set(ALGORITHMS) == {path.stem for path in FILES}
        assert default_algorithm(task) in settings_of(task)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_are_by_environment_with_what_rl_zoo_needs(path):
    found = yaml.safe_load(path.read_text())
    del found["default"]
    assert len(found) == len(TASKS)
    for env, entry in found.items():
        assert env in gym.registry
        assert locate(entry["policy"]) and entry["n_timesteps"] > 0 and entry["n_envs"] > 0
        # RL-Zoo splits strings at the "_", and YAML takes 1e-3 for a string.
        assert isinstance(entry["learning_rate"], float) or entry["learning_rate"].startswith("lin_")
        assert settings_of(gym.spec(env).kwargs["task"])[path.stem] == {"env": env, **entry}


@pytest.mark.parametrize(("task", "algorithm"), ENTRIES)
def test_learners_take_them_and_what_they_learn_is_read_again(task, algorithm, tmp_path):
    settings = settings_of(task)[algorithm]
    before = repr(settings)
    job = Job(task, algorithm, settings)
    model = training.build(job)
    assert model.gamma == settings.get("gamma", 0.99) and model.n_envs == settings["n_envs"]
    assert repr(settings) == before
    model.save(tmp_path / "policy.zip")
    again = training.load(job, tmp_path / "policy.zip")
    assert type(again) is type(model) and again.n_envs == model.n_envs


def test_a_task_without_settings_has_the_default_ones(monkeypatch):
    """Of its own environments; networks and imitation are told the task, and other processes import its module."""
    known = Entry("push", "Push", None, None, controller=lambda: None)
    monkeypatch.setattr(registry, "entry", lambda name: known)
    for algorithm, settings in settings_of("mine:push").items():
        default = yaml.safe_load((FILES[0].parent / f"{algorithm}.yml").read_text())["default"]
        assert settings.pop("env") == ("mine:Push-v0" if algorithm == "her" else "mine:PushDense-v0")
        assert settings["policy_kwargs"].pop("features_extractor_kwargs") == {"task": "mine:push"}
        assert settings.pop("controller", None) == ("mine:push" if algorithm == "dagger" else None)
        assert settings == default
    assert set(settings_of("push")) == set(ALGORITHMS) and default_algorithm("push") == "ppo"
    own = {"sac": {"env": "PushDense-v0", "policy": "Mlp"}}
    known = replace(known, controller=None, settings=lambda entry: own)
    assert settings_of("push") == own
    for _ in range(2):
        assert settings_of("mine:push") == {"sac": {"env": "mine:PushDense-v0", "policy": "Mlp"}}
    known = replace(known, settings=None)
    assert set(settings_of("push")) == set(ALGORITHMS) - {"dagger"}


def test_a_linear_schedule_falls_to_zero():
    made = for_learner({"learning_rate": "lin_0.002", "n_envs": 3, "env": "x", "policy": "P", "gamma": 0.9})
    assert [made["learning_rate"](left) for left in (1.0, 0.5, 0.0)] == [0.002, 0.001, 0.0]
    assert set(made) == {"learning_rate", "policy", "gamma"}


@pytest.mark.parametrize(("task", "algorithm"), [entry for entry in ENTRIES if entry[1] != "dagger"])
def test_rl_zoo_reads_the_same(task, algorithm, tmp_path, monkeypatch):
    """What it would give the learner's class is what train.py gives it."""
    pytest.importorskip("rl_zoo3", reason="rl_zoo3 is not installed")
    from rl_zoo3.exp_manager import ExperimentManager

    settings = settings_of(task)[algorithm]
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
