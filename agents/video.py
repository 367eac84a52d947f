"""Videos of policies: MP4 by MoviePy, animated WebP and GIF by Pillow."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.evaluate import Policy

Frames = list[NDArray[np.uint8]]

HELD_STEPS = 15
"""An episode is shown until its goal has been held for this number of steps."""
SUFFIXES = (".mp4", ".webp", ".gif")
WEBP_QUALITY = 70


def frames(policy: Policy, env: gymnasium.Env[Any, Any], episodes: int = 1, seed: int = 0) -> Frames:
    """Return the pictures of episodes, one per step.

    Parameters
    ----------
    policy : Policy
        Has `predict(observation, deterministic=True)`.
    env : gymnasium.Env
        With render mode "rgb_array" and a time limit.
    episodes : int
        How many; each ends when the goal has been held for HELD_STEPS.
    seed : int
        Episode i is seeded with `seed` + i.

    Raises
    ------
    ValueError
        For an environment with another render mode.
    """
    if env.render_mode != "rgb_array":
        raise ValueError(f"env has render_mode {env.render_mode!r}: expected 'rgb_array'")
    shown: Frames = []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        shown.append(env.render())  # type: ignore[arg-type]  # not a list with this mode
        held, over = 0, False
        while not over and held < HELD_STEPS:
            action, _ = policy.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            shown.append(env.render())  # type: ignore[arg-type]
            held, over = (held + 1 if info["is_success"] else 0), terminated or truncated
    return shown


def check_path(path: Path) -> None:
    """Raise ValueError for a path that `save` cannot write, ModuleNotFoundError if MoviePy is missing for it."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"path = {str(path)!r}: expected a file name that ends with {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".mp4":
        import moviepy  # noqa: F401


def save(shown: Frames, path: Path, fps: int) -> None:
    """Write pictures (h, w, 3) as a video, in the format that the path's suffix names.

    Raises
    ------
    ValueError
        If the suffix is not in SUFFIXES or there are no pictures.
    ModuleNotFoundError
        If MoviePy is missing and the suffix needs it.
    """
    check_path(path)
    if not shown:
        raise ValueError(f"shown = {shown!r}: expected pictures")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".mp4":
        from moviepy import ImageSequenceClip

        with ImageSequenceClip(shown, fps=fps) as clip:
            clip.write_videofile(str(path), logger=None, audio=False)
        return
    from PIL import Image

    first, *others = (Image.fromarray(picture) for picture in shown)
    how: dict[str, Any] = {"quality": WEBP_QUALITY, "method": 4} if path.suffix.lower() == ".webp" else {"optimize": True}
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, **how)
