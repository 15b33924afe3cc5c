"""The measurements of ``benchmarks.identifiability``: its discharges, and one table for each statement."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd

from battery_env.calibration.full_state_layout import ERROR_SCALE, OBSERVED
from battery_env.electrochemistry import NEW_CELL, QNS, STATE_SIZE, FloatArray, Trajectory, simulate, step_into
from battery_env.estimators import (
    ClosedForm,
    Estimate,
    ExtendedKalmanFilter,
    LeastSquares,
    cramer_rao_bound,
    sensitivities,
)
from battery_env.loads import RandomPiecewise, constant
from battery_env.sensors import SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.study import Tables

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
    "q^max alone": (("q_mobile",), False),
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
DRIFT_C = 0.05

#: The parameters, as estimators call them.
NAMES = ("q_mobile", "r_o")
PERCENT = 100.0


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


def conservation_table() -> pd.DataFrame:
    """How exactly the full state tells both parameters, over discharges of cells of many ages under varying power."""
    data = TrajectoryDataset.generate("joint", 50, RandomPiecewise(), SEED, r_o_range=(0.1, 0.3))
    worst = dict.fromkeys(NAMES, 0.0)
    samples = 0
    for record, trace in zip(data, ClosedForm().trace(data), strict=True):
        samples += len(record.time_s)
        for name in NAMES:
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
                for name in NAMES:
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
    "q^max held 5 % too high": Fault(held={"q_mobile": 1.05}),
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
            free = [parameter for parameter in NAMES if parameter not in held]
            fit = LeastSquares(free, cell=NEW_CELL.replace(**held))
            for share in FINE_SHARES:
                estimate = fit.estimate(beginning(record, share))
                row: dict[str, float | str] = {"load": load, "fault": name, "seen_percent": PERCENT * share}
                for parameter in NAMES:
                    error = getattr(estimate, parameter) / getattr(TRUE, parameter) - 1.0
                    row[f"{parameter}_error_percent"] = PERCENT * error if parameter in free else np.nan
                rows.append(row)
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
                row = {"load": load, "offset_sd_V": offset_sd_V, "seen_percent": PERCENT * share}
                errors = {name: getattr(trace, name)[at] / getattr(TRUE, name) - 1.0 for name in NAMES}
                rows.append(row | {f"{name}_error_percent": PERCENT * error for name, error in errors.items()})
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
                        "q_mobile_error_percent": PERCENT * (estimate.q_mobile / TRUE.q_mobile - 1.0),
                        "q_mobile_sd_percent": PERCENT * estimate.sd_q_mobile / TRUE.q_mobile,
                        "settled": estimate.settled,
                    }
                )
    return pd.DataFrame(rows)


def one_step_costs() -> pd.DataFrame:
    """
    The distance between the model's next state and the cell's, over q_mobile, with the full state measured: in volts and
    coulombs as they are and in the error scales of the tasks, from the true state and from one that has drifted.
    """
    record = simulate(ONE_STEP_POWER_W, TRUE.q_mobile, NEW_CELL.r_o)
    now, following = record.state[ONE_STEP_TIME_S], record.state[ONE_STEP_TIME_S + 1]
    drifted = now.copy()
    drifted[QNS] += DRIFT_C
    # the true value is one of them
    q_mobile_C = np.arange(ONE_STEP_RANGE_C[0], ONE_STEP_RANGE_C[1] + 1.0)
    n = len(q_mobile_C)
    table = {"q_mobile_C": q_mobile_C}
    for name, start in (("true", now), ("drifted", drifted)):
        after = np.empty((n, STATE_SIZE))
        load_W, r_o_ohm = np.full(n, ONE_STEP_POWER_W), np.full(n, NEW_CELL.r_o)
        step_into(
            after, np.tile(start, (n, 1)), load_W, q_mobile_C, r_o_ohm, 1.0, "power", False, NEW_CELL.packed, extended=True
        )
        error = (after - following)[:, OBSERVED]
        table[f"cost_{name}_si"] = np.linalg.norm(error, axis=1)
        table[f"cost_{name}_scaled"] = np.linalg.norm(error / ERROR_SCALE, axis=1)
    return pd.DataFrame(table)


def minima_table(costs: pd.DataFrame) -> pd.DataFrame:
    """The local minima of the one-step cost."""
    rows = []
    for column in costs.columns[1:]:
        values = costs[column].to_numpy()
        for n in 1 + np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])):
            rows.append({"cost": column, "q_mobile_C": costs["q_mobile_C"].iloc[n], "value": values[n]})
    return pd.DataFrame(rows)


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
