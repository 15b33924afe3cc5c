"""
How well the reference controllers of the cost environments do, without and with disturbances that they do not know of: what a
policy that was learned is to be compared with.

.. code-block:: bash

  python -m benchmarks.references
"""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import pandas as pd
from matplotlib.figure import Figure

from battery_env.plotting import new_figure
from benchmarks.control import DISTURBANCES, SHARES, draw_shares, tried
from benchmarks.study import Study, Tables, command_line, digits, markdown, positive
from sb3_lac.envs import reference_controller


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
