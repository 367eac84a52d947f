"""Equilibrium without load: nothing to integrate.

Where nothing loads the arm the total internal wrench is zero everywhere, so modules do not feel each other, and in a frame
that turns with its muscles a module's strain is constant. Six algebraic equations for the strain and one for each muscle's
tension remain per module, K (xi - xi*) + sum_i F_i [r x t; t] = 0 and length |p_a'| - rest length = elongation(F, drive); the
pose at its end is an exponential.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics.algebra import (
    ORIGIN,
    apply,
    axpy,
    axpy9,
    cross_matrix,
    entry,
    matmul,
    scalar_matrix,
    transpose,
)
from tca_envs.mechanics.kernels import (
    CLOSED_FORM,
    FIRST_MUSCLE,
    KIND,
    LAW,
    LENGTH,
    MODULES,
    NODES_OF,
    PIECES,
    REFERENCE,
    REST,
    STIFFNESS,
    about,
    along,
    get3,
    get9,
    largest,
    put3,
    put9,
    stiffened,
)
from tca_envs.mechanics.muscle import PARAMETERS, TENDON, law
from tca_envs.mechanics.packs import pointer_to_floats, pointer_to_ints
from tca_envs.mechanics.traced import choose, cosine, root, sine, size, traced
from tca_envs.mechanics.written import written

Array = NDArray[np.float64]

MAX_ITERATIONS = 30
MAX_STEP = 0.5
"""Of the rotation over a module [rad] and of the rest of the strain."""
ROUND_OFF = 1e-12
STRAIN, POSITION, ROTATION, RESIDUAL, ITERATIONS, RHS = 0, 6, 9, 18, 19, 20
"""Places of the numbers that are worked on: a module's strain, the pose at its base, the largest residual and number of
iterations of a module, Newton's right-hand side and, behind it, his matrix."""


class Sections(NamedTuple):
    """The sections at the modules' bases, besides what `collocation.Model` holds. M modules, n muscles, G nodes."""

    route: Array  # (n, 4) muscle position x, y [m] and its derivative in s
    turn: Array  # (M,) of the muscles about the centerline [rad/m]
    arc: Array  # (G,) distance of each node from its module's base [m]


@traced
def _turned(angle, x):
    """Return a vector turned about z."""
    c, s = cosine(angle), sine(angle)
    return c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]


@traced
def _moved(rotation, position, u, v, turn, length):
    """Return a pose taken along a module of constant strain in its turning frame: exp(L (xi^ + turn e_z)) Rz(-turn L)."""
    w = (length * u[0], length * u[1], length * (u[2] + turn))
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle, far = root(square), choose(1e-4, square, square, 1.0)
    # Near zero their series, to round-off.
    first = choose(1e-4, square, sine(angle) / root(far), 1.0 - square / 6.0 + square * square / 120.0)
    second = choose(1e-4, square, (1.0 - cosine(angle)) / far, 0.5 - square / 24.0 + square * square / 720.0)
    third = choose(1e-4, square, (1.0 - first) / far, 1.0 / 6.0 - square / 120.0 + square * square / 5040.0)
    hat = cross_matrix(w)
    twice, one = matmul(hat, hat), scalar_matrix(1.0)
    turned, swept = axpy9(first, hat, axpy9(second, twice, one)), axpy9(second, hat, axpy9(third, twice, one))
    c, s = cosine(turn * length), sine(turn * length)
    back = (c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)
    return matmul(matmul(rotation, turned), back), axpy(length, apply(rotation, apply(swept, v)), position)


@traced
def _diagonal(f, at):
    """Return the diagonal matrix of three numbers."""
    return f[at], 0.0, 0.0, 0.0, f[at + 1], 0.0, 0.0, 0.0, f[at + 2]


@traced
def _put_blocks(w, matrix, order, uu, vu, vv):
    """Write the strain's block of Newton's matrix."""
    uv = transpose(vu)
    for row in range(3):
        put3(w, matrix + row * order, uu[3 * row : 3 * row + 3])
        put3(w, matrix + row * order + 3, uv[3 * row : 3 * row + 3])
        put3(w, matrix + (row + 3) * order, vu[3 * row : 3 * row + 3])
        put3(w, matrix + (row + 3) * order + 3, vv[3 * row : 3 * row + 3])


@traced
def _put_column(w, at, order, moment, force):
    """Write a muscle's column of Newton's matrix."""
    for row in range(3):
        w[at + row * order] = moment[row]
        w[at + (row + 3) * order] = force[row]


@entry
def _solve(f, i, route, turn, arc, drive, tension, strain, path, work):
    """Fill strain, tension and path; `work` holds the residual (inf: no answer), iterations and pose of the tip then."""
    _solved(
        pointer_to_floats(f), pointer_to_ints(i), pointer_to_floats(route), pointer_to_floats(turn), pointer_to_floats(arc),
        pointer_to_floats(drive), pointer_to_floats(tension), pointer_to_floats(strain), pointer_to_floats(path),
        pointer_to_floats(work),
    )  # fmt: skip


@written
def _solved(f, i, routes, turns, arcs, drives, pulls, strains, paths, w):
    """Do what `_solve` does, given pointers."""
    w[RESIDUAL], w[ITERATIONS] = np.inf, 0.0
    worst_of_all, most, g = 0.0, 0.0, 0
    put9(w, ROTATION, scalar_matrix(1.0))
    put3(w, POSITION, ORIGIN)
    for k in range(i[MODULES]):
        i0 = i[i[FIRST_MUSCLE] + k]
        order = 6 + i[i[FIRST_MUSCLE] + k + 1] - i0
        matrix, stiffness, reference = RHS + order, i[STIFFNESS] + 6 * k, i[REFERENCE] + 6 * k
        span, rate = f[i[LENGTH] + k], turns[k]
        angle = -rate * arcs[g]
        put3(w, STRAIN, _turned(angle, get3(strains, 6 * g)))
        put3(w, STRAIN + 3, _turned(angle, get3(strains, 6 * g + 3)))
        before, count = np.inf, 0
        for _ in range(MAX_ITERATIONS):
            # Newton's equations.
            u, v = get3(w, STRAIN), get3(w, STRAIN + 3)
            uu, vu, vv = _diagonal(f, stiffness), scalar_matrix(0.0), _diagonal(f, stiffness + 3)
            for at in range(6 * order, order * order):
                w[matrix + at] = 0.0
            for d in range(6):
                w[RHS + d] = f[stiffness + d] * (f[reference + d] - w[STRAIN + d])
            for c in range(6, order):
                muscle = i0 + c - 6
                at = 4 * muscle
                x, y = routes[at], routes[at + 1]
                t, norm = along(x, y, routes[at + 2], routes[at + 3], u, v)
                if not norm > 1e-9:
                    return
                paths[muscle] = span * norm
                moment, row = about(x, y, t), matrix + c * order
                _put_column(w, matrix + c, order, moment, t)
                if i[i[KIND] + muscle] == TENDON:
                    pulls[muscle] = drives[muscle]
                    w[row + c], w[RHS + c] = -1.0, 0.0
                else:
                    rest = f[i[REST] + muscle]
                    parameters = i[LAW] + PARAMETERS * muscle
                    delta, soft, _ = law(i[i[KIND] + muscle], f, parameters, rest, pulls[muscle], drives[muscle])
                    put3(w, row, axpy(span, moment, ORIGIN))
                    put3(w, row + 3, axpy(span, t, ORIGIN))
                    w[row + c], w[RHS + c] = -soft, rest + delta - span * norm
                pull = pulls[muscle]
                uu, vu, vv = stiffened(x, y, t, pull / norm, uu, vu, vv)
                put3(w, RHS, axpy(-pull, moment, get3(w, RHS)))
                put3(w, RHS + 3, axpy(-pull, t, get3(w, RHS + 3)))
            _put_blocks(w, matrix, order, uu, vu, vv)
            worst = total = 0.0
            for d in range(6):
                share = size(w[RHS + d]) * ((span if d < 3 else 1.0) / f[stiffness + d])
                worst = largest(worst, share)
                total += share
            for c in range(6, order):
                share = size(w[RHS + c]) / f[i[REST] + i0 + c - 6]
                worst = largest(worst, share)
                total += share
            if not total < np.inf:
                return
            # Down to round-off: the last steps cost next to nothing.
            if (worst < ROUND_OFF) | ((worst < 1e3 * ROUND_OFF) & (worst >= before)):
                break
            before = worst
            # Without pivoting: the strain's block is definite, the muscles' complement negative definite.
            for c in range(order):
                for row in range(c + 1, order):
                    factor = w[matrix + row * order + c] / w[matrix + c * order + c]
                    for d in range(c + 1, order):
                        w[matrix + row * order + d] -= factor * w[matrix + c * order + d]
                    w[RHS + row] -= factor * w[RHS + c]
            for c in range(order - 1, -1, -1):
                for d in range(c + 1, order):
                    w[RHS + c] -= w[matrix + c * order + d] * w[RHS + d]
                w[RHS + c] /= w[matrix + c * order + c]
            longest = MAX_STEP
            for d in range(6):
                length = size(w[RHS + d]) * (span if d < 3 else 1.0)
                longest = largest(longest, length)
            step = MAX_STEP / longest
            for d in range(6):
                w[STRAIN + d] += step * w[RHS + d]
            for c in range(6, order):
                pulls[i0 + c - 6] += step * w[RHS + c]
            count += 1
        if count == MAX_ITERATIONS:
            return
        worst_of_all, most = largest(worst_of_all, worst), largest(most, 1.0 * count)
        u, v = get3(w, STRAIN), get3(w, STRAIN + 3)
        for _ in range(i[i[PIECES] + k] * i[i[NODES_OF] + k]):
            put3(strains, 6 * g, _turned(rate * arcs[g], u))
            put3(strains, 6 * g + 3, _turned(rate * arcs[g], v))
            g += 1
        rotation, position = _moved(get9(w, ROTATION), get3(w, POSITION), u, v, rate, span)
        put9(w, ROTATION, rotation)
        put3(w, POSITION, position)
    w[RESIDUAL], w[ITERATIONS] = worst_of_all, most


def solve_lane(model, sections, strain, tension, from_drive, from_load, drive, load, tip, lengths, report) -> bool:
    """Find the equilibrium of one arm that nothing loads; arguments as of `collocation.solve_lanes` with N = 1.

    Returns
    -------
    bool
        Whether there is an answer; otherwise nothing is changed.
    """
    found, pull, path = strain[0].copy(), tension[0].copy(), np.empty_like(lengths[0])
    order = 6 + model.route.shape[1]
    work = np.empty(RHS + order + order * order)
    _solve(model.f, model.i, *sections, drive[0], pull, found, path, work)
    if not work[RESIDUAL] < np.inf:
        return False
    strain[0], tension[0], lengths[0], from_drive[0], from_load[0] = found, pull, path, drive[0], load[0]
    tip[0, :3, :3], tip[0, :3, 3] = work[ROTATION:RESIDUAL].reshape(3, 3), work[POSITION:ROTATION]
    report[0] = CLOSED_FORM, work[RESIDUAL], work[ITERATIONS], 0.0, 0.0
    return True
