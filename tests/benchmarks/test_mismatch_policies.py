"""The comparison of algorithms under wrong constants runs end to end."""

import json

import numpy as np
import pandas as pd
import pytest

from battery_env import PolicyEstimator, evaluate
from battery_env.calibration.data import standard_dataset
from benchmarks import mismatch_policies
from benchmarks.mismatch import Follow


def test_every_algorithm_and_seed_is_scored_under_every_condition(tmp_path):
    command = ["--algos", "lac", "td3", "--seeds", "0", "1", "--updates", "4", "--discharges", "2", "--jobs", "1"]
    mismatch_policies.main([*command, "--out", str(tmp_path)])
    scores = pd.read_csv(tmp_path / "mismatch_policies.csv")
    sizes = scores.groupby(["calibrator", "seed", "mismatch", "sensor"]).size()
    assert (sizes == 2).all() and len(sizes) == 2 * 2 * 2 * 2
    record = json.loads((tmp_path / "mismatch_policies.json").read_text())["configuration"]
    assert record["trained_with"]["mismatch"] == 0.2 and record["updates"] == 4
    assert (tmp_path / "mismatch_policies.png").stat().st_size > 10_000
    table = (tmp_path / "mismatch_policies.md").read_text(encoding="utf-8")
    assert table.count("| LAC ") == table.count("| TD3 ") == 4
    with pytest.raises(SystemExit):
        mismatch_policies.main(["--discharges", "301", "--out", str(tmp_path)])


def test_a_policy_sees_discharges_that_it_did_not_learn_on(monkeypatch, tmp_path):
    monkeypatch.setattr(mismatch_policies, "train_or_load", lambda *arguments: Follow())
    (scores,) = mismatch_policies.part("sac", 3, 8, 2, tmp_path).values()
    data = standard_dataset(("q_mobile", "r_o"), "piecewise", "test", mismatch=0.2)[:2]
    expected = evaluate(
        PolicyEstimator(Follow(), mismatch_policies.ENV_ID, **mismatch_policies.OPTIONS),
        data,
        mismatch_policies.SENSORS["5 mV noise"],
        seed=1,
    )
    found = scores[(scores["mismatch"] == 0.2) & (scores["sensor"] == "5 mV noise")]
    assert set(scores["calibrator"]) == {"SAC"} and set(scores["seed"]) == {3}
    np.testing.assert_array_equal(found["q_mobile_final"], expected["q_mobile_final"])
