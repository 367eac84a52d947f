"""Compiled kernels: the equilibrium of an arm by Gauss collocation of the strain, for packs of arms.

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

Indices: k module, e element, j node of an element, g node of the arm, i muscle of the arm, c muscle of the module. A kernel's
arguments are an arm's numbers and sizes (`f` and `i`, see `PLACES` and `tables`), addresses (`a`, see `ADDRESSES`), the packs
that it works on (`w`, see `LAYOUT`) and an integer and a float of its own. Loads are flat, see `LOAD`. All matrices are small,
so loops are written out: they beat library calls here.
"""

import numpy as np

from tca_envs.mechanics.algebra import (
    ORIGIN,
    apply,
    apply_transposed,
    axpy,
    axpy9,
    cross,
    dot,
    inverse,
    matmul,
    outer,
    quaternion_rate,
    quaternion_turn,
    rotation_matrix,
    scalar_matrix,
    transpose,
)
from tca_envs.mechanics.muscle import PARAMETERS, TENDON, law
from tca_envs.mechanics.packs import call_kernel, floats_at, floats_of
from tca_envs.mechanics.traced import PACK, choose, part, root, size, spread, traced
from tca_envs.mechanics.written import written

# A load is (13,): tip force [N] and tip moment [N m] in the global frame, gravity [m/s2],
# payload mass [kg] and its centre in the tip's frame [m].
LOAD = 13
PAYLOAD_MASS = 9

MAX_ITERATIONS = 12
MAX_ROTATION_STEP = 1.0  # rad
MAX_SHEAR_STEP = 0.5
CONTRACTION = 0.5
LONG = 0.1
"""Newton's first step, rotation [rad] and stretch, is long enough for another branch to be in reach."""
ROUND_OFF = 1e-8
"""A step that is shorter need not contract."""
NEUTRAL = 1e-5
"""Smallest eigenvalues of the tangent (see `ladder.smallest_eigenvalue`) above minus this are neutral, not unstable: an arm
that can turn about an axis of symmetry without any work has a zero among them, up to the grid's error. Newton adds so many
times the rod's stiffness to the tangent, or it would be singular there."""
FIRST_SUBSTEP = 0.25
SMALLEST_SUBSTEP = 1.0 / 1024.0
SWEEPS = 60
REUSE = 0.3
"""Newton steps with old factors where the last step shrank the residual to less than this."""
KEPT = 3
"""Newton's factors serve for so many steps."""

WARM, SUBSTEPS, FINER, DESCENT, FAILED, CLOSED_FORM = 0, 1, 2, 3, 4, 5
"""Rungs of the ladder, see `equilibrium.Rung`."""
REPORT = 5
"""Numbers in the report of a lane, see `collocation.solve_lanes`."""

(
    MODULES, MUSCLES, NODES, ELEMENTS, WIDE, MOST,
    PIECES, NODES_OF, FIRST_MUSCLE, KIND,
    TOLERANCE, LENGTH, A, B, COUPLING, STIFFNESS, REFERENCE, ROUTE, MASS_BELOW, LAW, REST,
    STRAIN, TENSION, DRIVE, LOADS,
    GOOD_STRAIN, GOOD_TENSION, FROM_DRIVE, FROM_LOADS, TO_DRIVE, TO_LOADS,
    ACTIVE, MOVED, CONVERGED, WORST, TOTAL, INDEX, ROTATED, SHEARED, ITERATIONS, SLOWNESS, OUTCOME,
    RATE, QUATERNION, ENDS, POSITION, ROTATION, TANGENT, FORCE, MOMENT, SPIN, PATH, RESIDUAL, PATHS, GAP, SOFTNESS,
    COMPLIANCE, SLIDE, WRENCH, M_BLOCK, N_BLOCK, X_BLOCK, Y_BLOCK, PULL, SWING,
    MATRIX, PHI, PULLED, BASE, STRETCH, HANDED, BETA, MUSCLE_MATRIX, MUSCLE_PHI, MUSCLE_MOMENT,
    GAMMA, SOURCES, ANSWER, TURNED, BEND, SHEAR, CHANGE, TIP, END,
) = range(84)  # fmt: skip
"""Places in `i`. The first six are sizes of the arm: modules M, muscles n, nodes G, elements E, most nodes Q of an element,
most muscles m of a module. The next four are where its integers begin in `i` itself: M elements, M nodes of an element, M + 1
first muscles, n kinds. Then, where its numbers begin in `f`, see `collocation.flat`; and, from STRAIN on, where arrays begin
among the packs, see `layout`. END is the number of packs in all."""
(
    EVALUATE, ELIMINATE, SUBSTITUTE, NEWTON, FOLLOW, HEAT, LANES,
    AT_STRAIN, AT_TENSION, AT_FROM_DRIVE, AT_FROM_LOAD, AT_DRIVE, AT_LOAD, AT_TIP, AT_LENGTHS, AT_REPORT,
    AT_ACTION, AT_TEMPERATURE, AT_POWER, AT_HEATING, COUNT, BUDGET, HEATED, JOB,
) = range(24)  # fmt: skip
"""Places in `a`: kernels, then the arrays of `collocation.solve_lanes` and of `collocation.Heat`, how many lanes they have,
how many iterations a lane may take, and how many drives a lane has: TCAs, where they are heated, that are not the arm's come
after those that are. JOB is the number of places."""
KEPT_SHARE, LOST_SHARE, LOSS, MAX_POWER, AMBIENT_AT, LIMIT_AT = range(6)
"""Rows of the array at AT_HEATING (6, HEATED)."""


def layout(modules: int, n: int, nodes: int, elements: int, wide: int, most: int) -> tuple[int, ...]:
    """Return how many packs the arrays take, in the order of their places."""
    g, q, m = nodes, wide, most
    state = (6 * g, n, n, LOAD)
    return (
        *state,  # what is asked for or found
        *state, n, LOAD,  # of `follow`: the last good state, where it began and where it goes
        1, 1, 1, 1, 1, 1, 1, 1, 1, 1, REPORT,  # what kernels tell each other
        4 * q, 4 * g, 4 * (elements + 1), 3 * (elements + 1),  # h o u h/2; quaternions at nodes and ends; positions of ends [m]
        9 * g, 3 * g, 3 * g, 3 * g, 3 * g,  # rotation; p', total force (body frame), total moment and p' x n at nodes
        4 * m * g, 6 * g, n, n, n,  # t and |p'|; section balance; lengths [m]; gap, [m] ([N]: tendon); d elongation/d tension
        9 * g, 9 * g, 6 * m * g,  # H_vv^-1; H_vv^-1 H_vu; [r x t; t]
        9 * q, 9 * q, 9 * q, 9 * q, 3 * m * q, 3 * m * q,  # of an element, global frame: M, N, X, Y, e, z
        9 * q * g,  # rows g Q + l: block of node l in the balance of node g, then its factors
        9 * g, 3 * m * g,  # w from the rotation at the element's base and from dF
        9 * g, 3 * m * g,  # moment at the element's base and path lengths from w
        12 * m, m * m, modules * m * m, 3 * modules * m, 3 * modules * m,  # Q, alpha and successors; beta; muscles' factors
        m, 6 * q, 3 * g, 3 * g, 3 * g, 3 * g, n, 6,  # gamma; rho, zeta; w; rotations; du, dv (body frame); dF; of the tip
    )  # fmt: skip


@traced
def get3(w, k):
    """Return three packs."""
    return w[k], w[k + 1], w[k + 2]


@traced
def put3(w, k, x):
    """Set three packs."""
    w[k], w[k + 1], w[k + 2] = x


@traced
def get4(w, k):
    """Return four packs."""
    return w[k], w[k + 1], w[k + 2], w[k + 3]


@traced
def put4(w, k, x):
    """Set four packs."""
    w[k], w[k + 1], w[k + 2], w[k + 3] = x


@traced
def get9(w, k):
    """Return nine packs."""
    return w[k], w[k + 1], w[k + 2], w[k + 3], w[k + 4], w[k + 5], w[k + 6], w[k + 7], w[k + 8]


@traced
def put9(w, k, x):
    """Set nine packs."""
    w[k], w[k + 1], w[k + 2], w[k + 3], w[k + 4], w[k + 5], w[k + 6], w[k + 7], w[k + 8] = x


@traced
def zero3():
    """Return three packs of zeros."""
    nothing = spread(0.0)
    return nothing, nothing, nothing


@traced
def diagonal(x, y, z):
    """Return a diagonal matrix of packs."""
    nothing = spread(0.0)
    return x, nothing, nothing, nothing, y, nothing, nothing, nothing, z


@traced
def largest(x, y):
    """Return the larger numbers, x where y is not a number."""
    return choose(x, y, y, x)


@traced
def least(x, y):
    """Return the smaller numbers, x where y is not a number."""
    return choose(y, x, y, x)


@traced
def any_of(x):
    """Return whether a flag (0 or 1) is set for any arm."""
    return part(x, 0) + part(x, 1) + part(x, 2) + part(x, 3) > 0.5


@traced
def across(n, b):
    """Return [n] b: n x b, column by column."""
    x = cross(n, (b[0], b[3], b[6]))
    y = cross(n, (b[1], b[4], b[7]))
    z = cross(n, (b[2], b[5], b[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@traced
def add_cross(n, b):
    """Return [n] + b."""
    return b[0], b[1] - n[2], b[2] + n[1], b[3] + n[2], b[4], b[5] - n[0], b[6] - n[1], b[7] + n[0], b[8]


@traced
def negatives(a):
    """Return how many eigenvalues of a symmetric matrix are negative, by Descartes' rule; 3 if it is not finite."""
    trace = a[0] + a[4] + a[8]
    minors = a[0] * a[4] - a[1] * a[3] + a[0] * a[8] - a[2] * a[6] + a[4] * a[8] - a[5] * a[7]
    det = a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6]) + a[2] * (a[3] * a[7] - a[4] * a[6])
    first, second, third = choose(trace, 0.0, 1.0, 0.0), choose(minors, 0.0, 1.0, 0.0), choose(det, 0.0, 1.0, 0.0)
    return choose(size(det), np.inf, first + size(first - second) + size(second - third), 3.0)


@traced
def along(x, y, dx, dy, u, v):
    """Return the unit tangent of a muscle's path at the lever (x, y, 0), and the path's length per metre of centerline."""
    p = (v[0] - u[2] * y + dx, v[1] + u[2] * x + dy, v[2] + u[0] * y - u[1] * x)
    norm = root(dot(p, p))
    return axpy(1.0 / norm, p, ORIGIN), norm


@traced
def about(x, y, t):
    """Return the moment r x t of a muscle's tangent with the lever r = (x, y, 0)."""
    return y * t[2], -x * t[2], x * t[1] - y * t[0]


@traced
def stiffened(x, y, t, pull, uu, vu, vv):
    """Add what a muscle's pull, tension by path length per metre of centerline, adds to a section's stiffness."""
    p = axpy9(-pull, outer(t, t), scalar_matrix(pull))
    # P [-r] with the lever r = (x, y, 0), and below [r] times that.
    pa = (
        y * p[2], -x * p[2], x * p[1] - y * p[0],
        y * p[5], -x * p[5], x * p[4] - y * p[3],
        y * p[8], -x * p[8], x * p[7] - y * p[6],
    )  # fmt: skip
    around = (
        y * pa[6], y * pa[7], y * pa[8],
        -x * pa[6], -x * pa[7], -x * pa[8],
        x * pa[3] - y * pa[0], x * pa[4] - y * pa[1], x * pa[5] - y * pa[2],
    )  # fmt: skip
    return axpy9(1.0, around, uu), axpy9(1.0, pa, vu), axpy9(1.0, p, vv)


@written
def _turn(f, i, w, e, g0, k, q, h, guessed):
    """Collocate the quaternion over element e, eq. (28); return 1 where the nodes can resolve the rotation, else 0.

    Gauss-Seidel sweeps of h_j = h_0 + h sum_k a_jk (h_k o u_k)/2, a linear problem whose sweeps contract by about |u| h/4q,
    from the quaternions in `w` if they are `guessed` and otherwise from the exponential of the mean curvature. An arm that is
    not active keeps its quaternions.
    """
    wide = i[WIDE]
    a, b = i[A] + k * wide * wide, i[B] + k * wide
    close = largest(1e-14, 1e-3 * f[i[TOLERANCE]])
    q0 = get4(w, i[ENDS] + 4 * e)
    strain, quaternion, rate = i[STRAIN] + 6 * g0, i[QUATERNION] + 4 * g0, i[RATE]
    half = 0.5 * h
    for j in range(q):
        if guessed == 0:
            x = zero3()
            for l in range(q):
                x = axpy(half * f[a + j * wide + l], get3(w, strain + 6 * l), x)
            # By its series, good for elements that turn by less than three radians: a guess needs no more.
            y = dot(x, x)
            c = 1.0 - y * (0.5 - y * (1.0 / 24.0 - y * (1.0 / 720.0)))
            s = 1.0 - y * (1.0 / 6.0 - y * (1.0 / 120.0 - y * (1.0 / 5040.0)))
            d = quaternion_rate(q0, x)
            put4(
                w,
                quaternion + 4 * j,
                (c * q0[0] + s * d[0], c * q0[1] + s * d[1], c * q0[2] + s * d[2], c * q0[3] + s * d[3]),
            )
        old = get4(w, quaternion + 4 * j)
        put4(w, rate + 4 * j, quaternion_rate(old, axpy(half, get3(w, strain + 6 * j), zero3())))
    going, alive = w[i[ACTIVE]], spread(1.0)
    for _ in range(SWEEPS):
        change = spread(0.0)
        for j in range(q):
            h0, h1, h2, h3 = q0
            for l in range(q):
                coefficient, d = f[a + j * wide + l], get4(w, rate + 4 * l)
                h0 += coefficient * d[0]
                h1 += coefficient * d[1]
                h2 += coefficient * d[2]
                h3 += coefficient * d[3]
            old = get4(w, quaternion + 4 * j)
            new = (
                choose(0.5, going, h0, old[0]),
                choose(0.5, going, h1, old[1]),
                choose(0.5, going, h2, old[2]),
                choose(0.5, going, h3, old[3]),
            )
            moved = size(new[0] - old[0]) + size(new[1] - old[1]) + size(new[2] - old[2]) + size(new[3] - old[3])
            change = choose(change, moved, moved, change)
            change = choose(moved, np.inf, change, np.inf)
            put4(w, quaternion + 4 * j, new)
            put4(w, rate + 4 * j, quaternion_rate(new, axpy(half, get3(w, strain + 6 * j), zero3())))
        alive = choose(change, 1e6, alive, 0.0)
        going = choose(change, close, 0.0, going)
        if not any_of(going * alive):
            break
    h0, h1, h2, h3 = q0
    for l in range(q):
        coefficient, d = f[b + l], get4(w, rate + 4 * l)
        h0 += coefficient * d[0]
        h1 += coefficient * d[1]
        h2 += coefficient * d[2]
        h3 += coefficient * d[3]
    s = 1.0 / root(h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3)
    put4(w, i[ENDS] + 4 * (e + 1), (s * h0, s * h1, s * h2, s * h3))
    return choose(0.5, going, 0.0, alive)


@written
def evaluate(f, i, a, w, guessed, __):
    """Evaluate the equilibrium equations at a state: strain, tension, drive and load at STRAIN and behind.

    Rotations, wrenches and residuals go to their places; the quaternions there are near those of this state if they are
    `guessed`. Tensions of tendons are set to their drives. WORST is the dimensionless residual: the largest of |moment
    imbalance| L/K (an angle over the module), |force imbalance|/K (a strain) and |length mismatch|/rest length; TOTAL the sum
    of squares of all of them. Both inf where the state is no configuration (a rotation that the nodes cannot resolve, a muscle
    path that shrinks to a point).
    """
    modules, muscles, wide, most = i[MODULES], i[MUSCLES], i[WIDE], i[MOST]
    strain, tension, drive, load = i[STRAIN], i[TENSION], i[DRIVE], i[LOADS]
    ends, rotation, tangent, force, spin = i[ENDS], i[ROTATION], i[TANGENT], i[FORCE], i[SPIN]
    path, residual, paths, route, mass_below = i[PATH], i[RESIDUAL], i[PATHS], i[ROUTE], i[MASS_BELOW]
    worst, total, fine = spread(0.0), spread(0.0), spread(1.0)
    push, gravity, mass = get3(w, load), get3(w, load + 6), w[load + PAYLOAD_MASS]
    # Base to tip: rotations, tangents, forces.
    put4(w, ends, (spread(1.0), spread(0.0), spread(0.0), spread(0.0)))
    p = zero3()
    put3(w, i[POSITION], p)
    g0 = e = 0
    for k in range(modules):
        q = i[i[NODES_OF] + k]
        h = f[i[LENGTH] + k] / i[i[PIECES] + k]
        b = i[B] + k * wide
        for _ in range(i[i[PIECES] + k]):
            fine = choose(0.5, _turn(f, i, w, e, g0, k, q, h, guessed), fine, 0.0)
            for j in range(q):
                g = g0 + j
                r = rotation_matrix(get4(w, i[QUATERNION] + 4 * g))
                t = apply(r, get3(w, strain + 6 * g + 3))
                n = axpy(mass + f[mass_below + g], gravity, push)
                p = axpy(h * f[b + j], t, p)
                put9(w, rotation + 9 * g, r)
                put3(w, tangent + 3 * g, t)
                put3(w, force + 3 * g, apply_transposed(r, n))
                put3(w, spin + 3 * g, cross(t, n))
            g0 += q
            e += 1
            put3(w, i[POSITION] + 3 * e, p)
    # Tip to base: moments, section balance, path lengths.
    lever = apply(rotation_matrix(get4(w, ends + 4 * e)), get3(w, load + 10))
    m_end = axpy(mass, cross(lever, gravity), get3(w, load + 3))
    for muscle in range(muscles):
        w[paths + muscle] = spread(0.0)
        if i[i[KIND] + muscle] == TENDON:
            w[tension + muscle] = w[drive + muscle]
    for k in range(modules - 1, -1, -1):
        q, scale = i[i[NODES_OF] + k], f[i[LENGTH] + k]
        h = scale / i[i[PIECES] + k]
        b, coefficient = i[B] + k * wide, i[A] + k * wide * wide
        i0 = i[i[FIRST_MUSCLE] + k]
        mk = i[i[FIRST_MUSCLE] + k + 1] - i0
        for _ in range(i[i[PIECES] + k]):
            g0 -= q
            for j in range(q):
                g = g0 + j
                m = m_end
                for l in range(q):
                    m = axpy(h * (f[b + l] - f[coefficient + j * wide + l]), get3(w, spin + 3 * (g0 + l)), m)
                put3(w, i[MOMENT] + 3 * g, m)
                u, v = get3(w, strain + 6 * g), get3(w, strain + 6 * g + 3)
                ru = axpy(-1.0, apply_transposed(get9(w, rotation + 9 * g), m), zero3())
                rv = axpy(-1.0, get3(w, force + 3 * g), zero3())
                for c in range(mk):
                    at = route + 4 * (g * most + c)
                    x, y = f[at], f[at + 1]
                    t, norm = along(x, y, f[at + 2], f[at + 3], u, v)
                    fine = choose(1e-9, norm, fine, 0.0)
                    put4(w, path + 4 * (g * most + c), (t[0], t[1], t[2], norm))
                    w[paths + i0 + c] += h * f[b + j] * norm
                    pull = w[tension + i0 + c]
                    ru = axpy(pull, about(x, y, t), ru)
                    rv = axpy(pull, t, rv)
                put3(w, residual + 6 * g, ru)
                put3(w, residual + 6 * g + 3, rv)
                for d in range(6):
                    stiffness = f[i[STIFFNESS] + 6 * k + d]
                    off = w[residual + 6 * g + d] + stiffness * (w[strain + 6 * g + d] - f[i[REFERENCE] + 6 * k + d])
                    w[residual + 6 * g + d] = off
                    share = size(off) * ((scale if d < 3 else 1.0) / stiffness)
                    worst = largest(worst, share)
                    total += share * share
            for j in range(q):
                m_end = axpy(h * f[b + j], get3(w, spin + 3 * (g0 + j)), m_end)
    for muscle in range(muscles):
        kind, rest = i[i[KIND] + muscle], f[i[REST] + muscle]
        gap, soft = spread(0.0), spread(1.0)
        if kind != TENDON:
            pull, heat, length = w[tension + muscle], w[drive + muscle], w[paths + muscle]
            delta, soft, _ = law(kind, f, i[LAW] + PARAMETERS * muscle, rest, pull, heat)
            gap = length - rest - delta
            share = size(gap) * (1.0 / rest)
            worst = largest(worst, share)
            total += share * share
        w[i[GAP] + muscle], w[i[SOFTNESS] + muscle] = gap, soft
    good = choose(total, np.inf, fine, 0.0)
    w[i[WORST]] = choose(0.5, good, worst, np.inf)
    w[i[TOTAL]] = choose(0.5, good, total, np.inf)


@written
def _section(f, i, w, k, g, j, damping):
    """Linearise the section at node g: H = K + sum_i F_i d[r x t; t]/dxi, dv eliminated; return H_vv's negative eigenvalues.

    In the body frame, with n = R^T n, m = R^T m, B = H_vv^-1 and G = H_uv B:
    S = H_uu - G H_vu; N = G [n] - [m]; X = v n^T - (v.n) 1 - [n] B [n]; Y = [n] G^T; e = c_u - G c_v; z = [n] B c_v.
    Writes the global-frame blocks M = R S R^T, N, X, Y and e, z of node j of the element.
    """
    most = i[MOST]
    i0 = i[i[FIRST_MUSCLE] + k]
    mk = i[i[FIRST_MUSCLE] + k + 1] - i0
    stiffness = i[STIFFNESS] + 6 * k
    d = 1.0 + damping
    uu = diagonal(spread(d * f[stiffness]), spread(d * f[stiffness + 1]), spread(d * f[stiffness + 2]))
    vv = diagonal(spread(d * f[stiffness + 3]), spread(d * f[stiffness + 4]), spread(d * f[stiffness + 5]))
    nothing = spread(0.0)
    vu = diagonal(nothing, nothing, nothing)
    for c in range(mk):
        at = i[ROUTE] + 4 * (g * most + c)
        x, y = f[at], f[at + 1]
        t = get3(w, i[PATH] + 4 * (g * most + c))
        put3(w, i[WRENCH] + 6 * (g * most + c), about(x, y, t))
        put3(w, i[WRENCH] + 6 * (g * most + c) + 3, t)
        pull = w[i[TENSION] + i0 + c] / w[i[PATH] + 4 * (g * most + c) + 3]
        uu, vu, vv = stiffened(x, y, t, pull, uu, vu, vv)
    flexibility = inverse(vv)
    slide = matmul(flexibility, vu)
    gain = transpose(slide)
    put9(w, i[COMPLIANCE] + 9 * g, flexibility)
    put9(w, i[SLIDE] + 9 * g, slide)
    r = get9(w, i[ROTATION] + 9 * g)
    back = transpose(r)
    n, v = get3(w, i[FORCE] + 3 * g), get3(w, i[STRAIN] + 6 * g + 3)
    nf = across(n, flexibility)
    put9(w, i[M_BLOCK] + 9 * j, matmul(matmul(r, axpy9(-1.0, matmul(gain, vu), uu)), back))
    y_block = matmul(matmul(r, across(n, slide)), back)
    put9(w, i[Y_BLOCK] + 9 * j, y_block)
    # G [n] = -Y^T, and R [R^T m] R^T = [m].
    put9(
        w,
        i[N_BLOCK] + 9 * j,
        axpy9(-1.0, add_cross(get3(w, i[MOMENT] + 3 * g), transpose(y_block)), diagonal(nothing, nothing, nothing)),
    )
    # [n] B [n] = -[n] ([n] B)^T.
    along = -dot(v, n)
    x_block = axpy9(1.0, across(n, transpose(nf)), axpy9(1.0, outer(v, n), diagonal(along, along, along)))
    put9(w, i[X_BLOCK] + 9 * j, matmul(matmul(r, x_block), back))
    for c in range(mk):
        cu, cv = get3(w, i[WRENCH] + 6 * (g * most + c)), get3(w, i[WRENCH] + 6 * (g * most + c) + 3)
        put3(w, i[PULL] + 3 * (j * most + c), apply(r, axpy(-1.0, apply(gain, cv), cu)))
        put3(w, i[SWING] + 3 * (j * most + c), apply(r, apply(nf, cv)))
    return negatives(flexibility)


@written
def eliminate(f, i, a, w, _, damping):
    """Factorise the tangent at the state last given to `evaluate`, with `damping` times K added to it.

    For an element with w = (w_1..w_q), incoming rotation phi_0 and the module's dF, with A_rk = b_k - a_rk (A_0k = b_k):
    dm_r = D_r w + D_r0 phi_0 + D_rF dF + ..., where D_rl = h b_l P + h^2 sum_k A_rk a_kl X_k + h A_rl Y_l,
    D_r0 = P + h sum_k A_rk X_k and D_rF = Q + h sum_k A_rk z_k. Node r balances M w_r + N phi_r + e dF - dm_r = -rho_r;
    row 0 is the moment at the element's base, which the element before it sees. Path lengths follow from
    dl = stretch w + alpha phi_0 + beta dF.

    INDEX is how many eigenvalues of the tangent, as a quadratic form in the strain, are negative: as many as of its pivots, by
    Sylvester's law of inertia, less one for each muscle's pivot that is not negative: that muscle has made up for one of
    the rod's (Haynsworth).
    """
    modules, wide, most = i[MODULES], i[WIDE], i[MOST]
    matrix, phi, pulled, base, stretch = i[MATRIX], i[PHI], i[PULLED], i[BASE], i[STRETCH]
    pull, swing, x_block, y_block, n_block = i[PULL], i[SWING], i[X_BLOCK], i[Y_BLOCK], i[N_BLOCK]
    beta, wrench, compliance = i[BETA], i[WRENCH], i[COMPLIANCE]
    big_q, new_q, alpha, new_alpha = i[HANDED], i[HANDED] + 3 * most, i[HANDED] + 6 * most, i[HANDED] + 9 * most
    index, nothing = spread(0.0), spread(0.0)
    zero = diagonal(nothing, nothing, nothing)
    g0 = i[NODES]
    gravity, mass = get3(w, i[LOADS] + 6), w[i[LOADS] + PAYLOAD_MASS]
    lever = apply(rotation_matrix(get4(w, i[ENDS] + 4 * i[ELEMENTS])), get3(w, i[LOADS] + 10))
    weight = -mass * dot(lever, gravity)
    p_end = axpy9(mass, outer(lever, gravity), diagonal(weight, weight, weight))
    for k in range(modules - 1, -1, -1):
        q = i[i[NODES_OF] + k]
        h = f[i[LENGTH] + k] / i[i[PIECES] + k]
        i0 = i[i[FIRST_MUSCLE] + k]
        mk = i[i[FIRST_MUSCLE] + k + 1] - i0
        b, coefficient = i[B] + k * wide, i[A] + k * wide * wide
        coupling = i[COUPLING] + k * (wide + 1) * wide * wide
        for c in range(mk):
            put3(w, alpha + 3 * c, zero3())
            put3(w, big_q + 3 * c, zero3())
            for c2 in range(mk):
                w[beta + c * most + c2] = spread(0.0)
        for _ in range(i[i[PIECES] + k]):
            g0 -= q
            for j in range(q):
                index += _section(f, i, w, k, g0 + j, j, damping)
            inside = g0 > 0  # nothing turns the arm's own base: there phi_0 is zero and row 0 is of no use
            p_new = zero
            for r in range(0 if inside else 1, q + 1):  # row 0: the base; rows 1..q: the nodes
                row = g0 + r - 1
                late = coefficient + (r - 1) * wide  # of a row, A_rk = b_k - a_rk
                for l in range(q):
                    block = axpy9(h * f[b + l], p_end, zero)
                    for kk in range(q):
                        block = axpy9(f[coupling + (r * wide + l) * wide + kk], get9(w, x_block + 9 * kk), block)
                    share = f[b + l] if r == 0 else f[b + l] - f[late + l]
                    block = axpy9(h * share, get9(w, y_block + 9 * l), block)
                    if r == 0:
                        put9(w, base + 9 * (g0 + l), block)
                        continue
                    block = axpy9(-1.0, block, axpy9(h * f[late + l], get9(w, n_block + 9 * (r - 1)), zero))
                    if l == r - 1:
                        block = axpy9(1.0, get9(w, i[M_BLOCK] + 9 * l), block)
                    put9(w, matrix + 9 * (row * wide + l), block)
                if inside:
                    block = p_end
                    for kk in range(q):
                        share = f[b + kk] if r == 0 else f[b + kk] - f[late + kk]
                        block = axpy9(h * share, get9(w, x_block + 9 * kk), block)
                    if r == 0:
                        p_new = block
                    else:
                        put9(w, phi + 9 * row, axpy9(-1.0, get9(w, n_block + 9 * (r - 1)), block))
                for c in range(mk):
                    x = get3(w, big_q + 3 * c)
                    for kk in range(q):
                        share = f[b + kk] if r == 0 else f[b + kk] - f[late + kk]
                        x = axpy(h * share, get3(w, swing + 3 * (kk * most + c)), x)
                    if r == 0:
                        put3(w, new_q + 3 * c, x)
                    else:
                        put3(w, pulled + 3 * (row * most + c), axpy(-1.0, get3(w, pull + 3 * ((r - 1) * most + c)), x))
            for c in range(mk):
                x0 = get3(w, alpha + 3 * c)
                x = x0
                for j in range(q):
                    x = axpy(-h * f[b + j], get3(w, swing + 3 * (j * most + c)), x)
                put3(w, new_alpha + 3 * c, x)
                for l in range(q):
                    x = axpy(f[b + l], axpy(1.0, x0, get3(w, pull + 3 * (l * most + c))), zero3())
                    for j in range(q):
                        x = axpy(-h * f[b + j] * f[coefficient + j * wide + l], get3(w, swing + 3 * (j * most + c)), x)
                    put3(w, stretch + 3 * ((g0 + l) * most + c), axpy(h, x, zero3()))
                for c2 in range(mk):
                    gained = w[beta + c * most + c2]
                    for j in range(q):
                        t, t2 = (
                            get3(w, wrench + 6 * ((g0 + j) * most + c) + 3),
                            get3(w, wrench + 6 * ((g0 + j) * most + c2) + 3),
                        )
                        gained -= h * f[b + j] * dot(t, apply(get9(w, compliance + 9 * (g0 + j)), t2))
                    w[beta + c * most + c2] = gained
            index += _factorise_blocks(i, w, inside, g0, q, mk)
            for g in range(g0, g0 + q):
                if inside:
                    p_new = axpy9(1.0, matmul(get9(w, base + 9 * g), get9(w, phi + 9 * g)), p_new)
                for c in range(mk):
                    stretched = get3(w, stretch + 3 * (g * most + c))
                    if inside:
                        x = apply_transposed(get9(w, phi + 9 * g), stretched)
                        put3(w, new_alpha + 3 * c, axpy(1.0, x, get3(w, new_alpha + 3 * c)))
                        x = apply(get9(w, base + 9 * g), get3(w, pulled + 3 * (g * most + c)))
                        put3(w, new_q + 3 * c, axpy(1.0, x, get3(w, new_q + 3 * c)))
                    for c2 in range(mk):
                        w[beta + c * most + c2] += dot(stretched, get3(w, pulled + 3 * (g * most + c2)))
            if inside:
                for c in range(mk):
                    put3(w, alpha + 3 * c, get3(w, new_alpha + 3 * c))
                    put3(w, big_q + 3 * c, get3(w, new_q + 3 * c))
                p_end = p_new
        # The module's tensions: (beta - softness) dF + alpha phi_0 = -(gap + gamma). At the arm's own base phi_0 = 0.
        muscle = i[MUSCLE_MATRIX] + k * most * most
        follow = i[MUSCLE_PHI] + 3 * k * most
        for c in range(mk):
            tendon = i[i[KIND] + i0 + c] == TENDON  # its row: -dF = -gap
            for c2 in range(mk):
                w[muscle + c * most + c2] = spread(0.0) if tendon else w[beta + c * most + c2]
            w[muscle + c * most + c] -= w[i[SOFTNESS] + i0 + c]
            put3(w, follow + 3 * c, zero3() if tendon else get3(w, alpha + 3 * c))
            if k == 0:
                put3(w, follow + 3 * c, zero3())
            put3(w, i[MUSCLE_MOMENT] + 3 * (k * most + c), get3(w, big_q + 3 * c))
        index -= _factorise(w, muscle, mk, most)
        if k > 0:
            for d in range(3):
                for c in range(mk):
                    w[i[GAMMA] + c] = w[follow + 3 * c + d]
                _solve(w, muscle, mk, most, i[GAMMA])
                for c in range(mk):
                    w[follow + 3 * c + d] = w[i[GAMMA] + c]
            for c in range(mk):
                p_end = axpy9(-1.0, outer(get3(w, big_q + 3 * c), get3(w, follow + 3 * c)), p_end)
    w[i[INDEX]] = index


@written
def _factorise_blocks(i, w, inside, g0, q, mk):
    """LU without pivoting, in 3 x 3 blocks, of an element's matrix; PHI (if `inside`) and PULLED become the solutions.

    At a stable equilibrium the matrix is positive definite up to a diagonal scaling, so pivoting buys nothing; where it is
    singular the answer is not finite. Diagonal blocks are stored inverted. Returns how many of their eigenvalues are negative.
    """
    most, stride = i[MOST], 9 * i[WIDE]
    matrix, phi, pulled = i[MATRIX] + g0 * stride, i[PHI] + 9 * g0, i[PULLED] + 3 * g0 * most
    negative = spread(0.0)
    for k in range(q):
        row_k = matrix + k * stride
        pivot = inverse(get9(w, row_k + 9 * k))
        negative += negatives(pivot)
        put9(w, row_k + 9 * k, pivot)
        for r in range(k + 1, q):
            row = matrix + r * stride
            factor = matmul(get9(w, row + 9 * k), pivot)
            put9(w, row + 9 * k, factor)
            for j in range(k + 1, q):
                product = matmul(factor, get9(w, row_k + 9 * j))
                put9(w, row + 9 * j, axpy9(-1.0, product, get9(w, row + 9 * j)))
            if inside:
                put9(w, phi + 9 * r, axpy9(-1.0, matmul(factor, get9(w, phi + 9 * k)), get9(w, phi + 9 * r)))
            for c in range(mk):
                x = apply(factor, get3(w, pulled + 3 * (k * most + c)))
                put3(w, pulled + 3 * (r * most + c), axpy(-1.0, x, get3(w, pulled + 3 * (r * most + c))))
    for k in range(q - 1, -1, -1):
        row_k = matrix + k * stride
        if inside:
            block = get9(w, phi + 9 * k)
            for l in range(k + 1, q):
                block = axpy9(-1.0, matmul(get9(w, row_k + 9 * l), get9(w, phi + 9 * l)), block)
            put9(w, phi + 9 * k, matmul(get9(w, row_k + 9 * k), block))
        for c in range(mk):
            x = get3(w, pulled + 3 * (k * most + c))
            for l in range(k + 1, q):
                x = axpy(-1.0, apply(get9(w, row_k + 9 * l), get3(w, pulled + 3 * (l * most + c))), x)
            put3(w, pulled + 3 * (k * most + c), apply(get9(w, row_k + 9 * k), x))
    return negative


@written
def _factorise(w, matrix, order, stride):
    """LU without pivoting of a matrix, in place, the diagonal of U inverted; returns how many pivots are positive."""
    positive = spread(0.0)
    for k in range(order):
        pivot = w[matrix + k * stride + k]
        positive += choose(0.0, pivot, 1.0, 0.0)
        pivot = 1.0 / pivot
        w[matrix + k * stride + k] = pivot
        for r in range(k + 1, order):
            factor = w[matrix + r * stride + k] * pivot
            w[matrix + r * stride + k] = factor
            for j in range(k + 1, order):
                w[matrix + r * stride + j] -= factor * w[matrix + k * stride + j]
    return positive


@written
def _solve(w, matrix, order, stride, x):
    """Solve with the factors of `_factorise` for the packs from `x` on, in place."""
    for r in range(order):
        value = w[x + r]
        for l in range(r):
            value -= w[matrix + r * stride + l] * w[x + l]
        w[x + r] = value
    for r in range(order - 1, -1, -1):
        value = w[x + r]
        for l in range(r + 1, order):
            value -= w[matrix + r * stride + l] * w[x + l]
        w[x + r] = value * w[matrix + r * stride + r]


@written
def substitute(f, i, a, w, _, __):
    """Solve the factorised tangent for the right-hand side -(RESIDUAL, GAP).

    Writes the changes of strain (BEND, SHEAR), tension (CHANGE) and tip (TIP), the rotation of each node (TURNED), and the
    largest rotation [rad] (ROTATED) and the largest |dv| (SHEARED) of the step.
    """
    modules, wide, most = i[MODULES], i[WIDE], i[MOST]
    matrix, answer, change, gamma, sources = i[MATRIX], i[ANSWER], i[CHANGE], i[GAMMA], i[SOURCES]
    residual, rotation, wrench, compliance, slide = i[RESIDUAL], i[ROTATION], i[WRENCH], i[COMPLIANCE], i[SLIDE]
    force, pulled = i[FORCE], i[PULLED]
    g0 = i[NODES]
    p_end = zero3()
    for k in range(modules - 1, -1, -1):
        q = i[i[NODES_OF] + k]
        h = f[i[LENGTH] + k] / i[i[PIECES] + k]
        i0 = i[i[FIRST_MUSCLE] + k]
        mk = i[i[FIRST_MUSCLE] + k + 1] - i0
        b, coefficient = i[B] + k * wide, i[A] + k * wide * wide
        for c in range(mk):
            w[gamma + c] = spread(0.0)
        for _ in range(i[i[PIECES] + k]):
            g0 -= q
            for j in range(q):
                g = g0 + j
                r, ru, rv = get9(w, rotation + 9 * g), get3(w, residual + 6 * g), get3(w, residual + 6 * g + 3)
                slid = apply(get9(w, compliance + 9 * g), rv)
                put3(w, sources + 6 * j, apply(r, axpy(-1.0, apply_transposed(get9(w, slide + 9 * g), rv), ru)))
                put3(w, sources + 6 * j + 3, apply(r, cross(get3(w, force + 3 * g), slid)))
                for c in range(mk):
                    w[gamma + c] -= h * f[b + j] * dot(get3(w, wrench + 6 * (g * most + c) + 3), slid)
            for j in range(q):
                x = axpy(-1.0, get3(w, sources + 6 * j), p_end)
                for l in range(q):
                    x = axpy(h * (f[b + l] - f[coefficient + j * wide + l]), get3(w, sources + 6 * l + 3), x)
                for l in range(j):
                    block = get9(w, matrix + 9 * ((g0 + j) * wide + l))
                    x = axpy(-1.0, apply(block, get3(w, answer + 3 * (g0 + l))), x)
                put3(w, answer + 3 * (g0 + j), x)
            for j in range(q - 1, -1, -1):
                x = get3(w, answer + 3 * (g0 + j))
                for l in range(j + 1, q):
                    block = get9(w, matrix + 9 * ((g0 + j) * wide + l))
                    x = axpy(-1.0, apply(block, get3(w, answer + 3 * (g0 + l))), x)
                put3(w, answer + 3 * (g0 + j), apply(get9(w, matrix + 9 * ((g0 + j) * wide + j)), x))
            for l in range(q):
                x = get3(w, answer + 3 * (g0 + l))
                if g0 > 0:
                    p_end = axpy(1.0, apply(get9(w, i[BASE] + 9 * (g0 + l)), x), p_end)
                    p_end = axpy(h * f[b + l], get3(w, sources + 6 * l + 3), p_end)
                for c in range(mk):
                    w[gamma + c] += dot(get3(w, i[STRETCH] + 3 * ((g0 + l) * most + c)), x)
        # dF for phi_0 = 0; the part that follows phi_0 is in MUSCLE_PHI.
        for c in range(mk):
            tendon = i[i[KIND] + i0 + c] == TENDON
            w[change + i0 + c] = -w[i[GAP] + i0 + c] - (spread(0.0) if tendon else w[gamma + c])
        _solve(w, i[MUSCLE_MATRIX] + k * most * most, mk, most, change + i0)
        for c in range(mk):
            p_end = axpy(w[change + i0 + c], get3(w, i[MUSCLE_MOMENT] + 3 * (k * most + c)), p_end)
    # Base to tip.
    phi0, dp = zero3(), zero3()
    rotated, sheared = spread(0.0), spread(0.0)
    for k in range(modules):
        q = i[i[NODES_OF] + k]
        h = f[i[LENGTH] + k] / i[i[PIECES] + k]
        i0 = i[i[FIRST_MUSCLE] + k]
        mk = i[i[FIRST_MUSCLE] + k + 1] - i0
        b, coefficient = i[B] + k * wide, i[A] + k * wide * wide
        for c in range(mk):
            w[change + i0 + c] -= dot(get3(w, i[MUSCLE_PHI] + 3 * (k * most + c)), phi0)
        for _ in range(i[i[PIECES] + k]):
            for g in range(g0, g0 + q):
                x = get3(w, answer + 3 * g)
                if g0 > 0:
                    x = axpy(1.0, apply(get9(w, i[PHI] + 9 * g), phi0), x)
                for c in range(mk):
                    x = axpy(w[change + i0 + c], get3(w, pulled + 3 * (g * most + c)), x)
                put3(w, answer + 3 * g, x)
            for j in range(q):
                g = g0 + j
                phi = phi0
                for l in range(q):
                    phi = axpy(h * f[coefficient + j * wide + l], get3(w, answer + 3 * (g0 + l)), phi)
                rotated = largest(rotated, dot(phi, phi))
                put3(w, i[TURNED] + 3 * g, phi)
                r = get9(w, rotation + 9 * g)
                bend = apply_transposed(r, get3(w, answer + 3 * g))
                y = axpy(-1.0, get3(w, residual + 6 * g + 3), cross(get3(w, force + 3 * g), apply_transposed(r, phi)))
                for c in range(mk):
                    y = axpy(-w[change + i0 + c], get3(w, wrench + 6 * (g * most + c) + 3), y)
                shear = axpy(-1.0, apply(get9(w, slide + 9 * g), bend), apply(get9(w, compliance + 9 * g), y))
                sheared = largest(sheared, dot(shear, shear))
                put3(w, i[BEND] + 3 * g, bend)
                put3(w, i[SHEAR] + 3 * g, shear)
                dp = axpy(h * f[b + j], axpy(1.0, cross(phi, get3(w, i[TANGENT] + 3 * g)), apply(r, shear)), dp)
            for l in range(q):
                phi0 = axpy(h * f[b + l], get3(w, answer + 3 * (g0 + l)), phi0)
            g0 += q
    put3(w, i[TIP], dp)
    put3(w, i[TIP] + 3, phi0)
    # No number is the largest where one is not a number.
    whole = dot(phi0, phi0)
    rotated = largest(rotated, whole)
    w[i[ROTATED]] = choose(size(whole), np.inf, root(rotated), np.nan)
    w[i[SHEARED]] = choose(size(dot(dp, dp)), np.inf, root(sheared), np.nan)


@written
def newton(f, i, a, w, certified, __):
    """Solve by Newton from the state at STRAIN, in place, each arm on the branch of equilibria that it is near.

    Newton must go straight to the answer. It gives up where a step turns a section by more than MAX_ROTATION_STEP; where a step
    is not CONTRACTION times shorter than the one before; or if it takes long. For a solve that has to be steered may end on
    another branch. One that contracts finds the only equilibrium nearby (the theorem of Newton and Kantorovich in affine
    covariant form; Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 5.1). Where steps shrink to less than a
    quarter that holds for all the way from the start, so the answer is on the start's branch; where they do not, going back
    tells, `ladder.returns`. What has MOVED, drive or load, takes a step even where the start would do: a small change moves the
    arm a little, not in jerks.

    The answer must be stable by the count of `eliminate` there; not so a start that is the answer and `certified` already.
    Factors of an earlier step would not do, however well they serve for steps: the smallest eigenvalue changes by as much as
    the arm turns.

    The tangent is factorised for every KEPT-th step of all arms. In between a step with old factors gains almost as much as
    one with new ones, at a third of the cost; an arm for which it would not waits. An arm that is done, or lost, keeps its
    state. So what an arm does depends on itself alone. CONVERGED, WORST and ITERATIONS tell the end, and SLOWNESS the largest
    ratio of a step to the one before, 0 where the first was not LONG.
    """
    nodes, muscles = i[NODES], i[MUSCLES]
    moved = w[i[MOVED]]
    worst = extent = spread(np.inf)
    slowness = spread(0.0)
    iterations, first, converged, active = spread(0.0), spread(0.0), spread(0.0), spread(1.0)
    for turn in range(KEPT * MAX_ITERATIONS):
        w[i[ACTIVE]] = active
        call_kernel(a[EVALUATE], f, i, a, w, turn, 0.0)
        before, worst = worst, w[i[WORST]]
        begun = choose(0.5, iterations, 1.0, 1.0 - moved)
        there = choose(worst, f[i[TOLERANCE]], active * begun, 0.0)
        converged = converged + there
        active = choose(worst, np.inf, choose(iterations, MAX_ITERATIONS - 0.5, active - there, 0.0), 0.0)
        if not any_of(active):
            break
        going = active
        if turn % KEPT == 0:
            call_kernel(a[ELIMINATE], f, i, a, w, 0, NEUTRAL)
        else:
            going = choose(worst, REUSE * before, active, 0.0)
            if not any_of(going):
                continue
        call_kernel(a[SUBSTITUTE], f, i, a, w, 0, 0.0)
        rotated, sheared = w[i[ROTATED]], w[i[SHEARED]]
        last, step = extent, rotated + sheared
        good = choose(step, CONTRACTION * last, 1.0, choose(step, ROUND_OFF, 1.0, 0.0))
        good = choose(rotated, MAX_ROTATION_STEP, choose(sheared, MAX_SHEAR_STEP, good, 0.0), 0.0)
        active = active - going * (1.0 - good)
        first = choose(0.5, iterations, first, choose(0.5, going, step, first))
        going = going * good
        slowness = largest(slowness, choose(0.5, going, choose(last, np.inf, step / last, 0.0), 0.0))
        extent = choose(0.5, going, step, last)
        iterations = iterations + going
        for g in range(nodes):
            half = axpy(0.5, get3(w, i[TURNED] + 3 * g), zero3())
            old = get4(w, i[QUATERNION] + 4 * g)
            new = quaternion_turn(half, old)
            put4(
                w,
                i[QUATERNION] + 4 * g,
                (
                    choose(0.5, going, new[0], old[0]), choose(0.5, going, new[1], old[1]),
                    choose(0.5, going, new[2], old[2]), choose(0.5, going, new[3], old[3]),
                ),
            )  # fmt: skip
            for d in range(3):
                at = i[STRAIN] + 6 * g + d
                w[at] = choose(0.5, going, w[at] + w[i[BEND] + 3 * g + d], w[at])
                w[at + 3] = choose(0.5, going, w[at + 3] + w[i[SHEAR] + 3 * g + d], w[at + 3])
        for muscle in range(muscles):
            at = i[TENSION] + muscle
            w[at] = choose(0.5, going, w[at] + w[i[CHANGE] + muscle], w[at])
    counted = choose(0.5, iterations, 1.0, 1.0 - certified)
    if any_of(converged * counted):
        call_kernel(a[ELIMINATE], f, i, a, w, 0, NEUTRAL)
        converged = choose(counted * w[i[INDEX]], 0.5, converged, 0.0)
    w[i[CONVERGED]], w[i[ITERATIONS]], w[i[SLOWNESS]] = converged, iterations, choose(LONG, first, slowness, 0.0)


@written
def _copy(w, source, target, count):
    for k in range(count):
        w[target + k] = w[source + k]


@written
def follow(f, i, a, w, budget, first):
    """Follow the branch of equilibria of one arm, in all places of the packs, from FROM_DRIVE to TO_DRIVE, loads likewise.

    Newton over `first`, a share of the way, to begin with; its first step is the tangent's prediction. Where it fails, in
    substeps, shortened on failure and doubled on success, for at most `budget` iterations. In: the equilibrium where the way
    begins, at STRAIN. Out: that where it ends; FROM_DRIVE and FROM_LOADS, where that is; OUTCOME: rung (SUBSTEPS or FAILED),
    residual, Newton iterations in all, next substep as a share of what is left of the way, largest SLOWNESS.
    """
    strains, muscles = 6 * i[NODES], i[MUSCLES]
    way = muscles + LOAD
    state, good, start, goal = strains + muscles, i[GOOD_STRAIN], i[FROM_DRIVE], i[TO_DRIVE]
    _copy(w, i[STRAIN], good, state)
    moved = 0.0
    for k in range(way):
        if part(w[start + k], 0) != part(w[goal + k], 0):
            moved = 1.0
    w[i[MOVED]] = spread(moved)
    slowest, spent, work, done, step, rung = 0.0, 0.0, 0.0, 0.0, first, SUBSTEPS
    while True:
        here = least(1.0, done + step)
        share = (here - done) / (1.0 - done)
        for k in range(way):
            w[i[DRIVE] + k] = w[goal + k] if here == 1.0 else w[start + k] + share * (w[goal + k] - w[start + k])
        call_kernel(a[NEWTON], f, i, a, w, 0, 0.0)
        iterations, worst = part(w[i[ITERATIONS]], 0), part(w[i[WORST]], 0)
        spent += iterations
        work += iterations + 1.0
        if part(w[i[CONVERGED]], 0) > 0.5:
            slowest = largest(slowest, part(w[i[SLOWNESS]], 0))
            _copy(w, i[DRIVE], start, way)
            if here == 1.0:
                step = 1.0
                break
            done, step = here, 2.0 * step
            _copy(w, i[STRAIN], good, state)
            continue
        _copy(w, good, i[STRAIN], state)
        step *= 0.5
        if (step < SMALLEST_SUBSTEP) | (work >= budget):
            rung = FAILED
            step = least(0.5, step / (1.0 - done))
            break
    outcome = i[OUTCOME]
    w[outcome], w[outcome + 1], w[outcome + 2] = spread(1.0 * rung), spread(worst), spread(spent)
    w[outcome + 3], w[outcome + 4] = spread(step), spread(slowest)


@written
def _load(x, source, y, at, count, lane):
    """Put floats from place `source` on of `x` into packs from place `at` on, for one arm."""
    for k in range(count):
        y[(at + k) * PACK + lane] = x[source + k]


@written
def _store(x, target, y, at, count, lane):
    """Put the floats of one arm of the packs from place `at` on into those from place `target` on of `x`."""
    for k in range(count):
        x[target + k] = y[(at + k) * PACK + lane]


@written
def _tell(i, a, w, place, row):
    """Write the state of place `place` of the packs to row `row` of the lanes: an answer."""
    nodes, muscles = i[NODES], i[MUSCLES]
    y = floats_of(w)
    _store(floats_at(a[AT_STRAIN]), 6 * nodes * row, y, i[STRAIN], 6 * nodes, place)
    _store(floats_at(a[AT_TENSION]), muscles * row, y, i[TENSION], muscles, place)
    _store(floats_at(a[AT_FROM_DRIVE]), muscles * row, y, i[DRIVE], muscles, place)
    _store(floats_at(a[AT_FROM_LOAD]), LOAD * row, y, i[LOADS], LOAD, place)
    _store(floats_at(a[AT_LENGTHS]), muscles * row, y, i[PATHS], muscles, place)
    end, last = i[ENDS] + 4 * i[ELEMENTS], i[POSITION] + 3 * i[ELEMENTS]
    r = rotation_matrix(get4(w, end))
    tip = floats_at(a[AT_TIP])
    for d in range(3):
        tip[16 * row + 4 * d + 3] = y[(last + d) * PACK + place]
    at = 16 * row
    tip[at], tip[at + 1], tip[at + 2] = part(r[0], place), part(r[1], place), part(r[2], place)
    tip[at + 4], tip[at + 5], tip[at + 6] = part(r[3], place), part(r[4], place), part(r[5], place)
    tip[at + 8], tip[at + 9], tip[at + 10] = part(r[6], place), part(r[7], place), part(r[8], place)


@written
def heat(f, i, a, w, n, _):
    """Heat the TCAs of the lanes of pack `n` for one step: `thermal.step` at the powers asked for, under the cut-off.

    Writes the powers [W], and to the drives the temperatures [degC] that come of them.
    """
    heated = a[HEATED]
    action, temperature, power = floats_at(a[AT_ACTION]), floats_at(a[AT_TEMPERATURE]), floats_at(a[AT_POWER])
    constants, drive = floats_at(a[AT_HEATING]), floats_at(a[AT_DRIVE])
    for row in range(n * PACK, least(n * PACK + PACK, a[COUNT])):
        for k in range(heated):
            at = row * heated + k
            kept, loss, ambient = (
                constants[KEPT_SHARE * heated + k],
                constants[LOSS * heated + k],
                constants[AMBIENT_AT * heated + k],
            )
            asked = 0.5 * (least(largest(-1.0, action[at]), 1.0) + 1.0) * constants[MAX_POWER * heated + k]
            end = (constants[LIMIT_AT * heated + k] - kept * temperature[at]) / constants[LOST_SHARE * heated + k]
            given = least(asked, largest(0.0, loss * (end - ambient)))
            end = ambient + given / loss
            power[at] = given
            drive[at] = end + (temperature[at] - end) * kept


@written
def lanes(f, i, a, w, n, first):
    """Solve the lanes of pack `n` of the arrays of `collocation.solve_lanes`: together, and stragglers one by one."""
    strains, muscles, count, drives = 6 * i[NODES], i[MUSCLES], a[COUNT], a[HEATED]
    y = floats_of(w)
    strain, tension, report = floats_at(a[AT_STRAIN]), floats_at(a[AT_TENSION]), floats_at(a[AT_REPORT])
    from_drive, from_load = floats_at(a[AT_FROM_DRIVE]), floats_at(a[AT_FROM_LOAD])
    drive, load = floats_at(a[AT_DRIVE]), floats_at(a[AT_LOAD])
    for place in range(PACK):
        row = least(n * PACK + place, count - 1)  # fill up with copies of the last
        _load(strain, strains * row, y, i[STRAIN], strains, place)
        _load(tension, muscles * row, y, i[TENSION], muscles, place)
        _load(drive, drives * row, y, i[DRIVE], muscles, place)
        _load(load, LOAD * row, y, i[LOADS], LOAD, place)
        moved = 0.0
        for k in range(muscles):
            if drive[drives * row + k] != from_drive[muscles * row + k]:
                moved = 1.0
        for k in range(LOAD):
            if load[LOAD * row + k] != from_load[LOAD * row + k]:
                moved = 1.0
        y[i[MOVED] * PACK + place] = moved
    lost = 0
    rows = least(PACK, count - n * PACK)
    if first == 1.0:
        # What is heated has been solved before.
        call_kernel(a[NEWTON], f, i, a, w, 0 if a[AT_ACTION] == 0 else 1, 0.0)
        for place in range(rows):
            row = n * PACK + place
            report[REPORT * row], report[REPORT * row + 1] = 1.0 * WARM, y[i[WORST] * PACK + place]
            report[REPORT * row + 2], report[REPORT * row + 3] = y[i[ITERATIONS] * PACK + place], 0.0
            report[REPORT * row + 4] = y[i[SLOWNESS] * PACK + place]
            if y[i[CONVERGED] * PACK + place] > 0.5:
                _tell(i, a, w, place, row)
                continue
            lost |= 1 << place
            report[REPORT * row], report[REPORT * row + 3] = 1.0 * FAILED, FIRST_SUBSTEP
        if a[BUDGET] == 0:
            return
    else:
        lost = (1 << rows) - 1
        for place in range(rows):
            report[REPORT * (n * PACK + place) + 2] = 0.0
    for lane in range(rows):
        if lost & (1 << lane) != 0:
            row = n * PACK + lane
            for place in range(PACK):
                _load(strain, strains * row, y, i[STRAIN], strains, place)
                _load(tension, muscles * row, y, i[TENSION], muscles, place)
                _load(from_drive, muscles * row, y, i[FROM_DRIVE], muscles, place)
                _load(from_load, LOAD * row, y, i[FROM_LOADS], LOAD, place)
                _load(drive, drives * row, y, i[TO_DRIVE], muscles, place)
                _load(load, LOAD * row, y, i[TO_LOADS], LOAD, place)
            call_kernel(a[FOLLOW], f, i, a, w, a[BUDGET], FIRST_SUBSTEP if first == 1.0 else first)
            before = report[REPORT * row + 2]
            for k in range(REPORT):
                report[REPORT * row + k] = y[(i[OUTCOME] + k) * PACK]
            report[REPORT * row + 2] += before
            if report[REPORT * row] != FAILED:
                report[REPORT * row + 3] = 0.0
                _tell(i, a, w, 0, row)
            else:
                _store(strain, strains * row, y, i[STRAIN], strains, 0)
                _store(tension, muscles * row, y, i[TENSION], muscles, 0)
                _store(from_drive, muscles * row, y, i[FROM_DRIVE], muscles, 0)
                _store(from_load, LOAD * row, y, i[FROM_LOADS], LOAD, 0)


# Numba compiles a function by its own source and keeps it in its cache by its name: so each is written out.
def _evaluate(f, i, a, w, n, x):
    evaluate(f, i, a, w, n, x)


def _eliminate(f, i, a, w, n, x):
    eliminate(f, i, a, w, n, x)


def _substitute(f, i, a, w, n, x):
    substitute(f, i, a, w, n, x)


def _newton(f, i, a, w, n, x):
    newton(f, i, a, w, n, x)


def _follow(f, i, a, w, n, x):
    follow(f, i, a, w, n, x)


def _heat(f, i, a, w, n, x):
    heat(f, i, a, w, n, x)


def _lanes(f, i, a, w, n, x):
    lanes(f, i, a, w, n, x)


COMPILED = (_evaluate, _eliminate, _substitute, _newton, _follow, _heat, _lanes)
"""What Numba compiles, in the order of the first places in `a`."""
