"""The policies that come with the package are made by one command."""

import json

import pandas as pd
import pytest

from battery_env import TrajectoryDataset
from battery_env.loads import RandomPiecewise
from battery_env.policies.pretrained import policy_of_file
from benchmarks import pretrained
from benchmarks.runs import record_file
from sb3_lac import LAC


@pytest.fixture
def train_briefly(monkeypatch):
    """A model that has learned nothing, of the right task."""

    def train_or_load(run, folder):
        assert run.kind == "sb3_lac:LAC" and run.environment == pretrained.TRAINED_WITH
        record = record_file(run, folder)
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(json.dumps({"training_minutes": 1.0, "versions": {}}))
        env = pretrained.PolicyEstimator.environment(run.task, **pretrained.OPTIONS)
        return LAC("MlpPolicy", env, device="cpu", buffer_size=10, seed=run.seed, policy_kwargs={"net_arch": [8]})

    monkeypatch.setattr(pretrained, "train_or_load", train_or_load)
    monkeypatch.setattr(pretrained, "MISMATCHES", (0.0, 0.2))
    # not a thousand discharges of each mismatch
    monkeypatch.setattr(pretrained, "standard_dataset", lambda parameters, load, split, mismatch: few(parameters, mismatch))


def few(parameters, mismatch):
    ranges = {"q_mobile_range": (4000.0, 7600.0), "r_o_range": (0.1, 0.3)}
    return TrajectoryDataset.generate(parameters, 2, RandomPiecewise(), seed=0, mismatch=mismatch, **ranges)


@pytest.mark.attacks
def test_it_writes_a_policy_with_its_card(train_briefly, tmp_path, capsys):
    arguments = [*"--envs BatteryVoltageJoint-v0 --updates 100 --discharges 2 --jobs 1 --out".split(), str(tmp_path)]
    pretrained.main(arguments)
    policy, options = policy_of_file(tmp_path / "BatteryVoltageJoint-v0.onnx")
    assert policy.env_id == "BatteryVoltageJoint-v0" and options == pretrained.OPTIONS
    card = json.loads((tmp_path / "BatteryVoltageJoint-v0.json").read_text())
    assert card["recipe"]["environment"] == pretrained.TRAINED_WITH and card["recipe"]["seed"] == 0
    assert len(card["scores"]) == 2 * 2 * 2 and {row["parameter"] for row in card["scores"]} == {"q_mobile", "r_o"}
    assert len(pd.read_csv(tmp_path / "pretrained.csv")) == 2 * 2 * 2
    assert "| BatteryVoltageJoint-v0 |" in capsys.readouterr().out
