"""Checks of arguments: each check refuses invalid values, and returns the converted value."""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection, Iterable
from difflib import get_close_matches
from functools import wraps
from numbers import Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray

LoadUnit = Literal["power", "current"]

#: Largest magnitude of the load of one cell, per unit; a larger value is probably in another unit (mA for A).
LOAD_LIMITS: dict[str, float] = {"power": 5000.0, "current": 1000.0}
LOAD_UNIT_SYMBOLS: dict[str, str] = {"power": "W", "current": "A"}
#: 0 degC in K.
ZERO_CELSIUS_K = 273.15


def check_options(caller: str, names: Iterable[str], options: Collection[str]) -> None:
    """Refuse an unknown option, and suggest a similar one."""
    for name in names:
        if name not in options:
            matches = get_close_matches(name, options, 1)
            hint = f"did you mean {matches[0]}?" if matches else f"give {[*options]}"
            raise TypeError(f"{caller} takes no {name!r}: {hint}")


def with_option_hints(dataclass: Any) -> Any:
    """Make a dataclass suggest a similar option for an unknown one."""
    init: Callable[..., None] = dataclass.__init__

    @wraps(init)
    def checked_init(self: Any, *arguments: Any, **options: Any) -> None:
        check_options(dataclass.__name__, options, dataclass.__dataclass_fields__)
        init(self, *arguments, **options)

    dataclass.__init__ = checked_init
    return dataclass


def check_real(name: str, values: object) -> None:
    """Refuse truth values and complex numbers, which numpy would convert."""
    array = np.asarray(values, dtype=None if hasattr(values, "dtype") else object)
    for value in array.flat if array.dtype.kind == "O" else array.flat[:1]:
        if isinstance(value, bool | np.bool_ | complex | np.complexfloating):
            raise TypeError(f"{name} must hold real numbers, got {value!r}")


def check_numbers(name: str, values: ArrayLike, unit: str = "") -> FloatArray:
    """Refuse values that are no numbers."""
    check_real(name, values)
    try:
        return np.asarray(values, dtype=np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        unit = f" in {unit}" if unit else ""
        raise TypeError(f"{name} must be a number or an array of numbers{unit}, got {values!r}") from error


def check_within(name: str, values: ArrayLike, limits: tuple[float, float], unit: str, hint: str) -> FloatArray:
    """Refuse values beyond their limits."""
    array = check_numbers(name, values, unit)
    is_within = (array >= limits[0]) & (array <= limits[1])
    if not is_within.all():
        outlier = array[~is_within].flat[0]
        raise ValueError(f"{name} must lie within {limits[0]:g} .. {limits[1]:g} {unit}, got {outlier:g}. {hint}")
    return array


def check_range(name: str, limits: tuple[float, float]) -> tuple[float, float]:
    """Refuse limits that are not two finite numbers in ascending order."""
    try:
        low, high = map(float, limits)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be two numbers, lower and upper end, got {limits!r}") from error
    if not -np.inf < low <= high < np.inf:
        raise ValueError(f"{name} must be finite and increasing, got {limits!r}")
    return low, high


def check_positive(name: str, value: float) -> float:
    """Refuse a value that is not a positive, finite number."""
    if not isinstance(value, Real) or not 0.0 < value < np.inf:
        raise ValueError(f"{name} must be a positive, finite number, got {value!r}")
    return float(value)


def check_not_negative(**values: float) -> None:
    """Refuse values that are negative or not finite."""
    for name, value in values.items():
        if not 0.0 <= value < np.inf:
            raise ValueError(f"{name} must be finite and at least 0, got {value!r}")


def check_whole_number(name: str, value: int, least: int) -> int:
    """Refuse a value that is no whole number, or too small."""
    try:
        number = operator.index(value)
    except TypeError as error:
        raise TypeError(f"{name} must be a whole number, got {value!r}") from error
    if number < least:
        raise ValueError(f"{name} must be at least {least}, got {value!r}")
    return number


def check_indices(name: str, values: ArrayLike, size: int) -> IntArray:
    """Refuse invalid indices of a sequence."""
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TypeError(f"{name} must hold whole numbers, got {values!r}") from error
    if array.size == 0:
        return array.astype(np.int64)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} must hold whole numbers (of a mask, give np.flatnonzero), got {array.dtype} values")
    if not ((array >= 0) & (array < size)).all():
        raise ValueError(f"{name} must lie within 0 .. {size - 1}, got {array.min()} .. {array.max()}")
    return array.astype(np.int64)


def check_load(load: ArrayLike, load_unit: LoadUnit) -> FloatArray:
    """Refuse invalid loads. Negative loads charge the cell."""
    if not isinstance(load_unit, str) or load_unit not in LOAD_LIMITS:
        raise ValueError(f"load_unit must be 'power' (W) or 'current' (A), got {load_unit!r}")
    limit = LOAD_LIMITS[load_unit]
    return check_within("load", load, (-limit, limit), LOAD_UNIT_SYMBOLS[load_unit], f"The unit of the load is {load_unit}.")


def check_gain_sd(current_gain_sd: float) -> float:
    """Refuse an invalid uncertainty of the current sensor."""
    if not 0.0 <= current_gain_sd < 1.0:
        raise ValueError(f"current_gain_sd is a share within 0 .. 1 (1 %: 0.01), got {current_gain_sd!r}")
    return float(current_gain_sd)
