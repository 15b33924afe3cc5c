"""Stretches of a load that were not logged: whether the voltage says that their charge was drawn."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import NamedTuple

import numpy as np

from battery_env.arrays import FloatArray, IntArray
from battery_env.compiled import compiled
from battery_env.estimators.diagnosis.conditions import Condition, Diagnosis
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE

#: An interval between two samples is a gap where it is so many times longer than those before and after it, and what its load
#: draws in the time that is longer is above this share of ``q_mobile``.
GAP_RATIO, GAP_SHARE = 2.5, 0.005
#: Loggers that write a row on a change of voltage have intervals of all lengths. An interval is no gap if, among all intervals
#: under load in the order of their lengths, the one so many places before it is at least 1 / ``GAP_RATIO`` as long.
HABIT = 3
#: What the voltage says of a gap: that its charge was drawn, that it was not, or nothing.
DRAWN, NOT_DRAWN, UNSURE = range(3)

# The voltage beside a gap is looked at over as long as the gap, within these limits (s), and over so many samples at least.
_WINDOW_S, _SAMPLES = (60.0, 300.0), 5
# A drift of the model counts up to this share of its fall: a fit to a record whose clock jumped drifts beside the jump.
_MOST_DRIFT = 0.3
#: Where the charge was drawn, cell and model part across the gap by less than this share of the fall of the model. The second
#: one holds in the middle of a discharge, where the model knows less of the cell and nothing of what follows.
MOST_SHARE, MOST_SHARE_SO_FAR = 0.5, 0.7
# With so many standard deviations to spare it is a verdict.
_SURE_SD = 1.5
# Voltages are rounded, and no model is better than this, V: over a flat curve a short gap says nothing.
_RESOLUTION_V = 1e-3


class Gap(NamedTuple):
    """
    A stretch of a load that was not logged.

    :param start_s: time of the last sample before it, s
    :param end_s: time of the first sample after it, s
    :param charge_C: the charge that is in doubt, C
    :param verdict: ``DRAWN``, ``NOT_DRAWN`` or ``UNSURE``
    """

    start_s: float
    end_s: float
    charge_C: float
    verdict: int


@compiled
def doubtful_charge_C(before_s: float, duration_s: float, after_s: float, load_A: float, q_mobile: float) -> float:
    """Return the charge of an interval between two samples that is in doubt; 0 if the interval is no gap."""
    usual_s = max(before_s, after_s)
    charge_C = load_A * (duration_s - usual_s)
    is_gap = duration_s > GAP_RATIO * usual_s and load_A > REST_CURRENT_A and charge_C > GAP_SHARE * q_mobile
    return charge_C if is_gap else 0.0


@compiled
def verdict(missing_V: float, fall_V: float, sd_V: float, most_share: float) -> int:
    """
    Say whether the charge of a gap was drawn. The model falls across the gap by the charge that its current draws. A cell that
    was not loaded meanwhile, or whose clock jumped, does not.
    """
    if not fall_V > 0.0:
        return UNSURE
    if missing_V + _SURE_SD * sd_V < most_share * fall_V:
        return DRAWN
    if missing_V - _SURE_SD * hypot(sd_V, _RESOLUTION_V) > most_share * fall_V:
        return NOT_DRAWN
    return UNSURE


def long_intervals(time_s: FloatArray) -> IntArray:
    """Find the intervals that are so much longer than those beside them that they may be gaps."""
    step_s = np.diff(time_s)
    beside_s = np.pad(step_s, 1)
    return np.flatnonzero(step_s > GAP_RATIO * np.maximum(beside_s[:-2], beside_s[2:]))


def find_gaps(
    time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray, model_V: FloatArray, q_mobile: float
) -> list[Gap]:
    """Find the gaps of a record. The model errs too: what it drifts from the cell beside a gap it may drift within it."""
    gaps: list[Gap] = []
    step_s, long = np.diff(time_s), long_intervals(time_s)
    if not len(long):
        return gaps
    beside_s, unusual_s = np.pad(step_s, 1), _unusual_s(step_s, current_A)
    for n in long:
        usual_s = max(beside_s[n], beside_s[n + 2])
        load_A = float(np.abs(current_A[n : n + 2]).max())
        charge_C = doubtful_charge_C(beside_s[n], step_s[n], beside_s[n + 2], load_A, q_mobile)
        if not charge_C or not ((unusual_s > usual_s) & (unusual_s <= step_s[n])).any():
            continue
        said = _said(n, usual_s, time_s, voltage_V - model_V, float(model_V[n] - model_V[n + 1]))
        # one that varies beside the gap, over as long as the gap, varied in it
        first = max(int(np.searchsorted(time_s, time_s[n] - step_s[n])), min(n, 1))
        last = int(np.searchsorted(time_s, time_s[n + 1] + step_s[n], side="right"))
        if np.ptp(current_A[first:last]) > SWITCH_SHARE * load_A:
            said = UNSURE  # the load was switched, nobody knows when
        gaps.append(Gap(float(time_s[n]), float(time_s[n + 1]), float(charge_C), said))
    # where some were drawn, others as long are the habit of the logger, too
    drawn_s = sorted(gap.end_s - gap.start_s for gap in gaps if gap.verdict == DRAWN)
    habit_s = GAP_RATIO * drawn_s[-HABIT] if len(drawn_s) >= HABIT else 0.0
    return [gap for gap in gaps if gap.verdict != UNSURE or gap.end_s - gap.start_s > habit_s]


def note_gaps(diagnosis: Diagnosis, gaps: Sequence[Gap], doubt_counts: bool = True) -> None:
    """Note the first gap whose charge was not drawn, and the first one that leaves it in doubt, if a doubt counts."""
    for start_s, end_s, charge_C, said in gaps:
        diagnosis.note(Condition.NOT_DRAWN, said == NOT_DRAWN, since_s=start_s, fault_s=end_s, size=charge_C)
        in_doubt = said == UNSURE and doubt_counts
        diagnosis.note(Condition.GAP_UNSURE, in_doubt, gap_start_s=start_s, gap_end_s=end_s, gap_C=charge_C)


def _said(n: int, usual_s: float, time_s: FloatArray, parted_V: FloatArray, fall_V: float) -> int:
    """What the voltage says of the gap after sample n, across which the model falls by ``fall_V``."""
    duration_s = time_s[n + 1] - time_s[n]
    window_s = max(float(np.clip(duration_s, *_WINDOW_S)), 2.0 * _SAMPLES * usual_s)
    # the first voltage may be that of the rest before the load
    first = max(int(np.searchsorted(time_s, time_s[n] - window_s)), 1)
    last = int(np.searchsorted(time_s, time_s[n + 1] + window_s, side="right"))
    before_V, before_slope, before_sd_V = _edge(time_s[first : n + 1], parted_V[first : n + 1], time_s[n])
    after_V, after_slope, after_sd_V = _edge(time_s[n + 1 : last], parted_V[n + 1 : last], time_s[n + 1])
    # by what they drift on both sides alike they may drift in between
    slope = min(before_slope, after_slope, key=abs) if before_slope * after_slope > 0.0 else 0.0
    drift_V = slope * duration_s
    allowed_V = min(max(drift_V, 0.0), _MOST_DRIFT * max(fall_V, 0.0))
    missing_V = after_V - before_V
    missing_V -= float(np.clip(missing_V, min(drift_V, 0.0), allowed_V))
    return int(verdict(missing_V, fall_V, float(np.hypot(before_sd_V, after_sd_V)), MOST_SHARE))


def _unusual_s(step_s: FloatArray, current_A: FloatArray) -> FloatArray:
    """Lengths of intervals under load that are no habit of the logger, in their order, s."""
    loaded = np.maximum(np.abs(current_A[:-1]), np.abs(current_A[1:])) > REST_CURRENT_A
    length_s = np.sort(step_s[loaded])
    shorter_s = np.pad(length_s, (HABIT, 0))[: len(length_s)]
    return np.asarray(length_s[length_s > GAP_RATIO * shorter_s])


def _edge(time_s: FloatArray, voltage_V: FloatArray, edge_s: float) -> tuple[float, float, float]:
    """Fit a straight line: value at a time, slope, and standard deviation of the value."""
    n = len(time_s)
    if n < _SAMPLES:
        return 0.0, 0.0, np.nan
    since_s = time_s - time_s.mean()
    square_s2 = float(since_s @ since_s)
    slope = float(since_s @ voltage_V) / square_s2
    rest_V = voltage_V - voltage_V.mean() - slope * since_s
    distance_s = edge_s - float(time_s.mean())
    sd_V = np.sqrt(float(rest_V @ rest_V) / (n - 2) * (1.0 / n + distance_s**2 / square_s2))
    return float(voltage_V.mean()) + slope * distance_s, slope, float(sd_V)
