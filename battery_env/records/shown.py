"""What a record shows beside the samples under load: the charge before it, what flows at rest, and when the load came on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.records.samples import SWITCH_SHARE

# A charger holds its highest voltage within this, V.
_HELD_V = 0.01
# By so much of the largest current the last one written may differ from the one by which a charge was ended.
_READ_SHARE = 0.005


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
        """
        Whether the current fell to a tenth while the voltage was held, so that the cell took all that it could; about so, as a
        tester stops by a reading that it need not write.
        """
        return self.last_A <= (SWITCH_SHARE + _READ_SHARE) * self.largest_A

    @property
    def left_C(self) -> float:
        """What the cell had left to take when a taper ended, C: the current falls exponentially while the voltage is held."""
        return self.held_C * self.last_A / (self.largest_A - self.last_A) if self.tapered else 0.0


class Shown(NamedTuple):
    """What a record shows beside its samples, which calibrators take in."""

    # whether the first voltage is that of rest, though the first current may be that of a load switched on then
    at_rest: bool = False
    rest_s: float = 0.0  # how long the cell rested before the load
    charge: ChargeBefore | None = None  # the one before; ``None``: not recorded
    # when the load came on, as the tester says, on the clock of the record; ``None``: it does not
    load_on_s: float | None = None
    load_on_C: float = 0.0  # sd of the charge by the moment of load-on, which lies between two samples
    offset_A: float = 0.0  # what flows at rest
    is_counted: bool = False  # whether the tester counted the charge
    # by how much it counted another charge or, without a count, what a clock of each step does not tell
    uncounted_C: float = 0.0


def shown_beside(record: Any) -> Shown:
    """What is known of any record beside its samples."""
    shown: Shown = getattr(record, "shown", Shown())
    return shown._replace(at_rest=bool(getattr(record, "starts_at_rest", False)))


def load_on_sd_C(time_s: FloatArray, current_A: FloatArray, first: int, load_on_s: float) -> float:
    """
    The standard deviation of the charge by the moment at which a load came on before its sample ``first``: at any time between
    the two samples where some are missing, that is where they lie more than twice as far apart as those before and after, and
    else as much earlier as later than at ``load_on_s``.
    """
    if not first:
        return 0.0
    before_s, after_s = time_s[first - 1], time_s[first]
    beside_s = np.diff(time_s[max(first - 2, 0) : first]), np.diff(time_s[first : first + 2])
    is_missing = after_s - before_s > 2.0 * max((*beside_s[0], *beside_s[1]), default=0.0)
    earliest_s = before_s if is_missing else max(before_s, 2.0 * load_on_s - after_s)
    late_s, early_s = after_s - load_on_s, load_on_s - earliest_s
    return float(np.sqrt((late_s**3 + early_s**3) / (3.0 * (late_s + early_s))) * (current_A[first] - current_A[first - 1]))


def rest_current_A(current_A: FloatArray) -> float | None:
    """
    What flows at rest, A: what the rests before and after a load have in common, as a small load, or the end of a charge, is
    only before it or after. Where only the one before is recorded, what flows in it; ``None``: no rest is.
    """
    loaded = np.flatnonzero(current_A > SWITCH_SHARE * current_A.max())
    before, after = current_A[: loaded[0]], current_A[loaded[-1] + 1 :]
    # what is no load, before it or after, is a rest, unless a charge
    largest_A = current_A.max() - min(current_A.min(), 0.0)
    rests = [part[np.abs(part) <= SWITCH_SHARE * largest_A] for part in (before, after)]
    before_A, after_A = (float(np.median(rest)) if len(rest) else 0.0 for rest in rests)
    if not len(rests[1]):
        return before_A if len(rests[0]) else None
    return min(before_A, after_A, key=abs) if before_A * after_A > 0.0 else 0.0


def is_mixed(voltage_V: FloatArray, first: int) -> bool:
    """Whether the last row before a load already has the voltage under load: then the one before it is the last at rest."""
    return first > 1 and bool(abs(voltage_V[first - 1] - voltage_V[first]) < abs(voltage_V[first - 1] - voltage_V[first - 2]))
