"""What every calibrator returns, and the interface that evaluation relies on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from battery_env.electrochemistry import FloatArray


class Record(Protocol):
    """
    What was measured during one discharge; a simulated :class:`~battery_env.trajectories.Trajectory` and a recorded
    :class:`~battery_env.cells.Discharge` are both records. All arrays have shape (T,); the current is positive in discharge.
    """

    @property
    def time_s(self) -> FloatArray: ...

    @property
    def voltage_V(self) -> FloatArray: ...

    @property
    def current_A(self) -> FloatArray: ...


@dataclass(frozen=True)
class Estimate:
    """
    What a calibrator believes about a cell.

    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param sd_q_mobile: its stated standard deviation, C; NaN if the calibrator states none
    :param sd_r_o: likewise, ohm
    :param settled: whether the data determine the estimate (a fully charged cell says nothing about ``q_mobile``)
    """

    q_mobile: float
    r_o: float
    sd_q_mobile: float = float("nan")
    sd_r_o: float = float("nan")
    settled: bool = True


@dataclass(frozen=True)
class EstimateTrace:
    """
    The estimates of one discharge in the order they were made, arrays of shape (K,), K >= 1.

    :param time_s: time of the last sample that each estimate has seen, s
    :param q_mobile: C
    :param r_o: ohm
    :param sd_q_mobile: stated standard deviations, C; ``None`` if the calibrator states none
    :param sd_r_o: likewise, ohm
    """

    time_s: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    sd_q_mobile: FloatArray | None = None
    sd_r_o: FloatArray | None = None


class Estimator(ABC):
    """
    A calibrator: from the record of a discharge to (q_mobile, r_o), without labels.
    """

    @abstractmethod
    def estimate(self, record: Record) -> Estimate:
        """
        The estimate after the whole record.

        :param record: one discharge
        :return: the estimate
        """

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        The estimates over time of many discharges; a calibrator that only looks back gives one each, at the end.

        :param records: discharges
        :return: one trace per discharge, in the same order
        """
        traces = []
        for record in records:
            final = self.estimate(record)
            traces.append(
                EstimateTrace(
                    time_s=np.array([record.time_s[-1]]),
                    q_mobile=np.array([final.q_mobile]),
                    r_o=np.array([final.r_o]),
                    sd_q_mobile=np.array([final.sd_q_mobile]),
                    sd_r_o=np.array([final.sd_r_o]),
                )
            )
        return traces
