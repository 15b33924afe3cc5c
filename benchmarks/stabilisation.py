"""
LAC, SAC, TD3 and TQC on the six cost environments, beside their reference controllers: how fast they learn, what a policy
costs, whether it ends at the goal, what disturbances that it was not trained for do to it, and what a certificate says of it.

.. code-block:: bash

  python -m benchmarks.stabilisation --timesteps 16000 --seeds 0 1 2
  python -m benchmarks.stabilisation --algos lac published_lac sac td3 tqc metric_sac --compile
  python -m benchmarks.stabilisation --algos --weak-controllers

Policies are trained without disturbances, with the hyperparameters of ``zoo_configs``, and judged by their mean action. All of
them have the same starts and disturbances. ``sac_common``, ``td3_common`` and ``tqc_common`` have the one setting of LAC for
all problems in place of their own for each; ``published_lac`` has it too, and ``published_lac_paper`` that of its authors.
``metric_sac`` is SAC with critics that learn in LAC's metric, which tells what is LAC's from what is the metric's. ``lac`` has
its entry in ``zoo_configs``, with the fourth root; ``lac_default_root`` and ``lac_square_root`` have other roots, and
``lac_as_typed`` has no argument but policy and environment. What is done is not done again when the command is repeated, so
that seeds can be added. Without algorithms only controllers are judged, which takes minutes; with ``--weak-controllers`` also
those with too little gain or the wrong sign, of which a certificate must not say that they settle.
``tensorboard --logdir results/stabilisation/models`` overlays the curves of all trainings.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor

from battery_env.evaluation import over_seeds
from battery_env.plotting import COLOUR_OF, COLOURS
from benchmarks.control import (
    DISTURBANCES,
    FACTORS,
    LINEAR_FACTORS,
    SHARES,
    conditions,
    controllers,
    judge,
    tried,
    while_training,
)
from benchmarks.runs import Run, control_networks, made_by, train_or_load
from benchmarks.study import (
    Cell,
    Study,
    Tables,
    add_legend,
    command_line,
    count_of,
    digits,
    markdown,
    natural,
    new_panels,
    of_trained,
    positive,
    share_with_range,
    table_of,
    with_interval,
)
from benchmarks.zoo_runs import zoo_run
from sb3_lac.stability.plots import format_log_axis
from sb3_lac.stability.rollout import SETTLED_SHARE


@dataclass(frozen=True)
class Contender:
    """An algorithm with settings, and how it is drawn."""

    algo: str
    label: str
    colour: str
    marker: str
    settings_of: str | None = None  # whose default entry of zoo_configs it has in place of its own for each problem
    differing: Mapping[str, Any] = field(default_factory=dict)  # hyperparameters that are not those of the entry
    defaults: bool = False  # whether it is ALGO("MlpPolicy", env_id) as typed

    def run(self, env_id: str, seed: int, timesteps: int | None) -> Run:
        """Return the training."""
        chosen = {name: getattr(self, name) for name in ("settings_of", "differing", "defaults", "label")}
        return zoo_run(self.algo, env_id, seed, timesteps, **chosen)


REFERENCE = "reference"
_NETWORKS = {"policy_kwargs": control_networks()}
_NOISE = {"noise_type": "normal", "noise_std": 0.1}
_LAC, _PUBLISHED, _SAC, _TD3, _TQC = (COLOUR_OF[name] for name in ("LAC", "LAC as published", "SAC", "TD3", "TQC"))
#: Who is judged, by the name on the command line.
CONTENDERS = {
    "lac_as_typed": Contender("lac", "LAC, as typed", _LAC, "<", defaults=True),
    "lac_default_root": Contender("lac", "LAC", _LAC, "*", differing=_NETWORKS),
    "lac": Contender("lac", "LAC (root=4)", _LAC, "o"),
    "lac_square_root": Contender("lac", "LAC (root=2)", _LAC, "d", differing={"policy_kwargs": control_networks(2)}),
    "published_lac": Contender("published_lac", "LAC as published", _PUBLISHED, "P"),
    "published_lac_paper": Contender("published_lac", "LAC as published, its setting", _PUBLISHED, "X", "published_lac"),
    "sac": Contender("sac", "SAC", _SAC, "s"),
    "sac_common": Contender("sac", "SAC, LAC's setting", _SAC, "8", "lac", _NETWORKS),
    "td3": Contender("td3", "TD3", _TD3, "^"),
    "td3_common": Contender("td3", "TD3, LAC's setting", _TD3, ">", "lac", {**_NETWORKS, **_NOISE}),
    "tqc": Contender("tqc", "TQC", _TQC, "D"),
    "tqc_common": Contender("tqc", "TQC, LAC's setting", _TQC, "*", "lac", _NETWORKS),
    "metric_sac": Contender("benchmarks.metric_sac:MetricSAC", "SAC, LAC's metric", COLOURS[4], "v"),
}
#: How they are drawn: colour and marker.
STYLES = {each.label: (each.colour, each.marker) for each in CONTENDERS.values()}
STYLES |= dict(zip({**FACTORS, **LINEAR_FACTORS}, (("black", marker) for marker in "|123x"), strict=True))


def point_of(model: BaseAlgorithm, run: Run) -> dict[str, float]:
    """A point of a learning curve."""
    updates = getattr(model, "_n_updates", np.nan)
    return {"timesteps": model.num_timesteps, "updates": updates, **while_training(model, run.task, {})}


def trained(run: Run, models: Path, compiled: bool) -> tuple[BaseAlgorithm, dict[str, Any], pd.DataFrame]:
    """Train a policy, unless that has been done: the model, what its training took, and its learning curve."""
    folder = models / run.name
    model = train_or_load(run, folder, point_of, compiled=compiled)
    record = made_by(run, folder)
    took = {name: record[name] for name in ("timesteps", "updates", "training_minutes")}
    return model, took, pd.DataFrame(record["curve"])


def part(
    policy: str,
    env_id: str,
    seed: int | None,
    run: dict[str, Any] | None,
    episodes: int,
    certificate_episodes: int,
    models: Path,
    compiled: bool,
) -> Tables:
    """Train a policy, or take a controller, and judge it."""
    predictor: PolicyPredictor
    if run is None:
        predictor, label, recipe = controllers(env_id)[policy], policy, None
        took: dict[str, Any] = dict.fromkeys(("timesteps", "updates", "training_minutes"))
        learning = pd.DataFrame([{"timesteps": np.nan, "updates": np.nan, **while_training(predictor, env_id, {})}])
    else:
        made_from = Run(**run)
        predictor, took, learning = trained(made_from, models, compiled)
        label, recipe = made_from.algorithm, made_from.digest
    of_policy = {"environment": env_id, "policy": label, "seed": seed}
    described = {**of_policy, **took, "recipe": recipe}
    return {
        "stabilisation": _beside(described, tried(predictor, env_id, episodes)),
        "certificates": _beside(described, judge(predictor, env_id, certificate_episodes)),
        "learning": _beside(of_policy, learning),
    }


def _beside(described: dict[str, Any], rows: pd.DataFrame) -> pd.DataFrame:
    return pd.concat([pd.DataFrame([described] * len(rows)), rows], axis=1)


def parts_of(
    chosen: argparse.Namespace,
    contender: Callable[[str, str], Contender],
    timesteps: Callable[[str], int | None],
    untrained: Callable[[str], Iterable[str]] = lambda env_id: [REFERENCE],
) -> list[dict[str, Any]]:
    """The controllers of each environment, then seed by seed each policy, so that an interrupted study has whole seeds."""
    parts: list[dict[str, Any]] = [
        {"policy": name, "env_id": env_id, "seed": None, "run": None} for env_id in chosen.envs for name in untrained(env_id)
    ]
    for seed, env_id, policy in product(chosen.seeds, chosen.envs, chosen.algos):
        run = contender(policy, env_id).run(env_id, seed, timesteps(env_id))
        parts.append({"policy": policy, "env_id": env_id, "seed": seed, "run": asdict(run)})
    return parts


def in_order(tables: Tables, order: Sequence[str]) -> dict[str, pd.DataFrame]:
    """Tables by environment and policy."""
    return {
        name: table.sort_values(
            ["environment", "policy"], key=lambda names: names.map(order.index), kind="stable", ignore_index=True
        )
        for name, table in tables.items()
    }


def undisturbed_table(results: pd.DataFrame) -> pd.DataFrame:
    """Tabulate costs and final errors of policies without disturbances."""
    cells: dict[str, Cell] = {
        "seeds": of_trained(lambda group: str(len(group))),
        "updates": of_trained(lambda group: f"{group['updates'].max():.0f}"),
        "training (min)": of_trained(lambda group: digits(group["training_minutes"].mean())),
        "cost per step": ("cost", with_interval),
        "error at the end, median": ("error_median", with_interval),
        **{title: (column, share_with_range) for column, title in SHARES.items()},
        "died": ("died", share_with_range),
    }
    return table_of(results[results["disturbance"] == "none"], ["environment", "policy"], cells)


def undisturbed_text(results: pd.DataFrame) -> list[str]:
    """Write this table as Markdown, below a caption."""
    caption = (
        "Without disturbances. Costs and errors are interquartile means over seeds with 95 % intervals, shares of episodes "
    )
    return [f"{caption}are means (least to most of a seed):\n", markdown(undisturbed_table(results))]


def disturbed_table(results: pd.DataFrame, cell: Callable[[pd.DataFrame], str]) -> pd.DataFrame:
    """Tabulate each disturbance, with one cell for all tries of a policy."""
    conditions = results["disturbance"].unique()
    cells = {name: lambda tries, name=name: cell(tries[tries["disturbance"] == name]) for name in conditions}
    return table_of(results, ["environment", "policy"], cells)


def cost_of(tries: pd.DataFrame) -> str:
    """Cost per step, interquartile mean over seeds."""
    return digits(float(over_seeds(tries["cost"])[0]))


def ends_of(tries: pd.DataFrame) -> str:
    """Share of the episodes that end at the goal, and of those that die."""
    return f"{100 * tries['at_goal'].mean():.0f} % ({100 * tries['died'].mean():.0f} %)"


def certificate_table(certificates: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the certificates."""

    def interval_or_dash(values: pd.Series) -> str:
        return with_interval(values.dropna()) if values.notna().any() else "-"

    of_critics = certificates["function"] == "critic"
    labelled = certificates.assign(policy=certificates["policy"] + np.where(of_critics, " (critic)", ""))
    for column in ("cost_bound", "cost_bound_alpha3"):
        labelled[f"held_{column}"] = labelled[column].where(labelled["holds"])
    cells: dict[str, Cell] = {
        "holds": ("holds", count_of),
        f"settles at {SETTLED_SHARE:g} of the start": ("settles", count_of),
        "cost at the start": ("start_cost", lambda costs: digits(costs.mean())),
        "where it holds: mean cost settles below": ("held_cost_bound", interval_or_dash),
        "its alpha3": ("held_cost_bound_alpha3", interval_or_dash),
        "alpha3 without residual": ("largest_feasible_alpha3", with_interval),
        "cost-to-go by L, slope": ("calibration_slope", interval_or_dash),
        # stated once for a policy, with the fitted function
        "survives, at least": ("survives_at_least", lambda shares: digits(shares.mean())),
    }
    return table_of(labelled, ["environment", "policy"], cells)


def report(tables: Tables) -> str:
    """All tables, as Markdown."""
    results = tables["stabilisation"]
    return "\n".join(
        [
            *undisturbed_text(results),
            "Cost per step with each disturbance, interquartile mean over seeds:\n",
            markdown(disturbed_table(results, cost_of)),
            "Share of the episodes that end at the goal, and in brackets of those that die:\n",
            markdown(disturbed_table(results, ends_of)),
            "Certificates, of a function that is fitted to the policy's roll-outs, and of critics in LAC's metric:\n",
            markdown(certificate_table(tables["certificates"])),
        ]
    )


def plot_learning(learning: pd.DataFrame) -> Figure:
    """Cost of the mean action while policies are trained: interquartile mean, least and most over seeds, and references."""
    envs = list(learning["environment"].unique())
    figure, panels = new_panels(len(envs), 3, (3.1, 2.3), margin=(0.0, 0.4))
    for axes, env_id in zip(panels, envs, strict=True):
        env_rows = learning[learning["environment"] == env_id]
        for name, (colour, marker) in STYLES.items():
            of_policy = env_rows[env_rows["policy"] == name]
            if len(of_policy) and of_policy["seed"].isna().all():
                axes.axhline(float(of_policy["cost"].iloc[0]), color=colour, ls="--", lw=1.0, label=name)
            elif not of_policy.empty:
                costs = of_policy.pivot_table(index="seed", columns="timesteps", values="cost").dropna(axis="columns")
                axes.fill_between(costs.columns, costs.min(), costs.max(), color=colour, alpha=0.15, lw=0)
                axes.plot(costs.columns, over_seeds(costs)[0], marker=marker, ms=3, lw=1.4, color=colour, label=name)
        axes.set(title=env_id, yscale="log")
        format_log_axis(axes.yaxis)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in panels[::3]:
        axes.set_ylabel("cost per step")
    for axes in panels[-3:]:
        axes.set_xlabel("environment steps")
    add_legend(figure, panels, 5, STYLES)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("stabilisation", __doc__)
    parser.add_argument("--algos", nargs="*", default=["lac", "sac", "td3"], choices=list(CONTENDERS), help="may be none")
    parser.add_argument("--weak-controllers", action="store_true", help="judge controllers, too, that are not to settle")
    parser.add_argument("--envs", nargs="+", default=list(DISTURBANCES), choices=list(DISTURBANCES))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument(
        "--timesteps", type=positive, help="environment steps on every problem; those of zoo_configs by default"
    )
    parser.add_argument("--compile", action="store_true", help="compile the updates that can be, to one graph each")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes for each policy and disturbance")
    parser.add_argument("--certificate-episodes", type=positive, default=50, help="to fit, to judge and to certify, each")
    study = Study(parser, arguments)
    chosen = study.chosen
    judged = {"episodes": chosen.episodes, "certificate_episodes": chosen.certificate_episodes}

    def untrained(env_id: str) -> Iterable[str]:
        return controllers(env_id) if chosen.weak_controllers else [REFERENCE]

    try:
        parts = parts_of(chosen, lambda policy, env_id: CONTENDERS[policy], lambda env_id: chosen.timesteps, untrained)
    except ValueError as error:
        parser.error(str(error))
    study.configuration["disturbances"] = {env_id: conditions(env_id) for env_id in chosen.envs}
    parts_tables = study.run(part, [each | judged for each in parts], models=study.out / "models", compiled=chosen.compile)
    tables = in_order(parts_tables, [*DISTURBANCES, *STYLES])
    study.write(tables, {"learning": plot_learning(tables["learning"])}, report(tables))


if __name__ == "__main__":
    main()
