"""Reduced models: a few polynomials of the strain in each module, found by Galerkin on the energy.

The strain of a module is xi(s) = xi* + sum_j B_j(s) q_j: Legendre polynomials up to one order in each of its pieces, for the
strains that the model allows. The equations are the section balance weighed with the basis,

    integral of B^T (K (xi - xi*) + sum_i F_i [r_i x t_i; t_i] - R^T [m; n]) ds = 0,

and one compatibility equation for each muscle, with the tensions as unknowns. The published methods differ in their bases:

* piecewise constant curvature: one bend and one elongation for each module; it never agrees with the rod, at no cost however;
* piecewise constant strain: its error falls with k^-2 once the k pieces are shorter than a turn of a helical muscle;
* strain polynomials (geometric variable strain): exponential convergence where the strain is smooth. Under a helical muscle it
  turns in the body frame, and an order that is affordable does not follow five turns of it: there the error stops falling;
* Kirchhoff rod: the same polynomials for bending and twist alone, no shear and no extension.

Rotations go from node to node by a Magnus exponential of order six; other integrals are Gauss quadratures, on cells of less
than half a turn. Newton's tangent is that of continuous variations in the base frame: phi = int R B_u dq, dp' = phi x p' +
R B_v dq, dm' = -dp' x n. Pieces are eliminated from tip to base, each handing on dm = P phi + Q dF + p: the cost is linear in
their number. Where Newton does not go straight to the answer, drive and load go in substeps, and where these end, the arm
falls as a damped one would.

Indices in the kernels: k module, e piece of the arm, x interval between nodes of a piece, y node of a piece, g node of the
arm, d place among the allowed strains, l degree, j = d (order + 1) + l unknown of a piece, c muscle of the module.
"""

from collections.abc import Sequence
from functools import partial
from math import ceil, cos, inf, sin, sqrt
from typing import Any, NamedTuple

import numpy as np

from study.method import Answer, Array, Method, State

from study.notation import (  # isort: skip
    CENTRE, GRAVITY, MASS, SHRUNK, TENDON, Integers, between, carries, inline, inner, kernel, mat, mismatch,
    most_turns, muscle, put, put_mat, put_block, put_pose, put_quat, quat, stations, stiffening, tip_moment, vec, vec1,
)  # fmt: skip
from tca_envs.mechanics import Arm, Equilibrium, compiled
from tca_envs.mechanics.grid import gauss
from tca_envs.mechanics.solver.simd import Quat, Vec, cross, diagonal, dot, outer, product, rotation, transpose

ALL = (0, 1, 2, 3, 4, 5)
BEND_AND_STRETCH = (0, 1, 5)
BEND_AND_TWIST = (0, 1, 2)

TOLERANCE = 1e-7  # Newton stops below this: an angle over a module, a strain, a mismatch of length over length
NODES, MORE = 4, 4
"""Gauss nodes of a cell; and how many more the cells of a module share, for each piece at least one for each degree.
Quadratures are better than the basis by far with these."""
TURNS = 0.5  # turns of a helical muscle that a cell spans at most
SLENDERNESS = 40.0
"""Radii of gyration that a cell is long at most: rods under their muscles bend by less than three radians on that length."""

MAX_ITERATIONS = 12
MAX_FALL = 200
MAX_ROTATION_STEP = 0.5  # rad
MAX_SHEAR_STEP = 0.5
SMALLEST_SUBSTEP = 1.0 / 128.0
REUSE = 0.1  # Newton keeps its factors as long as a step shrinks the residual to less than this
SLOPE = np.sqrt(15.0) / 3.0
WARM, SUBSTEPS, FALL, FAILED = 0, 1, 2, 3


class Model(NamedTuple):
    """A strain basis as plain arrays. M modules, E pieces, G nodes, N nodes of a piece at most."""

    pieces: int  # of each module
    order: int
    allowed: Integers  # (A,) strains that the basis spans; the others keep xi*
    axis: Integers  # (D,) strain of each unknown of a piece
    degree: Integers  # (D,) and its polynomial
    cells: Integers  # (M,) of each piece
    nodes: Integers  # (M,) of each cell
    a: Array  # (M, Q, Q) Gauss coefficients a_jk on [0, 1]
    b: Array  # (M, Q) Gauss weights
    value: Array  # (M, N, order + 1) Legendre polynomials at the nodes of a piece
    between: Array  # (M, N + 1, 3, order + 1) and at the Gauss points between a node and the next
    step: Array  # (M, N + 1) distance of a node from the last one [m]
    route: Array  # (G, m, 4) muscle position x, y [m] and its derivative in s
    mass_beyond: Array  # (G,) mass of the arm beyond each node [kg]


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
    gap: Array  # (n,) mismatch of lengths, over the rest lengths
    slope: Array  # (n,) its derivative in the tension
    matrix: Array  # (E, D, D) tangent and its factors
    by_turn: Array  # (E, 3, D) dq of a piece from the rotation at its base
    by_pull: Array  # (E, m, D) from dF
    by_moment: Array  # (E, 3, D) its right-hand side from a moment at its end
    base: Array  # (E, 3, D) moment at its base from dq
    stretch: Array  # (E, m, D) path lengths from it on to the module's end from dq
    turn: Array  # (E, 3, D) rotation at its end from dq
    phi: Array  # (N, 3) of one column
    dspin: Array  # (N, 3)
    section: Array  # (6, 6) H at one node
    row: Array  # (4, 6) strains or weighed wrenches
    column: Array  # (D,)
    by_unit: Array  # (1, 9) moment at a piece's base from the rotation there
    muscle_matrix: Array  # (M, m, m) factors
    muscle_turn: Array  # (M, 3, m)
    muscle_moment: Array  # (M, m, 3)
    answer: Array  # (E, D) dq
    pull: Array  # (n,) dF


@compiled
def workspace(arm, model):
    """Return a `Workspace`."""
    modules, g, n, m = arm.length.size, model.mass_beyond.size, arm.kind.size, model.route.shape[1]
    e, d, most = modules * model.pieces, model.allowed.size * (model.order + 1), model.value.shape[1]
    return Workspace(
        np.empty((e + 1, 4)), np.empty((e + 1, 3)), np.empty((g, 9)), np.empty((g, 3)), np.empty((g, 3)), np.empty((g, 3)),
        np.empty((g, 3)), np.empty((g, 6)), np.empty((g, m, 6)), np.empty((g, m)), np.empty((e, d)), np.empty(n), np.empty(n),
        np.empty(n), np.empty((e, d, d)), np.empty((e, 3, d)), np.empty((e, m, d)), np.empty((e, 3, d)), np.empty((e, 3, d)),
        np.empty((e, m, d)), np.empty((e, 3, d)), np.empty((most, 3)), np.empty((most, 3)), np.empty((6, 6)),
        np.empty((4, 6)), np.empty(d), np.empty((1, 9)), np.empty((modules, m, m)), np.empty((modules, 3, m)),
        np.empty((modules, m, 3)), np.empty((e, d)), np.empty(n),
    )  # fmt: skip


@inline
def strains_at(arm, model, k, q, e, values, most, target, g):
    """Set target[g] to the strain of piece e where the polynomials have these values, but for strains beyond `most`."""
    for i in range(6):
        target[g, i] = arm.reference[k, i]
    for row in range(model.axis.size):
        if model.axis[row] <= most:
            target[g, model.axis[row]] += values[model.degree[row]] * q[e, row]


@inline
def magnus(size, u1, u2, u3):
    """Return the rotation vector over an interval with these curvatures at its three Gauss points, to order six."""
    a1, a2, a3 = size * u2, SLOPE * size * (u3 - u1), 10.0 / 3.0 * size * (u1 + u3 - 2.0 * u2)
    c1 = cross(a1, a2)
    c2 = cross(a1, c1 - 2.0 * a3)
    return a1 + 1.0 / 12.0 * a3 + 1.0 / 240.0 * cross(20.0 * a1 + a3 + c1, a2 - 1.0 / 60.0 * c2)


@inline
def turned(h, omega):
    """Return the quaternion h turned by the rotation vector omega in its own frame."""
    half = 0.5 * omega
    angle = sqrt(dot(half, half))
    return cos(angle) * h + (sin(angle) / angle if angle > 1e-8 else 1.0) * product(h, half)


@kernel
def forward(arm, model, q, load, ws):
    """Go from base to tip at coefficients q (E, D): strains, rotations, tangents, forces."""
    put_quat(ws.ends, 0, 0, Quat(1.0, 0.0, 0.0, 0.0))
    p, g, e = Vec(0.0, 0.0, 0.0), 0, 0
    put(ws.position, 0, 0, p)
    for k in range(arm.length.size):
        nodes, inside = model.nodes[k], model.cells[k] * model.nodes[k]
        h = arm.length[k] / (model.pieces * model.cells[k])
        for _ in range(model.pieces):
            turn = quat(ws.ends, e, 0)
            for x in range(inside + 1):
                if model.order == 0 and x > 0:
                    omega = model.step[k, x] * vec(ws.strain, g - 1, 0)
                else:
                    for i in range(3):
                        strains_at(arm, model, k, q, e, model.between[k, x, i], 2, ws.row, i)
                    omega = magnus(model.step[k, x], vec(ws.row, 0, 0), vec(ws.row, 1, 0), vec(ws.row, 2, 0))
                turn = turned(turn, omega)
                if x == inside:
                    break
                strains_at(arm, model, k, q, e, model.value[k, x], 5, ws.strain, g)
                r, n = rotation(turn), carries(load, model.mass_beyond[g])
                t = r @ vec(ws.strain, g, 3)
                put_mat(ws.rotation, g, r)
                put(ws.tangent, g, 0, t)
                put(ws.force, g, 0, n)
                put(ws.spin, g, 0, cross(t, n))
                p += h * model.b[k, x % nodes] * t
                g += 1
            e += 1
            put_quat(ws.ends, e, 0, turn)
            put(ws.position, e, 0, p)


@kernel
def balance(arm, model, k, g, tension, weight, ws):
    """Add the path lengths of node g; set ws.row[0] to its weighed imbalance. Returns whether no path shrinks to a point."""
    first, r = arm.first_muscle[k], transpose(mat(ws.rotation, g))
    u, v = vec(ws.strain, g, 0), vec(ws.strain, g, 3)
    ru, rv = -(r @ vec(ws.moment, g, 0)), -(r @ vec(ws.force, g, 0))
    for c in range(arm.first_muscle[k + 1] - first):
        lever, t, norm = muscle(model.route, g, c, u, v)
        if not norm > SHRUNK:
            return False
        ws.norm[g, c] = norm
        put(ws.wrench[g], c, 0, lever)
        put(ws.wrench[g], c, 3, t)
        ws.length[first + c] += weight * norm
        ru, rv = ru + tension[first + c] * lever, rv + tension[first + c] * t
    put(ws.row, 0, 0, ru)
    put(ws.row, 0, 3, rv)
    for i in range(6):
        ws.row[0, i] = weight * (ws.row[0, i] + arm.stiffness[k, i] * (ws.strain[g, i] - arm.reference[k, i]))
    return True


@kernel
def evaluate(arm, model, q, tension, drive, load, ws):
    """Evaluate the equations at coefficients `q` (E, D) and tensions; inf, inf where they are no configuration.

    Returns the largest of the weighed imbalances over K and the piece's length (those of moments times the module's length) and
    of the mismatches over the rest lengths, and the sum of their squares.
    """
    forward(arm, model, q, load, ws)
    g, (e, size) = model.mass_beyond.size, ws.residual.shape
    # Tip to base: moments, imbalances, path lengths.
    m_end = tip_moment(load, rotation(quat(ws.ends, e, 0)))
    worst, total = 0.0, 0.0
    for i in range(tension.size):
        ws.length[i] = 0.0
        if arm.kind[i] == TENDON:
            tension[i] = drive[i]
    for k in range(arm.length.size - 1, -1, -1):
        nodes, h = model.nodes[k], arm.length[k] / (model.pieces * model.cells[k])
        for _ in range(model.pieces):
            e -= 1
            ws.residual[e] = 0.0
            for cell in range(model.cells[k] - 1, -1, -1):
                g -= nodes
                for j in range(nodes):
                    m = m_end
                    for l in range(nodes):
                        m += h * (model.b[k, l] - model.a[k, j, l]) * vec(ws.spin, g + l, 0)
                    put(ws.moment, g + j, 0, m)
                    if not balance(arm, model, k, g + j, tension, h * model.b[k, j], ws):
                        return inf, inf
                    for row in range(size):
                        value = model.value[k, cell * nodes + j, model.degree[row]]
                        ws.residual[e, row] += value * ws.row[0, model.axis[row]]
                for l in range(nodes):
                    m_end += h * model.b[k, l] * vec(ws.spin, g + l, 0)
            for row in range(size):
                i = model.axis[row]
                scale = model.pieces / (arm.stiffness[k, i] * (1.0 if i < 3 else arm.length[k]))
                off = scale * abs(ws.residual[e, row])
                worst, total = max(worst, off), total + off * off
    for i in range(tension.size):
        ws.gap[i], ws.slope[i] = 0.0, -1.0
        if arm.kind[i] != TENDON:
            ws.gap[i], ws.slope[i] = mismatch(arm, i, ws.length[i], tension[i], drive[i])
        worst, total = max(worst, abs(ws.gap[i])), total + ws.gap[i] * ws.gap[i]
    return (worst, total) if total < inf else (inf, inf)


@kernel
def stiffen(arm, model, k, g, tension, damping, ws):
    """Set ws.section to H at node g, with `damping` times K added to it: K + sum F/|p'| (B^T B - c c^T), see `notation`."""
    bend, shear = (1.0 + damping) * vec(arm.stiffness, k, 0), (1.0 + damping) * vec(arm.stiffness, k, 3)
    uu, uv, vv = diagonal(bend.x, bend.y, bend.z), diagonal(0.0, 0.0, 0.0), diagonal(shear.x, shear.y, shear.z)
    for c in range(arm.first_muscle[k + 1] - arm.first_muscle[k]):
        f = tension[arm.first_muscle[k] + c] / ws.norm[g, c]
        lever, t = vec(ws.wrench[g], c, 0), vec(ws.wrench[g], c, 3)
        duu, duv, dvv = stiffening(model.route[g, c, 0], model.route[g, c, 1], f, lever, t)
        uu, uv, vv = uu + duu, uv + duv, vv + dvv
    put_block(ws.section, 0, 0, uu)
    put_block(ws.section, 0, 3, uv)
    put_block(ws.section, 3, 0, transpose(uv))
    put_block(ws.section, 3, 3, vv)


@kernel
def linearise(arm, model, k, e, g, tension, damping, ws):
    """Fill the parts of piece e's equations that follow from its strains alone: H, the muscles' pull, the end's moment."""
    h = arm.length[k] / (model.pieces * model.cells[k])
    matrix, stretch, by_moment = ws.matrix[e], ws.stretch[e], ws.by_moment[e]
    matrix[:] = 0.0
    stretch[:] = 0.0
    by_moment[:] = 0.0
    for y in range(model.cells[k] * model.nodes[k]):
        stiffen(arm, model, k, g + y, tension, damping, ws)
        for row in range(ws.column.size):
            i, x = model.axis[row], h * model.b[k, y % model.nodes[k]] * model.value[k, y, model.degree[row]]
            for c in range(arm.first_muscle[k + 1] - arm.first_muscle[k]):
                stretch[c, row] += x * ws.wrench[g + y, c, i]
            if i < 3:
                for l in range(3):
                    by_moment[l, row] += x * ws.rotation[g + y, 3 * l + i]
            for j in range(ws.column.size):
                matrix[row, j] += x * ws.section[i, model.axis[j]] * model.value[k, y, model.degree[j]]


@inline
def axis_of(turns, g, i):
    """Return column i of the rotation of node g."""
    return Vec(turns[g, i], turns[g, 3 + i], turns[g, 6 + i])


@kernel
def vary(arm, model, k, g, axis, l, phi0, p_end, ws):
    """One column of a piece whose nodes begin at g: what a change does to the wrench in its equations, in `ws.column`.

    The change is that of polynomial `l` of strain `axis`, or with axis -1 that of the rotation at the piece's base, phi0.
    Returns the changes of the moment at the base and of the rotation at the end.
    """
    nodes, cells = model.nodes[k], model.cells[k]
    h = arm.length[k] / (model.pieces * cells)
    ws.column[:] = 0.0
    for cell in range(cells):
        y0 = cell * nodes
        for j in range(nodes):
            phi, at = phi0, g + y0 + j
            if 0 <= axis < 3:
                for i in range(nodes):
                    phi += h * model.a[k, j, i] * model.value[k, y0 + i, l] * axis_of(ws.rotation, g + y0 + i, axis)
            dp = cross(phi, vec(ws.tangent, at, 0))
            if axis >= 3:
                dp += model.value[k, y0 + j, l] * axis_of(ws.rotation, at, axis - 3)
            put(ws.phi, y0 + j, 0, phi)
            put(ws.dspin, y0 + j, 0, cross(dp, vec(ws.force, at, 0)))
        if 0 <= axis < 3:
            for i in range(nodes):
                phi0 += h * model.b[k, i] * model.value[k, y0 + i, l] * axis_of(ws.rotation, g + y0 + i, axis)
    dm_end = p_end @ phi0
    for cell in range(cells - 1, -1, -1):
        y0 = cell * nodes
        for j in range(nodes):
            dm, phi, at = dm_end, vec(ws.phi, y0 + j, 0), g + y0 + j
            for i in range(nodes):
                dm += h * (model.b[k, i] - model.a[k, j, i]) * vec(ws.dspin, y0 + i, 0)
            back, weight = transpose(mat(ws.rotation, at)), h * model.b[k, j]
            # d(R^T m) = R^T (dm - phi x m), and for the force dn = 0.
            put(ws.row, 0, 0, back @ (dm - cross(phi, vec(ws.moment, at, 0))))
            put(ws.row, 0, 3, back @ cross(vec(ws.force, at, 0), phi))
            for row in range(ws.column.size):
                ws.column[row] -= weight * ws.row[0, model.axis[row]] * model.value[k, y0 + j, model.degree[row]]
        for i in range(nodes):
            dm_end += h * model.b[k, i] * vec(ws.dspin, y0 + i, 0)
    return dm_end, phi0


@kernel
def eliminate_piece(arm, model, k, e, g, p_end, ws):
    """Factorise piece e, whose end hands on the moment p_end phi + Q dF, and set what it hands on itself; returns its P.

    With changes dq, incoming rotation phi and the module's dF it balances A dq + A_phi phi + S^T dF - W (Q dF + p) = -r, W
    being `by_moment` and S the path lengths; path lengths from it to the module's end follow from S dq + alpha phi_end.
    """
    muscles, size = arm.first_muscle[k + 1] - arm.first_muscle[k], ws.column.size
    a, by_turn, by_pull, base = ws.matrix[e], ws.by_turn[e], ws.by_pull[e], ws.base[e]
    stretch, turn = ws.stretch[e], ws.turn[e]
    handed, follow, matrix = ws.muscle_moment[k], ws.muscle_turn[k], ws.muscle_matrix[k]
    for c in range(muscles):
        for row in range(size):
            by_pull[c, row] = -stretch[c, row]
            for i in range(3):
                by_pull[c, row] += ws.by_moment[e, i, row] * handed[c, i]
    for j in range(size + 3 if e > 0 else size):  # nothing turns the arm's own base
        axis, l, i = (model.axis[j], model.degree[j], -1) if j < size else (-1, 0, j - size)
        unit = Vec(1.0 * (i == 0), 1.0 * (i == 1), 1.0 * (i == 2))
        dm, phi = vary(arm, model, k, g, axis, l, unit, p_end, ws)
        if j < size:
            base[0, j], base[1, j], base[2, j] = dm.x, dm.y, dm.z
            turn[0, j], turn[1, j], turn[2, j] = phi.x, phi.y, phi.z
        else:
            ws.by_unit[0, i], ws.by_unit[0, 3 + i], ws.by_unit[0, 6 + i] = dm.x, dm.y, dm.z
        for row in range(size):
            if j < size:
                a[row, j] += ws.column[row]
            else:
                by_turn[i, row] = -ws.column[row]
    factorise(a, size)
    for c in range(muscles):
        substitute(a, by_pull[c])
        for i in range(3):
            for row in range(size):
                stretch[c, row] += follow[i, c] * turn[i, row]
    if e > 0:
        for i in range(3):
            substitute(a, by_turn[i])
            for l in range(3):
                ws.by_unit[0, 3 * l + i] += inner(base[l], by_turn[i])
        p_end = mat(ws.by_unit, 0)
    for c in range(muscles):
        for l in range(muscles):
            matrix[l, c] += inner(stretch[l], by_pull[c])
        for i in range(3):
            handed[c, i] += inner(base[i], by_pull[c])
            if e > 0:
                follow[i, c] += inner(stretch[c], by_turn[i])
    return p_end


@kernel
def eliminate(arm, model, tension, load, damping, ws):
    """Factorise the tangent at the state last given to `evaluate`, with `damping` times K added to it."""
    g, e = model.mass_beyond.size, ws.residual.shape[0]
    lever, weight = rotation(quat(ws.ends, e, 0)) @ vec1(load, CENTRE), load[MASS] * vec1(load, GRAVITY)
    lean = -dot(lever, weight)
    p_end = outer(lever, weight) + diagonal(lean, lean, lean)
    for k in range(arm.length.size - 1, -1, -1):
        first, muscles = arm.first_muscle[k], arm.first_muscle[k + 1] - arm.first_muscle[k]
        handed, follow, matrix = ws.muscle_moment[k], ws.muscle_turn[k], ws.muscle_matrix[k]  # q, alpha, beta
        handed[:] = 0.0
        follow[:] = 0.0
        matrix[:] = 0.0
        for _ in range(model.pieces):
            e -= 1
            g -= model.cells[k] * model.nodes[k]
            linearise(arm, model, k, e, g, tension, damping, ws)
            p_end = eliminate_piece(arm, model, k, e, g, p_end, ws)
        # The module's tensions: (beta - softness) dF + alpha phi = -(gap + gamma).
        for c in range(muscles):
            if arm.kind[first + c] == TENDON:  # its row: -dF = -gap
                matrix[c] = 0.0
                follow[:, c] = 0.0
            matrix[c, c] += ws.slope[first + c] * arm.rest_length[first + c]
        factorise(matrix, muscles)
        for i in range(3):
            substitute(matrix, follow[i, :muscles])
        for c in range(muscles):
            p_end -= outer(vec(handed, c, 0), Vec(follow[0, c], follow[1, c], follow[2, c]))


@kernel
def factorise(a, size):
    """LU without pivoting of a[:size, :size], in place, the diagonal of U inverted: definite where the arm is stable."""
    for k in range(size):
        a[k, k] = 1.0 / a[k, k]
        for i in range(k + 1, size):
            factor = a[i, k] * a[k, k]
            a[i, k] = factor
            for j in range(k + 1, size):
                a[i, j] -= factor * a[k, j]


@kernel
def substitute(a, x):
    """Solve with the factors of `factorise` for x, in place."""
    for i in range(x.size):
        value = x[i]
        for l in range(i):
            value -= a[i, l] * x[l]
        x[i] = value
    for i in range(x.size - 1, -1, -1):
        value = x[i]
        for l in range(i + 1, x.size):
            value -= a[i, l] * x[l]
        x[i] = value * a[i, i]


@kernel
def step(arm, model, ws):
    """Solve the factorised tangent for -(residual, gap): `ws.answer` and `ws.pull`.

    Returns bounds of the largest rotation [rad] and the largest |dv| of the step.
    """
    size, e = ws.column.size, ws.residual.shape[0]
    p: Any = Vec(0.0, 0.0, 0.0)
    for k in range(arm.length.size - 1, -1, -1):
        first, last = arm.first_muscle[k], arm.first_muscle[k + 1]
        for i in range(first, last):
            ws.pull[i] = -ws.gap[i] * arm.rest_length[i]
        for _ in range(model.pieces):
            e -= 1
            dq, base, moment = ws.answer[e], ws.base[e], ws.by_moment[e]
            for j in range(size):
                dq[j] = moment[0, j] * p.x + moment[1, j] * p.y + moment[2, j] * p.z - ws.residual[e, j]
            substitute(ws.matrix[e], dq)
            p += Vec(inner(base[0], dq), inner(base[1], dq), inner(base[2], dq))
            for i in range(first, last):
                if arm.kind[i] != TENDON:
                    ws.pull[i] -= inner(ws.stretch[e, i - first], dq)
        # dF as if nothing turned the module's base; the part that follows its rotation is in `muscle_turn`.
        substitute(ws.muscle_matrix[k], ws.pull[first:last])
        for i in range(first, last):
            p += ws.pull[i] * vec(ws.muscle_moment[k], i - first, 0)
    phi, rotated, sheared = Vec(0.0, 0.0, 0.0), 0.0, 0.0
    for k in range(arm.length.size):
        first, last = arm.first_muscle[k], arm.first_muscle[k + 1]
        half, turns = 0.5 * arm.length[k] / model.pieces, ws.muscle_turn[k]
        for i in range(first, last):
            ws.pull[i] -= turns[0, i - first] * phi.x + turns[1, i - first] * phi.y + turns[2, i - first] * phi.z
        for _ in range(model.pieces):
            dq, turn, by_turn, base_turn = ws.answer[e], ws.turn[e], ws.by_turn[e], phi
            bend = slide = 0.0
            for j in range(size):
                if e > 0:
                    dq[j] += by_turn[0, j] * base_turn.x + by_turn[1, j] * base_turn.y + by_turn[2, j] * base_turn.z
                for i in range(first, last):
                    dq[j] += ws.by_pull[e, i - first, j] * ws.pull[i]
                phi += dq[j] * Vec(turn[0, j], turn[1, j], turn[2, j])
                if model.axis[j] < 3:
                    bend += abs(dq[j])
                else:
                    slide += abs(dq[j])
            # No section turns by more than the ends of its piece and half of the bend between them.
            rotated, sheared = max(rotated, sqrt(dot(phi, phi)), half * bend), max(sheared, slide)
            e += 1
    return rotated, sheared


@kernel
def newton(arm, model, q, tension, drive, load, damping, ws):
    """Solve by Newton from (q, tension), in place; returns whether it converged, and iterations."""
    total = worst = inf
    iterations, falling = 0, damping > 0.0
    while True:
        before = worst
        worst, new_total = evaluate(arm, model, q, tension, drive, load, ws)
        if worst < TOLERANCE:
            return True, iterations
        if not worst < inf or iterations == (MAX_FALL if falling else MAX_ITERATIONS):
            return False, iterations
        if falling and iterations > 0:
            damping *= min(2.0, max(0.5, sqrt(new_total / total)))
        total = new_total
        # Near the answer a step with old factors gains almost as much as one with new ones, at a fraction of the cost.
        if falling or not worst < REUSE * before or before == inf:
            eliminate(arm, model, tension, load, damping, ws)
        turn, shear = step(arm, model, ws)
        part = min(1.0, MAX_ROTATION_STEP / max(turn, 1e-300), MAX_SHEAR_STEP / max(shear, 1e-300))
        if not (part == 1.0 or (falling and part > 1e-6)):
            return False, iterations
        iterations += 1
        for e in range(q.shape[0]):
            for j in range(q.shape[1]):
                q[e, j] += part * ws.answer[e, j]
        for i in range(tension.size):
            tension[i] += part * ws.pull[i]


@compiled
def solve(arm, model, q, tension, from_drive, from_load, drive, load, tip):
    """Find the equilibrium that continues a known one: Newton, then substeps of drive and load, then a damped fall.

    `q` (E, D) and `tension` (n,), in equilibrium at `from_drive` and `from_load`, become those at `drive` and `load`; `tip` (4,
    4) becomes the pose of the tip [m], but for the last row. Returns the rung and the Newton iterations in all.
    """
    ws = workspace(arm, model)
    good_q, good_tension = q.copy(), tension.copy()
    done, part, spent, rung, damping = 0.0, 1.0, 0, WARM, 0.0
    while True:
        here = min(1.0, done + part)
        drive_now, load_now = between(from_drive, drive, here), between(from_load, load, here)
        converged, iterations = newton(arm, model, q, tension, drive_now, load_now, damping, ws)
        spent += iterations
        if converged:
            if here == 1.0:
                break
            done, part = here, 2.0 * part
            good_q[:] = q
            good_tension[:] = tension
            continue
        if rung == FALL:
            return FAILED, spent
        q[:] = good_q
        tension[:] = good_tension
        part = 0.25 if rung == WARM else 0.5 * part
        rung = SUBSTEPS
        if part < SMALLEST_SUBSTEP:
            rung, part, damping = FALL, 1.0, 1.0
    put_pose(tip, rotation(quat(ws.ends, ws.ends.shape[0] - 1, 0)), vec(ws.position, ws.position.shape[0] - 1, 0))
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
    node_arc: Array  # arc positions of the nodes (G,) [m]

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        _, tension, drive, load = self.arm.unloaded()
        unknowns = self.model.allowed.size * (self.model.order + 1)
        return Guess(np.zeros((len(self.arm.modules) * self.model.pieces, unknowns)), tension, drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the strains of `known` projected on the basis, with its tensions."""
        model = self.model
        strain = known.strain(self.node_arc)
        q = self.cold().q
        g, degrees = 0, np.arange(model.order + 1)
        for e in range(len(q)):
            k = e // model.pieces
            count, nodes = model.cells[k] * model.nodes[k], model.nodes[k]
            here = strain[g : g + count, model.allowed] - self.arm.model.reference[k, model.allowed]
            weights = np.tile(model.b[k, :nodes], model.cells[k])[:, np.newaxis] / model.cells[k]
            moments = here.T @ (weights * model.value[k, :count])
            q[e] = (moments * (2 * degrees + 1)).ravel()
            g += count
        return Guess(q, known.tensions.copy(), known.drive.copy(), known.load.copy())

    def solve(self, state: State, guess: Guess) -> Answer:
        """Solve for the equilibrium of the reduced model at `state`."""
        q, tension, tip = guess.q.copy(), guess.tension.copy(), np.eye(4)
        rung, _ = solve(self.arm.model, self.model, q, tension, guess.drive, guess.load, state.drive, state.load, tip)
        if rung == FAILED:
            return Answer(False, tip, None)
        return Answer(True, tip, Guess(q, tension, state.drive, state.load))


def reduce(arm: Arm, allowed: Sequence[int], pieces: int, order: int) -> Basis:
    """Return the reduced model of an arm: so many pieces in each module, polynomials of one order for the strains `allowed`."""
    modules, cells, nodes = arm.modules, [], []
    for module in modules:
        slenderness = module.length / np.sqrt(module.stiffness[:2].min() / module.stiffness[5])
        curl = module.length * float(np.linalg.norm(module.reference_strain[:3]))
        shares = most_turns(module.muscles) / TURNS, slenderness / SLENDERNESS, curl / 2.0
        cells.append(max(1, *(ceil(share / pieces) for share in shares)))
        nodes.append(NODES + ceil(max(order, MORE / pieces) / cells[-1]))
    most_nodes, most = max(nodes), max(c * n for c, n in zip(cells, nodes, strict=True))
    a, b = np.zeros((len(modules), most_nodes, most_nodes)), np.zeros((len(modules), most_nodes))
    value = np.zeros((len(modules), most, order + 1))
    between, step = np.zeros((len(modules), most + 1, 3, order + 1)), np.zeros((len(modules), most + 1))
    legendre = partial(np.polynomial.legendre.legvander, deg=order)
    fractions = []
    for k, module in enumerate(modules):
        a[k, : nodes[k], : nodes[k]], b[k, : nodes[k]], c = gauss(nodes[k])
        x = ((np.arange(cells[k])[:, np.newaxis] + c) / cells[k]).ravel()
        bounds = np.concatenate([[0.0], x, [1.0]])
        gaps = np.diff(bounds)
        value[k, : x.size] = legendre(2.0 * x - 1.0)
        for side, place in enumerate(gauss(3)[2]):
            between[k, : gaps.size, side] = legendre(2.0 * (bounds[:-1] + place * gaps) - 1.0)
        step[k, : gaps.size] = gaps * module.length / pieces
        fractions.append(((np.arange(pieces)[:, np.newaxis] + x) / pieces).ravel())
    length = arm.model.length
    arc = [base + own * x for base, own, x in zip(np.cumsum(length) - length, length, fractions, strict=True)]
    axis, degree = np.repeat(allowed, order + 1), np.tile(np.arange(order + 1), len(allowed))
    whole = (np.array(x, dtype=np.int64) for x in (allowed, axis, degree, cells, nodes))
    parts: Any = pieces, order, *whole, a, b, value, between, step, *stations(arm, fractions)
    model = Model(*parts)
    return Basis(arm, model, np.concatenate(arc))


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
