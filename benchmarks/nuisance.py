"""
Calibrate cells whose other constants are wrong: least squares for ``q_mobile`` and ``r_o`` alone, and with these constants as
nuisances under priors.

.. code-block:: bash

  python -m benchmarks.nuisance --mismatch 0.2

The discharges are those of ``BatteryVoltageJoint-v0``'s test part: of each cell kn, tDiffusion, to and tsn are off by a factor
with this relative standard deviation, which the priors state. Voltage and current are read every second; errors are means over
the second half of the discharges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from battery_env.calibration.data import standard_dataset
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS
from battery_env.estimators import Estimator, LeastSquares
from battery_env.evaluation import evaluate
from benchmarks.contests import SENSORS
from benchmarks.study import SYMBOLS, Study, Tables, command_line, markdown, positive

#: Error of the model that the fit of two parameters is told, V: the best of a few.
MISMATCH_V = 0.02
#: Standard deviation of the offset, uniform within 10 mV to either side, V.
OFFSET_SD_V = 0.01 / np.sqrt(3.0)


def calibrators(mismatch: float, every_s: float) -> dict[str, Estimator]:
    """What is compared."""
    constants = dict.fromkeys(UNCERTAIN_CONSTANTS, mismatch)
    return {
        "two parameters": LeastSquares(mismatch_V=MISMATCH_V, window_every_s=every_s),
        "with nuisance constants": LeastSquares(nuisance=constants, window_every_s=every_s),
        "with nuisance constants and offset": LeastSquares(
            nuisance={**constants, "offset_V": OFFSET_SD_V}, window_every_s=every_s
        ),
    }


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """The table for people."""
    rows = []
    for (mismatch, sensor, calibrator), part in scores.groupby(["mismatch", "sensor", "calibrator"], sort=False):
        row = {"mismatch": f"{mismatch:g}", "sensor": sensor, "least squares": calibrator}
        for name, symbol in SYMBOLS.items():
            error = part[f"{name}_second_half_mape_percent"]
            row[f"{symbol}: mean (worst) error (%)"] = f"{error.mean():.2f} ({error.max():.2g})"
            row[f"{symbol}, last estimate (%)"] = f"{part[f'{name}_final_error_percent'].mean():.2f}"
            row[f"{symbol} within 2 sd (%)"] = f"{part[f'{name}_coverage_percent'].mean():.0f}"
        row["time per estimate (ms)"] = f"{1e3 * part['time_per_update_s'].iloc[0]:.0f}"
        rows.append(row)
    return pd.DataFrame(rows)


def part(mismatch: float, sensor: str, calibrator: str, discharges: int, every_s: float) -> Tables:
    """Score one calibrator."""
    data = standard_dataset(("q_mobile", "r_o"), "piecewise", "test", mismatch=mismatch)[:discharges]
    scores = evaluate(calibrators(mismatch, every_s)[calibrator], data, SENSORS[sensor], seed=1)
    return {"nuisance": scores.assign(mismatch=mismatch, sensor=sensor, calibrator=calibrator)}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("nuisance", __doc__)
    parser.add_argument(
        "--mismatch", nargs="+", type=float, default=[0.2], help="relative standard deviations of the constants"
    )
    parser.add_argument("--discharges", type=positive, default=60, help="test discharges")
    parser.add_argument("--every", type=float, default=180.0, help="time between two estimates, s")
    study = Study(parser, arguments)
    chosen = study.chosen
    if chosen.discharges > 300 or not chosen.every > 0.0 or not all(0.0 < x <= 0.5 for x in chosen.mismatch):
        parser.error("--discharges must lie within 1 .. 300, --every be above 0, and --mismatch within 0 .. 0.5")
    study.configuration["mismatch_V_of_two_parameters"] = MISMATCH_V
    parts = [
        {
            "mismatch": mismatch,
            "sensor": sensor,
            "calibrator": calibrator,
            "discharges": chosen.discharges,
            "every_s": chosen.every,
        }
        for mismatch in chosen.mismatch
        for sensor in SENSORS
        for calibrator in calibrators(mismatch, chosen.every)
    ]
    tables = study.run(part, parts)
    study.write(tables, {}, markdown(summary(tables["nuisance"])))


if __name__ == "__main__":
    main()
