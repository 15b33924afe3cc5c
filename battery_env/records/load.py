"""
The load of a record, found once: which samples are under it, where it begins and ends, when it is switched, and the charge
that it draws.
"""

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
#: A cell whose current is below this rests, A.
REST_CURRENT_A = 0.02
#: After so long under a steady current, or at rest, a voltage goes on as before, s.
STEADY_S = 60.0
#: Currents below this share of the largest are taken for noise or sensor offset.
LEAST_LOAD_SHARE = 0.03
# What draws no more than this share of the charge before or after the main load is noise, or an offset.
_LITTLE_SHARE = 5e-3
# Samples no farther apart than this, s, are taken as they are: the current of each lasts until the next.
_EXACT_S = 1.1


class LoadSpan(NamedTuple):
    """Where the load of a record begins and ends, in samples."""

    first: int  # the first one under load
    last: int  # the last one

    @property
    def rows(self) -> slice:
        """All samples from the first to the last."""
        return slice(self.first, self.last + 1)


def is_load(current_A: FloatArray) -> BoolArray:
    """Which samples are under load: none, where no current is positive."""
    return np.asarray(current_A > LOAD_SHARE * np.max(current_A, initial=0.0))


def load_span(time_s: FloatArray, current_A: FloatArray) -> LoadSpan:
    """
    Where the load of a record begins and ends. Small loads before the first or after the last large one belong to it if they
    draw more than ``_LITTLE_SHARE`` of its charge; all else there is noise, or an offset.
    """
    loaded = np.flatnonzero(is_load(current_A))
    if not len(loaded):
        raise ValueError("no current flows in this record, which says nothing about its load. Give the load.")
    first, last = int(loaded[0]), int(loaded[-1])
    most_A = float(current_A.max())
    least_A = min(max(REST_CURRENT_A, LEAST_LOAD_SHARE * most_A), LOAD_SHARE * most_A)
    small_A = np.where(current_A > least_A, current_A, 0.0)
    drawn_C = drawn(time_s, small_A, time_s)
    little_C, small = _LITTLE_SHARE * drawn_C[-1], np.flatnonzero(small_A)
    if drawn_C[max(first - 1, 0)] > little_C:
        first = int(small[0])
    if drawn_C[-1] - drawn_C[min(last + 1, len(drawn_C) - 1)] > little_C:
        last = int(small[-1])
    return LoadSpan(first, last)


def switches(load: FloatArray) -> IntArray:
    """The samples after which a load, a current or a power, is switched."""
    return np.flatnonzero(np.abs(np.diff(load)) > SWITCH_SHARE * np.abs(load).max())


def switch_times_s(time_s: FloatArray, load: FloatArray, before: IntArray) -> FloatArray:
    """
    When a load was switched between two samples: midway. A rest is often logged more seldom than a load, so next to a rest
    the switch is at most one interval of the samples under load away from these.
    """
    middle_s = 0.5 * (time_s[before] + time_s[before + 1])
    size = np.abs(load)
    # of the samples at the ends no further interval is known
    interval_s = np.concatenate([[np.inf], np.diff(time_s), [np.inf]])
    at_rest = np.minimum(size[before], size[before + 1]) <= LOAD_SHARE * size.max()
    nearest_s = np.where(
        size[before + 1] > size[before],
        np.maximum(middle_s, time_s[before + 1] - interval_s[before + 2]),
        np.minimum(middle_s, time_s[before] + interval_s[before]),
    )
    return np.where(at_rest, nearest_s, middle_s)


def _knots(time_s: FloatArray, load: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The load as a piecewise-linear function of time, whose jumps are two knots at one time."""
    before = switches(load)
    place = np.repeat(before + 1, 2)
    sides = np.column_stack([load[before], load[before + 1]]).ravel()
    return np.insert(time_s, place, np.repeat(switch_times_s(time_s, load, before), 2)), np.insert(load, place, sides)


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
    loaded = is_load(current)
    times_on = np.count_nonzero(np.diff(loaded.astype(np.int64)) > 0) + loaded[0]
    if not loaded.any() or not (loaded[-1] or times_on > 1):
        return ExpectedCurrent(0.0, False, 0.0)
    first = int(loaded.argmax())
    low, high = np.quantile(current[first:], [0.05, 0.95])
    if first == len(time) - 1 or high - low <= VARIED_SHARE * high:
        return ExpectedCurrent(float(current[-1]), False, 0.0)
    ends_s = np.linspace(time[first], time[-1], 5)
    quarters_A = np.diff(drawn(time, current, ends_s)) / np.diff(ends_s)
    return ExpectedCurrent(max(float(quarters_A[2:].mean()), 0.0), True, float(quarters_A.std(ddof=1)))


def load_on_sd_C(time_s: FloatArray, current_A: FloatArray, first: int, load_on_s: float) -> float:
    """
    The standard deviation of the charge by the moment at which a load came on before its sample ``first``: at any time between
    the two samples where some are missing, that is where they lie more than twice as far apart as those before and after, and
    else as much earlier as later than at ``load_on_s``.
    """
    if not first:
        return 0.0
    before_s, after_s = time_s[first - 1], time_s[first]
    neighbours_s = np.append(np.diff(time_s[max(first - 2, 0) : first]), np.diff(time_s[first : first + 2]))
    is_missing = after_s - before_s > 2.0 * neighbours_s.max(initial=0.0)
    earliest_s = before_s if is_missing else max(before_s, 2.0 * load_on_s - after_s)
    late_s, early_s = after_s - load_on_s, load_on_s - earliest_s
    return float(np.sqrt((late_s**3 + early_s**3) / (3.0 * (late_s + early_s))) * (current_A[first] - current_A[first - 1]))


def rest_current_A(current_A: FloatArray) -> float | None:
    """
    What flows at rest, A: what the rests before and after the large loads have in common, as a small load, or the end of a
    charge, is only before it or after. Where only the one before is recorded, what flows in it; ``None``: no rest is.
    """
    loaded = np.flatnonzero(is_load(current_A))
    # what is no load, before it or after, is a rest, unless a charge
    largest_A = current_A.max() - min(current_A.min(), 0.0)
    before, after = (
        part[np.abs(part) <= LOAD_SHARE * largest_A] for part in (current_A[: loaded[0]], current_A[loaded[-1] + 1 :])
    )
    before_A, after_A = (float(np.median(rest)) if len(rest) else 0.0 for rest in (before, after))
    if not len(after):
        return before_A if len(before) else None
    return min(before_A, after_A, key=abs) if before_A * after_A > 0.0 else 0.0


class SwitchedCharge(NamedTuple):
    """What the unknown moments of switches between two samples make of a charge."""

    sd_C: float
    independent_sd_C: float  # if the error of each switch were independent of the others'
    switches: int


def moment_sd_s(interval_s: FloatArray) -> FloatArray:
    """The standard deviation of the moment of a switch between two samples; of near ones it is that of the second."""
    return np.where(interval_s > _EXACT_S, interval_s / sqrt(12.0), 0.0)


def switched_charge(time_s: FloatArray, current_A: FloatArray) -> SwitchedCharge:
    """
    How far the charge of a record is in doubt by the moments at which its load was switched. A load that is switched again and
    again the same way may be met by the samples at the same place each time: then these errors add up, and others cancel in
    part.
    """
    changed_A, largest_A = np.diff(current_A), np.maximum.accumulate(np.abs(current_A))[1:]
    size_C = changed_A * moment_sd_s(np.diff(time_s))
    is_switch = (size_C != 0.0) & (np.abs(changed_A) > SWITCH_SHARE * largest_A)
    variance_C2 = 0.0
    for is_alike in (changed_A > 0.0, changed_A < 0.0):
        alike = np.flatnonzero(is_switch & is_alike)
        switched_A = changed_A[alike]
        is_other = np.abs(np.diff(switched_A, prepend=switched_A[:1])) > SWITCH_SHARE * np.abs(switched_A)
        together_C = np.bincount(np.cumsum(is_other), weights=size_C[alike])
        variance_C2 += float((together_C**2).sum())
    single_C = size_C[is_switch]
    return SwitchedCharge(sqrt(variance_C2), sqrt(float((single_C**2).sum())), len(single_C))


@compiled
def followed_current_A(time_s: FloatArray, current_A: FloatArray, follows_s: float) -> FloatArray:
    """The current that an ohmic drop stands for, which follows with a time constant after a first sample at rest."""
    followed_A = np.zeros_like(current_A)
    for k in range(1, len(current_A)):
        left = exp(-(time_s[k] - time_s[k - 1]) / follows_s)
        followed_A[k] = current_A[k - 1] + left * (followed_A[k - 1] - current_A[k - 1])
    return followed_A
