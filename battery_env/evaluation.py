"""One way to score any calibrator on any set of discharges whose parameters are known."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from battery_env.arrays import BoolArray, FloatArray
from battery_env.electrochemistry import Trajectory, simulate
from battery_env.estimates import EstimateTrace
from battery_env.estimators.cramer_rao import cramer_rao_bound
from battery_env.estimators.estimator import Estimator
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS
from battery_env.records.model import RecordModel
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.trajectories import TrajectoryDataset

#: Times of further forecasts of the end of discharge, in % of its true time.
FORECAST_PERCENT = (25, 50, 75)


def evaluate(
    estimator: Estimator,
    data: TrajectoryDataset | Sequence[Trajectory],
    sensor_errors: SensorErrors | RandomSensorErrors | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """
    Score an estimator on simulated discharges: one row per discharge, with the errors of each parameter.

    .. code-block:: python

      from battery_env import ClosedForm, TrajectoryDataset, evaluate

      _, test = TrajectoryDataset.paper("r_o").split(test=0.3, seed=0)
      scores = evaluate(ClosedForm(), test[::100])
      print(scores[["r_o", "r_o_hat", "r_o_mape_percent"]])

    Look also at ``scores["p_mape_percent"].max()``, the worst discharge; :func:`summarize` has both.

    Columns for each parameter p (``q_mobile`` in C, ``r_o`` in ohm):

    ==================================== =============================================================================
    ``p``                                the true value
    ``p_hat``, ``p_final``               mean of the estimates, last estimate
    ``p_worst``                          largest absolute error
    ``p_mape_percent``                   mean absolute error, % of the true value
    ``p_second_half_mape_percent``       the same over the second half of the discharge
    ``p_final_error_percent``            the same of the last estimate
    ``p_bias``, ``p_spread``             mean error, standard deviation of the estimates
    ``p_settling_time_1_percent_s``      time since the first sample after which all estimates are within 1 %; infinite if
                                         the last estimate is not
    ``p_coverage_percent``               share of the estimates within two stated standard deviations of the truth
    ``p_bound``                          the Cramér-Rao bound: least standard deviation of an unbiased calibrator with
                                         these sensors
    ==================================== =============================================================================

    The bound uses all samples of the voltage. Its unknowns are the parameters with a stated uncertainty (both, if the
    calibrator states none) and the offset of the voltage, if there is one.

    Columns for each discharge:

    ==================================== =============================================================================
    ``load``                             mean of the record, W or A
    ``eod_time_s``                       end of discharge
    ``eod_error_s``                      end predicted from full charge with the last estimate, minus the true end
    ``eod_error_at_25_percent_s``, ...   the same with the estimate after 25, 50, 75 % of the time, under the recorded load
    ``settled_time_s``                   time since the first sample after which all estimates are settled; infinite if the
                                         last estimate is not
    ``updates``                          number of estimates
    ``time_per_update_s``                wall time of the whole batch over its number of estimates
    ==================================== =============================================================================

    NaN means: no estimate in this part of the discharge, no stated uncertainty, no noise, or a record that does not start at
    full charge or has no end of discharge.

    :param estimator: the calibrator
    :param data: the discharges
    :param sensor_errors: errors of voltage and current in the records of the calibrator; ``None``: ``data`` without errors
    :param seed: seed of the noise; the noise of a discharge does not depend on other discharges
    :return: one row per discharge, in their order
    """
    dataset = data if isinstance(data, TrajectoryDataset) else TrajectoryDataset.from_trajectories(data)
    # on the clock of the data set, where single trajectories start at 0
    truth = data if isinstance(data, TrajectoryDataset) else [_from_zero(record) for record in data]
    measured: Sequence[Trajectory] = truth
    errors_of = [SensorErrors()] * len(truth)
    if sensor_errors is not None:
        generators = [np.random.default_rng((seed, n)) for n in range(len(truth))]
        errors_of = [sensor_errors.draw(rng) for rng in generators]
        measured = [errors.apply(record, rng) for errors, record, rng in zip(errors_of, truth, generators, strict=True)]
    start = time.perf_counter()
    traces = estimator.trace(measured)
    elapsed_s = time.perf_counter() - start
    updates = sum(len(trace.time_s) for trace in traces)
    rows = []
    for n, (record, trace, errors) in enumerate(zip(truth, traces, errors_of, strict=True)):
        row: dict[str, float] = {"trajectory": n}
        for name in PARAMETERS:
            row |= _errors(name, record, trace)
        row["load"] = record.load.mean()
        row["eod_time_s"] = record.eod_time_s
        row |= _forecasts(dataset, n, record, trace)
        settled_s = np.nan if trace.settled is None else _since(trace.settled, trace.time_s)
        row["settled_time_s"] = settled_s - record.time_s[0]
        row |= _bounds(dataset, record, trace, errors)
        row["updates"] = len(trace.time_s)
        row["time_per_update_s"] = elapsed_s / updates
        rows.append(row)
    return pd.DataFrame(rows)


def _from_zero(record: Trajectory) -> Trajectory:
    start_s = record.time_s[0]
    return replace(record, time_s=record.time_s - start_s, eod_time_s=record.eod_time_s - start_s)


def _errors(name: str, record: Trajectory, trace: EstimateTrace) -> dict[str, float]:
    true, estimates, sd = getattr(record, name), getattr(trace, name), getattr(trace, f"sd_{name}")
    error = estimates - true
    magnitude = np.abs(error)
    percent = 100.0 * magnitude / true
    second_half = percent[trace.time_s >= 0.5 * record.eod_time_s]
    return {
        name: true,
        f"{name}_hat": estimates.mean(),
        f"{name}_final": estimates[-1],
        f"{name}_worst": magnitude.max(),
        f"{name}_mape_percent": percent.mean(),
        f"{name}_second_half_mape_percent": second_half.mean() if len(second_half) else np.nan,
        f"{name}_final_error_percent": percent[-1],
        f"{name}_bias": error.mean(),
        f"{name}_spread": estimates.std(),
        f"{name}_coverage_percent": 100.0 * np.mean(magnitude <= 2.0 * sd) if _states_sd(trace, name) else np.nan,
        f"{name}_settling_time_1_percent_s": _since(percent <= 1.0, trace.time_s) - record.time_s[0],
    }


def _since(holds: BoolArray, time_s: FloatArray) -> float:
    """Return the time of the first estimate from which on a condition holds."""
    fails = np.flatnonzero(~holds)
    first = fails[-1] + 1 if len(fails) else 0
    return float(time_s[first]) if first < len(time_s) else np.inf


def _forecasts(dataset: TrajectoryDataset, n: int, record: Trajectory, trace: EstimateTrace) -> dict[str, float]:
    """Return the errors of the ends predicted with single estimates of one discharge."""
    columns = [f"eod_error_at_{percent}_percent_s" for percent in FORECAST_PERCENT]
    decision_s = 0.01 * np.array(FORECAST_PERCENT) * record.eod_time_s
    estimate_rows = [len(trace.time_s) - 1, *(np.searchsorted(trace.time_s, decision_s, side="right") - 1)]
    load = dataset.load_profile(n)
    # beyond the record the last load continues, for as long again
    load = np.concatenate([load, np.full(len(load), load[-1])])
    simulated = partial(
        simulate, load, dt=dataset.dt_s, load_unit=dataset.load_unit, thermal=dataset.thermal, cell=dataset.cell
    )
    errors_s = dict.fromkeys(["eod_error_s", *columns], np.nan)
    for column, estimate in zip(errors_s, estimate_rows, strict=True):
        values = {name: getattr(trace, name)[estimate] for name in PARAMETERS}
        is_within = all(PARAMETERS[name].limits[0] <= value <= PARAMETERS[name].limits[1] for name, value in values.items())
        if dataset.starts_full(n) and estimate >= 0 and is_within:
            errors_s[column] = simulated(**values).eod_time_s - record.eod_time_s
    return errors_s


def _bounds(
    dataset: TrajectoryDataset, record: Trajectory, trace: EstimateTrace, sensor_errors: SensorErrors
) -> dict[str, float]:
    if sensor_errors.noise_V == 0.0:
        return {f"{name}_bound": np.nan for name in PARAMETERS}
    model = RecordModel(dataset.cell, dataset.thermal, dataset.dt_s, initial=record.state[0])
    unknown = [name for name in PARAMETERS if _states_sd(trace, name)] or PARAMETER_NAMES
    bound = cramer_rao_bound(record, sensor_errors.noise_V, unknown, offset=sensor_errors.offset_V != 0.0, model=model)
    return {f"{name}_bound": getattr(bound, f"sd_{name}")[-1] for name in PARAMETERS}


def _states_sd(trace: EstimateTrace, name: str) -> bool:
    sd = getattr(trace, f"sd_{name}")
    return sd is not None and not np.isnan(sd).all()


def summarize(scores: pd.DataFrame, parameter: str) -> dict[str, float]:
    """Return the scores of one parameter over all discharges."""
    true, mape = scores[parameter], scores[f"{parameter}_mape_percent"]
    summary = {
        "mape_percent": mape.mean(),
        "mape_worst_percent": mape.max(),
        "second_half_mape_percent": scores[f"{parameter}_second_half_mape_percent"].mean(),
        "final_error_percent": scores[f"{parameter}_final_error_percent"].mean(),
        "final_error_worst_percent": scores[f"{parameter}_final_error_percent"].max(),
        "bias_percent": (100.0 * scores[f"{parameter}_bias"] / true).mean(),
        "spread_percent": (100.0 * scores[f"{parameter}_spread"] / true).mean(),
        "coverage_percent": scores[f"{parameter}_coverage_percent"].mean(),
        "bound_percent": (100.0 * scores[f"{parameter}_bound"] / true).mean(),
        "settling_time_1_percent_s": scores[f"{parameter}_settling_time_1_percent_s"].median(),
    }
    for suffix in ("", *(f"_at_{percent}_percent" for percent in FORECAST_PERCENT)):
        summary[f"eod_error_percent{suffix}"] = (100.0 * scores[f"eod_error{suffix}_s"].abs() / scores["eod_time_s"]).mean()
    return {name: float(value) for name, value in summary.items()}


def over_seeds(scores: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the interquartile mean of the scores of several trainings, and its 95 % interval by a bootstrap (Agarwal et al.
    2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice). For fewer than four scores it is the mean.
    """
    from scipy.stats import bootstrap, trim_mean  # here, because the import is slow

    def interquartile_mean(sample: FloatArray, axis: int = 0) -> FloatArray:
        return np.asarray(trim_mean(sample, 0.25, axis=axis))

    values = np.asarray(scores, dtype=np.float64)
    mean = interquartile_mean(values)
    if len(values) < 2:
        unknown = np.full_like(mean, np.nan)
        return mean, unknown, unknown
    interval = bootstrap(
        (values,), interquartile_mean, n_resamples=2000, axis=0, method="percentile", vectorized=True, random_state=0
    ).confidence_interval
    return mean, np.asarray(interval.low), np.asarray(interval.high)
