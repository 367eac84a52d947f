"""What every task is made of, and what the environment asks of it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import check
from tca_envs.mechanics.discretisation import COARSEST, FINEST
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.tasks.core import CUT_OFF, Core, Record

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_K = 25.0
"""Edge of the cells of temperature space that are dealt out to training and held-out goals [K]: about a millimetre of tip."""
SPLITS = ("train", "held-out")
HOTTEST = float(np.ceil(10.0 * (CUT_OFF - AMBIENT) / (SOFT_LIMIT - AMBIENT)) / 10.0)
"""Upper bound of a scaled temperature."""


class Task(ABC):
    """A goal for an arm. A subclass's docstring is its environment's documentation page.

    Parameters
    ----------
    split : str
        Where goals come from: "train" or "held-out".
    tolerance : float
        Largest error of the arm's tip [m].
    """

    actions: ClassVar[int]
    """Numbers in an action."""
    goal_space: spaces.Box
    observation_space: spaces.Box

    def __init__(self, split: str, tolerance: float = presets.TOLERANCE) -> None:
        if not isinstance(split, str) or split not in SPLITS:
            raise ValueError(f"split = {split!r}: expected one of {', '.join(map(repr, SPLITS))}")
        self.split = split
        self.tolerance = check.scalar("tolerance", tolerance, FINEST, COARSEST)

    @abstractmethod
    def core(self, lanes: int) -> Core:
        """Return `lanes` lanes of this task's arm."""

    @abstractmethod
    def draw(self, core: Core, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        """Return goals (count, k) and scenes (count, s) of new episodes, of this task's split."""

    def step(self, core: Core, action: Array) -> Array:
        """Advance all lanes by one step under actions (N, a); returns the solver's report, see `Core.step`."""
        return core.step(action)

    @abstractmethod
    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, k)."""

    @abstractmethod
    def observe(self, core: Core) -> Array:
        """Return what a controller measures (N, o)."""

    @abstractmethod
    def success(self, achieved: NDArray[Any], desired: NDArray[Any]) -> Mask:
        """Return whether goals are reached, over the last axis."""

    @abstractmethod
    def dense_reward(self, achieved: NDArray[Any], desired: NDArray[Any]) -> Array:
        """Return the dense reward over the last axis."""

    @abstractmethod
    def measures(self, achieved: NDArray[Any], desired: NDArray[Any]) -> Mapping[str, Array]:
        """Return what `info` reports of goals, by key."""

    def of_this_split(self, temperature: Array) -> bool:
        """Return whether goals at `temperature` (n,) [degC] belong to this task's split."""
        return held_out(temperature) == (self.split == "held-out")


def steady_goals(task: Task, core: Core, rng: np.random.Generator, count: int) -> Array:
    """Return what `count` arms achieve (count, k) in steady states of the task's split, drawn uniformly up to the soft limit.

    Where the arm could end on several sides, other temperatures are drawn, see `Core.settle`.
    """
    goals = np.empty((count, core.record.goal.shape[1]))
    for i in range(count):
        settled = False
        while not settled:
            temperature = AMBIENT + (SOFT_LIMIT - AMBIENT) * rng.random(len(core.arm.muscles))
            if task.of_this_split(temperature):
                record, good = core.settle(temperature[np.newaxis])
                settled = bool(good[0])
        goals[i] = task.achieved(record)[0]
    return goals


def held_out(temperature: Array) -> bool:
    """Return whether goals at `temperature` (n,) [degC] are held out: one cell in five, spread evenly over the space."""
    cells = np.floor((temperature - AMBIENT) / CELL_K).astype(int)
    return bool((cells * (np.arange(cells.size) % 4 + 1)).sum() % 5 == 0)


def heat(core: Core) -> Array:
    """Return the observation of the heated TCAs (N, 2 m): temperatures from 0 (25 degC) to 1 (150 degC), powers from 0 to 1."""
    temperature = (core.record.temperature - AMBIENT) / (SOFT_LIMIT - AMBIENT)
    return np.hstack([temperature, core.record.power / core.heating.max_power])


def box_with_heat(count: int, low: list[float], high: list[float]) -> spaces.Box:
    """Return the space of `heat` for `count` TCAs, followed by numbers from `low` to `high`."""
    return spaces.Box(
        np.array([0.0] * (2 * count) + low, dtype=np.float32),
        np.array([HOTTEST] * count + [1.0] * count + high, dtype=np.float32),
        dtype=np.float32,
    )
