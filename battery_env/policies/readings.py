"""What a policy that follows a stream has been shown so far."""

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


class ReadingsSoFar:
    """
    Samples of one discharge that come in one by one, at any intervals, with missing voltages (NaN) among them.

    :ivar time_s: since the first sample, s
    :ivar voltage_V: V
    :ivar current_A: from each sample to the next one, A
    """

    def __init__(self) -> None:
        self.time_s: list[float] = []
        self.voltage_V: list[float] = []
        self.current_A: list[float] = []

    def add(self, voltage_V: float, current_A: float, dt_s: float) -> None:
        """Take in a sample."""
        self.time_s.append(self.time_s[-1] + dt_s if self.time_s else 0.0)
        self.voltage_V.append(float(voltage_V))
        self.current_A.append(float(current_A))

    def record(self, dt_s: float) -> ReadingsOnGrid:
        """
        The same in equal steps: the mean current over each, so that the charge drawn is kept, and at the steps nearest to the
        samples that have a voltage theirs.
        """
        time_s, voltage_V, current_A = self.columns()
        steps = max(int(np.floor(time_s[-1] / dt_s + 0.5)), 1)
        grid_s = dt_s * np.arange(steps + 1, dtype=np.float64)
        drawn_C = np.append(0.0, np.cumsum(current_A[:-1] * np.diff(time_s)))
        mean_A = np.append(np.diff(np.interp(grid_s, time_s, drawn_C)) / dt_s, current_A[-1])
        known = np.flatnonzero(~np.isnan(voltage_V))
        nearest, first = np.unique(np.rint(time_s[known] / dt_s).astype(np.int64), return_index=True)
        at_grid_V, measured = np.interp(grid_s, time_s[known], voltage_V[known]), np.zeros(steps + 1, dtype=np.bool_)
        at_grid_V[nearest], measured[nearest] = voltage_V[known[first]], True
        return ReadingsOnGrid(grid_s, at_grid_V, mean_A, measured)

    def are_two(self, until_s: float) -> bool:
        """Whether two samples after the first one have a voltage."""
        time_s, voltage_V, _ = self.columns()
        return int(np.sum(~np.isnan(voltage_V[1:]) & (time_s[1:] <= until_s + 1e-9))) >= 2

    def known(self, until_s: float) -> Samples:
        """The samples that have a voltage."""
        time_s, voltage_V, current_A = self.columns()
        known = ~np.isnan(voltage_V) & (time_s <= until_s + 1e-9)
        return Samples(time_s[known], voltage_V[known], current_A[known])

    def columns(self) -> FloatArray:
        """All samples."""
        return np.array([self.time_s, self.voltage_V, self.current_A])

    @classmethod
    def of(cls, columns: FloatArray) -> ReadingsSoFar:
        """The reverse of :meth:`columns`."""
        readings = cls()
        readings.time_s, readings.voltage_V, readings.current_A = columns.tolist()
        return readings
