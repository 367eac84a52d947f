"""The least time to a goal: against the closed form, a search of the states, and what controllers take."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import tca_envs  # noqa: F401
from agents.evaluate import evaluate
from agents.fastest import fastest, grip_times, least_time
from agents.scripted import controller_of, plan, tip_at
from tca_envs import registry
from tca_envs.mechanics import grasp, thermal
from tca_envs.mechanics.thermal import AMBIENT
from tca_envs.robots import paper
from tca_envs.tasks.core import STEP_S

ENVS = {"reach": "TCAReach-v0", "twist-align": "TCATwistAlign-v0", "pick-and-place": "TCAPickAndPlace-v0"}
HOT = np.array([60.0, 110.0, 35.0])


def first(task, seed):
    return gym.make(ENVS[task], split="held-out").reset(seed=seed)[0]


@pytest.fixture(scope="module")
def aimed():
    """The bending robot and the aim of the tip that it has at HOT."""
    return paper.BENDING, tip_at(paper.BENDING.built().equilibrium(HOT).tip_pose[:3, 3])


def test_without_tolerance_it_is_the_closed_form_of_the_hottest(aimed):
    robot, aim = aimed
    heating = robot.heating()
    expected = thermal.time_to_reach(AMBIENT, HOT, heating)[1]
    assert least_time(robot, aim, [(slice(3), 2e-5)], HOT) == pytest.approx(expected, abs=0.01)


def test_from_warm_it_is_the_time_to_heat_or_to_cool(aimed):
    """One TCA that is too hot takes longest, or one that is too cold."""
    robot, aim = aimed
    heating = robot.heating()
    for start in (np.array([100.0, 110.0, 35.0]), np.array([25.0, 105.0, 35.0])):
        expected = thermal.time_to_reach(start, HOT, heating).max()
        found = least_time(robot, aim, [(slice(3), 2e-5)], HOT, start)
        assert found == pytest.approx(expected, abs=0.06) and found > 0.2


def test_no_cooler_state_is_within_the_tolerance_and_the_edge_is(aimed):
    """All temperatures that full power comes to in 0.05 s less, on a grid finer than the tolerance: 1 mm is some 20 K."""
    robot, aim = aimed
    heating = robot.heating()
    found = least_time(robot, aim, [(slice(3), 1e-3)], HOT)
    nearest = []
    for time in (found - 0.05, found + 0.02):
        hottest = thermal.step(AMBIENT, heating.max_power, time, heating)[0]
        axis = np.linspace(AMBIENT, hottest, 9)
        here, distances = None, []
        for i, row in enumerate(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(81, 9, 3)):
            for temperature in row[:: 1 - 2 * (i % 2)]:
                here = robot.built().equilibrium(temperature, start=here)
                distances.append(np.linalg.norm(aim(here)[0]))
        nearest.append(min(distances))
    assert nearest[0] > 1e-3
    assert nearest[1] < 1.1e-3


@pytest.mark.parametrize("task", ["reach", "twist-align"])
def test_the_scripted_controller_is_never_faster_and_not_much_slower(task):
    env, controller = gym.make(ENVS[task], split="held-out"), controller_of(task)
    times = [(evaluate(controller, env, 1, seed).time_to_success_s, fastest(task, first(task, seed))) for seed in range(10)]
    taken, least = np.array(times).T
    assert (taken > least - 1e-9).all()
    assert 1.0 < taken.sum() / least.sum() < 1.25


def test_pick_and_place_takes_at_least_heating_opening_closing_and_carrying():
    observation = first("pick-and-place", 3)
    controller = controller_of("pick-and-place")
    controller.predict(observation)
    heating = paper.WHOLE.heating()
    there = controller.plans["object"][1]
    alone = thermal.time_to_reach(AMBIENT, there, heating).max()
    found = fastest("pick-and-place", observation)
    assert found > max(alone, sum(grip_times(controller.task))) + 0.2
    env = gym.make(ENVS["pick-and-place"], split="held-out")
    assert found < evaluate(controller, env, 1, 3).time_to_success_s


def test_grip_times_are_those_of_the_gripper():
    """After them the object just fits, and friction just holds it."""
    task = registry.entry("pick-and-place").new()
    jaws, box = task.gripper.ring, task.box
    heating = task.robot.heating().part(slice(4, 5))
    opening, closing = grip_times(task)
    hot = thermal.step(AMBIENT, heating.max_power, opening, heating)
    assert jaws.gap(hot)[0] == pytest.approx(box.width, abs=1e-5)
    for share, holds in ((0.9, False), (1.1, True)):
        cool = thermal.step(hot, 0.0, share * closing, heating)
        assert grasp.holds(jaws.pinch(cool, box.width), box, task.site)[0] == holds


def test_it_is_a_whole_number_of_steps():
    for task in ENVS:
        steps = fastest(task, first(task, 1)) / STEP_S
        assert steps == pytest.approx(round(steps), abs=1e-9) and steps > 0


def test_a_goal_out_of_reach_is_an_error(aimed):
    robot, _ = aimed
    far = tip_at(np.array([0.06, 0.0, 0.0]))
    with pytest.raises(RuntimeError, match="no least time"):
        least_time(robot, far, [(slice(3), 1e-3)], plan(robot, far, HOT[np.newaxis]))


def test_an_unknown_task_is_refused():
    with pytest.raises(ValueError, match="task = 'fly': expected one of 'reach'"):
        fastest("fly", {})


def test_a_task_without_one_has_none(monkeypatch):
    entry = replace(registry.entry("reach"), fastest=None)
    monkeypatch.setattr(registry, "entry", lambda name: entry)
    assert np.isnan(fastest("reach", {}))
