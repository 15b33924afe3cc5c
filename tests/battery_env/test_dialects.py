"""Compositions of what testers do to a record: whatever is put together, its discharges are those that were written."""

import csv
import gzip
import io
import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from battery_env import read_discharges

DRAWN_C = 4800.0
START = pd.Timestamp("2026-02-27 22:50:00")
#: Names of the time, dates, the time in a step, voltage, current, temperature, step, what is done and the charge drawn.
NAMES = [
    "Test Time,Date Time,Step Time,Voltage,Current,Temperature,Step,State,Discharge_Capacity",
    "TestTime,DPT_Time,StepTime,Cell_Potential,I,Aux_Temperature_1,Step_Index,what is done,Capacity",
    "Zeit,Datum/Uhrzeit,Schrittzeit,U,Strom,T,Schritt,Betriebsart,Entladekapazität",
    "总时间,绝对时间,步骤时间,电压,电流,温度,工步号,工步类型,放电容量",
]
STYLES = ["{}({})", "{} [{}]", "{}/{}", "{} / {}", "{}_{}", "{} in {}", "{}, {}", "{} {{{}}}", "{}: {}", "{} <{}>", "below"]
WORDS = ["Charge,Rest,Discharge", "Laden,Pause,Entladen", "C,R,D", "CC Chg,Rest,CC DChg", "恒流充电,搁置,恒流放电"]
WORDS += ["CHA,PAU,DCH", "1C charge,wait,1C discharge"]
DATES = ["%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p", "%Y-%m-%dT%H:%M:%SZ"]
#: The first of each is the plainest, to which a failure is brought back.
FEATURES = {
    "cycles": [1, 2],
    "before": ["rest", "charge", "charge and rest", ""],
    "load": ["whole", "pulses"],
    "edge": ["start", "both", "mixed"],
    "names": NAMES,
    "style": STYLES,
    "units": [("s", "V", "A"), ("min", "mV", "mA"), ("h", "V", "mA"), ("ms", "mV", "A")],
    "clock": ["time", "h:min:s", "day", "step", *DATES],
    "beside": [set(), {"dates"}, {"step time", "capacity"}, {"temperature", "capacity", "set voltage"}],
    "sign": [-1, 1, 0],
    "words": WORDS,
    "order": range(5),
    "separator": [",.", ";,", ";.", "\t.", "\t,", "quoted", " ."],
    "above": ["", "Cell: 7", "Voltage limit: 4.2 V\n\nComment: time, voltage and current of cell 7"],
    "below": ["", "End of test", "\nEnded; normally"],
    "encoding": ["utf-8", "utf-8-sig", "utf-16", "latin-1"],
    "line": ["\n", "\r\n", "\r"],
    "repeated": [0, 1, 20],
} | dict.fromkeys(["rests", "again", "titles", "blank", "cut", "trailing", "index", "packed"], (False, True))


def rows_of(f):
    """Return the rows, current of a discharge positive, and the charge that each discharge of the file draws."""
    rest, charge, pulse = ("rest", 600, 0.0), ("charge", 3600, -DRAWN_C / 3600), ("load", 400, 2.0)
    parts = {"rest": [rest], "charge": [charge], "charge and rest": [charge, rest], "": []}
    load = [("load", 2400, 2.0)] if f["load"] == "whole" else [*([pulse, rest] * 5), pulse]
    steps = [*parts[f["before"]], *load, *([rest] * f["rests"]), *([charge, rest, *load] * (f["cycles"] - 1))]
    rows, start_s, passed_C = [], 0.0, 0.0
    for n, (kind, length_s, current_A) in enumerate(steps, start=1):
        for step_s in np.arange(0.0, length_s + (f["edge"] == "both"), 30.0 if kind == "charge" else 5.0):
            shown_A = rows[-1][4] if rows and f["edge"] == "mixed" and not step_s else current_A
            voltage_V = 4.1 - 1.2 * (passed_C + current_A * step_s) / DRAWN_C - 0.1 * current_A
            rows.append((kind, n, start_s + step_s, step_s, shown_A, voltage_V, max(current_A, 0.0) * step_s / 3600))
        start_s, passed_C = start_s + length_s, passed_C + length_s * current_A
    return pd.DataFrame(rows, columns="kind step time step_time current voltage capacity".split())


def columns_of(f, table, decimal):
    """Return the unit and the text of each column, by its name."""
    time, dates, step_time, voltage, current, temperature, step, state, capacity = f["names"].split(",")
    unit = dict(zip(("time", "voltage", "current"), f["units"], strict=True)) | {"temperature": "°C", "capacity": "Ah"}
    in_unit = {"min": 1 / 60, "h": 1 / 3600, "ms": 1e3, "mV": 1e3, "mA": 1e3}
    columns = {}

    def put(name, quantity, values):
        factor = in_unit.get(unit[quantity], 1.0)
        text = [f"{factor * value:.8f}".replace(".", decimal) for value in values]
        columns[name if f["style"] == "below" else f["style"].format(name, unit[quantity])] = (unit[quantity], text)

    date = START + pd.to_timedelta(table["time"], unit="s")
    if f["clock"] in ("time", "step"):
        put(time if f["clock"] == "time" else step_time, "time", table["time" if f["clock"] == "time" else "step_time"])
    elif f["clock"] == "h:min:s":
        columns[time] = ("", [f"{int(s // 3600)}:{int(s // 60 % 60):02d}:{s % 60:06.3f}" for s in table["time"]])
    else:
        columns[dates] = ("", date.dt.strftime("%H:%M:%S" if f["clock"] == "day" else f["clock"]).tolist())
    if "dates" in f["beside"] and f["clock"] in ("time", "step", "h:min:s"):
        columns[dates] = ("", date.dt.strftime(DATES[0]).tolist())
    if "step time" in f["beside"] and f["clock"] != "step":
        put(step_time, "time", table["step_time"])
    put(voltage, "voltage", table["voltage"])
    put(current, "current", table["current"].abs() if not f["sign"] else f["sign"] * table["current"])
    if "temperature" in f["beside"]:
        put(temperature, "temperature", 24.0 + 0.0 * table["time"])
        put("Set Voltage", "voltage", 4.2 + 0.0 * table["time"])
    if "capacity" in f["beside"]:
        put(capacity, "capacity", table["capacity"])
    if f["clock"] == "step" or not f["sign"]:
        words = dict(zip(("charge", "rest", "load"), f["words"].split(","), strict=True))
        columns |= {step: ("", table["step"].astype(str).tolist()), state: ("", table["kind"].map(words).tolist())}
    return columns


def write(f, folder):
    """Write a file as some tester might."""
    table, (separator, decimal) = rows_of(f), (",", ",") if f["separator"] == "quoted" else f["separator"]
    if f["repeated"]:
        table = pd.concat([table[:300], table[300 - f["repeated"] :]])
    columns = columns_of(f, table, decimal)
    names = [*columns][f["order"] :] + [*columns][: f["order"]]
    fields = [names, *([[columns[name][0] for name in names]] if f["style"] == "below" else [])]
    head = len(fields)
    fields += zip(*(columns[name][1] for name in names), strict=True)
    if f["again"]:
        fields[len(fields) // 2 : len(fields) // 2] = fields[:head]
    if f["index"]:
        fields = [["" if n < head else str(n), *each] for n, each in enumerate(fields)]
    if separator == " ":
        fields = [[field.replace(" ", "_") or "-" for field in each] for each in fields]
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="\n").writerows(fields)
    lines = text.getvalue().splitlines()
    if f["trailing"] and separator != " ":
        lines[head:] = [line + separator for line in lines[head:]]
    if f["cut"]:
        lines[-1] = lines[-1][: lines[-1].index(separator) + 1]
    elif f["below"]:
        lines.append(f["below"])
    if f["titles"]:
        for place in (head + 40, head + 20):
            lines[place:place] = ["Next step", ""]
    if f["blank"]:
        lines[9:9] = [""]
    content = f["line"].join([*f["above"].split("\n"), *lines]).encode(f["encoding"], errors="replace")
    path = folder / ("cell.csv.gz" if f["packed"] else "cell.csv")
    path.write_bytes(gzip.compress(content, 1) if f["packed"] else content)
    return path


@pytest.mark.attacks
@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.fixed_dictionaries({name: st.sampled_from(values) for name, values in FEATURES.items()}))
def test_whatever_is_put_together_the_discharges_are_those_that_were_written(tmp_path, f):
    if f["encoding"] == "latin-1":
        f |= {"names": NAMES[2], "words": WORDS[1]}
    if f["separator"] == "quoted":
        f |= {"cut": False}
    if f["separator"] == " .":
        f |= {"clock": "time", "beside": set(), "index": False, "cut": False}
    try:
        found = read_discharges(write(f, tmp_path))
    except ValueError as refused:
        # rows that come again and clocks of steps go back; row numbers and words may have no known name
        assert f["repeated"] or f["clock"] in ("day", "step") or f["index"] or not f["sign"]
        said = r"the clock goes back: row \d+|rows have|no column for the time|has no sign: from row|must hold numbers"
        assert re.search(said, str(refused)), refused
        return
    assert len(found) == f["cycles"]
    sd_charge_C = 10.0 * (1 + f["cut"] + (f["edge"] == "mixed"))  # a row that is missing, or of two steps
    for discharge in found:
        assert abs(discharge.charge_C - DRAWN_C) <= 3e-3 * DRAWN_C + sd_charge_C + 2.5 * discharge.sd_charge_C
        assert discharge.temperature_C is None or (discharge.temperature_C == 24.0).all()
