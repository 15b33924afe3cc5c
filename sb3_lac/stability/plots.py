"""Figures of roll-outs and of the decrease condition along them. ``LyapunovReport`` documents them and its tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

#: Colours that colour-blind readers can tell apart (Okabe & Ito)
BLUE, VERMILION, GREEN, ORANGE, GREY = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#7f7f7f"


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of a size in inches, outside pyplot's global state."""
    return Figure(figsize=(width, height), dpi=150, layout="constrained")


def is_wide(values: pd.Series | np.ndarray) -> bool:
    """Tell whether a logarithmic scale suits values."""
    return 0 < 10 * values.min() < values.max()


class _Numbers(LogFormatter):
    """Labels as few of the minor ticks as its base does, with numbers."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def format_log_axis(axis: Axis) -> None:
    """Label a logarithmic axis with numbers like 5 instead of powers like 5 * 10^0."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(_Numbers())


def set_log_scale(axes: Axes, axis_name: Literal["x", "y"], values: pd.Series | np.ndarray) -> None:
    """Make an axis logarithmic if that suits its values."""
    if is_wide(values):
        axes.set(**{f"{axis_name}scale": "log"})
        format_log_axis(axes.xaxis if axis_name == "x" else axes.yaxis)


def draw_episodes(transitions: pd.DataFrame, axes: Axes) -> None:
    """Draw ``L`` along some episodes."""
    # Few enough that each line can be followed
    chosen = np.unique(np.linspace(0, transitions["episode"].max(), 8).astype(int))
    of_chosen = transitions[transitions["episode"].isin(chosen)]
    for _, episode in of_chosen.groupby("episode"):
        axes.plot(episode["step"], episode["lyapunov"], color=BLUE, alpha=0.55, lw=1.1)
    deaths = of_chosen[of_chosen["terminated"]]
    if not deaths.empty:
        axes.scatter(deaths["step"], deaths["lyapunov"], s=36, color=VERMILION, marker="x", lw=1, zorder=3, label="died")
        axes.legend(fontsize=8)
    set_log_scale(axes, "y", transitions["lyapunov"])
    axes.set(xlabel="step", ylabel="$L(s, a)$", title=f"L along {len(chosen)} episodes")


def draw_by_cost(by_cost: pd.DataFrame, alpha3: float, axes: Axes) -> None:
    """Draw the decrease condition by level of the cost."""
    positions = np.arange(len(by_cost))
    axes.axhline(0, color="0.4", lw=1)
    colours = np.select([by_cost["decrease_high"] < 0, by_cost["decrease_low"] > 0], [GREEN, VERMILION], GREY).tolist()
    axes.vlines(positions, by_cost["decrease_low"], by_cost["decrease_high"], colors=colours, lw=2)
    axes.scatter(positions, by_cost["decrease"], c=colours, s=30, zorder=3)
    labels = [f"{low:.2g}\nto {high:.2g}" for low, high in zip(by_cost["cost_low"], by_cost["cost_high"], strict=True)]
    axes.set_xticks(positions, labels, fontsize=8)
    axes.margins(x=0.1)
    axes.set(
        xlabel="cost of the transition",
        ylabel=r"mean of $L(s', a') - L(s, a) + \alpha_3 c$",
        title=f"Decrease condition by cost, alpha3={alpha3:g}",
    )


def draw_calibration(transitions: pd.DataFrame, axes: Axes) -> None:
    """Draw ``L`` against the cost-to-go."""
    axes.set(xlabel="$L(s, a)$", ylabel="cost-to-go", title="L against the cost-to-go")
    calibrated = transitions.loc[transitions["cost_to_go"].notna(), ["lyapunov", "cost_to_go"]]
    if calibrated.empty:
        axes.text(0.5, 0.5, "no episode is long enough", transform=axes.transAxes, ha="center", color="0.4")
        return
    limits = [calibrated.to_numpy().min(), calibrated.to_numpy().max()]
    axes.plot(limits, limits, color="0.4", lw=1, label="identity", zorder=3)
    # More points would only cover each other
    points = calibrated.iloc[:: math.ceil(len(calibrated) / 5000)]
    axes.scatter(points["lyapunov"], points["cost_to_go"], s=4, color=BLUE, alpha=0.3, lw=0, rasterized=True)
    # Both or none: the identity is a straight line
    if is_wide(calibrated["lyapunov"]) and is_wide(calibrated["cost_to_go"]):
        set_log_scale(axes, "x", calibrated["lyapunov"])
        set_log_scale(axes, "y", calibrated["cost_to_go"])
    axes.legend(fontsize=8)


def draw_costs(transitions: pd.DataFrame, bound: float, name: str, axes: Axes) -> None:
    """Draw the costs over time."""
    low, median, high = transitions.groupby("step")["cost"].quantile(np.array([0.1, 0.5, 0.9])).unstack().to_numpy().T
    steps = np.arange(len(median))
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, lw=0, label="10 % to 90 % of the episodes")
    axes.plot(steps, median, color=BLUE, lw=1.4, label="median")
    if not math.isnan(bound):
        axes.axhline(bound, color=ORANGE, ls="--", lw=1.2, label=f"{name} {bound:.2g}")
    set_log_scale(axes, "y", low)
    axes.set(xlabel="step", ylabel="cost", title="Costs over time")
    axes.legend(fontsize=8)


def plot_report(transitions: pd.DataFrame, by_cost: pd.DataFrame, alpha3: float, ultimate_bound: float) -> Figure:
    """See ``LyapunovReport.plot()``."""
    figure = new_figure(9.5, 7.0)
    along_episodes, of_decrease, of_calibration, of_costs = figure.subplots(2, 2).flat
    draw_episodes(transitions, along_episodes)
    draw_by_cost(by_cost, alpha3, of_decrease)
    draw_calibration(transitions, of_calibration)
    draw_costs(transitions, ultimate_bound, "ultimate bound", of_costs)
    return figure


def plot_drift(by_cost: pd.DataFrame, cost_bound: float, cost_bound_alpha3: float, start_cost: float) -> Figure:
    """See ``LyapunovReport.plot_drift()``."""
    figure = new_figure(5.6, 4.2)
    axes = figure.subplots()
    cost, drift = by_cost["cost"], by_cost["drift"]
    axes.axhline(0, color="0.4", lw=1)
    axes.scatter(cost, drift, color=np.where(drift < 0, GREEN, VERMILION).tolist(), s=30, zorder=3)
    if not math.isnan(cost_bound_alpha3):
        # Many points, for the axes may be logarithmic
        along = np.interp(np.linspace(0, len(cost) - 1, 500), np.arange(len(cost)), np.sort(cost))
        axes.plot(along, cost_bound_alpha3 * (cost_bound - along), color=BLUE, lw=1.2, label=r"$-\alpha_3 c + b$")
    if not math.isnan(cost_bound):
        axes.axvline(cost_bound, color=ORANGE, ls="--", lw=1.2, label=f"$b / \\alpha_3$ = {cost_bound:.2g}")
    axes.axvline(start_cost, color="0.4", ls=":", lw=1.2, label=f"at the start {start_cost:.2g}")
    # The smallest costs are told apart, and the largest are still seen
    largest = float(np.abs(drift).max()) if len(drift) > 0 else 0.0
    if is_wide(cost) and largest > 0:
        smallest = float(cost.min())
        axes.set_xscale("symlog", linthresh=10 * smallest)
        axes.set_yscale("symlog", linthresh=max(10 * smallest, 1e-3 * largest))
    axes.margins(0.1)
    axes.set(xlabel="cost of the transition", ylabel="mean of $L(s', a') - L(s, a)$", title="Drift by cost")
    axes.legend(fontsize=8)
    return figure


def plot_certification(
    statements: pd.DataFrame, transitions: pd.DataFrame, ultimate_bound: float | None, own_bound: bool
) -> Figure:
    """See ``CertificationReport.plot()``."""
    figure = new_figure(9.5, 3.6)
    of_statements, of_costs = figure.subplots(1, 2)
    positions = np.arange(len(statements))[::-1]
    of_statements.barh(positions, statements["at_least"], height=0.4, color=GREEN, label="at least")
    of_statements.scatter(statements["share"], positions, color="black", s=24, zorder=3, label="of these episodes")
    names = [
        f"{str(name).replace('_', ' ')}\n{row['n_true']:.0f} of {row['n_episodes']:.0f}" for name, row in statements.iterrows()
    ]
    of_statements.set_yticks(positions, names)
    of_statements.set(
        xlim=(0, 1.02),
        ylim=(-0.9, len(statements) - 0.5),
        xlabel="probability",
        title="With 95 % confidence",
    )
    of_statements.legend(fontsize=8, loc="lower left", ncols=2)
    bound = math.nan if ultimate_bound is None else ultimate_bound
    draw_costs(transitions, bound, "bound of this loop alone" if own_bound else "stated bound", of_costs)
    return figure


def plot_region_of_attraction(starts: pd.DataFrame, x: int, y: int, names: Sequence[str] | None) -> Figure:
    """See ``CertificationReport.plot_region_of_attraction()``."""
    states = starts[[column for column in starts if str(column).startswith("state_")]].to_numpy()
    n_dims = states.shape[1]
    if not (0 <= x < n_dims and 0 <= y < n_dims):
        raise ValueError(f"x={x} and y={y} must lie between 0 and {n_dims - 1}, the states have {n_dims} dimensions.")
    if names is None:
        names = [f"state {k}" for k in range(n_dims)]
    if len(names) != n_dims:
        raise ValueError(f"names={list(names)} must name all {n_dims} dimensions of the states.")
    points = states[:, [x, y]]
    figure = new_figure(5.8, 4.8)
    axes = figure.subplots()
    # The worst of those that differ in other dimensions
    order = np.argsort(-starts["low"].to_numpy(), kind="stable")
    sorted_points, low = points[order], starts["low"].to_numpy()[order]
    # tiles that nearly touch on a grid, and points where starts lie anywhere
    side_points = np.clip(200.0 / max(len(np.unique(column)) for column in points.T), 6.5, 40.0)
    marks = axes.scatter(
        sorted_points[:, 0], sorted_points[:, 1], c=low, s=side_points**2, marker="s", cmap="viridis", vmin=0.0, vmax=1.0
    )
    never = (starts["n_attracted"] == 0).to_numpy()
    axes.scatter(points[never, 0], points[never, 1], s=20, color=VERMILION, marker="x", lw=1, label="never attracted")
    figure.colorbar(marks, ax=axes, label="probability of attraction, at least (95 % interval)")
    if never.any():
        # Beside the axes: a grid of starts leaves no room in a corner
        figure.legend(fontsize=8, loc="outside lower center")
    title = f"{len(points)} start states, {starts['n_episodes'].iloc[0]} episodes each"
    axes.set(title=title, xlabel=names[x], ylabel=names[y])
    return figure
