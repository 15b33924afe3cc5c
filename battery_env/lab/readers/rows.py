"""
The rows of a table as rows of a record: in SI units, in order, on one clock. The functions correct three faults, with a
warning: a clock that goes back, unusable rows, and two rows at one time. They refuse all other faults, and name the rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
import pandas as pd

from battery_env.arrays import BoolArray, FloatArray
from battery_env.checks import check_real
from battery_env.lab.readers.columns import Column, FileFormat, TableHeader, direction, few_of, notify
from battery_env.lab.readers.testers import REQUIRED
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE, switches
from battery_env.records.discharge import CLOCKS, LEAST_SAMPLES
from battery_env.records.refusals import Advice, RecordError
from battery_env.records.samples import PLAUSIBLE, SAMPLE_INTERVAL_LIMITS_S

#: A smaller share of the charge is negligible.
NOTHING_SHARE = 1e-3
#: Share of rows, or of the charge, that a record may lack; tolerance of two clocks, or of a clock and a counter.
FEW_SHARE = 0.01
_DATES: tuple[dict[str, Any], ...] = ({"format": "ISO8601"}, {}, {"dayfirst": True})


def rows_of(table: pd.DataFrame, header: TableHeader, file_format: FileFormat) -> pd.DataFrame:
    """Return the rows of a table with columns by quantity in SI units and in order, with the file's sign of the current."""
    rows = with_current(with_clock(in_si_units(table, header), header.columns), header.columns, file_format)
    return in_order(without_incomplete(rows, header.open_questions))


def place_of(rows: pd.DataFrame, selection: BoolArray | pd.Series[bool]) -> str:
    """Return rows as text, in the file's count: the first runs, and the number of rows."""
    row_numbers = rows.index[selection].to_numpy() + 1
    runs = np.split(row_numbers, np.flatnonzero(np.diff(row_numbers) > 1) + 1)
    text = few_of([f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs])
    return f"{text} ({len(row_numbers)} rows)" if len(row_numbers) > 1 else text


def in_si_units(table: pd.DataFrame, header: TableHeader) -> pd.DataFrame:
    """Return numbers in SI units by quantity, NaN where missing, without unreadable columns that a record does not need."""
    columns: dict[str, Any] = {}
    for quantity, column in header.columns.items():
        try:
            columns[quantity] = _READ[quantity.rstrip("0123456789")](table[quantity], column)
        except Exception as error:  # pandas raises errors of many types
            prefix = "" if column.name in str(error) else f"the column {column.name!r} cannot be read: "
            if quantity in REQUIRED or REQUIRED[0] not in table or quantity == "cell":
                raise ValueError(f"{prefix}{error}") from error
            notify(f"{prefix}{error}. It is left out")
    _check_twins(columns, header.columns)
    return pd.DataFrame(columns, index=table.index)


def _check_twins(values: dict[str, FloatArray], columns: Mapping[str, Column]) -> None:
    """Of columns whose names suit a quantity equally well keep the finest; refuse columns that differ."""
    for key in [name for name in values if name not in _READ]:
        quantity = key.rstrip("0123456789")
        first, second = (np.unique(values[name][np.isfinite(values[name])]) for name in (quantity, key))
        largest = np.abs(second).max(initial=0.0)
        # either column may be rounded, or cut off
        step = np.diff(min(first, second, key=len)).min(initial=FEW_SHARE * largest)
        if not np.nanmax(np.abs(values[key] - values[quantity])) <= max(step, NOTHING_SHARE * largest):
            names = [columns[name].name for name in (quantity, key)]
            raise RecordError(
                f"both {' and '.join(map(repr, names))} may be the {quantity}, and they differ",
                [Advice(f"If it is {name!r}", "columns", {quantity: name}) for name in names],
            )
        if len(second) > len(first):
            values[quantity] = values[key]


def numbers(values: pd.Series, column: Column) -> FloatArray:
    """Return numbers in SI units, NaN where missing; refuse words in more than a few rows."""
    check_real(f"the column {column.name!r}", values)
    if not pd.api.types.is_numeric_dtype(values.dtype):
        parsed = pd.to_numeric(values.astype(object), errors="coerce").astype(np.float64)
        _check_readable(values, parsed.isna(), column, "numbers")
        values = parsed
    return column.factor * values.to_numpy(dtype=np.float64, na_value=np.nan) + column.offset


def _check_readable(values: pd.Series, is_missing: pd.Series, column: Column, content: str) -> None:
    text = values[is_missing & values.notna()].astype(str).str.strip()
    invalid = text[text != ""]
    if 10 * len(invalid) > values.notna().sum():
        row = invalid.index[0] + 1
        raise ValueError(f"the column {column.name!r} must hold {content}, got {invalid.iloc[0]!r} in row {row}")


def _temperatures_C(values: pd.Series, column: Column) -> FloatArray:
    read_C = numbers(values, column)
    bad_C = read_C[(np.abs(read_C - 45.0) > 105.0) | ~read_C.any()]
    if len(bad_C):
        raise ValueError(
            f"the column {column.name!r} must hold temperatures (--units temperature=UNIT), got {bad_C[0]:g} degC"
        )
    return read_C


def _cycles(values: pd.Series, column: Column) -> FloatArray:
    cycles = pd.Series(numbers(values, column)).ffill().bfill().to_numpy()
    # a number that changes every few rows is no number of a cycle
    if not (cycles == np.round(cycles)).all() or LEAST_SAMPLES * (np.diff(cycles) != 0.0).sum() > len(cycles):
        raise ValueError(f"the column {column.name!r} must hold whole numbers of cycles")
    return cycles


def _steps(values: pd.Series, column: Column) -> FloatArray:
    return pd.factorize(values)[0].astype(np.float64)


def _directions(values: pd.Series, column: Column) -> FloatArray:
    codes, names = pd.factorize(values)
    return np.array([*map(direction, names), 0], dtype=np.float64)[codes]


def _one_cell(values: pd.Series, column: Column) -> FloatArray:
    names = values.dropna().astype(str).str.strip()
    cells = names[names != ""].unique()
    if len(cells) > 1:
        raise RecordError(
            f"{column.name!r} names {len(cells)} cells ({', '.join(cells[:3])}): give each a file, or in Python a table",
            [Advice("If they are one, leave the column out", "ignore", [column.name])],
        )
    return np.zeros(len(values))


def seconds(values: pd.Series, column: Column) -> FloatArray:
    """Return times in s, of dates since 1970, from numbers, hours:minutes:seconds, or dates; NaN for blanks and few words."""
    if pd.api.types.is_datetime64_any_dtype(values.dtype) or pd.api.types.is_timedelta64_dtype(values.dtype):
        return _total_s(values)
    is_number = pd.api.types.is_numeric_dtype(values.dtype)
    text = pd.Series(dtype="string") if is_number else values.astype("string").str.strip().replace({"": pd.NA})
    if 2 * text.str.contains(":").sum() <= text.notna().sum():
        times = numbers(values, column)
        digits = len(f"{pd.Series(times).min():.0f}")
        if digits == 14:  # a date, as 20260227225000
            text = pd.Series(times).round().astype("Int64").astype("string")
            return _total_s(pd.to_datetime(text, format="%Y%m%d%H%M%S", errors="coerce"))
        # since 1970, in ms, us or ns
        return times * 10.0 ** (10 - digits) if digits in (13, 16, 19) else times
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandas warns of a day that is no month
        text = text.str.replace(r",(?=\d+$)", ".", regex=True)
        parsed: list[pd.Series] = [pd.to_timedelta(text, errors="coerce")]
        if (parsed[0] >= pd.Timedelta(0)).sum() < text.notna().sum():
            # days and dates before a clock, as in 1-02:03:04, 1 day, 2:03:04, and 2026-02-27,22:50:00
            text = text.str.replace(r"(?<=\d)[^\d:]+(?=\d+:)", " ", n=1, regex=True)
            text = text.str.replace(r"^(\d+) (?=\d+:)", r"\1 days ", regex=True)
            parsed = [pd.to_timedelta(text, errors="coerce")]
        if parsed[0].isna().mean() > 0.5:
            # UTC, because the clocks of a time zone jump twice a year
            parsed = [pd.to_datetime(text, utc=True, errors="coerce", **candidate) for candidate in _DATES]
    fewest_missing = min(int(candidate.isna().sum()) for candidate in parsed)
    candidates_s = [_total_s(candidate) for candidate in parsed if candidate.isna().sum() == fewest_missing]
    content = "times: numbers, hours:minutes:seconds, or dates"
    _check_readable(values, pd.Series(np.isnan(candidates_s[0]), values.index), column, content)
    # a day read as a month makes a jump of a month at midnight
    return min(candidates_s, key=lambda time_s: float(np.abs(np.nan_to_num(np.diff(time_s))).max(initial=0.0)))


def _total_s(times: pd.Series) -> FloatArray:
    if pd.api.types.is_datetime64_any_dtype(times.dtype):
        times = times - pd.Timestamp(0, tz=times.dt.tz)
    return times.dt.total_seconds().to_numpy(dtype=np.float64)


_READ: dict[str, Callable[[pd.Series, Column], FloatArray]] = {
    **dict.fromkeys(("time", "date"), seconds),
    **dict.fromkeys(("voltage", "counter", "current", "power", "charge_step", "capacity"), numbers),
    **dict.fromkeys(("temperature", "ambient"), _temperatures_C),
    "cycle": _cycles,
    "step": _steps,
    "cell": _one_cell,
    "state": _directions,
}


def with_clock(rows: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Add the clock of the test, or the dates if this clock is missing or goes back other than at midnight."""
    for clock in [name for name in ("time", "date") if name in rows]:
        step_s, day_s = rows[clock].ffill().diff(), CLOCKS["days"][1]
        is_new = (step_s < 0.0) & (step_s + day_s).between(0.0, min(2.0 * step_s.max(), 0.5 * day_s))
        if is_new.any():  # a day is over here
            notify(f"the time of day {columns[clock].name!r} passes midnight: a day more from row {place_of(rows, is_new)} on")
            rows = rows.assign(**{clock: rows[clock] + day_s * is_new.cumsum()})
    if "time" in rows and "date" in rows and _goes_back(rows, "time") and not _goes_back(rows, "date"):
        notify(f"the time is {columns['date'].name!r}, as {columns['time'].name!r} goes back")
        rows = rows.drop(columns="time")
    if "time" not in rows:
        return rows.assign(time=rows["date"] - rows["date"].min())
    if "date" in rows and not (columns["time"].unit or _goes_back(rows, "time")):
        elapsed_s, ticks = float(np.ptp(rows["date"].dropna())), float(np.ptp(rows["time"].dropna()))
        refuse_other_unit(elapsed_s, ticks, f"the clock {columns['date'].name!r} passes {elapsed_s:g} s")
    return rows.assign(time=rows["time"] - rows["time"].min()) if rows["time"].min() > 1e8 else rows  # since 1970


def _goes_back(rows: pd.DataFrame, clock: str) -> bool:
    """Whether a clock goes back within a cycle."""
    return bool(((np.diff(rows[clock].ffill()) < 0.0) & ~changes(rows, "cycle")[1:]).any())


def refuse_other_unit(expected: float, ticks: float, observation: str) -> None:
    """Refuse a clock without a unit if another measurement shows that its ticks are no seconds."""
    for unit, (symbol, tick_s) in CLOCKS.items():
        if tick_s != 1.0 and abs(expected - tick_s * ticks) <= SWITCH_SHARE * expected:
            advice = Advice(f"If the time is in {unit}, state it", "units", {"time": symbol}, "time")
            raise RecordError(f"{observation}, as if the time counts {unit}: --units time={symbol}", [advice])


def with_current(rows: pd.DataFrame, columns: Mapping[str, Column], file_format: FileFormat) -> pd.DataFrame:
    """Add the voltage of the cell, and the current, from columns that replace these."""
    if "counter" in rows and columns["voltage"].name.startswith("Ewe") and "Ece" not in columns["voltage"].name:
        notify(f"the voltage is {columns['voltage'].name} less {columns['counter'].name}, as one electrode is no cell")
        rows = rows.assign(voltage=rows["voltage"] - rows["counter"])
    time_s, voltage_V = rows["time"], rows["voltage"]
    if file_format.load:
        times_s, loads, unit = file_format.load
        segment = np.searchsorted(times_s, time_s - time_s.min(), side="right") - 1
        load = np.where(segment >= 0, np.asarray(loads)[np.maximum(segment, 0)], 0.0)
        return rows.assign(current=load / (voltage_V if unit == "power" else 1.0))
    if "current" in rows:
        return rows
    if "charge_step" in rows:  # exact, whereas a power needs the voltage
        notify(f"the current is the charge {columns['charge_step'].name} over the time since the row before")
        step_s = time_s.diff()
        return rows.assign(current=(rows["charge_step"] / step_s.where(step_s > 0.0)).bfill())
    notify(f"the current is {columns['power'].name} over {columns['voltage'].name}, as there is no column for it")
    return rows.assign(current=rows["power"] / voltage_V.where(voltage_V > 0.0))


def without_incomplete(rows: pd.DataFrame, open_questions: Collection[str]) -> pd.DataFrame:
    """Drop rows without a measurement, or at the ends without a cell, and a few with a missing or implausible value."""
    has_value = np.isfinite(rows[list(REQUIRED)])
    rest_A = min(REST_CURRENT_A, NOTHING_SHARE * rows["current"].abs().max())  # a small cell may draw less than REST_CURRENT_A
    is_no_cell = (rows["voltage"] < 0.1 * rows["voltage"].median()) & (rows["current"].abs() <= rest_A)
    is_measured = has_value.any(axis=1) & ~(is_no_cell & (is_no_cell.cummin() | is_no_cell[::-1].cummin()))
    faults = {f"the {name} is missing": ~has_value[name] & is_measured for name in REQUIRED}
    max_rows = max(2, int(FEW_SHARE * len(rows)))
    for name, (low, high, unit) in zip(("voltage", "current"), PLAUSIBLE.values(), strict=False):
        size, is_of_cell = rows[name].abs(), rows[name].between(low, high)
        is_beyond = has_value[name] & ~is_of_cell
        if is_beyond.sum() > max_rows and name in open_questions:  # values near the limits have another unit
            is_beyond &= size > 10.0 * size[is_of_cell].max()
        if 10 * is_beyond.sum() <= len(rows):
            faults[f"the {name} lies beyond {low:g} .. {high:g} {unit}"] = is_beyond
    is_faulty = np.any([*faults.values()], axis=0)
    faults["there is no measurement of a cell"] = ~is_measured
    problem = "; ".join(f"{fault} in row {place_of(rows, mask)}" for fault, mask in faults.items() if mask.any())
    if is_faulty.sum() > max_rows:
        raise ValueError(f"{problem}. Of {len(rows)} rows at most {max_rows} are left out: remove these, or fill them in")
    if problem:
        notify(f"left out, as {problem}")
    complete = rows[is_measured & ~is_faulty]
    if len(complete) < LEAST_SAMPLES:
        raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows with a time, a voltage and a current, got {len(complete)}")
    return complete


def changes(rows: pd.DataFrame, name: str) -> BoolArray:
    """Return the rows in which a counter differs from the previous row."""
    return np.diff(rows[name], prepend=rows[name].iloc[:1]) != 0 if name in rows else np.zeros(len(rows), dtype=np.bool_)


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Order rows at one time, or drop a few of them; refuse a clock that goes back, except where the cycle changes."""
    time_s = rows["time"].to_numpy()
    step_s = np.diff(time_s, prepend=np.nan)
    goes_back = (step_s < 0.0) & ~changes(rows, "cycle")
    if goes_back.any():
        row = int(np.argmax(goes_back))
        raise ValueError(
            f"the clock goes back: row {place_of(rows, goes_back)} is at {time_s[row]:g} s, after {time_s[row - 1]:g} s. Give "
            "the time since the start of the test, or dates in UTC. Number tests in a column of the cycle, or give each a file"
        )
    is_same_time = step_s == 0.0
    is_switched = np.isin(np.arange(len(rows)), switches(rows["current"].to_numpy()) + 1)
    is_later = is_same_time & (changes(rows, "step") | is_switched)
    is_repeated = is_same_time & ~is_later
    if is_repeated.sum() > max(1.0, FEW_SHARE * len(rows)):
        return rows  # a record refuses these
    if (is_odd := is_same_time & ~changes(rows, "step")).any():
        notify(f"row {place_of(rows, is_odd)} has the time of the row before: later where the load is switched, else left out")
    n = np.arange(len(rows))
    later_s = SAMPLE_INTERVAL_LIMITS_S[0] * (n - np.maximum.accumulate(np.where(is_later, 0, n)))
    return rows.assign(time=time_s + later_s)[~is_repeated]
