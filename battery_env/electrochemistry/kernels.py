"""
The compiled kernels (numba) of the electrochemistry model; :mod:`battery_env.electrochemistry` documents equations and units.

Scalar functions take whole arrays and a row, never a slice: making slices would cost more than the arithmetic. Batches are
computed in blocks of cells, state by state instead of cell by cell, and in loops without branches, so that the compiler uses
vector instructions. Both call the same arithmetic. IEEE 754 defines every operation of it to the bit, so that the result of a
cell does not depend on the size of the batch or on the machine.

``constants`` has one row that all cells share, or in a batch one row a cell.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from battery_env.arrays import FloatArray, IntArray
from battery_env.compiled import compiled, inlined
from battery_env.electrochemistry.cell import (
    BULK_RATE,
    CONSTANTS_SIZE,
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
    SURROUNDINGS,
    TB,
    TO_RATE,
    TSN_RATE,
    TSP_RATE,
    U0,
    VO,
    VSN,
    VSP,
    WARMING,
    PackedConstants,
)

#: The extended model holds mole fractions this far from 0 and 1, and the voltage that turns power into current above a floor;
#: no discharge above the cut-off reaches either limit.
MOLE_FRACTION_MARGIN = 1e-3
_VOLTAGE_FLOOR_V = 1.0

# ln(x) for x = 2^k * m, m within sqrt(1/2) .. sqrt(2): bit patterns of float64, and the polynomial of (ln(1 + f) - 2 s) / s in
# s^2, s = f / (2 + f), of FreeBSD's e_log.c (Sun Microsystems 1993)
_ONE_OVER_ROOT_OF_HALF = np.uint64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD)
_MANTISSA_BITS = np.uint64(52)
_EXPONENT_OF_ONE = np.uint64(1023)
_TWO_TO_THE_52 = np.uint64(0x4330000000000000)
_LN_2_HIGH, _LN_2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_L1, _L2, _L3, _L4 = 6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01
_L5, _L6, _L7 = 1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01

#: A block of cells is one array with rows of this many values: states, inputs of a step, and constants. Rows start at constant
#: multiples, so that the compiler can tell that they do not overlap.
BLOCK = 64
LOAD, _Q, _R_O, _XN, _XP, _VOLTAGE, _CONSTANTS = range(STATE_SIZE, STATE_SIZE + 7)
#: Start of the voltages in a block, and its length; ``LOAD`` is the row of the loads, and of the currents after a step.
VOLTAGE, BLOCK_SIZE = _VOLTAGE * BLOCK, (_CONSTANTS + CONSTANTS_SIZE) * BLOCK


@inlined
def logarithm(x: float) -> float:
    # ln(x) within 1 ulp for x >= 2.3e-308, in operations that exist as vector instructions. The C library's logarithm has
    # branches, and differs between machines. With the C library's a step of BatteryQmax takes 1.05 times as long in 16 cells,
    # 1.09 times in 64 and 1.4 to 1.5 times in 1024
    bits = np.float64(x).view(np.uint64)
    exponent = np.uint64((bits + _ONE_OVER_ROOT_OF_HALF) >> _MANTISSA_BITS)
    k = np.uint64(exponent | _TWO_TO_THE_52).view(np.float64) - (2.0**52 + 1023.0)
    f = np.uint64(bits - ((exponent - _EXPONENT_OF_ONE) << _MANTISSA_BITS)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    r = w * (_L2 + w * (_L4 + w * _L6)) + z * (_L1 + w * (_L3 + w * (_L5 + w * _L7)))
    half_f_f = 0.5 * f * f
    value = k * _LN_2_HIGH - ((half_f_f - (s * (half_f_f + r) + k * _LN_2_LOW)) - f)
    return value if x < np.inf else x  # infinity and NaN stay what they are


@inlined
def polynomial(a: FloatArray, y: float) -> float:
    # degree 13, Estrin's scheme: half the latency of Horner's
    y2 = y * y
    y4 = y2 * y2
    low = (a[0] + a[1] * y) + (a[2] + a[3] * y) * y2 + ((a[4] + a[5] * y) + (a[6] + a[7] * y) * y2) * y4
    high = (a[8] + a[9] * y) + (a[10] + a[11] * y) * y2 + (a[12] + a[13] * y) * y4
    return low + high * (y4 * y4)


@inlined
def asinh_ratio(a: float, w: float) -> float:
    # asinh(a / sqrt(w)) with one root and one logarithm; absolute error below 1e-15
    root = abs(a) + sqrt(a * a + w)
    magnitude = 0.5 * logarithm(root * root / w)
    return magnitude if a >= 0.0 else -magnitude


@inlined
def _fraction(share: float, charge: float, extended: bool) -> float:
    # comparisons in place of min and max: NaN stays NaN
    fraction = share * charge
    if extended:
        fraction = MOLE_FRACTION_MARGIN if fraction < MOLE_FRACTION_MARGIN else fraction
        fraction = 1.0 - MOLE_FRACTION_MARGIN if fraction > 1.0 - MOLE_FRACTION_MARGIN else fraction
    return fraction


@inlined
def _has_voltage(xn: float, xp: float) -> bool:
    # an empty or overfull electrode has no voltage
    return (xn > 0.0) & (xn < 1.0) & (xp > 0.0) & (xp < 1.0)


@inlined
def nernst_logarithm(xn: float, xp: float) -> float:
    # the sum of both Nernst terms, in units of R * Tb / F
    return logarithm((1.0 - xp) * xn / (xp * (1.0 - xn)))


@inlined
def diffusion(bulk: float, surface: float, bulk_rate: float, surface_rate: float) -> float:
    # the current from the bulk to the surface of an electrode
    return bulk * bulk_rate - surface * surface_rate


@inlined
def _equilibrium(xn: float, xp: float, tb: float, gas: float, u0: float, poly_n: FloatArray, poly_p: FloatArray) -> float:
    # Vep(xp) - Ven(xn)
    return u0 + gas * tb * nernst_logarithm(xn, xp) + (polynomial(poly_p, 2.0 * xp - 1.0) - polynomial(poly_n, 2.0 * xn - 1.0))


@inlined
def _current(load: float, voltage: float, extended: bool) -> float:
    # the current of a power load
    if extended:
        return load / (_VOLTAGE_FLOOR_V if voltage < _VOLTAGE_FLOOR_V else voltage)
    return load / voltage if voltage > 0.0 else np.nan


@inlined
def _overpotential(i: float, x: float, scale: float, per_current: float) -> float:
    # steady state of Vsn or Vsp: Butler-Volmer with alpha = 1/2, J0 = k * sqrt(x * (1 - x)); scale: 2 * R * Tb / F
    return scale * asinh_ratio(i * per_current, (1.0 - x) * x)


@inlined
def _euler(
    x: tuple[float, float, float, float, float, float, float, float],
    i: float,
    xn: float,
    xp: float,
    r_o: float,
    dt: float,
    thermal: bool,
    k: tuple[float, float, float, float, float, float, float, float, float, float, float],
) -> tuple[float, float, float, float, float, float, float, float]:
    # One step of explicit Euler of the state x under the current i; k: the constants that it needs
    tb, vo, vsn, vsp, qnb, qns, qpb, qps = x
    bulk_rate, surface_rate, gas, per_current_n, per_current_p, rate_o, rate_n, rate_p, heat, cooling, surroundings = k
    scale = 2.0 * gas * tb
    has_voltage = _has_voltage(xn, xp)
    vsn_nominal = _overpotential(i, xn, scale, per_current_n) if has_voltage else np.nan
    vsp_nominal = _overpotential(i, xp, scale, per_current_p) if has_voltage else np.nan
    diffusion_n = diffusion(qnb, qns, bulk_rate, surface_rate)
    diffusion_p = diffusion(qpb, qps, bulk_rate, surface_rate)
    warming = dt * ((vo + vsn + vsp) * i * heat + (surroundings - tb) * cooling)
    return (
        tb + warming if thermal else tb,
        vo + dt * (i * r_o - vo) * rate_o,
        vsn + dt * (vsn_nominal - vsn) * rate_n,
        vsp + dt * (vsp_nominal - vsp) * rate_p,
        qnb - dt * diffusion_n,
        qns + dt * (diffusion_n - i),
        qpb - dt * diffusion_p,
        qps + dt * (diffusion_p + i),
    )


@inlined
def mole_fraction(surface_charge: float, q: float, extended: bool, constants: FloatArray) -> float:
    return _fraction(constants[0, FRACTION_PER_SHARE] / q, surface_charge, extended)


@inlined
def cell_fractions(x: FloatArray, n: int, q: float, extended: bool, constants: FloatArray) -> tuple[float, float]:
    # mole fractions at both surfaces of row n of x
    return mole_fraction(x[n, QNS], q, extended, constants), mole_fraction(x[n, QPS], q, extended, constants)


@inlined
def equilibrium_voltage(
    xn: float, xp: float, tb: float, constants: FloatArray, poly_n: FloatArray, poly_p: FloatArray
) -> float:
    # for mole fractions inside 0 .. 1
    return _equilibrium(xn, xp, tb, constants[0, R_OVER_F], constants[0, U0], poly_n, poly_p)


@inlined
def nominal_overpotentials(i: float, xn: float, xp: float, tb: float, constants: FloatArray) -> tuple[float, float]:
    # for mole fractions inside 0 .. 1
    scale = 2.0 * constants[0, R_OVER_F] * tb
    return _overpotential(i, xn, scale, constants[0, PER_CURRENT_N]), _overpotential(i, xp, scale, constants[0, PER_CURRENT_P])


@inlined
def cell_voltage(x: FloatArray, n: int, q: float, extended: bool, packed: PackedConstants) -> float:
    # V = Vep(xp) - Ven(xn) - Vo - Vsn - Vsp
    constants, poly_n, poly_p = packed
    xn, xp = cell_fractions(x, n, q, extended, constants)
    if not _has_voltage(xn, xp):
        return np.nan
    equilibrium = equilibrium_voltage(xn, xp, x[n, TB], constants, poly_n, poly_p)
    return equilibrium - x[n, VO] - x[n, VSN] - x[n, VSP]


@inlined
def cell_step(
    x: FloatArray,
    n: int,
    m: int,
    i: float,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    extended: bool,
    constants: FloatArray,
) -> None:
    # One step of row n of x, into its row m, which may be the same
    xn, xp = cell_fractions(x, n, q, extended, constants)
    state = (x[n, TB], x[n, VO], x[n, VSN], x[n, VSP], x[n, QNB], x[n, QNS], x[n, QPB], x[n, QPS])
    k = (
        constants[0, BULK_RATE],
        constants[0, SURFACE_RATE],
        constants[0, R_OVER_F],
        constants[0, PER_CURRENT_N],
        constants[0, PER_CURRENT_P],
        constants[0, TO_RATE],
        constants[0, TSN_RATE],
        constants[0, TSP_RATE],
        constants[0, WARMING],
        constants[0, COOLING],
        constants[0, SURROUNDINGS],
    )
    y = _euler(state, i, xn, xp, r_o, dt, thermal, k)
    x[m, TB], x[m, VO], x[m, VSN], x[m, VSP] = y[0], y[1], y[2], y[3]
    x[m, QNB], x[m, QNS], x[m, QPB], x[m, QPS] = y[4], y[5], y[6], y[7]


@compiled
def fill_block(
    block: FloatArray,
    first: int,
    cells: int,
    state: FloatArray,
    load: FloatArray,
    q: FloatArray,
    r_o: FloatArray,
    constants: FloatArray,
) -> None:
    # Copy ``cells`` cells, from row ``first`` on, into a block of shape (BLOCK_SIZE,); the first block is the largest
    for j in range(cells):
        n = first + j
        for k in range(STATE_SIZE):
            block[k * BLOCK + j] = state[n, k]
        block[LOAD * BLOCK + j] = load[n]
        block[_Q * BLOCK + j] = q[n]
        block[_R_O * BLOCK + j] = r_o[n]
    if constants.shape[0] > 1:
        for j in range(cells):
            for k in range(CONSTANTS_SIZE):
                block[(_CONSTANTS + k) * BLOCK + j] = constants[first + j, k]
    elif first == 0:
        for k in range(CONSTANTS_SIZE):
            for j in range(cells):
                block[(_CONSTANTS + k) * BLOCK + j] = constants[0, k]


@compiled
def voltage_of_block(block: FloatArray, cells: int, extended: bool, poly_n: FloatArray, poly_p: FloatArray) -> None:
    # write the voltages into block[VOLTAGE : VOLTAGE + cells]
    _fractions_of_block(block, cells, extended)
    for j in range(cells):
        xn, xp = block[_XN * BLOCK + j], block[_XP * BLOCK + j]
        gas, u0 = block[(_CONSTANTS + R_OVER_F) * BLOCK + j], block[(_CONSTANTS + U0) * BLOCK + j]
        equilibrium = _equilibrium(xn, xp, block[TB * BLOCK + j], gas, u0, poly_n, poly_p)
        volts = equilibrium - block[VO * BLOCK + j] - block[VSN * BLOCK + j] - block[VSP * BLOCK + j]
        block[VOLTAGE + j] = volts if _has_voltage(xn, xp) else np.nan


@compiled
def _fractions_of_block(block: FloatArray, cells: int, extended: bool) -> None:
    for j in range(cells):
        share = block[(_CONSTANTS + FRACTION_PER_SHARE) * BLOCK + j] / block[_Q * BLOCK + j]
        block[_XN * BLOCK + j] = _fraction(share, block[QNS * BLOCK + j], extended)
        block[_XP * BLOCK + j] = _fraction(share, block[QPS * BLOCK + j], extended)


@compiled
def step_of_block(
    block: FloatArray,
    cells: int,
    dt: float,
    power: bool,
    voltage: bool,
    thermal: bool,
    extended: bool,
    poly_n: FloatArray,
    poly_p: FloatArray,
) -> None:
    # advance the states in the first eight rows; with ``voltage`` (a power load needs it) write the voltages before the step
    if voltage:
        voltage_of_block(block, cells, extended, poly_n, poly_p)
    else:
        _fractions_of_block(block, cells, extended)
    if power:
        for j in range(cells):
            block[LOAD * BLOCK + j] = _current(block[LOAD * BLOCK + j], block[VOLTAGE + j], extended)
    for j in range(cells):
        x = (
            block[TB * BLOCK + j],
            block[VO * BLOCK + j],
            block[VSN * BLOCK + j],
            block[VSP * BLOCK + j],
            block[QNB * BLOCK + j],
            block[QNS * BLOCK + j],
            block[QPB * BLOCK + j],
            block[QPS * BLOCK + j],
        )
        k = (
            block[(_CONSTANTS + BULK_RATE) * BLOCK + j],
            block[(_CONSTANTS + SURFACE_RATE) * BLOCK + j],
            block[(_CONSTANTS + R_OVER_F) * BLOCK + j],
            block[(_CONSTANTS + PER_CURRENT_N) * BLOCK + j],
            block[(_CONSTANTS + PER_CURRENT_P) * BLOCK + j],
            block[(_CONSTANTS + TO_RATE) * BLOCK + j],
            block[(_CONSTANTS + TSN_RATE) * BLOCK + j],
            block[(_CONSTANTS + TSP_RATE) * BLOCK + j],
            block[(_CONSTANTS + WARMING) * BLOCK + j],
            block[(_CONSTANTS + COOLING) * BLOCK + j],
            block[(_CONSTANTS + SURROUNDINGS) * BLOCK + j],
        )
        i, r_o = block[LOAD * BLOCK + j], block[_R_O * BLOCK + j]
        y = _euler(x, i, block[_XN * BLOCK + j], block[_XP * BLOCK + j], r_o, dt, thermal, k)
        block[TB * BLOCK + j] = y[0]
        block[VO * BLOCK + j] = y[1]
        block[VSN * BLOCK + j] = y[2]
        block[VSP * BLOCK + j] = y[3]
        block[QNB * BLOCK + j] = y[4]
        block[QNS * BLOCK + j] = y[5]
        block[QPB * BLOCK + j] = y[6]
        block[QPS * BLOCK + j] = y[7]


@compiled
def states_of_block(block: FloatArray, first: int, cells: int, out: FloatArray) -> None:
    for j in range(cells):
        for k in range(STATE_SIZE):
            out[first + j, k] = block[k * BLOCK + j]


@compiled
def voltage_batch(state: FloatArray, q: FloatArray, extended: bool, packed: PackedConstants, out: FloatArray) -> None:
    block = np.empty(BLOCK_SIZE)
    for first in range(0, out.shape[0], BLOCK):
        cells = min(BLOCK, out.shape[0] - first)
        fill_block(block, first, cells, state, q, q, q, packed.constants)  # load and r_o play no part
        voltage_of_block(block, cells, extended, packed.polynomial_n, packed.polynomial_p)
        for j in range(cells):
            out[first + j] = block[VOLTAGE + j]


@compiled
def step_batch(
    state: FloatArray,
    load: FloatArray,
    q: FloatArray,
    r_o: FloatArray,
    dt: float,
    power: bool,
    thermal: bool,
    extended: bool,
    packed: PackedConstants,
    out: FloatArray,
) -> None:
    block = np.empty(BLOCK_SIZE)
    for first in range(0, out.shape[0], BLOCK):
        cells = min(BLOCK, out.shape[0] - first)
        fill_block(block, first, cells, state, load, q, r_o, packed.constants)
        step_of_block(block, cells, dt, power, power, thermal, extended, packed.polynomial_n, packed.polynomial_p)
        states_of_block(block, first, cells, out)


@compiled
def advance_batch(
    state: FloatArray,
    load: FloatArray,
    first: IntArray,
    steps: IntArray,
    q: FloatArray,
    r_o: FloatArray,
    dt: float,
    power: bool,
    thermal: bool,
    packed: PackedConstants,
) -> None:
    # the cells with most steps come first, so that the running cells of a block are always its first ones
    block = np.empty(BLOCK_SIZE)
    for start in range(0, state.shape[0], BLOCK):
        cells = running = min(BLOCK, state.shape[0] - start)
        fill_block(block, start, cells, state, q, q, r_o, packed.constants)  # the load comes below
        for k in range(steps[start]):
            while steps[start + running - 1] <= k:
                running -= 1
            for j in range(running):
                block[LOAD * BLOCK + j] = load[first[start + j] + k]
            step_of_block(block, running, dt, power, power, thermal, False, packed.polynomial_n, packed.polynomial_p)
        states_of_block(block, start, cells, state)


@compiled
def roll_out(
    load: FloatArray,
    q: float,
    r_o: float,
    dt: float,
    cut_off: float,
    power: bool,
    thermal: bool,
    packed: PackedConstants,
    state: FloatArray,
    columns: FloatArray,
) -> int:
    # Fill columns, the voltage and the current at each sample, shape (2, samples), up to the last sample whose voltage is a
    # number and at least the cut-off; return the number of samples. state has one row more, and its row 0 is the start. NaN
    # must end the discharge too, hence "not >=": near its end V can fall from 3.3 V to NaN in one step.
    voltage, current = columns[0], columns[1]
    for k in range(load.shape[0]):
        voltage[k] = cell_voltage(state, k, q, False, packed)
        if not voltage[k] >= cut_off:
            return k
        current[k] = _current(load[k], voltage[k], False) if power else load[k]
        cell_step(state, k, k + 1, current[k], q, r_o, dt, thermal, False, packed.constants)
    return int(load.shape[0])
