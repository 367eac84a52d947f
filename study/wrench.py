"""Compiled kernels: the rod's equilibrium as an initial value problem in the total wrench, by explicit Runge-Kutta steps.

The total internal wrench of rod and muscles feels external loads only, so the force n(s) is known beforehand, the moment
follows m' = -p' x n, and the strain is that which carries the wrench: at every stage six algebraic equations, solved by
`notation.settle` from the strain of the stage before. Integrated are the quaternion (eq. (28)), the position, the moment in the
base frame and the path lengths of a module's muscles: no derivative of the strain, and no rule for joints, for all of these are
continuous there. It shares arm and muscle laws with `Arm.equilibrium` and no numerics.

Indices: k module, c muscle of the module, i stage. A station is where a stage of a step evaluates.
"""

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from study.notation import (  # isort: skip
    Array, Integers, carried, carries, copy6, kernel, put, put_quat, quat, quat1, settle, stations, vec, vec1,
)  # fmt: skip
from tca_envs.mechanics import Arm, compiled
from tca_envs.mechanics.solver.simd import cross, dot, product, rotation, transpose

# A state is (STATE + m,): quaternion, position [m] and moment [N m] in the base frame, path lengths [m] since it was set to 0.
STATE = 10


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method."""

    a: Array  # (S, S)
    b: Array  # (S,)
    c: Array  # (S,)


RK4 = Tableau(
    np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
    np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
    np.array([0.0, 0.5, 0.5, 1.0]),
)  # The classic method of order 4
RK8 = Tableau(*(np.ascontiguousarray(x) for x in (DOP853.A, DOP853.B, DOP853.C)))
"""The method of order 8 and 12 stages of Dormand and Prince, with fixed steps."""


class Rod(NamedTuple):
    """How an arm of M modules is integrated: S stages, T stations, at most m muscles in a module."""

    steps: Integers  # (M,) steps of each module
    route: Array  # (T, m, 4) muscle position x, y [m] and its derivative in s
    mass_beyond: Array  # (T,) mass of the arm beyond each station [kg]
    a: Array  # (S, S) Runge-Kutta coefficients
    b: Array  # (S,) weights
    c: Array  # (S,) stages' places in a step
    settled: float  # as in `settle`


def rod(arm: Arm, tableau: Tableau, steps: Sequence[int], settled: float) -> Rod:
    """Return how to integrate an arm by `march` with so many steps in each module."""
    fractions = [((np.arange(count)[:, np.newaxis] + tableau.c) / count).ravel() for count in steps]
    return Rod(np.array(steps, dtype=np.int64), *stations(arm, fractions), *tableau, settled)


class Scratch(NamedTuple):
    """Arrays that `march` works with; C columns of the tangent."""

    strain: Array  # (6,)
    past: Array  # (6,)
    pull: Array  # (m, 6) [r x t; t] of each muscle, body frame
    rates: Array  # (S, STATE + m)
    tangent_rates: Array  # (S, C (6 + m))


@compiled
def scratch(rod, columns):
    """Return a `Scratch` for a tangent of so many columns."""
    stages, m = rod.b.size, rod.route.shape[1]
    rates = np.empty((stages, STATE + m)), np.empty((stages, columns * (6 + m)))
    return Scratch(np.empty(6), np.empty(6), np.empty((m, 6)), rates[0], rates[1])


@kernel
def march(arm, rod, k, station, steps, tension, load, state, base, columns, driven, tangent, ws):
    """Integrate over steps of one module, in place; False where a section has no strain that carries its wrench.

    The tangent is that of the differential equations, integrated along: where the rotation changes by phi, the moment by dm and
    tensions by dF, phi' = R du and dm' = n x dp' with dp' = phi x p' + R dv, and H [du; dv] is the change of the wrench,
    [R^T (dm - phi x m); R^T (n x phi)], less dF c.

    `steps` steps of module `k` begin at a station; `state` (STATE + m,) becomes that after them, and `base` (6,), near the
    strain at the first station, that strain. So many `columns` of `tangent` (C, 6 + m), changes of rotation, moment and path
    lengths that go with a unit of something, become those after the steps; `driven` (n,) says which row belongs to each
    tension, -1 for none.
    """
    b, strain, past, rates, tangent_rates = rod.b, ws.strain, ws.past, ws.rates, ws.tangent_rates
    first, last = arm.first_muscle[k], arm.first_muscle[k + 1]
    h, wide = arm.length[k] / rod.steps[k], tangent.shape[1]
    copy6(strain, base)
    copy6(past, base)
    here = before = 0.0
    for step in range(steps):
        for i in range(b.size):
            q, m = quat1(state, 0), vec1(state, 7)
            for j in range(i):
                d = h * rod.a[i, j]
                if d != 0.0:
                    q, m = q + d * quat(rates, j, 0), m + d * vec(rates, j, 7)
            # The strain is guessed on the line through those of the two places before.
            there = step + rod.c[i]
            if there != here:
                ahead = (there - here) / (here - before) if here != before else 0.0
                before, here = here, there
                for l in range(6):
                    now = strain[l]
                    strain[l] += ahead * (now - past[l])
                    past[l] = now
            n, r = carries(load, rod.mass_beyond[station]), rotation(q)
            back = transpose(r)
            ok, flexibility, gain, softness = settle(
                arm, k, rod.route, station, tension, back @ m, back @ n, strain, rod.settled, inf, rates[i, STATE:], ws.pull
            )  # fmt: skip
            if not ok:
                return False
            if step == 0 and i == 0:
                copy6(base, strain)
            t = r @ vec1(strain, 3)
            put_quat(rates, i, 0, product(q, 0.5 * vec1(strain, 0)))
            put(rates, i, 4, t)
            put(rates, i, 7, cross(n, t))
            for l in range(columns):
                phi, dm = vec(tangent, l, 0), vec(tangent, l, 3)
                for j in range(i):
                    d = h * rod.a[i, j]
                    if d != 0.0:
                        at = l * wide
                        phi, dm = phi + d * vec(tangent_rates, j, at), dm + d * vec(tangent_rates, j, at + 3)
                moment, force = back @ (dm - cross(phi, m)), back @ cross(n, phi)
                for c in range(last - first):
                    if driven[first + c] == l:
                        moment, force = moment - vec(ws.pull, c, 0), force - vec(ws.pull, c, 3)
                bend, shear = carried(flexibility, gain, softness, moment, force)
                put(tangent_rates, i, l * wide, r @ bend)
                put(tangent_rates, i, l * wide + 3, cross(n, cross(phi, t) + r @ shear))
                for c in range(last - first):
                    tangent_rates[i, l * wide + 6 + c] = dot(vec(ws.pull, c, 0), bend) + dot(vec(ws.pull, c, 3), shear)
            station += 1
        for i in range(b.size):
            for l in range(STATE + last - first):
                state[l] += h * b[i] * rates[i, l]
            for l in range(columns):
                for c in range(6 + last - first):
                    tangent[l, c] += h * b[i] * tangent_rates[i, l * wide + c]
    return True
