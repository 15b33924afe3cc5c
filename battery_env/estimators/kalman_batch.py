"""Many Kalman filters side by side, in one compiled call a sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import check_numbers
from battery_env.electrochemistry import PackedConstants
from battery_env.electrochemistry.tangents import PolynomialDerivatives
from battery_env.estimates import Estimates
from battery_env.estimators.base import OnlineBatch
from battery_env.estimators.kalman import DRAWN, SAMPLES, TIME, ZERO_CELSIUS_K, ExtendedKalmanFilter
from battery_env.estimators.kalman_bank import OUT_SIZE, Bank, Settings, follow
from battery_env.estimators.monitor import Limits, Monitor, watch
from battery_env.records import are_plausible


class _Stack(NamedTuple):
    """What the filters of all cells know, one row a cell; each filter holds its row."""

    bank: Bank
    monitor: Monitor
    constants: FloatArray  # of the models, shape (cells, 1, 13)
    start_V: FloatArray
    numbers: FloatArray


class KalmanBatch(OnlineBatch):
    """
    Cells side by side, each followed by a filter of its own with the same arguments. All filters that have had their first
    sample take the next one in one compiled call, with the same numbers as alone.

    :param estimator: what to copy; it stays as it is
    :param cells: how many
    :raises ValueError: for no cells
    """

    estimators: Sequence[ExtendedKalmanFilter]

    def __init__(self, estimator: ExtendedKalmanFilter, cells: int) -> None:
        super().__init__(estimator, cells)
        first = self.estimators[0]

        def rows(array: FloatArray) -> FloatArray:
            return np.empty((cells, *array.shape), dtype=array.dtype)

        self._stack = _Stack(
            Bank(*map(rows, first._bank)),
            Monitor(*map(rows, first._monitor)),
            rows(first.cell.packed.constants),
            np.empty(cells),
            rows(first._numbers),
        )
        self._rows: list[Bank | None] = [None] * cells

    def _adopt(self, n: int) -> None:
        """Let the filter of a cell hold its row, after it began anew."""
        estimator, stack = self.estimators[n], self._stack
        for own, all_of in ((estimator._bank, stack.bank), (estimator._monitor, stack.monitor)):
            for array, row in zip(own, all_of, strict=True):
                row[n] = array
        stack.constants[n], stack.start_V[n] = estimator._model_cell.packed.constants, estimator._limits.start_V
        stack.numbers[n] = estimator._numbers
        estimator._bank = self._rows[n] = Bank(*(row[n] for row in stack.bank))
        estimator._monitor = Monitor(*(row[n] for row in stack.monitor))
        estimator._numbers = stack.numbers[n]

    def update(
        self, voltage_V: ArrayLike, current_A: ArrayLike, dt_s: ArrayLike, temperature_C: ArrayLike | None = None
    ) -> Estimates:
        """Take in one sample of each cell: of all, or of none if one is refused."""
        cells, one = len(self.estimators), self.estimators[0]
        if one.told_from_rest:  # filters begin anew with each sample of a rest
            return Estimates.of(super().update(voltage_V, current_A, dt_s, temperature_C))
        for n, (estimator, row) in enumerate(zip(self.estimators, self._rows, strict=True)):
            if estimator._bank is not row:
                self._adopt(n)
        if (self._stack.numbers[:, SAMPLES] == 0.0).any():
            return Estimates.of(super().update(voltage_V, current_A, dt_s, temperature_C))
        columns = {"voltage_V": voltage_V, "current_A": current_A, "dt_s": dt_s}
        volts, amperes, since_s = (np.broadcast_to(check_numbers(name, each), cells) for name, each in columns.items())
        degrees_C = np.full(cells, np.nan)
        if temperature_C is not None:
            degrees_C = np.broadcast_to(np.asarray(temperature_C, dtype=np.float64), cells)
        before_A = self._stack.bank.memory[:, 0]
        doubtful = ~are_plausible(volts, amperes, since_s, None if temperature_C is None else degrees_C, before_A)
        numbers = self._stack.numbers
        drawn_C = numbers[:, DRAWN] + before_A * since_s
        doubtful |= ~(drawn_C > one.least_drawn_C)
        if doubtful.any():
            # as objects, as a temperature may be missing (None) but not be NaN
            given_C = np.broadcast_to(np.asarray(temperature_C, dtype=object), cells).tolist()
            for n in np.flatnonzero(doubtful).tolist():
                try:
                    self.estimators[n].check(float(volts[n]), float(amperes[n]), float(since_s[n]), given_C[n])
                except ValueError as error:
                    raise ValueError(f"cell {n}: {error}") from error
        out, codes = np.empty((cells, OUT_SIZE)), np.empty(cells, dtype=np.int64)
        packed = one.cell.packed
        _follow_all(
            self._stack.bank,
            self._stack.monitor,
            self._stack.constants,
            self._stack.start_V,
            volts,
            amperes,
            since_s,
            degrees_C + ZERO_CELSIUS_K,
            drawn_C,
            one._settings,
            packed,
            one._derivatives,
            one._limits,
            out,
            codes,
        )
        numbers[:, SAMPLES] += 1.0
        numbers[:, TIME] += since_s
        numbers[:, DRAWN] = drawn_C
        return self._estimates(out, codes)

    def _estimates(self, out: FloatArray, codes: IntArray) -> Estimates:
        q, r_o, sd_q, sd_r_o = out[:, :4].T
        searched = self.estimators[0]._limits.searched
        sd_q, sd_r_o = (sd if known else np.full(len(sd), np.nan) for sd, known in zip((sd_q, sd_r_o), searched, strict=True))
        monitor, start_V = self._stack.monitor.memory.copy(), self._stack.start_V.copy()

        def reason(n: int) -> str:
            if not codes[n]:
                return ""
            estimator = self.estimators[n]
            seen = estimator._monitor._replace(memory=monitor[n])
            return seen.texts(float(start_V[n]), estimator.initial_soc[0])[int(codes[n])]

        return Estimates(q, r_o, sd_q, sd_r_o, codes == 0, reason)


@njit(cache=True, error_model="numpy")
def _follow_all(
    banks: Bank,
    monitors: Monitor,
    constants: FloatArray,
    start_V: FloatArray,
    voltage: FloatArray,
    current: FloatArray,
    duration: FloatArray,
    temperature: FloatArray,
    drawn_C: FloatArray,
    settings: Settings,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    limits: Limits,
    out: FloatArray,
    codes: IntArray,
) -> None:
    # one sample of each cell, as ExtendedKalmanFilter takes it
    for n in range(voltage.shape[0]):
        bank = Bank(
            banks.state[n],
            banks.tangents[n],
            banks.mean[n],
            banks.covariance[n],
            banks.log_weight[n],
            banks.shown[n],
            banks.innovation[n],
            banks.expected_V[n],
            banks.seen[n],
            banks.memory[n],
        )
        of_cell = PackedConstants(constants[n], packed.polynomial_n, packed.polynomial_p)
        one = slice(n, n + 1)
        samples = (voltage[one], current[one], duration[one])
        follow(bank, samples[0], samples[1], samples[2], temperature[one], settings, of_cell, derivatives, out[one])
        monitor = Monitor(monitors.memory[n], monitors.kept[n], monitors.changes[n])
        own = Limits(
            start_V[n],
            limits.needs_rest,
            limits.rested,
            limits.searched,
            limits.bounds,
            limits.prior,
            limits.scale_sd,
            limits.plausible_C,
            limits.cell_q_mobile,
        )
        watch(monitor, samples[0], samples[1], samples[2], drawn_C[one], own, out[one], codes[one])
