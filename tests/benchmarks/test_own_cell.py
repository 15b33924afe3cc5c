"""The comparison of policies for a cell of one's own runs end to end."""

import json

import numpy as np
import pandas as pd
import pytest

from battery_env import PolicyEstimator, TrajectoryDataset
from benchmarks import own_cell


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("own_cell")
    own_cell.main(
        ["--algos", "lac", "--seeds", "0", "1", "--updates", "8", "--every", "120", "--jobs", "1", "--out", str(out)]
    )
    return out


def test_every_calibrator_is_tested_on_the_other_cell(results):
    found = pd.read_csv(results / "own_cell.csv")
    assert set(zip(found["fitted"], found["tested"], strict=True)) == {("B0005", "B0006"), ("B0006", "B0005")}
    calibrators = {*own_cell.CLASSICAL, "LAC", "LAC, 2 together"}
    assert set(found["calibrator"]) == calibrators
    # two discharges, four parts of each, and two seeds of a policy
    assert (found.groupby(["tested", "calibrator"]).size() == [16 if c == "LAC" else 8 for c in sorted(calibrators)] * 2).all()
    assert json.loads((results / "own_cell.json").read_text())["configuration"]["trained_with"]["process_noise_V"] == 0.002


def test_policies_learn_on_the_cell_that_was_fitted_and_never_see_the_other(results, monkeypatch):
    learned_on = []

    def trained(algo, seed, updates, dataset, folder):
        learned_on.append(TrajectoryDataset.load(dataset))
        return own_cell.Follow()

    monkeypatch.setattr(own_cell, "trained", trained)
    for fitted, tested in own_cell.PAIRS:
        (table,) = own_cell.part("LAC", [0], 8, fitted, tested, 120, results).values()
        fit, records = own_cell.fitted_to(fitted), own_cell.load_nasa_discharges(tested)
        assert learned_on[-1].cell == fit.cell
        assert set(table["cycle"]) == {record.meta["cycle"] for record in records[::120]}
        whole = table[table["share"] == 1.0].iloc[0]
        expected = PolicyEstimator(own_cell.Follow(), own_cell.ENV_ID, cell=fit.cell, **own_cell.OPTIONS)
        assert whole["q_mobile_C"] == expected.estimate(records[0].loaded_part(2.7)).q_mobile


def test_policies_act_together_by_their_mean(results):
    class Constant:
        def __init__(self, action):
            self.action = action

        def predict(self, observation, /, *, deterministic=False):
            assert deterministic
            return np.tile(self.action, (len(observation), 1)), None

    together = own_cell.Together([Constant([0.2, -0.4]), Constant([0.4, 0.0])])
    np.testing.assert_allclose(together.predict(np.zeros((3, 5)), deterministic=True)[0], [[0.3, -0.2]] * 3)


def test_the_departure_is_that_from_least_squares_of_the_whole_discharge():
    one = {"tested": "B0005", "cycle": 1}
    found = pd.DataFrame(
        [
            {**one, "calibrator": "least squares", "share": 1.0, "q_mobile_C": 5000.0},
            {**one, "calibrator": "least squares", "share": 0.5, "q_mobile_C": 4000.0},
            {**one, "calibrator": "LAC", "share": 1.0, "q_mobile_C": 5100.0},
        ]
    )
    np.testing.assert_allclose(own_cell.with_departure(found)["departure_percent"], [0.0, -20.0, 2.0])
