"""How good a policy is: success rate with its uncertainty, final distance, time to success, energy."""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Any, Protocol

import gymnasium
import numpy as np

from tca_envs.tasks.core import STEP_S


class Policy(Protocol):
    """What is evaluated: an SB3 model or a scripted controller."""

    def predict(self, observation: Any, state: Any = ..., episode_start: Any = ..., deterministic: bool = ...) -> Any:
        """Return (action, state)."""


@dataclass(frozen=True)
class Report:
    """Result of `evaluate`. An episode succeeds if its last step does, by a converged solve: the goal must be held."""

    episodes: int
    successes: int
    success_rate: float
    success_interval: tuple[float, float]
    """95 % Wilson score interval of the success rate."""
    final_distance_mm: float
    """Mean over episodes."""
    time_to_success_s: float | None
    """Mean, over the episodes that succeed, of the time from which on the goal is held; None if none does."""
    energy_J: float
    """Mean electrical energy of an episode."""
    episode_return: float
    """Mean."""
    solver_failures: int
    """Episodes that the solver truncated."""

    def __str__(self) -> str:
        low, high = self.success_interval
        time = "  --  " if self.time_to_success_s is None else f"{self.time_to_success_s:4.2f} s"
        return (
            f"success {100 * self.success_rate:5.1f} % (95 % interval {100 * low:.1f}-{100 * high:.1f} %), "
            f"final distance {self.final_distance_mm:.2f} mm, time to success {time}, energy {self.energy_J:.1f} J"
        )


def wilson(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a proportion (Wilson 1927)."""
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"successes = {successes!r}, trials = {trials!r}: expected 0 <= successes <= trials, trials >= 1")
    p, n = successes / trials, trials
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # At 0 and n the exact bounds are 0 and 1; round-off would miss them.
    return 0.0 if successes == 0 else centre - half, 1.0 if successes == trials else centre + half


def evaluate(
    policy: Policy,
    env: gymnasium.Env[Any, Any],
    episodes: int,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Report:
    """Run a policy.

    Parameters
    ----------
    policy : Policy
        Has `predict(observation, deterministic=True)`.
    env : gymnasium.Env
        One environment with its time limit.
    episodes : int
        How many; episode i is seeded with `seed` + i, so that every policy meets the same goals.
    seed : int
        First seed.
    progress : callable, optional
        Called with the number of episodes done.

    Returns
    -------
    Report

    Raises
    ------
    ValueError
        If `episodes` is not a positive integer.
    """
    if not isinstance(episodes, int) or episodes < 1:
        raise ValueError(f"episodes = {episodes!r}: expected a positive integer")
    successes = failures = 0
    distances, energies, returns, times = [], [], [], []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        total, steps, held_since, over = 0.0, 0, 0, False
        while not over:
            action, _ = policy.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            total += float(reward)
            steps += 1
            if not info["is_success"]:
                held_since = steps + 1
        converged = info["solver"]["converged"]
        successes += info["is_success"] and converged
        failures += not converged
        if info["is_success"] and converged:
            times.append(held_since * STEP_S)
        distances.append(info["distance_mm"])
        energies.append(info["energy_J"])
        returns.append(total)
        if progress is not None:
            progress(episode + 1)
    return Report(
        episodes=episodes,
        successes=successes,
        success_rate=successes / episodes,
        success_interval=wilson(successes, episodes),
        final_distance_mm=float(np.mean(distances)),
        time_to_success_s=float(np.mean(times)) if times else None,
        energy_J=float(np.mean(energies)),
        episode_return=float(np.mean(returns)),
        solver_failures=failures,
    )
