"""How sure a policy may be of its estimates: as sure as the fit in its observation, and as near as it is to that fit."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import CellParameters
from battery_env.estimates import Estimate
from battery_env.estimators.diagnosis import gaps
from battery_env.estimators.diagnosis.conditions import (
    EXCESS_LIMIT_UNSTATED,
    SETTLED_SHARES,
    SPARE_SAMPLES,
    Condition,
    Diagnosis,
    Verdict,
    rest_voltage_V,
    start_measured,
)
from battery_env.estimators.diagnosis.samples import note_samples, unseen_C, watched
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import Samples, Shown
from battery_env.records.model import RecordModel
from battery_env.tasks.voltage.fit import REACH_SD, Fitted
from battery_env.tasks.voltage.task import ESTIMATE_RANGES, VoltageTask

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

    def verdict(self, fitted: Fitted, n: int, estimate: FloatArray, sd: FloatArray, record: Samples, shown: Shown) -> Verdict:
        """Which numbers of an estimate are settled, and why not both."""
        diagnosis, cell, (q_mobile, r_o) = Diagnosis(), self._model.cell, estimate.tolist()
        readings, white_V, offset_V = int(fitted.readings[n]), float(fitted.white_V[n]), abs(float(fitted.offset_V[n]))
        first_V, full_V = float(record.voltage_V[0]), rest_voltage_V(cell)
        is_above = first_V > full_V + self._offset_V + _NOISES * white_V
        diagnosis.note(Condition.START_ABOVE, is_above, **start_measured(first_V, full_V))
        model_V = self._model.voltage(record, Estimate(q_mobile, r_o)) if gaps.may_have_any(record.time_s) else None
        seen = watched(record, cell, 1.0, (q_mobile, r_o), shown, model_V)
        sd = np.hypot(sd, [unseen_C(seen), 0.0])
        note_samples(diagnosis, seen, 1.0, record, shown, inf if sd[0] < SETTLED_SHARES["q_mobile"] * q_mobile else sd[0])
        diagnosis.note(Condition.SPARSE, self._is_sparse(record.time_s, readings), interval_s=self._interval_s)
        diagnosis.note(Condition.FEW, readings < len(self._parameters) + SPARE_SAMPLES, of="readings", or_else="")
        limit_V2 = (1.0 + EXCESS_LIMIT_UNSTATED / sqrt(readings)) * white_V**2 + _NEGLIGIBLE_V**2
        diagnosis.note(Condition.UNEXPLAINED, not fitted.noise_V[n] ** 2 <= limit_V2)
        is_off = offset_V > _OFFSET_MARGIN * self._offset_V
        diagnosis.note(Condition.OFFSET, is_off, offset_mV=1e3 * offset_V, most_mV=1e3 * self._offset_V)
        diagnosis.note(Condition.CONSTANTS, fitted.constants_sd[n] > _NEARLY * REACH_SD)
        differs = np.abs(fitted.estimate[n] / estimate - 1.0)
        for name in self._parameters:
            k, share = PARAMETER_NAMES.index(name), SETTLED_SHARES[name]
            diagnosis.note(Condition.Q_AT_BOUND.of(name), estimate[k] in ESTIMATE_RANGES[name])
            diagnosis.note(Condition.Q_DIFFERS.of(name), not differs[k] < share, differs=differs[k])
            diagnosis.note(Condition.Q_IMPRECISE.of(name), not sd[k] < share * estimate[k])
        values, sds = (dict(zip(PARAMETER_NAMES, each.tolist(), strict=True)) for each in (estimate, sd))
        return diagnosis.verdict(values, sds)

    def _is_sparse(self, time_s: FloatArray, readings: int) -> bool:
        """
        Whether readings lie between samples at the start, or again and again, or for long. There they lie on a straight line,
        which no cell follows, least of all when the load is switched on.
        """
        step_s = np.diff(np.append(time_s, max(time_s[-1], time_s[0] + readings * self._interval_s)))
        is_long = step_s > _LONGER * self._interval_s
        often = len(time_s) < 2 or bool(is_long[0]) or float(is_long.mean()) > _SPARSE_SHARE
        return often or float(step_s[is_long].sum() / step_s.sum()) > _SPARSE_SHARE
