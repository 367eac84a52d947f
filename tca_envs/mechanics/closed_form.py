"""Equilibrium without load: nothing to integrate.

Where nothing loads the arm the total internal wrench is zero everywhere, so modules do not feel each other, and in a frame
that turns with its muscles a module's strain is constant. Six algebraic equations for the strain and one for each muscle's
tension remain per module, K (xi - xi*) + sum_i F_i [r x t; t] = 0 and length |p_a'| - rest length = elongation(F, drive); the
pose at its end is an exponential.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics.algebra import entry, inner
from tca_envs.mechanics.kernels import CLOSED_FORM
from tca_envs.mechanics.muscle import TENDON, elongation

Array = NDArray[np.float64]

MAX_ITERATIONS = 30
MAX_STEP = 0.5
"""Of the rotation over a module [rad] and of the rest of the strain."""
ROUND_OFF = 1e-12


class Sections(NamedTuple):
    """The sections at the modules' bases, besides what `collocation.Model` holds. M modules, n muscles, G nodes."""

    lever: Array  # (n, 3, 6) J = [-r^, 1]: the muscle's path is J xi + r'
    slope: Array  # (n, 3) r'
    turn: Array  # (M,) of the muscles about the centerline [rad/m]
    arc: Array  # (G,) distance of each node from its module's base [m]


@inner
def _equations(model, sections, k, strain, tension, drive, matrix, rhs, lengths):
    """Fill Newton's equations of module k, matrix (6 + m, 6 + m) and rhs; return the dimensionless residual."""
    first, muscles, span = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k], model.length[k]
    worst = 0.0
    matrix[:] = 0.0
    for a in range(6):
        matrix[a, a] = model.stiffness[k, a]
        rhs[a] = model.stiffness[k, a] * (model.reference[k, a] - strain[a])
    path, wrench = np.empty(3), np.empty(6)
    across, turned = np.empty((3, 3)), np.empty((3, 6))
    for c in range(muscles):
        i = first + c
        lever = sections.lever[i]
        for x in range(3):
            path[x] = sections.slope[i, x]
            for a in range(6):
                path[x] += lever[x, a] * strain[a]
        norm = np.sqrt(path[0] ** 2 + path[1] ** 2 + path[2] ** 2)
        if not norm > 1e-9:
            return np.inf
        for x in range(3):
            for y in range(3):
                across[x, y] = ((1.0 if x == y else 0.0) - path[x] * path[y] / norm**2) / norm
        for a in range(6):
            wrench[a] = (lever[0, a] * path[0] + lever[1, a] * path[1] + lever[2, a] * path[2]) / norm
            for x in range(3):
                turned[x, a] = across[x, 0] * lever[0, a] + across[x, 1] * lever[1, a] + across[x, 2] * lever[2, a]
        for a in range(6):
            for b in range(6):
                product = lever[0, a] * turned[0, b] + lever[1, a] * turned[1, b] + lever[2, a] * turned[2, b]
                matrix[a, b] += tension[i] * product
            matrix[a, 6 + c] = wrench[a]
            rhs[a] -= tension[i] * wrench[a]
        lengths[i] = span * norm
        if model.kind[i] == TENDON:
            matrix[6 + c, 6 + c] = -1.0
            rhs[6 + c] = tension[i] - drive[i]
            continue
        rest = model.rest_length[i]
        delta, softness, _ = elongation(model.kind[i], model.parameters, i, rest, tension[i], drive[i])
        for a in range(6):
            matrix[6 + c, a] = span * wrench[a]
        matrix[6 + c, 6 + c] = -softness
        rhs[6 + c] = rest + delta - lengths[i]
        worst = max(worst, abs(rhs[6 + c]) / rest)
    for a in range(6):
        worst = max(worst, abs(rhs[a]) / model.stiffness[k, a] * (span if a < 3 else 1.0))
    return worst


@inner
def _eliminate(matrix, rhs):
    """Solve in place without pivoting: the strain's block is definite, the muscles' complement negative definite."""
    size = rhs.size
    for k in range(size):
        for i in range(k + 1, size):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, size):
                matrix[i, j] -= factor * matrix[k, j]
            rhs[i] -= factor * rhs[k]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            rhs[k] -= matrix[k, j] * rhs[j]
        rhs[k] /= matrix[k, k]


@inner
def _module(model, sections, k, strain, tension, drive, lengths):
    """Solve module k from (strain (6,), tension), in place; returns the residual and Newton's iterations."""
    first, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
    matrix, rhs = np.empty((6 + muscles, 6 + muscles)), np.empty(6 + muscles)
    for c in range(muscles):
        if model.kind[first + c] == TENDON:
            tension[first + c] = drive[first + c]
    before = np.inf
    for iteration in range(MAX_ITERATIONS):
        worst = _equations(model, sections, k, strain, tension, drive, matrix, rhs, lengths)
        # Down to round-off: the last steps cost next to nothing.
        if worst < ROUND_OFF or (worst < 1e3 * ROUND_OFF and worst >= before) or not worst < np.inf:
            return worst, iteration
        before = worst
        _eliminate(matrix, rhs)
        most = 0.0
        for a in range(6):
            most = max(most, abs(rhs[a]) * (model.length[k] if a < 3 else 1.0))
        step = min(1.0, MAX_STEP / max(most, 1e-300))
        for a in range(6):
            strain[a] += step * rhs[a]
        for c in range(muscles):
            tension[first + c] += step * rhs[6 + c]
    return np.inf, MAX_ITERATIONS


@inner
def _turn_about_z(angle, strain, turned):
    """Turn both halves of a strain (6,) about z, into `turned`."""
    c, s = np.cos(angle), np.sin(angle)
    for part in range(0, 6, 3):
        x, y = strain[part], strain[part + 1]
        turned[part], turned[part + 1], turned[part + 2] = c * x - s * y, s * x + c * y, strain[part + 2]


@inner
def _move(rotation, position, strain, turn, length):
    """Take a pose along a module of constant strain in its turning frame: exp(L (xi^ + turn e_z)) Rz(-turn L)."""
    w = (length * strain[0], length * strain[1], length * (strain[2] + turn))
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(square)
    if angle > 1e-2:
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
        third = (1.0 - first) / square
    else:  # series, to round-off
        first = 1.0 - square / 6.0 + square * square / 120.0
        second = 0.5 - square / 24.0 + square * square / 720.0
        third = 1.0 / 6.0 - square / 120.0 + square * square / 5040.0
    hat = np.zeros((3, 3))
    hat[0, 1], hat[0, 2], hat[1, 2] = -w[2], w[1], -w[0]
    hat[1, 0], hat[2, 0], hat[2, 1] = w[2], -w[1], w[0]
    turned, moved, back = np.eye(3), np.eye(3), np.eye(3)
    for a in range(3):
        for b in range(3):
            twice = hat[a, 0] * hat[0, b] + hat[a, 1] * hat[1, b] + hat[a, 2] * hat[2, b]
            turned[a, b] += first * hat[a, b] + second * twice
            moved[a, b] += second * hat[a, b] + third * twice
    c, s = np.cos(turn * length), np.sin(turn * length)
    back[0, 0], back[0, 1], back[1, 0], back[1, 1] = c, s, -s, c
    along = np.zeros(3)
    for a in range(3):
        for b in range(3):
            along[a] += length * moved[a, b] * strain[3 + b]
    old = rotation.copy()
    for a in range(3):
        position[a] += old[a, 0] * along[0] + old[a, 1] * along[1] + old[a, 2] * along[2]
        for b in range(3):
            rotation[a, b] = 0.0
            for c in range(3):
                for d in range(3):
                    rotation[a, b] += old[a, c] * turned[c, d] * back[d, b]


@entry
def solve_lane(model, sections, strain, tension, from_drive, from_load, drive, load, tip, lengths, report):
    """Find the equilibrium of one arm that nothing loads; arguments as of `collocation.solve_lanes` with N = 1.

    Returns
    -------
    bool
        Whether there is an answer; otherwise nothing is changed.
    """
    rotation, position, here = np.eye(3), np.zeros(3), np.empty(6)
    found, pull, path = np.empty_like(strain[0]), tension[0].copy(), np.empty_like(lengths[0])
    worst, iterations, g0 = 0.0, 0, 0
    for k in range(model.length.size):
        turn = sections.turn[k]
        _turn_about_z(-turn * sections.arc[g0], strain[0, g0], here)
        residual, steps = _module(model, sections, k, here, pull, drive[0], path)
        if not residual < np.inf:
            return False
        worst, iterations = max(worst, residual), max(iterations, steps)
        for _ in range(model.elements[k] * model.nodes[k]):
            _turn_about_z(turn * sections.arc[g0], here, found[g0])
            g0 += 1
        _move(rotation, position, here, turn, model.length[k])
    strain[0], tension[0], lengths[0], from_drive[0], from_load[0] = found, pull, path, drive[0], load[0]
    tip[0, :3, :3] = rotation
    tip[0, :3, 3] = position
    report[0, 0], report[0, 1], report[0, 2] = CLOSED_FORM, worst, iterations
    report[0, 3] = report[0, 4] = 0.0
    return True
