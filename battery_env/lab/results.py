"""
What became of many discharges, and the files that it is written to: a row of the run as each is done, which the same command
goes on from, and the tables that are made of these rows.
"""

from __future__ import annotations

import io
import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from battery_env.files import check_folder, locked, replacing, set_aside
from battery_env.lab.report import METHOD_NAMES, Calibration, title_of
from battery_env.lab.settings import Settings
from battery_env.lab.sources import LIFE, RUN, TABLES, VOLTAGE, Source, printable, record_name

# Discharges that could not be used have no values there.
_TYPES = {"cycle": "Int64", "settled": "boolean", "settled_q_mobile": "boolean", "settled_r_o": "boolean"}
_FORMAT, _FORMAT_VERSION = "battery_env.run", 1


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
        row = told | (self.found.row() if self.found else {}) | {"notes": self.notes, "error": self.error}
        return {name: printable(value) if isinstance(value, str) else value for name, value in row.items()}

    @classmethod
    def of_row(cls, row: Mapping[str, Any], settings: Settings) -> Outcome:
        """The same, of a discharge that could be used."""
        own = {field.name for field in fields(cls)}
        columns = {name: value for name, value in row.items() if name not in own - {"cycle"}}
        return cls(found=Calibration(settings, **columns), **{name: row[name] for name in own & row.keys()})


class Results:
    """
    The files in a folder that results are written to. A row of the run is appended as each discharge is done, and whatever
    ends the command, the same one goes on from there: one with the same sources, settings and whatever else its rows are made
    with. Other results that are there are refused unless they may be replaced.
    """

    def __init__(
        self,
        folder: Path,
        sources: Sequence[Source],
        with_voltages: bool,
        settings: Settings,
        made_with: Mapping[str, Any],
    ) -> None:
        self.folder, self.with_voltages, self._settings = folder, with_voltages, settings
        self._stems = [record_name(source.stem, source.cycle) for source in sources]
        prefix = f"{self._stems[0]}_" if len(sources) == 1 else ""
        self.table, self.parquet = (folder / f"{prefix}{name}" for name in TABLES)
        self.life, self.run = folder / f"{prefix}{LIFE}", folder / f"{prefix}{RUN}"
        self._sources = {source.argument: number for number, source in enumerate(sources)}
        self._stamps = {source.argument: _stamp(source) for source in sources}
        self._header = {"format": _FORMAT, "version": _FORMAT_VERSION, "made_with": json.loads(_json(made_with))}
        self._rows: dict[tuple[int, int], Outcome] = {}
        self._counts: dict[str, int] = {}
        check_folder(folder)

    @contextmanager
    def opened(self, replace: bool) -> Iterator[Results]:
        """Hold the files against other commands, read what of the run is done, and refuse what may not be replaced."""
        with locked(self.run):
            if replace:
                self.run.unlink(missing_ok=True)
            lines = self._lines()
            if lines is None and not replace and (existing := self._existing()):
                more = f" and {len(existing) - 3} more" if len(existing) > 3 else ""
                shown = ", ".join(str(path) for path in existing[:3])
                raise FileExistsError(f"{shown}{more} would be replaced; choose another --out, or give --force")
            # Only what is whole: a power cut may have left a part of the last line
            with replacing(self.run) as part:
                part.write_text("".join(f"{_json(line)}\n" for line in (self._header, *(lines or ()))), encoding="ascii")
            with self.run.open("ab") as self._stream:
                yield self

    def _lines(self) -> list[dict[str, Any]] | None:
        """The rows of this run that hold; ``None`` if there is no run."""
        if not self.run.exists():
            return None
        lines = [_line(text) for text in self.run.read_bytes().splitlines()]
        header = lines[0] if lines else None
        if header is None or header.get("format") != _FORMAT or header.get("version") != _FORMAT_VERSION:
            set_aside(self.run)
            return None
        before, now = header["made_with"], self._header["made_with"]
        if different := sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name)):
            raise FileExistsError(
                f"{self.run} is of a command with another {', '.join(different)}; choose another --out, or give --force"
            )
        kept = []
        for line in filter(None, lines[1:]):
            argument = line.get("source")
            if line.get("whole") and argument in self._sources and line.get("stamp") == self._stamps[argument]:
                self._rows[self._sources[argument], line["number"]] = Outcome.of_row(line["row"], self._settings)
                self._counts[argument] = line["of"]
                kept.append(line)
        return kept

    def _existing(self) -> list[Path]:
        if not self.folder.is_dir():
            return []
        # the numbers of the discharges are not known before their files are read
        stems = "|".join(map(re.escape, self._stems))
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*{VOLTAGE}\.(?:csv|png)", flags=re.IGNORECASE)
        tables = {path.name for path in (self.table, self.parquet, self.life)}
        return [
            path
            for path in sorted(self.folder.iterdir())
            if path.name in tables or (self.with_voltages and voltages.fullmatch(path.name))
        ]

    @property
    def names(self) -> list[str]:
        """What the discharges that are done are called."""
        return [each.record for each in self._rows.values()]

    def of(self, source: Source, number: int) -> Outcome | None:
        """What became of a discharge of a source, if that is done."""
        return self._rows.get((self._sources[source.argument], number))

    def all_of(self, source: Source) -> list[Outcome]:
        """What became of all discharges of a source; nothing unless all are done."""
        found = [self.of(source, number) for number in range(self._counts.get(source.argument, 0))]
        return [each for each in found if each] if all(found) else []

    def keep(self, outcome: Outcome, source: Source, number: int, count: int, whole: bool = True) -> None:
        """Append a row, which is on the disk when this returns; one that is not whole is made again by the same command."""
        self._rows[self._sources[source.argument], number] = outcome
        line = {
            "source": source.argument,
            "stamp": self._stamps[source.argument],
            "number": number,
            "of": count,
            "whole": whole and not outcome.error,
            "row": outcome.row(),
        }
        self._stream.write(f"{_json(line)}\n".encode("ascii"))
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def write_voltages(self, name: str, suffix: str, content: bytes) -> None:
        """Write what one discharge showed, beside the model."""
        with replacing(self.folder / f"{name}{VOLTAGE}.{suffix}") as part:
            part.write_bytes(content)

    def write_tables(self) -> list[Path]:
        """Write the table of all rows of the run and, if several are whole, the figure of their parameters over them."""
        table = pd.DataFrame([self._rows[key].row() for key in sorted(self._rows)]).astype(_TYPES)
        with replacing(self.table) as part:
            table.to_csv(part, index=False)
        written = [self.table]
        for path, write in ((self.parquet, _write_parquet), (self.life, _draw_life)):
            try:
                written += write(table, path)
            except Exception as error:  # whatever it is, the numbers are written
                warnings.warn(f"{path} is not written: {type(error).__name__}: {error}", stacklevel=2)
        return written

    @property
    def has_numbers(self) -> bool:
        """Whether any discharge could be used."""
        return any(not each.error for each in self._rows.values())


def _write_parquet(table: pd.DataFrame, path: Path) -> list[Path]:
    if find_spec("pyarrow") is None:
        return []
    with replacing(path) as part:
        table.to_parquet(part, engine="pyarrow", index=False)
    return [path]


def _draw_life(table: pd.DataFrame, path: Path) -> list[Path]:
    whole = table[table["measured_eod_time_s"].notna()]
    if len(whole) < 2:
        return []
    from battery_env.plotting import plot_life, save_figure

    return [save_figure(plot_life(whole), path)]


def _stamp(source: Source) -> list[int]:
    """What changes with the file; nothing of a bundled cell."""
    try:
        status = os.stat(source.path)
    except OSError:
        return []
    return [status.st_size, status.st_mtime_ns]


def _json(content: Any) -> str:
    """On one line, in ASCII, with numbers that come back to the bit."""
    return json.dumps(content, default=lambda value: value.item() if isinstance(value, np.generic) else str(value))


def _line(text: bytes) -> dict[str, Any] | None:
    try:
        content = json.loads(text)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None


def voltages_of(name: str, found: Calibration) -> bytes:
    """What one discharge showed, beside the model, as CSV."""
    record, forecast = found.record, found.forecast
    assert record is not None and forecast is not None
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    return pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False).encode()


def picture_of(name: str, found: Calibration) -> bytes:
    """The same as PNG."""
    from battery_env.plotting import literal, plot_discharge  # here, as matplotlib takes long to import

    assert found.record is not None and found.forecast is not None
    picture = io.BytesIO()
    shown = {f"model, {METHOD_NAMES[found.method]}": found.forecast}
    title = title_of(literal(name), found)
    plot_discharge(found.record, shown, title, found.end).savefig(picture, dpi="figure")
    return picture.getvalue()
