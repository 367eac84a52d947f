"""Films of policies at work."""

import sys

import gymnasium as gym
import numpy as np
import pytest

import train
from agents import training, video
from agents.scripted import RandomPolicy, controller_of

pytestmark = pytest.mark.usefixtures("drawing")


def env(name="TCAReach-v0", **options):
    return gym.make(name, **{"render_mode": "rgb_array", "width": 64, "height": 48, **options})


def test_episodes_are_shown_until_their_goals_are_held():
    made = env()
    shown = video.frames(controller_of("reach"), made, episodes=2, seed=1)
    lengths = []
    for seed in (1, 2):  # the same without pictures
        observation, info = made.reset(seed=seed)
        held, steps = 0, 0
        while held < video.HELD_STEPS:
            observation, *_, info = made.step(controller_of("reach").predict(observation)[0])
            held, steps = (held + 1 if info["is_success"] else 0), steps + 1
        lengths.append(steps + 1)
    assert len(shown) == sum(lengths)
    assert all(picture.shape == (48, 64, 3) for picture in shown)
    assert not np.array_equal(shown[0], shown[10])
    assert len(video.frames(RandomPolicy(3), env(max_episode_steps=8), seed=1)) == 9  # to the time limit
    with pytest.raises(ValueError, match="env has render_mode None: expected 'rgb_array'"):
        video.frames(RandomPolicy(3), env(render_mode=None))


@pytest.mark.parametrize("suffix", video.SUFFIXES)
def test_films_can_be_read_again(suffix, tmp_path):
    shown = [np.full((48, 64, 3), level, dtype=np.uint8) for level in (0, 120, 255)] * 4
    path = tmp_path / "new" / f"film{suffix}"
    if suffix == ".mp4":
        moviepy = pytest.importorskip("moviepy", reason='MoviePy is missing: pip install -e ".[video]"')
        video.save(shown, path, 10)
        with moviepy.VideoFileClip(str(path)) as clip:
            assert (clip.fps, clip.size) == (10, [64, 48])
            levels = [clip.get_frame(0.1 * i + 0.05).mean() for i in range(3)]
    else:
        from PIL import Image

        video.save(shown, path, 10)
        with Image.open(path) as film:
            assert (film.n_frames, film.size) == (12, (64, 48))
            levels = []
            for i in range(3):
                film.seek(i)
                levels.append(np.asarray(film.convert("RGB")).mean())
                assert film.info["duration"] == 100
    assert levels == pytest.approx([0.0, 120.0, 255.0], abs=12.0)


def test_other_formats_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"path = '.*film.avi': expected a file name that ends with .mp4, .webp, .gif"):
        video.save([np.zeros((4, 4, 3), dtype=np.uint8)], tmp_path / "film.avi", 10)


def test_the_command_line_films_a_policy(tmp_path, capsys, monkeypatch):
    pytest.importorskip("moviepy", reason='MoviePy is missing: pip install -e ".[video]"')
    monkeypatch.setattr(training, "FILMED_EPISODES", 1)
    path = tmp_path / "out.mp4"
    filmed, frames = [], video.frames
    monkeypatch.setattr(video, "frames", lambda policy, env, *how: filmed.append(env) or frames(policy, env, *how))
    assert train.main(["--task", "reach", "--eval-only", "pretrained", "--episodes", "2", "--video", str(path)]) == 0
    assert path.stat().st_size > 5_000
    assert [env.unwrapped.task.split for env in filmed] == ["held-out"]
    assert f"wrote {path}" in capsys.readouterr().out


def test_without_moviepy_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "moviepy", None)
    with pytest.raises(SystemExit) as stop:
        train.main(["--eval-only", "pretrained", "--video", "out.mp4"])
    assert stop.value.code == 2
    assert "--video needs PyVista, and MoviePy for .mp4: pip install -e '.[train,video]'" in capsys.readouterr().err
