"""
Calibrators under conditions: how far off each one is, how often what it states holds, and when it takes itself for settled.

.. code-block:: bash

  python -m benchmarks.calibrators peers               # what a user would pick instead of a learned policy
  python -m benchmarks.calibrators faults              # one thing wrong at a time
  python -m benchmarks.calibrators mismatch            # constants of the model off: the policies that come with battery_env

Each is a row of ``COMPARISONS``: its conditions, its calibrators, and its discharges, which start with a full cell at rest,
under power that changes every 60 to 140 s. Every calibrator starts from a new cell's parameters. Finished parts are not run
again. Parts that run at the same time (``--jobs``) may cost each other time, which is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from textwrap import fill
from timeit import Timer
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import NEW_CELL, UNCERTAIN_CONSTANTS
from battery_env.estimators import ClosedForm, Estimator, LeastSquares
from battery_env.evaluation import evaluate
from battery_env.loads import RandomPiecewise
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS
from battery_env.plotting import coloured, new_figure
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.policies.pretrained import pretrained_card
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.tasks.data import Q_MOBILE_RANGE_C, R_O_RANGE_OHM, standard_dataset
from battery_env.trajectories import TrajectoryDataset
from benchmarks.contests import HELD_OUT, SENSORS, rows_of_parameters
from benchmarks.kalman_filter import PlainKalmanFilter
from benchmarks.pretrained import OPTIONS
from benchmarks.study import (
    SYMBOLS,
    Study,
    Tables,
    add_legend,
    at_most,
    command_line,
    digits,
    duration,
    markdown,
    run_named,
)

ENV_ID = "BatteryVoltageJoint-v0"
NOISE_V = 0.005
#: Error of the model that a calibrator is told where it is told of one, V: the best of a few.
MODEL_ERROR_V = 0.02
#: Relative standard deviation of the constants of the model where they are off.
MISMATCH = 0.2
#: Standard deviation of the offset, uniform within 10 mV to either side, V.
OFFSET_SD_V = 0.01 / np.sqrt(3.0)
#: Time between the estimates of least squares during a discharge, s.
WINDOWS_S = {"peers": 60.0, "faults": 300.0, "mismatch": 300.0}
#: Standard deviations of the priors of progpy's filters, about the new cell's values, C and ohm.
PRIOR_SD = {"q_mobile": 1900.0, "r_o": 0.15}
#: Discharges of calibrators that take milliseconds a sample, for each parameter.
SLOW_DISCHARGES = 2
#: A cell that is a little worn in both parameters: 10 % less q_mobile, 10 % more r_o.
WORN_CELL = NEW_CELL.replace(q_mobile=0.9 * NEW_CELL.q_mobile, r_o=1.1 * NEW_CELL.r_o)
#: Where discharges are generated, by what is unknown.
SEEDS = {("q_mobile",): 0, ("r_o",): 1, ("q_mobile", "r_o"): 2}
#: Discharges that are timed, and how often each.
TIMED_DISCHARGES, TIMED_REPETITIONS = 3, 3
#: A calibrator that is off by more than this at the end has lost the discharge.
LOST_PERCENT = 5.0

# Columns of tables with a row for each parameter
_MEASURES = (
    "true",
    "final_error_percent",
    "second_half_mape_percent",
    "settling_time_1_percent_s",
    "coverage_percent",
    "bound",
    "trajectory",
    "settled_time_s",
    "updates",
    "cpu_time_per_estimate_s",
)
# The mean magnitude of a normal error is this times its standard deviation
_MEAN_MAGNITUDE = float(np.sqrt(2.0 / np.pi))
_POLICY_NEEDS = "training on simulated discharges, model"
# Of published rows whose calibrators are archived
_ARCHIVED_NEEDS = dict.fromkeys(("greedy one-step cost", "greedy, free-running"), "full state")
# Of the calibrators in a figure.
_MARKERS = "osD^vP*X<>"
# Exact estimates are drawn here
_FLOOR_PERCENT = 1e-4
# Where an observation with a fit holds its step, as an action
_STEP = slice(102, 104)


@dataclass(frozen=True)
class Calibrator:
    """A calibrator in a comparison."""

    name: str
    needs: str  # what it has to know, as shown to readers
    make: Callable[[Sequence[str], float | None], Estimator]  # of what is unknown and the noise that it is told, V
    full_state: bool = False  # whether it is shown the state without any sensor
    slow: bool = False
    policy: str = ""  # its digest


@dataclass(frozen=True)
class Condition:
    """What sensors and cells are like in a part of a comparison."""

    labels: Mapping[str, str | float]  # what names it, as columns of tables
    sensors: SensorErrors | RandomSensorErrors = field(default_factory=lambda: SensorErrors(noise_V=NOISE_V))
    told_V: float | None = NOISE_V  # noise of the voltage that calibrators are told
    mismatch: float = 0.0  # relative standard deviation of the constants of the model
    alone: bool = False  # whether one parameter is unknown at a time, and the other one held at the new cell's value
    other_worn: bool = False  # whether the one that is held is a little worn
    share: float = 1.0  # of the discharges
    tried: tuple[str, ...] = ()  # calibrators that are run, all if none is named


@dataclass(frozen=True)
class Comparison:
    """A study: who is compared under which conditions."""

    about: str  # what readers have to know
    conditions: tuple[Condition, ...]
    calibrators: tuple[Calibrator, ...]
    discharges: int  # by default
    work: Callable[[Condition, Sequence[str], int], TrajectoryDataset]  # of what is unknown and a number of discharges
    seed: int = 1  # of the noise
    by_parameter: bool = False  # whether its raw table has a row for each parameter


class FollowTheFit:
    """No policy: it makes the step of the fit that the observation holds."""

    def predict(self, observation: FloatArray, /, *, deterministic: bool = False) -> tuple[FloatArray, None]:
        """The step."""
        return observation[:, _STEP], None


#: The policy for simulated cells that comes with ``battery_env``, and what is left without it.
SHIPPED = (
    Calibrator(
        "LAC, pretrained",
        _POLICY_NEEDS,
        lambda unknown, told_V: PolicyEstimator.pretrained(ENV_ID),
        policy=pretrained_card(ENV_ID)["sha256"][:8],
    ),
    Calibrator(
        "the fit that LAC sees, no policy", "model", lambda unknown, told_V: PolicyEstimator(FollowTheFit(), ENV_ID, **OPTIONS)
    ),
)


def _least_squares(name: str, needs: str, **options: Any) -> Calibrator:
    return Calibrator(name, needs, lambda unknown, told_V: LeastSquares(unknown, voltage_noise_V=told_V, **options))


def _kalman(name: str, needs: str, mismatch_V: float = 0.0, thermal: bool = False) -> Calibrator:
    def make(unknown: Sequence[str], told_V: float | None) -> PlainKalmanFilter:
        # an error of the model is noise to it
        return PlainKalmanFilter(unknown, thermal=thermal, voltage_noise_V=max(told_V or NOISE_V, mismatch_V))

    return Calibrator(name, needs, make)


def _progpy(name: str, kind: Literal["ukf", "particles"]) -> Calibrator:
    def make(unknown: Sequence[str], told_V: float | None) -> Estimator:
        from benchmarks.progpy_filters import ProgpyFilter  # heavy, and needed here only

        return ProgpyFilter(unknown[0], kind, PRIOR_SD[unknown[0]], NOISE_V)

    return Calibrator(name, "voltage, prior", make, slow=True)


def _generated(condition: Condition, unknown: Sequence[str], n: int, **options: Any) -> TrajectoryDataset:
    cell = WORN_CELL if condition.other_worn else NEW_CELL
    return TrajectoryDataset.generate(unknown, n, RandomPiecewise(), SEEDS[tuple(unknown)], cell=cell, **options)


def _held_out(condition: Condition, unknown: Sequence[str], n: int) -> TrajectoryDataset:
    # the first held-out ones of the environment, with the same ages and loads whatever the mismatch, but where one parameter
    # alone is unknown
    if condition.alone:
        return _generated(condition, unknown, n, q_mobile_range=Q_MOBILE_RANGE_C, r_o_range=R_O_RANGE_OHM)
    return standard_dataset(PARAMETER_NAMES, "piecewise", "test", mismatch=condition.mismatch)[:n]


_TRIED = ("least squares, whole discharge", "extended Kalman filter")
_PEERS = Comparison(
    """Simulated as progpy does it, with a temperature: cells with a worn q_max of 4000 to 7600 C and cells with a worn R_o of
0.117 to 0.35 ohm, the other parameter new and known; then with both worn and unknown. Calibrators with the full state see
it exactly, all others are told 5 mV of noise; the Kalman filter allows for an offset of the voltage, least squares do not.""",
    (
        Condition({"case": "5 mV noise"}, alone=True),
        Condition({"case": "20 mV noise"}, SensorErrors(noise_V=0.020), alone=True, tried=_TRIED),
        Condition({"case": "+10 mV offset"}, SensorErrors(noise_V=NOISE_V, offset_V=0.010), alone=True, tried=_TRIED),
        Condition({"case": "+1 % current"}, SensorErrors(noise_V=NOISE_V, current_gain=1.01), alone=True, tried=_TRIED),
        Condition({"case": "other one 10 % worn, held new"}, alone=True, other_worn=True, tried=_TRIED),
        Condition({"case": "both unknown"}, tried=_TRIED),
    ),
    (
        Calibrator("closed form", "full state", lambda unknown, told_V: ClosedForm(), full_state=True),
        _least_squares("least squares, whole discharge", "voltage", thermal=True),
        _least_squares("least squares, growing window", "voltage", thermal=True, window_every_s=WINDOWS_S["peers"]),
        _kalman("extended Kalman filter", "voltage, prior", thermal=True),
        _progpy("progpy, unscented Kalman filter", "ukf"),
        _progpy("progpy, 100 particles", "particles"),
    ),
    discharges=30,
    work=partial(_generated, r_o_range=(0.117, 0.35), thermal=True),
    seed=0,
    by_parameter=True,
)

_FAULTS = Comparison(
    f"""The first held-out discharges of `{ENV_ID}`, both parameters unknown, 5 mV of noise; one thing wrong at a time. Where
one parameter is unknown, half as many discharges for each. Constants of the model: kn, tDiffusion, to and tsn of each cell are
multiplied by log-normal factors. The closed form sees the exact state and the current of the sensor. Least squares estimate
every 300 s, filters every second, the policy every minute.""",
    (
        Condition({"fault": "none"}),
        Condition({"fault": "told a third of the noise"}, told_V=NOISE_V / 3.0),
        Condition({"fault": "told three times the noise"}, told_V=3.0 * NOISE_V),
        Condition({"fault": "voltage +10 mV"}, SensorErrors(noise_V=NOISE_V, offset_V=0.010)),
        Condition({"fault": "current +1 %"}, SensorErrors(noise_V=NOISE_V, current_gain=1.01)),
        Condition(
            {"fault": "one unknown, the other 10 % worn but held new"},
            alone=True,
            other_worn=True,
            share=0.5,
            tried=("closed form", "least squares", "Kalman filter", "Kalman filter, told 20 mV of model error"),
        ),
        Condition({"fault": "constants of the model off by 10 %"}, mismatch=0.1),
        Condition({"fault": "constants of the model off by 20 %"}, mismatch=0.2),
    ),
    (
        Calibrator("closed form", "full state, model", lambda unknown, told_V: ClosedForm()),
        _least_squares("least squares", "model; noise for what it states", window_every_s=WINDOWS_S["faults"]),
        _kalman("Kalman filter", "model, noise, prior, size of an offset"),
        _kalman("Kalman filter, told 20 mV of model error", "the same, error of the model", MODEL_ERROR_V),
        SHIPPED[0],
    ),
    discharges=60,
    work=_held_out,
    by_parameter=True,
)

_NUISANCES = dict.fromkeys(UNCERTAIN_CONSTANTS, MISMATCH)


def _off(mismatch: float) -> tuple[Condition, ...]:
    labels: list[dict[str, str | float]] = [{"mismatch": mismatch, "sensor": sensor} for sensor in SENSORS]
    return tuple(Condition(label, SENSORS[str(label["sensor"])], told_V=None, mismatch=mismatch) for label in labels)


_MISMATCH = Comparison(
    f"""Held-out discharges of `{ENV_ID}`, both parameters unknown; kn, tDiffusion, to and tsn of each cell are
off by factors with this relative standard deviation (mismatch). Least squares with nuisances are told the truth: which
constants are off, and by how much. Least squares and filters read every second, the others every two.""",
    _off(0.0) + _off(MISMATCH),
    (
        *SHIPPED,
        _least_squares(
            "least squares, two parameters", "model", mismatch_V=MODEL_ERROR_V, window_every_s=WINDOWS_S["mismatch"]
        ),
        _least_squares(
            "least squares, nuisances, offset",
            "model, sizes of its errors",
            nuisance={**_NUISANCES, "offset_V": OFFSET_SD_V},
            window_every_s=WINDOWS_S["mismatch"],
        ),
        _kalman("Kalman filter", "model, noise, prior, size of an offset"),
        _kalman("Kalman filter, told 20 mV", "the same, error of the model", MODEL_ERROR_V),
    ),
    discharges=60,
    work=_held_out,
)

COMPARISONS = {
    "peers": _PEERS,
    "faults": _FAULTS,
    "mismatch": _MISMATCH,
}


def cpu_time_per_estimate_s(estimator: Estimator, data: TrajectoryDataset, slow: bool) -> float:
    """What an estimate costs on one core, on a few discharges; the least of several times, as others may use the machine."""
    records = [data[0].part(0, 200)] if slow else [data[n] for n in range(min(len(data), TIMED_DISCHARGES))]
    estimates = sum(len(trace.time_s) for trace in estimator.trace(records))
    timers = [Timer(partial(estimator.trace, [record]), timer=time.process_time) for record in records]
    return sum(min(timer.repeat(TIMED_REPETITIONS, number=1)) for timer in timers) / estimates


def part(comparison: str, calibrator: str, condition: int, unknown: Sequence[str], discharges: int, policy: str) -> Tables:
    """Score one calibrator under one condition."""
    study = COMPARISONS[comparison]
    who = next(each for each in study.calibrators if each.name == calibrator)
    where = study.conditions[condition]
    estimator, data = who.make(unknown, where.told_V), study.work(where, unknown, discharges)
    scores = evaluate(estimator, data, None if who.full_state else where.sensors, seed=study.seed)
    scores["cpu_time_per_estimate_s"] = cpu_time_per_estimate_s(estimator, data, who.slow)
    scores = scores.assign(calibrator=calibrator, **where.labels, policy=policy)
    return {comparison: by_parameter(scores, where.labels, unknown) if study.by_parameter else scores}


def parts(name: str, n: int) -> list[dict[str, Any]]:
    """All parts of a comparison."""
    chosen, study = [], COMPARISONS[name]
    for number, condition in enumerate(study.conditions):
        for who in study.calibrators:
            if not condition.tried or who.name in condition.tried:
                count = int(np.ceil(condition.share * n))
                common = {"comparison": name, "calibrator": who.name, "condition": number, "policy": who.policy}
                common["discharges"] = min(count, SLOW_DISCHARGES) if who.slow else count
                unknowns = [(name,) for name in PARAMETER_NAMES] if condition.alone else [PARAMETER_NAMES]
                chosen += [{**common, "unknown": list(unknown)} for unknown in unknowns]
    return chosen


def by_parameter(scores: pd.DataFrame, labels: Iterable[str], unknown: Sequence[str] = PARAMETER_NAMES) -> pd.DataFrame:
    """What is published of scores, with a row for each parameter."""
    return rows_of_parameters(scores, unknown)[["calibrator", *labels, "parameter", *_MEASURES]]


def summary(results: pd.DataFrame, labels: Sequence[str], needs: Mapping[str, str]) -> pd.DataFrame:
    """The table for readers, from one with a row for each parameter."""
    rows = []
    for keys, group in results.groupby([*labels, "calibrator"], sort=False):
        row = dict(zip([*labels, "calibrator"], keys, strict=True))
        # published rows are of a policy more, that of an earlier release
        row["needs"] = needs.get(str(row["calibrator"]), _POLICY_NEEDS)
        for parameter, part in group.groupby("parameter", sort=False):
            symbol = SYMBOLS[str(parameter)]
            for words, column in (("2nd half", "second_half_mape_percent"), ("last", "final_error_percent")):
                row[f"{symbol}: {words} (worst), %"] = f"{digits(part[column].mean(), 3)} ({digits(part[column].max())})"
            row[f"{symbol}: within 2 sd, %"] = digits(part["coverage_percent"].mean(), 3)
            lost, settled = part["final_error_percent"] > LOST_PERCENT, np.isfinite(part["settled_time_s"])
            row[f"{symbol}: lost / settled, %"] = f"{100.0 * lost.mean():.0f} / {100.0 * settled.mean():.0f}"
            within_s = part["settling_time_1_percent_s"]
            row[f"{symbol}: within 1 % after, s"] = f"{digits(within_s.median())} / {digits(within_s.max())}"
            row[f"{symbol}: bound, %"] = digits(_MEAN_MAGNITUDE * 100.0 * (part["bound"] / part["true"]).mean())
        row["discharges"] = group["trajectory"].nunique()
        row["time per estimate"] = duration(group["cpu_time_per_estimate_s"].mean())
        rows.append(row)
    return pd.DataFrame(rows).fillna("-")


def report(name: str, results: pd.DataFrame) -> str:
    """What readers have to know, and the table."""
    comparison = COMPARISONS[name]
    needs = _ARCHIVED_NEEDS | {who.name: who.needs for who in comparison.calibrators}
    table = summary(results, list(comparison.conditions[0].labels), needs)
    return f"""{comparison.about}

Errors are means over discharges, and (the worst discharge): in the
second half of a discharge, and of the last estimate. Within 2 sd: share of the estimates within two stated standard deviations
of the truth. Lost: off by more than {LOST_PERCENT:g} % in the end. Settled: the last estimate is taken for settled.
Within 1 %: from when on all estimates are, median and worst discharge. Bound: the least mean error that the last estimate of
an unbiased calibrator can have. Times are CPU times on one core.

{markdown(table)}"""


def plot(results: pd.DataFrame, labels: Sequence[str]) -> Figure:
    """The mean error and that of the middle 90 % of the discharges: a row for each condition, in it all calibrators."""
    # variants of a calibrator have its colour and a marker of their own
    styles = {
        name: (colour, marker)
        for marker, (colour, name) in zip(
            _MARKERS, coloured(dict.fromkeys(results["calibrator"]), variants_alike=True), strict=False
        )
    }
    figure = new_figure(9.6, 1.2 + 0.16 * len(results[[*labels, "calibrator"]].drop_duplicates()))
    panels, ticks, y = figure.subplots(1, len(PARAMETER_NAMES), sharey=True), {}, 0
    for keys, of_condition in results.groupby(list(labels), sort=False):
        first = y
        for name, of_calibrator in of_condition.groupby("calibrator", sort=False):
            colour, marker = styles[name]
            for axes, parameter in zip(panels, PARAMETER_NAMES, strict=True):
                errors = of_calibrator.loc[of_calibrator["parameter"] == parameter, "second_half_mape_percent"].dropna()
                ends = errors.clip(_FLOOR_PERCENT).quantile([0.05, 0.95])
                axes.plot(ends, [y, y], color=colour, lw=1.6, alpha=0.6)
                axes.plot(max(errors.mean(), _FLOOR_PERCENT), y, marker, color=colour, ms=5, label=name)
            y += 1
        named = zip(labels, keys, strict=True)
        text = "\n".join(fill(key if isinstance(key, str) else f"{name} {key:g}", 26) for name, key in named)
        ticks[(first + y - 1) / 2] = text
        for axes in panels:
            axes.axhline(y, color="0.8", lw=0.8)
        y += 1
    for axes, parameter in zip(panels, PARAMETER_NAMES, strict=True):
        axes.set(xscale="log", xlabel="error in the second half (%)", title=PARAMETERS[parameter].symbol)
        axes.grid(axis="x", alpha=0.25)
    panels[0].set_yticks(list(ticks), ticks.values(), fontsize=8)
    panels[0].set_ylim(y - 1, -1)
    add_legend(figure, panels[:1], 3)
    return figure


def run(name: str, arguments: Sequence[str]) -> None:
    """Run one comparison."""
    comparison = COMPARISONS[name]
    parser = command_line(f"calibrators {name}", comparison.about, jobs=1)
    number = at_most(HELD_OUT)
    parser.add_argument("--discharges", type=number, default=comparison.discharges, help="of each condition, at most 300")
    study = Study(parser, arguments)
    tables = study.run(part, parts(name, study.chosen.discharges))
    study.configuration |= {
        "conditions": [asdict(condition) for condition in comparison.conditions],
        "calibrators": [{"name": who.name, "policy": who.policy} for who in comparison.calibrators],
        "seed_of_noise": comparison.seed,
        "window_every_s": WINDOWS_S.get(name),
        "model_error_V": MODEL_ERROR_V,
        "prior_sd": PRIOR_SD,
        "loads": asdict(RandomPiecewise()),
    }
    labels, results = list(comparison.conditions[0].labels), tables[name]
    if not comparison.by_parameter:
        results = by_parameter(results, labels)
    study.write(tables, {name: plot(results, labels)}, report(name, results))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    run_named("calibrators", __doc__, {name: partial(run, name) for name in COMPARISONS}, arguments)


if __name__ == "__main__":
    main()
