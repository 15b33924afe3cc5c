"""The study of the real cells, on a few of their discharges."""

import json

import pandas as pd
import pytest

from battery_env.cells import load_nasa_discharges
from benchmarks import real_cells


@pytest.fixture
def few(monkeypatch):
    records = load_nasa_discharges("B0005")
    monkeypatch.setattr(real_cells, "load_nasa_discharges", lambda cell: [records[n] for n in (0, 60, 120, 167)])


def test_the_study_writes_tables_and_figures(few, tmp_path, capsys):
    real_cells.main(["--cells", "B0005", "--jobs", "1", "--out", str(tmp_path)])
    whole = pd.read_csv(tmp_path / "discharges.csv")
    assert list(whole["cycle"]) == [1, 61, 121, 168] and whole["settled"].all()
    assert whole["q_mobile_C"].corr(whole["capacity_Ah"]) > 0.999
    assert (whole["eod_error_s"].abs() < 0.01 * whole["duration_s"]).all()
    assert (whole["voltage_rmse_V"] < whole["new_cell_voltage_rmse_V"]).all()
    in_progress = pd.read_csv(tmp_path / "in_progress.csv")
    assert len(in_progress) == 3 * 3 * 3
    assert "Saha" in json.loads((tmp_path / "discharges.json").read_text())["configuration"]["data"]
    for name in ("life.png", "voltages.png", "summary.md"):
        assert (tmp_path / name).stat().st_size > 0
    assert "| B0005" in capsys.readouterr().out
