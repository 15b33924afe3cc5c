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
from battery_env.lab.readers.testers import INSTEAD, QUANTITIES, REQUIRED, TESTERS, Tester, joined

# Names that are this quantity only where a unit says so: t may be a time, and p, q or a capacity anything.
_WITH_UNIT = {("temperature", "t"), ("power", "p"), ("charge_step", "dq"), ("counter", "ece")}


def _units(factors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    return {name: (factor, 0.0) for names, factor in factors.items() for name in names.split()}


_TIMES = _units(
    {
        "s sec secs second seconds sek sekunden": 1.0,
        "ms msec millisecond milliseconds": 1e-3,
        "min mins minute minutes minuten": 60.0,
        "h hr hrs hour hours std stunden": 3600.0,
        "d day days tage": 86400.0,
    }
)
_VOLTS = _units({"v volt volts": 1.0, "mv mvolt mvolts millivolt millivolts": 1e-3})
_MILLIAMPERES = "ma mamp mamps milliamp milliamps milliampere milliamperes"
_CHARGES = _units({"mah mahr mamphr": 3.6, "ah ahr amphr": 3600.0, "mas": 1e-3, "as": 1.0})
_DEGREES = dict(_units({"c degc degreec celsius deg": 1.0}), k=(1.0, -ZERO_CELSIUS_K), kelvin=(1.0, -ZERO_CELSIUS_K))
# By quantity and unit in small letters alone: factor and offset to s, V, A, degC, W and C.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": _TIMES,
    "date": _TIMES,
    "voltage": _VOLTS,
    "counter": _VOLTS,
    "current": _units({"a amp amps ampere amperes": 1.0, _MILLIAMPERES: 1e-3, "ua \u03bca microamp microamps": 1e-6}),
    "power": _units({"w watt watts": 1.0, "mw": 1e-3}),
    "charge_step": _CHARGES,
    "temperature": _DEGREES,
    "ambient": _DEGREES,
    "capacity": _CHARGES,
}
_IN_BRACKETS = re.compile(
    r"^(?P<name>.*?) ?(?:\((?P<round>[^()]*)\)(?P<number>_\d+)?|\[(?P<square>[^][]*)\]|/ ?(?P<slash>[^/]+))$"
)
# Words end at a capital, too, as in TestTime; units may be in brackets of any kind, or behind a mark, or "in". A word of a
# sentence, with a mark at its end, is no name.
_GAP = re.compile(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])|(?:[_\-\s.#<>~{}/]|[,:](?=.)|(?<=[_\s])(?:in|IN)(?=[_\s]))+")
# A unit of text such as 1:02:03.5, which becomes seconds when it is read, by its letters.
_CLOCK = re.compile(r"h+m+(?:in)?s+[msfxz]*$")
# What testers call the steps in which a cell is discharged, and those of other words in which it is charged.
_DISCHARGE = re.compile(r"\bd\b|\bdis\b|dch|dsg|disch|d[ée]charg|descarg|scaric|entlad|放电")
_CHARGE = re.compile(r"\bc\b|ch|carg|caric|lad|充电")
_NUMBER = re.compile(r"[-+.]*\d[-+.,:/\deE\sT]*$|nan$|true$|false$", flags=re.IGNORECASE)
# So long are names, and what is shown of a line.
_LONGEST = 200


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
    columns: dict[str, Column]  # by quantity
    missing: list[str]  # quantities that a record must have
    doubts: list[str]  # what the caller must say of those that are there
    names: Sequence[str]  # all of the table
    rows: Sequence[Sequence[str]]  # fields of its first rows
    source: str

    def lines(self) -> list[str]:
        """What the table begins with, and what is known of it."""
        told = {"header": ", ".join(self.names)}
        told |= {f"row {n}": ", ".join(row) for n, row in enumerate(self.rows[:2], start=1)}
        told |= {"tester": self.tester.name}
        told |= {key: f"{each.name!r}{f' in {each.unit}' if each.unit else ''}" for key, each in self.columns.items()}
        told |= {each: "not found" for each in self.missing} | {"not used": ", ".join(self._unused())}
        return [f"{key:<12}{text if len(text) <= _LONGEST else f'{text[:_LONGEST]} ...'}" for key, text in told.items()]

    def _unused(self) -> list[str]:
        used = {column.position for column in self.columns.values()}
        return [name for n, name in enumerate(self.names) if name and n not in used]

    def refusal(self, reason: object) -> ValueError:
        """Why the table is not read, with its first lines, what is known of it, and what reads it."""
        likely = {each: [name for name in self._unused() if _unit_in(name, each)] for each in self.missing}
        columns = [f"{each}={names[0] if len(names) == 1 else 'NAME'}" for each, names in likely.items()]
        told = "; ".join(" ".join(line.split()) for line in self.lines())
        return ValueError(
            f"{str(reason).rstrip('.')}. {told}. Where this is wrong say what is what: --columns "
            f"{','.join(columns) or 'time=NAME'} (Python: columns), or fill in the file that battery-calibrate columns "
            f"{self.source} writes"
        )


def find_columns(
    names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]], source: str = "FILE"
) -> Recognised:
    """Columns by quantity, from all names and the first rows; refused, with what helps, where one is missing or in doubt."""
    found = recognise(names, file_format, rows, source)
    if found.missing or found.doubts:
        missing = [f"no column for the {', the '.join(found.missing)}"] if found.missing else []
        raise found.refusal(". ".join([*missing, *found.doubts]))
    return found


def recognise(
    names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]], source: str = "FILE"
) -> Recognised:
    """
    Which tester's table it is, the first of which it has a mark, and its columns. A unit is told from the name, as in
    ``Current(mA)``, ``Voltage / V``, ``mAmps`` or ``test_time_second``, or from the line below it; one of another quantity
    rules a column out.
    """
    for option, told in (("columns", file_format.columns), ("units", file_format.units)):
        if unknown := set(told or {}) - set(QUANTITIES):
            raise ValueError(f"{option} knows {', '.join(QUANTITIES)}, got {', '.join(sorted(unknown))}")
    labels = _labels(names, rows, {name.strip() for name in file_format.ignore})
    present = {key for label in labels for key, _, is_guess in _readings(label) if not is_guess}
    marked = [each for each in TESTERS[:-1] if present & set(map(_key, each.told_by))]
    # which need not be of one tester only
    marked = [each for each in marked if present & set(map(_key, (*each.columns["time"], *each.columns.get("date", ()))))]
    tester = file_format.tester or (joined(marked[0], TESTERS[-1]) if marked else TESTERS[-1])
    chosen, units = file_format.columns or {}, file_format.units or {}
    stated = {quantity: _place_of(name, quantity, names) for quantity, name in chosen.items()}
    found, doubts = dict[str, Column](), list[str]()
    for quantity in QUANTITIES:
        if quantity in INSTEAD["current"] and ("current" in found or file_format.load):
            continue
        # a column is one thing, but where the caller says otherwise
        used = {column.position for column in found.values()} | set(stated.values())
        if quantity in stated:
            places = {stated[quantity]: _unit_in(labels[stated[quantity]], quantity)}
        else:
            places = _places(["" if n in used else label for n, label in enumerate(labels)], quantity, tester)
        for place, unit in [*places.items()][:1]:
            unit = units.get(quantity, unit or tester.units.get(quantity, ""))
            known = _unit(unit, quantity)
            if unit and quantity in _UNITS and not known:
                doubt = f"the unit {unit!r} of the column {names[place]!r} is not known for the {quantity}"
                if quantity not in REQUIRED:
                    say(f"{doubt} (--units {quantity}=UNIT). It is left out")
                    continue
                doubts.append(f"{doubt}, but {', '.join(_UNITS[quantity])}")
            factor, offset = _UNITS.get(quantity, {}).get(known, (1.0, 0.0))
            found[quantity] = Column(place, str(names[place]), known, factor, offset)
        if len(places) > 1 and quantity in REQUIRED:
            both = " and ".join(repr(names[place]) for place in places)
            doubts.append(f"both {both} may be the {quantity}: --columns {quantity}=NAME, or --ignore NAME (Python: ignore)")
    given = {"current"} if file_format.load else set[str]()
    missing = [each for each in REQUIRED if not {each, *INSTEAD.get(each, ())} & (set(found) | given)]
    return Recognised(tester, found, missing, doubts, [*map(str, names)], rows, source)


def _labels(names: Sequence[str], rows: Sequence[Sequence[str]], ignore: Collection[str]) -> list[str]:
    """Names of columns that are looked at, with the units that are written below them, where they have none themselves."""
    labels = ["" if str(name).strip() in ignore else str(name).strip() for name in names]
    if not (rows and are_units(rows[0])):
        return labels
    plain = {key for names in TESTERS[-1].columns.values() for key in _ranks(tuple(names))}
    has_unit = [_key(label) not in plain and any(_unit_in(label, quantity) for quantity in _UNITS) for label in labels]
    fields = [*rows[0], *[""] * len(labels)]
    return [
        (
            label
            if has or not label or not any(_unit(text, quantity) for quantity in _UNITS)
            else f"{label} ({text.strip('[]()- ')})"
        )
        for label, has, text in zip(labels, has_unit, fields, strict=False)
    ]


def _place_of(name: str, quantity: str, names: Sequence[str]) -> int:
    stripped = [str(each).strip() for each in names]
    if name.strip() not in stripped:
        raise ValueError(f"there is no column {name!r} for the {quantity} among {', '.join(filter(None, stripped))}")
    return stripped.index(name.strip())


def _places(labels: Sequence[str], quantity: str, tester: Tester) -> dict[int, str]:
    """The columns that may be a quantity, those of the first name that there is, with the units that they tell."""
    ranks = _ranks(tuple(tester.columns.get(quantity, ())))
    matches = {n: match for n, label in enumerate(labels) if (match := _match(label, quantity, ranks, tester))}
    # a unit that is not known is taken where no other column of the quantity has one
    keys = {n: (bool(unit and quantity in _UNITS and not _unit(unit, quantity)), rank) for n, (rank, unit) in matches.items()}
    return {n: unit for n, (_, unit) in matches.items() if keys[n] == min(keys.values())}


@lru_cache(maxsize=1024)
def _ranks(names: tuple[str, ...]) -> dict[str, int]:
    return {_key(name): rank for rank, name in reversed([*enumerate(names)])}


def _match(label: str, quantity: str, ranks: Mapping[str, int], tester: Tester) -> tuple[int, str] | None:
    """The rank of a name among those of a quantity, and the unit in it; nothing if it is none, or its unit is of another."""
    for key, unit, is_guess in _readings(label):
        if key not in ranks or (is_guess and not _unit(unit, quantity)):
            continue
        unit = unit or _unit_in(label, quantity)
        if _unit(unit, quantity):
            return ranks[key], unit
        needs_unit = (quantity, key) in _WITH_UNIT or (quantity == "capacity" and quantity not in tester.units)
        is_of_another = any(_unit(unit, other) for other in _UNITS)
        return None if needs_unit or is_of_another else (ranks[key], unit if _letters(unit) else "")
    return None


@lru_cache(maxsize=4096)
def _readings(name: str) -> tuple[tuple[str, str, bool], ...]:
    """What a name may be without its unit, the unit, and whether that is a guess: the whole, what is in brackets, a word."""
    name = " ".join(normalize("NFKC", name)[:_LONGEST].split())  # brackets may be as wide as a Chinese character
    words, match = _words(name), _IN_BRACKETS.match(name)
    found = [("".join(words), "", False)]
    if match:
        unit = next(group for group in match.group("round", "square", "slash") if group is not None)
        found.append((_key(match["name"] + (match["number"] or "")), unit.strip(" _"), False))
    for cut in (1, -2, -1):  # the unit comes first, or last, also in two words, as deg C and mA.h
        parts = ["".join(words[:cut]), "".join(words[cut:])]
        unit, base = parts if cut > 0 else parts[::-1]
        if base and unit:
            found.append((base, unit, True))
    return tuple(found)


def _unit_in(name: str, quantity: str) -> str:
    """The unit in a name, whatever the rest of it is."""
    readings = _readings(name)
    units = (readings[0][0], *(unit for _, unit, _ in readings if unit))
    return next((unit for unit in units if _unit(unit, quantity)), "")


def _words(name: str) -> list[str]:
    return _GAP.sub(" ", name[:_LONGEST]).lower().split()


def _key(name: str) -> str:
    return "".join(_words(normalize("NFKC", name)))


def _letters(text: str) -> str:
    """A unit by its letters: signs of degrees are lost by encodings, and dots and strokes part factors."""
    return re.sub(r"[^a-z\u03bc]", "", normalize("NFKC", text).lower())


def _unit(text: str, quantity: str) -> str:
    """A unit as the table of units has it, or nothing; what is said behind it, as in ``V vs. Ref.``, is left out."""
    if quantity == "time" and _CLOCK.match(_letters(text)):
        return "s"
    first = text.split()[:1]
    return next((unit for unit in map(_letters, (text, *first)) if unit in _UNITS.get(quantity, {})), "")


def are_units(fields: Sequence[str]) -> bool:
    """Whether the line below a header holds units, where some testers write them; a clock may have none."""
    texts = [text for field in fields if (text := field.strip("[]()- "))]
    return not any(map(_NUMBER.match, texts)) and all(
        any(_unit(text, each) for each in (quantity, *INSTEAD.get(quantity, ())) for text in texts)
        for quantity in ("voltage", "current")
    )


def count_required(names: Iterable[str], file_format: FileFormat) -> int:
    """How much a line looks like the header of a record."""
    labels = [name.strip() for name in names if any(map(str.isalpha, name))]
    tester, chosen = file_format.tester or TESTERS[-1], file_format.columns or {}

    def has(quantity: str) -> bool:
        ranks = _ranks(tuple(tester.columns.get(quantity, ())))
        matches = (_match(label, quantity, ranks, tester) for label in labels)
        return any(match and (not match[1] or _unit(match[1], quantity)) for match in matches)

    return sum(
        chosen[quantity].strip() in labels if quantity in chosen else any(map(has, (quantity, *INSTEAD.get(quantity, ()))))
        for quantity in REQUIRED
    )


def direction(state: object) -> int:
    """1 for what a tester calls a discharge, -1 for a charge, else 0."""
    words = " ".join(_words(str(state)))
    return 1 if _DISCHARGE.search(words) else -1 if _CHARGE.search(words) else 0


def say(text: str) -> None:
    """Tell who reads a file what was done to it."""
    warnings.warn(text, stacklevel=3)
