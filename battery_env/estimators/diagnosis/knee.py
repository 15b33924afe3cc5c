"""The uncertainty of the knee: the voltage of other cells falls later than the model's, or less steeply."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.polynomial import polyfit

from battery_env.arrays import FloatArray
from battery_env.records import CUT_OFF_V, SWITCH_SHARE, Samples, integrate_load, is_load

# The end of a record: the last share of its charge, and its least number of samples.
_END_SHARE, _LEAST_SAMPLES = 0.05, 5


def knee_sd_C(record: Samples, model_V: FloatArray, empty_V: float) -> float:
    """
    Return the standard deviation of the charge that a record may still give beyond the knee of its model, C. The function
    extrapolates measured and modelled voltage, with slope and curvature at the end of the record, to the voltage of an empty
    cell. The standard deviation is half of the charge by which the measured voltage reaches it later.

    :param record: a discharge
    :param model_V: voltage of the fitted model at its samples, NaN where the model cell is empty
    :param empty_V: voltage of an empty cell, V; at most 2.7 V
    """
    drawn_C = integrate_load(record.time_s, record.current_A, record.time_s)
    load_A = record.current_A[np.flatnonzero(is_load(record.current_A))[-1]]
    # only voltages under the load of the end are comparable
    is_end = np.isfinite(model_V) & (np.abs(record.current_A - load_A) < SWITCH_SHARE * abs(load_A))
    samples = np.flatnonzero(is_end)
    count = max(int((drawn_C[samples] > (1.0 - _END_SHARE) * drawn_C[-1]).sum()), _LEAST_SAMPLES)
    samples = samples[-count:]
    fall_V = float(record.voltage_V[samples[-1]]) - min(empty_V, CUT_OFF_V) if len(samples) else 0.0
    if len(samples) < _LEAST_SAMPLES or fall_V <= 0.0:
        return 0.0
    charge_C = drawn_C[samples] - drawn_C[samples[-1]]
    extra_charge_C = [_charge_to_fall_C(charge_C, voltage_V[samples], fall_V) for voltage_V in (record.voltage_V, model_V)]
    return 0.5 * max(min(extra_charge_C[0], drawn_C[-1]) - extra_charge_C[1], 0.0)


def _charge_to_fall_C(charge_C: FloatArray, voltage_V: FloatArray, fall_V: float) -> float:
    """Return the charge until a voltage has fallen, by slope and downward curvature at the end."""
    span_C = -charge_C[0]
    _, slope_V, bend_V = polyfit(charge_C / span_C, voltage_V, 2)
    slope_V, bend_V = max(-slope_V, 0.0), max(-bend_V, 0.0)
    root_V = np.sqrt(slope_V**2 + 4.0 * bend_V * fall_V)
    return float(2.0 * fall_V * span_C / (slope_V + root_V)) if root_V > 0.0 else np.inf
