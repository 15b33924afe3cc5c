"""Calibration in closed form, where the full state is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from battery_env.electrochemistry import FULL_CHARGE_SHARES, NEW_CELL, QNB, QNS, VO, CellParameters, Trajectory
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimates.findings import SETTLED_SHARES, Reason
from battery_env.estimators.estimator import Estimator
from battery_env.estimators.verdict import Diagnosis, is_plausible


class ClosedForm(Estimator):
    """
    Both parameters from two consecutive full states, exactly; learning can at most tie.

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
        :return: the estimate; ``r_o`` is NaN where no current flows. It is settled if the charge that moved in the last step
            is that of the current, and the cell is one of this kind
        """
        trace = self.trace([record])[0]
        q_mobile, r_o = float(trace.q_mobile[-1]), float(trace.r_o[-1])
        negative_C = record.state[-2:, [QNB, QNS]].sum(axis=1)
        moved_C, drawn_C = float(negative_C[0] - negative_C[1]), float(record.current_A[-2]) * record.dt_s
        diagnosis = Diagnosis()
        contradicted = abs(moved_C - drawn_C) > SETTLED_SHARES["q_mobile"] * abs(moved_C)
        diagnosis.note(Reason.CHARGE_DIFFERS, contradicted, moved_C=moved_C, drawn_C=drawn_C)
        diagnosis.note(Reason.IMPLAUSIBLE, not is_plausible(q_mobile, self.cell.q_mobile))
        unknown = {"r_o": np.inf} if np.isnan(r_o) else {}  # no current flows in the last step
        verdict = diagnosis.verdict({"q_mobile": q_mobile, "r_o": r_o}, unknown, list(unknown))
        return Estimate(q_mobile, r_o, **verdict._asdict())

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """One estimate for every step of simulated discharges of at least two samples."""
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
