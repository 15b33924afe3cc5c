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
``metric_sac`` is SAC with critics that learn in LAC's metric, which tells what is LAC's from what is the metric's. Critics of
``lac_square_root`` learn that root, and those of ``lac`` the fourth. What is done is not done again when the command is
repeated, so that seeds can be added. Without algorithms only controllers are judged, which takes minutes; with
``--weak-controllers`` also those with too little gain or the wrong sign, of which a certificate must not say that they settle.
``tensorboard --logdir results/stabilisation/models`` overlays the curves of all trainings.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
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
    roll_out,
    shares_of,
    tried,
)
from benchmarks.runs import setting_of_lac
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
    write_text,
)
from benchmarks.training import Recipe, record_file, train_or_load, training_minutes
from sb3_lac.envs import CostEnv
from sb3_lac.stability.plots import format_log_axis
from sb3_lac.stability.rollout import SETTLED_SHARE


@dataclass(frozen=True)
class Contender:
    """
    An algorithm with settings.

    :param algo: the algorithm, see :class:`Recipe`
    :param label: what it is called in tables and figures
    :param colour: what it is drawn in
    :param marker: and with
    :param settings: whose ``default`` entry of ``zoo_configs`` it has in place of its own for each problem
    :param hyperparameters: what differs from that
    :param compiles: whether its updates can be compiled
    :param typed: whether it is ``ALGO("MlpPolicy", env_id)`` as typed, with the defaults of its class in place of an entry
    """

    algo: str
    label: str
    colour: str
    marker: str
    settings: str | None = None
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    compiles: bool = False
    typed: bool = False

    def recipe(self, env_id: str, seed: int, timesteps: int | None) -> Recipe:
        """What it is trained by."""
        differing = dict(self.hyperparameters)
        return Recipe.of(
            self.algo, env_id, seed, timesteps, hyperparameters=differing, settings=self.settings, defaults=self.typed
        )

    def trained(self, recipe: Recipe, digest: str | None, folder: Path, compiled: bool) -> Trained:
        """Train it, unless that has been done."""
        if recipe.digest != digest:
            who = f"{self.label} on {recipe.env_id}"
            raise RuntimeError(f"the hyperparameters of {who} have changed since the study began: start it again")
        file = record_file(recipe, folder).with_name(f"learning_{recipe.name}.csv")
        curve = LearningCurve(recipe.env_id, recipe.timesteps, file)
        model = train_or_load(recipe, folder, [curve], compile_update=compiled and self.compiles)
        learning = pd.read_csv(file)
        minutes = training_minutes(recipe, folder) - learning.pop("seconds").sum() / 60.0
        # updates of all algorithms that learn from a replay buffer
        return Trained(model, getattr(model, "_n_updates", None), minutes, learning)


class Trained(NamedTuple):
    """A policy, what its training took without what the learning curve did, and that curve."""

    model: BaseAlgorithm
    updates: int | None
    training_minutes: float
    learning: pd.DataFrame


REFERENCE = "reference"
_METRIC_SAC = "benchmarks.metric_sac:MetricSAC"
_SQUARE_ROOT = {"policy_kwargs": setting_of_lac(root=2)["policy_kwargs"]}
_NETWORKS = {"policy_kwargs": setting_of_lac(root=None)["policy_kwargs"]}
_NOISE = {"noise_type": "normal", "noise_std": 0.1}
#: Who is judged, by the name on the command line.
CONTENDERS = {
    "lac": Contender("lac", "LAC", COLOUR_OF["LAC"], "o", compiles=True),
    "lac_as_typed": Contender("lac", "LAC, as typed", COLOUR_OF["LAC"], "<", compiles=True, typed=True),
    "lac_default_root": Contender(
        "lac", "LAC, its default root", COLOUR_OF["LAC"], "*", hyperparameters=_NETWORKS, compiles=True
    ),
    "lac_square_root": Contender("lac", "LAC (root=2)", COLOUR_OF["LAC"], "d", hyperparameters=_SQUARE_ROOT, compiles=True),
    "published_lac": Contender("published_lac", "LAC as published", COLOUR_OF["LAC as published"], "P", compiles=True),
    "published_lac_paper": Contender(
        "published_lac",
        "LAC as published, its setting",
        COLOUR_OF["LAC as published"],
        "X",
        settings="published_lac",
        compiles=True,
    ),
    "sac": Contender("sac", "SAC", COLOUR_OF["SAC"], "s"),
    "sac_common": Contender("sac", "SAC, LAC's setting", COLOUR_OF["SAC"], "8", settings="lac", hyperparameters=_NETWORKS),
    "td3": Contender("td3", "TD3", COLOUR_OF["TD3"], "^"),
    "td3_common": Contender(
        "td3", "TD3, LAC's setting", COLOUR_OF["TD3"], ">", settings="lac", hyperparameters={**_NETWORKS, **_NOISE}
    ),
    "tqc": Contender("tqc", "TQC", COLOUR_OF["TQC"], "D"),
    "tqc_common": Contender("tqc", "TQC, LAC's setting", COLOUR_OF["TQC"], "*", settings="lac", hyperparameters=_NETWORKS),
    "metric_sac": Contender(_METRIC_SAC, "SAC, LAC's metric", COLOURS[4], "v", compiles=True),
}
#: How they are drawn: colour and marker.
STYLES = {each.label: (each.colour, each.marker) for each in CONTENDERS.values()}
STYLES |= dict(zip({**FACTORS, **LINEAR_FACTORS}, (("black", marker) for marker in "|123x"), strict=True))
# learning curves, whose episodes have other starts than those of all other judgements
_POINTS, _CURVE_EPISODES, _CURVE_SEED = 12, 30, 40_000


class LearningCurve(BaseCallback):
    """
    Judges the mean action while a policy is trained, at evenly spaced points of which the last is the end, and writes what it
    costs when the training has ended.

    :param env_id: id of the environment
    :param timesteps: environment steps of the training
    :param file: table to write
    """

    def __init__(self, env_id: str, timesteps: int, file: Path) -> None:
        super().__init__()
        self.env_id, self.timesteps, self.file = env_id, timesteps, file
        self.rows: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        if len(self.rows) + 1 < _POINTS and self.num_timesteps >= self.timesteps * (len(self.rows) + 1) / _POINTS:
            self._judge()
        return True

    def _on_training_end(self) -> None:
        self._judge()
        write_text(self.file, pd.DataFrame(self.rows).to_csv(index=False))

    def _judge(self) -> None:
        start = time.perf_counter()
        judged = {"timesteps": self.model.num_timesteps, "updates": getattr(self.model, "_n_updates", np.nan)}
        judged |= _cost_of(self.model, self.env_id)
        self.rows.append(judged | {"seconds": time.perf_counter() - start})


def _cost_of(policy: PolicyPredictor, env_id: str) -> dict[str, float]:
    outcome = roll_out(policy, partial(gym.make, env_id), _CURVE_EPISODES, seed=_CURVE_SEED)
    problem = gym.make(env_id).unwrapped
    assert isinstance(problem, CostEnv)
    return {"cost": outcome["cost"].mean(), "at_goal": shares_of(outcome, problem.error_tolerance)["at_goal"]}


def part(
    policy: str,
    env_id: str,
    seed: int | None,
    timesteps: int | None,
    recipe: str | None,
    episodes: int,
    certificate_episodes: int,
    models: Path,
    compiled: bool,
) -> Tables:
    """Train a policy, or take a controller, and judge it."""
    predictor: PolicyPredictor
    if seed is None:
        predictor, updates, minutes = controllers(env_id)[policy], None, None
        learning = pd.DataFrame([{"timesteps": np.nan, "updates": np.nan, **_cost_of(predictor, env_id)}])
    else:
        chosen, folder = CONTENDERS[policy], models / f"{env_id}_{policy}_seed{seed}"
        made_from = chosen.recipe(env_id, seed, timesteps)
        predictor, updates, minutes, learning = chosen.trained(made_from, recipe, folder, compiled)
    label = policy if seed is None else CONTENDERS[policy].label
    of_policy = {"environment": env_id, "policy": label, "seed": seed}
    described: dict[str, Any] = {
        **of_policy,
        "timesteps": timesteps,
        "updates": updates,
        "training_minutes": minutes,
        "recipe": recipe,
    }
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
        {"policy": name, "env_id": env_id, "seed": None, "timesteps": None, "recipe": None}
        for env_id in chosen.envs
        for name in untrained(env_id)
    ]
    for seed, env_id, policy in product(chosen.seeds, chosen.envs, chosen.algos):
        recipe = contender(policy, env_id).recipe(env_id, seed, timesteps(env_id))
        made_from = {"seed": seed, "timesteps": recipe.timesteps, "recipe": recipe.digest}
        parts.append({"policy": policy, "env_id": env_id, **made_from})
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
    """What policies cost and where they end, without disturbances."""
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
    """The same, as Markdown below what its numbers are."""
    said = "Without disturbances. Costs and errors are interquartile means over seeds with 95 % intervals, shares of episodes "
    return [f"{said}are means (least to most of a seed):\n", markdown(undisturbed_table(results))]


def disturbed_table(results: pd.DataFrame, cell: Callable[[pd.DataFrame], str]) -> pd.DataFrame:
    """What each disturbance does, as one cell says of all tries of a policy."""
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
    """What the certificates say."""

    def known(values: pd.Series) -> str:
        return with_interval(values.dropna()) if values.notna().any() else "-"

    of_critics = certificates["function"] == "critic"
    shown = certificates.assign(policy=certificates["policy"] + np.where(of_critics, " (critic)", ""))
    for column in ("cost_bound", "cost_bound_alpha3"):
        shown[f"held_{column}"] = shown[column].where(shown["holds"])
    cells: dict[str, Cell] = {
        "holds": ("holds", count_of),
        f"settles at {SETTLED_SHARE:g} of the start": ("settles", count_of),
        "cost at the start": ("start_cost", lambda costs: digits(costs.mean())),
        "where it holds: mean cost settles below": ("held_cost_bound", known),
        "its alpha3": ("held_cost_bound_alpha3", known),
        "alpha3 without residual": ("largest_feasible_alpha3", with_interval),
        "cost-to-go by L, slope": ("calibration_slope", known),
        # stated once for a policy, with the fitted function
        "survives, at least": ("survives_at_least", lambda shares: digits(shares.mean())),
    }
    return table_of(shown, ["environment", "policy"], cells)


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
    """
    Cost of the mean action while policies are trained, one panel per environment: the interquartile mean over seeds in a band
    from the least to the most of a seed, and the reference controller.
    """
    envs = list(learning["environment"].unique())
    figure, panels = new_panels(len(envs), 3, (3.1, 2.3), margin=(0.0, 0.4))
    for axes, env_id in zip(panels, envs, strict=True):
        of_env = learning[learning["environment"] == env_id]
        for name, (colour, marker) in STYLES.items():
            of_policy = of_env[of_env["policy"] == name]
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
    made = study.run(part, [each | judged for each in parts], models=study.out / "models", compiled=chosen.compile)
    tables = in_order(made, [*DISTURBANCES, *STYLES])
    study.write(tables, {"learning": plot_learning(tables["learning"])}, report(tables))


if __name__ == "__main__":
    main()
