"""What an answer is that is not the right one: another equilibrium, stable or not, or none at all.

An answer is an equilibrium where the reference solver, started from its shape, ends next to it. Methods that shoot or integrate
know moments and tensions; their strains follow from the balance of the sections.
"""

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from study.method import Answer, Array, State
from study.methods import bvp
from study.notation import routes
from study.reference import NoReference, reference
from study.shooting import quaternion_rate
from study.stability_cells import CONFIRMED
from tca_envs.mechanics import Arm, Equilibrium, continuation, loads, section
from tca_envs.mechanics.arm import pose

NEAR = 0.01  # tips that are closer than this, over the arm's length, are of one equilibrium
FARTHEST = 0.02
"""An answer whose tip is farther than this from the equilibrium that it leads to, over the arm's length, is none."""
STATES = 7  # quaternion and moment


class Outcome(IntEnum):
    """What a method makes of a cell."""

    RIGHT = 0
    OTHER = 1
    UNSTABLE = 2
    WRONG = 3
    NOTHING = 4


WORDS = {
    Outcome.RIGHT: "right branch, stable",
    Outcome.OTHER: "another stable equilibrium",
    Outcome.UNSTABLE: "an unstable equilibrium",
    Outcome.WRONG: "an answer that is no equilibrium",
    Outcome.NOTHING: "no answer",
}


def outcome(state: State, answer: Answer, right: Equilibrium | None, fine: Arm) -> Outcome:
    """Return what an answer to a state of an arm of one module is; `fine` is that arm on a fine grid."""
    if not answer.converged:
        return Outcome.NOTHING
    if right is not None and apart(state.arm, answer.tip, right.tip_pose) <= NEAR:
        # Close to a fold the unstable equilibrium may be as near; who knows the strains is asked.
        return Outcome.RIGHT if not isinstance(answer.guess, Equilibrium) or answer.guess.stable else Outcome.UNSTABLE
    try:
        near = shape(state, answer)
        found = reference(state, near, CONFIRMED)
        lane = continuation.Lane(near.sample(fine.node_arc)[1], near.tensions, state.drive, state.load)
        stability = continuation.smallest_eigenvalue(fine.problem, lane)
    except (NoReference, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return Outcome.WRONG
    if found.moved > FARTHEST * state.arm.length:
        return Outcome.WRONG
    if stability <= 0.0:
        return Outcome.UNSTABLE
    inaccurate = right is not None and apart(state.arm, found.tip, right.tip_pose) <= NEAR
    return Outcome.RIGHT if inaccurate else Outcome.OTHER


def apart(arm: Arm, tip: Array, other: Array) -> float:
    """Return the distance of two tips, poses (4, 4), over the arm's length."""
    return float(np.linalg.norm(tip[:3, 3] - other[:3, 3])) / arm.length


def shape(state: State, answer: Answer) -> Equilibrium:
    """Return the shape of an answer, as far as `reference` reads it."""
    guess: Any = answer.guess
    if isinstance(guess, Equilibrium):
        return guess
    if isinstance(guess, bvp.Guess):
        unit = bvp.build(state.arm, 1.0, ()).model.unit[0]
        scale = np.repeat([1.0, unit], [4, 3])[:, np.newaxis]
        carried: Callable[[float], Array] = CubicSpline(state.arm.length * guess.x, scale * guess.y[:STATES], axis=1)
    else:
        carried = integrated(state, guess.moment, guess.tension)

    def sample(s: Array) -> tuple[Array, Array]:
        rows = np.array([carried(at) for at in s])
        strains = [balanced(state, at, row, guess.tension) for at, row in zip(s, rows, strict=True)]
        return pose(rows[:, :4], np.zeros((len(s), 3))), np.array(strains)

    unloaded = state.arm.equilibrium(state.arm.unloaded()[2])
    return replace(unloaded, tip_pose=answer.tip, tensions=guess.tension, sample=sample)


def integrated(state: State, moment: Array, tension: Array) -> Callable[[float], Array]:
    """Return quaternion and moment (7,) along an arm as a function of s [m], from the moment at its base."""

    def rate(s: float, y: Array) -> Array:
        strain = balanced(state, s, y, tension)
        rotation = pose(y[:4], np.zeros(3))[:3, :3]
        return np.concatenate([quaternion_rate(y[:4], strain[:3]), np.cross(force(state, s), rotation @ strain[3:])])

    first = np.concatenate([[1.0, 0.0, 0.0, 0.0], moment])
    size = float(state.arm.modules[0].stiffness[0] / state.arm.length)
    absolute = np.repeat([1e-8, 1e-8 * size], [4, 3])
    answer = solve_ivp(rate, (0.0, state.arm.length), first, rtol=1e-8, atol=absolute, dense_output=True)
    if not answer.success:
        raise ArithmeticError(answer.message)
    return answer.sol


def force(state: State, s: float) -> Array:
    """Return the total force [N] at s [m], in the base frame."""
    load, module = state.load, state.arm.modules[0]
    mass = load[loads.MASS] + module.mass_per_length * (module.length - s)
    return load[loads.FORCE] + mass * load[loads.GRAVITY]


def balanced(state: State, s: float, row: Array, tension: Array) -> Array:
    """Return the strain (6,) at s [m] that carries the moment of a row (7,) of quaternion and moment."""
    module, rotation = state.arm.modules[0], pose(row[:4], np.zeros(3))[:3, :3]
    route = routes(module, np.array([s / module.length]))[0]
    wrench = np.concatenate([row[4:] @ rotation, force(state, s) @ rotation])
    return section.solve(module.stiffness, module.reference_strain, route, tension, wrench, module.reference_strain)
