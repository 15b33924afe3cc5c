"""What is known of a cell before its record: standard deviations of its constants, or a path along which such cells age."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np

from battery_env.electrochemistry.aging_path import PATH_DISTANCE_LIMIT_SD, PATH_NAMES, AgingPath
from battery_env.electrochemistry.cell import CellParameters
from battery_env.electrochemistry.model_error import CORRELATION_SHARE, UNFITTED_ERROR_RATIO, independent_errors
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.estimates import Estimate
from battery_env.estimators.diagnosis.evidence import dropouts_of
from battery_env.estimators.diagnosis.faults import MOST_NOISE_SD
from battery_env.estimators.error import ErrorModel
from battery_env.estimators.search import MARGIN, AnyPrior, Fit, JointPrior, Prior, Search
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import ChargeHistory, Samples, drawn_charge_C

#: How well the constants that say how fast a cell follows its load are known before any data, as standard deviations of their
#: logarithms: kn of seven cells lies so far from a new one's, but for the one of NASA's that is reported.
RATE_PRIOR_SD: Mapping[str, float] = {"kn": 3.0, "kp": 0.5, "tDiffusion": 0.5, "to": 0.5, "tsn": 0.5, "tsp": 0.5}
# Starts along a path, in standard deviations of its q_mobile; and how far above what the record allows they keep, as a share.
_STARTS_SD, _START_ABOVE = (-1.5, -0.5, 0.5, 1.5), 0.02


def explained_ratio(rates_sd: Mapping[str, float]) -> float:
    """Return the error of a model with known rate constants over that with rate constants of these standard deviations."""
    # free constants of any kind of cell explain as much of the error as q_mobile and r_o absorb
    return UNFITTED_ERROR_RATIO if rates_sd == RATE_PRIOR_SD else 1.0


@dataclass(frozen=True)
class CellPrior:
    """Constants of a cell, each of which is known to some standard deviation."""

    cell: CellParameters
    mismatch_V: float  # expected error of the model
    starts_at_rest: bool  # whether the first sample is the voltage of the cell at rest
    nuisance: Mapping[str, float]  # standard deviations of the unknowns besides both parameters
    sd_ratio: float  # how many times as large as a fit says its standard deviations are

    def with_fixed_rates(self) -> CellPrior:
        """With known rate constants, as those of all discharges of a cell."""
        rates_sd = {name: sd for name, sd in self.nuisance.items() if name in RATE_CONSTANTS}
        others = {name: sd for name, sd in self.nuisance.items() if name not in RATE_CONSTANTS}
        return replace(self, nuisance=others, mismatch_V=self.mismatch_V * explained_ratio(rates_sd))

    def starts(self, search: Search, previous: Estimate | None) -> list[dict[str, float]]:
        """Where to start the search in a record."""
        if "q_mobile" not in search.parameters:
            return search.starts([self.cell.q_mobile])[0]
        return search.best_starts([] if previous is None else [previous.q_mobile])

    def residuals(self) -> list[AnyPrior]:
        """The prior as further residuals."""
        return [Prior(name, 0.0, 1.0 / sd) for name, sd in self.nuisance.items()]

    def error(self, record: Samples, history: ChargeHistory, q_mobile: float, first_V: float, noise_V: float) -> ErrorModel:
        """The expected error of the voltage, by ``q_mobile`` and first residual where the search starts; noise may be 0."""
        cell, drift_V = self.cell, UNFITTED_ERROR_RATIO * self.mismatch_V
        if drift_V and noise_V and self.starts_at_rest:
            drift_V = hypot(drift_V, sqrt(self._beyond_V2(first_V, noise_V)))
        correlation_C = CORRELATION_SHARE * q_mobile
        dropouts_s = tuple((each.begin_s, each.end_s) for each in dropouts_of(record, cell))
        return ErrorModel(drift_V, noise_V or 1.0, cell.r_o, cell.to, correlation_C, history.load_on_C, dropouts_s)

    def more_variance(self, record: Samples, fit: Fit, error: ErrorModel, noise_V: float) -> float:
        """What a fit adds to the variance of a weighed residual."""
        return 0.0

    def distance_share(self, values: Mapping[str, float]) -> float:
        """How far a cell lies from the cells of its kind, as a share of how far they do at most."""
        return 0.0

    def _beyond_V2(self, first_V: float, noise_V: float) -> float:
        # an error of the model is no smaller than the voltage at rest shows, beyond noise
        return max(first_V**2 - (MOST_NOISE_SD * noise_V) ** 2 - self.mismatch_V**2, 0.0)


@dataclass(frozen=True)
class PathPrior(CellPrior):
    """Constants, ``q_mobile`` and ``r_o`` that go together along a path of aging cells."""

    path: AgingPath

    @classmethod
    def of(cls, path: AgingPath, cell: CellParameters, mismatch_V: float, starts_at_rest: bool) -> PathPrior:
        """The prior of a path."""
        sds = dict(zip(PATH_NAMES, np.sqrt(np.diag(path.moments[1])).tolist(), strict=True))
        nuisance = {name: sd for name, sd in sds.items() if name not in PARAMETER_NAMES}
        return cls(cell, mismatch_V, starts_at_rest, nuisance, path.sd_ratio, path)

    def with_fixed_rates(self) -> CellPrior:
        """The rate constants move along the path with ``q_mobile``."""
        return self

    def starts(self, search: Search, previous: Estimate | None) -> list[dict[str, float]]:
        """At what the path expects of cells of some ``q_mobile``, where the record allows for these."""
        (mean, covariance), q = self.path.moments, PATH_NAMES.index("q_mobile")
        log_least = float(np.log((1.0 + MARGIN) * search.least_q_C))
        log_q = mean[q] + np.sqrt(covariance[q, q]) * np.array(_STARTS_SD)
        starts = []
        for each in np.unique(np.maximum(log_q, log_least + _START_ABOVE)):
            expected = mean + covariance[q] / covariance[q, q] * (each - mean[q])
            start = dict(zip(PATH_NAMES, expected.tolist(), strict=True))
            start |= {name: float(np.exp(start[name])) for name in PARAMETER_NAMES}
            # its constants may need more charge than those of the cell
            start["q_mobile"] = max(start["q_mobile"], search.least_q_at_C(start)[0] * float(np.exp(_START_ABOVE)))
            starts.append(start)
        return starts

    def residuals(self) -> list[AnyPrior]:
        """All unknowns at once."""
        mean, covariance = self.path.moments
        return [JointPrior(PATH_NAMES, mean, np.linalg.cholesky(np.linalg.inv(covariance)).T)]

    def error(self, record: Samples, history: ChargeHistory, q_mobile: float, first_V: float, noise_V: float) -> ErrorModel:
        """Independent errors of the model, and noise."""
        return ErrorModel(noise_V=hypot(noise_V, sqrt(len(record.time_s) / self._errors(record)) * self.mismatch_V))

    def more_variance(self, record: Samples, fit: Fit, error: ErrorModel, noise_V: float) -> float:
        """One error of the model may be larger than the path leaves."""
        n, beyond_V2 = len(fit.residual_V), self._beyond_V2(float(fit.residual_V[0]), noise_V)
        return n * beyond_V2 / (self._errors(record) * error.noise_V) ** 2

    def distance_share(self, values: Mapping[str, float]) -> float:
        """By the distance from the path."""
        return self.path.distance_sd(values) / PATH_DISTANCE_LIMIT_SD

    def _errors(self, record: Samples) -> float:
        return independent_errors(drawn_charge_C(record), self.path.errors_per_C)
