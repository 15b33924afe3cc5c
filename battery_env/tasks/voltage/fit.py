"""What a fit that allows for wrong constants of the model and an offset of the sensor says about the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.compiled import compiled, inlined, reassociating
from battery_env.electrochemistry.cell import (
    BULK_RATE,
    PER_CURRENT_N,
    R_OVER_F,
    SURFACE_RATE,
    SURROUNDINGS,
    TO_RATE,
    TSN_RATE,
    UNCERTAIN_CONSTANTS,
)
from battery_env.electrochemistry.kernels import BLOCK
from battery_env.parameters import columns_of
from battery_env.tasks.voltage.readings import (
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
    VSN,
    VSP,
    Overpotentials,
    Readings,
    nominal_overpotentials_of_block,
    pad_block,
    relax_block,
    surface_fractions,
    take_readings,
    voltages_of_block,
)

# The unknowns: two parameters, the offset of the sensor, and the logarithms of UNCERTAIN_CONSTANTS. In the values of a block
# they are rows of the derivatives of the voltage, and the residual is the row after them
_Q, _R, _OFFSET, _KN, _T_DIFFUSION, _TO, _TSN, _RESIDUAL = range(8)
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
        self._model = readings.model
        self._columns = columns_of(parameters)
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

    def step(self, rows: IntArray, count: IntArray, estimate: FloatArray, shown: FloatArray) -> None:
        """Take one step for some cells; the arguments are those of :func:`nuisance_step`."""
        priors = self._prior_mean, self._prior_sd
        nuisance_step(rows, count, estimate, shown, self._model, self.logarithms, *priors, self._found)
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


@compiled
def _decay(rate: float, factor: float, interval_s: float, dt_s: float) -> tuple[float, float]:
    # what is left after one interval if the time constant is multiplied by a factor, and the derivative by its logarithm
    share = min(dt_s * rate / factor, 0.99)
    steps = interval_s / dt_s
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

    left_d: float  # of charge that diffuses
    slope_d: float
    gain_d: float  # how much of a current leaves the surface beyond its share at rest
    gain_slope_d: float
    left_o: float  # of the ohmic drop
    slope_o: float
    left_n: float  # of Vsn
    slope_n: float
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
def _rates(model: Any, logarithms: FloatArray) -> _Rates:
    constants, interval_s, dt_s = model.constants, model.interval_s, model.dt_s
    rate_d = constants[0, BULK_RATE] + constants[0, SURFACE_RATE]
    at_rest = constants[0, BULK_RATE] / rate_d
    factor_d, factor_o, factor_n = np.exp(logarithms[1]), np.exp(logarithms[2]), np.exp(logarithms[3])
    left_d0, _ = _decay(rate_d, 1.0, interval_s, dt_s)
    left_o0, _ = _decay(constants[0, TO_RATE], 1.0, interval_s, dt_s)
    left_d, slope_d = _decay(rate_d, factor_d, interval_s, dt_s)
    left_o, slope_o = _decay(constants[0, TO_RATE], factor_o, interval_s, dt_s)
    left_n, slope_n = _decay(constants[0, TSN_RATE], factor_n, interval_s, dt_s)
    gain_d0 = (1.0 - at_rest) * (1.0 - left_d0) / rate_d
    gain_d = (1.0 - at_rest) * (1.0 - left_d) * factor_d / rate_d
    gain_slope_d = gain_d - (1.0 - at_rest) * slope_d * factor_d / rate_d
    return _Rates(left_d, slope_d, gain_d, gain_slope_d, left_o, slope_o, left_n, slope_n, left_d0, gain_d0, left_o0)


@inlined
def _follow_current(block: FloatArray, values: FloatArray, size: int, r_o: float, rates: _Rates, before: _Linear) -> _Linear:
    # From the states of the model's constants, in the block, to those of the fit, and their derivatives
    unequal, unequal_0, ohmic, ohmic_0, by_t_diffusion, by_to = before
    for k in range(size):
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
    block: FloatArray, values: FloatArray, size: int, rates: _Rates, vsn: float, before: tuple[float, float]
) -> tuple[float, float]:
    # The derivatives by kn and tsn from the values that Vsn tends to, which values has by kn; returns the last ones
    by_kn, by_tsn = before
    for k in range(size):
        nominal = block[VSN * BLOCK + k]
        by_tsn = rates.left_n * by_tsn + rates.slope_n * (vsn - nominal)
        by_kn += (1.0 - rates.left_n) * (values[_KN, k] - by_kn)
        vsn += (1.0 - rates.left_n) * (nominal - vsn)
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
        values[_OFFSET, k], values[_RESIDUAL, k] = 1.0, block[RESIDUAL * BLOCK + k]
        values[_T_DIFFUSION, k] *= by_moved


@compiled
def _linearize(
    n: int, end: int, estimate: FloatArray, shown: FloatArray, model: Any, logarithms: FloatArray, sums: FloatArray
) -> None:
    # The sums of products of the derivatives by all unknowns, and of the residual, over the readings of a cell
    block, values, own = np.empty(BLOCK_SIZE), np.empty((_UNKNOWNS + 1, BLOCK)), model.constants.copy()
    q, r = estimate[n, 0], estimate[n, 1]
    own[0, PER_CURRENT_N] = model.constants[0, PER_CURRENT_N] / np.exp(logarithms[n, 0])
    rates = _rates(model, logarithms[n])
    linear, overpotentials = _Linear(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), Overpotentials(0.0, 0.0, 0.0, 0.0)
    by_constants, moved_before = (0.0, 0.0), 0.0
    sums[:] = 0.0
    for low in range(0, end, BLOCK):
        size = min(BLOCK, end - low)
        take_readings(block, shown, n, low, size)
        linear = _follow_current(block, values, size, r, rates, linear)
        padded = pad_block(block, size, moved_before)
        moved_before = block[MOVED * BLOCK + size - 1]
        nominal_overpotentials_of_block(block, padded, q, own)
        _differentiate_nominal(block, values, padded, q, own)
        by_constants = _differentiate_vsn(block, values, size, rates, overpotentials.vsn, by_constants)
        overpotentials = relax_block(block, size, 1.0 - rates.left_n, model.relaxed_p, overpotentials)
        voltages_of_block(block, padded, q, r, model)
        _differentiate_voltage(block, values, size, q)
        _add_products(values, size, sums)


@compiled
def _solve_under_priors(
    sums: FloatArray,
    before: FloatArray,
    readings: int,
    prior_mean: FloatArray,
    prior_sd: FloatArray,
    found: FloatArray,
) -> None:
    # The step, its standard deviations and the noise, into found of shape (FOUND_SIZE,)
    matrix, inverse = np.empty((2, _UNKNOWNS, _UNKNOWNS))
    step = np.empty(_UNKNOWNS)
    residuals = sums[_RESIDUAL, _RESIDUAL]
    noise2 = max(residuals / readings, _LEAST_NOISE_V**2)
    for _ in range(_NOISE_ROUNDS):
        for j in range(_UNKNOWNS):
            for m in range(j + 1):
                matrix[j, m] = matrix[m, j] = prior_sd[j] * prior_sd[m] * sums[j, m] / noise2
            matrix[j, j] += 1.0
            step[j] = prior_sd[j] * sums[_RESIDUAL, j] / noise2
            if prior_sd[j] > 0.0:
                step[j] += (prior_mean[j] - before[j]) / prior_sd[j]
        _solve(matrix, step, inverse)
        left = residuals
        for j in range(_UNKNOWNS):
            left -= 2.0 * prior_sd[j] * step[j] * sums[_RESIDUAL, j]
            for m in range(_UNKNOWNS):
                product = sums[max(j, m), min(j, m)]
                left += prior_sd[j] * step[j] * prior_sd[m] * step[m] * product
        noise2 = max(left / readings, _LEAST_NOISE_V**2)
    for j in range(_UNKNOWNS):
        found[j] = prior_sd[j] * step[j]
        found[_UNKNOWNS + j] = prior_sd[j] * np.sqrt(inverse[j, j])
    found[_NOISE] = np.sqrt(noise2)


@compiled
def nuisance_step(
    rows: IntArray,
    count: IntArray,
    estimate: FloatArray,
    shown: FloatArray,
    model: NDArray[np.void],
    logarithms: FloatArray,
    prior_mean: FloatArray,
    prior_sd: FloatArray,
    found: FloatArray,
) -> None:
    """
    One Gauss-Newton step towards the (q_mobile, r_o), offset and constants that explain the readings of each cell best under
    their priors; unchecked, all arrays contiguous. The arguments that :func:`battery_env.tasks.voltage.readings.explain` has
    too are the same.

    :param logarithms: of the factors that the constants of the model are multiplied by, shape (n, 4)
    :param prior_mean: of all unknowns, shape (7,)
    :param prior_sd: their standard deviations, 0 where one is known, same shape
    :param found: overwritten: step, standard deviations and noise, shape (n, FOUND_SIZE)
    """
    sums, before = np.empty((_UNKNOWNS + 1, _UNKNOWNS + 1)), np.zeros(_UNKNOWNS)
    for n in rows:
        _linearize(n, count[n], estimate, shown, model[0], logarithms, sums)
        before[_Q], before[_R] = estimate[n, 0], estimate[n, 1]
        before[_KN:] = logarithms[n]
        _solve_under_priors(sums, before, count[n], prior_mean, prior_sd, found[n])
