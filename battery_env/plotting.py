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

Thing = TypeVar("Thing")

#: Colours that colour-blind readers can tell apart (the first six and black of Okabe & Ito, the others of Tol).
COLOURS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#882255", "#777777", "#999933", "#332288", "#000000"),
)
#: What is drawn in more than one figure has one colour in all of them, wherever its name occurs in a label.
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
#: Of the axes of parameters.
LABELS = {name: parameter.label for name, parameter in PARAMETERS.items()}

# Title of the axis of each panel of a life, in the units of a lab, with the scale to them. Of both resistances the one that
# the table has.
_LIFE_COLUMNS = {
    "q_mobile_C": (f"{Q_MOBILE.symbol} (Ah)", 1.0 / 3600.0),
    "resistance_10s_ohm": (r"10 s resistance (m$\Omega$)", 1e3),
    "r_o_ohm": (rf"{R_O.symbol} (m$\Omega$)", 1e3),
    "drawn_Ah": ("charge drawn (Ah)", 1.0),
}
_NAMES = re.compile("|".join(rf"\b{name}\b" for name in COLOUR_OF), flags=re.IGNORECASE)
_COLOUR_OF_LOWER = {name.lower(): colour for name, colour in COLOUR_OF.items()}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure in the project's style, outside pyplot's global state, of some inches."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def literal(text: str) -> str:
    """A text that nothing in is taken for mathematics, as a name with dollars would be."""
    return text.replace("$", r"\$")


def titles_of(figure: Figure) -> dict[str, str]:
    """The titles of a figure, as the metadata of its PNG: readable without looking at it."""
    titles = [figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)]
    return {"Title": "; ".join(filter(None, titles))}


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """
    Save a figure; the file is written beside its place and renamed, so that it is never there in part.

    :param figure: the figure
    :param path: where to; its suffix chooses the format
    """
    with replacing(path) as part:
        # not the resolution of matplotlib's settings, which other libraries change
        figure.savefig(part, dpi="figure", metadata=titles_of(figure) if part.suffix == ".png" else None)
    return Path(path)


def plot_true_against_inferred(scores: Mapping[str, pd.DataFrame], parameter: str) -> Figure:
    """
    The paper's figure, one column per calibrator: the true parameter of each discharge against the mean of its estimates (bar:
    their standard deviation), and below it the error, which the upper panel is too coarse for.

    :param scores: what :func:`battery_env.evaluation.evaluate` returned, by name of the calibrator
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
        lower.set(yscale="log", xlabel=f"true {LABELS[parameter]}")
        lower.grid(alpha=0.25)
    panels[0, 0].set_ylabel(f"inferred {LABELS[parameter]}")
    panels[1, 0].set_ylabel("MAPE of a discharge (%)")
    figure.align_ylabels(panels[:, 0])
    figure.colorbar(points, ax=panels.ravel().tolist(), label="mean load (W)")
    return figure


def coloured(things: Iterable[Thing], variants_alike: bool = False) -> Iterator[tuple[str, Thing]]:
    """
    Things to draw side by side, names or tuples that start with one, each after its colour. The first with a name of
    :data:`COLOUR_OF` has its colour, or all have it that are told apart by something else; the others have those of
    :data:`COLOURS` that are left, which come again when they are used up.
    """
    listed = list(things)
    own = [_own_colour(thing) for thing in listed]
    left = [colour for colour in COLOURS if colour not in own]
    # beside names, a colour of another name comes last
    others = itertools.cycle(sorted(left, key=lambda colour: any(own) and colour in COLOUR_OF.values()))
    seen: set[str] = set()
    for thing, colour in zip(listed, own, strict=True):
        yield next(others) if colour is None or (colour in seen and not variants_alike) else colour, thing
        seen.add(colour or "")


def _own_colour(thing: object) -> str | None:
    while isinstance(thing, tuple):
        thing = thing[0]
    named = _NAMES.search(str(thing).replace("-", " "))
    return _COLOUR_OF_LOWER[named[0].lower()] if named else None


def draw_over_seeds(axes: Axes, x: ArrayLike, scores: ArrayLike, colour: str, label: str, **style: Any) -> None:
    """
    Draw the interquartile mean of scores, one row a seed, with a band of its 95 % interval where there are several seeds
    (:func:`battery_env.evaluation.over_seeds`).
    """
    middle, low, high = over_seeds(scores)
    axes.plot(x, middle, color=colour, label=label, **{"lw": 1.4, **style})
    if not np.isnan(low).all():
        axes.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)


def plot_learning_curves(
    curves: Mapping[str, list[pd.DataFrame]], title: str, metric: str = "mape_percent", label: str = "MAPE (%)"
) -> Figure:
    """
    How a policy does on held-out discharges during training, over seeds: one colour per algorithm.

    :param curves: by algorithm, for each seed a table with ``timesteps``, the metric (mean over discharges) and the metric
        followed by ``_worst``, as :class:`~battery_env.callbacks.CalibrationCallback` writes it
    :param title: title of the figure
    :param metric: what to show
    :param label: what readers call it
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
    The measured voltage of one discharge with that of the model at some estimates, the current, and the error of the model.

    :param record: one discharge, simulated or recorded
    :param forecasts: what :meth:`battery_env.RecordModel.forecast` made of estimates, by name for the legend
    :param title: of the figure
    :return: the figure; a line ends at the cut-off, and that of its error where the model cell is empty
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
    most_A = float(record.current_A.max())
    middle.set(ylabel="current (A)", ylim=(min(-0.1 * most_A, 1.1 * float(record.current_A.min())), 1.2 * most_A))
    lower.set(xlabel="time (s)", ylabel="model -\nmeasured (mV)")
    return _finished(figure, *panels)


def plot_cell_fit(fit: CellFit, discharges: Sequence[Record]) -> Figure:
    """
    Measured and model voltage with the constants before and after a fit, and below them the errors: one column a discharge.
    ``q_mobile`` and ``r_o`` are fitted to each, with either constants.

    :param fit: what :func:`battery_env.fit_cell` returned
    :param discharges: those it was fitted to, or others; of a :class:`~battery_env.Discharge` the part from load-on to the
        cut-off is taken
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
    return _finished(figure, *panels.ravel())


def plot_life(table: pd.DataFrame) -> Figure:
    """
    What became of cells over their discharges: q_max, the resistance and the charge drawn, one line a cell, with bars of two
    standard deviations to either side. Estimates that are not settled are hollow, and have none.

    Most of the error of an estimate is that of the model or of a sensor, which all discharges of a cell share: it shifts a
    line and does not bend it. What the discharges do not share shows in the scatter of the points.

    :param table: a row a discharge with ``cycle``, ``q_mobile_C``, ``sd_q_mobile_C``, ``resistance_10s_ohm`` or ``r_o_ohm``,
        its standard deviation, ``drawn_Ah`` and ``settled``, as the command line writes it, and if there are several cells
        with ``cell``. Where each cell has one discharge in it, the rows are taken for the discharges of one cell. They are
        drawn over their cycles, or over their order where the cycles are not known
    :raises ValueError: for estimates of more than one ``method``, whose ``r_o`` mean different things
    """
    if "method" in table and table["method"].nunique() > 1:
        raise ValueError(
            f"a life is drawn for one method, got {' and '.join(table['method'].unique())}: their r_o differ by up to a third"
        )
    has_measurable = "resistance_10s_ohm" in table and table["resistance_10s_ohm"].notna().any()
    left_out = "r_o_ohm" if has_measurable else "resistance_10s_ohm"
    figure = new_figure(6.8, 6.8)
    panels = figure.subplots(3, 1, sharex=True)
    one_each = "cell" not in table or not table["cell"].duplicated().any()
    cells = [("", table)] if one_each else list(table.groupby("cell", sort=False))
    is_numbered = all(rows["cycle"].notna().all() and not rows["cycle"].duplicated().any() for _, rows in cells)
    for colour, (name, of_cell) in coloured(cells):
        number = of_cell["cycle"].astype(float) if is_numbered else np.arange(1.0, len(of_cell) + 1.0)
        rows = of_cell.set_index(number).sort_index()
        settled = rows["settled"].astype(bool)
        shown = [(column, *how) for column, how in _LIFE_COLUMNS.items() if column != left_out]
        for axes, (column, label, scale) in zip(panels, shown, strict=True):
            values = scale * rows[column]
            reach = 2.0 * scale * rows[f"sd_{column}"][settled] if f"sd_{column}" in rows else None
            axes.plot(values, color=colour, lw=0.8, alpha=0.6)
            axes.plot(values[~settled], "o", ms=3.2, mfc="white", mec=colour, mew=0.8)
            known = values[settled]
            axes.errorbar(known.index, known, reach, fmt="o", ms=2.6, color=colour, elinewidth=0.4, label=literal(str(name)))
            axes.set_ylabel(label)
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[-1].set_xlabel("cycle" if is_numbered else "discharge")
    figure.suptitle("bars: two standard deviations, mostly common to all points of a cell; hollow: not settled", fontsize=9)
    if len(cells) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        named = slice(len(COLOURS))
        figure.legend(handles[named], labels[named], loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return _finished(figure, *panels)


def _finished(figure: Figure, *panels: Axes) -> Figure:
    for axes in panels:
        axes.grid(alpha=0.25)
    figure.align_ylabels()
    return figure
