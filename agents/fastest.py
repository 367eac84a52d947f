"""The least time in which the heaters can bring the arm to a goal: the reference for times to success.

A TCA follows the closed form of `thermal.step`. After a time t it is hottest under full power and coolest without power; other
powers reach every temperature between. The least time to a goal is the shortest t for which temperatures in this range put the
arm's equilibrium within the goal's tolerances. SciPy's SLSQP finds it on the arm's model with `tip_jacobian`, starting at the
scripted controller's plan. It is exact up to local minima. A controller that aims at the middle of a goal takes longer than
one that stops at its edge.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from agents.scripted import (
    METRES_PER_RADIAN,
    Aim,
    Array,
    Sight,
    carrying,
    least_turn,
    plan,
    starts,
    steady,
    tip_and_yaw_at,
    tip_at,
    tool_at,
    unwrapped,
)
from tca_envs import registry
from tca_envs.mechanics import thermal
from tca_envs.robots import Robot
from tca_envs.tasks.pick_and_place import PickAndPlace, pinch_table
from tca_envs.tasks.reach import Reach
from tca_envs.tasks.twist_align import TwistAlign

Observation = dict[str, NDArray[Any]]
Tolerances = list[tuple[slice, float]]
"""Parts of the error of an aim, and the largest norm of each [m]."""

PRECISION_S = 1e-5
"""Precision of the optimisation."""
SHARES = (1.0, 0.9, 0.7)
"""Shares of the rise to a goal's temperatures at which the optimisation starts."""
LONGEST_S = 20.0
"""Upper bound of the time: eleven time constants."""


def fastest(task: str, observation: Observation) -> float:
    """Return the least time [s] in which the heaters can succeed from the first `observation` of an episode.

    It is the end of the first step of the environment at which success is possible; nan where the task's entry in
    `tca_envs.registry` names no function for it.

    Raises
    ------
    ValueError
        If there is no such task.
    RuntimeError
        If the optimisation fails.
    """
    entry = registry.entry(task)
    time = registry.load(entry.fastest)
    if time is None:
        return float("nan")
    step_s = entry.new().step_s
    return float(np.ceil(time(observation) / step_s - PRECISION_S) * step_s)


def reach_time(observation: Observation, task: Reach | None = None) -> float:
    """Return the least time [s] to a goal of `task`, by default the registered one."""
    task = task or registry.entry("reach").new()
    aim = tip_at(np.asarray(observation["desired_goal"], dtype=np.float64) / 100.0)
    robot = task.robot
    return least_time(robot, aim, [(slice(3), task.success_cm / 100.0)], plan(robot, aim, starts(robot)))


def twist_align_time(observation: Observation, task: TwistAlign | None = None) -> float:
    """Return the least time [s] to a goal of `task`, by default the registered one."""
    task = task or registry.entry("twist-align").new()
    robot, goal = task.robot, np.asarray(observation["desired_goal"], dtype=np.float64)
    turn = unwrapped(float(np.arctan2(goal[4], goal[3])))
    aim = tip_and_yaw_at(goal[:3] / 100.0, turn)
    yaw = METRES_PER_RADIAN * np.radians(task.success_deg)
    tolerances = [(slice(3), task.success_cm / 100.0), (slice(3, 4), float(yaw))]
    return least_time(robot, aim, tolerances, plan(robot, aim, starts(robot, turn)))


def pick_and_place_time(observation: Observation, task: PickAndPlace | None = None) -> float:
    """Return the least time [s] of `task`, by default the registered one, for a grasp in the object's middle, in line with it.

    It is the sum of three times:

    1. The arm brings the tool over the object and turns it in line, while the gripper opens until the object fits.
    2. The gripper cools until friction holds the object.
    3. The loaded arm brings the object within the tolerance of the target.

    The stage and the release are left out. Lowering can be done during 1, lifting cannot; the jaws have to open wider where
    the object is not in line as they come down.
    """
    task = task or registry.entry("pick-and-place").new()
    scene, robot, loaded = Sight.of(observation, task), task.robot, carrying(task.robot)
    turn = least_turn(scene.object_yaw)
    there = plan(robot, tool_at(robot, scene.object[:2], turn), starts(robot, turn))
    opening, closing = grip_times(task)
    arm = robot.heating().part(slice(there.size))
    above = max(opening, float(thermal.time_to_reach(robot.limits.ambient, there, arm).max()))
    target = tool_at(loaded, scene.target, None)
    placed = plan(loaded, target, starts(loaded))
    return above + closing + least_time(loaded, target, [(slice(2), task.success_cm / 100.0)], placed, there)


def grip_times(task: PickAndPlace) -> tuple[float, float]:
    """Return how long the gripper heats from ambient until the object fits, and cools until friction holds it [s]."""
    jaws, box, ambient = task.gripper.ring, task.box, task.robot.limits.ambient
    heating = task.robot.heating().part(slice(-1, None))
    at, pinch = pinch_table(jaws, box.width, task.robot.limits)
    fits = np.interp(box.width, jaws.gap(at), at)
    needed = 0.5 * box.mass * task.site.gravity / box.friction
    holds = np.interp(-needed, -pinch, at)
    return float(thermal.time_to_reach(ambient, fits, heating)[0]), float(thermal.time_to_reach(fits, holds, heating)[0])


def least_time(robot: Robot, aim: Aim, tolerances: Tolerances, goal: Array, start: Array | None = None) -> float:
    """Return the least time [s] in which the heaters can bring a robot's arm within the tolerances of an aim.

    Parameters
    ----------
    robot : Robot
        Its arm has n TCAs.
    aim : Aim
        Error (k,) [m] and its Jacobian, see `agents.scripted.Aim`.
    tolerances : list of (slice, float)
        Parts of the error and the largest norm of each [m].
    goal : (n,) array
        Temperatures of a state within the tolerances [degC]: the optimisation starts near it.
    start : (n,) array, optional
        Initial temperatures [degC]; ambient by default.

    Raises
    ------
    RuntimeError
        If the optimisation fails.
    """
    count, ambient, arm = len(goal), robot.limits.ambient, robot.built()
    unit_K = robot.limits.soft - ambient  # of temperatures in the optimisation
    heating = robot.heating().part(slice(count))
    full, none = heating.max_power, np.zeros(count)
    begin = np.full(count, ambient) if start is None else start
    here = steady(robot, goal)

    def missing(x: Array) -> tuple[Array, Array]:
        nonlocal here
        temperature = ambient + unit_K * x[1:]
        if not np.array_equal(temperature, here.drive):
            here = arm.equilibrium(temperature, start=here)
        return aim(here)

    def room(x: Array) -> Array:
        """Return the constraints, not negative where kept: hottest, coolest, tolerances."""
        error, _ = missing(x)
        hottest, coolest = (thermal.step(begin, power, x[0], heating) for power in (full, none))
        within = [1.0 - error[part] @ error[part] / radius**2 for part, radius in tolerances]
        return np.concatenate([(hottest - ambient) / unit_K - x[1:], x[1:] - (coolest - ambient) / unit_K, within])

    def slopes(x: Array) -> Array:
        """Return the derivatives of `room`."""
        error, jacobian = missing(x)
        kept = np.exp(-x[0] * heating.loss / heating.capacity) / heating.capacity / unit_K
        warming, cooling = ((power - heating.loss * (begin - ambient)) * kept for power in (full, none))
        within = [np.append(0.0, 2.0 * unit_K / radius**2 * error[part] @ jacobian[part]) for part, radius in tolerances]
        sides = [np.column_stack([warming, -np.eye(count)]), np.column_stack([-cooling, np.eye(count)])]
        return np.vstack([*sides, *within])

    times = []
    for share in SHARES:  # from one start SLSQP's line search fails in one goal of a few hundred
        first = begin + share * (goal - begin)
        duration = min(LONGEST_S, float(thermal.time_to_reach(begin, first, heating).max()))
        found = minimize(
            lambda x: (x[0], np.eye(count + 1)[0]),
            np.append(duration, (first - ambient) / unit_K),
            jac=True,
            bounds=[(0.0, LONGEST_S)] + [(0.0, (robot.limits.cut_off - ambient) / unit_K)] * count,
            constraints={"type": "ineq", "fun": room, "jac": slopes},
            method="SLSQP",
            options={"ftol": PRECISION_S, "maxiter": 100},
        )
        if found.success and room(found.x).min() > -1e-3:
            times.append(float(found.x[0]))
    if not times:
        raise RuntimeError(f"no least time to {goal} degC: {found.message}")
    return min(times)
