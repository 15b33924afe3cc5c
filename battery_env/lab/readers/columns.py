"""Which column of a table is which measurement, and in which unit: by the names of the testers' table, or as is stated."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from unicodedata import normalize

from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.readers.testers import INSTEAD, LONGEST, QUANTITIES, REQUIRED, TESTERS, Tester, joined, words_of
from battery_env.records.refusals import Advice, RecordError

# Quantities that only a name with a unit is: p and q may be anything.
_WITH_UNIT = ("counter", "power", "charge_step", "capacity")


def _units(factors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    return {name: (factor, 0.0) for names, factor in factors.items() for name in names.split()}


_TIMES = _units(
    {
        "s sec secs second seconds": 1.0,
        "ms millisecond milliseconds": 1e-3,
        "us \u03bcs microsecond microseconds": 1e-6,
        "ns nanosecond nanoseconds": 1e-9,
        "min mins minute minutes": 60.0,
        "h hr hrs hour hours": 3600.0,
        "d day days": 86400.0,
    }
)
_VOLTS = _units({"v volt volts": 1.0, "mv mvolt mvolts": 1e-3})
_CHARGES = _units({"mah": 3.6, "ah ahr amphr": 3600.0})
_DEGREES = dict(_units({"c degc celsius": 1.0}), k=(1.0, -ZERO_CELSIUS_K), kelvin=(1.0, -ZERO_CELSIUS_K))
# By quantity and unit in small letters alone: factor and offset to s, V, A, degC, W and C.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": _TIMES,
    "date": _TIMES,
    "voltage": _VOLTS,
    "counter": _VOLTS,
    "current": _units({"a amp amps ampere amperes": 1.0, "ma mamp mamps": 1e-3, "ua \u03bca": 1e-6}),
    "power": _units({"w watt watts": 1.0, "mw": 1e-3}),
    "charge_step": _CHARGES,
    "temperature": _DEGREES,
    "ambient": _DEGREES,
    "capacity": _CHARGES,
}
# Units stand in brackets, or behind a stroke, or are the last word.
_UNIT = re.compile(r"[(\[](?P<bracket>[^()\[\]]*)[)\]]|/(?P<stroke>[^/]*)$")
# A stated unit may have a number, as in 0.01 A.
_SCALED = re.compile(r"^\s*(\d+\.?\d*|\.\d+|)(.*)")
# A unit of text such as 1:02:03.5, which becomes seconds when it is read, by its letters.
_CLOCK = re.compile(r"(?:hours?in)?h+m+(?:in)?s+[msfxz]*$")
# What testers call the steps in which a cell is discharged, and those of other words in which it is charged.
_DISCHARGE = re.compile(r"\bd\b|\bdis\b|dch|dsg|disch|entlad|放电")
_CHARGE = re.compile(r"\bc\b|ch|lad|充电")


class Column(NamedTuple):
    """A column and what makes SI of it."""

    position: int  # among the columns of the table
    name: str  # as the table has it
    unit: str = ""  # as its name or the caller says, empty if neither does
    factor: float = 1.0  # makes s, V or A of its values, or differences of temperature in K
    offset: float = 0.0  # is added then


@dataclass(frozen=True)
class FileFormat:
    """
    What files do not tell of themselves, see :func:`battery_env.read_discharges`.

    :param columns: by quantity, the name of its column
    :param units: by quantity, its unit
    :param discharge_is_negative: how the file counts the current of a discharge; ``None``: told from the voltage
    :param ignore: names of columns that are not looked at
    :param tester: whose table it is; ``None``: told from the names
    :param load: times in s and currents in A, or powers in W, of a load that the file does not hold, and its unit
    """

    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None
    discharge_is_negative: bool | None = None
    ignore: Collection[str] = ()
    tester: Tester | None = None
    load: tuple[list[float], list[float], str] | None = None


class Recognised(NamedTuple):
    """What is known of a table by its header."""

    tester: Tester
    columns: dict[str, Column]  # by quantity; of names as good as that of voltage, voltage2 is the second
    missing: list[str]  # quantities that a record must have
    names: Sequence[str]  # all of the table
    rows: Sequence[Sequence[str]]  # fields of its first rows

    def lines(self) -> list[str]:
        """What the table begins with, and what is known of it."""
        told = {"header": ", ".join(self.names)}
        told |= {f"row {n}": ", ".join(row) for n, row in enumerate(self.rows[:2], start=1)}
        told |= {"tester": self.tester.name}
        told |= {key: f"{each.name!r}{f' in {each.unit}' if each.unit else ''}" for key, each in self.columns.items()}
        told |= {each: "not found" for each in self.missing} | {"not used": ", ".join(self._unused())}
        return [f"{key:<12}{text[:LONGEST]}{' ...' * (len(text) > LONGEST)}".rstrip() for key, text in told.items()]

    def _unused(self) -> list[str]:
        used = {column.position for column in self.columns.values()}
        return [name for n, name in enumerate(self.names) if name and n not in used]

    @property
    def open_questions(self) -> frozenset[str]:
        """What may be stated: units that nothing tells, and the sign."""
        return frozenset(each for each, column in self.columns.items() if not column.unit) | {"is positive", "is negative"}

    def check(self) -> Recognised:
        """Refuse a table of which quantities are missing, and name what may be them: columns with such a unit, or else any."""
        if not self.missing:
            return self
        unused = self._unused()
        fitting = {each: [name for name in unused if _unit_in(name, each)] for each in self.missing}
        others = iter([name for name in unused if not any(name in names for names in fitting.values())])
        named = {each: names or [next(others, "NAME")] for each, names in fitting.items()}
        choices = range(max(map(len, named.values())))
        likely = [{each: names[min(n, len(names) - 1)] for each, names in named.items()} for n in choices]
        advice = [Advice("Name the columns, or their places", "columns", each) for each in likely]
        raise RecordError(f"no column for the {', the '.join(self.missing)}", advice)


def recognise(names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]]) -> Recognised:
    """
    Which tester's table it is, the first of which it has a mark, and its columns. A unit is told from the name, as in
    ``Current(mA)``, ``Voltage / V``, ``mAmps`` or ``test_time_second``, or from the line below it; one of another quantity
    rules a column out.
    """
    names = [str(name).strip() for name in names]
    labels = _labels(names, rows, {name.strip() for name in file_format.ignore})
    keys = {key for label in labels for key, _ in _parted(label)}
    marked = [each for each in TESTERS if any("".join(words_of(name)) in keys for name in each.told_by)]
    tester = file_format.tester or (joined(marked[0], TESTERS[-1]) if marked else TESTERS[-1])
    units = {**tester.units, **(file_format.units or {})}
    chosen = _places_of(file_format.columns or {}, units, names)
    ranks = [_ranks(label, tester) for label in labels]
    found = dict[str, Column]()
    for quantity in QUANTITIES:
        if quantity in INSTEAD["current"] and ("current" in found or file_format.load):
            continue
        # a column is one thing, but where the caller says otherwise
        used = {column.position for column in found.values()} | set(chosen.values())
        free = {n: each[quantity] for n, each in enumerate(ranks) if quantity in each and n not in used}
        places = [n for n, rank in free.items() if rank == min(free.values())]
        if quantity in chosen:
            places = [chosen[quantity]]
        scale, stated = _SCALED.findall(units.get(quantity, ""))[0]
        for number, place in enumerate(places if quantity in REQUIRED else places[:1], start=1):
            unit = _unit(stated, quantity) or _unit_in(labels[place], quantity)
            if unit or quantity not in _WITH_UNIT:
                factor, offset = _UNITS.get(quantity, {}).get(unit, (1.0, 0.0))
                key = quantity if number == 1 else f"{quantity}{number}"
                found[key] = Column(place, names[place], unit, float(scale or 1.0) * factor, offset)
    given = {"current"} if file_format.load else set[str]()
    missing = [each for each in REQUIRED if not {each, *INSTEAD.get(each, ())} & (set(found) | given)]
    return Recognised(tester, found, missing, names, rows)


def _places_of(columns: Mapping[str, str], units: Mapping[str, str], names: Sequence[str]) -> dict[str, int]:
    """Which column is stated for each quantity, by its name, or else by its place from 1 on."""
    for option, told in (("columns", columns), ("units", units)):
        if unknown := set(told) - set(QUANTITIES):
            raise ValueError(f"{option} knows {', '.join(QUANTITIES)}, got {', '.join(sorted(unknown))}")
    known = [*names, *(str(n + 1) for n in range(len(names)))]
    for quantity, name in columns.items():
        if name.strip() not in known:
            raise ValueError(f"there is no column {name!r} for the {quantity} among {', '.join(filter(None, names))}")
    for quantity, unit in units.items():
        if quantity in _UNITS and not _unit(unit, quantity):
            raise ValueError(f"the unit {unit!r} of the {quantity} is not known, but {', '.join(_UNITS[quantity])}")
    return {quantity: known.index(name.strip()) % len(names) for quantity, name in columns.items()}


def _labels(names: Sequence[str], rows: Sequence[Sequence[str]], ignore: Collection[str]) -> list[str]:
    """Names of columns that are looked at, with the units that are written below them, where they have none themselves."""
    labels = ["" if name in ignore else name for name in names]
    if not (rows and are_units(rows[0])):
        return labels
    below = [text.strip("[]()- ") for text in [*rows[0], *[""] * len(labels)]]
    return [f"{name} ({unit})" if name and not _UNIT.search(name) else name for name, unit in zip(labels, below, strict=False)]


def _ranks(label: str, tester: Tester) -> dict[str, int]:
    """The quantities that a name may be, by its unit too, and its rank among the names of each."""
    found: dict[str, int] = {}
    for key, unit in _parted(label):
        for quantity, rank in tester.ranks.get(key, {}).items():
            if quantity not in _UNITS or not _letters(unit) or _unit(unit, quantity):
                found.setdefault(quantity, rank)
    return found


@lru_cache(maxsize=4096)
def _parted(name: str) -> tuple[tuple[str, str], ...]:
    """What a name may be, and its unit: the whole, what is in brackets or behind a stroke, the last word."""
    name = normalize("NFKC", name)[:LONGEST]
    words, match = words_of(name), _UNIT.search(name)
    found = [("".join(words), "")]
    if match:
        base = name[: match.start()] + name[match.end() :]
        found.append(("".join(words_of(base)), match["bracket"] or match["stroke"] or ""))
    if len(words) > 1 and any(_unit(words[-1], quantity) for quantity in _UNITS):
        found.append(("".join(words[:-1]), words[-1]))
    return tuple(found)


def _unit_in(name: str, quantity: str) -> str:
    """The unit in a name, whatever the rest of it is: one that is the whole name, as mAmps, too."""
    (whole, _), *parted = _parted(name)
    return next((unit for text in (whole, *(unit for _, unit in parted)) if (unit := _unit(text, quantity))), "")


def _letters(text: str) -> str:
    """A unit by its letters: signs of degrees are lost by encodings, and dots and strokes part factors."""
    return re.sub(r"[^a-z\u03bc]", "", normalize("NFKC", text).lower())


def _unit(text: str, quantity: str) -> str:
    """A unit as the table of units has it, or nothing; what is said behind it, as in ``V vs. Ref.``, is left out."""
    if quantity == "time" and _CLOCK.match(_letters(text)):
        return "s"
    units = map(_letters, (text, text.strip().partition(" ")[0]))
    return next((unit for unit in units if unit in _UNITS.get(quantity, {})), "")


def are_units(fields: Sequence[str]) -> bool:
    """Whether the line below a header holds units, where some testers write them; a clock may have none."""
    return not any(map(str.isdigit, "".join(fields))) and all(
        any(_unit(text, quantity) for text in fields) for quantity in ("voltage", "current")
    )


def count_required(names: Iterable[str], file_format: FileFormat) -> int:
    """How much a line looks like the header of a record."""
    stated = {name.strip(): quantity for quantity, name in (file_format.columns or {}).items()}
    found = {quantity for name in names for quantity in _ranks(name, file_format.tester or TESTERS[-1])}
    found |= {stated[name.strip()] for name in names if name.strip() in stated}
    return sum(bool(found & {quantity, *INSTEAD.get(quantity, ())}) for quantity in REQUIRED)


def direction(state: object) -> int:
    """1 for what a tester calls a discharge, -1 for a charge, else 0."""
    words = " ".join(words_of(str(state)))
    return 1 if _DISCHARGE.search(words) else -1 if _CHARGE.search(words) else 0


def say(text: str) -> None:
    """Tell who reads a file what was done to it."""
    warnings.warn(text, stacklevel=3)
