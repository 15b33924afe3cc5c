"""
Many discharges: each is read, calibrated and written for itself, on one core or many, and none that fails stops the others.
The same command goes on from the rows that are written.
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
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.report import METHOD_NAMES, Calibration, title_of
from battery_env.lab.settings import Settings
from battery_env.lab.sources import (
    LIFE,
    RUN,
    TABLE,
    VOLTAGE,
    Source,
    few_of,
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

#: Of the package.
VERSION = resources.files("battery_env").joinpath("version.txt").read_text(encoding="utf-8").strip()

_FORMAT = "battery_env.run"
# Discharges that could not be used have no values there.
_SETTLED = ("settled", "settled_q_mobile", "settled_resistance_10s", "settled_r_o")
_TYPES = {"cycle": "Int64", **dict.fromkeys(_SETTLED, "boolean")}
# Warnings belong to the process: threads that catch them take turns.
_CATCHING = threading.RLock()

_Call = TypeVar("_Call")


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM, by which schedulers and services end a process, do what Ctrl-C does."""
    is_main = threading.current_thread() is threading.main_thread()  # no other may
    before = signal.signal(signal.SIGTERM, signal.default_int_handler) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, before)


class Processes(ThreadPoolExecutor):
    """
    Makes calls in processes of this machine, one for each thread, which end with this one. A call whose process is lost is
    made once more in a process of its own, so that it alone can be the reason. A single pool would end all calls under way.
    """

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self._free: list[ProcessPoolExecutor] = []
        self._others = set(multiprocessing.active_children())
        self._ends = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make a call as soon as a process is free."""
        return super().submit(self._make, partial(fn, *args, **kwargs))

    def _make(self, call: Callable[[], Any]) -> Any:
        future = self._done_by_a_process(call)
        if isinstance(future.exception(), BrokenExecutor) and not self._ends:
            future = self._done_by_a_process(call)
        return future.result()

    def _done_by_a_process(self, call: Callable[[], Any]) -> Future[Any]:
        try:
            one = self._free.pop()
        except IndexError:  # spawn: torch does not survive a fork with threads
            one = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_end_with_parent)
        future = one.submit(call)
        if not isinstance(future.exception(), BrokenExecutor):
            self._free.append(one)
        return future

    def __exit__(self, *error: Any) -> None:
        """What has not begun is not begun any more, and after an error what has begun is not waited for."""
        if error[0] is not None:
            self._ends = True
            for process in set(multiprocessing.active_children()) - self._others:
                process.terminate()
        self.shutdown(cancel_futures=True)
        for free in self._free:
            free.shutdown()


def _end_with_parent() -> None:
    """Leave Ctrl-C to the process that started this one, and end when that is gone, however that went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def workers(jobs: int, scheduler: str | None = None) -> Iterator[Executor]:
    """What makes calls side by side: so many processes of this machine (-1: one a core), or the workers of a Dask cluster."""
    if scheduler is None:
        with Processes(jobs if jobs > 0 else os.cpu_count() or 1) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError("--scheduler needs Dask: pip install './battery_env[cluster]'") from error
    try:
        # one that is there answers within milliseconds
        client = Client(scheduler, timeout=5, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"no Dask scheduler at {scheduler!r}: {error}") from error
    with client:
        yield client.get_executor(pure=False)


class Attempt(NamedTuple):
    """What became of a call: its result, ``None`` after an error, its warnings, and the error, empty if there is none."""

    result: Any
    notes: list[str]
    error: str


def attempt(function: Callable[..., Any], *arguments: Any) -> Attempt:
    """Make a call that stops no others, whatever becomes of it."""
    result, error = None, ""
    with _CATCHING, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")  # those for developers
        warnings.simplefilter("always", UserWarning)
        try:
            result = function(*arguments)
        except Exception as problem:
            error = _message(problem)
    return Attempt(result, [str(each.message) for each in caught], error)


def _message(error: Exception) -> str:
    text = str(error).strip()
    expected = (ValueError, TypeError, OSError, ImportError)
    return text if isinstance(error, expected) and text else f"{type(error).__name__}: {text}"


def _in_order(
    function: Callable[..., Any], calls: Iterable[tuple[_Call, tuple[Any, ...]]], executor: Executor | None, ahead: int
) -> Iterator[tuple[_Call, Attempt]]:
    """What became of calls of a function, in their order, each when at most so many others are under way."""
    if executor is None:
        for call, arguments in calls:
            yield call, attempt(function, *arguments)
        return
    waiting: deque[tuple[_Call, Future[Attempt]]] = deque()
    for call, arguments in calls:
        waiting.append((call, executor.submit(attempt, function, *arguments)))
        while waiting and (len(waiting) > ahead or waiting[0][1].done()):
            yield _awaited(*waiting.popleft())
    yield from (_awaited(*each) for each in waiting)


def _awaited(call: _Call, future: Future[Attempt]) -> tuple[_Call, Attempt]:
    try:
        return call, future.result()
    except Exception as error:  # the worker's
        return call, Attempt(None, [], _message(error))


@dataclass(frozen=True)
class Outcome:
    """
    What became of one discharge, or of a source that could not be read.

    :param record: what it is called in results
    :param source: file or bundled cell
    :param cell: that of the source
    :param cycle: number of the discharge; ``None`` if it has none
    :param start_time: date and time at which it begins; empty if it has none
    :param found: what it says; ``None`` if it could not be used
    :param notes: warnings
    :param error: why it could not be used, empty otherwise
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
        """What became of it, in words."""
        return "refused" if self.found is None else "settled" if self.found.settled else "not settled"

    def row(self) -> dict[str, Any]:
        """The columns of the table by name; no text is taken for a formula."""
        told = {name: getattr(self, name) for name in ("record", "source", "cell", "cycle", "start_time")}
        row = told | (self.found.row() if self.found else {}) | {"notes": self.notes, "error": " ".join(self.error.split())}
        return {name: no_formula(printable(value)) if isinstance(value, str) else value for name, value in row.items()}

    @classmethod
    def of_row(cls, row: Mapping[str, Any], settings: Settings) -> Outcome:
        """The same, of a discharge that could be used."""
        own = {field.name for field in fields(cls)}
        columns = {name: value for name, value in row.items() if name not in own - {"cycle"} | {"reason"}}
        columns["findings"] = findings_of(row["findings"])
        return cls(found=Calibration(settings, **columns), **{name: row[name] for name in own & row.keys()})


class Results:
    """
    The files in a folder that the results of one run are written to. A row is appended as each discharge is done, and whatever
    ends the command, the same one goes on from there: one with the same arguments, settings and version. Rows of files that
    are not there at the moment stay. What is there of another run, or of somebody else, is refused; of another run it may be
    replaced.
    """

    def __init__(
        self, folder: Path, sources: Sequence[Source], settings: Settings, file_format: FileFormat, with_voltages: bool = True
    ) -> None:
        self.folder, self.with_voltages, self._settings = folder, with_voltages, settings
        self.run = folder / RUN
        self._stems = [record_name(source.stem, source.cycle) for source in sources]
        self._sources = {source.key: source for source in sources}
        self._stamps: dict[str, list[Any] | None] = {}  # of files of which rows are there
        read = sorted({key_of(source.given) for source in sources})
        made_with = {**asdict(settings), **asdict(file_format), "sources": read, "voltages": with_voltages}
        self._header: dict[str, Any] = json.loads(_json({"format": _FORMAT, "battery_env": VERSION, **made_with}))
        self._rows: dict[tuple[str, int], dict[str, Any]] = {}
        self._counts: dict[str, int] = {}
        #: The files that are written, by name.
        self.written: list[str] = []
        #: How many lines are not as they were written.
        self.spoiled = 0
        check_folder(folder)

    @contextmanager
    def opened(self, replace: bool) -> Iterator[Results]:
        """Hold the folder against other commands, read what of the run is done, and refuse what may not be replaced."""
        with locked(self.run):
            header, lines = self._read()
            goes_on = header == self._header and not replace
            if not (goes_on or replace):
                self._refuse_another(header, lines)
            in_the_way = [] if replace else self._in_the_way(goes_on)
            if in_the_way:
                raise FileExistsError(f"{few_of(in_the_way)} would be replaced; choose another --out, or give --force")
            kept = [line for line in lines if self._takes(line)] if goes_on else []
            # Only what is whole: a power cut may have left a part of the last line
            with replacing(self.run) as part:
                part.write_text("".join(f"{_json(line)}\n" for line in (self._header, *kept)), encoding="ascii")
            with self.run.open("ab") as self._stream:
                yield self

    def _read(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """What the run in the folder was made with, and its lines; nothing if there is none."""
        if not self.run.exists():
            return {}, []
        texts = self.run.read_bytes().splitlines() if self.run.is_file() else []  # to read a pipe is to wait for it
        header = _line(texts[0]) if texts else {}
        if header.get("format") != _FORMAT:
            raise FileExistsError(f"{self.run} is no run of battery-calibrate: choose another --out, or move it elsewhere")
        lines = [line for line in map(_line, texts[1:]) if line.get("checksum") == _checksum(line)]
        self.spoiled = len(texts) - 1 - len(lines)
        return header, lines

    def _refuse_another(self, header: dict[str, Any], lines: list[dict[str, Any]]) -> None:
        """Refuse to begin where another run has something to lose: a discharge that could be used."""
        if not self.spoiled and all(line["row"]["error"] for line in lines):
            return
        different = {name for name in header | self._header if header.get(name) != self._header.get(name)}
        other = "battery_env" if "battery_env" in different else ", ".join(sorted(different - {"sources"}))
        reads = f" that reads {few_of(header.get('sources', []))}" if "sources" in header.keys() & different else ""
        raise FileExistsError(
            f"{self.run} is of a command{reads}{' with another ' if other else ''}{other}; choose another --out, or give "
            "--force, which begins anew"
        )

    def _takes(self, line: dict[str, Any]) -> bool:
        """Whether a line holds: of a file that is as it was, or not there."""
        if not line["whole"] or self._stamp_of(line["source"]) not in (None, line["stamp"]):
            return False
        self._rows[line["source"], line["number"]] = line["row"]
        self._counts[line["source"]] = line["of"]
        return True

    def _stamp_of(self, key: str) -> list[Any] | None:
        """That of a source that rows are of; ``None`` if it is not there."""
        if key not in self._stamps:
            self._stamps[key] = _stamp(self._sources[key]) if key in self._sources else None
        return self._stamps[key]

    def _in_the_way(self, goes_on: bool) -> list[str]:
        """What has the name of a result: of a run that goes on only records, as all else is its own."""
        # the numbers of the discharges are not known before their files are read
        stems = "|".join(map(re.escape, self._stems))
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*{VOLTAGE}\.(?:csv|png)", flags=re.IGNORECASE)
        named = [path for path in sorted(self.folder.iterdir()) if self.with_voltages and voltages.fullmatch(path.name)]
        if goes_on:
            return [str(path) for path in named if path.suffix.lower() == ".csv" and not is_result(path)]
        return [str(path) for path in (self.folder / TABLE, self.folder / LIFE, *named) if path.exists()]

    @property
    def done(self) -> list[Outcome]:
        """What became of the discharges that are done, in the order of the sources."""
        return [Outcome.of_row(row, self._settings) for row in self._sorted_rows()]

    @property
    def absent(self) -> int:
        """How many of these are of files that are not there."""
        return sum(self._stamp_of(key) is None for key, _ in self._rows)

    def holds(self, source: Source, number: int | None = None) -> bool:
        """Whether a discharge of a source is done; without its number, whether all are."""
        numbers = range(self._counts.get(source.key, 0)) if number is None else (number,)
        return len(numbers) > 0 and all((source.key, each) in self._rows for each in numbers)

    def keep(self, outcome: Outcome, place: _Place, whole: bool = True) -> None:
        """Append a row, which is on the disk when this returns; one that is not whole is made again by the same command."""
        key, number, row = place.source.key, place.number, outcome.row()
        if not (outcome.error and (key, number) in self._rows):  # the file is gone since
            self._rows[key, number] = row
        is_whole = whole and not outcome.error
        line = {"source": key, "stamp": place.stamp, "number": number, "of": place.of, "whole": is_whole, "row": row}
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
        with replacing(self.folder / name) as part:
            make(part)
        self.written.append(name)

    def write_tables(self) -> None:
        """Write the table of all rows, if any discharge could be used, and if several are whole a figure of them."""
        if not self.has_numbers:
            return
        table = with_codes(pd.DataFrame(self._sorted_rows())).astype(_TYPES)
        self.write(TABLE, partial(table.to_csv, index=False))
        whole = table[table["measured_eod_time_s"].notna()]
        if len(whole) > 1:
            try:
                self.write(LIFE, partial(_draw_life, whole))
            except Exception as error:  # whatever it is, the numbers are written
                warnings.warn(f"{LIFE} is not written: {type(error).__name__}: {error}", stacklevel=2)

    @property
    def has_numbers(self) -> bool:
        """Whether any discharge could be used."""
        return any(not row["error"] for row in self._rows.values())


def with_codes(table: pd.DataFrame) -> pd.DataFrame:
    """A table of rows with the codes of findings alone, as files have it."""
    of_row = table["findings"]
    return table.assign(findings=[codes_of(findings_of(each)) if isinstance(each, list) else "" for each in of_row])


def _by_date(keys: Sequence[str], starts: Mapping[str, str]) -> list[str]:
    """Files in their order, but in each folder by the dates at which they start, where each that was read has one."""
    folder = {key: os.path.dirname(key) for key in (*keys, *starts)}
    rank = {name: number for number, name in enumerate(dict.fromkeys(folder.values()))}
    undated = {folder[key] for key, start in starts.items() if not start}
    return sorted(keys, key=lambda key: (rank[folder[key]], "" if folder[key] in undated else starts.get(key, "")))


def _draw_life(whole: pd.DataFrame, path: Path) -> None:
    from battery_env.plotting import plot_life  # here, as matplotlib takes long to import

    plot_life(whole).savefig(path, dpi="figure")


def _stamp(source: Source) -> list[Any] | None:
    """What changes with the content of a file, or with what its results are called; ``None`` if it cannot be read."""
    if is_bundled(source.path):
        return [source.stem, source.cell]
    digest = hashlib.sha256()
    try:
        if not Path(source.path).is_file():  # to open a pipe is to wait for it
            return None
        with open(source.path, "rb") as stream:
            while part := stream.read(1 << 20):
                digest.update(part)
    except OSError:
        return None
    return [source.stem, source.cell, digest.hexdigest()]


def _checksum(line: Mapping[str, Any]) -> str:
    """Of all that a line holds beside its checksum."""
    return hashlib.sha256(_json({name: value for name, value in line.items() if name != "checksum"}).encode()).hexdigest()[:16]


def _json(content: Any) -> str:
    """On one line, in ASCII, with numbers that come back to the bit."""
    return json.dumps(content, default=lambda value: value.item() if isinstance(value, np.generic) else str(value))


def _line(text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


class _Place(NamedTuple):
    """So many-th discharge of how many of a source, and what is known of it before it is calibrated."""

    known: Outcome
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

    :param sources: what to read
    :param file_format: how
    :param settings: of the calibration
    :param results: files to write, opened; what is done there is not done again. ``None``: none
    :param executor: what reads and calibrates, any of ``concurrent.futures`` or of Dask; ``None``: one after the other here
    :param ahead: so many calls are under way at most beyond the one that is waited for, as each holds its data
    :return: in the order of the sources, but first what is done
    """
    with_voltages = results is not None and results.with_voltages
    done = results.done if results else []
    yield from done
    used = {each.record.casefold() for each in done}
    to_read = [source for source in sources if not (results and results.holds(source))]

    def calls() -> Iterator[tuple[_Place, tuple[Any, ...]]]:
        starts: dict[str, str] = {}  # the latest in each folder
        for source, read in _in_order(_read, ((source, (source, file_format)) for source in to_read), executor, ahead):
            start, folder = _start_of(read), os.path.dirname(source.key)
            latest = starts.setdefault(folder, start)
            if folder and start and start < latest:
                read.notes.append(
                    f"starts on {start:.10}, and a file before it on {latest:.10}: records are printed by their names"
                )
            starts[folder] = max(latest, start)
            for place, recording in _places(source, read, used):
                if recording is None or not (results and results.holds(source, place.number)):
                    yield place, (place.known.record, recording, settings, with_voltages)

    for place, made in _in_order(_calibrate, calls(), executor, ahead):
        outcome, whole = (place.known, False) if place.known.error else _outcome(place.known, made, results)
        if results is not None:
            results.keep(outcome, place, whole)
        yield outcome


def _read(source: Source, file_format: FileFormat) -> tuple[list[Any] | None, list[Recording]]:
    """The stamp of a source, of before it is read, and its discharges."""
    return _stamp(source), read_source(source, file_format)


def _start_of(read: Attempt) -> str:
    """Date and time at which what was read starts; empty if it does not tell."""
    return str(read.result[1][0].meta.get("start_time", "")) if read.result else ""


def _places(source: Source, read: Attempt, used: set[str]) -> Iterator[tuple[_Place, Recording | None]]:
    """The discharges of a source, each with what was recorded; or the error of the source, without."""
    if read.error:
        error = read.error if printable(source.path) in read.error else f"{source.path}: {read.error}"
        name = _unused(record_name(source.stem, source.cycle), used)
        known = Outcome(name, source.path, source.cell, source.cycle, notes="; ".join(read.notes), error=error)
        yield _Place(known, source, 0, 1, None), None
        return
    stamp, recordings = read.result
    for number, recording in enumerate(recordings):
        cycle = recording.meta.get("cycle")
        name = _unused(record_name(source.stem, cycle), used)
        start = str(recording.meta.get("start_time", ""))
        known = Outcome(name, source.path, source.cell, cycle, start, notes="; ".join(read.notes))
        yield _Place(known, source, number, len(recordings), stamp), recording


def _unused(name: str, used: set[str]) -> str:
    """The name, with a number behind it if another record has it; some file systems take a letter and its capital for one."""
    number, unused = 1, name
    while unused.casefold() in used:
        number += 1
        unused = f"{name}_{number}"
    used.add(unused.casefold())
    return unused


def calibrate_recording(discharge: Discharge, recording: Recording, settings: Settings) -> Calibration:
    """What a discharge of a file says; an error shows the commands that may mend the file."""
    try:
        return calibrate(discharge, settings)
    except RecordError as error:
        raise error.of(recording.origin) from error


def _calibrate(
    name: str, recording: Recording | None, settings: Settings, with_voltages: bool
) -> tuple[Calibration, Attempt] | None:
    """What the discharge says, and its voltages as files by their suffixes; ``None`` of a source that could not be read."""
    if recording is None:
        return None
    found = calibrate_recording(recording.discharge(), recording, settings)
    files = attempt(_voltages_of, name, found) if with_voltages else Attempt({}, [], "")
    return replace(found, record=None, forecast=None, end=None), files


def _outcome(known: Outcome, made: Attempt, results: Results | None) -> tuple[Outcome, bool]:
    """What became of a discharge, and whether all that belongs to it is written."""
    if made.error:
        return replace(known, error=f"{known.record}: {made.error}"), False
    found, (files, _, lost) = made.result
    for suffix, content in (files or {}).items():
        assert results is not None
        write = partial(Path.write_bytes, data=content)
        lost = lost or attempt(results.write, f"{known.record}{VOLTAGE}.{suffix}", write).error
    notes = [known.notes, *made.notes, f"{VOLTAGE[1:]} is not written: {lost}" if lost else ""]
    return replace(known, found=found, notes="; ".join(filter(None, notes))), not lost


def _voltages_of(name: str, found: Calibration) -> dict[str, bytes]:
    """What one discharge showed, beside the model, as CSV and as PNG."""
    from battery_env.plotting import literal, plot_discharge, titles_of  # here, as matplotlib takes long to import

    record, forecast = found.record, found.forecast
    assert record is not None and forecast is not None
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    table = pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False).encode()
    picture = io.BytesIO()
    models = {f"model, {METHOD_NAMES[found.method]}": forecast}
    figure = plot_discharge(record, models, title_of(literal(name), found))
    figure.savefig(picture, dpi="figure", metadata=titles_of(figure))
    return {"csv": table, "png": picture.getvalue()}
