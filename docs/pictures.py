"""Draw the tasks' animated pictures, docs/reach.webp and so on: python docs/pictures.py (needs the extra `render`).

They show episodes under the scripted controllers.
"""

from pathlib import Path

import gymnasium

from agents.video import frames, save
from tca_envs import registry

SIZE = 400
"""[pixel]"""
EPISODES = {"reach": (1, 7, 0), "twist-align": (9, 8, 14), "pick-and-place": (8,)}
"""Seeds of the episodes of each task, chosen for much motion."""


def main() -> None:
    """Write a picture for each task."""
    for task, seeds in EPISODES.items():
        entry = registry.entry(task)
        controller = registry.load(entry.controller)
        env = gymnasium.make(entry.ids["sparse"], render_mode="rgb_array", width=SIZE, height=SIZE)
        shown = [picture for seed in seeds for picture in frames(controller(), env, seed=seed)]
        path = Path(__file__).with_name(f"{task}.webp")
        save(shown, path, env.metadata["render_fps"])
        env.close()
        print(f"wrote {path.name}: {len(shown)} pictures, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
