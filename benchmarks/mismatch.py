"""
Who calibrates best from voltage and current if the model is a little wrong: the policies that come with ``battery_env``, the
fit that they are shown without any policy, least squares, and Kalman filters; on simulated cells and on both recorded ones.

.. code-block:: bash

  python -m benchmarks.mismatch

Simulated: held-out discharges of ``BatteryVoltageJoint-v0``, both parameters unknown; kn, tDiffusion, to and tsn of each cell
are off by factors with a relative standard deviation of 0 or 0.2. Errors are means over the second half of a discharge.
Recorded: every eighth discharge of B0005 and B0006, where all constants are unlike the model's. Least squares and filters read
every second, the others every two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.arrays import FloatArray
from battery_env.calibration.data import standard_dataset
from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.pretrained import pretrained_card
from battery_env.cells import BUNDLED_CELLS, load_nasa_discharges
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS
from battery_env.estimates import Estimate
from battery_env.estimators import Estimator, ExtendedKalmanFilter, LeastSquares
from battery_env.evaluation import evaluate
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import LABELS, coloured, new_figure
from battery_env.record_model import RecordModel
from benchmarks.contests import SENSORS, check_discharges
from benchmarks.nuisance import MISMATCH_V, OFFSET_SD_V
from benchmarks.peers import cpu_time_per_estimate_s
from benchmarks.real_cells import CUT_OFF_V, SHARES
from benchmarks.real_cells import calibrator as real_calibrator
from benchmarks.study import SYMBOLS, Study, Tables, command_line, digits, duration, markdown, positive

ENV_ID = "BatteryVoltageJoint-v0"
#: Relative standard deviation of the constants.
MISMATCHES = (0.0, 0.2)
#: Time between the estimates of least squares during a discharge, s.
WINDOW_EVERY_S = 300.0
# Where an observation with a fit holds its step, as an action
_STEP = slice(102, 104)
# Every so many recorded discharges
_EVERY = 8


class Follow:
    """No policy: it makes the step of the fit that the observation holds."""

    def predict(self, observation: FloatArray, /, *, deterministic: bool = False) -> tuple[FloatArray, None]:
        """The step."""
        return observation[:, _STEP], None


def _fit_alone() -> PolicyEstimator:
    return PolicyEstimator(Follow(), ENV_ID, **pretrained_card(ENV_ID)["options"])


def _least_squares(**more: Any) -> LeastSquares:
    return LeastSquares(window_every_s=WINDOW_EVERY_S, **more)


#: By name, what is compared. Least squares with nuisances are told the truth: which constants are wrong, and how much.
CALIBRATORS: dict[str, Callable[[], Estimator]] = {
    "LAC, pretrained": lambda: PolicyEstimator.pretrained(ENV_ID),
    "LAC, pretrained for recorded cells": lambda: PolicyEstimator.pretrained(ENV_ID, recorded=True),
    "the fit that LAC sees, no policy": _fit_alone,
    "least squares, two parameters": lambda: _least_squares(mismatch_V=MISMATCH_V),
    "least squares, nuisances, offset": lambda: _least_squares(
        nuisance={**dict.fromkeys(UNCERTAIN_CONSTANTS, 0.2), "offset_V": OFFSET_SD_V}
    ),
    "Kalman filter": ExtendedKalmanFilter,
    "Kalman filter, told 20 mV": lambda: ExtendedKalmanFilter(mismatch_V=0.02, voltage_noise_V=0.02),
}
#: Those that are run on recorded cells too.
ON_CELLS: dict[str, Callable[[], Estimator]] = {
    **{name: CALIBRATORS[name] for name in ("LAC, pretrained", "LAC, pretrained for recorded cells")},
    "the fit that LAC sees, no policy": _fit_alone,
    "least squares": real_calibrator,
    "Kalman filter": lambda: ExtendedKalmanFilter(thermal=True, mismatch_V=0.05),
}


def simulated_part(calibrator: str, mismatch: float, sensor: str, discharges: int, made: str) -> Tables:
    """Score one calibrator on simulated cells."""
    estimator = CALIBRATORS[calibrator]()
    data = standard_dataset(("q_mobile", "r_o"), "piecewise", "test", mismatch=mismatch)[:discharges]
    scores = evaluate(estimator, data, SENSORS[sensor], seed=1)
    scores["cpu_time_per_estimate_s"] = cpu_time_per_estimate_s(estimator, data[:2], slow=False)
    return {"mismatch": scores.assign(calibrator=calibrator, mismatch=mismatch, sensor=sensor, policy=made)}


def recorded_part(calibrator: str, cell: str, made: str) -> Tables:
    """Let one calibrator estimate a recorded cell, after whole discharges and after parts of them."""
    rows = []
    is_thermal = calibrator in ("least squares", "Kalman filter")
    model = RecordModel(thermal=is_thermal)
    for discharge in load_nasa_discharges(cell)[::_EVERY]:
        record = discharge.loaded_part(CUT_OFF_V)
        start_s, end_s = record.time_s[[0, -1]]
        for share in (*SHARES, 1.0):
            part = record if share == 1.0 else record.until(start_s + share * (end_s - start_s))
            estimate: Estimate = ON_CELLS[calibrator]().estimate(part)
            eod_time_s = model.forecast(part, estimate, CUT_OFF_V).eod_time_s
            rows.append(
                {
                    "calibrator": calibrator,
                    "cell": cell,
                    "cycle": discharge.meta["cycle"],
                    "share": share,
                    "capacity_Ah": discharge.meta["capacity_Ah"],
                    "q_mobile_C": estimate.q_mobile,
                    "r_o_ohm": estimate.r_o,
                    "settled": estimate.settled,
                    "eod_error_percent": 100.0 * (eod_time_s - end_s) / (end_s - start_s),
                    "policy": made,
                }
            )
    return {"mismatch_cells": pd.DataFrame(rows)}


def simulated_table(scores: pd.DataFrame) -> pd.DataFrame:
    """The table of simulated cells."""
    rows = []
    for (mismatch, sensor, calibrator), group in scores.groupby(["mismatch", "sensor", "calibrator"], sort=False):
        row = {"constants off by": f"{mismatch:g}", "sensor": sensor, "calibrator": calibrator}
        for name, symbol in SYMBOLS.items():
            error = group[f"{name}_second_half_mape_percent"]
            row[f"{symbol}: mean (worst) error (%)"] = f"{error.mean():.2f} ({error.max():.2g})"
            row[f"{symbol}, last estimate (%)"] = f"{group[f'{name}_final_error_percent'].mean():.2f}"
            row[f"{symbol}, within two stated sd (%)"] = digits(group[f"{name}_coverage_percent"].mean())
        row["settled in the end (%)"] = f"{100.0 * np.isfinite(group['settled_time_s']).mean():.0f}"
        row["CPU time per estimate"] = duration(group["cpu_time_per_estimate_s"].iloc[0])
        rows.append(row)
    return pd.DataFrame(rows)


def recorded_table(found: pd.DataFrame) -> pd.DataFrame:
    """The table of recorded cells. Least squares on the whole discharge stand for the truth."""
    rows = []
    truth = found[(found["calibrator"] == "least squares") & (found["share"] == 1.0)].set_index(["cell", "cycle"])[
        "q_mobile_C"
    ]
    for (cell, calibrator), group in found.groupby(["cell", "calibrator"], sort=False):
        row = {"cell": cell, "calibrator": calibrator}
        whole = group[group["share"] == 1.0]
        expected_C = truth.loc[cell].loc[whole["cycle"]].to_numpy()
        off = 100.0 * np.abs(whole["q_mobile_C"].to_numpy() / expected_C - 1.0)
        row["q^max, whole: mean (worst) departure from least squares (%)"] = f"{off.mean():.1f} ({off.max():.1f})"
        row["corr(q^max, capacity)"] = f"{whole['q_mobile_C'].corr(whole['capacity_Ah']):.4f}"
        for share in SHARES:
            error = group[group["share"] == share]["eod_error_percent"].abs()
            row[f"end, error at {100 * share:.0f} %: mean (worst) (%)"] = f"{error.mean():.1f} ({error.max():.0f})"
        rows.append(row)
    return pd.DataFrame(rows)


def plot_scores(scores: pd.DataFrame) -> Figure:
    """Errors of all simulated discharges."""
    conditions = list(dict.fromkeys(zip(scores["mismatch"], scores["sensor"], strict=True)))
    figure = new_figure(10.4, 1.9 * len(conditions) + 0.4)
    panels = figure.subplots(len(conditions), len(PARAMETER_NAMES), sharex="col", sharey=True, squeeze=False)
    names = list(dict.fromkeys(scores["calibrator"]))
    for row, (mismatch, sensor) in zip(panels, conditions, strict=True):
        of_row = scores[(scores["mismatch"] == mismatch) & (scores["sensor"] == sensor)]
        for axes, parameter in zip(row, PARAMETER_NAMES, strict=True):
            for n, (colour, name) in enumerate(coloured(names)):
                errors = of_row[of_row["calibrator"] == name][f"{parameter}_second_half_mape_percent"].to_numpy()
                axes.plot(errors, np.full(len(errors), n), "o", ms=3, mew=0, alpha=0.35, color=colour)
                axes.plot([errors.mean()] * 2, [n - 0.35, n + 0.35], color=colour, lw=2.2)
            axes.set(xscale="log", title=f"{LABELS[parameter].split(' (')[0]}, constants off by {mismatch:g}, {sensor}")
            axes.title.set_fontsize(9)
            axes.grid(axis="x", alpha=0.25)
        row[0].set_yticks(range(len(names)), names, fontsize=8)
    panels[0, 0].invert_yaxis()  # they share it
    for axes in panels[-1]:
        axes.set_xlabel("error in the second half (%)")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("mismatch", __doc__, jobs=1)
    parser.add_argument("--discharges", type=positive, default=60, help="simulated test discharges, up to 300")
    parser.add_argument("--cells", nargs="*", choices=BUNDLED_CELLS, default=list(BUNDLED_CELLS))
    study = Study(parser, arguments)
    check_discharges(parser, study.chosen.discharges)
    policies = [pretrained_card(ENV_ID, recorded)["sha256"][:8] for recorded in (False, True)]
    study.configuration |= {"policies": policies, "window_every_s": WINDOW_EVERY_S, "every_recorded_discharge": _EVERY}

    def made(calibrator: str) -> str:
        return policies["recorded" in calibrator] if calibrator.startswith("LAC") else ""

    parts = [
        {
            "calibrator": calibrator,
            "mismatch": mismatch,
            "sensor": sensor,
            "discharges": study.chosen.discharges,
            "made": made(calibrator),
        }
        for mismatch in MISMATCHES
        for sensor in SENSORS
        for calibrator in CALIBRATORS
    ]
    tables = study.run(simulated_part, parts)
    text = markdown(simulated_table(tables["mismatch"]))
    cells = [{"calibrator": name, "cell": cell, "made": made(name)} for cell in study.chosen.cells for name in ON_CELLS]
    if cells:
        tables |= study.run(recorded_part, cells)
        text += "\n" + markdown(recorded_table(tables["mismatch_cells"]))
    study.write(tables, {"mismatch": plot_scores(tables["mismatch"])}, text)


if __name__ == "__main__":
    main()
