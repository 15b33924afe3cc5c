"""
Why an estimate is not settled: one table of reasons for least squares, the filter, policies and the closed form, with their
order, their texts, and against which number each speaks; and the limits that they name. :mod:`battery_env.estimators.verdict`
goes by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from itertools import permutations
from typing import Any

from battery_env.parameters import PARAMETER_NAMES

#: An estimate is settled when its standard deviation is below this share of its value. That of ``r_o`` is wider: on a real
#: cell the error of the model divided by the current is a quarter of it already.
SETTLED_SHARES = {"q_mobile": 0.02, "r_o": 0.3}
#: What makes most of a variance is the reason for it.
MOST_OF_SD = 0.5**0.5

_AT_BOUND = "{} is at a bound of its search, where the record does not determine it."
_DIFFERS = "The policy and the fit in its observation differ by {{differs_{0}:.1%}} in {1}: it does not trust the fit."
_DROPPED = "The current changes for a moment, and the voltage does not follow: {} in doubt."
_SWITCHES = (
    "The load is switched between two samples, nobody knows when, {{switches}} times: {}. Log a sample before and after each "
    "switch, a second apart{}."
)
_PRIOR_WRONG = "The prior of {} contradicts what the record says."
_PRIOR_ALONE = "{} rests on its prior: the record alone does not determine it yet. Without it {}"
_SCALE_UNKNOWN = (
    "{} is known no better than what scales it and shows nowhere in the voltage: the gain of the current sensor "
    "(current_gain_sd) and the charge at the start (initial_soc)."
)
_IMPRECISE_Q = (
    "q_max is not known to 2 % yet: the voltage shows it at the knee, the steep end of the discharge, and the record does not "
    "go far enough into it. Discharge further; to the same cut-off, with less current, or with constants that were fitted to "
    "more of a life of this cell (fit_cell, --cell)."
)
_IMPRECISE_R = (
    "R_o is not known to 30 %: the error expected of noise and model, divided by the current, is larger. Take a larger "
    "current, or state a smaller mismatch_V if the model is that good."
)


class Reason(IntEnum):
    """
    What speaks against an estimate, in the order in which it counts: of each number the first row that speaks against it is
    the reason. Most speak against both numbers, and come before those against one. Braces name what was measured. A row of
    ``q_mobile`` is followed by that of ``r_o``.
    """

    def __new__(cls, text: str, *against: str) -> Reason:
        number = len(cls.__members__) + 1
        member = int.__new__(cls, number)
        member._value_ = number
        member.text, member.against = text, against or PARAMETER_NAMES
        return member

    text: str
    against: tuple[str, ...]

    # a policy that states nothing
    NO_FIT = "A policy whose observation has no fit (option nuisance) states no uncertainty."
    NOT_YET = "The policy states nothing before its next decision."
    # a start that constants of another cell cannot judge
    OTHER_KIND = (
        "The record starts at {first_V:.2f} V, where {expected} at rest shows {rest_V:.2f} V, and the voltage of the model is "
        "{rmse_mV:.0f} mV off (RMSE), where {mismatch_mV:.0f} mV are stated (mismatch_V): another kind of cell than these "
        "constants, or another charge at the start. Fit constants to it (fit_cell, --cell), or state initial_soc "
        "(--initial-soc)."
    )
    # the start, and samples that a policy cannot read
    START_UNKNOWN = (
        "The record does not start with a minute at rest, whose voltage would tell the charge. Give the rest before the load, "
        "or state initial_soc."
    )
    REST_UNKNOWN = (
        "The voltage at rest of these constants does not rise with the charge, and so does not tell it: state initial_soc, or "
        "fit constants to discharges with pauses."
    )
    START_ABOVE = (
        "The record starts at {first_V:.2f} V, above the {rest_V:.2f} V of {expected} at rest: it had not rested since its "
        "charge, or is another kind of cell or sensor. Give a minute at rest before the load, or fit constants (fit_cell, "
        "--cell)."
    )
    START_CHARGED = (
        "The charge before the load ended at {charge_V:.2f} V, still under {charge_A:.3g} A: the cell rests below that, and "
        "{expected} at {rest_V:.2f} V. Charge until the current has tapered off, or state initial_soc (--initial-soc)."
    )
    START_BELOW = "The record starts at {first_V:.2f} V, where {expected} at rest shows {rest_V:.2f} V. {start_advice}"
    START_LOADED = (
        "The record starts under load at {first_V:.2f} V, which need not be that of {expected}: it rests at {rest_V:.2f} V "
        "then. {start_advice}"
    )
    OTHER_LOAD = (
        "The load, {load_A:.3g} A, is none of those that the constants were fitted to, {fitted} A, and they hold for these: "
        "fit discharges of this load, too."
    )
    # faults of the samples; a stream keeps the first one in time
    RECOVERED = (
        "The voltage comes back to that of the start at {fault_s:.0f} s, though {size:.0f} C were drawn: the cell was charged."
        " Reset the filter when a discharge begins."
    )
    NOT_FOLLOWED = "The current changes by {size:.2f} A at {fault_s:.0f} s, and the voltage does not follow."
    RISES = "The voltage rises by {size:.2f} V at {fault_s:.0f} s, where the current stays as it was."
    MISSED = (
        "Between two samples under a steady load the voltage steps by what {missed_C:.0f} C make: rows are missing together "
        "with their time, or a charge is, that flowed and was not measured. Export all rows, with the clock of the tester."
    )
    # what was given does not suffice
    EMPTY = "The model cell is empty before the record ends: its q_max is too small for this record."
    FEW = "These are too few {of} to tell the noise. Record on or more often{or_else}."
    # the fit
    IMPLAUSIBLE = (
        "No cell of this kind has such a q_max. Check that time is in s and current in A, and that the record is of one "
        "cell; for a cell of another size fit constants (fit_cell, --cell)."
    )
    Q_AT_BOUND = _AT_BOUND.format("q_max")
    R_AT_BOUND = _AT_BOUND.format("R_o")
    CHARGE_DIFFERS = (
        "The charge that moves in the last step, {moved_C:.4g} C, is not that of the current, {drawn_C:.4g} C: check time, "
        "current and their units."
    )
    MISFIT = (
        "The voltage of the model is farther off than noise and mismatch_V explain: fit constants to this cell (fit_cell, "
        "--cell), state a larger mismatch_V, or check the sensors, the prior if one was given, and that this is one discharge."
    )
    OTHER_END = "The record falls to {lowest_V:.2f} V at {end_s:.0f} s, where this estimate says {model_end_s:.0f} s."
    OFFSET = (
        "The fit in the observation takes the voltage for {offset_mV:.0f} mV off, where the policy has learned of "
        "{most_mV:.0f} mV at most."
    )
    CONSTANTS = "A constant of the cell is farther from the model's than the policy has learned of (option nuisance)."
    BESIDE_PATH = (
        "The cell lies {distance:.1f} standard deviations beside the path of aging cells: it is of another kind, or its load "
        "is. Leave the path out."
    )
    Q_PRIOR_WRONG = _PRIOR_WRONG.format("q_max")
    R_PRIOR_WRONG = _PRIOR_WRONG.format("R_o")
    # after what makes it so
    UNEXPLAINED = (
        "The voltage is farther off than noise, an offset and the constants that the policy knows of explain: use least "
        "squares with mismatch_V, or check the sensors and that this is one discharge."
    )
    # what the record does not tell of one number
    NO_CURRENT = "No current flows in the last step, so that R_o does not show.", "r_o"
    Q_DIFFERS = _DIFFERS.format("q_mobile", "q_max"), "q_mobile"
    R_DIFFERS = _DIFFERS.format("r_o", "R_o"), "r_o"
    TAPERED_EARLY = (
        "The charge before the load ended while {charge_A:.3g} A still flowed: the cell had some {left_C:.0f} C left to take. "
        "Charge until less flows, or state initial_soc (--initial-soc).",
        "q_mobile",
    )
    LOAD_ON_UNSURE = (
        "The load came on between two samples, nobody knows when: {load_on_C:.0f} C are in doubt. Give samples around the "
        "moment.",
        "q_mobile",
    )
    REST_CURRENT = (
        "{offset_A:.3g} A flow at rest, an offset of the sensor or a load that nobody meant: {offset_C:.0f} C are in doubt. "
        "Subtract it from the current if it is an offset.",
        "q_mobile",
    )
    UNCOUNTED = (
        "The tester counted another charge than current and time make: {uncounted_C:.0f} C are in doubt. Check units and "
        "clock, and export the time since the start of the test.",
        "q_mobile",
    )
    Q_DROPPED = _DROPPED.format("{dropped_C:.0f} C are"), "q_mobile"
    R_DROPPED = _DROPPED.format("{dropped_mohm:.0f} mohm of R_o are"), "r_o"
    Q_SWITCHES = _SWITCHES.format("{switched_C:.0f} C are in doubt", ", or the charge that the tester counts"), "q_mobile"
    R_SWITCHES = _SWITCHES.format("R_o does not show", ""), "r_o"
    GAP = (
        "No sample lies between {gap_start_s:.0f} s and {gap_end_s:.0f} s, and the voltage does not show that the load was "
        "on: {gap_C:.0f} C are in doubt. Correct the times if the clock jumped, or give a rest as samples of no current.",
        "q_mobile",
    )
    Q_PRIOR_ALONE = _PRIOR_ALONE.format("q_max", _IMPRECISE_Q), "q_mobile"
    R_PRIOR_ALONE = _PRIOR_ALONE.format("R_o", _IMPRECISE_R), "r_o"
    PATH_UNTESTED = (
        "What the record tells of R_o rests on the path of aging cells, as long as q_max does not show that it fits.",
        "r_o",
    )
    R_OF_CONSTANTS = (
        "The discharges that the constants were fitted to leave {of_cell_mohm:.0f} mohm of R_o open: fit such of other loads, "
        "or with pauses, too.",
        "r_o",
    )
    Q_SCALE_UNKNOWN = _SCALE_UNKNOWN.format("q_max"), "q_mobile"
    R_SCALE_UNKNOWN = _SCALE_UNKNOWN.format("R_o"), "r_o"
    Q_IMPRECISE = _IMPRECISE_Q, "q_mobile"
    R_IMPRECISE = _IMPRECISE_R, "r_o"
    # none of these
    SETTLED = ""

    def of(self, name: str) -> Reason:
        """The row of a parameter, where this one is that of ``q_mobile``."""
        return Reason.numbered(self + PARAMETER_NAMES.index(name))

    @staticmethod
    def numbered(number: int) -> Reason:
        """The row of a number that compiled code found."""
        return _ROWS[number - 1]

    def said(self, measured: Mapping[str, Any]) -> str:
        """The text, filled with what was measured."""
        return self.text.format_map(measured)


_ROWS = tuple(Reason)


def is_only_imprecise(reason: str) -> bool:
    """Return whether an estimate is not settled by its precision alone: nothing in the record contradicts it."""
    texts = [row.text for row in Reason if Reason.Q_PRIOR_ALONE <= row < Reason.SETTLED]
    return reason in {*texts, *map(" ".join, permutations(texts, 2))}
