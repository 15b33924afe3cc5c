"""
Many discharges, on one core or many: each is read, calibrated and written by itself, so that a failure stops no other. The
same command continues after the last row that is on the disk.
"""

from __future__ import annotations

import hashlib
import io
import json
import multiprocessing
import os
import re
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from battery_env.estimates.findings import codes_of, findings_of
from battery_env.files import check_folder, locked, replacing
from battery_env.lab.calibrate import calibrate
from battery_env.lab.readers.columns import FileFormat, few_of
from battery_env.lab.report import METHOD_NAMES, Calibration, title_of
from battery_env.lab.settings import Settings
from battery_env.lab.sources import (
    LIFE,
    RUN,
    TABLE,
    VOLTAGE,
    Source,
    find_sources,
    is_bundled,
    is_result,
    key_of,
    no_formula,
    printable,
    read_source,
    record_name,
)
from battery_env.records.discharge import Discharge
from battery_env.records.recording import Recording
from battery_env.records.refusals import RecordError

__all__ = ["FileFormat", "Outcome", "Results", "Source", "calibrate_all", "find_sources", "read_source"]

#: Version of the package.
VERSION = resources.files("battery_env").joinpath("version.txt").read_text(encoding="utf-8").strip()

_FORMAT = "battery_env.run"
# These columns have no values for unusable discharges.
_SETTLED = ("settled", "settled_q_mobile", "settled_resistance_10s", "settled_r_o")
_TYPES = {"cycle": "Int64", **dict.fromkeys(_SETTLED, "boolean")}
# Python catches warnings for a whole process, so that threads take turns.
_CATCHING = threading.RLock()

_Key = TypeVar("_Key")


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM, which schedulers and services send to end a process, act like Ctrl-C."""
    is_main = threading.current_thread() is threading.main_thread()  # other threads may set no handler
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, previous)


class Processes(ThreadPoolExecutor):
    """
    Make calls in processes of this machine, one process for each thread. The processes end with this one. If a process dies,
    its call is made once more in a new process, and no other call is affected; a single pool would end all running calls.
    """

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self._free: list[ProcessPoolExecutor] = []
        self._others = set(multiprocessing.active_children())
        self._ends = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make a call as soon as a thread is free."""
        return super().submit(self._make, partial(fn, *args, **kwargs))

    def _make(self, call: Callable[[], Any]) -> Any:
        future = self._done_by_a_process(call)
        if isinstance(future.exception(), BrokenExecutor) and not self._ends:
            future = self._done_by_a_process(call)
        return future.result()

    def _done_by_a_process(self, call: Callable[[], Any]) -> Future[Any]:
        try:
            pool = self._free.pop()
        except IndexError:  # spawn: torch does not survive a fork with threads
            pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_end_with_parent)
        future = pool.submit(call)
        if not isinstance(future.exception(), BrokenExecutor):
            self._free.append(pool)
        return future

    def __exit__(self, *error: Any) -> None:
        """Cancel the waiting calls, and after an error end the running ones."""
        if error[0] is not None:
            self._ends = True
            for process in set(multiprocessing.active_children()) - self._others:
                process.terminate()
        self.shutdown(cancel_futures=True)
        for pool in self._free:
            pool.shutdown()


def _end_with_parent() -> None:
    """Leave Ctrl-C to the parent process, and end as soon as the parent has ended in any way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def workers(jobs: int, scheduler: str | None = None) -> Iterator[Executor]:
    """An executor: so many processes of this machine (-1: one for each core), or the workers of a Dask cluster."""
    if scheduler is None:
        with Processes(jobs if jobs > 0 else os.cpu_count() or 1) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError("--scheduler needs Dask: pip install './battery_env[cluster]'") from error
    try:
        # a running scheduler answers within milliseconds
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"no Dask scheduler at {scheduler!r}: {error}") from error
    with client:
        yield client.get_executor(pure=False)


class Attempt(NamedTuple):
    """The outcome of a call: its result (``None`` after an error), its warnings, and its error (empty without one)."""

    result: Any
    notes: list[str]
    error: str


def attempt(function: Callable[..., Any], *arguments: Any) -> Attempt:
    """Make a call, and return its warnings and its error as texts."""
    result, error = None, ""
    with _CATCHING, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")  # those for developers
        warnings.simplefilter("always", UserWarning)
        try:
            result = function(*arguments)
        except Exception as raised:
            error = _message(raised)
    return Attempt(result, [str(each.message) for each in caught], error)


def _message(error: Exception) -> str:
    text = str(error).strip()
    expected = (ValueError, TypeError, OSError, ImportError)
    return text if isinstance(error, expected) and text else f"{type(error).__name__}: {text}"


def _in_order(
    calls: Iterable[tuple[_Key, Callable[[], Any]]], executor: Executor | None, ahead: int
) -> Iterator[tuple[_Key, Attempt]]:
    """Make calls, at most ``ahead`` beyond the first unfinished one, and return their outcomes in order."""
    if executor is None:
        for key, call in calls:
            yield key, attempt(call)
        return
    waiting: deque[tuple[_Key, Future[Attempt]]] = deque()
    for key, call in calls:
        waiting.append((key, executor.submit(attempt, call)))
        while waiting and (len(waiting) > ahead or waiting[0][1].done()):
            yield _awaited(waiting.popleft())
    yield from map(_awaited, waiting)


def _awaited(submitted: tuple[_Key, Future[Attempt]]) -> tuple[_Key, Attempt]:
    key, future = submitted
    try:
        return key, future.result()
    except Exception as error:  # of the worker itself
        return key, Attempt(None, [], _message(error))


@dataclass(frozen=True)
class Outcome:
    """
    The outcome for one discharge, or for an unreadable source.

    :param record: name of the discharge in results
    :param source: file or bundled cell
    :param cell: name of the cell
    :param cycle: number of the discharge; ``None`` without a number
    :param start_time: date and time of the first sample; empty without a date
    :param found: the calibration; ``None`` for an unusable discharge
    :param notes: warnings
    :param error: why the discharge is unusable; empty otherwise
    """

    record: str
    source: str
    cell: str
    cycle: int | None
    start_time: str = ""
    found: Calibration | None = None
    notes: str = ""
    error: str = ""

    @property
    def state(self) -> str:
        """The outcome in words."""
        return "refused" if self.found is None else "settled" if self.found.settled else "not settled"

    def row(self) -> dict[str, Any]:
        """Return the columns of the table by name; workbooks take no text for a formula."""
        columns = {name: getattr(self, name) for name in ("record", "source", "cell", "cycle", "start_time")}
        row = columns | (self.found.row() if self.found else {}) | {"notes": self.notes, "error": " ".join(self.error.split())}
        return {name: no_formula(printable(value)) if isinstance(value, str) else value for name, value in row.items()}

    @classmethod
    def of_row(cls, row: Mapping[str, Any], settings: Settings) -> Outcome:
        """Return the outcome of a row of a usable discharge."""
        names = {field.name for field in fields(cls)}
        columns = {name: value for name, value in row.items() if name not in names - {"cycle"} | {"reason"}}
        columns["findings"] = findings_of(row["findings"])
        return cls(found=Calibration(settings, **columns), **{name: row[name] for name in names & row.keys()})


class Results:
    """
    The results of one run in a folder. Each discharge appends a row. After any end of the command, a command with the same
    arguments, settings and version continues from these rows. Rows of missing files stay. Results of another run, and files of
    another program, are refused; results of another run may be replaced.
    """

    def __init__(
        self, folder: Path, sources: Sequence[Source], settings: Settings, file_format: FileFormat, with_voltages: bool = True
    ) -> None:
        self.folder, self.with_voltages, self._settings = folder, with_voltages, settings
        self.run = folder / RUN
        self._stems = [record_name(source.stem, source.cycle) for source in sources]
        self._sources = {source.key: source for source in sources}
        self._stamps: dict[str, list[Any] | None] = {}  # of the files of all rows
        read_from = sorted({key_of(source.given) for source in sources})
        made_with = {**asdict(settings), **asdict(file_format), "sources": read_from, "voltages": with_voltages}
        self._header: dict[str, Any] = json.loads(_json({"format": _FORMAT, "battery_env": VERSION, **made_with}))
        self._rows: dict[tuple[str, int], dict[str, Any]] = {}
        self._counts: dict[str, int] = {}
        #: Names of the files written by this run.
        self.written: list[str] = []
        #: Number of lines whose checksum is wrong.
        self.damaged = 0
        check_folder(folder)

    @contextmanager
    def opened(self, replace: bool) -> Iterator[Results]:
        """Lock the folder, read the rows of this run, and refuse to replace other files."""
        with locked(self.run):
            header, lines = self._read()
            resumes = header == self._header and not replace
            if not (resumes or replace):
                self._refuse_another(header, lines)
            obstacles = [] if replace else self._obstacles(resumes)
            if obstacles:
                raise FileExistsError(f"{few_of(obstacles)} would be replaced; choose another --out, or give --force")
            valid = [line for line in lines if self._takes(line)] if resumes else []
            # complete lines only: a power cut may have left a part of the last line
            with replacing(self.run) as file:
                file.write_text("".join(f"{_json(line)}\n" for line in (self._header, *valid)), encoding="ascii")
            with self.run.open("ab") as self._stream:
                yield self

    def _read(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Return the header of the run in the folder, and its lines; both are empty without a run."""
        if not self.run.exists():
            return {}, []
        texts = self.run.read_bytes().splitlines() if self.run.is_file() else []  # reading a pipe would block
        header = _line(texts[0]) if texts else {}
        if header.get("format") != _FORMAT:
            raise FileExistsError(f"{self.run} is no run of battery-calibrate: choose another --out, or move it elsewhere")
        lines = [line for line in map(_line, texts[1:]) if line.get("checksum") == _checksum(line)]
        self.damaged = len(texts) - 1 - len(lines)
        return header, lines

    def _refuse_another(self, header: dict[str, Any], lines: list[dict[str, Any]]) -> None:
        """Refuse to overwrite another run that has a usable discharge."""
        if not self.damaged and all(line["row"]["error"] for line in lines):
            return
        different = {name for name in header | self._header if header.get(name) != self._header.get(name)}
        options = "battery_env" if "battery_env" in different else ", ".join(sorted(different - {"sources"}))
        sources = f" that reads {few_of(header.get('sources', []))}" if "sources" in header.keys() & different else ""
        raise FileExistsError(
            f"{self.run} is of a command{sources}{' with another ' if options else ''}{options}; choose another --out, or "
            "give --force, which begins anew"
        )

    def _takes(self, line: dict[str, Any]) -> bool:
        """Take over a line if its file is unchanged or missing, and return whether it is taken over."""
        if not line["whole"] or self._stamp_of(line["source"]) not in (None, line["stamp"]):
            return False
        self._rows[line["source"], line["number"]] = line["row"]
        self._counts[line["source"]] = line["of"]
        return True

    def _stamp_of(self, key: str) -> list[Any] | None:
        """Return the stamp of the source of a row; ``None`` for a missing source."""
        if key not in self._stamps:
            self._stamps[key] = _stamp(self._sources[key]) if key in self._sources else None
        return self._stamps[key]

    def _obstacles(self, resumes: bool) -> list[str]:
        """Return existing files with names of results; of a resumed run only records, as the other files are its own."""
        # the numbers of discharges are unknown before their files are read
        stems = "|".join(map(re.escape, self._stems))
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*{VOLTAGE}\.(?:csv|png)", flags=re.IGNORECASE)
        files = [path for path in sorted(self.folder.iterdir()) if self.with_voltages and voltages.fullmatch(path.name)]
        if resumes:
            return [str(path) for path in files if path.suffix.lower() == ".csv" and not is_result(path)]
        return [str(path) for path in (self.folder / TABLE, self.folder / LIFE, *files) if path.exists()]

    @property
    def done(self) -> list[Outcome]:
        """The outcomes of the rows, in the order of the sources."""
        return [Outcome.of_row(row, self._settings) for row in self._sorted_rows()]

    @property
    def absent(self) -> int:
        """The number of rows whose files are missing."""
        return sum(self._stamp_of(key) is None for key, _ in self._rows)

    def holds(self, source: Source, number: int | None = None) -> bool:
        """Return whether a discharge of a source has a row; without a number, whether all its discharges have."""
        numbers = range(self._counts.get(source.key, 0)) if number is None else (number,)
        return len(numbers) > 0 and all((source.key, each) in self._rows for each in numbers)

    def keep(self, outcome: Outcome, place: _Place, is_complete: bool = True) -> None:
        """Append a row and sync it to the disk; the same command repeats an incomplete one."""
        key, number, row = place.source.key, place.number, outcome.row()
        if not (outcome.error and (key, number) in self._rows):  # the file has disappeared since
            self._rows[key, number] = row
        is_final = is_complete and not outcome.error
        line = {"source": key, "stamp": place.stamp, "number": number, "of": place.of, "whole": is_final, "row": row}
        self._stream.write(f"{_json({**line, 'checksum': _checksum(line)})}\n".encode("ascii"))
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _sorted_rows(self) -> list[dict[str, Any]]:
        starts = {key: row["start_time"] for (key, number), row in self._rows.items() if number == 0 and not row["error"]}
        order = {key: number for number, key in enumerate(_by_date(list(self._sources), starts))}
        keys = sorted(self._rows, key=lambda key: (order.get(key[0], len(order)), *key))
        return [self._rows[key] for key in keys]

    def write(self, name: str, make: Callable[[Path], Any]) -> None:
        """Write a file of this run."""
        with replacing(self.folder / name) as file:
            make(file)
        self.written.append(name)

    def write_tables(self) -> None:
        """Write the table of all rows if any discharge is usable, and a figure if several reach the cut-off."""
        if not self.has_numbers:
            return
        table = with_codes(pd.DataFrame(self._sorted_rows())).astype(_TYPES)
        self.write(TABLE, partial(table.to_csv, index=False))
        complete = table[table["measured_eod_time_s"].notna()]
        if len(complete) > 1:
            try:
                self.write(LIFE, partial(_draw_life, complete))
            except Exception as error:  # a failed figure costs no numbers
                warnings.warn(f"{LIFE} is not written: {type(error).__name__}: {error}", stacklevel=2)

    @property
    def has_numbers(self) -> bool:
        """Whether any discharge is usable."""
        return any(not row["error"] for row in self._rows.values())


def with_codes(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of rows with the codes of the findings, as in files."""
    of_row = table["findings"]
    return table.assign(findings=[codes_of(findings_of(each)) if isinstance(each, list) else "" for each in of_row])


def _by_date(keys: Sequence[str], starts: Mapping[str, str]) -> list[str]:
    """Sort files by folder, and within a folder by date if all files that were read have dates."""
    folder = {key: os.path.dirname(key) for key in (*keys, *starts)}
    rank = {name: number for number, name in enumerate(dict.fromkeys(folder.values()))}
    undated = {folder[key] for key, start in starts.items() if not start}
    return sorted(keys, key=lambda key: (rank[folder[key]], "" if folder[key] in undated else starts.get(key, "")))


def _draw_life(table: pd.DataFrame, path: Path) -> None:
    from battery_env.plotting import plot_life  # here, as matplotlib takes long to import

    plot_life(table).savefig(path, dpi="figure")


def _stamp(source: Source) -> list[Any] | None:
    """Return a fingerprint of a file and of the names of its results; ``None`` for an unreadable file."""
    if is_bundled(source.path):
        return [source.stem, source.cell]
    digest = hashlib.sha256()
    try:
        if not Path(source.path).is_file():  # to open a pipe is to wait for it
            return None
        with open(source.path, "rb") as stream:
            while chunk := stream.read(1 << 20):
                digest.update(chunk)
    except OSError:
        return None
    return [source.stem, source.cell, digest.hexdigest()]


def _checksum(line: Mapping[str, Any]) -> str:
    """Return the checksum of all other values of a line."""
    return hashlib.sha256(_json({name: value for name, value in line.items() if name != "checksum"}).encode()).hexdigest()[:16]


def _json(content: Any) -> str:
    """Encode on one line, in ASCII; numbers are read back exactly."""
    return json.dumps(content, default=lambda value: value.item() if isinstance(value, np.generic) else str(value))


def _line(text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


class _Place(NamedTuple):
    """The position of a discharge in its source, and its outcome as far as it is determined before the calibration."""

    outcome: Outcome
    source: Source
    number: int
    of: int
    stamp: list[Any] | None  # of the source before it was read


def calibrate_all(
    sources: Sequence[Source],
    file_format: FileFormat,
    settings: Settings,
    results: Results | None = None,
    executor: Executor | None = None,
    ahead: int = 64,
) -> Iterator[Outcome]:
    """
    Calibrate the model to the discharges of many files.

    :param sources: files and bundled cells
    :param file_format: how to read the files
    :param settings: how to calibrate
    :param results: opened results, whose discharges are not calibrated again; ``None``: write no files
    :param executor: executor of ``concurrent.futures`` or Dask; ``None``: calibrate one after the other in this process
    :param ahead: how many calls may be submitted beyond the first unfinished one, as each holds its data
    :return: the outcomes, first those of ``results``, then in the order of the sources
    """
    with_voltages = results is not None and results.with_voltages
    outcomes = results.done if results else []
    yield from outcomes
    used = {each.record.casefold() for each in outcomes}
    unread = [source for source in sources if not (results and results.holds(source))]
    reads = ((source, partial(_read, source, file_format)) for source in unread)

    def calls() -> Iterator[tuple[_Place, Callable[[], Any]]]:
        starts: dict[str, str] = {}  # the latest date in each folder
        for source, read in _in_order(reads, executor, ahead):
            start, folder = _start_of(read), os.path.dirname(source.key)
            latest = starts.setdefault(folder, start)
            if folder and start and start < latest:
                read.notes.append(
                    f"starts on {start:.10}, and a file before it on {latest:.10}: records are printed by their names"
                )
            starts[folder] = max(latest, start)
            for place, recording in _places(source, read, used):
                if recording is None or not (results and results.holds(source, place.number)):
                    yield place, partial(_calibrate, place.outcome.record, recording, settings, with_voltages)

    for place, attempted in _in_order(calls(), executor, ahead):
        outcome, is_complete = (place.outcome, False) if place.outcome.error else _outcome(place.outcome, attempted, results)
        if results is not None:
            results.keep(outcome, place, is_complete)
        yield outcome


def _read(source: Source, file_format: FileFormat) -> tuple[list[Any] | None, list[Recording]]:
    """Return the stamp of a source before reading, and its discharges."""
    return _stamp(source), read_source(source, file_format)


def _start_of(read: Attempt) -> str:
    """Return the date and time of the first sample of a source; empty without a date."""
    return str(read.result[1][0].meta.get("start_time", "")) if read.result else ""


def _places(source: Source, read: Attempt, used: set[str]) -> Iterator[tuple[_Place, Recording | None]]:
    """The discharges of a source with their recordings; or the error of an unreadable source, without a recording."""
    notes, error = "; ".join(read.notes), read.error
    if error and printable(source.path) not in error:
        error = f"{source.path}: {error}"
    stamp, recordings = read.result or (None, [None])
    for number, recording in enumerate(recordings):
        meta = recording.meta if recording else {"cycle": source.cycle}
        cycle, start_time = meta.get("cycle"), str(meta.get("start_time", ""))
        name = _unused(record_name(source.stem, cycle), used)
        outcome = Outcome(name, source.path, source.cell, cycle, start_time, notes=notes, error=error)
        yield _Place(outcome, source, number, len(recordings), stamp), recording


def _unused(name: str, used: set[str]) -> str:
    """Return the name, with a number if another record has it; some file systems ignore case."""
    number, unused = 1, name
    while unused.casefold() in used:
        number += 1
        unused = f"{name}_{number}"
    used.add(unused.casefold())
    return unused


def calibrate_recording(discharge: Discharge, recording: Recording, settings: Settings) -> Calibration:
    """Calibrate a discharge of a file; an error shows the commands that may mend the file."""
    try:
        return calibrate(discharge, settings)
    except RecordError as error:
        raise error.of(recording.origin) from error


def _calibrate(
    name: str, recording: Recording | None, settings: Settings, with_voltages: bool
) -> tuple[Calibration, Attempt] | None:
    """Calibrate a discharge, and make its voltages as files by suffix; ``None`` for an unreadable source."""
    if recording is None:
        return None
    calibration = calibrate_recording(recording.discharge(), recording, settings)
    files = attempt(_voltages_of, name, calibration) if with_voltages else Attempt({}, [], "")
    return replace(calibration, record=None, forecast=None, end=None), files


def _outcome(outcome: Outcome, attempted: Attempt, results: Results | None) -> tuple[Outcome, bool]:
    """Return the outcome of a discharge, and whether all its files are written."""
    if attempted.error:
        return replace(outcome, error=f"{outcome.record}: {attempted.error}"), False
    calibration, (files, _, unwritten) = attempted.result
    for suffix, content in (files or {}).items():
        assert results is not None
        write = partial(Path.write_bytes, data=content)
        unwritten = unwritten or attempt(results.write, f"{outcome.record}{VOLTAGE}.{suffix}", write).error
    notes = [outcome.notes, *attempted.notes, f"{VOLTAGE[1:]} is not written: {unwritten}" if unwritten else ""]
    return replace(outcome, found=calibration, notes="; ".join(filter(None, notes))), not unwritten


def _voltages_of(name: str, calibration: Calibration) -> dict[str, bytes]:
    """Return measured and modelled voltages as CSV and as PNG, by suffix."""
    from battery_env.plotting import literal, plot_discharge, titles_of  # here, as matplotlib takes long to import

    record, forecast = calibration.record, calibration.forecast
    assert record is not None and forecast is not None
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    table = pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False).encode()
    picture = io.BytesIO()
    models = {f"model, {METHOD_NAMES[calibration.method]}": forecast}
    figure = plot_discharge(record, models, title_of(literal(name), calibration))
    figure.savefig(picture, dpi="figure", metadata=titles_of(figure))
    return {"csv": table, "png": picture.getvalue()}
