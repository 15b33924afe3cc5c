"""The standard deviations and the verdict of a policy, from the fit in its observation and the distance from this fit."""

from __future__ import annotations

from math import hypot, isnan, nan

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, CellParameters
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_NAMES, PATH_DISTANCE_LIMIT_SD, AgingPath, cell_with
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
from battery_env.tasks.voltage.fit import REACH_SD, FitResult
from battery_env.tasks.voltage.voltage_task import ESTIMATE_RANGES, VoltageTask

# Rounding, as a share of a limit of the fit.
_ROUNDING = 1e-9
# Root mean square of residuals that a linear step may leave, V
_LINEAR_STEP_V = 2e-3


class Confidence:
    """Standard deviations and verdicts for the estimates of a policy, whose task has a fit in its observation."""

    def __init__(self, task: VoltageTask, cell: CellParameters) -> None:
        self._offset_V = task.sensors.offset_V
        self._path: AgingPath | None = task.path
        self._sd_ratio = 1.0 if task.path is None else task.path.sd_ratio
        self._cell = cell

    def _model_V(self, fit: FitResult, n: int, record: Samples) -> FloatArray:
        """Return the voltage of the fitted model at the samples of a record."""
        cell = cell_with(self._cell, _by_name(fit, n))
        # a linear step may leave the ranges
        q_mobile, r_o = np.clip(fit.estimate[n], *np.array([ESTIMATE_RANGES[name] for name in PARAMETER_NAMES]).T).tolist()
        return RecordModel(cell).voltage(record, Estimate(q_mobile, r_o)) + fit.offset_V[n]

    def estimate(self, fit: FitResult, n: int, estimate: FloatArray, record: Samples, history: ChargeHistory) -> Estimate:
        """Return the estimate with standard deviations and verdict, and along a path with the constants of the fit."""
        # a standard deviation combines the fit's, the distance of the estimate from the fit, and that of the charge;
        # the verdict uses the fit's under a flat prior of the parameters
        cell, (q_mobile, r_o), path = self._cell, estimate.tolist(), self._path
        model_V = self._model_V(fit, n, record)
        evidence = evidence_of(record, cell, 1.0, (q_mobile, r_o), history, model_V)
        diagnosis = Diagnosis(evidence, evidence.measured(1.0, float(record.time_s[0]), history.charge))
        distance = np.abs(fit.estimate[n] - estimate)
        common_sd = np.hypot([evidence.sd_charge_C, 0.0], distance)
        sd = np.hypot(fit.sd_flat_prior[n] * [self._sd_ratio, 1.0], common_sd)
        is_measured = np.isfinite(record.voltage_V)
        residual_V = (model_V - record.voltage_V)[is_measured]  # NaN after the model is empty
        white_V = white_noise_V(residual_V[np.isfinite(residual_V)])
        readings = len(residual_V)
        mismatch_V = 0.0 if path is None else path.mismatch_V
        # limit of the first voltage: a full cell, the largest offset, and errors of noise and model
        tolerance_V = self._offset_V + MOST_NOISE_SD * hypot(white_V, MISMATCH_MARGIN * mismatch_V)
        diagnosis.note(Reason.START_DIFFERS, float(record.voltage_V[0]) > rest_voltage_V(cell) + tolerance_V)
        diagnosis.note(Reason.FEW, readings < len(PARAMETER_NAMES) + SPARE_SAMPLES)
        limit_V2 = misfit_limit_V2(white_V, readings, mismatch_V, negligible_V=_LINEAR_STEP_V)
        diagnosis.note(Reason.MISFIT, not square(residual_V) <= readings * limit_V2)
        limit_sd = REACH_SD if path is None else PATH_DISTANCE_LIMIT_SD
        for quantity, size, limit in (
            ("distance from the constants that it has learned of", float(fit.constants_sd[n]), limit_sd),
            ("offset of the voltage", abs(float(fit.offset_V[n])), MISMATCH_MARGIN * self._offset_V),
        ):
            if size > (1.0 - _ROUNDING) * limit:  # the fit clips at its limits
                diagnosis.note(Reason.OTHER_KIND, what=quantity, ratio=size / limit)
        for k, name in enumerate(PARAMETER_NAMES):
            diagnosis.note_about(name, Reason.AT_BOUND, estimate[k] in ESTIMATE_RANGES[name])
        values, sds = (dict(zip(PARAMETER_NAMES, column.tolist(), strict=True)) for column in (estimate, sd))
        distances = dict(zip(PARAMETER_NAMES, distance.tolist(), strict=True))
        assumptions = Assumptions(distance_from_fit=distances, is_along_path=path is not None)
        verdict = diagnosis.verdict(values, sds, PARAMETER_NAMES, assumptions=assumptions)
        stated_sds = np.hypot(self._sd_ratio * fit.sd[n], common_sd).tolist()
        # the same NaN object, so that equal estimates compare equal
        sd_q_mobile, sd_r_o = (nan if isnan(sd) else sd for sd in stated_sds)
        constants = None if path is None else _by_name(fit, n)
        return Estimate(q_mobile, r_o, sd_q_mobile, sd_r_o, **verdict._asdict(), constants=constants)


def _by_name(fit: FitResult, n: int) -> dict[str, float]:
    """Return the constants of a fit by name, 0 for those that it does not have."""
    names = (*UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES)
    return dict.fromkeys(names, 0.0) | dict(zip(names, fit.constants[n].tolist(), strict=False))
