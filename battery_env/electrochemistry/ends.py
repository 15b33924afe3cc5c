"""The end of a discharge: when one cell, or a thousand cells, reach the cut-off under a future load."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sqrt
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import LoadUnit
from battery_env.compiled import compiled
from battery_env.electrochemistry.cell import CellParameters, PackedConstants
from battery_env.electrochemistry.kernels import (
    BLOCK,
    BLOCK_SIZE,
    LOAD,
    VOLTAGE,
    fill_block,
    states_of_block,
    step_of_block,
    voltage_batch,
)
from battery_env.electrochemistry.model_error import CORRELATION_SHARE
from battery_env.electrochemistry.simulation import state_of_charge

#: Probabilities of the quantiles that a forecast states: nine of ten outcomes lie between the outer two.
BAND = (0.05, 0.5, 0.95)
#: The simulation of a discharge stops after this time, s: at a current that takes more than a week the cell rests.
LONGEST_S = 604_800.0
#: A full cell takes up at most this share of its charge.
SURPLUS_SHARE = 0.01
# After this number of steps the simulation drops the cells that are at the cut-off.
_CHUNK_STEPS = 512
# Rows of the progress of cells: parameters and errors, sum of currents, last current and voltage, and the end of discharge.
_Q, _R_O, _ERROR, _DRIFT, _FIRST_SOC, _LAST_STEP, _SUM_A, _LAST_A, _LAST_V, _END, _END_SOC = range(11)


class Model(Protocol):
    """How cells are simulated: their constants, whether their temperature moves, and the time step in s."""

    @property
    def cell(self) -> CellParameters: ...

    @property
    def thermal(self) -> bool: ...

    @property
    def dt_s(self) -> float: ...


class Cells(NamedTuple):
    """
    n cells of one kind at a moment of their discharge: samples of what one cell may be, or a single cell.

    :param q_mobile: charge that can move, C, shape (n,)
    :param r_o: ohmic resistance, ohm, shape (n,)
    :param state: shape (n, 8)
    :param error_V: voltage of the cell minus voltage of its model, V, shape (n,)
    :param drift_V: further model error once the correlation is lost, V, shape (n,)
    """

    q_mobile: FloatArray
    r_o: FloatArray
    state: FloatArray
    error_V: FloatArray
    drift_V: FloatArray

    @property
    def soc(self) -> FloatArray:
        """State of charge, shape (n,)."""
        return state_of_charge(self.state, self.q_mobile)

    def select(self, rows: IntArray) -> Cells:
        """Return the cells of these rows, in this order."""
        return Cells(*(column[rows] for column in self))


class FutureLoad(Protocol):
    """A load in W or A: its mean over steps, and the time, s, after which it draws nothing."""

    @property
    def unit(self) -> LoadUnit: ...

    @property
    def until_s(self) -> float: ...

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray: ...


class EndsOfDischarge(NamedTuple):
    """The ends of discharge of n cells, and the course of their voltage until then."""

    time_s: FloatArray  # after the start of the load, s, shape (n,); infinite where no end is reached within a week
    capacity_Ah: FloatArray  # charge from full to the end, Ah, shape (n,); NaN where no end is reached
    course_s: FloatArray  # times of the course, s, shape (K,)
    course_V: FloatArray  # quantiles BAND of the voltage, shape (3, K); after its end a discharge is at the cut-off


def quantile(values: FloatArray, probability: ArrayLike = BAND) -> FloatArray:
    """Return quantiles along the first axis, over equally likely cells: shape of ``probability``, then the other axes."""
    # no interpolation between two cells, because one of the two values may be infinite
    return np.asarray(np.quantile(values, np.asarray(probability, dtype=np.float64), axis=0, method="inverted_cdf"))


def simulate_to_cut_off(
    cells: Cells,
    model: Model,
    loads: Sequence[FutureLoad],
    cut_off_V: float,
    every_s: float | None = None,  # between samples of the course; None: no course
    surplus_share: float = SURPLUS_SHARE,  # a load that charges a cell further beyond full is refused
) -> EndsOfDischarge:
    """Discharge cells to the cut-off, for a week at most, under loads in one unit, one for all cells or one a cell."""
    count, dt_s, power = len(cells.q_mobile), model.dt_s, loads[0].unit == "power"
    end_step = np.broadcast_to(np.ceil(np.minimum([load.until_s for load in loads], LONGEST_S) / dt_s - 1e-9), count)
    progress = _initial_progress(cells, end_step)
    stride = 0 if every_s is None else max(round(every_s / dt_s), 1)
    course: list[tuple[IntArray, FloatArray]] = []
    first_step, active, state = 0, np.arange(count), cells.state.copy()
    while len(active):
        times_s = dt_s * np.arange(first_step, first_step + _CHUNK_STEPS, dtype=np.float64)
        load = np.array([loads[n].mean(times_s, dt_s) for n in (active.tolist() if len(loads) > 1 else [0])], dtype=np.float64)
        rows = np.arange(-first_step % stride, _CHUNK_STEPS, stride) if stride else np.arange(0)
        voltage_V, active_voltage_V = (np.full((n, len(rows)), cut_off_V) for n in (count, len(active)))
        active_progress, active_state = progress.take(active, axis=1), state[active]
        run = _Run(dt_s, power, model.thermal, float(cut_off_V), surplus_share, first_step, stride)
        overcharge_step = _advance(load, active_progress, run, model.cell.packed, active_state, active_voltage_V)
        if overcharge_step >= 0:
            raise ValueError(
                f"load charges the cell beyond full, by more than {SURPLUS_SHARE:.0%} of its charge, after "
                f"{dt_s * overcharge_step:g} s. Positive loads discharge: check its sign, or begin with the discharge."
            )
        progress[:, active], state[active], voltage_V[active] = active_progress, active_state, active_voltage_V
        course.append((first_step + rows, quantile(voltage_V)))
        first_step += _CHUNK_STEPS
        active = active[np.isinf(progress[_END, active])]
        if (progress[_LAST_STEP, active] < first_step).all():
            break
    last_step = np.where(np.isinf(progress[_END]), end_step, progress[_END]).max()
    steps, course_V = (np.concatenate(chunks, axis=-1) for chunks in zip(*course, strict=True))
    is_before_end = steps <= last_step
    time_s, course_s, course_V = dt_s * progress[_END], dt_s * steps[is_before_end], course_V[:, is_before_end]
    if stride and not len(active):
        course_s, course_V = np.append(course_s, time_s.max()), np.append(course_V, np.full((3, 1), cut_off_V), axis=1)
    return EndsOfDischarge(time_s, (1.0 - progress[_END_SOC]) * cells.q_mobile / 3600.0, course_s, course_V)


def simulate_current(cells: Cells, model: Model, current_A: FloatArray, n_voltages: int) -> tuple[Cells, FloatArray]:
    """
    Take cells through a measured current over each step, A: return the cells after it, and their voltages before each of the
    last ``n_voltages`` steps and at the end, V, shape (n, n_voltages + 1), NaN once a cell is empty.
    """
    count, state, first_voltage = len(cells.q_mobile), cells.state.copy(), len(current_A) - n_voltages
    progress, voltage_V = _initial_progress(cells, np.full(count, np.inf)), np.full((count, n_voltages + 1), np.nan)
    # no cut-off and no limit of the charge: the current was measured
    packed, sample_voltage_V = model.cell.packed, np.full((count, n_voltages), np.nan)
    run = _Run(model.dt_s, False, model.thermal, -np.inf, np.inf, 0, 0)
    _advance(current_A[None, :first_voltage], progress, run, packed, state, sample_voltage_V)
    _advance(current_A[None, first_voltage:], progress, run._replace(stride=1), packed, state, sample_voltage_V)
    end_voltage_V = np.empty(count)
    voltage_batch(state, cells.q_mobile, False, packed, end_voltage_V)
    voltage_V[:, :-1], voltage_V[:, -1] = sample_voltage_V, end_voltage_V + cells.error_V
    return cells._replace(state=state), voltage_V


class _Run(NamedTuple):
    """The settings of a simulation over some steps."""

    dt_s: float
    is_power: bool  # whether the load is a power; otherwise it is a current
    thermal: bool
    cut_off_V: float
    surplus_share: float  # largest charge beyond full
    first_step: int
    stride: int  # steps between two voltages of the course; 0: no course


def _initial_progress(cells: Cells, end_step: FloatArray) -> FloatArray:
    """Return the progress of cells before the first step."""
    initial = (cells.q_mobile, cells.r_o, cells.error_V, cells.drift_V, cells.soc, end_step)
    return np.vstack([*initial, *(np.full_like(end_step, value) for value in (0.0, np.nan, np.nan, np.inf, np.nan))])


@compiled
def _advance(
    load: FloatArray,
    progress: FloatArray,
    run: _Run,
    packed: PackedConstants,
    state: FloatArray,
    voltage_V: FloatArray,
) -> int:
    # Take cells through the steps of ``load``, shape (cells or 1, steps): fill their ends, in steps, and the voltages of the
    # course. Return the first step at which a cell is charged beyond full, or -1. After its _LAST_STEP no cell ends
    dt_s, first_step, stride = run.dt_s, run.first_step, run.stride
    is_common_load, block, overcharge_step = load.shape[0] == 1, np.empty(BLOCK_SIZE), -1
    for start in range(0, state.shape[0], BLOCK):
        cells = n_active = min(BLOCK, state.shape[0] - start)
        fill_block(block, start, cells, state, progress[_Q], progress[_Q], progress[_R_O], packed.constants)
        for k in range(load.shape[1]):
            if n_active == 0:
                break
            for j in range(cells):
                block[LOAD * BLOCK + j] = load[0 if is_common_load else start + j, k]
            step_of_block(block, cells, dt_s, run.is_power, True, run.thermal, False, packed.polynomial_n, packed.polynomial_p)
            for j in range(cells):
                n = start + j
                if progress[_END, n] < np.inf:
                    continue
                depth = progress[_SUM_A, n] * dt_s / progress[_Q, n]
                volts = block[VOLTAGE + j] + progress[_ERROR, n]
                if progress[_DRIFT, n] != 0.0:
                    # the error at the last voltages stays, as an error of r_o would; only the further error drifts
                    correlation = exp(-max(depth, 0.0) / CORRELATION_SHARE)
                    volts += progress[_DRIFT, n] * sqrt(1.0 - correlation * correlation)
                step = first_step + k
                if step <= progress[_LAST_STEP, n]:
                    first_soc, last_V = progress[_FIRST_SOC, n], progress[_LAST_V, n]
                    if first_soc - depth > max(first_soc, 1.0) + run.surplus_share:
                        overcharge_step = step if overcharge_step < 0 else min(overcharge_step, step)
                    if not volts > run.cut_off_V:
                        # NaN at an empty cell, and before the first voltage, takes the 0
                        step_share = (run.cut_off_V - volts) / (last_V - volts) if volts < last_V else 0.0
                        progress[_END, n] = step - step_share
                        progress[_END_SOC, n] = first_soc - depth
                        if step_share > 0.0:
                            progress[_END_SOC, n] += step_share * progress[_LAST_A, n] * dt_s / progress[_Q, n]
                        n_active -= 1
                        continue
                if stride > 0 and step % stride == 0:
                    voltage_V[n, step // stride - (first_step + stride - 1) // stride] = volts
                progress[_LAST_V, n] = volts
                progress[_LAST_A, n] = block[LOAD * BLOCK + j]
                progress[_SUM_A, n] += block[LOAD * BLOCK + j]
        states_of_block(block, start, cells, state)
    return overcharge_step
