"""
A plant that changes: LAC, also with a square and with a fourth root, SAC and TQC, all with LAC's one setting, trained on
control problems that draw all of their disturbances anew for each episode.

.. code-block:: bash

  python -m benchmarks.changing_plant --jobs 2 --compile
  python -m benchmarks.changing_plant --envs CartPoleCost-v0 --last-actions 2 --compile

Parameters, pushes, noises and the delay of actions are drawn together, in ranges that hold what ``benchmarks.stabilisation``
tries policies with. They are judged by the same disturbances one at a time, and by one outside of each range. With
``--last-actions`` an observation tells them the last actions, too. A training that is done is a row of ``runs.csv``, as those
of ``benchmarks.outside`` are.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from battery_env.evaluation import over_seeds
from battery_env.plotting import coloured
from benchmarks import roots
from benchmarks.control import DISTURBANCES, IMPULSE_INTERVAL, conditions, one_at_a_time, roll_out, while_training
from benchmarks.runs import Run, make_rows, rows_command_line, setting_of_lac
from benchmarks.study import Study, add_legend, digits, markdown, natural, new_panels, table_of, with_interval
from sb3_lac.stability.plots import format_log_axis

#: By environment the parameter that is drawn, its range, and a value outside; the first three are trained by default.
PARAMETERS = {
    "VehicleCost-v0": ("friction", (0.5, 1.0), 0.4),
    "Oscillator-v0": ("protein_decay", (0.05, 0.07), 0.045),
    "CartPoleCost-v0": ("pole_half_length_m", (0.4, 1.0), 1.2),
    "QuadrotorCost-v0": ("mass_kg", (0.8, 1.2), 1.3),
    "PendulumCost-v0": ("mass_kg", (0.7, 1.4), 1.6),
    "LinearCost-v0": ("control_max", (1.0, 3.0), 0.75),
}
#: What is outside of the ranges of pushes and noises, in parts of their ends; delays are a step longer.
BEYOND = 1.5
TIMESTEPS = 30_000
ALGORITHMS = {**roots.ALGORITHMS, "tqc": ("TQC", "sb3_contrib:TQC", None)}
#: Whom they are compared with.
RIVALS = ("SAC", "TQC")
EPISODES = 100
#: LAC is level with a rival that costs at least so much of what it costs.
LEVEL = 0.98


def ranges_of(env_id: str) -> dict[str, tuple[float, float]]:
    """Ranges that each training episode samples from: up to what the published table of robustness tries policies with."""
    impulse, _, process_noise, observation_noise, delay = DISTURBANCES[env_id]
    name, ends, _ = PARAMETERS[env_id]
    largest = {"impulse": impulse, "process_noise": process_noise, "observation_noise": observation_noise}
    return {name: ends, **{each: (0.0, size) for each, size in largest.items()}, "action_delay": (0, delay)}


def outside(env_id: str) -> dict[str, dict[str, Any]]:
    """Disturbances beyond the ranges, one at a time."""
    impulse, _, process_noise, observation_noise, delay = DISTURBANCES[env_id]
    name, _, value = PARAMETERS[env_id]
    return one_at_a_time(BEYOND * impulse, {name: value}, BEYOND * process_noise, BEYOND * observation_noise, delay + 1)


def run_of(env_id: str, algorithm: str, seed: int, last_actions: int = 0, timesteps: int | None = None) -> Run:
    """A training of this study."""
    label, kind, root = ALGORITHMS[algorithm]
    environment = {"drawn": ranges_of(env_id), "impulse_interval": IMPULSE_INTERVAL}
    if last_actions:
        label, environment["last_actions"] = f"{label}, {last_actions} last actions", last_actions
    return Run(env_id, label, kind, seed, timesteps or TIMESTEPS, setting_of_lac(root), environment)


def cost_while_training(model: OffPolicyAlgorithm, run: Run) -> float:
    """A step of the plant that changes, as in the training."""
    return float(while_training(model, run.task, run.environment)["cost"])


def costs(model: OffPolicyAlgorithm, run: Run) -> dict[str, float]:
    """Cost per step, and share of episodes that die, under each disturbance within the ranges and outside."""
    last_actions = {name: value for name, value in run.environment.items() if name == "last_actions"}
    tried = {**conditions(run.task), **{f"outside: {name}": each for name, each in outside(run.task).items()}}
    results: dict[str, float] = {}
    for name, arguments in tried.items():
        outcome = roll_out(model, partial(gym.make, run.task, **arguments, **last_actions), EPISODES)
        results |= {name: outcome["cost"].mean(), f"died: {name}": outcome["died"].mean()}
    return results


def cost_table(rows: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Interquartile means over seeds with their intervals, and the share of episodes that die, if some do."""

    def cost_and_deaths(group: pd.DataFrame, name: str) -> str:
        died = group[f"died: {name}"].mean()
        return with_interval(group[name]) + (f" ({digits(100 * died, 1)} %)" if died > 0 else "")

    cells = {"seeds": lambda group: str(len(group))}
    cells |= {name.removeprefix("outside: "): partial(cost_and_deaths, name=name) for name in names}
    return table_of(rows, {"task": "environment", "algorithm": "policy"}, cells)


def cells_held(rows: pd.DataFrame, names: list[str], candidate: str) -> str:
    """In how many cells a kind of LAC is ahead of the best of the others that saw the same, or level with it."""
    _, comma, suffix = candidate.partition(",")
    n_held, n_cells = 0, 0
    for _, task_rows in rows.groupby("task", sort=False):
        by_name, algorithms = task_rows.groupby("algorithm"), set(task_rows["algorithm"])
        rivals = [rival for rival in (f"{name}{comma}{suffix}" for name in RIVALS) if rival in algorithms]
        if candidate in algorithms and rivals:
            lac, *rival_costs = (over_seeds(by_name.get_group(each)[names])[0] for each in (candidate, *rivals))
            n_held += int((LEVEL * lac <= np.min(rival_costs, axis=0)).sum())
            n_cells += len(names)
    return f"{candidate}: {n_held} of {n_cells}"


def plot(rows: pd.DataFrame, names: Sequence[str]) -> Figure:
    """The cost under each disturbance: interquartile means over seeds, and their intervals."""
    tasks = list(rows["task"].unique())
    figure, panels = new_panels(len(tasks), 3, (3.6, 3.6), margin=(0.6, 0.3))
    for axes, task in zip(panels, tasks, strict=True):
        task_rows = rows[rows["task"] == task]
        policies = list(task_rows["algorithm"].unique())
        for n, (colour, policy) in enumerate(coloured(policies)):
            middle, low, high = over_seeds(task_rows.loc[task_rows["algorithm"] == policy, list(names)])
            places = np.arange(len(names)) + 0.7 * (n + 0.5) / len(policies) - 0.35
            axes.hlines(places, low, high, color=colour, lw=1.4)
            axes.plot(middle, places, "o", color=colour, ms=4, label=policy)
        axes.set(title=task, xscale="log", xlabel="cost per step")
        format_log_axis(axes.xaxis)
        axes.set_yticks(range(len(names)), names if axes is panels[0] else [""] * len(names))
        axes.invert_yaxis()
        axes.grid(axis="x", alpha=0.25)
    add_legend(figure, panels, 3)
    return figure


def report(rows: pd.DataFrame, within: list[str], beyond: list[str]) -> str:
    """Two tables, as Markdown."""
    text = ""
    for where, names in (("Within the ranges of the training", within), ("Outside of them", beyond)):
        text += f"{where}: cost per step, interquartile mean over seeds with its 95 % interval, and the share of episodes\n"
        text += "that die. Cells in which LAC is ahead of the best of the others, or within 2 %:\n"
        lac_names = [name for name in rows["algorithm"].unique() if name.startswith("LAC")]
        text += f"{'; '.join(cells_held(rows, names, each) for each in lac_names)}.\n\n"
        text += markdown(cost_table(rows, names)) + "\n"
    return text.rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = rows_command_line("changing_plant", __doc__, str(TIMESTEPS))
    parser.add_argument("--envs", nargs="+", default=list(PARAMETERS)[:3], choices=list(PARAMETERS))
    parser.add_argument("--algos", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    parser.add_argument("--last-actions", nargs="+", type=natural, default=[0], help="how many of them policies see")
    study = Study(parser, arguments)
    chosen = study.chosen
    runs = [
        run_of(env_id, algorithm, seed, last_actions, chosen.timesteps)
        for seed, env_id, last_actions, algorithm in product(chosen.seeds, chosen.envs, chosen.last_actions, chosen.algos)
    ]
    study.configuration["drawn"] = {env_id: ranges_of(env_id) for env_id in chosen.envs}
    rows = make_rows(study, runs, cost_while_training, costs)
    within = list(conditions(chosen.envs[0]))
    beyond = [f"outside: {name}" for name in outside(chosen.envs[0])]
    study.write({}, {"costs": plot(rows, [*within, *beyond])}, report(rows, within, beyond))


if __name__ == "__main__":
    main()
