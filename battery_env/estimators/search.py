"""The search for parameters whose simulated voltage is closest to records: of least squares and of the fit of a cell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import copysign, exp, inf, isnan, log, log1p, sqrt
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_NAMES, EQUILIBRIUM_SIZE
from battery_env.electrochemistry.cell import BULK_RATE, SURFACE_RATE, CellParameters
from battery_env.electrochemistry.equilibrium import equilibrium_slopes, with_equilibrium
from battery_env.electrochemistry.tangents import RATE_CONSTANTS, TANGENT_NAMES
from battery_env.estimators.error import ErrorModel, VoltageError
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import Record, check_drawn_charge, drawn_charge_C
from battery_env.records.model import RecordModel

#: How far the search keeps from the least ``q_mobile``, as a share of it: more than rounding, less than anyone measures.
MARGIN = 1e-6
# The distance of q_mobile to its least value is below exp of this, so that no step of the search overflows: no estimate of the
# bundled cells depends on it.
_LOG_LIMIT = 50.0
# Logarithms of nuisance constants are held within this, unless they have bounds. On records of the bundled cells, whole and in
# progress, twice as much moves no q_mobile by more than 0.2 %, half as much up to 39 %.
_REACHED = dict.fromkeys(RATE_CONSTANTS, (-5.0, 5.0))
#: Width of the prior of the logarithm of q_mobile of cells of one size.
SIZE_WIDTH = 0.2
_SCALES = {"q_mobile": 1.0, "r_o": 0.1}
# Where the search for q_mobile may start: this much above its least value. The narrow ones serve whole discharges, the wide
# ones the first minutes of one.
_START_EXCESS = 0.003 * 2.2 ** np.arange(13)
# Starts whose squares are within this ratio of the least are promising. The intervals beside them are cut into so many parts,
# and the search goes on from each local minimum. Half or double of each, and of the number below, moves q_mobile of the same
# records by less than 0.02 of its standard deviation.
_RIVAL_RATIO, _FINER = 2.0, 4
# Starts are compared on a coarse grid of time if it has at least this many points.
_COARSE_POINTS = 100
# Length of a step along a likelihood, in standard deviations: half or double of it changes widths by up to a quarter. And the
# most steps, of which no estimate of the same records takes as many as half.
_STEP_SD = 0.5
_STEPS = 100


@dataclass(frozen=True)
class OnGrid:
    """A record on the time grid of a model."""

    time_s: FloatArray  # of the samples, since the first one
    voltage_V: FloatArray  # of the samples
    current_A: FloatArray  # over each step of the model
    dt_s: float  # of the model

    @classmethod
    def of(cls, record: Record, model: RecordModel) -> OnGrid:
        """Resample any record."""
        time_s, current_A = model.grid(record)
        return cls(time_s, np.asarray(record.voltage_V), current_A, model.dt_s)

    @cached_property
    def grid_s(self) -> FloatArray:
        """Times of the grid, s."""
        return np.asarray(self.dt_s * np.arange(len(self.current_A)), dtype=np.float64)

    @cached_property
    def _samples_are_the_grid(self) -> bool:
        same = len(self.time_s) == len(self.grid_s)
        return same and np.allclose(self.time_s, self.grid_s, rtol=0.0, atol=1e-6 * self.dt_s)

    @cached_property
    def samples_A(self) -> FloatArray:
        """The current at the samples, A."""
        return self.at_samples([self.current_A])[0]

    def at_samples(self, columns: Iterable[FloatArray]) -> list[FloatArray]:
        """Columns of the grid, at the samples."""
        if self._samples_are_the_grid:
            return list(columns)
        return [np.interp(self.time_s, self.grid_s, column) for column in columns]


@dataclass(frozen=True)
class Prior:
    """The normal prior of one unknown, as one more residual."""

    name: str
    mean: float
    weight: float  # per unit of the unknown, as residuals are weighed

    def residual(self, values: Mapping[str, float]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """The residual, and its derivatives by unknown."""
        return np.array([self.weight * (values[self.name] - self.mean)]), {self.name: np.array([self.weight])}


@dataclass(frozen=True)
class SizePrior:
    """
    What cells of one size hold, new or aged, as one more residual of the logarithm of ``q_mobile``. Of a stated size it is
    normal. Of one that nobody stated its density falls as one over the distance: the size is likely, and none is ruled out.
    """

    usual_C: float
    is_stated: bool = False

    def residual(self, values: Mapping[str, float]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """The residual, and its derivatives by unknown."""
        distance = log(values["q_mobile"] / self.usual_C) / SIZE_WIDTH
        residual, slope = distance, 1.0
        if not self.is_stated and distance:
            residual = copysign(sqrt(log1p(distance**2)), distance)
            slope = distance / (1.0 + distance**2) / residual
        return np.array([residual]), {"q_mobile": np.array([slope / (SIZE_WIDTH * values["q_mobile"])])}


@dataclass(frozen=True)
class JointPrior:
    """The joint normal prior of some unknowns, as one more residual each; of parameters, of their logarithms."""

    names: tuple[str, ...]
    mean: FloatArray
    rows: FloatArray  # of the residuals, by the unknowns

    def residual(self, values: Mapping[str, float]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """The residuals, and their derivatives by unknown."""
        logarithmic = [name in PARAMETER_NAMES for name in self.names]
        given = np.array([values[name] for name in self.names])
        # a resistance that the search takes below zero has no logarithm
        positive = np.where(logarithmic, np.maximum(given, MARGIN), 1.0)
        x, slopes = np.where(logarithmic, np.log(positive), given), 1.0 / positive
        return self.rows @ (x - self.mean), dict(zip(self.names, (self.rows * slopes).T, strict=True))


AnyPrior = Prior | SizePrior | JointPrior


@dataclass(frozen=True)
class Fit:
    """The result of a search."""

    values: dict[str, float]  # of all unknowns, and of held parameters
    jacobian: FloatArray  # of all residuals as they are weighed, those of priors included, by the unknowns
    residual_V: FloatArray  # at the samples
    square: float  # of all residuals as they are weighed
    at_bound: tuple[str, ...]  # which parameters are
    spread: float = 1.0  # how many times as wide as its curvature says the likelihood of q_mobile is
    knee_sd_C: float = 0.0  # of the charge that the record may give beyond the knee of its model


@dataclass(frozen=True)
class Search:
    """
    The search in one record: Levenberg-Marquardt's (MINPACK's) with exact derivatives, from the best of several starts. A
    parameter that leaves its bounds is held there.
    """

    model: RecordModel
    parameters: tuple[str, ...]
    nuisance: Mapping[str, float]  # standard deviations of further unknowns
    bounds: Mapping[str, tuple[float, float]]  # of both parameters, and of constants; q_mobile is above its least value
    data: OnGrid
    least_q_C: float  # below it the model cell is empty before the record ends
    # by which residuals are weighed; of 1 V: they stay as they are
    error: ErrorModel = field(default_factory=ErrorModel)

    @classmethod
    def of(
        cls,
        record: Record,
        model: RecordModel,
        parameters: tuple[str, ...],
        nuisance: Mapping[str, float],
        bounds: Mapping[str, tuple[float, float]],
    ) -> Search:
        """Prepare the search in a record; refuse one that says nothing, or takes more charge than the bounds allow."""
        data = OnGrid.of(record, model)
        if not data.current_A[:-1].any():
            raise ValueError("no current flows in this record: it says nothing about q_mobile and r_o")
        check_drawn_charge(drawn_charge_C(record))
        least_q_C = model.least_q_mobile_C(data.current_A)
        low_C, high_C = max(bounds["q_mobile"][0], (1.0 + MARGIN) * least_q_C), bounds["q_mobile"][1]
        if "q_mobile" in parameters and not low_C < high_C:
            raise ValueError(
                f"this record takes a q_mobile of at least {low_C:g} C, which is beyond the upper bound, {high_C:g} C. Raise "
                "q_mobile_bounds_C (command line: --cell, with a fit of such a cell), or check that time is in s and current "
                "in A."
            )
        return cls(model, parameters, nuisance, bounds, data, least_q_C)

    @property
    def unknown(self) -> tuple[str, ...]:
        """All that is searched for, in the order of the columns of the Jacobian."""
        return (*self.parameters, *self.nuisance)

    def until_empty(self) -> Search:
        """Leave out the samples after a cell of the held ``q_mobile`` is empty, whatever its ``r_o``."""
        q_mobile, data = self.model.cell.q_mobile, self.data
        n = len(self.model.simulate(data.current_A, q_mobile, 0.0).time_s)
        is_before_empty = data.time_s <= (n - 1) * data.dt_s
        if is_before_empty.sum() <= len(self.parameters):
            raise ValueError(
                f"a cell with q_mobile = {q_mobile:g} C is empty at the start of this record, which takes at least "
                f"{self.least_q_C:g} C. Search for q_mobile too, or hold it at another value."
            )
        data_until_empty = OnGrid(data.time_s[is_before_empty], data.voltage_V[is_before_empty], data.current_A[:n], data.dt_s)
        return replace(self, data=data_until_empty, least_q_C=0.0)

    def starts(self, q_candidates: Sequence[float]) -> tuple[list[dict[str, float]], FloatArray]:
        """
        Compare values of ``q_mobile`` on a coarse grid of time: return each, within its bounds, with the ``r_o`` that goes
        best with it (the voltage is nearly linear in it), and the sums of squared residuals as they are weighed.
        """
        cell, data = self.model.cell, self.data
        # the largest step for which neither a voltage drop nor the diffusion oscillates with explicit Euler
        stride = max(int(min(cell.to, cell.tsn, cell.tsp, 1.0 / _diffusion_rate(cell)) / data.dt_s), 1)
        if len(data.current_A) < _COARSE_POINTS * stride:
            stride = 1
        points = len(data.current_A) // stride
        current_A = data.current_A[: points * stride].reshape(points, stride).mean(axis=1)
        time_s = data.grid_s[: points * stride : stride]
        voltage_V = np.interp(time_s, data.time_s, data.voltage_V)
        error = self.error.along(time_s, current_A)
        starts, squares = [], []
        for candidate in q_candidates:
            q_mobile, r_o = candidate, cell.r_o
            if "q_mobile" in self.parameters:
                low_C, high_C = self.bounds["q_mobile"]
                q_mobile = _within(q_mobile, (max(low_C, (1.0 + MARGIN) * self.least_q_C), high_C))
            model_V, _, by_r_o_A = self.model.sensitivities(current_A, q_mobile, r_o, stride)
            residual, by_r_o = error.whitened(np.column_stack([model_V - voltage_V, by_r_o_A])).T
            if "r_o" in self.parameters:
                best_ohm = _within(r_o - float(residual @ by_r_o) / square(by_r_o), self.bounds["r_o"])
                residual = residual + (best_ohm - r_o) * by_r_o
                r_o = best_ohm
            starts.append({"q_mobile": q_mobile, "r_o": r_o})
            # on the coarse grid a cell may be empty a little too early
            squares.append(inf if isnan(square(residual)) else square(residual))
        return starts, np.array(squares)

    def best_starts(self, more_q_C: Sequence[float]) -> list[dict[str, float]]:
        """
        Return the local minima on a grid of ``q_mobile``, refined where promising, that may lead to the global one, the least
        first.
        """
        excess = _START_EXCESS
        coarse, coarse_squares = self.starts((self.least_q_C * (1.0 + excess)).tolist())
        promising = _is_near_best(coarse_squares)
        left_ends = np.flatnonzero(promising[:-1] | promising[1:])
        ratios = excess[left_ends + 1] / excess[left_ends]
        between = excess[left_ends, None] * ratios[:, None] ** (np.arange(1, _FINER) / _FINER)
        finer, finer_squares = self.starts([*(self.least_q_C * (1.0 + between.ravel())).tolist(), *more_q_C])
        starts, squares = [*coarse, *finer], np.append(coarse_squares, finer_squares)
        order = np.argsort([start["q_mobile"] for start in starts], kind="stable")
        squares = squares[order]
        padded = np.pad(squares, 1, constant_values=np.inf)
        minima = (squares <= padded[:-2]) & (squares < padded[2:]) & _is_near_best(squares)
        rivals = np.union1d(np.flatnonzero(minima), squares.argmin())
        return [starts[order[n]] for n in rivals[np.argsort(squares[rivals], kind="stable")]]

    def best(self, starts: Sequence[dict[str, float]], priors: Sequence[AnyPrior]) -> Fit:
        """Return the best fit that is found from any of the starts; one without an ``r_o`` is empty on the coarse grid."""
        return min((self._fit(start, priors) for start in starts if not isnan(start["r_o"])), key=lambda fit: fit.square)

    def _fit(self, start: dict[str, float], priors: Sequence[AnyPrior]) -> Fit:
        free, values = list(self.unknown), dict.fromkeys(self.nuisance, 0.0) | start
        while True:
            (values,) = JointSearch([self], priors).minimized([values], free, method="lm", gtol=1e-10)
            bounds = self._bounds_at(values)
            clipped = {name: _within(values[name], bounds[name]) for name in free if name in bounds}
            inside = [name for name in free if clipped.get(name, values[name]) == values[name]]
            values = values | clipped
            if len(inside) in (0, len(free)):
                break
            free = inside
        reached = self.model_at(values).cell  # with the rates that the steps of the model allow
        values |= {name: log(getattr(reached, name) / getattr(self.model.cell, name)) for name in self._rates}
        residual, jacobian = self.weighed(values, priors)
        at_bound = tuple(name for name in self.parameters if values[name] in self._bounds_at(values)[name])
        return Fit(values, jacobian, self.residual(values)[0], square(residual), at_bound)

    def spread(self, fit: Fit, priors: Sequence[AnyPrior], variance: float) -> float:
        """
        How many times as wide as its curvature says the likelihood of ``q_mobile`` is, between the points where its deviance,
        minus twice its logarithm, has risen by one, as a normal one's does in a standard deviation; at least 1. It is adjusted
        for the other unknowns (Cox and Reid 1987), which follow from point to point by a step of Gauss and Newton.
        """
        column = self.unknown.index("q_mobile")
        best_C = fit.values["q_mobile"]
        least_C, _ = self.least_q_at_C(fit.values)
        sd_C = sqrt(variance) * float(standard_deviations(fit.jacobian)[column])
        if not 0.0 < sd_C < inf or fit.at_bound:
            return 1.0
        names = [name for name in self.unknown if name != "q_mobile"]

        def adjusted(values: dict[str, float]) -> tuple[float, dict[str, float]]:
            residual, jacobian = self.weighed(values, priors)
            others = np.delete(jacobian, column, axis=1)
            change = np.linalg.lstsq(others, -residual, rcond=None)[0]
            deviance = square(residual + others @ change) / variance + np.linalg.slogdet(others.T @ others)[1]
            return deviance, values | {name: values[name] + float(each) for name, each in zip(names, change, strict=True)}

        best = adjusted(fit.values)
        least, ends_C = best[0], []
        # upward a likelihood may be flat: steps grow with the distance to the least value, where that is more than a step
        near_C = min(least_C, best_C - _STEP_SD * sd_C)
        for side in (-1, 1):
            (deviance, values), q_C = best, best_C
            for way_C in _STEP_SD * sd_C * np.arange(1, _STEPS):
                before, before_C = deviance, q_C
                q_C = best_C - way_C if side < 0 else near_C + (best_C - near_C) * exp(way_C / (best_C - near_C))
                bounds_C = self._bounds_at(values)["q_mobile"]
                if _within(q_C, bounds_C) != q_C:
                    q_C = _within(q_C, bounds_C)
                    break
                deviance, values = adjusted(values | {"q_mobile": q_C})
                least = min(least, deviance)
                if deviance > least + 1.0:
                    # of a normal likelihood the root of its rise is linear in the distance
                    q_C = float(np.interp(1.0, (sqrt(before - least), sqrt(deviance - least)), (before_C, q_C)))
                    break
            ends_C.append(q_C)
        return max((ends_C[1] - ends_C[0]) / (2.0 * sd_C), 1.0)

    def _bounds_at(self, values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Of all that has any; how slow the diffusion is moves the least ``q_mobile``."""
        (low_C, high_C), least_C = self.bounds["q_mobile"], self.least_q_at_C(values)[0]
        of_q_C = (max(low_C, (1.0 + MARGIN) * least_C), high_C)
        return {**_REACHED, **self.bounds, "q_mobile": of_q_C}

    def x_at(self, values: Mapping[str, float], free: Sequence[str]) -> list[float]:
        """
        The point of the search at some values. The search is over the logarithm of the distance of ``q_mobile`` to its least
        value: so every simulation lasts as long as the record, and the knee of a discharge is nearly straight.
        """
        least_C, _ = self.least_q_at_C(values)
        return [np.log(values[name] - least_C) if name == "q_mobile" else values[name] for name in free]

    def values_at(self, start: Mapping[str, float], x: Mapping[str, float]) -> tuple[dict[str, float], float, float]:
        """Values at a point of the search, the least ``q_mobile`` there, and its slope by the logarithm of ``tDiffusion``."""
        values = {**start, **x}
        least_C, least_by_log_C = self.least_q_at_C(values)
        if "q_mobile" in x:
            values["q_mobile"] = least_C + float(np.exp(min(x["q_mobile"], _LOG_LIMIT)))
        return values, least_C, least_by_log_C

    def weighed_at(
        self, start: Mapping[str, float], x: Mapping[str, float], priors: Sequence[AnyPrior]
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals as of :meth:`weighed` at a point of the search, and their derivatives by its coordinates."""
        values, least_C, least_by_log_C = self.values_at(start, x)
        residual, by_unknown = self.weighed(values, priors)
        unknown, free = self.unknown, list(x)
        slopes = [values[name] - least_C if name == "q_mobile" else 1.0 for name in free]
        by_x = by_unknown[:, [unknown.index(name) for name in free]] * slopes
        if "q_mobile" in free and "tDiffusion" in free:  # which moves q_mobile along with its least value
            by_x[:, free.index("tDiffusion")] += least_by_log_C * by_unknown[:, unknown.index("q_mobile")]
        return residual, by_x

    @cached_property
    def error_at_samples(self) -> VoltageError:
        """The error of the voltage at the samples."""
        return self.error.along(self.data.time_s, self.data.samples_A)

    def weighed(self, values: Mapping[str, float], priors: Sequence[AnyPrior]) -> tuple[FloatArray, FloatArray]:
        """Return residuals as their error weighs them, with one more for each prior, and their derivatives by all unknowns."""
        residual_V, jacobian_V = self.residual(values)
        rows = self.error_at_samples.whitened(np.column_stack([residual_V, jacobian_V]))
        residual, jacobian = rows[:, 0], rows[:, 1:]
        for prior in priors:
            of_prior, slopes = prior.residual(values)
            by_unknown = np.column_stack([slopes.get(name, np.zeros(len(of_prior))) for name in self.unknown])
            residual, jacobian = np.append(residual, of_prior), np.vstack([jacobian, by_unknown])
        return residual, jacobian

    def residual(self, values: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Return the residuals at the samples, V, and their derivatives by all unknowns."""
        model_V, *columns = self.data.at_samples(self.voltage(values))
        return model_V - self.data.voltage_V, np.column_stack(columns)

    def voltage(self, values: Mapping[str, float]) -> list[FloatArray]:
        """Return the voltage of the model on its grid of time, V, and its derivatives by all unknowns."""
        q_mobile, r_o = values["q_mobile"], values["r_o"]
        if self.nuisance:
            model_V, slopes, fraction_p = self.model_at(values).tangents(self.data.current_A, q_mobile, r_o)
            by_name = dict(zip(TANGENT_NAMES, slopes, strict=True)) | {"offset_V": np.ones(len(model_V))}
            if self._has_equilibrium:
                by_name |= zip(EQUILIBRIUM_NAMES, equilibrium_slopes(fraction_p, EQUILIBRIUM_SIZE), strict=True)
            model_V = model_V + values.get("offset_V", 0.0)
        else:
            model_V, *by_parameter = self.model.sensitivities(self.data.current_A, q_mobile, r_o)
            by_name = dict(zip(PARAMETER_NAMES, by_parameter, strict=True))
        return [model_V, *(by_name[name] for name in self.unknown)]

    def model_at(self, values: Mapping[str, float]) -> RecordModel:
        """Return the model with the nuisance constants at some values."""
        cell = self.model.cell
        constants = {}
        for name in self._rates:
            # a step of the search may go far, but explicit Euler is stable only for rates below 2 / dt
            constant = getattr(cell, name) * float(np.exp(_within(values[name], self.bounds.get(name, _REACHED[name]))))
            constants[name] = max(constant, self._least_stable(name))
        added_V = tuple(values[name] for name in EQUILIBRIUM_NAMES) if self._has_equilibrium else ()
        return _with_constants(self.model, tuple(constants.items()), added_V)

    @property
    def _rates(self) -> list[str]:
        return [name for name in RATE_CONSTANTS if name in self.nuisance]

    @property
    def _has_equilibrium(self) -> bool:
        return EQUILIBRIUM_NAMES[0] in self.nuisance

    def _least_stable(self, name: str) -> float:
        cell, dt_s = self.model.cell, self.model.dt_s
        if name == "tDiffusion":
            return 0.5 * cell.tDiffusion * dt_s * _diffusion_rate(cell)
        return 0.5 * dt_s if name in ("to", "tsn", "tsp") else 0.0

    def least_q_at_C(self, values: Mapping[str, float]) -> tuple[float, float]:
        """The least q_mobile that the record allows, and its derivative by the logarithm of ``tDiffusion``."""
        if "tDiffusion" not in self.nuisance:
            return self.least_q_C, 0.0
        return self.model_at(values).least_q_mobile_tangent_C(self.data.current_A)


@dataclass(frozen=True)
class JointSearch:
    """
    The search in one or more records, whose cells share all unknowns but their parameters. Its columns are the parameters of
    the first record, those of the second one, and so on; and then what all share.
    """

    searches: Sequence[Search]  # of the same unknowns
    priors: Sequence[AnyPrior]  # of what all share, and of the parameters of the first record

    def residuals_V(self, values: Sequence[Mapping[str, float]]) -> list[FloatArray]:
        """The residuals of each record, V."""
        return [search.residual(at)[0] for search, at in zip(self.searches, values, strict=True)]

    def weighed(self, values: Sequence[Mapping[str, float]]) -> tuple[FloatArray, FloatArray]:
        """The residuals of all records as they are weighed, those of the priors among them, and their derivatives."""
        each = enumerate(zip(self.searches, values, strict=True))
        parts = [search.weighed(at, () if n else self.priors) for n, (search, at) in each]
        return _stacked(parts, len(self.searches[0].parameters))

    def minimized(
        self,
        starts: Sequence[Mapping[str, float]],
        free: Sequence[str],
        limits: Mapping[str, tuple[float, float]] | None = None,
        **how: Any,
    ) -> list[dict[str, float]]:
        """
        Minimize the squares of the residuals by scipy over the free unknowns, in the order of :attr:`Search.unknown`, within
        limits of the points of the search; from values of each record to values of each record.
        """
        first, count = self.searches[0], len(self.searches)
        own = sum(name in first.parameters for name in free)
        names, scales = [*count * list(free[:own]), *free[own:]], {**_SCALES, **first.nuisance}
        points = [search.x_at(start, free) for search, start in zip(self.searches, starts, strict=True)]
        x0 = np.concatenate([*(point[:own] for point in points), points[0][own:]])
        if limits is not None:
            low, high = np.array([limits[name] for name in names]).T
            room = MARGIN * (high - low)
            how["bounds"], x0 = (low, high), np.clip(x0, low + room, high - room)

        def of_each(x: FloatArray) -> list[dict[str, float]]:
            rows = x[: count * own].reshape(count, own)
            return [dict(zip(free, [*row.tolist(), *x[count * own :].tolist()], strict=True)) for row in rows]

        @lru_cache(maxsize=1)  # scipy asks for residuals and derivatives one after the other
        def evaluated(x: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
            each = enumerate(zip(self.searches, starts, of_each(np.array(x)), strict=True))
            parts = [search.weighed_at(start, at, () if n else self.priors) for n, (search, start, at) in each]
            return _stacked(parts, own)

        def residual(x: FloatArray) -> FloatArray:
            return evaluated(tuple(x))[0]

        def jacobian(x: FloatArray) -> FloatArray:
            return evaluated(tuple(x))[1]

        best = least_squares(residual, x0, jacobian, x_scale=[scales[name] for name in names], **how)
        of_best = zip(self.searches, starts, of_each(best.x), strict=True)
        return [search.values_at(start, at)[0] for search, start, at in of_best]


def _stacked(parts: Sequence[tuple[FloatArray, FloatArray]], own: int) -> tuple[FloatArray, FloatArray]:
    """Residuals of all records, and their derivatives, of which each record has so many first columns for itself."""
    of_each, shared = block_diag(*(rows[:, :own] for _, rows in parts)), np.vstack([rows[:, own:] for _, rows in parts])
    return np.concatenate([residual for residual, _ in parts]), np.hstack([of_each, shared])


@lru_cache(maxsize=4)  # it is asked for several times at each step of a search
def _with_constants(model: RecordModel, rates: tuple[tuple[str, float], ...], added_V: tuple[float, ...]) -> RecordModel:
    """A model with other rates, and with what is added to the equilibrium voltage."""
    cell = model.cell
    if rates:
        cell = cell.replace(**dict(rates))
    if added_V:
        cell = with_equilibrium(cell, list(added_V))
    return model if cell is model.cell else model.of_cell(cell)


def _diffusion_rate(cell: CellParameters) -> float:
    """At which the charges of bulk and surface come together, 1/s."""
    return float(cell.packed.constants[0, [BULK_RATE, SURFACE_RATE]].sum())


def spread_over(length: int, count: int) -> IntArray:
    """At most so many places of a sequence, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, length - 1, min(count, length)).round().astype(np.int64))


def square(array: FloatArray) -> float:
    """Sum of squares."""
    return float(array @ array)


def covariance(jacobian: FloatArray) -> FloatArray:
    """(J^T J)^-1: of the unknowns, of residuals whose variance is one; infinite where the data do not determine them."""
    try:
        return np.asarray(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return np.full((jacobian.shape[1], jacobian.shape[1]), np.inf)


def standard_deviations(jacobian: FloatArray) -> FloatArray:
    """The roots of the diagonal of :func:`covariance`."""
    return np.asarray(np.sqrt(np.diag(covariance(jacobian))))


def root_variance(jacobian: FloatArray, row: FloatArray) -> float:
    """The standard deviation of a linear function of the unknowns; infinite where the data do not determine them."""
    variance = float(row @ covariance(jacobian) @ row)
    return inf if isnan(variance) else sqrt(max(variance, 0.0))


def _within(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])


def _is_near_best(squares: FloatArray) -> BoolArray:
    return np.asarray(squares <= _RIVAL_RATIO * squares.min())
