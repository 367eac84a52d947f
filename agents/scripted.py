"""Controllers that solve the tasks from their observations, with the arm's model and no learning.

They have the interface of a Stable-Baselines3 policy, `predict(observation) -> (action, None)` for one observation or a batch,
so that everything that runs a trained policy runs them too.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import Arm, Equilibrium, grasp, thermal
from tca_envs.mechanics.rotation import yaw_angle
from tca_envs.mechanics.thermal import AMBIENT, SOFT_LIMIT, Heater
from tca_envs.tasks import pick_and_place as layout
from tca_envs.tasks import twist_align
from tca_envs.tasks.core import STEP_S

Array = NDArray[np.float64]

Aim = Callable[[Equilibrium], tuple[Array, Array]]
"""Equilibrium -> what is missing to the goal (k,) [m] and the derivative of what is there in the temperatures (k, n) [m/K]."""

CLOSE_ENOUGH = 5e-5
"""Distance of the planned tip from the goal [m] at which planning ends: a twentieth of what Reach asks, less of the others'."""
METRES_PER_RADIAN = twist_align.SUCCESS_CM / 100.0 / np.radians(twist_align.SUCCESS_DEG)
"""Weight of yaw errors in plans: a tolerance of yaw counts like one of position."""
MOST_YAW = np.radians(60.0)
"""Yaws are counted from here down a full turn: heating the helix turns one way, by at most 250 degrees or so."""

OPEN, WIDE = 150.0, 4.5e-3
"""Temperature of the open gripper [degC], and the gap from which on it counts as open [m]."""
NEAR, NEAR_YAW = 3e-3, np.radians(20.0)
"""Errors of the tool [m], [rad] at which the gripper opens."""
MARGIN, ALONG = 4e-4, 2.5e-3
"""Spare gap of the jaws, and the largest offset of the object along their width [m]."""
GRASP_DEPTH = 1.5e-3
"""The jaws close when they are no higher above the object's centre [m]."""
OVER_TARGET, PLACED = 1.5e-3, 2.8e-3
"""Errors of the object [m] at which it is released, and at which it is left."""
UNTWISTED = np.radians(15.0)
"""Yaw of the tool [rad] that counts as the original one."""
SAME_PLACE = 2e-4
"""An object that moved less [m], turned less [rad], needs no new plan."""
LEAST_TURN = np.radians(5.0)
"""Of the yaws that fit, the first below this one needs the least heat [rad]."""


class Lanes:
    """A controller for each lane of a batch: what one remembers is none of another's business.

    Parameters
    ----------
    controller : callable
        Makes one.
    """

    def __init__(self, controller: "Callable[[], SteadyController | PickAndPlaceController]") -> None:
        self.controller = controller
        self.lanes: list[SteadyController | PickAndPlaceController] = []

    def predict(self, observation: dict[str, NDArray[Any]]) -> tuple[NDArray[np.float32], None]:
        """Return the actions (N, n) for a batch of observations."""
        while len(self.lanes) < len(observation["desired_goal"]):
            self.lanes.append(self.controller())
        rows = [{key: value[i] for key, value in observation.items()} for i in range(len(observation["desired_goal"]))]
        return np.array([lane.predict(row)[0] for lane, row in zip(self.lanes, rows, strict=False)]), None


class SteadyController(ABC):
    """Plan the temperatures that put the tip on the goal, then drive each TCA there.

    The plan is Gauss-Newton on the arm's model with `tip_jacobian`, anew for every new goal. The drive is feed-forward
    and feedback in one: the power that takes the measured temperature to the next one in a step, all TCAs keeping pace.

    Parameters
    ----------
    arm : Arm
        The arm that the task steps.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.heating = Heater().scaled(self.arm.rest_lengths)
        self.goal: Array | None = None
        self.target = np.full(len(self.arm.muscles), AMBIENT)
        self.lanes = Lanes(type(self))

    def predict(
        self,
        observation: dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return the action (n,) for an observation of the task, or actions (N, n) for a batch of N.

        Lane i of a batch remembers what it planned for lane i; the other arguments are SB3's and not read.
        """
        if np.ndim(observation["desired_goal"]) == 2:
            return self.lanes.predict(observation)
        goal = np.asarray(observation["desired_goal"], dtype=np.float64)
        if self.goal is None or not np.array_equal(goal, self.goal):
            self.goal, self.target = goal, self.plan(goal)
        count = len(self.target)
        temperature = AMBIENT + (SOFT_LIMIT - AMBIENT) * np.asarray(observation["observation"][:count], dtype=np.float64)
        return drive(temperature, self.target, self.heating).astype(np.float32), None

    @abstractmethod
    def plan(self, goal: Array) -> Array:
        """Return the temperatures (n,) [degC] whose steady state is the goal, in the units of the task."""


class ReachController(SteadyController):
    """Solves TCAReach."""

    def __init__(self) -> None:
        super().__init__(presets.bending_arm())

    def plan(self, goal: Array) -> Array:
        """Return temperatures (3,) [degC] that bring the tip to `goal` (3,) [cm]."""
        return plan(self.arm, tip_at(goal / 100.0), BENDING_STARTS)


class TwistAlignController(SteadyController):
    """Solves TCATwistAlign."""

    def __init__(self) -> None:
        super().__init__(presets.whole_arm())

    def plan(self, goal: Array) -> Array:
        """Return temperatures (4,) [degC] that bring the tip to `goal` (5,): x, y, z [cm], cosine and sine of the yaw."""
        turn = unwrapped(float(np.arctan2(goal[4], goal[3])))
        return plan(self.arm, tip_and_yaw_at(goal[:3] / 100.0, turn), twisted(self.arm, turn))


class PickAndPlaceController:
    """Solves TCAPickAndPlace: the sequence of the paper's Fig. 6 as a state machine.

    The state is read off the observation at every step, so that a slip or a missed grasp leads back to where it belongs:

    1. `align`: bend and twist until the tool is over the object with its yaw;
    2. `open`: heat the gripper, from when the tool is near;
    3. `lower`: as long as the object fits between the jaws, until they are around its middle;
    4. `close`: let the gripper cool until friction holds the object;
    5. `lift`: the stage up;
    6. `untwist`: the helix cools;
    7. `carry`: bend until the object is over the target;
    8. `release`: heat the gripper until the object falls;
    9. `leave`: open jaws go up, everything cools.

    Plans are Gauss-Newton on the arm's model, anew where the object or the target has moved.
    """

    def __init__(self) -> None:
        self.arm = presets.whole_arm()
        self.carrying = presets.whole_arm(payload=presets.with_object())
        self.heating = Heater().scaled(np.append(self.arm.rest_lengths, presets.gripper().rest_length))
        self.plans: dict[str, tuple[Array, Array]] = {}
        self.lanes = Lanes(type(self))

    def predict(
        self,
        observation: dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return the action (6,) for an observation of TCAPickAndPlace, or actions (N, 6) for a batch of N.

        Lane i of a batch remembers what it planned for lane i; the other arguments are SB3's and not read.
        """
        if np.ndim(observation["desired_goal"]) == 2:
            return self.lanes.predict(observation)
        scene = Sight.of(observation)
        phase = self.phase(scene)
        temperature = scene.temperature
        if phase in ("carry", "release"):
            bent = self._plan("target", scene.target)
        elif phase == "untwist":
            bent = np.append(temperature[:3], AMBIENT)
        elif phase in ("close", "lift") or (phase == "leave" and scene.low):
            bent = temperature[:4]  # the arm stays where it is
        elif phase == "leave":
            bent = np.full(4, AMBIENT)
        else:
            bent = self._plan("object", np.append(scene.object[:2], scene.object_yaw))
        hot = phase in ("open", "lower", "release") or (phase == "align" and scene.near) or (phase == "leave" and scene.low)
        jaws = OPEN if hot else AMBIENT
        down = {"lower": 1.0, "open": 0.0, "close": 0.0, "release": 0.0, "align": -1.0 if scene.low else 0.0}
        speed = down.get(phase, -1.0)
        bending, opening = self.heating.part(slice(4)), self.heating.part(slice(4, 5))
        action = [*drive(temperature[:4], bent, bending), *drive(temperature[4:], np.array([jaws]), opening), speed]
        return np.array(action, dtype=np.float32), None

    def phase(self, scene: "Sight") -> str:
        """Return the name of the phase that an observation belongs to."""
        if scene.held:
            if np.linalg.norm(scene.object[:2] - scene.target) < OVER_TARGET and scene.stage < 0.1:
                return "release"
            if scene.stage >= 0.1:
                return "lift"
            return "carry" if abs(scene.yaw) < UNTWISTED else "untwist"
        if np.linalg.norm(scene.object[:2] - scene.target) < PLACED:
            return "leave"
        if scene.between and scene.tool[2] > scene.object[2] - GRASP_DEPTH:
            return "close"
        if not scene.low and not scene.near:
            return "align"
        if scene.gap < WIDE:
            return "open"
        return "lower" if scene.fits and (scene.between or not scene.low) else "align"

    def _plan(self, name: str, goal: Array) -> Array:
        """Return the temperatures (4,) [degC] that bring the tool to `goal`: x, y [m] and perhaps a yaw [rad] modulo pi."""
        known, temperatures = self.plans.get(name, (None, None))
        if known is None or temperatures is None or np.abs(goal - known).max() > SAME_PLACE:
            arm = self.carrying if name == "target" else self.arm
            turn = LEAST_TURN - (LEAST_TURN - goal[2]) % np.pi if len(goal) == 3 else None
            temperatures = plan(arm, tool_at(goal[:2], turn), twisted(arm, turn))
            self.plans[name] = goal, temperatures
        return temperatures


@dataclass(frozen=True)
class Sight:
    """What a controller sees in an observation of TCAPickAndPlace, in SI units and degC."""

    temperature: Array
    tool: Array
    yaw: float
    stage: float
    """From 0 (up) to 1 (down)."""
    gap: float
    held: bool
    touched: bool
    """Whether the gripper touches or surrounds the object."""
    low: bool
    """Whether the jaws are below the object's top."""
    object: Array
    object_yaw: float
    target: Array

    @property
    def turn(self) -> float:
        """Angle between jaws and object [rad], at most 90 degrees."""
        return abs(float(grasp.half_turn(np.array(self.object_yaw - self.yaw))))

    @property
    def near(self) -> bool:
        """Whether it is time to open the gripper."""
        return float(np.linalg.norm(self.object[:2] - self.tool[:2])) < NEAR and self.turn < NEAR_YAW

    @property
    def between(self) -> bool:
        """Whether the object stands between the jaws."""
        return self.low and self.touched and self._offsets()[1] <= 0.5 * presets.SITE.jaw_width

    @property
    def fits(self) -> bool:
        """Whether the object as it lies to the jaws fits between them."""
        across, along = self._offsets()
        reach = float(grasp.half_extents(np.array(self.turn), presets.OBJECT)[0])
        return 2.0 * (reach + across) + MARGIN < self.gap and along < ALONG

    def _offsets(self) -> tuple[float, float]:
        """Return how far the object is from the tool [m], across the jaws and along their width."""
        (x, y), c, s = self.object[:2] - self.tool[:2], np.cos(self.yaw), np.sin(self.yaw)
        return float(abs(c * x + s * y)), float(abs(c * y - s * x))

    @classmethod
    def of(cls, observation: dict[str, NDArray[Any]]) -> "Sight":
        """Return what `observation` says."""
        seen = np.asarray(observation["observation"], dtype=np.float64)
        place, tool = seen[layout.OBJECT] / 100.0, seen[layout.TOOL] / 100.0
        force = np.array(layout.FULL_FORCE * seen[layout.FORCE])
        held = bool(grasp.holds(force, presets.OBJECT, presets.SITE))
        low = bool(tool[2] > place[2] - 0.5 * presets.OBJECT.height)
        return cls(
            temperature=AMBIENT + (SOFT_LIMIT - AMBIENT) * seen[layout.TEMPERATURES],
            tool=tool,
            yaw=float(np.arctan2(seen[layout.TOOL_SIN], seen[layout.TOOL_COS])),
            stage=float(seen[layout.TRAVEL]),
            gap=float(seen[layout.OPENING]) / 100.0,
            held=held,
            touched=bool(observation["achieved_goal"][3] < 0.5),
            low=low,
            object=place,
            object_yaw=0.5 * float(np.arctan2(seen[layout.OBJECT_SIN2], seen[layout.OBJECT_COS2])),
            target=np.asarray(observation["desired_goal"][:2], dtype=np.float64) / 100.0,
        )


def drive(temperature: Array, target: Array, heating: thermal.Heating) -> Array:
    """Return the action (n,) that takes TCAs from `temperature` towards `target` (n,) [degC], on the straight way from ambient.

    The TCA that needs longest sets the pace, so nothing is lost, and the arm comes to the equilibrium that slow heating
    leads to: with one TCA near 150 degC it has others, buckled to the other side.
    """
    rise = target - AMBIENT
    reachable = thermal.step(temperature, heating.max_power, STEP_S, heating) - AMBIENT
    share = min([1.0, *(reachable[rise > 0.0] / rise[rise > 0.0])])
    power = thermal.power_to_reach(temperature, AMBIENT + share * rise, STEP_S, heating)
    return 2.0 * np.clip(power / heating.max_power, 0.0, 1.0) - 1.0


BENDING_STARTS = np.vstack([np.full(3, 60.0), 60.0 + 60.0 * np.eye(3), 120.0 - 60.0 * np.eye(3)])
"""Where plans begin [degC]: all bending TCAs lukewarm, then each one hot, then each one cooler than the others."""


def tip_at(goal: Array) -> Aim:
    """Return the aim of a tip position (3,) [m]."""
    return lambda here: (goal - here.tip_pose[:3, 3], here.tip_jacobian[:3])


def tip_and_yaw_at(goal: Array, turn: float) -> Aim:
    """Return the aim of a tip position (3,) [m] and a yaw [rad] as of `unwrapped`."""

    def aim(here: Equilibrium) -> tuple[Array, Array]:
        jacobian = here.tip_jacobian
        missing = np.append(goal - here.tip_pose[:3, 3], METRES_PER_RADIAN * (turn - yaw_of(here)))
        return missing, np.vstack([jacobian[:3], METRES_PER_RADIAN * yaw_gradient(here.tip_pose) @ jacobian[3:]])

    return aim


def tool_at(goal: Array, turn: float | None) -> Aim:
    """Return the aim of a horizontal place of the tool (2,) [m] and a yaw [rad]; without one the helix stays as it is."""

    def aim(here: Equilibrium) -> tuple[Array, Array]:
        pose, jacobian = here.tip_pose, here.tip_jacobian
        lever = presets.JAW_DEPTH * pose[:3, 2]
        place = jacobian[:3] + np.cross(jacobian[3:], lever, axis=0)
        missing = goal - (pose[:3, 3] + lever)[:2]
        if turn is None:
            place[:, -1] = 0.0
            return missing, place[:2]
        yaws = METRES_PER_RADIAN * yaw_gradient(pose) @ jacobian[3:]
        return np.append(missing, METRES_PER_RADIAN * (turn - yaw_of(here))), np.vstack([place[:2], yaws])

    return aim


def unwrapped(angle: float) -> float:
    """Return an angle [rad] as a yaw in (MOST_YAW - 2 pi, MOST_YAW]."""
    return MOST_YAW - (MOST_YAW - angle) % (2.0 * np.pi)


def yaw_of(here: Equilibrium) -> float:
    """Return the yaw of the tip [rad], unwrapped."""
    return unwrapped(float(yaw_angle(here.tip_pose)))


def yaw_gradient(pose: Array) -> Array:
    """Return d yaw/d(rotation vector added in the base frame) (3,) of a pose (4, 4)."""
    r = pose[:3, :3]
    cosine, sine = r[0, 0] + r[1, 1], r[1, 0] - r[0, 1]
    # d r_ij = (w x r_j)_i
    d_cosine = np.array([-r[2, 1], r[2, 0], r[0, 1] - r[1, 0]])
    d_sine = np.array([-r[2, 0], -r[2, 1], r[0, 0] + r[1, 1]])
    return (cosine * d_sine - sine * d_cosine) / (cosine**2 + sine**2)


def helix_temperature(arm: Arm, turn: float) -> float:
    """Return the temperature [degC] of the helical TCA at which the straight hanging arm has turned by about `turn` [rad]."""
    here, temperatures, turns = None, np.linspace(AMBIENT, SOFT_LIMIT, 12), []
    for temperature in temperatures:
        here = arm.equilibrium([AMBIENT, AMBIENT, AMBIENT, temperature], start=here)
        turns.append(yaw_of(here))
    return float(np.interp(-turn, -np.array(turns), temperatures))


def twisted(arm: Arm, turn: float | None) -> Array:
    """Return where plans of the whole arm begin (s, 4) [degC]: `BENDING_STARTS`, the helix cold or turned by `turn` [rad]."""
    helix = AMBIENT if turn is None else helix_temperature(arm, turn)
    return np.column_stack([BENDING_STARTS, np.full(len(BENDING_STARTS), helix)])


def plan(arm: Arm, aim: Aim, starts: Array) -> Array:
    """Return temperatures (n,) [degC] between ambient and the soft limit whose steady state misses `aim` least.

    Gauss-Newton from each of `starts` (s, n) until one comes close: in a straight arm the Jacobian hides what heating
    does sideways, and a start near the answer's branch finds that branch.
    """
    best, best_distance = np.full(len(arm.muscles), AMBIENT), np.inf
    for start in starts:
        temperature, distance = _gauss_newton(arm, aim, start)
        if distance < best_distance:
            best, best_distance = temperature, distance
        if best_distance < CLOSE_ENOUGH:
            break
    return best


def _gauss_newton(arm: Arm, aim: Aim, start: Array) -> tuple[Array, float]:
    """Return the best temperatures found from `start` and by how much they miss the aim [m]."""
    temperature, damping = start, 1e-3
    here = steady(arm, temperature)
    error, jacobian = aim(here)
    for _ in range(30):
        if np.linalg.norm(error) < 0.1 * CLOSE_ENOUGH:
            break
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
        new_error, new_jacobian = aim(there)
        if there.converged and np.linalg.norm(new_error) < np.linalg.norm(error):
            temperature, here, error, jacobian, damping = trial, there, new_error, new_jacobian, max(0.2 * damping, 1e-9)
        elif damping > 1e3:
            break
        else:
            damping *= 5.0
    # Newton's way may have led to an equilibrium that heating does not lead to.
    return temperature, float(np.linalg.norm(aim(steady(arm, temperature))[0]))


def steady(arm: Arm, temperature: Array) -> Equilibrium:
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
        """Return an action (size,) or, for a batch of N observations, actions (N, size); nothing else is read."""
        batch = np.shape(observation["desired_goal"])[:-1]
        return self.rng.uniform(-1.0, 1.0, (*batch, self.size)).astype(np.float32), None


CONTROLLERS: dict[str, Callable[[], SteadyController | PickAndPlaceController]] = {
    "reach": ReachController,
    "twist-align": TwistAlignController,
    "pick-and-place": PickAndPlaceController,
}
"""Scripted controller of each task."""
