import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tca_envs import registry
from tca_envs.mechanics import thermal
from tca_envs.mechanics.laws import REFERENCE_LENGTH
from tca_envs.mechanics.thermal import Heater
from tca_envs.robots import CUT_OFF
from tca_envs.tasks.core import STEP_S

HEATING = Heater().scaled([0.045, 0.045, 0.1111])

temperatures = st.lists(st.floats(-20.0, 300.0), min_size=3, max_size=3).map(np.array)
powers = st.lists(st.floats(0.0, 2.0), min_size=3, max_size=3).map(np.array)


@given(temperatures, powers, st.floats(0.0, 100.0))
def test_two_half_steps_equal_one(temperature, power, duration):
    half = thermal.step(temperature, power, 0.5 * duration, HEATING)
    twice = thermal.step(half, power, 0.5 * duration, HEATING)
    # Round-off of numbers of the size of the steady temperature.
    size = HEATING.ambient + np.abs(temperature).max() + (power / HEATING.loss).max()
    np.testing.assert_allclose(twice, thermal.step(temperature, power, duration, HEATING), rtol=0, atol=1e-15 * size)


@given(temperatures, temperatures, st.floats(1e-3, 100.0))
def test_power_to_reach_is_the_inverse(temperature, target, duration):
    power = thermal.power_to_reach(temperature, target, duration, HEATING)
    np.testing.assert_allclose(thermal.step(temperature, power, duration, HEATING), target, rtol=0, atol=1e-9)


def test_agrees_with_an_integrated_equation():
    power = np.array([0.0, 1.0, 2.0])

    def rate(_, temperature):
        return (power - HEATING.loss * (temperature - HEATING.ambient)) / HEATING.capacity

    start = np.array([150.0, 25.0, 80.0])
    expected = solve_ivp(rate, (0.0, 0.7), start, rtol=1e-10, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(thermal.step(start, power, 0.7, HEATING), expected, rtol=1e-8)


def test_last_axis_is_the_muscles_and_the_others_are_batches():
    rng = np.random.default_rng(0)
    temperature, power = rng.uniform(20, 160, (4, 5, 3)), rng.uniform(0, 2, (4, 5, 3))
    together = thermal.step(temperature, power, 0.1, HEATING)
    for i in range(4):
        for j in range(5):
            np.testing.assert_array_equal(together[i, j], thermal.step(temperature[i, j], power[i, j], 0.1, HEATING))


def test_steady_power_holds():
    held = np.array([30.0, 100.0, 150.0])
    after = thermal.step(held, thermal.steady_power(held, HEATING), 5.0, HEATING)
    np.testing.assert_allclose(after, held, rtol=1e-14)


def test_constants_scale_with_the_rest_length_so_the_time_constant_does_not():
    np.testing.assert_allclose(HEATING.capacity / HEATING.loss, 0.0193 / 0.0107, rtol=1e-14)
    np.testing.assert_allclose(HEATING.max_power, 2.0 * np.array([0.045, 0.045, 0.1111]) / REFERENCE_LENGTH, rtol=1e-14)


@pytest.mark.parametrize("start", [25.0, 90.0, 157.0])
def test_time_to_reach_is_that_of_full_power_or_none(start):
    """`step` arrives after it, and less than that is not enough."""
    target = np.array([26.0, 80.0, 150.0])
    time = thermal.time_to_reach(start, target, HEATING)
    assert (time > 0.0).all()
    for i in range(3):
        power = np.where(target[i] > start, HEATING.max_power, 0.0)
        assert thermal.step(start, power, time[i], HEATING)[i] == pytest.approx(target[i], abs=1e-9)
        assert abs(thermal.step(start, power, 0.99 * time[i], HEATING)[i] - target[i]) > 1e-3


def test_time_to_reach_is_zero_at_the_target_and_infinite_beyond_what_heaters_reach():
    hottest = HEATING.ambient + HEATING.max_power[0] / HEATING.loss[0]
    times = [0.0, 0.0, np.inf, np.inf]
    starts, targets = [25.0, 90.0, 90.0, 25.0], [25.0, 90.0, 25.0, 1.01 * hottest]
    for start, target, time in zip(starts, targets, times, strict=True):
        assert thermal.time_to_reach(start, target, HEATING)[0] == time


@pytest.mark.parametrize("duration", [-0.1, np.nan, np.inf, "1"])
def test_a_bad_duration_is_refused(duration):
    with pytest.raises(ValueError, match="duration = "):
        thermal.step(25.0, 0.0, duration, HEATING)


def test_no_time_reaches_nothing():
    with pytest.raises(ValueError, match=r"duration = 0\.0"):
        thermal.power_to_reach(25.0, 30.0, 0.0, HEATING)


@pytest.mark.parametrize("name", ["capacity", "loss", "max_power"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_bad_constants_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} = "):
        Heater(**{name: value})


@pytest.mark.parametrize("lengths", [[0.0], [-1.0], [np.nan], 0.045])
def test_bad_rest_lengths_are_refused(lengths):
    with pytest.raises(ValueError, match="rest_lengths = "):
        Heater().scaled(lengths)


def test_environments_heat_by_the_closed_form_up_to_the_cut_off():
    """What is compiled into the loop over lanes against the functions of `thermal`, from cold to the cut-off."""
    lanes = registry.entry("pick-and-place").new().core(6)
    rng, cut = np.random.default_rng(0), 0
    for _ in range(40):
        action = np.clip(rng.uniform(-1.5, 9.0, (6, 5)), -1.5, 1.5)
        before, energy = lanes.record.temperature.copy(), lanes.record.energy.copy()
        lanes.step(action)
        asked = 0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * lanes.heating.max_power
        allowed = np.maximum(thermal.power_to_reach(before, CUT_OFF, STEP_S, lanes.heating), 0.0)
        power = np.minimum(asked, allowed)
        cut += int((allowed < asked).sum())
        np.testing.assert_allclose(lanes.record.power, power, rtol=1e-12, atol=1e-12)
        expected = thermal.step(before, power, STEP_S, lanes.heating)
        np.testing.assert_allclose(lanes.record.temperature, expected, rtol=1e-13)
        np.testing.assert_allclose(lanes.record.energy - energy, power.sum(axis=1) * STEP_S, rtol=1e-10)
    assert cut > 10
