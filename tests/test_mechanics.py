"""The equilibrium of an arm: closed forms, derivatives, balance, convergence, symmetries, failed solves.

The rod of the closed forms has L = 45 mm, radius 4.5 mm, E = 0.125 MPa, G = E/3. Their tolerance is 1e-6 of
its length, and 1e-6 rad.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq, root
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from tca_envs.mechanics import TCA, Arm, Equilibrium, Grid, Module, Muscle, Payload, Rung, Spring, Tendon

Array = NDArray[np.float64]

L, RADIUS, E = 0.045, 0.0045, 0.125e6
EI, GJ, GA, EA = 4.025779179727e-5, 2.683852786e-5, 2.650718801, 7.952156404
WEIGHT = 0.667771  # of the rod [N/m], rho = 1070 kg/m3
G0 = 9.81
TIP = 1e-6 * L
AXIS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

# The same examples in every run: a verdict on the code, not on the draw. Shrinking would take minutes.
few = settings(max_examples=12, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.reuse, Phase.generate])


def rod(muscles: Sequence[Muscle] = (), length: float = L, mass: float = 0.0, rigid: bool = False, **kw: Any) -> Module:
    """The test rod; `rigid` takes its shear and extension away."""
    module = Module.cylinder(length, 2.0 * RADIUS, E, E / 3.0, mass, muscles, **kw)
    if rigid:
        module = replace(module, stiffness=module.stiffness * [1.0, 1.0, 1.0, 1e5, 1e5, 1e5])
    return module


def three(law: Any, offset: float = 0.004) -> list[Muscle]:
    return [Muscle(offset, 2.0 * np.pi * i / 3.0, 0.0, law) for i in range(3)]


def tendon(offset: float, angle: float = 0.0, turns: float = 0.0) -> Muscle:
    return Muscle(offset, angle, turns, Tendon())


def paper_module(grids: list[Grid] | None = None, residual_tolerance: float = 1e-9) -> Arm:
    """The paper's bending module with the rest of the arm below it: soft, heavy, strongly nonlinear."""
    module = Module.cylinder(L, 0.0045, E, E / 3.0, 3.9e-3, three(TCA()))
    return Arm([module], (0.0, 0.0, G0), Payload(2.1e-3, (0.0, 0.0, 0.012)), grids, residual_tolerance)


paper = cache(paper_module)


def matrix(x: ArrayLike) -> Array:
    """[x] with [x] y = x cross y."""
    a, b, c = np.asarray(x)
    return np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])


def twist(xi: Array) -> Array:
    """xi^: (4, 4) of xi = [u; v]."""
    result = np.zeros((4, 4))
    result[:3, :3], result[:3, 3] = matrix(xi[:3]), xi[3:]
    return result


def rotation_vector(a: Array, b: Array) -> Array:
    """phi with exp([phi]) b = a."""
    return Rotation.from_matrix(a @ b.T).as_rotvec()


def apart(a: Array, b: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    return (
        float(np.linalg.norm(a[:3, 3] - b[:3, 3])),
        float(np.linalg.norm(rotation_vector(a[:3, :3], b[:3, :3]))),
    )


def same_pose(a: Array, b: Array, distance: float = TIP, angle: float = 1e-6) -> bool:
    d, phi = apart(a, b)
    return d < distance and phi < angle


class Case(NamedTuple):
    arm: Arm
    drive: tuple[float, ...]
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    step: float = 0.01  # of the drive, for central differences

    def solve(self, drive: ArrayLike | None = None, start: Equilibrium | None = None) -> Equilibrium:
        return self.arm.equilibrium(self.drive if drive is None else drive, self.force, self.moment, start)


def two_modules() -> Arm:
    bending = Module.cylinder(L, 0.0045, E, E / 3.0, 3.9e-3, three(TCA()))
    twisting = Module.cylinder(0.016, 0.0045, E, E / 3.0, 1.2e-3, [Muscle(0.0035, 0.0, 5.0, TCA())])
    return Arm([bending, twisting], (0.0, 0.0, G0), Payload(2.4e-3, (0.001, 0.0, 0.01)), residual_tolerance=1e-11)


def ring() -> Module:
    """Like the gripper: two thirds of a ring, a muscle on its outside; three different stiffnesses."""
    stiffness = np.array([2.1e-5, 1.6e-5, 2.0e-5, 0.75, 0.75, 2.25])
    reference = np.array([0.0, 2.0 * np.pi / 0.0525, 0.0, 0.0, 0.0, 1.0])
    return Module(0.035, stiffness, 0.026, [tendon(0.0025, np.pi)], reference)


CASES = {
    "three TCAs, gravity, payload": lambda: Case(paper_module(residual_tolerance=1e-11), (130.0, 60.0, 30.0)),
    "three springs": lambda: Case(
        Arm([rod(three(Spring(50.0)))], residual_tolerance=1e-12),
        (0.042, 0.033, 0.035),
        (0.02, 0.01, -0.03),
        step=1e-6,
    ),
    "tendons, tip force": lambda: Case(
        Arm([rod([tendon(0.004), tendon(0.003, 2.0, 0.6)], mass=2e-3)], (G0, 0.0, 0.0), residual_tolerance=1e-12),
        (0.3, 0.15),
        (0.02, -0.03, 0.05),
        step=1e-5,
    ),
    "two modules, one helical TCA": lambda: Case(two_modules(), (110.0, 40.0, 60.0, 120.0)),
    "out-of-plane tip moment": lambda: Case(
        Arm([rod([tendon(0.004)])], residual_tolerance=1e-12),
        (0.3,),
        (0.0, 0.0, 0.02),
        (8e-4, 0.0, 4e-4),
        step=1e-5,
    ),
    "curved ring": lambda: Case(
        Arm([ring()], (0.0, G0, 0.0), Payload(1.5e-3, (0.0, 0.001, 0.0)), residual_tolerance=1e-12),
        (0.2,),
        (0.0, 0.01, 0.0),
        step=1e-5,
    ),
    "tendons that end halfway": lambda: Case(
        Arm(
            [rod([tendon(0.004), tendon(0.004, 1.5)], 0.025), rod([tendon(0.003, 3.0)], 0.03, 1e-3)],
            (0.0, -G0, 0.0),
            residual_tolerance=1e-12,
        ),
        (0.4, 0.2, 0.3),
        (0.0, 0.01, 0.01),
        (1e-4, 0.0, 0.0),
        step=1e-5,
    ),
}
in_every_case = pytest.mark.parametrize("name", CASES)


@cache
def solved(name: str) -> tuple[Case, Equilibrium]:
    case = CASES[name]()
    result = case.solve()
    assert result.converged, result.message
    return case, result


@cache
def solved_finely(name: str) -> tuple[Case, Equilibrium]:
    """Between its nodes the shape is a polynomial: a fine grid for what is compared there."""
    case = CASES[name]()
    arm = case.arm
    grids = [Grid(4 * elements, nodes) for elements, nodes in arm.grids]
    case = case._replace(arm=Arm(arm.modules, arm.gravity, arm.payload, grids, arm.residual_tolerance))
    result = case.solve()
    assert result.converged, result.message
    return case, result


def no_nan(result: Equilibrium) -> bool:
    return all(np.isfinite(x).all() for x in (result.tip_pose, result.tensions, result.muscle_lengths, result.poses([0.01])))


# Closed forms.


def test_the_round_section_has_the_closed_form_stiffness():
    assert rod().stiffness == pytest.approx([EI, EI, GJ, GA, GA, EA], rel=1e-9)


@pytest.mark.parametrize(
    ("tension", "tip", "length"),
    [
        (0.3, (0.0249404116, 0.0, 0.0314365278), 0.0379369263),
        (
            1.2,
            (0.0027944622, 0.0, -0.0056561498),
            None,
        ),  # rolled up beyond half a turn: the cold start must get there
    ],
)
def test_a_straight_tendon_bends_the_rod_to_an_arc(tension, tip, length):
    result = Arm([rod([tendon(0.004)])]).equilibrium([tension])
    assert result.converged
    assert result.tip_pose[:3, 3] == pytest.approx(tip, abs=TIP)
    assert result.tensions == pytest.approx([tension])
    if length is not None:
        assert result.strain([0.0])[0] == pytest.approx([0, 29.807894234, 0, 0, 0, 0.962274384], abs=1e-6)
        assert result.muscle_lengths == pytest.approx([length], abs=TIP)


@few
@given(
    st.lists(
        st.tuples(st.floats(0.0, 0.005), st.floats(-np.pi, np.pi), st.floats(0.0, 0.4)),
        min_size=1,
        max_size=4,
    )
)
def test_straight_tendons_add_up(routes):
    """u_x = -sum F y/EI, u_y = sum F x/EI, v_z = 1 - sum F/EA: constant, so the pose is one exponential."""
    result = Arm([rod([tendon(r, a) for r, a, _ in routes])]).equilibrium([f for *_, f in routes])
    x, y = np.array([(r * np.cos(a), r * np.sin(a)) for r, a, _ in routes]).T
    force = np.array([f for *_, f in routes])
    u_x, u_y, v_z = -force @ y / EI, force @ x / EI, 1.0 - force.sum() / EA
    assert result.converged
    assert same_pose(result.tip_pose, expm(L * twist(np.array([u_x, u_y, 0.0, 0.0, 0.0, v_z]))))
    assert result.muscle_lengths == pytest.approx(L * (v_z + u_x * y - u_y * x), abs=TIP)


def test_a_straight_tendon_collapses_the_rod_at_the_critical_tension():
    """The path shrinks in proportion to the tension; where it is a point, the equilibria end."""
    arm = Arm([rod([tendon(0.004)])])
    critical = 1.0 / (1.0 / EA + 0.004**2 / EI)
    assert critical == pytest.approx(1.911349, abs=1e-6)
    for tension in (1.5, 1.9, 0.999 * critical):
        result = arm.equilibrium([tension])
        assert result.converged
        assert result.muscle_lengths == pytest.approx([L * (1.0 - tension / critical)], abs=TIP)
    assert not arm.equilibrium([1.002 * critical]).converged


def test_three_springs_solve_their_linear_system():
    """(I/k + L C) F = L 1 - l0 with C_ij = 1/EA + r_i.r_j/EI; the ratio is what a passive muscle costs."""
    bend = []
    for angles, tensions, expected in (
        ([0, 1, 2], (0.11526673, 0.30746311, 0.30746311), 0.859345402),
        ([1, 2], (0.2980622, 0.2980622), 1.332690980),
    ):
        muscles = [three(Spring(50.0))[i] for i in angles]
        rest = np.array([0.042, 0.033, 0.033])[angles]
        r = np.array([(m.offset * np.cos(m.angle), m.offset * np.sin(m.angle)) for m in muscles])
        force = np.linalg.solve(np.eye(len(r)) / 50.0 + L * (1.0 / EA + r @ r.T / EI), L - rest)
        result = Arm([rod(muscles)]).equilibrium(rest)
        assert result.converged
        assert force == pytest.approx(tensions, abs=2e-8)
        assert result.tensions == pytest.approx(force, abs=1e-7)
        assert result.muscle_lengths == pytest.approx(rest + force / 50.0, abs=TIP)
        bend.append(np.linalg.norm(rotation_vector(result.tip_pose[:3, :3], np.eye(3))))
        assert bend[-1] == pytest.approx(expected, abs=1e-6)
    assert bend[1] / bend[0] == pytest.approx(1.5508, abs=5e-5)


@pytest.mark.parametrize(
    ("length", "turns", "tension"), [(0.016, 5.0, 0.2), (0.016, -5.0, 0.2), (0.016, 5.0, 0.5), (L, 2.0, 0.4)]
)
def test_a_helical_tendon_winds_the_rod(length, turns, tension):
    """In the frame that turns with the muscle the strain is constant: K dxi = -F [r x t; t]."""
    offset, k = 0.0035, 2.0 * np.pi * turns / length
    arm = Arm([rod([tendon(offset, 0.0, turns)], length)])
    r, stiffness = np.array([offset, 0.0, 0.0]), arm.modules[0].stiffness

    def path(dxi: Array) -> Array:
        xi = AXIS + dxi
        return xi[3:] + np.cross(xi[:3], r) + np.array([0.0, k * offset, 0.0])

    def imbalance(dxi: Array) -> Array:
        t = path(dxi) / np.linalg.norm(path(dxi))
        return dxi + tension * np.concatenate([np.cross(r, t), t]) / stiffness

    dxi = root(imbalance, np.zeros(6), tol=1e-13).x
    assert np.abs(imbalance(dxi)).max() < 1e-9
    spin = twist(np.array([0.0, 0.0, k, 0.0, 0.0, 0.0]))
    expected = expm(length * (twist(AXIS + dxi) + spin)) @ expm(-length * spin)
    result = arm.equilibrium([tension])
    assert result.converged
    assert same_pose(result.tip_pose, expected, 1e-6 * length)
    assert result.muscle_lengths == pytest.approx([length * np.linalg.norm(path(dxi))], abs=1e-6 * length)
    assert result.strain([0.0, 0.3 * length])[:, 2] == pytest.approx(dxi[2], abs=1e-6 / length)
    if (turns, tension) == (5.0, 0.2):
        # The twist is that of the section about its own axis, u_z L; the yaw of the tip is 0.0015 deg less.
        assert np.degrees(dxi[2] * length) == pytest.approx(-23.655144, abs=1e-6)
        assert result.muscle_lengths == pytest.approx([0.1084731904], abs=1e-6 * length)


@pytest.mark.parametrize(
    ("alpha", "deflection", "height"), [(1.0, 0.3017207738, 0.9435667637), (10.0, 0.8106090249, 0.4450044022)]
)
def test_a_tip_force_bends_an_inextensible_rod_to_the_elastica(alpha, deflection, height):
    """Bisshopp & Drucker (1945), by elliptic integrals of modulus p with 2 p^2 = 1 + sin(tip angle)."""
    m = brentq(
        lambda m: ellipk(m) - ellipkinc(np.arcsin(1.0 / np.sqrt(2.0 * m)), m) - np.sqrt(alpha),
        0.5 + 1e-12,
        1 - 1e-12,
    )
    start = np.arcsin(1.0 / np.sqrt(2.0 * m))
    exact = (
        1.0 - 2.0 * (ellipe(m) - ellipeinc(start, m)) / np.sqrt(alpha),
        np.sqrt(2.0 * (2.0 * m - 1.0) / alpha),
    )
    assert exact == pytest.approx((deflection, height), abs=1e-9)
    result = Arm([rod(rigid=True)]).equilibrium([], (alpha * EI / L**2, 0.0, 0.0))
    assert result.converged
    x, y, z = result.tip_pose[:3, 3] / L
    assert (x, y, z) == pytest.approx((exact[0], 0.0, exact[1]), abs=1e-6)


def test_a_small_tip_force_bends_and_shears():
    """Timoshenko's beam, to first order in the load."""
    slope = L**3 / (3.0 * EI) + L / GA
    assert slope == pytest.approx(0.77148885, abs=1e-8)
    result = Arm([rod()]).equilibrium([], (0.0, 1e-5, 0.0))
    assert result.tip_pose[1, 3] / 1e-5 == pytest.approx(slope, rel=1e-6)


def test_a_tip_moment_closes_the_rod_to_a_circle():
    result = Arm([rod()]).equilibrium([], tip_moment=(0.0, 2.0 * np.pi * EI / L, 0.0))
    assert result.converged
    assert same_pose(result.tip_pose, np.eye(4))
    top = result.poses([L / 2.0])[0]
    assert top[:3, 3] == pytest.approx([L / np.pi, 0.0, 0.0], abs=TIP)


def test_a_curved_rod_stays_curved_without_load():
    module = replace(ring(), muscles=())
    result = Arm([module], residual_tolerance=1e-12).equilibrium([])
    assert same_pose(result.tip_pose, expm(0.035 * twist(module.reference_strain)), 1e-8 * L, 1e-8)
    assert result.strain([0.01]) == pytest.approx(module.reference_strain[np.newaxis], abs=1e-9)


# Buckling.

CRITICAL = 0.048462219


def zero(f: Callable[[float], float], guess: float) -> float:
    """Zero of a smooth function, from below `guess`: beyond it, the straight rod is no answer."""
    low, high = 0.998 * guess, 0.999 * guess
    at_low, at_high = f(low), f(high)
    assert at_low > at_high > 0.0
    return low + (high - low) * at_low / (at_low - at_high)


def lateral_stiffness(arm: Arm, weight: float) -> float:
    return 1e-9 / arm.equilibrium([], (1e-9, 0.0, -weight)).tip_pose[0, 3]


def test_the_lateral_stiffness_vanishes_at_the_critical_tip_weight():
    """P (1 + P (1/GA - 1/EA)) = pi^2 EI/(4 L^2): shear softens the column, compression shortens it."""
    euler = np.pi**2 * EI / (4.0 * L**2)
    shear = 1.0 / GA - 1.0 / EA
    critical = (np.sqrt(1.0 + 4.0 * euler * shear) - 1.0) / (2.0 * shear)
    assert critical == pytest.approx(CRITICAL, abs=1e-9)
    arm = Arm([rod()], residual_tolerance=1e-12)
    assert zero(lambda weight: lateral_stiffness(arm, weight), critical) == pytest.approx(critical, rel=1e-5)


def test_the_lateral_stiffness_vanishes_at_greenhills_length():
    def standing(length: float) -> Arm:
        return Arm([rod(length=length, mass=WEIGHT / G0 * length, rigid=True)], (0, 0, -G0), residual_tolerance=1e-12)

    critical = (7.83734744 * EI / WEIGHT) ** (1.0 / 3.0)
    assert critical == pytest.approx(0.077886787, abs=1e-7)
    assert zero(lambda length: lateral_stiffness(standing(length), 0.0), critical) == pytest.approx(critical, rel=1e-5)


def pushed_and_released(arm: Arm, weight: float) -> Equilibrium:
    """Load the rod from the side and from above, then let go of the side, in steps that keep to one branch."""
    side = 0.02
    loads = [(part * side, 0.0, -part * weight) for part in np.linspace(0.1, 1.0, 10)]
    loads += [(part * side, 0.0, -weight) for part in np.linspace(0.9, 0.0, 10)]
    result = None
    for load in loads:
        result = arm.equilibrium([], load, start=result)
        assert result.converged
    assert result is not None
    return result


@pytest.mark.parametrize("ratio", [0.5, 0.9])
def test_a_column_below_the_critical_weight_stands(ratio):
    arm = Arm([rod()])
    # A push of 1e-4 of the weight is amplified by 1/(1 - ratio): nearly straight all the same.
    assert abs(arm.equilibrium([], (1e-4 * ratio * CRITICAL, 0.0, -ratio * CRITICAL)).tip_pose[0, 3]) < 2e-3 * L
    assert abs(pushed_and_released(arm, ratio * CRITICAL).tip_pose[0, 3]) < TIP


@pytest.mark.parametrize("ratio", [1.05, 1.2, 1.5])
def test_a_column_above_the_critical_weight_stays_bent(ratio):
    """The elastica: with k = sqrt(P/EI), k L = K(p), deflection 2 p/k, height 2 E(p)/k - L."""
    weight = ratio * np.pi**2 * EI / (4.0 * L**2)
    k = np.sqrt(weight / EI)
    m = brentq(lambda m: ellipk(m) - k * L, 1e-9, 1.0 - 1e-9, xtol=1e-14)
    result = pushed_and_released(Arm([rod(rigid=True)]), weight)
    expected = (2.0 * np.sqrt(m) / k, 0.0, 2.0 * ellipe(m) / k - L)
    # Near the critical load the bend is the square root of the excess: the residual shear shows a little.
    assert result.tip_pose[:3, 3] == pytest.approx(expected, abs=(1e-4 if ratio < 1.1 else 2e-5) * L)


@pytest.mark.parametrize(("length", "stands"), [(0.07, True), (0.085, False)])
def test_a_rod_stands_under_its_own_weight_up_to_greenhills_length(length, stands):
    module = rod(length=length, mass=WEIGHT / G0 * length)
    result = None
    for part in np.linspace(0.1, 1.0, 10):  # weight and push grow together, as in `pushed_and_released`
        arm = Arm([module], (0.0, 0.0, -part * G0))
        result = arm.equilibrium([], (part * 0.02, 0.0, 0.0), start=result)
    for part in np.linspace(0.9, 0.0, 10):
        result = arm.equilibrium([], (part * 0.02, 0.0, 0.0), start=result)
        assert result.converged
    away = abs(result.tip_pose[0, 3])
    assert away < 1e-6 * length if stands else away > 0.5 * length


# Derivatives.


@in_every_case
def test_the_tip_jacobian_is_the_derivative_of_the_tip(name):
    case, result = solved(name)
    jacobian = result.tip_jacobian
    assert jacobian.shape == (6, len(case.drive))
    for i in range(len(case.drive)):
        step = np.zeros(len(case.drive))
        step[i] = case.step
        ahead, behind = (case.solve(case.drive + sign * step, result) for sign in (1.0, -1.0))
        assert ahead.converged and behind.converged
        difference = np.concatenate(
            [
                ahead.tip_pose[:3, 3] - behind.tip_pose[:3, 3],
                rotation_vector(ahead.tip_pose[:3, :3], behind.tip_pose[:3, :3]),
            ]
        ) / (2.0 * case.step)
        metres = np.repeat([1.0 / case.arm.length, 1.0], 3)  # position and angle on one scale
        error = np.linalg.norm(metres * (jacobian[:, i] - difference))
        assert error < 1e-5 * np.linalg.norm(metres * difference)


def test_the_tip_jacobian_of_an_arm_without_muscles_is_empty():
    assert Arm([rod()]).equilibrium([]).tip_jacobian.shape == (6, 0)


# Shape and balance.


@in_every_case
def test_the_shape_ends_in_the_tip_pose_and_begins_at_the_origin(name):
    case, result = solved(name)
    length = case.arm.length
    first, last = result.poses([0.0, length])
    assert np.array_equal(first, np.eye(4))
    assert same_pose(last, result.tip_pose, 1e-12, 1e-7)
    line = result.centerline(7)
    assert line.shape == (7, 3)
    assert line == pytest.approx(result.poses(np.linspace(0.0, length, 7))[:, :3, 3], abs=1e-15)
    assert result.centerline().shape == (50, 3)


@in_every_case
def test_cross_sections_are_rigid_and_follow_the_strain(name):
    """R^T R = 1, R' = R [u], p' = R v, between the nodes too."""
    case, result = solved_finely(name)
    h = 1e-7
    s = np.random.default_rng(3).uniform(h, case.arm.length - h, 12)
    behind, here, ahead = result.poses(np.concatenate([s - h, s, s + h])).reshape(3, -1, 4, 4)
    for a, g, b, strain in zip(behind, here, ahead, result.strain(s), strict=True):
        r = g[:3, :3]
        assert np.abs(r.T @ r - np.eye(3)).max() < 1e-12
        assert np.linalg.det(r) == pytest.approx(1.0)
        assert g[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        u = rotation_vector(r.T @ b[:3, :3], r.T @ a[:3, :3]) / (2.0 * h)
        v = r.T @ (b[:3, 3] - a[:3, 3]) / (2.0 * h)
        assert np.linalg.norm(u - strain[:3]) * case.arm.length < 1e-5
        assert np.linalg.norm(v - strain[3:]) < 1e-5


def internal_wrench(arm: Arm, result: Equilibrium, s: float) -> Array:
    """K (xi - xi*) + sum F [r x t; t] at s, body frame: what rod and muscles carry."""
    xi = result.strain([s])[0]
    first, begin = 0, 0.0
    for module in arm.modules[:-1]:
        if s < begin + module.length:
            break
        first, begin = first + len(module.muscles), begin + module.length
    else:
        module = arm.modules[-1]
    wrench = module.stiffness * (xi - module.reference_strain)
    for muscle, force in zip(module.muscles, result.tensions[first:], strict=False):
        rate = 2.0 * np.pi * muscle.turns / module.length
        angle = muscle.angle + rate * (s - begin)
        r = muscle.offset * np.array([np.cos(angle), np.sin(angle), 0.0])
        t = xi[3:] + np.cross(xi[:3], r) + rate * np.array([-r[1], r[0], 0.0])
        t /= np.linalg.norm(t)
        wrench += force * np.concatenate([np.cross(r, t), t])
    return wrench


def external_wrench(case: Case, result: Equilibrium, s: float) -> Array:
    """Moment about p(s) and force of all loads beyond s, base frame, integrated over the returned shape."""
    arm, gravity = case.arm, case.arm.gravity
    here = result.poses([s])[0, :3, 3]
    tip = result.tip_pose
    force, moment = np.array(case.force), np.array(case.moment) + np.cross(tip[:3, 3] - here, case.force)
    if arm.payload is not None:
        lever = tip[:3, 3] + tip[:3, :3] @ arm.payload.centre - here
        force = force + arm.payload.mass * gravity
        moment = moment + np.cross(lever, arm.payload.mass * gravity)
    x, w = np.polynomial.legendre.leggauss(6)
    begin = 0.0
    for module in arm.modules:
        low, begin = max(begin, s), begin + module.length
        if module.mass_per_length > 0.0 and low < begin:
            half = (begin - low) / 16.0
            middle = low + half * np.arange(1, 16, 2)
            levers = result.poses((middle[:, np.newaxis] + half * x).ravel())[:, :3, 3] - here
            masses = np.tile(module.mass_per_length * half * w, len(middle))
            force = force + masses.sum() * gravity
            moment = moment + np.cross(masses @ levers, gravity)
    return np.concatenate([moment, force])


@in_every_case
def test_rod_and_muscles_carry_the_loads_beyond_every_section(name):
    """Global balance, by quadrature over the returned shape; nothing of the solver's own residual enters."""
    case, result = solved_finely(name)
    module = case.arm.modules[0]
    for s in (0.0, *np.random.default_rng(5).uniform(0.0, case.arm.length, 3), case.arm.length):
        r = result.poses([s])[0, :3, :3]
        carried = internal_wrench(case.arm, result, s)
        loads = external_wrench(case, result, s)
        loads = np.concatenate([r.T @ loads[:3], r.T @ loads[3:]])
        error = np.abs(carried - loads) / module.stiffness * np.repeat([case.arm.length, 1.0], 3)
        assert error.max() < 1e-6


def test_where_muscles_end_the_strain_jumps_and_the_wrench_does_not():
    case, result = solved("tendons that end halfway")
    joint = case.arm.modules[0].length
    before, after = result.strain([joint - 1e-9, joint])
    assert np.linalg.norm((after - before)[:3]) > 10.0
    jump = internal_wrench(case.arm, result, joint) - internal_wrench(case.arm, result, joint - 1e-9)
    assert np.abs(jump / case.arm.modules[0].stiffness * np.repeat([L, 1.0], 3)).max() < 1e-6


@in_every_case
def test_muscle_lengths_are_those_of_the_curves_in_space(name):
    case, result = solved(name)
    first, begin = 0, 0.0
    for module in case.arm.modules:
        s = np.linspace(0.0, module.length, 161)
        poses = result.poses(np.minimum(begin + s, case.arm.length))
        for i, muscle in enumerate(module.muscles):
            angle = muscle.angle + 2.0 * np.pi * muscle.turns * s / module.length
            r = muscle.offset * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            curve = poses[:, :3, 3] + np.einsum("nij,nj->ni", poses[:, :3, :2], r)
            chords, long_chords = (np.linalg.norm(np.diff(curve[::stride], axis=0), axis=1).sum() for stride in (1, 2))
            # A chord falls short of its arc by the square of its length: extrapolated.
            arc = (4.0 * chords - long_chords) / 3.0
            assert result.muscle_lengths[first + i] == pytest.approx(arc, rel=1e-5)
        first, begin = first + len(module.muscles), begin + module.length


def test_muscles_obey_their_laws():
    case, result = solved("two modules, one helical TCA")
    rest = np.array([L, L, L, 0.016 * np.hypot(1.0, 2.0 * np.pi * 5.0 * 0.0035 / 0.016)])
    f, t = result.tensions, np.array(case.drive)
    assert (f > 0.0).all() and (f < 0.8).all()
    untwist = -0.0161 * (t**2 - 25.0**2) + 0.3338 * (t - 25.0)
    modulus = 20.85e6 + 111.33e6 * f - 37.58e6 * f**2
    elongation = rest / 0.045 * (5.116e-5 * untwist + 2.3725e6 * f / modulus)
    assert result.muscle_lengths == pytest.approx(rest + elongation, rel=1e-9)
    springs, result = solved("three springs")
    assert result.muscle_lengths == pytest.approx(np.array(springs.drive) + result.tensions / 50.0, rel=1e-9)


@pytest.mark.parametrize("turns", [0.0, 1.3, -5.0])
def test_the_rest_length_is_the_path_in_the_unloaded_rod(turns):
    muscle = tendon(0.003, 0.7, turns)
    module = Module.cylinder(0.035, 0.006, E, E / 3.0, muscles=[muscle], curvature=(20.0, 150.0, 30.0))
    rate = 2.0 * np.pi * turns / module.length

    def stretch(s: float) -> float:
        r = 0.003 * np.array([np.cos(0.7 + rate * s), np.sin(0.7 + rate * s), 0.0])
        return float(np.linalg.norm([0, 0, 1] + np.cross([20.0, 150.0, 30.0], r) + rate * np.array([-r[1], r[0], 0])))

    assert module.rest_length(muscle) == pytest.approx(quad(stretch, 0.0, 0.035, limit=200)[0], rel=1e-8)


# Convergence.

celsius = st.floats(25.0, 160.0)
SLACK = -1e-3  # [N]: all that a coil pushes with
HOT = [
    (25.0, 25.0, 25.0),
    (100.0, 25.0, 25.0),
    (150.0, 25.0, 25.0),
    (160.0, 160.0, 25.0),
    (25.0, 160.0, 90.0),
]


@pytest.mark.parametrize("drive", HOT)
def test_a_refined_grid_moves_the_tip_less_than_a_micrometre(drive):
    coarse = paper_module([Grid(1, 8)]).equilibrium(drive)
    fine = paper_module([Grid(10, 8)]).equilibrium(drive)
    assert coarse.converged and fine.converged
    assert np.linalg.norm(coarse.tip_pose[:3, 3] - fine.tip_pose[:3, 3]) < 1e-6


@in_every_case
def test_the_default_grid_resolves_the_tip_to_a_millionth_of_the_length(name):
    (case, result), (_, fine) = solved(name), solved_finely(name)
    assert np.linalg.norm(result.tip_pose[:3, 3] - fine.tip_pose[:3, 3]) < 1e-6 * case.arm.length
    assert result.tensions == pytest.approx(fine.tensions, rel=1e-5)


@settings(few, max_examples=100)
@given(st.tuples(celsius, celsius, celsius))
@example((160.0, 160.0, 160.0))
@example((160.0, 25.0, 25.0))
@example((160.0, 160.0, 25.0))
def test_the_heavy_soft_module_is_solved_from_cold_at_any_temperature(drive):
    result = paper().equilibrium(drive)
    assert result.converged, result.message
    assert result.residual < paper().residual_tolerance
    assert (result.tensions > SLACK).all()


up_to_140 = st.floats(25.0, 140.0)


@settings(few, max_examples=100)
@given(st.tuples(up_to_140, up_to_140, up_to_140), st.tuples(up_to_140, up_to_140, up_to_140))
@example((25.0, 25.0, 25.0), (140.0, 25.0, 25.0))
@example((140.0, 25.0, 25.0), (25.0, 140.0, 25.0))
@example((140.0, 140.0, 140.0), (140.0, 25.0, 25.0))
def test_a_jump_ends_where_the_cold_start_does(before, after):
    """One equilibrium up to 140 degC, whatever the history. Beyond, branches fold (next test)."""
    warm = paper().equilibrium(after, start=paper().equilibrium(before))
    cold = paper().equilibrium(after)
    assert warm.converged, warm.message
    assert same_pose(warm.tip_pose, cold.tip_pose, 1e-8, 1e-6)
    assert warm.tensions == pytest.approx(cold.tensions, abs=1e-7)


FOLDS = [
    # Cooling the third muscle from here, the branch folds at 150.6 degC: the tip swings round to another one.
    ((25.0, 160.0, 160.0), (25.0, 160.0, 25.0)),
    ((160.0, 25.0, 25.0), (160.0, 160.0, 25.0)),
    ((95.6636882, 37.00631143, 157.56226357), (102.13840606, 25.86519916, 129.30764217)),
]


@pytest.mark.parametrize(("before", "after"), FOLDS)
def test_across_a_fold_the_arm_comes_to_rest_at_the_same_place_on_every_grid(before, after):
    tips = []
    for arm in (paper(), paper_module([Grid(4, 8)])):
        result = arm.equilibrium(after, start=arm.equilibrium(before))
        assert result.converged
        again = arm.equilibrium(after, start=result)  # it rests there
        assert again.iterations == 0
        tips.append(result.tip_pose[:3, 3])
    # Where it falls is a matter of the arm, not of the grid.
    assert np.linalg.norm(tips[0] - tips[1]) < 1e-6


@settings(few, max_examples=60)
@given(st.tuples(celsius, celsius, celsius), st.tuples(celsius, celsius, celsius))
@example((25.0, 25.0, 25.0), (160.0, 160.0, 160.0))
@example((160.0, 25.0, 25.0), (25.0, 160.0, 25.0))
def test_a_full_range_jump_ends_at_an_equilibrium(before, after):
    result = paper().equilibrium(after, start=paper().equilibrium(before))
    assert result.converged, result.message
    assert result.residual < paper().residual_tolerance
    assert (result.tensions > SLACK).all()
    assert no_nan(result)


@pytest.mark.parametrize("force", [0.1, 0.5, 0.8, 1.0, 1.5, 2.0])
def test_a_large_tip_force_from_cold_ends_where_a_slow_one_does(force):
    """Several equilibria exist at such a load; the one asked for continues the unloaded arm."""
    arm = Arm([rod()])
    slow = None
    for part in np.linspace(0.0, force, 41)[1:]:
        slow = arm.equilibrium([], (part, 0.0, 0.0), start=slow)
        assert slow.converged
    cold = arm.equilibrium([], (force, 0.0, 0.0))
    assert cold.converged
    assert same_pose(cold.tip_pose, slow.tip_pose)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_buckled_column_that_is_pushed_back_snaps_through_and_says_so(side):
    """Buckled to one side, it bears a small push from there; a larger one ends its branch, and it falls to the other.

    The column is flat, or it would turn about its axis on the smallest push.
    """
    arm = Arm([Module(L, np.array([4.0 * EI, EI, GJ, GA, GA, EA]))])
    buckled = None
    for push, weight in ((0.01, 0.0), (0.01, 0.06), (0.001, 0.06)):
        buckled = arm.equilibrium([], (side * push, 0.0, -weight), start=buckled)
    held = arm.equilibrium([], (-side * 0.002, 0.0, -0.06), start=buckled)
    fallen = arm.equilibrium([], (-side * 0.01, 0.0, -0.06), start=buckled)
    assert held.converged and fallen.converged
    assert side * held.tip_pose[0, 3] > 0.02
    assert side * fallen.tip_pose[0, 3] < -0.02
    assert (held.jumped, fallen.jumped) == (False, True)
    assert fallen.rung == Rung.DESCENT and "fell" in fallen.message
    assert arm.equilibrium([], (-side * 0.01, 0.0, -0.06), start=fallen).iterations == 0


# Symmetries.

routes = st.lists(
    st.tuples(st.floats(0.0, 0.004), st.floats(-3.0, 3.0), st.floats(-1.0, 1.0), st.floats(0.0, 0.3)),
    min_size=1,
    max_size=2,
)
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def loaded(
    layout: Sequence[tuple[float, float, float, float]],
    pull: Array,
    turn: Array,
    hang: Array,
    scale: float = 1.0,
) -> Equilibrium:
    """A rod of `scale` times the test rod's size with tendons (offset, angle, turns, tension)."""
    muscles = [tendon(scale * r, a, n) for r, a, n, _ in layout]
    module = Module.cylinder(scale * L, scale * 2.0 * RADIUS, E, E / 3.0, scale**2 * 2e-3, muscles)
    arm = Arm(
        [module],
        G0 * hang,
        Payload(scale**2 * 1e-3, tuple(scale * 0.005 * pull)),
        [Grid(2, 8)],
        residual_tolerance=1e-11,
    )
    tension = [scale**2 * f for *_, f in layout]
    result = arm.equilibrium(tension, scale**2 * 0.03 * pull, scale**3 * 2e-4 * turn)
    assert result.converged
    return result


EXACT = {"distance": 1e-8 * L, "angle": 1e-7}


@few
@given(routes, vectors, vectors, vectors, st.floats(-3.0, 3.0))
def test_turning_the_layout_and_the_loads_turns_the_answer(layout, pull, turn, hang, angle):
    z = np.eye(4)
    z[:3, :3] = about = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    here = loaded(layout, pull, turn, hang)
    there = loaded([(r, a + angle, n, f) for r, a, n, f in layout], about @ pull, about @ turn, about @ hang)
    assert same_pose(there.tip_pose, z @ here.tip_pose @ z.T, **EXACT)
    assert there.muscle_lengths == pytest.approx(here.muscle_lengths, abs=1e-8 * L)


@few
@given(routes, vectors, vectors, vectors)
def test_mirroring_the_layout_and_the_loads_mirrors_the_answer(layout, pull, turn, hang):
    """Angles and turns change sign; forces are vectors, moments axial vectors."""
    flip = np.array([1.0, -1.0, 1.0])
    here = loaded(layout, pull, turn, hang)
    there = loaded([(r, -a, -n, f) for r, a, n, f in layout], flip * pull, -flip * turn, flip * hang)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    assert same_pose(there.tip_pose, mirror @ here.tip_pose @ mirror, **EXACT)
    assert there.muscle_lengths == pytest.approx(here.muscle_lengths, abs=1e-8 * L)


@few
@given(routes, vectors, vectors, vectors, st.floats(0.2, 5.0))
def test_a_scaled_rod_takes_the_scaled_shape(layout, pull, turn, hang, scale):
    """Lengths by c; at equal stress forces go by c^2, moments by c^3, masses by c^2."""
    here, there = loaded(layout, pull, turn, hang), loaded(layout, pull, turn, hang, scale)
    expected = here.tip_pose.copy()
    expected[:3, 3] *= scale
    assert same_pose(there.tip_pose, expected, scale * 1e-8 * L, 1e-7)
    assert there.muscle_lengths == pytest.approx(scale * here.muscle_lengths, abs=scale * 1e-8 * L)


@cache
def reordered(order: tuple[int, ...]) -> Arm:
    module = paper().modules[0]
    return Arm([replace(module, muscles=[module.muscles[i] for i in order])], paper().gravity, paper().payload)


@few
@given(st.permutations(range(3)), st.tuples(up_to_140, up_to_140, up_to_140))
def test_the_order_of_the_muscles_does_not_matter(order, drive):
    here, there = paper().equilibrium(drive), reordered(tuple(order)).equilibrium([drive[i] for i in order])
    assert here.converged and there.converged
    assert same_pose(there.tip_pose, here.tip_pose, 1e-8 * L, 1e-6)
    assert there.tensions == pytest.approx(here.tensions[list(order)], abs=1e-8)


@cache
def cut_at(*ends: float) -> Arm:
    """A rod with a straight and a helical tendon, in modules that end at these fractions of its length."""
    modules = []
    for begin, end in pairwise((0.0, *ends)):
        helix = tendon(0.003, 2.0 + 2.0 * np.pi * 0.8 * begin, 0.8 * (end - begin))  # goes on where it was cut
        modules.append(rod([tendon(0.004, 0.5), helix], (end - begin) * L, (end - begin) * 2e-3))
    payload = Payload(1e-3, (0.0, 0.0, 0.01))
    return Arm(modules, (0.0, G0, 0.0), payload, [Grid(4, 8)] * len(modules), residual_tolerance=1e-11)


@few
@given(st.sampled_from([0.3, 0.5, 0.75]), st.floats(0.0, 0.3), st.floats(0.0, 0.3), vectors)
def test_cutting_a_module_in_two_changes_nothing(cut, first, second, pull):
    """With tendons: two elastic muscles in series are not one."""
    whole = cut_at(1.0).equilibrium([first, second], 0.02 * pull)
    halves = cut_at(cut, 1.0).equilibrium([first, second] * 2, 0.02 * pull)
    assert whole.converged and halves.converged
    assert same_pose(halves.tip_pose, whole.tip_pose, **EXACT)
    lengths = halves.muscle_lengths[:2] + halves.muscle_lengths[2:]
    assert lengths == pytest.approx(whole.muscle_lengths, abs=1e-8 * L)
    s = [0.1 * L, 0.5 * L, 0.9 * L]
    assert halves.poses(s) == pytest.approx(whole.poses(s), abs=1e-7)


# History, and solves that fail.


@in_every_case
def test_the_same_question_gets_the_same_answer_to_the_last_bit(name):
    case, first = solved(name)
    case.arm.equilibrium(np.array(case.drive) * 1.01, case.force)  # whatever is solved in between
    second = case.solve()
    other = CASES[name]().solve()
    for again in (second, other):
        assert np.array_equal(again.tip_pose, first.tip_pose)
        assert np.array_equal(again.tensions, first.tensions)
        assert np.array_equal(again.muscle_lengths, first.muscle_lengths)
        assert (again.residual, again.iterations) == (first.residual, first.iterations)
        assert np.array_equal(again.poses([0.01]), first.poses([0.01]))
        assert np.array_equal(again.tip_jacobian, first.tip_jacobian)


def snapshot(result: Equilibrium) -> list[Array]:
    s = [0.0, 0.012, 0.045]
    return [
        x.copy()
        for x in (
            result.tip_pose,
            result.tensions,
            result.muscle_lengths,
            result.drive,
            result.load,
            result.poses(s),
            result.strain(s),
        )
    ]


@pytest.mark.parametrize("drive", [(90.0, 30.0, 60.0), (160.0, 160.0, 25.0)])
def test_a_warm_start_leaves_the_start_alone(drive):
    start = paper().equilibrium((25.0, 120.0, 40.0))
    before = snapshot(start)
    asked = np.array(drive)
    result = paper().equilibrium(asked, start=start)
    result.tip_jacobian  # noqa: B018  (evaluated for its side effects, should it have any)
    assert all(np.array_equal(a, b) for a, b in zip(before, snapshot(start), strict=True))
    assert asked.tolist() == list(drive)
    # The answer owns its drive: the caller's array may change afterwards.
    asked[:] = 0.0
    assert result.drive.tolist() == list(drive)


def test_a_warm_start_at_the_answer_stays_there():
    first = paper().equilibrium((120.0, 50.0, 30.0))
    again = paper().equilibrium((120.0, 50.0, 30.0), start=first)
    assert again.iterations == 0
    assert again.tip_pose == pytest.approx(first.tip_pose, abs=1e-12)


def test_an_equilibrium_of_another_grid_is_a_start():
    coarse = paper_module([Grid(1, 6)]).equilibrium((120.0, 50.0, 30.0))
    warm = paper().equilibrium((120.0, 50.0, 30.0), start=coarse)
    cold = paper().equilibrium((120.0, 50.0, 30.0))
    assert warm.iterations < cold.iterations
    assert same_pose(warm.tip_pose, cold.tip_pose, 1e-8 * L, 1e-6)


HOPELESS = {
    "a tendon far beyond the collapse of the rod": (
        Arm([rod([tendon(0.004)])]),
        [0.1],
        [50.0],
        (0, 0, 0),
        (0, 0, 0),
    ),
    "a helical tendon": (Arm([rod([tendon(0.003, 0.0, 1.0)])]), [0.1], [1e9], (0, 0, 0), (0, 0, 0)),
    "a tip force": (Arm([rod([tendon(0.004)])]), [0.1], [0.1], (1e6, 0, 0), (0, 0, 0)),
    "a tip moment": (Arm([rod([tendon(0.004)])]), [0.1], [0.1], (0, 0, 0), (0, 10.0, 10.0)),
}


@pytest.mark.parametrize("cold", [True, False])
@pytest.mark.parametrize("name", HOPELESS)
def test_a_solve_that_fails_says_so_and_returns_the_starts_shape(name, cold):
    arm, easy, drive, force, moment = HOPELESS[name]
    known = arm.equilibrium(easy)
    result = arm.equilibrium(drive, force, moment, start=None if cold else known)
    assert not result.converged
    assert "no equilibrium found" in result.message
    assert no_nan(result)
    assert result.drive == pytest.approx(drive)
    s = [0.01, 0.03, L]
    if cold:
        unloaded = np.tile(np.eye(4), (3, 1, 1))
        unloaded[:, 2, 3] = s
        assert result.poses(s) == pytest.approx(unloaded, abs=1e-12)
        assert result.tip_pose == pytest.approx(unloaded[-1], abs=1e-12)
        assert result.strain(s) == pytest.approx(np.tile(AXIS, (3, 1)), abs=1e-12)
        assert result.tensions.tolist() == [0.0]
        assert result.muscle_lengths == pytest.approx([arm.modules[0].rest_length(arm.muscles[0])])
    else:
        assert np.array_equal(result.poses(s), known.poses(s))
        assert np.array_equal(result.strain(s), known.strain(s))
        assert same_pose(result.tip_pose, known.tip_pose, 1e-12, 1e-7)
        assert np.array_equal(result.tensions, known.tensions)
        assert result.muscle_lengths == pytest.approx(known.muscle_lengths)


def test_a_failed_solve_is_a_start_like_any_other():
    """It holds the shape of its own start, so the next solve continues from there."""
    arm = Arm([rod([tendon(0.004)])])
    known = arm.equilibrium([0.2])
    failed = arm.equilibrium([50.0], start=known)
    assert not failed.converged
    after, directly = (arm.equilibrium([0.5], start=start) for start in (failed, known))
    assert after.converged
    assert np.array_equal(after.tip_pose, directly.tip_pose)
