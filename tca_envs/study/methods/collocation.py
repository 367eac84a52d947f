"""The project's own solver on the speed-accuracy chart."""

from collections.abc import Sequence
from typing import NamedTuple

from tca_envs.mechanics import Arm, Equilibrium, discretise
from tca_envs.presets import STATES
from tca_envs.study.method import Answer, Method, State


class Collocation(NamedTuple):
    """`Arm.equilibrium` on one grid."""

    arm: Arm

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Equilibrium:
        """Return the equilibrium on this solver's grid."""
        return self.arm.equilibrium(state.drive, state.tip_force, start=known, payload=state.payload)

    def solve(self, state: State, guess: Equilibrium | None) -> Answer:
        """Solve for the equilibrium at `state`."""
        found = self.arm.equilibrium(state.drive, state.tip_force, start=guess, payload=state.payload)
        return Answer(found.converged, found.tip_pose, found if found.converged else None)


def build(arm: Arm, tolerance: float, states: Sequence[State]) -> Collocation:
    """Return the solver with the cheapest discretisation that keeps the tip within a tolerance [m] over the states."""
    some = states[:: -(-len(states) // STATES)]
    return Collocation(discretise(arm, tolerance, [s.drive for s in some], [s.load for s in some]))


METHOD = Method("strain collocation (this package)", "tolerance", (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9), build)
