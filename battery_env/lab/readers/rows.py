"""
The rows of a table as a record has them: in SI units, in their order, on one clock. Five things are mended, and said: clocks
that start anew, incomplete rows, ends without a cell, the newest row first, and two rows at one time. What else is odd is
refused with its rows.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable, Mapping
from io import StringIO
from typing import Any

import numpy as np
import pandas as pd

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.readers.columns import Column, FileFormat, Recognised, direction, say
from battery_env.lab.readers.testers import REQUIRED
from battery_env.records import LOAD_SHARE, REST_CURRENT_A, SWITCH_SHARE
from battery_env.records.discharge import CLOCKS, LEAST_SAMPLES

#: What is worth less than this share of the charge is nothing.
NOTHING_SHARE = 1e-3
#: Of so few rows, or of so little charge, a record can do without.
FEW_SHARE = 0.01
#: Two clocks, or a clock and a counter, agree within this share; of no more rows a value may be missing, or wild.
SOME_SHARE = 0.1
# Two rows of different steps may have the same time; the second counts as so much later, s.
_STEP_S = 1e-3
# Temperatures that a cell may have, degC.
_TEMPERATURES_C = (-60.0, 150.0)
# Fractions behind a comma or a colon, days as in 1-02:03:04, 1.02:03:04, 1 day, 2:03:04, and of workbooks, which count from
# 1900 on, and dates alone, which are midnight.
_AS_CLOCKS = {
    r"(?<=\d),(?=\d)|(?<=:\d\d:\d\d):(?=\d{3}$)": ".",
    r"^(?:1900-01-(\d+)[ T]|(\d+)(?:[-.]| days?,? ))(?=\d+:)": r"\1\2 days ",
    r"^(\d+([-./])\d+\2\d+)$": r"\1 00:00:00",
}
_THOUSANDS = re.compile(r"^\s*[-+]?\d{1,3}(?:[,.' ]\d{3})+(?:[.,]\d+)?\s*$")
_DAY_OR_MONTH_FIRST: tuple[dict[str, Any], ...] = ({"format": "ISO8601"}, {}, {"dayfirst": True})


def cells_of(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """
    The rows of each cell, of a table with columns by quantity as they were written, whose index counts the rows below the
    header; the name is empty where the table holds one cell.
    """
    if len(table) < LEAST_SAMPLES:
        raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows below the header, got {len(table)}")
    if "cell" not in table:
        return {"": table}
    cells = table["cell"].astype("string").ffill().bfill().fillna("").astype(str)
    counts = cells.value_counts()
    if len(counts) == 1 or counts.min() < LEAST_SAMPLES:
        return {"": table}
    return {str(name): rows for name, rows in table.groupby(cells, sort=False)}


def rows_of_cell(table: pd.DataFrame, known: Recognised, file_format: FileFormat) -> pd.DataFrame:
    """The rows of a cell in SI units, and in order; the current has the sign of the file."""
    rows = with_current(on_its_clock(in_si_units(table, known), known.columns), known.columns, file_format)
    for mend in (without_incomplete, without_dead_ends, with_newest_last, with_one_row_at_a_time):
        rows = mend(rows)
    return rows


def place_of(rows: pd.DataFrame, which: BoolArray) -> str:
    """The first of some rows as a file counts them, and how many more there are."""
    places = rows.index[which]
    return f"{places[0] + 1}" + (f" and {len(places) - 1} more" if len(places) > 1 else "")


def in_si_units(table: pd.DataFrame, known: Recognised) -> pd.DataFrame:
    """Numbers in SI units, a column a quantity, NaN where there is none; what is not needed and cannot be read is left out."""
    found: dict[str, Any] = {}
    columns = known.columns
    for key, column in columns.items():
        quantity = key.partition(" ")[0]
        if quantity in _READ and (key == quantity or quantity in found):
            try:
                values = _read(quantity, table[key], column)
            except ValueError as error:
                if quantity in REQUIRED or REQUIRED[0] not in table:
                    raise known.refusal(error) from error
                say(f"{error}. It is left out")
                continue
            if key == quantity:
                found[quantity] = values
            else:
                _check_agree(found[quantity], values, columns[quantity], column, quantity)
        elif quantity == "state":
            codes, names = pd.factorize(table[key])
            directions = np.array([*map(direction, names), 0])[codes]
            if {1, -1} <= set(directions):
                found.setdefault("direction", directions)
    if "step" in table:
        found["step"] = pd.factorize(table["step"])[0]
    return pd.DataFrame(found, index=table.index)


def _read(quantity: str, values: pd.Series, column: Column) -> FloatArray:
    try:
        return _READ[quantity](values, column)
    except Exception as error:  # pandas raises whatever a value leads it to
        what = "" if column.name in str(error) else f"the column {column.name!r} cannot be read: "
        raise ValueError(f"{what}{error}") from error


def _check_agree(one: FloatArray, other: FloatArray, first: Column, second: Column, quantity: str) -> None:
    """Refuse two columns of one name that say different things; clocks may do by what the coarser one counts in."""
    if quantity == "time":
        one, other = one - one[0], other - other[0]
    ticks = np.diff(np.unique(np.round(other[np.isfinite(other)], 6)))
    coarse = float(np.median(ticks)) if quantity == "time" and len(ticks) else 0.0
    if np.nanmax(np.abs(one - other), initial=0.0) > NOTHING_SHARE * np.nanmax(np.abs(one), initial=0.0) + coarse:
        raise ValueError(
            f"both {first.name!r} and {second.name!r} may be the {quantity}. Say which it is: --columns {quantity}=NAME, or "
            "leave one out: --ignore NAME (Python: columns, ignore)"
        )


def numbers(values: pd.Series, column: Column) -> FloatArray:
    """Numbers in SI units, NaN where there is none; refused if words stand in more than a few rows."""
    if not pd.api.types.is_numeric_dtype(values.dtype):
        found = pd.to_numeric(values.astype(object), errors="coerce").astype(np.float64)
        _check_readable(values, found.isna(), column, "numbers")
        values = found
    return column.factor * values.to_numpy(dtype=np.float64, na_value=np.nan) + column.offset


def _check_readable(values: pd.Series, is_missing: pd.Series, column: Column, what: str) -> None:
    text = values[is_missing & values.notna()].astype(str).str.strip()
    bad = text[text != ""]
    if len(bad) > SOME_SHARE * values.notna().sum():
        advice, thousands = "", bad[bad.str.match(_THOUSANDS)]
        if len(thousands):
            advice, bad = ". Write numbers without separators of thousands", thousands
        raise ValueError(f"the column {column.name!r} must hold {what}, got {bad.iloc[0]!r} in row {bad.index[0] + 1}{advice}")


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
    found = pd.Series(numbers(values, column)).ffill().bfill().to_numpy()
    if not (np.isfinite(found).all() and (found == np.round(found)).all()):
        raise ValueError(f"the column {column.name!r} must hold whole numbers of cycles")
    if LEAST_SAMPLES * (np.diff(found) != 0.0).sum() > len(found):
        raise ValueError(f"the column {column.name!r} changes every few rows, and so is none of cycles")
    return found


def seconds(values: pd.Series, column: Column) -> FloatArray:
    """
    Numbers in their unit; a clock, hours:minutes:seconds, in seconds; dates in seconds since 1970. Blanks, and words in a few
    rows, are NaN.
    """
    if pd.api.types.is_numeric_dtype(values.dtype):
        found = numbers(values, column)
        if not np.nanmin(found, initial=np.inf) >= 1e13 or not np.isfinite(found).any():
            return found
        # dates in digits, as 20260227225000
        digits = (values // 1).astype("Int64").astype("string")
        return _total_s(pd.to_datetime(digits, format="%Y%m%d%H%M%S", errors="coerce"))
    if pd.api.types.is_datetime64_any_dtype(values.dtype) or pd.api.types.is_timedelta64_dtype(values.dtype):
        return _total_s(values)
    text = values.astype("string").fillna("").str.strip()
    if not text.str.contains(":").mean() > 0.5 * (text != "").mean():
        return numbers(values, column)
    if (text.str.count(":") == 2).all():
        plain_s = _plain_clock_s(text)
        if np.isfinite(plain_s).all():
            return plain_s
    for pattern, clock in _AS_CLOCKS.items():
        text = text.str.replace(pattern, clock, regex=True)
    text = text.astype(object).where(text != "", None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a day that is no month, and of each row with one
        readings = [pd.to_timedelta(text, errors="coerce")]
        if readings[0].isna().mean() > 0.5:
            # UTC, as the clocks of a time zone are put forward and back
            readings = [pd.to_datetime(text, utc=True, errors="coerce", **each) for each in _DAY_OR_MONTH_FIRST]
    least = min(int(each.isna().sum()) for each in readings)
    found_s = [_total_s(each) for each in readings if each.isna().sum() == least]
    what = "times: numbers, hours:minutes:seconds, or dates"
    _check_readable(values, pd.Series(np.isnan(found_s[0]), values.index), column, what)
    # a day taken for a month makes a month of midnight
    return min(found_s, key=lambda time_s: float(np.abs(np.nan_to_num(np.diff(time_s))).max(initial=0.0)))


def _plain_clock_s(text: pd.Series) -> FloatArray:
    """The seconds of hours:minutes:seconds, of millions of rows as of few; NaN where it is anything else."""
    parts = pd.read_csv(
        StringIO("\n".join(text)),
        sep=":",
        header=None,
        names=["hours", "minutes", "seconds"],
        dtype=str,
        keep_default_na=False,
        skip_blank_lines=False,
        quoting=csv.QUOTE_NONE,
    )
    hours, minutes, rest_s = (pd.to_numeric(parts[name], errors="coerce") for name in parts)
    is_plain = parts["hours"].str.isdecimal() & parts["minutes"].str.isdecimal() & parts["seconds"].str[:1].str.isdecimal()
    is_plain &= (minutes < 60.0) & (rest_s < 60.0)
    return np.asarray((3600.0 * hours + 60.0 * minutes + rest_s).where(is_plain), dtype=np.float64)


def _total_s(times: pd.Series) -> FloatArray:
    if pd.api.types.is_datetime64_any_dtype(times.dtype):
        times = times - pd.Timestamp(0, tz=times.dt.tz)
    return times.dt.total_seconds().to_numpy(dtype=np.float64)


_READ: dict[str, Callable[[pd.Series, Column], FloatArray]] = {
    "time": seconds,
    "date": seconds,
    "step_time": seconds,
    "voltage": numbers,
    "counter": numbers,
    "current": numbers,
    "power": numbers,
    "charge_step": numbers,
    "temperature": _temperatures_C,
    "ambient": _temperatures_C,
    "capacity": numbers,
    "cycle": _cycles,
}


def on_its_clock(rows: pd.DataFrame, columns: Mapping[str, Column]) -> pd.DataFrame:
    """
    With the times of the test; where these go back, or are not there, with the dates if they tell as many rows apart; or with
    times that start anew, with each step or with each test, on one clock.
    """
    new_cycle = _changes(rows, "cycle")[1:]
    steps_s = {each: np.diff(rows[each].ffill()) for each in ("time", "date", "step_time") if each in rows}
    goes_back = {each: bool(((step_s < 0.0) & ~new_cycle).any()) for each, step_s in steps_s.items()}
    is_reversed = {each: bool((step_s <= 0.0).all()) for each, step_s in steps_s.items()}
    if "time" in rows and (is_reversed["time"] or not goes_back["time"]):
        return rows.assign(time=_from_zero(rows["time"] * _tick_of_clock(rows, columns)))
    other = "time" if "time" in rows else "step_time"
    same = {each: int((step_s <= 0.0).sum()) for each, step_s in steps_s.items()}
    if "date" in rows and (is_reversed["date"] or not goes_back["date"]):
        if other not in rows or same["date"] <= max(same[other], FEW_SHARE * len(rows)):
            if "time" in rows:
                say(f"the time is {columns['date'].name!r}, as {columns['time'].name!r} goes back")
            return rows.assign(time=_from_zero(rows["date"]))
    if "time" in rows:
        return _tests_apart(rows)
    return _added_up(rows) if "step_time" in rows else rows.assign(time=_from_zero(rows["date"]))


def _from_zero(time_s: pd.Series[float]) -> pd.Series[float]:
    """Dates from the first one on; other clocks begin where they do."""
    return time_s - time_s.min() if time_s.min() > 1e8 else time_s


def _starts_anew(time_s: FloatArray) -> IntArray:
    """Where a clock starts anew, near where it began, and goes on from there; nothing if it goes back elsewhere, too."""
    step_s = np.append(np.diff(time_s), 0.0)
    usual_s = 2.0 * float(np.median(step_s[step_s > 0.0])) if (step_s > 0.0).any() else 0.0
    n = np.flatnonzero(step_s[:-1] < 0.0) + 1
    is_near = np.abs(time_s[n] - time_s[0]) <= np.maximum(usual_s, step_s[n])
    goes_on = step_s[n] <= np.maximum(usual_s, 2.0 * step_s[np.minimum(n + 1, len(step_s) - 1)])
    return n if (is_near & goes_on).all() else n[:0]


def _tests_apart(rows: pd.DataFrame) -> pd.DataFrame:
    """Where the clock starts anew while the cell rests another test begins, with a number of its own."""
    n = _starts_anew(rows["time"].ffill().to_numpy())
    if "cycle" in rows or "current" not in rows or not len(n):
        return rows
    size_A = rows["current"].abs().to_numpy()
    if (np.maximum(size_A[n], size_A[n - 1]) > min(REST_CURRENT_A, LOAD_SHARE * np.nanmax(size_A))).any():
        return rows
    test = np.isin(np.arange(len(rows)), n)
    say(f"the clock starts anew at rest, where another test begins: row {place_of(rows, test)}")
    return rows.assign(cycle=1.0 + np.cumsum(test))


def _added_up(rows: pd.DataFrame) -> pd.DataFrame:
    """Times that start anew with each step become times since the start of the test."""
    time_s = rows["step_time"].ffill().to_numpy()
    new = _starts_anew(time_s)
    if not len(new):
        return rows.assign(time=rows["step_time"])
    step_s = np.append(np.diff(time_s), 0.0)
    # nothing is lost behind a row that comes sooner than those before at equal intervals: testers write it as a step ends
    last_s, before_s, earlier_s = (step_s[np.maximum(new - back, 0)] for back in (2, 3, 4))
    is_end = (last_s < (1.0 - NOTHING_SHARE) * before_s) & np.isclose(before_s, earlier_s, rtol=NOTHING_SHARE)
    lost_s, offsets_s = np.zeros(len(time_s)), np.zeros(len(time_s))
    lost_s[new], offsets_s[new] = np.where(is_end, 0.0, np.maximum(last_s, 0.0)), time_s[new - 1]
    unknown = f"; what passed in between, up to {lost_s.max():g} s each, is unknown" if lost_s.any() else ""
    say(f"the time starts anew with each step, and is added up{unknown}")
    return rows.assign(time=rows["step_time"] + np.cumsum(offsets_s), lost_s=lost_s)


def _tick_of_clock(rows: pd.DataFrame, columns: Mapping[str, Column]) -> float:
    """What a clock counts in whose name has no unit, s, where another clock tells, which may have none either."""
    if columns["time"].unit or "date" not in rows:
        return 1.0
    ticks, beside = (float(np.ptp(rows[each].ffill().bfill())) for each in ("time", "date"))
    is_number = not columns["date"].unit and rows["date"].max() < 1e8
    for unit, (_, tick_s) in CLOCKS.items():
        for span_s in [beside * each_s for _, each_s in CLOCKS.values()] if is_number else [beside]:
            if abs(span_s - tick_s * ticks) <= min(1.0, SOME_SHARE * span_s) + NOTHING_SHARE * span_s:
                if tick_s != 1.0:
                    say(f"{columns['time'].name!r} counts {unit}, as {columns['date'].name!r} tells")
                return tick_s
    return 1.0


def with_current(rows: pd.DataFrame, columns: Mapping[str, Column], file_format: FileFormat) -> pd.DataFrame:
    """With the voltage of the cell, and with the current, of a table that holds something in its place."""
    if "counter" in rows and not columns["voltage"].is_of_cell:
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


def without_incomplete(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Without rows in which the time, the voltage or the current is missing, if what they drew is known but for little: blanks,
    titles, headers that come again, and a last line that is cut. What is not known of it is in doubt (``lost``, C).
    """
    known = {name: np.isfinite(rows[name].to_numpy()) for name in REQUIRED}
    kept, is_measured = np.logical_and.reduce([*known.values()]), np.logical_or.reduce([*known.values()])
    n, at = np.arange(len(rows)), np.flatnonzero(kept)
    worth_C, is_known_enough = np.zeros(len(rows)), len(at) >= LEAST_SAMPLES
    if is_known_enough:
        time_s, beside_A = (np.interp(n, at, rows[name].to_numpy()[at]) for name in ("time", "current"))
        given_A = np.where(known["current"], rows["current"], np.where(is_measured, 0.0, beside_A))
        inside = ~kept & (n > at[0]) & (n < at[-1])
        worth_C = np.where(inside, np.abs(given_A - beside_A) * np.abs(np.gradient(time_s)), 0.0)
        is_known_enough = worth_C.sum() / 3.0**0.5 <= FEW_SHARE * _passed_C(rows[kept])
        is_known_enough &= (is_measured & ~kept).sum() <= SOME_SHARE * len(rows)
    for name, is_known in known.items():
        bad = ~is_known & is_measured
        if bad.any() and not is_known_enough:
            got = rows[name].to_numpy()[bad][0]
            raise ValueError(f"the {name} must be finite, got {got} in row {place_of(rows, bad)}. Remove such rows.")
        if bad.any():
            say(f"left out, as the {name} is missing: row {place_of(rows, bad)}")
    if (~is_measured).any():
        say(f"left out, as they hold no measurement: row {place_of(rows, ~is_measured)}")
    if not is_known_enough:
        raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows with a time, a voltage and a current, got {len(at)}")
    lost_C = worth_C + (rows["lost_s"] * rows["current"].abs().shift(fill_value=0.0) if "lost_s" in rows else 0.0)
    return rows[kept].assign(lost=np.diff(np.nancumsum(lost_C)[kept], prepend=0.0)) if np.nansum(lost_C) else rows[kept]


def without_dead_ends(rows: pd.DataFrame) -> pd.DataFrame:
    """Without rows at the ends in which no cell was connected."""
    dead = (rows["voltage"] < SOME_SHARE * rows["voltage"].median()) & (rows["current"].abs() <= REST_CURRENT_A)
    ends = dead & (dead.cummin() | dead[::-1].cummin())
    if not ends.any() or ends.all():
        return rows
    first_V = rows["voltage"][ends].iloc[0]
    say(f"row {place_of(rows, ends.to_numpy())} is left out: {first_V:g} V without a current is no cell")
    return rows[~ends]


def _changes(rows: pd.DataFrame, name: str) -> BoolArray:
    """Rows in which a counter differs from the row before."""
    return np.diff(rows[name], prepend=rows[name].iloc[:1]) != 0 if name in rows else np.zeros(len(rows), dtype=np.bool_)


def with_newest_last(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of which the newest comes first are turned."""
    step_s = np.diff(rows["time"])[~_changes(rows, "cycle")[1:]]
    if (step_s <= 0.0).all() and (step_s < 0.0).any():
        say("the clock runs backwards: the rows are taken from the last one to the first")
        return rows[::-1]
    return rows


def _passed_C(rows: pd.DataFrame) -> float:
    """The charge that passes in all, of whatever sign."""
    step_s = np.maximum(np.diff(rows["time"]), 0.0)
    return float(step_s @ rows["current"].abs().to_numpy()[1:])


def with_one_row_at_a_time(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Of two rows at one time, between which the step changes or the load is switched, the second is the later one. Other rows at
    the time of the row before are left out if they are few, or say what the others say. A clock that goes back is refused.
    """
    step_s = np.diff(rows["time"], prepend=-np.inf)
    _refuse_backwards(rows, step_s)
    same, n = step_s == 0.0, np.arange(len(rows))
    switched = (rows["current"].diff().abs() > SWITCH_SHARE * rows["current"].abs().max()).to_numpy() & ~_changes(rows, "step")
    later = same & (_changes(rows, "step") | switched)
    if (later & switched).any():
        place = place_of(rows, later & switched)
        say(f"row {place} has the time of the row before, and is the later one, as the load is switched")
    rows = rows.assign(time=rows["time"] + _STEP_S * (n - np.maximum.accumulate(np.where(later, 0, n))))
    twice, measured = same & ~later, ["time", "voltage", "current"]
    steps, usual = rows[measured].diff().abs()[twice].sum(), rows.loc[~twice, measured].diff().abs().mean()
    is_few = twice.sum() <= max(1.0, FEW_SHARE * len(rows))
    is_coarse = usual["time"] > FEW_SHARE * np.ptp(rows["time"])
    say_other = not is_few and (is_coarse or steps["voltage"] > 3.0 * usual["voltage"] * twice.sum())
    if not twice.any() or say_other or steps["current"] * usual["time"] > NOTHING_SHARE * _passed_C(rows):
        return rows
    say(f"left out with the time of the row before: row {place_of(rows, twice)}")
    return rows[~twice]


def _refuse_backwards(rows: pd.DataFrame, step_s: FloatArray) -> None:
    """Name the rows in which a clock goes back, but where the number of the cycle changes, which may have its own clock."""
    back = (step_s < 0.0) & ~_changes(rows, "cycle")
    if not back.any():
        return
    n, time_s = int(np.argmax(back)), rows["time"].to_numpy()
    if len(_starts_anew(time_s)):
        advice = (
            "Where it starts anew with each step it is the time in a step, not of the test: --columns step_time=NAME. Where "
            "another test begins number the tests in a column of the cycle, or give each a file"
        )
    elif abs(step_s[n] + 3600.0) <= (1.0 + SOME_SHARE) * max(float(np.median(step_s)), float(step_s[n - 1])):
        advice = "Clocks are put back by an hour in autumn: give times of UTC"
    else:
        advice = "Sort the rows by time, or remove those"
    raise ValueError(
        f"the clock goes back: row {place_of(rows, back)} is at {time_s[n]:g} s, after {time_s[n - 1]:g} s. {advice}"
    )
