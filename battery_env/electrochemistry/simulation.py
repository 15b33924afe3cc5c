"""The public functions of the model: voltage, one step, and whole discharges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import LoadUnit, check_load, check_numbers
from battery_env.electrochemistry.cell import (
    QNB,
    QNS,
    STATE_NAMES,
    STATE_SIZE,
    TB,
    CellParameters,
    PackedConstants,
    check_cell,
    check_dt,
    rest_shares,
)
from battery_env.electrochemistry.kernels import advance_batch, roll_out, step_batch, voltage_batch
from battery_env.parameters import Q_MOBILE, R_O

_MAX_STEPS = 1e8  # of one simulation, in memory


def _checked_parameters(
    cell: CellParameters | None, q_mobile: ArrayLike | None, r_o: ArrayLike | None = None, thermal: bool = False
) -> tuple[CellParameters, FloatArray, FloatArray]:
    """Check a cell and its parameters; a parameter that is ``None`` is the cell's."""
    constants = check_cell(cell, thermal)
    q = constants.q_mobile if q_mobile is None else q_mobile
    return constants, Q_MOBILE.check(q), R_O.check(constants.r_o if r_o is None else r_o)


def initial_state(q_mobile: ArrayLike | None = None, cell: CellParameters | None = None, soc: float = 1.0) -> FloatArray:
    """
    The state of a cell at rest. If it is fully charged, V = 4.191350 V for every ``q_mobile``.

    :param q_mobile: charge that can move, C, shape (...); ``None``: the cell's
    :param cell: constants of the cell; ``None``: the new cell's
    :param soc: state of charge: the share of ``q_mobile`` in the negative electrode
    :return: state, shape (..., 8)
    :raises ValueError: if ``q_mobile`` or ``soc`` is out of range
    """
    constants, q, _ = _checked_parameters(cell, q_mobile)
    state = np.zeros((*q.shape, STATE_SIZE))
    state[..., TB] = constants.Tb0
    state[..., QNB:] = q[..., None] * rest_shares(soc)
    return state


def _check_state(state: ArrayLike) -> FloatArray:
    array = check_numbers("state", state)
    if array.ndim == 0 or array.shape[-1] != STATE_SIZE:
        raise ValueError(f"state must have shape (..., {STATE_SIZE}) in the order {STATE_NAMES}, got shape {array.shape}")
    return array


def _flat(array: FloatArray, shape: tuple[int, ...], *tail: int) -> FloatArray:
    return np.array(np.broadcast_to(array, shape + tail), order="C").reshape(-1, *tail)


def voltage(state: ArrayLike, q_mobile: ArrayLike | None = None, cell: CellParameters | None = None) -> FloatArray:
    """
    The terminal voltage, V = V_e,p(x_p) - V_e,n(x_n) - Vo - Vsn - Vsp.

    :param state: shape (..., 8)
    :param q_mobile: charge that can move, C, shape (...); ``None``: the cell's
    :param cell: constants of the cell; ``None``: the new cell's
    :return: voltage in V, shape (...); NaN where an electrode is empty or overfull
    :raises ValueError: for a wrong shape, or ``q_mobile`` out of range
    """
    constants, q, _ = _checked_parameters(cell, q_mobile)
    x = _check_state(state)
    shape = np.broadcast_shapes(x.shape[:-1], q.shape)
    out = np.empty(int(np.prod(shape)))
    voltage_batch(_flat(x, shape, STATE_SIZE), _flat(q, shape), False, constants.packed, out)
    return out.reshape(shape)[()]


def step(
    state: ArrayLike,
    load: ArrayLike,
    q_mobile: ArrayLike | None = None,
    r_o: ArrayLike | None = None,
    dt: float = 1.0,
    load_unit: LoadUnit = "power",
    thermal: bool = False,
    cell: CellParameters | None = None,
) -> FloatArray:
    """
    One step of explicit Euler. All array arguments broadcast over the leading axes of ``state``.

    With power as the load the current is i = P / V(state); where the state has no positive voltage the result is NaN.

    :param state: shape (..., 8)
    :param load: power in W or current in A over the step (positive discharges), shape (...)
    :param q_mobile: charge that can move, C, shape (...); ``None``: the cell's
    :param r_o: ohmic resistance, ohm, shape (...); ``None``: the cell's
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature follows progpy's heat balance; otherwise it stays as it is
    :param cell: constants of the cell; ``None``: the new cell's
    :return: the next state, shape (..., 8)
    :raises ValueError: for a wrong shape, or a value out of range
    """
    constants, q, r = _checked_parameters(cell, q_mobile, r_o, thermal)
    x, u = _check_state(state), check_load(load, load_unit)
    shape = np.broadcast_shapes(x.shape[:-1], u.shape, q.shape, r.shape)
    out = np.empty((int(np.prod(shape)), STATE_SIZE))
    x, u, q, r = _flat(x, shape, STATE_SIZE), _flat(u, shape), _flat(q, shape), _flat(r, shape)
    step_batch(x, u, q, r, check_dt(dt, constants), load_unit == "power", thermal, False, constants.packed, out)
    return out.reshape((*shape, STATE_SIZE))


def advance_in_place(
    state: FloatArray,
    load: FloatArray,
    first: IntArray,
    steps: IntArray,
    q_mobile: FloatArray,
    r_o: FloatArray,
    dt: float,
    load_unit: LoadUnit,
    thermal: bool,
    packed: PackedConstants,
) -> None:
    """Advance every cell by its own number of steps under its own stretch of ``load``, unchecked."""
    order = np.argsort(-steps)
    ordered = packed if len(packed.constants) == 1 else packed._replace(constants=packed.constants[order])
    ordered_state, power = state[order], load_unit == "power"
    advance_batch(ordered_state, load, first[order], steps[order], q_mobile[order], r_o[order], dt, power, thermal, ordered)
    state[order] = ordered_state


def state_of_charge(state: FloatArray, q_mobile: FloatArray) -> FloatArray:
    """The share of ``q_mobile`` that is left in the negative electrode, 1 at full charge (progpy's ``SOC``)."""
    return np.asarray((state[..., QNB] + state[..., QNS]) / q_mobile)


@dataclass(frozen=True)
class Trajectory:
    """
    A simulated discharge, or a part of one: consecutive samples, none below the cut-off voltage.

    :param time_s: shape (T,)
    :param state: shape (T, 8)
    :param voltage_V: shape (T,)
    :param current_A: current over the step that starts at each sample, shape (T,)
    :param load: load over the step that starts at each sample, W or A, shape (T,)
    :param load_unit: ``"power"`` or ``"current"``
    :param cell: constants of the cell, with its own ``q_mobile`` and ``r_o``
    :param dt_s: time step, s
    :param thermal: whether the temperature moved
    :param eod_time_s: time of the first sample below the cut-off (or without a voltage), the end of discharge, on the
        clock of ``time_s``; NaN if the simulation stopped before
    """

    time_s: FloatArray
    state: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    load: FloatArray
    load_unit: LoadUnit
    cell: CellParameters
    dt_s: float
    thermal: bool
    eod_time_s: float

    @property
    def q_mobile(self) -> float:
        """Charge that can move, C."""
        return self.cell.q_mobile

    @property
    def r_o(self) -> float:
        """Ohmic resistance, ohm."""
        return self.cell.r_o

    def reached_s(self, voltage_V: float) -> float:
        """
        When the voltage first falls to a level, between two samples; an empty cell is below every level.

        :param voltage_V: the level, V
        :return: on the clock of ``time_s``, s; NaN if the level is not reached
        """
        below = np.flatnonzero(~(self.voltage_V > voltage_V))
        if not len(below):
            return self.eod_time_s
        n = below[0]
        if n == 0 or np.isnan(self.voltage_V[n]):
            return float(self.time_s[n])
        return float(np.interp(voltage_V, self.voltage_V[[n, n - 1]], self.time_s[[n, n - 1]]))

    def part(self, first: int, stop: int) -> Trajectory:
        """The samples ``first`` .. ``stop - 1``; time keeps its origin."""
        window = slice(first, stop)
        return replace(
            self,
            time_s=self.time_s[window],
            state=self.state[window],
            voltage_V=self.voltage_V[window],
            current_A=self.current_A[window],
            load=self.load[window],
        )


def _loads(
    load: float | ArrayLike | Callable[[FloatArray], ArrayLike], unit: LoadUnit, dt: float, max_samples: int
) -> FloatArray:
    """Return the load over the step that starts at each sample, as a new array."""
    load_unit = getattr(load, "unit", unit)
    if load_unit != unit:
        raise ValueError(f"the load is a {load_unit}, but load_unit is {unit!r}: give load_unit={load_unit!r}")
    n_samples = max_samples
    if callable(load):
        values = check_numbers("load", load(dt * np.arange(n_samples, dtype=np.float64)))
    else:
        values = check_numbers("load", load)
        n_samples = min(n_samples, len(values)) if values.ndim == 1 else n_samples
    values = check_load(values if values.ndim == 0 else values[..., :n_samples], unit)
    if values.shape not in ((), (n_samples,)) or n_samples == 0:
        raise ValueError(f"load must be a number or one value a step, shape (steps,), got shape {values.shape}")
    return np.full(n_samples, values) if values.ndim == 0 else np.array(values, order="C")


def simulate(
    load: float | ArrayLike | Callable[[FloatArray], ArrayLike],
    q_mobile: float | None = None,
    r_o: float | None = None,
    until: float = 86_400.0,
    dt: float = 1.0,
    load_unit: LoadUnit = "power",
    thermal: bool = False,
    cell: CellParameters | None = None,
    initial: ArrayLike | None = None,
    cut_off_V: float | None = None,
) -> Trajectory:
    """
    Discharge one cell of a given age under a load, from full charge (or from ``initial``).

    .. code-block:: python

      from battery_env import simulate

      aged = simulate(8.0, q_mobile=6000.0, r_o=0.15)  # 8 W
      print(aged.eod_time_s, aged.voltage_V.min())

    ``cell`` has the constants, and ``q_mobile`` and ``r_o`` the age. For many cells take
    :class:`~battery_env.trajectories.TrajectoryDataset`.

    :param load: a number; an array, one value a step; or a function of time in s (a :class:`battery_env.loads.Load`)
        that takes an array, and whose value at the start of each step holds for the step. Power in W or current in A
    :param q_mobile: charge that can move, C; ``None``: the cell's
    :param r_o: ohmic resistance, ohm; ``None``: the cell's
    :param until: where to stop if the discharge does not end before, s after the start
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature moves
    :param cell: constants of the cell; ``None``: the new cell's
    :param initial: state at the start, shape (8,); ``None``: full charge at rest
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the constants' ``VEOD``
    :return: the samples down to the cut-off, and the time of the end of discharge
    :raises ValueError: for a value out of range
    """
    constants, q, r = _checked_parameters(cell, q_mobile, r_o, thermal)
    dt = check_dt(dt, constants)
    if q.ndim or r.ndim:
        raise ValueError(f"q_mobile and r_o must be single numbers, got shapes {q.shape} and {r.shape}")
    if not isinstance(until, Real) or not 0.0 < until / dt <= _MAX_STEPS:
        raise ValueError(f"until must be a time in s, greater than 0 and at most {_MAX_STEPS:g} steps of dt, got {until!r}")
    loads = _loads(load, load_unit, dt, int(np.floor(until / dt + 1e-9)) + 1)
    n_samples = len(loads)
    initial_row = initial_state(q, constants) if initial is None else _check_state(initial)
    if initial_row.shape != (STATE_SIZE,):
        raise ValueError(f"initial must have shape ({STATE_SIZE},), got {initial_row.shape}")
    cut_off = constants.VEOD if cut_off_V is None else cut_off_V
    if not isinstance(cut_off, Real) or np.isnan(cut_off):
        raise ValueError(f"cut_off_V must be a number or None, got {cut_off_V!r}")
    state, columns, power = np.empty((n_samples + 1, STATE_SIZE)), np.empty((2, n_samples)), load_unit == "power"
    state[0] = initial_row
    n = roll_out(loads, float(q), float(r), dt, cut_off, power, thermal, constants.packed, state, columns)
    return Trajectory(
        time_s=dt * np.arange(n, dtype=np.float64),
        state=state[:n].copy(),
        voltage_V=columns[0, :n].copy(),
        current_A=columns[1, :n].copy(),
        load=loads[:n].copy(),
        load_unit=load_unit,
        cell=constants.replace(q_mobile=float(q), r_o=float(r)),
        dt_s=dt,
        thermal=bool(thermal),
        eod_time_s=n * dt if n < n_samples else float("nan"),
    )
