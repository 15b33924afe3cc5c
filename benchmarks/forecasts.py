"""
Forecast the end of discharges in progress, and the end of life of two real cells, and count how often the intervals hold.

.. code-block:: bash

  python -m benchmarks.forecasts --every 12 --simulated 8 --out results/forecasts

*Real cells*: NASA's B0005 and B0006, cut off after 25, 50 and 75 % of the time. Calibrated by the Kalman filter without a
prior, and by least squares with what the discharges before let expect (:func:`battery_env.track_life`). *Simulated cells* with
power that jumps at random, whose constants differ from the model's, with a prior of 2 %: with the load to come known and
unknown. *Life*: what was expected of each discharge, and of the life that remains. Constants of the method were chosen with
B0005 and the simulated cells of seed 0; B0006 and seed 1 were not looked at for it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

from battery_env.cells import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.estimates import Estimate
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.forecasts import BAND, forecast
from battery_env.life import Life, track_life
from battery_env.loads import Load, RandomPiecewise, RandomWalk
from battery_env.plotting import COLOUR_OF, COLOURS, coloured, new_figure
from battery_env.record_model import RecordModel
from battery_env.records import Record, Samples
from battery_env.sensors import SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.study import Study, command_line, markdown, natural, positive

CUT_OFF_V = 2.7
#: Error of the model on the real cells, and on the simulated ones, V.
MISMATCH_V = {"real": 0.05, "simulated": 0.02}
#: Shares of a discharge, in time, after which its end is forecast.
SHARES = (0.25, 0.5, 0.75)
#: Capacity at which the life of these 2 Ah cells ends, Ah.
END_OF_LIFE_Ah = 1.4
#: The simulated cells: relative standard deviation of their constants, noise, the priors they are calibrated
#: with, and the time step, s.
MISMATCH, NOISE_V, PRIOR_SD_SHARE, DT_S = 0.2, 0.005, 0.02, 2.0
#: Seeds of the simulated cells: the first was looked at while the method was made.
SEEDS = (0, 1)
#: The kinds of load of the simulated cells.
LOADS: dict[str, RandomPiecewise | RandomWalk] = {"piecewise": RandomPiecewise(), "random walk": RandomWalk()}


def score(record: Record, estimate: Estimate, start_s: float, end_s: float, **options: Any) -> dict[str, float | bool]:
    """One forecast against what happened."""
    began_s = perf_counter()
    low_s, median_s, high_s = forecast(record, estimate, **options).eod_quantile_s(BAND)
    percent = 100.0 / (end_s - start_s)
    return {
        "error_percent": percent * (median_s - end_s),
        "width_percent": percent * (high_s - low_s),
        "covered": bool(low_s <= end_s <= high_s),
        "below": bool(end_s < low_s),
        "seconds": perf_counter() - began_s,
    }


def real_rows(cell: str, discharges: list[Discharge], life: Life, every: int, samples: int) -> list[dict[str, object]]:
    """The discharges of one cell."""
    mismatch_V = MISMATCH_V["real"]
    options = {"cut_off_V": CUT_OFF_V, "model": RecordModel(thermal=True), "mismatch_V": mismatch_V, "samples": samples}
    rows: list[dict[str, object]] = []
    for n in tqdm(range(1, len(discharges), every), desc=cell, unit="discharge", file=sys.stderr):
        record = discharges[n].loaded_part(CUT_OFF_V)
        start_s, end_s = record.time_s[[0, -1]]
        carried = life.after(n).prior_q_mobile_C
        calibrators = {
            "Kalman filter, no prior": ExtendedKalmanFilter(thermal=True, mismatch_V=mismatch_V, voltage_noise_V=mismatch_V),
            "least squares, prior carried on": LeastSquares(thermal=True, mismatch_V=mismatch_V, prior_q_mobile_C=carried),
        }
        for share in SHARES:
            seen = record.until(start_s + share * (end_s - start_s))
            for name, calibrator in calibrators.items():
                row = {"data": cell, "discharge": n + 1, "share": share, "calibrator": name, "load": "as so far"}
                rows.append(row | score(seen, calibrator.estimate(seen), start_s, end_s, **options))
    return rows


def simulated_rows(kind: str, seed: int, count: int, samples: int) -> list[dict[str, object]]:
    """Simulated discharges under a random load."""
    data = TrajectoryDataset.generate(("q_mobile", "r_o"), count, LOADS[kind], seed=seed, mismatch=MISMATCH, dt_s=DT_S)
    rng = np.random.default_rng(seed)
    model, mismatch_V = RecordModel(dt_s=DT_S), MISMATCH_V["simulated"]
    options = {"cut_off_V": model.cell.VEOD, "model": model, "mismatch_V": mismatch_V, "samples": samples}
    rows: list[dict[str, object]] = []
    for n in tqdm(range(count), desc=f"{kind}, seed {seed}", unit="discharge", file=sys.stderr):
        whole = data[n]
        read = SensorErrors(noise_V=NOISE_V).apply(whole, rng)
        prior_C = whole.q_mobile * (1.0 + PRIOR_SD_SHARE * rng.standard_normal())
        prior = (prior_C, PRIOR_SD_SHARE * prior_C)
        fit = LeastSquares(dt_s=DT_S, mismatch_V=mismatch_V, voltage_noise_V=NOISE_V, prior_q_mobile_C=prior)
        for share in SHARES:
            stop = int(share * whole.eod_time_s / data.dt_s)
            seen = Samples(read.time_s, read.voltage_V, read.current_A).first(stop + 1)
            rest = Load(data.dt_s * np.arange(len(whole.load) - stop, dtype=np.float64), whole.load[stop:], whole.load_unit)
            estimate = fit.estimate(seen)
            for load_name, load in (("known", rest), ("as so far", None)):
                row = {"data": f"{kind}, seed {seed}", "discharge": n, "share": share}
                row |= {"calibrator": "least squares, prior", "load": load_name}
                rows.append(row | score(seen, estimate, 0.0, whole.eod_time_s, load=load, **options))
    return rows


def end_of_discharge_table(rows: pd.DataFrame) -> pd.DataFrame:
    """The summary of all forecasts of discharges."""
    table = []
    keys = ["data", "calibrator", "load", "share"]
    for (data, calibrator, load, _), part in rows.groupby(keys, sort=False):
        error = part["error_percent"].abs()
        table.append(
            {
                "data": data,
                "calibrator": calibrator,
                "load to come": load,
                "seen (%)": f"{100 * part['share'].iloc[0]:.0f}",
                "forecasts": len(part),
                "error, mean / worst (%)": f"{error.mean():.1f} / {error.max():.1f}",
                "width of the 90 % interval, median (%)": f"{part['width_percent'].median():.1f}",
                "inside (%)": f"{100 * part['covered'].mean():.0f}",
                "earlier (%)": f"{100 * part['below'].mean():.0f}",
            }
        )
    return pd.DataFrame(table)


def life_rows(cell: str, life: Life, seed: int = 0) -> list[dict[str, object]]:
    """What was expected of the life that remained."""
    ended = np.flatnonzero(life.table["capacity_Ah"] < END_OF_LIFE_Ah)
    rows: list[dict[str, object]] = []
    for n in range(10, int(ended[0]) + 1 if len(ended) else 0):
        low, median, high = life.after(n).remaining_discharges(END_OF_LIFE_Ah, seed=seed)
        row = {"cell": cell, "seen": n, "share": n / (ended[0] + 1), "remaining": ended[0] + 1 - n}
        rows.append(row | {"low": low, "median": median, "high": high})
    return rows


def life_table(lives: dict[str, Life], remaining: pd.DataFrame) -> pd.DataFrame:
    """The summary over cycles."""
    table = []
    for cell, life in lives.items():
        expected = [life.after(n).prior_q_mobile_C for n in range(1, len(life.table))]
        mean_C, sd_C = np.array(expected).T
        q_C = life.table["q_mobile_C"].to_numpy()[1:]
        error = np.abs(q_C / mean_C - 1.0)
        part = remaining[remaining["cell"] == cell]
        half = part.iloc[(part["share"] - 0.5).abs().argmin()]
        inside = (part["low"] <= part["remaining"]) & (part["remaining"] <= part["high"])
        table.append(
            {
                "cell": cell,
                "step of q_mobile (%)": f"{100 * life.step_share:.2f}",
                "noise (%)": f"{100 * life.noise_share:.2f}",
                "drift (% a discharge)": f"{100 * life.drift_share:.2f}",
                "q_mobile of the next: error, mean / worst (%)": f"{100 * error.mean():.2f} / {100 * error.max():.1f}",
                "inside 90 % (%)": f"{100 * np.mean(np.abs(q_C - mean_C) <= 1.645 * sd_C):.0f}",
                f"discharges to {END_OF_LIFE_Ah:g} Ah, at half of life": f"{half['remaining']:.0f}",
                "forecast, 5 / 50 / 95 %": f"{half['low']:.0f} / {half['median']:.0f} / {half['high']:.0f}",
                "inside 90 % over life (%)": f"{100 * inside.mean():.0f}",
            }
        )
    return pd.DataFrame(table)


def plot(rows: pd.DataFrame, remaining: pd.DataFrame) -> Figure:
    """How often the intervals of the forecasts hold, by method (colours) and data (markers), and the life that remained."""
    figure = new_figure(9.6, 7.2)
    above, below = figure.subplots(2, 2)
    real = rows["data"].isin(BUNDLED_CELLS)
    for axes, title, part in ((above[0], "real cells", rows[real]), (above[1], "simulated cells", rows[~real])):
        for colour, (method, each) in coloured(part.groupby(["calibrator", "load"], sort=False)):
            for marker, (_, by_data) in zip("os^v", each.groupby("data", sort=False), strict=False):
                inside = 100.0 * by_data.groupby("share")["covered"].mean()
                label = method[0] if title == "real cells" else f"load {method[1]}"
                shown = label if marker == "o" else None
                axes.plot(100.0 * inside.index, inside, marker=marker, ms=4, lw=1.1, color=colour, label=shown)
        axes.axhline(100.0 * (BAND[2] - BAND[0]), color="0.4", lw=0.8)
        axes.set(title=title, xlabel="seen of the discharge (%)", ylim=(0.0, 105.0))
        axes.set_ylabel("ends inside the 90 % interval (%)")
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="lower center")
    for axes, (cell, part) in zip(below, remaining.groupby("cell"), strict=False):
        high = part["high"].clip(upper=1e4)  # what is beyond the forecast is infinite
        axes.fill_between(part["seen"], part["low"], high, color=COLOURS[0], alpha=0.25, lw=0, label="90 %")
        axes.plot(part["seen"], part["median"], color=COLOURS[0], lw=1.4, label="median")
        axes.plot(part["seen"], part["remaining"], color=COLOUR_OF["measured"], lw=1.2, label="measured")
        axes.set(title=cell, xlabel="discharges seen", ylabel=f"discharges to {END_OF_LIFE_Ah:g} Ah")
        axes.set_ylim(0.0, 3.0 * part["remaining"].max())
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("forecasts", __doc__, jobs=None)
    parser.add_argument("--cells", nargs="*", default=list(BUNDLED_CELLS), choices=BUNDLED_CELLS)
    parser.add_argument("--every", type=positive, default=12, help="each how many-th real discharge is forecast")
    parser.add_argument("--simulated", type=natural, default=8, help="simulated discharges of each kind and seed")
    parser.add_argument("--samples", type=positive, default=200, help="of each forecast")
    study = Study(parser, arguments)
    chosen = study.chosen
    study.configuration |= {
        "cut_off_V": CUT_OFF_V,
        "mismatch_V": MISMATCH_V,
        "mismatch": MISMATCH,
        "noise_V": NOISE_V,
        "prior_sd_share": PRIOR_SD_SHARE,
        "dt_s": DT_S,
        "end_of_life_Ah": END_OF_LIFE_Ah,
        "data": NASA_CITATION,
    }
    rows, remaining, lives = [], [], {}
    for cell in chosen.cells:
        discharges = load_nasa_discharges(cell)
        lives[cell] = track_life(discharges, CUT_OFF_V)
        remaining += life_rows(cell, lives[cell])
        rows += real_rows(cell, discharges, lives[cell], chosen.every, chosen.samples)
    for kind in LOADS:
        for seed in SEEDS:
            rows += simulated_rows(kind, seed, chosen.simulated, chosen.samples) if chosen.simulated else []
    forecasts, left = pd.DataFrame(rows), pd.DataFrame(remaining)
    text, figures = markdown(end_of_discharge_table(forecasts)), {}
    if len(left):
        text += "\n" + markdown(life_table(lives, left))
        figures = {"forecasts": plot(forecasts, left)}
    study.write({"discharges": forecasts, "life": left}, figures, text, "summary")


if __name__ == "__main__":
    main()
