"""How good a policy is: success rate with its uncertainty, final distance, time to success, energy."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isnan, sqrt
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from tca_envs.tasks.core import STEP_S

MOST_LANES = 250
"""Episodes that are run at once."""


class Policy(Protocol):
    """What can be evaluated: an SB3 model or a scripted controller."""

    def predict(self, observation: Any, state: Any = ..., episode_start: Any = ..., deterministic: bool = ...) -> Any:
        """Return (actions, state)."""


@dataclass(frozen=True)
class Episodes:
    """Results of n episodes. One succeeds if its last step does and the solver converged: the goal must be held."""

    success: NDArray[np.bool_]
    """(n,)"""
    held_since_s: NDArray[np.float64]
    """(n,) time from which on the goal is held [s]; meaningless for failed episodes."""
    distance_mm: NDArray[np.float64]
    """(n,) at the end, nan where the task has none."""
    yaw_error_deg: NDArray[np.float64]
    """(n,) at the end, nan where the task has none."""
    energy_J: NDArray[np.float64]
    """(n,) electrical."""
    total: NDArray[np.float64]
    """(n,) sum of the rewards."""
    converged: NDArray[np.bool_]
    """(n,) False where the solver failed, which truncates the episode."""


@dataclass(frozen=True)
class Report:
    """Result of `evaluate`, see `Episodes`."""

    episodes: int
    successes: int
    success_rate: float
    success_interval: tuple[float, float]
    """95 % Wilson score interval of the success rate."""
    final_distance_mm: float | None
    """Mean over episodes; None where the task has none."""
    final_yaw_error_deg: float | None
    """Mean over episodes; None where the task has none."""
    time_to_success_s: float | None
    """Time from which on the goal is held, mean over successful episodes; None without any."""
    energy_J: float
    """Mean electrical energy of an episode."""
    episode_return: float
    """Mean."""
    solver_failures: int
    """Episodes that were truncated because the solver failed."""

    def __str__(self) -> str:
        low, high = self.success_interval
        time = "  --  " if self.time_to_success_s is None else f"{self.time_to_success_s:4.2f} s"
        distance = "" if self.final_distance_mm is None else f"final distance {self.final_distance_mm:.2f} mm, "
        yaw = "" if self.final_yaw_error_deg is None else f"yaw error {self.final_yaw_error_deg:.2f} deg, "
        return (
            f"success {100 * self.success_rate:5.1f} % (95 % interval {100 * low:.1f}-{100 * high:.1f} %), "
            f"{distance}{yaw}time to success {time}, energy {self.energy_J:.1f} J"
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


def lanes_for(episodes: int) -> int:
    """Return how many lanes run `episodes` in the fewest rounds that MOST_LANES allows, with the fewest idle lanes."""
    rounds = -(-episodes // MOST_LANES)
    return -(-episodes // rounds)


def evaluate(
    policy: Policy,
    env: VectorEnv[Any, Any, Any] | gymnasium.Env[Any, Any],
    episodes: int,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Report:
    """Run a policy and summarise its episodes; parameters as of `run`."""
    return summary(run(policy, env, episodes, seed, progress))


def run(
    policy: Policy,
    env: VectorEnv[Any, Any, Any] | gymnasium.Env[Any, Any],
    episodes: int,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Episodes:
    """Run a policy.

    Parameters
    ----------
    policy : Policy
        Has `predict(observation, deterministic=True)`, for a batch of observations.
    env : gymnasium.vector.VectorEnv or gymnasium.Env
        Environments with a time limit, in the autoreset mode NEXT_STEP, the default of `gymnasium.make_vec`; a single one is
        a batch of one.
    episodes : int
        How many; episode i is seeded with `seed` + i, so that every policy gets the same goals, whatever the batch.
    seed : int
        First seed.
    progress : callable, optional
        Called with the number of episodes done.

    Returns
    -------
    Episodes

    Raises
    ------
    ValueError
        If `episodes` is not a positive integer or the environments have another autoreset mode.
    """
    if not isinstance(episodes, int) or episodes < 1:
        raise ValueError(f"episodes = {episodes!r}: expected a positive integer")
    if isinstance(env, gymnasium.Env):
        single = env
        env = SyncVectorEnv([lambda: single])
    if env.metadata["autoreset_mode"] != AutoresetMode.NEXT_STEP:
        raise ValueError(f"env has autoreset_mode {env.metadata['autoreset_mode']}: expected {AutoresetMode.NEXT_STEP}")
    lanes = env.num_envs
    held = np.zeros(episodes, dtype=bool)
    converged = np.zeros(episodes, dtype=bool)
    held_since = np.zeros(episodes, dtype=int)
    energy, total = np.zeros(episodes), np.zeros(episodes)
    distance, yaw = np.full(episodes, np.nan), np.full(episodes, np.nan)
    done = 0
    for first in range(0, episodes, lanes):
        seeds = [seed + first + lane for lane in range(lanes)]
        observation, info = env.reset(seed=seeds)  # type: ignore[arg-type]  # lists are fine
        running, steps = np.arange(min(lanes, episodes - first)), 0
        held_since[first + running] = ~info["is_success"][running]  # at the first step's end, unless at rest already
        while running.size:
            action, _ = policy.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            steps += 1
            total[first + running] += reward[running]
            held_since[first + running[~info["is_success"][running]]] = steps + 1
            over = (terminated | truncated)[running]
            ended, running = running[over], running[~over]
            held[first + ended] = info["is_success"][ended]
            converged[first + ended] = info["solver"]["converged"][ended]
            energy[first + ended] = info["energy_J"][ended]
            for name, values in (("distance_mm", distance), ("yaw_error_deg", yaw)):
                if name in info:
                    values[first + ended] = info[name][ended]
            done += ended.size
            if progress is not None and ended.size:
                progress(done)
    return Episodes(held & converged, held_since * step_duration(env), distance, yaw, energy, total, converged)


def step_duration(env: VectorEnv[Any, Any, Any]) -> float:
    """Return the duration of a step of environments [s]; STEP_S if they have no task that tells it."""
    one = env.envs[0] if isinstance(env, SyncVectorEnv) else env
    return float(getattr(getattr(one.unwrapped, "task", None), "step_s", STEP_S))


def summary(episodes: Episodes) -> Report:
    """Summarise n episodes, at least one."""
    success = episodes.success
    distance, yaw = float(episodes.distance_mm.mean()), float(episodes.yaw_error_deg.mean())
    return Report(
        episodes=success.size,
        successes=int(success.sum()),
        success_rate=float(success.mean()),
        success_interval=wilson(int(success.sum()), success.size),
        final_distance_mm=None if isnan(distance) else distance,
        final_yaw_error_deg=None if isnan(yaw) else yaw,
        time_to_success_s=float(episodes.held_since_s[success].mean()) if success.any() else None,
        energy_J=float(episodes.energy_J.mean()),
        episode_return=float(episodes.total.mean()),
        solver_failures=int((~episodes.converged).sum()),
    )
