"""
The resistance after ten seconds, as meters report it: the fall of the voltage from before the load to ten seconds later, over
the current. A fitted model gives it with a standard deviation; a record gives it without any model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.estimators.search import Fit, Search, root_variance
from battery_env.records import SWITCH_SHARE, Record, integrate_load, load_span, switches
from battery_env.records.load import switch_times_s

#: The time of the DC resistance in test reports, s.
PULSE_S = 10.0


class LoadStep(NamedTuple):
    """
    A load that is switched on, or up.

    :param before: the last sample before
    :param on_s: when it is switched, s
    :param size_A: by how much, in the mean of the ten seconds that follow
    :param stays: whether the current is that at their end, too
    """

    before: int
    on_s: float
    size_A: float
    stays: bool

    def fall_ohm(self, record: Record, time_s: FloatArray, voltage_V: FloatArray, after_s: float = PULSE_S) -> float:
        """How far a voltage falls over the step and so much longer, by the current, V/A."""
        before_V, after_V = np.interp([record.time_s[self.before], self.on_s + after_s], time_s, voltage_V)
        return float(before_V - after_V) / self.size_A

    def is_measured(self, record: Record, after_s: float = PULSE_S) -> bool:
        """Whether samples lie before and after that time, near enough to interpolate, and before another switch."""
        after = int(np.searchsorted(record.time_s, self.on_s + after_s))
        if not self.before + 1 < after < len(record.time_s):
            return False
        # a current that lags is one that has not settled yet, and no other switch
        settles = np.abs(np.diff(record.current_A[self.before + 1 : after + 1])) <= SWITCH_SHARE * self.size_A
        is_switched = bool((settles[:-1] & ~settles[1:]).any())
        return not is_switched and bool(record.time_s[after] - record.time_s[after - 1] <= 2.0 * PULSE_S)


def load_on(record: Record, starts_at_rest: bool) -> LoadStep | None:
    """The step from the rest before a load; ``None`` if there is no rest, or less than ten seconds of the load."""
    first = load_span(record.time_s, record.current_A).first
    if first:
        return _step(record, first - 1, 0.0, _moment_s(record, first - 1))
    return _step(record, 0, 0.0, float(record.time_s[0])) if starts_at_rest else None


def later_step(record: Record) -> LoadStep | None:
    """The first step of a load that is switched up later on; ``None`` if there is none."""
    up = [int(n) for n in switches(record.current_A) if record.current_A[n + 1] > record.current_A[n]]
    steps = (_step(record, n, float(record.current_A[n]), _moment_s(record, n)) for n in up)
    return next(filter(None, steps), None)


def measured_resistance_ohm(record: Record, starts_at_rest: bool) -> float:
    """The resistance after ten seconds as measured, ohm; NaN without such a step, or without samples around its end."""
    step = load_on(record, starts_at_rest)
    if step is None or not step.stays or not step.is_measured(record):
        return float("nan")
    return step.fall_ohm(record, record.time_s, record.voltage_V)


class ModelResistance(NamedTuple):
    """
    The resistance of a fitted model over a step of its load.

    :param ohm: its value
    :param sd_ohm: its standard deviation, for residuals of one
    :param per_s: its slope by the time since the step, ohm/s, there or at the first sample under load, whichever is later
    :param moment_ohm: its largest change if the step is as early or as late as the samples allow, ohm
    """

    ohm: float
    sd_ohm: float
    per_s: float
    moment_ohm: float

    @classmethod
    def of(cls, record: Record, step: LoadStep, search: Search, fit: Fit, after_s: float = PULSE_S) -> ModelResistance:
        """The resistance of a fit to a record, at some time after the step."""
        grid_s, voltages = record.time_s[0] + search.data.grid_s, search.voltage(fit.values)
        ohm, *by_unknown = (step.fall_ohm(record, grid_s, each, after_s) for each in voltages)
        sd_ohm = root_variance(fit.jacobian, np.array(by_unknown))
        first_s = float(record.time_s[step.before + 1])
        center_s, half_s = max(after_s, first_s - step.on_s), first_s - step.on_s
        earlier_ohm, later_ohm, early_ohm, late_ohm = (
            step.fall_ohm(record, grid_s, voltages[0], each_s)
            for each_s in (center_s - 1.0, center_s + 1.0, after_s - half_s, after_s + half_s)
        )
        moment_ohm = max(abs(ohm - early_ohm), abs(ohm - late_ohm))
        return cls(ohm, sd_ohm, 0.5 * abs(later_ohm - earlier_ohm), moment_ohm)


def _moment_s(record: Record, before: int) -> float:
    return float(switch_times_s(record.time_s, record.current_A, np.array([before]))[0])


def _step(record: Record, before: int, before_A: float, on_s: float) -> LoadStep | None:
    end_s, largest_A = on_s + PULSE_S, float(np.abs(record.current_A).max())
    first_C, last_C = integrate_load(record.time_s, record.current_A, [on_s, end_s])
    size_A = float(last_C - first_C) / PULSE_S - before_A
    if end_s > record.time_s[-1] or not size_A > SWITCH_SHARE * largest_A:
        return None
    last_A = float(np.interp(end_s, record.time_s, record.current_A)) - before_A
    return LoadStep(before, on_s, size_A, abs(last_A - size_A) <= SWITCH_SHARE * size_A)
