"""
What a discharge says about q_mobile and r_o, and when: every number and figure of docs/identifiability.md.

.. code-block:: bash

  python -m benchmarks.identifiability

One simulated cell, discharged at a constant and at a varying current; bounds on what any calibrator can know, and what least
squares makes of records with noise, with errors that do not average out, and with priors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from battery_env.estimators import LeastSquares, cramer_rao_bound, sensitivities
from battery_env.plotting import plot_estimates, plot_sensitivities
from battery_env.sensors import SensorErrors
from benchmarks import identifiability_report as report
from benchmarks import identifiability_tables as measure
from benchmarks.study import Study, command_line, positive


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("identifiability", __doc__)
    parser.add_argument("--draws", type=positive, default=100, help="records with noise per case of least squares")
    study = Study(parser, arguments)
    tables = study.run(measure.part, [{"table": name, "draws": study.chosen.draws} for name in measure.TABLES])
    study.configuration |= {
        "q_mobile_C": measure.TRUE.q_mobile,
        "r_o_ohm": measure.TRUE.r_o,
        "current_A": measure.CURRENT_A,
        "current_range_A": measure.CURRENT_RANGE_A,
        "seed": measure.SEED,
    }
    records = measure.discharges()
    noisy = SensorErrors(noise_V=measure.NOISE_V).apply(records["constant"], np.random.default_rng(measure.SEED))
    trace = LeastSquares(voltage_noise_V=measure.NOISE_V, window_every_s=60.0).trace([noisy])[0]
    figures = {
        "sensitivity": plot_sensitivities({f"{load} current": sensitivities(record) for load, record in records.items()}),
        "bounds": report.plot_bounds(records),
        "loads": report.plot_loads(records),
        "estimates": plot_estimates({"least squares": trace}, measure.TRUE, cramer_rao_bound(noisy, measure.NOISE_V)),
        "faults": report.plot_faults(tables["faults"]),
        "misfits": report.plot_misfits(records),
        "one_step": report.plot_one_step(measure.one_step_costs()),
    }
    study.write(tables, figures, report.summary(tables), "summary")


if __name__ == "__main__":
    main()
