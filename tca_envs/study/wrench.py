"""Compiled kernels: the rod's equilibrium as an initial value problem in the total wrench, by explicit Runge-Kutta steps.

The total internal wrench of rod and muscles feels external loads only, so the force n(s) is known beforehand, the moment
follows m' = -p' x n, and the strain is that which carries the wrench: at every stage six algebraic equations,
K (xi - xi*) + sum_i F_i [r_i x t_i; t_i] = R^T [m; n], solved by Newton from the strain of the stage before. Integrated are the
quaternion (eq. (28)), the position, the moment in the base frame and the path lengths of a module's muscles: no derivative of
the strain, and no rule for joints, for all of these are continuous there.

It shares arm and muscle laws with `tca_envs.mechanics.collocation` and no numerics.

Indices: k module, c muscle of the module, i stage. A station is where a stage of a step evaluates.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import DOP853

from tca_envs.mechanics import Arm, Module
from tca_envs.mechanics.algebra import (
    INNER,
    ORIGIN,
    apply,
    apply_transposed,
    axpy,
    axpy9,
    cross,
    dot,
    get3,
    inner,
    inverse,
    matmul,
    outer,
    put3,
    quaternion_rate,
    rotation_matrix,
    scalar_matrix,
    transpose,
)
from tca_envs.mechanics.kernels import PAYLOAD_MASS

Array = NDArray[np.float64]

MAX_SETTLE = 25
"""Newton iterations of a section; two or three are usual."""

# A state is (STATE + m,): quaternion, position [m] and moment [N m] in the base frame, path lengths [m] since it was set to 0.
STATE = 10


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method."""

    a: Array
    """(S, S)."""
    b: Array
    """(S,)."""
    c: Array
    """(S,)."""


RK4 = Tableau(
    np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
    np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
    np.array([0.0, 0.5, 0.5, 1.0]),
)
"""The classic method of order 4."""
RK8 = Tableau(*(np.ascontiguousarray(x) for x in (DOP853.A, DOP853.B, DOP853.C)))
"""The method of order 8 and 12 stages of Dormand and Prince, with fixed steps."""


class Rod(NamedTuple):
    """An arm and its stations as plain arrays: M modules, n muscles, at most m in a module, S stages, T stations."""

    steps: NDArray[np.int64]  # (M,) steps of each module
    length: Array  # (M,) [m]
    stiffness: Array  # (M, 6) diagonal of K
    reference: Array  # (M, 6) xi*
    first_muscle: NDArray[np.int64]  # (M + 1,)
    route: Array  # (T, m, 4) muscle position x, y [m] and its derivative in s
    mass_below: Array  # (T,) mass of the arm beyond each station [kg]
    a: Array  # (S, S) Runge-Kutta coefficients
    b: Array  # (S,) weights
    c: Array  # (S,) stages' places in a step
    kind: NDArray[np.int64]  # (n,) kind of muscle law
    parameters: Array  # (n, PARAMETERS) of muscle law
    rest_length: Array  # (n,) [m]
    settled: float  # a section's Newton takes its last step when |moment imbalance| L/K and |force imbalance|/K are below this


def rod(arm: Arm, tableau: Tableau, steps: Sequence[int], settled: float) -> Rod:
    """Return an arm made ready for `march`.

    Parameters
    ----------
    arm : Arm
        The arm.
    tableau : Tableau
        The Runge-Kutta method.
    steps : sequence of int
        Number of steps of each module.
    settled : float
        Dimensionless imbalance of a section below which one more Newton step, which squares it, ends its solve.
    """
    modules = arm.modules
    most_muscles = max(len(module.muscles) for module in modules)
    routes, masses = [], []
    for k, (module, count) in enumerate(zip(modules, steps, strict=True)):
        fraction = ((np.arange(count)[:, np.newaxis] + tableau.c) / count).ravel()
        route = np.zeros((fraction.size, most_muscles, 4))
        for i, muscle in enumerate(module.muscles):
            route[:, i] = [module.route(muscle, x) for x in fraction]
        routes.append(route)
        beyond = sum(m.mass_per_length * m.length for m in modules[k + 1 :])
        masses.append(beyond + module.mass_per_length * module.length * (1.0 - fraction))
    return Rod(
        steps=np.array(steps, dtype=np.int64),
        length=np.array([module.length for module in modules]),
        stiffness=np.array([module.stiffness for module in modules]),
        reference=np.array([module.reference_strain for module in modules]),
        first_muscle=np.cumsum([0] + [len(module.muscles) for module in modules]).astype(np.int64),
        route=np.concatenate(routes),
        mass_below=np.concatenate(masses),
        a=tableau.a,
        b=tableau.b,
        c=tableau.c,
        kind=arm.model.kind,
        parameters=arm.model.parameters,
        rest_length=arm.rest_lengths,
        settled=settled,
    )


def moment_unit(arm: Arm) -> float:
    """Return the moment that bends the arm by about a radian, EI/L of its softest module [N m]."""
    return min(float(module.stiffness[:3].min()) for module in arm.modules) / arm.length


def wrench(module: Module, fraction: float, strain: Array, tension: Array) -> Array:
    """Return the total internal wrench (6,) [m; n] of rod and muscles in the body frame, from a section's strain."""
    result = module.stiffness * (strain - module.reference_strain)
    for muscle, force in zip(module.muscles, tension, strict=True):
        x, y, dx, dy = module.route(muscle, fraction)
        r = np.array([x, y, 0.0])
        path = strain[3:] + np.cross(strain[:3], r) + np.array([dx, dy, 0.0])
        t = path / np.linalg.norm(path)
        result += force * np.concatenate([np.cross(r, t), t])
    return result


class Scratch(NamedTuple):
    """Arrays that `march` works with; C columns of the tangent."""

    strain: Array  # (6,)
    past: Array  # (6,)
    pull: Array  # (m, 6) [r x t; t] of each muscle, body frame
    rates: Array  # (S, STATE + m)
    tangent_rates: Array  # (S, C, 6 + m)


@inner
def scratch(rod, columns):
    """Return a `Scratch` for a tangent of so many columns."""
    stages, m = rod.b.size, rod.route.shape[1]
    return Scratch(
        np.empty(6), np.empty(6), np.empty((m, 6)), np.empty((stages, STATE + m)), np.empty((stages, columns, 6 + m))
    )


@njit(forceinline=True, **INNER)  # a call would copy all of `rod`
def settle(rod, k, station, tension, moment, force, strain, stretch, pull):
    """Find the strain that carries a wrench, by Newton, in place.

    The muscles' forces derive from sum F_i |p_i'|, so with B = [-[r], 1] and c = [r x t; t] the derivative is
    H = K + sum F_i/|p_i'| (B^T B - c c^T), symmetric, positive definite for F >= 0. It is split into 3 x 3 blocks.

    Parameters
    ----------
    rod : Rod
        The arm.
    k, station : int
        Module and station.
    tension : (n,) array
        Tensions [N].
    moment, force : tuple
        The wrench in the body frame.
    strain : (6,) array
        In: first guess; out: the strain, where there is one.
    stretch : (>= m,) array
        Out: |p_i'| of the module's muscles.
    pull : (m, 6) array
        Out: their c.

    Returns
    -------
    tuple
        Whether Newton got there; H_vv^-1; H_uv H_vv^-1; (H_uu - H_uv H_vv^-1 H_vu)^-1: with them, H x = y is solved.
    """
    stiffness, reference, route, length = rod.stiffness, rod.reference, rod.route, rod.length[k]
    i0, mk = rod.first_muscle[k], rod.first_muscle[k + 1] - rod.first_muscle[k]
    u, v = (strain[0], strain[1], strain[2]), (strain[3], strain[4], strain[5])
    ku, kv = get3(stiffness, k, 0), get3(stiffness, k, 3)
    u0, v0 = get3(reference, k, 0), get3(reference, k, 3)
    flexibility = gain = softness = scalar_matrix(0.0)
    for _ in range(MAX_SETTLE):
        ru = (ku[0] * (u[0] - u0[0]) - moment[0], ku[1] * (u[1] - u0[1]) - moment[1], ku[2] * (u[2] - u0[2]) - moment[2])
        rv = (kv[0] * (v[0] - v0[0]) - force[0], kv[1] * (v[1] - v0[1]) - force[1], kv[2] * (v[2] - v0[2]) - force[2])
        uu = (ku[0], 0.0, 0.0, 0.0, ku[1], 0.0, 0.0, 0.0, ku[2])
        vv = (kv[0], 0.0, 0.0, 0.0, kv[1], 0.0, 0.0, 0.0, kv[2])
        uv = scalar_matrix(0.0)
        for c in range(mk):
            x, y = route[station, c, 0], route[station, c, 1]
            t = (v[0] - u[2] * y + route[station, c, 2], v[1] + u[2] * x + route[station, c, 3], v[2] + u[0] * y - u[1] * x)
            norm = np.sqrt(dot(t, t))
            if not norm > 1e-9:
                return False, flexibility, gain, softness
            t = axpy(1.0 / norm, t, ORIGIN)
            lever = (y * t[2], -x * t[2], x * t[1] - y * t[0])
            f = tension[i0 + c]
            ru, rv = axpy(f, lever, ru), axpy(f, t, rv)
            g = f / norm
            uu = axpy9(
                g, axpy9(-1.0, outer(lever, lever), (y * y, -x * y, 0.0, -x * y, x * x, 0.0, 0.0, 0.0, x * x + y * y)), uu
            )
            uv = axpy9(g, axpy9(-1.0, outer(lever, t), (0.0, 0.0, y, 0.0, 0.0, -x, -y, x, 0.0)), uv)
            vv = axpy9(g, axpy9(-1.0, outer(t, t), scalar_matrix(1.0)), vv)
        worst = max(
            length * max(abs(ru[0] / ku[0]), abs(ru[1] / ku[1]), abs(ru[2] / ku[2])),
            max(abs(rv[0] / kv[0]), abs(rv[1] / kv[1]), abs(rv[2] / kv[2])),
        )
        if not worst < 1e6:
            return False, flexibility, gain, softness
        flexibility = inverse(vv)
        gain = matmul(uv, flexibility)
        softness = inverse(axpy9(-1.0, matmul(gain, transpose(uv)), uu))
        bend, shear = carried(flexibility, gain, softness, ru, rv)
        u, v = axpy(-1.0, bend, u), axpy(-1.0, shear, v)
        if worst < rod.settled:
            strain[0], strain[1], strain[2] = u
            strain[3], strain[4], strain[5] = v
            # The last step squares the imbalance: it is not looked at again.
            for c in range(mk):
                x, y = route[station, c, 0], route[station, c, 1]
                t = (v[0] - u[2] * y + route[station, c, 2], v[1] + u[2] * x + route[station, c, 3], v[2] + u[0] * y - u[1] * x)
                stretch[c] = np.sqrt(dot(t, t))
                t = axpy(1.0 / stretch[c], t, ORIGIN)
                put3(pull, c, 0, (y * t[2], -x * t[2], x * t[1] - y * t[0]))
                put3(pull, c, 3, t)
            return True, flexibility, gain, softness
    return False, flexibility, gain, softness


@njit(forceinline=True, **INNER)
def carried(flexibility, gain, softness, moment, force):
    """Return the change of bend and shear (u, v) that goes with a change of the wrench, from the factors of `settle`."""
    bend = apply(softness, axpy(-1.0, apply(gain, force), moment))
    return bend, axpy(-1.0, apply_transposed(gain, bend), apply(flexibility, force))


@inner
def march(rod, k, station, steps, tension, load, state, base, columns, driven, tangent, ws):
    """Integrate over steps of one module, in place.

    The tangent is that of the differential equations, integrated along: where the rotation changes by phi, the moment by dm and
    tensions by dF, phi' = R du and dm' = n x dp' with dp' = phi x p' + R dv, and H [du; dv] is the change of the wrench,
    [R^T (dm - phi x m); R^T (n x phi)], less dF c.

    Parameters
    ----------
    rod : Rod
        The arm.
    k, station, steps : int
        The module, the first station of the first step, and the number of steps.
    tension : (n,) array
        Tensions [N].
    load : (LOAD,) array
        External load.
    state : (STATE + m,) array
        State at the first station; out: that after the steps.
    base : (6,) array
        Near the strain at the first station; out: that strain.
    columns : int
        So many rows of `tangent` are wanted, from the first one; 0 for no tangent.
    driven : (n,) array
        The row of the tangent that belongs to each tension; -1 for none.
    tangent : (C, 6 + m) array
        Changes of rotation, moment and path lengths, which go with a unit of something; out: those after the steps.
    ws : Scratch
        Scratch.

    Returns
    -------
    bool
        False where a section has no strain that carries its wrench.
    """
    a, b, strain, past, rates, tangent_rates = rod.a, rod.b, ws.strain, ws.past, ws.rates, ws.tangent_rates
    i0, mk = rod.first_muscle[k], rod.first_muscle[k + 1] - rod.first_muscle[k]
    h = rod.length[k] / rod.steps[k]
    gravity = (load[6], load[7], load[8])
    tip_force = (load[0], load[1], load[2])
    for l in range(6):
        strain[l], past[l] = base[l], base[l]
    here = before = 0.0
    for step in range(steps):
        for i in range(b.size):
            q = (state[0], state[1], state[2], state[3])
            m = (state[7], state[8], state[9])
            for j in range(i):
                d = h * a[i, j]
                if d != 0.0:
                    q = (
                        q[0] + d * rates[j, 0],
                        q[1] + d * rates[j, 1],
                        q[2] + d * rates[j, 2],
                        q[3] + d * rates[j, 3],
                    )
                    m = axpy(d, get3(rates, j, 7), m)
            # The strain is guessed on the line through those of the two places before.
            there = step + rod.c[i]
            if there != here:
                ahead = (there - here) / (here - before) if here != before else 0.0
                before, here = here, there
                for l in range(6):
                    now = strain[l]
                    strain[l] += ahead * (now - past[l])
                    past[l] = now
            n = axpy(load[PAYLOAD_MASS] + rod.mass_below[station], gravity, tip_force)
            r = rotation_matrix(q)
            ok, flexibility, gain, softness = settle(
                rod, k, station, tension, apply_transposed(r, m), apply_transposed(r, n), strain, rates[i, STATE:], ws.pull
            )
            if not ok:
                return False
            if step == 0 and i == 0:
                for l in range(6):
                    base[l] = strain[l]
            t = apply(r, (strain[3], strain[4], strain[5]))
            rates[i, 0], rates[i, 1], rates[i, 2], rates[i, 3] = quaternion_rate(
                q, (0.5 * strain[0], 0.5 * strain[1], 0.5 * strain[2])
            )
            put3(rates, i, 4, t)
            put3(rates, i, 7, cross(n, t))
            for l in range(columns):
                phi, dm = get3(tangent, l, 0), get3(tangent, l, 3)
                for j in range(i):
                    d = h * a[i, j]
                    if d != 0.0:
                        phi = axpy(d, (tangent_rates[j, l, 0], tangent_rates[j, l, 1], tangent_rates[j, l, 2]), phi)
                        dm = axpy(d, (tangent_rates[j, l, 3], tangent_rates[j, l, 4], tangent_rates[j, l, 5]), dm)
                moment = apply_transposed(r, axpy(-1.0, cross(phi, m), dm))
                force = apply_transposed(r, cross(n, phi))
                for c in range(mk):
                    if driven[i0 + c] == l:
                        moment = axpy(-1.0, get3(ws.pull, c, 0), moment)
                        force = axpy(-1.0, get3(ws.pull, c, 3), force)
                bend, shear = carried(flexibility, gain, softness, moment, force)
                put3(tangent_rates[i], l, 0, apply(r, bend))
                put3(tangent_rates[i], l, 3, cross(n, axpy(1.0, cross(phi, t), apply(r, shear))))
                for c in range(mk):
                    tangent_rates[i, l, 6 + c] = dot(get3(ws.pull, c, 0), bend) + dot(get3(ws.pull, c, 3), shear)
            station += 1
        for i in range(b.size):
            for l in range(STATE + mk):
                state[l] += h * b[i] * rates[i, l]
            for l in range(columns):
                for c in range(6 + mk):
                    tangent[l, c] += h * b[i] * tangent_rates[i, l, c]
    return True


@inner
def tip_moment(load, r):
    """Return the moment at the tip from the external load, in the base frame [N m]; r is the tip's rotation matrix."""
    weight = axpy(load[PAYLOAD_MASS], (load[6], load[7], load[8]), ORIGIN)
    return axpy(1.0, cross(apply(r, (load[10], load[11], load[12])), weight), (load[3], load[4], load[5]))


@inner
def tip_moment_turned(load, r, phi):
    """Return the change of `tip_moment` as the tip turns by phi."""
    weight = axpy(load[PAYLOAD_MASS], (load[6], load[7], load[8]), ORIGIN)
    return cross(cross(phi, apply(r, (load[10], load[11], load[12]))), weight)
