"""What speaks against the estimates of a filter: its samples are watched as they come in, compiled (numba)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from math import expm1, hypot, inf, isnan, nan, sqrt
from typing import Any

import numpy as np
from numba import njit

from battery_env.estimators import gaps, settling
from battery_env.estimators.kalman_bank import LIMIT_SD
from battery_env.estimators.kalman_state import KEPT, Q, R, Row, Settings
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE

# The data must have narrowed a prior by this share of its width before a deviation from it says anything.
_LEAST_NARROWING = 0.2
# A cell from which this share of its charge was drawn does not come back to the voltage of its first sample without a charge.
_RECOVERY_SHARE = 0.2
# A load that was switched for at least this long, s, and this many samples shows in the voltage: the ohmic drop of the model
# comes to 80 % in 10 s.
_LEAST_PULSE_S, _LEAST_PULSE_SAMPLES = 10.0, 3
# The middle one of three samples has this share of their noise.
_SMOOTHED_SHARE = 0.67
# Voltages are kept about this far apart, s: all that are kept cover the window in which a voltage may not rise.
_KEPT_EVERY_S = 0.9
# What model and cell part by is averaged over about so many samples before a gap, and how fast the voltage falls over so long,
# s; after it the middle voltage of three counts.
_PARTED_MEMORY, _RATE_MEMORY_S, _PARTED_SAMPLES = 8.0, 100.0, 3
# Standard deviation of the difference of both, as a share of the noise.
_PARTED_NOISE_SHARE = 0.72
_SHARES = (settling.SETTLED_SHARES["q_mobile"], settling.SETTLED_SHARES["r_o"])
_RECOVERED_TEXT = (
    "The voltage comes back to that of the start at {:.0f} s, though {:.0f} C were drawn: the cell was charged. Reset the "
    "filter when a discharge begins."
)

_compiled = njit(cache=True, error_model="numpy")


class Verdict(IntEnum):
    """
    Why an estimate is not settled. A row holds the text of a reason, and the names of what fills it (:func:`reason`). The
    first row that holds is the reason; of the faults it is the first one in time.
    """

    def __new__(cls, text: str, *names: str) -> Verdict:
        number = len(cls.__members__)
        member = int.__new__(cls, number)
        member._value_ = number
        member.text, member.names = text, names
        return member

    text: str
    names: tuple[str, ...]

    SETTLED = ""
    # the start, with the numbers that settling.start_code gives and settling.start_text tells
    START_ABOVE = "", "start"
    START_BELOW = "", "start"
    START_LOADED = "", "start"
    # faults
    RECOVERED = _RECOVERED_TEXT, "fault_s", "size"
    NOT_FOLLOWED = settling.NOT_FOLLOWED, "size", "fault_s"
    RISES = settling.RISES, "size", "fault_s"
    NOT_DRAWN = settling.NOT_DRAWN_TEXT, "since_s", "fault_s", "size"
    # the estimate
    EMPTY = settling.EMPTY
    Q_AT_BOUND = settling.AT_BOUND, "q_mobile"
    R_AT_BOUND = settling.AT_BOUND, "r_o"
    IMPLAUSIBLE = settling.IMPLAUSIBLE
    MISFIT = settling.MISFIT
    Q_PRIOR_WRONG = settling.PRIOR_CONTRADICTED, "q_mobile"
    Q_PRIOR_ALONE = settling.PRIOR_ALONE, "q_mobile"
    R_PRIOR_WRONG = settling.PRIOR_CONTRADICTED, "r_o"
    R_PRIOR_ALONE = settling.PRIOR_ALONE, "r_o"
    GAP_UNSURE = settling.UNSURE_TEXT, "gap_start_s", "gap_end_s", "gap_C"
    Q_IMPRECISE = settling.IMPRECISE["q_mobile"]
    R_IMPRECISE = settling.IMPRECISE["r_o"]
    Q_SCALE_UNKNOWN = settling.SCALE_UNKNOWN, "q_mobile"
    R_SCALE_UNKNOWN = settling.SCALE_UNKNOWN, "r_o"


_VERDICTS = tuple(Verdict)


def reason(code: int, seen: Mapping[str, Any], initial_soc: float, clock_s: float = 0.0) -> str:
    """The reason that a code stands for, from the start, the fault and the gap that were seen, on a clock of its own."""
    said, fault, gap = _VERDICTS[code], seen["fault"], seen["gap"]
    if "start" in said.names:
        return settling.start_text(code, float(seen["start"]["first_V"]), float(seen["start_V"]), initial_soc)
    end_s = clock_s + gap["end_s"]
    fills = {
        "fault_s": clock_s + fault["time_s"],
        "since_s": clock_s + fault["since_s"],
        "size": fault["size"],
        "gap_start_s": end_s - gap["length_s"],
        "gap_end_s": end_s,
        "gap_C": gap["charge_C"],
    }
    return said.text.format(*(fills.get(name, name) for name in said.names))


@_compiled
def _noise_V(cell: Row) -> float:
    # what is more than noise; infinite as long as there are too few samples to tell
    n = min(cell.ring.n_changes, KEPT)
    if n < KEPT // 4:
        return inf
    return settling.NOISES * _SMOOTHED_SHARE * float(np.median(cell.ring.change_V[:n])) / (0.6745 * sqrt(2.0))


@_compiled
def _find(cell: Row, code: int, time_s: float, size: float) -> None:
    # the first one is kept
    fault = cell.fault
    if fault.code == Verdict.SETTLED:
        fault.code, fault.time_s, fault.size = code, time_s, size


@_compiled
def _conclude_switch(cell: Row, resistance_ohm: float) -> None:
    # whether the voltage followed the last switch of the load by half of the least ohmic drop
    switch = cell.switch
    drop_V = 0.5 * resistance_ohm * switch.to_follow_A
    if abs(drop_V) > _noise_V(cell):
        followed_V = switch.before_V - (switch.lowest_V if drop_V > 0.0 else switch.highest_V)
        if followed_V / drop_V < 1.0:
            _find(cell, Verdict.NOT_FOLLOWED, switch.time_s, switch.size_A)
    switch.size_A = 0.0


@_compiled
def _note_switch(cell: Row, time_s: float, current: float, resistance_ohm: float) -> None:
    # whether the load jumped, or was switched, since the last sample that was examined
    switch, last = cell.switch, cell.examined
    last.largest_A = max(last.largest_A, abs(current))
    if last.count == 0:
        switch.time_s = last.jump_s = time_s
        return
    switched_A = current - last.current_A
    if abs(switched_A) > min(SWITCH_SHARE * last.largest_A, settling.LEAST_JUMP_A):
        last.jump_s = time_s
    if abs(switched_A) > SWITCH_SHARE * last.largest_A:
        if switch.size_A != 0.0 and time_s - switch.time_s >= _LEAST_PULSE_S and switch.samples >= _LEAST_PULSE_SAMPLES:
            _conclude_switch(cell, resistance_ohm)
        switch.time_s, switch.size_A, switch.before_V = time_s, switched_A, last.voltage_V
        switch.to_follow_A = settling.change_to_follow_A(switched_A, current, last.lagging_A)
        switch.lowest_V, switch.highest_V, switch.samples = inf, -inf, 0.0
    last.lagging_A = settling.lagging_current_A(last.lagging_A, last.current_A, time_s - last.time_s)


@_compiled
def _look_for_rise(cell: Row, time_s: float, voltage: float, current: float) -> None:
    # since the voltage a little more than the window ago, under a current that has been steady since long before
    ring = cell.ring
    for back in range(2, min(ring.n_kept, KEPT) + 1):
        n = (ring.n_kept - back) % KEPT
        since_s = time_s - ring.time_s[n]
        if since_s > settling.START_WINDOW_S:
            rise_V = voltage - ring.voltage_V[n] - settling.MOST_RESISTANCE_OHM * max(ring.current_A[n] - current, 0.0)
            was_steady = time_s - since_s - cell.examined.jump_s >= settling.STEADY_S
            if was_steady and rise_V > settling.RISE_V and rise_V > _noise_V(cell):
                _find(cell, Verdict.RISES, time_s - since_s, rise_V)
            break
    if ring.n_kept == 0 or time_s - ring.time_s[(ring.n_kept - 1) % KEPT] >= _KEPT_EVERY_S:
        n = ring.n_kept % KEPT
        ring.time_s[n], ring.voltage_V[n], ring.current_A[n] = time_s, voltage, current
        ring.n_kept += 1


@_compiled
def _examine(cell: Row, voltage: float, settings: Settings) -> None:
    # The sample before the one at hand, with the middle voltage of three, which is no single wild one
    last, switch, q = cell.examined, cell.switch, cell.bank.mean[Q]
    time_s, current = cell.before.time_1_s, cell.before.current_1_A
    resistance_ohm = settling.least_resistance_ohm(q, cell.bank.mean[R])
    _note_switch(cell, time_s, current, resistance_ohm)
    if switch.size_A != 0.0:
        switch.lowest_V, switch.highest_V = min(switch.lowest_V, voltage), max(switch.highest_V, voltage)
        switch.samples += 1.0
        if time_s - switch.time_s > settling.START_WINDOW_S and switch.samples >= _LEAST_PULSE_SAMPLES:
            _conclude_switch(cell, resistance_ohm)
    _look_for_rise(cell, time_s, voltage, current)
    # under a steady load the voltage at rest is higher by the ohmic drop at least; a charge that is seen raises it
    drop_V = resistance_ohm * max(current, 0.0) if time_s - switch.time_s > settling.START_WINDOW_S else 0.0
    is_high = voltage + drop_V > cell.start_V - settling.FULL_REST_V[0] and min(current, last.lagging_A) >= -REST_CURRENT_A
    if is_high and cell.drawn_C > _RECOVERY_SHARE * max(q, settings.cell_q_mobile):
        _find(cell, Verdict.RECOVERED, time_s, cell.drawn_C)
    last.count += 1
    last.time_s, last.voltage_V, last.current_A = time_s, voltage, current


@_compiled
def _start(cell: Row, voltage: float, current: float) -> int:
    start = cell.start
    if cell.samples == 1:
        start.first_V, start.first_A, start.most_A, start.least_V = voltage, current, current, voltage
        if start.at_rest:
            start.first_A = 0.0
    elif cell.samples == 2 or cell.time_s <= settling.START_WINDOW_S:
        start.most_A = max(start.most_A, current)
        if not isnan(voltage):
            start.least_V = min(start.least_V, voltage)
    resistance_ohm = settling.least_resistance_ohm(cell.bank.mean[Q], cell.bank.mean[R])
    return int(settling.start_code(start.first_V, start.first_A, start.most_A, start.least_V, cell.start_V, resistance_ohm))


@_compiled
def _middle(a: float, b: float, c: float) -> float:
    return max(min(a, b), min(max(a, b), c))


@_compiled
def _note_interval(cell: Row, interval_s: float, load_A: float) -> None:
    # one that was no gap, or whose charge was drawn
    longest_s = cell.usual.longest_s
    if interval_s > longest_s[0] and load_A > REST_CURRENT_A:
        longest_s[0] = interval_s
        longest_s.sort()


@_compiled
def _open_gap(cell: Row, voltage: float, current: float, duration: float, charge_C: float, load_A: float) -> None:
    gap, usual = cell.gap, cell.usual
    if gap.samples > 0.0:
        cell.doubt_C += gap.charge_C
    gap.length_s, gap.end_s, gap.charge_C, gap.samples = duration, cell.time_s, charge_C, 1.0
    # the filter gives way to the samples after a gap, so that these are compared with what it had expected before
    gap.fall_V = usual.expected_V - cell.bank.expected_V
    if cell.time_s - duration - cell.examined.jump_s >= settling.STEADY_S:
        # a model whose q_mobile is not known yet may take its cell for empty: the voltage falls at least as it did before
        gap.fall_V = min(gap.fall_V, usual.fall_V_per_s * duration)
    gap.model_V = usual.expected_V + usual.parted_V - gap.fall_V
    gap.after_V = voltage
    if isnan(voltage) or abs(current - cell.current_A) > SWITCH_SHARE * load_A:
        gap.fall_V = 0.0  # which leaves it in doubt


@_compiled
def _close_gap(cell: Row, voltage: float, load_A: float) -> None:
    gap = cell.gap
    after_V = _middle(gap.after_V, gap.next_V, voltage)
    sd_V = _PARTED_NOISE_SHARE * _noise_V(cell) / (settling.NOISES * _SMOOTHED_SHARE)
    said = gaps.verdict(after_V - gap.model_V, gap.fall_V, sd_V, gaps.MOST_SHARE_SO_FAR)
    if said == gaps.DRAWN:
        _note_interval(cell, gap.length_s, load_A)
    else:
        cell.doubt_C += gap.charge_C
    if said == gaps.NOT_DRAWN and cell.fault.code == Verdict.SETTLED:
        cell.fault.since_s = gap.end_s - gap.length_s
        _find(cell, Verdict.NOT_DRAWN, gap.end_s, gap.charge_C)
    gap.samples = 0.0


@_compiled
def _follow_gaps(cell: Row, voltage: float, current: float, duration: float) -> None:
    # One sample that is not the first. A gap is pending from its end until the voltages after it were seen.
    gap, usual, expected = cell.gap, cell.usual, cell.bank.expected_V
    load_A = max(abs(cell.current_A), abs(current))
    if gap.samples > 0.0 and gap.length_s <= gaps.GAP_RATIO * duration and cell.time_s - duration == gap.end_s:
        gap.samples = 0.0  # the samples are as far apart from now on
    charge_C = 0.0
    if duration > gaps.GAP_RATIO * usual.longest_s[0]:  # else the logger has a habit of it
        charge_C = gaps.doubtful_charge_C(usual.interval_s, duration, 0.0, load_A, cell.bank.mean[Q])
    if charge_C > 0.0:
        _open_gap(cell, voltage, current, duration, charge_C, load_A)
    else:
        _note_interval(cell, duration, min(abs(cell.current_A), abs(current)))
        if gap.samples > 0.0 and not isnan(voltage):
            gap.samples += 1.0
            if gap.samples < _PARTED_SAMPLES:
                gap.next_V = voltage
                # by how much it falls from one sample to the next
                gap.model_V -= gap.fall_V * (cell.time_s - gap.end_s) / gap.length_s
            else:
                _close_gap(cell, voltage, load_A)
    if not isnan(voltage):
        if gap.samples == 0.0:
            usual.parted_V += (voltage - expected - usual.parted_V) / min(cell.samples - 1.0, _PARTED_MEMORY)
        usual.expected_V = expected
        if charge_C == 0.0 and cell.samples > 2:
            fall_V_per_s = (cell.before.voltage_1_V - voltage) / duration
            usual.fall_V_per_s += -expm1(-duration / _RATE_MEMORY_S) * (fall_V_per_s - usual.fall_V_per_s)
    usual.interval_s = duration


@_compiled
def _judge(cell: Row, sd: tuple[float, float], doubt_C: float, settings: Settings) -> int:
    # why an estimate with these standard deviations is not settled; those of the bank are its own
    bank, searched = cell.bank, settings.searched
    if not bank.has_voltage:
        return Verdict.EMPTY
    for k in range(2):
        low, high = settings.bounds[k]
        if searched[k] and not low + bank.sd[k] < bank.mean[k] < high - bank.sd[k]:
            return Verdict.Q_AT_BOUND + k
    least, most = settling.PLAUSIBLE_Q_SHARES
    if searched[Q] and not least * settings.cell_q_mobile < bank.mean[Q] < most * settings.cell_q_mobile:
        return Verdict.IMPLAUSIBLE
    if bank.trend_sd > LIMIT_SD:
        return Verdict.MISFIT
    for k in range(2):
        mean, prior_sd = settings.carried[k]
        if prior_sd > 0.0:
            narrowed = max(prior_sd**2 - bank.sd[k] ** 2, (_LEAST_NARROWING * prior_sd) ** 2)
            if (bank.mean[k] - mean) ** 2 > settling.PRIOR_LIMIT_SD**2 * narrowed:
                return Verdict.Q_PRIOR_WRONG + 2 * k
            # precisions add up
            of_data = max(max(bank.sd[k] ** -2.0 - prior_sd**-2.0, 0.0) ** -0.5, bank.common_sd_q if k == Q else 0.0)
            if of_data >= _SHARES[k] * bank.mean[k]:
                return Verdict.Q_PRIOR_ALONE + 2 * k
    if searched[Q] and hypot(sd[Q], doubt_C) >= _SHARES[Q] * bank.mean[Q] > sd[Q]:
        return Verdict.GAP_UNSURE
    for k in range(2):
        if searched[k] and not sd[k] < _SHARES[k] * bank.mean[k]:
            return (Verdict.Q_IMPRECISE if settings.scale_sd[k] < _SHARES[k] else Verdict.Q_SCALE_UNKNOWN) + k
    return Verdict.SETTLED


@_compiled
def watch(cell: Row, sample: Row, settings: Settings, estimate: Row) -> None:
    """Judge the estimate of a bank by the samples that it comes from, the last of which it has just taken in; unchecked."""
    voltage, current, duration, bank, before = sample.voltage_V, sample.current_A, sample.dt_s, cell.bank, cell.before
    if cell.samples > 1 and not isnan(voltage):
        cell.ring.change_V[cell.ring.n_changes % KEPT] = abs(voltage - before.voltage_1_V)
        cell.ring.n_changes += 1
        _examine(cell, _middle(before.voltage_2_V, before.voltage_1_V, voltage), settings)
    if cell.samples > 1 and duration > 0.0:
        _follow_gaps(cell, voltage, current, duration)
    start = _start(cell, voltage, current)
    if not isnan(voltage):
        before.voltage_2_V = before.voltage_1_V if cell.samples > 1 else voltage
        before.voltage_1_V, before.time_1_s, before.current_1_A = voltage, cell.time_s, current
    # what the error of the model leaves open beside the prior, and what shows nowhere in the voltage
    least_sd_q = (bank.common_sd_q**-2.0 + 1.0 / settings.variance[Q]) ** -0.5
    sd = (
        hypot(max(bank.sd[Q], least_sd_q), settings.scale_sd[Q] * bank.mean[Q]),
        hypot(max(bank.sd[R], 0.0), settings.scale_sd[R] * bank.mean[R]),
    )
    doubt_C = cell.doubt_C + (cell.gap.charge_C if cell.gap.samples > 0.0 else 0.0)
    if start != Verdict.SETTLED:
        estimate.code = start
    elif cell.fault.code != Verdict.SETTLED:
        estimate.code = cell.fault.code
    else:
        estimate.code = _judge(cell, sd, doubt_C, settings)
    estimate.q_mobile, estimate.r_o = bank.mean[Q], bank.mean[R]
    estimate.sd[Q] = hypot(sd[Q], doubt_C) if settings.searched[Q] else nan
    estimate.sd[R] = sd[R] if settings.searched[R] else nan
