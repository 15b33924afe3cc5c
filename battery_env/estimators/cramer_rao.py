"""What a record can tell at best: sensitivities of its voltage, and the Cramér-Rao bound on the errors of estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import Trajectory
from battery_env.estimates import Estimate
from battery_env.parameters import PARAMETER_NAMES, check_parameters
from battery_env.records import Record
from battery_env.records.model import RecordModel

# Below this determinant of the normalized information, unknowns cannot be told apart but by rounding errors.
_LEAST_DETERMINANT = 1e-10


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """
    How the voltage of a record depends on both parameters, at the current of the record; arrays of shape (T,).

    :param time_s: of the samples, on the clock of the record
    :param voltage_V: of the model
    :param by_q_mobile_V_per_C: dV/dq_mobile
    :param by_r_o_A: dV/dr_o; near minus the current, once the load has been on for a while
    """

    time_s: FloatArray
    voltage_V: FloatArray
    by_q_mobile_V_per_C: FloatArray
    by_r_o_A: FloatArray


@dataclass(frozen=True, eq=False)
class CramerRaoBound:
    """
    The least standard deviations of unbiased estimates from all samples so far; arrays of shape (T,).

    :param time_s: of the samples, on the clock of the record
    :param sd_q_mobile: C; NaN if ``q_mobile`` is known, infinite while the samples do not determine it
    :param sd_r_o: likewise, ohm
    """

    time_s: FloatArray
    sd_q_mobile: FloatArray
    sd_r_o: FloatArray


def sensitivities(record: Record, at: Estimate | None = None, model: RecordModel | None = None) -> Sensitivities:
    """
    Differentiate the voltage of the model at the samples of a record, exactly.

    :param record: one discharge, of which only time and current are used
    :param at: the parameters; ``None``: the true ones of a simulated discharge
    :param model: the model; ``None``: isothermal, in steps of 1 s, of a new cell that is full at the first sample
    :raises ValueError: for a recorded discharge without parameters
    """
    if at is None:
        if not isinstance(record, Trajectory):
            raise ValueError("give the parameters of a recorded discharge, e.g. what LeastSquares estimates, as `at`")
        at = Estimate(record.q_mobile, record.r_o)
    model = model or RecordModel()
    time_s, current_A = model.grid(record)
    grid_s = model.dt_s * np.arange(len(current_A))
    columns = model.sensitivities(current_A, at.q_mobile, at.r_o)
    return Sensitivities(np.asarray(record.time_s), *(np.interp(time_s, grid_s, column) for column in columns))


def cramer_rao_bound(
    record: Record,
    voltage_noise_V: float,
    parameters: Sequence[str] = PARAMETER_NAMES,
    offset: bool = False,
    at: Estimate | None = None,
    model: RecordModel | None = None,
) -> CramerRaoBound:
    """
    Return the bound for a voltage sensor with white normal noise and an exact current, over time as the record grows: sd^2 =
    diag((sum over samples of g g^T)^-1) * noise^2, g the derivatives of the voltage with respect to all unknowns
    (:func:`sensitivities`, which has ``record``, ``at`` and ``model``).

    What is known exactly is the current. Were it the power, the current would give the parameters away a little as well, and
    the bound would be lower by 5 to 30 %.

    :param voltage_noise_V: standard deviation of the noise, V
    :param parameters: which are unknown: ``"q_mobile"``, ``"r_o"`` or both; the other one is known
    :param offset: whether the sensor has an unknown constant offset as well
    :raises ValueError: for an argument out of range, or a record that cannot be used
    """
    names = check_parameters(parameters)
    if not 0.0 < voltage_noise_V < np.inf:
        raise ValueError(f"voltage_noise_V must be greater than 0 V, got {voltage_noise_V!r}")
    slopes = sensitivities(record, at, model)
    by_parameter = {"q_mobile": slopes.by_q_mobile_V_per_C, "r_o": slopes.by_r_o_A}
    columns = [by_parameter[name] for name in names]
    if offset:
        columns.append(np.ones(len(slopes.time_s)))
    gradient = np.column_stack(columns) / voltage_noise_V
    variance = _inverse_diagonals(np.cumsum(gradient[:, :, None] * gradient[:, None, :], axis=0))
    sd = dict.fromkeys(PARAMETER_NAMES, np.full(len(slopes.time_s), np.nan))
    sd |= {name: np.sqrt(variance[:, n]) for n, name in enumerate(names)}
    return CramerRaoBound(slopes.time_s, sd["q_mobile"], sd["r_o"])


def _inverse_diagonals(information: FloatArray) -> FloatArray:
    """Invert the information after each sample; infinite where it cannot be inverted."""
    scale = np.sqrt(np.einsum("tii->ti", information))
    out = np.full_like(scale, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        normalized = information / (scale[:, :, None] * scale[:, None, :])
        regular = np.linalg.det(normalized) > _LEAST_DETERMINANT
    out[regular] = np.einsum("tii->ti", np.linalg.inv(normalized[regular])) / scale[regular] ** 2
    return out
