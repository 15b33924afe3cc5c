"""What a fit that allows for wrong constants of the model and an offset of the sensor says about the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.compiled import compiled, inlined, reassociating
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_NAMES, EQUILIBRIUM_SIZE, PATH_NAMES, AgingPath
from battery_env.electrochemistry.cell import (
    BULK_RATE,
    PER_CURRENT_N,
    POLYNOMIAL_SIZE,
    R_OVER_F,
    SURFACE_RATE,
    SURROUNDINGS,
    TO_RATE,
    TSN_RATE,
    TSP_RATE,
    U0,
    UNCERTAIN_CONSTANTS,
    CellParameters,
)
from battery_env.electrochemistry.equilibrium import on_unit_range, with_equilibrium
from battery_env.electrochemistry.kernels import BLOCK
from battery_env.electrochemistry.model_error import independent_errors
from battery_env.parameters import PARAMETER_NAMES
from battery_env.tasks.voltage.readings import (
    AT_REST,
    BLOCK_SIZE,
    CURRENT,
    FURTHER_VSN,
    FURTHER_VSP,
    HALF,
    MOVED,
    OHMIC,
    RELATIVE_STEP,
    RESIDUAL,
    SLOPE,
    STEPS,
    VSN,
    VSP,
    nominal_overpotentials_of_block,
    pad_block,
    relax_block,
    surface_fractions,
    take_readings,
    voltages_of_block,
)

# The unknowns: two parameters, the offset of the sensor, the logarithms of UNCERTAIN_CONSTANTS, and along a path what is added
# to the equilibrium voltage. In the values of a block they are rows of the derivatives of the voltage, and the residual is the
# row after them
_Q, _R, _OFFSET, _KN, _T_DIFFUSION, _TO, _TSN, _EQUILIBRIUM = range(8)
#: Logarithms of constants are held within this many of their standard deviations.
REACH_SD = 3.0
# Along a path, where constants make the model bend, a step moves q_mobile by this share at most, and all else in proportion.
_LONGEST_STEP = 0.1
# What is known of an unknown about which nothing is known, in its unit to the power of -2
_NOTHING = 1e-6
#: What the parts of an observation are divided by; standard deviations by this share of the range of the estimate
VOLTAGE_SCALE_V = 0.010
_SD_SCALE = 0.01
# Noise is not taken for less, V.
_LEAST_NOISE_V = 0.001
# How often the noise is told anew from what the step leaves of the residuals
_NOISE_ROUNDS = 3

# mole fractions of the positive electrode as -1 .. 1
_UNIT_START = float(on_unit_range(0.0))
_UNIT_SLOPE = float(on_unit_range(1.0)) - _UNIT_START

assert UNCERTAIN_CONSTANTS == ("kn", "tDiffusion", "to", "tsn")


class Fitted(NamedTuple):
    """What a fit says of each cell of a batch."""

    estimate: FloatArray  # (q_mobile, r_o) after its step, C and ohm, shape (cells, 2)
    sd: FloatArray  # their standard deviations under the priors, same shape
    sd_alone: FloatArray  # what they would be if nothing were known of the parameters before, same shape
    constants: FloatArray  # as of NuisanceFit, shape (cells, 4) or (cells, 12)
    offset_V: FloatArray  # of the voltage sensor, V, shape (cells,)
    constants_sd: FloatArray  # of the farthest constant, or of the cell beside its path, standard deviations, shape (cells,)


@dataclass(frozen=True, eq=False)
class FitPrior:
    """What is known of the unknowns before a discharge: normal, in units of their own."""

    mean: FloatArray  # of all unknowns, shape (n,)
    units: FloatArray  # shape (n,); 0 for an offset that is known
    precision: FloatArray  # the inverse of the covariance, in these units, shape (n, n)
    alone: FloatArray  # the same if nothing were known of the parameters, nor of what goes together with them
    shown: FloatArray  # what constants are divided by where an agent sees them, shape (n - 3,)
    path: AgingPath | None = None  # of whose cells the mean of parameters is that of their logarithms; ``None``: no path

    @classmethod
    def of_ranges(cls, ranges: Mapping[str, tuple[float, float]], offset_V: float, nuisance: float) -> FitPrior:
        """
        Each for itself: parameters have the mean and the standard deviation of their ranges, C and ohm; constants a relative
        standard deviation.
        """
        limits = np.array(list(ranges.values()))
        constants = np.full(len(UNCERTAIN_CONSTANTS), np.sqrt(np.log1p(nuisance**2)))
        uniform = np.append(np.ptp(limits, axis=1), 2.0 * offset_V) / np.sqrt(12.0)
        mean = np.concatenate([limits.mean(axis=1), np.zeros(1 + len(constants))])
        alone = np.eye(len(mean))
        alone[[_Q, _R], [_Q, _R]] = _NOTHING
        units = np.concatenate([uniform, constants])
        return cls(mean, units, np.eye(len(mean)), alone, np.full(len(constants), nuisance))

    @classmethod
    def along(cls, path: AgingPath, offset_V: float) -> FitPrior:
        """What goes together along a path of aging cells."""
        order = [PATH_NAMES.index(name) for name in (*PARAMETER_NAMES, *UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES)]
        of_path = [k for k in range(len(order) + 1) if k != _OFFSET]
        mean, covariance = path.moments
        means, precision = np.zeros(len(of_path) + 1), np.zeros((len(of_path) + 1, len(of_path) + 1))
        means[of_path] = mean[order]
        precision[np.ix_(of_path, of_path)] = np.linalg.inv(covariance[np.ix_(order, order)])
        precision[_OFFSET, _OFFSET] = 3.0 / offset_V**2 if offset_V > 0.0 else 1.0
        variances = np.diag(np.linalg.inv(precision))
        alone = np.diag(np.concatenate([[_NOTHING, _NOTHING], 1.0 / variances[_OFFSET:]]))
        units = np.ones(len(means))
        units[_OFFSET] = float(offset_V > 0.0)
        return cls(means, units, precision, alone, np.sqrt(variances[_KN:]), path)


class Known(NamedTuple):
    """What a step knows before the readings."""

    mean: FloatArray  # of all unknowns, shape (n, unknowns)
    units: FloatArray  # likewise
    precision: FloatArray  # as of FitPrior, shape (unknowns, unknowns)
    alone: FloatArray  # likewise
    mismatch_V: float  # what the model is expected to be off for all its constants, V
    errors_per_C: float  # how many independent errors of the model a coulomb shows, besides a first one


class NuisanceFit:
    """
    A fit for each cell of a batch: of the parameters, of the offset of the voltage sensor, and of the constants of the model
    that nobody knows exactly, under a prior. One Gauss-Newton step is taken whenever the estimate moves or readings arrive; it
    moves the constants, and is shown to the agent, which moves the parameters.

    :ivar constants: logarithms of what ``UNCERTAIN_CONSTANTS`` are multiplied by, and along a path what is added to the
        equilibrium voltage, V, shape (cells, 4) or (cells, 12)
    """

    def __init__(self, cells: int, model: NDArray[np.void], cell: CellParameters, prior: FitPrior) -> None:
        self.prior, self._model, unknowns = prior, model, len(prior.mean)
        self._sd = np.sqrt(np.diag(np.linalg.inv(prior.precision))) * prior.units
        error = (0.0, 0.0) if prior.path is None else (prior.path.mismatch_V, prior.path.errors_per_C)
        means, units = np.tile(prior.mean, (cells, 1)), np.tile(prior.units, (cells, 1))
        self._known = Known(means, units, prior.precision, prior.alone, *error)
        self._first = np.zeros(unknowns - _KN) if prior.path is None else prior.mean[_KN:]
        self.constants = np.tile(self._first, (cells, 1))
        self._found = np.zeros((cells, found_size(unknowns)))
        self._added = _added_by_equilibrium(cell, unknowns - _EQUILIBRIUM)
        self.observation_size = 2 * len(PARAMETER_NAMES) + 2 + unknowns - _KN

    def step(self, rows: IntArray, count: IntArray, estimate: FloatArray, shown: FloatArray) -> None:
        """Take one step for some cells; the arguments are those of :func:`nuisance_step`."""
        if self.prior.path is not None:  # its normal distribution is one of logarithms
            self._known.units[rows, : _R + 1] = now = estimate[rows]
            self._known.mean[rows, : _R + 1] = now * (1.0 + self.prior.mean[: _R + 1] - np.log(now))
        nuisance_step(rows, count, estimate, shown, self._model, self.constants, self._added, self._known, self._found)
        if self.prior.path is not None:
            share = _LONGEST_STEP * estimate[rows, _Q] / np.maximum(np.abs(self._found[rows, _Q]), 1e-9)
            self._found[rows, : len(self.prior.mean)] *= np.minimum(share, 1.0)[:, None]
        reach = REACH_SD * self._sd[_KN:]
        moved = self.constants[rows] + self._found[rows, _KN : len(self.prior.mean)]
        self.constants[rows] = np.clip(moved, self._first - reach, self._first + reach)

    def start(self, row: int) -> None:
        """Forget the constants of a cell."""
        self.constants[row] = self._first

    def found(self, estimate: FloatArray) -> Fitted:
        """What the last step found."""
        found, n = self._found.copy(), len(self.prior.mean)
        step, sd, sd_alone = (found[:, first : first + 2] for first in (0, n, 2 * n + 1))
        constants, after = self.constants.copy(), estimate + step
        if self.prior.path is None:
            constants_sd = np.abs(constants / self._sd[_KN:]).max(axis=1)
        else:
            kept = np.maximum(after, 0.5 * estimate)  # a step so long has no logarithm
            constants_sd = self.prior.path.distances_sd(np.hstack([constants, np.log(kept)]))
        return Fitted(after, sd, sd_alone, constants, found[:, _OFFSET], constants_sd)

    def beside(self, estimate: FloatArray, distance_sd: FloatArray) -> FloatArray:
        """Parameters that lie so many standard deviations beside those of the fit, C and ohm, shape (cells, 2)."""
        n = len(self.prior.mean)
        return estimate + self._found[:, : _R + 1] + distance_sd * self._found[:, n : n + _R + 1]

    def parts(self, largest_step: FloatArray, width: FloatArray) -> list[FloatArray]:
        """What the agent sees."""
        n = len(self.prior.mean)
        step, sd = (self._found[:, first : first + 2] for first in (0, n))
        return [
            np.clip(np.sign(step) * np.sqrt(np.abs(step) / largest_step), -1.0, 1.0),
            np.log(sd / (_SD_SCALE * width)),
            np.log(self._found[:, 2 * n, None] / VOLTAGE_SCALE_V),
            np.arcsinh(self._found[:, _OFFSET, None] / VOLTAGE_SCALE_V),
            (self.constants - self._first) / self.prior.shown,
        ]


def found_size(unknowns: int) -> int:
    """Of what :func:`nuisance_step` finds: a step and a standard deviation of each unknown, the noise, and two deviations."""
    return 2 * unknowns + 3


@lru_cache(maxsize=4)
def _added_by_equilibrium(cell: CellParameters, count: int) -> FloatArray:
    # what each coefficient adds to U0 and to the polynomial of the positive electrode, shape (count, 1 + POLYNOMIAL_SIZE)
    def packed(coefficients_V: FloatArray) -> FloatArray:
        made = with_equilibrium(cell, coefficients_V).packed
        return np.append(made.constants[0, U0], made.polynomial_p)

    without = packed(np.zeros(EQUILIBRIUM_SIZE))
    added = [packed(row) - without for row in np.eye(EQUILIBRIUM_SIZE)[:count]]
    return np.array(added).reshape(count, 1 + POLYNOMIAL_SIZE)


@compiled
def _decay(rate: float, factor: float, steps: float, dt_s: float) -> tuple[float, float]:
    # what is left after some steps if the time constant is multiplied by a factor, and the derivative by its logarithm
    share = min(dt_s * rate / factor, 0.99)
    left = (1.0 - share) ** steps
    return left, steps * left * share / (1.0 - share)


@compiled
def _solve(matrix: FloatArray, right: FloatArray, inverse: FloatArray) -> None:
    # Gauss-Jordan without pivots, as the matrix is positive definite; right becomes the solution
    n = len(right)
    for j in range(n):
        for k in range(n):
            inverse[j, k] = 1.0 if j == k else 0.0
    for j in range(n):
        pivot = 1.0 / matrix[j, j]
        for k in range(n):
            matrix[j, k] *= pivot
            inverse[j, k] *= pivot
        right[j] *= pivot
        for m in range(n):
            if m != j:
                factor = matrix[m, j]
                for k in range(n):
                    matrix[m, k] -= factor * matrix[j, k]
                    inverse[m, k] -= factor * inverse[j, k]
                right[m] -= factor * right[j]


@reassociating
def _add_products(values: FloatArray, size: int, sums: FloatArray) -> None:
    for j in range(len(values)):
        for m in range(j + 1):
            total = 0.0
            for k in range(size):
                total += values[j, k] * values[m, k]
            sums[j, m] += total


class _Rates(NamedTuple):
    """What of charges and drops is left after an interval, and the derivatives by the logarithms of time constants."""

    steps: float  # of the interval
    left_d: float  # of charge that diffuses
    slope_d: float
    gain_d: float  # how much of a current leaves the surface beyond its share at rest
    gain_slope_d: float
    left_o: float  # of the ohmic drop
    slope_o: float
    left_d0: float  # with the constants of the model
    gain_d0: float
    left_o0: float


class _Linear(NamedTuple):
    """The part of the states that is linear in the current, at one reading; 0 stands for the constants of the model."""

    unequal: float  # charge that has left the surface beyond its share at rest, C
    unequal_0: float
    ohmic: float  # drop per ohm, A
    ohmic_0: float
    by_t_diffusion: float  # of the charge
    by_to: float  # of the drop


@inlined
def _rates(model: Any, logarithms: FloatArray, steps: float) -> _Rates:
    constants, dt_s = model.constants, model.dt_s
    rate_d = constants[0, BULK_RATE] + constants[0, SURFACE_RATE]
    at_rest = constants[0, BULK_RATE] / rate_d
    factor_d, factor_o = np.exp(logarithms[1]), np.exp(logarithms[2])
    left_d0, _ = _decay(rate_d, 1.0, steps, dt_s)
    left_o0, _ = _decay(constants[0, TO_RATE], 1.0, steps, dt_s)
    left_d, slope_d = _decay(rate_d, factor_d, steps, dt_s)
    left_o, slope_o = _decay(constants[0, TO_RATE], factor_o, steps, dt_s)
    gain_d0 = (1.0 - at_rest) * (1.0 - left_d0) / rate_d
    gain_d = (1.0 - at_rest) * (1.0 - left_d) * factor_d / rate_d
    gain_slope_d = gain_d - (1.0 - at_rest) * slope_d * factor_d / rate_d
    return _Rates(steps, left_d, slope_d, gain_d, gain_slope_d, left_o, slope_o, left_d0, gain_d0, left_o0)


@inlined
def _follow_current(
    block: FloatArray, values: FloatArray, size: int, r_o: float, model: Any, logarithms: FloatArray, before: _Linear
) -> _Linear:
    # From the states of the model's constants, in the block, to those of the fit, and their derivatives
    unequal, unequal_0, ohmic, ohmic_0, by_t_diffusion, by_to = before
    rates = _rates(model, logarithms, block[STEPS * BLOCK])
    for k in range(size):
        if block[STEPS * BLOCK + k] != rates.steps:
            rates = _rates(model, logarithms, block[STEPS * BLOCK + k])
        current, shown = block[CURRENT * BLOCK + k], block[OHMIC * BLOCK + k]
        # the current that makes this ohmic drop of the one before
        effective = (shown - rates.left_o0 * ohmic_0) / (1.0 - rates.left_o0)
        ohmic_0 = shown
        by_to = rates.left_o * by_to + rates.slope_o * (ohmic - effective)
        ohmic = rates.left_o * ohmic + (1.0 - rates.left_o) * effective
        # what has left the surface, beyond its share at rest
        by_t_diffusion = rates.left_d * by_t_diffusion + rates.slope_d * unequal + rates.gain_slope_d * current
        unequal = rates.left_d * unequal + rates.gain_d * current
        unequal_0 = rates.left_d0 * unequal_0 + rates.gain_d0 * current
        block[MOVED * BLOCK + k] = block[MOVED * BLOCK + k] + unequal - unequal_0
        block[OHMIC * BLOCK + k] = ohmic
        values[_T_DIFFUSION, k], values[_TO, k] = by_t_diffusion, -r_o * by_to
    return _Linear(unequal, unequal_0, ohmic, ohmic_0, by_t_diffusion, by_to)


@inlined
def _differentiate_vsn(
    block: FloatArray, values: FloatArray, size: int, model: Any, factor: float, vsn: float, before: tuple[float, float]
) -> tuple[float, float]:
    # The derivatives by kn and tsn from the values that Vsn tends to, which values has by kn; returns the last ones
    by_kn, by_tsn = before
    steps, left, slope = 0.0, 1.0, 0.0
    for k in range(size):
        if block[STEPS * BLOCK + k] != steps:
            steps = block[STEPS * BLOCK + k]
            left, slope = _decay(model.constants[0, TSN_RATE], factor, steps, model.dt_s)
        nominal = block[VSN * BLOCK + k]
        by_tsn = left * by_tsn + slope * (vsn - nominal)
        by_kn += (1.0 - left) * (values[_KN, k] - by_kn)
        vsn += (1.0 - left) * (nominal - vsn)
        values[_KN, k], values[_TSN, k] = -by_kn, -by_tsn
    return by_kn, by_tsn


@inlined
def _differentiate_nominal(block: FloatArray, values: FloatArray, size: int, q: float, own: FloatArray) -> None:
    # What Vsn tends to, by the logarithm of kn
    scale = 2.0 * own[0, R_OVER_F] * own[0, SURROUNDINGS]
    for k in range(size):
        xn, _ = surface_fractions(block[HALF * BLOCK + k], q, own)
        argument = block[CURRENT * BLOCK + k] * own[0, PER_CURRENT_N]
        values[_KN, k] = -scale * argument / np.sqrt(argument * argument + (1.0 - xn) * xn)


@inlined
def _differentiate_voltage(block: FloatArray, values: FloatArray, size: int, q: float) -> None:
    step_C = q * RELATIVE_STEP
    for k in range(size):
        slope, moved = block[SLOPE * BLOCK + k], block[MOVED * BLOCK + k]
        relaxing = block[FURTHER_VSN * BLOCK + k] - block[VSN * BLOCK + k]
        relaxing += block[FURTHER_VSP * BLOCK + k] - block[VSP * BLOCK + k]
        # the equilibrium is a function of moved / q
        by_moved = -(slope + relaxing / step_C) * q / max(moved, 1.0)
        values[_Q, k], values[_R, k] = slope, -block[OHMIC * BLOCK + k]
        values[_OFFSET, k], values[len(values) - 1, k] = 1.0, block[RESIDUAL * BLOCK + k]
        values[_T_DIFFUSION, k] *= by_moved


@inlined
def _differentiate_equilibrium(block: FloatArray, values: FloatArray, size: int, q: float, constants: FloatArray) -> None:
    # Legendre polynomials of the mole fraction
    for k in range(size):
        _, xp = surface_fractions(block[MOVED * BLOCK + k], q, constants)
        x = xp * _UNIT_SLOPE + _UNIT_START
        values[_EQUILIBRIUM, k], values[_EQUILIBRIUM + 1, k] = 1.0, x
        for j in range(2, len(values) - 1 - _EQUILIBRIUM):
            last, before = values[_EQUILIBRIUM + j - 1, k], values[_EQUILIBRIUM + j - 2, k]
            values[_EQUILIBRIUM + j, k] = ((2 * j - 1) * x * last - (j - 1) * before) / j


@compiled
def _linearize(
    n: int,
    end: int,
    estimate: FloatArray,
    shown: FloatArray,
    model: Any,
    constants: FloatArray,
    added: FloatArray,
    sums: FloatArray,
) -> float:
    # The sums of products of the derivatives by all unknowns, and of the residual, over the readings of a cell; returns the
    # charge drawn
    block, values, own = np.empty(BLOCK_SIZE), np.empty((len(sums), BLOCK)), model.constants.copy()
    q, r, logarithms = estimate[n, 0], estimate[n, 1], constants[n]
    own[0, PER_CURRENT_N] = model.constants[0, PER_CURRENT_N] / np.exp(logarithms[0])
    polynomial_p = np.zeros(POLYNOMIAL_SIZE)
    for k in range(POLYNOMIAL_SIZE):
        polynomial_p[k] = model.polynomial_p[k]
    for j in range(len(added)):
        coefficient_V = logarithms[_EQUILIBRIUM - _KN + j]
        own[0, U0] += coefficient_V * added[j, 0]
        for k in range(POLYNOMIAL_SIZE):
            polynomial_p[k] += coefficient_V * added[j, 1 + k]
    share_n = min(model.dt_s * own[0, TSN_RATE] / np.exp(logarithms[3]), 0.99)
    share_p = model.dt_s * own[0, TSP_RATE]
    linear, overpotentials = _Linear(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), AT_REST
    by_constants, moved_before, drawn_C = (0.0, 0.0), 0.0, 0.0
    sums[:] = 0.0
    for low in range(0, end, BLOCK):
        size = min(BLOCK, end - low)
        take_readings(block, shown, n, low, size)
        for k in range(size):
            drawn_C += block[CURRENT * BLOCK + k] * block[STEPS * BLOCK + k] * model.dt_s
        linear = _follow_current(block, values, size, r, model, logarithms, linear)
        padded = pad_block(block, size, moved_before)
        moved_before = block[MOVED * BLOCK + size - 1]
        nominal_overpotentials_of_block(block, padded, q, own)
        _differentiate_nominal(block, values, padded, q, own)
        factor_n = np.exp(logarithms[3])
        by_constants = _differentiate_vsn(block, values, size, model, factor_n, overpotentials.vsn, by_constants)
        overpotentials = relax_block(block, size, share_n, share_p, overpotentials)
        voltages_of_block(block, padded, q, r, own, model.polynomial_n, polynomial_p)
        _differentiate_voltage(block, values, size, q)
        if len(added) > 0:
            _differentiate_equilibrium(block, values, size, q, own)
        _add_products(values, size, sums)
    return drawn_C


@inlined
def _normal_matrix(sums: FloatArray, noise2: float, units: FloatArray, precision: FloatArray, matrix: FloatArray) -> None:
    for j in range(len(units)):
        for m in range(j + 1):
            matrix[j, m] = matrix[m, j] = units[j] * units[m] * sums[j, m] / noise2 + precision[j, m]


@compiled
def _solve_under_priors(
    sums: FloatArray,
    before: FloatArray,
    readings: int,
    least_noise_V: float,
    mean: FloatArray,
    units: FloatArray,
    precision: FloatArray,
    alone: FloatArray,
    found: FloatArray,
) -> None:
    # The step, its standard deviations, the noise, and standard deviations without a prior of the parameters, into found
    n = len(mean)
    matrix, inverse = np.empty((2, n, n))
    step, away = np.empty(n), np.zeros(n)
    for j in range(n):
        if units[j] > 0.0:
            away[j] = (mean[j] - before[j]) / units[j]
    residuals = sums[n, n]
    noise2 = max(residuals / readings, least_noise_V**2)
    for _ in range(_NOISE_ROUNDS):
        _normal_matrix(sums, noise2, units, precision, matrix)
        for j in range(n):
            step[j] = units[j] * sums[n, j] / noise2
            for m in range(n):
                step[j] += precision[j, m] * away[m]
        _solve(matrix, step, inverse)
        left = residuals
        for j in range(n):
            left -= 2.0 * units[j] * step[j] * sums[n, j]
            for m in range(n):
                product = sums[max(j, m), min(j, m)]
                left += units[j] * step[j] * units[m] * step[m] * product
        noise2 = max(left / readings, least_noise_V**2)
    for j in range(n):
        found[j] = units[j] * step[j]
        found[n + j] = units[j] * np.sqrt(inverse[j, j])
    found[2 * n] = np.sqrt(noise2)
    _normal_matrix(sums, noise2, units, alone, matrix)
    _solve(matrix, step, inverse)
    for j in range(_R + 1):
        found[2 * n + 1 + j] = units[j] * np.sqrt(inverse[j, j])


@compiled
def nuisance_step(
    rows: IntArray,
    count: IntArray,
    estimate: FloatArray,
    shown: FloatArray,
    model: NDArray[np.void],
    constants: FloatArray,
    added: FloatArray,
    known: Known,
    found: FloatArray,
) -> None:
    """
    One Gauss-Newton step towards the (q_mobile, r_o), offset and constants that explain the readings of each cell best under
    their prior, into ``found``, shape (n, found_size); unchecked, all arrays contiguous. The arguments that
    :func:`battery_env.tasks.voltage.readings.explain` has too are the same. ``added`` is what the coefficients of the
    equilibrium voltage among the constants add to the model, shape (coefficients, 1 + POLYNOMIAL_SIZE).
    """
    unknowns = known.mean.shape[1]
    sums, before = np.empty((unknowns + 1, unknowns + 1)), np.zeros(unknowns)
    for n in rows:
        drawn_C = _linearize(n, count[n], estimate, shown, model[0], constants, added, sums)
        before[_Q], before[_R] = estimate[n, 0], estimate[n, 1]
        before[_KN:] = constants[n]
        errors = independent_errors(max(drawn_C, 0.0), known.errors_per_C)
        least_noise_V = np.sqrt(_LEAST_NOISE_V**2 + known.mismatch_V**2 * count[n] / errors)
        prior = known.mean[n], known.units[n], known.precision, known.alone
        _solve_under_priors(sums, before, count[n], least_noise_V, *prior, found[n])
