"""TwistAlign: bring the gripper over a place and turn it to a yaw."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics.rotation import yaw
from tca_envs.mechanics.thermal import Heater
from tca_envs.tasks.core import Core, Record
from tca_envs.tasks.task import Array, Outcome, Single, Task, box_with_heat, steady_goals

SUCCESS_CM = 0.15
"""A tip within 1.5 mm of the goal is over it ..."""
SUCCESS_DEG = 5.0
"""... and aligned within 5 degrees."""
BOX_CM = 8.0
"""No coordinate of the tip can be larger: the arm is shorter."""


class TwistAlign(Task):
    """Put the gripper of a soft arm over an object and align it: tip position and yaw at once.

    ## Description

    The bending module and, under it, the twisting module of the paper's arm hang from their base; the gripper hangs from the
    end as dead weight. Three straight twisted-and-coiled actuators (TCAs) bend the first module, a helical one turns the
    second: when heated, it turns the gripper one way only, counter-clockwise as seen from above. The arm is
    quasi-static: it is in equilibrium at every step, while the temperatures follow the heating powers with a time constant
    of 1.8 s.

    ## Action Space

    `Box(-1, 1, (4,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of bending TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |
    | 3 | heating power of the helical TCA | 0 | 4.94 | W |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC.

    ## Observation Space

    `Dict` of float32 boxes, as goal-conditioned learners (HER) expect it. The yaw is the turn of the tip about the vertical
    (the twist of its swing-twist decomposition); it enters as cosine and sine, which do not jump.

    | Key | Index | Meaning | Min | Max | Unit |
    |---|---|---|---|---|---|
    | `observation` | 0..3 | (temperature - 25 degC)/125 K of each TCA | 0 | 1.1 | 1 |
    | | 4..7 | heating power of the last step/full power | 0 | 1 | 1 |
    | | 8..10 | tip position x, y, z in the base frame, z down | -8 | 8 | cm |
    | | 11, 12 | cosine and sine of the tip's yaw | -1 | 1 | 1 |
    | `achieved_goal` | 0..2 | tip position x, y, z | -8 | 8 | cm |
    | | 3, 4 | cosine and sine of the tip's yaw | -1 | 1 | 1 |
    | `desired_goal` | 0..2 | goal position x, y, z | -8 | 8 | cm |
    | | 3, 4 | cosine and sine of the goal's yaw | -1 | 1 | 1 |

    ## Rewards

    `TCATwistAlign-v0`: 0 within 1.5 mm and 5 degrees of the goal, else -1. `TCATwistAlignDense-v0`: minus the distance in cm,
    minus 0.15 for every 5 degrees of yaw error, so that both tolerances weigh the same.
    `compute_reward(achieved_goal, desired_goal, info)` gives the same, for one goal or a batch; it does not read `info`.

    `info` (from `reset` too) holds `is_success` (within both now), `distance_mm`, `yaw_error_deg`, `energy_J` (electrical
    energy since the episode's start), `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs) and `solver`
    (`converged`, `residual`, `iterations`, `rung` as of `tca_envs.mechanics.Rung`, and `jumped`: the arm fell to another
    equilibrium).

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight. The goal is the steady state at temperatures drawn uniformly between 25
    and 150 degC, so that it can be reached and held; yaws lie between 0 and about -240 degrees. Where the arm could end on
    several sides (it can buckle when a TCA is near 150 degC), other temperatures are drawn. Temperature space is dealt out
    in cells of 25 K: a fifth of them is held out for evaluation, and training goals never come from those; they lie
    around them, so that a policy is tested on interpolation.

    ## Episode End

    Truncation after 100 steps of 0.1 s. There is no termination: the goal is to be held. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `reward` | `"sparse"` (`"dense"` in TCATwistAlignDense-v0) | which reward |
    | `split` | `"train"` | where goals come from: `"train"` or `"held-out"` |
    | `tolerance` | 1e-5 | largest error of the tip [m], 1e-9 to 1e-3; the cheapest discretisation that keeps to it is chosen |
    | `render_mode` | None | `"rgb_array"`, `"depth_array"`: what `render` returns; `"human"`: a window shows every step |
    | `width`, `height` | 480 | size of pictures or the window [pixel] |
    | `camera` | `"front"` | `"front"`, `"side"`, `"above"`, `"gripper"`, or where it stands and at what it looks [m] |

    ## Version History

    * v0: first version.
    """

    actions = 4
    goal_space = spaces.Box(
        np.array([-BOX_CM] * 3 + [-1.0] * 2, dtype=np.float32), np.array([BOX_CM] * 3 + [1.0] * 2, dtype=np.float32)
    )
    observation_space = box_with_heat(4, [-BOX_CM] * 3 + [-1.0] * 2, [BOX_CM] * 3 + [1.0] * 2)

    def core(self, lanes: int) -> Core:
        """Return `lanes` lanes of the whole arm."""
        return Core(presets.whole_arm(tolerance=self.tolerance), Heater(), lanes, goal_size=5)

    def draw(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return tip positions [cm] and yaws (N, 5) at steady temperatures of this task's split; there is no scene."""
        return steady_goals(self, core, generators), np.empty((len(generators), 0))

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 5): tip position [cm], cosine and sine of its yaw."""
        result = np.empty((len(record.tip), 5))
        result[:, :3] = 100.0 * record.tip[:, :3, 3]
        result[:, 3], result[:, 4] = yaw(record.tip)
        return result

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 13) what a controller measures beside the heat."""
        result[:, 8:] = achieved

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return what is to be said of goals (..., 5); a tolerance of yaw weighs like one of distance in the dense reward."""
        c, s = achieved[..., 3].astype(np.float64), achieved[..., 4].astype(np.float64)
        to_c, to_s = desired[..., 3], desired[..., 4]
        turn = np.degrees(np.abs(np.arctan2(s * to_c - c * to_s, c * to_c + s * to_s)))
        return Outcome(
            (away <= SUCCESS_CM) & (turn <= SUCCESS_DEG),
            -away - SUCCESS_CM / SUCCESS_DEG * turn,
            {"distance_mm": 10.0 * away, "yaw_error_deg": turn},
        )
