"""
Train algorithms on environments through Stable-Baselines3's own callbacks, and compare what they reach with each other and,
on the battery tasks, with calibrators that do not learn.

.. code-block:: bash

  python -m benchmarks.compare --envs BatteryQmax-v0 BatteryRo-v0 --seeds 0 1 2
  python -m benchmarks.compare --envs BatteryVoltageJoint-v0 --seeds 0 1 --out results/voltage
  python -m benchmarks.compare --defaults --out results/compare_defaults
  python -m benchmarks.compare --envs BatteryQmaxPaper-v0 --algos lac --hyperparams n_envs:1
  python -m benchmarks.compare --defaults --algos tqc my_package.my_module:MyAlgorithm --envs my_package.my_envs:MyEnv-v0

Algorithms are those of the RL Zoo, LAC, and classes of your own; environments are all that are registered, or that importing
the module before the colon registers. Hyperparameters and numbers of steps are those of ``zoo_configs``; with ``--defaults``,
those of ``ALGO("MlpPolicy", env_id)``. What ``--hyperparams`` names differs from them: for all, or with the name of an
algorithm or of an environment before it, as in ``sac.tau:0.02``, for that one.

Policies of full-state tasks are scored on all held-out discharges, from exact starts and from starts that are off, beside the
closed form; those of voltage-only tasks on the first 100, under two sensors, beside least squares and a Kalman filter that
read every second; and in all other environments by the returns of episodes with the mean action.

Every run has a folder of its own, named by its recipe: algorithm, environment, seed, steps, hyperparameters and version of
this project. A run that is finished is not run again; with another recipe it is. Every two minutes a run writes a checkpoint.
An interrupted run goes on from there when the same command is given again; it does not equal an uninterrupted one then, and
the table says so.
The tables and the figures show all finished runs in the folder, so that runs can be added, and name the recipe of each row;
the JSON files beside them spell the recipes out. ``tensorboard --logdir <out>/tensorboard`` shows the runs in common charts,
with the hyperparameters of all of them in one table.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from battery_env.callbacks import CALIBRATION_CHARTS, CalibrationCallback
from benchmarks.contests import EVALUATION_EPISODES, contest_of, recipes_of
from benchmarks.runs import Run, checkpoint_file, made_by, record_file, registered_id, train_or_load
from benchmarks.study import Study, Tables, command_line, markdown, natural, positive
from benchmarks.zoo_runs import DEFAULTS_TIMESTEPS, zoo_run
from sb3_lac import DashboardCallback, LyapunovCallback
from sb3_lac.cost_algorithm import CostAlgorithm


def part(algo: str, source: str, run: dict[str, Any], out: Path, evaluations: int) -> Tables:
    """Train one policy, unless that has been done, and score it; ``algo`` and ``source`` are for the table."""
    made_from = Run(**run)
    folder, contest = _folder(made_from, out), contest_of(made_from.task)
    every = max(made_from.timesteps // (evaluations * made_from.n_envs), 1)
    curve = folder / f"learning_{made_from.name}.csv"
    if not checkpoint_file(made_from, folder).exists() and not record_file(made_from, folder).exists():
        curve.unlink(missing_ok=True)  # what began and left no checkpoint left no curve

    def new_env() -> VecEnv:
        env = made_from.environments(1, **contest.options)
        env.seed(made_from.seed)
        return env

    env = new_env()
    about = {"env": made_from.task, "recipe": made_from.digest, "timesteps": made_from.timesteps, "source": source}
    callbacks: list[BaseCallback] = [
        CalibrationCallback(
            lambda candidate: contest.scores(candidate, env, brief=True), every, contest.metrics, curve, verbose=0
        ),
        EvalCallback(new_env(), n_eval_episodes=EVALUATION_EPISODES, eval_freq=every, verbose=0),
        DashboardCallback(CALIBRATION_CHARTS, {**run["settings"], **about}),
    ]
    if issubclass(made_from.type, CostAlgorithm):
        # from the same start states each time, which are not those of the training
        seed = made_from.seed + made_from.n_envs
        callbacks.append(LyapunovCallback(new_env(), None, EVALUATION_EPISODES, every, seed, verbose=0))
    log = f"{made_from.algorithm.replace(' ', '_')}_seed{made_from.seed}_{made_from.digest}"
    model = train_or_load(made_from, folder, callbacks=callbacks, log=out / "tensorboard" / contest.env_id / log)
    return {"scores": contest.scores(model, env), "learning": pd.read_csv(curve)}


def _folder(run: Run, out: Path) -> Path:
    return out / registered_id(run.task) / run.name


def finished_runs(study: Study) -> pd.DataFrame:
    """Collect the finished runs of a folder, one row per run, with its tables."""
    rows = []
    for arguments, tables in study.done(part):
        run = Run(**arguments["run"])
        record = made_by(run, _folder(run, study.out))
        rows.append(
            {
                "env": registered_id(run.task),
                "algo": arguments["algo"],
                "hyperparameters": arguments["source"],
                "recipe": run.digest,
                "seed": run.seed,
                # an algorithm with roll-outs of fixed length makes more than it is asked for
                "timesteps": record["timesteps"],
                "label": run.algorithm,
                **{name: record[name] for name in ("updates", "resumed", "training_minutes")},
                "made_by": record,
                "tables": tables,
            }
        )
    if not rows:
        return pd.DataFrame()
    runs = pd.DataFrame(rows)
    recipes = runs.groupby(["env", "label"])["recipe"].transform("nunique")
    runs["label"] = runs["label"].where(recipes == 1, runs["label"] + " " + runs["recipe"])
    order = ["env", "algo", "hyperparameters", "recipe", "seed"]
    return runs.sort_values(order, ascending=[name != "hyperparameters" for name in order], ignore_index=True)


def report(study: Study) -> None:
    """Write and show the tables of all finished runs in a folder and, for each environment, its figures with their data."""
    runs = finished_runs(study)
    if runs.empty:
        return
    tables_by_columns: dict[tuple[str, ...], list[pd.DataFrame]] = {}  # a table for readers for each set of columns
    tables = []
    for _, env_runs in runs.groupby("env"):
        for_readers, table = contest_of(env_runs["made_by"].iloc[0]["run"]["task"]).report(env_runs, study)
        tables.append(table)
        tables_by_columns.setdefault(tuple(for_readers.columns), []).append(for_readers)
    summary = pd.concat(tables, ignore_index=True)
    if len(summary) > 0:
        study.write_table("compare", summary, recipes_of(runs))
    texts = [markdown(pd.concat(of_columns)) for of_columns in tables_by_columns.values()]
    resumed = runs[runs["resumed"] > 0]
    if len(resumed) > 0:
        text = "Interrupted and continued from a checkpoint, with other random numbers than an uninterrupted run has:\n\n"
        for _, of_run in resumed.iterrows():
            times = "once" if of_run["resumed"] == 1 else f"{of_run['resumed']} times"
            text += f"- {of_run['label']} on {of_run['env']}, seed {of_run['seed']}: {times}\n"
        texts.append(text)
    study.write({}, {}, "\n".join(texts))


def _check(run: Run, out: Path) -> None:
    """Refuse what could not be trained or scored, before anything is."""
    if issubclass(run.type, RecurrentPPO):
        raise ValueError(f"{run.algorithm}: policies with a memory cannot be scored here")
    contest_of(run.task)
    if not record_file(run, _folder(run, out)).exists():
        try:
            with contextlib.closing(run.environments()) as env:
                run.model(env)
        except (AssertionError, TypeError, ValueError) as error:
            raise ValueError(f"{run.algorithm} on {run.task}: {error}") from error


def _differing(settings: Sequence[str]) -> defaultdict[str, dict[str, Any]]:
    """
    Hyperparameters by name, of each algorithm or environment that is named before a dot, and under ``""`` of all; what is no
    literal of Python is text, like ``lin_1e-3``.
    """
    hyperparameters: defaultdict[str, dict[str, Any]] = defaultdict(dict)
    for setting in settings:
        before, _, value = setting.partition(":")
        whose, _, name = before.rpartition(".")
        if not name or not value:
            raise ValueError(f"--hyperparams takes NAME:VALUE, like n_envs:1, got {setting}")
        try:
            hyperparameters[whose][name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            hyperparameters[whose][name] = value
    return hyperparameters


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("compare", __doc__)
    parser.add_argument(
        "--algos", nargs="+", default=["lac", "sac", "td3"], help="of the RL Zoo, or package.module:Class of your own"
    )
    parser.add_argument("--envs", nargs="+", default=["BatteryRo-v0", "BatteryQmax-v0"], help="ids, or module:id")
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0])
    parser.add_argument(
        "--timesteps",
        type=positive,
        help=f"environment steps of each run; those of zoo_configs by default, {DEFAULTS_TIMESTEPS} with --defaults",
    )
    parser.add_argument(
        "--defaults", action="store_true", help="the algorithms' own hyperparameters and one environment, not zoo_configs"
    )
    parser.add_argument(
        "--hyperparams",
        nargs="+",
        metavar="NAME:VALUE",
        default=[],
        help="what differs, like learning_rate:lin_1e-3, or sac.tau:0.02 for one algorithm or environment",
    )
    parser.add_argument("--evaluations", type=positive, default=10, help="evaluations during each run")
    study = Study(parser, arguments)
    chosen = study.chosen
    options = {"timesteps": chosen.timesteps, "defaults": chosen.defaults}
    source = "defaults" if chosen.defaults else "zoo_configs"
    try:
        differing = _differing(chosen.hyperparams)
        names = {name: name.rpartition(":")[2] for name in (*chosen.envs, *chosen.algos)}
        if unknown := differing.keys() - {"", *names.values()}:
            raise ValueError(f"--hyperparams has some of {', '.join(sorted(unknown))}, which is not compared")
        differ = {
            (algo, env_id): {**differing[""], **differing[names[env_id]], **differing[names[algo]]}
            for algo, env_id in itertools.product(chosen.algos, chosen.envs)
        }
        runs = [
            (algo, zoo_run(algo, env_id, seed, differing=differ[algo, env_id], **options))
            for env_id, seed, algo in itertools.product(chosen.envs, chosen.seeds, chosen.algos)
        ]
        for run in {run.digest: run for _, run in runs}.values():
            _check(run, study.out)
    except (ValueError, FileNotFoundError, gym.error.Error) as error:
        parser.error(str(error))
    try:
        parts = [{"algo": algo, "source": source, "run": asdict(run)} for algo, run in runs]
        study.run(part, parts, out=study.out, evaluations=chosen.evaluations)
    finally:
        report(study)  # of those that finished


if __name__ == "__main__":
    main()
