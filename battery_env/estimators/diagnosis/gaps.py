"""Stretches of a load that were not logged, compiled (numba): whether the voltage says that their charge was drawn."""

from __future__ import annotations

from math import expm1, isnan

from battery_env.compiled import compiled
from battery_env.estimators.diagnosis.faults import Row, middle, noise_V, table
from battery_env.records import REST_CURRENT_A, STEADY_S, SWITCH_SHARE

# An interval between two samples is a gap where it is so many times longer than the one before, and what its load draws in
# the time that is longer is above this share of ``q_mobile``. Loggers that write a row on a change of voltage have intervals
# of all lengths: it is no gap if so many others under load were 1 / _RATIO as long at least, and in no doubt.
_RATIO, _LEAST_SHARE, _HABIT = 2.5, 0.005, 3
# Where the charge of a gap was drawn, cell and model part across it by less than this share of the fall of the model.
_MOST_SHARE = 0.5
# What model and cell part by is averaged over about so many samples before a gap, twice, which tells its trend, and how fast
# the voltage falls over so long, s; after it the middle voltage of three counts.
_PARTED_MEMORY, _RATE_MEMORY_S, _PARTED_SAMPLES = 4.0, 100.0, 3
# With so much of what is no more than noise to spare: one and a half standard deviations of the difference.
_MARGIN_SHARE = 0.25

#: What was expected before a gap: the last interval, the voltage, by how much cell and model part and how fast the voltage
#: falls, both in the mean; the longest intervals under load that were not in doubt, in their order.
USUAL = table(
    [
        *((name, "f8") for name in ("interval_s", "expected_V", "parted_V", "parted_twice_V", "fall_V_per_s")),
        ("longest_s", "f8", _HABIT),
    ]
)

#: The last gap, pending until the voltages after it were seen: its charge, the fall of the model within it, the voltage of
#: the model after it, the first voltages then, and how many; 0: none is pending. And the charge of those that are in doubt,
#: and how long the longest of them is.
GAP = table("length_s end_s charge_C fall_V model_V after_V next_V samples doubt_C doubt_s")


@compiled
def doubtful_C(evidence: Row) -> float:
    """The charge of gaps that are in doubt, or pending."""
    return float(evidence.gap.doubt_C + (evidence.gap.charge_C if evidence.gap.samples > 0.0 else 0.0))


@compiled
def follow(evidence: Row, voltage: float, current: float, expected_V: float, q_mobile: float) -> None:
    """
    Look whether the charge of gaps was drawn, at one sample that is not the first, of which the model expected a voltage. A
    gap is pending from its end until the voltages after it were evidence.
    """
    gap, usual, duration = evidence.gap, evidence.usual, evidence.interval_s
    load_A = max(abs(evidence.current_A), abs(current))
    if gap.samples > 0.0 and gap.length_s <= _RATIO * duration and evidence.time_s - duration == gap.end_s:
        gap.samples = 0.0  # the samples are as far apart from now on
    charge_C = load_A * (duration - usual.interval_s)
    is_long = duration > _RATIO * max(usual.interval_s, usual.longest_s[0])
    is_gap = is_long and load_A > REST_CURRENT_A and charge_C > _LEAST_SHARE * q_mobile
    if is_gap:
        _open(evidence, voltage, current, expected_V, charge_C, load_A)
    else:
        _note_interval(evidence, duration, min(abs(evidence.current_A), abs(current)))
        if gap.samples > 0.0 and not isnan(voltage):
            gap.samples += 1.0
            if gap.samples < _PARTED_SAMPLES:
                gap.next_V = voltage
                # by how much it falls from one sample to the next
                gap.model_V -= gap.fall_V * (evidence.time_s - gap.end_s) / gap.length_s
            else:
                _close(evidence, voltage, load_A)
    if not isnan(voltage):
        if gap.samples == 0.0:
            share = 1.0 / min(evidence.samples - 1.0, _PARTED_MEMORY)
            usual.parted_V += share * (voltage - expected_V - usual.parted_V)
            usual.parted_twice_V += share * (usual.parted_V - usual.parted_twice_V)
        usual.expected_V = expected_V
        if not is_gap and evidence.samples > 2:
            fall_V_per_s = (evidence.before.voltage_1_V - voltage) / duration
            usual.fall_V_per_s += -expm1(-duration / _RATE_MEMORY_S) * (fall_V_per_s - usual.fall_V_per_s)
    usual.interval_s = duration


@compiled
def _note_interval(evidence: Row, interval_s: float, load_A: float) -> None:
    # one that was no gap, or whose charge was drawn: others as long are the habit of the logger, too
    longest_s, gap = evidence.usual.longest_s, evidence.gap
    if interval_s > longest_s[0] and load_A > REST_CURRENT_A:
        longest_s[0] = interval_s
        longest_s.sort()
        if gap.doubt_s <= _RATIO * longest_s[0]:
            gap.doubt_C = gap.doubt_s = 0.0


@compiled
def _doubt(gap: Row) -> None:
    gap.doubt_C += gap.charge_C
    gap.doubt_s = max(gap.doubt_s, gap.length_s)


@compiled
def _open(evidence: Row, voltage: float, current: float, expected_V: float, charge_C: float, load_A: float) -> None:
    gap, usual, duration = evidence.gap, evidence.usual, evidence.interval_s
    if gap.samples > 0.0:
        _doubt(gap)
    gap.length_s, gap.end_s, gap.charge_C, gap.samples = duration, evidence.time_s, charge_C, 1.0
    # samples after a gap are compared with what was expected before it
    gap.fall_V = usual.expected_V - expected_V
    steady_s = evidence.time_s - duration - evidence.examined.jump_s
    if steady_s >= STEADY_S:
        # a model whose q_mobile is not known yet may take its cell for empty: the voltage falls at least as it did before
        gap.fall_V = min(gap.fall_V, usual.fall_V_per_s * duration)
    gap.model_V = usual.expected_V + 2.0 * usual.parted_V - usual.parted_twice_V - gap.fall_V
    gap.after_V = voltage
    # a load that was switched just before may have been switched again
    is_switched = steady_s < duration and evidence.examined.jump_s > evidence.rest.over_s
    if isnan(voltage) or is_switched or abs(current - evidence.current_A) > SWITCH_SHARE * load_A:
        gap.fall_V = 0.0  # which leaves it in doubt


@compiled
def _close(evidence: Row, voltage: float, load_A: float) -> None:
    # The model falls across the gap by the charge that its current draws. A cell that was not loaded meanwhile, or whose clock
    # jumped, does not.
    gap = evidence.gap
    missing_V = middle(gap.after_V, gap.next_V, voltage) - gap.model_V
    gap.samples = 0.0
    if gap.fall_V > 0.0 and missing_V + _MARGIN_SHARE * noise_V(evidence) < _MOST_SHARE * gap.fall_V:
        _note_interval(evidence, gap.length_s, load_A)
        return
    _doubt(gap)
