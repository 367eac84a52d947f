"""What every task is made of.

A new task is a subclass of `Task` with six short methods, and an entry in the registry that makes it known:

1. `__init__` takes the robot and the task's own arguments, and sets `goal_space` and `observation_space`;
2. `sample` draws the goals of new episodes; `steady_goals` does it for whatever the arm achieves at rest;
3. `achieved` returns what is compared with the goal;
4. `observe` writes what a controller measures beside the heat;
5. `judge` returns success, dense reward and what `info` reports;
6. `draw` returns what is to be seen of the goal.

`tasks/reach.py` is the shortest example. A task with an object or a stage has a `scene`, too, and acts on it in `step`, see
`tasks/pick_and_place.py`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from math import floor
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Part, Parts
from tca_envs.mechanics import check, continuation
from tca_envs.mechanics.discretisation import COARSEST, FINEST
from tca_envs.robots import TOLERANCE, Posture, Robot
from tca_envs.tasks.core import STEP_S, Core, Record, Solve

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

CELL_K = 25.0
"""Edge of the cells of temperature space that are dealt out to training and held-out goals [K]: about a millimetre of tip."""
SPLITS = ("train", "held-out")
LONGEST_STEP_S = 10.0
"""By then a TCA has come 99.6 % of the way to its steady temperature."""


class Outcome(NamedTuple):
    """What goals (..., k) come to, over the last axis."""

    success: Mask
    """Whether they are reached."""
    dense_reward: Array
    measures: Mapping[str, Array]
    """What `info` reports, by name and unit, such as "distance_mm"."""


class Task(ABC):
    """A goal for a robot. A subclass's docstring is its environment's documentation page.

    Parameters
    ----------
    robot : Robot
        What reaches the goals. Its limits and heated TCAs make the space of actions, and that of observations with the task.
    split : str
        Where goals come from: "train" or "held-out".
    tolerance : float
        Largest error of the arm's tip [m].
    step_s : float
        Duration of a step [s].

    Attributes
    ----------
    actions : int
        Numbers in an action: the powers of the heated TCAs, and what else a subclass adds.
    goal_space, observation_space : gymnasium.spaces.Box
        A subclass sets them.
    """

    scene_size: ClassVar[int] = 0
    """Numbers that the task keeps beside the goal, such as an object's place."""
    goal_space: spaces.Box
    observation_space: spaces.Box

    def __init__(self, robot: Robot, split: str = "train", tolerance: float = TOLERANCE, step_s: float = STEP_S) -> None:
        if not isinstance(robot, Robot):
            raise ValueError(f"robot = {robot!r}: expected a tca_envs.robots.Robot")
        if not isinstance(split, str) or split not in SPLITS:
            raise ValueError(f"split = {split!r}: expected one of {', '.join(map(repr, SPLITS))}")
        self.robot = robot
        self.split = split
        self.tolerance = check.scalar("tolerance", tolerance, FINEST, COARSEST)
        self.step_s = check.scalar("step_s", step_s, 0.0, LONGEST_STEP_S, above=True)
        self.actions = robot.heated

    @abstractmethod
    def sample(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return goals (N, k) and scenes (N, s) of new episodes of this task's split, each drawn by its own generator."""

    @abstractmethod
    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, k); the first three numbers, if there are so many, are a place [cm]."""

    @abstractmethod
    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, o - 2 m) what a controller measures beside temperatures and powers of the m heated TCAs.

        `achieved` (N, k) is what is compared with the goal.
        """

    @abstractmethod
    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return the outcome of goals (..., k); `away` (...,) is the distance of their first three numbers."""

    @abstractmethod
    def draw(self, record: Record, colour: str) -> Parts:
        """Return the surfaces of goal and scene of one lane, the goal's in `colour`; names are not those of the robot's."""

    def step(self, core: Core, action: Array) -> Array:
        """Advance all lanes by one step under actions (N, a); returns the solver's report, see `Core.step`."""
        return core.step(action)

    def posture(self, record: Record) -> Posture:
        """Return how the robot of one lane stands: stage and jaws."""
        return Posture()

    @property
    def ground(self) -> float:
        """Depth of the table in pictures under the base [m]."""
        return self.robot.ground

    def core(self, lanes: int, solve: Solve = continuation.solve) -> Core:
        """Return `lanes` lanes of this task's robot, brought to equilibrium by `solve`."""
        goals = int(np.prod(self.goal_space.shape))
        return Core(self.robot, self.tolerance, lanes, goals, self.scene_size, self.step_s, solve)

    def parts(self, core: Core, lane: int = 0) -> dict[str, Part]:
        """Return all that is to be seen of a lane, by name: robot, "stage", "column" and "table", goal and scene."""
        record = core.record.rows(np.array([lane]))
        posture = self.posture(record)
        known = continuation.Lane(record.strain[0], record.tension[0], record.drive[0], record.load[0])
        result = self.robot.draw(core.arm, known, record.tip[0], record.temperature[0], posture)
        achieved, goal = self.achieved(record)[0], record.goal[0]
        colour = geometry.DONE if self.outcome(achieved, goal).success else geometry.GOAL
        return {**result, **self.draw(record, colour), **geometry.site_parts(self.ground, posture.lowered)}

    def outcome(self, achieved: Any, desired: Any) -> Outcome:
        """Return the outcome of goals (..., k)."""
        reached, asked = np.asarray(achieved), np.asarray(desired)
        square = np.zeros(np.broadcast_shapes(reached.shape, asked.shape)[:-1])
        for j in range(min(3, reached.shape[-1])):  # in the order in which a step adds them up
            apart = reached[..., j].astype(np.float64) - asked[..., j]
            square += apart * apart
        return self.judge(reached, asked, np.sqrt(square))

    def of_this_split(self, temperature: Sequence[float]) -> bool:
        """Return whether goals at `temperature` (n,) [degC] belong to this task's split."""
        return held_out(temperature, self.robot.limits.ambient) == (self.split == "held-out")

    def observed(self, low: Sequence[float], high: Sequence[float]) -> spaces.Box:
        """Return the space of observations: of the heated TCAs, followed by numbers from `low` to `high`.

        Temperatures go from 0 (ambient) to 1 (the soft limit), and a little above up to the cut-off; powers from 0 to 1.
        """
        limits, count = self.robot.limits, self.robot.heated
        hottest = float(np.ceil(10.0 * (limits.cut_off - limits.ambient) / (limits.soft - limits.ambient)) / 10.0)
        return spaces.Box(
            np.array([0.0] * (2 * count) + [*low], dtype=np.float32),
            np.array([hottest] * count + [1.0] * count + [*high], dtype=np.float32),
            dtype=np.float32,
        )


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
    muscles, limits = len(core.arm.muscles), task.robot.limits

    def candidate(generator: np.random.Generator) -> list[float]:
        while True:
            temperature: list[float] = (limits.ambient + (limits.soft - limits.ambient) * generator.random(muscles)).tolist()
            if task.of_this_split(temperature):
                return temperature

    def accepted(which: NDArray[np.intp], temperature: Array) -> Mask:
        record, good = core.settle(temperature)
        goals[which] = task.achieved(record)
        return good

    rounds(generators, candidate, accepted)
    return goals


def held_out(temperature: Sequence[float], ambient: float) -> bool:
    """Return whether goals at `temperature` (n,) [degC] are held out: one cell in five, spread evenly over the space."""
    return sum(floor((t - ambient) / CELL_K) * (i % 4 + 1) for i, t in enumerate(temperature)) % 5 == 0
