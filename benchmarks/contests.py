"""
What algorithms are compared by: the scores of a policy in each kind of environment, what they stand beside, and how tables and
figures show them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from battery_env.estimators import ClosedForm, Estimator, LeastSquares
from battery_env.evaluation import evaluate, summarize
from battery_env.parameters import PARAMETERS
from battery_env.plotting import (
    coloured,
    draw_over_seeds,
    new_figure,
    plot_learning_curves,
    plot_true_against_inferred,
    save_figure,
)
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.tasks.full_state.full_state_task import FullStateTask
from battery_env.trajectories import TrajectoryDataset
from benchmarks.kalman_filter import PlainKalmanFilter
from benchmarks.runs import registered_id
from benchmarks.study import (
    EVALUATION_SEED,
    SYMBOLS,
    Cell,
    Study,
    Tables,
    digits,
    of_trained,
    side_by_side,
    table_of,
    with_interval,
    with_spread,
)

#: What the voltmeter does to the test discharges of voltage-only tasks.
SENSORS: dict[str, SensorErrors | RandomSensorErrors] = {
    "5 mV noise": SensorErrors(noise_V=0.005),
    "1-30 mV noise, +-10 mV offset": RandomSensorErrors(noise_V=(0.001, 0.030), offset_V=0.010),
}
_EVALUATION_TRAJECTORIES = 64  # of the test part of full-state tasks, evenly spaced, while training; all of them at the end
_VOLTAGE_TRAJECTORIES, _BRIEF_VOLTAGE_TRAJECTORIES = 100, 20  # the first ones: whole lives of cells that age
#: How far off models start for the second score of full-state tasks, error scales: 50 mV, and 1.3 % of a new cell's charge.
START_OFF = 5.0
#: Episodes of an evaluation while training.
EVALUATION_EPISODES = 20
_SCORED_EPISODES = 100
#: Discharges in the test part of a data set of a voltage-only task.
HELD_OUT = 300
#: Columns of runs that no table has: what made a run, and its tables.
OF_RUN = ["made_by", "tables"]
_RECIPE: dict[str, Cell] = {
    "recipe": of_trained(lambda group: group["recipe"].iloc[0]),
    "steps": of_trained(lambda group: f"{group['timesteps'].iloc[0]:.0f}"),
    "seeds": of_trained(lambda group: str(len(group))),
}
_TRAINING: dict[str, Cell] = {"training (min)": of_trained(lambda group: f"{group['training_minutes'].mean():.1f}")}
_TIMES: dict[str, Cell] = {"time per estimate (us)": ("time_per_update_us", lambda us: f"{us.mean():.2g}"), **_TRAINING}


def held_out_trajectories(env_id: str) -> TrajectoryDataset:
    """The discharges that no policy has seen."""
    data = PolicyEstimator.environment(env_id, split="test").task.dataset
    assert isinstance(data, TrajectoryDataset)
    return data


def rows_of_parameters(scores: pd.DataFrame, parameters: Sequence[str]) -> pd.DataFrame:
    """Scores as ``evaluate`` gives them, with a row for each parameter."""
    tables = []
    for name in parameters:
        of_name = scores.rename(columns=lambda column, name=name: column.removeprefix(f"{name}_"))
        tables.append(of_name.assign(parameter=name, true=scores[name]))
    return pd.concat(tables)


class Contest(ABC):
    """Scores by which algorithms are compared in one kind of environment."""

    metric: str  # that is followed while training, in files of learning curves and in figures; smaller is better
    label: str
    options: Mapping[str, Any]  # of the environment while evaluating
    metrics: Mapping[str, str]  # columns of the scores that are followed, and the name of each
    stems: Mapping[str, str]  # for each of these names, how the names of files of learning curves begin

    def __init__(self, env_id: str) -> None:
        self.env_id = registered_id(env_id)

    @abstractmethod
    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        """Score a policy."""

    @abstractmethod
    def report(self, runs: pd.DataFrame, study: Study) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Write tables and figures of all finished runs in this environment: what readers see, and what goes with others."""

    def write_learning(self, runs: pd.DataFrame, study: Study) -> None:
        """Draw each metric during training, and write the curves."""
        for name, stem in self.stems.items():
            columns = {name: self.metric, f"{name}_worst": f"{self.metric}_worst"}
            curves: dict[str, list[pd.DataFrame]] = {}
            tables: dict[tuple[str, int], pd.DataFrame] = {}
            for label, seed, run in runs[["label", "seed", "tables"]].itertuples(index=False):
                history = run["learning"].rename(columns=columns)
                tables[label, seed] = history[["timesteps", *columns.values()]]
                curves.setdefault(label, []).append(tables[label, seed])
            save_figure(plot_learning_curves(curves, stem, self.metric, self.label), study.out / f"{stem}_learning.png")
            table = pd.concat(tables, names=["algo", "seed"]).droplevel(-1).reset_index()
            study.write_table(f"{stem}_learning", table, recipes_of(runs))


class Calibration(Contest):
    """Calibrators on held-out discharges."""

    metric = "mape_percent"
    label = "MAPE (%)"
    options: Mapping[str, Any] = {"split": "test"}

    def __init__(self, env_id: str) -> None:
        super().__init__(env_id)
        self.parameters = PolicyEstimator.environment(self.env_id).task.parameters
        self.test = held_out_trajectories(self.env_id)
        # known by its parameter only where there are two
        if len(self.parameters) == 1:
            self.metrics, self.stems = {f"{self.parameters[0]}_{self.metric}": self.metric}, {self.metric: self.env_id}
        else:
            self.metrics = {f"{name}_{self.metric}": f"{name}_{self.metric}" for name in self.parameters}
            self.stems = {f"{name}_{self.metric}": f"{self.env_id}_{name}" for name in self.parameters}


class FullState(Calibration):
    """Calibrators that see the full state."""

    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        if brief:
            few = range(0, len(self.test), max(len(self.test) // _EVALUATION_TRAJECTORIES, 1))
            return evaluate(PolicyEstimator(model, self.env_id), self.test.subset(few))
        scores = evaluate(PolicyEstimator(model, self.env_id), self.test)
        start_off = evaluate(PolicyEstimator(model, self.env_id, initial_perturbation=START_OFF), self.test)
        errors = [f"{name}_{self.metric}" for name in self.parameters]
        return scores.join(start_off[errors].add_prefix("start_off_"))

    def table(self, runs: pd.DataFrame) -> pd.DataFrame:
        """The scores of all runs, and of the closed form."""

        def scored(of: pd.DataFrame, scores: Sequence[pd.DataFrame], name: str) -> pd.DataFrame:
            times_us = [1e6 * float(each["time_per_update_s"].iloc[0]) for each in scores]
            summaries = pd.DataFrame([summarize(each, name) for each in scores], index=of.index)
            return of.assign(time_per_update_us=times_us, parameter=name).join(summaries)

        exact, of_runs = evaluate(ClosedForm(), self.test), [tables["scores"] for tables in runs["tables"]]
        closed_form = pd.DataFrame([{"env": self.env_id, "algo": "closed form", "label": "closed form"}])
        tables = []
        for name in self.parameters:
            start_off = [scores[f"start_off_{name}_{self.metric}"] for scores in of_runs]
            table = scored(runs, of_runs, name)
            table["start_off_mape_percent"] = [errors.mean() for errors in start_off]
            table["start_off_worst_percent"] = [errors.max() for errors in start_off]
            tables += [table, scored(closed_form, [exact], name)]
        return pd.concat(tables, ignore_index=True)

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[pd.DataFrame, pd.DataFrame]:
        self.write_learning(runs, study)
        errors = [f"{prefix}{name}_{self.metric}" for prefix in ("", "start_off_") for name in self.parameters]
        of_runs = {
            (label, seed): run["scores"][errors]
            for label, seed, run in runs[["label", "seed", "tables"]].itertuples(index=False)
        }
        scores = pd.concat(of_runs, names=["calibrator", "seed", "trajectory"]).reset_index()
        study.write_table(f"{self.env_id}_scores", scores, recipes_of(runs))
        # the paper's figure, of the first seed
        first = runs.drop_duplicates("label")
        inferred = {label: run["scores"] for label, run in zip(first["label"], first["tables"], strict=True)}
        for name, stem in zip(self.parameters, self.stems.values(), strict=True):
            save_figure(plot_true_against_inferred(inferred, name), study.out / f"{stem}_inferred.png")
            columns = ["load", name, f"{name}_hat", f"{name}_spread"]
            points = pd.concat({label: scores[columns] for label, scores in inferred.items()}, names=["algo", "trajectory"])
            study.write_table(f"{stem}_inferred", points.reset_index(), recipes_of(runs))
        table = self.table(runs)
        cells: dict[str, Cell] = {
            **_RECIPE,
            "MAPE (%)": ("mape_percent", with_spread),
            "interquartile mean (%)": ("mape_percent", lambda errors: with_interval(errors) if len(errors) > 1 else ""),
            "worst discharge (%)": ("mape_worst_percent", lambda errors: digits(errors.max())),
            "MAPE, start off (%)": of_trained(lambda group: with_spread(group["start_off_mape_percent"])),
            "bias (%)": ("bias_percent", with_spread),
            "spread (%)": ("spread_percent", with_spread),
            "end of discharge (%)": ("eod_error_percent", with_spread),
            **_TIMES,
        }
        for_readers = table_of(table, {"env": "environment", "parameter": "parameter", "label": "calibrator"}, cells)
        return for_readers, table.drop(columns=["label", *OF_RUN])


class VoltageOnly(Calibration):
    """Calibrators that see voltage and current."""

    metric = "second_half_mape_percent"
    label = "MAPE of the second half (%)"

    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        return self.under_sensors(PolicyEstimator(model, self.env_id), brief)

    def under_sensors(self, estimator: Estimator, brief: bool = False) -> pd.DataFrame:
        """Score any calibrator."""
        data = self.test[: _BRIEF_VOLTAGE_TRAJECTORIES if brief else _VOLTAGE_TRAJECTORIES]
        sensors = dict(list(SENSORS.items())[: 1 if brief else None])
        tables = {name: evaluate(estimator, data, errors, seed=1) for name, errors in sensors.items()}
        return pd.concat(tables, names=["sensor"]).reset_index("sensor")

    def peers(self) -> dict[str, Estimator]:
        """Calibrators without learning. The filter allows for an offset of the sensor, least squares do not."""
        return {
            "least squares": LeastSquares(self.parameters, window_every_s=60.0),
            "Kalman filter": PlainKalmanFilter(self.parameters),
        }

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[pd.DataFrame, pd.DataFrame]:
        self.write_learning(runs, study)
        columns = ["label", "seed", "training_minutes", "tables"]
        tables = [
            run["scores"].assign(calibrator=label, seed=seed, training_minutes=minutes)
            for label, seed, minutes, run in runs[columns].itertuples(index=False)
        ]
        peers = [{"env_id": self.env_id, "calibrator": name} for name in self.peers()]
        scores = pd.concat([*tables, study.run(peer_scores, peers)["scores"]], ignore_index=True)
        order = ["calibrator", "seed", "training_minutes"]
        scores = scores[[*order, *(column for column in scores.columns if column not in order)]]
        table = self.table(scores)
        study.write_table(f"{self.env_id}_scores", scores, recipes_of(runs))
        study.write_table(self.env_id, table, recipes_of(runs))
        save_figure(plot_ranks(scores, self.parameters), study.out / f"{self.env_id}.png")
        cells: dict[str, Cell] = {}
        for name in self.parameters:
            symbol = SYMBOLS[name]
            cells[f"{symbol}, second half (%)"] = (f"{name}_second_half_percent", side_by_side)
            cells[f"worst discharge (%) {symbol}"] = (f"{name}_second_half_worst_percent", side_by_side)
            cells[f"{symbol}, final (%)"] = (f"{name}_final_percent", side_by_side)
        cells["end of discharge, at 50 % (%)"] = ("eod_error_at_50_percent", side_by_side)
        by = ["environment", "sensor", "calibrator"]
        return table_of(table.assign(environment=self.env_id), by, cells | _TIMES), pd.DataFrame()

    def table(self, scores: pd.DataFrame) -> pd.DataFrame:
        """The scores of all calibrators, over discharges."""
        rows = []
        for (sensor, calibrator, seed), group in scores.groupby(["sensor", "calibrator", "seed"], sort=False, dropna=False):
            row: dict[str, Any] = {"sensor": sensor, "calibrator": calibrator, "seed": seed}
            for name in self.parameters:
                of_parameter = summarize(group, name)
                row[f"{name}_second_half_percent"] = of_parameter["second_half_mape_percent"]
                row[f"{name}_second_half_worst_percent"] = group[f"{name}_second_half_mape_percent"].max()
                row[f"{name}_final_percent"] = of_parameter["final_error_percent"]
                row[f"{name}_final_worst_percent"] = of_parameter["final_error_worst_percent"]
                row[f"{name}_bound_percent"] = of_parameter["bound_percent"]
            for percent in (50, 75):
                row[f"eod_error_at_{percent}_percent"] = of_parameter[f"eod_error_percent_at_{percent}_percent"]
            row["time_per_update_us"] = 1e6 * group["time_per_update_s"].iloc[0]
            row["training_minutes"] = group["training_minutes"].iloc[0]
            rows.append(row)
        return pd.DataFrame(rows).sort_values("sensor", key=lambda names: names.map(list(SENSORS).index), kind="stable")


def peer_scores(env_id: str, calibrator: str) -> Tables:
    """A part of this study: a calibrator without learning, under each sensor."""
    task = VoltageOnly(env_id)
    return {"scores": task.under_sensors(task.peers()[calibrator]).assign(calibrator=calibrator)}


class Episodes(Contest):
    """Any other environment: what an episode costs, which is minus its return."""

    metric = label = "cost"
    options: Mapping[str, Any] = {}
    metrics: Mapping[str, str] = {"cost": "cost"}

    def __init__(self, env_id: str) -> None:
        super().__init__(env_id)
        self.stems = {"cost": self.env_id}

    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        env.seed(EVALUATION_SEED)  # the same starts for every policy
        episodes = EVALUATION_EPISODES if brief else _SCORED_EPISODES
        returns, lengths = evaluate_policy(model, env, episodes, return_episode_rewards=True)
        return pd.DataFrame({"cost": -np.asarray(returns), "length": lengths})

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[pd.DataFrame, pd.DataFrame]:
        self.write_learning(runs, study)
        scores = [run["scores"] for run in runs["tables"]]
        table = runs.assign(
            cost=[of_run["cost"].mean() for of_run in scores],
            cost_worst=[of_run["cost"].max() for of_run in scores],
            length=[of_run["length"].mean() for of_run in scores],
        )
        study.write_table(self.env_id, table.drop(columns=["label", *OF_RUN]), recipes_of(runs))
        cells: dict[str, Cell] = {
            **_RECIPE,
            "cost of an episode": ("cost", with_spread),
            "return, interquartile mean": ("cost", lambda costs: with_interval(-costs)),
            "worst episode": ("cost_worst", lambda costs: digits(costs.max())),
            "steps of an episode": ("length", with_spread),
            **_TRAINING,
        }
        return table_of(table, {"env": "environment", "label": "algorithm"}, cells), pd.DataFrame()


def contest_of(env_id: str) -> Contest:
    """Return the contest of an environment."""
    try:
        task = PolicyEstimator.environment(registered_id(env_id)).task
    except ValueError:
        return Episodes(env_id)
    return FullState(env_id) if isinstance(task, FullStateTask) else VoltageOnly(env_id)


def plot_ranks(scores: pd.DataFrame, parameters: Sequence[str]) -> Figure:
    """Plot the share of discharges with a smaller error in their second half, for each calibrator, over seeds."""
    sensors = list(dict.fromkeys(scores["sensor"]))
    figure = new_figure(4.0 * len(parameters) + 0.6, 2.7 * len(sensors) + 0.4)
    panels = figure.subplots(len(sensors), len(parameters), squeeze=False, sharex="col", sharey=True)
    for row, sensor in zip(panels, sensors, strict=True):
        for axes, name in zip(row, parameters, strict=True):
            of_sensor, column = scores[scores["sensor"] == sensor], f"{name}_second_half_mape_percent"
            limits = np.geomspace(of_sensor[column].min(), of_sensor[column].max(), 200)
            for colour, (calibrator, group) in coloured(of_sensor.groupby("calibrator", sort=False)):
                seeds = [errors.to_numpy() for _, errors in group.groupby("seed", dropna=False)[column]]
                shares = [100.0 * np.mean(errors[:, None] <= limits, axis=0) for errors in seeds]
                draw_over_seeds(axes, limits, shares, colour, str(calibrator))
            axes.set(xscale="log", title=f"{PARAMETERS[name].symbol}, {sensor}")
            axes.title.set_fontsize(9)
            axes.grid(which="both", alpha=0.2)
    for axes in panels[-1]:
        axes.set_xlabel("mean error in the second half (%)")
    for axes in panels[:, 0]:
        axes.set_ylabel("discharges (%)")
    panels[0, 0].legend(frameon=False, fontsize=8)
    return figure


def recipes_of(runs: pd.DataFrame) -> dict[str, Any]:
    """Collect the recipes of the runs of a table."""
    recipes: dict[str, Any] = {}
    for digest, of_run in zip(runs["recipe"], runs["made_by"], strict=True):
        recipe = {**of_run["run"], "defaults": of_run["defaults"]}
        seed = {"seed": recipe.pop("seed"), "resumed": of_run["resumed"], "versions": of_run["versions"]}
        recipes.setdefault(digest, {**recipe, "runs": []})["runs"].append(seed)
    return {"recipes": recipes}
