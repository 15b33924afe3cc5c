"""
The command line: what records of discharges say about their cells, and how their constants are found.

.. code-block:: bash

  python -m battery_env calibrate discharge.csv
  python -m battery_env calibrate B0005:12 --out results/B0005
  battery-calibrate lab/ --out results --jobs 2
  python -m battery_env fit B0005:1 B0005:84 B0005:168 --out my_cell.json
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from battery_env.cells import Discharge
from battery_env.estimators.cell_fit import CellFit, fit_cell, read_cell
from battery_env.estimators.rest import InitialSoc
from battery_env.files import check_folder
from battery_env.fleet import Reading, Results, calibrate_all, find_sources, read_source
from battery_env.parameters import PARAMETER_NAMES
from battery_env.summary import METHODS, Settings, text_of

#: What the process returns: all records settled, one or more refused, one or more not settled, stopped by Ctrl-C.
SETTLED, REFUSED, NOT_SETTLED, INTERRUPTED = 0, 2, 3, 130

# So many discharges fit beside each other in the figure of a fit.
_MOST_SHOWN = 4

_QUANTITY = re.compile(r",\s*(?=\w+=)")


def _parser(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=name,
        description=(
            "Fit the charge that can move, q_mobile, and the ohmic resistance, r_o, of the model to discharges that each "
            "start with a full cell, or with --initial-soc, and predict when the cut-off voltage is reached."
        ),
        epilog="Exit status: 0 if every discharge is settled, 3 if one is not, 2 if one cannot be used.",
        allow_abbrev=False,
    )
    _add_reading(parser)
    _add_calibration(parser.add_argument_group("calibration"))
    _add_results(parser.add_argument_group("results"))
    return parser


def _fit_parser(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=name,
        description=(
            "Fit the constants of the model to a few discharges of one cell, each from full charge to its knee, and save them "
            "for --cell of calibrate. Take three or more, of all ages and loads that they are to hold for."
        ),
        epilog="Exit status: 0, 3 if the discharges may not have started full, or 2 if one cannot be used or the equations do "
        "not describe the cell.",
        allow_abbrev=False,
    )
    _add_reading(parser)
    group = parser.add_argument_group("fit")
    group.add_argument(
        "--cut-off", type=float, default=2.7, metavar="V", help="voltage at which the discharge ends, V (default: %(default)s)"
    )
    group.add_argument("--isothermal", action="store_true", help="keep the temperature of the model constant")
    group.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE.json",
        help="write the fit there, and beside it a figure, FILE.png; neither may exist",
    )
    return parser


def _add_reading(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "records",
        nargs="+",
        metavar="FILE",
        help="text of any delimiter, Parquet, NASA's .mat, Neware's .nda and .ndax, BioLogic's .mpr; a folder of them; "
        "FILE:CYCLE for one discharge of a life; or a bundled cell, B0005, and its discharge, B0005:12",
    )
    group = parser.add_argument_group("reading")
    group.add_argument(
        "--columns",
        type=_assignments,
        metavar="time=NAME,...",
        help="names of the columns of time, voltage, current, temperature, ambient, cycle, step and state, where their names "
        "do not tell",
    )
    group.add_argument(
        "--units",
        type=_assignments,
        metavar="time=UNIT,...",
        help="their units, where the names do not tell: s, ms, min, h; V, mV; A, mA; degC, K",
    )
    sign = group.add_mutually_exclusive_group()
    sign.add_argument(
        "--discharge-is-negative",
        action="store_const",
        const=True,
        dest="discharge_is_negative",
        help="the files count discharge as negative (default: told from the voltage)",
    )
    sign.add_argument(
        "--discharge-is-positive", action="store_const", const=False, dest="discharge_is_negative", help="or as positive"
    )


def _add_calibration(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="least squares for whole discharges, the filter for one in progress without a prior, or a policy trained on "
        "simulated cells (default: %(default)s)",
    )
    group.add_argument(
        "--policy",
        type=Path,
        metavar="FILE.onnx",
        help="what --method policy follows, with the constants of --cell if it was trained with them (default: the "
        "policy that comes with the package, which has learned on a new 18650)",
    )
    group.add_argument(
        "--parameters",
        nargs="+",
        choices=PARAMETER_NAMES,
        default=PARAMETER_NAMES,
        help="what to fit; the other is held at the cell's value (default: both). Give it after the files",
    )
    group.add_argument(
        "--cut-off",
        type=float,
        metavar="V",
        help="voltage at which the discharge ends, V (default: 2.7, or that of the fit of --cell)",
    )
    group.add_argument(
        "--prior",
        "--prior-q",
        nargs=2,
        type=float,
        metavar=("MEAN", "SD"),
        help="q_mobile as known from an earlier discharge, C; while a discharge is in progress the estimate rests on it",
    )
    group.add_argument(
        "--initial-soc",
        type=_initial_soc,
        default=1.0,
        metavar="SOC",
        help="state of charge when the load is switched on, after a rest: 0.8; with its standard deviation 0.8,0.02; or rest: "
        "told from the voltage of a minute or more at rest before the load (default: 1, a full cell)",
    )
    group.add_argument(
        "--mismatch",
        type=float,
        metavar="V",
        help="error to expect of the model itself, V; 0 for simulated data (default: 0.05, or that of the fit of --cell)",
    )
    group.add_argument(
        "--current-gain-sd",
        type=float,
        default=0.005,
        metavar="SHARE",
        help="standard deviation of the gain of the current sensor, which q_mobile and r_o share (default: %(default)s)",
    )
    group.add_argument(
        "--future-current",
        type=float,
        metavar="A",
        help="current after the end of a record in progress, A (default: its last one, or its mean if it varied)",
    )
    group.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="constants of the cell, as the command fit saves them, or CellParameters.to_json (default: those of a new 18650)",
    )
    group.add_argument(
        "--nominal",
        type=float,
        metavar="AH",
        help="nominal capacity, Ah, which the state of health refers to (default: what the cell of --cell gives at this load)",
    )
    group.add_argument(
        "--ambient",
        type=float,
        metavar="DEGC",
        help="temperature of the surroundings, degC (default: the first one measured, or the model cell's 19 degC)",
    )
    group.add_argument(
        "--isothermal",
        action="store_true",
        default=None,
        help="keep the temperature of the model constant (default: it moves, or as in the fit of --cell)",
    )


def _add_results(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write the table of estimates (CSV, Parquet), the voltages and figures there",
    )
    group.add_argument("--table-only", action="store_true", help="write no voltages of single discharges")
    group.add_argument("--force", action="store_true", help="replace results that are there already")
    group.add_argument("--json", action="store_true", help="print one JSON object a discharge and line")
    group.add_argument(
        "--jobs",
        type=_jobs,
        default=1,
        metavar="N",
        help="processes; -1: one a core (default: %(default)s)",
    )
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster, tcp://host:port, whose workers read and calibrate; they must see the files by the same names",
    )


def _assignments(text: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in _QUANTITY.split(text)]
    if any(not (name.strip() and equals and value.strip()) for name, equals, value in pairs):
        raise argparse.ArgumentTypeError(f"expected quantity=NAME,quantity=NAME, got {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


def _jobs(text: str) -> int:
    try:
        jobs = int(text)
    except ValueError:
        jobs = 0
    if jobs != -1 and jobs < 1:
        raise argparse.ArgumentTypeError(f"expected a number of processes, 1 or more, or -1 for one a core, got {text!r}")
    return jobs


def _initial_soc(text: str) -> InitialSoc | Literal["rest"]:
    if text == "rest":
        return "rest"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"expected SOC, SOC,SD or rest, got {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    parser = argparse.ArgumentParser(prog="python -m battery_env", description="Calibrate a battery model to real cells.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("calibrate", help="capacity and resistance of cells from their discharges", add_help=False)
    commands.add_parser("fit", help="the constants of a cell from a few of its discharges", add_help=False)
    command = {"calibrate": calibrate, "fit": fit}[parser.parse_args(given[:1]).command]
    return command(given[1:], f"{parser.prog} {given[0]}")


def calibrate(arguments: Sequence[str] | None = None, name: str = "battery-calibrate") -> int:
    """The command ``calibrate``, which is also installed as ``battery-calibrate``."""
    options = _parser(name).parse_args(arguments)
    interrupted = False
    try:
        settings = _settings(options)
        sources = find_sources(options.records)
        results = Results(options.out, sources, not options.table_only, options.force) if options.out else None
        reading = Reading(options.columns, options.units, options.discharge_is_negative)
        rows: list[dict[str, Any]] = []
        try:
            for row in calibrate_all(sources, reading, settings, results, options.jobs, options.scheduler):
                rows.append(row)
                _show(row, rows, options.json)
        except KeyboardInterrupt:
            print("interrupted: what is done is kept", file=sys.stderr)
            interrupted = True
        if not options.json:
            _conclude(rows, settings)
        if results and any(not row["error"] for row in rows):
            written = results.write_table(rows)
            if not options.json:
                print("\nwritten: " + ", ".join(map(str, written)))
    except (ValueError, TypeError, OSError, ImportError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    if interrupted:
        return INTERRUPTED
    if any(row["error"] for row in rows):
        return REFUSED
    return SETTLED if all(row["settled"] for row in rows) else NOT_SETTLED


def _settings(options: argparse.Namespace) -> Settings:
    given = {
        "method": options.method,
        "parameters": tuple(options.parameters),
        "cut_off_V": options.cut_off,
        "prior_q_mobile_C": tuple(options.prior) if options.prior else None,
        "mismatch_V": options.mismatch,
        "current_gain_sd": options.current_gain_sd,
        "future_current_A": options.future_current,
        "initial_soc": options.initial_soc,
        "thermal": False if options.isothermal else None,
        "ambient_C": options.ambient,
        "nominal_Ah": options.nominal,
        "policy": options.policy,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if not options.cell:
        return Settings(**given)
    if not options.cell.is_file():
        raise FileNotFoundError(
            f"no file {str(options.cell)!r} for --cell: give what the command fit, or CellParameters.to_json, wrote"
        )
    cell = read_cell(options.cell)
    if isinstance(cell, CellFit) and cell.doubt:
        print(f"warning: {options.cell}: {cell.doubt}", file=sys.stderr)
    return Settings.for_cell(cell, **given)


def fit(arguments: Sequence[str] | None = None, name: str = "python -m battery_env fit") -> int:
    """
    The command ``fit``.

    :param arguments: as in :func:`main`, without the name of the command
    :param name: of the program, for its help
    :return: 0, 3 if the discharges may not have started full, or 2 if nothing was fitted; a line on standard error says why
    """
    options = _fit_parser(name).parse_args(arguments)
    out: Path = options.out
    picture = out.with_suffix(".png")
    try:
        if out.suffix != ".json":
            raise ValueError(f"the fit is written as JSON: --out {out.name}.json instead of {out.name}")
        check_folder(out.parent)
        existing = [str(path) for path in (out, picture) if path.exists()]
        if existing:
            raise FileExistsError(f"{', '.join(existing)} would be replaced; choose another --out, or delete what is there")
        reading = Reading(options.columns, options.units, options.discharge_is_negative)
        discharges = _discharges(options.records, reading)
        print(f"fitting {len(discharges)} discharges", file=sys.stderr, flush=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the doubt, which is printed
            found = fit_cell(discharges, options.cut_off, thermal=not options.isothermal)
        print(found.summary())
        if found.doubt:
            print(f"warning: {found.doubt}", file=sys.stderr)
        found.to_json(out)

        from battery_env.plotting import plot_cell_fit, save_figure  # here, as matplotlib takes long to import

        shown = np.unique(np.linspace(0, len(discharges) - 1, _MOST_SHOWN).round().astype(np.int64))
        save_figure(plot_cell_fit(found, [discharges[n] for n in shown]), picture)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    print(f"\nwritten: {out}, {picture}")
    return NOT_SETTLED if found.doubt else SETTLED


def _discharges(records: Sequence[str], reading: Reading) -> list[Discharge]:
    """All that the arguments name, each with the cell and the number that it is shown by."""
    discharges = []
    for source in find_sources(records):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                recordings = read_source(source, reading)
                for number, recording in enumerate(recordings, start=1):
                    meta = {"cycle": number, **recording.meta, "cell": source.stem}
                    discharges.append(recording._replace(meta=meta).discharge())
            except Exception as error:  # readers of files raise what they like
                text = " ".join(str(error).split())
                raise ValueError(text if source.path in text else f"{source.argument}: {text}") from error
        for each in caught:
            print(f"warning: {source.argument}: {each.message}", file=sys.stderr)
    return discharges


def _show(row: dict[str, Any], done: Sequence[dict[str, Any]], as_json: bool) -> None:
    """Prints a row as it comes: a line each, but the first one waits, as it is printed in full if it stays the only one."""
    if as_json:
        print(json.dumps({key: _plain(value) for key, value in row.items()}), flush=True)
    if row["notes"]:
        print(f"warning: {row['record']}: {row['notes']}", file=sys.stderr)
    if row["error"]:
        print(f"error: {row['error']}", file=sys.stderr, flush=True)
    if len(done) > 1 and not as_json:
        for each in done if len(done) == 2 else done[-1:]:
            _print_line(each)


def _conclude(done: Sequence[dict[str, Any]], settings: Settings) -> None:
    if len(done) > 1:
        settled = sum(not row["error"] and row["settled"] for row in done)
        refused = sum(bool(row["error"]) for row in done)
        print(f"\n{len(done)} discharges: {settled} settled, {len(done) - settled - refused} not settled, {refused} refused")
        if settings.method == "policy":
            print(f"calibrated by {settings.calibrated_by}")
    elif done and not done[0]["error"]:
        print(text_of(done[0]["record"], done[0], settings))


def _print_line(row: dict[str, Any]) -> None:
    if row["error"]:
        return
    health = "" if math.isnan(row["state_of_health"]) else f"  health {row['state_of_health']:.3f}"
    sd_q_mobile = "" if math.isnan(row["sd_q_mobile_C"]) else f" sd {row['sd_q_mobile_C']:3.0f}"
    sd_r_o = "" if math.isnan(row["sd_r_o_ohm"]) else f" sd {row['sd_r_o_ohm']:.4f}"
    print(
        f"{row['record']:<18} q_mobile {row['q_mobile_C']:5.0f} C{sd_q_mobile}  r_o {row['r_o_ohm']:.4f} "
        f"ohm{sd_r_o}  drawn {row['drawn_Ah']:.3f} Ah{health}  RMSE {1e3 * row['voltage_rmse_V']:3.0f} mV  "
        f"{'settled' if row['settled'] else 'not settled: ' + row['reason']}",
        flush=True,
    )


def _plain(value: Any) -> Any:
    """JSON has no NaN and no infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main())
