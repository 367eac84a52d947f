"""Reduced models: a few polynomials of the strain in each module, found by Galerkin on the energy.

The strain of a module is xi(s) = xi* + sum_j B_j(s) q_j: Legendre polynomials up to one order in each of its pieces, for
the strains that the model allows. The equations are the gradient of the total energy, the section balance weighed with the
basis,

    integral of B^T (K (xi - xi*) + sum_i F_i [r_i x t_i; t_i] - R^T [m; n]) ds = 0,

and one compatibility equation for each muscle, with the tensions as unknowns. The published methods with these bases
differ in what they allow:

* piecewise constant curvature: one bend and one elongation for each module; no twist, no shear. It cannot turn under a
  helical muscle and never agrees with the rod, at no cost however: a model of a few numbers;
* piecewise constant strain: all six strains, constant in each of k pieces. Its error falls with k^-2 once the pieces are
  shorter than a turn of a helical muscle;
* strain polynomials (geometric variable strain): all six strains, one polynomial in each module. Exponential convergence
  where the strain is smooth. Under a helical muscle the strain turns in the body frame, and an order that is affordable
  does not follow five turns of it: there the error stops falling;
* Kirchhoff rod: the same polynomials for bending and twist alone, no shear and no extension.

Rotations go from node to node by a Magnus exponential of order six, exact for constant strain; other integrals are Gauss
quadratures, on cells of less than half a turn. Newton's tangent is that of continuous variations in the base frame:
phi = int R B_u dq, dp' = phi x p' + R B_v dq, dm' = -dp' x n. Pieces are eliminated from tip to base, each handing on
dm = P phi + Q dF + p, tensions at the base of their module: the cost is linear in the number of pieces. Where Newton does
not go straight to the answer, drive and load go in substeps, and where these end, the arm falls as a damped one would.

Indices in the kernels: k module, e piece of the arm, x interval between nodes of a piece, y node of a piece, g node of the
arm, d place among the allowed strains, l degree, j = d (order + 1) + l unknown of a piece, c muscle of the module.
"""

from collections.abc import Sequence
from functools import partial
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, Equilibrium
from tca_envs.mechanics.algebra import (
    apply,
    apply_transposed,
    axpy,
    axpy9,
    cross,
    dot,
    entry,
    get3,
    get4,
    get9,
    inner,
    outer,
    put3,
    put4,
    put9,
    quaternion_rate,
    rotation_matrix,
    scalar_matrix,
)
from tca_envs.mechanics.arm import gauss
from tca_envs.mechanics.kernels import PAYLOAD_MASS
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.study.method import Answer, Array, Method, State

ALL = (0, 1, 2, 3, 4, 5)
BEND_AND_STRETCH = (0, 1, 5)
BEND_AND_TWIST = (0, 1, 2)

TOLERANCE = 1e-7
"""Newton stops below this: an angle over a module, a strain, a mismatch of length over length."""
NODES, MORE = 4, 4
"""Gauss nodes of a cell; and how many more the cells of a module share, for each piece at least one for each degree.
Quadratures are better than the basis by far with these."""
TURNS = 0.5
"""Turns of a helical muscle that a cell spans at most."""
SLENDERNESS = 40.0
"""Radii of gyration that a cell is long at most: rods under their muscles bend by less than three radians on that length."""

MAX_ITERATIONS = 12
MAX_FALL = 200
MAX_ROTATION_STEP = 0.5  # rad
MAX_SHEAR_STEP = 0.5
SMALLEST_SUBSTEP = 1.0 / 128.0
REUSE = 0.1  # Newton keeps its factors as long as a step shrinks the residual to less than this
ORIGIN = (0.0, 0.0, 0.0)
SLOPE = np.sqrt(15.0) / 3.0
WARM, SUBSTEPS, FALL, FAILED = 0, 1, 2, 3


class Model(NamedTuple):
    """An arm with a strain basis as plain arrays. M modules, E pieces, n muscles, G nodes, N nodes of a piece at most."""

    pieces: int  # of each module
    order: int
    allowed: NDArray[np.int64]  # (A,) strains that the basis spans; the others keep xi*
    cells: NDArray[np.int64]  # (M,) of each piece
    nodes: NDArray[np.int64]  # (M,) of each cell
    length: Array  # (M,) [m]
    a: Array  # (M, Q, Q) Gauss coefficients a_jk on [0, 1]
    b: Array  # (M, Q) Gauss weights
    value: Array  # (M, N, order + 1) Legendre polynomials at the nodes of a piece
    between: Array  # (M, N + 1, 3, order + 1) and at the Gauss points between a node and the next
    step: Array  # (M, N + 1) distance of a node from the last one [m]
    stiffness: Array  # (M, 6) diagonal of K
    reference: Array  # (M, 6) xi*
    first_muscle: NDArray[np.int64]  # (M + 1,)
    route: Array  # (G, m, 4) muscle position x, y [m] and its derivative in s
    mass_below: Array  # (G,) mass of the arm beyond each node [kg]
    kind: NDArray[np.int64]  # (n,) kind of muscle law
    parameters: Array  # (n, PARAMETERS) of muscle law
    rest_length: Array  # (n,) [m]


class Workspace(NamedTuple):
    """Scratch of one solve. D unknowns of a piece."""

    ends: Array  # (E + 1, 4) quaternions at the ends of the pieces
    position: Array  # (E + 1, 3) [m]
    rotation: Array  # (G, 9)
    tangent: Array  # (G, 3) p', base frame
    force: Array  # (G, 3) n, base frame
    moment: Array  # (G, 3) m, base frame
    spin: Array  # (G, 3) p' x n
    strain: Array  # (G, 6)
    wrench: Array  # (G, m, 6) [r x t; t]
    norm: Array  # (G, m) |p_i'|
    residual: Array  # (E, D)
    length: Array  # (n,) path lengths [m]
    gap: Array  # (n,) compatibility [m]
    softness: Array  # (n,) d elongation/d tension
    tangent_matrix: Array  # (E, D, D) and its factors
    by_turn: Array  # (E, D, 3) dq of a piece from the rotation at its base
    by_pull: Array  # (E, D, m) from dF
    by_moment: Array  # (E, D, 3) its right-hand side from a moment at its end
    base: Array  # (E, 3, D) moment at its base from dq
    stretch: Array  # (E, m, D) path lengths from it on to the module's end from dq
    turn: Array  # (E, 3, D) rotation at its end from dq
    phi: Array  # (N, 3) of one column
    dspin: Array  # (N, 3)
    section: Array  # (6, 6) H at one node
    weighed: Array  # (1, 6)
    column: Array  # (D + m,)
    by_unit: Array  # (1, 9) moment at a piece's base from the rotation there
    muscle_matrix: Array  # (M, m, m) factors
    muscle_turn: Array  # (M, m, 3)
    muscle_moment: Array  # (M, 3, m)
    answer: Array  # (E, D) dq
    pull: Array  # (n,) dF


@inner
def _workspace(model):
    """Return a `Workspace` for `model`."""
    modules, big_g, n, m = model.length.size, model.mass_below.size, model.kind.size, model.route.shape[1]
    e, d, most = modules * model.pieces, model.allowed.size * (model.order + 1), model.value.shape[1]
    return Workspace(
        np.empty((e + 1, 4)), np.empty((e + 1, 3)), np.empty((big_g, 9)), np.empty((big_g, 3)), np.empty((big_g, 3)),
        np.empty((big_g, 3)), np.empty((big_g, 3)), np.empty((big_g, 6)), np.empty((big_g, m, 6)), np.empty((big_g, m)),
        np.empty((e, d)), np.empty(n), np.empty(n), np.empty(n), np.empty((e, d, d)), np.empty((e, d, 3)),
        np.empty((e, d, m)), np.empty((e, d, 3)), np.empty((e, 3, d)), np.empty((e, m, d)), np.empty((e, 3, d)),
        np.empty((most, 3)), np.empty((most, 3)), np.empty((6, 6)), np.empty((1, 6)), np.empty(d + m), np.empty((1, 9)),
        np.empty((modules, m, m)), np.empty((modules, m, 3)), np.empty((modules, 3, m)), np.empty((e, d)), np.empty(n),
    )  # fmt: skip


@inner
def _curvature(model, k, q, e, values):
    """Return u (3,) of piece e where the polynomials have these values."""
    terms = model.order + 1
    u0, u1, u2 = get3(model.reference, k, 0)
    for d in range(model.allowed.size):
        axis = model.allowed[d]
        if axis > 2:
            break
        x = 0.0
        for l in range(terms):
            x += values[l] * q[e, d * terms + l]
        if axis == 0:
            u0 += x
        elif axis == 1:
            u1 += x
        else:
            u2 += x
    return u0, u1, u2


@inner
def _magnus(size, u1, u2, u3):
    """Return the rotation vector over an interval with these curvatures at its three Gauss points, to order six."""
    a1 = axpy(size, u2, ORIGIN)
    a2 = axpy(SLOPE * size, axpy(-1.0, u1, u3), ORIGIN)
    a3 = axpy(10.0 / 3.0 * size, axpy(-2.0, u2, axpy(1.0, u1, u3)), ORIGIN)
    c1 = cross(a1, a2)
    c2 = cross(a1, axpy(-2.0, a3, c1))
    last = cross(axpy(20.0, a1, axpy(1.0, a3, c1)), axpy(-1.0 / 60.0, c2, a2))
    return axpy(1.0 / 240.0, last, axpy(1.0 / 12.0, a3, a1))


@inner
def _turned(h, omega):
    """Return the quaternion h turned by the rotation vector omega in its own frame."""
    half = axpy(0.5, omega, ORIGIN)
    angle = np.sqrt(dot(half, half))
    c, s = np.cos(angle), (np.sin(angle) / angle if angle > 1e-8 else 1.0)
    d = quaternion_rate(h, half)
    return c * h[0] + s * d[0], c * h[1] + s * d[1], c * h[2] + s * d[2], c * h[3] + s * d[3]


@inner
def _evaluate(model, q, tension, drive, load, ws):
    """Evaluate the equations at coefficients `q` (E, D) and tensions.

    Returns
    -------
    tuple of float
        The dimensionless residual: the largest of the weighed imbalances over K and the piece's length (those of moments
        times the module's length) and of the mismatches over the rest lengths; and the sum of their squares. Both inf
        where the state is no configuration.
    """
    a, b, first_muscle, route, terms = model.a, model.b, model.first_muscle, model.route, model.order + 1
    strain, rotation, count = ws.strain, ws.rotation, model.allowed.size
    gravity, mass = (load[6], load[7], load[8]), load[PAYLOAD_MASS]
    # Base to tip: strains, rotations, tangents, forces.
    put4(ws.ends, 0, (1.0, 0.0, 0.0, 0.0))
    put3(ws.position, 0, 0, ORIGIN)
    p, g, e = ORIGIN, 0, 0
    for k in range(model.length.size):
        nodes = model.nodes[k]
        inside = model.cells[k] * nodes
        h = model.length[k] / (model.pieces * model.cells[k])
        for _ in range(model.pieces):
            quaternion = get4(ws.ends, e)
            for x in range(inside + 1):
                size = model.step[k, x]
                if model.order == 0 and x > 0:
                    omega = axpy(size, get3(strain, g - 1, 0), ORIGIN)
                else:
                    omega = _magnus(
                        size,
                        _curvature(model, k, q, e, model.between[k, x, 0]),
                        _curvature(model, k, q, e, model.between[k, x, 1]),
                        _curvature(model, k, q, e, model.between[k, x, 2]),
                    )
                quaternion = _turned(quaternion, omega)
                if x == inside:
                    break
                for i in range(6):
                    strain[g, i] = model.reference[k, i]
                for d in range(count):
                    for l in range(terms):
                        strain[g, model.allowed[d]] += model.value[k, x, l] * q[e, d * terms + l]
                r = rotation_matrix(quaternion)
                t = apply(r, get3(strain, g, 3))
                n = axpy(mass + model.mass_below[g], gravity, (load[0], load[1], load[2]))
                put9(rotation, g, r)
                put3(ws.tangent, g, 0, t)
                put3(ws.force, g, 0, n)
                put3(ws.spin, g, 0, cross(t, n))
                p = axpy(h * b[k, x % nodes], t, p)
                g += 1
            e += 1
            put4(ws.ends, e, quaternion)
            put3(ws.position, e, 0, p)
    # Tip to base: moments, imbalances, path lengths.
    lever = apply(rotation_matrix(get4(ws.ends, e)), (load[10], load[11], load[12]))
    m_end = axpy(mass, cross(lever, gravity), (load[3], load[4], load[5]))
    worst, total = 0.0, 0.0
    for i in range(tension.size):
        ws.length[i] = 0.0
        if model.kind[i] == TENDON:
            tension[i] = drive[i]
    for k in range(model.length.size - 1, -1, -1):
        nodes, h = model.nodes[k], model.length[k] / (model.pieces * model.cells[k])
        i0, muscles = first_muscle[k], first_muscle[k + 1] - first_muscle[k]
        for _ in range(model.pieces):
            e -= 1
            ws.residual[e] = 0.0
            for cell in range(model.cells[k] - 1, -1, -1):
                g -= nodes
                for j in range(nodes):
                    here, weight = g + j, h * b[k, j]
                    m = m_end
                    for l in range(nodes):
                        m = axpy(h * (b[k, l] - a[k, j, l]), get3(ws.spin, g + l, 0), m)
                    put3(ws.moment, here, 0, m)
                    r = get9(rotation, here)
                    u, v = get3(strain, here, 0), get3(strain, here, 3)
                    ru = axpy(-1.0, apply_transposed(r, m), ORIGIN)
                    rv = axpy(-1.0, apply_transposed(r, get3(ws.force, here, 0)), ORIGIN)
                    for c in range(muscles):
                        lever = (route[here, c, 0], route[here, c, 1], 0.0)
                        w = cross(u, lever)
                        t = (v[0] + w[0] + route[here, c, 2], v[1] + w[1] + route[here, c, 3], v[2] + w[2])
                        norm = np.sqrt(dot(t, t))
                        if not norm > 1e-9:
                            return np.inf, np.inf
                        t = axpy(1.0 / norm, t, ORIGIN)
                        turn = cross(lever, t)
                        ws.norm[here, c] = norm
                        for i in range(3):
                            ws.wrench[here, c, i] = turn[i]
                            ws.wrench[here, c, 3 + i] = t[i]
                        ws.length[i0 + c] += weight * norm
                        ru = axpy(tension[i0 + c], turn, ru)
                        rv = axpy(tension[i0 + c], t, rv)
                    for i in range(3):
                        ws.weighed[0, i] = weight * (ru[i] + model.stiffness[k, i] * (u[i] - model.reference[k, i]))
                        i2 = 3 + i
                        ws.weighed[0, i2] = weight * (rv[i] + model.stiffness[k, i2] * (v[i] - model.reference[k, i2]))
                    for d in range(count):
                        for l in range(terms):
                            value = model.value[k, cell * nodes + j, l]
                            ws.residual[e, d * terms + l] += value * ws.weighed[0, model.allowed[d]]
                for l in range(nodes):
                    m_end = axpy(h * b[k, l], get3(ws.spin, g + l, 0), m_end)
            for d in range(count):
                i = model.allowed[d]
                scale = model.pieces / (model.stiffness[k, i] * (1.0 if i < 3 else model.length[k]))
                for l in range(terms):
                    size = scale * abs(ws.residual[e, d * terms + l])
                    worst = max(worst, size)
                    total += size * size
    for i in range(tension.size):
        if model.kind[i] == TENDON:
            ws.gap[i], ws.softness[i] = 0.0, 1.0
            continue
        rest = model.rest_length[i]
        delta, ws.softness[i], _ = elongation(model.kind[i], model.parameters, i, rest, tension[i], drive[i])
        ws.gap[i] = ws.length[i] - rest - delta
        size = abs(ws.gap[i]) / rest
        worst = max(worst, size)
        total += size * size
    if not total < np.inf:
        return np.inf, np.inf
    return worst, total


@inner
def _linearise_sections(model, k, e, g, tension, damping, ws):
    """Fill the parts of piece e's equations that follow from its strains alone: H, the muscles' pull, the end's moment."""
    terms, count, nodes = model.order + 1, model.allowed.size, model.nodes[k]
    h = model.length[k] / (model.pieces * model.cells[k])
    i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
    matrix, stretch, by_moment, section = ws.tangent_matrix[e], ws.stretch[e], ws.by_moment[e], ws.section
    matrix[:] = 0.0
    stretch[:] = 0.0
    by_moment[:] = 0.0
    for y in range(model.cells[k] * nodes):
        here, weight = g + y, h * model.b[k, y % nodes]
        section[:] = 0.0
        for i in range(6):
            section[i, i] = (1.0 + damping) * model.stiffness[k, i]
        for c in range(muscles):
            x0, x1 = model.route[here, c, 0], model.route[here, c, 1]
            t = (ws.wrench[here, c, 3], ws.wrench[here, c, 4], ws.wrench[here, c, 5])
            f = tension[i0 + c] / ws.norm[here, c]
            # F J^T (1 - t t^T) J/|p'| with J = [-r^, 1]: w = J^T t is the wrench, and J^T J is written out.
            section[0, 0] += f * x1 * x1
            section[1, 1] += f * x0 * x0
            section[2, 2] += f * (x0 * x0 + x1 * x1)
            section[0, 1] -= f * x0 * x1
            section[1, 0] -= f * x0 * x1
            section[0, 5] += f * x1
            section[5, 0] += f * x1
            section[1, 5] -= f * x0
            section[5, 1] -= f * x0
            section[2, 3] -= f * x1
            section[3, 2] -= f * x1
            section[2, 4] += f * x0
            section[4, 2] += f * x0
            w = (ws.wrench[here, c, 0], ws.wrench[here, c, 1], ws.wrench[here, c, 2])
            for i in range(3):
                section[3 + i, 3 + i] += f
                for l in range(3):
                    section[i, l] -= f * w[i] * w[l]
                    section[i, 3 + l] -= f * w[i] * t[l]
                    section[3 + i, l] -= f * t[i] * w[l]
                    section[3 + i, 3 + l] -= f * t[i] * t[l]
        for d in range(count):
            i = model.allowed[d]
            for l in range(terms):
                row, x = d * terms + l, weight * model.value[k, y, l]
                for c in range(muscles):
                    stretch[c, row] += x * ws.wrench[here, c, i]
                if i < 3:
                    for i2 in range(3):
                        by_moment[row, i2] += x * ws.rotation[here, 3 * i2 + i]
                for d2 in range(count):
                    z = x * section[i, model.allowed[d2]]
                    for l2 in range(terms):
                        matrix[row, d2 * terms + l2] += z * model.value[k, y, l2]


@inner
def _column(rotation, g, i):
    """Return column i of the rotation of node g."""
    return rotation[g, i], rotation[g, 3 + i], rotation[g, 6 + i]


@inner
def _vary(model, k, e, g, axis, l, phi0, p_end, column, ws):
    """One column of piece e: add to `column` what a change does to the wrench in its equations.

    The change is that of polynomial `l` of strain `axis`, or with axis -1 that of the rotation at the piece's base, phi0.

    Returns
    -------
    tuple
        Changes of the moment at the base and of the rotation at the end.
    """
    terms, count, nodes, cells = model.order + 1, model.allowed.size, model.nodes[k], model.cells[k]
    h = model.length[k] / (model.pieces * cells)
    for cell in range(cells):
        y0 = cell * nodes
        for j in range(nodes):
            y = y0 + j
            phi = phi0
            if 0 <= axis < 3:
                for l2 in range(nodes):
                    w = _column(ws.rotation, g + y0 + l2, axis)
                    phi = axpy(h * model.a[k, j, l2] * model.value[k, y0 + l2, l], w, phi)
            dp = cross(phi, get3(ws.tangent, g + y, 0))
            if axis >= 3:
                dp = axpy(model.value[k, y, l], _column(ws.rotation, g + y, axis - 3), dp)
            put3(ws.phi, y, 0, phi)
            put3(ws.dspin, y, 0, cross(dp, get3(ws.force, g + y, 0)))
        if 0 <= axis < 3:
            for l2 in range(nodes):
                w = _column(ws.rotation, g + y0 + l2, axis)
                phi0 = axpy(h * model.b[k, l2] * model.value[k, y0 + l2, l], w, phi0)
    dm_end = apply(p_end, phi0)
    for cell in range(cells - 1, -1, -1):
        y0 = cell * nodes
        for j in range(nodes):
            y = y0 + j
            dm = dm_end
            for l2 in range(nodes):
                dm = axpy(h * (model.b[k, l2] - model.a[k, j, l2]), get3(ws.dspin, y0 + l2, 0), dm)
            phi, r, weight = get3(ws.phi, y, 0), get9(ws.rotation, g + y), h * model.b[k, j]
            # d(R^T m) = R^T (dm - phi x m), and for the force dn = 0.
            put3(ws.weighed, 0, 0, apply_transposed(r, axpy(-1.0, cross(phi, get3(ws.moment, g + y, 0)), dm)))
            put3(ws.weighed, 0, 3, apply_transposed(r, cross(get3(ws.force, g + y, 0), phi)))
            for d in range(count):
                z = weight * ws.weighed[0, model.allowed[d]]
                for l2 in range(terms):
                    column[d * terms + l2] -= z * model.value[k, y, l2]
        for l2 in range(nodes):
            dm_end = axpy(h * model.b[k, l2], get3(ws.dspin, y0 + l2, 0), dm_end)
    return dm_end, phi0


@inner
def _eliminate(model, tension, load, damping, ws):
    """Factorise the tangent at the state last given to `_evaluate`, with `damping` times K added to it.

    Piece e with changes dq, incoming rotation phi and the module's dF balances A dq + A_phi phi + S^T dF - W (Q dF + p) = -r,
    W being `by_moment` and S the path lengths; path lengths from it to the module's end follow from S dq + alpha phi_end.
    """
    terms, count = model.order + 1, model.allowed.size
    size = terms * count
    gravity, mass = (load[6], load[7], load[8]), load[PAYLOAD_MASS]
    lever = apply(rotation_matrix(get4(ws.ends, ws.ends.shape[0] - 1)), (load[10], load[11], load[12]))
    p_end = axpy9(mass, outer(lever, gravity), scalar_matrix(-mass * dot(lever, gravity)))
    g, e, column = model.mass_below.size, ws.residual.shape[0], ws.column
    for k in range(model.length.size - 1, -1, -1):
        i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
        handed, follow, matrix = ws.muscle_moment[k], ws.muscle_turn[k], ws.muscle_matrix[k]  # Q, alpha, beta
        handed[:] = 0.0
        follow[:] = 0.0
        matrix[:] = 0.0
        for _ in range(model.pieces):
            e -= 1
            g -= model.cells[k] * model.nodes[k]
            _linearise_sections(model, k, e, g, tension, damping, ws)
            a, by_turn, by_pull = ws.tangent_matrix[e], ws.by_turn[e], ws.by_pull[e]
            base, stretch, turn = ws.base[e], ws.stretch[e], ws.turn[e]
            for c in range(muscles):
                for row in range(size):
                    x = -stretch[c, row]
                    for i in range(3):
                        x += ws.by_moment[e, row, i] * handed[i, c]
                    by_pull[row, c] = x
            for j in range(size + 3 if e > 0 else size):  # nothing turns the arm's own base
                column[:] = 0.0
                axis = model.allowed[j // terms] if j < size else -1
                unit = (1.0 if j == size else 0.0, 1.0 if j == size + 1 else 0.0, 1.0 if j == size + 2 else 0.0)
                dm, phi = _vary(model, k, e, g, axis, j % terms, unit, p_end, column, ws)
                for row in range(size):
                    if j < size:
                        a[row, j] += column[row]
                    else:
                        by_turn[row, j - size] = -column[row]
                for i in range(3):
                    if j < size:
                        base[i, j], turn[i, j] = dm[i], phi[i]
                    else:
                        ws.by_unit[0, 3 * i + j - size] = dm[i]
            _factorise(a, size)
            for c in range(muscles):
                _solve(a, size, by_pull, c, column)
                for row in range(size):
                    for i in range(3):
                        stretch[c, row] += follow[c, i] * turn[i, row]
            if e > 0:
                for i in range(3):
                    _solve(a, size, by_turn, i, column)
                    for row in range(size):
                        for i2 in range(3):
                            ws.by_unit[0, 3 * i2 + i] += base[i2, row] * by_turn[row, i]
                p_end = get9(ws.by_unit, 0)
            for c in range(muscles):
                for row in range(size):
                    for c2 in range(muscles):
                        matrix[c2, c] += stretch[c2, row] * by_pull[row, c]
                    for i in range(3):
                        handed[i, c] += base[i, row] * by_pull[row, c]
                        if e > 0:
                            follow[c, i] += stretch[c, row] * by_turn[row, i]
        # The module's tensions: (beta - softness) dF + alpha phi = -(gap + gamma).
        for c in range(muscles):
            if model.kind[i0 + c] == TENDON:  # its row: -dF = -gap
                matrix[c] = 0.0
                follow[c] = 0.0
            matrix[c, c] -= ws.softness[i0 + c]
        _factorise(matrix, muscles)
        for i in range(3):
            _solve(matrix, muscles, follow, i, column)
        for c in range(muscles):
            moment = (handed[0, c], handed[1, c], handed[2, c])
            p_end = axpy9(-1.0, outer(moment, (follow[c, 0], follow[c, 1], follow[c, 2])), p_end)


@inner
def _factorise(mat, size):
    """LU without pivoting of mat[:size, :size], in place, the diagonal of U inverted: definite where the arm is stable."""
    for k in range(size):
        mat[k, k] = 1.0 / mat[k, k]
        for i in range(k + 1, size):
            factor = mat[i, k] * mat[k, k]
            mat[i, k] = factor
            for j in range(k + 1, size):
                mat[i, j] -= factor * mat[k, j]


@inner
def _substitute(mat, size, x):
    """Solve with the factors of `_factorise` for x[:size], in place."""
    for i in range(size):
        value = x[i]
        for l in range(i):
            value -= mat[i, l] * x[l]
        x[i] = value
    for i in range(size - 1, -1, -1):
        value = x[i]
        for l in range(i + 1, size):
            value -= mat[i, l] * x[l]
        x[i] = value * mat[i, i]


@inner
def _solve(mat, size, columns, c, scratch):
    """Solve with the factors of `_factorise` for columns[:size, c], in place."""
    for i in range(size):
        scratch[i] = columns[i, c]
    _substitute(mat, size, scratch)
    for i in range(size):
        columns[i, c] = scratch[i]


@inner
def _step(model, ws):
    """Solve the factorised tangent for -(residual, gap): `ws.answer` and `ws.pull`.

    Returns
    -------
    tuple of float
        Bounds of the largest rotation [rad] and the largest |dv| of the step.
    """
    terms, count = model.order + 1, model.allowed.size
    size = terms * count
    p0 = p1 = p2 = 0.0
    e = ws.residual.shape[0]
    for k in range(model.length.size - 1, -1, -1):
        i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
        for c in range(muscles):
            ws.pull[i0 + c] = -ws.gap[i0 + c]
        for _ in range(model.pieces):
            e -= 1
            dq, base, moment = ws.answer[e], ws.base[e], ws.by_moment[e]
            for j in range(size):
                dq[j] = moment[j, 0] * p0 + moment[j, 1] * p1 + moment[j, 2] * p2 - ws.residual[e, j]
            _substitute(ws.tangent_matrix[e], size, dq)
            for j in range(size):
                p0 += base[0, j] * dq[j]
                p1 += base[1, j] * dq[j]
                p2 += base[2, j] * dq[j]
                for c in range(muscles):
                    if model.kind[i0 + c] != TENDON:
                        ws.pull[i0 + c] -= ws.stretch[e, c, j] * dq[j]
        # dF as if nothing turned the module's base; the part that follows its rotation is in `muscle_turn`.
        _substitute(ws.muscle_matrix[k], muscles, ws.pull[i0 : i0 + muscles])
        for c in range(muscles):
            p0 += ws.muscle_moment[k, 0, c] * ws.pull[i0 + c]
            p1 += ws.muscle_moment[k, 1, c] * ws.pull[i0 + c]
            p2 += ws.muscle_moment[k, 2, c] * ws.pull[i0 + c]
    phi = ORIGIN
    rotation = shear = 0.0
    for k in range(model.length.size):
        i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
        half = 0.5 * model.length[k] / model.pieces
        for c in range(muscles):
            ws.pull[i0 + c] -= dot(get3(ws.muscle_turn[k], c, 0), phi)
        for _ in range(model.pieces):
            dq = ws.answer[e]
            bend = slide = 0.0
            phi0 = phi
            for j in range(size):
                dq[j] += dot(get3(ws.by_turn[e], j, 0), phi0) if e > 0 else 0.0
                for c in range(muscles):
                    dq[j] += ws.by_pull[e, j, c] * ws.pull[i0 + c]
                phi = axpy(dq[j], (ws.turn[e, 0, j], ws.turn[e, 1, j], ws.turn[e, 2, j]), phi)
                if model.allowed[j // terms] < 3:
                    bend += abs(dq[j])
                else:
                    slide += abs(dq[j])
            # No section turns by more than the ends of its piece and half of the bend between them.
            rotation = max(rotation, np.sqrt(dot(phi, phi)), half * bend)
            shear = max(shear, slide)
            e += 1
    return rotation, shear


@inner
def _newton(model, q, tension, drive, load, damping, ws):
    """Solve by Newton from (q, tension), in place; the rules are those of `kernels.newton`.

    Returns
    -------
    tuple
        converged (bool), iterations.
    """
    total = worst = np.inf
    iterations = 0
    falling = damping > 0.0
    while True:
        before = worst
        worst, new_total = _evaluate(model, q, tension, drive, load, ws)
        if worst < TOLERANCE:
            return True, iterations
        if not worst < np.inf or iterations == (MAX_FALL if falling else MAX_ITERATIONS):
            return False, iterations
        if falling and iterations > 0:
            damping *= min(2.0, max(0.5, np.sqrt(new_total / total)))
        total = new_total
        # Near the answer a step with old factors gains almost as much as one with new ones, at a fraction of the cost.
        if falling or not worst < REUSE * before or before == np.inf:
            _eliminate(model, tension, load, damping, ws)
        rotation, shear = _step(model, ws)
        step = min(1.0, MAX_ROTATION_STEP / max(rotation, 1e-300), MAX_SHEAR_STEP / max(shear, 1e-300))
        if not (step == 1.0 or (falling and step > 1e-6)):
            return False, iterations
        iterations += 1
        for e in range(q.shape[0]):
            for j in range(q.shape[1]):
                q[e, j] += step * ws.answer[e, j]
        for i in range(tension.size):
            tension[i] += step * ws.pull[i]


@entry
def solve(model, q, tension, from_drive, from_load, drive, load, tip):
    """Find the equilibrium that continues a known one: Newton, then substeps of drive and load, then a damped fall.

    Parameters
    ----------
    model : Model
        The arm with its basis.
    q, tension : (E, D), (n,) arrays
        In: the known equilibrium. Out: the asked one.
    from_drive, from_load : (n,), (LOAD,) arrays
        Where (q, tension) are in equilibrium.
    drive, load : (n,), (LOAD,) arrays
        What is asked.
    tip : (4, 4) array
        Out: pose of the tip [m], but for the last row.

    Returns
    -------
    tuple
        rung (WARM, SUBSTEPS, FALL or FAILED), Newton iterations in all.
    """
    ws = _workspace(model)
    good_q, good_tension = q.copy(), tension.copy()
    drive_now, load_now = drive.copy(), load.copy()
    done, step, spent, rung, damping = 0.0, 1.0, 0, WARM, 0.0
    while True:
        here = min(1.0, done + step)
        for i in range(drive.size):
            drive_now[i] = drive[i] if here == 1.0 else from_drive[i] + here * (drive[i] - from_drive[i])
        for i in range(load.size):
            load_now[i] = load[i] if here == 1.0 else from_load[i] + here * (load[i] - from_load[i])
        converged, iterations = _newton(model, q, tension, drive_now, load_now, damping, ws)
        spent += iterations
        if converged:
            if here == 1.0:
                break
            done, step = here, 2.0 * step
            good_q[:] = q
            good_tension[:] = tension
            continue
        if rung == FALL:
            return FAILED, spent
        q[:] = good_q
        tension[:] = good_tension
        step = 0.25 if rung == WARM else 0.5 * step
        rung = SUBSTEPS
        if step < SMALLEST_SUBSTEP:
            rung, step, damping = FALL, 1.0, 1.0
    r = rotation_matrix(get4(ws.ends, ws.ends.shape[0] - 1))
    put3(tip, 0, 0, (r[0], r[1], r[2]))
    put3(tip, 1, 0, (r[3], r[4], r[5]))
    put3(tip, 2, 0, (r[6], r[7], r[8]))
    tip[:3, 3] = ws.position[-1]
    return rung, spent


class Guess(NamedTuple):
    """A known equilibrium of the reduced model."""

    q: Array
    tension: Array
    drive: Array
    load: Array


class Basis(NamedTuple):
    """A reduced model of one arm."""

    arm: Arm
    model: Model
    node_arc: Array
    """Arc positions of the nodes (G,) [m]."""

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        _, tension, drive, load = self.arm.unloaded()
        unknowns = self.model.allowed.size * (self.model.order + 1)
        return Guess(np.zeros((self.model.length.size * self.model.pieces, unknowns)), tension, drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the strains of `known` projected on the basis, with its tensions."""
        model = self.model
        strain = known.strain(self.node_arc)
        q = self.cold().q
        g, degrees = 0, np.arange(model.order + 1)
        for e in range(len(q)):
            k = e // model.pieces
            count, nodes = model.cells[k] * model.nodes[k], model.nodes[k]
            here = strain[g : g + count, model.allowed] - model.reference[k, model.allowed]
            weights = np.tile(model.b[k, :nodes], model.cells[k])[:, np.newaxis] / model.cells[k]
            moments = here.T @ (weights * model.value[k, :count])
            q[e] = (moments * (2 * degrees + 1)).ravel()
            g += count
        return Guess(q, known.tensions.copy(), known.drive.copy(), known.load.copy())

    def solve(self, state: State, guess: Guess) -> Answer:
        """Solve for the equilibrium of the reduced model at `state`."""
        q, tension, tip = guess.q.copy(), guess.tension.copy(), np.eye(4)
        rung, _ = solve(self.model, q, tension, guess.drive, guess.load, state.drive, state.load, tip)
        if rung == FAILED:
            return Answer(False, tip, None)
        return Answer(True, tip, Guess(q, tension, state.drive, state.load))


def reduce(arm: Arm, allowed: Sequence[int], pieces: int, order: int) -> Basis:
    """Return the reduced model of an arm.

    Parameters
    ----------
    arm : Arm
        The arm; its grids play no part.
    allowed : sequence of int
        Strains that the basis spans, ascending; the others keep their reference value.
    pieces : int
        Of each module.
    order : int
        Of the polynomials in each piece.
    """
    modules = arm.modules
    cells, nodes = [], []
    for module in modules:
        turns = max((abs(muscle.turns) for muscle in module.muscles), default=0.0)
        slenderness = module.length / np.sqrt(module.stiffness[:2].min() / module.stiffness[5])
        curl = module.length * float(np.linalg.norm(module.reference_strain[:3]))
        cells.append(max(1, ceil(turns / TURNS / pieces), ceil(slenderness / SLENDERNESS / pieces), ceil(curl / 2.0 / pieces)))
        nodes.append(NODES + ceil(max(order, MORE / pieces) / cells[-1]))
    most_nodes, most = max(nodes), max(c * n for c, n in zip(cells, nodes, strict=True))
    most_muscles = max(len(module.muscles) for module in modules)
    a, b = np.zeros((len(modules), most_nodes, most_nodes)), np.zeros((len(modules), most_nodes))
    value = np.zeros((len(modules), most, order + 1))
    between, step = np.zeros((len(modules), most + 1, 3, order + 1)), np.zeros((len(modules), most + 1))
    legendre = partial(np.polynomial.legendre.legvander, deg=order)
    routes: list[Array] = []
    mass_below: list[float] = []
    arc: list[float] = []
    base = 0.0
    for k, module in enumerate(modules):
        a[k, : nodes[k], : nodes[k]], b[k, : nodes[k]], c = gauss(nodes[k])
        x = ((np.arange(cells[k])[:, np.newaxis] + c) / cells[k]).ravel()
        bounds = np.concatenate([[0.0], x, [1.0]])
        gaps = np.diff(bounds)
        value[k, : x.size] = legendre(2.0 * x - 1.0)
        for side, place in enumerate(gauss(3)[2]):
            between[k, : gaps.size, side] = legendre(2.0 * (bounds[:-1] + place * gaps) - 1.0)
        step[k, : gaps.size] = gaps * module.length / pieces
        beyond = sum(m.mass_per_length * m.length for m in modules[k + 1 :])
        for fraction in ((np.arange(pieces)[:, np.newaxis] + x) / pieces).ravel():
            route = np.zeros((most_muscles, 4))
            for i, muscle in enumerate(module.muscles):
                route[i] = module.route(muscle, fraction)
            routes.append(route)
            mass_below.append(beyond + module.mass_per_length * module.length * (1.0 - fraction))
            arc.append(base + fraction * module.length)
        base += module.length
    whole = arm.model
    model = Model(
        pieces=pieces,
        order=order,
        allowed=np.array(allowed, dtype=np.int64),
        cells=np.array(cells, dtype=np.int64),
        nodes=np.array(nodes, dtype=np.int64),
        length=whole.length,
        a=a,
        b=b,
        value=value,
        between=between,
        step=step,
        stiffness=whole.stiffness,
        reference=whole.reference,
        first_muscle=whole.first_muscle,
        route=np.array(routes),
        mass_below=np.array(mass_below),
        kind=whole.kind,
        parameters=whole.parameters,
        rest_length=whole.rest_length,
    )
    return Basis(arm, model, np.array(arc))


def _pieces(arm: Arm, pieces: int, states: Sequence[State], allowed: Sequence[int] = ALL) -> Basis:
    """Return the model of strains that are constant in pieces."""
    return reduce(arm, allowed, pieces, 0)


def _polynomials(arm: Arm, order: int, states: Sequence[State], allowed: Sequence[int] = ALL) -> Basis:
    """Return the model of one polynomial in each module."""
    return reduce(arm, allowed, 1, order)


METHODS = (
    Method("piecewise constant curvature", "pieces", (1,), partial(_pieces, allowed=BEND_AND_STRETCH), reduced=True),
    Method("piecewise constant strain", "pieces", (1, 2, 4, 8, 16), _pieces),
    Method("strain polynomials", "order", (0, 1, 2, 3, 4), _polynomials),
    Method("Kirchhoff rod", "order", (0, 1, 2, 3, 4), partial(_polynomials, allowed=BEND_AND_TWIST), reduced=True),
)
