"""Calibrators on the real cells, on a few of their discharges."""

import json

import numpy as np
import pandas as pd
import pytest

from battery_env import PolicyEstimator, TrajectoryDataset, load_nasa_discharges
from benchmarks import cells
from benchmarks.calibrators import ENV_ID, Follow
from tests.policies import Always


def configuration(file):
    return json.loads(file.read_text())["configuration"]


def test_over_the_life_of_a_cell_q_mobile_follows_its_capacity(tmp_path, capsys, monkeypatch):
    records = load_nasa_discharges("B0005")
    monkeypatch.setattr(cells, "load_nasa_discharges", lambda cell: [records[n] for n in (0, 60, 120, 167)])
    cells.main(["real_cells", "--cells", "B0005", "--jobs", "1", "--out", str(tmp_path)])
    whole = pd.read_csv(tmp_path / "discharges.csv")
    assert list(whole["cycle"]) == [1, 61, 121, 168] and whole["settled"].all()
    assert whole["q_mobile_C"].corr(whole["capacity_Ah"]) > 0.999
    assert (whole["eod_error_s"].abs() < 0.01 * whole["duration_s"]).all()
    assert (whole["voltage_rmse_V"] < whole["new_cell_voltage_rmse_V"]).all()
    assert len(pd.read_csv(tmp_path / "in_progress.csv")) == 3 * 3 * 3
    assert "Saha" in configuration(tmp_path / "discharges.json")["data"]
    for name in ("life.png", "voltages.png", "summary.md"):
        assert (tmp_path / name).stat().st_size > 0
    assert "| B0005" in capsys.readouterr().out


def test_fitted_constants_are_better_on_the_other_cell(tmp_path):
    cells.main(["fit_cell", "--every", "60", "--jobs", "1", "--out", str(tmp_path)])
    scores = pd.read_csv(tmp_path / "discharges.csv")
    assert len(scores) == 2 * 2 * 3
    rmse_V = scores.groupby(["cell", "constants"])["voltage_rmse_V"].median()
    for trained, tested in cells.PAIRS:
        assert rmse_V[tested, f"fitted to {trained}"] < 0.7 * rmse_V[tested, "of the new cell"]
        assert (tmp_path / f"{trained}_on_{tested}.png").stat().st_size > 0
    constants = pd.read_csv(tmp_path / "constants.csv")
    assert set(constants["fitted_to"]) == {"B0005", "B0006"} and (constants["sd"] <= constants["prior_sd"]).all()


@pytest.fixture(autouse=True, scope="module")
def _few_simulations():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cells, "N_CELLS", 20)
        yield


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("own_cell")
    few = ["--algos", "lac", "--seeds", "0", "1", "--updates", "8", "--every", "120", "--jobs", "1"]
    cells.main(["own_cell", *few, "--out", str(out)])
    return out


class TestOwnCell:
    def test_every_calibrator_is_tested_on_the_other_cell(self, results):
        found = pd.read_csv(results / "own_cell.csv")
        assert set(zip(found["fitted"], found["tested"], strict=True)) == {("B0005", "B0006"), ("B0006", "B0005")}
        names = sorted({*cells.CLASSICAL, "LAC", "LAC, 2 together"})
        # two discharges, four parts of each, and two seeds of a policy
        sizes = found.groupby(["tested", "calibrator"]).size()
        assert sizes.to_dict() == {(cell, name): 16 if name == "LAC" else 8 for cell in ("B0005", "B0006") for name in names}
        assert configuration(results / "own_cell.json")["trained_with"]["process_noise_V"] == 0.002

    def test_policies_learn_on_the_cell_that_was_fitted_and_never_see_the_other(self, results, monkeypatch):
        learned_on = []

        def trained(algo, seed, updates, dataset, folder):
            learned_on.append(TrajectoryDataset.load(dataset))
            return Follow()

        monkeypatch.setattr(cells, "trained", trained)
        for fitted, tested in cells.PAIRS:
            (table,) = cells.own_part("LAC", [0], 8, fitted, tested, 120, results).values()
            fit, records = cells.fitted_to(fitted), load_nasa_discharges(tested)
            assert learned_on[-1].cell == fit.cell
            assert set(table["cycle"]) == {record.meta["cycle"] for record in records[::120]}
            whole = table[table["share"] == 1.0].iloc[0]
            expected = PolicyEstimator(Follow(), ENV_ID, cell=fit.cell, **cells.pretrained.OPTIONS)
            assert whole["q_mobile_C"] == expected.estimate(records[0].loaded_part(2.7)).q_mobile

    def test_policies_act_together_by_their_mean(self):
        together = cells.Together([Always(0.2, -0.4), Always(0.4, 0.0)])
        np.testing.assert_allclose(together.predict(np.zeros((3, 5)), deterministic=True)[0], [[0.3, -0.2]] * 3)


def test_the_departure_is_that_from_least_squares_of_the_whole_discharge(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "NEW_CELLS", {name: cells.NEW_CELLS[name] for name in ("least squares", "LAC, pretrained")})
    cells.main(["mismatch_cells", "--cells", "B0005", "--every", "80", "--out", str(tmp_path)])
    found = pd.read_csv(tmp_path / "mismatch_cells.csv")
    assert len(found) == 2 * 3 * 4
    assert (found["policy"].isna() == (found["calibrator"] == "least squares")).all()
    departure = cells.with_departure(found.rename(columns={"cell": "tested"}))
    whole = found[(found["calibrator"] == "least squares") & (found["share"] == 1.0)].set_index("cycle")["q_mobile_C"]
    expected = 100.0 * (found["q_mobile_C"] / found["cycle"].map(whole) - 1.0)
    np.testing.assert_allclose(departure["departure_percent"], expected)
    text = (tmp_path / "mismatch_cells.md").read_text(encoding="utf-8")
    assert "0.00 (0.0)" in text.splitlines()[-2] + text.splitlines()[-1]
