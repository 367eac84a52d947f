"""What the single and the vector environment share: N lanes' observations, rewards and infos, and snapshots of them."""

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tca_envs import registry
from tca_envs.mechanics import compiled
from tca_envs.tasks.core import Core, Record, Solve, solved
from tca_envs.tasks.task import Array, Outcome, Task

Observation = dict[str, NDArray[Any]]

REWARDS = ("sparse", "dense")


SOLVERS = {"collocation": "tca_envs.mechanics.continuation:solve", "shooting": "study.shooting:solve"}
"""What can bring arms to equilibrium, by name: references to functions, see `tasks.core.Core`."""


def new_task(task: str, reward: str, arguments: Mapping[str, Any]) -> Task:
    """Return the task that the arguments of an environment ask for; ValueError if there is none."""
    found = registry.entry(task)
    if not isinstance(reward, str) or reward not in REWARDS:
        raise ValueError(f"reward = {reward!r}: expected one of {', '.join(map(repr, REWARDS))}")
    made: Task = found.new(**arguments)
    return made


def new_solver(solver: Any) -> Solve:
    """Return the function that a name in SOLVERS stands for, or a function as it is; ValueError for anything else."""
    if isinstance(solver, str) and solver in SOLVERS:
        solver = registry.load(SOLVERS[solver])
    if not callable(solver):
        raise ValueError(f"solver = {solver!r}: expected one of {', '.join(map(repr, SOLVERS))}, or a function")
    found: Solve = solver
    return found


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


@partial(compiled, fastmath=False)  # so that N changes no number
def _look(record, heat, achieved, seen, reached, desired, numbers):
    """Write what all tasks observe and tell alike; as array operations it takes as long as a solve."""
    temperature, power, goal = record
    full_power, ambient, soft = heat
    for i in range(len(temperature)):
        muscles = temperature.shape[1]
        cost = 0.0
        for j in range(muscles):
            seen[i, j] = (temperature[i, j] - ambient) / (soft - ambient)
            seen[i, muscles + j] = power[i, j] / full_power[j]
            cost += max(temperature[i, j] - soft, 0.0)
        square = 0.0
        for j in range(goal.shape[1]):
            reached[i, j], desired[i, j] = achieved[i, j], goal[i, j]
            if j < 3:
                away = np.float64(reached[i, j]) - np.float64(desired[i, j])
                square += away * away
        numbers[AWAY, i], numbers[COST, i] = math.sqrt(square), cost


AWAY, COST = 0, 1
"""Rows of what `_look` writes."""


def look(task: Task, core: Core, report: Any) -> tuple[Observation, Outcome, dict[str, Any]]:
    """Return what is to be seen of all lanes after a step or a reset.

    Parameters
    ----------
    task : Task
        Of the lanes.
    core : Core
        N lanes.
    report : (N,) structured array
        Of the solver, see `continuation.solve`.

    Returns
    -------
    tuple
        Observations, arrays of their own; the outcome of their goals; and infos, arrays (N,) that may be views.
    """
    record, limits = core.record, task.robot.limits
    lanes, goals = record.goal.shape
    seen = np.empty((lanes, *task.observation_space.shape), dtype=np.float32)
    reached, desired = np.empty((lanes, goals), dtype=np.float32), np.empty((lanes, goals), dtype=np.float32)
    numbers = np.empty((2, lanes))
    heat = (core.heating.max_power, limits.ambient, limits.soft)
    _look((record.temperature, record.power, record.goal), heat, task.achieved(record), seen, reached, desired, numbers)
    task.observe(core, reached, seen[:, 2 * record.power.shape[1] :])
    outcome = task.judge(reached, desired, numbers[AWAY])
    info = {
        "is_success": outcome.success,
        **outcome.measures,
        "energy_J": record.energy,
        "cost": numbers[COST],
        "solver": {
            "converged": solved(report),
            "residual": report["residual"],
            "iterations": report["iterations"],
            "rung": report["rung"],
            "jumped": report["jumped"],
        },
    }
    return {"observation": seen, "achieved_goal": reached, "desired_goal": desired}, outcome, info


def rewards(reward: str, outcome: Outcome) -> Array:
    """Return the rewards (...,) of the kind `reward`."""
    return np.subtract(outcome.success, 1.0) if reward == "sparse" else outcome.dense_reward


def compute_reward(task: Task, reward: str, achieved: ArrayLike, desired: ArrayLike) -> Any:
    """Return the reward of a goal (k,) as a float, or of a batch (..., k) as a float32 array (...,)."""
    found = rewards(reward, task.outcome(achieved, desired))
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
