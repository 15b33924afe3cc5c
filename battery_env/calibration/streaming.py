"""A discharge in progress, as the readings that a voltage-only task shows to its policy."""

from __future__ import annotations

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.calibration.task import CalibrationTask
from battery_env.calibration.voltage import VoltageTask
from battery_env.records import Samples


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

    def record(self, dt_s: float) -> Samples:
        """
        The same in equal steps: the mean current over each, so that the charge drawn is kept, and the voltage between the
        samples that have one.
        """
        time_s, voltage_V, current_A = (np.array(column) for column in (self.time_s, self.voltage_V, self.current_A))
        steps = max(int(np.floor(time_s[-1] / dt_s + 1e-9)), 1)
        grid_s = dt_s * np.arange(steps + 1, dtype=np.float64)
        drawn_C = np.append(0.0, np.cumsum(current_A[:-1] * np.diff(time_s)))
        mean_A = np.append(np.diff(np.interp(grid_s, time_s, drawn_C)) / dt_s, current_A[-1])
        known = ~np.isnan(voltage_V)
        return Samples(grid_s, np.interp(grid_s, time_s[known], voltage_V[known]), mean_A)

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


def resume(task: CalibrationTask, estimate: FloatArray, action: FloatArray, logarithms: FloatArray) -> FloatArray:
    """Let a task of one cell stand where its policy left off."""
    assert isinstance(task, VoltageTask)
    task._estimate[0] = estimate
    task._action[0] = action
    if task._fit is not None:
        task._fit.logarithms[0] = logarithms
    task._explain()
    return logarithms if task._fit is None else task._fit.logarithms[0].copy()
