"""What an effect is worth: the same arm and state with it left out, and what can be left out of each scene."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from study.method import Array, State
from study.notation import TENDON, mismatch_of
from study.scenes import Case
from tca_envs.mechanics import Arm, Equilibrium, Module, Payload
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import paper

STIFF = 1e6  # what a stiffness is multiplied with to leave its strain out
COOL = 40.0  # a TCA below this temperature [degC] hardly pulls by itself

# Functions of an arm are cached: equal questions are asked of the same arm object.


def _rebuilt(arm: Arm, modules: Sequence[Module]) -> Arm:
    return Arm(modules, arm.gravity, arm.payload, arm.grids, arm.residual_tolerance)


@lru_cache(maxsize=16)
def without_gravity(arm: Arm) -> Arm:
    """Return the arm where nothing weighs anything, its payload neither."""
    return Arm(arm.modules, payload=arm.payload, grids=arm.grids, residual_tolerance=arm.residual_tolerance)


@lru_cache(maxsize=32)
def stiffened(arm: Arm, first: int, last: int) -> Arm:
    """Return the arm whose rods have no strains of these numbers, first to last - 1."""
    factor = np.where((np.arange(6) >= first) & (np.arange(6) < last), STIFF, 1.0)
    return _rebuilt(arm, [replace(module, stiffness=factor * module.stiffness) for module in arm.modules])


without_shear = partial(stiffened, first=3, last=5)
without_extension = partial(stiffened, first=5, last=6)


def active(arm: Arm, drive: Array) -> NDArray[np.bool_]:
    """Return which muscles (n,) pull by themselves: tendons with a tension, others that would contract if they were free."""
    kinds, rest = arm.model.kind, arm.model.rest_length
    free = [drive[i] if k == TENDON else mismatch_of(arm.model, i, rest[i], 0.0, drive[i])[0] for i, k in enumerate(kinds)]
    return np.array(free, dtype=float) > 0.0


@lru_cache(maxsize=128)
def _with_muscles(arm: Arm, kept: tuple[bool, ...]) -> Arm:
    keep = iter(kept)
    modules = [replace(module, muscles=[muscle for muscle in module.muscles if next(keep)]) for module in arm.modules]
    return _rebuilt(arm, modules)


def with_muscles(arm: Arm, kept: NDArray[np.bool_]) -> Arm:
    """Return the arm with those of its muscles (n,) that are `kept`."""
    return _with_muscles(arm, tuple(kept.tolist()))


def restricted(known: Equilibrium, kept: NDArray[np.bool_]) -> Equilibrium:
    """Return a start for the arm `with_muscles(arm, kept)` from an equilibrium of the whole one."""
    drive, load = known.known
    return replace(known, tensions=known.tensions[kept], drive=known.drive[kept], known=(drive[kept], load), nodes=None)


def extended(arm: Arm, found: Equilibrium, kept: NDArray[np.bool_]) -> Equilibrium:
    """Return a start for an arm from an equilibrium of `with_muscles(arm, kept)`: the other muscles carry nothing."""
    _, tension, neutral, _ = arm.unloaded()
    drive, load = found.known
    tension[kept], neutral[kept] = found.tensions, drive
    return replace(found, tensions=tension, drive=neutral, known=(neutral, load), nodes=None)


@lru_cache(maxsize=64)
def rigid_rest(arm: Arm, payload: Payload | None = None) -> tuple[Payload, Array]:
    """Return all that hangs from an arm's first module as a rigid body in its unloaded shape, and where the tip is on it.

    That is the payload of the first module's end, and the pose (4, 4) of the arm's tip in the frame of that end [m].
    """
    hanging = payload or arm.payload or Payload(0.0)
    rest = Arm([replace(module, muscles=()) for module in arm.modules[1:]])
    shape = rest.equilibrium([])
    points, weights = np.polynomial.legendre.leggauss(16)
    mass, base = hanging.mass, 0.0
    moment = mass * (shape.tip_pose @ [*hanging.centre, 1.0])[:3]
    for module in rest.modules:
        own = module.mass_per_length * module.length
        moment += own * 0.5 * weights @ shape.poses(base + 0.5 * (points + 1.0) * module.length)[:, :3, 3]
        mass, base = mass + own, base + module.length
    x, y, z = (moment / mass).tolist() if mass > 0.0 else (0.0, 0.0, 0.0)
    return Payload(mass, (x, y, z)), shape.tip_pose


# What can be left out


def _tip(found: Equilibrium) -> Array:
    return found.tip_pose


class View(NamedTuple):
    """What a model is asked of a case."""

    before: State  # of the same arm as `now`, where a warm start comes from
    now: State
    point: Callable[[Equilibrium], Array]  # equilibrium -> pose (4, 4) of the point that is compared [m]


class Effect(NamedTuple):
    """Something physical: warm cases of a scene as seen by a model without it and by one with it."""

    name: str
    without: Callable[[Case], View]
    complete: Callable[[Case], View]
    present: Callable[[State], bool] = lambda state: True  # whether the state has it at all

    def contained(self, case: Case) -> bool:
        """Return whether the case's arm is the model with the effect."""
        return self.complete(case).now.arm is case.state.arm


def _both(change: Callable[[State], State], point: Callable[[Equilibrium], Array] = _tip) -> Callable[[Case], View]:
    """Return what makes a view of a case whose two states are changed."""

    def view(case: Case) -> View:
        assert case.before is not None
        return View(change(case.before), change(case.state), point)

    return view


AS_IT_IS = _both(lambda state: state)


def _of(change: Callable[[Arm], Arm]) -> Callable[[Case], View]:
    return _both(lambda state: replace(state, arm=change(state.arm)))


def _muscles(which: Callable[[State], NDArray[np.bool_]], name: str) -> Effect:
    """Return the effect of those muscles that are not `which` at the state that is asked for."""

    def without(case: Case) -> View:
        kept = which(case.state)
        arm = with_muscles(case.state.arm, kept)
        return _both(lambda state: replace(state, arm=arm, drive=state.drive[kept]))(case)

    return Effect(name, without, AS_IT_IS, lambda state: not which(state).all())


_first_module = lru_cache(maxsize=16)(
    lambda arm: Arm(arm.modules[:1], arm.gravity, None, arm.grids[:1], arm.residual_tolerance)
)


def _rest_rigid(case: Case) -> View:
    """Return a view of the first module with the rest as a rigid body, which is not driven either."""
    first, tip = _first_module(case.state.arm), rigid_rest(case.state.arm)[1]

    def alone(state: State) -> State:
        return State(first, state.drive[: len(first.muscles)], state.tip_force, rigid_rest(state.arm, state.payload)[0])

    return _both(alone, lambda found: found.tip_pose @ tip)(case)


_with_cold_helix = _both(
    lambda state: State(paper.whole_arm(), np.append(state.drive, AMBIENT), state.tip_force),
    lambda found: found.poses([paper.BENDING_LENGTH])[0],
)


COMMON = (
    Effect("gravity", _of(without_gravity), AS_IT_IS),
    Effect("weight at the tip", _both(lambda state: replace(state, payload=Payload(0.0))), AS_IT_IS),
    _muscles(lambda state: active(state.arm, state.drive), "passive muscles"),
    _muscles(lambda state: np.asarray(state.drive >= COOL), "cool muscles"),
    Effect("extension", _of(without_extension), AS_IT_IS),
    Effect("shear", _of(without_shear), AS_IT_IS),
)
OBJECT = Effect(
    "object's weight",
    _both(lambda state: replace(state, payload=None)),
    AS_IT_IS,
    lambda state: state.payload is not None and state.payload != state.arm.payload,
)
COUPLING = "module coupling"
EFFECTS: dict[str, tuple[Effect, ...]] = {
    "reach": (*COMMON, Effect(COUPLING, AS_IT_IS, _with_cold_helix)),
    "twist-align": (*COMMON, Effect(COUPLING, _rest_rigid, AS_IT_IS)),
    "pick-and-place": (*COMMON, OBJECT, Effect(COUPLING, _rest_rigid, AS_IT_IS)),
    "helix": COMMON,
}  # Scene -> what is left out of it, one at a time
NAMES = (
    "gravity", "weight at the tip", "object's weight", "passive muscles", "cool muscles", "extension", "shear", COUPLING,
)  # fmt: skip
"""All effects, in the order of tables and figures."""
