"""The study of ageing paths."""

import pandas as pd
import pytest

from battery_env import PolicyEstimator, fit_life, load_nasa_discharges
from battery_env.policies.pretrained import policy_of_file
from benchmarks import aging_paths


@pytest.mark.attacks
def test_few_discharges_of_one_cell_make_its_tables_and_the_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(aging_paths, "CELLS", {"B0005": "B0006"})
    for name, value in {"SHARES": (0.5, 1.0), "UPDATES": 8, "TRAINING_CELLS": 20, "BUNDLED_CELLS": ("B0006",)}.items():
        monkeypatch.setattr(aging_paths, name, value)
    monkeypatch.setattr(aging_paths, "fit_life", lambda lives: fit_life([life[::4] for life in lives]))
    monkeypatch.setattr(aging_paths, "load_nasa_discharges", lambda cell: load_nasa_discharges(cell)[::7])
    asked = ["--every", "20", "--algos", "lac", "--seeds", "0", "1", "--jobs", "1", "--out", str(tmp_path)]
    aging_paths.main([*asked, "--export"])
    rows, shares = pd.read_csv(tmp_path / "discharges.csv"), 2
    # of two discharges, by three methods whole and in progress, by six that tell an end, and by policies alone and as one
    assert len(rows) == 2 * (3 * shares + 6 * (shares - 1) + 3 * shares) and set(rows["cell"]) == {"B0005"}
    whole = rows["share"] == 1.0
    assert (rows["error_percent"].abs().dropna() < 20.0).all() and (rows["q_error_percent"][whole].abs() < 2.0).all()
    text = (tmp_path / "aging_paths.md").read_text()
    assert "| LAC, path of B0006, 2 as one " in text and (tmp_path / "ends.png").stat().st_size > 0
    policy, options = policy_of_file(tmp_path / "BatteryVoltageJoint-v0_recorded.onnx")
    assert PolicyEstimator(policy, policy.env_id, **options).parameters == ("q_mobile", "r_o")
    aging_paths.main([*asked, "--redraw"])
    assert (tmp_path / "aging_paths.md").read_text() == text
