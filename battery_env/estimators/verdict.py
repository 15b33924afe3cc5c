"""
Which numbers of an estimate are settled, and why not both: one function of an estimate, its standard deviations and the
evidence of its record, for all calibrators.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import comb, hypot, nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.estimates.findings import CODES, MOST_OF_SD, SETTLED_SHARES, Doubt, Finding, Reason
from battery_env.estimators.diagnosis.evidence import (
    EVIDENCE,
    charges_in_doubt_C,
    fault_reason,
    is_smeared,
    start_reason,
)
from battery_env.estimators.diagnosis.faults import RESOLUTION_V, Row, table
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
_SHARES = (SETTLED_SHARES["q_mobile"], SETTLED_SHARES["r_o"], SETTLED_SHARES["resistance_10s"])
#: An estimate and its verdict; what is threefold is of ``NUMBERS``: the values, their standard deviations with all
#: that is known and by the record alone, whether they are searched for and whether they have a prior; the first reason against
#: each, which number it names, and of one that is in doubt by what and how much; and whether the resistance is in the larger
#: doubt.
JUDGED = table(
    [
        *((name, "f8", 3) for name in ("value", "sd", "own_sd")),
        *((name, "i8", 3) for name in ("is_searched", "has_prior", "reason")),
        *(("about", "i8", 3), ("doubt", "i8", 3), ("in_doubt", "f8", 3)),
        ("resistance_comes_first", "b1"),
    ]
)


class Assumptions(NamedTuple):
    """What is taken for known beside a record, and shows nowhere in its voltage."""

    gain_sd: float = 0.0  # of the current sensor, which scales both parameters
    sd_soc: float = 0.0  # of the charge at the start, as a share of it
    knee_sd_C: float = 0.0  # of the charge beyond the knee of the model
    apart: tuple[float, float] = (0.0, 0.0)  # how far a policy is from the fit in its observation, C and ohm
    load_on_ohm: float = 0.0  # of the resistance after ten seconds, by the moment of load-on
    is_along_path: bool = False  # whether these constants lie along a path of aging cells


@compiled
def _note_one(judged: Row, k: int, reason: int, about: int, holds: bool) -> None:
    # against one number: the row of the table that comes first counts
    row = reason + 0  # a member of an enumeration is no number in older versions of numba
    if holds and row < judged.reason[k]:
        judged.reason[k], judged.about[k] = row, about


@compiled
def note(judged: Row, reason: int, holds: bool) -> None:
    """Note a reason against all numbers, if it holds, that names none of them."""
    note_about(judged, -1, reason, holds)


@compiled
def note_about(judged: Row, about: int, reason: int, holds: bool) -> None:
    """Note one that names one number, against all, if it holds."""
    for k in range(len(judged.reason)):
        _note_one(judged, k, reason, about, holds)


@compiled
def _note_doubt(judged: Row, k: int, doubt: int, size: float) -> None:
    # what makes most of a standard deviation
    if size > MOST_OF_SD * judged.sd[k] and Reason.IN_DOUBT + 0 < judged.reason[k]:
        _note_one(judged, k, Reason.IN_DOUBT, k, True)
        judged.doubt[k], judged.in_doubt[k] = doubt + 0, size


@compiled
def judge(judged: Row, evidence: Row, known: Assumptions) -> None:
    """Note what the samples of a record and the standard deviations of an estimate say against it."""
    start, fault = start_reason(evidence), fault_reason(evidence)
    note(judged, start, start > 0)
    note(judged, fault, fault > 0)
    beyond_q = beyond_r = 0.0  # in standard deviations that a settled one may have
    for k in range(len(judged.reason)):
        if judged.is_searched[k] == 0:
            continue
        sd, own_sd, most_sd, is_r = judged.sd[k], judged.own_sd[k], _SHARES[k] * judged.value[k], k > 0
        _note_one(judged, k, Reason.PRIOR_ALONE, k, judged.has_prior[k] > 0 and not own_sd < most_sd)
        if not sd < most_sd:
            note(judged, Reason.MISSED, not is_r and evidence.missed_C > MOST_OF_SD * sd)
            if is_r:
                _note_doubt(judged, k, Doubt.LOAD_ON, known.load_on_ohm if k > 1 else 0.0)
            else:
                for number, size_C in enumerate(charges_in_doubt_C(evidence)):
                    _note_doubt(judged, 0, number + 1, size_C)
                _note_doubt(judged, 0, Doubt.KNEE, known.knee_sd_C)
                _note_one(judged, 1, Reason.PATH_UNTESTED, 1, known.is_along_path)
                _note_one(judged, 2, Reason.PATH_UNTESTED, 2, known.is_along_path)
            _note_doubt(judged, k, Doubt.POLICY, known.apart[k] if k < 2 else 0.0)
            scale_sd = known.gain_sd if is_r else hypot(known.gain_sd, known.sd_soc)
            _note_one(judged, k, Reason.SCALE_UNKNOWN, k, scale_sd >= _SHARES[k])
            _note_one(judged, k, Reason.IMPRECISE, k, True)
        if is_r:
            _note_doubt(judged, k, Doubt.SWITCHES, judged.value[k] if is_smeared(evidence) else 0.0)  # all of it
            beyond_r = max(sd, own_sd) / most_sd
        else:
            beyond_q = max(sd, own_sd) / most_sd
    judged.resistance_comes_first = beyond_r > beyond_q


class Verdict(NamedTuple):
    """Which numbers of an estimate are settled, and why not all, by the names of :class:`~battery_env.Estimate`."""

    settled_q_mobile: bool
    settled_r_o: bool
    findings: tuple[Finding, ...]
    settled_resistance_10s: bool

    @classmethod
    def of(cls, judged: Any, measured: Mapping[str, Any]) -> Verdict:
        """What follows from a row of ``JUDGED``, with what was measured."""
        found = []
        for k, about in enumerate(judged["about"].tolist()):
            reason, name = Reason(judged["reason"][k]), "" if about < 0 else NUMBERS[about]
            if reason is Reason.IN_DOUBT:
                found.append(Finding.of(Doubt(judged["doubt"][k]), name, judged["in_doubt"][k], **measured))
            else:
                found.append(Finding.of(reason, name, **measured))
        settled_q_mobile, settled_r_o, settled_10s = (each.code not in CODES for each in found)
        is_stated = bool(judged["is_searched"][2])
        # where there is a resistance that a meter shows, that of the model need not be settled
        of_both = [found[0], found[2 if is_stated else 1]]
        in_order = dict.fromkeys(reversed(of_both) if judged["resistance_comes_first"] else of_both)
        against = tuple(each for each in in_order if each.code in CODES)
        return cls(settled_q_mobile, settled_r_o, against, settled_10s and is_stated)


class Diagnosis:
    """
    What speaks against the estimate of one whole record.

    :param evidence: what its samples show, a row of ``EVIDENCE``; ``None``: nothing
    :param measured: what texts say of them, by the names in their braces
    """

    def __init__(self, evidence: Any = None, measured: Mapping[str, Any] | None = None) -> None:
        self._evidence = np.zeros(1, EVIDENCE)[0] if evidence is None else evidence
        self._measured = dict(measured or {})
        self._judged = np.zeros(1, JUDGED)[0]
        self._judged["reason"] = Reason.SETTLED

    def note(self, reason: Reason, holds: bool = True, /, **measured: Any) -> None:
        """Note that a reason holds against all numbers, if it does, with what was measured of it."""
        if holds:
            note(self._judged, reason, True)
            self._measured = measured | self._measured

    def note_about(self, number: str, reason: Reason, holds: bool = True) -> None:
        """The same of one that names one number."""
        note_about(self._judged, NUMBERS.index(number), reason, holds)

    def verdict(
        self,
        values: Mapping[str, float],
        sds: Mapping[str, float],
        searched: Collection[str] = (),
        priors: Collection[str] = (),
        known: Assumptions | None = None,
    ) -> Verdict:
        """
        Which numbers are settled, by their values and standard deviations as the record alone has them, of those that were
        searched for, and why not both: first why not the one that is farther beyond its limit.
        """
        judged = self._judged
        judged["value"] = [values.get(name, nan) for name in NUMBERS]
        judged["sd"] = judged["own_sd"] = [sds.get(name, nan) for name in NUMBERS]
        judged["is_searched"] = [name in searched for name in NUMBERS]
        judged["has_prior"] = [name in priors for name in NUMBERS]
        judge(judged, self._evidence, known or Assumptions())
        return Verdict.of(judged, self._measured)


@compiled
def is_plausible(q_mobile: float, cell_q_mobile: float) -> bool:
    """Whether a cell of the kind of the model can have some ``q_mobile``."""
    least, most = PLAUSIBLE_Q_SHARES
    return bool(least * cell_q_mobile < q_mobile < most * cell_q_mobile)


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
