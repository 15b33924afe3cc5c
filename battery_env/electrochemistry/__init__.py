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

from battery_env.checks import LoadUnit as LoadUnit
from battery_env.electrochemistry.cell import FULL_CHARGE_SHARES as FULL_CHARGE_SHARES
from battery_env.electrochemistry.cell import NEW_CELL as NEW_CELL
from battery_env.electrochemistry.cell import QNB as QNB
from battery_env.electrochemistry.cell import QNS as QNS
from battery_env.electrochemistry.cell import QPS as QPS
from battery_env.electrochemistry.cell import STATE_NAMES as STATE_NAMES
from battery_env.electrochemistry.cell import STATE_SIZE as STATE_SIZE
from battery_env.electrochemistry.cell import TB as TB
from battery_env.electrochemistry.cell import UNCERTAIN_CONSTANTS as UNCERTAIN_CONSTANTS
from battery_env.electrochemistry.cell import VO as VO
from battery_env.electrochemistry.cell import VSP as VSP
from battery_env.electrochemistry.cell import CellParameters as CellParameters
from battery_env.electrochemistry.cell import PackedConstants as PackedConstants
from battery_env.electrochemistry.cell import check_cell as check_cell
from battery_env.electrochemistry.cell import check_dt as check_dt
from battery_env.electrochemistry.cell import rest_shares as rest_shares
from battery_env.electrochemistry.simulation import Trajectory as Trajectory
from battery_env.electrochemistry.simulation import advance_in_place as advance_in_place
from battery_env.electrochemistry.simulation import initial_state as initial_state
from battery_env.electrochemistry.simulation import simulate as simulate
from battery_env.electrochemistry.simulation import state_of_charge as state_of_charge
from battery_env.electrochemistry.simulation import step as step
from battery_env.electrochemistry.simulation import voltage as voltage
