"""
The electrochemistry model of a Li-ion cell during discharge.

Source: M. Daigle and C. S. Kulkarni, "Electrochemistry-based Battery Modeling for Prognostics", PHM 2013, as coded in
NASA's Prognostics Model Library (``+Battery``, isothermal) and in its Python successor progpy
(``BatteryElectroChemEOD``, thermal). Names of constants are progpy's.

A state is a vector of eight numbers, in this order (``STATE_NAMES``):

====== ====== ======================================================== ====
index  name   meaning                                                  unit
====== ====== ======================================================== ====
0      Tb     temperature of the cell                                  K
1      Vo     voltage drop over the ohmic resistance                   V
2      Vsn    surface overpotential of the negative electrode          V
3      Vsp    surface overpotential of the positive electrode          V
4      qnB    charge in the bulk volume of the negative electrode      C
5      qnS    charge in the surface volume of the negative electrode   C
6      qpB    charge in the bulk volume of the positive electrode      C
7      qpS    charge in the surface volume of the positive electrode   C
====== ====== ======================================================== ====

Two parameters age: ``q_mobile``, the charge that can move (the paper's q^max, the libraries' ``qMobile``; new: 7600 C;
not to be confused with the libraries' ``qMax = qMobile / 0.6``), and ``r_o``, the ohmic resistance (new: 0.117215 ohm).

One compiled kernel (numba) serves one cell and a million: every public function broadcasts over leading axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from numbers import Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from battery_env.kernels import FloatArray, PackedConstants, advance_batch, roll_out, step_batch, voltage_batch

LoadUnit = Literal["power", "current"]

STATE_NAMES: tuple[str, ...] = ("Tb", "Vo", "Vsn", "Vsp", "qnB", "qnS", "qpB", "qpS")
STATE_SIZE = len(STATE_NAMES)
TB, VO, VSN, VSP, QNB, QNS, QPB, QPS = range(STATE_SIZE)

#: Charges at full charge and rest, as shares of ``q_mobile``, in the order of the state (qnB, qnS, qpB, qpS). At a
#: fixed history of the current the charges are linear in ``q_mobile`` with this slope, at all times.
FULL_CHARGE_SHARES: FloatArray = np.array([0.9, 0.1, 0.6, 1.0 / 15.0])

#: Largest magnitude of a load, per unit. Beyond it a value is taken for a mistake in the unit (mA for A, kW for W).
LOAD_LIMITS: dict[str, float] = {"power": 200.0, "current": 60.0}
LOAD_UNIT_SYMBOLS: dict[str, str] = {"power": "W", "current": "A"}
#: Range of ``q_mobile`` in C; its ends catch ampere-hours (2.1 Ah = 7560 C) and nonsense.
Q_MOBILE_LIMITS_C = (100.0, 1e6)
#: Range of ``r_o`` in ohm; its upper end catches milliohms.
R_O_LIMITS_OHM = (0.0, 5.0)

#: Constants that nobody can measure well, as they lie in :meth:`CellParameters.packed_with`.
UNCERTAIN_CONSTANTS: tuple[str, ...] = ("kn", "tDiffusion", "to", "tsn")

_SIX_TENTHS = 0.6  # xnMax - xnMin: the share of all lithium sites that a full discharge uses
_POLYNOMIAL_SIZE = 14
_MAX_STEPS = 1e8  # of one simulation, in memory


def _redlich_kister_polynomial(coefficients: tuple[float, ...], faraday: float) -> FloatArray:
    """
    Collapse the Redlich-Kister sum of the equilibrium potential into one polynomial in y = 2x - 1.

    Term k is A_k/F * ((1 + k/2) * y^(k+1) - (k/2) * y^(k-1)); unlike the sum it has no singularity at x = 0.5.

    :param coefficients: A_0, A_1, ... in J/mol
    :param faraday: Faraday's constant in C/mol
    :return: coefficients in V, lowest power first, shape (14,)
    """
    polynomial = np.zeros(_POLYNOMIAL_SIZE)
    for k, coefficient in enumerate(coefficients):
        polynomial[k + 1] += coefficient / faraday * (1.0 + k / 2.0)
        if k > 0:
            polynomial[k - 1] -= coefficient / faraday * (k / 2.0)
    return polynomial


@dataclass(frozen=True)
class CellParameters:
    """
    Constants of the model, in SI units, under progpy's names; the defaults are NASA's 18650 cell when new.

    Source: Daigle & Kulkarni 2013; the values agree in NASA's MATLAB library, progpy and the seed paper's code.

    :param q_mobile: charge that can move, C (progpy's ``qMobile``, the paper's q^max)
    :param r_o: ohmic resistance, ohm (progpy's ``Ro``)
    :param R: gas constant, J/mol/K
    :param F: Faraday's constant, C/mol
    :param alpha: symmetry factor of the Butler-Volmer equation
    :param Sn: surface of the negative electrode, m^2
    :param Sp: surface of the positive electrode, m^2
    :param kn: lumped rate constant of the negative electrode, A/m^2
    :param kp: lumped rate constant of the positive electrode, A/m^2
    :param Vol: volume of one electrode, m^3
    :param VolSFraction: share of that volume which counts as surface
    :param tDiffusion: time constant of diffusion between surface and bulk, s/m^3
    :param to: time constant of the ohmic voltage drop, s
    :param tsn: time constant of the negative surface overpotential, s
    :param tsp: time constant of the positive surface overpotential, s
    :param U0n: reference potential of the negative electrode, V
    :param U0p: reference potential of the positive electrode, V
    :param An: Redlich-Kister coefficients of the negative electrode, J/mol
    :param Ap: Redlich-Kister coefficients of the positive electrode, J/mol
    :param Tb0: temperature of cell and surroundings at the start, K
    :param mC: thermal mass of the cell, J/K
    :param tau: time constant of its cooling, s
    :param VEOD: voltage at which the cell counts as discharged, V
    :raises ValueError: if a value is not finite, or outside the range in which the model means anything
    """

    q_mobile: float = 7600.0
    r_o: float = 0.117215
    R: float = 8.3144621
    F: float = 96487.0
    alpha: float = 0.5
    Sn: float = 0.000437545
    Sp: float = 0.00030962
    kn: float = 2120.96
    kp: float = 248898.0
    Vol: float = 2e-5
    VolSFraction: float = 0.1
    tDiffusion: float = 7e6
    to: float = 6.08671
    tsn: float = 1001.38
    tsp: float = 46.4311
    U0n: float = 0.01
    U0p: float = 4.03
    An: tuple[float, ...] = (86.19,)
    Ap: tuple[float, ...] = (
        -31593.7,
        0.106747,
        24606.4,
        -78561.9,
        13317.9,
        307387.0,
        84916.1,
        -1.07469e6,
        2285.04,
        990894.0,
        283920.0,
        -161513.0,
        -469218.0,
    )
    Tb0: float = 292.1
    mC: float = 37.04
    tau: float = 100.0
    VEOD: float = 3.0

    def __post_init__(self) -> None:
        check_q_mobile(self.q_mobile)
        check_r_o(self.r_o)
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if field.name in ("An", "Ap") and isinstance(value, tuple) else (value,)
            if not all(isinstance(number, Real) for number in numbers):
                raise TypeError(f"CellParameters: {field.name} must be {field.type}, got {value!r}")
            if not np.all(np.isfinite(np.array(value, dtype=np.float64))):
                raise ValueError(f"CellParameters: {field.name} must be finite, got {value!r}")
            if field.name not in ("U0n", "U0p", "An", "Ap", "r_o") and not value > 0.0:
                raise ValueError(f"CellParameters: {field.name} must be greater than 0, got {value!r}")
        for name in ("An", "Ap"):
            if not 1 <= len(getattr(self, name)) < _POLYNOMIAL_SIZE:
                raise ValueError(
                    f"CellParameters: {name} must hold 1 to {_POLYNOMIAL_SIZE - 1} coefficients, got {getattr(self, name)!r}"
                )
        if not self.VolSFraction < 1.0:
            raise ValueError(f"CellParameters: VolSFraction is a share and must be less than 1, got {self.VolSFraction!r}")
        if self.alpha != 0.5:
            raise ValueError(f"CellParameters: only alpha = 0.5 is implemented (no library uses another), got {self.alpha!r}")

    def replace(self, **changes: Any) -> CellParameters:
        """
        A copy with some constants changed.

        :param changes: constants by name
        :return: the changed copy
        """
        return replace(self, **changes)

    @cached_property
    def packed(self) -> PackedConstants:
        """
        What the compiled kernels read: constants of the equations, and both equilibrium-potential polynomials.

        :return: one row of constants, and the polynomials
        """
        volume_surface = self.VolSFraction * self.Vol
        constants = [
            _SIX_TENTHS / self.VolSFraction,  # mole fraction = constant * surface charge / q_mobile
            1.0 / ((self.Vol - volume_surface) * self.tDiffusion),
            1.0 / (volume_surface * self.tDiffusion),
            self.R / self.F,
            1.0 / self.alpha,
            1.0 / (2.0 * self.Sn * self.kn),
            1.0 / (2.0 * self.Sp * self.kp),
            1.0 / self.to,
            1.0 / self.tsn,
            1.0 / self.tsp,
            self.U0p - self.U0n,
            1.0 / self.mC,
            1.0 / self.tau,
            self.Tb0,
        ]
        return PackedConstants(
            np.array([constants]),
            _redlich_kister_polynomial(self.An, self.F),
            _redlich_kister_polynomial(self.Ap, self.F),
        )

    def packed_with(self, factors: FloatArray) -> PackedConstants:
        """
        Constants of many cells that differ from this one in what is known least, for the unchecked functions.

        :param factors: what each of ``UNCERTAIN_CONSTANTS`` is multiplied by, shape (n, 4)
        :return: constants with one row a cell
        """
        packed = self.packed
        constants = np.repeat(packed.constants, len(factors), axis=0)
        kn, t_diffusion, to, tsn = factors.T
        constants[:, 5] /= kn
        constants[:, [1, 2]] /= t_diffusion[:, None]
        constants[:, 7] /= to
        constants[:, 8] /= tsn
        return packed._replace(constants=constants)


def _numbers(name: str, value: ArrayLike, what: str = "") -> FloatArray:
    try:
        return np.asarray(value, dtype=np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a number or an array of numbers{what}, got {value!r}") from error


def _checked_cell(parameters: CellParameters | None, thermal: bool = False) -> CellParameters:
    if parameters is not None and not isinstance(parameters, CellParameters):
        raise TypeError(f"parameters must be CellParameters or None, got {parameters!r}")
    if not isinstance(thermal, (bool, np.bool_)):
        raise TypeError(f"thermal must be True or False, got {thermal!r}")
    return NEW_CELL if parameters is None else parameters


def _check_range(name: str, value: ArrayLike, limits: tuple[float, float], unit: str, hint: str) -> FloatArray:
    array = _numbers(name, value, f" in {unit}")
    inside = (array >= limits[0]) & (array <= limits[1])
    if not inside.all():
        worst = array[~inside].flat[0]
        raise ValueError(f"{name} must lie within {limits[0]:g} .. {limits[1]:g} {unit}, got {worst:g}. {hint}")
    return array


def check_q_mobile(q_mobile: ArrayLike) -> FloatArray:
    """
    Refuse values of ``q_mobile`` that cannot be meant.

    :param q_mobile: charge that can move, C, any shape
    :return: the same as a float64 array
    :raises ValueError: outside ``Q_MOBILE_LIMITS_C``
    """
    return _check_range("q_mobile", q_mobile, Q_MOBILE_LIMITS_C, "C", "Ampere-hours become coulombs times 3600.")


def check_r_o(r_o: ArrayLike) -> FloatArray:
    """
    Refuse values of ``r_o`` that cannot be meant.

    :param r_o: ohmic resistance, ohm, any shape
    :return: the same as a float64 array
    :raises ValueError: outside ``R_O_LIMITS_OHM``
    """
    return _check_range("r_o", r_o, R_O_LIMITS_OHM, "ohm", "Milliohms become ohms divided by 1000.")


def check_load(load: ArrayLike, load_unit: LoadUnit) -> FloatArray:
    """
    Refuse loads that cannot be meant. Negative loads charge the cell.

    :param load: power in W or current in A, any shape
    :param load_unit: ``"power"`` or ``"current"``
    :return: the load as a float64 array
    :raises ValueError: for another unit, or beyond ``LOAD_LIMITS``
    """
    if not isinstance(load_unit, str) or load_unit not in LOAD_LIMITS:
        raise ValueError(f"load_unit must be 'power' (W) or 'current' (A), got {load_unit!r}")
    limit = LOAD_LIMITS[load_unit]
    return _check_range("load", load, (-limit, limit), LOAD_UNIT_SYMBOLS[load_unit], f"The unit of the load is {load_unit}.")


def check_dt(dt: float, parameters: CellParameters) -> float:
    """
    Refuse time steps for which explicit Euler is unstable.

    :param dt: time step, s
    :param parameters: constants of the cell; the fastest of them, ``to``, sets the limit
    :return: the time step
    :raises ValueError: unless 0 < dt <= 2 * to
    """
    limit = 2.0 * min(parameters.to, parameters.tsn, parameters.tsp)
    if not isinstance(dt, Real) or not 0.0 < dt <= limit:
        raise ValueError(
            f"dt must be greater than 0 and at most {limit:.4g} s (twice the fastest time constant: explicit Euler is "
            f"unstable beyond), got {dt!r}. Use a smaller dt."
        )
    return float(dt)


def initial_state(q_mobile: ArrayLike, parameters: CellParameters | None = None) -> FloatArray:
    """
    The state of a fully charged cell at rest: V = 4.191350 V for every ``q_mobile``.

    :param q_mobile: charge that can move, C, shape (...)
    :param parameters: constants of the cell; ``None``: the new cell's
    :return: state, shape (..., 8)
    :raises ValueError: if ``q_mobile`` is out of range
    """
    q = check_q_mobile(q_mobile)
    state = np.zeros((*q.shape, STATE_SIZE))
    state[..., TB] = _checked_cell(parameters).Tb0
    state[..., QNB:] = q[..., None] * FULL_CHARGE_SHARES
    return state


def _check_state(state: ArrayLike) -> FloatArray:
    array = _numbers("state", state)
    if array.ndim == 0 or array.shape[-1] != STATE_SIZE:
        raise ValueError(f"state must have shape (..., {STATE_SIZE}) in the order {STATE_NAMES}, got shape {array.shape}")
    return array


def _flat(array: FloatArray, shape: tuple[int, ...], *tail: int) -> FloatArray:
    return np.array(np.broadcast_to(array, shape + tail), order="C").reshape(-1, *tail)


def voltage(state: ArrayLike, q_mobile: ArrayLike, parameters: CellParameters | None = None) -> FloatArray:
    """
    The terminal voltage, V = V_e,p(x_p) - V_e,n(x_n) - Vo - Vsn - Vsp.

    :param state: shape (..., 8)
    :param q_mobile: charge that can move, C, shape (...)
    :param parameters: constants of the cell; ``None``: the new cell's
    :return: voltage in V, shape (...); NaN where an electrode is empty or overfull
    :raises ValueError: for a wrong shape, or ``q_mobile`` out of range
    """
    x, q = _check_state(state), check_q_mobile(q_mobile)
    shape = np.broadcast_shapes(x.shape[:-1], q.shape)
    out = np.empty(int(np.prod(shape)))
    voltage_into(out, _flat(x, shape, STATE_SIZE), _flat(q, shape), _checked_cell(parameters).packed)
    return out.reshape(shape)[()]


def step(
    state: ArrayLike,
    load: ArrayLike,
    q_mobile: ArrayLike,
    r_o: ArrayLike,
    dt: float = 1.0,
    load_unit: LoadUnit = "power",
    thermal: bool = False,
    parameters: CellParameters | None = None,
) -> FloatArray:
    """
    One step of explicit Euler. All array arguments broadcast over the leading axes of ``state``.

    With power as the load the current is i = P / V(state); where the state has no positive voltage the result is NaN.

    :param state: shape (..., 8)
    :param load: power in W or current in A over the step (positive discharges), shape (...)
    :param q_mobile: charge that can move, C, shape (...)
    :param r_o: ohmic resistance, ohm, shape (...)
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature follows progpy's heat balance; otherwise it stays as it is
    :param parameters: constants of the cell (its own ``q_mobile`` and ``r_o`` are not used); ``None``: the new cell's
    :return: the next state, shape (..., 8)
    :raises ValueError: for a wrong shape, or a value out of range
    """
    cell = _checked_cell(parameters, thermal)
    x, u, q, r = _check_state(state), check_load(load, load_unit), check_q_mobile(q_mobile), check_r_o(r_o)
    shape = np.broadcast_shapes(x.shape[:-1], u.shape, q.shape, r.shape)
    out = np.empty((int(np.prod(shape)), STATE_SIZE))
    step_into(
        out,
        _flat(x, shape, STATE_SIZE),
        _flat(u, shape),
        _flat(q, shape),
        _flat(r, shape),
        check_dt(dt, cell),
        load_unit,
        thermal,
        cell.packed,
    )
    return out.reshape((*shape, STATE_SIZE))


def step_into(
    out: FloatArray,
    state: FloatArray,
    load: FloatArray,
    q_mobile: FloatArray,
    r_o: FloatArray,
    dt: float,
    load_unit: LoadUnit,
    thermal: bool,
    packed: PackedConstants,
    extended: bool = False,
) -> None:
    """
    :func:`step` for inner loops: no checks, no broadcasting, no allocation; all arrays contiguous float64.

    :param out: the next state, shape (n, 8); may be ``state`` itself
    :param state: shape (n, 8)
    :param load: shape (n,)
    :param q_mobile: shape (n,)
    :param r_o: shape (n,)
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature moves
    :param packed: ``CellParameters.packed``, or with one row a cell ``CellParameters.packed_with``
    :param extended: continue the model where it is not defined: the same numbers wherever it is, but finite for a
        ``q_mobile`` that the charges of ``state`` contradict (mole fractions kept within 0.001 .. 0.999), and in voltage
        collapse (power is turned into current at 1 V or more). For calibrators, which try wrong parameters
    """
    step_batch(state, load, q_mobile, r_o, dt, load_unit == "power", thermal, extended, *packed, out)


def advance_in_place(
    state: FloatArray,
    load: FloatArray,
    first: NDArray[np.int64],
    steps: NDArray[np.int64],
    q_mobile: FloatArray,
    r_o: FloatArray,
    dt: float,
    load_unit: LoadUnit,
    thermal: bool,
    packed: PackedConstants,
    extended: bool = False,
) -> None:
    """
    Advance every cell by its own number of steps under its own stretch of ``load``; unchecked, like :func:`step_into`.

    :param state: shape (n, 8), overwritten
    :param load: the load profiles of all cells, end to end
    :param first: where in ``load`` each cell starts, shape (n,)
    :param steps: how many steps each cell takes, shape (n,)
    :param q_mobile: shape (n,)
    :param r_o: shape (n,)
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature moves
    :param packed: ``CellParameters.packed``, or with one row a cell ``CellParameters.packed_with``
    :param extended: as in :func:`step_into`
    """
    order = np.argsort(-steps)
    ordered = packed if len(packed.constants) == 1 else packed._replace(constants=packed.constants[order])
    ahead, flags = state[order], (load_unit == "power", thermal, extended)
    advance_batch(ahead, load, first[order], steps[order], q_mobile[order], r_o[order], dt, *flags, *ordered)
    state[order] = ahead


def voltage_into(
    out: FloatArray, state: FloatArray, q_mobile: FloatArray, packed: PackedConstants, extended: bool = False
) -> None:
    """
    :func:`voltage` for inner loops: no checks, no broadcasting, no allocation; all arrays contiguous float64.

    :param out: voltage in V, shape (n,)
    :param state: shape (n, 8)
    :param q_mobile: shape (n,)
    :param packed: ``CellParameters.packed``, or with one row a cell ``CellParameters.packed_with``
    :param extended: as in :func:`step_into`
    """
    voltage_batch(state, q_mobile, extended, *packed, out)


def state_of_charge(state: FloatArray, q_mobile: FloatArray) -> FloatArray:
    """
    The share of ``q_mobile`` that is left in the negative electrode, 1 at full charge (progpy's ``SOC``).

    :param state: shape (..., 8)
    :param q_mobile: charge that can move, C, shape (...)
    :return: shape (...)
    """
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
    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param eod_time_s: time of the first sample below the cut-off (or without a voltage), the end of discharge, on the
        clock of ``time_s``; NaN if the simulation stopped before
    """

    time_s: FloatArray
    state: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    load: FloatArray
    load_unit: LoadUnit
    q_mobile: float
    r_o: float
    eod_time_s: float

    def part(self, first: int, stop: int) -> Trajectory:
        """
        The samples ``first`` .. ``stop - 1``; time keeps its origin.

        :param first: first sample
        :param stop: one past the last sample
        :return: the part
        """
        window = slice(first, stop)
        return replace(
            self,
            time_s=self.time_s[window],
            state=self.state[window],
            voltage_V=self.voltage_V[window],
            current_A=self.current_A[window],
            load=self.load[window],
        )


def simulate(
    load: float | ArrayLike | Callable[[FloatArray], ArrayLike],
    q_mobile: float,
    r_o: float,
    until: Literal["eod"] | float = "eod",
    dt: float = 1.0,
    load_unit: LoadUnit = "power",
    thermal: bool = False,
    parameters: CellParameters | None = None,
    initial: ArrayLike | None = None,
    cut_off_V: float | None = None,
    max_duration_s: float = 86_400.0,
) -> Trajectory:
    """
    Discharge one cell under a load, from full charge (or from ``initial``), compiled.

    :param load: a number; an array, one value a step; or a function of time in s (a :class:`battery_env.loads.Load`)
        that takes an array. Power in W or current in A
    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param until: ``"eod"`` (the end of discharge) or a duration in s, whichever of the two comes first
    :param dt: time step, s
    :param load_unit: ``"power"`` or ``"current"``
    :param thermal: whether the temperature moves
    :param parameters: constants of the cell (its own ``q_mobile`` and ``r_o`` are not used); ``None``: the new cell's
    :param initial: state at the start, shape (8,); ``None``: full charge at rest
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the constants' ``VEOD``
    :param max_duration_s: where to stop if the discharge does not end by itself (a load of zero), s
    :return: the samples down to the cut-off, and the time of the end of discharge
    :raises ValueError: for a value out of range
    """
    cell = _checked_cell(parameters, thermal)
    dt = check_dt(dt, cell)
    q, r = check_q_mobile(q_mobile), check_r_o(r_o)
    if q.ndim or r.ndim:
        raise ValueError(f"q_mobile and r_o must be single numbers, got shapes {q.shape} and {r.shape}")
    given_unit = getattr(load, "unit", load_unit)
    if given_unit != load_unit:
        raise ValueError(f"the load is a {given_unit}, but load_unit is {load_unit!r}: give load_unit={given_unit!r}")
    if until != "eod" and not (isinstance(until, (int, float)) and 0.0 < until <= max_duration_s):
        raise ValueError(f"until must be 'eod' or a duration within 0 .. {max_duration_s:g} s, got {until!r}")
    duration_s = max_duration_s if until == "eod" else float(until)
    if not isinstance(max_duration_s, Real) or not 0.0 < max_duration_s / dt <= _MAX_STEPS:
        raise ValueError(
            f"max_duration_s must be greater than 0 and at most {_MAX_STEPS:g} steps of dt, got {max_duration_s!r}"
        )
    n_samples = int(np.floor(duration_s / dt + 1e-9)) + 1
    if callable(load):
        loads = _numbers("load", load(dt * np.arange(n_samples, dtype=np.float64)))
    else:
        loads = _numbers("load", load)
        if loads.ndim == 1:
            n_samples = min(n_samples, len(loads))
    if loads.ndim == 0:
        loads = np.full(n_samples, check_load(loads, load_unit))
    else:
        loads = check_load(loads[..., :n_samples], load_unit)
    if loads.shape != (n_samples,) or n_samples == 0:
        raise ValueError(f"load must be a number or one value a step, shape (steps,), got shape {loads.shape}")
    start = initial_state(q, cell) if initial is None else _check_state(initial)
    if start.shape != (STATE_SIZE,):
        raise ValueError(f"initial must have shape ({STATE_SIZE},), got {start.shape}")
    cut_off = cell.VEOD if cut_off_V is None else cut_off_V
    if not isinstance(cut_off, Real) or np.isnan(cut_off):
        raise ValueError(f"cut_off_V must be a number or None, got {cut_off_V!r}")
    state, volts, amperes = np.empty((n_samples + 1, STATE_SIZE)), np.empty(n_samples), np.empty(n_samples)
    state[0] = start
    flags = (load_unit == "power", thermal)
    n = roll_out(
        np.require(loads, requirements=["C", "W"]),
        float(q),
        float(r),
        dt,
        cut_off,
        *flags,
        *cell.packed,
        state,
        volts,
        amperes,
    )
    return Trajectory(
        time_s=dt * np.arange(n, dtype=np.float64),
        state=state[:n].copy(),
        voltage_V=volts[:n].copy(),
        current_A=amperes[:n].copy(),
        load=np.array(loads[:n]),
        load_unit=load_unit,
        q_mobile=float(q),
        r_o=float(r),
        eod_time_s=n * dt if n < n_samples else float("nan"),
    )


#: The new cell: every constant at its default.
NEW_CELL = CellParameters()
