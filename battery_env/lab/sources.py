"""Where discharges come from: files, folders of them, and the bundled cells, by the names that a command line gives."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

from battery_env.lab.readers.columns import FileFormat, few_of
from battery_env.lab.readers.discharges import read_recordings
from battery_env.lab.readers.tables import BINARY_SUFFIXES, NUMBERED_SUFFIXES, PACKED_SUFFIXES, TEXT_SUFFIXES, is_readable
from battery_env.records.discharge import BUNDLED_CELLS, load_nasa_discharges
from battery_env.records.recording import Recording
from battery_env.records.refusals import Origin

#: Names of results: rows, their table, voltages, a figure.
RUN, TABLE, VOLTAGE, LIFE = "estimate.jsonl", "estimate.csv", "_voltage", "life.png"
# First bytes of results whose names a record may have.
_RESULT_HEADS = (b"record,source,cell,cycle,", b"time_s,voltage_V,current_A,model_V\n")
_NASA_SUFFIX = ".mat"
# The table of tests of NASA's discharges, in the layout of the bundled ones, is no record.
_NO_RECORDS = ("cycles.csv",)
# First characters of a formula in workbooks.
_FORMULA_HEADS = ("=", "+", "-", "@")


class Source(NamedTuple):
    """
    Where discharges come from.

    :param path: a file, or the name of a bundled cell
    :param cycle: which discharge; ``None``: all of them
    :param stem: start of the names of results
    :param cell: name of the cell
    :param given: the argument of the command line, such as the folder of a file
    """

    path: str
    cycle: int | None
    stem: str
    cell: str
    given: str

    @property
    def argument(self) -> str:
        """The source as an argument of the command line."""
        return self.path if self.cycle is None else f"{self.path}:{self.cycle}"

    @property
    def key(self) -> str:
        """An identifier that does not depend on the working directory."""
        return key_of(self.argument)


def find_sources(arguments: Iterable[str]) -> list[Source]:
    """
    Find the sources that arguments of a command line name. A cell has the name of its file; or of its folder, if the arguments
    are folders and records lie in several folders.
    """
    arguments = list(arguments)
    inside = {argument: _records(Path(argument)) for argument in arguments if Path(argument).is_dir()}
    folders = {file.parent.absolute() for files in inside.values() for file in files}
    sources = []
    for argument in arguments:
        if inside.get(argument):
            for file in inside[argument]:
                stem, cell = _names(file, folders)
                sources.append(Source(str(file), None, stem, cell, argument))
            continue
        name, colon, cycle = argument.rpartition(":")
        if not (colon and cycle.isdecimal()) or Path(argument).exists():
            name, cycle = argument, ""
        stem = name if name in BUNDLED_CELLS else _stem(Path(name))
        sources.append(Source(name, int(cycle) if cycle else None, stem, stem, argument))
    sources = [each._replace(path=f"./{each.path}") if each.path.startswith(_FORMULA_HEADS) else each for each in sources]
    return list({source.key: source for source in sources}.values())  # each source once


def _records(folder: Path) -> list[Path]:
    """Return the possible records in a folder, by their numbers, and unreadable folders; warn of all else but results."""
    records, ignored = [], []

    def unread(error: OSError) -> None:
        records.append(Path(error.filename))

    for parent, folders, names in os.walk(folder, onerror=unread):
        folders[:] = [name for name in folders if not name.startswith(".")]
        ignored += [Path(parent, name) for name in folders if Path(parent, name).is_symlink()]
        for path in (Path(parent, name) for name in names if not name.startswith(".")):
            if path.name in _NO_RECORDS or not is_readable(path, (_NASA_SUFFIX,)):
                ignored.append(path)
            elif not is_result(path):
                records.append(path)
    left_out = [
        printable(path.relative_to(folder).as_posix()) for path in sorted(ignored, key=_by_number) if not is_result(path)
    ]
    if records and left_out:
        warnings.warn(f"{folder}: {few_of(left_out)} left out, by their names no records", stacklevel=3)
    return sorted(records, key=_by_number)


def _by_number(path: Path) -> tuple[list[list[str | int]], Path]:
    parts = [re.split("([0-9]+)", part) for part in path.parts]
    return [[int(each) if k % 2 else each for k, each in enumerate(part)] for part in parts], path


def _names(file: Path, folders: Collection[Path]) -> tuple[str, str]:
    """Return the stem and the cell of a file in one of some folders."""
    if len(folders) == 1:
        return _stem(file), _stem(file)
    common = Path(os.path.commonpath(folders))
    folder = file.parent.absolute()
    cell = folder.name if folder == common else folder.relative_to(common).as_posix()
    return f"{_plain(cell.replace('/', '_'))}_{_stem(file)}", _plain(cell)


def is_result(path: Path) -> bool:
    """Return whether a file is a result; a table is recognised by its header, as a record may have its name."""
    if path.suffix != ".csv":
        return path.name in (RUN, LIFE) or path.name.endswith(f"{VOLTAGE}.png")
    if not path.is_file():  # to open a pipe is to wait for it
        return False
    try:
        with path.open("rb") as stream:
            return stream.read(64).startswith(_RESULT_HEADS)
    except OSError:
        return False


def _stem(path: Path) -> str:
    name = path.name
    for suffixes in (PACKED_SUFFIXES, (*TEXT_SUFFIXES, *NUMBERED_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX), (".bdf",)):
        for suffix in suffixes:
            if name.lower().endswith(suffix) and len(name) > len(suffix):
                name = name[: -len(suffix)]
                break
    return _plain(name)


def _plain(name: str) -> str:
    """Return a name of files and cells, with underscores for characters that cannot be printed."""
    return no_formula("".join(each if each.isprintable() else "_" for each in name))


def printable(text: str) -> str:
    """Return a text for terminals and tables, with escapes for characters that cannot be printed."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def no_formula(text: str) -> str:
    """Return a text that no workbook takes for a formula."""
    return f"_{text}" if text.startswith(_FORMULA_HEADS) else text


def record_name(stem: str, cycle: int | None) -> str:
    """Return the name of a discharge in results."""
    return stem if cycle is None else f"{stem}_{cycle:03d}"


def is_bundled(path: str) -> bool:
    """Return whether a path is a bundled cell, and no file of its name."""
    return path in BUNDLED_CELLS and not Path(path).exists()


def key_of(argument: str) -> str:
    """Return an identifier of an argument that does not depend on the working directory."""
    return argument if is_bundled(argument.partition(":")[0]) else os.path.abspath(argument)


def read_source(source: Source, file_format: FileFormat) -> list[Recording]:
    """Read the discharges of a source."""
    path, cycle = source.path, source.cycle
    if is_bundled(path):
        columns = ("time_s", "voltage_V", "current_A", "temperature_C")
        recordings = [
            Recording({name: getattr(each, name) for name in columns}, each.meta, Origin(path, frozenset()))
            for each in load_nasa_discharges(path)
        ]
    elif Path(path).is_dir():
        os.scandir(path).close()  # which says why, where it cannot be looked into
        endings = ", ".join((*TEXT_SUFFIXES, *BINARY_SUFFIXES, _NASA_SUFFIX))
        raise ValueError(f"{path} holds no file whose name ends as that of a record ({endings}), nor do the folders in it")
    elif Path(path).exists() and not Path(path).is_file():
        raise ValueError(f"{path} is no file that can be read twice, as its columns are found first: save it to one")
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
        cycles = sorted({recording.meta["cycle"] for recording in recordings if "cycle" in recording.meta})
        text = f"has discharges {path}:{cycles[0]} .. {path}:{cycles[-1]}" if cycles else "has one discharge, without a number"
        raise ValueError(f"{path} {text}, got {source.argument}")
    return chosen
