"""The package's own solver on simpler physics: without weight, and without the muscles that nobody drives."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tca_envs.mechanics import Arm, Equilibrium
from tca_envs.study import effects
from tca_envs.study.method import Answer, Array, Method, State

TOLERANCE = 1e-6
"""Newton's, on the default grids: the numerical error is far below that of the physics."""


class Weightless(NamedTuple):
    """The arm where nothing weighs anything."""

    arm: Arm

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Equilibrium:
        """Return the known equilibrium."""
        return known

    def solve(self, state: State, guess: Equilibrium | None) -> Answer:
        """Solve for the weightless equilibrium at `state`."""
        found = self.arm.equilibrium(state.drive, state.tip_force, start=guess, payload=state.payload)
        return Answer(found.converged, found.tip_pose, found if found.converged else None)


class Known(NamedTuple):
    """An equilibrium, and which of the arm's muscles it has."""

    found: Equilibrium
    kept: tuple[bool, ...]


class Driven(NamedTuple):
    """The arm with only those muscles that pull by themselves: one arm for each set of them, made when it is met."""

    arm: Arm
    arms: dict[tuple[bool, ...], Arm]

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Known:
        """Return the known equilibrium without the muscles that do not pull at `state`."""
        kept = effects.active(self.arm, state.drive)
        return Known(effects.restricted(known, kept), tuple(kept.tolist()))

    def solve(self, state: State, guess: Known | None) -> Answer:
        """Solve for the equilibrium at `state` without the muscles that do not pull there."""
        kept, arm = self.at(state.drive)
        mask = np.array(kept, dtype=np.bool_)
        start = None
        if guess is not None and guess.kept == kept:
            start = guess.found
        elif guess is not None:
            whole = effects.extended(self.arm, guess.found, np.array(guess.kept, dtype=np.bool_))
            start = effects.restricted(whole, mask)
        found = arm.equilibrium(state.drive[mask], state.tip_force, start=start, payload=state.payload)
        return Answer(found.converged, found.tip_pose, Known(found, kept) if found.converged else None)

    def at(self, drive: Array) -> tuple[tuple[bool, ...], Arm]:
        """Return which muscles pull at a drive (n,), and the arm that has them alone."""
        mask = effects.active(self.arm, drive)
        kept = tuple(mask.tolist())
        if kept not in self.arms:
            self.arms[kept] = effects.with_muscles(self.arm, mask)
        return kept, self.arms[kept]


def _on_default_grids(arm: Arm) -> Arm:
    return Arm(arm.modules, arm.gravity, arm.payload, residual_tolerance=TOLERANCE)


def weightless(arm: Arm, setting: str, states: Sequence[State]) -> Weightless:
    """Return the solver of the weightless arm."""
    return Weightless(effects.without_gravity(_on_default_grids(arm)))


def driven(arm: Arm, setting: str, states: Sequence[State]) -> Driven:
    """Return the solver of the arm without muscles that nobody drives."""
    solver = Driven(_on_default_grids(arm), {})
    for state in states:
        solver.at(state.drive)
    return solver


METHODS = (
    Method("gravity off", "grid", ("default",), weightless, reduced=True),
    Method("passive muscles ignored", "grid", ("default",), driven, reduced=True),
)
