"""The baseline methods of the speed-accuracy study: closed forms, `Arm.equilibrium` on a fine grid, hard starts."""

from functools import cache

import numpy as np
import pytest

from study import effects, shooting
from study.method import State
from study.methods import METHODS, ablation, bvp, paper, strain_basis
from tca_envs.mechanics import TCA, Arm, Grid, Module, Muscle, Payload, Spring, Tendon
from tca_envs.robots import paper as robot

CURVATURE, PIECES, POLYNOMIALS, KIRCHHOFF = strain_basis.METHODS
FULL = (PIECES, POLYNOMIALS, bvp.METHOD, *paper.METHODS)
ALL = (*strain_basis.METHODS, bvp.METHOD, *paper.METHODS, *ablation.METHODS)
SLOW = (*strain_basis.METHODS, paper.METHODS[1])
compiled = pytest.mark.slow
"""Of what needs the kernels of strain bases, which take a minute to compile and serve the charts alone."""

E, RADIUS, LENGTH = 0.125e6, 0.0045, 0.045
BENT = np.array([100.0, 60.0, 25.0])
WHOLE = np.array([100.0, 60.0, 25.0, 80.0])


def some(*methods):
    return [pytest.param(method, marks=compiled) if method in SLOW else method for method in methods]


def name(method):
    return method.name


def rod(laws, offset=0.004):
    muscles = [Muscle(offset, 2.0 * np.pi * i / 3.0, 0.0, law) for i, law in enumerate(laws)]
    return Arm([Module.cylinder(LENGTH, 2.0 * RADIUS, E, E / 3.0, 0.0, muscles)])


@cache
def fine(make):
    """An arm on a grid ten times finer than its own."""
    arm = make()
    grids = [Grid(24, 6) if any(m.turns for m in module.muscles) else Grid(6, 8) for module in arm.modules]
    return Arm(arm.modules, arm.gravity, arm.payload, grids, 1e-11)


def error(answer, reference):
    assert answer.converged and reference.converged
    return np.linalg.norm(answer.tip[:3, 3] - reference.tip_pose[:3, 3])


def warm(method, setting, make, drive, step=3.0, tip_force=(0.0, 0.0, 0.0)):
    """Error of a method [m] after a step of all drives, from its own answer before the step."""
    arm = fine(make)
    before = arm.equilibrium(drive, tip_force)
    states = [State(arm, drive, tip_force), State(arm, drive + step, tip_force)]
    solver = method.build(arm, setting, states)
    start = solver.solve(states[0], solver.near(before, states[0]))
    assert start.converged
    return error(solver.solve(states[1], start.guess), arm.equilibrium(drive + step, tip_force, start=before))


# Closed forms.


@pytest.mark.parametrize(
    ("tension", "tip"), [(0.3, (0.0249404116, 0.0, 0.0314365278)), (1.2, (0.0027944622, 0.0, -0.0056561498))]
)
@pytest.mark.parametrize("method", some(CURVATURE, PIECES, POLYNOMIALS, bvp.METHOD, paper.METHODS[1]), ids=name)
def test_a_straight_tendon_bends_a_rod_to_an_arc(method, tension, tip):
    state = State(rod([Tendon()]), np.array([tension]))
    solver = method.build(state.arm, method.settings[2 if method.knob in ("rtol", "tol") else 0], [state])
    answer = solver.solve(state, solver.cold())
    assert answer.converged
    coarse = method.knob in ("rtol", "tol")
    np.testing.assert_allclose(answer.tip[:3, 3], tip, rtol=0.0, atol=2e-5 if coarse else 2e-9)


@pytest.mark.parametrize("method", some(CURVATURE, PIECES, bvp.METHOD), ids=name)
def test_springs_share_the_tension(method):
    state = State(rod([Spring(50.0)] * 3), np.array([0.042, 0.033, 0.033]))
    solver = method.build(state.arm, method.settings[-1], [state])
    answer = solver.solve(state, solver.cold())
    assert answer.guess.tension == pytest.approx([0.11526673, 0.30746311, 0.30746311], abs=2e-7)
    assert np.arccos((np.trace(answer.tip[:3, :3]) - 1.0) / 2.0) == pytest.approx(0.859345402, abs=1e-6)


@pytest.mark.parametrize("method", some(PIECES, bvp.METHOD), ids=name)
def test_gravity_and_payload_bend_a_rod_that_lies(method):
    """Small loads: a Timoshenko beam's tip under its payload's weight sinks by P L^3/3EI + P L/GA."""
    arm = Arm(rod([Tendon()]).modules, (1e-4, 0.0, 0.0), Payload(1.0))
    state = State(arm, np.zeros(1))
    solver = method.build(arm, method.settings[-1], [state])
    assert solver.solve(state, solver.cold()).tip[0, 3] == pytest.approx(0.77148885e-4, rel=2e-3)


# Against the full model.


@compiled
def test_error_of_constant_pieces_falls_with_their_number_squared():
    errors = [warm(PIECES, pieces, robot.bending_arm, BENT) for pieces in PIECES.settings[1:]]
    ratios = np.divide(errors[:-1], errors[1:])
    assert ((ratios > 3.5) & (ratios < 4.5)).all()
    assert errors[-1] < 1.2e-5


@compiled
def test_polynomials_converge_exponentially():
    errors = [warm(POLYNOMIALS, order, robot.bending_arm, BENT) for order in POLYNOMIALS.settings]
    assert errors[0] > 1e-3 and errors[3] < 2e-6 and errors[4] < 5e-8


@compiled
def test_polynomials_bend_out_of_plane():
    """Curvature that turns: rotations do not commute along the module."""
    arm, drive, force = fine(robot.bending_arm), np.array([150.0, 60.0, 25.0]), (0.0, 0.02, 0.0)
    known = arm.equilibrium(drive, force)
    state = State(arm, drive, force)
    basis = strain_basis.reduce(arm, strain_basis.ALL, 1, 6)
    assert error(basis.solve(state, basis.near(known, state)), known) < 2e-7


@pytest.mark.parametrize(
    ("method", "setting", "limit"),
    [
        pytest.param(PIECES, 16, 1e-5, marks=compiled),
        pytest.param(POLYNOMIALS, 4, 1e-5, marks=compiled),
        (bvp.METHOD, 1e-4, 1e-7),
    ],
)
def test_both_modules(method, setting, limit):
    assert warm(method, setting, robot.whole_arm, WHOLE, tip_force=(0.0, 1e-3, 0.0)) < limit


def test_boundary_value_problem_meets_its_tolerance():
    errors = [warm(bvp.METHOD, tolerance, robot.bending_arm, BENT) for tolerance in bvp.METHOD.settings[:4]]
    assert errors[0] < 1e-5 and errors[2] < 1e-7 and errors[3] < 5e-9


@pytest.mark.parametrize("method", some(*paper.METHODS), ids=name)
def test_shooting_goes_on_from_its_last_answer(method):
    assert warm(method, 1e-2, robot.bending_arm, BENT) < 5e-4
    assert warm(method, 1e-4, robot.bending_arm, BENT) < 2e-6


@compiled
def test_shooting_takes_a_good_start():
    """Where the straight arm is none: the plain method spends its evaluations there."""
    arm = fine(robot.bending_arm)
    state = State(arm, BENT)
    solver = paper.started(arm, 1e-3, [state])
    answer = solver.solve(state, solver.cold())
    assert error(answer, arm.equilibrium(BENT)) < 2e-5
    assert answer.guess.iterations < 30


@compiled
def test_kirchhoff_rods_neither_shear_nor_stretch():
    arm = fine(robot.bending_arm)
    stiff = effects.without_extension(effects.without_shear(arm))
    state = State(arm, BENT, (0.0, 5e-3, 0.0))
    solver = KIRCHHOFF.build(arm, 4, [state])
    answer = solver.solve(state, solver.cold())
    assert error(answer, stiff.equilibrium(BENT, state.tip_force)) < 5e-7
    assert error(answer, arm.equilibrium(BENT, state.tip_force)) > 5e-4


@compiled
def test_constant_curvature_does_not_twist():
    arm = fine(robot.whole_arm)
    state = State(arm, np.array([25.0, 25.0, 25.0, 120.0]))
    solver = CURVATURE.build(arm, 1, [state])
    answer = solver.solve(state, solver.cold())
    turn = answer.tip[:3, :3]
    assert answer.converged and abs(turn[1, 0] - turn[0, 1]) < 1e-3
    assert (answer.guess.q.shape == (2, 3)) and (arm.equilibrium(state.drive).tip_pose[0, 0] < 0.0)


@pytest.mark.parametrize("method", some(*(method for method in METHODS[1:] if method.available())), ids=name)
def test_a_known_equilibrium_is_a_start(method):
    arm = fine(robot.bending_arm)
    known = arm.equilibrium(BENT)
    state = State(arm, BENT)
    solver = method.build(arm, method.settings[2 % len(method.settings)], [state])
    answer = solver.solve(state, solver.near(known, state))
    assert error(answer, known) < (2e-2 if method.reduced else 5e-4)


@compiled
def test_starts_are_near_the_answer():
    arm = fine(robot.whole_arm)
    known = arm.equilibrium(WHOLE)
    state = State(arm, WHOLE)
    basis = PIECES.build(arm, 16, [state])
    start, found = basis.near(known, state), basis.solve(state, basis.cold()).guess
    off, scale = np.abs(start.q - found.q).max(axis=0), np.abs(found.q).max(axis=0)
    assert (off < 0.1 * scale).all()
    np.testing.assert_allclose(start.tension, found.tension, atol=1e-3)
    basis = POLYNOMIALS.build(fine(robot.bending_arm), 4, [])
    known_bent = fine(robot.bending_arm).equilibrium(BENT)
    start = basis.near(known_bent, state)
    found = basis.solve(State(basis.arm, BENT), start).guess
    np.testing.assert_allclose(start.q, found.q, atol=1e-3 * np.abs(found.q).max())
    solver = bvp.build(arm, 1e-4, [state])
    begun, ended = solver.near(known, state), solver.solve(state, solver.cold()).guess
    np.testing.assert_allclose(begun.y[:, [0, -1]], ended.y[:, [0, -1]], atol=1e-4)
    np.testing.assert_allclose(begun.tension, ended.tension, atol=1e-5)


# Work inside.


@compiled
@pytest.mark.parametrize(("pieces", "order"), [(1, 4), (8, 0), (3, 2)])
def test_newton_has_the_tangent_of_the_reduced_equations(pieces, order):
    arm = robot.whole_arm()
    basis = strain_basis.reduce(arm, strain_basis.ALL, pieces, order)
    start = basis.solve(State(arm, WHOLE), basis.cold()).guess
    asked = State(arm, WHOLE + 3.0)
    rung, iterations = strain_basis.solve(
        basis.plain, basis.model, start.q, start.tension, start.drive, start.load, asked.drive, asked.load, np.eye(4)
    )
    assert rung == strain_basis.WARM and iterations <= 4


def test_boundary_value_problem_has_its_derivatives():
    arm = robot.whole_arm()
    known = arm.equilibrium(WHOLE)
    solver = bvp.build(arm, 1e-3, [])
    x, y, tension, _, _ = solver.near(known, State(arm, WHOLE))
    problem = bvp.Problem(solver, WHOLE, arm.load((0.0, 0.01, 0.0), (1e-4, 0.0, 0.0)))
    y = y + 0.01 * np.random.default_rng(0).normal(size=y.shape)
    by_state, by_tension = problem.fun_jac(x, y, tension)
    by_start, by_end, by_pull = (block.copy() for block in problem.boundary(y[:, 0], y[:, -1], tension)[1:])
    for i in range(len(y)):
        step = np.zeros_like(y)
        step[i] = 1e-6
        found = (problem.rates(x, y + step, tension)[0] - problem.rates(x, y - step, tension)[0]) / 2e-6
        np.testing.assert_allclose(found, by_state[:, i], atol=1e-6)
        e = step[:, 0]
        for block, ends in ((by_start, ((e, 0), (-e, 0))), (by_end, ((0, e), (0, -e)))):
            up, down = (problem.boundary(y[:, 0] + a, y[:, -1] + b, tension)[0] for a, b in ends)
            np.testing.assert_allclose((up - down) / 2e-6, block[:, i], atol=1e-6)
    for i, e in enumerate(1e-6 * np.eye(len(tension))):
        found = (problem.rates(x, y, tension + e)[0] - problem.rates(x, y, tension - e)[0]) / 2e-6
        np.testing.assert_allclose(found, by_tension[:, i], atol=1e-6)
        up, down = (problem.boundary(y[:, 0], y[:, -1], tension + sign * e)[0] for sign in (1.0, -1.0))
        found = (up - down) / 2e-6
        np.testing.assert_allclose(found, by_pull[:, i], atol=1e-6)


@pytest.mark.parametrize("method", some(*ALL), ids=name)
@pytest.mark.parametrize(
    ("drive", "tip_force"),
    [([158.0] * 3, (0.0, 0.0, 0.0)), ([25.0, 158.0, 25.0], (1.2, 0.0, 0.0)), ([25.0] * 3, (0.0, 0.2, -1.2))],
)
def test_hard_cold_starts_end_without_an_error(method, drive, tip_force, monkeypatch):
    monkeypatch.setattr(shooting, "MAX_EVALUATIONS", 20)  # seconds otherwise
    arm = robot.bending_arm()
    state = State(arm, np.array(drive), tip_force)
    for setting in {method.settings[0], method.settings[-1] if method.knob != "rtol" else 1e-2}:
        solver = method.build(arm, setting, [state])
        answer = solver.solve(state, solver.cold())
        assert not answer.converged or (np.isfinite(answer.tip).all() and answer.guess is not None)
        assert answer.converged or answer.guess is None


def test_boundary_value_problem_goes_in_substeps():
    """Straight to this state SciPy's Newton fails."""
    arm = robot.bending_arm()
    state = State(arm, np.array([117.0, 92.0, 35.0]), (-0.07, 0.09, 0.0))
    solver = bvp.build(arm, 1e-2, [state])
    assert error(solver.solve(state, solver.cold()), arm.equilibrium(state.drive, state.tip_force)) < 5e-5


# Effects left out.


def test_active_muscles_pull_by_themselves():
    arm = rod([TCA(), Tendon(), Spring(50.0)])
    assert effects.active(arm, np.array([26.0, 0.1, 0.04])).tolist() == [True, True, True]
    assert effects.active(arm, np.array([25.0, 0.0, 0.045])).tolist() == [False, False, False]
    assert effects.active(arm, np.array([20.0, 0.0, 0.05])).tolist() == [False, False, False]


def test_passive_muscles_are_taken_out():
    arm = robot.bending_arm()
    kept = effects.active(arm, np.array([25.0, 90.0, 25.0]))
    other = effects.with_muscles(arm, kept)
    assert kept.tolist() == [False, True, False] and other.muscles == (arm.muscles[1],)
    state, next_state = State(arm, np.array([25.0, 90.0, 25.0])), State(arm, np.array([25.0, 90.0, 80.0]))
    solver = ablation.driven(arm, "default", [state])
    first = solver.solve(state, solver.cold())
    assert error(first, other.equilibrium([90.0])) < 1e-6
    # Another set of muscles, from the last one's answer: those that were not there carry nothing.
    whole = effects.extended(arm, first.guess.found, kept)
    assert whole.tensions[kept] == first.guess.found.tensions and not whole.tensions[~kept].any()
    assert whole.known[0].tolist() == [25.0, 90.0, 25.0]
    two = effects.with_muscles(arm, effects.active(arm, next_state.drive))
    assert error(solver.solve(next_state, first.guess), two.equilibrium([90.0, 80.0])) < 1e-6
    none = State(arm, np.full(3, 25.0))
    assert error(solver.solve(none, first.guess), effects.with_muscles(arm, np.zeros(3, dtype=bool)).equilibrium([])) < 1e-6


def test_gravity_off():
    arm = robot.bending_arm()
    state = State(arm, BENT, payload=Payload(0.01))
    solver = ablation.weightless(arm, "default", [state])
    reference = Arm(arm.modules).equilibrium(BENT)
    assert error(solver.solve(state, solver.cold()), reference) < 1e-6
    assert effects.without_gravity(arm).payload is arm.payload


def test_stiffened_rods():
    arm = robot.bending_arm()
    s = np.linspace(0.0, 0.04, 5)
    sheared, stretched = (
        change(arm).equilibrium(BENT, (0.0, 0.01, 0.0)).strain(s)
        for change in (effects.without_extension, effects.without_shear)
    )
    np.testing.assert_allclose(sheared[:, 5], 1.0, atol=1e-6)
    np.testing.assert_allclose(stretched[:, 3:5], 0.0, atol=1e-6)
    assert np.abs(sheared[:, 3:5]).max() > 1e-3 and np.abs(stretched[:, 5] - 1.0).max() > 1e-3
