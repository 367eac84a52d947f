"""`train.py --tune`: trials are kept, gone on with, given up, and the best one is written as settings are."""

from types import SimpleNamespace

import pytest
import yaml

import train
from agents import training
from agents.hyperparameters import ALGORITHMS, for_learner, settings_of
from agents.training import Job

optuna = pytest.importorskip("optuna", reason="optuna is not installed (extra `tune`)")

from agents import tuning  # noqa: E402  (needs Optuna)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(tuning, "EPISODES", 2)


def test_trials_are_kept_and_the_best_settings_written(tmp_path, capsys):
    arguments = ["--task", "reach", "--algo", "sac", "--steps", "128", "--seed", "4", "--out", str(tmp_path)]
    assert train.main([*arguments, "--tune", "2"]) == 0
    assert train.main([*arguments, "--tune", "1"]) == 0
    study = optuna.load_study(study_name="reach-sac", storage=f"sqlite:///{tmp_path / 'study.db'}")
    assert [trial.number for trial in study.trials] == [0, 1, 2]
    ((env, best),) = yaml.safe_load((tmp_path / "best.yml").read_text()).items()
    assert {"env": env, **best} == study.best_trial.user_attrs["settings"]
    present = settings_of("reach")["sac"]
    assert env == present["env"] and best["n_timesteps"] == present["n_timesteps"]
    assert for_learner(best)["learning_rate"](1.0) == pytest.approx(study.best_params["learning_rate"], rel=0.05)
    assert "trial 2: return " in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", list(tuning.SPACES))
def test_what_is_tried_is_complete_settings_that_learners_take(algorithm):
    settings = settings_of("reach")[algorithm]
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(3):
        tried = tuning.SPACES[algorithm](study.ask(), settings)
        assert set(tried) <= {*settings, "tau"}
        training.build(Job("reach", algorithm, {**settings, **tried}))


def test_every_algorithm_has_a_space():
    assert set(tuning.SPACES) == set(ALGORITHMS)


@pytest.mark.parametrize("pruned", [False, True])
def test_a_trial_that_falls_behind_is_given_up(pruned, monkeypatch):
    reported = []
    trial = SimpleNamespace(report=lambda value, step: reported.append((step, value)), should_prune=lambda: pruned)
    monkeypatch.setattr(tuning, "evaluate", lambda *_: SimpleNamespace(episode_return=-float(len(reported))))
    judge = tuning.Judge(trial, None, 8)
    judge.model = None
    if pruned:
        judge.num_timesteps = 2
        with pytest.raises(optuna.TrialPruned):
            judge._on_step()
        return
    for judge.num_timesteps in range(1, 9):
        assert judge._on_step()
    judge._on_training_end()
    assert reported == [(0, 0.0), (1, -1.0), (2, -2.0), (3, -3.0)] and judge.worth == -3.0


def test_the_command_line_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(train, "find_spec", lambda name: None)
    for arguments, message in (
        (["--tune", "1"], "--tune needs Optuna"),
        (["--tune", "0"], "--tune 0: expected a positive integer"),
        (["--tune", "1", "--benchmark"], "--tune and --benchmark exclude each other"),
    ):
        with pytest.raises(SystemExit, match="2"):
            train.main(arguments)
        assert message in capsys.readouterr().err
