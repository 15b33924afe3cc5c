"""
How well policies of LAC, SAC and TD3 stand what they were not trained for: impulses, other parameters, noisy measurements.

.. code-block:: bash

  python -m benchmarks.robustness

Policies are trained on ``CartPoleCost-v0`` and ``Oscillator-v0`` as they are, with the hyperparameters of ``zoo_configs``, and
then run under each condition. What is done is not done again when the command is repeated.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.evaluation import over_seeds
from battery_env.plotting import coloured, draw_over_seeds, new_figure
from benchmarks.control import roll_out
from benchmarks.study import Study, Tables, command_line, digits, markdown, natural, positive, with_spread
from benchmarks.training import train_or_load

_ALGORITHMS = ("lac", "sac", "td3")

# each study: environment, the arguments that vary with their values, and standard deviations of the noise on observations
STUDIES: dict[str, tuple[str, dict[str, tuple[float, ...]], tuple[float, ...]]] = {
    "impulse": ("CartPoleCost-v0", {"impulse_N": (0.0, 40.0, 80.0, 100.0, 120.0, 150.0)}, (0.0,)),
    "cart and pole": (
        "CartPoleCost-v0",
        {"cart_mass_kg": (0.5, 1.0, 2.0, 4.0), "pole_half_length_m": (0.25, 0.5, 1.0, 2.0)},
        (0.0,),
    ),
    "measurement noise": ("CartPoleCost-v0", {}, (0.0, 0.01, 0.03, 0.1)),
    "gene network": (
        "Oscillator-v0",
        {"light": (2.5, 5.0, 10.0), "protein_decay": (0.03, 0.06, 0.12)},
        (0.0,),
    ),
    "process noise": ("Oscillator-v0", {"process_noise": (0.0, 0.1, 0.3, 1.0)}, (0.0,)),
}


_LABELS = {
    "impulse_N": "impulse (N)",
    "cart_mass_kg": "mass of the cart (kg)",
    "pole_half_length_m": "half length of the pole (m)",
    "observation_noise": "noise on each observed variable",
    "light": "effect of light",
    "protein_decay": "decay rate of proteins",
    "process_noise": "noise on each state",
    "death_rate": "death rate",
    "cost": "cost per step",
}


def combinations(study: str) -> list[tuple[dict[str, Any], float]]:
    """All combinations of a study."""
    _, arguments, noises = STUDIES[study]
    grid = itertools.product(*arguments.values())
    return [(dict(zip(arguments, values, strict=True)), noise) for values in grid for noise in noises]


def part(algo: str, seed: int, timesteps: dict[str, int], episodes: int, models: Path) -> Tables:
    """Train a policy for each environment, and try it under all conditions."""
    rows = []
    for study, (env_id, _, _) in STUDIES.items():
        model = train_or_load(algo, env_id, seed, timesteps[env_id], models / f"{env_id}_{algo}_seed{seed}")
        for arguments, noise in combinations(study):
            outcome = roll_out(model, partial(gym.make, env_id, **arguments), episodes, noise)
            rows.append(
                {
                    "study": study,
                    "algo": algo.upper(),
                    "seed": seed,
                    **arguments,
                    "observation_noise": noise,
                    "death_rate": outcome["died"].mean(),
                    "cost": outcome["cost"].mean(),
                    "cost_worst": outcome["cost"].max(),
                }
            )
    return {"robustness": pd.DataFrame(rows)}


def varied(study: str) -> list[str]:
    """What varies in a study."""
    return [*STUDIES[study][1]] or ["observation_noise"]


def plot_lines(results: pd.DataFrame, studies: Sequence[tuple[str, str]]) -> Figure:
    """One panel per study: a metric over what varies, interquartile mean over seeds with its 95 % interval."""
    figure = new_figure(3.4 * len(studies), 3.0)
    for axes, (study, metric) in zip(figure.subplots(1, len(studies), squeeze=False)[0], studies, strict=True):
        column, of_study = varied(study)[0], results[results["study"] == study]
        for colour, (algo, of_algo) in coloured(of_study.groupby("algo")):
            seeds = of_algo.pivot(index="seed", columns=column, values=metric)
            draw_over_seeds(axes, seeds.columns, seeds, colour, str(algo), marker="o", ms=4)
        axes.set(xlabel=_LABELS[column], ylabel=_LABELS[metric])
        axes.legend(frameon=False, fontsize="small")
        axes.set_title(study)
        if metric == "cost":
            axes.set_yscale("log")
        else:
            axes.set_ylim(-0.03, 1.03)
    return figure


def plot_grid(results: pd.DataFrame, study: str, metric: str) -> Figure:
    """
    One map per algorithm: the interquartile mean over seeds of a metric over two parameters; in the titles of costs that over
    all conditions and seeds, with its 95 % interval.
    """
    results = results[results["study"] == study]
    row, column = varied(study)
    tables, titles = {}, {}
    for algo, of_algo in results.groupby("algo"):
        seeds = of_algo.pivot(index="seed", columns=[row, column], values=metric)
        tables[str(algo)] = pd.Series(over_seeds(seeds)[0], index=seeds.columns).unstack()
        overall = [digits(float(value)) for value in over_seeds(*(seeds[condition] for condition in seeds))]
        # most conditions kill nobody, and of all of them together an interquartile mean would say no more
        titles[str(algo)] = f"{algo}: {overall[0]} [{overall[1]}, {overall[2]}]" if metric == "cost" else str(algo)
    shown = {algo: table.map(np.log10) if metric == "cost" else table for algo, table in tables.items()}
    low, high = min(table.min().min() for table in shown.values()), max(table.max().max() for table in shown.values())
    if metric == "death_rate":
        low, high = 0.0, 1.0
    figure = new_figure(3.2 * len(tables), 3.0)
    for axes, (algo, table) in zip(figure.subplots(1, len(tables), squeeze=False)[0], tables.items(), strict=True):
        axes.imshow(shown[algo], origin="lower", aspect="auto", vmin=low, vmax=high, cmap="cividis_r")
        for i, j in np.ndindex(table.shape):
            dark = shown[algo].iloc[i, j] > (low + high) / 2
            axes.text(j, i, digits(table.iloc[i, j]), ha="center", va="center", color="white" if dark else "black", size=8)
        axes.set_xticks(range(table.shape[1]), [f"{value:g}" for value in table.columns])
        axes.set_yticks(range(table.shape[0]), [f"{value:g}" for value in table.index])
        axes.set(xlabel=_LABELS[column], ylabel=_LABELS[row], title=titles[algo])
    figure.suptitle(_LABELS[metric])
    return figure


def report(results: pd.DataFrame) -> str:
    """Mean and standard deviation over seeds, as Markdown."""

    text = ""
    for study, of_study in results.groupby("study", sort=False):
        columns = varied(str(study))
        metrics = ["death_rate", "cost"] if of_study["death_rate"].any() else ["cost"]
        table = of_study.pivot_table(index=columns, columns="algo", values=metrics, aggfunc=with_spread)[metrics]
        table.columns = [f"{algo}, {_LABELS[metric]}" for metric, algo in table.columns]
        text += f"**{study}** ({STUDIES[str(study)][0]}, {of_study['seed'].nunique()} seeds)\n\n"
        text += markdown(table.reset_index().rename(columns=_LABELS)) + "\n"
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("robustness", __doc__)
    parser.add_argument("--algos", nargs="+", default=list(_ALGORITHMS), choices=_ALGORITHMS)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--cart-pole-timesteps", type=positive, default=20_000, help="environment steps of each training")
    parser.add_argument("--oscillator-timesteps", type=positive, default=20_000, help="environment steps of each training")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes for each policy and condition")
    study = Study(parser, arguments)
    chosen = study.chosen
    timesteps = {"CartPoleCost-v0": chosen.cart_pole_timesteps, "Oscillator-v0": chosen.oscillator_timesteps}
    common = {"timesteps": timesteps, "episodes": chosen.episodes}
    parts = [{"algo": algo, "seed": seed, **common} for seed in chosen.seeds for algo in chosen.algos]
    tables = study.run(part, parts, models=study.out / "models")
    results = tables["robustness"]
    lines = [("impulse", "death_rate"), ("measurement noise", "cost"), ("process noise", "cost")]
    figures = {
        "disturbances": plot_lines(results, lines),
        "cart_and_pole": plot_grid(results, "cart and pole", "death_rate"),
        "gene_network": plot_grid(results, "gene network", "cost"),
    }
    study.write(tables, figures, report(results))


if __name__ == "__main__":
    main()
