"""The test of fitted constants on another cell, on a few of its discharges."""

import json

import pandas as pd
import pytest

from benchmarks import fit_cell


def test_it_writes_tables_and_figures(tmp_path, capsys):
    fit_cell.main(["--every", "60", "--jobs", "1", "--out", str(tmp_path)])
    scores = pd.read_csv(tmp_path / "discharges.csv")
    assert len(scores) == 2 * 2 * 3
    rmse_V = scores.groupby(["cell", "constants"])["voltage_rmse_V"].median()
    for trained, tested in fit_cell.PAIRS:
        assert rmse_V[tested, f"fitted to {trained}"] < 0.7 * rmse_V[tested, "of the new cell"]
        assert (tmp_path / f"{trained}_on_{tested}.png").stat().st_size > 0
    constants = pd.read_csv(tmp_path / "constants.csv")
    assert set(constants["fitted_to"]) == {"B0005", "B0006"} and (constants["sd"] <= constants["prior_sd"]).all()
    assert "Saha" in json.loads((tmp_path / "discharges.json").read_text())["configuration"]["data"]
    assert "| B0006" in capsys.readouterr().out


def test_bad_numbers_are_refused(capsys):
    with pytest.raises(SystemExit):
        fit_cell.main(["--every", "0"])
    assert "--every: must be at least 1, got 0" in capsys.readouterr().err
