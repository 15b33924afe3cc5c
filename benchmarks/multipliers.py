"""
What alpha3 and lambda_max do: LAC with a grid of both, on the three cost environments.

.. code-block:: bash

  python -m benchmarks.multipliers

For each combination: the cost of the policy, where lambda and the entropy coefficient ended, and what ``evaluate_lyapunov``
says of the decrease condition, all of the mean action. lambda learns at the rate of everything else, its default: with a rate
of its own, its ratio to the entropy coefficient would say how fast each of them learns, and not what alpha3 does.
A policy that is trained is not trained again when the command is repeated.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import ttest_1samp
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from battery_env.plotting import new_figure, save_figure
from benchmarks.reporting import write_csv, write_text
from benchmarks.training import run_all, train_or_load
from sb3_lac import LAC, evaluate_lyapunov

_EVALUATION_SEED = 10_000  # no training seed comes close
_TIMESTEPS = {"LinearCost-v0": 3_000, "CartPoleCost-v0": 10_000, "Oscillator-v0": 8_000}
_EPISODES = 20
_LAMBDA_RANGE = 1e-4  # lambda_min / lambda_max as by default: lambda has the same room to fall below each limit


def run(env_id: str, alpha3: float, lambda_max: float, seed: int, out: Path) -> dict[str, object]:
    """
    Train and evaluate one policy.

    :param env_id: id of the environment
    :param alpha3: see ``LAC``
    :param lambda_max: see ``LAC``, also the start of lambda
    :param seed: seed of the training
    :param out: folder of all results
    :return: what came out
    """
    hyperparameters = {
        "alpha3": alpha3,
        "lambda_min": _LAMBDA_RANGE * lambda_max,
        "lambda_max": lambda_max,
        "lambda_init": lambda_max,
    }
    folder = out / "models" / f"{env_id}_alpha3_{alpha3:g}_lambda_max_{lambda_max:g}_seed{seed}"
    model = train_or_load("lac", env_id, seed, _TIMESTEPS[env_id], folder, hyperparameters)
    assert isinstance(model, LAC)
    env = Monitor(gym.make(env_id))
    env.reset(seed=_EVALUATION_SEED)
    returns, lengths = evaluate_policy(model, env, _EPISODES, return_episode_rewards=True)
    assert isinstance(returns, list) and isinstance(lengths, list)
    metrics = evaluate_lyapunov(
        model, gym.make(env_id), n_eval_episodes=_EPISODES, deterministic=True, seed=_EVALUATION_SEED
    ).metrics
    assert model.log_ent_coef is not None
    return {
        "env": env_id,
        "alpha3": alpha3,
        "lambda_max": lambda_max,
        "seed": seed,
        # per step of the whole episode, so that an early death is not cheap
        "cost": -np.sum(returns) / np.sum(lengths),
        "death_rate": metrics["death_rate"].value,
        "lambda": float(model.log_lambda.detach().exp()),
        "ent_coef": float(model.log_ent_coef.detach().exp()),
        "decrease": metrics["decrease"].value,
        "condition_holds": metrics["decrease"].high < 0,
        "largest_feasible_alpha3": metrics["largest_feasible_alpha3"].value,
    }


def mean_interval(values: pd.Series) -> tuple[float, float, float]:
    """
    Mean over seeds with its 95 % interval, of Student's t distribution.

    :param values: one per seed
    :return: mean, and lower and upper end of the interval (NaN for a single seed)
    """
    if len(values) < 2:
        return float(values.mean()), float("nan"), float("nan")
    low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(values.mean()), float(low), float(high)


def plot(results: pd.DataFrame) -> Figure:
    """
    One column per environment: cost, and where lambda ended relative to its upper limit, over alpha3.

    :param results: see ``run()``, of all runs
    :return: the figure
    """
    figure = new_figure(3.4 * results["env"].nunique(), 5.0)
    panels = figure.subplots(2, results["env"].nunique(), sharex=True, squeeze=False)
    for (upper, lower), (env_id, of_env) in zip(panels.T, results.groupby("env", sort=False), strict=True):
        for number, (lambda_max, group) in enumerate(of_env.groupby("lambda_max")):
            style = {"color": f"C{number}", "marker": "o", "ms": 4, "label": f"lambda_max = {lambda_max:g}"}
            costs = pd.DataFrame({alpha3: mean_interval(values) for alpha3, values in group.groupby("alpha3")["cost"]}).T
            errors = [costs[0] - costs[1], costs[2] - costs[0]]
            # Side by side, for the intervals overlap
            upper.errorbar(costs.index * 1.05**number, costs[0], np.nan_to_num(errors), capsize=3, **style)
            lower.plot((group["lambda"] / group["lambda_max"]).groupby(group["alpha3"]).median(), **style)
        upper.set(title=str(env_id), ylabel="cost per step, mean and 95 %")
        lower.set(xlabel="alpha3", ylabel="lambda / lambda_max, median", yscale="log", xscale="log")
        upper.legend(frameon=False, fontsize="small")
    return figure


def report(results: pd.DataFrame) -> str:
    """
    What came out over seeds, as Markdown: means with their 95 % intervals, and medians of the multipliers.

    :param results: see ``run()``, of all runs
    :return: one table
    """

    def with_interval(values: pd.Series) -> str:
        return "{:.3g} [{:.3g}, {:.3g}]".format(*mean_interval(values))

    rows = [
        {
            "env": env_id,
            "alpha3": f"{alpha3:g}",
            "lambda_max": f"{lambda_max:g}",
            "cost per step": with_interval(group["cost"]),
            "death rate": f"{group['death_rate'].mean():.2g}",
            "lambda": f"{group['lambda'].median():.2g}",
            "lambda / ent_coef": f"{(group['lambda'] / group['ent_coef']).median():.3g}",
            "largest feasible alpha3": with_interval(group["largest_feasible_alpha3"]),
            "condition holds": f"{group['condition_holds'].sum()} of {len(group)}",
        }
        for (env_id, alpha3, lambda_max), group in results.groupby(["env", "alpha3", "lambda_max"], sort=False)
    ]
    return pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=list(_TIMESTEPS), choices=list(_TIMESTEPS))
    parser.add_argument("--alpha3", nargs="+", type=float, default=[0.1, 0.3, 1.0])
    parser.add_argument("--lambda-max", nargs="+", type=float, default=[1.0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="runs at the same time, one core each")
    parser.add_argument("--out", type=Path, default=Path("results/multipliers"))
    chosen = parser.parse_args(arguments)
    if chosen.jobs < 1 or min(*chosen.alpha3, *chosen.lambda_max) <= 0:
        parser.error("--jobs must be at least 1, --alpha3 and --lambda-max greater than 0")

    runs = [
        (env_id, alpha3, lambda_max, seed)
        for env_id in chosen.envs
        for seed in chosen.seeds
        for alpha3 in chosen.alpha3
        for lambda_max in chosen.lambda_max
    ]
    results = pd.DataFrame(run_all(partial(run, out=chosen.out), runs, chosen.jobs))
    configuration = {name: value for name, value in vars(chosen).items() if name not in ("jobs", "out")}
    write_csv(chosen.out / "multipliers.csv", results, {**configuration, "timesteps": _TIMESTEPS})
    save_figure(plot(results), chosen.out / "multipliers.png")
    text = report(results.sort_values(["env", "alpha3", "lambda_max"]))
    write_text(chosen.out / "multipliers.md", text)
    sys.stdout.write("\n" + text)


if __name__ == "__main__":
    main()
