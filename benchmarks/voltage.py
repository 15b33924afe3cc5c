"""
Train LAC, SAC and TD3 on a voltage-only task, and compare what they infer on held-out discharges with least squares, a Kalman
filter and the Cramér-Rao bound.

.. code-block:: bash

  python -m benchmarks.voltage --algos lac sac td3 --seeds 0 1

Every discharge starts with the estimate of a new cell. Policies read voltage and current every ten seconds, least squares
and the filter every second. Hyperparameters are those of ``zoo_configs``. A policy that is trained already is not trained
again, so that an interrupted command goes on where it was when it is given again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

from battery_env.calibration.data import standard_dataset
from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.task import Parameter
from battery_env.estimators import Estimator, ExtendedKalmanFilter, LeastSquares
from battery_env.evaluation import evaluate, summarize
from battery_env.plotting import COLOURS, LABELS, new_figure, save_figure
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.reporting import write_csv, write_text
from benchmarks.training import Recipe, record_file, run_all, train_or_load

#: What the voltmeter does to the test discharges.
SENSORS: dict[str, SensorErrors | RandomSensorErrors] = {
    "5 mV noise": SensorErrors(noise_V=0.005),
    "1-30 mV noise, +-10 mV offset": RandomSensorErrors(noise_V=(0.001, 0.030), offset_V=0.010),
}
_ENVIRONMENTS: dict[str, tuple[Parameter, ...]] = {
    "BatteryVoltageJoint-v0": ("q_mobile", "r_o"),
    "BatteryVoltageQmax-v0": ("q_mobile",),
    "BatteryVoltageRo-v0": ("r_o",),
}
#: Time between two estimates, s.
DECISION_S = 60.0


def test_discharges(env_id: str, discharges: int) -> TrajectoryDataset:
    """
    Discharges that no policy has seen.

    :param env_id: id of a voltage-only environment
    :param discharges: how many, at most 300
    :return: the first ones of the test part of the environment's data
    """
    parameters = _ENVIRONMENTS[env_id]
    aged = "joint" if len(parameters) == 2 else parameters[0]
    return standard_dataset(aged, "piecewise", "test")[:discharges]


def score(estimator: Estimator, data: TrajectoryDataset) -> pd.DataFrame:
    """
    The scores of a calibrator under each sensor.

    :param estimator: the calibrator
    :param data: test discharges
    :return: one row per sensor and discharge
    """
    tables = {name: evaluate(estimator, data, errors, seed=1) for name, errors in SENSORS.items()}
    return pd.concat(tables, names=["sensor"]).reset_index("sensor")


def train_and_score(algo: str, env_id: str, seed: int, timesteps: int, discharges: int, out: Path) -> pd.DataFrame:
    """
    Train one policy and score it, unless that has been done.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of a voltage-only environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param discharges: test discharges
    :param out: folder of all results
    :return: what :func:`score` returns, with ``calibrator``, ``seed`` and ``training_minutes``
    """
    folder = out / env_id / f"{algo}_seed{seed}_{timesteps}"
    model = train_or_load(algo, env_id, seed, timesteps, folder)
    record = json.loads(record_file(Recipe.of(algo, env_id, seed, timesteps), folder).read_text(encoding="utf-8"))
    scores = score(PolicyEstimator(model, env_id, decision_s=DECISION_S), test_discharges(env_id, discharges))
    return scores.assign(calibrator=algo.upper(), seed=seed, training_minutes=record["training_minutes"])


def peers(env_id: str) -> dict[str, Estimator]:
    """
    Calibrators without learning. The filter allows for an offset of the sensor, least squares do not.

    :param env_id: id of a voltage-only environment
    :return: by name
    """
    parameters = _ENVIRONMENTS[env_id]
    return {
        "least squares": LeastSquares(parameters, window_every_s=DECISION_S),
        "Kalman filter": ExtendedKalmanFilter(parameters),
    }


def summary(scores: pd.DataFrame, parameters: Sequence[str]) -> pd.DataFrame:
    """
    One row per sensor, calibrator and seed.

    :param scores: of all calibrators
    :param parameters: what was to be found
    :return: errors in per cent, over discharges
    """
    rows = []
    for (sensor, calibrator, seed), group in scores.groupby(["sensor", "calibrator", "seed"], sort=False, dropna=False):
        row: dict[str, Any] = {"sensor": sensor, "calibrator": calibrator, "seed": seed}
        for name in parameters:
            of_parameter = summarize(group, name)
            second_half = group[f"{name}_second_half_mape_percent"]
            row[f"{name}_second_half_percent"] = second_half.mean()
            row[f"{name}_second_half_worst_percent"] = second_half.max()
            row[f"{name}_final_percent"] = of_parameter["final_error_percent"]
            row[f"{name}_final_worst_percent"] = of_parameter["final_error_worst_percent"]
            row[f"{name}_bound_percent"] = of_parameter["bound_percent"]
        for percent in (50, 75):
            row[f"eod_error_at_{percent}_percent"] = summarize(group, parameters[0])[f"eod_error_percent_at_{percent}_percent"]
        row["time_per_update_us"] = 1e6 * group["time_per_update_s"].iloc[0]
        row["training_minutes"] = group["training_minutes"].iloc[0]
        rows.append(row)
    return pd.DataFrame(rows).sort_values("sensor", key=lambda names: names.map(list(SENSORS).index), kind="stable")


def markdown(table: pd.DataFrame, parameters: Sequence[str]) -> str:
    """
    The table for people.

    :param table: what :func:`summary` returned
    :param parameters: what was to be found
    :return: markdown
    """

    def spread(values: pd.Series) -> str:
        return " / ".join(f"{value:.2g}" for value in values)

    lines = []
    for (sensor, calibrator), group in table.groupby(["sensor", "calibrator"], sort=False):
        line = {"sensor": sensor, "calibrator": calibrator}
        for name in parameters:
            symbol = {"q_mobile": "q^max", "r_o": "R_o"}[name]
            line[f"{symbol}, second half (%)"] = spread(group[f"{name}_second_half_percent"])
            line[f"worst discharge (%) {symbol}"] = spread(group[f"{name}_second_half_worst_percent"])
            line[f"{symbol}, final (%)"] = spread(group[f"{name}_final_percent"])
        line["end of discharge, at 50 % (%)"] = spread(group["eod_error_at_50_percent"])
        line["time per estimate (us)"] = f"{group['time_per_update_us'].mean():.2g}"
        learned = group["training_minutes"].notna().any()
        line["training (min)"] = f"{group['training_minutes'].mean():.1f}" if learned else ""
        lines.append(line)
    return pd.DataFrame(lines).to_markdown(index=False, disable_numparse=True) + "\n"


def plot_ranks(scores: pd.DataFrame, parameters: Sequence[str]) -> Figure:
    """
    Which share of the discharges has an error in its second half below a value, for each calibrator.

    :param scores: of all calibrators
    :param parameters: what was to be found
    :return: the figure, one column per parameter, one row per sensor
    """
    sensors = list(dict.fromkeys(scores["sensor"]))
    figure = new_figure(4.0 * len(parameters) + 0.6, 2.7 * len(sensors) + 0.4)
    panels = figure.subplots(len(sensors), len(parameters), squeeze=False, sharex="col", sharey=True)
    for row, sensor in zip(panels, sensors, strict=True):
        for axes, name in zip(row, parameters, strict=True):
            of_sensor = scores[scores["sensor"] == sensor]
            groups = of_sensor.groupby(["calibrator", "seed"], sort=False, dropna=False)
            calibrators = list(dict.fromkeys(of_sensor["calibrator"]))
            for (calibrator, seed), group in groups:
                errors = np.sort(group[f"{name}_second_half_mape_percent"])
                first = seed == of_sensor.loc[of_sensor["calibrator"] == calibrator, "seed"].iloc[0] or np.isnan(seed)
                axes.plot(
                    errors,
                    100.0 * np.arange(1, len(errors) + 1) / len(errors),
                    color=COLOURS[calibrators.index(calibrator)],
                    lw=1.3,
                    label=calibrator if first else None,
                )
            axes.set(xscale="log", title=f"{LABELS[name].split(' (')[0]}, {sensor}")
            axes.title.set_fontsize(9)
            axes.grid(which="both", alpha=0.2)
    for axes in panels[-1]:
        axes.set_xlabel("mean error in the second half (%)")
    for axes in panels[:, 0]:
        axes.set_ylabel("discharges (%)")
    panels[0, 0].legend(frameon=False, fontsize=8)
    return figure


def report(env_id: str, scores: pd.DataFrame, out: Path, configuration: Mapping[str, Any]) -> str:
    """
    Write table and figure.

    :param env_id: id of a voltage-only environment
    :param scores: of all calibrators
    :param out: folder of all results
    :param configuration: what was chosen on the command line
    :return: the table in markdown
    """
    parameters = _ENVIRONMENTS[env_id]
    write_csv(out / f"{env_id}_scores.csv", scores, dict(configuration))
    table = summary(scores, parameters)
    write_csv(out / f"{env_id}.csv", table, dict(configuration))
    save_figure(plot_ranks(scores, parameters), out / f"{env_id}.png")
    text = markdown(table, parameters)
    write_text(out / f"{env_id}.md", text)
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.voltage", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--algos", nargs="+", default=["lac", "sac", "td3"], help="off-policy algorithms of the RL Zoo, or lac"
    )
    parser.add_argument("--env", default="BatteryVoltageJoint-v0", choices=list(_ENVIRONMENTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--timesteps", type=float, help="environment steps of each run; those of zoo_configs by default")
    parser.add_argument("--discharges", type=int, default=100, help="test discharges")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="runs at the same time, one core each")
    parser.add_argument("--out", type=Path, default=Path("results/voltage"))
    chosen = parser.parse_args(arguments)
    if not (chosen.timesteps is None or chosen.timesteps >= 1) or chosen.jobs < 1 or not 1 <= chosen.discharges <= 300:
        parser.error("--timesteps and --jobs must be at least 1, --discharges within 1 .. 300")
    timesteps = None if chosen.timesteps is None else int(chosen.timesteps)
    try:
        recipes = [
            Recipe.of(algo, chosen.env, seed, timesteps)
            for seed in dict.fromkeys(chosen.seeds)
            for algo in dict.fromkeys(chosen.algos)
        ]
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    runs = [(recipe.algo, chosen.env, recipe.seed, recipe.timesteps, chosen.discharges, chosen.out) for recipe in recipes]
    try:
        tables = run_all(train_and_score, runs, chosen.jobs)
    except KeyboardInterrupt:
        sys.exit(f"\nInterrupted; what is done lies in {chosen.out}, and the same command goes on from there.")
    data = test_discharges(chosen.env, chosen.discharges)
    for name, estimator in tqdm(peers(chosen.env).items(), desc="peers", disable=None):
        tables.append(score(estimator, data).assign(calibrator=name))
    configuration = {name: value for name, value in vars(chosen).items() if name not in ("jobs", "out")}
    order = ["calibrator", "seed", "training_minutes"]
    scores = pd.concat(tables, ignore_index=True)
    scores = scores[[*order, *(column for column in scores.columns if column not in order)]]
    sys.stdout.write("\n" + report(chosen.env, scores, chosen.out, configuration))


if __name__ == "__main__":
    main()
