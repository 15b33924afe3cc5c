"""Which column of a table is which measurement, and in which unit: by the names of the testers' table, or as is stated."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from typing import NamedTuple
from unicodedata import normalize

from battery_env.checks import ZERO_CELSIUS_K
from battery_env.lab.readers.testers import BESIDE, QUANTITIES, REQUIRED, TESTERS, Tester

#: What may stand in the place of a quantity that a record must have.
INSTEAD = {"time": ("date", "step_time"), "current": ("power", "charge_step")}
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
_CHARGES = _units({"ma.h mah mahr mamphr": 3.6, "a.h ah ahr amphr": 3600.0, "mas": 1e-3, "as": 1.0})
_DEGREES = _units({"c degc degreec celsius deg": 1.0}) | dict.fromkeys(("k", "kelvin"), (1.0, -ZERO_CELSIUS_K))
# By quantity and unit in lower case without blanks: factor and offset to s, V, A, degC, W and C.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": _TIMES,
    "date": _TIMES,
    "step_time": _TIMES,
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
# The sign of a degree, and what is left of it after another encoding.
_DEGREE_SIGN = re.compile("^[Ââ]?[°º˚\ufffd?]")
# A unit of text such as 1:02:03.5, which becomes seconds when it is read.
_CLOCK = re.compile(r"\[?h+\]?:m+(?:in)?:s+(?:[.,]?(?:m?s+|f+|0+|x+|z+))?$")
# What testers call the steps in which a cell is discharged, and those of other words in which it is charged.
_DISCHARGE = re.compile(r"\bd\b|\bdis\b|dch|dsg|disch|d[ée]charg|descarg|scaric|entlad|放电")
_CHARGE = re.compile(r"\bc\b|ch|carg|caric|lad|充电")
_NUMBER = re.compile(r"[-+.]*\d[-+.,:/\deE\sT]*$|nan$|true$|false$", flags=re.IGNORECASE)
_AROUND_UNITS = "[]()- "
# So long are names, and what is shown of a line; a column of words has so few of them.
_LONGEST, _FEW_WORDS = 200, 20


class Column(NamedTuple):
    """A column and what makes SI of it."""

    position: int  # among the columns of the table
    name: str  # as the table has it
    factor: float = 1.0  # makes s, V or A of its values, or differences of temperature in K
    offset: float = 0.0  # is added then
    unit: str = ""  # as its name or the caller says, empty if neither does

    @property
    def is_of_cell(self) -> bool:
        """Whether a voltage is that of a cell, and not of one of its electrodes against a third one."""
        return "".join(_words(self.name)).removesuffix("v") != "ewe"


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
    columns: dict[str, Column]  # by quantity; what may serve as well has a number, as ``time 2``
    missing: list[str]  # quantities that a record must have
    names: Sequence[str]  # all of the table
    rows: Sequence[Sequence[str]]  # fields of its first rows
    source: str

    def unused(self) -> list[str]:
        """Names of the columns that are not used."""
        used = {column.position for column in self.columns.values()}
        return [name for n, name in enumerate(self.names) if name and n not in used]

    def lines(self) -> list[str]:
        """What the table begins with, and what is known of it."""
        told = {"header": ", ".join(self.names)}
        told |= {f"row {n}": ", ".join(row) for n, row in enumerate(self.rows[:2], start=1)}
        told |= {"tester": self.tester.name} | {key: shown(column) for key, column in self.columns.items()}
        told |= {each: "not found" for each in self.missing} | {"not used": ", ".join(self.unused())}
        return [f"{key:<12}{shortened(text)}" for key, text in told.items()]

    def refusal(self, reason: object) -> ValueError:
        """Why the table is not read, with its first lines, what is known of it, and what reads it."""
        likely = {each: [name for name in self.unused() if _stated_unit(name, each)] for each in self.missing}
        columns = [f"{each}={names[0] if len(names) == 1 else 'NAME'}" for each, names in likely.items()]
        told = "; ".join(" ".join(line.split()) for line in self.lines())
        return ValueError(
            f"{reason}. {told}. Say what is what: --columns {','.join(columns) or 'time=NAME'} (Python: columns), or fill in "
            f"the file that battery-calibrate columns {self.source} writes"
        )


def find_columns(
    names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]], source: str = "FILE"
) -> Recognised:
    """Columns by quantity, from all names and the first rows; refused, with what helps, where one is missing."""
    found = recognise(names, file_format, rows, source)
    if found.missing:
        raise found.refusal(f"no column for the {', the '.join(found.missing)}")
    return found


def recognise(
    names: Sequence[str], file_format: FileFormat, rows: Sequence[Sequence[str]], source: str = "FILE"
) -> Recognised:
    """
    Which tester's table it is, the first of which it has all that a record needs, and its columns. A unit is told
    from the name, as in ``Current(mA)``, ``Voltage / V``, ``mAmps`` or ``test_time_second``, or from the line below it; one of
    another quantity rules a column out.
    """
    for option, stated in (("columns", file_format.columns), ("units", file_format.units)):
        if unknown := set(stated or {}) - set(QUANTITIES):
            raise ValueError(f"{option} knows {', '.join(QUANTITIES)}, got {', '.join(sorted(unknown))}")
    ignore = {name.strip() for name in file_format.ignore}
    kept = [name if (name := str(each).strip()) not in ignore else "" for each in names]
    units = rows[0] if rows and are_units(rows[0]) else []
    labels = [_label(name, text) for name, text in zip_longest(kept, units[: len(kept)])]
    present = {key for name in labels for key, *_ in _readings(name)}
    given = {"current"} if file_format.load else set[str]()
    candidates = []
    for tester in (file_format.tester,) if file_format.tester else TESTERS:
        if tester is TESTERS[-1] or not tester.told_by or present & set(map(_key, tester.told_by)):
            found = _columns_of(tester, kept, labels, rows, file_format)
            missing = [each for each in REQUIRED if not {each, *INSTEAD.get(each, ())} & (set(found) | given)]
            candidates.append(Recognised(tester, found, missing, names, rows, source))
            if not missing and "time" in found:
                return candidates[-1]
    # the time in a step, or a date, where no tester's row has the time of the test
    return next((each for each in candidates if not each.missing), candidates[-1])


def _columns_of(
    tester: Tester, names: Sequence[str], labels: Sequence[str], rows: Sequence[Sequence[str]], file_format: FileFormat
) -> dict[str, Column]:
    chosen, units = file_format.columns or {}, {**tester.units, **(file_format.units or {})}
    found: dict[str, Column] = {}
    for quantity in QUANTITIES:
        if quantity in INSTEAD["current"] and ("current" in found or file_format.load):
            continue
        # a column is one thing, but where the caller says otherwise
        used = {column.position for column in found.values()} | {n for n, name in enumerate(names) if name in chosen.values()}
        left = labels if quantity in chosen else ["" if n in used else label for n, label in enumerate(labels)]
        known = (*tester.columns.get(quantity, ()), *(BESIDE if quantity == "date" and "time" in found else ()))
        places = _places(known, tester.units, quantity, names, left, chosen.get(quantity))
        if quantity == "state":
            places |= {n: "" for n in _of_words(row[: len(names)] for row in rows if len(row) >= len(names)) if names[n]}
        stated = (file_format.units or {}).get(quantity)
        for place, unit in places.items():
            if quantity not in (*REQUIRED, "state") and not stated and unit and not _unit(unit, quantity):
                if quantity in _UNITS:
                    say(f"the unit of {names[place]!r} is not known (--units {quantity}=UNIT). It is left out")
                    continue
            key = quantity if quantity not in found else f"{quantity} {place}"
            found[key] = Column(
                place, names[place], *_scale(quantity, stated or unit or units.get(quantity, ""), names[place])
            )
    return found


def _places(
    known: tuple[str, ...],
    own_units: Mapping[str, str],
    quantity: str,
    names: Sequence[str],
    labels: Sequence[str],
    chosen: str | None,
) -> dict[int, str]:
    """The columns that may be a quantity, those of the first name that there is, with the units that they tell."""
    if chosen is not None:
        place = next((n for n, name in enumerate(names) if name == chosen.strip()), None)
        if place is None:
            raise ValueError(f"there is no column {chosen!r} for the {quantity} among {', '.join(filter(None, names))}")
        return {place: _stated_unit(labels[place], quantity)}
    ranks = _ranks(known)
    matches = {n: match for n, label in enumerate(labels) if (match := _match(label, quantity, ranks, own_units))}
    if not matches:
        return {}
    # a unit that is not known is taken where no other column of the quantity has one
    is_unknown = {n: bool(unit and quantity in _UNITS and not _unit(unit, quantity)) for n, (_, unit) in matches.items()}
    best = min((is_unknown[n], rank) for n, (rank, _) in matches.items())
    places = {n: unit for n, (rank, unit) in matches.items() if (is_unknown[n], rank) == best}
    return places if quantity in REQUIRED else dict([next(iter(places.items()))])


@lru_cache(maxsize=1024)
def _ranks(names: tuple[str, ...]) -> dict[str, int]:
    return {_key(name): rank for rank, name in reversed([*enumerate(names)])}


def _match(label: str, quantity: str, ranks: Mapping[str, int], units: Mapping[str, str]) -> tuple[int, str] | None:
    """The rank of a name among those of a quantity, and the unit in it; nothing if it is none, or its unit is of another."""
    for key, unit, is_guess in _readings(label):
        if key not in ranks or (is_guess and not _unit(unit, quantity)):
            continue
        unit = unit or _stated_unit(label, quantity)
        needs_unit = (quantity, key) in _WITH_UNIT or (quantity == "capacity" and quantity not in units)
        if (needs_unit and not _unit(unit, quantity)) or (
            not _unit(unit, quantity) and any(_unit(unit, other) for other in _UNITS)
        ):
            return None
        return ranks[key], unit
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
    for cut in (1, -3, -2, -1):  # the unit comes first, or last, also in some words, as deg C, m|A and m|A.h
        parts = ["".join(words[:cut]), "".join(words[cut:])]
        unit, base = parts if cut > 0 else parts[::-1]
        if base and unit:
            found.append((base, unit, True))
    return tuple(found)


def _stated_unit(name: str, quantity: str) -> str:
    """The unit in a name that the caller gives, whatever the rest of it is."""
    readings = _readings(name)
    units = (readings[0][0], *(unit for _, unit, _ in readings if unit))
    return next((unit for unit in units if _unit(unit, quantity)), "")


def _words(name: str) -> list[str]:
    return _GAP.sub(" ", name[:_LONGEST]).lower().split()


def _key(name: str) -> str:
    return "".join(_words(normalize("NFKC", name)))


def _label(name: str | None, text: str | None) -> str:
    """A name with the unit that is written below it, unless it has one itself."""
    name, unit = name or "", (text or "").strip(_AROUND_UNITS)
    has_none = not any(each and any(_unit(each, quantity) for quantity in _UNITS) for _, each, _ in _readings(name))
    is_unit = any(_unit(unit, quantity) for quantity in _UNITS)
    is_plain = any(_key(name) in _ranks(tuple(names)) for names in TESTERS[-1].columns.values())
    return f"{name} ({unit})" if name and is_unit and (has_none or is_plain) else name


def _unit(text: str, quantity: str) -> str | None:
    """A unit as the table of units has it; what is said behind it, as in ``Hours in hh:mm:ss``, is left out."""
    text = normalize("NFKC", text).lower()  # of the signs for degrees Celsius and micro there are several
    first, *_ = [*text.split(), ""]
    for unit in ("".join(text.split()), first):
        unit = _DEGREE_SIGN.sub("", unit) if quantity in ("temperature", "ambient") else unit
        unit = "s" if quantity in ("time", "step_time") and _CLOCK.match(unit) else unit
        if unit in _UNITS.get(quantity, {}):
            return unit
    return None


def _scale(quantity: str, unit: str, name: str) -> tuple[float, float, str]:
    if quantity not in _UNITS or not unit:
        return 1.0, 0.0, ""
    known = _unit(unit, quantity)
    if known is None:
        raise ValueError(
            f"the unit {unit!r} of the column {name!r} is not known for the {quantity}. Known are "
            f"{', '.join(_UNITS[quantity])}. State it: --units {quantity}=UNIT (Python: units)"
        )
    return *_UNITS[quantity][known], known


def are_units(fields: Sequence[str]) -> bool:
    """Whether the line below a header holds units, where some testers write them; a clock may have none."""
    texts = [text for field in fields if (text := field.strip(_AROUND_UNITS))]
    return not any(map(_NUMBER.match, texts)) and all(
        any(_unit(text, each) for each in (quantity, *INSTEAD.get(quantity, ())) for text in texts)
        for quantity in ("voltage", "current")
    )


def count_required(names: Sequence[str], file_format: FileFormat) -> int:
    """How much a line looks like the header of a record."""
    names = [str(name) for name in names if any(map(str.isalpha, str(name)))]
    testers, chosen = [file_format.tester or TESTERS[-1]], file_format.columns or {}
    return sum(
        (
            any(name.strip() == chosen[quantity] for name in names)
            if quantity in chosen
            else any(has(each, names, testers[0]) for each in (quantity, *INSTEAD.get(quantity, ())))
        )
        for quantity in REQUIRED
    )


def has(quantity: str, names: Iterable[str], tester: Tester = TESTERS[-1]) -> bool:
    """Whether one of the names is that of a quantity."""
    ranks = _ranks(tuple(tester.columns.get(quantity, ())))
    matches = (_match(name, quantity, ranks, tester.units) for name in names)
    return any(match and (not match[1] or _unit(match[1], quantity)) for match in matches)


def direction(state: object) -> int:
    """1 for what a tester calls a discharge, -1 for a charge, else 0."""
    words = " ".join(_words(str(state)))
    return 1 if _DISCHARGE.search(words) else -1 if _CHARGE.search(words) else 0


def _of_words(rows: Iterable[Sequence[str]]) -> list[int]:
    """Columns of a few words."""
    texts = [{text for value in values if (text := value.strip())} for values in zip(*rows, strict=False)]
    return [n for n, words in enumerate(texts) if 0 < len(words) <= _FEW_WORDS and not any(map(_NUMBER.match, words))]


def shown(column: Column) -> str:
    """A column for messages."""
    return f"{shortened(column.name)!r}{f' in {column.unit}' if column.unit else ''}"


def shortened(text: str) -> str:
    """A line for messages."""
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def say(text: str) -> None:
    """Tell who reads a file what was done to it."""
    warnings.warn(text, stacklevel=3)
