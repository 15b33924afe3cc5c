"""The report says what the raw files say, and the tables beside them."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks import report

RESULTS = Path(__file__).parents[2] / "docs/results"


@pytest.fixture
def small(tmp_path):
    """Eight discharges and two seeds of LAC, one of SAC, as ``benchmarks.compare`` writes them."""
    rows = [("LAC", seed, k, 0.1 * (k + 1) * (seed + 1)) for seed in (0, 1) for k in range(8)]
    rows += [("SAC", 0, k, 2.0) for k in range(8)]
    table = pd.DataFrame(rows, columns=["calibrator", "seed", "trajectory", "r_o_mape_percent"])
    (tmp_path / "compare").mkdir()
    table.to_csv(tmp_path / "compare/BatteryRo-v0_scores.csv", index=False)
    (tmp_path / "compare/BatteryRo-v0_scores.json").write_text('{"command": "python -m benchmarks.compare --seeds 0 1"}')
    # a file of another kind
    pd.DataFrame({"algo": ["LAC"], "r_o_mape_percent": [99.0]}).to_csv(tmp_path / "compare/compare.csv", index=False)
    return tmp_path


def test_numbers_are_those_of_the_small_table(small):
    lac, sac = report.summary(report.read_errors(small)).to_dict("records")
    assert (lac["calibrator"], lac["seeds"], lac["discharges"]) == ("LAC", 2, 8)
    # the means of the seeds are 0.45 and 0.9
    assert lac["mean"] == pytest.approx(0.675) and lac["sd"] == pytest.approx(0.45 / np.sqrt(2))
    assert lac["worst"] == pytest.approx(1.6)
    # of 0.1 ... 0.8 and 0.2 ... 1.6, without the four least and the four largest
    assert lac["interquartile_mean"] == pytest.approx(np.mean([0.4, 0.4, 0.5, 0.6, 0.6, 0.7, 0.8, 0.8]))
    assert lac["low"] < lac["interquartile_mean"] < lac["high"]
    assert sac["mean"] == sac["worst"] == sac["interquartile_mean"] == sac["low"] == sac["high"] == 2.0
    assert np.isnan(sac["sd"])


def test_the_page_holds_tables_figures_and_commands(small, capsys):
    report.main(["--results", str(small), "--out", str(small / "new" / "report.html")])
    text = (small / "new" / "report.html").read_text(encoding="utf-8")
    assert capsys.readouterr().out.split() == [str(small / "new" / name) for name in ("report.html", "report.md")]
    tables = (small / "new" / "report.md").read_text(encoding="utf-8")
    assert re.search(r"\| LAC +\| 2 +\| 8 +\| 0.68 ± 0.3 +\| 1.6 +\| 0.6 ", tables)
    assert "## BatteryRo-v0, r_o\n\nFrom compare/BatteryRo-v0_scores.csv, made by `python -m benchmarks.compare" in tables
    table = re.findall(r"<td>(.*?)</td>", text)
    assert table[:6] == ["LAC", "2", "8", "0.68 ± 0.3", "1.6", "0.6"]
    assert table[7:13] == ["SAC", "1", "8", "2", "2", "2"] and table[13] == "2 to 2"
    assert "made by <code>python -m benchmarks.compare --seeds 0 1</code>" in text
    assert text.count("data:image/png;base64,") == 1
    # nothing is fetched from elsewhere
    assert not re.search(r"(src|href)=.(?!data:)", text) and "http" not in text


def test_all_that_is_published_is_on_the_page():
    errors = report.read_errors(RESULTS)
    assert "mismatch, q_mobile, second half, constants off by 20 %, 5 mV noise" in set(errors["comparison"])
    for _, of_calibrator in errors.groupby(["source", "comparison", "calibrator"]):
        assert len(of_calibrator) == of_calibrator["seed"].nunique() * of_calibrator["trajectory"].nunique()
        assert len(report.summary(of_calibrator)) == 1


def test_numbers_of_the_voltage_only_tasks_are_those_of_their_table():
    errors = report.read_errors(RESULTS / "voltage")
    table = pd.read_csv(RESULTS / "voltage/BatteryVoltageJoint-v0.csv")
    checked = 0
    for comparison, group in errors.groupby("comparison"):
        name = comparison.split(", ")[1]
        for row in report.summary(group).itertuples():
            (sensor,) = (sensor for sensor in set(table["sensor"]) if comparison.endswith(sensor))
            expected = table[(table["sensor"] == sensor) & (table["calibrator"] == row.calibrator)]
            assert row.seeds == len(expected)
            assert row.mean == pytest.approx(expected[f"{name}_second_half_percent"].mean(), rel=1e-5)
            assert row.worst == pytest.approx(expected[f"{name}_second_half_worst_percent"].max(), rel=1e-5)
            checked += 1
    assert checked == 20


@pytest.mark.parametrize("folder", ["compare", "compare_defaults"])
def test_numbers_with_the_full_state_are_those_of_their_table(folder):
    errors = report.read_errors(RESULTS / folder)
    table = pd.read_csv(RESULTS / folder / "compare.csv")
    rows = table.groupby(["env", "parameter", "algo"])
    for comparison, group in errors.groupby("comparison"):
        seeds = group.groupby("calibrator")["seed"].unique()
        for row in report.summary(group).itertuples():
            expected = rows.get_group((*comparison.split(", "), row.calibrator.split()[0].lower()))
            expected = expected[expected["seed"].isin(seeds[row.calibrator])]
            assert row.seeds == len(expected)
            assert row.mean == pytest.approx(expected["mape_percent"].mean(), rel=1e-4)
            assert row.worst == pytest.approx(expected["mape_worst_percent"].max(), rel=1e-4)


@given(arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(2, 12)), elements=st.floats(0.0, 100.0)))
@settings(max_examples=10, deadline=None)
def test_the_interval_lies_within_the_errors_and_around_their_middle(errors):
    value, low, high = report.interquartile_mean(errors)
    assert errors.min() - 1e-9 <= low <= high <= errors.max() + 1e-9
    assert errors.min() - 1e-9 <= value <= errors.max() + 1e-9


def test_a_better_seed_widens_the_interval():
    errors = np.random.default_rng(0).uniform(1.0, 2.0, (2, 200))
    _, low, high = report.interquartile_mean(errors)
    assert report.interquartile_mean(errors)[1:] == (low, high)
    _, low_apart, high_apart = report.interquartile_mean(errors * [[1.0], [3.0]])
    assert high_apart - low_apart > 5 * (high - low)


def test_profiles_count_what_is_below():
    errors = np.array([[1.0, 2.0, 3.0, np.inf], [1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(report.profile(errors, np.array([0.5, 1.5, 10.0])), [[0, 0.25, 0.75], [0, 1, 1]])


def test_a_discharge_without_an_estimate_is_not_left_out(small):
    errors = report.read_errors(small)
    errors.loc[0, "error_percent"] = np.nan
    lac = report.summary(errors).iloc[0]
    assert lac["worst"] == lac["mean"] == np.inf and 0.6 < lac["interquartile_mean"] < 0.8
    assert report.plot_profiles(errors, "errors").axes[0].get_xlim()[1] < 10


def test_a_folder_without_errors_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        report.main(["--results", str(tmp_path), "--out", str(tmp_path / "report.html")])
    assert "has no CSV file with errors of discharges" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("shape", [(5,), (2, 1)])
def test_too_few_discharges_are_refused(shape):
    with pytest.raises(ValueError, match="at least two discharges, got"):
        report.interquartile_mean(np.ones(shape))
