"""Speed, measured and not judged, and the accuracy that goes with it. Alone for clean numbers: pytest tests/test_benchmark.py.

The scene is the one that TCAReach steps: the bending module with three TCAs and the rest of the arm hanging from it.
"""

import itertools

import numpy as np
import pytest

from tca_envs import presets
from tca_envs.mechanics import Arm, Grid, shooting

WARM = np.array([110.0, 60.0, 40.0])
"""Temperatures [degC] of the first state; the second is 1 degC hotter everywhere."""
PAPER_RTOL = 1e-6


@pytest.fixture(scope="module")
def arm():
    return presets.bending_arm()


@pytest.mark.benchmark(group="warm solve after 1 degC, bending module with the rest of the arm")
def test_warm_solve(benchmark, arm):
    states = itertools.cycle([arm.equilibrium(WARM + 1.0), arm.equilibrium(WARM)])
    drives = itertools.cycle([WARM, WARM + 1.0])
    result = benchmark(lambda: arm.equilibrium(next(drives), start=next(states)))
    assert result.converged


@pytest.mark.benchmark(group="warm solve after 1 degC, bending module with the rest of the arm")
def test_warm_solve_by_the_papers_method(benchmark, arm):
    start = arm.equilibrium(WARM)
    result = benchmark.pedantic(
        lambda: shooting.equilibrium(arm, WARM + 1.0, start=start, rtol=PAPER_RTOL), rounds=3, iterations=1
    )
    assert result.converged
    exact = arm.equilibrium(WARM + 1.0)
    assert np.linalg.norm(result.tip_pose[:3, 3] - exact.tip_pose[:3, 3]) < 1e-6


@pytest.mark.benchmark(group="cold solve")
def test_cold_solve(benchmark, arm):
    result = benchmark(lambda: arm.equilibrium(WARM))
    assert result.converged


@pytest.mark.benchmark(group="cold solve")
def test_tip_jacobian(benchmark, arm):
    start = arm.equilibrium(WARM)
    benchmark(lambda: start.differentiate())


def test_the_presets_grid_is_accurate_to_a_micrometre(arm):
    finer = Arm(arm.modules, arm.gravity, arm.payload, [Grid(10, arm.grids[0].nodes)], tolerance=1e-11)
    rng = np.random.default_rng(0)
    corners = itertools.product((25.0, 160.0), repeat=3)
    drives = [*rng.uniform(25.0, 160.0, (40, 3)), *map(np.array, corners)]
    for drive in drives:
        coarse = arm.equilibrium(drive)
        # From the coarse answer, so that both are on the same branch.
        fine = finer.equilibrium(drive, start=coarse)
        assert coarse.converged and fine.converged
        warm = arm.equilibrium(np.maximum(drive - 1.0, 25.0), start=coarse)
        warm_fine = finer.equilibrium(np.maximum(drive - 1.0, 25.0), start=fine)
        for a, b in ((coarse, fine), (warm, warm_fine)):
            assert np.linalg.norm(a.tip_pose[:3, 3] - b.tip_pose[:3, 3]) < 1e-6
