"""The learning curve of a run: evaluations during training, each with a checkpoint."""

import csv
import time
from collections.abc import Callable
from math import isnan, nan
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv
from stable_baselines3.common.callbacks import BaseCallback

from agents.evaluate import evaluate

COLUMNS = ("steps", "seconds", "success_rate", "final_distance_mm", "episode_return")


class Curve(BaseCallback):
    """Evaluate at intervals, keep the best policy, and save what resuming needs.

    A run that is killed can be resumed from the last point: files are replaced atomically.

    Parameters
    ----------
    folder : pathlib.Path
        Of the run: `policy.zip` (the best), `last.zip` and `replay_buffer.pkl` (the latest), `curve.csv` and `curve.png` are
        written there.
    env : gymnasium.vector.VectorEnv
        See `agents.evaluate.evaluate`.
    episodes, seed : int
        Of each point, see there. The policy that comes nearest to these goals is the best; of a task without a distance, that
        with the largest return.
    interval : int
        Steps between points.
    resume : bool
        Whether to continue the curve in `folder`.
    """

    def __init__(
        self, folder: Path, env: VectorEnv[Any, Any, Any], episodes: int, seed: int, interval: int, resume: bool
    ) -> None:
        super().__init__()
        self.folder, self.env, self.episodes, self.seed, self.interval = folder, env, episodes, seed, interval
        self.rows = read(folder) if resume else []
        self.begun = time.monotonic() - (self.rows[-1]["seconds"] if self.rows else 0.0)
        self.due = 0

    @property
    def seconds(self) -> float:
        """Duration of the training so far, earlier parts of a resumed run included."""
        return time.monotonic() - self.begun

    def _on_training_start(self) -> None:
        self.due = self.num_timesteps + self.interval

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.due:
            self.due += self.interval
            self.add_point()
        return True

    def _on_training_end(self) -> None:
        if not self.rows or self.rows[-1]["steps"] < self.num_timesteps:
            self.add_point()
        else:
            self.save()  # the model was updated after the last point

    def add_point(self) -> None:
        """Evaluate and save."""
        report = evaluate(self.model, self.env, self.episodes, self.seed)
        row: dict[str, float] = {
            "steps": self.num_timesteps,
            "seconds": round(self.seconds, 1),
            "success_rate": report.success_rate,
            "final_distance_mm": nan if report.final_distance_mm is None else report.final_distance_mm,
            "episode_return": report.episode_return,
        }
        for name in COLUMNS[2:]:
            self.logger.record(f"eval/{name}", row[name])
        self.logger.dump(self.num_timesteps)
        self.rows.append(row)
        if row is min(self.rows, key=shortfall):
            replace(self.folder / "policy.zip", self.model.save)
        self.save()

    def save(self) -> None:
        """Save the current model and the curve."""
        if hasattr(self.model, "save_replay_buffer"):
            replace(self.folder / "replay_buffer.pkl", self.model.save_replay_buffer)
        replace(self.folder / "last.zip", self.model.save)
        if not (self.folder / "policy.zip").exists():
            replace(self.folder / "policy.zip", self.model.save)
        replace(self.folder / "curve.csv", self._write)
        draw(self.rows, self.folder, self.episodes)

    def _write(self, path: Path) -> None:
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(self.rows)


def shortfall(row: dict[str, float]) -> float:
    """Return what is the smaller, the better a point of the curve is."""
    distance = row["final_distance_mm"]
    return -row["episode_return"] if isnan(distance) else distance


def replace(path: Path, save: Callable[[Path], Any]) -> None:
    """Replace a file atomically by one that `save` writes."""
    written = path.with_name(f"new-{path.name}")
    save(written)
    written.replace(path)


def read(folder: Path) -> list[dict[str, float]]:
    """Return the learning curve of a run, empty if it has none."""
    path = folder / "curve.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def draw(rows: list[dict[str, float]], folder: Path, episodes: int) -> None:
    """Draw a learning curve as curve.png; `episodes` is the number per point."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator

    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(6.0, 5.0), layout="constrained")
    steps = [row["steps"] / 1000.0 for row in rows]
    top.plot(steps, [100.0 * row["success_rate"] for row in rows], "o-", ms=3)
    top.set(ylabel="success rate [%]", ylim=(-3, 103), title=f"{folder.name}: {episodes} episodes per point")
    bottom.semilogy(steps, [row["final_distance_mm"] for row in rows], "o-", ms=3, color="tab:orange")
    bottom.set(xlabel="environment steps [thousands]", ylabel="mean final distance [mm]")
    bottom.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    for axis_format in (bottom.yaxis.set_major_formatter, bottom.yaxis.set_minor_formatter):
        axis_format("{x:g}")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "curve.png", dpi=150)
    plt.close(figure)
