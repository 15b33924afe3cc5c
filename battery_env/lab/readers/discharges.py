"""
Recorded discharges from files and tables as testers write them: which columns, which unit, which sign, and which of the rows
are a discharge.
"""

from __future__ import annotations

import itertools
import os
import re
import warnings
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from battery_env.arrays import FloatArray
from battery_env.lab.readers.columns import Column, FileFormat, unit_of
from battery_env.lab.readers.rows import cells_of, mended
from battery_env.lab.readers.tables import columns_of, read_columns
from battery_env.records import LEAST_LOAD_SHARE, SWITCH_SHARE, ChargeBefore, ChargeHistory, drawn
from battery_env.records.discharge import LEAST_SAMPLES, Discharge, read_nasa_mat

Made = TypeVar("Made")

# A stretch of charging ends a discharge if it returns more than this share of the charge drawn until then; less is braking.
_RETURNED_SHARE = 0.2
# A charge before the load is cut off if it exceeds this share of the charge drawn; a smaller one is sensor offset. A charge
# within the load ends the discharge only if it returns more than this share of the largest charge drawn: early pulses return
# much of the little drawn yet.
_CHARGED_SHARE = 0.02
# What returns less than this share of the charge that passes in all is not looked at.
_NOTHING_SHARE = 1e-3
# What draws less than this share of the largest discharge of its file is a pulse between two charges, and left aside; so is
# what draws less than _RETURNED_SHARE of the charge before and of the charge after.
_LEAST_SHARE = 0.01
# Over longer gaps than this a temperature that is missing is a guess, s.
_TEMPERATURE_GAP_S = 600.0
# What the tester counted may be off by this share, as of rows a minute apart.
_COUNTED_SHARE = 0.01
# Where the voltage comes back so near to that of the start, as a share of its fall, the cell was charged; so little of the
# fall of the whole record is a pulse.
_BACK_SHARE = 0.25
# What errors advise.
_SENTENCE = re.compile(r"(?<=[^.\s]\.)\s+(?=[A-Z])")
_UNIT_ADVICE = re.compile(r" in [^,]+, not in \w+ \(command line: --units (\w+)=(\w+)\)(, and)?")
_CLOCK_ADVICE, _SIGN_ADVICE = "Give the time in seconds: ", ": flip the sign"
_STEP_ADVICE = re.compile(r", or name the column of its step|, and one that does with each step a column of the step")


class Recording(NamedTuple):
    """What a file or a table holds of one discharge, not checked yet."""

    arrays: dict[str, Any]  # arguments of Discharge, by name
    meta: dict[str, Any]  # what else is known; without ``cycle`` if the file holds one discharge and does not number it
    # quantities of known unit, ``step`` if it has a column, ``sign`` if that was told from the data
    stated: frozenset[str] = frozenset()

    def discharge(self) -> Discharge:
        """Check it; what an error advises is left out where it contradicts what is known, or would not help."""
        if (count := len(self.arrays["time_s"])) < LEAST_SAMPLES:
            raise ValueError(f"{count} rows are no discharge. If each is the end of a step, export all that was recorded.")
        try:
            return Discharge(**self.arrays, meta=self.meta)
        except ValueError as error:
            raise ValueError(" ".join(filter(None, map(self._helpful, _SENTENCE.split(str(error)))))) from error

    def _helpful(self, sentence: str) -> str:
        """What is left of a sentence of an error once the option that it advises, if any, was tried."""
        if "step" in self.stated:
            sentence = _STEP_ADVICE.sub("", sentence)
        if "time" in self.stated and sentence.startswith(_CLOCK_ADVICE):
            return ""
        unit = _UNIT_ADVICE.search(sentence)
        if not unit and _SIGN_ADVICE not in sentence:
            return sentence
        quantity, (factor, offset) = (unit[1], unit_of(unit[1], unit[2])) if unit else ("current", (-1.0, 0.0))
        if (quantity if unit else "sign") not in self.stated:
            name = next(each for each in self.arrays if each.startswith(quantity))
            try:
                Discharge(**self.arrays | {name: factor * self.arrays[name] + offset})
                return sentence
            except ValueError:
                pass
        if unit:
            return _UNIT_ADVICE.sub(",", sentence) if unit[3] else ""
        return sentence.partition(_SIGN_ADVICE)[0] + "."


def read_discharges(
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
    ignore: Collection[str] = (),
) -> list[Discharge]:
    """
    Read the discharges of a file or of a table.

    A table is a ``pandas.DataFrame``, whose index is a column too if it has a name. A file is text with a header (commas,
    semicolons, tabs or blanks, decimal points or commas, also packed as .gz, .bz2, .xz or .zip), Parquet, one of NASA's .mat
    files, with the extra ``excel`` a workbook, or with the extra ``cyclers`` a binary file of Neware (.nda, .ndax) or BioLogic
    (.mpr). Columns go by the names that testers give them; their units are told from the names.

    It may hold charges and rests as well, many cycles, and several cells if a column names them. A discharge is what lies
    between two charges, with the rest before the load; it is numbered by the cycle that is given, or else counted. If there
    are several, each has its own clock, which starts at its first sample. Discharges whose charges are not logged are told
    apart by the column of the cycle, or a clock that starts anew at rest, alone. What is mended is said in a warning. A
    temperature that is missing in some rows is interpolated.

    .. code-block:: python

      frame = pd.DataFrame({"Test Time / s": time, "Voltage / V": voltage, "Current / A": current})
      discharges = read_discharges(frame)

    :param source: the file, or the table
    :param columns: by quantity (``time``, ``voltage``, ``current``, ``temperature``, ``ambient``, ``cycle``, ``step``,
        ``state``, ``cell``), the name of its column, where the names do not tell
    :param units: by quantity, its unit, where the name does not tell: ``s``, ``ms``, ``min``, ``h``; ``V``, ``mV``; ``A``,
        ``mA``; ``degC``, ``K``
    :param discharge_is_negative: how the current of a discharge is counted; ``None``: told from the voltage, which jumps
        against a load where that is switched, or from words for charge and discharge
    :param ignore: names of columns that are not looked at
    :return: the discharges; their ``meta`` holds ``source`` and, if there are several or they are numbered, ``cycle``. One
        that fails the checks of :class:`~battery_env.Discharge` is left out with a warning
    :raises ValueError: if there is none, the file is damaged, or it does not tell what is asked for
    :raises ImportError: if the file needs an extra that is not installed
    """
    return each_usable(lambda discharge: discharge, source, FileFormat(columns, units, discharge_is_negative, ignore))


def each_usable(use: Callable[[Discharge], Made], source: str | Path | pd.DataFrame, file_format: FileFormat) -> list[Made]:
    """What is made of each discharge. One that cannot be used is left out with a warning; if none can, that is an error."""
    made, reasons = [], []
    for recording in read_recordings(source, file_format):
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


def read_recordings(source: str | Path | pd.DataFrame, file_format: FileFormat) -> list[Recording]:
    """
    The discharges of a file or a table before they are checked, so that one that cannot be used does not lose the others; one
    at least. Those of a table of several cells have the ``cell`` in their ``meta``.
    """
    name = _name_of(source)
    try:
        if isinstance(source, pd.DataFrame):
            recordings = _recordings(name, *columns_of(source, file_format), file_format)
        elif Path(source).suffix.lower() == ".mat":
            recordings = [Recording(arrays, meta) for arrays, meta in read_nasa_mat(Path(source))]
        else:
            recordings = _recordings(name, *read_columns(Path(source), file_format), file_format)
        if not recordings:
            raise ValueError("there is no discharge")
    except (TypeError, ValueError) as error:
        raise ValueError(str(error) if name in str(error) else f"{name}: {error}") from error
    return recordings


def _name_of(source: str | Path | pd.DataFrame) -> str:
    if not isinstance(source, pd.DataFrame | str | os.PathLike):
        raise TypeError(f"expected a DataFrame or the path of a file, got {type(source).__name__}")
    return "DataFrame" if isinstance(source, pd.DataFrame) else str(source)


def _recordings(source: str, table: pd.DataFrame, columns: Mapping[str, Column], file_format: FileFormat) -> list[Recording]:
    stated = frozenset(quantity for quantity, column in columns.items() if column.unit or quantity == "step")
    stated |= {"sign"} if file_format.discharge_is_negative is None else set()
    found, reasons = [], []
    for cell, rows in cells_of(table, columns).items():
        meta = {"source": source} | ({"cell": cell} if cell else {})
        try:
            found += _split(mended(rows, columns, file_format), meta, stated)
        except ValueError as error:
            reasons.append(f"cell {cell}: {error}" if cell else str(error))
    if not found:
        raise ValueError(reasons[0])
    for reason in reasons:
        warnings.warn(f"{reason}. It is left out", stacklevel=2)
    return found


def _split(rows: pd.DataFrame, meta: dict[str, Any], stated: frozenset[str]) -> list[Recording]:
    """The discharges among the rows of one cell."""
    bounds = _bounds(rows)
    parts = [part for low, high in itertools.pairwise(bounds) for part in _discharges(rows, low, high)]
    if not parts:
        raise ValueError("there is no discharge: no charge is drawn. Check the sign of the current")
    least_C = _LEAST_SHARE * max(drawn_C for _, drawn_C in parts)
    passed_C = _passed_C(rows["time"].to_numpy(), rows["current"].to_numpy())
    ends_C = [passed_C[[stretch.start, stretch.stop - 1]] for stretch, _ in parts]
    charged_C = -np.diff(np.concatenate([[0.0], *ends_C, passed_C[-1:]]))[::2]
    pulses_C = _RETURNED_SHARE * np.minimum(charged_C[:-1], charged_C[1:])
    stretches = [part for (part, drawn_C), each_C in zip(parts, pulses_C, strict=True) if drawn_C >= max(each_C, least_C)]
    if not stretches:
        raise ValueError("there is no discharge: what is drawn are pulses within charges. Check the sign of the current")
    if pulses := sum(least_C <= drawn_C < each_C for (_, drawn_C), each_C in zip(parts, pulses_C, strict=True)):
        warnings.warn(f"pulses within charges, which are no discharges, are left aside: {pulses}", stacklevel=2)
    before = [ChargeHistory(charge=_charge_before(rows, each.start), load_on_s=_load_on_s(rows, each)) for each in stretches]
    return [
        _recording(
            rows[stretch], history, meta | ({"cycle": number} if len(stretches) > 1 else {}), len(stretches) > 1, stated
        )
        for number, (stretch, history) in enumerate(zip(stretches, before, strict=True), start=1)
    ]


def _bounds(rows: pd.DataFrame) -> list[int]:
    """
    Where a test begins, or the number of the cycle changes, but not where that parts a rest from its load, or a discharge
    whose voltage goes on: counters may count loops, or go up where the load is switched on.
    """
    bounds = [0]
    if {"cycle", "test"} & set(rows):
        time_s, voltage_V, current_A = (rows[name].to_numpy() for name in ("time", "voltage", "current"))
        switch_A, lowest_V = SWITCH_SHARE * np.abs(current_A).max(), voltage_V.min()
        charged = np.zeros(len(rows), dtype=np.bool_)
        for start, end, _, is_braking in _charges(current_A, _passed_C(time_s, current_A)):
            charged[start:end] = not is_braking and current_A[start:end].min() < -switch_A
        charges, under_load = np.flatnonzero(charged), np.flatnonzero(charged | (current_A > switch_A))
        counters = rows[[each for each in ("cycle", "test") if each in rows]]
        changes = (np.flatnonzero(np.diff(counters, axis=0).any(axis=1)) + 1).tolist()
        for n, following in itertools.pairwise([*changes, len(rows)]):
            k = int(np.searchsorted(under_load, n))
            before, after = (int(each[0]) if len(each) else None for each in (under_load[:k][-1:], under_load[k : k + 1]))
            if time_s[n] < time_s[n - 1] or (after is not None and charged[after]):
                bounds.append(n)
            elif after is not None and (before is None or charged[before]):
                # a rest that is all in the cycle before belongs to the load
                bounds.append(n if after > n else 0 if before is None else before + 1)
            elif after is not None:
                low = max(bounds[-1], *(charges[: np.searchsorted(charges, n)][-1:] + 1), 0)
                top_V, low_V = voltage_V[low:n].max(), voltage_V[low:n].min()
                is_back = top_V - voltage_V[n : min(after + 1, following)].max() < _BACK_SHARE * (top_V - low_V)
                if is_back and top_V - low_V > _BACK_SHARE * (top_V - lowest_V):
                    bounds.append(n)
    return [*sorted({*bounds}), len(rows)]


def _passed_C(time_s: FloatArray, current_A: FloatArray) -> FloatArray:
    """The charge that has passed at each row, on a clock that does not go back."""
    clock_s = np.append(0.0, np.cumsum(np.maximum(np.diff(time_s), 0.0)))
    return drawn(clock_s, current_A, clock_s)


def _discharges(rows: pd.DataFrame, low: int, high: int) -> list[tuple[slice, float]]:
    """The discharges among some rows, and the charge that each draws, C."""
    time_s, current_A = (rows[name].to_numpy()[low:high] for name in ("time", "current"))
    passed_C = _passed_C(time_s, current_A)
    charges = _charges(current_A, passed_C)
    found = list(itertools.pairwise([0, *(start for start, _, is_end, _ in charges if is_end), high - low]))
    parts = []
    for begin, end in found:
        peak_A = current_A[begin:end].max()
        if not peak_A > 0.0:
            continue
        first = begin + int(np.argmax(current_A[begin:end] > SWITCH_SHARE * peak_A))
        drawn_C = float(passed_C[first:end].max() - passed_C[first])
        for start, stop, _, is_braking in charges:
            is_before = begin <= start and stop <= (first if is_braking else end)
            if is_before and passed_C[start] - passed_C[stop - 1] > _CHARGED_SHARE * drawn_C:
                begin = stop
        if begin < end:
            parts.append((slice(low + begin, low + end), float(passed_C[begin:end].max() - passed_C[begin])))
    return parts


def _charge_before(rows: pd.DataFrame, begin: int) -> ChargeBefore | None:
    """The charge that ends where a discharge begins, if it is in the table and no mere noise."""
    current_A = rows["current"].to_numpy()
    start = int(np.append(-1, np.flatnonzero(current_A[:begin] >= 0.0))[-1]) + 1
    charging_A = current_A[start:begin]
    if not (charging_A < -LEAST_LOAD_SHARE * np.abs(current_A).max()).any():
        return None
    time_s, voltage_V = (rows[each].to_numpy()[start:begin] for each in ("time", "voltage"))
    return ChargeBefore.of(time_s, voltage_V, charging_A)


def _load_on_s(rows: pd.DataFrame, stretch: slice) -> float | None:
    """When the load of a discharge came on, if its first row says how long ago that was, or how much was drawn since."""
    time_s, current_A = (rows[name].to_numpy() for name in ("time", "current"))
    n = stretch.start + int(np.argmax(current_A[stretch] > SWITCH_SHARE * current_A[stretch].max()))
    if not 0 < n < len(rows) - 1:
        return None
    interval_s, ago_s, teller = time_s[n] - time_s[n - 1], np.inf, ""
    if "capacity" in rows:
        (on_C, next_C), now_C = np.diff(rows["capacity"].iloc[n - 1 : n + 2]), rows["capacity"].iloc[n]
        if abs(abs(next_C) / current_A[n] - (time_s[n + 1] - time_s[n])) <= SWITCH_SHARE * (time_s[n + 1] - time_s[n]):
            # a counter may start anew with each step
            ago_s, teller = abs(on_C if on_C * next_C >= 0.0 else now_C) / current_A[n], "the count of the tester"
    if "step_time" in rows:
        step_s, later_s = rows["step_time"].iloc[n : n + 2]
        ago_s, teller = (step_s, "the time in its step") if 0.0 <= step_s < later_s else (ago_s, teller)
    # the two clocks need not agree to the last digit, nor a count of few digits
    if not ago_s <= (1.0 + SWITCH_SHARE) * interval_s:
        return None
    told_s = max(float(time_s[n] - ago_s), float(time_s[n - 1]))
    if interval_s > 2.0 * max(time_s[n + 1] - time_s[n], time_s[n - 1] - time_s[max(n - 2, 0)]):
        warnings.warn(
            f"the load came on {time_s[n] - told_s:g} s before row {rows.index[n] + 1}, as {teller} says", stacklevel=2
        )
    return told_s


def _recording(
    rows: pd.DataFrame, history: ChargeHistory, meta: dict[str, Any], has_own_clock: bool, stated: frozenset[str]
) -> Recording:
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    if has_own_clock and history.load_on_s is not None:
        history = history._replace(load_on_s=history.load_on_s - float(time_s[0]))
    if "cycle" in rows:
        meta["cycle"] = int(rows["cycle"].iloc[int(np.argmax(current_A > SWITCH_SHARE * current_A.max()))])
    if "ambient" in rows and not rows["ambient"].isna().all():
        meta["ambient_temperature_C"] = float(rows["ambient"].median())
    arrays = {
        "time_s": time_s - time_s[0] if has_own_clock else time_s,
        "voltage_V": rows["voltage"].to_numpy(),
        "current_A": current_A,
    }
    if "temperature" in rows:
        temperature_C = _filled(time_s, rows["temperature"].to_numpy())
        if temperature_C is not None:
            arrays["temperature_C"] = temperature_C
    arrays["history"] = _with_count(history, rows)
    return Recording(arrays, meta, stated)


def _with_count(history: ChargeHistory, rows: pd.DataFrame) -> ChargeHistory:
    """With how much the charge under load is another one than the tester counted row by row, or than a clock lost."""
    time_s, current_A = rows["time"].to_numpy(), rows["current"].to_numpy()
    loaded = np.flatnonzero(current_A > SWITCH_SHARE * current_A.max())
    if not len(loaded):  # of values that no cell has, which are refused later
        return history
    part = slice(loaded[0], loaded[-1] + 1)
    if "lost" in rows:  # all of it in each step of the program, none, or any part in all alike
        history = history._replace(uncounted_C=float(rows["lost"].to_numpy()[part][1:].sum()) / 3.0**0.5)
    if "capacity" not in rows or len(loaded) < LEAST_SAMPLES:
        return history
    step_C = np.diff(rows["capacity"].to_numpy()[part])
    step_C = step_C if (step_C > 0.0).sum() > (step_C < 0.0).sum() else -step_C  # a counter may count down
    if (step_C > 0.0).mean() < 0.5:
        return history
    goes_on = step_C >= 0.0
    is_counted = bool(goes_on.all())
    if not is_counted:  # but anew with each step, of which the last row may be missing
        goes_on &= np.abs(np.diff(current_A[part])) <= SWITCH_SHARE * current_A.max()
    counted_C = float(step_C[goes_on].sum())
    # some count what is drawn alone, others what is returned, too
    passed_C = [drawn(time_s[part], each[part], time_s[part]) for each in (np.maximum(current_A, 0.0), np.abs(current_A))]
    off_C = min((float(np.diff(each)[goes_on].sum()) - counted_C for each in passed_C), key=abs)
    if abs(off_C) > _COUNTED_SHARE * counted_C:
        warnings.warn(
            f"the tester counted {counted_C / 3600.0:.4g} Ah, where current and time make {(counted_C + off_C) / 3600.0:.4g} "
            "Ah: check units and clock, and that all rows are there",
            stacklevel=2,
        )
    return history._replace(is_counted=is_counted, uncounted_C=abs(off_C))


def _charges(current_A: FloatArray, passed_C: FloatArray) -> list[tuple[int, int, bool, bool]]:
    """
    Where the cell is charged, noise at rest left aside: the first sample, the one after the last, whether that ends a
    discharge, and whether it is braking, which returns less than was drawn and ends none.
    """
    charging = np.concatenate([[False], current_A < 0.0, [False]])
    starts, ends = np.flatnonzero(~charging[:-1] & charging[1:]), np.flatnonzero(charging[:-1] & ~charging[1:])
    counts = passed_C[starts] - passed_C[ends - 1] > _NOTHING_SHARE * float(np.ptp(passed_C))
    least_C = _CHARGED_SHARE * float((passed_C - np.minimum.accumulate(passed_C)).max())
    found, lowest_C, highest_C = [], passed_C[0], passed_C[0]
    for start, end in zip(starts[counts].tolist(), ends[counts].tolist(), strict=True):
        drawn_C, highest_C = passed_C[start] - lowest_C, max(highest_C, passed_C[start])
        returned_C = passed_C[start] - passed_C[end - 1]
        # a charge may be logged in many steps, of which each returns little
        is_end = drawn_C > 0.0 and returned_C > _RETURNED_SHARE * drawn_C and highest_C - passed_C[end - 1] > least_C
        found.append((start, end, bool(is_end), bool(not is_end and returned_C < drawn_C)))
        lowest_C = passed_C[start] if is_end else lowest_C
        if passed_C[end - 1] < lowest_C:
            lowest_C = highest_C = passed_C[end - 1]
    return found


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
