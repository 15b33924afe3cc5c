"""Recorded discharges from files and tables of testers: the rows of each discharge, and its history."""

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
from battery_env.lab.readers.columns import FileFormat, few_of, notify, recognise
from battery_env.lab.readers.nasa import read_nasa_mat
from battery_env.lab.readers.rows import FEW_SHARE, NOTHING_SHARE, changes, refuse_other_unit, rows_of
from battery_env.lab.readers.signs import LARGE_SHARE, with_signed_current
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

Result = TypeVar("Result")

# A charge ends a discharge if it returns more than this share of the charge drawn; less is braking, unless the file marks it.
_END_CHARGE_SHARE = 0.2
# A charge before the load is cut off if it exceeds this share of the charge drawn; a smaller charge is sensor offset. A charge
# within the load ends the discharge only if it returns more than this share of the largest charge drawn, because early pulses
# return a large share of the charge so far.
_LEAST_CHARGE_SHARE = 0.02


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
    return map_usable(lambda discharge: discharge, {_name_of(source): lambda: read_recordings(source, file_format)})


def map_usable(use: Callable[[Discharge], Result], readers: Mapping[str, Callable[[], list[Recording]]]) -> list[Result]:
    """Apply a function to each discharge of some sources, given their readers; warn of failures, unless all fail."""
    results, errors = [], []
    for name, read in readers.items():
        try:
            recordings = read()
        except (OSError, TypeError, ValueError) as error:
            errors.append(error)
            continue
        for recording in recordings:
            try:
                results.append(use(recording.discharge()))
            except (TypeError, ValueError) as error:
                number = f"discharge {recording.meta['cycle']}: " if "cycle" in recording.meta else ""
                errors.append(ValueError(f"{name}: {number}{error}"))
    try:
        if not results:
            raise errors[0]
        for reason in errors:
            warnings.warn(f"It is left out: {reason}", stacklevel=3)
    finally:
        errors.clear()  # an error keeps its frame alive, and so the files of its reader
    return results


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
    """Return the discharges of a file or a table, at least one, unchecked, so that an invalid one loses no other."""
    name = _name_of(source)
    origin = Origin(name)
    lines: list[str] = []
    try:
        if not isinstance(source, pd.DataFrame) and Path(source).suffix.lower() == ".mat":
            check_mat(Path(source))
            origin = Origin(name, frozenset())
            recordings = [Recording(arrays, meta, origin) for arrays, meta in read_nasa_mat(Path(source))]
        else:
            table = open_frame(source) if isinstance(source, pd.DataFrame) else open_file(Path(source), file_format)
            header = recognise(table.names, file_format, table.rows)
            lines, origin = header.lines(), Origin(name, header.open_questions, vars(file_format))
            rows = rows_of(table.read(header.check()), header, file_format)
            if not file_format.load:  # a stated load has the right sign
                file_current_A, rows = rows["current"], with_signed_current(rows, header, file_format.discharge_is_negative)
                sign = "is negative" if (file_current_A * rows["current"]).sum() < 0.0 else "is positive"
                origin = replace(origin, open_questions=header.open_questions - {sign})
            recordings = _split(rows, origin)
        if not recordings:
            raise ValueError("there is no discharge")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {RecordError.like(error).of(origin, lines)}") from error
    return recordings


def _name_of(source: str | Path | pd.DataFrame) -> str:
    if not isinstance(source, pd.DataFrame | str | os.PathLike):
        raise TypeError(f"expected a DataFrame or the path of a file, got {type(source).__name__}")
    return TABLE if isinstance(source, pd.DataFrame) else str(source)


class _Candidate(NamedTuple):
    """Rows of a table that may be a discharge."""

    rows: slice
    drawn_C: float
    charge: slice  # the rows of the charge before, empty if there is none


def _split(rows: pd.DataFrame, origin: Origin) -> list[Recording]:
    """Return the discharges of a table, and warn of small ones that are left out."""
    candidates = [candidate for low, high in itertools.pairwise(_bounds(rows)) for candidate in _discharges(rows, low, high)]
    if not candidates:
        raise _no_discharge(rows)
    current_A, row_numbers = rows["current"].to_numpy(), rows.index + 1
    # a discharge at a current of no cell is refused later, and must not count as the largest
    plausible = [candidate for candidate in candidates if current_A[candidate.rows].max() <= LOAD_LIMITS["current"]]
    largest_C = max((candidate.drawn_C for candidate in plausible), default=0.0)
    dropped = [
        f"{drawn_C / 3600.0:.3g} Ah in rows {row_numbers[candidate.start]} to {row_numbers[candidate.stop - 1]}"
        for candidate, drawn_C, _ in candidates
        if NOTHING_SHARE**2 * largest_C < drawn_C < LOAD_SHARE * largest_C  # less is noise of a sensor
    ]
    if dropped:
        notify(f"left aside, as they draw less than {LOAD_SHARE:.0%} of the largest: {len(dropped)} ({few_of(dropped)})")
    candidates = [candidate for candidate in candidates if candidate.drawn_C >= LOAD_SHARE * largest_C]
    histories = [ChargeHistory(charge=_charge_before(rows, candidate.charge)) for candidate in candidates]
    meta: dict[str, Any] = {"source": origin.source}
    tables, is_several = [rows.iloc[candidate.rows] for candidate in candidates], len(candidates) > 1
    metas = [meta | {"cycle": number} for number in range(1, len(candidates) + 1)] if is_several else [meta]
    entries = zip(tables, histories, metas, strict=True)
    return [_recording(table, history, entry, is_several, origin) for table, history, entry in entries]


def _no_discharge(rows: pd.DataFrame) -> RecordError:
    """Return the error for rows without a discharge: a charge, if the voltage rises."""
    time_s, voltage_V, current_A = (rows[name].to_numpy() for name in REQUIRED)
    charged_Ah = -float(_net_charge_C(time_s, current_A)[-1]) / 3600.0
    start_V, end_V = voltage_V[current_A < 0.0][[0, -1]] if (current_A < 0.0).any() else (0.0, 0.0)
    if end_V > start_V:
        return RecordError(f"there is no discharge, but a charge of {charged_Ah:.4g} Ah, from {start_V:.2f} to {end_V:.2f} V")
    return RecordError("there is no discharge, as no charge is drawn: check the sign of the current", SIGNS)


def _bounds(rows: pd.DataFrame) -> list[int]:
    """Return the bounds of tests: where the number of the cycle, which may count loops, and something else change."""
    # the clock restarts, a current of no cell begins or ends, or, without logged charges, the voltage returns after its fall
    time_s, voltage_V, current_A = (rows[name].to_numpy() for name in ("time", "voltage", "current"))
    are_charges_logged = any(charge.is_end for charge in _charges(rows, _net_charge_C(time_s, current_A)))
    bounds, numbers = [0], [0, *np.flatnonzero(changes(rows, "cycle")), len(rows)]
    is_plausible, top_V = True, -np.inf
    for begin, end in itertools.pairwise(numbers):
        highest_V = voltage_V[begin:end].max()
        was_plausible, is_plausible = is_plausible, np.abs(current_A[begin:end]).max() <= LOAD_LIMITS["current"]
        fell_V = top_V - voltage_V[begin - 1]  # a charge ends at the top
        is_back = fell_V > LARGE_SHARE * np.ptp(voltage_V) and top_V - highest_V < LARGE_SHARE * fell_V
        is_restart = time_s[begin] < time_s[begin - 1] or is_plausible != was_plausible
        if begin and (is_restart or (is_back and not are_charges_logged)):
            bounds.append(int(begin))
            top_V = highest_V
        top_V = max(top_V, highest_V)
    return [*bounds, len(rows)]


def _net_charge_C(time_s: FloatArray, current_A: FloatArray) -> FloatArray:
    """Return the net charge drawn at each row, on a clock that does not go back."""
    clock_s = np.append(0.0, np.cumsum(np.maximum(np.diff(time_s), 0.0)))
    return integrate_load(clock_s, current_A, clock_s)


def _discharges(rows: pd.DataFrame, low: int, high: int) -> list[_Candidate]:
    """Return the discharges in a range of rows: from one charge to the next, without charges before the load."""
    time_s, current_A = (rows[name].to_numpy()[low:high] for name in ("time", "current"))
    net_C = _net_charge_C(time_s, current_A)
    groups: list[list[_Charge]] = [[]]
    for charge in _charges(rows[low:high], net_C):
        groups += [[]] if charge.is_end else []
        groups[-1].append(charge)
    begins = [0, *(group[0].start for group in groups[1:]), high - low]
    candidates = []
    for begin, end, charges in zip(begins, begins[1:], groups, strict=False):
        is_loaded = is_load(current_A[begin:end])
        if not is_loaded.any():
            continue
        first, charge_rows = begin + int(is_loaded.argmax()), slice(begin, begin)
        drawn_C = float(net_C[first:end].max() - net_C[first])
        for charge in charges:
            is_before = charge.stop <= (first if charge.is_braking else end)
            if is_before and net_C[charge.start] - net_C[charge.stop - 1] > _LEAST_CHARGE_SHARE * drawn_C:
                begin, charge_rows = charge.stop, slice(charge.start, charge.stop)
        if begin < end:
            drawn_C = float(net_C[begin:end].max() - net_C[begin])
            charge_rows = slice(low + charge_rows.start, low + charge_rows.stop)
            candidates.append(_Candidate(slice(low + begin, low + end), drawn_C, charge_rows))
    return candidates


class _Charge(NamedTuple):
    """Rows of a charge."""

    start: int
    stop: int
    is_end: bool  # whether it ends the discharge before
    is_braking: bool  # whether it returns less than was drawn, and ends no discharge


def _charges(rows: pd.DataFrame, net_C: FloatArray) -> list[_Charge]:
    """Return the charges between loads, which may have several steps, without noise at rest."""
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    state, cycle = (rows[name].to_numpy() if name in rows else 0.0 * time_s for name in ("state", "cycle"))
    load_rows = np.flatnonzero(current_A > LEAST_LOAD_SHARE * current_A.max())
    is_strong = current_A < LEAST_LOAD_SHARE * current_A.min()
    is_charging = np.concatenate([[False], current_A < 0.0, [False]])
    starts, ends = np.flatnonzero(~is_charging[:-1] & is_charging[1:]), np.flatnonzero(is_charging[:-1] & ~is_charging[1:])
    is_relevant = net_C[starts] - net_C[ends - 1] > NOTHING_SHARE * float(np.ptp(net_C))
    n = np.searchsorted(load_rows, starts[is_relevant])
    starts, ends = starts[is_relevant][np.diff(n, prepend=-1) > 0], ends[is_relevant][np.diff(n, append=len(rows) + 1) > 0]
    least_C = _LEAST_CHARGE_SHARE * float((net_C - np.minimum.accumulate(net_C)).max())
    charges, lowest_C, highest_C = [], net_C[0], net_C[0]
    for start, end, load_count in zip(starts.tolist(), ends.tolist(), np.unique(n).tolist(), strict=True):
        drawn_C, highest_C = net_C[start] - lowest_C, max(highest_C, net_C[start])
        returned_C = net_C[start] - net_C[end - 1]
        is_end = returned_C > _END_CHARGE_SHARE * drawn_C and highest_C - net_C[end - 1] > least_C
        strong_rows = start + np.flatnonzero(is_strong[start:end])  # smaller currents are an offset at rest
        if load_count and len(strong_rows) and returned_C > least_C:
            last_load_row = load_rows[load_count - 1]
            is_end |= state[strong_rows].mean() < 0.0 or time_s[strong_rows[0] - 1] - time_s[last_load_row] > STEADY_S
            is_end |= (cycle[load_rows[load_count : load_count + 1]] != cycle[last_load_row]).any()
        is_end &= drawn_C > 0.0
        charges.append(_Charge(start, end, bool(is_end), bool(not is_end and returned_C < drawn_C)))
        lowest_C = net_C[start] if is_end else lowest_C
        if net_C[end - 1] < lowest_C:
            lowest_C = highest_C = net_C[end - 1]
    return charges


def _charge_before(rows: pd.DataFrame, charge_rows: slice) -> ChargeBefore | None:
    """Return the charge that ends at the start of a discharge, if it is in the table and not noise."""
    time_s, voltage_V, current_A = (rows[name].to_numpy()[charge_rows] for name in ("time", "voltage", "current"))
    is_noise = not (current_A < -LEAST_LOAD_SHARE * rows["current"].abs().max()).any()
    return None if is_noise else ChargeBefore.of(time_s, voltage_V, current_A)


def _recording(
    rows: pd.DataFrame, history: ChargeHistory, meta: dict[str, Any], has_own_clock: bool, origin: Origin
) -> Recording:
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    if "cycle" in rows:
        meta["cycle"] = int(rows["cycle"].iloc[int(is_load(current_A).argmax())])
    # dates of this century are more than a billion seconds after 1970, unlike a clock
    if "date" in rows and rows["date"].iloc[0] > 1e9:
        start = datetime.fromtimestamp(float(rows["date"].iloc[0]), tz=timezone.utc)
        meta["start_time"] = start.replace(tzinfo=None).isoformat(timespec="milliseconds")
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
    """Add the difference between the charge under load and the tester's count, which may restart with a step."""
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    load_rows = np.flatnonzero(is_load(current_A))
    span = slice(load_rows[0], load_rows[-1] + 1)
    step_C = np.diff(rows["capacity"].to_numpy()[span])
    integral_C = np.diff(integrate_load(time_s, current_A, time_s)[span])
    if len(load_rows) < LEAST_SAMPLES or (step_C > 0.0).mean() < 0.5:
        return history
    is_steady = (step_C >= 0.0) & (integral_C >= 0.0) & (np.abs(np.diff(current_A[span])) <= SWITCH_SHARE * current_A.max())
    counter_Ah, integral_Ah = step_C[is_steady].sum() / 3600.0, integral_C[is_steady].sum() / 3600.0
    if abs(integral_Ah - counter_Ah) > FEW_SHARE * counter_Ah:
        problem = f"the tester counted {counter_Ah:.4g} Ah, where current and time make {integral_Ah:.4g} Ah"
        if origin.leaves_open("time"):
            refuse_other_unit(counter_Ah, integral_Ah, problem)
        notify(f"{problem}: check units and clock, and that all rows are there")
    return history._replace(is_counted=bool((step_C >= 0.0).all()), sd_counter_C=3600.0 * abs(integral_Ah - counter_Ah))
