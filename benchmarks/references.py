"""
How well the reference controllers of the cost environments do, without and with disturbances that they do not know of: what a
policy that was learned is to be compared with.

.. code-block:: bash

  python -m benchmarks.references
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from stable_baselines3.common.type_aliases import PolicyPredictor

from battery_env.plotting import new_figure
from benchmarks.robustness import roll_out
from benchmarks.study import Study, Tables, command_line, digits, markdown, positive
from sb3_lac.envs import CostEnv, reference_controller

#: By environment: its impulse, parameters that are not as they should be, noise on states, noise on observations, delay.
DISTURBANCES: dict[str, tuple[float, dict[str, float], float, float, int]] = {
    "LinearCost-v0": (5.0, {"control_max": 1.0}, 0.03, 0.1, 2),
    "CartPoleCost-v0": (100.0, {"pole_half_length_m": 1.0}, 0.01, 0.02, 2),
    "Oscillator-v0": (3.0, {"protein_decay": 0.05}, 0.1, 0.1, 1),
    "PendulumCost-v0": (10.0, {"mass_kg": 1.4}, 0.01, 0.03, 2),
    "QuadrotorCost-v0": (50.0, {"mass_kg": 1.2}, 0.01, 0.03, 2),
    "VehicleCost-v0": (20_000.0, {"friction": 0.5}, 0.01, 0.03, 2),
}
#: Shares of episodes, with their titles in tables: the error at the end is within the tolerance, or within a part of that at
#: the start.
SHARES = {
    "at_goal": "at the goal",
    "within_1_percent": "within 1 % of the start",
    "within_0.1_percent": "within 0.1 %",
}
# No episode ends within 15 steps after an impulse
_IMPULSE_INTERVAL = 85


def conditions(env_id: str) -> dict[str, dict[str, Any]]:
    """The disturbances that a controller is tried with, one at a time."""
    impulse, changed, process_noise, observation_noise, delay = DISTURBANCES[env_id]
    return {
        "none": {},
        "impulses": {"impulse": impulse, "impulse_interval": _IMPULSE_INTERVAL},
        "other parameters": {"changed_parameters": changed},
        "process noise": {"process_noise": process_noise},
        "observation noise": {"observation_noise": observation_noise},
        "action delay": {"action_delay": delay},
    }


def tried(policy: PolicyPredictor, env_id: str, episodes: int) -> pd.DataFrame:
    """Try a policy under all conditions."""
    problem = gym.make(env_id).unwrapped
    assert isinstance(problem, CostEnv)
    rows = []
    for condition, arguments in conditions(env_id).items():
        outcome = roll_out(policy, partial(gym.make, env_id, **arguments), episodes)
        left = (outcome["error"] / outcome["error_at_start"]).where(~outcome["died"], np.inf)
        rows.append(
            {
                "environment": env_id,
                "disturbance": condition,
                "arguments": ", ".join(f"{name}={value}" for name, value in arguments.items()),
                "cost": outcome["cost"].mean(),
                "cost_worst": outcome["cost"].max(),
                "error_median": outcome["error"].median(),
                "error_worst": outcome["error"].max(),
                "tolerance": problem.error_tolerance,
                "at_goal": ((outcome["error"] <= problem.error_tolerance) & ~outcome["died"]).mean(),
                "within_1_percent": (left <= 0.01).mean(),
                "within_0.1_percent": (left <= 0.001).mean(),
                "died": outcome["died"].mean(),
            }
        )
    return pd.DataFrame(rows)


def part(env_id: str, episodes: int) -> Tables:
    """Try the reference controller under all conditions."""
    return {"references": tried(reference_controller(gym.make(env_id)), env_id, episodes)}


def report(results: pd.DataFrame) -> str:
    """One table, as Markdown."""
    shown = {
        "environment": results["environment"],
        "disturbance": results["disturbance"] + [f" ({text})" if text else "" for text in results["arguments"]],
        "cost per step, mean (worst episode)": [
            f"{digits(mean)} ({digits(worst)})" for mean, worst in zip(results["cost"], results["cost_worst"], strict=True)
        ],
        "error at the end, median (worst)": [
            f"{digits(median)} ({digits(worst)})"
            for median, worst in zip(results["error_median"], results["error_worst"], strict=True)
        ],
        "tolerance": results["tolerance"],
        **{title: [f"{share:.0%}" for share in results[column]] for column, title in SHARES.items()},
        "died": [f"{share:.0%}" for share in results["died"]],
    }
    return markdown(pd.DataFrame(shown))


def draw_shares(axes: Axes, results: pd.DataFrame, by: str, order: list[str]) -> None:
    """A map of the share of episodes that end at the goal, and in brackets of those that die, by disturbance."""
    shares, deaths = (
        results.pivot_table(index=by, columns="disturbance", values=column, sort=False).loc[order]
        for column in ("at_goal", "died")
    )
    axes.imshow(shares, vmin=0.0, vmax=1.0, aspect="auto", cmap="cividis")
    for i, j in np.ndindex(shares.shape):
        share, death = shares.iloc[i, j], deaths.iloc[i, j]
        text = f"{share:.0%}" + (f" ({death:.0%})" if death > 0 else "")
        axes.text(j, i, text, ha="center", va="center", color="black" if share > 0.5 else "white", size=8)
    axes.set_xticks(range(shares.shape[1]), [name.replace(" ", "\n") for name in shares.columns], fontsize="small")
    axes.set_yticks(range(len(order)), order)


def plot(results: pd.DataFrame) -> Figure:
    """The share of episodes that end at the goal, and in brackets of those that die."""
    figure = new_figure(7.6, 3.2)
    axes = figure.subplots()
    draw_shares(axes, results, "environment", list(results["environment"].unique()))
    axes.set_title("episodes that end at the goal (that die)")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("references", __doc__)
    parser.add_argument("--episodes", type=positive, default=100, help="episodes for each environment and condition")
    study = Study(parser, arguments)
    tables = study.run(part, [{"env_id": env_id, "episodes": study.chosen.episodes} for env_id in DISTURBANCES])
    study.write(tables, {"references": plot(tables["references"])}, report(tables["references"]))


if __name__ == "__main__":
    main()
