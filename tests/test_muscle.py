"""Muscle laws against the paper's numbers, and the derivatives that the solver relies on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tca_envs.mechanics import TCA, Spring, Tendon
from tca_envs.mechanics.laws import elongation

# The same examples in every run: a verdict on the code, not on the draw.
same = settings(max_examples=100, deadline=None, derandomize=True)

REST = 0.045
LAWS = [TCA(), TCA.paper(), Spring(50.0), Tendon()]
TCAS = [TCA(), TCA.paper()]
tensions, temperatures = st.floats(-1.0, 5.0), st.floats(-20.0, 300.0)


def law_of(law, tension, drive, rest=REST):
    """Elongation [m], its derivative in tension [m/N] and in drive, as the solver sees them."""
    return elongation(law.kind, law.parameters()[np.newaxis], 0, rest, tension, drive)


# The TCA.


@pytest.mark.parametrize(("tension", "millimetres"), [(0.05, 4.51), (0.1, 7.51), (0.2, 11.40), (0.4, 15.98), (0.8, 22.10)])
def test_passive_elongation_is_the_papers_figure_3(tension, millimetres):
    assert 1e3 * TCA().elongation(tension, 25.0) == pytest.approx(millimetres, abs=0.02)


@pytest.mark.parametrize(("temperature", "percent"), [(25, 0.0), (50, 2.5), (75, 7.3), (100, 14.3), (125, 23.7), (150, 35.3)])
def test_free_contraction_is_the_measured_one(temperature, percent):
    assert -100.0 * TCA().elongation(0.0, temperature) / REST == pytest.approx(percent, abs=0.05)


def test_heat_untwists_the_fibre_by_the_papers_polynomial():
    def untwist(x):
        return -0.0161 * x**2 + 0.3338 * x - 7.7311

    for temperature in (-20.0, 10.0, 40.0, 90.0, 160.0):
        assert TCA().elongation(0.0, temperature) == pytest.approx(5.116e-5 * (untwist(temperature) - untwist(25.0)), abs=1e-12)
        # The authors' own curves need the argument T - 25.
        assert TCA.paper().elongation(0.0, temperature) == pytest.approx(
            2.1e-5 * (untwist(temperature - 25.0) - untwist(0.0)), abs=1e-12
        )


def test_the_paper_preset_turns_where_the_papers_figure_4_does():
    """34.7 degC, read off the plot; with T as the argument the turn would be near 10 degC."""
    temperature = np.linspace(0.0, 100.0, 10001)
    longest = [temperature[np.argmax([law.elongation(0.0, t) for t in temperature])] for law in TCAS]
    assert longest[1] == pytest.approx(25.0 + 0.3338 / (2.0 * 0.0161), abs=0.01)
    assert longest[1] == pytest.approx(34.7, abs=1.0)
    assert longest[0] < 11.0


def test_the_default_is_the_hardware_set():
    assert TCA.hardware() == TCA()
    assert TCA.paper() != TCA()


@pytest.mark.parametrize("law", TCAS)
@same
@given(tensions, tensions, temperatures)
def test_tension_always_lengthens_the_coil(law, a, b, temperature):
    """So the tension at a length is unique, slack and overloaded too."""
    low, high = sorted((a, b))
    stretch = law.elongation(high, temperature) - law.elongation(low, temperature)
    f = np.linspace(0.0, 0.8, 1001)
    stiffest = np.min(2.3725e6 * (20.85e6 + 37.58e6 * f**2) / (20.85e6 + 111.33e6 * f - 37.58e6 * f**2) ** 2)
    assert stiffest > 0.014
    assert stretch >= 0.9999 * stiffest * (high - low) - 1e-15
    assert law_of(law, a, temperature)[1] >= 0.9999 * stiffest


@pytest.mark.parametrize("law", TCAS)
@pytest.mark.parametrize("end", [0.0, 0.8])
def test_the_law_goes_on_with_its_tangent_at_both_ends_of_the_measured_range(law, end):
    h = 1e-9
    (below, slope_below, _), (above, slope_above, _) = (law_of(law, end + s * h, 90.0) for s in (-1.0, 1.0))
    at, slope, _ = law_of(law, end, 90.0)
    assert slope_below == pytest.approx(slope, rel=1e-6)
    assert slope_above == pytest.approx(slope, rel=1e-6)
    assert above - below == pytest.approx(2.0 * h * slope, rel=1e-5)
    outside = -1.0 if end == 0.0 else 5.0
    assert law.elongation(outside, 90.0) == pytest.approx(at + slope * (outside - end), rel=1e-12)


@pytest.mark.parametrize("law", TCAS)
@same
@given(tensions, temperatures, st.floats(0.2, 5.0))
def test_elongation_scales_with_the_rest_length(law, tension, temperature, scale):
    whole, part = law.elongation(tension, temperature), law.elongation(tension, temperature, scale * REST)
    assert part == pytest.approx(scale * whole, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    "arguments",
    [
        # The paper's misprint: F/G_t falls beyond 0.15 N.
        {"modulus": (0.85e6, 111.33e6, 37.58e6)},
        {"modulus": (20e6, -30e6, 0.0)},  # G_t = 0 at 0.67 N
        {"modulus": (20.85e6, 111.33e6, 33e6)},  # turns over at 0.795 N, just inside the range
        {"modulus": (-20.85e6, 111.33e6, -37.58e6)},
        {"max_tension": 3.2},  # G_t of the hardware set is negative at 3.2 N
    ],
)
def test_a_law_that_turns_over_is_refused(arguments):
    with pytest.raises(ValueError, match="turns over") as refusal:
        TCA(**arguments)
    assert repr(next(iter(arguments.values()))) in str(refusal.value)


def test_the_same_modulus_is_accepted_up_to_where_it_turns_over():
    modulus = (20.85e6, 111.33e6, 33e6)
    turn = np.sqrt(modulus[0] / modulus[2])
    law = TCA(modulus=modulus, max_tension=0.99 * turn)
    assert law_of(law, 5.0, 25.0)[1] > 0.0


# All laws.


def test_a_spring_lengthens_in_proportion():
    """Drive is its own rest length; elongation counts from the path length in the unloaded rod."""
    assert law_of(Spring(50.0), 0.3, 0.042) == pytest.approx((0.042 + 0.3 / 50.0 - REST, 0.02, 1.0))


def test_a_tendon_has_no_law():
    assert law_of(Tendon(), 0.3, 0.3) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("law", LAWS)
@same
@given(tensions, st.floats(0.0, 1.0))
def test_the_derivatives_are_those_of_the_elongation(law, tension, fraction):
    low, high = law.drive_range()
    drive = low + fraction * (min(high, 300.0) - low)
    rest, h, k = 0.111, 1e-5, 1e-3
    _, by_tension, by_drive = law_of(law, tension, drive, rest)
    difference = (law_of(law, tension + h, drive, rest)[0] - law_of(law, tension - h, drive, rest)[0]) / (2.0 * h)
    # Across the ends of the measured range the second derivative jumps: an error of first order in h.
    assert by_tension == pytest.approx(difference, rel=1e-4, abs=1e-9)
    difference = (law_of(law, tension, drive + k, rest)[0] - law_of(law, tension, drive - k, rest)[0]) / (2.0 * k)
    assert by_drive == pytest.approx(difference, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("rest", [0.02, REST, 0.111])
def test_at_its_neutral_drive_a_muscle_carries_nothing(law, rest):
    drive = law.neutral_drive(rest)
    low, high = law.drive_range()
    assert low <= drive <= high
    assert law_of(law, 0.0, drive, rest)[0] == pytest.approx(0.0, abs=1e-15)


def test_laws_do_not_share_rows():
    """Several muscles' numbers lie in one array; a row must be read by its own muscle only."""
    rows = np.array([law.parameters() for law in LAWS])
    for i, law in enumerate(LAWS):
        assert elongation(law.kind, rows, i, REST, 0.2, 100.0) == law_of(law, 0.2, 100.0)


@pytest.mark.parametrize("law", LAWS)
def test_laws_are_values(law):
    assert law == type(law)(**{name: getattr(law, name) for name in law.__dataclass_fields__ if name != "kind"})
    with pytest.raises(AttributeError):
        law.kind = 7
