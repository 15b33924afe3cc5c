"""What a fit that allows for wrong constants of the model and an offset of the sensor says about the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from battery_env.arrays import FloatArray, IntArray
from battery_env.calibration.readings import (
    BLOCK_SIZE,
    CURRENT,
    FURTHER_VSN,
    FURTHER_VSP,
    HALF,
    LANES,
    MEASURED,
    MOVED,
    OHMIC,
    RELATIVE_STEP,
    RESIDUAL,
    SLOPE,
    VSN,
    VSP,
    Readings,
    nominal_overpotentials_of_block,
    surface_fractions,
    voltages_of_block,
)
from battery_env.electrochemistry.cell import BULK_RATE, PER_CURRENT_N, R_OVER_F, SURFACE_RATE, UNCERTAIN_CONSTANTS
from battery_env.electrochemistry.kernels import BLOCK

# The unknowns: two parameters, the offset of the sensor, and the logarithms of UNCERTAIN_CONSTANTS
_Q, _R, _OFFSET, _KN, _TD, _TO, _TSN = range(7)
_UNKNOWNS = 7
_CONSTANTS = slice(_KN, _UNKNOWNS)
#: What :func:`nuisance_step` finds: a step and a standard deviation of every unknown, and at last the noise.
FOUND_SIZE = 2 * _UNKNOWNS + 1
_NOISE = 2 * _UNKNOWNS
#: Logarithms of constants are held within this many of their standard deviations.
REACH_SD = 3.0
# What the parts of an observation are divided by; standard deviations by this share of the range of the estimate
_VOLTAGE_SCALE_V = 0.010
_SD_SCALE = 0.01
# Noise is not taken for less, V.
_LEAST_NOISE_V = 0.001
# How often the noise is told anew from what the step leaves of the residuals
_NOISE_ROUNDS = 3

_compiled = njit(cache=True, error_model="numpy")
# sums in any order, which vector instructions need
_reassociating = njit(cache=True, error_model="numpy", fastmath={"reassoc"})
assert UNCERTAIN_CONSTANTS == ("kn", "tDiffusion", "to", "tsn")


class Fitted(NamedTuple):
    """
    What a fit says of each cell of a batch.

    :param estimate: (q_mobile, r_o) after its step, C and ohm, shape (cells, 2)
    :param sd: their standard deviations under the priors, 0 where one is known, same shape
    :param noise_V: root mean square of the residuals that it leaves, V, shape (cells,)
    :param offset_V: of the voltage sensor, V, shape (cells,)
    :param constants_sd: how far the constant lies from the model's that is the farthest, as a multiple of its standard
        deviation, shape (cells,)
    :param readings: to how many it is a fit, shape (cells,)
    :param white_V: white part of their noise, which no model can explain, V, shape (cells,); infinite where they are too few
    """

    estimate: FloatArray
    sd: FloatArray
    noise_V: FloatArray
    offset_V: FloatArray
    constants_sd: FloatArray
    readings: IntArray
    white_V: FloatArray


class NuisanceFit:
    """
    A fit for each cell of a batch: of the parameters, of the offset of the voltage sensor, and of the constants of the model
    that nobody knows exactly, each under a prior. One Gauss-Newton step is taken whenever the estimate moves or readings
    arrive; it moves the constants, and is shown to the agent, which moves the parameters.

    :param cells: size of the batch
    :param readings: of the discharges
    :param parameters: which of both are to be found
    :param ranges: where they are kept, C and ohm; a prior has the mean and the standard deviation of its range
    :param offset_V: bound of the offset, V
    :param nuisance: relative standard deviation of the constants
    :ivar logarithms: of the factors that the constants of the model are multiplied by, shape (cells, 4)
    """

    def __init__(
        self,
        cells: int,
        readings: Readings,
        parameters: Sequence[str],
        ranges: Mapping[str, tuple[float, float]],
        offset_V: float,
        nuisance: float,
    ) -> None:
        self._cell, self._rates = readings.cell, rates_of(readings)
        self._relaxed_p = 1.0 - float(readings.decay(self._cell.tsp))
        self._columns = [n for n, name in enumerate(ranges) if name in parameters]
        self._nuisance = nuisance
        limits = np.array(list(ranges.values()))
        unknown = [name in parameters for name in ranges]
        constants = np.full(len(UNCERTAIN_CONSTANTS), np.sqrt(np.log1p(nuisance**2)))
        self._prior_mean = np.concatenate([limits.mean(axis=1), np.zeros(1 + len(constants))])
        uniform = np.append(np.ptp(limits, axis=1) * unknown, 2.0 * offset_V) / np.sqrt(12.0)
        self._prior_sd = np.concatenate([uniform, constants])
        self.logarithms = np.zeros((cells, len(constants)))
        self._found = np.zeros((cells, FOUND_SIZE))
        self.observation_size = 2 * len(self._columns) + 2 + len(constants)

    def step(
        self,
        rows: IntArray,
        count: IntArray,
        first: IntArray,
        estimate: FloatArray,
        measured: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    ) -> None:
        """Take one step."""
        nuisance_step(
            rows,
            count,
            first,
            np.ascontiguousarray(estimate[:, 0]),
            np.ascontiguousarray(estimate[:, 1]),
            *measured,
            self._cell.Tb0,
            self._relaxed_p,
            self._rates,
            self.logarithms,
            *self._cell.packed,
            self._prior_mean,
            self._prior_sd,
            self._found,
        )
        limit = REACH_SD * self._prior_sd[_CONSTANTS]
        self.logarithms[rows] = np.clip(self.logarithms[rows] + self._found[rows, _CONSTANTS], -limit, limit)

    def found(self, estimate: FloatArray, readings: IntArray, white_V: FloatArray) -> Fitted:
        """What the last step found."""
        found = self._found.copy()
        step, sd = (found[:, start : start + 2] for start in (0, _UNKNOWNS))
        constants_sd = np.abs(self.logarithms / self._prior_sd[_CONSTANTS]).max(axis=1)
        return Fitted(estimate + step, sd, found[:, _NOISE], found[:, _OFFSET], constants_sd, readings, white_V)

    def parts(self, largest_step: FloatArray, width: FloatArray) -> list[FloatArray]:
        """What the agent sees."""
        step, sd = (self._found[:, start : start + 2][:, self._columns] for start in (0, _UNKNOWNS))
        return [
            np.clip(np.sign(step) * np.sqrt(np.abs(step) / largest_step), -1.0, 1.0),
            np.log(sd / (_SD_SCALE * width)),
            np.log(self._found[:, _NOISE, None] / _VOLTAGE_SCALE_V),
            np.arcsinh(self._found[:, _OFFSET, None] / _VOLTAGE_SCALE_V),
            self.logarithms / self._nuisance,
        ]


def rates_of(readings: Readings) -> FloatArray:
    """How quickly the model follows its current."""
    cell, constants = readings.cell, readings.cell.packed.constants[0]
    rate = constants[BULK_RATE] + constants[SURFACE_RATE]
    at_rest = constants[BULK_RATE] / rate
    return np.array([rate, 1.0 / cell.to, 1.0 / cell.tsn, at_rest, readings.interval_s, readings.dt_s])


@_compiled
def _decay(rate: float, factor: float, interval_s: float, dt_s: float) -> tuple[float, float]:
    # what is left after one interval if the time constant is multiplied by a factor, and the derivative by its logarithm
    share = min(dt_s * rate / factor, 0.99)
    steps = interval_s / dt_s
    left = (1.0 - share) ** steps
    return left, steps * left * share / (1.0 - share)


@_compiled
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


@_reassociating
def _add_products(values: FloatArray, begin: int, end: int, sums: FloatArray) -> None:
    for j in range(len(values)):
        for m in range(j + 1):
            total = 0.0
            for k in range(begin, end):
                total += values[j, k] * values[m, k]
            sums[j, m] += total


@_compiled
def nuisance_step(
    rows: IntArray,
    count: IntArray,
    first: IntArray,
    q_mobile: FloatArray,
    r_o: FloatArray,
    voltage_V: FloatArray,
    current_A: FloatArray,
    moved_C: FloatArray,
    ohmic_A: FloatArray,
    temperature_K: float,
    relaxed_p: float,
    rates: FloatArray,
    logarithms: FloatArray,
    constants: FloatArray,
    polynomial_n: FloatArray,
    polynomial_p: FloatArray,
    prior_mean: FloatArray,
    prior_sd: FloatArray,
    found: FloatArray,
) -> None:
    """
    One Gauss-Newton step towards the (q_mobile, r_o), offset and constants that explain the readings of each cell best under
    their priors; unchecked, all arrays contiguous. The arguments that :func:`battery_env.calibration.readings.explain` has too
    are the same.
    """
    rate_d, rate_o, rate_n, at_rest, interval_s, dt_s = rates
    left_d0, _ = _decay(rate_d, 1.0, interval_s, dt_s)
    left_o0, _ = _decay(rate_o, 1.0, interval_s, dt_s)
    gain_d0 = (1.0 - at_rest) * (1.0 - left_d0) / rate_d
    scale_n = 2.0 * constants[0, R_OVER_F] * temperature_K
    own, block = constants.copy(), np.empty(BLOCK_SIZE)
    # derivatives by all unknowns, and the residual; sums of their products
    rows_of_block, sums = np.empty((_UNKNOWNS + 1, BLOCK)), np.empty((_UNKNOWNS + 1, _UNKNOWNS + 1))
    matrix, inverse = np.empty((2, _UNKNOWNS, _UNKNOWNS))
    step, before = np.empty((2, _UNKNOWNS))
    for n in rows:
        q, r, begin, end = q_mobile[n], r_o[n], first[n], count[n]
        further_q, step_C = q * (1.0 + RELATIVE_STEP), q * RELATIVE_STEP
        factor_kn, factor_td, factor_to, factor_tsn = np.exp(logarithms[n])
        own[0, PER_CURRENT_N] = per_current = constants[0, PER_CURRENT_N] / factor_kn
        left_d, slope_d = _decay(rate_d, factor_td, interval_s, dt_s)
        left_o, slope_o = _decay(rate_o, factor_to, interval_s, dt_s)
        left_n, slope_n = _decay(rate_n, factor_tsn, interval_s, dt_s)
        gain_d = (1.0 - at_rest) * (1.0 - left_d) * factor_td / rate_d
        gain_slope_d = gain_d - (1.0 - at_rest) * slope_d * factor_td / rate_d
        sums[:] = 0.0
        unequal = unequal_0 = ohmic = ohmic_0 = half_before = by_kn = by_td = by_to = by_tsn = 0.0
        vsn = vsp = further_vsn = further_vsp = 0.0
        for low in range(0, end, BLOCK):
            size = min(BLOCK, end - low)
            padded = (size + LANES - 1) // LANES * LANES
            for k in range(padded):
                at = low + min(k, size - 1)
                current = current_A[n, at]
                if k < size:
                    # the current that makes this ohmic drop of the one before
                    effective = (ohmic_A[n, at] - left_o0 * ohmic_0) / (1.0 - left_o0)
                    ohmic_0 = ohmic_A[n, at]
                    by_to = left_o * by_to + slope_o * (ohmic - effective)
                    ohmic = left_o * ohmic + (1.0 - left_o) * effective
                    # what has left the surface, beyond its share at rest
                    by_td = left_d * by_td + slope_d * unequal + gain_slope_d * current
                    unequal = left_d * unequal + gain_d * current
                    unequal_0 = left_d0 * unequal_0 + gain_d0 * current
                moved = moved_C[n, at] + unequal - unequal_0
                block[MEASURED * BLOCK + k], block[CURRENT * BLOCK + k] = voltage_V[n, at], current
                block[MOVED * BLOCK + k], block[OHMIC * BLOCK + k] = moved, ohmic
                block[HALF * BLOCK + k] = 0.5 * (half_before + moved)
                half_before = moved
                rows_of_block[_TD, k], rows_of_block[_TO, k] = by_td, -r * by_to
            nominal_overpotentials_of_block(block, padded, q, further_q, temperature_K, own)
            for k in range(padded):
                xn, _ = surface_fractions(block[HALF * BLOCK + k], q, constants)
                argument = block[CURRENT * BLOCK + k] * per_current
                rows_of_block[_KN, k] = -scale_n * argument / np.sqrt(argument * argument + (1.0 - xn) * xn)
            for k in range(size):
                nominal = block[VSN * BLOCK + k]
                by_tsn = left_n * by_tsn + slope_n * (vsn - nominal)
                by_kn += (1.0 - left_n) * (rows_of_block[_KN, k] - by_kn)
                vsn += (1.0 - left_n) * (nominal - vsn)
                vsp += relaxed_p * (block[VSP * BLOCK + k] - vsp)
                further_vsn += (1.0 - left_n) * (block[FURTHER_VSN * BLOCK + k] - further_vsn)
                further_vsp += relaxed_p * (block[FURTHER_VSP * BLOCK + k] - further_vsp)
                block[VSN * BLOCK + k], block[VSP * BLOCK + k] = vsn, vsp
                block[FURTHER_VSN * BLOCK + k], block[FURTHER_VSP * BLOCK + k] = further_vsn, further_vsp
                rows_of_block[_KN, k], rows_of_block[_TSN, k] = -by_kn, -by_tsn
            voltages_of_block(block, padded, q, further_q, r, temperature_K, constants, polynomial_n, polynomial_p)
            for k in range(size):
                slope, moved = block[SLOPE * BLOCK + k], block[MOVED * BLOCK + k]
                relaxing = block[FURTHER_VSN * BLOCK + k] - block[VSN * BLOCK + k]
                relaxing += block[FURTHER_VSP * BLOCK + k] - block[VSP * BLOCK + k]
                # the equilibrium is a function of moved / q
                by_moved = -(slope + relaxing / step_C) * q / max(moved, 1.0)
                rows_of_block[_Q, k], rows_of_block[_R, k] = slope, -block[OHMIC * BLOCK + k]
                rows_of_block[_OFFSET, k], rows_of_block[_UNKNOWNS, k] = 1.0, block[RESIDUAL * BLOCK + k]
                rows_of_block[_TD, k] *= by_moved
            _add_products(rows_of_block, max(begin - low, 0), size, sums)
        readings, residuals = end - begin, sums[_UNKNOWNS, _UNKNOWNS]
        before[:] = 0.0
        before[_Q], before[_R] = q, r
        before[_KN:] = logarithms[n]
        noise2 = max(residuals / readings, _LEAST_NOISE_V**2)
        for _ in range(_NOISE_ROUNDS):
            for j in range(_UNKNOWNS):
                for m in range(j + 1):
                    matrix[j, m] = matrix[m, j] = prior_sd[j] * prior_sd[m] * sums[j, m] / noise2
                matrix[j, j] += 1.0
                step[j] = prior_sd[j] * sums[_UNKNOWNS, j] / noise2
                if prior_sd[j] > 0.0:
                    step[j] += (prior_mean[j] - before[j]) / prior_sd[j]
            _solve(matrix, step, inverse)
            left = residuals
            for j in range(_UNKNOWNS):
                left -= 2.0 * prior_sd[j] * step[j] * sums[_UNKNOWNS, j]
                for m in range(_UNKNOWNS):
                    product = sums[max(j, m), min(j, m)]
                    left += prior_sd[j] * step[j] * prior_sd[m] * step[m] * product
            noise2 = max(left / readings, _LEAST_NOISE_V**2)
        for j in range(_UNKNOWNS):
            found[n, j] = prior_sd[j] * step[j]
            found[n, _UNKNOWNS + j] = prior_sd[j] * np.sqrt(inverse[j, j])
        found[n, _NOISE] = np.sqrt(noise2)
