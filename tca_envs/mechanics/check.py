"""Checks of arguments: each refuses with a message that names the argument, its value and what was expected."""

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def scalar(name: str, value: Any, low: float = -np.inf, high: float = np.inf, above: bool = False) -> float:
    """Return `value` as a finite float within [low, high], or (low, high] if `above`; ValueError otherwise."""
    interval = f"{'(' if above else '['}{low:g}, {high:g}]"
    expected = "a finite number" if low == -np.inf and high == np.inf else f"a finite number in {interval}"
    if not isinstance(value, int | float | np.integer | np.floating) or isinstance(value, bool):
        raise ValueError(f"{name} = {value!r}: expected {expected}")
    number = float(value)
    if not np.isfinite(number) or number < low or number > high or (above and number == low):
        raise ValueError(f"{name} = {value!r}: expected {expected}")
    return number


def array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """Return a float64 copy of `value`, finite and of `shape` (None: any size); ValueError otherwise."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == shape and isfinite(np.vdot(value, value)):
        return value.copy()  # the usual case, and all that a fast solver has time for
    try:
        given = np.asarray(value)
    except ValueError:  # ragged
        given = np.empty(0, dtype=object)
    if given.dtype.kind not in "iuf":  # not booleans, strings or complex numbers, which NumPy would convert
        raise ValueError(f"{name} = {value!r}: expected finite numbers of shape {_written(shape)}")
    result = np.array(given, dtype=np.float64)
    if result.shape != shape and (
        result.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, result.shape, strict=True))
    ):
        raise ValueError(f"{name} = {value!r} has shape {result.shape}: expected shape {_written(shape)}")
    if not np.isfinite(result).all():
        raise ValueError(f"{name} = {value!r}: expected finite numbers")
    return result


def _written(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
