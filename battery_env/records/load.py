"""The load of a record: the samples under load, its begin and end, its switches, and the charge that it draws."""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.compiled import compiled

#: A cell is under load where its current is above this share of the largest one.
LOAD_SHARE = 0.1
#: A change of the current between two samples by more than this share of its largest magnitude is a switch of the load,
#: not a drift; the current is taken to jump between the two samples (:func:`switch_times_s`).
SWITCH_SHARE = 0.1
#: A load whose current spreads by more than this share (from the 5th to the 95th percentile) has varied.
VARIED_SHARE = 0.05
#: A cell with a smaller current rests, A.
REST_CURRENT_A = 0.02
#: The voltage is steady after this time under a steady current, or at rest, s.
STEADY_S = 60.0
#: Currents below this share of the largest current count as noise or sensor offset.
LEAST_LOAD_SHARE = 0.03
# Currents before or after the main load that draw no more than this share of the charge are noise, or an offset.
_NEGLIGIBLE_SHARE = 5e-3
# At intervals up to this, s, the moment of a switch is exact: it is that of the second sample.
_DENSE_INTERVAL_S = 1.1


class LoadSpan(NamedTuple):
    """The first and the last sample under load."""

    first: int
    last: int

    @property
    def rows(self) -> slice:
        """All samples from the first to the last."""
        return slice(self.first, self.last + 1)


def is_load(current_A: FloatArray) -> BoolArray:
    """Return which samples are under load: none, if no current is positive."""
    return np.asarray(current_A > LOAD_SHARE * np.max(current_A, initial=0.0))


def load_span(time_s: FloatArray, current_A: FloatArray) -> LoadSpan:
    """
    Return the span of the load of a record. Small loads before or after the large loads belong to it if they draw more than
    ``_NEGLIGIBLE_SHARE`` of its charge; smaller currents are noise, or an offset.
    """
    loaded = np.flatnonzero(is_load(current_A))
    if not len(loaded):
        raise ValueError("no current flows in this record, which says nothing about its load. Give the load.")
    first, last = int(loaded[0]), int(loaded[-1])
    largest_A = float(current_A.max())
    threshold_A = min(max(REST_CURRENT_A, LEAST_LOAD_SHARE * largest_A), LOAD_SHARE * largest_A)
    load_A = np.where(current_A > threshold_A, current_A, 0.0)
    drawn_C = integrate_load(time_s, load_A, time_s)
    negligible_C, load_rows = _NEGLIGIBLE_SHARE * drawn_C[-1], np.flatnonzero(load_A)
    if drawn_C[max(first - 1, 0)] > negligible_C:
        first = int(load_rows[0])
    if drawn_C[-1] - drawn_C[min(last + 1, len(drawn_C) - 1)] > negligible_C:
        last = int(load_rows[-1])
    return LoadSpan(first, last)


def switches(load: FloatArray) -> IntArray:
    """Return the samples after which a load, a current or a power, is switched."""
    return np.flatnonzero(np.abs(np.diff(load)) > SWITCH_SHARE * np.abs(load).max())


def switch_times_s(time_s: FloatArray, load: FloatArray, rows: IntArray) -> FloatArray:
    """
    Return when a load was switched between two samples: midway. Testers often log a rest more seldom than a load, so next to a
    rest the switch is at most one interval of the samples under load away from these.
    """
    middle_s = 0.5 * (time_s[rows] + time_s[rows + 1])
    size = np.abs(load)
    # the samples at the ends have no further interval
    interval_s = np.concatenate([[np.inf], np.diff(time_s), [np.inf]])
    is_beside_rest = np.minimum(size[rows], size[rows + 1]) <= LOAD_SHARE * size.max()
    nearest_s = np.where(
        size[rows + 1] > size[rows],
        np.maximum(middle_s, time_s[rows + 1] - interval_s[rows + 2]),
        np.minimum(middle_s, time_s[rows] + interval_s[rows]),
    )
    return np.where(is_beside_rest, nearest_s, middle_s)


def _knots(time_s: FloatArray, load: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The load as a piecewise-linear function of time, whose jumps are two knots at one time."""
    rows = switches(load)
    insertions = np.repeat(rows + 1, 2)
    sides = np.column_stack([load[rows], load[rows + 1]]).ravel()
    return np.insert(time_s, insertions, np.repeat(switch_times_s(time_s, load, rows), 2)), np.insert(load, insertions, sides)


def integrate_load(time_s: FloatArray, load: FloatArray, at_s: ArrayLike) -> FloatArray:
    """
    Integrate a load from the first sample: the charge of a current, or the energy of a power. The load is linear between
    samples, and jumps at its switches (:func:`switch_times_s`). Beyond the last sample the load keeps its last value.
    """
    t, i = _knots(time_s, load)
    interval_s = np.diff(t)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (i[1:] + i[:-1]) * interval_s)])
    slope = np.append(np.divide(np.diff(i), interval_s, out=np.zeros_like(interval_s), where=interval_s > 0.0), 0.0)
    n = np.searchsorted(t, at_s, side="right") - 1
    elapsed_s = np.asarray(at_s) - t[n]
    return total[n] + elapsed_s * (i[n] + 0.5 * slope[n] * elapsed_s)


def resample_current(time_s: FloatArray, current_A: FloatArray, dt_s: float, n_steps: int) -> FloatArray:
    """
    Return the mean current over each step of the model's time grid, which starts at the first sample; the means keep the
    charge drawn exactly. Samples ``dt_s`` apart, as in a simulated record, stay as they are: there ``current_A[k]`` is the
    current over the step that starts at sample k.
    """
    if np.allclose(np.diff(time_s), dt_s, rtol=1e-6, atol=0.0):
        return current_A[np.minimum(np.arange(n_steps), len(current_A) - 1)]
    grid_s = time_s[0] + dt_s * np.arange(n_steps + 1)
    return np.diff(integrate_load(time_s, current_A, grid_s)) / dt_s


def load_range_A(current_A: FloatArray) -> tuple[float, float]:
    """Return the range of a load without its few extremes: the 5 % and the 95 % quantile of the current."""
    low_A, high_A = np.quantile(current_A, [0.05, 0.95]).tolist()
    return low_A, high_A


class ExpectedCurrent(NamedTuple):
    """The current to expect after the end of a record, A."""

    mean_A: float  # 0 if the load was switched off and not on again
    is_varying: bool  # whether the load varied, so that the mean is over its last half, and an assumption
    sd_A: float  # standard deviation between the means over quarters of the record


def expected_current(time_s: ArrayLike, current_A: ArrayLike) -> ExpectedCurrent:
    """
    Return the current to expect after the end of a record: the last current of a constant load, and the mean over the last
    half of a load that varied by more than ``VARIED_SHARE``, such as pulses.
    """
    time, current = np.asarray(time_s, dtype=np.float64), np.asarray(current_A, dtype=np.float64)
    loaded = is_load(current)
    load_count = np.count_nonzero(np.diff(loaded.astype(np.int64)) > 0) + loaded[0]
    if not loaded.any() or not (loaded[-1] or load_count > 1):
        return ExpectedCurrent(0.0, False, 0.0)
    first = int(loaded.argmax())
    low_A, high_A = load_range_A(current[first:])
    if first == len(time) - 1 or high_A - low_A <= VARIED_SHARE * high_A:
        return ExpectedCurrent(float(current[-1]), False, 0.0)
    ends_s = np.linspace(time[first], time[-1], 5)
    quarters_A = np.diff(integrate_load(time, current, ends_s)) / np.diff(ends_s)
    return ExpectedCurrent(max(float(quarters_A[2:].mean()), 0.0), True, float(quarters_A.std(ddof=1)))


def load_on_sd_C(time_s: FloatArray, current_A: FloatArray, first: int, load_on_s: float) -> float:
    """
    Return the standard deviation of the charge by the moment of load-on before sample ``first``. The moment is uniform between
    the two samples if samples are missing there (the interval is more than twice its neighbours), and otherwise uniform around
    ``load_on_s``.
    """
    if not first:
        return 0.0
    previous_s, first_s = time_s[first - 1], time_s[first]
    neighbours_s = np.append(np.diff(time_s[max(first - 2, 0) : first]), np.diff(time_s[first : first + 2]))
    is_missing = first_s - previous_s > 2.0 * neighbours_s.max(initial=0.0)
    earliest_s = previous_s if is_missing else max(previous_s, 2.0 * load_on_s - first_s)
    late_s, early_s = first_s - load_on_s, load_on_s - earliest_s
    return float(np.sqrt((late_s**3 + early_s**3) / (3.0 * (late_s + early_s))) * (current_A[first] - current_A[first - 1]))


def rest_current_A(current_A: FloatArray) -> float | None:
    """
    Return the current at rest, A: the common part of the currents before and after the large loads, because a small load, or
    the end of a charge, is only on one side. Without a rest after the load it is the current before; ``None``: no rest.
    """
    loaded = np.flatnonzero(is_load(current_A))
    # a charge before or after the load is no rest
    largest_A = current_A.max() - min(current_A.min(), 0.0)
    rest_before, rest_after = (
        side_A[np.abs(side_A) <= LOAD_SHARE * largest_A] for side_A in (current_A[: loaded[0]], current_A[loaded[-1] + 1 :])
    )
    first_A, last_A = (float(np.median(side_A)) if len(side_A) else 0.0 for side_A in (rest_before, rest_after))
    if not len(rest_after):
        return first_A if len(rest_before) else None
    return min(first_A, last_A, key=abs) if first_A * last_A > 0.0 else 0.0


class SwitchedCharge(NamedTuple):
    """The standard deviation of a charge by the unknown moments of its switches."""

    sd_C: float
    independent_sd_C: float  # if the errors of the switches were independent
    switches: int


def switch_time_sd_s(interval_s: FloatArray) -> FloatArray:
    """Return the standard deviation of the moment of a switch between two samples."""
    return np.where(interval_s > _DENSE_INTERVAL_S, interval_s / sqrt(12.0), 0.0)


def switched_charge(time_s: FloatArray, current_A: FloatArray) -> SwitchedCharge:
    """
    Return the uncertainty of the charge of a record by the moments of its switches. Samples may meet a load that is switched
    repeatedly in the same way at the same place each time. Therefore the errors of equal switches add up.
    """
    changed_A, largest_A = np.diff(current_A), np.maximum.accumulate(np.abs(current_A))[1:]
    size_C = changed_A * switch_time_sd_s(np.diff(time_s))
    is_switch = (size_C != 0.0) & (np.abs(changed_A) > SWITCH_SHARE * largest_A)
    variance_C2 = 0.0
    for has_sign in (changed_A > 0.0, changed_A < 0.0):
        same_sign = np.flatnonzero(is_switch & has_sign)
        switched_A = changed_A[same_sign]
        is_other = np.abs(np.diff(switched_A, prepend=switched_A[:1])) > SWITCH_SHARE * np.abs(switched_A)
        sum_C = np.bincount(np.cumsum(is_other), weights=size_C[same_sign])
        variance_C2 += float((sum_C**2).sum())
    switch_C = size_C[is_switch]
    return SwitchedCharge(sqrt(variance_C2), sqrt(float((switch_C**2).sum())), len(switch_C))


@compiled
def lagged_current_A(time_s: FloatArray, current_A: FloatArray, time_constant_s: float) -> FloatArray:
    """Return the current of an ohmic drop: first-order lag of the current with a time constant, from rest."""
    lagged_A = np.zeros_like(current_A)
    for k in range(1, len(current_A)):
        decay = exp(-(time_s[k] - time_s[k - 1]) / time_constant_s)
        lagged_A[k] = current_A[k - 1] + decay * (lagged_A[k - 1] - current_A[k - 1])
    return lagged_A
