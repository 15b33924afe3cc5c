"""Loads on a cell: what it delivers, as a function of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from battery_env.electrochemistry import FloatArray, LoadUnit, check_load


@dataclass(frozen=True, eq=False)
class Load:
    """
    A piecewise-constant load. Value k holds from ``start_s[k]`` (included) to ``start_s[k + 1]`` (excluded), the last one
    for ever.

    :param start_s: start of each segment, s, shape (K,), the first 0, increasing
    :param value: power in W or current in A, positive in discharge, shape (K,)
    :param unit: ``"power"`` or ``"current"``
    :raises ValueError: for wrong shapes, times that do not increase from 0, or values out of range
    """

    start_s: FloatArray
    value: FloatArray
    unit: LoadUnit = "power"

    def __post_init__(self) -> None:
        start = np.array(self.start_s, dtype=np.float64)
        value = check_load(np.array(self.value, dtype=np.float64), self.unit)
        if start.ndim != 1 or start.size == 0 or start.shape != value.shape:
            raise ValueError(f"start_s and value must be 1-D, alike and not empty, got shapes {start.shape} and {value.shape}")
        if start[0] != 0.0 or not (np.diff(start) > 0.0).all() or not np.isfinite(start).all():
            raise ValueError(f"start_s must be finite and increase from 0, got {start}")
        object.__setattr__(self, "start_s", start)
        object.__setattr__(self, "value", value)

    def __call__(self, time_s: ArrayLike) -> FloatArray:
        """
        The load at some times.

        :param time_s: s, at least 0, any shape
        :return: the load, same shape
        :raises ValueError: for a negative time
        """
        time = np.asarray(time_s, dtype=np.float64)
        if not (time >= 0.0).all():
            raise ValueError(f"time_s must be at least 0, got {time.min() if time.size else time}")
        return np.asarray(self.value[np.searchsorted(self.start_s, time, side="right") - 1])


#: Draws a load at random: what :meth:`battery_env.trajectories.TrajectoryDataset.generate` takes for random loads.
LoadSampler = Callable[[np.random.Generator], Load]


def constant(value: float, unit: LoadUnit = "power") -> Load:
    """
    The same load at all times.

    :param value: power in W or current in A
    :param unit: ``"power"`` or ``"current"``
    :return: the load
    """
    return Load(np.zeros(1), np.array([value], dtype=np.float64), unit)


def piecewise(values: ArrayLike, durations_s: ArrayLike, unit: LoadUnit = "power") -> Load:
    """
    One value after the other, each for its duration; the last one goes on.

    :param values: power in W or current in A, shape (K,)
    :param durations_s: how long each value holds, s, shape (K,), all positive
    :param unit: ``"power"`` or ``"current"``
    :return: the load
    """
    durations = np.asarray(durations_s, dtype=np.float64)
    if durations.ndim != 1 or not (durations > 0.0).all():
        raise ValueError(f"durations_s must be 1-D and positive, got {durations_s!r}")
    return Load(np.concatenate([[0.0], np.cumsum(durations)[:-1]]), np.asarray(values, dtype=np.float64), unit)


@dataclass(frozen=True)
class RandomPiecewise:
    """
    A sampler of piecewise-constant loads: values and durations uniform at random.

    :param value_range: lowest and highest value, W or A
    :param duration_range_s: shortest and longest segment, s
    :param total_s: for how long the load changes; beyond, its last value goes on
    :param unit: ``"power"`` or ``"current"``
    :raises ValueError: for ranges that are not increasing and positive
    """

    value_range: tuple[float, float] = (2.0, 8.0)
    duration_range_s: tuple[float, float] = (60.0, 140.0)
    total_s: float = 20_000.0
    unit: LoadUnit = "power"

    def __post_init__(self) -> None:
        check_load(np.array(self.value_range), self.unit)
        for name in ("value_range", "duration_range_s"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"{name} must be positive and increasing, got {(low, high)}")
        if not self.total_s > 0.0:
            raise ValueError(f"total_s must be positive, got {self.total_s!r}")

    def __call__(self, rng: np.random.Generator) -> Load:
        """
        Draw one load.

        :param rng: source of randomness
        :return: the load
        """
        segments = int(np.ceil(self.total_s / self.duration_range_s[0]))
        durations = rng.uniform(*self.duration_range_s, size=segments)
        count = int(np.searchsorted(np.cumsum(durations), self.total_s)) + 1
        return piecewise(rng.uniform(*self.value_range, size=segments)[:count], durations[:count], self.unit)
