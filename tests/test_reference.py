"""The reference equilibria against closed forms, against collocation, and the order of the integrator behind them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from study.method import State
from study.reference import SETTLED, Guess, NoReference, carry, jacobian, mismatch, reference, segments
from study.wrench import RK4, RK8, STATE, rod
from tca_envs.mechanics import TCA, Arm, Grid, Module, Muscle, Payload, Spring, Tendon, section
from tca_envs.robots.paper import BELOW_BENDING, GRAVITY, bending_arm, bending_module, whole_arm

E, G, LENGTH, RADIUS, DENSITY = 0.125e6, 0.125e6 / 3.0, 0.045, 0.0045, 1070.0
AREA = np.pi * RADIUS**2
EI, GA, EA = E * np.pi * RADIUS**4 / 4.0, G * AREA, E * AREA


def cylinder(muscles=(), length=LENGTH, weighs=False):
    mass = DENSITY * AREA * length if weighs else 0.0
    return Module.cylinder(length, 2.0 * RADIUS, E, G, mass, muscles)


def straight(laws, offset=0.004):
    return [Muscle(offset, 2.0 * np.pi * i / 3.0, 0.0, law) for i, law in enumerate(laws)]


def fine(arm, elements=8):
    """The same arm on a much finer grid."""
    grids = [Grid(elements * (5 if any(muscle.turns for muscle in module.muscles) else 1), 8) for module in arm.modules]
    return Arm(arm.modules, arm.gravity, arm.payload, grids, residual_tolerance=1e-12)


def solved(arm, drive, **load):
    """The reference, from the equilibrium on the arm's own grid."""
    state = State(arm, np.array(drive, dtype=float), **load)
    known = arm.equilibrium(state.drive, state.tip_force, payload=state.payload)
    assert known.converged
    return reference(state, known)


# Closed forms


@pytest.mark.parametrize(
    ("tension", "place"), [(0.3, (0.0249404116, 0.0, 0.0314365278)), (1.2, (0.0027944622, 0.0, -0.0056561498))]
)
def test_straight_tendon(tension, place):
    found = solved(Arm([cylinder(straight([Tendon()]))]), [tension])
    curvature, stretch = tension * 0.004 / EI, 1.0 - tension / EA
    radius = stretch / curvature
    exact = [radius * (1.0 - np.cos(curvature * LENGTH)), 0.0, radius * np.sin(curvature * LENGTH)]
    assert found.tip[:3, 3] == pytest.approx(place, abs=1e-10)
    assert found.tip[:3, 3] == pytest.approx(exact, abs=1e-14)
    assert found.tip[:3, :3] == pytest.approx(Rotation.from_rotvec([0.0, curvature * LENGTH, 0.0]).as_matrix(), abs=1e-12)


def test_springs():
    active, rest = [1, 2], np.array([0.033, 0.033])
    muscles = straight([Spring(50.0)] * 3)
    found = solved(Arm([cylinder([muscles[i] for i in active])]), rest)
    places = np.array([muscles[i].offset * np.array([np.cos(muscles[i].angle), np.sin(muscles[i].angle)]) for i in active])
    exact = np.linalg.solve(np.eye(2) / 50.0 + LENGTH * (1.0 / EA + places @ places.T / EI), LENGTH - rest)
    assert found.tensions == pytest.approx(exact, abs=1e-13)
    assert found.tensions == pytest.approx([0.2980622] * 2, abs=1e-7)
    assert Rotation.from_matrix(found.tip[:3, :3]).magnitude() == pytest.approx(1.332690980, abs=1e-9)


def test_helix():
    length, radius, turns, tension = 0.016, 0.0035, 5.0, 0.2
    module = cylinder([Muscle(radius, 0.0, turns, Tendon())], length)
    found = solved(Arm([module]), [tension])
    # The strain is constant in the frame that turns with the muscle.
    rate = 2.0 * np.pi * turns / length
    route = np.array([[radius, 0.0, 0.0, radius * rate]])
    strain = section.solve(
        module.stiffness, module.reference_strain, route, np.array([tension]), np.zeros(6), module.reference_strain
    )
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = section.cross_matrix(strain[:3] + np.array([0.0, 0.0, rate])), strain[3:]
    exact = expm(length * twist)
    exact[:3, :3] = exact[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, -rate * length]).as_matrix()
    assert np.degrees(strain[2] * length) == pytest.approx(-23.655144, abs=1e-6)
    assert found.tip == pytest.approx(exact, abs=1e-11)


@pytest.mark.parametrize(("alpha", "across", "along"), [(1.0, 0.3017207738, 0.9435667637), (10.0, 0.8106090249, 0.4450044022)])
def test_bisshopp_drucker(alpha, across, along):
    hard = Arm([Module(LENGTH, cylinder().stiffness * [1.0, 1.0, 1.0, 1e9, 1e9, 1e9])])
    found = solved(hard, [], tip_force=(alpha * EI / LENGTH**2, 0.0, 0.0))
    assert found.tip[[0, 2], 3] / LENGTH == pytest.approx([across, along], abs=2e-10)


def test_small_loads():
    arm = Arm([cylinder()])
    across = solved(arm, [], tip_force=(1e-7, 0.0, 0.0))
    assert across.tip[0, 3] / 1e-7 == pytest.approx(LENGTH**3 / (3.0 * EI) + LENGTH / GA, rel=1e-9)
    assert across.tip[0, 3] / 1e-7 == pytest.approx(0.77148885, abs=1e-8)
    along = solved(arm, [], tip_force=(0.0, 0.0, 0.1))
    assert along.tip[2, 3] == pytest.approx(LENGTH * (1.0 + 0.1 / EA), abs=1e-15)


# The other solver

LONG = Arm([cylinder(straight([TCA()] * 3), 0.25, weighs=True)], GRAVITY)
CASES = {
    "bending, one hot": (bending_arm(), [135.0, 25.0, 25.0], {}),
    "bending, two hot": (bending_arm(), [25.0, 120.0, 90.0], {}),
    "bending, all hot": (bending_arm(), [150.0, 150.0, 150.0], {}),
    "bending, pulled": (bending_arm(), [60.0, 25.0, 25.0], {"tip_force": (0.002, 0.003, -0.01)}),
    "whole, cold": (whole_arm(), [25.0, 25.0, 25.0, 25.0], {}),
    "whole, hot": (whole_arm(), [150.0, 25.0, 25.0, 150.0], {}),
    "whole, carrying": (whole_arm(), [25.0, 120.0, 90.0, 100.0], {"payload": Payload(2.4e-3, (1e-3, 0.0, 9e-3))}),
    "long, under gravity": (LONG, [100.0, 25.0, 60.0], {}),
    "tendons, gravity across": (
        Arm([cylinder(straight([Tendon(), Tendon()]), 0.25, weighs=True)], (9.81, 0.0, 0.0)),
        [0.2, 0.1],
        {},
    ),
    "heavy": (Arm([bending_module()], GRAVITY, replace(BELOW_BENDING, mass=8e-3)), [25.0, 150.0, 110.0], {}),
}


@pytest.mark.parametrize(("arm", "drive", "load"), CASES.values(), ids=CASES.keys())
def test_agrees_with_collocation(arm, drive, load):
    other = fine(arm, 32 if arm.length > 0.2 else 8)
    known = other.equilibrium(drive, **load)
    assert known.converged
    found = solved(arm, drive, **load)  # from a coarser grid
    assert found.tip[:3, 3] == pytest.approx(known.tip_pose[:3, 3], abs=1e-12)
    assert found.tip[:3, :3] == pytest.approx(known.tip_pose[:3, :3], abs=2e-11)
    assert found.tensions == pytest.approx(known.tensions, abs=1e-11)
    assert found.residual < 1e-12
    assert found.error <= 1e-11 * arm.length


def test_says_how_far_it_moved():
    arm = bending_arm()
    state = State(arm, np.array([135.0, 25.0, 25.0]))
    known = arm.equilibrium(state.drive)
    found = reference(state, known)
    assert found.moved == pytest.approx(np.linalg.norm(found.tip[:3, 3] - known.tip_pose[:3, 3]))
    assert 1e-9 < found.moved < 1e-6  # the error of the arm's own grid
    again = reference(state, fine(arm).equilibrium(state.drive))
    assert again.moved < 1e-12
    assert again.tip == pytest.approx(found.tip, abs=1e-12)


def test_start_far_away_is_refused():
    arm = bending_arm()
    with pytest.raises(NoReference):
        reference(State(arm, np.array([25.0, 25.0, 25.0]), tip_force=(5.0, 0.0, -8.0)), arm.equilibrium([150.0, 25.0, 25.0]))


# The integrator


@pytest.mark.parametrize(("tableau", "steps", "order"), [(RK4, (16, 32, 64), 4), (RK8, (5, 7, 10), 8)])
def test_order(tableau, steps, order):
    """Initial value problems over both modules: no equilibria, all rates vary along them."""
    arm = Arm(whole_arm().modules, (1.0, 0.0, 3.0))
    tension, start = np.array([0.02, 0.022, 0.018, 0.06]), np.zeros((2, STATE))
    start[:, 0], start[:, 7:10] = 1.0, (2e-5, -1e-5, 3e-6)
    strains = np.array([module.reference_strain for module in arm.modules])
    load = arm.load((0.003, 0.001, -0.002))

    def ends(method, n):
        cut = rod(arm, method, [n, 3 * n], SETTLED)
        result, none = np.empty((2, STATE + 3)), np.empty((2, 0, 9))
        station = np.array([0, n * len(method.b)])
        assert carry(arm.model, cut, np.arange(2), station, cut.steps, start, strains.copy(), tension, load, result, none)
        return result[:, :11]  # of the second module's paths there is one

    exact = ends(RK8, 40)
    errors = np.array([np.abs(ends(tableau, n) - exact).max(axis=1) for n in steps])
    rates = np.log(errors[:-1] / errors[1:]) / np.log(np.divide(steps[1:], steps[:-1]))[:, np.newaxis]
    assert (errors[-1] > 1e-13).all()
    assert rates[-1] == pytest.approx([order, order], abs=0.6)


def test_jacobian():
    """Against central differences, at a state that is no equilibrium."""
    arm = Arm(
        [bending_module(), cylinder([Muscle(0.0035, 0.4, 1.7, TCA()), *straight([Tendon()])], 0.016)], GRAVITY, BELOW_BENDING
    )
    cut = segments(arm, 1)
    rng = np.random.default_rng(0)
    state = State(arm, np.array([40.0, 60.0, 80.0, 100.0, 0.05]), tip_force=(0.003, -0.002, 0.001))
    count = len(cut.module)
    starts = np.zeros((count, STATE))
    starts[:, 0], starts[:, 7:10] = 1.0, rng.normal(size=(count, 3)) * cut.unit
    strains = cut.arm.reference[cut.module]
    tension = rng.uniform(0.02, 0.1, 5)

    def at(step):
        guess = Guess(starts.copy(), strains.copy(), tension.copy())
        guess.move(cut, step)
        return guess

    size = 6 * count - 3 + 5
    here = 0.1 * rng.normal(size=size)
    here[-5:] = 0.0
    guess = at(here)
    result = jacobian(cut, guess, state)
    for j, step in enumerate(1e-4 * np.eye(size)):
        sides = []
        for sign in (1.0, -1.0):
            other = Guess(guess.starts.copy(), guess.strains.copy(), guess.tension.copy())
            other.move(cut, sign * step)
            sides.append(mismatch(cut, other, state)[0])
        # Rows of rotations are those of a vector at zero: only moments and lengths are exact away from the equilibrium.
        joints = (np.arange(size) // 3 % 2 == 0) & (np.arange(size) < 6 * count - 6)
        assert ((sides[0] - sides[1]) / 2e-4)[~joints] == pytest.approx(result[~joints, j], rel=1e-6, abs=1e-6)
