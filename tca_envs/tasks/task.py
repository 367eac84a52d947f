"""What every task is made of, and what the environment asks of it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from math import floor
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import check
from tca_envs.mechanics.discretisation import COARSEST, FINEST
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT
from tca_envs.tasks.core import CUT_OFF, Core, Record

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

CELL_K = 25.0
"""Edge of the cells of temperature space that are dealt out to training and held-out goals [K]: about a millimetre of tip."""
SPLITS = ("train", "held-out")
HOTTEST = float(np.ceil(10.0 * (CUT_OFF - AMBIENT) / (SOFT_LIMIT - AMBIENT)) / 10.0)
"""Upper bound of a scaled temperature."""


class Outcome(NamedTuple):
    """What is said of goals, over the last axis."""

    success: Mask
    """Whether they are reached."""
    dense_reward: Array
    measures: Mapping[str, Array]
    """What `info` reports, by key."""


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
    def draw(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return goals (N, k) and scenes (N, s) of new episodes of this task's split, each drawn by its own generator."""

    def step(self, core: Core, action: Array) -> Array:
        """Advance all lanes by one step under actions (N, a); returns the solver's report, see `Core.step`."""
        return core.step(action)

    @abstractmethod
    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, k)."""

    @abstractmethod
    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, o) what a controller measures; that of the m heated TCAs, 2 m numbers, is there already.

        `achieved` (N, k) is what is compared with the goal.
        """

    @abstractmethod
    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return what is to be said of goals (..., k); `away` (...,) is the distance of their first three numbers."""

    def of_this_split(self, temperature: Sequence[float]) -> bool:
        """Return whether goals at `temperature` (n,) [degC] belong to this task's split."""
        return held_out(temperature) == (self.split == "held-out")


def rounds(
    generators: Sequence[np.random.Generator],
    candidate: Callable[[np.random.Generator], list[float]],
    accepted: Callable[[NDArray[np.intp], Array], Mask],
) -> None:
    """Let each generator draw candidates until one is accepted; all that wait for that are judged at once.

    Parameters
    ----------
    generators : sequence of numpy.random.Generator
        N of them.
    candidate : callable
        Draws one.
    accepted : callable
        Of the indices of p generators (p,) and their candidates (p, c): which ones are accepted (p,); it keeps those.
    """
    waiting = np.arange(len(generators))
    while waiting.size:
        drawn = np.array([candidate(generators[i]) for i in waiting.tolist()])
        waiting = waiting[~accepted(waiting, drawn)]


def steady_goals(task: Task, core: Core, generators: Sequence[np.random.Generator]) -> Array:
    """Return what arms achieve (N, k) in steady states of the task's split, drawn uniformly up to the soft limit.

    Where the arm could end on several sides, other temperatures are drawn, see `Core.settle`.
    """
    goals = np.empty((len(generators), core.record.goal.shape[1]))
    muscles = len(core.arm.muscles)

    def candidate(generator: np.random.Generator) -> list[float]:
        while True:
            temperature: list[float] = (AMBIENT + (SOFT_LIMIT - AMBIENT) * generator.random(muscles)).tolist()
            if task.of_this_split(temperature):
                return temperature

    def accepted(which: NDArray[np.intp], temperature: Array) -> Mask:
        record, good = core.settle(temperature)
        goals[which] = task.achieved(record)
        return good

    rounds(generators, candidate, accepted)
    return goals


def held_out(temperature: Sequence[float]) -> bool:
    """Return whether goals at `temperature` (n,) [degC] are held out: one cell in five, spread evenly over the space."""
    return sum(floor((t - AMBIENT) / CELL_K) * (i % 4 + 1) for i, t in enumerate(temperature)) % 5 == 0


def box_with_heat(count: int, low: list[float], high: list[float]) -> spaces.Box:
    """Return the space of observations: of `count` heated TCAs, followed by numbers from `low` to `high`.

    Temperatures go from 0 (25 degC) to 1 (150 degC), powers from 0 to 1.
    """
    return spaces.Box(
        np.array([0.0] * (2 * count) + low, dtype=np.float32),
        np.array([HOTTEST] * count + [1.0] * count + high, dtype=np.float32),
        dtype=np.float32,
    )
