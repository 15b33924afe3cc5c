"""
LAC beside SAC, TD3 and TQC on tasks of Gymnasium, which nobody here made or tuned for.

.. code-block:: bash

  python -m benchmarks.outside --jobs 2
  python -m benchmarks.outside --minutes 8 --jobs 16 --out rows
  python -m benchmarks.outside --tasks Hopper-v5 HalfCheetah-v5 --timesteps 100000 --algos lac sac --out outside_longer
  python -m benchmarks.outside --merge rows/runs.csv --redraw

Every algorithm has its defaults, but SAC, TD3 and TQC those settings of the RL Zoo that are tuned for a task with at most 50
thousand steps. ``lac_zoo`` is LAC on the car (MountainCarContinuous-v0) alone, with a square root and the RL Zoo's settings
of SAC there. ``lac_common`` is LAC with its one setting for control problems. The critics of ``lac_square_root`` and
``lac_fourth_root`` learn that root, and the weight of the entropy begins at 1 in ``lac_higher_start``, as SAC's does, and
at 0.1 in ``sac_lower_start``, as LAC's does. A policy is judged by its mean action, in 20 episodes that no training starts
with. A training that is done is a row of ``runs.csv``, which nothing but a change of what was run makes anew. The same
command goes on from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from scipy.stats import bootstrap
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from battery_env.plotting import coloured, draw_over_seeds
from benchmarks.control import roll_out
from benchmarks.runs import AT_THE_END, CURVE, Run, make_rows, rows_command_line, setting_of_lac
from benchmarks.study import Study, add_legend, digits, markdown, new_panels, with_interval

#: Environment steps of each task, the cheap ones first; the last one takes an hour and is trained only where it is named.
TASKS = {
    "Pendulum-v1": 20_000,
    "MountainCarContinuous-v0": 20_000,
    "InvertedPendulum-v5": 10_000,
    "InvertedDoublePendulum-v5": 20_000,
    "Reacher-v5": 10_000,
    "Pusher-v5": 10_000,
    "Hopper-v5": 20_000,
    "HalfCheetah-v5": 100_000,
}
_SQUARE_ROOT, _FOURTH_ROOT = ({"policy_kwargs": f"dict(root={root})"} for root in (2, 4))
#: Algorithms by their names on the command line: what readers call them, the class, and what differs from its defaults; None
#: is for those that are trained only where TUNED has settings.
ALGORITHMS: dict[str, tuple[str, str, dict[str, Any] | None]] = {
    "lac": ("LAC", "sb3_lac:LAC", {}),
    "published_lac": ("LAC as published", "sb3_lac:PublishedLAC", {}),
    "lac_common": ("LAC (root=4), its one setting", "sb3_lac:LAC", setting_of_lac(4)),
    "lac_zoo": ("LAC (root=2), SAC's settings of the car", "sb3_lac:LAC", None),
    "lac_square_root": ("LAC (root=2)", "sb3_lac:LAC", _SQUARE_ROOT),
    "lac_fourth_root": ("LAC (root=4)", "sb3_lac:LAC", _FOURTH_ROOT),
    "lac_higher_start": ("LAC (root=4), entropy from 1", "sb3_lac:LAC", {"ent_coef": "auto", **_FOURTH_ROOT}),
    "sac": ("SAC", "stable_baselines3:SAC", {}),
    "sac_lower_start": ("SAC, entropy from 0.1", "stable_baselines3:SAC", None),
    "td3": ("TD3", "stable_baselines3:TD3", {}),
    "tqc": ("TQC", "sb3_contrib:TQC", {}),
}
OURS = ("lac", "lac_square_root", "lac_fourth_root", "lac_zoo")
RIVALS = ("published_lac", "sac", "td3", "tqc")
_CAR = {
    "learning_rate": 3e-4,
    "buffer_size": 50_000,
    "batch_size": 512,
    "ent_coef": 0.1,
    "train_freq": 32,
    "gradient_steps": 32,
    "gamma": 0.9999,
    "tau": 0.01,
    "learning_starts": 0,
    "use_sde": True,
    "policy_kwargs": "dict(log_std_init=-3.67, net_arch=[64, 64], use_expln=True)",
}
_CAR_OF_LAC = {**_CAR, "policy_kwargs": "dict(log_std_init=-3.67, net_arch=[64, 64], use_expln=True, root=2)"}
#: Settings for a task: the RL Zoo's, where it tunes for at most 50 thousand steps, and those that test a cause.
TUNED: dict[str, dict[str, dict[str, Any]]] = {
    "Pendulum-v1": {
        "sac": {"learning_rate": 1e-3},
        "td3": {
            "gamma": 0.98,
            "buffer_size": 200_000,
            "learning_starts": 10_000,
            "noise_type": "normal",
            "noise_std": 0.1,
            "gradient_steps": 1,
            "train_freq": 1,
            "learning_rate": 1e-3,
            "policy_kwargs": "dict(net_arch=[400, 300])",
        },
        "tqc": {"learning_rate": 1e-3},
    },
    "MountainCarContinuous-v0": {"lac_zoo": _CAR_OF_LAC, "sac": _CAR, "tqc": _CAR},
    # Is the lead of LAC there that of its start?
    "HalfCheetah-v5": {"sac_lower_start": {"ent_coef": "auto_0.1"}},
}
EPISODES = 20


def run_of(task: str, algorithm: str, seed: int, timesteps: int | None = None) -> Run:
    """A training of this study."""
    _, kind, settings = ALGORITHMS[algorithm]
    return Run(task, algorithm, kind, seed, timesteps or TASKS[task], TUNED.get(task, {}).get(algorithm, settings or {}))


def mean_return(model: OffPolicyAlgorithm, run: Run) -> float:
    """Mean return of the held-out episodes."""
    outcome = roll_out(model, partial(gym.make, run.task), EPISODES)
    return -float((outcome["cost"] * outcome["length"]).mean())


def difference(scores: np.ndarray, rival_scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Difference of the mean scores."""
    return np.asarray(scores.mean(axis) - rival_scores.mean(axis))


def improvement(*scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    The probability that one of our scores is above one of the others' (Agarwal et al. 2021), mean over tasks, of ours and the
    others' scores of each task in turn.
    """
    of_tasks = []
    for own_scores, rival_scores in zip(scores[::2], scores[1::2], strict=True):
        gain = np.moveaxis(own_scores, axis, -1)[..., :, None] - np.moveaxis(rival_scores, axis, -1)[..., None, :]
        of_tasks.append((0.5 * (1.0 + np.sign(gain))).mean((-2, -1)))
    return np.mean(of_tasks, axis=0)


def _interval(statistic: Any, scores: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """With the 95 % interval of a bootstrap in which the scores of each task and algorithm are drawn by themselves."""
    middle = float(statistic(*scores))
    if min(map(len, scores)) < 2:
        return middle, np.nan, np.nan
    resampled = bootstrap(scores, statistic, vectorized=True, n_resamples=2000, method="percentile", random_state=0)
    return middle, float(resampled.confidence_interval.low), float(resampled.confidence_interval.high)


def comparison(rows: pd.DataFrame) -> pd.DataFrame:
    """LAC against each rival, on each task and on all that both have rows of."""
    scores = {key: group[AT_THE_END].to_numpy() for key, group in rows.groupby(["task", "algorithm"], sort=False)}
    rows_of_pairs = []
    for lac, rival in product(OURS, RIVALS):
        tasks = [task for task in TASKS if (task, lac) in scores and (task, rival) in scores]
        for task in tasks:
            pair = [scores[task, lac], scores[task, rival]]
            rows_of_pairs.append([task, lac, rival, *_interval(difference, pair), *_interval(improvement, pair)])
        if len(tasks) > 1:
            of_all = [scores[task, algorithm] for task in tasks for algorithm in (lac, rival)]
            rows_of_pairs.append(["all", lac, rival, *[np.nan] * 3, *_interval(improvement, of_all)])
    of_difference, of_probability = ([name, f"{name}_low", f"{name}_high"] for name in ("difference", "probability"))
    return pd.DataFrame(rows_of_pairs, columns=["task", "ours", "rival", *of_difference, *of_probability])


def report(rows: pd.DataFrame, compared: pd.DataFrame) -> str:
    """The returns and the comparison, as Markdown."""
    labels = {name: label for name, (label, *_) in ALGORITHMS.items() if name in set(rows["algorithm"])}
    returns = [
        {"task": task, "steps": str(task_rows["timesteps"].max()), "seeds": str(task_rows["seed"].nunique())}
        | {
            label: with_interval(own[AT_THE_END]) if len(own := task_rows[task_rows["algorithm"] == name]) else ""
            for name, label in labels.items()
        }
        for task, task_rows in rows.groupby("task", sort=False)
    ]
    cells = [
        {
            "task": row["task"],
            "LAC": ALGORITHMS[row["ours"]][0],
            "against": ALGORITHMS[row["rival"]][0],
            "difference of means": "" if row["task"] == "all" else _with_bounds(row, "difference"),
            "probability of improvement": _with_bounds(row, "probability"),
        }
        for row in compared.to_dict("records")
    ]
    text = "Return of the mean action at the end, interquartile mean over seeds with its 95 % interval, higher is better:\n\n"
    text += markdown(returns)
    if cells:
        text += "\nLAC against the others, with 95 % intervals; above 0, and above 0.5, LAC is ahead:\n\n"
        text += markdown(cells)
    return text


def _with_bounds(row: Mapping[Any, Any], name: str) -> str:
    middle, low, high = (digits(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return f"{middle} [{low}, {high}]"


def plot_learning(rows: pd.DataFrame) -> Figure:
    """The return of the mean action while policies are trained: interquartile mean over seeds, in a band of its interval."""
    tasks = list(rows["task"].unique())
    figure, panels = new_panels(len(tasks), 4, (3.1, 2.3), margin=(0.0, 0.4))
    for axes, task in zip(panels, tasks, strict=True):
        task_rows = rows[rows["task"] == task]
        for colour, (label, name) in coloured((label, name) for name, (label, *_) in ALGORITHMS.items()):
            own = task_rows[task_rows["algorithm"] == name]
            if len(own):
                steps = np.array(list(CURVE)) / 100 * own["timesteps"].iloc[0]
                draw_over_seeds(axes, steps, own[list(CURVE.values())], colour, label)
        axes.set_title(task, fontsize=10)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.25)
    for axes in panels[::4]:
        axes.set_ylabel("return")
    for axes in panels[-4:]:
        axes.set_xlabel("environment steps")
    add_legend(figure, panels, 6)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = rows_command_line("outside", __doc__, "those of TASKS")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS)[:-1], choices=list(TASKS))
    parser.add_argument("--algos", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    study = Study(parser, arguments)
    chosen = study.chosen
    in_order = sorted(chosen.tasks, key=list(TASKS).index)
    runs = [
        run_of(task, algorithm, seed, chosen.timesteps)
        for seed, task, algorithm in product(chosen.seeds, in_order, chosen.algos)
        if ALGORITHMS[algorithm][2] is not None or algorithm in TUNED.get(task, {})
    ]
    rows = make_rows(study, runs, mean_return)
    compared = comparison(rows)
    study.write({"comparison": compared}, {"learning": plot_learning(rows)}, report(rows, compared))


if __name__ == "__main__":
    main()
