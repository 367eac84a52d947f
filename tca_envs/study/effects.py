"""What an effect is worth: the same arm and state with it left out, and what can be left out of each scene."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs import presets
from tca_envs.mechanics import Arm, Equilibrium, Module, Payload
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.study.method import Array, State
from tca_envs.study.scenes import Case

STIFF = 1e6
"""What a stiffness is multiplied with to leave its strain out."""
COOL = 40.0
"""A TCA below this temperature [degC] hardly pulls by itself."""

# Functions of an arm are cached: equal questions are asked of the same arm object.


@lru_cache(maxsize=16)
def without_gravity(arm: Arm) -> Arm:
    """Return the arm where nothing weighs anything, its payload neither."""
    return Arm(arm.modules, payload=arm.payload, grids=arm.grids, residual_tolerance=arm.residual_tolerance)


@lru_cache(maxsize=16)
def without_shear(arm: Arm) -> Arm:
    """Return the arm with unshearable rods."""
    return _rebuilt(arm, [_stiffened(module, slice(3, 5)) for module in arm.modules])


@lru_cache(maxsize=16)
def without_extension(arm: Arm) -> Arm:
    """Return the arm with inextensible rods."""
    return _rebuilt(arm, [_stiffened(module, slice(5, 6)) for module in arm.modules])


def active(arm: Arm, drive: Array) -> NDArray[np.bool_]:
    """Return which muscles (n,) pull by themselves: tendons with a tension, others that would contract if they were free."""
    result = np.empty(drive.size, dtype=np.bool_)
    for i, (muscle, rest) in enumerate(zip(arm.muscles, arm.rest_lengths, strict=True)):
        law = muscle.law
        if law.kind == TENDON:
            result[i] = drive[i] > 0.0
        else:
            result[i] = elongation(law.kind, law.parameters()[np.newaxis], 0, rest, 0.0, drive[i])[0] < 0.0
    return result


def with_muscles(arm: Arm, kept: NDArray[np.bool_]) -> Arm:
    """Return the arm with those of its muscles (n,) that are `kept`."""
    keep = iter(kept)
    modules = [replace(module, muscles=[muscle for muscle in module.muscles if next(keep)]) for module in arm.modules]
    return _rebuilt(arm, modules)


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

    Parameters
    ----------
    arm : Arm
        Of at least two modules.
    payload : Payload, optional
        What hangs from the tip instead of the arm's own payload.

    Returns
    -------
    Payload
        Of the first module's end.
    (4, 4) array
        Pose of the arm's tip in the frame of the first module's end [m].
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


def _stiffened(module: Module, strains: slice) -> Module:
    stiffness = module.stiffness.copy()
    stiffness[strains] *= STIFF
    return replace(module, stiffness=stiffness)


def _rebuilt(arm: Arm, modules: list[Module]) -> Arm:
    return Arm(modules, arm.gravity, arm.payload, arm.grids, arm.residual_tolerance)


# What can be left out


class View(NamedTuple):
    """What a model is asked of a case."""

    before: State
    """Of the same arm as `now`, where a warm start comes from."""
    now: State
    point: Callable[[Equilibrium], Array] = lambda found: found.tip_pose
    """Equilibrium -> pose (4, 4) of the point that is compared [m]."""


class Effect(NamedTuple):
    """Something physical: warm cases of a scene as seen by a model without it and by one with it."""

    name: str
    without: Callable[[Case], View]
    complete: Callable[[Case], View]
    present: Callable[[State], bool] = lambda state: True
    """Whether the state has it at all."""

    def contained(self, case: Case) -> bool:
        """Return whether the case's arm is the model with the effect."""
        return self.complete(case).now.arm is case.state.arm


def _both(change: Callable[[State], State], point: Callable[[Equilibrium], Array] | None = None) -> Callable[[Case], View]:
    """Return what makes a view of a case whose two states are changed."""

    def view(case: Case) -> View:
        assert case.before is not None
        changed = View(change(case.before), change(case.state))
        return changed if point is None else changed._replace(point=point)

    return view


AS_IT_IS = _both(lambda state: state)


def _of(change: Callable[[Arm], Arm]) -> Callable[[Case], View]:
    return _both(lambda state: replace(state, arm=change(state.arm)))


def _pulling(state: State) -> NDArray[np.bool_]:
    return active(state.arm, state.drive)


def _warm(state: State) -> NDArray[np.bool_]:
    return np.asarray(state.drive >= COOL)


@lru_cache(maxsize=128)
def _with_muscles(arm: Arm, kept: tuple[bool, ...]) -> Arm:
    return with_muscles(arm, np.array(kept))


def _muscles(which: Callable[[State], NDArray[np.bool_]], name: str) -> Effect:
    """Return the effect of those muscles that are not `which` at the state that is asked for."""

    def without(case: Case) -> View:
        kept = which(case.state)
        arm = _with_muscles(case.state.arm, tuple(kept.tolist()))
        return _both(lambda state: replace(state, arm=arm, drive=state.drive[kept]))(case)

    return Effect(name, without, AS_IT_IS, lambda state: not which(state).all())


@lru_cache(maxsize=16)
def _first_module(arm: Arm) -> Arm:
    return Arm(arm.modules[:1], arm.gravity, None, arm.grids[:1], arm.residual_tolerance)


def _first_alone(state: State) -> State:
    first = _first_module(state.arm)
    return State(first, state.drive[: len(first.muscles)], state.tip_force, rigid_rest(state.arm, state.payload)[0])


def _rest_rigid(case: Case) -> View:
    """Return a view of the first module with the rest as a rigid body, which is not driven either."""
    tip = rigid_rest(case.state.arm)[1]
    return _both(_first_alone, lambda found: found.tip_pose @ tip)(case)


def _with_cold_helix(state: State) -> State:
    return State(presets.whole_arm(), np.append(state.drive, AMBIENT), state.tip_force)


def _end_of_bending(found: Equilibrium) -> Array:
    return found.poses([presets.BENDING_LENGTH])[0]


COMMON = (
    Effect("gravity", _of(without_gravity), AS_IT_IS),
    Effect("weight at the tip", _both(lambda state: replace(state, payload=Payload(0.0))), AS_IT_IS),
    _muscles(_pulling, "passive muscles"),
    _muscles(_warm, "cool muscles"),
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
    "reach": (*COMMON, Effect(COUPLING, AS_IT_IS, _both(_with_cold_helix, _end_of_bending))),
    "twist-align": (*COMMON, Effect(COUPLING, _rest_rigid, AS_IT_IS)),
    "pick-and-place": (*COMMON, OBJECT, Effect(COUPLING, _rest_rigid, AS_IT_IS)),
    "helix": COMMON,
}
"""Scene -> what is left out of it, one at a time."""
NAMES = (
    "gravity", "weight at the tip", "object's weight", "passive muscles", "cool muscles", "extension", "shear", COUPLING,
)  # fmt: skip
"""All effects, in the order of tables and figures."""
