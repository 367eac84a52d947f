"""Search for better settings of a learner with Optuna: `python train.py --tune N`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import optuna
import yaml
from stable_baselines3.common.callbacks import BaseCallback

from agents import training
from agents.evaluate import evaluate
from agents.training import Job
from tca_envs import registry

SHARE = 0.25
"""Default length of a trial, as a share of a whole training."""
POINTS = 4
"""Evaluations of a trial; from the second on it is stopped if it is worse than the median of earlier trials."""
EPISODES = 50
"""Of each evaluation, on goals of the training split."""


def tune(job: Job, trials: int, steps: int | None, folder: Path) -> None:
    """Try settings, print the best ones and write them to `folder`; a search that is there is continued.

    The best settings have the largest mean return after a part of the training. Returns fall with the distance from the goal
    at every step, so they measure how fast it is reached, too.

    Parameters
    ----------
    job : Job
        What is trained: settings that are not searched stay as they are. With the engine ray trials run side by side.
    trials : int
        How many more.
    steps : int, optional
        Environment steps of a trial; SHARE of a whole training by default.
    folder : pathlib.Path
        Gets the study as `study.db`, for Optuna's own tools, and the best settings as `best.yml`, as in
        `agents/hyperparameters`.
    """
    training.set_threads(job.threads)
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    steps_of_trial = steps or int(SHARE * job.settings["n_timesteps"])

    def open_study(seed: int) -> optuna.Study:
        return optuna.create_study(
            storage=f"sqlite:///{folder / 'study.db'}",
            study_name=f"{registry.entry(job.task).name}-{job.algorithm}",
            load_if_exists=True,
            direction="maximize",
            sampler=optuna.samplers.TPESampler(seed=seed, constant_liar=job.engine == "ray"),
            pruner=optuna.pruners.MedianPruner(n_startup_trials=3, n_warmup_steps=1),
        )

    def worth(trial: optuna.Trial) -> float:
        chosen = {**job.settings, **SPACES[job.algorithm](trial, job.settings)}
        trial.set_user_attr("settings", chosen)
        model = training.build(replace(job, settings=chosen))
        judge = Judge(trial, gymnasium.make_vec(job.settings["env"], EPISODES), steps_of_trial)
        model.learn(steps_of_trial, callback=judge)
        return judge.worth

    def say(_: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        value = f"return {trial.value:.2f}" if trial.state == optuna.trial.TrialState.COMPLETE else trial.state.name.lower()
        tried = ", ".join(f"{name} {short(given)}" for name, given in trial.params.items())
        print(f"trial {trial.number}: {value}, {tried}")

    study = open_study(job.seed)
    if job.engine == "ray":
        from agents.ray_engine import run_trials

        def one(number: int) -> dict[str, Any]:
            """Run a trial in a process of its own; they share the file of the study."""
            open_study(job.seed + number).optimize(worth, n_trials=1)
            return {}

        begun = len(study.trials)
        run_trials(one, range(begun, begun + trials), job.workers)
        for trial in study.trials[begun:]:
            say(study, trial)
    else:
        study.optimize(worth, n_trials=trials, callbacks=[say])
    best = dict(study.best_trial.user_attrs["settings"])
    text = yaml.safe_dump({best.pop("env"): best}, sort_keys=False)
    (folder / "best.yml").write_text(text)
    print(
        f"\nthe best, trial {study.best_trial.number} with return {study.best_value:.2f}, in {folder / 'best.yml'}:\n\n{text}"
    )


def short(value: Any) -> str:
    """Return a setting as text."""
    return f"{value:.2g}" if isinstance(value, float) else str(value)


class Judge(BaseCallback):
    """Evaluate a trial during training, report to Optuna, and stop the trial if Optuna asks for it."""

    def __init__(self, trial: optuna.Trial, env: Any, steps: int) -> None:
        super().__init__()
        self.trial, self.env, self.steps = trial, env, steps
        self.points = 0
        self.worth = float("nan")

    def _on_step(self) -> bool:
        if self.num_timesteps >= (self.points + 1) * self.steps / POINTS and self.points + 1 < POINTS:
            self.add_point()
            if self.trial.should_prune():
                raise optuna.TrialPruned
        return True

    def _on_training_end(self) -> None:
        self.add_point()

    def add_point(self) -> None:
        """Evaluate."""
        self.worth = evaluate(self.model, self.env, EPISODES, training.CURVE_SEED).episode_return
        self.trial.report(self.worth, self.points)
        self.points += 1


def _any(trial: optuna.Trial) -> dict[str, Any]:
    """Return the settings to try of every learner."""
    rate = trial.suggest_float("learning_rate", 1e-4, 5e-3, log=True)
    return {"learning_rate": f"lin_{rate:.2g}"}


def _net(trial: optuna.Trial, settings: dict[str, Any]) -> dict[str, Any]:
    width = trial.suggest_categorical("width", [64, 128, 256])
    return {**settings["policy_kwargs"], "net_arch": [width, width]}


def ppo(trial: optuna.Trial, settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings of PPO to try."""
    steps = trial.suggest_categorical("n_steps", [25, 50, 100, 200])
    return {
        **_any(trial),
        "policy_kwargs": {**_net(trial, settings), "log_std_init": trial.suggest_float("log_std_init", -1.5, 0.5)},
        "n_steps": steps,
        "batch_size": settings["n_envs"] * steps // trial.suggest_categorical("batches", [5, 10, 20]),
        "n_epochs": trial.suggest_int("n_epochs", 3, 15),
        "gamma": trial.suggest_categorical("gamma", [0.8, 0.9, 0.95, 0.98, 0.99]),
        "gae_lambda": trial.suggest_categorical("gae_lambda", [0.8, 0.9, 0.95]),
    }


def sac(trial: optuna.Trial, settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings of SAC to try."""
    return {
        **_any(trial),
        "policy_kwargs": _net(trial, settings),
        "batch_size": trial.suggest_categorical("batch_size", [128, 256, 512]),
        "gradient_steps": trial.suggest_int("gradient_steps", 1, max(1, settings["n_envs"] // 2)),
        "gamma": trial.suggest_categorical("gamma", [0.8, 0.9, 0.95, 0.98, 0.99]),
        "tau": trial.suggest_float("tau", 0.002, 0.05, log=True),
    }


def dagger(trial: optuna.Trial, settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings of DAgger to try."""
    width = trial.suggest_categorical("width", [64, 128, 256])
    return {
        **_any(trial),
        "policy_kwargs": {**settings["policy_kwargs"], "net_arch": {"pi": [width, width], "vf": [1]}},
        "batch_size": settings["n_envs"] * settings["n_steps"] // trial.suggest_categorical("batches", [10, 20, 40]),
        "n_epochs": trial.suggest_int("n_epochs", 4, 20),
    }


SPACES: dict[str, Callable[[optuna.Trial, dict[str, Any]], dict[str, Any]]] = {
    "ppo": ppo,
    "sac": sac,
    "her": sac,
    "dagger": dagger,
}
"""Search space of each algorithm."""
