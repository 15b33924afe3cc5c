"""An estimate, and the estimates over a discharge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan, nan, sqrt
from typing import Any

import numpy as np

from battery_env.arrays import BoolArray, FloatArray, StringArray
from battery_env.estimates.findings import Finding, reason_of


@dataclass(frozen=True)
class Estimate:
    """
    The parameters of a cell as a calibrator estimates them.

    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance of the model, ohm
    :param sd_q_mobile: standard deviation of ``q_mobile``, C; NaN if the calibrator states none
    :param sd_r_o: standard deviation of ``r_o``, ohm; NaN if the calibrator states none
    :param settled: whether the data determine ``q_mobile`` and the resistance after ten seconds (without this resistance:
        ``r_o``), and nothing in the record contradicts the estimate. A fully charged cell says nothing about ``q_mobile``, and
        a prior alone settles nothing
    :param findings: why the estimate is not settled, with the largest doubt first; empty if settled
    :param settled_q_mobile: whether ``q_mobile`` is settled, even if ``r_o`` is not. If ``settled`` is false, and nothing is
        stated about either number, neither is settled
    :param settled_r_o: whether ``r_o`` is settled
    :param resistance_10s_ohm: resistance as a meter shows it: the fall of the voltage of the fitted model from rest to ten
        seconds after load-on, over the current, at the charge, current and temperature of this record; NaN without a rest
    :param sd_resistance_10s_ohm: standard deviation of ``resistance_10s_ohm``, ohm
    :param settled_resistance_10s: whether ``resistance_10s_ohm`` is settled; false if not stated
    :param constants: other estimated constants, by the names of an :class:`~battery_env.AgingPath`; ``None``: none
    """

    q_mobile: float
    r_o: float
    sd_q_mobile: float = float("nan")
    sd_r_o: float = float("nan")
    settled: bool = True
    findings: tuple[Finding, ...] = ()
    settled_q_mobile: bool = True
    settled_r_o: bool = True
    resistance_10s_ohm: float = nan
    sd_resistance_10s_ohm: float = nan
    settled_resistance_10s: bool = False
    constants: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        is_settled = self.settled_r_o if isnan(self.resistance_10s_ohm) else self.settled_resistance_10s
        if not (self.settled_q_mobile and is_settled):
            object.__setattr__(self, "settled", False)
        elif not self.settled:
            for name in ("settled_q_mobile", "settled_r_o", "settled_resistance_10s"):
                object.__setattr__(self, name, False)

    @property
    def reason(self) -> str:
        """The findings as one text, with remedies."""
        return reason_of(self.findings)

    def within(self, low_C: float, high_C: float) -> Estimate:
        """
        Restrict ``q_mobile`` to a known range.

        :param low_C: least ``q_mobile``, C
        :param high_C: largest ``q_mobile``, C
        :return: the estimate with the mean and the standard deviation of the logarithm of ``q_mobile`` in this range
        """
        from scipy.stats import truncnorm  # here, because the import takes long

        share = self.sd_q_mobile / self.q_mobile
        if not 0.0 < share < np.inf:
            return self
        limits = np.log([low_C / self.q_mobile, high_C / self.q_mobile]) / share
        mean, variance = (float(moment) for moment in truncnorm.stats(*limits))
        q_mobile = float(np.clip(self.q_mobile * np.exp(share * mean), low_C, high_C))
        return replace(self, q_mobile=q_mobile, sd_q_mobile=q_mobile * share * sqrt(max(variance, 0.0)))


_COLUMNS = (
    *("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled_q_mobile", "settled_r_o"),
    *("resistance_10s_ohm", "sd_resistance_10s_ohm", "settled_resistance_10s"),
)


@dataclass(frozen=True)
class EstimateTrace:
    """
    The estimates over one discharge, arrays of shape (K,), K >= 1, with the names and units of :class:`Estimate`. ``None``:
    the calibrator does not state it.

    :param time_s: time of the last sample of each estimate, s
    :param q_mobile: C
    :param r_o: ohm
    :param sd_q_mobile: C
    :param sd_r_o: ohm
    :param settled: whether each estimate is settled
    :param findings: the findings against each estimate, empty if it is settled
    :param settled_q_mobile: whether each ``q_mobile`` is settled
    :param settled_r_o: whether each ``r_o`` is settled
    :param resistance_10s_ohm: ohm
    :param sd_resistance_10s_ohm: ohm
    :param settled_resistance_10s: whether each ``resistance_10s_ohm`` is settled
    :param constants: the other constants of each estimate
    """

    time_s: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    sd_q_mobile: FloatArray | None = None
    sd_r_o: FloatArray | None = None
    settled: BoolArray | None = None
    findings: Sequence[tuple[Finding, ...]] | None = None
    settled_q_mobile: BoolArray | None = None
    settled_r_o: BoolArray | None = None
    resistance_10s_ohm: FloatArray | None = None
    sd_resistance_10s_ohm: FloatArray | None = None
    settled_resistance_10s: BoolArray | None = None
    constants: Sequence[Mapping[str, float] | None] | None = None

    @classmethod
    def of(cls, time_s: Sequence[float] | FloatArray, estimates: Sequence[Estimate]) -> EstimateTrace:
        """Make a trace of single estimates, and the times of their last samples, s."""
        names = (*_COLUMNS, "settled")
        columns: dict[str, Any] = {name: np.array([getattr(estimate, name) for estimate in estimates]) for name in names}
        constants = None if estimates[-1].constants is None else [estimate.constants for estimate in estimates]
        findings = [estimate.findings for estimate in estimates]
        return cls(np.array(time_s), **columns, findings=findings, constants=constants)

    @property
    def reason(self) -> StringArray | None:
        """The findings of each estimate as one text."""
        return None if self.findings is None else np.array([reason_of(findings) for findings in self.findings], dtype=object)


def last_estimate(trace: EstimateTrace) -> Estimate:
    """Return the last estimate of a trace with standard deviations and verdicts."""
    assert trace.findings is not None
    constants = None if trace.constants is None else trace.constants[-1]
    columns: dict[str, Any] = {name: column[-1].item() for name in _COLUMNS if (column := getattr(trace, name)) is not None}
    return Estimate(**columns, findings=trace.findings[-1], constants=constants)
