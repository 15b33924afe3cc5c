"""Calibration during a discharge: an extended Kalman filter on voltage and current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from battery_env.arrays import FloatArray, StringArray
from battery_env.checks import check_gain_sd
from battery_env.electrochemistry import CellParameters, check_cell, check_dt
from battery_env.electrochemistry.tangents import PolynomialDerivatives
from battery_env.estimates import Estimate, EstimateTrace, last_estimate
from battery_env.estimators.base import OnlineEstimator, check_bounds
from battery_env.estimators.kalman_bank import LIMIT_SD, Bank, Settings, follow
from battery_env.estimators.settling import (
    AT_BOUND,
    EMPTY,
    IMPLAUSIBLE,
    IMPRECISE,
    MISFIT,
    MISMATCH_MARGIN,
    PRIOR_ALONE,
    PRIOR_CONTRADICTED,
    PRIOR_LIMIT_SD,
    SETTLED_SHARES,
    START_WINDOW_S,
    data_sd,
    is_plausible,
    sensor_reason,
    start_reason,
)
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, check_parameters
from battery_env.records import Record, Stream, check_drawn_charge, check_sample

_PRIOR_SD_SHARE_Q = 0.25
_PRIOR_SD_R_OHM = 0.15
_HOUR_S = 3600.0
_NOISE_V = 0.005
# The data must have narrowed a prior by this share of its width before a deviation from it says anything.
_LEAST_NARROWING = 0.2
# A full cell takes no more charge than this share of its own.
_SURPLUS_SHARE = 0.01


class ExtendedKalmanFilter(OnlineEstimator):
    """
    Follows (q_mobile, r_o) along a discharge that starts with a fully charged cell at rest: one estimate a sample, with its
    standard deviation.

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

    The gain of the current sensor scales both parameters and does not show in the voltage: state it as ``current_gain_sd``.

    *Settled* means that the data determine every parameter searched for: its standard deviation, without what a given prior
    adds to it, is below :data:`~battery_env.estimators.settling.SETTLED_SHARES` of its value; and that nothing contradicts it:

    - the first samples can be those of a full cell (:func:`~battery_env.estimators.settling.start_reason`);
    - the estimate is farther than its standard deviation from its bounds, ``q_mobile`` is plausible for a cell of this kind,
      and the model cell is not empty;
    - innovations have not gone the same way again and again: the sum of the products of successive ones has never been 5
      standard deviations above 0, with twice ``mismatch_V`` allowed for. It comes to that where the error of the model or the
      noise is far larger than stated, a sensor fails, or the cell was charged without :meth:`reset`; one wild sample does no
      harm;
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
            q_growth=(drift_per_hour * q) ** 2 / _HOUR_S if q_sd > 0.0 else 0.0,
            r_growth=(drift_per_hour * r_o) ** 2 / _HOUR_S if r_o_sd > 0.0 else 0.0,
            offset_growth=float(mismatch_V) ** 2 / _HOUR_S,
            least_q=float(q_mobile_bounds_C[0]),
            most_q=float(q_mobile_bounds_C[1]),
            least_r=float(r_o_bounds_ohm[0]),
            most_r=float(r_o_bounds_ohm[1]),
        )
        self._derivatives = PolynomialDerivatives.of(self.cell.packed)
        self._fresh = Bank.of((q, r_o), (q_sd, r_o_sd, offset_sd_V), self._settings, self.cell)
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
        Forget all samples: the next one is the first of a discharge, of a fully charged cell at rest.
        """
        self._bank = self._fresh.copy()
        self._time_s = self._drawn_C = 0.0
        self._start: list[tuple[float, float, float]] = []  # the first samples
        self._start_reason = ""

    def update(self, voltage_V: float, current_A: float, dt_s: float) -> Estimate:
        """
        Take in one sample.

        :param voltage_V: terminal voltage, V
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one
        :return: the estimate
        :raises ValueError: for what cannot be meant (:func:`battery_env.records.check_sample`), and for a current that charges
            a full cell; the filter stays as it was
        """
        is_first = not self._start
        check_sample(voltage_V, current_A, None if is_first else dt_s)
        since_s = 0.0 if is_first else dt_s
        drawn_C = self._drawn_C + since_s * self._bank.current_A
        self._check_drawn(drawn_C)
        self._time_s, self._drawn_C = self._time_s + since_s, drawn_C
        if len(self._start) < 2 or self._time_s <= START_WINDOW_S:
            self._start.append((self._time_s, voltage_V, current_A))
            time_s, voltages_V, currents_A = np.array(self._start).T
            self._start_reason = start_reason(time_s, voltages_V, currents_A, self.cell)
        out = self._run(self._bank, np.array([[voltage_V], [current_A], [since_s]], dtype=np.float64))
        trace = self._trace(np.array([self._time_s]), out, np.array([self._start_reason], dtype=object))
        return last_estimate(trace)

    def estimate(self, record: Record) -> Estimate:
        """
        The estimate at the last sample of a record. Unlike the stream, a whole record can be asked whether its voltage follows
        its current everywhere: where a sensor is stuck or gone for a while, the estimate is not settled.

        :param record: one discharge
        :return: the estimate
        :raises ValueError: if the record cannot be used
        """
        from scipy.ndimage import median_filter  # here, as it takes longer to import than this package

        estimate = super().estimate(record)
        time_s, voltage_V, current_A = (np.asarray(getattr(record, name)) for name in ("time_s", "voltage_V", "current_A"))
        # single wild samples are gated
        smooth_V = median_filter(voltage_V, size=3, mode="nearest")
        reason = estimate.reason or (sensor_reason(time_s, smooth_V, current_A) if len(time_s) > 1 else "")
        return replace(estimate, settled=not reason, reason=reason)

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        One estimate for every sample of many discharges, in one compiled call each.

        :param records: discharges; a :class:`~battery_env.trajectories.TrajectoryDataset` is one
        :return: one trace per discharge, in the same order
        :raises ValueError: if a record cannot be used
        """
        traces = []
        for record in records:
            time_s, voltage_V, current_A, dt_s = Stream.of(record, self.dt_s)
            self._check_drawn(float(np.cumsum(np.append(0.0, current_A[:-1]) * dt_s).min()))
            starts = max(int(np.searchsorted(time_s, time_s[0] + START_WINDOW_S, side="right")), 2)
            reasons = [start_reason(time_s[:n], voltage_V[:n], current_A[:n], self.cell) for n in range(1, starts + 1)]
            start = np.array(reasons[: len(time_s)] + [reasons[-1]] * (len(time_s) - starts), dtype=object)
            out = self._run(self._fresh.copy(), np.stack([voltage_V, current_A, dt_s]))
            traces.append(self._trace(time_s, out, start))
        self.reset()
        return traces

    def _check_drawn(self, charge_C: float) -> None:
        check_drawn_charge(charge_C, -_SURPLUS_SHARE * self.cell.q_mobile)

    def _run(self, bank: Bank, samples: FloatArray) -> FloatArray:
        out = np.empty((samples.shape[1], 6))
        follow(bank, samples[0], samples[1], samples[2], self._settings, self.cell.packed, self._derivatives, out)
        return out

    def _trace(self, time_s: FloatArray, out: FloatArray, start: StringArray) -> EstimateTrace:
        """What the filter says, from its rows and from why each sample so far is no start of a full cell."""
        q, r_o, sd_q, sd_r_o, alive, trend = out.T.copy()
        values, own_sd = {"q_mobile": q, "r_o": r_o}, {"q_mobile": sd_q, "r_o": sd_r_o}
        sd = {name: np.hypot(own_sd[name], self.current_gain_sd * values[name]) for name in self.parameters}
        conditions = [(start != "", start), (alive == 0.0, EMPTY)]
        for name in self.parameters:
            low, high = self.bounds[name]
            inside = (low + own_sd[name] < values[name]) & (values[name] < high - own_sd[name])
            conditions.append((~inside, AT_BOUND.format(name)))
        if "q_mobile" in self.parameters:
            conditions.append((~is_plausible(q, self.cell), IMPLAUSIBLE))
        conditions.append((trend > LIMIT_SD, MISFIT))
        for name, (mean, prior_sd) in self._carried.items():
            narrowed = np.maximum(prior_sd**2 - own_sd[name] ** 2, (_LEAST_NARROWING * prior_sd) ** 2)
            contradicted = (values[name] - mean) ** 2 > PRIOR_LIMIT_SD**2 * narrowed
            alone = data_sd(own_sd[name], prior_sd) >= SETTLED_SHARES[name] * values[name]
            conditions += [(contradicted, PRIOR_CONTRADICTED.format(name)), (alone, PRIOR_ALONE.format(name))]
        conditions += [(~(sd[name] < SETTLED_SHARES[name] * values[name]), IMPRECISE[name]) for name in self.parameters]
        reason = np.full(len(time_s), "", dtype=object)
        for holds, text in reversed(conditions):
            reason = np.where(holds, text, reason)
        held = np.full(len(time_s), np.nan)
        return EstimateTrace(time_s, q, r_o, sd.get("q_mobile", held), sd.get("r_o", held), reason == "", reason)
