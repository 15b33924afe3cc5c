"""
Does the unit of the cost matter? The same trainings with all rewards times a factor, judged in the unit of the environment.

.. code-block:: bash

  python -m benchmarks.cost_units --envs LinearCost-v0 QuadrotorCost-v0

A training that does not depend on the unit gives the same policy with every factor, up to rounding and to what its networks
start from. Hyperparameters are those of ``zoo_configs`` for a factor of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import pandas as pd
from matplotlib.figure import Figure

from battery_env.evaluation import over_seeds
from benchmarks.control import DISTURBANCES, roll_out
from benchmarks.stabilisation import CONTENDERS, STYLES
from benchmarks.study import Study, Tables, command_line, markdown, natural, new_panels, positive, with_interval
from benchmarks.training import train_or_load

_FACTORS = (0.01, 1.0, 100.0)


class ScaledReward(gym.RewardWrapper[Any, Any]):
    """Multiplies every reward by a factor."""

    def __init__(self, env: gym.Env[Any, Any], factor: float) -> None:
        super().__init__(env)
        self.factor = factor

    def reward(self, reward: SupportsFloat) -> float:
        """The reward in the other unit."""
        return self.factor * float(reward)


def part(algo: str, env_id: str, factor: float, seed: int, timesteps: int, episodes: int, models: Path) -> Tables:
    """Train a policy in one unit of the cost, and judge it in the environment's own."""
    wrapper = [{"benchmarks.cost_units.ScaledReward": {"factor": factor}}]
    folder = models / f"{env_id}_{algo}_{factor:g}_seed{seed}"
    model = train_or_load(algo, env_id, seed, timesteps, folder, hyperparameters={"env_wrapper": wrapper})
    outcome = roll_out(model, partial(gym.make, env_id), episodes)
    row = {"environment": env_id, "policy": CONTENDERS[algo].label, "factor": factor, "seed": seed}
    return {"cost_units": pd.DataFrame([{**row, "cost": outcome["cost"].mean(), "died": outcome["died"].mean()}])}


def report(results: pd.DataFrame) -> str:
    """The table, as Markdown."""
    costs = results.groupby(["environment", "policy", "factor"], sort=False)["cost"].apply(with_interval)
    table = costs.unstack("factor").rename(columns=lambda factor: f"rewards times {factor:g}").reset_index()
    unit = "Cost per step of the mean action, in the unit of the environment"
    return f"{unit}: interquartile mean over seeds with its 95 % interval.\n\n{markdown(table)}"


def plot(results: pd.DataFrame) -> Figure:
    """Cost over factor, one panel per environment: each seed, and the interquartile mean."""
    envs = list(results["environment"].unique())
    figure, panels = new_panels(len(envs), len(envs), (3.4, 2.6), margin=(0.0, 0.3))
    for axes, env_id in zip(panels, envs, strict=True):
        for number, (name, of_policy) in enumerate(results[results["environment"] == env_id].groupby("policy", sort=False)):
            colour, marker = STYLES[str(name)]
            costs = of_policy.pivot_table(index="seed", columns="factor", values="cost")
            places = costs.columns * 1.25 ** (2 * number - 1)
            for _, of_seed in costs.iterrows():
                axes.scatter(places, of_seed, s=9, color=colour, alpha=0.4, lw=0)
            axes.plot(places, over_seeds(costs)[0], marker=marker, ms=5, color=colour, label=str(name))
        axes.set(title=env_id, xscale="log", yscale="log", xlabel="rewards times", xticks=costs.columns)
    panels[0].set_ylabel("cost per step")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES), fontsize="small")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("cost_units", __doc__)
    parser.add_argument("--algos", nargs="+", default=["lac", "sac"], choices=["lac", "sac", "td3", "tqc"])
    parser.add_argument("--envs", nargs="+", default=["LinearCost-v0", "QuadrotorCost-v0"], choices=list(DISTURBANCES))
    parser.add_argument("--factors", nargs="+", type=float, default=list(_FACTORS))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[20, 21, 22, 23, 24])
    parser.add_argument("--timesteps", type=positive, default=15_000)
    parser.add_argument("--episodes", type=positive, default=100)
    study = Study(parser, arguments)
    chosen = study.chosen
    common = {"timesteps": chosen.timesteps, "episodes": chosen.episodes}
    parts = [
        {"algo": algo, "env_id": env_id, "factor": factor, "seed": seed, **common}
        for seed in chosen.seeds
        for env_id in chosen.envs
        for factor in chosen.factors
        for algo in chosen.algos
    ]
    tables = study.run(part, parts, models=study.out / "models")
    results = tables["cost_units"].sort_values(["environment", "policy", "factor", "seed"], ignore_index=True)
    study.write({"cost_units": results}, {"cost_units": plot(results)}, report(results))


if __name__ == "__main__":
    main()
