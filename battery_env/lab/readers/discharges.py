"""Recorded discharges from files and tables of testers: which of the rows are a discharge, and what is known beside it."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from battery_env.arrays import FloatArray
from battery_env.checks import LOAD_LIMITS
from battery_env.lab.readers.columns import FileFormat, recognise, say
from battery_env.lab.readers.nasa import read_nasa_mat
from battery_env.lab.readers.rows import FEW_SHARE, NOTHING_SHARE, changes, refuse_other_unit, rows_of
from battery_env.lab.readers.signs import MUCH_SHARE, with_signed_current
from battery_env.lab.readers.tables import check_mat, open_file, open_frame
from battery_env.lab.readers.testers import REQUIRED, Tester, find_tester
from battery_env.records import (
    LEAST_LOAD_SHARE,
    LOAD_SHARE,
    STEADY_S,
    SWITCH_SHARE,
    ChargeBefore,
    ChargeHistory,
    integrate_load,
    is_load,
)
from battery_env.records.discharge import LEAST_SAMPLES, Discharge
from battery_env.records.recording import Recording
from battery_env.records.refusals import TABLE, Origin, RecordError
from battery_env.records.samples import SIGNS

Made = TypeVar("Made")

# A charge ends a discharge if it returns more than this share of the charge drawn until then; less is braking, or is told.
_RETURNED_SHARE = 0.2
# A charge before the load is cut off if it exceeds this share of the charge drawn; a smaller one is sensor offset. A charge
# within the load ends the discharge only if it returns more than this share of the largest charge drawn: early pulses return
# much of the little drawn yet.
_CHARGED_SHARE = 0.02


def read_discharges(
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
    ignore: Collection[str] = (),
    tester: str | Path | Tester | None = None,
) -> list[Discharge]:
    """
    Read the discharges of a file or of a table.

    A table is a ``pandas.DataFrame``; an index with a name is a column, too. A file is text with a header (commas,
    semicolons, tabs or blanks, decimal points or commas, also packed as .gz or .zip), Parquet, one of NASA's .mat
    files, with the extra ``excel`` a workbook, or with the extra ``cyclers`` a binary file of Neware (.nda, .ndax) or BioLogic
    (.mpr). The names of testers identify columns and their units.

    The file may also hold charges and rests of the cell, and many cycles. A discharge is the part between two charges, with
    the rest before the load. Its number is the cycle in the file, or a count. Each of several discharges has a clock that
    starts at its first sample. If the charges are not logged, only a column of the cycle separates discharges. A warning names
    all corrections. A temperature that is missing in some rows is interpolated.

    .. code-block:: python

      frame = pd.DataFrame({"Test Time / s": time, "Voltage / V": voltage, "Current / A": current})
      discharges = read_discharges(frame)

    :param source: the file, or the table
    :param columns: the column of each quantity (``time``, ``voltage``, ``current``, ``temperature``, ``ambient``, ``cycle``,
        ``step``, ``state``, ``cell``), if the names are unknown
    :param units: the unit of each quantity, if the name has none: ``s``, ``ms``, ``min``, ``h``; ``V``, ``mV``; ``A``,
        ``mA``; ``degC``, ``K``
    :param discharge_is_negative: whether the current of a discharge is negative; ``None``: recognised from jumps of the
        voltage at switches of the load, or from words for charge and discharge
    :param ignore: names of columns to leave out
    :param tester: the tester of the table: a name in the testers' table, or a TOML file; ``None``: recognised from the table
    :return: the discharges; their ``meta`` holds ``source`` and, if there are several or they are numbered, ``cycle``. A
        discharge that fails the checks of :class:`~battery_env.Discharge` is left out with a warning
    :raises ValueError: if there is no discharge, the file is damaged, or a column or unit is unknown
    :raises ImportError: if the file needs an extra that is not installed
    """
    file_format = FileFormat(columns, units, discharge_is_negative, ignore, find_tester(tester))
    return each_usable(lambda each: each, {_name_of(source): lambda: read_recordings(source, file_format)})


def each_usable(use: Callable[[Discharge], Made], readers: Mapping[str, Callable[[], list[Recording]]]) -> list[Made]:
    """What is made of each discharge, by sources and what reads each; a warning tells what is left out, if not all is."""
    made, errors = [], []
    for name, read in readers.items():
        try:
            recordings = read()
        except (OSError, TypeError, ValueError) as error:
            errors.append(error)
            continue
        for recording in recordings:
            try:
                made.append(use(recording.discharge()))
            except (TypeError, ValueError) as error:
                number = f"discharge {recording.meta['cycle']}: " if "cycle" in recording.meta else ""
                errors.append(ValueError(f"{name}: {number}{error}"))
    try:
        if not made:
            raise errors[0]
        for reason in errors:
            warnings.warn(f"It is left out: {reason}", stacklevel=3)
    finally:
        errors.clear()  # an error holds the frame that holds it, and with it what its reader had opened
    return made


def read_discharge_csv(path: str | Path, discharge_is_negative: bool = False) -> Discharge:
    """
    Read one discharge from a text file, with a stated sign of the current.

    :param path: the file, as in :func:`read_discharges`
    :param discharge_is_negative: whether the current of a discharge is negative in the file
    :return: the discharge; its ``meta`` holds ``source``
    :raises ValueError: if the file holds no discharge or several, or if its values are invalid
    """
    discharges = read_discharges(path, discharge_is_negative=discharge_is_negative)
    if len(discharges) > 1:
        raise ValueError(f"{path} holds {len(discharges)} discharges: read them with read_discharges")
    return discharges[0]


def read_recordings(source: str | Path | pd.DataFrame, file_format: FileFormat) -> list[Recording]:
    """The discharges of a file or a table, one at least, before they are checked: one that cannot be used loses no other."""
    name = _name_of(source)
    told = Origin(name)
    lines: list[str] = []
    try:
        if not isinstance(source, pd.DataFrame) and Path(source).suffix.lower() == ".mat":
            check_mat(Path(source))
            told = Origin(name, frozenset())
            recordings = [Recording(arrays, meta, told) for arrays, meta in read_nasa_mat(Path(source))]
        else:
            opened = open_frame(source) if isinstance(source, pd.DataFrame) else open_file(Path(source), file_format)
            known = recognise(opened.names, file_format, opened.rows)
            lines, told = known.lines(), Origin(name, known.open_questions, vars(file_format))
            rows = rows_of(opened.read(known.check()), known, file_format)
            if not file_format.load:  # which is what it says
                before_A, rows = rows["current"], with_signed_current(rows, known, file_format.discharge_is_negative)
                taken = "is negative" if (before_A * rows["current"]).sum() < 0.0 else "is positive"
                told = replace(told, open_questions=known.open_questions - {taken})
            recordings = _split(rows, told)
        if not recordings:
            raise ValueError("there is no discharge")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {RecordError.like(error).of(told, lines)}") from error
    return recordings


def _name_of(source: str | Path | pd.DataFrame) -> str:
    if not isinstance(source, pd.DataFrame | str | os.PathLike):
        raise TypeError(f"expected a DataFrame or the path of a file, got {type(source).__name__}")
    return TABLE if isinstance(source, pd.DataFrame) else str(source)


class _Part(NamedTuple):
    """Rows of a table that may be a discharge."""

    rows: slice
    drawn_C: float
    charge: slice  # the rows of the charge that ends where it begins, empty if there is none


def _split(rows: pd.DataFrame, origin: Origin) -> list[Recording]:
    """The discharges among some rows; what is left aside is named."""
    parts = [part for low, high in itertools.pairwise(_bounds(rows)) for part in _discharges(rows, low, high)]
    if not parts:
        raise _nothing_drawn(rows)
    current_A, places = rows["current"].to_numpy(), rows.index + 1
    # what no cell can draw is refused later, and is no measure of the others
    largest_C = max((part.drawn_C for part in parts if current_A[part.rows].max() <= LOAD_LIMITS["current"]), default=0.0)
    aside = [
        f"{drawn_C / 3600.0:.3g} Ah in rows {places[part.start]} to {places[part.stop - 1]}"
        for part, drawn_C, _ in parts
        if NOTHING_SHARE**2 * largest_C < drawn_C < LOAD_SHARE * largest_C  # next to nothing is noise of a sensor
    ]
    if aside:
        first = "; ".join(aside[:3]) + (" and others" if len(aside) > 3 else "")
        say(f"left aside, as they draw less than {LOAD_SHARE:.0%} of the largest: {len(aside)} ({first})")
    parts = [part for part in parts if part.drawn_C >= LOAD_SHARE * largest_C]
    histories = [ChargeHistory(charge=_charge_before(rows, part.charge)) for part in parts]
    meta: dict[str, Any] = {"source": origin.source}
    metas = [meta | {"cycle": number} for number in range(1, len(parts) + 1)] if len(parts) > 1 else [meta]
    found = zip(parts, histories, metas, strict=True)
    return [_recording(rows.iloc[part.rows], history, each, len(parts) > 1, origin) for part, history, each in found]


def _nothing_drawn(rows: pd.DataFrame) -> RecordError:
    """What rows are in which no charge is drawn: a charge, if the voltage rises with it."""
    time_s, voltage_V, current_A = (rows[name].to_numpy() for name in REQUIRED)
    charged_Ah = -float(_passed_C(time_s, current_A)[-1]) / 3600.0
    begin_V, end_V = voltage_V[current_A < 0.0][[0, -1]] if (current_A < 0.0).any() else (0.0, 0.0)
    if end_V > begin_V:
        return RecordError(f"there is no discharge, but a charge of {charged_Ah:.4g} Ah, from {begin_V:.2f} to {end_V:.2f} V")
    return RecordError("there is no discharge, as no charge is drawn: check the sign of the current", SIGNS)


def _bounds(rows: pd.DataFrame) -> list[int]:
    """
    Where the number of the cycle changes, and a clock starts anew, or a current that no cell can draw begins or ends; or where
    no charge is logged, and the voltage is back after it fell: counters may count loops.
    """
    time_s, voltage_V, current_A = (rows[name].to_numpy() for name in ("time", "voltage", "current"))
    are_charges_logged = any(charge.is_end for charge in _charges(rows, _passed_C(time_s, current_A)))
    bounds, numbers = [0], [0, *np.flatnonzero(changes(rows, "cycle")), len(rows)]
    of_cell, top_V = True, -np.inf
    for begin, end in itertools.pairwise(numbers):
        highest_V = voltage_V[begin:end].max()
        was_of_cell, of_cell = of_cell, np.abs(current_A[begin:end]).max() <= LOAD_LIMITS["current"]
        fell_V = top_V - voltage_V[begin - 1]  # a charge ends at the top
        is_back = fell_V > MUCH_SHARE * np.ptp(voltage_V) and top_V - highest_V < MUCH_SHARE * fell_V
        if begin and (time_s[begin] < time_s[begin - 1] or of_cell != was_of_cell or (is_back and not are_charges_logged)):
            bounds.append(int(begin))
            top_V = highest_V
        top_V = max(top_V, highest_V)
    return [*bounds, len(rows)]


def _passed_C(time_s: FloatArray, current_A: FloatArray) -> FloatArray:
    """The charge that has passed at each row, on a clock that does not go back."""
    clock_s = np.append(0.0, np.cumsum(np.maximum(np.diff(time_s), 0.0)))
    return integrate_load(clock_s, current_A, clock_s)


def _discharges(rows: pd.DataFrame, low: int, high: int) -> list[_Part]:
    """The discharges among some rows: from one charge to the next, without those before the load."""
    time_s, current_A = (rows[name].to_numpy()[low:high] for name in ("time", "current"))
    passed_C = _passed_C(time_s, current_A)
    groups: list[list[_Charge]] = [[]]
    for charge in _charges(rows[low:high], passed_C):
        groups += [[]] if charge.is_end else []
        groups[-1].append(charge)
    begins = [0, *(group[0].start for group in groups[1:]), high - low]
    parts = []
    for begin, end, charges in zip(begins, begins[1:], groups, strict=False):
        loaded = is_load(current_A[begin:end])
        if not loaded.any():
            continue
        first, before = begin + int(loaded.argmax()), slice(begin, begin)
        drawn_C = float(passed_C[first:end].max() - passed_C[first])
        for charge in charges:
            is_before = charge.stop <= (first if charge.is_braking else end)
            if is_before and passed_C[charge.start] - passed_C[charge.stop - 1] > _CHARGED_SHARE * drawn_C:
                begin, before = charge.stop, slice(charge.start, charge.stop)
        if begin < end:
            drawn_C = float(passed_C[begin:end].max() - passed_C[begin])
            parts.append(_Part(slice(low + begin, low + end), drawn_C, slice(low + before.start, low + before.stop)))
    return parts


class _Charge(NamedTuple):
    """Rows in which the cell is charged."""

    start: int
    stop: int
    is_end: bool  # of the discharge before
    is_braking: bool  # which returns less than was drawn, and ends none


def _charges(rows: pd.DataFrame, passed_C: FloatArray) -> list[_Charge]:
    """Where the cell is charged between two loads, in as many steps as there are; noise at rest is left aside."""
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    state, cycle = (rows[each].to_numpy() if each in rows else 0.0 * time_s for each in ("state", "cycle"))
    loaded = np.flatnonzero(current_A > LEAST_LOAD_SHARE * current_A.max())
    is_strong = current_A < LEAST_LOAD_SHARE * current_A.min()
    charging = np.concatenate([[False], current_A < 0.0, [False]])
    starts, ends = np.flatnonzero(~charging[:-1] & charging[1:]), np.flatnonzero(charging[:-1] & ~charging[1:])
    counts = passed_C[starts] - passed_C[ends - 1] > NOTHING_SHARE * float(np.ptp(passed_C))
    n = np.searchsorted(loaded, starts[counts])
    starts, ends = starts[counts][np.diff(n, prepend=-1) > 0], ends[counts][np.diff(n, append=len(rows) + 1) > 0]
    least_C = _CHARGED_SHARE * float((passed_C - np.minimum.accumulate(passed_C)).max())
    found, lowest_C, highest_C = [], passed_C[0], passed_C[0]
    for start, end, after in zip(starts.tolist(), ends.tolist(), np.unique(n).tolist(), strict=True):
        drawn_C, highest_C = passed_C[start] - lowest_C, max(highest_C, passed_C[start])
        returned_C = passed_C[start] - passed_C[end - 1]
        is_end = returned_C > _RETURNED_SHARE * drawn_C and highest_C - passed_C[end - 1] > least_C
        strong = start + np.flatnonzero(is_strong[start:end])  # less is an offset at rest
        if after and len(strong) and returned_C > least_C:
            before = loaded[after - 1]
            is_end |= state[strong].mean() < 0.0 or time_s[strong[0] - 1] - time_s[before] > STEADY_S
            is_end |= (cycle[loaded[after : after + 1]] != cycle[before]).any()
        is_end &= drawn_C > 0.0
        found.append(_Charge(start, end, bool(is_end), bool(not is_end and returned_C < drawn_C)))
        lowest_C = passed_C[start] if is_end else lowest_C
        if passed_C[end - 1] < lowest_C:
            lowest_C = highest_C = passed_C[end - 1]
    return found


def _charge_before(rows: pd.DataFrame, part: slice) -> ChargeBefore | None:
    """The charge that ends where a discharge begins, if it is in the table and no mere noise."""
    time_s, voltage_V, current_A = (rows[each].to_numpy()[part] for each in ("time", "voltage", "current"))
    is_noise = not (current_A < -LEAST_LOAD_SHARE * rows["current"].abs().max()).any()
    return None if is_noise else ChargeBefore.of(time_s, voltage_V, current_A)


def _recording(
    rows: pd.DataFrame, history: ChargeHistory, meta: dict[str, Any], has_own_clock: bool, origin: Origin
) -> Recording:
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    if "cycle" in rows:
        meta["cycle"] = int(rows["cycle"].iloc[int(is_load(current_A).argmax())])
    # dates of this century are more than a billion seconds after 1970, and a clock is none
    if "date" in rows and rows["date"].iloc[0] > 1e9:
        begin = datetime.fromtimestamp(float(rows["date"].iloc[0]), tz=timezone.utc)
        meta["start_time"] = begin.replace(tzinfo=None).isoformat(timespec="milliseconds")
    if "ambient" in rows and not rows["ambient"].isna().all():
        meta["ambient_temperature_C"] = float(rows["ambient"].median())
    arrays = {
        "time_s": time_s - time_s[0] if has_own_clock else time_s,
        "voltage_V": rows["voltage"].to_numpy(),
        "current_A": current_A,
        "history": _with_count(history, rows, origin) if "capacity" in rows else history,
    }
    if "temperature" in rows and not rows["temperature"].isna().all():
        temperature_C = rows.set_index("time")["temperature"].interpolate(method="index", limit_direction="both")
        arrays["temperature_C"] = temperature_C.to_numpy()
    return Recording(arrays, meta, origin)


def _with_count(history: ChargeHistory, rows: pd.DataFrame, origin: Origin) -> ChargeHistory:
    """With how much the charge under load is another one than the tester counted row by row; it may count anew with a step."""
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    loaded = np.flatnonzero(is_load(current_A))
    part = slice(loaded[0], loaded[-1] + 1)
    step_C, passed_C = np.diff(rows["capacity"].to_numpy()[part]), np.diff(integrate_load(time_s, current_A, time_s)[part])
    if len(loaded) < LEAST_SAMPLES or (step_C > 0.0).mean() < 0.5:
        return history
    goes_on = (step_C >= 0.0) & (passed_C >= 0.0) & (np.abs(np.diff(current_A[part])) <= SWITCH_SHARE * current_A.max())
    counted_Ah, passed_Ah = step_C[goes_on].sum() / 3600.0, passed_C[goes_on].sum() / 3600.0
    if abs(passed_Ah - counted_Ah) > FEW_SHARE * counted_Ah:
        told = f"the tester counted {counted_Ah:.4g} Ah, where current and time make {passed_Ah:.4g} Ah"
        if origin.leaves_open("time"):
            refuse_other_unit(counted_Ah, passed_Ah, told)
        say(f"{told}: check units and clock, and that all rows are there")
    return history._replace(is_counted=bool((step_C >= 0.0).all()), sd_counter_C=3600.0 * abs(passed_Ah - counted_Ah))
