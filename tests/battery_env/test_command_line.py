import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import fields, replace
from io import StringIO
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest

import battery_env
from battery_env import Calibration, Discharge, PolicyEstimator, Settings, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, CellParameters, initial_state, simulate
from battery_env.electrochemistry.model_error import CORRELATION_SHARE
from battery_env.estimates.findings import Reason
from battery_env.estimators.cell_fit import read_cell
from battery_env.lab.calibrate import calibrate as calibrated
from battery_env.lab.command_line import calibrate as command
from battery_env.lab.settings import SettingsOptions
from battery_env.lab.sources import find_sources
from battery_env.loads import constant
from battery_env.records import Samples
from tests.records import recorded, table_of
from tests.sweeps import sweep
from tests.tables import RECORD
from tests.terminal import write


def names_in(folder: Path) -> set[str]:
    """Those that are shown, without the lock."""
    return {path.name for path in folder.iterdir() if not path.name.startswith(".")}


def test_calibrates_a_bundled_discharge_and_writes_what_it_found(tmp_path, terminal):
    folder = tmp_path / "new" / "folder"
    shown = terminal.shows("B0005:100", "--out", folder)
    assert "settled" in shown and "yes" in shown and "measured at" in shown and "remaining" not in shown
    assert "1.486 Ah   the capacity to 2.7 V" in shown and "state of health" not in shown
    assert names_in(folder) == {"estimate.csv", "estimate.jsonl", "B0005_100_voltage.csv", "B0005_100_voltage.png"}
    (row,) = pd.read_csv(folder / "estimate.csv").to_dict(orient="records")
    assert row["q_mobile_C"] == pytest.approx(5736.0, abs=5.0)
    assert row["capacity_Ah"] == row["drawn_Ah"] == pytest.approx(1.4857, abs=1e-4) and np.isnan(row["state_of_health"])
    assert row["predicted_eod_time_s"] == pytest.approx(row["measured_eod_time_s"], rel=0.01)
    assert row["settled"] and row["cycle"] == 100
    voltages = pd.read_csv(folder / "B0005_100_voltage.csv")
    error_V = voltages["model_V"] - voltages["voltage_V"]
    assert np.sqrt((error_V**2).mean()) == pytest.approx(row["voltage_rmse_V"])
    assert (folder / "B0005_100_voltage.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_of_constants_takes_the_place_of_the_new_cell(tmp_path, terminal):
    cell = NEW_CELL.replace(q_mobile=7000.0, kn=500.0).to_json(tmp_path / "cell.json")
    shown = terminal.shows(write(RECORD, tmp_path / "record.csv"), "--cell", cell)
    fit, record = Settings(cell=CellParameters.from_json(cell)).calibrator(), RECORD.loaded_part(2.7)
    drawn_Ah = record.charge_C / 3600.0
    (given_Ah,) = fit.model.capacity_Ah([constant(record.current_A[-1], "current")], 2.7)
    assert f"{fit.estimate(record).q_mobile / 3600.0:.3f} Ah" in shown
    drawn = f"{drawn_Ah:.3f} Ah (sd {0.005 * drawn_Ah:.3f} Ah), drawn"
    assert f"{drawn_Ah / given_Ah:.3f}   {drawn}, of {given_Ah:.4g} Ah, what the given cell yields" in shown
    cell.write_text("{}")
    assert "cell.json holds no battery_env.CellParameters" in terminal.refuses("record.csv", "--cell", cell)


def test_constants_are_fitted_saved_and_used(tmp_path, terminal, capsys):
    out = tmp_path / "new" / "cell.json"
    assert command(["fit", "B0005:1", "B0005:84", "B0005:168", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(read_cell(out).summary()) and "B0005:168" in shown
    assert out.with_name("cell_fit.png").read_bytes().startswith(b"\x89PNG")
    row = terminal.row("B0006:100", "--cell", out)
    assert row["voltage_rmse_V"] < 0.03 and 0.7 < row["state_of_health"] < 0.9


def test_constants_of_cells_that_did_not_start_full_are_warned_of_whenever_they_are_used(tmp_path, capsys):
    out, record = tmp_path / "cell.json", tmp_path / "low.csv"
    low = initial_state(6000.0, soc=0.8)
    current_A = np.append(np.zeros(120), np.full(20_000, 2.0))
    write(simulate(current_A, 6000.0, 0.15, load_unit="current", thermal=True, initial=low, cut_off_V=2.6), record)
    assert command(["fit", str(record), "--out", str(out)]) == 3
    shown = capsys.readouterr()
    assert f"warning: {read_cell(out).doubt}" in shown.err.splitlines() and "at 4.00 V after" in shown.out
    assert command([str(record), "--cell", str(out)]) == 3
    assert f"warning: {out}: A full cell rests at 4.00 V" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["B0005:1", "--out", "cell.txt"], "cell.txt.json instead of cell.txt"),
        (["B0005:1", "--out", "old.json"], "old.json, old_fit.png would be replaced"),
        (["B0005:1", "--out", "old_fit.png/cell.json"], "old_fit.png is a file"),
        (["B0005:1", "notes.txt", "--out", "cell.json"], "notes.txt"),
        (["B0005", "--out", "cell.json"], "fit_cell takes 1 to 30 discharges, got 168"),
        (
            ["B0005:1", "half.csv", "--out", "cell.json"],
            "discharge half:1: its lowest voltage is 3.377 V, above the cut-off, 2.7 V",
        ),
    ],
)
def test_nothing_is_fitted_to_bad_input_and_nothing_is_overwritten(arguments, message, tmp_path, monkeypatch, terminal):
    monkeypatch.chdir(tmp_path)
    write(RECORD.until(1500.0), Path("half.csv"))
    for name in ("old.json", "old_fit.png"):
        Path(name).write_text("precious")
    Path("notes.txt").write_text("Dear all,\nplease find the data attached.\n")
    assert message in terminal.refuses("fit", *arguments)
    assert {path.name for path in tmp_path.iterdir()} == {"old.json", "old_fit.png", "notes.txt", "half.csv"}
    assert Path("old.json").read_text() == Path("old_fit.png").read_text() == "precious"


def test_what_remains_of_a_discharge_in_progress_is_wide_without_a_prior(tmp_path, terminal):
    path = write(RECORD.until(1500.0), tmp_path / "half.csv")
    shown = terminal.shows(path, status=3)
    assert "remaining" in shown and "Not settled: q_max is not known to 2 % yet" in shown
    assert "battery-calibrate forecast FILE --life" in shown and "Ah   so far" in shown
    alone = terminal.row(path, status=3)
    shown = terminal.shows(path, "--prior", 5460, 55, "--nominal", 2, "--out", tmp_path, status=3)
    assert "Not settled: q_max rests on its prior" in shown and "--life" not in shown
    assert "2.01 A to go on" in shown and "Ah), predicted, of 2 Ah" in shown
    (row,) = pd.read_csv(tmp_path / "estimate.csv").to_dict(orient="records")
    end_s, whole_Ah = RECORD.eod_time_s(2.7), RECORD.loaded_part(2.7).charge_C / 3600.0
    assert 1500.0 + row["remaining_s"] == pytest.approx(end_s, rel=0.02)
    assert np.isnan(row["measured_eod_time_s"]) and np.isnan(row["capacity_Ah"])
    assert row["predicted_capacity_Ah"] == pytest.approx(whole_Ah, rel=0.02)
    assert row["state_of_health"] == pytest.approx(row["predicted_capacity_Ah"] / 2.0)
    # a charge has the gain of the current sensor, too, which cancels from the end; the moment of load-on widens it a little
    by_end = row["sd_predicted_eod_time_s"] * row["future_current_A"] / 7200.0
    with_gain = np.hypot(by_end, Settings().current_gain_sd * row["state_of_health"])
    assert by_end < row["sd_state_of_health"] == pytest.approx(with_gain, rel=0.03)
    assert alone["settled"] is False and alone["measured_eod_time_s"] is None
    assert 1500.0 + alone["remaining_s"] == pytest.approx(end_s, rel=0.2)
    assert alone["sd_predicted_eod_time_s"] > 5.0 * row["sd_predicted_eod_time_s"]


def test_what_is_usual_of_its_size_counts_in_progress_alone_and_where_nothing_is_known(monkeypatch):
    told, calibrator = [], Settings.calibrator
    monkeypatch.setattr(Settings, "calibrator", lambda *given: told.append(given[-1]) or calibrator(*given))
    running, whole = RECORD.until(1500.0), RECORD.loaded_part(2.7)
    rest = [running.time_s[-1] + 60.0 * np.arange(1.0, 5.0), np.linspace(3.7, 3.8, 4), np.zeros(4)]
    columns = (running.time_s, running.voltage_V, running.current_A)
    paused = Discharge(*map(np.append, columns, rest))
    pulses = simulate(np.where(np.arange(1600) % 200 < 100, 4.0, 1.0), 7000.0, 0.12, load_unit="current", thermal=True)
    for record, options, counts in (
        (running, {}, True),
        (running, {"nominal_Ah": 2.0}, True),
        (running, {"prior_q_mobile_C": (5460.0, 55.0)}, False),
        (running, {"cell": NEW_CELL}, False),
        (paused, {}, True),
        (recorded(pulses), {}, True),
        (whole, {}, False),
    ):
        assert battery_env.calibrate(record, **options).method == "least-squares"
        assert (told[-1] is not None) == counts, options


def test_a_cell_of_more_than_twice_the_size_is_settled_at_1C_and_one_number_alone_at_C_over_30():
    options = {"load_unit": "current", "thermal": True, "cut_off_V": 2.69, "until": 80_000}
    fast, slow = (recorded(simulate(load_A, 18_000.0, 0.026, **options)) for load_A in (5.0, 0.3))
    found, alone = battery_env.calibrate(fast), battery_env.calibrate(slow)
    assert found.settled and found.q_mobile_C == pytest.approx(18_000.0, rel=0.01)
    assert found.r_o_ohm == pytest.approx(0.026, abs=2.0 * found.sd_r_o_ohm)
    assert alone.settled_q_mobile and not alone.settled_r_o and "only q_max settled: R_o is not" in repr(alone)
    assert "no   only q_max is" in str(alone) and "Not settled: R_o is not known to 30 %" in str(alone)


def test_a_load_that_varied_goes_on_as_so_far_and_that_is_said():
    pulses = simulate(np.where(np.arange(1600) % 200 < 100, 4.0, 0.0), 7000.0, 0.12, load_unit="current", thermal=True)
    found = battery_env.calibrate(recorded(pulses), prior_q_mobile_C=(7000.0, 70.0))
    assert " A on average, as so far, an assumption: the load varied" in str(found)


def test_the_end_is_as_unsure_as_the_voltage_at_the_cut_off():
    true = simulate(2.0, 6000.0, NEW_CELL.r_o, load_unit="current", thermal=True, cut_off_V=2.7)
    record = recorded(true, slice(1200))
    settings = Settings(cut_off_V=3.5, prior_q_mobile_C=(6000.0, 20.0))
    row = calibrated(record, settings).row()
    # the voltage measured pins the error down, until more charge is drawn
    left = np.exp(-2.0 * row["remaining_s"] / 6000.0 / CORRELATION_SHARE)
    off_V = 0.05 * np.sqrt(1.0 - left**2)
    early_s, late_s = np.interp([-3.5 - off_V, -3.5 + off_V], -true.voltage_V, true.time_s)
    expected_s = np.hypot(row["sd_q_mobile_C"] / 2.0, 0.5 * (late_s - early_s))
    # a cell that ends early has drifted less
    assert 0.6 * expected_s < row["sd_predicted_eod_time_s"] < expected_s
    assert expected_s > 5.0 * row["sd_q_mobile_C"] / 2.0
    assert calibrated(record, replace(settings, cut_off_V=2.7)).row()["sd_predicted_eod_time_s"] < 0.3 * expected_s


def test_simulated_data_without_mismatch_are_recovered_exactly(tmp_path):
    path = write(simulate(2.0, 6000.0, 0.15, load_unit="current"), tmp_path / "clean.csv")
    exact = {"thermal": False, "mismatch_V": 0.0, "cut_off_V": 3.0}
    (found,) = battery_env.calibrate(path, **exact)
    assert (found.q_mobile_C, found.r_o_ohm) == pytest.approx((6000.0, 0.15), rel=1e-6)


POLICY = ["B0005:100", "--method", "policy"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.csv"], "no file 'missing.csv'"),
        (["forcast", "x.csv"], "did you mean battery-calibrate forecast?"),
        (["B0005:0"], "B0005:1 .. B0005:168"),
        (["life.csv:4"], "life.csv:1 .. life.csv:3"),
        (["pictures"], "holds no file whose name ends as that of a record (.csv"),
        (["wild.csv"], "wild: the voltage falls to 0.00 V at 937.578 s"),
        (["B0005:1", "--cell", "missing.json"], "no file 'missing.json' for --cell"),
        (["B0005:1", "--prior", "1.9", "0.1"], "Ampere-hours"),
        (["B0005:1", "--cut-off", "4.3"], "all of the voltage under load lies below the cut-off of 4.3 V"),
        (["B0005:1", "--nominal", "0"], "the nominal capacity in Ah must be a positive, finite number, got 0.0"),
        ([*POLICY, "--prior", "5000", "50"], "the policy that comes with the package takes no prior_q_mobile_C"),
    ],
)
def test_bad_input_is_one_line_and_no_traceback(arguments, message, lab, tmp_path, monkeypatch, terminal):
    monkeypatch.chdir(tmp_path)
    Path("life.csv").symlink_to(lab / "life.csv")
    Path("pictures").mkdir()
    Path("pictures/cell.png").write_bytes(b"PNG")
    wild = replace(RECORD, voltage_V=np.where(np.arange(len(RECORD.time_s)) == 100, 0.0, RECORD.voltage_V))
    write(wild, Path("wild.csv"))
    assert message in terminal.refuses(*arguments)


@pytest.mark.parametrize("command_name", ["calibrate", "forecast", "fit"])
def test_a_cut_off_in_mV_is_called_that(command_name, tmp_path, terminal):
    out = ["--out", tmp_path / "cell.json"] if command_name == "fit" else []
    names = [] if command_name == "calibrate" else [command_name]
    refused = terminal.refuses(*names, "B0005:1", "--cut-off", "2700", *out)
    assert "a voltage of one cell, above 0 and up to 5.5 V, got 2700. Give the cut-off in V, not in mV:" in refused
    assert refused.endswith("battery-calibrate B0005:1 --cut-off 2.7")


def test_options_of_quantities_that_are_given_twice_are_merged_or_refused(tmp_path, terminal, capsys):
    path = tmp_path / "cell.csv"
    table = pd.DataFrame({"t": RECORD.time_s / 60.0, "U": 1e3 * RECORD.voltage_V, "I": RECORD.current_A})
    table.to_csv(path, index=False)
    merged = terminal.shows(path, "--units", "time=min", "--units", "voltage=mV", "--units", "time=min")
    assert merged == terminal.shows(path, "--units", "time=min,voltage=mV")
    for units in (["time=min,time=s"], ["time=min", "--units", "time=s"]):
        with pytest.raises(SystemExit, match="2"):
            command([str(path), "--units", *units])
        assert "the time cannot be both 'min' and 's': give one" in capsys.readouterr().err


def test_a_command_that_is_shown_keeps_what_was_stated_and_its_table_is_that_of_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    table = pd.DataFrame({"Zeit, ab": RECORD.time_s, "it's U": RECORD.voltage_V, "load": 1e3 * RECORD.current_A})
    table.to_csv("a cell.csv", index=False)
    assert command(["a cell.csv", "--units", "current=mA"]) == 2
    problem, *lines, asked, shown = capsys.readouterr().err.splitlines()
    assert problem == "error: a cell.csv: no column for the time, the voltage, the current."
    assert asked == "Name the columns, or their places:"
    assert command(["columns", "a cell.csv", "--out", "tester.toml"]) == 3
    assert capsys.readouterr().out.splitlines()[: len(lines)] == lines
    name, *arguments = shlex.split(shown)
    assert name == "battery-calibrate" and command(arguments) == 0


def test_a_command_that_is_shown_keeps_the_tester_and_works(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    table = pd.DataFrame({"alpha": RECORD.time_s, "beta": RECORD.voltage_V, "gamma": 1e3 * RECORD.current_A})
    table.to_csv("a.csv", index=False)
    Path("mine.toml").write_text('[columns]\ntime = "alpha"\nvoltage = "beta"\ncurrent = "gamma"\n', encoding="utf-8")
    assert command(["a.csv", "--tester", "mine.toml"]) == 2
    shown = capsys.readouterr().err.splitlines()[-1]
    _, *arguments = shlex.split(shown)
    assert "mine.toml" in arguments and command(arguments) == 0


def test_a_folder_ends_with_how_its_cell_changed_and_names_what_is_written(tmp_path, terminal):
    shown = terminal.shows("B0005:1", "B0005:100", "--out", tmp_path / "r")
    first, last = battery_env.calibrate("B0005:1")[0], battery_env.calibrate("B0005:100")[0]
    assert f"q_max {first.shown('q_mobile_C', with_unit=False)} -> {last.shown('q_mobile_C')}, 10 s resistance" in shown
    assert "2 of 2 settled" in shown
    named = shown.rpartition("written to ")[2].partition(": ")[2].strip().split(", ")
    assert sorted(named) == sorted(each.name for each in (tmp_path / "r").iterdir() if each.suffix in (".csv", ".png"))


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit, match="0"):
        command(["--version"])
    assert capsys.readouterr().out == f"battery_env {battery_env.__version__}\n"


@pytest.mark.parametrize(
    ("first", "more", "reason"),
    [(0, {}, "starts at 3.94 V"), (400, {"initial_soc": "rest"}, "does not start with a minute at rest")],
)
def test_no_capacity_is_stated_where_the_cell_did_not_start_full(first, more, reason):
    load_A = np.append(np.zeros(120), np.full(3000, 2.0))
    start = initial_state(6000.0, soc=0.7)
    low = simulate(load_A, 6000.0, 0.15, load_unit="current", thermal=True, initial=start, cut_off_V=2.65)
    found = battery_env.calibrate(recorded(low, slice(first, None)), nominal_Ah=2.0, **more)
    assert found.drawn_Ah > 0.9 and reason in found.reason
    assert np.isnan([found.capacity_Ah, found.predicted_capacity_Ah, found.state_of_health]).all()
    assert "Ah   to 2.7 V; not the capacity, as not all of the charge is known" in str(found)
    assert "state of health          not known" in str(found)


@pytest.mark.parametrize("load_A", [1.5, 3.0])
def test_a_doubt_about_the_start_stands_behind_the_estimates_own_reason_and_is_one_about_the_charge(load_A):
    record = simulate(np.full(20_000, load_A), 6000.0, 0.2, load_unit="current", thermal=True, cut_off_V=2.65)
    stated, unknown = (battery_env.calibrate(recorded(record), initial_soc=each) for each in (1.0, "rest"))
    assert unknown.reason == f"{stated.reason} {Reason.START_UNKNOWN.text}".strip()
    assert not unknown.settled and not unknown.settled_q_mobile and unknown.settled_r_o == stated.settled_r_o
    assert unknown.r_o_ohm == pytest.approx(0.2, rel=0.01) and np.isnan(unknown.capacity_Ah)


def test_no_capacity_is_stated_where_the_current_sensor_fails():
    current_A = RECORD.current_A.copy()
    current_A[60:100] = 0.0
    found = battery_env.calibrate(Discharge(RECORD.time_s, RECORD.voltage_V, current_A), nominal_Ah=2.0)
    assert "the voltage does not follow" in found.reason and np.isnan([found.capacity_Ah, found.state_of_health]).all()


def test_what_is_drawn_after_the_cut_off_is_told():
    time_s = np.append(RECORD.time_s, RECORD.time_s + RECORD.time_s[-1] + 100.0)  # too soon for a charge between
    columns = (np.append(column, column) for column in (RECORD.voltage_V, RECORD.current_A))
    with pytest.warns(UserWarning, match="Ah more are drawn after the cut-off at") as warned:
        assert np.isnan(battery_env.calibrate(Discharge(time_s, *columns)).capacity_Ah)
    assert warned[0].filename == __file__


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Path:
    """A folder as it grows in a laboratory: a life, a single RECORD, two of one name, and what cannot be used."""
    folder = tmp_path_factory.mktemp("lab")
    life = [
        pd.DataFrame({"cycle": n, "Time(s)": each.time_s, "Voltage(V)": each.voltage_V, "Current(A)": -each.current_A})
        for n, each in enumerate(load_nasa_discharges("B0005")[::60], start=1)
    ]
    pd.concat(life).to_csv(folder / "life.csv", index=False)
    write(RECORD, folder / "cell.csv")
    write(RECORD.until(1500.0), folder / "cell.csv.gz")
    (folder / "notes.txt").write_text("Dear all,\nplease find the data attached.\n")
    (folder / "broken.parquet").write_bytes(b"PAR1")
    (folder / "picture.png").write_bytes(b"PNG")
    pd.DataFrame({"battery_id": ["life"]}).to_csv(folder / "cycles.csv", index=False)
    return folder


def test_the_second_file_of_a_folder_comes_before_the_tenth(tmp_path):
    for name in ("cell2/c10.csv", "cell2/c9.csv", "cell10/1.csv", "cell2/c01.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [Path(source.path).relative_to(tmp_path).as_posix() for source in find_sources([str(tmp_path)])]
    assert names == ["cell2/c01.csv", "cell2/c9.csv", "cell2/c10.csv", "cell10/1.csv"]


def test_a_folder_becomes_one_table_and_what_cannot_be_used_stops_nothing(lab, tmp_path, capsys):
    assert command([str(lab), "--out", str(tmp_path), "--nominal", "1.9"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("error: ") == 2 and "broken.parquet" in captured.err and "notes.txt" in captured.err
    assert "7 discharges: 4 settled, 1 not settled, 2 refused" in captured.out
    table = pd.read_csv(tmp_path / "estimate.csv")
    records = ["broken", "cell", "cell_2", "life_001", "life_002", "life_003", "notes"]
    assert list(table["record"]) == records
    assert list(table["error"].notna()) == list(table["q_mobile_C"].isna()) == [True, *5 * [False], True]
    life = table[table["cell"] == "life"]
    assert list(life["cycle"]) == [1, 2, 3] and (np.diff(life["state_of_health"]) < -0.05).all()
    kinds = [f"{name}_voltage.{kind}" for name in records[1:6] for kind in ("csv", "png")]
    assert names_in(tmp_path) == {*kinds, "estimate.csv", "estimate.jsonl", "life.png"}


@pytest.mark.parametrize("given", [["cells"], ["cells/B7", "cells/B18"]])
def test_each_folder_of_records_is_a_cell(given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("B7/001", "B7/002", "B18/001", "B18/old/001", ".cache/001"):
        file = Path("cells", f"{name}.csv")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    cells = {"B7_001": "B7", "B7_002": "B7", "B18_001": "B18", "B18_old_001": "B18/old"}
    assert {source.stem: source.cell for source in find_sources(given)} == cells


@pytest.fixture(scope="module")
def fleet(lab, tmp_path_factory):
    """Calibrate several files and return their rows as they are printed, and the bytes of all results."""

    def calibrate_all(*more: str) -> tuple[str, dict[str, bytes]]:
        out = tmp_path_factory.mktemp("fleet")
        records = [str(lab / name) for name in ("notes.txt", "life.csv:2", "cell.csv")]
        with matplotlib.rc_context(), redirect_stdout(StringIO()) as printed:
            # as in the other processes: progpy, which other tests import, changes the settings
            matplotlib.rcdefaults()
            assert command([*records, "--json", "--out", str(out), *more]) == 2
        return printed.getvalue(), {path.name: path.read_bytes() for path in out.iterdir() if path.suffix != ".lock"}

    return calibrate_all


@pytest.fixture(scope="module")
def one_after_the_other(fleet):
    return fleet()


@pytest.mark.parametrize("where", sweep("processes", "cluster"))
@pytest.mark.attacks
def test_a_fleet_side_by_side_is_the_same_as_one_after_the_other(where, fleet, one_after_the_other, request):
    chosen = ["--jobs", "2"]
    if where == "cluster":
        chosen = ["--scheduler", request.getfixturevalue("dask_cluster").scheduler_address]
    printed, written = fleet(*chosen)
    assert (printed, written) == one_after_the_other
    assert printed.count("\n") == 3 and "life_002_voltage.png" in written


def test_a_cluster_needs_an_extra_and_a_scheduler(monkeypatch, terminal):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    assert "no Dask scheduler at 'nonsense'" in terminal.refuses("B0005:1", "--scheduler", "nonsense")
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "battery_env[cluster]" in terminal.refuses("B0005:1", "--scheduler", "tcp://127.0.0.1:1")


def test_results_among_the_records_are_no_records(tmp_path, terminal):
    write(RECORD, tmp_path / "cell.csv")
    write(RECORD, tmp_path / "own_voltage.csv")  # a record of this name has no figure beside it
    terminal.shows(tmp_path, "--out", tmp_path)
    assert {"estimate.csv", "life.png", "own_voltage_voltage.csv"} < names_in(tmp_path)
    assert [source.stem for source in find_sources([str(tmp_path)])] == ["cell", "own_voltage"]


class TestInPython:
    def test_files_tables_and_discharges_say_the_same_as_on_the_command_line(self, tmp_path, terminal):
        path = Path(write(Samples(RECORD.time_s, RECORD.voltage_V, -RECORD.current_A), tmp_path / "cell.csv"))
        row = terminal.row(path, "--nominal", 2, "--method", "policy")
        options = {"nominal_Ah": 2.0, "method": "policy"}
        (of_file,), (of_table,) = (battery_env.calibrate(each, **options) for each in (path, pd.read_csv(path)))
        of_discharge = battery_env.calibrate(battery_env.read_discharges(path)[0], Settings(**options))
        for found in (of_file, of_table, of_discharge):
            assert isinstance(found, Calibration)
            known = pd.Series(found.row()).dropna()
            assert known.to_dict() == {name: row[name] for name in known.index}

    def test_cells_numbers_and_folders_are_found_as_on_the_command_line(self, lab, tmp_path, terminal):
        for source in ("B0005:100", f"{lab}/life.csv:2"):
            (found,) = battery_env.calibrate(source)
            assert repr(found).startswith(f"<discharge {found.cycle} ") and "\n" not in repr(found)
            assert str(found).splitlines()[1:] == terminal.shows(source).splitlines()[1:]
        shutil.copy(lab / "life.csv", tmp_path / "life.csv")
        (tmp_path / "damaged.csv").write_text("no record")
        with pytest.warns(UserWarning, match="It is left out: .*damaged.csv"):
            assert [each.cycle for each in battery_env.calibrate(tmp_path)] == [1, 2, 3]
        with pytest.raises(FileNotFoundError, match="no file 'B0099:1'; the bundled cells are given as"):
            battery_env.calibrate("B0099:1")

    def test_its_keywords_are_those_of_the_settings_and_one_that_there_is_not_is_told(self):
        assert set(SettingsOptions.__annotations__) == {field.name for field in fields(Settings)}
        for name, said in (("nominal", "did you mean nominal_Ah"), ("x", "give .*'cut_off_V'.*'ignore'")):
            with pytest.raises(TypeError, match=f"calibrate takes no '{name}': {said}"):
                battery_env.calibrate("B0005:100", **{name: 2.0})
        with pytest.raises(TypeError, match="Settings takes no 'nominal': did you mean nominal_Ah"):
            battery_env.Settings(nominal=2.0)


def test_the_temperature_is_the_first_one_measured_or_that_of_the_surroundings():
    temperature_C = np.interp(RECORD.time_s, RECORD.time_s[[0, -1]], [20.0, 60.0])
    r_o_ohm = [
        battery_env.calibrate(table_of(RECORD, **more))[0].r_o_ohm
        for more in ({"temperature_C": temperature_C}, *({"ambient temperature": each_C} for each_C in (20.0, 40.0)))
    ]
    assert r_o_ohm[0] == pytest.approx(r_o_ohm[1], rel=1e-3) and r_o_ohm[1] > r_o_ohm[2]


def test_many_samples_are_averaged_and_say_the_same():
    whole = RECORD.loaded_part(2.7)
    time_s = np.linspace(whole.time_s[0], whole.time_s[-1], 120_001)
    columns = [np.interp(time_s, whole.time_s, column) for column in (whole.voltage_V, whole.current_A, whole.temperature_C)]
    many, few = (battery_env.calibrate(Discharge(time_s[::n], *(each[::n] for each in columns))) for n in (1, 40))
    assert len(many.record.time_s) < many.samples / 30 and len(few.record.time_s) == few.samples
    assert many.q_mobile_C == pytest.approx(few.q_mobile_C, rel=2e-3)
    assert many.r_o_ohm == pytest.approx(few.r_o_ohm, rel=1e-2)


def test_a_reader_that_leaves_ends_it_in_silence():
    command = [sys.executable, "-m", "battery_env", "calibrate", "B0005:1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


class TestPolicies:
    def test_the_one_that_comes_with_the_package_is_followed_and_named(self, tmp_path, terminal):
        shown = terminal.shows(*POLICY, "--out", tmp_path)
        assert "calibrated by the policy that comes with the package" in shown and "nan" not in shown
        assert shown.count("   sd ") == 2 and "Not settled" not in shown
        (row,) = pd.read_csv(tmp_path / "estimate.csv").to_dict(orient="records")
        record = load_nasa_discharges("B0005")[99].loaded_part(2.7)
        assert row["q_mobile_C"] == pytest.approx(PolicyEstimator.pretrained(recorded=True).estimate(record).q_mobile)
        assert row["method"] == "policy" and row["sd_q_mobile_C"] < 100.0 and row["settled"]
