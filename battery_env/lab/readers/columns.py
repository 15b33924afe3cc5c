"""Which column of a table is which measurement, and in which unit: told from the names that testers give."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple
from unicodedata import normalize

from battery_env.checks import ZERO_CELSIUS_K

#: What a record must have.
REQUIRED = ("time", "voltage", "current")

# By quantity, the names it goes by. The first that a table has is taken: elapsed times before dates, and these before the
# times of a step; a cell before one of its electrodes. Below them, what may stand in their place, or tells more of them.
_NAMES = {
    "time": "test time, total time, elapsed time, accumulated time, cumulative time, run time, record time, elapsed, "
    "prog time, program time, program duration, programmdauer, test, time, relative time, testzeit, prüfzeit, gesamtzeit, "
    "programmzeit, laufzeit, zeit, temps total, temps, tempo, tiempo, 总时间, 测试时间, 累计时间, 时间, 相对时间, seconds, t, "
    "unix time, date time, timestamp, absolute time, dpt time, real time, system time, sys time, date, datum, datum uhrzeit, "
    "zeitstempel, fecha, 绝对时间, 系统时间, 日期, step time, step duration, schrittzeit, schrittdauer, temps étape, "
    "步骤时间, 工步时间",
    "voltage": "voltage, cell voltage, terminal voltage, battery voltage, voltage measured, measured voltage, volts, volt, "
    "vol, ewe ece, ecell, potential, cell potential, ewe, u, v, spannung, zellspannung, klemmenspannung, batteriespannung, "
    "u cell, v cell, u zelle, tension cellule, u bat, v bat, u batt, v batt, vf, tension, tensión, tensao, tensão, "
    "voltaje, 电压",
    "current": "current, cell current, battery current, current measured, measured current, cur, curr, amps, amp, i, strom, "
    "zellstrom, batteriestrom, i cell, i bat, i batt, im, courant, corriente, corrente, 电流",
    "temperature": "temperature, cell temperature, temperature measured, surface temperature, surface temperature t1, "
    "temperature t1, temperature 1, aux temperature, aux temperature 1, temp, temp 1, t1, log temp 001, temperatur, "
    "zelltemperatur, température, temperatura, 温度, 电池温度, t cell, t",
    "ambient": "ambient temperature, chamber temperature, environment temperature, ev temp, umgebungstemperatur",
    "cycle": "cycle, cycle index, cycle number, cycle no, cycle count, cycle id, cyc, cyc count, cycle p, zyklus, "
    "zyklusnummer, ciclo, 循环, 循环号, 循环序号",
    "step": "step count, step, step index, step number, step no, step id, steps, ns, schritt, schrittnummer, etape, "
    "étape, 工步, 工步号, 工步序号",
    "state": "state, md, status, step type, mode, zustand, 状态, 工步类型, 工步状态",
    "cell": "cell id, cell name, cell number, cell no, cell, battery id, battery, barcode, serial number, channel, "
    "channel id, channel number, zelle",
    "step_time": "step time, step duration, schrittzeit, schrittdauer, temps étape, t step, 步骤时间, 工步时间",
    "power": "power, p, leistung",
    "charge_step": "dq",
    "counter": "ece",
    "capacity": "discharge capacity, dchg capacity, dchg cap, q discharge, discharged capacity, capacity, cap, ah, "
    "entladekapazität, kapazität, 放电容量, 容量",
}
_RANKS = {
    quantity: {name: rank for rank, name in enumerate(names.replace(" ", "").split(","))} for quantity, names in _NAMES.items()
}
# Names that are this quantity only where a unit says so: t may be a time, and p or q anything.
_WITH_UNIT = {("temperature", "t"), ("power", "p"), ("charge_step", "dq"), ("counter", "ece")}
_WITH_UNIT |= {("capacity", name) for name in _RANKS["capacity"]}


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
    "voltage": _VOLTS,
    "current": _units({"a amp amps ampere amperes": 1.0, _MILLIAMPERES: 1e-3, "ua \u03bca microamp microamps": 1e-6}),
    "temperature": _DEGREES,
    "ambient": _DEGREES,
    "step_time": _TIMES,
    "power": _units({"w watt watts": 1.0, "mw": 1e-3}),
    "charge_step": _CHARGES,
    "counter": _VOLTS,
    "capacity": _CHARGES,
}
# What a record may have in place of a quantity.
_INSTEAD = {"current": ("power", "charge_step")}
_IN_BRACKETS = re.compile(
    r"^(?P<name>.*?)\s*(?:\((?P<round>[^()]*)\)(?P<number>_\d+)?|\[(?P<square>[^][]*)\]|/\s*(?P<slash>[^/]+))\s*$"
)
# Words end at a capital, too, as in TestTime; units may be in brackets of any kind, or behind a mark, or "in". A word of a
# sentence, with a mark at its end, is no name.
_GAP = re.compile(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])|(?:[_\-\s.#<>~{}/]|[,:](?=.)|(?<=[_\s])(?:in|IN)(?=[_\s]))+")
# The sign of a degree, and what is left of it after another encoding.
_DEGREE_SIGN = re.compile("^[Ââ]?[°º˚\ufffd?]")
# A unit of text such as 1:02:03.5, which becomes seconds when it is read.
_CLOCK = re.compile(r"\[?h+\]?:m+(?:in)?:s+(?:[.,]?(?:m?s+|f+|0+|x+|z+))?$")
# So long are names that are a unit, as mV; a shorter one may be anything, as min.
_LEAST_UNIT_NAME = {"time": 4, "voltage": 2, "current": 2, "capacity": 5}
# What testers call the steps in which a cell is discharged, and those of other words in which it is charged.
_DISCHARGE = re.compile(r"\bd\b|\bdis\b|dch|dsg|disch|d[ée]charg|descarg|scaric|entlad|放电")
_CHARGE = re.compile(r"\bc\b|ch|carg|caric|lad|充电")
_NUMBER = re.compile(r"[-+.]*\d[-+.,:/\deE\sT]*$|nan$|true$|false$", flags=re.IGNORECASE)
_FEW_WORDS, _AROUND_UNITS = 20, "[]()- "


class Column(NamedTuple):
    """A column and what makes SI of it."""

    position: int  # among the columns of the table
    name: str  # as the table has it
    factor: float = 1.0  # makes s, V or A of its values, or differences of temperature in K
    offset: float = 0.0  # is added then
    unit: str = ""  # as its name or the caller says, empty if neither does
    words: str = ""  # its name without the unit, in lower case without gaps


@dataclass(frozen=True)
class FileFormat:
    """
    What files do not tell of themselves, see :func:`battery_env.read_discharges`.

    :param columns: by quantity, the name of its column
    :param units: by quantity, its unit
    :param discharge_is_negative: how the file counts the current of a discharge; ``None``: told from the voltage
    :param ignore: names of columns that are not looked at
    """

    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None
    discharge_is_negative: bool | None = None
    ignore: Collection[str] = ()


def find_columns(names: Sequence[str], file_format: FileFormat, rows: Iterable[Sequence[str]]) -> dict[str, Column]:
    """
    The columns of a record by quantity, from the names of all columns and the first rows, whose words may say which are
    charges. Columns that may serve as well have the quantity and a number, as ``time 2``. A unit is told from the name, as in
    ``Current(mA)``, ``Voltage / V``, ``mAmps`` or ``test_time_second``; a name without one is in s, V, A or degC. A unit of
    another quantity rules a column out.
    """
    chosen, units, ignore = file_format.columns or {}, file_format.units or {}, [name.strip() for name in file_format.ignore]
    for option, given in (("columns", chosen), ("units", units)):
        if unknown := set(given) - set(_NAMES):
            raise ValueError(f"{option} knows {', '.join(_NAMES)}, got {', '.join(sorted(unknown))}")
    kept, rows = [name if (name := str(each).strip()) not in ignore else "" for each in names], list(rows)
    labels = [_label(name, text) for name, text in zip_longest(kept, rows[0])] if rows and are_units(rows[0]) else kept
    found: dict[str, Column] = {}
    for quantity in _NAMES:
        if "current" in found and quantity in _INSTEAD["current"]:
            continue
        places = _places(quantity, kept, labels, chosen.get(quantity), units.get(quantity))
        if quantity == "state":
            # a separator may end each row
            of_words = _of_words(row[: len(kept)] for row in rows if len(row) >= len(kept))
            places += [n for n in of_words if kept[n] and n not in places]
        for number, place in enumerate(places, start=1):
            words, unit = _split(labels[place], quantity)
            column = Column(place, kept[place], *_scale(quantity, units.get(quantity, unit), kept[place]), words)
            found[quantity if number == 1 else f"{quantity} {number}"] = column
    missing = [quantity for quantity in REQUIRED if not {quantity, *_INSTEAD.get(quantity, ())} & set(found)]
    if missing:
        raise ValueError(
            f"no column for the {', the '.join(missing)} among {', '.join(map(str, names))}. Say which it is: "
            f"--columns {','.join(f'{quantity}=NAME' for quantity in missing)} (Python: columns)"
        )
    return found


def are_units(fields: Sequence[str]) -> bool:
    """Whether the line below a header holds units, where some testers write them; a clock may have none."""
    texts = [text for field in fields if (text := field.strip(_AROUND_UNITS))]
    needed = (("voltage",), ("current", *_INSTEAD["current"]))
    return not any(map(_NUMBER.match, texts)) and all(
        any(_unit(text, quantity) for quantity in quantities for text in texts) for quantities in needed
    )


def count_required(names: Sequence[str], chosen: Mapping[str, str] | None = None) -> int:
    """How much a line looks like the header of a record."""
    chosen, names = chosen or {}, [str(name) for name in names if any(map(str.isalpha, str(name)))]
    return sum(
        (
            any(name.strip() == chosen[quantity] for name in names)
            if quantity in chosen
            else any(_is_known(each, name) for each in (quantity, *_INSTEAD.get(quantity, ())) for name in names)
        )
        for quantity in REQUIRED
    )


def has(quantity: str, names: Sequence[str]) -> bool:
    """Whether one of the names may be that of a quantity."""
    return any(_is_known(quantity, name) for name in names)


def unit_of(quantity: str, unit: str) -> tuple[float, float]:
    """What the values of a quantity in some unit are multiplied with, and what is added then."""
    return _UNITS[quantity][unit.lower()]


def direction(state: object) -> int:
    """1 for what a tester calls a discharge, -1 for a charge, else 0."""
    words = " ".join(_words(str(state)))
    return 1 if _DISCHARGE.search(words) else -1 if _CHARGE.search(words) else 0


def _of_words(rows: Iterable[Sequence[str]]) -> list[int]:
    """Columns of a few words."""
    texts = [{text for value in values if (text := value.strip())} for values in zip(*rows, strict=False)]
    return [n for n, words in enumerate(texts) if 0 < len(words) <= _FEW_WORDS and not any(map(_NUMBER.match, words))]


def _words(name: str) -> list[str]:
    return _GAP.sub(" ", name).lower().split()


def _split(name: str, quantity: str) -> tuple[str, str]:
    """A name in lower case without gaps, and the unit in it, which may be empty."""
    name = normalize("NFKC", name)  # brackets may be as wide as a Chinese character
    match, words, known, ranks = _IN_BRACKETS.match(name), _words(name), _UNITS.get(quantity, {}), _RANKS[quantity]
    whole = "".join(words)
    if match and whole not in ranks:
        unit = next(group for group in match.group("round", "square", "slash") if group is not None)
        return "".join(_words(match["name"] + (match["number"] or ""))), unit.strip(" _")
    if len(name) >= _LEAST_UNIT_NAME.get(quantity, len(name) + 1) and whole in known:
        return next(each for each in ranks if each in known), whole
    for cut in (1, -3, -2, -1):  # the unit comes first, or last, also in some words, as deg C, m|A and m|A.h
        parts = ["".join(words[:cut]), "".join(words[cut:])]
        unit, base = parts if cut > 0 else parts[::-1]
        if base in ranks and unit in known:
            return base, unit
    return whole, ""


def _label(name: str | None, text: str | None) -> str:
    """A name with the unit that is written below it, unless it has one itself."""
    name, unit = name or "", (text or "").strip(_AROUND_UNITS)
    is_unit = any(_unit(unit, quantity) for quantity in _UNITS)
    is_plain = any("".join(_words(name)) in ranks for ranks in _RANKS.values())
    has_none = is_plain or not any(_split(name, quantity)[1] for quantity in _UNITS)
    return f"{name} ({unit})" if name and is_unit and has_none else name


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


def _may_be(quantity: str, name: str) -> bool:
    """Whether a name is among those of a quantity, and its unit not among those of another."""
    words, unit = _split(name, quantity)
    if words not in _RANKS[quantity] or ((quantity, words) in _WITH_UNIT and _unit(unit, quantity) is None):
        return False
    return _unit(unit, quantity) is not None or not any(_unit(unit, other) for other in _UNITS)


def _is_known(quantity: str, name: str) -> bool:
    """Whether a name may be that of a quantity, and its unit, if any, is known."""
    unit = _split(name, quantity)[1]
    return _may_be(quantity, name) and (not unit or _unit(unit, quantity) is not None)


def _places(quantity: str, names: Sequence[str], labels: Sequence[str], chosen: str | None, unit: str | None) -> list[int]:
    """The columns that may be a quantity: of clocks all, as one may be finer, of others those of the first name."""
    if chosen is not None:
        places = [n for n, name in enumerate(names) if name == chosen.strip()]
        if not places:
            raise ValueError(f"there is no column {chosen!r} for the {quantity} among {', '.join(filter(None, names))}")
        return places[:1]
    split = {n: _split(name, quantity) for n, name in enumerate(labels) if name and _may_be(quantity, name)}
    places = sorted(split, key=lambda n: _RANKS[quantity][split[n][0]])
    known = [n for n in places if unit or not split[n][1] or quantity not in _UNITS or _unit(split[n][1], quantity)]
    if places and not known and quantity not in REQUIRED:
        name = names[places[0]]
        warnings.warn(f"the unit of {name!r} is not known (--units {quantity}=UNIT). It is left out", stacklevel=2)
        return []
    places = known or places
    if quantity in REQUIRED:
        return [n for n in places if quantity == "time" or split[n][0] == split[places[0]][0]]
    return places[:1]


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
