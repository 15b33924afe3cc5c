"""
The experiments of Han et al. (2020) that can be made here: LAC as published and SAC on the cart and pole and on the synthetic
oscillator, and what impulses, other parameters, noise and other references do to their policies.

.. code-block:: bash

  python -m benchmarks.published --compile
  python -m benchmarks.published --compile --envs CartPoleCost-v0 --timesteps 1000000

Settings are those of the authors' code, with ``alpha3 = 1`` and the horizon of 5 of the paper: one environment, 80 updates
every 100 steps, rates of 1e-4 (actor) and 3e-4 (critics) that fall to zero, time limits that are ends. SAC has the same, with
as many updates (their code makes 50) and the hidden layers of LAC's networks. Their cart and pole has a million steps.
Policies are trained without disturbances and judged by their mean action. ``lac_inf`` is LAC with the discounted sum of all
costs. What is done is not done again when the command is repeated, so that seeds can be added.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium.wrappers import TimeLimit
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter
from stable_baselines3.common.type_aliases import PolicyPredictor

from battery_env.plotting import COLOUR_OF, COLOURS
from benchmarks.control import tried_with
from benchmarks.runs import Run
from benchmarks.stabilisation import REFERENCE, Contender, in_order, parts_of, trained, undisturbed_text
from benchmarks.study import (
    Study,
    Tables,
    add_legend,
    command_line,
    markdown,
    natural,
    new_panels,
    positive,
    share_with_range,
    side_by_side,
    table_of,
)
from sb3_lac import PublishedLAC
from sb3_lac.envs import OscillatorEnv, reference_controller
from sb3_lac.stability.plots import format_log_axis

#: How policies are drawn: colour and marker.
STYLES = {
    "LAC as published": (COLOUR_OF["LAC as published"], "P"),
    "the same, N = inf": (COLOURS[4], "X"),
    "SAC": (COLOUR_OF["SAC"], "s"),
    REFERENCE: ("black", "|"),
}
#: LAC by horizon: what it is called.
HORIZONS = {"lac": (5, "LAC as published"), "lac_inf": (None, "the same, N = inf")}
#: Environment steps of a training.
TIMESTEPS = {"Oscillator-v0": 100_000, "CartPoleCost-v0": 200_000}
_CRITIC_LAYERS = {"Oscillator-v0": [256, 256], "CartPoleCost-v0": [64, 64]}
#: What a disturbance is judged by: a column with its title.
MEASURES = {"Oscillator-v0": ("cost", "cost per step"), "CartPoleCost-v0": ("died", "episodes that die")}
_IMPULSES = {"Oscillator-v0": "amount of the first protein every 20 steps", "CartPoleCost-v0": "force every 20 steps (N)"}
_LEARNED = {"cost": "cost per step", "at_goal": "episodes at rest"}
#: By environment and disturbance: arguments of the environment, by what is different.
DISTURBANCES: dict[str, dict[str, dict[str, dict[str, Any]]]] = {
    "Oscillator-v0": {
        "none": {"undisturbed": {}},
        "impulses": {f"{size:g}": {"impulse": size, "impulse_interval": 20} for size in (0.5, 1.0, 2.0, 4.0)},
        "other parameters": {
            f"{name} = {value:g}": {"changed_parameters": {name: value}}
            for name, values in {
                "transcription": (0.8, 3.2),
                "half_saturation": (0.5, 2.0),
                "messenger_decay": (0.08, 0.24),
                "translation": (0.08, 0.24),
                "protein_decay": (0.03, 0.09),
            }.items()
            for value in values
        },
        "process noise": {f"noise {std:g}": {"process_noise": std} for std in (0.1, 0.3, 1.0)},
        "other reference": {
            "period 150": {"reference": (8.0, 7.0, 150)},
            "period 400": {"reference": (8.0, 7.0, 400)},
            "constant 8": {"reference": (8.0, 0.0, 1)},
            "constant 16": {"reference": (16.0, 0.0, 1)},
        },
    },
    "CartPoleCost-v0": {
        "none": {"undisturbed": {}},
        "impulses": {f"{size} N": {"impulse": float(size), "impulse_interval": 20} for size in range(80, 151, 10)},
        "other parameters": {
            f"half length {length:g} m, cart {mass:g} kg": {
                "changed_parameters": {"pole_half_length_m": length, "cart_mass_kg": mass}
            }
            for length in (0.1, 0.5, 1.0, 2.0)
            for mass in (0.1, 0.5, 1.0, 2.0)
        },
    },
}


class EndFarAway(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Ends an episode with a step that costs more than 100, as the authors' oscillator does in training."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or info["cost"] > 100.0, truncated, info


class OtherReferenceEnv(OscillatorEnv):
    """The oscillator with a reference that nobody was trained with."""

    def __init__(self, mean: float, amplitude: float, period_steps: int) -> None:
        super().__init__()
        self.mean, self.amplitude, self.period_steps = mean, amplitude, period_steps

    def reference(self, step: int) -> float:
        return self.mean + self.amplitude * float(np.sin(2.0 * np.pi * step / self.period_steps))


def make_env(env_id: str, reference: tuple[float, float, int] | None = None, **arguments: Any) -> gym.Env[Any, Any]:
    """An environment with a disturbance, or the oscillator with another reference."""
    if reference is None:
        return gym.make(env_id, **arguments)
    max_episode_steps = gym.spec(env_id).max_episode_steps
    assert max_episode_steps is not None
    return TimeLimit(OtherReferenceEnv(*reference), max_episode_steps)


def contender(policy: str, env_id: str) -> Contender:
    """An algorithm with the settings and networks for an environment."""
    own: dict[str, Any]
    if policy in HORIZONS:
        algo, layers = "published_lac", [*_CRITIC_LAYERS[env_id], 16]
        horizon, label = HORIZONS[policy]
        own = {"horizon": horizon}
    else:
        algo, label, layers = "benchmarks.two_rate_sac:TwoRateSAC", "SAC", _CRITIC_LAYERS[env_id]
        own = {"ent_coef": "auto_1.0", "gamma": 0.995, "train_freq": 100, "gradient_steps": 80, "learning_starts": 1000}
    own["policy_kwargs"] = {"net_arch": {"pi": [64, 64], "qf": layers}}
    if env_id == "Oscillator-v0":
        own["env_wrapper"] = "benchmarks.published.EndFarAway"
    return Contender(algo, label, *STYLES[label], "published_lac", own)


def tried(policy: PolicyPredictor, env_id: str, episodes: int) -> list[dict[str, Any]]:
    """Try a policy with all disturbances, and return one row each."""
    rows = []
    for disturbance, settings in DISTURBANCES[env_id].items():
        for setting, arguments in settings.items():
            row = {"disturbance": disturbance, "setting": setting, "impulse": arguments.get("impulse", 0.0)}
            rows.append(row | tried_with(policy, env_id, episodes, arguments, make_env))
    return rows


def part(
    policy: str,
    env_id: str,
    seed: int | None,
    run: dict[str, Any] | None,
    episodes: int,
    models: Path,
    compiled: bool,
) -> Tables:
    """Train a policy, or take the reference controller, and try it."""
    predictor: PolicyPredictor
    described: dict[str, Any] = {"environment": env_id, "policy": policy, "seed": seed}
    tables, weight = {}, None
    if run is None:
        predictor = reference_controller(gym.make(env_id))
        took: dict[str, Any] = dict.fromkeys(("timesteps", "updates", "training_minutes"))
    else:
        predictor, took, learning = trained(Run(**run), models, compiled)
        described["policy"] = run["algorithm"]
        weight = predictor.log_lambda.exp().item() if isinstance(predictor, PublishedLAC) else None
        tables["learning"] = learning.assign(**described)
    rows = [{**described, **took, "lambda": weight, **row} for row in tried(predictor, env_id, episodes)]
    return {"published": pd.DataFrame(rows), **tables}


def disturbed_table(results: pd.DataFrame) -> pd.DataFrame:
    """Tabulate each policy under each disturbance, by the measure of the environment."""
    (env_id,) = results["environment"].unique()
    measure, _ = MEASURES[env_id]
    cell = share_with_range if measure == "died" else side_by_side
    policies = results["policy"].unique()
    cells = {name: lambda tries, name=name: cell(tries.loc[tries["policy"] == name, measure]) for name in policies}
    return table_of(results, ["disturbance", "setting"], cells)


def report(results: pd.DataFrame) -> str:
    """All tables, as Markdown."""
    text = undisturbed_text(results)
    for env_id in results["environment"].unique():
        measure, title = MEASURES[env_id]
        seeds = "mean over seeds (least to most of a seed)" if measure == "died" else "each seed"
        text.append(f"{env_id} with disturbances. {title.capitalize()}, {seeds}:\n")
        text.append(markdown(disturbed_table(results[results["environment"] == env_id])))
    return "\n".join(text)


def _plot_over_seeds(axes: Axes, results: pd.DataFrame, x: str, y: str) -> None:
    """The median over seeds, in a band from the least to the most of a seed."""
    for name, of_policy in results.groupby("policy", sort=False):
        colour, marker = STYLES[str(name)]
        values = of_policy.groupby(x)[y].agg(["median", "min", "max"])
        axes.fill_between(values.index, values["min"], values["max"], color=colour, alpha=0.15, lw=0)
        axes.plot(values.index, values["median"], marker=marker, ms=4, lw=1.4, color=colour, label=str(name))


def _set_scale(axes: Axes, measure: str, along: str) -> None:
    axis = axes.xaxis if along == "x" else axes.yaxis
    if measure == "cost":
        axes.set(**{f"{along}scale": "log"})
        format_log_axis(axis)
    else:
        axes.set(**{f"{along}lim": (-0.03, 1.03)})
        axis.set_major_formatter(PercentFormatter(1.0))


def plot_learning(learning: pd.DataFrame, results: pd.DataFrame) -> Figure:
    """Plot the cost of the mean action while policies are trained, and the share of episodes that settle."""
    envs = list(learning["environment"].unique())
    figure, panels = new_panels(2 * len(envs), 2, (3.9, 2.4), margin=(0.0, 0.3))
    measures = [(env_id, measure, label) for env_id in envs for measure, label in _LEARNED.items()]
    for axes, (env_id, measure, label) in zip(panels, measures, strict=True):
        _plot_over_seeds(axes, learning[learning["environment"] == env_id], "timesteps", measure)
        references = results[(results["environment"] == env_id) & (results["policy"] == REFERENCE)]
        level = references.loc[references["disturbance"] == "none", measure].mean()
        axes.axhline(level, color=STYLES[REFERENCE][0], ls="--", lw=1.0, label=REFERENCE)
        axes.set(title=env_id, ylabel=label)
        _set_scale(axes, measure, "y")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in panels[-2:]:
        axes.set_xlabel("environment steps")
    add_legend(figure, panels[:1], 3)
    return figure


def plot_impulses(results: pd.DataFrame) -> Figure:
    """Plot the measure of an environment by the size of impulses."""
    pushed = results[results["disturbance"].isin(["none", "impulses"])]
    envs = list(pushed["environment"].unique())
    figure, panels = new_panels(len(envs), 2, (3.9, 2.6), margin=(0.0, 0.3))
    for axes, env_id in zip(panels, envs, strict=True):
        measure, label = MEASURES[env_id]
        _plot_over_seeds(axes, pushed[pushed["environment"] == env_id], "impulse", measure)
        axes.set(title=env_id, xlabel=_IMPULSES[env_id], ylabel=label)
        _set_scale(axes, measure, "y")
    add_legend(figure, panels[:1], 3)
    return figure


def plot_changes(results: pd.DataFrame) -> Figure:
    """Plot the measure under all other changes: each seed, and the median."""
    changed = results[results["disturbance"] != "impulses"]
    envs = list(changed["environment"].unique())
    figure, panels = new_panels(len(envs), 2, (5.0, 4.6), margin=(0.0, 0.3))
    for axes, env_id in zip(panels, envs, strict=True):
        env_rows = changed[changed["environment"] == env_id]
        labels = list(dict.fromkeys(env_rows["setting"]))
        measure, label = MEASURES[env_id]
        for name, of_policy in env_rows.groupby("policy", sort=False):
            colour, marker = STYLES[str(name)]
            axes.plot(of_policy[measure], of_policy["setting"].map(labels.index), ".", color=colour, alpha=0.35, ms=4)
            medians = of_policy.groupby("setting")[measure].median()
            axes.plot(medians, medians.index.map(labels.index), marker, color=colour, ms=6, label=str(name))
        axes.set_yticks(range(len(labels)), labels, fontsize="small")
        axes.invert_yaxis()
        axes.set(title=env_id, xlabel=label)
        _set_scale(axes, measure, "x")
    add_legend(figure, panels[:1], 3)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("published", __doc__)
    parser.add_argument("--algos", nargs="+", default=["lac", "sac"], choices=[*HORIZONS, "sac"])
    parser.add_argument("--envs", nargs="+", default=list(TIMESTEPS), choices=list(TIMESTEPS))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    steps = ", ".join(f"{steps} ({env_id})" for env_id, steps in TIMESTEPS.items())
    parser.add_argument("--timesteps", type=positive, help=f"environment steps of each training, {steps} by default")
    parser.add_argument("--compile", action="store_true", help="compile the updates of LAC to one graph each")
    parser.add_argument("--episodes", type=positive, default=40, help="episodes for each policy and disturbance")
    study = Study(parser, arguments)
    chosen = study.chosen
    try:
        parts = parts_of(chosen, contender, lambda env_id: chosen.timesteps or TIMESTEPS[env_id])
    except ValueError as error:
        parser.error(str(error))
    study.configuration["disturbances"] = {env_id: DISTURBANCES[env_id] for env_id in chosen.envs}
    parts = [each | {"episodes": chosen.episodes} for each in parts]
    parts_tables = study.run(part, parts, models=study.out / "models", compiled=chosen.compile)
    tables = in_order(parts_tables, [*DISTURBANCES, *STYLES])
    results = tables["published"]
    figures = {
        "learning": plot_learning(tables["learning"], results),
        "impulses": plot_impulses(results),
        "changes": plot_changes(results),
    }
    study.write(tables, figures, report(results))


if __name__ == "__main__":
    main()
