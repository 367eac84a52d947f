"""PickAndPlace: grasp an object on the table and put it down elsewhere."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import grasp
from tca_envs.mechanics.rotation import yaw, yaw_angle
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT, Heater
from tca_envs.tasks.core import STEP_S, Core, Record, solved
from tca_envs.tasks.task import Array, Mask, Outcome, Single, Task, box_with_heat, rounds

SUCCESS_CM = 0.3
"""An object at rest within 3 mm of the target, the gripper clear of it, is placed."""
APART_CM = 0.6
"""The target lies at least this far from the object's first place."""
HOTTEST_OBJECT = np.array([100.0, 100.0, 100.0, 125.0])
"""The object's first place is under the gripper at temperatures up to these [degC] ..."""
HOTTEST_TARGET = np.array([120.0, 120.0, 120.0, AMBIENT])
"""... and the target under that of an arm that carries it at temperatures up to these, untwisted."""
BOX_CM = 10.0
"""No coordinate of tool or object can be larger."""
FULL_FORCE = 0.05
"""Unit of the observed pinch force [N]."""
TEMPERATURES, POWERS, TOOL, TOOL_COS, TOOL_SIN = slice(0, 5), slice(5, 10), slice(10, 13), 13, 14
TRAVEL, OPENING, FORCE, OBJECT, OBJECT_COS2, OBJECT_SIN2 = 15, 16, 17, slice(18, 21), 21, 22
"""Places in `observation`."""


class PickAndPlace(Task):
    """Grasp an object under the arm, lift it, and put it down at a target: with heat, friction and a vertical stage.

    ## Description

    The whole arm of the paper: three twisted-and-coiled actuators (TCAs) bend it, a helical one turns the gripper (one way
    only), a fifth one opens the gripper's ring, and a stage moves the base up and down. An upright board (3 mm wide, 12 mm
    long, 8 mm high, 1.5 g) stands on a table, its centre 10 mm under the jaws of the cold arm.

    Grasping follows from physics. The jaws go down over the object only where their gap is wider than the object as it lies
    to them; otherwise the stage stops on its top. Closing jaws push the object to their middle and turn it into line. It is
    held as long as friction carries its weight, 2 mu N >= m g, with the pinch force N of the cooling ring; its weight then
    loads the arm.
    When the jaws open it falls straight down and stays where it lands.

    The arm is quasi-static: it is in equilibrium at every step, while the temperatures follow the heating powers with a time
    constant of 1.8 s. Not modelled: contact between arm and table beyond a stop of the stage, jaws that push an object which
    is not between them, impact, tilting and rolling of the object (a held one hangs upright), the tilt of the jaws in
    contacts, the millimetre by which the jaws of the open ring hang lower.

    ## Action Space

    `Box(-1, 1, (6,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of bending TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |
    | 3 | heating power of the helical TCA | 0 | 4.94 | W |
    | 4 | heating power of the gripper's TCA | 0 | 2.25 | W |
    | 5 | speed of the stage, positive down | -10 | 10 | mm/s |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC. The stage travels 15 mm; where the arm sinks onto
    table or object it gives way.

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

    `info` (from `reset` too) holds `is_success` (placed now), `distance_mm`, `energy_J` (electrical energy of heating since
    the episode's start), `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs) and `solver`
    (`converged`, `residual`, `iterations`, `rung` as of `tca_envs.mechanics.Rung`, and `jumped`: the arm fell to another
    equilibrium).

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight, the stage up. The object lies under the tool of a steady state, with its
    yaw: at bending temperatures drawn uniformly between 25 and 100 degC and a twisting temperature between 25 and 125 degC
    (yaws down to about -150 degrees). The target lies under an object carried by an untwisted arm at bending
    temperatures between 25 and 120 degC, at least 6 mm away. Temperature space (of the seven temperatures) is dealt out in
    cells of 25 K: a fifth of them is held out for evaluation, and training episodes never come from those.

    ## Episode End

    Truncation after 300 steps of 0.1 s. There is no termination: the object is to stay. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `reward` | `"sparse"` (`"dense"` in TCAPickAndPlaceDense-v0) | which reward |
    | `split` | `"train"` | where episodes come from: `"train"` or `"held-out"` |
    | `tolerance` | 1e-5 | largest error of the tip [m], 1e-9 to 1e-3; the cheapest discretisation that keeps to it is chosen |
    | `render_mode` | None | `"rgb_array"`, `"depth_array"`: what `render` returns; `"human"`: a window shows every step |
    | `width`, `height` | 480 | size of pictures or the window [pixel] |
    | `camera` | `"front"` | `"front"`, `"side"`, `"above"`, `"gripper"`, or where it stands and at what it looks [m] |

    ## Version History

    * v0: first version.
    """

    actions = 6
    goal_space = spaces.Box(np.array([-BOX_CM] * 3 + [0.0], dtype=np.float32), np.array([BOX_CM] * 3 + [1.0], dtype=np.float32))
    observation_space = box_with_heat(
        5,
        [-BOX_CM] * 3 + [-1.0] * 2 + [0.0] * 3 + [-BOX_CM] * 3 + [-1.0] * 2,
        [BOX_CM] * 3 + [1.0] * 5 + [BOX_CM] * 3 + [1.0] * 2,
    )

    def __init__(self, split: str, tolerance: float = presets.TOLERANCE) -> None:
        super().__init__(split, tolerance)
        self.gripper = presets.gripper()
        self._pinch = pinch_table()
        self._last_gap = (b"", np.empty(0))

    def core(self, lanes: int) -> Core:
        """Return `lanes` lanes of the whole arm; the gripper's TCA is heated, too."""
        return Core(presets.whole_arm(tolerance=self.tolerance), Heater(), lanes, 4, grasp.SCENE, [self.gripper.rest_length])

    def draw(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return targets (N, 4) and scenes (N, SCENE) with the object under the tool of a steady state."""
        rest = grasp.resting(presets.OBJECT, presets.SITE)
        goals = np.tile([0.0, 0.0, 100.0 * rest, 1.0], (len(generators), 1))
        scenes = np.zeros((len(generators), grasp.SCENE))
        scenes[:, grasp.Z] = rest
        carrying = presets.hanging(np.array([0.0, 0.0, presets.JAW_DEPTH]))

        def candidate(generator: np.random.Generator) -> list[float]:
            while True:
                first = (AMBIENT + (HOTTEST_OBJECT - AMBIENT) * generator.random(4)).tolist()
                last = (AMBIENT + (HOTTEST_TARGET - AMBIENT) * generator.random(4)).tolist()
                if self.of_this_split(first + last[:3]):
                    return [*first, *last]

        def accepted(which: NDArray[np.intp], temperature: Array) -> Mask:
            # All empty arms first, then all that carry the object.
            payload = np.repeat([core.rest.payload[0], carrying], which.size, axis=0)
            record, good = core.settle(np.concatenate([temperature[:, :4], temperature[:, 4:]]), payload)
            place = tool(record)[:, :2]
            here, there = place[: which.size], place[which.size :]
            scenes[which, grasp.X : grasp.Z] = here
            scenes[which, grasp.YAW] = grasp.half_turn(heading(record)[: which.size])
            goals[which, :2] = 100.0 * there
            apart = 100.0 * there - 100.0 * here
            return good[: which.size] & good[which.size :] & (np.hypot(apart[:, 0], apart[:, 1]) >= APART_CM)

        rounds(generators, candidate, accepted)
        return goals, scenes

    def step(self, core: Core, action: Array) -> Array:
        """Heat by the first five numbers of the actions (N, 6), then move the stage and let jaws and object act."""
        report = core.step(action[:, :5])
        record = core.record
        lowering = presets.STAGE_SPEED * STEP_S * np.clip(action[:, 5], -1.0, 1.0)
        gap, pinch = self.gap(record), self.pinch(record)
        scene = grasp.step(record.scene, tool(record), heading(record), gap, pinch, lowering, presets.OBJECT, presets.SITE)
        record.scene[:] = np.where(solved(report)[:, np.newaxis], scene, record.scene)
        record.payload[:] = core.rest.payload
        held = np.flatnonzero(record.scene[:, grasp.HELD])
        if held.size:
            record.payload[held] = presets.hanging(grasp.in_mount(record.scene[held], record.tip[held]))
        return report

    def gap(self, record: Record) -> Array:
        """Return the distance (N,) of the jaws without an object [m]."""
        # A step asks for it twice, to act and to observe, and it takes as long as all else that is observed.
        temperature = record.temperature[:, 4].tobytes()
        if temperature != self._last_gap[0]:
            self._last_gap = (temperature, self.gripper.gap(record.temperature[:, 4]))
        return self._last_gap[1]

    def pinch(self, record: Record) -> Array:
        """Return the force (N,) with which each jaw would press on the object between them [N]."""
        return np.interp(record.temperature[:, 4], PINCH_AT, self._pinch)

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 4): object position [cm] and whether it lies there free."""
        scene = record.scene
        result = np.empty((len(scene), 4))
        result[:, :3] = 100.0 * scene[:, grasp.X : grasp.Z + 1]
        result[:, 3] = scene[:, grasp.TOUCHED] < 0.5
        return result

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 23) what a controller measures beside the heat."""
        record, scene = core.record, core.record.scene
        between = scene[:, grasp.HELD] + scene[:, grasp.ASTRIDE]  # 0 or 1: never both
        turn = 2.0 * scene[:, grasp.YAW]
        place = tool(record)
        place[:, 2] += scene[:, grasp.STAGE]
        result[:, TOOL] = 100.0 * place
        result[:, TOOL_COS], result[:, TOOL_SIN] = yaw(record.tip)
        result[:, TRAVEL] = scene[:, grasp.STAGE] / presets.STAGE_TRAVEL
        result[:, OPENING] = 100.0 * np.maximum(self.gap(record), presets.OBJECT.width * between)
        result[:, FORCE] = self.pinch(record) * between / FULL_FORCE
        result[:, OBJECT] = achieved[:, :3]
        result[:, OBJECT_COS2], result[:, OBJECT_SIN2] = np.cos(turn), np.sin(turn)

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return what is to be said of goals (..., 4)."""
        return Outcome((away <= SUCCESS_CM) & (achieved[..., 3] > 0.5), -away, {"distance_mm": 10.0 * away})


PINCH_AT = np.arange(AMBIENT, HARD_LIMIT + 1.0)
"""[degC]: the pinch force is interpolated between these, within 0.3 mN."""


@cache
def pinch_table() -> Array:
    """Return the pinch force on the object at PINCH_AT [N]; it takes a second, and every environment asks."""
    table = presets.gripper().pinch(PINCH_AT, presets.OBJECT.width)
    table.setflags(write=False)
    return table


def tool(record: Record) -> Array:
    """Return the points between the jaws (N, 3) with the stage up [m]."""
    return grasp.between_jaws(record.tip, presets.JAW_DEPTH)


def heading(record: Record) -> Array:
    """Return the directions in which the jaws open (N,) [rad]: the tip's x axis."""
    return yaw_angle(record.tip)
