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

from battery_env.arrays import FloatArray
from battery_env.checks import LoadUnit
from battery_env.electrochemistry.cell import (
    FULL_CHARGE_SHARES,
    NEW_CELL,
    QNB,
    QNS,
    QPB,
    QPS,
    STATE_NAMES,
    STATE_SIZE,
    TB,
    UNCERTAIN_CONSTANTS,
    VO,
    VSN,
    VSP,
    CellParameters,
    PackedConstants,
    check_cell,
    check_dt,
    rest_shares,
)
from battery_env.electrochemistry.simulation import (
    Trajectory,
    advance_in_place,
    initial_state,
    simulate,
    state_of_charge,
    step,
    step_into,
    voltage,
    voltage_into,
)

__all__ = [
    "FULL_CHARGE_SHARES",
    "NEW_CELL",
    "QNB",
    "QNS",
    "QPB",
    "QPS",
    "STATE_NAMES",
    "STATE_SIZE",
    "TB",
    "UNCERTAIN_CONSTANTS",
    "VO",
    "VSN",
    "VSP",
    "CellParameters",
    "FloatArray",
    "LoadUnit",
    "PackedConstants",
    "Trajectory",
    "advance_in_place",
    "check_cell",
    "check_dt",
    "initial_state",
    "rest_shares",
    "simulate",
    "state_of_charge",
    "step",
    "step_into",
    "voltage",
    "voltage_into",
]
