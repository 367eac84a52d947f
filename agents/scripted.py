"""Controllers that solve the tasks from their observations, with the arm's model and without learning.

They have the interface of a Stable-Baselines3 policy, `predict(observation) -> (action, None)` for one observation or a batch.
A plan is a set of temperatures, found by Gauss-Newton on the arm's model with `tip_jacobian`. The drive combines feed-forward
and feedback: the power that takes the measured temperature to the next one in a step, all TCAs in pace.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tca_envs import registry
from tca_envs.mechanics import Arm, Equilibrium, grasp, thermal
from tca_envs.robots import Robot
from tca_envs.rotation import yaw_angle
from tca_envs.tasks import pick_and_place as layout
from tca_envs.tasks import twist_align
from tca_envs.tasks.pick_and_place import PickAndPlace

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Observation = dict[str, NDArray[Any]]

Aim = Callable[[Equilibrium], tuple[Array, Array]]
"""Equilibrium -> error: goal minus position (k,) [m], and the position's Jacobian in the temperatures (k, n) [m/K]."""

CLOSE_ENOUGH = 5e-5
"""Error of the planned tip [m] at which planning ends: a twentieth of Reach's success radius."""
METRES_PER_RADIAN = twist_align.SUCCESS_MM / 10.0 / 100.0 / np.radians(twist_align.SUCCESS_DEG)
"""Weight of yaw errors in plans: TwistAlign's tolerance of yaw counts like that of position."""
MOST_YAW = np.radians(60.0)
"""Yaws are counted from here down a full turn: heating the helix turns the arm one way, by at most about 250 degrees."""

WIDE = 4.5e-3
"""Gap of the jaws [m] from which on the gripper counts as open."""
NEAR, NEAR_YAW = 3e-3, np.radians(20.0)
"""Errors of the tool [m], [rad] at which the gripper opens."""
MARGIN, ALONG = 4e-4, 2.5e-3
"""Clearance of the object between the jaws, and its largest offset along their width [m]."""
GRASP_DEPTH = 1.5e-3
"""Height above the object's centre [m] below which the jaws close."""
OVER_TARGET, PLACED = 1.5e-3, 2.8e-3
"""Errors of the object [m] below which it is released, and below which it counts as placed."""
UNTWISTED = np.radians(15.0)
"""Yaw of the tool [rad] below which it counts as untwisted."""
SAME_PLACE = 2e-4
"""Change of place [m] and yaw [rad] of the object up to which a plan stays valid."""
LEAST_TURN = np.radians(5.0)
"""Of the yaws that fit the object, the first below this one needs the least heat [rad]."""
LUKEWARM, HOT = 60.0, 120.0
"""Temperatures of bending TCAs from which plans begin [degC]."""


class Controller(ABC):
    """What the controllers share: the interface of a policy, and a plan for the arm's steady state that is driven to.

    Parameters
    ----------
    task : Task, optional
        The task, with any robot; by default the registered one.
    """

    name: ClassVar[str]
    """Of the registered task."""

    def __init__(self, task: Any = None) -> None:
        self.task = registry.entry(self.name).new() if task is None else task
        self.robot: Robot = self.task.robot
        self.heating = self.robot.heating()
        self.goal: Array | None = None
        self.target = np.full(self.robot.heated, self.robot.limits.ambient)
        self.lanes: list[Controller] = []

    def predict(
        self, observation: Observation, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Return the action (a,) for an observation of the task, or actions (N, a) for a batch of N.

        Each lane of a batch has a controller of its own, which remembers its plans; the other arguments are SB3's and not read.
        """
        if np.ndim(observation["desired_goal"]) == 1:
            return self.act(observation).astype(np.float32), None
        rows = [{key: value[i] for key, value in observation.items()} for i in range(len(observation["desired_goal"]))]
        self.lanes += [type(self)(self.task) for _ in rows[len(self.lanes) :]]
        return np.array([lane.act(row) for lane, row in zip(self.lanes, rows, strict=False)], dtype=np.float32), None

    @abstractmethod
    def act(self, observation: Observation) -> Array:
        """Return the action (a,) for an observation."""

    def hold(self, observation: Observation, plan: Callable[[Array], Array]) -> Array:
        """Return the action that heats towards the goal and holds it; `plan` gives the arm's temperatures for a new goal."""
        goal = np.asarray(observation["desired_goal"], dtype=np.float64)
        if self.goal is None or not np.array_equal(goal, self.goal):
            self.goal, planned = goal, plan(goal)
            self.target = np.append(planned, self.target[planned.size :])
        return drive(measured(self.robot, observation), self.target, self.heating, self.task.step_s)


class ReachController(Controller):
    """Solves TCAReach: the steady state of a plan puts the tip on the goal."""

    name = "reach"

    def act(self, observation: Observation) -> Array:
        """Return the action (n,) for an observation."""
        return self.hold(observation, self.plan)

    def plan(self, goal: Array) -> Array:
        """Return temperatures (n,) [degC] that bring the tip to `goal` (3,) [cm]."""
        return plan(self.robot, tip_at(goal / 100.0), starts(self.robot))


class TwistAlignController(Controller):
    """Solves TCATwistAlign: the steady state of a plan puts the tip on the goal and turns it."""

    name = "twist-align"

    def act(self, observation: Observation) -> Array:
        """Return the action (n,) for an observation."""
        return self.hold(observation, self.plan)

    def plan(self, goal: Array) -> Array:
        """Return temperatures (n,) [degC] that bring the tip to `goal` (5,): x, y, z [cm], cosine and sine of the yaw."""
        turn = unwrapped(float(np.arctan2(goal[4], goal[3])))
        return plan(self.robot, tip_and_yaw_at(goal[:3] / 100.0, turn), starts(self.robot, turn))


class PickAndPlaceController(Controller):
    """Solves TCAPickAndPlace: the sequence of the paper's Fig. 6 as a state machine.

    The state is read from the observation at every step, so that the controller recovers from a slip or a missed grasp:

    1. `align`: bend and twist until the tool is over the object with its yaw;
    2. `open`: heat the gripper as soon as the tool is near;
    3. `lower`: while the object fits between the jaws, until they are around its middle;
    4. `close`: let the gripper cool until friction holds the object;
    5. `lift`: the stage up;
    6. `untwist`: the helix cools;
    7. `carry`: bend until the object is over the target;
    8. `release`: heat the gripper until the object falls;
    9. `leave`: raise the open jaws, let everything cool.

    A plan is made again whenever the object or the target has moved.
    """

    name = "pick-and-place"

    def __init__(self, task: PickAndPlace | None = None) -> None:
        super().__init__(task)
        self.plans: dict[str, tuple[Array, Array]] = {}

    def act(self, observation: Observation) -> Array:
        """Return the action (m + 1,) for an observation."""
        scene = Sight.of(observation, self.task)
        phase = self.phase(scene)
        temperature, limits = scene.temperature, self.robot.limits
        arm = slice(temperature.size - 1)
        if phase in ("carry", "release"):
            bent = self._plan("target", scene.target)
        elif phase == "untwist":
            bent = np.where(helical(self.robot.arm), limits.ambient, temperature[arm])
        elif phase in ("close", "lift") or (phase == "leave" and scene.low):
            bent = temperature[arm]  # the arm stays where it is
        elif phase == "leave":
            bent = np.full(temperature.size - 1, limits.ambient)
        else:
            bent = self._plan("object", np.append(scene.object[:2], scene.object_yaw))
        hot = phase in ("open", "lower", "release") or (phase == "align" and scene.near) or (phase == "leave" and scene.low)
        jaws = np.array([limits.soft if hot else limits.ambient])
        down = {"lower": 1.0, "open": 0.0, "close": 0.0, "release": 0.0, "align": -1.0 if scene.low else 0.0}
        speed = down.get(phase, -1.0)
        gripper = slice(temperature.size - 1, temperature.size)
        powers = [
            drive(temperature[part], target, self.heating.part(part), self.task.step_s)
            for part, target in ((arm, bent), (gripper, jaws))
        ]
        return np.concatenate([*powers, [speed]])

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
        """Return the temperatures (n,) [degC] that bring the tool to `goal`: x, y [m] and perhaps a yaw [rad] modulo pi."""
        known, temperatures = self.plans.get(name, (None, None))
        if known is None or temperatures is None or np.abs(goal - known).max() > SAME_PLACE:
            robot = carrying(self.robot) if name == "target" else self.robot
            turn = least_turn(goal[2]) if len(goal) == 3 else None
            temperatures = plan(robot, tool_at(robot, goal[:2], turn), starts(robot, turn))
            self.plans[name] = goal, temperatures
        return temperatures


@dataclass(frozen=True)
class Sight:
    """The contents of an observation of TCAPickAndPlace in SI units and degC."""

    task: PickAndPlace
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
        return self.low and self.touched and self._offsets()[1] <= 0.5 * self.task.site.jaw_width

    @property
    def fits(self) -> bool:
        """Whether the object as it lies to the jaws fits between them."""
        across, along = self._offsets()
        reach = float(grasp.half_extents(np.array(self.turn), self.task.box)[0])
        return 2.0 * (reach + across) + MARGIN < self.gap and along < ALONG

    def _offsets(self) -> tuple[float, float]:
        """Return how far the object is from the tool [m], across the jaws and along their width."""
        (x, y), c, s = self.object[:2] - self.tool[:2], np.cos(self.yaw), np.sin(self.yaw)
        return float(abs(c * x + s * y)), float(abs(c * y - s * x))

    @classmethod
    def of(cls, observation: Observation, task: PickAndPlace) -> "Sight":
        """Return the contents of an observation of `task`."""
        seen = np.asarray(observation["observation"], dtype=np.float64)
        place, tool = seen[layout.OBJECT] / 100.0, seen[layout.TOOL] / 100.0
        force = np.array(layout.FULL_FORCE * seen[layout.FORCE])
        held = bool(grasp.holds(force, task.box, task.site))
        low = bool(tool[2] > place[2] - 0.5 * task.box.height)
        return cls(
            task=task,
            temperature=measured(task.robot, observation),
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


def measured(robot: Robot, observation: Observation) -> Array:
    """Return the temperatures (m,) [degC] of the heated TCAs in an observation."""
    limits, scaled = robot.limits, np.asarray(observation["observation"][: robot.heated], dtype=np.float64)
    return limits.ambient + (limits.soft - limits.ambient) * scaled


def drive(temperature: Array, target: Array, heating: thermal.Heating, step_s: float) -> Array:
    """Return the action (n,) that takes TCAs from `temperature` towards `target` (n,) [degC], all in the same proportion.

    The TCA that needs longest sets the pace, which costs no time. So the arm reaches the equilibrium of slow heating: with one
    TCA near 150 degC it has others, buckled to the other side.
    """
    rise = target - heating.ambient
    reachable = thermal.step(temperature, heating.max_power, step_s, heating) - heating.ambient
    share = min([1.0, *(reachable[rise > 0.0] / rise[rise > 0.0])])
    power = thermal.power_to_reach(temperature, heating.ambient + share * rise, step_s, heating)
    return 2.0 * np.clip(power / heating.max_power, 0.0, 1.0) - 1.0


@lru_cache(maxsize=16)
def carrying(robot: Robot) -> Robot:
    """Return a robot with what it carries at its tip."""
    return replace(robot, arm=Arm(robot.arm.modules, robot.arm.gravity, robot.carries))


def helical(arm: Arm) -> Mask:
    """Return which TCAs of an arm (n,) are wound around it and twist it; the others bend it."""
    return np.array([muscle.turns != 0.0 for muscle in arm.muscles])


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


def tool_at(robot: Robot, goal: Array, turn: float | None) -> Aim:
    """Return the aim of a horizontal position of the tool (2,) [m] and a yaw [rad]; without a yaw the helix is not heated."""
    assert robot.gripper is not None
    depth, twists = robot.gripper.depth, helical(robot.arm)

    def aim(here: Equilibrium) -> tuple[Array, Array]:
        pose, jacobian = here.tip_pose, here.tip_jacobian
        lever = depth * pose[:3, 2]
        place = jacobian[:3] + np.cross(jacobian[3:], lever, axis=0)
        missing = goal - (pose[:3, 3] + lever)[:2]
        if turn is None:
            place[:, twists] = 0.0
            return missing, place[:2]
        yaws = METRES_PER_RADIAN * yaw_gradient(pose) @ jacobian[3:]
        return np.append(missing, METRES_PER_RADIAN * (turn - yaw_of(here))), np.vstack([place[:2], yaws])

    return aim


def unwrapped(angle: float) -> float:
    """Return an angle [rad] as a yaw in (MOST_YAW - 2 pi, MOST_YAW]."""
    return MOST_YAW - (MOST_YAW - angle) % (2.0 * np.pi)


def least_turn(angle: float) -> float:
    """Return the yaw [rad] below LEAST_TURN that differs from an angle by half turns."""
    return LEAST_TURN - (LEAST_TURN - angle) % np.pi


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


def helix_temperature(robot: Robot, turn: float) -> float:
    """Return the temperature [degC] of the helical TCAs at which the straight arm has turned by about `turn` [rad]."""
    arm, limits, twists = robot.built(), robot.limits, helical(robot.arm)
    here, temperatures, turns = None, np.linspace(limits.ambient, limits.soft, 12), []
    for temperature in temperatures:
        here = arm.equilibrium(np.where(twists, temperature, limits.ambient), start=here)
        turns.append(yaw_of(here))
    sense = float(np.sign(turns[-1] - turns[0]))  # np.interp asks for rising yaws
    return float(np.interp(sense * turn, sense * np.array(turns), temperatures))


def starts(robot: Robot, turn: float | None = None) -> Array:
    """Return initial temperatures of plans (s, n) [degC].

    All bending TCAs are lukewarm, then each one is hot, then each one is cooler than the others. The helical ones are cold or
    turn the arm by `turn` [rad].
    """
    twists, limits = helical(robot.arm), robot.limits
    each = np.eye(int((~twists).sum()))
    result = np.full((1 + 2 * len(each), twists.size), limits.ambient)
    result[:, ~twists] = np.vstack(
        [np.full(len(each), LUKEWARM), LUKEWARM + (HOT - LUKEWARM) * each, HOT - (HOT - LUKEWARM) * each]
    )
    if turn is not None:
        result[:, twists] = helix_temperature(robot, turn)
    return result


def plan(robot: Robot, aim: Aim, starts: Array) -> Array:
    """Return temperatures (n,) [degC] between ambient and the soft limit whose steady state misses `aim` least.

    Gauss-Newton runs from each of `starts` (s, n) until one comes close. The Jacobian of a straight arm does not show how
    heating bends it sideways, and a start near the solution's branch finds that branch.
    """
    best, best_distance = np.full(len(robot.arm.muscles), robot.limits.ambient), np.inf
    for start in starts:
        temperature, distance = _gauss_newton(robot, aim, start)
        if distance < best_distance:
            best, best_distance = temperature, distance
        if best_distance < CLOSE_ENOUGH:
            break
    return best


def _gauss_newton(robot: Robot, aim: Aim, start: Array) -> tuple[Array, float]:
    """Return the best temperatures found from `start` and their error [m]."""
    arm, limits, temperature, damping = robot.built(), robot.limits, start, 1e-3
    here = steady(robot, temperature)
    error, jacobian = aim(here)
    for _ in range(30):
        if np.linalg.norm(error) < 0.1 * CLOSE_ENOUGH:
            break
        normal = jacobian.T @ jacobian
        # TCAs that the step would push beyond a limit take no part in it.
        gradient = jacobian.T @ error
        free = ~(((temperature <= limits.ambient) & (gradient < 0.0)) | ((temperature >= limits.soft) & (gradient > 0.0)))
        if not free.any():
            break
        step = np.zeros_like(temperature)
        scaled = normal[np.ix_(free, free)] + damping * np.trace(normal) / len(normal) * np.eye(int(free.sum()))
        step[free] = np.clip(np.linalg.solve(scaled, gradient[free]), -40.0, 40.0)
        trial = np.clip(temperature + step, limits.ambient, limits.soft)
        there = arm.equilibrium(trial, start=here)
        new_error, new_jacobian = aim(there)
        if there.converged and np.linalg.norm(new_error) < np.linalg.norm(error):
            temperature, here, error, jacobian, damping = trial, there, new_error, new_jacobian, max(0.2 * damping, 1e-9)
        elif damping > 1e3:
            break
        else:
            damping *= 5.0
    # Newton's iterations may have led to an equilibrium that heating does not reach.
    return temperature, float(np.linalg.norm(aim(steady(robot, temperature))[0]))


def steady(robot: Robot, temperature: Array) -> Equilibrium:
    """Return the equilibrium that slow heating from ambient to `temperature` (n,) [degC] reaches."""
    arm, ambient = robot.built(), robot.limits.ambient
    here = arm.equilibrium(np.full(len(temperature), ambient))
    for part in np.linspace(0.1, 1.0, 10):
        here = arm.equilibrium(ambient + part * (temperature - ambient), start=here)
    return here


class RandomPolicy:
    """A policy with uniformly random actions, the lower bound of comparisons.

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


def controller_of(task: str) -> Any:
    """Return a controller of a task, as its entry in `tca_envs.registry` names it; None if it names none."""
    make = registry.load(registry.entry(task).controller)
    return None if make is None else make()
