"""
The derivatives of the model with respect to its parameters at a given current: its equations, differentiated.

A tangent is the derivative of a state. Those of a cell are the rows of an array of shape (2, 8) or (8, 8), in the order of
``TANGENT_NAMES``: with respect to ``q_mobile`` and ``r_o`` and, if asked for, to the logarithms of the constants that say how
fast the cell follows its load. The charges are linear in ``q_mobile``, so that their tangents hold at any distance.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from battery_env.arrays import FloatArray
from battery_env.electrochemistry.cell import (
    BULK_RATE,
    COOLING,
    FRACTION_PER_SHARE,
    PER_CURRENT_N,
    PER_CURRENT_P,
    QNB,
    QNS,
    QPB,
    QPS,
    R_OVER_F,
    STATE_SIZE,
    SURFACE_RATE,
    TB,
    TO_RATE,
    TSN_RATE,
    TSP_RATE,
    VO,
    VSN,
    VSP,
    WARMING,
    PackedConstants,
)
from battery_env.electrochemistry.kernels import (
    cell_step,
    cell_voltage,
    diffusion,
    mole_fraction,
    nernst_logarithm,
    nominal_overpotentials,
    polynomial,
)

#: Constants that say how fast the cell follows its load; derivatives are with respect to their logarithms.
RATE_CONSTANTS: tuple[str, ...] = ("kn", "kp", "tDiffusion", "to", "tsn", "tsp")
#: Rows of the tangents.
TANGENT_NAMES: tuple[str, ...] = ("q_mobile", "r_o", *RATE_CONSTANTS)
BY_Q, BY_R, BY_KN, BY_KP, BY_T_DIFFUSION, BY_TO, BY_TSN, BY_TSP = range(len(TANGENT_NAMES))

_compiled = njit(cache=True, error_model="numpy")


class PolynomialSlopes(NamedTuple):
    """
    The derivatives of both equilibrium-potential polynomials, laid out as the polynomials.

    :param negative: of the negative electrode, V, shape (14,)
    :param positive: of the positive electrode, V, shape (14,)
    """

    negative: FloatArray
    positive: FloatArray

    @classmethod
    def of(cls, packed: PackedConstants) -> PolynomialSlopes:
        """
        Differentiate the polynomials of a cell.

        :param packed: constants of the cell
        :return: the derivatives
        """
        powers = np.arange(1, len(packed.polynomial_n))
        n, p = (np.append(a[1:] * powers, 0.0) for a in (packed.polynomial_n, packed.polynomial_p))
        return cls(n, p)


@_compiled
def equilibrium_slopes(
    xn: float, xp: float, tb: float, constants: FloatArray, c: int, slopes: PolynomialSlopes
) -> tuple[float, float]:
    # of kernels.equilibrium_voltage with respect to xn and xp
    nernst = constants[c, R_OVER_F] * tb
    by_xn = nernst / (xn * (1.0 - xn)) - 2.0 * polynomial(slopes.negative, 2.0 * xn - 1.0)
    by_xp = 2.0 * polynomial(slopes.positive, 2.0 * xp - 1.0) - nernst / (xp * (1.0 - xp))
    return by_xn, by_xp


@_compiled
def overpotential_slopes(i: float, xn: float, xp: float, tb: float, constants: FloatArray, c: int) -> tuple[float, float]:
    # of kernels.nominal_overpotentials, each with respect to the mole fraction of its own electrode
    scale = 2.0 * constants[c, R_OVER_F] * tb
    an, wn = i * constants[c, PER_CURRENT_N], (1.0 - xn) * xn
    ap, wp = i * constants[c, PER_CURRENT_P], (1.0 - xp) * xp
    by_xn = scale * an * (xn - 0.5) / (wn * sqrt(wn + an * an))
    by_xp = scale * ap * (xp - 0.5) / (wp * sqrt(wp + ap * ap))
    return by_xn, by_xp


@_compiled
def _fraction_tangents(
    dx: FloatArray, row: int, xn: float, xp: float, q: float, constants: FloatArray, c: int
) -> tuple[float, float]:
    # of xn and xp
    dxn, dxp = mole_fraction(dx[row, QNS], q, False, constants, c), mole_fraction(dx[row, QPS], q, False, constants, c)
    return (dxn - xn / q, dxp - xp / q) if row == BY_Q else (dxn, dxp)


@_compiled
def _diffuse(dx: FloatArray, row: int, dt: float, constants: FloatArray, c: int) -> None:
    # the tangents of the charges over a step; the current does not depend on parameters
    for bulk, surface in ((QNB, QNS), (QPB, QPS)):
        moved = dt * diffusion(dx[row, bulk], dx[row, surface], constants[c, BULK_RATE], constants[c, SURFACE_RATE])
        dx[row, bulk] -= moved
        dx[row, surface] += moved


@_compiled
def _diffuse_slower(dx: FloatArray, row: int, x: FloatArray, of: int, dt: float, constants: FloatArray, c: int) -> None:
    # what row `of` of x moves over a step, differentiated by the logarithm of tDiffusion: its rate falls
    for bulk, surface in ((QNB, QNS), (QPB, QPS)):
        moved = dt * diffusion(x[of, bulk], x[of, surface], constants[c, BULK_RATE], constants[c, SURFACE_RATE])
        dx[row, bulk] += moved
        dx[row, surface] -= moved


@_compiled
def _follow_differently(
    dx: FloatArray, row: int, x: FloatArray, i: float, xn: float, xp: float, r_o: float, dt: float, constants: FloatArray
) -> None:
    # what a step of the state x does to its tangent with respect to the logarithm of a rate constant
    tb = x[0, TB]
    if row == BY_KN:
        a = i * constants[0, PER_CURRENT_N]
        dx[row, VSN] -= dt * 2.0 * constants[0, R_OVER_F] * tb * a / sqrt((1.0 - xn) * xn + a * a) * constants[0, TSN_RATE]
    elif row == BY_KP:
        a = i * constants[0, PER_CURRENT_P]
        dx[row, VSP] -= dt * 2.0 * constants[0, R_OVER_F] * tb * a / sqrt((1.0 - xp) * xp + a * a) * constants[0, TSP_RATE]
    elif row == BY_T_DIFFUSION:
        _diffuse_slower(dx, row, x, 0, dt, constants, 0)
    elif row == BY_TO:
        dx[row, VO] -= dt * (i * r_o - x[0, VO]) * constants[0, TO_RATE]
    else:
        vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants, 0)
        if row == BY_TSN:
            dx[row, VSN] -= dt * (vsn - x[0, VSN]) * constants[0, TSN_RATE]
        else:
            dx[row, VSP] -= dt * (vsp - x[0, VSP]) * constants[0, TSP_RATE]


@_compiled
def roll_out_with_tangents(
    current: FloatArray,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    packed: PackedConstants,
    slopes: PolynomialSlopes,
    start: FloatArray,
    shares: FloatArray,
    voltage: FloatArray,
    by_parameter: FloatArray,
    fraction_p: FloatArray,
) -> None:
    # Fills voltage, the rows of by_parameter, its derivatives (the first two or all), and the mole fraction at the surface of
    # the positive electrode (if there is room for it), up to the last sample at which the model has a voltage. The charges of
    # the first state, start, have the derivatives shares with respect to q
    constants, rows = packed.constants, by_parameter.shape[0]
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((rows, STATE_SIZE))
    x[0] = start
    dx[BY_Q, QNB:] = shares
    for k in range(current.shape[0]):
        voltage_k = cell_voltage(x, 0, q, False, packed, 0)
        if np.isnan(voltage_k):
            return
        voltage[k] = voltage_k
        i, tb = current[k], x[0, TB]
        xn, xp = mole_fraction(x[0, QNS], q, False, constants, 0), mole_fraction(x[0, QPS], q, False, constants, 0)
        if fraction_p.shape[0] > 0:
            fraction_p[k] = xp
        v_xn, v_xp = equilibrium_slopes(xn, xp, tb, constants, 0, slopes)
        vsn_xn, vsp_xp = overpotential_slopes(i, xn, xp, tb, constants, 0)
        v_tb, vsn_tb, vsp_tb = 0.0, 0.0, 0.0
        if thermal:
            v_tb = constants[0, R_OVER_F] * nernst_logarithm(xn, xp)
            vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants, 0)
            vsn_tb, vsp_tb = vsn / tb, vsp / tb
        for row in range(rows):
            dxn, dxp = _fraction_tangents(dx, row, xn, xp, q, constants, 0)
            dtb, dvo, dvsn, dvsp = dx[row, TB], dx[row, VO], dx[row, VSN], dx[row, VSP]
            by_parameter[row, k] = v_xn * dxn + v_xp * dxp - dvo - dvsn - dvsp + v_tb * dtb
            dvo_nominal = i if row == BY_R else 0.0
            dx[row, VO] += dt * (dvo_nominal - dvo) * constants[0, TO_RATE]
            dx[row, VSN] += dt * (vsn_xn * dxn + vsn_tb * dtb - dvsn) * constants[0, TSN_RATE]
            dx[row, VSP] += dt * (vsp_xp * dxp + vsp_tb * dtb - dvsp) * constants[0, TSP_RATE]
            if thermal:
                dx[row, TB] += dt * ((dvo + dvsn + dvsp) * i * constants[0, WARMING] - dtb * constants[0, COOLING])
            _diffuse(dx, row, dt, constants, 0)
            if row > BY_R:
                _follow_differently(dx, row, x, i, xn, xp, r_o, dt, constants)
        cell_step(x, 0, i, q, r_o, dt, thermal, False, constants, 0, x, 0)


@_compiled
def least_q_mobile(
    current: FloatArray, q: float, dt: float, constants: FloatArray, start: FloatArray, shares: FloatArray
) -> tuple[float, float]:
    # The q below which the cell is empty before the current ends, and its derivative with respect to the logarithm of
    # tDiffusion; the q given is large enough. A surface charge that is `charge` at q is charge + slope * (least - q) at least,
    # and must stay within 0 .. full * least
    full = 1.0 / constants[0, FRACTION_PER_SHARE]
    by_t, slope_by_t = 1, 2  # the charges by tDiffusion, and so their slopes by q
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((3, STATE_SIZE))
    x[0] = start
    dx[BY_Q, QNB:] = shares
    least, least_by_t = 0.0, 0.0
    for k in range(current.shape[0]):
        for surface in (QNS, QPS):
            slope, change = dx[BY_Q, surface], dx[slope_by_t, surface]
            moved = x[0, surface] - slope * q
            moved_by_t = dx[by_t, surface] - change * q
            if -moved / slope > least:
                least, least_by_t = -moved / slope, (moved * change / slope - moved_by_t) / slope
            if moved / (full - slope) > least:
                least, least_by_t = moved / (full - slope), (moved * change / (full - slope) + moved_by_t) / (full - slope)
        _diffuse(dx, slope_by_t, dt, constants, 0)
        _diffuse_slower(dx, slope_by_t, dx, BY_Q, dt, constants, 0)
        _diffuse(dx, by_t, dt, constants, 0)
        _diffuse_slower(dx, by_t, x, 0, dt, constants, 0)
        _diffuse(dx, BY_Q, dt, constants, 0)
        cell_step(x, 0, current[k], q, 0.0, dt, False, False, constants, 0, x, 0)
    return least, least_by_t
