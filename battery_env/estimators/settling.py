"""When an estimate counts as settled, and why not: shared by the calibrators that state an uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import BoolArray, FloatArray
from battery_env.electrochemistry import CellParameters, initial_state, voltage
from battery_env.records import SWITCH_SHARE

#: An estimate counts as settled when its standard deviation is below this share of its value. That of ``r_o`` is wider: on a
#: real cell the error of the model divided by the current is a quarter of it already.
SETTLED_SHARES = {"q_mobile": 0.02, "r_o": 0.3}

#: How far below and above the model's voltage a full cell may rest, V. Real full cells of the bundled kind rest at 4.17 to
#: 4.23 V, the model's at 4.19 V; at rest it falls by 11 mV with each percent of the charge, so that a cell that lacks 4 % or
#: more is noticed.
FULL_REST_V = (0.04, 0.06)
#: A cell has at least this resistance, ohm: the bundled ones show 0.105 ohm and more when the load is switched on, and those
#: of the tasks have 0.1 ohm and more. A first voltage under load is corrected by no more than that.
LEAST_RESISTANCE_OHM = 0.1
#: The voltage of a cell that was at rest at the first sample falls by at least half of its ohmic drop within this time, s.
START_WINDOW_S = 20.0

# Under a current that has been steady for this long, s, the voltage of a cell does not rise by this much, V.
_STEADY_S, _RISE_V = 60.0, 0.05
# What is more than this many standard deviations of the noise is not noise.
_NOISES = 8.0

#: A ``q_mobile`` is plausible within these multiples of the model cell's: its electrodes are those of a 2 Ah cell.
PLAUSIBLE_Q_SHARES = (0.2, 5.0)
#: A prior farther from what the record says than this many standard deviations of their difference contradicts it. Within it,
#: a prior of the settled width moves no estimate by more than 5 %.
PRIOR_LIMIT_SD = 2.5
#: The error of the model may be this much larger than stated before the residuals contradict it.
MISMATCH_MARGIN = 2.0

#: Why a precision does not suffice, and what would help.
IMPRECISE = {
    "q_mobile": "q_mobile is not known to 2 % yet: the voltage shows it at the knee of the discharge. Record on.",
    "r_o": "r_o is not known to 30 %: the error expected of noise and model, divided by the current, is larger. A larger "
    "current, or a smaller mismatch_V if the model is that good, tells more.",
}
AT_BOUND = "{} is at a bound of its search, where the record does not determine it."
EMPTY = "The model cell is empty before the record ends: its q_mobile is too small for this record."
IMPLAUSIBLE = (
    "No cell of this kind has such a q_mobile. Check that time is in s and current in A, and that the record is of one cell."
)
MISFIT = (
    "The voltage of the model is farther off than noise and mismatch_V explain: state a larger mismatch_V, or check the "
    "sensors and that this is one discharge."
)
PRIOR_CONTRADICTED = "The prior of {} contradicts what the record says."
PRIOR_ALONE = "{} rests on its prior: the record alone does not determine it yet."


def start_reason(time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray, cell: CellParameters) -> str:
    """
    Whether a record can start with a full cell. At rest its voltage tells. A first sample under load is corrected by the least
    ohmic drop that a cell can have: a full cell of a larger resistance cannot be told from one that lacks some charge.

    :param time_s: times of the samples, s, shape (T,), T >= 1; those of the first 20 s suffice
    :param voltage_V: V, shape (T,)
    :param current_A: positive in discharge, A, shape (T,)
    :param cell: constants of the model
    :return: why it cannot, or cannot be told to; empty if it can
    """
    full_V = float(voltage(initial_state(cell=cell), cell=cell))
    first_V, drop_V = float(voltage_V[0]), LEAST_RESISTANCE_OHM * max(float(current_A[0]), 0.0)
    low_V, high_V = full_V - FULL_REST_V[0], full_V + FULL_REST_V[1]
    if first_V > high_V:
        return (
            f"The record starts at {first_V:.2f} V, above the {full_V:.2f} V of a full cell: another kind of cell or sensor."
        )
    if first_V >= low_V:
        return ""
    advice = "Give the whole discharge of a full cell, with the rest before it."
    soon = time_s <= time_s[0] + START_WINDOW_S
    soon[1:2] = True
    at_rest = current_A[0] <= SWITCH_SHARE * current_A[soon].max() or first_V - voltage_V[soon].min() >= 0.5 * drop_V
    if at_rest:
        return f"The record starts at rest at {first_V:.2f} V, where a full cell shows {full_V:.2f} V. {advice}"
    if first_V + drop_V < low_V:
        return (
            f"The record starts under load at {first_V:.2f} V, at which a cell need not be full: it rests at {full_V:.2f} V "
            f"then. {advice}"
        )
    return ""


def sensor_reason(time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray) -> str:
    """
    Whether voltage and current belong to each other. Where the load is switched and stays so, the voltage follows by at least
    half of the least ohmic drop; and it does not rise while the current stays as it was.

    :param time_s: times of the samples, s, shape (T,), T >= 2
    :param voltage_V: V, shape (T,)
    :param current_A: positive in discharge, A, shape (T,)
    :return: where they do not; empty if they do
    """
    last = len(time_s) - 1
    noise_V = _NOISES * white_noise_V(voltage_V)
    switched_A = np.diff(current_A)
    switches = np.flatnonzero(np.abs(switched_A) > SWITCH_SHARE * np.abs(current_A).max()) + 1
    until = np.minimum(
        np.maximum(np.searchsorted(time_s, time_s + START_WINDOW_S, side="right"), np.arange(last + 1) + 2), last
    )
    for n, following in zip(switches, np.append(switches, last)[1:], strict=True):
        drop_V = 0.5 * LEAST_RESISTANCE_OHM * switched_A[n - 1]
        after_V = voltage_V[n : until[n] + 1]
        if until[n] <= min(following, last - 1) and abs(drop_V) > noise_V:
            followed_V = voltage_V[n - 1] - (after_V.min() if drop_V > 0.0 else after_V.max())
            if followed_V / drop_V < 1.0:
                return (
                    f"The current changes by {switched_A[n - 1]:.2f} A at {time_s[n]:.0f} s, and the voltage does not follow."
                )
    since_s = np.full(last + 1, time_s[0])
    since_s[switches] = time_s[switches]
    steady = np.maximum.accumulate(since_s)[until[:-1]] <= time_s[:-1] - _STEADY_S
    rise_V = np.where(steady, voltage_V[until[:-1]] - voltage_V[:-1], 0.0)
    highest = int(rise_V.argmax())
    if rise_V[highest] > max(_RISE_V, noise_V):
        return f"The voltage rises by {rise_V[highest]:.2f} V at {time_s[highest]:.0f} s, where the current stays as it was."
    return ""


def is_plausible(q_mobile: ArrayLike, cell: CellParameters) -> BoolArray:
    """
    Whether a cell of the kind of the model can have some ``q_mobile``.

    :param q_mobile: C, any shape
    :param cell: constants of the model
    :return: same shape
    """
    low, high = PLAUSIBLE_Q_SHARES
    share = np.asarray(q_mobile) / cell.q_mobile
    return np.asarray((share > low) & (share < high))


def white_noise_V(residual_V: FloatArray) -> float:
    """
    The standard deviation of the white part of residuals, from their differences from sample to sample, which hardly hold
    what drifts. The median leaves single wild samples aside.

    :param residual_V: V, shape (T,), T >= 2
    :return: V
    """
    return float(np.median(np.abs(np.diff(residual_V))) / (0.6745 * np.sqrt(2.0)))


def data_sd(sd: ArrayLike, prior_sd: float) -> FloatArray:
    """
    The standard deviation that the data alone give: precisions add up.

    :param sd: of prior and data together, any shape
    :param prior_sd: of the prior
    :return: same shape; infinite where the data add nothing
    """
    more = np.asarray(sd, dtype=np.float64) ** -2.0 - prior_sd**-2.0
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(more, 0.0) ** -0.5)


def first_reason(conditions: Sequence[tuple[bool, str]]) -> str:
    """
    The reason of the first condition that holds.

    :param conditions: each with its reason
    :return: empty if none holds
    """
    return next((reason for holds, reason in conditions if holds), "")
