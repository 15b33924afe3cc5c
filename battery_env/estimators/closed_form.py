"""Calibration in closed form, where the full state is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from battery_env.electrochemistry import FULL_CHARGE_SHARES, NEW_CELL, QNB, VO, CellParameters, Trajectory
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.base import Estimator


class ClosedForm(Estimator):
    """
    Both parameters from two consecutive full states, exactly; no learning can do more than tie with it.

    Charge is conserved, so that the four charges always add up to what they are at full charge,
    ``q_mobile * (0.9 + 0.1 + 0.6 + 1/15) = q_mobile / 0.6``. And the ohmic voltage drop obeys
    ``Vo' = (i * r_o - Vo) / to``, so that ``r_o = (Vo + to / dt * (Vo_{t+1} - Vo)) / i``.

    :param cell: constants of the cell
    """

    def __init__(self, cell: CellParameters = NEW_CELL) -> None:
        self.cell = cell

    def estimate(self, record: Trajectory) -> Estimate:  # type: ignore[override]
        """
        The estimate at the end of a discharge.

        :param record: a simulated discharge (no recording has the full state) of at least two samples
        :return: the estimate; ``r_o`` is NaN where no current flows
        """
        trace = self.trace([record])[0]
        return Estimate(q_mobile=float(trace.q_mobile[-1]), r_o=float(trace.r_o[-1]))

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """
        One estimate for every step of many discharges.

        :param records: simulated discharges of at least two samples
        :return: one trace per discharge, in the same order
        """
        traces = []
        for record in records:
            ohmic = record.state[:, VO]
            ohmic_nominal = ohmic[:-1] + self.cell.to / record.dt_s * np.diff(ohmic)
            current = np.where(record.current_A[:-1] == 0.0, np.nan, record.current_A[:-1])
            charge = record.state[1:, QNB:].sum(axis=1)
            traces.append(
                EstimateTrace(
                    time_s=record.time_s[1:], q_mobile=charge / FULL_CHARGE_SHARES.sum(), r_o=ohmic_nominal / current
                )
            )
        return traces
