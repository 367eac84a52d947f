"""Compiled kernels: the equilibrium of an arm by Gauss collocation of the strain.

Each module is cut into elements, each element carries q Gauss nodes, the unknowns are the strain at every node and the
muscles' tensions. A muscle is internal to the arm, so the total internal wrench (rod + muscles) feels external loads only:

* the total force n(s) in the global frame is known beforehand: tip force + weight below s;
* the rotation follows from the strain (R' = R u^, collocated on quaternions), the moment from m' = -p' x n;
* at a node the strain balances K (xi - xi*) + sum_i F_i [r x t; t] = R^T [m; n]: no derivative of the strain appears, and
  no rule for joints, because the total wrench is continuous across them (erratum of eq. (26));
* one equation per muscle: path length - rest length = elongation(tension, drive), eq. (24).

Newton's tangent comes from continuous variations in the global frame: with w = R du, phi' = w, dp' = phi x p' + R dv,
dm' = -dp' x n. Eliminating dv at the nodes leaves 3 q unknowns w in an element; elements are eliminated from the tip to the
base, each handing on dm = P phi + Q dF + p at its base end (a Riccati recursion: linear cost in the number of elements,
stable for any length), and the tensions of a module are eliminated at its base. Gauss weights make this tangent that of
the discrete equations up to the discretisation error.

Indices: k module, e element, j node of an element, g node of the arm, i muscle of the arm, c muscle of the module.
Loads are one flat array, see `LOAD`. All matrices are small, so loops are written out: they beat library calls here.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics.algebra import (
    apply,
    apply_transposed,
    axpy,
    axpy9,
    cross,
    cross_matrix,
    dot,
    entry,
    get3,
    get4,
    get9,
    inner,
    inverse,
    matmul,
    negatives,
    outer,
    put3,
    put4,
    put9,
    quaternion_rate,
    quaternion_turn,
    rotation_matrix,
    scalar_matrix,
    transpose,
)
from tca_envs.mechanics.muscle import PARAMETERS, TENDON, elongation, pull, stored

Array = NDArray[np.float64]

# A load is (13,): tip force [N] and tip moment [N m] in the global frame, gravity [m/s2],
# payload mass [kg] and its centre in the tip's frame [m].
LOAD = 13
PAYLOAD_MASS = 9

MAX_ITERATIONS = 12
MAX_ROTATION_STEP = 1.0  # rad
MAX_SHEAR_STEP = 0.5
CONTRACTION = 0.5
ROUND_OFF = 1e-8
"""A step that is shorter need not contract."""
NEUTRAL = 1e-5
"""Smallest eigenvalues of the tangent (see `ladder.smallest_eigenvalue`) above minus this are neutral, not unstable: an arm
that can turn about an axis of symmetry without any work has a zero among them, up to the grid's error. Newton adds so many
times the rod's stiffness to the tangent, or it would be singular there."""
FIRST_SUBSTEP = 0.25
SMALLEST_SUBSTEP = 1.0 / 1024.0
WORK = 10_000
"""Nodes times Newton iterations of one call; muscles beyond a few to a module count, too."""
SWEEPS = 60
REUSE = 0.3  # Newton keeps its factors as long as a step shrinks the residual to less than this
ORIGIN = (0.0, 0.0, 0.0)

WARM, SUBSTEPS, FINER, DESCENT, FAILED, CLOSED_FORM = 0, 1, 2, 3, 4, 5
"""Rungs of the ladder, see `equilibrium.Rung`."""
REPORT = 5
"""Numbers in the report of a lane, see `solve_lanes`."""
SHAPE, INERTIA, STEP, GIVEN, JACOBIAN = 0, 1, 2, 3, 4
"""What `linearise` is asked for."""


class Model(NamedTuple):
    """An arm as plain arrays. M modules, n muscles, G nodes, q <= Q nodes per element, at most m muscles in a module."""

    elements: NDArray[np.int64]  # (M,) elements of each module
    nodes: NDArray[np.int64]  # (M,) nodes per element
    length: Array  # (M,) [m]
    a: Array  # (M, Q, Q) Gauss coefficients a_jk on [0, 1]
    b: Array  # (M, Q) Gauss weights
    stiffness: Array  # (M, 6) diagonal of K
    reference: Array  # (M, 6) xi*
    first_muscle: NDArray[np.int64]  # (M + 1,)
    route: Array  # (G, m, 4) muscle position x, y [m] and its derivative in s
    mass_below: Array  # (G,) mass of the arm beyond each node [kg]
    kind: NDArray[np.int64]  # (n,) kind of muscle law
    parameters: Array  # (n, PARAMETERS) of muscle law
    rest_length: Array  # (n,) [m]
    tolerance: float  # Newton stops when the dimensionless residual is below this (see `evaluate`)
    ladder: bool  # whether `solve` goes on where Newton fails


class Workspace(NamedTuple):
    """Scratch of one solve: filled by `evaluate`, `eliminate` and `substitute`; E elements in all."""

    rate: Array  # (Q, 4) h o u h/2 at the nodes of an element
    quaternion: Array  # (G, 4)
    ends: Array  # (E + 1, 4) quaternions at the element ends
    position: Array  # (E + 1, 3) at the element ends [m]
    rotation: Array  # (G, 9)
    tangent: Array  # (G, 3) p' in the global frame
    force: Array  # (G, 3) total force n, body frame
    moment: Array  # (G, 3) total moment m, global frame
    spin: Array  # (G, 3) p' x n, global frame
    path: Array  # (G, 4 m) t and |p'| of each muscle
    residual: Array  # (G, 6) section balance
    length: Array  # (n,) path lengths [m]
    gap: Array  # (n,) compatibility, [m] ([N] for a tendon)
    softness: Array  # (n,) d elongation/d tension
    compliance: Array  # (G, 9) inverse of H_vv
    slide: Array  # (G, 9) H_vv^-1 H_vu
    wrench: Array  # (G, 6 m) [r x t; t]
    m_block: Array  # (G, 9) M, global frame, as the next five
    n_block: Array  # (G, 9) N
    x_block: Array  # (G, 9) X
    y_block: Array  # (G, 9) Y
    pull: Array  # (G, 3 m) e
    swing: Array  # (G, 3 m) z
    matrix: Array  # (G Q, 9) rows g Q + l: block of node l in the balance of node g, then its factors
    phi: Array  # (G, 9) w from the rotation at the element's base
    pulled: Array  # (G, 3 m) w from dF
    base: Array  # (G, 9) moment at the element's base from w
    stretch: Array  # (G, 3 m) path lengths from w
    handed: Array  # (4 m, 3) Q and its successor, alpha and its successor
    beta: Array  # (m, m)
    muscle_matrix: Array  # (M, m, m) factors
    muscle_phi: Array  # (M, m, 3)
    muscle_moment: Array  # (M, m, 3)
    gamma: Array  # (m,)
    sources: Array  # (Q, 6) rho and zeta of the nodes of an element
    answer: Array  # (G, 3) w
    turned: Array  # (G, 3) rotation of each node
    bend: Array  # (G, 3) du, body frame
    shear: Array  # (G, 3) dv, body frame
    tension: Array  # (n,) dF
    tip: Array  # (6,) d(tip position, tip rotation)


@inner
def workspace(model):
    """Return a `Workspace` for `model`."""
    big_e, big_g = np.sum(model.elements), model.mass_below.size
    q, m, n, modules = model.b.shape[1], model.route.shape[1], model.kind.size, model.length.size
    return Workspace(
        np.empty((q, 4)), np.empty((big_g, 4)), np.empty((big_e + 1, 4)), np.empty((big_e + 1, 3)),
        np.empty((big_g, 9)), np.empty((big_g, 3)), np.empty((big_g, 3)), np.empty((big_g, 3)),
        np.empty((big_g, 3)), np.empty((big_g, 4 * m)), np.empty((big_g, 6)), np.empty(n), np.empty(n), np.empty(n),
        np.empty((big_g, 9)), np.empty((big_g, 9)), np.empty((big_g, 6 * m)), np.empty((big_g, 9)),
        np.empty((big_g, 9)), np.empty((big_g, 9)), np.empty((big_g, 9)), np.empty((big_g, 3 * m)),
        np.empty((big_g, 3 * m)), np.empty((big_g * q, 9)), np.empty((big_g, 9)), np.empty((big_g, 3 * m)),
        np.empty((big_g, 9)), np.empty((big_g, 3 * m)), np.empty((4 * m, 3)), np.empty((m, m)),
        np.empty((modules, m, m)), np.empty((modules, m, 3)), np.empty((modules, m, 3)), np.empty(m), np.empty((q, 6)),
        np.empty((big_g, 3)), np.empty((big_g, 3)), np.empty((big_g, 3)), np.empty((big_g, 3)), np.empty(n), np.empty(6),
    )  # fmt: skip


@inner
def _turn(e, g0, k, q, h, model, strain, guessed, ws):
    """Collocate the quaternion over element e, eq. (28); False where the nodes cannot resolve the rotation.

    Gauss-Seidel sweeps of h_j = h_0 + h sum_k a_jk (h_k o u_k)/2, a linear problem whose sweeps contract by about |u| h/4q,
    from the quaternions in `ws` if they are `guessed` and otherwise from the exponential of the mean curvature.
    """
    a, quaternion, rate = model.a, ws.quaternion, ws.rate
    close = max(1e-14, 1e-3 * model.tolerance)
    q0 = get4(ws.ends, e)
    half = 0.5 * h
    for j in range(q):
        if not guessed:
            x = ORIGIN
            for l in range(q):
                x = axpy(half * a[k, j, l], get3(strain, g0 + l, 0), x)
            angle = np.sqrt(dot(x, x))
            c, s = np.cos(angle), (np.sin(angle) / angle if angle > 1e-8 else 1.0)
            d = quaternion_rate(q0, x)
            put4(
                quaternion,
                g0 + j,
                (c * q0[0] + s * d[0], c * q0[1] + s * d[1], c * q0[2] + s * d[2], c * q0[3] + s * d[3]),
            )
        old = get4(quaternion, g0 + j)
        put4(rate, j, quaternion_rate(old, axpy(half, get3(strain, g0 + j, 0), ORIGIN)))
    settled = False
    for _ in range(SWEEPS):
        change = 0.0
        for j in range(q):
            h0, h1, h2, h3 = q0
            for l in range(q):
                c = a[k, j, l]
                h0 += c * rate[l, 0]
                h1 += c * rate[l, 1]
                h2 += c * rate[l, 2]
                h3 += c * rate[l, 3]
            old = get4(quaternion, g0 + j)
            new = (h0, h1, h2, h3)
            change = max(change, abs(h0 - old[0]), abs(h1 - old[1]), abs(h2 - old[2]), abs(h3 - old[3]))
            put4(quaternion, g0 + j, new)
            put4(rate, j, quaternion_rate(new, axpy(half, get3(strain, g0 + j, 0), ORIGIN)))
        if change < close:
            settled = True
            break
        if not change < 1e6:
            return False
    h0, h1, h2, h3 = q0
    for l in range(q):
        c = model.b[k, l]
        h0 += c * rate[l, 0]
        h1 += c * rate[l, 1]
        h2 += c * rate[l, 2]
        h3 += c * rate[l, 3]
    s = 1.0 / np.sqrt(h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3)
    put4(ws.ends, e + 1, (s * h0, s * h1, s * h2, s * h3))
    return settled


@inner
def evaluate(model, strain, tension, drive, load, guessed, ws):
    """Evaluate the equilibrium equations at a state.

    Parameters
    ----------
    model : Model
        The arm.
    strain : (G, 6) array
        Strain xi = [u; v] at the nodes, body frame.
    tension : (n,) array
        Tensions [N]; those of tendons are set to their drives.
    drive : (n,) array
        Drives.
    load : (LOAD,) array
        External load.
    guessed : bool
        Whether `ws` holds quaternions near those of this state.
    ws : Workspace
        Receives rotations, wrenches and residuals.

    Returns
    -------
    tuple of float
        The dimensionless residual: the largest of |moment imbalance| L/K (an angle over the module), |force imbalance|/K (a
        strain) and |length mismatch|/rest length; and the sum of squares of all of them. Both inf where the state is
        no configuration (a rotation that the nodes cannot resolve, a muscle path that shrinks to a point).
    """
    a, b, elements, nodes, first_muscle = model.a, model.b, model.elements, model.nodes, model.first_muscle
    ends, position, rotation, tangent, spin = ws.ends, ws.position, ws.rotation, ws.tangent, ws.spin
    path, residual, length, route = ws.path, ws.residual, ws.length, model.route
    worst, total = 0.0, 0.0
    gravity = (load[6], load[7], load[8])
    mass = load[PAYLOAD_MASS]
    # Base to tip: rotations, tangents, forces.
    put4(ends, 0, (1.0, 0.0, 0.0, 0.0))
    p = ORIGIN
    put3(position, 0, 0, p)
    g0 = e = 0
    for k in range(elements.size):
        q, h = nodes[k], model.length[k] / elements[k]
        for _ in range(elements[k]):
            if not _turn(e, g0, k, q, h, model, strain, guessed, ws):
                return np.inf, np.inf
            for j in range(q):
                g = g0 + j
                r = rotation_matrix(get4(ws.quaternion, g))
                t = apply(r, get3(strain, g, 3))
                n = axpy(mass + model.mass_below[g], gravity, (load[0], load[1], load[2]))
                p = axpy(h * b[k, j], t, p)
                put9(rotation, g, r)
                put3(tangent, g, 0, t)
                put3(ws.force, g, 0, apply_transposed(r, n))
                put3(spin, g, 0, cross(t, n))
            g0 += q
            e += 1
            put3(position, e, 0, p)
    # Tip to base: moments, section balance, path lengths.
    lever = apply(rotation_matrix(get4(ends, e)), (load[10], load[11], load[12]))
    m_end = axpy(mass, cross(lever, gravity), (load[3], load[4], load[5]))
    for i in range(tension.size):
        length[i] = 0.0
        if model.kind[i] == TENDON:
            tension[i] = drive[i]
    for k in range(elements.size - 1, -1, -1):
        q, h, scale = nodes[k], model.length[k] / elements[k], model.length[k]
        i0, mk = first_muscle[k], first_muscle[k + 1] - first_muscle[k]
        for _ in range(elements[k]):
            g0 -= q
            for j in range(q):
                g = g0 + j
                m = m_end
                for l in range(q):
                    m = axpy(h * (b[k, l] - a[k, j, l]), get3(spin, g0 + l, 0), m)
                put3(ws.moment, g, 0, m)
                u, v = get3(strain, g, 0), get3(strain, g, 3)
                ru = axpy(-1.0, apply_transposed(get9(rotation, g), m), ORIGIN)
                rv = axpy(-1.0, get3(ws.force, g, 0), ORIGIN)
                for c in range(mk):
                    r = (route[g, c, 0], route[g, c, 1], 0.0)
                    w = cross(u, r)
                    t = (v[0] + w[0] + route[g, c, 2], v[1] + w[1] + route[g, c, 3], v[2] + w[2])
                    norm = np.sqrt(dot(t, t))
                    if not norm > 1e-9:
                        return np.inf, np.inf
                    t = axpy(1.0 / norm, t, ORIGIN)
                    put3(path, g, 4 * c, t)
                    path[g, 4 * c + 3] = norm
                    length[i0 + c] += h * b[k, j] * norm
                    ru = axpy(tension[i0 + c], cross(r, t), ru)
                    rv = axpy(tension[i0 + c], t, rv)
                put3(residual, g, 0, ru)
                put3(residual, g, 3, rv)
                for i in range(6):
                    stiffness = model.stiffness[k, i]
                    residual[g, i] += stiffness * (strain[g, i] - model.reference[k, i])
                    size = abs(residual[g, i]) / stiffness * (scale if i < 3 else 1.0)
                    worst = max(worst, size)
                    total += size * size
            for j in range(q):
                m_end = axpy(h * b[k, j], get3(spin, g0 + j, 0), m_end)
    for i in range(tension.size):
        if model.kind[i] == TENDON:
            ws.gap[i], ws.softness[i] = 0.0, 1.0
            continue
        rest = model.rest_length[i]
        delta, ws.softness[i], _ = elongation(model.kind[i], model.parameters, i, rest, tension[i], drive[i])
        ws.gap[i] = length[i] - rest - delta
        size = abs(ws.gap[i]) / rest
        worst = max(worst, size)
        total += size * size
    if not total < np.inf:
        return np.inf, np.inf
    return worst, total


@inner
def _section(model, k, g, tension, strain, damping, ws):
    """Linearise the section at node g: H = K + sum_i F_i d[r x t; t]/dxi, dv eliminated; return H_vv's negative eigenvalues.

    In the body frame, with n = R^T n, m = R^T m, B = H_vv^-1 and G = H_uv B:
    S = H_uu - G H_vu; N = G [n] - [m]; X = v n^T - (v.n) 1 - [n] B [n]; Y = [n] G^T; e = c_u - G c_v; z = [n] B c_v.
    Writes the global-frame blocks M = R S R^T, N, X, Y and e, z.
    """
    stiffness, route = model.stiffness, model.route
    i0, mk = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
    d = 1.0 + damping
    uu = (d * stiffness[k, 0], 0.0, 0.0, 0.0, d * stiffness[k, 1], 0.0, 0.0, 0.0, d * stiffness[k, 2])
    vv = (d * stiffness[k, 3], 0.0, 0.0, 0.0, d * stiffness[k, 4], 0.0, 0.0, 0.0, d * stiffness[k, 5])
    vu = scalar_matrix(0.0)
    for c in range(mk):
        lever = (route[g, c, 0], route[g, c, 1], 0.0)
        t = get3(ws.path, g, 4 * c)
        put3(ws.wrench, g, 6 * c, cross(lever, t))
        put3(ws.wrench, g, 6 * c + 3, t)
        f = tension[i0 + c] / ws.path[g, 4 * c + 3]
        p = axpy9(-f, outer(t, t), scalar_matrix(f))
        arm = cross_matrix((-lever[0], -lever[1], 0.0))
        pa = matmul(p, arm)
        vv = axpy9(1.0, p, vv)
        vu = axpy9(1.0, pa, vu)
        uu = axpy9(1.0, matmul(transpose(arm), pa), uu)
    flexibility = inverse(vv)
    slide = matmul(flexibility, vu)
    gain = transpose(slide)
    put9(ws.compliance, g, flexibility)
    put9(ws.slide, g, slide)
    r = get9(ws.rotation, g)
    back = transpose(r)
    n, v = get3(ws.force, g, 0), get3(strain, g, 3)
    nb = cross_matrix(n)
    nf = matmul(nb, flexibility)
    put9(ws.m_block, g, matmul(matmul(r, axpy9(-1.0, matmul(gain, vu), uu)), back))
    y = matmul(nb, slide)
    put9(ws.y_block, g, matmul(matmul(r, y), back))
    # G [n] = -Y^T, and R [R^T m] R^T = [m].
    minus_n = axpy9(1.0, cross_matrix(get3(ws.moment, g, 0)), matmul(matmul(r, transpose(y)), back))
    put9(ws.n_block, g, axpy9(-1.0, minus_n, scalar_matrix(0.0)))
    x = axpy9(-1.0, matmul(nf, nb), axpy9(1.0, outer(v, n), scalar_matrix(-dot(v, n))))
    put9(ws.x_block, g, matmul(matmul(r, x), back))
    for c in range(mk):
        cu, cv = get3(ws.wrench, g, 6 * c), get3(ws.wrench, g, 6 * c + 3)
        put3(ws.pull, g, 3 * c, apply(r, axpy(-1.0, apply(gain, cv), cu)))
        put3(ws.swing, g, 3 * c, apply(r, apply(nf, cv)))
    return negatives(flexibility)


@inner
def eliminate(model, strain, tension, load, damping, ws):
    """Factorise the tangent at the state last given to `evaluate`, with `damping` times K added to it.

    For an element with w = (w_1..w_q), incoming rotation phi_0 and the module's dF, with A_rk = b_k - a_rk (A_0k = b_k):
    dm_r = D_r w + D_r0 phi_0 + D_rF dF + ..., where D_rl = h b_l P + h^2 sum_k A_rk a_kl X_k + h A_rl Y_l,
    D_r0 = P + h sum_k A_rk X_k and D_rF = Q + h sum_k A_rk z_k. Node r balances M w_r + N phi_r + e dF - dm_r = -rho_r;
    row 0 is the moment at the element's base, which the element before it sees. Path lengths follow from
    dl = stretch w + alpha phi_0 + beta dF.

    Returns
    -------
    int
        How many eigenvalues of the tangent, as a quadratic form in the strain, are negative: as many as of its pivots, by
        Sylvester's law of inertia, less one for each muscle's pivot that is not negative: that muscle has made up for one of
        the rod's (Haynsworth).
    """
    index = 0
    a, b, elements, nodes, first_muscle = model.a, model.b, model.elements, model.nodes, model.first_muscle
    matrix, phi, pulled, base, stretch = ws.matrix, ws.phi, ws.pulled, ws.base, ws.stretch
    pull, swing, x_block, y_block, n_block, beta = (
        ws.pull,
        ws.swing,
        ws.x_block,
        ws.y_block,
        ws.n_block,
        ws.beta,
    )
    m, wide = model.route.shape[1], b.shape[1]
    handed = ws.handed
    big_q, new_q, alpha, new_alpha = 0, m, 2 * m, 3 * m  # first rows in `handed`
    g0 = model.mass_below.size
    gravity = (load[6], load[7], load[8])
    lever = apply(rotation_matrix(get4(ws.ends, ws.ends.shape[0] - 1)), (load[10], load[11], load[12]))
    mass = load[PAYLOAD_MASS]
    p_end = axpy9(mass, outer(lever, gravity), scalar_matrix(-mass * dot(lever, gravity)))
    zero = scalar_matrix(0.0)
    for k in range(elements.size - 1, -1, -1):
        q, h = nodes[k], model.length[k] / elements[k]
        i0, mk = first_muscle[k], first_muscle[k + 1] - first_muscle[k]
        for c in range(mk):
            put3(handed, alpha + c, 0, ORIGIN)
            put3(handed, big_q + c, 0, ORIGIN)
            for c2 in range(mk):
                beta[c, c2] = 0.0
        for _ in range(elements[k]):
            g0 -= q
            for j in range(q):
                index += _section(model, k, g0 + j, tension, strain, damping, ws)
            inside = g0 > 0  # nothing turns the arm's own base: there phi_0 is zero and row 0 is of no use
            p_new = zero
            for r in range(q + 1):  # row 0: the base; rows 1..q: the nodes
                row = g0 + r - 1
                if r == 0 and not inside:
                    for l in range(q):
                        put9(base, g0 + l, zero)
                        put9(phi, g0 + l, zero)
                    for c in range(mk):
                        put3(handed, new_q + c, 0, ORIGIN)
                    continue
                for l in range(q):
                    block = axpy9(h * b[k, l], p_end, zero)
                    for kk in range(q):
                        late = b[k, kk] if r == 0 else b[k, kk] - a[k, r - 1, kk]
                        block = axpy9(h * h * late * a[k, kk, l], get9(x_block, g0 + kk), block)
                    late = b[k, l] if r == 0 else b[k, l] - a[k, r - 1, l]
                    block = axpy9(h * late, get9(y_block, g0 + l), block)
                    if r == 0:
                        put9(base, g0 + l, block)
                        continue
                    block = axpy9(-1.0, block, axpy9(h * a[k, r - 1, l], get9(n_block, row), zero))
                    if l == r - 1:
                        block = axpy9(1.0, get9(ws.m_block, row), block)
                    put9(matrix, row * wide + l, block)
                if inside:
                    block = p_end
                    for kk in range(q):
                        late = b[k, kk] if r == 0 else b[k, kk] - a[k, r - 1, kk]
                        block = axpy9(h * late, get9(x_block, g0 + kk), block)
                    if r == 0:
                        p_new = block
                    else:
                        put9(phi, row, axpy9(-1.0, get9(n_block, row), block))
                for c in range(mk):
                    x = get3(handed, big_q + c, 0)
                    for kk in range(q):
                        late = b[k, kk] if r == 0 else b[k, kk] - a[k, r - 1, kk]
                        x = axpy(h * late, get3(swing, g0 + kk, 3 * c), x)
                    if r == 0:
                        put3(handed, new_q + c, 0, x)
                    else:
                        put3(pulled, row, 3 * c, axpy(-1.0, get3(pull, row, 3 * c), x))
            for c in range(mk):
                x0 = get3(handed, alpha + c, 0)
                x = x0
                for j in range(q):
                    x = axpy(-h * b[k, j], get3(swing, g0 + j, 3 * c), x)
                put3(handed, new_alpha + c, 0, x)
                for l in range(q):
                    x = axpy(b[k, l], axpy(1.0, x0, get3(pull, g0 + l, 3 * c)), ORIGIN)
                    for j in range(q):
                        x = axpy(-h * b[k, j] * a[k, j, l], get3(swing, g0 + j, 3 * c), x)
                    put3(stretch, g0 + l, 3 * c, axpy(h, x, ORIGIN))
                for c2 in range(mk):
                    for j in range(q):
                        t, t2 = get3(ws.wrench, g0 + j, 6 * c + 3), get3(ws.wrench, g0 + j, 6 * c2 + 3)
                        beta[c, c2] -= h * b[k, j] * dot(t, apply(get9(ws.compliance, g0 + j), t2))
            index += _factorise_blocks(matrix, phi, pulled, inside, g0, q, wide, mk)
            for l in range(g0, g0 + q):
                p_new = axpy9(1.0, matmul(get9(base, l), get9(phi, l)), p_new)
                for c in range(mk):
                    x = apply_transposed(get9(phi, l), get3(stretch, l, 3 * c))
                    put3(handed, new_alpha + c, 0, axpy(1.0, x, get3(handed, new_alpha + c, 0)))
                    x = apply(get9(base, l), get3(pulled, l, 3 * c))
                    put3(handed, new_q + c, 0, axpy(1.0, x, get3(handed, new_q + c, 0)))
                    for c2 in range(mk):
                        beta[c, c2] += dot(get3(stretch, l, 3 * c), get3(pulled, l, 3 * c2))
            for c in range(mk):
                put3(handed, alpha + c, 0, get3(handed, new_alpha + c, 0))
                put3(handed, big_q + c, 0, get3(handed, new_q + c, 0))
            p_end = p_new
        # The module's tensions: (beta - softness) dF + alpha phi_0 = -(gap + gamma).
        muscle, follow = ws.muscle_matrix[k], ws.muscle_phi[k]
        for c in range(mk):
            tendon = model.kind[i0 + c] == TENDON  # its row: -dF = -gap
            for c2 in range(mk):
                muscle[c, c2] = 0.0 if tendon else beta[c, c2]
            muscle[c, c] -= ws.softness[i0 + c]
            put3(follow, c, 0, ORIGIN if tendon else get3(handed, alpha + c, 0))
            put3(ws.muscle_moment[k], c, 0, get3(handed, big_q + c, 0))
        index -= _factorise(muscle, mk)
        for d in range(3):
            for c in range(mk):
                ws.gamma[c] = follow[c, d]
            _substitute(muscle, mk, ws.gamma, 0)
            for c in range(mk):
                follow[c, d] = ws.gamma[c]
        for c in range(mk):
            p_end = axpy9(-1.0, outer(get3(handed, big_q + c, 0), get3(follow, c, 0)), p_end)
    return index


@inner
def _factorise_blocks(matrix, phi, pulled, inside, g0, q, wide, mk):
    """LU without pivoting, in 3 x 3 blocks, of an element's matrix; `phi` (if `inside`) and `pulled` become the solutions.

    At a stable equilibrium the matrix is positive definite up to a diagonal scaling, so pivoting buys nothing; where it is
    singular the answer is not finite. Diagonal blocks are stored inverted. Returns how many of their eigenvalues are negative.
    """
    negative = 0
    for k in range(q):
        row_k = (g0 + k) * wide
        pivot = inverse(get9(matrix, row_k + k))
        negative += negatives(pivot)
        put9(matrix, row_k + k, pivot)
        phi_k = get9(phi, g0 + k)
        for i in range(k + 1, q):
            row_i = (g0 + i) * wide
            factor = matmul(get9(matrix, row_i + k), pivot)
            put9(matrix, row_i + k, factor)
            for j in range(k + 1, q):
                product = matmul(factor, get9(matrix, row_k + j))
                put9(matrix, row_i + j, axpy9(-1.0, product, get9(matrix, row_i + j)))
            if inside:
                put9(phi, g0 + i, axpy9(-1.0, matmul(factor, phi_k), get9(phi, g0 + i)))
            for c in range(mk):
                x = apply(factor, get3(pulled, g0 + k, 3 * c))
                put3(pulled, g0 + i, 3 * c, axpy(-1.0, x, get3(pulled, g0 + i, 3 * c)))
    for k in range(q - 1, -1, -1):
        row_k = (g0 + k) * wide
        if inside:
            block = get9(phi, g0 + k)
            for l in range(k + 1, q):
                block = axpy9(-1.0, matmul(get9(matrix, row_k + l), get9(phi, g0 + l)), block)
            put9(phi, g0 + k, matmul(get9(matrix, row_k + k), block))
        for c in range(mk):
            x = get3(pulled, g0 + k, 3 * c)
            for l in range(k + 1, q):
                x = axpy(-1.0, apply(get9(matrix, row_k + l), get3(pulled, g0 + l, 3 * c)), x)
            put3(pulled, g0 + k, 3 * c, apply(get9(matrix, row_k + k), x))
    return negative


@inner
def _factorise(mat, size):
    """LU without pivoting of mat[:size, :size], in place, the diagonal of U inverted; returns how many pivots are positive."""
    positive = 0
    for k in range(size):
        positive += 1 if mat[k, k] > 0.0 else 0
        mat[k, k] = 1.0 / mat[k, k]
        for i in range(k + 1, size):
            mat[i, k] *= mat[k, k]
            for j in range(k + 1, size):
                mat[i, j] -= mat[i, k] * mat[k, j]
    return positive


@inner
def _substitute(mat, size, x, x0):
    """Solve with the factors of `_factorise` for x[x0 : x0 + size], in place."""
    for i in range(size):
        value = x[x0 + i]
        for l in range(i):
            value -= mat[i, l] * x[x0 + l]
        x[x0 + i] = value
    for i in range(size - 1, -1, -1):
        value = x[x0 + i]
        for l in range(i + 1, size):
            value -= mat[i, l] * x[x0 + l]
        x[x0 + i] = value * mat[i, i]


@inner
def substitute(model, ws):
    """Solve the factorised tangent for the right-hand side -(ws.residual, ws.gap).

    Writes the changes of strain (`ws.bend`, `ws.shear`), tension (`ws.tension`) and tip (`ws.tip`); returns the largest
    rotation [rad] and the largest |dv| of the step.
    """
    a, b, elements, nodes, first_muscle = model.a, model.b, model.elements, model.nodes, model.first_muscle
    matrix, answer, tension, gamma, wide = ws.matrix, ws.answer, ws.tension, ws.gamma, b.shape[1]
    residual, rotation, wrench, sources = ws.residual, ws.rotation, ws.wrench, ws.sources
    g0 = model.mass_below.size
    p_end = ORIGIN
    for k in range(elements.size - 1, -1, -1):
        q, h = nodes[k], model.length[k] / elements[k]
        i0, mk = first_muscle[k], first_muscle[k + 1] - first_muscle[k]
        for c in range(mk):
            gamma[c] = 0.0
        for _ in range(elements[k]):
            g0 -= q
            for j in range(q):
                g = g0 + j
                r, ru, rv = get9(rotation, g), get3(residual, g, 0), get3(residual, g, 3)
                slid = apply(get9(ws.compliance, g), rv)
                put3(sources, j, 0, apply(r, axpy(-1.0, apply_transposed(get9(ws.slide, g), rv), ru)))
                put3(sources, j, 3, apply(r, cross(get3(ws.force, g, 0), slid)))
                for c in range(mk):
                    gamma[c] -= h * b[k, j] * dot(get3(wrench, g, 6 * c + 3), slid)
            for j in range(q):
                x = axpy(-1.0, get3(sources, j, 0), p_end)
                for l in range(q):
                    x = axpy(h * (b[k, l] - a[k, j, l]), get3(sources, l, 3), x)
                put3(answer, g0 + j, 0, x)
            for j in range(q):
                x = get3(answer, g0 + j, 0)
                for l in range(j):
                    x = axpy(-1.0, apply(get9(matrix, (g0 + j) * wide + l), get3(answer, g0 + l, 0)), x)
                put3(answer, g0 + j, 0, x)
            for j in range(q - 1, -1, -1):
                x = get3(answer, g0 + j, 0)
                for l in range(j + 1, q):
                    x = axpy(-1.0, apply(get9(matrix, (g0 + j) * wide + l), get3(answer, g0 + l, 0)), x)
                put3(answer, g0 + j, 0, apply(get9(matrix, (g0 + j) * wide + j), x))
            for l in range(q):
                w = get3(answer, g0 + l, 0)
                p_end = axpy(h * b[k, l], get3(sources, l, 3), axpy(1.0, apply(get9(ws.base, g0 + l), w), p_end))
                for c in range(mk):
                    gamma[c] += dot(get3(ws.stretch, g0 + l, 3 * c), w)
        # dF for phi_0 = 0; the part that follows phi_0 is in muscle_phi.
        for c in range(mk):
            tension[i0 + c] = -ws.gap[i0 + c] - (0.0 if model.kind[i0 + c] == TENDON else gamma[c])
        _substitute(ws.muscle_matrix[k], mk, tension, i0)
        for c in range(mk):
            p_end = axpy(tension[i0 + c], get3(ws.muscle_moment[k], c, 0), p_end)
    # Base to tip.
    phi0, dp = ORIGIN, ORIGIN
    most_rotation = most_shear = 0.0
    for k in range(elements.size):
        q, h = nodes[k], model.length[k] / elements[k]
        i0, mk = first_muscle[k], first_muscle[k + 1] - first_muscle[k]
        for c in range(mk):
            tension[i0 + c] -= dot(get3(ws.muscle_phi[k], c, 0), phi0)
        for _ in range(elements[k]):
            for g in range(g0, g0 + q):
                w = axpy(1.0, apply(get9(ws.phi, g), phi0), get3(answer, g, 0))
                for c in range(mk):
                    w = axpy(tension[i0 + c], get3(ws.pulled, g, 3 * c), w)
                put3(answer, g, 0, w)
            for j in range(q):
                g = g0 + j
                phi = phi0
                for l in range(q):
                    phi = axpy(h * a[k, j, l], get3(answer, g0 + l, 0), phi)
                most_rotation = max(most_rotation, dot(phi, phi))
                put3(ws.turned, g, 0, phi)
                r = get9(rotation, g)
                bend = apply_transposed(r, get3(answer, g, 0))
                y = axpy(-1.0, get3(residual, g, 3), cross(get3(ws.force, g, 0), apply_transposed(r, phi)))
                for c in range(mk):
                    y = axpy(-tension[i0 + c], get3(wrench, g, 6 * c + 3), y)
                shear = axpy(-1.0, apply(get9(ws.slide, g), bend), apply(get9(ws.compliance, g), y))
                most_shear = max(most_shear, dot(shear, shear))
                put3(ws.bend, g, 0, bend)
                put3(ws.shear, g, 0, shear)
                dp = axpy(h * b[k, j], axpy(1.0, cross(phi, get3(ws.tangent, g, 0)), apply(r, shear)), dp)
            for l in range(q):
                phi0 = axpy(h * b[k, l], get3(answer, g0 + l, 0), phi0)
            g0 += q
    ws.tip[0], ws.tip[1], ws.tip[2] = dp
    ws.tip[3], ws.tip[4], ws.tip[5] = phi0
    return np.sqrt(max(most_rotation, dot(phi0, phi0))), np.sqrt(most_shear)


@inner
def newton(model, strain, tension, drive, load, moved, ws):
    """Solve by Newton from (strain, tension), in place, on the branch of equilibria that these are near.

    Newton must go straight to the answer. It gives up where a step turns a section by more than MAX_ROTATION_STEP; where a step
    is not CONTRACTION times shorter than the one before; or if it takes long. For a solve that has to be steered may end on
    another branch. One that contracts finds the only equilibrium nearby (the theorem of Newton and Kantorovich in affine
    covariant form; Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 5.1); that this is on the branch that the
    start is on is seen by going back, `ladder.returns`, where the way is long. What has `moved`, drive or load, takes a step
    even where the start would do: a small change moves the arm a little, not in jerks.

    The answer must be stable by the count of `eliminate` there. Factors of an earlier step would not do, however well they
    serve for steps: the smallest eigenvalue changes by as much as the arm turns.

    Returns
    -------
    tuple
        converged (bool), dimensionless residual, iterations, size of the first step.
    """
    worst = size = np.inf
    iterations, first = 0, 0.0
    while True:
        before = worst
        worst, _ = evaluate(model, strain, tension, drive, load, iterations > 0, ws)
        there = worst < model.tolerance and (iterations > 0 or not moved)
        if not worst < np.inf or (iterations == MAX_ITERATIONS and not there):
            return False, worst, iterations, first
        # Near the answer a step with old factors gains almost as much as one with new ones, at a third of the cost.
        if there or not worst < REUSE * before or before == np.inf:
            index = eliminate(model, strain, tension, load, NEUTRAL, ws)
            if there:
                return index == 0, worst, iterations, first
        rotation, shear = substitute(model, ws)
        last, size = size, rotation + shear
        first = size if iterations == 0 else first
        if not (rotation < MAX_ROTATION_STEP and shear < MAX_SHEAR_STEP and (size < CONTRACTION * last or size < ROUND_OFF)):
            return False, worst, iterations, first
        iterations += 1
        for g in range(strain.shape[0]):
            put3(strain, g, 0, axpy(1.0, get3(ws.bend, g, 0), get3(strain, g, 0)))
            put3(strain, g, 3, axpy(1.0, get3(ws.shear, g, 0), get3(strain, g, 3)))
            half = axpy(0.5, get3(ws.turned, g, 0), ORIGIN)
            put4(ws.quaternion, g, quaternion_turn(half, get4(ws.quaternion, g)))
        for i in range(tension.size):
            tension[i] += ws.tension[i]


@inner
def solve(model, strain, tension, from_drive, from_load, drive, load, first, budget, ws):
    """Follow the branch of equilibria from a known one to the asked one, in place.

    Newton from the known state first; its first step is the tangent's prediction. Where it fails, drive and load go from the
    known ones to the asked ones in substeps, shortened on failure and doubled on success. Arguments as in `solve_lanes`,
    for one arm.

    Returns
    -------
    tuple
        rung (WARM, SUBSTEPS or FAILED), dimensionless residual, Newton iterations in all, next substep as a share of what is
        left of the way, largest first step of Newton.
    """
    first_drive, first_load = from_drive.copy(), from_load.copy()
    good_strain, good_tension = strain.copy(), tension.copy()
    drive_now, load_now = drive.copy(), load.copy()
    longest, work = 0.0, 0
    done, step, spent, rung, moved = 0.0, first, 0, WARM if first == 1.0 else SUBSTEPS, False
    for i in range(drive.size):
        moved |= drive[i] != from_drive[i]
    for i in range(load.size):
        moved |= load[i] != from_load[i]
    while True:
        here = min(1.0, done + step)
        for i in range(drive.size):
            drive_now[i] = drive[i] if here == 1.0 else first_drive[i] + here * (drive[i] - first_drive[i])
        for i in range(load.size):
            load_now[i] = load[i] if here == 1.0 else first_load[i] + here * (load[i] - first_load[i])
        converged, worst, iterations, size = newton(model, strain, tension, drive_now, load_now, moved, ws)
        spent += iterations
        work += iterations + 1
        if converged:
            longest = max(longest, size)
            from_drive[:] = drive_now
            from_load[:] = load_now
            if here == 1.0:
                return rung, worst, spent, 1.0, longest
            done, step = here, 2.0 * step
            good_strain[:] = strain
            good_tension[:] = tension
            continue
        strain[:] = good_strain
        tension[:] = good_tension
        step = FIRST_SUBSTEP if rung == WARM else 0.5 * step
        rung = SUBSTEPS
        if step < SMALLEST_SUBSTEP or work >= budget or not model.ladder:
            return FAILED, worst, spent, min(0.5, step / (1.0 - done)), longest


def solve_lanes(model, strain, tension, from_drive, from_load, drive, load, tip, lengths, report, first=1.0):
    """Follow the branches of N arms of one model, each from its own known equilibrium.

    Parameters
    ----------
    model : Model
        The arm.
    strain, tension : (N, G, 6), (N, n) arrays
        In: known equilibria. Out: the asked ones; where there was none, the last ones on the way.
    from_drive, from_load : (N, n), (N, LOAD) arrays
        In: where (strain, tension) are in equilibrium. Out: where they are now: as asked, or as far as the branch went.
    drive, load : (N, n), (N, LOAD) arrays
        What is asked.
    tip : (N, 4, 4) array
        Out: tip poses [m], but for the last row, which stays; unchanged where there was no answer.
    lengths : (N, n) array
        Out: path lengths [m]; unchanged where there was no answer.
    report : (N, REPORT) array
        Out: rung (WARM, SUBSTEPS or FAILED), dimensionless residual, Newton iterations, jumped (0; of a lane that FAILED, the
        substep to go on with), largest first step of a Newton (rotation [rad] and stretch). A lane that FAILED is at the end of
        its branch (the substep is below SMALLEST_SUBSTEP) or has done `budget` iterations.
    first : float
        Substep to begin with, as a share of the way: 1 but for a lane that goes on.
    """
    _solve_lanes(*model, strain, tension, from_drive, from_load, drive, load, first, budget(model), tip, lengths, report)


@cache
def compile_kernels():
    """Compile the kernels or load them from the cache, so that this is no part of the time of a solve."""
    one, none = np.ones(1, dtype=np.int64), np.zeros(0, dtype=np.int64)
    straight, drive, load = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros(0), np.zeros(LOAD)
    model = Model(
        one, one, np.ones(1), np.full((1, 1, 1), 0.5), np.ones((1, 1)), np.ones((1, 6)), straight, np.zeros(2, dtype=np.int64),
        np.zeros((1, 0, 4)), np.zeros(1), none, np.zeros((0, PARAMETERS)), np.zeros(0), 1e-6, True,
    )  # fmt: skip
    linearise(model, straight, drive, drive, load, 0.0, False, SHAPE, straight)
    drives, loads = np.zeros((1, 0)), np.zeros((1, LOAD))
    known = (straight[np.newaxis], drives.copy(), drives.copy(), loads.copy())
    solve_lanes(model, *known, drives, loads, np.eye(4)[np.newaxis].copy(), drives.copy(), np.zeros((1, REPORT)))


def budget(model):
    """Return the Newton iterations after which `solve_lanes` gives a lane up, so that someone can look at the clock."""
    return max(MAX_ITERATIONS, WORK // (len(model.mass_below) * max(1, model.route.shape[1] // 4)))


@entry
def _solve_lanes(
    elements, nodes, length, a, b, stiffness, reference, first_muscle, route, mass_below, kind, parameters, rest_length,
    tolerance, ladder, strain, tension, from_drive, from_load, drive, load, first, budget, tip, lengths, report,
):  # fmt: skip
    """`solve_lanes` with the model's fields one by one: of a NamedTuple Numba works out the type anew at every call."""
    model = Model(
        elements, nodes, length, a, b, stiffness, reference, first_muscle, route, mass_below, kind, parameters, rest_length,
        tolerance, ladder,
    )  # fmt: skip
    ws = workspace(model)
    for lane in range(strain.shape[0]):
        rung, worst, iterations, step, longest = solve(
            model, strain[lane], tension[lane], from_drive[lane], from_load[lane], drive[lane], load[lane], first, budget, ws
        )
        report[lane, 0], report[lane, 1], report[lane, 2], report[lane, 3] = rung, worst, iterations, 0.0
        report[lane, 4] = longest
        if rung == FAILED:
            report[lane, 3] = step
            continue
        r = rotation_matrix(get4(ws.ends, ws.ends.shape[0] - 1))
        pose = tip[lane]
        put3(pose, 0, 0, (r[0], r[1], r[2]))
        put3(pose, 1, 0, (r[3], r[4], r[5]))
        put3(pose, 2, 0, (r[6], r[7], r[8]))
        pose[:3, 3] = ws.position[-1]
        lengths[lane] = ws.length


@inner
def _energy(model, strain, tension, load, ws):
    """Return the total energy [J] of the state last given to `evaluate`, without a tip moment, which has no potential.

    Rod and muscles store it, loads lose it: int n . p' ds is the work of the tip force and of all weights but the lever of the
    payload's.
    """
    total, g = 0.0, 0
    for k in range(model.elements.size):
        h = model.length[k] / model.elements[k]
        for _ in range(model.elements[k]):
            for j in range(model.nodes[k]):
                density = -dot(get3(ws.force, g, 0), get3(strain, g, 3))
                for i in range(6):
                    density += 0.5 * model.stiffness[k, i] * (strain[g, i] - model.reference[k, i]) ** 2
                total += h * model.b[k, j] * density
                g += 1
    lever = apply(rotation_matrix(get4(ws.ends, ws.ends.shape[0] - 1)), (load[10], load[11], load[12]))
    total -= load[PAYLOAD_MASS] * dot(lever, (load[6], load[7], load[8]))
    for i in range(tension.size):
        total += stored(model.kind[i], model.parameters, i, model.rest_length[i], tension[i], ws.length[i])
    return total


@entry
def linearise(model, strain, tension, drive, load, damping, slaved, ask, given):
    """Evaluate a state and what follows from its tangent; everything but the hot path is made of this.

    Parameters
    ----------
    model : Model
        The arm.
    strain, tension : (G, 6), (n,) arrays
        The state.
    drive, load : (n,), (LOAD,) arrays
        Drives and load.
    damping : float
        So many times the rod's stiffness K is added to the tangent.
    slaved : bool
        Whether tensions follow from the path lengths; `tension` is overwritten then.
    ask : int
        SHAPE: the state alone; INERTIA: factors, too; STEP: Newton's step; GIVEN: the step under the imbalance `given`;
        JACOBIAN: derivatives in the drives.
    given : (G, 6) array
        Imbalance at the nodes.

    Returns
    -------
    tuple
        Residual, sum of its squares, energy [J] (true where tensions are slaved), `eliminate`'s count, the step's
        largest rotation [rad] and largest dv, its work against the imbalance g . dx and its size dx . K dx [J], as an array
        (8,); quaternions at element ends and nodes, positions at ends, p' and p' x n at the nodes, path lengths; bend and
        shear of the step (G, 3); d(tip position, tip rotation) of the step or, for JACOBIAN, by each drive (6, 1 or n): by
        the implicit function theorem, not finite where it has none.
    """
    ws = workspace(model)
    n = tension.size
    numbers = np.zeros(8)
    columns = n if ask == JACOBIAN else (1 if ask >= STEP else 0)
    tips = np.zeros((6, columns))
    worst = total = np.inf
    for again in range(2 if slaved else 1):
        worst, total = evaluate(model, strain, tension, drive, load, again > 0, ws)
        if not worst < np.inf:
            break
        if slaved and again == 0:
            for i in range(n):
                if model.kind[i] != TENDON:
                    tension[i] = pull(
                        model.kind[i], model.parameters, i, model.rest_length[i], ws.length[i], drive[i], tension[i]
                    )
    numbers[0], numbers[1] = worst, total
    numbers[3] = 1.0  # what is no configuration is not stable
    if worst < np.inf:
        numbers[2], numbers[3] = _energy(model, strain, tension, load, ws), 0.0
        if ask != SHAPE:
            numbers[3] = eliminate(model, strain, tension, load, damping, ws)
        if ask >= GIVEN:
            ws.gap[:] = 0.0
            for g in range(strain.shape[0]):
                for i in range(6):
                    ws.residual[g, i] = given[g, i] if ask == GIVEN else 0.0
        for i in range(columns):
            if ask == JACOBIAN:
                if model.kind[i] == TENDON:
                    ws.gap[i] = 1.0  # its row reads -dF = -gap
                else:
                    _, _, slope = elongation(model.kind[i], model.parameters, i, model.rest_length[i], tension[i], drive[i])
                    ws.gap[i] = -slope
            numbers[4], numbers[5] = substitute(model, ws)
            tips[:, i] = ws.tip
            if ask == JACOBIAN:
                ws.gap[i] = 0.0
        g = 0
        for k in range(model.elements.size):
            h = model.length[k] / model.elements[k]
            for node in range(model.elements[k] * model.nodes[k]):
                weight = h * model.b[k, node % model.nodes[k]]
                for i in range(3 if columns else 0):
                    bend, shear = ws.bend[g, i], ws.shear[g, i]
                    numbers[6] += weight * (ws.residual[g, i] * bend + ws.residual[g, 3 + i] * shear)
                    numbers[7] += weight * (model.stiffness[k, i] * bend**2 + model.stiffness[k, 3 + i] * shear**2)
                g += 1
    return numbers, ws.ends, ws.quaternion, ws.position, ws.tangent, ws.spin, ws.length, ws.bend, ws.shear, tips
