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
from math import ceil, inf
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation

from study.method import Answer, Array, Method, State

from study.notation import (  # isort: skip
    TENDON, Integers, carried, carries, copy6, inline, kernel, masses, mismatch, most_turns, put1, routes, settle,
    tip_moment, tip_moment_turned, vec, vec1,
)  # fmt: skip
from study.shooting import wrench
from tca_envs.mechanics import Arm, Equilibrium, compiled
from tca_envs.mechanics.arm import pose
from tca_envs.mechanics.solver.simd import Quat, Vec, cross, dot, product, rotation, transpose

MAX_NODES = 2000  # of the mesh
INTERVALS, PER_TURN = 6, 4  # of the first mesh, and how many more for each turn of a helical muscle
ROUGH = 1e-2  # tolerance of substeps
MAX_SUBSTEPS = 16
FIRST_SUBSTEP, SMALLEST_SUBSTEP = 0.25, 1.0 / 32.0
SETTLED = 1e-7  # dimensionless imbalance of a section that a last Newton step squares
CAREFUL = 1.0  # where a balance fails, steps change the strain by no more than this: muscles that push make it very nonlinear
ROTATION, MOMENT = 4, 3


class Model(NamedTuple):
    """Where a module's states are: quaternion, moment, path lengths."""

    first_row: Integers  # (M + 1,)
    unit: Array  # (M,) of moments, EI/L [N m]
    mass: Array  # (M,) [kg]
    beyond: Array  # (M,) mass of the modules after it [kg]


@inline
def quaternion_at(y, row, j):
    """Return the quaternion that begins at a row of column j."""
    return Quat(y[row, j], y[row + 1, j], y[row + 2, j], y[row + 3, j])


@inline
def turn_of(h, d):
    """Return the change of a quaternion's component d, and the body's turn that it makes, 2 Im(h* o dh)/|h|^2."""
    one = Quat(1.0 * (d == 0), 1.0 * (d == 1), 1.0 * (d == 2), 1.0 * (d == 3))
    scale = 2.0 / (h.w * h.w + h.x * h.x + h.y * h.y + h.z * h.z)
    a, b = Vec(h.x, h.y, h.z), Vec(one.x, one.y, one.z)
    return one, scale * (h.w * b - one.w * a - cross(a, b))


@kernel
def rates(arm, model, x, route, y, tension, load, strain, warm, scratch, rate, tangent, by_state, by_tension):
    """Right-hand side at the points of a mesh, and its derivatives.

    `x` (k,) is the mesh, `route` (M, k, m, 4) and `y` (states, k) are the muscles' routes and the states there. `strain` (k, M,
    6) holds, if `warm`, strains to start from (else each point starts from the one before it) and becomes the strains. `rate`
    (states, k) and `tangent` (3 M, k) become derivatives of the states and L p' in the base frame [m], not finite where a
    section has no answer; `by_state`, `by_tension` the derivatives of `rate`, unless they are empty. `scratch` is (7, m).
    """
    stretch, pull = scratch[0], scratch[1:].reshape(-1, 6)
    for j in range(x.size):
        for k in range(arm.length.size):
            row, length, unit = model.first_row[k], arm.length[k], model.unit[k]
            first, muscles = arm.first_muscle[k], arm.first_muscle[k + 1] - arm.first_muscle[k]
            h = quaternion_at(y, row, j)
            r = rotation(h)
            m = unit * Vec(y[row + 4, j], y[row + 5, j], y[row + 6, j])
            n = carries(load, model.beyond[k] + model.mass[k] * (1.0 - x[j]))
            bm, bn, here = transpose(r) @ m, transpose(r) @ n, strain[j, k]
            if not warm:
                copy6(here, strain[j - 1, k] if j > 0 else arm.reference[k])
            for attempt in range(3):
                if attempt > 0:
                    copy6(here, arm.reference[k])
                longest = inf if attempt < 2 else CAREFUL
                balanced, flexibility, gain, softness = settle(
                    arm, k, route[k], j, tension, bm, bn, here, SETTLED, longest, stretch, pull
                )
                if balanced:
                    break
            if not balanced:
                copy6(here, arm.reference[k])
                rate[:, j] = np.nan
                continue
            u, v = vec1(here, 0), vec1(here, 3)
            dh, t = product(h, 0.5 * length * u), length * (r @ v)
            spin = 1.0 / unit * cross(n, t)
            rate[row, j], rate[row + 1, j], rate[row + 2, j], rate[row + 3, j] = dh.w, dh.x, dh.y, dh.z
            rate[row + 4, j], rate[row + 5, j], rate[row + 6, j] = spin.x, spin.y, spin.z
            tangent[3 * k, j], tangent[3 * k + 1, j], tangent[3 * k + 2, j] = t.x, t.y, t.z
            for c in range(muscles):
                rate[row + 7 + c, j] = length * stretch[c] / arm.rest_length[first + c]
            if by_state.size == 0:
                continue
            # By quaternion (0 to 3), moment (4 to 6) and tension of each muscle.
            for d in range(7 + muscles):
                theta, turned = Vec(0.0, 0.0, 0.0), Quat(0.0, 0.0, 0.0, 0.0)
                if d < 4:
                    one, theta = turn_of(h, d)
                    turned, moment, force = product(one, 0.5 * length * u), cross(bm, theta), cross(bn, theta)
                elif d < 7:
                    moment = transpose(r) @ Vec(unit * (d == 4), unit * (d == 5), unit * (d == 6))
                    force = Vec(0.0, 0.0, 0.0)
                else:
                    moment, force = -vec(pull, d - 7, 0), -vec(pull, d - 7, 3)
                du, dv = carried(flexibility, gain, softness, moment, force)
                turned += product(h, 0.5 * length * du)
                spin = length / unit * cross(n, r @ (cross(theta, v) + dv))
                target, column = (by_state, row + d) if d < 7 else (by_tension, first + d - 7)
                target[row, column, j], target[row + 1, column, j] = turned.w, turned.x
                target[row + 2, column, j], target[row + 3, column, j] = turned.y, turned.z
                target[row + 4, column, j], target[row + 5, column, j], target[row + 6, column, j] = spin.x, spin.y, spin.z
                for c in range(muscles):
                    change = dot(vec(pull, c, 0), du) + dot(vec(pull, c, 3), dv)
                    target[row + 7 + c, column, j] = length / arm.rest_length[first + c] * change


@compiled
def boundary(arm, model, y0, y1, tension, drive, load, rows, by_start, by_end, by_tension):
    """Boundary conditions (states + n,) at states y0, y1 (states,) of x = 0, 1, and their derivatives.

    Per module its rotation and the path lengths at its base and the moment at its end; then compatibility. `by_start`, `by_end`
    and `by_tension` receive derivatives.
    """
    last = arm.length.size - 1
    by_start[:], by_end[:], by_tension[:] = 0.0, 0.0, 0.0
    place = 0
    for k in range(last + 1):
        row, beyond = model.first_row[k], model.first_row[k + 1]
        for d in range(beyond - row - 3):
            at = row + (d if d < 4 else d + 3)  # quaternion and path lengths
            rows[place] = y0[at] - (1.0 if d == 0 and k == 0 else 0.0)
            by_start[place, at] = 1.0
            if d < 4 and k > 0:
                rows[place] -= y1[model.first_row[k - 1] + d]
                by_end[place, model.first_row[k - 1] + d] = -1.0
            place += 1
        if k < last:
            ratio = model.unit[k + 1] / model.unit[k]
            for d in range(4, 7):
                rows[place] = y1[row + d] - ratio * y0[beyond + d]
                by_end[place, row + d], by_start[place, beyond + d] = 1.0, -ratio
                place += 1
    row, unit = model.first_row[last], model.unit[last]
    h = Quat(y1[row], y1[row + 1], y1[row + 2], y1[row + 3])
    r = rotation(h)
    put1(rows, place, vec1(y1, row + 4) - 1.0 / unit * tip_moment(load, r))
    for d in range(4):
        _, theta = turn_of(h, d)
        change = -1.0 / unit * tip_moment_turned(load, r, r @ theta)
        by_end[place, row + d], by_end[place + 1, row + d], by_end[place + 2, row + d] = change.x, change.y, change.z
    for d in range(3):
        by_end[place + d, row + 4 + d] = 1.0
    place += 3
    for k in range(last + 1):
        for i in range(arm.first_muscle[k], arm.first_muscle[k + 1]):
            at = model.first_row[k] + 7 + i - arm.first_muscle[k]
            if arm.kind[i] == TENDON:
                rows[place], by_tension[place, i] = tension[i] - drive[i], 1.0
            else:
                by_end[place, at] = 1.0
                rows[place], by_tension[place, i] = mismatch(arm, i, y1[at] * arm.rest_length[i], tension[i], drive[i])
            place += 1


class Problem:
    """What `solve_bvp` calls, for one drive and load."""

    def __init__(self, solver: "Bvp", drive: Array, load: Array) -> None:
        self.solver, self.drive, self.load = solver, drive, load
        self.states, self.modules, n = int(solver.model.first_row[-1]), len(solver.arm.modules), len(drive)
        self._strains: dict[int, Array] = {}
        shapes = (), (self.states,), (self.states,), (n,)
        self._conditions = [np.empty((self.states + n, *columns)) for columns in shapes]

    def rates(self, x: Array, y: Array, tension: Array, derivatives: tuple[Array, Array] | None = None) -> tuple[Array, Array]:
        """Return the right-hand side (states, k) and L p' (3 M, k)."""
        strain = self._strains.get(x.size)
        warm = strain is not None
        if strain is None:
            strain = self._strains[x.size] = np.empty((x.size, self.modules, 6))
        rate, tangent, none = np.empty(y.shape), np.empty((3 * self.modules, x.size)), np.empty((0, 0, 0))
        route, scratch = self.solver.routes(x)
        known = self.solver.arm.model, self.solver.model, x, route, y, tension, self.load, strain, warm, scratch
        rates(*known, rate, tangent, *(derivatives or (none, none)))
        return rate, tangent

    def fun_jac(self, x: Array, y: Array, tension: Array) -> tuple[Array, Array]:
        """Return the derivatives of the right-hand side in states and tensions."""
        derivatives = np.zeros((self.states, self.states, x.size)), np.zeros((self.states, tension.size, x.size))
        self.rates(x, y, tension, derivatives)
        return derivatives

    def boundary(self, y0: Array, y1: Array, tension: Array) -> tuple[Array, ...]:
        """Return the boundary conditions (states + n,) and their derivatives."""
        # Slices of the states at the mesh are strided: one type for the compiled function.
        known, result = (y0.copy(), y1.copy(), tension, self.drive, self.load), self._conditions
        boundary(self.solver.arm.model, self.solver.model, *known, *result)
        return result[0].copy(), *result[1:]

    def tip(self, x: Array, y: Array, rate: Array, tension: Array) -> Array:
        """Return the tip's pose (4, 4) of a solution: Simpson's rule for the position."""
        h = np.diff(x)
        middle = 0.5 * (y[:, 1:] + y[:, :-1]) - 0.125 * h * (rate[:, 1:] - rate[:, :-1])
        _, ends = self.rates(x, y, tension)
        _, middles = self.rates(x[:-1] + 0.5 * h, middle, tension)
        pieces = (ends[:, :-1] + 4.0 * middles + ends[:, 1:]) @ h / 6.0
        row = self.solver.model.first_row[-2]
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
    known: dict[bytes, Array]  # routes on meshes that were met

    def routes(self, x: Array) -> tuple[Array, Array]:
        """Return the muscles' routes (M, k, m, 4) on a mesh, and scratch for their section."""
        most = max(len(module.muscles) for module in self.arm.modules)
        key = x.tobytes()
        if key not in self.known:
            self.known[key] = np.stack([routes(module, x, most) for module in self.arm.modules])
        return self.known[key], np.empty((7, most))

    def cold(self) -> Guess:
        """Return the unloaded arm."""
        model, arm = self.model, self.arm
        _, tension, drive, load = arm.unloaded()
        x = np.linspace(0.0, 1.0, 1 + INTERVALS + PER_TURN * ceil(most_turns(arm.muscles)))
        y = np.zeros((model.first_row[-1], x.size))
        for k, row in enumerate(model.first_row[:-1]):
            y[row] = 1.0
            y[row + ROTATION + MOMENT : model.first_row[k + 1]] = x
        return Guess(x, y, tension, drive, load)

    def near(self, known: Equilibrium, state: State) -> Guess:
        """Return the shape of `known` on the first mesh; its moments from section balance, its lengths linear in x."""
        model, (x, y, *_), start = self.model, self.cold(), 0.0
        for k, module in enumerate(self.arm.modules):
            mine, row = slice(*self.arm.model.first_muscle[k : k + 2]), model.first_row[k]
            # A joint belongs to the module beyond it.
            poses, strains = known.sample(start + module.length * np.minimum(x, 1.0 - 1e-9))
            h = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
            # Of the two quaternions of a rotation those that go on along the mesh, from 1.
            steps = np.sum(h * np.vstack([[1.0, 0.0, 0.0, 0.0], h[:-1]]), axis=1)
            y[row : row + ROTATION] = (h * np.cumprod(np.where(steps < 0.0, -1.0, 1.0))[:, np.newaxis]).T
            for j in range(x.size):
                moment = wrench(module, x[j] * module.length, strains[j], known.tensions[mine])[:3]
                y[row + ROTATION : row + ROTATION + MOMENT, j] = poses[j, :3, :3] @ moment / model.unit[k]
            ratio = known.muscle_lengths[mine] / self.arm.model.rest_length[mine]
            y[row + ROTATION + MOMENT : model.first_row[k + 1]] = ratio[:, np.newaxis] * x
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
        problem = Problem(self, drive, load)
        try:
            with np.errstate(all="ignore"):
                found = solve_bvp(
                    lambda *at: problem.rates(*at)[0], lambda *at: problem.boundary(*at)[0], guess.x, guess.y, guess.tension,
                    fun_jac=problem.fun_jac, bc_jac=lambda *at: problem.boundary(*at)[1:], tol=tolerance, max_nodes=MAX_NODES,
                )  # fmt: skip
        except (ArithmeticError, ValueError, RuntimeError):  # from the linear algebra, of numbers that are not finite
            return None, np.eye(4)
        if found.status != 0:
            return None, np.eye(4)
        tip = problem.tip(found.x, found.y, found.yp, found.p)
        return Guess(found.x, found.y, found.p, drive, load), tip


def build(arm: Arm, tolerance: float, states: Sequence[State]) -> Bvp:
    """Return the solver at a tolerance."""
    if not arm.muscles:
        raise ValueError("expected an arm with muscles: their tensions are the parameters of the boundary value problem")
    rows = np.cumsum([0] + [ROTATION + MOMENT + len(module.muscles) for module in arm.modules]).astype(np.int64)
    unit = arm.model.stiffness[:, :2].min(axis=1) / arm.model.length
    return Bvp(arm, Model(rows, unit, *masses(arm)), tolerance, {})


METHOD = Method("boundary value problem (SciPy solve_bvp)", "tol", (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7), build)
