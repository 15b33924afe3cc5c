"""Many discharges: each is read, calibrated and written for itself, and none that fails stops the others."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

from battery_env.lab.calibrate import calibrate
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.readers.discharges import Recording
from battery_env.lab.report import Calibration
from battery_env.lab.results import Outcome, Results, voltages_of
from battery_env.lab.settings import Settings
from battery_env.lab.sources import Source, find_sources, read_source, record_name
from battery_env.lab.workers import Attempt, InThisProcess, attempt, in_order

__all__ = ["FileFormat", "Outcome", "Source", "calibrate_all", "find_sources"]


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
    read = in_order(executor, ahead, read_source, ((source, file_format) for source in sources))
    with_voltages = results is not None and results.with_voltages
    calls = ((known, recording, settings, with_voltages) for known, recording in _recordings(read))
    for (known, *_), (made, notes, error) in in_order(executor, ahead, _calibrate, calls):
        if known.error:
            yield known
            continue
        if results is not None and not error:
            error = attempt(results.write_voltages, known.record, made[1]).error
        if error:
            yield replace(known, error=f"{known.record}: {error}")
        else:
            yield replace(known, found=made[0], notes="; ".join(filter(None, [known.notes, *notes])))


def _recordings(read: Iterable[tuple[tuple[Any, ...], Attempt]]) -> Iterator[tuple[Outcome, Recording | None]]:
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


def _unused(name: str, used: set[str]) -> str:
    """The name, with a number behind it if another record has it; some file systems take a letter and its capital for one."""
    number, unused = 1, name
    while unused.casefold() in used:
        number += 1
        unused = f"{name}_{number}"
    used.add(unused.casefold())
    return unused


def _calibrate(
    known: Outcome, recording: Recording | None, settings: Settings, with_voltages: bool
) -> tuple[Calibration, dict[str, bytes]] | None:
    """What the discharge says, and its voltages as files; nothing of a source that could not be read."""
    if recording is None:
        return None
    found = calibrate(recording.discharge(), settings)
    files = voltages_of(known.record, found) if with_voltages else {}
    return replace(found, record=None, forecast=None, end=None), files
