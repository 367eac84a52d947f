"""What an effect is worth: the same arm and state with it left out."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, Equilibrium, Module, Payload
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.study.method import Array, State

STIFF = 1e6
"""What a stiffness is multiplied with to leave its strain out."""


def without_gravity(arm: Arm) -> Arm:
    """Return the arm where nothing weighs anything, its payload neither."""
    return Arm(arm.modules, payload=arm.payload, grids=arm.grids, residual_tolerance=arm.residual_tolerance)


def without_shear(arm: Arm) -> Arm:
    """Return the arm with unshearable rods."""
    return _rebuilt(arm, [_stiffened(module, slice(3, 5)) for module in arm.modules])


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


def without_passive(arm: Arm, drive: Array) -> tuple[Arm, NDArray[np.bool_]]:
    """Return the arm without the muscles that do not pull by themselves at a drive (n,), and which are kept (n,)."""
    kept = active(arm, drive)
    return with_muscles(arm, kept), kept


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


def uncoupled(arm: Arm, payload: Payload | None = None) -> tuple[Arm, ...]:
    """Return each module on its own, its base upright, with all beyond it as a rigid body in its unloaded shape.

    Parameters
    ----------
    arm : Arm
        The arm.
    payload : Payload, optional
        What hangs from the tip instead of the arm's own payload.
    """
    hanging = payload or arm.payload or Payload(0.0)
    alone: list[Arm] = []
    for k in range(len(arm.modules) - 1, -1, -1):
        module, grid = arm.modules[k], arm.grids[k]
        alone.append(Arm([module], arm.gravity, hanging, [grid], arm.residual_tolerance))
        # Weigh the module and pass it on: its centre and that of what hangs from it, seen from its base.
        straight = Arm([replace(module, muscles=())], grids=[grid]).equilibrium([])
        points, weights = np.polynomial.legendre.leggauss(16)
        own = 0.5 * weights @ straight.poses(0.5 * (points + 1.0) * module.length)[:, :3, 3]
        far = (straight.tip_pose @ [*hanging.centre, 1.0])[:3]
        mass = module.mass_per_length * module.length
        total = mass + hanging.mass
        x, y, z = ((mass * own + hanging.mass * far) / total if total > 0.0 else far).tolist()
        hanging = Payload(total, (x, y, z))
    return tuple(reversed(alone))


def _stiffened(module: Module, strains: slice) -> Module:
    stiffness = module.stiffness.copy()
    stiffness[strains] *= STIFF
    return replace(module, stiffness=stiffness)


def _rebuilt(arm: Arm, modules: list[Module]) -> Arm:
    return Arm(modules, arm.gravity, arm.payload, arm.grids, arm.residual_tolerance)


def _tip_of(change: Callable[[Arm], Arm]) -> Callable[[Arm, State, Equilibrium], Array]:
    """Return the tip's pose in an arm that is changed."""

    def tip(arm: Arm, state: State, known: Equilibrium) -> Array:
        return _pose(change(arm).equilibrium(state.drive, state.tip_force, start=known, payload=state.payload))

    return tip


def _tip_without_passive(arm: Arm, state: State, known: Equilibrium) -> Array:
    other, kept = without_passive(arm, state.drive)
    start = restricted(known, kept)
    return _pose(other.equilibrium(state.drive[kept], state.tip_force, start=start, payload=state.payload))


def _tip_uncoupled(arm: Arm, state: State, known: Equilibrium) -> Array:
    """Return the product of the modules' own tip poses; each feels the tip force at the end of the unloaded rest."""
    result, beyond, first = np.eye(4), arm.length, 0
    for module, alone in zip(arm.modules, uncoupled(arm, state.payload), strict=True):
        beyond -= module.length
        muscles = slice(first, first + len(module.muscles))
        moment = np.cross([0.0, 0.0, beyond], state.tip_force)
        result = result @ _pose(alone.equilibrium(state.drive[muscles], state.tip_force, moment))
        first = muscles.stop
    return result


def _pose(found: Equilibrium) -> Array:
    return found.tip_pose if found.converged else np.full((4, 4), np.nan)


LEFT_OUT: dict[str, Callable[[Arm, State, Equilibrium], Array]] = {
    "gravity": _tip_of(without_gravity),
    "shear": _tip_of(without_shear),
    "extension": _tip_of(without_extension),
    "passive muscles": _tip_without_passive,
    "module coupling": _tip_uncoupled,
}
"""(arm, state, equilibrium of this arm at this state) -> the tip's pose (4, 4) without the effect; nan where there is none.

The arm is the state's, on a grid of the caller's choice."""
