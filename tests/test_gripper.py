"""The gripper against closed forms, the arm's solver and an integration of its own."""

import re
from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

from tca_envs.mechanics import TCA, Gripper, Spring, Tendon
from tca_envs.robots import paper

same = settings(max_examples=50, deadline=None, derandomize=True)

HARDWARE, PAPER = paper.ring(), paper.ring(TCA.paper())
SETS = pytest.mark.parametrize("ring", [HARDWARE, PAPER], ids=["hardware", "paper"])
HEATS = np.array([25.0, 40.0, 60.0, 90.0, 110.0, 130.0, 158.0])
WIDTH = paper.OBJECT.width
temperatures = st.floats(25.0, 158.0)


def straightness(ring):
    """c: the path of the ring's muscle shortens by F length c [1/N]."""
    return 1.0 / ring.axial_stiffness + ring.offset**2 / ring.bending_stiffness


# The free ring.


def test_the_paper_ring():
    """All of it as in the paper: 35 mm, closed to a circle, its muscle 2.5 mm outside, a stiffness measured with tape."""
    assert HARDWARE.radius == pytest.approx(1.0 / 179.5, rel=1e-3)
    assert HARDWARE.rest_length == pytest.approx(2.0 * pi * (HARDWARE.radius + 2.5e-3), rel=1e-14)
    assert HARDWARE.half().rest_lengths[0] == pytest.approx(0.5 * HARDWARE.rest_length, rel=1e-12)
    assert (HARDWARE.length, HARDWARE.bending_stiffness) == (35e-3, 2.1e-5)
    assert HARDWARE.axial_stiffness / 0.125e6 == pytest.approx(12.0 * HARDWARE.bending_stiffness / 0.125e6 / 3e-3**2)


@SETS
@pytest.mark.parametrize("temperature", HEATS)
def test_the_closed_form_is_the_equilibrium_of_an_arm(ring, temperature):
    half = ring.half().equilibrium([temperature])
    assert half.converged
    assert ring.tension(temperature) == pytest.approx(half.tensions[0], abs=1e-9)
    # Jaws that press on each other have no gap: the arm's tip, which knows of no other half, goes past its middle.
    assert ring.gap(temperature) == pytest.approx(max(2.0 * half.tip_pose[2, 3], 0.0), abs=1e-11)


@SETS
@pytest.mark.parametrize("temperature", [-20.0, *HEATS, 300.0])
def test_tension_balances_coil_and_ring(ring, temperature):
    def lengths_differ(force):
        return ring.law.elongation(force, temperature, ring.rest_length) + force * ring.length * straightness(ring)

    assert ring.tension(temperature) == pytest.approx(brentq(lengths_differ, -1.0, 9.0, xtol=1e-15, rtol=1e-14), abs=1e-12)


@same
@given(temperatures, temperatures)
def test_heat_opens_the_gripper(a, b):
    low, high = sorted((a, b))
    assert HARDWARE.tension(high) >= HARDWARE.tension(low)
    assert HARDWARE.gap(high) >= HARDWARE.gap(low)
    if high - low > 1e-3:
        # At 25 degC a kelvin opens the ring by 5 um, and more the hotter it is.
        assert HARDWARE.gap(high) - HARDWARE.gap(low) > 4e-6 * (high - low)


def test_the_gap_is_millimetres_at_the_temperatures_of_use():
    gap = HARDWARE.gap(np.linspace(100.0, 150.0, 11))
    assert 1.5e-3 < gap[0] < 2.5e-3
    assert 6e-3 < gap[-1] < 8e-3
    assert HARDWARE.gap(158.0) < 1e-2  # what the observation can show


@SETS
def test_the_cold_gripper_is_closed_without_tension(ring):
    assert ring.gap(25.0) == pytest.approx(0.0, abs=1e-15)
    assert ring.tension(25.0) == pytest.approx(0.0, abs=1e-15)


def test_jaws_that_press_on_each_other_have_no_gap():
    """By the paper's set the coil lengthens at first: up to 44 degC it is slack and pushes the jaws together."""
    warm = np.array([26.0, 34.7, 44.0])
    assert (PAPER.tension(warm) < 0.0).all()
    np.testing.assert_array_equal(PAPER.gap(warm), 0.0)
    assert PAPER.gap(46.0) > 0.0


def test_a_weak_pull_opens_in_proportion():
    """First order in F: the two ends turn by F r L/EI about the mount, a diameter away."""
    warm = HARDWARE.tension(25.5)
    turn = warm * HARDWARE.offset * HARDWARE.length / HARDWARE.bending_stiffness
    assert HARDWARE.gap(25.5) == pytest.approx(2.0 * HARDWARE.radius * turn / 2.0, rel=5e-3)


# Pinching.


def pinch_of_elastica(ring, temperature, width):
    """Force on an object by integration of one half; independent of `Arm`.

    In the plane of the ring z leaves the mount along the ring and x points to its centre; theta turns z to x. Across each
    section the force P z of the object is that of rod and muscle; its moment about the section is -P (X - x), X the tip's x.
    """
    half, axial, shear = 0.5 * ring.length, ring.axial_stiffness, ring.axial_stiffness / 3.0
    scale = np.array([0.1, 0.01, ring.radius])

    def strain(theta, x, tension, force, tip):
        u, along, across = 1.0 / ring.radius, 1.0, 0.0
        for _ in range(12):  # the muscle's direction depends on the strain, weakly
            path = np.hypot(along + ring.offset * u, across)
            pull, push = tension * (along + ring.offset * u) / path, tension * across / path
            u = 1.0 / ring.radius - (force * (tip - x) + ring.offset * pull) / ring.bending_stiffness
            along = 1.0 + (force * cos(theta) - pull) / axial
            across = (-force * sin(theta) - push) / shear
        return u, along, across, path

    def rates(_, state, *unknown):
        theta, x, _, _ = state
        u, along, across, path = strain(theta, x, *unknown)
        return u, along * sin(theta) + across * cos(theta), along * cos(theta) - across * sin(theta), path

    def misses(guess):
        tension, force, tip = guess * scale
        ends = solve_ivp(rates, (0.0, half), np.zeros(4), "DOP853", args=(tension, force, tip), rtol=1e-10, atol=1e-13)
        _, x, z, path = ends.y[:, -1]
        elongation = ring.law.elongation(tension, temperature, 0.5 * ring.rest_length)
        return np.array([x - tip, z - 0.5 * width, path - 0.5 * ring.rest_length - elongation]) / ring.radius

    found = root(misses, [0.0, 1.0, 2.0], tol=1e-11)
    assert np.abs(found.fun).max() < 1e-9
    return found.x[1] * scale[1]


@pytest.mark.parametrize(
    ("ring", "temperature", "width"),
    [(HARDWARE, 25.0, 3e-3), (HARDWARE, 110.0, 3e-3), (HARDWARE, 140.0, 8.7e-3), (PAPER, 60.0, 1e-3)],
)
def test_pinch_is_that_of_an_elastica(ring, temperature, width):
    assert ring.pinch(temperature, width) == pytest.approx(pinch_of_elastica(ring, temperature, width), rel=1e-6)


def opening_stiffness(ring):
    """Castigliano, for a thin object in the cold ring: P is the force of a jaw, F = -b P the push of the slack coil.

    Moment P R (1 + cos) + F r, axial force P cos - F, shear P sin over half a circle.
    """
    r, turn = ring.radius, ring.radius**2 * ring.offset * pi / ring.bending_stiffness
    alone = 1.5 * pi * r**3 / ring.bending_stiffness + 0.5 * pi * r * (1.0 + 3.0) / ring.axial_stiffness
    coil = ring.law.compliance_gain / ring.law.modulus[0] * 0.5 * ring.rest_length / 45e-3
    return 1.0 / (2.0 * (alone - turn**2 / (coil + pi * r * straightness(ring))))


@SETS
def test_a_thin_object_feels_the_stiffness_of_the_closed_ring(ring):
    stiffness = ring.pinch(25.0, 1e-6) / 1e-6
    # Force is found to 1e-9 N of 1.3e-5 N.
    assert stiffness == pytest.approx(opening_stiffness(ring), rel=5e-4)
    assert stiffness == pytest.approx(ring.bending_stiffness / (3.0 * pi * ring.radius**3), rel=0.03)
    assert stiffness == pytest.approx(12.8, rel=0.03)


def test_pinch_falls_with_heat_and_rises_with_width():
    heats, widths = np.linspace(25.0, 158.0, 20), (1e-3, 3e-3, 6e-3, 8.75e-3)
    forces = np.array([HARDWARE.pinch(heats, width) for width in widths])
    assert (np.diff(forces, axis=0) >= 0.0).all()
    for force, width in zip(forces, widths, strict=True):
        pinched = HARDWARE.gap(heats) < width
        assert pinched.any() and (force[pinched] > 0.0).all()
        assert (np.diff(force[pinched]) < 0.0).all()
        np.testing.assert_array_equal(force[~pinched], 0.0)


@SETS
@pytest.mark.parametrize("width", [1e-4, 1e-3])
def test_pinch_vanishes_continuously_where_the_jaws_leave_the_object(ring, width):
    leaves = brentq(lambda t: ring.gap(t) - width, 25.0 if ring is HARDWARE else 46.0, 158.0, xtol=1e-10)
    opening = ring.gap(leaves + 0.01) - ring.gap(leaves - 0.01)
    before, just_before, after = ring.pinch(leaves + np.array([-0.02, -1e-5, 1e-5]), width)
    # The ring's stiffness changes little with its opening.
    assert before == pytest.approx(opening_stiffness(ring) * opening, rel=0.2)
    assert 0.0 < just_before < 1e-3 * before
    assert after == 0.0


def test_the_object_is_held_cold_and_let_go_hot():
    """The board's weight takes 6.7 mN of each jaw."""
    needed = paper.OBJECT.mass * 9.81 / (2.0 * paper.OBJECT.friction)
    assert HARDWARE.pinch(25.0, WIDTH) > 4.0 * needed
    assert HARDWARE.pinch(100.0, WIDTH) > needed
    assert HARDWARE.pinch(120.0, WIDTH) < needed
    assert HARDWARE.pinch(125.0, WIDTH) == 0.0


@SETS
def test_every_pinch_within_the_limits_is_found(ring):
    heats = np.linspace(-20.0, 300.0, 23)
    for width in (1e-7, 1e-3, 0.25 * ring.length):
        pinched = ring.gap(heats) < width
        force = ring.pinch(heats, width)
        assert (force[pinched] > 0.0).all() and (force < 0.1).all()
        assert (force[~pinched] == 0.0).all()


# Units.


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_a_larger_ring_of_the_same_shape_has_the_same_forces(scale):
    """Lengths times s, EI times s^2, EA as it is."""
    large = Gripper(
        scale * HARDWARE.length, scale**2 * HARDWARE.bending_stiffness, HARDWARE.axial_stiffness, scale * HARDWARE.offset,
        HARDWARE.law,
    )  # fmt: skip
    np.testing.assert_allclose(large.tension(HEATS), HARDWARE.tension(HEATS), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(large.gap(HEATS), scale * HARDWARE.gap(HEATS), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(large.pinch(HEATS, scale * WIDTH), HARDWARE.pinch(HEATS, WIDTH), rtol=1e-6, atol=2e-9)


def test_ring_and_coil_of_another_stiffness_have_the_same_gap():
    """EI, EA and the coil's forces times c."""
    scale, law = 2.0, HARDWARE.law
    modulus = tuple(g / scale**i for i, g in enumerate(law.modulus))
    stiff = replace(law, compliance_gain=law.compliance_gain / scale, modulus=modulus, max_tension=scale * law.max_tension)
    ring = Gripper(
        HARDWARE.length, scale * HARDWARE.bending_stiffness, scale * HARDWARE.axial_stiffness, HARDWARE.offset, stiff
    )
    np.testing.assert_allclose(ring.gap(HEATS), HARDWARE.gap(HEATS), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(ring.tension(HEATS), scale * HARDWARE.tension(HEATS), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(ring.pinch(HEATS, WIDTH), scale * HARDWARE.pinch(HEATS, WIDTH), rtol=1e-6, atol=3e-9)


# Arrays and bad arguments.


def pinch(temperature):
    return HARDWARE.pinch(temperature, WIDTH)


METHODS = pytest.mark.parametrize("method", [HARDWARE.tension, HARDWARE.gap, pinch], ids=["tension", "gap", "pinch"])


@METHODS
def test_temperatures_have_any_shape_and_stay_as_they_are(method):
    grid = np.array([[25.0, 60.0, 90.0], [110.0, 130.0, 150.0]])
    one_by_one = [[float(method(float(t))) for t in row] for row in grid]
    for given_ in (grid, grid.tolist(), grid.astype(int), grid.astype(np.float32), np.asfortranarray(grid)):
        before = np.array(given_)
        np.testing.assert_array_equal(method(given_), one_by_one)
        np.testing.assert_array_equal(before, given_)
    np.testing.assert_array_equal(method(grid.T), np.transpose(one_by_one))
    np.testing.assert_array_equal(method(grid[:, ::2]), np.array(one_by_one)[:, ::2])
    fixed = grid.copy()
    fixed.setflags(write=False)
    np.testing.assert_array_equal(method(fixed), one_by_one)
    assert np.shape(method(60)) == np.shape(method(np.array(60.0))) == ()
    assert method([]).shape == (0,)
    assert method(np.zeros((2, 0, 3))).shape == (2, 0, 3)


NAN = float("nan")
NO_TEMPERATURE = [
    NAN,
    float("inf"),
    -20.1,
    300.1,
    "60",
    None,
    True,
    60j,
    [60.0, NAN],
    ["60"],
    [True, False],
    [[60], [1, 2]],
    {},
]


@METHODS
@pytest.mark.parametrize("bad", NO_TEMPERATURE, ids=repr)
def test_bad_temperatures_are_refused(method, bad):
    with pytest.raises(ValueError, match=re.escape(f"temperature = {bad!r}: expected numbers in [-20, 300] degC")):
        method(bad)


@pytest.mark.parametrize("bad", [0.0, -1e-3, 8.751e-3, NAN, float("inf"), "3e-3", None, True, [3e-3], 3e-3j], ids=repr)
def test_bad_widths_are_refused(bad):
    with pytest.raises(ValueError, match=re.escape(f"width = {bad!r}: expected")):
        HARDWARE.pinch(25.0, bad)


@pytest.mark.parametrize("name", ["length", "bending_stiffness", "axial_stiffness", "offset"])
@pytest.mark.parametrize("bad", [0.0, -1.0, NAN, float("inf"), "1", None, True, [1.0]], ids=repr)
def test_bad_numbers_are_refused(name, bad):
    with pytest.raises(ValueError, match=re.escape(f"{name} = {bad!r}: expected")):
        replace(HARDWARE, **{name: bad})


@pytest.mark.parametrize("bad", [None, TCA, Tendon(), Spring(50.0), "TCA"], ids=repr)
def test_a_law_that_is_no_tca_is_refused(bad):
    with pytest.raises(ValueError, match=re.escape(f"law = {bad!r}: expected a TCA")):
        replace(HARDWARE, law=bad)


def test_a_gripper_is_a_value():
    assert paper.ring() == HARDWARE != PAPER
    with pytest.raises(AttributeError):
        HARDWARE.length = 1.0
