"""What the speed-accuracy study asks of a method that solves for equilibrium."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, Equilibrium, Payload
from tca_envs.mechanics.arm import ZERO, ArrayOf3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class State:
    """What is asked of an arm: drives and loads.

    Parameters
    ----------
    arm : Arm
        The arm; methods take its modules and gravity, and no numerics.
    drive : (n,) array
        Temperature [degC] of a TCA, tension [N] of a tendon, rest length [m] of a spring.
    tip_force : (3,) tuple
        In the base frame [N].
    payload : Payload, optional
        What hangs from the tip instead of the arm's own payload.
    """

    arm: Arm
    drive: Array
    tip_force: ArrayOf3 = ZERO
    payload: Payload | None = None

    @cached_property
    def load(self) -> Array:
        """Everything that loads the arm, as the flat array of `kernels.LOAD` numbers."""
        return self.arm.load(self.tip_force, payload=self.payload)


class Answer(NamedTuple):
    """What a method says of a state."""

    converged: bool
    tip: Array
    """Pose of the tip (4, 4) [m]; not read where `converged` is False."""
    guess: Any
    """What `Solver.solve` can start the next solve from; None where `converged` is False."""


class Solver(Protocol):
    """A method at one setting, made ready for one arm."""

    def cold(self) -> Any:
        """Return the guess of a cold start: the unloaded arm."""

    def near(self, known: Equilibrium, state: State) -> Any:
        """Return a guess from a known equilibrium at `state` (as of `Arm.equilibrium`, on a fine grid)."""

    def solve(self, state: State, guess: Any) -> Answer:
        """Solve for the equilibrium at `state`; this is what is timed. It raises nothing on finite input."""


@dataclass(frozen=True)
class Method:
    """A way to solve for equilibrium, with its accuracy knob."""

    name: str
    """In legends and tables."""
    knob: str
    """What a setting is, such as "steps" or "rtol"."""
    settings: tuple[Any, ...]
    """From coarse to fine; each prints well."""
    build: Callable[[Arm, Any, Sequence[State]], Solver]
    """(arm, setting, states that it will meet) -> solver; compiles and tabulates. ValueError, with the reason, for an arm
    that it cannot model."""
    reduced: bool = False
    """Whether it solves a simpler model: then its error does not vanish, and a far answer is no failure."""
    own_limit: bool = False
    """Whether it solves another law of its own: then its error is also that against its own finest setting."""
    builds_slowly: bool = False
    """Whether `build` compiles for half a minute or more at each setting."""
    available: Callable[[], bool] = lambda: True
    """Whether the package that it needs is installed."""
