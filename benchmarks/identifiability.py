"""
What a discharge says about q_mobile and r_o, and when: every number and figure of docs/reports/identifiability.md.

.. code-block:: bash

  python -m benchmarks.identifiability

One simulated cell, discharged at a constant and at a varying current; bounds on what any calibrator can know, and what least
squares makes of records with noise, with errors that do not average out, and with priors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, ScalarFormatter

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import NEW_CELL, QNS, STATE_SIZE, VO, VSP, Trajectory, simulate, step_into
from battery_env.estimators import (
    ClosedForm,
    Estimate,
    ExtendedKalmanFilter,
    LeastSquares,
    cramer_rao_bound,
    sensitivities,
)
from battery_env.loads import RandomPiecewise, constant
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import COLOURS, LABELS, coloured, new_figure, plot_sensitivities
from battery_env.records.model import RecordModel
from battery_env.sensors import SensorErrors
from battery_env.tasks.full_state.layout import ERROR_SCALE, OBSERVED
from battery_env.trajectories import TrajectoryDataset
from benchmarks.study import SYMBOLS, Cell, Study, Tables, command_line, digits, markdown, positive, row_by_row, table_of

#: The aged cell of this study.
TRUE = Estimate(q_mobile=6000.0, r_o=0.15)
CURRENT_A = 2.0
#: The varying current, A; it changes every 60 to 140 s.
CURRENT_RANGE_A = (1.0, 3.0)
SEED = 0
NOISES_V = (0.001, 0.005, 0.010, 0.030)
#: The noise where one is enough, V: bounds are proportional to it.
NOISE_V = 0.010
#: Shares of a discharge, in time.
SHARES = (0.25, 0.5, 0.75, 1.0)
#: Those at which errors are drawn.
FINE_SHARES = tuple(np.round(np.arange(0.1, 1.001, 0.05), 2).tolist())
#: What is unknown: parameters, and whether the sensor has an offset as well.
UNKNOWNS: dict[str, tuple[tuple[str, ...], bool]] = {
    "q_max alone": (("q_mobile",), False),
    "R_o alone": (("r_o",), False),
    "both": (("q_mobile", "r_o"), False),
    "both and an offset": (("q_mobile", "r_o"), True),
}
#: A voltage sensor with an offset, V.
OFFSET_V = 0.010
OFFSET_NOISE_V = 0.005
#: Readings in an episode of the paper.
EPISODE_STEPS = 16
#: The one-step cost is looked at here: power in W, time in s, and where q_mobile is searched, C.
ONE_STEP_POWER_W = 12.0
ONE_STEP_TIME_S = 900
ONE_STEP_RANGE_C = (4000.0, 8000.0)
#: Charge that a model which was wrong for a while has too much in its negative surface, C.
DRIFTS_C = {"true": 0.0, "drifted": 0.05, "far": 20.0}
PERCENT = 100.0
# Of a discharge, as tables say it
_SEEN = "25 / 50 / 75 / 100 %"


def discharges() -> dict[str, Trajectory]:
    """The discharges of this study: the same cell at a constant and at a varying current, sampled once a second."""
    varying = RandomPiecewise(CURRENT_RANGE_A, unit="current")(np.random.default_rng(SEED))
    loads = {"constant": constant(CURRENT_A, "current"), "varying": varying}
    return {name: _discharge(load) for name, load in loads.items()}


def _discharge(load: Callable[[FloatArray], FloatArray], **changes: float) -> Trajectory:
    # a cell whose other constants are multiplied by `changes`
    cell = NEW_CELL.replace(**{name: factor * getattr(NEW_CELL, name) for name, factor in changes.items()})
    return simulate(load, TRUE.q_mobile, TRUE.r_o, load_unit="current", cell=cell)


def beginning(record: Trajectory, share: float) -> Trajectory:
    """What has been seen of a discharge."""
    return record.part(0, round(share * len(record.time_s)))


def error_percent(estimate: Estimate, name: str) -> float:
    """How far an estimate is from the aged cell."""
    return PERCENT * float(getattr(estimate, name) / getattr(TRUE, name) - 1.0)


def conservation_table() -> pd.DataFrame:
    """How exactly the full state tells both parameters, over discharges of cells of many ages under varying power."""
    data = TrajectoryDataset.generate(PARAMETER_NAMES, 50, RandomPiecewise(), SEED, r_o_range=(0.1, 0.3))
    worst = dict.fromkeys(PARAMETER_NAMES, 0.0)
    samples = 0
    for record, trace in zip(data, ClosedForm().trace(data), strict=True):
        samples += len(record.time_s)
        for name in PARAMETER_NAMES:
            error = np.abs(getattr(trace, name) / getattr(record, name) - 1.0).max()
            worst[name] = max(worst[name], float(error))
    row = {f"{name}_worst_relative_error": value for name, value in worst.items()}
    return pd.DataFrame([{"discharges": len(data), "samples": samples, **row}])


def response_table(record: Trajectory) -> pd.DataFrame:
    """How soon r_o shows after the load is switched on."""
    slope_A = sensitivities(record).by_r_o_A
    times_s = np.array([1, 3, 6, 12, 18, 30, 60])
    return pd.DataFrame({"time_s": times_s, "share_of_final_percent": PERCENT * slope_A[times_s] / slope_A[-1]})


def sensitivity_table(record: Trajectory) -> pd.DataFrame:
    """How much the voltage says about either parameter at several points of a discharge."""
    slopes = sensitivities(record)
    shares = np.array([0.01, 0.05, 0.1, 0.25, 0.5, 0.65, 0.75, 0.9, 0.95, 0.98, 1.0])
    at = np.minimum((shares * len(record.time_s)).astype(int), len(record.time_s) - 1)
    by_q_mV = 1e3 * slopes.by_q_mobile_V_per_C[at] * TRUE.q_mobile / PERCENT
    by_r_mV = 1e3 * slopes.by_r_o_A[at] * TRUE.r_o / PERCENT
    return pd.DataFrame(
        {
            "seen_percent": PERCENT * shares,
            "time_s": record.time_s[at],
            "voltage_V": record.voltage_V[at],
            "mV_per_percent_of_q_mobile": by_q_mV,
            "mV_per_percent_of_r_o": by_r_mV,
            "q_mobile_percent_per_10_mV": 10.0 / by_q_mV,
            "r_o_percent_per_10_mV": 10.0 / np.abs(by_r_mV),
        }
    )


class Bound(NamedTuple):
    """A Cramér-Rao bound over time, in percent of the true parameters."""

    time_s: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray


def bound(record: Trajectory, noise_V: float, unknown: str) -> Bound:
    """The least standard deviations over a discharge."""
    parameters, offset = UNKNOWNS[unknown]
    least = cramer_rao_bound(record, noise_V, parameters, offset)
    return Bound(least.time_s, PERCENT * least.sd_q_mobile / TRUE.q_mobile, PERCENT * least.sd_r_o / TRUE.r_o)


def bounds_table(records: dict[str, Trajectory]) -> pd.DataFrame:
    """The bounds at several points of both discharges, and from when on they are below 1 %."""
    rows = []
    for load, record in records.items():
        for unknown, (parameters, _) in UNKNOWNS.items():
            for noise_V in NOISES_V:
                least = bound(record, noise_V, unknown)
                row: dict[str, float | str] = {"load": load, "unknown": unknown, "noise_V": noise_V}
                for name in parameters:
                    sd = getattr(least, name)
                    row |= {f"{name}_sd_percent_at_{share:.0%}": sd[round(share * len(sd)) - 1] for share in SHARES}
                    within = np.flatnonzero(sd < 1.0)
                    row[f"{name}_within_1_percent_s"] = least.time_s[within[0]] if len(within) else np.inf
                rows.append(row)
    return pd.DataFrame(rows)


def late_table(records: dict[str, Trajectory]) -> pd.DataFrame:
    """What a logger loses that starts late, if the sensor has an unknown offset."""
    rows = []
    for load, record in records.items():
        slopes = sensitivities(record)
        columns = [slopes.by_q_mobile_V_per_C * TRUE.q_mobile, slopes.by_r_o_A * TRUE.r_o, np.ones(len(slopes.time_s))]
        gradient = np.column_stack(columns) / NOISE_V
        for start_s in (0, 10, 30):
            seen = gradient[slopes.time_s >= start_s]
            q_sd, r_sd, _ = PERCENT * np.sqrt(np.diag(np.linalg.inv(seen.T @ seen)))
            rows.append({"load": load, "start_s": start_s, "q_mobile_sd_percent": q_sd, "r_o_sd_percent": r_sd})
    return pd.DataFrame(rows)


def windows_table(record: Trajectory) -> pd.DataFrame:
    """What the readings of one short episode say, if the charge drawn before it is known, against all readings so far."""
    slopes = sensitivities(record)
    gradient = np.column_stack([slopes.by_q_mobile_V_per_C * TRUE.q_mobile, slopes.by_r_o_A * TRUE.r_o]) / NOISE_V
    rows = []
    for share in (0.01, *SHARES[:-1], 0.9, 0.95, 0.98, 1.0):
        stop = max(round(share * len(gradient)), EPISODE_STEPS)
        episode, all_so_far = gradient[stop - EPISODE_STEPS : stop], gradient[:stop]
        rows.append(
            {
                "seen_percent": PERCENT * share,
                "episode_alone_percent": PERCENT / np.linalg.norm(episode[:, 0]),
                "episode_joint_percent": PERCENT * np.sqrt(np.linalg.inv(episode.T @ episode)[0, 0]),
                "all_so_far_alone_percent": PERCENT / np.linalg.norm(all_so_far[:, 0]),
                "all_so_far_joint_percent": PERCENT * np.sqrt(np.linalg.inv(all_so_far.T @ all_so_far)[0, 0]),
            }
        )
    return pd.DataFrame(rows)


def least_squares_table(records: dict[str, Trajectory], draws: int) -> pd.DataFrame:
    """Least squares on records with white noise, against the bound."""
    rng = np.random.default_rng(SEED)
    rows = []
    for load, record in records.items():
        for noise_V in (0.005, 0.030):
            least, fit = bound(record, noise_V, "both"), LeastSquares(voltage_noise_V=noise_V)
            sensor = SensorErrors(noise_V=noise_V)
            for share in SHARES:
                part = beginning(record, share)
                estimates = [fit.estimate(sensor.apply(part, rng)) for _ in range(draws)]
                settled = np.array([estimate.settled for estimate in estimates])
                row: dict[str, float | str] = {"load": load, "noise_V": noise_V, "seen_percent": PERCENT * share}
                for name in PARAMETER_NAMES:
                    true = getattr(TRUE, name)
                    error = np.array([getattr(estimate, name) for estimate in estimates]) - true
                    stated = np.array([getattr(estimate, f"sd_{name}") for estimate in estimates])
                    row[f"{name}_rms_percent"] = PERCENT * np.sqrt(np.mean(error**2)) / true
                    row[f"{name}_bound_percent"] = getattr(least, name)[len(part.time_s) - 1]
                    row[f"{name}_within_2_sd_percent"] = PERCENT * np.mean(np.abs(error) <= 2.0 * stated)
                    row[f"{name}_worst_settled_percent"] = PERCENT * np.abs(error[settled]).max(initial=0.0) / true
                rows.append(row | {"settled_percent": PERCENT * settled.mean()})
    return pd.DataFrame(rows)


class Fault(NamedTuple):
    """Something that is wrong about a record or a calibrator, and does not average out."""

    sensors: SensorErrors = SensorErrors()
    cell: dict[str, float] = {}  # noqa: RUF012 (factors of constants; never changed)
    held: dict[str, float] = {}  # noqa: RUF012 (likewise: what the calibrator takes a parameter for, over its true value)


FAULTS = {
    "nothing": Fault(),
    "voltage read 10 mV too high": Fault(SensorErrors(offset_V=OFFSET_V)),
    "current read 1 % too high": Fault(SensorErrors(current_gain=1.01)),
    "kn of the cell 20 % lower": Fault(cell={"kn": 0.8}),
    "diffusion of the cell 20 % slower": Fault(cell={"tDiffusion": 1.2}),
    "tsn of the cell 20 % longer": Fault(cell={"tsn": 1.2}),
    "R_o held 10 % too low": Fault(held={"r_o": 0.9}),
    "R_o held 30 % too low": Fault(held={"r_o": 0.7}),
    "q_max held 5 % too high": Fault(held={"q_mobile": 1.05}),
}


def faults_table() -> pd.DataFrame:
    """What errors that do not average out do to estimates by least squares, without noise."""
    rng = np.random.default_rng(SEED)
    rows = []
    for load, sound in discharges().items():
        for name, fault in FAULTS.items():
            # past its own end the load of the sound cell goes on
            record = _discharge(_going_on(sound.load), **fault.cell) if fault.cell else sound
            record = fault.sensors.apply(record, rng)
            held = {held: factor * getattr(TRUE, held) for held, factor in fault.held.items()}
            free = [parameter for parameter in PARAMETER_NAMES if parameter not in held]
            fit = LeastSquares(free, cell=NEW_CELL.replace(**held))
            for share in FINE_SHARES:
                estimate = fit.estimate(beginning(record, share))
                errors = {f"{each}_error_percent": error_percent(estimate, each) for each in free}
                rows.append({"load": load, "fault": name, "seen_percent": PERCENT * share, **errors})
    return pd.DataFrame(rows)


def offsets_table(records: dict[str, Trajectory]) -> pd.DataFrame:
    """
    What a voltage sensor with noise and an offset does to a Kalman filter that does not and that does know of the offset.
    """
    rows = []
    for load, record in records.items():
        seen = SensorErrors(noise_V=OFFSET_NOISE_V, offset_V=OFFSET_V).apply(record, np.random.default_rng(SEED))
        for offset_sd_V in (0.0, OFFSET_V):
            trace = ExtendedKalmanFilter(voltage_noise_V=OFFSET_NOISE_V, offset_sd_V=offset_sd_V).trace([seen])[0]
            for share in SHARES:
                at = round(share * len(trace.time_s)) - 1
                estimate = Estimate(trace.q_mobile[at], trace.r_o[at])
                errors = {f"{each}_error_percent": error_percent(estimate, each) for each in PARAMETER_NAMES}
                rows.append({"load": load, "offset_sd_V": offset_sd_V, "seen_percent": PERCENT * share, **errors})
    return pd.DataFrame(rows)


def _going_on(load: FloatArray) -> Callable[[FloatArray], FloatArray]:
    return lambda time_s: load[np.minimum(time_s.astype(int), len(load) - 1)]


#: Priors on q_mobile: mean over the true value, and standard deviation as a share of the mean.
PRIORS: dict[str, tuple[float, float] | None] = {
    "none": None,
    "right, sd 1 %": (1.0, 0.01),
    "3 % too high, sd 1 %": (1.03, 0.01),
    "3 % too high, sd 5 %": (1.03, 0.05),
}
#: The model is wrong in its kn by this factor, and the calibrator may be told to expect such an error, V.
PRIOR_KN_FACTOR = 0.8
PRIOR_MISMATCHES_V = (0.0, 0.010)


def priors_table(record: Trajectory) -> pd.DataFrame:
    """What a prior on q_mobile does to least squares on a noisy record of a cell that differs from the model."""
    other = _discharge(_going_on(record.load), kn=PRIOR_KN_FACTOR)
    noisy = SensorErrors(noise_V=NOISE_V).apply(other, np.random.default_rng(SEED))
    rows = []
    for mismatch_V in PRIOR_MISMATCHES_V:
        for name, prior in PRIORS.items():
            given = None if prior is None else (prior[0] * TRUE.q_mobile, prior[0] * prior[1] * TRUE.q_mobile)
            fit = LeastSquares(prior_q_mobile_C=given, mismatch_V=mismatch_V, voltage_noise_V=NOISE_V)
            for share in SHARES:
                estimate = fit.estimate(beginning(noisy, share))
                rows.append(
                    {
                        "expected_mismatch_V": mismatch_V,
                        "prior": name,
                        "seen_percent": PERCENT * share,
                        "q_mobile_error_percent": error_percent(estimate, "q_mobile"),
                        "q_mobile_sd_percent": PERCENT * estimate.sd_q_mobile / TRUE.q_mobile,
                        "settled": estimate.settled,
                    }
                )
    return pd.DataFrame(rows)


def one_step_costs() -> pd.DataFrame:
    """
    How far the model's next state is from the cell's, over q_mobile, with the full state measured: in volts and coulombs as
    they are, in the error scales of the tasks, and in Vsp alone, the cost of the tasks, from states that have drifted or not.
    """
    record = simulate(ONE_STEP_POWER_W, TRUE.q_mobile, NEW_CELL.r_o)
    now, following = record.state[ONE_STEP_TIME_S], record.state[ONE_STEP_TIME_S + 1]
    # the true value is one of them
    q_mobile_C = np.arange(ONE_STEP_RANGE_C[0], ONE_STEP_RANGE_C[1] + 1.0)
    n = len(q_mobile_C)
    table = {"q_mobile_C": q_mobile_C}
    for name, drift_C in DRIFTS_C.items():
        start = now.copy()
        start[QNS] += drift_C
        after = np.empty((n, STATE_SIZE))
        load_W, r_o_ohm = np.full(n, ONE_STEP_POWER_W), np.full(n, NEW_CELL.r_o)
        step_into(
            after, np.tile(start, (n, 1)), load_W, q_mobile_C, r_o_ohm, 1.0, "power", False, NEW_CELL.packed, extended=True
        )
        error = (after - following)[:, OBSERVED]
        table[f"cost_{name}_si"] = np.linalg.norm(error, axis=1)
        table[f"cost_{name}_scaled"] = np.linalg.norm(error / ERROR_SCALE, axis=1)
        table[f"cost_{name}_task"] = np.abs(error / ERROR_SCALE)[:, VSP - VO]
    return pd.DataFrame(table)


def minima_table(costs: pd.DataFrame) -> pd.DataFrame:
    """The local minima of the one-step cost."""
    rows = []
    for column in costs.columns[1:]:
        values = costs[column].to_numpy()
        for n in 1 + np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])):
            rows.append({"cost": column, "q_mobile_C": costs["q_mobile_C"].iloc[n], "value": values[n]})
    return pd.DataFrame(rows)


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
    for axes, name in zip(panels[:, 0], PARAMETER_NAMES, strict=True):
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
            for axes, name in zip(panels, PARAMETER_NAMES, strict=True):
                axes.plot(least.time_s, getattr(least, name), style, color=colour, lw=1.5, label=f"{load} load, {words}")
    for axes, name, limits in zip(panels, PARAMETER_NAMES, ((1e-2, 1e2), (3e-2, 3e1)), strict=True):
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
        of_lab = q_mobile_C / 3600.0, 1e3 * r_o_ohm, misfit_mV
        drawn = axes.contourf(*of_lab, levels, cmap="viridis_r", norm=BoundaryNorm(levels, 256))
        axes.contour(*of_lab, levels, colors="w", linewidths=0.4)
        axes.plot(TRUE.q_mobile / 3600.0, 1e3 * TRUE.r_o, "+", color=COLOURS[1], ms=9, mew=1.8)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("$q_{max}$ (Ah)")
    panels[0].set_ylabel(r"$R_o$ (m$\Omega$)")
    figure.colorbar(drawn, ax=panels.tolist(), label="rms misfit (mV)")
    return figure


def plot_faults(faults: pd.DataFrame) -> Figure:
    """The error of q_mobile over the constant discharge, for several faults."""
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots()
    shown = [name for name, fault in FAULTS.items() if name != "nothing" and "q_mobile" not in fault.held]
    for colour, marker, name in zip(COLOURS, "osD^v<>", shown, strict=False):
        part = faults[(faults["load"] == "constant") & (faults["fault"] == name)]
        error_percent, label = part["q_mobile_error_percent"], name.replace("R_o", "$R_o$")
        axes.plot(part["seen_percent"], error_percent, marker=marker, ms=3.5, lw=1.2, color=colour, label=label)
    axes.axhline(0.0, color="0.5", lw=0.8)
    axes.set(xlabel="seen of the discharge, in time (%)", ylabel=f"error of {LABELS['q_mobile'].split(' (')[0]} (%)")
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    axes.set_yticks([-20, -10, -5, -2, -1, 0, 1, 2, 5])
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.grid(alpha=0.25)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _at_shares(table: pd.DataFrame, column: str, digits: int = 1, sign: str = "+") -> str:
    """One column at ``SHARES``."""
    rows = table[np.isclose(table["seen_percent"].to_numpy()[:, None], PERCENT * np.array(SHARES)).any(axis=1)]
    # no sign for what is zero once it is rounded
    values = [f"{value:{sign}.{digits}f}" if round(value, digits) else f"{0:.{digits}f}" for value in rows[column]]
    return "held" if rows[column].isna().all() else " / ".join(values)


def _shown_within(table: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for noise_V, part in table[table["load"] == "constant"].groupby("noise_V"):
        by_unknown, row = part.set_index("unknown"), {"noise of a reading": f"{1e3 * float(str(noise_V)):.0f} mV"}
        for name, label in SYMBOLS.items():
            for unknown in (f"{label} alone", "both", "both and an offset"):
                time_s = by_unknown.loc[unknown, f"{name}_within_1_percent_s"]
                title = f"{label}, {'the other known' if unknown.endswith('alone') else unknown + ' unknown'}"
                row[title] = "never" if np.isinf(time_s) else f"{time_s:.0f} s"
        rows.append(row)
    return pd.DataFrame(rows)


def _shown_loads(table: pd.DataFrame) -> pd.DataFrame:
    def sd_of(name: str) -> Callable[[dict[str, float]], str]:
        def said(bounds: dict[str, float]) -> str:
            values = [bounds[f"{name}_sd_percent_at_{share:.0%}"] for share in SHARES]
            return "known" if np.isnan(values).all() else " / ".join(f"{value:.2g}" for value in values)

        return said

    cells = {f"sd of {label} (%) at {_SEEN}": sd_of(name) for name, label in SYMBOLS.items()}
    return row_by_row(table[table["noise_V"] == NOISE_V], {"load": "{load}", "unknown": "{unknown}", **cells})


def _shown_faults(table: pd.DataFrame) -> pd.DataFrame:
    def error_of(name: str, load: str) -> Cell:
        return lambda part: _at_shares(part[part["load"] == load], f"{name}_error_percent")

    loads = table["load"].unique()
    cells = {f"{label} (%), {load} load": error_of(name, load) for load in loads for name, label in SYMBOLS.items()}
    return table_of(table, {"fault": f"error at {_SEEN}"}, cells)


def _shown_offsets(table: pd.DataFrame) -> pd.DataFrame:
    cells: dict[str, Cell] = {
        f"error of q_max (%) at {_SEEN}": lambda part: _at_shares(part, "q_mobile_error_percent"),
        "error of R_o (%)": lambda part: _at_shares(part, "r_o_error_percent"),
    }
    shown = table.assign(offset=[f"sd {1e3 * offset_sd_V:.0f} mV" for offset_sd_V in table["offset_sd_V"]])
    return table_of(shown, {"load": "load", "offset": "offset that the filter allows for"}, cells)


def _shown_priors(table: pd.DataFrame) -> pd.DataFrame:
    cells: dict[str, Cell] = {
        f"error of q_max (%) at {_SEEN}": lambda part: _at_shares(part, "q_mobile_error_percent"),
        "stated sd (%)": lambda part: _at_shares(part, "q_mobile_sd_percent", 2, ""),
    }
    shown = table.assign(expected=[f"{1e3 * mismatch_V:.0f} mV" for mismatch_V in table["expected_mismatch_V"]])
    return table_of(shown, {"prior": "prior", "expected": "error of the model that is expected"}, cells)


def _shown_minima(table: pd.DataFrame) -> pd.DataFrame:
    starts = {name: f"a state {drift_C:g} C off" if drift_C else "the true state" for name, drift_C in DRIFTS_C.items()}
    units = {"si": "all states, V and C", "scaled": "all states, error scales", "task": "Vsp, error scales"}
    parts = table["cost"].str.split("_", expand=True)
    shown = table.assign(of=parts[2].map(units), start=parts[1].map(starts))
    shown["minimum"] = [f"{q_mobile_C:.0f} C ({value:.2g})" for q_mobile_C, value in table[["q_mobile_C", "value"]].to_numpy()]
    return table_of(shown, {"of": "one-step cost of", "start": "from"}, {"minima (cost there)": ("minimum", ", ".join)})


def _response_row(table: pd.DataFrame) -> pd.DataFrame:
    shares = zip(table["time_s"], table["share_of_final_percent"], strict=True)
    row = {"time under load": "effect of R_o on the voltage"}
    return pd.DataFrame([row | {f"{time_s:.0f} s": f"{percent:.0f} %" for time_s, percent in shares}])


def _worst(share: float) -> str:
    return f"{PERCENT * share:.1g}"


#: The tables as readers see them, by the name of what they show: cells of each row, or what makes the table.
READABLE: tuple[tuple[str, Mapping[str, Cell] | Callable[[pd.DataFrame], pd.DataFrame]], ...] = (
    (
        "conservation",
        {
            "discharges": "{discharges}",
            "samples": "{samples}",
            "largest error of q_max (%)": ("q_mobile_worst_relative_error", _worst),
            "largest error of R_o (%)": ("r_o_worst_relative_error", _worst),
        },
    ),
    ("response", _response_row),
    (
        "sensitivity",
        {
            "seen": "{seen_percent:.0f} %",
            "voltage (V)": "{voltage_V:.2f}",
            "1 % more q_max (mV)": "{mV_per_percent_of_q_mobile:+.1f}",
            "1 % more R_o (mV)": "{mV_per_percent_of_r_o:+.1f}",
            "10 mV are worth, in q_max (%)": "{q_mobile_percent_per_10_mV:.2g}",
            "in R_o (%)": "{r_o_percent_per_10_mV:.2g}",
        },
    ),
    ("bounds", _shown_within),
    ("bounds", _shown_loads),
    (
        "late",
        {
            "load": "{load}",
            "first reading after": "{start_s:.0f} s",
            "sd of q_max at the end (%)": "{q_mobile_sd_percent:.2g}",
            "sd of R_o at the end (%)": ("r_o_sd_percent", lambda percent: f"{percent:#.3g}".rstrip(".")),
        },
    ),
    ("offsets", _shown_offsets),
    (
        "windows",
        {
            "until": "{seen_percent:.0f} %",
            f"{EPISODE_STEPS} readings, R_o known": ("episode_alone_percent", digits),
            f"{EPISODE_STEPS} readings, R_o unknown": ("episode_joint_percent", digits),
            "all so far, R_o known": ("all_so_far_alone_percent", digits),
            "all so far, R_o unknown": ("all_so_far_joint_percent", digits),
        },
    ),
    (
        "least_squares",
        {
            "load": "{load}",
            "noise": ("noise_V", lambda noise_V: f"{1e3 * noise_V:.0f} mV"),
            "seen": "{seen_percent:.0f} %",
            "q_max: error / bound (%)": "{q_mobile_rms_percent:.2g} / {q_mobile_bound_percent:.2g}",
            "q_max: within 2 sd (%)": "{q_mobile_within_2_sd_percent:.0f}",
            "R_o: error / bound (%)": "{r_o_rms_percent:.2g} / {r_o_bound_percent:.2g}",
            "R_o: within 2 sd (%)": "{r_o_within_2_sd_percent:.0f}",
            "settled (%)": "{settled_percent:.0f}",
            "worst q_max of these (%)": lambda found: (
                f"{found['q_mobile_worst_settled_percent']:.2g}" if found["settled_percent"] else ""
            ),
        },
    ),
    ("faults", _shown_faults),
    ("priors", _shown_priors),
    ("minima", _shown_minima),
)


def summary(tables: Tables) -> str:
    """The tables as readers see them, as Markdown."""
    shown = [how(tables[name]) if callable(how) else row_by_row(tables[name], how) for name, how in READABLE]
    return "\n".join(markdown(table) for table in shown)


#: By name, what makes each table, from the discharges and how often noise is drawn.
TABLES: dict[str, Callable[[dict[str, Trajectory], int], pd.DataFrame]] = {
    "conservation": lambda records, draws: conservation_table(),
    "response": lambda records, draws: response_table(records["constant"]),
    "sensitivity": lambda records, draws: sensitivity_table(records["constant"]),
    "bounds": lambda records, draws: bounds_table(records),
    "late": lambda records, draws: late_table(records),
    "windows": lambda records, draws: windows_table(records["constant"]),
    "least_squares": lambda records, draws: least_squares_table(records, draws),
    "faults": lambda records, draws: faults_table(),
    "offsets": lambda records, draws: offsets_table(records),
    "priors": lambda records, draws: priors_table(records["constant"]),
    "minima": lambda records, draws: minima_table(one_step_costs()),
}


def part(table: str, draws: int) -> Tables:
    """A part of the study."""
    return {table: TABLES[table](discharges(), draws)}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("identifiability", __doc__)
    parser.add_argument("--draws", type=positive, default=100, help="records with noise per case of least squares")
    study = Study(parser, arguments)
    tables = study.run(part, [{"table": name, "draws": study.chosen.draws} for name in TABLES])
    study.configuration |= {
        "q_mobile_C": TRUE.q_mobile,
        "r_o_ohm": TRUE.r_o,
        "current_A": CURRENT_A,
        "current_range_A": CURRENT_RANGE_A,
        "seed": SEED,
    }
    records = discharges()
    figures = {
        "sensitivity": plot_sensitivities({f"{load} current": sensitivities(of) for load, of in records.items()}, TRUE),
        "bounds": plot_bounds(records),
        "loads": plot_loads(records),
        "faults": plot_faults(tables["faults"]),
        "misfits": plot_misfits(records),
    }
    study.write(tables, figures, summary(tables), "summary")


if __name__ == "__main__":
    main()
