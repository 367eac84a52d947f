"""Vectors and 3 x 3 matrices as tuples, for compiled kernels: they live in registers and allocate nothing.

Numba's cache watches the file of a kernel, not those of the functions that it calls: after a change here, in `traced` or in
`muscle`, delete the package's `__pycache__` folders.

A matrix is its nine numbers, row by row. A quaternion is (w, x, y, z).
"""

from typing import Any

from numba import njit

from tca_envs.mechanics.traced import traced

# Not nnan or ninf: overflow must stay visible.
OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    "nogil": True,
    "no_cfunc_wrapper": True,
}
INNER: dict[str, Any] = {"no_cpython_wrapper": True, **OPTIONS}
ORIGIN = (0.0, 0.0, 0.0)
CALLED: dict[str, Any] = {name: OPTIONS[name] for name in ("cache", "error_model", "fastmath")}
"""Options of kernels that are called by address."""
entry = njit(**OPTIONS)
"""Decorator of kernels that Python calls."""
parallel = njit(parallel=True, **OPTIONS)
"""Decorator of kernels that Python calls and that share their work among threads."""
inner = njit(**INNER)
"""Decorator of kernels that only kernels call: without wrappers they compile faster."""
merged = njit(inline="always", **INNER)
"""Decorator of kernels that one kernel calls: they become part of it before anything is compiled."""
_small = njit(forceinline=True, **INNER)


@_small
def get3(array, i, j):
    """Return array[i, j:j+3]."""
    return array[i, j], array[i, j + 1], array[i, j + 2]


@_small
def put3(array, i, j, x):
    """Set array[i, j:j+3]."""
    array[i, j], array[i, j + 1], array[i, j + 2] = x


@_small
def get4(array, i):
    """Return array[i, :4]."""
    return array[i, 0], array[i, 1], array[i, 2], array[i, 3]


@_small
def put4(array, i, x):
    """Set array[i, :4]."""
    array[i, 0], array[i, 1], array[i, 2], array[i, 3] = x


@_small
def get9(array, i):
    """Return array[i, :9]."""
    return (
        array[i, 0], array[i, 1], array[i, 2], array[i, 3], array[i, 4],
        array[i, 5], array[i, 6], array[i, 7], array[i, 8],
    )  # fmt: skip


@_small
def put9(array, i, x):
    """Set array[i, :9]."""
    (
        array[i, 0], array[i, 1], array[i, 2], array[i, 3], array[i, 4],
        array[i, 5], array[i, 6], array[i, 7], array[i, 8],
    ) = x  # fmt: skip


@traced
def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@traced
def axpy(c, a, b):
    """Return c a + b for vectors."""
    return c * a[0] + b[0], c * a[1] + b[1], c * a[2] + b[2]


@traced
def cross(a, b):
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@traced
def cross_matrix(a):
    """Return [a] with [a] b = a x b."""
    return 0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0


@traced
def outer(a, b):
    """Return a b^T."""
    return (
        a[0] * b[0], a[0] * b[1], a[0] * b[2],
        a[1] * b[0], a[1] * b[1], a[1] * b[2],
        a[2] * b[0], a[2] * b[1], a[2] * b[2],
    )  # fmt: skip


@traced
def scalar_matrix(c):
    """Return c times the unit matrix."""
    return c, 0.0, 0.0, 0.0, c, 0.0, 0.0, 0.0, c


@traced
def axpy9(c, a, b):
    """Return c a + b for matrices."""
    return (
        c * a[0] + b[0], c * a[1] + b[1], c * a[2] + b[2],
        c * a[3] + b[3], c * a[4] + b[4], c * a[5] + b[5],
        c * a[6] + b[6], c * a[7] + b[7], c * a[8] + b[8],
    )  # fmt: skip


@traced
def apply(a, x):
    """Return a x."""
    return (
        a[0] * x[0] + a[1] * x[1] + a[2] * x[2],
        a[3] * x[0] + a[4] * x[1] + a[5] * x[2],
        a[6] * x[0] + a[7] * x[1] + a[8] * x[2],
    )


@traced
def apply_transposed(a, x):
    """Return a^T x."""
    return (
        a[0] * x[0] + a[3] * x[1] + a[6] * x[2],
        a[1] * x[0] + a[4] * x[1] + a[7] * x[2],
        a[2] * x[0] + a[5] * x[1] + a[8] * x[2],
    )


@traced
def transpose(a):
    """Return a^T."""
    return a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]


@traced
def matmul(a, b):
    """Return a b."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@traced
def inverse(a):
    """Return the inverse of a, by cofactors."""
    c0 = a[4] * a[8] - a[5] * a[7]
    c3 = a[5] * a[6] - a[3] * a[8]
    c6 = a[3] * a[7] - a[4] * a[6]
    d = 1.0 / (a[0] * c0 + a[1] * c3 + a[2] * c6)
    return (
        d * c0, d * (a[2] * a[7] - a[1] * a[8]), d * (a[1] * a[5] - a[2] * a[4]),
        d * c3, d * (a[0] * a[8] - a[2] * a[6]), d * (a[2] * a[3] - a[0] * a[5]),
        d * c6, d * (a[1] * a[6] - a[0] * a[7]), d * (a[0] * a[4] - a[1] * a[3]),
    )  # fmt: skip


@traced
def quaternion_rate(q, x):
    """Return q o [0, x]."""
    return (
        -q[1] * x[0] - q[2] * x[1] - q[3] * x[2],
        q[0] * x[0] + q[2] * x[2] - q[3] * x[1],
        q[0] * x[1] - q[1] * x[2] + q[3] * x[0],
        q[0] * x[2] + q[1] * x[1] - q[2] * x[0],
    )


@traced
def quaternion_turn(x, q):
    """Return [1, x] o q: q turned by about 2 x in the global frame."""
    return (
        q[0] - x[0] * q[1] - x[1] * q[2] - x[2] * q[3],
        q[1] + q[0] * x[0] + x[1] * q[3] - x[2] * q[2],
        q[2] + q[0] * x[1] + x[2] * q[1] - x[0] * q[3],
        q[3] + q[0] * x[2] + x[0] * q[2] - x[1] * q[1],
    )


@traced
def rotation_matrix(q):
    """Return the rotation matrix of a quaternion of any norm."""
    s = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    wx, wy, wz = s * q[0] * q[1], s * q[0] * q[2], s * q[0] * q[3]
    xx, xy, xz = s * q[1] * q[1], s * q[1] * q[2], s * q[1] * q[3]
    yy, yz, zz = s * q[2] * q[2], s * q[2] * q[3], s * q[3] * q[3]
    return 1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy
