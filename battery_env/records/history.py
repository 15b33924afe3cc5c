"""What is known of the charge of a record beside its samples: the charge before, the rest, and the counter of the tester."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray

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


def history_of(record: Any) -> ChargeHistory:
    """What is known of the charge of any record beside its samples."""
    history: ChargeHistory = getattr(record, "history", ChargeHistory())
    return history._replace(at_rest=bool(getattr(record, "starts_at_rest", False)))
