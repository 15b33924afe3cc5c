"""What is known of the charge of a record beside its samples: the charge before, the rest, and the counter of the tester."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.records.load import REST_CURRENT_A, VARIED_SHARE

# A charger holds its highest voltage within this, V.
_HELD_V = 0.01
# A charge has tapered off where its last current is below this share of the largest one: a tenth, and a little more, as a
# tester stops by a reading that it need not write.
_TAPER_SHARE = 0.105


class ChargeBefore(NamedTuple):
    """The charge that ended before a discharge."""

    highest_V: float  # the cell rests below it
    last_A: float  # the current, without a sign, at which that voltage was held last
    largest_A: float  # without a sign
    held_C: float  # what flowed while that voltage was held

    @classmethod
    def of(cls, time_s: FloatArray, voltage_V: FloatArray, current_A: FloatArray) -> ChargeBefore:
        """That of these samples."""
        size_A, held = np.abs(current_A), np.flatnonzero(voltage_V >= voltage_V.max() - _HELD_V)
        held_C = float(size_A[held[:-1]] @ np.diff(time_s[held]))
        # the last row may already mix the charge with what follows
        return cls(float(voltage_V.max()), float(size_A[held[-2:]].max()), float(size_A.max()), held_C)

    @property
    def tapered(self) -> bool:
        """Whether the current tapered off while the voltage was held, so that the cell took all that it could."""
        return self.last_A <= _TAPER_SHARE * self.largest_A

    @property
    def left_C(self) -> float:
        """What the cell had left to take when a taper ended, C: the current falls exponentially while the voltage is held."""
        return self.held_C * self.last_A / (self.largest_A - self.last_A) if self.tapered else 0.0


class DischargeStart(NamedTuple):
    """
    How a discharge starts, or how discharges of one cell do that start alike: what counts as full of this cell.

    :param voltage_V: the first voltage, in the mean, V
    :param current_A: under which current that is, A; 0: at rest
    :param sd_V: standard deviation of that voltage between the discharges, V
    :param charge: the one before; ``None``: it was not recorded
    """

    voltage_V: float
    current_A: float
    sd_V: float = 0.0
    charge: ChargeBefore | None = None

    @classmethod
    def of(cls, record: Any) -> DischargeStart:
        """That of any record."""
        first_A, history = float(record.current_A[0]), history_of(record)
        is_at_rest = history.at_rest or abs(first_A) <= REST_CURRENT_A
        return cls(float(record.voltage_V[0]), 0.0 if is_at_rest else first_A, 0.0, history.charge)

    def is_of_current(self, other: DischargeStart) -> bool:
        """Whether the first voltages are of one current, or both at rest, so that they can be compared."""
        largest_A = max(abs(self.current_A), abs(other.current_A))
        return abs(self.current_A - other.current_A) <= VARIED_SHARE * largest_A

    def is_charged_like(self, other: DischargeStart, tolerance_V: float) -> bool | None:
        """Whether the charges before ended alike; ``None`` if one was not recorded."""
        own, others = self.charge, other.charge
        if own is None or others is None:
            return None
        is_of_current = abs(own.last_A - others.last_A) <= _TAPER_SHARE * max(own.last_A, others.last_A)
        return is_of_current and abs(own.highest_V - others.highest_V) <= tolerance_V


class ChargeHistory(NamedTuple):
    """What is known of the charge of a record beside its samples, which calibrators take in."""

    # whether the first voltage is that of rest, though the first current may be that of a load switched on then
    at_rest: bool = False
    rest_s: float = 0.0  # how long the cell rested before the load
    charge: ChargeBefore | None = None  # the one before; ``None``: not recorded
    load_on_C: float = 0.0  # sd of the charge by the moment of load-on, which lies between two samples
    offset_A: float = 0.0  # what flows at rest
    is_counted: bool = False  # whether the tester counted the charge
    uncounted_C: float = 0.0  # by how much it counted another charge
    start: DischargeStart | None = None  # how the record starts, if other discharges of its cell tell how they do:
    usual_start: DischargeStart | None = None


def history_of(record: Any, usual_start: DischargeStart | None = None) -> ChargeHistory:
    """What is known of the charge of any record beside its samples, and of how other discharges of its cell start."""
    history: ChargeHistory = getattr(record, "history", ChargeHistory())
    history = history._replace(at_rest=bool(getattr(record, "starts_at_rest", False)))
    if usual_start is None:
        return history
    return history._replace(start=DischargeStart.of(record), usual_start=usual_start)
