"""How sure a policy may be of its estimates: as sure as the fit in its observation, and as near as it is to that fit."""

from __future__ import annotations

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
    IMPRECISE,
    SETTLED_SHARES,
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
from battery_env.records import REST_CURRENT_A, Samples

#: Why a policy is sure of nothing whose observation has no fit.
NO_FIT = "A policy whose observation has no fit (option nuisance) states no uncertainty."
# Residuals are more than noise if their variance is above that of the noise by this over the root of the number of readings,
# and by this, V, for what a linear step leaves
_EXCESS_LIMIT, _NEGLIGIBLE_V = 10.0, 2e-3
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
        self._model = RecordModel(cell, dt_s=dt_s)

    def standard_deviations(self, fitted: Fitted, estimate: FloatArray) -> FloatArray:
        """
        Those of the fit, with the distance of the estimate from it.

        :param fitted: what the policy has seen
        :param estimate: (q_mobile, r_o) that it has made of it, C and ohm, shape (cells, 2)
        :return: same shape; NaN where the parameter is known
        """
        known = [name not in self._parameters for name in PARAMETER_NAMES]
        return np.where(known, np.nan, np.hypot(fitted.sd, fitted.estimate - estimate))

    def reason(self, fitted: Fitted, n: int, estimate: FloatArray, sd: FloatArray, record: Samples, rested: bool) -> str:
        """
        Why an estimate is not settled. What is quick to see is looked at first.

        :param fitted: what the policy has seen
        :param n: of which cell
        :param estimate: (q_mobile, r_o) that it has made of it, C and ohm, shape (2,)
        :param sd: their standard deviations, same shape
        :param record: all samples so far, at least two
        :param rested: whether the first voltage is known to be that of a cell at rest
        :return: a sentence or two, empty if it is settled
        """
        q_mobile, r_o = estimate.tolist()
        resistance_ohm = least_resistance_ohm(q_mobile, r_o)
        start = start_reason(*record, self._model.cell, resistance_ohm=resistance_ohm, rested=rested)
        start = start or self._start_reason(record, float(fitted.white_V[n]), rested)
        excess = 1.0 + _EXCESS_LIMIT / sqrt(fitted.readings[n])
        limit_V2 = excess * float(fitted.white_V[n]) ** 2 + _NEGLIGIBLE_V**2
        offset_V = abs(float(fitted.offset_V[n]))
        columns = [(name, PARAMETER_NAMES.index(name)) for name in self._parameters]
        differs = np.abs(fitted.estimate[n] / estimate - 1.0)
        return first_reason(
            [
                (bool(start), start),
                *((estimate[k] in ESTIMATE_RANGES[name], AT_BOUND.format(name)) for name, k in columns),
                (not fitted.noise_V[n] ** 2 <= limit_V2, _UNEXPLAINED),
                (offset_V > _OFFSET_MARGIN * self._offset_V, _OFFSET.format(1e3 * offset_V, 1e3 * self._offset_V)),
                (not fitted.constants_sd[n] < REACH_SD, _CONSTANTS),
                *((not differs[k] < SETTLED_SHARES[name], _DIFFERS.format(differs[k], name)) for name, k in columns),
                *((not sd[k] < SETTLED_SHARES[name] * estimate[k], _IMPRECISE[name]) for name, k in columns),
            ]
        ) or self._reason_of_samples(record, Estimate(q_mobile, r_o), resistance_ohm)

    def _start_reason(self, record: Samples, white_V: float, rested: bool) -> str:
        """Whether the sensors that the policy has learned of can show the first voltage of a full cell."""
        first_V, rest_V = float(record.voltage_V[0]), rest_voltage_V(self._model.cell)
        limit_V = self._offset_V + _NOISES * white_V
        if first_V > rest_V + limit_V:
            return start_text(1, first_V, rest_V)
        at_rest = rested or abs(float(record.current_A[0])) <= REST_CURRENT_A
        return start_text(2, first_V, rest_V) if at_rest and first_V < rest_V - limit_V else ""

    def _reason_of_samples(self, record: Samples, estimate: Estimate, resistance_ohm: float) -> str:
        if len(long_intervals(record.time_s)):
            model_V = self._model.voltage(record, estimate)
            gaps = [gap for gap in find_gaps(*record, model_V, estimate.q_mobile) if gap.verdict != DRAWN]
            if gaps:
                return gap_reason(gaps, gaps[0].verdict)
        return sensor_reason(*record, resistance_ohm)
