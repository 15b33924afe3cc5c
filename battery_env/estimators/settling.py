"""When an estimate counts as settled, and why not: shared by the calibrators that state an uncertainty."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from math import comb, expm1

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.electrochemistry import NEW_CELL, CellParameters, initial_state, voltage
from battery_env.estimators.gaps import NOT_DRAWN, UNSURE, Gap
from battery_env.records import SWITCH_SHARE

# Of estimates

#: An estimate is settled when its standard deviation is below this share of its value. That of ``r_o`` is wider: on a real
#: cell the error of the model divided by the current is a quarter of it already.
SETTLED_SHARES = {"q_mobile": 0.02, "r_o": 0.3}
#: A ``q_mobile`` is plausible within these multiples of the model cell's: its electrodes are those of a 2 Ah cell.
PLAUSIBLE_Q_SHARES = (0.2, 5.0)
#: The error of the model may be this much larger than stated before the residuals contradict it.
MISMATCH_MARGIN = 2.0
#: Where the noise is told from the residuals, their variance may exceed its by this share over the root of their number.
EXCESS_LIMIT_UNSTATED = 10.0
#: So many samples more than parameters tell how large the noise is.
SPARE_SAMPLES = 10
#: A prior contradicts the record beyond so many standard deviations of their difference. Within it, a prior of the settled
#: width moves no estimate by more than 5 %.
PRIOR_LIMIT_SD = 2.5

# Of the start

#: A full cell may rest so far below and above the model's voltage, V. Real ones of the bundled kind rest at 4.17 to 4.23 V,
#: the model's at 4.19 V, which falls by 11 mV with each percent of the charge: a cell that lacks 4 % or more is noticed.
FULL_REST_V = (0.04, 0.06)
#: A cell that was at rest at the first sample falls by at least half of its ohmic drop within this time, s. So does one whose
#: load is switched.
START_WINDOW_S = 20.0

# Of the sensors: does the voltage belong to the current?

# Least resistance of a cell, ohm, up to the q_mobile of a new one; larger cells of the same electrodes have a smaller one. The
# bundled cells show 0.105 ohm and more when the load is switched on, those of the tasks have 0.1 ohm and more.
_LEAST_RESISTANCE_OHM, _NEW_Q_C = 0.1, NEW_CELL.q_mobile
# Time constant with which the ohmic drop follows the current at most, s: cells may be twice as slow as the model's.
_FOLLOWS_S = 2.0 * NEW_CELL.to
#: Under a current that was steady for so long, s, the voltage of a cell does not rise by so much, V.
STEADY_S, RISE_V = 60.0, 0.05
#: Smaller changes of the current than this, A, hardly show in the voltage. Where a load falls in such steps, a rise of the
#: voltage by this resistance, ohm, says nothing.
LEAST_JUMP_A, MOST_RESISTANCE_OHM = 0.05, 0.6
#: A change of more than so many standard deviations of the noise is not noise.
NOISES = 8.0

#: Why a precision does not suffice, and what would help.
IMPRECISE = {
    "q_mobile": "q_mobile is not known to 2 % yet: the voltage shows it at the knee of the discharge, the more the lower the "
    "record goes. To the same cut-off, a smaller load or constants of the cell itself (fit_cell, --cell) tell more.",
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
NOT_FOLLOWED = "The current changes by {:.2f} A at {:.0f} s, and the voltage does not follow."
RISES = "The voltage rises by {:.2f} V at {:.0f} s, where the current stays as it was."
NOT_DRAWN_TEXT = (
    "No sample lies between {:.0f} s and {:.0f} s, and the voltage does not fall by what the {:.0f} C of that time would make "
    "it: the clock jumped, or the load was off. Mend the times, or give the rest as samples of no current."
)
UNSURE_TEXT = (
    "No sample lies between {:.0f} s and {:.0f} s, and the voltage does not tell whether the load was on: {:.0f} C are "
    "in doubt."
)
PRIOR_CONTRADICTED = "The prior of {} contradicts what the record says."
START_UNKNOWN = (
    "The record does not start with a minute at rest, whose voltage would tell the charge. Give the rest before the load, or "
    "state initial_soc."
)
SCALE_UNKNOWN = (
    "{} is known no better than what scales it and shows nowhere in the voltage: the gain of the current sensor "
    "(current_gain_sd) and the charge at the start (initial_soc)."
)
PRIOR_ALONE = "{} rests on its prior: the record alone does not determine it yet."
# The reasons why an estimate is not settled though nothing contradicts it
_ONLY_IMPRECISE = (
    *IMPRECISE.values(),
    *(text.format(name) for text in (SCALE_UNKNOWN, PRIOR_ALONE) for name in IMPRECISE),
)


@lru_cache(maxsize=64)
def rest_voltage_V(cell: CellParameters, soc: float = 1.0) -> float:
    """The voltage of a cell at rest."""
    return float(voltage(initial_state(cell=cell, soc=soc), cell=cell))


@njit(cache=True, error_model="numpy")
def least_resistance_ohm(q_mobile: float, r_o: float) -> float:
    """Return the least resistance that a cell can show: of those of other cells, of larger ones, and the estimate."""
    return max(min(_LEAST_RESISTANCE_OHM, _LEAST_RESISTANCE_OHM * _NEW_Q_C / q_mobile, r_o), 0.0)


@njit(cache=True, error_model="numpy")
def lagging_current_A(before_A: float, current_A: float, duration_s: float) -> float:
    """Return the current that the ohmic drop stands for after a while; it follows slowly."""
    return before_A + (before_A - current_A) * expm1(-duration_s / _FOLLOWS_S)


@njit(cache=True, error_model="numpy")
def change_to_follow_A(switched_A: float, current_A: float, lagging_A: float) -> float:
    """Return how much of a current step the ohmic drop must follow: little after a pulse too short for it to build up."""
    return max(min(current_A - lagging_A, max(switched_A, 0.0)), min(switched_A, 0.0))


@njit(cache=True, error_model="numpy")
def _changes_to_follow_A(time_s: FloatArray, current_A: FloatArray) -> FloatArray:
    # from each sample to the next one
    change_A, lagging_A = np.empty(len(time_s) - 1), 0.0
    for n in range(len(time_s) - 1):
        change_A[n] = change_to_follow_A(current_A[n + 1] - current_A[n], current_A[n + 1], lagging_A)
        lagging_A = lagging_current_A(lagging_A, current_A[n], time_s[n + 1] - time_s[n])
    return change_A


def start_reason(
    time_s: FloatArray,
    voltage_V: FloatArray,
    current_A: FloatArray,
    cell: CellParameters,
    initial_soc: float = 1.0,
    resistance_ohm: float = _LEAST_RESISTANCE_OHM,
    rested: bool = False,
) -> str:
    """
    Say why a record cannot start with a full cell, or with one of another charge. At rest its voltage tells. A first sample
    under load is corrected by the least ohmic drop that the cell can have: a full cell of a larger resistance cannot be told
    from one that lacks some charge.
    """
    rest_V = rest_voltage_V(cell, initial_soc)
    soon = time_s <= time_s[0] + START_WINDOW_S
    soon[1:2] = True
    first_V, first_A = float(voltage_V[0]), 0.0 if rested else float(current_A[0])
    most_A, least_V = float(current_A[soon].max()), float(voltage_V[soon].min())
    code = start_code(first_V, first_A, most_A, least_V, rest_V, resistance_ohm)
    return start_text(code, first_V, rest_V, initial_soc)


@njit(cache=True, error_model="numpy")
def start_code(first_V: float, first_A: float, most_A: float, least_V: float, rest_V: float, resistance_ohm: float) -> int:
    """Return which text of :func:`start_text` the first samples deserve; 0 if they can be those of a cell that rested."""
    drop_V = resistance_ohm * max(first_A, 0.0)
    low_V, high_V = rest_V - FULL_REST_V[0], rest_V + FULL_REST_V[1]
    if first_V > high_V:
        return 1
    if first_V >= low_V:
        return 0
    if first_A <= SWITCH_SHARE * most_A or first_V - least_V >= 0.5 * drop_V:
        return 2
    return 3 if first_V + drop_V < low_V else 0


def start_text(code: int, first_V: float, rest_V: float, initial_soc: float = 1.0) -> str:
    """Return the reason that a code of :func:`start_code` stands for."""
    if initial_soc == 1.0:
        what = "a full cell"
        advice = "Give the whole discharge of a full cell, with the rest before it, or state initial_soc (--initial-soc)."
    else:
        what, advice = f"a cell with {initial_soc:.0%} of its charge", "State another initial_soc (--initial-soc)."
    return (
        "",
        f"The record starts at {first_V:.2f} V, above the {rest_V:.2f} V of {what}: another kind of cell or sensor.",
        f"The record starts at rest at {first_V:.2f} V, where {what} shows {rest_V:.2f} V. {advice}",
        f"The record starts under load at {first_V:.2f} V, at which a cell need not be "
        + ("full" if initial_soc == 1.0 else what)
        + f": it rests at {rest_V:.2f} V then. {advice}",
        START_UNKNOWN,
    )[code]


def sensor_reason(
    time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray, resistance_ohm: float = _LEAST_RESISTANCE_OHM
) -> str:
    """Say why voltage and current do not belong to each other."""
    n, noise_V = np.arange(len(time_s)), NOISES * white_noise_V(voltage_V)
    # the last sample of the window that begins with each sample
    window = np.minimum(np.maximum(np.searchsorted(time_s, time_s + START_WINDOW_S, side="right"), n + 2), n[-1])
    record = time_s, voltage_V, current_A
    return _not_followed(*record, window, noise_V, resistance_ohm) or _rises(*record, window, noise_V)


def _not_followed(
    time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray, window: IntArray, noise_V: float, resistance_ohm: float
) -> str:
    # Where the load is switched and stays so, the voltage follows by at least half of the least ohmic drop, as far as that had
    # followed the load before.
    last, switched_A = len(time_s) - 1, np.diff(current_A)
    switches = np.flatnonzero(np.abs(switched_A) > SWITCH_SHARE * np.abs(current_A).max()) + 1
    to_follow_A = _changes_to_follow_A(time_s, current_A)
    for n, following in zip(switches, np.append(switches, last)[1:], strict=True):
        drop_V = 0.5 * resistance_ohm * to_follow_A[n - 1]
        after_V = voltage_V[n : window[n] + 1]
        if window[n] <= min(following, last - 1) and abs(drop_V) > noise_V:
            followed_V = voltage_V[n - 1] - (after_V.min() if drop_V > 0.0 else after_V.max())
            if followed_V / drop_V < 1.0:
                return NOT_FOLLOWED.format(switched_A[n - 1], time_s[n])
    return ""


def _rises(time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray, window: IntArray, noise_V: float) -> str:
    # The voltage does not rise while the current stays as it was.
    since_s = np.full(len(time_s), time_s[0])
    jumps = np.flatnonzero(np.abs(np.diff(current_A)) > min(SWITCH_SHARE * np.abs(current_A).max(), LEAST_JUMP_A)) + 1
    since_s[jumps] = time_s[jumps]
    steady = np.maximum.accumulate(since_s)[window[:-1]] <= time_s[:-1] - STEADY_S
    by_current_V = MOST_RESISTANCE_OHM * np.maximum(current_A[:-1] - current_A[window[:-1]], 0.0)
    rise_V = np.where(steady, voltage_V[window[:-1]] - voltage_V[:-1] - by_current_V, 0.0)
    highest = int(rise_V.argmax())
    return RISES.format(rise_V[highest], time_s[highest]) if rise_V[highest] > max(RISE_V, noise_V) else ""


def gap_reason(gaps: Sequence[Gap], verdict: int) -> str:
    """Say what gaps in a record leave open."""
    text = {NOT_DRAWN: NOT_DRAWN_TEXT, UNSURE: UNSURE_TEXT}[verdict]
    return next((text.format(*gap[:3]) for gap in gaps if gap.verdict == verdict), "")


def is_plausible(q_mobile: ArrayLike, cell: CellParameters) -> BoolArray:
    """Return whether a cell of the kind of the model can have some ``q_mobile``."""
    low, high = PLAUSIBLE_Q_SHARES
    share = np.asarray(q_mobile) / cell.q_mobile
    return np.asarray((share > low) & (share < high))


def white_noise_V(residual_V: FloatArray, order: int = 1) -> float:
    """
    Return the standard deviation of the white part of residuals: from their differences from sample to sample, which hardly
    hold what drifts, by the median, which leaves single wild samples aside.
    """
    return float(np.median(np.abs(np.diff(residual_V, order))) / (0.6745 * np.sqrt(comb(2 * order, order))))


def is_only_imprecise(reason: str) -> bool:
    """Return whether an estimate is not settled by its precision alone: nothing in the record contradicts it."""
    return reason.startswith(_ONLY_IMPRECISE)


def first_reason(conditions: Iterable[tuple[bool, str]]) -> str:
    """Return the reason of the first condition that holds."""
    return next((reason for holds, reason in conditions if holds), "")
