"""The project's own solver on the speed-accuracy chart.

It is called as the environments call it, a batch of one without checks, like the other compiled methods on the chart;
`Arm.equilibrium` checks its arguments and builds a result on top of that.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from study.method import Answer, Method, State, lanes_at
from tca_envs.mechanics import Arm, Equilibrium, Rung, continuation, discretise
from tca_envs.mechanics.continuation import Lanes
from tca_envs.robots.robot import STATES


class Collocation(NamedTuple):
    """The package's solver of an arm on its grid; guesses are batches of one."""

    arm: Arm

    def cold(self) -> Lanes:
        """Return the guess of a cold start."""
        return lanes_at(self.arm.unloaded())

    def near(self, known: Equilibrium, state: State) -> Lanes:
        """Return the equilibrium on this solver's grid."""
        return lanes_at(self.arm.restart(known))

    def solve(self, state: State, guess: Lanes) -> Answer:
        """Solve for the equilibrium at `state`."""
        lanes = Lanes(*(x.copy() for x in guess))
        report = continuation.solve(self.arm, lanes, state.drive[np.newaxis], state.load[np.newaxis])
        found = bool(report["rung"][0] != Rung.FAILED)
        return Answer(found, lanes.tip[0], lanes if found else None)


def build(arm: Arm, tolerance: float, states: Sequence[State]) -> Collocation:
    """Return the solver with the cheapest discretisation that keeps the tip within a tolerance [m] over the states."""
    some = states[:: -(-len(states) // STATES)]
    return Collocation(discretise(arm, tolerance, [s.drive for s in some], [s.load for s in some]))


METHOD = Method("strain collocation (this package)", "tolerance", (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9), build)
