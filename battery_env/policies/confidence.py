"""How sure a policy may be of its estimates: as sure as the fit in its observation, and as near as it is to that fit."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, CellParameters
from battery_env.electrochemistry.aging_path import BESIDE_LIMIT_SD, EQUILIBRIUM_NAMES, AgingPath, cell_with
from battery_env.estimates import Estimate
from battery_env.estimators.diagnosis.conditions import (
    EXCESS_LIMIT_UNSTATED,
    MISMATCH_MARGIN,
    SETTLED_SHARES,
    SPARE_SAMPLES,
    Condition,
    Diagnosis,
    Verdict,
    rest_voltage_V,
    start_measured,
    white_noise_V,
)
from battery_env.estimators.diagnosis.samples import note_samples, unseen_C, watched
from battery_env.estimators.search import square
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import ChargeHistory, Samples
from battery_env.records.model import RecordModel
from battery_env.tasks.voltage.fit import REACH_SD, Fitted
from battery_env.tasks.voltage.task import ESTIMATE_RANGES, VoltageTask

# Residuals below this may be what a linear step leaves, V
_NEGLIGIBLE_V = 2e-3
# That a constant is at its limit is a matter of rounding
_NEARLY = 1.0 - 1e-9
# The first voltage may be this many standard deviations of noise and model, and the largest offset, beyond that of a full cell
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
        self._path: AgingPath | None = task.path
        self._sd_ratio = 1.0 if task.path is None else task.path.sd_ratio
        self._cell, self._dt_s = cell, dt_s

    def constants(self, fitted: Fitted, n: int) -> dict[str, float] | None:
        """What the fit says of the constants along a path, by their names."""
        return None if self._path is None else _by_name(fitted, n)

    def _model_V(self, fitted: Fitted, n: int, record: Samples) -> FloatArray:
        """The voltage of the model that was fitted, at the samples of a record."""
        cell = cell_with(self._cell, _by_name(fitted, n))
        # a linear step may go beyond
        q_mobile, r_o = np.clip(fitted.estimate[n], *np.array([ESTIMATE_RANGES[name] for name in PARAMETER_NAMES]).T).tolist()
        return RecordModel(cell, dt_s=self._dt_s).voltage(record, Estimate(q_mobile, r_o)) + fitted.offset_V[n]

    def verdict(
        self, fitted: Fitted, n: int, estimate: FloatArray, record: Samples, history: ChargeHistory
    ) -> tuple[Verdict, FloatArray]:
        """
        Which numbers of an estimate are settled, and why not both; and its standard deviations, those of the fit with the
        distance of the estimate from it and the charge that nobody saw, shape (2,). What is known of the parameters before
        settles nothing.
        """
        diagnosis, cell, (q_mobile, r_o) = Diagnosis(), self._cell, estimate.tolist()
        model_V = self._model_V(fitted, n, record)
        seen = watched(record, cell, 1.0, (q_mobile, r_o), history, model_V)
        hidden = np.hypot([unseen_C(seen), 0.0], fitted.estimate[n] - estimate)
        sd = np.hypot(fitted.sd_alone[n] * [self._sd_ratio, 1.0], hidden)
        is_measured = np.isfinite(record.voltage_V)
        residual_V = (model_V - record.voltage_V)[is_measured]  # NaN after the model is empty
        white_V = white_noise_V(residual_V[np.isfinite(residual_V)])
        readings, offset_V = len(residual_V), abs(float(fitted.offset_V[n]))
        first_V, full_V = float(record.voltage_V[0]), rest_voltage_V(cell)
        mismatch_V = 0.0 if self._path is None else MISMATCH_MARGIN * self._path.mismatch_V
        is_above = first_V > full_V + self._offset_V + _NOISES * sqrt(white_V**2 + mismatch_V**2)
        diagnosis.note(Condition.START_ABOVE, is_above, **start_measured(first_V, full_V))
        note_samples(diagnosis, seen, 1.0, record, history, inf if sd[0] < SETTLED_SHARES["q_mobile"] * q_mobile else sd[0])
        diagnosis.note(Condition.FEW, readings < len(self._parameters) + SPARE_SAMPLES, of="readings", or_else="")
        limit_V2 = (1.0 + EXCESS_LIMIT_UNSTATED / sqrt(readings)) * white_V**2 + _NEGLIGIBLE_V**2
        limit_V2 += mismatch_V**2
        diagnosis.note(Condition.UNEXPLAINED, not square(residual_V) <= readings * limit_V2)
        is_off = offset_V > _OFFSET_MARGIN * self._offset_V
        diagnosis.note(Condition.OFFSET, is_off, offset_mV=1e3 * offset_V, most_mV=1e3 * self._offset_V)
        if self._path is None:
            diagnosis.note(Condition.CONSTANTS, fitted.constants_sd[n] > _NEARLY * REACH_SD)
        else:
            distance = float(fitted.constants_sd[n])
            diagnosis.note(Condition.BESIDE_PATH, distance > BESIDE_LIMIT_SD, distance=distance)
            diagnosis.note(Condition.PATH_UNTESTED, not sd[0] < SETTLED_SHARES["q_mobile"] * q_mobile)
        differs = np.abs(fitted.estimate[n] / estimate - 1.0)
        for name in self._parameters:
            k, share = PARAMETER_NAMES.index(name), SETTLED_SHARES[name]
            diagnosis.note(Condition.Q_AT_BOUND.of(name), estimate[k] in ESTIMATE_RANGES[name])
            diagnosis.note(Condition.Q_DIFFERS.of(name), not differs[k] < share, differs=differs[k])
            diagnosis.note(Condition.Q_IMPRECISE.of(name), not sd[k] < share * estimate[k])
        values, sds = (dict(zip(PARAMETER_NAMES, each.tolist(), strict=True)) for each in (estimate, sd))
        known = [name not in self._parameters for name in PARAMETER_NAMES]
        stated = np.where(known, np.nan, np.hypot(self._sd_ratio * fitted.sd[n], hidden))
        return diagnosis.verdict(values, sds), stated


def _by_name(fitted: Fitted, n: int) -> dict[str, float]:
    """The constants of a fit, by their names; without a path it has none of the equilibrium voltage."""
    names = (*UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES)
    return dict.fromkeys(names, 0.0) | dict(zip(names, fitted.constants[n].tolist(), strict=False))
