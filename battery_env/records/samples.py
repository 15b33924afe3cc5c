"""A record: time, voltage and current as measured during one discharge; its checks, and its samples as a live stream."""

from __future__ import annotations

from math import isfinite, isnan
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray
from battery_env.checks import LOAD_LIMITS, check_real
from battery_env.records.load import REST_CURRENT_A, integrate_load
from battery_env.records.refusals import Advice, RecordError

#: Least and greatest time between two samples of a stream, s. They catch most times in milliseconds or in hours.
SAMPLE_INTERVAL_LIMITS_S = (1e-3, 600.0)
#: Greatest time to the next sample at rest, s.
REST_LIMIT_S = 604_800.0
#: Default cut-off of recorded cells, V.
CUT_OFF_V = 2.7

#: Advice on a current that is out of range.
MILLIAMPERE = Advice("Give the current in A, not in mA", "units", {"current": "mA"}, "current")
# Advice on a value that is missing in a stream
_MISSING_ADVICE = {
    "voltage_V": "A voltage may be missing (NaN), but for the first one, which tells whether the cell is full.",
    "current_A": "The charge that was drawn cannot do without it: give the mean current since it was last known.",
    "temperature_C": "Leave it out (None) where it is missing.",
}
#: Advice on a current of the wrong sign.
SIGNS = (
    Advice("State that the file counts a discharge as negative", "discharge_is_negative", True, "is negative"),
    Advice("State that the file counts a discharge as positive", "discharge_is_negative", False, "is positive"),
)
#: Least and largest plausible value, and unit, by name.
PLAUSIBLE: dict[str, tuple[float, float, str]] = {
    "voltage_V": (-0.1, 5.5, "V"),  # half cells are driven a little below 0
    "current_A": (-LOAD_LIMITS["current"], LOAD_LIMITS["current"], "A"),
    "temperature_C": (-60.0, 150.0, "degC"),
}
# Advice on a value beyond these limits.
_ADVICE_BEYOND = {
    "voltage_V": (
        Advice("Give the voltage of one cell, not that of a pack"),
        Advice("Give the voltage in V, not in mV", "units", {"voltage": "mV"}, "voltage"),
    ),
    "current_A": (MILLIAMPERE,),
    "temperature_C": (
        Advice("Give the temperature in degrees Celsius, not in kelvin", "units", {"temperature": "K"}, "temperature"),
    ),
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
    """Samples of a record, a :class:`Record` too: s, V, and A, positive in discharge; arrays of shape (T,)."""

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray

    @classmethod
    def of(cls, record: Record) -> Samples:
        """Return the samples of any record."""
        return cls(*(np.asarray(column) for column in (record.time_s, record.voltage_V, record.current_A)))

    def first(self, count: int) -> Samples:
        """Return the first samples."""
        return Samples(*(column[:count] for column in self))


def check_column(name: str, values: ArrayLike, least_samples: int) -> FloatArray:
    """Refuse an invalid column of a record."""
    if values is None or np.ma.is_masked(values):
        raise TypeError(f"{name} must hold real numbers, none of them masked, got {type(values).__name__}")
    check_real(name, values)
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
    invalid = np.flatnonzero(~np.isfinite(array))
    if len(invalid):
        raise ValueError(
            f"{name} must be finite, got {array[invalid[0]]} at sample {invalid[0]}. Remove or fill such samples."
        )
    if name in PLAUSIBLE:
        low, high, _ = PLAUSIBLE[name]
        invalid = np.flatnonzero((array < low) | (array > high))
        if len(invalid):
            raise _implausible(name, float(array[invalid[0]]), f" at sample {invalid[0]}")
    array.setflags(write=False)
    return array


def _implausible(name: str, value: float, where: str = "") -> RecordError:
    low, high, unit = PLAUSIBLE[name]
    # a value that is too low has no other unit: it may be a negative voltage of a half cell
    advice = _ADVICE_BEYOND[name] if value > high or low == -high else ()
    return RecordError(f"{name} must lie within {low:g} .. {high:g} {unit}, got {value:g}{where}", advice)


def check_record(record: Record, least_samples: int = 1) -> Samples:
    """Refuse an invalid record; a discharge, which was checked on construction, is not checked again."""
    if getattr(record, "is_checked", False) and len(record.time_s) >= least_samples:
        return Samples.of(record)
    return check_samples(record.time_s, record.voltage_V, record.current_A, least_samples)


def check_samples(time_s: ArrayLike, voltage_V: ArrayLike, current_A: ArrayLike, least_samples: int = 1) -> Samples:
    """Refuse invalid columns of a record."""
    arrays = {
        name: check_column(name, values, least_samples)
        for name, values in (("time_s", time_s), ("voltage_V", voltage_V), ("current_A", current_A))
    }
    # smaller currents vanish in the rounding of the largest current that a record may hold
    largest_A, least_A = float(np.abs(arrays["current_A"]).max(initial=0.0)), LOAD_LIMITS["current"] * np.finfo(np.float64).eps
    if 0.0 < largest_A < least_A:
        raise ValueError(f"current_A must reach {least_A:.1g} A, got {largest_A:g} A at most: no sensor reads so little")
    time = arrays["time_s"]
    for name, array in arrays.items():
        if len(array) != len(time):
            raise ValueError(f"{name} has {len(array)} samples, but time_s has {len(time)}")
    stalled_rows = np.flatnonzero(np.diff(time) <= 0.0)
    if len(stalled_rows):
        n = stalled_rows[0] + 1
        if time[n] == time[n - 1]:
            advice = "Give each sample once, with a clock that tells it from the next, or name the column of its step"
        else:
            advice = (
                "Sort the samples, and give one discharge at a time, or number them in a column of the cycle. A clock that "
                "starts anew, at midnight or with each step, needs dates"
            )
        raise RecordError(
            f"time_s must increase from sample to sample, but sample {n} is at {time[n]:g} s, after {time[n - 1]:g} s",
            [Advice(advice)],
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
        low, high, _ = PLAUSIBLE[name]
        if _is_within(name, value, low, high) or (name == "voltage_V" and previous_A is not None and isnan(value)):
            continue
        if isfinite(value):
            raise _implausible(name, value)
        raise ValueError(f"{name} must be finite, got {value!r}. {_MISSING_ADVICE[name]}")
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
        if isinstance(value, bool | np.bool_):
            raise TypeError("a truth value")
        return low <= value <= high
    except TypeError as error:
        raise TypeError(f"{name} must be a number, got {value!r}. {_MISSING_ADVICE.get(name, '')}".strip()) from error


def check_drawn_charge(charge_C: float, least_C: float = 0.0) -> None:
    """Refuse a current of the wrong sign."""
    if not charge_C > least_C:
        raise RecordError(
            f"current_A is positive in discharge, but this record draws {charge_C:.6g} C in total: flip the sign of it",
            SIGNS,
        )


def check_cut_off(cut_off_V: float) -> float:
    """Refuse a cut-off that is no voltage of one cell."""
    highest_V = PLAUSIBLE["voltage_V"][1]
    if not 0.0 < cut_off_V <= highest_V:
        is_in_mV = 0.0 < 1e-3 * cut_off_V <= highest_V
        advice = [Advice("Give the cut-off in V, not in mV", "cut_off_V", 1e-3 * cut_off_V)] if is_in_mV else []
        raise RecordError(
            f"the cut-off must be a voltage of one cell, above 0 and up to {highest_V:g} V, got {cut_off_V:g}", advice
        )
    return cut_off_V


def drawn_charge_C(record: Record) -> float:
    """Return the charge drawn from the first sample to the last."""
    return float(integrate_load(record.time_s, record.current_A, record.time_s[-1]))


def mean_current_A(record: Record) -> float:
    """Return the mean current from the first sample to the last."""
    return drawn_charge_C(record) / float(np.ptp(record.time_s))


class Stream(NamedTuple):
    """
    A record as a live stream, arrays of shape (T,).

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
        Check a record and convert it; the mean currents keep the charge of :func:`integrate_load` exactly.
        """
        time_s, voltage_V, current_A = check_record(record)
        step_s = np.diff(time_s)
        if not np.allclose(step_s, dt_s, rtol=1e-6, atol=0.0):
            mean_A = np.diff(integrate_load(time_s, current_A, time_s)) / step_s
            current_A = np.append(mean_A, current_A[-1])
        temperature_C = getattr(record, "temperature_C", None)
        if temperature_C is not None:
            temperature_C = check_column("temperature_C", temperature_C, len(time_s))
        return cls(time_s, voltage_V, current_A, np.append(0.0, step_s), temperature_C)

    def samples(self) -> zip[tuple[float, float, float]]:
        """Return the arguments of :meth:`battery_env.estimators.OnlineEstimator.update`, sample by sample."""

        return zip(self.voltage_V.tolist(), self.current_A.tolist(), self.dt_s.tolist(), strict=True)
