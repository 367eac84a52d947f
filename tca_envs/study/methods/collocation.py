"""The project's own solver on the speed-accuracy chart.

It is called as the environments call it, a batch of one without checks, like the other compiled methods on the chart;
`Arm.equilibrium` checks its arguments and builds a result on top of that.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tca_envs.mechanics import Arm, Equilibrium, discretise, ladder
from tca_envs.mechanics.kernels import FAILED, REPORT
from tca_envs.presets import STATES
from tca_envs.study.method import Answer, Array, Method, State

UNIT = np.eye(4)[np.newaxis]


class Lane(NamedTuple):
    """A known equilibrium as a batch of one."""

    strain: Array
    """(1, G, 6)."""
    tension: Array
    """(1, n) [N]."""
    drive: Array
    """(1, n)."""
    load: Array
    """(1, LOAD)."""


class Collocation(NamedTuple):
    """The ladder of an arm on its grid."""

    arm: Arm

    def cold(self) -> Lane:
        """Return the guess of a cold start."""
        strain, tension, drive, load = self.arm.unloaded()
        return Lane(strain[np.newaxis], tension[np.newaxis], drive[np.newaxis], load[np.newaxis])

    def near(self, known: Equilibrium, state: State) -> Lane:
        """Return the equilibrium on this solver's grid."""
        strain, tension, drive, load = self.arm.restart(known)
        return Lane(strain[np.newaxis], tension[np.newaxis], drive[np.newaxis], load[np.newaxis])

    def solve(self, state: State, guess: Lane) -> Answer:
        """Solve for the equilibrium at `state`."""
        strain, tension, drive, load = guess.strain.copy(), guess.tension.copy(), guess.drive.copy(), guess.load.copy()
        tip, lengths, report = UNIT.copy(), np.empty_like(drive), np.empty((1, REPORT))
        asked = (state.drive[np.newaxis], state.load[np.newaxis])
        ladder.solve(self.arm, strain, tension, drive, load, *asked, tip, lengths, report)
        found = report[0, 0] != FAILED
        return Answer(bool(found), tip[0], Lane(strain, tension, drive, load) if found else None)


def build(arm: Arm, tolerance: float, states: Sequence[State]) -> Collocation:
    """Return the solver with the cheapest discretisation that keeps the tip within a tolerance [m] over the states."""
    some = states[:: -(-len(states) // STATES)]
    return Collocation(discretise(arm, tolerance, [s.drive for s in some], [s.load for s in some]))


METHOD = Method("strain collocation (this package)", "tolerance", (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9), build)
