"""
What a discharge says about q_mobile and r_o, and when: every number and figure of docs/identifiability.md.

.. code-block:: bash

  python -m benchmarks.identifiability

One simulated cell, discharged at a constant and at a varying current; bounds on what any calibrator can know, and what least
squares makes of records with noise, with errors that do not average out, and with priors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from battery_env.estimators import LeastSquares, cramer_rao_bound, sensitivities
from battery_env.plotting import plot_estimates, plot_sensitivities, save_figure
from battery_env.sensors import SensorErrors
from benchmarks import identifiability_report as report
from benchmarks import identifiability_tables as measure
from benchmarks.reporting import write_csv, write_text


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100, help="records with noise per case of least squares")
    parser.add_argument("--out", type=Path, default=Path("results/identifiability"))
    chosen = parser.parse_args(arguments)
    if chosen.draws < 1:
        parser.error("--draws must be at least 1")
    records, costs = measure.discharges(), measure.one_step_costs()
    tables = {
        "conservation": measure.conservation_table(),
        "response": measure.response_table(records["constant"]),
        "sensitivity": measure.sensitivity_table(records["constant"]),
        "bounds": measure.bounds_table(records),
        "late": measure.late_table(records),
        "windows": measure.windows_table(records["constant"]),
        "least_squares": measure.least_squares_table(records, chosen.draws),
        "faults": measure.faults_table(),
        "offsets": measure.offsets_table(records),
        "priors": measure.priors_table(records["constant"]),
        "minima": measure.minima_table(costs),
    }
    configuration = {
        "draws": chosen.draws,
        "q_mobile_C": measure.TRUE.q_mobile,
        "r_o_ohm": measure.TRUE.r_o,
        "current_A": measure.CURRENT_A,
        "current_range_A": measure.CURRENT_RANGE_A,
        "seed": measure.SEED,
    }
    for name, table in tables.items():
        write_csv(chosen.out / f"{name}.csv", table, configuration)
    noisy = SensorErrors(noise_V=measure.NOISE_V).apply(records["constant"], np.random.default_rng(measure.SEED))
    trace = LeastSquares(voltage_noise_V=measure.NOISE_V, window_every_s=60.0).trace([noisy])[0]
    figures = {
        "sensitivity": plot_sensitivities({f"{load} current": sensitivities(record) for load, record in records.items()}),
        "bounds": report.plot_bounds(records),
        "loads": report.plot_loads(records),
        "estimates": plot_estimates({"least squares": trace}, measure.TRUE, cramer_rao_bound(noisy, measure.NOISE_V)),
        "faults": report.plot_faults(tables["faults"]),
        "misfits": report.plot_misfits(records),
        "one_step": report.plot_one_step(costs),
    }
    for name, figure in figures.items():
        save_figure(figure, chosen.out / f"{name}.png")
    text = report.summary(tables)
    write_text(chosen.out / "summary.md", text)
    sys.stdout.write("\n" + text)


if __name__ == "__main__":
    main()
