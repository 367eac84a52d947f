"""A task and a robot of a user: turn the tip of an arm of two modules and five TCAs to a heading. `import toy` registers it."""

import numpy as np
from gymnasium import spaces

from tca_envs import geometry
from tca_envs.mechanics import TCA, Arm, Module, Muscle, Payload
from tca_envs.registry import Entry, register
from tca_envs.robots import Robot
from tca_envs.rotation import yaw
from tca_envs.tasks.task import Outcome, Task, steady_goals


def muscles(offset, count, turns=0.0):
    return [Muscle(offset, 2.0 * np.pi * i / count, turns, TCA()) for i in range(count)]


UPPER = Module.cylinder(0.12, 9e-3, 0.2e6, 0.07e6, 12e-3, muscles(6e-3, 4))
LOWER = Module.cylinder(0.03, 6e-3, 0.2e6, 0.07e6, 2e-3, muscles(5e-3, 1, turns=4.0))
ROBOT = Robot(Arm([UPPER, LOWER], (0.0, 0.0, 9.81), Payload(1e-3)))


class Turn(Task):
    """Turn the tip of an arm to a heading."""

    scene_size = 1

    def __init__(self, robot, success_deg=10.0, **shared):
        super().__init__(robot, **shared)
        self.success_deg = success_deg
        self.goal_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = self.observed([-1.0] * 2, [1.0] * 2)

    def sample(self, core, generators):
        return steady_goals(self, core, generators), np.full((len(generators), 1), 0.5)

    def achieved(self, record):
        return np.stack(yaw(record.tip), axis=-1)

    def observe(self, core, achieved, result):
        result[:] = achieved

    def judge(self, achieved, desired, away):
        error = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * away, 1.0)))
        return Outcome(error <= self.success_deg, -error, {"heading_error_deg": error})

    def draw(self, record, colour):
        x, y = 0.03 * record.goal[0]
        return {"goal": geometry.ball(np.array([x, y, 0.1]), 3e-3, colour, 0.9)}


register(Entry("turn", "ToyTurn", Turn, ROBOT, steps=20))
