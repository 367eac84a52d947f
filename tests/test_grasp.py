"""Grasping: every sentence of its contract, its symmetries, rough rides, and the same in the environment."""

import re
from dataclasses import replace
from math import atan2, cos, hypot, pi, sin

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tca_envs  # noqa: F401
from tca_envs.mechanics import Rung, continuation, grasp
from tca_envs.mechanics.grasp import ALONG, ASTRIDE, DROP, HELD, LOW, SCENE, STAGE, YAW, Box, Site, X, Y, Z
from tca_envs.robots import paper

same = settings(max_examples=50, deadline=None, derandomize=True)

BOX = Box(width=3e-3, length=12e-3, height=8e-3, mass=1.5e-3, friction=1.1)
SITE = Site(table=86.8e-3, travel=15e-3, jaw_width=6e-3, jaw_thickness=3e-3, gravity=9.81)
REST, TOP, RAISED = 82.8e-3, 78.8e-3, 72.8e-3
"""Depths of the centre and the top of the box on the table, and of the jaws with the stage up [m]."""
NEEDED = BOX.mass * SITE.gravity / (2.0 * BOX.friction)
WEAK, FIRM = 0.999 * NEEDED, 1.001 * NEEDED
WIDE, SHUT = 8e-3, 0.0
HAIR = 1e-9


def scene(x=0.0, y=0.0, yaw=0.0, **others):
    """One lane, a box on the table, the jaws above it; others by the name of their column."""
    result = np.zeros((1, SCENE))
    result[0, [X, Y, Z, YAW]] = x, y, REST, yaw
    for name, value in others.items():
        result[0, getattr(grasp, name)] = value
    return result


def act(before, down=0.0, gap=WIDE, pinch=0.0, tool=(0.0, 0.0, RAISED), heading=0.0, box=BOX, site=SITE):
    """Step the lanes of a scene, all alike where only one value is given."""
    n = len(before)
    full = (np.broadcast_to(np.asarray(value, dtype=float), (n,)).copy() for value in (heading, gap, pinch, down))
    return grasp.step(before, np.broadcast_to(tool, (n, 3)).copy(), *full, box, site)


def astride(x=0.0, y=0.0, yaw=0.0, down=10e-3, **others):
    """The jaws are wide open and around the box; they stand at its centre's height for `down` = 10 mm."""
    result = act(scene(x, y, yaw), down, **others)
    assert result[0, ASTRIDE] == 1.0
    return result


def grasped(x=0.0, y=0.0, yaw=0.0, down=10e-3, **others):
    result = act(astride(x, y, yaw, down, **others), gap=SHUT, pinch=FIRM, **others)
    assert result[0, HELD] == 1.0
    return result


def jaws(after, tool=RAISED):
    return tool + after[0, STAGE]


def lies_as_in(after, before):
    return np.array_equal(after[:, X : YAW + 1], before[:, X : YAW + 1])


# Small functions.


def test_extents_are_those_of_the_corners():
    turn = np.linspace(-4.0, 4.0, 41)
    corners = np.array([[1, 1, -1, -1], [1, -1, 1, -1]]) * 0.5 * np.array([[BOX.width], [BOX.length]])
    turned = np.array([[[cos(t), -sin(t)], [sin(t), cos(t)]] @ corners for t in turn])
    np.testing.assert_allclose(grasp.half_extents(turn, BOX), turned.max(axis=2).T, rtol=1e-14)


def test_the_largest_turn_is_where_the_box_touches_both_jaws():
    gap = np.linspace(BOX.width, 12e-3, 50)
    turn = grasp.largest_turn(gap, BOX)
    np.testing.assert_allclose(BOX.width * np.cos(turn) + BOX.length * np.sin(turn), gap, rtol=1e-12)
    assert (np.diff(turn) > 0.0).all()
    np.testing.assert_allclose(grasp.largest_turn(np.array([0.0, 2e-3, 3e-3]), BOX), 0.0, atol=1e-15)
    wide_enough = hypot(BOX.width, BOX.length) * np.array([1.0, 1.5])
    np.testing.assert_array_equal(grasp.largest_turn(wide_enough, BOX), pi / 2)


@same
@given(st.floats(-50.0, 50.0))
def test_a_half_turn_is_the_same_line(angle):
    turned = grasp.half_turn(np.array([angle]))[0]
    assert -pi / 2 <= turned < pi / 2
    assert sin(turned - angle) == pytest.approx(0.0, abs=1e-13)


def test_friction_of_both_jaws_carries_the_weight_or_not():
    pinch = np.array([0.0, WEAK, FIRM, 1.0])
    assert grasp.holds(pinch, BOX, SITE).tolist() == [False, False, True, True]
    light = Box(1.0, 1.0, 1.0, mass=2.0, friction=0.5)
    assert grasp.holds(np.array([3.0]), light, replace(SITE, gravity=1.5)).item()  # exactly: 2 mu N = m g


# The stage goes down.


def test_open_jaws_go_down_around_the_box():
    after = act(scene(x=1e-3, y=-2e-3, yaw=0.2), down=10e-3)
    assert jaws(after) == pytest.approx(REST)
    assert after[0, [ASTRIDE, HELD]].tolist() == [1.0, 0.0]
    np.testing.assert_allclose(after[0, X : YAW + 1], [1e-3, -2e-3, REST, 0.2], rtol=1e-14)


def test_jaws_above_the_top_touch_nothing():
    top = grasp.resting(BOX, SITE) - 0.5 * BOX.height
    for depth in (top - HAIR, top):
        after = act(act(scene(), tool=(0.0, 0.0, depth)), gap=SHUT, pinch=FIRM, tool=(0.0, 0.0, depth))
        assert not after[0, [HELD, ASTRIDE, LOW]].any()


TURN = float(grasp.largest_turn(np.array([WIDE]), BOX)[0])
BY_A_HAIR = pytest.mark.parametrize(
    "place",
    [
        lambda hair: {"gap": BOX.width - hair},
        lambda hair: {"x": 0.5 * (WIDE - BOX.width) + hair},
        lambda hair: {"x": -0.5 * (WIDE - BOX.width) - hair},
        lambda hair: {"yaw": TURN + hair},
        lambda hair: {"yaw": -TURN - hair},
        lambda hair: {"heading": 3.0, "yaw": 3.0 - TURN - hair},
        lambda hair: {"x": 1e-3, "yaw": 0.3, "gap": 2e-3 + BOX.width * cos(0.3) + BOX.length * sin(0.3) - hair},
    ],
    ids=["gap", "right", "left", "yaw", "-yaw", "heading", "all"],
)


def lowered(x=0.0, y=0.0, yaw=0.0, **others):
    before = scene(x, y, yaw)
    after = act(before, down=0.1, **others)
    assert lies_as_in(after, before) or after[0, ASTRIDE] == 1.0
    return after


@BY_A_HAIR
def test_jaws_stop_on_a_box_that_does_not_fit_by_a_hair(place):
    after = lowered(**place(HAIR))
    assert jaws(after) == pytest.approx(TOP, abs=1e-15)
    assert not after[0, [ASTRIDE, HELD, LOW]].any()


@BY_A_HAIR
def test_jaws_pass_a_box_that_fits_by_a_hair(place):
    after = lowered(**place(-HAIR))
    assert jaws(after) == pytest.approx(SITE.table)
    assert after[0, ASTRIDE] == 1.0


BESIDE = pytest.mark.parametrize(
    "place",
    [
        lambda hair: {"x": 0.5 * (WIDE + BOX.width) + SITE.jaw_thickness + hair},
        lambda hair: {"x": -0.5 * (WIDE + BOX.length) - SITE.jaw_thickness - hair, "yaw": -pi / 2},
        lambda hair: {"y": 0.5 * (SITE.jaw_width + BOX.length) + hair, "gap": SHUT},
        lambda hair: {"y": -0.5 * (SITE.jaw_width + BOX.width) - hair, "gap": SHUT, "yaw": pi / 2},
    ],
    ids=["right", "left", "before", "behind"],
)


@BESIDE
def test_jaws_beside_the_box_pass_it(place):
    after = lowered(**place(HAIR))
    assert jaws(after) == pytest.approx(SITE.table)
    assert after[0, LOW] == 1.0 and not after[0, [ASTRIDE, HELD]].any()


@BESIDE
def test_jaws_not_quite_beside_the_box_stop_on_it(place):
    assert jaws(lowered(**place(-HAIR))) == pytest.approx(TOP, abs=1e-15)


def test_jaws_that_rest_on_the_box_stay_there_when_the_arm_sinks():
    """The stage gives way."""
    rng = np.random.default_rng(0)
    now = act(scene(), down=0.1, gap=SHUT)
    for depth in RAISED + 1e-3 * rng.random(200):
        now = act(now, down=1e-3, gap=SHUT, tool=(0.0, 0.0, depth))
        assert jaws(now, depth) == pytest.approx(TOP, abs=1e-15)
        assert now[0, LOW] == 0.0
    opened = act(now, down=1e-3, tool=(0.0, 0.0, depth))
    assert jaws(opened, depth) == pytest.approx(TOP + 1e-3)
    assert opened[0, ASTRIDE] == 1.0


def test_a_raised_stage_cannot_give_way_but_the_jaws_stay_above_the_box():
    now = scene()
    for sunk in (-1e-3, 1e-3, 2e-3):
        now = act(now, gap=SHUT, tool=(0.0, 0.0, TOP + sunk))
        assert now[0, [STAGE, LOW, ASTRIDE]].tolist() == [0.0, 0.0, 0.0]
    opened = act(now, tool=(0.0, 0.0, TOP + sunk))
    assert opened[0, [LOW, ASTRIDE]].tolist() == [1.0, 1.0]


def test_an_arm_that_sinks_through_the_top_in_one_step_stops_there():
    hovering = act(scene(), down=TOP - RAISED - 1e-5, gap=SHUT)
    after = act(hovering, gap=SHUT, tool=(0.0, 0.0, RAISED + 1e-3))
    assert jaws(after, RAISED + 1e-3) == pytest.approx(TOP, abs=1e-15)


def test_a_box_further_off_than_the_jaws_are_wide_is_not_grasped():
    for y, caught in ((0.5 * SITE.jaw_width - HAIR, 1.0), (0.5 * SITE.jaw_width + HAIR, 0.0)):
        for side in (-1.0, 1.0):
            before = scene(y=side * y)
            after = act(act(before, down=10e-3), gap=SHUT, pinch=FIRM)
            assert jaws(after) == pytest.approx(REST)
            assert after[0, HELD] == caught
            assert lies_as_in(after, before)


@pytest.mark.parametrize("depth", [RAISED, 80e-3, 90e-3])
def test_the_stage_moves_as_asked_between_its_stops(depth):
    aside = scene(x=50e-3)
    tool = (0.0, 0.0, depth)
    low = min(SITE.travel, max(SITE.table - depth, 0.0))
    assert act(aside, down=4e-3, tool=tool)[0, STAGE] == pytest.approx(min(4e-3, low))
    assert act(aside, down=-4e-3, tool=tool)[0, STAGE] == 0.0
    bottom = act(aside, down=0.1, tool=tool)
    assert bottom[0, STAGE] == pytest.approx(low)
    assert act(bottom, down=-1e-3, tool=tool)[0, STAGE] == pytest.approx(max(low - 1e-3, 0.0))


def test_the_stage_ends_at_its_travel():
    assert act(scene(x=50e-3), down=0.1, tool=(0.0, 0.0, 60e-3))[0, STAGE] == SITE.travel


# The jaws close.


@same
@given(st.floats(-0.9e-3, 0.9e-3), st.floats(-2.9e-3, 2.9e-3), st.floats(-0.2, 0.2), st.floats(-4.0, 4.0))
def test_closing_jaws_push_the_box_to_their_middle_and_into_line(across, along, turn, heading):
    c, s = cos(heading), sin(heading)
    now = astride(c * across - s * along, s * across + c * along, heading + turn, heading=heading)
    for gap in np.linspace(WIDE, BOX.width, 60):
        before, now = now, act(now, gap=gap, heading=heading)
        off = c * now[0, X] + s * now[0, Y]
        tilt = grasp.half_turn(now[0, YAW] - heading)
        taken = BOX.width * cos(tilt) + BOX.length * abs(sin(tilt))
        assert 2.0 * abs(off) + taken <= gap + 1e-12
        if not np.allclose(now[0, X : YAW + 1], before[0, X : YAW + 1], rtol=0.0, atol=1e-15):  # pushed: it touches a jaw
            assert 2.0 * abs(off) + taken == pytest.approx(gap, abs=1e-12)
        if abs(tilt) < abs(grasp.half_turn(before[0, YAW] - heading)) - 1e-14:  # turned: it touches both
            assert taken == pytest.approx(gap, abs=1e-12)
        assert c * now[0, Y] - s * now[0, X] == pytest.approx(along, abs=1e-14)
    assert off == pytest.approx(0.0, abs=1e-12)
    assert tilt == pytest.approx(0.0, abs=1e-12)
    assert now[0, [HELD, ASTRIDE]].tolist() == [0.0, 1.0]
    assert now[0, Z] == REST


def test_jaws_around_a_box_push_it_along_with_them():
    now = astride()
    for x in np.linspace(0.0, 20e-3, 21):
        now = act(now, tool=(x, 0.0, RAISED))
    assert now[0, X] == pytest.approx(20e-3 - 0.5 * (WIDE - BOX.width))
    for heading in np.linspace(0.0, 1.5, 16):
        now = act(now, tool=(20e-3, 0.0, RAISED), heading=heading)
    assert now[0, YAW] == pytest.approx(1.5 - TURN)
    assert now[0, ASTRIDE] == 1.0


def test_jaws_that_move_along_the_box_leave_it():
    now = astride()
    for y in (2e-3, 4e-3):
        now = act(now, tool=(0.0, y, RAISED))
    assert now[0, ASTRIDE] == 0.0
    after = act(now, gap=SHUT, pinch=FIRM, tool=(0.0, 4e-3, RAISED))
    assert after[0, HELD] == 0.0 and lies_as_in(after, scene())
    # Once out, they are not around it again until they come from above.
    assert act(now)[0, ASTRIDE] == 0.0


@pytest.mark.parametrize(
    ("gap", "pinch", "held"), [(SHUT, FIRM, 1.0), (SHUT, WEAK, 0.0), (BOX.width, FIRM, 1.0), (BOX.width + HAIR, FIRM, 0.0)]
)
def test_a_box_is_held_where_the_jaws_touch_it_and_friction_carries_it(gap, pinch, held):
    after = act(astride(x=1e-3, yaw=0.2), gap=gap, pinch=pinch)
    assert after[0, [HELD, ASTRIDE]].tolist() == [held, 1.0 - held]
    np.testing.assert_allclose(after[0, X : YAW + 1], [0.0, 0.0, REST, 0.0], atol=1e-7)


def test_raised_jaws_leave_a_box_that_they_do_not_hold():
    pinched = act(astride(), gap=SHUT, pinch=WEAK)
    after = act(pinched, down=-8e-3, gap=SHUT, pinch=WEAK)
    assert not after[0, [HELD, ASTRIDE]].any()
    assert lies_as_in(after, pinched)
    firm = act(after, gap=SHUT, pinch=FIRM)  # too late
    assert firm[0, HELD] == 0.0


@pytest.mark.parametrize("down", [7e-3, 10e-3, 13e-3])
def test_a_grasp_keeps_where_the_box_is_in_the_jaws(down):
    after = grasped(x=1e-3, y=2e-3, yaw=0.1, down=down)
    assert after[0, ALONG] == pytest.approx(2e-3)
    assert after[0, DROP] == pytest.approx(10e-3 - down, abs=1e-15)


# The box is carried.


@pytest.mark.parametrize("down", [7e-3, 10e-3, 13e-3])
def test_a_held_box_moves_with_the_jaws(down):
    now = grasped(x=1e-3, y=2e-3, down=down)
    for k in range(1, 11):
        tool, heading = np.array([2e-3 * k, -1e-3 * k, RAISED - 1e-4 * k]), 0.2 * k
        now = act(now, down=-1e-3, gap=SHUT, pinch=FIRM, tool=tool, heading=heading)
        stage = max(down - 1e-3 * k, 0.0)
        assert now[0, STAGE] == pytest.approx(stage)
        assert now[0, [HELD, ASTRIDE]].tolist() == [1.0, 0.0]
        expected = np.add(tool, [-2e-3 * sin(heading), 2e-3 * cos(heading), stage + 10e-3 - down])
        np.testing.assert_allclose(now[0, X : Z + 1], expected, rtol=1e-12)
        assert sin(now[0, YAW] - heading) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("down", [7e-3, 10e-3, 13e-3])
def test_the_stage_stops_where_a_held_box_meets_the_table(down):
    """Which is before the jaws do; by an arm that hangs lower, it stops earlier."""
    lifted = act(grasped(down=down), down=-5e-3, gap=SHUT, pinch=FIRM)
    assert lifted[0, Z] == pytest.approx(REST - 5e-3)
    for sunk in (0.0, 1e-3):
        after = act(lifted, down=0.1, gap=SHUT, pinch=FIRM, tool=(0.0, 0.0, RAISED + sunk))
        assert after[0, STAGE] == pytest.approx(down - sunk)
        assert after[0, Z] == pytest.approx(REST, abs=1e-15)


def test_a_held_box_stays_on_the_table_when_the_arm_sinks():
    """The stage gives way as far as it can, and the box never goes below."""
    now = grasped(down=7e-3)
    for sunk in (1e-3, 5e-3, 10e-3):
        now = act(now, gap=SHUT, pinch=FIRM, tool=(0.0, 0.0, RAISED + sunk))
        assert now[0, STAGE] == pytest.approx(max(7e-3 - sunk, 0.0))
        assert now[0, Z] == pytest.approx(REST, abs=1e-15)
        assert now[0, HELD] == 1.0


def lost(lifted_by, gap=BOX.width, down=10e-3):
    """Held, lifted, carried 5 mm away, then too weakly pinched; with the scene before."""
    carried = act(grasped(y=1e-3, down=down), -lifted_by, SHUT, FIRM, tool=(5e-3, 0.0, RAISED), heading=0.5)
    assert carried[0, HELD] == 1.0
    return carried, act(carried, gap=gap, pinch=WEAK, tool=(5e-3, 0.0, RAISED), heading=0.5)


def test_a_box_that_slips_falls_straight_down_and_rests_where_it_lands():
    before, after = lost(10e-3)
    assert before[0, Z] == pytest.approx(REST - 10e-3)
    np.testing.assert_array_equal(after[0, [X, Y, YAW]], before[0, [X, Y, YAW]])
    assert after[0, Z] == REST
    assert not after[0, [HELD, ASTRIDE, ALONG, DROP]].any()
    for k in range(10):  # nothing moves it any more
        again = act(after, gap=SHUT, pinch=FIRM, tool=(1e-3 * k, 0.0, RAISED))
        assert again[0, HELD] == 0.0 and lies_as_in(again, after)


@pytest.mark.parametrize("lifted_by", [0.0, 2e-3, 3.9e-3])
def test_a_box_that_slips_between_low_jaws_stands_between_them(lifted_by):
    before, after = lost(lifted_by)
    np.testing.assert_allclose(after[0, [X, Y, YAW]], before[0, [X, Y, YAW]], atol=1e-15)
    assert after[0, Z] == REST
    assert after[0, [HELD, ASTRIDE]].tolist() == [0.0, 1.0]
    again = act(after, gap=SHUT, pinch=FIRM, tool=(5e-3, 0.0, RAISED), heading=0.5)
    assert again[0, HELD] == 1.0
    assert again[0, DROP] == pytest.approx(lifted_by)


def test_a_box_that_slips_on_the_table_is_pushed_by_jaws_that_move_on():
    after = act(grasped(), gap=BOX.width + 1e-3, pinch=0.0, tool=(2e-3, 0.0, RAISED), heading=0.0)
    assert after[0, ASTRIDE] == 1.0
    assert after[0, X] == pytest.approx(2e-3 - 0.5e-3)
    away = act(grasped(), gap=WIDE, pinch=0.0, tool=(0.0, 4e-3, RAISED))
    assert away[0, ASTRIDE] == 0.0
    assert lies_as_in(away, scene())


def test_a_dropped_box_can_be_grasped_again():
    _, dropped = lost(10e-3)
    tool, heading = (5e-3, 0.0, RAISED), 0.5
    around = act(dropped, down=9e-3, tool=tool, heading=heading)
    assert around[0, ASTRIDE] == 1.0
    again = act(around, gap=SHUT, pinch=FIRM, tool=tool, heading=heading)
    up = act(again, down=-5e-3, gap=SHUT, pinch=FIRM, tool=tool, heading=heading)
    assert up[0, HELD] == 1.0
    assert up[0, Z] == pytest.approx(REST - 5e-3)
    np.testing.assert_allclose(up[0, [X, Y, YAW]], dropped[0, [X, Y, YAW]], atol=1e-15)


# Many lanes and rough rides.


def ride(seed, lanes=300, steps=60):
    """Yield (before, inputs, after) of random rides: mostly careful ones over the box, some wild."""
    rng = np.random.default_rng(seed)
    now = np.repeat(scene(), lanes, axis=0)
    now[:, X:Z] = rng.normal(0.0, 1.5e-3, (lanes, 2))
    now[:, YAW] = grasp.half_turn(rng.normal(0.0, 0.3, lanes))
    tool, heading = np.tile([0.0, 0.0, RAISED], (lanes, 1)), rng.normal(0.0, 0.1, lanes)
    wild = 10.0 ** rng.uniform(-2.0, 0.5, lanes)
    heat, friction = rng.random(lanes), rng.choice([0.5, 1.0, 4.0], lanes)
    for k in range(steps):
        plan = k % 30  # open, down, close, up
        tool += 1e-3 * wild[:, np.newaxis] * rng.normal(size=(lanes, 3)) * [1.0, 1.0, 0.3]
        heading = heading + 0.2 * wild * rng.normal(size=lanes)
        heat = np.clip(heat + np.where(plan < 15, 0.2, -0.15) + 0.1 * rng.normal(size=lanes), 0.0, 1.0)
        gap = 8.5e-3 * heat**2
        pinch = friction * np.maximum(BOX.width + 0.2e-3 - gap, 0.0) * 10.0  # as a coarse table might have it
        lowering = 1e-3 * (np.where((plan > 4) & (plan < 22), 1.0, -1.0) + rng.normal(size=lanes))
        inputs = (tool.copy(), heading, gap, pinch, lowering)
        after = grasp.step(now, *inputs, BOX, SITE)
        yield now, inputs, after
        now = after


def check(before, inputs, after):
    """Assert what holds in every step of every ride."""
    tool, heading, gap, pinch, _ = inputs
    assert after.shape == before.shape and np.isfinite(after).all()
    for flag in (HELD, ASTRIDE, LOW):
        assert np.isin(after[:, flag], (0.0, 1.0)).all()
    held, between, was_held = after[:, HELD] == 1.0, after[:, ASTRIDE] == 1.0, before[:, HELD] == 1.0
    free = ~held & ~between
    assert not (held & between).any()
    # Stage and jaws.
    stage, low = after[:, STAGE], tool[:, 2] + after[:, STAGE]
    assert (stage >= 0.0).all() and (stage <= SITE.travel).all()
    assert ((low <= SITE.table + 1e-15) | (stage == 0.0)).all()
    assert (low[between] > TOP).all()
    # The box is on the table or in the jaws, and nothing else moves it.
    assert (after[:, Z] <= REST).all()
    assert (after[~held, Z] == REST).all()
    np.testing.assert_array_equal(after[free, X:Z], before[free, X:Z])
    np.testing.assert_array_equal(after[free, YAW], before[free, YAW])
    assert ((after[:, YAW] >= -pi / 2) & (after[:, YAW] < pi / 2)).all()
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = after[:, X] - tool[:, 0], after[:, Y] - tool[:, 1]
    across, along = c * dx + s * dy, c * dy - s * dx
    tilt = np.arcsin(np.abs(np.sin(after[:, YAW] - heading)))
    extent = 0.5 * (BOX.width * np.cos(tilt) + BOX.length * np.sin(tilt))
    assert (np.abs(across) + extent <= 0.5 * np.maximum(gap, BOX.width) + 1e-12)[between].all()
    assert (np.abs(along) <= 0.5 * SITE.jaw_width + 1e-12)[held | between].all()
    # Held ones.
    assert (2.0 * BOX.friction * pinch >= BOX.mass * SITE.gravity)[held].all()
    assert (gap <= BOX.width)[held & ~was_held].all()
    assert (tilt[held] < 1e-12).all() and (np.abs(across[held]) < 1e-12).all()
    np.testing.assert_allclose(along[held], after[held, ALONG], atol=1e-12)
    assert (np.abs(after[held, Z] - np.minimum(low + after[:, DROP], REST)[held]) < 1e-15).all()
    assert (after[held & was_held, DROP] == before[held & was_held, DROP]).all()


def test_rough_rides_break_no_law():
    caught = lost = pushed = stopped = 0
    for before, inputs, after in ride(0, lanes=3000):
        check(before, inputs, after)
        held, was_held = after[:, HELD] > 0.5, before[:, HELD] > 0.5
        caught += (held & ~was_held).sum()
        lost += (was_held & ~held).sum()
        pushed += ((before[:, ASTRIDE] > 0.5) & (before[:, X] != after[:, X])).sum()
        stopped += (np.abs(inputs[0][:, 2] + after[:, STAGE] - TOP) < 1e-15).sum()
    assert min(caught, lost, pushed, stopped) > 1000


@same
@given(st.integers(0, 2**32), st.integers(1, 8), st.integers(1, 80))
def test_short_rides_break_no_law(seed, lanes, steps):
    for before, inputs, after in ride(seed, lanes, steps):
        check(before, inputs, after)


numbers, positive = st.floats(-0.02, 0.02), st.floats(0.0, 0.1)


@same
@given(
    st.lists(
        st.tuples(numbers, numbers, positive, st.floats(-10.0, 10.0), st.floats(0.0, 0.02), positive, numbers),
        max_size=12,
    )
)
def test_any_sequence_breaks_no_law(sequence):
    now = scene()
    for x, y, z, *others in sequence:
        inputs = (np.array([[x, y, z]]), *(np.array([value]) for value in others))
        after = grasp.step(now, *inputs, BOX, SITE)
        check(now, inputs, after)
        now = after


def test_every_lane_is_alone():
    for before, inputs, after in ride(1, lanes=37):
        for i in range(37):
            single = grasp.step(before[i : i + 1], *(values[i : i + 1] for values in inputs), BOX, SITE)
            assert single.tobytes() == after[i : i + 1].tobytes()


def test_nothing_that_is_given_changes():
    for before, inputs, _ in ride(2, lanes=50):
        copies = [values.copy() for values in (before, *inputs)]
        for values in (before, *inputs):
            values.setflags(write=False)
        after = grasp.step(before, *inputs, BOX, SITE)
        assert not np.shares_memory(after, before)
        for values, copied in zip((before, *inputs), copies, strict=True):
            assert values.tobytes() == copied.tobytes()


def assert_alike(first, second):
    """Equal up to rounding; a yaw is a line."""
    others = [column for column in range(SCENE) if column != YAW]
    np.testing.assert_allclose(first[:, others], second[:, others], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(np.sin(first[:, YAW] - second[:, YAW]), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "shift"), [(0.7, (0.0, 0.0)), (-2.0, (0.03, -0.01)), (pi / 2, (1.0, 2.0)), (11.0, (0.0, 0.0))]
)
def test_the_vertical_has_no_preferred_direction_or_place(angle, shift):
    c, s = cos(angle), sin(angle)

    def moved(places):
        return np.column_stack([c * places[:, 0] - s * places[:, 1], s * places[:, 0] + c * places[:, 1]]) + shift

    def turned(scenes):
        result = scenes.copy()
        result[:, X:Z] = moved(scenes[:, X:Z])
        result[:, YAW] = grasp.half_turn(scenes[:, YAW] + angle)
        return result

    for before, (tool, heading, *others), after in ride(3, lanes=100):
        elsewhere = np.column_stack([moved(tool), tool[:, 2]])
        assert_alike(turned(after), grasp.step(turned(before), elsewhere, heading + angle, *others, BOX, SITE))


def test_a_box_and_a_pair_of_jaws_look_the_same_from_behind():
    for before, (tool, heading, *others), after in ride(4, lanes=100):
        behind = before.copy()
        behind[:, YAW] += pi
        assert_alike(after, grasp.step(behind, tool, heading, *others, BOX, SITE))
        swapped = before.copy()
        swapped[:, ALONG] *= -1.0
        mirrored = grasp.step(swapped, tool, heading + pi, *others, BOX, SITE)
        mirrored[:, ALONG] *= -1.0
        assert_alike(after, mirrored)


def test_depth_has_no_preferred_place():
    for before, (tool, *others), after in ride(5, lanes=100):
        deeper, expected = before.copy(), after.copy()
        deeper[:, Z] += 0.1
        expected[:, Z] += 0.1
        site = replace(SITE, table=SITE.table + 0.1)
        assert_alike(expected, grasp.step(deeper, np.add(tool, [0.0, 0.0, 0.1]), *others, BOX, site))


# Bad arguments.


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf"), "1", None, True, [1.0]], ids=repr)
@pytest.mark.parametrize(
    ("thing", "name"), [(thing, name) for thing in (BOX, SITE) for name in thing.__dataclass_fields__], ids=str
)
def test_bad_numbers_are_refused(thing, name, bad):
    with pytest.raises(ValueError, match=re.escape(f"{name} = {bad!r}: expected")):
        replace(thing, **{name: bad})


# In the environment, by hand.

HEAT, COOL = 1.0, -1.0
DOWN, STAY, UP = 1.0, 0.0, -1.0


@pytest.fixture(scope="module")
def made():
    return gym.make("TCAPickAndPlace-v0")


class Hand:
    """An episode whose arm hangs straight, with the box at a place of one's own."""

    def __init__(self, made, x=0.0, y=0.0, yaw=0.0):
        made.reset(seed=0)
        self.env = made.unwrapped
        state = self.env.get_state()
        tip = state["tip"][0]
        self.under = tip[:2, 3] + paper.JAW_DEPTH * tip[:2, 2]
        state["scene"][0, [X, Y, YAW]] = *np.add(self.under, [x, y]), self.yaw + yaw
        state["goal"][0, :3] = 100.0 * np.array([*self.under, REST])
        self.env.set_state(state)

    def do(self, steps, ring=COOL, stage=STAY, bending=COOL):
        for _ in range(steps):
            action = np.array([bending, COOL, COOL, COOL, ring, stage], dtype=np.float32)
            self.observation, self.reward, terminated, truncated, self.info = self.env.step(action)
            assert not terminated and not truncated
        return self

    def pick(self, down=10):
        return self.do(25, ring=HEAT).do(down, ring=HEAT, stage=DOWN).do(20).do(8, stage=UP)

    @property
    def record(self):
        return self.env.core.record

    @property
    def scene(self):
        return self.record.scene[0]

    @property
    def yaw(self):
        tip = self.record.tip[0] if hasattr(self, "observation") else self.env.core.rest.tip[0]
        return atan2(tip[1, 0] - tip[0, 1], tip[0, 0] + tip[1, 1])

    @property
    def tool(self):
        tip = self.record.tip[0]
        return tip[:3, 3] + paper.JAW_DEPTH * tip[:3, 2]


def test_jaws_that_close_on_nothing_hold_nothing(made):
    hand = Hand(made, x=20e-3)
    place = hand.scene[X : YAW + 1].copy()
    hand.pick()
    assert not hand.scene[[HELD, ASTRIDE]].any()
    np.testing.assert_array_equal(hand.scene[X : YAW + 1], place)
    assert hand.record.payload[0, 0] == paper.GRIPPER_MASS
    assert hand.observation["observation"][17] == 0.0  # pinch force


def test_closed_jaws_come_to_rest_on_the_object(made):
    hand = Hand(made).do(15, stage=DOWN)
    top = paper.TABLE - paper.OBJECT.height
    assert hand.tool[2] + hand.scene[STAGE] == pytest.approx(top, abs=1e-12)
    assert not hand.scene[[HELD, ASTRIDE]].any()
    stage = hand.scene[STAGE]
    hand.do(10, stage=DOWN)
    assert hand.scene[STAGE] == pytest.approx(stage, abs=1e-6)
    free = Hand(made, x=20e-3).do(15, stage=DOWN)
    assert free.tool[2] + free.scene[STAGE] == pytest.approx(paper.TABLE, abs=1e-12)


def test_a_held_object_hangs_from_the_arm(made):
    alone = Hand(made, x=20e-3).pick()
    unloaded = alone.record.tip[0, 2, 3]
    hand = Hand(made, x=0.5e-3, y=1e-3, yaw=0.1).pick(down=12)
    assert hand.scene[HELD] == 1.0
    assert hand.scene[Z] < REST - 7e-3
    assert sin(hand.scene[YAW] - hand.yaw) == pytest.approx(0.0, abs=1e-9)
    # Gripper and box together, where they are (the frame of the tip is that of the raised base, and hardly tilted).
    mass, *centre = hand.record.payload[0]
    assert mass == pytest.approx(paper.GRIPPER_MASS + paper.OBJECT.mass)
    tip, raised = hand.record.tip[0], [0.0, 0.0, hand.scene[STAGE]]
    ring = tip[:3, :3] @ paper.GRIPPER_CENTRE + tip[:3, 3]
    together = paper.GRIPPER_MASS * ring + paper.OBJECT.mass * (hand.scene[X : Z + 1] - raised)
    np.testing.assert_allclose(tip[:3, :3] @ centre + tip[:3, 3], together / mass, atol=6e-5)
    assert abs(hand.scene[ALONG]) > 0.8e-3 and hand.scene[DROP] < -1.5e-3
    # 15 mN stretch a 61 mm arm of EA = 2 N by 0.45 mm; its coils help to carry it.
    assert 0.1e-3 < hand.record.tip[0, 2, 3] - unloaded < 0.45e-3
    *place, _, _, _, opening, pinch, x, y, z, _, _ = hand.observation["observation"][10:]
    np.testing.assert_allclose(place, 100.0 * (hand.tool + raised), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose([x, y, z], 100.0 * hand.scene[X : Z + 1], rtol=1e-6, atol=1e-6)
    assert opening == pytest.approx(100.0 * paper.OBJECT.width)
    assert 0.05 * pinch > NEEDED


def test_what_is_put_down_at_the_target_is_placed(made):
    hand = Hand(made, x=0.5e-3).pick()
    assert not hand.info["is_success"] and hand.reward == -1.0
    hand.do(10, stage=DOWN)
    assert hand.scene[Z] == pytest.approx(REST, abs=1e-12)
    hand.do(25, ring=HEAT)
    assert hand.scene[[HELD, ASTRIDE]].tolist() == [0.0, 1.0]
    assert not hand.info["is_success"]  # the gripper is around it
    assert hand.record.payload[0, 0] == paper.GRIPPER_MASS
    hand.do(10, ring=HEAT, stage=UP)
    assert not hand.scene[[HELD, ASTRIDE]].any()
    assert hand.info["is_success"] and hand.reward == 0.0


def test_an_object_falls_from_a_ring_that_heats_up(made):
    hand = Hand(made).pick()
    place = hand.scene[[X, Y, YAW]].copy()
    hand.do(20, ring=HEAT)
    assert not hand.scene[[HELD, ASTRIDE]].any()
    assert hand.scene[Z] == REST
    # The arm that lost its load moves up, not aside.
    np.testing.assert_allclose(hand.scene[[X, Y, YAW]], place, atol=1e-6)


def test_the_tabulated_pinch_is_that_of_the_ring(made):
    task = made.unwrapped.task
    heats = np.linspace(25.0, 158.0, 38)
    record = task.core(len(heats)).record
    record.temperature[:, 4] = heats
    np.testing.assert_allclose(task.pinch(record), task.gripper.ring.pinch(heats, paper.OBJECT.width), atol=3e-4)


def test_without_an_equilibrium_nothing_moves(made, monkeypatch):
    hand = Hand(made).pick()
    before = hand.env.get_state()

    def without_answer(arm, lanes, drive, *rest):
        report = np.zeros(len(drive), dtype=continuation.REPORT)
        report["rung"], report["residual"], report["iterations"] = Rung.FAILED, 1.0, 7
        return report

    monkeypatch.setattr(hand.env.core, "solve", without_answer)
    *_, truncated, _ = hand.env.step(np.ones(6, dtype=np.float32))
    assert truncated
    after = hand.env.get_state()
    before["steps"] += 1  # time goes on
    assert all(np.array_equal(before[key], after[key]) for key in before if key != "rng")
