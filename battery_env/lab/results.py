"""What became of many discharges, and the files that it is written to."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from battery_env.files import check_folder, replacing
from battery_env.lab.report import METHOD_NAMES, Calibration, title_of
from battery_env.lab.sources import LIFE, TABLES, VOLTAGE, Source, record_name

# Discharges that could not be used have no values there.
_TYPES = {"cycle": "Int64", "settled": "boolean", "settled_q_mobile": "boolean", "settled_r_o": "boolean"}


class Results:
    """The files that results are written to, refused if they are there already and may not be replaced."""

    def __init__(self, folder: Path, sources: Sequence[Source], with_voltages: bool, replace: bool) -> None:
        self.folder, self.with_voltages = folder, with_voltages
        prefix = f"{record_name(sources[0].stem, sources[0].cycle)}_" if len(sources) == 1 else ""
        self.table, self.parquet = (folder / f"{prefix}{name}" for name in TABLES)
        self.life = folder / f"{prefix}{LIFE}"
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
        voltages = re.compile(rf"(?:{stems})(?:_\d+)*{VOLTAGE}\.(?:csv|png)", flags=re.IGNORECASE)
        tables = {path.name for path in (self.table, self.parquet, self.life)}
        return [
            path
            for path in sorted(self.folder.iterdir())
            if path.name in tables or (self.with_voltages and voltages.fullmatch(path.name))
        ]

    def write_voltages(self, name: str, files: Mapping[str, bytes]) -> None:
        """Write what one discharge showed, beside the model."""
        for suffix, content in files.items():
            with replacing(self.folder / f"{name}{VOLTAGE}.{suffix}") as part:
                part.write_bytes(content)

    def write_table(self, outcomes: Sequence[Outcome]) -> list[Path]:
        """Write the table of all discharges and, if several are whole, the figure of their parameters over them."""
        table = pd.DataFrame([each.row() for each in outcomes]).astype(_TYPES)
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


def voltages_of(name: str, found: Calibration) -> dict[str, bytes]:
    """What one discharge showed, beside the model, as files by their suffixes."""
    from battery_env.plotting import plot_discharge  # here, as matplotlib takes long to import

    record, forecast = found.record, found.forecast
    assert record is not None and forecast is not None
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    table = pd.DataFrame(columns | {"model_V": forecast.at_samples_V}).to_csv(index=False)
    picture = io.BytesIO()
    shown = {f"model, {METHOD_NAMES[found.method]}": forecast}
    plot_discharge(record, shown, title_of(name, found), found.end).savefig(picture, dpi="figure")
    return {"csv": table.encode(), "png": picture.getvalue()}
