"""The vector environment: N lanes of a task, stepped by one call."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numba
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tca_envs import batch, render
from tca_envs.batch import Observation
from tca_envs.mechanics import Arm
from tca_envs.tasks.core import solved

Lanes = NDArray[np.intp]
Mask = NDArray[np.bool_]

NO_LANES = np.empty(0, dtype=np.intp)
PICTURES = ("rgb_array", "depth_array")
"""Render modes of many lanes."""
FOR_ALL = ("compute_reward", "task", "reward", "arm", "render_mode", "spec")
"""What `call` and `get_attr` find that is the same for all lanes, beside the spaces."""


class ArmVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """N arms with the same task: bit by bit what Gymnasium's `SyncVectorEnv` of N `ArmEnv` with a `TimeLimit` is, but faster.

    The task's docstring (`tca_envs.tasks`) documents spaces, rewards and episodes. Row i of all that is returned equals what
    the single environment with the seed of lane i returns, whatever N and the number of threads; it belongs to the caller.

    Parameters
    ----------
    num_envs : int
        N.
    task, reward
        As of `tca_envs.env.ArmEnv`.
    max_episode_steps : int, optional
        Episodes are truncated after so many steps; `gymnasium.make_vec` passes that of the registered id. None or -1: never.
    autoreset_mode : AutoresetMode or str
        When a lane whose episode has ended starts anew: "NextStep", "SameStep", or "Disabled": by `reset` with the option
        "reset_mask".
    threads : int, optional
        How many threads share the lanes; by default as many as Numba has. A forked process uses one, whatever is asked
        for. On a machine that is busy with other work one is faster: threads wait for each other.
    render_mode : str, optional
        "rgb_array" or "depth_array": `render` returns pictures of all lanes. A window is for one arm: `gymnasium.make`.
    width, height, camera
        As of `ArmEnv`.
    solver : str or function
        As of `ArmEnv`, but for "shooting", which solves one arm at a time.
    **arguments
        Of the task, as of `ArmEnv`.

    Raises
    ------
    ValueError
        If an argument has a value that it cannot have.
    gymnasium.error.DependencyNotInstalled
        If a render mode is asked for and PyVista is missing.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "reach",
        reward: str = "sparse",
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: str | None = None,
        width: int = render.SIZE,
        height: int = render.SIZE,
        camera: render.Camera = "front",
        solver: Any = "collocation",
        **arguments: Any,
    ) -> None:
        self.num_envs = _count("num_envs", num_envs)
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError:
            expected = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode = {autoreset_mode!r}: expected one of {expected}") from None
        endless = max_episode_steps is None or max_episode_steps == -1
        self.max_episode_steps = None if endless else _count("max_episode_steps", max_episode_steps)
        most: int = numba.config.NUMBA_NUM_THREADS
        self.threads = most if threads is None else _count("threads", threads, most)
        if solver == "shooting":
            raise ValueError(
                f"solver = {solver!r}: expected 'collocation' or a function; shooting solves one arm at a time: gymnasium.make"
            )
        self.task = batch.new_task(task, reward, arguments)
        self._renderer = render.new_renderer(render_mode, width, height, camera, PICTURES)
        self.render_mode = render_mode
        self.metadata = {"render_modes": list(PICTURES), "render_fps": render.fps(self.task.step_s), "autoreset_mode": mode}
        self.reward = reward
        self.core = self.task.core(self.num_envs, batch.new_solver(solver))
        self.core.threads = self.threads
        self.single_action_space = batch.action_space(self.task)
        self.single_observation_space = batch.observation_space(self.task)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._seeds = [-1] * self.num_envs
        self._over = np.zeros(self.num_envs, dtype=np.bool_)  # whether the last step ended the episode
        self._ready = False  # whether there has been a reset

    def reset(  # Gymnasium's own vector environments take lists of seeds, too
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes from rest with new goals.

        Parameters
        ----------
        seed : int or list of int or None, optional
            Of each lane's generator of goals; an integer stands for seed, seed + 1, ... A lane without one goes on with the
            generator that it has.
        options : dict, optional
            "reset_mask", an (N,) array of booleans, restricts the reset to some lanes. No other option is known.

        Returns
        -------
        tuple
            Observations of all lanes, and infos of those that were reset.

        Raises
        ------
        ValueError
            For other seeds or masks; all episodes stay as they were.
        ResetNeeded
            If lanes are left out before all have been reset once.
        """
        seeds, mask = self._checked_seeds(seed), self._checked_mask(options)
        if not self._ready and not mask.all():
            raise ResetNeeded("the first reset has to be one of all lanes")
        for lane in np.flatnonzero(mask).tolist():
            if seeds[lane] is not None:
                self._generators[lane], self._seeds[lane] = seeding.np_random(seeds[lane])
        self._ready = True
        self._start(np.flatnonzero(mask))
        self._over[mask] = False
        report = np.repeat(self.core.rest_report, self.num_envs, axis=0)
        observation, _, info = batch.look(self.task, self.core, report)
        return observation, _with_masks(info, mask)

    def step(self, actions: NDArray[Any]) -> tuple[Observation, NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        """Act for one step in all lanes, but for those that start anew instead; see `gymnasium.vector.VectorEnv.step`.

        Raises
        ------
        ValueError
            For actions of the wrong shape or, in a lane that acts, with a number that is not finite; all episodes stay as
            they were.
        ResetNeeded
            Before the first reset, and with autoreset disabled if an episode is over.
        """
        mode, over = self.metadata["autoreset_mode"], self._over
        if not self._ready:
            raise ResetNeeded("cannot step before the first reset")
        if mode is AutoresetMode.DISABLED and over.any():
            raise ResetNeeded(f"episodes are over in lanes {np.flatnonzero(over).tolist()}: reset those")
        anew = np.flatnonzero(over) if mode is AutoresetMode.NEXT_STEP else NO_LANES
        command = self._checked_actions(actions, anew)
        if anew.size:  # they rest meanwhile, where a step costs next to nothing and cannot fail
            self.core.reset(anew, 0.0, 0.0)
        report = self.task.step(self.core, command)
        truncated = ~solved(report)
        if self.max_episode_steps is not None:
            truncated |= self.core.record.steps >= self.max_episode_steps
        if anew.size:
            self._start(anew)
            report[anew] = self.core.rest_report
            truncated[anew] = False
        observation, outcome, info = batch.look(self.task, self.core, report)
        reward = batch.rewards(self.reward, outcome)
        if anew.size:
            reward[anew] = 0.0
        final: dict[str, Any] = {}
        if mode is AutoresetMode.SAME_STEP and truncated.any():
            final = {
                "final_obs": _rows(observation, truncated),
                "_final_obs": truncated.copy(),
                "final_info": _with_masks(info, truncated),
                "_final_info": truncated.copy(),
            }
            ended = np.flatnonzero(truncated)
            self._start(ended)
            report[ended] = self.core.rest_report
            observation, _, info = batch.look(self.task, self.core, report)
        self._over = truncated.copy()
        infos = {**_with_masks(info, np.ones(self.num_envs, dtype=np.bool_)), **final}
        return observation, reward, np.zeros(self.num_envs, dtype=np.bool_), truncated, infos

    def render(self) -> tuple[NDArray[Any], ...] | None:
        """Return the pictures of all lanes, each as of `ArmEnv.render`; None without a render mode."""
        renderer = self._renderer
        if renderer is None:
            return None
        return tuple(renderer.render(self.task, self.core, lane) for lane in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Release what pictures hold, see `gymnasium.vector.VectorEnv.close`."""
        if self._renderer is not None:
            self._renderer.close()

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Return the reward of a goal (k,) as a float, or of a batch (..., k) as an array (...,); `info` is not read."""
        return batch.compute_reward(self.task, self.reward, achieved_goal, desired_goal)

    @property
    def arm(self) -> Arm:
        """The arms' mechanics."""
        return self.core.arm

    @property  # type: ignore[misc]  # without a setter, as SyncVectorEnv has it
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The lanes' generators of goals."""
        return tuple(self._generator(lane) for lane in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the lanes' generators; -1 where it is not known."""
        _ = self.np_random
        return tuple(self._seeds)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return for each lane what its environment's method `name` returns, or its attribute `name`.

        Raises
        ------
        AttributeError
            For a name that is not among `FOR_ALL`, the spaces, "metadata", "render", "np_random" and "np_random_seed".
        """
        if name == "render":
            return self.render() or (None,) * self.num_envs
        if name in ("np_random", "np_random_seed"):
            return tuple(getattr(self, name))
        if name == "metadata":
            told = {name: value for name, value in self.metadata.items() if name != "autoreset_mode"}
            return tuple(deepcopy(told) for _ in range(self.num_envs))
        if name in ("action_space", "observation_space"):
            name = f"single_{name}"
        elif name not in FOR_ALL:
            raise AttributeError(f"name = {name!r}: lanes have {', '.join(FOR_ALL)}, their spaces, metadata and np_random")
        found = getattr(self, name)
        return (found(*args, **kwargs) if callable(found) else found,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each lane, see `call`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set "np_random" of each lane, a list of generators, or "reward", the same for all.

        Raises
        ------
        ValueError
            For another name, number of values or kind of value, and for rewards that differ.
        """
        given = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(given) != self.num_envs:
            raise ValueError(f"values = {values!r}: expected {self.num_envs} of them, one for each lane")
        if name == "reward" and given[0] in batch.REWARDS and given.count(given[0]) == len(given):
            self.reward = given[0]
        elif name == "np_random" and all(isinstance(value, np.random.Generator) for value in given):
            self._generators, self._seeds = given, [-1] * self.num_envs
        else:
            raise ValueError(f"{name} = {values!r}: expected 'np_random' and generators, or 'reward' and one for all lanes")

    def get_state(self) -> dict[str, Any]:
        """Return all episodes, to the last bit: arrays by name and the states of the random generators ("rng")."""
        return {
            **batch.snapshot(self.core.record),
            "over": self._over.copy(),
            "rng": [generator.bit_generator.state for generator in self.np_random],
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `get_state` returned.

        Raises
        ------
        ValueError
            If it is not such a state of so many lanes of this task; all episodes stay as they were.
        """
        batch.check_state(state, self.get_state())
        generators = [np.random.Generator(np.random.PCG64(0)) for _ in range(self.num_envs)]
        try:
            for generator, rng in zip(generators, state["rng"], strict=True):
                generator.bit_generator.state = rng
        except (TypeError, ValueError, KeyError):
            raise ValueError(
                f"state['rng'] = {state['rng']!r}: expected the states of {self.num_envs} bit generators"
            ) from None
        batch.restore(self.core.record, state)
        self._over[:] = state["over"]
        self._generators, self._seeds, self._ready = list(generators), [-1] * self.num_envs, True

    def _start(self, lanes: Lanes) -> None:
        """Put lanes at rest with new goals."""
        goals, scenes = self.task.sample(self.core, [self._generator(lane) for lane in lanes.tolist()])
        self.core.reset(lanes, goals, scenes)

    def _generator(self, lane: int) -> np.random.Generator:
        found = self._generators[lane]
        if found is None:
            found, self._seeds[lane] = seeding.np_random()
            self._generators[lane] = found
        return found

    def _checked_actions(self, actions: Any, ignored: Lanes) -> NDArray[np.float64]:
        """Return actions (N, a), in lanes that are ignored those that leave the heaters off."""
        shape = (self.num_envs, self.task.actions)
        if ignored.size and np.shape(actions) == shape:
            actions = np.array(actions)
            actions[ignored] = -1.0
        return batch.checked_actions("actions", actions, shape)

    def _checked_seeds(self, seed: Any) -> list[int | None]:
        given = [seed + i for i in range(self.num_envs)] if _integer(seed) else seed
        given = [None] * self.num_envs if given is None else given
        good = isinstance(given, list | tuple | np.ndarray) and len(given) == self.num_envs
        if not good or any(s is not None and not (_integer(s) and s >= 0) for s in given):
            raise ValueError(f"seed = {seed!r}: expected an integer of at least 0, None, or {self.num_envs} of these")
        return [None if s is None else int(s) for s in given]

    def _checked_mask(self, options: Mapping[str, Any] | None) -> Mask:
        if not options or "reset_mask" not in options:
            return np.ones(self.num_envs, dtype=np.bool_)
        mask = options["reset_mask"]
        if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,) and mask.any()):
            raise ValueError(
                f"options['reset_mask'] = {mask!r}: expected an array of {self.num_envs} booleans, not all of them False"
            )
        return mask


def _integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _count(name: str, value: Any, most: int | None = None) -> int:
    if not _integer(value) or value < 1 or (most is not None and value > most):
        raise ValueError(f"{name} = {value!r}: expected an integer of at least 1{'' if most is None else f', at most {most}'}")
    return int(value)


def _rows(observation: Observation, mask: Mask) -> NDArray[np.object_]:
    """Return the observations of some lanes as an array (N,) of dictionaries, None in the others."""
    result = np.full(mask.size, None, dtype=object)
    for lane in np.flatnonzero(mask).tolist():
        result[lane] = {key: values[lane].copy() for key, values in observation.items()}
    return result


def _with_masks(info: Mapping[str, Any], mask: Mask) -> dict[str, Any]:
    """Return infos, zero in lanes that have none, and beside each key a mask of those that have; nothing of it is shared."""
    without = np.flatnonzero(~mask)
    result: dict[str, Any] = {}
    for key, value in info.items():
        if isinstance(value, dict):
            result[key] = _with_masks(value, mask)
        else:
            result[key] = value.copy()
            if without.size:
                result[key][without] = 0
        result[f"_{key}"] = mask.copy()
    return result
