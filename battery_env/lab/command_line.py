"""
The command line: calibrate discharges, forecast the end of one in progress, fit the constants of a cell, and show all of it
on a page.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from battery_env.compiled import announce_compilation
from battery_env.estimators.diagnosis.rest import InitialSoc
from battery_env.estimators.joint_fit import fit_cell
from battery_env.estimators.search import spread_over
from battery_env.files import check_new, finite_or_none, replacing
from battery_env.lab.batch import VERSION, Outcome, Results, calibrate_all, interruptible, workers
from battery_env.lab.page_server import serve
from battery_env.lab.readers.columns import FileFormat, few_of, recognise
from battery_env.lab.readers.tables import open_file
from battery_env.lab.readers.testers import find_tester, tester_file
from battery_env.lab.report import Calibration, change_of, line_of, text_of
from battery_env.lab.settings import METHODS, Settings, SettingsOptions
from battery_env.lab.sources import VOLTAGE, Source, find_sources, read_source
from battery_env.loads import constant
from battery_env.records import CUT_OFF_V
from battery_env.records.discharge import Discharge
from battery_env.records.refusals import Advice, Origin, RecordError
from battery_env.records.samples import check_cut_off

#: Exit statuses: all records settled, some refused, some not settled, interrupted, the reader of a pipe left.
SETTLED, REFUSED, NOT_SETTLED, INTERRUPTED, PIPE_CLOSED = 0, 2, 3, 130, 141

_NAME = "battery-calibrate"

_ASSIGNMENTS = re.compile(r",\s*(?=\w+=)")


class _Assignments(argparse.Action):
    """Options of the form quantity=NAME,quantity=NAME, which may be repeated, with one value for each quantity."""

    def __call__(self, _parser: Any, namespace: argparse.Namespace, text: Any, _option: str | None = None) -> None:
        values = dict(getattr(namespace, self.dest) or {})
        for name, equals, value in (assignment.partition("=") for assignment in _ASSIGNMENTS.split(text)):
            quantity, value = name.strip(), value.strip()
            if not (quantity and equals and value):
                raise argparse.ArgumentError(self, f"expected quantity=NAME,quantity=NAME, got {text!r}")
            if values.setdefault(quantity, value) != value:
                raise argparse.ArgumentError(
                    self, f"the {quantity} cannot be both {values[quantity]!r} and {value!r}: give one"
                )
        setattr(namespace, self.dest, values)


def _initial_soc(text: str) -> InitialSoc | Literal["rest"]:
    if text == "rest":
        return "rest"
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"expected SOC, SOC,SD or rest, got {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def _drawn(text: str) -> tuple[list[float], list[float], str]:
    try:
        load = constant(float(text), "current")
    except ValueError:
        from battery_env.lab.running import read_load  # here, as matplotlib takes long to import

        load = read_load(text)
    return load.start_s.tolist(), load.value.tolist(), load.unit


# The start of the help.
_FIRST = """\
q_max (the charge that can move), resistance, health and the end of discharges, each from a full cell at rest.

other commands, each with --help:
{}

examples:
  battery-calibrate B0005:100                         a bundled discharge
  battery-calibrate lab/ --nominal 2.0 --out life     a folder: a table, a figure, health as a share of 2 Ah
  battery-calibrate forecast running.csv --life lab/  when it will be empty, with an interval
"""


def _parser() -> argparse.ArgumentParser:
    commands = "\n".join(f"  {_NAME} {name:<10}{what}" for name, (_, what) in _COMMANDS.items() if name != "calibrate")
    parser = argparse.ArgumentParser(
        prog=_NAME,
        usage=f"{_NAME} FILE [FILE ...] [options]\n       {_NAME} B0005:100, for example; --help has more",
        description=_FIRST.format(commands),
        epilog="Exit status: 0 if every discharge is settled, 3 if one is not, 2 if one cannot be used.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"battery_env {VERSION}")
    parser.add_argument("records", nargs="+", metavar="FILE", help=_FILE_HELP)
    _add_reading(parser)
    group = parser.add_argument_group("calibration")
    group.add_argument(
        "--method",
        choices=METHODS,
        help="of calibration: least squares, or the policy that comes with the package (default: least squares)",
    )
    _add_settings(group)
    group = parser.add_argument_group("results")
    group.add_argument(
        "--out", type=Path, metavar="DIR", help="write the table of estimates, the voltages and figures there, for one run"
    )
    group.add_argument("--table-only", action="store_true", help="write no voltages of single discharges")
    group.add_argument("--force", action="store_true", help="replace results that are there already")
    group.add_argument("--json", action="store_true", help="print one JSON object a discharge and line")
    group.add_argument("--jobs", type=int, default=1, metavar="N", help="processes; -1: one a core (default: %(default)s)")
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster, tcp://host:port, whose workers read and calibrate; they must see the files by the same names",
    )
    parser.add_argument(
        "--load",
        dest="drawn",
        type=_drawn,
        metavar="A|FILE.csv",
        help="the load of a file that holds no current: a number of A from its first row on, or time_s, from 0 at the first "
        "row, and current_A or power_W, each held until the next",
    )
    return parser


def _fit_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"{_NAME} fit",
        description="Fit the constants of the model to a few discharges of one cell, each from full charge to the cut-off, "
        "and save them for --cell of calibrate. Take three or more, of all ages and loads that they are to hold for.",
        epilog="Exit status: 0, 3 if the discharges may not have started full, are of one age or not of one cell, or 2 if one "
        "cannot be used or does not reach the cut-off, or the equations do not describe the cell.",
        allow_abbrev=False,
    )
    parser.add_argument("records", nargs="+", metavar="FILE", help=_FILE_HELP)
    _add_reading(parser)
    group = parser.add_argument_group("fit")
    group.add_argument(
        "--cut-off", type=float, default=CUT_OFF_V, metavar="V", help="where the discharge ends, V (default: %(default)s)"
    )
    group.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="NAME.json",
        help="write the fit there, and beside it a figure, NAME_fit.png; neither may exist",
    )
    return parser


def _forecast_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"{_NAME} forecast",
        description="Forecast the end of a discharge in progress, with an interval that holds nine of ten ends, from the life "
        "of its cell and the load to come.",
        epilog="Exit status: 0, 3 if something in the record contradicts the estimate, or 2 if something cannot be used.",
        allow_abbrev=False,
    )
    parser.add_argument("record", metavar="FILE", help=_FILE_HELP)
    _add_reading(parser)
    group = parser.add_argument_group("forecast")
    group.add_argument(
        "--life",
        nargs="+",
        default=(),
        metavar="FILE",
        help="discharges of the cell before this one, oldest first: files, folders of them, or a bundled cell. They say what "
        "q_mobile to expect. All are taken for one cell's; refused if the files themselves (.mat) name several",
    )
    group.add_argument(
        "--load",
        type=Path,
        metavar="FILE.csv",
        help="the load to come: time_s, from 0 at the last sample under load, and current_A or power_W, each held until the "
        "next (default: as so far)",
    )
    _add_settings(parser.add_argument_group("calibration"))
    group = parser.add_argument_group("results")
    group.add_argument("--out", type=Path, metavar="DIR", help="write a figure there, NAME_forecast.png; it may not exist")
    group.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


_FILE_HELP = (
    "text of any delimiter, .xlsx, Parquet, NASA's .mat, Neware's .nda and .ndax, BioLogic's .mpr; a folder of them, or "
    "of folders; FILE:CYCLE for one discharge of a life; or a bundled cell, B0005, and its discharge, B0005:12"
)


def _add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options of all commands that read files."""
    group = parser.add_argument_group("reading")
    group.add_argument(
        "--columns",
        action=_Assignments,
        metavar="time=NAME,...",
        help="names of the columns of time, voltage, current, temperature, ambient, cycle, step, state and cell, where their "
        "names do not tell",
    )
    group.add_argument(
        "--units",
        action=_Assignments,
        metavar="time=UNIT,...",
        help="their units, where the names do not tell: s, ms, min, h; V, mV; A, mA; degC, K",
    )
    group.add_argument(
        "--tester",
        type=find_tester,
        metavar="FILE.toml",
        help="how the tester writes its tables: a file that the command columns begins, or the name of one that is known "
        "(default: told from the names)",
    )
    group.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="COLUMN",
        help="a column that is not looked at; may be given several times",
    )
    sign = group.add_mutually_exclusive_group()
    sign.add_argument(
        "--discharge-is-negative",
        action="store_true",
        default=None,
        help="the files count discharge as negative (default: told from the voltage)",
    )
    sign.add_argument(
        "--discharge-is-positive", action="store_false", dest="discharge_is_negative", default=None, help="or as positive"
    )


# Options of the settings, with the names of their values: the setting, the type of a value, and the help.
_SETTINGS: Mapping[str, tuple[str, Callable[[str], Any], str]] = {
    "--cut-off V": ("cut_off_V", float, "voltage at which the discharge ends, V (default: 2.7, or that of the fit of --cell)"),
    "--prior MEAN SD": (
        "prior_q_mobile_C",
        float,
        "q_mobile as known from an earlier discharge, C; while a discharge is in progress the estimate rests on it",
    ),
    "--initial-soc SOC": (
        "initial_soc",
        _initial_soc,
        "state of charge when the load is switched on, after a rest: 0.8; with its standard deviation 0.8,0.02; or rest: told "
        "from the voltage of a minute or more at rest before the load (default: 1, a full cell)",
    ),
    "--mismatch V": (
        "mismatch_V",
        float,
        "error to expect of the model itself, V; 0 for simulated data (default: 0.05, or that of the fit of --cell)",
    ),
    "--cell FILE": (
        "cell",
        Path,
        "constants of the cell, as the command fit saves them, or CellParameters.to_json; or how cells of its kind age, as "
        "fit_life finds it and AgingPath.to_json saves it (default: those of a new 18650)",
    ),
    "--nominal AH": (
        "nominal_Ah",
        float,
        "nominal capacity, Ah, which the state of health refers to (default: what the cell of --cell gives at this load); it "
        "also tells what to expect of a cell in progress that is below 1 or above 4 Ah",
    ),
}


def _add_settings(group: Any) -> None:
    for form, (setting, read, text) in _SETTINGS.items():
        option, *values = form.split()
        count = len(values) if len(values) > 1 else None
        group.add_argument(option, dest=setting, type=read, nargs=count, metavar=tuple(values), help=text)


def calibrate(arguments: Sequence[str] | None = None) -> int:
    """
    The command ``battery-calibrate``, and the others by their names behind it. Errors are a line, an interruption another, and
    a closed pipe none; each has its exit status.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a console without some character shows an escape
            stream.reconfigure(errors="backslashreplace")
    name = words.pop(0) if words and words[0] in _COMMANDS else "calibrate"
    try:
        with interruptible():
            status = _COMMANDS[name][0](words)
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # closed by head or a pager
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still to be flushed
        return PIPE_CLOSED
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    return status


def _calibrate(arguments: Sequence[str]) -> int:
    """Calibrate discharges; the exit status is that of the least settled one."""
    if arguments and not Path(arguments[0]).exists() and (similar := get_close_matches(arguments[0], _COMMANDS, 1)):
        raise ValueError(f"no command and no file {arguments[0]!r}: did you mean {_NAME} {similar[0]}?")
    options = _parser().parse_args(arguments)
    settings = _settings(options)
    settings.calibrator()  # settings that it refuses are wrong for every file
    with _printing_warnings():
        sources = find_sources(options.records)
    file_format = _file_format(options)
    if options.out is None:
        return _calibrate_all(sources, settings, file_format, options, None)
    results = Results(options.out, sources, settings, file_format, not options.table_only)
    with results.opened(options.force):
        return _calibrate_all(sources, settings, file_format, options, results)


def _calibrate_all(
    sources: Sequence[Source],
    settings: Settings,
    file_format: FileFormat,
    options: argparse.Namespace,
    results: Results | None,
) -> int:
    states: Counter[str] = Counter()
    cells: Counter[str] = Counter()
    first_settled: Calibration | None = None
    last_settled: Calibration | None = None
    first: Outcome | None = None
    is_interrupted = False
    if results and results.damaged:
        problem = "lines are not as they were written, and are left out"
        print(f"warning: {results.run}: {results.damaged} {problem}", file=sys.stderr)
    if results and (count_done := len(results.done)):
        absent = f", {results.absent} of them of files that are not there now" if results.absent else ""
        print(f"going on: {count_done} discharges are done, as {results.run} says{absent}", file=sys.stderr, flush=True)
    try:
        is_serial = options.jobs == 1 and options.scheduler is None
        side_by_side = nullcontext() if is_serial else workers(options.jobs, options.scheduler)
        with side_by_side as executor, announce_compilation():
            most_waiting = 64 if options.scheduler or options.jobs < 1 else 2 * options.jobs
            for outcome in calibrate_all(sources, file_format, settings, results, executor, most_waiting):
                _report(outcome, options.json)
                if first is not None and not options.json:  # a single discharge is printed in full
                    for each in (first, outcome) if states.total() == 1 else (outcome,):
                        _print_line(each)
                first = first or outcome
                states[outcome.state] += 1
                cells[outcome.cell] += 1
                if outcome.found and outcome.found.settled:
                    first_settled, last_settled = first_settled or outcome.found, outcome.found
    except KeyboardInterrupt:
        print("interrupted: what is done is kept" + (", and the same command goes on" if results else ""), file=sys.stderr)
        is_interrupted = True
    finally:
        if results:
            with _printing_warnings():
                results.write_tables()
    if not options.json:
        if states.total() > 1:
            counts = ", ".join(f"{states[state]} {state}" for state in ("settled", "not settled", "refused"))
            print(f"\n{states.total()} discharges: {counts}")
            is_one_cell = len(cells) in (1, states.total())  # a cell, or one file for each discharge, as in life.png
            if is_one_cell and first_settled and last_settled and last_settled is not first_settled:
                change = change_of(first_settled, last_settled)
                print(f"{change}, {states['settled']} of {states.total()} settled")
        elif first and first.found:
            print(text_of(first.record, first.found))
        if results and results.has_numbers:
            print(f"\nwritten to {results.folder}: {few_of(sorted(results.written, key=lambda name: VOLTAGE in name))}")
    if is_interrupted:
        return INTERRUPTED
    return REFUSED if states["refused"] else NOT_SETTLED if states["not settled"] else SETTLED


def _report(outcome: Outcome, as_json: bool) -> None:
    if as_json:
        print(json.dumps({name: finite_or_none(value) for name, value in outcome.row().items()}), flush=True)
    if outcome.notes:
        print(f"warning: {outcome.record}: {outcome.notes}", file=sys.stderr)
    if outcome.error:
        print(f"error: {outcome.error}", file=sys.stderr, flush=True)


def _print_line(outcome: Outcome) -> None:
    if outcome.found:
        print(line_of(outcome.record, outcome.found), flush=True)


def _file_format(options: argparse.Namespace) -> FileFormat:
    load = getattr(options, "drawn", None)
    return FileFormat(options.columns, options.units, options.discharge_is_negative, options.ignore, options.tester, load)


def _settings(options: argparse.Namespace) -> Settings:
    """The settings that were stated; the default of a setting holds where its option is not given."""
    stated: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in vars(options).items()
        if name in SettingsOptions.__annotations__ and value is not None
    }
    with _printing_warnings(), _with_command(options):
        return Settings.for_file(stated.pop("cell", None), **stated)


@contextmanager
def _with_command(options: argparse.Namespace) -> Iterator[None]:
    """Let an error show the command that mends an option, for the first file of the command line."""
    try:
        yield
    except RecordError as error:
        raise error.of(Origin([*getattr(options, "records", ()), getattr(options, "record", "")][0])) from error


def _fit(arguments: Sequence[str]) -> int:
    """The command ``fit``; its exit status is 3 for a doubtful fit."""
    options = _fit_parser().parse_args(arguments)
    out: Path = options.out
    picture = out.with_name(f"{out.stem}_fit.png")
    if out.suffix != ".json":
        raise ValueError(f"the fit is written as JSON: --out {out.name}.json instead of {out.name}")
    check_new(out, picture)
    with _with_command(options):
        check_cut_off(options.cut_off)
    discharges = _discharges(options.records, _file_format(options))
    print(f"fitting {len(discharges)} discharges", file=sys.stderr, flush=True)
    with warnings.catch_warnings(), announce_compilation():
        warnings.simplefilter("ignore", UserWarning)  # the doubt is printed below
        fit = fit_cell(discharges, options.cut_off)
    print(fit.summary())
    if fit.doubt:
        print(f"warning: {fit.doubt}", file=sys.stderr)
    fit.to_json(out)

    from battery_env.plotting import plot_cell_fit, save_figure  # here, as matplotlib takes long to import

    # four discharges fit into a figure
    examples = [discharges[n] for n in spread_over(len(discharges), 4)]
    save_figure(plot_cell_fit(fit, examples), picture)
    print(f"\nwritten: {out}, {picture}")
    return NOT_SETTLED if fit.doubt else SETTLED


def _forecast(arguments: Sequence[str]) -> int:
    """The command ``forecast``; its exit status is 3 if the record contradicts the estimate."""
    options = _forecast_parser().parse_args(arguments)
    from battery_env.lab.running import end_of_record, figure_of  # here, as matplotlib takes long to import

    settings, file_format = _settings(options), _file_format(options)
    if options.life and settings.prior_q_mobile_C is not None:
        raise ValueError("--life and --prior say the same: give one of them")
    figure = figure_of(options.record, options.out) if options.out else None
    if figure:
        check_new(figure)
    with _printing_warnings(), announce_compilation():
        end = end_of_record(options.record, settings, file_format, options.life, options.load)
    print(json.dumps(end.row()) if options.json else end.text())
    if figure:
        end.draw(figure)
        if not options.json:
            print(f"\nwritten: {figure}")
    return NOT_SETTLED if end.contradicted else SETTLED


def _page(arguments: Sequence[str]) -> int:
    """The command ``page``: a page of this machine alone in a browser, until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog=f"{_NAME} page",
        description="Open a page in the browser: drop files, see q_max, resistance, health and the life, forecast the end.",
        epilog="Needs the extra page: pip install './battery_env[page]'. Nothing leaves this machine, or stays on its disk.",
        allow_abbrev=False,
    )
    parser.add_argument("--port", type=int, default=8501, metavar="N", help="of the page, or the next free one (%(default)s)")
    options = parser.parse_args(arguments)
    if find_spec("streamlit") is None or find_spec("plotly") is None:
        raise ImportError("the page needs Streamlit and Plotly: pip install './battery_env[page]'")
    serve(Path(__file__).with_name("page.py"), options.port)
    return SETTLED


def _columns(arguments: Sequence[str]) -> int:
    """The command ``columns``; its exit status is 3 if the table lacks what a record needs."""
    parser = argparse.ArgumentParser(
        prog=f"{_NAME} columns",
        description="Show the first lines of a table and what is recognised of it, and write a file to fill in: how its "
        "tester names its columns, for --tester of the other commands.",
        allow_abbrev=False,
    )
    parser.add_argument("record", type=Path, metavar="FILE", help="of a tester")
    parser.add_argument("--out", type=Path, default=Path("my_tester.toml"), metavar="FILE.toml", help="default: %(default)s")
    options = parser.parse_args(arguments)
    check_new(options.out)
    with _printing_warnings():
        table = open_file(options.record, FileFormat())
        columns = recognise(table.names, FileFormat(), table.rows)
    print("\n".join(columns.lines()))
    with replacing(options.out, new=True) as file:
        file.write_text(tester_file(columns.columns, table.names, table.rows), encoding="utf-8")
    task = "Fill in what is not found" if columns.missing else "Change what is wrong"
    command = Origin(str(options.record)).command(Advice(task, "tester", options.out))
    print(f"\nwritten: {options.out}. {task}, and calibrate: {command}")
    return NOT_SETTLED if columns.missing else SETTLED


# The commands, with their purposes.
_COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "calibrate": (_calibrate, "capacity and resistance of cells from their discharges"),
    "forecast": (_forecast, "the end of a discharge in progress"),
    "fit": (_fit, "the constants of a cell from a few of its discharges"),
    "columns": (_columns, "what is recognised of a table, and a file to fill in for a tester that is not known"),
    "page": (_page, "all of it as a page in the browser"),
}


@contextmanager
def _printing_warnings(name: str = "") -> Iterator[None]:
    """Print the warnings of the block."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")  # those for developers
        warnings.simplefilter("always", UserWarning)
        try:
            yield
        finally:
            for each in caught:
                print(f"warning: {name}{each.message}", file=sys.stderr)


def _discharges(records: Sequence[str], file_format: FileFormat) -> list[Discharge]:
    """Read the discharges of all arguments, each with the name of its file and its number."""
    discharges = []
    with _printing_warnings():
        sources = find_sources(records)
    for source in sources:
        with _printing_warnings(f"{source.argument}: "):
            try:
                recordings = read_source(source, file_format)
                if len(cells := {str(each.meta.get("cell")) for each in recordings}) > 1:
                    raise ValueError(f"these are discharges of {' and '.join(sorted(cells))}: give those of one cell")
                for number, recording in enumerate(recordings, start=1):
                    meta = {"cycle": number, **recording.meta, "cell": source.stem}
                    discharges.append(recording._replace(meta=meta).discharge())
            except Exception as error:  # readers of files raise what they like
                text = str(error)
                raise ValueError(text if source.path in text else f"{source.argument}: {text}") from error
    return discharges
