"""TwistAlign: bring the gripper over a place and turn it to a yaw."""

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Parts
from tca_envs.mechanics import check
from tca_envs.robots import Robot
from tca_envs.rotation import yaw
from tca_envs.tasks.core import Core, Record
from tca_envs.tasks.task import Array, Outcome, Single, Task, steady_goals

SUCCESS_MM = 1.5
"""A tip so near to the goal is over it ..."""
SUCCESS_DEG = 5.0
"""... and aligned within this angle."""


class TwistAlign(Task):
    """Put the gripper of a soft arm over an object and align it: tip position and yaw at once.

    ## Description

    The bending module and, under it, the twisting module of the paper's arm hang from their base. The gripper hangs from the
    end as dead weight. Three straight twisted-and-coiled actuators (TCAs) bend the first module. A helical one turns the
    second: when heated, it turns the gripper one way only, counter-clockwise as seen from above. The arm is quasi-static: it
    is in equilibrium at every step. The temperatures follow the heating powers with a time constant of 1.8 s.

    ## Action Space

    `Box(-1, 1, (4,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of bending TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |
    | 3 | heating power of the helical TCA | 0 | 4.94 | W |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC. Another robot has a power for each of its heated
    TCAs; observations follow, and its limits take the place of 25, 150 and 158 degC.

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

    `info` (from `reset` too) holds `is_success` (within both tolerances now), `distance_mm`, `yaw_error_deg`, `energy_J`
    (electrical energy since the episode's start) and `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs).
    `solver` in it holds `converged`, `residual`, `iterations`, `rung` (as of `tca_envs.mechanics.Rung`) and `jumped`: the arm
    snapped through to another equilibrium.

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight. The goal is the tip's position and yaw in the steady state at temperatures
    drawn uniformly between 25 and 150 degC, so that it can be reached and held. Yaws lie between 0 and about -240 degrees.
    The arm can buckle when a TCA is near 150 degC; where it could end on several sides, other temperatures are drawn.
    Temperature space is dealt out in cells of 25 K, and a fifth of them is held out for evaluation. Training goals never come
    from those but lie around them: evaluation tests interpolation.

    ## Episode End

    Truncation after 100 steps of 0.1 s. There is no termination: the goal is to be held. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `robot` | None | what is moved, a `tca_envs.robots.Robot`; None is the paper's whole arm |
    | `success_mm` | 1.5 | a tip so near to the goal is over it ... [mm] |
    | `success_deg` | 5.0 | ... and aligned within this angle [deg] |
    | `reward` | `"sparse"` (`"dense"` in TCATwistAlignDense-v0) | which reward |
    | `split` | `"train"` | where goals come from: `"train"` or `"held-out"` |
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

    def __init__(self, robot: Robot, success_mm: float = SUCCESS_MM, success_deg: float = SUCCESS_DEG, **shared: Any) -> None:
        super().__init__(robot, **shared)
        self.success_cm = check.scalar("success_mm", success_mm, 0.0, above=True) / 10.0
        self.success_deg = check.scalar("success_deg", success_deg, 0.0, 180.0, above=True)
        high = [robot.bound_cm] * 3 + [1.0] * 2
        self.goal_space = spaces.Box(-np.array(high, dtype=np.float32), np.array(high, dtype=np.float32))
        self.observation_space = self.observed([-x for x in high], high)

    def sample(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return tip positions [cm] and yaws (N, 5) at steady temperatures of this task's split; there is no scene."""
        return steady_goals(self, core, generators), np.empty((len(generators), 0))

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 5): tip position [cm], cosine and sine of its yaw."""
        result = np.empty((len(record.tip), 5))
        result[:, :3] = 100.0 * record.tip[:, :3, 3]
        result[:, 3], result[:, 4] = yaw(record.tip)
        return result

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 5) what a controller measures beside the heat: tip and yaw."""
        result[:] = achieved

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return the outcome of goals (..., 5); both tolerances weigh the same in the dense reward."""
        c, s = achieved[..., 3].astype(np.float64), achieved[..., 4].astype(np.float64)
        to_c, to_s = desired[..., 3], desired[..., 4]
        turn = np.degrees(np.abs(np.arctan2(s * to_c - c * to_s, c * to_c + s * to_s)))
        return Outcome(
            (away <= self.success_cm) & (turn <= self.success_deg),
            -away - self.success_cm / self.success_deg * turn,
            {"distance_mm": 10.0 * away, "yaw_error_deg": turn},
        )

    def draw(self, record: Record, colour: str) -> Parts:
        """Return the goal, a ball of the success radius, and what hangs from the arm's tip as a ghost at the goal's yaw."""
        goal = record.goal[0]
        pose = np.eye(4)
        c, s = goal[3:5] / hypot(*goal[3:5])
        pose[:2, :2] = (c, -s), (s, c)
        pose[:3, 3] = place = 1e-2 * goal[:3]
        ghosts = {} if self.robot.tail is None else self.robot.tail(pose)
        return {
            "goal": geometry.ball(place, 1e-2 * self.success_cm, colour, 0.6),
            **{f"goal {name}": part._replace(colour=colour, opacity=0.5) for name, part in ghosts.items()},
        }
