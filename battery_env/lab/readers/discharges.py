"""
Recorded discharges from files and tables as testers write them: which columns, which unit, which sign, and which of the rows
are a discharge.
"""

from __future__ import annotations

import itertools
import os
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.lab.readers.columns import Column
from battery_env.lab.readers.tables import columns_of, read_columns
from battery_env.records import REST_CURRENT_A, SWITCH_SHARE, drawn
from battery_env.records.discharge import LEAST_SAMPLES, Discharge, read_nasa_mat

Made = TypeVar("Made")

# The voltage falls with the current and with the charge drawn. The sum of both effects, in standard deviations, must be this
# clear to tell the sign of the current. In the discharges that come with the package it is -0.84 or clearer.
_CLEAR_EFFECT = 0.5
# A stretch of charging ends a discharge if it returns more than this share of the charge drawn until then; less is braking.
_RETURNED_SHARE = 0.2
# A charge before the load is cut off if it exceeds this share of the charge drawn; a smaller one is sensor offset. A charge
# within the load ends the discharge only if it returns more than this share of the largest charge drawn: early pulses return
# much of the little drawn yet.
_CHARGED_SHARE = 0.02
# What returns less than this share of the charge that passes in all is not looked at.
_NOTHING_SHARE = 1e-3
# What draws less than this share of the largest discharge of its file is a pulse between two charges, and left aside.
_LEAST_SHARE = 0.01
# Over longer gaps than this a temperature that is missing is a guess, s.
_TEMPERATURE_GAP_S = 600.0
# Two rows of different steps may have the same time; the second counts as so much later, s.
_STEP_S = 1e-3
_THOUSANDS = re.compile(r"^\s*[-+]?\d{1,3}(?:[,.' ]\d{3})+(?:[.,]\d+)?\s*$")


class Recording(NamedTuple):
    """
    What a file or a table holds of one discharge, not checked yet.

    :param arrays: arguments of :class:`~battery_env.Discharge`, by name
    :param meta: what else is known; ``cycle`` is missing if the file holds one discharge and does not number it
    """

    arrays: dict[str, Any]
    meta: dict[str, Any]

    def discharge(self) -> Discharge:
        """Check it."""
        return Discharge(**self.arrays, meta=self.meta)


def read_discharges(
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
) -> list[Discharge]:
    """
    Read the discharges of a file or of a table.

    A table is a ``pandas.DataFrame``, whose index is a column too if it has a name. A file is text with a header (commas,
    semicolons, tabs or blanks, decimal points or commas, also packed as .gz, .bz2, .xz or .zip), Parquet, one of NASA's .mat
    files, or with the extra ``cyclers`` a binary file of Neware (.nda, .ndax) or BioLogic (.mpr). Columns go by the names
    that testers give them, the Battery Data Format's, Arbin's, Maccor's, Neware's and BioLogic's among them; their units are
    told from the names.

    It may hold charges and rests as well, and many cycles. A discharge is what lies between two charges, with the rest
    before the load; it is numbered by the cycle that is given, or else counted. If there are several, each has its own
    clock, which starts at its first sample. Discharges whose charges are not logged are told apart by the column of the cycle
    alone. Rows that are repeated, and lines below the table, are dropped with a warning. A temperature that is missing in some
    rows is interpolated.

    .. code-block:: python

      frame = pd.DataFrame({"Test Time / s": time, "Voltage / V": voltage, "Current / A": current})
      discharges = read_discharges(frame)

    :param source: the file, or the table
    :param columns: by quantity (``time``, ``voltage``, ``current``, ``temperature``, ``ambient``, ``cycle``, ``step``,
        ``state``), the name of its column, where the names do not tell
    :param units: by quantity, its unit, where the name does not tell: ``s``, ``ms``, ``min``, ``h``; ``V``, ``mV``; ``A``,
        ``mA``; ``degC``, ``K``
    :param discharge_is_negative: how the current of a discharge is counted; ``None``: told from the voltage, which falls where
        a load is switched on and as charge is drawn
    :return: the discharges; their ``meta`` holds ``source`` and, if there are several or they are numbered, ``cycle``. One
        that fails the checks of :class:`~battery_env.Discharge` is left out with a warning
    :raises ValueError: if there is none, the file is damaged, or it does not tell what is asked for
    :raises ImportError: if the file needs an extra that is not installed
    """
    return each_usable(lambda discharge: discharge, source, columns, units, discharge_is_negative)


def each_usable(
    use: Callable[[Discharge], Made],
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
) -> list[Made]:
    """What is made of each discharge. One that cannot be used is left out with a warning; if none can, that is an error."""
    made, reasons = [], []
    for recording in read_recordings(source, columns, units, discharge_is_negative):
        try:
            made.append(use(recording.discharge()))
        except (TypeError, ValueError) as error:
            number = f"discharge {recording.meta['cycle']}: " if "cycle" in recording.meta else ""
            reasons.append(f"{_name_of(source)}: {number}{error}")
    if not made:
        raise ValueError(reasons[0])
    for reason in reasons:
        warnings.warn(f"{reason} It is left out.", stacklevel=3)
    return made


def read_discharge_csv(path: str | Path, discharge_is_negative: bool = False) -> Discharge:
    """
    Read one discharge from a text file, with the sign of its current as stated and not told.

    :param path: the file, as :func:`read_discharges` takes it
    :param discharge_is_negative: whether the file counts the current of a discharge as negative; it is flipped then
    :return: the discharge; its ``meta`` holds ``source``
    :raises ValueError: if the file holds none, or several, or if its values are invalid
    """
    discharges = read_discharges(path, discharge_is_negative=discharge_is_negative)
    if len(discharges) > 1:
        raise ValueError(f"{path} holds {len(discharges)} discharges: read them with read_discharges")
    return discharges[0]


def read_recordings(
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
) -> list[Recording]:
    """
    The discharges of a file or a table before they are checked, so that one that cannot be used does not lose the others; one
    at least.
    """
    name = _name_of(source)
    try:
        if isinstance(source, pd.DataFrame):
            recordings = _Table.of(*columns_of(source, columns, units)).recordings(name, discharge_is_negative)
        elif Path(source).suffix.lower() == ".mat":
            recordings = [Recording(arrays, meta) for arrays, meta in read_nasa_mat(Path(source))]
        else:
            recordings = _Table.of(*read_columns(Path(source), columns, units)).recordings(name, discharge_is_negative)
        if not recordings:
            raise ValueError("there is no discharge")
    except (TypeError, ValueError) as error:
        raise ValueError(str(error) if name in str(error) else f"{name}: {error}") from error
    return recordings


def _name_of(source: str | Path | pd.DataFrame) -> str:
    if not isinstance(source, pd.DataFrame | str | os.PathLike):
        raise TypeError(f"expected a DataFrame or the path of a file, got {type(source).__name__}")
    return "DataFrame" if isinstance(source, pd.DataFrame) else str(source)


class _Table:
    """The columns of a table in SI units, arrays of shape (T,)."""

    def __init__(self, columns: dict[str, FloatArray], labels: dict[str, Any]) -> None:
        self.columns = columns  # numbers, by quantity
        self.labels = labels  # numbers of steps and states, by quantity

    @classmethod
    def of(cls, table: pd.DataFrame, scales: dict[str, Column]) -> _Table:
        blank = table[["time", "voltage", "current"]].isna().all(axis=1).to_numpy()
        if blank.any():
            table = table[~blank]
        if len(table) < LEAST_SAMPLES:
            raise ValueError(f"a discharge needs {LEAST_SAMPLES} rows below the header, got {len(table)}")
        columns, labels = {}, {}
        for quantity, scale in scales.items():
            values = table[quantity]
            if quantity in ("step", "state"):
                labels[quantity] = pd.factorize(values)
            elif quantity == "time":
                columns[quantity] = _seconds(values, scale)
            elif quantity in ("temperature", "ambient") and values.isna().all():
                continue  # a sensor that was not connected
            else:
                columns[quantity] = scale.factor * _numbers(values, scale) + scale.offset
        return cls(columns, labels)

    def recordings(self, source: str, discharge_is_negative: bool | None) -> list[Recording]:
        cycles = self.columns.get("cycle")
        if cycles is not None and not (np.isfinite(cycles).all() and (cycles == np.round(cycles)).all()):
            raise ValueError("the column of the cycle must hold whole numbers")
        self._turn_rows()
        self._accumulate_step_times()
        self._drop_repeated()
        self._separate_steps()
        self._refuse_backwards()
        for name in ("time", "voltage", "current"):
            bad = np.flatnonzero(~np.isfinite(self.columns[name]))
            if len(bad):
                raise ValueError(
                    f"the {name} must be finite, got {self.columns[name][bad[0]]} in row {bad[0] + 1}. Remove such rows."
                )
        self._turn_current(discharge_is_negative)
        return self._split(source)

    def _select(self, keep: BoolArray | IntArray) -> None:
        self.columns = {name: column[keep] for name, column in self.columns.items()}
        self.labels = {name: (codes[keep], values) for name, (codes, values) in self.labels.items()}

    def _turn_rows(self) -> None:
        """Rows of which the newest comes first are turned."""
        time_s = self.columns["time"]
        starts_anew = np.zeros(len(time_s) - 1, dtype=np.bool_)
        for counter in (self.columns.get("cycle"), self.labels.get("step", (None,))[0]):
            if counter is not None:
                starts_anew |= np.diff(counter) != 0
        step_s = np.diff(time_s)[~starts_anew]
        if (step_s <= 0.0).all() and (step_s < 0.0).any():
            warnings.warn("the clock runs backwards: the rows are taken from the last one to the first", stacklevel=2)
            self._select(np.arange(len(time_s))[::-1])

    def _refuse_backwards(self) -> None:
        """A clock that starts anew goes back once; one that goes back in two rows on end is none."""
        time_s = self.columns["time"]
        back = np.diff(time_s) < 0.0
        on_end = np.flatnonzero(back[1:] & back[:-1])
        if len(on_end):
            n = on_end[0] + 1
            raise ValueError(
                f"the clock runs backwards: row {n + 1} is at {time_s[n]:g} s, after {time_s[n - 1]:g} s. Sort the rows by "
                "time"
            )

    def _accumulate_step_times(self) -> None:
        """Times that start anew with each step become times since the start of the test."""
        if "step" not in self.labels:
            return
        time_s, steps = self.columns["time"], self.labels["step"][0]
        back = np.flatnonzero(np.diff(time_s) < 0.0) + 1
        if len(back) and (steps[back] != steps[back - 1]).all() and not self._restarts_with_cycle(back):
            offsets_s = np.zeros(len(time_s))
            offsets_s[back] = time_s[back - 1]
            self.columns["time"] = time_s + np.cumsum(offsets_s)

    def _restarts_with_cycle(self, back: Any) -> bool:
        cycles = self.columns.get("cycle")
        return cycles is not None and bool((cycles[back] != cycles[back - 1]).all())

    def _drop_repeated(self) -> None:
        """Rows are compared only where the clock stands still or goes back, as comparing them takes time."""
        if (np.diff(self.columns["time"]) > 0.0).all():
            return
        names = [name for name in ("cycle", "time", "voltage", "current") if name in self.columns]
        rows = pd.DataFrame(
            {name: self.columns[name] for name in names} | {name: each[0] for name, each in self.labels.items()}
        )
        repeated = rows.duplicated().to_numpy()
        if repeated.any():
            warnings.warn(f"{repeated.sum()} of {len(repeated)} rows are repeated, and dropped", stacklevel=2)
            self._select(~repeated)

    def _separate_steps(self) -> None:
        if "step" not in self.labels:
            return
        time_s, steps = self.columns["time"], self.labels["step"][0]
        same = np.flatnonzero((np.diff(time_s) == 0.0) & (np.diff(steps) != 0)) + 1
        same = same[(same + 1 == len(time_s)) | (time_s[np.minimum(same + 1, len(time_s) - 1)] > time_s[same] + _STEP_S)]
        if len(same):
            self.columns["time"] = time_s.copy()
            self.columns["time"][same] += _STEP_S

    def _turn_current(self, discharge_is_negative: bool | None) -> None:
        """Makes the current of a discharge positive."""
        current_A = self.columns["current"]
        if not (np.abs(current_A) > REST_CURRENT_A).any():
            raise ValueError(
                f"no current flows above {REST_CURRENT_A:g} A, below which a cell rests: there is no discharge. Check its unit"
            )
        signs = self._signs_of_states()
        if signs is not None and (current_A >= -REST_CURRENT_A).all():
            self.columns["current"] = current_A * signs
            return
        if discharge_is_negative is None:
            effect = self._effect_on_voltage()
            if not abs(effect) > _CLEAR_EFFECT:
                raise ValueError(
                    "whether the current of a discharge is positive or negative cannot be told, as the voltage neither falls "
                    f"nor rises clearly with the current and the charge (by {effect:.2f} standard deviations). State it: "
                    "--discharge-is-negative or --discharge-is-positive (Python: discharge_is_negative)"
                )
            discharge_is_negative = effect > 0.0
        if discharge_is_negative:
            self.columns["current"] = -current_A

    def _signs_of_states(self) -> FloatArray | None:
        """1 in discharge and -1 in charge, if the states of the tester say so of both."""
        if "state" not in self.labels:
            return None
        codes, states = self.labels["state"]
        names = [str(state).strip().lower() for state in states]
        discharging = np.array([name == "d" or "dch" in name or "disch" in name for name in names])
        charging = np.array([name == "c" or "ch" in name for name in names]) & ~discharging
        if not (discharging.any() and charging.any()):
            return None
        return np.where(np.append(charging, False)[codes], -1.0, 1.0)

    def _effect_on_voltage(self) -> float:
        """
        How the voltage goes with the current, which shows where the load is switched, and with the charge that has passed,
        which shows where it is steady: the sum of the coefficients of a linear fit within each cycle, all columns in standard
        deviations.
        """
        time_s, voltage_V, current_A = (self.columns[name] for name in ("time", "voltage", "current"))
        step_s = np.diff(time_s)
        charge_C = np.append(0.0, np.cumsum(0.5 * (current_A[1:] + current_A[:-1]) * np.maximum(step_s, 0.0)))
        new = step_s < 0.0
        if "cycle" in self.columns:
            new |= np.diff(self.columns["cycle"]) != 0.0
        cycle = np.append(0, np.cumsum(new))
        columns = pd.DataFrame({"current": current_A, "charge": charge_C, "voltage": voltage_V})
        with np.errstate(over="ignore", invalid="ignore"):  # of columns that are no measurements
            within = (columns - columns.groupby(cycle).transform("mean")).to_numpy()
            rounding = np.finfo(np.float64).tiny + 1e-9 * np.abs(columns.to_numpy()).max(axis=0)
            scaled = within / np.maximum(within.std(axis=0), rounding)
        if not np.isfinite(scaled).all():
            return float("nan")
        return float(np.linalg.lstsq(scaled[:, :2], scaled[:, 2], rcond=None)[0].sum())

    def _split(self, source: str) -> list[Recording]:
        cycles = self.columns.get("cycle")
        bounds = [0, len(self.columns["time"])]
        if cycles is not None:
            bounds = [0, *(np.flatnonzero(np.diff(cycles)) + 1).tolist(), bounds[1]]
        parts = [part for low, high in itertools.pairwise(bounds) for part in self._discharges(low, high)]
        if not parts:
            raise ValueError("there is no discharge: no charge is drawn. Check the sign of the current")
        least_C = _LEAST_SHARE * max(drawn_C for _, drawn_C in parts)
        stretches = [stretch for stretch, drawn_C in parts if drawn_C >= least_C]
        return [self._recording(stretch, n, len(stretches), source) for n, stretch in enumerate(stretches, start=1)]

    def _discharges(self, low: int, high: int) -> list[tuple[slice, float]]:
        """The discharges among some rows, and the charge that each draws, C."""
        time_s, current_A = self.columns["time"][low:high], self.columns["current"][low:high]
        clock_s = np.append(0.0, np.cumsum(np.maximum(np.diff(time_s), 0.0)))  # which does not go back
        passed_C = drawn(clock_s, current_A, clock_s)
        charges = _charges(current_A, passed_C)
        least_C = _CHARGED_SHARE * float((passed_C - np.minimum.accumulate(passed_C)).max())
        found, begin, lowest_C, highest_C = [], 0, passed_C[0], passed_C[0]
        for start, end in charges:
            drawn_C, highest_C = passed_C[start] - lowest_C, max(highest_C, passed_C[start])
            returned_C = passed_C[start] - passed_C[end - 1]
            # a charge may be logged in many steps, of which each returns little
            if drawn_C > 0.0 and returned_C > _RETURNED_SHARE * drawn_C and highest_C - passed_C[end - 1] > least_C:
                found.append((begin, start))
                begin, lowest_C = start, passed_C[start]
            if passed_C[end - 1] < lowest_C:
                lowest_C = highest_C = passed_C[end - 1]
        found.append((begin, high - low))
        parts = []
        for begin, end in found:
            peak_A = current_A[begin:end].max()
            if not peak_A > 0.0:
                continue
            first = begin + int(np.argmax(current_A[begin:end] > SWITCH_SHARE * peak_A))
            drawn_C = float(passed_C[first:end].max() - passed_C[first])
            for start, stop in charges:
                if begin <= start and stop <= first and passed_C[start] - passed_C[stop - 1] > _CHARGED_SHARE * drawn_C:
                    begin = stop
            parts.append((slice(low + begin, low + end), drawn_C))
        return parts

    def _recording(self, stretch: slice, number: int, count: int, source: str) -> Recording:
        meta: dict[str, Any] = {"source": source}
        if "cycle" in self.columns:
            meta["cycle"] = int(self.columns["cycle"][stretch.start])
        elif count > 1:
            meta["cycle"] = number
        if "ambient" in self.columns and not np.isnan(self.columns["ambient"][stretch]).all():
            meta["ambient_temperature_C"] = float(np.nanmedian(self.columns["ambient"][stretch]))
        time_s = self.columns["time"][stretch]
        arrays = {
            "time_s": time_s - time_s[0] if count > 1 else time_s,
            "voltage_V": self.columns["voltage"][stretch],
            "current_A": self.columns["current"][stretch],
        }
        if "temperature" in self.columns:
            temperature_C = _filled(time_s, self.columns["temperature"][stretch])
            if temperature_C is not None:
                arrays["temperature_C"] = temperature_C
        return Recording(arrays, meta)


def _charges(current_A: FloatArray, passed_C: FloatArray) -> list[tuple[int, int]]:
    """Where the cell is charged, noise at rest left aside: the first sample, and the one after the last."""
    charging = np.concatenate([[False], current_A < 0.0, [False]])
    starts, ends = np.flatnonzero(~charging[:-1] & charging[1:]), np.flatnonzero(charging[:-1] & ~charging[1:])
    counts = passed_C[starts] - passed_C[ends - 1] > _NOTHING_SHARE * float(np.ptp(passed_C))
    return list(zip(starts[counts].tolist(), ends[counts].tolist(), strict=True))


def _filled(time_s: FloatArray, temperature_C: FloatArray) -> FloatArray | None:
    """The temperature at all samples, where some of them have none; nothing where all have none."""
    known = ~np.isnan(temperature_C)
    if known.all():
        return temperature_C
    if not known.any():
        return None
    gap_s = float(np.diff([time_s[0], *time_s[known], time_s[-1]]).max())
    if gap_s > _TEMPERATURE_GAP_S:
        warnings.warn(f"the temperature is missing for up to {gap_s:.0f} s, and interpolated", stacklevel=2)
    return np.interp(time_s, time_s[known], temperature_C[known])


def _numbers(values: pd.Series, column: Column) -> FloatArray:
    if pd.api.types.is_numeric_dtype(values.dtype):
        return values.to_numpy(dtype=np.float64, na_value=np.nan)
    numbers = pd.to_numeric(values, errors="coerce")
    bad = values[numbers.isna() & values.notna()]
    if len(bad):
        advice, thousands = "", bad[bad.astype(str).str.match(_THOUSANDS)]
        if len(thousands):
            advice, bad = ". Write numbers without separators of thousands", thousands
        text = str(bad.iloc[0])
        raise ValueError(f"the column {column.name!r} must hold numbers, got {text!r} in row {bad.index[0] + 1}{advice}")
    return numbers.to_numpy(dtype=np.float64)


def _seconds(values: pd.Series, column: Column) -> FloatArray:
    """Numbers in their unit; a clock, hours:minutes:seconds, in seconds; dates in seconds since the earliest one."""
    if pd.api.types.is_numeric_dtype(values.dtype):
        return column.factor * _numbers(values, column)
    if pd.api.types.is_datetime64_any_dtype(values.dtype):
        return (values - values.min()).dt.total_seconds().to_numpy(dtype=np.float64)
    if pd.api.types.is_timedelta64_dtype(values.dtype):
        return values.dt.total_seconds().to_numpy(dtype=np.float64)
    if not values.dropna().astype(str).str.contains(":").all():
        return column.factor * _numbers(values, column)
    text = values.astype(str).str.strip().str.replace(",", ".")
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
                found.append(_seconds(pd.Series(convert(text, **options), index=values.index), column))
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
