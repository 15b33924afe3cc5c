"""Calibration by least squares on the voltage of a whole record: what learning has to compete with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from battery_env.cells import SWITCH_SHARE, resample_current
from battery_env.electrochemistry import (
    FULL_CHARGE_SHARES,
    NEW_CELL,
    Q_MOBILE_LIMITS_C,
    QNB,
    QNS,
    QPS,
    STATE_SIZE,
    VO,
    CellParameters,
    FloatArray,
    Trajectory,
    check_dt,
    check_q_mobile,
    check_r_o,
    initial_state,
    simulate,
)
from battery_env.estimators.base import Estimate, Estimator, Record

#: An estimate counts as settled when its standard deviation is below this share of its value. That of ``r_o`` is wider: on a
#: real cell the error of the model divided by the current is a quarter of it already.
SETTLED_SHARES = {"q_mobile": 0.02, "r_o": 0.3}

_NAMES = ("q_mobile", "r_o")
# Where the search for q_mobile starts: this much above the least value that the record allows. The narrow ones serve whole
# discharges, the wide ones the first minutes of one.
_START_EXCESS = 0.003 * 5.0 ** np.arange(7)
_REFERENCE_Q_C = Q_MOBILE_LIMITS_C[1]
_REFERENCE_R_O_OHM = 1.0
# The total of the four charges is q_mobile / 0.6 at all times.
_Q_PER_CHARGE = 1.0 / float(FULL_CHARGE_SHARES.sum())
# How far the search keeps from the least q_mobile, as a share of it: more than rounding, less than anyone measures.
_MARGIN = 1e-6
_SEARCH_SCALES = {"q_mobile": 1000.0, "r_o": 0.1}


class _Problem(NamedTuple):
    """One record on the model's time grid, and what follows from its current alone."""

    time_s: FloatArray  # of the samples, since the first one
    voltage_V: FloatArray
    current_A: FloatArray  # over each step of the model
    least_q_C: float  # below it the model cell is empty before the record ends
    ohmic_A: FloatArray  # the ohmic voltage drop at the samples per ohm of r_o


class _Start(NamedTuple):
    values: dict[str, float]
    square_V2: float  # sum of the squared residuals, but for the small effect of r_o on the temperature


class _Fit(NamedTuple):
    values: dict[str, float]
    jacobian: FloatArray  # of the residuals, V, with respect to the parameters searched for
    square_V2: float  # sum of the squared residuals
    at_bound: bool


class LeastSquares(Estimator):
    """
    The (q_mobile, r_o) whose simulated voltage is closest to the recorded one, over all samples of the record.

    The model starts at the first sample of the record, fully charged and at rest unless ``initial`` says otherwise, and
    follows the recorded current (:func:`battery_env.cells.resample_current`). For a recorded discharge give
    :meth:`battery_env.cells.Discharge.loaded_part`, which starts when the load is switched on.

    *The least q_mobile.* At a fixed current the charges of the model are linear in ``q_mobile``; so one simulation gives
    exactly the value below which the model cell would be empty before the record ends. The search stays above it, where
    every simulation lasts as long as the record and the voltage is smooth in both parameters.

    *Standard deviations.* The covariance is (s^2 + n m^2) (J^T J)^-1: J is the Jacobian of the n simulated voltages, s^2 the
    variance of the residuals, m ``mismatch_V``. With m = 0 this holds for white residuals, as of simulated records with
    noise. On a real cell the residuals are the model's error, which is far from white and which a fit of half a discharge
    hides in its parameters: the white formula then claims 1 % where the estimate is 40 % off. There set ``mismatch_V`` to
    the error expected of the model (0.05 V for the cells that come with the package): it counts as one error common to
    the record, which more samples do not make smaller.

    *Settled* means that every parameter searched for is inside its bounds, with a standard deviation below
    ``SETTLED_SHARES`` of its value, and that the model lasts as long as the record.

    *Prior.* Before its knee a discharge says little about ``q_mobile``. To calibrate during a discharge, carry
    (mean, standard deviation) over from an earlier one as ``prior_q_mobile_C``; it enters as one more residual.

    :param parameters: which to search for; the other is held at ``cell``'s value
    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: time step of the model, s; that of simulated records if these are to be reproduced exactly
    :param initial: state of the model at the first sample, shape (8,), e.g. from a simulation. It stands for a history
        of the current: its charges move along with ``q_mobile``. ``None``: fully charged, at rest
    :param q_mobile_bounds_C: where to search, C; the lower one is raised to the least value that the record allows
    :param r_o_bounds_ohm: where to search, ohm
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before this record, C; ``None``: nothing is known
    :param mismatch_V: error to expect of the model itself, V, as above
    :raises ValueError: for an argument out of range
    """

    def __init__(
        self,
        parameters: Sequence[str] = _NAMES,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        initial: ArrayLike | None = None,
        q_mobile_bounds_C: tuple[float, float] = (Q_MOBILE_LIMITS_C[0], 1e5),
        r_o_bounds_ohm: tuple[float, float] = (0.0, 1.0),
        prior_q_mobile_C: tuple[float, float] | None = None,
        mismatch_V: float = 0.0,
    ) -> None:
        self.parameters = tuple(parameters)
        if not self.parameters or len(set(self.parameters)) < len(self.parameters) or set(self.parameters) - set(_NAMES):
            raise ValueError(f"parameters must be one or both of {_NAMES}, got {parameters!r}")
        self.cell = cell or NEW_CELL
        self.thermal = thermal
        self.dt_s = check_dt(dt_s, self.cell)
        self.initial = initial_state(_REFERENCE_Q_C, self.cell) if initial is None else np.array(initial, dtype=np.float64)
        if self.initial.shape != (STATE_SIZE,) or not np.isfinite(self.initial).all():
            raise ValueError(f"initial must hold {STATE_SIZE} finite numbers, got {initial!r}")
        self.bounds = {"q_mobile": q_mobile_bounds_C, "r_o": r_o_bounds_ohm}
        for name, limits in (("q_mobile", check_q_mobile(q_mobile_bounds_C)), ("r_o", check_r_o(r_o_bounds_ohm))):
            if limits.shape != (2,) or not limits[0] < limits[1]:
                raise ValueError(f"the bounds of {name} must be (lower, upper) with lower < upper, got {self.bounds[name]!r}")
        if prior_q_mobile_C is not None:
            if "q_mobile" not in self.parameters:
                raise ValueError("prior_q_mobile_C needs 'q_mobile' among the parameters to search for")
            check_q_mobile(prior_q_mobile_C[0])
            if not 0.0 < prior_q_mobile_C[1] < np.inf:
                raise ValueError(f"prior_q_mobile_C is (mean, sd) with sd > 0, got {prior_q_mobile_C!r}")
        self.prior_q_mobile_C = prior_q_mobile_C
        if not 0.0 <= mismatch_V < np.inf:
            raise ValueError(f"mismatch_V must be at least 0 V, got {mismatch_V!r}")
        self.mismatch_V = mismatch_V

    def estimate(self, record: Record) -> Estimate:
        """
        Search for the parameters of one record.

        :param record: one discharge
        :return: the estimate
        :raises ValueError: if the record cannot be used, or the least ``q_mobile`` it allows is outside the bounds
        """
        problem = self._problem(record)
        candidates = problem.least_q_C * (1.0 + _START_EXCESS)
        if "q_mobile" not in self.parameters:
            candidates, problem = np.array([self.cell.q_mobile]), self._until_empty(problem)
        starts = [self._start(problem, q) for q in candidates]
        fit = self._search(problem, min(starts, key=lambda start: start.square_V2).values)
        n = len(problem.time_s)
        variance_V2 = fit.square_V2 / (n - len(self.parameters)) + n * self.mismatch_V**2
        if self.prior_q_mobile_C is not None:
            weight_V, middle = float(np.sqrt(variance_V2)), self._start(problem, self.prior_q_mobile_C[0]).values
            fit = min(
                (self._search(problem, start, weight_V) for start in (fit.values, middle)), key=lambda fit: fit.square_V2
            )
        sd = dict.fromkeys(_NAMES, float("nan"))
        for name, root in zip(self.parameters, _root_inverse_diagonal(fit.jacobian), strict=True):
            sd[name] = float(np.sqrt(variance_V2) * root)
        settled = n == len(record.time_s) and not fit.at_bound
        settled &= all(sd[name] < SETTLED_SHARES[name] * fit.values[name] for name in self.parameters)
        return Estimate(fit.values["q_mobile"], fit.values["r_o"], sd["q_mobile"], sd["r_o"], settled)

    def predict_voltage_V(self, record: Record, estimate: Estimate) -> FloatArray:
        """
        The voltage that the model shows at the samples of a record, under its current.

        :param record: one discharge
        :param estimate: the parameters
        :return: voltage in V, shape (T,); NaN after the model cell is empty
        """
        time_s, current_A = self._grid(record)
        return _at(time_s, self._simulate(current_A, estimate.q_mobile, estimate.r_o))

    def forecast(self, record: Record, estimate: Estimate, cut_off_V: float | None = None) -> tuple[FloatArray, FloatArray]:
        """
        The voltage of the model from the first sample of a record down to the cut-off, under the current of the record,
        which keeps its last value beyond the end.

        :param record: one discharge, whole or in progress
        :param estimate: the parameters
        :param cut_off_V: cut-off voltage, V; ``None``: the ``VEOD`` of ``cell``
        :return: time on the clock of the record, s, and voltage, V. The last point is at the cut-off, interpolated between
            steps; if it is never reached, as the load is off at the end of the record, the last point is above it
        """
        _, current_A = self._grid(record)
        cut_off = self.cell.VEOD if cut_off_V is None else cut_off_V
        last_A = float(record.current_A[-1])
        if last_A > SWITCH_SHARE * np.abs(record.current_A).max():
            # no cell of this q_mobile lasts longer than this, whatever it had delivered before
            current_A = np.append(current_A, np.full(int(estimate.q_mobile / (last_A * self.dt_s)) + 1, last_A))
        simulation = self._simulate(current_A, estimate.q_mobile, estimate.r_o)
        time_s, voltage_V = float(record.time_s[0]) + simulation.time_s, simulation.voltage_V
        below = np.flatnonzero(voltage_V <= cut_off)
        if not len(below):
            if np.isnan(simulation.eod_time_s):
                return time_s, voltage_V
            n, end_s = len(time_s), float(record.time_s[0]) + simulation.eod_time_s  # the cell is empty one step later
        else:
            n = int(below[0])
            around = [n, max(n - 1, 0)]
            end_s = float(np.interp(cut_off, voltage_V[around], time_s[around]))
        return np.append(time_s[:n], end_s), np.append(voltage_V[:n], cut_off)

    def predict_eod_time_s(self, record: Record, estimate: Estimate, cut_off_V: float | None = None) -> float:
        """
        When the model reaches the cut-off (:meth:`forecast`).

        :param record: one discharge, whole or in progress
        :param estimate: the parameters
        :param cut_off_V: cut-off voltage, V; ``None``: the ``VEOD`` of ``cell``
        :return: the end of discharge on the clock of the record, s; NaN if it is never reached
        """
        cut_off = self.cell.VEOD if cut_off_V is None else cut_off_V
        time_s, voltage_V = self.forecast(record, estimate, cut_off)
        return float(time_s[-1]) if voltage_V[-1] <= cut_off else float("nan")

    def _grid(self, record: Record) -> tuple[FloatArray, FloatArray]:
        time_s = np.asarray(record.time_s, dtype=np.float64)
        if time_s.ndim != 1 or len(time_s) <= len(self.parameters) or not (np.diff(time_s) > 0.0).all():
            raise ValueError(f"a record needs more than {len(self.parameters)} samples, in the order of time")
        n_steps = int(np.ceil((time_s[-1] - time_s[0]) / self.dt_s - 1e-6)) + 1
        current_A = resample_current(time_s, np.asarray(record.current_A, dtype=np.float64), self.dt_s, n_steps)
        return time_s - time_s[0], current_A

    def _problem(self, record: Record) -> _Problem:
        time_s, current_A = self._grid(record)
        voltage_V = np.asarray(record.voltage_V, dtype=np.float64)
        if voltage_V.shape != time_s.shape or not np.isfinite(voltage_V).all():
            raise ValueError("voltage_V of the record must hold one finite value a sample")
        if not current_A.any():
            raise ValueError("no current flows in this record: it says nothing about q_mobile and r_o")
        # charges are linear in q_mobile; both of these are too large for the record to exhaust
        low_q_C, high_q_C = 0.5 * _REFERENCE_Q_C, _REFERENCE_Q_C
        low, high = (self._simulate(current_A, q, _REFERENCE_R_O_OHM) for q in (low_q_C, high_q_C))
        if len(low.time_s) < len(current_A):
            raise ValueError(f"the record draws too much charge for a q_mobile of {low_q_C:g} C. Is its current in A?")
        slope = (high.state[:, [QNS, QPS]] - low.state[:, [QNS, QPS]]) / (high_q_C - low_q_C)
        moved_C = high.state[:, [QNS, QPS]] - slope * high_q_C
        # neither surface is empty or overfull: 0 < slope * q + moved < (share of all sites that are at the surface) * q
        full = self.cell.VolSFraction * FULL_CHARGE_SHARES.sum()
        least_q_C = float(max((-moved_C / slope).max(), (moved_C / (full - slope)).max(), 0.0))
        ohmic_A = np.interp(time_s, high.time_s, high.state[:, VO]) / _REFERENCE_R_O_OHM
        return _Problem(time_s, voltage_V, current_A, least_q_C * (1.0 + _MARGIN), ohmic_A)

    def _simulate(self, current_A: FloatArray, q_mobile: float, r_o: float) -> Trajectory:
        start = self.initial.copy()
        start[QNB:] += (q_mobile - _Q_PER_CHARGE * start[QNB:].sum()) * FULL_CHARGE_SHARES
        return simulate(
            current_A,
            q_mobile,
            r_o,
            dt=self.dt_s,
            load_unit="current",
            thermal=self.thermal,
            parameters=self.cell,
            initial=start,
            cut_off_V=-np.inf,
            max_duration_s=len(current_A) * self.dt_s,
        )

    def _until_empty(self, problem: _Problem) -> _Problem:
        """The samples that a cell of the held ``q_mobile`` lives to see, whatever its ``r_o``."""
        n = len(self._simulate(problem.current_A, self.cell.q_mobile, 0.0).time_s)
        seen = problem.time_s <= (n - 1) * self.dt_s
        if seen.sum() <= len(self.parameters):
            raise ValueError(
                f"a cell with q_mobile = {self.cell.q_mobile:g} C is empty at the start of this record, which takes at least "
                f"{problem.least_q_C:g} C. Search for q_mobile too, or hold it at another value."
            )
        return problem._replace(
            time_s=problem.time_s[seen],
            voltage_V=problem.voltage_V[seen],
            ohmic_A=problem.ohmic_A[seen],
            current_A=problem.current_A[:n],
            least_q_C=0.0,
        )

    def _start(self, problem: _Problem, q_mobile: float) -> _Start:
        """The given ``q_mobile`` within its bounds, and the ``r_o`` that goes best with it: the voltage is linear in it."""
        if "q_mobile" in self.parameters:
            low, high = self.bounds["q_mobile"]
            q_mobile = min(max(q_mobile, low, problem.least_q_C), high)
        if "r_o" not in self.parameters:
            values = {"q_mobile": q_mobile, "r_o": self.cell.r_o}
            return _Start(values, _square(self._residual(problem, values)))
        excess_V = self._residual(problem, {"q_mobile": q_mobile, "r_o": 0.0})
        r_o = float(np.clip(excess_V @ problem.ohmic_A / _square(problem.ohmic_A), *self.bounds["r_o"]))
        return _Start({"q_mobile": q_mobile, "r_o": r_o}, _square(excess_V - r_o * problem.ohmic_A))

    def _search(self, problem: _Problem, start: dict[str, float], prior_weight_V: float = 0.0) -> _Fit:
        low, high = np.array([self.bounds[name] for name in self.parameters]).T
        if "q_mobile" in self.parameters:
            n = self.parameters.index("q_mobile")
            low[n] = max(low[n], problem.least_q_C)
            if not low[n] < high[n]:
                raise ValueError(
                    f"this record takes a q_mobile of at least {low[n]:g} C, which is beyond the upper bound, {high[n]:g} C. "
                    "Raise q_mobile_bounds_C, or check that time is in s and current in A."
                )

        def named(x: FloatArray) -> dict[str, float]:
            return start | {name: float(value) for name, value in zip(self.parameters, x, strict=True)}

        def residual(x: FloatArray) -> FloatArray:
            return self._residual(problem, named(x), prior_weight_V)

        result = least_squares(
            residual,
            [start[name] for name in self.parameters],
            bounds=(low, high),
            x_scale=[_SEARCH_SCALES[name] for name in self.parameters],
            gtol=1e-10,
        )
        at_bound = bool(np.any(result.active_mask))
        return _Fit(named(result.x), np.asarray(result.jac), 2.0 * float(result.cost), at_bound)

    def _residual(self, problem: _Problem, values: dict[str, float], prior_weight_V: float = 0.0) -> FloatArray:
        simulation = self._simulate(problem.current_A, values["q_mobile"], values["r_o"])
        residual_V = _at(problem.time_s, simulation) - problem.voltage_V
        if prior_weight_V == 0.0 or self.prior_q_mobile_C is None:
            return residual_V
        mean_C, sd_C = self.prior_q_mobile_C
        return np.append(residual_V, prior_weight_V * (values["q_mobile"] - mean_C) / sd_C)


def _at(time_s: FloatArray, simulation: Trajectory) -> FloatArray:
    return np.interp(time_s, simulation.time_s, simulation.voltage_V, right=np.nan)


def _square(array: FloatArray) -> float:
    return float(array @ array)


def _root_inverse_diagonal(jacobian: FloatArray) -> FloatArray:
    """The roots of the diagonal of (J^T J)^-1; infinite where the data do not determine the parameters."""
    try:
        return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    except np.linalg.LinAlgError:
        return np.full(jacobian.shape[1], np.inf)
