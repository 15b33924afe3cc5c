"""How sure a policy may be of its estimates: as sure as the fit in its observation, and as near as it is to that fit."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.calibration.nuisance import REACH_SD, Fitted
from battery_env.calibration.voltage import ESTIMATE_RANGES, VoltageTask
from battery_env.electrochemistry import CellParameters
from battery_env.estimates import Estimate
from battery_env.estimators.gaps import DRAWN, find_gaps, long_intervals
from battery_env.estimators.settling import (
    AT_BOUND,
    EXCESS_LIMIT_UNSTATED,
    IMPRECISE,
    SETTLED_SHARES,
    SPARE_SAMPLES,
    first_reason,
    gap_reason,
    least_resistance_ohm,
    rest_voltage_V,
    sensor_reason,
    start_reason,
    start_text,
)
from battery_env.parameters import PARAMETER_NAMES
from battery_env.record_model import RecordModel
from battery_env.records import Samples

#: Why a policy is sure of nothing whose observation has no fit.
NO_FIT = "A policy whose observation has no fit (option nuisance) states no uncertainty."
# Residuals below this may be what a linear step leaves, V
_NEGLIGIBLE_V = 2e-3
# That a constant is at its limit is a matter of rounding
_NEARLY = 1.0 - 1e-9
# Samples may be this many times farther apart than readings for this share of them, and of the time
_LONGER, _SPARSE_SHARE = 1.25, 0.05
# The first voltage may be this many standard deviations of the noise, and the largest offset, beyond that of a full cell
_NOISES = 3.0
# An offset may be this many times the bound that it was trained with
_OFFSET_MARGIN = 2.0
_UNEXPLAINED = (
    "The voltage is farther off than noise, an offset and the constants that the policy knows of explain: use least squares "
    "with mismatch_V, or check the sensors and that this is one discharge."
)
_OFFSET = "The fit in the observation takes the voltage for {:.0f} mV off, where the policy has learned of {:.0f} mV at most."
_CONSTANTS = "A constant of the cell is farther from the model's than the policy has learned of (option nuisance)."
_DIFFERS = "The policy and the fit in its observation differ by {:.1%} in {}: it does not trust the fit."
_FEW = "These are too few readings to tell the noise yet."
_SPARSE = (
    "Samples lie farther apart than the {:g} s between the readings of the policy, or are missing at the start: it reads a "
    "straight line between them, which misleads it. Least squares and the filter take such records."
)
_IMPRECISE = IMPRECISE | {"r_o": "r_o is not known to 30 % yet: a larger current tells more."}


class Confidence:
    """
    What a policy can state of one discharge after another.

    :param task: that the policy acts in, with a fit in its observation
    :param cell: constants of the model
    :param dt_s: time step of the model, s
    """

    def __init__(self, task: VoltageTask, cell: CellParameters, dt_s: float) -> None:
        self._parameters = task.parameters
        self._offset_V = task.sensors.offset_V
        self._interval_s = task.readings.interval_s
        self._model = RecordModel(cell, dt_s=dt_s)

    def standard_deviations(self, fitted: Fitted, estimate: FloatArray) -> FloatArray:
        """Those of the fit, with the distance of the estimate from it."""
        known = [name not in self._parameters for name in PARAMETER_NAMES]
        return np.where(known, np.nan, np.hypot(fitted.sd, fitted.estimate - estimate))

    def reason(self, fitted: Fitted, n: int, estimate: FloatArray, sd: FloatArray, record: Samples, rested: bool) -> str:
        """Why an estimate is not settled."""
        return first_reason(self._conditions(fitted, n, estimate, sd, record, rested))

    def _conditions(
        self, fitted: Fitted, n: int, estimate: FloatArray, sd: FloatArray, record: Samples, rested: bool
    ) -> Iterator[tuple[bool, str]]:
        """What speaks against an estimate, in the order in which it counts. What takes long is looked at last."""
        columns = [(name, PARAMETER_NAMES.index(name)) for name in self._parameters]
        resistance_ohm = least_resistance_ohm(*estimate.tolist())
        start = start_reason(*record, self._model.cell, resistance_ohm=resistance_ohm, rested=rested)
        yield bool(start), start
        readings, white_V = int(fitted.readings[n]), float(fitted.white_V[n])
        often, share = self._without_samples(record.time_s, readings)
        sparse = _SPARSE.format(self._interval_s)
        yield often, sparse
        yield readings < len(columns) + SPARE_SAMPLES, _FEW
        for name, k in columns:
            yield estimate[k] in ESTIMATE_RANGES[name], AT_BOUND.format(name)
        limit_V2 = (1.0 + EXCESS_LIMIT_UNSTATED / sqrt(readings)) * white_V**2 + _NEGLIGIBLE_V**2
        yield not fitted.noise_V[n] ** 2 <= limit_V2, _UNEXPLAINED
        first_V, full_V = float(record.voltage_V[0]), rest_voltage_V(self._model.cell)
        yield first_V > full_V + self._offset_V + _NOISES * white_V, start_text(1, first_V, full_V)
        offset_V = abs(float(fitted.offset_V[n]))
        yield offset_V > _OFFSET_MARGIN * self._offset_V, _OFFSET.format(1e3 * offset_V, 1e3 * self._offset_V)
        yield fitted.constants_sd[n] > _NEARLY * REACH_SD, _CONSTANTS
        differs = np.abs(fitted.estimate[n] / estimate - 1.0)
        for name, k in columns:
            yield not differs[k] < SETTLED_SHARES[name], _DIFFERS.format(differs[k], name)
        for name, k in columns:
            yield not sd[k] < SETTLED_SHARES[name] * estimate[k], _IMPRECISE[name]
        of_samples = self._reason_of_samples(record, Estimate(*estimate.tolist()), resistance_ohm)
        yield bool(of_samples), of_samples
        yield share > _SPARSE_SHARE, sparse

    def _without_samples(self, time_s: FloatArray, readings: int) -> tuple[bool, float]:
        """
        Whether readings lie between samples at the start or again and again, and for which share of the time. There they lie
        on a straight line, which no cell follows, least of all when the load is switched on.
        """
        step_s = np.diff(np.append(time_s, max(time_s[-1], time_s[0] + readings * self._interval_s)))
        is_long = step_s > _LONGER * self._interval_s
        often = len(time_s) < 2 or bool(is_long[0]) or float(is_long.mean()) > _SPARSE_SHARE
        return often, float(step_s[is_long].sum() / step_s.sum())

    def _reason_of_samples(self, record: Samples, estimate: Estimate, resistance_ohm: float) -> str:
        if len(long_intervals(record.time_s)):
            model_V = self._model.voltage(record, estimate)
            gaps = [gap for gap in find_gaps(*record, model_V, estimate.q_mobile) if gap.verdict != DRAWN]
            if gaps:
                return gap_reason(gaps, gaps[0].verdict)
        return sensor_reason(*record, resistance_ohm)
