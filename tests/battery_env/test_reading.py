"""Each mend of a table, and how far it goes: a discharge that is written in another way is the same, or it is refused."""

import csv
import gzip
import importlib.util
import sys
import time
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from battery_env import Settings, calibrate, load_nasa_discharges, read_discharges
from battery_env.lab.batch import calibrate_all
from battery_env.lab.command_line import calibrate as command
from battery_env.lab.readers.columns import FileFormat, recognise
from battery_env.lab.readers.discharges import read_recordings
from battery_env.lab.readers.testers import TESTERS
from battery_env.lab.sources import find_sources

RECORD = load_nasa_discharges("B0006")[99]
TABLE = pd.DataFrame({"time": RECORD.time_s, "voltage": RECORD.voltage_V, "current": -RECORD.current_A})
LOADED = (TABLE["current"] < -1.0).to_numpy()
LOAD_ON = int(np.argmax(LOADED))
#: A charge and a rest, as they come before the discharge.
CHARGE = pd.DataFrame({"time": np.arange(0.0, 3600.0, 60.0), "voltage": np.linspace(3.6, 4.2, 60), "current": 1.5})
REST = pd.DataFrame({"time": 3600.0 + np.arange(0.0, 600.0, 60.0), "voltage": 4.19, "current": 0.0})
CYCLE = pd.concat([CHARGE, REST, TABLE.assign(time=4200.0 + TABLE["time"])], ignore_index=True)


def read(table, said="", **options):
    """Return the one discharge of a table, and check what is said of it; nothing by default."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (discharge,) = read_discharges(table, **options)
    messages = "; ".join(str(each.message) for each in caught)
    assert (said in messages) if said else not messages, messages
    return discharge


def same(discharge, rtol=1e-9, atol=1e-6):
    """Check that it is the record."""
    np.testing.assert_allclose(discharge.time_s, RECORD.time_s, rtol, atol)
    np.testing.assert_allclose(discharge.voltage_V, RECORD.voltage_V, rtol, atol)
    np.testing.assert_allclose(discharge.current_A, RECORD.current_A, rtol, atol)


def near(discharge, share=2e-3):
    assert discharge.charge_C == pytest.approx(RECORD.charge_C, rel=share)
    assert (np.diff(discharge.time_s) > 0.0).all()


@pytest.mark.parametrize("unit", ["degC", "°C", "\N{DEGREE CELSIUS}", "\ufffdC", "?C", "Â°C", "C"])
@pytest.mark.parametrize("names", [("t[s]", "U[V]", "I[A]", "T[{}]"), ("Zeit[s]", "U[V]", "I[A]", "T[{}]")])
def test_a_unit_of_another_quantity_rules_a_column_out(unit, names):
    table = TABLE.assign(temperature=25.0)
    table.columns = [name.format(unit) for name in names]
    assert (read(table).temperature_C == 25.0).all()
    with pytest.raises(ValueError, match="no column for the time"):
        read_discharges(table.iloc[:, 1:])


@pytest.mark.parametrize(
    ("values", "name", "said"),
    [
        (25.0, "T1(?)", "the unit of 'T1(?)' is not known (--units temperature=UNIT). It is left out"),
        (0.0, "Temperature (C)", "holds 0 in all rows, as without a sensor. It is left out"),
        (-2501.7, "Temperature (C)", "must hold temperatures, got -2501.7 degC. It is left out"),
        ("--", "Temperature (C)", "got '--' in row 1. It is left out"),
        (297.0, "Temperature", "in kelvin, --units temperature=K says so. It is left out"),
        (297.0, "Temperature (C)", "must hold temperatures, got 297 degC. It is left out"),
        (6.283, "Cycle", "whole numbers of cycles. It is left out"),
        (np.nan, "Cycle", "whole numbers of cycles. It is left out"),
        ("first", "Cycle", "got 'first' in row 1. It is left out"),
    ],
)
def test_a_column_that_nobody_needs_never_refuses_a_record(values, name, said):
    table = TABLE.assign(**{name: values})
    discharge = read(table, said)
    same(discharge)
    assert discharge.temperature_C is None and "cycle" not in discharge.meta
    same(read(table, ignore=[name]))  # and nothing is said of it


def test_a_column_can_be_ignored_on_the_command_line(tmp_path, capsys):
    TABLE.assign(Voltage=0.5 * TABLE["voltage"]).to_csv(tmp_path / "cell.csv", index=False)
    assert command([str(tmp_path / "cell.csv")]) == 2
    assert "both 'voltage' and 'Voltage' may be the voltage" in capsys.readouterr().err
    assert command([str(tmp_path / "cell.csv"), "--ignore", "Voltage", "--ignore", "other"]) == 0
    assert calibrate(tmp_path / "cell.csv", ignore=["Voltage"])[0].settled


def test_of_three_electrodes_the_cell_is_taken():
    table = TABLE.rename(columns={"time": "time/s", "voltage": "Ewe-Ece/V", "current": "I/A"})
    table["Ece/V"] = np.linspace(0.05, 0.2, len(table))
    table["Ewe/V"] = table["Ewe-Ece/V"] + table["Ece/V"]
    same(read(table))
    same(read(table.drop(columns="Ewe-Ece/V"), "the voltage is Ewe/V less Ece/V"))
    alone = read(table[["time/s", "Ewe/V", "I/A"]])
    np.testing.assert_array_equal(alone.voltage_V, table["Ewe/V"])


@pytest.mark.parametrize(("unit", "factor"), [("W", 1.0), ("mW", 1e3)])
def test_a_power_or_a_charge_a_row_tells_the_current(unit, factor):
    table = TABLE.assign(**{f"Power ({unit})": factor * TABLE["current"] * TABLE["voltage"]}).drop(columns="current")
    same(read(table, f"the current is Power ({unit}) over voltage"))
    steps_C = np.diff(TABLE["time"], prepend=TABLE["time"].iloc[0]) * TABLE["current"]
    table = TABLE.assign(**{"dq/mA.h": steps_C / 3.6}).drop(columns="current")
    found = read(table, "the current is the charge dq/mA.h over the time since the row before")
    np.testing.assert_allclose(found.current_A[1:], RECORD.current_A[1:])
    assert found.history.uncounted_C == 0.0
    # which is no matter of the voltage
    same(read(table.assign(Power=0.0).rename(columns={"Power": "P/W"}), "the current is the charge"), atol=2.0)
    # nobody needs them beside a current
    same(read(TABLE.assign(Power="?", **{"dq/mA.h": "?"})))


DAYS = 45000.3 + RECORD.time_s / 86400.0
DATES = [f"{date:%d.%m.%Y %H:%M:%S}" for date in pd.Timestamp("2026-02-27 23:50") + pd.to_timedelta(RECORD.time_s, unit="s")]


def test_dates_in_digits_are_read_as_dates():
    dates = pd.Timestamp("2026-02-27 23:50") + pd.to_timedelta(np.floor(RECORD.time_s), unit="s")
    for digits in (dates.strftime("%Y%m%d%H%M%S").astype(np.int64), dates.strftime("%Y%m%d%H%M%S").astype(float)):
        near(read(TABLE.assign(time=digits).rename(columns={"time": "Timestamp"})))


@pytest.mark.parametrize(("unit", "in_a_second"), [("minutes", 1 / 60), ("hours", 1 / 3600), ("milliseconds", 1e3), ("", 1.0)])
@pytest.mark.parametrize(
    "beside", [{"DPT Time": DATES}, {"Date_Time(s)": 5.0 + RECORD.time_s}, {"Zeit": RECORD.time_s / 86400.0}]
)
def test_a_second_clock_tells_what_one_without_a_unit_counts(unit, in_a_second, beside):
    table = TABLE.assign(time=in_a_second * RECORD.time_s, **beside).rename(columns={"time": "TestTime"})
    table["Step Time"] = table["TestTime"]
    same(read(table, f"'TestTime' counts {unit}, as '{next(iter(beside))}' tells" if unit else ""))
    # a clock that has a unit is believed
    same(read(TABLE.rename(columns={"time": "Test Time / s"}).assign(**beside)))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, len(TABLE) - 2), st.sampled_from([-5e-4, -1e-4, 1e-4, 5e-4]), st.integers(1, 3))
def test_a_row_that_comes_again_with_little_else_is_left_out(row, more, times):
    again = TABLE.iloc[np.repeat(row, times)] + np.outer(np.arange(1, times + 1), [0.0, more, more])
    table = pd.concat([TABLE[: row + 1], again, TABLE[row + 1 :]], ignore_index=True)
    same(read(table, "left out with the time of the row before"))


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("row", [100, 200])
def test_at_a_switch_the_order_of_the_rows_tells(share, row):
    current = np.where(np.arange(len(TABLE)) >= row, share, 1.0) * TABLE["current"]
    table = TABLE.assign(current=current)
    again = table.iloc[[row - 1]].assign(current=current.iloc[row], voltage=TABLE["voltage"].iloc[row - 1] + 0.1)
    table = pd.concat([table[:row], again, table[row:]], ignore_index=True)
    found = read(table, f"row {row + 1} has the time of the row before, and is the later one")
    expected_C = -np.trapezoid(current[:row], RECORD.time_s[:row]) - np.trapezoid(current[row:], RECORD.time_s[row:])
    expected_C -= current.iloc[row] * (RECORD.time_s[row] - RECORD.time_s[row - 1])
    assert found.charge_C == pytest.approx(expected_C, rel=4e-3)


def test_a_fault_of_the_voltage_does_not_turn_the_sign():
    fault = TABLE[99:100].assign(time=RECORD.time_s[99] + 1.0, voltage=0.003, current=0.0)
    for sign in (1, -1):
        table = pd.concat([TABLE[:100], fault, TABLE[100:]])
        assert read(table.assign(current=sign * table["current"])).charge_C > 5000.0


@pytest.mark.parametrize("around", [(["[Summary]", "Cell: 7", "[Data]"], []), (["99,TABLE"], ["s,V vs. Ref.,A"])])
def test_what_is_said_around_a_header_that_comes_again_is_left_out_with_it(around, tmp_path):
    header, *lines = TABLE.rename(columns={"time": "T", "voltage": "Vf", "current": "Im"}).to_csv(index=False).splitlines()
    above = [f"[Save data when time > {n} seconds]" for n in range(700)]  # as in the protocol of a test
    (tmp_path / "cell.dta").write_text(
        "\n".join([*above, header, *around[1], *lines[:100], *around[0], header, *around[1], *lines[100:]])
    )
    same(read(tmp_path / "cell.dta", "left out, as"))
    assert [source.stem for source in find_sources([str(tmp_path)])] == ["cell"]


@pytest.mark.parametrize(
    "words", ["Step 3;Discharge;2 A", "# next step", "Min,2.699,2.0", "Total;1.80", "Cell;12\nDate;13.03.2023", "Alarm: 3"]
)
@pytest.mark.parametrize("places", [[3], [-1], [3, 120, 200, -1]])
@pytest.mark.filterwarnings("ignore:the last line")
def test_rows_whose_time_is_words_are_none_if_they_are_few(words, places, tmp_path):
    lines = TABLE.assign(day=DAYS).rename(columns={"day": "Zeit"}).to_csv(index=False).splitlines()
    for place in sorted(places, reverse=True):
        lines[place % len(lines) + 1 : place % len(lines) + 1] = words.replace(";", ",").split("\n")
    (tmp_path / "cell.csv").write_text("\n".join(lines))
    same(read(tmp_path / "cell.csv", "left out, as "))
    lines[1::3] = [f"at {line}" for line in lines[1::3]]
    (tmp_path / "cell.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"the column 'time' must hold numbers, got 'at 0\.0' in row 1"):
        read_discharges(tmp_path / "cell.csv")


@pytest.mark.parametrize("ends", [(1, 0), (0, 1), (3, 2)])
def test_rows_without_a_cell_at_the_ends_are_named(ends):
    def dead(count):
        return pd.DataFrame({"time": np.zeros(count), "voltage": 0.003, "current": 0.0})

    table = pd.concat([dead(ends[0]), TABLE, dead(ends[1])], ignore_index=True)
    table["time"] = np.concatenate([np.arange(-ends[0], 0), RECORD.time_s, RECORD.time_s[-1] + 1 + np.arange(ends[1])])
    for sign in (1, -1):
        same(read(table.assign(current=sign * table["current"]), "is left out: 0.003 V without a current is no cell"))


@pytest.mark.parametrize(
    ("missing", "rows"), [("voltage", [40, 90, 91, 130]), ("voltage", [LOAD_ON]), ("current", [100, 101])]
)
def test_a_few_values_that_are_missing_cost_what_they_are_worth(missing, rows):
    table = TABLE.copy()
    table.loc[rows, missing] = np.nan
    discharge = read(table, f"left out, as the {missing} is missing: row {rows[0] + 1}")
    near(discharge)
    lost_C = 2.0 * 0.5 * (RECORD.time_s[102] - RECORD.time_s[99] + 9.4) if missing == "current" else 0.0
    assert discharge.history.uncounted_C == pytest.approx(lost_C / 3.0**0.5, rel=0.1, abs=0.5)
    table.loc[np.arange(90, 130), missing] = np.nan
    with pytest.raises(ValueError, match=f"the {missing} must be finite, got nan in row "):
        read_discharges(table)


def test_a_row_a_step_is_no_record():
    step = pd.DataFrame({"time": [3600.0, 4200.0, 6800.0, 7400.0], "voltage": [4.2, 4.19, 2.7, 3.2]})
    step["current"] = [1.5, 0.0, -2.0, 0.0]
    table = pd.concat([step.assign(time=step["time"] + 8000.0 * n, Cycle=n) for n in range(3)])
    with pytest.raises(ValueError, match=r"rows are no discharge\. If each is the end of a step, export all"):
        read_discharges(table)


@pytest.mark.parametrize("gap_s", [0.0, 100.0])
@pytest.mark.parametrize(("share", "off_s"), [(0.05, 0.0), (0.5, 0.0), (0.9, 0.0), (1.0, 0.6e-3)])
@pytest.mark.parametrize("with_step", [True, False])
def test_the_time_in_a_step_tells_when_the_load_was_switched_on(gap_s, share, off_s, with_step):
    before_s = share * float(np.diff(RECORD.time_s)[LOAD_ON - 1])
    after = RECORD.time_s - RECORD.time_s[LOAD_ON]
    table = TABLE.assign(time=RECORD.time_s + np.where(after >= 0.0, gap_s, 0.0))
    table["Step Time (s)"] = np.where(after >= 0.0, after + before_s + off_s, RECORD.time_s)
    if with_step:
        table["Step"] = np.cumsum(np.arange(len(table)) == LOAD_ON)
    found = read(table, f"the load came on {before_s + off_s:g} s before row 3, as the time in its step says" if gap_s else "")
    on_s = RECORD.time_s[LOAD_ON] + gap_s - before_s
    assert found.load_on_time_s == pytest.approx(on_s, abs=2e-3)
    part = found.loaded_part(2.7)
    told_C = before_s * found.current_A[LOAD_ON]
    usual_C = (RECORD.time_s[LOAD_ON] - RECORD.load_on_time_s) * found.current_A[LOAD_ON]
    assert part.charge_C == pytest.approx(RECORD.loaded_part(2.7).charge_C + told_C - usual_C, abs=0.1)
    assert part.history.load_on_C == 0.0
    assert found.charge_C - part.charge_C == pytest.approx(RECORD.charge_C - RECORD.loaded_part(2.7).charge_C, abs=0.6)
    # a step that began elsewhere, or does not count, tells nothing
    for other in (after + 500.0, 0.0 * after):
        assert read(table.assign(**{"Step Time (s)": other})).history.load_on_s is None


@pytest.mark.parametrize("missing", [0, 3, 30])
@pytest.mark.parametrize("starts_anew", [False, True])
def test_the_count_of_the_tester_tells_when_the_load_was_switched_on(missing, starts_anew):
    load_s = np.arange(10.0, 3000.0, 10.0)[missing:]
    time_s, current_A = np.append(np.arange(0.0, 601.0, 10.0), 600.0 + load_s), np.repeat([0.0, 2.0], [61, len(load_s)])
    counted = np.append(np.repeat(0.0 if starts_anew else 1.5, 61), 2.0 * load_s / 3600.0 + (not starts_anew) * 1.5)
    table = pd.DataFrame({"Time (s)": time_s, "Current (A)": -current_A, "Voltage (V)": 4.0 - 4e-4 * time_s})
    said = "as the count of the tester says" if missing else ""
    found = read(table.assign(**{"Capacity (Ah)": np.round(counted, 4)}), said)
    assert found.charge_C == pytest.approx(2.0 * load_s[-1], abs=1.0)
    # what does not count as current and time do tells nothing, and then the switches are in doubt
    for other in (2.0, 3.0 * counted):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            (other,) = read_discharges(table.assign(**{"Capacity (Ah)": other}))
        assert other.history.load_on_s is None and other.unseen_C > 5.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("options", [{}, {"discharge_is_negative": True}, {"discharge_is_negative": False}])
@pytest.mark.parametrize("order", [["CHARGE", "REST", "TABLE"], ["TABLE", "REST", "CHARGE"], ["LOW", "FLAT", "REST", "TABLE"]])
def test_a_current_without_a_sign_is_refused(sign, options, order):
    # a charge whose voltage jumps more than it rises
    low, flat = REST.assign(voltage=3.7), CHARGE.assign(voltage=np.linspace(3.9, 4.2, 60))
    parts = [{"LOW": low, "FLAT": flat}.get(name, globals().get(name)) for name in order]
    parts = [part.assign(time=part["time"] - part["time"].iloc[0] + 4000.0 * n) for n, part in enumerate(parts)]
    table = pd.concat(parts, ignore_index=True)
    table["current"] = sign * table["current"].abs()
    with pytest.raises(ValueError, match=r"the current has no sign.*--columns state=NAME"):
        read_discharges(table, **options)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("cell", ["B0005", "B0006"])
@pytest.mark.parametrize("rest_V", [0.3, 0.45, 0.6])
def test_the_jumps_at_the_switches_tell_the_sign_though_a_long_rest_follows(sign, cell, rest_V):
    for record in load_nasa_discharges(cell)[::24]:
        loaded = np.flatnonzero(record.current_A > 1.0)[-1] + 1
        rest = np.arange(1, 61) * 10.0
        table = pd.DataFrame({"time": record.time_s, "voltage": record.voltage_V, "current": sign * record.current_A})[:loaded]
        low_V = table["voltage"].iloc[-1] + rest_V * (1.0 - 0.5 * np.exp(-rest / 200.0))
        more = pd.DataFrame({"time": table["time"].iloc[-1] + rest, "voltage": low_V, "current": 0.0})
        discharge = read(pd.concat([table, more]))
        assert discharge.charge_C == pytest.approx(record.charge_C, rel=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("every_s", [20.0, 60.0, 200.0])
def test_a_current_that_falls_while_the_voltage_is_held_does_not_turn_the_sign(sign, every_s):
    table = TABLE[LOADED & (TABLE["voltage"] > 2.8)]
    held_s = np.arange(1.0, 20.0) * every_s
    held = pd.DataFrame({"time": held_s, "voltage": 2.8, "current": table["current"].iloc[-1] * np.exp(-held_s / 300.0)})
    held["time"] += table["time"].iloc[-1]
    found = read(pd.concat([table, held]).assign(current=lambda rows: sign * rows["current"]))
    assert found.current_A.min() > 0.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 4), st.integers(1, 40), st.booleans())
def test_the_number_of_the_cycle_parts_no_rest_from_its_load_and_no_discharge(before, loops, with_charge):
    """``before``: so many rows of the rest count to the cycle of the load; in the load the counter goes up ``loops`` times."""
    rest = len(CYCLE) - len(TABLE) + LOAD_ON
    number = 7 + np.cumsum(np.isin(np.arange(len(CYCLE)), [rest - before, *np.linspace(rest, len(CYCLE), loops).astype(int)]))
    table = CYCLE.assign(Cycle=number)[0 if with_charge else len(CHARGE) :]
    table = pd.concat([table, table.assign(time=table["time"] + 9000.0, Cycle=table["Cycle"] + 100)])
    discharges = read_discharges(table)
    assert len(discharges) == 2
    for discharge, offset in zip(discharges, (0, 100), strict=True):
        assert discharge.charge_C == pytest.approx(RECORD.charge_C, rel=3e-3)
        assert discharge.meta["cycle"] == number[rest] + offset
        assert discharge.current_A[0] < 0.01


def hybrid(counter):
    """Return nine loops of a pulse of load, one of charge, a discharge and a rest, with a counter that goes up in each."""
    loop = [(10, 2.0, 1), (40, 0.0, 5), (10, -1.5, 1), (40, 0.0, 5), (360, 2.0, 10), (600, 0.0, 60)]
    steps = [(600, 0.0, 60), *(9 * loop)]
    table = pd.DataFrame([(dt, amps, k) for k, (length, amps, dt) in enumerate(steps) for _ in range(length // dt)])
    table.columns = ["dt", "amps", "step"]
    charge_C = (table["dt"] * table["amps"]).cumsum()
    table = pd.DataFrame({"time": table["dt"].cumsum(), "voltage": 4.19 - 1.4 * charge_C / 7200 - 0.1 * table["amps"]}).assign(
        current=-table["amps"], Cycle=(table["step"] + 5 - counter) // 6
    )
    return table, charge_C.iloc[-1]


@pytest.mark.parametrize(("pulse_s", "found"), [(5, 1), (10, 1), (40, 1), (55, 12)])
def test_pulses_within_a_charge_are_no_discharges(pulse_s, found):
    # 360 C and a pulse twelve times, and then the whole discharge; larger ones are cycles
    minute_s = np.mod(np.arange(0.0, 3600.0, 5.0), 300.0)
    current_A = np.where(minute_s < 240.0, 1.5, np.where(minute_s < 240.0 + pulse_s, -1.5, 0.0))
    voltage_V = 3.6 + 0.6 * np.cumsum(current_A) / np.cumsum(current_A).max() + 0.05 * current_A
    pulses = pd.DataFrame({"time": np.arange(0.0, 3600.0, 5.0), "voltage": voltage_V, "current": current_A})
    table = pd.concat([pulses, REST, CYCLE[len(CHARGE) + len(REST) :]], ignore_index=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        discharges = read_discharges(table)
    assert len(discharges) == found
    assert any("within charges" in str(each.message) for each in caught) == (pulse_s == 40)
    np.testing.assert_allclose(discharges[-1].current_A[-len(TABLE) :], RECORD.current_A)
    assert discharges[-1].charge_C == pytest.approx(RECORD.charge_C, rel=0.03)


@pytest.mark.parametrize("counter", range(6))
def test_loops_of_pulses_are_one_discharge_wherever_the_counter_goes_up(counter):
    table, charge_C = hybrid(counter)
    (discharge,) = read_discharges(table)
    assert discharge.charge_C == pytest.approx(charge_C, rel=0.02)


@pytest.mark.parametrize("order", ["stacked", "mixed"])
def test_the_cells_of_a_table_are_told_apart(order, tmp_path, capsys):
    for nobody in (None, np.nan, ""):
        same(read(TABLE.assign(**{"Cell ID": nobody})))
    other = load_nasa_discharges("B0005")[99]
    second = pd.DataFrame({"time": other.time_s, "voltage": other.voltage_V, "current": -other.current_A, "cell_id": "B 5"})
    table = pd.concat([TABLE.assign(cell_id="B6"), second])
    table = table.sort_values("time", kind="stable") if order == "mixed" else table
    found = read_discharges(table)
    assert [each.meta["cell"] for each in found] == ["B6", "B 5"]
    same(found[0])
    table.to_csv(tmp_path / "two.csv", index=False)
    (source,) = find_sources([str(tmp_path / "two.csv")])
    outcomes = list(calibrate_all([source], FileFormat(), Settings()))
    assert [(each.cell, each.record) for each in outcomes] == [("B6", "two_B6"), ("B 5", "two_B_5")]
    assert {each.meta.get("cell") for each in read_discharges(TABLE.assign(cell_id="B6"))} == {None}


def test_lines_that_are_quoted_as_a_whole_are_read(tmp_path):
    lines = [f'"{line}"\n' for line in TABLE.to_csv(index=False).splitlines()]
    for above in ([], ["[Summary]\n", "Cell: 7, of 9\n"]):
        (tmp_path / "cell.csv").write_text("".join([*above, *lines]))
        same(read(tmp_path / "cell.csv"))
    text = TABLE.rename(columns={"time": "总时间(s)", "voltage": "电压(V)", "current": "电流(A)"}).to_csv(index=False)
    (tmp_path / "cell.csv").write_text(text, encoding="gb18030")
    same(read(tmp_path / "cell.csv"))


def test_layers_of_rows_are_read_as_the_lowest_one(tmp_path):
    """As Neware's software exports cycles, steps and records in one table."""
    lines = ["Cycle Index,Chg. Cap.(Ah),DChg. Cap.(Ah)", ",Step Index,Step Type,Capacity(Ah),Voltage(V)"]
    lines += [",,DataPoint,Total Time,Current(A),Voltage(V)"]
    for cycle in (1, 2):
        lines += [f"{cycle},1.9,1.4"]
        for step, (low, high) in enumerate([(0, 60), (60, 70 + LOAD_ON), (70 + LOAD_ON, len(CYCLE))], start=1):
            lines += [f",{step},CC Chg,1.4,3.9"]
            part = CYCLE[low:high]
            lines += [f",,{n},{9000 * cycle + t!r},{i!r},{v!r}" for n, (t, v, i) in enumerate(part.to_numpy().tolist())]
    (tmp_path / "cell.csv").write_text("\n".join(lines))
    paths = [tmp_path / "cell.csv"]
    if importlib.util.find_spec("openpyxl"):
        paths.append(tmp_path / "cell.xlsx")
        fields = [(line + 6 * ",").split(",")[:6] for line in lines]
        pd.DataFrame(fields).replace("", None).to_excel(paths[1], header=False, index=False)
    for path in paths:
        found = read_discharges(path)
        assert [each.meta["cycle"] for each in found] == [1, 2]
        for each in found:
            np.testing.assert_allclose(each.current_A[10:], RECORD.current_A)


def test_the_sheet_of_a_workbook_that_holds_the_record_is_read_with_those_that_continue_it(tmp_path):
    pytest.importorskip("openpyxl", reason="the extra excel is not installed")
    path = tmp_path / "cell.xlsx"
    half = len(TABLE) // 2
    table = TABLE.rename(columns={"time": "Test_Time(s)", "voltage": "Voltage(V)", "current": "Current(A)"})
    with pd.ExcelWriter(path) as writer:
        pd.DataFrame({"Cell": ["B0006"], "Schedule": ["cc"]}).to_excel(writer, sheet_name="Info", index=False)
        table[:half].to_excel(writer, sheet_name="Channel_1", index=False, startrow=3)
        table[half:].to_excel(writer, sheet_name="Channel_2", index=False, startrow=3)
        table[:1].assign(more=1).to_excel(writer, sheet_name="Statistics", index=False)
    same(read(path))
    # nor need they continue each other
    with pd.ExcelWriter(path) as writer:
        for name, add_s in (("DST", 0.0), ("US06", 0.0), ("FUDS", 30.0)):
            table.assign(**{"Test_Time(s)": RECORD.time_s + add_s}).to_excel(writer, sheet_name=name, index=False)
    found = read_discharges(path)
    assert [each.meta["cycle"] for each in found] == [1, 2, 3]
    for each in found:
        np.testing.assert_allclose(each.charge_C, RECORD.charge_C)
    (tmp_path / "text.xls").write_text(table.to_csv(index=False, sep="\t"))
    same(read(tmp_path / "text.xls"))  # as some testers call their text


def test_names_with_blanks_and_line_breaks_are_read_and_one_that_comes_twice_is_no_column(tmp_path):
    pytest.importorskip("openpyxl", reason="the extra excel is not installed")
    pyarrow = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    from pyarrow import parquet

    table = TABLE.assign(Units="SI").set_axis(["Test Time\n(s)", " Voltage (V)", "Current\r\n(A) ", " Units "], axis="columns")
    for name, write in (("cell.parquet", table.to_parquet), ("cell.xlsx", table.to_excel)):
        write(tmp_path / name, index=False)
        same(read(tmp_path / name))
    columns = parquet.read_table(tmp_path / "cell.parquet").columns
    twice = pyarrow.table([*columns, columns[1]], names=[*table, " Voltage (V)"])
    parquet.write_table(twice, tmp_path / "cell.parquet")
    with pytest.raises(ValueError, match="no column for the voltage"):
        read_discharges(tmp_path / "cell.parquet")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("9" * 400, "the column 'time' cannot be read: int too large"),
        ('"', r"the quotes that begin in row \d+ do not end"),
        ("first", "'time' must hold numbers, got 'first' in row 1"),
    ],
)
def test_a_refused_table_shows_its_first_lines_and_the_command_that_reads_it(words, said, tmp_path):
    path = tmp_path / "cell.csv"
    rows = [f"{words if n < 9 else n},{4.1 - 0.01 * n},2" for n in range(51)]
    path.write_text("\n".join(["time,voltage,current", *rows]))
    shown = rf"{said}.*header time, voltage, current; row 1 .*; row 2 .*; tester plain; time 'time'; .*columns {path}"
    with pytest.raises(ValueError, match=shown):
        read_discharges(path)


@pytest.mark.parametrize("suffix", [".xlsx", ".xls"])
def test_a_workbook_that_is_damaged_or_needs_an_extra_says_so(suffix, tmp_path, monkeypatch):
    (tmp_path / f"cell{suffix}").write_bytes({".xlsx": b"PK\x03\x04", ".xls": b"\xd0\xcf\x11\xe0"}[suffix] + bytes(100))
    with pytest.raises((ValueError, ImportError), match=r"damaged, or no Excel file|Excel files need .*battery_env\[excel\]"):
        read_discharges(tmp_path / f"cell{suffix}")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    monkeypatch.setitem(sys.modules, "xlrd", None)
    with pytest.raises((ValueError, ImportError), match=r"damaged, or no Excel file|Excel files need .*battery_env\[excel\]"):
        read_discharges(tmp_path / f"cell{suffix}")


def test_a_folder_reads_numbered_text_and_names_what_it_left_out(tmp_path, capsys):
    lab, results = tmp_path / "lab", tmp_path / "lab" / "results"
    lab.mkdir()
    TABLE.to_csv(lab / "cell.001", index=False, sep="\t")
    (lab / "old.csv.gz").write_bytes(gzip.compress(TABLE.to_csv(index=False).encode()))
    for name in ("a.res", "b.h5", "photo.png"):
        (lab / name).write_bytes(b"?")
    assert command([str(lab), "--out", str(results)]) == 0
    assert "a.res, b.h5, photo.png left out, by their names no records" in capsys.readouterr().err
    assert command([str(lab)]) == 0  # results are no records, and need not be named
    assert "results" not in capsys.readouterr().err
    assert [source.stem for source in find_sources([str(lab / "cell.001")])] == ["cell"]


@pytest.mark.parametrize(
    ("changes", "said", "unsaid"),
    [
        ({"time": TABLE["time"] / 3600.0}, "--units time=h", ""),
        ({"time": TABLE["time"] / 86400.0}, "3022 s if it is in days (command line: --units time=d)", "minutes"),
        ({"time": TABLE["time"] * 1e3}, "--units time=ms", ""),
        ({"voltage": TABLE["voltage"] * 1e3}, "--units voltage=mV", ""),
        ({"time (s)": TABLE["time"] / 3600.0, "time": None}, "got 0.839375 s, too short for a discharge.", "--units"),
        (
            {"current (A)": TABLE["current"] * 1e-3, "current": None, "voltage": 4.1},
            "a coin cell under load: no discharge",
            "unit",
        ),
        # an open-circuit voltage that falls when the cell is taken out
        ({"current (A)": 1e-6 * (TABLE.index == 7), "current": None}, "a coin cell under load: no discharge", "unit"),
        ({"voltage": TABLE["voltage"] - 2.9}, "must lie within -0.1 .. 5.5 V, got -0.1", "pack"),
        ({"current": 30.0 + TABLE["time"], "voltage": 1.0}, "cannot be told", "zero-size"),
    ],
)
def test_advice_is_given_only_if_it_helps_and_does_not_contradict_what_is_known(changes, said, unsaid):
    table = TABLE.assign(**changes).dropna(axis="columns", how="all")
    with pytest.raises(ValueError) as caught:
        read_discharges(table)
    assert said in str(caught.value) and not (unsaid and unsaid in str(caught.value)), str(caught.value)


@pytest.mark.parametrize("share", [400.0, 22.0, 1e-1, 1e-2, 3e-3, 1e-3, 1e-4])
def test_the_charge_of_a_cell_of_any_size_is_known_and_where_that_is_another_its_constants_are_not(share):
    (found,) = calibrate(TABLE.assign(current=share * TABLE["current"]).rename(columns={"current": "current (A)"}))
    assert found.drawn_Ah == pytest.approx(share * RECORD.loaded_part(2.7).charge_C / 3600.0, rel=0.01)
    assert found.capacity_Ah == pytest.approx(found.drawn_Ah) and not found.settled
    assert share == 0.1 or found.reason.startswith(("No cell of this kind has such a q_max", "Cells below 28 mAh are not"))
    at_bound = share in (400.0, 1e-2, 3e-3, 1e-3, 1e-4)
    assert np.isnan([found.q_mobile_C, found.sd_q_mobile_C, found.r_o_ohm, found.sd_r_o_ohm]).all() == at_bound
    assert "nan" not in str(found)
    drawn = str(found).partition(" Ah drawn")[0].split()[-1]
    assert float(drawn) == pytest.approx(found.drawn_Ah, rel=0.005)


class TestCountedByTheTester:
    COUNTED = np.append(0.0, np.cumsum(np.maximum(-TABLE["current"], 0.0).to_numpy()[:-1] * np.diff(TABLE["time"]))) / 3600.0

    @pytest.mark.parametrize("name", ["Discharge_Capacity(Ah)", "Capacity(mAh)", "DChg. Cap.(Ah)", "Q discharge/mA.h"])
    def test_what_agrees_is_not_said_however_it_counts(self, name):
        counted = self.COUNTED * (1e3 if "mA" in name else 1.0)
        for values in (
            counted,
            -counted,
            counted + 3.0,
            np.where(np.arange(len(counted)) > 100, counted - counted[100], counted),
        ):
            shown = read(TABLE.assign(**{name: values})).history
            assert shown.uncounted_C < 0.1 and shown.is_counted == (values[-1] != (counted - counted[100])[-1])
        # nor a name that is a unit, nor a count without a sign of what comes back
        assert read(TABLE.assign(**{"Amp-hr": self.COUNTED})).history.uncounted_C < 0.1
        current_A = TABLE["current"].where(TABLE.index != 200, 1.0)
        passed = np.append(0.0, np.cumsum(np.abs(current_A.to_numpy()[:-1]) * np.diff(TABLE["time"]))) / 3600.0
        assert read(TABLE.assign(current=current_A, **{"Capacity(Ah)": passed})).history.uncounted_C < 20.0
        # nor a column that is no count
        assert not read(TABLE.assign(**{name: 2.0})).history.is_counted

    def test_what_starts_anew_while_the_load_is_switched_tells_nothing_of_that(self):
        """Pulses of 10 s, each in one row alone, that a counter of single steps shows at 0."""
        time_s = np.arange(0.0, 6000.0, 10.0)
        pulse, load = time_s % 600.0 == 300.0, time_s % 600.0 < 200.0
        table = pd.DataFrame({"Time (s)": time_s, "Current (A)": -np.select([pulse, load], [8.0, 2.0], 0.0)})
        table["Voltage (V)"] = 4.1 - 2e-4 * time_s + 0.1 * table["Current (A)"]
        table["Capacity (mAh)"] = np.where(load, 2.0 * (time_s % 600.0) / 3.6, 0.0)
        found = read(table)
        assert found.history.uncounted_C < 0.01 * found.charge_C < found.unseen_C and not found.history.is_counted

    def test_a_clock_beside_it_that_counts_the_same_tells_nothing(self):
        same(read(TABLE.rename(columns={"time": "Test_Time"}).assign(DateTime=1547507301.8 + TABLE["time"])))

    @pytest.mark.parametrize("gain", [0.5, 0.9, 0.97, 1.03, 1.1, 2.0])
    def test_what_does_not_is_said_and_is_a_doubt_of_its_size(self, gain):
        for name, ticks in (("Amp-hr", 1.0), ("Capacity(mAs)", 3.6e6)):
            assert read(TABLE.assign(**{name: ticks * gain * self.COUNTED}), "the tester counted").history.uncounted_C > 0.0
        discharge = read(TABLE.assign(**{"Capacity(Ah)": gain * self.COUNTED}), "the tester counted")
        charge_C = 3600.0 * self.COUNTED[-1]
        assert discharge.history.uncounted_C == pytest.approx(abs(gain - 1.0) * charge_C, rel=0.1)
        for method in ("least-squares", "kalman"):
            found = calibrate(discharge, method=method)
            assert found.sd_q_mobile_C > 0.95 * discharge.history.uncounted_C and not found.settled_q_mobile
            assert "The tester counted another charge" in found.reason
            assert found.sd_predicted_capacity_Ah > discharge.history.uncounted_C / 3600.0


@pytest.mark.parametrize("writes_ends", [False, True])
@pytest.mark.parametrize("every_s", [1, 2, 5, 10, 20])
def test_what_a_clock_that_starts_anew_with_each_step_loses_is_in_doubt(every_s, writes_ends):
    """Loads of two sizes in turn, for 97 s each, with rows every so often, and one at the end of each step or none."""
    starts_s = 97 * np.arange(20)
    at_s = [np.unique([*range(0, 97, every_s), *([96] if writes_ends else [])]) for _ in starts_s]
    step, within_s = np.repeat(np.arange(20), [len(each) for each in at_s]), np.concatenate(at_s)
    true_s, current_A = starts_s[step] + within_s, np.where(step % 2, 1.0, 3.0)
    table = {"Step Time (s)": within_s, "Step Index": step, "Current (A)": current_A}
    table["Voltage (V)"] = 4.1 - 4e-4 * true_s - 0.1 * current_A
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (found,) = read_discharges(pd.DataFrame(table), discharge_is_negative=False)
    true_C = float(current_A[:-1] @ np.diff(true_s))
    assert abs(found.charge_C - true_C) <= 2.0 * found.history.uncounted_C + 0.012 * true_C  # rows lie a second apart at best
    assert (found.history.uncounted_C == 0.0) == (writes_ends and 96 % every_s > 0)
    assert any("is unknown" in str(each.message) for each in caught) == (found.history.uncounted_C > 0.0)


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_titles_are_no_names(separator, tmp_path):
    rows = TABLE.to_csv(index=False, header=False, sep=separator)
    titles = "Old cell at end of charge\nstarting voltage: 4.2 V\nload of 350 mA at 5V\n\n"
    (tmp_path / "cell.txt").write_text(titles + rows)
    with pytest.raises(ValueError, match="there is no line with the names of the columns above the numbers"):
        read_discharges(tmp_path / "cell.txt")
    (tmp_path / "cell.txt").write_text(titles + separator.join("abc") + "\n" + rows)
    with pytest.raises(ValueError, match=r"no column for the time, the voltage, the current\. header a, b, c"):
        read_discharges(tmp_path / "cell.txt")
    same(read(tmp_path / "cell.txt", columns={"time": "a", "voltage": "b", "current": "c"}))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_of_headers_that_with_the_most_rows_below_that_fit_it_is_taken(separator, tmp_path):
    program = pd.DataFrame(
        {"Step": [1, 2, 3], "Current (A)": [1.5, 0.0, 2.0], "Voltage (V)": [4.2, 0.0, 2.7], "Time (s)": 9e4}
    )
    above, text = (table.to_csv(index=False, sep=separator) for table in (program, TABLE))
    (tmp_path / "cell.txt").write_text(f"{above}\n{text}")
    same(read(tmp_path / "cell.txt", "the header is line 6; the table of line 1 is left out"))
    text = text.replace("time", "X_Value", 1)
    (tmp_path / "cell.txt").write_text(f"Units{separator}Volts{separator}Amps{separator}K\nEnd of header\n{text}")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match=r"no column for the time\. header X_Value"):
        read_discharges(tmp_path / "cell.txt")


def test_a_voltage_that_jumps_against_what_passes_leaves_the_sign_open():
    """The drop over a wire that a load shares with a sensor of a pack can exceed that of the cell."""
    table = TABLE.assign(voltage=TABLE["voltage"] - 0.3 * TABLE["current"])
    with pytest.raises(ValueError, match=r"cannot be told.*contradict each other\. State it: --discharge-is-negative"):
        read_discharges(table)
    near(read(table, discharge_is_negative=True))


def test_charges_alone_without_a_sign_are_no_discharge():
    """Pulses of charge and rests in turn, in which a little flows by an offset of the sensor."""
    time_s = np.arange(0.0, 7200.0, 10.0)
    charges = time_s % 1200.0 < 600.0
    voltage_V = 3.6 + 1e-4 * np.cumsum(charges) * 10.0 + np.where(charges, 0.1, 0.1 * np.exp(-(time_s % 600.0) / 100.0))
    table = pd.DataFrame({"time": time_s, "voltage": voltage_V, "current": np.where(charges, 1.0, 0.01)})
    with pytest.raises(ValueError, match="there is no discharge: no charge is drawn"):
        read_discharges(table)


def test_a_last_line_that_is_cut_within_quotes_is_left_out(tmp_path):
    content = TABLE.astype(str).to_csv(index=False, quoting=csv.QUOTE_ALL)
    for encoding, end in (("utf-8", content.rindex(',"') + 4), ("utf-16", content.rindex('\n"') + 3)):
        (tmp_path / "cell.csv").write_text(content[:end], encoding=encoding)
        near(read(tmp_path / "cell.csv", "the last line is cut within quotes, and left out"))


@pytest.mark.parametrize("day", ["{}-", "{}.", "{} days ", "{} day, ", "1900-01-{:02d} "])
@pytest.mark.parametrize("fraction", [".", ",", ":"])
def test_days_stand_before_the_hours_of_a_clock(day, fraction):
    later_s = np.round(RECORD.time_s + 85000.0, 2)
    days = [day.format(int(later // 86400)) if later >= 86400.0 else "" for later in later_s]
    clock = [day + time.strftime("%H:%M:", time.gmtime(t)) + f"{t % 60:06.3f}" for day, t in zip(days, later_s, strict=True)]
    names = {"time": "TestTime", "voltage": "Vol", "current": "Cur"}
    found = read(
        TABLE.assign(time=[text.replace(".", fraction) if day != "{}." else text for text in clock]).rename(columns=names)
    )
    np.testing.assert_allclose(found.time_s, later_s)
    near(found)


def test_a_date_alone_is_midnight():
    dates = pd.Timestamp("2026-02-28") + pd.to_timedelta(np.floor(RECORD.time_s) - np.floor(RECORD.time_s[100]), unit="s")
    for style in ("%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S"):
        text = [date.removesuffix(" 00:00:00") for date in dates.strftime(style)]
        near(read(TABLE.assign(time=text).rename(columns={"time": "Date"})))
    with pytest.raises(ValueError, match="must hold numbers, got '2026-02-28' in row 1"):
        read_discharges(TABLE.assign(time="2026-02-28"))


def test_signs_of_typographers_and_strokes_between_columns_are_read(tmp_path):
    text = TABLE.to_csv(index=False, sep="|")
    (tmp_path / "cell.txt").write_text(text.replace("-", "\u2212"), encoding="utf-8")
    same(read(tmp_path / "cell.txt"))
    text = TABLE.to_csv(index=False, sep=";", decimal=",")
    (tmp_path / "cell.txt").write_text(text.replace("-", "\u2212"), encoding="utf-16")
    same(read(tmp_path / "cell.txt"))


def test_one_cell_without_a_discharge_does_not_lose_the_others():
    """As an empty slot of a tester, or a cell that is charged only."""
    for other in (CHARGE, TABLE.assign(current=0.0, voltage=0.001)):
        table = pd.concat([other.assign(Channel=1), TABLE.assign(Channel=2)], ignore_index=True)
        same(read(table, "cell 1: "))
    # rows above the first name are of the cell below
    same(read(TABLE.assign(Barcode=["", *["A7"] * (len(TABLE) - 1)])))


@pytest.mark.parametrize("unit", ["hh:mm:ss.sss", "HH:mm:ss.fff", "[h]:mm:ss", "h:min:s.ms", "hh:mm:ss.0", "H:M:S"])
def test_a_unit_of_hours_minutes_and_seconds_is_a_clock(unit):
    clock = [str(pd.Timedelta(seconds=t))[7:] for t in RECORD.time_s.tolist()]
    same(read(TABLE.assign(time=clock).rename(columns={"time": f"Total Time({unit})"})))


def test_a_current_that_a_meter_could_not_read_is_refused_as_such():
    table = TABLE.assign(Capacity=1.0).rename(columns={"Capacity": "Capacity (Ah)"})
    table.loc[[5, 100], "current"] = 9.9e37
    with pytest.raises(ValueError, match=r"current_A must lie within|cannot be told"):
        read_discharges(table)


def test_two_columns_of_one_name_agree_or_one_is_named():
    hours, milli = {"time/h": (RECORD.time_s / 3600.0).round(7)}, {"current/mA": -1e3 * RECORD.current_A}
    table = TABLE.rename(columns={"time": "time/s", "current": "current/A"}).assign(**hours, **milli)
    same(read(table))
    same(read(table[table.columns[::-1]]), atol=2e-4)
    table["time/h"] *= 1.01
    with pytest.raises(ValueError, match=r"both 'time/s' and 'time/h' may be the time.*--ignore NAME"):
        read_discharges(table)
    same(read(table, ignore=["time/h"]))


@settings(max_examples=20, deadline=None)
@given(st.sets(st.sampled_from(range(10, len(TABLE) - 9, 9)), min_size=1, max_size=6), st.floats(0.0, 5.0))
def test_the_time_in_a_step_is_added_up_and_a_time_of_the_test_is_not(starts, first_s):
    steps = np.zeros(len(TABLE))
    steps[[LOAD_ON, *starts]] = 1.0
    steps = np.cumsum(steps)
    start_s = TABLE["time"].groupby(steps).transform("first")
    table = TABLE.assign(time=TABLE["time"] - start_s + first_s, Step=steps)
    with pytest.raises(ValueError, match=r"the clock goes back: row \d+ .*is at .* s, after "):
        read_discharges(table)
    discharge = read(table, "the time starts anew with each step, and is added up", columns={"step_time": "time"})
    # what passes between two steps is not in such a file
    lost_s = sum(TABLE["time"].iloc[n] - TABLE["time"].iloc[n - 1] - first_s for n in {LOAD_ON, *starts})
    assert np.ptp(discharge.time_s) == pytest.approx(np.ptp(RECORD.time_s) - lost_s, abs=0.01 * len(starts) + 0.01)


@pytest.mark.parametrize("with_step", [True, False])
@pytest.mark.parametrize("dates", ["%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", None])
def test_dates_are_the_clock_where_another_one_goes_back(with_step, dates):
    step = np.searchsorted([60, len(CHARGE) + len(REST) + LOAD_ON], np.arange(len(CYCLE)), side="right")
    date = pd.Timestamp("2026-02-27 23:50") + pd.to_timedelta(CYCLE["time"] + np.where(step == 2, 3600.0, 0.0), unit="s")
    table = CYCLE.assign(time=CYCLE["time"] - CYCLE.groupby(step)["time"].transform("first"))
    table["Absolute Time"] = date.dt.strftime(dates) if dates else date
    if with_step:
        table["Step"] = step
    found = read(table, "the time is 'Absolute Time', as 'time' goes back")
    assert found.time_s[-1] - found.time_s[0] == pytest.approx(4200.0 + RECORD.time_s[-1], abs=1.0)
    assert found.loaded_part(2.7).charge_C == pytest.approx(RECORD.loaded_part(2.7).charge_C, rel=5e-3)
    assert found.meta["start_time"].startswith("2026-02-28T00:50")
    # dates that tell fewer rows apart are no better
    with pytest.raises(ValueError, match="--columns step_time=NAME"):
        read_discharges(table.assign(**{"Absolute Time": date.dt.floor("30s")}))


PUT_BACK_S = TABLE["time"] - 3600.0 * (TABLE["time"] > 900.0)
HOUR = TABLE.assign(time=pd.Timestamp("2026-10-25 02:45") + pd.to_timedelta(PUT_BACK_S, "s"))
BACK = TABLE.assign(time=TABLE["time"] - 10.0 * (TABLE.index >= 150))
OTHER = pd.concat([TABLE, TABLE.assign(voltage=TABLE["voltage"] - 0.05)]).sort_values("time", kind="stable")
ZERO = TABLE.assign(time=TABLE["time"].where(TABLE.index != 150, 0.0))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (HOUR, "Clocks are put back by an hour in autumn: give times of UTC"),
        (BACK, r"the clock goes back: row 151 is at .* s, after .* s\. Sort the rows by time, or remove those"),
        (ZERO, r"the clock goes back: row 151 is at 0 s, after .* s\. Sort the rows by time, or remove those"),
        (pd.concat([TABLE[:150], TABLE[100:]], ignore_index=True), "the clock goes back: row 151 is at"),
        (OTHER, "each sample once"),
    ],
)
def test_a_broken_clock_is_refused_with_its_rows(table, said):
    with pytest.raises(ValueError, match=said):
        read_discharges(table)
    with pytest.raises(ValueError, match=r"the clock goes back|each sample once"):
        read_discharges(table.assign(Step=1))


@pytest.mark.parametrize("more", [[], ["rest"]])
def test_where_the_clock_starts_anew_at_rest_another_test_begins(more):
    test = pd.concat([CYCLE, CYCLE[-1:].assign(time=CYCLE["time"].iloc[-1] + 9.0, current=0.0, voltage=3.3)])
    test["current"] = test["current"].where(test["time"] > 0.0, 0.0)
    table = pd.concat([test, test.assign(current=0.999 * test["current"])], ignore_index=True)
    said = f"the clock starts anew at rest, where another test begins: row {len(test) + 1}"
    with pytest.warns(UserWarning, match=said):
        found = read_discharges(table)
    assert [each.meta["cycle"] for each in found] == [1, 2]
    for each, share in zip(found, (1.0, 0.999), strict=True):
        assert each.charge_C == pytest.approx(share * RECORD.charge_C, rel=2e-3) and each.time_s[0] == 0.0
    numbered = table.assign(Cycle=np.repeat([1, 2], len(test)))
    assert [each.charge_C for each in read_discharges(numbered)] == [each.charge_C for each in found]
    with pytest.raises(ValueError, match="number the tests in a column of the cycle"):
        read_discharges(table.assign(Cycle=1))


@pytest.mark.parametrize("separator", [",", "\t"])
def test_rows_of_more_numbers_than_names_are_refused_and_remarks_change_nothing(separator, tmp_path):
    rows = TABLE.to_csv(index=False, header=False, sep=separator).splitlines()
    (tmp_path / "cell.txt").write_text("\n".join([separator.join(TABLE), *(f"{row}{separator}ok" for row in rows)]))
    same(read(tmp_path / "cell.txt"))
    (tmp_path / "cell.txt").write_text("\n".join([separator.join(TABLE), *(f"{row}{separator}7" for row in rows)]))
    with pytest.raises(ValueError, match="rows have 4 fields below 3 names"):
        read_discharges(tmp_path / "cell.txt")


@pytest.mark.parametrize("power", ["W", "V"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("noise_V", [0.0, 0.003])
def test_a_load_that_follows_the_voltage_tells_its_sign_by_the_fall(power, sign, noise_V):
    """A constant power, or a constant resistance, without a rest."""
    voltage_V = RECORD.voltage_V[LOADED] + noise_V * np.random.default_rng(1).standard_normal(LOADED.sum())
    current_A = 8.0 / voltage_V if power == "W" else voltage_V / 2.0
    found = read(pd.DataFrame({"time": RECORD.time_s[LOADED], "voltage": voltage_V, "current": sign * current_A}))
    np.testing.assert_allclose(found.current_A, current_A)


def test_a_unit_is_read_from_a_stated_name_and_nothing_is_read_from_an_unknown_one(tmp_path):
    table = pd.DataFrame({"time_s": RECORD.time_s, "batt_mV": 1e3 * RECORD.voltage_V, "load_mA": 1e3 * RECORD.current_A})
    path = tmp_path / "cell.csv"
    table.to_csv(path, index=False)
    said = rf"row 1 0\.0, 418.*row 2 9.*time 'time_s' in s.*voltage=batt_mV,current=load_mA.*columns {path}"
    with pytest.raises(ValueError, match=said) as caught:
        read_discharges(path)
    assert "\n" not in str(caught.value)
    same(read(path, columns={"voltage": "batt_mV", "current": "load_mA"}))


def test_a_tester_is_told_by_its_names_or_added_by_a_file(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = pd.DataFrame({"Clock": RECORD.time_s / 60.0, "Pole(V)": RECORD.voltage_V, "Load": -1e3 * RECORD.current_A})
    table.to_csv("cell.csv", index=False)
    assert command(["columns", "cell.csv"]) == 3
    shown = capsys.readouterr().out
    assert "header      Clock, Pole(V), Load" in shown and "row 2       0.157" in shown and "time        not found" in shown
    text = Path("my_tester.toml").read_text()
    for name, value in (("time", "Clock"), ("voltage", "Pole"), ("current", "Load")):
        text = text.replace(f'# {name} = ""', f'{name} = "{value}"', 1)
    head, units = text.split("[units]")
    Path("my_tester.toml").write_text(f"{head}[units]{units}")
    with pytest.raises(ValueError, match="current_A must lie within"):
        read_discharges("cell.csv", tester="my_tester.toml")  # minutes and milliamperes
    units = units.replace('# time = ""', 'time = "min"').replace('# current = ""', 'current = "mA"')
    Path("my_tester.toml").write_text(f"{head}[units]{units}")
    same(read("cell.csv", tester="my_tester.toml"), atol=1e-3)
    assert command(["cell.csv", "--tester", "my_tester.toml"]) == 0
    assert calibrate("cell.csv", tester="my_tester.toml")[0].settled
    assert command(["columns", "cell.csv"]) == 2  # nothing is overwritten
    assert "my_tester.toml would be replaced" in capsys.readouterr().err
    faults = (("a = 1", "a tester has name"), ("[columns", "no file in TOML"), ("[columns]\nx='y'", "by quantity"))
    for content, said in faults:
        Path("bad.toml").write_text(content)
        with pytest.raises(ValueError, match=f"bad.toml.*{said}"):
            read_discharges("cell.csv", tester="bad.toml")
    with pytest.raises(FileNotFoundError, match="nor a tester of this name: known are Arbin, Maccor"):
        read_discharges("cell.csv", tester="Unheard")


def test_every_row_of_the_table_reads_its_own_names():
    for tester in TESTERS[:-1]:
        names = {quantity: tester.columns[quantity][0] for quantity in ("time", "voltage", "current")}
        marks = {name: 20.0 for name in tester.told_by[:1] if name not in names.values()}
        table = pd.DataFrame({names[each]: TABLE[each] for each in names} | marks)
        factors = {"voltage": 1e3 if "mV" in names["voltage"] else 1.0, "current": 1e3 if "mA" in names["current"] else 1.0}
        for quantity, factor in factors.items():
            table[names[quantity]] *= factor
        assert recognise(list(table), FileFormat(), []).tester is tester, tester.name
        same(read(table), atol=1e-5)


def test_nul_bytes_are_left_out_and_a_binary_file_is_not_read(tmp_path):
    text = TABLE.to_csv(index=False).encode()
    for content in (b"\0" + text, text[:400] + b"\0" + text[400:], text + bytes(4096)):
        (tmp_path / "cell.csv").write_bytes(content)
        near(read(tmp_path / "cell.csv", "NUL bytes, which are no text, are left out"))
    (tmp_path / "cell.csv").write_bytes(text.decode().encode("utf-32"))
    with pytest.raises(ValueError, match="the file is binary"):
        read_discharges(tmp_path / "cell.csv")


@pytest.mark.parametrize("name", ["time", "Test Time", "Date"])
def test_a_blank_in_a_clock_is_a_row_that_is_left_out(name):
    clock = pd.Series([f"{int(s // 3600)}:{int(s // 60 % 60):02d}:{s % 60:06.3f}" for s in RECORD.time_s])
    if name == "Date":
        clock = pd.Series(DATES)
    for blank in (np.nan, "", None):
        table = TABLE.assign(time=clock.mask(clock.index == 30, blank)).rename(columns={"time": name})
        near(read(table, "left out, as the time is missing: row 31"))


def test_what_is_left_aside_is_named_and_a_mistake_in_some_cycles_loses_no_other():
    cycle = CYCLE.assign(Cycle=1, current=10.0 * CYCLE["current"])
    small = cycle.assign(current=0.005 * cycle["current"], time=cycle["time"] + 9000.0, Cycle=2)
    with pytest.warns(UserWarning, match=r"left aside, as they draw less than 1% of the largest: 1 \(0\.072. Ah in rows"):
        (found,) = read_discharges(pd.concat([cycle, small], ignore_index=True))
    assert found.charge_C == pytest.approx(10.0 * RECORD.charge_C, rel=3e-3)
    wrong = cycle.assign(current=1e3 * cycle["current"], time=cycle["time"] - 9000.0, Cycle=0)
    with pytest.warns(UserWarning, match=r"current_A must lie within -1000 .. 1000 A, got 2.*left out"):
        (found,) = read_discharges(pd.concat([wrong, cycle], ignore_index=True))
    assert found.charge_C == pytest.approx(10.0 * RECORD.charge_C, rel=3e-3)


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


def hostile(folder, kind):
    """Small files that would become large."""
    path = folder / f"cell.{kind}"
    if kind == "csv.gz":
        path.write_bytes(gzip.compress(b"time_s,voltage_V,current_A\n" + 40_000_000 * b"1,4,2\n", 9))
    elif kind == "csv":
        path.write_bytes(b"time_s,voltage_V,current_A\n" + 3_100_000 * b"1,4,2\n")
    elif kind == "mat":
        savemat(path, {"B0005": np.zeros(1 << 23)}, do_compression=True)
    elif kind == "parquet":
        rows = 4_000_000
        frame = pd.DataFrame({"time_s": np.zeros(rows), "voltage_V": 4.0, "current_A": 2.0})
        frame.to_parquet(path, compression="zstd")
    else:
        openpyxl = pytest.importorskip("openpyxl", reason="the extra excel is not installed")
        book = openpyxl.Workbook()
        book.active.append(["time_s", "voltage_V", "current_A"])
        book.active["XFD1048576"] = 1.0
        book.save(path)
    return path


@pytest.mark.parametrize("kind", ["csv.gz", "csv", "xlsx", "parquet", "mat"])
def test_nothing_that_is_small_becomes_large(kind, tmp_path):
    path = hostile(tmp_path, kind)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"cell.*more than the \d+ (?:MiB )?that are read"):
            read_discharges(path)
        assert tracemalloc.get_traced_memory()[1] < 6e8
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("header", [f"|{' ' * 4000}|", "[" * 3000, f"time{' ' * 5000}(s)", "a/" * 4000, "x," * 5000])
def test_a_header_of_any_kind_is_looked_at_in_no_time(header, tmp_path):
    (tmp_path / "cell.csv").write_text(f"{header}\n" * 3 + "1,2,3\n" * 50)
    start = time.process_time()
    with pytest.raises(ValueError, match=r"no column for|names of the columns|columns are more"):
        read_discharges(tmp_path / "cell.csv")
    assert time.process_time() - start < 5.0
