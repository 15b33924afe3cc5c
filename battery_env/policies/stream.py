"""
The stream of a policy: samples so far, each with the time since the first sample, s, the voltage, V, NaN where missing, and
the current until the next sample, A.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from battery_env.arrays import BoolArray, FloatArray
from battery_env.records import Samples


class ReadingsOnGrid(NamedTuple):
    """A record in equal steps, with a flag for the measured voltages."""

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    is_measured: BoolArray


def on_grid(samples: list[tuple[float, float, float]], dt_s: float) -> ReadingsOnGrid:
    """Resample in equal steps: the mean current of a step keeps the charge; a voltage goes to the nearest step."""
    time_s, voltage_V, current_A = columns(samples)
    steps = max(int(np.floor(time_s[-1] / dt_s + 0.5)), 1)
    grid_s = dt_s * np.arange(steps + 1, dtype=np.float64)
    drawn_C = np.append(0.0, np.cumsum(current_A[:-1] * np.diff(time_s)))
    mean_A = np.append(np.diff(np.interp(grid_s, time_s, drawn_C)) / dt_s, current_A[-1])
    has_voltage = ~np.isnan(voltage_V)
    nearest, first = np.unique(np.rint(time_s[has_voltage] / dt_s).astype(np.int64), return_index=True)
    grid_V, is_measured = np.interp(grid_s, time_s[has_voltage], voltage_V[has_voltage]), np.zeros(steps + 1, dtype=np.bool_)
    grid_V[nearest], is_measured[nearest] = voltage_V[has_voltage][first], True
    return ReadingsOnGrid(grid_s, grid_V, mean_A, is_measured)


def with_voltage(samples: list[tuple[float, float, float]], until_s: float) -> Samples:
    """Return the samples up to a time that have a voltage."""
    time_s, voltage_V, current_A = columns(samples)
    has_voltage = ~np.isnan(voltage_V) & (time_s <= until_s + 1e-9)
    return Samples(time_s[has_voltage], voltage_V[has_voltage], current_A[has_voltage])


def columns(samples: list[tuple[float, float, float]]) -> FloatArray:
    """Return the columns of the samples, shape (3, n)."""
    return np.array(samples, dtype=np.float64).reshape(-1, 3).T.copy()
