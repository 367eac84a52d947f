"""Speed, measured and not judged, and the accuracy that goes with it. Alone for clean numbers: pytest tests/test_benchmark.py.

The scenes are those that the environments step: the bending module with three TCAs and the rest of the arm hanging from it
(TCAReach), and the whole arm, bending and twisting module in series, with four TCAs (TCATwistAlign, TCAPickAndPlace).
"""

import itertools
import time

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import spearmanr

import tca_envs  # noqa: F401
from study import shooting
from tca_envs.mechanics import Arm, Grid
from tca_envs.mechanics.discretisation import cost
from tca_envs.mechanics.solver import Lanes, solve
from tca_envs.mechanics.thermal import AMBIENT, HARD_LIMIT
from tca_envs.robots import CUT_OFF, paper

WARM = np.array([110.0, 60.0, 40.0])
"""Temperatures [degC] of the first state; the second is 1 degC hotter everywhere."""
WHOLE = np.array([110.0, 60.0, 40.0, 80.0])
"""The same for the whole arm."""
PAPER_RTOL = 1e-6


@pytest.fixture(scope="module")
def arm():
    return paper.bending_arm(tolerance=1e-6)


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


@pytest.fixture(scope="module")
def whole():
    return paper.whole_arm(tolerance=1e-6)


@pytest.mark.benchmark(group="warm solve after 1 degC, whole arm")
def test_warm_solve_of_the_whole_arm(benchmark, whole):
    states = itertools.cycle([whole.equilibrium(WHOLE + 1.0), whole.equilibrium(WHOLE)])
    drives = itertools.cycle([WHOLE, WHOLE + 1.0])
    result = benchmark(lambda: whole.equilibrium(next(drives), start=next(states)))
    assert result.converged


@pytest.mark.benchmark(group="warm solve after 1 degC, whole arm")
def test_warm_solve_of_the_whole_arm_by_the_papers_method(benchmark, whole):
    start = whole.equilibrium(WHOLE)
    result = benchmark.pedantic(
        lambda: shooting.equilibrium(whole, WHOLE + 1.0, start=start, rtol=PAPER_RTOL), rounds=3, iterations=1
    )
    assert result.converged
    exact = whole.equilibrium(WHOLE + 1.0)
    assert np.linalg.norm(result.tip_pose[:3, 3] - exact.tip_pose[:3, 3]) < 1e-6


def test_the_whole_arms_warm_solve_is_a_thousand_times_faster_than_the_papers_method(whole):
    """By 10,000 times or so: the bound holds on any machine."""
    start = whole.equilibrium(WHOLE)

    def seconds(solve, repeats):
        taken = []
        for _ in range(repeats):
            begun = time.perf_counter()
            solve()
            taken.append(time.perf_counter() - begun)
        return float(np.median(taken))

    ours = seconds(lambda: whole.equilibrium(WHOLE + 1.0, start=start), 201)
    theirs = seconds(lambda: shooting.equilibrium(whole, WHOLE + 1.0, start=start, rtol=PAPER_RTOL), 1)
    assert theirs > 1000.0 * ours


@pytest.mark.benchmark(group="cold solve")
def test_cold_solve(benchmark, arm):
    result = benchmark(lambda: arm.equilibrium(WARM))
    assert result.converged


@pytest.mark.benchmark(group="cold solve")
def test_tip_jacobian(benchmark, arm):
    start = arm.equilibrium(WARM)
    benchmark(lambda: start.differentiate())


def test_the_counted_cost_of_a_grid_follows_the_measured_time():
    """In order, of a warm solve in compiled code; lanes are many and grids take turns, so that noise hardly matters."""
    module, lanes = paper.bending_module(), 50
    grids = [Grid(1, 4), Grid(1, 6), Grid(1, 8), Grid(1, 10), Grid(1, 14), Grid(2, 6), Grid(4, 4), Grid(3, 8)]
    arms = [Arm([module], paper.GRAVITY, paper.BELOW_BENDING, [grid], 1e-5) for grid in grids]
    known = [arm.equilibrium(WARM) for arm in arms]
    asked, tip = np.tile(WARM + 1.0, (lanes, 1)), np.tile(np.eye(4), (lanes, 1, 1))
    taken = np.empty((40, len(arms)))
    for row in taken:
        for j, (arm, start) in enumerate(zip(arms, known, strict=True)):
            state = (start.nodes[1], start.tensions, *start.known)
            lane = [np.tile(values, (lanes, *[1] * values.ndim)) for values in state]
            load, known_lanes = np.tile(start.load, (lanes, 1)), Lanes(*lane, tip, np.empty((lanes, 3)))
            begun = time.perf_counter()
            report = solve(arm.problem, known_lanes, asked, load)
            row[j] = (time.perf_counter() - begun) / lanes
            assert (report["iterations"] == 2).all()
    measured, counted = taken.min(axis=0), np.array([cost(module, grid) for grid in grids])
    assert spearmanr(counted, measured).statistic > 0.85
    # More nodes in all, but less to eliminate.
    many, few = grids.index(Grid(4, 4)), grids.index(Grid(1, 14))
    assert measured[many] < measured[few] and counted[many] < counted[few]


@pytest.mark.parametrize(
    ("build", "payload", "hottest"),
    [
        (paper.bending_arm, None, HARD_LIMIT),
        (paper.whole_arm, None, CUT_OFF),
        (paper.whole_arm, paper.with_object(), CUT_OFF),
    ],
    ids=["bending module", "whole arm", "whole arm with object"],
)
def test_the_presets_keep_to_their_tolerance_cold_and_warm(build, payload, hottest):
    """Against ten times as many elements, at random temperatures and in all corners."""
    arm = build()
    grids = [Grid(10 * grid.elements, grid.nodes) for grid in arm.grids]
    finer = Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-10)
    muscles = len(arm.muscles)
    random = np.random.default_rng(0).uniform(AMBIENT, hottest, (20, muscles))
    for drive in [*random, *map(np.array, itertools.product((AMBIENT, hottest), repeat=muscles))]:
        coarse = arm.equilibrium(drive, payload=payload)
        # From the coarse answer, so that both are on the same branch.
        fine = finer.equilibrium(drive, start=coarse, payload=payload)
        assert coarse.converged and fine.converged
        warm = arm.equilibrium(np.maximum(drive - 1.0, AMBIENT), start=coarse, payload=payload)
        warm_fine = finer.equilibrium(np.maximum(drive - 1.0, AMBIENT), start=fine, payload=payload)
        for a, b in ((coarse, fine), (warm, warm_fine)):
            assert np.linalg.norm(a.tip_pose[:3, 3] - b.tip_pose[:3, 3]) < paper.TOLERANCE


@pytest.mark.benchmark(group="a picture of 480 x 480 pixels")
@pytest.mark.parametrize("name", ["TCAReach-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0"])
def test_picture(benchmark, drawing, name):
    env = gym.make(name, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(np.ones(env.action_space.shape, dtype=np.float32))
    picture = benchmark(env.render)
    env.close()
    assert picture.shape == (480, 480, 3) and (picture != first).any()
