"""The known testers: a row each, with its names of columns and its sign of the current. Users add rows as files."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from unicodedata import normalize

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# A word also ends at a capital, as in TestTime; a word with a punctuation mark at its end is no name.
_GAP = re.compile(r"(?<=[a-zäöü]{2})(?=[A-ZÄÖÜ])|(?:[_\-\s.#<>~{}()\[\]/]|[,:](?=.)|(?<=[_\s])in(?=[_\s]))+")
# Basic strings of TOML are those of JSON.
_quoted = partial(json.dumps, ensure_ascii=False)
#: Largest length of a name, and of a line in a message.
LONGEST = 200
#: Quantities of columns, and those that a record needs.
QUANTITIES = tuple(
    "time date voltage counter current power charge_step temperature ambient capacity cycle step cell state".split()
)
REQUIRED = ("time", "voltage", "current")
#: Quantities that can replace a required quantity.
SUBSTITUTES = {"time": ("date",), "current": ("power", "charge_step")}


@dataclass(frozen=True)
class Tester:
    """The layout of a tester's tables."""

    name: str
    # names without units, by quantity; the first in a table counts, and capitals, blanks and signs do not. time runs through
    # the test; counter is the counter electrode of the voltage, charge_step the charge since the previous row, and capacity
    # the tester's count of the charge drawn
    columns: Mapping[str, Sequence[str]]
    marks: Sequence[str] = ()  # names that identify a table of this tester
    units: Mapping[str, str] = field(default_factory=dict)  # of names without a unit; else s, V, A, degC and Ah
    discharge_is_negative: bool | None = None  # if voltage and words do not decide
    encoding: str = ""  # of its text, if not UTF-8
    missing: Sequence[str] = ()  # text for a missing value, besides nothing and NaN
    argument: str = ""  # the file of this row

    def __str__(self) -> str:
        return self.argument or self.name

    @cached_property
    def ranks(self) -> dict[str, dict[str, int]]:
        """Quantities by the words of a name, with the rank of the name for each."""
        ranks: dict[str, dict[str, int]] = {}
        for quantity, names in self.columns.items():
            for rank, name in enumerate(names):
                ranks.setdefault("".join(words_of(name)), {}).setdefault(quantity, rank)
        return ranks


def _row(name: str, marks: str, negative: bool | None = None, encoding: str = "", missing: str = "", **names: str) -> Tester:
    columns = {quantity: _split_names(text) for quantity, text in names.items()}
    return Tester(name, columns, _split_names(marks), {}, negative, encoding, _split_names(missing))


def _split_names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


# These rows omit names of the plain row, except clocks, because the clock of the test must come first.
_NAMED_TESTERS = (
    _row(
        "Arbin", "dV/dt, Is_FC_Data, ACI_Phase_Angle", negative=True, time="Test_Time", date="Date_Time",
        temperature="Aux_Temperature_1, Aux_Temperature", cell="Channel_ID",
    ),
    _row(
        "Maccor", "DPT Time, Amp-hr, Rec#, Cycle P", missing="N/A", time="TestTime, Test", date="DPT Time",
        voltage="Volts, mVolts", current="Amps, mAmps", temperature="Temp 1, EV Temp", capacity="Amp-hr, Cap.",
        cycle="Cyc#, Cycle P, Cycle C", state="State, Md",
    ),
    _row(
        "BioLogic", "Ewe, Ecell, Ewe-Ece, <Ewe>, Ns changes", negative=True, encoding="latin-1", time="time",
        voltage="Ewe-Ece, Ecell, Ewe, <Ewe>", counter="Ece", current="I, <I>", power="P, Pwe",
        charge_step="dq", capacity="Q discharge", cycle="cycle number", step="Ns",
    ),
    _row(
        "Neware", "DataPoint, Record number, Record ID, Chg. Cap., DChg. Cap., Relative Time, Cumulative Time, 工步号",
        encoding="gb18030", missing="--",
        time="Total Time, Cumulative Time, Test Time, 总时间, 累计时间, Time, Relative Time, 时间, 相对时间",
        date="Date, Absolute Time, Realtime, Timestamp, 绝对时间, 系统时间, 日期", voltage="Voltage, 电压",
        current="Current, Cur, 电流", temperature="T1, 温度, 电池温度", capacity="DChg. Cap., Capacitance DChg, 放电容量",
        cycle="Cycle Index, Cycle ID, 循环, 循环号, 循环序号", step="Step Index, Step ID, 工步, 工步号, 工步序号",
        state="Step Type, 状态, 工步类型, 工步状态",
    ),
    _row(
        "Basytec", "t-Step, t-Set, Ah-Step, Ah-Cyc-Discharge", negative=True, encoding="latin-1", time="~Time, Time, Zeit",
        date="Date", capacity="Ah-Cyc-Discharge", cycle="Cyc-Count", step="Line", state="Command",
    ),
    _row(
        "Novonix", "Run Time, Circuit Temperature", negative=True, encoding="latin-1", time="Run Time", date="Date and Time",
        voltage="Potential",
    ),
    _row(
        "Digatron", "Prog Time, Program Time, Program Duration, Programmdauer, AhAccu, AhStep", negative=True,
        encoding="latin-1", time="Prog Time, Program Time, Program Duration, Programmdauer, Programmzeit",
        date="Time Stamp, Zeitstempel", temperature="LogTemp001",
    ),
    _row(
        "Landt", "channel_index, SysTime, Step-State, 测试时间", encoding="gb18030", time="TestTime, 测试时间",
        date="SysTime, Date Time ISO string, 系统时间", temperature="Temperature 1", state="Step Name, StepMode, Step-State",
    ),
    _row(
        "PEC", "Load On Time, Position Start Time", negative=True, time="Total Time", date="Real Time",
        state="Instruction Name",
    ),
    _row("Gamry", "Vf, Im", time="T", voltage="Vf", current="Im"),
    _row("EBC", "Vol", encoding="gb18030", time="Time, Sec", voltage="Vol", current="Cur"),
    _row(
        "Battery Archive (Sandia, CALCE)", "Environment_Temperature", negative=True, time="Test_Time", date="Date_Time",
        temperature="Cell_Temperature", ambient="Environment_Temperature",
    ),
    _row("CALCE (text of Cadex)", "mV", time="Time", voltage="mV", current="mA"),
    _row(
        "Battery Data Format", "Unix Time, Test Time", negative=True, time="Test Time", date="Unix Time, Date Time",
        temperature="Surface Temperature T1, Temperature T1", capacity="Discharging Capacity",
    ),
)  # fmt: skip
_PLAIN = _row(
    "plain", "", encoding="latin-1", missing="--, ---, N/A, n.a., -",
    time="time, total time, elapsed time, elapsed, test, relative time, seconds, t, testzeit, laufzeit, zeit",
    date="date time, timestamp, date, absolute time, system time, datum, datum uhrzeit",
    voltage="voltage, cell voltage, terminal voltage, battery voltage, voltage measured, volts, volt, u, v, cell potential, "
    "u cell, v cell, spannung, zellspannung, klemmenspannung",
    current="current, cell current, battery current, current measured, amps, amp, i, i cell, strom, zellstrom",
    power="power, p, leistung",
    temperature="temperature, cell temperature, temperature measured, surface temperature, temp, temp 1, t1, t, temperatur",
    ambient="ambient temperature, chamber temperature, umgebungstemperatur",
    capacity="discharge capacity, capacity, cap, ah, entladekapazität, kapazität",
    cycle="cycle, cycle index, cycle number, cycle no, cycle count, cyc, zyklus",
    step="step, step index, step number, step no, schritt",
    state="state, status, mode, step type, zustand, betriebsart, modus",
    cell="cell id, cell name, cell number, cell no, cell, battery id, barcode, serial number, channel, zelle",
)  # fmt: skip


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters, with full-width brackets as plain brackets."""
    return _GAP.sub(" ", normalize("NFKC", name)[:LONGEST]).lower().split()


def merge(first: Tester, *fallbacks: Tester) -> Tester:
    """Return a row with the names of other rows behind the names of the first."""
    columns = {
        quantity: list(dict.fromkeys(name for tester in (first, *fallbacks) for name in tester.columns.get(quantity, ())))
        for quantity in QUANTITIES
    }
    return replace(first, columns=columns, missing=[text for tester in (first, *fallbacks) for text in tester.missing])


#: All rows in order of trial; the last row has the names of all.
TESTERS = (*_NAMED_TESTERS, merge(_PLAIN, *_NAMED_TESTERS))
#: Encodings other than UTF-8.
ENCODINGS = tuple(dict.fromkeys(tester.encoding for tester in (_PLAIN, *_NAMED_TESTERS) if tester.encoding))


def find_tester(name: str | Path | Tester | None) -> Tester | None:
    """Return a tester by its name, or from a TOML file as of :func:`tester_file`; ``None``: by the table."""
    if name is None or isinstance(name, Tester):
        return name
    for tester in TESTERS:
        if tester.name.lower() == str(name).strip().lower():
            return merge(tester, TESTERS[-1])
    try:
        tester = _tester_of(Path(name).stem, tomllib.loads(Path(name).read_text(encoding="utf-8")))
        return replace(tester, argument=str(name))
    except FileNotFoundError as error:
        names = ", ".join(tester.name for tester in TESTERS)
        raise FileNotFoundError(f"no file {str(name)!r}, nor a tester of this name: known are {names}") from error
    except ValueError as error:  # of the encoding, of TOML, or of what it says
        raise ValueError(f"{name} is no file of a tester in TOML: {error}") from error


def _tester_of(name: str, content: dict[str, Any]) -> Tester:
    kinds = dict(name=str, columns=dict, units=dict, discharge_is_negative=bool, encoding=str, missing=list)
    for key, value in content.items():
        if key not in kinds or not isinstance(value, kinds[key]):
            allowed = ", ".join(f"{name} ({kind.__name__})" for name, kind in kinds.items())
            raise ValueError(f"a tester has {allowed}, got {key} = {value!r}")
    columns, units = content.get("columns", {}), content.get("units", {})
    for key, value in (*columns.items(), *units.items()):
        if key not in QUANTITIES or not isinstance(value, str):
            raise ValueError(f"names and units are text by quantity ({', '.join(QUANTITIES)}), got {key} = {value!r}")
    column_names = {"columns": {quantity: [text] for quantity, text in columns.items()}}
    return merge(Tester(**{"name": name} | content | column_names), TESTERS[-1])


def tester_file(columns: Mapping[str, Any], names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a TOML file to fill in, with the recognised columns of a table, its names and its first rows."""
    lines = [
        "# A tester for battery-calibrate --tester: its columns by name, and units that the names do not tell.",
        *(f"# {_quoted(', '.join(fields)[:200])}" for fields in (names, *rows[:2])),
        'name = "my tester"',
        "# discharge_is_negative = true  # where the voltage does not tell",
        '# encoding = "latin-1"  # where the text is not UTF-8',
        '# missing = ["--"]  # what stands for a value that was not measured',
    ]
    for title, attribute in (("columns", "name"), ("units", "unit")):
        lines.append(f"[{title}]")
        for quantity in QUANTITIES:
            text = getattr(columns.get(quantity), attribute, "")
            lines.append(f"{'' if text else '# '}{quantity} = {_quoted(text)}")
    return "\n".join([*lines, ""])
