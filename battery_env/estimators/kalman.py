"""Calibration during a discharge: an extended Kalman filter on voltage and current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.checks import check_gain_sd
from battery_env.electrochemistry import STATE_SIZE, CellParameters, check_cell, check_dt
from battery_env.electrochemistry.tangents import PolynomialDerivatives
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.base import SURPLUS_SHARE, ModelNow, OnlineBatch, OnlineEstimator, check_bounds
from battery_env.estimators.kalman_bank import OUT_SIZE, Bank, Settings, follow
from battery_env.estimators.monitor import AT_REST, Limits, Monitor, watch
from battery_env.estimators.rest import (
    LEAST_REST_S,
    InitialSoc,
    Start,
    check_initial_soc,
    follow_rest,
    soc_at_rest,
    told_at_rest,
)
from battery_env.estimators.settling import MISMATCH_MARGIN, PLAUSIBLE_Q_SHARES, rest_voltage_V
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, check_parameters
from battery_env.records import REST_CURRENT_A, Record, Stream, check_drawn_charge, check_sample, starts_at_rest

_PRIOR_SD_SHARE_Q = 0.25
_PRIOR_SD_R_OHM = 0.15
_HOUR_S = 3600.0
_NOISE_V = 0.005
ZERO_CELSIUS_K = 273.15
#: What the filter remembers of a discharge beside its bank: how many samples, how long (s), the charge drawn (C), whether a
# load was on, how long the cell rested before it (s), both means of its voltage then (V); the state of charge at the first
# sample, its standard deviation; and the temperature of the surroundings (K).
SAMPLES, TIME, DRAWN, _LOADED, _REST, _FAST_V, _SLOW_V, _SOC, _SD_SOC, _AMBIENT = range(10)


class ExtendedKalmanFilter(OnlineEstimator):
    """
    Follows (q_mobile, r_o) along a discharge that starts with a cell at rest, fully charged unless ``initial_soc`` says
    otherwise: one estimate a sample, with its standard deviation.

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
    discharge, takes one filter.

    *Gate.* Innovations count in full up to 5 standard deviations, and beyond as if the noise had been larger (Huber's loss): a
    wild sample moves nothing far, and a filter that is wrong still finds back.

    *Noise.* Where the innovations of the last 30 or so samples show more noise than stated, that noise is used; the first ones
    count as stated.

    *Bounds.* Estimates stay within their bounds, and ``q_mobile`` above the least value that has the charge drawn so far: mole
    fractions never leave 0 .. 1. If ``q_mobile`` is held and too small for that, the estimate freezes and is not settled.

    *Standard deviations* count the error of the model as noise that is new with each sample. As it is not, that of
    ``q_mobile`` does not fall below half of what :class:`~battery_env.estimators.LeastSquares` states for an error common to
    the whole discharge, up to 1 % of ``q_mobile``: on whole discharges of the bundled cells, with ``mismatch_V=0.05``, it is
    0.7 to 1 %.

    The gain of the current sensor scales both parameters and does not show in the voltage: state it as ``current_gain_sd``.

    *A stream.* :meth:`update` takes sample after sample, at any intervals. Between two samples the current of the first one
    flows; a cell at rest may be left alone for a week. A voltage that is missing (NaN) corrects nothing. Charge may flow back,
    as far as the cell has room for it: the model charges by the same equations. A measured temperature is that of the model
    then; the first one is also that of its surroundings.

    *Settled* means that the data determine every parameter searched for: its standard deviation, without what a given prior
    adds to it, is below :data:`~battery_env.estimators.settling.SETTLED_SHARES` of its value; and that nothing contradicts it:

    - the first samples can be those of a full cell (:func:`~battery_env.estimators.settling.start_reason`), or of one with
      ``initial_soc``;
    - the voltage follows the current where the load is switched, does not rise where it is not, and does not come back to
      where it started from without a charge (:mod:`~battery_env.estimators.monitor`);
    - after a stretch of a load without samples (:mod:`~battery_env.estimators.gaps`) the voltage is lower by what was drawn
      meanwhile. If noise hides that, the charge in doubt is in the standard deviation of ``q_mobile``;
    - the estimate is farther than its standard deviation from its bounds, ``q_mobile`` is plausible for a cell of this kind,
      and the model cell is not empty;
    - innovations have not gone the same way again and again: the sum of the products of successive ones has never been 5
      standard deviations above 0, with twice ``mismatch_V`` allowed for. It comes to that where the error of the model or the
      noise is far larger than stated, a sensor fails, or the cell was charged without :meth:`reset`; one wild sample does no
      harm;
    - the offset that is found is within 5 standard deviations of ``offset_sd_V`` and what ``mismatch_V`` adds to it;
    - ``r_o`` is where it was before, within 5 of the standard deviations stated then;
    - a given prior is within 2.5 standard deviations of what the data say.

    Otherwise ``reason`` of the estimate says which of these does not hold. In particular an estimate that rests on a prior is
    not settled: it is as good as the prior.

    For a recorded discharge give :meth:`battery_env.cells.Discharge.loaded_part`, which starts when the load is switched on,
    and state the error of the model as ``mismatch_V``: 0.05 V for the cells that come with the package.

    :param parameters: which to search for; the other is held at ``cell``'s value
    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: longest time step of the model, s; that of simulated records if these are to be reproduced exactly
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before the discharge, C; ``None``: ``cell``'s value,
        and a quarter of it
    :param prior_r_o_ohm: likewise of ``r_o``, ohm; ``None``: ``cell``'s value, and 0.15 ohm
    :param q_mobile_bounds_C: where the estimate stays, C
    :param r_o_bounds_ohm: likewise, ohm
    :param voltage_noise_V: standard deviation of the noise of one voltage sample, V; ``None``: ``mismatch_V``, and at least
        0.005 V. A model that wanders by ``mismatch_V`` is not followed more closely from sample to sample
    :param offset_sd_V: standard deviation of a constant offset of sensor and model, V; ``None``: ``mismatch_V``, and at least
        0.005 V. With 0 errors are about half as large
        if there is no offset, and several percent if there is one of 10 mV
    :param mismatch_V: how far the error of the model itself wanders in an hour (standard deviation of a random walk), V
    :param drift_per_hour: how far the parameters may wander in an hour, as a share of their prior means. A little keeps the
        filter awake
    :param current_gain_sd: standard deviation of the gain of the current sensor, as a share of it
    :param initial_soc: state of charge at the first sample, after a rest: a number; (mean, standard deviation), which adds to
        that of ``q_mobile``; or ``"rest"``: it is told from the voltage of the rest before the load, of a minute at least, by
        the open-circuit voltage of the model, with ``voltage_noise_V`` and ``offset_sd_V`` as its errors
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
        q_mobile_bounds_C: tuple[float, float] = (Q_MOBILE.limits[0], 1e5),
        r_o_bounds_ohm: tuple[float, float] = (0.0, 1.0),
        voltage_noise_V: float | None = None,
        offset_sd_V: float | None = None,
        mismatch_V: float = 0.0,
        drift_per_hour: float = 0.001,
        current_gain_sd: float = 0.0,
        initial_soc: InitialSoc = 1.0,
    ) -> None:
        self.parameters = check_parameters(parameters)
        self.cell = check_cell(cell, thermal)
        self.thermal = thermal
        self.dt_s = check_dt(dt_s, self.cell)
        self.bounds = check_bounds(q_mobile_bounds_C, r_o_bounds_ohm)
        offset_sd_V = max(_NOISE_V, mismatch_V) if offset_sd_V is None else offset_sd_V
        for name, value in (("offset_sd_V", offset_sd_V), ("mismatch_V", mismatch_V), ("drift_per_hour", drift_per_hour)):
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {value!r}")
        voltage_noise_V = max(_NOISE_V, mismatch_V) if voltage_noise_V is None else voltage_noise_V
        if not 0.0 < voltage_noise_V < np.inf:
            raise ValueError(f"voltage_noise_V must be greater than 0 V, got {voltage_noise_V!r}. Exact records: 1e-4.")
        if voltage_noise_V < mismatch_V:
            raise ValueError(
                f"voltage_noise_V must be at least mismatch_V, {mismatch_V!r} V, got {voltage_noise_V!r} V: the filter would "
                "take each sample of a model that wanders for exact. Leave voltage_noise_V out to have it follow mismatch_V."
            )
        self.current_gain_sd = check_gain_sd(current_gain_sd)
        self.initial_soc = check_initial_soc(initial_soc)
        self.told_from_rest = isinstance(initial_soc, str)
        self._carried = {
            name: (float(prior[0]), float(prior[1]))
            for name, prior in (("q_mobile", prior_q_mobile_C), ("r_o", prior_r_o_ohm))
            if prior is not None
        }
        q, q_sd = self._prior("q_mobile", prior_q_mobile_C, _PRIOR_SD_SHARE_Q * self.cell.q_mobile)
        r_o, r_o_sd = self._prior("r_o", prior_r_o_ohm, _PRIOR_SD_R_OHM)
        self._settings = Settings(
            dt_s=self.dt_s,
            thermal=thermal,
            noise_V2=float(voltage_noise_V) ** 2,
            spare_V2=(MISMATCH_MARGIN**2 - 1.0) * float(mismatch_V) ** 2,
            mismatch_V2=float(mismatch_V) ** 2,
            q_prior=q_sd**2,
            r_prior=r_o_sd**2,
            q_growth=(drift_per_hour * q) ** 2 / _HOUR_S if q_sd > 0.0 else 0.0,
            r_growth=(drift_per_hour * r_o) ** 2 / _HOUR_S if r_o_sd > 0.0 else 0.0,
            offset_growth=float(mismatch_V) ** 2 / _HOUR_S,
            least_q=float(q_mobile_bounds_C[0]),
            most_q=float(q_mobile_bounds_C[1]),
            least_r=float(r_o_bounds_ohm[0]),
            most_r=float(r_o_bounds_ohm[1]),
        )
        self._derivatives = PolynomialDerivatives.of(self.cell.packed)
        self._means, self._sds = (q, r_o), (q_sd, r_o_sd, float(offset_sd_V))
        self._rest_sd_V = float(np.hypot(voltage_noise_V, offset_sd_V))
        self.reset()

    def _prior(self, name: str, prior: tuple[float, float] | None, default_sd: float) -> tuple[float, float]:
        if name not in self.parameters:
            if prior is not None:
                raise ValueError(f"a prior of {name} needs {name!r} among the parameters to search for")
            return float(getattr(self.cell, name)), 0.0
        mean, sd = (getattr(self.cell, name), default_sd) if prior is None else prior
        low, high = self.bounds[name]
        if not (low <= mean <= high and 0.0 < sd < np.inf):
            raise ValueError(f"the prior of {name} is (mean within {low:g} .. {high:g}, sd above 0), got {prior!r}")
        return float(mean), float(sd)

    def reset(self) -> None:
        """
        Forget all samples: the next one is the first of a discharge, of a cell at rest with ``initial_soc``.
        """
        self._numbers = np.zeros(_AMBIENT + 1)
        self._numbers[_SOC], self._numbers[_SD_SOC] = self.initial_soc
        self._numbers[_AMBIENT] = self.cell.Tb0
        self._monitor, self._clock_s = Monitor.new(), 0.0
        self._model_cell = self.cell
        self._begin()

    def _begin(self) -> None:
        """The filters at the start, as far as it is known, and what their samples are compared with."""
        soc, sd_soc = float(self._numbers[_SOC]), float(self._numbers[_SD_SOC])
        self._bank = Bank.of(self._means, self._sds, self._settings, self._model_cell, soc)
        self._set_limits(soc, sd_soc)

    def _set_limits(self, soc: float, sd_soc: float) -> None:
        nothing = (np.nan, np.nan)
        self._limits = Limits(
            start_V=rest_voltage_V(self._model_cell, soc),
            needs_rest=self.told_from_rest,
            rested=bool(self._numbers[_REST] >= LEAST_REST_S),
            searched=np.array([float(name in self.parameters) for name in PARAMETER_NAMES]),
            bounds=np.array([self.bounds[name] for name in PARAMETER_NAMES]),
            prior=np.array([self._carried.get(name, nothing) for name in PARAMETER_NAMES]),
            scale_sd=np.array([np.hypot(self.current_gain_sd, sd_soc / soc), self.current_gain_sd]),
            plausible_C=np.multiply(PLAUSIBLE_Q_SHARES, self.cell.q_mobile),
            cell_q_mobile=self.cell.q_mobile,
        )

    def check(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> None:
        """
        Refuse a sample that :meth:`update` would refuse, and change nothing.

        :param voltage_V: as of :meth:`update`
        :param current_A: likewise
        :param dt_s: likewise
        :param temperature_C: likewise
        :raises ValueError: as :meth:`update`
        """
        is_first, before_A = not self._numbers[SAMPLES], self._bank.current_A
        check_sample(voltage_V, current_A, dt_s, temperature_C, None if is_first else before_A)
        self._check_drawn(self._numbers[DRAWN] + (0.0 if is_first else dt_s * before_A))

    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """
        Take in one sample.

        :param voltage_V: terminal voltage, V; NaN where it is missing, but for the first sample
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one. The current of the previous sample
            has flowed all the time
        :param temperature_C: of the cell, degC; ``None``: not measured
        :return: the estimate
        :raises TypeError: for what is no number
        :raises ValueError: for what cannot be meant (:func:`battery_env.records.check_sample`), and for a current that charges
            a full cell; the filter stays as it was
        """
        self.check(voltage_V, current_A, dt_s, temperature_C)
        since_s = dt_s if self._numbers[SAMPLES] else 0.0
        temperature_K = np.nan if temperature_C is None else temperature_C + ZERO_CELSIUS_K
        if not self._numbers[SAMPLES] and temperature_C is not None:
            self._surround(temperature_K)
        if self.told_from_rest and not self._numbers[_LOADED]:
            self._rest(voltage_V, current_A, since_s)
        samples = np.array([[voltage_V], [current_A], [since_s], [temperature_K]], dtype=np.float64)
        out, codes = self._run(samples)
        code = int(codes[0])
        reason = self._texts()[code] if code else ""
        q, r_o, sd_q, sd_r_o = out[0, :4].tolist()
        searched = self._limits.searched
        return Estimate(
            q, r_o, sd_q if searched[0] else float("nan"), sd_r_o if searched[1] else float("nan"), not code, reason
        )

    def _surround(self, temperature_K: float) -> None:
        """The model starts at this temperature, and in surroundings of it."""
        self._numbers[_AMBIENT] = temperature_K
        self._model_cell = self.cell.replace(Tb0=temperature_K)
        self._begin()

    def _rest(self, voltage_V: float, current_A: float, since_s: float) -> None:
        """Tell the state of charge from the voltage, as long as no load is on."""
        numbers = self._numbers
        if abs(current_A) > REST_CURRENT_A:
            numbers[_LOADED] = 1.0
            return
        if np.isnan(voltage_V):
            return
        means_V = numbers[_FAST_V : _SLOW_V + 1]
        if not numbers[SAMPLES]:
            means_V[:] = voltage_V
        follow_rest(means_V, voltage_V, since_s)
        numbers[_REST] += since_s
        numbers[_SOC], numbers[_SD_SOC] = soc_at_rest(means_V, self._rest_sd_V, self._model_cell)
        self._begin()

    def start_of(self, record: Record) -> Start:
        """
        The state of charge that a record starts with: the one that is stated, or what its rest tells.

        :param record: one discharge
        :return: as far as it can be told
        :raises ValueError: if the record cannot be used
        """
        if self.told_from_rest:
            measured_C = getattr(record, "temperature_C", None)
            cell = self.cell if measured_C is None else self.cell.replace(Tb0=float(measured_C[0]) + ZERO_CELSIUS_K)
            return told_at_rest(record, cell, self._rest_sd_V, self.dt_s)
        return Start(*self.initial_soc)

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        One estimate for every sample of many discharges, in one compiled call each. A temperature that was measured is that of
        the model, as in a stream.

        :param records: discharges; a :class:`~battery_env.trajectories.TrajectoryDataset` is one
        :return: one trace per discharge, in the same order
        :raises ValueError: if a record cannot be used
        """
        traces = []
        for record in records:
            stream = Stream.of(record, self.dt_s)
            self.reset()
            time_s, voltage_V, current_A, dt_s, temperature_C = stream
            self._clock_s = float(time_s[0])
            if self.told_from_rest:  # filters begin anew with each sample of a rest
                traces.append(self._follow_samples(stream))
                continue
            temperature_K = np.full(len(time_s), np.nan)
            if temperature_C is not None:
                temperature_K = temperature_C + ZERO_CELSIUS_K
                self._surround(float(temperature_K[0]))
            self._monitor.memory[AT_REST] = float(starts_at_rest(record))
            self._check_drawn(float(np.cumsum(np.append(0.0, current_A[:-1]) * dt_s).min()))
            out, codes = self._run(np.stack([voltage_V, current_A, dt_s, temperature_K]))
            q, r_o, sd_q, sd_r_o = out[:, :4].T.copy()
            for name, sd in (("q_mobile", sd_q), ("r_o", sd_r_o)):
                if name not in self.parameters:
                    sd[:] = np.nan
            reason = np.array(self._texts(), dtype=object)[codes]
            traces.append(EstimateTrace(time_s, q, r_o, sd_q, sd_r_o, codes == 0, reason))
        self.reset()
        return traces

    @property
    def least_drawn_C(self) -> float:
        """The charge drawn stays above this: a cell takes no more than it has room for, C."""
        return -(SURPLUS_SHARE + (1.0 - float(self._numbers[_SOC]))) * self.cell.q_mobile

    def _check_drawn(self, charge_C: float) -> None:
        check_drawn_charge(charge_C, self.least_drawn_C)

    def batch(self, cells: int) -> OnlineBatch:
        """
        Filters like this one, each for a cell of its own, which take their samples in one compiled call.

        :param cells: how many
        :return: these, before their first samples
        :raises ValueError: for no cells
        """
        from battery_env.estimators.kalman_batch import KalmanBatch  # here, as it imports this module

        return KalmanBatch(self, cells)

    def _run(self, samples: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        """Take in samples."""
        voltage_V, current_A, dt_s, temperature_K = samples
        numbers, count = self._numbers, samples.shape[1]
        out, codes = np.empty((count, OUT_SIZE)), np.empty(count, dtype=np.int64)
        before_A = np.append(self._bank.current_A, current_A[:-1])
        drawn_C = numbers[DRAWN] + np.cumsum(before_A * dt_s)
        settings, packed = self._settings, self._model_cell.packed
        follow(self._bank, voltage_V, current_A, dt_s, temperature_K, settings, packed, self._derivatives, out)
        watch(self._monitor, voltage_V, current_A, dt_s, drawn_C, self._limits, out, codes)
        numbers[SAMPLES] += count
        numbers[TIME] += dt_s.sum()
        numbers[DRAWN] = drawn_C[-1]
        return out, codes

    def _texts(self) -> list[str]:
        return self._monitor.texts(self._limits.start_V, float(self._numbers[_SOC]), self._clock_s)

    def now(self) -> ModelNow:
        """
        The model at the last sample, at the mean of all filters.

        :return: where it stands
        """
        bank = self._bank
        weight = np.exp(bank.log_weight - bank.log_weight.max())
        weight /= weight.sum()
        best, alive = int(weight.argmax()), weight > 0.0
        mean = weight[alive] @ bank.mean[alive]
        apart = bank.mean[alive] - mean
        covariance = np.tensordot(weight[alive], bank.covariance[alive] + apart[:, :, None] * apart[:, None, :], axes=1)
        # the state goes along with the parameters, by its tangents
        by_parameters = np.vstack([np.hstack([bank.tangents[best], np.eye(2, 3)]), np.eye(1, STATE_SIZE + 3, STATE_SIZE + 2)])
        variances, directions = np.linalg.eigh(covariance)
        deviations = (directions * np.sqrt(np.maximum(variances, 0.0))).T @ by_parameters
        state = bank.state[best] + (mean - bank.mean[best]) @ by_parameters[:, :STATE_SIZE]
        return ModelNow(self._model_cell, self.thermal, self.dt_s, state, mean, deviations)

    def _made_with(self) -> dict[str, Any]:
        return {
            "estimator": type(self).__name__,
            "parameters": list(self.parameters),
            "cell": asdict(self.cell),
            "means": list(self._means),
            "standard deviations": list(self._sds),
            "settings": self._settings._asdict(),
            "priors": self._carried,
            "current_gain_sd": self.current_gain_sd,
            "initial_soc": "rest" if self.told_from_rest else list(self.initial_soc),
        }

    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays = {f"bank/{name}": array for name, array in self._bank._asdict().items()}
        arrays |= {f"monitor/{name}": array for name, array in self._monitor._asdict().items()}
        return {**arrays, "numbers": self._numbers}

    def _restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self._numbers = arrays["numbers"].copy()
        self._model_cell = self.cell.replace(Tb0=float(self._numbers[_AMBIENT]))
        self._bank = Bank(*(arrays[f"bank/{name}"].copy() for name in Bank._fields))
        self._monitor = Monitor(*(arrays[f"monitor/{name}"].copy() for name in Monitor._fields))
        self._set_limits(float(self._numbers[_SOC]), float(self._numbers[_SD_SOC]))
