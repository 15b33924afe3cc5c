"""The model under the current of a record: its voltage during and after the record, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray
from battery_env.checks import check_not_negative
from battery_env.electrochemistry import (
    FULL_CHARGE_SHARES,
    QNB,
    STATE_SIZE,
    CellParameters,
    Trajectory,
    check_cell,
    check_dt,
    initial_state,
    rest_shares,
    simulate,
)
from battery_env.electrochemistry.aging_path import cell_with
from battery_env.electrochemistry.ends import LONGEST_S, Cells, FutureLoad, simulate_to_cut_off
from battery_env.electrochemistry.tangents import TANGENT_NAMES, PolynomialDerivatives, least_q_mobile, roll_out_with_tangents
from battery_env.estimates import Estimate
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.records.load import expected_current, integrate_load, resample_current
from battery_env.records.samples import Record, Samples, check_record

# The total of the four charges is q_mobile / 0.6 at all times.
_Q_PER_CHARGE = 1.0 / float(FULL_CHARGE_SHARES.sum())

#: The error of the model at the end of a record is the mean over this last share of its time.
RECENT_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class VoltageForecast:
    """
    The voltage of the model from the first sample of a record on, at some parameters.

    :param simulation: the steps of the model on the clock of the record, until its cell is empty or its load is over
    :param cut_off_V: voltage at which the discharge ends, V
    :param at_samples_V: at the samples of the record, also below the cut-off, shape (T,); NaN after the model cell is empty
    """

    simulation: Trajectory
    cut_off_V: float
    at_samples_V: FloatArray

    def reached_s(self, voltage_V: float) -> float:
        """When the voltage falls to a level, V, on the clock of the record, s; NaN if it is not reached."""
        return self.simulation.reached_s(voltage_V)

    @property
    def eod_time_s(self) -> float:
        """
        When the cut-off is reached, on the clock of the record, s; NaN if it is not reached, or only after more than a week.
        """
        return self.reached_s(self.cut_off_V)

    @property
    def time_s(self) -> FloatArray:
        """Times of the model's steps down to the cut-off, on the clock of the record, s, shape (K,)."""
        return self._down_to_the_cut_off[0]

    @property
    def voltage_V(self) -> FloatArray:
        """
        Voltage at ``time_s``, V, shape (K,). The last voltage is the cut-off, between two steps; it is above the cut-off if
        the cut-off is never reached, because the load is off at the end of the record.
        """
        return self._down_to_the_cut_off[1]

    @cached_property
    def _down_to_the_cut_off(self) -> tuple[FloatArray, FloatArray]:
        time_s, voltage_V, end_s = self.simulation.time_s, self.simulation.voltage_V, self.eod_time_s
        if np.isnan(end_s):
            return time_s, voltage_V
        is_above = time_s < end_s
        return np.append(time_s[is_above], end_s), np.append(voltage_V[is_above], self.cut_off_V)


class ModelError(NamedTuple):
    """
    What the model misses over a discharge, to its cut-off.

    :param drawn_share: charge drawn, as a share of ``q_mobile``, shape (T,)
    :param error_V: the measured voltage less that of the model, V, shape (T,)
    """

    drawn_share: FloatArray
    error_V: FloatArray

    def at(self, drawn_C: FloatArray, q_mobile: float) -> FloatArray:
        """Return the error of a discharge alike, V, where it has drawn these charges, C."""
        return np.interp(drawn_C / q_mobile, *self)

    def removed_from(self, record: Record, q_mobile: float) -> Record:
        """Return a record of a discharge alike without this error."""
        time_s, voltage_V, current_A = Samples.of(record)
        return Samples(time_s, voltage_V - self.at(integrate_load(time_s, current_A, time_s), q_mobile), current_A)


class Tangents(NamedTuple):
    """
    The voltage of the model and its derivatives, at the points of its grid; NaN after the model cell is empty.

    :param voltage_V: shape (K,)
    :param by_parameter: in the order of :data:`~battery_env.electrochemistry.tangents.TANGENT_NAMES`: with respect to
        ``q_mobile``, V/C, ``r_o``, A, and the logarithms of constants, V, shape (8, K)
    :param fraction_p: mole fraction at the surface of the positive electrode, on which the equilibrium voltage depends,
        shape (K,)
    """

    voltage_V: FloatArray
    by_parameter: FloatArray
    fraction_p: FloatArray


class RecordModel:
    """
    The model under the current of a record: the basis of calibration by the voltage of whole records, and of predictions from
    the estimate of any calibrator.

    .. code-block:: python

      estimate = LeastSquares(thermal=True, mismatch_V=0.05).estimate(record)
      forecast = RecordModel(thermal=True).forecast(record, estimate, cut_off_V=2.7)
      print(forecast.eod_time_s)

    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: time step of the model, s
    :param initial: state of the model at the first sample, shape (8,). It stands for a history of the current: its charges
        change in proportion to ``q_mobile``. ``None``: at rest, with ``initial_soc``
    :param initial_soc: state of charge at the first sample, within 0 .. 1; 1: fully charged
    :raises ValueError: for an argument out of range, or both ``initial`` and an ``initial_soc``
    """

    def __init__(
        self,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        initial: ArrayLike | None = None,
        initial_soc: float = 1.0,
    ) -> None:
        self.cell = check_cell(cell, thermal)
        self.thermal = thermal
        self.dt_s = check_dt(dt_s, self.cell)
        reference_q_C = Q_MOBILE.limits[1]
        self._shares = rest_shares(initial_soc)
        if initial is None:
            self.initial = initial_state(reference_q_C, self.cell, initial_soc)
        elif initial_soc == 1.0:
            self.initial = np.array(initial, dtype=np.float64)
        else:
            raise ValueError(f"initial is a whole state: give it or initial_soc, got both, initial_soc = {initial_soc!r}")
        self.initial_soc = float(initial_soc)
        if self.initial.shape != (STATE_SIZE,) or not np.isfinite(self.initial).all():
            raise ValueError(f"initial must hold {STATE_SIZE} finite numbers, got {initial!r}")
        self._derivatives = PolynomialDerivatives.of(self.cell.packed)

    def of_cell(self, cell: CellParameters) -> RecordModel:
        """Return the model with the same start and temperature, and other constants."""
        model = copy(self)
        model.cell, model._derivatives = check_cell(cell, self.thermal), PolynomialDerivatives.of(cell.packed)
        check_dt(self.dt_s, cell)
        return model

    def at(self, estimate: Estimate) -> RecordModel:
        """Return the model with the fitted constants of an estimate, if it has any."""
        return self if estimate.constants is None else self.of_cell(cell_with(self.cell, estimate.constants))

    def grid(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """
        Return a record on the time grid of the model, which starts at the first sample.

        :param record: one discharge
        :return: times of the samples since the first one, s, shape (T,); current over each step, A, shape (K,), such that
            the K points of the grid reach the last sample
        :raises ValueError: as :func:`battery_env.records.check_record`
        """
        time_s, _, current_A = check_record(record, least_samples=2)
        n_steps = int(np.ceil((time_s[-1] - time_s[0]) / self.dt_s - 1e-6)) + 1
        return time_s - time_s[0], resample_current(time_s, current_A, self.dt_s, n_steps)

    def start(self, q_mobile: float | FloatArray) -> FloatArray:
        """
        Return the state at the first sample, shape (..., 8), of cells with ``q_mobile``, C, shape (...): ``initial``, with its
        charges in proportion, or at rest with ``initial_soc``.
        """
        missing_C = np.asarray(q_mobile - _Q_PER_CHARGE * self.initial[QNB:].sum())
        start = np.broadcast_to(self.initial, (*missing_C.shape, STATE_SIZE)).copy()
        start[..., QNB:] += missing_C[..., None] * self._shares
        return start

    def simulate(self, current_A: FloatArray, q_mobile: float, r_o: float) -> Trajectory:
        """
        Simulate the model under a current, without a cut-off.

        :param current_A: current over each step, A, shape (K,)
        :param q_mobile: charge that can move, C
        :param r_o: ohmic resistance, ohm
        :return: the samples down to where the model cell is empty, or all K of them
        """
        return simulate(
            current_A,
            q_mobile,
            r_o,
            dt=self.dt_s,
            load_unit="current",
            thermal=self.thermal,
            cell=self.cell,
            initial=self.start(q_mobile),
            cut_off_V=-np.inf,
            until=len(current_A) * self.dt_s,
        )

    def voltage(self, record: Record, at: Estimate) -> FloatArray:
        """
        Return the voltage of the model at the samples of a record, under its current.

        :param record: one discharge
        :param at: the parameters, with their fitted constants
        :return: voltage in V, shape (T,); NaN after the model cell is empty
        :raises ValueError: for parameters out of range, or a record that cannot be used
        """
        time_s, current_A = self.grid(record)
        return _at_times(time_s, self.at(at).simulate(current_A, at.q_mobile, at.r_o))

    def forecast(
        self,
        record: Record,
        at: Estimate,
        cut_off_V: float | None = None,
        future_current_A: float | None = None,
    ) -> VoltageForecast:
        """
        Return the voltage of the model from the first sample of a record down to the cut-off, under the current of the record,
        and beyond its end under a constant current. For the end of a cell in progress use :func:`battery_env.forecast`, which
        corrects the error of the model.

        :param record: one discharge, whole or in progress
        :param at: the parameters
        :param cut_off_V: cut-off voltage, V; ``None``: the ``VEOD`` of ``cell``
        :param future_current_A: current beyond the end of the record, at least 0 A; ``None``: as
            :func:`~battery_env.records.expected_current` has it, the last current of a constant load and the mean of a load
            that varied, which is an assumption
        :raises ValueError: for a negative future current, parameters out of range, or a record that cannot be used
        """
        Q_MOBILE.check(at.q_mobile)
        samples_s, current_A = self.grid(record)
        if future_current_A is None:
            future_current_A = expected_current(record.time_s, record.current_A).mean_A
        else:
            check_not_negative(future_current_A=future_current_A)
        if future_current_A * LONGEST_S > at.q_mobile:
            # no cell of this q_mobile lasts longer, even from full
            steps = int(at.q_mobile / (future_current_A * self.dt_s)) + 1
            current_A = np.append(current_A[:-1], np.full(steps + 1, future_current_A))
        simulation, start_s = self.at(at).simulate(current_A, at.q_mobile, at.r_o), float(record.time_s[0])
        return VoltageForecast(
            replace(simulation, time_s=start_s + simulation.time_s, eod_time_s=start_s + simulation.eod_time_s),
            self.cell.VEOD if cut_off_V is None else cut_off_V,
            _at_times(samples_s, simulation),
        )

    def capacity_Ah(
        self, loads: Sequence[FutureLoad], cut_off_V: float, q_mobile: ArrayLike | None = None, r_o: ArrayLike | None = None
    ) -> FloatArray:
        """
        Return the charge that cells deliver from full down to the cut-off, plus any charge that the load returns first.

        :param loads: of :mod:`battery_env.loads`, in one unit, one for all or one a cell
        :param cut_off_V: cut-off voltage, V
        :param q_mobile: charge that can move, C, shape (n,); ``None``: that of ``cell``
        :param r_o: ohmic resistance, ohm, shape (n,); ``None``: that of ``cell``
        :return: Ah, shape (n,); NaN if the cut-off is not reached within a week
        """
        q_C = Q_MOBILE.check(self.cell.q_mobile if q_mobile is None else q_mobile)
        r_ohm = R_O.check(self.cell.r_o if r_o is None else r_o)
        q_C, r_ohm, _ = (np.array(column) for column in np.broadcast_arrays(q_C, r_ohm, np.empty(len(loads))))
        no_error_V = np.zeros(len(q_C))
        full_cells = Cells(q_C, r_ohm, initial_state(q_C, self.cell), no_error_V, no_error_V)
        return simulate_to_cut_off(full_cells, self, loads, cut_off_V, surplus_share=np.inf).capacity_Ah

    def sensitivities(
        self, current_A: FloatArray, q_mobile: float, r_o: float, stride: int = 1
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return the voltage under a current and its derivatives with respect to both parameters; unchecked.

        :param current_A: current over each step, A, shape (K,)
        :param q_mobile: charge that can move, C
        :param r_o: ohmic resistance, ohm
        :param stride: number of ``dt_s`` in a step: 1, or more for a coarse simulation
        :return: voltage, V, dV/dq_mobile, V/C, and dV/dr_o, A, each of shape (K,); NaN after the model cell is empty
        """
        columns = np.full((3, len(current_A)), np.nan)
        self._roll_out(current_A, q_mobile, r_o, stride, columns)
        return columns[0], columns[1], columns[2]

    def tangents(self, current_A: FloatArray, q_mobile: float, r_o: float) -> Tangents:
        """
        Return :meth:`sensitivities` with the derivatives by the logarithms of ``RATE_CONSTANTS``; unchecked.
        """
        columns = np.full((len(TANGENT_NAMES) + 2, len(current_A)), np.nan)
        self._roll_out(current_A, q_mobile, r_o, 1, columns)
        return Tangents(columns[0], columns[1:-1], columns[-1])

    def _roll_out(self, current_A: FloatArray, q_mobile: float, r_o: float, stride: int, columns: FloatArray) -> None:
        roll_out_with_tangents(
            current_A,
            q_mobile,
            r_o,
            stride * self.dt_s,
            self.thermal,
            self.cell.packed,
            self._derivatives,
            self.start(q_mobile),
            self._shares,
            columns,
        )

    def least_q_mobile_C(self, current_A: FloatArray) -> float:
        """
        Return the ``q_mobile`` below which the model cell is empty before a current over each step, A, ends, C. At a fixed
        current the charges are linear in ``q_mobile``, so that one roll-out gives it exactly.
        """
        return self.least_q_mobile_tangent_C(current_A)[0]

    def least_q_mobile_tangent_C(self, current_A: FloatArray) -> tuple[float, float]:
        """Return :meth:`least_q_mobile_C`, and its derivative by the logarithm of ``tDiffusion``, the only other cause, C."""
        q_C = Q_MOBILE.limits[1]
        constants = self.cell.packed.constants
        least_C, by_t_C = least_q_mobile(current_A, q_C, self.dt_s, constants, self.start(q_C), self._shares)
        return float(least_C), float(by_t_C)


def _at_times(time_s: FloatArray, simulation: Trajectory) -> FloatArray:
    return np.interp(time_s, simulation.time_s, simulation.voltage_V, right=np.nan)
