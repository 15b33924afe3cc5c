"""The study of identifiability: the facts that its page states, and the page against the published tables."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import identifiability as measure

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "docs" / "results" / "identifiability"


@pytest.fixture(scope="module")
def records():
    return measure.discharges()


def test_both_discharges_are_of_the_same_cell_and_reach_the_end(records):
    assert list(records) == ["constant", "varying"]
    for record in records.values():
        assert (record.q_mobile, record.r_o) == (6000.0, 0.15) and np.isfinite(record.eod_time_s)
    assert np.ptp(records["constant"].current_A) == 0.0 and np.ptp(records["varying"].current_A) > 1.0


def test_the_full_state_tells_both_parameters_to_rounding():
    row = measure.conservation_table().iloc[0]
    assert row["discharges"] == 50 and row["samples"] > 50_000
    assert row["q_mobile_worst_relative_error"] < 1e-13 and row["r_o_worst_relative_error"] < 1e-13


def test_r_o_shows_at_once_and_q_mobile_at_the_knee(records):
    response = measure.response_table(records["constant"]).set_index("time_s")["share_of_final_percent"]
    assert response[6] == pytest.approx(100.0 * (1.0 - (1.0 - 1.0 / 6.08671) ** 6), rel=1e-6) and response[30] > 99.0
    table = measure.sensitivity_table(records["constant"]).set_index("seen_percent")
    by_q = table["mV_per_percent_of_q_mobile"]
    assert by_q[1.0] < 1.0 and by_q[100.0] > 40.0 * by_q[50.0]
    np.testing.assert_allclose(table["mV_per_percent_of_r_o"][5.0:], -3.0, rtol=1e-2)


def test_bounds_are_proportional_to_the_noise_and_grow_with_what_is_unknown(records):
    table = measure.bounds_table(records).set_index(["load", "unknown", "noise_V"])
    at_half = table["q_mobile_sd_percent_at_50%"]["constant"]
    np.testing.assert_allclose(at_half["both"].to_numpy(), at_half["both"][0.001] * np.array([1.0, 5.0, 10.0, 30.0]))
    assert at_half["q_max alone"][0.01] < at_half["both"][0.01] < at_half["both and an offset"][0.01]
    assert np.isinf(table["r_o_within_1_percent_s"]["constant", "both and an offset", 0.01])
    assert np.isfinite(table["r_o_within_1_percent_s"]["varying", "both and an offset", 0.01])


def test_a_short_episode_of_voltages_says_little_before_the_knee(records):
    table = measure.windows_table(records["constant"]).set_index("seen_percent")
    prior_percent = 100.0 * (7600.0 - 4000.0) / np.sqrt(12.0) / 6000.0
    assert (table["episode_joint_percent"][:90.0] > prior_percent).all() and table["episode_joint_percent"][100.0] < 1.0
    assert (table["all_so_far_joint_percent"] <= table["episode_joint_percent"]).all()


def test_an_offset_is_lost_by_a_logger_that_starts_late_unless_the_load_varies(records):
    table = measure.late_table(records).set_index(["load", "start_s"])["r_o_sd_percent"]
    assert table["constant", 30] > 100.0 * table["constant", 0]
    assert table["varying", 30] == pytest.approx(table["varying", 0], rel=0.05)


def test_a_filter_that_knows_of_the_offset_is_not_misled_by_it(records):
    table = measure.offsets_table(records).set_index(["load", "offset_sd_V", "seen_percent"])
    assert abs(table["q_mobile_error_percent"]["varying", 0.0, 25.0]) > 3.0
    assert table.xs(measure.OFFSET_V, level="offset_sd_V").abs().to_numpy().max() < 1.0


def test_the_cost_of_vsp_points_to_the_truth_from_states_that_have_drifted():
    minima = measure.minima_table(measure.one_step_costs()).groupby("cost")["q_mobile_C"].agg(list)
    assert minima["cost_true_si"] == pytest.approx([5480.0, 5730.0, 6000.0], abs=5.0)
    assert minima["cost_true_scaled"] == minima["cost_drifted_scaled"] == [6000.0]
    assert 6000.0 not in minima["cost_drifted_si"]
    assert abs(minima["cost_far_scaled"][0] - 6000.0) > 20.0
    assert minima["cost_far_task"] == pytest.approx([6000.0], abs=10.0)


@pytest.fixture
def brief(monkeypatch):
    monkeypatch.setattr(measure, "FINE_SHARES", measure.SHARES)
    few = ("voltage read 10 mV too high", "kn of the cell 20 % lower", "R_o held 10 % too low", "q_max held 5 % too high")
    monkeypatch.setattr(measure, "FAULTS", {name: measure.FAULTS[name] for name in few})
    monkeypatch.setattr(measure, "PRIORS", {"none": None, "right, sd 1 %": (1.0, 0.01)})


def test_the_study_writes_tables_and_figures(brief, tmp_path, capsys):
    measure.main(["--draws", "2", "--jobs", "1", "--out", str(tmp_path)])
    names = {path.name for path in PUBLISHED.iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == names | {"parts"}
    assert json.loads((tmp_path / "bounds.json").read_text())["configuration"]["draws"] == 2
    assert (tmp_path / "summary.md").read_text(encoding="utf-8") in capsys.readouterr().out
    least_squares = pd.read_csv(tmp_path / "least_squares.csv")
    assert len(least_squares) == 2 * 2 * 4 and (least_squares["q_mobile_rms_percent"] < 20.0).all()
    faults = pd.read_csv(tmp_path / "faults.csv").set_index(["load", "fault", "seen_percent"]).sort_index()
    held = faults["q_mobile_error_percent"]["constant", "R_o held 10 % too low"]
    assert held[50.0] < -10.0 and abs(held[100.0]) < 1.0
    assert faults["q_mobile_error_percent"]["constant", "q_max held 5 % too high"].isna().all()


def cells(line):
    return tuple(cell.strip() for cell in line.strip().strip("|").split("|"))


def rows(page):
    return [cells(line) for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]


def test_every_row_of_the_page_is_in_the_published_tables():
    shown, published = rows(ROOT / "docs/reports/identifiability.md"), set(rows(PUBLISHED / "summary.md"))
    assert len(shown) >= 6
    assert [row for row in shown if row not in published] == []


def test_published_tables_are_shown_as_they_are_published():
    tables = {name: pd.read_csv(PUBLISHED / f"{name}.csv") for name in measure.TABLES}
    assert measure.summary(tables) == (PUBLISHED / "summary.md").read_text(encoding="utf-8")
