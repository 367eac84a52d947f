"""The least time in which the heaters bring the arm to a goal: what times to success are measured against.

A TCA follows the closed form of `thermal.step`: full power gives the hottest that it can be after a time, no power the
coolest, other powers everything between. So the least time to a goal is a small optimisation: the shortest t for which
temperatures within these limits put the arm's equilibrium within the goal's tolerances, on the arm's model with
`tip_jacobian`, by SciPy's SLSQP from the scripted controller's plan. It is exact up to local minima. A controller that aims at
the middle of a goal takes longer than one that comes in at its edge.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from agents.scripted import (
    BENDING_STARTS,
    LEAST_TURN,
    METRES_PER_RADIAN,
    Aim,
    Array,
    Sight,
    plan,
    steady,
    tip_and_yaw_at,
    tip_at,
    tool_at,
    twisted,
    unwrapped,
)
from tca_envs import presets
from tca_envs.mechanics import Arm, thermal
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT, Heater
from tca_envs.tasks import pick_and_place, reach, twist_align
from tca_envs.tasks.core import CUT_OFF, STEP_S

Observation = dict[str, NDArray[Any]]
Tolerances = list[tuple[slice, float]]
"""Parts of what an aim says is missing, and how long each of them may be [m]."""

UNIT_K = SOFT_LIMIT - AMBIENT
"""Unit of temperatures in the optimisation."""
PRECISION_S = 1e-5
"""To which it is solved."""
SHARES = (1.0, 0.9, 0.7)
"""Where on the way to a goal's temperatures it begins."""
LONGEST_S = 20.0
"""Eleven time constants: what takes longer is not looked at."""


def fastest(task: str, observation: Observation) -> float:
    """Return the least time [s] in which the heaters can succeed from the first `observation` of an episode.

    It is the end of the first step of the environment at which success is possible.

    Raises
    ------
    ValueError
        If there is no such task.
    RuntimeError
        If the optimisation fails.
    """
    if task not in TIMES:
        raise ValueError(f"task = {task!r}: expected one of {', '.join(map(repr, TIMES))}")
    return float(np.ceil(TIMES[task](observation) / STEP_S - PRECISION_S) * STEP_S)


def reach_time(observation: Observation) -> float:
    """Return the least time [s] to a goal of TCAReach."""
    arm, aim = presets.bending_arm(), tip_at(np.asarray(observation["desired_goal"], dtype=np.float64) / 100.0)
    return least_time(arm, aim, [(slice(3), reach.SUCCESS_CM / 100.0)], plan(arm, aim, BENDING_STARTS))


def twist_align_time(observation: Observation) -> float:
    """Return the least time [s] to a goal of TCATwistAlign."""
    arm, goal = presets.whole_arm(), np.asarray(observation["desired_goal"], dtype=np.float64)
    turn = unwrapped(float(np.arctan2(goal[4], goal[3])))
    aim = tip_and_yaw_at(goal[:3] / 100.0, turn)
    yaw = METRES_PER_RADIAN * np.radians(twist_align.SUCCESS_DEG)
    tolerances = [(slice(3), twist_align.SUCCESS_CM / 100.0), (slice(3, 4), float(yaw))]
    return least_time(arm, aim, tolerances, plan(arm, aim, twisted(arm, turn)))


def pick_and_place_time(observation: Observation) -> float:
    """Return the least time [s] of TCAPickAndPlace for a gripper that takes the object in its middle, in line with it.

    One after the other:

    1. All TCAs of the arm come to where the tool is over the object, turned in line; the gripper meanwhile gets hot enough
       for the object to fit.
    2. The gripper cools until friction holds the object.
    3. The arm, loaded, comes to where the object is within its tolerance of the target.

    The stage and the release are left out: lowering takes less than 1. if it begins in time, but not lifting, and the jaws
    have to open wider where the object is not in line as they come down.
    """
    scene = Sight.of(observation)
    arm, loaded = presets.whole_arm(), presets.whole_arm(payload=presets.with_object())
    turn = LEAST_TURN - (LEAST_TURN - scene.object_yaw) % np.pi
    there = plan(arm, tool_at(scene.object[:2], turn), twisted(arm, turn))
    heating = Heater().scaled(arm.rest_lengths)
    opening, closing = grip_times()
    above = max(opening, float(thermal.time_to_reach(AMBIENT, there, heating).max()))
    target = tool_at(scene.target, None)
    placed = plan(loaded, target, twisted(loaded, None))
    return above + closing + least_time(loaded, target, [(slice(2), pick_and_place.SUCCESS_CM / 100.0)], placed, there)


def grip_times() -> tuple[float, float]:
    """Return how long the gripper heats from ambient until the object fits, and then cools until friction holds it [s]."""
    jaws, box = presets.gripper(), presets.OBJECT
    heating = Heater().scaled([jaws.rest_length])
    fits = np.interp(box.width, jaws.gap(pick_and_place.PINCH_AT), pick_and_place.PINCH_AT)
    needed = 0.5 * box.mass * presets.SITE.gravity / box.friction
    holds = np.interp(-needed, -pick_and_place.pinch_table(), pick_and_place.PINCH_AT)
    return float(thermal.time_to_reach(AMBIENT, fits, heating)[0]), float(thermal.time_to_reach(fits, holds, heating)[0])


TIMES: dict[str, Callable[[Observation], float]] = {
    "reach": reach_time,
    "twist-align": twist_align_time,
    "pick-and-place": pick_and_place_time,
}
"""Least time of each task [s] from the first observation of an episode."""


def least_time(arm: Arm, aim: Aim, tolerances: Tolerances, goal: Array, start: Array | float = AMBIENT) -> float:
    """Return the least time [s] in which the heaters bring an arm within the tolerances of an aim.

    Parameters
    ----------
    arm : Arm
        With n TCAs.
    aim : Aim
        What is missing (k,) [m], see `agents.scripted.Aim`.
    tolerances : list of (slice, float)
        Parts of what is missing and how long each of them may be [m].
    goal : (n,) array
        Temperatures of a state within them [degC]: the optimisation begins near it.
    start : (n,) array or float
        Temperatures at first [degC].

    Raises
    ------
    RuntimeError
        If the optimisation fails.
    """
    heating = Heater().scaled(arm.rest_lengths)
    count, full, none = len(goal), heating.max_power, np.zeros(len(goal))
    here = steady(arm, goal)

    def missing(x: Array) -> tuple[Array, Array]:
        nonlocal here
        temperature = AMBIENT + UNIT_K * x[1:]
        if not np.array_equal(temperature, here.drive):
            here = arm.equilibrium(temperature, start=here)
        return aim(here)

    def room(x: Array) -> Array:
        """Distances from the limits, not negative where they are kept to: of hot and cold, of the tolerances."""
        error, _ = missing(x)
        hottest, coolest = (thermal.step(start, power, x[0], heating) for power in (full, none))
        within = [1.0 - error[part] @ error[part] / radius**2 for part, radius in tolerances]
        return np.concatenate([(hottest - AMBIENT) / UNIT_K - x[1:], x[1:] - (coolest - AMBIENT) / UNIT_K, within])

    def slopes(x: Array) -> Array:
        error, jacobian = missing(x)
        kept = np.exp(-x[0] * heating.loss / heating.capacity) / heating.capacity / UNIT_K
        warming, cooling = ((power - heating.loss * (start - AMBIENT)) * kept for power in (full, none))
        within = [np.append(0.0, 2.0 * UNIT_K / radius**2 * error[part] @ jacobian[part]) for part, radius in tolerances]
        sides = [np.column_stack([warming, -np.eye(count)]), np.column_stack([-cooling, np.eye(count)])]
        return np.vstack([*sides, *within])

    times = []
    for share in SHARES:  # SLSQP's line search sticks in one goal of a few hundred, but not from everywhere
        first = start + share * (goal - start)
        duration = min(LONGEST_S, float(thermal.time_to_reach(start, first, heating).max()))
        found = minimize(
            lambda x: (x[0], np.eye(count + 1)[0]),
            np.append(duration, (first - AMBIENT) / UNIT_K),
            jac=True,
            bounds=[(0.0, LONGEST_S)] + [(0.0, (CUT_OFF - AMBIENT) / UNIT_K)] * count,
            constraints={"type": "ineq", "fun": room, "jac": slopes},
            method="SLSQP",
            options={"ftol": PRECISION_S, "maxiter": 100},
        )
        if found.success and room(found.x).min() > -1e-3:
            times.append(float(found.x[0]))
    if not times:
        raise RuntimeError(f"no least time to {goal} degC: {found.message}")
    return min(times)
