"""
The rows of a table as a record has them: in SI units, in their order, on one clock, and with the current of a discharge
positive. Each step is a function from table to table that is named after what it mends. What is mended is said; what is not
clear enough to mend is refused.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import pandas as pd

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.readers.columns import REQUIRED, Column, FileFormat, direction
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE
from battery_env.records.discharge import CLOCKS, LEAST_SAMPLES

# How plain the sign of the current must be: the share of its jumps with which the voltage jumps, less that of the others; or
# the correlation of the voltage with the charge that has passed.
_CLEAR = 0.5
# Below the current at which other cells rest, a voltage that changes by so much is that of a coin cell under load, V.
_COIN_FALL_V = 0.1
# What is worth less than this share of the charge is mended; of two columns that differ by less either may be taken.
_NOTHING_SHARE = 1e-3
# So few of the rows may be out of time.
_FEW_SHARE = 0.01
# A stretch that passes more than this share of the largest charge, and in which the voltage rises by more than this share of
# its range, is a charge.
_LONG_SHARE = 0.25
# Two rows of different steps may have the same time; the second counts as so much later, s.
_STEP_S = 1e-3
# What a clock may count in, s.
_TICKS_S = (3600.0, 60.0, 1.0, 0.1, 0.01)
# Numbers from here on may be dates in digits, as 20260227225000.
_LEAST_DATE = 1e13
_DAY_S = CLOCKS["days"][1]
# What is so many times what is usual is not usual.
_MANY_TIMES = 3.0
# No cell has a voltage below this share of what the record mostly shows.
_DEAD_SHARE = 0.1
# Temperatures that a cell may have, degC.
_TEMPERATURES_C = (-60.0, 150.0)
# Fractions behind a comma or a colon, days as in 1-02:03:04, 1.02:03:04, 1 day, 2:03:04, and of workbooks, which count from
# 1900 on, and dates alone, which are midnight.
_AS_CLOCKS = {
    r"(?<=\d),(?=\d)|(?<=:\d\d:\d\d):(?=\d{3}$)": ".",
    r"^(?:1900-01-(\d+)[ T]|(\d+)(?:[-.]| days?,? ))(?=\d+:)": r"\1\2 days ",
    r"^(\d+([-./])\d+\2\d+)$": r"\1 00:00:00",
}
_BEGINS_AS_NUMBER = re.compile(r"\s*[-+.,]*\d")
_THOUSANDS = re.compile(r"^\s*[-+]?\d{1,3}(?:[,.' ]\d{3})+(?:[.,]\d+)?\s*$")


def cells_of(table: pd.DataFrame, columns: Mapping[str, Column]) -> dict[str, pd.DataFrame]:
    """
    The rows of each cell, of a table with columns by quantity as they were written, whose index counts the rows below the
    header; the name is empty where the table holds one cell.
    """
    for mend in (without_blank_rows, without_words, without_cut_line):
        table = mend(table, columns)
    if len(table) < LEAST_SAMPLES:
        raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows below the header, got {len(table)}")
    named = table["cell"].astype("string") if "cell" in table else pd.Series("", index=table.index)
    cells = named.ffill().bfill().fillna("").astype(str)
    if cells.nunique() == 1 or cells.value_counts().min() < LEAST_SAMPLES:
        return {"": table}
    return {name: table[cells == name] for name in cells.unique()}


def mended(table: pd.DataFrame, columns: Mapping[str, Column], file_format: FileFormat) -> pd.DataFrame:
    """The rows of a cell in SI units, and in order."""
    rows = in_si_units(table, columns)
    for mend in (
        without_dead_ends,
        without_missing,
        with_newest_last,
        over_midnight,
        without_repeated,
        on_one_clock,
        with_clock_going_on,
        with_tests_apart,
        with_steps_apart,
        without_rows_out_of_time,
    ):
        rows = mend(rows)
    return with_signed_current(rows, columns, file_format.discharge_is_negative)


def _say(text: str) -> None:
    warnings.warn(text, stacklevel=3)


def without_blank_rows(table: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Without rows that hold no measurement at all."""
    return table[~table[_measured(table)].isna().all(axis=1)]


def without_words(table: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Without rows of words in place of the time, where few places have such: titles, summaries, headers that come again."""
    time, measured = table["time"], _measured(table)
    is_text = pd.api.types.is_object_dtype(time.dtype) or pd.api.types.is_string_dtype(time.dtype)
    is_time = time.astype(str).str.match(_BEGINS_AS_NUMBER) if is_text else time.notna()
    if is_time.all() or not is_time.mean() > 0.5:
        return table
    # what stands among them and is no measurement either, as the number of a cell, is none of a row
    others = table[[each for each in measured if "time" not in each]].apply(pd.to_numeric, errors="coerce").isna().all(axis=1)
    words = ~is_time & (time.notna() | others)
    nothing = words | others
    block = (nothing != nothing.shift()).cumsum()
    nothing &= words.groupby(block).transform("any")
    if not nothing.any() or block[nothing].nunique() > max(1.0, SWITCH_SHARE * len(table)):
        return table
    text = str(table.loc[words, measured].iloc[0].dropna().iloc[0]).strip()
    _say(f"left out, as words stand for the time: row {_place(table, nothing.to_numpy())}, {text!r}")
    kept = table[~nothing].copy()
    for name in measured:
        with suppress(ValueError, TypeError):  # words among numbers made text of all
            kept[name] = pd.to_numeric(kept[name])
    return kept


def without_cut_line(table: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Without the last line where it is incomplete, as in a file that is being written."""
    last = table.tail(2)
    values = [last[each] if "time" in each else pd.to_numeric(last[each], errors="coerce") for each in _measured(table)]
    # what the row before does not hold either is no matter of the end
    if any(each.isna().iloc[-1] and each.notna().iloc[0] for each in values):
        _say(f"the last line, row {last.index[-1] + 1}, is incomplete, and left out")
        return table.iloc[:-1]
    return table


def _measured(table: pd.DataFrame) -> list[str]:
    return [each for each in map(str, table) if each.partition(" ")[0] in (*REQUIRED, "power", "charge_step")]


def _place(table: pd.DataFrame, which: BoolArray) -> str:
    """The first of some rows as a file counts them, and how many more there are."""
    places = table.index[which]
    return f"{places[0] + 1}" + (f" and {len(places) - 1} more" if len(places) > 1 else "")


def in_si_units(table: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """
    Numbers in SI units, one column a quantity. Of those that agree the finest is taken. One that is not needed and cannot be
    read is left out.
    """
    found: dict[str, Any] = {quantity: _finest(table, columns, quantity) for quantity in REQUIRED if quantity in table}
    for quantity, read in _OTHERS.items():
        if quantity in table:
            try:
                found[quantity] = read(table[quantity], columns[quantity])
            except ValueError as error:
                if quantity in _measured(table):
                    raise
                _say(f"{error}. It is left out")
    if "step" in table:
        found["step"] = pd.factorize(table["step"])[0]
    for key in [key for key in columns if key.partition(" ")[0] == "state"]:
        directions = _directions(table[key])
        if {1, -1} <= set(directions):
            found.setdefault("direction", directions)
    rows = pd.DataFrame(found, index=table.index)
    tick_s = _tick_of_clock(table, rows, columns)
    for name in {"time", "step_time"} & set(rows):
        rows[name] *= tick_s if pd.api.types.is_numeric_dtype(table[name].dtype) and not columns[name].unit else 1.0
    if "counter" in rows and columns["voltage"].words == "ewe":
        _say(f"the voltage is {columns['voltage'].name} less {columns['counter'].name}, as one electrode is no cell")
        rows["voltage"] -= rows["counter"]
    if "current" not in rows:
        rows["current"] = _current(rows, columns)
    return rows.drop(columns=["counter", "power", "charge_step"], errors="ignore")


def _current(rows: pd.DataFrame, columns: Mapping[str, Column]) -> pd.Series:
    """The current of a table that holds something in its place; a charge is exact, whatever voltage a power is of."""
    if "charge_step" in rows:
        _say(f"the current is the charge {columns['charge_step'].name} over the time since the row before")
        step_s = rows["time"].diff()
        return (rows["charge_step"] / step_s.where(step_s > 0.0)).bfill()
    _say(f"the current is {columns['power'].name} over {columns['voltage'].name}, as there is no column for it")
    return rows["power"] / rows["voltage"].where(rows["voltage"] > 0.0)


def _directions(states: pd.Series) -> IntArray:
    codes, names = pd.factorize(states)
    return np.array([*map(direction, names), 0])[codes]


def _finest(table: pd.DataFrame, columns: Mapping[str, Column], quantity: str) -> FloatArray:
    """The column of a quantity. Clocks of other names are asked only if the first one has one time twice, or goes back."""
    column = columns[quantity]
    read = seconds if quantity == "time" else numbers
    best = read(table[quantity], column)
    for key in [key for key in columns if key.startswith(f"{quantity} ")]:
        other = columns[key]
        if other.words != column.words and (np.diff(best) > 0.0).all():
            break
        try:
            values = read(table[key], other)
        except ValueError:
            continue
        is_finer = len(np.unique(values)) > len(np.unique(best))
        if _agree(best, values, quantity):
            best = values if is_finer else best
        elif quantity == "time" and (refined_s := _refined(best, values)) is not None:
            best = refined_s
        elif _goes_on_where(values, best):
            _say(f"the time is {other.name!r}, as {column.name!r} goes back")
            best = values
        elif other.words == column.words:
            raise ValueError(
                f"both {column.name!r} and {other.name!r} may be the {quantity}. Say which it is: --columns {quantity}=NAME "
                "(Python: columns)"
            )
        elif is_finer:
            _say(f"the time is {column.name!r}; {other.name!r} tells more rows apart, but is another clock")
    return best


def _refined(coarse_s: FloatArray, fine_s: FloatArray) -> FloatArray | None:
    """A coarse clock as a finer one tells it that starts anew, and agrees with it from each start to the next."""
    ticks_s, part = np.diff(np.unique(coarse_s)), np.cumsum(np.diff(fine_s, prepend=fine_s[:1]) < 0.0)
    if not len(ticks_s) or not part[-1]:
        return None
    off_s = pd.Series(coarse_s - fine_s).groupby(part)
    low_s, high_s = off_s.transform("min").to_numpy(), off_s.transform("max").to_numpy()
    refined_s = fine_s + 0.5 * (low_s + high_s)
    is_finer = (np.diff(refined_s) > 0.0).sum() > (np.diff(coarse_s) > 0.0).sum() and (np.diff(refined_s) >= 0.0).all()
    return refined_s if is_finer and (high_s - low_s <= (1.0 + _NOTHING_SHARE) * ticks_s.min()).all() else None


def _goes_on_where(other_s: FloatArray, time_s: FloatArray) -> bool:
    """Whether a clock goes on where another one goes back, and tells as many rows apart."""
    other, this = np.diff(other_s), np.diff(time_s)
    return bool((other >= 0.0).all() and (this < 0.0).any() and (other <= 0.0).sum() <= (this <= 0.0).sum())


def _tick_of_clock(table: pd.DataFrame, rows: pd.DataFrame, columns: Mapping[str, Column]) -> float:
    """
    What a clock counts in whose name has no unit, s, where something beside it tells: dates, days as spreadsheets count, or
    the charge that the tester counted.
    """
    clock, ends = columns["time"], table["time"].iloc[[0, -1]]
    if clock.unit or not pd.api.types.is_numeric_dtype(ends.dtype) or not table["time"].is_monotonic_increasing:
        return 1.0
    ticks, told = np.ptp(numbers(ends, clock)), []
    for key in [key for key in columns if key.startswith("time ")]:
        try:
            span_s = np.ptp(seconds(table[key].iloc[[0, -1]], columns[key]))
        except ValueError:
            continue
        if pd.api.types.is_numeric_dtype(table[key].dtype) and not columns[key].unit:
            if abs(span_s - ticks) <= _NOTHING_SHARE * ticks:
                continue  # both count the same
            span_s *= _DAY_S
        # dates count whole seconds
        told.append((key, span_s, 1.0 + _NOTHING_SHARE * span_s))
    if "capacity" in rows and "current" in rows and columns["current"].unit:
        step_C, passed_C = np.diff(rows["capacity"]), np.diff(rows["time"]) * rows["current"].to_numpy()[1:]
        # a counter may count down, and what is drawn alone
        counted_C, for_C = max(
            ((way * step_C).clip(0.0) @ (sign * passed_C > 0.0), (sign * passed_C).clip(0.0).sum())
            for way, sign in itertools.product((1.0, -1.0), repeat=2)
        )
        if counted_C > 0.0:
            told.append(("capacity", counted_C / for_C * ticks, SWITCH_SHARE * counted_C / for_C * ticks))
    for key, span_s, tolerance_s in told:
        for unit, (_, tick_s) in CLOCKS.items():
            if abs(span_s - tick_s * ticks) <= tolerance_s:
                if tick_s != 1.0:
                    _say(f"{clock.name!r} counts {unit}, as {columns[key].name!r} tells")
                return tick_s
    return 1.0


def _agree(one: FloatArray, other: FloatArray, quantity: str) -> bool:
    """Whether two columns say the same; clocks do to what the coarser one counts in."""
    tolerance = _NOTHING_SHARE * float(np.nanmax(np.abs(one), initial=0.0))
    if quantity == "time":
        one, other = one - one[0], other - other[0]
        tolerance = max(_tick_s(one), _tick_s(other))
    return bool(np.nanmax(np.abs(one - other), initial=0.0) <= tolerance)


def _tick_s(time_s: FloatArray) -> float:
    """What a clock counts in."""
    return next((tick_s for tick_s in _TICKS_S if np.allclose(time_s / tick_s, np.round(time_s / tick_s), 0.0, 1e-3)), _STEP_S)


def numbers(values: pd.Series, column: Column) -> FloatArray:
    """Numbers in SI units."""
    if pd.api.types.is_numeric_dtype(values.dtype):
        return column.factor * values.to_numpy(dtype=np.float64, na_value=np.nan) + column.offset
    found = pd.to_numeric(values, errors="coerce")
    bad = values[found.isna() & values.notna() & (values.astype(str).str.strip() != "")]
    if len(bad):
        advice, thousands = "", bad[bad.astype(str).str.match(_THOUSANDS)]
        if len(thousands):
            advice, bad = ". Write numbers without separators of thousands", thousands
        text = str(bad.iloc[0])
        raise ValueError(f"the column {column.name!r} must hold numbers, got {text!r} in row {bad.index[0] + 1}{advice}")
    return column.factor * found.to_numpy(dtype=np.float64) + column.offset


def _temperatures_C(values: pd.Series, column: Column) -> FloatArray:
    found = numbers(values, column)
    if not found.any():
        raise ValueError(f"the column {column.name!r} holds 0 in all rows, as without a sensor")
    low_C, high_C = _TEMPERATURES_C
    bad = np.flatnonzero((found < low_C) | (found > high_C))
    if len(bad):
        kelvin = found - ZERO_CELSIUS_K
        is_kelvin = not column.unit and bool(((kelvin >= low_C) & (kelvin <= high_C)).all())
        advice = ": if it is in kelvin, --units temperature=K says so" if is_kelvin else ""
        raise ValueError(f"the column {column.name!r} must hold temperatures, got {found[bad[0]]:g} degC{advice}")
    return found


def _cycles(values: pd.Series, column: Column) -> FloatArray:
    found = numbers(values, column)
    if not (np.isfinite(found).all() and (found == np.round(found)).all()):
        raise ValueError(f"the column {column.name!r} must hold whole numbers of cycles")
    return found


def seconds(values: pd.Series, column: Column) -> FloatArray:
    """Numbers in their unit; a clock, hours:minutes:seconds, in seconds; dates in seconds since the earliest one."""
    if pd.api.types.is_numeric_dtype(values.dtype):
        if not values.min() >= _LEAST_DATE:
            return numbers(values, column)
        dates = pd.to_datetime((values // 1).astype("Int64").astype("string"), format="%Y%m%d%H%M%S", errors="coerce")
        return numbers(values, column) if dates.isna().any() else seconds(dates, column)
    if pd.api.types.is_datetime64_any_dtype(values.dtype):
        return (values - values.min()).dt.total_seconds().to_numpy(dtype=np.float64)
    if pd.api.types.is_timedelta64_dtype(values.dtype):
        return values.dt.total_seconds().to_numpy(dtype=np.float64)
    lines = "\n".join(map(str.strip, values.astype(str)))
    for pattern, clock in _AS_CLOCKS.items() if ":" in lines else ():
        lines = re.sub(pattern, clock, lines, flags=re.MULTILINE)
    text = pd.Series(lines.split("\n"), index=values.index)
    if not text[values.notna()].str.contains(":").all():
        return numbers(values, column)
    # UTC, as the clocks of a time zone are put forward and back
    readings: tuple[tuple[Callable[..., Any], dict[str, Any]], ...] = (
        (pd.to_timedelta, {}),
        (pd.to_datetime, {"format": "ISO8601", "utc": True}),
        (pd.to_datetime, {"utc": True}),
        (pd.to_datetime, {"utc": True, "dayfirst": True}),
    )
    found: list[FloatArray] = []
    for convert, options in readings:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a day that is no month, and of each row with one
                found.append(seconds(pd.Series(convert(text, **options), index=values.index), column))
        except ValueError:
            continue
        if "utc" not in options or "format" in options:
            break
    if not found:
        raise ValueError(
            f"the column {column.name!r} must hold times: numbers, hours:minutes:seconds, or dates; got "
            f"{str(values.iloc[0])!r}"
        )
    # a day taken for a month makes a month of midnight
    return min(found, key=lambda time_s: float(np.abs(np.nan_to_num(np.diff(time_s))).max(initial=0.0)))


_OTHERS: dict[str, Callable[[pd.Series, Column], FloatArray]] = {
    "temperature": _temperatures_C,
    "ambient": _temperatures_C,
    "cycle": _cycles,
    "step_time": seconds,
    "power": numbers,
    "charge_step": numbers,
    "counter": numbers,
    "capacity": numbers,
}


def without_dead_ends(rows: pd.DataFrame) -> pd.DataFrame:
    """Without rows at the ends in which no cell was connected."""
    dead = (rows["voltage"] < _DEAD_SHARE * rows["voltage"].median()) & (rows["current"].abs() <= REST_CURRENT_A)
    ends = dead & (dead.cummin() | dead[::-1].cummin())
    if ends.any() and not ends.all():
        at = int(np.argmax(ends))
        _say(f"row {_place(rows, ends.to_numpy())} is left out: {rows['voltage'].iloc[at]:g} V without a current is no cell")
        return rows[~ends]
    return rows


def without_missing(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Without rows in which the voltage or the current is missing, if they are few, and what they drew is known but for little:
    of a voltage it is, and of a current it is in doubt.
    """
    known = {name: np.isfinite(rows[name].to_numpy()) for name in REQUIRED}
    kept = np.logical_and.reduce([*known.values()])
    if kept.all():
        return rows
    place, current_A = np.arange(len(rows)), np.where(known["current"], rows["current"], 0.0)
    beside_A = np.interp(place, place[kept], current_A[kept]) if kept.any() else current_A
    worth_C = np.where(kept, 0.0, np.abs(current_A - beside_A) * np.abs(np.gradient(rows["time"])))
    is_little = worth_C.sum() / 3.0**0.5 <= _FEW_SHARE * _passed_C(rows[kept])
    for name, is_known in known.items():
        if not is_known.all():
            n = int(np.argmin(is_known))
            if name == "time" or not is_little or (~kept).sum() > SWITCH_SHARE * len(rows):
                got = rows[name].iloc[n]
                raise ValueError(f"the {name} must be finite, got {got} in row {rows.index[n] + 1}. Remove such rows.")
            _say(f"left out, as the {name} is missing: row {_place(rows, ~is_known)}")
    return rows[kept].assign(lost=np.diff(np.cumsum(worth_C)[kept], prepend=0.0))


def _changes(rows: pd.DataFrame, *names: str) -> BoolArray:
    """Rows in which a counter differs from the row before."""
    changes = np.zeros(len(rows), dtype=np.bool_)
    for name in names:
        if name in rows:
            changes[1:] |= np.diff(rows[name]) != 0
    return changes


def with_newest_last(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of which the newest comes first are turned."""
    step_s = np.diff(rows["time"])[~_changes(rows, "cycle", "step")[1:]]
    if (step_s <= 0.0).all() and (step_s < 0.0).any():
        _say("the clock runs backwards: the rows are taken from the last one to the first")
        return rows[::-1]
    return rows


def over_midnight(rows: pd.DataFrame) -> pd.DataFrame:
    """The time of day goes on at midnight."""
    step_s = np.diff(rows["time"], prepend=rows["time"].iloc[:1])
    before_s, after_s = np.roll(step_s, 1), np.roll(step_s, -1)
    beside_s = np.maximum(np.maximum(before_s, after_s), np.median(step_s))
    # after a row that is out of time the clock goes on as before
    midnight = (step_s < 0.0) & (step_s >= -_DAY_S) & (step_s + _DAY_S <= _MANY_TIMES * beside_s) & (step_s + after_s < 0.0)
    if not midnight.any():
        return rows
    _say(f"the clock is that of the day, and goes on at midnight: row {_place(rows, midnight)}")
    return rows.assign(time=rows["time"] + _DAY_S * np.cumsum(midnight))


def on_one_clock(rows: pd.DataFrame) -> pd.DataFrame:
    """Times that start anew, near zero, with each step become times since the start of the test."""
    time_s, new = rows["time"].to_numpy(), np.flatnonzero(_changes(rows, "step"))
    back = np.flatnonzero(np.diff(time_s) < 0.0) + 1
    with_cycles = _changes(rows, "cycle")[back].all()
    if not len(back) or with_cycles or not np.isin(back, new).all():
        return rows
    step_s = np.append(np.diff(time_s), 0.0)
    usual_s = float(np.median(step_s[step_s > 0.0])) if (step_s > 0.0).any() else 0.0
    # the first rows of a few steps may be missing
    late = time_s[new] > _MANY_TIMES * np.maximum(usual_s, step_s[new])
    if late.mean() > _LONG_SHARE or not np.isin(new[late], back).all():
        return rows
    # a row that is out of time, where the next one goes on with the clock of the one before
    after_s = _MANY_TIMES * step_s[np.minimum(back + 1, len(time_s) - 1)]
    goes_on_s = time_s[np.minimum(back + 1, len(time_s) - 1)] - time_s[back - 1]
    if ((time_s[back - 1] > after_s) & (goes_on_s > 0.0) & (goes_on_s <= after_s)).any():
        return rows
    # nothing is lost behind a row that comes sooner than those before at equal intervals: testers write it as a step ends
    last_s, before_s, earlier_s = (step_s[np.maximum(new - back, 0)] for back in (2, 3, 4))
    is_end = (last_s < (1.0 - _NOTHING_SHARE) * before_s) & np.isclose(before_s, earlier_s, rtol=_NOTHING_SHARE)
    lost_s, offsets_s = np.zeros(len(time_s)), np.zeros(len(time_s))
    lost_s[new], offsets_s[new] = np.where(is_end, 0.0, last_s), time_s[new - 1]
    unknown = f"; what passed in between, up to {lost_s.max():g} s each, is unknown" if lost_s.any() else ""
    _say(f"the time starts anew with each step, and is added up{unknown}")
    lost_C = lost_s * np.abs(np.roll(rows["current"], 1)) + (rows["lost"] if "lost" in rows else 0.0)
    return rows.assign(time=time_s + np.cumsum(offsets_s), lost=lost_C)


def with_clock_going_on(rows: pd.DataFrame) -> pd.DataFrame:
    """A clock that goes back by a few rows' time where the step changes, and goes on from there, goes on from before."""
    time_s = rows["time"].to_numpy()
    step_s = np.diff(time_s, prepend=time_s[:1])
    usual_s = float(np.median(step_s[1:]))
    most_s, next_s = _MANY_TIMES * usual_s, np.append(step_s[1:], usual_s)
    back = _changes(rows, "step") & (step_s < 0.0) & (step_s >= -most_s) & (next_s > 0.0) & (next_s <= most_s)
    if not back.any():
        return rows
    _say(f"the clock goes back where the step changes, and is taken to go on by {usual_s:g} s: row {_place(rows, back)}")
    return rows.assign(time=time_s + np.cumsum(np.where(back, usual_s - step_s, 0.0)))


def without_repeated(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Without blocks of rows that come again directly after themselves; alone, rows may be alike under a clock of each step. They
    are compared only where the clock does not go on, as that takes time.
    """
    if (np.diff(rows["time"]) > 0.0).all():
        return rows
    names, place = ("cycle", *REQUIRED, "step", "direction"), pd.Series(np.arange(len(rows)), rows.index)
    ago = place - place.groupby([rows[name] for name in names if name in rows], sort=False).shift()
    repeated = ago.groupby((ago != ago.shift()).cumsum()).transform("size") >= ago
    if repeated.any():
        _say(f"{repeated.sum()} of {len(repeated)} rows are repeated, and dropped")
    return rows[~repeated]


def with_tests_apart(rows: pd.DataFrame) -> pd.DataFrame:
    """Where the clock starts anew, near where it began, while the cell rests, another test begins. Cycles are numbered on."""
    time_s, step_s = rows["time"].to_numpy(), np.append(np.diff(rows["time"]), 0.0)
    rests = (rows["current"].abs() <= _rest_A(rows["current"])).to_numpy()
    cycle = rows["cycle"].to_numpy(copy=True) if "cycle" in rows else np.zeros(len(rows))
    starts, few, usual_s = [0], int(max(1.0, _FEW_SHARE * len(rows))), float(np.median(step_s))
    for n in (np.flatnonzero((step_s[:-1] < 0.0) & rests[:-1] & rests[1:] & (np.diff(cycle) <= 0.0)) + 1).tolist():
        # rows out of time are few, and the clock goes on as before while the cell still rests
        ends = (time_s[n : n + few + 1] >= time_s[n - 1]) | ~rests[n : n + few + 1]
        goes_on = ends.any() and rests[n + int(np.argmax(ends))]
        if not goes_on and time_s[n] <= time_s[starts[-1]] + _MANY_TIMES * max(usual_s, step_s[n]):
            starts.append(n)
    test = np.isin(np.arange(len(rows)), starts[1:])
    if not test.any():
        return rows
    _say(f"the clock starts anew at rest, where another test begins: row {_place(rows, test)}")
    for begin, end in itertools.pairwise([*starts, len(rows)]):
        again = np.isin(np.unique(cycle[begin:end]), cycle[:begin]).any()
        cycle[begin:end] += cycle[:begin].max() + 1.0 - cycle[begin:end].min() if again else 0.0
    return rows.assign(test=np.cumsum(test), **({"cycle": cycle} if "cycle" in rows else {}))


def with_steps_apart(rows: pd.DataFrame) -> pd.DataFrame:
    """Of two rows at one time, between which the step changes or the load is switched, the second is the later one."""
    time_s, jump_A = rows["time"].to_numpy(), np.diff(rows["current"], prepend=rows["current"].iloc[:1])
    same = np.diff(time_s, prepend=np.nan) == 0.0
    new_step = _changes(rows, "step")
    switched = same & ~new_step & (np.abs(jump_A) > SWITCH_SHARE * rows["current"].abs().max())
    # which a clock tells to its tick
    if switched.any() and np.linalg.norm(jump_A[switched]) * _tick_s(time_s) / 12**0.5 <= _NOTHING_SHARE * _passed_C(rows):
        _say(f"row {_place(rows, switched)} has the time of the row before, and is the later one, as the load is switched")
    else:
        switched[:] = False
    later, n = (same & new_step) | switched, np.arange(len(rows))
    return rows.assign(time=time_s + _STEP_S * (n - np.maximum.accumulate(np.where(later, 0, n))))


def _passed_C(rows: pd.DataFrame) -> float:
    """The charge that passes in all, of whatever sign."""
    step_s = np.maximum(np.diff(rows["time"]), 0.0)
    return float(step_s @ rows["current"].abs().to_numpy()[1:])


def without_rows_out_of_time(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Without rows that are not later than all before them, if they are few, or say what the others say, and if little charge
    passes from each to the next, as all of that is lost where a clock was put back. Cycles and tests may have own clocks.
    """
    time = rows["time"]
    if (np.diff(time) > 0.0).all():
        return rows
    cycle = pd.Series(np.cumsum(_changes(rows, "cycle", "test") & (np.diff(time, prepend=-np.inf) < 0.0)), index=rows.index)
    latest = time.groupby(cycle).cummax().groupby(cycle).shift()
    twice, back = (time == latest).to_numpy(), (time < latest).to_numpy()
    kept, few = rows[~(twice | back)], max(1.0, _FEW_SHARE * len(rows))
    on_end = back & np.roll(back, 1)  # no row is behind itself, so that the first one is none
    lost_C = (time.diff().clip(lower=0.0) * rows["current"].abs())[on_end].sum()
    if back.sum() > max(few, _changes(rows, "step").sum()) or lost_C > _FEW_SHARE * _passed_C(rows):
        _refuse_backwards(rows)
        return rows
    steps = rows[["time", "voltage", "current"]].diff().abs()
    usual = kept[["time", "voltage", "current"]].diff().abs()
    worth_C = steps["current"][twice].sum() * usual["time"].median()
    say_other = twice.sum() > few and steps["voltage"][twice].mean() > _MANY_TIMES * usual["voltage"].mean()
    if say_other or worth_C > _NOTHING_SHARE * _passed_C(rows):
        return rows
    for which, what in ((twice, "the time of the row before"), (back, "a time before that of the row before")):
        if which.any():
            _say(f"left out with {what}: row {_place(rows, which)}")
    return kept


def _refuse_backwards(rows: pd.DataFrame) -> None:
    """A clock that starts anew goes back once; one that goes back in two rows on end, or by an hour, does not."""
    time_s = rows["time"].to_numpy()
    step_s = np.diff(time_s, prepend=time_s[:1])
    on_end = (step_s < 0.0) & (np.append(step_s[1:], 0.0) < 0.0)
    interval_s = (1.0 + SWITCH_SHARE) * np.maximum(np.abs(np.median(step_s)), np.roll(step_s, 1))
    hour = (step_s < 0.0) & (np.abs(step_s + 3600.0) <= interval_s)
    advice_of_hour = "Clocks are put back by an hour in autumn: give times of UTC"
    for which, advice in ((on_end, "Sort the rows by time"), (hour, advice_of_hour)):
        if which.any():
            n = int(np.argmax(which))
            raise ValueError(
                f"the clock runs backwards: row {rows.index[n] + 1} is at {time_s[n]:g} s, after {time_s[n - 1]:g} s. {advice}"
            )


def with_signed_current(rows: pd.DataFrame, columns: Mapping[str, Column], is_negative: bool | None) -> pd.DataFrame:
    """The current of a discharge is positive."""
    current_A, rest_A = rows["current"], _rest_A(rows["current"])
    if not (current_A.abs() > REST_CURRENT_A).any():
        is_known = any(columns[each].unit for each in ("current", "power", "charge_step") if each in columns)
        # under the load of a coin cell the voltage falls
        if not is_known or not current_A.any() or not np.ptp(rows["voltage"][current_A.abs() > rest_A]) > _COIN_FALL_V:
            coin = f", nor that of a coin cell, whose voltage changes by {_COIN_FALL_V:g} V"
            advice = coin if is_known else ", or that of a coin cell: state the unit of the current"
            raise ValueError(f"no current flows above {REST_CURRENT_A:g} A, below which a cell rests: no discharge{advice}")
    if "direction" in rows and (current_A >= -rest_A).all():
        # a first row at rest may have the current of the step before
        towards = rows["direction"].mask((rows["direction"] == 0) & (current_A > rest_A)).ffill()
        return rows.assign(current=current_A.mask(towards < 0, -current_A))
    if (current_A >= -rest_A).all() or (current_A <= rest_A).all():
        _refuse_unsigned(rows, columns)
    if is_negative is None:
        jumps, fall = _jumps(rows), _fall(rows)
        clear = [effect for effect in (jumps, fall) if abs(effect) > _CLEAR]
        if not clear or min(clear) < 0.0 < max(clear):
            raise ValueError(
                "whether the current of a discharge is positive or negative cannot be told, as the voltage neither falls nor "
                f"rises clearly with the current ({jumps:.2f}) and the charge ({fall:.2f}), or they contradict each other. "
                "State it: --discharge-is-negative or --discharge-is-positive (Python: discharge_is_negative)"
            )
        is_negative = clear[0] > 0.0
    return rows.assign(current=-current_A) if is_negative else rows


def _rest_A(current_A: pd.Series[float]) -> float:
    """At most so much flows where a cell rests, A: of a coin cell less."""
    return min(REST_CURRENT_A, SWITCH_SHARE * float(current_A.abs().max()))


def _refuse_unsigned(rows: pd.DataFrame, columns: Mapping[str, Column]) -> None:
    """
    Refuse a current of one sign under which, once it has grown, the voltage rises for long, while elsewhere it falls; or with
    which the voltage jumps up where a rest ends, while elsewhere it jumps down.
    """
    size_A, voltage_V = rows["current"].abs().to_numpy(), rows["voltage"].to_numpy()
    jump_A = np.diff(size_A, prepend=0.0)
    begin = np.union1d([0], np.flatnonzero(np.abs(jump_A) > SWITCH_SHARE * size_A.max()))
    end = np.append(begin[1:], len(rows)) - 1
    charge_C = np.add.reduceat(size_A * np.maximum(np.diff(rows["time"], prepend=rows["time"].iloc[0]), 0.0), begin)
    # the first row may have the voltage from before
    rise_V = voltage_V[end] - voltage_V[np.minimum(begin + 1, end)]
    is_long, long_V = charge_C >= _LONG_SHARE * charge_C.max(), _LONG_SHARE * float(np.ptp(voltage_V))
    # after a larger load it rises, too, but not above where it was before that
    before_V = voltage_V[np.maximum(np.append(0, begin[:-1]) - 1, 0)]
    relaxes = (jump_A[begin] < 0.0) & (voltage_V[end] < before_V)
    rests = np.maximum.reduceat(size_A, begin) <= SWITCH_SHARE * size_A.max()
    rise_V[rests | ((~is_long | relaxes) & (rise_V > 0.0))] = 0.0
    jump_V = voltage_V[np.minimum(begin + 1, end)] - voltage_V[np.maximum(begin - 1, 0)]
    jump_V[rests | ~is_long | (begin == 0) | (size_A[begin - 1] > SWITCH_SHARE * size_A.max()) | (jump_V * rise_V < 0.0)] = 0.0
    if min(jump_V.max(), -jump_V.min()) > _LONG_SHARE * np.abs(jump_V).max():
        rise_V, long_V = jump_V, 0.0
    if rise_V.max() > long_V and np.minimum(rise_V, 0.0).sum() < -long_V:
        known = " and ".join(repr(column.name) for key, column in columns.items() if key.startswith("state"))
        raise ValueError(
            f"the current has no sign: from row {rows.index[begin[np.argmax(rise_V)]] + 1} on the voltage rises for long, and "
            "elsewhere it falls under a current of the same sign. Leave out the charges, or name the column that tells them "
            f"from discharges: --columns state=NAME (Python: columns){f'. The words of {known} do not' if known else ''}"
        )


def _jumps(rows: pd.DataFrame) -> float:
    """
    How the voltage jumps with the current where that is switched, -1 to 1; rows next to the switch may mix both sides. A
    current that goes on to fall is that of a voltage that is held.
    """
    voltage_V, current_A = rows["voltage"].to_numpy(), rows["current"].to_numpy()
    jump_A, fall_A = np.diff(current_A), -np.diff(np.abs(current_A))
    most_A = np.abs(current_A).max()
    held = (current_A[1:] * current_A[:-1] > 0.0) & (fall_A > 0.0) & (np.append(fall_A[1:], 0.0) > _NOTHING_SHARE * most_A)
    n = np.flatnonzero((np.abs(jump_A) > SWITCH_SHARE * most_A) & ~held)
    wide_V = voltage_V[np.minimum(n + 2, len(voltage_V) - 1)] - voltage_V[np.maximum(n - 1, 0)]
    jump_V = voltage_V[n + 1] - voltage_V[n]
    jump_V = np.where(np.abs(wide_V) > np.abs(jump_V), wide_V, jump_V)
    return float(np.sign(jump_A[n] * jump_V) @ np.abs(jump_A[n]) / np.abs(jump_A[n]).sum()) if len(n) else 0.0


def _fall(rows: pd.DataFrame) -> float:
    """How the voltage goes with the charge that has passed in each cycle, whatever the current is, -1 to 1."""
    step_s = np.diff(rows["time"], prepend=rows["time"].iloc[0])
    passed = rows[["voltage", "current"]].assign(charge=np.cumsum(rows["current"] * np.maximum(step_s, 0.0)))
    within = passed - passed.groupby(np.cumsum((step_s < 0.0) | _changes(rows, "cycle"))).transform("mean")
    by = within.corr().fillna(0.0)
    (of_voltage, of_both), of_charge = by.loc["charge", ["voltage", "current"]], by.at["voltage", "current"]
    rest = (1.0 - of_charge**2) * (1.0 - of_both**2)
    return float((of_voltage - of_charge * of_both) / rest**0.5) if rest > 0.0 else 0.0
