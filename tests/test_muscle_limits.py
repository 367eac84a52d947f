"""What muscles do at the ends of what their laws describe: slack, closed coils, overload, collapse of the rod.

The test rod has L = 45 mm, radius 4.5 mm, E = 0.125 MPa, G = E/3.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from tca_envs.mechanics import TCA, Arm, Equilibrium, Module, Muscle, Tendon
from tca_envs.robots import CUT_OFF
from tca_envs.robots.paper import bending_arm, ring, whole_arm, with_object

Array = NDArray[np.float64]

L, E = 0.045, 0.125e6
EI, EA = 4.025779179727e-5, 7.952156404
AMBIENT = 25.0


def rod(muscles: list[Muscle]) -> Arm:
    return Arm([Module.cylinder(L, 0.009, E, E / 3.0, muscles=muscles)])


# The arms of the tasks, as hot as their heaters get.


def reachable(muscles: int, count: int) -> Array:
    """Temperatures [degC]: all corners of what the heaters reach, and random ones."""
    rng = np.random.default_rng(0)
    return np.vstack([list(product((AMBIENT, CUT_OFF), repeat=muscles)), rng.uniform(AMBIENT, CUT_OFF, (count, muscles))])


@pytest.fixture(scope="module")
def equilibria() -> dict[str, tuple[Arm, list[Equilibrium]]]:
    """The arms of the tasks at such temperatures, the whole one with and without the object."""
    bending, whole = bending_arm(), whole_arm()
    drives = reachable(4, 60)
    found = {
        "bending module": (bending, [bending.equilibrium(drive) for drive in reachable(3, 60)]),
        "whole arm": (whole, [whole.equilibrium(drive) for drive in drives]),
        "whole arm with the object": (whole, [whole.equilibrium(drive, payload=with_object()) for drive in drives]),
    }
    assert all(result.converged for _, results in found.values() for result in results)
    return found


@pytest.mark.parametrize("name", ["bending module", "whole arm", "whole arm with the object"])
def test_no_coil_of_a_task_closes(name, equilibria):
    """Coils touch at 0.643 of the rest length, which the law does not know. The arms' weight and stiffness keep them open."""
    arm, results = equilibria[name]
    shortest = min((result.muscle_lengths / arm.rest_lengths).min() for result in results)
    assert 0.643 < 0.75 < shortest < 0.85


def test_the_grippers_coil_stays_open():
    half = ring().half()
    lengths = [half.equilibrium([temperature]).muscle_lengths[0] for temperature in (AMBIENT, 100.0, CUT_OFF)]
    assert 0.643 < 0.85 < min(lengths) / half.rest_lengths[0]


def test_a_free_coil_closes_just_beyond_the_soft_limit_and_the_law_goes_on():
    """Without a load the measured limit is passed at 150.8 degC: what lies beyond is no longer a coil."""
    law = TCA()
    closed = brentq(lambda temperature: law.elongation(0.0, temperature) / L + 0.357, 100.0, 300.0)
    assert closed == pytest.approx(150.8, abs=0.05)
    # Any pull that a task's arm exerts on a hot coil, 0.12 N, holds it open up to the cut-off.
    assert law.elongation(0.12, CUT_OFF) / L > -0.25
    hot = np.array([law.elongation(0.0, temperature) for temperature in np.linspace(closed, 300.0, 50)])
    assert (np.diff(hot) < 0.0).all()
    assert hot[-1] < -L  # a length below zero: nonsense that the law's range of drives admits


# Slack.


def test_a_slack_coil_pushes_at_the_rate_of_its_softest():
    """Below zero tension the tangent at zero goes on: 8.8 N/m for 45 mm, an eighth of the rate at the end of the range."""
    law = TCA()
    pushing = (law.elongation(-0.01, 90.0) - law.elongation(0.0, 90.0)) / -0.01
    assert 1.0 / pushing == pytest.approx(20.85e6 / 2.3725e6)
    rates = [1e-6 / (law.elongation(f + 1e-6, 90.0) - law.elongation(f, 90.0)) for f in np.linspace(0.0, 0.8, 81)]
    assert min(rates) == pytest.approx(rates[0]) == pytest.approx(1.0 / pushing, rel=1e-4)
    assert max(rates) == pytest.approx(69.5, abs=0.05)


@pytest.mark.parametrize(
    ("name", "least"), [("bending module", 0.0), ("whole arm", 0.0), ("whole arm with the object", -7.5e-3)]
)
def test_a_cold_coil_among_hot_ones_carries_almost_nothing(name, least, equilibria):
    """The arm's weight keeps every coil stretched, but for a cold one in an arm that is bent over with the object: 7 mN."""
    _, results = equilibria[name]
    slackest = min(results, key=lambda result: result.tensions.min())
    assert slackest.tensions.min() > least
    assert slackest.drive[np.argmin(slackest.tensions)] < 30.0
    assert abs(slackest.tensions.min()) < 0.05 * slackest.tensions.max()


def test_what_a_slack_coil_pushes_with_moves_the_tip_by_a_millimetre_at_most():
    """Beside tendons without tension instead of the slack coils: the law's push is an idealisation of that size."""
    arm = whole_arm()
    drive = np.array([CUT_OFF, CUT_OFF, AMBIENT, AMBIENT])
    pushed = arm.equilibrium(drive, payload=with_object())
    bending, twisting = arm.modules
    muscles = [*bending.muscles[:2], Muscle(bending.muscles[2].offset, bending.muscles[2].angle, 0.0, Tendon())]
    slack = Arm([replace(bending, muscles=muscles), twisting], arm.gravity, arm.payload, arm.grids, arm.residual_tolerance)
    free = slack.equilibrium([CUT_OFF, CUT_OFF, 0.0, AMBIENT], payload=with_object())
    assert pushed.converged and free.converged
    assert pushed.tensions[2] == pytest.approx(-6.9e-3, abs=1e-4)
    assert np.linalg.norm(free.tip_pose[:3, 3] - pushed.tip_pose[:3, 3]) == pytest.approx(0.8e-3, abs=0.2e-3)


# The printed modulus.


def test_with_the_printed_modulus_two_tensions_have_one_length():
    """F/G_t has its maximum at sqrt(g0/g2) = 0.15 N; tensions whose product is g0/g2 lengthen the coil alike."""
    g0, g1, g2 = 0.85e6, 111.33e6, 37.58e6

    def elongation(f: float) -> float:
        return 2.3725e6 * f / (g0 + g1 * f + g2 * f**2)

    turn = np.sqrt(g0 / g2)
    assert turn == pytest.approx(0.1504, abs=1e-4)
    for f in (0.03, 0.06, 0.12):
        assert elongation(f) == pytest.approx(elongation(g0 / g2 / f), rel=1e-12)
        assert elongation(f) < elongation(turn)
    # Up to where it turns the law is one like any other, and is taken; beyond, it is refused.
    TCA(modulus=(g0, g1, g2), max_tension=0.999 * turn)
    with pytest.raises(ValueError, match="turns over"):
        TCA(modulus=(g0, g1, g2), max_tension=1.001 * turn)


# Overload.


def test_the_solver_crosses_the_ends_of_the_measured_range():
    """Three coils around a rod that is pulled: v_z = 1 + (P - 3 F)/EA, from slack to beyond the break, in any steps.

    The rod is stiff in shear: with GA < EA it would buckle under such a pull.
    """
    law = TCA()
    (module,) = rod([Muscle(0.004, 2.0 * np.pi * i / 3.0, 0.0, law) for i in range(3)]).modules
    arm = Arm([replace(module, stiffness=module.stiffness * [1.0, 1.0, 1.0, 100.0, 100.0, 1.0])])

    def expected(pull: float) -> float:
        return float(brentq(lambda f: L * (pull - 3.0 * f) / EA - law.elongation(f, AMBIENT), -1.0, 5.0, xtol=1e-14))

    pulls = np.linspace(-0.03, 9.0, 61)
    tensions, result = [], None
    for pull in [*pulls, *pulls[::-20]]:
        result = arm.equilibrium([AMBIENT] * 3, (0.0, 0.0, pull), start=result)
        assert result.converged
        assert result.tensions == pytest.approx(expected(pull), abs=1e-7)
        assert result.tip_pose[2, 3] == pytest.approx(L + law.elongation(expected(pull), AMBIENT), abs=1e-6 * L)
        tensions.append(result.tensions[0])
    there = np.array(tensions[: len(pulls)])
    assert there[0] < 0.0 and there[-1] > 1.0
    assert (np.diff(there) > 0.0).all()


def test_an_overheated_coil_pulls_beyond_the_measured_range():
    """One coil on a rod a thousand times as stiff, heated until it would have no length: L F c = -elongation(F, T)."""
    law, stiffer = TCA(), 1e3
    arm = Arm([Module.cylinder(L, 0.009, stiffer * E, stiffer * E / 3.0, muscles=[Muscle(0.004, 0.3, 0.0, law)])])
    compliance = (1.0 / EA + 0.004**2 / EI) / stiffer
    result, tensions = None, []
    for temperature in np.linspace(AMBIENT, 300.0, 23):
        result = arm.equilibrium([temperature], start=result)
        force = brentq(lambda f, t=temperature: L * compliance * f + law.elongation(f, t), -1.0, 20.0, xtol=1e-14)
        assert result.converged
        assert result.tensions == pytest.approx([force], rel=1e-7, abs=1e-9)
        tensions.append(force)
    assert tensions[0] < 1e-9 and tensions[-1] > 2.0


# Collapse.

COLLAPSE = 1.911349


def test_the_rod_collapses_under_a_straight_tendon_at_the_closed_form_tension():
    """The tendon's path is L (1 - F/F_c): a point at F_c, and nothing beyond."""
    arm = rod([Muscle(0.004, 0.0, 0.0, Tendon())])
    critical = 1.0 / (1.0 / EA + 0.004**2 / EI)
    assert critical == pytest.approx(COLLAPSE, abs=1e-6)
    near = arm.equilibrium([0.999 * critical])
    assert near.converged
    assert near.muscle_lengths == pytest.approx([0.001 * L], abs=1e-6 * L)
    assert near.strain([0.4 * L])[0] == pytest.approx(
        [0.0, 0.999 * critical * 0.004 / EI, 0.0, 0.0, 0.0, 1.0 - 0.999 * critical / EA], abs=1e-5
    )
    for start in (None, near):
        beyond = arm.equilibrium([1.001 * critical], start=start)
        assert not beyond.converged
        assert beyond.message.startswith("no equilibrium found: ") and "collapses the rod" in beyond.message
        shape = near.tip_pose if start else np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, L], [0, 0, 0, 1.0]])
        assert beyond.tip_pose == pytest.approx(shape, abs=1e-9)
        assert np.isfinite(beyond.poses([0.0, 0.3 * L, L])).all()
    # Nothing is lost: it goes on from there.
    assert arm.equilibrium([0.5 * critical], start=beyond).converged
