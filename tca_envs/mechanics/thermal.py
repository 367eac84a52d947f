"""Heating: first-order model of a TCA in still air, C dT/dt = P - lambda (T - T_amb), and its exact solution.

All functions work elementwise on arrays of any shape; the last axis is the muscles', so that constants may be (n,) arrays.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tca_envs.mechanics import check
from tca_envs.mechanics.laws import REFERENCE_LENGTH

Array = NDArray[np.float64]

AMBIENT = 25.0
"""Air temperature [degC]."""
SOFT_LIMIT = 150.0
"""Highest temperature for long use [degC]."""
HARD_LIMIT = 160.0
"""Temperature that is never reached [degC]."""


KEPT, LOST, LOSS, MAX_POWER, AIR, LIMIT = range(6)
"""Rows of `constants`."""


class Heat(NamedTuple):
    """How drives come about that are temperatures of heated TCAs: by one step of `heated`."""

    action: Array  # (N, m) heating powers asked for, -1 (none) to 1 (full)
    temperature: Array  # (N, m) at the start of the step [degC]
    power: Array  # (N, m) out: heating powers [W]
    constants: Array  # (6, m), see `constants`


class Heating(NamedTuple):
    """Thermal constants of n muscles."""

    capacity: Array  # C (n,) [J/K]
    loss: Array  # lambda (n,) [W/K]
    max_power: Array  # (n,) [W]
    ambient: float = AMBIENT  # T_amb [degC]

    def part(self, muscles: slice) -> "Heating":
        """Return the constants of some of the muscles."""
        return Heating(self.capacity[muscles], self.loss[muscles], self.max_power[muscles], self.ambient)


@dataclass(frozen=True)
class Heater:
    """Thermal constants of a 45 mm TCA in still air; all scale with the rest length.

    Nobody has published these for this arm; they follow from coils of the same fibre, with medium confidence.

    Parameters
    ----------
    capacity : float
        C [J/K].
    loss : float
        lambda [W/K]; capacity/loss = 1.8 s.
    max_power : float
        [W].
    """

    capacity: float = 0.0193
    loss: float = 0.0107
    max_power: float = 2.0

    def __post_init__(self) -> None:
        for name in ("capacity", "loss", "max_power"):
            check.scalar(name, getattr(self, name), 0.0, above=True)

    def scaled(self, rest_lengths: ArrayLike) -> Heating:
        """Return the constants of muscles of the given rest lengths (n,) [m]."""
        scale = check.array("rest_lengths", rest_lengths, (None,)) / REFERENCE_LENGTH
        if not (scale > 0.0).all():
            raise ValueError(f"rest_lengths = {rest_lengths!r}: expected positive lengths")
        return Heating(self.capacity * scale, self.loss * scale, self.max_power * scale)


def step(temperature: ArrayLike, power: ArrayLike, duration: float, heating: Heating) -> Array:
    """Return the temperature [degC] after `duration` [s] at constant power (exact zero-order hold).

    Parameters
    ----------
    temperature : (..., n) array
        [degC].
    power : (..., n) array
        [W].
    duration : float
        [s], at least 0.
    heating : Heating
        Constants of the n muscles.

    Returns
    -------
    (..., n) array
        T_end + (T - T_end) exp(-duration lambda/C) with T_end = T_amb + P/lambda.
    """
    start = np.asarray(temperature, dtype=np.float64)
    end = heating.ambient + np.asarray(power, dtype=np.float64) / heating.loss
    return end + (start - end) * np.exp(-_duration(duration) * heating.loss / heating.capacity)


def power_to_reach(temperature: ArrayLike, target: ArrayLike, duration: float, heating: Heating) -> Array:
    """Return the constant power [W] that takes `temperature` to `target` [degC] in `duration` [s] > 0: inverse of `step`.

    It may be negative or above `heating.max_power`: then no heater reaches the target in that time.
    """
    if _duration(duration) == 0.0:
        raise ValueError(f"duration = {duration!r}: expected a positive number of seconds")
    start = np.asarray(temperature, dtype=np.float64)
    kept = np.exp(-duration * heating.loss / heating.capacity)
    end = (np.asarray(target, dtype=np.float64) - kept * start) / -np.expm1(-duration * heating.loss / heating.capacity)
    return heating.loss * (end - heating.ambient)


def constants(duration: float, limit: float, heating: Heating) -> Array:
    """Return the numbers (6, n) with which `heated` steps temperatures that never exceed `limit` [degC].

    Shares of heat kept and lost in a step of `duration` [s], loss [W/K], full power [W], ambient and limit [degC].
    """
    exponent = -_duration(duration) * heating.loss / heating.capacity
    return np.array(
        np.broadcast_arrays(np.exp(exponent), -np.expm1(exponent), heating.loss, heating.max_power, heating.ambient, limit)
    )


def heated(constants: Any, k: int, temperature: float, action: float) -> tuple[float, float]:
    """Return temperature [degC] after and power [W] in a step of TCA k: `step` at the power asked for, under the cut-off.

    The same text for Python and for the compiled kernels; `action` goes from -1 (no power) to 1 (full).
    """
    kept, loss, ambient = constants[KEPT, k], constants[LOSS, k], constants[AIR, k]
    asked = 0.5 * (min(max(-1.0, action), 1.0) + 1.0) * constants[MAX_POWER, k]
    hottest = (constants[LIMIT, k] - kept * temperature) / constants[LOST, k]
    power = min(asked, max(0.0, loss * (hottest - ambient)))
    end = ambient + power / loss
    return end + (temperature - end) * kept, power


def time_to_reach(temperature: ArrayLike, target: ArrayLike, heating: Heating) -> Array:
    """Return the shortest time [s] in which a heater takes `temperature` (..., n) to `target` (..., n) [degC].

    That is full power upwards and none downwards: C/lambda ln((T_end - T)/(T_end - target)) with the T_end of that power, by
    solving `step` for the duration. It is infinite where the target is T_end or lies beyond it.
    """
    start, end = np.asarray(temperature, dtype=np.float64), np.asarray(target, dtype=np.float64)
    last = np.where(end >= start, heating.ambient + heating.max_power / heating.loss, heating.ambient)
    # What is left of the way to T_end, as a share of the whole of it: 0 or less is never reached, no way takes no time.
    left = np.divide(last - end, last - start, out=np.ones(np.broadcast(start, end, last).shape), where=end != start)
    with np.errstate(divide="ignore"):
        return -heating.capacity / heating.loss * np.log(np.maximum(left, 0.0))


def steady_power(temperature: ArrayLike, heating: Heating) -> Array:
    """Return the power [W] that holds `temperature` [degC]."""
    return heating.loss * (np.asarray(temperature, dtype=np.float64) - heating.ambient)


def _duration(duration: float) -> float:
    return check.scalar("duration", duration, 0.0)
