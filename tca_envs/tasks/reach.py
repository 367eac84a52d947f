"""Reach: heat the bending module so that its tip comes to rest at a goal."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics.thermal import Heater
from tca_envs.tasks.core import Core, Record
from tca_envs.tasks.task import Array, Outcome, Single, Task, box_with_heat, steady_goals

SUCCESS_CM = 0.1
"""A tip within 1 mm of the goal has reached it."""
BOX_CM = 7.0
"""No coordinate of the tip can be larger: the arm is shorter."""


class Reach(Task):
    """Bring the tip of a soft arm, bent by three heated coils, to a goal position and hold it there.

    ## Description

    The bending module of the paper's arm hangs from its base, the twisting module and the gripper hang from it as dead weight.
    Three twisted-and-coiled actuators (TCAs) run along it, 120 degrees apart; a heated one contracts and bends the arm
    towards its side, the cold ones resist. The arm is quasi-static: it is in equilibrium at every step, while the
    temperatures follow the heating powers with a time constant of 1.8 s.

    ## Action Space

    `Box(-1, 1, (3,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC.

    ## Observation Space

    `Dict` of float32 boxes, as goal-conditioned learners (HER) expect it.

    | Key | Index | Meaning | Min | Max | Unit |
    |---|---|---|---|---|---|
    | `observation` | 0..2 | (temperature - 25 degC)/125 K of each TCA | 0 | 1.1 | 1 |
    | | 3..5 | heating power of the last step/full power | 0 | 1 | 1 |
    | | 6..8 | tip position x, y, z in the base frame, z down | -7, -7, -7 | 7, 7, 7 | cm |
    | `achieved_goal` | 0..2 | tip position x, y, z | -7 | 7 | cm |
    | `desired_goal` | 0..2 | goal position x, y, z | -7 | 7 | cm |

    ## Rewards

    `TCAReach-v0`: 0 within 1 mm of the goal, else -1. `TCAReachDense-v0`: minus the distance in cm.
    `compute_reward(achieved_goal, desired_goal, info)` gives the same, for one goal or a batch; it does not read `info`.

    `info` (from `reset` too) holds `is_success` (within 1 mm now), `distance_mm`, `energy_J` (electrical energy since the
    episode's start), `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs) and `solver`
    (`converged`, `residual`, `iterations`, `rung` as of `tca_envs.mechanics.Rung`, and `jumped`: the arm fell to another
    equilibrium).

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight. The goal is the steady state at temperatures drawn uniformly between 25
    and 150 degC, so that it can be reached and held; where the arm could end on several sides (it can buckle when one TCA is
    near 150 degC), another one is drawn. Temperature space is dealt out in cells of 25 K: a fifth of them
    is held out for evaluation, and training goals never come from those; they lie around them, so that a policy is
    tested on interpolation.

    ## Episode End

    Truncation after 100 steps of 0.1 s. There is no termination: the goal is to be held. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `reward` | `"sparse"` (`"dense"` in TCAReachDense-v0) | which reward |
    | `split` | `"train"` | where goals come from: `"train"` or `"held-out"` |
    | `tolerance` | 1e-5 | largest error of the tip [m], 1e-9 to 1e-3; the cheapest discretisation that keeps to it is chosen |
    | `render_mode` | None | `"rgb_array"`, `"depth_array"`: what `render` returns; `"human"`: a window shows every step |
    | `width`, `height` | 480 | size of pictures or the window [pixel] |
    | `camera` | `"front"` | `"front"`, `"side"`, `"above"`, `"gripper"`, or where it stands and at what it looks [m] |

    ## Version History

    * v0: first version.
    """

    actions = 3
    goal_space = spaces.Box(-BOX_CM, BOX_CM, (3,), np.float32)
    observation_space = box_with_heat(3, [-BOX_CM] * 3, [BOX_CM] * 3)

    def core(self, lanes: int) -> Core:
        """Return `lanes` lanes of the bending module with the rest of the arm as dead weight."""
        return Core(presets.bending_arm(tolerance=self.tolerance), Heater(), lanes, goal_size=3)

    def draw(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return tips (N, 3) [cm] at steady temperatures of this task's split; there is no scene."""
        return steady_goals(self, core, generators), np.empty((len(generators), 0))

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 3): tip position [cm]."""
        return 100.0 * record.tip[:, :3, 3]

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 9) what a controller measures beside the heat."""
        result[:, 6:] = achieved

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return what is to be said of goals (..., 3)."""
        return Outcome(away <= SUCCESS_CM, -away, {"distance_mm": 10.0 * away})
