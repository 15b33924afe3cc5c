"""
How far the ageing of one recorded cell tells of another one: least squares with the path of a life as their prior, on
discharges of the cell whose life it is not, whole and in progress, beside the filter that knows nothing and the discharge
before.

.. code-block:: bash

  python -m benchmarks.aging_paths --every 4

Nothing is random. Settings of the paths were chosen with the path of B0006 on B0005; that of B0005 on B0006 is the test.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd
from matplotlib.figure import Figure

from battery_env import LeastSquares, fit_life, forecast, load_nasa_discharges
from battery_env.electrochemistry.aging_path import AgingPath, cell_with
from battery_env.electrochemistry.ends import BAND
from battery_env.lab.running import forecast_end
from battery_env.lab.settings import Settings
from battery_env.plotting import COLOURS
from battery_env.records.discharge import Discharge
from battery_env.records.model import RecordModel
from benchmarks.study import Study, Tables, command_line, digits, markdown, new_panels, positive

CUT_OFF_V = 2.7
SHARES = (0.25, 0.5, 0.75, 1.0)
CELLS = {"B0005": "B0006", "B0006": "B0005"}
PATH, FILTER, LAST = "least squares, path of {}", "what the command says, nothing known", "as long as the last"


def part(judged: str, every: int) -> Tables:
    """The discharges of a cell by the path of the other one."""
    path, discharges = fit_life(load_nasa_discharges(CELLS[judged])), load_nasa_discharges(judged)
    chosen = range(1, len(discharges), every)
    rows = [row for n in chosen for row in _said(path, CELLS[judged], discharges[n], discharges[n - 1])]
    return {"discharges": pd.DataFrame(rows).assign(cell=judged)}


def _said(path: AgingPath, life: str, whole: Discharge, last: Discharge) -> Iterator[dict[str, object]]:
    """What each method says of a discharge at each share of its time, in per cent of the time or of ``q_mobile``."""
    start_s, end_s = whole.load_on_time_s, whole.eod_time_s(CUT_OFF_V)
    percent, known = 100.0 / (end_s - start_s), LeastSquares(mismatch_V=0.05, thermal=True)
    q_mobile = known.estimate(whole.loaded_part(CUT_OFF_V)).q_mobile
    for share in SHARES:
        seen = whole.until(start_s + share * (end_s - start_s))
        record = seen.loaded_part(CUT_OFF_V)
        found = LeastSquares(path=path).estimate(record)
        row = {"method": PATH.format(life), "share": share, "settled": found.settled_q_mobile}
        row |= {"q_error_percent": 100.0 * (found.q_mobile / q_mobile - 1.0)}
        if share == 1.0:
            yield row
            continue
        model = RecordModel(cell_with(path.cell, found.constants or {}))
        of_path = forecast(record, found, cut_off_V=CUT_OFF_V, model=model, mismatch_V=path.mismatch_V)
        for name, ahead in ((PATH.format(life), of_path), (FILTER, forecast_end(seen, Settings(cut_off_V=CUT_OFF_V)))):
            low_s, median_s, high_s = ahead.eod_quantile_s(BAND)
            said = {"method": name, "share": share, "error_percent": percent * (median_s - end_s)}
            said |= {"width_percent": percent * (high_s - low_s), "covered": float(low_s <= end_s <= high_s)}
            yield row | said if name != FILTER else said
        lasted_s = last.eod_time_s(CUT_OFF_V) - last.load_on_time_s
        yield {"method": LAST, "share": share, "error_percent": percent * (start_s + lasted_s - end_s)}


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One line a cell and method: the mean errors at each share."""
    lines = []
    for (cell, method), group in rows.groupby(["cell", "method"], sort=False):
        ends = group[group["share"] < 1.0].groupby("share")
        line = {
            "cell": cell,
            "method": method,
            "end at 25 / 50 / 75 %: mean error (%)": " / ".join(
                digits(each["error_percent"].abs().mean()) for _, each in ends
            ),
            "worst (%)": " / ".join(digits(each["error_percent"].abs().max()) for _, each in ends),
            "inside 90 % (%)": "",
            "whole: q_max off least squares, mean (worst) (%)": "",
            "settled, whole": "",
        }
        if group["covered"].notna().any():
            line["inside 90 % (%)"] = " / ".join(f"{100.0 * each['covered'].mean():.0f}" for _, each in ends)
        whole = group[group["share"] == 1.0]
        if len(whole):
            q_error = whole["q_error_percent"].abs()
            line["whole: q_max off least squares, mean (worst) (%)"] = f"{digits(q_error.mean())} ({digits(q_error.max())})"
            line["settled, whole"] = f"{whole['settled'].sum()} of {len(whole)}"
        lines.append(line)
    return pd.DataFrame(lines)


def plot(rows: pd.DataFrame) -> Figure:
    """The error of the end in each discharge of each cell, after half of the time."""
    figure, panels = new_panels(len(CELLS), 2, (4.2, 2.8), margin=(0.0, 0.4))
    for axes, (cell, of_cell) in zip(panels, rows[rows["share"] == 0.5].groupby("cell"), strict=True):
        for colour, (method, group) in zip(COLOURS, of_cell.groupby("method", sort=False), strict=False):
            axes.plot(range(len(group)), group["error_percent"], ".-", color=colour, lw=0.8, label=method)
        axes.axhline(0.0, color="black", lw=0.6)
        axes.set(title=cell, xlabel="discharge, from young to old", ylabel="error of the end, half seen (%)")
        axes.legend(frameon=False, fontsize=7)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("aging_paths", __doc__)
    parser.add_argument("--every", type=positive, default=4, help="take one discharge of so many")
    study = Study(parser, arguments)
    parts = [{"judged": cell, "every": study.chosen.every} for cell in CELLS]
    rows = study.run(part, parts)["discharges"]
    study.write({"discharges": rows}, {"ends": plot(rows)}, markdown(summary(rows)))


if __name__ == "__main__":
    main()
