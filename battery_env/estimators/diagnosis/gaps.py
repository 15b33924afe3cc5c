"""Gaps in the log of a load, and whether the voltage shows that their charge was drawn."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import expm1, inf, isnan

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.estimators.diagnosis.faults import MeasuredSamples
from battery_env.records import REST_CURRENT_A, STEADY_S, SWITCH_SHARE, Samples

# An interval is a gap if it is _RATIO times longer than the previous interval, and its load draws more than this share of
# ``q_mobile`` in the excess time. Loggers that write a row on a change of voltage have intervals of all lengths: then it is no
# gap if _USUAL_COUNT other intervals under load, in no doubt, were at least 1 / _RATIO as long.
_RATIO, _LEAST_SHARE, _USUAL_COUNT = 2.5, 0.005, 3
# If the charge of a gap was drawn, the model error changes across it by less than this share of the fall of the model.
_DRAWN_SHARE = 0.5
# Double exponential smoothing of the model error, in samples: level and trend before the gap. Time constant of the rate at
# which the voltage falls, s. Number of voltages after the gap, whose median counts.
_ERROR_SAMPLES, _RATE_TIME_CONSTANT_S, _SAMPLES_AFTER = 4.0, 100.0, 3
# Margin, as a share of the largest change that may be noise: 1.5 standard deviations of the difference.
_MARGIN_SHARE = 0.25


@dataclass
class _Gap:
    """
    A gap whose charge may not have been drawn.

    :param row: the first sample after the gap
    :param length_s: its length
    :param charge_C: charge of its load in the time beyond the previous interval
    :param fall_V: fall of the model within the gap; 0: unknown
    :param model_V: voltage of the model after the gap
    :param later_V: the voltages after the gap
    """

    row: int
    length_s: float
    charge_C: float
    fall_V: float
    model_V: float
    later_V: list[float]


@dataclass
class Gaps:
    """
    The gaps of a record.

    :param doubt_C: the charge of the gaps in doubt
    :param span_s: begin and end of the last gap since the first sample
    """

    doubt_C: float = 0.0
    span_s: tuple[float, float] = (0.0, 0.0)
    _longest_doubt_s: float = 0.0
    # the longest intervals under load that are in no doubt, in their order
    _longest_s: list[float] = field(default_factory=lambda: [0.0] * _USUAL_COUNT)

    def add_doubt(self, gap: _Gap) -> None:
        """Add a gap in doubt."""
        self.doubt_C += gap.charge_C
        self._longest_doubt_s = max(self._longest_doubt_s, gap.length_s)

    def add_interval(self, interval_s: float, load_A: float) -> None:
        """Add an interval that is no gap, or whose charge was drawn: intervals of this length are then usual."""
        if interval_s > self._longest_s[0] and load_A > REST_CURRENT_A:
            self._longest_s = sorted([*self._longest_s[1:], interval_s])
            if self._longest_doubt_s <= _RATIO * self.usual_s:
                self.doubt_C = self._longest_doubt_s = 0.0

    @property
    def usual_s(self) -> float:
        """Usual length of long intervals."""
        return self._longest_s[0]


class _ExpectedVoltage:
    """The expected voltage after a gap: the model's, with its error and the trend of its error."""

    def __init__(self) -> None:
        self.model_V = self._error_V = self._smoothed_V = self.fall_V_per_s = 0.0

    def add_sample(self, n: int, voltage_V: float, model_V: float, updates_error: bool) -> None:
        """Add a sample."""
        if updates_error:
            share = 1.0 / min(n, _ERROR_SAMPLES)
            self._error_V += share * (voltage_V - model_V - self._error_V)
            self._smoothed_V += share * (self._error_V - self._smoothed_V)
        self.model_V = model_V

    def add_fall(self, fall_V_per_s: float, interval_s: float) -> None:
        """Add the rate at which the voltage falls over an interval."""
        self.fall_V_per_s += -expm1(-interval_s / _RATE_TIME_CONSTANT_S) * (fall_V_per_s - self.fall_V_per_s)

    @property
    def voltage_V(self) -> float:
        """The expected voltage at the next sample."""
        return self.model_V + 2.0 * self._error_V - self._smoothed_V


def gaps_of(record: Samples, model_V: FloatArray, q_mobile: float, samples: MeasuredSamples, load_on_s: float) -> Gaps:
    """
    Return the gaps of a record, with the charge that the voltage leaves in doubt.

    :param record: all samples
    :param model_V: voltage of the model at the samples, NaN where its cell is empty
    :param q_mobile: an estimate, C
    :param samples: the samples that have a voltage
    :param load_on_s: end of the rest before the load since the first sample
    """
    gaps, expected, gap = Gaps(), _ExpectedVoltage(), None
    time_s, interval_s = record.time_s - record.time_s[0], np.diff(record.time_s)
    size_A = np.abs(record.current_A)
    load_A, before_s = np.maximum(size_A[1:], size_A[:-1]), np.append(0.0, interval_s[:-1])
    charge_C = load_A * (interval_s - before_s)
    may_be_gap = (interval_s > _RATIO * before_s) & (load_A > REST_CURRENT_A) & (charge_C > _LEAST_SHARE * q_mobile)
    if not may_be_gap.any():
        return gaps
    measured_rows = np.cumsum(np.isfinite(record.voltage_V)) - 1
    for n, voltage_V in enumerate(record.voltage_V[1:].tolist(), 1):
        is_measured, length_s = not isnan(voltage_V), float(interval_s[n - 1])
        if gap is not None and gap.row == n - 1 and gap.length_s <= _RATIO * length_s:
            gap = None  # the interval of the log has changed for good
        is_gap = bool(may_be_gap[n - 1]) and length_s > _RATIO * gaps.usual_s
        if is_gap:
            if gap is not None:
                gaps.add_doubt(gap)
            gap = _Gap(n, length_s, float(charge_C[n - 1]), 0.0, 0.0, [voltage_V])
            gaps.span_s = float(time_s[n - 1]), float(time_s[n])
            gap.fall_V = _fall_V(record, n, expected, float(model_V[n]), samples, int(measured_rows[n - 1]), load_on_s)
            gap.model_V = expected.voltage_V - gap.fall_V
        else:
            gaps.add_interval(length_s, float(min(size_A[n - 1], size_A[n])))
            if gap is not None and is_measured:
                gap.later_V.append(voltage_V)
                if len(gap.later_V) < _SAMPLES_AFTER:
                    # the fall of the model to the next sample
                    gap.model_V -= gap.fall_V * float(time_s[n] - time_s[gap.row]) / gap.length_s
                else:
                    missing_V = float(np.median(gap.later_V)) - gap.model_V
                    is_drawn = missing_V + _MARGIN_SHARE * samples.noise_V(int(measured_rows[n])) < _DRAWN_SHARE * gap.fall_V
                    if gap.fall_V > 0.0 and is_drawn:
                        gaps.add_interval(gap.length_s, float(load_A[n - 1]))
                    else:
                        gaps.add_doubt(gap)
                    gap = None
        if is_measured:
            expected.add_sample(n, voltage_V, float(model_V[n]), gap is None)
            if not is_gap and n > 1:
                expected.add_fall((float(samples.voltage_V[measured_rows[n - 1]]) - voltage_V) / length_s, length_s)
    if gap is not None:
        gaps.add_doubt(gap)
    return gaps


def _fall_V(
    record: Samples, n: int, expected: _ExpectedVoltage, model_V: float, samples: MeasuredSamples, row: int, load_on_s: float
) -> float:
    """Return the fall of the model across a gap; 0 if it shows nothing."""
    interval_s, load_A = float(record.time_s[n] - record.time_s[n - 1]), np.abs(record.current_A[n - 1 : n + 1]).max()
    jump_s = float(samples.jump_s[row])
    steady_s = float(record.time_s[n - 1] - record.time_s[0]) - jump_s
    # a load that was switched shortly before the gap may have been switched again
    is_switched = steady_s < interval_s and jump_s > load_on_s
    is_other = abs(record.current_A[n] - record.current_A[n - 1]) > SWITCH_SHARE * load_A
    if isnan(record.voltage_V[n]) or is_switched or is_other:
        return 0.0
    # a model with a wrong q_mobile may be empty too early: the voltage falls at least as before
    least_V = expected.fall_V_per_s * interval_s if steady_s >= STEADY_S else inf
    return min(expected.model_V - model_V, least_V)
