"""Speed of workers: how fast PPO samples and learns in one process, and with one and two workers.

python -m agents.ray_study --out docs/study
"""

import argparse
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from agents.hyperparameters import for_learner, settings_of
from agents.output import markdown_table, write_csv
from agents.ray_engine import BatchRunner, RayPPO, cluster
from agents.sb3 import make
from tca_envs import registry

TASKS = [entry.name for entry in registry.entries()]
WARM_UP = 2
"""Updates that are not counted, in which processes start and kernels are loaded."""
UPDATES = 8


@dataclass(frozen=True)
class Rate:
    """Speed of one way of training."""

    task: str
    way: str
    workers: int
    sampling: float
    """Environment steps per second while sampling."""
    learning: float
    """Share of the time in which the networks are updated."""
    overall: float
    """Environment steps per second of training."""


class Clock:
    """A function whose calls are timed."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call the function."""
        begun = time.perf_counter()
        try:
            return self.function(*arguments, **options)
        finally:
            self.seconds += time.perf_counter() - begun


def measure_ray(task: str, way: str, workers: int, runner: type[EnvRunner]) -> Rate:
    """Measure training by Ray with `workers` workers."""
    settings = settings_of(task)["ppo"]
    env = make(settings["env"], settings["n_envs"], 0)
    model = RayPPO(env=env, env_id=settings["env"], workers=workers, seed=0, **for_learner(settings))
    config = model.config(settings["n_timesteps"])
    config.env_runners(env_runner_cls=runner, gym_env_vectorize_mode="vector_entry_point")
    algorithm = config.build_algo()
    try:
        clock = algorithm.learner_group.update = Clock(algorithm.learner_group.update)
        for _ in range(WARM_UP):
            algorithm.train()
        clock.seconds, begun, steps = 0.0, time.perf_counter(), 0
        for _ in range(UPDATES):
            steps += int(algorithm.train()["env_runners"]["num_env_steps_sampled"])
        seconds = time.perf_counter() - begun
    finally:
        algorithm.stop()
        shutil.rmtree(algorithm.logdir, ignore_errors=True)
    return Rate(task, way, workers, steps / (seconds - clock.seconds), clock.seconds / seconds, steps / seconds)


class Mark(BaseCallback):
    """Note the time at the end of the warm-up."""

    begun = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == WARM_UP * self.model.n_steps * self.model.n_envs:  # type: ignore[attr-defined]  # PPO's
            self.model.train.seconds, self.begun = 0.0, time.perf_counter()  # type: ignore[attr-defined]  # the clock


def measure_one_process(task: str) -> Rate:
    """Measure training by Stable-Baselines3, whose batch of environments has all processors."""
    settings = settings_of(task)["ppo"]
    model = PPO(env=make(settings["env"], settings["n_envs"], 0), seed=0, device="cpu", **for_learner(settings))
    clock = Clock(model.train)
    model.train = clock  # type: ignore[method-assign]
    mark, steps = Mark(), UPDATES * model.n_steps * model.n_envs
    model.learn(steps * (WARM_UP + UPDATES) // UPDATES, callback=mark)
    seconds = time.perf_counter() - mark.begun
    return Rate(task, "sb3", 0, steps / (seconds - clock.seconds), clock.seconds / seconds, steps / seconds)


def main(arguments: list[str] | None = None) -> None:
    """Measure, and write workers.csv and workers.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    rates = [measure_one_process(task) for task in TASKS]
    with cluster(None, 2):
        for task in TASKS:
            rates += [measure_ray(task, "ray", workers, BatchRunner) for workers in (1, 2)]
        rates.append(measure_ray("reach", "ray, RLlib's own worker", 1, SingleAgentEnvRunner))
    rates.sort(key=lambda rate: TASKS.index(rate.task))
    write_csv(options.out / "workers.csv", [field.name for field in fields(Rate)], [astuple(rate) for rate in rates])
    (options.out / "workers.md").write_text(page(rates), encoding="utf-8")


def page(rates: list[Rate]) -> str:
    """Return the page of the results."""
    gains = []
    for task in TASKS:
        one, two = (next(r for r in rates if (r.task, r.way, r.workers) == (task, "ray", n)) for n in (1, 2))
        gains.append(f"{two.sampling / one.sampling:.2f} times as fast in {task} ({two.overall / one.overall:.2f} in all)")
    rows = [
        (r.task, r.way, str(r.workers or "--"), f"{r.sampling:,.0f}", f"{100 * r.learning:.0f} %", f"{r.overall:,.0f}")
        for r in rates
    ]
    header = ["Task", "Engine", "Workers", "Sampling [steps/s]", "Learning", "In all [steps/s]"]
    return f"""# What workers are worth

Two workers sample {", ".join(gains)}, on {os.cpu_count()} processors that they share with the learner.

PPO with the settings of `agents/hyperparameters/ppo.yml`; {UPDATES} updates after {WARM_UP} that are not counted. "Learning" is
the share of the time in which the networks are updated; nothing is sampled meanwhile. The engine sb3 is one process whose batch
of environments has all processors, a worker of the engine ray has one. "RLlib's own worker" goes through its environments one
by one. Made by `python -m agents.ray_study --out docs/study`.

{markdown_table(header, rows)}
"""


if __name__ == "__main__":
    main()
