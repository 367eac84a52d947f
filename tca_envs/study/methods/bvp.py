"""SciPy's solver for boundary value problems, `scipy.integrate.solve_bvp`, on the wrench form of the equilibrium.

The states are quaternion, moment and the muscles' path lengths in each module, all on x in [0, 1], modules side by side; the
tensions are parameters. The total force is known beforehand and the strain follows from the wrench at each x by the section
balance:

    h' = L (h o u)/2,   m' = -L p' x n,   l_i' = L |p_i'|,   K (xi - xi*) + sum_i F_i [r_i x t_i; t_i] = R^T [m; n].

Rotation and moment are continuous at the joints, the moment at the tip is the load's, and each path length is what its muscle
asks for. The tip's position is a quadrature of p' over the mesh, by the Simpson rule that SciPy's fourth-order
collocation amounts to.

SciPy's part is in Python and sparse linear algebra. The right-hand side, the section balances (by Newton from their last
answers on a mesh of the same size) and the analytic Jacobians are compiled. Guesses carry mesh and solution on. Where a solve
fails, drive and load go from those of the guess in a bounded number of substeps.
"""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from tca_envs.mechanics import Arm, Equilibrium
from tca_envs.mechanics.algebra import apply, apply_transposed, axpy, cross, dot, entry, inner, quaternion_rate, rotation_matrix
from tca_envs.mechanics.arm import pose
from tca_envs.mechanics.kernels import PAYLOAD_MASS
from tca_envs.mechanics.muscle import TENDON, elongation
from tca_envs.study.method import Answer, Array, Method, State

MAX_NODES = 2000
"""Of the mesh."""
INTERVALS, PER_TURN = 6, 4
"""Of the first mesh, and how many more for each turn of a helical muscle."""
ROUGH = 1e-2
"""Tolerance of substeps."""
MAX_SUBSTEPS = 16
FIRST_SUBSTEP, SMALLEST_SUBSTEP = 0.25, 1.0 / 32.0
BALANCED = 1e-9
"""A section is balanced after a Newton step that changes its strain, times L for curvatures, by less."""
CAREFUL = 1.0
"""Where that fails, steps change it by no more than this: muscles that push make the balance very nonlinear."""
MAX_SECTION_STEPS = 60
ORIGIN = (0.0, 0.0, 0.0)
ROTATION, MOMENT = 4, 3


class Model(NamedTuple):
    """An arm as plain arrays. M modules, n muscles; a module's states are quaternion, moment, path lengths."""

    first_row: NDArray[np.int64]  # (M + 1,) of the states
    first_muscle: NDArray[np.int64]  # (M + 1,)
    length: Array  # (M,) [m]
    unit: Array  # (M,) of moments, EI/L [N m]
    stiffness: Array  # (M, 6)
    reference: Array  # (M, 6)
    mass: Array  # (M,) of each module [kg]
    beyond: Array  # (M,) of the modules after it [kg]
    offset: Array  # (n,) [m]
    angle: Array  # (n,) at the module's base
    winding: Array  # (n,) angle over the module's length
    kind: NDArray[np.int64]  # (n,) kind of muscle law
    parameters: Array  # (n, PARAMETERS) of muscle law
    rest_length: Array  # (n,) [m]


@inner
def _muscles(model, k, x, u, v, wrench, norm):
    """Fill [r x t; t] (m, 6) and |p_i'| (m,) of module k's muscles; False where a path shrinks to a point."""
    for c in range(model.first_muscle[k + 1] - model.first_muscle[k]):
        i = model.first_muscle[k] + c
        angle, rate = model.angle[i] + model.winding[i] * x, model.winding[i] / model.length[k]
        lever = (model.offset[i] * np.cos(angle), model.offset[i] * np.sin(angle), 0.0)
        w = cross(u, lever)
        t = (v[0] + w[0] - rate * lever[1], v[1] + w[1] + rate * lever[0], v[2] + w[2])
        size = np.sqrt(dot(t, t))
        if not size > 1e-9:
            return False
        t = axpy(1.0 / size, t, ORIGIN)
        turn = cross(lever, t)
        norm[c] = size
        for d in range(3):
            wrench[c, d], wrench[c, 3 + d] = turn[d], t[d]
    return True


@inner
def _balance(model, k, x, strain, tension, body, longest, section, wrench, norm):
    """Solve the section of module k at x for its strain (6,), in place, under the wrench `body` (6,).

    No step changes it by more than `longest`. Leaves the Cholesky factor of the balance's derivative in `section` (lower
    half); False where there is no answer.
    """
    stiffness, length = model.stiffness[k], model.length[k]
    i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
    step = np.empty(6)
    for _ in range(MAX_SECTION_STEPS):
        u, v = (strain[0], strain[1], strain[2]), (strain[3], strain[4], strain[5])
        if not _muscles(model, k, x, u, v, wrench, norm):
            return False
        section[:] = 0.0
        for d in range(6):
            section[d, d] = stiffness[d]
            step[d] = body[d] - stiffness[d] * (strain[d] - model.reference[k, d])
        for c in range(muscles):
            i = i0 + c
            angle = model.angle[i] + model.winding[i] * x
            y0, y1 = model.offset[i] * np.cos(angle), model.offset[i] * np.sin(angle)
            f = tension[i] / norm[c]
            # F J^T (1 - t t^T) J/|p'| with J = [-r^, 1], lower half; J^T t is the wrench.
            section[0, 0] += f * y1 * y1
            section[1, 0] -= f * y0 * y1
            section[1, 1] += f * y0 * y0
            section[2, 2] += f * (y0 * y0 + y1 * y1)
            section[3, 2] -= f * y1
            section[4, 2] += f * y0
            section[5, 0] += f * y1
            section[5, 1] -= f * y0
            for d in range(6):
                if d > 2:
                    section[d, d] += f
                step[d] -= tension[i] * wrench[c, d]
                for l in range(d + 1):
                    section[d, l] -= f * wrench[c, d] * wrench[c, l]
        for d in range(6):
            for l in range(d + 1):
                value = section[d, l]
                for i in range(l):
                    value -= section[d, i] * section[l, i]
                if l < d:
                    section[d, l] = value / section[l, l]
                elif value > 0.0:
                    section[d, d] = np.sqrt(value)
                else:
                    return False
        _back(section, step)
        change = 0.0
        for d in range(6):
            change = max(change, abs(step[d]) * (length if d < 3 else 1.0))
        part = min(1.0, longest / max(change, 1e-300))
        for d in range(6):
            strain[d] += part * step[d]
        if change < BALANCED:
            return True
    return False


@inner
def _back(factor, x):
    """Solve with a Cholesky factor (6, 6), in place."""
    for d in range(6):
        value = x[d]
        for l in range(d):
            value -= factor[d, l] * x[l]
        x[d] = value / factor[d, d]
    for d in range(5, -1, -1):
        value = x[d]
        for l in range(d + 1, 6):
            value -= factor[l, d] * x[l]
        x[d] = value / factor[d, d]


@entry
def rates(model, x, y, tension, load, strain, warm, rate, tangent, by_state, by_tension):
    """Right-hand side at the points of a mesh, and its derivatives.

    Parameters
    ----------
    model : Model
        The arm.
    x, y : (m,), (states, m) arrays
        The mesh and the states there.
    tension : (n,) array
        Tensions [N].
    load : (LOAD,) array
        External load.
    strain : (m, M, 6) array
        In, if `warm`: strains to start from. Out: the strains.
    warm : bool
        Whether `strain` holds strains near those of this state; otherwise each point starts from the one before it.
    rate, tangent : (states, m), (3 M, m) arrays
        Out: derivatives of the states, and L p' in the base frame [m]; not finite where a section has no answer.
    by_state, by_tension : (states, states, m), (states, n, m) arrays
        Out: derivatives of `rate`; nothing is done about them where they are empty.
    """
    most = 0
    for k in range(model.length.size):
        most = max(most, model.first_muscle[k + 1] - model.first_muscle[k])
    section, wrench, norm, body, change = np.empty((6, 6)), np.empty((most, 6)), np.empty(most), np.empty(6), np.empty(6)
    differentiate = by_state.size > 0
    gravity = (load[6], load[7], load[8])
    for j in range(x.size):
        for k in range(model.length.size):
            row, length, unit = model.first_row[k], model.length[k], model.unit[k]
            i0, muscles = model.first_muscle[k], model.first_muscle[k + 1] - model.first_muscle[k]
            h = (y[row, j], y[row + 1, j], y[row + 2, j], y[row + 3, j])
            r = rotation_matrix(h)
            m = (unit * y[row + 4, j], unit * y[row + 5, j], unit * y[row + 6, j])
            mass = load[PAYLOAD_MASS] + model.beyond[k] + model.mass[k] * (1.0 - x[j])
            n = axpy(mass, gravity, (load[0], load[1], load[2]))
            bm, bn = apply_transposed(r, m), apply_transposed(r, n)
            for d in range(3):
                body[d], body[3 + d] = bm[d], bn[d]
            here = strain[j, k]
            if not warm:
                here[:] = strain[j - 1, k] if j > 0 else model.reference[k]
            balanced = False
            for attempt in range(3):
                if attempt > 0:
                    here[:] = model.reference[k]
                longest = np.inf if attempt < 2 else CAREFUL
                balanced = _balance(model, k, x[j], here, tension, body, longest, section, wrench, norm)
                if balanced:
                    break
            if not balanced:
                here[:] = model.reference[k]
                rate[:, j] = np.nan
                continue
            u, v = (here[0], here[1], here[2]), (here[3], here[4], here[5])
            _muscles(model, k, x[j], u, v, wrench, norm)
            dh = quaternion_rate(h, axpy(0.5 * length, u, ORIGIN))
            t = axpy(length, apply(r, v), ORIGIN)
            spin = cross(n, t)
            for d in range(4):
                rate[row + d, j] = dh[d]
            for d in range(3):
                tangent[3 * k + d, j] = t[d]
                rate[row + 4 + d, j] = spin[d] / unit
            for c in range(muscles):
                rate[row + 7 + c, j] = length * norm[c] / model.rest_length[i0 + c]
            if not differentiate:
                continue
            # By quaternion (0 to 3), moment (4 to 6) and tension of each muscle.
            scale = 2.0 / (h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3])
            for d in range(7 + muscles):
                theta, turned = ORIGIN, (0.0, 0.0, 0.0, 0.0)
                change[:] = 0.0
                if d < 4:
                    # A change of h turns the section by 2 Im(h* o dh)/|h|^2 in its own frame.
                    one = (1.0 if d == 0 else 0.0, 1.0 if d == 1 else 0.0, 1.0 if d == 2 else 0.0, 1.0 if d == 3 else 0.0)
                    turned = quaternion_rate(one, axpy(0.5 * length, u, ORIGIN))
                    theta = (
                        scale * (h[0] * one[1] - h[1] * one[0] - h[2] * one[3] + h[3] * one[2]),
                        scale * (h[0] * one[2] - h[2] * one[0] - h[3] * one[1] + h[1] * one[3]),
                        scale * (h[0] * one[3] - h[3] * one[0] - h[1] * one[2] + h[2] * one[1]),
                    )
                    dm, dn = cross(bm, theta), cross(bn, theta)
                    for l in range(3):
                        change[l], change[3 + l] = dm[l], dn[l]
                elif d < 7:
                    for l in range(3):
                        change[l] = unit * r[3 * (d - 4) + l]
                else:
                    for l in range(6):
                        change[l] = -wrench[d - 7, l]
                _back(section, change)
                du, dv = (change[0], change[1], change[2]), (change[3], change[4], change[5])
                bent = quaternion_rate(h, axpy(0.5 * length, du, ORIGIN))
                dspin = cross(n, apply(r, axpy(1.0, cross(theta, v), dv)))
                for l in range(7 + muscles):
                    if l < 4:
                        value = turned[l] + bent[l]
                    elif l < 7:
                        value = length / unit * dspin[l - 4]
                    else:
                        value = 0.0
                        for i in range(6):
                            value += wrench[l - 7, i] * change[i]
                        value *= length / model.rest_length[i0 + l - 7]
                    if d < 7:
                        by_state[row + l, row + d, j] = value
                    else:
                        by_tension[row + l, i0 + d - 7, j] = value


@entry
def boundary(model, y0, y1, tension, drive, load, rows, by_start, by_end, by_tension):
    """Boundary conditions (states + n,) at states y0, y1 (states,) of x = 0, 1, and their derivatives.

    Per module its rotation, the moment at its end and the path lengths at its base; then compatibility. `by_start`, `by_end`
    and `by_tension` receive derivatives.
    """
    modules = model.length.size
    by_start[:] = 0.0
    by_end[:] = 0.0
    by_tension[:] = 0.0
    place = 0
    for k in range(modules):
        row, before = model.first_row[k], model.first_row[k - 1]
        muscles = model.first_muscle[k + 1] - model.first_muscle[k]
        for d in range(4):
            rows[place] = y0[row + d]
            by_start[place, row + d] = 1.0
            if k == 0:
                rows[place] -= 1.0 if d == 0 else 0.0
            else:
                rows[place] -= y1[before + d]
                by_end[place, before + d] = -1.0
            place += 1
        for c in range(muscles):
            rows[place] = y0[row + 7 + c]
            by_start[place, row + 7 + c] = 1.0
            place += 1
        if k + 1 < modules:
            after, ratio = model.first_row[k + 1], model.unit[k + 1] / model.unit[k]
            for d in range(3):
                rows[place] = y1[row + 4 + d] - ratio * y0[after + 4 + d]
                by_end[place, row + 4 + d] = 1.0
                by_start[place, after + 4 + d] = -ratio
                place += 1
    row, unit = model.first_row[modules - 1], model.unit[modules - 1]
    h = (y1[row], y1[row + 1], y1[row + 2], y1[row + 3])
    r = rotation_matrix(h)
    scale = 2.0 / (h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3])
    centre = (load[10], load[11], load[12])
    weight = axpy(load[PAYLOAD_MASS], (load[6], load[7], load[8]), ORIGIN)
    moment = axpy(1.0, cross(apply(r, centre), weight), (load[3], load[4], load[5]))
    for d in range(3):
        rows[place + d] = y1[row + 4 + d] - moment[d] / unit
        by_end[place + d, row + 4 + d] = 1.0
    for i in range(4):
        one = (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0, 1.0 if i == 3 else 0.0)
        theta = (
            scale * (h[0] * one[1] - h[1] * one[0] - h[2] * one[3] + h[3] * one[2]),
            scale * (h[0] * one[2] - h[2] * one[0] - h[3] * one[1] + h[1] * one[3]),
            scale * (h[0] * one[3] - h[3] * one[0] - h[1] * one[2] + h[2] * one[1]),
        )
        change = cross(apply(r, cross(theta, centre)), weight)
        for d in range(3):
            by_end[place + d, row + i] = -change[d] / unit
    place += 3
    for k in range(modules):
        for c in range(model.first_muscle[k + 1] - model.first_muscle[k]):
            i = model.first_muscle[k] + c
            if model.kind[i] == TENDON:
                rows[place] = tension[i] - drive[i]
                by_tension[place, i] = 1.0
            else:
                rest = model.rest_length[i]
                delta, slope, _ = elongation(model.kind[i], model.parameters, i, rest, tension[i], drive[i])
                rows[place] = y1[model.first_row[k] + 7 + c] - 1.0 - delta / rest
                by_end[place, model.first_row[k] + 7 + c] = 1.0
                by_tension[place, i] = -slope / rest
            place += 1


class Problem:
    """What `solve_bvp` calls, for one drive and load."""

    def __init__(self, model: Model, drive: Array, load: Array) -> None:
        self.model, self.drive, self.load = model, drive, load
        self.states, self.modules = int(model.first_row[-1]), model.length.size
        n = len(drive)
        self._strains: dict[int, Array] = {}
        self._rows = np.empty(self.states + n)
        self._by_start, self._by_end = np.empty((2, self.states + n, self.states))
        self._by_tension = np.empty((self.states + n, n))
        self._none = np.empty((0, 0, 0))

    def rates(self, x: Array, y: Array, tension: Array, derivatives: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Return the right-hand side (states, m) and L p' (3 M, m)."""
        strain = self._strains.get(x.size)
        warm = strain is not None
        if strain is None:
            strain = self._strains[x.size] = np.empty((x.size, self.modules, 6))
        rate, tangent = np.empty(y.shape), np.empty((3 * self.modules, x.size))
        by_state, by_tension = derivatives or (self._none, self._none)
        rates(self.model, x, y, tension, self.load, strain, warm, rate, tangent, by_state, by_tension)
        return rate, tangent

    def fun(self, x: Array, y: Array, tension: Array) -> Array:
        """Return the right-hand side (states, m)."""
        return self.rates(x, y, tension)[0]

    def fun_jac(self, x: Array, y: Array, tension: Array) -> tuple[Array, Array]:
        """Return its derivatives in states and tensions."""
        derivatives = np.zeros((self.states, self.states, x.size)), np.zeros((self.states, tension.size, x.size))
        self.rates(x, y, tension, derivatives)
        return derivatives

    def bc(self, y0: Array, y1: Array, tension: Array) -> Array:
        """Return the boundary conditions (states + n,)."""
        self._boundary(y0, y1, tension)
        return self._rows.copy()

    def bc_jac(self, y0: Array, y1: Array, tension: Array) -> tuple[Array, Array, Array]:
        """Return their derivatives."""
        self._boundary(y0, y1, tension)
        return self._by_start, self._by_end, self._by_tension

    def _boundary(self, y0: Array, y1: Array, tension: Array) -> None:
        # Slices of the states at the mesh are strided: one type for the compiled function.
        boundary(
            self.model, y0.copy(), y1.copy(), tension, self.drive, self.load,
            self._rows, self._by_start, self._by_end, self._by_tension,
        )  # fmt: skip

    def tip(self, x: Array, y: Array, rate: Array, tension: Array) -> Array:
        """Return the tip's pose (4, 4) of a solution: Simpson's rule for the position."""
        h = np.diff(x)
        middle = 0.5 * (y[:, 1:] + y[:, :-1]) - 0.125 * h * (rate[:, 1:] - rate[:, :-1])
        _, ends = self.rates(x, y, tension)
        _, middles = self.rates(x[:-1] + 0.5 * h, middle, tension)
        pieces = (ends[:, :-1] + 4.0 * middles + ends[:, 1:]) @ h / 6.0
        row = self.model.first_row[-2]
        return pose(y[row : row + ROTATION, -1], pieces.reshape(-1, 3).sum(axis=0))


class Guess(NamedTuple):
    """A solution on its mesh, and what it is a solution for."""

    x: Array
    y: Array
    tension: Array
    drive: Array
    load: Array


class Bvp(NamedTuple):
    """`solve_bvp` at one tolerance."""

    arm: Arm
    model: Model
    tolerance: float

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        model, arm = self.model, self.arm
        _, tension, drive, load = arm.unloaded()
        turns = max((abs(muscle.turns) for muscle in arm.muscles), default=0.0)
        x = np.linspace(0.0, 1.0, 1 + INTERVALS + PER_TURN * ceil(turns))
        y = np.zeros((model.first_row[-1], x.size))
        for k, row in enumerate(model.first_row[:-1]):
            y[row] = 1.0
            y[row + ROTATION + MOMENT : model.first_row[k + 1]] = x
        return Guess(x, y, tension, drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the shape of `known` on the first mesh; its moments from section balance, its lengths linear in x."""
        model, guess = self.model, self.cold()
        x, y = guess.x, guess.y
        start = 0.0
        for k, module in enumerate(self.arm.modules):
            row, i0 = model.first_row[k], model.first_muscle[k]
            # A joint belongs to the module beyond it.
            s = start + module.length * np.minimum(x, 1.0 - 1e-9)
            poses, strains = known.sample(s)
            for j in range(x.size):
                y[row : row + ROTATION, j] = _quaternion(poses[j, :3, :3], y[row : row + ROTATION, max(j - 1, 0)])
                wrench = module.stiffness * (strains[j] - module.reference_strain)
                u, v = strains[j, :3], strains[j, 3:]
                for muscle, tension in zip(module.muscles, known.tensions[i0:], strict=False):
                    px, py, dx, dy = module.route(muscle, x[j])
                    r = np.array([px, py, 0.0])
                    t = v + np.cross(u, r) + (dx, dy, 0.0)
                    t /= np.linalg.norm(t)
                    wrench += tension * np.concatenate([np.cross(r, t), t])
                y[row + ROTATION : row + ROTATION + MOMENT, j] = poses[j, :3, :3] @ wrench[:3] / model.unit[k]
            for c, _ in enumerate(module.muscles):
                y[row + ROTATION + MOMENT + c] = x * known.muscle_lengths[i0 + c] / model.rest_length[i0 + c]
            start += module.length
        return Guess(x, y, known.tensions.copy(), known.drive.copy(), known.load.copy())

    def solve(self, state: State, guess: Guess) -> Answer:
        """Solve for the equilibrium at `state`."""
        drive, load = state.drive, state.load
        answer, tip = self._attempt(guess, drive, load, self.tolerance)
        if answer is not None:
            return Answer(True, tip, answer)
        # In substeps to a rough solution; the last attempt starts from that one, or from what came before it.
        known, done, step, rough = guess, 0.0, FIRST_SUBSTEP, max(self.tolerance, ROUGH)
        for _ in range(MAX_SUBSTEPS):
            here = min(1.0, done + step)
            drive_here = guess.drive + here * (drive - guess.drive)
            load_here = guess.load + here * (load - guess.load)
            answer, tip = self._attempt(known, drive_here, load_here, rough)
            if answer is not None:
                known, done, step = answer, here, 2.0 * step
                if here == 1.0:
                    break
            else:
                step *= 0.5
                if step < SMALLEST_SUBSTEP:
                    break
        if done < 1.0:
            return Answer(False, np.eye(4), None)
        if self.tolerance < ROUGH:
            answer, tip = self._attempt(known, drive, load, self.tolerance)
        return Answer(answer is not None, tip, answer)

    def _attempt(self, guess: Guess, drive: Array, load: Array, tolerance: float) -> tuple[Guess | None, Array]:
        """Return the solution at a drive and a load, or None, and the tip's pose."""
        problem = Problem(self.model, drive, load)
        try:
            with np.errstate(all="ignore"):
                found = solve_bvp(
                    problem.fun, problem.bc, guess.x, guess.y, guess.tension,
                    fun_jac=problem.fun_jac, bc_jac=problem.bc_jac, tol=tolerance, max_nodes=MAX_NODES,
                )  # fmt: skip
        except (ArithmeticError, ValueError, RuntimeError):  # from the linear algebra, of numbers that are not finite
            return None, np.eye(4)
        if found.status != 0:
            return None, np.eye(4)
        tip = problem.tip(found.x, found.y, found.yp, found.p)
        return Guess(found.x, found.y, found.p, drive, load), tip


def _quaternion(rotation: Array, last: Array) -> Array:
    """Return the quaternion of a rotation (3, 3), of the two that nearer to `last`."""
    k = np.array(
        [
            1.0 + np.trace(rotation),
            1.0 + 2.0 * rotation[0, 0] - np.trace(rotation),
            1.0 + 2.0 * rotation[1, 1] - np.trace(rotation),
            1.0 + 2.0 * rotation[2, 2] - np.trace(rotation),
        ]
    )
    a, b, c = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    d, e, f = rotation[0, 1] + rotation[1, 0], rotation[0, 2] + rotation[2, 0], rotation[1, 2] + rotation[2, 1]
    row = int(np.argmax(k))
    h = np.array([[k[0], a, b, c], [a, k[1], d, e], [b, d, k[2], f], [c, e, f, k[3]]])[row]
    h /= np.linalg.norm(h)
    return np.asarray(h if h @ last >= 0.0 else -h)


def build(arm: Arm, tolerance: float, states: Sequence[State]) -> Bvp:
    """Return the solver at a tolerance."""
    if not arm.muscles:
        raise ValueError("expected an arm with muscles: their tensions are the parameters of the boundary value problem")
    modules, whole = arm.modules, arm.model
    mass = np.array([module.mass_per_length * module.length for module in modules])
    muscles = [muscle for module in modules for muscle in module.muscles]
    per_module = [len(module.muscles) for module in modules]
    model = Model(
        first_row=np.cumsum([0] + [ROTATION + MOMENT + n for n in per_module]).astype(np.int64),
        first_muscle=whole.first_muscle,
        length=whole.length,
        unit=whole.stiffness[:, :2].min(axis=1) / whole.length,
        stiffness=whole.stiffness,
        reference=whole.reference,
        mass=mass,
        beyond=mass.sum() - np.cumsum(mass),
        offset=np.array([muscle.offset for muscle in muscles]),
        angle=np.array([muscle.angle for muscle in muscles]),
        winding=2.0 * np.pi * np.array([muscle.turns for muscle in muscles]),
        kind=whole.kind,
        parameters=whole.parameters,
        rest_length=whole.rest_length,
    )
    return Bvp(arm, model, tolerance)


METHOD = Method("boundary value problem (SciPy solve_bvp)", "tol", (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7), build)
