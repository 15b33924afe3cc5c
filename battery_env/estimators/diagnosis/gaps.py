"""Stretches of a load that were not logged: whether the voltage says that their charge was drawn."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import expm1, inf, isnan

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.estimators.diagnosis.faults import MeasuredSamples
from battery_env.records import REST_CURRENT_A, STEADY_S, SWITCH_SHARE, Samples

# An interval between two samples is a gap where it is so many times longer than the one before, and what its load draws in
# the time that is longer is above this share of ``q_mobile``. Loggers that write a row on a change of voltage have intervals
# of all lengths: it is no gap if so many others under load were 1 / _RATIO as long at least, and in no doubt.
_RATIO, _LEAST_SHARE, _HABIT = 2.5, 0.005, 3
# Where the charge of a gap was drawn, cell and model part across it by less than this share of the fall of the model.
_MOST_SHARE = 0.5
# The error of the model is smoothed over about so many samples before a gap, twice, which tells its trend, and the rate at
# which the voltage falls over so long, s; after it the median of three voltages counts.
_ERROR_MEMORY, _RATE_MEMORY_S, _SAMPLES_AFTER = 4.0, 100.0, 3
# With so much of what is no more than noise to spare: one and a half standard deviations of the difference.
_MARGIN_SHARE = 0.25


@dataclass
class _Gap:
    """
    A gap whose charge may not have been drawn.

    :param row: the first sample after it
    :param length_s: how long it is
    :param charge_C: what its load draws in the time that is longer than the interval before
    :param fall_V: the fall of the model within it; 0: unknown
    :param model_V: voltage of the model after it
    :param after_V: the voltages after it
    """

    row: int
    length_s: float
    charge_C: float
    fall_V: float
    model_V: float
    after_V: list[float]


@dataclass
class Gaps:
    """
    The gaps of a record.

    :param doubt_C: the charge of those in doubt
    :param span_s: where the last one lies, in the time since the first sample
    """

    doubt_C: float = 0.0
    span_s: tuple[float, float] = (0.0, 0.0)
    _longest_doubt_s: float = 0.0
    # the longest intervals under load that are in no doubt, in their order
    _longest_s: list[float] = field(default_factory=lambda: [0.0] * _HABIT)

    def note_doubt(self, gap: _Gap) -> None:
        """Leave the charge of a gap in doubt."""
        self.doubt_C += gap.charge_C
        self._longest_doubt_s = max(self._longest_doubt_s, gap.length_s)

    def note_interval(self, interval_s: float, load_A: float) -> None:
        """Take in one that is no gap, or whose charge was drawn: others as long are the habit of the logger, too."""
        if interval_s > self._longest_s[0] and load_A > REST_CURRENT_A:
            self._longest_s = sorted([*self._longest_s[1:], interval_s])
            if self._longest_doubt_s <= _RATIO * self.usual_s:
                self.doubt_C = self._longest_doubt_s = 0.0

    @property
    def usual_s(self) -> float:
        """An interval so long is the habit of the logger."""
        return self._longest_s[0]


class _Expected:
    """The voltage to expect after a gap: that of the model, with its error and its trend, or as the voltage fell before."""

    def __init__(self) -> None:
        self.model_V = self._error_V = self._smoothed_V = self.fall_V_per_s = 0.0

    def note(self, n: int, voltage_V: float, model_V: float, is_error_known: bool) -> None:
        """Take in a sample."""
        if is_error_known:
            share = 1.0 / min(n, _ERROR_MEMORY)
            self._error_V += share * (voltage_V - model_V - self._error_V)
            self._smoothed_V += share * (self._error_V - self._smoothed_V)
        self.model_V = model_V

    def note_fall(self, fall_V_per_s: float, interval_s: float) -> None:
        """Take in how fast the voltage falls."""
        self.fall_V_per_s += -expm1(-interval_s / _RATE_MEMORY_S) * (fall_V_per_s - self.fall_V_per_s)

    @property
    def voltage_V(self) -> float:
        """The voltage to expect next."""
        return self.model_V + 2.0 * self._error_V - self._smoothed_V


def gaps_of(record: Samples, model_V: FloatArray, q_mobile: float, samples: MeasuredSamples, load_on_s: float) -> Gaps:
    """
    The gaps of a record, and what of their charge the voltage leaves in doubt.

    :param record: all its samples
    :param model_V: voltage of the model at these, NaN where it is empty
    :param q_mobile: an estimate, C
    :param samples: those of which the voltage was measured
    :param load_on_s: when the rest before the load is over, in the time since the first sample
    """
    gaps, expected, gap = Gaps(), _Expected(), None
    time_s, interval_s = record.time_s - record.time_s[0], np.diff(record.time_s)
    size_A = np.abs(record.current_A)
    load_A, before_s = np.maximum(size_A[1:], size_A[:-1]), np.append(0.0, interval_s[:-1])
    charge_C = load_A * (interval_s - before_s)
    may_be_gap = (interval_s > _RATIO * before_s) & (load_A > REST_CURRENT_A) & (charge_C > _LEAST_SHARE * q_mobile)
    if not may_be_gap.any():
        return gaps
    measured = np.cumsum(np.isfinite(record.voltage_V)) - 1
    for n, voltage_V in enumerate(record.voltage_V[1:].tolist(), 1):
        is_measured, length_s = not isnan(voltage_V), float(interval_s[n - 1])
        if gap is not None and gap.row == n - 1 and gap.length_s <= _RATIO * length_s:
            gap = None  # the samples are as far apart from now on
        is_gap = bool(may_be_gap[n - 1]) and length_s > _RATIO * gaps.usual_s
        if is_gap:
            if gap is not None:
                gaps.note_doubt(gap)
            gap = _Gap(n, length_s, float(charge_C[n - 1]), 0.0, 0.0, [voltage_V])
            gaps.span_s = float(time_s[n - 1]), float(time_s[n])
            gap.fall_V = _fall_V(record, n, expected, float(model_V[n]), samples, int(measured[n - 1]), load_on_s)
            gap.model_V = expected.voltage_V - gap.fall_V
        else:
            gaps.note_interval(length_s, float(min(size_A[n - 1], size_A[n])))
            if gap is not None and is_measured:
                gap.after_V.append(voltage_V)
                if len(gap.after_V) < _SAMPLES_AFTER:
                    # by how much it falls from one sample to the next
                    gap.model_V -= gap.fall_V * float(time_s[n] - time_s[gap.row]) / gap.length_s
                else:
                    missing_V = float(np.median(gap.after_V)) - gap.model_V
                    is_drawn = missing_V + _MARGIN_SHARE * samples.noise_V(int(measured[n])) < _MOST_SHARE * gap.fall_V
                    if gap.fall_V > 0.0 and is_drawn:
                        gaps.note_interval(gap.length_s, float(load_A[n - 1]))
                    else:
                        gaps.note_doubt(gap)
                    gap = None
        if is_measured:
            expected.note(n, voltage_V, float(model_V[n]), gap is None)
            if not is_gap and n > 1:
                expected.note_fall((float(samples.voltage_V[measured[n - 1]]) - voltage_V) / length_s, length_s)
    if gap is not None:
        gaps.note_doubt(gap)
    return gaps


def _fall_V(
    record: Samples, n: int, expected: _Expected, model_V: float, samples: MeasuredSamples, before: int, load_on_s: float
) -> float:
    """The fall of the model across a gap; 0 where it tells nothing."""
    interval_s, load_A = float(record.time_s[n] - record.time_s[n - 1]), np.abs(record.current_A[n - 1 : n + 1]).max()
    jump_s = float(samples.jump_s[before])
    steady_s = float(record.time_s[n - 1] - record.time_s[0]) - jump_s
    # a load that was switched just before may have been switched again
    is_switched = steady_s < interval_s and jump_s > load_on_s
    is_other = abs(record.current_A[n] - record.current_A[n - 1]) > SWITCH_SHARE * load_A
    if isnan(record.voltage_V[n]) or is_switched or is_other:
        return 0.0
    # a model whose q_mobile is not known yet may take its cell for empty: the voltage falls at least as it did before
    least_V = expected.fall_V_per_s * interval_s if steady_s >= STEADY_S else inf
    return min(expected.model_V - model_V, least_V)
