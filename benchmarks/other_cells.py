"""
Real cells of other kinds: ends of their discharges, forecast as a lab does.

.. code-block:: bash

  python -m benchmarks.other_cells

Constants are fitted to the first discharge of a cell that starts full (:func:`battery_env.fit_cell`). Each later discharge is
seen for 25, 50 and 75 % of its time: when will it end, by this fit and by the life, up to six discharges before it? The load
goes on as so far. Beside the forecast two answers without a model: when the charge of the discharge before will be drawn, and
as long as the last discharge before it at this load. All discharges that start full are asked, and a forecast that is refused
counts as refused. This was decided before the first result, and nothing was chosen on these cells; the methods were developed
on B0005 and B0006, of the same table. ``benchmarks/data/README.md`` names sources and licences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from battery_env import CellFit, Discharge, Settings, fit_cell, load_nasa_discharges, track_life
from battery_env.lab.running import forecast_end
from battery_env.loads import constant
from battery_env.plotting import COLOURS
from battery_env.records import VARIED_SHARE, mean_current_A
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION
from benchmarks.forecasts import as_long_as_the_last, coulomb_count
from benchmarks.pybamm_cells import BEFORE, SHARES, draw_ends, end_in_percent, over_shares
from benchmarks.study import Cell, Study, Tables, command_line, markdown, new_panels, table_of

DATA = Path(__file__).parent / "data"


class RealCell(NamedTuple):
    """What readers call a cell, its cut-off, and its first discharge that starts full."""

    title: str
    cut_off_V: float
    first: int = 1


CELLS: Mapping[str, RealCell] = {
    "lg_hg2_nmc_18650_3Ah": RealCell("LG HG2, NMC, 3 Ah", 2.8),
    "lco_pouch_7.3Ah": RealCell("pouch, LCO, 7.3 Ah", 3.0),
    "nmc_21700_M50T_5Ah": RealCell("LG M50T, NMC 811, 5 Ah", 2.5, first=2),
    **{name: RealCell(f"{name}, 2 Ah", 2.7) for name in BUNDLED_CELLS},
}


def full_discharges(name: str) -> list[Discharge]:
    """All discharges of a cell that start full."""
    if name in BUNDLED_CELLS:
        return load_nasa_discharges(name)
    rows = pd.read_csv(DATA / f"{name}.csv.gz")
    columns = ["time_s", "voltage_V", "current_A", "temperature_C"]
    each = [Discharge(*group[columns].to_numpy().T) for _, group in rows.groupby("discharge")]
    return each[CELLS[name].first - 1 :]


def part(cell: str) -> Tables:
    """A cell: fit its first discharge, and forecast all others."""
    _, cut_off_V, first = CELLS[cell]
    discharges = full_discharges(cell)
    fit = fit_cell(discharges[:1], cut_off_V)
    rows: list[dict[str, Any]] = []
    for n, discharge in enumerate(discharges[1:], 1):
        before = discharges[max(n - BEFORE, 0) : n]
        common = {"cell": cell, "discharge": first + n, "fit_rmse_V": fit.rmse_V}
        rows += [common | row for row in _ends(discharge, before, fit, cut_off_V)]
    return {"other_cells": pd.DataFrame(rows)}


def _ends(discharge: Discharge, before: Sequence[Discharge], fit: CellFit, cut_off_V: float) -> list[dict[str, Any]]:
    """What is said of a discharge at each share of its time, with and without the model."""
    start_s, end_s = discharge.load_on_time_s, discharge.eod_time_s(cut_off_V)
    current_A = mean_current_A(discharge.loaded_part(cut_off_V))
    parts = [each.loaded_part(cut_off_V) for each in before]
    alike = [each for each in parts if abs(mean_current_A(each) / current_A - 1.0) <= VARIED_SHARE]
    rows: list[dict[str, Any]] = []
    seen = [discharge.until(start_s + share * (end_s - start_s)) for share in SHARES]
    for share, part_seen in zip(SHARES, seen, strict=True):
        record, load = part_seen.loaded_part(cut_off_V), constant(current_A, "current")
        counted_s = coulomb_count(parts[-1], record, load)
        as_long_s = as_long_as_the_last(alike[-1], record, load) if alike else np.nan
        rows.append({"share": share, "current_A": current_A, "refused": ""})
        for method, said_s in (("count", counted_s), ("as_long", as_long_s)):
            rows[-1][f"{method}_error_percent"] = 100.0 * (said_s - end_s) / (end_s - start_s)
    try:
        life = track_life(before, cut_off_V, fit.calibrator())
    except ValueError as error:
        return [row | {"refused": str(error)} for row in rows]
    for row, part_seen in zip(rows, seen, strict=True):
        try:
            quantiles_s = forecast_end(part_seen, Settings(cell=fit), life=life).eod_quantile_s()
            row |= end_in_percent(quantiles_s, start_s, end_s)
        except ValueError as error:
            row["refused"] = str(error)
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One line a cell."""
    rows = rows.assign(
        half_width=0.5 * (rows["high_percent"] - rows["low_percent"]),
        percent_inside=100.0 * rows["inside"],
        cell=rows["cell"].map({name: each.title for name, each in CELLS.items()}),
        **{method: rows[f"{method}_percent"].abs() for method in ("error", "count_error", "as_long_error")},
    )
    cells: dict[str, Cell] = {
        "discharges asked": ("discharge", lambda numbers: str(numbers.nunique())),
        "end at 25 / 50 / 75 %: mean error (%)": over_shares("error", "mean"),
        "worst (%)": over_shares("error", "max"),
        "inside 90 % (%)": over_shares("percent_inside", "mean"),
        "half width (%)": over_shares("half_width", "mean"),
        "refused": ("error", lambda errors: str(errors.isna().sum())),
        "last charge, counted: mean error (%)": over_shares("count_error", "mean"),
        "worst of it (%)": over_shares("count_error", "max"),
        "as long as the last at this load: mean error (%)": over_shares("as_long_error", "mean"),
        "worst of these (%)": over_shares("as_long_error", "max"),
    }
    return table_of(rows, ["cell"], cells)


def report(rows: pd.DataFrame) -> str:
    """The table as readers see it."""
    return markdown(summary(rows))


def plot(rows: pd.DataFrame) -> Figure:
    """The error of the end and its interval after half of the time, of every discharge, beside that of counting charge."""
    half = rows[rows["share"] == 0.5]
    figure, panels = new_panels(half["cell"].nunique(), 3, (3.4, 3.0))
    for axes, (cell, group) in zip(panels, half.groupby("cell", sort=False), strict=True):
        draw_ends(axes, [(COLOURS[0], ("forecast, 90 %", group))], CELLS[str(cell)].title)
        axes.plot(group["discharge"], group["count_error_percent"], "x", ms=4, color=COLOURS[1], label="last charge, counted")
        # a cell of a single discharge has one tick, too
        axes.set_xlim(group["discharge"].min() - 0.5, group["discharge"].max() + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("other_cells", __doc__)
    parser.add_argument("--cells", nargs="+", default=list(CELLS), choices=CELLS)
    study = Study(parser, arguments)
    study.configuration |= {
        "shares": SHARES,
        "before": BEFORE,
        "seeds": "none: the draws of a forecast have the seed 0",
        "data": ["benchmarks/data/README.md", NASA_CITATION],
    }
    rows = study.run(part, [{"cell": cell} for cell in study.chosen.cells])["other_cells"]
    study.write({"other_cells": rows}, {"other_cells": plot(rows)}, report(rows))


if __name__ == "__main__":
    main()
