"""
The evidence of samples, compiled (numba): whether a cell starts with the charge expected, and whether its voltage belongs to
its current. A stream is watched sample by sample, and a whole record in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import expm1, hypot, isnan, nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import BoolArray, FloatArray
from battery_env.compiled import compiled
from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.estimates.findings import SETTLED_SHARES, Reason
from battery_env.estimators.diagnosis import gaps
from battery_env.estimators.diagnosis.faults import (
    KEPT,
    MOST_NOISE_SD,
    NOISES,
    RESOLUTION_V,
    SMOOTHED_SHARE,
    Row,
    find,
    middle,
    noise_V,
    table,
)
from battery_env.estimators.diagnosis.rest import ABOVE_REST_V, LACKING_SHARE, low_rest_voltage_V, rest_voltage_V
from battery_env.records import (
    LOAD_SHARE,
    REST_CURRENT_A,
    STEADY_S,
    SWITCH_SHARE,
    ChargeBefore,
    ChargeHistory,
    DischargeStart,
    Samples,
)
from battery_env.records.load import SWITCHES, note_switch, switched_C

# A cell that was at rest at the first sample falls by at least half of its ohmic drop within this time, s. So does one whose
# load is switched.
_START_WINDOW_S = 20.0
# Least resistance of a cell, ohm, up to the q_mobile of a new one; larger cells of the same electrodes have a smaller one. The
# bundled cells show 0.105 ohm and more when the load is switched on, those of the tasks have 0.1 ohm and more.
_LEAST_RESISTANCE_OHM, _NEW_Q_C = 0.1, NEW_CELL.q_mobile
# Time constant with which the ohmic drop follows the current at most, s: cells may be twice as slow as the model's.
_FOLLOWS_S = 2.0 * NEW_CELL.to
# Under a steady current the voltage of a cell does not rise by so much, V.
_RISE_V = 0.05
# Smaller changes of the current than this, A, hardly show in the voltage. Where a load falls in such steps, a rise of the
# voltage by this resistance, ohm, says nothing.
_LEAST_JUMP_A, _MOST_RESISTANCE_OHM = 0.05, 0.6
# A cell from which this share of its charge was drawn does not come back to the voltage of its first sample without a charge.
_RECOVERY_SHARE = 0.2
# A change of the voltage is compared with so many before and behind it.
_BESIDE = 5
# Switches between samples that leave more of the charge open than a settled estimate may tell no resistance.
_MOST_SHARE = SETTLED_SHARES["q_mobile"]
# Voltages are kept about this far apart, s: all that are kept cover the window in which a voltage may not rise.
_KEPT_EVERY_S = 0.9

# The start: the first sample, and within the start window the largest current and the least voltage.
_START = table(
    [
        *(("at_rest", "b1"), ("charge", "i8"), ("is_cut_short", "b1")),
        *((name, "f8") for name in ("first_V", "first_A", "most_A", "least_V")),
    ]
)

# The current before the load, in the mean: since when it is over, the interval in which the load came on and the one before,
# and the standard deviation of the charge by that.
_REST = table(
    [("samples", "i8"), ("is_over", "b1"), *((f, "f8") for f in ("mean_A", "over_s", "on_s", "before_s", "load_on_C"))]
)

# The two voltages before the one at hand, and time and current of the last of them: the middle one of three is examined.
_BEFORE = table("voltage_2_V voltage_1_V time_1_s current_1_A")

# The last sample that was examined and the voltage before it, the current that the ohmic drop stands for then, the largest
# magnitude of the current, and when the current last jumped.
_EXAMINED = table(
    [
        ("count", "i8"),
        *((f, "f8") for f in ("time_s", "earlier_V", "voltage_V", "current_A", "lagging_A", "largest_A", "jump_s")),
    ]
)

# The last switch of the load, 0 A once it was judged: the part of its size that the voltage has to follow, the voltage before
# and the range since, and the charge by it until now; and when one was taken back, 0 s if none was.
_SWITCH = table("time_s size_A to_follow_A before_V lowest_V highest_V charge_C back_s")

# Some samples of the last minute, and the last changes of the voltage from sample to sample, in rings.
_RING = table(
    [
        *(("n_kept", "i8"), ("time_s", "f8", KEPT), ("voltage_V", "f8", KEPT), ("current_A", "f8", KEPT)),
        *(("n_changes", "i8"), ("change_V", "f8", KEPT), ("interval_s", "f8", KEPT)),
    ]
)

# The first fault that was found, 0 if there is none: when, and how large it is.
_FAULT = table([("reason", "i8"), ("time_s", "f8"), ("size", "f8")])

#: What the samples of a discharge have shown so far.
EVIDENCE = table(
    [
        ("samples", "i8"),
        ("time_s", "f8"),
        ("current_A", "f8"),  # since the last sample
        ("drawn_C", "f8"),
        ("model_V", "f8"),  # of the model at rest with the charge expected at the start; NaN: none is
        ("start_V", "f8"),  # of a cell with that charge
        ("low_V", "f8"),  # of one that lacks charge
        ("high_V", "f8"),  # of another cell
        ("is_usual", "b1"),  # whether other discharges of the cell tell these voltages: the first ones, under a current of
        ("usual_A", "f8"),
        ("share_V", "f8"),  # at rest at least, when the share was drawn from which it does not come back; 0: not yet
        ("start", _START),
        ("interval_s", "f8"),  # the last one
        ("rest", _REST),
        ("before", _BEFORE),
        ("examined", _EXAMINED),
        ("switch", _SWITCH),
        ("ring", _RING),
        ("usual", gaps.USUAL),
        ("gap", gaps.GAP),
        ("pending", "b1"),  # the voltage has not followed the last switch yet
        ("switches", SWITCHES),
        ("is_counted", "b1"),  # by the tester, which saw what lies between samples
        ("uncounted_C", "f8"),  # by how much it counted another charge
        ("left_C", "f8"),  # what a charge before had left to take
        ("missed_C", "f8"),  # charge that steps of the voltage show, and the current does not
        ("dropped_C", "f8"),  # charge of switches that were taken back, which it did not follow
        ("fault", _FAULT),
    ]
)


def evidence_of(
    record: Samples,
    cell: CellParameters,
    initial_soc: float | None,
    estimate: Sequence[float],
    history: ChargeHistory,
    model_V: FloatArray | None = None,
) -> Any:
    """
    What the samples of a whole record show beside an estimate of ``q_mobile``, C, and ``r_o``, ohm: a row of ``EVIDENCE``.
    Without a state of charge no rest is expected at the start; without the voltage of the model gaps are not looked at.
    """
    evidence, (q_mobile, r_o) = np.zeros(1, EVIDENCE), estimate
    expect(evidence, cell, initial_soc)
    # another charge was stated by whoever knows it
    take_in(evidence, history if initial_soc == 1.0 else history._replace(usual_start=None))
    time_s, voltage_V, current_A = (np.ascontiguousarray(column) for column in record)
    expected_V = np.empty(0) if model_V is None else model_V
    _watch_all(evidence, time_s, voltage_V, current_A, expected_V, q_mobile, r_o, cell.q_mobile)
    return evidence[0]


def dropouts_s(record: Samples, cell: CellParameters) -> FloatArray:
    """
    When the current of a record changed for a moment and the voltage did not follow: until the ohmic drop of a model that did
    is over, spans of the time since the first sample, s, shape (dropouts, 2).
    """
    time_s, voltage_V, current_A = (np.ascontiguousarray(column) for column in record)
    belong = _watch_all(
        np.zeros(1, EVIDENCE), time_s, voltage_V, current_A, np.empty(0), cell.q_mobile, cell.r_o, cell.q_mobile
    )
    edges = np.flatnonzero(np.diff(belong, prepend=True, append=True))
    since_s = np.append(time_s - time_s[0], np.inf)
    return np.column_stack([since_s[edges[::2]], since_s[edges[1::2]]])


def expect(evidence: Any, cell: CellParameters, initial_soc: float | None) -> None:
    """Expect a cell at rest with some charge, before the first sample; ``None``: none."""
    evidence["model_V"] = evidence["low_V"] = nan
    if initial_soc is not None:
        evidence["model_V"], evidence["low_V"] = rest_voltage_V(cell, initial_soc), low_rest_voltage_V(cell, initial_soc)
    evidence["start_V"], evidence["high_V"] = evidence["model_V"], evidence["model_V"] + ABOVE_REST_V


def take_in(evidence: Any, history: ChargeHistory) -> None:
    """Take in what is known beside the samples, before the first of them."""
    start, rest, charge, full_V = evidence["start"], evidence["rest"], history.charge, evidence["start_V"]
    start["at_rest"], evidence["is_counted"], evidence["uncounted_C"] = (
        history.at_rest,
        history.is_counted,
        history.uncounted_C,
    )
    if charge is not None:
        # without a rest a charge that did not taper off tells nothing but that the cell is lower
        is_low = (charge.highest_V < evidence["low_V"]) | (not charge.tapered and history.rest_s < STEADY_S)
        start["charge"] = np.where(np.isnan(full_V), 0, np.where(is_low, -1, int(charge.tapered)))
        evidence["left_C"], start["is_cut_short"] = np.where(np.isnan(full_V), 0.0, charge.left_C), not charge.tapered
    if history.start is not None and history.usual_start is not None:
        _expect_usual(evidence, history.start, history.usual_start)
    if history.load_on_C or history.offset_A:
        rest["is_over"], rest["mean_A"], rest["load_on_C"] = True, history.offset_A, history.load_on_C


def _expect_usual(evidence: Any, own: DischargeStart, usual: DischargeStart) -> None:
    """Expect a start like those of other discharges of the cell: its voltage, or its charge if the load is another one."""
    span_V = evidence["start_V"] - evidence["low_V"]
    is_like = own.is_charged_like(usual, float(np.max(span_V)))
    if not own.is_of_current(usual) and is_like is None:
        return
    evidence["start_V"], evidence["is_usual"], evidence["usual_A"] = usual.voltage_V, True, usual.current_A
    if not own.is_of_current(usual):
        evidence["start"]["charge"], evidence["start"]["is_cut_short"] = 1 if is_like else -1, False
        evidence["high_V"] = np.inf
        return
    spread_V = MOST_NOISE_SD * usual.sd_V
    evidence["low_V"], evidence["high_V"] = usual.voltage_V - span_V - spread_V, usual.voltage_V + ABOVE_REST_V + spread_V
    if own.charge is not None:
        is_low, is_full = own.charge.highest_V < evidence["low_V"], own.charge.tapered and is_like is not False
        evidence["start"]["charge"] = np.where(is_low, -1, int(is_full))


def measured(evidence: Any, initial_soc: float, clock_s: float = 0.0, charge: ChargeBefore | None = None) -> dict[str, Any]:
    """What was measured of samples, by the names that texts have in braces, on a clock of its own."""
    charge, rest = charge or ChargeBefore(nan, nan, nan, nan), evidence["rest"]
    fault, switch, gap = evidence["fault"], evidence["switch"], evidence["gap"]
    end_s = clock_s + gap["end_s"]
    size = fault["size"] if fault["reason"] else switch["size_A"]
    return {
        "first_V": float(evidence["start"]["first_V"]),
        "rest_V": float(evidence["start_V"]),
        "first_A": float(evidence["start"]["first_A"]),
        "usual_A": float(evidence["usual_A"]),
        "initial_soc": initial_soc,
        "charge_V": charge.highest_V,
        "charge_A": charge.last_A,
        "offset_A": rest["mean_A"],
        "fault_s": clock_s + (fault["time_s"] if fault["reason"] else switch["time_s"]),
        **dict.fromkeys(("drawn_C", "change_A", "rise_V"), size),  # by which fault it is
        "switches": evidence["switches"]["count"],
        "missed_C": evidence["missed_C"],
        "gap_start_s": end_s - gap["length_s"],
        "gap_end_s": end_s,
    }


@compiled
def _watch_all(
    rows: NDArray[np.void],
    time_s: FloatArray,
    voltage_V: FloatArray,
    current_A: FloatArray,
    model_V: FloatArray,
    q_mobile: float,
    r_o: float,
    cell_q_mobile: float,
) -> BoolArray:
    # which voltages belong to their current, as far as is told at the end
    evidence, belong = rows[0], np.ones(len(time_s), dtype=np.bool_)
    for n in range(len(time_s)):
        begin(evidence, time_s[n] - time_s[max(n - 1, 0)])
        back_s = evidence.switch.back_s
        examine(evidence, voltage_V[n], current_A[n], q_mobile, r_o, cell_q_mobile)
        belong[n] = belongs(evidence) or evidence.pending
        k = n
        while evidence.switch.back_s != back_s and k >= 0 and time_s[k] - time_s[0] >= evidence.switch.time_s:
            belong[k] = False
            k -= 1
        if n > 0 and len(model_V) > 0:
            gaps.follow(evidence, voltage_V[n], current_A[n], model_V[n], q_mobile)
        remember(evidence, voltage_V[n], current_A[n], current_A[n])
    return belong


@compiled
def begin(evidence: Row, duration: float) -> None:
    """Count the time since the sample before, and the charge drawn in it."""
    evidence.samples += 1
    evidence.interval_s = duration
    evidence.time_s += duration
    evidence.drawn_C += evidence.current_A * duration


@compiled
def examine(evidence: Row, voltage: float, current: float, q_mobile: float, r_o: float, cell_q_mobile: float) -> None:
    """Look whether one more voltage belongs to its current, beside an estimate and the model's cell."""
    if evidence.samples > 1 and not isnan(voltage):
        before, ring = evidence.before, evidence.ring
        ring.change_V[ring.n_changes % KEPT] = voltage - before.voltage_1_V
        ring.interval_s[ring.n_changes % KEPT] = evidence.time_s - before.time_1_s
        ring.n_changes += 1
        middle_V = middle(before.voltage_2_V, before.voltage_1_V, voltage)
        resistance_ohm = _least_resistance_ohm(evidence.start, q_mobile, r_o)
        _examine_last(evidence, middle_V, resistance_ohm, max(q_mobile, cell_q_mobile))
        _look_for_missed(evidence, current)
        switch = evidence.switch
        lowest_V, highest_V = min(switch.lowest_V, voltage), max(switch.highest_V, voltage)
        is_pending = switch.size_A != 0.0 and evidence.fault.reason == 0
        evidence.pending = is_pending and not _is_followed(evidence, evidence.time_s, lowest_V, highest_V, resistance_ohm)
    _note_start(evidence, voltage, current, cell_q_mobile)


@compiled
def remember(evidence: Row, voltage: float, current: float, read_A: float) -> None:
    """Keep a sample that was examined: its current until the next, and the one that was read at its time."""
    before = evidence.before
    _note_rest(evidence.rest, evidence.time_s, evidence.interval_s, current)
    # that of load-on is judged there
    note_switch(evidence.switches, read_A, evidence.interval_s if evidence.rest.on_s == 0.0 else 0.0)
    if not isnan(voltage):
        before.voltage_2_V = before.voltage_1_V if evidence.samples > 1 else voltage
        before.voltage_1_V, before.time_1_s, before.current_1_A = voltage, evidence.time_s, current
    evidence.current_A = current


@compiled
def _note_rest(rest: Row, time_s: float, interval_s: float, current: float) -> None:
    # what flows before the load, and when that comes on: in an interval of its own samples, unless some are missing before it
    if rest.is_over:
        if rest.on_s > 0.0 and rest.on_s <= 2.0 * max(rest.before_s, interval_s):
            rest.load_on_C *= min(interval_s / rest.on_s, 1.0)
        rest.on_s = 0.0
    elif rest.samples > 0 and abs(current - rest.mean_A) > SWITCH_SHARE * max(abs(current), abs(rest.mean_A), REST_CURRENT_A):
        rest.is_over, rest.over_s = True, time_s
        if abs(rest.mean_A) <= LOAD_SHARE * abs(current):
            rest.on_s, rest.load_on_C = interval_s, interval_s * abs(current - rest.mean_A) / sqrt(3.0)
    else:
        rest.samples += 1
        rest.mean_A += (current - rest.mean_A) / rest.samples
        rest.before_s = interval_s


@compiled
def _rest_current_C(evidence: Row) -> float:
    # what the current before the load makes of the charge, if no load; one without samples was told by the whole recording
    rest = evidence.rest
    is_rest = rest.is_over and (rest.samples == 0 or abs(rest.mean_A) <= LOAD_SHARE * evidence.switches.largest_A)
    return abs(rest.mean_A) * (evidence.time_s - rest.over_s) if is_rest else 0.0


@compiled
def charges_in_doubt_C(evidence: Row) -> tuple[float, ...]:
    """The standard deviations of the charge by what nobody saw, in the order of ``Doubt``."""
    rest = evidence.rest
    return (
        rest.load_on_C if rest.is_over else 0.0,
        _rest_current_C(evidence),
        evidence.left_C,
        evidence.uncounted_C,
        evidence.dropped_C,
        0.0 if evidence.is_counted else switched_C(evidence.switches),
        gaps.doubtful_C(evidence),
    )


@compiled
def unseen_C(evidence: Row) -> float:
    """The standard deviation of the charge by all that nobody saw, and that steps of the voltage show."""
    variance_C2 = evidence.missed_C**2
    for doubt_C in charges_in_doubt_C(evidence):
        variance_C2 += doubt_C**2
    return sqrt(variance_C2)


@compiled
def is_smeared(evidence: Row) -> bool:
    """Whether the load is switched between samples so often that they do not tell which current a voltage belongs to."""
    return bool(switched_C(evidence.switches) > _MOST_SHARE * evidence.drawn_C)


@compiled
def _least_resistance_ohm(start: Row, q_mobile: float, r_o: float) -> float:
    # of those that a cell can show: of other cells, of larger ones, and of this one, by its estimate, which a fault may have
    # spoiled, or by its fall at the start
    own_ohm = max((start.first_V - start.least_V) / start.most_A, r_o) if start.most_A > 0.0 else r_o
    return max(min(_LEAST_RESISTANCE_OHM, _LEAST_RESISTANCE_OHM * _NEW_Q_C / q_mobile, own_ohm), 0.0)


@compiled
def _note_start(evidence: Row, voltage: float, current: float, cell_q_mobile: float) -> None:
    start = evidence.start
    if evidence.samples == 1:
        if start.is_cut_short and voltage < evidence.start_V:
            # its charge left what the voltage at rest is too low by
            evidence.left_C = (
                LACKING_SHARE * cell_q_mobile * (evidence.start_V - voltage) / (evidence.start_V - evidence.low_V)
            )
        start.first_V, start.first_A, start.most_A, start.least_V = voltage, current, current, voltage
        if start.at_rest:
            start.first_A = 0.0
    elif evidence.samples == 2 or evidence.time_s <= _START_WINDOW_S:
        start.most_A = max(start.most_A, current)
        if not isnan(voltage):
            start.least_V = min(start.least_V, voltage)


@compiled
def start_reason(evidence: Row) -> int:
    """
    Say why a cell need not have started with the charge expected; 0 if its first voltage shows that it did. Under load that
    is lower than at rest by a drop that nobody knows: a cell with a larger one cannot be told from one that lacks some charge.
    """
    start = evidence.start
    is_high, is_low = start.first_V > evidence.high_V, start.charge == 0 and start.first_V < evidence.low_V
    if evidence.is_usual:
        return Reason.START_UNLIKE + 0 if is_high or is_low or start.charge < 0 else 0
    if is_high or is_low:
        return Reason.START_DIFFERS + 0
    return Reason.START_CHARGED + 0 if start.charge < 0 else 0


@compiled
def fault_reason(evidence: Row) -> int:
    """Say what the samples show that no cell does, the first one found; 0 if nothing."""
    return Reason.NOT_FOLLOWED + 0 if evidence.pending else evidence.fault.reason


@compiled
def belongs(evidence: Row) -> bool:
    """Whether the last voltage belongs to its current: it follows that, and would follow a model of it."""
    back_s = evidence.switch.back_s
    return not evidence.pending and (back_s == 0.0 or evidence.time_s > back_s + _START_WINDOW_S)


@compiled
def _is_followed(evidence: Row, time_s: float, lowest_V: float, highest_V: float, resistance_ohm: float) -> bool:
    # whether the voltage follows the last switch of the load by half of the least ohmic drop that it can have by then, or that
    # drop is no more than noise
    switch = evidence.switch
    drop_V = -resistance_ohm * switch.to_follow_A * expm1((switch.time_s - time_s) / _FOLLOWS_S)
    followed_V = switch.before_V - (lowest_V if drop_V > 0.0 else highest_V)
    return abs(drop_V) <= noise_V(evidence) or followed_V / drop_V >= 0.5


@compiled
def _take_back(evidence: Row, current: float) -> bool:
    # A switch that the voltage did not follow, and that was taken back, was none: what it made of the charge is in doubt
    switch, last = evidence.switch, evidence.examined
    switched_A = current - last.current_A
    if (switch.size_A - switched_A) * switched_A >= 0.0:
        return False
    evidence.dropped_C += abs(switch.charge_C)
    last.lagging_A, switch.size_A, switch.back_s = current, 0.0, evidence.time_s
    return True


@compiled
def _note_switch(evidence: Row, time_s: float, current: float, resistance_ohm: float) -> None:
    # whether the load jumped, or was switched, since the last sample that was examined
    switch, last = evidence.switch, evidence.examined
    last.largest_A = max(last.largest_A, abs(current))
    if last.count == 0:
        switch.time_s = last.jump_s = time_s
        return
    switched_A = current - last.current_A
    switch.charge_C += switch.size_A * (time_s - last.time_s)
    if abs(switched_A) > min(SWITCH_SHARE * last.largest_A, _LEAST_JUMP_A):
        last.jump_s = time_s
    if abs(switched_A) > SWITCH_SHARE * last.largest_A:
        if _is_followed(evidence, time_s, switch.lowest_V, switch.highest_V, resistance_ohm):  # or nothing was left to follow
            switch.size_A = 0.0
        if switch.size_A == 0.0:
            switch.charge_C = 0.0
            # the last row before a switch may already have the voltage after it
            highest_V, lowest_V = max(last.earlier_V, last.voltage_V), min(last.earlier_V, last.voltage_V)
            switch.time_s, switch.before_V = time_s, highest_V if switched_A > 0.0 else lowest_V
            switch.lowest_V = switch.highest_V = evidence.before.voltage_1_V
        # steps the same way before it was judged are one switch: a mean over an interval shows a switch as two
        switch.size_A += switched_A
        if _take_back(evidence, current):
            return
        # the ohmic drop must follow little after a pulse too short for it to build up
        switch.to_follow_A = max(min(current - last.lagging_A, max(switch.size_A, 0.0)), min(switch.size_A, 0.0))
    # the ohmic drop follows slowly
    last.lagging_A += (last.lagging_A - last.current_A) * expm1(-(time_s - last.time_s) / _FOLLOWS_S)


@compiled
def _look_for_rise(evidence: Row, time_s: float, voltage: float, current: float) -> None:
    # since the voltage a little more than the window ago, under a current that has been steady since long before
    ring = evidence.ring
    for back in range(2, min(ring.n_kept, KEPT) + 1):
        n = (ring.n_kept - back) % KEPT
        since_s = time_s - ring.time_s[n]
        if since_s > _START_WINDOW_S:
            rise_V = voltage - ring.voltage_V[n] - _MOST_RESISTANCE_OHM * max(ring.current_A[n] - current, 0.0)
            was_steady = time_s - since_s - evidence.examined.jump_s >= STEADY_S
            if was_steady and rise_V > _RISE_V and rise_V > noise_V(evidence):
                find(evidence, Reason.RISES, time_s - since_s, rise_V)
            break
    if ring.n_kept == 0 or time_s - ring.time_s[(ring.n_kept - 1) % KEPT] >= _KEPT_EVERY_S:
        n = ring.n_kept % KEPT
        ring.time_s[n], ring.voltage_V[n], ring.current_A[n] = time_s, voltage, current
        ring.n_kept += 1


@compiled
def _look_for_missed(evidence: Row, current: float) -> None:
    # Under a steady load the voltage changes from sample to sample as it did before and does afterwards, or in proportion to
    # the time between them. A step beyond that and noise is a charge that rows were lost with, together with their time.
    ring, count = evidence.ring, 2 * _BESIDE + 1
    if ring.n_changes < count or current <= REST_CURRENT_A:
        return
    change_V, interval_s = np.empty(count), np.empty(count)
    for k in range(count):
        n = (ring.n_changes - count + k) % KEPT
        change_V[k], interval_s[k] = ring.change_V[n], ring.interval_s[n]
    span_s = interval_s.sum()
    if evidence.time_s - span_s - evidence.examined.jump_s < STEADY_S:
        return
    usual_V, usual_V_per_s = float(np.median(change_V)), float(np.median(change_V / interval_s))
    by_time_V = usual_V_per_s * interval_s[_BESIDE]
    low_V, high_V = min(usual_V, by_time_V), max(usual_V, by_time_V)
    # alone and with either neighbour, which takes a single wild voltage back
    alone_V = change_V[_BESIDE]
    pairs_V = alone_V + change_V[_BESIDE - 1] - usual_V, alone_V + change_V[_BESIDE + 1] - usual_V
    step_V = 0.0
    if max(alone_V, pairs_V[0], pairs_V[1]) < low_V:
        step_V = low_V - max(alone_V, pairs_V[0], pairs_V[1])
    elif min(alone_V, pairs_V[0], pairs_V[1]) > high_V:
        step_V = high_V - min(alone_V, pairs_V[0], pairs_V[1])
    noise_of_change_V = max(sqrt(2.0) / SMOOTHED_SHARE * noise_V(evidence), NOISES * RESOLUTION_V)
    if abs(step_V) <= noise_of_change_V:
        return
    fall_V_per_s = max(-float(change_V.sum() - alone_V) / (span_s - interval_s[_BESIDE]), RESOLUTION_V / span_s)
    evidence.missed_C = hypot(evidence.missed_C, current * step_V / fall_V_per_s)


@compiled
def _examine_last(evidence: Row, voltage: float, resistance_ohm: float, most_q: float) -> None:
    # The sample before the one at hand, with the middle voltage of three, which is no single wild one
    last, switch, before = evidence.examined, evidence.switch, evidence.before
    time_s, current = before.time_1_s, before.current_1_A
    if switch.size_A != 0.0:
        # some loggers write a voltage a sample later than its current: the first one after a switch may belong before it
        switch.lowest_V, switch.highest_V = min(switch.lowest_V, before.voltage_1_V), max(switch.highest_V, before.voltage_1_V)
    _note_switch(evidence, time_s, current, resistance_ohm)
    if switch.size_A != 0.0 and time_s - switch.time_s > _START_WINDOW_S:
        if not _is_followed(evidence, time_s, switch.lowest_V, switch.highest_V, resistance_ohm):
            find(evidence, Reason.NOT_FOLLOWED, switch.time_s, switch.size_A)
        switch.size_A = 0.0
    _look_for_rise(evidence, time_s, voltage, current)
    # under a steady load the voltage at rest is higher by the ohmic drop at least; a charge that is seen raises it
    whole_V = resistance_ohm * max(current, 0.0)
    drop_V = whole_V if time_s - switch.time_s > _START_WINDOW_S else 0.0
    if evidence.drawn_C > _RECOVERY_SHARE * most_q:
        if evidence.share_V == 0.0:
            evidence.share_V = voltage + whole_V
        # on a flat curve, or with a smaller drop than that, it never was much lower
        is_high = voltage + drop_V > max(evidence.low_V, evidence.share_V + _RISE_V)
        if is_high and min(current, last.lagging_A) >= -REST_CURRENT_A:
            find(evidence, Reason.RECOVERED, time_s, evidence.drawn_C)
    last.count += 1
    last.earlier_V = voltage if last.count == 1 else last.voltage_V
    last.time_s, last.voltage_V, last.current_A = time_s, voltage, current
