"""
Train algorithms on environments through Stable-Baselines3's own callbacks, and compare what they reach with each other and,
on the battery tasks, with calibrators that do not learn.

.. code-block:: bash

  python -m benchmarks.compare --envs BatteryQmax-v0 BatteryRo-v0 --seeds 0 1 2
  python -m benchmarks.compare --envs BatteryVoltageJoint-v0 --seeds 0 1 --out results/voltage
  python -m benchmarks.compare --defaults --out results/compare_defaults
  python -m benchmarks.compare --defaults --algos tqc my_package.my_module:MyAlgorithm --envs my_package.my_envs:MyEnv-v0

Algorithms are those of the RL Zoo, LAC, and classes of your own; environments are all that are registered, or that importing
the module before the colon registers. Hyperparameters and numbers of steps are those of ``zoo_configs``; with ``--defaults``,
those of ``ALGO("MlpPolicy", env_id)``.

Policies of full-state tasks are scored on all held-out discharges, beside the closed form; those of voltage-only tasks on the
first 100, under two sensors, beside least squares and a Kalman filter that read every second; and in all other environments by
the returns of episodes with the mean action.

Every run has a folder of its own, named by its recipe: algorithm, environment, seed, steps, evaluations, hyperparameters and
version of this project. A run that is finished is not run again; with another recipe it is. An interrupted run goes on from
its last checkpoint when the same command is given again; it does not equal an uninterrupted one then, and the table says so.
The tables and the figures show all finished runs in the folder, so that runs can be added, and name the recipe of each row;
the JSON files beside them spell the recipes out. TensorBoard logs lie in ``<out>/tensorboard/<env>``, so that the algorithms
overlay.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from battery_env.calibration.full_state import FullStateTask
from battery_env.calibration.policy import PolicyEstimator
from battery_env.callbacks import CalibrationCallback
from battery_env.estimators import ClosedForm, Estimator, ExtendedKalmanFilter, LeastSquares
from battery_env.evaluation import evaluate, summarize
from battery_env.plotting import (
    COLOURS,
    LABELS,
    draw_over_seeds,
    new_figure,
    plot_learning_curves,
    plot_true_against_inferred,
    save_figure,
)
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.study import (
    EVALUATION_SEED,
    SYMBOLS,
    Study,
    Tables,
    command_line,
    digits,
    markdown,
    positive,
    side_by_side,
    versions,
    with_spread,
    write_json,
    write_text,
)
from benchmarks.training import DEFAULTS_TIMESTEPS, CheckpointCallback, Recipe, registered_id, set_up

#: What the voltmeter does to the test discharges of voltage-only tasks.
SENSORS: dict[str, SensorErrors | RandomSensorErrors] = {
    "5 mV noise": SensorErrors(noise_V=0.005),
    "1-30 mV noise, +-10 mV offset": RandomSensorErrors(noise_V=(0.001, 0.030), offset_V=0.010),
}
_EVALUATION_TRAJECTORIES = 64  # of the test part of full-state tasks, evenly spaced, while training; all of them at the end
_VOLTAGE_TRAJECTORIES, _BRIEF_VOLTAGE_TRAJECTORIES = 100, 20  # the first ones: whole lives of cells that age
_EVALUATION_EPISODES = 20
_SCORED_EPISODES = 100


def held_out_trajectories(env_id: str) -> TrajectoryDataset:
    """
    The discharges that no policy has seen.

    :param env_id: id of a calibration environment
    :return: the test part of its data set
    """
    data = PolicyEstimator.environment(env_id, split="test").task.dataset
    assert isinstance(data, TrajectoryDataset)
    return data


class Contest(ABC):
    """
    What algorithms are compared by in one kind of environment.

    :param env_id: id of the environment
    :ivar env_id: the same, without the module that registers it
    :ivar options: of the environment while evaluating
    :ivar metrics: which columns of the scores are followed while training, and the name of each; smaller is better
    :ivar stems: for each of these names, how the names of files of learning curves begin
    """

    #: The metric that is followed, in files of learning curves and in figures.
    metric: str
    label: str
    options: Mapping[str, Any]
    metrics: Mapping[str, str]
    stems: Mapping[str, str]

    def __init__(self, env_id: str) -> None:
        self.env_id = registered_id(env_id)

    @abstractmethod
    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        """
        Score a policy.

        :param model: the policy
        :param env: one environment as the policy knows it, with ``options``
        :param brief: on little work, as while training
        :return: one row per discharge (and sensor) or episode
        """

    def summary(self, scores: pd.DataFrame) -> dict[str, Any]:
        """
        What is kept of a run beside its scores.

        :param scores: of one policy
        :return: by name
        """
        return {"time_per_update_us": 1e6 * float(scores["time_per_update_s"].iloc[0])}

    @abstractmethod
    def report(self, runs: pd.DataFrame, study: Study) -> tuple[list[dict[str, str]], pd.DataFrame]:
        """
        Write tables and figures of all finished runs in this environment.

        :param runs: see :func:`finished_runs`
        :param study: where to
        :return: rows for readers, and what stands of it in compare.csv
        """

    def write_learning(self, runs: pd.DataFrame, study: Study) -> None:
        """
        Draw each metric during training, and write the curves.

        :param runs: see :func:`finished_runs`
        :param study: where to
        """
        for name, stem in self.stems.items():
            columns = {name: self.metric, f"{name}_worst": f"{self.metric}_worst"}
            curves: dict[str, list[pd.DataFrame]] = {}
            tables: dict[tuple[str, int], pd.DataFrame] = {}
            for label, seed, folder in runs[["label", "seed", "folder"]].itertuples(index=False):
                history = pd.read_csv(folder / "calibration.csv").rename(columns=columns)
                tables[label, seed] = history[["timesteps", *columns.values()]]
                curves.setdefault(label, []).append(tables[label, seed])
            save_figure(plot_learning_curves(curves, stem, self.metric, self.label), study.out / f"{stem}_learning.png")
            table = pd.concat(tables, names=["algo", "seed"]).droplevel(-1).reset_index()
            study.write_table(f"{stem}_learning", table, made_by(runs))


class Calibration(Contest):
    """
    Calibrators on held-out discharges.

    :param env_id: id of a calibration environment
    """

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
        step = max(len(self.test) // _EVALUATION_TRAJECTORIES, 1) if brief else 1
        return evaluate(PolicyEstimator(model, self.env_id), self.test.subset(range(0, len(self.test), step)))

    def summary(self, scores: pd.DataFrame) -> dict[str, Any]:
        return {**super().summary(scores), "scores": {name: summarize(scores, name) for name in self.parameters}}

    def table(self, runs: pd.DataFrame) -> pd.DataFrame:
        """
        The scores of all runs, and of the closed form.

        :param runs: see :func:`finished_runs`
        :return: one row per run and parameter
        """
        exact = evaluate(ClosedForm(), self.test)
        tables = []
        for name in self.parameters:
            of_name = pd.DataFrame([scores[name] for scores in runs["scores"]], index=runs.index)
            tables.append(runs.drop(columns="scores").assign(parameter=name).join(of_name))
            row: dict[str, Any] = {"env": self.env_id, "parameter": name, "algo": "closed form", "label": "closed form"}
            row |= summarize(exact, name)
            tables.append(pd.DataFrame([{**row, "time_per_update_us": 1e6 * float(exact["time_per_update_s"].iloc[0])}]))
        return pd.concat(tables, ignore_index=True)

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[list[dict[str, str]], pd.DataFrame]:
        self.write_learning(runs, study)
        # the paper's figure, of the first seed
        first = runs.drop_duplicates("label")
        folders = zip(first["label"], first["folder"], strict=True)
        inferred = {label: pd.read_csv(folder / "scores.csv") for label, folder in folders}
        for name, stem in zip(self.parameters, self.stems.values(), strict=True):
            save_figure(plot_true_against_inferred(inferred, name), study.out / f"{stem}_inferred.png")
            columns = ["load", name, f"{name}_hat", f"{name}_spread", f"{name}_mape_percent"]
            points = pd.concat({label: scores[columns] for label, scores in inferred.items()}, names=["algo", "trajectory"])
            study.write_table(f"{stem}_inferred", points.reset_index(), made_by(runs))
        table, lines = self.table(runs), []
        for (parameter, label), group in table.groupby(["parameter", "label"], sort=False):
            learned = label != "closed form"
            lines.append(
                {
                    "environment": self.env_id,
                    "parameter": str(parameter),
                    **_who(str(label), group, learned),
                    "MAPE (%)": with_spread(group["mape_percent"]),
                    "worst discharge (%)": digits(group["mape_worst_percent"].max()),
                    "bias (%)": with_spread(group["bias_percent"]),
                    "spread (%)": with_spread(group["spread_percent"]),
                    "end of discharge (%)": with_spread(group["eod_error_percent"]),
                    **_times(group, learned),
                }
            )
        return lines, table.drop(columns=["label", "folder"])


class VoltageOnly(Calibration):
    """Calibrators that see voltage and current."""

    metric = "second_half_mape_percent"
    label = "MAPE of the second half (%)"

    def scores(self, model: BaseAlgorithm, env: VecEnv, brief: bool = False) -> pd.DataFrame:
        return self.under_sensors(PolicyEstimator(model, self.env_id), brief)

    def under_sensors(self, estimator: Estimator, brief: bool = False) -> pd.DataFrame:
        """
        Score any calibrator.

        :param estimator: the calibrator
        :param brief: on little work, as while training
        :return: one row per sensor and discharge
        """
        data = self.test[: _BRIEF_VOLTAGE_TRAJECTORIES if brief else _VOLTAGE_TRAJECTORIES]
        sensors = dict(list(SENSORS.items())[: 1 if brief else None])
        tables = {name: evaluate(estimator, data, errors, seed=1) for name, errors in sensors.items()}
        return pd.concat(tables, names=["sensor"]).reset_index("sensor")

    def peers(self) -> dict[str, Estimator]:
        """
        Calibrators without learning. The filter allows for an offset of the sensor, least squares do not.

        :return: by name
        """
        return {
            "least squares": LeastSquares(self.parameters, window_every_s=60.0),
            "Kalman filter": ExtendedKalmanFilter(self.parameters),
        }

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[list[dict[str, str]], pd.DataFrame]:
        self.write_learning(runs, study)
        who = ["label", "seed", "training_minutes", "folder"]
        tables = [
            pd.read_csv(folder / "scores.csv").assign(calibrator=label, seed=seed, training_minutes=minutes)
            for label, seed, minutes, folder in runs[who].itertuples(index=False)
        ]
        peers = [{"env_id": self.env_id, "calibrator": name} for name in self.peers()]
        scores = pd.concat([*tables, study.run(peer_scores, peers)["scores"]], ignore_index=True)
        order = ["calibrator", "seed", "training_minutes"]
        scores = scores[[*order, *(column for column in scores.columns if column not in order)]]
        table = self.table(scores)
        study.write_table(f"{self.env_id}_scores", scores, made_by(runs))
        study.write_table(self.env_id, table, made_by(runs))
        save_figure(plot_ranks(scores, self.parameters), study.out / f"{self.env_id}.png")
        lines = []
        for (sensor, calibrator), group in table.groupby(["sensor", "calibrator"], sort=False):
            line = {"environment": self.env_id, "sensor": str(sensor), "calibrator": str(calibrator)}
            for name in self.parameters:
                symbol = SYMBOLS[name]
                line[f"{symbol}, second half (%)"] = side_by_side(group[f"{name}_second_half_percent"])
                line[f"worst discharge (%) {symbol}"] = side_by_side(group[f"{name}_second_half_worst_percent"])
                line[f"{symbol}, final (%)"] = side_by_side(group[f"{name}_final_percent"])
            line["end of discharge, at 50 % (%)"] = side_by_side(group["eod_error_at_50_percent"])
            lines.append({**line, **_times(group, bool(group["training_minutes"].notna().any()))})
        return lines, pd.DataFrame()

    def table(self, scores: pd.DataFrame) -> pd.DataFrame:
        """
        The scores of all calibrators, over discharges.

        :param scores: of all calibrators
        :return: one row per sensor, calibrator and seed; errors in per cent
        """
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
    """
    A part of this study: a calibrator without learning, under each sensor.

    :param env_id: id of a voltage-only environment
    :param calibrator: its name
    :return: ``scores``, one row per sensor and discharge
    """
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
        episodes = _EVALUATION_EPISODES if brief else _SCORED_EPISODES
        returns, lengths = evaluate_policy(model, env, episodes, return_episode_rewards=True)
        return pd.DataFrame({"cost": -np.asarray(returns), "length": lengths})

    def summary(self, scores: pd.DataFrame) -> dict[str, Any]:
        return {"time_per_update_us": None}

    def report(self, runs: pd.DataFrame, study: Study) -> tuple[list[dict[str, str]], pd.DataFrame]:
        self.write_learning(runs, study)
        scores = [pd.read_csv(folder / "scores.csv") for folder in runs["folder"]]
        table = runs.assign(
            cost=[of_run["cost"].mean() for of_run in scores],
            cost_worst=[of_run["cost"].max() for of_run in scores],
            length=[of_run["length"].mean() for of_run in scores],
        )
        study.write_table(self.env_id, table.drop(columns=["scores", "label", "folder", "time_per_update_us"]), made_by(runs))
        lines = [
            {
                "environment": self.env_id,
                **_who(str(label), group, learned=True),
                "cost of an episode": with_spread(group["cost"]),
                "worst episode": digits(group["cost_worst"].max()),
                "steps of an episode": with_spread(group["length"]),
                "training (min)": f"{group['training_minutes'].mean():.1f}",
            }
            for label, group in table.groupby("label", sort=False)
        ]
        return lines, pd.DataFrame()


def contest(env_id: str) -> Contest:
    """
    What algorithms are compared by in an environment.

    :param env_id: its id
    :return: the contest
    :raises gymnasium.error.Error: if it does not exist
    """
    try:
        task = PolicyEstimator.environment(registered_id(env_id)).task
    except ValueError:
        return Episodes(env_id)
    return FullState(env_id) if isinstance(task, FullStateTask) else VoltageOnly(env_id)


def _who(label: str, group: pd.DataFrame, learned: bool) -> dict[str, str]:
    return {
        "calibrator" if "parameter" in group else "algorithm": label,
        "recipe": group["recipe"].iloc[0] if learned else "",
        "steps": f"{group['timesteps'].iloc[0]:.0f}" if learned else "",
        "seeds": str(len(group)) if learned else "",
    }


def _times(group: pd.DataFrame, learned: bool) -> dict[str, str]:
    return {
        "time per estimate (us)": f"{group['time_per_update_us'].mean():.2g}",
        "training (min)": f"{group['training_minutes'].mean():.1f}" if learned else "",
    }


def plot_ranks(scores: pd.DataFrame, parameters: Sequence[str]) -> Figure:
    """
    Which share of the discharges has an error in its second half below a value, for each calibrator, over seeds.

    :param scores: of all calibrators
    :param parameters: what was to be found
    :return: the figure, one column per parameter, one row per sensor
    """
    sensors = list(dict.fromkeys(scores["sensor"]))
    figure = new_figure(4.0 * len(parameters) + 0.6, 2.7 * len(sensors) + 0.4)
    panels = figure.subplots(len(sensors), len(parameters), squeeze=False, sharex="col", sharey=True)
    for row, sensor in zip(panels, sensors, strict=True):
        for axes, name in zip(row, parameters, strict=True):
            of_sensor, column = scores[scores["sensor"] == sensor], f"{name}_second_half_mape_percent"
            limits = np.geomspace(of_sensor[column].min(), of_sensor[column].max(), 200)
            for colour, (calibrator, group) in zip(COLOURS, of_sensor.groupby("calibrator", sort=False), strict=False):
                seeds = [errors.to_numpy() for _, errors in group.groupby("seed", dropna=False)[column]]
                shares = [100.0 * np.mean(errors[:, None] <= limits, axis=0) for errors in seeds]
                draw_over_seeds(axes, limits, shares, colour, str(calibrator))
            axes.set(xscale="log", title=f"{LABELS[name].split(' (')[0]}, {sensor}")
            axes.title.set_fontsize(9)
            axes.grid(which="both", alpha=0.2)
    for axes in panels[-1]:
        axes.set_xlabel("mean error in the second half (%)")
    for axes in panels[:, 0]:
        axes.set_ylabel("discharges (%)")
    panels[0, 0].legend(frameon=False, fontsize=8)
    return figure


class ProgressCallback(BaseCallback):
    """
    A progress bar with the latest score.

    :param label: name of the run
    :param total: environment steps of the whole run
    :param calibration: where the score comes from
    :param position: line of the terminal
    """

    def __init__(self, label: str, total: int, calibration: CalibrationCallback, position: int) -> None:
        super().__init__()
        self.label, self.total, self.calibration, self.position = label, total, calibration, position

    def _on_training_start(self) -> None:
        self.bar = tqdm(desc=self.label, total=self.total, initial=self.num_timesteps, position=self.position, mininterval=1.0)

    def _on_step(self) -> bool:
        self.bar.update(self.num_timesteps - self.bar.n)
        if self.calibration.history:
            objective = self.calibration.objective
            self.bar.set_postfix_str(f"{objective} {digits(self.calibration.history[-1][objective])}", refresh=False)
        return True

    def _on_training_end(self) -> None:
        self.bar.close()


def run(recipe: Recipe, out: Path, position: int = 0) -> None:
    """
    Train one policy and score it. Does nothing if that has been done, and goes on from the last checkpoint if it was
    interrupted.

    :param recipe: of the training, with how often to evaluate, and to save a checkpoint, in between
    :param out: folder of all results
    :param position: line of the terminal for the progress bar
    """
    assert recipe.evaluations is not None
    folder = _folder(recipe, out)
    if (folder / "summary.json").exists():
        return
    of_env = contest(recipe.env_id)
    every = max(recipe.timesteps // (recipe.evaluations * recipe.hyperparameters.get("n_envs", 1)), 1)
    checkpoint = CheckpointCallback(folder / "checkpoint", every)
    manager, model = set_up(
        recipe,
        folder / "zoo",
        eval_env_kwargs=dict(of_env.options),
        trained_agent=str(checkpoint.folder / "model.zip") if checkpoint.resumed else "",
    )
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation_env, scored_env = (manager.create_envs(n_envs=1, eval_env=True, no_log=True) for _ in range(2))
    log = out / "tensorboard" / of_env.env_id / f"{recipe.label.replace(' ', '_')}_seed{recipe.seed}_{recipe.digest}"
    model.set_logger(configure(str(log), ["tensorboard"]))

    calibration = CalibrationCallback(
        lambda candidate: of_env.scores(candidate, scored_env, brief=True),
        eval_freq=every,
        metrics=of_env.metrics,
        log_path=folder / "calibration.csv",
        verbose=0,
    )
    callbacks: list[BaseCallback] = [
        calibration,
        EvalCallback(evaluation_env, n_eval_episodes=_EVALUATION_EPISODES, eval_freq=every, verbose=0),
        checkpoint,
        ProgressCallback(f"{of_env.env_id} {recipe.label} seed {recipe.seed}", recipe.timesteps, calibration, position),
    ]
    model.learn(recipe.timesteps - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
    model.save(folder / "model")

    scores = of_env.scores(model, scored_env)
    write_text(folder / "scores.csv", scores.to_csv(index=False, float_format="%.6g"))
    summary = {"recipe": asdict(recipe), "versions": versions(), "resumed": checkpoint.resumed, "updates": model._n_updates}
    summary |= {"training_minutes": checkpoint.seconds / 60.0, **of_env.summary(scores)}
    write_json(folder / "summary.json", summary)
    shutil.rmtree(checkpoint.folder, ignore_errors=True)


def _folder(recipe: Recipe, out: Path) -> Path:
    return out / registered_id(recipe.env_id) / recipe.name


def finished_runs(out: Path) -> pd.DataFrame:
    """
    What the finished runs in a folder say, one row per run.

    :param out: folder of all results
    :return: what was learned, with the ``folder`` of the run, its ``recipe``, its ``label`` in tables, and its ``scores``
    :raises ValueError: if there is one that does not say what made it
    """
    rows = []
    for file in sorted(out.glob("*/*/summary.json")):
        summary = json.loads(file.read_text(encoding="utf-8"))
        if set(summary.get("recipe", ())) != {field.name for field in fields(Recipe)}:
            raise ValueError(f"{file} was written by an earlier version: choose another --out")
        recipe = Recipe(**summary["recipe"])
        of_run: dict[str, Any] = {
            "env": registered_id(recipe.env_id),
            "algo": recipe.algo,
            "hyperparameters": recipe.source,
            "recipe": recipe.digest,
            "seed": recipe.seed,
            "timesteps": recipe.timesteps,
            "label": recipe.label,
            "folder": file.parent,
            "scores": summary.get("scores"),
        }
        kept = ("updates", "resumed", "training_minutes", "time_per_update_us")
        rows.append(of_run | {name: summary[name] for name in kept})
    if not rows:
        return pd.DataFrame()
    runs = pd.DataFrame(rows)
    recipes = runs.groupby(["env", "label"])["recipe"].transform("nunique")
    runs["label"] = runs["label"].where(recipes == 1, runs["label"] + " " + runs["recipe"])
    order = ["env", "algo", "hyperparameters", "recipe", "seed"]
    return runs.sort_values(order, ascending=[name != "hyperparameters" for name in order], ignore_index=True)


def made_by(runs: pd.DataFrame) -> dict[str, Any]:
    """
    What made the runs of a table.

    :param runs: see :func:`finished_runs`
    :return: each recipe once, with the seeds that were run
    """
    recipes: dict[str, Any] = {}
    for recipe_digest, folder in zip(runs["recipe"], runs["folder"], strict=True):
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        recipe = summary["recipe"]
        seed = {"seed": recipe.pop("seed"), "resumed": summary["resumed"], "versions": summary["versions"]}
        recipes.setdefault(recipe_digest, {**recipe, "runs": []})["runs"].append(seed)
    return {"recipes": recipes}


def report(study: Study) -> None:
    """
    Write and show the tables of all finished runs in a folder and, for each environment, its figures with their data.

    :param study: the folder
    """
    runs = finished_runs(study.out)
    rows: dict[tuple[str, ...], list[dict[str, str]]] = {}  # a table for readers for each set of columns
    tables = []
    for _, of_env in runs.groupby("env"):
        summary = json.loads((of_env["folder"].iloc[0] / "summary.json").read_text(encoding="utf-8"))
        lines, table = contest(summary["recipe"]["env_id"]).report(of_env, study)
        tables.append(table)
        for line in lines:
            rows.setdefault(tuple(line), []).append(line)
    together = pd.concat(tables, ignore_index=True)
    if len(together) > 0:
        study.write_table("compare", together, made_by(runs))
    texts = [markdown(lines) for lines in rows.values()]
    resumed = runs[runs["resumed"] > 0]
    if len(resumed) > 0:
        said = "Interrupted and continued from a checkpoint, with other random numbers than an uninterrupted run has:\n\n"
        for _, of_run in resumed.iterrows():
            times = "once" if of_run["resumed"] == 1 else f"{of_run['resumed']} times"
            said += f"- {of_run['label']} on {of_run['env']}, seed {of_run['seed']}: {times}\n"
        texts.append(said)
    study.write({}, {}, "\n".join(texts))


def _checked(recipe: Recipe, out: Path) -> Recipe:
    """Refuse what could not be trained or scored, before anything is."""
    if recipe.algo == "ppo_lstm":
        raise ValueError("ppo_lstm: policies with a memory cannot be scored here")
    if recipe.hyperparameters.get("normalize"):
        raise ValueError(f"{recipe.algo} on {recipe.env_id}: policies with `normalize` cannot be scored here")
    contest(recipe.env_id)
    if not (_folder(recipe, out) / "summary.json").exists():
        try:
            with tempfile.TemporaryDirectory() as folder:
                set_up(recipe, Path(folder))
        except (AssertionError, TypeError, ValueError) as error:
            raise ValueError(f"{recipe.algo} on {recipe.env_id}: {error}") from error
    return recipe


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = command_line("compare", __doc__)
    parser.add_argument(
        "--algos", nargs="+", default=["lac", "sac", "td3"], help="of the RL Zoo, or package.module:Class of your own"
    )
    parser.add_argument("--envs", nargs="+", default=["BatteryRo-v0", "BatteryQmax-v0"], help="ids, or module:id")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument(
        "--timesteps",
        type=positive,
        help=f"environment steps of each run; those of zoo_configs by default, {DEFAULTS_TIMESTEPS} with --defaults",
    )
    parser.add_argument(
        "--defaults", action="store_true", help="the algorithms' own hyperparameters and one environment, not zoo_configs"
    )
    parser.add_argument("--evaluations", type=positive, default=10, help="evaluations and checkpoints during each run")
    study = Study(parser, arguments)
    chosen = study.chosen
    given = {"timesteps": chosen.timesteps, "defaults": chosen.defaults, "evaluations": chosen.evaluations}
    try:
        finished_runs(study.out)
        recipes = [
            [Recipe.of(algo, env_id, seed, **given) for algo in dict.fromkeys(chosen.algos)]
            for env_id in dict.fromkeys(chosen.envs)
            for seed in dict.fromkeys(chosen.seeds)
        ]
        for recipe in {recipe.digest: recipe for of_seed in recipes for recipe in of_seed}.values():
            _checked(recipe, study.out)
    except (ValueError, FileNotFoundError, gym.error.Error) as error:
        parser.error(str(error))
    jobs = [recipe for of_seed in recipes for recipe in of_seed]
    study.each(run, [(recipe, study.out, 1 + k % chosen.jobs) for k, recipe in enumerate(jobs)])
    report(study)


if __name__ == "__main__":
    main()
