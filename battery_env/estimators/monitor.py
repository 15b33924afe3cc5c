"""What speaks against the estimates of a filter: its samples are watched as they come in, compiled (numba)."""

from __future__ import annotations

from math import expm1, hypot, inf, isnan, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from battery_env.arrays import FloatArray, IntArray
from battery_env.estimators.gaps import DRAWN, GAP_RATIO, HABIT, MOST_SHARE_SO_FAR, NOT_DRAWN, doubtful_charge_C, verdict
from battery_env.estimators.kalman_bank import LIMIT_SD
from battery_env.estimators.settling import (
    AT_BOUND,
    EMPTY,
    FULL_REST_V,
    IMPLAUSIBLE,
    IMPRECISE,
    LEAST_JUMP_A,
    MISFIT,
    MOST_RESISTANCE_OHM,
    NOISES,
    NOT_DRAWN_TEXT,
    NOT_FOLLOWED,
    PRIOR_ALONE,
    PRIOR_CONTRADICTED,
    PRIOR_LIMIT_SD,
    RISE_V,
    RISES,
    SCALE_UNKNOWN,
    SETTLED_SHARES,
    START_WINDOW_S,
    STEADY_S,
    UNSURE_TEXT,
    change_to_follow_A,
    lagging_current_A,
    least_resistance_ohm,
    start_code,
    start_text,
)
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE

# The data must have narrowed a prior by this share of its width before a deviation from it says anything.
_LEAST_NARROWING = 0.2
# A cell from which this share of its charge was drawn does not come back to the voltage of its first sample without a charge.
_RECOVERY_SHARE = 0.2
# The least standard deviation of q_mobile that the error of the model leaves is not taken to be above this share: a discharge
# whose knee the filter has not seen has a larger one of its own.
_MOST_LEAST_SHARE = 0.5 * SETTLED_SHARES["q_mobile"]
# A load that was switched for at least this long, s, and this many samples shows in the voltage: the ohmic drop of the model
# comes to 80 % in 10 s.
_LEAST_PULSE_S, _LEAST_PULSE_SAMPLES = 10.0, 3
# The middle one of three samples has this share of their noise.
_SMOOTHED_SHARE = 0.67
# Voltages are kept about this far apart, s; as many of them as below cover the window in which a voltage may not rise.
_KEPT_EVERY_S = 0.9
_KEPT = 32
# What model and cell part by is averaged over about so many samples before a gap, and how fast the voltage falls over so long,
# s; after it the middle voltage of three counts.
_PARTED_MEMORY, _RATE_MEMORY_S, _PARTED_SAMPLES = 8.0, 100.0, 3
# Standard deviation of the difference of both, as a share of the noise.
_PARTED_NOISE_SHARE = 0.72

# What a monitor remembers: number and time of the samples (s); voltage and current of the first one; the largest current and
# the least voltage within the start window; the two voltages before the one at hand, and time and current of the last of them;
# how many samples were examined, and the last one; the current that the ohmic drop stands for then; the largest magnitude of
# the current; of the last switch of the load its time, its size (A), the part of it that the voltage has to follow, the
# voltage before it, the least and greatest one since, and how many samples; how many voltages were
# kept; the time of the last jump of the current; how many changes of the voltage were kept; the fault that was found, its time
# and its size, and since when; whether the first sample is known to be of a cell at rest. Of gaps: the last interval (s), the
# current since (A), the voltage that was expected last, by how much cell and model part (V) and how fast the voltage falls
# (V/s), in the mean; of the last gap its length (s), the time after it, its charge (C), the fall of the model, the voltage of
# the model after it, the first two voltages then (V), and how many were seen; the charge in doubt (C); and the longest
# intervals under load that were not in doubt, in their order (s).
(
    _SAMPLES,
    _TIME,
    _FIRST_V,
    _FIRST_A,
    _MOST_A,
    _LEAST_V,
    _VOLTAGE_2,
    _VOLTAGE_1,
    _TIME_1,
    _CURRENT_1,
    _EXAMINED,
    _LAST_S,
    _LAST_V,
    _LAST_A,
    _LAGGING_A,
    _LARGEST_A,
    _SWITCH_S,
    _SWITCHED_A,
    _TO_FOLLOW_A,
    _BEFORE_V,
    _LOW_V,
    _HIGH_V,
    _SINCE,
    _N_KEPT,
    _JUMP_S,
    _N_CHANGES,
    _FAULT,
    _FAULT_S,
    _FAULT_SIZE,
    _FAULT_SINCE_S,
    AT_REST,
    _INTERVAL_S,
    _LOAD_A,
    _EXPECTED_V,
    _PARTED_V,
    _RATE_V,
    _GAP_S,
    _GAP_END_S,
    _GAP_C,
    _GAP_FALL_V,
    _GAP_MODEL_V,
    _GAP_AFTER_V,
    _GAP_NEXT_V,
    _GAP_COUNT,
    _DOUBT_C,
    _LONGEST_S,
) = range(46)
_SIZE = _LONGEST_S + HABIT

#: Codes of what was found, in the order in which they count. 1 .. 4 are those of :func:`~.settling.start_code`.
(
    SETTLED,
    _START_ABOVE,
    _START_BELOW,
    _START_LOADED,
    _START_UNKNOWN,
    _RECOVERED,
    _NOT_FOLLOWED,
    _RISES,
    _NOT_DRAWN,
    _EMPTY,
    _Q_AT_BOUND,
    _R_AT_BOUND,
    _IMPLAUSIBLE,
    _MISFIT,
    _Q_PRIOR_WRONG,
    _Q_PRIOR_ALONE,
    _R_PRIOR_WRONG,
    _R_PRIOR_ALONE,
    _GAP_UNSURE,
    _Q_IMPRECISE,
    _R_IMPRECISE,
    _Q_SCALE_UNKNOWN,
    _R_SCALE_UNKNOWN,
) = range(23)

_Q_SHARE, _R_SHARE = SETTLED_SHARES["q_mobile"], SETTLED_SHARES["r_o"]

_compiled = njit(cache=True, error_model="numpy")


class Limits(NamedTuple):
    """
    What the monitor of a filter is told.

    :param start_V: voltage that the first sample is to have at rest, V
    :param needs_rest: whether the charge at the start was told from a rest, so that the record has to begin with one
    :param rested: whether it did
    :param searched: whether ``q_mobile`` and ``r_o`` are searched for, 1 or 0, shape (2,)
    :param bounds: of both, shape (2, 2)
    :param prior: means and standard deviations of what was carried over from an earlier discharge, NaN where nothing was,
        shape (2, 2)
    :param scale_sd: standard deviations of what scales both and does not show in the voltage, as shares, shape (2,)
    :param plausible_C: between which ``q_mobile`` can lie, shape (2,)
    :param cell_q_mobile: of the model's cell, C
    """

    start_V: float
    needs_rest: bool
    rested: bool
    searched: FloatArray
    bounds: FloatArray
    prior: FloatArray
    scale_sd: FloatArray
    plausible_C: FloatArray
    cell_q_mobile: float


class Monitor(NamedTuple):
    """
    What the samples so far showed.

    :param memory: shape (48,)
    :param kept: times, s, voltages, V, and currents, A, of some samples, the last ones, in a ring, shape (3, 32)
    :param changes: magnitudes of the last changes of the voltage from sample to sample, in a ring, V, shape (32,)
    """

    memory: FloatArray
    kept: FloatArray
    changes: FloatArray

    @classmethod
    def new(cls) -> Monitor:
        """Before the first sample."""
        return cls(np.zeros(_SIZE), np.zeros((3, _KEPT)), np.zeros(_KEPT))

    def texts(self, start_V: float, initial_soc: float, clock_s: float = 0.0) -> list[str]:
        """The reasons that the codes stand for."""
        memory = self.memory
        since_s, fault_s, gap_end_s = (clock_s + float(memory[n]) for n in (_FAULT_SINCE_S, _FAULT_S, _GAP_END_S))
        first_V, size = float(memory[_FIRST_V]), float(memory[_FAULT_SIZE])
        return [
            "",
            *(start_text(code, first_V, start_V, initial_soc) for code in range(1, 5)),
            f"The voltage comes back to that of the start at {fault_s:.0f} s, though {size:.0f} C were drawn: the cell was "
            "charged. Reset the filter when a discharge begins.",
            NOT_FOLLOWED.format(size, fault_s),
            RISES.format(size, fault_s),
            NOT_DRAWN_TEXT.format(since_s, fault_s, size),
            EMPTY,
            AT_BOUND.format("q_mobile"),
            AT_BOUND.format("r_o"),
            IMPLAUSIBLE,
            MISFIT,
            PRIOR_CONTRADICTED.format("q_mobile"),
            PRIOR_ALONE.format("q_mobile"),
            PRIOR_CONTRADICTED.format("r_o"),
            PRIOR_ALONE.format("r_o"),
            UNSURE_TEXT.format(gap_end_s - float(memory[_GAP_S]), gap_end_s, float(memory[_GAP_C])),
            IMPRECISE["q_mobile"],
            IMPRECISE["r_o"],
            SCALE_UNKNOWN.format("q_mobile"),
            SCALE_UNKNOWN.format("r_o"),
        ]


@_compiled
def _noise_V(monitor: Monitor) -> float:
    # what is more than noise; infinite as long as there are too few samples to tell
    n = min(int(monitor.memory[_N_CHANGES]), _KEPT)
    if n < _KEPT // 4:
        return inf
    return NOISES * _SMOOTHED_SHARE * float(np.median(monitor.changes[:n])) / (0.6745 * sqrt(2.0))


@_compiled
def _find(monitor: Monitor, fault: int, time_s: float, size: float) -> None:
    # the first one is kept
    if monitor.memory[_FAULT] == 0.0:
        monitor.memory[_FAULT], monitor.memory[_FAULT_S], monitor.memory[_FAULT_SIZE] = fault, time_s, size


@_compiled
def _conclude_switch(monitor: Monitor, resistance_ohm: float) -> None:
    # whether the voltage followed the last switch of the load by half of the least ohmic drop
    m = monitor.memory
    drop_V = 0.5 * resistance_ohm * m[_TO_FOLLOW_A]
    if abs(drop_V) > _noise_V(monitor):
        followed_V = m[_BEFORE_V] - (m[_LOW_V] if drop_V > 0.0 else m[_HIGH_V])
        if followed_V / drop_V < 1.0:
            _find(monitor, _NOT_FOLLOWED, m[_SWITCH_S], m[_SWITCHED_A])
    m[_SWITCHED_A] = 0.0


@_compiled
def _examine(
    monitor: Monitor, time_s: float, voltage: float, current: float, drawn_C: float, q: float, r_o: float, limits: Limits
) -> None:
    # One sample whose voltage is no single wild one
    m, kept = monitor.memory, monitor.kept
    resistance_ohm = least_resistance_ohm(q, r_o)
    switched_A = current - m[_LAST_A]
    m[_LARGEST_A] = max(m[_LARGEST_A], abs(current))
    if m[_EXAMINED] > 0.0:
        if abs(switched_A) > min(SWITCH_SHARE * m[_LARGEST_A], LEAST_JUMP_A):
            m[_JUMP_S] = time_s
        if abs(switched_A) > SWITCH_SHARE * m[_LARGEST_A]:
            if m[_SWITCHED_A] != 0.0 and time_s - m[_SWITCH_S] >= _LEAST_PULSE_S and m[_SINCE] >= _LEAST_PULSE_SAMPLES:
                _conclude_switch(monitor, resistance_ohm)
            m[_SWITCH_S], m[_SWITCHED_A], m[_BEFORE_V] = time_s, switched_A, m[_LAST_V]
            m[_TO_FOLLOW_A] = change_to_follow_A(switched_A, current, m[_LAGGING_A])
            m[_LOW_V], m[_HIGH_V], m[_SINCE] = inf, -inf, 0.0
        m[_LAGGING_A] = lagging_current_A(m[_LAGGING_A], m[_LAST_A], time_s - m[_LAST_S])
    else:
        m[_SWITCH_S] = m[_JUMP_S] = time_s
    if m[_SWITCHED_A] != 0.0:
        m[_LOW_V], m[_HIGH_V] = min(m[_LOW_V], voltage), max(m[_HIGH_V], voltage)
        m[_SINCE] += 1.0
        if time_s - m[_SWITCH_S] > START_WINDOW_S and m[_SINCE] >= _LEAST_PULSE_SAMPLES:
            _conclude_switch(monitor, resistance_ohm)
    # the voltage a little more than the window ago, under a current that has been steady since long before
    n_kept = int(m[_N_KEPT])
    for back in range(2, min(n_kept, _KEPT) + 1):
        since_s = time_s - kept[0, (n_kept - back) % _KEPT]
        if since_s > START_WINDOW_S:
            rise_V = voltage - kept[1, (n_kept - back) % _KEPT]
            rise_V -= MOST_RESISTANCE_OHM * max(kept[2, (n_kept - back) % _KEPT] - current, 0.0)
            if rise_V > RISE_V and time_s - since_s - m[_JUMP_S] >= STEADY_S and rise_V > _noise_V(monitor):
                _find(monitor, _RISES, time_s - since_s, rise_V)
            break
    if n_kept == 0 or time_s - kept[0, (n_kept - 1) % _KEPT] >= _KEPT_EVERY_S:
        kept[0, n_kept % _KEPT], kept[1, n_kept % _KEPT], kept[2, n_kept % _KEPT] = time_s, voltage, current
        m[_N_KEPT] += 1.0
    # under a steady load the voltage at rest is higher by the ohmic drop at least; a charge that is seen raises it
    drop_V = resistance_ohm * max(current, 0.0) if time_s - m[_SWITCH_S] > START_WINDOW_S else 0.0
    is_high = voltage + drop_V > limits.start_V - FULL_REST_V[0] and min(current, m[_LAGGING_A]) >= -REST_CURRENT_A
    if is_high and drawn_C > _RECOVERY_SHARE * max(q, limits.cell_q_mobile):
        _find(monitor, _RECOVERED, time_s, drawn_C)
    m[_EXAMINED] += 1.0
    m[_LAST_S], m[_LAST_V], m[_LAST_A] = time_s, voltage, current


@_compiled
def _start(monitor: Monitor, voltage: float, current: float, resistance_ohm: float, limits: Limits) -> int:
    m = monitor.memory
    if m[_SAMPLES] == 1.0:
        m[_FIRST_V], m[_FIRST_A], m[_MOST_A], m[_LEAST_V] = voltage, current, current, voltage
        if m[AT_REST] != 0.0:
            m[_FIRST_A] = 0.0
    elif m[_SAMPLES] == 2.0 or m[_TIME] <= START_WINDOW_S:
        m[_MOST_A] = max(m[_MOST_A], current)
        if not isnan(voltage):
            m[_LEAST_V] = min(m[_LEAST_V], voltage)
    if limits.needs_rest and not limits.rested:
        return _START_UNKNOWN
    return int(start_code(m[_FIRST_V], m[_FIRST_A], m[_MOST_A], m[_LEAST_V], limits.start_V, resistance_ohm))


@_compiled
def _middle(a: float, b: float, c: float) -> float:
    return max(min(a, b), min(max(a, b), c))


@_compiled
def _note_interval(monitor: Monitor, interval_s: float, load_A: float) -> None:
    # one that was no gap, or whose charge was drawn
    longest_s = monitor.memory[_LONGEST_S:]
    if interval_s > longest_s[0] and load_A > REST_CURRENT_A:
        longest_s[0] = interval_s
        longest_s.sort()


@_compiled
def _follow_gaps(monitor: Monitor, voltage: float, expected: float, current: float, duration: float, q: float) -> None:
    # One sample that is not the first. A gap is pending from its end until the voltages after it were seen.
    m = monitor.memory
    load_A = max(abs(m[_LOAD_A]), abs(current))
    if m[_GAP_COUNT] > 0.0 and m[_GAP_S] <= GAP_RATIO * duration and m[_TIME] - duration == m[_GAP_END_S]:
        m[_GAP_COUNT] = 0.0  # the samples are as far apart from now on
    charge_C = 0.0
    if duration > GAP_RATIO * m[_LONGEST_S]:  # else the logger has a habit of it
        charge_C = doubtful_charge_C(m[_INTERVAL_S], duration, 0.0, load_A, q)
    if charge_C == 0.0:
        _note_interval(monitor, duration, min(abs(m[_LOAD_A]), abs(current)))
    if charge_C > 0.0:
        if m[_GAP_COUNT] > 0.0:
            m[_DOUBT_C] += m[_GAP_C]
        m[_GAP_S], m[_GAP_END_S], m[_GAP_C], m[_GAP_COUNT] = duration, m[_TIME], charge_C, 1.0
        # the filter gives way to the samples after a gap, so that these are compared with what it had expected before
        m[_GAP_FALL_V] = m[_EXPECTED_V] - expected
        if m[_TIME] - duration - m[_JUMP_S] >= STEADY_S:
            # a model whose q_mobile is not known yet may take its cell for empty: the voltage falls at least as it did before
            m[_GAP_FALL_V] = min(m[_GAP_FALL_V], m[_RATE_V] * duration)
        m[_GAP_MODEL_V] = m[_EXPECTED_V] + m[_PARTED_V] - m[_GAP_FALL_V]
        m[_GAP_AFTER_V] = voltage
        if isnan(voltage) or abs(current - m[_LOAD_A]) > SWITCH_SHARE * load_A:
            m[_GAP_FALL_V] = 0.0  # which leaves it in doubt
    elif m[_GAP_COUNT] > 0.0 and not isnan(voltage):
        m[_GAP_COUNT] += 1.0
        if m[_GAP_COUNT] < _PARTED_SAMPLES:
            m[_GAP_NEXT_V] = voltage
            # by how much it falls from one sample to the next
            m[_GAP_MODEL_V] -= m[_GAP_FALL_V] * (m[_TIME] - m[_GAP_END_S]) / m[_GAP_S]
        else:
            after_V = _middle(m[_GAP_AFTER_V], m[_GAP_NEXT_V], voltage)
            sd_V = _PARTED_NOISE_SHARE * _noise_V(monitor) / (NOISES * _SMOOTHED_SHARE)
            said = verdict(after_V - m[_GAP_MODEL_V], m[_GAP_FALL_V], sd_V, MOST_SHARE_SO_FAR)
            if said == DRAWN:
                _note_interval(monitor, m[_GAP_S], load_A)
            else:
                m[_DOUBT_C] += m[_GAP_C]
            if said == NOT_DRAWN and m[_FAULT] == 0.0:
                m[_FAULT_SINCE_S] = m[_GAP_END_S] - m[_GAP_S]
                _find(monitor, _NOT_DRAWN, m[_GAP_END_S], m[_GAP_C])
            m[_GAP_COUNT] = 0.0
    if m[_GAP_COUNT] == 0.0 and not isnan(voltage):
        m[_PARTED_V] += (voltage - expected - m[_PARTED_V]) / min(m[_SAMPLES] - 1.0, _PARTED_MEMORY)
    if not isnan(voltage):
        m[_EXPECTED_V] = expected
        if charge_C == 0.0 and m[_SAMPLES] > 2.0:
            m[_RATE_V] += -expm1(-duration / _RATE_MEMORY_S) * ((m[_VOLTAGE_1] - voltage) / duration - m[_RATE_V])
    m[_INTERVAL_S] = duration


@_compiled
def _verdict(row: FloatArray, own_sd: tuple[float, float], doubt_C: float, limits: Limits) -> int:
    # why the estimate of a row is not settled
    if row[4] == 0.0:
        return _EMPTY
    for k in range(2):
        low, high = limits.bounds[k]
        if limits.searched[k] and not low + own_sd[k] < row[k] < high - own_sd[k]:
            return _Q_AT_BOUND + k
    if limits.searched[0] and not limits.plausible_C[0] < row[0] < limits.plausible_C[1]:
        return _IMPLAUSIBLE
    if row[5] > LIMIT_SD:
        return _MISFIT
    shares = (_Q_SHARE, _R_SHARE)
    for k in range(2):
        mean, prior_sd = limits.prior[k]
        if not isnan(mean):
            narrowed = max(prior_sd**2 - own_sd[k] ** 2, (_LEAST_NARROWING * prior_sd) ** 2)
            if (row[k] - mean) ** 2 > PRIOR_LIMIT_SD**2 * narrowed:
                return _Q_PRIOR_WRONG + 2 * k
            # precisions add up
            of_data = max(own_sd[k] ** -2.0 - prior_sd**-2.0, 0.0) ** -0.5
            if of_data >= shares[k] * row[k]:
                return _Q_PRIOR_ALONE + 2 * k
    if limits.searched[0] and hypot(row[2], doubt_C) >= _Q_SHARE * row[0] > row[2]:
        return _GAP_UNSURE
    for k in range(2):
        if limits.searched[k] and not row[2 + k] < shares[k] * row[k]:
            return (_Q_IMPRECISE if limits.scale_sd[k] < shares[k] else _Q_SCALE_UNKNOWN) + k
    return SETTLED


@_compiled
def watch(
    monitor: Monitor,
    voltage: FloatArray,
    current: FloatArray,
    duration: FloatArray,
    drawn_C: FloatArray,
    limits: Limits,
    out: FloatArray,
    codes: IntArray,
) -> None:
    """Judge estimates by the samples that they come from; unchecked."""
    m = monitor.memory
    for n in range(voltage.shape[0]):
        m[_SAMPLES] += 1.0
        m[_TIME] += duration[n]
        if m[_SAMPLES] > 1.0 and not isnan(voltage[n]):
            # the middle one of three leaves single wild samples aside
            monitor.changes[int(m[_N_CHANGES]) % _KEPT] = abs(voltage[n] - m[_VOLTAGE_1])
            m[_N_CHANGES] += 1.0
            low, high = min(m[_VOLTAGE_2], m[_VOLTAGE_1]), max(m[_VOLTAGE_2], m[_VOLTAGE_1])
            middle_V = max(low, min(high, voltage[n]))
            _examine(monitor, m[_TIME_1], middle_V, m[_CURRENT_1], drawn_C[n], out[n, 0], out[n, 1], limits)
        if m[_SAMPLES] > 1.0 and duration[n] > 0.0:
            _follow_gaps(monitor, voltage[n], out[n, 6], current[n], duration[n], out[n, 0])
        m[_LOAD_A] = current[n]
        start = _start(monitor, voltage[n], current[n], least_resistance_ohm(out[n, 0], out[n, 1]), limits)
        if not isnan(voltage[n]):
            m[_VOLTAGE_2] = m[_VOLTAGE_1] if m[_SAMPLES] > 1.0 else voltage[n]
            m[_VOLTAGE_1], m[_TIME_1], m[_CURRENT_1] = voltage[n], m[_TIME], current[n]
        own_sd = (out[n, 2], out[n, 3])
        for k in range(2):
            # what the error of the model leaves open
            least_sd = min(out[n, 7], _MOST_LEAST_SHARE * out[n, 0]) if k == 0 else 0.0
            out[n, 2 + k] = hypot(max(own_sd[k], least_sd), limits.scale_sd[k] * out[n, k])
        doubt_C = m[_DOUBT_C] + (m[_GAP_C] if m[_GAP_COUNT] > 0.0 else 0.0)
        if start != 0:
            codes[n] = start
        elif m[_FAULT] != 0.0:
            codes[n] = int(m[_FAULT])
        else:
            codes[n] = _verdict(out[n], own_sd, doubt_C, limits)
        out[n, 2] = hypot(out[n, 2], doubt_C)
