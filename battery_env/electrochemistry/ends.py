"""The end of a discharge: when cells reach the cut-off under what is to come, one of them, a few, or a thousand."""

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
from battery_env.electrochemistry.model_error import memory_share
from battery_env.electrochemistry.simulation import state_of_charge

#: The ends and the middle of the intervals that are shown: nine of ten outcomes lie between the outer two.
BAND = (0.05, 0.5, 0.95)
#: No discharge is followed longer than this, s: a current that takes more than a week to empty a cell is that of a cell at
#: rest.
LONGEST_S = 604_800.0
#: A full cell takes no more charge than this share of its own.
SURPLUS_SHARE = 0.01
# Cells that have ended are left out every so many steps.
_CHUNK_STEPS = 512
# Rows of what is followed of cells: what they are, and the sum of their currents, the last current and voltage, and their end.
_Q, _R_O, _ERROR, _DRIFT, _FIRST_SOC, _UNTIL, _SUM_A, _LAST_A, _LAST_V, _END, _END_SOC = range(11)
_AT_FIRST = (0.0, np.nan, np.nan, np.inf, np.nan)


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
    n cells of one kind at a moment of their discharge: all that one cell may be, or one alone.

    :param q_mobile: charge that can move, C, shape (n,)
    :param r_o: ohmic resistance, ohm, shape (n,)
    :param state: shape (n, 8)
    :param error_V: by how much a cell is higher than its model, V, shape (n,)
    :param drift_V: what comes to that in the long run, as charge is drawn, V, shape (n,)
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

    def part(self, chosen: IntArray) -> Cells:
        """Some of them, in the order that is asked for."""
        return Cells(*(column[chosen] for column in self))


class ToCome(Protocol):
    """What a cell is to deliver, as loads are: in W or A, until when it draws anything at all, and its mean over steps, s."""

    @property
    def unit(self) -> LoadUnit: ...

    @property
    def until_s(self) -> float: ...

    def mean(self, time_s: FloatArray, dt_s: float) -> FloatArray: ...


class Ends(NamedTuple):
    """Where the discharges of n cells end."""

    time_s: FloatArray  # from now on, s, shape (n,); infinite where the cut-off is not reached within a week
    capacity_Ah: FloatArray  # given from full to the end, Ah, shape (n,); NaN likewise
    course_s: FloatArray  # times of the course, s, shape (K,)
    course_V: FloatArray  # quantiles BAND of the voltage then, shape (3, K); after its end a discharge is at the cut-off


def quantile(values: FloatArray, probability: ArrayLike = BAND) -> FloatArray:
    """
    Quantiles over cells that are equally likely, along the first axis of some values: shape of ``probability``, then the
    others.
    """
    # of the cells themselves: between two of them there is no number if one is infinite
    return np.asarray(np.quantile(values, np.asarray(probability, dtype=np.float64), axis=0, method="inverted_cdf"))


def run_down(
    cells: Cells,
    model: Model,
    loads: Sequence[ToCome],
    cut_off_V: float,
    every_s: float | None = None,
    surplus_share: float = SURPLUS_SHARE,
) -> Ends:
    """
    The one way to the end of a discharge: take cells down to the cut-off, side by side, for a week at most, under loads in one
    unit, one for all or one a cell. The course of the voltage is kept every so often, s, if at all. A load that charges a cell
    further beyond full than a share of its charge is refused.
    """
    count, dt_s, power = len(cells.q_mobile), model.dt_s, loads[0].unit == "power"
    until = np.broadcast_to(np.ceil(np.minimum([each.until_s for each in loads], LONGEST_S) / dt_s - 1e-9), count)
    followed = _followed(cells, until)
    every = 0 if every_s is None else max(round(every_s / dt_s), 1)
    course: list[tuple[IntArray, FloatArray]] = []
    first, going, state = 0, np.arange(count), cells.state.copy()
    while len(going):
        starts_s = dt_s * np.arange(first, first + _CHUNK_STEPS, dtype=np.float64)
        load = np.array([loads[n].mean(starts_s, dt_s) for n in (going.tolist() if len(loads) > 1 else [0])], dtype=np.float64)
        rows = np.arange(-first % every, _CHUNK_STEPS, every) if every else np.arange(0)
        shown_V, part, ahead = np.full((count, len(rows)), cut_off_V), followed.take(going, axis=1), state[going]
        part_V = np.full((len(going), len(rows)), cut_off_V)
        run = _Run(dt_s, power, model.thermal, float(cut_off_V), surplus_share, memory_share("forecast"), first, every)
        overfull = _run_on(load, part, run, model.cell.packed, ahead, part_V)
        if overfull >= 0:
            raise ValueError(
                f"load charges the cell beyond full, by more than {SURPLUS_SHARE:.0%} of its charge, after "
                f"{dt_s * overfull:g} s. Positive loads discharge: check its sign, or begin with the discharge."
            )
        followed[:, going], state[going], shown_V[going] = part, ahead, part_V
        course.append((first + rows, quantile(shown_V)))
        first += _CHUNK_STEPS
        going = going[np.isinf(followed[_END, going])]
        if (followed[_UNTIL, going] < first).all():
            break
    last = np.where(np.isinf(followed[_END]), until, followed[_END]).max()
    steps, course_V = (np.concatenate(each, axis=-1) for each in zip(*course, strict=True))
    shown = steps <= last
    time_s, course_s, course_V = dt_s * followed[_END], dt_s * steps[shown], course_V[:, shown]
    if every and not len(going):
        course_s, course_V = np.append(course_s, time_s.max()), np.append(course_V, np.full((3, 1), cut_off_V), axis=1)
    return Ends(time_s, (1.0 - followed[_END_SOC]) * cells.q_mobile / 3600.0, course_s, course_V)


def follow(cells: Cells, model: Model, current_A: FloatArray, shown: int) -> tuple[Cells, FloatArray]:
    """
    Take cells through a current that was measured, over each step, A: to its end, with their voltages before each of so many
    last steps, and then, V, shape (n, shown + 1), NaN once a cell is empty.
    """
    count, state, split = len(cells.q_mobile), cells.state.copy(), len(current_A) - shown
    followed, voltage_V = _followed(cells, np.full(count, np.inf)), np.full((count, shown + 1), np.nan)
    # nobody asks where these end, nor how full they become
    packed, part_V = model.cell.packed, np.full((count, shown), np.nan)
    run = _Run(model.dt_s, False, model.thermal, -np.inf, np.inf, memory_share("forecast"), 0, 0)
    _run_on(current_A[None, :split], followed, run, packed, state, part_V)
    _run_on(current_A[None, split:], followed, run._replace(every=1), packed, state, part_V)
    at_end_V = np.empty(count)
    voltage_batch(state, cells.q_mobile, False, packed, at_end_V)
    voltage_V[:, :-1], voltage_V[:, -1] = part_V, at_end_V + cells.error_V
    return cells._replace(state=state), voltage_V


class _Run(NamedTuple):
    """How cells are taken on through some steps."""

    dt_s: float
    is_power: bool  # whether the load is one, or a current
    thermal: bool
    cut_off_V: float
    surplus_share: float  # how far beyond full a cell may be charged
    memory_share: float  # over which the error of the model drifts
    first: int  # the first step
    every: int  # the voltage is kept at all multiples of so many steps; 0: it is not


def _followed(cells: Cells, until: FloatArray) -> FloatArray:
    """What is followed of cells, at first."""
    known = (cells.q_mobile, cells.r_o, cells.error_V, cells.drift_V, cells.soc, until)
    return np.vstack([*known, np.repeat(np.array(_AT_FIRST)[:, None], len(until), axis=1)])


@compiled
def _run_on(
    load: FloatArray,
    followed: FloatArray,
    run: _Run,
    packed: PackedConstants,
    state: FloatArray,
    shown: FloatArray,
) -> int:
    # Take cells on through the steps of ``load``, shape (cells or 1, steps): fills their ends, in steps, and the voltages
    # that are shown. Returns the first step at which a cell is charged beyond full, or -1. After its last step no cell ends
    dt, first, every = run.dt_s, run.first, run.every
    shared, block, overfull = load.shape[0] == 1, np.empty(BLOCK_SIZE), -1
    for start in range(0, state.shape[0], BLOCK):
        cells = going = min(BLOCK, state.shape[0] - start)
        fill_block(block, start, cells, state, followed[_Q], followed[_Q], followed[_R_O], packed.constants)
        for k in range(load.shape[1]):
            if going == 0:
                break
            for j in range(cells):
                block[LOAD * BLOCK + j] = load[0 if shared else start + j, k]
            step_of_block(block, cells, dt, run.is_power, True, run.thermal, False, packed.polynomial_n, packed.polynomial_p)
            for j in range(cells):
                n = start + j
                if followed[_END, n] < np.inf:
                    continue
                drawn = followed[_SUM_A, n] * dt / followed[_Q, n]
                volts = block[VOLTAGE + j] + followed[_ERROR, n]
                if followed[_DRIFT, n] != 0.0:
                    # what the last voltages showed stays, as an error of r_o would; what the error is beside that changes
                    left = exp(-max(drawn, 0.0) / run.memory_share)
                    volts += followed[_DRIFT, n] * sqrt(1.0 - left * left)
                if first + k <= followed[_UNTIL, n]:
                    first_soc, last_V = followed[_FIRST_SOC, n], followed[_LAST_V, n]
                    if first_soc - drawn > max(first_soc, 1.0) + run.surplus_share and (overfull < 0 or first + k < overfull):
                        overfull = first + k
                    if not volts > run.cut_off_V:
                        # an empty cell has no voltage, and a first one none before
                        back = (run.cut_off_V - volts) / (last_V - volts) if volts < last_V else 0.0
                        followed[_END, n] = first + k - back
                        followed[_END_SOC, n] = first_soc - drawn
                        if back > 0.0:
                            followed[_END_SOC, n] += back * followed[_LAST_A, n] * dt / followed[_Q, n]
                        going -= 1
                        continue
                if every > 0 and (first + k) % every == 0:
                    shown[n, (first + k) // every - (first + every - 1) // every] = volts
                followed[_LAST_V, n] = volts
                followed[_LAST_A, n] = block[LOAD * BLOCK + j]
                followed[_SUM_A, n] += block[LOAD * BLOCK + j]
        states_of_block(block, start, cells, state)
    return overfull
