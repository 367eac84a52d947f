"""Other packages on the speed-accuracy chart; their tests run where they are installed (the extra `study`)."""

import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from study.method import Method, State
from study.methods import METHODS, elastica, gvs
from tca_envs.mechanics import TCA, Arm, Equilibrium, Grid, Module, Muscle, Spring, Tendon, muscle
from tca_envs.robots import paper

PEERS = (elastica.METHOD, elastica.MATCHED, gvs.METHOD)
HOT = np.array([110.0, 40.0, 25.0])
"""[degC]"""


def bending(muscles: bool = True, gravity=(0.0, 0.0, 0.0)) -> Arm:
    """The bending module alone, on a fine grid."""
    module = paper.bending_module()
    if not muscles:
        module = Module(module.length, module.stiffness, module.mass_per_length)
    return Arm([module], gravity, grids=[Grid(4, 8)], residual_tolerance=1e-10)


def error(method: Method, setting, arm: Arm, drive, tip_force=(0.0, 0.0, 0.0)) -> tuple[float, float]:
    """Distance of the tip [m] and of its rotation matrix from those of `Arm.equilibrium`."""
    answer = solve(method, setting, arm, drive, tip_force)
    found = arm.equilibrium(drive, tip_force)
    assert answer.converged and found.converged
    apart = answer.tip - found.tip_pose
    return float(np.linalg.norm(apart[:3, 3])), float(np.linalg.norm(apart[:3, :3]))


def solve(method: Method, setting, arm: Arm, drive, tip_force=(0.0, 0.0, 0.0)):
    state = State(arm, np.asarray(drive, dtype=float), tip_force)
    solver = method.build(arm, setting, [state])
    return solver.solve(state, solver.cold())


@cache
def hot_tip(method: Method, setting: int):
    """Tip of the bending module without weight, one muscle hot."""
    answer = solve(method, setting, bending(), HOT)
    assert answer.converged
    return answer.tip[:3, 3]


# Without the packages.


def test_nothing_is_imported_before_a_method_is_built():
    code = "import sys, study.methods; print({'elastica', 'soromox', 'jax'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_peers_are_on_the_chart():
    assert set(PEERS) <= set(METHODS)
    assert [method.own_limit for method in PEERS] == [True, False, False]


@pytest.mark.parametrize(
    "package, method", [("elastica", elastica.METHOD), ("elastica", elastica.MATCHED), ("soromox", gvs.METHOD)]
)
def test_a_method_is_available_where_its_package_is(package, method):
    try:
        __import__(package)
    except ImportError:
        assert not method.available()
    else:
        assert method.available()


# PyElastica.


@pytest.fixture(scope="module")
def rods():
    pytest.importorskip("elastica")


def test_relaxed_passive_rod_approaches_the_equilibrium_in_second_order(rods):
    arm = bending(muscles=False)
    errors = [error(elastica.MATCHED, n, arm, [], (1e-3, 0.0, 0.0)) for n in (10, 20)]
    tip = arm.equilibrium([], (1e-3, 0.0, 0.0)).tip_pose[:3, 3]
    assert tip[0] > 0.01
    assert errors[1][0] < 2e-5
    assert errors[1][1] < 1e-3
    assert 3.5 < errors[0][0] / errors[1][0] < 4.5


def test_relaxed_rod_with_muscles_approaches_the_equilibrium_in_second_order(rods):
    tip = bending().equilibrium(HOT).tip_pose[:3, 3]
    coarse, fine = (np.linalg.norm(hot_tip(elastica.MATCHED, n) - tip) for n in (10, 20))
    assert fine < 5e-4
    assert 3.0 < coarse / fine < 5.0


def test_the_packages_own_law_has_another_limit(rods):
    tip = bending().equilibrium(HOT).tip_pose[:3, 3]
    coarse, middle, fine = (hot_tip(elastica.METHOD, n) for n in (10, 20, 40))
    assert 3.0 < np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine) < 5.0
    assert np.linalg.norm(fine - tip) > 5.0 * np.linalg.norm(hot_tip(elastica.MATCHED, 40) - tip)


def test_relaxed_rod_carries_payload_weight_and_a_second_helical_module(rods):
    arm = paper.whole_arm()
    drive = [110.0, 60.0, 40.0, 90.0]
    distance, turn = error(elastica.MATCHED, 10, arm, drive)
    assert distance < 4e-4
    assert turn < 0.03


@pytest.mark.parametrize("law, drive", [(Tendon(), 0.05), (Spring(20.0), 0.035)])
def test_relaxed_rod_takes_the_other_laws(rods, law, drive):
    module = paper.bending_module()
    arm = Arm([Module(module.length, module.stiffness, 0.0, [Muscle(0.004, 0.3, 0.2, law)])])
    assert error(elastica.MATCHED, 20, arm, [drive])[0] < 2e-4


def test_relaxation_goes_on_from_its_own_answer_and_from_an_equilibrium(rods):
    arm = paper.bending_arm()
    before, after = State(arm, HOT), State(arm, HOT + 1.0)
    solver = elastica.MATCHED.build(arm, 10, [before])
    cold = solver.solve(after, solver.cold())
    for guess in (solver.solve(before, solver.cold()).guess, solver.near(arm.equilibrium(HOT), before)):
        answer = solver.solve(after, guess)
        assert answer.converged
        np.testing.assert_allclose(answer.tip[:3, 3], cold.tip[:3, 3], atol=2e-6)


@pytest.mark.parametrize("method", [elastica.METHOD, elastica.MATCHED])
def test_relaxation_reports_a_rod_that_tears(rods, method):
    answer = solve(method, 10, bending(), HOT, (1e6, 0.0, 0.0))
    assert not answer.converged and answer.guess is None


# SoRoMoX: slow, for JAX compiles half a minute for each order.


@cache
def gvs_solver(order: int):
    arm = bending()
    return arm, gvs.METHOD.build(arm, order, [])


@pytest.fixture(scope="module")
def strains():
    pytest.importorskip("soromox")


def test_jax_elongation_is_that_of_the_muscle(strains):
    import jax

    laws = [TCA(), TCA.paper(), Spring(30.0)]
    kind = np.array([law.kind for law in laws])
    parameters = np.array([law.parameters() for law in laws])
    rest = np.array([0.045, 0.11, 0.03])
    with jax.enable_x64(True):
        for tension in (-0.05, 0.0, 0.2, 0.9):
            drive = np.array([80.0, 120.0, 0.035])
            ours = [muscle.elongation(kind[i], parameters, i, rest[i], tension, drive[i])[0] for i in range(3)]
            theirs = gvs.elongation(kind, parameters, rest, np.full(3, tension), drive)
            np.testing.assert_allclose(np.asarray(theirs), ours, rtol=1e-12)


@pytest.mark.slow
def test_strain_series_approach_the_equilibrium_with_their_order(strains):
    drive, force = HOT, (1e-3, -5e-4, 0.0)
    errors = []
    for order in (0, 2):
        arm, solver = gvs_solver(order)
        state = State(arm, drive, force)
        answer, found = solver.solve(state, solver.cold()), arm.equilibrium(drive, force)
        assert answer.converged
        errors.append(float(np.linalg.norm(answer.tip[:3, 3] - found.tip_pose[:3, 3])))
        apart = answer.tip[:3, :3] - found.tip_pose[:3, :3]
    assert errors[1] < 2e-5
    assert np.abs(apart).max() < 5e-3
    assert errors[0] > 20.0 * errors[1]


@pytest.mark.slow
def test_strain_series_go_on_from_an_equilibrium(strains):
    arm, solver = gvs_solver(2)
    state = State(arm, HOT)
    known: Equilibrium = arm.equilibrium(HOT - 1.0)
    guess = solver.near(known, State(arm, HOT - 1.0))
    cold, warm = solver.solve(state, solver.cold()), solver.solve(state, guess)
    assert warm.converged
    np.testing.assert_allclose(warm.tip, cold.tip, atol=1e-8)
    # The fit to the known strains is the answer there but for what the series leave out.
    there = solver.solve(State(arm, HOT - 1.0), guess).guess
    np.testing.assert_allclose(guess.coefficients, there.coefficients, atol=0.5)


@pytest.mark.slow
def test_strain_series_report_what_they_do_not_find(strains):
    arm, solver = gvs_solver(0)
    answer = solver.solve(State(arm, HOT, (1e6, 0.0, 0.0)), solver.cold())
    assert not answer.converged and answer.guess is None


@pytest.mark.slow
def test_strain_series_carry_payload_weight_and_a_second_helical_module(strains):
    # The arm's own grid is good for 10 um.
    distance, turn = error(gvs.METHOD, 3, paper.whole_arm(), [110.0, 60.0, 40.0, 90.0])
    assert distance < 1.5e-5
    assert turn < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("law, drive", [(Tendon(), 0.05), (Spring(20.0), 0.035)])
def test_strain_series_take_the_other_laws(strains, law, drive):
    module = paper.bending_module()
    arm = Arm([Module(module.length, module.stiffness, 0.0, [Muscle(0.004, 0.3, 0.2, law)])])
    assert error(gvs.METHOD, 3, arm, [drive])[0] < 1e-5


@pytest.mark.slow
def test_strain_series_bend_a_passive_rod(strains):
    assert error(gvs.METHOD, 3, bending(muscles=False), [], (1e-3, 0.0, 0.0))[0] < 1e-5
