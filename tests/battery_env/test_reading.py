"""Tables of one record that is written in other ways: what is read, what is said of it, and what is refused, a row a kind."""

import gzip
import io
import re
import sys
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from battery_env import calibrate, read_discharges
from battery_env.estimators.least_squares import LeastSquares
from battery_env.lab import calibrate as calibrate_module
from battery_env.lab import running as running_module
from battery_env.lab.command_line import calibrate as command
from battery_env.lab.readers.columns import FileFormat, recognise
from battery_env.lab.readers.discharges import read_recordings
from battery_env.lab.readers.testers import TESTERS, merge
from battery_env.lab.sources import Source, find_sources
from tests.sweeps import sweep
from tests.tables import LOADED, RECORD, TABLE, clock, near, read

LOAD_ON = int(np.argmax(LOADED))
ROWS = len(TABLE)
#: A charge and a rest, as they come before the discharge.
CHARGE = pd.DataFrame({"time": np.arange(0.0, 3600.0, 60.0), "voltage": np.linspace(3.6, 4.2, 60), "current": 1.5})
REST = pd.DataFrame({"time": 3600.0 + np.arange(0.0, 600.0, 60.0), "voltage": 4.19, "current": 0.0})
CYCLE = pd.concat([CHARGE, REST, TABLE.assign(time=4200.0 + TABLE["time"])], ignore_index=True)
START = pd.Timestamp("2026-02-27 23:50")
DATES = START + pd.to_timedelta(RECORD.time_s, unit="s")
COUNTED_AH = np.append(0.0, np.cumsum(RECORD.current_A.clip(0.0)[:-1] * np.diff(RECORD.time_s))) / 3600.0


def named(*names, **columns):
    """The record with other names of its columns, and more columns."""
    return TABLE.set_axis(names or [*TABLE], axis="columns").assign(**columns)


def at(row, **values):
    """The record with other values in a row."""
    table = TABLE.astype(object)
    table.loc[row, [*values]] = [*values.values()]
    return table


def refused(source, message):
    """The error of what is not read."""
    with pytest.raises(ValueError) as caught:
        read_discharges(source)
    assert re.search(message, " ".join(str(caught.value).split())), caught.value
    return str(caught.value)


CLOCK = {"Total Time (Hours in hh:mm:ss)": [*map(clock, RECORD.time_s)]}
LATER = np.round(RECORD.time_s + 85000.0, 2)
DAYS = {
    style: [(style.format(int(t // 86400)) if t >= 86400.0 else "") + clock(t % 86400.0) for t in LATER]
    for style in ("{}-", "{}.", "{} days ", "{} day, ", "{}d ")
}
TIMES_OF_DAY = (START + pd.to_timedelta(RECORD.time_s, unit="s")).strftime("%H:%M:%S.%f")
DEAD = pd.DataFrame({"time": [-2.0, -1.0], "voltage": 0.003, "current": 0.0})
ELECTRODES = named("time/s", "Ewe-Ece/V", "I/A", **{"Ece/V": np.linspace(0.05, 0.2, ROWS)})
ELECTRODES["Ewe/V"] = ELECTRODES["Ewe-Ece/V"] + ELECTRODES["Ece/V"]
STEP_C = np.diff(TABLE["time"], prepend=TABLE["time"].iloc[0]) * TABLE["current"]
NOT_NEEDED = "It is left out"
#: What is read as the record, or near to it, and what is said of it.
READ = {
    "a unit of another quantity": (named("t[s]", "U[V]", "I[A]", **{"T[°C]": 25.0}), ""),
    "a lost sign of degrees": (named(**{"Temperature/\ufffdC": 25.0}), ""),
    "no sensor": (named(**{"Temperature (C)": 0.0}), NOT_NEEDED),
    "a sensor that is not connected": (named(**{"Temperature (C)": -2501.7}), NOT_NEEDED),
    "dashes": (named(**{"Temperature (C)": "--"}), NOT_NEEDED),
    "an unknown unit": (named(**{"Temperature (furlong)": 25.0}), ""),
    "two names that agree": (
        named("time/s", "U/V", "I/A", **{"time/h": RECORD.time_s / 3600.0, "U/mV": (1e3 * TABLE["voltage"]).round()}),
        "",
    ),
    "no number of cycles": (named(Cycle=6.283), NOT_NEEDED),
    "three electrodes": (ELECTRODES, ""),
    "two electrodes": (ELECTRODES.drop(columns="Ewe-Ece/V"), "the voltage is Ewe/V less Ece/V"),
    "a power": (TABLE[["time", "voltage"]].assign(**{"P (mW)": 1e3 * TABLE["current"] * TABLE["voltage"]}), "P (mW) over"),
    "a charge a row": (TABLE[["time", "voltage"]].assign(**{"dq/mA.h": STEP_C / 3.6}), "the charge dq/mA.h"),
    "dates in digits": (named("Timestamp", "U", "I").assign(Timestamp=DATES.strftime("%Y%m%d%H%M%S").astype(np.int64)), ""),
    "a clock of hours": (named(time=[*map(clock, RECORD.time_s)]), ""),
    "a unit that is a clock": (named("Total Time (Hours in hh:mm:ss)", "U", "I").assign(**CLOCK), ""),
    **{f"days as {style}": (named("TestTime", "Vol", "Cur").assign(TestTime=text), "") for style, text in DAYS.items()},
    "a blank in a clock": (named(time=pd.Series([*map(clock, RECORD.time_s)]).mask(TABLE.index == 30)), "row 31"),
    "a blank in dates": (
        named("Date", "U", "I").assign(Date=pd.Series(DATES.strftime("%d.%m.%Y %X")).mask(TABLE.index == 9)),
        "10",
    ),
    "a voltage that is missing": (
        at([40, 90], voltage=np.nan),
        "left out, as the voltage is missing in row 41, 91 (2 rows)",
    ),
    "what a meter could not read": (at([5, 100], current=9.9e37), "lies beyond -1000 .. 1000 A in row 6, 101 (2 rows)"),
    "bytes that were lost": (
        at([41, 42], voltage=114694.0, current=-589843.0),
        "the voltage lies beyond -0.1 .. 5.5 V in row 42 to 43 (2 rows); the current lies beyond",
    ),
    "words in a row": (at(50, time="Step", voltage="three", current=""), "no measurement of a cell in row 51"),
    "no cell at the ends": (pd.concat([DEAD, TABLE], ignore_index=True), "no measurement of a cell in row 1 to 2 (2 rows)"),
    "a time of day": (named(time=TIMES_OF_DAY), "the time of day 'time' passes midnight: a day more from row 65 on"),
    "a time of day with decimal commas": (named(time=TIMES_OF_DAY.str.replace(".", ",")), "passes midnight"),
    "a time of day that is a number": (named(time=(RECORD.time_s + 85800.0) % 86400.0), "passes midnight"),
    "a time of day, of a cycle each": (named(time=TIMES_OF_DAY, Cycle=1 + (RECORD.time_s > 600.0)), "passes midnight"),
    **{
        f"{tick} since 1970": (named(time=((1.6e9 + RECORD.time_s) * per_s).round().astype(np.int64)), "")
        for tick, per_s in (("ms", 1e3), ("us", 1e6), ("ns", 1e9))
    },
    "us by name": (named("time_us", "U", "I").assign(time_us=1e6 * RECORD.time_s), ""),
    "ns by name": (named("Time (ns)", "U", "I").assign(**{"Time (ns)": 1e9 * RECORD.time_s}), ""),
    **{
        f"dates as {style} beside minutes of each step": (
            named(time=RECORD.time_s % 900.0 / 60.0, Date=DATES.strftime(style)),
            "the time is 'Date', as 'time' goes back",
        )
        for style in ("%Y-%m-%d,%H:%M:%S.%f", "%Y-%m-%d-%H:%M:%S.%f", "%d.%m.%Y, %H:%M:%S.%f", "%Y/%m/%d_%H:%M:%S.%f")
    },
    "a row twice": (pd.concat([TABLE[:100], TABLE[99:]], ignore_index=True), "row 101 has the time of the row before"),
    "a fault of the voltage": (at(100, voltage=0.003), ""),
    "rows of Float64 and an index": (TABLE.astype("Float64").set_index("time"), ""),
    "a clock that goes back beside dates": (
        named(time=np.where(TABLE.index > 150, RECORD.time_s - 1400.0, RECORD.time_s), **{"Absolute Time": DATES}),
        "the time is 'Absolute Time', as 'time' goes back",
    ),
    "the count of the tester": (named(**{"Capacity (Ah)": COUNTED_AH}), ""),
    "a count that starts anew": (named(**{"Capacity (Ah)": COUNTED_AH - COUNTED_AH[150] * (TABLE.index >= 150)}), ""),
    "a count of something else": (named(**{"Capacity (Ah)": 2.0}), ""),
    "another count": (named(**{"Capacity (Ah)": 1.1 * COUNTED_AH}), "the tester counted"),
    "no name of a cell": (named(**{"Cell ID": ""}), ""),
}
HALF_SIGN = pd.concat([CHARGE, REST, CYCLE[len(CHARGE) + len(REST) :]]).assign(current=lambda rows: rows["current"].abs())
PUT_BACK = DATES - pd.to_timedelta(3600.0 * (RECORD.time_s > 900.0), unit="s")
#: What is refused, and why.
REFUSED = {
    "no time": (
        TABLE[["voltage", "current"]],
        r"no column for the time\. header voltage, current row 1 .* time not found",
    ),
    "two of a name": (
        named("time/s", "U/V", "I/A", **{"time/h": 1.0, "I/mA": 1.0}),
        r"both 'time/s' and 'time/h' may be the time, and they differ.*If it is 'time/s': .*columns={'time': 'time/s'}",
    ),
    "two of a name that differ in one part": (
        named("time", "U/V", "I", **{"U/mV": 1e3 * TABLE["voltage"] - np.where(TABLE.index > 250, 50.0, 0.0)}),
        r"both 'U/V' and 'U/mV' may be the voltage",
    ),
    "an unknown unit": (named("time (furlong)", "U", "I"), r"no column for the time\. header time \(furlong\), U, I"),
    "several cells": (named(**{"Cell ID": np.where(LOADED, "A", "B")}), r"'Cell ID' names 2 cells \(B, A\): give each a file"),
    "a step": (TABLE[:4], "needs 5 rows with a time, a voltage and a current, got 4"),
    "words for numbers": (named(voltage="OVERLOAD"), "'voltage' must hold numbers, got 'OVERLOAD' in row 1"),
    "separators of thousands": (
        named(time=[f"{1e3 * t:,.1f}" for t in RECORD.time_s]),
        "must hold numbers, got '9,421.0' in row 2",
    ),
    "many values that are missing": (
        at([*range(90, 130)], current=np.nan),
        r"the current is missing in row 91 to 130 \(40 rows\)\. Of 322 rows at most 3 are left out: remove these, or fill",
    ),
    "values that are missing in two columns": (
        at([*range(10, 60, 10)], current=np.nan).assign(voltage=TABLE["voltage"].mask(TABLE.index == 321)),
        r"voltage is missing in row 322; the current is missing in row 11, 21, 31, 41, 51 \(5 rows\)",
    ),
    "bytes that are often lost": (
        at([*range(10, 110, 10)], current=589843.0),
        r"the current lies beyond -1000 .. 1000 A in row 11, 21, .*, 101 \(10 rows\)\. Of 322 rows at most 3",
    ),
    "truth values": (named(current=LOADED), "the column 'current' must hold real numbers, got np.False_"),
    "complex numbers": (named(current=TABLE["current"] + 0j), "the column 'current' must hold real numbers, got np.complex"),
    "next to nothing": (named(current=1e-300 * TABLE["current"]), "current_A must reach 2e-13 A, got 2.01529e-300 A at most"),
    "microseconds": (
        named(time=1e6 * RECORD.time_s),
        r"too long for a discharge. Give the time in seconds: .*{'time': 'us'}",
    ),
    "a clock that goes back": (
        named(time=RECORD.time_s - 10.0 * (TABLE.index >= 150)),
        r"goes back: row 151 is at .* s, after",
    ),
    "the newest row first": (TABLE[::-1], "goes back: row 2 to 322"),
    "a time of day that stops at noon": (named(time=(RECORD.time_s + 42000.0) % 43200.0), "goes back: row 130"),
    "a clock of each step": (
        named(time=RECORD.time_s - RECORD.time_s[150] * (TABLE.index >= 150)),
        "goes back: row 151 is at 0 s",
    ),
    "a clock that is put back": (named("Date", "U", "I").assign(Date=PUT_BACK), "the clock goes back: row .*dates in UTC"),
    "tests one after another": (
        pd.concat([CYCLE, CYCLE]),
        "the clock goes back: row 393 .*Number tests in a column",
    ),
    "two channels in turn": (
        pd.concat([TABLE, TABLE.assign(voltage=TABLE["voltage"] - 0.05)]).sort_values("time", kind="stable"),
        "each sample once",
    ),
    "a coarse clock": (named(time=RECORD.time_s - RECORD.time_s % 300.0), "each sample once"),
    "minutes beside dates": (named(time=RECORD.time_s / 60.0, Date=DATES), "as if the time counts minutes: --units time=min"),
    "minutes beside a count": (
        named(time=RECORD.time_s / 60.0, **{"Capacity (Ah)": COUNTED_AH}),
        "the tester counted .* as if the time counts minutes: --units time=min",
    ),
    "hours": (named(time=RECORD.time_s / 3600.0), "too short for a discharge. Give the time in seconds: .*{'time': 'h'}"),
    "three seconds": (
        named("Test (Sec)", "U", "I").assign(**{"Test (Sec)": RECORD.time_s / 1e3}),
        r"too short for a discharge\.$",
    ),
    "millivolts": (named(voltage=1e3 * RECORD.voltage_V), "voltage_V must lie within .*units={'voltage': 'mV'}"),
    "milliamperes": (named(current=1e3 * RECORD.current_A), "current_A must lie within .*units={'current': 'mA'}"),
    "few milliamperes": (
        named(current=100.0 * RECORD.current_A),
        r"145 Ah if it is in A, 145 mAh if it is in mA: above 10 Ah state which\. mA\? Then: .*'mA'}\) A\? Then: .*'A'}\)",
    ),
    "nanoseconds": (named(time=1e9 * RECORD.time_s), r"too long for a discharge. .*units={'time': 'ns'}\)$"),
    "a charge": (CHARGE, r"there is no discharge, but a charge of 1\.475 Ah, from 3\.60 to 4\.20 V"),
    "a charge that is negative": (
        CHARGE.assign(current=-1.5),
        r"there is no discharge, but a charge of 1\.475 Ah, from 3\.60 to 4\.20 V",
    ),
    "no current": (named(current=0.0), "no current flows"),
    "so little that it is noise": (named(current=1e-6 * (TABLE.index == 7)), "no current flows"),
    "no sign": (HALF_SIGN, r"the current has no sign: from row 1 on the voltage rises.*--columns state=NAME"),
    "words that contradict the voltage": (
        CYCLE.assign(state=np.where(CYCLE["current"] > 0.0, "Discharge", "Charge")),
        r"contradict each other \(1\.00, -1\.00\)",
    ),
    "no voltage that tells the sign": (named(voltage=3.7), "cannot be told.*discharge_is_negative=True.*=False"),
    "jumps against what passes": (
        named(voltage=RECORD.voltage_V + 0.3 * RECORD.current_A),
        "in total: flip the sign of it.*discharge_is_negative=",
    ),
    "ends of steps alone": (
        pd.concat(
            [
                CYCLE.iloc[[59, 69, 70 + np.flatnonzero(LOADED)[-1], -1]].assign(
                    time=lambda rows, n=n: rows["time"] + 9e3 * n, Cycle=n
                )
                for n in range(3)
            ]
        ),
        "rows are no discharge. If each is the end of a step",
    ),
}


@pytest.mark.parametrize(("table", "said"), READ.values(), ids=READ)
def test_what_is_read_is_the_record_and_what_is_odd_is_said(table, said):
    near(read(table, said))


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("table", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused_says_why(table, message):
    for line in refused(table, message).splitlines():
        if line.startswith("  "):  # can be pasted
            assert eval(line.strip(), {"read_discharges": lambda _, **options: options, "table": table})


TEXT = TABLE.to_csv(index=False)
HEADER, *LINES = TEXT.splitlines()
PROGRAM = "Step,Current (A),Voltage (V),Time (s)\n1,1.5,4.2,9e4\n2,0,0,9e4\n3,2,2.7,9e4\n\n"
MORE = HEADER.replace("time", "T").replace("voltage", "Vf").replace("current", "Im") + "\ns,V vs. Ref.,A\n"
#: Texts of the record, and what is said of them.
TEXTS = {
    "a header that comes again": (
        MORE + "\n".join([*LINES[:99], "[Data]", *MORE.splitlines(), *LINES[99:]]),
        "no measurement",
    ),
    "a program above": (PROGRAM + TEXT, "the header is line 6; the table of line 1 is left out"),
    "a delimiter that is said": ("sep=;\n" + TEXT.replace(",", ";"), ""),
    "decimal commas": (TEXT.replace(",", ";").replace(".", ","), ""),
    "decimal commas and titles": (
        TEXT.replace(",", ";").replace(".", ",").replace("\n", "\nNext step\n", 30),
        "no measurement",
    ),
    "names behind the last field": (TEXT.replace(HEADER, HEADER + ",VAR1,VAR2"), "longer than the rows: VAR1, VAR2 left out"),
    "names behind an empty field": (
        TEXT.replace(HEADER, HEADER + ",VAR1,VAR2").replace("\n", ",\n").replace(",", "\t"),
        "longer than the rows: VAR2 left out",
    ),
    "strokes and signs of typographers": (TEXT.replace(",", "|").replace("-", "\u2212"), ""),
    "lines of old computers": (TEXT.replace("\n", "\r"), ""),
    "a byte of an unknown origin": (b"\0" + TEXT.encode(), "NUL bytes, which are no text, are left out"),
    "an end that a power cut left": (TEXT.encode() + bytes(4096), "NUL bytes"),
    "UTF-16": (TEXT.encode("utf-16"), ""),
    "Chinese": ("总时间(s),电压(V),电流(A)\n".encode("gb18030") + "\n".join(LINES).encode(), ""),
    "a last line that is cut": (TEXT[: TEXT.rindex(",")], "left out, as the current is missing in row 322"),
    "remarks behind": ("\n".join([HEADER, *LINES[:200], *(f"{line},ok" for line in LINES[200:])]), ""),
    "row numbers": ("," + HEADER + "\n" + "\n".join(f"{n},{line}" for n, line in enumerate(LINES)), ""),
}
#: Texts that are refused, and why.
NO_TEXTS = {
    "a row of titles": (
        "Old cell\nload of 350 mA at 5V\n\n" + "\n".join(LINES),
        "no column for the time, the voltage, the current. header 1, 2, 3",
    ),
    "names with blanks": (
        "Test Time Volts Amps Temp\n" + "\n".join(f"{line.replace(',', ' ')} 25" for line in LINES),
        "4 fields below 5 names, .*than the blanks in names",
    ),
    "more numbers than names": (TEXT.replace(".", ","), "fields below 3 names.*another delimiter than the decimal comma"),
    "quotes that do not end": (TEXT.replace("\n", '\n"', 90), r"the column 'time' must hold numbers, got '0\.0,4"),
    "layers of rows": (
        "Cycle,Cap\n,Step,Cap\n,," + HEADER + "\n1,1.4\n,1,1.4\n" + "\n".join(f",,{line}" for line in LINES),
        "rows of cycles, steps and records are in one table: export the records alone",
    ),
    "UTF-32": (TEXT.encode("utf-32"), "the file is binary"),
    "a program alone": ("Units,Volts,Amps,K\nEnd\n" + TEXT.replace("time", "X", 1), r"no column for the time\. header X"),
}


@pytest.mark.parametrize(("text", "said"), TEXTS.values(), ids=TEXTS)
def test_texts_are_read(text, said, tmp_path):
    (tmp_path / "cell.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    near(read(tmp_path / "cell.csv", said))


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("text", "message"), NO_TEXTS.values(), ids=NO_TEXTS)
def test_other_texts_are_refused_with_their_first_lines(text, message, tmp_path):
    (tmp_path / "cell.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(tmp_path / "cell.csv", message)


@pytest.mark.parametrize("with_step", [True, False])
def test_at_a_switch_the_order_of_the_rows_tells(with_step):
    table = TABLE.assign(current=TABLE["current"].where(TABLE.index < 150, 0.0))
    again = table.iloc[[149]].assign(current=0.0, voltage=TABLE["voltage"].iloc[149] + 0.1)
    table = pd.concat([table[:150], again, table[150:]], ignore_index=True)
    if with_step:
        table["Step"] = np.arange(len(table)) >= 150
    found = read(table, "" if with_step else "row 151 has the time of the row before: later where the load is switched")
    np.testing.assert_allclose(found.time_s[150] - found.time_s[149], 1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("power", ["W", "V"])
def test_a_load_that_follows_the_voltage_tells_its_sign_by_the_fall(sign, power):
    """A constant power, or a constant resistance, without a rest."""
    voltage_V = RECORD.voltage_V[LOADED] + 0.003 * np.random.default_rng(1).standard_normal(LOADED.sum())
    current_A = 8.0 / voltage_V if power == "W" else voltage_V / 2.0
    found = read(pd.DataFrame({"time": RECORD.time_s[LOADED], "voltage": voltage_V, "current": sign * current_A}))
    np.testing.assert_allclose(found.current_A, current_A)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("after", ["a long rest", "a held voltage"])
def test_what_follows_a_load_does_not_turn_the_sign(sign, after):
    load, more_s = TABLE[: np.flatnonzero(LOADED)[-1]], np.arange(1, 61) * 10.0
    more = pd.DataFrame(
        {"time": load["time"].iloc[-1] + more_s, "voltage": 2.9 - 0.2 * np.exp(-more_s / 200.0), "current": 0.0}
    )
    if after == "a held voltage":
        more = more.assign(voltage=load["voltage"].iloc[-1], current=load["current"].iloc[-1] * np.exp(-more_s / 300.0))
    table = pd.concat([load, more])
    found = read(table.assign(current=sign * table["current"]))
    assert found.charge_C > 0.99 * RECORD.charge_C and found.current_A.min() >= -0.01


@pytest.mark.parametrize("order", [["CHARGE", "REST", "TABLE"], ["TABLE", "LOW", "CHARGE"], ["LOW", "FLAT", "REST", "TABLE"]])
def test_a_current_without_a_sign_is_refused_or_told_by_words(order):
    parts = {"CHARGE": CHARGE, "REST": REST, "TABLE": TABLE, "LOW": REST.assign(voltage=3.7)}
    parts["FLAT"] = CHARGE.assign(voltage=np.linspace(3.9, 4.2, 60))  # a charge whose voltage jumps more than it rises
    parts = [parts[name].assign(time=lambda rows, n=n: rows["time"] + 5e3 * n, Mode=name) for n, name in enumerate(order)]
    table = pd.concat(parts, ignore_index=True).assign(current=lambda rows: rows["current"].abs())
    with pytest.raises(ValueError, match=r"the current has no sign.*--columns state=NAME"):
        read_discharges(table.drop(columns="Mode"))
    words = {"CHARGE": "CC Chg", "FLAT": "Laden", "REST": "Rest", "LOW": "Pause", "TABLE": "CC DChg"}
    near(read(table.assign(Mode=table["Mode"].map(words))), 3e-3)


@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=40)
@given(st.integers(0, 4), st.integers(1, 40), st.booleans())
def test_the_number_of_the_cycle_parts_no_rest_from_its_load_and_no_discharge(before, loops, with_charge):
    """``before``: so many rows of the rest count to the cycle of the load; in the load the counter goes up ``loops`` times."""
    rest = len(CYCLE) - ROWS + LOAD_ON
    number = 7 + np.cumsum(np.isin(np.arange(len(CYCLE)), [rest - before, *np.linspace(rest, len(CYCLE), loops).astype(int)]))
    table = CYCLE.assign(Cycle=number)[0 if with_charge else len(CHARGE) :]
    table = pd.concat([table, table.assign(time=table["time"] + 9000.0, Cycle=table["Cycle"] + 100)])
    discharges = read_discharges(table)
    assert [each.meta["cycle"] for each in discharges] == [number[rest], number[rest] + 100]
    for discharge in discharges:
        near(discharge, 3e-3)
        assert discharge.current_A[0] < 0.01


@pytest.mark.parametrize("counter", range(6))
def test_loops_of_pulses_are_one_discharge_wherever_the_counter_goes_up(counter):
    """Nine loops of a pulse of load, one of charge, a discharge and a rest."""
    loop = [(10, 2.0, 1), (40, 0.0, 5), (10, -1.5, 1), (40, 0.0, 5), (360, 2.0, 10), (600, 0.0, 60)]
    steps = [(600, 0.0, 60), *(9 * loop)]
    rows = [(every_s, current_A, k) for k, (length, current_A, every_s) in enumerate(steps) for _ in range(length // every_s)]
    every_s, current_A, step = np.array(rows).T
    charge_C = np.cumsum(every_s * current_A)
    voltage_V = 4.19 - 1.4 * charge_C / 7200.0 - 0.1 * current_A
    columns = {"time": np.cumsum(every_s), "voltage": voltage_V, "current": -current_A, "Cycle": (step + 5 - counter) // 6}
    assert read(pd.DataFrame(columns)).charge_C == pytest.approx(charge_C[-1], rel=0.02)


def parts_in_turn(*parts):
    """Tables one after another, on one clock."""
    begins_s = np.cumsum([0.0, *(np.ptp(part["time"]) + 30.0 for part in parts)])
    return pd.concat(
        [part.assign(time=part["time"] - part["time"].iloc[0] + begin) for part, begin in zip(parts, begins_s, strict=False)],
        ignore_index=True,
    )


@pytest.mark.parametrize("share", [0.03, 0.08, 0.12, 0.17])
@pytest.mark.parametrize("told", ["a rest", "a number", "a state", "all"])
def test_a_short_charge_that_the_file_tells_is_one(share, told):
    """It gives back less than a fifth, and what is drawn then is a discharge of its own, or named as left aside."""
    low = pd.DataFrame({"time": np.arange(0.0, 900.0, 60.0), "voltage": 3.35, "current": 0.0})
    count = int(LOADED.sum() * share)
    charge_A, charge_s = 1.1 * share * RECORD.charge_C / 195.0, np.arange(0.0, 200.0, 5.0)
    charge = pd.DataFrame({"time": charge_s, "voltage": np.linspace(3.6, 4.1, 40), "current": charge_A})
    short = TABLE[LOADED][-count:]
    parts = [CYCLE.assign(Cycle=1), CYCLE.assign(Cycle=2), charge.assign(Cycle=3), short.assign(Cycle=3)]
    parts[2:2] = [low.assign(Cycle=2)] if told in ("a rest", "all") else []
    table = parts_in_turn(*parts)
    table["State"] = np.where(table["current"] > 0.0, "Chg", np.where(table["current"] < -1.0, "DChg", "Rest"))
    table = table.drop(columns={"a number": ["State"], "a state": ["Cycle"], "a rest": ["State", "Cycle"]}.get(told, []))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        discharges = read_discharges(table)
    for whole in discharges[:2]:
        near(whole)
    said = "; ".join(str(each.message) for each in caught)
    if share > 0.1:
        assert len(discharges) == 3 and not said
        assert discharges[2].charge_C == pytest.approx(share * RECORD.charge_C, rel=0.1)
        assert discharges[2].history.charge.highest_V == pytest.approx(4.1)
    else:
        assert len(discharges) == 2 and re.search(r"left aside, as they draw less than 10% .* Ah in rows \d+ to", said)


@pytest.mark.parametrize("downhill_s", [10, 60])
def test_braking_parts_no_discharge_where_the_tester_calls_it_a_charge(downhill_s):
    """Loops of a drive with stops before and after braking, and a state by the sign of the current."""
    loop = [(240, 3.0), (90, 0.0), (60, 3.0), (downhill_s, -1.5), (90, 0.0)]
    steps = [(300, 0.0), *(12 * loop), (300, 0.0)]
    current_A = np.concatenate([np.full(length // 5, current_A) for length, current_A in steps])
    charge_C = 5.0 * np.cumsum(current_A)
    table = pd.DataFrame(
        {
            "time": 5.0 * np.arange(len(current_A)),
            "voltage": 4.19 - 1.2 * charge_C / 12000.0 - 0.05 * current_A,
            "current": -current_A,
            "Cycle": np.repeat(np.arange(len(steps)) // len(loop), [length // 5 for length, _ in steps]),
            "State": np.select([current_A > 0.0, current_A < 0.0], ["D", "C"], "R"),
        }
    )
    assert read(table).charge_C == pytest.approx(charge_C[-1], rel=0.02)


def test_what_is_left_aside_is_named_and_a_mistake_in_some_cycles_loses_no_other():
    cycle = CYCLE.assign(Cycle=1, current=6.0 * CYCLE["current"])
    small = cycle.assign(current=0.005 * cycle["current"], time=cycle["time"] + 9000.0, Cycle=2)
    with pytest.warns(UserWarning, match=r"left aside, as they draw less than 10% of the largest: 1 \(0\.043. Ah in rows"):
        (found,) = read_discharges(pd.concat([cycle, small], ignore_index=True))
    assert found.charge_C == pytest.approx(6.0 * RECORD.charge_C, rel=3e-3)
    wrong = cycle.assign(current=1e3 * cycle["current"], time=cycle["time"] - 9000.0, Cycle=0)
    with pytest.warns(UserWarning, match="left out: .* discharge 0: current_A must lie within -1000 .. 1000 A"):
        (found,) = read_discharges(pd.concat([wrong, cycle], ignore_index=True))
    assert found.charge_C == pytest.approx(6.0 * RECORD.charge_C, rel=3e-3)


@pytest.mark.parametrize("share", [22.0, *sweep(1e-2, 400.0, 1e-1, 3e-3, 1e-4)])
def test_the_charge_of_a_cell_of_any_size_is_known_and_where_that_is_another_its_constants_are_not(share):
    (found,) = calibrate(TABLE.assign(current=share * TABLE["current"]).rename(columns={"current": "current (A)"}))
    assert found.drawn_Ah == pytest.approx(share * RECORD.loaded_part(2.7).charge_C / 3600.0, rel=0.01)
    assert found.capacity_Ah == pytest.approx(found.drawn_Ah) and not found.settled
    assert share == 0.1 or found.reason.startswith(("No cell of this kind has such a q_max", "Cells below 28 mAh are not"))
    at_bound = share in (400.0, 1e-2, 3e-3, 1e-4)
    assert np.isnan([found.q_mobile_C, found.sd_q_mobile_C, found.r_o_ohm, found.sd_r_o_ohm]).all() == at_bound
    assert "nan" not in str(found)


def small_cell(highest_V=4.3, lowest_V=3.0):
    """A half cell of 1.27 mAh, discharged in 34 hours after a rest of two rows."""
    row = np.arange(95)
    voltage_V, current_A = highest_V - (highest_V - lowest_V) * (row / 95) ** 2, np.where(row < 2, 0.0, 1.27e-3 / 34.0)
    return pd.DataFrame({"time (h)": np.linspace(0.0, 34.0, 95), "voltage (V)": voltage_V, "current (A)": -current_A})


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("ends", ["whole", "above the cut-off"])
def test_nothing_is_searched_for_what_is_far_below_the_sizes_of_the_model(ends, monkeypatch):
    def search(*given, **options):
        raise AssertionError("searched")

    monkeypatch.setattr(LeastSquares, "estimate", search)
    monkeypatch.setattr(calibrate_module, "forecast", search)
    (found,) = calibrate(small_cell(lowest_V=2.6 if ends == "whole" else 3.0))
    assert found.drawn_Ah == pytest.approx(1.27e-3, rel=0.05) and found.reason.startswith("Cells below 28 mAh are not")
    assert found.capacity_Ah == pytest.approx(found.drawn_Ah) if ends == "whole" else np.isnan(found.capacity_Ah)
    (record,) = read_discharges(small_cell())
    with pytest.raises(ValueError, match="Cells below 28 mAh are not modelled"):
        running_module.forecast_end(record)


@pytest.mark.parametrize("lowest_V", [0.02, 0.8, 1.5])
def test_a_voltage_below_the_cut_off_is_refused_with_one_that_is_reached(lowest_V):
    table = small_cell(lowest_V + 0.9, lowest_V)
    with pytest.raises(
        ValueError, match=r"all of the voltage under load lies below the cut-off of 2\.7 V\. .*--cut-off"
    ) as caught:
        calibrate(table)
    cut_off_V = float(re.search(r"--cut-off ([\d.]+)\)", str(caught.value))[1])
    assert cut_off_V == pytest.approx(table["voltage (V)"].min(), rel=1e-3)
    (found,) = calibrate(table, cut_off_V=cut_off_V)
    assert found.measured_eod_time_s > 0.0 and found.drawn_Ah == pytest.approx(1.27e-3, rel=0.05)


@pytest.mark.parametrize("gain", [0.5, 0.97, 1.03, 2.0])
def test_another_count_of_the_tester_is_a_doubt_of_its_size(gain):
    discharge = read(TABLE.assign(**{"Capacity(mAh)": 1e3 * gain * COUNTED_AH}), "the tester counted")
    assert discharge.history.sd_counter_C == pytest.approx(abs(gain - 1.0) * 3600.0 * COUNTED_AH[-1], rel=0.1)
    found = calibrate(discharge)
    assert found.sd_q_mobile_C > 0.95 * discharge.history.sd_counter_C and not found.settled_q_mobile
    assert "the tester counted another charge" in found.reason


def test_a_count_that_starts_anew_while_the_load_is_switched_tells_nothing_of_that():
    """Pulses of 10 s, each in one row alone, that a counter of single steps shows at 0."""
    time_s = np.arange(0.0, 6000.0, 10.0)
    pulse, load = time_s % 600.0 == 300.0, time_s % 600.0 < 200.0
    table = pd.DataFrame({"Time (s)": time_s, "Current (A)": -np.select([pulse, load], [8.0, 2.0], 0.0)})
    table["Voltage (V)"] = 4.1 - 2e-4 * time_s + 0.1 * table["Current (A)"]
    found = read(table.assign(**{"Capacity (mAh)": np.where(load, 2.0 * (time_s % 600.0) / 3.6, 0.0)}))
    assert found.history.sd_counter_C < 0.01 * found.charge_C < found.sd_charge_C and not found.history.is_counted


def test_workbooks_are_read_by_the_sheet_of_the_record_and_those_that_continue_it(tmp_path):
    pytest.importorskip("openpyxl", reason="the extra excel is not installed")
    table = TABLE.set_axis(["Test_Time\n(s)", " Voltage (V)", "Current\r\n(A) "], axis="columns")
    with pd.ExcelWriter(tmp_path / "cell.xlsx") as writer:
        pd.DataFrame({"Cell": ["B0006"], "Schedule": ["cc"]}).to_excel(writer, sheet_name="Info", index=False)
        table[:150].to_excel(writer, sheet_name="Channel_1", index=False, startrow=3)
        table[150:].to_excel(writer, sheet_name="Channel_2", index=False, startrow=3)
        table[:1].assign(more=1).to_excel(writer, sheet_name="Statistics", index=False)
    near(read(tmp_path / "cell.xlsx"))
    (tmp_path / "text.xls").write_text(TEXT.replace(",", "\t"))
    near(read(tmp_path / "text.xls"))  # as some testers call their text


def test_of_a_name_that_comes_twice_in_parquet_neither_is_taken(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    from pyarrow import parquet

    columns = [pyarrow.array(TABLE[name]) for name in (*TABLE, "voltage")]
    parquet.write_table(pyarrow.table(columns, names=[*TABLE, "voltage"]), tmp_path / "cell.parquet")
    with pytest.raises(ValueError, match="no column for the voltage"):
        read_discharges(tmp_path / "cell.parquet")


def test_a_workbook_that_is_damaged_or_needs_an_extra_says_so(tmp_path, monkeypatch):
    (tmp_path / "cell.xlsx").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(ValueError, match="damaged, or no Excel file"):
        read_discharges(tmp_path / "cell.xlsx")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(ImportError, match=r"Excel files need .*battery_env\[excel\]"):
        read_discharges(tmp_path / "cell.xlsx")


def test_a_folder_reads_numbered_text_and_names_what_it_left_out(tmp_path, capsys):
    lab, results = tmp_path / "lab", tmp_path / "lab" / "results"
    lab.mkdir()
    (lab / "cell.001").write_text(TEXT.replace(",", "\t"))
    (lab / "old.csv.gz").write_bytes(gzip.compress(TEXT.encode()))
    for name in ("a.res", "b.h5", "photo.png"):
        (lab / name).write_bytes(b"?")
    assert command([str(lab), "--out", str(results)]) == 0
    assert "a.res, b.h5, photo.png left out, by their names no records" in capsys.readouterr().err
    assert command([str(lab)]) == 0  # results are no records, and need not be named
    assert "results" not in capsys.readouterr().err
    assert [source.stem for source in find_sources([str(lab / "cell.001")])] == ["cell"]


def test_a_refused_file_shows_the_command_that_reads_it(tmp_path):
    path = tmp_path / "cell.csv"
    table = pd.DataFrame({"time_s": RECORD.time_s, "batt_mV": 1e3 * RECORD.voltage_V, "load_mA": 1e3 * RECORD.current_A})
    table.to_csv(path, index=False)
    said = "row 1 0.0, 418.*row 2 9.*time 'time_s' in s.*places: "
    said += rf"battery-calibrate {path} --columns voltage=batt_mV,current=load_mA"
    stated = re.search(r"--columns (\S+)", refused(path, said))[1]
    assert command([str(path), "--columns", stated]) == 0
    assert command([str(path), "--columns", stated, "--ignore", "batt_mV"]) == 2


@pytest.mark.parametrize(
    "title", ["", "Old cell\nload of 350 mA at 5 V\n\n", "@Model:X; Hardware:V2.00\n\n", "0,,,Version=1.30\n"]
)
@pytest.mark.parametrize(("delimiter", "end"), sweep((",", "\r"), (";", "\n"), ("\t", "\r\n"), ("  ", "\n"), ("|", "\n")))
def test_a_log_without_names_shows_how_places_are_stated_and_is_read_by_them(title, delimiter, end, tmp_path, capsys):
    path = tmp_path / "log of a charger.txt"
    hundredths_A, mV = (-100.0 * TABLE["current"]).round(2), 1e3 * TABLE["voltage"]
    rows = [
        delimiter.join(map(str, row)) for row in zip(mV, "$" + mV.index.astype(str), hundredths_A, RECORD.time_s, strict=True)
    ]
    path.write_text(title.replace("\n", end) + end.join(rows), newline="")
    assert command([str(path)]) == 2
    said = capsys.readouterr().err
    assert "--columns time=1,voltage=2,current=3 (and --units current=0.01A)" in said and "row 1       4182.85" in said
    *_, shown = said.splitlines()
    assert shown == f"  battery-calibrate '{path}' --columns time=1,voltage=2,current=3"
    stated = {"columns": {"time": "4", "voltage": "1", "current": "3"}, "units": {"voltage": "mV", "current": "0.01A"}}
    near(read(path, discharge_is_negative=False, **stated))
    assert command(["columns", str(path), "--out", str(tmp_path / "my.toml")]) == 3


@pytest.mark.parametrize("content", ["text", "workbook"])
def test_a_place_is_stated_where_a_name_does_not_tell_or_comes_twice(content, tmp_path):
    table, path = TABLE.set_axis(["a", "b", "b"], axis="columns"), tmp_path / f"cell.{'csv' if content == 'text' else 'xlsx'}"
    table.to_csv(path, index=False) if content == "text" else table.to_excel(path, index=False)
    near(read(path, columns={"time": "a", "voltage": "2", "current": "3"}))
    with pytest.raises(ValueError, match="there is no column '4' for the current among a, b, b"):
        read_discharges(path, columns={"time": "a", "voltage": "2", "current": "4"})


def test_a_tester_is_told_by_its_names_or_added_by_a_file(tmp_path, monkeypatch, terminal):
    monkeypatch.chdir(tmp_path)
    table = pd.DataFrame({"Clock": RECORD.time_s / 60.0, "Pole(V)": RECORD.voltage_V, "Load": -1e3 * RECORD.current_A})
    table.to_csv("cell.csv", index=False)
    shown = terminal.shows("columns", "cell.csv", status=3)
    assert "header      Clock, Pole(V), Load" in shown and "row 2       0.157" in shown and "time        not found" in shown
    text = Path("my_tester.toml").read_text()
    for name, value in (("time", "Clock"), ("voltage", "Pole"), ("current", "Load")):
        text = text.replace(f'# {name} = ""', f'{name} = "{value}"', 1)
    head, units = text.split("[units]")
    units = units.replace('# time = ""', 'time = "min"').replace('# current = ""', 'current = "mA"')
    Path("my_tester.toml").write_text(f"{head}[units]{units}")
    near(read("cell.csv", tester="my_tester.toml"))
    assert command(["cell.csv", "--tester", "my_tester.toml"]) == 0
    assert calibrate("cell.csv", tester="my_tester.toml")[0].settled
    assert "my_tester.toml would be replaced" in terminal.refuses("columns", "cell.csv")
    faults = (("a = 1", "a tester has name"), ("[columns", "in TOML"), ("[columns]\nx='y'", "by quantity"))
    for content, said in faults:
        Path("bad.toml").write_text(content)
        with pytest.raises(ValueError, match=f"bad.toml.*{said}"):
            read_discharges("cell.csv", tester="bad.toml")
    with pytest.raises(FileNotFoundError, match="nor a tester of this name: known are Arbin, Maccor"):
        read_discharges("cell.csv", tester="Unheard")


def test_every_row_of_the_table_reads_its_own_names():
    for tester in TESTERS[:-1]:
        known = merge(tester, TESTERS[-1])
        names = {quantity: known.columns[quantity][0] for quantity in ("time", "voltage", "current")}
        marks = {name: 20.0 for name in tester.marks[:1] if name not in names.values()}
        table = pd.DataFrame({names[each]: TABLE[each] for each in names} | marks)
        for quantity, unit in (("voltage", "mV"), ("current", "mA")):
            table[names[quantity]] *= 1e3 if unit in names[quantity] else 1.0
        assert recognise(list(table), FileFormat(), []).tester.name == tester.name
        near(read(table))


def test_a_log_without_a_current_takes_a_stated_load(tmp_path, capsys):
    path, load = tmp_path / "log.csv", tmp_path / "load.csv"
    table = pd.DataFrame({"time_s": RECORD.time_s, "voltage_V": RECORD.voltage_V})
    table[LOADED].to_csv(path, index=False)
    (found,) = read_recordings(path, FileFormat(load=([0.0], [2.01], "current")))
    assert found.discharge().charge_C == pytest.approx(2.01 * np.ptp(RECORD.time_s[LOADED]))
    table.to_csv(path, index=False)
    end_s = RECORD.time_s[np.flatnonzero(LOADED)[-1]]
    load.write_text(f"time_s,current_A\n0,0\n14.5,2.01\n{end_s + 1.0},0\n")
    assert command([str(path), "--load", str(load)]) == 0
    assert "1.4" in capsys.readouterr().out


def test_a_life_is_in_the_order_of_its_dates_or_else_of_its_names(tmp_path):
    for name, day in (("cell_10.csv", 1), ("cell_2.csv", 2)):
        TABLE.assign(Date=DATES + pd.Timedelta(days=day)).to_csv(tmp_path / name, index=False)
    running = Source("B0005", 1, "B0005", "B0005", "B0005:1")
    found = running_module.read_life([str(tmp_path)], running, FileFormat())
    assert [Path(each.meta["source"]).name for each in found] == ["cell_10.csv", "cell_2.csv"]
    with pytest.warns(UserWarning, match=r"in the order of names, as not all records have dates: .*cell_2.csv, .*cell_10.csv"):
        found = running_module.read_life([str(tmp_path)], running, FileFormat(ignore=["Date"]))
    assert [Path(each.meta["source"]).name for each in found] == ["cell_2.csv", "cell_10.csv"]
    # and what began after the one in progress is no part of it, whatever its name
    running = Source(str(tmp_path / "cell_2.csv"), None, "cell_2", "", "cell_2.csv")
    assert [Path(each.meta["source"]).name for each in running_module.read_life([str(tmp_path)], running, FileFormat())] == [
        "cell_10.csv"
    ]
    with pytest.raises(ValueError, match="no discharge before"):
        running_module.read_life([str(tmp_path)], running, FileFormat(ignore=["Date"]))


def hostile(kind):
    """A small file that would become large."""
    content = io.BytesIO()
    rows = b"time_s,voltage_V,current_A\n" + (3_100_000 if kind == "csv" else 40_000_000) * b"1,4,2\n"
    if kind == "csv.gz":
        return gzip.compress(rows, 9)
    if kind == "csv":
        return rows
    if kind == "csv.zip":
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("cell.csv", rows)
    elif kind == "mat":
        savemat(content, {"B0005": np.zeros(1 << 23)}, do_compression=True)
    elif kind == "parquet":
        frame = pd.DataFrame({"time_s": np.zeros(4_000_000), "voltage_V": 4.0, "current_A": 2.0})
        frame.to_parquet(content, compression="zstd")
    else:
        openpyxl = pytest.importorskip("openpyxl", reason="the extra excel is not installed")
        book = openpyxl.Workbook()
        book.active.append(["time_s", "voltage_V", "current_A"])
        book.active["XFD1048576"] = 1.0
        book.save(content)
    return content.getvalue()


@pytest.mark.parametrize("kind", sweep("csv.gz", "csv", "csv.zip", "xlsx", "parquet", "mat"))
def test_nothing_that_is_small_becomes_large(kind, tmp_path):
    path = tmp_path / f"cell.{kind}"
    path.write_bytes(hostile(kind))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"cell.*are more than the \d+ that are read"):
            read_discharges(path)
        assert tracemalloc.get_traced_memory()[1] < 6e8
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("header", [f"|{' ' * 4000}|", "[" * 3000, f"time{' ' * 5000}(s)", "a/" * 4000, "x," * 5000])
def test_a_header_of_any_kind_is_looked_at_in_no_time(header, tmp_path):
    (tmp_path / "cell.csv").write_text(f"{header}\n" * 3 + "1,2,3\n" * 50)
    start = time.process_time()
    with pytest.raises(ValueError, match=r"no column for|names of the columns|columns are more|fields below"):
        read_discharges(tmp_path / "cell.csv")
    assert time.process_time() - start < 5.0
