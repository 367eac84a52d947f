"""What the speed-accuracy study asks of a method that solves for equilibrium."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import Arm, Equilibrium, Payload, continuation
from tca_envs.mechanics.arm import ZERO
from tca_envs.mechanics.continuation import Lane, Lanes

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class State:
    """What is asked of an arm: drives and loads."""

    arm: Arm  # methods take its modules and gravity, and no numerics
    drive: Array  # (n,) temperature [degC] of a TCA, tension [N] of a tendon, rest length [m] of a spring
    tip_force: ArrayLike = ZERO  # in the base frame [N]
    payload: Payload | None = None  # what hangs from the tip instead of the arm's own payload

    @cached_property
    def load(self) -> Array:
        """Everything that loads the arm, as of `mechanics.loads`."""
        return self.arm.load(self.tip_force, payload=self.payload)

    def on(self, arm: Arm, start: Equilibrium | None = None) -> Equilibrium:
        """Return the equilibrium at this state of an arm on other grids."""
        return arm.equilibrium(self.drive, self.tip_force, start=start, payload=self.payload)


def lanes_at(known: Lane, count: int = 1) -> Lanes:
    """Return so many lanes at a known equilibrium; their tips and lengths are still to be set by a solver."""
    strain, tension, drive, load = (np.repeat(x[np.newaxis], count, axis=0) for x in known)
    return Lanes(strain, tension, drive, load, np.repeat(np.eye(4)[np.newaxis], count, axis=0), np.empty_like(tension))


def warm_call(arm: Arm, known: Lane, drive: Array, load: Array, count: int = 1) -> Callable[[], tuple[float, Any]]:
    """Return a call of the solver on so many lanes at a known equilibrium, as environments make it: time [s] and report."""
    asked, under = (np.repeat(x[np.newaxis], count, axis=0) for x in (drive, load))

    def call() -> tuple[float, Any]:
        lanes, begun = lanes_at(known, count), perf_counter()
        report = continuation.solve(arm, lanes, asked, under)
        return perf_counter() - begun, report

    return call


class Answer(NamedTuple):
    """What a method says of a state."""

    converged: bool
    tip: Array  # pose of the tip (4, 4) [m]; not read where `converged` is False
    guess: Any  # what `Solver.solve` can start the next solve from; None where `converged` is False


class Solver(Protocol):
    """A method at one setting, made ready for one arm."""

    def cold(self) -> Any:
        """Return the guess of a cold start: the unloaded arm."""

    def near(self, known: Equilibrium, state: State) -> Any:
        """Return a guess from a known equilibrium at `state` (as of `Arm.equilibrium`, on a fine grid)."""

    def solve(self, state: State, guess: Any) -> Answer:
        """Solve for the equilibrium at `state`; this is what is timed. It raises nothing on finite input."""


class Plain(NamedTuple):
    """`Arm.equilibrium` on an arm's grids."""

    arm: Arm
    tells: bool = False  # whether the guess of a failure is its result, which says why

    def cold(self) -> None:
        """Return the guess of a cold start."""
        return None

    def near(self, known: Equilibrium, state: State) -> Equilibrium:
        """Return the known equilibrium."""
        return known

    def solve(self, state: State, guess: Equilibrium | None) -> Answer:
        """Solve for the equilibrium at `state`."""
        found = state.on(self.arm, guess)
        return Answer(found.converged, found.tip_pose, found if found.converged or self.tells else None)


@dataclass(frozen=True)
class Method:
    """A way to solve for equilibrium, with its accuracy knob."""

    name: str  # in legends and tables
    knob: str  # what a setting is, such as "steps" or "rtol"
    settings: tuple[Any, ...]  # from coarse to fine; each prints well
    build: Callable[[Arm, Any, Sequence[State]], Solver]
    """(arm, setting, states that it will meet) -> solver; compiles and tabulates. ValueError, with the reason, for an arm
    that it cannot model."""
    reduced: bool = False  # whether it solves a simpler model: then its error does not vanish, and a far answer is no failure
    own_limit: bool = False
    """Whether it solves another law of its own: then its error is also that against its own finest setting."""
    builds_slowly: bool = False  # whether `build` compiles for half a minute or more at each setting
    available: Callable[[], bool] = lambda: True  # whether the package that it needs is installed
