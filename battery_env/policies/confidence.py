"""How sure a policy may be of its estimates: as sure as the fit in its observation, and as near as it is to that fit."""

from __future__ import annotations

from math import hypot, isnan, nan

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, CellParameters
from battery_env.electrochemistry.aging_path import BESIDE_LIMIT_SD, EQUILIBRIUM_NAMES, AgingPath, cell_with
from battery_env.estimates import Estimate
from battery_env.estimates.findings import Reason
from battery_env.estimators.diagnosis.evidence import evidence_of
from battery_env.estimators.diagnosis.faults import MOST_NOISE_SD
from battery_env.estimators.diagnosis.rest import rest_voltage_V
from battery_env.estimators.search import square
from battery_env.estimators.verdict import (
    MISMATCH_MARGIN,
    SPARE_SAMPLES,
    Assumptions,
    Diagnosis,
    misfit_limit_V2,
    white_noise_V,
)
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import ChargeHistory, Samples
from battery_env.records.model import RecordModel
from battery_env.tasks.voltage.fit import REACH_SD, Fitted
from battery_env.tasks.voltage.voltage_task import ESTIMATE_RANGES, VoltageTask

# What is within its reach by less than this share may lie at its edge but for rounding.
_ROUNDING = 1e-9
# Residuals below this may be what a linear step leaves, V
_LINEAR_STEP_V = 2e-3


class Confidence:
    """
    What a policy can state of one discharge after another.

    :param task: that the policy acts in, with a fit in its observation
    :param cell: constants of the model
    :param dt_s: time step of the model, s
    """

    def __init__(self, task: VoltageTask, cell: CellParameters, dt_s: float) -> None:
        self._offset_V = task.sensors.offset_V
        self._path: AgingPath | None = task.path
        self._sd_ratio = 1.0 if task.path is None else task.path.sd_ratio
        self._cell, self._dt_s = cell, dt_s

    def _model_V(self, fitted: Fitted, n: int, record: Samples) -> FloatArray:
        """The voltage of the model that was fitted, at the samples of a record."""
        cell = cell_with(self._cell, _by_name(fitted, n))
        # a linear step may go beyond
        q_mobile, r_o = np.clip(fitted.estimate[n], *np.array([ESTIMATE_RANGES[name] for name in PARAMETER_NAMES]).T).tolist()
        return RecordModel(cell, dt_s=self._dt_s).voltage(record, Estimate(q_mobile, r_o)) + fitted.offset_V[n]

    def estimate(self, fitted: Fitted, n: int, estimate: FloatArray, record: Samples, history: ChargeHistory) -> Estimate:
        """
        An estimate, with its standard deviations, those of the fit with the distance of the estimate from it and the charge
        that nobody saw; which of both numbers are settled, and why not both; and along a path what the fit says of the
        constants. What is known of the parameters before settles nothing.
        """
        cell, (q_mobile, r_o), path = self._cell, estimate.tolist(), self._path
        model_V = self._model_V(fitted, n, record)
        evidence = evidence_of(record, cell, 1.0, (q_mobile, r_o), history, model_V)
        diagnosis = Diagnosis(evidence, evidence.measured(1.0, float(record.time_s[0]), history.charge))
        apart = np.abs(fitted.estimate[n] - estimate)
        hidden = np.hypot([evidence.unseen_C, 0.0], apart)
        sd = np.hypot(fitted.sd_alone[n] * [self._sd_ratio, 1.0], hidden)
        is_measured = np.isfinite(record.voltage_V)
        residual_V = (model_V - record.voltage_V)[is_measured]  # NaN after the model is empty
        white_V = white_noise_V(residual_V[np.isfinite(residual_V)])
        readings = len(residual_V)
        mismatch_V = 0.0 if path is None else path.mismatch_V
        # the first voltage may be that of a full cell with the largest offset, and noise and model beyond
        beyond_V = self._offset_V + MOST_NOISE_SD * hypot(white_V, MISMATCH_MARGIN * mismatch_V)
        diagnosis.note(Reason.START_DIFFERS, float(record.voltage_V[0]) > rest_voltage_V(cell) + beyond_V)
        diagnosis.note(Reason.FEW, readings < len(PARAMETER_NAMES) + SPARE_SAMPLES)
        limit_V2 = misfit_limit_V2(white_V, readings, mismatch_V, negligible_V=_LINEAR_STEP_V)
        diagnosis.note(Reason.MISFIT, not square(residual_V) <= readings * limit_V2)
        most_sd = REACH_SD if path is None else BESIDE_LIMIT_SD
        for what, size, most in (
            ("distance from the constants that it has learned of", float(fitted.constants_sd[n]), most_sd),
            ("offset of the voltage", abs(float(fitted.offset_V[n])), MISMATCH_MARGIN * self._offset_V),
        ):
            if size > (1.0 - _ROUNDING) * most:  # as a fit keeps within its reach
                diagnosis.note(Reason.OTHER_KIND, what=what, ratio=size / most)
        for k, name in enumerate(PARAMETER_NAMES):
            diagnosis.note_about(name, Reason.AT_BOUND, estimate[k] in ESTIMATE_RANGES[name])
        values, sds = (dict(zip(PARAMETER_NAMES, each.tolist(), strict=True)) for each in (estimate, sd))
        distances = dict(zip(PARAMETER_NAMES, apart.tolist(), strict=True))
        assumptions = Assumptions(distance_from_fit=distances, is_along_path=path is not None)
        verdict = diagnosis.verdict(values, sds, PARAMETER_NAMES, assumptions=assumptions)
        # the same NaN always, so that equal estimates are equal
        sd_q_mobile, sd_r_o = (nan if isnan(sd) else sd for sd in np.hypot(self._sd_ratio * fitted.sd[n], hidden).tolist())
        constants = None if path is None else _by_name(fitted, n)
        return Estimate(q_mobile, r_o, sd_q_mobile, sd_r_o, **verdict._asdict(), constants=constants)


def _by_name(fitted: Fitted, n: int) -> dict[str, float]:
    """The constants of a fit, by their names; without a path it has none of the equilibrium voltage."""
    names = (*UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES)
    return dict.fromkeys(names, 0.0) | dict(zip(names, fitted.constants[n].tolist(), strict=False))
