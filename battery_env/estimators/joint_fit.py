"""The constants of your own cell, from a few of its discharges."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot, log, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.checks import ZERO_CELSIUS_K, check_positive
from battery_env.electrochemistry import CellParameters, check_cell, check_dt
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_NAMES
from battery_env.electrochemistry.cell import Q_MOBILE_PER_CAPACITY, new_cell_of
from battery_env.electrochemistry.model_error import ERRORS_PER_DISCHARGE, independent_errors
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.estimates import Estimate
from battery_env.estimators.cell_fit import (
    UNFITTED_MISMATCH_V,
    CellFit,
    FittedConstant,
    FittedDischarge,
    aged_V,
    groups,
    uncovered_life,
)
from battery_env.estimators.diagnosis.faults import RESOLUTION_V
from battery_env.estimators.diagnosis.rest import ABOVE_REST_V, BELOW_REST_V, usual_start
from battery_env.estimators.error import ErrorModel
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.priors import RATE_PRIOR_SD
from battery_env.estimators.search import (
    MARGIN,
    JointSearch,
    Prior,
    Search,
    spread_over,
    square,
    standard_deviations,
)
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS, Q_MOBILE
from battery_env.records import (
    CUT_OFF_V,
    Record,
    check_drawn_charge,
    check_record,
    drawn_charge_C,
    mean_current_A,
)
from battery_env.records.discharge import Discharge
from battery_env.records.model import RecordModel

#: How far the equilibrium voltage may be another one: standard deviations of the coefficients of Legendre polynomials 0, 1,
#: ... over the mole fractions of the positive electrode that a discharge passes through, V.
EQUILIBRIUM_PRIOR_SD_V: tuple[float, ...] = (0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
#: A fit that is farther from the measured voltages than this (root mean square), V, is refused: one that was not fitted is
#: as near.
LIMIT_V = UNFITTED_MISMATCH_V
_MOST_DISCHARGES, _FEWEST_SAMPLES = 30, 20
# Longer records are thinned: what the constants shape is slower.
_MOST_SAMPLES = 2000
# Rounds of weighing the residuals by how large they turn out, and how large they are taken for in the first one, V.
_ROUNDS = 3
_FIRST_MISMATCH_V = 0.02
#: Each discharge shows so many independent errors of the model, unless its residuals change their sign more often.
INDEPENDENT_ERRORS = independent_errors(1.0, ERRORS_PER_DISCHARGE["fit"])
# How many standard deviations of its prior the search may move a constant.
_REACH_SD = 6.0
# Where the search for q_mobile starts beside the fit with the constants known before, and how near that may be to its least
# value, as shares of it.
_START_EXCESS, _LEAST_EXCESS = 0.02, 1e-4


def fit_cell(
    discharges: Sequence[Record],
    cut_off_V: float = CUT_OFF_V,
    start: CellParameters | None = None,
    thermal: bool = True,
    dt_s: float = 1.0,
    limit_V: float = LIMIT_V,
) -> CellFit:
    """
    Fit the constants of the model to a few discharges of your own cell: how fast the cell follows its load (``kn``, ``kp``,
    ``tDiffusion``, ``to``, ``tsn``, ``tsp``) and its equilibrium voltage (``U0p``, ``Ap``). Each discharge has its own
    ``q_mobile`` and ``r_o``. Three discharges are enough; take discharges of all ages and loads for which you will use the
    constants. Each must start with a full cell and reach the cut-off: a discharge in progress is refused.

    *Objective.* The fit minimizes the sum of squares of the residuals of the voltage and of the distances to the priors. The
    logarithms of the rate constants have ``RATE_PRIOR_SD``. The change of the equilibrium voltage is a polynomial in the mole
    fraction of the positive electrode with ``EQUILIBRIUM_PRIOR_SD_V``, which ``U0p`` and ``Ap`` represent exactly. Therefore
    constants that the discharges do not determine stay near their start. The voltage at rest of a full cell counts as much as
    all samples within a fiftieth of the discharge. The search is scipy's trust region with exact derivatives.

    *Uncertainty.* The residuals are the error of the model, and drift slowly: the residuals of a discharge count as 50
    independent ones, or as many as their changes of sign. The fit estimates their variance together with the constants.

    *The expected error* of another discharge is the error of discharges left out of the fit: the young, the middle and the old
    third, one after the other. Of a single discharge its parts are left out, one per independent error. The part of a life
    (:data:`LIFE_LOSS` of ``q_mobile``) and of ``q_mobile`` that no discharge covers counts in proportion to the error of the
    constants before the fit. ``mismatch_V`` holds for any age, ``error_at_V`` for one.

    *Other cells.* A cell of another capacity starts with electrodes of another size. For another chemistry the fit is as good
    as the equations; if the residuals stay large, the fit is refused. A start that is not full looks like another chemistry:
    a fit whose full cell rests more than 0.04 V below the full cell of ``start`` has a warning (``doubt``). A fit of less than
    half a life, and a fit with a discharge that does not belong to the others, have a warning, too.

    :param discharges: discharges of one cell, each from full charge. A :class:`~battery_env.Discharge` counts from load-on to
        the cut-off, and other records count whole
    :param cut_off_V: cut-off voltage, V
    :param start: the constants before the fit; ``None``: the new cell's, at the size of this cell
    :param thermal: whether the temperature of the model changes. It starts at the measured temperature, if known
    :param dt_s: time step of the model, s
    :param limit_V: the largest root mean square of the residuals, V
    :raises TypeError: if ``discharges`` is no sequence of records
    :raises ValueError: for an argument out of range, records that cannot be used or stay more than 0.05 V above the cut-off,
        or a cell that the equations cannot describe
    """
    records = _records(discharges, cut_off_V)
    check_positive("limit_V", limit_V)
    prior = _prior(records, start, thermal, cut_off_V)
    check_dt(dt_s, prior)
    # a simulated record is at rest before its first current acts
    at_rest = [not isinstance(whole, Discharge) or whole.load.first > 0 for whole in discharges]
    _check_starts_alike(records, at_rest)
    fit = replace(JointFit(records, at_rest, prior, thermal, dt_s).solve(), usual_start=usual_start(records))
    if not fit.rmse_V <= limit_V:
        raise ValueError(
            f"the equations do not describe this cell: with all constants fitted the voltage is still {1e3 * fit.rmse_V:.0f} "
            f"mV off (limit_V: {1e3 * limit_V:.0f} mV). Check units, sign and cut_off_V, that all discharges are of one cell "
            "and start full, and leave out odd ones; or raise limit_V and take the fit for what it is."
        )
    if fit.doubt:
        warnings.warn(fit.doubt, stacklevel=2)
    return fit


def _records(discharges: Sequence[Record], cut_off_V: float) -> list[Record]:
    if isinstance(discharges, Discharge) or not isinstance(discharges, Sequence):
        raise TypeError(f"discharges must be a list of discharges, got {type(discharges).__name__}")
    check_positive("cut_off_V", cut_off_V)
    if not 1 <= len(discharges) <= _MOST_DISCHARGES:
        raise ValueError(
            f"fit_cell takes 1 to {_MOST_DISCHARGES} discharges, got {len(discharges)}. A few of all ages tell as much."
        )
    records: list[Record] = []
    for number, discharge in enumerate(discharges, start=1):
        try:
            record = discharge.loaded_part(cut_off_V) if isinstance(discharge, Discharge) else discharge
            samples = check_record(record, _FEWEST_SAMPLES)
            check_drawn_charge(drawn_charge_C(samples))
            _check_ends(float(samples.voltage_V.min()), cut_off_V)
        except AttributeError as error:
            raise TypeError(f"discharge {_name(discharge, number)} is no record: {error}") from error
        except (TypeError, ValueError) as error:
            raise type(error)(f"discharge {_name(discharge, number)}: {error}") from error
        records.append(record)
    return records


def _check_ends(lowest_V: float, cut_off_V: float) -> None:
    """Refuse a discharge in progress: before its knee, a cell that holds less looks like one that follows its load slower."""
    if lowest_V > cut_off_V + UNFITTED_MISMATCH_V:
        raise ValueError(
            f"its lowest voltage is {lowest_V:.4g} V, above the cut-off, {cut_off_V:.4g} V. A discharge in progress does not "
            "determine the constants: leave it out. If it was discharged no further, state cut_off_V (--cut-off)."
        )


def _check_starts_alike(records: Sequence[Record], at_rest: Sequence[bool]) -> None:
    """Refuse discharges that cannot all start full: a full cell, of whatever kind, rests at about one voltage."""
    numbered = enumerate(zip(records, at_rest, strict=True), start=1)
    rests = [(float(each.voltage_V[0]), _name(each, n)) for n, (each, rested) in numbered if rested]
    (low_V, low), (high_V, high) = min(rests, default=(0.0, "")), max(rests, default=(0.0, ""))
    if high_V - low_V > BELOW_REST_V + ABOVE_REST_V:
        raise ValueError(
            f"discharge {low} starts at rest at {low_V:.2f} V, discharge {high} at {high_V:.2f} V: they "
            "cannot both be of a full cell. Leave out those that do not start full."
        )


def _prior(records: Sequence[Record], start: CellParameters | None, thermal: bool, cut_off_V: float) -> CellParameters:
    """The constants before the fit, with the cut-off and the temperature that are measured."""
    check_cell(start, thermal)
    q_mobile = float(Q_MOBILE.check(Q_MOBILE_PER_CAPACITY * max(drawn_charge_C(record) for record in records)))
    start = new_cell_of(q_mobile) if start is None else start
    columns = [getattr(record, "temperature_C", None) for record in records]
    temperatures_C = [column[0] for column in columns if column is not None]
    measured = {"Tb0": ZERO_CELSIUS_K + float(np.mean(temperatures_C))} if temperatures_C else {}
    return start.replace(VEOD=float(cut_off_V), **measured)


def _name(record: Record, number: int) -> str:
    meta = getattr(record, "meta", {})
    return f"{meta['cell']}:{meta['cycle']}" if {"cell", "cycle"} <= set(meta) else str(number)


@dataclass(frozen=True)
class _Weights:
    """How much the residuals of each discharge count."""

    mismatch_V: float
    independent: FloatArray  # errors in each discharge, shape (D,)


class JointFit:
    """
    The search over the constants, which all discharges share, and over ``q_mobile`` and ``r_o`` of each. Its values are a
    mapping for each discharge, in which the constants are the same.
    """

    def __init__(
        self, records: Sequence[Record], at_rest: Sequence[bool], start: CellParameters, thermal: bool, dt_s: float
    ) -> None:
        self.model = RecordModel(start, thermal, dt_s)
        self.names = [_name(record, number) for number, record in enumerate(records, start=1)]
        self.records, self.at_rest = records, at_rest  # whether the first sample is the voltage of a full cell at rest
        self.sd = {name: RATE_PRIOR_SD[name] for name in RATE_CONSTANTS}
        self.sd |= zip(EQUILIBRIUM_NAMES, EQUILIBRIUM_PRIOR_SD_V, strict=True)
        self.priors = [Prior(name, 0.0, 1.0 / sd) for name, sd in self.sd.items()]
        bounds = {name: parameter.limits for name, parameter in PARAMETERS.items()}
        bounds |= {name: (-_REACH_SD * sd, _REACH_SD * sd) for name, sd in self.sd.items()}
        for name in ("to", "tsn", "tsp"):  # the model is stable at twice this step
            low, high = bounds[name]
            bounds[name] = max(low, log(dt_s / getattr(start, name))), high
        self.searches = [_thinned(Search.of(record, self.model, PARAMETER_NAMES, self.sd, bounds)) for record in records]
        # the search is over the logarithm of the distance of q_mobile to its least value
        least_C = min(search.least_q_C for search in self.searches)
        self.limits = bounds | {"q_mobile": (log(MARGIN * least_C), log(bounds["q_mobile"][1]))}
        self.charges_C = np.array([drawn_charge_C(record) for record in records])

    @cached_property
    def fits_before(self) -> list[tuple[Estimate, float]]:
        """The best fit of each discharge with the constants before the fit, and its error, V."""
        return [self._fit_with(dict.fromkeys(self.sd, 0.0), d) for d in range(len(self.searches))]

    def _fit_with(self, constants: dict[str, float], d: int) -> tuple[Estimate, float]:
        """The best fit of one discharge with some constants, and its error (root mean square), V."""
        model, search = self.model, self.searches[d]
        cell = search.model_at(constants).cell
        estimate = LeastSquares(cell=cell, thermal=model.thermal, dt_s=model.dt_s).estimate(self.records[d])
        residual_V, _ = search.residual({**constants, "q_mobile": estimate.q_mobile, "r_o": estimate.r_o})
        return estimate, _rms(residual_V)

    def starts(self) -> list[list[dict[str, float]]]:
        """Where to start: at the constants before the fit."""
        constants, estimates = dict.fromkeys(self.sd, 0.0), [estimate for estimate, _ in self.fits_before]
        least_C = np.array([search.least_q_C for search in self.searches])
        fitted_C = np.maximum([each.q_mobile for each in estimates], (1.0 + _LEAST_EXCESS) * least_C)
        return [
            [{**constants, "q_mobile": q, "r_o": each.r_o} for q, each in zip(q_C.tolist(), estimates, strict=True)]
            for q_C in (fitted_C, (1.0 + _START_EXCESS) * least_C)
        ]

    def solve(self) -> CellFit:
        """The best fit that is found from any start, with the weights that its residuals imply."""
        search = self._weighed_by(_Weights(_FIRST_MISMATCH_V, np.full(len(self.records), INDEPENDENT_ERRORS)))
        fits = [self._minimized(search, start) for start in self.starts()]
        best = min(fits, key=lambda values: square(search.weighed(values)[0]))
        for _ in range(_ROUNDS):
            search = self._weighed_by(self._weights(search, best))
            best = self._minimized(search, best)
        weights = self._weights(search, best)
        return self._result(self._weighed_by(weights), best, weights.mismatch_V)

    def _weighed_by(self, weights: _Weights) -> JointSearch:
        """The search with these errors of the voltage; one sample alone says what a full cell shows, however many follow."""
        searches = []
        for search, at_rest, count in zip(self.searches, self.at_rest, weights.independent.tolist(), strict=True):
            noise_V = weights.mismatch_V * sqrt(len(search.data.time_s) / count)
            error = ErrorModel(noise_V=noise_V, first_noise_V=weights.mismatch_V if at_rest else None)
            searches.append(replace(search, error=error))
        return JointSearch(searches, self.priors)

    def _minimized(self, search: JointSearch, start: Sequence[dict[str, float]]) -> list[dict[str, float]]:
        tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-7)
        return search.minimized(start, search.searches[0].unknown, self.limits, max_nfev=200, **tolerances)

    def _weights(self, search: JointSearch, values: Sequence[dict[str, float]]) -> _Weights:
        """What the residuals say about their own size, and how many of them are independent."""
        residuals_V = search.residuals_V(values)
        changes = [float(np.count_nonzero(np.diff(np.signbit(residual)))) for residual in residuals_V]
        independent = np.maximum(changes, INDEPENDENT_ERRORS)
        # what was fitted makes residuals smaller than errors, by as much as the data determine
        sds = standard_deviations(search.weighed(values)[1])[-len(self.sd) :] / np.array(list(self.sd.values()))
        fitted = float(np.sum(1.0 - sds**2)) + 2.0 * len(residuals_V)
        square_V2 = sum(count * _rms(residual) ** 2 for count, residual in zip(independent, residuals_V, strict=True))
        return _Weights(max(float(np.sqrt(square_V2 / (independent.sum() - fitted))), RESOLUTION_V), independent)

    def _left_out_V(self, search: JointSearch, values: Sequence[dict[str, float]]) -> list[float | None]:
        """
        How far each discharge is from constants that were fitted without it, and without those of its age (root mean square),
        V. That is what a discharge shows that nobody has fitted; of one alone its parts do.
        """
        if len(values) == 1:
            return [self._parts_left_out_V(search, values)]
        errors_V: list[float | None] = [None] * len(values)
        for group, others in groups([at["q_mobile"] for at in values]):
            without_group = replace(search, searches=[search.searches[d] for d in others])
            fitted = self._minimized(without_group, [values[d] for d in others])[0]
            for d in group.tolist():
                try:
                    errors_V[d] = self._fit_with({name: fitted[name] for name in self.sd}, d)[1]
                except ValueError as error:
                    raise ValueError(
                        f"constants fitted to the other discharges cannot follow {self.names[d]}: leave it out"
                    ) from error
        return errors_V

    def _parts_left_out_V(self, search: JointSearch, values: Sequence[dict[str, float]]) -> float:
        """
        How far the parts of the only discharge, one for each independent error, are from constants that were fitted to its
        others (root mean square), V; to first order, and no farther than constants that were not fitted.
        """
        n = len(self.sd)
        residual, jacobian = (rows[:-n] for rows in search.weighed(values))
        # q_mobile and r_o are always fitted to all of a discharge
        own, by_constants = jacobian[:, :-n], jacobian[:, -n:] * np.array(list(self.sd.values()))
        by_constants = by_constants - own @ np.linalg.lstsq(own, by_constants, rcond=None)[0]
        inverse, left_out = np.linalg.inv(by_constants.T @ by_constants + np.eye(n)), residual.copy()
        for part in np.array_split(np.arange(len(residual)), int(INDEPENDENT_ERRORS)):
            shares = by_constants[part] @ inverse @ by_constants[part].T
            left_out[part] = np.linalg.solve(np.eye(len(part)) - shares, residual[part])
        return min(_rms(search.searches[0].error_at_samples.noise_V * left_out), UNFITTED_MISMATCH_V)

    def _expected_V(self, discharges: Sequence[FittedDischarge], residual_V: float) -> float:
        """The error to expect of any discharge: of discharges left out, and of ages and charges that no discharge covers."""
        q_mobile_C = np.array([each.q_mobile for each in discharges])
        left_out_V = [each.left_out_V for each in discharges if each.left_out_V is not None]
        undrawn = 1.0 - float((self.charges_C / q_mobile_C).max())
        uncovered_V = hypot(aged_V(uncovered_life(q_mobile_C)), UNFITTED_MISMATCH_V * max(undrawn, 0.0))
        return hypot(max(residual_V, _rms(np.array(left_out_V or [0.0]))), uncovered_V)

    def _result(self, search: JointSearch, values: Sequence[dict[str, float]], mismatch_V: float) -> CellFit:
        """The fit as data."""
        start, cell = self.model.cell, search.searches[0].model_at(values[0]).cell
        sds = standard_deviations(search.weighed(values)[1]).tolist()
        constants = []
        for name, sd in zip(self.sd, sds[-len(self.sd) :], strict=True):
            is_rate = name in RATE_CONSTANTS
            before, after = (getattr(each, name) for each in (start, cell)) if is_rate else (0.0, values[0][name])
            constants.append(FittedConstant(name, before, self.sd[name], after, sd))
        residuals_V = search.residuals_V(values)
        discharges = [
            FittedDischarge(
                self.names[d],
                at["q_mobile"],
                at["r_o"],
                sd_q_mobile=sds[2 * d],
                sd_r_o=sds[2 * d + 1],
                rmse_V=_rms(residuals_V[d]),
                rmse_before_V=self.fits_before[d][1],
                left_out_V=left_out_V,
                current_A=mean_current_A(self.records[d]),
            )
            for d, (at, left_out_V) in enumerate(zip(values, self._left_out_V(search, values), strict=True))
        ]
        largest = max(discharges, key=lambda discharge: discharge.q_mobile)
        new = {"q_mobile": largest.q_mobile, "r_o": largest.r_o}
        return CellFit(
            cell.replace(**new),
            start.replace(**new),
            self._expected_V(discharges, mismatch_V),
            _rms(np.concatenate(residuals_V)),
            self.model.thermal,
            tuple(constants),
            tuple(discharges),
        )


def _thinned(search: Search) -> Search:
    spread = spread_over(len(search.data.time_s), _MOST_SAMPLES)
    data = replace(search.data, time_s=search.data.time_s[spread], voltage_V=search.data.voltage_V[spread])
    return replace(search, data=data)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
