"""The native batch of environments as a `VecEnv` of Stable-Baselines3."""

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

import tca_envs  # noqa: F401  (registers the environments)

Observations = dict[str, NDArray[Any]]
Step = tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]


def make(name: str, lanes: int, seed: int | None = None, done_steps: int | None = None, **options: Any) -> "BatchVecEnv":
    """Return a batch of environments for a learner of Stable-Baselines3.

    Parameters
    ----------
    name : str
        Id of the environment.
    lanes : int
        How many.
    seed : int, optional
        Lane i starts with `seed` + i.
    done_steps : int, optional
        See `BatchVecEnv`.
    **options
        Arguments of the environment.

    Returns
    -------
    BatchVecEnv
    """
    vector = gymnasium.make_vec(name, lanes, autoreset_mode=AutoresetMode.DISABLED, **options)
    env = BatchVecEnv(vector, done_steps)
    env.seed(seed)
    return env


class BatchVecEnv(VecEnv):
    """N lanes of a Gymnasium `VectorEnv` with the interface of Stable-Baselines3.

    Observations, rewards, ends and infos are those that its `DummyVecEnv` gives for N single environments. A lane whose
    episode is over starts the next one in the same step; the last observation is in `info["terminal_observation"]`, and
    `info["TimeLimit.truncated"]` says that the learner may look beyond it. Every array belongs to the caller.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Its observations are dictionaries of arrays and its autoreset mode is DISABLED: this class resets.
    done_steps : int, optional
        Truncate episodes whose goal has been held for this number of steps (`info["is_success"]`).

    Raises
    ------
    ValueError
        If an argument has another type or value.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], done_steps: int | None = None) -> None:
        if not isinstance(env, VectorEnv):
            raise ValueError(f"env = {env!r}: expected a gymnasium.vector.VectorEnv")
        if env.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
            raise ValueError(f"env has autoreset_mode {env.metadata.get('autoreset_mode')}: expected {AutoresetMode.DISABLED}")
        if not isinstance(env.single_observation_space, gymnasium.spaces.Dict):
            raise ValueError(f"env has observations of {env.single_observation_space}: expected a dictionary")
        if done_steps is not None and (not isinstance(done_steps, int) or done_steps < 1):
            raise ValueError(f"done_steps = {done_steps!r}: expected a positive integer")
        self.env = env
        self.done_steps = done_steps
        self._held = np.zeros(env.num_envs, dtype=np.intp)
        self._actions: Any = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Observations:
        """Start an episode in every lane, with the seeds and options set before; returns observations (N, ...)."""
        seeds, options = self._seeds, self._options
        if any(other != options[0] for other in options):
            raise ValueError(f"options = {options!r}: expected the same for every environment of a batch")
        observation, infos = self.env.reset(
            seed=None if all(seed is None for seed in seeds) else seeds,  # type: ignore[arg-type]  # lists are fine
            options=options[0] or None,
        )
        self._reset_seeds()
        self._reset_options()
        self._held[:] = 0
        self.reset_infos = by_lane(infos, np.arange(self.num_envs))
        return {key: np.array(value) for key, value in observation.items()}

    def step_async(self, actions: NDArray[Any]) -> None:
        """Note the actions (N, a)."""
        self._actions = actions

    def step_wait(self) -> Step:
        """Step with the actions noted; returns observations (N, ...), rewards (N,), ends (N,) and N infos."""
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        if self.done_steps is not None:
            self._held = np.where(infos["is_success"], self._held + 1, 0)
            truncated = truncated | (self._held >= self.done_steps)
        done = terminated | truncated
        rows = by_lane(infos, np.arange(self.num_envs))
        for row, limited in zip(rows, (truncated & ~terminated).tolist(), strict=True):
            row["TimeLimit.truncated"] = limited
        if done.any():
            over = np.flatnonzero(done)
            for lane in over:
                rows[lane]["terminal_observation"] = {key: np.array(value[lane]) for key, value in observation.items()}
            observation, infos = self.env.reset(options={"reset_mask": done})
            self._held[over] = 0
            for lane, info in zip(over, by_lane(infos, over), strict=True):
                self.reset_infos[lane] = info
        return {key: np.array(value) for key, value in observation.items()}, reward.astype(np.float32), done, rows

    def close(self) -> None:
        """Release what the environments hold."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return the lanes' pictures (height, width, 3)."""
        if self.render_mode != "rgb_array":
            warnings.warn(f"render_mode = {self.render_mode!r}: pictures come from 'rgb_array' only", stacklevel=2)
            return [None] * self.num_envs
        frames: Any = self.env.render()
        return list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the lanes `indices` (default: all)."""
        values = self.env.get_attr(attr_name)  # type: ignore[attr-defined]  # of the vectors that Gymnasium makes
        return [values[lane] for lane in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the lanes `indices` (default: all)."""
        values = [value] * self.num_envs if indices is None else list(self.env.get_attr(attr_name))  # type: ignore[attr-defined]
        for lane in self._get_indices(indices):
            values[lane] = value
        self.env.set_attr(attr_name, values)  # type: ignore[attr-defined]

    def env_method(self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any) -> list[Any]:
        """Return what a method of the lanes `indices` (default: all) returns."""
        results = self.env.call(method_name, *method_args, **method_kwargs)  # type: ignore[attr-defined]
        return [results[lane] for lane in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each of the lanes `indices` (default: all): they are rows of arrays and wear no wrapper."""
        return [False for _ in self._get_indices(indices)]


def by_lane(infos: dict[str, Any], lanes: NDArray[np.intp]) -> list[dict[str, Any]]:
    """Return infos of single environments from a batch's, where the mask `_key` tells which lanes have a `key`.

    It runs in every step: copies of a dictionary that are filled key by key are twice as fast as new ones.
    """
    names = [name for name in infos if f"_{name}" in infos]
    known = {name: infos[f"_{name}"][lanes] for name in names}
    blank = dict.fromkeys(name for name in names if known[name].all())
    rows: list[dict[str, Any]] = [blank.copy() for _ in range(len(lanes))]
    for name in names:
        values = infos[name]
        column = by_lane(values, lanes) if isinstance(values, dict) else values[lanes]
        listed = column.tolist() if isinstance(column, np.ndarray) and column.ndim == 1 else column
        if name in blank:
            for row, value in zip(rows, listed, strict=True):
                row[name] = value
        else:
            for row, value, there in zip(rows, listed, known[name], strict=True):
                if there:
                    row[name] = value
    return rows
