"""One entry makes a task known: a user's task on a user's robot, and the paper's tasks on other robots."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from tca_envs import batch, geometry, registry
from tca_envs.mechanics import Arm, Module, Muscle, Payload, Tendon, continuation, grasp
from tca_envs.registry import Entry
from tca_envs.robots import Limits, Robot, paper
from tca_envs.viewer.session import Session

TASKS = ("reach", "twist-align", "pick-and-place")


# --- a user's task and robot ------------------------------------------------------------------------------------------------


def test_a_task_and_a_robot_take_fewer_than_60_lines():
    assert len((Path(__file__).with_name("toy.py")).read_text().splitlines()) < 60


@pytest.mark.parametrize("name", ["ToyTurn-v0", "ToyTurnDense-v0"])
def test_checkers_take_a_users_task(toy, name):
    env = gym.make(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
        check_env_sb3(env.unwrapped)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[3] for _ in range(20)]
    assert ends == [False] * 19 + [True]


def test_rows_of_a_users_vector_environment_are_its_single_environments(toy):
    many = gym.make_vec("ToyTurnDense-v0", num_envs=3, threads=1)
    singles = [gym.make("ToyTurnDense-v0") for _ in range(3)]
    first, rng = many.reset(seed=4)[0], np.random.default_rng(0)
    for i, single in enumerate(singles):
        alone = single.reset(seed=4 + i)[0]
        assert all(alone[key].tobytes() == first[key][i].tobytes() for key in alone)
    for _ in range(15):
        action = rng.uniform(-1, 1, (3, 5)).astype(np.float32)
        seen, reward, *_ = many.step(action)
        for i, single in enumerate(singles):
            alone, alone_reward, *_ = single.step(action[i])
            assert all(alone[key].tobytes() == seen[key][i].tobytes() for key in alone) and alone_reward == reward[i]


def test_a_users_goals_are_those_that_its_robot_reaches(toy):
    task = registry.entry("turn").new()
    core = task.core(1)
    goals, scenes = task.sample(core, np.random.default_rng(0).spawn(20))
    np.testing.assert_allclose(np.linalg.norm(goals, axis=1), 1.0, atol=1e-12)
    assert np.ptp(np.arctan2(goals[:, 1], goals[:, 0])) > 0.5 and (scenes == 0.5).all()


def test_a_users_task_is_drawn_where_it_is_with_what_is_its_own(toy):
    env = gym.make("ToyTurn-v0").unwrapped
    env.reset(seed=0)
    for _ in range(8):
        env.step(np.array([1.0, -1.0, -1.0, -1.0, 0.5], dtype=np.float32))
    shown, record = env.task.parts(env.core), env.core.record
    ends = {f"plate {k} {end}" for k in (0, 1) for end in ("top", "bottom")}
    coils = {f"coil {i}" for i in range(5)}
    assert set(shown) == {"module 0", "module 1", "goal", "stage", "column", "table"} | ends | coils  # no gripper, no object
    assert shown["module 0"].axis[0] == pytest.approx([0.0, 0.0, 0.0])  # not lowered by what the scene holds
    assert shown["module 1"].axis[-1] == pytest.approx(record.tip[0, :3, 3], abs=1e-6)
    assert shown["stage"].vertices[:, 2].max() == pytest.approx(-geometry.PLATE_THICKNESS)
    assert shown["table"].vertices[:, 2].min() == pytest.approx(env.task.robot.ground)
    assert env.task.robot.ground > shown["module 1"].vertices[:, 2].max()
    assert len(shown["goal"].vertices) == len(geometry.ball(np.zeros(3), 1.0, "", 1.0).vertices)
    assert shown["goal"].vertices.mean(axis=0)[2] == pytest.approx(0.1)


def test_a_users_task_is_seen_as_a_whole(toy, drawing):
    env = gym.make("ToyTurn-v0", render_mode="rgb_array", width=120, height=120)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (120, 120, 3) and picture.dtype == np.uint8
    dark = picture.max(axis=2) < 140
    dark[:, 100:] = dark[:40, :45] = False  # colour bar and readout
    row, column = np.nonzero(dark)
    assert row.min() > 5 and row.max() < 115 and column.min() > 35 and column.max() < 85  # it stands in the middle
    assert np.ptp(row) > 50
    env.close()
    depth = gym.make("ToyTurn-v0", render_mode="depth_array", width=120, height=120)
    depth.reset(seed=0)
    seen = depth.render()
    # The camera stands as far away as the arm is larger than the paper's.
    assert seen[np.isfinite(seen)].min() == pytest.approx(0.28 * toy.ROBOT.ground / paper.TABLE, rel=0.2)
    depth.close()


def test_the_viewer_takes_a_users_task(toy):
    session = Session("toy:turn", seed=3)
    assert [control.label for control in session.controls] == ["Bend 0°", "Bend 90°", "Bend 180°", "Bend 270°", "Twist"]
    session.command[0] = session.controls[0].most
    for _ in range(5):
        session.step()
    assert session.core.record.tip[0, 0, 3] > 1e-3 and session.solve.converged and "goal" in session.parts()
    assert session.core.record.power[0].tolist() == pytest.approx([session.controls[0].most, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"controller = 'scripted': expected one of 'manual'$"):
        session.drive_by("scripted")


# --- the registry -----------------------------------------------------------------------------------------------------------


def test_entries_name_the_tasks_and_register_their_ids():
    assert tuple(entry.name for entry in registry.entries()) == TASKS
    for entry in registry.entries():
        for reward, name in entry.ids.items():
            assert gym.spec(name).kwargs == {"task": entry.name, "reward": reward}
            assert gym.spec(name).max_episode_steps == entry.steps
        assert entry.new(split="held-out").split == "held-out"
        assert entry.title == type(entry.new()).__name__


def test_a_name_with_a_module_imports_it_first(toy):
    assert registry.entry("toy:turn").task is toy.Turn
    with pytest.raises(ValueError, match=r"task = 'toy:juggle': expected one of 'reach', .*'turn'"):
        registry.entry("toy:juggle")
    with pytest.raises(ModuleNotFoundError):
        registry.entry("no_such_module:turn")


def test_a_taken_name_or_id_is_refused(toy):
    registry.register(registry.entry("turn"))  # the same again changes nothing
    for other in (Entry("turn", "Another", toy.Turn, toy.ROBOT), Entry("another", "ToyTurn", toy.Turn, toy.ROBOT)):
        with pytest.raises(ValueError, match=f"entry = {other.name!r} with the id {other.id!r}: expected neither to be taken"):
            registry.register(other)
    assert "another" not in [entry.name for entry in registry.entries()]


def test_a_camera_of_an_entry_is_the_default_of_its_environments(toy, drawing):
    entry = replace(registry.entry("turn"), name="above", id="ToyAbove", camera="above")
    registry.register(entry)
    try:
        pictures = {}
        for name, options in (("ToyAbove-v0", {}), ("ToyTurn-v0", {"camera": "above"}), ("ToyTurn-v0", {})):
            env = gym.make(name, render_mode="rgb_array", width=64, height=64, **options)
            env.reset(seed=0)
            pictures[name, len(options)] = env.render()
            env.close()
    finally:
        registry._ENTRIES.pop("above")
        for name in entry.ids.values():
            gym.registry.pop(name)
    np.testing.assert_array_equal(pictures["ToyAbove-v0", 0], pictures["ToyTurn-v0", 1])
    assert (pictures["ToyAbove-v0", 0] != pictures["ToyTurn-v0", 0]).any()


def test_what_a_reference_needs_is_said():
    assert registry.load("math:pi") == np.pi and registry.load(len) is len
    with pytest.raises(ModuleNotFoundError, match=r"elsewhere.scripted:X needs the package 'elsewhere', which a checkout"):
        registry.load("elsewhere.scripted:X")


# --- the paper's tasks on other robots --------------------------------------------------------------------------------------


def test_reach_takes_another_robot_radius_and_step(toy):
    env = gym.make("TCAReach-v0", robot=toy.ROBOT, success_mm=2.0, step_s=0.25)
    bound = toy.ROBOT.bound_cm
    assert env.action_space.shape == (5,) and env.observation_space["observation"].shape == (13,)
    assert bound == 18.0 and (env.observation_space["achieved_goal"].high == bound).all()
    assert env.metadata["render_fps"] == 4
    observation, _ = env.reset(seed=0)
    assert observation["achieved_goal"][2] == pytest.approx(15.0, abs=0.5)
    _, _, _, _, info = env.step(np.ones(5, dtype=np.float32))
    task = env.unwrapped.task
    assert info["energy_J"] == pytest.approx(0.25 * env.unwrapped.core.heating.max_power.sum())
    assert task.outcome([0.0, 0.0, 0.199], np.zeros(3)).success and not task.outcome([0.0, 0.0, 0.201], np.zeros(3)).success
    many = gym.make_vec("TCAReach-v0", num_envs=2, robot=toy.ROBOT, success_mm=2.0, step_s=0.25)
    assert many.reset(seed=0)[0]["desired_goal"][0].tobytes() == observation["desired_goal"].tobytes()
    assert many.metadata["render_fps"] == 4 and many.call("metadata")[0]["render_fps"] == 4
    ball = task.parts(env.unwrapped.core)["goal"].vertices
    assert np.ptp(ball, axis=0) == pytest.approx([4e-3] * 3, rel=0.02)


def test_limits_of_a_robot_are_those_of_its_observations_goals_and_heaters():
    limits = Limits(ambient=20.0, soft=100.0, cut_off=110.0, hard=120.0)
    task = registry.entry("reach").new(replace(paper.BENDING, limits=limits))
    env = gym.make("TCAReach-v0", robot=task.robot)
    observation, _ = env.reset(seed=0)
    assert not observation["observation"][:6].any()
    assert env.observation_space["observation"].high[0] == np.float32(1.2)  # 90 K of 80 K, rounded up
    for _ in range(60):
        observation, _, _, _, info = env.step(np.ones(3, dtype=np.float32))
    np.testing.assert_allclose(env.unwrapped.core.record.temperature, 110.0, rtol=1e-12)
    np.testing.assert_allclose(observation["observation"][:3], 90.0 / 80.0, rtol=1e-6)
    assert info["cost"] == pytest.approx(30.0)
    core, drawn = task.core(1), []
    settle = core.settle
    core.settle = lambda temperature: (drawn.extend(temperature), settle(temperature))[1]
    task.sample(core, np.random.default_rng(0).spawn(50))
    assert 20.0 <= np.min(drawn) < 30.0 and 90.0 < np.max(drawn) <= 100.0


def test_pick_and_place_takes_another_box_table_and_robot():
    box = grasp.Box(2.5e-3, 10e-3, 6e-3, 2.5e-3, 0.9)
    single = replace(
        paper.GRIPPING, arm=Arm([paper.bending_module()], paper.GRAVITY, paper.EMPTY), stage=replace(paper.STAGE, travel=20e-3)
    )
    heat = [100.0, 100.0, 100.0]
    env = gym.make(
        "TCAPickAndPlace-v0", robot=single, box=box, table_m=70e-3, object_degC=heat, target_degC=heat, success_mm=2.0
    )
    assert env.action_space.shape == (5,) and env.observation_space["observation"].shape == (8 + 13,)
    observation, _ = env.reset(seed=1)
    task, core = env.unwrapped.task, env.unwrapped.core
    assert observation["achieved_goal"][2] == observation["desired_goal"][2] == np.float32(6.7)
    assert task.robot.carries == single.gripper.payload(2.5e-3) and core.arm.discretisation.tolerance == 1e-5
    for _ in range(30):
        observation, *_ = env.step(np.array([-1.0, -1.0, -1.0, -1.0, 1.0], dtype=np.float32))
    travel = core.record.scene[0, grasp.STAGE]
    assert 5e-3 < travel < 20e-3  # the jaws stand on the box or the table
    assert observation["observation"][8 + 5] == pytest.approx(travel / 20e-3)
    shown = task.parts(core)
    assert np.ptp(shown["object"].vertices[:, 2]) == pytest.approx(6e-3)
    assert shown["table"].vertices[:, 2].min() == pytest.approx(70e-3)
    assert shown["module 0"].axis[0, 2] == pytest.approx(travel)


def tendons():
    return Arm([Module.cylinder(0.05, 5e-3, 1e5, 3e4, 1e-3, [Muscle(4e-3, 0.0, 0.0, Tendon())])])


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("Reach", {"robot": "arm"}, "robot = 'arm': expected a tca_envs.robots.Robot"),
        ("Reach", {"success_mm": 0.0}, "success_mm = 0.0: expected a finite number in (0, inf]"),
        ("Reach", {"success_mm": "1"}, "success_mm = '1': expected a finite number"),
        ("Reach", {"step_s": 0.0}, "step_s = 0.0: expected a finite number in (0, 10]"),
        ("Reach", {"step_s": 11}, "step_s = 11: expected a finite number in (0, 10]"),
        ("TwistAlign", {"success_deg": 181.0}, "success_deg = 181.0: expected a finite number in (0, 180]"),
        ("TwistAlign", {"success_mm": -1.0}, "success_mm = -1.0: expected a finite number in (0, inf]"),
        ("PickAndPlace", {"robot": paper.WHOLE}, "expected one with a gripper and a stage"),
        ("PickAndPlace", {"box": 3.0}, "box = 3.0: expected a tca_envs.mechanics.grasp.Box"),
        ("PickAndPlace", {"table_m": -1.0}, "table_m = -1.0: expected a finite number in (0, inf]"),
        ("PickAndPlace", {"object_degC": [100.0]}, "object_degC = [100.0] has shape (1,): expected shape (4,)"),
        ("PickAndPlace", {"target_degC": [151.0] * 4}, "expected temperatures in [25, 150] degC"),
        ("Reach", {"solver": "magic"}, "solver = 'magic': expected one of 'collocation', 'shooting', or a function"),
    ],
)
@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_bad_arguments_of_tasks_are_refused(make, name, arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(f"TCA{name}-v0", **arguments)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Robot("arm"), "arm = 'arm': expected an Arm with muscles"),
        (lambda: Robot(Arm([Module(0.1, np.ones(6))])), "expected an Arm with muscles"),
        (lambda: Robot(tendons()), r"arm.muscles\[0\].law = .*: expected a TCA that takes all of Limits"),
        (lambda: Robot(paper.BENDING.arm, reach_cm=-1.0), r"reach_cm = -1.0: expected a finite number in \(0, inf\]"),
        (lambda: Robot(paper.BENDING.arm, limits=Limits(hard=301.0)), "expected a TCA that takes all of Limits"),
        (lambda: Limits(soft=20.0), r"soft = 20.0: expected a finite number in \(25, inf\]"),
        (lambda: Limits(cut_off=149.0), r"cut_off = 149.0: expected a finite number in \[150, inf\]"),
        (lambda: replace(paper.STAGE, speed=0.0), r"speed = 0.0: expected a finite number in \(0, inf\]"),
        (lambda: replace(paper.gripper(), depth=0.0), r"depth = 0.0: expected a finite number in \(0, inf\]"),
    ],
)
def test_robots_refuse_what_they_cannot_be(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_an_arm_with_many_tcas_gets_a_discretisation():
    module = Module.cylinder(
        0.05, 6e-3, 0.2e6, 0.07e6, 3e-3, [Muscle(4e-3, 2.0 * np.pi * i / 9, 0.0, paper.MEASURED) for i in range(9)]
    )
    arm = Robot(Arm([module], paper.GRAVITY, Payload(1e-3))).built(1e-4)
    assert arm.discretisation.states == 160 and arm.discretisation.error <= 1e-4


# --- solvers ----------------------------------------------------------------------------------------------------------------


def test_a_function_may_solve():
    calls = []

    def solve(*arguments):
        calls.append(len(arguments))
        return continuation.solve(*arguments)

    for make in (gym.make, gym.make_vec):
        env, plain = make("TCAReach-v0", solver=solve), make("TCAReach-v0")
        first, again = env.reset(seed=3)[0], plain.reset(seed=3)[0]
        calls.clear()
        action = np.full(env.action_space.shape, 0.5, dtype=np.float32)
        seen, expected = env.step(action)[0], plain.step(action)[0]
        assert len(calls) == 1
        assert all(first[key].tobytes() == again[key].tobytes() for key in first)
        assert all(seen[key].tobytes() == expected[key].tobytes() for key in seen)


def test_shooting_is_for_one_arm_and_is_loaded_when_it_is_asked_for(monkeypatch):
    with pytest.raises(ValueError, match="solver = 'shooting': expected 'collocation' or a function; shooting solves one arm"):
        gym.make_vec("TCAReach-v0", num_envs=2, solver="shooting")
    monkeypatch.setitem(batch.SOLVERS, "shooting", "elsewhere.shooting:solve")
    with pytest.raises(ModuleNotFoundError, match=r"needs the package 'elsewhere', which a checkout of the repository has"):
        gym.make("TCAReach-v0", solver="shooting")
    monkeypatch.setitem(batch.SOLVERS, "shooting", "tca_envs.mechanics.continuation:solve")
    assert gym.make("TCAReach-v0", solver="shooting").unwrapped.core.solve is continuation.solve
