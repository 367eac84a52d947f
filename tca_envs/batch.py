"""What the single and the vector environment share: N lanes' observations, rewards and infos, and snapshots of them."""

from collections.abc import Mapping
from dataclasses import fields
from math import isfinite
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs.mechanics.thermal import SOFT_LIMIT
from tca_envs.tasks import TASKS
from tca_envs.tasks.core import Core, Record, solved
from tca_envs.tasks.task import Array, Outcome, Task

Observation = dict[str, NDArray[Any]]

REWARDS = ("sparse", "dense")


def new_task(task: str, reward: str, split: str, tolerance: float) -> Task:
    """Return the task that the arguments of an environment ask for; ValueError if there is none."""
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"task = {task!r}: expected one of {', '.join(map(repr, TASKS))}")
    if not isinstance(reward, str) or reward not in REWARDS:
        raise ValueError(f"reward = {reward!r}: expected one of {', '.join(map(repr, REWARDS))}")
    return TASKS[task](split, tolerance)


def action_space(task: Task) -> spaces.Box:
    """Return the space of one lane's actions."""
    return spaces.Box(-1.0, 1.0, (task.actions,), np.float32)


def observation_space(task: Task) -> spaces.Dict:
    """Return the space of one lane's observations."""
    return spaces.Dict(
        {"observation": task.observation_space, "achieved_goal": task.goal_space, "desired_goal": task.goal_space}
    )


def checked_actions(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return actions as a new float64 array of `shape`, finite; ValueError otherwise."""
    try:
        actions = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        actions = np.empty(0)
    # A finite sum says that all are finite, in half the time that looking at each of a few takes.
    if actions.shape != shape or not (isfinite(np.add.reduce(actions, axis=None)) or np.isfinite(actions).all()):
        raise ValueError(f"{name} = {value!r}: expected finite numbers of shape {shape}")
    return actions


def look(task: Task, core: Core) -> tuple[Observation, Outcome]:
    """Return the observations of all lanes, arrays of their own, and what is to be said of their goals."""
    measured, achieved = task.observe(core)
    desired = core.record.goal.astype(np.float32)
    observation = {"observation": measured, "achieved_goal": achieved, "desired_goal": desired}
    return observation, task.judge(achieved, desired)


def rewards(reward: str, outcome: Outcome) -> Array:
    """Return the rewards (...,) of the kind `reward`."""
    return np.subtract(outcome.success, 1.0) if reward == "sparse" else outcome.dense_reward


def compute_reward(task: Task, reward: str, achieved: NDArray[Any], desired: NDArray[Any]) -> Any:
    """Return the reward of a goal (k,) as a float, or of a batch (..., k) as a float32 array (...,)."""
    found = rewards(reward, task.judge(np.asarray(achieved), np.asarray(desired)))
    return float(found) if np.ndim(found) == 0 else found.astype(np.float32)


def infos(record: Record, outcome: Outcome, report: Array) -> dict[str, Any]:
    """Return the infos of all lanes, arrays (N,) that may be views, "solver" as a dictionary of such."""
    return {
        "is_success": outcome.success,
        **outcome.measures,
        "energy_J": record.energy,
        "cost": np.add.reduce(np.maximum(record.temperature - SOFT_LIMIT, 0.0), axis=1),
        "solver": {
            "converged": solved(report),
            "residual": report[:, 1],
            "iterations": report[:, 2].astype(np.int64),
            "rung": report[:, 0].astype(np.int64),
            "jumped": report[:, 3].astype(np.bool_),
        },
    }


def of_lane(info: Mapping[str, Any], lane: int) -> dict[str, Any]:
    """Return the info of one lane of `infos`, as Python's own types."""
    return {key: of_lane(value, lane) if isinstance(value, dict) else value.item(lane) for key, value in info.items()}


def snapshot(record: Record) -> dict[str, Any]:
    """Return copies of all arrays of a record by name."""
    return {field.name: getattr(record, field.name).copy() for field in fields(record)}


def check_state(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raise ValueError unless `state` holds finite arrays, named and shaped as those of `expected`, and some "rng"."""
    shapes = {name: value.shape for name, value in expected.items() if name != "rng"}
    found = {name: np.shape(value) for name, value in state.items() if name != "rng"}
    if found != shapes or "rng" not in state:
        raise ValueError(f"state has arrays {found}: expected {shapes} and 'rng'")
    for name in shapes:
        if not np.isfinite(np.asarray(state[name], dtype=np.float64)).all():
            raise ValueError(f"state[{name!r}] = {state[name]!r}: expected finite numbers")


def restore(record: Record, state: Mapping[str, Any]) -> None:
    """Overwrite a record with a snapshot of the same shapes."""
    for field in fields(record):
        getattr(record, field.name)[...] = state[field.name]
