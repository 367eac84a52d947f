"""Training settings per task and algorithm: the YAML files beside this one, a file for each algorithm.

They are in the format of RL-Zoo (rl_zoo3), which trains with them, too:

    python -m rl_zoo3.train --algo ppo --env TCAReachDense-v0 --gym-packages tca_envs --conf-file agents/hyperparameters/ppo.yml

An entry's key is the environment, `n_envs` and `n_timesteps` say how many are stepped together and for how many steps in all.
`lin_x` is a number that falls linearly from x to zero over the training. All else goes to the learner. Two things are ours:

* `done_steps`: training episodes end when their goal has been held for so many steps.
* The key `default`: settings of any task that has none of its own. Hindsight (her) uses its sparse rewards, all others the
  dense ones. The name of the task is added to the arguments of networks and imitation.
"""

from copy import deepcopy
from functools import cache
from pathlib import Path
from pydoc import locate
from typing import Any

import yaml

from tca_envs import registry
from tca_envs.registry import Entry

Settings = dict[str, Any]

FILES = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.yml"))}
ALGORITHMS = tuple(FILES)
"""Learners that `train.py` offers: PPO and SAC of Stable-Baselines3, the latter also with hindsight experience replay on the
sparse rewards ("her"), and imitation of the scripted controller (`agents.dagger`)."""
SCHEDULES = ("learning_rate", "clip_range")
"""Settings that may be `lin_x`."""
OURS = ("env", "n_envs", "n_timesteps", "done_steps")
"""Settings that are not the learner's."""


@cache
def read(algorithm: str) -> dict[str, Settings]:
    """Return the contents of an algorithm's file."""
    found: dict[str, Settings] = yaml.safe_load(FILES[algorithm].read_text())
    return found


def of(entry: Entry) -> dict[str, Settings]:
    """Return a task's settings by algorithm, with the environment's id as `env`: its own, else the default ones."""
    found = {}
    for algorithm in ALGORITHMS:
        known = read(algorithm)
        env = next((env for env in entry.ids.values() if env in known), None)
        if env is None:
            env = entry.ids["sparse" if "replay_buffer_class" in known["default"] else "dense"]
        found[algorithm] = {"env": env, **known.get(env, known["default"])}
    if entry.controller is None:
        del found["dagger"]
    return found


def settings_of(task: str) -> dict[str, Settings]:
    """Return the settings of a task by algorithm.

    Parameters
    ----------
    task : str
        Its name, or "module:name", see `tca_envs.registry.entry`. The module is part of the environments' ids then, so that
        other processes import it, too.

    Raises
    ------
    ValueError
        If there is no such task.
    """
    entry = registry.entry(task)
    module = task.rpartition(":")[0]
    found: dict[str, Settings] = deepcopy(registry.load(entry.settings or of)(entry))
    for algorithm, settings in found.items():
        if module:
            settings["env"] = f"{module}:{settings['env']}"
        if settings["policy"].startswith("agents.policies."):
            named = {"features_extractor_kwargs": {"task": task}}
            settings["policy_kwargs"] = {**named, **settings.get("policy_kwargs", {})}
        if algorithm == "dagger":
            settings.setdefault("controller", task)
    return found


def default_algorithm(task: str) -> str:
    """Return the algorithm that a task is trained with unless another one is asked for."""
    return registry.entry(task).algorithm or "ppo"


def for_learner(settings: Settings) -> Settings:
    """Return the arguments of a learner's class that are in `settings`."""
    import stable_baselines3
    from stable_baselines3.common.utils import LinearSchedule

    # Copies: learners write into the mappings that they are given.
    made = {name: deepcopy(value) for name, value in settings.items() if name not in OURS}
    if "." in made["policy"]:
        made["policy"] = locate(made["policy"])
    for name in SCHEDULES:
        if isinstance(made.get(name), str):
            made[name] = LinearSchedule(float(made[name].removeprefix("lin_")), 0.0, 1.0)
    if "replay_buffer_class" in made:
        made["replay_buffer_class"] = getattr(stable_baselines3, made["replay_buffer_class"])
    return made
