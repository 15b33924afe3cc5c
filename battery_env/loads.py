"""Loads of a cell: current or power as a function of time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import LoadUnit, check_load, check_numbers, check_positive, check_range
from battery_env.records import Record, is_load, load_span, resample_current, switches

_MOST_SEGMENTS = 1e6  # of a random load; more segments mean a time in another unit
#: The blocks of :class:`BlockBootstrap`, as a share of the record.
BLOCK_SHARE = 0.1


def _check_segments(total_s: float, name: str, shortest_s: float) -> None:
    if total_s / shortest_s > _MOST_SEGMENTS:
        raise ValueError(f"total_s and {name} make more than {_MOST_SEGMENTS:g} segments, got {total_s!r} and {shortest_s!r}")


class KnownLoad(ABC):
    """A load that is known at all times, with its unit, ``"power"`` or ``"current"``."""

    unit: LoadUnit
    #: After this time the load never discharges a cell, s; infinite if unknown.
    until_s: float = np.inf

    @abstractmethod
    def __call__(self, time_s: ArrayLike) -> FloatArray:
        """Return the load at some times, W or A."""

    @abstractmethod
    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray:
        """Return the mean of the load over steps that start at some times, s, which keeps its charge or energy."""


@dataclass(frozen=True, eq=False)
class Load(KnownLoad):
    """
    A piecewise-constant load. Value k holds from ``start_s[k]`` (included) to ``start_s[k + 1]`` (excluded), and the last
    value for ever.

    :param start_s: start of each segment, s, shape (K,), the first 0, increasing
    :param value: power in W or current in A, positive in discharge, shape (K,)
    :param unit: ``"power"`` or ``"current"``
    :raises ValueError: for wrong shapes, times that do not increase from 0, or values out of range
    """

    start_s: FloatArray
    value: FloatArray
    unit: LoadUnit = "power"

    def __post_init__(self) -> None:
        start = check_numbers("start_s", self.start_s).copy()
        value = check_load(check_numbers("value", self.value), self.unit).copy()
        if start.ndim != 1 or start.size == 0 or start.shape != value.shape:
            raise ValueError(f"start_s and value must be 1-D, alike and not empty, got shapes {start.shape} and {value.shape}")
        if start[0] != 0.0 or not (np.diff(start) > 0.0).all() or not np.isfinite(start).all():
            raise ValueError(f"start_s must be finite and increase from 0, got {start}")
        object.__setattr__(self, "start_s", start)
        object.__setattr__(self, "value", value)

    def __call__(self, time_s: ArrayLike) -> FloatArray:
        time = check_numbers("time_s", time_s)
        if not (time >= 0.0).all():
            raise ValueError(f"time_s must be at least 0, got {time[~(time >= 0.0)][0]:g}")
        return np.asarray(self.value[np.searchsorted(self.start_s, time, side="right") - 1])

    @property
    def until_s(self) -> float:  # type: ignore[override]
        """After this time the load never discharges a cell, s."""
        discharge_rows = np.flatnonzero(self.value > 0.0)
        return float(np.append(self.start_s, np.inf)[discharge_rows[-1] + 1 if len(discharge_rows) else 0])

    @cached_property
    def _totals(self) -> FloatArray:
        return np.append(0.0, np.cumsum(self.value[:-1] * np.diff(self.start_s)))

    def drawn(self, time_s: FloatArray) -> FloatArray:
        """Return the charge of a current, C, or the energy of a power, J, until some times."""
        # the last value continues
        after_end_s = np.maximum(time_s - self.start_s[-1], 0.0)
        return np.asarray(np.interp(time_s, self.start_s, self._totals) + self.value[-1] * after_end_s)

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray:
        return (self.drawn(time_s + dt_s) - self.drawn(time_s)) / dt_s


@dataclass(frozen=True, eq=False)
class Cycle(KnownLoad):
    """
    A load that repeats: a mission, a drive cycle, a pulse.

    :param load: one cycle
    :param period_s: time after which the load repeats, s
    :raises ValueError: for a period that is not positive
    """

    load: Load
    period_s: float

    def __post_init__(self) -> None:
        check_positive("period_s", self.period_s)

    @property
    def unit(self) -> LoadUnit:  # type: ignore[override]
        """``"power"`` or ``"current"``."""
        return self.load.unit

    def __call__(self, time_s: ArrayLike) -> FloatArray:
        time = check_numbers("time_s", time_s)
        # within rounding, a whole number of periods belongs to the cycle that starts there
        cycle_s = time - self.period_s * np.floor(time / self.period_s + 1e-9)
        return self.load(np.where(time < 0.0, time, np.maximum(cycle_s, 0.0)))

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray:
        def drawn(until_s: FloatArray) -> FloatArray:
            cycles, within_s = np.divmod(until_s, self.period_s)
            return cycles * self.load.drawn(np.asarray(self.period_s)) + self.load.drawn(within_s)

        return (drawn(time_s + dt_s) - drawn(time_s)) / dt_s


@dataclass(frozen=True, eq=False)
class _Spliced(KnownLoad):
    """Blocks of a series of values, one after the other, repeated after the last block; the series is a circle."""

    # no array holds a day of values, because a forecast has a thousand of these loads
    value: FloatArray  # one for each ``dt_s``
    start: IntArray  # start of each block in the series
    length: int  # of a block, in values
    dt_s: float
    unit: LoadUnit

    def __call__(self, time_s: ArrayLike) -> FloatArray:
        block, offset = np.divmod((np.asarray(time_s) / self.dt_s + 1e-9).astype(np.int64), self.length)
        return np.asarray(self.value[(self.start[block % len(self.start)] + offset) % len(self.value)])

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray:
        # only the values within the steps
        start, length = time_s / self.dt_s, dt_s / self.dt_s
        edges = np.arange(int(start.min()), int(np.ceil(start.max() + length)) + 1, dtype=np.float64)
        totals = np.append(0.0, np.cumsum(self(self.dt_s * edges[:-1])))
        return (np.interp(start + length, edges, totals) - np.interp(start, edges, totals)) / length


#: A function that draws a load, for :meth:`battery_env.trajectories.TrajectoryDataset.generate`.
LoadSampler = Callable[[np.random.Generator], Load]


class RandomLoad(ABC):
    """A load with a known distribution: :func:`battery_env.forecast` draws a load for each sample."""

    @abstractmethod
    def __call__(self, rng: np.random.Generator) -> KnownLoad:
        """Draw one load."""


@dataclass(frozen=True, eq=False)
class _Function(KnownLoad):
    """A function of time as a load: its value at the start of a step holds over the step."""

    function: Callable[[FloatArray], ArrayLike]
    unit: LoadUnit

    def __call__(self, time_s: ArrayLike) -> FloatArray:
        time = np.asarray(time_s, dtype=np.float64)
        values = check_load(self.function(time), self.unit)
        if values.shape not in ((), time.shape):
            raise ValueError(f"load must return one value for each time, shape {time.shape}, got shape {values.shape}")
        return np.broadcast_to(values, time.shape)

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray:
        return self(time_s)


#: A future load, as an argument.
LoadToCome = float | KnownLoad | RandomLoad | Callable[[FloatArray], ArrayLike]


def known_load(load: Any, unit: LoadUnit) -> KnownLoad:
    """Convert a load, a number or a function of time in s that takes an array; ``unit`` is that of a number or a function."""
    if isinstance(load, KnownLoad):
        return load
    if callable(load):
        return _Function(load, unit)
    value = check_numbers("load", load)
    if value.ndim:
        raise TypeError(
            f"load must be a number, a function of time or a load of battery_env.loads, got an array of shape {value.shape}. "
            "Give Load(time_s, value, unit), with time_s from 0 at the end of the record."
        )
    return constant(float(value), unit)


def constant(value: float, unit: LoadUnit = "power") -> Load:
    """Return a constant load, power in W or current in A."""
    return Load(np.zeros(1), check_numbers("value", [value]), unit)


@dataclass(frozen=True)
class RandomPiecewise(RandomLoad):
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
        check_load(check_range("value_range", self.value_range), self.unit)
        check_range("duration_range_s", self.duration_range_s)
        for name in ("value_range", "duration_range_s"):
            check_positive(f"the lower end of {name}", getattr(self, name)[0])
        check_positive("total_s", self.total_s)
        _check_segments(self.total_s, "duration_range_s", self.duration_range_s[0])

    def __call__(self, rng: np.random.Generator) -> Load:
        """Draw one load."""
        segments = int(np.ceil(self.total_s / self.duration_range_s[0]))
        durations = rng.uniform(*self.duration_range_s, size=segments)
        starts_s = np.append(0.0, np.cumsum(durations)[:-1])
        count = int(np.searchsorted(starts_s[1:], self.total_s)) + 1
        return Load(starts_s[:count], rng.uniform(*self.value_range, size=segments)[:count], self.unit)


@dataclass(frozen=True)
class RandomWalk(RandomLoad):
    """
    A sampler of piecewise-constant random walks: each value is the last value plus a uniform random step, reflected at the
    bounds. The first value, and therefore each value, is uniform between the bounds.

    :param value_range: lowest and highest value, W or A
    :param largest_step: largest change from one segment to the next, W or A
    :param segment_s: how long each value holds, s
    :param total_s: for how long the load changes; beyond, its last value goes on
    :param unit: ``"power"`` or ``"current"``
    :raises ValueError: for a range that is not increasing and positive, or other values that are not positive
    """

    value_range: tuple[float, float] = (2.0, 8.0)
    largest_step: float = 2.0
    segment_s: float = 60.0
    total_s: float = 20_000.0
    unit: LoadUnit = "power"

    def __post_init__(self) -> None:
        low, high = check_range("value_range", self.value_range)
        check_load((low, high), self.unit)
        check_positive("the lower end of value_range", low)
        check_positive("the width of value_range", high - low)
        for name in ("largest_step", "segment_s", "total_s"):
            check_positive(name, getattr(self, name))
        _check_segments(self.total_s, "segment_s", self.segment_s)

    def __call__(self, rng: np.random.Generator) -> Load:
        """Draw one load."""
        low, high = self.value_range
        width = high - low
        segments = int(np.ceil(self.total_s / self.segment_s))
        steps = rng.uniform(-self.largest_step, self.largest_step, size=segments - 1)
        free_walk = np.cumsum(np.concatenate([[rng.uniform(0.0, width)], steps]))
        # a walk between two mirrors is a free walk, folded
        walk = width - np.abs(free_walk % (2.0 * width) - width)
        return Load(self.segment_s * np.arange(segments, dtype=np.float64), low + walk, self.unit)


def steadier_unit(record: Record) -> LoadUnit:
    """Return the unit that the consumer controls: what drifts less between switches while the voltage falls."""
    current_A = np.asarray(record.current_A)
    stretches, is_loaded = np.split(np.arange(len(current_A)), switches(current_A) + 1), is_load(current_A)
    drift = {"current": 0.0, "power": 0.0}
    for stretch in stretches:
        # the first sample after a switch may mix both sides
        third = (len(stretch) - 1) // 3
        if third < 1 or not is_loaded[stretch].all():
            continue
        for unit, load in (("current", current_A), ("power", current_A * np.asarray(record.voltage_V))):
            drift[unit] += float(np.log(load[stretch[-third:]].mean() / load[stretch[1 : 1 + third]].mean()) ** 2)
    return "power" if drift["power"] < drift["current"] else "current"


@dataclass(frozen=True, eq=False)
class BlockBootstrap(RandomLoad):
    """
    A sampler of loads that continue a record: random blocks of the record, one after the other. The order within a block
    stays, so that pulses remain pulses.

    The record is one draw of the load, and its length limits the accuracy of its mean. Therefore the blocks are drawn twice:
    first as many blocks as the record has, which make another possible record; then the future blocks from this record. Blocks
    may run over the end of the record to its start (the circular block bootstrap of Politis and Romano, 1992).

    :param record: one discharge, from load-on, or in progress; a rest before its load is left out
    :param unit: ``"power"`` (voltage times current) or ``"current"``
    :param block_s: length of a block, s; ``None``: a tenth of the record
    :param dt_s: values are means over this time, s
    :param total_s: for how long blocks are drawn; beyond, they come again
    :raises ValueError: for a record without load, or of less than two blocks, or other values that are not positive
    """

    record: Record
    unit: LoadUnit = "current"
    block_s: float | None = None
    dt_s: float = 1.0
    total_s: float = 86_400.0

    def __post_init__(self) -> None:
        for name in ("dt_s", "total_s"):
            check_positive(name, getattr(self, name))
        if self.block_s is not None:
            check_positive("block_s", self.block_s)
        if 2 * self._length > len(self._values):
            raise ValueError(
                f"block_s must be at most half of the {self.dt_s * len(self._values):g} s under load, got {self.block_s!r}"
            )
        _check_segments(self.total_s, "block_s", self._length * self.dt_s)

    @cached_property
    def _values(self) -> FloatArray:
        current_A = np.asarray(self.record.current_A)
        time_s = np.asarray(self.record.time_s)
        span = load_span(time_s, current_A)
        load = current_A * np.asarray(self.record.voltage_V) if self.unit == "power" else current_A
        first, last = (int((time_s[n] - time_s[0]) / self.dt_s + 1e-9) for n in (span.first, -1))
        return check_load(resample_current(time_s, load, self.dt_s, last)[first:], self.unit)

    @cached_property
    def _length(self) -> int:
        block_s = self.block_s or BLOCK_SHARE * self.dt_s * len(self._values)
        return max(round(block_s / self.dt_s), 1)

    def __call__(self, rng: np.random.Generator) -> KnownLoad:
        """Draw one load."""
        count = len(self._values)
        sources = rng.integers(count, size=-(-count // self._length))
        blocks = int(np.ceil(self.total_s / (self._length * self.dt_s)))
        return _Spliced(self._values, rng.choice(sources, size=blocks), self._length, self.dt_s, self.unit)
