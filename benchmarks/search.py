"""
Search the hyperparameters of LAC, SAC, TD3 and TQC on a full-state task or a cost environment: the same number of trials,
updates and varied settings for each algorithm, starting from the entry in ``zoo_configs``.

.. code-block:: bash

  python -m benchmarks.search --env BatteryQmax-v0 --trials 10 --updates 2400
  python -m benchmarks.search --env PendulumCost-v0 --trials 6 --updates 4000 --finalists 2 --repeats 1 --exchange

A trial trains with the entry of ``zoo_configs``, changed where the search varies it, and is scored by its mean action. On a
full-state task that is its mean error on whole discharges of the training part, the model running free, and over both
parameters where there are two; the test part is not touched. On a cost environment it is the cost per step, from other starts
than those of the studies. One seed says little: the best trials, three by default, are trained again, twice by default, with
other seeds, and ranked by the mean of their scores.
With ``--exchange`` each algorithm also tries what the others found: its own best trial with the settings that it shares with
the best of another one, as often. A few trials find a good learning rate or not, and that is no merit of an algorithm.
Trials lie in a journal of Optuna: after an interruption the same command goes on (with other trials than an uninterrupted
search would try).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pandas as pd
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState
from stable_baselines3.common.base_class import BaseAlgorithm

from battery_env.evaluation import evaluate
from battery_env.policies.estimator import PolicyEstimator
from battery_env.tasks.full_state.task import FullStateTask
from benchmarks.control import DISTURBANCES, roll_out
from benchmarks.study import Study, Tables, command_line, positive, side_by_side
from benchmarks.training import Recipe, set_up

_DISCHARGES = 64  # whole ones, evenly spaced in the training part
_EPISODES, _SEED = 50, 20_000  # on a cost environment
_COMMON = ["learning_rate", "gamma", "tau"]
_SOFT = [*_COMMON, "ent_coef", "target_entropy"]
_TD3 = [*_COMMON, "noise_std", "target_policy_noise"]
_DONE_OR_TO_DO = [TrialState.COMPLETE, TrialState.WAITING]


@dataclass(frozen=True)
class Family:
    """
    Tasks that are searched alike.

    :param unit: of the scores, ends the names of their columns
    :param worst: what a policy is given that does worse
    :param scores: of a policy on a task, by id: one number for each discharge or episode, less is better
    :param ranges: of the settings that are varied: choices, or limits of a number that is drawn on a logarithmic scale
    :param varied: which of them, by algorithm, five for each
    :param learning_rate: how a learning rate is written
    :param first_trials: the settings of the first trials, chosen by hand
    :param of_easier: what an easier task needed, by algorithm, tried before these
    """

    unit: str
    worst: float
    scores: Callable[[BaseAlgorithm, str], pd.Series]
    ranges: dict[str, list[float] | tuple[float, float]]
    varied: dict[str, list[str]]
    learning_rate: str
    first_trials: list[dict[str, float]]
    of_easier: dict[str, dict[str, float]] = field(default_factory=dict)


def _errors(model: BaseAlgorithm, env_id: str) -> pd.Series:
    task = PolicyEstimator.environment(env_id).task
    assert isinstance(task, FullStateTask)
    discharges = task.dataset.subset(range(0, len(task.dataset), len(task.dataset) // _DISCHARGES))
    errors = evaluate(PolicyEstimator(model, env_id), discharges)
    return errors[[f"{name}_mape_percent" for name in task.parameters]].mean(axis=1)


def _costs(model: BaseAlgorithm, env_id: str) -> pd.Series:
    return roll_out(model, partial(gym.make, env_id), _EPISODES, seed=_SEED)["cost"]


_FULL_STATE = Family(
    "percent",
    100.0,
    _errors,
    {
        "learning_rate": (3e-4, 3e-3),
        "gamma": [0.3, 0.6, 0.8, 0.9],
        "tau": [0.005, 0.01, 0.02],
        "ent_coef": (0.005, 0.2),
        "target_entropy": [-2.0, -3.0, -4.0, -6.0],
        "noise_std": (0.1, 1.0),
        "target_policy_noise": (0.01, 0.2),
    },
    {"lac": _SOFT, "sac": _SOFT, "td3": _TD3},
    "lin_{:.2g}",
    [
        {
            "learning_rate": 1e-3,
            "gamma": 0.6,
            "tau": 0.005,
            "ent_coef": 0.02,
            "target_entropy": -4.0,
            "noise_std": 0.5,
            "target_policy_noise": 0.05,
        },
    ],
)
# As much entropy for each of two parameters; what q^max needed, LAC with the rate that it has had since.
_BOTH = replace(
    _FULL_STATE,
    ranges=_FULL_STATE.ranges | {"target_entropy": [-4.0, -6.0, -8.0, -12.0]},
    of_easier={
        "lac": {"learning_rate": 1e-3, "gamma": 0.6, "tau": 0.01, "ent_coef": 0.043, "target_entropy": -8.0},
        "sac": {"learning_rate": 2.8e-3, "gamma": 0.9, "tau": 0.005, "ent_coef": 0.0054, "target_entropy": -6.0},
        "td3": {"learning_rate": 1.9e-3, "gamma": 0.6, "tau": 0.01, "noise_std": 0.26, "target_policy_noise": 0.19},
    },
)
_COST = Family(
    "cost",
    1e6,
    _costs,
    {
        "learning_rate": (2e-4, 3e-3),
        "gamma": [0.9, 0.95, 0.98, 0.99],
        "tau": [0.005, 0.01, 0.02],
        "ent_coef": (0.01, 10.0),
        "target_entropy": [-1.0, -2.0, -4.0, -6.0],
        "noise_std": (0.05, 0.5),
        "target_policy_noise": (0.05, 0.5),
    },
    {"lac": _SOFT, "sac": _SOFT, "td3": _TD3, "tqc": _SOFT},
    "{:.2g}",
    [
        {
            "learning_rate": 5e-4,
            "gamma": 0.99,
            "tau": 0.005,
            "ent_coef": 0.1,
            "target_entropy": -2.0,
            "noise_std": 0.1,
            "target_policy_noise": 0.2,
        },
        {
            "learning_rate": 2.5e-3,
            "gamma": 0.99,
            "tau": 0.01,
            "ent_coef": 0.7,
            "target_entropy": -1.0,
            "noise_std": 0.3,
            "target_policy_noise": 0.3,
        },
    ],
)
#: By environment.
FAMILIES = {
    "BatteryQmax-v0": _FULL_STATE,
    "BatteryRo-v0": _FULL_STATE,
    "BatteryJoint-v0": _BOTH,
    **dict.fromkeys(DISTURBANCES, _COST),
}


def sampled(algo: str, env_id: str, trial: Trial) -> dict[str, Any]:
    """The settings of a trial."""
    family = FAMILIES[env_id]
    settings: dict[str, Any] = {}
    for name in family.varied[algo]:
        of_name = family.ranges[name]
        if isinstance(of_name, tuple):
            settings[name] = float(f"{trial.suggest_float(name, *of_name, log=True):.2g}")
        else:
            settings[name] = trial.suggest_categorical(name, of_name)
    text = family.learning_rate.format(settings["learning_rate"])
    settings["learning_rate"] = text if text.startswith("lin_") else float(text)
    if "ent_coef" in settings:
        settings["ent_coef"] = f"auto_{settings['ent_coef']:.2g}"
    if "target_policy_noise" in settings:
        settings["target_noise_clip"] = 2.0 * settings["target_policy_noise"]
    return settings


def score(algo: str, env_id: str, updates: int, folder: Path, trial: Trial) -> float:
    """Train one policy and score it."""
    family = FAMILIES[env_id]
    recipe = Recipe.of(algo, env_id, trial.number, updates=updates, hyperparameters=sampled(algo, env_id, trial))
    _, model = set_up(recipe, folder)
    model.learn(recipe.timesteps)
    scores = family.scores(model, env_id)
    trial.set_user_attr("updates", model._n_updates)
    trial.set_user_attr("median", float(scores.median()))
    trial.set_user_attr("worst", float(scores.max()))
    return min(float(np.nan_to_num(scores.mean(), nan=family.worst)), family.worst)


def part(
    algo: str,
    env_id: str,
    trials: int,
    updates: int,
    finalists: int,
    repeats: int,
    others: dict[str, dict[str, Any]],
    out: Path,
) -> Tables:
    """The search of one algorithm, or what is left of it."""
    out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name=f"{env_id} {algo} {updates} updates",
        storage=JournalStorage(JournalFileBackend(str(out / "journal.log"))),
        load_if_exists=True,
    )
    # another seed after an interruption, or the first draws would come again
    study.sampler = optuna.samplers.TPESampler(n_startup_trials=trials // 2, multivariate=True, seed=len(study.trials))
    family = FAMILIES[env_id]
    first_trials = [family.of_easier[algo], *family.first_trials] if algo in family.of_easier else family.first_trials
    # An interruption may have taken some of them
    kept = [trial.system_attrs.get("fixed_params") for trial in study.get_trials(states=_DONE_OR_TO_DO)]
    for first_trial in first_trials[:trials]:
        if first_trial not in kept:
            study.enqueue_trial(first_trial)
    objective = partial(score, algo, env_id, updates, out / "zoo")
    study.optimize(objective, n_trials=max(trials - len(_own_trials(study)), 0))
    best = sorted(_own_trials(study), key=lambda trial: trial.values[0])[:finalists]
    _train_again(study, objective, best, repeats)
    start = min(best, key=lambda trial: np.mean([run.value for run in _runs(study, trial)]))
    for other, settings in others.items():
        shared = {name: value for name, value in settings.items() if name in family.varied[algo]}
        of_other = {"settings_of": other, "settings": shared}
        if not _adopted(study, of_other):
            study.enqueue_trial(start.params | shared, user_attrs=of_other)
            study.optimize(objective, n_trials=1)
        _train_again(study, objective, _adopted(study, of_other), repeats)
    rows, unit = [], family.unit
    for trial in _first_trials(study):
        runs = _runs(study, trial)
        scores = {
            "seeds": len(runs),
            f"mean_{unit}": np.mean([run.value for run in runs]),
            f"median_{unit}": np.mean([run.user_attrs["median"] for run in runs]),
            f"worst_{unit}": max(run.user_attrs["worst"] for run in runs),
            f"all_mean_{unit}": side_by_side(run.values[0] for run in runs),
        }
        origin = trial.user_attrs.get("settings_of", algo)
        described = {"algo": algo, "trial": trial.number, "settings_of": origin, "updates": updates}
        rows.append({**described, **scores, **trial.params})
    return {"search": pd.DataFrame(rows)}


def _first_trials(study: optuna.Study) -> list[FrozenTrial]:
    complete = study.get_trials(states=[TrialState.COMPLETE])
    return [trial for trial in complete if "repeats" not in trial.user_attrs]


def _own_trials(study: optuna.Study) -> list[FrozenTrial]:
    return [trial for trial in _first_trials(study) if "settings_of" not in trial.user_attrs]


def _adopted(study: optuna.Study, of_other: dict[str, Any]) -> list[FrozenTrial]:
    return [trial for trial in _first_trials(study) if of_other.items() <= trial.user_attrs.items()]


def _runs(study: optuna.Study, trial: FrozenTrial) -> list[FrozenTrial]:
    # the trial and its repeats
    complete = study.get_trials(states=[TrialState.COMPLETE])
    return [trial, *(run for run in complete if run.user_attrs.get("repeats") == trial.number)]


def _train_again(
    study: optuna.Study, objective: Callable[[Trial], float], trials: Sequence[FrozenTrial], repeats: int
) -> None:
    for trial in trials:
        for _ in range(repeats + 1 - len(_runs(study, trial))):
            study.enqueue_trial(trial.params, user_attrs={**trial.user_attrs, "repeats": trial.number})
            study.optimize(objective, n_trials=1)


def report(trials: pd.DataFrame) -> str:
    """The best trials of each algorithm, trained with several seeds, and the first one, as Markdown."""
    text = ""
    mean = next(name for name in trials.columns if name.startswith("mean_"))
    for algo, of_algo in trials.groupby("algo", sort=False):
        best = of_algo[of_algo["seeds"] > 1].sort_values(mean)
        shown = pd.concat([best, of_algo[of_algo["trial"] == 0]]).drop_duplicates().dropna(axis=1, how="all")
        table = shown.drop(columns=["algo", "updates", mean]).to_markdown(index=False, floatfmt=".2g")
        text += f"**{str(algo).upper()}**, {len(of_algo)} trials\n\n{table}\n\n"
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("search", __doc__)
    parser.add_argument("--env", default="BatteryQmax-v0", choices=list(FAMILIES))
    parser.add_argument("--algos", nargs="+", default=["lac", "sac", "td3"], choices=list(_COST.varied))
    parser.add_argument("--trials", type=positive, default=10, help="trials of each algorithm")
    parser.add_argument("--updates", type=positive, default=2400, help="gradient steps of each trial")
    parser.add_argument("--finalists", type=positive, default=3, help="how many of the best trials are trained again")
    parser.add_argument("--repeats", type=positive, default=2, help="how often they are trained again")
    parser.add_argument("--exchange", action="store_true", help="try the best settings of the other algorithms too")
    study = Study(parser, arguments)
    chosen = study.chosen
    if unknown := set(chosen.algos) - set(FAMILIES[chosen.env].varied):
        parser.error(f"{', '.join(sorted(unknown))} cannot be searched on {chosen.env}")
    if chosen.exchange and len(set(chosen.algos)) < 2:
        parser.error("--exchange takes two algorithms or more: there is nobody to exchange settings with")
    common = {
        "env_id": chosen.env,
        "trials": chosen.trials,
        "updates": chosen.updates,
        "finalists": chosen.finalists,
        "repeats": chosen.repeats,
    }
    others: dict[str, dict[str, dict[str, Any]]] = {algo: {} for algo in chosen.algos}
    if chosen.exchange:
        found = _search(study, others, common)
        best = {algo: _best_settings(found[found["algo"] == algo], FAMILIES[chosen.env]) for algo in chosen.algos}
        others = {algo: {other: best[other] for other in chosen.algos if other != algo} for algo in chosen.algos}
    trials = _search(study, others, common)
    study.write({"search": trials}, {}, report(trials))


def _search(study: Study, others: dict[str, dict[str, dict[str, Any]]], common: dict[str, Any]) -> pd.DataFrame:
    parts = [{"algo": algo, **common, "others": of_others} for algo, of_others in others.items()]
    return study.run(part, parts, out=study.out)["search"]


def _best_settings(trials: pd.DataFrame, family: Family) -> dict[str, Any]:
    repeated = trials[trials["seeds"] > 1] if (trials["seeds"] > 1).any() else trials
    best = repeated.sort_values(f"mean_{family.unit}").iloc[0]
    return {name: float(best[name]) for name in family.ranges if name in best and not pd.isna(best[name])}


if __name__ == "__main__":
    main()
