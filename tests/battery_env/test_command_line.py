import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from battery_env.__main__ import main
from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, CellParameters, simulate
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
    assert "1.486 Ah   the capacity to 2.7 V" in shown
    folder = tmp_path / "new" / "folder"
    assert {path.name for path in folder.iterdir()} == {
        f"B0005_100_{kind}" for kind in ("estimate.csv", "voltage.csv", "voltage.png")
    }
    (row,) = pd.read_csv(folder / "B0005_100_estimate.csv").to_dict(orient="records")
    assert row["q_mobile_C"] == pytest.approx(5631.0, abs=5.0)
    assert row["state_of_health"] == pytest.approx(row["q_mobile_C"] / 7600.0)
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
    fit = LeastSquares(cell=CellParameters.from_json(cell), thermal=True, mismatch_V=0.05)
    q_mobile = fit.estimate(recorded.loaded_part(2.7)).q_mobile
    assert f"{q_mobile:.0f} C" in shown and f"{q_mobile / 7000.0:.3f}   q_mobile / 7000 C" in shown
    cell.write_text("{}")
    assert "cell.json holds no battery_env.CellParameters" in fails([path, "--cell", str(cell)], capsys)
    assert "missing.json" in fails([path, "--cell", str(tmp_path / "missing.json")], capsys)


def test_says_what_remains_of_a_discharge_in_progress_and_that_it_is_not_settled(recorded, tmp_path, capsys):
    path = write(recorded.until(1500.0), tmp_path / "half.csv")
    assert main(["calibrate", path]) == 0
    shown = capsys.readouterr().out
    assert "remaining" in shown and "Not settled: q_mobile is not known to 2 % yet" in shown
    assert "give --prior-q" in shown and "ExtendedKalmanFilter" in shown and "Ah   so far" in shown
    assert main(["calibrate", path, "--prior-q", "5460", "55", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "Not settled: q_mobile rests on its prior" in shown and "give --prior-q" not in shown and "2.01 A to go on" in shown
    (row,) = pd.read_csv(tmp_path / "half_estimate.csv").to_dict(orient="records")
    assert 1500.0 + row["remaining_s"] == pytest.approx(recorded.eod_time_s(2.7), rel=0.02)
    assert np.isnan(row["measured_eod_time_s"])


def test_a_load_that_varied_is_forecast_at_its_mean_and_that_is_said(tmp_path, capsys):
    pulses = simulate(np.where(np.arange(1600) % 200 < 100, 4.0, 0.0), 7000.0, 0.12, load_unit="current", thermal=True)
    path = write(Discharge(pulses.time_s, pulses.voltage_V, pulses.current_A), tmp_path / "pulses.csv")
    assert main(["calibrate", path, "--prior-q", "7000", "70"]) == 0
    assert " A the mean current so far, an assumption: the load varied" in capsys.readouterr().out
    assert main(["calibrate", path, "--prior-q", "7000", "70", "--future-current", "4"]) == 0
    assert "4 A to go on" in capsys.readouterr().out


def test_one_parameter_can_be_held(capsys):
    assert main(["calibrate", "B0005:1", "--parameters", "r_o", "--isothermal"]) == 0
    shown = capsys.readouterr().out
    assert "held" in shown and "state of health" not in shown


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


def test_negative_discharge_current_is_explained_and_can_be_flipped(recorded, tmp_path, capsys):
    path = write(recorded, tmp_path / "cell.csv", sign=-1.0)
    assert "--discharge-is-negative" in fails([path], capsys)
    assert main(["calibrate", path, "--discharge-is-negative"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.csv"], "no file 'missing.csv'"),
        (["B0005"], "B0005:1 .. B0005:168"),
        (["B0005:0"], "B0005:1 .. B0005:168"),
        (["B0006:169"], "B0006:1 .. B0006:168"),
        (["B0018:1"], "no file 'B0018:1'"),
        (["B0005:1", "--prior-q", "1.9", "0.1"], "Ampere-hours"),
        (["B0005:1", "--cut-off", "4.3"], "between load-on at 26.242 s and 4.3 V"),
        (["B0005:1", "--mismatch", "-1"], "mismatch_V"),
        (["B0005:1", "--current-gain-sd", "2"], "current_gain_sd is a share within 0 .. 1"),
        (["B0005:1", "--future-current", "-2"], "future_current_A must be finite and at least 0 A, got -2.0"),
    ],
)
def test_bad_input_is_one_line_and_no_traceback(arguments, message, capsys):
    assert message in fails(arguments, capsys)


def test_a_file_with_other_columns_lists_them(tmp_path, capsys):
    (tmp_path / "cell.csv").write_text("Test_Time(s),Voltage(V),Current(A)\n0,4.1,2\n")
    assert "Test_Time(s), Voltage(V), Current(A)" in fails([str(tmp_path / "cell.csv")], capsys)


def test_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "battery_env", "calibrate", "B0005:1"], capture_output=True, text=True)
    assert done.returncode == 0 and "q_mobile" in done.stdout and done.stderr == ""
