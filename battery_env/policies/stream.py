"""
The stream that a policy follows: samples so far at any intervals, each with the time since the first one, s,
the voltage, V, NaN where it is missing, and the current until the next one, A.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from battery_env.arrays import BoolArray, FloatArray
from battery_env.records import Samples


class ReadingsOnGrid(NamedTuple):
    """A record in equal steps, of which only some voltages were measured."""

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    measured: BoolArray


def on_grid(samples: list[tuple[float, float, float]], dt_s: float) -> ReadingsOnGrid:
    """
    Samples in equal steps: the mean current over each, so that the charge drawn is kept, and at the steps nearest to the
    samples that have a voltage theirs.
    """
    time_s, voltage_V, current_A = columns(samples)
    steps = max(int(np.floor(time_s[-1] / dt_s + 0.5)), 1)
    grid_s = dt_s * np.arange(steps + 1, dtype=np.float64)
    drawn_C = np.append(0.0, np.cumsum(current_A[:-1] * np.diff(time_s)))
    mean_A = np.append(np.diff(np.interp(grid_s, time_s, drawn_C)) / dt_s, current_A[-1])
    known = np.flatnonzero(~np.isnan(voltage_V))
    nearest, first = np.unique(np.rint(time_s[known] / dt_s).astype(np.int64), return_index=True)
    at_grid_V, measured = np.interp(grid_s, time_s[known], voltage_V[known]), np.zeros(steps + 1, dtype=np.bool_)
    at_grid_V[nearest], measured[nearest] = voltage_V[known[first]], True
    return ReadingsOnGrid(grid_s, at_grid_V, mean_A, measured)


def with_voltage(samples: list[tuple[float, float, float]], until_s: float) -> Samples:
    """The samples until some time that have a voltage."""
    time_s, voltage_V, current_A = columns(samples)
    known = ~np.isnan(voltage_V) & (time_s <= until_s + 1e-9)
    return Samples(time_s[known], voltage_V[known], current_A[known])


def columns(samples: list[tuple[float, float, float]]) -> FloatArray:
    """All samples, shape (3, n)."""
    return np.array(samples, dtype=np.float64).reshape(-1, 3).T.copy()
