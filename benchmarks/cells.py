"""
Calibrators on the discharges of two real cells, NASA's B0005 and B0006, whole and in progress.

.. code-block:: bash

  python -m benchmarks.cells real_cells       # with the constants of the new cell, over the lives of both
  python -m benchmarks.cells fit_cell         # with constants that were fitted to three discharges of the other cell
  python -m benchmarks.cells own_cell         # the same: policies that learn on simulations of the fitted cell, beside rivals
  python -m benchmarks.cells mismatch_cells   # the policies that come with battery_env, beside rivals

*Whole*: the voltage between load-on and 2.7 V. *In progress*: its first 25, 50 and 75 % of the time; how far off is the
predicted end of discharge? Nothing is known of the parameters of a tested cell but what the name of a calibrator says.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import NEW_CELL
from battery_env.estimates import Estimate
from battery_env.estimators import CellFit, Estimator, ExtendedKalmanFilter, LeastSquares, fit_cell
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V
from battery_env.loads import recorded
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import COLOUR_OF, COLOURS, LABELS, coloured, new_figure, plot_cell_fit, title_of_life
from battery_env.policies.estimator import PolicyEstimator, Predictor
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.records.model import RecordModel
from battery_env.trajectories import TrajectoryDataset
from benchmarks import pretrained
from benchmarks.calibrators import ENV_ID, SHIPPED, Follow
from benchmarks.study import (
    Cell,
    Study,
    Tables,
    command_line,
    digest_of,
    markdown,
    natural,
    positive,
    run_named,
    share_in_percent,
    table_of,
)
from benchmarks.training import Recipe, train_or_load

CUT_OFF_V = 2.7
#: Shares of a discharge, in time, after which its end is predicted.
SHARES = (0.25, 0.5, 0.75)
#: Which cell is fitted, and which one tests it.
PAIRS = (("B0005", "B0006"), ("B0006", "B0005"))
#: About how far q_mobile moves from one discharge to the next, as a share of it (root mean square, measured here).
PRIOR_SD_SHARE = 0.01
#: Of the simulated cells that policies learn on: how many, and their ages, C and ohm.
N_CELLS, Q_MOBILE_RANGE_C, R_O_RANGE_OHM = 1000, (4000.0, 8000.0), (0.06, 0.3)
#: What rivals with a prior know of ``q_mobile``: mean and standard deviation of that range, C.
PRIOR_C = (sum(Q_MOBILE_RANGE_C) / 2.0, float(np.ptp(Q_MOBILE_RANGE_C) / np.sqrt(12.0)))
#: Options of the task in training: as of the policies for recorded cells, but for the mismatch, which is in the data. With
#: these constants the noise makes the voltage wander by 29 mV, twice the error that the fits leave.
TRAINED_WITH = {name: value for name, value in (pretrained.TRAINED_WITH | pretrained.RECORDED).items() if name != "mismatch"}

_NEW = Estimate(NEW_CELL.q_mobile, NEW_CELL.r_o)
_THERMAL = RecordModel(thermal=True)
_AGES = {"fresh": 0.0, "middle": 0.5, "aged": 1.0}


def estimates(
    discharge: Discharge, calibrator: Estimator, model: RecordModel, shares: Sequence[float] = SHARES
) -> list[dict[str, Any]]:
    """Calibrate to beginnings of a discharge, and predict its end."""
    record = discharge.loaded_part(CUT_OFF_V)
    start_s, end_s = record.time_s[[0, -1]]
    rows = []
    for share in shares:
        seen = record if share == 1.0 else record.until(start_s + share * (end_s - start_s))
        estimate = calibrator.estimate(seen)
        eod_time_s = model.forecast(seen, estimate, CUT_OFF_V).eod_time_s
        rows.append(
            {
                "cycle": discharge.meta["cycle"],
                "capacity_Ah": discharge.meta["capacity_Ah"],
                "share": share,
                "q_mobile_C": estimate.q_mobile,
                "sd_q_mobile_C": estimate.sd_q_mobile,
                "r_o_ohm": estimate.r_o,
                "settled": estimate.settled,
                "eod_error_percent": 100.0 * (eod_time_s - end_s) / (end_s - start_s),
            }
        )
    return rows


def least_squares(prior_q_mobile_C: float | None = None) -> LeastSquares:
    """Least squares with the constants of the new cell."""
    prior = None if prior_q_mobile_C is None else (prior_q_mobile_C, PRIOR_SD_SHARE * prior_q_mobile_C)
    return LeastSquares(thermal=True, mismatch_V=UNFITTED_MISMATCH_V, prior_q_mobile_C=prior)


def _filter(**options: Any) -> ExtendedKalmanFilter:
    # told what a fit expects, 13 to 15 mV, it loses discharges in their first quarter
    return ExtendedKalmanFilter(mismatch_V=UNFITTED_MISMATCH_V, **options)


# over the lives of both cells


def fit_whole(discharge: Discharge) -> dict[str, Any]:
    """Calibrate to one whole discharge."""
    record = discharge.loaded_part(CUT_OFF_V)
    estimate = least_squares().estimate(record)
    row = {name: discharge.meta[name] for name in ("cell", "cycle", "start_time", "capacity_Ah", "Re_ohm", "Rct_ohm")}
    row |= {
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "r_o_ohm": estimate.r_o,
        "sd_r_o_ohm": estimate.sd_r_o,
        "settled": estimate.settled,
        "duration_s": record.time_s[-1] - record.time_s[0],
    }
    for prefix, parameters in (("", estimate), ("new_cell_", _NEW)):
        forecast = _THERMAL.forecast(record, parameters, CUT_OFF_V)
        residual_V = forecast.at_samples_V - record.voltage_V
        row[f"{prefix}voltage_rmse_V"] = float(np.sqrt(np.nanmean(residual_V**2)))
        row[f"{prefix}eod_error_s"] = forecast.eod_time_s - record.time_s[-1]
    return row


def life_part(cell: str) -> Tables:
    """Whole discharges of a cell, and those in progress without and with the previous one as a prior."""
    whole, in_progress = [], []
    previous_C = None
    for discharge in load_nasa_discharges(cell):
        whole.append(fit_whole(discharge))
        if previous_C is not None:
            methods = {
                "least squares alone": least_squares(),
                "Kalman filter alone": _filter(thermal=True),
                "with prior": least_squares(previous_C),
            }
            for share in SHARES:
                for method, calibrator in methods.items():
                    (found,) = estimates(discharge, calibrator, _THERMAL, [share])
                    in_progress.append({"cell": cell, "method": method, **found})
        previous_C = whole[-1]["q_mobile_C"]
    columns = ["cell", "cycle", "share", "method", "q_mobile_C", "sd_q_mobile_C", "settled", "eod_error_percent"]
    return {"discharges": pd.DataFrame(whole), "in_progress": pd.DataFrame(in_progress, columns=columns)}


def whole_table(whole: pd.DataFrame) -> pd.DataFrame:
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
    return table_of(shown, ["cell"], cells)


def progress_table(progress: pd.DataFrame, whole: pd.DataFrame) -> pd.DataFrame:
    """The summary of discharges in progress."""
    known = progress.merge(whole[["cell", "cycle", "q_mobile_C"]], on=["cell", "cycle"], suffixes=("", "_whole"))
    known = known.sort_values(["cell", "share", "method"], kind="stable")
    shown = known.assign(
        seen=known["share"].map(lambda share: f"{100 * share:.0f}"),
        error=known["eod_error_percent"].abs(),
        sd_percent=100 * known["sd_q_mobile_C"] / known["q_mobile_C"],
        within=(known["q_mobile_C"] - known["q_mobile_C_whole"]).abs() <= 2.0 * known["sd_q_mobile_C"],
    )
    cells: dict[str, Cell] = {
        "mean abs error of EOD (%)": ("error", lambda errors: f"{errors.mean():.1f}"),
        "worst (%)": ("error", lambda errors: f"{errors.max():.1f}"),
        "stated sd of q_mobile (%)": ("sd_percent", lambda percent: f"{percent.median():.1f}"),
        "q_mobile within 2 sd (%)": ("within", share_in_percent),
        "settled (%)": ("settled", share_in_percent),
    }
    return table_of(shown, {"cell": "cell", "seen": "seen (%)", "method": "method"}, cells)


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
            symbol = LABELS[name].split(" (")[0]
            axes.fill_between(part["cycle"], value - sd, value + sd, color=fitted, alpha=0.15, lw=0, label="± 1 sd, common")
            axes.plot(part["cycle"], value, color=fitted, lw=1.6, label=f"{symbol}, least squares")
            axes.grid(alpha=0.25)
        upper.plot(part["cycle"], part["capacity_Ah"], ".", ms=3.5, color=measured, label="capacity to 2.7 V, measured")
        impedance_mohm = 1e3 * (part["Re_ohm"] + part["Rct_ohm"])
        lower.plot(part["cycle"], impedance_mohm, ".", ms=3.5, color=measured, label="$R_e + R_{ct}$, impedance tests")
        upper.set_title(f"{cell}\n{title_of_life([part])}", fontsize=10)
        lower.set_xlabel("cycle")
        upper.legend(frameon=False, loc="upper right", fontsize=9)
        lower.legend(frameon=False, loc="upper left", fontsize=9)
    # room for the legend
    panels[1, 0].set(ylim=(None, 1.2e3 * (whole["r_o_ohm"] + whole["sd_r_o_ohm"]).max()), ylabel=r"resistance (m$\Omega$)")
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
                (Estimate(fit["q_mobile_C"], fit["r_o_ohm"]), "-", COLOUR_OF["least squares"], "model, fitted"),
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
    shown = [whole_table(whole), progress_table(progress, whole), repetition_table(whole)]
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


def fitted_row(discharge: Discharge, calibrator: LeastSquares) -> dict[str, Any]:
    """Calibrate to one discharge and to its beginnings, in one row."""
    record = discharge.loaded_part(CUT_OFF_V)
    whole, *beginnings = estimates(discharge, calibrator, calibrator.model, (1.0, *SHARES))
    residual_V = calibrator.model.voltage(record, Estimate(whole["q_mobile_C"], whole["r_o_ohm"])) - record.voltage_V
    row = {name: whole[name] for name in ("cycle", "capacity_Ah", "q_mobile_C", "r_o_ohm")}
    row |= {"voltage_rmse_V": float(np.sqrt(np.nanmean(residual_V**2))), "settled": whole["settled"]}
    for found in beginnings:
        percent = f"at_{100 * found['share']:.0f}_percent"
        row[f"eod_error_percent_{percent}"] = found["eod_error_percent"]
        row[f"within_2_sd_{percent}"] = abs(found["q_mobile_C"] - whole["q_mobile_C"]) <= 2.0 * found["sd_q_mobile_C"]
        row[f"settled_{percent}"] = found["settled"]
    return row


def fit_part(trained: str, tested: str, every: int) -> Tables:
    """Fit one cell, and test the constants on the other."""
    fit = fitted_to(trained)
    calibrators = {"of the new cell": least_squares(), f"fitted to {trained}": fit.calibrator()}
    rows = [
        {"cell": tested, "constants": constants, **fitted_row(discharge, calibrator)}
        for discharge in load_nasa_discharges(tested)[::every]
        for constants, calibrator in calibrators.items()
    ]
    constants = pd.DataFrame(fit.constants).assign(identified=[each.identified for each in fit.constants], fitted_to=trained)
    return {"discharges": pd.DataFrame(rows), "constants": constants}


def fit_table(scores: pd.DataFrame) -> pd.DataFrame:
    """The table for readers."""

    def errors_of(error_percent: pd.Series) -> str:
        return f"{error_percent.abs().mean():.1f} / {error_percent.abs().max():.0f}"

    def rmse_of(rmse_V: pd.Series) -> str:
        return f"{1e3 * rmse_V.median():.0f} / {1e3 * rmse_V.max():.0f}"

    cells: dict[str, Cell] = {"voltage RMSE, median / max (mV)": ("voltage_rmse_V", rmse_of)}
    for percent in (f"{100 * share:.0f}" for share in SHARES):
        cells[f"EOD at {percent} %: mean / worst error (%)"] = (f"eod_error_percent_at_{percent}_percent", errors_of)
        cells[f"settled at {percent} % (%)"] = (f"settled_at_{percent}_percent", share_in_percent)
        cells[f"q within 2 sd at {percent} % (%)"] = (f"within_2_sd_at_{percent}_percent", share_in_percent)
    cells["whole: settled (%)"] = ("settled", share_in_percent)
    cells["corr(q_mobile, capacity)"] = lambda part: f"{part['q_mobile_C'].corr(part['capacity_Ah']):.4f}"
    return table_of(scores, {"cell": "tested on", "constants": "constants"}, cells)


def fit_of_another(arguments: Sequence[str]) -> None:
    """Test constants that were fitted to the other cell."""
    parser = command_line("cells fit_cell", "Fit constants to three discharges of one cell, and test them on the other one.")
    _add_every(parser)
    study = _study(parser, arguments, fitted_to="first, middle and last discharge of the other cell")
    pairs = [{"trained": trained, "tested": tested, "every": study.chosen.every} for trained, tested in PAIRS]
    tables = study.run(fit_part, pairs)
    text, figures = [markdown(fit_table(tables["discharges"]))], dict[str, Figure]()
    for trained, tested in PAIRS:
        fit = fitted_to(trained)  # seconds: once more, for what is no table
        text.append(f"Fitted to {trained}:\n\n```\n{fit.summary()}\n```\n")
        figures[f"{trained}_on_{tested}"] = plot_cell_fit(fit, _three_of(tested))
    study.write(tables, figures, "\n".join(text), "summary")


# calibrators side by side


def simulated(fit: CellFit, cell: str, folder: Path) -> Path:
    """The discharges that policies learn on, unless the file is there."""
    made_from = {
        "cell": asdict(fit.cell),
        "q": Q_MOBILE_RANGE_C,
        "r": R_O_RANGE_OHM,
        "mismatch": pretrained.MISMATCH,
        "n": N_CELLS,
    }
    file = folder / f"{cell}_{digest_of(made_from)}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        loads = [recorded(discharge.loaded_part(CUT_OFF_V), "power", 1.0) for discharge in load_nasa_discharges(cell)]
        ranges: dict[str, Any] = {"q_mobile_range": Q_MOBILE_RANGE_C, "r_o_range": R_O_RANGE_OHM}
        data = TrajectoryDataset.generate(
            PARAMETER_NAMES, N_CELLS, loads, 0, **ranges, cell=fit.cell, mismatch=pretrained.MISMATCH
        )
        with suppress(FileExistsError):  # of another part, which has made the same
            data.save(file)
    return file


class Together:
    """Several policies as one: the mean of their actions. None at all leave both parameters to the fit that they would see."""

    def __init__(self, policies: Sequence[Predictor]) -> None:
        self.policies = policies

    def predict(self, observation: FloatArray, /, *, deterministic: bool = False) -> tuple[FloatArray, None]:
        """The mean action."""
        if not self.policies:
            return np.zeros((len(observation), len(PARAMETER_NAMES))), None
        actions = [policy.predict(observation, deterministic=deterministic)[0] for policy in self.policies]
        return np.mean(actions, axis=0), None


#: Calibrators without learning, by name, with fitted constants.
CLASSICAL: dict[str, Callable[[CellFit], Estimator]] = {
    "least squares": lambda fit: fit.calibrator(),
    "least squares, prior": lambda fit: fit.calibrator(prior_q_mobile_C=PRIOR_C),
    "Kalman filter": lambda fit: _filter(cell=fit.cell, thermal=fit.thermal),
    "Kalman filter, prior": lambda fit: _filter(cell=fit.cell, thermal=fit.thermal, prior_q_mobile_C=PRIOR_C),
    "the fit that policies see": lambda fit: PolicyEstimator(Follow(), ENV_ID, cell=fit.cell, **pretrained.OPTIONS),
}

#: By name, calibrators with the constants of the new cell.
NEW_CELLS: dict[str, Callable[[], Estimator]] = {
    **{who.name: partial(who.make, PARAMETER_NAMES, None) for who in SHIPPED},
    "least squares": least_squares,
    "Kalman filter": lambda: _filter(thermal=True),
}


def trained(algo: str, seed: int, updates: int, dataset: Path, folder: Path) -> Predictor:
    """A policy for a cell, trained unless that has been done."""
    chosen = {"env_kwargs": {**TRAINED_WITH, "dataset": str(dataset)}}
    return train_or_load(Recipe.of(algo, ENV_ID, seed, updates=updates, hyperparameters=chosen), folder)


def scored(cell: str, every: int, calibrator: Estimator, model: RecordModel) -> pd.DataFrame:
    """Let a calibrator estimate the discharges of a cell, in progress and whole."""
    discharges = load_nasa_discharges(cell)[::every]
    rows = [row for discharge in discharges for row in estimates(discharge, calibrator, model, (*SHARES, 1.0))]
    return pd.DataFrame(rows)


def own_part(calibrator: str, seeds: list[int], updates: int, fitted: str, tested: str, every: int, folder: Path) -> Tables:
    """Test one calibrator with the constants of a fitted cell on the other one."""
    fit = fitted_to(fitted)
    if calibrator in CLASSICAL:
        estimator = CLASSICAL[calibrator](fit)
    else:
        dataset = simulated(fit, fitted, folder / "data")
        policies = [trained(calibrator.lower(), seed, updates, dataset, folder / "models") for seed in seeds]
        policy = policies[0] if len(seeds) == 1 else Together(policies)
        estimator = PolicyEstimator(policy, ENV_ID, cell=fit.cell, **pretrained.OPTIONS)
    found = scored(tested, every, estimator, RecordModel(fit.cell, fit.thermal))
    found.insert(0, "fitted", fitted)
    found.insert(1, "tested", tested)
    found.insert(2, "calibrator", calibrator if len(seeds) < 2 else f"{calibrator}, {len(seeds)} together")
    found.insert(3, "seed", seeds[0] if len(seeds) == 1 else None)
    return {"own_cell": found.drop(columns="sd_q_mobile_C")}


def new_part(calibrator: str, cell: str, every: int, policy: str) -> Tables:
    """Test one calibrator with the constants of the new cell."""
    estimator = NEW_CELLS[calibrator]()
    found = scored(cell, every, estimator, RecordModel(thermal=not isinstance(estimator, PolicyEstimator)))
    found.insert(0, "calibrator", calibrator)
    found.insert(1, "cell", cell)
    return {"mismatch_cells": found.drop(columns="sd_q_mobile_C").assign(policy=policy)}


def with_departure(found: pd.DataFrame) -> pd.DataFrame:
    """
    How far each estimate of ``q_mobile`` is from that of least squares for the whole discharge, which stand for the truth.
    """
    key = ["tested", "cycle"]
    whole = found[(found["calibrator"] == "least squares") & (found["share"] == 1.0)]
    truth = whole.set_index(key)["q_mobile_C"].rename("expected_C")
    joined = found.join(truth, on=key)
    return joined.assign(departure_percent=100.0 * (joined["q_mobile_C"] / joined["expected_C"] - 1.0))


def _over_seeds(rows: pd.DataFrame, column: str, decimals: int) -> str:
    # mean over discharges: of each seed side by side, and the worst of all
    means = rows[column].abs().groupby(rows["seed"].fillna(-1)).mean()
    return f"{' / '.join(f'{mean:.{decimals}f}' for mean in means)} ({rows[column].abs().max():.{decimals - 1}f})"


def departure_table(found: pd.DataFrame) -> pd.DataFrame:
    """The table for readers."""
    rows = []
    for (tested, calibrator), of_both in with_departure(found).groupby(["tested", "calibrator"], sort=False):
        whole = of_both[of_both["share"] == 1.0]
        mean_C = whole.groupby("cycle")[["q_mobile_C", "capacity_Ah"]].mean()
        row = {
            "tested on": tested,
            "calibrator": calibrator,
            "q_max of whole discharges, departure: mean (worst) (%)": _over_seeds(whole, "departure_percent", 2),
            "corr(q_max, capacity)": f"{mean_C['q_mobile_C'].corr(mean_C['capacity_Ah']):.4f}",
        }
        for share in SHARES:
            at_share = of_both[of_both["share"] == share]
            row[f"end at {100 * share:.0f} %: mean (worst) (%)"] = _over_seeds(at_share, "eod_error_percent", 1)
        rows.append(row)
    return pd.DataFrame(rows)


def plot_departures(found: pd.DataFrame) -> Figure:
    """
    How far ``q_mobile`` of whole discharges is from that of least squares over the life of a cell, and how far off the end of
    discharge is that is predicted on the way.
    """
    names = [name for name in found["calibrator"].unique() if "together" not in name and not name.startswith("the fit")]
    colours = {family: colour for colour, family in coloured(dict.fromkeys(name.partition(",")[0] for name in names))}
    figure = new_figure(10.4, 6.6)
    panels = figure.subplots(2, found["tested"].nunique(), sharey="row", squeeze=False)
    for (upper, lower), (tested, of_cell) in zip(panels.T, with_departure(found).groupby("tested", sort=False), strict=True):
        for name in names:
            family = name.partition(",")[0]
            of_name, colour = of_cell[of_cell["calibrator"] == name], colours[family]
            style = "-" if name == family else "--"
            whole = of_name[of_name["share"] == 1.0].groupby("cycle")["departure_percent"].mean()
            upper.plot(whole.index, whole, ls=style, lw=1.2, color=colour)
            in_progress = of_name[of_name["share"] < 1.0]
            errors = in_progress["eod_error_percent"].abs().groupby(in_progress["share"]).mean()
            lower.plot(100.0 * errors.index, errors, "o", ls=style, color=colour, label=name)
        title = f"{tested}, with the constants of {of_cell['fitted'].iloc[0]}"
        upper.set(title=title, xlabel="cycle", ylabel=f"{LABELS['q_mobile'].split(' (')[0]}, from least squares (%)")
        lower.set(yscale="log", xlabel="seen of the discharge (%)", ylabel="mean error of its end (%)", xticks=(25, 50, 75))
        for axes in (upper, lower):
            axes.grid(alpha=0.25)
    figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize=8)
    return figure


def own_cell(arguments: Sequence[str]) -> None:
    """Compare calibrators that have the constants of the other cell."""
    parser = command_line("cells own_cell", "Policies that learn on simulations of a fitted cell, on the other one.")
    parser.add_argument("--algos", nargs="+", choices=("lac", "sac", "td3"), default=["lac", "sac", "td3"])
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2])
    parser.add_argument("--updates", type=positive, default=5000, help="gradient steps of each training")
    _add_every(parser)
    study = _study(parser, arguments, trained_with=TRAINED_WITH, prior_C=PRIOR_C)
    chosen = study.chosen
    for fitted, _ in PAIRS:
        simulated(fitted_to(fitted), fitted, study.out / "data")  # here, as parts that make the same file meet
    pairs = [{"fitted": fitted, "tested": tested, "every": chosen.every} for fitted, tested in PAIRS]
    alone = [{"calibrator": algo.upper(), "seeds": [seed]} for seed in chosen.seeds for algo in chosen.algos]
    together = [{"calibrator": algo.upper(), "seeds": chosen.seeds} for algo in chosen.algos if len(chosen.seeds) > 1]
    tables = []
    # policies act together when each is trained
    for who in ([{"calibrator": name, "seeds": []} for name in CLASSICAL], alone, together):
        parts = [{**one, "updates": chosen.updates, **pair} for pair in pairs for one in who]
        tables += [study.run(own_part, parts, folder=study.out)] if parts else []
    found = pd.concat([table["own_cell"] for table in tables], ignore_index=True)
    found = found.sort_values("tested", kind="stable", ignore_index=True)
    study.write({"own_cell": found}, {"own_cell": plot_departures(found)}, markdown(departure_table(found)))


def mismatch_cells(arguments: Sequence[str]) -> None:
    """Compare calibrators that have the constants of the new cell."""
    parser = command_line("cells mismatch_cells", "The policies that come with battery_env, beside rivals.", jobs=1)
    parser.add_argument("--cells", nargs="+", choices=BUNDLED_CELLS, default=list(BUNDLED_CELLS))
    _add_every(parser, default=8)
    study = _study(parser, arguments)
    policies = {who.name: who.policy for who in SHIPPED}
    parts = [
        {"calibrator": name, "cell": cell, "every": study.chosen.every, "policy": policies.get(name, "")}
        for cell in study.chosen.cells
        for name in NEW_CELLS
    ]
    tables = study.run(new_part, parts)
    found = tables["mismatch_cells"].rename(columns={"cell": "tested"}).assign(seed=None)
    study.write(tables, {}, markdown(departure_table(found)))


def _add_every(parser: argparse.ArgumentParser, default: int = 1) -> None:
    parser.add_argument("--every", type=positive, default=default, help="test on every k-th discharge (default: %(default)s)")


def _study(parser: argparse.ArgumentParser, arguments: Sequence[str], **configuration: Any) -> Study:
    study = Study(parser, arguments)
    common = {"cut_off_V": CUT_OFF_V, "mismatch_V": UNFITTED_MISMATCH_V, "thermal": True, "data": NASA_CITATION}
    study.configuration |= {**common, **configuration}
    return study


STUDIES = {"real_cells": real_cells, "fit_cell": fit_of_another, "own_cell": own_cell, "mismatch_cells": mismatch_cells}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    run_named("cells", __doc__, STUDIES, arguments)


if __name__ == "__main__":
    main()
