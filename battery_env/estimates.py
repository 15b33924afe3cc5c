"""What every calibrator returns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

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


_COLUMNS = ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled")


class Estimates(Sequence[Estimate]):
    """
    What was estimated of many cells at once: a sequence of estimates, and arrays of shape (cells,).

    :ivar q_mobile: C
    :ivar r_o: ohm
    :ivar sd_q_mobile: standard deviations, C
    :ivar sd_r_o: likewise, ohm
    :ivar settled: whether each is settled
    :param q_mobile: as above
    :param r_o: likewise
    :param sd_q_mobile: likewise
    :param sd_r_o: likewise
    :param settled: likewise
    :param reason: of a cell by its number, why its estimate is not settled
    """

    def __init__(
        self,
        q_mobile: FloatArray,
        r_o: FloatArray,
        sd_q_mobile: FloatArray,
        sd_r_o: FloatArray,
        settled: BoolArray,
        reason: Callable[[int], str],
    ) -> None:
        self.q_mobile, self.r_o, self.sd_q_mobile, self.sd_r_o, self.settled = q_mobile, r_o, sd_q_mobile, sd_r_o, settled
        self._reason = reason

    def __len__(self) -> int:
        return len(self.q_mobile)

    @overload
    def __getitem__(self, index: int) -> Estimate: ...

    @overload
    def __getitem__(self, index: slice) -> list[Estimate]: ...

    def __getitem__(self, index: int | slice) -> Estimate | list[Estimate]:
        if isinstance(index, slice):
            return [self[n] for n in range(*index.indices(len(self)))]
        n = range(len(self))[index]
        q_mobile, r_o, sd_q_mobile, sd_r_o = (float(getattr(self, name)[n]) for name in _COLUMNS[:4])
        return Estimate(q_mobile, r_o, sd_q_mobile, sd_r_o, bool(self.settled[n]), self._reason(n))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]


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
        columns = {name: np.array([getattr(estimate, name) for estimate in estimates]) for name in _COLUMNS}
        return cls(np.array(time_s), **columns, reason=np.array([estimate.reason for estimate in estimates], dtype=object))


def last_estimate(trace: EstimateTrace) -> Estimate:
    """The last estimate of a trace that states uncertainties and what is settled."""
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
