"""
Certificates of reference controllers, of the same with too little gain or the wrong sign, and of trained policies: a Lyapunov
function fitted to roll-outs, judged on others.

.. code-block:: bash

  python -m benchmarks.certificate
  python -m benchmarks.certificate --algos lac sac td3 --fractions 1 0.1
  python -m benchmarks.certificate --envs CartPoleCost-v0 --models sac=model.zip

Without algorithms and models only controllers are judged, which takes minutes and trains nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rl_zoo3 import ALGOS
from scipy.linalg import eigh
from stable_baselines3.common.type_aliases import PolicyPredictor
from tqdm import tqdm

from battery_env.plotting import COLOURS
from benchmarks.control import CERTIFICATE_ENVS, DISTURBANCES, SETTLED_SHARE, STATEMENTS, controllers, factors, judge
from benchmarks.study import Cell, Study, command_line, count_of, digits, markdown, natural, new_panels, table_of
from benchmarks.training import Recipe, train_or_load
from sb3_lac.envs import LinearCostEnv

_MEANING = (
    f"mean cost settles below (green: known to be below {SETTLED_SHARE:g} of the cost at the start; blue: below it; "
    "orange: not)"
)


def policies(chosen: argparse.Namespace, env_id: str) -> list[tuple[str, int | None, PolicyPredictor]]:
    """What is judged in an environment."""
    found: list[tuple[str, int | None, PolicyPredictor]] = [
        (name, None, controller) for name, controller in controllers(env_id).items()
    ]
    for model in chosen.models:
        algo, _, path = model.partition("=")
        found.append((Path(path).stem, None, ALGOS[algo].load(path, device="cpu")))
    for algo in chosen.algos:
        for fraction in chosen.fractions:
            for seed in chosen.seeds:
                recipe = Recipe.of(algo, env_id, seed)
                starts = {**recipe.arguments, **recipe.hyperparameters}.get("learning_starts", 0)
                whole = min(recipe.timesteps, int(chosen.timesteps or recipe.timesteps))
                # a share of what is learned: nothing is before learning_starts
                steps = starts + round(fraction * (whole - starts))
                name = algo.upper() if fraction == 1 else f"{algo.upper()}, {100 * fraction:g} % of the updates"
                found.append((name, seed, train_or_load(Recipe.of(algo, env_id, seed, steps), chosen.out / "models")))
    return found


def feasible_alpha3() -> pd.DataFrame:
    """
    The largest alpha3 that holds in every state of ``LinearCost-v0``, exactly and without noise: with
    ``kappa = sup L / c`` it is ``(1 - (1 - gamma) kappa) / gamma`` for the cost discounted by gamma, and 1 for the average
    cost. kappa is the largest eigenvalue of ``P x = kappa C x``, for the quadratic forms of L and of the cost.
    """
    env = LinearCostEnv()
    rows = []
    for name, factor in factors("LinearCost-v0").items():
        if factor <= 0:
            continue
        row: dict[str, Any] = {"controller": name}
        for gamma in (0.6, 0.9, 0.95, 0.99):
            gain = factor * env.optimal_gain(gamma)
            kappa = eigh(env.value_matrix(gain, gamma), env.Q + gain.T @ env.R @ gain, eigvals_only=True).max()
            row[f"discount {gamma:g}"] = f"{(1 - (1 - gamma) * kappa) / gamma:.2f} ({kappa:.2f})"
        rows.append({**row, "average cost": "1.00"})
    return pd.DataFrame(rows)


def _over_policies(values: pd.Series) -> str:
    known = values.dropna()
    middle, least, most = (digits(value, 3) for value in (known.median(), known.min(), known.max()))
    text = middle if least == most else f"{middle} ({least} to {most})"
    return text if len(known) in (0, len(values)) else f"{text}, of {len(known)}"


def report(table: pd.DataFrame) -> str:
    """The certificates side by side, as Markdown. Numbers of several seeds are their median (least to most of a seed)."""
    text = "The largest feasible `alpha3` of the exact function, and in brackets the largest L / c:\n\n"
    text += markdown(feasible_alpha3())
    of_critics = table["function"] == "critic"
    table = table.assign(policy=table["policy"] + np.where(of_critics, " (critic)", ""))

    def bound_of(group: pd.DataFrame) -> str:
        low, high = group["cost_bound_low"], group["cost_bound_high"]
        interval = f" [{digits(low.item(), 3)}, {digits(high.item(), 3)}]" if len(group) == 1 else ""
        return _over_policies(group["cost_bound"]) + interval

    cells: dict[str, Cell] = {
        "holds": ("holds", count_of),
        f"settles at {SETTLED_SHARE:g} of the start": ("settles", count_of),
        "cost at the start": ("start_cost", _over_policies),
        "mean cost settles below": bound_of,
        "its alpha3": ("cost_bound_alpha3", _over_policies),
        "alpha3 without residual": ("largest_feasible_alpha3", _over_policies),
        **{f"{name.replace('_', ' ')}, at least": (f"{name}_at_least", _over_policies) for name in STATEMENTS},
    }
    for env_id, of_env in table.groupby("env", sort=False):
        text += f"\n`{env_id}`:\n\n" + markdown(table_of(of_env, ["policy"], cells))
    return text


def plot(table: pd.DataFrame) -> Figure:
    """Where the mean cost settles against the cost at the start: a row a policy and function, in it a dot a seed."""
    envs = table["env"].unique()
    named = table.assign(who=table["policy"] + np.where(table["function"] == "critic", ", L of the critic", ""))
    height = 0.9 + 0.25 * named.groupby("env")["who"].nunique().max()
    figure, panels = new_panels(len(envs), 3, (4.4, height), margin=(0.0, 0.5))
    for axes, env_id in zip(panels, envs, strict=True):
        of_env = named[named["env"] == env_id]
        names = list(dict.fromkeys(of_env["who"]))[::-1]
        rows = of_env["who"].map(names.index).to_numpy()
        colours = np.where(of_env["settles"], COLOURS[2], np.where(of_env["holds"], COLOURS[0], COLOURS[1])).tolist()
        bounds = of_env[["cost_bound_low", "cost_bound", "cost_bound_high"]]
        # a logarithmic axis has no 0, which is shown a decade below all else
        least = min(of_env["start_cost"].min(), bounds.where(bounds > 1e-9).min(axis=None)) / 10
        low, bound, high = bounds.clip(lower=least).to_numpy().T
        axes.hlines(rows, low, high, colors=colours, lw=3)
        axes.scatter(bound, rows, c=colours, s=24, alpha=0.7, label=_MEANING, zorder=3)
        axes.scatter(of_env["start_cost"], rows, color="black", marker="|", s=80, label="at the start")
        axes.set_yticks(range(len(names)), names, fontsize="small")
        axes.set_ylim(-0.7, len(names) - 0.3)
        zero = f" (0 at {least:.1g})" if (bounds < 1e-9).any(axis=None) else ""
        axes.set(xscale="log", xlabel=f"cost per step{zero}", title=env_id)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize="small")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("certificate", __doc__, jobs=None)
    parser.add_argument("--envs", nargs="+", default=list(DISTURBANCES), help="cost environments")
    parser.add_argument("--algos", nargs="*", default=[], help="algorithms to train, with an entry in zoo_configs")
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=float, help="environment steps at most; those of zoo_configs by default")
    parser.add_argument("--fractions", nargs="+", type=float, default=[1.0], help="shares of the updates to train for")
    parser.add_argument("--models", nargs="*", default=[], metavar="ALGO=PATH", help="saved models to judge, in all --envs")
    parser.add_argument("--episodes", type=int, default=200, help="to fit, to evaluate and to certify, each")
    study = Study(parser, arguments)
    chosen = study.chosen
    unknown = [name for name in [*chosen.algos, *(model.partition("=")[0] for model in chosen.models)] if name not in ALGOS]
    if unknown:
        parser.error(f"unknown algorithms: {', '.join(unknown)}; models are given as ALGO=PATH")
    paths = [model.partition("=")[2] for model in chosen.models]
    missing = [path for path in paths if not (Path(path).is_file() or Path(f"{path}.zip").is_file())]
    if missing:
        parser.error(f"there is no file {', '.join(missing)}")
    if chosen.episodes < CERTIFICATE_ENVS or min(chosen.fractions) <= 0:
        parser.error(f"--episodes must be at least {CERTIFICATE_ENVS}, and --fractions positive")

    rows = []
    for env_id in chosen.envs:
        for policy, seed, predictor in tqdm(policies(chosen, env_id), desc=env_id, disable=None):
            name = "_".join(f"{env_id}_{policy}{'' if seed is None else f'_seed{seed}'}".replace("%", "percent").split())
            described = {"env": env_id, "policy": policy, "seed": seed}
            of_policy = judge(predictor, env_id, chosen.episodes, chosen.out / name.replace(",", ""))
            rows += [{**described, **row} for row in of_policy]
    table = pd.DataFrame(rows)
    study.write({"certificates": table}, {"certificates": plot(table)}, report(table), "certificates")


if __name__ == "__main__":
    main()
