"""Calibrators on the real cells, on a few of their discharges."""

import json

import pandas as pd
import pytest

from battery_env import load_nasa_discharges
from benchmarks import cells


def configuration(file):
    return json.loads(file.read_text())["configuration"]


@pytest.mark.attacks
def test_over_the_life_of_a_cell_q_mobile_follows_its_capacity(tmp_path, capsys, monkeypatch):
    records = load_nasa_discharges("B0005")
    monkeypatch.setattr(cells, "load_nasa_discharges", lambda cell: [records[n] for n in (0, 60, 120, 167)])
    cells.main(["real_cells", "--cells", "B0005", "--jobs", "1", "--out", str(tmp_path)])
    whole = pd.read_csv(tmp_path / "discharges.csv")
    assert list(whole["cycle"]) == [1, 61, 121, 168] and whole["settled"].all()
    assert whole["q_mobile_C"].corr(whole["capacity_Ah"]) > 0.999
    assert (whole["eod_error_s"].abs() < 0.01 * whole["duration_s"]).all()
    assert (whole["voltage_rmse_V"] < whole["new_cell_voltage_rmse_V"]).all()
    assert len(pd.read_csv(tmp_path / "in_progress.csv")) == 3 * 3 * len(cells.SHARES)
    assert "Saha" in configuration(tmp_path / "discharges.json")["data"]
    for name in ("life.png", "voltages.png", "summary.md"):
        assert (tmp_path / name).stat().st_size > 0
    assert "| B0005" in capsys.readouterr().out


@pytest.mark.attacks
def test_fitted_constants_are_better_on_the_other_cell(tmp_path):
    cells.main(["fit_cell", "--every", "60", "--jobs", "1", "--out", str(tmp_path)])
    scores = pd.read_csv(tmp_path / "discharges.csv")
    assert len(scores) == 2 * 2 * 3
    rmse_V = scores.groupby(["cell", "method"])["voltage_rmse_V"].median()
    for trained, tested in cells.PAIRS:
        assert rmse_V[tested, f"fitted to {trained}"] < 0.9 * rmse_V[tested, "of the new cell"]
        assert (tmp_path / f"{trained}_on_{tested}.png").stat().st_size > 0
    progress = pd.read_csv(tmp_path / "in_progress.csv")
    nearly = progress[progress["settled"] & (progress["share"] >= 0.95)]
    assert len(nearly) >= 12 and (nearly["q_mobile_C"] / nearly["q_mobile_of_whole_C"] - 1.0).abs().max() < 0.05
    constants = pd.read_csv(tmp_path / "constants.csv")
    assert set(constants["fitted_to"]) == {"B0005", "B0006"} and (constants["sd"] <= constants["prior_sd"]).all()
