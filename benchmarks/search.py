"""
Search the hyperparameters of LAC, SAC and TD3 on a full-state task: the same number of trials, updates and varied settings for
each algorithm, starting from the entry in ``zoo_configs``.

.. code-block:: bash

  python -m benchmarks.search --env BatteryQmax-v0 --trials 10 --updates 2400

A trial trains with the entry of ``zoo_configs``, changed where the search varies it. Its score is the mean error of the mean
action on whole discharges of the training part, the model running free; the test part is not touched. One seed says little:
the best three trials are trained twice more, with other seeds, and ranked by the mean of their three scores. Trials lie in a
journal of Optuna: after an interruption the same command goes on (with other trials than an uninterrupted search would try).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from battery_env.calibration.full_state import FullStateTask
from battery_env.calibration.policy import PolicyEstimator
from battery_env.evaluation import evaluate
from benchmarks.study import Study, Tables, command_line, positive, side_by_side
from benchmarks.training import Recipe, set_up, timesteps_of

_DISCHARGES = 64  # whole ones, evenly spaced in the training part
_WORST_ERROR = 100.0  # %, what a policy is given that does worse
_FINALISTS, _REPEATS = 3, 2  # the best trials, and how often each is trained again


def _sample_common(trial: Trial) -> dict[str, Any]:
    return {
        "learning_rate": f"lin_{trial.suggest_float('learning_rate', 3e-4, 3e-3, log=True):.2g}",
        "gamma": trial.suggest_categorical("gamma", [0.3, 0.6, 0.8, 0.9]),
        "tau": trial.suggest_categorical("tau", [0.005, 0.01, 0.02]),
    }


def _sample_soft(trial: Trial) -> dict[str, Any]:
    return {
        **_sample_common(trial),
        "ent_coef": f"auto_{trial.suggest_float('ent_coef', 0.005, 0.2, log=True):.2g}",
        "target_entropy": trial.suggest_categorical("target_entropy", [-2.0, -3.0, -4.0, -6.0]),
    }


def _sample_td3(trial: Trial) -> dict[str, Any]:
    target_noise = trial.suggest_float("target_policy_noise", 0.01, 0.2, log=True)
    return {
        **_sample_common(trial),
        "noise_std": float(f"{trial.suggest_float('noise_std', 0.1, 1.0, log=True):.2g}"),
        "target_policy_noise": float(f"{target_noise:.2g}"),
        "target_noise_clip": float(f"{2.0 * target_noise:.2g}"),
    }


#: What is varied, five settings for each algorithm.
SAMPLERS: dict[str, Callable[[Trial], dict[str, Any]]] = {"lac": _sample_soft, "sac": _sample_soft, "td3": _sample_td3}
#: The first trial of each, whatever it varies of this.
FIRST_TRIAL = {
    "learning_rate": 1e-3,
    "gamma": 0.6,
    "tau": 0.005,
    "ent_coef": 0.02,
    "target_entropy": -4.0,
    "noise_std": 0.5,
    "target_policy_noise": 0.05,
}


def score(algo: str, env_id: str, updates: int, folder: Path, trial: Trial) -> float:
    """
    Train one policy and score it.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of a full-state environment with one parameter
    :param updates: gradient steps
    :param folder: where the zoo writes what it does
    :param trial: what chooses the settings, and is told the median and the worst discharge
    :return: error of q_mobile or r_o, mean over whole discharges of the training part, %
    """
    recipe = Recipe.of(algo, env_id, trial.number, hyperparameters=SAMPLERS[algo](trial))
    _, model = set_up(recipe, folder)
    model.learn(timesteps_of(updates, recipe.hyperparameters))
    task = PolicyEstimator.environment(env_id).task
    assert isinstance(task, FullStateTask)
    discharges = task.dataset.subset(range(0, len(task.dataset), len(task.dataset) // _DISCHARGES))
    errors = evaluate(PolicyEstimator(model, env_id), discharges)[f"{task.parameters[0]}_mape_percent"]
    trial.set_user_attr("updates", model._n_updates)
    trial.set_user_attr("median_percent", float(errors.median()))
    trial.set_user_attr("worst_percent", float(errors.max()))
    return min(float(np.nan_to_num(errors.mean(), nan=_WORST_ERROR)), _WORST_ERROR)


def part(algo: str, env_id: str, trials: int, updates: int, out: Path) -> Tables:
    """
    The search of one algorithm, or what is left of it.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of a full-state environment with one parameter
    :param trials: trials in all
    :param updates: gradient steps of each
    :param out: folder of the journal
    :return: ``search``, one row per trial; means over its seeds, the worst discharge of any seed
    """
    out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name=f"{env_id} {algo} {updates} updates",
        storage=JournalStorage(JournalFileBackend(str(out / "journal.log"))),
        load_if_exists=True,
    )
    # another seed after an interruption, or the first draws would come again
    study.sampler = optuna.samplers.TPESampler(n_startup_trials=trials // 2, multivariate=True, seed=len(study.trials))
    if not study.trials:
        study.enqueue_trial(FIRST_TRIAL)
    objective = partial(score, algo, env_id, updates, out / "zoo")
    study.optimize(objective, n_trials=max(trials - len(_first_trials(study)), 0))
    finalists = sorted(_first_trials(study), key=lambda trial: trial.values[0])[:_FINALISTS]
    for finalist in finalists:
        for _ in range(_REPEATS - len(_repeats(study, finalist))):
            study.enqueue_trial(finalist.params, user_attrs={"repeats": finalist.number})
            study.optimize(objective, n_trials=1)
    rows = []
    for trial in _first_trials(study):
        runs = [trial, *_repeats(study, trial)]
        scores = {
            "seeds": len(runs),
            "mean_percent": np.mean([run.value for run in runs]),
            "median_percent": np.mean([run.user_attrs["median_percent"] for run in runs]),
            "worst_percent": max(run.user_attrs["worst_percent"] for run in runs),
            "all_mean_percent": side_by_side(run.values[0] for run in runs),
        }
        rows.append({"algo": algo, "trial": trial.number, "updates": updates, **scores, **trial.params})
    return {"search": pd.DataFrame(rows)}


def _first_trials(study: optuna.Study) -> list[FrozenTrial]:
    complete = study.get_trials(states=[TrialState.COMPLETE])
    return [trial for trial in complete if "repeats" not in trial.user_attrs]


def _repeats(study: optuna.Study, trial: FrozenTrial) -> list[FrozenTrial]:
    complete = study.get_trials(states=[TrialState.COMPLETE])
    return [run for run in complete if run.user_attrs.get("repeats") == trial.number]


def report(trials: pd.DataFrame) -> str:
    """
    The three best trials of each algorithm, with three seeds, and the first one, as Markdown.

    :param trials: of all algorithms
    :return: one table per algorithm
    """
    text = ""
    for algo, of_algo in trials.groupby("algo", sort=False):
        best = of_algo[of_algo["seeds"] > 1].sort_values("mean_percent")
        shown = pd.concat([best, of_algo[of_algo["trial"] == 0]]).drop_duplicates().dropna(axis=1, how="all")
        table = shown.drop(columns=["algo", "updates", "mean_percent"]).to_markdown(index=False, floatfmt=".2g")
        text += f"**{str(algo).upper()}**, {len(of_algo)} trials\n\n{table}\n\n"
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = command_line("search", __doc__)
    parser.add_argument("--env", default="BatteryQmax-v0", choices=["BatteryQmax-v0", "BatteryRo-v0"])
    parser.add_argument("--algos", nargs="+", default=list(SAMPLERS), choices=list(SAMPLERS))
    parser.add_argument("--trials", type=positive, default=10, help="trials of each algorithm")
    parser.add_argument("--updates", type=positive, default=2400, help="gradient steps of each trial")
    study = Study(parser, arguments)
    chosen = study.chosen
    common = {"env_id": chosen.env, "trials": chosen.trials, "updates": chosen.updates}
    tables = study.run(part, [{"algo": algo, **common} for algo in chosen.algos], out=study.out)
    study.write(tables, {}, report(tables["search"]))


if __name__ == "__main__":
    main()
