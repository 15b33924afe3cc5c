"""
The derivatives of the model with respect to its parameters at a given current: its equations, differentiated.

A tangent is the derivative of a state. The state of a cell is the only row of ``x``, as the kernels of the model take rows of
arrays. Its tangents ``dx`` have the shape (1, 2, 8) or (1, 8, 8), with rows in the order of ``TANGENT_NAMES``: with respect to
``q_mobile`` and ``r_o`` and, optionally, to the logarithms of ``RATE_CONSTANTS``. The charges are linear in ``q_mobile``, so
that their tangents hold at any distance.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled, inlined
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
    cell_fractions,
    cell_step,
    cell_voltage,
    diffusion,
    mole_fraction,
    nernst_logarithm,
    nominal_overpotentials,
    polynomial,
)

#: Constants that set how fast the cell follows its load; derivatives are with respect to their logarithms.
RATE_CONSTANTS: tuple[str, ...] = ("kn", "kp", "tDiffusion", "to", "tsn", "tsp")
#: Rows of the tangents.
TANGENT_NAMES: tuple[str, ...] = ("q_mobile", "r_o", *RATE_CONSTANTS)
BY_Q, BY_R, BY_KN, BY_KP, BY_T_DIFFUSION, BY_TO, BY_TSN, BY_TSP = range(len(TANGENT_NAMES))


class PolynomialDerivatives(NamedTuple):
    """The derivatives of both equilibrium-potential polynomials, V, laid out as the polynomials, shape (14,)."""

    slope_n: FloatArray
    slope_p: FloatArray

    @classmethod
    def of(cls, packed: PackedConstants) -> PolynomialDerivatives:
        """Differentiate the polynomials of a cell."""
        return cls(*(_polynomial_derivative(polynomial) for polynomial in packed[1:]))


def _polynomial_derivative(coefficients: FloatArray) -> FloatArray:
    return np.append(coefficients[1:] * np.arange(1, len(coefficients)), 0.0)


@inlined
def equilibrium_slopes(
    xn: float, xp: float, tb: float, constants: FloatArray, derivatives: PolynomialDerivatives
) -> tuple[float, float]:
    # derivatives of kernels.equilibrium_voltage with respect to xn and xp
    nernst = constants[0, R_OVER_F] * tb
    by_xn = nernst / (xn * (1.0 - xn)) - 2.0 * polynomial(derivatives.slope_n, 2.0 * xn - 1.0)
    by_xp = 2.0 * polynomial(derivatives.slope_p, 2.0 * xp - 1.0) - nernst / (xp * (1.0 - xp))
    return by_xn, by_xp


@inlined
def overpotential_slopes(i: float, xn: float, xp: float, tb: float, constants: FloatArray) -> tuple[float, float]:
    # derivatives of kernels.nominal_overpotentials, each with respect to the mole fraction of the same electrode
    scale = 2.0 * constants[0, R_OVER_F] * tb
    an, wn = i * constants[0, PER_CURRENT_N], (1.0 - xn) * xn
    ap, wp = i * constants[0, PER_CURRENT_P], (1.0 - xp) * xp
    by_xn = scale * an * (xn - 0.5) / (wn * sqrt(wn + an * an))
    by_xp = scale * ap * (xp - 0.5) / (wp * sqrt(wp + ap * ap))
    return by_xn, by_xp


@inlined
def _fraction_tangents(dx: FloatArray, xn: float, xp: float, q: float, constants: FloatArray) -> tuple[float, float]:
    # derivatives of xn and xp with respect to q; xn and xp do not depend on r_o
    share = constants[0, FRACTION_PER_SHARE] / q
    return share * dx[0, BY_Q, QNS] - xn / q, share * dx[0, BY_Q, QPS] - xp / q


@inlined
def _rate_fraction_tangents(dx: FloatArray, row: int, q: float, constants: FloatArray) -> tuple[float, float]:
    # derivatives of xn and xp with respect to the logarithm of a rate constant; only tDiffusion moves them
    dxn = mole_fraction(dx[0, row, QNS], q, False, constants)
    return dxn, mole_fraction(dx[0, row, QPS], q, False, constants)


@inlined
def _voltage_slopes(
    x: FloatArray, q: float, thermal: bool, packed: PackedConstants, derivatives: PolynomialDerivatives
) -> tuple[float, float, float, float, float]:
    # mole fractions at both surfaces, and the derivatives of the voltage by these and by the temperature
    constants, tb = packed.constants, x[0, TB]
    xn, xp = cell_fractions(x, 0, q, False, constants)
    v_xn, v_xp = equilibrium_slopes(xn, xp, tb, constants, derivatives)
    return xn, xp, v_xn, v_xp, constants[0, R_OVER_F] * nernst_logarithm(xn, xp) if thermal else 0.0


@inlined
def _voltage_tangent(dx: FloatArray, row: int, by_fractions: float, v_tb: float) -> float:
    # by_fractions: the change of the voltage through the mole fractions
    return by_fractions - dx[0, row, VO] - dx[0, row, VSN] - dx[0, row, VSP] + v_tb * dx[0, row, TB]


@inlined
def voltage_tangents(
    x: FloatArray, dx: FloatArray, q: float, thermal: bool, packed: PackedConstants, derivatives: PolynomialDerivatives
) -> tuple[float, float]:
    # The derivatives of the voltage with respect to q and r_o; the cell has a voltage
    xn, xp, v_xn, v_xp, v_tb = _voltage_slopes(x, q, thermal, packed, derivatives)
    dxn, dxp = _fraction_tangents(dx, xn, xp, q, packed.constants)
    return _voltage_tangent(dx, BY_Q, v_xn * dxn + v_xp * dxp, v_tb), _voltage_tangent(dx, BY_R, 0.0, v_tb)


@compiled
def _voltage_rate_tangents(
    x: FloatArray,
    dx: FloatArray,
    q: float,
    thermal: bool,
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
    by_parameter: FloatArray,
    k: int,
) -> None:
    # The derivatives of the voltage with respect to the logarithms of RATE_CONSTANTS, into column k of by_parameter
    _, _, v_xn, v_xp, v_tb = _voltage_slopes(x, q, thermal, packed, derivatives)
    for row in range(BY_KN, dx.shape[1]):
        dxn, dxp = _rate_fraction_tangents(dx, row, q, packed.constants)
        by_parameter[row, k] = _voltage_tangent(dx, row, v_xn * dxn + v_xp * dxp, v_tb)


@inlined
def _diffuse(dx: FloatArray, row: int, dt: float, constants: FloatArray) -> None:
    # one row of the tangents of the charges over a step; the current does not depend on parameters
    for bulk, surface in ((QNB, QNS), (QPB, QPS)):
        flow_C = dt * diffusion(dx[0, row, bulk], dx[0, row, surface], constants[0, BULK_RATE], constants[0, SURFACE_RATE])
        dx[0, row, bulk] -= flow_C
        dx[0, row, surface] += flow_C


@inlined
def _diffuse_slower(dx: FloatArray, row: int, charges: FloatArray, dt: float, constants: FloatArray) -> None:
    # derivative of the diffusion of these charges over a step by the logarithm of tDiffusion: the flow falls
    for bulk, surface in ((QNB, QNS), (QPB, QPS)):
        flow_C = dt * diffusion(charges[bulk], charges[surface], constants[0, BULK_RATE], constants[0, SURFACE_RATE])
        dx[0, row, bulk] += flow_C
        dx[0, row, surface] -= flow_C


@inlined
def _relax(
    dx: FloatArray, row: int, i: float, nominal: tuple[float, float, float], dt: float, thermal: bool, constants: FloatArray
) -> None:
    # one row of the tangents of the voltage drops and of the temperature over a step; nominal: tangents of the steady drops
    dvo, dvsn, dvsp = dx[0, row, VO], dx[0, row, VSN], dx[0, row, VSP]
    dx[0, row, VO] += dt * (nominal[0] - dvo) * constants[0, TO_RATE]
    dx[0, row, VSN] += dt * (nominal[1] - dvsn) * constants[0, TSN_RATE]
    dx[0, row, VSP] += dt * (nominal[2] - dvsp) * constants[0, TSP_RATE]
    if thermal:
        dx[0, row, TB] += dt * ((dvo + dvsn + dvsp) * i * constants[0, WARMING] - dx[0, row, TB] * constants[0, COOLING])


@inlined
def step_with_tangents(
    x: FloatArray,
    dx: FloatArray,
    i: float,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    extended: bool,
    constants: FloatArray,
) -> None:
    # One step of the state and of its tangents with respect to q and r_o, in place
    tb = x[0, TB]
    xn, xp = cell_fractions(x, 0, q, extended, constants)
    vsn_xn, vsp_xp = overpotential_slopes(i, xn, xp, tb, constants)
    vsn_tb, vsp_tb = 0.0, 0.0
    if thermal:
        vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants)
        vsn_tb, vsp_tb = vsn / tb, vsp / tb
    dxn, dxp = _fraction_tangents(dx, xn, xp, q, constants)
    # effect of a parameter at a fixed state: on the mole fractions, and on the ohmic drop
    for row, by_xn, by_xp, dvo_nominal in ((BY_Q, vsn_xn * dxn, vsp_xp * dxp, 0.0), (BY_R, 0.0, 0.0, i)):
        dtb = dx[0, row, TB]
        _relax(dx, row, i, (dvo_nominal, by_xn + vsn_tb * dtb, by_xp + vsp_tb * dtb), dt, thermal, constants)
    _diffuse(dx, BY_Q, dt, constants)
    cell_step(x, 0, 0, i, q, r_o, dt, thermal, extended, constants)


@compiled
def _step_rate_tangents(
    x: FloatArray, dx: FloatArray, i: float, q: float, r_o: float, dt: float, thermal: bool, constants: FloatArray
) -> None:
    # One step of the tangents with respect to the logarithms of RATE_CONSTANTS, in place; the state stays as it is
    tb = x[0, TB]
    xn, xp = cell_fractions(x, 0, q, False, constants)
    vsn_xn, vsp_xp = overpotential_slopes(i, xn, xp, tb, constants)
    vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants)
    vsn_tb, vsp_tb = (vsn / tb, vsp / tb) if thermal else (0.0, 0.0)
    for row in range(BY_KN, dx.shape[1]):
        dxn, dxp = _rate_fraction_tangents(dx, row, q, constants)
        dtb = dx[0, row, TB]
        _relax(dx, row, i, (0.0, vsn_xn * dxn + vsn_tb * dtb, vsp_xp * dxp + vsp_tb * dtb), dt, thermal, constants)
    _diffuse(dx, BY_T_DIFFUSION, dt, constants)
    # effect of a constant at a fixed state
    an, ap = i * constants[0, PER_CURRENT_N], i * constants[0, PER_CURRENT_P]
    scale = 2.0 * constants[0, R_OVER_F] * tb
    dx[0, BY_KN, VSN] -= dt * scale * an / sqrt((1.0 - xn) * xn + an * an) * constants[0, TSN_RATE]
    dx[0, BY_KP, VSP] -= dt * scale * ap / sqrt((1.0 - xp) * xp + ap * ap) * constants[0, TSP_RATE]
    _diffuse_slower(dx, BY_T_DIFFUSION, x[0], dt, constants)
    dx[0, BY_TO, VO] -= dt * (i * r_o - x[0, VO]) * constants[0, TO_RATE]
    dx[0, BY_TSN, VSN] -= dt * (vsn - x[0, VSN]) * constants[0, TSN_RATE]
    dx[0, BY_TSP, VSP] -= dt * (vsp - x[0, VSP]) * constants[0, TSP_RATE]


@compiled
def least_q(charge: float, slope: float, q: float, margin: float, constants: FloatArray) -> float:
    # The least q at which the mole fraction of a surface keeps the margin from 0 and 1. The charge of the surface is linear in
    # q with this slope
    full_share = 1.0 / constants[0, FRACTION_PER_SHARE]
    intercept = charge - slope * q
    return max(-intercept / (slope - margin * full_share), intercept / ((1.0 - margin) * full_share - slope))


@compiled
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
    columns: FloatArray,
) -> None:
    # Fill the rows of columns up to the last sample at which the model has a voltage: the voltage, its derivatives by q and
    # r_o, and, if columns has rows for these, its derivatives by RATE_CONSTANTS and the mole fraction at the surface of the
    # positive electrode. The charges of the initial state, start, have the derivatives shares with respect to q
    with_rates, constants = columns.shape[0] > 1 + BY_KN, packed.constants
    rows = len(TANGENT_NAMES) if with_rates else BY_KN
    voltage, by_parameter = columns[0], columns[1 : 1 + rows]
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((1, rows, STATE_SIZE))
    x[0] = start
    dx[0, BY_Q, QNB:] = shares
    for k in range(current.shape[0]):
        voltage_k = cell_voltage(x, 0, q, False, packed)
        if np.isnan(voltage_k):
            return
        voltage[k] = voltage_k
        by_parameter[BY_Q, k], by_parameter[BY_R, k] = voltage_tangents(x, dx, q, thermal, packed, derivatives)
        if with_rates:
            columns[1 + rows, k] = mole_fraction(x[0, QPS], q, False, constants)
            _voltage_rate_tangents(x, dx, q, thermal, packed, derivatives, by_parameter, k)
            _step_rate_tangents(x, dx, current[k], q, r_o, dt, thermal, constants)
        step_with_tangents(x, dx, current[k], q, r_o, dt, thermal, False, constants)


@compiled
def least_q_mobile(
    current: FloatArray, q: float, dt: float, constants: FloatArray, start: FloatArray, shares: FloatArray
) -> tuple[float, float]:
    # The q below which the cell is empty before the current ends, and the derivative of this q with respect to the logarithm
    # of tDiffusion; the q of the argument must be larger
    full_share = 1.0 / constants[0, FRACTION_PER_SHARE]
    by_t, slope_by_t = 1, 2  # rows: derivatives by tDiffusion of the charges, and of their slopes by q
    x, dx = np.empty((1, STATE_SIZE)), np.zeros((1, 3, STATE_SIZE))
    x[0] = start
    dx[0, BY_Q, QNB:] = shares
    least, least_by_t = 0.0, 0.0
    for k in range(current.shape[0]):
        for surface in (QNS, QPS):
            charge, slope = x[0, surface], dx[0, BY_Q, surface]
            surface_least = least_q(charge, slope, q, 0.0, constants)
            if surface_least > least:
                least = surface_least
                # at this q the surface is empty, or full; q must follow tDiffusion so that the surface stays so
                charge_by_t = dx[0, by_t, surface] + dx[0, slope_by_t, surface] * (least - q)
                least_by_t = charge_by_t / (full_share - slope) if charge > slope * q else -charge_by_t / slope
        _diffuse(dx, slope_by_t, dt, constants)
        _diffuse_slower(dx, slope_by_t, dx[0, BY_Q], dt, constants)
        _diffuse(dx, by_t, dt, constants)
        _diffuse_slower(dx, by_t, x[0], dt, constants)
        _diffuse(dx, BY_Q, dt, constants)
        cell_step(x, 0, 0, current[k], q, 0.0, dt, False, False, constants)
    return least, least_by_t
