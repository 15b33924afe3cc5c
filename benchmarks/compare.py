"""
Train LAC, SAC and TD3 on the battery tasks through Stable-Baselines3's own callbacks, and compare what they infer on
held-out discharges with each other and with the closed form.

.. code-block:: bash

  python -m benchmarks.compare --envs BatteryQmax-v0 BatteryRo-v0 --seeds 0 1 2
  python -m benchmarks.compare --defaults --out results/compare_defaults

Hyperparameters and numbers of steps are those of ``zoo_configs``; with ``--defaults``, those of ``ALGO("MlpPolicy", env_id)``.

Every run has a folder of its own, named by its recipe: algorithm, environment, seed, steps, evaluations, hyperparameters and
version of this project. A run that is finished is not run again; with another recipe it is. An interrupted run goes on from
its last checkpoint when the same command is given again; it does not equal an uninterrupted one then, and the table says so.
The table and the figures show all finished runs in the folder, so that runs can be added, and name the recipe of each row;
``compare.json`` spells the recipes out. ``tensorboard --logdir <out>/tensorboard`` shows the runs in common charts, with the
hyperparameters of all of them in one table.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import tqdm

from battery_env.calibration.full_state import FullStateTask
from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.task import Parameter
from battery_env.callbacks import CalibrationCallback
from battery_env.estimators.closed_form import ClosedForm
from battery_env.evaluation import evaluate, summarize
from battery_env.plotting import plot_learning_curves, plot_true_against_inferred, save_figure
from battery_env.trajectories import TrajectoryDataset
from benchmarks.dashboard import dashboard_callbacks
from benchmarks.reporting import versions, write_csv, write_text
from benchmarks.training import DEFAULTS_TIMESTEPS, Recipe, run_all, set_up

_EVALUATION_TRAJECTORIES = 64  # of the test part, evenly spaced, while training; all of them at the end
_EVALUATION_EPISODES = 20


class CheckpointCallback(BaseCallback):
    """
    Saves model and replay buffer in one folder that is replaced as a whole, so that a training can be resumed whenever it is
    interrupted; and counts interruptions and time.

    :param folder: the folder, of an earlier part of the same training if it exists
    :param save_freq: calls between checkpoints
    """

    def __init__(self, folder: Path, save_freq: int) -> None:
        super().__init__()
        self.folder = folder
        self.save_freq = save_freq
        self.recover(folder)
        #: How often the training was continued from a checkpoint.
        self.resumed = 0
        #: Wall time of the training, evaluations included.
        self.seconds = 0.0
        if folder.exists():
            before = json.loads((folder / "progress.json").read_text(encoding="utf-8"))
            self.resumed, self.seconds = before["resumed"] + 1, before["seconds"]

    def _on_training_start(self) -> None:
        self._start = time.perf_counter() - self.seconds

    def _on_training_end(self) -> None:
        self.seconds = time.perf_counter() - self._start

    @staticmethod
    def recover(folder: Path) -> None:
        """
        Put the previous checkpoint back if an interruption fell between setting it aside and putting the new one in place.

        :param folder: the folder
        """
        old = folder.with_suffix(".old")
        if old.exists() and not folder.exists():
            os.replace(old, folder)

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            assert isinstance(self.model, OffPolicyAlgorithm)
            part, old = self.folder.with_suffix(".part"), self.folder.with_suffix(".old")
            for leftover in (part, old):
                shutil.rmtree(leftover, ignore_errors=True)
            part.mkdir(parents=True)
            self.model.save(part / "model")
            self.model.save_replay_buffer(part / "replay_buffer.pkl")
            progress = {"resumed": self.resumed, "seconds": time.perf_counter() - self._start}
            (part / "progress.json").write_text(json.dumps(progress), encoding="utf-8")
            if self.folder.exists():
                os.replace(self.folder, old)
            os.replace(part, self.folder)
            shutil.rmtree(old, ignore_errors=True)
        return True


class ProgressCallback(BaseCallback):
    """
    A progress bar with the latest error on held-out trajectories.

    :param label: name of the run
    :param total: environment steps of the whole run
    :param calibration: where the error comes from
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
            self.bar.set_postfix_str(f"MAPE {self.calibration.history[-1][self.calibration.objective]:.2f} %", refresh=False)
        return True

    def _on_training_end(self) -> None:
        self.bar.close()


def parameters_of(env_id: str) -> tuple[Parameter, ...]:
    """
    Which parameters an environment is about.

    :param env_id: id of a full-state environment
    :return: one or both of ``"q_mobile"`` and ``"r_o"``
    :raises ValueError: for another environment
    """
    return _task(env_id).parameters


def held_out_trajectories(env_id: str) -> TrajectoryDataset:
    """
    The discharges that no policy has seen.

    :param env_id: id of a full-state environment
    :return: the test part of its data set
    :raises ValueError: for another environment
    """
    return _task(env_id, split="test").dataset


def _task(env_id: str, **options: Any) -> FullStateTask:
    task = PolicyEstimator.environment(env_id, **options).task
    if not isinstance(task, FullStateTask):
        raise ValueError(f"{env_id} is no full-state environment; voltage-only ones are compared by benchmarks.voltage")
    return task


def run(recipe: Recipe, out: Path, position: int = 0) -> None:
    """
    Train one policy and score it on all test trajectories. Does nothing if that has been done, and goes on from the last
    checkpoint if it was interrupted.

    :param recipe: of the training, with how often to evaluate, and to save a checkpoint, in between
    :param out: folder of all results
    :param position: line of the terminal for the progress bar
    """
    assert recipe.evaluations is not None
    env_id, timesteps = recipe.env_id, recipe.timesteps
    folder = out / env_id / recipe.name
    if (folder / "summary.json").exists():
        return
    parameters, test = parameters_of(env_id), held_out_trajectories(env_id)
    n_envs = recipe.hyperparameters.get("n_envs", 1)
    every = max(timesteps // (recipe.evaluations * n_envs), 1)
    checkpoint = CheckpointCallback(folder / "checkpoint", every)

    manager, model = set_up(
        recipe,
        folder / "zoo",
        eval_env_kwargs={"split": "test"},
        trained_agent=str(checkpoint.folder / "model.zip") if checkpoint.resumed else "",
    )
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation_env = manager.create_envs(n_envs=1, eval_env=True, no_log=True)
    log = out / "tensorboard" / env_id / f"{recipe.label.replace(' ', '_')}_seed{recipe.seed}_{recipe.digest}"
    model.set_logger(configure(str(log), ["tensorboard"]))

    subset = test.subset(range(0, len(test), max(len(test) // _EVALUATION_TRAJECTORIES, 1)))

    def scores_on_subset(candidate: BaseAlgorithm) -> pd.DataFrame:
        return evaluate(PolicyEstimator(candidate, env_id), subset)

    calibration = CalibrationCallback(
        scores_on_subset,
        eval_freq=every,
        metrics={f"{name}_mape_percent": _metric(name, parameters) for name in parameters},
        log_path=folder / "calibration.csv",
        verbose=0,
    )
    callbacks: list[BaseCallback] = [
        calibration,
        EvalCallback(evaluation_env, n_eval_episodes=_EVALUATION_EPISODES, eval_freq=every, verbose=0),
        *dashboard_callbacks(recipe, manager, model, _EVALUATION_EPISODES, every),
        checkpoint,
        ProgressCallback(f"{env_id} {recipe.label} seed {recipe.seed}", timesteps, calibration, position),
    ]
    model.learn(timesteps - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
    model.save(folder / "model")

    scores = evaluate(PolicyEstimator(model, env_id), test)
    summary = {
        "recipe": asdict(recipe),
        "versions": versions(),
        "resumed": checkpoint.resumed,
        "updates": model._n_updates,
        "training_minutes": checkpoint.seconds / 60.0,
        "time_per_update_us": 1e6 * float(scores["time_per_update_s"].iloc[0]),
        "scores": {name: summarize(scores, name) for name in parameters},
    }
    write_csv(folder / "scores.csv", scores, {"recipe": summary["recipe"], "resumed": summary["resumed"]})
    write_text(folder / "summary.json", json.dumps(summary, indent=2, default=str) + "\n")
    shutil.rmtree(checkpoint.folder, ignore_errors=True)


def _metric(parameter: str, parameters: Sequence[str]) -> str:
    # as it is called in TensorBoard and in files: by its parameter only where there are two
    return "mape_percent" if len(parameters) == 1 else f"{parameter}_mape_percent"


def finished_runs(out: Path) -> pd.DataFrame:
    """
    What the finished runs in a folder say, one row per run and parameter.

    :param out: folder of all results
    :return: what was learned and how well, with the ``folder`` of the run, its ``recipe`` and its ``label`` in tables
    :raises ValueError: if there is one that does not say what made it
    """
    rows = []
    for file in sorted(out.glob("*/*/summary.json")):
        summary = json.loads(file.read_text(encoding="utf-8"))
        if set(summary.get("recipe", ())) != {field.name for field in fields(Recipe)}:
            raise ValueError(f"{file} was written by an earlier version: choose another --out")
        recipe = Recipe(**summary["recipe"])
        of_run: dict[str, Any] = {
            "env": recipe.env_id,
            "algo": recipe.algo,
            "hyperparameters": recipe.source,
            "recipe": recipe.digest,
            "seed": recipe.seed,
            "timesteps": recipe.timesteps,
            "label": recipe.label,
            "folder": file.parent,
        }
        of_run |= {name: summary[name] for name in ("updates", "resumed", "training_minutes", "time_per_update_us")}
        rows += [{**of_run, "parameter": name, **scores} for name, scores in summary["scores"].items()]
    if not rows:
        return pd.DataFrame()
    runs = pd.DataFrame(rows)
    recipes = runs.groupby(["env", "label"])["recipe"].transform("nunique")
    runs["label"] = runs["label"].where(recipes == 1, runs["label"] + " " + runs["recipe"])
    order = ["env", "parameter", "algo", "hyperparameters", "recipe", "seed"]
    return runs.sort_values(order, ascending=[name != "hyperparameters" for name in order], ignore_index=True)


def _made_by(runs: pd.DataFrame) -> dict[str, Any]:
    # each recipe once, with the seeds that were run
    recipes: dict[str, Any] = {}
    for _, of_run in runs.drop_duplicates("folder").iterrows():
        summary = json.loads((of_run["folder"] / "summary.json").read_text(encoding="utf-8"))
        recipe = summary["recipe"]
        seed = {"seed": recipe.pop("seed"), "resumed": summary["resumed"], "versions": summary["versions"]}
        recipes.setdefault(of_run["recipe"], {**recipe, "runs": []})["runs"].append(seed)
    return {"recipes": recipes}


def report(out: Path) -> str:
    """
    Write the table of all finished runs in a folder (CSV, markdown) and, for each environment, figures with their data. Where
    an algorithm has several seeds the first one is drawn as the paper's figure.

    :param out: folder of all results
    :return: the table in markdown
    """
    runs = finished_runs(out)
    tables = []
    for (env_id, name_of_parameter), of_env in runs.groupby(["env", "parameter"]):
        parameters, parameter = parameters_of(str(env_id)), str(name_of_parameter)
        metric = _metric(parameter, parameters)
        inferred: dict[str, pd.DataFrame] = {}
        curves: dict[str, list[pd.DataFrame]] = {}
        histories: dict[tuple[str, int], pd.DataFrame] = {}
        for label, of_label in of_env.groupby("label", sort=False):
            name = str(label)
            inferred[name] = pd.read_csv(of_label["folder"].iloc[0] / "scores.csv")
            histories_of_label = [pd.read_csv(folder / "calibration.csv") for folder in of_label["folder"]]
            curves[name] = [
                table.rename(columns={metric: "mape_percent", f"{metric}_worst": "mape_percent_worst"})
                for table in histories_of_label
            ]
            histories |= {(name, seed): line for seed, line in zip(of_label["seed"], curves[name], strict=True)}
        exact = evaluate(ClosedForm(), held_out_trajectories(str(env_id)))
        row = {"env": env_id, "parameter": parameter, "algo": "closed form", "label": "closed form"}
        row |= summarize(exact, parameter)
        row["time_per_update_us"] = 1e6 * float(exact["time_per_update_s"].iloc[0])
        tables += [of_env, pd.DataFrame([row])]

        stem, made_by = str(env_id) if len(parameters) == 1 else f"{env_id}_{parameter}", _made_by(of_env)
        save_figure(plot_true_against_inferred(inferred, parameter), out / f"{stem}_inferred.png")
        columns = ["load", parameter, f"{parameter}_hat", f"{parameter}_spread", f"{parameter}_mape_percent"]
        points = pd.concat({name: scores[columns] for name, scores in inferred.items()}, names=["algo", "trajectory"])
        write_csv(out / f"{stem}_inferred.csv", points.reset_index(), made_by)
        save_figure(plot_learning_curves(curves, stem), out / f"{stem}_learning.png")
        history = pd.concat(histories, names=["algo", "seed"]).droplevel(-1)
        write_csv(out / f"{stem}_learning.csv", history.reset_index(), made_by)
    table = pd.concat(tables, ignore_index=True)
    write_csv(out / "compare.csv", table.drop(columns=["label", "folder"]), _made_by(runs))
    markdown = _markdown(table)
    write_text(out / "compare.md", markdown)
    return markdown


def _markdown(table: pd.DataFrame) -> str:
    # mean over seeds, with the spread (standard deviation) where there are several
    def over_seeds(values: pd.Series) -> str:
        spread = f" ± {values.std():.1g}" if len(values) > 1 else ""
        return f"{two_digits(values.mean())}{spread}"

    def two_digits(value: float) -> str:
        return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"

    lines = []
    for (env_id, parameter, label), group in table.groupby(["env", "parameter", "label"], sort=False):
        learned = label != "closed form"
        lines.append(
            {
                "environment": env_id,
                "parameter": parameter,
                "calibrator": label,
                "recipe": group["recipe"].iloc[0] if learned else "",
                "steps": f"{group['timesteps'].iloc[0]:.0f}" if learned else "",
                "seeds": str(len(group)) if learned else "",
                "MAPE (%)": over_seeds(group["mape_percent"]),
                "worst discharge (%)": two_digits(group["mape_worst_percent"].max()),
                "bias (%)": over_seeds(group["bias_percent"]),
                "spread (%)": over_seeds(group["spread_percent"]),
                "end of discharge (%)": over_seeds(group["eod_error_percent"]),
                "time per estimate (us)": f"{group['time_per_update_us'].mean():.2g}",
                "training (min)": f"{group['training_minutes'].mean():.1f}" if learned else "",
            }
        )
    text = pd.DataFrame(lines).to_markdown(index=False, disable_numparse=True) + "\n"
    resumed = table[table["resumed"] > 0].drop_duplicates("folder")
    if len(resumed) > 0:
        text += "\nInterrupted and continued from a checkpoint, with other random numbers than an uninterrupted run has:\n\n"
    for _, of_run in resumed.iterrows():
        times = "once" if of_run["resumed"] == 1 else f"{of_run['resumed']:.0f} times"
        text += f"- {of_run['label']} on {of_run['env']}, seed {of_run['seed']:.0f}: {times}\n"
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.compare", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--algos", nargs="+", default=["lac", "sac", "td3"], help="off-policy algorithms of the RL Zoo, or lac"
    )
    parser.add_argument("--envs", nargs="+", default=["BatteryRo-v0", "BatteryQmax-v0"], help="full-state environments")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument(
        "--timesteps",
        type=float,
        help=f"environment steps of each run; those of zoo_configs by default, {DEFAULTS_TIMESTEPS} with --defaults",
    )
    parser.add_argument(
        "--defaults", action="store_true", help="the algorithms' own hyperparameters and one environment, not zoo_configs"
    )
    parser.add_argument("--evaluations", type=int, default=10, help="evaluations and checkpoints during each run")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="runs at the same time, one core each")
    parser.add_argument("--out", type=Path, default=Path("results/compare"))
    chosen = parser.parse_args(arguments)
    if not (chosen.timesteps is None or chosen.timesteps >= 1) or chosen.evaluations < 1 or chosen.jobs < 1:
        parser.error("--timesteps, --evaluations and --jobs must be at least 1")
    try:
        finished_runs(chosen.out)
        for env_id in chosen.envs:
            parameters_of(env_id)
        recipes = [
            Recipe.of(
                algo,
                env_id,
                seed,
                None if chosen.timesteps is None else int(chosen.timesteps),
                defaults=chosen.defaults,
                evaluations=chosen.evaluations,
            )
            for env_id in dict.fromkeys(chosen.envs)
            for seed in dict.fromkeys(chosen.seeds)
            for algo in dict.fromkeys(chosen.algos)
        ]
    except (ValueError, FileNotFoundError, gym.error.Error) as error:
        parser.error(str(error))
    jobs = [(recipe, chosen.out, 1 + k % chosen.jobs) for k, recipe in enumerate(recipes)]
    try:
        run_all(run, jobs, chosen.jobs)
    except KeyboardInterrupt:
        sys.exit(f"\nInterrupted; what is done lies in {chosen.out}, and the same command goes on from there.")
    sys.stdout.write("\n" + report(chosen.out))


if __name__ == "__main__":
    main()
