"""
Train LAC, SAC and TD3 on the battery tasks through Stable-Baselines3's own callbacks, and compare what they infer on
held-out discharges with each other and with the closed form.

.. code-block:: bash

  python -m benchmarks.compare --algos lac sac td3 --envs BatteryRo-v0 BatteryQmax-v0 --seeds 0 --timesteps 200000

Hyperparameters are those of ``zoo_configs``. Every run has a folder of its own; a run that is finished is not run again, and
an interrupted one goes on from its last checkpoint when the same command is given again. The table and the figures show all
finished runs in the folder, so that runs can be added. TensorBoard logs lie in
``<out>/tensorboard/<env>/<ALGO>_seed<k>``, so that the algorithms overlay.
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
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import tqdm

from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.task import Parameter
from battery_env.calibration.variants import FullStateEnv
from battery_env.estimators.closed_form import ClosedForm
from battery_env.evaluation import evaluate, summarize
from battery_env.plotting import plot_learning_curves, plot_true_against_inferred, save_figure
from battery_env.trajectories import TrajectoryDataset
from benchmarks.reporting import write_csv, write_text
from benchmarks.training import run_all, set_up
from sb3_lac import CalibrationCallback

_EVALUATION_TRAJECTORIES = 64  # of the test part, evenly spaced, while training; all of them at the end
_EVALUATION_EPISODES = 20


class CheckpointCallback(BaseCallback):
    """
    Saves model and replay buffer in one folder that is replaced as a whole, so that a training can be resumed whenever it is
    interrupted.

    :param folder: the folder
    :param save_freq: calls between checkpoints
    """

    def __init__(self, folder: Path, save_freq: int) -> None:
        super().__init__()
        self.folder = folder
        self.save_freq = save_freq

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
    """
    return PolicyEstimator.environment(env_id).task.parameters


def held_out_trajectories(env_id: str) -> TrajectoryDataset:
    """
    The discharges that no policy has seen.

    :param env_id: id of a full-state environment
    :return: the test part of its data set
    :raises ValueError: for another environment
    """
    env = PolicyEstimator.environment(env_id, split="test")
    if not isinstance(env, FullStateEnv):
        raise ValueError(f"{env_id} is no full-state environment; voltage-only ones are compared by benchmarks.voltage")
    return env.dataset


def run(algo: str, env_id: str, seed: int, timesteps: int, evaluations: int, out: Path, position: int = 0) -> None:
    """
    Train one policy and score it on all test trajectories. Does nothing if that has been done, and goes on from the last
    checkpoint if it was interrupted.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of the environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param evaluations: how often to evaluate, and to save a checkpoint, in between
    :param out: folder of all results
    :param position: line of the terminal for the progress bar
    :raises ValueError: if the folder of the run holds one with another number of steps
    """
    folder = out / env_id / f"{algo}_seed{seed}"
    summary_file, checkpoint = folder / "summary.json", folder / "checkpoint"
    if summary_file.exists():
        done = json.loads(summary_file.read_text())
        if done["timesteps"] != timesteps:
            raise ValueError(f"{folder} holds a run of {done['timesteps']} steps, not {timesteps}; choose another --out")
        return
    parameters, test = parameters_of(env_id), held_out_trajectories(env_id)
    CheckpointCallback.recover(checkpoint)
    resumed = (checkpoint / "model.zip").exists()
    clock = _Clock(folder / "training_seconds.json")

    manager, model, hyperparameters = set_up(
        algo,
        env_id,
        seed,
        timesteps,
        folder / "zoo",
        eval_env_kwargs={"split": "test"},
        trained_agent=str(checkpoint / "model.zip") if resumed else "",
    )
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation_env = manager.create_envs(n_envs=1, eval_env=True, no_log=True)
    model.set_logger(configure(str(out / "tensorboard" / env_id / f"{algo.upper()}_seed{seed}"), ["tensorboard"]))

    every = max(timesteps // (evaluations * manager.n_envs), 1)
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
        clock,
        CheckpointCallback(checkpoint, every),
        ProgressCallback(f"{env_id} {algo} seed {seed}", timesteps, calibration, position),
    ]
    model.learn(timesteps - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
    model.save(folder / "model")

    scores = evaluate(PolicyEstimator(model, env_id), test)
    configuration = {"algo": algo, "env": env_id, "seed": seed, "timesteps": timesteps}
    configuration["hyperparameters"] = dict(hyperparameters)
    write_csv(folder / "scores.csv", scores, configuration)
    result = {"env": env_id, "algo": algo, "seed": seed, "timesteps": timesteps, "updates": model._n_updates}
    result["training_minutes"] = clock.seconds / 60.0
    result["time_per_update_us"] = 1e6 * float(scores["time_per_update_s"].iloc[0])
    result["scores"] = {name: summarize(scores, name) for name in parameters}
    write_text(summary_file, json.dumps(result, indent=2) + "\n")
    shutil.rmtree(checkpoint, ignore_errors=True)


def _metric(parameter: str, parameters: Sequence[str]) -> str:
    # as it is called in TensorBoard and in files: by its parameter only where there are two
    return "mape_percent" if len(parameters) == 1 else f"{parameter}_mape_percent"


class _Clock(BaseCallback):
    # wall time of the training, evaluations included, over interruptions
    def __init__(self, file: Path) -> None:
        super().__init__()
        self.file = file
        self.seconds = float(json.loads(file.read_text())) if file.exists() else 0.0

    def _on_training_start(self) -> None:
        self.last = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        now = time.perf_counter()
        self.seconds, self.last = self.seconds + now - self.last, now
        if self.n_calls % 500 == 0:
            write_text(self.file, json.dumps(self.seconds))


def report(out: Path, configuration: dict[str, Any]) -> str:
    """
    Write the table of all finished runs in a folder (CSV, markdown) and, for each environment, figures with their data. Where
    an algorithm has several seeds the first one is drawn as the paper's figure.

    :param out: folder of all results
    :param configuration: what was chosen on the command line
    :return: the table in markdown
    """
    runs = _rows(sorted(out.glob("*/*/summary.json")))
    tables = []
    for (env_id, name_of_parameter), of_env in runs.groupby(["env", "parameter"]):
        parameters, parameter = parameters_of(str(env_id)), str(name_of_parameter)
        metric = _metric(parameter, parameters)
        inferred: dict[str, pd.DataFrame] = {}
        curves: dict[str, list[pd.DataFrame]] = {}
        histories: dict[tuple[str, int], pd.DataFrame] = {}
        for algo, of_algo in of_env.groupby("algo"):
            name = str(algo).upper()
            folders = [out / str(env_id) / f"{algo}_seed{seed}" for seed in of_algo["seed"]]
            inferred[name] = pd.read_csv(folders[0] / "scores.csv")
            histories_of_algo = [pd.read_csv(folder / "calibration.csv") for folder in folders]
            curves[name] = [
                table.rename(columns={metric: "mape_percent", f"{metric}_worst": "mape_percent_worst"})
                for table in histories_of_algo
            ]
            histories |= {(name, seed): line for seed, line in zip(of_algo["seed"], curves[name], strict=True)}
        exact = evaluate(ClosedForm(), held_out_trajectories(str(env_id)))
        row = {"env": env_id, "parameter": parameter, "algo": "closed form", **summarize(exact, parameter)}
        row["time_per_update_us"] = 1e6 * float(exact["time_per_update_s"].iloc[0])
        tables += [of_env, pd.DataFrame([row])]

        stem = str(env_id) if len(parameters) == 1 else f"{env_id}_{parameter}"
        save_figure(plot_true_against_inferred(inferred, parameter), out / f"{stem}_inferred.png")
        columns = ["load", parameter, f"{parameter}_hat", f"{parameter}_spread", f"{parameter}_mape_percent"]
        points = pd.concat({algo: scores[columns] for algo, scores in inferred.items()}, names=["algo", "trajectory"])
        write_csv(out / f"{stem}_inferred.csv", points.reset_index(), configuration)
        save_figure(plot_learning_curves(curves, stem), out / f"{stem}_learning.png")
        history = pd.concat(histories, names=["algo", "seed"]).droplevel(-1)
        write_csv(out / f"{stem}_learning.csv", history.reset_index(), configuration)
    table = pd.concat(tables, ignore_index=True)
    write_csv(out / "compare.csv", table, configuration)
    markdown = _markdown(table)
    write_text(out / "compare.md", markdown)
    return markdown


def _rows(files: Iterable[Path]) -> pd.DataFrame:
    # one row per run and parameter
    rows = []
    for file in files:
        run = json.loads(file.read_text(encoding="utf-8"))
        if "scores" not in run:
            raise ValueError(f"{file} was written by an earlier version: choose another --out")
        scores = run.pop("scores")
        rows += [{**run, "parameter": parameter, **of_parameter} for parameter, of_parameter in scores.items()]
    return pd.DataFrame(rows)


def _markdown(table: pd.DataFrame) -> str:
    # mean over seeds, with the spread (standard deviation) where there are several
    def over_seeds(values: pd.Series) -> str:
        spread = f" ± {values.std():.1g}" if len(values) > 1 else ""
        return f"{two_digits(values.mean())}{spread}"

    def two_digits(value: float) -> str:
        return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"

    lines = []
    for (env_id, parameter, algo), group in table.groupby(["env", "parameter", "algo"], sort=False):
        learned = algo != "closed form"
        lines.append(
            {
                "environment": env_id,
                "parameter": parameter,
                "calibrator": str(algo).upper() if learned else algo,
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
    return pd.DataFrame(lines).to_markdown(index=False, disable_numparse=True) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__.splitlines()[1])
    parser.add_argument("--algos", nargs="+", default=["lac", "sac", "td3"], choices=["lac", "sac", "td3"])
    parser.add_argument("--envs", nargs="+", default=["BatteryRo-v0", "BatteryQmax-v0"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--timesteps", type=float, default=2e5, help="environment steps of each run")
    parser.add_argument("--evaluations", type=int, default=10, help="evaluations and checkpoints during each run")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="runs at the same time, one core each")
    parser.add_argument("--out", type=Path, default=Path("results/compare"))
    chosen = parser.parse_args(arguments)
    if chosen.timesteps < 1 or chosen.evaluations < 1 or chosen.jobs < 1:
        parser.error("--timesteps, --evaluations and --jobs must be at least 1")
    runs = [
        (algo, env_id, seed, int(chosen.timesteps), chosen.evaluations, chosen.out)
        for env_id in chosen.envs
        for seed in chosen.seeds
        for algo in chosen.algos
    ]
    try:
        run_all(run, [(*job, 1 + k % chosen.jobs) for k, job in enumerate(runs)], chosen.jobs)
    except KeyboardInterrupt:
        sys.exit(f"\nInterrupted; what is done lies in {chosen.out}, and the same command goes on from there.")
    configuration = {name: value for name, value in vars(chosen).items() if name not in ("jobs", "out")}
    sys.stdout.write("\n" + report(chosen.out, configuration))


if __name__ == "__main__":
    main()
