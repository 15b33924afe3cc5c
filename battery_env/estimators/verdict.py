"""
Which numbers of an estimate are settled, and the reasons against the others: one function of an estimate, its standard
deviations and the evidence of its record, for all calibrators.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator, Mapping
from math import comb, hypot, sqrt
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.estimates.findings import MOST_OF_SD, SETTLED_SHARES, Doubt, Finding, Reason
from battery_env.estimators.diagnosis.evidence import Evidence
from battery_env.estimators.diagnosis.faults import RESOLUTION_V
from battery_env.parameters import PARAMETER_NAMES

#: A ``q_mobile`` is plausible within these multiples of the model cell's: its electrodes are those of a 2 Ah cell.
PLAUSIBLE_Q_SHARES = (0.2, 5.0)
#: The error of the model may be this much larger than stated before the residuals contradict it.
MISMATCH_MARGIN = 2.0
#: So many samples more than parameters tell how large the noise is.
SPARE_SAMPLES = 10
#: A prior contradicts the record beyond so many standard deviations of their difference. Within it, a prior of the settled
#: width moves no estimate by more than 5 %.
PRIOR_LIMIT_SD = 2.5
#: The resistance of the model contradicts the measured one beyond so many standard deviations: on sound records
#: of the bundled cells both agree within 0.9.
RESISTANCE_LIMIT_SD = 2.0
# Residuals whose variance is so many of its standard deviations above the one expected are not noise; and where the noise is
# told from the residuals themselves, by so large a share over the root of their number.
_EXCESS_LIMIT, _EXCESS_LIMIT_UNSTATED = 5.0, 10.0

#: What is judged: both parameters, and the resistance after ten seconds, ohm.
NUMBERS = (*PARAMETER_NAMES, "resistance_10s")


class Assumptions(NamedTuple):
    """Uncertainties that the voltage cannot reveal."""

    gain_sd: float = 0.0  # of the current sensor, which scales both parameters
    sd_soc: float = 0.0  # of the charge at the start, as a share of it
    knee_sd_C: float = 0.0  # of the charge beyond the knee of the model
    distance_from_fit: Mapping[str, float] = MappingProxyType({})  # of a policy, from the fit in its observation, by number
    load_on_ohm: float = 0.0  # of the resistance after ten seconds, by the moment of load-on
    is_along_path: bool = False  # whether these constants lie along a path of aging cells


class Verdict(NamedTuple):
    """Which numbers of an estimate are settled, and why not all, by the names of :class:`~battery_env.Estimate`."""

    settled_q_mobile: bool
    settled_r_o: bool
    findings: tuple[Finding, ...]
    settled_resistance_10s: bool


class _Against(NamedTuple):
    """A reason against a number, with the number that it names; of a doubt also which doubt, and its size."""

    reason: Reason
    about: str = ""
    doubt: Doubt | None = None
    size: float = 0.0

    def finding(self, measured: Mapping[str, Any]) -> Finding:
        """As data, with what was measured."""
        if self.doubt is None:
            return Finding.of(self.reason, self.about, **measured)
        return Finding.of(self.doubt, self.about, self.size, **measured)


class Diagnosis:
    """
    The reasons against the estimate of one record.

    :param evidence: of its samples; ``None``: without a finding
    :param measured: the values in the texts of findings, by the names in their braces
    """

    def __init__(self, evidence: Evidence | None = None, measured: Mapping[str, Any] | None = None) -> None:
        self._evidence = Evidence() if evidence is None else evidence
        self._measured = dict(measured or {})
        reasons = (self._evidence.start, self._evidence.fault and self._evidence.fault.reason)
        self._against = [_Against(reason) for reason in reasons if reason is not None]

    def note(self, reason: Reason, holds: bool = True, /, **measured: Any) -> None:
        """Note that a reason holds against all numbers, if it does, with what was measured of it."""
        if holds:
            self._against.append(_Against(reason))
            self._measured = measured | self._measured

    def note_about(self, number: str, reason: Reason, holds: bool = True, /, **measured: Any) -> None:
        """The same of one that names one number."""
        if holds:
            self._against.append(_Against(reason, number))
            self._measured = measured | self._measured

    def verdict(
        self,
        values: Mapping[str, float],
        sds: Mapping[str, float],
        searched: Collection[str] = (),
        priors: Collection[str] = (),
        assumptions: Assumptions | None = None,
    ) -> Verdict:
        """
        Return which of the numbers that were searched for are settled, by their values and standard deviations from the record
        alone; and the findings against the others, first against the number that is farthest beyond its limit.
        """
        assumptions = assumptions or Assumptions()
        limits = {name: SETTLED_SHARES[name] * values[name] for name in NUMBERS if name in searched}
        is_open = "q_mobile" in limits and not sds["q_mobile"] < limits["q_mobile"]
        against, findings = list(self._against), {}
        if is_open and self._evidence.missed_C > MOST_OF_SD * sds["q_mobile"]:
            against.append(_Against(Reason.MISSED))
        for name in NUMBERS:
            is_untested = is_open and assumptions.is_along_path and name != "q_mobile"
            of_number = [_Against(Reason.PATH_UNTESTED, name)] if is_untested else []
            if name in limits:
                of_number += self._against_one(name, values[name], sds[name], name in priors, assumptions)
            # the row of the table that comes first counts
            findings[name] = min([*against, *of_number], key=lambda each: each.reason, default=None)
        # where there is a resistance that a meter shows, that of the model need not be settled
        resistance = "resistance_10s" if "resistance_10s" in limits else "r_o"
        # a resistance of 0 is as far beyond its limit as can be
        beyond = {
            name: sds[name] / max(limits[name], sys.float_info.min) for name in ("q_mobile", resistance) if name in limits
        }
        of_both = sorted(("q_mobile", resistance), key=lambda name: -beyond.get(name, 0.0))
        in_order = dict.fromkeys(each.finding(self._measured) for name in of_both if (each := findings[name]))
        settled_q_mobile, settled_r_o, settled_10s = (findings[name] is None for name in NUMBERS)
        return Verdict(settled_q_mobile, settled_r_o, tuple(in_order), settled_10s and resistance == "resistance_10s")

    def _against_one(
        self, name: str, value: float, sd: float, has_prior: bool, assumptions: Assumptions
    ) -> Iterator[_Against]:
        """The reasons against a number that follow from its standard deviation."""
        is_charge, share = name == "q_mobile", SETTLED_SHARES[name]
        doubts: dict[Doubt, float] = {}
        if not sd < share * value:
            if is_charge:
                doubts = {**self._evidence.charges_C, Doubt.KNEE: assumptions.knee_sd_C}
            elif name == "resistance_10s":
                doubts = {Doubt.LOAD_ON: assumptions.load_on_ohm}
            doubts[Doubt.POLICY] = assumptions.distance_from_fit.get(name, 0.0)
            if has_prior:
                yield _Against(Reason.PRIOR_ALONE, name)
            if hypot(assumptions.gain_sd, assumptions.sd_soc if is_charge else 0.0) >= share:
                yield _Against(Reason.SCALE_UNKNOWN, name)
            yield _Against(Reason.IMPRECISE, name)
        if self._evidence.is_smeared and not is_charge:
            doubts[Doubt.SWITCHES] = value  # all of it
        # what makes most of a standard deviation
        yield from (_Against(Reason.IN_DOUBT, name, doubt, size) for doubt, size in doubts.items() if size > MOST_OF_SD * sd)


def is_plausible(q_mobile: float, cell_q_mobile: float) -> bool:
    """Whether a cell of the kind of the model can have some ``q_mobile``."""
    least, most = PLAUSIBLE_Q_SHARES
    return least * cell_q_mobile < q_mobile < most * cell_q_mobile


def misfit_limit_V2(
    noise_V: float, samples: int, mismatch_V: float, is_noise_stated: bool = False, negligible_V: float = RESOLUTION_V
) -> float:
    """The mean square of residuals, V^2, that noise and error of the model explain."""
    excess = _EXCESS_LIMIT * sqrt(2.0 / samples) if is_noise_stated else _EXCESS_LIMIT_UNSTATED / sqrt(samples)
    return noise_V**2 * (1.0 + excess) + (MISMATCH_MARGIN * mismatch_V) ** 2 + negligible_V**2


def white_noise_V(residual_V: FloatArray, order: int = 1) -> float:
    """
    Return the standard deviation of the white part of residuals: from their differences from sample to sample, which hardly
    hold what drifts, by the median, which leaves single wild samples aside.
    """
    return float(np.median(np.abs(np.diff(residual_V, order))) / (0.6745 * np.sqrt(comb(2 * order, order))))
