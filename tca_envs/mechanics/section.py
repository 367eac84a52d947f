"""Strain of a cross section from the wrench that it carries: six algebraic equations."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    tangent = np.diag(stiffness).copy()
    for (x, y, dx, dy), force in zip(route, tension, strict=True):
        r = np.array([x, y, 0.0])
        path = strain[3:] + np.cross(strain[:3], r) + np.array([dx, dy, 0.0])
        norm = np.linalg.norm(path)
        t = path / norm
        imbalance += force * np.concatenate([np.cross(r, t), t])
        b = np.hstack([-cross_matrix(r), np.eye(3)])
        tangent += force / norm * b.T @ (np.eye(3) - np.outer(t, t)) @ b
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
