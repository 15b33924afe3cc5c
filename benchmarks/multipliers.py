"""
What alpha3 and lambda_max do: LAC with a grid of both, on the three cost environments.

.. code-block:: bash

  python -m benchmarks.multipliers

For each combination: the cost of the policy, where lambda and the entropy coefficient ended, and what ``evaluate_lyapunov``
says of the decrease condition, all of the mean action. lambda learns at the rate of everything else, its default: with a rate
of its own, its ratio to the entropy coefficient would say how fast each of them learns, and not what alpha3 does.
What is done is not done again when the command is repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from battery_env.evaluation import over_seeds
from battery_env.plotting import new_figure
from benchmarks.study import EVALUATION_SEED, Study, Tables, command_line, digits, markdown, natural
from benchmarks.training import train_or_load
from sb3_lac import LAC, evaluate_lyapunov

_TIMESTEPS = {"LinearCost-v0": 3_000, "CartPoleCost-v0": 10_000, "Oscillator-v0": 8_000}
_EPISODES = 20
_LAMBDA_RANGE = 1e-4  # lambda_min / lambda_max as by default: lambda has the same room to fall below each limit


def part(env_id: str, alpha3: float, lambda_max: float, seed: int, timesteps: int, models: Path) -> Tables:
    """Train and evaluate one policy."""
    hyperparameters = {
        "alpha3": alpha3,
        "lambda_min": _LAMBDA_RANGE * lambda_max,
        "lambda_max": lambda_max,
        "lambda_init": lambda_max,
    }
    folder = models / f"{env_id}_alpha3_{alpha3:g}_lambda_max_{lambda_max:g}_seed{seed}"
    model = train_or_load("lac", env_id, seed, timesteps, folder, hyperparameters)
    assert isinstance(model, LAC)
    env = Monitor(gym.make(env_id))
    env.reset(seed=EVALUATION_SEED)
    returns, lengths = evaluate_policy(model, env, _EPISODES, return_episode_rewards=True)
    assert isinstance(returns, list) and isinstance(lengths, list)
    metrics = evaluate_lyapunov(
        model, gym.make(env_id), n_eval_episodes=_EPISODES, deterministic=True, seed=EVALUATION_SEED
    ).metrics
    assert model.log_ent_coef is not None
    row = {
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
    return {"multipliers": pd.DataFrame([row])}


def plot(results: pd.DataFrame) -> Figure:
    """
    One column per environment: cost (interquartile mean over seeds with its 95 % interval), and where lambda ended relative to
    its upper limit, over alpha3.
    """
    figure = new_figure(3.4 * results["env"].nunique(), 5.0)
    panels = figure.subplots(2, results["env"].nunique(), sharex=True, squeeze=False)
    for (upper, lower), (env_id, of_env) in zip(panels.T, results.groupby("env", sort=False), strict=True):
        for number, (lambda_max, group) in enumerate(of_env.groupby("lambda_max")):
            style = {"color": f"C{number}", "marker": "o", "ms": 4, "label": f"lambda_max = {lambda_max:g}"}
            seeds = group.pivot(index="seed", columns="alpha3", values="cost")
            cost, low, high = over_seeds(seeds)
            # Side by side, for the intervals overlap
            upper.errorbar(seeds.columns * 1.05**number, cost, np.nan_to_num([cost - low, high - cost]), capsize=3, **style)
            lower.plot((group["lambda"] / group["lambda_max"]).groupby(group["alpha3"]).median(), **style)
        upper.set(title=str(env_id), ylabel="cost per step, IQM and 95 %")
        lower.set(xlabel="alpha3", ylabel="lambda / lambda_max, median", yscale="log", xscale="log")
        upper.legend(frameon=False, fontsize="small")
    return figure


def report(results: pd.DataFrame) -> str:
    """What came out over seeds, as Markdown: interquartile means with their 95 % intervals, and medians of the multipliers."""

    def with_interval(values: pd.Series) -> str:
        middle, low, high = (digits(float(value), 3) for value in over_seeds(values))
        return f"{middle} [{low}, {high}]"

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
    return markdown(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("multipliers", __doc__)
    parser.add_argument("--envs", nargs="+", default=list(_TIMESTEPS), choices=list(_TIMESTEPS))
    parser.add_argument("--alpha3", nargs="+", type=float, default=[0.1, 0.3, 1.0])
    parser.add_argument("--lambda-max", nargs="+", type=float, default=[1.0])
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    study = Study(parser, arguments)
    chosen = study.chosen
    if min(*chosen.alpha3, *chosen.lambda_max) <= 0:
        parser.error("--alpha3 and --lambda-max must be greater than 0")
    study.configuration["timesteps"] = _TIMESTEPS
    parts = [
        {"env_id": env_id, "alpha3": alpha3, "lambda_max": lambda_max, "seed": seed, "timesteps": _TIMESTEPS[env_id]}
        for env_id in chosen.envs
        for seed in chosen.seeds
        for alpha3 in chosen.alpha3
        for lambda_max in chosen.lambda_max
    ]
    tables = study.run(part, parts, models=study.out / "models")
    results = tables["multipliers"]
    in_order = results.sort_values(["env", "alpha3", "lambda_max"])
    study.write(tables, {"multipliers": plot(results)}, report(in_order))


if __name__ == "__main__":
    main()
