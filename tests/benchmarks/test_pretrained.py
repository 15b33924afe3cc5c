"""The policies that come with the package are made by one command."""

import json

import pandas as pd
import pytest

from battery_env import TrajectoryDataset
from battery_env.loads import RandomPiecewise
from battery_env.policies.pretrained import policy_of_file
from benchmarks import pretrained


def few(parameters, load, split, mismatch):
    """Two discharges instead of a thousand."""
    ranges = {"q_mobile_range": (4000.0, 7600.0), "r_o_range": (0.1, 0.3)}
    return TrajectoryDataset.generate(parameters, 2, RandomPiecewise(), seed=0, mismatch=mismatch, **ranges)


@pytest.mark.attacks
def test_it_writes_a_policy_with_its_card(train_nothing, tmp_path, monkeypatch, capsys):
    asked = train_nothing(pretrained)
    monkeypatch.setattr(pretrained, "MISMATCHES", (0.0, 0.2))
    monkeypatch.setattr(pretrained, "standard_dataset", few)
    arguments = [*"--updates 100 --discharges 2 --jobs 1 --out".split(), str(tmp_path)]
    pretrained.main(arguments)
    assert [each[:3] for each in asked] == [("sb3_lac:LAC", "BatteryVoltageJoint-v0", 0)]
    policy, options = policy_of_file(tmp_path / "BatteryVoltageJoint-v0.onnx")
    assert policy.env_id == "BatteryVoltageJoint-v0" and options == pretrained.OPTIONS
    card = json.loads((tmp_path / "BatteryVoltageJoint-v0.json").read_text())
    assert card["recipe"]["environment"] == pretrained.TRAINED_WITH and card["recipe"]["seed"] == 0
    assert len(card["scores"]) == 2 * 2 * 2 and {row["parameter"] for row in card["scores"]} == {"q_mobile", "r_o"}
    assert len(pd.read_csv(tmp_path / "pretrained.csv")) == 2 * 2 * 2
    assert "| BatteryVoltageJoint-v0 |" in capsys.readouterr().out
