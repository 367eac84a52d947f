"""The equilibrium equations of an arm, by Gauss collocation of the strain, their tangent and its factors.

Each module is cut into elements, each element carries Gauss nodes; the unknowns are the strain at every node and the muscles'
tensions. A muscle is internal to the arm, so the total internal wrench (rod + muscles) feels external loads only:

* the total force n(s) in the global frame is known beforehand: tip force + weight below s;
* the rotation follows from the strain (R' = R u^, collocated on quaternions), the moment from m' = -p' x n;
* at a node the strain balances K (xi - xi*) + sum_i F_i [r x t; t] = R^T [m; n]: no derivative of the strain appears, and
  no rule for joints, because the total wrench is continuous across them (erratum of eq. (26));
* one equation per muscle: path length - rest length = elongation(tension, drive), eq. (24).

Newton's tangent comes from continuous variations in the global frame: with w = R du, phi' = w, dp' = phi x p' + R dv,
dm' = -dp' x n. Eliminating dv at the nodes leaves three unknowns w a node; elements are eliminated from the tip to the base,
each handing on dm = P phi + Q dF + p at its base (a Riccati recursion: linear cost in the number of elements, stable for any
length), and the tensions of a module are eliminated at its base. Gauss weights make this tangent that of the discrete equations
up to the discretisation error. Fields, axes and indices: `fields`.
"""

import math

from tca_envs.mechanics import laws
from tca_envs.mechanics.laws import TENDON
from tca_envs.mechanics.solver.cache import part
from tca_envs.mechanics.solver.simd import (
    Quat,
    Vec,
    any_lane,
    cross,
    diagonal,
    dot,
    hat,
    inverse,
    lever,
    negatives,
    norm1,
    outer,
    product,
    rotation,
    spread,
    sqrt,
    square,
    times,
    transpose,
    where,
)

SWEEPS = 60
"""Of the collocation of rotations; an element that needs more turns too far for its nodes."""
SHORTEST_PATH = 1e-9
"""A muscle's path that is shorter, per length of the rod, has no direction."""

elongation = part(laws.elongation)
part(laws.coil)  # which it calls


@part
def turn_element(arm, rod, k, e, g0, guessed):
    """Collocate the quaternion over an element, eq. (28); return 1 where the nodes can resolve the rotation, else 0.

    Gauss-Seidel sweeps of h_j = h_0 + h sum_l a_jl (h_l o u_l)/2, a linear problem whose sweeps contract by about |u| h/4q,
    from the quaternions that are there if they are `guessed` and otherwise from the exponential of the mean curvature.
    """
    q, close, h0 = arm.width[k], max(1e-14, 1e-3 * arm.tolerance), rod.h_end[e]
    for j in range(q):
        g = g0 + j
        if not guessed:
            x = Vec(0.0, 0.0, 0.0)
            for l in range(q):
                x += arm.inner[k, j, l] * rod.u[g0 + l]
            x = 0.5 * x
            y = dot(x, x)
            # Cosine and sine by their series, good for elements that turn by less than three radians: a guess needs no more.
            c = 1.0 - y * (0.5 - y * (1.0 / 24.0 - y * (1.0 / 720.0)))
            s = 1.0 - y * (1.0 / 6.0 - y * (1.0 / 120.0 - y * (1.0 / 5040.0)))
            rod.h[g] = c * h0 + s * product(h0, x)
        rod.rate[j] = 0.5 * product(rod.h[g], rod.u[g])
    going, alive = rod.active, 1.0
    for _ in range(SWEEPS):
        change = 0.0
        for j in range(q):
            g = g0 + j
            h = h0
            for l in range(q):
                h += arm.inner[k, j, l] * rod.rate[l]
            h = where(going > 0.5, h, rod.h[g])
            moved = norm1(h - rod.h[g])
            change = where(moved <= change, change, moved)
            rod.h[g] = h
            rod.rate[j] = 0.5 * product(h, rod.u[g])
        alive = where(change < 1e6, alive, 0.0)
        going = where(change < close, 0.0, going)
        if not any_lane(going * alive > 0.5):
            break
    h = h0
    for l in range(q):
        h += arm.weight[k, l] * rod.rate[l]
    rod.h_end[e + 1] = (1.0 / sqrt(square(h))) * h
    return where(going > 0.5, 0.0, alive)


@part
def base_to_tip(arm, rod, guessed):
    """Integrate rotations, positions and forces; return 1 where the nodes can resolve the rotation, else 0."""
    fine = 1.0
    gravity, mass, push = rod.gravity, rod.mass, rod.push
    p = Vec(0.0, 0.0, 0.0)
    rod.h_end[0] = Quat(1.0, 0.0, 0.0, 0.0)
    rod.p_end[0] = p
    g0 = e = 0
    for k in range(arm.modules):
        for _ in range(arm.pieces[k]):
            fine = where(turn_element(arm, rod, k, e, g0, guessed) > 0.5, fine, 0.0)
            for j in range(arm.width[k]):
                g = g0 + j
                R = rotation(rod.h[g])
                tangent = R @ rod.v[g]
                force = push + (mass + arm.mass_beyond[g]) * gravity
                p += arm.weight[k, j] * tangent
                rod.R[g] = R
                rod.tangent[g] = tangent
                rod.force[g] = transpose(R) @ force
                rod.spin[g] = cross(tangent, force)
            g0 += arm.width[k]
            e += 1
            rod.p_end[e] = p
    return fine


@part
def balance_section(arm, rod, k, g, b, m):
    """Balance a section against the total moment m; return the smallest |p_a'| of its muscles, eq. (13)."""
    i0 = arm.first[k]
    u, v, shortest = rod.u[g], rod.v[g], 1.0
    ru = times(arm.k_u[k], u - arm.rest_u[k]) - transpose(rod.R[g]) @ m
    rv = times(arm.k_v[k], v - arm.rest_v[k]) - rod.force[g]
    for c in range(arm.first[k + 1] - i0):
        x, y = arm.x[g, c], arm.y[g, c]  # r = (x, y, 0)
        path = v - lever(x, y, u) + Vec(arm.dx[g, c], arm.dy[g, c], 0.0)
        norm = sqrt(dot(path, path))
        t = (1.0 / norm) * path
        r_x_t = lever(x, y, t)
        rod.t[g, c] = t
        rod.r_x_t[g, c] = r_x_t
        rod.stretch[g, c] = norm
        rod.path[i0 + c] += b * norm
        ru += rod.tension[i0 + c] * r_x_t
        rv += rod.tension[i0 + c] * t
        shortest = where(norm > shortest, shortest, norm)
    rod.moment[g] = m
    rod.off_u[g] = ru
    rod.off_v[g] = rv
    return shortest


@part
def tip_to_base(arm, rod, fine):
    """Integrate the moment and balance all sections; return what of `fine` has no path that shrinks to a point."""
    g0, worst, total = arm.nodes, 0.0, 0.0
    m_end = rod.twist + rod.mass * cross(rotation(rod.h_end[arm.elements]) @ rod.centre, rod.gravity)
    for k in range(arm.modules - 1, -1, -1):
        q = arm.width[k]
        for _ in range(arm.pieces[k]):
            g0 -= q
            for j in range(q):
                g = g0 + j
                m = m_end
                for l in range(q):
                    m += arm.late[k, j + 1, l] * rod.spin[g0 + l]
                fine = where(balance_section(arm, rod, k, g, arm.weight[k, j], m) > SHORTEST_PATH, fine, 0.0)
                angle, strain = times(arm.unit_u[k], rod.off_u[g]), times(arm.unit_v[k], rod.off_v[g])
                worst = max(max(max(worst, abs(angle.x)), abs(angle.y)), abs(angle.z))
                worst = max(max(max(worst, abs(strain.x)), abs(strain.y)), abs(strain.z))
                total += dot(angle, angle) + dot(strain, strain)
            for j in range(q):
                m_end += arm.weight[k, j] * rod.spin[g0 + j]
    rod.worst = worst
    rod.total = total
    return fine


def evaluate(arm, rod, guessed):
    """Evaluate the equilibrium equations at a state.

    Rotations, wrenches and imbalances go to their fields; the quaternions there are near those of this state if they are
    `guessed`. Tensions of tendons are set to their drives. `worst` is the dimensionless residual: the largest of |moment
    imbalance| L/K (an angle over the module), |force imbalance|/K (a strain) and |length mismatch|/rest length; `total` the sum
    of squares of all of them. Both are inf where the state is no configuration (a rotation that the nodes cannot resolve, a
    muscle path that shrinks to a point).
    """
    for i in range(arm.muscles):
        rod.path[i] = 0.0
        if arm.kind[i] == TENDON:
            rod.tension[i] = rod.drive[i]
    fine = tip_to_base(arm, rod, base_to_tip(arm, rod, guessed > 0.5))
    worst, total = rod.worst, rod.total
    for i in range(arm.muscles):
        gap, softness = 0.0, 1.0
        if arm.kind[i] != TENDON:
            rest = arm.rest[i]
            delta, softness, _ = elongation(arm.kind[i], arm.law, i, rest, rod.tension[i], rod.drive[i])
            gap = rod.path[i] - rest - delta
            share = abs(gap) * (1.0 / rest)
            worst = max(worst, share)
            total += share * share
        rod.gap[i] = gap
        rod.softness[i] = softness
    good = (total < math.inf) & (fine > 0.5)
    rod.worst = where(good, worst, math.inf)


@part
def linearise_section(arm, rod, k, g, j, damping):
    """Linearise the section at a node: H = K + sum_i F_i d[r x t; t]/dxi, dv eliminated; return H_vv's negative eigenvalues.

    In the body frame, with n = R^T n, m = R^T m, B = H_vv^-1 and G = H_uv B:
    S = H_uu - G H_vu; N = G [n] - [m]; X = v n^T - (v.n) 1 - [n] B [n]; Y = [n] G^T; e = c_u - G c_v; z = [n] B c_v.
    Writes the global-frame blocks M = R S R^T, N, X, Y and e, z of node j of the element.
    """
    i0, d = arm.first[k], 1.0 + damping
    mk = arm.first[k + 1] - i0
    k_u, k_v = d * arm.k_u[k], d * arm.k_v[k]
    uu = diagonal(k_u.x, k_u.y, k_u.z)
    vv = diagonal(k_v.x, k_v.y, k_v.z)
    vu = diagonal(0.0, 0.0, 0.0)
    for c in range(mk):
        t = rod.t[g, c]
        pull = rod.tension[i0 + c] / rod.stretch[g, c]
        P = diagonal(pull, pull, pull) - outer(pull * t, t)
        x, y = arm.x[g, c], arm.y[g, c]
        minus_Pr = transpose(lever(x, y, P))  # -P [r] with the lever r = (x, y, 0)
        vv += P
        vu += minus_Pr
        uu += lever(x, y, minus_Pr)
    B = inverse(vv)
    slide = B @ vu
    gain = transpose(slide)
    R, n, v = rod.R[g], rod.force[g], rod.v[g]
    back, nB = transpose(R), cross(n, B)
    along = -dot(v, n)
    Y = R @ cross(n, slide) @ back
    rod.compliance[g] = B
    rod.slide[g] = slide
    rod.M[j] = R @ (uu - gain @ vu) @ back
    rod.Y[j] = Y
    # G [n] = -Y^T, R [R^T m] R^T = [m] and [n] B [n] = -[n] ([n] B)^T.
    rod.N[j] = -(hat(rod.moment[g]) + transpose(Y))
    rod.X[j] = R @ (cross(n, transpose(nB)) + outer(v, n) + diagonal(along, along, along)) @ back
    for c in range(mk):
        rod.e[j, c] = R @ (rod.r_x_t[g, c] - gain @ rod.t[g, c])
        rod.z[j, c] = R @ (nB @ rod.t[g, c])
    return negatives(B)


@part
def assemble(arm, rod, k, g0, inside, P):
    """Fill an element's matrix and what it hands on of moments; return the moment at its base from the rotation there.

    With w = (w_1..w_q), incoming rotation phi_0 and the module's dF: dm_r = D_r w + D_r0 phi_0 + D_rF dF + ..., where
    D_rl = h b_l P + sum_j late_rj inner_jl X_j + late_rl Y_l, D_r0 = P + sum_l late_rl X_l and D_rF = Q + sum_l late_rl z_l.
    Node r balances M w_r + N phi_r + e dF - dm_r = -rho_r; row 0 is the moment at the element's base.
    """
    q, mk = arm.width[k], arm.first[k + 1] - arm.first[k]
    handed = P
    for r in range(0 if inside else 1, q + 1):
        for l in range(q):
            D = arm.weight[k, l] * P + arm.late[k, r, l] * rod.Y[l]
            for j in range(q):
                D += arm.coupling[k, r, l * q + j] * rod.X[j]
            if r == 0:
                rod.to_base[g0 + l] = D
            else:
                D = arm.inner[k, r - 1, l] * rod.N[r - 1] - D
                if l == r - 1:
                    D += rod.M[l]
                rod.A[g0 + r - 1, l] = D
        D = P
        for l in range(q):
            D += arm.late[k, r, l] * rod.X[l]
        if r == 0:
            handed = D
        elif inside:
            rod.by_phi[g0 + r - 1] = D - rod.N[r - 1]
        for c in range(mk):
            x = rod.Q[c]
            for l in range(q):
                x += arm.late[k, r, l] * rod.z[l, c]
            if r == 0:
                rod.new_Q[c] = x
            else:
                rod.pulled[g0 + r - 1, c] = x - rod.e[r - 1, c]
    return handed


@part
def assemble_paths(arm, rod, k, g0):
    """Fill how an element's path lengths follow: dl = sum_l by_w_l w_l + alpha phi_0 + beta dF."""
    q, mk = arm.width[k], arm.first[k + 1] - arm.first[k]
    for c in range(mk):
        alpha = rod.alpha[c]
        new = alpha
        for j in range(q):
            new -= arm.weight[k, j] * rod.z[j, c]
        rod.new_alpha[c] = new
        for l in range(q):
            x = arm.weight[k, l] * (alpha + rod.e[l, c])
            for j in range(q):
                x -= (arm.weight[k, j] * arm.inner[k, j, l]) * rod.z[j, c]
            rod.by_w[g0 + l, c] = x
        for c2 in range(mk):
            for g in range(g0, g0 + q):
                rod.beta[c, c2] -= arm.weight[k, g - g0] * dot(rod.t[g, c], rod.compliance[g] @ rod.t[g, c2])


@part
def factorise_element(rod, g0, q, mk, inside):
    """LU without pivoting, in 3 x 3 blocks, of an element's matrix; by_phi (if `inside`) and pulled become the solutions.

    At a stable equilibrium the matrix is positive definite up to a diagonal scaling, so pivoting buys nothing; where it is
    singular the answer is not finite. Diagonal blocks are stored inverted. Returns how many of their eigenvalues are negative.
    """
    A, by_phi, pulled = rod.A, rod.by_phi, rod.pulled
    negative = 0.0
    for d in range(q):
        pivot = inverse(A[g0 + d, d])
        negative += negatives(pivot)
        A[g0 + d, d] = pivot
        for r in range(d + 1, q):
            factor = A[g0 + r, d] @ pivot
            A[g0 + r, d] = factor
            for j in range(d + 1, q):
                A[g0 + r, j] -= factor @ A[g0 + d, j]
            if inside:
                by_phi[g0 + r] -= factor @ by_phi[g0 + d]
            for c in range(mk):
                pulled[g0 + r, c] -= factor @ pulled[g0 + d, c]
    for d in range(q - 1, -1, -1):
        if inside:
            D = by_phi[g0 + d]
            for l in range(d + 1, q):
                D -= A[g0 + d, l] @ by_phi[g0 + l]
            by_phi[g0 + d] = A[g0 + d, d] @ D
        for c in range(mk):
            x = pulled[g0 + d, c]
            for l in range(d + 1, q):
                x -= A[g0 + d, l] @ pulled[g0 + l, c]
            pulled[g0 + d, c] = A[g0 + d, d] @ x
    return negative


@part
def hand_on(arm, rod, k, g0, inside, P):
    """Return the moment at an element's base from the rotation there, w eliminated; so for muscles and path lengths."""
    mk = arm.first[k + 1] - arm.first[k]
    for g in range(g0, g0 + arm.width[k]):
        if inside:
            P += rod.to_base[g] @ rod.by_phi[g]
        for c in range(mk):
            by_w = rod.by_w[g, c]
            if inside:
                rod.new_alpha[c] += transpose(rod.by_phi[g]) @ by_w
                rod.new_Q[c] += rod.to_base[g] @ rod.pulled[g, c]
            for c2 in range(mk):
                rod.beta[c, c2] += dot(by_w, rod.pulled[g, c2])
    if inside:
        for c in range(mk):
            rod.alpha[c] = rod.new_alpha[c]
            rod.Q[c] = rod.new_Q[c]
    return P


@part
def factorise_muscles(rod, k, n):
    """LU without pivoting of a module's muscles, in place, U's diagonal inverted; return how many pivots are positive."""
    A, positive = rod.muscle_A, 0.0
    for d in range(n):
        pivot = A[k, d, d]
        positive += where(pivot > 0.0, 1.0, 0.0)
        pivot = 1.0 / pivot
        A[k, d, d] = pivot
        for r in range(d + 1, n):
            factor = A[k, r, d] * pivot
            A[k, r, d] = factor
            for j in range(d + 1, n):
                A[k, r, j] -= factor * A[k, d, j]
    return positive


@part
def solve_muscles(rod, k, n, x, x0):
    """Solve with a module's factors for x[x0:], in place."""
    A = rod.muscle_A
    for r in range(n):
        for l in range(r):
            x[x0 + r] -= A[k, r, l] * x[x0 + l]
    for r in range(n - 1, -1, -1):
        for l in range(r + 1, n):
            x[x0 + r] -= A[k, r, l] * x[x0 + l]
        x[x0 + r] = A[k, r, r] * x[x0 + r]


@part
def eliminate_tensions(arm, rod, k, P):
    """Factorise a module's compatibility, (beta - softness) dF + alpha phi_0 = -(gap + gamma); phi_0 = 0 at the arm's base."""
    i0 = arm.first[k]
    mk = arm.first[k + 1] - i0
    for c in range(mk):
        tendon = arm.kind[i0 + c] == TENDON  # its row: -dF = -gap
        for c2 in range(mk):
            rod.muscle_A[k, c, c2] = 0.0 if tendon else rod.beta[c, c2]
        rod.muscle_A[k, c, c] -= rod.softness[i0 + c]
        rod.muscle_phi[k, c] = Vec(0.0, 0.0, 0.0) if tendon or k == 0 else rod.alpha[c]
        rod.muscle_moment[k, c] = rod.Q[c]
    rod.negative -= factorise_muscles(rod, k, mk)
    if k == 0:
        return P
    for c in range(mk):
        rod.column[c] = rod.muscle_phi[k, c]
    solve_muscles(rod, k, mk, rod.column, 0)
    for c in range(mk):
        rod.muscle_phi[k, c] = rod.column[c]
        P -= outer(rod.Q[c], rod.column[c])
    return P


def eliminate(arm, rod, damping):
    """Factorise the tangent at the state last given to `evaluate`, with `damping` times K added to it.

    `negative` is how many eigenvalues of the tangent, as a quadratic form in the strain, are negative: as many as of its
    pivots, by Sylvester's law of inertia, less one for each muscle's pivot that is not negative: that muscle has made up for
    one of the rod's (Haynsworth).
    """
    rod.negative = 0.0
    g0, mass = arm.nodes, rod.mass
    arm_of_payload = rotation(rod.h_end[arm.elements]) @ rod.centre
    weight = -mass * dot(arm_of_payload, rod.gravity)
    P = outer(mass * arm_of_payload, rod.gravity) + diagonal(weight, weight, weight)
    for k in range(arm.modules - 1, -1, -1):
        q = arm.width[k]
        mk = arm.first[k + 1] - arm.first[k]
        for c in range(mk):
            rod.alpha[c] = Vec(0.0, 0.0, 0.0)
            rod.Q[c] = Vec(0.0, 0.0, 0.0)
            for c2 in range(mk):
                rod.beta[c, c2] = 0.0
        for _ in range(arm.pieces[k]):
            g0 -= q
            inside = g0 > 0  # nothing turns the arm's own base: there phi_0 is zero and row 0 is of no use
            for j in range(q):
                rod.negative += linearise_section(arm, rod, k, g0 + j, j, damping)
            handed = assemble(arm, rod, k, g0, inside, P)
            assemble_paths(arm, rod, k, g0)
            rod.negative += factorise_element(rod, g0, q, mk, inside)
            P = hand_on(arm, rod, k, g0, inside, handed)
        P = eliminate_tensions(arm, rod, k, P)


@part
def substitute_element(arm, rod, k, g0, p):
    """Solve an element for a moment p at its end, while nothing turns its base; return the moment there."""
    q, mk = arm.width[k], arm.first[k + 1] - arm.first[k]
    A, w = rod.A, rod.w
    for j in range(q):
        g = g0 + j
        slid = rod.compliance[g] @ rod.off_v[g]
        rod.rho[j] = rod.R[g] @ (rod.off_u[g] - transpose(rod.slide[g]) @ rod.off_v[g])
        rod.zeta[j] = rod.R[g] @ cross(rod.force[g], slid)
        for c in range(mk):
            rod.gamma[c] -= arm.weight[k, j] * dot(rod.t[g, c], slid)
    for j in range(q):
        x = p - rod.rho[j]
        for l in range(q):
            x += arm.late[k, j + 1, l] * rod.zeta[l]
        for l in range(j):
            x -= A[g0 + j, l] @ w[g0 + l]
        w[g0 + j] = x
    for j in range(q - 1, -1, -1):
        x = w[g0 + j]
        for l in range(j + 1, q):
            x -= A[g0 + j, l] @ w[g0 + l]
        w[g0 + j] = A[g0 + j, j] @ x
    for l in range(q):
        if g0 > 0:
            p += rod.to_base[g0 + l] @ w[g0 + l] + arm.weight[k, l] * rod.zeta[l]
        for c in range(mk):
            rod.gamma[c] += dot(rod.by_w[g0 + l, c], w[g0 + l])
    return p


@part
def step_of_element(arm, rod, k, g0, phi0):
    """Complete the step of an element whose base turns by phi0; return the rotation of its end, largest |phi|^2 and |dv|^2."""
    q, i0 = arm.width[k], arm.first[k]
    mk = arm.first[k + 1] - i0
    rotated, sheared, total = 0.0, 0.0, 0.0
    for g in range(g0, g0 + q):
        w = rod.w[g]
        if g0 > 0:
            w += rod.by_phi[g] @ phi0
        for c in range(mk):
            w += rod.pull[i0 + c] * rod.pulled[g, c]
        rod.w[g] = w
    end = phi0
    for j in range(q):
        g = g0 + j
        phi = phi0
        for l in range(q):
            phi += arm.inner[k, j, l] * rod.w[g0 + l]
        back = transpose(rod.R[g])
        bend = back @ rod.w[g]
        y = cross(rod.force[g], back @ phi) - rod.off_v[g]
        for c in range(mk):
            y -= rod.pull[i0 + c] * rod.t[g, c]
        shear = rod.compliance[g] @ y - rod.slide[g] @ bend
        far = dot(shear, shear)
        rotated, sheared, total = max(rotated, dot(phi, phi)), max(sheared, far), total + far
        rod.phi[g] = phi
        rod.bend[g] = bend
        rod.shear[g] = shear
        end += arm.weight[k, j] * rod.w[g]
    return end, rotated, where(total < math.inf, sheared, math.nan)


def substitute(arm, rod, _):
    """Solve the factorised tangent for the right-hand side -(off_u, off_v, gap).

    Writes the changes of strain (bend, shear) and tension (pull), the rotation of each node (phi), the largest rotation [rad]
    (rotated) and the largest |dv| (sheared) of the step; these are not numbers where one is not.
    """
    g0, zero = arm.nodes, spread(0.0)
    p = Vec(zero, zero, zero)
    for k in range(arm.modules - 1, -1, -1):
        i0 = arm.first[k]
        mk = arm.first[k + 1] - i0
        for c in range(mk):
            rod.gamma[c] = 0.0
        for _ in range(arm.pieces[k]):
            g0 -= arm.width[k]
            p = substitute_element(arm, rod, k, g0, p)
        # dF for phi_0 = 0; the part that follows phi_0 is in muscle_phi.
        for c in range(mk):
            rod.pull[i0 + c] = -rod.gap[i0 + c]
            if arm.kind[i0 + c] != TENDON:
                rod.pull[i0 + c] -= rod.gamma[c]
        solve_muscles(rod, k, mk, rod.pull, i0)
        for c in range(mk):
            p += rod.pull[i0 + c] * rod.muscle_moment[k, c]
    phi0 = Vec(zero, zero, zero)
    rotated, sheared, sound = zero, zero, zero
    for k in range(arm.modules):
        i0 = arm.first[k]
        for c in range(arm.first[k + 1] - i0):
            rod.pull[i0 + c] -= dot(rod.muscle_phi[k, c], phi0)
        for _ in range(arm.pieces[k]):
            phi0, turned, slid = step_of_element(arm, rod, k, g0, phi0)
            rotated, sheared, sound = max(rotated, turned), max(sheared, slid), sound + slid
            g0 += arm.width[k]
    whole = dot(phi0, phi0)
    rod.tip_turn = phi0
    rod.rotated = where(whole < math.inf, sqrt(max(rotated, whole)), math.nan)
    rod.sheared = where(sound < math.inf, sqrt(sheared), math.nan)
