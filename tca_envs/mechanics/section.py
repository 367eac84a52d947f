"""Strain of a cross section from the wrench that it carries: six algebraic equations."""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EYE = np.eye(3)


def cross_matrix(x: Array) -> Array:
    """Return [x] with [x] y = x cross y, for x (3,)."""
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def balance(
    stiffness: Array, reference: Array, route: Array, tension: Array, strain: Array, wrench: Array
) -> tuple[Array, Array]:
    """Imbalance K (xi - xi*) + sum F [r x t; t] - W of a section and its derivative in the strain.

    Parameters
    ----------
    stiffness, reference : (6,) arrays
        Diagonal of K and xi* = [u*; v*].
    route : (m, 4) array
        Position x, y of each muscle [m] and its derivative in s.
    tension : (m,) array
        Tensions [N].
    strain, wrench : (6,) arrays
        xi and the total internal wrench W = [m; n], body frame.

    Returns
    -------
    tuple of array
        Imbalance (6,) and H (6, 6), symmetric, positive definite for tensions >= 0.
    """
    imbalance = stiffness * (strain - reference) - wrench
    tangent = np.diag(stiffness)
    u_x, u_y, u_z, v_x, v_y, v_z = strain.tolist()
    for (x, y, dx, dy), force in zip(route.tolist(), tension.tolist(), strict=True):
        # p' = v + u x r + r', r = (x, y, 0)
        path = np.array([v_x - u_z * y + dx, v_y + u_z * x + dy, v_z + u_x * y - u_y * x])
        norm = sqrt(path @ path)
        t = path / norm
        b = np.array([[0.0, 0.0, -y, 1.0, 0.0, 0.0], [0.0, 0.0, x, 0.0, 1.0, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]])
        imbalance += force * (b.T @ t)
        tangent += force / norm * b.T @ (EYE - np.outer(t, t)) @ b
    return imbalance, tangent


def solve(stiffness: Array, reference: Array, route: Array, tension: Array, wrench: Array, strain: Array) -> Array:
    """Return the strain (6,) that carries `wrench`, by Newton from `strain`; arguments as in `balance`."""
    for _ in range(50):
        imbalance, tangent = balance(stiffness, reference, route, tension, strain, wrench)
        step = np.linalg.solve(tangent, imbalance)
        strain = strain - step
        if np.abs(step).max() <= 1e-12 * (1.0 + np.abs(strain).max()):
            break
    return strain
