"""
The compiled kernels (numba) of the electrochemistry model; :mod:`battery_env.electrochemistry` is their public face and
documents equations and units.

They take whole arrays and a row, never a slice: making slices would cost more than the arithmetic. ``constants`` has one row
that all cells share, or one row a cell.
"""

from __future__ import annotations

from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# The extended model holds mole fractions and the voltage that turns power into current inside these bounds, which no
# discharge reaches above the cut-off
_MOLE_FRACTION_MARGIN = 1e-3
_VOLTAGE_FLOOR_V = 1.0


class PackedConstants(NamedTuple):
    """
    What the kernels read: constants of the equations, and both equilibrium-potential polynomials in y = 2x - 1.

    :param constants: one row for all cells or one row a cell, shape (1, 14) or (n, 14); ``CellParameters.packed`` says what
        the columns are
    :param polynomial_n: of the negative electrode, V, lowest power first, shape (14,)
    :param polynomial_p: of the positive electrode, V, shape (14,)
    """

    constants: FloatArray
    polynomial_n: FloatArray
    polynomial_p: FloatArray


@njit(cache=True, error_model="numpy")
def polynomial(a: FloatArray, y: float) -> float:
    # degree 13, Estrin's scheme: half the latency of Horner's
    y2 = y * y
    y4 = y2 * y2
    low = (a[0] + a[1] * y) + (a[2] + a[3] * y) * y2 + ((a[4] + a[5] * y) + (a[6] + a[7] * y) * y2) * y4
    high = (a[8] + a[9] * y) + (a[10] + a[11] * y) * y2 + (a[12] + a[13] * y) * y4
    return low + high * (y4 * y4)


@njit(cache=True, error_model="numpy")
def asinh_ratio(a: float, w: float) -> float:
    # asinh(a / sqrt(w)) with one root and one logarithm; absolute error below 1e-15
    root = abs(a) + sqrt(a * a + w)
    magnitude = 0.5 * log(root * root / w)
    return magnitude if a >= 0.0 else -magnitude


@njit(cache=True, error_model="numpy")
def mole_fraction(surface_charge: float, q: float, extended: bool, constants: FloatArray, c: int) -> float:
    fraction = constants[c, 0] / q * surface_charge
    if extended:
        return min(max(fraction, _MOLE_FRACTION_MARGIN), 1.0 - _MOLE_FRACTION_MARGIN)
    return fraction


@njit(cache=True, error_model="numpy")
def equilibrium_voltage(
    xn: float, xp: float, tb: float, constants: FloatArray, c: int, poly_n: FloatArray, poly_p: FloatArray
) -> float:
    # Vep(xp) - Ven(xn), for mole fractions inside 0 .. 1; both logarithms of the Nernst terms are taken as one
    nernst = constants[c, 3] * tb * log((1.0 - xp) * xn / (xp * (1.0 - xn)))
    return constants[c, 10] + nernst + (polynomial(poly_p, 2.0 * xp - 1.0) - polynomial(poly_n, 2.0 * xn - 1.0))


@njit(cache=True, error_model="numpy")
def cell_voltage(
    x: FloatArray,
    n: int,
    q: float,
    extended: bool,
    constants: FloatArray,
    c: int,
    poly_n: FloatArray,
    poly_p: FloatArray,
) -> float:
    # V = Vep(xp) - Ven(xn) - Vo - Vsn - Vsp
    xn = mole_fraction(x[n, 5], q, extended, constants, c)
    xp = mole_fraction(x[n, 7], q, extended, constants, c)
    if not (0.0 < xn < 1.0 and 0.0 < xp < 1.0):
        return np.nan  # empty or overfull electrode: the model has no voltage there
    return equilibrium_voltage(xn, xp, x[n, 0], constants, c, poly_n, poly_p) - x[n, 1] - x[n, 2] - x[n, 3]


@njit(cache=True, error_model="numpy")
def nominal_overpotentials(i: float, xn: float, xp: float, tb: float, constants: FloatArray, c: int) -> tuple[float, float]:
    # What Vsn and Vsp relax to: Butler-Volmer with alpha = 1/2, Jn0 = kn * sqrt(xn * (1 - xn)); mole fractions inside 0 .. 1
    thermal_voltage = constants[c, 3] * tb * constants[c, 4]
    vsn = thermal_voltage * asinh_ratio(i * constants[c, 5], (1.0 - xn) * xn)
    vsp = thermal_voltage * asinh_ratio(i * constants[c, 6], (1.0 - xp) * xp)
    return vsn, vsp


@njit(cache=True, error_model="numpy")
def cell_step(
    x: FloatArray,
    n: int,
    i: float,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    extended: bool,
    constants: FloatArray,
    c: int,
    out: FloatArray,
    m: int,
) -> None:
    # One step of explicit Euler of row n of x under the current i, into row m of out; may work in place.
    tb, vo, vsn, vsp = x[n, 0], x[n, 1], x[n, 2], x[n, 3]
    qnb, qns, qpb, qps = x[n, 4], x[n, 5], x[n, 6], x[n, 7]
    xn = mole_fraction(qns, q, extended, constants, c)
    xp = mole_fraction(qps, q, extended, constants, c)
    diffusion_n = qnb * constants[c, 1] - qns * constants[c, 2]
    diffusion_p = qpb * constants[c, 1] - qps * constants[c, 2]
    vsn_nominal, vsp_nominal = np.nan, np.nan
    if 0.0 < xn < 1.0 and 0.0 < xp < 1.0:
        vsn_nominal, vsp_nominal = nominal_overpotentials(i, xn, xp, tb, constants, c)
    out[m, 0] = tb
    if thermal:
        out[m, 0] += dt * ((vo + vsn + vsp) * i * constants[c, 11] + (constants[c, 13] - tb) * constants[c, 12])
    out[m, 1] = vo + dt * (i * r_o - vo) * constants[c, 7]
    out[m, 2] = vsn + dt * (vsn_nominal - vsn) * constants[c, 8]
    out[m, 3] = vsp + dt * (vsp_nominal - vsp) * constants[c, 9]
    out[m, 4] = qnb - dt * diffusion_n
    out[m, 5] = qns + dt * (diffusion_n - i)
    out[m, 6] = qpb - dt * diffusion_p
    out[m, 7] = qps + dt * (diffusion_p + i)


@njit(cache=True, error_model="numpy")
def cell_current(load: float, power: bool, voltage: float, extended: bool) -> float:
    if not power:
        return load
    if extended:
        return load / max(voltage, _VOLTAGE_FLOOR_V)
    return load / voltage if voltage > 0.0 else np.nan


@njit(cache=True, error_model="numpy")
def voltage_batch(
    state: FloatArray,
    q: FloatArray,
    extended: bool,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    out: FloatArray,
) -> None:
    for n in range(out.shape[0]):
        c = n if constants.shape[0] > 1 else 0
        out[n] = cell_voltage(state, n, q[n], extended, constants, c, poly_n, poly_p)


@njit(cache=True, error_model="numpy")
def step_batch(
    state: FloatArray,
    load: FloatArray,
    q: FloatArray,
    r_o: FloatArray,
    dt: float,
    power: bool,
    thermal: bool,
    extended: bool,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    out: FloatArray,
) -> None:
    for n in range(out.shape[0]):
        c = n if constants.shape[0] > 1 else 0
        volts = cell_voltage(state, n, q[n], extended, constants, c, poly_n, poly_p) if power else 0.0
        i = cell_current(load[n], power, volts, extended)
        cell_step(state, n, i, q[n], r_o[n], dt, thermal, extended, constants, c, out, n)


@njit(cache=True, error_model="numpy")
def advance_batch(
    state: FloatArray,
    load: FloatArray,
    first: NDArray[np.int64],
    steps: NDArray[np.int64],
    q: FloatArray,
    r_o: FloatArray,
    dt: float,
    power: bool,
    thermal: bool,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
) -> None:
    for n in range(state.shape[0]):
        c = n if constants.shape[0] > 1 else 0
        for k in range(steps[n]):
            volts = cell_voltage(state, n, q[n], False, constants, c, poly_n, poly_p) if power else 0.0
            i = cell_current(load[first[n] + k], power, volts, False)
            cell_step(state, n, i, q[n], r_o[n], dt, thermal, False, constants, c, state, n)


@njit(cache=True, error_model="numpy")
def roll_out(
    load: FloatArray,
    q: float,
    r_o: float,
    dt: float,
    cut_off: float,
    power: bool,
    thermal: bool,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    state: FloatArray,
    voltage: FloatArray,
    current: FloatArray,
) -> int:
    # state has one row more than there are samples, and its row 0 is the start. Fills the samples up to the last one whose
    # voltage is a number and at least the cut-off; returns how many they are. The condition is written so that NaN ends
    # the discharge too: near its end V can fall from 3.3 V to NaN in one step.
    for k in range(load.shape[0]):
        voltage[k] = cell_voltage(state, k, q, False, constants, 0, poly_n, poly_p)
        if not voltage[k] >= cut_off:
            return k
        current[k] = cell_current(load[k], power, voltage[k], False)
        cell_step(state, k, current[k], q, r_o, dt, thermal, False, constants, 0, state, k + 1)
    return int(load.shape[0])
