"""Reach: heat the muscles so that the arm's tip comes to rest at a goal."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tca_envs import geometry
from tca_envs.geometry import Parts
from tca_envs.mechanics import check
from tca_envs.robots import Robot
from tca_envs.tasks.core import Core, Record
from tca_envs.tasks.task import Array, Outcome, Single, Task, steady_goals

SUCCESS_MM = 1.0
"""A tip so near to the goal has reached it."""


class Reach(Task):
    """Bring the tip of a soft arm, bent by three heated coils, to a goal position and hold it there.

    ## Description

    The bending module of the paper's arm hangs from its base. The twisting module and the gripper hang from it as dead weight.
    Three twisted-and-coiled actuators (TCAs) run along it, 120 degrees apart. A heated TCA contracts and bends the arm towards
    its side; the cold ones resist. The arm is quasi-static: it is in equilibrium at every step. The temperatures follow the
    heating powers with a time constant of 1.8 s.

    ## Action Space

    `Box(-1, 1, (3,), float32)`. Finite values outside are clipped; others raise `ValueError`.

    | Index | Meaning | Min (-1) | Max (+1) | Unit |
    |---|---|---|---|---|
    | 0..2 | heating power of TCA 0 (at 0 deg, +x), 1 (120 deg), 2 (240 deg) | 0 | 2 | W |

    A cut-off in the heaters lowers the power so that no TCA passes 158 degC. Another robot has a power for each of its heated
    TCAs; observations follow, and its limits take the place of 25, 150 and 158 degC.

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

    `info` (from `reset` too) holds `is_success` (within the radius now), `distance_mm`, `energy_J` (electrical energy since the
    episode's start) and `cost` (kelvins above the soft limit of 150 degC, summed over the TCAs). `solver` in it holds
    `converged`, `residual`, `iterations`, `rung` (as of `tca_envs.mechanics.Rung`) and `jumped`: the arm snapped through to
    another equilibrium.

    ## Starting State

    All TCAs at 25 degC, the arm hanging straight. The goal is the tip's position in the steady state at temperatures drawn
    uniformly between 25 and 150 degC, so that it can be reached and held. The arm can buckle when one TCA is near 150 degC;
    where it could end on several sides, other temperatures are drawn. Temperature space is dealt out in cells of 25 K, and a
    fifth of them is held out for evaluation. Training goals never come from those but lie around them: evaluation tests
    interpolation.

    ## Episode End

    Truncation after 100 steps of 0.1 s. There is no termination: the goal is to be held. If the solver finds no
    equilibrium, the last good state stays, `info["solver"]["converged"]` is False and the episode is truncated.

    ## Arguments

    | Name | Default | Meaning |
    |---|---|---|
    | `robot` | None | what is moved, a `tca_envs.robots.Robot`; None is the paper's bending module with the rest of its arm |
    | `success_mm` | 1.0 | a tip so near to the goal has reached it [mm] |
    | `reward` | `"sparse"` (`"dense"` in TCAReachDense-v0) | which reward |
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

    def __init__(self, robot: Robot, success_mm: float = SUCCESS_MM, **shared: Any) -> None:
        super().__init__(robot, **shared)
        self.success_cm = check.scalar("success_mm", success_mm, 0.0, above=True) / 10.0
        bound = robot.bound_cm
        self.goal_space = spaces.Box(-bound, bound, (3,), np.float32)
        self.observation_space = self.observed([-bound] * 3, [bound] * 3)

    def sample(self, core: Core, generators: Sequence[np.random.Generator]) -> tuple[Array, Array]:
        """Return tips (N, 3) [cm] at steady temperatures of this task's split; there is no scene."""
        return steady_goals(self, core, generators), np.empty((len(generators), 0))

    def achieved(self, record: Record) -> Array:
        """Return what is compared with the goal (N, 3): tip position [cm]."""
        return 100.0 * record.tip[:, :3, 3]

    def observe(self, core: Core, achieved: Single, result: Single) -> None:
        """Write into `result` (N, 3) what a controller measures beside the heat: the tip."""
        result[:] = achieved

    def judge(self, achieved: NDArray[Any], desired: NDArray[Any], away: Array) -> Outcome:
        """Return the outcome of goals (..., 3)."""
        return Outcome(away <= self.success_cm, -away, {"distance_mm": 10.0 * away})

    def draw(self, record: Record, colour: str) -> Parts:
        """Return the goal, a ball of the success radius, and a pale one around it that can be seen from afar."""
        place = 1e-2 * record.goal[0]
        return {
            "goal": geometry.ball(place, 1e-2 * self.success_cm, colour, 0.9),
            "goal halo": geometry.ball(place, geometry.plate_radius(self.robot.arm), colour, 0.4),
        }
