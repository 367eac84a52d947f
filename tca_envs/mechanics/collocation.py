"""The equilibrium of arms by Gauss collocation of the strain: what Python calls of the compiled `kernels`."""

import gc
import os
import threading
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import cfunc, get_num_threads, get_thread_id, prange, set_num_threads
from numpy.typing import NDArray

from tca_envs.mechanics import kernels
from tca_envs.mechanics.algebra import CALLED, apply, axpy, dot, entry, merged, parallel, rotation_matrix
from tca_envs.mechanics.kernels import (
    ACTIVE,
    AT_ACTION,
    AT_DRIVE,
    AT_FROM_DRIVE,
    AT_FROM_LOAD,
    AT_HEATING,
    AT_LENGTHS,
    AT_LOAD,
    AT_POWER,
    AT_REPORT,
    AT_STRAIN,
    AT_TEMPERATURE,
    AT_TENSION,
    AT_TIP,
    BEND,
    BUDGET,
    COUNT,
    DRIVE,
    ELEMENTS,
    ELIMINATE,
    ENDS,
    EVALUATE,
    FORCE,
    GAP,
    HEAT,
    HEATED,
    INDEX,
    JOB,
    KIND,
    LANES,
    LAW,
    LENGTH,
    LOAD,
    MAX_ITERATIONS,
    MODULES,
    MUSCLES,
    NODES,
    NODES_OF,
    PATHS,
    PAYLOAD_MASS,
    PIECES,
    REFERENCE,
    REPORT,
    RESIDUAL,
    REST,
    ROTATED,
    SHEAR,
    SHEARED,
    STIFFNESS,
    STRAIN,
    SUBSTITUTE,
    TENSION,
    TIP,
    TOTAL,
    WIDE,
    WORST,
    B,
    get3,
)  # fmt: skip
from tca_envs.mechanics.muscle import PARAMETERS, TENDON, law, pull, stored
from tca_envs.mechanics.packs import (
    ALIGNMENT,
    KERNEL,
    address_of,
    call_kernel,
    floats_of,
    pointer_to_floats,
    pointer_to_ints,
    pointer_to_packs,
)  # fmt: skip
from tca_envs.mechanics.traced import PACK, spread, traced
from tca_envs.mechanics.written import written

Array = NDArray[np.float64]

WORK = 10_000
"""Nodes times Newton iterations of one call; muscles beyond a few to a module count, too."""
WORTH_SHARING = 32
"""Lanes from which on threads gain more than it takes to wake them."""
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
    tolerance: float  # Newton stops when the dimensionless residual is below this (see `kernels.evaluate`)
    ladder: bool  # whether `solve_lanes` goes on where Newton fails
    f: Array  # all numbers, flat, and ...
    i: NDArray[np.int64]  # ... all integers for `kernels`, see `flat`


def flat(elements, nodes, length, a, b, stiffness, reference, first_muscle, route, mass_below, kind, parameters, rest_length,
         tolerance):  # fmt: skip
    """Return the numbers and the integers of a model as `kernels` read them; arguments as of `Model`."""
    wide, most, big_g = b.shape[1], route.shape[1], len(mass_below)
    # h^2 A_rk a_kl of `kernels.eliminate`, A_rk = b_k - a_rk and A_0k = b_k, as [module, r, l, k].
    rows = b[:, np.newaxis] - np.concatenate([np.zeros_like(b)[:, np.newaxis], a], axis=1)
    coupling = np.einsum("m,mrk,mkl->mrlk", (length / elements) ** 2, rows, a)
    tables = (np.array([tolerance]), length, a, b, coupling, stiffness, reference, route, mass_below, parameters, rest_length)
    sizes = (len(elements), len(kind), big_g, int(elements.sum()), wide, most)
    integers = (elements, nodes, first_muscle, kind)
    numbers = np.concatenate([np.ravel(table) for table in tables])
    in_f = np.cumsum([0, *(table.size for table in tables[:-1])])
    in_w = np.cumsum([0, *kernels.layout(*sizes)])
    in_i = kernels.END + 1 + np.cumsum([0, *(table.size for table in integers[:-1])])
    return numbers, np.concatenate([sizes, in_i, in_f, in_w, *integers]).astype(np.int64)


class Heat(NamedTuple):
    """How drives come about that are temperatures of heated TCAs: by one step of `thermal.step`."""

    action: Array  # (N, m) heating powers asked for, -1 (none) to 1 (full)
    temperature: Array  # (N, m) at the start of the step [degC]
    power: Array  # (N, m) out: heating powers [W]
    constants: Array  # (6, m) share of heat kept in a step, share lost, loss [W/K], full power [W], ambient and limit [degC]


NO_HEAT = Heat(*np.empty((4, 0, 0)))


_forked: list[bool] = []
"""Not empty in a forked process: threads do not survive a fork, and OpenMP would wait for its own for ever."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: _forked.append(True))


class _Scratch(threading.local):
    """Packs for the kernels to work on; each thread of Python has its own."""

    def __init__(self) -> None:
        self.packs = np.empty((0, PACK))

    def of(self, model: Model, copies: int = 1) -> Array:
        """Return so many times the packs that a model needs (copies, k, PACK), aligned."""
        count = -(-int(model.i[kernels.END]) * PACK * 8 // ALIGNMENT) * ALIGNMENT // (8 * PACK)
        if len(self.packs) < copies * count:
            raw = np.zeros(copies * count * PACK + ALIGNMENT // 8)
            first = -(raw.ctypes.data // 8) % (ALIGNMENT // 8)
            self.packs = raw[first : first + copies * count * PACK].reshape(-1, PACK)
        return self.packs[: copies * count].reshape(copies, count, PACK)


_scratch = _Scratch()


def solve_lanes(
    model, strain, tension, from_drive, from_load, drive, load, tip, lengths, report, first=1.0, threads=1, heat=None
):
    """Follow the branches of N arms of one model, each from its own known equilibrium.

    Parameters
    ----------
    model : Model
        The arm.
    strain, tension : (N, G, 6), (N, n) arrays
        In: known equilibria. Out: the asked ones; where there was none, the last ones on the way.
    from_drive, from_load : (N, n), (N, LOAD) arrays
        In: where (strain, tension) are in equilibrium. Out: where they are now: as asked, or as far as the branch went.
    drive, load : (N, n or more), (N, LOAD) arrays
        What is asked; a lane's first n drives are the arm's.
    tip : (N, 4, 4) array
        Out: tip poses [m], but for the last row, which stays; unchanged where there was no answer.
    lengths : (N, n) array
        Out: path lengths [m]; unchanged where there was no answer.
    report : (N, REPORT) array
        Out: rung (WARM, SUBSTEPS or FAILED), dimensionless residual, Newton iterations, jumped (0; of a lane that FAILED, the
        substep to go on with), by how much Newton's steps shrank at worst (0 where
        the first was not LONG). A lane that FAILED is at the end of
        its branch (the substep is below SMALLEST_SUBSTEP) or has done `budget` iterations.
    first : float
        Substep to begin with, as a share of the way: 1 but for a lane that goes on.
    threads : int
        How many share the work; no number depends on it.
    heat : Heat, optional
        How `drive` comes about; it is overwritten then. Lanes must be at equilibria found before.
    """
    arrays = (strain, tension, from_drive, from_load, drive, load, tip, lengths, report, *(NO_HEAT if heat is None else heat))
    steps = budget(model) if model.ladder else 0
    if threads > 1 and len(strain) >= WORTH_SHARING and not _forked:
        before = get_num_threads()
        set_num_threads(threads)
        _solve_in_parallel(model.f, model.i, addresses().copy(), _scratch.of(model, threads), steps, first, *arrays)
        set_num_threads(before)
    else:
        _solve_serially(model.f, model.i, addresses().copy(), _scratch.of(model)[0], steps, first, *arrays)


def budget(model):
    """Return the Newton iterations after which `solve_lanes` gives a lane up, so that someone can look at the clock."""
    return max(MAX_ITERATIONS, WORK // (len(model.mass_below) * max(1, model.route.shape[1] // 4)))


@cache
def addresses() -> NDArray[np.int64]:
    """Return what kernels find in `a`, but for what is a lane's; compiles them, or loads them from the cache."""
    compiled = [cfunc(KERNEL, **CALLED)(kernel) for kernel in kernels.COMPILED]
    _KEPT.extend(compiled)
    job = np.zeros(JOB, dtype=np.int64)
    job[: len(compiled)] = np.array([kernel.address for kernel in compiled])
    return job


@cache
def compile_kernels():
    """Compile everything or load it from the cache, so that this is no part of the time of a solve."""
    collects = gc.isenabled()
    gc.disable()  # it would take a tenth of the time
    try:
        _compile_kernels()
    finally:
        if collects:
            gc.enable()


def _compile_kernels():
    one, none = np.ones(1, dtype=np.int64), np.zeros(0, dtype=np.int64)
    straight, load = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros((1, LOAD))
    fields = (
        one, one, np.ones(1), np.full((1, 1, 1), 0.5), np.ones((1, 1)), np.ones((1, 6)), straight, np.zeros(2, dtype=np.int64),
        np.zeros((1, 0, 4)), np.zeros(1), none, np.zeros((0, PARAMETERS)), np.zeros(0), 1e-6,
    )  # fmt: skip
    model = Model(*fields, True, *flat(*fields))
    drives = [np.zeros((1, 0)) for _ in range(4)]
    linearise(model, straight, drives[0][0], drives[1][0], load[0], 0.0, False, SHAPE, straight)
    known = (straight[np.newaxis].copy(), drives[0], drives[1], load.copy())
    solve_lanes(model, *known, drives[2], load, np.eye(4)[np.newaxis].copy(), drives[3], np.zeros((1, REPORT)))


_KEPT: list = []
"""Compiled kernels: their code lives as long as they do."""


@merged
def _fill(
    job, budget, strain, tension, from_drive, from_load, drive, load, tip, lengths, report, action, temperature, power,
    constants,
):  # fmt: skip
    """Complete what kernels find in `a`."""
    a = pointer_to_ints(job)
    a[AT_STRAIN], a[AT_TENSION] = address_of(strain), address_of(tension)
    a[AT_FROM_DRIVE], a[AT_FROM_LOAD], a[AT_DRIVE] = address_of(from_drive), address_of(from_load), address_of(drive)
    a[AT_LOAD], a[AT_TIP], a[AT_LENGTHS] = address_of(load), address_of(tip), address_of(lengths)
    a[AT_REPORT], a[AT_ACTION] = address_of(report), address_of(action) if len(action) else 0
    a[AT_TEMPERATURE], a[AT_POWER], a[AT_HEATING] = address_of(temperature), address_of(power), address_of(constants)
    a[COUNT], a[BUDGET], a[HEATED] = len(strain), budget, drive.shape[1]


@merged
def _solve_pack(f, i, job, w, n, first):
    """Do pack `n` of the lanes."""
    ff, ii, a, ww = pointer_to_floats(f), pointer_to_ints(i), pointer_to_ints(job), pointer_to_packs(w)
    if a[AT_ACTION] != 0:
        call_kernel(a[HEAT], ff, ii, a, ww, n, 0.0)
    call_kernel(a[LANES], ff, ii, a, ww, n, first)


@entry
def _solve_serially(
    f, i, job, w, budget, first, strain, tension, from_drive, from_load, drive, load, tip, lengths, report, action,
    temperature, power, constants,
):  # fmt: skip
    _fill(
        job, budget, strain, tension, from_drive, from_load, drive, load, tip, lengths, report,
        action, temperature, power, constants,
    )  # fmt: skip
    for n in range((len(strain) + PACK - 1) // PACK):
        _solve_pack(f, i, job, w, n, first)


@parallel
def _solve_in_parallel(
    f, i, job, w, budget, first, strain, tension, from_drive, from_load, drive, load, tip, lengths, report, action,
    temperature, power, constants,
):  # fmt: skip
    _fill(
        job, budget, strain, tension, from_drive, from_load, drive, load, tip, lengths, report,
        action, temperature, power, constants,
    )  # fmt: skip
    for n in prange((len(strain) + PACK - 1) // PACK):
        _solve_pack(f, i, job, w[get_thread_id()], n, first)


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
    w = _scratch.of(model)[0]
    i, (big_g, n) = model.i, (len(strain), tension.size)

    def view(place, count):
        return w[i[place] : i[place] + count]

    view(kernels.STRAIN, 6 * big_g)[:] = strain.reshape(-1, 1)
    view(kernels.TENSION, n)[:] = tension[:, np.newaxis]
    view(kernels.DRIVE, n)[:] = drive[:, np.newaxis]
    view(kernels.LOADS, LOAD)[:] = load[:, np.newaxis]
    numbers, tips = np.zeros(8), np.zeros((6, n if ask == JACOBIAN else (1 if ask >= STEP else 0)))
    _linearise(model.f, i, addresses(), w, tension, load, damping, slaved, ask, given, numbers, tips)
    taken = (
        (kernels.ENDS, (-1, 4), 4 * (int(i[kernels.ELEMENTS]) + 1)), (kernels.QUATERNION, (-1, 4), 4 * big_g),
        (kernels.POSITION, (-1, 3), 3 * (int(i[kernels.ELEMENTS]) + 1)), (kernels.TANGENT, (-1, 3), 3 * big_g),
        (kernels.SPIN, (-1, 3), 3 * big_g), (kernels.PATHS, (n,), n),
        (kernels.BEND, (-1, 3), 3 * big_g), (kernels.SHEAR, (-1, 3), 3 * big_g),
    )  # fmt: skip
    return numbers, *(view(place, count)[:, 0].copy().reshape(shape) for place, shape, count in taken), tips


@entry
def _linearise(f, i, a, w, tension, load, damping, slaved, ask, given, numbers, tips):
    """`linearise` of the state in all places of `w`; fills `tension`, `numbers` and `tips`."""
    _evaluated(
        pointer_to_floats(f), pointer_to_ints(i), pointer_to_ints(a), pointer_to_packs(w), pointer_to_floats(tension),
        pointer_to_floats(load), damping, slaved, ask, pointer_to_floats(given), pointer_to_floats(numbers),
        pointer_to_floats(tips), tips.shape[1],
    )  # fmt: skip


@written
def _evaluated(f, i, a, w, tension, load, damping, slaved, ask, given, out, tip, columns):
    """Do what `_linearise` does, given pointers."""
    y = floats_of(w)
    nodes, muscles, kinds, rests, law_at = i[NODES], i[MUSCLES], i[KIND], i[REST], i[LAW]
    paths, drives, gap, residual = i[PATHS], i[DRIVE], i[GAP], i[RESIDUAL]
    w[i[ACTIVE]] = spread(1.0)
    for again in range(2 if slaved else 1):
        call_kernel(a[EVALUATE], f, i, a, w, again, 0.0)
        out[0], out[1] = y[i[WORST] * PACK], y[i[TOTAL] * PACK]
        for m in range(muscles):
            kind, drive = i[kinds + m], y[(drives + m) * PACK]
            if kind == TENDON:
                tension[m] = drive
            elif slaved & (again == 0) & (out[0] < np.inf):
                tension[m] = pull(kind, f, law_at + PARAMETERS * m, f[rests + m], y[(paths + m) * PACK], drive, tension[m])
                w[i[TENSION] + m] = spread(tension[m])
    out[3] = 1.0  # what is no configuration is not stable
    if not out[0] < np.inf:
        return
    out[3] = 0.0
    if ask != SHAPE:
        call_kernel(a[ELIMINATE], f, i, a, w, 0, damping)
        out[3] = y[i[INDEX] * PACK]
    if ask >= GIVEN:
        for m in range(muscles):
            w[gap + m] = spread(0.0)
        for d in range(6 * nodes):
            w[residual + d] = spread(given[d] if ask == GIVEN else 0.0)
    for m in range(columns):
        if ask == JACOBIAN:
            wanted = 1.0  # a tendon's row reads -dF = -gap
            if i[kinds + m] != TENDON:
                _, _, slope = law(i[kinds + m], f, law_at + PARAMETERS * m, f[rests + m], tension[m], y[(drives + m) * PACK])
                wanted = -slope
            w[gap + m] = spread(wanted)
        call_kernel(a[SUBSTITUTE], f, i, a, w, 0, 0.0)
        out[4], out[5] = y[i[ROTATED] * PACK], y[i[SHEARED] * PACK]
        for d in range(6):
            tip[d * columns + m] = y[(i[TIP] + d) * PACK]
        if ask == JACOBIAN:
            w[gap + m] = spread(0.0)
    # Energies: rod and muscles store them, loads lose them.
    total = work = extent = 0.0
    g = 0
    for k in range(i[MODULES]):
        q = i[i[NODES_OF] + k]
        h = f[i[LENGTH] + k] / i[i[PIECES] + k]
        for node in range(i[i[PIECES] + k] * q):
            weight = h * f[i[B] + k * i[WIDE] + node % q]
            total += weight * _density(f, y, i[STIFFNESS] + 6 * k, i[REFERENCE] + 6 * k, i[STRAIN] + 6 * g, i[FORCE] + 3 * g)
            if columns > 0:
                done, size = _step(f, y, i[STIFFNESS] + 6 * k, residual + 6 * g, i[BEND] + 3 * g, i[SHEAR] + 3 * g)
                work += weight * done
                extent += weight * size
            g += 1
    for m in range(muscles):
        kind, path = i[kinds + m], y[(paths + m) * PACK]
        total += stored(kind, f, law_at + PARAMETERS * m, f[rests + m], tension[m], path)
    out[2] = total - _lifted(y, i[ENDS] + 4 * i[ELEMENTS], load)
    out[6], out[7] = work, extent


@traced
def _three(y, place):
    """Return three numbers of the first arm of the packs."""
    return y[PACK * place], y[PACK * (place + 1)], y[PACK * (place + 2)]


@traced
def _weighted(f, at, x):
    """Return x . K x of half a strain, with its stiffness from place `at` on."""
    return f[at] * x[0] * x[0] + f[at + 1] * x[1] * x[1] + f[at + 2] * x[2] * x[2]


@traced
def _density(f, y, stiffness, reference, strain, force):
    """Return a section's energy per metre [N].

    int n . p' ds is the work of the tip force and of all weights but the lever of the payload's. A tip moment has no potential.
    """
    v = _three(y, strain + 3)
    du, dv = axpy(-1.0, get3(f, reference), _three(y, strain)), axpy(-1.0, get3(f, reference + 3), v)
    return 0.5 * (_weighted(f, stiffness, du) + _weighted(f, stiffness + 3, dv)) - dot(_three(y, force), v)


@traced
def _step(f, y, stiffness, residual, bend, shear):
    """Return g . dx and dx . K dx of a step per metre [N]."""
    du, dv = _three(y, bend), _three(y, shear)
    work = dot(_three(y, residual), du) + dot(_three(y, residual + 3), dv)
    return work, _weighted(f, stiffness, du) + _weighted(f, stiffness + 3, dv)


@traced
def _lifted(y, end, load):
    """Return the work that the payload's weight does on its lever [J]."""
    x, z = _three(y, end), _three(y, end + 1)
    lever = apply(rotation_matrix((x[0], x[1], x[2], z[2])), get3(load, PAYLOAD_MASS + 1))
    return load[PAYLOAD_MASS] * dot(lever, get3(load, 6))
