"""Figures of calibrations."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from battery_env.estimators.cell_fit import CellFit
from battery_env.estimators.least_squares import LeastSquares
from battery_env.evaluation import over_seeds
from battery_env.files import replacing
from battery_env.parameters import PARAMETERS, Q_MOBILE, R_O
from battery_env.records import Record
from battery_env.records.discharge import Discharge
from battery_env.records.model import VoltageForecast

Item = TypeVar("Item")

#: Colours that colour-blind readers can tell apart (the first six and black of Okabe & Ito, the others of Tol).
COLOURS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#882255", "#777777", "#999933", "#332288", "#000000"),
)
#: Colours by names in labels, the same in all figures.
COLOUR_OF: Mapping[str, str] = {
    "LAC as published": COLOURS[9],
    "LAC": COLOURS[0],
    "policy": COLOURS[0],
    "SAC": COLOURS[1],
    "TD3": COLOURS[2],
    "TQC": COLOURS[3],
    "Kalman filter": COLOURS[5],
    "least squares": COLOURS[6],
    "closed form": COLOURS[8],
    "measured": "0.5",
    "true": "0.25",
}

# Title and scale of the axis of each panel of a life, in units of a lab. A figure has one of both resistances.
_LIFE_COLUMNS = {
    "q_mobile_C": (f"{Q_MOBILE.symbol} (Ah)", 1.0 / 3600.0),
    "resistance_10s_ohm": (r"10 s resistance (m$\Omega$)", 1e3),
    "r_o_ohm": (rf"{R_O.symbol} (m$\Omega$)", 1e3),
    "drawn_Ah": ("charge drawn (Ah)", 1.0),
}
_NAMES = re.compile("|".join(rf"\b{name}\b" for name in COLOUR_OF), flags=re.IGNORECASE)
_COLOUR_OF_LOWER = {name.lower(): colour for name, colour in COLOUR_OF.items()}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of some inches in the project's style, outside pyplot's global state."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def literal(text: str) -> str:
    """Return a text without mathematics, even if it has dollars."""
    return text.replace("$", r"\$")


def titles_of(figure: Figure) -> dict[str, str]:
    """Return the titles of a figure, for the metadata of its PNG file."""
    titles = [figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)]
    return {"Title": "; ".join(filter(None, titles))}


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """
    Save a figure, to a temporary file first, so that the file is complete or absent.

    :param figure: the figure
    :param path: the file; its suffix chooses the format
    """
    with replacing(path) as temporary:
        # not the resolution of matplotlib's settings, which other libraries change
        figure.savefig(temporary, dpi="figure", metadata=titles_of(figure) if temporary.suffix == ".png" else None)
    return Path(path)


def plot_true_against_inferred(scores: Mapping[str, pd.DataFrame], parameter: str) -> Figure:
    """
    The paper's figure, one column per calibrator: the true parameter of each discharge against the mean of its estimates (bar:
    their standard deviation), and below it the error, on a finer scale.

    :param scores: results of :func:`battery_env.evaluation.evaluate`, by name of the calibrator
    :param parameter: ``"q_mobile"`` or ``"r_o"``
    """
    figure = new_figure(3.1 * len(scores) + 0.9, 5.2)
    panels = figure.subplots(2, len(scores), sharex=True, sharey="row", height_ratios=[3, 2], squeeze=False)
    low = min(table[parameter].min() for table in scores.values())
    high = max(table[parameter].max() for table in scores.values())
    for (upper, lower), (name, table) in zip(panels.T, scores.items(), strict=True):
        true, inferred, spread = table[parameter], table[f"{parameter}_hat"], table[f"{parameter}_spread"]
        mape = table[f"{parameter}_mape_percent"]
        upper.plot([low, high], [low, high], color="0.6", lw=1.0, zorder=1)
        upper.vlines(true, inferred - spread, inferred + spread, color="0.75", lw=0.6, zorder=2)
        upper.scatter(true, inferred, c=table["load"], s=5, cmap="viridis", zorder=3)
        upper.set_title(f"{name}\nMAPE {mape.mean():.3g} %, worst {mape.max():.3g} %", fontsize=10)
        points = lower.scatter(true, mape, c=table["load"], s=3, cmap="viridis")
        lower.set(yscale="log", xlabel=f"true {PARAMETERS[parameter].label}")
        lower.grid(alpha=0.25)
    panels[0, 0].set_ylabel(f"inferred {PARAMETERS[parameter].label}")
    panels[1, 0].set_ylabel("MAPE of a discharge (%)")
    figure.align_ylabels(panels[:, 0])
    figure.colorbar(points, ax=panels.ravel().tolist(), label="mean load (W)")
    return figure


def coloured(items: Iterable[Item], variants_alike: bool = False) -> Iterator[tuple[str, Item]]:
    """Yield a colour for each thing, a name or a tuple that starts with one: that of its name, or else one of those left."""
    # of things with one name the first has its colour, unless variants_alike
    item_list = list(items)
    own_colours = [_own_colour(item) for item in item_list]
    free = [colour for colour in COLOURS if colour not in own_colours]
    # beside names, a colour of another name comes last
    further = itertools.cycle(sorted(free, key=lambda colour: any(own_colours) and colour in COLOUR_OF.values()))
    used: set[str] = set()
    for item, colour in zip(item_list, own_colours, strict=True):
        yield next(further) if colour is None or (colour in used and not variants_alike) else colour, item
        used.add(colour or "")


def _own_colour(item: object) -> str | None:
    while isinstance(item, tuple):
        item = item[0]
    match = _NAMES.search(str(item).replace("-", " "))
    return _COLOUR_OF_LOWER[match[0].lower()] if match else None


def draw_over_seeds(axes: Axes, x: ArrayLike, scores: ArrayLike, colour: str, label: str, **style: Any) -> None:
    """Draw the interquartile mean of scores, one row a seed, with a band of its 95 % interval if there are several."""
    mean, low, high = over_seeds(scores)
    axes.plot(x, mean, color=colour, label=label, **{"lw": 1.4, **style})
    if not np.isnan(low).all():
        axes.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)


def plot_learning_curves(
    curves: Mapping[str, list[pd.DataFrame]], title: str, metric: str = "mape_percent", label: str = "MAPE (%)"
) -> Figure:
    """
    Draw the error of policies on held-out discharges during training, over seeds, with one colour an algorithm.

    :param curves: by algorithm, for each seed a table with ``timesteps``, the metric (mean over discharges) and the metric
        followed by ``_worst``, as :class:`~battery_env.callbacks.CalibrationCallback` writes it
    :param title: title of the figure
    :param metric: name of the metric
    :param label: its label
    """
    figure = new_figure(7.2, 3.7)
    panels = {metric: "mean", f"{metric}_worst": "worst"}
    for axes, (column, panel) in zip(figure.subplots(1, 2, sharex=True), panels.items(), strict=True):
        for colour, (name, tables) in coloured(curves.items()):
            seeds = pd.concat([table.set_index("timesteps")[column] for table in tables], axis=1).T
            draw_over_seeds(axes, seeds.columns / 1e3, seeds, colour, name)
        all_positive = all((table[column] > 0).all() for tables in curves.values() for table in tables)
        axes.set(yscale="log" if all_positive else "linear", xlabel="environment steps (thousands)", ylabel=label)
        axes.set_title(panel, fontsize=10)
        axes.grid(which="both", alpha=0.25)
    figure.suptitle(title, fontsize=11)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def plot_discharge(record: Record, forecasts: Mapping[str, VoltageForecast], title: str = "") -> Figure:
    """
    Draw the measured voltage of one discharge, the model voltage at some estimates, the current, and the error of the model.

    :param record: one discharge, simulated or recorded
    :param forecasts: results of :meth:`battery_env.RecordModel.forecast`, by name for the legend
    :param title: of the figure
    :return: the figure; a voltage ends at the cut-off, and its error where the model cell is empty
    """
    figure = new_figure(6.4, 5.4)
    upper, middle, lower = panels = figure.subplots(3, 1, sharex=True, height_ratios=[5, 2, 3])
    upper.plot(record.time_s, record.voltage_V, "o", ms=2.2, color=COLOUR_OF["measured"], label="measured")
    middle.plot(record.time_s, record.current_A, color=COLOUR_OF["measured"], lw=1.2)
    lower.axhline(0.0, color="0.6", lw=0.8)
    for colour, (name, forecast) in coloured(forecasts.items()):
        upper.plot(forecast.time_s, forecast.voltage_V, color=colour, lw=1.4, label=name)
        error_mV = 1e3 * (forecast.at_samples_V - record.voltage_V)
        lower.plot(record.time_s, error_mV, color=colour, lw=1.0, label=name)
    figure.suptitle(title, fontsize=10)
    upper.set_ylabel("voltage (V)")
    upper.legend(frameon=False, fontsize=9, loc="lower left")
    largest_A = float(record.current_A.max())
    middle.set(ylabel="current (A)", ylim=(min(-0.1 * largest_A, 1.1 * float(record.current_A.min())), 1.2 * largest_A))
    lower.set(xlabel="time (s)", ylabel="model -\nmeasured (mV)")
    return _with_grid(figure, *panels)


def plot_cell_fit(fit: CellFit, discharges: Sequence[Record]) -> Figure:
    """
    Draw measured and model voltage with the constants before and after a fit, and the errors below: one column a discharge.
    The figure fits ``q_mobile`` and ``r_o`` to each discharge, with both sets of constants.

    :param fit: result of :func:`battery_env.fit_cell`
    :param discharges: discharges of the fit, or others; a :class:`~battery_env.Discharge` counts from load-on to the cut-off
    """
    figure = new_figure(3.2 * len(discharges) + 0.9, 4.8)
    panels = figure.subplots(2, len(discharges), sharey="row", sharex="col", height_ratios=[3, 2], squeeze=False)
    cells = {"before": (fit.start, "--", COLOURS[4]), "after": (fit.cell, "-", COLOUR_OF["least squares"])}
    for (upper, lower), discharge in zip(panels.T, discharges, strict=True):
        record = discharge.loaded_part(fit.cell.VEOD) if isinstance(discharge, Discharge) else discharge
        since_s = record.time_s - record.time_s[0]
        upper.plot(since_s, record.voltage_V, "o", ms=2.2, color=COLOUR_OF["measured"], label="measured")
        lower.axhline(0.0, color="0.6", lw=0.8)
        errors_mV = []
        for name, (cell, style, colour) in cells.items():
            calibrator = LeastSquares(cell=cell, thermal=fit.thermal)
            model_V = calibrator.model.voltage(record, calibrator.estimate(record))
            error_mV = 1e3 * (model_V - record.voltage_V)
            errors_mV.append(float(np.sqrt(np.nanmean(error_mV**2))))
            upper.plot(since_s, model_V, style, color=colour, lw=1.3, label=f"model, constants {name} the fit")
            lower.plot(since_s, error_mV, style, color=colour, lw=1.1)
        meta = getattr(record, "meta", {})
        name = literal(f"{meta['cell']}:{meta['cycle']}, ") if {"cell", "cycle"} <= set(meta) else ""
        upper.set_title(f"{name}RMSE {errors_mV[0]:.0f} → {errors_mV[1]:.0f} mV", fontsize=9)
        lower.set_xlabel("time (s)")
    panels[0, 0].set_ylabel("voltage (V)")
    panels[1, 0].set_ylabel("model - measured (mV)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return _with_grid(figure, *panels.ravel())


def plot_life(table: pd.DataFrame) -> Figure:
    """
    Draw q_max, the resistance and the charge drawn of cells over their discharges, one line a cell, with bars of two standard
    deviations to either side. Estimates that are not settled are hollow, without bars.

    Most of the error of an estimate is the error of the model or of a sensor, which all discharges of a cell share: it shifts
    a line without bending it. The scatter of the points shows the other errors.

    :param table: a row a discharge with ``cycle``, ``q_mobile_C``, ``sd_q_mobile_C``, ``resistance_10s_ohm`` or ``r_o_ohm``,
        its standard deviation, ``drawn_Ah`` and ``settled``, as the command line writes it, and for several cells ``cell``. If
        each cell has one discharge, the rows are the discharges of one cell. The axis is the cycle, or the order of the rows
        if a cycle is unknown
    :raises ValueError: for estimates of more than one ``method``, whose ``r_o`` mean different things
    """
    if "method" in table and table["method"].nunique() > 1:
        raise ValueError(
            f"a life is drawn for one method, got {' and '.join(table['method'].unique())}: their r_o differ by up to a third"
        )
    has_measurable = "resistance_10s_ohm" in table and table["resistance_10s_ohm"].notna().any()
    omitted = "r_o_ohm" if has_measurable else "resistance_10s_ohm"
    figure = new_figure(6.8, 6.8)
    panels = figure.subplots(3, 1, sharex=True)
    is_single_cell = "cell" not in table or not table["cell"].duplicated().any()
    cells = [("", table)] if is_single_cell else list(table.groupby("cell", sort=False))
    is_numbered = all(rows["cycle"].notna().all() and not rows["cycle"].duplicated().any() for _, rows in cells)
    for colour, (name, cell_table) in coloured(cells):
        number = cell_table["cycle"].astype(float) if is_numbered else np.arange(1.0, len(cell_table) + 1.0)
        rows = cell_table.set_index(number).sort_index()
        settled = rows["settled"].astype(bool)
        entries = [(column, *entry) for column, entry in _LIFE_COLUMNS.items() if column != omitted]
        for axes, (column, label, scale) in zip(panels, entries, strict=True):
            values = scale * rows[column]
            bars = 2.0 * scale * rows[f"sd_{column}"][settled] if f"sd_{column}" in rows else None
            axes.plot(values, color=colour, lw=0.8, alpha=0.6)
            axes.plot(values[~settled], "o", ms=3.2, mfc="white", mec=colour, mew=0.8)
            points = values[settled]
            axes.errorbar(points.index, points, bars, fmt="o", ms=2.6, color=colour, elinewidth=0.4, label=literal(str(name)))
            axes.set_ylabel(label)
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[-1].set_xlabel("cycle" if is_numbered else "discharge")
    figure.suptitle("bars: two standard deviations, mostly common to all points of a cell; hollow: not settled", fontsize=9)
    if len(cells) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        first = slice(len(COLOURS))
        figure.legend(handles[first], labels[first], loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return _with_grid(figure, *panels)


def _with_grid(figure: Figure, *panels: Axes) -> Figure:
    for axes in panels:
        axes.grid(alpha=0.25)
    figure.align_ylabels()
    return figure
