"""
Calibrators on the discharges of two real cells, NASA's B0005 and B0006, whole and in progress.

.. code-block:: bash

  python -m benchmarks.cells real_cells       # with the constants of the new cell, over the lives of both
  python -m benchmarks.cells fit_cell         # with constants that were fitted to three discharges of the other cell

*Whole*: the voltage between load-on and 2.7 V. *In progress*: its first 25 to 98 % of the time; how far off is the predicted
end of discharge, how far are q_max and R_o from those of the whole discharge, and is that settled? Nothing is known of the
parameters of a tested cell but what the name of a calibrator says.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import norm, spearmanr

from battery_env.electrochemistry import NEW_CELL
from battery_env.estimates import Estimate
from battery_env.estimators import CellFit, Estimator, LeastSquares, fit_cell
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V
from battery_env.lab.settings import Settings
from battery_env.parameters import PARAMETERS
from battery_env.plotting import COLOUR_OF, COLOURS, new_figure, plot_cell_fit
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.records.model import RecordModel
from benchmarks.study import (
    Cell,
    Study,
    Tables,
    command_line,
    digits,
    markdown,
    positive,
    run_named,
    share_in_percent,
    table_of,
)

CUT_OFF_V = 2.7
#: Shares of a discharge, in time, after which its end is predicted.
SHARES = (0.25, 0.5, 0.75, 0.9, 0.95, 0.98)
#: Which cell is fitted, and which one tests it.
PAIRS = (("B0005", "B0006"), ("B0006", "B0005"))
#: About how far q_mobile moves from one discharge to the next, as a share of it (root mean square, measured here).
PRIOR_SD_SHARE = 0.01

_NEW = Estimate(NEW_CELL.q_mobile, NEW_CELL.r_o)
_THERMAL = RecordModel(thermal=True)
_AGES = {"fresh": 0.0, "middle": 0.5, "aged": 1.0}


def whole_row(discharge: Discharge, calibrator: LeastSquares) -> dict[str, Any]:
    """Calibrate to one whole discharge."""
    record = discharge.loaded_part(CUT_OFF_V)
    estimate = calibrator.estimate(record)
    row = {name: discharge.meta[name] for name in ("cell", "cycle", "start_time", "capacity_Ah", "Re_ohm", "Rct_ohm")}
    row |= {
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "r_o_ohm": estimate.r_o,
        "sd_r_o_ohm": estimate.sd_r_o,
        "settled": estimate.settled,
        "duration_s": record.time_s[-1] - record.time_s[0],
    }
    for prefix, model, parameters in (("", calibrator.model, estimate), ("new_cell_", _THERMAL, _NEW)):
        forecast = model.forecast(record, parameters, CUT_OFF_V)
        residual_V = forecast.at_samples_V - record.voltage_V
        row[f"{prefix}voltage_rmse_V"] = float(np.sqrt(np.nanmean(residual_V**2)))
        row[f"{prefix}eod_error_s"] = forecast.eod_time_s - record.time_s[-1]
    return row


def rows_in_progress(
    discharge: Discharge, calibrators: Mapping[str, Estimator], model: RecordModel, whole: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Calibrate to beginnings of a discharge, predict its end, and name what it says as a whole."""
    record = discharge.loaded_part(CUT_OFF_V)
    rows = []
    for share, (method, calibrator) in product(SHARES, calibrators.items()):
        seen = record.until(record.time_s[0] + share * whole["duration_s"])
        estimate = calibrator.estimate(seen)
        eod_time_s = model.forecast(seen, estimate, CUT_OFF_V).eod_time_s
        rows.append(
            {
                "cell": discharge.meta["cell"],
                "cycle": discharge.meta["cycle"],
                "share": share,
                "method": method,
                "q_mobile_C": estimate.q_mobile,
                "sd_q_mobile_C": estimate.sd_q_mobile,
                "q_mobile_of_whole_C": whole["q_mobile_C"],
                "r_o_ohm": estimate.r_o,
                "sd_r_o_ohm": estimate.sd_r_o,
                "r_o_of_whole_ohm": whole["r_o_ohm"],
                "settled": estimate.settled,
                "eod_error_percent": 100.0 * (eod_time_s - record.time_s[-1]) / whole["duration_s"],
            }
        )
    return rows


def progress_table(progress: pd.DataFrame) -> pd.DataFrame:
    """The summary of discharges in progress; what is settled is judged by the whole discharge."""
    shown = progress.sort_values(["cell", "share", "method"], kind="stable")
    shown = shown.assign(
        seen=shown["share"].map(lambda share: f"{100 * share:.0f}"),
        error=shown["eod_error_percent"].abs(),
        sd_percent=100 * shown["sd_q_mobile_C"] / shown["q_mobile_C"],
    )

    def both(said: Callable[[pd.Series, pd.Series, pd.Series], str]) -> Callable[[pd.DataFrame], str]:
        names = (("q_mobile", "C"), ("r_o", "ohm"))
        columns = [[f"{name}_{unit}", f"sd_{name}_{unit}", f"{name}_of_whole_{unit}"] for name, unit in names]
        return lambda part: " / ".join(said(*(part[column] for column in of_one)) for of_one in columns)

    def inside(value: pd.Series, sd: pd.Series, of_whole: pd.Series) -> str:
        return share_in_percent((value - of_whole).abs() <= norm.ppf(0.95) * sd)

    def farthest(value: pd.Series, sd: pd.Series, of_whole: pd.Series) -> str:
        return digits(100 * (value / of_whole - 1.0).abs().max())

    cells: dict[str, Cell] = {
        "mean abs error of EOD (%)": ("error", lambda errors: f"{errors.mean():.1f}"),
        "worst (%)": ("error", lambda errors: f"{errors.max():.1f}"),
        "stated sd of q_mobile (%)": ("sd_percent", lambda percent: f"{percent.median():.1f}"),
        "q_mobile / r_o inside 90 % (%)": both(inside),
        "settled (%)": ("settled", share_in_percent),
        "of these q_mobile / r_o off at most (%)": lambda part: both(farthest)(part[part["settled"]]),
    }
    return table_of(shown, {"cell": "cell", "seen": "seen (%)", "method": "method"}, cells)


def least_squares(prior_q_mobile_C: float | None = None, is_size_known: bool = False) -> LeastSquares:
    """Least squares with the constants of the new cell, and what ``calibrate`` expects of a cell in progress of its size."""
    prior = None if prior_q_mobile_C is None else (prior_q_mobile_C, PRIOR_SD_SHARE * prior_q_mobile_C)
    settings = Settings(prior_q_mobile_C=prior)
    calibrator = settings.calibrator(size=settings.size if is_size_known else None)
    assert isinstance(calibrator, LeastSquares)
    return calibrator


# over the lives of both cells


def life_part(cell: str) -> Tables:
    """Whole discharges of a cell, and those in progress without and with the previous one as a prior."""
    whole, in_progress = [], []
    previous_C = None
    for discharge in load_nasa_discharges(cell):
        whole.append(whole_row(discharge, least_squares()))
        if previous_C is not None:
            methods = {
                "least squares alone": least_squares(),
                "size known": least_squares(is_size_known=True),
                "with prior": least_squares(previous_C),
            }
            in_progress += rows_in_progress(discharge, methods, _THERMAL, whole[-1])
        previous_C = whole[-1]["q_mobile_C"]
    return {"discharges": pd.DataFrame(whole), "in_progress": pd.DataFrame(in_progress)}


def whole_table(whole: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """The summary of whole discharges."""
    shown = whole.assign(
        error_s=whole["eod_error_s"].abs(),
        error_percent=100 * whole["eod_error_s"].abs() / whole["duration_s"],
        rmse_mV=1e3 * whole["voltage_rmse_V"],
        ratio=whole["q_mobile_C"] / (3600.0 * whole["capacity_Ah"]),
    )
    cells: dict[str, Cell] = {
        "discharges": len,
        "voltage RMSE, median / max (mV)": ("rmse_mV", lambda mV: f"{mV.median():.0f} / {mV.max():.0f}"),
        "mean abs error of EOD (s)": ("error_s", lambda errors: f"{errors.mean():.1f}"),
        "(%)": ("error_percent", lambda errors: f"{errors.mean():.2f}"),
        "q_mobile, first -> last (C)": ("q_mobile_C", lambda C: f"{C.iloc[0]:.0f} -> {C.iloc[-1]:.0f}"),
        "q_mobile / (3600 capacity)": ("ratio", lambda ratio: f"{ratio.min():.3f} .. {ratio.max():.3f}"),
        "corr(q_mobile, capacity)": lambda part: f"{part['q_mobile_C'].corr(part['capacity_Ah']):.4f}",
        "r_o, first -> last (ohm)": ("r_o_ohm", lambda ohm: f"{ohm.iloc[0]:.3f} -> {ohm.iloc[-1]:.3f}"),
        "Spearman(cycle, r_o)": lambda part: f"{spearmanr(part['cycle'], part['r_o_ohm'])[0]:.3f}",
        "settled (%)": ("settled", share_in_percent),
        "new cell's parameters: RMSE, median (mV)": ("new_cell_voltage_rmse_V", lambda V: f"{1e3 * V.median():.0f}"),
        "and error of EOD, first / last (s)": ("new_cell_eod_error_s", lambda s: f"{s.iloc[0]:+.0f} / {s.iloc[-1]:+.0f}"),
    }
    return table_of(shown, by, cells)


def repetition_table(whole: pd.DataFrame) -> pd.DataFrame:
    """How much a discharge is like the one before: what a prior can rest on, and what it has to compete with."""

    def steps(q_mobile_C: pd.Series) -> str:
        move = 100.0 * q_mobile_C.pct_change()
        return f"{np.sqrt((move**2).mean()):.1f} / {move.abs().max():.1f}"

    def late(duration_s: pd.Series) -> str:
        percent = 100.0 * (duration_s.shift() / duration_s - 1.0).abs()
        return f"{percent.mean():.1f} / {percent.max():.1f}"

    cells: dict[str, Cell] = {
        "step of q_mobile, rms / most (%)": ("q_mobile_C", steps),
        "EOD after as long as the previous one: mean / worst error (%)": ("duration_s", late),
    }
    return table_of(whole, ["cell"], cells)


def plot_life(whole: pd.DataFrame) -> Figure:
    """Both parameters over the life of each cell, with what was measured."""
    cells = list(dict.fromkeys(whole["cell"]))
    figure = new_figure(4.2 * len(cells), 5.4)
    panels = figure.subplots(2, len(cells), sharex=True, sharey="row", squeeze=False)
    fitted, measured = COLOUR_OF["least squares"], COLOUR_OF["measured"]
    for cell, (upper, lower) in zip(cells, panels.T, strict=True):
        part = whole[whole["cell"] == cell]
        for axes, name, unit, scale in ((upper, "q_mobile", "C", 1.0 / 3600.0), (lower, "r_o", "ohm", 1e3)):
            value, sd = scale * part[f"{name}_{unit}"], scale * part[f"sd_{name}_{unit}"]
            symbol = PARAMETERS[name].symbol
            axes.fill_between(part["cycle"], value - sd, value + sd, color=fitted, alpha=0.15, lw=0, label="± 1 sd, common")
            axes.plot(part["cycle"], value, color=fitted, lw=1.6, label=f"{symbol}, least squares")
            axes.grid(alpha=0.25)
        upper.plot(part["cycle"], part["capacity_Ah"], ".", ms=3.5, color=measured, label="capacity to 2.7 V, measured")
        impedance_mohm = 1e3 * (part["Re_ohm"] + part["Rct_ohm"])
        lower.plot(part["cycle"], impedance_mohm, ".", ms=3.5, color=measured, label="$R_e + R_{ct}$, impedance tests")
        upper.set_title(cell, fontsize=10)
        lower.set_xlabel("cycle")
        upper.legend(frameon=False, loc="upper right", fontsize=9)
        lower.legend(frameon=False, loc="upper left", fontsize=9)
    # room for the legend
    panels[1, 0].set(ylim=(None, 1.3e3 * (whole["Re_ohm"] + whole["Rct_ohm"]).max()), ylabel=r"resistance (m$\Omega$)")
    panels[0, 0].set_ylabel("charge (Ah)")
    figure.align_ylabels(panels[:, 0])
    return figure


def plot_voltages(discharges: Mapping[str, Sequence[Discharge]], whole: pd.DataFrame) -> Figure:
    """A fresh, a middle and an aged discharge of each cell, with the fitted and the new cell's model."""
    figure = new_figure(9.6, 2.5 * len(discharges) + 0.6)
    panels = figure.subplots(len(discharges), len(_AGES), sharex=True, sharey=True, squeeze=False)
    for row, (cell, records) in zip(panels, discharges.items(), strict=True):
        fits = whole[whole["cell"] == cell]
        for axes, (age, position) in zip(row, _AGES.items(), strict=True):
            n = round(position * (len(records) - 1))
            record, fit = records[n].loaded_part(CUT_OFF_V), fits.iloc[n]
            start_s = record.time_s[0]
            since_s = record.time_s - start_s
            axes.plot(since_s, record.voltage_V, "o", ms=2.6, color=COLOUR_OF["measured"], label="measured")
            for estimate, style, colour, label in (
                (least_squares().estimate(record), "-", COLOUR_OF["least squares"], "model, fitted"),
                (_NEW, "--", COLOURS[4], "model, new cell's parameters"),
            ):
                forecast = _THERMAL.forecast(record, estimate, CUT_OFF_V)
                axes.plot(forecast.time_s - start_s, forecast.voltage_V, style, color=colour, lw=1.5, label=label)
            axes.set_title(f"{cell}, {age} (discharge {fit['cycle']}): RMSE {1e3 * fit['voltage_rmse_V']:.0f} mV", fontsize=9)
            axes.grid(alpha=0.25)
        row[0].set_ylabel("voltage (V)")
    for axes in panels[-1]:
        axes.set_xlabel("time since load-on (s)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def real_cells(arguments: Sequence[str]) -> None:
    """Calibrate to every discharge of both cells."""
    parser = command_line("cells real_cells", "Calibrate to every discharge of real cells, with the new cell's constants.")
    parser.add_argument("--cells", nargs="+", default=list(BUNDLED_CELLS), choices=BUNDLED_CELLS)
    study = _study(parser, arguments, prior_sd_share=PRIOR_SD_SHARE)
    cells = study.chosen.cells
    tables = study.run(life_part, [{"cell": cell} for cell in cells])
    whole, progress = tables["discharges"], tables["in_progress"]
    voltages = plot_voltages({cell: load_nasa_discharges(cell) for cell in cells}, whole)
    shown = [whole_table(whole, ["cell"]), progress_table(progress), repetition_table(whole)]
    text = "\n".join(markdown(table) for table in shown)
    study.write(tables, {"life": plot_life(whole), "voltages": voltages}, text, "summary")


# with constants that were fitted to another cell


def _three_of(cell: str) -> list[Discharge]:
    discharges = load_nasa_discharges(cell)
    return [discharges[0], discharges[len(discharges) // 2], discharges[-1]]


@cache
def fitted_to(cell: str) -> CellFit:
    """The constants that are tested, fitted to the first, the middle and the last discharge of a cell."""
    return fit_cell(_three_of(cell), CUT_OFF_V)


def fit_part(trained: str, tested: str, every: int) -> Tables:
    """Fit one cell, and test the constants on the other."""
    fit = fitted_to(trained)
    whole, in_progress = [], []
    for discharge in load_nasa_discharges(tested)[::every]:
        for method, calibrator in {"of the new cell": least_squares(), f"fitted to {trained}": fit.calibrator()}.items():
            whole.append({"method": method, **whole_row(discharge, calibrator)})
            in_progress += rows_in_progress(discharge, {method: calibrator}, calibrator.model, whole[-1])
    constants = pd.DataFrame(fit.constants).assign(identified=[each.identified for each in fit.constants], fitted_to=trained)
    return {"discharges": pd.DataFrame(whole), "in_progress": pd.DataFrame(in_progress), "constants": constants}


def fit_of_another(arguments: Sequence[str]) -> None:
    """Test constants that were fitted to the other cell."""
    parser = command_line("cells fit_cell", "Fit constants to three discharges of one cell, and test them on the other one.")
    parser.add_argument("--every", type=positive, default=1, help="test on every k-th discharge (default: %(default)s)")
    study = _study(parser, arguments, fitted_to="first, middle and last discharge of the other cell")
    pairs = [{"trained": trained, "tested": tested, "every": study.chosen.every} for trained, tested in PAIRS]
    tables = study.run(fit_part, pairs)
    tests = [whole_table(tables["discharges"], ["cell", "method"]), progress_table(tables["in_progress"])]
    text, figures = [markdown(table) for table in tests], dict[str, Figure]()
    for trained, tested in PAIRS:
        fit = fitted_to(trained)  # seconds: once more, for what is no table
        text.append(f"Fitted to {trained}:\n\n```\n{fit.summary()}\n```\n")
        figures[f"{trained}_on_{tested}"] = plot_cell_fit(fit, _three_of(tested))
    study.write(tables, figures, "\n".join(text), "summary")


def _study(parser: argparse.ArgumentParser, arguments: Sequence[str], **configuration: Any) -> Study:
    study = Study(parser, arguments)
    common = {"cut_off_V": CUT_OFF_V, "mismatch_V": UNFITTED_MISMATCH_V, "thermal": True, "data": NASA_CITATION}
    study.configuration |= {**common, **configuration}
    return study


STUDIES = {"real_cells": real_cells, "fit_cell": fit_of_another}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    run_named("cells", __doc__, STUDIES, arguments)


if __name__ == "__main__":
    main()
