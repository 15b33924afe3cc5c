"""Readings of voltage and current of a discharge, and the model's misfit to all readings so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.compiled import compiled, inlined
from battery_env.electrochemistry import (
    FULL_CHARGE_SHARES,
    NEW_CELL,
    QNB,
    QNS,
    QPS,
    VO,
    CellParameters,
    Trajectory,
    initial_state,
    simulate,
)
from battery_env.electrochemistry.cell import (
    CONSTANTS_SIZE,
    POLYNOMIAL_SIZE,
    SURROUNDINGS,
    TSN_RATE,
    TSP_RATE,
)
from battery_env.electrochemistry.kernels import BLOCK, equilibrium_voltage, mole_fraction, nominal_overpotentials
from battery_env.records import Record, check_record, resample_current

# A charge that no discharge empties: one simulation then gives the linear part of the model
_LARGE_CHARGE_C = 1e6
# Share of q_mobile in the surface of each electrode at full charge
_SURFACE_SHARE_N, _SURFACE_SHARE_P = (float(FULL_CHARGE_SHARES[column - QNB]) for column in (QNS, QPS))
#: Step of the difference quotient dV/dq, as a share of q.
RELATIVE_STEP = 1e-3
# A current is above a mean only by more than this, A: less is rounding
_EQUAL_A = 1e-9

# The kernels compare readings in blocks: one array, in rows that start at constant multiples. The compiler uses vector
# instructions where it can tell that rows do not overlap, and where a reading does not depend on the previous reading
MEASURED, CURRENT, MOVED, OHMIC, STEPS, HALF, VSN, VSP, FURTHER_VSN, FURTHER_VSP, MODELLED, RESIDUAL, SLOPE = range(13)
BLOCK_SIZE = 13 * BLOCK
#: The first rows are measurements: voltage, V, mean current since the previous reading, A, charge that has left the surface of
#: the negative electrode, C, ohmic drop per ohm, A, and steps of the model since the previous reading.
SENSOR_ROWS = 5
# largest number of values of one instruction (AVX-512)
_LANES = 8

#: The model for the kernels, one record.
MODEL = np.dtype(
    [
        ("constants", float, (1, CONSTANTS_SIZE)),
        ("polynomial_n", float, (POLYNOMIAL_SIZE,)),
        ("polynomial_p", float, (POLYNOMIAL_SIZE,)),
        ("dt_s", float),
    ]
)


@dataclass(frozen=True, eq=False)
class Readings:
    """
    Discharges from full charge, read at their samples, with the linear part of the model under their current.

    At a fixed current the charges of the model are linear in ``q_mobile``, and its ohmic drop is linear in ``r_o``; so two
    numbers a reading give both for every (q_mobile, r_o). Only the surface overpotentials need a new integration, one step a
    reading (:func:`summarise_residuals`). The arrays of all discharges are concatenated.
    """

    start: IntArray  # first reading of each discharge, shape (n,)
    start_s: FloatArray  # time of its first sample, s, shape (n,)
    count: IntArray  # number of its readings, shape (n,)
    sample: IntArray  # sample of each reading in its discharge, shape (total,), as all arrays down to ``ohmic_A``
    time_s: FloatArray  # of the readings since the first sample, s
    voltage_V: FloatArray  # terminal voltage
    current_A: FloatArray  # mean since the previous reading
    drawn_C: FloatArray  # charge drawn since the start
    moved_C: FloatArray  # charge that has left the surface of the negative electrode
    ohmic_A: FloatArray  # ohmic drop per ohm of ``r_o``
    q_mobile: FloatArray  # true value, C, NaN if unknown, shape (n,)
    r_o: FloatArray  # true value, ohm, NaN if unknown, shape (n,)
    interval_s: float  # least time between readings, s
    dt_s: float  # time step of the model, s; all readings are at multiples of it
    cell: CellParameters  # constants of the model

    @classmethod
    def of(
        cls,
        records: Sequence[Record],
        interval_s: float | tuple[float, float] = 10.0,
        dt_s: float = 1.0,
        cell: CellParameters = NEW_CELL,
    ) -> Readings:
        """
        Read discharges at samples at least ``interval_s`` apart, a whole number of steps. With (least, most) each discharge
        draws a mean interval, and each interval is 0.5 to 1.5 times the mean, as testers write them. If a record has
        ``is_measured``, shape (K,), only these samples have a voltage.
        """
        low_s, high_s = interval_s if isinstance(interval_s, Sequence) else (interval_s, interval_s)
        least_steps = round(low_s / dt_s)
        if least_steps < 1 or abs(least_steps * dt_s - low_s) > 1e-9 * low_s:
            raise ValueError(f"interval_s must be a multiple of the time step, {dt_s:g} s, got {low_s!r}")
        if not low_s <= high_s < np.inf:
            raise ValueError(f"interval_s must be (least, most) with least <= most, got {interval_s!r}")
        rng = np.random.default_rng(0)
        columns: list[tuple[FloatArray, ...]] = []
        for n, record in enumerate(records):
            samples = check_record(record, least_samples=2)
            time_s = samples.time_s - samples.time_s[0]
            intervals = np.full(len(time_s), float(least_steps))
            if high_s > low_s:
                intervals = np.exp(rng.uniform(np.log(low_s), np.log(high_s))) / dt_s * rng.uniform(0.5, 1.5, len(time_s))
            candidates = np.flatnonzero(getattr(record, "is_measured", np.ones(len(time_s), dtype=np.bool_)))
            rows = candidates[_thin(np.rint(time_s[candidates] / dt_s), intervals)]
            if len(rows) < 2:
                raise ValueError(f"discharge {n} lasts {time_s[-1]:g} s, at least two readings {low_s:g} s apart are needed")
            steps = np.rint(time_s[rows] / dt_s).astype(np.int64)
            current_A = resample_current(time_s, samples.current_A, dt_s, int(steps[-1]))
            drawn_C, moved_C, ohmic_A = _linear_part(current_A, steps, dt_s, cell)
            mean_A = np.diff(drawn_C, prepend=0.0) / (dt_s * np.diff(steps, prepend=0))
            columns.append((rows, dt_s * steps, samples.voltage_V[rows], mean_A, drawn_C, moved_C, ohmic_A))
        if not columns:
            raise ValueError("there must be at least one discharge to read")
        counts = np.array([len(column[0]) for column in columns], dtype=np.int64)
        sample, at_s, voltage_V, current_A, drawn_C, moved_C, ohmic_A = map(np.concatenate, zip(*columns, strict=True))
        return cls(
            start=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64),
            start_s=np.array([float(record.time_s[0]) for record in records]),
            count=counts,
            sample=sample,
            time_s=at_s,
            voltage_V=voltage_V,
            current_A=current_A,
            drawn_C=drawn_C,
            moved_C=moved_C,
            ohmic_A=ohmic_A,
            q_mobile=np.array([r.q_mobile if isinstance(r, Trajectory) else np.nan for r in records]),
            r_o=np.array([r.r_o if isinstance(r, Trajectory) else np.nan for r in records]),
            interval_s=low_s,
            dt_s=dt_s,
            cell=cell,
        )

    def __len__(self) -> int:
        return len(self.count)

    def rows_of(self, discharge: int) -> slice:
        """Return the rows of the readings of one discharge."""
        return slice(int(self.start[discharge]), int(self.start[discharge] + self.count[discharge]))

    def exact_measurements(self, discharge: int) -> FloatArray:
        """Return the measurements of exact sensors of one discharge, shape (SENSOR_ROWS, readings)."""
        return self._all_measurements[:, self.rows_of(discharge)]

    @cached_property
    def _all_measurements(self) -> FloatArray:
        return np.stack([self.voltage_V, self.current_A, self.moved_C, self.ohmic_A, self._steps])

    @cached_property
    def _steps(self) -> FloatArray:
        """Steps of the model since the previous reading."""
        steps = np.diff(self.time_s, prepend=0.0)
        steps[self.start] = self.time_s[self.start]
        return np.rint(steps / self.dt_s)

    @cached_property
    def model(self) -> NDArray[np.void]:
        """The record of the model for the kernels, shape (1,)."""
        model, cell = np.zeros(1, dtype=MODEL), self.cell
        for name, value in {**cell.packed._asdict(), "dt_s": self.dt_s}.items():
            model[name] = value
        return model

    def process_noise_V(self, discharge: int, deviation: float, draws: FloatArray) -> FloatArray:
        """Return the noise of the voltage, at the readings of one discharge, from white noise on Vo, Vsn and Vsp."""
        cell, dt_s = self.cell, self.dt_s
        total = np.zeros(draws.shape[1])
        for draw, time_constant_s in zip(draws, (cell.to, cell.tsn, cell.tsp), strict=True):
            decay = (1.0 - dt_s / time_constant_s) ** self._steps[self.rows_of(discharge)]
            # the variance of a sum of decaying steps over one interval
            variance = dt_s * (1.0 - decay**2) / (1.0 - (1.0 - dt_s / time_constant_s) ** 2)
            total -= _decaying_sum(deviation * np.sqrt(variance) * draw, decay)
        return total

    def with_sensor(self, discharge: int, gain: float, offset_A: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the current rows of another current sensor in one discharge; all of them are linear in the current."""
        rows = self.rows_of(discharge)
        steps = np.rint(self.time_s[rows] / self.dt_s).astype(np.int64)
        _, moved_by_unit, ohmic_by_unit = _linear_part(np.ones(int(steps[-1])), steps, self.dt_s, self.cell)
        return (
            gain * self.current_A[rows] + offset_A,
            gain * self.moved_C[rows] + offset_A * moved_by_unit,
            gain * self.ohmic_A[rows] + offset_A * ohmic_by_unit,
        )


@compiled
def _thin(steps: FloatArray, intervals: FloatArray) -> IntArray:
    # samples at least these intervals apart, and the first interval after the start
    rows, last = np.empty(len(steps), np.int64), 0.0
    count = 0
    for k in range(len(steps)):
        if steps[k] - last >= intervals[count]:
            rows[count], last = k, steps[k]
            count += 1
    return rows[:count]


@compiled
def _decaying_sum(increments: FloatArray, decay: FloatArray) -> FloatArray:
    # a quantity that decays over each interval, plus the increments of the intervals
    values, value = np.empty(len(increments)), 0.0
    for k in range(len(increments)):
        value = decay[k] * value + increments[k]
        values[k] = value
    return values


def _linear_part(
    current_A: FloatArray, steps: IntArray, dt_s: float, cell: CellParameters
) -> tuple[FloatArray, FloatArray, FloatArray]:
    start = initial_state(_LARGE_CHARGE_C, cell)
    state = simulate(
        np.append(current_A, 0.0),
        _LARGE_CHARGE_C,
        1.0,  # ohm, so that the ohmic drop is in A
        dt=dt_s,
        load_unit="current",
        cell=cell,
        cut_off_V=-np.inf,
        until=len(current_A) * dt_s,
    ).state
    if len(state) <= steps[-1]:
        drawn_C = dt_s * float(current_A.sum())
        raise ValueError(
            f"a discharge draws {drawn_C:.6g} C, far more than such a cell holds: check the units of current and time"
        )
    state = state[steps]
    moved_C = start[QNS] - state[:, QNS]
    return moved_C + start[QNB] - state[:, QNB], moved_C, state[:, VO]


class Overpotentials(NamedTuple):
    """Surface overpotentials at a reading, V."""

    vsn: float  # negative electrode
    vsp: float  # positive electrode
    further_vsn: float  # negative electrode at q (1 + ``RELATIVE_STEP``)
    further_vsp: float  # positive electrode at q (1 + ``RELATIVE_STEP``)


#: Before the first reading.
AT_REST = Overpotentials(0.0, 0.0, 0.0, 0.0)


@inlined
def load_readings(block: FloatArray, measurements: FloatArray, n: int, first: int, size: int) -> None:
    for row in range(SENSOR_ROWS):
        for k in range(size):
            block[row * BLOCK + k] = measurements[row, n, first + k]


@inlined
def pad_block(block: FloatArray, size: int, moved_before: float) -> int:
    # Repeat the last reading up to a multiple of the vector length, and return this length. The overpotentials relax towards
    # their value half way between two readings
    padded = (size + _LANES - 1) // _LANES * _LANES
    for row in range(SENSOR_ROWS):
        for k in range(size, padded):
            block[row * BLOCK + k] = block[row * BLOCK + size - 1]
    block[HALF * BLOCK] = 0.5 * (moved_before + block[MOVED * BLOCK])
    for k in range(1, padded):
        block[HALF * BLOCK + k] = 0.5 * (block[MOVED * BLOCK + k - 1] + block[MOVED * BLOCK + k])
    return padded


@inlined
def surface_fractions(moved: float, q: float, constants: FloatArray) -> tuple[float, float]:
    xn = mole_fraction(_SURFACE_SHARE_N * q - moved, q, True, constants)
    return xn, mole_fraction(_SURFACE_SHARE_P * q + moved, q, True, constants)


@compiled
def nominal_overpotentials_of_block(block: FloatArray, size: int, q: float, constants: FloatArray) -> None:
    further_q, temperature_K = q * (1.0 + RELATIVE_STEP), constants[0, SURROUNDINGS]
    for k in range(size):
        current, half = block[CURRENT * BLOCK + k], block[HALF * BLOCK + k]
        xn, xp = surface_fractions(half, q, constants)
        vsn, vsp = nominal_overpotentials(current, xn, xp, temperature_K, constants)
        block[VSN * BLOCK + k], block[VSP * BLOCK + k] = vsn, vsp
        xn, xp = surface_fractions(half, further_q, constants)
        vsn, vsp = nominal_overpotentials(current, xn, xp, temperature_K, constants)
        block[FURTHER_VSN * BLOCK + k], block[FURTHER_VSP * BLOCK + k] = vsn, vsp


@inlined
def relax_block(block: FloatArray, size: int, share_n: float, share_p: float, previous: Overpotentials) -> Overpotentials:
    # Replace the steady states of the overpotentials by the relaxed overpotentials; return the last ones
    vsn, vsp, further_vsn, further_vsp = previous
    steps, relaxation_n, relaxation_p = 0.0, 0.0, 0.0
    for k in range(size):
        if block[STEPS * BLOCK + k] != steps:
            steps = block[STEPS * BLOCK + k]
            relaxation_n, relaxation_p = 1.0 - (1.0 - share_n) ** steps, 1.0 - (1.0 - share_p) ** steps
        vsn += relaxation_n * (block[VSN * BLOCK + k] - vsn)
        vsp += relaxation_p * (block[VSP * BLOCK + k] - vsp)
        further_vsn += relaxation_n * (block[FURTHER_VSN * BLOCK + k] - further_vsn)
        further_vsp += relaxation_p * (block[FURTHER_VSP * BLOCK + k] - further_vsp)
        block[VSN * BLOCK + k], block[VSP * BLOCK + k] = vsn, vsp
        block[FURTHER_VSN * BLOCK + k], block[FURTHER_VSP * BLOCK + k] = further_vsn, further_vsp
    return Overpotentials(vsn, vsp, further_vsn, further_vsp)


@compiled
def voltages_of_block(
    block: FloatArray,
    size: int,
    q: float,
    r_o: float,
    constants: FloatArray,
    polynomial_n: FloatArray,
    polynomial_p: FloatArray,
) -> None:
    further_q, step_C, temperature_K = q * (1.0 + RELATIVE_STEP), q * RELATIVE_STEP, constants[0, SURROUNDINGS]
    for k in range(size):
        moved, ohmic_V = block[MOVED * BLOCK + k], r_o * block[OHMIC * BLOCK + k]
        xn, xp = surface_fractions(moved, q, constants)
        equilibrium = equilibrium_voltage(xn, xp, temperature_K, constants, polynomial_n, polynomial_p)
        modelled = equilibrium - block[VSN * BLOCK + k] - block[VSP * BLOCK + k] - ohmic_V
        xn, xp = surface_fractions(moved, further_q, constants)
        equilibrium = equilibrium_voltage(xn, xp, temperature_K, constants, polynomial_n, polynomial_p)
        further = equilibrium - block[FURTHER_VSN * BLOCK + k] - block[FURTHER_VSP * BLOCK + k] - ohmic_V
        block[MODELLED * BLOCK + k] = modelled
        block[RESIDUAL * BLOCK + k] = block[MEASURED * BLOCK + k] - modelled
        block[SLOPE * BLOCK + k] = (further - modelled) / step_C


@inlined
def _mean_of_halves(
    residual: FloatArray, slope: FloatArray, ohmic: FloatArray, low: int, high: int, means: FloatArray
) -> None:
    # Write the means over the readings below and above the mean current of a stretch into means, shape (3, 2)
    middle_A = 0.0
    for k in range(low, high):
        middle_A += ohmic[k]
    middle_A = middle_A / (high - low) + _EQUAL_A
    # adding zeros costs less than a branch that the processor cannot predict
    residual_0 = residual_1 = slope_0 = slope_1 = ohmic_0 = ohmic_1 = 0.0
    count_1 = 0
    for k in range(low, high):
        r, s, o = residual[k], slope[k], ohmic[k]
        is_above = o > middle_A
        residual_0 += 0.0 if is_above else r
        residual_1 += r if is_above else 0.0
        slope_0 += 0.0 if is_above else s
        slope_1 += s if is_above else 0.0
        ohmic_0 += 0.0 if is_above else o
        ohmic_1 += o if is_above else 0.0
        count_1 += 1 if is_above else 0
    count_0 = high - low - count_1
    if count_1 == 0:
        # under a constant current there is one half only
        residual_1, slope_1, ohmic_1, count_1 = residual_0, slope_0, ohmic_0, count_0
    means[0, 0], means[0, 1] = residual_0 / count_0, residual_1 / count_1
    means[1, 0], means[1, 1] = slope_0 / count_0, slope_1 / count_1
    means[2, 0], means[2, 1] = ohmic_0 / count_0, ohmic_1 / count_1


@compiled
def summarise_residuals(
    rows: IntArray,
    count: IntArray,
    estimate: FloatArray,
    measurements: FloatArray,
    model: NDArray[np.void],
    means: FloatArray,
    rms_V: FloatArray,
    last_V: FloatArray,
) -> None:
    """
    Compare the model with the first readings of many cells; unchecked, all arrays contiguous.

    :param rows: indices of the cells, of n cells
    :param count: number of readings of each cell, shape (n,)
    :param estimate: q_mobile and r_o, shape (n, 2)
    :param measurements: as of :meth:`Readings.exact_measurements`, shape (SENSOR_ROWS, n, most readings)
    :param means: overwritten: of the residual, dV/dq and the ohmic drop per ohm over the readings with less and with more
        current in equal stretches, shape (3, n, stretches, 2)
    :param rms_V: overwritten: root mean square of the residuals, shape (n,)
    :param last_V: overwritten: modelled voltage at the last reading, shape (n,)
    """
    stretches, block = means.shape[2], np.empty(BLOCK_SIZE)
    # measured minus modelled voltage, and dV/dq, of all readings of one cell
    residual, slope = np.empty((2, measurements.shape[2]))
    cell = model[0]
    constants = cell.constants
    share_n, share_p = cell.dt_s * constants[0, TSN_RATE], cell.dt_s * constants[0, TSP_RATE]
    for n in rows:
        readings, q, r = count[n], estimate[n, 0], estimate[n, 1]
        moved_before, overpotentials = 0.0, AT_REST
        for low in range(0, readings, BLOCK):
            size = min(BLOCK, readings - low)
            load_readings(block, measurements, n, low, size)
            padded = pad_block(block, size, moved_before)
            moved_before = block[MOVED * BLOCK + size - 1]
            nominal_overpotentials_of_block(block, padded, q, constants)
            overpotentials = relax_block(block, size, share_n, share_p, overpotentials)
            voltages_of_block(block, padded, q, r, constants, cell.polynomial_n, cell.polynomial_p)
            for k in range(size):
                residual[low + k] = block[RESIDUAL * BLOCK + k]
                slope[low + k] = block[SLOPE * BLOCK + k]
            last_V[n] = block[MODELLED * BLOCK + size - 1]
        square = 0.0
        for k in range(readings):
            square += residual[k] ** 2
        rms_V[n] = np.sqrt(square / readings)
        for j in range(stretches):
            low = j * readings // stretches
            high = max(low + 1, (j + 1) * readings // stretches)
            _mean_of_halves(residual, slope, measurements[OHMIC, n], low, high, means[:, n, j])
