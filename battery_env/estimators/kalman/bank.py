"""A bank of Kalman filters, each from its own part of the prior of ``q_mobile``, compiled (numba)."""

from __future__ import annotations

from math import exp, hypot, inf, isnan, log, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled, inlined
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
from battery_env.estimators.diagnosis.evidence import unseen_C
from battery_env.estimators.diagnosis.faults import KEPT, MOST_NOISE_SD, Row
from battery_env.estimators.kalman.state import FILTER, OFFSET, FilterSettings, Q, R
from battery_env.estimators.reasons import Reason
from battery_env.estimators.verdict import (
    MISMATCH_MARGIN,
    PRIOR_LIMIT_SD,
    is_plausible,
    judge,
    note,
    note_about,
)

#: Standard deviations. Innovations count in full within the gate. A filter whose successive innovations are correlated, whose
#: estimate leaves the range that it stated, or whose offset is beyond the stated one, by more than the limit does not follow
#: its cell.
GATE_SD, LIMIT_SD = 5.0, 5.0

# The last innovations, and the products of each one with those before it, are averaged with these weights of what was.
_TREND_MEMORY, _PRODUCTS_MEMORY = 0.8, 0.999
# A filter is linear over its standard deviation of q_mobile: a wider prior is divided among filters this far apart (as a
# share of its mean), to each side as far as it would not contradict the record.
_WIDEST_SHARE = 0.08
# Larger cells are rare, not impossible: their filters lie one width of the prior apart, as a share, and their weights fall
# with this power of the size.
_RARITY_OF_SIZE = 3.0
# A filter is given up when its weight falls below this share of the heaviest one's, and merged with that one when both say the
# same, within this share of a standard deviation.
_LEAST_LOG_WEIGHT = -15.0
_SAME_SHARE = 0.25
# The data must have narrowed a prior by this share of its width before a deviation from it says anything.
_LEAST_NARROWING = 0.2


def filters_of_prior(
    means: tuple[float, float],
    sds: tuple[float, float, float],
    bounds_C: tuple[float, float],
    cell: CellParameters,
    soc: float,
    is_size_known: bool,
) -> NDArray[np.void]:
    """The filters that a prior takes, before the first sample of a cell at rest."""
    (q, r_o), share = means, sds[Q] / means[Q]
    half = int(np.ceil(PRIOR_LIMIT_SD * share / _WIDEST_SHARE)) if share > _WIDEST_SHARE else 0
    deviations = np.linspace(-PRIOR_LIMIT_SD, PRIOR_LIMIT_SD, 2 * half + 1) if half else np.zeros(1)
    q_mobile = q * (1.0 + share * deviations)
    sd_q = np.full(len(deviations), PRIOR_LIMIT_SD / half * sds[Q] if half else sds[Q])
    size, log_weight = np.ones(len(deviations)), -0.5 * deviations**2
    if half and not is_size_known:
        log_size = np.arange(np.log1p(PRIOR_LIMIT_SD * share), -_LEAST_LOG_WEIGHT / _RARITY_OF_SIZE, share)
        larger = np.exp(log_size)
        q_mobile, sd_q = np.append(q_mobile, q * larger), np.append(sd_q, sds[Q] * larger)
        size, log_weight = np.append(size, larger), np.append(log_weight, -_RARITY_OF_SIZE * log_size)
    inside = (q_mobile >= bounds_C[0]) & (q_mobile <= bounds_C[1])
    q_mobile, sd_q, size, log_weight = q_mobile[inside], sd_q[inside], size[inside], log_weight[inside]
    filters = np.zeros(len(q_mobile), FILTER)
    filters["state"][:, 0] = initial_state(q_mobile, cell, soc)
    filters["tangents"][:, 0, BY_Q, QNB:] = rest_shares(soc)
    # a larger cell has less resistance
    filters["mean"][:, Q], filters["mean"][:, R] = q_mobile, r_o / size
    for number, sd in ((Q, sd_q), (R, sds[R] / size), (OFFSET, sds[OFFSET])):
        filters["covariance"][:, number, number] = np.square(sd)
    filters["log_weight"] = log_weight
    return filters


@inlined
def _move(one: Row, q_change: float, r_change: float) -> None:
    # Another estimate is another past: the state goes along with it, by its tangents. For the charges that is exact.
    state, tangents, mean = one.state, one.tangents, one.mean
    for j in range(STATE_SIZE):
        state[0, j] += tangents[0, BY_Q, j] * q_change + tangents[0, BY_R, j] * r_change
    mean[Q] += q_change
    mean[R] += r_change


@inlined
def _keep_alive(one: Row, settings: FilterSettings, constants: FloatArray) -> bool:
    # Raises q_mobile to what the charge drawn so far takes; tells whether the model cell has a voltage then.
    q, least = one.mean[Q], 0.0
    for surface in (QNS, QPS):
        slope = one.tangents[0, BY_Q, surface]
        least = max(least, least_q(one.state[0, surface], slope, q, MOLE_FRACTION_MARGIN, constants))
    if least > q:
        if one.covariance[Q, Q] == 0.0 or least > settings.bounds[Q][1]:
            return False
        _move(one, least - q, 0.0)
    return True


@inlined
def _predict(one: Row, current: float, duration: float, settings: FilterSettings, constants: FloatArray) -> None:
    q, r_o, p = one.mean[Q], one.mean[R], one.covariance
    steps = int(np.ceil(duration / settings.dt_s - 1e-6))
    for _ in range(steps):
        step_with_tangents(one.state, one.tangents, current, q, r_o, duration / steps, settings.thermal, True, constants)
    p[Q, Q] += settings.growth[Q] * duration
    p[R, R] += settings.growth[R] * duration
    p[OFFSET, OFFSET] += settings.offset_growth * duration


@inlined
def _mismatch_V2(evidence: Row, settings: FilterSettings) -> float:
    # The model is no better than the voltage at rest shows, beyond noise.
    start_V2 = (evidence.start.first_V - evidence.model_V) ** 2 - MOST_NOISE_SD**2 * settings.noise_V2
    return start_V2 if start_V2 > settings.mismatch_V2 else settings.mismatch_V2


@inlined
def _common_error_sd(one: Row, settings: FilterSettings, mismatch_V2: float) -> float:
    # What an error of the model that is common to the discharge leaves open of q_mobile, without its prior, however many
    # samples there are: as much as least squares state. Theirs is the worst error of the stated mean square. Once the knee is
    # seen, almost all of that lies on the few samples there, but an error beyond the margin would show: it is no larger.
    information, (q_prior, r_prior) = one.information, settings.variance
    if mismatch_V2 == 0.0 or q_prior == 0.0 or information.charge_C == 0.0:
        return 0.0
    charge_C, own_qq = information.charge_C, information.qq
    if r_prior > 0.0:
        own_qq -= information.qr * information.qr / (information.rr + mismatch_V2 * charge_C / r_prior)
    if not own_qq > 0.0:
        return inf
    spread = min(1.0, MISMATCH_MARGIN * information.q / sqrt(information.charge_C * information.qq))
    return spread * sqrt(mismatch_V2 * charge_C / own_qq)


@inlined
def _resistive_error_sd(one: Row, mismatch_V2: float) -> float:
    # And of r_o: an error that goes with the current is no offset, which a load that varies would tell from it.
    information = one.information
    return sqrt(mismatch_V2 * information.charge_C / information.rr) if information.rr > 0.0 else 0.0


@inlined
def _r_by_share(one: Row) -> float:
    # What r_o makes up for a share of q_mobile that was drawn at first and not counted, beside what q_mobile makes up for.
    information = one.information
    both = information.rr * information.qq - information.qr * information.qr
    by_start = abs(information.by_r * information.qq - information.by_q * information.qr)
    return one.mean[Q] ** 2 * by_start / both if both > 0.0 else 0.0


@inlined
def _add_to(information: Row, charge: float, by_q: float, by_r: float) -> None:
    # What a sample tells, by the charge that flowed before it
    information.q += charge * abs(by_q)
    information.qq += charge * by_q * by_q
    information.qr += charge * by_q * by_r
    information.rr += charge * by_r * by_r
    information.charge_C += charge
    if charge > 0.0:
        information.by_q += charge * by_q * by_q / information.charge_C
        information.by_r += charge * by_q * by_r / information.charge_C


@inlined
def _correct(
    one: Row,
    voltage: float,
    charge: float,
    noise: float,
    settings: FilterSettings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
) -> None:
    # One measurement, to second order in q_mobile; charge: what flowed since the last one
    state, tangents, mean, p = one.state, one.tangents, one.mean, one.covariance
    q, r_o = mean[Q], mean[R]
    by_q, by_r = voltage_tangents(state, tangents, q, settings.thermal, packed, derivatives)
    h = (by_q, by_r, 1.0)
    # over the spread of q_mobile a curved voltage is higher by this in the mean, with twice its square as the variance
    bend = 0.5 * voltage_curvature(state, tangents, q, packed, derivatives) * p[Q, Q]
    ph = (
        p[0, 0] * h[0] + p[0, 1] * h[1] + p[0, 2] * h[2],
        p[1, 0] * h[0] + p[1, 1] * h[1] + p[1, 2] * h[2],
        p[2, 0] * h[0] + p[2, 1] * h[1] + p[2, 2] * h[2],
    )
    explained = h[0] * ph[0] + h[1] * ph[1] + h[2] * ph[2] + 2.0 * bend * bend
    innovation = voltage - cell_voltage(state, 0, q, True, packed) - bend - mean[OFFSET]
    one.expected_V = voltage - innovation
    variance = explained + noise
    sd = sqrt(variance)
    # innovations may show more than the stated mismatch before they contradict it
    spare_V2 = (MISMATCH_MARGIN**2 - 1.0) * settings.mismatch_V2
    one.innovation = min(max(innovation / sqrt(variance + spare_V2), -GATE_SD), GATE_SD)
    one.noise_V2 = min(innovation * innovation, (GATE_SD * sd) ** 2) - explained
    beyond = max(abs(innovation) / sd / GATE_SD, 1.0)
    # Huber's loss: quadratic up to the gate, linear beyond, where a larger variance stands for it
    loss = innovation * innovation / variance if beyond == 1.0 else GATE_SD**2 * (2.0 * beyond - 1.0)
    one.log_weight -= 0.5 * loss + log(sd)
    variance *= beyond * beyond
    gain = (ph[0] / variance, ph[1] / variance, ph[2] / variance)
    for j in range(3):
        for k in range(j + 1):
            # Joseph's form, multiplied out
            p[j, k] += gain[j] * gain[k] * variance - gain[j] * ph[k] - ph[j] * gain[k]
            p[k, j] = p[j, k]
    information = one.information
    _add_to(information, charge, by_q, by_r)
    (least_q_C, most_q_C), (least_r, most_r) = settings.bounds
    to_q = min(max(q + gain[Q] * innovation, least_q_C), most_q_C)
    to_r = min(max(r_o + gain[R] * innovation, least_r), most_r)
    mean[OFFSET] += gain[OFFSET] * innovation
    # along the curve of the voltage over the state of charge: with a smaller q_mobile the record comes further
    if information.qq > 0.0:
        scale = exp(-0.5 * (1.0 + information.charge_C * by_q * by_q / information.qq) * (to_q / q - 1.0))
        information.q *= scale
        information.qq *= scale * scale
        information.qr *= scale
        information.by_q *= scale * scale
        information.by_r *= scale
    _move(one, to_q - q, to_r - r_o)


@inlined
def _heaviest(filters: Row) -> int:
    best = 0
    for m in range(1, len(filters)):
        if filters[m].log_weight > filters[best].log_weight:
            best = m
    return best


@compiled
def _reduce(filters: Row) -> int:
    # Makes weights relative to the heaviest filter's, gives up light ones and merges equal ones; returns the heaviest.
    best = _heaviest(filters)
    heaviest, total = filters[best], 1.0
    mean, p, log_weight = heaviest.mean, heaviest.covariance, heaviest.log_weight
    for m in range(len(filters)):
        one = filters[m]
        if m == best or one.log_weight == -inf:
            continue
        one.log_weight -= log_weight
        same = True
        for j in range(2):
            same &= abs(one.mean[j] - mean[j]) <= _SAME_SHARE * sqrt(p[j, j])
            same &= abs(one.covariance[j, j] - p[j, j]) <= _SAME_SHARE * p[j, j]
        if same or one.log_weight < _LEAST_LOG_WEIGHT:
            total += exp(one.log_weight)
            one.log_weight = -inf
    heaviest.log_weight = log(total)
    return best


@inlined
def _mix(bank: Row, filters: Row, best: int, voltage: float) -> None:
    # Moments of the mixture, about the heaviest filter, and what its innovations show
    middle = filters[best].mean
    total, q, r, qq, rr, square, normalized = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(len(filters)):
        one = filters[m]
        if one.log_weight > -inf:
            weight, dq, dr = exp(one.log_weight), one.mean[Q] - middle[Q], one.mean[R] - middle[R]
            total += weight
            q += weight * dq
            r += weight * dr
            qq += weight * (one.covariance[Q, Q] + dq * dq)
            rr += weight * (one.covariance[R, R] + dr * dr)
            square += weight * one.noise_V2
            normalized += weight * one.innovation
    q, r = q / total, r / total
    normalized /= total
    if not isnan(voltage):
        bank.noise_V2 = max(bank.noise_V2 + (square / total - bank.noise_V2) / KEPT, 0.0)
        bank.products = _PRODUCTS_MEMORY * bank.products + normalized * bank.last
        bank.variance = _PRODUCTS_MEMORY**2 * bank.variance + 1.0
        bank.trend_sd = max(bank.trend_sd, bank.products / sqrt(bank.variance))
        bank.last = _TREND_MEMORY * bank.last + sqrt(1.0 - _TREND_MEMORY**2) * normalized
    bank.mean[Q], bank.mean[R] = middle[Q] + q, middle[R] + r
    bank.sd[Q], bank.sd[R] = sqrt(qq / total - q * q), sqrt(rr / total - r * r)


@inlined
def _doubt(bank: Row, offset_V: float) -> None:
    # An offset beyond the stated one, and an r_o out of the range that was stated before, contradict the filter
    if offset_V**2 > LIMIT_SD**2 * bank.offset_V2:
        bank.trend_sd = inf
    r_o, reach = bank.mean[R], LIMIT_SD * bank.sd[R]
    if reach > 0.0:
        bank.least_r, bank.most_r = max(bank.least_r, r_o - reach), min(bank.most_r, r_o + reach)
        if not bank.least_r <= r_o <= bank.most_r:
            bank.trend_sd = inf


@inlined
def take(
    cell: Row,
    filters: Row,
    sample: Row,
    voltage: float,
    settings: FilterSettings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
) -> None:
    """Take in one sample of a cell, of which this voltage counts; unchecked."""
    bank, duration, temperature = cell.bank, sample.dt_s, sample.temperature_K
    constants, current = packed.constants, cell.evidence.current_A
    noise, charge = max(bank.noise_V2, settings.noise_V2), abs(current) * duration
    before = _heaviest(filters)
    for m in range(len(filters)):
        one = filters[m]
        if one.log_weight > -inf:
            if duration > 0.0:
                _predict(one, current, duration, settings, constants)
            if not isnan(temperature):
                # measured, it is no function of the parameters any more
                one.state[0, TB] = temperature
                one.tangents[0, BY_Q, TB] = one.tangents[0, BY_R, TB] = 0.0
            if _keep_alive(one, settings, constants):
                if not isnan(voltage):
                    _correct(one, voltage, charge, noise, settings, packed, derivatives)
                    _keep_alive(one, settings, constants)
    best = _reduce(filters)
    _mix(bank, filters, best, voltage)
    bank.has_voltage = _keep_alive(filters[best], settings, constants)
    bank.offset_V2 += settings.offset_growth * duration
    _doubt(bank, filters[best].mean[OFFSET])
    bank.expected_V = filters[before].expected_V  # by the filter that did not know yet
    mismatch_V2 = _mismatch_V2(cell.evidence, settings)
    bank.common_sd[Q] = _common_error_sd(filters[best], settings, mismatch_V2)
    bank.common_sd[R] = _resistive_error_sd(filters[best], mismatch_V2)
    bank.r_by_share = _r_by_share(filters[best])


@compiled
def conclude(cell: Row, settings: FilterSettings, estimate: Row) -> None:
    """Say what a bank estimates after a sample that was examined, and what speaks against it; unchecked."""
    bank, evidence, known = cell.bank, cell.evidence, settings.known
    estimate.reason[:] = Reason.SETTLED + 0
    note(estimate, Reason.EMPTY, not bank.has_voltage)
    note(estimate, Reason.IMPLAUSIBLE, settings.searched[Q] and not is_plausible(bank.mean[Q], settings.cell_q_mobile))
    note(estimate, Reason.MISFIT, bank.trend_sd > LIMIT_SD)
    # what nobody saw, as if it had been missing at the start
    unseen_share = hypot(known.sd_soc, unseen_C(evidence) / bank.mean[Q])
    for k in range(2):
        value, own_sd, (low, high), (mean, prior_sd) = bank.mean[k], bank.sd[k], settings.bounds[k], settings.carried[k]
        estimate.value[k], estimate.sd[k], estimate.is_searched[k] = value, nan, settings.searched[k]
        if not settings.searched[k]:
            continue
        common_sd = (bank.common_sd[k] ** -2.0 + 1.0 / settings.variance[k]) ** -0.5
        hidden_sd = bank.mean[Q] * unseen_share
        if k == R:
            hidden_sd = hypot(bank.r_by_share * unseen_share, hypot(evidence.dropped_ohm, known.cell_sd_r_o))
        sd = hypot(hypot(max(own_sd, common_sd), known.gain_sd * value), hidden_sd)
        estimate.sd[k], estimate.own_sd[k], estimate.has_prior[k] = sd, sd, prior_sd > 0.0
        note_about(estimate, k, Reason.AT_BOUND, not low + own_sd < value < high - own_sd)
        if prior_sd > 0.0:
            narrowed = max(prior_sd**2 - own_sd**2, (_LEAST_NARROWING * prior_sd) ** 2)
            note_about(estimate, k, Reason.PRIOR_WRONG, (value - mean) ** 2 > PRIOR_LIMIT_SD**2 * narrowed)
            # precisions add up
            estimate.own_sd[k] = max(max(own_sd**-2.0 - prior_sd**-2.0, 0.0) ** -0.5, bank.common_sd[k])
    judge(estimate, evidence, known)
