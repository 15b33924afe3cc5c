"""The history of the charge of a record: the charge before, the rest, and the counter of the tester."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.records.load import REST_CURRENT_A, VARIED_SHARE

# A charger holds its highest voltage within this, V.
_HELD_V = 0.01
# A charge has tapered off if its last current is below this share of the largest current: a tenth, and a little more because a
# tester need not write the reading that stops it.
_TAPER_SHARE = 0.105


class ChargeBefore(NamedTuple):
    """The charge that ended before a discharge."""

    highest_V: float  # above the voltage at rest
    last_A: float  # magnitude of the last current at that voltage
    largest_A: float  # largest magnitude of the current
    hold_charge_C: float  # charge that flowed at that voltage

    @classmethod
    def of(cls, time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray) -> ChargeBefore:
        """Summarise the samples of a charge."""
        size_A, hold = np.abs(current_A), np.flatnonzero(voltage_V >= voltage_V.max() - _HELD_V)
        hold_charge_C = float(size_A[hold[:-1]] @ np.diff(time_s[hold]))
        # the last row may already mix the charge with the rest after it
        return cls(float(voltage_V.max()), float(size_A[hold[-2:]].max()), float(size_A.max()), hold_charge_C)

    @property
    def is_tapered(self) -> bool:
        """Whether the current tapered off at the highest voltage, so that the cell was full."""
        return self.last_A <= _TAPER_SHARE * self.largest_A

    @property
    def taper_remainder_C(self) -> float:
        """Charge missing to a full cell at the end of a taper, C: the current of a taper falls exponentially."""
        return self.hold_charge_C * self.last_A / (self.largest_A - self.last_A) if self.is_tapered else 0.0


class DischargeStart(NamedTuple):
    """
    The start of a discharge, or the mean start of discharges of one cell that start alike.

    :param voltage_V: the first voltage, in the mean, V
    :param current_A: current at the first voltage, A; 0: at rest
    :param sd_V: standard deviation of the first voltage between the discharges, V
    :param charge: the charge before; ``None``: not recorded
    """

    voltage_V: float
    current_A: float
    sd_V: float = 0.0
    charge: ChargeBefore | None = None

    @classmethod
    def of(cls, record: Any) -> DischargeStart:
        """Return the start of any record."""
        first_A, history = float(record.current_A[0]), history_of(record)
        is_at_rest = history.at_rest or abs(first_A) <= REST_CURRENT_A
        return cls(float(record.voltage_V[0]), 0.0 if is_at_rest else first_A, 0.0, history.charge)

    def is_of_current(self, other: DischargeStart) -> bool:
        """Whether the first voltages are at one current, or both at rest, so that they can be compared."""
        largest_A = max(abs(self.current_A), abs(other.current_A))
        return abs(self.current_A - other.current_A) <= VARIED_SHARE * largest_A

    def is_charged_like(self, other: DischargeStart, tolerance_V: float) -> bool | None:
        """Whether the charges before ended alike; ``None`` if either was not recorded."""
        charge, other_charge = self.charge, other.charge
        if charge is None or other_charge is None:
            return None
        is_of_current = abs(charge.last_A - other_charge.last_A) <= _TAPER_SHARE * max(charge.last_A, other_charge.last_A)
        return is_of_current and abs(charge.highest_V - other_charge.highest_V) <= tolerance_V


class ChargeHistory(NamedTuple):
    """The history of the charge of a record, an input of calibrators."""

    # whether the first voltage is the voltage at rest, even if the first current is of a load that is switched on there
    at_rest: bool = False
    rest_s: float = 0.0  # duration of the rest before the load
    charge: ChargeBefore | None = None  # ``None``: not recorded
    load_on_C: float = 0.0  # sd of the charge by the moment of load-on, which lies between two samples
    offset_A: float = 0.0  # current at rest
    is_counted: bool = False  # whether the tester counted the charge
    sd_counter_C: float = 0.0  # difference of the tester's count and the integral of the current
    start: DischargeStart | None = None  # of the record, if there is a ``usual_start`` to compare it with
    usual_start: DischargeStart | None = None  # of other discharges of the cell


def history_of(record: Any, usual_start: DischargeStart | None = None) -> ChargeHistory:
    """Return the history of the charge of any record, with the usual start of its cell."""
    history: ChargeHistory = getattr(record, "history", ChargeHistory())
    history = history._replace(at_rest=bool(getattr(record, "starts_at_rest", False)))
    if usual_start is None:
        return history
    return history._replace(start=DischargeStart.of(record), usual_start=usual_start)
