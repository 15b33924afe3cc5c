"""
What q_max and R_o are, beside what a test bench measures on two real cells: pulses, impedance, and capacities to other
voltages.

.. code-block:: bash

  python -m benchmarks.parameters

Every discharge to 2.7 V is calibrated by least squares and by the Kalman filter. The resistance of a pulse is the fall of the
voltage within 10 s of load-on, from full charge. Capacities to 3.0 and 3.2 V are measured in the same discharge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from battery_env import Estimate
from battery_env.estimators import ExtendedKalmanFilter
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V
from battery_env.lab.settings import Settings
from battery_env.loads import constant
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.records.model import RecordModel
from benchmarks.study import Study, Tables, command_line, markdown, positive

CUT_OFF_V = 2.7
#: Capacities to these voltages are predicted by estimates from discharges to ``CUT_OFF_V``.
OTHER_CUT_OFFS_V = (3.0, 3.2)
PULSE_S = 10.0

_METHODS = {
    "least_squares": Settings(method="least-squares").calibrator(),
    "kalman": ExtendedKalmanFilter(thermal=True, mismatch_V=UNFITTED_MISMATCH_V),
}
_MODEL = RecordModel(thermal=True)


def measure(discharge: Discharge) -> dict[str, Any]:
    """What one discharge shows with and without the model."""
    record = discharge.loaded_part(CUT_OFF_V)
    # without the first moment, in which the current is switched
    load_A = float(np.median(record.current_A))
    pulse_V = np.interp(record.time_s[0] + PULSE_S, record.time_s, record.voltage_V)
    row = {name: discharge.meta[name] for name in ("cell", "cycle", "Re_ohm", "Rct_ohm")}
    row |= {"load_A": load_A, "pulse_ohm": (record.voltage_V[0] - pulse_V) / load_A, "capacity_Ah": record.charge_C / 3600.0}
    for name, method in _METHODS.items():
        estimate = method.estimate(record)
        pulse, sd_pulse = pulse_ohm(estimate, load_A)
        row |= {f"{name}_r_o_ohm": estimate.r_o, f"{name}_sd_r_o_ohm": estimate.sd_r_o}
        row |= {f"{name}_pulse_ohm": pulse, f"{name}_sd_pulse_ohm": sd_pulse}
        if name == "least_squares":
            for cut_off_V in OTHER_CUT_OFFS_V:
                found, sd = capacity_Ah(estimate, load_A, cut_off_V)
                measured_Ah = discharge.loaded_part(cut_off_V).charge_C / 3600.0
                row |= {f"error_to_{cut_off_V:g}_V_percent": 100.0 * (found / measured_Ah - 1.0)}
                row |= {f"sd_to_{cut_off_V:g}_V_percent": 100.0 * sd / measured_Ah}
    return row


def capacity_Ah(estimate: Estimate, load_A: float, cut_off_V: float) -> tuple[float, float]:
    """What a cell of this estimate gives from full down to a cut-off, and its standard deviation to first order."""
    step_C, step_ohm = 0.01 * estimate.q_mobile, 0.002
    q_mobile = estimate.q_mobile + step_C * np.array([0.0, -1.0, 1.0, 0.0])
    r_o = estimate.r_o + np.array([0.0, 0.0, 0.0, step_ohm])
    value, less, more, of_r = _MODEL.at(estimate).capacity_Ah([constant(load_A, "current")], cut_off_V, q_mobile, r_o).tolist()
    by_q, by_r = (more - less) / (2.0 * step_C), (of_r - value) / step_ohm
    return value, float(np.hypot(by_q * estimate.sd_q_mobile, by_r * estimate.sd_r_o))


def pulse_ohm(estimate: Estimate, current_A: float) -> tuple[float, float]:
    """The fall of its voltage within ``PULSE_S`` from full charge, over the current, and its standard deviation."""
    columns = _MODEL.at(estimate).sensitivities(np.full(int(PULSE_S) + 1, current_A), estimate.q_mobile, estimate.r_o)
    value, by_q, by_r = ((column[0] - column[-1]) / current_A for column in columns)
    return float(value), float(np.hypot(by_q * estimate.sd_q_mobile, by_r * estimate.sd_r_o))


def part(cell: str, every: int) -> Tables:
    """The discharges of a cell."""
    return {"resistances": pd.DataFrame([measure(each) for each in load_nasa_discharges(cell)[::every]])}


def resistance_table(found: pd.DataFrame) -> pd.DataFrame:
    """First and last discharge of each cell, and how far neighbours scatter."""
    shown = {
        "pulse of 10 s at full charge, measured": found["pulse_ohm"],
        "R_e, impedance": found["Re_ohm"],
        "R_e + R_ct, impedance": found["Re_ohm"] + found["Rct_ohm"],
        "R_o, least squares": found["least_squares_r_o_ohm"],
        "R_o, Kalman filter": found["kalman_r_o_ohm"],
    }
    rows = []
    for name, values in shown.items():
        row = {"resistance": name}
        for cell, of_cell in values.groupby(found["cell"]):
            scatter = of_cell.diff().std() / np.sqrt(2.0)
            row[f"{cell}: first -> last (ohm)"] = f"{of_cell.iloc[0]:.3f} -> {of_cell.iloc[-1]:.3f}"
            row[f"{cell}: scatter (ohm)"] = f"{scatter:.4f}"
        rows.append(row)
    return pd.DataFrame(rows)


def conversion_table(found: pd.DataFrame) -> pd.DataFrame:
    """How far conversions are from what was measured."""
    rows = []
    for cell, of_cell in found.groupby("cell"):
        for cut_off_V in OTHER_CUT_OFFS_V:
            error, sd = (of_cell[f"{name}_to_{cut_off_V:g}_V_percent"] for name in ("error", "sd"))
            name, inside = f"capacity to {cut_off_V:g} V, least squares (%)", error.abs() <= 2.0 * sd
            rows.append(
                {"cell": cell, "converted to": name, **_errors(error, 1), "within 2 sd (%)": f"{100 * inside.mean():.0f}"}
            )
        for method in _METHODS:
            error, sd = of_cell[f"{method}_pulse_ohm"] - of_cell["pulse_ohm"], of_cell[f"{method}_sd_pulse_ohm"]
            name, inside = f"pulse of 10 s, {method.replace('_', ' ')} (mohm)", error.abs() <= 2.0 * sd
            errors = _errors(1e3 * error, 0)
            rows.append({"cell": cell, "converted to": name, **errors, "within 2 sd (%)": f"{100 * inside.mean():.0f}"})
    return pd.DataFrame(rows)


def _errors(error: pd.Series, digits: int) -> dict[str, str]:
    worst = error.iloc[int(error.abs().to_numpy().argmax())]
    return {
        "mean error": f"{error.mean():+.{digits}f}",
        "mean size": f"{error.abs().mean():.{digits}f}",
        "worst": f"{worst:+.{digits}f}",
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("parameters", __doc__, jobs=1)
    parser.add_argument("--cells", nargs="+", default=list(BUNDLED_CELLS), choices=BUNDLED_CELLS)
    parser.add_argument("--every", type=positive, default=1, help="each how many-th discharge is calibrated")
    study = Study(parser, arguments)
    chosen = study.chosen
    study.configuration |= {"cut_off_V": CUT_OFF_V, "mismatch_V": UNFITTED_MISMATCH_V, "data": NASA_CITATION}
    tables = study.run(part, [{"cell": cell, "every": chosen.every} for cell in chosen.cells])
    found = tables["resistances"]
    study.write(
        tables, {}, "\n".join(markdown(each) for each in (resistance_table(found), conversion_table(found))), "summary"
    )


if __name__ == "__main__":
    main()
