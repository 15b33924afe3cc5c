"""
The rows of a table as a record has them: in SI units, in their order, on one clock. Three things are mended, and said: a clock
that goes back at midnight or beside dates, unusable rows, and two rows at one time. What else is odd is refused with its rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
import pandas as pd

from battery_env.arrays import BoolArray, FloatArray
from battery_env.checks import check_real
from battery_env.lab.readers.columns import Column, FileFormat, Recognised, direction, say
from battery_env.lab.readers.testers import REQUIRED
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE, switches
from battery_env.records.discharge import CLOCKS, LEAST_SAMPLES
from battery_env.records.refusals import Advice, RecordError
from battery_env.records.samples import PLAUSIBLE

#: What is worth less than this share of the charge is nothing.
NOTHING_SHARE = 1e-3
#: Of so few rows, or of so little charge, a record can do without; two clocks, or a clock and a counter, agree within it.
FEW_SHARE = 0.01
# Two rows of different steps may have the same time; the second counts as so much later, s.
_STEP_S = 1e-3
_DATES: tuple[dict[str, Any], ...] = ({"format": "ISO8601"}, {}, {"dayfirst": True})


def rows_of(table: pd.DataFrame, known: Recognised, file_format: FileFormat) -> pd.DataFrame:
    """
    The rows of a table with columns by quantity as they were written, whose index counts the rows below the header, in SI
    units, and in order; the current has the sign of the file.
    """
    rows = with_current(on_its_clock(in_si_units(table, known), known.columns), known.columns, file_format)
    return in_order(without_incomplete(rows, known.open_questions))


def place_of(rows: pd.DataFrame, which: BoolArray | pd.Series[bool], most: int = 10) -> str:
    """Some rows as a file counts them: so many stretches of them at most, and how many rows there are."""
    places = rows.index[which].to_numpy() + 1
    parts = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    named = ", ".join(f"{part[0]}" if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in parts[:most])
    more = " and others" if len(parts) > most else ""
    return f"{named}{more} ({len(places)} rows)" if len(places) > 1 else named


def in_si_units(table: pd.DataFrame, known: Recognised) -> pd.DataFrame:
    """Numbers in SI units, a column a quantity, NaN where there is none; what is not needed and cannot be read is left out."""
    found: dict[str, Any] = {}
    for quantity, column in known.columns.items():
        try:
            found[quantity] = _READ[quantity.rstrip("0123456789")](table[quantity], column)
        except Exception as error:  # pandas raises whatever a value leads it to
            what = "" if column.name in str(error) else f"the column {column.name!r} cannot be read: "
            if quantity in REQUIRED or REQUIRED[0] not in table or quantity == "cell":
                raise ValueError(f"{what}{error}") from error
            say(f"{what}{error}. It is left out")
    _check_twins(found, known.columns)
    return pd.DataFrame(found, index=table.index)


def _check_twins(found: dict[str, FloatArray], columns: Mapping[str, Column]) -> None:
    """Of columns that have equally good names for a quantity take the finest; refuse them if they are not the same."""
    for key in [each for each in found if each not in _READ]:
        quantity = key.rstrip("0123456789")
        values, others = (np.unique(found[each][np.isfinite(found[each])]) for each in (quantity, key))
        largest = np.abs(others).max(initial=0.0)
        # one of them may be rounded, or cut off
        step = np.diff(min(values, others, key=len)).min(initial=FEW_SHARE * largest)
        if not np.nanmax(np.abs(found[key] - found[quantity])) <= max(step, NOTHING_SHARE * largest):
            names = [columns[each].name for each in (quantity, key)]
            raise RecordError(
                f"both {' and '.join(map(repr, names))} may be the {quantity}, and they differ",
                [Advice(f"If it is {name!r}", "columns", {quantity: name}) for name in names],
            )
        if len(others) > len(values):
            found[quantity] = found[key]


def numbers(values: pd.Series, column: Column) -> FloatArray:
    """Numbers in SI units, NaN where there is none; refused if words stand in more than a few rows."""
    check_real(f"the column {column.name!r}", values)
    if not pd.api.types.is_numeric_dtype(values.dtype):
        found = pd.to_numeric(values.astype(object), errors="coerce").astype(np.float64)
        _check_readable(values, found.isna(), column, "numbers")
        values = found
    return column.factor * values.to_numpy(dtype=np.float64, na_value=np.nan) + column.offset


def _check_readable(values: pd.Series, is_missing: pd.Series, column: Column, what: str) -> None:
    text = values[is_missing & values.notna()].astype(str).str.strip()
    bad = text[text != ""]
    if 10 * len(bad) > values.notna().sum():
        raise ValueError(f"the column {column.name!r} must hold {what}, got {bad.iloc[0]!r} in row {bad.index[0] + 1}")


def _temperatures_C(values: pd.Series, column: Column) -> FloatArray:
    found = numbers(values, column)
    bad = found[(np.abs(found - 45.0) > 105.0) | ~found.any()]
    if len(bad):
        raise ValueError(f"the column {column.name!r} must hold temperatures (--units temperature=UNIT), got {bad[0]:g} degC")
    return found


def _cycles(values: pd.Series, column: Column) -> FloatArray:
    found = pd.Series(numbers(values, column)).ffill().bfill().to_numpy()
    # what changes every few rows is no number of cycles
    if not (found == np.round(found)).all() or LEAST_SAMPLES * (np.diff(found) != 0.0).sum() > len(found):
        raise ValueError(f"the column {column.name!r} must hold whole numbers of cycles")
    return found


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
    """Times in s, those of dates since 1970: numbers, hours:minutes:seconds, or dates; blanks, and a few words, are NaN."""
    if pd.api.types.is_datetime64_any_dtype(values.dtype) or pd.api.types.is_timedelta64_dtype(values.dtype):
        return _total_s(values)
    is_number = pd.api.types.is_numeric_dtype(values.dtype)
    text = pd.Series(dtype="string") if is_number else values.astype("string").str.strip().replace({"": pd.NA})
    if 2 * text.str.contains(":").sum() <= text.notna().sum():
        found = numbers(values, column)
        digits = len(f"{pd.Series(found).min():.0f}")
        if digits == 14:  # a date, as 20260227225000
            text = pd.Series(found).round().astype("Int64").astype("string")
            return _total_s(pd.to_datetime(text, format="%Y%m%d%H%M%S", errors="coerce"))
        # since 1970, in ms, us or ns
        return found * 10.0 ** (10 - digits) if digits in (13, 16, 19) else found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a day that is no month
        text = text.str.replace(r",(?=\d+$)", ".", regex=True)
        readings: list[pd.Series] = [pd.to_timedelta(text, errors="coerce")]
        if (readings[0] >= pd.Timedelta(0)).sum() < text.notna().sum():
            # days and dates stand before a clock as in 1-02:03:04, 1 day, 2:03:04, and 2026-02-27,22:50:00
            text = text.str.replace(r"(?<=\d)[^\d:]+(?=\d+:)", " ", n=1, regex=True)
            text = text.str.replace(r"^(\d+) (?=\d+:)", r"\1 days ", regex=True)
            readings = [pd.to_timedelta(text, errors="coerce")]
        if readings[0].isna().mean() > 0.5:
            # UTC, as the clocks of a time zone are put forward and back
            readings = [pd.to_datetime(text, utc=True, errors="coerce", **each) for each in _DATES]
    least = min(int(each.isna().sum()) for each in readings)
    found_s = [_total_s(each) for each in readings if each.isna().sum() == least]
    what = "times: numbers, hours:minutes:seconds, or dates"
    _check_readable(values, pd.Series(np.isnan(found_s[0]), values.index), column, what)
    # a day taken for a month makes a month of midnight
    return min(found_s, key=lambda time_s: float(np.abs(np.nan_to_num(np.diff(time_s))).max(initial=0.0)))


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


def on_its_clock(rows: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """With the times of the test; where these go back other than at midnight, or are not there, with the dates."""
    for clock in [each for each in ("time", "date") if each in rows]:
        step_s, day_s = rows[clock].ffill().diff(), CLOCKS["days"][1]
        is_new = (step_s < 0.0) & (step_s + day_s).between(0.0, min(2.0 * step_s.max(), 0.5 * day_s))
        if is_new.any():  # just where a day is over
            say(f"the time of day {columns[clock].name!r} passes midnight: a day more from row {place_of(rows, is_new)} on")
            rows = rows.assign(**{clock: rows[clock] + day_s * is_new.cumsum()})
    if "time" in rows and "date" in rows and _goes_back(rows, "time") and not _goes_back(rows, "date"):
        say(f"the time is {columns['date'].name!r}, as {columns['time'].name!r} goes back")
        rows = rows.drop(columns="time")
    if "time" not in rows:
        return rows.assign(time=rows["date"] - rows["date"].min())
    if "date" in rows and not (columns["time"].unit or _goes_back(rows, "time")):
        passed_s, ticks = float(np.ptp(rows["date"].dropna())), float(np.ptp(rows["time"].dropna()))
        refuse_other_unit(passed_s, ticks, f"the clock {columns['date'].name!r} passes {passed_s:g} s")
    return rows.assign(time=rows["time"] - rows["time"].min()) if rows["time"].min() > 1e8 else rows  # since 1970


def _goes_back(rows: pd.DataFrame, clock: str) -> bool:
    """Whether a clock goes back within a cycle."""
    return bool(((np.diff(rows[clock].ffill()) < 0.0) & ~changes(rows, "cycle")[1:]).any())


def refuse_other_unit(true: float, ticks: float, told: str) -> None:
    """Refuse a clock without a unit whose ticks another measure shows to be no seconds."""
    for unit, (symbol, tick_s) in CLOCKS.items():
        if tick_s != 1.0 and abs(true - tick_s * ticks) <= SWITCH_SHARE * true:
            advice = Advice(f"If the time is in {unit}, state it", "units", {"time": symbol}, "time")
            raise RecordError(f"{told}, as if the time counts {unit}: --units time={symbol}", [advice])


def with_current(rows: pd.DataFrame, columns: Mapping[str, Column], file_format: FileFormat) -> pd.DataFrame:
    """With the voltage of the cell, and with the current, of a table that holds something in its place."""
    if "counter" in rows and columns["voltage"].name.startswith("Ewe") and "Ece" not in columns["voltage"].name:
        say(f"the voltage is {columns['voltage'].name} less {columns['counter'].name}, as one electrode is no cell")
        rows = rows.assign(voltage=rows["voltage"] - rows["counter"])
    time_s, voltage_V = rows["time"], rows["voltage"]
    if file_format.load:
        times_s, loads, unit = file_format.load
        at = np.searchsorted(times_s, time_s - time_s.min(), side="right") - 1
        load = np.where(at >= 0, np.asarray(loads)[np.maximum(at, 0)], 0.0)
        return rows.assign(current=load / (voltage_V if unit == "power" else 1.0))
    if "current" in rows:
        return rows
    if "charge_step" in rows:  # which is exact, whatever voltage a power is of
        say(f"the current is the charge {columns['charge_step'].name} over the time since the row before")
        step_s = time_s.diff()
        return rows.assign(current=(rows["charge_step"] / step_s.where(step_s > 0.0)).bfill())
    say(f"the current is {columns['power'].name} over {columns['voltage'].name}, as there is no column for it")
    return rows.assign(current=rows["power"] / voltage_V.where(voltage_V > 0.0))


def without_incomplete(rows: pd.DataFrame, open_questions: Collection[str]) -> pd.DataFrame:
    """
    Without rows that hold no measurement, as blanks, titles, headers that come again, and those at the ends in which no cell
    is connected; and without a few in which the time, the voltage or the current is missing, or none that a cell has.
    """
    is_known = np.isfinite(rows[list(REQUIRED)])
    rest_A = min(REST_CURRENT_A, NOTHING_SHARE * rows["current"].abs().max())  # which a small cell yields in full
    is_no_cell = (rows["voltage"] < 0.1 * rows["voltage"].median()) & (rows["current"].abs() <= rest_A)
    is_measured = is_known.any(axis=1) & ~(is_no_cell & (is_no_cell.cummin() | is_no_cell[::-1].cummin()))
    faults = {f"the {name} is missing": ~is_known[name] & is_measured for name in REQUIRED}
    most = max(2, int(FEW_SHARE * len(rows)))
    for name, (low, high, unit) in zip(("voltage", "current"), PLAUSIBLE.values(), strict=False):
        size, is_of_cell = rows[name].abs(), rows[name].between(low, high)
        beyond = is_known[name] & ~is_of_cell
        if beyond.sum() > most and name in open_questions:  # near ones are of another unit
            beyond &= size > 10.0 * size[is_of_cell].max()
        if 10 * beyond.sum() <= len(rows):
            faults[f"the {name} lies beyond {low:g} .. {high:g} {unit}"] = beyond
    is_faulty = np.any([*faults.values()], axis=0)
    faults["there is no measurement of a cell"] = ~is_measured
    told = "; ".join(f"{fault} in row {place_of(rows, bad)}" for fault, bad in faults.items() if bad.any())
    if is_faulty.sum() > most:
        raise ValueError(f"{told}. Of {len(rows)} rows at most {most} are left out: remove these, or fill them in")
    if told:
        say(f"left out, as {told}")
    kept = rows[is_measured & ~is_faulty]
    if len(kept) < LEAST_SAMPLES:
        raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows with a time, a voltage and a current, got {len(kept)}")
    return kept


def changes(rows: pd.DataFrame, name: str) -> BoolArray:
    """Rows in which a counter differs from the row before."""
    return np.diff(rows[name], prepend=rows[name].iloc[:1]) != 0 if name in rows else np.zeros(len(rows), dtype=np.bool_)


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Of two rows at one time the second is later where the step changes or the load is switched; others are left out, if few. A
    clock that goes back is refused, but where the number of the cycle changes, which may have its own.
    """
    time_s = rows["time"].to_numpy()
    step_s = np.diff(time_s, prepend=np.nan)
    back = (step_s < 0.0) & ~changes(rows, "cycle")
    if back.any():
        first = int(np.argmax(back))
        raise ValueError(
            f"the clock goes back: row {place_of(rows, back)} is at {time_s[first]:g} s, after {time_s[first - 1]:g} s. Give "
            "the time since the start of the test, or dates in UTC. Number tests in a column of the cycle, or give each a file"
        )
    same = step_s == 0.0
    is_switched = np.isin(np.arange(len(rows)), switches(rows["current"].to_numpy()) + 1)
    later = same & (changes(rows, "step") | is_switched)
    twice = same & ~later
    if twice.sum() > max(1.0, FEW_SHARE * len(rows)):
        return rows  # which a record refuses
    if (odd := same & ~changes(rows, "step")).any():
        say(f"row {place_of(rows, odd)} has the time of the row before: later where the load is switched, else left out")
    n = np.arange(len(rows))
    return rows.assign(time=time_s + _STEP_S * (n - np.maximum.accumulate(np.where(later, 0, n))))[~twice]
