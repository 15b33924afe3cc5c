"""Calibration during a discharge: an extended Kalman filter on voltage and current, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import exp, inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from battery_env.arrays import FloatArray, StringArray
from battery_env.checks import check_gain_sd
from battery_env.electrochemistry import (
    FULL_CHARGE_SHARES,
    QNB,
    QNS,
    QPS,
    STATE_SIZE,
    CellParameters,
    PackedConstants,
    check_cell,
    check_dt,
    initial_state,
)
from battery_env.electrochemistry.cell import FRACTION_PER_SHARE
from battery_env.electrochemistry.kernels import MOLE_FRACTION_MARGIN, cell_step, cell_voltage
from battery_env.estimates import Estimate, EstimateTrace, last_estimate
from battery_env.estimators.base import OnlineEstimator, check_bounds
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

# What a filter estimates: q_mobile (C), r_o (ohm) and the offset of the voltage (V).
_Q, _R, _OFFSET = range(3)
# What the bank remembers: the current since the last sample (A), the mean of the noise that innovations showed (V^2), the last
# innovations (of the mixture, normalized), the sum of the products of each with those before it and its variance, both over
# about so many samples, how many standard deviations that sum has been above 0 at most, and the range that r_o cannot leave
# if what the filter said about it before was right (q_mobile can: at the knee the error of the model moves it).
_CURRENT, _NOISE, _LAST, _PRODUCTS, _VARIANCE, _TREND, _LEAST_R, _MOST_R = range(8)
_TREND_MEMORY, _PRODUCTS_MEMORY = 0.8, 0.999
# It runs three copies of the model: at its estimate, with this much more q_mobile, and with this much more r_o; their
# differences are the derivatives of the state.
_COPIES = 3
_MORE_Q_C = 0.1
_MORE_R_OHM = 1e-3
# A filter is linear over its standard deviation of q_mobile: a wider prior is divided among filters this far apart (as a
# share of its mean), over so many standard deviations to each side.
_WIDEST_SHARE = 0.08
_REACH_SD = 2.5
# A filter is given up when its weight falls below this share of the heaviest one's, and merged with that one when both say the
# same, within this share of a standard deviation.
_LEAST_LOG_WEIGHT = -15.0
_SAME_SHARE = 0.25
# Innovations count in full up to this many standard deviations.
_GATE_SD = 5.0
# The noise that innovations show is averaged over about this many samples.
_NOISE_MEMORY = 32.0
_SHARE_N, _SHARE_P = float(FULL_CHARGE_SHARES[QNS - QNB]), float(FULL_CHARGE_SHARES[QPS - QNB])

_PRIOR_SD_SHARE_Q = 0.25
_PRIOR_SD_R_OHM = 0.15
_HOUR_S = 3600.0
_NOISE_V = 0.005
# Successive innovations of a filter that follows its cell are uncorrelated, and its estimates stay where it said that they
# are. This many standard deviations away from either, the filter does not follow its cell.
_LIMIT_SD = 5.0
# The data must have narrowed a prior by this share of its width before a deviation from it says anything.
_LEAST_NARROWING = 0.2
# A full cell takes no more charge than this share of its own.
_SURPLUS_SHARE = 0.01


class _Bank(NamedTuple):
    """Filters side by side, each from its own part of the prior of q_mobile."""

    state: FloatArray  # of the copies of the model, shape (3 * filters + 1, 8); the last row is scratch
    mean: FloatArray  # shape (filters, 3)
    covariance: FloatArray  # shape (filters, 3, 3)
    log_weight: FloatArray  # shape (filters,); -inf: given up
    shown: FloatArray  # variance of the noise that the last innovation showed, V^2, shape (filters,)
    innovation: FloatArray  # the last one over its standard deviation, within the gate, shape (filters,)
    memory: FloatArray  # see _CURRENT and what follows

    def copy(self) -> _Bank:
        return _Bank(*(array.copy() for array in self))


class _Settings(NamedTuple):
    dt_s: float
    thermal: bool
    noise_V2: float  # variance of the voltage noise
    spare_V2: float  # what innovations may show beyond it before they contradict the stated mismatch
    q_growth: float  # of the variances of what a filter estimates, per s
    r_growth: float
    offset_growth: float
    least_q: float
    most_q: float
    least_r: float
    most_r: float


@njit(cache=True, error_model="numpy")
def _move(state: FloatArray, mean: FloatArray, m: int, q_change: float, r_change: float) -> None:
    # Another estimate is another past: the states go along with it, by their derivatives. For the charges that is exact.
    at = _COPIES * m
    for j in range(state.shape[1]):
        by_q, by_r = (state[at + 1, j] - state[at, j]) / _MORE_Q_C, (state[at + 2, j] - state[at, j]) / _MORE_R_OHM
        for copy in range(_COPIES):
            state[at + copy, j] += by_q * q_change + by_r * r_change
    mean[m, _Q] += q_change
    mean[m, _R] += r_change


@njit(cache=True, error_model="numpy")
def _least_q(surface_charge: float, share: float, q: float, per_q: float) -> float:
    # The smallest q' whose mole fraction, per_q * (surface_charge + share * (q' - q)) / q', lies inside the margins; that of a
    # full cell, per_q * share, does.
    full, amount = per_q * share, per_q * surface_charge
    low, high = MOLE_FRACTION_MARGIN, 1.0 - MOLE_FRACTION_MARGIN
    return q + max((low * q - amount) / (full - low), (amount - high * q) / (high - full))


@njit(cache=True, error_model="numpy")
def _keep_alive(state: FloatArray, mean: FloatArray, p: FloatArray, m: int, settings: _Settings, per_q: float) -> bool:
    # Raises q_mobile to what the charge drawn so far takes; tells whether the model cell has a voltage then.
    at, q = _COPIES * m, mean[m, _Q]
    least = max(_least_q(state[at, QNS], _SHARE_N, q, per_q), _least_q(state[at, QPS], _SHARE_P, q, per_q))
    if least > q:
        if p[m, _Q, _Q] == 0.0 or least > settings.most_q:
            return False
        _move(state, mean, m, least - q, 0.0)
    return True


@njit(cache=True, error_model="numpy")
def _predict(
    state: FloatArray,
    mean: FloatArray,
    p: FloatArray,
    m: int,
    current: float,
    duration: float,
    settings: _Settings,
    constants: FloatArray,
) -> None:
    steps = int(np.ceil(duration / settings.dt_s - 1e-6))
    for copy in range(_COPIES):
        q = mean[m, _Q] + (_MORE_Q_C if copy == 1 else 0.0)
        r_o = mean[m, _R] + (_MORE_R_OHM if copy == 2 else 0.0)
        at = _COPIES * m + copy
        for _ in range(steps):
            cell_step(state, at, current, q, r_o, duration / steps, settings.thermal, True, constants, 0, state, at)
    p[m, _Q, _Q] += settings.q_growth * duration
    p[m, _R, _R] += settings.r_growth * duration
    p[m, _OFFSET, _OFFSET] += settings.offset_growth * duration


@njit(cache=True, error_model="numpy")
def _correct(
    state: FloatArray,
    mean: FloatArray,
    p: FloatArray,
    log_weight: FloatArray,
    normalized: FloatArray,
    m: int,
    voltage: float,
    noise: float,
    settings: _Settings,
    packed: PackedConstants,
) -> float:
    # One measurement, to second order in q_mobile; returns the variance of the noise that it shows.
    at, spare, q = _COPIES * m, state.shape[0] - 1, mean[m, _Q]
    for j in range(state.shape[1]):
        state[spare, j] = 2.0 * state[at, j] - state[at + 1, j]
    here = cell_voltage(state, at, q, True, packed, 0)
    more_q = cell_voltage(state, at + 1, q + _MORE_Q_C, True, packed, 0)
    less_q = cell_voltage(state, spare, q - _MORE_Q_C, True, packed, 0)
    more_r = cell_voltage(state, at + 2, q, True, packed, 0)
    h = ((more_q - here) / _MORE_Q_C, (more_r - here) / _MORE_R_OHM, 1.0)
    # over the spread of q_mobile a curved voltage is higher by this in the mean, with twice its square as the variance
    bend = 0.5 * (more_q - 2.0 * here + less_q) / _MORE_Q_C**2 * p[m, _Q, _Q]
    ph = (
        p[m, 0, 0] * h[0] + p[m, 0, 1] * h[1] + p[m, 0, 2] * h[2],
        p[m, 1, 0] * h[0] + p[m, 1, 1] * h[1] + p[m, 1, 2] * h[2],
        p[m, 2, 0] * h[0] + p[m, 2, 1] * h[1] + p[m, 2, 2] * h[2],
    )
    explained = h[0] * ph[0] + h[1] * ph[1] + h[2] * ph[2] + 2.0 * bend * bend
    innovation = voltage - here - bend - mean[m, _OFFSET]
    variance = explained + noise
    sd = sqrt(variance)
    normalized[m] = min(max(innovation / sqrt(variance + settings.spare_V2), -_GATE_SD), _GATE_SD)
    beyond = max(abs(innovation) / sd / _GATE_SD, 1.0)
    # Huber's loss: quadratic up to the gate, linear beyond, where a larger variance stands for it
    loss = innovation * innovation / variance if beyond == 1.0 else _GATE_SD**2 * (2.0 * beyond - 1.0)
    log_weight[m] -= 0.5 * loss + log(sd)
    variance *= beyond * beyond
    gain = (ph[0] / variance, ph[1] / variance, ph[2] / variance)
    for j in range(3):
        for k in range(j + 1):
            # Joseph's form, multiplied out
            p[m, j, k] += gain[j] * gain[k] * variance - gain[j] * ph[k] - ph[j] * gain[k]
            p[m, k, j] = p[m, j, k]
    to_q = min(max(q + gain[_Q] * innovation, settings.least_q), settings.most_q)
    to_r = min(max(mean[m, _R] + gain[_R] * innovation, settings.least_r), settings.most_r)
    mean[m, _OFFSET] += gain[_OFFSET] * innovation
    _move(state, mean, m, to_q - q, to_r - mean[m, _R])
    return min(innovation * innovation, (_GATE_SD * sd) ** 2) - explained


@njit(cache=True, error_model="numpy")
def _reduce(mean: FloatArray, p: FloatArray, log_weight: FloatArray) -> int:
    # Makes weights relative to the heaviest filter's, gives up light ones and merges equal ones; returns the heaviest.
    best = 0
    for m in range(1, log_weight.shape[0]):
        if log_weight[m] > log_weight[best]:
            best = m
    total, heaviest = 1.0, log_weight[best]
    for m in range(log_weight.shape[0]):
        if m == best or log_weight[m] == -inf:
            continue
        log_weight[m] -= heaviest
        same = True
        for j in range(2):
            same &= abs(mean[m, j] - mean[best, j]) <= _SAME_SHARE * sqrt(p[best, j, j])
            same &= abs(p[m, j, j] - p[best, j, j]) <= _SAME_SHARE * p[best, j, j]
        if same or log_weight[m] < _LEAST_LOG_WEIGHT:
            total += exp(log_weight[m])
            log_weight[m] = -inf
    log_weight[best] = log(total)
    return best


@njit(cache=True, error_model="numpy")
def _take(
    bank: _Bank,
    voltage: float,
    current: float,
    duration: float,
    settings: _Settings,
    packed: PackedConstants,
    out: FloatArray,
    n: int,
) -> None:
    # One sample. Row n of out: q_mobile, r_o, their standard deviations, whether the model cell has a voltage, and how far
    # the correlation of successive innovations has been above 0, in standard deviations.
    state, mean, p, log_weight, shown, innovation, memory = bank
    per_q = packed.constants[0, FRACTION_PER_SHARE]
    noise = max(memory[_NOISE], settings.noise_V2)
    for m in range(log_weight.shape[0]):
        if log_weight[m] > -inf:
            if duration > 0.0:
                _predict(state, mean, p, m, memory[_CURRENT], duration, settings, packed.constants)
            if _keep_alive(state, mean, p, m, settings, per_q):
                shown[m] = _correct(state, mean, p, log_weight, innovation, m, voltage, noise, settings, packed)
                _keep_alive(state, mean, p, m, settings, per_q)
    best = _reduce(mean, p, log_weight)
    # moments of the mixture, about the heaviest filter
    total, q, r, qq, rr, square, normalized = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(log_weight.shape[0]):
        if log_weight[m] > -inf:
            weight, dq, dr = exp(log_weight[m]), mean[m, _Q] - mean[best, _Q], mean[m, _R] - mean[best, _R]
            total += weight
            q += weight * dq
            r += weight * dr
            qq += weight * (p[m, _Q, _Q] + dq * dq)
            rr += weight * (p[m, _R, _R] + dr * dr)
            square += weight * shown[m]
            normalized += weight * innovation[m]
    q, r = q / total, r / total
    normalized /= total
    memory[_CURRENT] = current
    memory[_NOISE] = max(memory[_NOISE] + (square / total - memory[_NOISE]) / _NOISE_MEMORY, 0.0)
    memory[_PRODUCTS] = _PRODUCTS_MEMORY * memory[_PRODUCTS] + normalized * memory[_LAST]
    memory[_VARIANCE] = _PRODUCTS_MEMORY**2 * memory[_VARIANCE] + 1.0
    memory[_TREND] = max(memory[_TREND], memory[_PRODUCTS] / sqrt(memory[_VARIANCE]))
    memory[_LAST] = _TREND_MEMORY * memory[_LAST] + sqrt(1.0 - _TREND_MEMORY**2) * normalized
    out[n, 0] = mean[best, _Q] + q
    out[n, 1] = mean[best, _R] + r
    out[n, 2] = sqrt(qq / total - q * q)
    out[n, 3] = sqrt(rr / total - r * r)
    out[n, 4] = 1.0 if _keep_alive(state, mean, p, best, settings, per_q) else 0.0
    reach = _LIMIT_SD * out[n, 3]
    if reach > 0.0:
        memory[_LEAST_R] = max(memory[_LEAST_R], out[n, 1] - reach)
        memory[_MOST_R] = min(memory[_MOST_R], out[n, 1] + reach)
        if not memory[_LEAST_R] <= out[n, 1] <= memory[_MOST_R]:
            memory[_TREND] = inf
    out[n, 5] = memory[_TREND]


@njit(cache=True, error_model="numpy")
def _follow(
    bank: _Bank,
    voltage: FloatArray,
    current: FloatArray,
    duration: FloatArray,
    settings: _Settings,
    packed: PackedConstants,
    out: FloatArray,
) -> None:
    for n in range(voltage.shape[0]):
        _take(bank, voltage[n], current[n], duration[n], settings, packed, out, n)


class ExtendedKalmanFilter(OnlineEstimator):
    """
    Follows (q_mobile, r_o) along a discharge that starts with a fully charged cell at rest: one estimate a sample, with its
    standard deviation.

    *State.* Given the current, the state of the model is a function of its two parameters; the charges are even linear in
    ``q_mobile``, with slope ``FULL_CHARGE_SHARES``. So the covariance of the augmented state (states and parameters) has the
    rank of the parameters from the start and keeps it: the filter carries the covariance of (q_mobile, r_o, offset) and the
    derivatives of the state with respect to them, obtained from copies of the model beside it. When an estimate moves the
    state moves with it. A parameter not searched for has variance zero.

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
        self._settings = _Settings(
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
        self._fresh = self._bank_of(q, q_sd, r_o, r_o_sd, offset_sd_V)
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

    def _bank_of(self, q: float, q_sd: float, r_o: float, r_o_sd: float, offset_sd_V: float) -> _Bank:
        half = int(np.ceil(_REACH_SD * q_sd / (_WIDEST_SHARE * q))) if q_sd > _WIDEST_SHARE * q else 0
        deviations = np.linspace(-_REACH_SD, _REACH_SD, 2 * half + 1) if half else np.zeros(1)
        means, low = q + q_sd * deviations, self.bounds["q_mobile"]
        inside = (means >= low[0]) & (means <= low[1])
        means, deviations = means[inside], deviations[inside]
        filters = len(means)
        covariance = np.zeros((filters, 3, 3))
        covariance[:, _Q, _Q] = (_REACH_SD / half * q_sd if half else q_sd) ** 2
        covariance[:, _R, _R] = r_o_sd**2
        covariance[:, _OFFSET, _OFFSET] = offset_sd_V**2
        state = np.zeros((_COPIES * filters + 1, STATE_SIZE))
        state[:-1] = initial_state(np.repeat(means, _COPIES), self.cell)
        state[1:-1:_COPIES, QNB:] += _MORE_Q_C * FULL_CHARGE_SHARES
        memory = np.zeros(8)
        memory[_LEAST_R:] = [-inf, inf]
        mean = np.column_stack([means, np.full(filters, r_o), np.zeros(filters)])
        return _Bank(state, mean, covariance, -0.5 * deviations**2, np.zeros(filters), np.zeros(filters), memory)

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
        drawn_C = self._drawn_C + since_s * float(self._bank.memory[_CURRENT])
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

    def _run(self, bank: _Bank, samples: FloatArray) -> FloatArray:
        out = np.empty((samples.shape[1], 6))
        _follow(bank, samples[0], samples[1], samples[2], self._settings, self.cell.packed, out)
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
        conditions.append((trend > _LIMIT_SD, MISFIT))
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
