"""Many discharges: each is read, calibrated and written for itself, and none that fails stops the others."""

from __future__ import annotations

import io
import os
import re
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from battery_env.cells import BUNDLED_CELLS, load_nasa_discharges
from battery_env.files import check_folder, replacing
from battery_env.parallel import Submit, cluster, processes
from battery_env.record_files import Recording, read_recordings
from battery_env.summary import Settings, Summary, summarize
from battery_env.tables import BINARY_SUFFIXES, PACKED_SUFFIXES, TEXT_SUFFIXES, is_readable

_NASA_SUFFIX = ".mat"
# Calls under way at the same time on a cluster, whose workers come and go.
_ON_A_CLUSTER = 64
# What NASA's discharges have beside them, in the layout of the bundled ones, is a table of tests and no record.
_NO_RECORDS = ("cycles.csv",)
# Results that an earlier command wrote among the records: tables, and voltages, which have their figure beside them.
_TABLES, _VOLTAGE = ("estimate.csv", "estimate.parquet"), "_voltage"


class Source(NamedTuple):
    """
    Where discharges come from.

    :param path: a file, or the name of a bundled cell
    :param cycle: which discharge; ``None``: all of them
    :param stem: what names of results start with
    """

    path: str
    cycle: int | None
    stem: str

    @property
    def argument(self) -> str:
        """As on the command line."""
        return self.path if self.cycle is None else f"{self.path}:{self.cycle}"


@dataclass(frozen=True)
class Reading:
    """
    How files are read, see :func:`battery_env.record_files.read_discharges`.

    :param columns: by quantity, the name of its column
    :param units: by quantity, its unit
    :param discharge_is_negative: how the file counts the current of a discharge; ``None``: told from the voltage
    """

    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None
    discharge_is_negative: bool | None = None


def find_sources(arguments: Iterable[str]) -> list[Source]:
    """What the arguments of a command line name."""
    sources = []
    for argument in arguments:
        path = Path(argument)
        if path.is_dir():
            files = sorted(entry for entry in path.iterdir() if _is_record(entry))
            sources += [Source(str(file), None, _stem(file)) for file in files] or [Source(argument, None, path.name)]
            continue
        name, colon, cycle = argument.rpartition(":")
        if colon and cycle.isdecimal() and not path.exists():
            stem = name if name in BUNDLED_CELLS else _stem(Path(name))
            sources.append(Source(name, int(cycle), stem))
        else:
            sources.append(Source(argument, None, argument if argument in BUNDLED_CELLS else _stem(path)))
    return sources


def _is_record(path: Path) -> bool:
    hidden = path.name.startswith(".") or path.name in _NO_RECORDS
    return path.is_file() and not hidden and not _is_result(path) and is_readable(path, (_NASA_SUFFIX,))


def _is_result(path: Path) -> bool:
    is_table = path.name in _TABLES or path.name.endswith(tuple(f"_{name}" for name in _TABLES))
    return is_table or (path.name.endswith(f"{_VOLTAGE}.csv") and path.with_suffix(".png").exists())


def _stem(path: Path) -> str:
    name = path.name
    for suffixes in (PACKED_SUFFIXES, (*TEXT_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX), (".bdf",)):
        for suffix in suffixes:
            if name.lower().endswith(suffix) and len(name) > len(suffix):
                name = name[: -len(suffix)]
                break
    return name


def read_source(source: Source, reading: Reading) -> list[Recording]:
    """Read what a source names."""
    path, cycle = source.path, source.cycle
    if path in BUNDLED_CELLS and not Path(path).exists():
        columns = ("time_s", "voltage_V", "current_A", "temperature_C")
        recordings = [
            Recording({name: getattr(each, name) for name in columns}, each.meta) for each in load_nasa_discharges(path)
        ]
    elif Path(path).is_dir():
        endings = ", ".join((*TEXT_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX))
        raise ValueError(f"{path} holds no file whose name ends as that of a record ({endings})")
    elif not Path(path).exists():
        raise FileNotFoundError(
            f"no file {source.argument!r}; the bundled cells are given as {BUNDLED_CELLS[0]}:1, {BUNDLED_CELLS[0]}:2, ..."
        )
    else:
        recordings = read_recordings(path, reading.columns, reading.units, reading.discharge_is_negative)
    if cycle is None:
        return recordings
    chosen = [recording for recording in recordings if recording.meta.get("cycle") == cycle]
    if not chosen:
        known = sorted({recording.meta["cycle"] for recording in recordings if "cycle" in recording.meta})
        has = f"has discharges {path}:{known[0]} .. {path}:{known[-1]}" if known else "has one discharge, without a number"
        raise ValueError(f"{path} {has}, got {source.argument}")
    return chosen


class Results:
    """
    The files that results are written to.

    :param folder: for all of them
    :param sources: what is calibrated
    :param with_voltages: whether the voltages of each discharge are written, as a table and a figure
    :param replace: whether files of an earlier run may be replaced
    :raises FileExistsError: if there are some, and may not
    """

    def __init__(self, folder: Path, sources: Sequence[Source], with_voltages: bool, replace: bool) -> None:
        self.folder, self.with_voltages = folder, with_voltages
        prefix = f"{record_name(sources[0].stem, sources[0].cycle)}_" if len(sources) == 1 else ""
        self.table, self.parquet = (folder / f"{prefix}{name}" for name in _TABLES)
        self.life = folder / f"{prefix}life.png"
        check_folder(folder)
        existing = self._existing(sources)
        if existing and not replace:
            more = f" and {len(existing) - 3} more" if len(existing) > 3 else ""
            shown = ", ".join(str(path) for path in existing[:3])
            raise FileExistsError(f"{shown}{more} would be replaced; choose another --out, or give --force")

    def _existing(self, sources: Sequence[Source]) -> list[Path]:
        if not self.folder.is_dir():
            return []
        # the numbers of the discharges are not known before their files are read
        stems = "|".join(re.escape(record_name(source.stem, source.cycle)) for source in sources)
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*{_VOLTAGE}\.(?:csv|png)", flags=re.IGNORECASE)
        tables = {path.name for path in (self.table, self.parquet, self.life)}
        return [
            path
            for path in sorted(self.folder.iterdir())
            if path.name in tables or (self.with_voltages and voltages.fullmatch(path.name))
        ]

    def write_voltages(self, name: str, files: Mapping[str, bytes]) -> None:
        """Write what one discharge showed, beside the model."""
        for suffix, content in files.items():
            with replacing(self.folder / f"{name}{_VOLTAGE}.{suffix}") as part:
                part.write_bytes(content)

    def write_table(self, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
        """Write the table of all discharges and, if there are several, the figure of their parameters over them."""
        table = pd.DataFrame(rows).astype({"cycle": "Int64"})
        table["settled"] = table["settled"].astype("boolean")
        with replacing(self.table) as part:
            table.to_csv(part, index=False)
        written = [self.table]
        try:
            with replacing(self.parquet) as part:
                table.to_parquet(part, engine="pyarrow", index=False)
            written.append(self.parquet)
        except ImportError:
            pass
        if (table["error"] == "").sum() > 1:
            from battery_env.plotting import plot_life, save_figure

            written.append(save_figure(plot_life(table[table["error"] == ""]), self.life))
        return written


def calibrate_all(
    sources: Sequence[Source],
    reading: Reading,
    settings: Settings,
    results: Results | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Calibrate the model to the discharges of many files, one after the other or side by side."""
    with ExitStack() as stack:
        each: _Each = _one_by_one
        if scheduler is not None:
            each = partial(_side_by_side, stack.enter_context(cluster(scheduler, ("battery_env",))), _ON_A_CLUSTER)
        elif jobs != -1 and jobs < 1:
            raise ValueError(f"jobs must be at least 1, or -1 for as many as there are cores, got {jobs!r}")
        elif jobs != 1:
            jobs = (os.cpu_count() or 1) if jobs == -1 else jobs
            each = partial(_side_by_side, stack.enter_context(processes(jobs)), 2 * jobs)
        read = each(read_source, ((source, reading) for source in sources))
        with_voltages = results is not None and results.with_voltages
        calls = ((known, recording, settings, with_voltages) for known, recording in _recordings(read))
        for (known, *_), (calibrated, notes, error) in each(_calibrate, calls):
            name = known["record"]
            if results is not None and calibrated is not None:
                error = _outcome(results.write_voltages, name, calibrated[1]).error
            if known["error"] or error:
                yield known | {"error": known["error"] or f"{name}: {error}"}
            else:
                told = {column: known[column] for column in ("record", "source", "cell", "cycle")}
                yield told | calibrated[0] | {"notes": "; ".join(filter(None, [known["notes"], *notes])), "error": ""}


class _Outcome(NamedTuple):
    result: Any  # None if there is an error
    notes: list[str]
    error: str


#: Calls a function with each of many arguments; in their order, the arguments and what became of them.
_Each = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[tuple[Any, ...], _Outcome]]]


def _outcome(function: Callable[..., Any], *arguments: Any) -> _Outcome:
    result, error = None, ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = function(*arguments)
        except Exception as problem:  # of whatever kind, it must not stop the others
            error = _message(problem)
    return _Outcome(result, [str(each.message) for each in caught], error)


def _one_by_one(function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[tuple[tuple[Any, ...], _Outcome]]:
    return ((call, _outcome(function, *call)) for call in calls)


def _side_by_side(
    submit: Submit, ahead: int, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], _Outcome]]:
    """As many calls ahead as keep all workers busy, and no more, as each holds its data."""
    started: deque[tuple[tuple[Any, ...], Future[_Outcome]]] = deque()
    for call in calls:
        started.append((call, submit(_outcome, function, *call)))
        while started and (len(started) > ahead or started[0][1].done()):
            yield _finished(*started.popleft())
    while started:
        yield _finished(*started.popleft())


def _finished(call: tuple[Any, ...], future: Future[_Outcome]) -> tuple[tuple[Any, ...], _Outcome]:
    try:
        return call, future.result()
    except Exception as error:  # of the worker
        return call, _Outcome(None, [], _message(error))


def _recordings(
    read: Iterable[tuple[tuple[Any, ...], _Outcome]],
) -> Iterator[tuple[dict[str, Any], Recording | None]]:
    """What was read, with what is known of it before it is calibrated: record, source, cell, cycle, notes, error."""
    used: set[str] = set()
    for (source, _), (recordings, notes, error) in read:
        if error and source.path not in error:
            error = f"{source.path}: {error}"
        for recording in [None] if error else recordings:
            cycle = source.cycle if recording is None else recording.meta.get("cycle")
            name = _unused(record_name(source.stem, cycle), used)
            known = {"record": name, "source": source.path, "cell": source.stem, "cycle": cycle}
            yield known | {"notes": "; ".join(notes), "error": error}, recording


def record_name(stem: str, cycle: int | None) -> str:
    """How one discharge is called in results."""
    return stem if cycle is None else f"{stem}_{cycle:03d}"


def _unused(name: str, used: set[str]) -> str:
    """The name, with a number behind it if another record has it; some file systems take a letter and its capital for one."""
    number, unused = 1, name
    while unused.casefold() in used:
        number += 1
        unused = f"{name}_{number}"
    used.add(unused.casefold())
    return unused


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    expected = (ValueError, TypeError, OSError, ImportError)
    return text if isinstance(error, expected) and text else f"{type(error).__name__}: {text}"


def _calibrate(
    known: Mapping[str, Any], recording: Recording | None, settings: Settings, with_voltages: bool
) -> tuple[dict[str, Any], dict[str, bytes]] | None:
    """What the discharge says, and its voltages as files; nothing of a source that could not be read."""
    if recording is None:
        return None
    summary = summarize(recording.discharge(), settings)
    return summary.row, _voltages(summary, _title(known["record"], summary.row)) if with_voltages else {}


def _voltages(summary: Summary, title: str) -> dict[str, bytes]:
    from battery_env.plotting import plot_discharge  # here, as matplotlib takes long to import

    record, forecast = summary.record, summary.forecast
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    table = pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False)
    picture = io.BytesIO()
    plot_discharge(record, {"model": forecast}, title).savefig(picture, dpi="figure")
    return {"csv": table.encode(), "png": picture.getvalue()}


def _title(name: str, row: Mapping[str, Any]) -> str:
    parts = []
    for symbol, value, sd, digits, unit in (
        ("$q^{max}$", row["q_mobile_C"], row["sd_q_mobile_C"], 0, "C"),
        ("$R_o$", row["r_o_ohm"], row["sd_r_o_ohm"], 4, "$\\Omega$"),
    ):
        spread = " (held)" if np.isnan(sd) else f" (sd {sd:.{digits}f})"
        # a policy states none
        parts.append(f"{symbol} {value:.{digits}f} {unit}" + ("" if row["method"] == "policy" else spread))
    state = "settled" if row["settled"] else "not settled"
    drawn = f"{row['drawn_Ah']:.3f} Ah drawn"
    return f"{name}: {state}\n" + ", ".join([*parts, drawn, f"RMSE {1e3 * row['voltage_rmse_V']:.0f} mV"])
