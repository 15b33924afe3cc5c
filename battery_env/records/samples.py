"""
A record: time, voltage and current as they were measured during one discharge. What is valid, how the current runs between
the samples, and what to expect of it after the last one.
"""

from __future__ import annotations

from math import isfinite, isnan
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import LOAD_LIMITS

#: A change of the current between two samples by more than this share of its largest magnitude is a switch of the load,
#: not a drift; the current is taken to jump between the two samples (:func:`switch_times_s`).
SWITCH_SHARE = 0.1
#: A load whose current spreads by more than this share (from the 5th to the 95th percentile) has varied.
VARIED_SHARE = 0.05
#: Least and greatest time between two samples of a stream, s. Seconds given in milliseconds or in hours are mostly beyond.
SAMPLE_INTERVAL_LIMITS_S = (1e-3, 600.0)
#: A cell whose current is below this rests, A; then the next sample may come after as long as a week, s.
REST_CURRENT_A, REST_LIMIT_S = 0.02, 604_800.0
#: Where discharges of recorded cells end if nothing else is said, V.
CUT_OFF_V = 2.7
#: Currents below this share of the largest are taken for noise or sensor offset.
LEAST_LOAD_SHARE = 0.03

_MILLIVOLT = "Give the voltage of one cell in V, not in mV (command line: --units voltage=mV), and not that of a pack."
#: What a current that is out of range usually is.
MILLIAMPERE = "Give the current in A, not in mA (command line: --units current=mA), and that of one cell."
# What to do about a value that is missing in a stream
_MISSING = {
    "voltage_V": "A voltage may be missing (NaN), but for the first one, which tells whether the cell is full.",
    "current_A": "The charge that was drawn cannot do without it: give the mean current since it was last known.",
    "temperature_C": "Leave it out (None) where it is missing.",
}
_KELVIN = "Give the temperature in degrees Celsius, not in kelvin (command line: --units temperature=K)."
# name: least and largest plausible value, unit, what a value beyond usually is
_PLAUSIBLE: dict[str, tuple[float, float, str, str]] = {
    "voltage_V": (-0.1, 5.5, "V", _MILLIVOLT),  # half cells are driven a little below 0
    "current_A": (-LOAD_LIMITS["current"], LOAD_LIMITS["current"], "A", MILLIAMPERE),
    "temperature_C": (-60.0, 150.0, "degC", _KELVIN),
}


class Record(Protocol):
    """
    What was measured during one discharge; a simulated :class:`~battery_env.trajectories.Trajectory` and a recorded
    :class:`~battery_env.Discharge` are both records. All arrays have shape (T,); the current is positive in discharge.
    """

    @property
    def time_s(self) -> FloatArray: ...

    @property
    def voltage_V(self) -> FloatArray: ...

    @property
    def current_A(self) -> FloatArray: ...


class Samples(NamedTuple):
    """Samples of a record, which are a record themselves: s, V, and A, positive in discharge; arrays of shape (T,)."""

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray

    @classmethod
    def of(cls, record: Record) -> Samples:
        """Those of any record."""
        return cls(*(np.asarray(column) for column in (record.time_s, record.voltage_V, record.current_A)))

    def first(self, count: int) -> Samples:
        """The first ones."""
        return Samples(*(column[:count] for column in self))


def check_column(name: str, values: ArrayLike, least_samples: int) -> FloatArray:
    """Refuse an invalid column of a record."""
    if values is None or np.ma.is_masked(values) or np.iscomplexobj(values):
        raise TypeError(f"{name} must hold real numbers, none of them masked, got {type(values).__name__}")
    if np.asarray(values).dtype.kind in "mM":
        raise TypeError(f"{name} must hold numbers, got dates. read_discharges takes a table with dates")
    try:
        array = np.array(values, dtype=np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise TypeError(f"{name} must hold numbers: {error}") from error
    if array.ndim != 1 or len(array) < least_samples:
        raise ValueError(
            f"{name} must hold one value a sample, at least {least_samples} samples in all; got shape {array.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if len(bad):
        raise ValueError(f"{name} must be finite, got {array[bad[0]]} at sample {bad[0]}. Remove or fill such samples.")
    if name in _PLAUSIBLE:
        low, high, _, _ = _PLAUSIBLE[name]
        bad = np.flatnonzero((array < low) | (array > high))
        if len(bad):
            raise ValueError(_implausible(name, float(array[bad[0]]), f" at sample {bad[0]}"))
    array.setflags(write=False)
    return array


def _implausible(name: str, value: float, where: str = "") -> str:
    low, high, unit, hint = _PLAUSIBLE[name]
    # what is too low is of no other unit, as a negative voltage of a half cell
    advice = f" {hint}" if value > high or low == -high else ""
    return f"{name} must lie within {low:g} .. {high:g} {unit}, got {value:g}{where}.{advice}"


def check_record(record: Record, least_samples: int = 1) -> Samples:
    """Refuse an invalid record; one that was checked when it was made, a discharge, is not checked again."""
    if getattr(record, "is_checked", False) and len(record.time_s) >= least_samples:
        return Samples.of(record)
    return check_samples(record.time_s, record.voltage_V, record.current_A, least_samples)


def check_samples(time_s: ArrayLike, voltage_V: ArrayLike, current_A: ArrayLike, least_samples: int = 1) -> Samples:
    """Refuse invalid columns of a record."""
    arrays = {
        name: check_column(name, values, least_samples)
        for name, values in (("time_s", time_s), ("voltage_V", voltage_V), ("current_A", current_A))
    }
    time = arrays["time_s"]
    for name, array in arrays.items():
        if len(array) != len(time):
            raise ValueError(f"{name} has {len(array)} samples, but time_s has {len(time)}")
    stalls = np.flatnonzero(np.diff(time) <= 0.0)
    if len(stalls):
        n = stalls[0] + 1
        if time[n] == time[n - 1]:
            advice = "Give each sample once, with a clock that tells it from the next, or name the column of its step"
        else:
            advice = (
                "Sort the samples, and give one discharge at a time, or number them in a column of the cycle. A clock that "
                "starts anew at midnight needs dates, and one that does with each step a column of the step"
            )
        raise ValueError(
            f"time_s must increase from sample to sample, but sample {n} is at {time[n]:g} s, after {time[n - 1]:g} s. "
            f"{advice}."
        )
    return Samples(**arrays)


def check_sample(
    voltage_V: float,
    current_A: float,
    dt_s: float,
    temperature_C: float | None = None,
    previous_A: float | None = None,
) -> None:
    """
    Refuse one sample of a stream that :func:`check_record` would refuse in a record. A voltage may be missing (NaN), but for
    the first one.
    """
    measured = {"voltage_V": voltage_V, "current_A": current_A}
    if temperature_C is not None:
        measured["temperature_C"] = temperature_C
    for name, value in measured.items():
        low, high, _, _ = _PLAUSIBLE[name]
        if _is_within(name, value, low, high) or (name == "voltage_V" and previous_A is not None and isnan(value)):
            continue
        if isfinite(value):
            raise ValueError(_implausible(name, value))
        raise ValueError(f"{name} must be finite, got {value!r}. {_MISSING[name]}")
    if previous_A is None:
        return
    low, high = SAMPLE_INTERVAL_LIMITS_S
    if abs(previous_A) <= REST_CURRENT_A:
        high = REST_LIMIT_S
    if not _is_within("dt_s", dt_s, low, high):
        raise ValueError(
            f"dt_s, the time since the previous sample, must lie within {low:g} .. {high:g} s, got {dt_s!r}. Give it in "
            "seconds, not in hours or milliseconds. After a longer gap, start anew with a full cell."
        )


def _is_within(name: str, value: float, low: float, high: float) -> bool:
    try:
        return low <= value <= high
    except TypeError as error:
        raise TypeError(f"{name} must be a number, got {value!r}. {_MISSING.get(name, '')}".strip()) from error


def check_drawn_charge(charge_C: float, least_C: float = 0.0) -> None:
    """Refuse a current of the wrong sign."""
    if not charge_C > least_C:
        raise ValueError(
            f"current_A is positive in discharge, but this record draws {charge_C:.6g} C in total: flip the sign of the "
            "current (discharge_is_negative; command line: --discharge-is-negative or --discharge-is-positive)."
        )


def least_load_A(current_A: FloatArray) -> float:
    """
    The least current that counts as a load. It is above ``REST_CURRENT_A`` and ``LEAST_LOAD_SHARE`` of the largest current,
    and never above the size of a switch.
    """
    most_A = float(np.abs(current_A).max())
    return min(max(REST_CURRENT_A, LEAST_LOAD_SHARE * most_A), SWITCH_SHARE * most_A)


def switch_times_s(time_s: FloatArray, load: FloatArray, before: IntArray) -> FloatArray:
    """
    When a load was switched between two samples: midway. A rest is often logged more seldom than a load, so next to a rest
    the switch is at most one interval of the samples under load away from these.
    """
    middle_s = 0.5 * (time_s[before] + time_s[before + 1])
    size = np.abs(load)
    # of the samples at the ends no further interval is known
    interval_s = np.concatenate([[np.inf], np.diff(time_s), [np.inf]])
    at_rest = np.minimum(size[before], size[before + 1]) <= SWITCH_SHARE * size.max()
    nearest_s = np.where(
        size[before + 1] > size[before],
        np.maximum(middle_s, time_s[before + 1] - interval_s[before + 2]),
        np.minimum(middle_s, time_s[before] + interval_s[before]),
    )
    return np.where(at_rest, nearest_s, middle_s)


def _knots(time_s: FloatArray, load: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The load as a piecewise-linear function of time, whose jumps are two knots at one time."""
    switches = np.flatnonzero(np.abs(np.diff(load)) > SWITCH_SHARE * np.abs(load).max())
    place = np.repeat(switches + 1, 2)
    sides = np.column_stack([load[switches], load[switches + 1]]).ravel()
    return np.insert(time_s, place, np.repeat(switch_times_s(time_s, load, switches), 2)), np.insert(load, place, sides)


def drawn(time_s: FloatArray, load: FloatArray, at_s: ArrayLike) -> FloatArray:
    """
    Charge of a current, or energy of a power, drawn since the first sample. The load is linear between samples,
    except where it was switched (see ``SWITCH_SHARE``): there it jumps, as :func:`switch_times_s` has it. Beyond the last
    sample it keeps its last value.
    """
    t, i = _knots(time_s, load)
    width = np.diff(t)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (i[1:] + i[:-1]) * width)])
    slope = np.append(np.divide(np.diff(i), width, out=np.zeros_like(width), where=width > 0.0), 0.0)
    n = np.searchsorted(t, at_s, side="right") - 1
    since = np.asarray(at_s) - t[n]
    return total[n] + since * (i[n] + 0.5 * slope[n] * since)


def drawn_charge_C(record: Record) -> float:
    """The charge drawn from the first sample to the last."""
    return float(drawn(record.time_s, record.current_A, record.time_s[-1]))


def mean_current_A(record: Record) -> float:
    """The charge drawn over the time from the first sample to the last."""
    return drawn_charge_C(record) / float(np.ptp(record.time_s))


def resample_current(time_s: FloatArray, current_A: FloatArray, dt_s: float, n_steps: int) -> FloatArray:
    """
    The current on the model's time grid, which starts at the first sample: its mean over each step, so that the charge
    drawn is kept exactly. A record whose samples lie ``dt_s`` apart, as simulated ones do, is taken as it is: there
    ``current_A[k]`` is the current over the step that starts at sample k.
    """
    if np.allclose(np.diff(time_s), dt_s, rtol=1e-6, atol=0.0):
        return current_A[np.minimum(np.arange(n_steps), len(current_A) - 1)]
    grid_s = time_s[0] + dt_s * np.arange(n_steps + 1)
    return np.diff(drawn(time_s, current_A, grid_s)) / dt_s


class Stream(NamedTuple):
    """
    A record as it comes in live, arrays of shape (T,).

    :param time_s: s
    :param voltage_V: V
    :param current_A: mean current from each sample to the next, A
    :param dt_s: time since the previous sample, s; 0 for the first one
    :param temperature_C: of the cell, degC; ``None``: not measured
    """

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    dt_s: FloatArray
    temperature_C: FloatArray | None = None

    @classmethod
    def of(cls, record: Record, dt_s: float) -> Stream:
        """
        Check a record and convert it. Between samples the current is linear, as
        :func:`drawn` has it, so that the charge drawn is kept exactly.
        """
        time_s, voltage_V, current_A = check_record(record)
        step_s = np.diff(time_s)
        if not np.allclose(step_s, dt_s, rtol=1e-6, atol=0.0):
            mean_A = np.diff(drawn(time_s, current_A, time_s)) / step_s
            current_A = np.append(mean_A, current_A[-1])
        temperature_C = getattr(record, "temperature_C", None)
        if temperature_C is not None:
            temperature_C = check_column("temperature_C", temperature_C, len(time_s))
        return cls(time_s, voltage_V, current_A, np.append(0.0, step_s), temperature_C)

    def samples(self) -> zip[tuple[float, float, float]]:
        """What :meth:`battery_env.estimators.OnlineEstimator.update` takes, sample by sample."""
        return zip(self.voltage_V.tolist(), self.current_A.tolist(), self.dt_s.tolist(), strict=True)


class ExpectedCurrent(NamedTuple):
    """The current to expect after the end of a record, A."""

    mean_A: float  # 0 if the load was switched off and not on again
    varied: bool  # whether the load did, so that the mean is that of its last half, and an assumption
    sd_A: float  # how far means over quarters of the record lie from each other


def expected_current(time_s: ArrayLike, current_A: ArrayLike) -> ExpectedCurrent:
    """
    The current to expect after the end of a record: the last one of a constant load, and the mean over the last half of a load
    that varied by more than ``VARIED_SHARE``, pulses among them.
    """
    time, current = np.asarray(time_s, dtype=np.float64), np.asarray(current_A, dtype=np.float64)
    loaded = current > SWITCH_SHARE * np.abs(current).max()
    switches = np.flatnonzero(np.diff(loaded.astype(np.int64)) > 0)
    if not loaded.any() or not (loaded[-1] or len(switches) + loaded[0] > 1):
        return ExpectedCurrent(0.0, False, 0.0)
    first = int(np.flatnonzero(loaded)[0])
    low, high = np.quantile(current[first:], [0.05, 0.95])
    if first == len(time) - 1 or high - low <= VARIED_SHARE * high:
        return ExpectedCurrent(float(current[-1]), False, 0.0)
    ends_s = np.linspace(time[first], time[-1], 5)
    quarters_A = np.diff(drawn(time, current, ends_s)) / np.diff(ends_s)
    return ExpectedCurrent(max(float(quarters_A[2:].mean()), 0.0), True, float(quarters_A.std(ddof=1)))
