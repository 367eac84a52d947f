"""Tasks: goal, observation and success of each environment, and the clock that they share."""

from tca_envs.tasks.reach import Reach

TASKS = {"reach": Reach}
