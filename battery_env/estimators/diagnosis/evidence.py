"""The evidence of a record: whether its cell starts with the charge expected, and its voltage belongs to its current."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import CellParameters
from battery_env.estimates.findings import SETTLED_SHARES, Doubt, Reason
from battery_env.estimators.diagnosis.faults import MOST_NOISE_SD, Dropout, Fault, MeasuredSamples
from battery_env.estimators.diagnosis.gaps import Gaps, gaps_of
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
from battery_env.records.load import switched_charge


@dataclass(frozen=True)
class Evidence:
    """
    Evidence of the samples of a record for or against an estimate. Times are since its first sample.

    :param first_V: the first voltage
    :param first_A: the current at the first voltage; 0: at rest
    :param start_V: the expected first voltage; NaN: unknown
    :param usual_A: the current of the expected first voltage, if other discharges of the cell give it
    :param start: why the cell may have started with another charge; ``None``: its first voltage confirms the expected charge
    :param fault: the first fault
    :param dropouts: momentary changes of the current that the voltage does not follow
    :param charges_C: standard deviations of the charge, by cause
    :param missed_C: charge that the voltage shows in steps, and the current does not
    :param offset_A: the mean current before the load
    :param gap_s: begin and end of the last gap
    :param switches: number of switches of the load between samples
    :param is_smeared: whether switches are too many to tell the current of each voltage
    """

    first_V: float = nan
    first_A: float = 0.0
    start_V: float = nan
    usual_A: float = 0.0
    start: Reason | None = None
    fault: Fault | None = None
    dropouts: tuple[Dropout, ...] = ()
    charges_C: Mapping[Doubt, float] = field(default_factory=dict)
    missed_C: float = 0.0
    offset_A: float = 0.0
    gap_s: tuple[float, float] = (0.0, 0.0)
    switches: int = 0
    is_smeared: bool = False

    @property
    def sd_charge_C(self) -> float:
        """Root sum of squares of all uncertainties of the charge."""
        return sqrt(sum((charge_C**2 for charge_C in self.charges_C.values()), self.missed_C**2))

    def measured(self, initial_soc: float, clock_s: float = 0.0, charge: ChargeBefore | None = None) -> dict[str, Any]:
        """Return the measured values by the names in the texts of findings, with times after ``clock_s``."""
        charge = charge or ChargeBefore(nan, nan, nan, nan)
        fault = self.fault or Fault(Reason.SETTLED, nan, nan)
        return {
            "first_V": self.first_V,
            "rest_V": self.start_V,
            "first_A": self.first_A,
            "usual_A": self.usual_A,
            "initial_soc": initial_soc,
            "charge_V": charge.highest_V,
            "charge_A": charge.last_A,
            "offset_A": self.offset_A,
            "fault_s": clock_s + fault.time_s,
            **dict.fromkeys(("drawn_C", "change_A", "rise_V"), fault.size),  # the text of the fault names one of them
            "dropout_s": clock_s + (self.dropouts[0].begin_s if self.dropouts else nan),
            "switches": self.switches,
            "missed_C": self.missed_C,
            "gap_start_s": clock_s + self.gap_s[0],
            "gap_end_s": clock_s + self.gap_s[1],
        }


def evidence_of(
    record: Samples,
    cell: CellParameters,
    initial_soc: float | None,
    estimate: Sequence[float],
    history: ChargeHistory,
    model_V: FloatArray | None = None,
) -> Evidence:
    """
    Return the evidence of a record for an estimate of ``q_mobile``, C, and ``r_o``, ohm. Without a state of charge there is no
    expected start; without the voltage of the model there are no gaps.
    """
    # a user who states another charge knows the start
    history = history if initial_soc == 1.0 else history._replace(usual_start=None)
    (q_mobile, r_o), samples, first_V = estimate, MeasuredSamples.of(record), float(record.voltage_V[0])
    expected, rest = _ExpectedStart.of(cell, initial_soc, history), _Rest.of(record, history)
    resistance_ohm = samples.least_resistance_ohm(q_mobile, r_o)
    response = samples.response(resistance_ohm)
    recovery = samples.recovery(expected.low_V, max(q_mobile, cell.q_mobile), resistance_ohm, response.switched_s)
    faults = [*response.faults, *filter(None, (samples.rise(), recovery))]
    fault = min(faults, key=lambda fault_at: fault_at[0])[1] if faults else None
    # ``rest`` has the charge of load-on
    load_rows = slice(rest.load_on_row, None)
    switch_charge = switched_charge(record.time_s[load_rows], record.current_A[load_rows])
    gaps = Gaps() if model_V is None else gaps_of(record, model_V, q_mobile, samples, rest.end_s)
    drawn_C = float(record.current_A[:-1] @ np.diff(record.time_s))
    return Evidence(
        first_V=first_V,
        first_A=0.0 if history.at_rest else float(record.current_A[0]),
        start_V=expected.voltage_V,
        usual_A=expected.usual_A or 0.0,
        start=expected.reason(first_V),
        fault=fault,
        dropouts=tuple(response.dropouts),
        charges_C={
            Doubt.LOAD_ON: rest.load_on_C,
            Doubt.REST_CURRENT: rest.charge_C,
            Doubt.CHARGE_LEFT: expected.remaining_charge_C(first_V, cell.q_mobile),
            Doubt.UNCOUNTED: history.sd_counter_C,
            Doubt.DROPPED: sum(dropout.charge_C for dropout in response.dropouts),
            Doubt.SWITCHES: 0.0 if history.is_counted else switch_charge.sd_C,
            Doubt.GAP: gaps.doubt_C,
        },
        missed_C=samples.missed_C(),
        offset_A=rest.mean_A,
        gap_s=gaps.span_s,
        switches=switch_charge.switches,
        is_smeared=switch_charge.sd_C > SETTLED_SHARES["q_mobile"] * drawn_C,
    )


def dropouts_of(record: Samples, cell: CellParameters) -> list[Dropout]:
    """Return the momentary changes of the current of a record, until a model's ohmic drop after them has decayed."""
    samples = MeasuredSamples.of(record)
    return samples.response(samples.least_resistance_ohm(cell.q_mobile, cell.r_o)).dropouts


@dataclass
class _ExpectedStart:
    """
    The expected start of a discharge: that of a full cell at rest, or of other discharges of the cell.

    :param voltage_V: the voltage; NaN: unknown
    :param low_V: a cell with a lower first voltage lacks charge
    :param high_V: a cell with a higher first voltage is another cell
    :param usual_A: the current of these voltages, if they are of other discharges of the cell; otherwise ``None``
    :param is_full: whether the charge before filled the cell; ``None``: unknown
    :param taper_remainder_C: charge missing to a full cell at the end of the charge before
    :param is_cut_short: whether the charge before ended before it tapered off
    """

    voltage_V: float
    low_V: float
    high_V: float
    usual_A: float | None = None
    is_full: bool | None = None
    taper_remainder_C: float = 0.0
    is_cut_short: bool = False

    @classmethod
    def of(cls, cell: CellParameters, initial_soc: float | None, history: ChargeHistory) -> _ExpectedStart:
        """Return the expected start of a cell with a state of charge and a history."""
        if initial_soc is None:
            return cls(nan, nan, nan)
        rest_V, charge = rest_voltage_V(cell, initial_soc), history.charge
        expected = cls(rest_V, low_rest_voltage_V(cell, initial_soc), rest_V + ABOVE_REST_V)
        if charge is not None:
            # a charge that did not taper off leaves the cell below full; only a rest can show by how much
            is_low = charge.highest_V < expected.low_V or (not charge.is_tapered and history.rest_s < STEADY_S)
            expected.is_full = False if is_low else charge.is_tapered or None
            expected.taper_remainder_C, expected.is_cut_short = charge.taper_remainder_C, not charge.is_tapered
        if history.start is not None and history.usual_start is not None:
            expected._expect_usual(history.start, history.usual_start)
        return expected

    def _expect_usual(self, start: DischargeStart, usual: DischargeStart) -> None:
        """Expect the voltage of other discharges of the cell, or their charge if their load differs."""
        span_V, is_of_current = self.voltage_V - self.low_V, start.is_of_current(usual)
        is_like = start.is_charged_like(usual, span_V)
        if not is_of_current and is_like is None:
            return
        self.voltage_V, self.usual_A = usual.voltage_V, usual.current_A
        if not is_of_current:
            self.is_full, self.is_cut_short, self.high_V = bool(is_like), False, inf
            return
        spread_V = MOST_NOISE_SD * usual.sd_V
        self.low_V, self.high_V = usual.voltage_V - span_V - spread_V, usual.voltage_V + ABOVE_REST_V + spread_V
        if start.charge is not None:
            is_low, is_full = start.charge.highest_V < self.low_V, start.charge.is_tapered and is_like is not False
            self.is_full = False if is_low else is_full or None

    def remaining_charge_C(self, first_V: float, cell_q_mobile: float) -> float:
        """Return the charge missing to a full cell; after a charge that was cut short the voltage at rest gives it."""
        if not self.is_cut_short or not first_V < self.voltage_V:
            return self.taper_remainder_C
        return LACKING_SHARE * cell_q_mobile * (self.voltage_V - first_V) / (self.voltage_V - self.low_V)

    def reason(self, first_V: float) -> Reason | None:
        """
        Return why a cell may have started otherwise; ``None`` if its first voltage confirms the expected start. Under load the
        unknown ohmic drop lowers this voltage, so that it cannot show a small lack of charge.
        """
        is_other = first_V > self.high_V or (self.is_full is None and first_V < self.low_V)
        if self.usual_A is not None:
            return Reason.START_UNLIKE if is_other or self.is_full is False else None
        if is_other:
            return Reason.START_DIFFERS
        return Reason.START_CHARGED if self.is_full is False else None


class _Rest(NamedTuple):
    """
    The current before the load.

    :param mean_A: its mean
    :param end_s: end of the rest; 0: before the first sample, or never
    :param load_on_row: the first sample under load; 0: the first sample of all, or none
    :param load_on_C: standard deviation of the charge by the moment of load-on
    :param charge_C: charge of the mean current from then on
    """

    mean_A: float
    end_s: float = 0.0
    load_on_row: int = 0
    load_on_C: float = 0.0
    charge_C: float = 0.0

    @classmethod
    def of(cls, record: Samples, history: ChargeHistory) -> _Rest:
        """Return the rest of a record, or of the recording that it is a part of."""
        time_s, current_A = record.time_s - record.time_s[0], record.current_A
        if history.load_on_C or history.offset_A:
            charge_C = abs(history.offset_A) * float(time_s[-1])
            return cls(history.offset_A, load_on_C=history.load_on_C, charge_C=charge_C)
        means_A, size_A = np.cumsum(current_A) / np.arange(1, len(current_A) + 1), np.abs(current_A)
        largest_A = np.maximum(np.maximum(size_A[1:], np.abs(means_A[:-1])), REST_CURRENT_A)
        switch_rows = np.flatnonzero(np.abs(current_A[1:] - means_A[:-1]) > SWITCH_SHARE * largest_A)
        if not len(switch_rows):
            return cls(float(means_A[-1]))
        previous_row = int(switch_rows[0])
        mean_A, row, end_s = float(means_A[previous_row]), previous_row + 1, float(time_s[previous_row + 1])
        is_rest = abs(mean_A) <= LOAD_SHARE * size_A.max()
        charge_C = abs(mean_A) * float(time_s[-1] - end_s) if is_rest else 0.0
        if abs(mean_A) > LOAD_SHARE * size_A[row]:
            return cls(mean_A, end_s, charge_C=charge_C)
        interval_s = np.diff(time_s)
        on_s, earlier_s = float(interval_s[previous_row]), interval_s[:previous_row][-1:].tolist()
        neighbour_s = [*interval_s[row : row + 1].tolist(), *earlier_s]
        if row + 1 < len(time_s) and on_s <= 2.0 * max(neighbour_s):
            # unless samples are missing, the load came on within one interval of the samples under load
            on_s = min(on_s, neighbour_s[0])
        return cls(mean_A, end_s, row, on_s * abs(float(current_A[row]) - mean_A) / sqrt(3.0), charge_C)
