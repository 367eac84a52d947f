"""The Gymnasium environment: one lane of a task."""

from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tca_envs import batch, render
from tca_envs.mechanics import Arm
from tca_envs.tasks.core import STEP_S, solved


class ArmEnv(gymnasium.Env[Any, NDArray[Any]]):
    """One arm with one task; the task's docstring (`tca_envs.tasks`) documents spaces, rewards and episodes.

    Parameters
    ----------
    task : str
        Name of a task in `tca_envs.registry`, or "module:name": then the module is imported first.
    reward : str
        "sparse" or "dense".
    render_mode : str, optional
        "rgb_array" or "depth_array": `render` returns pictures; "human": a window shows every step in real time.
    width, height : int
        Of pictures or the window [pixel].
    camera : str or pair of (3,) arrays
        "front", "side", "above" or "gripper", or where it stands and at what it looks [m] in the base frame, z down.
    solver : str or function
        What finds equilibria: "collocation"; "shooting", the paper's method, warm-started, slow, and in a checkout of the
        repository only; or a function with the signature of `tca_envs.mechanics.continuation.solve`.
    **arguments
        Of the task: those of `tca_envs.tasks.task.Task`, such as `robot`, `split`, `tolerance` and `step_s`, and its own, such
        as `success_mm`.

    Raises
    ------
    ValueError
        If an argument has a value that it cannot have.
    gymnasium.error.DependencyNotInstalled
        If a render mode is asked for and PyVista is missing.
    """

    # A dictionary of the class, as Gymnasium has it; instances have their own.
    metadata: dict[str, Any] = {"render_modes": list(render.MODES), "render_fps": render.fps(STEP_S)}  # noqa: RUF012

    def __init__(
        self,
        task: str = "reach",
        reward: str = "sparse",
        render_mode: str | None = None,
        width: int = render.SIZE,
        height: int = render.SIZE,
        camera: render.Camera = "front",
        solver: Any = "collocation",
        **arguments: Any,
    ) -> None:
        self.task = batch.new_task(task, reward, arguments)
        self._renderer = render.new_renderer(render_mode, width, height, camera)
        self.render_mode = render_mode
        self.metadata = deepcopy(self.metadata) | {"render_fps": render.fps(self.task.step_s)}
        self.reward = reward
        self.core = self.task.core(1, batch.new_solver(solver))
        self.action_space = batch.action_space(self.task)
        self.observation_space = batch.observation_space(self.task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start an episode from rest with a new goal; see `gymnasium.Env.reset`. No option is known."""
        super().reset(seed=seed)
        goals, scenes = self.task.sample(self.core, [self.np_random])
        self.core.reset(np.zeros(1, dtype=np.intp), goals, scenes)
        observation, _, info = self._result(self.core.rest_report)
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Act for one step; see `gymnasium.Env.step`.

        Raises
        ------
        ValueError
            For an action of the wrong shape or with a number that is not finite; the episode stays as it was.
        """
        command = batch.checked_actions("action", action, (self.task.actions,))
        report = self.task.step(self.core, command[np.newaxis])
        observation, reward, info = self._result(report)
        if self.render_mode == "human":
            self.render()
        return observation, reward, False, not solved(report[0]), info

    def _result(self, report: NDArray[np.float64]) -> tuple[dict[str, NDArray[Any]], float, dict[str, Any]]:
        """Return observation, reward and info: the only row of a batch of one."""
        observation, outcome, info = batch.look(self.task, self.core, report)
        reward = batch.rewards(self.reward, outcome)
        return {key: values[0] for key, values in observation.items()}, reward.item(0), batch.of_lane(info, 0)

    def render(self) -> Any:
        """Return the picture (height, width, 3) uint8, or the distances (height, width) float32 [m] from the camera's plane.

        None with "human", and without a render mode, see `gymnasium.Env.render`; docs/seeing.md says what a picture shows.

        Raises
        ------
        RuntimeError
            If there is no OpenGL, or no display for a window.
        """
        return None if self._renderer is None else self._renderer.render(self.task, self.core)

    def close(self) -> None:
        """Close the window."""
        if self._renderer is not None:
            self._renderer.close()

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Return the reward of a goal (k,) as a float, or of a batch (..., k) as an array (...,); `info` is not read."""
        return batch.compute_reward(self.task, self.reward, achieved_goal, desired_goal)

    @property
    def arm(self) -> Arm:
        """The arm's mechanics."""
        return self.core.arm

    def get_state(self) -> dict[str, Any]:
        """Return the episode, to the last bit, as arrays by name and the state of the random generator ("rng").

        The count that Gymnasium's `TimeLimit` keeps is not part of it; "steps", which pictures show, is.
        """
        return {**batch.snapshot(self.core.record), "rng": self.np_random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what `get_state` returned.

        Raises
        ------
        ValueError
            If it is not such a state of this task; the episode stays as it was.
        """
        batch.check_state(state, self.get_state())
        try:
            self.np_random.bit_generator.state = state["rng"]
        except (TypeError, ValueError, KeyError):
            raise ValueError(f"state['rng'] = {state['rng']!r}: expected the state of a bit generator") from None
        batch.restore(self.core.record, state)
