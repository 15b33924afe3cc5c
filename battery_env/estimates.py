"""What every calibrator returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from battery_env.arrays import BoolArray, FloatArray, StringArray


@dataclass(frozen=True)
class Estimate:
    """
    What a calibrator believes about a cell.

    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param sd_q_mobile: its stated standard deviation, C; NaN if the calibrator states none
    :param sd_r_o: likewise, ohm
    :param settled: whether the data determine the estimate, and nothing in the record contradicts it: a fully charged cell
        says nothing about ``q_mobile``, and a prior alone settles nothing
    :param reason: why it is not settled, in a sentence or two; empty if it is
    """

    q_mobile: float
    r_o: float
    sd_q_mobile: float = float("nan")
    sd_r_o: float = float("nan")
    settled: bool = True
    reason: str = ""


@dataclass(frozen=True)
class EstimateTrace:
    """
    The estimates of one discharge in the order they were made, arrays of shape (K,), K >= 1.

    :param time_s: time of the last sample that each estimate has seen, s
    :param q_mobile: C
    :param r_o: ohm
    :param sd_q_mobile: stated standard deviations, C; ``None`` if the calibrator states none
    :param sd_r_o: likewise, ohm
    :param settled: whether the calibrator takes each estimate for settled; ``None`` if it does not say
    :param reason: why each is not settled, strings, empty for those that are; ``None`` if the calibrator does not say
    """

    time_s: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    sd_q_mobile: FloatArray | None = None
    sd_r_o: FloatArray | None = None
    settled: BoolArray | None = None
    reason: StringArray | None = None

    @classmethod
    def of(cls, time_s: Sequence[float] | FloatArray, estimates: Sequence[Estimate]) -> EstimateTrace:
        """
        A trace of single estimates.

        :param time_s: time of the last sample that each has seen, s
        :param estimates: as many
        :return: the trace
        """
        names = ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled")
        columns = {name: np.array([getattr(estimate, name) for estimate in estimates]) for name in names}
        return cls(np.array(time_s), **columns, reason=np.array([estimate.reason for estimate in estimates], dtype=object))


def last_estimate(trace: EstimateTrace) -> Estimate:
    """
    The last estimate of a trace that states uncertainties and what is settled.

    :param trace: of one discharge
    :return: its last estimate
    """
    assert trace.sd_q_mobile is not None and trace.sd_r_o is not None
    assert trace.settled is not None and trace.reason is not None
    return Estimate(
        q_mobile=float(trace.q_mobile[-1]),
        r_o=float(trace.r_o[-1]),
        sd_q_mobile=float(trace.sd_q_mobile[-1]),
        sd_r_o=float(trace.sd_r_o[-1]),
        settled=bool(trace.settled[-1]),
        reason=str(trace.reason[-1]),
    )
