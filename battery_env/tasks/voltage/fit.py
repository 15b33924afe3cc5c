"""A fit of the parameters together with nuisance parameters: constants of the model, and the offset of the sensor."""

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
    load_readings,
    nominal_overpotentials_of_block,
    pad_block,
    relax_block,
    surface_fractions,
    voltages_of_block,
)

# The unknowns: two parameters, the offset of the sensor, the logarithms of UNCERTAIN_CONSTANTS, and along a path coefficients
# of the equilibrium voltage. The values of a block have a row of the derivatives of the voltage for each of them, and then the
# residual
_Q, _R, _OFFSET, _KN, _T_DIFFUSION, _TO, _TSN, _EQUILIBRIUM = range(8)
#: Limit of the logarithms of constants, in their standard deviations.
REACH_SD = 3.0
# Along a path, where the model is less linear, a step moves q_mobile by this share at most, and all else in proportion.
_LARGEST_STEP_SHARE = 0.1
# Precision of an unknown without prior knowledge, in its unit to the power of -2
_FLAT_PRECISION = 1e-6
#: Scales of an observation; the scale of a standard deviation is this share of the range of the estimate
VOLTAGE_SCALE_V = 0.010
_SD_SCALE = 0.01
#: Least standard deviation of the noise of a voltage sensor, V.
LEAST_NOISE_V = 0.001
# Iterations of the noise estimate from the residuals after the step
_NOISE_ROUNDS = 3

# mole fractions of the positive electrode as -1 .. 1
_UNIT_START = float(on_unit_range(0.0))
_UNIT_SLOPE = float(on_unit_range(1.0)) - _UNIT_START

assert UNCERTAIN_CONSTANTS == ("kn", "tDiffusion", "to", "tsn")


class FitResult(NamedTuple):
    """The fit of each cell of a batch."""

    estimate: FloatArray  # (q_mobile, r_o) after the step, C and ohm, shape (cells, 2)
    sd: FloatArray  # standard deviations under the priors, same shape
    sd_flat_prior: FloatArray  # standard deviations without prior knowledge of the parameters, same shape
    constants: FloatArray  # as of NuisanceFit, shape (cells, 4) or (cells, 12)
    offset_V: FloatArray  # of the voltage sensor, V, shape (cells,)
    constants_sd: FloatArray  # distance of the farthest constant, or of the cell from its path, in sd, shape (cells,)


@dataclass(frozen=True, eq=False)
class FitPrior:
    """The normal prior of the unknowns, each in a unit of its own."""

    mean: FloatArray  # of all unknowns, shape (n,)
    units: FloatArray  # shape (n,); 0 for an offset that is known
    precision: FloatArray  # the inverse of the covariance, in these units, shape (n, n)
    flat_precision: FloatArray  # ``precision`` without prior knowledge of the parameters, nor of correlations with them
    observation_scale: FloatArray  # scales of the constants in an observation, shape (n - 3,)
    path: AgingPath | None = None  # with a path the means of the parameters are those of their logarithms

    @classmethod
    def of_ranges(cls, ranges: Mapping[str, tuple[float, float]], offset_V: float, nuisance: float) -> FitPrior:
        """Make a prior of parameters with the moments of their ranges, C and ohm, and constants of this relative sd."""
        limits = np.array(list(ranges.values()))
        constants = np.full(len(UNCERTAIN_CONSTANTS), np.sqrt(np.log1p(nuisance**2)))
        uniform = np.append(np.ptp(limits, axis=1), 2.0 * offset_V) / np.sqrt(12.0)
        mean = np.concatenate([limits.mean(axis=1), np.zeros(1 + len(constants))])
        flat_precision = np.eye(len(mean))
        flat_precision[[_Q, _R], [_Q, _R]] = _FLAT_PRECISION
        units = np.concatenate([uniform, constants])
        return cls(mean, units, np.eye(len(mean)), flat_precision, np.full(len(constants), nuisance))

    @classmethod
    def along(cls, path: AgingPath, offset_V: float) -> FitPrior:
        """Make the joint prior of a path of aging cells."""
        path_order = [PATH_NAMES.index(name) for name in (*PARAMETER_NAMES, *UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES)]
        path_rows = [k for k in range(len(path_order) + 1) if k != _OFFSET]
        mean, covariance = path.moments
        means, precision = np.zeros(len(path_rows) + 1), np.zeros((len(path_rows) + 1, len(path_rows) + 1))
        means[path_rows] = mean[path_order]
        precision[np.ix_(path_rows, path_rows)] = np.linalg.inv(covariance[np.ix_(path_order, path_order)])
        precision[_OFFSET, _OFFSET] = 3.0 / offset_V**2 if offset_V > 0.0 else 1.0
        variances = np.diag(np.linalg.inv(precision))
        flat_precision = np.diag(np.concatenate([[_FLAT_PRECISION, _FLAT_PRECISION], 1.0 / variances[_OFFSET:]]))
        units = np.ones(len(means))
        units[_OFFSET] = float(offset_V > 0.0)
        return cls(means, units, precision, flat_precision, np.sqrt(variances[_KN:]), path)


class StepPrior(NamedTuple):
    """The prior of a step."""

    mean: FloatArray  # of all unknowns, shape (n, unknowns)
    units: FloatArray  # likewise
    precision: FloatArray  # as of FitPrior, shape (unknowns, unknowns)
    flat_precision: FloatArray  # likewise
    mismatch_V: float  # expected error of the model with its best constants, V
    errors_per_C: float  # independent model errors per coulomb, in addition to a first one


class NuisanceFit:
    """
    A fit for each cell of a batch, under a prior: of the parameters, the offset of the voltage sensor, and the uncertain
    constants of the model. Each move of the estimate, and each new reading, takes one Gauss-Newton step. The step moves the
    constants; the agent observes the step, and moves the parameters.

    :ivar constants: logarithms of the factors of ``UNCERTAIN_CONSTANTS``, and along a path coefficients of the equilibrium
        voltage, V, shape (cells, 4) or (cells, 12)
    """

    def __init__(self, cells: int, model: NDArray[np.void], cell: CellParameters, prior: FitPrior) -> None:
        self.prior, self._model, unknowns = prior, model, len(prior.mean)
        self._sd = np.sqrt(np.diag(np.linalg.inv(prior.precision))) * prior.units
        mismatch_V, errors_per_C = (0.0, 0.0) if prior.path is None else (prior.path.mismatch_V, prior.path.errors_per_C)
        means, units = np.tile(prior.mean, (cells, 1)), np.tile(prior.units, (cells, 1))
        self._prior_rows = StepPrior(means, units, prior.precision, prior.flat_precision, mismatch_V, errors_per_C)
        self._first = np.zeros(unknowns - _KN) if prior.path is None else prior.mean[_KN:]
        self.constants = np.tile(self._first, (cells, 1))
        # of each cell a step and an sd of each unknown, the noise, and two sds under a flat prior
        self._solution = np.zeros((cells, 2 * unknowns + 3))
        self._equilibrium = _equilibrium_terms(cell, unknowns - _EQUILIBRIUM)
        self.observation_size = 2 * len(PARAMETER_NAMES) + 2 + unknowns - _KN

    def step(self, rows: IntArray, count: IntArray, estimate: FloatArray, measurements: FloatArray) -> None:
        """Take one step for some cells; the arguments are those of :func:`nuisance_step`."""
        if self.prior.path is not None:  # the path has a normal distribution of logarithms
            self._prior_rows.units[rows, : _R + 1] = current = estimate[rows]
            self._prior_rows.mean[rows, : _R + 1] = current * (1.0 + self.prior.mean[: _R + 1] - np.log(current))
        model, terms, solution = self._model, self._equilibrium, self._solution
        nuisance_step(rows, count, estimate, measurements, model, self.constants, terms, self._prior_rows, solution)
        if self.prior.path is not None:
            share = _LARGEST_STEP_SHARE * estimate[rows, _Q] / np.maximum(np.abs(solution[rows, _Q]), 1e-9)
            solution[rows, : len(self.prior.mean)] *= np.minimum(share, 1.0)[:, None]
        reach = REACH_SD * self._sd[_KN:]
        constants = self.constants[rows] + solution[rows, _KN : len(self.prior.mean)]
        self.constants[rows] = np.clip(constants, self._first - reach, self._first + reach)

    def start(self, row: int) -> None:
        """Reset the constants of a cell."""
        self.constants[row] = self._first

    def result(self, estimate: FloatArray) -> FitResult:
        """Return the fit after the last step."""
        solution, n = self._solution.copy(), len(self.prior.mean)
        step, sd, sd_flat_prior = (solution[:, first : first + 2] for first in (0, n, 2 * n + 1))
        constants, estimate_after = self.constants.copy(), estimate + step
        if self.prior.path is None:
            constants_sd = np.abs(constants / self._sd[_KN:]).max(axis=1)
        else:
            positive = np.maximum(estimate_after, 0.5 * estimate)  # a longer step may have no logarithm
            constants_sd = self.prior.path.distances_sd(np.hstack([constants, np.log(positive)]))
        return FitResult(estimate_after, sd, sd_flat_prior, constants, solution[:, _OFFSET], constants_sd)

    def estimate_at(self, estimate: FloatArray, distance_sd: FloatArray) -> FloatArray:
        """Return the parameters of the fit plus this many standard deviations, C and ohm, shape (cells, 2)."""
        n = len(self.prior.mean)
        return estimate + self._solution[:, : _R + 1] + distance_sd * self._solution[:, n : n + _R + 1]

    def observation_parts(self, largest_step: FloatArray, width: FloatArray) -> list[FloatArray]:
        """Return the fit's columns of the observation."""
        n = len(self.prior.mean)
        step, sd = (self._solution[:, first : first + 2] for first in (0, n))
        return [
            np.clip(np.sign(step) * np.sqrt(np.abs(step) / largest_step), -1.0, 1.0),
            np.log(sd / (_SD_SCALE * width)),
            np.log(self._solution[:, 2 * n, None] / VOLTAGE_SCALE_V),
            np.arcsinh(self._solution[:, _OFFSET, None] / VOLTAGE_SCALE_V),
            (self.constants - self._first) / self.prior.observation_scale,
        ]


@lru_cache(maxsize=4)
def _equilibrium_terms(cell: CellParameters, count: int) -> FloatArray:
    # change of U0 and of the polynomial of the positive electrode per coefficient, shape (count, 1 + POLYNOMIAL_SIZE)
    def packed(coefficients_V: FloatArray) -> FloatArray:
        cell_constants = with_equilibrium(cell, coefficients_V).packed
        return np.append(cell_constants.constants[0, U0], cell_constants.polynomial_p)

    base = packed(np.zeros(EQUILIBRIUM_SIZE))
    terms = [packed(row) - base for row in np.eye(EQUILIBRIUM_SIZE)[:count]]
    return np.array(terms).reshape(count, 1 + POLYNOMIAL_SIZE)


@compiled
def _decay(rate: float, factor: float, steps: float, dt_s: float) -> tuple[float, float]:
    # remainder of a decay after some steps, with a factor of the time constant, and its derivative by the factor's logarithm
    share = min(dt_s * rate / factor, 0.99)
    decay = (1.0 - share) ** steps
    return decay, steps * decay * share / (1.0 - share)


@compiled
def _solve(matrix: FloatArray, vector: FloatArray, inverse: FloatArray) -> None:
    # Gauss-Jordan without pivots, because the matrix is positive definite; the solution overwrites vector
    n = len(vector)
    for j in range(n):
        for k in range(n):
            inverse[j, k] = 1.0 if j == k else 0.0
    for j in range(n):
        pivot = 1.0 / matrix[j, j]
        for k in range(n):
            matrix[j, k] *= pivot
            inverse[j, k] *= pivot
        vector[j] *= pivot
        for m in range(n):
            if m != j:
                factor = matrix[m, j]
                for k in range(n):
                    matrix[m, k] -= factor * matrix[j, k]
                    inverse[m, k] -= factor * inverse[j, k]
                vector[m] -= factor * vector[j]


@reassociating
def _add_products(values: FloatArray, size: int, sums: FloatArray) -> None:
    for j in range(len(values)):
        for m in range(j + 1):
            total = 0.0
            for k in range(size):
                total += values[j, k] * values[m, k]
            sums[j, m] += total


class _Rates(NamedTuple):
    """Decays and gains over an interval, and their derivatives by the logarithms of time constants."""

    steps: float  # of the interval
    decay_d: float  # of diffusion
    slope_d: float
    gain_d: float  # depletion of the surface, beyond its share at rest, per current
    gain_slope_d: float
    decay_o: float  # of the ohmic drop
    slope_o: float
    decay_d0: float  # with the constants of the model, as all below
    gain_d0: float
    decay_o0: float


class _Linear(NamedTuple):
    """The states that are linear in the current, at one reading; 0 stands for the constants of the model."""

    depletion_C: float  # charge that has left the surface beyond its share at rest
    depletion_0_C: float
    ohmic: float  # drop per ohm, A
    ohmic_0: float
    by_t_diffusion: float  # of the charge
    by_to: float  # of the drop


@inlined
def _rates(model: Any, logarithms: FloatArray, steps: float) -> _Rates:
    constants, dt_s = model.constants, model.dt_s
    rate_d = constants[0, BULK_RATE] + constants[0, SURFACE_RATE]
    rest_share = constants[0, BULK_RATE] / rate_d
    factor_d, factor_o = np.exp(logarithms[1]), np.exp(logarithms[2])
    decay_d0, _ = _decay(rate_d, 1.0, steps, dt_s)
    decay_o0, _ = _decay(constants[0, TO_RATE], 1.0, steps, dt_s)
    decay_d, slope_d = _decay(rate_d, factor_d, steps, dt_s)
    decay_o, slope_o = _decay(constants[0, TO_RATE], factor_o, steps, dt_s)
    gain_d0 = (1.0 - rest_share) * (1.0 - decay_d0) / rate_d
    gain_d = (1.0 - rest_share) * (1.0 - decay_d) * factor_d / rate_d
    gain_slope_d = gain_d - (1.0 - rest_share) * slope_d * factor_d / rate_d
    return _Rates(steps, decay_d, slope_d, gain_d, gain_slope_d, decay_o, slope_o, decay_d0, gain_d0, decay_o0)


@inlined
def _integrate_current(
    block: FloatArray, values: FloatArray, size: int, r_o: float, model: Any, logarithms: FloatArray, previous: _Linear
) -> _Linear:
    # Replace the states of the model's constants, in the block, by the states of the fit, and compute their derivatives
    depletion_C, depletion_0_C, ohmic, ohmic_0, by_t_diffusion, by_to = previous
    rates = _rates(model, logarithms, block[STEPS * BLOCK])
    for k in range(size):
        if block[STEPS * BLOCK + k] != rates.steps:
            rates = _rates(model, logarithms, block[STEPS * BLOCK + k])
        current, measured_A = block[CURRENT * BLOCK + k], block[OHMIC * BLOCK + k]
        # the current that takes the previous ohmic drop to this one
        effective = (measured_A - rates.decay_o0 * ohmic_0) / (1.0 - rates.decay_o0)
        ohmic_0 = measured_A
        by_to = rates.decay_o * by_to + rates.slope_o * (ohmic - effective)
        ohmic = rates.decay_o * ohmic + (1.0 - rates.decay_o) * effective
        by_t_diffusion = rates.decay_d * by_t_diffusion + rates.slope_d * depletion_C + rates.gain_slope_d * current
        depletion_C = rates.decay_d * depletion_C + rates.gain_d * current
        depletion_0_C = rates.decay_d0 * depletion_0_C + rates.gain_d0 * current
        block[MOVED * BLOCK + k] = block[MOVED * BLOCK + k] + depletion_C - depletion_0_C
        block[OHMIC * BLOCK + k] = ohmic
        values[_T_DIFFUSION, k], values[_TO, k] = by_t_diffusion, -r_o * by_to
    return _Linear(depletion_C, depletion_0_C, ohmic, ohmic_0, by_t_diffusion, by_to)


@inlined
def _differentiate_vsn(
    block: FloatArray, values: FloatArray, size: int, model: Any, factor: float, vsn: float, previous: tuple[float, float]
) -> tuple[float, float]:
    # The derivatives of Vsn by kn and tsn from those of its steady state, in values; return the last derivatives
    by_kn, by_tsn = previous
    steps, decay, slope = 0.0, 1.0, 0.0
    for k in range(size):
        if block[STEPS * BLOCK + k] != steps:
            steps = block[STEPS * BLOCK + k]
            decay, slope = _decay(model.constants[0, TSN_RATE], factor, steps, model.dt_s)
        nominal = block[VSN * BLOCK + k]
        by_tsn = decay * by_tsn + slope * (vsn - nominal)
        by_kn += (1.0 - decay) * (values[_KN, k] - by_kn)
        vsn += (1.0 - decay) * (nominal - vsn)
        values[_KN, k], values[_TSN, k] = -by_kn, -by_tsn
    return by_kn, by_tsn


@inlined
def _differentiate_nominal(block: FloatArray, values: FloatArray, size: int, q: float, constants: FloatArray) -> None:
    # The derivative of the steady state of Vsn by the logarithm of kn
    scale = 2.0 * constants[0, R_OVER_F] * constants[0, SURROUNDINGS]
    for k in range(size):
        xn, _ = surface_fractions(block[HALF * BLOCK + k], q, constants)
        argument = block[CURRENT * BLOCK + k] * constants[0, PER_CURRENT_N]
        values[_KN, k] = -scale * argument / np.sqrt(argument * argument + (1.0 - xn) * xn)


@inlined
def _differentiate_voltage(block: FloatArray, values: FloatArray, size: int, q: float) -> None:
    step_C = q * RELATIVE_STEP
    for k in range(size):
        slope, moved = block[SLOPE * BLOCK + k], block[MOVED * BLOCK + k]
        relaxation = block[FURTHER_VSN * BLOCK + k] - block[VSN * BLOCK + k]
        relaxation += block[FURTHER_VSP * BLOCK + k] - block[VSP * BLOCK + k]
        # the equilibrium is a function of moved / q
        by_moved = -(slope + relaxation / step_C) * q / max(moved, 1.0)
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
            order_1, order_2 = values[_EQUILIBRIUM + j - 1, k], values[_EQUILIBRIUM + j - 2, k]
            values[_EQUILIBRIUM + j, k] = ((2 * j - 1) * x * order_1 - (j - 1) * order_2) / j


@compiled
def _linearize(
    n: int,
    end: int,
    estimate: FloatArray,
    measurements: FloatArray,
    model: Any,
    constants: FloatArray,
    equilibrium_terms: FloatArray,
    sums: FloatArray,
) -> float:
    # Sum the products of the derivatives by all unknowns, and of the residual, over the readings of a cell; return the charge
    # drawn
    block, values, fit_constants = np.empty(BLOCK_SIZE), np.empty((len(sums), BLOCK)), model.constants.copy()
    q, r, logarithms = estimate[n, 0], estimate[n, 1], constants[n]
    fit_constants[0, PER_CURRENT_N] = model.constants[0, PER_CURRENT_N] / np.exp(logarithms[0])
    polynomial_p = np.zeros(POLYNOMIAL_SIZE)
    for k in range(POLYNOMIAL_SIZE):
        polynomial_p[k] = model.polynomial_p[k]
    for j in range(len(equilibrium_terms)):
        coefficient_V = logarithms[_EQUILIBRIUM - _KN + j]
        fit_constants[0, U0] += coefficient_V * equilibrium_terms[j, 0]
        for k in range(POLYNOMIAL_SIZE):
            polynomial_p[k] += coefficient_V * equilibrium_terms[j, 1 + k]
    share_n = min(model.dt_s * fit_constants[0, TSN_RATE] / np.exp(logarithms[3]), 0.99)
    share_p = model.dt_s * fit_constants[0, TSP_RATE]
    linear, overpotentials = _Linear(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), AT_REST
    by_constants, moved_before, drawn_C = (0.0, 0.0), 0.0, 0.0
    sums[:] = 0.0
    for low in range(0, end, BLOCK):
        size = min(BLOCK, end - low)
        load_readings(block, measurements, n, low, size)
        for k in range(size):
            drawn_C += block[CURRENT * BLOCK + k] * block[STEPS * BLOCK + k] * model.dt_s
        linear = _integrate_current(block, values, size, r, model, logarithms, linear)
        padded = pad_block(block, size, moved_before)
        moved_before = block[MOVED * BLOCK + size - 1]
        nominal_overpotentials_of_block(block, padded, q, fit_constants)
        _differentiate_nominal(block, values, padded, q, fit_constants)
        factor_n = np.exp(logarithms[3])
        by_constants = _differentiate_vsn(block, values, size, model, factor_n, overpotentials.vsn, by_constants)
        overpotentials = relax_block(block, size, share_n, share_p, overpotentials)
        voltages_of_block(block, padded, q, r, fit_constants, model.polynomial_n, polynomial_p)
        _differentiate_voltage(block, values, size, q)
        if len(equilibrium_terms) > 0:
            _differentiate_equilibrium(block, values, size, q, fit_constants)
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
    values: FloatArray,
    readings: int,
    least_noise_V: float,
    mean: FloatArray,
    units: FloatArray,
    precision: FloatArray,
    flat_precision: FloatArray,
    solution: FloatArray,
) -> None:
    # Write the step, its sds, the noise, and the sds of the parameters under a flat prior, into solution
    n = len(mean)
    matrix, inverse = np.empty((2, n, n))
    step, distance = np.empty(n), np.zeros(n)
    for j in range(n):
        if units[j] > 0.0:
            distance[j] = (mean[j] - values[j]) / units[j]
    residuals = sums[n, n]
    noise2 = max(residuals / readings, least_noise_V**2)
    for _ in range(_NOISE_ROUNDS):
        _normal_matrix(sums, noise2, units, precision, matrix)
        for j in range(n):
            step[j] = units[j] * sums[n, j] / noise2
            for m in range(n):
                step[j] += precision[j, m] * distance[m]
        _solve(matrix, step, inverse)
        sum_of_squares = residuals
        for j in range(n):
            sum_of_squares -= 2.0 * units[j] * step[j] * sums[n, j]
            for m in range(n):
                product = sums[max(j, m), min(j, m)]
                sum_of_squares += units[j] * step[j] * units[m] * step[m] * product
        noise2 = max(sum_of_squares / readings, least_noise_V**2)
    for j in range(n):
        solution[j] = units[j] * step[j]
        solution[n + j] = units[j] * np.sqrt(inverse[j, j])
    solution[2 * n] = np.sqrt(noise2)
    _normal_matrix(sums, noise2, units, flat_precision, matrix)
    _solve(matrix, step, inverse)
    for j in range(_R + 1):
        solution[2 * n + 1 + j] = units[j] * np.sqrt(inverse[j, j])


@compiled
def nuisance_step(
    rows: IntArray,
    count: IntArray,
    estimate: FloatArray,
    measurements: FloatArray,
    model: NDArray[np.void],
    constants: FloatArray,
    equilibrium_terms: FloatArray,
    prior: StepPrior,
    solution: FloatArray,
) -> None:
    # Take one Gauss-Newton step towards the best unknowns of each cell under their prior, into solution; unchecked. Arguments
    # as of summarise_residuals, and the equilibrium_terms of the coefficients among the constants
    unknowns = prior.mean.shape[1]
    sums, values = np.empty((unknowns + 1, unknowns + 1)), np.zeros(unknowns)
    for n in rows:
        drawn_C = _linearize(n, count[n], estimate, measurements, model[0], constants, equilibrium_terms, sums)
        values[_Q], values[_R] = estimate[n, 0], estimate[n, 1]
        values[_KN:] = constants[n]
        errors = independent_errors(max(drawn_C, 0.0), prior.errors_per_C)
        least_noise_V = np.sqrt(LEAST_NOISE_V**2 + prior.mismatch_V**2 * count[n] / errors)
        mean, units, precision, flat_precision = prior.mean[n], prior.units[n], prior.precision, prior.flat_precision
        _solve_under_priors(sums, values, count[n], least_noise_V, mean, units, precision, flat_precision, solution[n])
