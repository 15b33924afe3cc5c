"""
How far the ageing of one recorded cell tells of another one: the path of a life as the prior of least squares and of policies
that learned on cells along it, on discharges of the cell whose life it is not, whole and in progress. Beside them a plain
filter with that prior, the command with none, a regression that has the capacities of the life for labels, and who knows the
cell's own life.

.. code-block:: bash

  python -m benchmarks.aging_paths --every 4 --algos lac sac published_lac --export

With ``--export`` LAC learns along the paths of both cells, too, and its seeds become one file with its card, as it is shipped
from ``battery_env/policies/pretrained_policies``.

Settings of the paths were chosen with the path of B0006 on B0005; that of B0005 on B0006 is the test. Policies learn on
simulated cells of the path, from the error of the simulated state; no recorded discharge is among their training data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env import (
    AgingPath,
    Estimate,
    LeastSquares,
    PolicyEstimator,
    TrajectoryDataset,
    fit_life,
    forecast,
    load_nasa_discharges,
)
from battery_env.arrays import FloatArray
from battery_env.electrochemistry.aging_path import PATH_NAMES, cell_with
from battery_env.electrochemistry.ends import BAND
from battery_env.estimates import last_estimate
from battery_env.lab.life import Life, track_life
from battery_env.lab.running import forecast_end
from battery_env.lab.settings import Settings
from battery_env.loads import Load, RandomLoad, RandomPiecewise, constant
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import coloured
from battery_env.policies.policy_estimator import Predictor
from battery_env.policies.pretrained import file_stem, write_card
from battery_env.records import integrate_load
from battery_env.records.discharge import BUNDLED_CELLS, Discharge
from battery_env.records.model import RecordModel
from benchmarks.kalman_filter import PlainKalmanFilter
from benchmarks.runs import Run, control_networks, made_by, train_or_load
from benchmarks.study import (
    Cell,
    Study,
    Tables,
    command_line,
    count_of,
    digits,
    markdown,
    natural,
    new_panels,
    positive,
    table_of,
    versions,
)
from benchmarks.zoo_runs import zoo_run
from sb3_lac.onnx import export_onnx

CUT_OFF_V = 2.7
SHARES = (0.25, 0.5, 0.75, 1.0)
CELLS = {"B0005": "B0006", "B0006": "B0005"}
ENV_ID = "BatteryVoltageJoint-v0"
PATH, NOTHING_KNOWN, LAST = "least squares, path of {}", "what the command says, nothing known", "as long as the last"
OWN_LIFE, BOTH, KALMAN = "own life so far", "own life so far, path of {}", "Kalman filter, path of {}"
LABELLED, FIT = "regression on the labels of {}", "the fit that policies see, path of {}"
LABELS = {"lac": "LAC", "sac": "SAC", "published_lac": "LAC as published"}
#: How policies see a discharge along a path: readings that lie 2 to 20 s apart in the mean.
OPTIONS: dict[str, Any] = {"reading_s": (2.0, 20.0)}
#: What they learn with: sensors as good as a tester's, and a model whose voltage wanders by 7 mV.
TRAINED_WITH: dict[str, Any] = {
    "cost": "state",
    "new_readings": (0, 29),
    "noise_V": (0.0002, 0.010),
    "process_noise_V": 0.0003,
}
#: How many cells policies learn on, and with how many updates: few, as they begin with what the fit says.
TRAINING_CELLS, UPDATES = 700, 2500
# What the filter takes for the error of a model with the mean constants of a path, V: chosen on B0005.
_MEAN_CELL_MISMATCH_V = 0.02
# A regression knows so many steps of the voltage, and how much it is held back: chosen on B0005. It knows steps and not
# voltages, as the level of the voltage is another one in each cell.
_STEPS, _RIDGE = 16, 0.001


class Loads(RandomLoad):
    """Three of five discharges are at a constant current of 1 to 3 A, the others at one that changes again and again."""

    def __call__(self, rng: np.random.Generator) -> Load:
        """Draw one load."""
        if rng.random() < 0.6:
            return constant(float(np.exp(rng.uniform(0.0, np.log(3.0)))), "current")
        return RandomPiecewise((0.5, 3.0), unit="current")(rng)


class MeanPolicy:
    """Several policies as one: the mean of their actions. None at all leave both parameters to the fit that they would see."""

    def __init__(self, policies: Sequence[Predictor]) -> None:
        self.policies = policies

    def predict(self, observation: FloatArray, /, *, deterministic: bool = False) -> tuple[FloatArray, None]:
        """The mean action."""
        if not self.policies:
            return np.zeros((len(observation), len(PARAMETER_NAMES))), None
        actions = [policy.predict(observation, deterministic=deterministic)[0] for policy in self.policies]
        return np.mean(actions, axis=0), None


def path_of(cells: Sequence[str], folder: Path) -> tuple[AgingPath, Path]:
    """The path of some lives, and its file."""
    file = folder / f"path_{'_'.join(cells)}.json"
    if not file.exists():
        with suppress(FileExistsError):  # another process has been faster
            fit_life([load_nasa_discharges(cell) for cell in cells]).to_json(file)
    return AgingPath.from_json(file), file


def run_of(algo: str, cells: Sequence[str], seed: int, folder: Path) -> Run:
    """Training of a policy along the path of some lives."""
    path, file = path_of(cells, folder)
    data = file.with_name(file.name.replace("path_", "cells_")).with_suffix(".npz")
    if not data.exists():
        with suppress(FileExistsError):
            TrajectoryDataset.along(path, TRAINING_CELLS, Loads(), seed=0).save(data)
    options = {**OPTIONS, **TRAINED_WITH, "path": str(file), "dataset": str(data)}
    own = {"env_kwargs": options, "policy_kwargs": control_networks(4 if algo == "lac" else None)}
    return zoo_run(algo, ENV_ID, seed, updates=UPDATES, differing=own)


def train(algo: str, lives: Sequence[str], seed: int, folder: Path) -> None:
    """Train one policy, unless that has been done."""
    train_or_load(run_of(algo, lives, seed, folder), folder / "models")


def part(judged: str, every: int, folder: Path, method: str | None = None, **policies: Any) -> Tables:
    """The discharges of a cell by a method that learned along the path of the other one, or by all that need no training."""
    if method is not None:
        return learned(judged, every, method, folder=folder, **policies)
    life = CELLS[judged]
    (path, own_path), discharges = (path_of([cell], folder)[0] for cell in (life, judged)), load_nasa_discharges(judged)
    labelled = load_nasa_discharges(life)
    settings = {OWN_LIFE: Settings(cut_off_V=CUT_OFF_V), BOTH.format(life): Settings(cell=path, cut_off_V=CUT_OFF_V)}
    lives = {name: track_life(discharges, CUT_OFF_V, _least_squares(each)) for name, each in settings.items()}
    rows: list[dict[str, object]] = []
    for n in range(1, len(discharges), every):
        whole = _Whole(discharges[n])
        rows += _said(path, life, labelled, whole, discharges[n - 1])
        rows += _along(own_path, PATH.format(judged), whole)
        for method, each in settings.items():
            rows += _with_own_life(method, each, lives[method].after(n), whole)
    return {"discharges": pd.DataFrame(rows).assign(cell=judged)}


def learned(judged: str, every: int, method: str, algo: str, seeds: Sequence[int], folder: Path) -> Tables:
    """The discharges of a cell by policies that learned along the path of the other one, their actions averaged."""
    path = path_of([CELLS[judged]], folder)[0]
    policies = [train_or_load(run_of(algo, [CELLS[judged]], seed, folder), folder / "models") for seed in seeds]
    estimator = PolicyEstimator(MeanPolicy(policies), ENV_ID, path=path, **OPTIONS)
    wholes = [_Whole(each) for each in load_nasa_discharges(judged)[1::every]]
    rows = []
    for share in SHARES:
        records = [whole.seen(share).loaded_part(CUT_OFF_V) for whole in wholes]
        for whole, record, trace in zip(wholes, records, estimator.trace(records), strict=True):
            rows.append({"method": method, **_row(path, whole, share, record, last_estimate(trace))})
    seed = seeds[0] if len(seeds) == 1 else np.nan
    return {"discharges": pd.DataFrame(rows).assign(cell=judged, seed=seed)}


class _Whole:
    """A discharge to its end, and what least squares say of it."""

    def __init__(self, discharge: Discharge) -> None:
        self.discharge = discharge
        self.start_s, self.end_s = discharge.load_on_time_s, discharge.eod_time_s(CUT_OFF_V)
        known = LeastSquares(mismatch_V=0.05, thermal=True)
        self.q_mobile = known.estimate(discharge.loaded_part(CUT_OFF_V)).q_mobile

    def seen(self, share: float) -> Discharge:
        """What there is of it after a share of its time."""
        return self.discharge.until(self.start_s + share * (self.end_s - self.start_s))

    def off(self, end_s: float) -> float:
        """How far an end is off, in per cent of the time."""
        return 100.0 * (end_s - self.end_s) / (self.end_s - self.start_s)


def _row(
    path: AgingPath, whole: _Whole, share: float, record: Discharge, found: Estimate, mismatch_V: float | None = None
) -> dict[str, object]:
    """Errors of an estimate along a path, in per cent of ``q_mobile``, and of its end."""
    row: dict[str, object] = {"share": share, "settled": found.settled_q_mobile}
    row |= {"q_error_percent": 100.0 * (found.q_mobile / whole.q_mobile - 1.0)}
    if share == 1.0:
        return row
    model, expected_V = RecordModel(path.cell), mismatch_V or path.mismatch_V
    ahead = forecast(record, found, cut_off_V=CUT_OFF_V, model=model, mismatch_V=expected_V)
    return row | _end(whole, ahead.eod_quantile_s(BAND))


def _end(whole: _Whole, quantiles_s: Sequence[float] | FloatArray) -> dict[str, object]:
    low_s, median_s, high_s = quantiles_s
    covered = float(low_s <= whole.end_s <= high_s)
    width_percent = whole.off(high_s) - whole.off(low_s)
    return {"error_percent": whole.off(median_s), "width_percent": width_percent, "covered": covered}


def _said(
    path: AgingPath, life: str, labelled: Sequence[Discharge], whole: _Whole, last: Discharge
) -> Iterator[dict[str, object]]:
    """Rows of each method on a discharge at each share of its time."""
    yield from _along(path, PATH.format(life), whole)
    for share in SHARES[:-1]:
        seen = whole.seen(share)
        record = seen.loaded_part(CUT_OFF_V)
        yield {"method": KALMAN.format(life), **_row(path, whole, share, record, *_filtered(path, record))}
        ahead = forecast_end(seen, Settings(cut_off_V=CUT_OFF_V))
        yield {"method": NOTHING_KNOWN, "share": share, **_end(whole, ahead.eod_quantile_s(BAND))}
        yield {"method": LABELLED.format(life), "share": share, "error_percent": _regression(labelled, whole, record)}
        lasted_s = last.eod_time_s(CUT_OFF_V) - last.load_on_time_s
        yield {"method": LAST, "share": share, "error_percent": whole.off(whole.start_s + lasted_s)}


def _along(path: AgingPath, method: str, whole: _Whole) -> Iterator[dict[str, object]]:
    """Rows of least squares on a discharge along a path."""
    for share in SHARES:
        record = whole.seen(share).loaded_part(CUT_OFF_V)
        yield {"method": method, **_row(path, whole, share, record, LeastSquares(path=path).estimate(record))}


def _filtered(path: AgingPath, record: Discharge) -> tuple[Estimate, float]:
    """What a plain filter says that expects the cells of a path, with their mean constants, and the error of that model, V."""
    (mean, covariance), size = path.moments, len(PATH_NAMES)
    constants = dict(zip(PATH_NAMES, mean.tolist(), strict=True))
    priors = [(float(np.exp(mean[n])), float(np.exp(mean[n]) * np.sqrt(covariance[n, n]))) for n in (size - 2, size - 1)]
    cell = cell_with(path.cell, constants)
    found = PlainKalmanFilter(
        cell=cell, prior_q_mobile_C=priors[0], prior_r_o_ohm=priors[1], voltage_noise_V=_MEAN_CELL_MISMATCH_V
    ).estimate(record)
    return replace(found, constants=constants), _MEAN_CELL_MISMATCH_V


def _least_squares(settings: Settings) -> LeastSquares:
    calibrator = replace(settings, method="least-squares").calibrator()
    assert isinstance(calibrator, LeastSquares)
    return calibrator


def _with_own_life(method: str, settings: Settings, before: Life, whole: _Whole) -> Iterator[dict[str, object]]:
    """What is said of a discharge in progress by those who know the life of its cell so far."""
    for share in SHARES[:-1]:
        ahead = forecast_end(whole.seen(share), settings, life=before)
        yield {"method": method, "share": share, **_end(whole, ahead.eod_quantile_s(BAND))}


def _regression(labelled: Sequence[Discharge], whole: _Whole, record: Discharge) -> float:
    """Error of the end by a linear map of the voltages, learned on measured capacities, in per cent."""
    charge_C = record.charge_C
    loaded = [each.loaded_part(CUT_OFF_V) for each in labelled]
    usable = [each for each in loaded if each.charge_C > charge_C]
    features = np.array([_steps_V(each, charge_C) for each in usable])
    targets = np.log([each.charge_C for each in usable])
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-6
    scaled = (features - mean) / spread
    held = _RIDGE * len(usable) * np.eye(_STEPS)
    weights = np.linalg.solve(scaled.T @ scaled + held, scaled.T @ (targets - targets.mean()))
    told_C = float(np.exp(targets.mean() + (_steps_V(record, charge_C) - mean) / spread @ weights))
    capacity_C = whole.discharge.loaded_part(CUT_OFF_V).charge_C
    return 100.0 * (told_C / capacity_C - 1.0)


def _steps_V(record: Discharge, charge_C: float) -> FloatArray:
    """Falls of the voltage over equal steps of charge, up to one."""
    drawn_C = integrate_load(record.time_s, record.current_A, record.time_s)
    at_C = charge_C * (np.arange(_STEPS + 1) + 0.5) / (_STEPS + 1)
    return np.diff(np.interp(at_C, drawn_C - drawn_C[0], record.voltage_V))


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One line a cell and method: the mean errors at each share, and over seeds the least and the most of them."""

    def in_progress(said: Callable[[pd.DataFrame], str]) -> Callable[[pd.DataFrame], str]:
        return lambda group: " / ".join(said(each) for _, each in group[group["share"] < 1.0].groupby("share"))

    def of_wholes(said: Callable[[pd.DataFrame], str]) -> Callable[[pd.DataFrame], str]:
        return lambda group: said(whole) if len(whole := group[group["share"] == 1.0]) else ""

    def inside(group: pd.DataFrame) -> str:
        covered = in_progress(lambda each: f"{100.0 * each['covered'].mean():.0f}")
        return covered(group) if group["covered"].notna().any() else ""

    cells: dict[str, Cell] = {
        "end at 25 / 50 / 75 %: mean error (%)": in_progress(lambda each: _over_seeds(each, "error_percent")),
        "worst (%)": in_progress(lambda each: digits(each["error_percent"].abs().max())),
        "inside 90 % (%)": inside,
        "whole: q_max off least squares, mean (worst) (%)": of_wholes(
            lambda whole: f"{_over_seeds(whole, 'q_error_percent')} ({digits(whole['q_error_percent'].abs().max())})"
        ),
        "settled, whole": of_wholes(lambda whole: count_of(whole["settled"].astype(str).eq("True"))),
    }
    return table_of(rows, ["cell", "method"], cells)


def _over_seeds(rows: pd.DataFrame, column: str) -> str:
    """Mean error, with its range over seeds where there are several."""
    means = rows[column].abs().groupby(rows["seed"]).mean()
    spread = f" [{digits(means.min())}, {digits(means.max())}]" if len(means) > 1 else ""
    return digits(rows[column].abs().mean()) + spread


def plot(rows: pd.DataFrame) -> Figure:
    """The error of the end in each discharge of each cell, after half of the time; of policies those that act as one."""
    left_out = rows["method"].str.startswith(("regression", "the fit", BOTH.format("")))
    shown = rows[(rows["share"] == 0.5) & rows["seed"].isna() & ~left_out]
    figure, panels = new_panels(len(CELLS), 2, (4.6, 4.0))
    for axes, (cell, of_cell) in zip(panels, shown.groupby("cell"), strict=True):
        along = f", path of {CELLS[cell]}"
        others = of_cell[of_cell["method"] != PATH.format(cell)]
        for colour, (method, group) in coloured(others.groupby("method", sort=False)):
            axes.plot(range(len(group)), group["error_percent"], ".-", color=colour, lw=0.8, label=method.replace(along, ""))
        axes.axhline(0.0, color="black", lw=0.6)
        axes.set(title=cell + along, xlabel="discharge, from young to old", ylabel="error of the end, half seen (%)")
        axes.legend(frameon=False, fontsize=7, loc="upper center", bbox_to_anchor=(0.45, -0.16), ncols=2)
    return figure


def export(seeds: Sequence[int], folder: Path, command: str, scores: pd.DataFrame) -> None:
    """Train LAC along the paths of all cells, and write its seeds as one file with its card, and scores on the other cell."""
    path, _ = path_of(BUNDLED_CELLS, folder)
    runs = [run_of("lac", BUNDLED_CELLS, seed, folder) for seed in seeds]
    models = [train_or_load(run, folder / "models") for run in runs]
    file = folder / f"{file_stem(ENV_ID, recorded=True)}.onnx"
    export_onnx(models, file, ENV_ID)
    card = {
        "env_id": ENV_ID,
        "options": {**OPTIONS, "path": path.to_mapping()},
        "algorithm": "LAC",
        "command": command,
        "recipe": {**asdict(runs[0]), "seed": list(seeds)},
        "training_data": f"{TRAINING_CELLS} simulated cells along the lives of {' and '.join(BUNDLED_CELLS)}",
        "scores": scores[scores["method"].str.match("LAC, .* as one")].to_dict("records"),
        "training_minutes": sum(made_by(run, folder / "models")["training_minutes"] for run in runs),
        "versions": versions(),
    }
    write_card(file, card)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("aging_paths", __doc__)
    parser.add_argument("--every", type=positive, default=4, help="take one discharge of so many")
    parser.add_argument("--algos", nargs="+", default=["lac"], choices=LABELS, help="of policies")
    parser.add_argument("--seeds", type=natural, nargs="+", default=[0, 1, 2, 3, 4], help="of policies")
    parser.add_argument("--export", action="store_true", help="write the policy that comes with the package")
    study = Study(parser, arguments)
    chosen = study.chosen
    runs = [(algo, [life], seed, study.out) for life, algo, seed in product(BUNDLED_CELLS, chosen.algos, chosen.seeds)]
    runs += [("lac", list(BUNDLED_CELLS), seed, study.out) for seed in chosen.seeds if chosen.export]
    study.configuration |= {"options": OPTIONS, "trained_with": TRAINED_WITH, "cells": TRAINING_CELLS, "updates": UPDATES}
    study.each(train, () if study.redraws else runs)
    asked: list[dict[str, Any]] = []
    for judged, life in CELLS.items():
        of_cell = {"judged": judged, "every": chosen.every}
        asked += [of_cell, {**of_cell, "method": FIT.format(life), "algo": "lac", "seeds": []}]
        for algo in chosen.algos:
            name = f"{LABELS[algo]}, path of {life}"
            asked += [{**of_cell, "method": name, "algo": algo, "seeds": [seed]} for seed in chosen.seeds]
            asked.append({**of_cell, "method": f"{name}, {len(chosen.seeds)} as one", "algo": algo, "seeds": chosen.seeds})
    table = study.run(part, asked, folder=study.out)["discharges"]
    shown = summary(table)
    if chosen.export and not study.redraws:
        export(chosen.seeds, study.out, study.command, shown)
    study.write({"discharges": table}, {"ends": plot(table)}, markdown(shown))


if __name__ == "__main__":
    main()
