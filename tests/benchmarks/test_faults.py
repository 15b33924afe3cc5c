"""The comparison under faults on little work: one thing is wrong at a time, on the same discharges."""

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("progpy")

from battery_env.electrochemistry import NEW_CELL
from benchmarks import faults


@pytest.mark.parametrize("mismatch", [0.1, 0.2])
def test_faults_of_the_model_leave_ages_and_loads_as_they_are(mismatch):
    right, wrong = (faults.work(faults.Fault("", mismatch=value), ["q_mobile", "r_o"], 2) for value in (0.0, mismatch))
    np.testing.assert_array_equal(right.q_mobile, wrong.q_mobile)
    np.testing.assert_array_equal(right.r_o, wrong.r_o)
    for n in range(2):
        shared = min(right.samples[n], wrong.samples[n])
        np.testing.assert_array_equal(right.load_profile(n)[:shared], wrong.load_profile(n)[:shared])
    assert (right.factors == 1.0).all() and (wrong.factors != 1.0).all()


def test_the_held_parameter_is_ten_per_cent_worn():
    fault = next(fault for fault in faults.FAULTS.values() if fault.other_worn)
    data = faults.work(fault, ["q_mobile"], 3)
    assert (data.r_o == 1.1 * NEW_CELL.r_o).all() and len(set(data.q_mobile)) == 3
    data = faults.work(fault, ["r_o"], 3)
    assert (data.q_mobile == 0.9 * NEW_CELL.q_mobile).all() and len(set(data.r_o)) == 3


def test_tables_and_figure_are_written(tmp_path, monkeypatch, capsys):
    class Middle:
        @classmethod
        def load(cls, file, device):
            return cls()

        def predict(self, observation, deterministic=False):
            return np.zeros((len(observation), 2)), None

    model = tmp_path / "mine.zip"
    model.write_bytes(b"weights")
    monkeypatch.setattr(faults, "WINDOW_EVERY_S", 1200.0)
    monkeypatch.setitem(faults.ALGOS, "lac", Middle)
    monkeypatch.setattr(faults, "FAULTS", {name: faults.FAULTS[name] for name in ("none", "current +1 %")})
    faults.main(["--discharges", "2", "--policies", f"lac:{model}", "--out", str(tmp_path / "out")])
    results = pd.read_csv(tmp_path / "out" / "faults.csv")
    error = results.set_index(["calibrator", "fault", "parameter"])["second_half_mape_percent"].groupby(level=[0, 1, 2]).max()
    assert error["closed form", "none", "q_mobile"] < 1e-9 and error["closed form", "none", "r_o"] < 1e-9
    # the current scales R_o; charges are measured
    assert error["closed form", "current +1 %", "r_o"] == pytest.approx(100.0 * (1.0 - 1.0 / 1.01), rel=1e-6)
    for name in ("least squares", "Kalman filter"):
        assert error[name, "none", "q_mobile"] < 0.5 < error[name, "current +1 %", "q_mobile"] < 3.0
    text = (tmp_path / "out" / "faults.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "LAC mine" in text
    assert (tmp_path / "out" / "faults.png").stat().st_size > 0


@pytest.mark.parametrize("command", [["--discharges", "0"], ["--policies", "lac:nowhere.zip"], ["--policies", "model.zip"]])
def test_nonsense_on_the_command_line_is_refused(command, tmp_path):
    with pytest.raises(SystemExit):
        faults.main([*command, "--out", str(tmp_path)])
    assert not any(tmp_path.iterdir())
