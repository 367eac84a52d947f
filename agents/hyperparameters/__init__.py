"""Training settings per task and algorithm: the YAML files beside this one, a file for each algorithm.

They are in the format of RL-Zoo (rl_zoo3), which trains with them, too:

    python -m rl_zoo3.train --algo ppo --env TCAReachDense-v0 --gym-packages tca_envs --conf-file agents/hyperparameters/ppo.yml

An entry's key is the environment, `n_envs` and `n_timesteps` say how many are stepped together and for how many steps in all.
`lin_x` is a number that falls linearly from x to zero over the training. `done_steps` is ours: training episodes end when their
goal has been held for so many steps. All else goes to the learner.
"""

from copy import deepcopy
from pathlib import Path
from pydoc import locate
from typing import Any

import gymnasium
import yaml

import tca_envs  # noqa: F401  (registers the environments)

DEFAULT_ALGORITHM = {"reach": "ppo", "twist-align": "ppo", "pick-and-place": "dagger"}
"""The best of each task."""
SCHEDULES = ("learning_rate", "clip_range")
"""Settings that may be `lin_x`."""


def task_of(env: str) -> str:
    """Return the task of an environment's id."""
    return str(gymnasium.spec(env).kwargs["task"])


def read() -> dict[str, dict[str, dict[str, Any]]]:
    """Return the settings by task and algorithm, as they are written and with the environment's id as `env`."""
    settings: dict[str, dict[str, dict[str, Any]]] = {task: {} for task in DEFAULT_ALGORITHM}
    for path in sorted(Path(__file__).parent.glob("*.yml")):
        for env, entry in yaml.safe_load(path.read_text()).items():
            settings[task_of(env)][path.stem] = {"env": env, **entry}
    return settings


HYPERPARAMETERS = read()
ALGORITHMS = tuple(dict.fromkeys(algorithm for entries in HYPERPARAMETERS.values() for algorithm in entries))
"""Learners that `train.py` offers: PPO and SAC of Stable-Baselines3, the latter also with hindsight experience replay on the
sparse rewards ("her"), and imitation of the scripted controller (`agents.dagger`)."""


def for_learner(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of a learner's class that are in `settings`."""
    import stable_baselines3
    from stable_baselines3.common.utils import LinearSchedule

    # Copies: learners write into the mappings that they are given.
    ours = ("env", "n_envs", "n_timesteps", "done_steps")
    made = {name: deepcopy(value) for name, value in settings.items() if name not in ours}
    if "." in made["policy"]:
        made["policy"] = locate(made["policy"])
    for name in SCHEDULES:
        if isinstance(made.get(name), str):
            made[name] = LinearSchedule(float(made[name].removeprefix("lin_")), 0.0, 1.0)
    if "replay_buffer_class" in made:
        made["replay_buffer_class"] = getattr(stable_baselines3, made["replay_buffer_class"])
    return made
