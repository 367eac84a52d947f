"""PickAndPlace: grasp an object on the table and put it down elsewhere."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tca_envs import geometry
from tca_envs.geometry import Parts
from tca_envs.mechanics import Gripper, check, grasp
from tca_envs.mechanics.grasp import Box, Site
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import Limits, Posture, Robot, paper
from tca_envs.robots.robot import carrying
from tca_envs.rotation import yaw, yaw_angle
from tca_envs.tasks.core import Core, Record, solved
from tca_envs.tasks.task import Array, Mask, Outcome, Single, Task, rounds

SUCCESS_MM = 3.0
"""An object at rest so near to the target, the gripper clear of it, is placed."""
APART_CM = 0.6
"""The target lies at least this far from the object's first place."""
HOTTEST_OBJECT = (100.0, 100.0, 100.0, 125.0)
"""The object's first place is under the gripper at temperatures up to these [degC] ..."""
HOTTEST_TARGET = (120.0, 120.0, 120.0, AMBIENT)
"""... and the target under that of an arm that carries it at temperatures up to these, untwisted."""
FULL_FORCE = 0.05
"""Unit of the observed pinch force [N]."""
TOOL, TOOL_COS, TOOL_SIN, TRAVEL, OPENING, FORCE = slice(-13, -10), -10, -9, -8, -7, -6
OBJECT, OBJECT_COS2, OBJECT_SIN2 = slice(-5, -2), -2, -1
"""Places in `observation`, counted from its end: temperatures and powers of the heated TCAs come first."""


class PickAndPlace(Task):
    """Grasp an object under the arm, lift it, and put it down at a target: with heat, friction and a vertical stage.

    ## Description

    The whole arm of the paper: three twisted-and-coiled actuators (TCAs) bend it, a helical one turns the gripper (one way
    only), and a fifth one opens the gripper's ring. A stage moves the base up and down. An upright board (3 mm wide, 12 mm
    long, 8 mm high, 1.5 g) stands on a table, its centre 10 mm under the jaws of the cold arm.

    Grasping follows from physics. The jaws go down over the object only where their gap is wider than the object as it lies
    to them; otherwise the stage stops on its top. Closing jaws push the object to their middle and turn it into line. Friction
    holds it as long as it carries its weight, 2 mu N >= m g, with the pinch force N of the cooling ring. The weight of a held
    object loads the arm. When the jaws open it falls straight down and stays where it lands.

    The arm is quasi-static: it is in equilibrium at every step. The temperatures follow the heating powers with a time
    constant of 1.8 s. Not modelled are:

    * contact between arm and table beyond a stop of the stage, and impact;
    * jaws that push an object which is not between them;
    * tilting and rolling of the object (a held one hangs upright), and the tilt of the jaws in contacts;
    * the millimetre by which the jaws of the open ring hang lower.

    ## Action Space

    `Box(-1, 1, (6,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of bending TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |
    | 3 | heating power of the helical TCA | 0 | 4.94 | W |
    | 4 | heating power of the gripper's TCA | 0 | 2.25 | W |
    | 5 | speed of the stage, positive down | -10 | 10 | mm/s |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC. The stage travels 15 mm; where the arm sinks onto
    table or object it gives way. Another robot has a power for each of its heated TCAs, then the stage's speed; observations
    follow, and its limits take the place of 25, 150 and 158 degC.

    ## Observation Space

    `Dict` of float32 boxes, as goal-conditioned learners (HER) expect it. "Tool" is the point between the jaws.

    | Key | Index | Meaning | Min | Max | Unit |
    |---|---|---|---|---|---|
    | `observation` | 0..4 | (temperature - 25 degC)/125 K of each TCA | 0 | 1.1 | 1 |
    | | 5..9 | heating power of the last step/full power | 0 | 1 | 1 |
    | | 10..12 | tool position x, y, z in the frame of the raised base, z down | -10 | 10 | cm |
    | | 13, 14 | cosine and sine of the tool's yaw | -1 | 1 | 1 |
    | | 15 | travel of the stage/15 mm, 1 is down | 0 | 1 | 1 |
    | | 16 | opening of the jaws | 0 | 1 | cm |
    | | 17 | pinch force on the object/50 mN | 0 | 1 | 1 |
    | | 18..20 | object position x, y, z (its centre) | -10 | 10 | cm |
    | | 21, 22 | cosine and sine of twice the object's yaw | -1 | 1 | 1 |
    | `achieved_goal` | 0..2 | object position x, y, z | -10 | 10 | cm |
    | | 3 | 1 if it rests on the table and the gripper neither touches nor surrounds it, else 0 | 0 | 1 | 1 |
    | `desired_goal` | 0..2 | target position x, y, z | -10 | 10 | cm |
    | | 3 | 1 | 0 | 1 | 1 |

    ## Rewards

    `TCAPickAndPlace-v0`: 0 where the object rests within 3 mm of the target with the gripper clear of it, else -1.
    `TCAPickAndPlaceDense-v0`: minus the distance of object and target in cm.
    `compute_reward(achieved_goal, desired_goal, info)` gives the same, for one goal or a batch; it does not read `info`.

    `info` (from `reset` too) holds `is_success` (placed now), `distance_mm`, `energy_J` (electrical energy since the
    episode's start) and `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs). `solver` in it holds
    `converged`, `residual`, `iterations`, `rung` (as of `tca_envs.mechanics.Rung`) and `jumped`: the arm snapped through to
    another equilibrium.

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight, the stage up. The object lies under the tool of a steady state, with its
    yaw: at bending temperatures drawn uniformly between 25 and 100 degC and a twisting temperature between 25 and 125 degC
    (yaws down to about -150 degrees). The target lies under an object carried by an untwisted arm at bending temperatures
    between 25 and 120 degC, at least 6 mm away. The space of these seven temperatures is dealt out in cells of 25 K. A fifth
    of them is held out for evaluation, and training episodes never come from those.

    ## Episode End

    Truncation after 300 steps of 0.1 s. There is no termination: the object is to stay. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `robot` | None | what is moved, a `tca_envs.robots.Robot`; None is the paper's whole arm with its gripper, on its stage |
    | `success_mm` | 3.0 | an object at rest so near to the target, the gripper clear of it, is placed [mm] |
    | `box` | the board above | what is grasped, a `tca_envs.mechanics.grasp.Box` |
    | `table_m` | 0.0868 | depth of the table under the raised base [m] |
    | `object_degC` | (100, 100, 100, 125) | the object's first place is under the gripper at temperatures up to these [degC] |
    | `target_degC` | (120, 120, 120, 25) | the target is under that of the loaded arm at temperatures up to these [degC] |
    | `reward` | `"sparse"` (`"dense"` in TCAPickAndPlaceDense-v0) | which reward |
    | `split` | `"train"` | where episodes come from: `"train"` or `"held-out"` |
    | `step_s` | 0.1 | duration of a step [s] |
    | `tolerance` | 1e-5 | largest error of the tip [m], 1e-9 to 1e-3; the cheapest discretisation that keeps to it is chosen |
    | `solver` | `"collocation"` | what finds equilibria: `"shooting"` is the paper's method, slow, see below; or a function |
    | `render_mode` | None | `"rgb_array"`, `"depth_array"`: what `render` returns; `"human"`: a window shows every step |
    | `width`, `height` | 480 | size of pictures or the window [pixel] |
    | `camera` | `"front"` | `"front"`, `"side"`, `"above"`, `"gripper"`, or where it stands and at what it looks [m] |

    `gymnasium.make(id, max_episode_steps=...)` sets the length of episodes. `solver="shooting"` is for a check that a policy
    does not depend on the solver: it needs a checkout of the repository and `gymnasium.make`, not `make_vec`.

    ## Version History

    * v0: first version.
    """

    scene_size = grasp.SCENE

    def __init__(
        self,
        robot: Robot,
        success_mm: float = SUCCESS_MM,
        box: Box = paper.OBJECT,
        table_m: float = paper.TABLE,
        object_degC: ArrayLike = HOTTEST_OBJECT,
        target_degC: ArrayLike = HOTTEST_TARGET,
        **shared: Any,
    ) -> None:
        super().__init__(robot, **shared)
        if robot.gripper is None or robot.stage is None:
            raise ValueError(f"robot = {robot!r}: expected one with a gripper and a stage")
        if not isinstance(box, Box):
            raise ValueError(f"box = {box!r}: expected a tca_envs.mechanics.grasp.Box")
        self.gripper, self.stage, self.box = robot.gripper, robot.stage, box
        self.robot = carrying(robot, self.gripper.payload(box.mass))
        self.success_cm = check.scalar("success_mm", success_mm, 0.0, above=True) / 10.0
        table = check.scalar("table_m", table_m, 0.0, above=True)
        gravity = float(robot.arm.gravity[2])
        self.site = Site(table, self.stage.travel, self.gripper.width, self.gripper.thickness, gravity)
        self.object_degC = self._hottest("object_degC", object_degC)
        self.target_degC = self._hottest("target_degC", target_degC)
        self._pinch = pinch_table(self.gripper.ring, box.width, robot.limits)
        self._last_gap = (b"", np.empty(0))
        self.actions = robot.heated + 1
        bound = [robot.bound_cm] * 3
        away = [-x for x in bound]
        self.goal_space = spaces.Box(np.array([*away, 0.0], dtype=np.float32), np.array([*bound, 1.0], dtype=np.float32))
        self.observation_space = self.observed(
            away + [-1.0] * 2 + [0.0] * 3 + away + [-1.0] * 2, bound + [1.0] * 5 + bound + [1.0] * 2
        )

    def _hottest(self, name: str, value: ArrayLike) -> Array:
        """Return upper bounds of temperatures, one for each of the arm's TCAs."""
        limits, result = self.robot.limits, check.array(name, value, (len(self.robot.arm.muscles),))
        if not ((result >= limits.ambient) & (result <= limits.soft)).all():
            raise ValueError(f"{name} = {value!r}: expected temperatures in [{limits.ambient:g}, {limits.soft:g}] degC")
        return result

    @property
    def ground(self) -> float:
        """Depth of the table under the base [m]."""
        return self.site.table

    def sample(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return targets (N, 4) and scenes (N, SCENE) with the object under the tool of a steady state."""
        rest = grasp.resting(self.box, self.site)
        goals = np.tile([0.0, 0.0, 100.0 * rest, 1.0], (len(generators), 1))
        scenes = np.zeros((len(generators), grasp.SCENE))
        scenes[:, grasp.Z] = rest
        loaded = self.gripper.carrying(self.box.mass, np.array([0.0, 0.0, self.gripper.depth]))
        ambient, muscles = self.robot.limits.ambient, len(core.arm.muscles)
        warm = np.flatnonzero(self.target_degC > ambient).tolist()

        def candidate(generator: np.random.Generator) -> list[float]:
            while True:
                first = (ambient + (self.object_degC - ambient) * generator.random(muscles)).tolist()
                last = (ambient + (self.target_degC - ambient) * generator.random(muscles)).tolist()
                if self.of_this_split(first + [last[i] for i in warm]):
                    return [*first, *last]

        def accepted(which: NDArray[np.intp], temperature: Array) -> Mask:
            # All empty arms first, then all that carry the object.
            payload = np.repeat([core.rest.payload[0], loaded], which.size, axis=0)
            record, good = core.settle(np.concatenate([temperature[:, :muscles], temperature[:, muscles:]]), payload)
            place = self.tool(record)[:, :2]
            here, there = place[: which.size], place[which.size :]
            scenes[which, grasp.X : grasp.Z] = here
            scenes[which, grasp.YAW] = grasp.half_turn(heading(record)[: which.size])
            goals[which, :2] = 100.0 * there
            apart = 100.0 * there - 100.0 * here
            return good[: which.size] & good[which.size :] & (np.hypot(apart[:, 0], apart[:, 1]) >= APART_CM)

        rounds(generators, candidate, accepted)
        return goals, scenes

    def step(self, core: Core, action: Array) -> Array:
        """Heat by all but the last numbers of the actions (N, m + 1), then move the stage and let jaws and object act."""
        report = core.step(action[:, :-1])
        record = core.record
        lowering = self.stage.speed * self.step_s * np.clip(action[:, -1], -1.0, 1.0)
        gap, pinch = self.gap(record), self.pinch(record)
        scene = grasp.step(record.scene, self.tool(record), heading(record), gap, pinch, lowering, self.box, self.site)
        record.scene[:] = np.where(solved(report)[:, np.newaxis], scene, record.scene)
        record.payload[:] = core.rest.payload
        held = np.flatnonzero(record.scene[:, grasp.HELD])
        if held.size:
            place = grasp.in_mount(record.scene[held], record.tip[held])
            record.payload[held] = self.gripper.carrying(self.box.mass, place)
        return report

    def tool(self, record: Record) -> Array:
        """Return the points between the jaws (N, 3) with the stage up [m]."""
        return grasp.between_jaws(record.tip, self.gripper.depth)

    def gap(self, record: Record) -> Array:
        """Return the distance (N,) of the jaws without an object [m]."""
        # A step asks for it twice, to act and to observe, and it takes as long as all else that is observed.
        temperature = record.temperature[:, -1].tobytes()
        if temperature != self._last_gap[0]:
            self._last_gap = (temperature, self.gripper.ring.gap(record.temperature[:, -1]))
        return self._last_gap[1]

    def opening(self, record: Record) -> Array:
        """Return the distance (N,) of the jaws [m]: at least the object's width where it is between them."""
        between = record.scene[:, grasp.HELD] + record.scene[:, grasp.ASTRIDE]  # 0 or 1: never both
        return np.maximum(self.gap(record), self.box.width * between)

    def pinch(self, record: Record) -> Array:
        """Return the force (N,) with which each jaw would press on the object between them [N]."""
        return np.interp(record.temperature[:, -1], *self._pinch)

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 4): object position [cm] and whether it lies there free."""
        scene = record.scene
        result = np.empty((len(scene), 4))
        result[:, :3] = 100.0 * scene[:, grasp.X : grasp.Z + 1]
        result[:, 3] = scene[:, grasp.TOUCHED] < 0.5
        return result

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 13) what a controller measures beside the heat."""
        record, scene = core.record, core.record.scene
        between = scene[:, grasp.HELD] + scene[:, grasp.ASTRIDE]
        turn = 2.0 * scene[:, grasp.YAW]
        place = self.tool(record)
        place[:, 2] += scene[:, grasp.STAGE]
        result[:, TOOL] = 100.0 * place
        result[:, TOOL_COS], result[:, TOOL_SIN] = yaw(record.tip)
        result[:, TRAVEL] = scene[:, grasp.STAGE] / self.stage.travel
        result[:, OPENING] = 100.0 * self.opening(record)
        result[:, FORCE] = self.pinch(record) * between / FULL_FORCE
        result[:, OBJECT] = achieved[:, :3]
        result[:, OBJECT_COS2], result[:, OBJECT_SIN2] = np.cos(turn), np.sin(turn)

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return the outcome of goals (..., 4)."""
        return Outcome((away <= self.success_cm) & (achieved[..., 3] > 0.5), -away, {"distance_mm": 10.0 * away})

    def posture(self, record: Record) -> Posture:
        """Return how far the stage is down and the jaws are open in one lane."""
        return Posture(float(record.scene[0, grasp.STAGE]), float(self.opening(record)[0]))

    def draw(self, record: Record, colour: str) -> Parts:
        """Return the object, its ghost at the target, and a disc of the success radius on the table."""
        scene, place = record.scene[0], 1e-2 * record.goal[0, :3]
        turn = float(scene[grasp.YAW])
        half = (0.5 * self.box.width, 0.5 * self.box.length, 0.5 * self.box.height)
        spot = np.eye(4)
        spot[:3, 3] = place[0], place[1], self.site.table - 0.1e-3
        return {
            "goal": geometry.box(place, half, colour, turn)._replace(opacity=0.55),
            "goal place": geometry.disc(spot, 1e-2 * self.success_cm, 0.1e-3, colour)._replace(opacity=0.6),
            "object": geometry.box(scene[grasp.X : grasp.Z + 1], half, geometry.OBJECT, turn),
        }


@cache
def pinch_table(ring: Gripper, width: float, limits: Limits) -> tuple[Array, Array]:
    """Return temperatures [degC] and the pinch force at them [N]; in between it is interpolated, within 0.3 mN.

    It takes a second, and every environment asks.
    """
    at = np.arange(limits.ambient, limits.hard + 1.0)
    force = ring.pinch(at, width)
    for values in (at, force):
        values.setflags(write=False)
    return at, force


def heading(record: Record) -> Array:
    """Return the directions in which the jaws open (N,) [rad]: the tip's x axis."""
    return yaw_angle(record.tip)
