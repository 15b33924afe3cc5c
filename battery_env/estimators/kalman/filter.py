"""Calibration during a discharge: an extended Kalman filter on voltage and current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from math import inf, isnan, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.checks import ZERO_CELSIUS_K, check_gain_sd, check_not_negative
from battery_env.compiled import compiled
from battery_env.electrochemistry import NEW_CELL, STATE_SIZE, CellParameters, PackedConstants, check_cell, check_dt
from battery_env.electrochemistry.ends import SURPLUS_SHARE
from battery_env.electrochemistry.tangents import PolynomialDerivatives
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.diagnosis import gaps
from battery_env.estimators.diagnosis.evidence import begin, belongs, examine, expect, measured, remember, take_in
from battery_env.estimators.diagnosis.rest import LEAST_ERROR_V, check_initial_soc
from battery_env.estimators.estimator import ModelNow, OnlineEstimator, check_bounds
from battery_env.estimators.kalman.bank import conclude, filters_of_prior, take
from battery_env.estimators.kalman.state import CELL, FILTER, SAMPLE, FilterSettings, Q, R
from battery_env.estimators.reasons import Reason
from battery_env.estimators.verdict import JUDGED, Assumptions, Verdict
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, R_O, check_parameters
from battery_env.records import ChargeBefore, DischargeStart, Record, Stream, check_drawn_charge, check_sample, history_of

#: How far cells of one nominal capacity may lie from it, new and worn: the standard deviation, as a share.
PRIOR_SD_SHARE_Q = 0.25
# Of a new 18650; a resistance goes with one over the size.
_PRIOR_SD_R_OHM = 0.15
_HOUR_S = 3600.0
# So far may the parameters wander in an hour, as a share of their prior means: a little keeps a filter awake.
_DRIFT_PER_HOUR = 0.001


class ExtendedKalmanFilter(OnlineEstimator):
    """
    Follows (q_mobile, r_o) along a discharge that starts with a cell at rest: one estimate a sample, with its standard
    deviation. The cell is fully charged unless ``initial_soc`` says otherwise.

    *State.* Given the current, the state of the model is a function of its two parameters; the charges are even linear in
    ``q_mobile``, with slope ``FULL_CHARGE_SHARES``. So the covariance of the augmented state (states and parameters) has the
    rank of the parameters from the start and keeps it: the filter carries the covariance of (q_mobile, r_o, offset) and the
    derivatives of the state with respect to them (:mod:`battery_env.electrochemistry.tangents`). When an estimate moves
    the state moves with it. A parameter not searched for has variance zero.

    *Curvature.* Each measurement is taken to second order in ``q_mobile`` (Gaussian second-order filter): where the voltage is
    curved over the spread of the estimate, at the knee above all, it counts for less.

    *Wide priors.* Over the middle of a discharge many values of ``q_mobile`` explain the voltage; a single filter that starts
    from a wide prior may take to a wrong one and claim to be sure. Such a prior is divided among several filters, each of them
    weighted with the likelihood of its innovations; estimate and standard deviation are those of the mixture. Filters that
    lost their weight or agree with the heaviest one are dropped. A prior of 8 % or less, carried over from an earlier
    discharge, takes one filter. Where no prior is given, larger cells are rare, not impossible: they have filters too, with as
    much less resistance.

    *Gate.* Innovations count in full up to 5 standard deviations, and beyond as if the noise had been larger (Huber's loss): a
    wild sample moves nothing far, and a filter that is wrong still finds back.

    *Noise.* Where the innovations of the last 30 or so samples show more noise than stated, that noise is used; the first ones
    count as stated.

    *Bounds.* Estimates stay within their bounds, and ``q_mobile`` above the least value that has the charge drawn so far: mole
    fractions never leave 0 .. 1. If ``q_mobile`` is held and too small for that, the estimate freezes and is not settled.

    *Standard deviations* count the error of the model as noise that is new with each sample. As it is not, that of
    ``q_mobile`` does not fall below what an error common to the whole discharge leaves open: before the knee what
    :class:`~battery_env.estimators.LeastSquares` state, and at the knee what an error of twice ``mismatch_V`` at every sample
    does, as a larger one would show. On whole discharges of the bundled cells that is about 1.2 % with ``mismatch_V=0.05``.
    That of ``r_o`` does not fall below ``mismatch_V`` over the current: an error that goes with the current is no offset,
    which a load that varies would tell.

    The gain of the current sensor scales both parameters and does not show in the voltage: state it as ``current_gain_sd``.

    *A stream.* :meth:`update` takes sample after sample, at any intervals. Between two samples the current of the first one
    flows; a cell at rest may be left alone for a week. A voltage that is missing (NaN) corrects nothing. Charge may flow back,
    as far as the cell has room for it: the model charges by the same equations. A measured temperature is that of the model
    then; the first one is also that of its surroundings.

    *Settled* is what :class:`~battery_env.estimators.LeastSquares` calls it. In place of the fit it is judged whether the
    innovations go the same way again and again, with twice ``mismatch_V`` allowed for.

    The defaults are those of simulated records. For recorded cells take :func:`battery_env.calibrate`, or
    ``battery_env.Settings(method="kalman").calibrator()``: a model of the temperature, and the errors of model and sensor to
    expect. Give it :meth:`battery_env.Discharge.loaded_part`, which starts when the load is switched on.

    :param parameters: which to search for; the other is held at ``cell``'s value
    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: longest time step of the model, s; that of simulated records if these are to be reproduced exactly
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before the discharge, C; ``None``: ``cell``'s value,
        and a quarter of it
    :param prior_r_o_ohm: likewise of ``r_o``, ohm; ``None``: ``cell``'s value, and 0.15 ohm for the charge of a
        new 18650, less for a larger cell
    :param q_mobile_bounds_C: where the estimate stays, C
    :param r_o_bounds_ohm: likewise, ohm
    :param voltage_noise_V: standard deviation of the noise of one voltage sample, V; ``None``: ``mismatch_V``, and at least
        0.005 V. A model that wanders by ``mismatch_V`` is not followed more closely from sample to sample
    :param offset_sd_V: standard deviation of a constant offset of sensor and model, V; ``None``: ``mismatch_V``, and at least
        0.005 V. With 0 errors are about half as large if there is no offset, and several percent if there is one of 10 mV
    :param mismatch_V: how far the error of the model itself wanders in an hour (standard deviation of a random walk), V
    :param current_gain_sd: standard deviation of the gain of the current sensor, as a share of it
    :param initial_soc: state of charge at the first sample, after a rest: a number, or (mean, standard deviation), which adds
        to that of ``q_mobile``
    :param cell_sd_r_o_ohm: what the constants leave open of ``r_o``: its standard deviation by theirs, ohm
    :param usual_start: how other discharges of the cell start, which :meth:`follow` compares records with; ``None``: as a full
        cell of the model rests
    :raises ValueError: for an argument out of range
    """

    def __init__(
        self,
        parameters: Sequence[str] = PARAMETER_NAMES,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        prior_q_mobile_C: tuple[float, float] | None = None,
        prior_r_o_ohm: tuple[float, float] | None = None,
        q_mobile_bounds_C: tuple[float, float] = Q_MOBILE.limits,
        r_o_bounds_ohm: tuple[float, float] = R_O.limits,
        voltage_noise_V: float | None = None,
        offset_sd_V: float | None = None,
        mismatch_V: float = 0.0,
        current_gain_sd: float = 0.0,
        initial_soc: float | tuple[float, float] = 1.0,
        cell_sd_r_o_ohm: float = 0.0,
        usual_start: DischargeStart | None = None,
    ) -> None:
        self.parameters = check_parameters(parameters)
        self.cell = check_cell(cell, thermal)
        self.thermal = thermal
        self.dt_s = check_dt(dt_s, self.cell)
        self.bounds = check_bounds(q_mobile_bounds_C, r_o_bounds_ohm)
        offset_sd_V = max(LEAST_ERROR_V, mismatch_V) if offset_sd_V is None else offset_sd_V
        check_not_negative(offset_sd_V=offset_sd_V, mismatch_V=mismatch_V, cell_sd_r_o_ohm=cell_sd_r_o_ohm)
        voltage_noise_V = _checked_noise_V(voltage_noise_V, mismatch_V)
        self.current_gain_sd = check_gain_sd(current_gain_sd)
        self.initial_soc = check_initial_soc(initial_soc)
        self.usual_start = usual_start
        q, q_sd = self._prior("q_mobile", prior_q_mobile_C, PRIOR_SD_SHARE_Q * self.cell.q_mobile)
        r_o, r_o_sd = self._prior("r_o", prior_r_o_ohm, _PRIOR_SD_R_OHM * NEW_CELL.q_mobile / self.cell.q_mobile)
        self._means, self._sds = (q, r_o), (q_sd, r_o_sd, float(offset_sd_V))
        soc, sd_soc = self.initial_soc
        self._settings = FilterSettings(
            dt_s=self.dt_s,
            thermal=thermal,
            noise_V2=float(voltage_noise_V) ** 2,
            mismatch_V2=float(mismatch_V) ** 2,
            searched=("q_mobile" in self.parameters, "r_o" in self.parameters),
            variance=(q_sd**2, r_o_sd**2),
            growth=(
                (_DRIFT_PER_HOUR * q) ** 2 / _HOUR_S if q_sd > 0.0 else 0.0,
                (_DRIFT_PER_HOUR * r_o) ** 2 / _HOUR_S if r_o_sd > 0.0 else 0.0,
            ),
            offset_growth=float(mismatch_V) ** 2 / _HOUR_S,
            bounds=(_pair(q_mobile_bounds_C), _pair(r_o_bounds_ohm)),
            carried=(_pair(prior_q_mobile_C or (0.0, 0.0)), _pair(prior_r_o_ohm or (0.0, 0.0))),
            cell_q_mobile=float(self.cell.q_mobile),
            known=Assumptions(float(self.current_gain_sd), float(sd_soc / soc), float(cell_sd_r_o_ohm)),
        )
        self._derivatives = PolynomialDerivatives.of(self.cell.packed)
        self._cell = np.zeros((), CELL)
        self._filters = np.zeros(len(self._start(self.cell)), FILTER)
        self.reset()

    def _prior(self, name: str, prior: tuple[float, float] | None, default_sd: float) -> tuple[float, float]:
        if name not in self.parameters:
            if prior is not None:
                raise ValueError(f"a prior of {name} needs {name!r} among the parameters to search for")
            return float(getattr(self.cell, name)), 0.0
        mean, sd = (getattr(self.cell, name), default_sd) if prior is None else prior
        low, high = self.bounds[name]
        if not (low <= mean <= high and 0.0 < sd < inf):
            raise ValueError(f"the prior of {name} is (mean within {low:g} .. {high:g}, sd above 0), got {prior!r}")
        return float(mean), float(sd)

    def _start(self, cell: CellParameters) -> NDArray[np.void]:
        is_size_known = self._settings.carried[Q] != (0.0, 0.0)
        return filters_of_prior(self._means, self._sds, self._settings.bounds[Q], cell, self.initial_soc[0], is_size_known)

    def reset(self) -> None:
        """Forget all samples: the next one is the first of a discharge, of a cell at rest with ``initial_soc``."""
        self._cell[...] = np.zeros((), CELL)
        bank = self._cell["bank"]
        bank["least_r"], bank["most_r"], bank["offset_V2"] = -inf, inf, self._sds[2] ** 2
        self._begin(self.cell.Tb0)

    def _begin(self, ambient_K: float) -> None:
        """Let the model start at this temperature, and in surroundings of it."""
        self._cell["ambient_K"] = ambient_K
        cell = self._cell_now()
        self._cell["constants"] = cell.packed.constants
        expect(self._cell["evidence"], cell, self.initial_soc[0])
        self._filters[...] = self._start(cell)

    def _cell_now(self) -> CellParameters:
        ambient_K = float(self._cell["ambient_K"])
        return self.cell if ambient_K == self.cell.Tb0 else self.cell.replace(Tb0=ambient_K)

    def check(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> None:
        """Refuse a sample that :meth:`update` would refuse, and change nothing."""
        seen = self._cell["evidence"]
        before_A = float(seen["current_A"]) if seen["samples"] else None
        check_sample(voltage_V, current_A, dt_s, temperature_C, before_A)
        check_drawn_charge(float(seen["drawn_C"]) + (0.0 if before_A is None else dt_s * before_A), self.least_drawn_C)

    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """
        Take in one sample, as :meth:`OnlineEstimator.update` describes. A sample that :func:`battery_env.records.check_sample`
        refuses, or one that charges a full cell, leaves the filter as it was.
        """
        self.check(voltage_V, current_A, dt_s, temperature_C)
        temperature_K = nan if temperature_C is None else temperature_C + ZERO_CELSIUS_K
        if not self._cell["evidence"]["samples"]:
            dt_s = 0.0
            if not isnan(temperature_K):
                self._begin(temperature_K)
        sample = np.array([(voltage_V, current_A, dt_s, temperature_K, current_A)], dtype=SAMPLE)
        (judged,) = self._follow(sample)
        verdict = Verdict.of(judged, self._measured())
        (q_mobile, r_o), (sd_q_mobile, sd_r_o) = judged["value"].tolist(), judged["sd"].tolist()
        return Estimate(q_mobile, r_o, sd_q_mobile, sd_r_o, **verdict._asdict())

    def _follow(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """What is estimated after each of these samples."""
        estimates = np.zeros(len(samples), JUDGED)
        _follow_all(self._cell, self._filters, samples, self._settings, self.cell.packed, self._derivatives, estimates)
        return estimates

    def _measured(self, clock_s: float = 0.0, charge: ChargeBefore | None = None) -> dict[str, Any]:
        """What texts say, by the names in their braces."""
        return measured(self._cell["evidence"], self.initial_soc[0], clock_s, charge)

    def follow(self, record: Record) -> EstimateTrace:
        """
        One estimate for every sample of a discharge, in one compiled call. A temperature that was measured is that of the
        model, as in a stream.
        """
        stream = Stream.of(record, self.dt_s)
        self.reset()
        time_s, voltage_V, current_A, dt_s, temperature_C = stream
        samples = np.zeros(len(time_s), SAMPLE)
        samples["voltage_V"], samples["current_A"], samples["dt_s"] = voltage_V, current_A, dt_s
        samples["read_A"] = record.current_A
        samples["temperature_K"] = nan if temperature_C is None else temperature_C + ZERO_CELSIUS_K
        if temperature_C is not None:
            self._begin(float(samples["temperature_K"][0]))
        history = history_of(record, self.usual_start)
        if self.initial_soc[0] < 1.0:
            history = history._replace(charge=None, usual_start=None)
        take_in(self._cell["evidence"], history)
        check_drawn_charge(float(np.cumsum(np.append(0.0, current_A[:-1]) * dt_s).min()), self.least_drawn_C)
        judged, said = self._follow(samples), self._measured(float(time_s[0]), history.charge)
        # the same is said again and again, at last with what is in doubt then
        kinds = [each.tobytes() for each in judged[["reason", "about", "doubt", "r_o_comes_first"]]]
        texts = {kind: Verdict.of(judged[n], said).reason for kind, n in {kind: n for n, kind in enumerate(kinds)}.items()}
        (q_mobile, r_o), (sd_q_mobile, sd_r_o) = judged["value"].T.copy(), judged["sd"].T.copy()
        settled_q, settled_r_o = (judged["reason"] == Reason.SETTLED).T
        reasons = np.array([texts[kind] for kind in kinds], dtype=object)
        settled = settled_q & settled_r_o
        return EstimateTrace(time_s, q_mobile, r_o, sd_q_mobile, sd_r_o, settled, reasons, settled_q, settled_r_o)

    @property
    def least_drawn_C(self) -> float:
        """The charge drawn stays above this: a cell takes no more than it has room for, C."""
        return -(SURPLUS_SHARE + (1.0 - self.initial_soc[0])) * self.cell.q_mobile

    def __copy__(self) -> ExtendedKalmanFilter:
        """A filter that goes its own way."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), _cell=self._cell.copy(), _filters=self._filters.copy())
        return other

    def now(self) -> ModelNow:
        """The model at the last sample, at the mean of all filters."""
        filters = self._filters
        weight = np.exp(filters["log_weight"] - filters["log_weight"].max())
        weight /= weight.sum()
        best, alive = int(weight.argmax()), weight > 0.0
        means, covariances = filters["mean"], filters["covariance"]
        mean = weight[alive] @ means[alive]
        apart = means[alive] - mean
        covariance = np.tensordot(weight[alive], covariances[alive] + apart[:, :, None] * apart[:, None, :], axes=1)
        # the state goes along with the parameters, by its tangents
        tangents = filters["tangents"][best, 0]
        by_parameters = np.vstack([np.hstack([tangents, np.eye(2, 3)]), np.eye(1, STATE_SIZE + 3, STATE_SIZE + 2)])
        variances, directions = np.linalg.eigh(covariance)
        deviations = (directions * np.sqrt(np.maximum(variances, 0.0))).T @ by_parameters
        state = filters["state"][best, 0] + (mean - means[best]) @ by_parameters[:, :STATE_SIZE]
        return ModelNow(self._cell_now(), self.thermal, self.dt_s, state, mean, deviations)

    def _made_with(self) -> dict[str, Any]:
        return {
            "estimator": type(self).__name__,
            "parameters": list(self.parameters),
            "cell": asdict(self.cell),
            "initial_soc": self.initial_soc,
            "means": self._means,
            "standard_deviations": self._sds,
            **self._settings._asdict(),
        }

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"cell": self._cell, "filters": self._filters}


def _checked_noise_V(voltage_noise_V: float | None, mismatch_V: float) -> float:
    """The noise of a voltage sample that is stated, or what follows from the error of the model."""
    if voltage_noise_V is None:
        return float(max(LEAST_ERROR_V, mismatch_V))
    if not 0.0 < voltage_noise_V < inf:
        raise ValueError(f"voltage_noise_V must be greater than 0 V, got {voltage_noise_V!r}. Exact records: 1e-4.")
    if voltage_noise_V < mismatch_V:
        raise ValueError(
            f"voltage_noise_V must be at least mismatch_V, {mismatch_V!r} V, got {voltage_noise_V!r} V: the filter would "
            "take each sample of a model that wanders for exact. Leave voltage_noise_V out to have it follow mismatch_V."
        )
    return float(voltage_noise_V)


def _pair(values: tuple[float, float]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


@compiled
def _follow_all(
    one: NDArray[np.void],
    filters: NDArray[np.void],
    samples: NDArray[np.void],
    settings: FilterSettings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    estimates: NDArray[np.void],
) -> None:
    # every sample of a cell, an array of no dimension, into the estimate after it
    cell: Any = one[()]
    bank, evidence = cell.bank, cell.evidence
    of_cell = PackedConstants(cell.constants, packed.polynomial_n, packed.polynomial_p)
    for k in range(len(samples)):
        sample = samples[k]
        voltage, current, duration = sample.voltage_V, sample.current_A, sample.dt_s
        begin(evidence, duration)
        examine(evidence, voltage, current, bank.mean[Q], bank.mean[R], settings.cell_q_mobile)
        # a voltage that does not follow its current corrects nothing
        belonging_V = voltage if belongs(evidence) else nan
        take(cell, filters, sample, belonging_V, settings, of_cell, derivatives)
        if evidence.samples > 1 and duration > 0.0:
            gaps.follow(evidence, belonging_V, current, bank.expected_V, bank.mean[Q])
        conclude(cell, settings, estimates[k])
        remember(evidence, voltage, current, sample.read_A)
