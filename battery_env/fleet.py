"""Many discharges: each is read, calibrated and written for itself, and none that fails stops the others."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from battery_env.cells import BUNDLED_CELLS, load_nasa_discharges
from battery_env.files import check_folder, replacing
from battery_env.record_files import Recording, read_recordings
from battery_env.summary import Settings, Summary, summarize
from battery_env.tables import BINARY_SUFFIXES, PACKED_SUFFIXES, TEXT_SUFFIXES, is_readable

_NASA_SUFFIX = ".mat"
# What NASA's discharges have beside them, in the layout of the bundled ones, is a table of tests and no record.
_NO_RECORDS = ("cycles.csv",)


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
    """
    What the arguments of a command line name.

    :param arguments: files; folders, for all files in them whose names end as those of records; ``FILE:CYCLE``; bundled cells
        and ``CELL:CYCLE``
    :return: as many sources or more; a file that does not exist is one too, and fails when it is read
    """
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
    return path.is_file() and not hidden and is_readable(path, (_NASA_SUFFIX,))


def _stem(path: Path) -> str:
    name = path.name
    for suffixes in (PACKED_SUFFIXES, (*TEXT_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX), (".bdf",)):
        for suffix in suffixes:
            if name.lower().endswith(suffix) and len(name) > len(suffix):
                name = name[: -len(suffix)]
                break
    return name


def read_source(source: Source, reading: Reading) -> list[Recording]:
    """
    Read what a source names.

    :param source: a file or a bundled cell, and perhaps which discharge
    :param reading: how files are read
    :return: its discharges
    :raises ValueError: if it cannot be read, or there are none
    """
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
        self.table, self.parquet = folder / f"{prefix}estimate.csv", folder / f"{prefix}estimate.parquet"
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
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*_voltage\.(?:csv|png)", flags=re.IGNORECASE)
        tables = {path.name for path in (self.table, self.parquet, self.life)}
        return [
            path
            for path in sorted(self.folder.iterdir())
            if path.name in tables or (self.with_voltages and voltages.fullmatch(path.name))
        ]

    def write_voltages(self, name: str, summary: Summary, title: str) -> None:
        """
        Write what one discharge showed, beside the model.

        :param name: what the names of its files start with
        :param summary: of the discharge
        :param title: of the figure
        """
        from battery_env.plotting import plot_discharge, save_figure  # here, as matplotlib takes long to import

        record, forecast = summary.record, summary.forecast
        columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
        with replacing(self.folder / f"{name}_voltage.csv") as part:
            pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(part, index=False)
        save_figure(plot_discharge(record, {"model": forecast}, title), self.folder / f"{name}_voltage.png")

    def write_table(self, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
        """
        Write the table of all discharges and, if there are several, the figure of their parameters over them.

        :param rows: one a discharge
        :return: the files that were written. Parquet is written if pyarrow is installed
        """
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
    sources: Sequence[Source], reading: Reading, settings: Settings, results: Results | None = None, jobs: int = 1
) -> Iterator[dict[str, Any]]:
    """
    Calibrate the model to the discharges of many files, one after the other or side by side.

    :param sources: where they are
    :param reading: how files are read
    :param settings: how each discharge is looked at
    :param results: where to write what each discharge showed; ``None``: nowhere
    :param jobs: processes; -1: as many as there are cores
    :return: one row a discharge in their order, as they are finished: ``record`` (its name, which no other has), ``source``,
        ``cell``, ``cycle``, what :func:`battery_env.summary.summarize` tells, ``notes`` (warnings), and ``error`` where a file
        or a discharge cannot be used; it is empty otherwise
    :raises ImportError: for several processes without the extra ``fleet``
    """
    folder = results if results is not None and results.with_voltages else None
    tasks = ((task, settings, folder) for task in _tasks(sources, reading))
    if jobs == 1:
        return (_calibrate(*task) for task in tasks)
    try:
        from joblib import Parallel, delayed
    except ImportError as error:
        raise ImportError("--jobs needs joblib: pip install 'battery_env[fleet]'") from error
    return iter(Parallel(n_jobs=jobs, return_as="generator")(delayed(_calibrate)(*task) for task in tasks))


class _Task(NamedTuple):
    row: dict[str, Any]  # what is known before: record, source, cell, cycle, notes, error
    recording: Recording | None


def _tasks(sources: Sequence[Source], reading: Reading) -> Iterator[_Task]:
    used: set[str] = set()
    for source in sources:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                recordings = read_source(source, reading)
            except Exception as error:  # of whatever kind, it must not stop the others
                name = _unused(record_name(source.stem, source.cycle), used)
                text = _message(error)
                text = text if source.path in text else f"{source.path}: {text}"
                yield _Task(_known(name, source, source.cycle, caught, text), None)
                continue
        for recording in recordings:
            cycle = recording.meta.get("cycle")
            name = _unused(record_name(source.stem, cycle), used)
            yield _Task(_known(name, source, cycle, caught, ""), recording)


def _known(
    name: str, source: Source, cycle: int | None, caught: Sequence[warnings.WarningMessage], error: str
) -> dict[str, Any]:
    notes = "; ".join(str(each.message) for each in caught)
    return {"record": name, "source": source.path, "cell": source.stem, "cycle": cycle, "notes": notes, "error": error}


def record_name(stem: str, cycle: int | None) -> str:
    """
    How one discharge is called in results.

    :param stem: of its source
    :param cycle: its number, if it has one
    :return: its name
    """
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


def _calibrate(task: _Task, settings: Settings, results: Results | None) -> dict[str, Any]:
    known, recording = task
    if recording is None:
        return known
    name = known["record"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            summary = summarize(recording.discharge(), settings)
            if results is not None:
                results.write_voltages(name, summary, _title(name, summary.row))
        except Exception as error:  # of whatever kind, it must not stop the others
            return known | {"error": f"{name}: {_message(error)}"}
    notes = "; ".join(filter(None, [known["notes"], *(str(each.message) for each in caught)]))
    return {name: known[name] for name in ("record", "source", "cell", "cycle")} | summary.row | {"notes": notes, "error": ""}


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
