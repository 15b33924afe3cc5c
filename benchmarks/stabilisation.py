"""
LAC, SAC, TD3 and TQC on the six cost environments, beside their reference controllers: what a policy costs, whether it ends at
the goal, what disturbances that it was not trained for do to it, and what a certificate says of it.

.. code-block:: bash

  python -m benchmarks.stabilisation --timesteps 16000 --seeds 0 1 2
  python -m benchmarks.stabilisation --algos lac sac td3 tqc

Policies are trained without disturbances, with the hyperparameters of ``zoo_configs``, and judged by their mean action. All of
them have the same starts and disturbances. What is done is not done again when the command is repeated, so that seeds can be
added. ``tensorboard --logdir results/stabilisation/models`` overlays the curves of all trainings.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from stable_baselines3.common.type_aliases import PolicyPredictor

from battery_env.evaluation import over_seeds
from battery_env.plotting import COLOURS, new_figure
from benchmarks.control import DISTURBANCES, SETTLED_SHARE, SHARES, conditions, draw_shares, judge, tried
from benchmarks.study import (
    Study,
    Tables,
    command_line,
    digits,
    markdown,
    natural,
    new_panels,
    positive,
    share_with_range,
    with_interval,
)
from benchmarks.training import Recipe, train_or_load, training_minutes
from sb3_lac.envs import reference_controller

_REFERENCE = "reference"
# how they are drawn
_STYLES = {
    "LAC": (COLOURS[0], "o"),
    "SAC": (COLOURS[1], "s"),
    "TD3": (COLOURS[2], "^"),
    "TQC": (COLOURS[3], "D"),
    _REFERENCE: ("black", "|"),
}
ALGORITHMS = [name.lower() for name in _STYLES if name != _REFERENCE]


def part(
    policy: str,
    env_id: str,
    seed: int | None,
    timesteps: int | None,
    recipe: str | None,
    episodes: int,
    certificate_episodes: int,
    models: Path,
) -> Tables:
    """Train a policy, or take the reference controller, and judge it."""
    predictor: PolicyPredictor
    if policy == _REFERENCE:
        predictor, updates, minutes = reference_controller(gym.make(env_id)), None, None
    else:
        assert seed is not None and timesteps is not None
        folder = models / f"{env_id}_{policy}_seed{seed}"
        model = train_or_load(policy, env_id, seed, timesteps, folder)
        # of all algorithms that learn from a replay buffer
        predictor, updates = model, getattr(model, "_n_updates", None)
        minutes = training_minutes(Recipe.of(policy, env_id, seed, timesteps), folder)
    described: dict[str, Any] = {
        "environment": env_id,
        "policy": policy if policy == _REFERENCE else policy.upper(),
        "seed": seed,
        "timesteps": timesteps,
        "updates": updates,
        "training_minutes": minutes,
        "recipe": recipe,
    }
    outcomes = tried(predictor, env_id, episodes).drop(columns="environment")
    certificates = pd.DataFrame(judge(predictor, env_id, certificate_episodes))
    return {"stabilisation": _beside(described, outcomes), "certificates": _beside(described, certificates)}


def _beside(described: dict[str, Any], rows: pd.DataFrame) -> pd.DataFrame:
    return pd.concat([pd.DataFrame([described] * len(rows)), rows], axis=1)


def _in_order(names: pd.Series) -> pd.Series:
    order = [*DISTURBANCES, *_STYLES]
    return names.map(order.index)


def undisturbed_table(results: pd.DataFrame) -> pd.DataFrame:
    """What policies cost and where they end, without disturbances."""
    rows = []
    undisturbed = results[results["disturbance"] == "none"]
    for (env_id, policy), group in undisturbed.groupby(["environment", "policy"], sort=False):
        rows.append(
            {
                "environment": env_id,
                "policy": policy,
                "seeds": "" if policy == _REFERENCE else str(len(group)),
                "updates": "" if policy == _REFERENCE else f"{group['updates'].max():.0f}",
                "training (min)": "" if policy == _REFERENCE else digits(group["training_minutes"].mean()),
                "cost per step": with_interval(group["cost"]),
                "error at the end, median": with_interval(group["error_median"]),
                **{title: share_with_range(group[column]) for column, title in SHARES.items()},
                "died": share_with_range(group["died"]),
            }
        )
    return pd.DataFrame(rows)


def disturbed_table(results: pd.DataFrame) -> pd.DataFrame:
    """What each disturbance does."""
    rows = []
    for (env_id, policy), group in results.groupby(["environment", "policy"], sort=False):
        row: dict[str, Any] = {"environment": env_id, "policy": policy}
        for condition, tries in group.groupby("disturbance", sort=False):
            row[str(condition)] = f"{100 * tries['at_goal'].mean():.0f} % ({100 * tries['died'].mean():.0f} %)"
        rows.append(row)
    return pd.DataFrame(rows)


def certificate_table(certificates: pd.DataFrame) -> pd.DataFrame:
    """What the certificates say."""
    rows = []
    for (env_id, policy, function), group in certificates.groupby(["environment", "policy", "function"], sort=False):
        held, calibrated = group[group["holds"]], group["calibration_slope"].dropna()
        rows.append(
            {
                "environment": env_id,
                "policy": f"{policy} (critic)" if function == "critic" else policy,
                "holds": f"{group['holds'].sum()} of {len(group)}",
                f"settles at {SETTLED_SHARE:g} of the start": f"{group['settles'].sum()} of {len(group)}",
                "cost at the start": digits(group["start_cost"].mean()),
                "where it holds: mean cost settles below": with_interval(held["cost_bound"]) if len(held) else "-",
                "its alpha3": with_interval(held["cost_bound_alpha3"]) if len(held) else "-",
                "alpha3 without residual": with_interval(group["largest_feasible_alpha3"]),
                "cost-to-go by L, slope": with_interval(calibrated) if len(calibrated) else "-",
                "survives, at least": "-" if function == "critic" else digits(group["survives_at_least"].mean()),
            }
        )
    return pd.DataFrame(rows)


def report(tables: Tables) -> str:
    """All tables, as Markdown."""
    results = tables["stabilisation"]
    return "\n".join(
        [
            "Without disturbances. Costs and errors are interquartile means over seeds with 95 % intervals, shares of "
            "episodes are means (least to most of a seed):\n",
            markdown(undisturbed_table(results)),
            "Share of the episodes that end at the goal, and in brackets of those that die:\n",
            markdown(disturbed_table(results)),
            "Certificates, of a function that is fitted to the policy's roll-outs, and of LAC's critic:\n",
            markdown(certificate_table(tables["certificates"])),
        ]
    )


def plot_costs(results: pd.DataFrame) -> Figure:
    """
    The cost of each policy and the share that ends at the goal: each seed, and the interquartile mean with its 95 % interval.
    """
    undisturbed = results[results["disturbance"] == "none"]
    envs, names = list(undisturbed["environment"].unique()), [name for name in _STYLES if name in set(undisturbed["policy"])]
    figure = new_figure(8.6, 1.0 + 0.75 * len(envs))
    costs, goals = figure.subplots(1, 2, sharey=True)
    yardsticks = undisturbed[undisturbed["policy"] == _REFERENCE].set_index("environment")["cost"]
    for row, env_id in enumerate(envs):
        for number, name in enumerate(names):
            of_policy = undisturbed[(undisturbed["environment"] == env_id) & (undisturbed["policy"] == name)]
            if of_policy.empty:
                continue
            colour, marker = _STYLES[name]
            height = row + 0.7 * ((number + 0.5) / len(names) - 0.5)
            for axes, values in ((costs, of_policy["cost"] / yardsticks[env_id]), (goals, of_policy["at_goal"])):
                middle, low, high = (float(value) for value in over_seeds(values))
                axes.scatter(values, np.full(len(values), height), s=8, color=colour, alpha=0.35, lw=0)
                axes.plot([low, high], [height, height], color=colour, lw=1.5)
                axes.plot(middle, height, marker, color=colour, ms=6, label=name if row == 0 else None)
    costs.set(xscale="log", xlabel="cost per step over that of the reference controller")
    # numbers, which are shorter than powers of ten: there may be several of them within a decade
    costs.xaxis.set_major_formatter(LogFormatter())
    costs.xaxis.set_minor_formatter(LogFormatter())
    costs.set_yticks(range(len(envs)), envs)
    costs.invert_yaxis()
    goals.set(xlabel="share of episodes that end at the goal", xlim=(-0.03, 1.03))
    figure.legend(*costs.get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize="small")
    return figure


def plot_disturbances(results: pd.DataFrame) -> Figure:
    """
    One map per environment: the share of episodes at the goal, and in brackets of those that die, by policy and disturbance.
    """
    envs = list(results["environment"].unique())
    figure, panels = new_panels(len(envs), 2, (5.6, 2.1), margin=(0.0, 0.5))
    for axes, env_id in zip(panels, envs, strict=True):
        of_env = results[results["environment"] == env_id]
        draw_shares(axes, of_env, "policy", [name for name in _STYLES if name in set(of_env["policy"])])
        axes.set_title(env_id)
    figure.suptitle("episodes that end at the goal (that die)")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("stabilisation", __doc__)
    parser.add_argument("--algos", nargs="+", default=["lac", "sac", "td3"], choices=ALGORITHMS)
    parser.add_argument("--envs", nargs="+", default=list(DISTURBANCES), choices=list(DISTURBANCES))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=positive, help="environment steps at most; those of zoo_configs by default")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes for each policy and disturbance")
    parser.add_argument("--certificate-episodes", type=positive, default=50, help="to fit, to judge and to certify, each")
    study = Study(parser, arguments)
    chosen = study.chosen
    judged = {"episodes": chosen.episodes, "certificate_episodes": chosen.certificate_episodes}
    parts = [
        {"policy": _REFERENCE, "env_id": env_id, "seed": None, "timesteps": None, "recipe": None, **judged}
        for env_id in chosen.envs
    ]
    # seed by seed, so that an interrupted study has whole seeds
    for seed in chosen.seeds:
        for env_id in chosen.envs:
            for algo in chosen.algos:
                timesteps = Recipe.of(algo, env_id, seed).timesteps
                timesteps = min(timesteps, chosen.timesteps or timesteps)
                try:
                    recipe = Recipe.of(algo, env_id, seed, timesteps).digest
                except ValueError as error:
                    parser.error(str(error))
                parts.append(
                    {"policy": algo, "env_id": env_id, "seed": seed, "timesteps": timesteps, "recipe": recipe, **judged}
                )
    study.configuration["disturbances"] = {env_id: conditions(env_id) for env_id in chosen.envs}
    tables = {
        name: table.sort_values(["environment", "policy"], key=_in_order, kind="stable", ignore_index=True)
        for name, table in study.run(part, parts, models=study.out / "models").items()
    }
    results = tables["stabilisation"]
    figures = {"costs": plot_costs(results), "disturbances": plot_disturbances(results)}
    study.write(tables, figures, report(tables))


if __name__ == "__main__":
    main()
