"""Calibrators under conditions on little work: who is compared on which discharges, and progpy's filters on little data."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from battery_env import NEW_CELL, SensorErrors, simulate, step, voltage
from benchmarks import calibrators
from benchmarks.calibrators import COMPARISONS, Condition


def among(monkeypatch, name, conditions=None, names=None):
    """A comparison of a few."""
    whole = COMPARISONS[name]
    few = [who for who in whole.calibrators if names is None or who.name in names]
    monkeypatch.setitem(COMPARISONS, name, replace(whole, conditions=whole.conditions[conditions], calibrators=tuple(few)))


def make(tmp_path, *arguments):
    """The raw table and the text of a study, whose files are all there."""
    calibrators.main([*arguments, "--out", str(tmp_path)])
    name = arguments[0]
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert json.loads((tmp_path / f"{name}.json").read_text())["configuration"]["seed_of_noise"] in (0, 1)
    return pd.read_csv(tmp_path / f"{name}.csv"), (tmp_path / f"{name}.md").read_text(encoding="utf-8")


class TestWork:
    @pytest.mark.parametrize("name", ["peers", "faults"])
    def test_the_parameter_that_is_held_is_the_new_cells_or_ten_per_cent_worn(self, name):
        work = COMPARISONS[name].work
        worn = Condition({}, alone=True, other_worn=True)
        for condition, q_share, r_share in ((Condition({}, alone=True), 1.0, 1.0), (worn, 0.9, 1.1)):
            data = work(condition, ["q_mobile"], 3)
            assert (data.r_o == r_share * NEW_CELL.r_o).all() and len(set(data.q_mobile)) == 3
            data = work(condition, ["r_o"], 3)
            assert (data.q_mobile == q_share * NEW_CELL.q_mobile).all() and len(set(data.r_o)) == 3
            assert data.thermal == (name == "peers")

    def test_each_calibrator_meets_each_condition_but_where_few_are_tried(self):
        counts = {name: [part["discharges"] for part in calibrators.parts(name, 30)] for name in COMPARISONS}
        # six alone on either parameter, two of progpy's on few discharges; two of them under four conditions, and on both
        assert len(counts["peers"]) == 6 * 2 + 2 * (4 * 2 + 1) and counts["peers"].count(2) == 2 * 2
        # four of five on either parameter, half of the discharges each
        assert len(counts["faults"]) == 7 * 5 + 4 * 2 and counts["faults"].count(15) == 4 * 2
        assert len(counts["mismatch"]) == 4 * 6


@pytest.mark.attacks
def test_peers_are_as_good_as_they_can_be_until_a_sensor_is_wrong(tmp_path, monkeypatch, capsys):
    names = ("closed form", "least squares, whole discharge", "extended Kalman filter")
    among(monkeypatch, "peers", slice(0, 6, 3), names)
    results, text = make(tmp_path, "peers", "--discharges", "2")
    last = results.groupby(["calibrator", "case", "parameter"])["final_error_percent"].max()
    for parameter, limits in {"q_mobile": (1e-9, 0.02, 0.1), "r_o": (1e-9, 0.1, 0.5)}.items():
        for name, limit in zip(names, limits, strict=True):
            assert last[name, "5 mV noise", parameter] < limit
        assert last["least squares, whole discharge", "+1 % current", parameter] > 0.5
    assert text in capsys.readouterr().out and text.count("\n| ") == 1 + 3 + 2


def test_a_wrong_current_goes_into_both_parameters(tmp_path, monkeypatch):
    among(monkeypatch, "faults", slice(0, 5, 4), ("closed form", "Kalman filter"))
    results, _ = make(tmp_path, "faults", "--discharges", "2")
    error = results.groupby(["calibrator", "fault", "parameter"])["second_half_mape_percent"].max()
    assert error["closed form", "none", "q_mobile"] < 1e-9 and error["closed form", "none", "r_o"] < 1e-9
    # the current scales R_o; charges are measured
    assert error["closed form", "current +1 %", "r_o"] == pytest.approx(100.0 * (1.0 - 1.0 / 1.01), rel=1e-6)
    assert error["Kalman filter", "none", "q_mobile"] < 0.8 < error["Kalman filter", "current +1 %", "q_mobile"] < 3.0


@pytest.mark.attacks
def test_the_policy_that_comes_with_the_package_says_which_it_is(tmp_path, monkeypatch):
    among(monkeypatch, "mismatch", slice(2, 3), ("LAC, pretrained",))
    results, text = make(tmp_path, "mismatch", "--discharges", "2")
    assert set(results["policy"]) == {calibrators.pretrained_card(calibrators.ENV_ID)["sha256"][:8]}
    assert "| LAC, pretrained |" in text


@pytest.mark.attacks
def test_nuisance_constants_make_up_for_those_that_are_off(tmp_path, monkeypatch):
    among(monkeypatch, "mismatch", slice(2, 3), ("least squares, two parameters", "least squares, nuisances, offset"))
    results, _ = make(tmp_path, "mismatch", "--discharges", "2")
    error = results.groupby("calibrator")["q_mobile_second_half_mape_percent"].mean()
    assert error["least squares, nuisances, offset"] < 0.5 * error["least squares, two parameters"]


class TestProgpyFilters:
    @pytest.fixture
    def filters(self):
        pytest.importorskip("progpy")
        from benchmarks import progpy_filters

        return progpy_filters

    @pytest.mark.parametrize(("parameter", "value"), [("q_mobile", 6000.0), ("r_o", 0.2)])
    def test_their_model_is_ours_with_one_more_state(self, filters, parameter, value):
        parameters = {"q_mobile": 7600.0, "r_o": NEW_CELL.r_o} | {parameter: value}
        record = simulate(2.0, **parameters, load_unit="current", thermal=True)
        state = record.state[[5, 500, 2000]]
        model = filters.BatteryWithUnknown(parameter, process_noise=0, measurement_noise=0)
        x = model.StateContainer(np.vstack([state.T, np.full(3, value)]))
        moved = np.asarray(model.next_state(x, {"i": 2.0}, 1.0).matrix, dtype=float)
        np.testing.assert_allclose(moved[:-1].T, step(state, 2.0, **parameters, load_unit="current", thermal=True), rtol=1e-9)
        np.testing.assert_array_equal(moved[-1], value)
        np.testing.assert_allclose(np.asarray(model.output(x)["v"], dtype=float), voltage(state, parameters["q_mobile"]))

    @pytest.mark.parametrize("kind", ["ukf", "particles"])
    def test_they_find_r_o_within_a_minute(self, filters, kind):
        record = SensorErrors(noise_V=0.005).apply(
            simulate(6.0, NEW_CELL.q_mobile, 0.2, until=60.0, thermal=True), np.random.default_rng(0)
        )
        made = [filters.ProgpyFilter("r_o", kind, 0.15, 0.005) for _ in range(2)]
        first, again = made[0].trace([record])[0], made[1].estimate(record)
        np.testing.assert_array_equal(first.time_s, record.time_s[1:])
        assert again.r_o == first.r_o[-1] == pytest.approx(0.2, rel=0.03)
        np.testing.assert_array_equal(first.q_mobile, NEW_CELL.q_mobile)

    @pytest.mark.attacks
    def test_progpy_leaves_the_style_of_figures_as_it_is(self, filters):
        check = "from matplotlib import rcParams, rcParamsDefault as d; assert rcParams['font.size'] == d['font.size']"
        subprocess.run([sys.executable, "-c", f"import benchmarks.progpy_filters; {check}"], check=True)
