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
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from battery_env.electrochemistry import simulate
from battery_env.estimators import ExtendedKalmanFilter, LeastSquares
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V
from battery_env.lab.conversions import capacity_Ah, dc_resistance_ohm
from battery_env.plotting import COLOUR_OF, COLOURS, LABELS, new_figure
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.records.model import RecordModel
from benchmarks.study import Study, Tables, command_line, markdown, positive

CUT_OFF_V = 2.7
#: Capacities to these voltages are predicted by estimates from discharges to ``CUT_OFF_V``.
OTHER_CUT_OFFS_V = (3.0, 3.2)
PULSE_S = 10.0

_METHODS = {
    "least_squares": LeastSquares(thermal=True, mismatch_V=UNFITTED_MISMATCH_V),
    "kalman": ExtendedKalmanFilter(thermal=True, mismatch_V=UNFITTED_MISMATCH_V),
}
_MODEL = RecordModel(thermal=True)
# parameters of the curves: the middle one is the same in both panels
_Q_MOBILE_C, _R_O_OHM = (7000.0, 6000.0, 5000.0), (0.05, 0.12, 0.19)
_SHADES = ("#0072b2", "#4b4b4b", "#d55e00")


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
        pulse = dc_resistance_ohm(estimate, load_A, PULSE_S, 1.0, model=_MODEL)
        row |= {f"{name}_r_o_ohm": estimate.r_o, f"{name}_sd_r_o_ohm": estimate.sd_r_o}
        row |= {f"{name}_pulse_ohm": pulse.value, f"{name}_sd_pulse_ohm": pulse.sd}
        if name == "least_squares":
            for cut_off_V in OTHER_CUT_OFFS_V:
                found = capacity_Ah(estimate, load_A, cut_off_V, model=_MODEL)
                measured_Ah = discharge.loaded_part(cut_off_V).charge_C / 3600.0
                row |= {f"error_to_{cut_off_V:g}_V_percent": 100.0 * (found.value / measured_Ah - 1.0)}
                row |= {f"sd_to_{cut_off_V:g}_V_percent": 100.0 * found.sd / measured_Ah}
    return row


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


def plot_curves() -> Figure:
    """What either parameter does to the voltage of a discharge."""
    figure = new_figure(6.4, 3.3)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    pairs = ([(q, _R_O_OHM[1]) for q in _Q_MOBILE_C], [(_Q_MOBILE_C[1], r) for r in _R_O_OHM])
    for axes, parameters, title in ((left, pairs[0], "smaller $q_{max}$"), (right, pairs[1], "larger $R_o$")):
        for (q_mobile, r_o), shade in zip(parameters, _SHADES, strict=True):
            curve = simulate(2.0, q_mobile, r_o, load_unit="current", cut_off_V=CUT_OFF_V)
            label = f"{q_mobile / 3600.0:.2f} Ah" if axes is left else f"{1e3 * r_o:.0f} m$\\Omega$"
            axes.plot(curve.time_s / 60.0, curve.voltage_V, color=shade, lw=1.8, label=label)
        axes.set(xlabel="time at 2 A (min)")
        axes.set_title(title, fontsize=11)
        axes.grid(alpha=0.25)
        axes.legend(
            title=LABELS["q_mobile" if axes is left else "r_o"].split(" (")[0], frameon=False, fontsize=10, loc="lower left"
        )
    left.set_ylabel("voltage (V)")
    arrow = {"arrowstyle": "-|>", "lw": 2.0, "color": "0.15", "mutation_scale": 16}
    left.annotate("", (39.8, 3.05), (55.0, 3.05), arrowprops=arrow)
    left.text(37.2, 3.05, "ends\nearlier", ha="right", va="center", fontsize=10)
    right.annotate("", (20.0, 3.44), (20.0, 3.71), arrowprops=arrow)
    right.text(21.5, 3.78, "lies lower", ha="left", va="center", fontsize=10)
    return figure


def plot_model() -> Figure:
    """The model: where the charge is, and what takes voltage."""
    figure = new_figure(6.4, 3.0)
    axes = figure.subplots()
    axes.set(xlim=(0.0, 16.0), ylim=(0.0, 7.5))
    axes.axis("off")
    for x, widths, name, names in (
        (0.3, (3.4, 1.2), "negative electrode", ("bulk", "surface")),
        (11.1, (1.2, 3.4), "positive electrode", ("surface", "bulk")),
    ):
        for width, kind in zip(widths, names, strict=True):
            middle, is_bulk = x + width / 2, kind == "bulk"
            axes.add_patch(Rectangle((x, 1.9), width, 3.0, fc="#cfe3f1" if is_bulk else "#8fbfe0", ec="0.3", lw=1.0))
            share = "bulk, 90 %" if is_bulk else "surface, 10 %"
            axes.text(
                middle, 4.1 if is_bulk else 3.4, share, ha="center", va="center", rotation=0 if is_bulk else 90, fontsize=9
            )
            if is_bulk:
                _arrow(axes, (middle - 1.4, 2.5), (middle + 1.4, 2.5), "diffusion, slow", 0.15)
            x += width
        axes.text(x - 2.3, 1.35, name, ha="center", fontsize=10)
    _arrow(axes, (5.1, 3.2), (10.9, 3.2), "$q_{max}$ from full to empty", 0.2)
    axes.plot([2.6, 2.6, 6.3], [5.0, 6.5, 6.5], color="0.2", lw=1.2)
    axes.plot([9.7, 13.4, 13.4], [6.5, 6.5, 5.0], color="0.2", lw=1.2)
    axes.add_patch(Rectangle((6.3, 6.05), 3.4, 0.9, fc="white", ec=COLOURS[1], lw=1.6))
    axes.text(8.0, 6.5, "$R_o$ · current", ha="center", va="center", fontsize=10, color=COLOURS[1])
    formula = "voltage = equilibrium of the surfaces - $R_o$ · current - overpotentials"
    axes.text(8.0, 0.35, formula, ha="center", fontsize=10)
    return figure


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str, above: float) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "lw": 1.8, "color": COLOURS[0], "mutation_scale": 15})
    axes.text((start[0] + end[0]) / 2, start[1] + above, text, ha="center", va="bottom", fontsize=10, color=COLOURS[0])


def plot_resistances(found: pd.DataFrame) -> Figure:
    """``R_o`` by both methods over the lives of the cells, beside measured resistances."""
    cells = list(dict.fromkeys(found["cell"]))
    figure = new_figure(3.2 * len(cells), 3.6)
    panels = figure.subplots(1, len(cells), sharey=True, squeeze=False)[0]
    for axes, cell in zip(panels, cells, strict=True):
        rows = found[found["cell"] == cell].set_index("cycle")
        axes.plot(1e3 * rows["least_squares_r_o_ohm"], color=COLOUR_OF["least squares"], lw=1.8, label="$R_o$, least squares")
        axes.plot(1e3 * rows["kalman_r_o_ohm"], color=COLOUR_OF["Kalman filter"], lw=1.8, label="$R_o$, Kalman filter")
        axes.plot(1e3 * rows["pulse_ohm"], "o", ms=2.4, color="0.35", label="10 s at full charge, measured")
        axes.plot(1e3 * (rows["Re_ohm"] + rows["Rct_ohm"]), "+", ms=4, color="0.35", label="$R_e + R_{ct}$, impedance")
        axes.plot(1e3 * rows["Re_ohm"], "x", ms=3, color="0.6", label="$R_e$, impedance")
        axes.set_title(cell, fontsize=11)
        axes.set_xlabel("cycle")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("resistance (m$\\Omega$)")
    panels[0].set_ylim(bottom=0.0)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return figure


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
    figures = {"model": plot_model(), "curves": plot_curves(), "resistances": plot_resistances(found)}
    study.write(
        tables, figures, "\n".join(markdown(each) for each in (resistance_table(found), conversion_table(found))), "summary"
    )


if __name__ == "__main__":
    main()
