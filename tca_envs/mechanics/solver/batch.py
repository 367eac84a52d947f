"""What Python calls of the compiled kernels: `prepare` an arm, `solve` many lanes of it, `linearise` a state."""

import gc
import math
import os
import threading
from collections import OrderedDict
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numba import config, get_num_threads, get_thread_id, prange, set_num_threads, types
from numpy.typing import NDArray

from tca_envs.mechanics import laws, loads, thermal
from tca_envs.mechanics.laws import PARAMETERS, TENDON
from tca_envs.mechanics.rungs import SMALLEST_SUBSTEP, Rung
from tca_envs.mechanics.solver.cache import address_of_kernel, compiled, part
from tca_envs.mechanics.solver.fields import Arm, Rod, Twin, call, load_lane, store_lane, struct_of, table_of, views
from tca_envs.mechanics.solver.newton import ELIMINATE, EVALUATE, MAX_ITERATIONS, NEWTON, SUBSTITUTE, newton
from tca_envs.mechanics.solver.simd import LANES, Vec, any_lane, cross, dot, lane_of, real, rotation, spread, times, with_lane
from tca_envs.mechanics.solver.statics import eliminate, elongation, evaluate, substitute
from tca_envs.mechanics.thermal import Heat

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

FIRST_SUBSTEP = 0.25
"""As a share of the way."""
WARM, SUBSTEPS, FAILED = int(Rung.WARM), int(Rung.SUBSTEPS), int(Rung.FAILED)
WORK = 10_000
"""Nodes times Newton iterations of one call; muscles beyond a few to a module count, too."""
WORTH_SHARING = 32
"""Threshold for multithreading [lanes]: fewer gain less than it takes to wake threads."""
SHAPE, FACTORS, STEP, JACOBIAN = range(4)
ASKED = {"shape": SHAPE, "factors": FACTORS, "step": STEP, "jacobian": JACOBIAN}
"""What `linearise` can be asked for; each includes the ones before, but for the step."""
REPORT = np.dtype(
    {
        "names": ["rung", "residual", "iterations", "substep", "slowness", "jumped"],
        "formats": ["i8", "f8", "i8", "f8", "f8", "?"],
    },
    align=True,
)
"""What is told of a lane: rung, dimensionless residual, Newton iterations; of a lane that FAILED, the substep to go on with, as
a share of the way left; the largest ratio of Newton's steps, 0 where the first was not LONG; whether it left its branch."""


class Model(NamedTuple):
    """An arm as plain arrays. M modules, n muscles, G nodes, q <= Q nodes per element, at most m muscles in a module."""

    elements: Integers  # (M,) elements of each module
    nodes: Integers  # (M,) nodes per element
    length: Array  # (M,) [m]
    a: Array  # (M, Q, Q) Gauss coefficients a_jl on [0, 1]
    b: Array  # (M, Q) Gauss weights
    stiffness: Array  # (M, 6) diagonal of K
    reference: Array  # (M, 6) xi*
    first_muscle: Integers  # (M + 1,)
    route: Array  # (G, m, 4) muscle position x, y [m] and its derivative in s
    mass_beyond: Array  # (G,) mass of the arm beyond each node [kg]
    kind: Integers  # (n,) kind of muscle law
    parameters: Array  # (n, PARAMETERS) of muscle law
    rest_length: Array  # (n,) [m]
    tolerance: float  # Newton stops when the dimensionless residual is below this


class Problem(NamedTuple):
    """A model as the kernels read it."""

    model: Model
    sizes: dict[str, int]  # of the axes in `fields` ...
    shape: tuple[int, ...]  # ... and these alone: arms that share them can be worked on in the same packs
    data: Array  # the fields of `ARM_FIELDS` ...
    table: Integers  # ... and where they are
    rod_table: Integers  # where those of `ROD_FIELDS` are in packs ...
    rod_floats: int  # ... and how many floats they take
    steps: int  # Newton iterations that a lane may take in a call of `solve`

    def __reduce__(self) -> Any:
        return prepare, (self.model,)  # addresses of kernels are this process's own


class Lanes(NamedTuple):
    """N arms of one model in equilibrium; `solve` overwrites them."""

    strain: Array  # (N, G, 6) [u; v] at the nodes [1/m, 1]
    tension: Array  # (N, n) [N]
    drive: Array  # (N, n)
    load: Array  # (N, loads.SIZE)
    tip: Array  # (N, 4, 4) tip poses [m]
    length: Array  # (N, n) path lengths of the muscles [m]


class Linearisation(NamedTuple):
    """A state and what follows from its tangent."""

    residual: float  # dimensionless, see `statics.evaluate`
    energy: float  # of rod, muscles and loads [J]; true where tensions follow from path lengths
    negative: int  # how many eigenvalues of the tangent are negative
    rotated: float  # largest rotation of the step [rad] ...
    sheared: float  # ... and its largest change of v
    work: float  # of the step against the imbalance, g . dx [J]
    size: float  # dx . K dx [J]
    tension: Array  # (n,) [N]
    path: Array  # (n,) path lengths [m]
    h: Array  # (G, 4) quaternions at the nodes ...
    h_end: Array  # (E + 1, 4) ... and at the elements' ends
    p_end: Array  # (E + 1, 3) positions there [m]
    tangent: Array  # (G, 3) p' at the nodes
    spin: Array  # (G, 3) p' x n
    step: Array  # (G, 6) change of the strain
    tip: Array  # (6, 1) d(tip position, tip rotation) by the step, (6, n) by each drive; not finite without a tangent


heated = part(thermal.heated)
stored_energy = part(laws.stored_energy)


@partial(part, forceinline=True)  # a call would hand over a hundred numbers of its arrays
def put_lane(arm, rod, lane, lanes, asked, row, share):
    """Put a lane's state into the packs; drive and load a share of the way from those it is known at to those asked for."""
    strain, tension, from_drive, from_load, _, _ = lanes
    drive, load, _ = asked
    for g in range(arm.nodes):
        for d in range(3):
            store_lane(rod.u, g, d, lane, strain[row, g, d])
            store_lane(rod.v, g, d, lane, strain[row, g, 3 + d])
    moved = 0.0
    for i in range(arm.muscles):
        store_lane(rod.tension, i, 0, lane, tension[row, i])
        here, goal = from_drive[row, i], drive[row, i]
        store_lane(rod.drive, i, 0, lane, goal if share == 1.0 else here + share * (goal - here))
        if goal != here:
            moved = 1.0
    for d in range(from_load.shape[1]):
        here, goal = from_load[row, d], load[row, d]
        store_lane(rod.load, d, 0, lane, goal if share == 1.0 else here + share * (goal - here))
        if goal != here:
            moved = 1.0
    rod.moved = with_lane(rod.moved, lane, moved)


@partial(part, forceinline=True)  # a call would hand over a hundred numbers of its arrays
def take_lane(arm, rod, lane, lanes, row, answer):
    """Take an equilibrium out of the packs: the state, the drive and load that it is known at; tip and lengths of an answer."""
    strain, tension, from_drive, from_load, tip, length = lanes
    for g in range(arm.nodes):
        for d in range(3):
            strain[row, g, d] = load_lane(rod.u, g, d, lane)
            strain[row, g, 3 + d] = load_lane(rod.v, g, d, lane)
    for i in range(arm.muscles):
        tension[row, i] = load_lane(rod.tension, i, 0, lane)
        from_drive[row, i] = load_lane(rod.drive, i, 0, lane)
    for d in range(from_load.shape[1]):
        from_load[row, d] = load_lane(rod.load, d, 0, lane)
    if not answer:
        return
    for i in range(arm.muscles):
        length[row, i] = load_lane(rod.path, i, 0, lane)
    for d in range(3):
        tip[row, d, 3] = load_lane(rod.p_end, arm.elements, d, lane)
    R = rotation(rod.h_end[arm.elements])
    for d, column in enumerate((Vec(R.xx, R.yx, R.zx), Vec(R.xy, R.yy, R.zy), Vec(R.xz, R.yz, R.zz))):
        tip[row, 0, d], tip[row, 1, d] = lane_of(column.x, lane), lane_of(column.y, lane)
        tip[row, 2, d] = lane_of(column.z, lane)


@part
def follow(arm, rod, lanes, asked, row, steps, first):
    """Follow the branch of equilibria of one lane, copied to all places of the packs, to the drive and load asked for.

    Newton over `first`, a share of the way, to begin with; its first step is the tangent's prediction. Where it fails, in
    substeps, shortened on failure and doubled on success, until the branch ends or `steps` are done. What is reached on the way
    is the lane's known equilibrium from then on.
    """
    told = asked[2][row]
    slowest, work, done, step = 0.0, 0, 0.0, first
    told["rung"] = SUBSTEPS
    while True:
        here = min(1.0, done + step)
        for lane in range(arm.lanes):
            put_lane(arm, rod, lane, lanes, asked, row, 1.0 if here == 1.0 else (here - done) / (1.0 - done))
        call(arm.call[NEWTON], arm, rod, 0.0)
        iterations = int(lane_of(rod.iterations, 0))
        told["iterations"] += iterations
        work += iterations + 1
        if lane_of(rod.converged, 0) > 0.5:
            slowest = max(slowest, lane_of(rod.slowness, 0))
            take_lane(arm, rod, lane, lanes, row, here == 1.0)  # from any place, they hold the same
            if here == 1.0:
                break
            done, step = here, 2.0 * step
            continue
        step *= 0.5
        if step < SMALLEST_SUBSTEP or work >= steps:
            told["rung"], told["substep"] = FAILED, min(0.5, step / (1.0 - done))
            break
    told["residual"], told["slowness"] = lane_of(rod.worst, 0), slowest


arm_of, rod_of = struct_of(Arm), struct_of(Rod)


@compiled
def _solve_packs(problem, packs, lanes, asked, heat, numbers):
    """Solve the lanes of some packs: together by Newton from where they are, and stragglers one by one in substeps.

    `numbers` are the Newton iterations that a lane may take (0: no substeps), the substep to begin with (1 but for lanes that
    go on), the first of the packs and the one behind the last.
    """
    (data, table, rod_table), (drive, _, report), (action, temperature, power, constants) = problem, asked, heat
    steps, first, n, last = numbers
    arm, rod = arm_of(data, table), rod_of(packs, rod_table)
    while n < last:
        begin, end = n * LANES, min((n + 1) * LANES, len(drive))
        n += 1
        for row in range(begin, end):
            told = report[row]
            told["rung"], told["iterations"], told["jumped"] = FAILED, 0, False
            told["residual"], told["substep"], told["slowness"] = math.inf, 0.0, 0.0
            if len(action) > 0:  # drives are temperatures: heat for one step
                for i in range(drive.shape[1]):
                    drive[row, i], power[row, i] = heated(constants, i, temperature[row, i], action[row, i])
        if first == 1.0:
            for lane in range(arm.lanes):
                put_lane(arm, rod, lane, lanes, asked, min(begin + lane, end - 1), 1.0)  # fill up with copies of the last
            # What is heated has been solved before.
            call(arm.call[NEWTON], arm, rod, 1.0 if len(action) > 0 else 0.0)
            for row in range(begin, end):
                lane, told = row - begin, report[row]
                told["residual"], told["slowness"] = lane_of(rod.worst, lane), lane_of(rod.slowness, lane)
                told["iterations"], told["substep"] = int(lane_of(rod.iterations, lane)), FIRST_SUBSTEP
                converged = lane_of(rod.converged, lane) > 0.5
                if converged:
                    told["rung"] = WARM
                    take_lane(arm, rod, lane, lanes, row, converged)
        if steps > 0:
            for row in range(begin, end):
                if report[row]["rung"] == FAILED:
                    follow(arm, rod, lanes, asked, row, steps, FIRST_SUBSTEP if first == 1.0 else first)


@partial(compiled, parallel=True)
def _solve_in_parallel(problem, packs, lanes, asked, heat, numbers):
    steps, first, begin, end = numbers
    for n in prange(begin, end):
        _solve_packs(problem, packs[get_thread_id()], lanes, asked, heat, (steps, first, n, n + 1))


@part
def energy_of(arm, rod):
    """Write the energy of a state, and a step's work against the imbalance and its size: rod and muscles store, loads lose.

    int n . p' ds is the work of the tip force and of all weights but the lever of the payload's. A tip moment has no potential.
    """
    energy, work, size, g = spread(0.0), 0.0, 0.0, 0
    for k in range(arm.modules):
        for _ in range(arm.pieces[k]):
            for j in range(arm.width[k]):
                du, dv = rod.u[g] - arm.rest_u[k], rod.v[g] - arm.rest_v[k]
                stored = 0.5 * (dot(du, times(arm.k_u[k], du)) + dot(dv, times(arm.k_v[k], dv)))
                bend, shear, h = rod.bend[g], rod.shear[g], arm.weight[k, j]
                energy += h * (stored - dot(rod.force[g], rod.v[g]))
                work += h * (dot(rod.off_u[g], bend) + dot(rod.off_v[g], shear))
                size += h * (dot(bend, times(arm.k_u[k], bend)) + dot(shear, times(arm.k_v[k], shear)))
                g += 1
    for i in range(arm.muscles):
        energy += stored_energy(arm.kind[i], arm.law, i, arm.rest[i], rod.tension[i], rod.path[i])
    lever = rotation(rod.h_end[arm.elements]) @ rod.centre
    rod.energy = energy - rod.mass * dot(lever, rod.gravity)
    rod.work = work
    rod.size = size


@part
def solve_for(arm, rod, tips, column):
    """Solve the factorised tangent and write how the tip moves and turns."""
    call(arm.call[SUBSTITUTE], arm, rod, 0.0)
    dp, turn, g = Vec(0.0, 0.0, 0.0), rod.tip_turn, 0
    for k in range(arm.modules):
        for _ in range(arm.pieces[k]):
            for j in range(arm.width[k]):  # dp' = phi x p' + R dv
                dp += arm.weight[k, j] * (cross(rod.phi[g], rod.tangent[g]) + rod.R[g] @ rod.shear[g])
                g += 1
    tips[0, column], tips[1, column], tips[2, column] = lane_of(dp.x, 0), lane_of(dp.y, 0), lane_of(dp.z, 0)
    tips[3, column], tips[4, column], tips[5, column] = lane_of(turn.x, 0), lane_of(turn.y, 0), lane_of(turn.z, 0)


@part
def by_drives(arm, rod, tips):
    """Solve the tangent for the derivative by each drive: by the implicit function theorem."""
    for g in range(arm.nodes):
        rod.off_u[g] = Vec(0.0, 0.0, 0.0)
        rod.off_v[g] = Vec(0.0, 0.0, 0.0)
    for i in range(arm.muscles):
        for other in range(arm.muscles):
            rod.gap[other] = 0.0
        if arm.kind[i] == TENDON:  # its row reads -dF = -gap
            rod.gap[i] = 1.0
        else:
            _, _, slope = elongation(arm.kind[i], arm.law, i, arm.rest[i], rod.tension[i], rod.drive[i])
            rod.gap[i] = -slope
        solve_for(arm, rod, tips, i)


@part
def slave_tension(arm, rod, i):
    """Set a muscle's tension to that at which it has its path length: Newton, for elongation grows with tension."""
    tension = rod.tension[i]
    for _ in range(60):
        delta, softness, _ = elongation(arm.kind[i], arm.law, i, arm.rest[i], tension, rod.drive[i])
        step = (rod.path[i] - arm.rest[i] - delta) / softness
        tension += step
        if not any_lane(abs(step) > 1e-14 + 1e-13 * abs(tension)):
            break
    rod.tension[i] = tension


@compiled
def _linearise(data, table, packs, rod_table, numbers, given, tips):
    """Do what `linearise` says for the state in all lanes of the packs."""
    damping, slaved, ask = numbers
    arm, rod = arm_of(data, table), rod_of(packs, rod_table)
    rod.active, rod.negative = 1.0, 1.0  # what is no configuration is not stable
    rod.energy, rod.rotated, rod.sheared, rod.work, rod.size = 0.0, 0.0, 0.0, 0.0, 0.0
    call(arm.call[EVALUATE], arm, rod, 0.0)
    if slaved and lane_of(rod.worst, 0) < math.inf:
        for i in range(arm.muscles):
            if arm.kind[i] != TENDON:
                slave_tension(arm, rod, i)
        call(arm.call[EVALUATE], arm, rod, 1.0)
    if not lane_of(rod.worst, 0) < math.inf:
        return
    rod.negative = 0.0
    if ask != SHAPE:
        call(arm.call[ELIMINATE], arm, rod, damping)
    if ask == JACOBIAN:
        by_drives(arm, rod, tips)
    elif ask == STEP:
        if len(given):  # another imbalance at the nodes (G, 6), lengths being right
            for i in range(arm.muscles):
                rod.gap[i] = 0.0
            for g in range(arm.nodes):
                rod.off_u[g] = Vec(given[g, 0], given[g, 1], given[g, 2])
                rod.off_v[g] = Vec(given[g, 3], given[g, 4], given[g, 5])
        solve_for(arm, rod, tips, tips.shape[1] - 1)
    energy_of(arm, rod)


KERNEL = types.void(Arm, Rod, real)


@cache
def kernels() -> Integers:
    """Return the addresses of the kernels; compiles them, or reads them from the cache."""
    collects = gc.isenabled()
    gc.disable()  # it would take a tenth of the time
    try:
        return np.array([address_of_kernel(kernel, KERNEL) for kernel in (evaluate, eliminate, substitute, newton)])
    finally:
        if collects:
            gc.enable()


def prepare(model: Model) -> Problem:
    """Return an arm as the kernels read it: its fields in one array."""
    h = model.length / model.elements
    late = h[:, None, None] * (model.b[:, None] - np.concatenate([np.zeros_like(model.b)[:, None], model.a], axis=1))
    inner = h[:, None, None] * model.a
    coupling = np.zeros((*late.shape[:2], late.shape[2] ** 2))
    for k, q in enumerate(model.nodes):
        coupling[k, :, : q * q] = np.einsum("rj,jl->rlj", late[k, :, :q], inner[k, :q, :q]).reshape(-1, q * q)
    x, y, dx, dy = np.moveaxis(model.route, 2, 0)
    (modules, rows, q), (nodes, most), elements = late.shape, x.shape, int(model.elements.sum())
    values: dict[str, Any] = dict(
        modules=modules, muscles=len(model.kind), nodes=nodes, elements=elements, lanes=LANES, tolerance=model.tolerance,
        call=0 if config.DISABLE_JIT else kernels(), pieces=model.elements, width=model.nodes, first=model.first_muscle,
        kind=model.kind, weight=h[:, None] * model.b, inner=inner, late=late, coupling=coupling, x=x, y=y, dx=dx, dy=dy,
        mass_beyond=model.mass_beyond, law=model.parameters, rest=model.rest_length,
    )  # fmt: skip
    unit = np.where(np.arange(6) < 3, model.length[:, None], 1.0) / model.stiffness
    for name, numbers in (("k", model.stiffness), ("rest", model.reference), ("unit", unit)):
        values[f"{name}_u"], values[f"{name}_v"] = numbers[:, :3, None], numbers[:, 3:, None]
    sizes = {
        "M": modules, "M+1": modules + 1, "n": len(model.kind), "G": nodes, "E+1": elements + 1, "Q": q, "Q+1": rows,
        "QQ": q * q, "m": most, "P": PARAMETERS, "L": loads.SIZE,
    }  # fmt: skip
    (table, floats), (rod_table, rod_floats) = table_of(Arm, sizes), table_of(Rod, sizes)
    data = _aligned(floats)
    for name, field in views(Arm, sizes, table, data).items():
        field[...] = values[name]
    steps = max(MAX_ITERATIONS, WORK // (nodes * max(1, most // 4)))
    return Problem(model, sizes, tuple(sizes.values()), data, table, rod_table, rod_floats, steps)


class _Workspace(threading.local):
    """Packs for the kernels to work on; each thread of Python has its own, for the latest few shapes of arms."""

    def __init__(self) -> None:
        self.kept: OrderedDict[Any, tuple[Array, Array, Any]] = OrderedDict()

    def of(self, problem: Problem, threads: int = 1) -> tuple[Array, Array, Any]:
        """Return as many times the packs of an arm as there are threads, each in a row; the first row, and its fields."""
        key = (threads, problem.shape)
        found = self.kept.get(key)
        if found is None:
            packs = _aligned(threads * problem.rod_floats).reshape(threads, -1)
            found = self.kept[key] = packs, packs[0], views(Rod, problem.sizes, problem.rod_table, packs[0])
            while len(self.kept) > 1 and sum(kept[0].nbytes for kept in self.kept.values()) > MOST_BYTES:
                self.kept.popitem(last=False)
        self.kept.move_to_end(key)
        return found


MOST_BYTES = 2**25  # workspaces of a thread take no more, but for the latest one
_workspace = _Workspace()


def _aligned(floats: int) -> Array:
    """Return zeros that begin, and in rows of so many begin, where packs may be read at once."""
    raw = np.zeros(floats + 8)
    return raw[-(raw.ctypes.data // 8) % 8 :][:floats]


_forked: list[bool] = []
"""Not empty in a forked process: threads do not survive a fork, and OpenMP would wait for its own for ever."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: _forked.append(True))

NO_HEAT = tuple(np.empty((4, 0, 0)))


def solve(
    problem: Problem, lanes: Lanes, drive: Array, load: Array, first: float = 1.0, substeps: bool = True, threads: int = 1,
    heat: Heat | None = None,
) -> Any:  # fmt: skip
    """Follow the branches of N arms of one model, each from its own known equilibrium: Newton, then substeps.

    Parameters
    ----------
    problem : Problem
        The arm.
    lanes : Lanes
        In: known equilibria, their drives and loads. Out: the asked ones; where there was none, `tip` and `length` are as they
        were and the rest is the last equilibrium on the way.
    drive, load : (N, n or more), (N, loads.SIZE) arrays
        What is asked; a lane's first n drives are the arm's.
    first : float
        Substep to begin with, as a share of the way: 1 but for a lane that goes on.
    substeps : bool
        Whether there are any.
    threads : int
        How many share the work; no number depends on it.
    heat : Heat, optional
        How `drive` comes about; it is overwritten then. Lanes must be at equilibria found before.

    Returns
    -------
    (N,) array of REPORT
        A lane that FAILED is at the end of its branch (the substep is below SMALLEST_SUBSTEP) or has done its share of WORK.
    """
    report = np.empty(len(drive), dtype=REPORT)
    numbers = (problem.steps if substeps else 0, first, 0, -(-len(drive) // LANES))
    arrays, asked = (problem.data, problem.table, problem.rod_table), (drive, load, report)
    known, given = tuple(lanes), NO_HEAT if heat is None else tuple(heat)
    if config.DISABLE_JIT:
        arm, rod = twins(problem)
        _solve_packs((arm, *arrays[1:]), rod, known, asked, given, numbers)
    elif threads > 1 and len(drive) >= WORTH_SHARING and not _forked:
        before = get_num_threads()
        set_num_threads(threads)
        try:
            _solve_in_parallel(arrays, _workspace.of(problem, threads)[0], known, asked, given, numbers)
        finally:
            set_num_threads(before)
    else:
        _solve_packs(arrays, _workspace.of(problem)[1], known, asked, given, numbers)
    return report


def twins(problem: Problem) -> tuple[Twin, Twin]:
    """Return what kernels get that run in an interpreter: an arm, and the first lane of the packs that it is solved in."""
    fields = views(Arm, problem.sizes, problem.table, problem.data)
    return Twin(Arm, fields, call=(evaluate, eliminate, substitute, newton)), Twin(Rod, _workspace.of(problem)[2])


NOTHING = np.empty((0, 6))


def linearise(
    problem: Problem, strain: Array, tension: Array, drive: Array, load: Array, ask: str, damping: float = 0.0,
    slaved: bool = False, given: Array = NOTHING,
) -> Linearisation:  # fmt: skip
    """Evaluate a state and what follows from its tangent; everything but the hot path is made of this.

    Parameters
    ----------
    problem : Problem
        The arm.
    strain, tension : (G, 6), (n,) arrays
        The state.
    drive, load : (n,), (loads.SIZE,) arrays
        Drives and load.
    ask : str
        "shape": the state alone; "factors": those of the tangent, too; "step": Newton's step, or that under the imbalance
        `given`; "jacobian": derivatives in the drives.
    damping : float
        So many times the rod's stiffness K is added to the tangent.
    slaved : bool
        Whether tensions follow from the path lengths.
    given : (G, 6) array, optional
        Imbalance at the nodes.
    """
    _, packs, fields = _workspace.of(problem)
    fields["u"][...], fields["v"][...] = strain[:, :3, None], strain[:, 3:, None]
    fields["bend"][...], fields["shear"][...] = 0.0, 0.0
    fields["tension"][:, 0], fields["drive"][:, 0], fields["load"][:, 0] = tension[:, None], drive[:, None], load[:, None]
    tips = np.zeros((6, len(drive) if ask == "jacobian" else int(ask == "step")))
    arm, rod = twins(problem) if config.DISABLE_JIT else (problem.data, packs)
    numbers = (float(damping), bool(slaved), ASKED[ask])
    _linearise(arm, problem.table, rod, problem.rod_table, numbers, np.ascontiguousarray(given), tips)
    residual, energy, negative, rotated, sheared, work, size = (float(fields[name][0, 0]) for name in ONE)
    tension, path, *many = (fields[name][..., 0].copy() for name in MANY)
    h, h_end, p_end, tangent, spin, bend, shear = many
    return Linearisation(
        residual, energy, int(negative), rotated, sheared, work, size, tension[:, 0], path[:, 0], h, h_end, p_end, tangent,
        spin, step=np.hstack([bend, shear]), tip=tips,
    )  # fmt: skip


ONE = ("worst", "energy", "negative", "rotated", "sheared", "work", "size")
MANY = ("tension", "path", "h", "h_end", "p_end", "tangent", "spin", "bend", "shear")
"""Fields that `linearise` returns."""
