"""Calibration by least squares on the voltage of a whole record: what learning has to compete with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray
from battery_env.checks import check_gain_sd, check_not_negative, check_positive
from battery_env.electrochemistry import CellParameters
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimates.findings import Reason
from battery_env.estimators.diagnosis.evidence import Evidence, evidence_of
from battery_env.estimators.diagnosis.faults import MOST_NOISE_SD
from battery_env.estimators.diagnosis.knee import knee_sd_C
from battery_env.estimators.diagnosis.rest import InitialSoc, check_initial_soc
from battery_env.estimators.estimator import Estimator, check_bounds
from battery_env.estimators.priors import CellPrior, PathPrior
from battery_env.estimators.resistance import PULSE_S, ModelResistance, later_step, load_on
from battery_env.estimators.search import (
    Fit,
    Prior,
    Search,
    SizePrior,
    square,
    standard_deviations,
)
from battery_env.estimators.verdict import (
    PRIOR_LIMIT_SD,
    RESISTANCE_LIMIT_SD,
    SPARE_SAMPLES,
    Assumptions,
    Diagnosis,
    Verdict,
    is_plausible,
    misfit_limit_V2,
    white_noise_V,
)
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, R_O, check_parameters
from battery_env.records import (
    STEADY_S,
    ChargeHistory,
    DischargeStart,
    Record,
    Samples,
    check_record,
    history_of,
)
from battery_env.records.model import RecordModel

# Least noise that is estimated from residuals, V: a voltmeter's resolution. No estimate of the bundled cells depends on it.
_LEAST_NOISE_V = 1e-4
# Step of the state of charge for a derivative. Twice as much changes standard deviations of the bundled cells by 0.1 %.
_SOC_STEP = 1e-3


class Alternative(NamedTuple):
    """A cell that a record leaves open: its model, ``q_mobile``, C, and ``r_o``, ohm."""

    model: RecordModel
    q_mobile: float
    r_o: float


@dataclass(frozen=True)
class RecordFit:
    """The fit of a record by :meth:`LeastSquares.fit`, with all that its standard deviations are made of."""

    record: Samples
    history: ChargeHistory
    search: Search
    fit: Fit  # with all priors
    without_prior: Fit  # of q_mobile
    variance: float  # of one weighed residual
    hidden_sd: Mapping[str, float]  # uncertainty that the voltage cannot reveal, by parameter
    evidence: Evidence  # of the samples

    def sd(self, fit: Fit, ratios: Mapping[str, float]) -> dict[str, float]:
        """The standard deviations of a fit, times some ratios, with the uncertainty that the voltage cannot reveal."""
        sd = dict.fromkeys(PARAMETER_NAMES, nan)
        for name, root in zip(self.search.parameters, standard_deviations(fit.jacobian), strict=False):
            ratio = ratios.get(name, 1.0) * (fit.spread if name == "q_mobile" else 1.0)
            knee_sd_C = fit.knee_sd_C if name == "q_mobile" else 0.0
            sd[name] = hypot(ratio * sqrt(self.variance) * float(root), self.hidden_sd[name], knee_sd_C)
        return sd

    def alternatives(self) -> list[Alternative]:
        """
        The cell that fits best; and those a standard deviation to each side, in each direction in which all unknowns are open.
        """
        fit, names = self.fit, self.search.unknown
        roots = np.linalg.cholesky(self.variance * np.linalg.pinv(fit.jacobian.T @ fit.jacobian, hermitian=True)).T
        cells = [fit.values]
        cells += [
            fit.values | {n: fit.values[n] + float(move) for n, move in zip(names, row, strict=True)}
            for row in (*roots, *-roots)
        ]
        (least_C, most_C), (least_ohm, most_ohm) = Q_MOBILE.limits, R_O.limits
        return [
            Alternative(
                self.search.model_at(at), min(max(at["q_mobile"], least_C), most_C), min(max(at["r_o"], least_ohm), most_ohm)
            )
            for at in cells
        ]


class _Resistance(NamedTuple):
    """The resistance after ten seconds, its standard deviation, and the share of the unknown moment of load-on in it, ohm."""

    ohm: float = nan
    sd_ohm: float = nan
    load_on_ohm: float = 0.0


class LeastSquares(Estimator):
    """
    The (q_mobile, r_o) whose simulated voltage is closest to the recorded voltage, over all samples of the record.

    The defaults are for simulated records. For recorded cells use :func:`battery_env.calibrate`, or
    ``battery_env.Settings().calibrator()``, with a model of the temperature and the expected errors of model and sensor.

    The model starts at the first sample of the record, fully charged and at rest (or with ``initial_soc`` or ``initial``), and
    follows the recorded current (:func:`battery_env.records.resample_current`). For a recorded discharge pass
    :meth:`battery_env.Discharge.loaded_part`, which starts when the load is switched on.

    *Search.* At a fixed current the charges of the model are linear in ``q_mobile``. Therefore one simulation gives exactly
    the value below which the model cell would be empty before the end of the record. The search is over the logarithm of the
    distance to this value, because the knee of a discharge is nearly straight in it. The method is Levenberg-Marquardt
    (MINPACK) with exact derivatives, from the best of several starts on a coarse time grid. Parameters stay within bounds.

    *Standard deviations* follow from one likelihood (:mod:`~battery_env.estimators.error`). With ``mismatch_V`` of 0 the
    residuals are white, as in simulated records with noise. The residuals of a real cell are the model's error, and a fit of
    half a discharge hides this error in the parameters. Therefore an error of twice ``mismatch_V`` drifts along the charge
    drawn, in addition to white noise. More samples do not average the drift out. The standard deviation of ``q_mobile`` has
    the width of the likelihood, not of its curvature: at the start of a knee a much larger ``q_mobile`` is hardly less likely.

    *Nuisance constants* are not known exactly. The fit estimates these constants together with the parameters, each under a
    prior, and also an offset of the voltage sensor. Slow diffusion looks like a smaller ``q_mobile``, and slow kinetics like a
    larger ``r_o``: the standard deviations contain all that the record does not separate.

    *Settled* (:class:`~battery_env.Estimate`) means that the record alone determines every parameter searched for, with a
    standard deviation below :data:`~battery_env.estimates.findings.SETTLED_SHARES` of its value without any prior, and that
    nothing contradicts the estimate: the start, gaps and steps of the voltage, the fit, bounds, and a prior. An estimate that
    depends on a prior is not settled, because it is only as good as the prior.

    *During a discharge*, :meth:`trace` with ``window_every_s`` repeats the estimate from all samples so far. Before the knee a
    discharge says little about ``q_mobile``: pass (mean, standard deviation) of an earlier discharge as ``prior_q_mobile_C``,
    which enters as one more residual.

    :param parameters: the parameters to search for; the other is held at the value of ``cell``
    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model changes
    :param dt_s: time step of the model, s; the time step of simulated records reproduces these records exactly
    :param initial: state of the model at the first sample, shape (8,), e.g. from a simulation. It stands for a history
        of the current: its charges change in proportion to ``q_mobile``. ``None``: at rest, with ``initial_soc``
    :param q_mobile_bounds_C: bounds of the search, C; the lower bound is raised to the least value that the record allows
    :param r_o_bounds_ohm: bounds of the search, ohm
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before this record, C; ``None``: no prior
    :param size: usual ``q_mobile`` of cells of this size, new or aged: a weak prior, on which no settled estimate depends;
        ``None``: all sizes are equally likely
    :param mismatch_V: expected error of the model, V, as above
    :param voltage_noise_V: standard deviation of the noise of the voltage sensor, V; ``None``: estimated from the record
    :param window_every_s: time between the estimates of :meth:`trace`, s; ``None``: one estimate, at the end
    :param current_gain_sd: relative standard deviation of the gain of the current sensor; the voltage does not show the gain
    :param nuisance: other unknowns: standard deviations of the logarithms of constants, by name, e.g.
        ``{"kn": 0.2, "tDiffusion": 0.2}`` for two constants known to 20 %; and of the offset of the sensor in V, as
        ``"offset_V"``
    :param initial_soc: state of charge at the first sample, after a rest: a number, or (mean, standard deviation), which adds
        to the parameters' own. :func:`battery_env.soc_from_rest` computes it from the voltage of the rest before the load
    :param path: path of aging cells of this kind (:func:`battery_env.fit_life`): constants, ``q_mobile`` and ``r_o`` that go
        together before the record is known. The path gives the defaults of ``cell`` and ``mismatch_V``
    :param usual_start: how other discharges of the cell start, to compare the record with; ``None``: a full cell of the model
        at rest
    :raises ValueError: for an argument out of range
    """

    def __init__(
        self,
        parameters: Sequence[str] = PARAMETER_NAMES,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        initial: ArrayLike | None = None,
        q_mobile_bounds_C: tuple[float, float] = Q_MOBILE.limits,
        r_o_bounds_ohm: tuple[float, float] = R_O.limits,
        prior_q_mobile_C: tuple[float, float] | None = None,
        size: SizePrior | None = None,
        mismatch_V: float = 0.0,
        voltage_noise_V: float | None = None,
        window_every_s: float | None = None,
        current_gain_sd: float = 0.0,
        nuisance: Mapping[str, float] | None = None,
        initial_soc: InitialSoc = 1.0,
        path: AgingPath | None = None,
        usual_start: DischargeStart | None = None,
    ) -> None:
        self.parameters, self.usual_start = check_parameters(parameters), usual_start
        sds = _check_nuisance({} if nuisance is None else nuisance, self.parameters)
        check_not_negative(mismatch_V=mismatch_V)
        if path is not None:
            if sds or self.parameters != PARAMETER_NAMES:
                raise ValueError("path is of both parameters and of all nuisances: leave parameters and nuisance out")
            cell, mismatch_V = cell or path.cell, mismatch_V or path.mismatch_V
        self.initial_soc = check_initial_soc(initial_soc)
        self.model = RecordModel(cell, thermal, dt_s, initial, self.initial_soc[0])
        self.prior = CellPrior(self.model.cell, mismatch_V, initial is None, sds, sd_ratio=1.0)
        if path is not None:
            self.prior = PathPrior.of(path, self.model.cell, mismatch_V, initial is None)
        self.bounds = check_bounds(q_mobile_bounds_C, r_o_bounds_ohm)
        if prior_q_mobile_C is not None:
            if "q_mobile" not in self.parameters:
                raise ValueError("prior_q_mobile_C needs 'q_mobile' among the parameters to search for")
            Q_MOBILE.check(prior_q_mobile_C[0])
            if not 0.0 < prior_q_mobile_C[1] < np.inf:
                raise ValueError(f"prior_q_mobile_C is (mean, sd) with sd > 0, got {prior_q_mobile_C!r}")
        if size is not None:
            check_positive("size.usual_C", size.usual_C)
        self.prior_q_mobile_C, self.size = prior_q_mobile_C, size
        self.current_gain_sd = check_gain_sd(current_gain_sd)
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
        return self.estimate_of(self.fit(record))

    @property
    def mismatch_V(self) -> float:
        """Expected error of the model, V, as a forecast takes it."""
        return self.prior.mismatch_V

    def fit(self, record: Record) -> RecordFit:
        """The search of :meth:`estimate`, which also says what other cells a record leaves open."""
        return self._fit(self._samples(record), self._history(record))

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
        available = self._samples(record)
        time_s = available.time_s
        counts = np.searchsorted(time_s, np.arange(time_s[0] + every_s, time_s[-1], every_s), side="right")
        # the current of a sample shows at the next one
        fewest = max(len(self.parameters), int((available.current_A != 0.0).argmax()) + 1) + 1
        stops = np.unique(np.append(counts[counts >= fewest], len(time_s)))
        estimates: list[Estimate] = []
        for stop in stops:
            previous = estimates[-1] if estimates else None
            estimates.append(self.estimate_of(self._fit(available.first(stop), self._history(record), previous)))
        return EstimateTrace.of(time_s[stops - 1], estimates)

    def _samples(self, record: Record) -> Samples:
        return check_record(record, least_samples=len(self.parameters) + 1)

    def _history(self, record: Record) -> ChargeHistory:
        # where another charge is stated, that before the load does not count
        history = history_of(record, self.usual_start)
        return history if self.initial_soc[0] == 1.0 else history._replace(charge=None)

    def estimate_of(self, fitted: RecordFit) -> Estimate:
        """The estimate of a record, from :meth:`fit`."""
        sd = fitted.sd(fitted.fit, dict.fromkeys(self.parameters, self.prior.sd_ratio))
        resistance = self._resistance(fitted, fitted.fit)
        values, verdict = fitted.fit.values, self._verdict(fitted)
        constants = {name: values[name] for name in self.prior.nuisance if name != "offset_V"} or None
        return Estimate(
            q_mobile=values["q_mobile"],
            r_o=values["r_o"],
            sd_q_mobile=sd["q_mobile"],
            sd_r_o=sd["r_o"],
            resistance_10s_ohm=resistance.ohm,
            sd_resistance_10s_ohm=resistance.sd_ohm,
            **verdict._asdict(),
            constants=constants,
        )

    def _fit(self, record: Samples, history: ChargeHistory, previous: Estimate | None = None) -> RecordFit:
        """The best fits with and without the prior, with all that their standard deviations are made of."""
        prior, noise_V, size = self.prior, self.voltage_noise_V or 0.0, self.size
        is_open = "q_mobile" in self.parameters
        search = Search.of(record, self.model, self.parameters, prior.nuisance, self.bounds)
        search = search if is_open else search.until_empty()
        starts = prior.starts(search, previous)
        at_start_V = search.residual(dict.fromkeys(prior.nuisance, 0.0) | starts[0])[0]
        if not noise_V and (prior.nuisance or prior.mismatch_V or size):  # what else is known is weighed against it
            noise_V = max(white_noise_V(at_start_V), _LEAST_NOISE_V)
        priors = prior.residuals()
        error = prior.error(record, history, starts[0]["q_mobile"], float(at_start_V[0]), noise_V)
        search = replace(search, error=error)
        if size is not None:
            priors.append(size)
            starts = [*starts, *search.starts([size.usual_C])[0]]
        fit = search.best(starts, priors)
        n = len(fit.residual_V)
        variance = 1.0 if noise_V else square(fit.residual_V) / (n - len(self.parameters))
        if is_open:
            # a model that is exact, or of cells of this kind, has no other knee
            knee_C = knee_sd_C(record, _model_V(record, fit), self.model.cell.VEOD) if error.drift_V else 0.0
            fit = replace(fit, spread=search.spread(fit, priors, variance), knee_sd_C=knee_C)
        # a settled estimate rests neither on a usual size nor on what goes together along a path
        loose = np.pad(np.diag([1.0 / sd for sd in prior.nuisance.values()]), ((0, 0), (len(self.parameters), 0)))
        without_prior = replace(fit, jacobian=np.vstack([fit.jacobian[:n], loose]))
        variance += prior.more_variance(record, fit, error, noise_V)
        if self.prior_q_mobile_C is not None:
            mean_C, sd_C = self.prior_q_mobile_C
            carried = Prior("q_mobile", mean_C, prior.sd_ratio * sqrt(variance) / sd_C)
            fit = search.best([without_prior.values, *search.starts([mean_C])[0]], [*priors, carried])
            fit = replace(fit, spread=search.spread(fit, [*priors, carried], variance))
        estimate, soc = [fit.values[name] for name in PARAMETER_NAMES], self.initial_soc[0] if prior.starts_at_rest else None
        evidence = evidence_of(record, self.model.cell, soc, estimate, history, _model_V(record, fit))
        hidden_sd = self._hidden_sd(search, fit, evidence.sd_charge_C)
        return RecordFit(record, history, search, fit, without_prior, variance, hidden_sd, evidence)

    def _hidden_sd(self, search: Search, fit: Fit, sd_charge_C: float) -> dict[str, float]:
        """
        The standard deviations that the voltage cannot reveal: of the gain of the current sensor, which scales both
        parameters, and of the charge at the start, which the fit compensates. A charge that was not measured counts as one at
        the start.
        """
        (soc, sd_soc), values, model = self.initial_soc, fit.values, self.model
        sd_soc = hypot(sd_soc, sd_charge_C / values["q_mobile"])
        by_soc = np.zeros(len(search.unknown))
        if sd_soc:
            step = _SOC_STEP if soc < 0.5 else -_SOC_STEP
            at, nearby = (
                replace(search, model=RecordModel(model.cell, model.thermal, model.dt_s, initial_soc=each))
                for each in (soc, soc + step)
            )
            at_V = fit.residual_V if self.prior.starts_at_rest else at.residual(values)[0]
            compensated = dict(values)
            if "q_mobile" in self.parameters:  # along with it, so that the cell ends as full as before
                compensated["q_mobile"] *= soc / (soc + step)
                by_soc[self.parameters.index("q_mobile")] = (compensated["q_mobile"] - values["q_mobile"]) / step
            change_V = (nearby.residual(compensated)[0] - at_V) / step
            weighed = search.error_at_samples.whitened(np.nan_to_num(change_V)[:, None])[:, 0]
            rows = np.append(weighed, np.zeros(len(fit.jacobian) - len(weighed)))
            by_soc -= np.linalg.lstsq(fit.jacobian, rows, rcond=None)[0]
        return {
            name: hypot(self.current_gain_sd * values[name], sd_soc * float(by_soc[n]))
            for n, name in enumerate(self.parameters)
        }

    def _resistance(self, fitted: RecordFit, fit: Fit) -> _Resistance:
        """The resistance after ten seconds of a fit; NaN where the record does not begin with a rest and a load that stays."""
        record, history = fitted.record, fitted.history
        step = load_on(record, history.at_rest) if self.prior.starts_at_rest and self.parameters == PARAMETER_NAMES else None
        if step is None or not step.stays:
            return _Resistance()
        resistance = ModelResistance.of(record, step, fitted.search, fit)
        load_on_ohm = resistance.per_s * history.load_on_C / step.size_A
        fit_ohm = self.prior.sd_ratio * sqrt(fitted.variance) * resistance.sd_ohm
        return _Resistance(resistance.ohm, hypot(fit_ohm, load_on_ohm, self.current_gain_sd * resistance.ohm), load_on_ohm)

    def _differing(self, fitted: RecordFit) -> dict[str, float]:
        """The measured and the modelled resistance of a step of the load, if they contradict each other; nothing else."""
        record, history = fitted.record, fitted.history
        # constants that are held, and may be wrong, explain a difference as well
        is_open = self.parameters == PARAMETER_NAMES and any(name in self.prior.nuisance for name in RATE_CONSTANTS)
        step = (load_on(record, history.at_rest) or later_step(record)) if is_open else None
        model_V, sd_unit = _model_V(record, fitted.without_prior), self.prior.sd_ratio * sqrt(fitted.variance)
        for after_s in (PULSE_S, STEADY_S):  # a difference that decays is seen at one of these times
            if step is None or not step.is_measured(record, after_s):
                continue
            measured_ohm = step.fall_ohm(record, record.time_s, record.voltage_V, after_s)
            model_ohm = step.fall_ohm(record, record.time_s, model_V, after_s)
            of_model = ModelResistance.of(record, step, fitted.search, fitted.without_prior, after_s)
            noise_ohm = MOST_NOISE_SD * sd_unit * fitted.search.error.noise_V / step.size_A
            # the number that is reported is that after ten seconds; from then on the error of the model drifts
            drift_ohm = sd_unit * fitted.search.error.drift_after_V(step.size_A * (after_s - PULSE_S)) / step.size_A
            sd_ohm = hypot(sd_unit * of_model.sd_ohm, drift_ohm)
            apart_ohm = abs(measured_ohm - model_ohm)
            # the measurement and the fit may have different moments of the switch
            if apart_ohm > 2.0 * of_model.moment_ohm + hypot(RESISTANCE_LIMIT_SD * sd_ohm, noise_ohm):
                measured = {"after_s": after_s, "step_s": step.on_s, "measured_ohm": measured_ohm, "model_ohm": model_ohm}
                return {**measured, "apart_sd": apart_ohm / sd_ohm}
        return {}

    def _verdict(self, fitted: RecordFit) -> Verdict:
        """Judge an estimate by all that contradicts it."""
        record, history = fitted.record, fitted.history
        fit, without_prior, evidence, (soc, sd_soc) = fitted.fit, fitted.without_prior, fitted.evidence, self.initial_soc
        diagnosis = Diagnosis(evidence, evidence.measured(soc, float(record.time_s[0]), history.charge))
        n, free, is_stated = len(fit.residual_V), self.parameters, self.voltage_noise_V is not None
        diagnosis.note(Reason.EMPTY, n < len(record.time_s))
        diagnosis.note(Reason.FEW, not is_stated and n < len(free) + SPARE_SAMPLES)
        noise_V = self.voltage_noise_V or white_noise_V(fit.residual_V)
        # the error along a path is the mismatch of its cells, and otherwise the drift
        drift_V = fitted.search.error.drift_V or self.prior.mismatch_V
        diagnosis.note(Reason.MISFIT, square(fit.residual_V) > n * misfit_limit_V2(noise_V, n, drift_V, is_stated))
        q_mobile = fit.values["q_mobile"]
        diagnosis.note(Reason.IMPLAUSIBLE, "q_mobile" in free and not is_plausible(q_mobile, self.model.cell.q_mobile))
        ratio = self.prior.distance_share(fit.values)
        diagnosis.note(Reason.OTHER_KIND, ratio > 1.0, what="distance from the path of aging cells", ratio=ratio)
        limit = (self.prior.sd_ratio * PRIOR_LIMIT_SD) ** 2 * fitted.variance
        mean_C, sd_C = self.prior_q_mobile_C or (nan, nan)
        sizes_C = {
            "record_Ah": without_prior.values["q_mobile"],
            "least_Ah": mean_C - PRIOR_LIMIT_SD * sd_C,
            "most_Ah": mean_C + PRIOR_LIMIT_SD * sd_C,
        }
        sizes_Ah = {name: size_C / 3600.0 for name, size_C in sizes_C.items()}
        diagnosis.note_about("q_mobile", Reason.PRIOR_WRONG, fit.square - without_prior.square > limit, **sizes_Ah)
        differing = self._differing(fitted)
        diagnosis.note(Reason.RESISTANCE_DIFFERS, bool(differing), **differing)
        for name in fit.at_bound:
            diagnosis.note_about(name, Reason.AT_BOUND)
        priors = [] if self.prior_q_mobile_C is None else ["q_mobile"]
        resistance = self._resistance(fitted, without_prior)
        assumptions = Assumptions(
            self.current_gain_sd,
            sd_soc / soc,
            knee_sd_C=without_prior.knee_sd_C,
            load_on_ohm=resistance.load_on_ohm,
            is_along_path=isinstance(self.prior, PathPrior),
        )
        # without the prior, at both optima; the larger one counts: before the knee the voltage says little of q_mobile
        at_prior_optimum = replace(without_prior, jacobian=np.vstack([fit.jacobian[:n], without_prior.jacobian[n:]]))
        ratios = {"q_mobile": self.prior.sd_ratio}
        sds_without_prior = [fitted.sd(each, ratios) for each in (without_prior, at_prior_optimum)]
        sds = {name: max(sd[name] for sd in sds_without_prior) for name in free}
        if not isnan(resistance.ohm):
            sds["resistance_10s"] = resistance.sd_ohm
        values = without_prior.values | {"resistance_10s": resistance.ohm}
        return diagnosis.verdict(values, sds, list(sds), priors, assumptions)


def _model_V(record: Samples, fit: Fit) -> FloatArray:
    """What the model of a fit gives at the samples of a record, NaN where it is empty."""
    model_V = np.full(len(record.time_s), nan)
    model_V[: len(fit.residual_V)] = record.voltage_V[: len(fit.residual_V)] + fit.residual_V
    return model_V


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
