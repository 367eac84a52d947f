"""Equilibria to round-off, to measure errors against: multiple shooting on the wrench form of the rod.

Each module is cut into segments; unknown are the rotation and the moment where each segment starts (at the base the moment
alone) and the muscles' tensions. A segment is integrated by Runge-Kutta steps of order 8, so errors do not grow along the arm
as they do in single shooting. Newton starts from a known equilibrium and stays on its branch; steps are doubled until the tip
no longer moves. It shares arm and muscle laws with `Arm.equilibrium` and no numerics.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from study.method import State
from study.notation import TENDON, Array, Integers, mismatch_of, moment_unit, most_turns
from study.shooting import tension_units, wrench
from study.wrench import RK8, STATE, Rod, march, rod, scratch
from tca_envs.mechanics import Arm, Equilibrium, Module, compiled, loads
from tca_envs.mechanics.arm import pose
from tca_envs.mechanics.solver import Model

SEGMENT = 15e-3  # longest segment [m]
STEP = 2.5e-3  # longest step of the coarsest integration [m] in a module without helical muscles
STEPS_PER_TURN = 10  # fewest steps of the coarsest integration for each turn of a helical muscle
DOUBLINGS = 4
SETTLED = 1e-8  # imbalance of a section that a last Newton step squares
MAX_ITERATIONS = 12
ROUND_OFF = 1e-12  # largest scaled residual at which Newton may come to a standstill
CLEAN = 2e-14  # scaled residual at which it need not go on
STILL = 1e-11
"""Steps are fine enough where doubling them moves the tip by less than this, over the arm's length. The error that is left
is some 256 times smaller."""
CONTRACTION = 0.1  # Newton takes a new Jacobian where a step shrinks the residual by less


class NoReference(ArithmeticError):
    """Newton or the doubling of steps did not come to round-off."""


class Reference(NamedTuple):
    """An equilibrium to round-off."""

    tip: Array  # pose of the tip (4, 4) [m]
    tensions: Array  # (n,) [N]
    residual: float  # largest scaled mismatch: rotation [rad] and moment where segments meet and at the tip, muscle lengths
    error: float  # estimated error of the tip's position [m]: how far the last doubling of steps moved it
    moved: float  # distance of the tip from that of the known equilibrium [m]


class Segments(NamedTuple):
    """An arm cut into P segments, at one number of steps."""

    arm: Model
    rod: Rod
    module: Integers  # (P,) module of each segment
    station: Integers  # (P,) first station of each segment
    steps: Integers  # (P,) steps of each segment
    unit: float  # of moments [N m]
    tension_unit: Array  # (n,) [N]


@lru_cache(maxsize=16)
def segments(arm: Arm, doubling: int) -> Segments:
    """Return an arm cut into segments, with 2**doubling times the coarsest steps."""

    def coarsest(module: Module) -> float:
        return max(module.length / STEP, STEPS_PER_TURN * most_turns(module.muscles))

    counts = [ceil(module.length / SEGMENT) for module in arm.modules]
    steps = [2**doubling * ceil(coarsest(module) / count) for module, count in zip(arm.modules, counts, strict=True)]
    stations = len(RK8.b) * np.repeat(steps, counts)
    cut = rod(arm, RK8, [count * n for count, n in zip(counts, steps, strict=True)], SETTLED)
    places = np.repeat(np.arange(len(counts)), counts), np.cumsum(stations) - stations, np.repeat(steps, counts)
    return Segments(arm.model, cut, *places, moment_unit(arm), tension_units(arm))


@compiled
def carry(arm, rod, module, station, steps, starts, strains, tension, load, ends, tangents):
    """Integrate every segment; False where a section has no strain that carries its wrench.

    `module`, `station`, `steps` (P,) are those of each segment, `starts` (P, STATE) its first state; `strains` (P, 6) are near
    the strains there and become those. `ends` (P, STATE + m) becomes the last state and the path lengths, and `tangents`, by
    row for a turn [rad] or a moment [N m] at the start or a tension [N] of the module's muscles, how rotation, moment and path
    lengths at the end change: (P, 6 + m, 6 + m), or (P, 0, 6 + m) where that is not asked for.
    """
    columns = tangents.shape[1]
    ws = scratch(rod, columns)
    tangents[:] = 0.0
    for l in range(min(columns, 6)):
        tangents[:, l, l] = 1.0
    for p in range(starts.shape[0]):
        k = module[p]
        driven = 6 - arm.first_muscle[k] + np.arange(tension.size)
        ends[p, :STATE] = starts[p]
        ends[p, STATE:] = 0.0
        if not march(arm, rod, k, station[p], steps[p], tension, load, ends[p], strains[p], columns, driven, tangents[p], ws):
            return False
    return True


@dataclass(eq=False)
class Guess:
    """The unknowns of an arm's P segments; Newton moves them in place."""

    starts: Array  # (P, STATE) where each segment starts: quaternion, position 0, moment [N m]
    strains: Array  # (P, 6) near the strains there
    tension: Array  # (n,) [N]

    def move(self, cut: Segments, step: Array) -> None:
        """Add a step of the scaled unknowns: moment at the base, then rotation and moment of each segment, then tensions."""
        count = len(self.starts)
        each = np.concatenate([np.zeros(3), step[: 6 * count - 3]]).reshape(count, 6)
        turned = Rotation.from_rotvec(each[:, :3]) * Rotation.from_quat(self.starts[:, :4], scalar_first=True)
        self.starts[:, :4] = turned.as_quat(scalar_first=True)
        self.starts[:, 7:10] += cut.unit * each[:, 3:]
        self.tension += cut.tension_unit * step[6 * count - 3 :]


def shoot(cut: Segments, guess: Guess, load: Array, columns: int = 0) -> tuple[Array, Array]:
    """Return the segments' ends and, for so many columns, tangents, as of `carry`; NoReference where there are none."""
    wide = cut.rod.route.shape[1]
    ends, tangents = np.empty((len(cut.module), STATE + wide)), np.empty((len(cut.module), columns, 6 + wide))
    if not carry(*cut[:5], guess.starts, guess.strains, guess.tension, load, ends, tangents):
        raise NoReference("a section has no strain that carries its wrench")
    return ends, tangents


def _hanging(load: Array, end: Array) -> tuple[Array, Array]:
    """Return the lever [m] and the weight [N] of what hangs from the tip, in the base frame."""
    return pose(end[:4], end[4:7])[:3, :3] @ load[loads.CENTRE], load[loads.MASS] * load[loads.GRAVITY]


def mismatch(cut: Segments, guess: Guess, state: State) -> tuple[Array, Array]:
    """Return the scaled residual (6 P - 3 + n,) and the segments' ends (P, STATE + m).

    The residual is rotation [rad] and moment at the end of each segment less those where the next one starts, the moment at
    the tip less that applied, and the muscles' length mismatch over their rest lengths (tendons: tension over its unit).
    """
    arm, load, starts = cut.arm, state.load, guess.starts
    ends, _ = shoot(cut, guess, load)
    before, after = (Rotation.from_quat(q, scalar_first=True) for q in (ends[:-1, :4], starts[1:, :4]))
    joints = np.hstack([(before * after.inv()).as_rotvec(), (ends[:-1, 7:10] - starts[1:, 7:10]) / cut.unit])
    tip = (ends[-1, 7:10] - load[loads.MOMENT] - np.cross(*_hanging(load, ends[-1]))) / cut.unit
    rows = (guess.tension - state.drive) / cut.tension_unit
    for i in np.flatnonzero(arm.kind != TENDON):
        k = np.searchsorted(arm.first_muscle, i, side="right") - 1
        length = ends[cut.module == k, STATE + i - arm.first_muscle[k]].sum()
        rows[i] = mismatch_of(arm, i, length, guess.tension[i], state.drive[i])[0]
    return np.concatenate([joints.ravel(), tip, rows]), ends


def jacobian(cut: Segments, guess: Guess, state: State) -> Array:
    """Return the derivative (N, N) of the residual in the unknowns, N = 6 P - 3 + n."""
    arm, load, count, n = cut.arm, state.load, len(cut.module), len(guess.tension)
    ends, tangents = shoot(cut, guess, load, 6 + cut.rod.route.shape[1])
    blocks = tangents.transpose(0, 2, 1)
    blocks[:, 3:6] /= cut.unit
    blocks[:, :, 3:6] *= cut.unit
    lever, weight = _hanging(load, ends[-1])
    # By the base's rotation as well, and with the tip's among the rows: both are left out below.
    result = np.zeros((6 * count + n, 6 * count + n))
    for p, k in enumerate(cut.module):
        i0, mk = arm.first_muscle[k], arm.first_muscle[k + 1] - arm.first_muscle[k]
        here, muscles = slice(6 * p, 6 * p + 6), slice(6 * count + i0, 6 * count + i0 + mk)
        by_tension = blocks[p, : 6 + mk, 6 : 6 + mk] * cut.tension_unit[i0 : i0 + mk]
        result[here, here], result[here, muscles] = blocks[p, :6, :6], by_tension[:6]
        result[muscles, here] = blocks[p, 6 : 6 + mk, :6]
        result[muscles, muscles] += by_tension[6:]
        if p + 1 < count:
            result[here, 6 * p + 6 : 6 * p + 12] = -np.eye(6)
    turned, bent = result[6 * count - 6 : 6 * count - 3], result[6 * count - 3 : 6 * count]
    bent -= (np.outer(lever, weight) - lever @ weight * np.eye(3)) / cut.unit @ turned
    for i in range(n):
        row = result[6 * count + i]
        if arm.kind[i] == TENDON:
            row[:] = 0.0
            row[6 * count + i] = 1.0
        else:
            row /= arm.rest_length[i]
            row[6 * count + i] += mismatch_of(arm, i, 0.0, guess.tension[i], state.drive[i])[1] * cut.tension_unit[i]
    return np.delete(result, np.s_[6 * count - 6 : 6 * count - 3], axis=0)[:, 3:]


def newton(cut: Segments, guess: Guess, state: State, inverse: Array | None) -> tuple[float, Array, Array | None]:
    """Move `guess` to the equilibrium; return the largest residual, the segments' ends and the inverse Jacobian.

    An old `inverse` serves as long as it helps. Raises NoReference where it does not come to round-off.
    """
    residual, ends = mismatch(cut, guess, state)
    size = float(np.abs(residual).max())
    for _ in range(MAX_ITERATIONS):
        if inverse is None:
            try:
                inverse = np.asarray(np.linalg.inv(jacobian(cut, guess, state)), dtype=np.float64)
            except np.linalg.LinAlgError:
                raise NoReference("Newton met a singular Jacobian") from None
        guess.move(cut, -(inverse @ residual))
        before = size
        residual, ends = mismatch(cut, guess, state)
        size = float(np.abs(residual).max())
        if size < CLEAN or CONTRACTION * before < size < ROUND_OFF:
            return size, ends, inverse
        if not size < CONTRACTION * before:
            inverse = None
    raise NoReference(f"Newton stopped at a residual of {size:.1e}")


def reference(state: State, near: Equilibrium, still: float = STILL) -> Reference:
    """Find the equilibrium at `state` to round-off, on the branch of `near`, an equilibrium there on a fine grid.

    Steps are fine enough where doubling them moves the tip by less than `still`, over the arm's length. Raises NoReference
    where Newton does not come to round-off, or finer steps still move the tip.
    """
    arm = state.arm
    cut = segments(arm, 0)
    length, first = cut.arm.length, cut.arm.first_muscle
    count = np.bincount(cut.module)
    fraction = np.concatenate([np.arange(n) / n for n in count])
    poses, strains = near.sample((np.cumsum(length) - length)[cut.module] + fraction * length[cut.module])
    starts = np.zeros((len(fraction), STATE))
    starts[:, :4] = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    for p, k in enumerate(cut.module):
        carried = wrench(arm.modules[k], fraction[p] * length[k], strains[p], near.tensions[first[k] : first[k + 1]])
        starts[p, 7:10] = poses[p, :3, :3] @ carried[:3]
    guess, inverse, last = Guess(starts, strains, near.tensions.copy()), None, near.tip_pose[:3, 3]
    for doubling in range(DOUBLINGS + 1):
        residual, ends, inverse = newton(segments(arm, doubling), guess, state, inverse)
        tip = pose(ends[-1, :4], ends[:, 4:7].sum(axis=0))
        error, last = float(np.linalg.norm(tip[:3, 3] - last)), tip[:3, 3]
        if doubling > 0 and error < still * arm.length:
            return Reference(tip, guess.tension, residual, error, float(np.linalg.norm(last - near.tip_pose[:3, 3])))
    raise NoReference(f"twice as many steps still move the tip by {error:.1e} m")
