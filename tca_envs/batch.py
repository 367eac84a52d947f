"""What the single and the vector environment share: N lanes' observations, rewards and infos, and snapshots of them."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import njit
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics.kernels import FAILED
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.tasks import TASKS
from tca_envs.tasks.core import Core, Record
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
    if actions.shape != shape or not (math.isfinite(np.add.reduce(actions, axis=None)) or np.isfinite(actions).all()):
        raise ValueError(f"{name} = {value!r}: expected finite numbers of shape {shape}")
    return actions


@njit(cache=True, error_model="numpy", nogil=True)  # without fast mathematics, so that N changes no number
def _look(temperature, power, full_power, achieved, goal, report, seen, reached, desired, numbers, counts, flags):
    """Write what all tasks observe and tell alike; as array operations it takes as long as a solve."""
    for i in range(len(temperature)):
        muscles = temperature.shape[1]
        cost = 0.0
        for j in range(muscles):
            seen[i, j] = (temperature[i, j] - AMBIENT) / (SOFT_LIMIT - AMBIENT)
            seen[i, muscles + j] = power[i, j] / full_power[j]
            cost += max(temperature[i, j] - SOFT_LIMIT, 0.0)
        square = 0.0
        for j in range(goal.shape[1]):
            reached[i, j], desired[i, j] = achieved[i, j], goal[i, j]
            if j < 3:
                away = np.float64(reached[i, j]) - np.float64(desired[i, j])
                square += away * away
        numbers[AWAY, i], numbers[COST, i] = math.sqrt(square), cost
        counts[RUNG, i], counts[ITERATIONS, i] = int(report[i, 0]), int(report[i, 2])
        flags[CONVERGED, i], flags[JUMPED, i] = report[i, 0] != FAILED, report[i, 3] != 0.0


AWAY, COST = 0, 1
RUNG, ITERATIONS = 0, 1
CONVERGED, JUMPED = 0, 1
"""Rows of what `_look` writes."""


def look(task: Task, core: Core, report: Array) -> tuple[Observation, Outcome, dict[str, Any]]:
    """Return what is to be seen of all lanes after a step or a reset.

    Parameters
    ----------
    task : Task
        Of the lanes.
    core : Core
        N lanes.
    report : (N, REPORT) array
        Of the solver.

    Returns
    -------
    tuple
        Observations, arrays of their own; what is to be said of their goals; and infos, arrays (N,) that may be views.
    """
    record = core.record
    lanes, goals = record.goal.shape
    seen = np.empty((lanes, *task.observation_space.shape), dtype=np.float32)
    reached, desired = np.empty((lanes, goals), dtype=np.float32), np.empty((lanes, goals), dtype=np.float32)
    numbers, counts, flags = np.empty((2, lanes)), np.empty((2, lanes), dtype=np.int64), np.empty((2, lanes), dtype=np.bool_)
    _look(
        record.temperature, record.power, core.heating.max_power, task.achieved(record), record.goal, report, seen, reached,
        desired, numbers, counts, flags,
    )  # fmt: skip
    task.observe(core, reached, seen)
    outcome = task.judge(reached, desired, numbers[AWAY])
    info = {
        "is_success": outcome.success,
        **outcome.measures,
        "energy_J": record.energy,
        "cost": numbers[COST],
        "solver": {
            "converged": flags[CONVERGED],
            "residual": report[:, 1],
            "iterations": counts[ITERATIONS],
            "rung": counts[RUNG],
            "jumped": flags[JUMPED],
        },
    }
    return {"observation": seen, "achieved_goal": reached, "desired_goal": desired}, outcome, info


def outcome(task: Task, achieved: ArrayLike, desired: ArrayLike) -> Outcome:
    """Return what is to be said of goals (..., k)."""
    reached, asked = np.asarray(achieved), np.asarray(desired)
    apart = reached[..., :3].astype(np.float64) - asked[..., :3]
    x, y, z = apart[..., 0], apart[..., 1], apart[..., 2]
    return task.judge(reached, asked, np.sqrt(x * x + y * y + z * z))


def rewards(reward: str, outcome: Outcome) -> Array:
    """Return the rewards (...,) of the kind `reward`."""
    return np.subtract(outcome.success, 1.0) if reward == "sparse" else outcome.dense_reward


def compute_reward(task: Task, reward: str, achieved: ArrayLike, desired: ArrayLike) -> Any:
    """Return the reward of a goal (k,) as a float, or of a batch (..., k) as a float32 array (...,)."""
    found = rewards(reward, outcome(task, achieved, desired))
    return float(found) if np.ndim(found) == 0 else found.astype(np.float32)


def of_lane(info: Mapping[str, Any], lane: int) -> dict[str, Any]:
    """Return the info of one lane, as Python's own types."""
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
