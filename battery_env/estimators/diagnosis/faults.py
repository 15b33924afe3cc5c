"""
The rows of tables in which the evidence of samples is kept, compiled (numba), and what all questions about samples share: the
noise, the middle one of three voltages, and the first fault.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np

from battery_env.compiled import compiled

#: A row of a table, whose columns numba knows and type checkers do not.
Row = Any

#: So many voltages, and changes of them, are kept.
KEPT = 32
#: A change of more than so many standard deviations of the noise is not noise. The middle one of three samples has this share
#: of their noise.
NOISES, SMOOTHED_SHARE = 8.0, 0.67
#: A voltage farther off than so many standard deviations of its noise shows an error of the model, or of the sensor.
MOST_NOISE_SD = 3.0
#: Voltages are rounded, and no model is better than this, V.
RESOLUTION_V = 1e-3
# This many changes tell the noise.
_LEAST_CHANGES = 4


def table(columns: str | list[tuple[Any, ...]]) -> np.dtype[np.void]:
    """The type of a row: numbers by their names, or names with types."""
    return np.dtype([(name, "f8") for name in columns.split()] if isinstance(columns, str) else columns, align=True)


@compiled
def middle(a: float, b: float, c: float) -> float:
    """The middle one of three."""
    return max(min(a, b), min(max(a, b), c))


@compiled
def noise_V(evidence: Row) -> float:
    """What is more than noise; infinite as long as there are too few samples to tell."""
    n = min(evidence.ring.n_changes, KEPT)
    if n < _LEAST_CHANGES:
        return inf
    change_V = evidence.ring.change_V[:n]
    return NOISES * SMOOTHED_SHARE * float(np.median(np.abs(change_V - np.median(change_V)))) / (0.6745 * sqrt(2.0))


@compiled
def find(evidence: Row, reason: int, time_s: float, size: float) -> None:
    """Note a fault; the first one is kept."""
    fault = evidence.fault
    if fault.reason == 0:
        fault.reason, fault.time_s, fault.size = reason, time_s, size
