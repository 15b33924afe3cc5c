"""
Findings: why an estimate is not settled, as data. One table has the reasons of all calibrators in their order, another one
what leaves a charge or a resistance in doubt. All texts are made here.
:mod:`battery_env.estimators.verdict` goes by them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from battery_env.parameters import Q_MOBILE

#: An estimate is settled when its standard deviation is below this share of its value. That of ``r_o`` is wider: on a real
#: cell the error of the model divided by the current is a quarter of it already.
SETTLED_SHARES = {"q_mobile": 0.02, "r_o": 0.3, "resistance_10s": 0.3}
#: What makes most of a variance is the reason for it.
MOST_OF_SD = 0.5**0.5

_LACK_OF_CURRENT = (
    "the error expected of noise and model, divided by the current, is larger. Take a larger current, or state a smaller "
    "mismatch_V if the model is that good"
)
# What texts say of each number: its name, how much of it is in doubt, how well it has to be known, and what an estimate lacks.
# A doubt has a size, under the name that stands in braces there.
_OF_NUMBER: Mapping[str, Mapping[str, Any]] = {
    "q_mobile": {
        "name": "q_max",
        "size": "in_doubt_C",
        "in_doubt": "{in_doubt_C:.0f} C are in doubt: ",
        "limit_percent": 100.0 * SETTLED_SHARES["q_mobile"],
        "lack": (
            "the voltage shows it at the knee, the steep end of the discharge, and the record does not go far enough into it. "
            "Discharge further; to the same cut-off, with less current, or with constants that were fitted to more of a life "
            "of this cell (fit_cell, --cell)"
        ),
    },
    "r_o": {
        "name": "R_o",
        "size": "in_doubt_ohm",
        "in_doubt": "{in_doubt_ohm:.3f} ohm of R_o are in doubt: ",
        "limit_percent": 100.0 * SETTLED_SHARES["r_o"],
        "lack": _LACK_OF_CURRENT,
    },
    "resistance_10s": {
        "name": "The resistance after ten seconds",
        "size": "in_doubt_ohm",
        "in_doubt": "{in_doubt_ohm:.3f} ohm of the resistance after ten seconds are in doubt: ",
        "limit_percent": 100.0 * SETTLED_SHARES["resistance_10s"],
        "lack": _LACK_OF_CURRENT,
    },
}
# What texts say in words, by what was measured of it.
_WORDS = {"expected": ("initial_soc",), "fitted": ("least_fitted_A", "most_fitted_A")}
_IMPRECISE = "{name} is not known to {limit_percent:.0f} % yet: {lack}."


class _Row(IntEnum):
    """A row of a table, by its number from 1 on; braces in its text name what was measured."""

    def __new__(cls, text: str) -> _Row:
        number = len(cls.__members__) + 1
        member = int.__new__(cls, number)
        member._value_ = number
        member.text = text
        return member

    text: str


class Doubt(_Row):
    """What leaves some charge, or some resistance, in doubt: a size in the standard deviation, and what would resolve it."""

    LOAD_ON = "the load came on between two samples, nobody knows when. Give samples around the moment."
    REST_CURRENT = (
        "{offset_A:.3g} A flow at rest, an offset of the sensor or a load that nobody meant. Subtract it from the current if "
        "it is an offset."
    )
    CHARGE_LEFT = (
        "the charge before the load ended while {charge_A:.3g} A still flowed, and the cell had some left to take. Charge "
        "until less flows, or state initial_soc (--initial-soc)."
    )
    UNCOUNTED = (
        "the tester counted another charge than current and time make. Check units and clock, and export the time since the "
        "start of the test."
    )
    DROPPED = (
        "the current changes for a moment at {dropout_s:.0f} s, and the voltage does not follow. Check the current sensor and "
        "its logger."
    )
    SWITCHES = (
        "the load is switched between two samples, nobody knows when, {switches:.0f} times. Log a sample before and after "
        "each switch, a second apart, or the charge that the tester counts."
    )
    GAP = (
        "no sample lies between {gap_start_s:.0f} s and {gap_end_s:.0f} s, and the voltage does not show that the load was "
        "on. Correct the times if the clock jumped, or give a rest as samples of no current."
    )
    KNEE = (
        "where the record ends, its voltage falls less steeply than that of the model. The knee of this cell may come later. "
        "Discharge further, or fit constants to this cell (fit_cell, --cell)."
    )
    POLICY = "the policy is so far from the fit in its observation, which it does not trust. Use least squares."


class Reason(_Row):
    """
    What speaks against an estimate, in the order in which it counts: of each number the first row that speaks against it is
    the reason. Most speak against both numbers.
    """

    NOTHING_STATED = (
        "The policy states no uncertainty: it does from its first decision on, and where its observation has a fit (option "
        "nuisance)."
    )
    # the start
    START_UNKNOWN = (
        "The record does not start with a minute at rest whose voltage tells the charge with these constants. Give the rest "
        "before the load, state initial_soc, or fit constants to discharges with pauses."
    )
    START_CHARGED = (
        "The charge before the load ended at {charge_V:.2f} V, still under {charge_A:.3g} A: the cell rests below that, and "
        "{expected} at {rest_V:.2f} V. Charge until the current has tapered off, or state initial_soc (--initial-soc)."
    )
    START_DIFFERS = (
        "The record starts at {first_V:.2f} V under {first_A:.3g} A, where {expected} at rest shows {rest_V:.2f} V: it has "
        "not rested, holds another charge, or is another kind of cell. Give the whole discharge of a full cell with a minute "
        "at rest before it, state initial_soc (--initial-soc), or fit constants to such cells (fit_cell, --cell)."
    )
    START_UNLIKE = (
        "The record starts at {first_V:.2f} V under {first_A:.3g} A, where the discharges of its life, or of its fit, do at "
        "{rest_V:.2f} V under {usual_A:.3g} A: it was charged or has rested otherwise, or is of another cell. Give one that "
        "starts as they do, or state initial_soc (--initial-soc)."
    )
    OTHER_LOAD = (
        "The load, {load_A:.3g} A, is none of those that the constants were fitted to, {fitted} A, and they hold for these: "
        "fit discharges of this load, too."
    )
    # faults of the samples, of which the first one in time is kept
    RECOVERED = (
        "The voltage comes back to that of the start at {fault_s:.0f} s, though {drawn_C:.0f} C were drawn: the cell was "
        "charged. Give each discharge alone; call reset() of a stream when one begins."
    )
    NOT_FOLLOWED = "The current changes by {change_A:.2f} A at {fault_s:.0f} s, and the voltage does not follow."
    RISES = "The voltage rises by {rise_V:.2f} V at {fault_s:.0f} s, where the current stays as it was."
    MISSED = (
        "Between two samples under a steady load the voltage steps by what {missed_C:.0f} C make: rows are missing together "
        "with their time, or a charge is, that flowed and was not measured. Export all rows, with the clock of the tester."
    )
    # what was given does not suffice
    EMPTY = "The model cell is empty before the record ends: its q_max is too small for this record."
    FEW = "These are too few samples to tell the noise. Record on or more often; least squares take voltage_noise_V, too."
    # the fit
    IMPLAUSIBLE = (
        "No cell of this kind has such a q_max. Check that time is in s and current in A, and that the record is of one "
        "cell; for a cell of another size fit constants (fit_cell, --cell)."
    )
    AT_BOUND = "{name} is at a bound of its search, where the record does not determine it."
    CHARGE_DIFFERS = (
        "The charge that moves in the last step, {moved_C:.4g} C, is not that of the current, {drawn_C:.4g} C: check time, "
        "current and their units."
    )
    OTHER_KIND = (
        "The {what} is {ratio:.1f} times the largest that is allowed for: the cell is of another kind, or its load is, or a "
        "sensor is off. Use least squares, without a path."
    )
    PRIOR_WRONG = (
        "{name} is {record_Ah:.3g} Ah by the record, outside of the {least_Ah:.3g} to {most_Ah:.3g} Ah that the prior, the "
        "life or the nominal capacity allows. Check the unit and the gain of the current, that the record is of this cell, "
        "and what was stated."
    )
    MISFIT = (
        "The voltage of the model is farther off than noise and mismatch_V explain: fit constants to this cell (fit_cell, "
        "--cell), state a larger mismatch_V (a policy takes none), or check the sensors, the prior if one was given, and that "
        "this is one discharge."
    )
    RESISTANCE_DIFFERS = (
        "{after_s:.0f} s after the load was switched on, at {step_s:.0f} s, the resistance is {measured_ohm:.3f} ohm as "
        "measured and {model_ohm:.3f} ohm by the fit of the whole record, {apart_sd:.1f} standard deviations apart: current "
        "and voltage are not of the same moments, as if a sensor lags or averages. Check both sensors and their logger."
    )
    # what the record does not tell of one number
    IN_DOUBT = ""  # the text is that of the doubt
    BELOW_ALL_SIZES = (
        f"Cells below {min(Q_MOBILE.limits) / 3.6:.0f} mAh are not modelled, nor fitted: what was drawn is known, and no more."
    )
    OTHER = "{message}"  # of a record that cannot be used, or of an estimator of your own
    PRIOR_ALONE = "{name} rests on its prior: the record alone does not determine it yet. Without it " + _IMPRECISE
    PATH_UNTESTED = (
        "What the record tells of R_o rests on the path of aging cells, as long as q_max does not show that it fits. "
        "Discharge further."
    )
    SCALE_UNKNOWN = (
        "{name} is known no better than what scales it and shows nowhere in the voltage: the gain of the current sensor "
        "(current_gain_sd) and the charge at the start (initial_soc)."
    )
    IMPRECISE = _IMPRECISE
    # none of these
    SETTLED = ""


#: All that can be found, by its code.
CODES: Mapping[str, Reason | Doubt] = {row.name.lower(): row for row in (*Reason, *Doubt) if row.text}


@dataclass(frozen=True)
class Finding:
    """
    A reason against an estimate. ``str`` returns a text with the remedy.

    :param code: the kind of the reason, a key of :data:`CODES`
    :param number: the number in question, ``"q_mobile"``, ``"r_o"`` or ``"resistance_10s"``; empty: the record as a whole
    :param measured: the measured values, by names with SI units
    """

    code: str
    number: str = ""
    measured: Mapping[str, float | str] = field(default_factory=dict, hash=False)

    @classmethod
    def of(cls, row: Reason | Doubt, number: str = "", size: float | None = None, **measured: Any) -> Finding:
        """
        A finding of some row, with that part of what was measured which its text names.

        :param size: how much a doubt leaves open
        """
        named = [part for name in re.findall(r"{(\w+)", row.text) for part in _WORDS.get(name, (name,))]
        sizes = {} if size is None else {_OF_NUMBER[number]["size"]: float(size)}
        told = {name: value if isinstance(value, str) else float(value) for name, value in measured.items() if name in named}
        return cls(row.name.lower(), number, sizes | told)

    def __str__(self) -> str:
        row, of_number = CODES[self.code], _OF_NUMBER.get(self.number, {})
        text = of_number["in_doubt"] + row.text if isinstance(row, Doubt) else row.text
        return text.format_map({**of_number, **_words(self.measured), **self.measured})


def _words(measured: Mapping[str, Any]) -> dict[str, str]:
    """What texts say in words."""
    words = {}
    if "initial_soc" in measured:
        soc = measured["initial_soc"]
        words["expected"] = "a full cell" if soc == 1.0 else f"a cell with {soc:.0%} of its charge"
    if "least_fitted_A" in measured:
        words["fitted"] = " to ".join(dict.fromkeys(f"{measured[name]:.3g}" for name in _WORDS["fitted"]))
    return words


def reason_of(findings: Iterable[Finding]) -> str:
    """Findings as one text."""
    return " ".join(map(str, findings))


def codes_of(findings: Iterable[Finding]) -> str:
    """The codes of findings, each with the number that it is about, as in ``misfit imprecise:r_o``."""
    return " ".join(":".join(filter(None, (each.code, each.number))) for each in findings)


def findings_of(rows: Iterable[Mapping[str, Any]]) -> tuple[Finding, ...]:
    """Findings from what ``asdict`` made of them."""
    return tuple(Finding(**row) for row in rows)


def is_only_imprecise(findings: Iterable[Finding]) -> bool:
    """Return whether an estimate is not settled by its precision alone: nothing in the record contradicts it."""
    rows = [CODES[each.code] for each in findings]
    return bool(rows) and all(row is Doubt.KNEE or (isinstance(row, Reason) and row >= Reason.PRIOR_ALONE) for row in rows)
