"""
What a user would pick instead of a learned policy, on the same work: calibrators that need no training, and the bound on all.

.. code-block:: bash

  python -m benchmarks.peers

Simulated discharges under power that changes every 60 to 140 s, 30 of cells with a worn q_mobile and 30 with a worn r_o; then
30 with both, and the same with worse sensors. The cells are full and at rest when a discharge starts, and every calibrator
starts from a new cell's parameters. Finished parts are not run again. Parts that run at the same time (``--jobs``) may cost
each other time, which is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from battery_env.electrochemistry import NEW_CELL
from battery_env.estimators.base import Estimator
from battery_env.estimators.closed_form import ClosedForm
from battery_env.estimators.greedy import GreedyOneStep
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.evaluation import evaluate
from battery_env.loads import RandomPiecewise
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS
from battery_env.plotting import COLOURS, LABELS, new_figure
from battery_env.sensors import SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.progpy_filters import ProgpyFilter
from benchmarks.study import SYMBOLS, Study, Tables, command_line, digits, duration, markdown, positive

R_O_RANGE_OHM = (0.117, 0.35)
#: A cell that is a little worn in both parameters: 10 % less q_mobile, 10 % more r_o.
WORN_CELL = NEW_CELL.replace(q_mobile=0.9 * NEW_CELL.q_mobile, r_o=1.1 * NEW_CELL.r_o)
SEEDS = {"q_mobile": 0, "r_o": 1, "joint": 2}
#: What calibrators are told about the noise of the voltage, whatever it is.
STATED_NOISE_V = 0.005
#: Time between the estimates of least squares during a discharge.
WINDOW_EVERY_S = 60.0
#: Standard deviations of the filters' priors, about the new cell's values, C and ohm.
PRIOR_SD = {"q_mobile": 1900.0, "r_o": 0.15}
#: Discharges that are timed, and how often each.
TIMED_DISCHARGES, TIMED_REPETITIONS = 3, 3
#: A calibrator that is off by more than this at the end has lost the discharge.
LOST_PERCENT = 5.0

# The mean magnitude of a normal error is this times its standard deviation
_MEAN_MAGNITUDE = float(np.sqrt(2.0 / np.pi))


@dataclass(frozen=True)
class Method:
    """
    A calibrator in the comparison.

    :param name: as shown to readers
    :param needs: what it takes, beside the model
    :param make: makes it, from the names of what is unknown
    :param full_state: whether it is shown the state instead of voltage and current
    :param slow: whether it is run on a few discharges only
    """

    name: str
    needs: str
    make: Callable[[Sequence[str]], Estimator]
    full_state: bool = False
    slow: bool = False


def _least_squares(unknown: Sequence[str], window_every_s: float | None = None) -> LeastSquares:
    return LeastSquares(unknown, thermal=True, voltage_noise_V=STATED_NOISE_V, window_every_s=window_every_s)


def _progpy(parameter: str, kind: Literal["ukf", "particles"]) -> ProgpyFilter:
    return ProgpyFilter(parameter, kind, PRIOR_SD[parameter], STATED_NOISE_V)


_METHODS = (
    Method("closed form", "full state", lambda unknown: ClosedForm(), full_state=True),
    Method("greedy one-step cost", "full state", lambda unknown: GreedyOneStep(unknown[0], thermal=True), full_state=True),
    Method(
        "greedy, free-running",
        "full state",
        lambda unknown: GreedyOneStep(unknown[0], resync=False, thermal=True),
        full_state=True,
    ),
    Method("least squares, whole discharge", "voltage", lambda unknown: _least_squares(unknown)),
    Method("least squares, growing window", "voltage", lambda unknown: _least_squares(unknown, WINDOW_EVERY_S)),
    Method(
        "extended Kalman filter",
        "voltage, prior",
        lambda unknown: ExtendedKalmanFilter(unknown, thermal=True, voltage_noise_V=STATED_NOISE_V),
    ),
    Method("progpy, unscented Kalman filter", "voltage, prior", lambda unknown: _progpy(unknown[0], "ukf"), slow=True),
    Method("progpy, 100 particles", "voltage, prior", lambda unknown: _progpy(unknown[0], "particles"), slow=True),
)
METHODS = {method.name: method for method in _METHODS}
#: Those that are tried under worse conditions too.
TRIED = ("least squares, whole discharge", "extended Kalman filter")


@dataclass(frozen=True)
class Case:
    """
    A condition.

    :param name: as shown to readers
    :param sensors: errors of the sensors
    :param other_worn: whether the parameter that is held at the new cell's value is a little worn
    :param both_unknown: whether both are worn and searched for
    """

    name: str
    sensors: SensorErrors
    other_worn: bool = False
    both_unknown: bool = False


_NOISE = SensorErrors(noise_V=STATED_NOISE_V)
BASE = Case("5 mV noise", _NOISE)
_CASES = (
    BASE,
    Case("20 mV noise", SensorErrors(noise_V=0.020)),
    Case("+10 mV offset", SensorErrors(noise_V=STATED_NOISE_V, offset_V=0.010)),
    Case("+1 % current", SensorErrors(noise_V=STATED_NOISE_V, current_gain=1.01)),
    Case("other one 10 % worn, held new", _NOISE, other_worn=True),
    Case("both unknown", _NOISE, both_unknown=True),
)
CASES = {case.name: case for case in _CASES}


def work(case: Case, unknown: Sequence[str], n: int) -> TrajectoryDataset:
    """The work: discharges as progpy simulates them (the model with a temperature; tests compare both)."""
    kind = "joint" if case.both_unknown else unknown[0]
    return TrajectoryDataset.generate(
        unknown,
        n,
        RandomPiecewise(),
        seed=SEEDS[kind],
        r_o_range=R_O_RANGE_OHM,
        thermal=True,
        cell=WORN_CELL if case.other_worn else NEW_CELL,
    )


def cpu_time_per_estimate_s(estimator: Estimator, data: TrajectoryDataset, slow: bool) -> float:
    """What an estimate costs on one core, on a few discharges; the least of several times, as others may use the machine."""
    records = [data[0].part(0, 200)] if slow else [data[n] for n in range(min(len(data), TIMED_DISCHARGES))]
    spent_s, estimates = 0.0, 0
    for record in records:
        times_s = []
        for _ in range(TIMED_REPETITIONS):
            start_s = time.process_time()
            trace = estimator.trace([record])[0]
            times_s.append(time.process_time() - start_s)
        spent_s += min(times_s)
        estimates += len(trace.time_s)
    return spent_s / estimates


def part(method: str, case: str, unknown: Sequence[str], discharges: int) -> Tables:
    """Score one calibrator under one condition."""
    chosen, condition = METHODS[method], CASES[case]
    data = work(condition, unknown, discharges)
    estimator = chosen.make(unknown)
    scores = evaluate(estimator, data, None if chosen.full_state else condition.sensors)
    scores["cpu_time_per_estimate_s"] = cpu_time_per_estimate_s(estimator, data, chosen.slow)
    columns = {
        "true": "",
        "final_error_percent": "_final_error_percent",
        "second_half_mape_percent": "_second_half_mape_percent",
        "settling_time_1_percent_s": "_settling_time_1_percent_s",
        "coverage_percent": "_coverage_percent",
        "bound": "_bound",
    }
    tables = []
    for name in unknown:
        table = pd.DataFrame({column: scores[f"{name}{suffix}"] for column, suffix in columns.items()})
        table.insert(0, "parameter", name)
        tables.append(table.join(scores[["trajectory", "settled_time_s", "updates", "cpu_time_per_estimate_s"]]))
    together = pd.concat(tables)
    together.insert(0, "case", case)
    together.insert(0, "method", method)
    return {"peers": together}


def parts(n: int, slow_n: int) -> list[dict[str, Any]]:
    """All parts of this study."""
    chosen = []
    for case in CASES.values():
        for method in METHODS.values():
            if case is BASE or method.name in TRIED:
                unknowns = [PARAMETER_NAMES] if case.both_unknown else [(name,) for name in PARAMETERS]
                common = {"method": method.name, "case": case.name, "discharges": min(slow_n, n) if method.slow else n}
                chosen += [{**common, "unknown": list(unknown)} for unknown in unknowns]
    return chosen


def bound_percent(results: pd.DataFrame, case: Case, parameter: str) -> float:
    """What the mean error of an unbiased calibrator is at least, at the end of the discharges."""
    rows = results[(results["method"] == TRIED[0]) & (results["case"] == case.name) & (results["parameter"] == parameter)]
    return float(_MEAN_MAGNITUDE * 100.0 * (rows["bound"] / rows["true"]).mean())


def methods_table(results: pd.DataFrame) -> pd.DataFrame:
    """All calibrators under the first condition."""
    base = results[results["case"] == BASE.name]
    rows = []
    for method in METHODS.values():
        of_method = base[base["method"] == method.name]
        row = {"calibrator": method.name, "needs": method.needs}
        for parameter, part in of_method.groupby("parameter", sort=False):
            symbol = SYMBOLS[str(parameter)]
            last, settled_s = part["final_error_percent"], part["settling_time_1_percent_s"]
            many = (part["updates"] > 1).all()
            half = digits(part["second_half_mape_percent"].mean()) if many else "-"
            row[f"{symbol}: last / 2nd half (worst last), %"] = f"{digits(last.mean())} / {half} ({digits(last.max())})"
            row[f"{symbol} within 1 % after: median / worst, s"] = (
                f"{digits(settled_s.median())} / {digits(settled_s.max())}" if many else "-"
            )
        row["discharges"] = str(int(of_method.groupby("parameter").size().sum()))
        row["time per estimate"] = duration(of_method["cpu_time_per_estimate_s"].mean())
        rows.append(row)
    bounds = {name: digits(bound_percent(results, BASE, name)) for name in PARAMETERS}
    bound_row = {f"{SYMBOLS[name]}: last / 2nd half (worst last), %": f"{value} / - (-)" for name, value in bounds.items()}
    rows.append({"calibrator": "Cramér-Rao bound", "needs": "voltage", **bound_row})
    return pd.DataFrame(rows).fillna("-")


def cases_table(results: pd.DataFrame) -> pd.DataFrame:
    """Those that were tried under all conditions."""
    rows = []
    for case in CASES.values():
        row = {"case": case.name}
        for name in TRIED:
            for parameter in PARAMETERS:
                part = _of(results, name, case, parameter)
                error, lost = part["final_error_percent"], (part["final_error_percent"] > LOST_PERCENT).sum()
                settled = np.isfinite(part["settled_time_s"]).sum()
                row[f"{name}, {SYMBOLS[parameter]}: last (worst), %"] = f"{digits(error.mean())} ({digits(error.max())})"
                row[f"{name}, {SYMBOLS[parameter]}: lost / says settled"] = f"{lost} / {settled} of {len(part)}"
        bounds = " / ".join(digits(bound_percent(results, case, parameter)) for parameter in PARAMETERS)
        rows.append(row | {"bound, %": bounds})
    return pd.DataFrame(rows)


def _of(results: pd.DataFrame, method: str, case: Case, parameter: str) -> pd.DataFrame:
    chosen = (results["method"] == method) & (results["case"] == case.name) & (results["parameter"] == parameter)
    return results[chosen]


def _draw_errors(axes: Axes, row: float, errors: pd.Series, colour: str, label: str | None = None) -> None:
    # one dot per discharge, a bar at their mean
    visible = np.maximum(errors.to_numpy(), 1e-13)
    axes.plot(visible, np.full(len(visible), row), "o", ms=3.5, mew=0, alpha=0.35, color=colour)
    axes.plot([errors.mean()] * 2, [row - 0.3, row + 0.3], color=colour, lw=2.2, label=label)


def _finish(panels: Sequence[Axes], labels: Sequence[str]) -> None:
    for axes, parameter in zip(panels, PARAMETERS, strict=True):
        axes.set(xscale="log", xlabel="error of the last estimate (%)", title=LABELS[parameter].split(" (")[0])
        axes.grid(axis="x", alpha=0.25)
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].invert_yaxis()


def plot_methods(results: pd.DataFrame) -> Figure:
    """The errors of all calibrators under the first condition."""
    figure = new_figure(9.6, 3.8)
    panels = figure.subplots(1, len(PARAMETERS), sharey=True)
    for axes, parameter in zip(panels, PARAMETERS, strict=True):
        for row, method in enumerate(METHODS.values()):
            errors = _of(results, method.name, BASE, parameter)["final_error_percent"]
            _draw_errors(axes, row, errors, COLOURS[2 if method.full_state else 4 if method.slow else 0])
        axes.axvline(bound_percent(results, BASE, parameter), color="0.3", lw=1.2, ls="--", label="Cramér-Rao bound")
    _finish(panels, list(METHODS))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower right", frameon=False, fontsize=9)
    return figure


def plot_cases(results: pd.DataFrame) -> Figure:
    """The errors of those that were tried under all conditions."""
    figure = new_figure(9.6, 4.0)
    panels = figure.subplots(1, len(PARAMETERS), sharey=True)
    for axes, parameter in zip(panels, PARAMETERS, strict=True):
        for row, case in enumerate(CASES.values()):
            for shift, name, colour in zip((-0.19, 0.19), TRIED, COLOURS, strict=False):
                errors = _of(results, name, case, parameter)["final_error_percent"]
                _draw_errors(axes, row + shift, errors, colour, name if row == 0 else None)
            bound = bound_percent(results, case, parameter)
            axes.plot(
                [bound] * 2, [row - 0.5, row + 0.5], "--", color="0.3", lw=1.2, label="Cramér-Rao bound" if row == 0 else None
            )
    _finish(panels, list(CASES))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def report(results: pd.DataFrame, configuration: dict[str, Any]) -> str:
    """Both tables, with what they show."""
    n, slow_n = configuration["discharges"], configuration["progpy_discharges"]
    noise_mV, (low_ohm, high_ohm) = 1e3 * STATED_NOISE_V, R_O_RANGE_OHM
    methods, cases = (markdown(table) for table in (methods_table(results), cases_table(results)))
    return f"""Simulated discharges down to {NEW_CELL.VEOD:g} V under 2 to 8 W that change every 60 to 140 s, one sample each
second: {n} of cells with q^max of 4000 to 7600 C, {n} with R_o of {low_ohm:g} to {high_ohm:g} ohm, the other parameter new
and known. Voltage with {noise_mV:g} mV of noise, exact current; calibrators with the full state see it exactly. progpy's
filters: {slow_n} discharges for each parameter. Errors are means over discharges, of the last estimate and over the second
half of the discharge. The bound is the least mean error of an unbiased calibrator. Times are CPU times on one core.

{methods}
The same with other sensors or other cells. All calibrators are told {noise_mV:g} mV; the Kalman filter allows for an offset
of the voltage, least squares do not. Lost: off by more than {LOST_PERCENT:g} % in the end. Says settled: the calibrator takes
its last estimate for settled. With both unknown, both vary at once over the ranges above.

{cases}"""


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("peers", __doc__, jobs=1)
    parser.add_argument("--discharges", type=positive, default=30, help="for each parameter, and with both worn")
    parser.add_argument("--progpy-discharges", type=positive, default=2, help="likewise, for each estimator of progpy; slow")
    study = Study(parser, arguments)
    study.configuration |= {
        "seeds": SEEDS,
        "loads": asdict(RandomPiecewise()),
        "r_o_range_ohm": R_O_RANGE_OHM,
        "new_cell": {name: getattr(NEW_CELL, name) for name in PARAMETERS},
        "cases": [asdict(case) for case in CASES.values()],
        "stated_noise_V": STATED_NOISE_V,
        "prior_sd": PRIOR_SD,
        "window_every_s": WINDOW_EVERY_S,
        "thermal": True,
    }
    tables = study.run(part, parts(study.chosen.discharges, study.chosen.progpy_discharges))
    results = tables["peers"]
    study.write(tables, {"peers": plot_methods(results), "limits": plot_cases(results)}, report(results, study.configuration))


if __name__ == "__main__":
    main()
