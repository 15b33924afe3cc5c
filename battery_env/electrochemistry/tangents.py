"""
The derivatives of the model with respect to ``q_mobile`` and ``r_o`` at a given current: its equations, differentiated.

A tangent is the derivative of a state. The tangents of n cells have the shape (n, 2, 8); each cell has the rows ``BY_Q`` and
``BY_R``. The charges are linear in ``q_mobile``, so that their tangents hold at any distance. All cells share one row of
constants.
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

#: Rows of the tangents.
BY_Q, BY_R = range(2)

_compiled = njit(cache=True, error_model="numpy")
_inlined = njit(cache=True, error_model="numpy", forceinline=True)


class PolynomialDerivatives(NamedTuple):
    """
    The derivatives of both equilibrium-potential polynomials, laid out as the polynomials, each of shape (14,).

    :param slope_n: first derivative, of the negative electrode, V
    :param slope_p: first derivative, of the positive electrode, V
    :param curvature_n: second derivative, of the negative electrode, V
    :param curvature_p: second derivative, of the positive electrode, V
    """

    slope_n: FloatArray
    slope_p: FloatArray
    curvature_n: FloatArray
    curvature_p: FloatArray

    @classmethod
    def of(cls, packed: PackedConstants) -> PolynomialDerivatives:
        """
        Differentiate the polynomials of a cell.

        :param packed: constants of the cell
        :return: the derivatives
        """
        slopes = [_differentiated(polynomial) for polynomial in packed[1:]]
        return cls(*slopes, *map(_differentiated, slopes))


def _differentiated(coefficients: FloatArray) -> FloatArray:
    return np.append(coefficients[1:] * np.arange(1, len(coefficients)), 0.0)


@_inlined
def equilibrium_slopes(
    xn: float, xp: float, tb: float, constants: FloatArray, c: int, derivatives: PolynomialDerivatives
) -> tuple[float, float]:
    # of kernels.equilibrium_voltage with respect to xn and xp
    nernst = constants[c, R_OVER_F] * tb
    by_xn = nernst / (xn * (1.0 - xn)) - 2.0 * polynomial(derivatives.slope_n, 2.0 * xn - 1.0)
    by_xp = 2.0 * polynomial(derivatives.slope_p, 2.0 * xp - 1.0) - nernst / (xp * (1.0 - xp))
    return by_xn, by_xp


@_inlined
def equilibrium_curvatures(
    xn: float, xp: float, tb: float, constants: FloatArray, c: int, derivatives: PolynomialDerivatives
) -> tuple[float, float]:
    # second derivatives of kernels.equilibrium_voltage with respect to xn and xp; the mixed one is zero
    nernst = constants[c, R_OVER_F] * tb
    by_xn = nernst * (2.0 * xn - 1.0) / (xn * (1.0 - xn)) ** 2 - 4.0 * polynomial(derivatives.curvature_n, 2.0 * xn - 1.0)
    by_xp = 4.0 * polynomial(derivatives.curvature_p, 2.0 * xp - 1.0) - nernst * (2.0 * xp - 1.0) / (xp * (1.0 - xp)) ** 2
    return by_xn, by_xp


@_inlined
def overpotential_slopes(i: float, xn: float, xp: float, tb: float, constants: FloatArray, c: int) -> tuple[float, float]:
    # of kernels.nominal_overpotentials, each with respect to the mole fraction of its own electrode
    scale = 2.0 * constants[c, R_OVER_F] * tb
    an, wn = i * constants[c, PER_CURRENT_N], (1.0 - xn) * xn
    ap, wp = i * constants[c, PER_CURRENT_P], (1.0 - xp) * xp
    by_xn = scale * an * (xn - 0.5) / (wn * sqrt(wn + an * an))
    by_xp = scale * ap * (xp - 0.5) / (wp * sqrt(wp + ap * ap))
    return by_xn, by_xp


@_inlined
def _fraction_tangents(dx: FloatArray, n: int, xn: float, xp: float, q: float, constants: FloatArray) -> tuple[float, float]:
    # of xn and xp with respect to q; they do not depend on r_o
    share = constants[0, FRACTION_PER_SHARE] / q
    return share * dx[n, BY_Q, QNS] - xn / q, share * dx[n, BY_Q, QPS] - xp / q


@_inlined
def voltage_tangents(
    x: FloatArray,
    dx: FloatArray,
    n: int,
    q: float,
    thermal: bool,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
) -> tuple[float, float]:
    # The derivatives of the voltage of row n of x with respect to q and r_o; the cell has a voltage
    constants, tb = packed.constants, x[n, TB]
    xn, xp = mole_fraction(x[n, QNS], q, False, constants, 0), mole_fraction(x[n, QPS], q, False, constants, 0)
    v_xn, v_xp = equilibrium_slopes(xn, xp, tb, constants, 0, derivatives)
    v_tb = constants[0, R_OVER_F] * nernst_logarithm(xn, xp) if thermal else 0.0
    dxn, dxp = _fraction_tangents(dx, n, xn, xp, q, constants)
    by_q = v_xn * dxn + v_xp * dxp - dx[n, BY_Q, VO] - dx[n, BY_Q, VSN] - dx[n, BY_Q, VSP] + v_tb * dx[n, BY_Q, TB]
    by_r_o = -dx[n, BY_R, VO] - dx[n, BY_R, VSN] - dx[n, BY_R, VSP] + v_tb * dx[n, BY_R, TB]
    return by_q, by_r_o


@_inlined
def voltage_curvature(
    x: FloatArray, dx: FloatArray, n: int, q: float, packed: PackedConstants, derivatives: PolynomialDerivatives
) -> float:
    # The second derivative of the voltage of row n of x with respect to q along the tangent of its state
    constants, tb = packed.constants, x[n, TB]
    xn, xp = mole_fraction(x[n, QNS], q, False, constants, 0), mole_fraction(x[n, QPS], q, False, constants, 0)
    dxn, dxp = _fraction_tangents(dx, n, xn, xp, q, constants)
    v_xn, v_xp = equilibrium_slopes(xn, xp, tb, constants, 0, derivatives)
    v_xn_xn, v_xp_xp = equilibrium_curvatures(xn, xp, tb, constants, 0, derivatives)
    # of a charge that is linear in q, over q
    of_fractions = v_xn_xn * dxn * dxn + v_xp_xp * dxp * dxp - 2.0 * (v_xn * dxn + v_xp * dxp) / q
    nernst = constants[0, R_OVER_F] * dx[n, BY_Q, TB]
    return of_fractions + 2.0 * nernst * (dxn / (xn * (1.0 - xn)) - dxp / (xp * (1.0 - xp)))


@_inlined
def _diffuse(dx: FloatArray, n: int, dt: float, constants: FloatArray) -> None:
    # the derivatives of the charges with respect to q over a step; the current does not depend on parameters
    for bulk, surface in ((QNB, QNS), (QPB, QPS)):
        moved = dt * diffusion(dx[n, BY_Q, bulk], dx[n, BY_Q, surface], constants[0, BULK_RATE], constants[0, SURFACE_RATE])
        dx[n, BY_Q, bulk] -= moved
        dx[n, BY_Q, surface] += moved


@_inlined
def step_with_tangents(
    x: FloatArray,
    dx: FloatArray,
    n: int,
    i: float,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    extended: bool,
    constants: FloatArray,
) -> None:
    # One step of row n of x and of its tangents, in place
    tb = x[n, TB]
    xn, xp = mole_fraction(x[n, QNS], q, extended, constants, 0), mole_fraction(x[n, QPS], q, extended, constants, 0)
    vsn_xn, vsp_xp = overpotential_slopes(i, xn, xp, tb, constants, 0)
    vsn_tb, vsp_tb = 0.0, 0.0
    if thermal:
        vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants, 0)
        vsn_tb, vsp_tb = vsn / tb, vsp / tb
    dxn, dxp = _fraction_tangents(dx, n, xn, xp, q, constants)
    # what a parameter does at a given state: to the mole fractions, and to the ohmic drop
    for row, by_xn, by_xp, dvo_nominal in ((BY_Q, vsn_xn * dxn, vsp_xp * dxp, 0.0), (BY_R, 0.0, 0.0, i)):
        dtb, dvo, dvsn, dvsp = dx[n, row, TB], dx[n, row, VO], dx[n, row, VSN], dx[n, row, VSP]
        dx[n, row, VO] += dt * (dvo_nominal - dvo) * constants[0, TO_RATE]
        dx[n, row, VSN] += dt * (by_xn + vsn_tb * dtb - dvsn) * constants[0, TSN_RATE]
        dx[n, row, VSP] += dt * (by_xp + vsp_tb * dtb - dvsp) * constants[0, TSP_RATE]
        if thermal:
            dx[n, row, TB] += dt * ((dvo + dvsn + dvsp) * i * constants[0, WARMING] - dtb * constants[0, COOLING])
    _diffuse(dx, n, dt, constants)
    cell_step(x, n, i, q, r_o, dt, thermal, extended, constants, 0, x, n)


@_compiled
def least_q(charge: float, slope: float, q: float, margin: float, constants: FloatArray) -> float:
    # The least q at which the mole fraction of a surface is this far inside 0 .. 1. Its charge, the one given at q, is linear
    # in q with this slope
    full = 1.0 / constants[0, FRACTION_PER_SHARE]
    moved = charge - slope * q
    return max(-moved / (slope - margin * full), moved / ((1.0 - margin) * full - slope))


@_compiled
def roll_out_with_tangents(
    current: FloatArray,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    start: FloatArray,
    shares: FloatArray,
    voltage: FloatArray,
    by_parameter: FloatArray,
) -> None:
    # Fills voltage and the rows of by_parameter, its derivatives, up to the last sample at which the model has a voltage. The
    # charges of the first state, start, have the derivatives shares with respect to q
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((1, 2, STATE_SIZE))
    x[0] = start
    dx[0, BY_Q, QNB:] = shares
    for k in range(current.shape[0]):
        voltage_k = cell_voltage(x, 0, q, False, packed, 0)
        if np.isnan(voltage_k):
            return
        voltage[k] = voltage_k
        by_parameter[BY_Q, k], by_parameter[BY_R, k] = voltage_tangents(x, dx, 0, q, thermal, packed, derivatives)
        step_with_tangents(x, dx, 0, current[k], q, r_o, dt, thermal, False, packed.constants)


@_compiled
def least_q_mobile(
    current: FloatArray, q: float, dt: float, constants: FloatArray, start: FloatArray, shares: FloatArray
) -> float:
    # The q below which the cell is empty before the current ends; the one given is large enough
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((1, 2, STATE_SIZE))
    x[0] = start
    dx[0, BY_Q, QNB:] = shares
    least = 0.0
    for k in range(current.shape[0]):
        for surface in (QNS, QPS):
            least = max(least, least_q(x[0, surface], dx[0, BY_Q, surface], q, 0.0, constants))
        _diffuse(dx, 0, dt, constants)
        cell_step(x, 0, current[k], q, 0.0, dt, False, False, constants, 0, x, 0)
    return least
