"""Gauss nodes: how modules are discretised, integrals and interpolation on them."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Grid(NamedTuple):
    """How a module is discretised: `elements` of equal length with `nodes` Gauss nodes each."""

    elements: int
    nodes: int


MAX_NODES = 16


@cache
def legendre_nodes(count: int) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss quadrature on [-1, 1]."""
    return np.polynomial.legendre.leggauss(count)


@cache
def gauss(nodes: int) -> tuple[Array, Array, Array]:
    """Return the Gauss collocation coefficients a (q, q), weights b (q,) and nodes c (q,) on [0, 1]."""
    x, w = legendre_nodes(nodes)
    return integrals((x + 1.0) / 2.0, (x + 1.0) / 2.0), w / 2.0, (x + 1.0) / 2.0


def integrals(c: Array, x: Array) -> Array:
    """Return A (len(x), q): integrals from 0 to x of the Lagrange polynomials on the nodes c in [0, 1]."""
    q = len(c)
    legendre = np.polynomial.legendre
    vandermonde = legendre.legvander(2.0 * c - 1.0, q - 1)
    columns = legendre.legval(2.0 * x - 1.0, legendre.legint(np.eye(q), lbnd=-1.0)) / 2.0
    return np.asarray(np.linalg.solve(vandermonde.T, columns).T, dtype=np.float64)


@cache
def interpolation(here: Grid, there: Grid) -> tuple[NDArray[np.int64], Array]:
    """Return what takes values at the nodes of one grid of a module to those of another, `interpolated`.

    Nodes (G', q) of the element that each new node lies in, and the values of their Lagrange polynomials there (G', q).
    """
    vandermonde = np.polynomial.legendre.legvander
    x = ((np.arange(there.elements)[:, np.newaxis] + gauss(there.nodes)[2]) / there.elements * here.elements).ravel()
    element = np.minimum(x.astype(np.int64), here.elements - 1)
    basis = vandermonde(2.0 * gauss(here.nodes)[2] - 1.0, here.nodes - 1)
    values = vandermonde(2.0 * (x - element) - 1.0, here.nodes - 1)
    weights = np.asarray(np.linalg.solve(basis.T, values.T).T, dtype=np.float64)
    return element[:, np.newaxis] * here.nodes + np.arange(here.nodes), weights


def interpolated(here: Grid, values: Array, there: Grid) -> Array:
    """Return values (..., G, d) at the nodes of one grid of a module interpolated to those of another, (..., G', d)."""
    nodes, weights = interpolation(here, there)
    return np.einsum("gq,...gqd->...gd", weights, values[..., nodes, :])


def carried(here: Sequence[Grid], strain: Array, there: Sequence[Grid]) -> Array:
    """Return strains (..., G, 6) at the nodes of an arm's grids `here` interpolated to those of other grids, (..., G', 6)."""
    parts, first = [], 0
    for old, new in zip(here, there, strict=True):
        last = first + old.elements * old.nodes
        parts.append(interpolated(old, strain[..., first:last, :], new))
        first = last
    return np.ascontiguousarray(np.concatenate(parts, axis=-2))  # kernels are compiled for this layout alone
