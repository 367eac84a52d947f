"""What is drawn is what was solved, in pictures, depths, videos and a window."""

import copy
import gc
import itertools
import os
import pickle
import shutil
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from gymnasium.utils.env_checker import check_env

import tca_envs  # noqa: F401
from tca_envs import geometry, render
from tca_envs.mechanics import grasp
from tca_envs.robots import paper

IDS = ("TCAReach-v0", "TCATwistAlign-v0", "TCAPickAndPlace-v0")
ALL = sorted(name for name, spec in gym.registry.items() if "tca_envs" in str(spec.entry_point))
SIDE = 160


COIL = geometry.Coil()


def hot(name, steps=12, seed=3, power=(0.8, -1.0, -0.2, 0.4, 0.6, 0.5), **options):
    """Return an environment after some steps."""
    env = gym.make(name, width=SIDE, height=SIDE, **options)
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(np.array(power[: env.action_space.shape[0]], dtype=np.float32))
    return env


def parts(env):
    return env.unwrapped.task.parts(env.unwrapped.core)


def lowered(env):
    scene = env.unwrapped.core.record.scene
    return np.array([0.0, 0.0, scene[0, grasp.STAGE] if scene.size else 0.0])


def solved(env):
    """Return the arm and an equilibrium at the environment's temperatures and load, solved by itself."""
    unwrapped = env.unwrapped
    record, arm = unwrapped.core.record, unwrapped.arm
    found = None
    for share in (0.5, 1.0):
        drive = 25.0 + share * (record.drive[0] - 25.0)
        found = arm.equilibrium(drive, start=found)
    return arm, found


# --- geometry ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_body_and_coils_lie_where_the_solver_has_them(name):
    env = hot(name)
    arm, equilibrium = solved(env)
    shown, base, number = parts(env), 0.0, 0
    for k, module in enumerate(arm.modules):
        tube = shown[f"module {k}"]
        s = np.linspace(base, base + module.length, geometry.RINGS)
        poses = equilibrium.poses(np.minimum(s, arm.length))
        expected = poses[:, :3, 3] + lowered(env)
        assert np.abs(tube.axis - expected).max() < 1e-7
        rings = tube.vertices[: geometry.RINGS * geometry.CIRCLE].reshape(geometry.RINGS, -1, 3) - expected[:, np.newaxis]
        assert np.abs(np.linalg.norm(rings, axis=2) - paper.BODY_DIAMETER / 2).max() < 1e-7
        assert np.abs(np.einsum("kmi,ki->km", rings, poses[:, :3, 2])).max() < 1e-7  # in the cross sections
        for muscle in module.muscles:
            axis = shown[f"coil {number}"].axis
            for end, fraction in ((0, 0.0), (-1, 1.0)):
                x, y = muscle.route(module.length, fraction)[:2]
                pose = poses[end]
                assert np.abs(axis[end] - (pose @ [x, y, 0.0, 1.0])[:3] - lowered(env)).max() < 1e-7
            # What is drawn is as long as what is solved.
            assert np.linalg.norm(np.diff(axis, axis=0), axis=1).sum() == pytest.approx(
                equilibrium.muscle_lengths[number], rel=2e-4
            )
            assert shown[f"coil {number}"].temperature == pytest.approx(env.unwrapped.core.record.temperature[0, number])
            number += 1
        base += module.length
    assert np.abs(equilibrium.tip_pose[:3, 3] + lowered(env) - shown[f"module {k}"].axis[-1]).max() < 1e-7


def test_poses_are_those_that_equilibrium_samples_strains_at():
    arm = paper.whole_arm(tolerance=1e-9)
    equilibrium = arm.equilibrium([80.0, 30.0, 50.0, 90.0])
    s = np.sort(np.random.default_rng(0).uniform(0.0, arm.length, 40))
    h = 1e-6
    near = equilibrium.poses(np.clip(np.concatenate([s - h, s + h]), 0.0, arm.length)).reshape(2, 40, 4, 4)
    rates = (near[1, :, :3, 3] - near[0, :, :3, 3]) / (2 * h)
    inside = (s > 1e-5) & (s < arm.length - 1e-5) & (abs(s - arm.modules[0].length) > 1e-5)
    expected = np.einsum("kij,kj->ki", equilibrium.poses(s)[:, :3, :3], equilibrium.strain(s)[:, 3:])
    assert np.abs(rates - expected)[inside].max() < 1e-5  # v, which is about 1


def test_coils_are_fibres_of_their_length_around_their_axis():
    env = hot("TCATwistAlign-v0")
    for number, count in ((0, 58.7), (3, 144.9)):
        coil = parts(env)[f"coil {number}"]
        rings = coil.vertices[: len(coil.axis) * geometry.FIBRE].reshape(len(coil.axis), -1, 3)
        away = np.linalg.norm(rings.mean(axis=1) - coil.axis, axis=1)
        assert np.abs(away - COIL.radius).max() < 1e-9
        thick = np.linalg.norm(rings - rings.mean(axis=1, keepdims=True), axis=2)
        assert np.abs(thick - COIL.fibre_diameter / 2).max() < 1e-9
        assert (len(coil.axis) - 1) / geometry.TURN == pytest.approx(count, abs=0.2)
    straight = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 45e-3], 2001)
    winding = geometry.Coil()
    cold = winding.part(straight, np.tile([1.0, 0.0, 0.0], (2001, 1)), winding.turns(45e-3), 25.0)
    fibre = cold.vertices[: 2001 * geometry.FIBRE].reshape(2001, -1, 3).mean(axis=1)
    assert np.linalg.norm(np.diff(fibre, axis=0), axis=1).sum() == pytest.approx(COIL.fibre_length, rel=2e-3)
    assert pytest.approx(0.53e-3, rel=0.01) == COIL.fibre_diameter


@pytest.mark.parametrize("temperature", [25.0, 90.0, 110.0, 125.0, 150.0])
def test_the_ring_is_as_long_as_it_is_and_opens_by_its_gap(temperature):
    gap = float(paper.ring().gap(temperature))
    mount = np.eye(4)
    mount[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    mount[:3, 3] = 1e-3, 2e-3, 60e-3
    section = (paper.GRIPPER_THICKNESS, paper.GRIPPER_WIDTH)
    shown = geometry.ring_parts(mount, paper.ring(), section, gap)
    shown["gripper coil"] = geometry.ring_coil(mount, paper.ring(), gap, temperature)
    jaws = [shown[f"ring {i}"].axis[-1] for i in (0, 1)]
    assert jaws[1] - jaws[0] == pytest.approx([0.0, gap, 0.0], abs=1e-9)  # along the mount's x axis
    for i in (0, 1):
        line = shown[f"ring {i}"].axis
        assert line[0] == pytest.approx(mount[:3, 3])
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() == pytest.approx(paper.GRIPPER_LENGTH / 2, rel=2e-3)
    assert 0.99 * paper.JAW_DEPTH < jaws[0][2] - 60e-3 < paper.JAW_DEPTH + 1.4e-3
    away = shown["gripper coil"].axis[:, np.newaxis] - np.concatenate([shown["ring 0"].axis, shown["ring 1"].axis])
    assert np.linalg.norm(away, axis=2).min(axis=1) == pytest.approx(paper.GRIPPER_OFFSET, rel=0.02)


def test_gripper_object_and_stage_follow_the_scene():
    from agents.scripted import PickAndPlaceController

    env, controller = gym.make("TCAPickAndPlace-v0"), PickAndPlaceController()
    observation, _ = env.reset(seed=1)
    seen = set()
    for _ in range(100):
        observation, *_ = env.step(controller.predict(observation)[0])
        record, shown = env.unwrapped.core.record, parts(env)
        scene = record.scene[0]
        around = shown["object"].vertices
        assert around.mean(axis=0) == pytest.approx(scene[grasp.X : grasp.Z + 1], abs=1e-9)
        assert np.ptp(around[:, 2]) == pytest.approx(paper.OBJECT.height)
        assert np.linalg.norm(np.ptp(around[:, :2], axis=0)) >= paper.OBJECT.length
        assert shown["stage"].vertices[:, 2].max() == pytest.approx(scene[grasp.STAGE] - geometry.PLATE_THICKNESS)
        assert shown["module 0"].axis[0] == pytest.approx([0.0, 0.0, scene[grasp.STAGE]])
        jaws = np.linalg.norm(shown["ring 1"].axis[-1] - shown["ring 0"].axis[-1])
        free = float(env.unwrapped.task.gap(record)[0])
        between = bool(scene[grasp.HELD] + scene[grasp.ASTRIDE])
        assert jaws == pytest.approx(max(free, paper.OBJECT.width * between), abs=1e-9)
        assert shown["gripper coil"].temperature == record.temperature[0, 4]
        seen.add((bool(scene[grasp.HELD]), bool(scene[grasp.ASTRIDE])))
    assert {(True, False), (False, True), (False, False)} <= seen  # held, between the jaws, alone


@pytest.mark.parametrize("name", IDS)
def test_goals_are_where_they_are_asked(name):
    env = hot(name, steps=0)
    goal = env.unwrapped.core.record.goal[0]
    shown = parts(env)
    assert shown["goal"].vertices.mean(axis=0) == pytest.approx(1e-2 * goal[:3], abs=1e-6)
    if name == "TCATwistAlign-v0":
        across = shown["goal ring 1"].axis[geometry.RINGS // 2] - shown["goal ring 0"].axis[geometry.RINGS // 2]
        assert across[:2] / np.linalg.norm(across) == pytest.approx(goal[3:5], abs=1e-6)


@pytest.mark.parametrize("name", IDS)
def test_surfaces_are_closed_and_face_outwards(name):
    for part in parts(hot(name)).values():
        corners = (part.vertices - part.vertices[0])[part.triangles]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        big = np.linalg.norm(faces, axis=1) > 1e-14
        assert (np.einsum("ti,ti->t", faces, part.normals[part.triangles[:, 0]])[big] > 0.0).all()
        assert np.linalg.norm(part.normals, axis=1) == pytest.approx(1.0)
        # Faces of a closed surface balance; its volume is positive.
        assert np.abs(faces.sum(axis=0)).max() < 1e-9 * np.abs(faces).sum()
        assert np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0.0


def test_heat_is_coloured_from_ambient_to_the_limit():
    cold, warm, hottest = geometry.heat_colour(np.array([25.0, 90.0, 160.0]))
    assert cold[2] > cold[0] and hottest[0] > 0.9 and hottest[1] > hottest[2]
    assert (geometry.heat_colour(-20.0) == cold).all() and (geometry.heat_colour(300.0) == hottest).all()
    assert cold[0] < warm[0] < hottest[0]


# --- pictures ---------------------------------------------------------------------------------------------------------------


def pixels(points, camera="front", side=SIDE):
    """Return where a pinhole camera sees points (n, 3) [m]: column, row and distance from its plane (n, 3)."""
    stand, target = (np.array(point) for point in render.CAMERAS[camera])
    ahead = (target - stand) / np.linalg.norm(target - stand)
    right = np.cross(ahead, [0.0, 0.0, -1.0])
    right /= np.linalg.norm(right)
    x, up, deep = ((points - stand) @ axis for axis in (right, np.cross(right, ahead), ahead))
    scale = 0.5 * side / np.tan(0.5 * np.radians(render.VIEW_DEG))
    return np.stack([0.5 * side + scale * x / deep - 0.5, 0.5 * side - scale * up / deep - 0.5, deep], axis=1)


@pytest.mark.parametrize("name", ALL)
def test_pictures_have_the_size_asked_for_and_change_nothing(name, drawing):
    env = gym.make(name, render_mode="rgb_array", width=90, height=70)
    env.reset(seed=1)
    before = pickle.dumps(env.unwrapped.get_state())
    picture = env.render()
    assert picture.shape == (70, 90, 3) and picture.dtype == np.uint8
    assert picture.std() > 10.0
    assert np.array_equal(picture, env.render())
    assert pickle.dumps(env.unwrapped.get_state()) == before
    env.close()
    assert np.array_equal(picture, env.render())  # drawn anew
    env.close()


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("camera", ["front", "side"])
def test_the_depth_of_a_picture_is_that_of_the_solved_arm(name, camera, drawing):
    env = hot(name, render_mode="depth_array", camera=camera)
    depth, shown = env.render(), parts(env)
    assert depth.shape == (SIDE, SIDE) and depth.dtype == np.float32
    seen = {"module": 0, "coil": 0}
    for key, part in shown.items():
        kind = key.split()[0]
        if kind in seen:
            column, row, deep = pixels(part.axis, camera).T
            radius = 0.5 * paper.BODY_DIAMETER if kind == "module" else COIL.radius + 0.5 * COIL.fibre_diameter
            found = depth[np.rint(row).astype(int), np.rint(column).astype(int)]
            if kind == "module":
                assert (found[1:-1] < deep[1:-1]).all()  # its surface is there, or something before it
            seen[kind] += np.sum(np.abs(deep - found - 0.5 * radius) < 0.5 * radius + 0.2e-3)
    assert seen["module"] > 5 and seen["coil"] > 100, seen
    assert np.isinf(depth[0, 0]) and depth[np.isfinite(depth)].min() > 0.1
    env.close()


def filled(part):
    """Return points all over a surface."""
    n = 12
    weights = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    corners = part.vertices[part.triangles]
    large = np.linalg.norm(np.ptp(corners, axis=1), axis=1) > 1e-3
    return np.concatenate([part.vertices, (weights @ corners[large]).reshape(-1, 3)])


@pytest.mark.parametrize("name", IDS)
def test_pictures_of_two_states_differ_where_they_should(name, drawing):
    env = hot(name, render_mode="rgb_array")
    first, before = env.render().astype(int), parts(env)
    for _ in range(10):
        env.step(np.where(np.arange(env.action_space.shape[0]) == 1, 1.0, -1.0).astype(np.float32))
    second, after = env.render().astype(int), parts(env)
    changed = np.abs(first - second).max(axis=2) > 30
    expected = np.zeros_like(changed)
    for name in before:
        if name not in ("table", "column"):
            for points in (filled(before[name]), filled(after[name])):
                fallen = points + (paper.TABLE - points[:, 2:]) * render.SUN  # its shadow
                column, row, _ = np.rint(pixels(np.concatenate([points, fallen]))).astype(int).T
                seen = (column >= 0) & (column < SIDE) & (row >= 0) & (row < SIDE)
                expected[row[seen], column[seen]] = True
    for axis, step in itertools.product((0, 1), (1, -1)):  # points are up to a pixel apart, and edges are blurred
        expected |= np.roll(expected, step, axis)
    expected[: SIDE // 4, : SIDE // 2] = True  # the readout
    assert 100 < changed.sum() < 0.5 * SIDE**2
    assert not (changed & ~expected).any()
    tips = [pixels(shown["ring 1"].axis)[-1] for shown in (before, after)]
    assert np.linalg.norm(np.subtract(*tips)[:2]) > 4.0  # the gripper went elsewhere ...
    for column, row, _ in tips:
        assert changed[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3].any()  # ... in the picture, too
    env.close()


def test_a_hot_coil_has_the_colour_of_its_temperature(drawing):
    env = hot("TCAReach-v0", render_mode="rgb_array", power=(1.0, -1.0, -1.0), camera=((0.2, 0.15, 0.02), (0.0, 0.0, 0.03)))
    middle = slice(60, 100), slice(60, 100)  # without the colour bar

    def warmth():
        picture = env.render()[middle].astype(float)
        return (picture[..., 0] - picture[..., 2]).max()

    assert warmth() > 100.0
    env.unwrapped.core.record.drive[0, 0] = 25.0  # as if it were cold
    assert warmth() < 60.0
    env.close()


def test_the_arm_casts_a_shadow_on_the_table_before_a_white_wall(drawing):
    env = hot("TCATwistAlign-v0", render_mode="rgb_array")
    picture, shown = env.render().astype(float).mean(axis=2), parts(env)
    fallen = shown["ring 1"].axis + (paper.TABLE - shown["ring 1"].axis[:, 2:]) * render.SUN
    column, row, _ = np.rint(pixels(fallen)).astype(int).T
    beside = picture[row, column + 25]
    assert np.all(picture[row, column] < beside - 25.0) and np.ptp(beside) < 15.0
    assert (picture[:5, -20:] == 255.0).all()
    env.close()


def test_a_goal_that_is_reached_turns_green():
    env = hot("TCAReach-v0", steps=2)
    assert parts(env)["goal"].colour == geometry.GOAL
    env.unwrapped.core.record.goal[0] = env.unwrapped.task.achieved(env.unwrapped.core.record)[0]
    assert parts(env)["goal"].colour == geometry.DONE


def test_the_readout_tells_time_heat_goal_and_success():
    env = hot("TCATwistAlign-v0", steps=12)
    unwrapped = env.unwrapped
    text = render.readout(unwrapped.task, unwrapped.core, 0)
    *_, info = env.step(np.full(4, -1.0, dtype=np.float32))
    after = render.readout(unwrapped.task, unwrapped.core, 0)
    assert text.splitlines()[0] == "1.2 s" and after.splitlines()[0] == "1.3 s"
    assert f"distance {info['distance_mm']:.1f} mm" in after and f"yaw error {info['yaw_error_deg']:.1f}°" in after
    assert " / ".join(f"{value:.0f}" for value in unwrapped.core.record.temperature[0]) + " °C" in after
    unwrapped.core.record.goal[0] = unwrapped.task.achieved(unwrapped.core.record)[0]
    assert "success" in render.readout(unwrapped.task, unwrapped.core, 0) and "success" not in after
    env.reset()
    assert render.readout(unwrapped.task, unwrapped.core, 0).startswith("0.0 s")


# --- interfaces -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("mode", ["rgb_array", "depth_array"])
def test_checkers_pass_with_pictures(name, mode, drawing):
    env = gym.make(name, render_mode=mode, width=64, height=64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)  # that would open a window
    env.close()


def test_copies_go_on_with_pictures_of_their_own(drawing):
    env = hot("TCAReach-v0", render_mode="rgb_array")
    picture = env.render()
    for copied in (copy.deepcopy(env), pickle.loads(pickle.dumps(env.unwrapped))):
        assert np.array_equal(copied.render(), picture)
        copied.step(np.ones(3, dtype=np.float32))
        assert not np.array_equal(copied.render(), picture)
        copied.close()
    assert np.array_equal(env.render(), picture)
    env.close()


def test_gymnasiums_lists_and_videos(tmp_path, drawing):
    pytest.importorskip("moviepy", reason='MoviePy is missing: pip install -e ".[video]"')
    from gymnasium.wrappers import RecordVideo
    from moviepy import VideoFileClip

    env = gym.make("TCAPickAndPlace-v0", render_mode="rgb_array_list", width=64, height=64)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert [frame.shape for frame in env.render()] == [(64, 64, 3)] * 2
    env.close()
    env = RecordVideo(
        gym.make("TCAReach-v0", render_mode="rgb_array", width=64, height=64), str(tmp_path / "videos"), video_length=12
    )
    env.reset(seed=0)
    for _ in range(12):
        env.step(env.action_space.sample())
    env.close()
    (video,) = tmp_path.glob("videos/*.mp4")
    with VideoFileClip(str(video)) as clip:
        assert (clip.fps, clip.size) == (env.metadata["render_fps"], [64, 64])
        assert clip.duration == pytest.approx(1.2, abs=0.11)


def test_lanes_of_a_batch_look_like_single_environments(drawing):
    options = {"render_mode": "rgb_array", "width": 64, "height": 64}
    batch = gym.make_vec("TCATwistAlign-v0", num_envs=3, threads=1, **options)
    batch.reset(seed=5)
    action = np.full((3, 4), 0.5, dtype=np.float32)
    for _ in range(5):
        batch.step(action)
    pictures = batch.render()
    assert len(pictures) == 3
    for lane, picture in enumerate(pictures):
        env = gym.make("TCATwistAlign-v0", **options)
        env.reset(seed=5 + lane)
        for _ in range(5):
            env.step(action[0])
        assert np.array_equal(env.render(), picture)
        env.close()
    batch.close()
    with pytest.raises(ValueError, match="render_mode = 'human': expected None or one of 'rgb_array', 'depth_array'"):
        gym.make_vec("TCAReach-v0", num_envs=2, render_mode="human")
    assert gym.make_vec("TCAReach-v0", num_envs=2).render() is None


def test_stable_baselines_takes_pictures_and_videos(tmp_path, drawing):
    pytest.importorskip("moviepy", reason='MoviePy is missing: pip install -e ".[video]"')
    from stable_baselines3.common.vec_env import VecVideoRecorder

    from agents.sb3 import make

    env = make("TCAReach-v0", lanes=3, seed=0, render_mode="rgb_array", width=64, height=64)
    env.reset()
    assert [image.shape for image in env.get_images()] == [(64, 64, 3)] * 3
    assert env.render().shape == (128, 128, 3)
    recorder = VecVideoRecorder(env, str(tmp_path), record_video_trigger=lambda step: step == 0, video_length=5)
    recorder.reset()
    for _ in range(6):
        recorder.step(np.zeros((3, 3), dtype=np.float32))
    recorder.close()
    assert len(list(tmp_path.glob("*.mp4"))) == 1


def test_any_thread_may_draw(drawing):
    env = hot("TCAReach-v0", render_mode="rgb_array")
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(env.render).result()
        assert np.array_equal(env.render(), first)
        env.step(np.ones(3, dtype=np.float32))
        second = env.render()
        assert np.array_equal(pool.submit(env.render).result(), second) and not np.array_equal(first, second)
    env.close()


def test_environments_that_nobody_closes_release_what_they_drew_with(drawing):
    from pyvista.plotting.plotter import _ALL_PLOTTERS

    gc.collect()
    before = len(_ALL_PLOTTERS)
    env = hot("TCAReach-v0", render_mode="rgb_array")
    env.render()
    assert len(_ALL_PLOTTERS) == before + 1
    del env
    gc.collect()
    assert len(_ALL_PLOTTERS) == before


@pytest.mark.parametrize("name", IDS)
def test_goals_are_ghosts_that_depth_knows_nothing_of(name, drawing):
    env = hot(name, render_mode="depth_array")
    before = env.render()
    env.unwrapped.core.record.goal[0, :2] += 0.8
    assert np.array_equal(env.render(), before)
    env.close()


@pytest.mark.parametrize("size", [(96, 192), (192, 96)])
def test_readout_and_colour_bar_fit_narrow_pictures(size, drawing):
    width, height = size
    env = gym.make("TCAPickAndPlace-v0", render_mode="rgb_array", width=width, height=height)
    env.reset(seed=0)
    inked = env.render()[: round(0.4 * min(size))].min(axis=2) < 200
    assert not inked[:, -1].any() and not inked[:, 0].any() and not inked[0].any()
    assert inked[:, -round(0.15 * min(size)) :].any() and inked[:, : round(0.4 * min(size))].any()
    env.close()


# --- errors -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("render_mode", "ansi"), ("render_mode", 3), ("width", 15), ("width", 4097), ("height", 480.0), ("height", True),
        ("camera", "behind"), ("camera", ((0.0, 0.0, 0.1), (0.0, 0.0, 0.2))), ("camera", (1.0, 2.0)), ("camera", None),
        ("camera", ((0.0, 0.1, np.nan), (0.0, 0.0, 0.2))), ("camera", ((0.0, 0.1), (0.0, 0.0))),
    ],
)  # fmt: skip
@pytest.mark.parametrize("maker", ["single", "batch"])
def test_bad_arguments_are_refused(maker, name, value):
    entry = gym.spec("TCAReach-v0").entry_point if maker == "single" else gym.spec("TCAReach-v0").vector_entry_point
    with pytest.raises(ValueError, match=f"^{name} = .*expected"):
        gym.envs.registration.load_env_creator(entry)(**{name: value})


def test_without_pyvista_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        DependencyNotInstalled, match=r"render_mode = 'rgb_array' needs PyVista: pip install \"tca_envs\[render\]"
    ):
        gym.make("TCAReach-v0", render_mode="rgb_array")
    gym.make("TCAReach-v0").close()


def in_a_process(code, **variables):
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"} | variables
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env=environment, timeout=120
    )


def test_without_a_display_a_window_is_refused(drawing):
    code = "import gymnasium, tca_envs; e = gymnasium.make('TCAReach-v0', render_mode='human'); e.reset()"
    found = in_a_process(code)
    assert found.returncode == 1
    assert "RuntimeError: render_mode = 'human' needs a display" in found.stderr


def test_without_opengl_it_is_said_what_to_install(drawing):
    code = "import gymnasium, tca_envs; e = gymnasium.make('TCAReach-v0', render_mode='rgb_array'); e.reset(); e.render()"
    found = in_a_process(code, VTK_DEFAULT_OPENGL_WINDOW="vtkOSOpenGLRenderWindow")
    if found.returncode == 0:
        pytest.skip("OSMesa is installed")
    assert found.returncode == 1
    assert "RuntimeError: no OpenGL to draw with" in found.stderr and "apt install" in found.stderr


# --- the window -------------------------------------------------------------------------------------------------------------


WINDOW = """
import time, subprocess, gymnasium, numpy as np, tca_envs
env = gymnasium.make("TCAReach-v0", render_mode="human", width=200, height=200)
env.reset(seed=0)
scene = env.unwrapped._renderer._scene
print("kind", scene.plotter.render_window.GetClassName(), scene.plotter.render_window.GetSize())
begun = time.perf_counter()
for _ in range(10):
    env.step(np.ones(3, dtype=np.float32))
    env.render()  # changes nothing
print("seconds", time.perf_counter() - begun)
before = scene.plotter.camera.position
subprocess.run("xdotool mousemove 60 100 mousedown 1 mousemove 100 110 mousemove 150 130 mouseup 1".split(), check=True)
for _ in range(3):
    env.step(np.ones(3, dtype=np.float32))
print("turned", np.linalg.norm(np.subtract(scene.plotter.camera.position, before)))
assert env.render() is None
subprocess.run("xdotool mousemove 100 100 key q".split(), check=True)
for _ in range(3):
    env.step(np.ones(3, dtype=np.float32))
print("closed", scene.closed)
env.close()
"""
CHECKERS = """
import gymnasium, tca_envs
from gymnasium.utils.env_checker import check_env
for name in sorted(name for name, spec in gymnasium.registry.items() if "tca_envs" in str(spec.entry_point)):
    check_env(gymnasium.make(name, width=64, height=64).unwrapped)
    print(name)
"""


def test_a_step_is_shown_once_for_a_tenth_of_a_second():
    class Window:
        closed = False

        def __init__(self):
            self.waited = []

        def show(self, parts, text):
            pass

        def wait(self, until):
            self.waited.append(until)

    env = hot("TCAReach-v0", steps=1)
    core = env.unwrapped.core
    renderer = render.Renderer("human", 64, 64, "front")
    renderer._scene = window = Window()
    for _ in range(3):  # as who calls `render` after `step`, which has drawn already
        renderer.render(env.unwrapped.task, core)
    assert len(window.waited) == 1
    for _ in range(3):
        core.record.steps += 1
        renderer.render(env.unwrapped.task, core)
    assert np.diff(window.waited).min() > 0.0999


@pytest.fixture
def display(drawing, tmp_path):
    if not (shutil.which("Xvfb") and shutil.which("xdotool")):
        pytest.skip("Xvfb or xdotool is missing")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "400x400x24", "-nolisten", "tcp"],
        pass_fds=[write], stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait(timeout=10)


def test_a_window_shows_steps_in_real_time_and_turns_with_the_mouse(display):
    found = in_a_process(WINDOW, DISPLAY=display)
    assert found.returncode == 0, found.stderr
    said = dict(line.split(maxsplit=1) for line in found.stdout.splitlines())
    assert said["kind"] == "vtkXOpenGLRenderWindow (200, 200)"
    assert 0.95 <= float(said["seconds"]) < 10.0
    assert float(said["turned"]) > 10.0
    assert said["closed"] == "True"
    assert found.stderr == ""


def test_checkers_pass_with_all_render_modes(display):
    found = in_a_process(CHECKERS, DISPLAY=display)
    assert found.returncode == 0 and found.stderr == "", found.stderr
    assert found.stdout.split() == ALL
