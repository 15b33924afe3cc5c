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

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

from battery_env.calibration.data import standard_dataset
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS
from battery_env.estimators import Estimator, LeastSquares
from battery_env.evaluation import evaluate
from battery_env.parameters import PARAMETER_NAMES
from benchmarks.reporting import write_csv, write_text
from benchmarks.voltage import SENSORS

#: Error of the model that the fit of two parameters is told, V: the best of a few.
MISMATCH_V = 0.02
#: Standard deviation of the offset, uniform within 10 mV to either side, V.
OFFSET_SD_V = 0.01 / np.sqrt(3.0)


def calibrators(mismatch: float, every_s: float) -> dict[str, Estimator]:
    """
    What is compared.

    :param mismatch: relative standard deviation of the constants
    :param every_s: time between two estimates, s
    :return: by name
    """
    constants = dict.fromkeys(UNCERTAIN_CONSTANTS, mismatch)
    return {
        "two parameters": LeastSquares(mismatch_V=MISMATCH_V, window_every_s=every_s),
        "with nuisance constants": LeastSquares(nuisance=constants, window_every_s=every_s),
        "with nuisance constants and offset": LeastSquares(
            nuisance={**constants, "offset_V": OFFSET_SD_V}, window_every_s=every_s
        ),
    }


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """
    The table for people.

    :param scores: one row per mismatch, sensor, calibrator and discharge
    :return: one row per mismatch, sensor and calibrator
    """
    rows = []
    for (mismatch, sensor, calibrator), part in scores.groupby(["mismatch", "sensor", "calibrator"], sort=False):
        row = {"mismatch": f"{mismatch:g}", "sensor": sensor, "least squares": calibrator}
        for name, symbol in zip(PARAMETER_NAMES, ("q^max", "R_o"), strict=True):
            error = part[f"{name}_second_half_mape_percent"]
            row[f"{symbol}: mean (worst) error (%)"] = f"{error.mean():.2f} ({error.max():.2g})"
            row[f"{symbol}, last estimate (%)"] = f"{part[f'{name}_final_error_percent'].mean():.2f}"
            row[f"{symbol} within 2 sd (%)"] = f"{part[f'{name}_coverage_percent'].mean():.0f}"
        row["time per estimate (ms)"] = f"{1e3 * part['time_per_update_s'].iloc[0]:.0f}"
        rows.append(row)
    return pd.DataFrame(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.nuisance", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--mismatch", nargs="+", type=float, default=[0.2], help="relative standard deviations of the constants"
    )
    parser.add_argument("--discharges", type=int, default=60, help="test discharges")
    parser.add_argument("--every", type=float, default=180.0, help="time between two estimates, s")
    parser.add_argument("--out", type=Path, default=Path("results/nuisance"))
    chosen = parser.parse_args(arguments)
    if not 1 <= chosen.discharges <= 300 or not chosen.every > 0.0 or not all(0.0 < x <= 0.5 for x in chosen.mismatch):
        parser.error("--discharges must lie within 1 .. 300, --every be above 0, and --mismatch within 0 .. 0.5")
    tables = []
    runs = [
        (mismatch, sensor, name)
        for mismatch in chosen.mismatch
        for sensor in SENSORS
        for name in calibrators(mismatch, chosen.every)
    ]
    for mismatch, sensor, name in tqdm(runs, unit="calibrator", file=sys.stderr):
        data = standard_dataset("joint", "piecewise", "test", mismatch=mismatch)[: chosen.discharges]
        scores = evaluate(calibrators(mismatch, chosen.every)[name], data, SENSORS[sensor], seed=1)
        tables.append(scores.assign(mismatch=mismatch, sensor=sensor, calibrator=name))
    scores = pd.concat(tables, ignore_index=True)
    configuration = {name: value for name, value in vars(chosen).items() if name != "out"}
    write_csv(chosen.out / "nuisance.csv", scores, {**configuration, "mismatch_V_of_two_parameters": MISMATCH_V})
    text = summary(scores).to_markdown(index=False, disable_numparse=True) + "\n"
    write_text(chosen.out / "nuisance.md", text)
    sys.stdout.write("\n" + text)


if __name__ == "__main__":
    main()
