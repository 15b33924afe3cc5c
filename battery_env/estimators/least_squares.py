"""Calibration by least squares on the voltage of a whole record: what learning has to compete with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from functools import lru_cache
from math import hypot, inf, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from battery_env.arrays import BoolArray, FloatArray
from battery_env.checks import check_gain_sd, check_positive
from battery_env.electrochemistry import CellParameters
from battery_env.electrochemistry.cell import BULK_RATE, SURFACE_RATE
from battery_env.electrochemistry.tangents import RATE_CONSTANTS, TANGENT_NAMES
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.base import Estimator, check_bounds
from battery_env.estimators.gaps import DRAWN, NOT_DRAWN, UNSURE, Gap, find_gaps
from battery_env.estimators.rest import InitialSoc, Start, check_initial_soc, told_at_rest
from battery_env.estimators.settling import (
    AT_BOUND,
    EMPTY,
    EXCESS_LIMIT_UNSTATED,
    IMPLAUSIBLE,
    IMPRECISE,
    MISFIT,
    MISMATCH_MARGIN,
    PRIOR_ALONE,
    PRIOR_CONTRADICTED,
    PRIOR_LIMIT_SD,
    SCALE_UNKNOWN,
    SETTLED_SHARES,
    SPARE_SAMPLES,
    first_reason,
    gap_reason,
    imprecise_text,
    is_plausible,
    least_resistance_ohm,
    sensor_reason,
    start_reason,
    white_noise_V,
)
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, check_parameters
from battery_env.record_model import LONGEST_FORECAST_S, RecordModel
from battery_env.records import Record, Samples, check_drawn_charge, check_record, drawn, starts_at_rest

# Where the search for q_mobile may start: this much above the least value that the record allows. The narrow ones serve whole
# discharges, the wide ones the first minutes of one.
_START_EXCESS = 0.003 * 2.2 ** np.arange(13)
# Starts whose squares are within this ratio of the least are promising. The intervals beside them are cut into so many parts,
# and the search goes on from each that is a local minimum then.
_RIVAL_RATIO = 2.0
_FINER = 4
# Starts are compared on a coarse grid of time if it has at least this many points.
_COARSE_POINTS = 100
# How far the search keeps from the least q_mobile, as a share of it: more than rounding, less than anyone measures.
_MARGIN = 1e-6
_SEARCH_SCALES = {"q_mobile": 1.0, "r_o": 0.1}
# The distance of q_mobile to its least value is below exp of this, so that no step of the search overflows.
_LOG_LIMIT = 50.0
# Logarithms of nuisance constants are held within this.
_REACH = 5.0
# Residuals whose variance is this many of its standard deviations above the one expected are not noise.
_EXCESS_LIMIT = 5.0
# Residuals below this are as good as none, V: files are rounded.
_NEGLIGIBLE_V = 1e-3
# The effect of the charge at the start is taken over this step.
_SOC_STEP = 1e-3
# Sensors are not taken to be better than this where no noise is stated, V.
_NOISE_V = 0.005
# Noise told from residuals is not below the resolution of a voltmeter, V.
_LEAST_NOISE_V = 1e-4
# The end of a record agrees with an estimate within this share of its duration.
_END_SHARE = 0.02
_FEW = "These are too few samples to tell the noise. Record on or more often, or state voltage_noise_V."
# At so many points of what is still to come it is told how well q_mobile would be known by then.
_DEPTHS = 500


class _Problem(NamedTuple):
    """One record on the model's time grid, and what follows from its current alone."""

    time_s: FloatArray  # of the samples, since the first one
    voltage_V: FloatArray
    current_A: FloatArray  # over each step of the model
    on_grid: bool  # whether the samples are the points of the grid
    least_q_C: float  # below it the model cell is empty before the record ends


class _Prior(NamedTuple):
    """What is known of one unknown, as one more residual."""

    name: str
    mean: float
    weight_V: float  # per unit of the unknown


class _Start(NamedTuple):
    values: dict[str, float]
    square_V2: float  # sum of the squared residuals on a coarse grid of time


class _Fit(NamedTuple):
    values: dict[str, float]
    jacobian: FloatArray  # of the residuals, V, with respect to the parameters searched for
    residual_V: FloatArray  # at the samples
    square_V2: float  # sum of all squared residuals, those of priors included
    at_bound: tuple[str, ...]  # which parameters are


class LeastSquares(Estimator):
    """
    The (q_mobile, r_o) whose simulated voltage is closest to the recorded one, over all samples of the record.

    The model starts at the first sample of the record, fully charged and at rest unless ``initial_soc`` or ``initial`` say
    otherwise, and follows the recorded current (:func:`battery_env.records.resample_current`). For a recorded discharge give
    :meth:`battery_env.cells.Discharge.loaded_part`, which starts when the load is switched on.

    *The search.* At a fixed current the charges of the model are linear in ``q_mobile``; so one simulation gives exactly the
    value below which the model cell would be empty before the record ends. The search stays above it, where every simulation
    lasts as long as the record; it is over the logarithm of the distance to it, in which the knee of a discharge is nearly
    straight. It is Levenberg-Marquardt's (MINPACK's) with exact derivatives, from the best of several starts on a coarse grid
    of time. A parameter that leaves its bounds is held there.

    *Standard deviations.* The covariance is (s^2 + n m^2) (J^T J)^-1: J is the Jacobian of the n simulated voltages, s^2 the
    variance of the residuals, m ``mismatch_V``. With m = 0 this holds for white residuals, as of simulated records with
    noise. On a real cell the residuals are the model's error, which is far from white and which a fit of half a discharge
    hides in its parameters: the white formula then claims 1 % where the estimate is 40 % off. There set ``mismatch_V`` to
    the error expected of the model (0.05 V for the cells that come with the package): it counts as one error common to
    the record, which more samples do not make smaller. Where the noise is known, give it as ``voltage_noise_V``: it then
    takes the place of s, which a few samples cannot tell.

    The gain of the current sensor scales both parameters and does not show in the voltage: state it as ``current_gain_sd``.

    *Settled* means that the record alone determines every parameter searched for, with a standard deviation below
    :data:`~battery_env.estimators.settling.SETTLED_SHARES` of its value without any prior, and that nothing contradicts it:

    - the record can start with a full cell (:func:`~battery_env.estimators.settling.start_reason`), or with one of
      ``initial_soc``, unless ``initial`` is given;
    - where it was not logged for a while under load (:mod:`~battery_env.estimators.gaps`), the voltage falls by what was drawn
      meanwhile. If noise hides that, the charge in doubt is in the standard deviation of ``q_mobile``;
    - each parameter is inside its bounds, ``q_mobile`` is plausible for a cell of this kind, and the model lasts as long as
      the record;
    - the residuals are no larger than noise and twice ``mismatch_V`` explain. They are where the sensor has an offset, or
      where the parameter that is held is wrong. The noise is ``voltage_noise_V``, or the white part of the residuals;
    - the voltage follows the current where the load is switched, and does not rise where it is not;
    - the model comes down to the lowest voltage of the record when the record did, to 2 % of its duration;
    - a prior is within 2.5 standard deviations of what the record says;
    - if no noise is stated, there are at least 10 samples more than parameters.

    Otherwise ``reason`` of the estimate says which of these does not hold. In particular an estimate that rests on a prior is
    not settled: it is as good as the prior.

    *Nuisance constants.* Constants that are not known exactly can be estimated along with the parameters, each under a prior
    of its own, and so can an offset of the voltage sensor: where the model is wrong in a known way, that is better than to
    let the parameters take the blame. Their uncertainty is in the standard deviations of the parameters. The priors are
    weighed against the noise; if none is stated, it is told from the white part of the residuals.

    *During a discharge*, :meth:`trace` with ``window_every_s`` estimates again and again from all samples so far.

    *Prior.* Before its knee a discharge says little about ``q_mobile``. To calibrate during a discharge, carry
    (mean, standard deviation) over from an earlier one as ``prior_q_mobile_C``; it enters as one more residual.

    :param parameters: which to search for; the other is held at ``cell``'s value
    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: time step of the model, s; that of simulated records if these are to be reproduced exactly
    :param initial: state of the model at the first sample, shape (8,), e.g. from a simulation. It stands for a history
        of the current: its charges move along with ``q_mobile``. ``None``: at rest, with ``initial_soc``
    :param q_mobile_bounds_C: where to search, C; the lower one is raised to the least value that the record allows
    :param r_o_bounds_ohm: where to search, ohm
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before this record, C; ``None``: nothing is known
    :param mismatch_V: error to expect of the model itself, V, as above
    :param voltage_noise_V: standard deviation of the noise of the voltage sensor, V; ``None``: that of the residuals
    :param window_every_s: time between the estimates of :meth:`trace`, s; ``None``: one estimate, at the end
    :param current_gain_sd: standard deviation of the gain of the current sensor, as a share of it
    :param nuisance: what else is not known: standard deviations of the logarithms of constants, by name, e.g.
        ``{"kn": 0.2, "tDiffusion": 0.2}`` for two that are known to 20 %; and of the offset of the sensor in V, as
        ``"offset_V"``
    :param initial_soc: state of charge at the first sample, after a rest: a number; (mean, standard deviation), which adds to
        those of the parameters; or ``"rest"``: it is told from the voltage of the rest before the load, of a minute at least,
        by the open-circuit voltage of the model, with ``voltage_noise_V`` and ``mismatch_V``, at least 5 mV, as its errors.
        The fit then starts with the last sample of the rest, and the model of a record is :meth:`model_for`
    :raises ValueError: for an argument out of range
    """

    def __init__(
        self,
        parameters: Sequence[str] = PARAMETER_NAMES,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        initial: ArrayLike | None = None,
        q_mobile_bounds_C: tuple[float, float] = (Q_MOBILE.limits[0], 1e5),
        r_o_bounds_ohm: tuple[float, float] = (0.0, 1.0),
        prior_q_mobile_C: tuple[float, float] | None = None,
        mismatch_V: float = 0.0,
        voltage_noise_V: float | None = None,
        window_every_s: float | None = None,
        current_gain_sd: float = 0.0,
        nuisance: Mapping[str, float] | None = None,
        initial_soc: InitialSoc = 1.0,
    ) -> None:
        self.parameters = check_parameters(parameters)
        self.nuisance = _check_nuisance({} if nuisance is None else nuisance, self.parameters)
        self.initial_soc = check_initial_soc(initial_soc)
        self.told_from_rest = isinstance(initial_soc, str)
        if self.told_from_rest and initial is not None:
            raise ValueError("initial is a whole state: give it or initial_soc, got both, initial_soc = 'rest'")
        self._model_at_start = RecordModel(cell, thermal, dt_s, initial, self.initial_soc[0])
        self.bounds = check_bounds(q_mobile_bounds_C, r_o_bounds_ohm)
        if prior_q_mobile_C is not None:
            if "q_mobile" not in self.parameters:
                raise ValueError("prior_q_mobile_C needs 'q_mobile' among the parameters to search for")
            Q_MOBILE.check(prior_q_mobile_C[0])
            if not 0.0 < prior_q_mobile_C[1] < np.inf:
                raise ValueError(f"prior_q_mobile_C is (mean, sd) with sd > 0, got {prior_q_mobile_C!r}")
        self.prior_q_mobile_C = prior_q_mobile_C
        if not 0.0 <= mismatch_V < np.inf:
            raise ValueError(f"mismatch_V must be at least 0 V, got {mismatch_V!r}")
        self.mismatch_V = mismatch_V
        self.current_gain_sd = check_gain_sd(current_gain_sd)
        self._at_rest = initial is None
        for name, value in (("voltage_noise_V", voltage_noise_V), ("window_every_s", window_every_s)):
            if value is not None and not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be greater than 0, got {value!r}")
        self.voltage_noise_V = voltage_noise_V
        self.window_every_s = window_every_s

    def estimate(self, record: Record) -> Estimate:
        """
        Search for the parameters of one record.

        :param record: one discharge
        :return: the estimate
        :raises ValueError: if the record cannot be used, or the least ``q_mobile`` it allows is outside the bounds
        """
        known, part, start = self._begun(record)
        return known._estimate(part, start, starts_at_rest(record))

    @property
    def model(self) -> RecordModel:
        """
        The model, which starts as ``initial_soc`` or ``initial`` say.

        :return: the model
        :raises ValueError: where the start is told from each record; :meth:`model_for` has its model
        """
        if self.told_from_rest:
            raise ValueError("the charge at the start is told from each record: model_for(record) is the model of one")
        return self._model_at_start

    def model_for(self, record: Record) -> RecordModel:
        """
        The model of one record, whose forecasts belong to its estimate.

        :param record: one discharge, with its rest where the start is told from that
        :return: the model as it starts with this record
        :raises ValueError: if the record cannot be used
        """
        return self._begun(record)[0].model

    def start_of(self, record: Record) -> Start:
        """
        The state of charge that a record starts with: the one that is stated, or what its rest tells.

        :param record: one discharge
        :return: as far as it can be told
        :raises ValueError: if the record cannot be used
        """
        if not self.told_from_rest:
            return Start(*self.initial_soc)
        offset_sd_V = max(_NOISE_V, self.mismatch_V)
        error_V = hypot(self.voltage_noise_V or offset_sd_V, offset_sd_V)
        return told_at_rest(record, self._model_at_start.cell, error_V, self._model_at_start.dt_s)

    def _begun(self, record: Record) -> tuple[LeastSquares, Record, Start]:
        """One that knows how a record starts, the record from the end of the rest on that tells it, and that start."""
        start = self.start_of(record)
        if not self.told_from_rest:
            return self, record, start
        known, own = copy(self), self._model_at_start
        known.initial_soc, known.told_from_rest = (start.soc, start.sd_soc), False
        known._model_at_start = RecordModel(own.cell, own.thermal, own.dt_s, initial_soc=start.soc)
        return known, Samples(*(column[max(start.samples - 1, 0) :] for column in Samples.of(record))), start

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        With ``window_every_s``: estimates over time, each from all samples so far, and starting from the one before as well;
        otherwise one estimate at the end of each record.

        :param records: discharges
        :return: one trace per discharge, in the same order
        :raises ValueError: as :meth:`estimate`
        """
        if self.window_every_s is None:
            return super().trace(records)
        return [self._growing_trace(record, self.window_every_s) for record in records]

    def _growing_trace(self, record: Record, every_s: float) -> EstimateTrace:
        known, part, start = self._begun(record)
        whole = Samples.of(part)
        time_s = whole.time_s
        samples = np.searchsorted(time_s, np.arange(time_s[0] + every_s, time_s[-1], every_s), side="right")
        # the current of a sample shows at the next one
        fewest = max(len(self.parameters), *np.flatnonzero(whole.current_A)[:1] + 1) + 1
        stops = np.unique(np.append(samples[samples >= fewest], len(time_s)))
        estimates: list[Estimate] = []
        for stop in stops:
            estimates.append(known._estimate(whole.first(stop), start, starts_at_rest(record), *estimates[-1:]))
        return EstimateTrace.of(time_s[stops - 1], estimates)

    def _estimate(self, record: Record, start: Start, rested: bool, previous: Estimate | None = None) -> Estimate:
        problem = self._problem(record)
        if "q_mobile" in self.parameters:
            starts = self._best_starts(problem, [] if previous is None else [previous.q_mobile])
        else:
            problem = self._until_empty(problem)
            starts = [self._starts(problem, [self.model.cell.q_mobile])[0].values]
        n = len(problem.time_s)
        noise_V = self._noise_V(problem, starts)
        weight_V = hypot(noise_V or 0.0, sqrt(n) * self.mismatch_V)
        priors = tuple(_Prior(name, 0.0, weight_V / sd) for name, sd in self.nuisance.items())
        alone = fit = self._search(problem, starts, priors)
        noise_V2 = noise_V**2 if noise_V else _square(alone.residual_V) / (n - len(self.parameters))
        variance_V2 = noise_V2 + n * self.mismatch_V**2
        if self.prior_q_mobile_C is not None:
            mean_C, sd_C = self.prior_q_mobile_C
            (middle,) = self._starts(problem, [mean_C])
            carried = _Prior("q_mobile", mean_C, sqrt(variance_V2) / sd_C)
            fit = self._search(problem, [*starts, alone.values, middle.values], (*priors, carried))
        gaps = self._gaps(record, problem, fit)
        hidden = self._hidden_sd(problem, fit)
        sd = self._sd(fit, variance_V2, hidden, gaps)
        if len(problem.time_s) < len(record.time_s):
            reason = EMPTY
        else:
            reason = (
                start.reason
                or self._contradiction(record, problem, fit, rested, gaps)
                or self._shortage(problem, fit, alone, variance_V2, hidden, gaps)
            )
        return Estimate(fit.values["q_mobile"], fit.values["r_o"], sd["q_mobile"], sd["r_o"], not reason, reason)

    def _noise_V(self, problem: _Problem, starts: Sequence[dict[str, float]]) -> float | None:
        """The noise that is stated or, where priors of constants are weighed against it, the white part of residuals."""
        if self.voltage_noise_V is not None or not self.nuisance:
            return self.voltage_noise_V
        residual_V, _ = self._residual(problem, dict.fromkeys(self.nuisance, 0.0) | starts[0], ())
        return max(white_noise_V(residual_V), _LEAST_NOISE_V)

    def _sd(self, fit: _Fit, variance_V2: float, hidden: Mapping[str, float], gaps: Sequence[Gap] = ()) -> dict[str, float]:
        """The standard deviations, with those of what does not show in the voltage, and with charges that nobody saw."""
        sd = dict.fromkeys(PARAMETER_NAMES, nan)
        for name, root in zip(self.parameters, _root_inverse_diagonal(fit.jacobian), strict=False):
            sd[name] = hypot(sqrt(variance_V2) * float(root), hidden[name])
        sd["q_mobile"] = hypot(sd["q_mobile"], sum(gap.charge_C for gap in gaps if gap.verdict != DRAWN))
        return sd

    def _gaps(self, record: Record, problem: _Problem, fit: _Fit) -> list[Gap]:
        """Where the record was not written under load, and what its voltage says of that."""
        model_V = problem.voltage_V + fit.residual_V - fit.values.get("offset_V", 0.0)
        current_A = np.asarray(record.current_A)[: len(problem.time_s)]
        clock_s = np.asarray(record.time_s)[: len(problem.time_s)]
        return find_gaps(clock_s, problem.voltage_V, current_A, model_V, fit.values["q_mobile"])

    def _hidden_sd(self, problem: _Problem, fit: _Fit) -> dict[str, float]:
        """
        The standard deviations of what does not show in the voltage: the gain of the current sensor, which scales both
        parameters, and the charge at the start, which the fit makes up for.
        """
        (soc, sd_soc), values = self.initial_soc, fit.values
        by_soc = np.zeros(len(self.parameters) + len(self.nuisance))
        if sd_soc:
            step, nearby = _SOC_STEP if soc < 0.5 else -_SOC_STEP, copy(self)
            own = self.model
            nearby._model_at_start = RecordModel(own.cell, own.thermal, own.dt_s, initial_soc=soc + step)
            moved = dict(values)
            if "q_mobile" in self.parameters:  # along with it, so that the cell ends as full as before
                moved["q_mobile"] *= soc / (soc + step)
                by_soc[self.parameters.index("q_mobile")] = (moved["q_mobile"] - values["q_mobile"]) / step
            change_V = (nearby._residual(problem, moved, ())[0] - self._residual(problem, values, ())[0]) / step
            rows = np.nan_to_num(np.append(change_V, np.zeros(len(fit.jacobian) - len(change_V))))
            by_soc -= np.linalg.lstsq(fit.jacobian, rows, rcond=None)[0]
        return {
            name: hypot(self.current_gain_sd * values[name], sd_soc * float(by_soc[n]))
            for n, name in enumerate(self.parameters)
        }

    def _contradiction(self, record: Record, problem: _Problem, fit: _Fit, rested: bool, gaps: Sequence[Gap]) -> str:
        """What in the record contradicts the fit."""
        cell, n = self.model.cell, len(problem.time_s)
        if self.voltage_noise_V is None:
            noise_V, excess = white_noise_V(fit.residual_V), EXCESS_LIMIT_UNSTATED / sqrt(n)
        else:
            noise_V, excess = self.voltage_noise_V, _EXCESS_LIMIT * sqrt(2.0 / n)
        limit_V2 = noise_V**2 * (1.0 + excess) + (MISMATCH_MARGIN * self.mismatch_V) ** 2 + _NEGLIGIBLE_V**2
        samples = Samples.of(record)
        resistance_ohm, start = least_resistance_ohm(fit.values["q_mobile"], fit.values["r_o"]), ""
        if self._at_rest:
            start = start_reason(*samples, cell, self.initial_soc[0], resistance_ohm, rested)
        not_drawn, sensors = gap_reason(gaps, NOT_DRAWN), sensor_reason(*samples, resistance_ohm)
        return first_reason(
            [
                (bool(start), start),
                (bool(not_drawn), not_drawn),
                *((True, AT_BOUND.format(name)) for name in fit.at_bound),
                ("q_mobile" in self.parameters and not is_plausible(fit.values["q_mobile"], cell), IMPLAUSIBLE),
                (_square(fit.residual_V) > n * limit_V2, MISFIT),
                (bool(sensors), sensors),
            ]
        ) or self._end_reason(record, fit, max(2.0 * self.mismatch_V, 3.0 * noise_V, _NEGLIGIBLE_V))

    def _end_reason(self, record: Record, fit: _Fit, deviation_V: float) -> str:
        """Whether the model comes as low as the record did much earlier or later than the record."""
        time_s, voltage_V, current_A = Samples.of(record)
        n = int(voltage_V.argmin())
        load_A = float(current_A[max(n - 1, 0) : n + 1].max())
        # at rest, with whatever current a sensor shows then, no voltage is reached
        if n == 0 or load_A * LONGEST_FORECAST_S <= fit.values["q_mobile"]:
            return ""
        until = Samples(time_s, voltage_V, current_A).first(n + 1)
        estimate = Estimate(fit.values["q_mobile"], fit.values["r_o"])
        model, lowest_V = self._model(fit.values), float(voltage_V[n]) - fit.values.get("offset_V", 0.0)
        early_s, late_s = (
            model.forecast(until, estimate, lowest_V + sign * deviation_V, load_A).eod_time_s for sign in (1.0, -1.0)
        )
        allowed_s = _END_SHARE * (time_s[n] - time_s[0]) + 2.0 * self.model.dt_s
        if early_s - allowed_s <= time_s[n] <= late_s + allowed_s:
            return ""
        return (
            f"The record falls to {voltage_V[n]:.2f} V at {time_s[n]:.0f} s, where this estimate says "
            f"{early_s if early_s > time_s[n] else late_s:.0f} s."
        )

    def _shortage(
        self,
        problem: _Problem,
        fit: _Fit,
        alone: _Fit,
        variance_V2: float,
        hidden: Mapping[str, float],
        gaps: Sequence[Gap],
    ) -> str:
        """Why the record alone does not determine the parameters; ``alone``: the fit without the prior."""
        own, unsure = self._sd(alone, variance_V2, hidden, gaps), gap_reason(gaps, UNSURE)
        unknown = [name for name in self.parameters if not own[name] < SETTLED_SHARES[name] * alone.values[name]]
        carried = self.prior_q_mobile_C is not None
        imprecise = dict(IMPRECISE)
        if "q_mobile" in unknown:
            imprecise["q_mobile"] = self._imprecise_q_mobile(problem, alone, variance_V2, own["q_mobile"], hidden)
        return first_reason(
            [
                (fit.square_V2 - alone.square_V2 > PRIOR_LIMIT_SD**2 * variance_V2, PRIOR_CONTRADICTED.format("q_mobile")),
                (bool(unsure) and "q_mobile" in unknown, unsure),
                (carried and "q_mobile" in unknown, f"{PRIOR_ALONE.format('q_mobile')} Without it {imprecise['q_mobile']}"),
                *((hidden[name] >= SETTLED_SHARES[name] * fit.values[name], SCALE_UNKNOWN.format(name)) for name in unknown),
                *((True, imprecise[name]) for name in unknown),
                (self.voltage_noise_V is None and len(fit.residual_V) < len(self.parameters) + SPARE_SAMPLES, _FEW),
            ]
        )

    def _imprecise_q_mobile(
        self, problem: _Problem, fit: _Fit, variance_V2: float, sd_C: float, hidden: Mapping[str, float]
    ) -> str:
        """What limits ``q_mobile``, and what would help, by the same formula as its standard deviation."""
        n, q_C, hidden_C = len(problem.time_s), fit.values["q_mobile"], hidden["q_mobile"]
        if not np.isfinite(sd_C):
            return IMPRECISE["q_mobile"]
        noise_V2, target_C2 = variance_V2 - n * self.mismatch_V**2, (SETTLED_SHARES["q_mobile"] * q_C) ** 2 - hidden_C**2
        enough_V2 = (target_C2 * variance_V2 / (sd_C**2 - hidden_C**2) - noise_V2) / n
        # the priors of nuisance constants are weighed against the mismatch as well
        enough_V = nan if self.nuisance or enough_V2 <= 0.0 else sqrt(enough_V2)
        return imprecise_text(
            sd_C / q_C,
            self._depth_V(problem, fit, noise_V2, target_C2),
            enough_V if self.mismatch_V else None,
            sqrt(_square(fit.residual_V) / n),
        )

    def _depth_V(self, problem: _Problem, fit: _Fit, noise_V2: float, target_C2: float) -> float:
        """
        The voltage down to which the record has to go on, with the load of its last half again and again, to tell ``q_mobile``
        with a variance of ``target_C2``, if the cell is the one of the fit; -inf if it is empty before, NaN without a load.
        """
        n, seen, q_C, dt_s = len(problem.time_s), len(problem.current_A), fit.values["q_mobile"], self.model.dt_s
        load_A = problem.current_A[(seen - 1) // 2 : -1]
        if load_A.mean() * LONGEST_FORECAST_S <= q_C:
            return nan
        current_A = np.append(problem.current_A[:-1], np.resize(load_A, int(q_C / (load_A.mean() * dt_s)) + len(load_A)))
        grid_s = dt_s * np.arange(len(current_A), dtype=np.float64)
        longer = problem._replace(time_s=grid_s, voltage_V=np.zeros(len(grid_s)), current_A=current_A, on_grid=True)
        voltage_V, jacobian = (rows[seen:] for rows in self._residual(longer, fit.values, ()))
        steps = int(np.count_nonzero(~np.isnan(voltage_V)))
        stride = max(steps // _DEPTHS, 1)
        blocks = steps // stride
        in_block = jacobian[: blocks * stride].reshape(blocks, stride, jacobian.shape[1])
        # samples follow each other as they did
        share = n / seen
        information = share * np.cumsum(np.einsum("bsi,bsj->bij", in_block, in_block), axis=0)
        covariance = np.linalg.inv(fit.jacobian.T @ fit.jacobian + information)
        variance_V2 = noise_V2 + (n + share * stride * np.arange(1, blocks + 1)) * self.mismatch_V**2
        k = self.parameters.index("q_mobile")
        told = np.flatnonzero(variance_V2 * covariance[:, k, k] < target_C2)
        return float(voltage_V[: (told[0] + 1) * stride].min() - fit.residual_V[-1]) if len(told) else -inf

    def _problem(self, record: Record) -> _Problem:
        clock_s, voltage_V, measured_A = check_record(record, least_samples=len(self.parameters) + 1)
        time_s, current_A = self.model.grid(record)
        if not current_A[:-1].any():
            raise ValueError("no current flows in this record: it says nothing about q_mobile and r_o")
        check_drawn_charge(float(drawn(clock_s, measured_A, clock_s[-1])))
        grid_s = self.model.dt_s * np.arange(len(current_A))
        on_grid = len(grid_s) == len(time_s) and np.allclose(time_s, grid_s, rtol=0.0, atol=1e-6 * self.model.dt_s)
        return _Problem(time_s, voltage_V, current_A, on_grid, self.model.least_q_mobile_C(current_A))

    def _until_empty(self, problem: _Problem) -> _Problem:
        """The samples that a cell of the held ``q_mobile`` lives to see, whatever its ``r_o``."""
        q_mobile = self.model.cell.q_mobile
        n = len(self.model.simulate(problem.current_A, q_mobile, 0.0).time_s)
        seen = problem.time_s <= (n - 1) * self.model.dt_s
        if seen.sum() <= len(self.parameters):
            raise ValueError(
                f"a cell with q_mobile = {q_mobile:g} C is empty at the start of this record, which takes at least "
                f"{problem.least_q_C:g} C. Search for q_mobile too, or hold it at another value."
            )
        return problem._replace(
            time_s=problem.time_s[seen], voltage_V=problem.voltage_V[seen], current_A=problem.current_A[:n], least_q_C=0.0
        )

    def _q_bounds_C(self, problem: _Problem) -> tuple[float, float]:
        low_C, high_C = self.bounds["q_mobile"]
        return max(low_C, problem.least_q_C * (1.0 + _MARGIN)), high_C

    def _starts(self, problem: _Problem, q_candidates: Sequence[float]) -> list[_Start]:
        """
        Values of ``q_mobile`` within their bounds, each with the ``r_o`` that goes best with it (the voltage is linear in it
        but for its small effect on the temperature), and how far from the record they are, all on a coarse grid of time.
        """
        # the largest step for which no voltage drop of explicit Euler oscillates
        cell = self.model.cell
        stride = max(int(min(cell.to, cell.tsn, cell.tsp) / self.model.dt_s), 1)
        if len(problem.current_A) < _COARSE_POINTS * stride:
            stride = 1
        points = len(problem.current_A) // stride
        current_A = problem.current_A[: points * stride].reshape(points, stride).mean(axis=1)
        voltage_V = np.interp(stride * self.model.dt_s * np.arange(points), problem.time_s, problem.voltage_V)
        starts = []
        for candidate in q_candidates:
            q_mobile, r_o = candidate, self.model.cell.r_o
            if "q_mobile" in self.parameters:
                low_C, high_C = self._q_bounds_C(problem)
                q_mobile = min(max(q_mobile, low_C), high_C)
            model_V, _, by_r_o_A = self.model.sensitivities(current_A, q_mobile, r_o, stride)
            residual_V = model_V - voltage_V
            if "r_o" in self.parameters:
                low_ohm, high_ohm = self.bounds["r_o"]
                best_ohm = min(max(r_o - float(residual_V @ by_r_o_A) / _square(by_r_o_A), low_ohm), high_ohm)
                residual_V += (best_ohm - r_o) * by_r_o_A
                r_o = best_ohm
            square_V2 = _square(residual_V)
            # on the coarse grid a cell may be empty a little too early
            starts.append(_Start({"q_mobile": q_mobile, "r_o": r_o}, inf if isnan(square_V2) else square_V2))
        return starts

    def _best_starts(self, problem: _Problem, more_q_C: Sequence[float]) -> list[dict[str, float]]:
        """The local minima on a grid of ``q_mobile``, refined where it is promising, that may lead to the global one."""
        excess = _START_EXCESS
        starts = self._starts(problem, (problem.least_q_C * (1.0 + excess)).tolist())
        promising = _is_near_best(starts)
        left = np.flatnonzero(promising[:-1] | promising[1:])
        finer = excess[left, None] * (excess[left + 1] / excess[left])[:, None] ** (np.arange(1, _FINER) / _FINER)
        starts += self._starts(problem, [*(problem.least_q_C * (1.0 + finer.ravel())).tolist(), *more_q_C])
        starts.sort(key=lambda start: start.values["q_mobile"])
        squares_V2 = np.pad([start.square_V2 for start in starts], 1, constant_values=np.inf)
        minima = (squares_V2[1:-1] <= squares_V2[:-2]) & (squares_V2[1:-1] < squares_V2[2:]) & _is_near_best(starts)
        return [starts[n].values for n in np.union1d(np.flatnonzero(minima), squares_V2[1:-1].argmin())]

    def _search(self, problem: _Problem, starts: Sequence[dict[str, float]], priors: Sequence[_Prior]) -> _Fit:
        """The best fit that is found from any of the starts."""
        bounds = self.bounds | {"q_mobile": self._q_bounds_C(problem)}
        if "q_mobile" in self.parameters and not bounds["q_mobile"][0] < bounds["q_mobile"][1]:
            raise ValueError(
                "this record takes a q_mobile of at least {:g} C, which is beyond the upper bound, {:g} C. Raise "
                "q_mobile_bounds_C (command line: --cell, with a fit of such a cell), or check that time is in s and current "
                "in A.".format(*bounds["q_mobile"])
            )
        return min((self._fit(problem, start, bounds, priors) for start in starts), key=lambda fit: fit.square_V2)

    def _fit(
        self, problem: _Problem, start: dict[str, float], bounds: dict[str, tuple[float, float]], priors: Sequence[_Prior]
    ) -> _Fit:
        free, values = [*self.parameters, *self.nuisance], dict.fromkeys(self.nuisance, 0.0) | start
        while True:
            values = self._minimize(problem, values, free, priors)
            clipped = {name: min(max(values[name], bounds[name][0]), bounds[name][1]) for name in free if name in bounds}
            inside = [name for name in free if name not in bounds or clipped[name] == values[name]]
            values = values | clipped
            if len(inside) in (0, len(free)):
                break
            free = inside
        residual_V, jacobian = self._residual(problem, values, priors)
        at_bound = tuple(name for name in self.parameters if values[name] in bounds[name])
        return _Fit(values, jacobian, residual_V[: len(problem.time_s)], _square(residual_V), at_bound)

    def _minimize(
        self, problem: _Problem, start: dict[str, float], free: list[str], priors: Sequence[_Prior]
    ) -> dict[str, float]:
        unknown = [*self.parameters, *self.nuisance]
        columns = [unknown.index(name) for name in free]

        def values_at(x: Iterable[float]) -> tuple[dict[str, float], float, float]:
            values = start | {name: float(value) for name, value in zip(free, x, strict=True)}
            least_C, least_by_log_C = self._least_q_C(problem, values)
            if "q_mobile" in free:
                values["q_mobile"] = least_C + float(np.exp(min(values["q_mobile"], _LOG_LIMIT)))
            return values, least_C, least_by_log_C

        @lru_cache(maxsize=1)
        def evaluated(x: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
            values, least_C, least_by_log_C = values_at(x)
            residual_V, by_parameter = self._residual(problem, values, priors)
            slopes = [values[name] - least_C if name == "q_mobile" else 1.0 for name in free]
            by_x = by_parameter[:, columns] * slopes
            if "q_mobile" in free and "tDiffusion" in free:  # which moves q_mobile along with its least value
                by_x[:, free.index("tDiffusion")] += least_by_log_C * by_parameter[:, unknown.index("q_mobile")]
            return residual_V, by_x

        # scipy asks for them one after the other; one roll-out gives both
        def residual(x: FloatArray) -> FloatArray:
            return evaluated(tuple(x))[0]

        def jacobian(x: FloatArray) -> FloatArray:
            return evaluated(tuple(x))[1]

        least_C, _ = self._least_q_C(problem, start)
        result = least_squares(
            residual,
            [np.log(start[name] - least_C) if name == "q_mobile" else start[name] for name in free],
            jac=jacobian,
            method="lm",
            x_scale=[(_SEARCH_SCALES | self.nuisance)[name] for name in free],
            gtol=1e-10,
        )
        return values_at(result.x)[0]

    def _model(self, values: Mapping[str, float]) -> RecordModel:
        """The model with the nuisance constants at some values."""
        constants = self._constants(values)
        if not constants:
            return self.model
        return self.model.of_cell(self.model.cell.replace(**constants))

    def _constants(self, values: Mapping[str, float]) -> dict[str, float]:
        constants = {}
        for name in self.nuisance.keys() & set(RATE_CONSTANTS):
            # a step of the search may go far, but explicit Euler is stable only for rates below 2 / dt
            constant = getattr(self.model.cell, name) * float(np.exp(max(min(values[name], _REACH), -_REACH)))
            constants[name] = max(constant, self._least_stable(name))
        return constants

    def _least_stable(self, name: str) -> float:
        cell, dt_s = self.model.cell, self.model.dt_s
        if name == "tDiffusion":
            rates = cell.packed.constants[0, [BULK_RATE, SURFACE_RATE]]
            return float(0.5 * cell.tDiffusion * dt_s * rates.sum())
        return 0.5 * dt_s if name in ("to", "tsn", "tsp") else 0.0

    def _least_q_C(self, problem: _Problem, values: Mapping[str, float]) -> tuple[float, float]:
        """The least q_mobile that the record allows, and its derivative by the logarithm of ``tDiffusion``."""
        if "tDiffusion" not in self.nuisance:
            return problem.least_q_C, 0.0
        return self._model(values).least_q_mobile_tangent_C(problem.current_A)

    def _residual(
        self, problem: _Problem, values: dict[str, float], priors: Sequence[_Prior]
    ) -> tuple[FloatArray, FloatArray]:
        """The residuals at the samples, V, and one more for each prior; and their derivatives by all that is unknown."""
        q_mobile, r_o = values["q_mobile"], values["r_o"]
        if self.nuisance:
            model_V, slopes, _ = self._model(values).tangents(problem.current_A, q_mobile, r_o)
            by_unknown = dict(zip(TANGENT_NAMES, slopes, strict=True)) | {"offset_V": np.ones(len(model_V))}
            model_V = model_V + values.get("offset_V", 0.0)
        else:
            model_V, *both = self.model.sensitivities(problem.current_A, q_mobile, r_o)
            by_unknown = dict(zip(PARAMETER_NAMES, both, strict=True))
        unknown = (*self.parameters, *self.nuisance)
        columns = [model_V, *(by_unknown[name] for name in unknown)]
        if not problem.on_grid:
            grid_s = self.model.dt_s * np.arange(len(model_V))
            columns = [np.interp(problem.time_s, grid_s, column) for column in columns]
        residual_V, jacobian = columns[0] - problem.voltage_V, np.column_stack(columns[1:])
        for prior in priors:
            row = [prior.weight_V if name == prior.name else 0.0 for name in unknown]
            residual_V = np.append(residual_V, prior.weight_V * (values[prior.name] - prior.mean))
            jacobian = np.vstack([jacobian, row])
        return residual_V, jacobian


def _check_nuisance(nuisance: Mapping[str, float], parameters: tuple[str, ...]) -> dict[str, float]:
    if not isinstance(nuisance, Mapping):
        raise TypeError(f"nuisance must hold standard deviations by name, got {nuisance!r}")
    for name, sd in nuisance.items():
        if name not in (*RATE_CONSTANTS, "offset_V"):
            raise ValueError(f"nuisance constants are {', '.join(RATE_CONSTANTS)} and offset_V, got {name!r}")
        check_positive(f"nuisance {name}", sd)
    if "tDiffusion" in nuisance and "q_mobile" not in parameters:
        raise ValueError("tDiffusion can be a nuisance only beside q_mobile: without it the model cell may be empty too early")
    return dict(nuisance)


def _is_near_best(starts: Sequence[_Start]) -> BoolArray:
    squares_V2 = np.array([start.square_V2 for start in starts])
    return squares_V2 <= _RIVAL_RATIO * squares_V2.min()


def _square(array: FloatArray) -> float:
    return float(array @ array)


def _root_inverse_diagonal(jacobian: FloatArray) -> FloatArray:
    """The roots of the diagonal of (J^T J)^-1; infinite where the data do not determine the parameters."""
    try:
        return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    except np.linalg.LinAlgError:
        return np.full(jacobian.shape[1], np.inf)
