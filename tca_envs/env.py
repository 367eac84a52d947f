"""The Gymnasium environment: one lane of a task."""

from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import Arm
from tca_envs.mechanics.thermal import SOFT_LIMIT
from tca_envs.tasks import TASKS
from tca_envs.tasks.core import solved

REWARDS = ("sparse", "dense")


class ArmEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One arm with one task; the task's docstring (`tca_envs.tasks`) documents spaces, rewards and episodes.

    Parameters
    ----------
    task : str
        Name in `tca_envs.tasks.TASKS`.
    reward : str
        "sparse" or "dense".
    split : str
        Where goals come from: "train" or "held-out".
    tolerance : float
        Largest error of the arm's tip [m], 1e-9 to 1e-3. The cheapest discretisation that keeps to it over the task's states
        is chosen; `env.unwrapped.arm.discretisation` prints it.

    Raises
    ------
    ValueError
        If an argument is none of these.
    """

    def __init__(
        self, task: str = "reach", reward: str = "sparse", split: str = "train", tolerance: float = presets.TOLERANCE
    ) -> None:
        if not isinstance(task, str) or task not in TASKS:
            raise ValueError(f"task = {task!r}: expected one of {', '.join(map(repr, TASKS))}")
        if not isinstance(reward, str) or reward not in REWARDS:
            raise ValueError(f"reward = {reward!r}: expected one of {', '.join(map(repr, REWARDS))}")
        self.metadata = {"render_modes": []}
        self.reward = reward
        self.task = TASKS[task](split, tolerance)
        self.core = self.task.core(1)
        self.action_space = spaces.Box(-1.0, 1.0, (self.task.actions,), np.float32)
        self.observation_space = spaces.Dict(
            {
                "observation": self.task.observation_space,
                "achieved_goal": self.task.goal_space,
                "desired_goal": self.task.goal_space,
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start an episode from rest with a new goal; see `gymnasium.Env.reset`. No option is known."""
        super().reset(seed=seed)
        goals, scenes = self.task.draw(self.core, self.np_random, 1)
        self.core.reset(np.zeros(1, dtype=np.intp), goals, scenes)
        observation = self._observe()
        return observation, self._info(observation, self.core.rest_report[0])

    def step(self, action: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Act for 0.1 s; see `gymnasium.Env.step`.

        Raises
        ------
        ValueError
            For an action of the wrong shape or with a number that is not finite; the episode stays as it was.
        """
        try:
            command = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            command = np.empty(0)
        if command.shape != self.action_space.shape or not np.isfinite(command).all():
            raise ValueError(f"action = {action!r}: expected finite numbers of shape {self.action_space.shape}")
        report = self.task.step(self.core, command[np.newaxis])[0]
        observation = self._observe()
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], None)
        return observation, reward, False, not solved(report), self._info(observation, report)

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Return the reward of a goal (k,) as a float, or of a batch (..., k) as an array (...,); `info` is not read."""
        if self.reward == "sparse":
            reward = self.task.success(achieved_goal, desired_goal) - 1.0
        else:
            reward = self.task.dense_reward(achieved_goal, desired_goal)
        return float(reward) if np.ndim(reward) == 0 else reward.astype(np.float32)

    @property
    def arm(self) -> Arm:
        """The arm's mechanics."""
        return self.core.arm

    def get_state(self) -> dict[str, Any]:
        """Return the episode, to the last bit, as arrays by name and the state of the random generator ("rng").

        The count of steps belongs to Gymnasium's `TimeLimit` and is not part of it.
        """
        record = self.core.record.copy()
        state: dict[str, Any] = {f.name: getattr(record, f.name) for f in fields(record)}
        state["rng"] = self.np_random.bit_generator.state
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what `get_state` returned.

        Raises
        ------
        ValueError
            If it is not such a state of this task; the episode stays as it was.
        """
        record = self.core.record
        shapes = {f.name: getattr(record, f.name).shape for f in fields(record)}
        found = {name: np.shape(value) for name, value in state.items() if name != "rng"}
        if found != shapes or "rng" not in state:
            raise ValueError(f"state has arrays {found}: expected {shapes} and 'rng'")
        for name in shapes:
            if not np.isfinite(np.asarray(state[name], dtype=np.float64)).all():
                raise ValueError(f"state[{name!r}] = {state[name]!r}: expected finite numbers")
        try:
            self.np_random.bit_generator.state = state["rng"]
        except (TypeError, ValueError, KeyError):
            raise ValueError(f"state['rng'] = {state['rng']!r}: expected the state of a bit generator") from None
        for name in shapes:
            getattr(record, name)[...] = state[name]

    def _observe(self) -> dict[str, NDArray[Any]]:
        observation = self.task.observe(self.core)[0].astype(np.float32)
        achieved = self.task.achieved(self.core.record)[0].astype(np.float32)
        return {
            "observation": observation,
            "achieved_goal": achieved,
            "desired_goal": self.core.record.goal[0].astype(np.float32),
        }

    def _info(self, observation: dict[str, NDArray[Any]], report: NDArray[np.float64]) -> dict[str, Any]:
        record = self.core.record
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        return {
            "is_success": bool(self.task.success(achieved, desired)),
            **{name: float(value) for name, value in self.task.measures(achieved, desired).items()},
            "energy_J": float(record.energy[0]),
            "cost": float(np.maximum(record.temperature[0] - SOFT_LIMIT, 0.0).sum()),
            "solver": {
                "converged": bool(solved(report)),
                "residual": float(report[1]),
                "iterations": int(report[2]),
                "rung": int(report[0]),
                "jumped": bool(report[3]),
            },
        }
