"""
The command line: what a record of a discharge says about its cell.

.. code-block:: bash

  python -m battery_env calibrate discharge.csv
  python -m battery_env calibrate B0005:12 --out results/B0005
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from battery_env.cells import BUNDLED_CELLS, Discharge, load_nasa_discharges, read_discharge_csv
from battery_env.estimates import Estimate
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V, calibrator_from_json
from battery_env.estimators.least_squares import LeastSquares
from battery_env.files import replacing
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import plot_discharge, save_figure
from battery_env.record_model import Forecast
from battery_env.records import ExpectedCurrent, expected_current


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m battery_env", description="Calibrate a battery model to real cells.")
    commands = parser.add_subparsers(dest="command", required=True)
    calibrate = commands.add_parser(
        "calibrate",
        help="capacity and resistance of a cell from one discharge",
        description=(
            "Fit the charge that can move, q_mobile, and the ohmic resistance, r_o, of the model to one discharge that "
            "starts with a full cell, and predict when the cut-off voltage is reached."
        ),
    )
    calibrate.add_argument(
        "record",
        help="file of comma-separated values with columns time_s, voltage_V, current_A (positive = discharge) and, if "
        "measured, temperature_C; or a bundled cell and its discharge, such as B0005:12",
    )
    calibrate.add_argument(
        "--parameters",
        nargs="+",
        choices=PARAMETER_NAMES,
        default=PARAMETER_NAMES,
        help="what to fit; the other is held at the new cell's value (default: both)",
    )
    calibrate.add_argument(
        "--cut-off", type=float, default=2.7, metavar="V", help="voltage at which the discharge ends, V (default: %(default)s)"
    )
    calibrate.add_argument(
        "--prior-q",
        nargs=2,
        type=float,
        metavar=("MEAN", "SD"),
        help="q_mobile as known from an earlier discharge, C; while a discharge is in progress the estimate rests on it",
    )
    calibrate.add_argument(
        "--mismatch",
        type=float,
        metavar="V",
        help="error to expect of the model itself, V; 0 for simulated data (default: 0.05, or that of the fit of --cell)",
    )
    calibrate.add_argument(
        "--current-gain-sd",
        type=float,
        default=0.005,
        metavar="SHARE",
        help="standard deviation of the gain of the current sensor, which q_mobile and r_o share (default: %(default)s)",
    )
    calibrate.add_argument(
        "--future-current",
        type=float,
        metavar="A",
        help="current after the end of a record in progress, A (default: its last one, or its mean if it varied)",
    )
    calibrate.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="constants of the cell, as battery_env.fit_cell(...).to_json saves them (default: the new cell's)",
    )
    calibrate.add_argument("--isothermal", action="store_true", help="keep the temperature of the model constant")
    calibrate.add_argument("--discharge-is-negative", action="store_true", help="the file counts discharge as negative")
    calibrate.add_argument("--out", type=Path, metavar="DIR", help="write the estimate, the voltages and a figure there")
    calibrate.add_argument("--force", action="store_true", help="replace results that are there already")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run one command.

    :param arguments: of the command line; ``None``: those of this process
    :return: 0, or 2 if the input cannot be used; then one line on standard error says why
    """
    options = _parser().parse_args(arguments)
    try:
        _calibrate(options)
    except (ValueError, TypeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _calibrate(options: argparse.Namespace) -> None:
    name, discharge = _read(options.record, options.discharge_is_negative)
    outputs = (
        [options.out / f"{name}_{kind}" for kind in ("estimate.csv", "voltage.csv", "voltage.png")] if options.out else []
    )
    existing = [str(path) for path in outputs if path.exists()]
    if existing and not options.force:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; choose another --out, or give --force")

    record = discharge.loaded_part(options.cut_off)
    calibrator = _calibrator(options)
    new_q_mobile_C = calibrator.model.cell.q_mobile
    estimate = calibrator.estimate(record)
    future = expected_current(record.time_s, record.current_A)
    if options.future_current is not None:
        future = ExpectedCurrent(options.future_current, varied=False, sd_A=0.0)
    forecast = calibrator.model.forecast(record, estimate, options.cut_off, future.mean_A)
    row = _summary(record, estimate, forecast, discharge.eod_time_s(options.cut_off), future)
    row["state_of_health"] = estimate.q_mobile / new_q_mobile_C
    if "q_mobile" not in options.parameters:
        row["state_of_health"] = float("nan")
    _print(name, record, row, options.parameters, options.cut_off, future, new_q_mobile_C)
    if not options.prior_q and not estimate.settled and np.isnan(row["measured_eod_time_s"]):
        print("During a discharge give --prior-q with the q_mobile of an earlier one of this cell. Without it the filter in")
        print("Python, ExtendedKalmanFilter(thermal=True, mismatch_V=0.05), predicts the end better than this fit.")
    if outputs:
        with replacing(outputs[0]) as part:
            pd.DataFrame([{"record": name, **row}]).to_csv(part, index=False)
        columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
        with replacing(outputs[1]) as part:
            pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(part, index=False)
        save_figure(plot_discharge(record, {name: forecast}), outputs[2])
        print("\nwritten: " + ", ".join(map(str, outputs)))


def _calibrator(options: argparse.Namespace) -> LeastSquares:
    arguments: dict[str, Any] = {
        "parameters": options.parameters,
        "thermal": not options.isothermal,
        "prior_q_mobile_C": tuple(options.prior_q) if options.prior_q else None,
        "current_gain_sd": options.current_gain_sd,
    }
    if options.mismatch is not None:
        arguments["mismatch_V"] = options.mismatch
    if options.cell is None:
        return LeastSquares(**{"mismatch_V": UNFITTED_MISMATCH_V, **arguments})
    return calibrator_from_json(options.cell, **arguments)


def _read(record: str, discharge_is_negative: bool) -> tuple[str, Discharge]:
    """A file, or ``CELL:CYCLE`` of a bundled cell; and what to call its results."""
    cell, colon, cycle = record.partition(":")
    if cell not in BUNDLED_CELLS:
        path = Path(record)
        if not path.is_file():
            raise FileNotFoundError(
                f"no file {record!r}; the bundled cells are given as {BUNDLED_CELLS[0]}:1, {BUNDLED_CELLS[0]}:2, ..."
            )
        return path.name.split(".")[0], read_discharge_csv(path, discharge_is_negative)
    discharges = load_nasa_discharges(cell)
    if not (colon and cycle.isdecimal() and 1 <= int(cycle) <= len(discharges)):
        raise ValueError(f"{cell} has discharges {cell}:1 .. {cell}:{len(discharges)}, got {record!r}")
    return f"{cell}_{int(cycle):03d}", discharges[int(cycle) - 1]


def _summary(
    record: Discharge, estimate: Estimate, forecast: Forecast, measured_eod_s: float, future: ExpectedCurrent
) -> dict[str, Any]:
    remaining_s = max(forecast.eod_time_s - float(record.time_s[-1]), 0.0) if np.isnan(measured_eod_s) else 0.0
    residual_V = forecast.at_samples_V - record.voltage_V
    return {
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "r_o_ohm": estimate.r_o,
        "sd_r_o_ohm": estimate.sd_r_o,
        "settled": estimate.settled,
        "reason": estimate.reason,
        "drawn_Ah": record.charge_C / 3600.0,
        "state_of_health": float("nan"),
        "voltage_rmse_V": float(np.sqrt(np.nanmean(residual_V**2))),
        "predicted_eod_time_s": forecast.eod_time_s,
        "sd_predicted_eod_time_s": _sd_eod_s(estimate, remaining_s, future),
        "measured_eod_time_s": measured_eod_s,
        "remaining_s": remaining_s,
        "future_current_A": future.mean_A,
    }


def _sd_eod_s(estimate: Estimate, remaining_s: float, future: ExpectedCurrent) -> float:
    """The charge still to come moves with q_mobile, and is drawn at a current that may not be the one assumed."""
    if not future.mean_A > 0.0:
        return float("nan")
    return float(np.hypot(estimate.sd_q_mobile, remaining_s * future.sd_A)) / future.mean_A


def _print(
    name: str,
    record: Discharge,
    row: dict[str, Any],
    fitted: Sequence[str],
    cut_off_V: float,
    future: ExpectedCurrent,
    new_q_mobile_C: float,
) -> None:
    in_progress = np.isnan(row["measured_eod_time_s"])
    lines = {
        "q_mobile": (f"{row['q_mobile_C']:.0f} C", f"{row['sd_q_mobile_C']:.0f} C"),
        "r_o": (f"{row['r_o_ohm']:.4f} ohm", f"{row['sd_r_o_ohm']:.4f} ohm"),
    }
    print(f"{name}: {len(record.time_s)} samples from load-on at {record.time_s[0]:.1f} s, {record.charge_C:.0f} C drawn\n")
    for parameter, (value, sd) in lines.items():
        print(f"  {parameter:<22}{value:>12}   {'sd ' + sd if parameter in fitted else 'held'}")
    print(f"  {'settled':<22}{'yes' if row['settled'] else 'no':>12}")
    print(f"  {'drawn':<22}{row['drawn_Ah']:>9.3f} Ah   {'so far' if in_progress else f'the capacity to {cut_off_V:g} V'}")
    if "q_mobile" in fitted:
        print(f"  {'state of health':<22}{row['state_of_health']:>12.3f}   q_mobile / {new_q_mobile_C:.0f} C")
    print(f"  {'voltage RMSE':<22}{1e3 * row['voltage_rmse_V']:>9.1f} mV")
    print(f"  {f'{cut_off_V:g} V, predicted at':<22}{row['predicted_eod_time_s']:>10.0f} s")
    if in_progress:
        sure = f"sd {row['sd_predicted_eod_time_s']:.0f} s, " if "q_mobile" in fitted else ""
        load = "the mean current so far, an assumption: the load varied" if future.varied else "to go on"
        print(f"  {'remaining':<22}{row['remaining_s']:>10.0f} s   {sure}{future.mean_A:.3g} A {load}")
    else:
        print(f"  {f'{cut_off_V:g} V, measured at':<22}{row['measured_eod_time_s']:>10.0f} s")
    if not row["settled"]:
        print(f"\nNot settled: {row['reason']}")


if __name__ == "__main__":
    sys.exit(main())
