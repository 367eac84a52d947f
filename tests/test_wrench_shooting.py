"""Single wrench shooting, one of the methods on the speed-accuracy chart, against the reference."""

import time

import numpy as np
import pytest

from study.method import State
from study.methods.wrench_shooting import METHOD, Guess
from study.reference import reference
from tca_envs.mechanics import TCA, Arm, Module, Muscle, Payload, Spring, Tendon
from tca_envs.robots.paper import BELOW_BENDING, GRAVITY, bending_arm, bending_module, whole_arm


def mixed_arm():
    """Tendons, springs and TCAs, a helix of less than two turns."""
    first = [Muscle(0.003, 0.3, 0.0, Tendon()), Muscle(0.003, 2.5, 0.0, TCA()), Muscle(0.003, 4.0, 0.0, Spring(30.0))]
    second = [Muscle(0.0035, 0.4, 1.7, TCA()), Muscle(0.003, 1.0, 0.0, Tendon())]
    modules = [
        Module.cylinder(0.045, 0.009, 0.125e6, 0.125e6 / 3.0, 3e-3, first),
        Module.cylinder(0.02, 0.007, 0.125e6, 0.125e6 / 3.0, 1e-3, second),
    ]
    return Arm(modules, (1.0, 0.0, 9.0), Payload(1e-3, (2e-3, 0.0, 5e-3)))


CASES = {
    "bending": (bending_arm(), [25.0, 120.0, 90.0], {}),
    "whole": (whole_arm(), [80.0, 40.0, 25.0, 110.0], {}),
    "whole, loaded": (whole_arm(), [60.0, 25.0, 25.0, 60.0], {"tip_force": (1e-3, 0.0, -2e-3), "payload": Payload(2e-3)}),
    "heavy": (Arm([bending_module()], GRAVITY, Payload(8e-3, BELOW_BENDING.centre)), [120.0, 25.0, 25.0], {}),
    "mixed": (mixed_arm(), [0.1, 90.0, 0.04, 80.0, 0.05], {"tip_force": (0.002, 0.003, 0.0)}),
    "no muscles": (Arm([Module.cylinder(0.1, 0.009, 0.125e6, 4e4, 6e-3)], (9.81, 0.0, 0.0)), [], {}),
}


def made(arm, drive, load):
    state = State(arm, np.array(drive, dtype=float), **load)
    known = arm.equilibrium(drive, **load)
    assert known.converged
    return state, known, reference(state, known)


def error(answer, expected):
    assert answer.converged
    return np.linalg.norm(answer.tip[:3, 3] - expected.tip[:3, 3])


@pytest.mark.parametrize(("arm", "drive", "load"), CASES.values(), ids=CASES.keys())
def test_converges_at_fourth_order(arm, drive, load):
    state, known, expected = made(arm, drive, load)
    solvers = [METHOD.build(arm, steps, [state]) for steps in (16, 32, 64)]
    errors = [error(solver.solve(state, solver.near(known, state)), expected) for solver in solvers]
    assert errors[-1] < 5e-8 * arm.length
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(4.0, abs=0.4)
    answer = solvers[-1].solve(state, solvers[-1].near(known, state))
    assert answer.tip[:3, :3] == pytest.approx(expected.tip[:3, :3], abs=1e-6)
    assert answer.tip[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert answer.guess.tension == pytest.approx(expected.tensions, abs=1e-7)


@pytest.mark.parametrize(("arm", "drive", "load"), CASES.values(), ids=CASES.keys())
def test_cold_start(arm, drive, load):
    """Newton goes straight to some of them; others take substeps."""
    state, _, expected = made(arm, drive, load)
    solver = METHOD.build(arm, 16, [state])
    assert error(solver.solve(state, solver.cold()), expected) < 1e-5 * arm.length


def test_keeps_an_equilibrium():
    """From its own answer it does not move; from a known equilibrium it moves no further than the steps' error."""
    arm = whole_arm()
    state, known, expected = made(arm, [25.0, 120.0, 90.0, 110.0], {})
    solver = METHOD.build(arm, 32, [state])
    guess = solver.near(known, state)
    first = solver.solve(state, guess)
    assert first.guess.moment == pytest.approx(guess.moment, abs=1e-3 * np.abs(guess.moment).max())
    assert first.guess.tension == pytest.approx(guess.tension, abs=1e-5)
    again = solver.solve(state, first.guess)
    assert error(again, expected) == pytest.approx(error(first, expected), abs=1e-12)
    assert again.guess.tension.tolist() == first.guess.tension.tolist()


def test_warm_start():
    """A step of drives, from an answer with its Jacobian; the guess that it starts from stays as it is."""
    arm = whole_arm()
    before, known, _ = made(arm, [40.0, 60.0, 25.0, 80.0], {})
    after, _, expected = made(arm, [46.0, 64.0, 25.0, 75.0], {})
    solver = METHOD.build(arm, 16, [before, after])
    guess = solver.solve(before, solver.near(known, before)).guess
    kept = Guess(*(x.copy() for x in guess))
    answer = solver.solve(after, guess)
    assert error(answer, expected) < 1e-6
    assert all((x == y).all() for x, y in zip(guess, kept, strict=True))
    assert error(solver.solve(after, guess), expected) == error(answer, expected)


@pytest.mark.parametrize(
    ("drive", "tip_force"),
    [([300.0] * 3, (0.0, 0.0, -3.0)), ([25.0] * 3, (1e8, 0.0, 0.0)), ([-20.0] * 3, (0.0, 1e300, 1e300))],
)
def test_failure_is_reported(drive, tip_force):
    """In bounded time."""
    arm = bending_arm()
    state = State(arm, np.array(drive), tip_force=tip_force)
    for steps in (METHOD.settings[0], METHOD.settings[-1]):
        solver = METHOD.build(arm, steps, [state])
        solver.solve(State(arm, np.full(3, 25.0)), solver.cold())
        begun = time.perf_counter()
        answer = solver.solve(state, solver.cold())
        assert time.perf_counter() - begun < 3.0
        assert not answer.converged
        assert answer.guess is None
