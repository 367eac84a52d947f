"""The paper's own method, `shooting.equilibrium`, as it is and given a good start.

Sun & Zhao shoot from the strain at the base and the tensions. Cold, the plain method starts from the straight arm without
tension. Given a good start, it begins from what a model of piecewise constant strain says of the asked state, whose solve is
part of the time: some milliseconds, where the shooting takes a second. Both go on from their last answer, so they differ in
cold starts alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from study import shooting
from study.method import Answer, Array, Method, State
from study.methods import strain_basis
from tca_envs.mechanics import Arm, Equilibrium

RTOL = (1e-2, 1e-3, 1e-4, 1e-6, 1e-9)
PIECES = 16  # of each module, in the model that a good start comes from


class Shooting(NamedTuple):
    """The paper's method at one tolerance."""

    arm: Arm
    rtol: float
    sketch: tuple[strain_basis.Basis, Equilibrium] | None  # model that good cold starts come from, and the unloaded arm

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Equilibrium:
        """Return the known equilibrium: its strain at the base and its tensions are all that counts."""
        return known

    def solve(self, state: State, guess: Equilibrium | None) -> Answer:
        """Solve for the equilibrium at `state`."""
        start = _sketched(self.arm, *self.sketch, state) if guess is None and self.sketch is not None else guess
        found = shooting.equilibrium(self.arm, state.drive, state.tip_force, start=start, rtol=self.rtol, payload=state.payload)
        return Answer(found.converged, found.tip_pose, found if found.converged else None)


def _sketched(arm: Arm, sketch: strain_basis.Basis, unloaded: Equilibrium, state: State) -> Equilibrium | None:
    """Return what a model of piecewise constant strain says of a state, as far as shooting reads it; None if nothing."""
    answer = sketch.solve(state, sketch.cold())
    if not answer.converged:
        return None
    first, second = answer.guess.q[:2]
    base = arm.modules[0].reference_strain + 1.5 * first - 0.5 * second  # from the middle of the first pieces

    def sample(s: Array) -> tuple[Array, Array]:
        return np.tile(answer.tip, (s.size, 1, 1)), np.tile(base, (s.size, 1))

    return replace(unloaded, tip_pose=answer.tip, tensions=answer.guess.tension, sample=sample, nodes=None)


def plain(arm: Arm, rtol: float, states: Sequence[State]) -> Shooting:
    """Return the method as the paper has it."""
    return Shooting(arm, rtol, None)


def started(arm: Arm, rtol: float, states: Sequence[State]) -> Shooting:
    """Return the method with good cold starts."""
    unloaded = arm.equilibrium(arm.unloaded().drive)
    return Shooting(arm, rtol, (strain_basis.reduce(arm, strain_basis.ALL, PIECES, 0), unloaded))


METHODS = (
    Method("the paper's shooting", "rtol", RTOL, plain),
    Method("the paper's shooting, good start", "rtol", RTOL, started),
)
