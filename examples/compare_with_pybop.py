"""
The charge and the resistance of a real cell by ``calibrate`` and PyBOP on the same record.

PyBOP fits an equivalent circuit of PyBaMM (a resistor and an RC pair) on the open-circuit voltage of this package's model, so
that its capacity is what q_max is here: the charge between full and empty. It needs ``pip install '.[pybop]'``.
"""

import time

import numpy as np
import pybamm
import pybop

from battery_env import calibrate, initial_state, load_nasa_discharges
from battery_env.electrochemistry import voltage

record = load_nasa_discharges("B0005")[99].loaded_part(cut_off_V=2.7)

print(f"drawn to 2.7 V: {record.charge_C / 3600.0:.3f} Ah\n")
print(f"{'':<16}{'charge (Ah)':>12}{'resistance (ohm)':>18}{'RMSE (mV)':>11}{'time (s)':>10}")


def show(name: str, charge_Ah: float, resistance_ohm: float, residual_V: np.ndarray, since_s: float) -> None:
    rmse_mV = 1e3 * float(np.sqrt(np.nanmean(residual_V**2)))
    took_s = time.perf_counter() - since_s
    print(f"{name:<16}{charge_Ah:12.3f}{resistance_ohm:18.3f}{rmse_mV:11.1f}{took_s:10.3f}")


calibrate(record.until(600.0))  # compiles
since_s = time.perf_counter()
cell = calibrate(record)
residual_V = cell.forecast.at_samples_V - record.voltage_V
show("least squares", cell.q_mobile_C / 3600.0, cell.resistance_10s_ohm, residual_V, since_s)

# The open-circuit voltage of the model over the state of charge. Where it is empty it has none.
soc = np.linspace(0.0, 1.0, 401)
empty, full = initial_state(soc=0.0), initial_state(soc=1.0)
open_circuit_V = voltage(empty + np.maximum(soc, 1e-6)[:, None] * (full - empty))

circuit = pybamm.equivalent_circuit.Thevenin()
circuit.events = []  # a full cell is at one of them
values = circuit.default_parameter_values
values.update(
    {
        "Initial SoC": 1.0,
        "Nominal cell capacity [A.h]": 2.0,
        "Open-circuit voltage [V]": lambda state_of_charge: pybamm.Interpolant(soc, open_circuit_V, state_of_charge),
        "Entropic change [V/K]": 0.0,
        "Element-1 initial overpotential [V]": 0.0,
        "C1 [F]": 2000.0,
        "Cell capacity [A.h]": pybop.Parameter(initial_value=2.0),
        "R0 [Ohm]": pybop.Parameter(initial_value=0.1),
        "R1 [Ohm]": pybop.Parameter(initial_value=0.05),
    }
)
columns = {"Time [s]": record.time_s - record.time_s[0], "Current [A]": record.current_A, "Voltage [V]": record.voltage_V}
since_s = time.perf_counter()
dataset = pybop.Dataset(columns)
simulator = pybop.pybamm.Simulator(circuit, parameter_values=values, protocol=dataset)
found = pybop.NelderMead(pybop.Problem(simulator, pybop.SumSquaredError(dataset))).run()
capacity_Ah, r0_ohm, r1_ohm = found.x
at_best = dict(zip(("Cell capacity [A.h]", "R0 [Ohm]", "R1 [Ohm]"), found.x, strict=True))
residual_V = simulator.solve(at_best)["Voltage [V]"].data - record.voltage_V
show("PyBOP", capacity_Ah, r0_ohm + r1_ohm, residual_V, since_s)
