"""The cheapest discretisation that a scene needs: grids and Newton's stop from a tip error and the states to be met.

1. All states are solved on a coarse grid and on a better one. Those whose tips differ most are the hardest: what
   makes a state hard, a strongly bent module or a branch of equilibria about to end, does so on every grid.
2. The hardest ones are solved on a fine grid, refined until that no longer matters to the tolerance.
3. Module by module, grids are tried in the order of their cost, all other modules being fine, until one keeps the tip within
   a share of the tolerance. Newton starts a little off, as a warm start does, so that its own error counts, too.
4. The chosen grids together are held against the fine ones; where they miss, the share is halved.

The estimated error is the largest over the hardest states times SAFETY, for worse states than those given will be met.
Everything is deterministic: costs are counted, not timed.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check, continuation, solver
from tca_envs.mechanics.arm import Arm
from tca_envs.mechanics.grid import MAX_NODES, Grid, carried
from tca_envs.mechanics.loads import SIZE
from tca_envs.mechanics.module import Module
from tca_envs.mechanics.rungs import Rung
from tca_envs.mechanics.solver import Lanes

Array = NDArray[np.float64]

FINEST, COARSEST = 1e-9, 1e-3
"""Tip errors that can be asked for [m]."""
SAFETY = 3.0
"""The worst of thousands of states has up to so many times the error of the worst of some hundred."""
HARDEST, FIRST = 16, 4
"""States that grids are tried on, and how many of them first: most grids that do not do fail there."""
FEWEST_NODES = 3
"""Per element: with two, Newton's tangent, that of the continuous equations, is too far from the discrete ones'."""
NEWTON_SHARE = 0.1
"""Newton stops at a residual that, as an angle over the arm's length, moves the tip by this share of the tolerance."""
OFF = 0.005
"""Newton starts from strains that are off by this share, as after a small step."""
FINE = ((10, 1), (14, 1), (14, 2), (14, 4))
"""Nodes and elements, the latter as a multiple of the fewest that may do, of ever finer grids."""
ROUNDS = 4


class Known(NamedTuple):
    """Solved states of an arm, S of them."""

    arm: Arm
    drive: Array  # (S, n)
    load: Array  # (S, loads.SIZE)
    strain: Array  # (S, G, 6)
    tension: Array  # (S, n)
    tip: Array  # (S, 3) [m]
    found: NDArray[np.bool_]  # (S,) whether there is an equilibrium; the rest of such a row says nothing

    def some(self, states: NDArray[np.intp] | NDArray[np.bool_] | slice) -> "Known":
        """Return some of the states."""
        rows: list[Any] = [values[states] for values in self[1:]]
        return Known(self.arm, *rows)


def discretise(arm: Arm, tolerance: float, drives: ArrayLike, loads: ArrayLike | None = None) -> Arm:
    """Return the arm with the cheapest discretisation that keeps its tip within a tolerance over a scene.

    Parameters
    ----------
    arm : Arm
        Its modules, gravity and payload are kept.
    tolerance : float
        Largest tip error [m], in [1e-9, 1e-3].
    drives : (S, n) array
        The scene: states that it will meet, typical and extreme ones.
    loads : (S, SIZE) array, optional
        Load of each state as of `Arm.load`; by default the arm's own weight and payload.

    Returns
    -------
    Arm
        With what was chosen in `discretisation`.

    Raises
    ------
    ValueError
        For a tolerance out of its range, states of the wrong shape or without any equilibrium, or where no grid keeps to the
        tolerance.
    """
    tolerance = check.scalar("tolerance", tolerance, FINEST, COARSEST)
    drive = check.array("drives", drives, (None, len(arm.muscles)))
    load = np.tile(arm.load(), (len(drive), 1)) if loads is None else check.array("loads", loads, (len(drive), SIZE))
    for row in drive:
        arm.checked_drive(row)
    residual_tolerance = NEWTON_SHARE * tolerance / arm.length
    known = _hardest(arm, drive, load)
    if not len(known.drive):
        raise ValueError(f"drives = {drives!r}: expected states of which at least one has an equilibrium")
    fine = _fine(known, tolerance)
    share = tolerance / SAFETY
    for _ in range(ROUNDS):
        grids = [_cheapest(k, share, fine, residual_tolerance) for k in range(len(arm.modules))]
        error = SAFETY * _error(grids, fine, residual_tolerance)
        if error <= tolerance:
            return _chosen(arm, grids, residual_tolerance, tolerance, error, len(drive))
        share *= 0.5
    raise ValueError(f"tolerance = {tolerance:g}: expected one that grids of this arm can keep to; {error:.2g} m was reached")


def cost(module: Module, grid: Grid) -> float:
    """Return what a grid costs, in nanoseconds or so of a warm solve: elimination grows with the cube of the nodes."""
    return 6.0 * grid.elements * grid.nodes * (200.0 + 20.0 * len(module.muscles) + grid.nodes**2)


def _chosen(arm: Arm, grids: Sequence[Grid], residual_tolerance: float, tolerance: float, error: float, states: int) -> Arm:
    result = Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance)
    result.discretisation = replace(result.discretisation, tolerance=tolerance, error=error, states=states)
    return result


def _elements(module: Module) -> int:
    """Return how few elements may do: somewhat more than a turn of a muscle, or two radians of the reference, in each."""
    turns = max((abs(muscle.turns) for muscle in module.muscles), default=0.0)
    bend = module.length * float(np.linalg.norm(module.reference_strain[:3]))
    return max(1, ceil(0.8 * turns), ceil(0.5 * bend))


def _on(arm: Arm, grids: Sequence[Grid], residual_tolerance: float) -> Arm:
    return Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance)


def _hardest(arm: Arm, drive: Array, load: Array) -> Known:
    """Return the hardest states, solved on a middling grid."""
    elements = [_elements(module) for module in arm.modules]
    coarse, middling = [Grid(e, 5 if e == 1 else 4) for e in elements], [Grid(e, 7 if e == 1 else 6) for e in elements]
    rough = _on(arm, coarse, 1e-3)
    start = [np.tile(x, (len(drive), *[1] * x.ndim)) for x in rough.unloaded()]
    lanes = _lanes(*(x.copy() for x in start))
    first = _known(rough, lanes, drive, load, solver.solve(rough.problem, lanes, drive, load))
    beyond = ~first.found  # a branch's end, most of them
    lanes = _lanes(*(x[beyond] for x in start))
    fallen = _known(rough, lanes, drive[beyond], load[beyond], continuation.solve(rough, lanes, drive[beyond], load[beyond]))
    for values, new in zip(first[1:], fallen[1:], strict=True):
        values[beyond] = new
    known = _carried(first.some(first.found), _on(arm, middling, 1e-6))
    known = known.some(known.found)
    # Both to the same small residual, so that the grids alone make the difference.
    other = _carried(known, _on(arm, coarse, 1e-6))
    error = np.where(other.found, np.linalg.norm(other.tip - known.tip, axis=1), np.inf)
    return known.some(np.argsort(-error, kind="stable")[:HARDEST])


def _fine(known: Known, tolerance: float) -> Known:
    """Return the states on a grid so fine that a finer one makes no difference to the tolerance."""
    for nodes, times in FINE:
        grids = [Grid(times * _elements(module), nodes) for module in known.arm.modules]
        finer = _carried(known, _on(known.arm, grids, max(1e-11, 1e-3 * tolerance)))
        change = np.linalg.norm(finer.tip - known.tip, axis=1)[finer.found]
        # Where the branch ends on the finer grid there is nothing to compare other grids with.
        known = finer.some(finer.found)
        if not len(change) or change.max() < 0.1 * tolerance / SAFETY:
            break
    return known.some(_carried(known, known.arm, OFF).found)


def _cheapest(k: int, share: float, fine: Known, residual_tolerance: float) -> Grid:
    """Return the cheapest grid of module k with which the tip errs by at most `share`, all other modules being fine."""
    module, best = fine.arm.modules[k], fine.arm.grids[k]
    few = _elements(module)

    def does(grid: Grid) -> bool:
        grids = [*fine.arm.grids[:k], grid, *fine.arm.grids[k + 1 :]]
        parts = (fine.some(slice(FIRST)), fine.some(slice(FIRST, None)))
        return all(_error(grids, part, residual_tolerance) <= share for part in parts)

    def improved(elements: int) -> bool:
        nonlocal best
        grids = [Grid(elements, nodes) for nodes in range(FEWEST_NODES, MAX_NODES + 1)]
        cheaper = [grid for grid in grids if cost(module, grid) < cost(module, best)]
        first = bisect_left(cheaper, True, key=does)
        best = cheaper[first] if first < len(cheaper) else best
        return first < len(cheaper)

    improved(few)
    for step in (1, -1):  # more elements, then fewer, as long as that is cheaper
        elements = few + step
        while elements >= 1 and improved(elements):
            elements += step
    return best


def _error(grids: Sequence[Grid], fine: Known, residual_tolerance: float) -> float:
    """Return the largest tip error [m] on other grids, inf where Newton does not go straight to one of the states."""
    found = _carried(fine, _on(fine.arm, grids, residual_tolerance), OFF)
    return float(np.linalg.norm(found.tip - fine.tip, axis=1).max(initial=0.0)) if found.found.all() else np.inf


def _carried(known: Known, arm: Arm, off: float = 0.0) -> Known:
    """Solve known states on another arm's grids, starting from their strains, reduced towards the unloaded ones by `off`."""
    strain = carried(known.arm.grids, known.strain, arm.grids)
    if off:
        strain -= off * (strain - arm.unloaded()[0])
    lanes = _lanes(strain, known.tension.copy(), known.drive.copy(), known.load.copy())
    report = solver.solve(arm.problem, lanes, known.drive, known.load, substeps=False)
    return _known(arm, lanes, known.drive, known.load, report)


def _lanes(strain: Array, tension: Array, drive: Array, load: Array) -> Lanes:
    return Lanes(strain, tension, drive, load, np.tile(np.eye(4), (len(drive), 1, 1)), np.empty_like(drive))


def _known(arm: Arm, lanes: Lanes, drive: Array, load: Array, report: Any) -> Known:
    return Known(arm, drive, load, lanes.strain, lanes.tension, lanes.tip[:, :3, 3], report["rung"] != Rung.FAILED)
