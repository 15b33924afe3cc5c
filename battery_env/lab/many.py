"""Many discharges: each is read, calibrated and written for itself, and none that fails stops the others."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

from battery_env.lab.calibrate import calibrate
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.readers.discharges import Recording
from battery_env.lab.report import Calibration
from battery_env.lab.results import Outcome, Results, picture_of, voltages_of
from battery_env.lab.settings import Settings
from battery_env.lab.sources import VOLTAGE, Source, find_sources, printable, read_source, record_name
from battery_env.lab.workers import Attempt, InThisProcess, attempt, in_order

__all__ = ["FileFormat", "Outcome", "Source", "calibrate_all", "find_sources"]


@dataclass(frozen=True)
class _Place:
    """So many-th discharge of how many of a source, and what is known of it before it is calibrated."""

    known: Outcome
    source: Source
    number: int
    count: int


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
    :return: in the order of the sources
    """
    executor = executor or InThisProcess()
    to_read = ((results.all_of(source) if results else []) or (source, file_format) for source in sources)
    read = zip(sources, in_order(executor, ahead, read_source, to_read), strict=True)
    for call, made in in_order(executor, ahead, _calibrate, _calls(read, results, settings)):
        if isinstance(call, Outcome):  # done before
            yield call
            continue
        place: _Place = call if made is None else call[0]
        outcome, whole = (place.known, True) if made is None else _outcome(place.known, made, results)
        if results is not None:
            results.keep(outcome, place.source, place.number, place.count, whole)
        yield outcome


def _calls(
    read: Iterable[tuple[Source, tuple[Any, Attempt | None]]], results: Results | None, settings: Settings
) -> Iterator[Any]:
    """What is left to do of each source, and in its place what is done, or cannot be."""
    used = {name.casefold() for name in results.names} if results else set[str]()
    for source, (done, made) in read:
        if made is None:
            yield from done
            continue
        recordings, notes, error = made
        if error and printable(source.path) not in error:
            error = f"{source.path}: {error}"
        is_one = bool(error) or len({each.meta.get("cell") for each in recordings}) == 1
        count = 1 if error else len(recordings)
        for number, recording in enumerate([None] if error else recordings):
            if results is not None and (outcome := results.of(source, number)):
                yield outcome
                continue
            cycle, stem, cell = source.cycle, source.stem, source.cell
            if recording is not None:
                cycle = recording.meta.get("cycle")
                if not is_one:  # a table of several cells names them
                    cell = recording.meta["cell"]
                    stem = "_".join((stem, *re.findall(r"[\w.-]+", cell)))
            name = _unused(record_name(stem, cycle), used)
            place = _Place(Outcome(name, source.path, cell, cycle, notes="; ".join(notes), error=error), source, number, count)
            with_voltages = results is not None and results.with_voltages
            yield place if recording is None else (place, recording, settings, with_voltages)


def _outcome(known: Outcome, made: Attempt, results: Results | None) -> tuple[Outcome, bool]:
    """What became of a discharge, and whether all that belongs to it is written."""
    if made.error:
        return replace(known, error=f"{known.record}: {made.error}"), False
    found, files, lost = made.result
    for suffix, content in files.items():
        assert results is not None
        if error := attempt(results.write_voltages, known.record, suffix, content).error:
            lost.append(f"{VOLTAGE[1:]}.{suffix} is not written: {error}")
    return replace(known, found=found, notes="; ".join(filter(None, [known.notes, *made.notes, *lost]))), not lost


def _unused(name: str, used: set[str]) -> str:
    """The name, with a number behind it if another record has it; some file systems take a letter and its capital for one."""
    number, unused = 1, name
    while unused.casefold() in used:
        number += 1
        unused = f"{name}_{number}"
    used.add(unused.casefold())
    return unused


def _calibrate(
    place: _Place, recording: Recording, settings: Settings, with_voltages: bool
) -> tuple[Calibration, dict[str, bytes], list[str]]:
    """What the discharge says, its voltages as files by their suffixes, and which of these could not be made, and why."""
    found = calibrate(recording.discharge(), settings)
    files, lost = {}, []
    for suffix, make in (("csv", voltages_of), ("png", picture_of)) if with_voltages else ():
        made = attempt(make, place.known.record, found)
        if made.error:
            lost.append(f"{VOLTAGE[1:]}.{suffix} is not made: {made.error}")
        else:
            files[suffix] = made.result
    return replace(found, record=None, forecast=None, end=None), files, lost
