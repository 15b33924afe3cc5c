"""Many discharges: each is read, calibrated and written for itself, and none that fails stops the others."""

from __future__ import annotations

import io
import multiprocessing
import os
import re
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from battery_env.files import check_folder, replacing
from battery_env.lab.calibrate import METHOD_NAMES, Calibration, Settings, calibrate, title_of
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.readers.discharges import Recording, read_recordings
from battery_env.lab.readers.tables import BINARY_SUFFIXES, NUMBERED_SUFFIXES, PACKED_SUFFIXES, TEXT_SUFFIXES, is_readable
from battery_env.records.discharge import BUNDLED_CELLS, load_nasa_discharges

_NASA_SUFFIX = ".mat"
# A scheduler that is there answers within milliseconds.
_PATIENCE_S = 5
# What NASA's discharges have beside them, in the layout of the bundled ones, is a table of tests and no record.
_NO_RECORDS = ("cycles.csv",)
# Results that an earlier command wrote among the records: tables, and voltages, which have their figure beside them.
_TABLES, _VOLTAGE, _LIFE = ("estimate.csv", "estimate.parquet"), "_voltage", "life.png"
# So many files that are left out are named.
_MOST_NAMED = 10


class Source(NamedTuple):
    """
    Where discharges come from.

    :param path: a file, or the name of a bundled cell
    :param cycle: which discharge; ``None``: all of them
    :param stem: what names of results start with
    :param cell: which cell it is of
    """

    path: str
    cycle: int | None
    stem: str
    cell: str

    @property
    def argument(self) -> str:
        """As on the command line."""
        return self.path if self.cycle is None else f"{self.path}:{self.cycle}"


def find_sources(arguments: Iterable[str], cell_name: re.Pattern[str] | None = None) -> list[Source]:
    """
    What the arguments of a command line name. A cell is called as its file; as its folder, if folders are given and their
    records lie in several; or as the group that a pattern finds in the name of the file.
    """
    arguments = list(arguments)
    inside = {argument: _records(Path(argument)) for argument in arguments if Path(argument).is_dir()}
    folders = {file.parent.absolute() for files in inside.values() for file in files}
    sources = []
    for argument in arguments:
        if inside.get(argument):
            sources += [Source(str(file), None, *_names(file, folders)) for file in inside[argument]]
            continue
        name, colon, cycle = argument.rpartition(":")
        if not (colon and cycle.isdecimal()) or Path(argument).exists():
            name, cycle = argument, ""
        stem = name if name in BUNDLED_CELLS else _stem(Path(name))
        sources.append(Source(name, int(cycle) if cycle else None, stem, stem))
    if cell_name is None:
        return sources
    found = [cell_name.search(Path(source.path).name) for source in sources]
    return [source._replace(cell=match[1]) if match else source for source, match in zip(sources, found, strict=True)]


def _records(folder: Path) -> list[Path]:
    """
    The files in a folder, and in those in it, that may be records; their numbers count, so that 2 comes before 10. What is
    neither a record nor a result is named.
    """
    files = [
        path
        for path in sorted(folder.rglob("*"), key=_by_number)
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts) and not _is_result(path)
    ]
    records = [path for path in files if path.name not in _NO_RECORDS and is_readable(path, (_NASA_SUFFIX,))]
    other = [path.relative_to(folder).as_posix() for path in sorted({*files} - {*records}, key=_by_number)]
    if records and other:
        more = f" and {len(other) - _MOST_NAMED} more" if len(other) > _MOST_NAMED else ""
        warnings.warn(f"{folder}: {', '.join(other[:_MOST_NAMED])}{more} left out, by their names no records", stacklevel=3)
    return records


def _by_number(path: Path) -> tuple[list[list[str | int]], Path]:
    parts = [re.split("([0-9]+)", part) for part in path.parts]
    return [[int(each) if k % 2 else each for k, each in enumerate(part)] for part in parts], path


def _names(file: Path, folders: Collection[Path]) -> tuple[str, str]:
    """Stem and cell of a file that was found in one of some folders."""
    if len(folders) == 1:
        return _stem(file), _stem(file)
    common = Path(os.path.commonpath(folders))
    folder = file.parent.absolute()
    cell = folder.name if folder == common else folder.relative_to(common).as_posix()
    return f"{cell.replace('/', '_')}_{_stem(file)}", cell


def _is_result(path: Path) -> bool:
    names = (*_TABLES, _LIFE)
    is_table = path.name in names or path.name.endswith(tuple(f"_{name}" for name in names))
    pair = [path.with_suffix(suffix) for suffix in (".csv", ".png")]
    return is_table or (path.stem.endswith(_VOLTAGE) and path in pair and all(each.exists() for each in pair))


def _stem(path: Path) -> str:
    name = path.name
    for suffixes in (PACKED_SUFFIXES, (*TEXT_SUFFIXES, *NUMBERED_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX), (".bdf",)):
        for suffix in suffixes:
            if name.lower().endswith(suffix) and len(name) > len(suffix):
                name = name[: -len(suffix)]
                break
    return name


def read_source(source: Source, file_format: FileFormat) -> list[Recording]:
    """Read what a source names."""
    path, cycle = source.path, source.cycle
    if path in BUNDLED_CELLS and not Path(path).exists():
        columns = ("time_s", "voltage_V", "current_A", "temperature_C")
        recordings = [
            Recording({name: getattr(each, name) for name in columns}, each.meta) for each in load_nasa_discharges(path)
        ]
    elif Path(path).is_dir():
        endings = ", ".join((*TEXT_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX))
        raise ValueError(f"{path} holds no file whose name ends as that of a record ({endings}), nor do the folders in it")
    elif not Path(path).exists():
        raise FileNotFoundError(
            f"no file {source.argument!r}; the bundled cells are given as {BUNDLED_CELLS[0]}:1, {BUNDLED_CELLS[0]}:2, ..."
        )
    else:
        recordings = read_recordings(path, file_format)
    if cycle is None:
        return recordings
    chosen = [recording for recording in recordings if recording.meta.get("cycle") == cycle]
    if not chosen:
        known = sorted({recording.meta["cycle"] for recording in recordings if "cycle" in recording.meta})
        has = f"has discharges {path}:{known[0]} .. {path}:{known[-1]}" if known else "has one discharge, without a number"
        raise ValueError(f"{path} {has}, got {source.argument}")
    return chosen


class Results:
    """The files that results are written to, refused if they are there already and may not be replaced."""

    def __init__(self, folder: Path, sources: Sequence[Source], with_voltages: bool, replace: bool) -> None:
        self.folder, self.with_voltages = folder, with_voltages
        prefix = f"{record_name(sources[0].stem, sources[0].cycle)}_" if len(sources) == 1 else ""
        self.table, self.parquet = (folder / f"{prefix}{name}" for name in _TABLES)
        self.life = folder / f"{prefix}{_LIFE}"
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

    def write_table(self, outcomes: Sequence[Outcome]) -> list[Path]:
        """Write the table of all discharges and, if several are whole, the figure of their parameters over them."""
        table = pd.DataFrame([each.row() for each in outcomes]).astype({"cycle": "Int64"})
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
        whole = table[table["measured_eod_time_s"].notna()]
        if len(whole) > 1:
            from battery_env.plotting import plot_life, save_figure

            written.append(save_figure(plot_life(whole), self.life))
        return written


@dataclass(frozen=True)
class Outcome:
    """
    What became of one discharge, or of a source that could not be read.

    :param record: what it is called in results
    :param source: file or bundled cell
    :param cell: that of the source
    :param cycle: number of the discharge; ``None`` if it has none
    :param found: what it says; ``None`` if it could not be used
    :param notes: warnings
    :param error: why it could not be used, empty otherwise
    """

    record: str
    source: str
    cell: str
    cycle: int | None
    found: Calibration | None = None
    notes: str = ""
    error: str = ""

    def row(self) -> dict[str, Any]:
        """The columns of the table by name."""
        told = {"record": self.record, "source": self.source, "cell": self.cell, "cycle": self.cycle}
        return told | (self.found.row() if self.found else {}) | {"notes": self.notes, "error": self.error}


class InThisProcess(Executor):
    """Makes each call at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make a call."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """
    What makes calls side by side, in processes of this machine or on a Dask cluster. When the block is left, what has not
    begun is not begun any more.
    """
    if scheduler is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError("--scheduler needs Dask: pip install 'battery_env[cluster]'") from error
        try:
            client = Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(f"no Dask scheduler at {scheduler!r}: {error}") from error
        with client:
            yield client.get_executor(pure=False)
    elif jobs == 1:
        yield InThisProcess()
    else:
        # spawn: torch does not survive a fork with threads
        pool = ProcessPoolExecutor(None if jobs == -1 else jobs, mp_context=multiprocessing.get_context("spawn"))
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


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
    :param results: files to write; ``None``: none
    :param executor: what reads and calibrates, any of ``concurrent.futures`` or of Dask; ``None``: one after the other here
    :param ahead: so many calls are under way at most beyond the one that is waited for, as each holds its data
    :return: in the order of the sources
    """
    executor = executor or InThisProcess()
    read = _in_order(executor, ahead, read_source, ((source, file_format) for source in sources))
    with_voltages = results is not None and results.with_voltages
    calls = ((known, recording, settings, with_voltages) for known, recording in _recordings(read))
    for (known, *_), attempt in _in_order(executor, ahead, _calibrate, calls):
        if known.error:
            yield known
            continue
        error = attempt.error
        if results is not None and not error:
            error = _attempt(results.write_voltages, known.record, attempt.result[1]).error
        if error:
            yield replace(known, error=f"{known.record}: {error}")
        else:
            yield replace(known, found=attempt.result[0], notes="; ".join(filter(None, [known.notes, *attempt.notes])))


class _Attempt(NamedTuple):
    result: Any  # None if there is an error
    notes: list[str]
    error: str


def _attempt(function: Callable[..., Any], *arguments: Any) -> _Attempt:
    result, error = None, ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = function(*arguments)
        except Exception as problem:  # of whatever kind, it must not stop the others
            error = _message(problem)
    return _Attempt(result, [str(each.message) for each in caught], error)


def _in_order(
    executor: Executor, ahead: int, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], _Attempt]]:
    """Each call with what became of it, in their order."""
    started: deque[tuple[tuple[Any, ...], Future[_Attempt]]] = deque()
    for call in calls:
        started.append((call, executor.submit(_attempt, function, *call)))
        while started and (len(started) > ahead or started[0][1].done()):
            yield _finished(*started.popleft())
    while started:
        yield _finished(*started.popleft())


def _finished(call: tuple[Any, ...], future: Future[_Attempt]) -> tuple[tuple[Any, ...], _Attempt]:
    try:
        return call, future.result()
    except Exception as error:  # of the worker
        return call, _Attempt(None, [], _message(error))


def _recordings(read: Iterable[tuple[tuple[Any, ...], _Attempt]]) -> Iterator[tuple[Outcome, Recording | None]]:
    """What was read, with what is known of it before it is calibrated."""
    used: set[str] = set()
    for (source, _), (recordings, notes, error) in read:
        if error and source.path not in error:
            error = f"{source.path}: {error}"
        is_one = bool(error) or len({each.meta.get("cell") for each in recordings}) == 1
        for recording in [None] if error else recordings:
            cycle, stem, cell = source.cycle, source.stem, source.cell
            if recording is not None:
                cycle = recording.meta.get("cycle")
                if not is_one:  # a table of several cells names them
                    cell = recording.meta["cell"]
                    stem = "_".join((stem, *re.findall(r"[\w.-]+", cell)))
            name = _unused(record_name(stem, cycle), used)
            yield Outcome(name, source.path, cell, cycle, notes="; ".join(notes), error=error), recording


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
    known: Outcome, recording: Recording | None, settings: Settings, with_voltages: bool
) -> tuple[Calibration, dict[str, bytes]] | None:
    """What the discharge says, and its voltages as files; nothing of a source that could not be read."""
    if recording is None:
        return None
    found = calibrate(recording.discharge(), settings)
    files = _voltages(known.record, found) if with_voltages else {}
    return replace(found, record=None, forecast=None), files


def _voltages(name: str, found: Calibration) -> dict[str, bytes]:
    from battery_env.plotting import plot_discharge  # here, as matplotlib takes long to import

    record, forecast = found.record, found.forecast
    assert record is not None and forecast is not None
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    table = pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False)
    picture = io.BytesIO()
    shown = {f"model, {METHOD_NAMES[found.method]}": forecast}
    plot_discharge(record, shown, title_of(name, found), found.end_quantiles_s).savefig(picture, dpi="figure")
    return {"csv": table.encode(), "png": picture.getvalue()}
