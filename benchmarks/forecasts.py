"""
Forecast the end of discharges in progress beside what needs no model, and the end of life of two real cells.

.. code-block:: bash

  python -m benchmarks.forecasts --every 8 --simulated 12 --out results/forecasts

*Unchanged load*: NASA's B0005 and B0006 at 2 A, cut off after 25, 50 and 75 % of the time. *Changing loads*: simulated cells
with the constants that :func:`battery_env.fit_cell` finds of B0005 (seed 0) and of B0006 (seed 1), four of them off by another
20 %, which the model does not know: it has those of a new 18650. Eight discharges at 2 A are their life; the ninth has a load
that changes. Voltages have 5 mV of noise, and the current sensor a gain of 0.5 %. The load to come is known, but for two rows;
of these the one without a life is what the command says of a file alone. Beside them constants are fitted to the last three
discharges of the life.
*Life*: what was expected of each discharge, and of the life that remains. Constants of the method were chosen with B0005 and
seed 0; B0006 and seed 1 were not looked at for it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from tqdm import tqdm

from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, simulate
from battery_env.electrochemistry.ends import BAND
from battery_env.estimators import CellFit, fit_cell
from battery_env.lab.life import Life, track_life
from battery_env.lab.running import forecast_end
from battery_env.lab.settings import Settings
from battery_env.loads import Load, RandomPiecewise, RandomWalk, constant
from battery_env.records import Record, drawn_charge_C, integrate_load
from battery_env.records.discharge import BUNDLED_CELLS, NASA_CITATION, Discharge, load_nasa_discharges
from benchmarks.study import Cell, Study, command_line, markdown, natural, positive, table_of

CUT_OFF_V = 2.7
#: Shares of a discharge, in time, after which its end is forecast.
SHARES = (0.25, 0.5, 0.75)
#: Of each forecast.
SAMPLES = 200
#: Capacity at which the life of these 2 Ah cells ends, Ah.
END_OF_LIFE_Ah = 1.4
#: Of the simulated cells: relative standard deviation of constants, noise, gain of the current sensor, discharges before, and
#: mean and standard deviation of the step of ln q_mobile from one to the next, as ``track_life`` finds them of B0005.
MISMATCH, NOISE_V, GAIN_SD, BEFORE, STEP = 0.2, 0.005, 0.005, 8, (-0.002, 0.007)
#: The cell that simulated ones resemble, by seed.
SEEDS = {0: "B0005", 1: "B0006"}
#: Discharges of it that are fitted.
FITTED = (0, 83, 167)
#: So many of the last discharges of a life are fitted.
FITTED_LAST = 3

FORECAST, UNKNOWN_LOAD = "forecast, life known", "the same, load unknown"
OWN_FIT = "forecast, life known and fitted"
OF_SIZE = "forecast, nominal capacity and load known"
NO_LIFE, NOTHING = "forecast, nothing but the load known", "forecast, nothing known"
_LONGEST_S = 20_000.0
#: Without prior knowledge of the cell, and with its nominal capacity.
NEW, NOMINAL = Settings(cut_off_V=CUT_OFF_V), Settings(cut_off_V=CUT_OFF_V, nominal_Ah=2.0)


def step_load(rng: np.random.Generator) -> Load:
    """A load with a plan: 1 A for most of the time, then 4 A."""
    return Load(np.array([0.0, rng.uniform(1500.0, 3000.0)]), np.array([1.0, 4.0]), "current")


#: The loads of the simulated cells.
LOADS: dict[str, Callable[[np.random.Generator], Load]] = {
    "piecewise, 0.5 to 4 A": RandomPiecewise((0.5, 4.0), unit="current"),
    "random walk, 0.5 to 4 A": RandomWalk((0.5, 4.0), 1.0, unit="current"),
    "1 A, then 4 A": step_load,
}


def as_long_as_the_last(last: Record, seen: Record, load: Load) -> float:
    """It ends when the last discharge did."""
    return float(seen.time_s[0] + last.time_s[-1] - last.time_s[0])


def coulomb_count(last: Record, seen: Record, load: Load) -> float:
    """It ends when the charge of the last one was drawn."""
    left_C = drawn_charge_C(last) - drawn_charge_C(seen)
    since_s = np.arange(_LONGEST_S)
    return float(seen.time_s[-1] + np.interp(max(float(left_C), 0.0), load.drawn(since_s), since_s))


def last_curve(last: Record, seen: Record, load: Load) -> float:
    """It ends as the voltage over charge of the last one does, with the resistance that fits best."""
    charge_C, seen_C = (integrate_load(each.time_s, each.current_A, each.time_s) for each in (last, seen))
    usual_A = charge_C[-1] / (last.time_s[-1] - last.time_s[0])
    # beyond its end the curve falls on
    end_C, end_V = charge_C[-1], last.voltage_V[-1]
    slope_V = 0.5 * end_C * (end_V - last.voltage_V[-5]) / (end_C - charge_C[-5])
    curve_C, curve_V = np.append(charge_C, 1.5 * end_C), np.append(last.voltage_V, end_V + slope_V)
    more_A = (seen.current_A - usual_A)[1:]
    lower_V = np.interp(seen_C[1:], curve_C, curve_V) - seen.voltage_V[1:]
    # at the load of the last one a resistance says nothing
    resistance_ohm = max(float(lower_V @ more_A) / float(more_A @ more_A + 4e-4 * len(more_A)), 0.0)
    since_s = np.arange(_LONGEST_S)
    expected_V = np.interp(seen_C[-1] + load.drawn(since_s), curve_C, curve_V)
    expected_V -= resistance_ohm * (load(since_s) - usual_A)
    return float(seen.time_s[-1] + np.argmax(expected_V <= CUT_OFF_V))


#: What needs no model.
BASELINES: dict[str, Callable[[Record, Record, Load], float]] = {
    "as long as the last": as_long_as_the_last,
    "Coulomb count, last capacity": coulomb_count,
    "last curve, R fitted": last_curve,
}


#: What a forecast may know beside the load: settings, and the life of the cell.
Known = tuple[Settings, Life | None]


def ends(
    last: Record, running: Discharge, knows: Mapping[str, Known], load_after: Callable[[float], Load], end_s: float
) -> Iterator[dict[str, object]]:
    """What every method says of a discharge, at each share of it."""
    start_s = running.load_on_time_s
    percent = 100.0 / (end_s - start_s)
    for share in SHARES:
        seen = running.until(start_s + share * (end_s - start_s))
        record = seen.loaded_part(CUT_OFF_V)
        load = load_after(float(record.time_s[-1]))
        for name, baseline in BASELINES.items():
            yield {"method": name, "share": share, "error_percent": percent * (baseline(last, record, load) - end_s)}
        asked: list[tuple[str, Known, Load | None]] = [(name, known, load) for name, known in knows.items()]
        asked += [(UNKNOWN_LOAD, knows[FORECAST], None), (NOTHING, knows[NO_LIFE], None)]
        for name, (settings, life), to_come in asked:
            low_s, median_s, high_s = forecast_end(seen, settings, to_come, SAMPLES, life).eod_quantile_s(BAND)
            yield {
                "method": name,
                "share": share,
                "error_percent": percent * (median_s - end_s),
                "width_percent": percent * (high_s - low_s),
                "covered": float(low_s <= end_s <= high_s),
            }


def _held(load: Load, now_s: float) -> Load:
    return load


def real_rows(cell: str, discharges: list[Discharge], life: Life, every: int) -> list[dict[str, object]]:
    """The discharges of one real cell."""
    rows: list[dict[str, object]] = []
    for n in tqdm(range(1, len(discharges), every), desc=cell, unit="discharge", file=sys.stderr):
        running, last = discharges[n], discharges[n - 1].loaded_part(CUT_OFF_V)
        load = constant(float(running.loaded_part(CUT_OFF_V).current_A[-1]), "current")
        knows: dict[str, Known] = {FORECAST: (NEW, life.after(n)), OF_SIZE: (NOMINAL, None), NO_LIFE: (NEW, None)}
        said = ends(last, running, knows, partial(_held, load), running.eod_time_s(CUT_OFF_V))
        rows += [{"data": cell, "load": "2 A", "discharge": n + 1} | row for row in said]
    return rows


def simulated_rows(kind: str, seed: int, fit: CellFit, count: int) -> list[dict[str, object]]:
    """Simulated cells, each with a life at 2 A and a discharge under another load."""
    rng = np.random.default_rng([seed, list(LOADS).index(kind)])
    rows: list[dict[str, object]] = []
    for n in tqdm(range(count), desc=f"{kind}, seed {seed}", unit="cell", file=sys.stderr):
        load, gain = LOADS[kind](rng), 1.0 + GAIN_SD * rng.standard_normal()
        spread = np.exp(MISMATCH * rng.standard_normal(len(UNCERTAIN_CONSTANTS)))
        cell = fit.cell.replace(
            **{name: factor * getattr(fit.cell, name) for name, factor in zip(UNCERTAIN_CONSTANTS, spread, strict=True)}
        )
        age, (young, *_, old) = rng.uniform(), fit.discharges
        q_mobile = np.exp(np.interp(age, [0.0, 1.0], np.log([young.q_mobile, old.q_mobile])))
        r_o = float(np.interp(age, [0.0, 1.0], [young.r_o, old.r_o]))
        levels = q_mobile * np.exp(np.cumsum(STEP[0] + STEP[1] * rng.standard_normal(BEFORE + 1)))
        records, true_end_s = [], 0.0
        for level, each in zip(levels, [*[constant(2.0, "current")] * BEFORE, load], strict=True):
            whole = simulate(each, float(level), r_o, load_unit="current", thermal=True, cell=cell, cut_off_V=CUT_OFF_V - 0.1)
            noise_V, true_end_s = NOISE_V * rng.standard_normal(len(whole.time_s)), whole.reached_s(CUT_OFF_V)
            records.append(Discharge(whole.time_s, whole.voltage_V + noise_V, gain * whole.current_A, starts_at_rest=True))
        *before, running = records
        own = fit_cell(before[-FITTED_LAST:], CUT_OFF_V)
        knows: dict[str, Known] = {
            FORECAST: (NEW, track_life(before, CUT_OFF_V)),
            OF_SIZE: (NOMINAL, None),
            NO_LIFE: (NEW, None),
            OWN_FIT: (Settings(cell=own), track_life(before, CUT_OFF_V, own.calibrator())),
        }

        def rest_of(now_s: float, whole: Load = load) -> Load:
            later = whole.start_s > now_s
            values = np.append(whole(np.array([now_s])), whole.value[later])
            return Load(np.append(0.0, whole.start_s[later] - now_s), values, "current")

        said = ends(before[-1].loaded_part(CUT_OFF_V), running, knows, rest_of, true_end_s)
        rows += [{"data": f"like {SEEDS[seed]}, seed {seed}", "load": kind, "discharge": n} | row for row in said]
    return rows


def end_of_discharge_table(rows: pd.DataFrame) -> pd.DataFrame:
    """The summary of all forecasts of discharges."""
    rows = rows.assign(error=rows["error_percent"].abs(), inside=100.0 * rows["covered"])

    def at_shares(column: str, how: str, decimals: int) -> Callable[[pd.DataFrame], str]:
        def said(part: pd.DataFrame) -> str:
            values = part.groupby("share")[column].agg(how)
            return "" if values.isna().any() else " / ".join(f"{value:.{decimals}f}" for value in values)

        return said

    cells: dict[str, Cell] = {
        "mean error at 25 / 50 / 75 % (%)": at_shares("error", "mean", 1),
        "worst (%)": at_shares("error", "max", 0),
        "inside 90 % (%)": at_shares("inside", "mean", 0),
        "width (%)": ("width_percent", lambda widths: "" if widths.isna().any() else f"{widths.median():.1f}"),
        "forecasts": len,
    }
    return table_of(rows, ["load", "data", "method"], cells)


def life_rows(cell: str, life: Life) -> list[dict[str, object]]:
    """What was expected of the life that remained."""
    ended = np.flatnonzero(life.table["capacity_Ah"] < END_OF_LIFE_Ah)
    rows: list[dict[str, object]] = []
    for n in range(10, int(ended[0]) + 1 if len(ended) else 0):
        low, median, high = life.after(n).remaining_discharges(END_OF_LIFE_Ah)
        row = {"cell": cell, "seen": n, "share": n / (ended[0] + 1), "remaining": ended[0] + 1 - n}
        rows.append(row | {"low": low, "median": median, "high": high})
    return rows


def life_table(lives: dict[str, Life], remaining: pd.DataFrame) -> pd.DataFrame:
    """The summary over cycles."""
    table = []
    for cell, life in lives.items():
        expected = [life.after(n).next_q_mobile_C for n in range(1, len(life.table))]
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


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("forecasts", __doc__, jobs=None)
    parser.add_argument("--cells", nargs="*", default=list(BUNDLED_CELLS), choices=BUNDLED_CELLS)
    parser.add_argument("--every", type=positive, default=8, help="each how many-th real discharge is forecast")
    parser.add_argument("--simulated", type=natural, default=12, help="simulated cells of each kind of load and seed")
    study = Study(parser, arguments)
    chosen = study.chosen
    study.configuration |= {
        "cut_off_V": CUT_OFF_V,
        "samples": SAMPLES,
        "mismatch": MISMATCH,
        "noise_V": NOISE_V,
        "current_gain_sd": GAIN_SD,
        "discharges_before": BEFORE,
        "step": STEP,
        "seeds": SEEDS,
        "end_of_life_Ah": END_OF_LIFE_Ah,
        "data": NASA_CITATION,
    }
    rows, remaining, lives = [], [], {}
    for cell in chosen.cells:
        discharges = load_nasa_discharges(cell)
        lives[cell] = track_life(discharges, CUT_OFF_V)
        remaining += life_rows(cell, lives[cell])
        rows += real_rows(cell, discharges, lives[cell], chosen.every)
    for seed, cell in SEEDS.items() if chosen.simulated else ():
        discharges = load_nasa_discharges(cell)
        fit = fit_cell([discharges[n] for n in FITTED], CUT_OFF_V)
        for kind in LOADS:
            rows += simulated_rows(kind, seed, fit, chosen.simulated)
    forecasts, left = pd.DataFrame(rows), pd.DataFrame(remaining)
    text = markdown(end_of_discharge_table(forecasts))
    if len(left):
        text += "\n" + markdown(life_table(lives, left))
    study.write({"discharges": forecasts, "life": left}, {}, text, "summary")


if __name__ == "__main__":
    main()
