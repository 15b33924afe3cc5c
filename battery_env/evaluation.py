"""One way to score any calibrator on any set of discharges whose parameters are known."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import pandas as pd

from battery_env.electrochemistry import FloatArray, Trajectory, initial_state, simulate
from battery_env.estimators.base import EstimateTrace, Estimator
from battery_env.trajectories import TrajectoryDataset

PARAMETERS = ("q_mobile", "r_o")
#: An estimate has settled when it stays within this share of the truth from then on.
SETTLING_BANDS_PERCENT = (5.0, 1.0)


def evaluate(estimator: Estimator, data: TrajectoryDataset | Sequence[Trajectory]) -> pd.DataFrame:
    """
    Let a calibrator estimate the parameters of every discharge, and compare its estimates with the true ones.

    Columns, per parameter p (``q_mobile`` in C, ``r_o`` in ohm): ``p`` (true), ``p_hat`` (mean of its estimates),
    ``p_final`` (the last one), ``p_mae``, ``p_mape_percent``, ``p_bias`` (mean error), ``p_spread`` (standard deviation of
    the estimates), ``p_settling_time_5_percent_s`` and ``p_settling_time_1_percent_s`` (time since the first sample from
    which on all estimates are that close; infinite if the last one is not). Further ``load`` (mean of the record, W or A),
    ``eod_time_s``, ``eod_error_s`` (end of discharge predicted from full charge with the last estimate, minus the true one;
    NaN for records that do not start at full charge or do not say when it is), ``updates`` and ``time_per_update_s``
    (wall time of the whole batch over its number of estimates).

    :param estimator: the calibrator
    :param data: the discharges
    :return: one row per discharge, in their order
    """
    dataset = data if isinstance(data, TrajectoryDataset) else TrajectoryDataset.from_trajectories(data)
    start = time.perf_counter()
    traces = estimator.trace(dataset)
    elapsed_s = time.perf_counter() - start
    updates = sum(len(trace.time_s) for trace in traces)
    rows = []
    for n, trace in enumerate(traces):
        row: dict[str, float] = {"trajectory": n}
        for name in PARAMETERS:
            row.update(_errors(name, float(getattr(dataset, name)[n]), trace, dataset.first[n] * dataset.dt_s))
        profile = dataset.load_values[dataset.load_start[n] : dataset.load_start[n] + dataset.samples[n]]
        row["load"] = float(profile[dataset.first[n] : dataset.stop[n]].mean())
        row["eod_time_s"] = dataset.samples[n] * dataset.dt_s
        row["eod_error_s"] = _eod_time_s(dataset, n, profile, row["q_mobile_final"], row["r_o_final"]) - row["eod_time_s"]
        row["updates"] = len(trace.time_s)
        row["time_per_update_s"] = elapsed_s / updates
        rows.append(row)
    return pd.DataFrame(rows).astype({"trajectory": int, "updates": int})


def _errors(name: str, true: float, trace: EstimateTrace, start_s: float) -> dict[str, float]:
    estimates: FloatArray = getattr(trace, name)
    error = estimates - true
    magnitude = np.abs(error)
    scores = {
        name: true,
        f"{name}_hat": float(estimates.mean()),
        f"{name}_final": float(estimates[-1]),
        f"{name}_mae": float(magnitude.mean()),
        f"{name}_mape_percent": float(100.0 * magnitude.mean() / true),
        f"{name}_bias": float(error.mean()),
        f"{name}_spread": float(estimates.std()),
    }
    for band in SETTLING_BANDS_PERCENT:
        outside = np.flatnonzero(~(100.0 * magnitude <= band * true))
        settled = 0 if outside.size == 0 else outside[-1] + 1
        time_s = trace.time_s[settled] - start_s if settled < len(magnitude) else np.inf
        scores[f"{name}_settling_time_{band:g}_percent_s"] = float(time_s)
    return scores


def _eod_time_s(dataset: TrajectoryDataset, n: int, profile: FloatArray, q_mobile: float, r_o: float) -> float:
    full = initial_state(dataset.q_mobile[n], dataset.parameters)
    if not (np.array_equal(dataset.checkpoint[dataset.checkpoint_start[n]], full) and np.isfinite([q_mobile, r_o]).all()):
        return float("nan")
    # beyond the record its last load goes on, for as long again
    load = np.concatenate([profile, np.full(len(profile), profile[-1])])
    cell, unit = dataset.parameters, dataset.load_unit
    prediction = simulate(load, q_mobile, r_o, dt=dataset.dt_s, load_unit=unit, thermal=dataset.thermal, parameters=cell)
    return prediction.eod_time_s


def summarize(scores: pd.DataFrame, parameter: str) -> dict[str, float]:
    """
    The scores of one parameter over all discharges.

    :param scores: what :func:`evaluate` returned
    :param parameter: ``"q_mobile"`` or ``"r_o"``
    :return: mean, median and worst MAPE (%), mean bias and spread (% of the truth), median settling time to 1 % (s), mean
        absolute error of the end of discharge (% of its time)
    """
    true, mape = scores[parameter], scores[f"{parameter}_mape_percent"]
    return {
        "mape_percent": float(mape.mean()),
        "mape_median_percent": float(mape.median()),
        "mape_worst_percent": float(mape.max()),
        "bias_percent": float((100.0 * scores[f"{parameter}_bias"] / true).mean()),
        "spread_percent": float((100.0 * scores[f"{parameter}_spread"] / true).mean()),
        "settling_time_1_percent_s": float(scores[f"{parameter}_settling_time_1_percent_s"].median()),
        "eod_error_percent": float((100.0 * scores["eod_error_s"].abs() / scores["eod_time_s"]).mean()),
    }
