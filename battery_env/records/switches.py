"""A load is switched between two samples, nobody knows when: what that makes of the charge, compiled (numba)."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.records.samples import SWITCH_SHARE

# Samples no farther apart than this, s, are taken as they are: the current of each lasts until the next.
_EXACT_S = 1.1

#: What switches have made of the charge so far: the current that was read last, and the largest one; the last switch up and
#: the last one down, and the standard deviations by each of both and by those like it before; the variance by all others; and
#: how many there were.
SWITCHES = np.dtype(
    [
        *(("read_A", "f8"), ("largest_A", "f8"), ("last_A", "f8", 2), ("like_C", "f8", 2)),
        *(("other_C2", "f8"), ("count", "i8")),
    ],
    align=True,
)


@compiled
def note_switch(switches: Any, read_A: float, interval_s: float) -> None:
    """
    Take in the current of one more sample, so long after the one before, or 0 s if nothing is in doubt. The moment of a switch
    is anywhere in its interval. A load that is switched again and again the same way may be met by the samples at the same
    place each time: then these errors add up, and others cancel in part.
    """
    switched_A, switches.read_A = read_A - switches.read_A, read_A
    switches.largest_A = max(switches.largest_A, abs(read_A))
    if interval_s <= _EXACT_S or abs(switched_A) <= SWITCH_SHARE * switches.largest_A:
        return
    way = 0 if switched_A > 0.0 else 1
    if abs(switched_A - switches.last_A[way]) > SWITCH_SHARE * abs(switched_A):
        switches.other_C2 += switches.like_C[way] ** 2
        switches.like_C[way] = 0.0
    switches.last_A[way] = switched_A
    switches.like_C[way] += abs(switched_A) * interval_s / sqrt(12.0)
    switches.count += 1


@compiled
def switched_C(switches: Any) -> float:
    """The standard deviation of the charge by the moments of all switches."""
    return sqrt(switches.other_C2 + switches.like_C[0] ** 2 + switches.like_C[1] ** 2)


@compiled
def _note_all(rows: Any, time_s: FloatArray, current_A: FloatArray) -> float:
    for n in range(len(time_s)):
        note_switch(rows[0], current_A[n], time_s[n] - time_s[max(n - 1, 0)])
    return switched_C(rows[0])


def switched_sd_C(time_s: FloatArray, current_A: FloatArray) -> float:
    """The standard deviation of the charge of a record by the moments at which its load was switched, C."""
    return float(_note_all(np.zeros(1, SWITCHES), time_s, current_A))
