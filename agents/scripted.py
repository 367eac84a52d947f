"""Controllers that solve the tasks from their observations, with the arm's model and no learning.

They have the interface of a Stable-Baselines3 policy, `predict(observation) -> (action, None)`, so that everything that
runs a trained policy runs them too.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import Arm, Equilibrium, thermal
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT, Heater
from tca_envs.tasks.core import STEP_S

Array = NDArray[np.float64]

CLOSE_ENOUGH = 5e-5
"""Distance of the planned tip from the goal [m] at which planning ends: a twentieth of what the task asks."""


class ReachController:
    """Plan the temperatures that put the tip on the goal, then drive each TCA there.

    The plan is Gauss-Newton on the arm's model with `tip_jacobian`, anew for every new goal. The drive is feed-forward
    and feedback in one: the power that takes the measured temperature to the next one in a step, all TCAs keeping pace.
    """

    def __init__(self) -> None:
        self.arm = presets.bending_arm()
        self.heating = Heater().scaled(self.arm.rest_lengths)
        self.goal: Array | None = None
        self.target = np.full(len(self.arm.muscles), AMBIENT)

    def predict(
        self,
        observation: dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return the action (3,) for an observation of TCAReach; the other arguments are SB3's and not read."""
        goal = np.asarray(observation["desired_goal"], dtype=np.float64)
        if self.goal is None or not np.array_equal(goal, self.goal):
            self.goal, self.target = goal, plan(self.arm, goal / 100.0)
        temperature = AMBIENT + (SOFT_LIMIT - AMBIENT) * np.asarray(observation["observation"][:3], dtype=np.float64)
        waypoint = self._waypoint(temperature)
        power = thermal.power_to_reach(temperature, waypoint, STEP_S, self.heating)
        action = 2.0 * np.clip(power / self.heating.max_power, 0.0, 1.0) - 1.0
        return action.astype(np.float32), None

    def _waypoint(self, temperature: Array) -> Array:
        """Return the temperatures to aim at next, on the straight way from ambient to the target.

        The TCA that needs longest sets the pace, so nothing is lost, and the arm comes to the equilibrium that slow heating
        leads to: with one TCA near 150 degC it has others, buckled to the other side.
        """
        rise = self.target - AMBIENT
        reachable = thermal.step(temperature, self.heating.max_power, STEP_S, self.heating) - AMBIENT
        share = min([1.0, *(reachable[rise > 0.0] / rise[rise > 0.0])])
        return AMBIENT + share * rise


def plan(arm: Arm, goal: Array) -> Array:
    """Return temperatures (n,) [degC] between ambient and the soft limit whose steady tip is nearest to `goal` (3,) [m].

    Gauss-Newton, first from all TCAs lukewarm, then from each one hot: in a straight arm the Jacobian hides what heating
    does sideways, and a start near the answer's branch finds that branch.
    """
    best, best_distance = np.full(len(arm.muscles), AMBIENT), np.inf
    starts = np.vstack([np.full(3, 60.0), 60.0 + 60.0 * np.eye(3), 120.0 - 60.0 * np.eye(3)])
    for start in starts:
        temperature, distance = _gauss_newton(arm, goal, start)
        if distance < best_distance:
            best, best_distance = temperature, distance
        if best_distance < CLOSE_ENOUGH:
            break
    return best


def _gauss_newton(arm: Arm, goal: Array, start: Array) -> tuple[Array, float]:
    """Return the best temperatures found from `start` and their tip's distance to the goal [m]."""
    temperature, damping = start, 1e-3
    here = _steady(arm, temperature)
    error = goal - here.tip_pose[:3, 3]
    for _ in range(30):
        if np.linalg.norm(error) < 0.1 * CLOSE_ENOUGH:
            break
        jacobian = here.tip_jacobian[:3]
        normal = jacobian.T @ jacobian
        # TCAs at a limit that the step would push beyond it take no part in it.
        gradient = jacobian.T @ error
        free = ~(((temperature <= AMBIENT) & (gradient < 0.0)) | ((temperature >= SOFT_LIMIT) & (gradient > 0.0)))
        if not free.any():
            break
        step = np.zeros_like(temperature)
        scaled = normal[np.ix_(free, free)] + damping * np.trace(normal) / len(normal) * np.eye(int(free.sum()))
        step[free] = np.clip(np.linalg.solve(scaled, gradient[free]), -40.0, 40.0)
        trial = np.clip(temperature + step, AMBIENT, SOFT_LIMIT)
        there = arm.equilibrium(trial, start=here)
        new_error = goal - there.tip_pose[:3, 3]
        if there.converged and np.linalg.norm(new_error) < np.linalg.norm(error):
            temperature, here, error, damping = trial, there, new_error, max(0.2 * damping, 1e-9)
        elif damping > 1e3:
            break
        else:
            damping *= 5.0
    # Newton's way may have led to an equilibrium that heating does not lead to.
    return temperature, float(np.linalg.norm(goal - _steady(arm, temperature).tip_pose[:3, 3]))


def _steady(arm: Arm, temperature: Array) -> Equilibrium:
    """Return the equilibrium that slow heating from ambient to `temperature` reaches."""
    here = arm.equilibrium(np.full(len(temperature), AMBIENT))
    for part in np.linspace(0.1, 1.0, 10):
        here = arm.equilibrium(AMBIENT + part * (temperature - AMBIENT), start=here)
    return here


class RandomPolicy:
    """Actions drawn uniformly: the floor that every policy is compared with.

    Parameters
    ----------
    size : int
        Numbers in an action.
    seed : int
        Of its own random generator.
    """

    def __init__(self, size: int, seed: int = 0) -> None:
        self.size = size
        self.rng = np.random.default_rng(seed)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Return an action (size,); no argument is read."""
        return self.rng.uniform(-1.0, 1.0, self.size).astype(np.float32), None


CONTROLLERS = {"reach": ReachController}
"""Scripted controller of each task."""
