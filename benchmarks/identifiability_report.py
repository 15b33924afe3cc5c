"""The figures of ``benchmarks.identifiability``, and its tables as readers see them."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from battery_env.electrochemistry import Trajectory
from battery_env.plotting import COLOURS, LABELS, coloured, new_figure
from battery_env.record_model import RecordModel
from benchmarks.identifiability_tables import (
    DRIFT_C,
    EPISODE_STEPS,
    FAULTS,
    NAMES,
    NOISE_V,
    NOISES_V,
    PERCENT,
    SHARES,
    TRUE,
    beginning,
    bound,
)
from benchmarks.study import SYMBOLS, digits, markdown


def plot_bounds(records: dict[str, Trajectory]) -> Figure:
    """The bounds over the constant discharge, for several noises and unknowns."""
    record, unknowns = records["constant"], ("alone", "both", "both and an offset")
    figure = new_figure(7.8, 4.2)
    panels = figure.subplots(2, len(unknowns), sharex=True, sharey="row")
    for column, unknown in enumerate(unknowns):
        for axes, name, label in zip(panels[:, column], *zip(*SYMBOLS.items(), strict=True), strict=True):
            for colour, noise_V in coloured(NOISES_V):
                least = bound(record, noise_V, f"{label} alone" if unknown == "alone" else unknown)
                axes.plot(least.time_s, getattr(least, name), color=colour, lw=1.4, label=f"{1e3 * noise_V:.0f} mV")
            axes.axhline(1.0, color="0.5", lw=0.8, ls="--")
            axes.set(yscale="log", ylim=(1e-3, 1e2) if name == "q_mobile" else (3e-3, 3e1))
            axes.yaxis.set_major_locator(LogLocator(numticks=8))
            axes.grid(alpha=0.25)
        panels[0, column].set_title({"alone": "the other one known"}.get(unknown, f"{unknown} unknown"), fontsize=9)
        panels[1, column].set_xlabel("time (s)")
    for axes, name in zip(panels[:, 0], NAMES, strict=True):
        axes.set_ylabel(f"sd of {LABELS[name].split(' (')[0]} (%)")
    figure.align_ylabels(panels[:, 0])
    handles, labels = panels[0, 0].get_legend_handles_labels()
    labels = [f"noise {label}" for label in labels]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def plot_loads(records: dict[str, Trajectory]) -> Figure:
    """What an unknown offset costs under a constant and under a varying load."""
    figure = new_figure(7.6, 3.3)
    panels = figure.subplots(1, 2, sharex=True)
    for colour, (load, record) in coloured(records.items()):
        for unknown, style, words in (("both", "--", "offset known"), ("both and an offset", "-", "offset unknown")):
            least = bound(record, NOISE_V, unknown)
            for axes, name in zip(panels, NAMES, strict=True):
                axes.plot(least.time_s, getattr(least, name), style, color=colour, lw=1.5, label=f"{load} load, {words}")
    for axes, name, limits in zip(panels, NAMES, ((1e-2, 1e2), (3e-2, 3e1)), strict=True):
        axes.set(yscale="log", xlabel="time (s)", ylabel=f"sd of {LABELS[name].split(' (')[0]} (%)", ylim=limits)
        axes.grid(alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return figure


def plot_misfits(records: dict[str, Trajectory]) -> Figure:
    """The misfit of the voltage over both parameters, without noise: of one reading, and of all readings so far."""
    figure = new_figure(8.6, 3.1)
    cases = (
        ("one reading\nat half time", "constant", 0.5, True),
        ("all until half time\nconstant load", "constant", 0.5, False),
        ("all until half time\nvarying load", "varying", 0.5, False),
        ("all until the end\nconstant load", "constant", 1.0, False),
    )
    q_mobile_C, r_o_ohm = np.linspace(5000.0, 7000.0, 101), np.linspace(0.12, 0.18, 101)
    levels = [0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0]
    panels = figure.subplots(1, len(cases), sharex=True, sharey=True)
    for axes, (title, load, share, last_only) in zip(panels, cases, strict=True):
        part = beginning(records[load], share)
        misfit_mV = np.empty((len(r_o_ohm), len(q_mobile_C)))
        for column, q_mobile in enumerate(q_mobile_C):
            # isothermal, the voltage is linear in r_o
            model_V, _, by_r_o_A = RecordModel().sensitivities(part.current_A, float(q_mobile), TRUE.r_o)
            error_V = model_V - part.voltage_V + (r_o_ohm[:, None] - TRUE.r_o) * by_r_o_A
            misfit_mV[:, column] = 1e3 * np.sqrt(np.mean(error_V[:, -1:] ** 2 if last_only else error_V**2, axis=1))
        axes.set_facecolor("0.85")
        drawn = axes.contourf(q_mobile_C, r_o_ohm, misfit_mV, levels, cmap="viridis_r", norm=BoundaryNorm(levels, 256))
        axes.contour(q_mobile_C, r_o_ohm, misfit_mV, levels, colors="w", linewidths=0.4)
        axes.plot(TRUE.q_mobile, TRUE.r_o, "+", color=COLOURS[1], ms=9, mew=1.8)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(LABELS["q_mobile"])
    panels[0].set_ylabel(LABELS["r_o"])
    figure.colorbar(drawn, ax=panels.tolist(), label="rms misfit (mV)")
    return figure


def plot_one_step(costs: pd.DataFrame) -> Figure:
    """The one-step cost over q_mobile."""
    figure = new_figure(7.6, 3.3)
    panels = figure.subplots(1, 2, sharex=True)
    titles = {"si": "in V and C", "scaled": "in error scales of the tasks"}
    starts = {"true": "from the true state", "drifted": f"{1e3 * DRIFT_C:.0f} mC off in $q_{{nS}}$"}
    for axes, (kind, title) in zip(panels, titles.items(), strict=True):
        for colour, (start, label) in coloured(starts.items()):
            axes.plot(costs["q_mobile_C"], costs[f"cost_{start}_{kind}"], color=colour, lw=1.4, label=label)
        axes.axvline(TRUE.q_mobile, color="0.5", lw=0.8, ls="--")
        axes.set(yscale="log", xlabel=LABELS["q_mobile"], ylabel="one-step cost")
        axes.set_title(title, fontsize=10)
        axes.grid(alpha=0.25)
    panels[0].legend(frameon=False, fontsize=9)
    return figure


def plot_faults(faults: pd.DataFrame) -> Figure:
    """The error of q_mobile over the constant discharge, for several faults."""
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots()
    shown = [name for name, fault in FAULTS.items() if name != "nothing" and "q_mobile" not in fault.held]
    for colour, marker, name in zip(COLOURS, "osD^v<>", shown, strict=False):
        part = faults[(faults["load"] == "constant") & (faults["fault"] == name)]
        axes.plot(
            part["seen_percent"], part["q_mobile_error_percent"], marker=marker, ms=3.5, lw=1.2, color=colour, label=name
        )
    axes.axhline(0.0, color="0.5", lw=0.8)
    axes.set(xlabel="seen of the discharge, in time (%)", ylabel=f"error of {LABELS['q_mobile'].split(' (')[0]} (%)")
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    axes.grid(alpha=0.25)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _at_shares(table: pd.DataFrame, column: str, digits: int = 1, sign: str = "+") -> str:
    """One column at ``SHARES``, as readers see it."""
    rows = table[np.isclose(table["seen_percent"].to_numpy()[:, None], PERCENT * np.array(SHARES)).any(axis=1)]
    # no sign for what is zero once it is rounded
    values = [f"{value:{sign}.{digits}f}" if round(value, digits) else f"{0:.{digits}f}" for value in rows[column]]
    return "held" if rows[column].isna().all() else " / ".join(values)


def summary(tables: dict[str, pd.DataFrame]) -> str:
    """The tables as readers see them, as Markdown."""
    seen = " / ".join(f"{share:.0%}" for share in SHARES).replace("%", "") + " %"
    readable = [
        _conservation_summary(tables["conservation"]),
        _response_summary(tables["response"]),
        _sensitivity_summary(tables["sensitivity"]),
        _within_summary(tables["bounds"]),
        _loads_summary(tables["bounds"], seen),
        _late_summary(tables["late"]),
        _offsets_summary(tables["offsets"], seen),
        _windows_summary(tables["windows"]),
        _least_squares_summary(tables["least_squares"]),
        _faults_summary(tables["faults"], seen),
        _priors_summary(tables["priors"], seen),
        _minima_summary(tables["minima"]),
    ]
    return "\n".join(markdown(table) for table in readable)


def _conservation_summary(table: pd.DataFrame) -> pd.DataFrame:
    row = table.iloc[0]
    return pd.DataFrame(
        [
            {
                "discharges": f"{row['discharges']:.0f}",
                "samples": f"{row['samples']:.0f}",
                "largest error of q^max (%)": f"{PERCENT * row['q_mobile_worst_relative_error']:.1g}",
                "largest error of R_o (%)": f"{PERCENT * row['r_o_worst_relative_error']:.1g}",
            }
        ]
    )


def _response_summary(table: pd.DataFrame) -> pd.DataFrame:
    shares = {f"{row['time_s']:.0f} s": f"{row['share_of_final_percent']:.0f} %" for _, row in table.iterrows()}
    return pd.DataFrame([{"time under load": "effect of R_o on the voltage"} | shares])


def _sensitivity_summary(table: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "seen": [f"{value:.0f} %" for value in table["seen_percent"]],
            "voltage (V)": [f"{value:.2f}" for value in table["voltage_V"]],
            "1 % more q^max (mV)": [f"{value:+.1f}" for value in table["mV_per_percent_of_q_mobile"]],
            "1 % more R_o (mV)": [f"{value:+.1f}" for value in table["mV_per_percent_of_r_o"]],
            "10 mV are worth, in q^max (%)": [f"{value:.2g}" for value in table["q_mobile_percent_per_10_mV"]],
            "in R_o (%)": [f"{value:.2g}" for value in table["r_o_percent_per_10_mV"]],
        }
    )


def _within_summary(table: pd.DataFrame) -> pd.DataFrame:
    part = table[table["load"] == "constant"]
    rows = []
    for noise_V, of_noise in part.groupby("noise_V"):
        by_unknown = of_noise.set_index("unknown")
        row = {"noise of a reading": f"{1e3 * float(str(noise_V)):.0f} mV"}
        for name, label in SYMBOLS.items():
            for unknown in (f"{label} alone", "both", "both and an offset"):
                time_s = by_unknown.loc[unknown, f"{name}_within_1_percent_s"]
                title = f"{label}, {'the other known' if unknown.endswith('alone') else unknown + ' unknown'}"
                row[title] = "never" if np.isinf(time_s) else f"{time_s:.0f} s"
        rows.append(row)
    return pd.DataFrame(rows)


def _loads_summary(table: pd.DataFrame, seen: str) -> pd.DataFrame:
    rows = []
    for (load, unknown), part in table[table["noise_V"] == NOISE_V].groupby(["load", "unknown"], sort=False):
        row = {"load": load, "unknown": unknown}
        for name, label in SYMBOLS.items():
            values = [part[f"{name}_sd_percent_at_{share:.0%}"].iloc[0] for share in SHARES]
            known = bool(np.isnan(values).all())
            row[f"sd of {label} (%) at {seen}"] = "known" if known else " / ".join(f"{value:.2g}" for value in values)
        rows.append(row)
    return pd.DataFrame(rows)


def _late_summary(table: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "load": table["load"],
            "first reading after": [f"{value:.0f} s" for value in table["start_s"]],
            "sd of q^max at the end (%)": [f"{value:.2g}" for value in table["q_mobile_sd_percent"]],
            "sd of R_o at the end (%)": [f"{value:#.3g}".rstrip(".") for value in table["r_o_sd_percent"]],
        }
    )


def _windows_summary(table: pd.DataFrame) -> pd.DataFrame:
    def column(name: str) -> list[str]:
        return [digits(value) for value in table[name]]

    return pd.DataFrame(
        {
            "until": [f"{value:.0f} %" for value in table["seen_percent"]],
            f"{EPISODE_STEPS} readings, R_o known": column("episode_alone_percent"),
            f"{EPISODE_STEPS} readings, R_o unknown": column("episode_joint_percent"),
            "all so far, R_o known": column("all_so_far_alone_percent"),
            "all so far, R_o unknown": column("all_so_far_joint_percent"),
        }
    )


def _least_squares_summary(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for _, row in table.iterrows():
        shown = {"load": row["load"], "noise": f"{1e3 * row['noise_V']:.0f} mV", "seen": f"{row['seen_percent']:.0f} %"}
        for name, label in SYMBOLS.items():
            shown[f"{label}: error / bound (%)"] = f"{row[f'{name}_rms_percent']:.2g} / {row[f'{name}_bound_percent']:.2g}"
            shown[f"{label}: within 2 sd (%)"] = f"{row[f'{name}_within_2_sd_percent']:.0f}"
        shown["settled (%)"] = f"{row['settled_percent']:.0f}"
        shown["worst q^max of these (%)"] = f"{row['q_mobile_worst_settled_percent']:.2g}" if row["settled_percent"] else ""
        rows.append(shown)
    return pd.DataFrame(rows)


def _faults_summary(table: pd.DataFrame, seen: str) -> pd.DataFrame:
    rows = []
    for fault in FAULTS:
        row = {f"error at {seen}": fault}
        for load in dict.fromkeys(table["load"]):
            part = table[(table["load"] == load) & (table["fault"] == fault)]
            for name, label in SYMBOLS.items():
                row[f"{label} (%), {load} load"] = _at_shares(part, f"{name}_error_percent")
        rows.append(row)
    return pd.DataFrame(rows)


def _offsets_summary(table: pd.DataFrame, seen: str) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "load": load,
                "offset that the filter allows for": f"sd {1e3 * float(str(offset_sd_V)):.0f} mV",
                f"error of q^max (%) at {seen}": _at_shares(part, "q_mobile_error_percent"),
                "error of R_o (%)": _at_shares(part, "r_o_error_percent"),
            }
            for (load, offset_sd_V), part in table.groupby(["load", "offset_sd_V"], sort=False)
        ]
    )


def _priors_summary(table: pd.DataFrame, seen: str) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "prior": prior,
                "error of the model that is expected": f"{1e3 * float(str(mismatch_V)):.0f} mV",
                f"error of q^max (%) at {seen}": _at_shares(part, "q_mobile_error_percent"),
                "stated sd (%)": _at_shares(part, "q_mobile_sd_percent", 2, ""),
            }
            for (mismatch_V, prior), part in table.groupby(["expected_mismatch_V", "prior"], sort=False)
        ]
    )


def _minima_summary(table: pd.DataFrame) -> pd.DataFrame:
    words = {
        "true": "the true state",
        "drifted": f"a state {1e3 * DRIFT_C:.0f} mC off",
        "si": "V and C",
        "scaled": "error scales",
    }
    rows = []
    for cost, part in table.groupby("cost", sort=False):
        _, start, kind = str(cost).split("_")
        minima = [f"{row['q_mobile_C']:.0f} C ({row['value']:.2g})" for _, row in part.iterrows()]
        rows.append({"one-step cost in": words[kind], "from": words[start], "minima (cost there)": ", ".join(minima)})
    return pd.DataFrame(rows)
