"""Which column of a table is which measurement, and in which unit: told from the names that testers give."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from battery_env.checks import ZERO_CELSIUS_K

#: What a record must have.
REQUIRED = ("time", "voltage", "current")

# By quantity, the names it goes by, written in lower case with single spaces. The first that a table has is taken: elapsed
# times before those of a step, and times before dates.
_NAMES: dict[str, tuple[str, ...]] = {
    "time": (
        *("test time", "total time", "elapsed time", "accumulated time", "run time", "test", "time", "t", "relative time"),
        *("unix time", "date time", "datetime", "timestamp", "absolute time", "dpt time", "real time", "realtime", "date"),
    ),
    "voltage": ("voltage", "cell voltage", "terminal voltage", "voltage measured", "volts", "volt", "ecell", "ewe", "u", "v"),
    "current": ("current", "cell current", "current measured", "amps", "amp", "i"),
    "temperature": (
        *("temperature", "cell temperature", "temperature measured", "surface temperature", "surface temperature t1"),
        *("temperature t1", "aux temperature 1", "temp", "temp 1", "t1"),
    ),
    "ambient": ("ambient temperature",),
    "cycle": ("cycle", "cycle index", "cycle number", "cycle count", "cycle id", "cyc", "cycle p"),
    "step": ("step count", "step", "step index", "step number", "step id", "steps", "ns"),
    "state": ("state", "md", "status", "step type"),
}
_DEGREES = dict.fromkeys(("c", "°c", "degc", "deg c", "celsius"), (1.0, 0.0))
_KELVIN = dict.fromkeys(("k", "kelvin"), (1.0, -ZERO_CELSIUS_K))
# By quantity and unit in lower case: factor and offset to s, V, A and degC.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), (1.0, 0.0)),
        **dict.fromkeys(("ms", "millisecond", "milliseconds"), (1e-3, 0.0)),
        **dict.fromkeys(("min", "mins", "minute", "minutes"), (60.0, 0.0)),
        **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), (3600.0, 0.0)),
        # text such as 1:02:03.5, which becomes seconds when it is read
        **dict.fromkeys(("h:min:s.ms", "h:m:s.ms", "hh:mm:ss", "hh:mm:ss.ms", "h:m:s", "h:min:s"), (1.0, 0.0)),
    },
    "voltage": {
        **dict.fromkeys(("v", "volt", "volts"), (1.0, 0.0)),
        **dict.fromkeys(("mv", "millivolt", "millivolts"), (1e-3, 0.0)),
    },
    "current": {
        **dict.fromkeys(("a", "amp", "amps", "ampere", "amperes"), (1.0, 0.0)),
        **dict.fromkeys(("ma", "milliamp", "milliamps", "milliampere", "milliamperes"), (1e-3, 0.0)),
        **dict.fromkeys(("ua", "µa", "μa", "microamp", "microamps"), (1e-6, 0.0)),
    },
    "temperature": _DEGREES | _KELVIN,
    "ambient": _DEGREES | _KELVIN,
}
_UNIT = re.compile(r"^(?P<name>.*?)\s*(?:\((?P<round>[^()]*)\)|\[(?P<square>[^][]*)\]|/\s*(?P<slash>[^/]+))\s*$")


class Column(NamedTuple):
    """
    A column and what makes SI of it.

    :param position: among the columns of the table
    :param name: as the table has it
    :param factor: what its values are multiplied with to give s, V or A, or differences of temperature in K
    :param offset: what is added then
    """

    position: int
    name: str
    factor: float = 1.0
    offset: float = 0.0


def find_columns(
    names: Sequence[str], chosen: Mapping[str, str] | None = None, units: Mapping[str, str] | None = None
) -> dict[str, Column]:
    """
    The columns of a record. A unit is told from the name, as in ``Current(mA)``, ``Voltage / V``, ``time[min]`` or
    ``test_time_second``; a name without one is in s, V, A or degC.
    """
    chosen, units = dict(chosen or {}), dict(units or {})
    for option, given in (("columns", chosen), ("units", units)):
        if unknown := set(given) - set(_NAMES):
            raise ValueError(f"{option} knows {', '.join(_NAMES)}, got {', '.join(sorted(unknown))}")
    split = {quantity: [_split(str(name), quantity) for name in names] for quantity in _NAMES}
    found: dict[str, Column] = {}
    for quantity, parts in split.items():
        position = _position(quantity, names, [name for name, _ in parts], chosen.get(quantity))
        if position is not None:
            unit = units.get(quantity, parts[position][1])
            found[quantity] = Column(position, str(names[position]), *_scale(quantity, unit, str(names[position])))
    missing = [quantity for quantity in REQUIRED if quantity not in found]
    if missing:
        raise ValueError(
            f"no column for the {', the '.join(missing)} among {', '.join(str(name) for name in names)}. Say which it is: "
            f"--columns {','.join(f'{quantity}=NAME' for quantity in missing)} (Python: columns)"
        )
    return found


def units_below(columns: Mapping[str, Column], fields: Sequence[str]) -> dict[str, str] | None:
    """The units in the line below a header, where some testers write them."""
    found = {}
    for quantity, column in columns.items():
        unit = fields[column.position].strip("[]() ").lower() if column.position < len(fields) else ""
        if unit in _UNITS.get(quantity, {}):
            found[quantity] = unit
        elif quantity in REQUIRED:
            return None
    return {quantity: unit for quantity, unit in found.items() if not _split(columns[quantity].name, quantity)[1]}


def count_required(names: Sequence[str], chosen: Mapping[str, str] | None = None) -> int:
    """How much a line looks like the header of a record."""
    chosen = chosen or {}
    return sum(
        (
            any(str(name).strip() == chosen[quantity] for name in names)
            if quantity in chosen
            else any(_split(str(name), quantity)[0] in _NAMES[quantity] for name in names)
        )
        for quantity in REQUIRED
    )


def _split(name: str, quantity: str) -> tuple[str, str]:
    """A name in lower case with single spaces, and the unit in it, which may be empty."""
    match = _UNIT.match(name)
    if match:
        unit = next(group for group in match.group("round", "square", "slash") if group is not None)
        return _plain(match["name"]), unit.strip().lower()
    plain = _plain(name)
    base, _, last = plain.rpartition(" ")
    if base in _NAMES[quantity] and last in _UNITS.get(quantity, {}):
        return base, last
    return plain, ""


def _plain(name: str) -> str:
    return " ".join(re.sub(r"[_\-\s.#<>~]+", " ", name.lower()).split())


def _position(quantity: str, names: Sequence[str], plain: Sequence[str], chosen: str | None) -> int | None:
    if chosen is not None:
        places = [n for n, name in enumerate(names) if str(name).strip() == chosen.strip()]
        if not places:
            raise ValueError(f"there is no column {chosen!r} for the {quantity} among {', '.join(map(str, names))}")
        return places[0]
    for known in _NAMES[quantity]:
        places = [n for n, name in enumerate(plain) if name == known]
        if len(places) > 1 and quantity in REQUIRED:
            both = " and ".join(repr(str(names[n])) for n in places[:2])
            raise ValueError(
                f"both {both} may be the {quantity}. Say which it is: --columns {quantity}=NAME (Python: columns)"
            )
        if places:
            return places[0]
    return None


def _scale(quantity: str, unit: str, name: str) -> tuple[float, float]:
    known = _UNITS.get(quantity)
    if known is None or not unit:
        return 1.0, 0.0
    if unit.lower() not in known:
        raise ValueError(
            f"the unit {unit!r} of the column {name!r} is not known for the {quantity}. Known are {', '.join(known)}. "
            f"State it: --units {quantity}=UNIT (Python: units)"
        )
    return known[unit.lower()]
