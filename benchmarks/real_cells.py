"""
Calibrate the model to every discharge of two real cells, NASA's B0005 and B0006, over their lives.

.. code-block:: bash

  python -m benchmarks.real_cells --cells B0005 B0006 --out results/real_cells

Two experiments. *Whole discharges*: (q_mobile, r_o) from the voltage between load-on and 2.7 V, against the measured capacity
and the measured end of discharge. *Discharges in progress*: the same from the first 25, 50 and 75 % only, with and without
the q_mobile of the previous discharge as a prior, and by the Kalman filter; how far off is the predicted end of discharge?
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import spearmanr
from tqdm import tqdm

from battery_env.cells import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL
from battery_env.estimates import Estimate
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.plotting import COLOURS, LABELS, new_figure
from battery_env.record_model import RecordModel
from benchmarks.study import Study, Tables, command_line, markdown

CUT_OFF_V = 2.7
#: Error of the model on these cells, V (the residuals of whole discharges, measured here).
MISMATCH_V = 0.05
#: Shares of a discharge, in time, after which its end is predicted.
SHARES = (0.25, 0.5, 0.75)
#: About how far q_mobile moves from one discharge to the next, as a share of it (root mean square, measured here).
PRIOR_SD_SHARE = 0.01

_NEW = Estimate(NEW_CELL.q_mobile, NEW_CELL.r_o)
_MODEL = RecordModel(thermal=True)
_AGES = {"fresh": 0.0, "middle": 0.5, "aged": 1.0}


def calibrator(prior_q_mobile_C: float | None = None) -> LeastSquares:
    """Least squares as used here."""
    prior = None if prior_q_mobile_C is None else (prior_q_mobile_C, PRIOR_SD_SHARE * prior_q_mobile_C)
    return LeastSquares(thermal=True, mismatch_V=MISMATCH_V, prior_q_mobile_C=prior)


def fit_whole(discharge: Discharge) -> dict[str, float | str | bool]:
    """Calibrate to one whole discharge."""
    record = discharge.loaded_part(CUT_OFF_V)
    duration_s = record.time_s[-1] - record.time_s[0]
    estimate = calibrator().estimate(record)
    row = {name: discharge.meta[name] for name in ("cell", "cycle", "start_time", "capacity_Ah", "Re_ohm", "Rct_ohm")}
    row |= {
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "r_o_ohm": estimate.r_o,
        "sd_r_o_ohm": estimate.sd_r_o,
        "settled": estimate.settled,
        "duration_s": duration_s,
    }
    for prefix, parameters in (("", estimate), ("new_cell_", _NEW)):
        forecast = _MODEL.forecast(record, parameters, CUT_OFF_V)
        residual_V = forecast.at_samples_V - record.voltage_V
        row[f"{prefix}voltage_rmse_V"] = float(np.sqrt(np.nanmean(residual_V**2)))
        row[f"{prefix}eod_error_s"] = forecast.eod_time_s - record.time_s[-1]
    return row


def fit_in_progress(discharge: Discharge, previous_q_mobile_C: float) -> list[dict[str, float | str | bool]]:
    """Calibrate to the beginnings of one discharge, without and with a prior."""
    record = discharge.loaded_part(CUT_OFF_V)
    start_s, end_s = record.time_s[[0, -1]]
    rows = []
    for share in SHARES:
        beginning = record.until(start_s + share * (end_s - start_s))
        for method, fit in (
            ("least squares alone", calibrator()),
            ("Kalman filter alone", ExtendedKalmanFilter(thermal=True, mismatch_V=MISMATCH_V)),
            ("with prior", calibrator(previous_q_mobile_C)),
        ):
            estimate = fit.estimate(beginning)
            eod_time_s = _MODEL.forecast(beginning, estimate, CUT_OFF_V).eod_time_s
            row = {"cell": discharge.meta["cell"], "cycle": discharge.meta["cycle"], "share": share, "method": method}
            row |= {"q_mobile_C": estimate.q_mobile, "sd_q_mobile_C": estimate.sd_q_mobile, "settled": estimate.settled}
            rows.append(row | {"eod_error_percent": 100.0 * (eod_time_s - end_s) / (end_s - start_s)})
    return rows


def part(cell: str) -> Tables:
    """Both experiments with one cell."""
    whole, in_progress = [], []
    previous_q_mobile_C = None
    for discharge in tqdm(load_nasa_discharges(cell), desc=cell, unit="discharge", file=sys.stderr):
        whole.append(fit_whole(discharge))
        if previous_q_mobile_C is not None:
            in_progress += fit_in_progress(discharge, previous_q_mobile_C)
        previous_q_mobile_C = float(whole[-1]["q_mobile_C"])
    return {"discharges": pd.DataFrame(whole), "in_progress": pd.DataFrame(in_progress)}


def whole_table(whole: pd.DataFrame) -> pd.DataFrame:
    """The summary of the first experiment."""
    rows = []
    for cell, part in whole.groupby("cell"):
        first, last = part.iloc[0], part.iloc[-1]
        ratio = part["q_mobile_C"] / (3600.0 * part["capacity_Ah"])
        error_s, rmse_mV = part["eod_error_s"].abs(), 1e3 * part["voltage_rmse_V"]
        new_rmse_mV, new_error_s = 1e3 * part["new_cell_voltage_rmse_V"], part["new_cell_eod_error_s"]
        rows.append(
            {
                "cell": cell,
                "discharges": len(part),
                "voltage RMSE, median / max (mV)": f"{rmse_mV.median():.0f} / {rmse_mV.max():.0f}",
                "mean abs error of EOD (s)": f"{error_s.mean():.1f}",
                "(%)": f"{100 * (error_s / part['duration_s']).mean():.2f}",
                "q_mobile, first -> last (C)": f"{first['q_mobile_C']:.0f} -> {last['q_mobile_C']:.0f}",
                "q_mobile / (3600 capacity)": f"{ratio.min():.3f} .. {ratio.max():.3f}",
                "corr(q_mobile, capacity)": f"{part['q_mobile_C'].corr(part['capacity_Ah']):.4f}",
                "r_o, first -> last (ohm)": f"{first['r_o_ohm']:.3f} -> {last['r_o_ohm']:.3f}",
                "Spearman(cycle, r_o)": f"{spearmanr(part['cycle'], part['r_o_ohm'])[0]:.3f}",
                "settled (%)": f"{100 * part['settled'].mean():.0f}",
                "new cell's parameters: RMSE, median (mV)": f"{new_rmse_mV.median():.0f}",
                "and error of EOD, first / last (s)": f"{new_error_s.iloc[0]:+.0f} / {new_error_s.iloc[-1]:+.0f}",
            }
        )
    return pd.DataFrame(rows)


def progress_table(progress: pd.DataFrame, whole: pd.DataFrame) -> pd.DataFrame:
    """The summary of the second experiment."""
    known = progress.merge(whole[["cell", "cycle", "q_mobile_C"]], on=["cell", "cycle"], suffixes=("", "_whole"))
    rows = []
    for (cell, _, method), part in known.groupby(["cell", "share", "method"]):
        error = part["eod_error_percent"].abs()
        misses = (part["q_mobile_C"] - part["q_mobile_C_whole"]).abs()
        rows.append(
            {
                "cell": cell,
                "seen (%)": f"{100 * part['share'].iloc[0]:.0f}",
                "method": method,
                "mean abs error of EOD (%)": f"{error.mean():.1f}",
                "worst (%)": f"{error.max():.1f}",
                "stated sd of q_mobile (%)": f"{100 * (part['sd_q_mobile_C'] / part['q_mobile_C']).median():.1f}",
                "q_mobile within 2 sd (%)": f"{100 * (misses <= 2.0 * part['sd_q_mobile_C']).mean():.0f}",
                "settled (%)": f"{100 * part['settled'].mean():.0f}",
            }
        )
    return pd.DataFrame(rows)


def repetition_table(whole: pd.DataFrame) -> pd.DataFrame:
    """How much a discharge is like the one before: what a prior can rest on, and what it has to compete with."""
    rows = []
    for cell, part in whole.groupby("cell"):
        move = 100.0 * part["q_mobile_C"].pct_change()
        late = 100.0 * (part["duration_s"].shift() / part["duration_s"] - 1.0).abs()
        rows.append(
            {
                "cell": cell,
                "step of q_mobile, rms / most (%)": f"{np.sqrt((move**2).mean()):.1f} / {move.abs().max():.1f}",
                "EOD after as long as the previous one: mean / worst error (%)": f"{late.mean():.1f} / {late.max():.1f}",
            }
        )
    return pd.DataFrame(rows)


def plot_life(whole: pd.DataFrame) -> Figure:
    """Both parameters over the life of each cell, with what was measured."""
    cells = list(dict.fromkeys(whole["cell"]))
    figure = new_figure(4.2 * len(cells), 5.4)
    panels = figure.subplots(2, len(cells), sharex=True, sharey="row", squeeze=False)
    q_limits_C = (0.93 * whole["q_mobile_C"].min(), 1.05 * whole["q_mobile_C"].max())
    c_per_Ah = float((whole["q_mobile_C"] / whole["capacity_Ah"]).median())
    for column, cell in enumerate(cells):
        part = whole[whole["cell"] == cell]
        upper, lower = panels[:, column]
        for axes, name, unit in ((upper, "q_mobile", "C"), (lower, "r_o", "ohm")):
            value, sd = part[f"{name}_{unit}"], part[f"sd_{name}_{unit}"]
            axes.fill_between(part["cycle"], value - sd, value + sd, color=COLOURS[0], alpha=0.2, lw=0)
            axes.plot(part["cycle"], value, color=COLOURS[0], lw=1.6, label=f"{LABELS[name].split(' (')[0]}, fitted, ± 1 sd")
            axes.grid(alpha=0.25)
        capacity = upper.twinx()
        capacity.plot(part["cycle"], part["capacity_Ah"], ".", ms=3.5, color=COLOURS[1])
        upper.plot([], [], ".", ms=5, color=COLOURS[1], label="capacity, measured")
        upper.set_ylim(*q_limits_C)
        capacity.set_ylim(*(limit / c_per_Ah for limit in q_limits_C))
        capacity.tick_params(axis="y", colors=COLOURS[1], labelright=column == len(cells) - 1)
        if column == len(cells) - 1:
            capacity.set_ylabel("capacity to 2.7 V (Ah)", color=COLOURS[1])
        lower.plot(
            part["cycle"],
            part["Re_ohm"] + part["Rct_ohm"],
            ".",
            ms=3.5,
            color=COLOURS[1],
            label="$R_e + R_{ct}$, impedance tests",
        )
        upper.set_title(cell)
        lower.set_xlabel("discharge")
        upper.legend(frameon=False, loc="upper right", fontsize=9)
        lower.legend(frameon=False, loc="upper left", fontsize=9)
    panels[1, 0].set_ylim(
        0.9 * (whole["r_o_ohm"] - whole["sd_r_o_ohm"]).min(), 1.2 * (whole["r_o_ohm"] + whole["sd_r_o_ohm"]).max()
    )
    panels[0, 0].set_ylabel(LABELS["q_mobile"])
    panels[1, 0].set_ylabel(LABELS["r_o"])
    figure.align_ylabels(panels[:, 0])
    return figure


def plot_voltages(discharges: dict[str, list[Discharge]], whole: pd.DataFrame) -> Figure:
    """A fresh, a middle and an aged discharge of each cell, with the fitted and the new cell's model."""
    figure = new_figure(9.6, 2.5 * len(discharges) + 0.6)
    panels = figure.subplots(len(discharges), len(_AGES), sharex=True, sharey=True, squeeze=False)
    for row, (cell, records) in zip(panels, discharges.items(), strict=True):
        fits = whole[whole["cell"] == cell]
        for axes, (age, position) in zip(row, _AGES.items(), strict=True):
            n = round(position * (len(records) - 1))
            record, fit = records[n].loaded_part(CUT_OFF_V), fits.iloc[n]
            start_s = record.time_s[0]
            axes.plot(record.time_s - start_s, record.voltage_V, "o", ms=2.6, color="0.5", label="measured")
            for estimate, style, colour, label in (
                (Estimate(fit["q_mobile_C"], fit["r_o_ohm"]), "-", COLOURS[0], "model, fitted"),
                (_NEW, "--", COLOURS[1], "model, new cell's parameters"),
            ):
                forecast = _MODEL.forecast(record, estimate, CUT_OFF_V)
                axes.plot(forecast.time_s - start_s, forecast.voltage_V, style, color=colour, lw=1.5, label=label)
            axes.set_title(f"{cell}, {age} (discharge {fit['cycle']}): RMSE {1e3 * fit['voltage_rmse_V']:.0f} mV", fontsize=9)
            axes.grid(alpha=0.25)
    for axes in panels[-1]:
        axes.set_xlabel("time since load-on (s)")
    for axes in panels[:, 0]:
        axes.set_ylabel("voltage (V)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("real_cells", __doc__)
    parser.add_argument("--cells", nargs="+", default=list(BUNDLED_CELLS), choices=BUNDLED_CELLS)
    study = Study(parser, arguments)
    study.configuration |= {
        "cut_off_V": CUT_OFF_V,
        "mismatch_V": MISMATCH_V,
        "prior_sd_share": PRIOR_SD_SHARE,
        "thermal": True,
        "data": NASA_CITATION,
    }
    cells = study.chosen.cells
    tables = study.run(part, [{"cell": cell} for cell in cells])
    whole, progress = tables["discharges"], tables["in_progress"]
    figures = {
        "life": plot_life(whole),
        "voltages": plot_voltages({cell: load_nasa_discharges(cell) for cell in cells}, whole),
    }
    shown = [whole_table(whole), progress_table(progress, whole), repetition_table(whole)]
    study.write(tables, figures, "\n".join(markdown(table) for table in shown), "summary")


if __name__ == "__main__":
    main()
