"""A knee that the model has and the record does not have: the voltage of other cells falls later, or less steeply."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.polynomial import polyfit

from battery_env.arrays import FloatArray
from battery_env.records import CUT_OFF_V, SWITCH_SHARE, Samples, integrate_load, is_load

# The end of a record: this share of the charge that was drawn, and at least so many samples.
_END_SHARE, _LEAST_SAMPLES = 0.05, 5


def knee_sd_C(record: Samples, model_V: FloatArray, empty_V: float) -> float:
    """
    Return the standard deviation of the charge that a record may still give beyond the knee of its model, C. Measured and
    modelled voltage are continued down to that of an empty cell, as they fall and bend at the end of the record. Half of the
    charge by which the measured one gets there later is in doubt: nothing, if the record goes down to it.

    :param record: a discharge
    :param model_V: voltage of the fitted model at its samples, NaN where the model cell is empty
    :param empty_V: voltage of an empty cell, V; 2.7 V if that is lower
    """
    drawn_C = integrate_load(record.time_s, record.current_A, record.time_s)
    load_A = record.current_A[np.flatnonzero(is_load(record.current_A))[-1]]
    # voltages are compared under the load of the end
    is_end = np.isfinite(model_V) & (np.abs(record.current_A - load_A) < SWITCH_SHARE * abs(load_A))
    samples = np.flatnonzero(is_end)
    count = max(int((drawn_C[samples] > (1.0 - _END_SHARE) * drawn_C[-1]).sum()), _LEAST_SAMPLES)
    samples = samples[-count:]
    fall_V = float(record.voltage_V[samples[-1]]) - min(empty_V, CUT_OFF_V) if len(samples) else 0.0
    if len(samples) < _LEAST_SAMPLES or fall_V <= 0.0:
        return 0.0
    left_C = drawn_C[samples] - drawn_C[samples[-1]]
    more_C = [_charge_to_fall_C(left_C, each[samples], fall_V) for each in (record.voltage_V, model_V)]
    return 0.5 * max(min(more_C[0], drawn_C[-1]) - more_C[1], 0.0)


def _charge_to_fall_C(charge_C: FloatArray, voltage_V: FloatArray, fall_V: float) -> float:
    """The charge until a voltage has fallen, if slope and bend at the end stay as they are; one that bends up is straight."""
    span_C = -charge_C[0]
    _, slope_V, bend_V = polyfit(charge_C / span_C, voltage_V, 2)
    slope_V, bend_V = max(-slope_V, 0.0), max(-bend_V, 0.0)
    root_V = np.sqrt(slope_V**2 + 4.0 * bend_V * fall_V)
    return float(2.0 * fall_V * span_C / (slope_V + root_V)) if root_V > 0.0 else np.inf
