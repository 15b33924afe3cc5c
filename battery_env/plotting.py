"""Figures of calibrations."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from battery_env.files import replacing

#: Colours that colour-blind readers can tell apart (Okabe & Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
LABELS = {"q_mobile": "$q^{max}$ (C)", "r_o": r"$R_o$ ($\Omega$)"}


def new_figure(width: float, height: float) -> Figure:
    """
    An empty figure in the project's style, outside pyplot's global state.

    :param width: inches
    :param height: inches
    :return: the figure
    """
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """
    Save a figure; the file is written beside its place and renamed, so that it is never there in part.

    :param figure: the figure
    :param path: where to; its suffix chooses the format
    :return: the file
    """
    with replacing(path) as part:
        figure.savefig(part)
    return Path(path)


def plot_true_against_inferred(scores: Mapping[str, pd.DataFrame], parameter: str) -> Figure:
    """
    The paper's figure, one column per calibrator: the true parameter of each discharge against the mean of its estimates (bar:
    their standard deviation), and below it the error, which the upper panel is too coarse for.

    :param scores: what :func:`battery_env.evaluation.evaluate` returned, by name of the calibrator
    :param parameter: ``"q_mobile"`` or ``"r_o"``
    :return: the figure
    """
    figure = new_figure(3.1 * len(scores) + 0.9, 5.2)
    panels = figure.subplots(2, len(scores), sharex=True, sharey="row", height_ratios=[3, 2], squeeze=False)
    low = min(table[parameter].min() for table in scores.values())
    high = max(table[parameter].max() for table in scores.values())
    points = None
    for (upper, lower), (name, table) in zip(panels.T, scores.items(), strict=True):
        true, inferred, spread = table[parameter], table[f"{parameter}_hat"], table[f"{parameter}_spread"]
        mape = table[f"{parameter}_mape_percent"]
        upper.plot([low, high], [low, high], color="0.6", lw=1.0, zorder=1)
        upper.vlines(true, inferred - spread, inferred + spread, color="0.75", lw=0.6, zorder=2)
        upper.scatter(true, inferred, c=table["load"], s=5, cmap="viridis", zorder=3)
        upper.set_title(f"{name}\nMAPE {mape.mean():.2g} %, worst {mape.max():.2g} %", fontsize=10)
        points = lower.scatter(true, mape, c=table["load"], s=3, cmap="viridis")
        lower.set(yscale="log", xlabel=f"true {LABELS[parameter]}")
        lower.grid(alpha=0.25)
    panels[0, 0].set_ylabel(f"inferred {LABELS[parameter]}")
    panels[1, 0].set_ylabel("MAPE of a discharge (%)")
    figure.align_ylabels(panels[:, 0])
    if points is not None:
        figure.colorbar(points, ax=panels.ravel().tolist(), label="mean load (W)")
    return figure


def plot_learning_curves(curves: Mapping[str, list[pd.DataFrame]], title: str) -> Figure:
    """
    Error on held-out discharges during training: one line per seed, one colour per algorithm.

    :param curves: by algorithm, for each seed a table with ``timesteps``, ``mape_percent`` and ``mape_percent_worst``
    :param title: title of the figure
    :return: the figure
    """
    figure = new_figure(7.2, 3.4)
    for axes, column, label in zip(
        figure.subplots(1, 2, sharex=True),
        ("mape_percent", "mape_percent_worst"),
        ("mean over trajectories", "worst trajectory"),
        strict=True,
    ):
        for colour, (name, tables) in zip(COLOURS, curves.items(), strict=False):
            for k, table in enumerate(tables):
                axes.plot(table["timesteps"] / 1e3, table[column], color=colour, lw=1.4, label=name if k == 0 else None)
        axes.set(yscale="log", xlabel="environment steps (thousands)", ylabel="MAPE (%)")
        axes.set_title(label, fontsize=10)
        axes.grid(which="both", alpha=0.25)
        axes.legend(frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    return figure
