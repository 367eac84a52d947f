"""Tasks: goal, observation and success of each environment, and the clock that they share."""

from collections.abc import Callable

from tca_envs.tasks.pick_and_place import PickAndPlace
from tca_envs.tasks.reach import Reach
from tca_envs.tasks.task import Task
from tca_envs.tasks.twist_align import TwistAlign

TASKS: dict[str, Callable[[str, float], Task]] = {"reach": Reach, "twist-align": TwistAlign, "pick-and-place": PickAndPlace}
