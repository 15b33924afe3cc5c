import json
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest

from battery_env.app import many
from battery_env.app.calibrate import Settings
from battery_env.app.calibrate import calibrate as calibrated
from battery_env.app.command_line import calibrate, main
from battery_env.calibration.policy import PolicyEstimator
from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, CellParameters, initial_state, simulate
from battery_env.estimators.cell_fit import fit_cell, read_cell
from battery_env.estimators.least_squares import LeastSquares


@pytest.fixture(scope="module")
def recorded() -> Discharge:
    return load_nasa_discharges("B0006")[99]


def write(record: Discharge, path: Path, sign: float = 1.0) -> str:
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": sign * record.current_A}
    pd.DataFrame(columns).to_csv(path, index=False)
    return str(path)


def fails(arguments: list[str], capsys: pytest.CaptureFixture) -> str:
    assert main(["calibrate", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    return captured.err


def test_calibrates_a_bundled_discharge_and_writes_what_it_found(tmp_path, capsys):
    assert main(["calibrate", "B0005:100", "--out", str(tmp_path / "new" / "folder")]) == 0
    shown = capsys.readouterr().out
    assert "settled" in shown and "yes" in shown and "measured at" in shown and "remaining" not in shown
    assert "1.486 Ah   the capacity to 2.7 V" in shown and "state of health" not in shown
    assert "40.3 degC   from 24.3 degC; the model ends at 26.2 degC" in shown
    folder = tmp_path / "new" / "folder"
    assert {path.name for path in folder.iterdir()} == {
        f"B0005_100_{kind}" for kind in ("estimate.csv", "estimate.parquet", "voltage.csv", "voltage.png")
    }
    (row,) = pd.read_csv(folder / "B0005_100_estimate.csv").to_dict(orient="records")
    assert row["q_mobile_C"] == pytest.approx(5631.0, abs=5.0)
    assert row["capacity_Ah"] == row["drawn_Ah"] == pytest.approx(1.4857, abs=1e-4) and np.isnan(row["state_of_health"])
    (same,) = pd.read_parquet(folder / "B0005_100_estimate.parquet").to_dict(orient="records")
    assert same["q_mobile_C"] == row["q_mobile_C"] and same["settled"] and same["cycle"] == 100
    assert row["predicted_eod_time_s"] == pytest.approx(row["measured_eod_time_s"], rel=0.01)
    voltages = pd.read_csv(folder / "B0005_100_voltage.csv")
    error_V = voltages["model_V"] - voltages["voltage_V"]
    assert np.sqrt((error_V**2).mean()) == pytest.approx(row["voltage_rmse_V"])
    assert (folder / "B0005_100_voltage.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_of_constants_takes_the_place_of_the_new_cell(recorded, tmp_path, capsys):
    path = write(recorded, tmp_path / "record.csv")
    cell = NEW_CELL.replace(q_mobile=7000.0, kn=500.0).to_json(tmp_path / "cell.json")
    assert main(["calibrate", path, "--cell", str(cell)]) == 0
    shown = capsys.readouterr().out
    fit = LeastSquares(cell=CellParameters.from_json(cell), thermal=True, mismatch_V=0.05, current_gain_sd=0.005)
    record = recorded.loaded_part(2.7)
    q_mobile = fit.estimate(record).q_mobile
    given_Ah = fit.model.capacity_Ah(record.current_A[-1], "current", 2.7, 7000.0)
    health = record.charge_C / 3600.0 / given_Ah
    assert f"{q_mobile:.0f} C" in shown
    assert (
        f"{health:.3f}   {record.charge_C / 3600.0:.3f} Ah, drawn, of {given_Ah:.4g} Ah, what the given cell yields" in shown
    )
    cell.write_text("{}")
    assert "cell.json holds no battery_env.CellParameters" in fails([path, "--cell", str(cell)], capsys)
    assert f"no file '{tmp_path / 'missing.json'}' for --cell" in fails(
        [path, "--cell", str(tmp_path / "missing.json")], capsys
    )


def test_a_future_current_is_that_of_a_discharge_in_progress_only(recorded):
    records = (recorded, recorded.until(2000.0))
    plain, slow = (
        [calibrated(each, Settings(cell=NEW_CELL, future_current_A=current_A)).row() for each in records]
        for current_A in (None, 0.5)
    )
    assert slow[0]["state_of_health"] == plain[0]["state_of_health"] and slow[0]["nominal_Ah"] == plain[0]["nominal_Ah"]
    assert slow[1]["nominal_Ah"] > 1.02 * plain[1]["nominal_Ah"]


def test_constants_are_fitted_saved_and_used(tmp_path, capsys):
    out = tmp_path / "new" / "cell.json"
    fitted = ["B0005:1", "B0005:84", "B0005:168"]
    assert main(["fit", *fitted, "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    known = load_nasa_discharges("B0005")
    fit = fit_cell([known[0], known[83], known[167]])
    assert read_cell(out) == fit and shown.startswith(fit.summary()) and "B0005:168" in shown
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert main(["calibrate", "B0006:100", "--cell", str(out), "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["voltage_rmse_V"] < 0.02 and 0.7 < row["state_of_health"] < 0.9


def test_constants_of_cells_that_did_not_start_full_are_warned_of_whenever_they_are_used(tmp_path, capsys):
    out, record = tmp_path / "cell.json", tmp_path / "low.csv"
    low = initial_state(6000.0, soc=0.8)
    current_A = np.append(np.zeros(120), np.full(20_000, 2.0))
    write(simulate(current_A, 6000.0, 0.15, load_unit="current", thermal=True, initial=low, cut_off_V=2.6), record)
    assert main(["fit", str(record), "--out", str(out)]) == 3
    shown = capsys.readouterr()
    assert f"warning: {read_cell(out).doubt}" in shown.err.splitlines() and "at 4.00 V after" in shown.out
    assert main(["calibrate", str(record), "--cell", str(out)]) == 0
    assert f"warning: {out}: A full cell rests at 4.00 V" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["B0005:1", "--out", "cell.txt"], "cell.txt.json instead of cell.txt"),
        (["B0005:1", "--out", "old.json"], "old.json, old.png would be replaced"),
        (["B0005:1", "--out", "old.png/cell.json"], "old.png is a file"),
        (["B0005:1", "missing.csv", "--out", "cell.json"], "no file 'missing.csv'"),
        (["B0005:1", "notes.txt", "--out", "cell.json"], "notes.txt"),
        (["B0005", "--out", "cell.json"], "fit_cell takes 1 to 30 discharges, got 168"),
        (["B0005:1", "--cut-off", "4.3", "--out", "cell.json"], "discharge 1 of 1"),
    ],
)
def test_nothing_is_fitted_to_bad_input_and_nothing_is_overwritten(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("old.json", "old.png"):
        Path(name).write_text("precious")
    Path("notes.txt").write_text("Dear all,\nplease find the data attached.\n")
    assert main(["fit", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error.splitlines()[-1] and error.splitlines()[-1].startswith("error: ")
    assert {path.name for path in tmp_path.iterdir()} == {"old.json", "old.png", "notes.txt"}
    assert Path("old.json").read_text() == Path("old.png").read_text() == "precious"


def test_says_what_remains_of_a_discharge_in_progress_and_that_it_is_not_settled(recorded, tmp_path, capsys):
    path = write(recorded.until(1500.0), tmp_path / "half.csv")
    assert main(["calibrate", path]) == 3
    shown = capsys.readouterr().out
    assert "remaining" in shown and "Not settled: q_mobile is not known to 2 % yet" in shown
    assert "give --prior" in shown and "--method kalman" in shown and "Ah   so far" in shown
    assert main(["calibrate", path, "--prior", "5460", "55", "--nominal", "2", "--out", str(tmp_path)]) == 3
    shown = capsys.readouterr().out
    assert "Not settled: q_mobile rests on its prior" in shown and "give --prior" not in shown and "2.01 A to go on" in shown
    (row,) = pd.read_csv(tmp_path / "half_estimate.csv").to_dict(orient="records")
    assert 1500.0 + row["remaining_s"] == pytest.approx(recorded.eod_time_s(2.7), rel=0.02)
    assert np.isnan(row["measured_eod_time_s"]) and np.isnan(row["capacity_Ah"])
    whole_Ah = recorded.loaded_part(2.7).charge_C / 3600.0
    assert row["predicted_capacity_Ah"] == pytest.approx(whole_Ah, rel=0.02)
    assert row["state_of_health"] == row["predicted_capacity_Ah"] / 2.0
    assert "Ah, predicted, of 2 Ah" in shown


def test_the_filter_predicts_a_discharge_in_progress_without_a_prior(recorded, tmp_path, capsys):
    path = write(recorded.until(1500.0), tmp_path / "half.csv")
    assert main(["calibrate", path, "--method", "kalman", "--json"]) == 3
    row = json.loads(capsys.readouterr().out)
    assert row["method"] == "kalman" and row["settled"] is False and row["measured_eod_time_s"] is None
    assert 1500.0 + row["remaining_s"] == pytest.approx(recorded.eod_time_s(2.7), rel=0.2)


def test_a_load_that_varied_is_forecast_at_its_mean_and_that_is_said(tmp_path, capsys):
    pulses = simulate(np.where(np.arange(1600) % 200 < 100, 4.0, 0.0), 7000.0, 0.12, load_unit="current", thermal=True)
    path = write(Discharge(pulses.time_s, pulses.voltage_V, pulses.current_A), tmp_path / "pulses.csv")
    assert main(["calibrate", path, "--prior-q", "7000", "70"]) == 3
    assert " A the mean current so far, an assumption: the load varied" in capsys.readouterr().out
    assert main(["calibrate", path, "--prior-q", "7000", "70", "--future-current", "4"]) == 3
    assert "4 A to go on" in capsys.readouterr().out


@pytest.mark.parametrize("parameters", [("q_mobile",), ("q_mobile", "r_o")])
def test_the_end_is_as_unsure_as_the_voltage_at_the_cut_off(parameters):
    true = simulate(2.0, 6000.0, NEW_CELL.r_o, load_unit="current", thermal=True, cut_off_V=2.7)
    record = Discharge(true.time_s[:1200], true.voltage_V[:1200], true.current_A[:1200])
    settings = Settings(parameters=parameters, cut_off_V=3.5, prior_q_mobile_C=(6000.0, 20.0))
    row = calibrated(record, settings).row()
    assert row["q_mobile_C"] == pytest.approx(6000.0, rel=1e-3)
    off_V = np.hypot(0.05, 2.0 * row["sd_r_o_ohm"]) if "r_o" in parameters else 0.05
    early_s, late_s = np.interp([-3.5 - off_V, -3.5 + off_V], -true.voltage_V, true.time_s)
    expected_s = np.hypot(row["sd_q_mobile_C"] / 2.0, 0.5 * (late_s - early_s))
    assert row["sd_predicted_eod_time_s"] == pytest.approx(expected_s, rel=0.02)
    assert expected_s > 5.0 * row["sd_q_mobile_C"] / 2.0
    assert calibrated(record, replace(settings, cut_off_V=2.7)).row()["sd_predicted_eod_time_s"] < 0.3 * expected_s


def test_a_discharge_in_progress_has_not_ended_in_a_pulse_before():
    current_A = np.where(np.arange(10_000) % 120 < 10, 6.0, 1.0)
    true = simulate(current_A, 6000.0, NEW_CELL.r_o - 0.03, load_unit="current", cut_off_V=3.0)
    for count in (3500, 3726):  # in a pause, in a pulse
        record = Discharge(true.time_s[:count], true.voltage_V[:count], true.current_A[:count])
        # the resistance of the new cell is too large, so that the model comes below the cut-off where the record does not
        row = calibrated(record, Settings(parameters=("q_mobile",), cut_off_V=3.0, prior_q_mobile_C=(6000.0, 10.0))).row()
        assert record.voltage_V.min() > 3.02 and np.isnan(row["measured_eod_time_s"])
        assert row["remaining_s"] == row["predicted_eod_time_s"] - record.time_s[-1] > 100.0
        assert row["predicted_capacity_Ah"] > row["drawn_Ah"] + 0.03


def test_one_parameter_can_be_held(capsys):
    assert main(["calibrate", "B0005:1", "--parameters", "r_o", "--isothermal"]) == 3
    shown = capsys.readouterr().out
    assert "held" in shown


def test_simulated_data_without_mismatch_are_recovered_exactly(tmp_path):
    trajectory = simulate(2.0, 6000.0, 0.15, load_unit="current")
    path = write(Discharge(trajectory.time_s, trajectory.voltage_V, trajectory.current_A), tmp_path / "clean.csv")
    arguments = ["calibrate", path, "--isothermal", "--mismatch", "0", "--cut-off", "3", "--out", str(tmp_path)]
    assert main(arguments) == 0
    (row,) = pd.read_csv(tmp_path / "clean_estimate.csv").to_dict(orient="records")
    assert (row["q_mobile_C"], row["r_o_ohm"]) == pytest.approx((6000.0, 0.15), rel=1e-6)


def test_results_are_only_replaced_when_asked(recorded, tmp_path, capsys):
    path = write(recorded, tmp_path / "cell.csv")
    (tmp_path / "cell_estimate.csv").write_text("precious")
    assert "would be replaced" in fails([path, "--out", str(tmp_path)], capsys)
    assert (tmp_path / "cell_estimate.csv").read_text() == "precious"
    assert main(["calibrate", path, "--out", str(tmp_path), "--force"]) == 0
    assert (tmp_path / "cell_estimate.csv").read_text() != "precious"


def test_the_sign_of_the_current_is_told_and_may_be_stated(recorded, tmp_path, capsys):
    path = write(recorded, tmp_path / "cell.csv", sign=-1.0)
    assert main(["calibrate", path]) == 0
    told = capsys.readouterr().out
    assert main(["calibrate", path, "--discharge-is-negative"]) == 0
    assert capsys.readouterr().out == told
    assert "--discharge-is-negative" in fails([path, "--discharge-is-positive"], capsys)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.csv"], "no file 'missing.csv'"),
        (["B0005:0"], "B0005:1 .. B0005:168"),
        (["B0006:169"], "B0006:1 .. B0006:168"),
        (["B0018:1"], "no file 'B0018:1'"),
        (["B0005:1", "--prior-q", "1.9", "0.1"], "Ampere-hours"),
        (["B0005:1", "--cut-off", "4.3"], "between load-on at 26.242 s and 4.3 V"),
        (["B0005:1", "--mismatch", "-1"], "mismatch_V"),
        (["B0005:1", "--current-gain-sd", "2"], "current_gain_sd is a share within 0 .. 1"),
        (["B0005:1", "--future-current", "-2"], "future_current_A must be finite and at least 0 A, got -2.0"),
        (["B0005:1", "--nominal", "0"], "the nominal capacity in Ah must be a positive, finite number, got 0.0"),
        (["B0005:1", "--ambient", "297"], "the ambient temperature must lie within -60 .. 100 degC, got 297.0"),
        (["B0005:1", "--cut-off", "nan"], "the cut-off must be a voltage above 0 V, got nan"),
    ],
)
def test_bad_input_is_one_line_and_no_traceback(arguments, message, capsys):
    assert message in fails(arguments, capsys)


@pytest.mark.parametrize("jobs", ["0", "-2", "many"])
def test_a_number_of_processes_that_cannot_be_is_refused(jobs, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", "B0005:1", f"--jobs={jobs}"])
    assert stopped.value.code == 2
    assert f"--jobs: expected a number of processes, 1 or more, or -1 for one a core, got '{jobs}'" in capsys.readouterr().err


def test_a_wild_voltage_is_refused_with_its_time(recorded, tmp_path, capsys):
    columns = (recorded.time_s, recorded.voltage_V.copy(), recorded.current_A)
    columns[1][100] = 0.0
    said = fails([write(Discharge(*columns), tmp_path / "cell.csv")], capsys)
    assert f"falls to 0.00 V at {recorded.time_s[100]:g} s" in said and "Remove these samples (1)" in said


@pytest.mark.parametrize("method", ["least-squares", "kalman"])
def test_no_capacity_is_stated_where_the_cell_did_not_start_full(method, tmp_path, capsys):
    load_A = np.append(np.zeros(120), np.full(3000, 2.0))
    start = initial_state(6000.0, soc=0.7)
    low = simulate(load_A, 6000.0, 0.15, load_unit="current", thermal=True, initial=start, cut_off_V=2.65)
    rest = Discharge(low.time_s, low.voltage_V, low.current_A)
    loaded = Discharge(low.time_s[400:], low.voltage_V[400:], low.current_A[400:])
    for record, more, word in (
        (rest, [], "starts at rest at 3.94 V"),
        (loaded, [], "starts under load at"),
        (rest, ["--initial-soc", "0.9"], "starts at rest at 3.94 V"),
        (loaded, ["--initial-soc", "rest"], "does not start with a minute at rest"),
    ):
        path = write(record, tmp_path / "cell.csv")
        arguments = ["calibrate", path, "--nominal", "2", "--method", method, *more]
        assert main([*arguments, "--json"]) == 3
        row = json.loads(capsys.readouterr().out)
        assert row["drawn_Ah"] > 0.9 and word in row["reason"]
        assert row["capacity_Ah"] is row["predicted_capacity_Ah"] is row["state_of_health"] is None
        assert main(arguments) == 3
        shown = capsys.readouterr().out
        assert "Ah   to 2.7 V; not the capacity, as not all of the charge is known" in shown
        assert "state of health          not known" in shown


@pytest.mark.parametrize("method", ["least-squares", "kalman"])
def test_nor_where_the_clock_jumps_under_load(method, recorded):
    after = recorded.time_s > recorded.load_on_time_s + 1200.0
    jumped = replace(recorded, time_s=recorded.time_s + 600.0 * after)
    lost = replace(
        recorded,
        **{
            name: np.delete(getattr(recorded, name), np.flatnonzero(after)[:20])
            for name in ("time_s", "voltage_V", "current_A", "temperature_C")
        },
    )
    plain, jumped_row, lost_row = (calibrated(each, Settings(method=method)).row() for each in (recorded, jumped, lost))
    assert np.isnan(jumped_row["capacity_Ah"]) and np.isnan(jumped_row["state_of_health"]) and not jumped_row["settled"]
    assert lost_row["settled"] and lost_row["capacity_Ah"] == pytest.approx(plain["capacity_Ah"], rel=1e-3)


@pytest.mark.parametrize("method", ["least-squares", "kalman"])
def test_a_rest_that_is_seldom_logged_moves_nothing_and_missing_samples_are_refused(method, recorded, tmp_path, capsys):
    plain = calibrated(recorded, Settings(method=method)).row()

    def with_rest(rest_s: list[float]) -> list[str]:
        columns = [
            np.append(values, column[2:])
            for values, column in (
                (rest_s, recorded.time_s),
                ([recorded.voltage_V[1]] * len(rest_s), recorded.voltage_V),
                ([0.0] * len(rest_s), recorded.current_A),
            )
        ]
        return [write(Discharge(*columns), tmp_path / "cell.csv"), "--method", method]

    assert main(["calibrate", *with_rest([-1800.0, -1200.0, -600.0]), "--json"]) == 0
    seldom = json.loads(capsys.readouterr().out)
    assert seldom["settled"] and not seldom["notes"]
    assert seldom["q_mobile_C"] == pytest.approx(plain["q_mobile_C"], rel=0.005)
    assert seldom["sd_q_mobile_C"] == pytest.approx(plain["sd_q_mobile_C"], rel=0.1)
    assert "samples are missing from -600 s, at rest, to" in fails(with_rest([-600.0]), capsys)


def test_what_is_drawn_after_the_cut_off_is_told(recorded, tmp_path, capsys):
    time_s = np.append(recorded.time_s, recorded.time_s + recorded.time_s[-1] + 100.0)  # too soon for a charge between
    columns = (np.append(column, column) for column in (recorded.voltage_V, recorded.current_A))
    path = write(Discharge(time_s, *columns), tmp_path / "two.csv")
    assert main(["calibrate", path, "--discharge-is-positive", "--json"]) == 0
    assert "Ah more are drawn after the cut-off at" in json.loads(capsys.readouterr().out)["notes"]


def test_large_cells_are_fitted_and_calibrated(tmp_path, capsys):
    load_A = np.append(np.zeros(60), np.full(4000, 2.0))
    small = simulate(load_A, 6000.0, 0.15, load_unit="current", thermal=True, cut_off_V=2.65)
    large = Discharge(small.time_s[::10], small.voltage_V[::10], 50.0 * small.current_A[::10])
    path = write(large, tmp_path / "large.csv")
    assert "at least 29" in (said := fails([path], capsys)) and "--cell" in said
    cell = tmp_path / "cell.json"
    assert main(["fit", path, "--out", str(cell)]) == 0
    capsys.readouterr()
    assert main(["calibrate", path, "--cell", str(cell), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["q_mobile_C"] == pytest.approx(300_000.0, rel=0.01)


def test_a_file_with_unknown_columns_lists_them_and_takes_them_from_the_command_line(recorded, tmp_path, capsys):
    path = tmp_path / "cell.csv"
    columns = {"t_min": recorded.time_s / 60.0, "a": 1e3 * recorded.voltage_V, "b": recorded.current_A}
    pd.DataFrame(columns).to_csv(path, index=False)
    assert "t_min, a, b" in fails([str(path)], capsys)
    given = ["--columns", "time=t_min,voltage=a,current=b", "--units", "voltage=mV,time=min"]
    assert calibrate([str(path), *given]) == 0
    assert "2.7 V, measured at" in capsys.readouterr().out


@pytest.fixture(scope="module")
def lab(tmp_path_factory, recorded) -> Path:
    """A folder as it grows in a laboratory: a life, a single discharge, two of one name, and what cannot be used."""
    folder = tmp_path_factory.mktemp("lab")
    life = [
        pd.DataFrame({"cycle": n, "Time(s)": each.time_s, "Voltage(V)": each.voltage_V, "Current(A)": -each.current_A})
        for n, each in enumerate(load_nasa_discharges("B0005")[::60], start=1)
    ]
    pd.concat(life).to_csv(folder / "life.csv", index=False)
    write(recorded, folder / "cell.csv")
    write(recorded.until(1500.0), folder / "cell.csv.gz")
    (folder / "notes.txt").write_text("Dear all,\nplease find the data attached.\n")
    (folder / "broken.parquet").write_bytes(b"PAR1")
    (folder / "picture.png").write_bytes(b"PNG")
    pd.DataFrame({"battery_id": ["life"]}).to_csv(folder / "cycles.csv", index=False)
    return folder


RECORDS = ["broken", "cell", "cell_2", "life_001", "life_002", "life_003", "notes"]


def test_a_folder_becomes_one_table_and_what_cannot_be_used_stops_nothing(lab, tmp_path, capsys):
    assert main(["calibrate", str(lab), "--out", str(tmp_path / "out"), "--nominal", "1.9"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("error: ") == 2 and "broken.parquet" in captured.err and "notes.txt" in captured.err
    assert "7 discharges: 4 settled, 1 not settled, 2 refused" in captured.out
    table = pd.read_csv(tmp_path / "out" / "estimate.csv")
    assert list(table["record"]) == RECORDS
    assert list(table["error"].notna()) == [True, False, False, False, False, False, True]
    assert (table["q_mobile_C"].notna() == table["error"].isna()).all()
    lives = table[table["cell"] == "life"]
    assert list(lives["cycle"]) == [1, 2, 3] and (np.diff(lives["state_of_health"]) < -0.05).all()
    pd.testing.assert_frame_equal(
        pd.read_parquet(tmp_path / "out" / "estimate.parquet")[["record", "q_mobile_C"]],
        table[["record", "q_mobile_C"]],
        check_dtype=False,
    )
    kinds = [f"{name}_voltage.{kind}" for name in RECORDS[1:6] for kind in ("csv", "png")]
    found = {path.name for path in (tmp_path / "out").iterdir()}
    assert found == {*kinds, "estimate.csv", "estimate.parquet", "life.png"}


def test_the_cycle_of_a_life_is_picked_by_its_number(lab, tmp_path, capsys):
    assert main(["calibrate", f"{lab}/life.csv:2", "--out", str(tmp_path), "--table-only"]) == 0
    assert "life_002: " in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"life_002_estimate.csv", "life_002_estimate.parquet"}
    assert main(["calibrate", f"{lab}/life.csv:3", "--out", str(tmp_path), "--table-only"]) == 0
    capsys.readouterr()
    assert "life.csv:1 .. " in fails([f"{lab}/life.csv:4"], capsys)
    assert "has one discharge, without a number" in fails([f"{lab}/cell.csv:4"], capsys)


@pytest.mark.parametrize("where", ["processes", "cluster"])
def test_a_fleet_side_by_side_is_the_same_as_one_after_the_other(where, lab, tmp_path, request, capsys):
    chosen = ["--jobs", "2"]
    if where == "cluster":
        chosen = ["--scheduler", request.getfixturevalue("dask_cluster").scheduler_address]
    one, many = tmp_path / "one", tmp_path / "many"
    records = [str(lab / name) for name in ("notes.txt", "cell.csv.gz", "life.csv:2", "cell.csv")]
    with matplotlib.rc_context():
        # as in the other processes: progpy, which other tests import, changes the settings
        matplotlib.rcdefaults()
        assert main(["calibrate", *records, "--json", "--out", str(one)]) == 2
        assert main(["calibrate", *records, "--json", "--out", str(many), *chosen]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 * len(records) and lines[: len(records)] == lines[len(records) :]
    written = {path.name: path.read_bytes() for path in one.iterdir()}
    assert written == {path.name: path.read_bytes() for path in many.iterdir()} and "cell_2_voltage.png" in written


class Loses(ThreadPoolExecutor):
    """Loses the worker of one call, and is slow with another one."""

    def submit(self, function, *arguments):
        if "life_002" in str(arguments):
            future = Future()
            future.set_exception(BrokenExecutor("the worker died"))
            return future
        return super().submit(self.slowly if "life_001" in str(arguments) else self.at_once, function, *arguments)

    @staticmethod
    def slowly(function, *arguments):
        time.sleep(0.2)
        return function(*arguments)

    @staticmethod
    def at_once(function, *arguments):
        return function(*arguments)


def test_a_lost_worker_stops_no_other_and_results_keep_their_order(lab):
    sources = many.find_sources([f"{lab}/life.csv"])
    with Loses(2) as executor:
        found = list(many.calibrate_all(sources, many.FileFormat(), Settings(), executor=executor))
    assert [each.record for each in found] == ["life_001", "life_002", "life_003"]
    assert [each.error for each in found] == ["", "life_002: BrokenExecutor: the worker died", ""]


def test_a_cluster_needs_an_extra_and_a_scheduler(monkeypatch, capsys):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    assert "no Dask scheduler at 'nonsense'" in fails(["B0005:1", "--scheduler", "nonsense"], capsys)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "battery_env[cluster]" in fails(["B0005:1", "--scheduler", "tcp://127.0.0.1:1"], capsys)


def test_existing_results_are_found_before_any_work_is_done(lab, tmp_path, capsys):
    (tmp_path / "life_017_voltage.csv").write_text("precious")
    assert "life_017_voltage.csv would be replaced" in fails([str(lab / "life.csv"), "--out", str(tmp_path)], capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["life_017_voltage.csv"]
    (tmp_path / "file").write_text("")
    assert "is a file" in fails(["B0005:1", "--out", str(tmp_path / "file")], capsys)


def test_results_among_the_records_are_no_records(recorded, tmp_path, capsys):
    write(recorded, tmp_path / "cell.csv")
    write(recorded, tmp_path / "own_voltage.csv")  # a record of this name has no figure beside it
    for results in ([], ["--out", str(tmp_path)], ["--force", "--out", str(tmp_path)], []):
        assert main(["calibrate", str(tmp_path), "--json", *results]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [json.loads(line)["record"] for line in lines] == ["cell", "own_voltage"]
    assert main(["calibrate", f"{tmp_path}/cell.csv", "--json", "--table-only", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "cell_estimate.csv").exists() and (tmp_path / "own_voltage_voltage.csv").exists()
    assert [Path(source.path).stem for source in many.find_sources([str(tmp_path)])] == ["cell", "own_voltage"]


def test_what_was_done_before_an_interruption_is_kept(lab, tmp_path, monkeypatch, capsys):
    def interrupted(discharge, settings):
        if discharge.meta["cycle"] == 2:
            raise KeyboardInterrupt
        return calibrated(discharge, settings)

    monkeypatch.setattr(many, "calibrate", interrupted)
    assert main(["calibrate", f"{lab}/life.csv", "--out", str(tmp_path), "--table-only"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert list(pd.read_csv(tmp_path / "life_estimate.csv")["record"]) == ["life_001"]


def test_a_folder_without_records_says_so(tmp_path, capsys):
    (tmp_path / "picture.png").write_bytes(b"PNG")
    assert "holds no file whose name ends as that of a record (.csv" in fails([str(tmp_path)], capsys)


def test_the_temperature_is_that_of_the_record_or_the_one_given(recorded, tmp_path, capsys):
    columns = {"time_s": recorded.time_s, "voltage_V": recorded.voltage_V, "current_A": recorded.current_A}
    temperature_C = np.interp(recorded.time_s, recorded.time_s[[0, -1]], [20.0, 60.0])
    pd.DataFrame(columns | {"temperature_C": temperature_C}).to_csv(tmp_path / "hot.csv", index=False)
    pd.DataFrame(columns | {"Ambient Temperature / degC": 40.0}).to_csv(tmp_path / "chamber.csv", index=False)
    rows = []
    for arguments in (["hot.csv"], ["hot.csv", "--ambient", "50"], ["chamber.csv"], ["chamber.csv", "--ambient", "10"]):
        assert main(["calibrate", str(tmp_path / arguments[0]), *arguments[1:], "--json"]) == 0
        captured = capsys.readouterr()
        rows.append(json.loads(captured.out))
        assert ("its temperature does not hold" in captured.err) == (len(rows) in (1, 2)) == ("does not" in rows[-1]["notes"])
    assert [round(row["ambient_C"]) for row in rows] == [20, 50, 40, 10]
    assert rows[0]["r_o_ohm"] > rows[2]["r_o_ohm"] + 0.001 > rows[1]["r_o_ohm"]


def test_many_samples_are_averaged_and_say_the_same(recorded, tmp_path, capsys):
    whole = recorded.loaded_part(2.7)
    time_s = np.linspace(whole.time_s[0], whole.time_s[-1], 120_001)
    columns = {"time_s": time_s} | {
        name: np.interp(time_s, whole.time_s, getattr(whole, name)) for name in ("voltage_V", "current_A", "temperature_C")
    }
    pd.DataFrame(columns).to_parquet(tmp_path / "dense.parquet")
    pd.DataFrame(columns).iloc[::40].to_parquet(tmp_path / "sparse.parquet")
    rows = []
    for name in ("dense", "sparse"):
        assert main(["calibrate", str(tmp_path / f"{name}.parquet"), "--json"]) == 0
        rows.append(json.loads(capsys.readouterr().out))
    assert rows[0]["averaged_over_s"] == 1.0 and rows[1]["averaged_over_s"] == 0.0
    assert rows[0]["q_mobile_C"] == pytest.approx(rows[1]["q_mobile_C"], rel=5e-4)
    assert rows[0]["r_o_ohm"] == pytest.approx(rows[1]["r_o_ohm"], rel=1e-3)


def test_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "battery_env", "calibrate", "B0005:1"], capture_output=True, text=True)
    assert done.returncode == 0 and "q_mobile" in done.stdout and done.stderr == ""


def test_the_filter_follows_the_measured_temperature_unless_another_one_is_stated(recorded):
    def r_o(temperature_C, **more):
        record = Discharge(recorded.time_s, recorded.voltage_V, recorded.current_A, temperature_C)
        return calibrated(record, Settings(method="kalman", **more)).row()["r_o_ohm"]

    warming_C = np.linspace(20.0, 40.0, len(recorded.time_s))
    measured, stated, held = (r_o(warming_C, **more) for more in ({}, {"ambient_C": 20.0}, {"thermal": False}))
    assert measured < stated and measured < held
    assert stated == r_o(None, ambient_C=20.0) and held == pytest.approx(r_o(None, ambient_C=20.0, thermal=False), rel=2e-3)


class TestPolicies:
    def test_the_one_that_comes_with_the_package_is_followed_and_named(self, tmp_path, capsys):
        assert main(["calibrate", "B0005:100", "--method", "policy", "--out", str(tmp_path)]) == 3
        shown = capsys.readouterr().out
        assert "calibrated by the policy that comes with the package" in shown and "nan" not in shown
        assert shown.count("   sd ") == 2 and "Not settled: Samples lie farther apart than the 2 s" in shown
        (row,) = pd.read_csv(tmp_path / "B0005_100_estimate.csv").to_dict(orient="records")
        record = load_nasa_discharges("B0005")[99].loaded_part(2.7)
        assert row["q_mobile_C"] == pytest.approx(PolicyEstimator.pretrained(recorded=True).estimate(record).q_mobile)
        assert row["method"] == "policy" and row["sd_q_mobile_C"] > 100.0 and not row["settled"]

    def test_one_parameter_has_its_own(self, capsys):
        assert main(["calibrate", "B0005:100", "B0005:101", "--method", "policy", "--parameters", "r_o"]) == 3
        shown = capsys.readouterr().out
        assert shown.count(f"q_mobile {NEW_CELL.q_mobile:5.0f} C  r_o") == shown.count(" sd ") == 2
        assert "calibrated by the policy that comes with the package" in shown

    def test_one_of_a_file_takes_its_place(self, tmp_path, capsys):
        file = tmp_path / "mine.onnx"
        for suffix in (".onnx", ".json"):
            content = files("battery_env.pretrained_policies").joinpath(f"BatteryVoltageQmax-v0{suffix}").read_bytes()
            file.with_suffix(suffix).write_bytes(content)
        arguments = ["B0005:100", "--method", "policy", "--policy", str(file)]
        assert main(["calibrate", *arguments, "--parameters", "q_mobile"]) == 3
        assert f"calibrated by the policy of {file}" in capsys.readouterr().out
        error = fails(arguments, capsys)
        assert "a policy of BatteryVoltageQmax-v0, which finds q_mobile, not q_mobile and r_o" in error

    @pytest.mark.parametrize(
        ("more", "message"),
        [
            (["--prior", "5000", "50"], "a policy takes no prior_q_mobile_C"),
            (["--ambient", "30"], "a policy takes no ambient_C"),
            (["--mismatch", "0.01"], "a policy takes no mismatch_V"),
            (["--initial-soc", "0.8"], "a policy takes no initial_soc"),
            (["--policy", "none.onnx"], "none.onnx"),
        ],
    )
    def test_what_a_policy_cannot_use_is_refused(self, more, message, capsys):
        assert message in fails(["B0005:100", "--method", "policy", *more], capsys)

    def test_a_policy_is_for_its_method(self, capsys):
        assert "a policy is for the method policy, got 'kalman'" in fails(
            ["B0005:100", "--method", "kalman", "--policy", "mine.onnx"], capsys
        )
