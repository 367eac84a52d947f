"""The package's own solver on simpler physics: without weight, and without the muscles that nobody drives."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from study import effects
from study.method import Answer, Method, Plain, State
from tca_envs.mechanics import Arm, Equilibrium

TOLERANCE = 1e-6  # Newton's, on the default grids: the numerical error is far below that of the physics


class Known(NamedTuple):
    """An equilibrium, and which of the arm's muscles it has."""

    found: Equilibrium
    kept: NDArray[np.bool_]


class Driven(NamedTuple):
    """The arm with only those muscles that pull by themselves: one arm for each set of them."""

    arm: Arm

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Known:
        """Return the known equilibrium without the muscles that do not pull at `state`."""
        kept = effects.active(self.arm, state.drive)
        return Known(effects.restricted(known, kept), kept)

    def solve(self, state: State, guess: Known | None) -> Answer:
        """Solve for the equilibrium at `state` without the muscles that do not pull there."""
        kept, start = effects.active(self.arm, state.drive), None
        if guess is not None:
            start = guess.found
            if not np.array_equal(guess.kept, kept):
                start = effects.restricted(effects.extended(self.arm, start, guess.kept), kept)
        arm = effects.with_muscles(self.arm, kept)
        found = arm.equilibrium(state.drive[kept], state.tip_force, start=start, payload=state.payload)
        return Answer(found.converged, found.tip_pose, Known(found, kept) if found.converged else None)


def _on_default_grids(arm: Arm) -> Arm:
    return Arm(arm.modules, arm.gravity, arm.payload, residual_tolerance=TOLERANCE)


def weightless(arm: Arm, setting: str, states: Sequence[State]) -> Plain:
    """Return the solver of the weightless arm."""
    return Plain(effects.without_gravity(_on_default_grids(arm)))


def driven(arm: Arm, setting: str, states: Sequence[State]) -> Driven:
    """Return the solver of the arm without muscles that nobody drives."""
    solver = Driven(_on_default_grids(arm))
    for state in states:  # makes their arms
        effects.with_muscles(solver.arm, effects.active(solver.arm, state.drive))
    return solver


METHODS = (
    Method("gravity off", "grid", ("default",), weightless, reduced=True),
    Method("passive muscles ignored", "grid", ("default",), driven, reduced=True),
)
