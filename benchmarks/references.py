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
from benchmarks.study import Cell, Study, Tables, command_line, digits, markdown, positive, row_by_row
from sb3_lac.envs import reference_controller


def part(env_id: str, episodes: int) -> Tables:
    """Try the reference controller under all conditions."""
    return {"references": tried(reference_controller(gym.make(env_id)), env_id, episodes)}


def report(results: pd.DataFrame) -> str:
    """One table, as Markdown."""
    cells: dict[str, Cell] = {
        "environment": ("environment", str),
        "disturbance": lambda row: row["disturbance"] + (f" ({row['arguments']})" if row["arguments"] else ""),
        "cost per step, mean (worst episode)": lambda row: f"{digits(row['cost'])} ({digits(row['cost_worst'])})",
        "error at the end, median (worst)": lambda row: f"{digits(row['error_median'])} ({digits(row['error_worst'])})",
        "tolerance": ("tolerance", float),
        **{title: (column, "{:.0%}".format) for column, title in SHARES.items()},
        "died": ("died", "{:.0%}".format),
    }
    return markdown(row_by_row(results, cells))


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
