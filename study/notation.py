"""What the compiled baselines share: an arm as plain arrays, and the balance of a section, in the notation of `mechanics`.

A rod and its muscles carry the wrench [m; n] = K (xi - xi*) + sum_i F_i [r_i x t_i; t_i] (body frame), with xi = [u; v] and
t_i = p_i'/|p_i'|, p_i' = v + u x r_i + r_i'. Its derivative in the strain is, with B = [-[r], 1] and c = [r x t; t],
H = K + sum_i F_i/|p_i'| (B^T B - c c^T): symmetric, and positive definite for F >= 0.
"""

from collections.abc import Sequence
from functools import partial
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from tca_envs.mechanics import Arm, Module, compiled, loads
from tca_envs.mechanics.laws import TENDON as TENDON
from tca_envs.mechanics.laws import elongation
from tca_envs.mechanics.solver.simd import Mat, Quat, Vec, cross, diagonal, dot, inverse, outer, times, transpose

# Counting references to arrays would take as long as the balance of a section: these functions own none.
kernel = partial(compiled, _nrt=False)  # decorator of kernels that make no arrays
inline = partial(compiled, _nrt=False, forceinline=True)  # decorator of those that become part of their callers

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_SETTLE = 60  # Newton iterations of a section; two or three are usual
SHRUNK = 1e-9  # a muscle whose path is shorter, per length of the rod, has become a point
FORCE, MOMENT, GRAVITY, CENTRE = (part.start for part in (loads.FORCE, loads.MOMENT, loads.GRAVITY, loads.CENTRE))
MASS = loads.MASS  # where a load's parts begin


def routes(module: Module, fraction: Array, most: int = 0) -> Array:
    """Return x, y [m] of a module's muscles and their derivatives in s at fractions (k,) of its length: (k, m, 4).

    They are filled up with zeros to `most` muscles.
    """
    result = np.zeros((len(fraction), max(most, len(module.muscles)), 4))
    for i, muscle in enumerate(module.muscles):
        result[:, i] = muscle.route(module.length, fraction)
    return result


def stations(arm: Arm, fractions: Sequence[Array]) -> tuple[Array, Array]:
    """Return routes (T, m, 4) at fractions of each module, and the arm's mass beyond each of these places (T,) [kg]."""
    most = max(len(module.muscles) for module in arm.modules)
    mass, beyond = masses(arm)
    where = [routes(module, x, most) for module, x in zip(arm.modules, fractions, strict=True)]
    return np.concatenate(where), np.concatenate([b + m * (1.0 - x) for b, m, x in zip(beyond, mass, fractions, strict=True)])


def masses(arm: Arm) -> tuple[Array, Array]:
    """Return the modules' masses (M,) and the mass of the modules beyond each (M,) [kg]."""
    mass = np.array([module.mass_per_length * module.length for module in arm.modules])
    return mass, mass.sum() - np.cumsum(mass)


def most_turns(muscles: Sequence) -> float:
    """Return how often the most helical one of some muscles turns, 0 if none does."""
    return max((abs(muscle.turns) for muscle in muscles), default=0.0)


def moment_unit(arm: Arm) -> float:
    """Return the moment that bends the arm by about a radian, EI/L of its softest module [N m]."""
    return min(float(module.stiffness[:3].min()) for module in arm.modules) / arm.length


# Arrays


@inline
def vec(a, i, j):
    """Return a[i, j:j+3] of an array as a vector."""
    return Vec(a[i, j], a[i, j + 1], a[i, j + 2])


@inline
def put(a, i, j, x):
    """Set a[i, j:j+3] to a vector."""
    a[i, j], a[i, j + 1], a[i, j + 2] = x.x, x.y, x.z


@inline
def vec1(a, j):
    """Return a[j:j+3] of an array as a vector."""
    return Vec(a[j], a[j + 1], a[j + 2])


@inline
def put1(a, j, x):
    """Set a[j:j+3] to a vector."""
    a[j], a[j + 1], a[j + 2] = x.x, x.y, x.z


@inline
def quat1(a, j):
    """Return a[j:j+4] of an array as a quaternion."""
    return Quat(a[j], a[j + 1], a[j + 2], a[j + 3])


@inline
def quat(a, i, j):
    """Return a[i, j:j+4] of an array as a quaternion."""
    return Quat(a[i, j], a[i, j + 1], a[i, j + 2], a[i, j + 3])


@inline
def put_quat(a, i, j, q):
    """Set a[i, j:j+4] to a quaternion."""
    a[i, j], a[i, j + 1], a[i, j + 2], a[i, j + 3] = q.w, q.x, q.y, q.z


@inline
def mat(a, i):
    """Return a[i, :9] of an array as a matrix."""
    return Mat(a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5], a[i, 6], a[i, 7], a[i, 8])


@inline
def put_mat(a, i, m):
    """Set a[i, :9] to a matrix."""
    a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4] = m.xx, m.xy, m.xz, m.yx, m.yy
    a[i, 5], a[i, 6], a[i, 7], a[i, 8] = m.yz, m.zx, m.zy, m.zz


@inline
def copy6(target, source):
    """Copy a strain (6,)."""
    for l in range(6):
        target[l] = source[l]


@inline
def put_block(a, i, j, m):
    """Set a[i:i+3, j:j+3] to a matrix."""
    a[i, j], a[i, j + 1], a[i, j + 2] = m.xx, m.xy, m.xz
    a[i + 1, j], a[i + 1, j + 1], a[i + 1, j + 2] = m.yx, m.yy, m.yz
    a[i + 2, j], a[i + 2, j + 1], a[i + 2, j + 2] = m.zx, m.zy, m.zz


@inline
def put_pose(pose, turn, place):
    """Set the first three rows of a pose (4, 4) to a rotation matrix and a place."""
    put_block(pose, 0, 0, turn)
    pose[0, 3], pose[1, 3], pose[2, 3] = place.x, place.y, place.z


@inline
def inner(a, b):
    """Return the inner product of two rows of an array."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


# Muscles


@inline
def muscle(route, at, c, u, v):
    """Return r x t, t and |p'| of muscle c at a station of some routes (T, m, 4) where the strain is [u; v]."""
    x, y = route[at, c, 0], route[at, c, 1]
    path = v + Vec(route[at, c, 2] - u.z * y, route[at, c, 3] + u.z * x, u.x * y - u.y * x)
    norm = sqrt(dot(path, path))
    t = 1.0 / norm * path
    return Vec(y * t.z, -x * t.z, x * t.y - y * t.x), t, norm


@inline
def stiffening(x, y, g, lever, t):
    """Return the blocks uu, uv, vv of g (B^T B - c c^T) of a muscle at (x, y) with c = [lever; t]."""
    a = g * lever
    uu = Mat(g * y * y, -g * x * y, 0.0, -g * x * y, g * x * x, 0.0, 0.0, 0.0, g * (x * x + y * y)) - outer(a, lever)
    uv = Mat(0.0, 0.0, g * y, 0.0, 0.0, -g * x, -g * y, g * x, 0.0) - outer(a, t)
    return uu, uv, diagonal(g, g, g) - outer(g * t, t)


@inline
def mismatch(arm, i, length, tension, drive):
    """Return how far a muscle, no tendon, is longer than its law says, over l*, and the derivative of that in its tension."""
    rest = arm.rest_length[i]
    delta, softness, _ = elongation(arm.kind[i], arm.parameters, i, rest, tension, drive)
    return (length - rest - delta) / rest, -softness / rest


@compiled
def mismatch_of(arm, i, length, tension, drive):
    """Return `mismatch`, to Python."""
    return mismatch(arm, i, length, tension, drive)


# Sections


@inline
def settle(arm, k, route, station, tension, moment, force, strain, settled, longest, stretch, pull):
    """Find the strain (6,) that carries a wrench, moment and force in the body frame, by Newton from `strain`, in place.

    One more step, which squares it, ends the solve where |moment imbalance| L/K and |force imbalance|/K are below `settled`; no
    step changes the strain, times L for curvatures, by more than `longest`. `stretch` (m,) and `pull` (m, 6) become |p_i'| and
    c of the muscles of module k, whose routes are at a station of `route` (T, m, 4).

    Returns whether Newton got there, and the factors of H that `carried` solves with: H_vv^-1, H_uv H_vv^-1 and (H_uu - H_uv
    H_vv^-1 H_vu)^-1.
    """
    first, muscles, length = arm.first_muscle[k], arm.first_muscle[k + 1] - arm.first_muscle[k], arm.length[k]
    u, v, ku, kv = vec1(strain, 0), vec1(strain, 3), vec(arm.stiffness, k, 0), vec(arm.stiffness, k, 3)
    u0, v0 = vec(arm.reference, k, 0), vec(arm.reference, k, 3)
    flexibility = gain = softness = diagonal(0.0, 0.0, 0.0)
    for _ in range(MAX_SETTLE):
        ru, rv = times(ku, u - u0) - moment, times(kv, v - v0) - force
        uu, uv, vv = diagonal(ku.x, ku.y, ku.z), diagonal(0.0, 0.0, 0.0), diagonal(kv.x, kv.y, kv.z)
        for c in range(muscles):
            lever, t, norm = muscle(route, station, c, u, v)
            if not norm > SHRUNK:
                return False, flexibility, gain, softness
            f = tension[first + c]
            ru, rv = ru + f * lever, rv + f * t
            duu, duv, dvv = stiffening(route[station, c, 0], route[station, c, 1], f / norm, lever, t)
            uu, uv, vv = uu + duu, uv + duv, vv + dvv
        bent = max(abs(ru.x / ku.x), abs(ru.y / ku.y), abs(ru.z / ku.z))
        sheared = max(abs(rv.x / kv.x), abs(rv.y / kv.y), abs(rv.z / kv.z))
        worst = max(length * bent, sheared)
        if not worst < 1e6:
            return False, flexibility, gain, softness
        flexibility = inverse(vv)
        gain = uv @ flexibility
        softness = inverse(uu - gain @ transpose(uv))
        bend, shear = carried(flexibility, gain, softness, ru, rv)
        if longest < inf:
            change = max(length * max(abs(bend.x), abs(bend.y), abs(bend.z)), abs(shear.x), abs(shear.y), abs(shear.z))
            part = min(1.0, longest / max(change, 1e-300))
            bend, shear = part * bend, part * shear
        u, v = u - bend, v - shear
        if worst < settled:
            put1(strain, 0, u)
            put1(strain, 3, v)
            # The last step squares the imbalance: it is not looked at again.
            for c in range(muscles):
                lever, t, stretch[c] = muscle(route, station, c, u, v)
                put(pull, c, 0, lever)
                put(pull, c, 3, t)
            return True, flexibility, gain, softness
    return False, flexibility, gain, softness


@inline
def carried(flexibility, gain, softness, moment, force):
    """Return the change of bend and shear (u, v) that goes with a change of the wrench, from the factors of `settle`."""
    bend = softness @ (moment - gain @ force)
    return bend, flexibility @ force - transpose(gain) @ bend


# Loads


@inline
def carries(load, mass):
    """Return the force [N] that a section carries with a mass of the arm [kg] beyond it."""
    return vec1(load, FORCE) + (load[MASS] + mass) * vec1(load, GRAVITY)


@inline
def tip_moment(load, turn):
    """Return the moment at the tip from the external load, base frame [N m]; `turn` is the tip's rotation matrix."""
    return cross(turn @ vec1(load, CENTRE), load[MASS] * vec1(load, GRAVITY)) + vec1(load, MOMENT)


@inline
def tip_moment_turned(load, turn, phi):
    """Return the change of `tip_moment` as the tip turns by phi."""
    return cross(cross(phi, turn @ vec1(load, CENTRE)), load[MASS] * vec1(load, GRAVITY))


@compiled
def between(known, asked, share):
    """Return what lies at a share of the way from known to asked numbers; at 1 those asked themselves, not a rounded sum."""
    return asked.copy() if share == 1.0 else known + share * (asked - known)
