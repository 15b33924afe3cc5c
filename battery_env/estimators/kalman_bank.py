"""A bank of Kalman filters, each from its own part of the prior of ``q_mobile``, compiled (numba)."""

from __future__ import annotations

from math import exp, inf, isnan, log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import (
    QNB,
    QNS,
    QPS,
    STATE_SIZE,
    TB,
    CellParameters,
    PackedConstants,
    initial_state,
    rest_shares,
)
from battery_env.electrochemistry.kernels import MOLE_FRACTION_MARGIN, cell_voltage
from battery_env.electrochemistry.tangents import (
    BY_Q,
    BY_R,
    PolynomialDerivatives,
    least_q,
    step_with_tangents,
    voltage_curvature,
    voltage_tangents,
)

#: Standard deviations. Innovations count in full within the gate. A filter whose successive innovations are correlated, whose
#: estimate leaves the range that it stated, or whose offset is beyond the stated one, by more than the limit does not follow
#: its cell.
GATE_SD, LIMIT_SD = 5.0, 5.0

# What a filter estimates: q_mobile (C), r_o (ohm) and the offset of the voltage (V).
_Q, _R, _OFFSET = range(3)
# What the bank remembers: the current since the last sample (A), the mean of the noise that innovations showed (V^2), the last
# innovations (of the mixture, normalized), the sum of the products of each with those before it and its variance, both over
# about so many samples, how many standard deviations that sum has been above 0 at most, and the range that r_o cannot leave
# if what the filter said about it before was right (q_mobile can: at the knee the error of the model moves it), and the
# variance that the offset may have by now (V^2).
_CURRENT, _NOISE, _LAST, _PRODUCTS, _VARIANCE, _TREND, _LEAST_R, _MOST_R, _OFFSET_V2 = range(9)
_TREND_MEMORY, _PRODUCTS_MEMORY = 0.8, 0.999
# A filter is linear over its standard deviation of q_mobile: a wider prior is divided among filters this far apart (as a
# share of its mean), over so many standard deviations to each side.
_WIDEST_SHARE = 0.08
_REACH_SD = 2.5
# A filter is given up when its weight falls below this share of the heaviest one's, and merged with that one when both say the
# same, within this share of a standard deviation.
_LEAST_LOG_WEIGHT = -15.0
_SAME_SHARE = 0.25
# Of all errors as large as the one that is stated the worst moves q_mobile as far as least squares state. On discharges of the
# bundled cell B0005 the filter is about half as far from least squares, as it is on those of B0006.
_MISMATCH_SHARE = 0.5
# The noise that innovations show is averaged over about this many samples.
_NOISE_MEMORY = 32.0
#: How many numbers a bank says after each sample, see :func:`follow`.
OUT_SIZE = 8

_compiled = njit(cache=True, error_model="numpy")
# a call passes all arrays of a bank, which takes longer than the arithmetic
_inlined = njit(cache=True, error_model="numpy", forceinline=True)


class Settings(NamedTuple):
    """
    What a bank is told.

    :param dt_s: longest time step of the model, s
    :param thermal: whether the temperature of the model moves
    :param noise_V2: variance of the voltage noise, V^2
    :param spare_V2: variance that innovations may show beyond it before they contradict the stated mismatch, V^2
    :param mismatch_V2: variance of the error of the model, V^2
    :param q_prior: variance of ``q_mobile`` before the discharge, 0 where it is held, C^2
    :param r_prior: of ``r_o``, ohm^2
    :param q_growth: growth of the variance of ``q_mobile``, C^2/s
    :param r_growth: growth of the variance of ``r_o``, ohm^2/s
    :param offset_growth: growth of the variance of the offset, V^2/s
    :param least_q: lower bound of ``q_mobile``, C
    :param most_q: upper bound of ``q_mobile``, C
    :param least_r: lower bound of ``r_o``, ohm
    :param most_r: upper bound of ``r_o``, ohm
    """

    dt_s: float
    thermal: bool
    noise_V2: float
    spare_V2: float
    mismatch_V2: float
    q_prior: float
    r_prior: float
    q_growth: float
    r_growth: float
    offset_growth: float
    least_q: float
    most_q: float
    least_r: float
    most_r: float


class Bank(NamedTuple):
    """
    Filters side by side, each with a model of its own at its estimate.

    :param state: of the models, shape (filters, 8)
    :param tangents: derivatives of the states with respect to ``q_mobile`` and ``r_o``, shape (filters, 2, 8)
    :param mean: estimates of ``q_mobile``, ``r_o`` and the offset, shape (filters, 3)
    :param covariance: their covariance, shape (filters, 3, 3)
    :param log_weight: logarithm of the weight, -inf for a filter that is given up, shape (filters,)
    :param shown: variance of the noise that the last innovation showed, V^2, shape (filters,)
    :param innovation: the last one over its standard deviation, within the gate, shape (filters,)
    :param expected_V: voltage of the model at the last sample before it was taken in, with the offset, V, shape (filters,)
    :param seen: what the voltage told so far: sums over the charge drawn of the products of its derivatives with respect to
        ``q_mobile`` and ``r_o`` (V^2/C, V A, A^2 C), and that charge (C), shape (filters, 4)
    :param memory: what the bank remembers, shape (9,)
    """

    state: FloatArray
    tangents: FloatArray
    mean: FloatArray
    covariance: FloatArray
    log_weight: FloatArray
    shown: FloatArray
    innovation: FloatArray
    expected_V: FloatArray
    seen: FloatArray
    memory: FloatArray

    @classmethod
    def of(
        cls,
        means: tuple[float, float],
        sds: tuple[float, float, float],
        settings: Settings,
        cell: CellParameters,
        soc: float = 1.0,
    ) -> Bank:
        """The filters that a prior takes, before the first sample of a cell at rest."""
        (q, r_o), sd_q = means, sds[_Q]
        half = int(np.ceil(_REACH_SD * sd_q / (_WIDEST_SHARE * q))) if sd_q > _WIDEST_SHARE * q else 0
        deviations = np.linspace(-_REACH_SD, _REACH_SD, 2 * half + 1) if half else np.zeros(1)
        q_mobile = q + sd_q * deviations
        inside = (q_mobile >= settings.least_q) & (q_mobile <= settings.most_q)
        q_mobile, deviations = q_mobile[inside], deviations[inside]
        filters = len(q_mobile)
        tangents = np.zeros((filters, 2, STATE_SIZE))
        tangents[:, BY_Q, QNB:] = rest_shares(soc)
        own_sds = [_REACH_SD / half * sd_q if half else sd_q, *sds[1:]]
        memory = np.zeros(9)
        memory[_LEAST_R:] = [-inf, inf, sds[_OFFSET] ** 2]
        return cls(
            state=initial_state(q_mobile, cell, soc),
            tangents=tangents,
            mean=np.column_stack([q_mobile, np.full(filters, r_o), np.zeros(filters)]),
            covariance=np.tile(np.diag(np.square(own_sds)), (filters, 1, 1)),
            log_weight=-0.5 * deviations**2,
            shown=np.zeros(filters),
            innovation=np.zeros(filters),
            expected_V=np.zeros(filters),
            seen=np.zeros((filters, 4)),
            memory=memory,
        )

    def copy(self) -> Bank:
        """A bank that goes its own way."""
        return Bank(*(array.copy() for array in self))

    @property
    def current_A(self) -> float:
        """The current since the last sample, A."""
        return float(self.memory[_CURRENT])


@_inlined
def _move(bank: Bank, m: int, q_change: float, r_change: float) -> None:
    # Another estimate is another past: the state goes along with it, by its tangents. For the charges that is exact.
    state, tangents = bank.state, bank.tangents
    for j in range(STATE_SIZE):
        state[m, j] += tangents[m, BY_Q, j] * q_change + tangents[m, BY_R, j] * r_change
    bank.mean[m, _Q] += q_change
    bank.mean[m, _R] += r_change


@_inlined
def _keep_alive(bank: Bank, m: int, settings: Settings, constants: FloatArray) -> bool:
    # Raises q_mobile to what the charge drawn so far takes; tells whether the model cell has a voltage then.
    q, least = bank.mean[m, _Q], 0.0
    for surface in (QNS, QPS):
        slope = bank.tangents[m, BY_Q, surface]
        least = max(least, least_q(bank.state[m, surface], slope, q, MOLE_FRACTION_MARGIN, constants))
    if least > q:
        if bank.covariance[m, _Q, _Q] == 0.0 or least > settings.most_q:
            return False
        _move(bank, m, least - q, 0.0)
    return True


@_inlined
def _predict(bank: Bank, m: int, duration: float, settings: Settings, constants: FloatArray) -> None:
    state, tangents, current, p = bank.state, bank.tangents, bank.memory[_CURRENT], bank.covariance
    q, r_o = bank.mean[m, _Q], bank.mean[m, _R]
    steps = int(np.ceil(duration / settings.dt_s - 1e-6))
    for _ in range(steps):
        step_with_tangents(state, tangents, m, current, q, r_o, duration / steps, settings.thermal, True, constants)
    p[m, _Q, _Q] += settings.q_growth * duration
    p[m, _R, _R] += settings.r_growth * duration
    p[m, _OFFSET, _OFFSET] += settings.offset_growth * duration


@_inlined
def _mismatch_sd(bank: Bank, m: int, settings: Settings) -> float:
    # What the error of the model leaves open of q_mobile, however many samples there are: the filter takes the error for noise
    # that is new with each of them. As in least squares it is one error common to the discharge.
    qq, qr, rr, total_C = bank.seen[m]
    if settings.mismatch_V2 == 0.0 or settings.q_prior == 0.0 or total_C == 0.0:
        return 0.0
    share = 1.0 / (_MISMATCH_SHARE**2 * settings.mismatch_V2 * total_C)
    qq = qq * share + 1.0 / settings.q_prior
    if settings.r_prior == 0.0:
        return sqrt(1.0 / qq)
    qr, rr = qr * share, rr * share + 1.0 / settings.r_prior
    return sqrt(rr / (qq * rr - qr * qr))


@_inlined
def _correct(
    bank: Bank,
    m: int,
    voltage: float,
    duration: float,
    noise: float,
    settings: Settings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
) -> None:
    # One measurement, to second order in q_mobile
    state, tangents, mean, p = bank.state, bank.tangents, bank.mean, bank.covariance
    q, r_o = mean[m, _Q], mean[m, _R]
    by_q, by_r = voltage_tangents(state, tangents, m, q, settings.thermal, packed, derivatives)
    h = (by_q, by_r, 1.0)
    # over the spread of q_mobile a curved voltage is higher by this in the mean, with twice its square as the variance
    bend = 0.5 * voltage_curvature(state, tangents, m, q, packed, derivatives) * p[m, _Q, _Q]
    ph = (
        p[m, 0, 0] * h[0] + p[m, 0, 1] * h[1] + p[m, 0, 2] * h[2],
        p[m, 1, 0] * h[0] + p[m, 1, 1] * h[1] + p[m, 1, 2] * h[2],
        p[m, 2, 0] * h[0] + p[m, 2, 1] * h[1] + p[m, 2, 2] * h[2],
    )
    explained = h[0] * ph[0] + h[1] * ph[1] + h[2] * ph[2] + 2.0 * bend * bend
    innovation = voltage - cell_voltage(state, m, q, True, packed) - bend - mean[m, _OFFSET]
    bank.expected_V[m] = voltage - innovation
    variance = explained + noise
    sd = sqrt(variance)
    bank.innovation[m] = min(max(innovation / sqrt(variance + settings.spare_V2), -GATE_SD), GATE_SD)
    bank.shown[m] = min(innovation * innovation, (GATE_SD * sd) ** 2) - explained
    beyond = max(abs(innovation) / sd / GATE_SD, 1.0)
    # Huber's loss: quadratic up to the gate, linear beyond, where a larger variance stands for it
    loss = innovation * innovation / variance if beyond == 1.0 else GATE_SD**2 * (2.0 * beyond - 1.0)
    bank.log_weight[m] -= 0.5 * loss + log(sd)
    variance *= beyond * beyond
    gain = (ph[0] / variance, ph[1] / variance, ph[2] / variance)
    for j in range(3):
        for k in range(j + 1):
            # Joseph's form, multiplied out
            p[m, j, k] += gain[j] * gain[k] * variance - gain[j] * ph[k] - ph[j] * gain[k]
            p[m, k, j] = p[m, j, k]
    charge = abs(bank.memory[_CURRENT]) * duration
    seen = bank.seen[m]
    seen[0] += charge * by_q * by_q
    seen[1] += charge * by_q * by_r
    seen[2] += charge * by_r * by_r
    seen[3] += charge
    to_q = min(max(q + gain[_Q] * innovation, settings.least_q), settings.most_q)
    to_r = min(max(r_o + gain[_R] * innovation, settings.least_r), settings.most_r)
    mean[m, _OFFSET] += gain[_OFFSET] * innovation
    _move(bank, m, to_q - q, to_r - r_o)


@_compiled
def _reduce(bank: Bank) -> int:
    # Makes weights relative to the heaviest filter's, gives up light ones and merges equal ones; returns the heaviest.
    mean, p, log_weight, best = bank.mean, bank.covariance, bank.log_weight, 0
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


@_inlined
def _take(
    bank: Bank,
    voltage: float,
    current: float,
    duration: float,
    temperature: float,
    settings: Settings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    out: FloatArray,
    n: int,
) -> None:
    # One sample, into row n of out (see follow)
    mean, p, log_weight, memory, constants = bank.mean, bank.covariance, bank.log_weight, bank.memory, packed.constants
    noise = max(memory[_NOISE], settings.noise_V2)
    before = 0
    for m in range(1, log_weight.shape[0]):
        if log_weight[m] > log_weight[before]:
            before = m
    for m in range(log_weight.shape[0]):
        if log_weight[m] > -inf:
            if duration > 0.0:
                _predict(bank, m, duration, settings, constants)
            if not isnan(temperature):
                # measured, it is no function of the parameters any more
                bank.state[m, TB] = temperature
                bank.tangents[m, BY_Q, TB] = bank.tangents[m, BY_R, TB] = 0.0
            if _keep_alive(bank, m, settings, constants):
                if not isnan(voltage):
                    _correct(bank, m, voltage, duration, noise, settings, packed, derivatives)
                    _keep_alive(bank, m, settings, constants)
    best = _reduce(bank)
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
            square += weight * bank.shown[m]
            normalized += weight * bank.innovation[m]
    q, r = q / total, r / total
    normalized /= total
    memory[_CURRENT] = current
    if not isnan(voltage):
        memory[_NOISE] = max(memory[_NOISE] + (square / total - memory[_NOISE]) / _NOISE_MEMORY, 0.0)
        memory[_PRODUCTS] = _PRODUCTS_MEMORY * memory[_PRODUCTS] + normalized * memory[_LAST]
        memory[_VARIANCE] = _PRODUCTS_MEMORY**2 * memory[_VARIANCE] + 1.0
        memory[_TREND] = max(memory[_TREND], memory[_PRODUCTS] / sqrt(memory[_VARIANCE]))
        memory[_LAST] = _TREND_MEMORY * memory[_LAST] + sqrt(1.0 - _TREND_MEMORY**2) * normalized
    out[n, 0] = mean[best, _Q] + q
    out[n, 1] = mean[best, _R] + r
    out[n, 2] = sqrt(qq / total - q * q)
    out[n, 3] = sqrt(rr / total - r * r)
    out[n, 4] = 1.0 if _keep_alive(bank, best, settings, constants) else 0.0
    memory[_OFFSET_V2] += settings.offset_growth * duration
    if mean[best, _OFFSET] ** 2 > LIMIT_SD**2 * memory[_OFFSET_V2]:
        memory[_TREND] = inf
    reach = LIMIT_SD * out[n, 3]
    if reach > 0.0:
        memory[_LEAST_R] = max(memory[_LEAST_R], out[n, 1] - reach)
        memory[_MOST_R] = min(memory[_MOST_R], out[n, 1] + reach)
        if not memory[_LEAST_R] <= out[n, 1] <= memory[_MOST_R]:
            memory[_TREND] = inf
    out[n, 5] = memory[_TREND]
    out[n, 6] = bank.expected_V[before]  # by the filter that did not know yet
    out[n, 7] = _mismatch_sd(bank, best, settings)


@_compiled
def follow(
    bank: Bank,
    voltage: FloatArray,
    current: FloatArray,
    duration: FloatArray,
    temperature: FloatArray,
    settings: Settings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    out: FloatArray,
) -> None:
    """Take in samples; unchecked."""
    for n in range(voltage.shape[0]):
        _take(bank, voltage[n], current[n], duration[n], temperature[n], settings, packed, derivatives, out, n)
