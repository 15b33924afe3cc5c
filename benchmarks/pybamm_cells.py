"""
Cells of other equations: lives of five cells, iron phosphate among them, that PyBaMM simulates (single particle model with
electrolyte), looked at as a lab does with its own.

.. code-block:: bash

  pip install pybamm
  python -m benchmarks.pybamm_cells

A cell is worn from discharge to discharge: it loses active material on both sides, and its contacts get worse. Every fourth
discharge has a current that changes each minute, the others a constant one. Constants are fitted to three discharges at a
constant current and two at a varying one, over the life. Of each other discharge the first 25, 50 and 75 % of the time are
seen: when will it end, by the fit alone, by the six discharges before as well, and without either? And how far is q_max of
whole discharges in other surroundings than those of the fit from that of the same cell there? That an end keeps to what a cell
holds over its life was found on these cells; no number was chosen on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from battery_env import Discharge, Settings, calibrate, fit_cell, track_life
from battery_env.arrays import FloatArray
from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.life import Life
from battery_env.lab.report import Calibration
from battery_env.lab.running import forecast_end
from battery_env.loads import Load
from battery_env.plotting import coloured
from benchmarks.study import (
    Cell,
    Study,
    Tables,
    command_line,
    markdown,
    natural,
    new_panels,
    share_in_percent,
    side_by_side,
    table_of,
)

#: Parameter sets of PyBaMM, and what readers call them.
CELLS = {
    "Chen2020": "LG M50, NMC 811, 5 Ah",
    "Mohtat2020": "pouch, NMC 532, 5 Ah",
    "Ai2020": "Enertech, LCO, 2.3 Ah",
    "Marquis2019": "Kokam, LCO, 0.7 Ah",
    "Prada2013": "A123, LFP, 2.3 Ah",
}
SHARES = (0.25, 0.5, 0.75)
DISCHARGES, BEFORE = 24, 6
#: Those that constants are fitted to.
FITTED = (0, 7, 10, 19, 22)
FIT, LIFE, OF_SIZE, NOTHING = "the fit", "the fit and six discharges before", "the nominal capacity", "nothing"
#: Constant current, and range of one that varies, over the nominal capacity, 1/h.
RATE, RATES, MINUTE_S = 0.8, (0.3, 1.3), 60.0
#: What a life takes of the active material of the negative and the positive electrode, and how many times larger contacts get.
LOST, CONTACT, CONTACT_GROWTH = (0.15, 0.10), 0.025, 3.0
#: Of the surroundings of a life, degC.
OF_LIFE_C = 25.0
#: Of others, degC, and which discharge is looked at in each.
OTHERS_C = (5.0, 15.0, 35.0, 45.0)
MOVED = 12
#: Sampling, s, and noise: V, and a share of the capacity over an hour.
SAMPLING_S, NOISE_V, NOISE_A = 10.0, 0.001, 2e-4


class SimulatedLife(NamedTuple):
    """A life, where its discharges end, and the nominal capacity of the cell."""

    discharges: list[Discharge]
    cut_off_V: float
    nominal_Ah: float


def varies(n: int) -> bool:
    """Whether the current of a discharge does."""
    return n % 4 == 3


def simulated(
    name: str, seed: int, numbers: Sequence[int] = range(DISCHARGES), surroundings_C: float = OF_LIFE_C
) -> SimulatedLife:
    """The life of a cell, or some of its discharges."""
    import pybamm  # here, as it is no requirement of the tests

    pybamm.set_logging_level("ERROR")
    rng, new, made = np.random.default_rng(seed), pybamm.ParameterValues(name), []
    capacity_Ah, cut_off_V = float(new["Nominal cell capacity [A.h]"]), float(new["Lower voltage cut-off [V]"])
    is_thermal = "Negative current collector thickness [m]" in new
    options = {"contact resistance": "true", "thermal": "lumped" if is_thermal else "isothermal"}
    for n in numbers:
        worn, age = new.copy(), n / (DISCHARGES - 1)
        for side, lost in zip(("Negative", "Positive"), LOST, strict=True):
            worn[f"{side} electrode active material volume fraction"] *= 1.0 - lost * age
        worn["Ambient temperature [K]"] = worn["Initial temperature [K]"] = surroundings_C + ZERO_CELSIUS_K
        worn["Contact resistance [Ohm]"] = CONTACT / capacity_Ah * (1.0 + CONTACT_GROWTH * age)
        if varies(n):
            starts_s = np.arange(0.0, 400.0 * MINUTE_S, SAMPLING_S)
            levels_A = capacity_Ah * np.repeat(rng.uniform(*RATES, 400), int(MINUTE_S / SAMPLING_S))
            drive: Any = np.column_stack([starts_s, levels_A])
            ends = f"< {cut_off_V}V"
        else:
            drive, ends = RATE * capacity_Ah, f"{cut_off_V}V"
        often = f"{SAMPLING_S:g} seconds"
        rest = pybamm.step.rest("5 minutes", period=often)
        steps = [rest, pybamm.step.current(drive, termination=ends, period=often), rest]
        model = pybamm.lithium_ion.SPMe(options)
        solution = pybamm.Simulation(model, parameter_values=worn, experiment=pybamm.Experiment(steps)).solve(initial_soc=1.0)
        names = ("Time [s]", "Terminal voltage [V]", "Current [A]", "Volume-averaged cell temperature [C]")
        columns = np.array([solution[name].entries for name in names])
        # a step begins when the one before ends
        time_s, voltage_V, current_A, temperature_C = columns[:, np.append(True, np.diff(columns[0]) > 1e-6)]
        voltage_V = voltage_V + rng.normal(0.0, NOISE_V, len(time_s))
        current_A = current_A + rng.normal(0.0, NOISE_A * capacity_Ah, len(time_s)) * (current_A > 0.0)
        made.append(Discharge(time_s, voltage_V, current_A, temperature_C))
    return SimulatedLife(made, cut_off_V, capacity_Ah)


def to_come(discharge: Discharge, seen: Discharge) -> Load:
    """The current that was measured after what was seen."""
    later = (discharge.time_s >= seen.time_s[-1]) & (discharge.current_A > 0.0)
    return Load(discharge.time_s[later] - discharge.time_s[later][0], discharge.current_A[later], "current")


def part(cell: str, seed: int) -> Tables:
    """A cell: simulate its life, fit it, and forecast the discharges that were not fitted."""
    life, cut_off_V, nominal_Ah = simulated(cell, seed)
    fit = fit_cell([life[n] for n in FITTED], cut_off_V)
    settings = Settings(cell=fit)
    rows: list[dict[str, Any]] = []
    for n, discharge in enumerate(life):
        if n in FITTED or n < BEFORE:
            continue
        found = calibrate(discharge, settings)
        common = {"cell": cell, "discharge": n, "varies": varies(n), "seed": seed, "fit_rmse_V": fit.rmse_V}
        rows.append({**common, "knows": FIT, "share": 1.0, "settled": float(found.settled_q_mobile)})
        before = track_life(life[n - BEFORE : n], cut_off_V, fit.calibrator())
        known: dict[str, tuple[Settings, Life | None]] = {
            FIT: (settings, None),
            LIFE: (settings, before),
            OF_SIZE: (Settings(cut_off_V=cut_off_V, nominal_Ah=nominal_Ah), None),
            NOTHING: (Settings(cut_off_V=cut_off_V), None),
        }
        start_s, end_s = discharge.loaded_part(cut_off_V).time_s[[0, -1]].tolist()
        for share in SHARES:
            seen = discharge.until(start_s + share * (end_s - start_s))
            load = to_come(discharge, seen) if varies(n) else None
            for knows, (stated, own) in known.items():
                quantiles_s = forecast_end(seen, stated, load, life=own).eod_quantile_s()
                rows.append({**common, "knows": knows, "share": share, **end_in_percent(quantiles_s, start_s, end_s)})
    there, surroundings = calibrate(life[MOVED], settings), []
    for other_C in OTHERS_C:
        (moved,) = simulated(cell, seed, [MOVED], other_C).discharges
        surroundings.append(
            {"cell": cell, "seed": seed, "surroundings_C": other_C, **_moved(there, calibrate(moved, settings))}
        )
    return {"pybamm_cells": pd.DataFrame(rows), "surroundings": pd.DataFrame(surroundings)}


def _moved(there: Calibration, elsewhere: Calibration) -> dict[str, float]:
    change_C = elsewhere.q_mobile_C - there.q_mobile_C
    return {
        "q_mobile_percent": 100.0 * change_C / there.q_mobile_C,
        "q_mobile_sd": change_C / elsewhere.sd_q_mobile_C,
        "r_o_ratio": elsewhere.r_o_ohm / there.r_o_ohm,
        "settled_q_mobile": elsewhere.settled_q_mobile,
    }


def end_in_percent(quantiles_s: FloatArray, start_s: float, end_s: float) -> dict[str, float]:
    """How far quantiles of a forecast end lie from the measured one, in percent of the time from load-on."""
    low, middle, high = 100.0 * (quantiles_s - end_s) / (end_s - start_s)
    return {"error_percent": middle, "low_percent": low, "high_percent": high, "inside": float(low <= 0.0 <= high)}


def over_shares(column: str, how: str, by: str = "share") -> Cell:
    """What a cell of a table says of a column at each share of the time, or at each value of another column."""
    return lambda group: side_by_side(group.groupby(by)[column].agg(how).dropna())


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One line a cell and what is known of it."""
    width = rows["high_percent"] - rows["low_percent"]
    shown = rows.assign(
        error=rows["error_percent"].abs(), width=width, cell=rows["cell"].map(CELLS), inside=100.0 * rows["inside"]
    )
    cells: dict[str, Cell] = {
        "end at 25 / 50 / 75 %: mean error (%)": over_shares("error", "mean"),
        "worst (%)": over_shares("error", "max"),
        "inside 90 % (%)": over_shares("inside", "mean"),
        "width of the interval (%)": over_shares("width", "mean"),
        "whole: settled (%)": lambda group: share_in_percent(whole) if len(whole := group["settled"].dropna()) else "",
    }
    return table_of(shown, ["cell", "knows"], cells)


def surroundings_table(rows: pd.DataFrame) -> pd.DataFrame:
    """One line a cell: whole discharges in other surroundings, with constants that were fitted in those of the life."""
    cells: dict[str, Cell] = {
        f"q_mobile at {side_by_side(OTHERS_C)} degC: off (%)": over_shares("q_mobile_percent", "mean", "surroundings_C"),
        "in standard deviations": over_shares("q_mobile_sd", "mean", "surroundings_C"),
        "r_o over that of the life": over_shares("r_o_ratio", "mean", "surroundings_C"),
        "settled q_mobile (%)": ("settled_q_mobile", share_in_percent),
    }
    return table_of(rows.assign(cell=rows["cell"].map(CELLS)), ["cell"], cells)


def draw_ends(axes: Axes, forecasts: Iterable[tuple[str, tuple[Any, pd.DataFrame]]], title: str) -> None:
    """The errors of ends and their intervals, half seen, over the discharges of a cell: by colour and name."""
    for colour, (name, rows) in forecasts:
        error = rows["error_percent"]
        beside = [error - rows["low_percent"], rows["high_percent"] - error]
        axes.errorbar(rows["discharge"], error, beside, fmt=".", color=colour, lw=0.8, label=name)
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set(title=title, xlabel="discharge", ylabel="error of the end, half seen (%)")


def plot(rows: pd.DataFrame) -> Figure:
    """The error of the end and its interval after half of the time, over the life of each cell that was fitted."""
    half = rows[(rows["share"] == 0.5) & rows["knows"].isin([FIT, LIFE])]
    figure, panels = new_panels(len(CELLS), 3, (3.4, 3.0))
    for axes, (cell, of_cell) in zip(panels, half.groupby("cell", sort=False), strict=False):
        draw_ends(axes, coloured(of_cell.groupby("knows", sort=False)), CELLS[str(cell)])
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("pybamm_cells", __doc__)
    parser.add_argument("--seeds", type=natural, nargs="+", default=[0, 1, 2, 3, 4], help="of loads and noise")
    parser.add_argument("--cells", nargs="+", default=list(CELLS), choices=CELLS)
    study = Study(parser, arguments)
    chosen = study.chosen
    tables = study.run(part, [{"cell": cell, "seed": seed} for cell in chosen.cells for seed in chosen.seeds])
    rows = tables["pybamm_cells"]
    text = "\n".join(markdown(table) for table in (summary(rows), surroundings_table(tables["surroundings"])))
    study.write(tables, {"pybamm_cells": plot(rows[rows["seed"] == chosen.seeds[0]])}, text)


if __name__ == "__main__":
    main()
