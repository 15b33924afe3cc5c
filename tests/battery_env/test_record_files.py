"""Files as testers and people write them, and as a new user would get them wrong."""

import gzip
import sys
import types
import warnings

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from battery_env import read_discharge_csv, read_discharges, simulate
from battery_env.records import Samples
from tests.records import table_of
from tests.tables import LOADED, RECORD, TABLE, clock, read, same


def named(time: str, voltage: str, current: str, temperature: str, factors=(1.0, 1.0, -1.0), zero_C=0.0) -> dict:
    """Return the record by its columns' names, in units that the factors make of s, V and A."""
    quantities = zip((time, voltage, current), factors, (RECORD.time_s, RECORD.voltage_V, RECORD.current_A), strict=True)
    return {name: factor * values for name, factor, values in quantities} | {temperature: RECORD.temperature_C + zero_C}


ARBIN = named("Test_Time(s)", "Voltage(V)", "Current(A)", "Aux_Temperature_1 (C)")
BDF = named("Test Time / s", "Voltage / V", "Current / A", "Surface Temperature T1 / degC")
CLOCK = named("Time", "voltage_mv", "current_ma", "T1", (1.0, 1e3, -1e3))
DATES = named("Date_Time", "Voltage", "Current", "Cell Temperature", (1.0, 1.0, 1.0))
COLUMNS = {
    "this package": named("time_s", "voltage_V", "current_A", "temperature_C", (1.0, 1.0, 1.0)),
    "Battery Data Format": BDF | {"Ambient Temperature / degC": 23.0},
    "Battery Data Format for machines": named("test_time_second", "voltage_volt", "current_ampere", "temperature_t1_celsius"),
    "Arbin": ARBIN | {"Step_Time(s)": np.mod(RECORD.time_s, 100.0), "Charge_Capacity(Ah)": 0.0},
    "BioLogic": named("time/s", "Ewe/V", "<I>/mA", "temperature", (1.0, 1.0, -1e3)),
    "Neware": named("Total Time", "Voltage(V)", "Current(mA)", "T1", (1.0, 1.0, -1e3)),
    "NASA": named("Time", "Voltage_measured", "Current_measured", "Temperature_measured"),
    "thousandths, minutes and kelvin": named(
        "elapsed time [min]", "U (mV)", "I [mA]", "Temp (K)", (1.0 / 60.0, 1e3, 1e3), zero_C=273.15
    ),
    "hours": named("Time (h)", "Volts", "Amps", "temperature", (1.0 / 3600.0, 1.0, 1.0)),
    "Gamry": named("T", "Vf", "Im", "temp 1"),
    "Basytec": named("~Time[h]", "U[V]", "I[A]", "T1[°C]", (1.0 / 3600.0, 1.0, -1.0)),
    "Landt": named("test_time_s", "voltage_V", "current_A", "temperature_1_C"),
    "another Arbin": named("Test_Time(s)", "Voltage(V)", "Current(A)", "Aux_Temperature(℃)_1"),
    "a clock": CLOCK | {"Time": [*map(clock, RECORD.time_s)]},
    "dates": DATES | {"Date_Time": pd.Timestamp("2026-02-28 23:50") + pd.to_timedelta(RECORD.time_s, unit="s")},
}


@pytest.mark.parametrize("columns", COLUMNS.values(), ids=COLUMNS)
@pytest.mark.parametrize("name", ["cell.csv", "cell.parquet", "cell.txt.gz"])
def test_columns_go_by_the_names_of_testers_and_units_are_told_from_them(columns, name, tmp_path):
    table = pd.DataFrame(columns)
    path = tmp_path / name
    table.to_parquet(path) if name.endswith("parquet") else table.to_csv(path, index=False, sep="\t" if "txt" in name else ",")
    discharge = read(path)
    same(discharge, temperature=True)
    assert ("ambient_temperature_C" in discharge.meta) == ("Ambient Temperature / degC" in columns)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_the_encoding_of_a_long_file_is_told(encoding, tmp_path):
    # Longer than what is looked at
    text = TABLE.assign(State="é" * 1000).to_csv(index=False)
    (tmp_path / "cell.csv").write_text(text, encoding=encoding)
    assert len(text) > 2**18
    same(read(tmp_path / "cell.csv"))


@pytest.mark.parametrize("comments", ["# ", ""])
def test_blanks_separate_columns_as_numpy_writes_them(comments, tmp_path):
    np.savetxt(tmp_path / "cell.dat", TABLE, header="time_s voltage_V current_A", comments=comments, fmt="%10.6f")
    same(read(tmp_path / "cell.dat"))


def life(sign: float = -1.0) -> pd.DataFrame:
    """Three cycles of charge, rest, discharge and rest on one clock; the cell fades."""
    parts = []
    for cycle in range(3):
        fade, start_s = 1.0 - 0.1 * cycle, 9000.0 * cycle
        charge = Samples(start_s + np.arange(0.0, 3600.0, 60.0), np.linspace(3.4, 4.2, 60), np.full(60, sign * fade))
        load = Samples(start_s + 3700.0 + fade * RECORD.time_s, RECORD.voltage_V, -sign * RECORD.current_A)
        parts += [table_of(charge, cycle=cycle + 1), table_of(load, cycle=cycle + 1)]
    return pd.concat(parts, ignore_index=True)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("numbered", [True, False])
def test_the_discharges_of_a_life_are_found_between_the_charges(sign, numbered, tmp_path):
    table = life(sign)
    (table if numbered else table.drop(columns="cycle")).to_csv(tmp_path / "life.csv", index=False)
    discharges = read_discharges(tmp_path / "life.csv")
    assert [discharge.meta["cycle"] for discharge in discharges] == [1, 2, 3]
    for cycle, discharge in enumerate(discharges):
        np.testing.assert_allclose(discharge.time_s, (1.0 - 0.1 * cycle) * RECORD.time_s, atol=1e-9)
        np.testing.assert_allclose(discharge.current_A, RECORD.current_A)


def test_braking_at_once_does_not_end_a_discharge_and_a_charge_in_small_steps_does():
    minute_s = np.mod(np.arange(0.0, 6000.0, 5.0), 60.0)
    drive_A = np.where(minute_s < 15.0, 6.0, np.where(minute_s < 25.0, -4.0, 0.0))
    steps_A = np.where(minute_s < 25.0, -2.0, 0.0)  # each returns 1 % of what is drawn in all
    rest_A = np.zeros(100)
    current_A = np.concatenate([np.full(500, -2.0), rest_A, drive_A, rest_A, steps_A, rest_A, drive_A, rest_A])
    time_s = 5.0 * np.arange(len(current_A))
    table = pd.DataFrame({"time_s": time_s, "voltage_V": 3.7 - 0.02 * current_A, "current_A": current_A})
    discharges = read_discharges(table, discharge_is_negative=False)
    assert len(discharges) == 2
    for discharge in discharges:
        assert np.count_nonzero(discharge.current_A == 6.0) == np.count_nonzero(drive_A == 6.0)


def test_columns_and_units_can_be_stated():
    columns = {"x": RECORD.time_s / 60.0, "Voltage 1": 1e3 * RECORD.voltage_V, "Voltage 2": 0.0, "I, mean": RECORD.current_A}
    table = pd.DataFrame(columns)
    columns = {"time": "x", "voltage": "Voltage 1", "current": "I, mean"}
    same(read(table, columns=columns, units={"time": "min", "voltage": "mV"}))
    for options, message in (
        ({"columns": columns | {"time": "y"}}, "there is no column 'y' for the time among x, Voltage 1"),
        ({"columns": {"energy": "x"}}, r"columns knows time, date, .*, got energy"),
    ):
        with pytest.raises(ValueError, match=message):
            read_discharges(table, **options)


def test_a_temperature_that_is_logged_more_seldom_is_interpolated():
    warming_C = 24.0 + RECORD.time_s / 200.0
    seldom_C = np.where(np.arange(len(TABLE)) % 5 == 1, warming_C, np.nan)
    discharge = read(TABLE.assign(temperature_C=seldom_C))
    np.testing.assert_allclose(discharge.temperature_C[1:-5], warming_C[1:-5], atol=1e-3)
    assert read(TABLE.assign(temperature_C=np.nan)).temperature_C is None  # a sensor that was not connected


def test_discharges_whose_charges_are_not_logged_need_a_number():
    parts = [TABLE.assign(voltage=TABLE["voltage"] - 0.01 * n) for n in (1, 2)]
    numbered = [part.assign(cycle=n) for n, part in enumerate(parts)]
    assert [discharge.meta["cycle"] for discharge in read_discharges(pd.concat(numbered))] == [0, 1]
    parts[1]["time"] += 9000.0
    numbered[1]["time"] += 9000.0
    assert [discharge.meta["cycle"] for discharge in read_discharges(pd.concat(numbered))] == [0, 1]
    # of which battery-calibrate says that more is drawn
    assert read(pd.concat(parts, ignore_index=True)).loaded_part(2.7).time_s[-1] < RECORD.time_s[-1]


def test_dates_are_read_as_they_are_written(tmp_path):
    expected_s = np.floor(RECORD.time_s) + 0.25 * (RECORD.time_s > 100.0)  # of which those of whole seconds have no fraction
    times = [pd.Timestamp("2026-02-01 23:50") + pd.Timedelta(seconds=float(time_s)) for time_s in expected_s]
    to_summer = pd.Timestamp("2026-03-29 00:50") - times[0]
    berlin, summer = (
        [(time + shift).tz_localize("UTC").tz_convert("Europe/Berlin").isoformat() for time in times]
        for shift in (pd.Timedelta(0), to_summer)
    )
    written = {
        "ISO": [time.isoformat() for time in times],
        "ISO with a zone": berlin,
        "the clock is put forward": summer,
        "day first": [time.strftime("%d/%m/%Y %H:%M:%S.%f") for time in times],
        "day first, points": [time.strftime("%d.%m.%Y %H:%M:%S.%f") for time in times],
        "month first": [time.strftime("%m/%d/%Y %I:%M:%S.%f %p") for time in times],
        "a clock, where hours are thought of": [clock(time_s) for time_s in expected_s],
    }
    for name, column in written.items():
        TABLE.drop(columns="time").assign(**{"Time (h)": column}).to_csv(tmp_path / "cell.csv", index=False)
        np.testing.assert_allclose(read(tmp_path / "cell.csv").time_s, expected_s, atol=1e-6, err_msg=name)


CUT_SHORT = gzip.compress(b"time_s,voltage_V,current_A\n" + 200_000 * b"1,4.1,2\n", mtime=0)[:-100]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.csv", b"", "is empty"),
        ("header.csv", b"time_s,voltage_V,current_A\n", "no rows below the header"),
        ("text.txt", b"Dear all,\nplease find the data attached.\n", "no rows below the header"),
        ("cut.csv.gz", CUT_SHORT, "damaged"),
        ("no.csv.gz", b"time_s,voltage_V,current_A\n", "damaged"),
        ("picture.csv", b"\x89PNG\x00\x00\x0dIHDR", "is a picture, and no table"),
        ("report.txt", b"%PDF-1.7\n1 0 obj\n", "is a PDF, and no table"),
        ("page.csv", b"\n<!DOCTYPE HTML>\n<html><body>404 1 2 3", "is a page of the web"),
        ("stored.csv", b"version https://git-lfs.github.com/spec/v1\nsize 12345\n", "git lfs pull fetches"),
        ("cell.parquet", b"PAR1", "damaged, or no Parquet"),
        ("cell.mat", b"MATLAB", "damaged"),
        ("cell.h5", b"\x89HDF\x00\x00\x00\x01", "binary.*Export the records as CSV"),
        ("cell.xls", b"\xd0\xcf\x11\xe0\x00\x00\x00\x01", "binary.*a workbook as .xlsx"),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}.*{message}") as caught:
        read_discharges(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_the_sign_can_be_stated_and_then_is_not_told(tmp_path):
    path = tmp_path / "cell.csv"
    TABLE.to_csv(path, index=False)
    same(read(path, discharge_is_negative=True))
    same(read_discharge_csv(path, discharge_is_negative=True))
    TABLE[LOADED].to_csv(path, index=False)
    for read_wrongly in (read_discharges, read_discharge_csv):
        with pytest.raises(ValueError, match=r"no discharge.*sign of the current"):
            read_wrongly(path, discharge_is_negative=False)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_sign_of_a_random_load_is_told_from_its_steps(sign, seed):
    # of which parts may have a voltage that rises while charge is drawn
    walk_A = np.repeat(np.random.default_rng(seed).choice(np.arange(0.5, 5.0, 0.5), 20), 300)
    record = simulate(walk_A, 7000.0, 0.12, load_unit="current", thermal=True)
    part = pd.DataFrame({"t": record.time_s, "U": record.voltage_V, "I": sign * record.current_A})[900:2100]
    (discharge,) = read_discharges(part)
    np.testing.assert_array_equal(discharge.current_A, walk_A[900:2100])


def test_binary_files_of_neware_and_biologic_go_by_the_names_of_its_readers(tmp_path, monkeypatch):
    neware, biologic = types.ModuleType("NewareNDA"), types.ModuleType("galvani.BioLogic")
    table = pd.DataFrame(named("Time", "Voltage", "Current(mA)", "T1", (1.0, 1.0, -1e3)) | {"Cycle": 1})
    table = table.assign(Step=np.where(LOADED, 2, 1), Status=np.where(LOADED, "CC_DChg", "Rest")).drop(columns="T1")

    def read_nda(path, log_level):
        warnings.warn("this will change in pandas 4", FutureWarning, stacklevel=2)  # which is no matter of who reads a record
        return table.assign(Timestamp=pd.Timestamp("2026-02-28"))

    neware.read = read_nda
    records = np.rec.fromarrays([RECORD.time_s, -1e3 * RECORD.current_A, RECORD.voltage_V], names="time/s,I/mA,Ewe/V")
    biologic.MPRfile = lambda stream: types.SimpleNamespace(data=records)
    monkeypatch.setitem(sys.modules, "NewareNDA", neware)
    monkeypatch.setitem(sys.modules, "galvani", types.ModuleType("galvani"))
    monkeypatch.setitem(sys.modules, "galvani.BioLogic", biologic)
    for name in ("c.nda", "c.mpr"):
        (tmp_path / name).write_bytes(b"x")
        same(read(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "module", "words"), [("c.nda", "NewareNDA", "Neware"), ("c.mpr", "galvani.BioLogic", "BioLogic")]
)
def test_and_need_an_extra(name, module, words, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ImportError, match=rf"{words}.*battery_env\[cyclers\]"):
        read_discharges(tmp_path / name)


CELLS = st.one_of(st.floats(width=32).map(str), st.sampled_from(["", "NaN", "4.1", "2", "-2", "0:10", "x", "1e400", '"']))


@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=300),
        st.text(max_size=300).map(lambda text: text.encode("utf-8", errors="replace")),
        st.lists(st.lists(CELLS, max_size=7).map(",".join), max_size=12).map(
            lambda rows: "\n".join(["time_s,voltage_V,current_A,temperature_C,cycle,step,state", *rows]).encode()
        ),
    )
)
def test_whatever_a_file_holds_it_is_read_or_refused_in_words(tmp_path, content):
    (tmp_path / "any.csv").write_bytes(content)
    try:
        discharges = read_discharges(tmp_path / "any.csv")
    except ValueError as error:
        assert "any.csv: " in str(error) and all(map(str.strip, str(error).splitlines()))
    else:
        assert all(discharge.charge_C > 0.0 for discharge in discharges)


@pytest.mark.parametrize("source", [np.zeros((9, 3)), [pd.DataFrame()], None])
def test_what_is_neither_table_nor_file_is_refused(source):
    with pytest.raises(TypeError, match=f"DataFrame or the path of a file, got {type(source).__name__}"):
        read_discharges(source)
