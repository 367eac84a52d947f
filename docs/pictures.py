"""Draw the animated pictures of the tasks: python docs/pictures.py writes docs/reach.webp and so on (needs the extra `render`).

They show episodes that the scripted controllers solve.
"""

from pathlib import Path

import gymnasium

import tca_envs  # noqa: F401  (registers the environments)
from agents.scripted import CONTROLLERS
from agents.video import frames, save
from tca_envs.render import FPS

SIZE = 400
"""[pixel]"""
EPISODES = {
    "reach": ("TCAReach-v0", (1, 7, 0)),
    "twist-align": ("TCATwistAlign-v0", (9, 8, 14)),
    "pick-and-place": ("TCAPickAndPlace-v0", (8,)),
}
"""Environment and seeds of each task's episodes: those with much to see."""


def main() -> None:
    """Write them."""
    for task, (name, seeds) in EPISODES.items():
        env = gymnasium.make(name, render_mode="rgb_array", width=SIZE, height=SIZE)
        shown = [picture for seed in seeds for picture in frames(CONTROLLERS[task](), env, seed=seed)]
        env.close()
        path = Path(__file__).with_name(f"{task}.webp")
        save(shown, path, FPS)
        print(f"wrote {path.name}: {len(shown)} pictures, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
