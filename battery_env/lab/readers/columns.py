"""The quantities and units of the columns of a table, by the names of testers, or as stated."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from unicodedata import normalize

from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.readers.testers import LONGEST, QUANTITIES, REQUIRED, SUBSTITUTES, TESTERS, Tester, merge, words_of
from battery_env.records.refusals import Advice, RecordError

# Messages name at most so many columns, rows or files.
_MOST_NAMED = 10
# Quantities whose names need a unit: p and q may mean anything.
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
# Factor and offset to s, V, A, degC, W and C, by quantity and by unit in small letters.
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
# A unit stands in brackets, behind a stroke, or as the last word.
_UNIT = re.compile(r"[(\[](?P<bracket>[^()\[\]]*)[)\]]|/(?P<stroke>[^/]*)$")
# A stated unit may have a number, as in 0.01 A.
_SCALED_UNIT = re.compile(r"^\s*(\d+\.?\d*|\.\d+|)(.*)")
# Letters of a unit of text such as 1:02:03.5, which is read as seconds.
_CLOCK = re.compile(r"(?:hours?in)?h+m+(?:in)?s+[msfxz]*$")
# Words of testers for a discharge, and, among all other words, for a charge.
_DISCHARGE = re.compile(r"\bd\b|\bdis\b|dch|dsg|disch|entlad|放电")
_CHARGE = re.compile(r"\bc\b|ch|lad|充电")


class Column(NamedTuple):
    """A column and its conversion to SI units."""

    position: int  # among the columns of the table
    name: str  # in the table
    unit: str = ""  # stated, or in the name; empty if neither
    factor: float = 1.0  # of the values, to s, V, A, or differences of temperature in K
    offset: float = 0.0  # added after the factor


@dataclass(frozen=True)
class FileFormat:
    """
    What a user states about a file, see :func:`battery_env.read_discharges`.

    :param columns: names of columns, by quantity
    :param units: units, by quantity
    :param discharge_is_negative: whether the current of a discharge is negative; ``None``: by words or voltage
    :param ignore: names of columns to ignore
    :param tester: the tester of the table; ``None``: by the names
    :param load: times in s and currents in A, or powers in W, of a load that is not in the file, and its unit
    """

    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None
    discharge_is_negative: bool | None = None
    ignore: Collection[str] = ()
    tester: Tester | None = None
    load: tuple[list[float], list[float], str] | None = None


class TableHeader(NamedTuple):
    """The recognised header of a table."""

    tester: Tester
    columns: dict[str, Column]  # by quantity; voltage2 has a name that suits the voltage equally well
    missing: list[str]  # required quantities without a column
    names: Sequence[str]  # all names
    rows: Sequence[Sequence[str]]  # fields of the first rows

    def lines(self) -> list[str]:
        """Return the beginning of the table, and its recognised columns, as lines of text."""
        entries = {"header": ", ".join(self.names)}
        entries |= {f"row {n}": ", ".join(row) for n, row in enumerate(self.rows[:2], start=1)}
        entries |= {"tester": self.tester.name}
        units = {key: f" in {column.unit}" if column.unit else "" for key, column in self.columns.items()}
        entries |= {key: f"{column.name!r}{units[key]}" for key, column in self.columns.items()}
        entries |= {quantity: "not found" for quantity in self.missing} | {"not used": ", ".join(self._unused())}
        return [f"{key:<12}{text[:LONGEST]}{' ...' * (len(text) > LONGEST)}".rstrip() for key, text in entries.items()]

    def _unused(self) -> list[str]:
        used = {column.position for column in self.columns.values()}
        return [name for n, name in enumerate(self.names) if name and n not in used]

    @property
    def open_questions(self) -> frozenset[str]:
        """Quantities without a unit, and both signs of the current."""
        return frozenset(key for key, column in self.columns.items() if not column.unit) | {"is positive", "is negative"}

    def check(self) -> TableHeader:
        """Refuse a table without required quantities, and propose columns for these: with a suitable unit, or else any."""
        if not self.missing:
            return self
        unused = self._unused()
        candidates = {quantity: [name for name in unused if _unit_in(name, quantity)] for quantity in self.missing}
        further = iter([name for name in unused if not any(name in names for names in candidates.values())])
        candidates = {quantity: names or [next(further, "NAME")] for quantity, names in candidates.items()}
        count = max(map(len, candidates.values()))
        proposals = [{key: names[min(n, len(names) - 1)] for key, names in candidates.items()} for n in range(count)]
        advice = [Advice("Name the columns, or their places", "columns", proposal) for proposal in proposals]
        raise RecordError(f"no column for the {', the '.join(self.missing)}", advice)


def recognise(names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]]) -> TableHeader:
    """Recognise the tester of a table, the first with a mark in the header, and its columns with their units."""
    names = [str(name).strip() for name in names]
    labels = _labels(names, rows, {name.strip() for name in file_format.ignore})
    keys = {key for label in labels for key, _ in _name_candidates(label)}
    testers = [tester for tester in TESTERS if any("".join(words_of(mark)) in keys for mark in tester.marks)]
    tester = file_format.tester or (merge(testers[0], TESTERS[-1]) if testers else TESTERS[-1])
    units = {**tester.units, **(file_format.units or {})}
    stated = _stated_positions(file_format.columns or {}, units, names)
    ranks = [_ranks(label, tester) for label in labels]
    columns = dict[str, Column]()
    for quantity in QUANTITIES:
        if quantity in SUBSTITUTES["current"] and ("current" in columns or file_format.load):
            continue
        # a column serves one quantity, unless the caller states otherwise
        taken = {column.position for column in columns.values()} | set(stated.values())
        free_ranks = {n: rank[quantity] for n, rank in enumerate(ranks) if quantity in rank and n not in taken}
        positions = [n for n, rank in free_ranks.items() if rank == min(free_ranks.values())]
        if quantity in stated:
            positions = [stated[quantity]]
        scale, stated_unit = _SCALED_UNIT.findall(units.get(quantity, ""))[0]
        for number, position in enumerate(positions if quantity in REQUIRED else positions[:1], start=1):
            unit = _unit(stated_unit, quantity) or _unit_in(labels[position], quantity)
            if unit or quantity not in _WITH_UNIT:
                factor, offset = _UNITS.get(quantity, {}).get(unit, (1.0, 0.0))
                key = quantity if number == 1 else f"{quantity}{number}"
                columns[key] = Column(position, names[position], unit, float(scale or 1.0) * factor, offset)
    substituted = {"current"} if file_format.load else set[str]()
    missing = [key for key in REQUIRED if not {key, *SUBSTITUTES.get(key, ())} & (set(columns) | substituted)]
    return TableHeader(tester, columns, missing, names, rows)


def _stated_positions(columns: Mapping[str, str], units: Mapping[str, str], names: Sequence[str]) -> dict[str, int]:
    """Return the positions of stated columns, by name, or else by number from 1 on."""
    for option, stated in (("columns", columns), ("units", units)):
        if unknown := set(stated) - set(QUANTITIES):
            raise ValueError(f"{option} knows {', '.join(QUANTITIES)}, got {', '.join(sorted(unknown))}")
    labels = [*names, *(str(n + 1) for n in range(len(names)))]
    for quantity, name in columns.items():
        if name.strip() not in labels:
            raise ValueError(f"there is no column {name!r} for the {quantity} among {', '.join(filter(None, names))}")
    for quantity, unit in units.items():
        if quantity in _UNITS and not _unit(unit, quantity):
            raise ValueError(f"the unit {unit!r} of the {quantity} is not known, but {', '.join(_UNITS[quantity])}")
    return {quantity: labels.index(name.strip()) % len(names) for quantity, name in columns.items()}


def _labels(names: Sequence[str], rows: Sequence[Sequence[str]], ignore: Collection[str]) -> list[str]:
    """Return the names of columns, empty if ignored, with the units in the line below if the names have none."""
    labels = ["" if name in ignore else name for name in names]
    if not (rows and are_units(rows[0])):
        return labels
    units = [text.strip("[]()- ") for text in [*rows[0], *[""] * len(labels)]]
    return [f"{name} ({unit})" if name and not _UNIT.search(name) else name for name, unit in zip(labels, units, strict=False)]


def _ranks(label: str, tester: Tester) -> dict[str, int]:
    """Return the quantities that a name and its unit suit, with the rank of the name for each."""
    ranks: dict[str, int] = {}
    for key, unit in _name_candidates(label):
        for quantity, rank in tester.ranks.get(key, {}).items():
            if quantity not in _UNITS or not _letters(unit) or _unit(unit, quantity):
                ranks.setdefault(quantity, rank)
    return ranks


@lru_cache(maxsize=4096)
def _name_candidates(name: str) -> tuple[tuple[str, str], ...]:
    """Return possible names and units of a column: the unit in brackets, behind a stroke, or as the last word."""
    name = normalize("NFKC", name)[:LONGEST]
    words, match = words_of(name), _UNIT.search(name)
    candidates = [("".join(words), "")]
    if match:
        base = name[: match.start()] + name[match.end() :]
        candidates.append(("".join(words_of(base)), match["bracket"] or match["stroke"] or ""))
    if len(words) > 1 and any(_unit(words[-1], quantity) for quantity in _UNITS):
        candidates.append(("".join(words[:-1]), words[-1]))
    return tuple(candidates)


def _unit_in(name: str, quantity: str) -> str:
    """Return the unit in a name, which may be the whole name, as in mAmps; empty if none."""
    (full_name, _), *candidates = _name_candidates(name)
    return next((unit for text in (full_name, *(unit for _, unit in candidates)) if (unit := _unit(text, quantity))), "")


def _letters(text: str) -> str:
    """Return the letters of a unit, because encodings lose signs of degrees, and dots and strokes separate factors."""
    return re.sub(r"[^a-z\u03bc]", "", normalize("NFKC", text).lower())


def _unit(text: str, quantity: str) -> str:
    """Return a unit as in the table of units, without any text behind it, as in ``V vs. Ref.``; empty if unknown."""
    if quantity == "time" and _CLOCK.match(_letters(text)):
        return "s"
    units = map(_letters, (text, text.strip().partition(" ")[0]))
    return next((unit for unit in units if unit in _UNITS.get(quantity, {})), "")


def are_units(fields: Sequence[str]) -> bool:
    """Whether the line below a header holds units; a clock may have none."""
    return not any(map(str.isdigit, "".join(fields))) and all(
        any(_unit(text, quantity) for text in fields) for quantity in ("voltage", "current")
    )


def count_required(names: Iterable[str], file_format: FileFormat) -> int:
    """Count the required quantities in a line, which may be a header."""
    stated = {name.strip(): quantity for quantity, name in (file_format.columns or {}).items()}
    quantities = {quantity for name in names for quantity in _ranks(name, file_format.tester or TESTERS[-1])}
    quantities |= {stated[name.strip()] for name in names if name.strip() in stated}
    return sum(bool(quantities & {quantity, *SUBSTITUTES.get(quantity, ())}) for quantity in REQUIRED)


def direction(state: object) -> int:
    """Return 1 for a tester's word for discharge, -1 for a word for charge, else 0."""
    words = " ".join(words_of(str(state)))
    return 1 if _DISCHARGE.search(words) else -1 if _CHARGE.search(words) else 0


def few_of(names: Sequence[str]) -> str:
    """Return the first of many names as text."""
    return ", ".join(names[:_MOST_NAMED]) + (f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else "")


def notify(text: str) -> None:
    """Warn the reader of a file of a correction."""
    warnings.warn(text, stacklevel=3)
