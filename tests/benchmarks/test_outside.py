"""What is said of tasks outside is what the rows say, by the definitions of the statistics."""

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import outside
from benchmarks.runs import Rows

SCORES = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=6).map(np.array)


def test_the_probability_of_improvement_counts_pairs():
    assert outside.improvement(np.array([1.0, 3.0]), np.array([2.0, 2.0])) == 0.5
    assert outside.improvement(np.array([3.0, 2.0]), np.array([2.0, 1.0])) == 0.875
    # a mean over tasks, not over pairs
    assert outside.improvement(np.ones(4), np.zeros(4), np.zeros(1), np.ones(1)) == 0.5


@given(SCORES, SCORES)
def test_what_one_gains_the_other_loses(ours, others):
    assert outside.improvement(ours, others) + outside.improvement(others, ours) == pytest.approx(1.0)
    assert outside.difference(ours, others) == pytest.approx(-outside.difference(others, ours))


def rows(**returns):
    """Rows of five seeds, by algorithm."""
    curves = [
        {"task": "Pendulum-v1", "algorithm": name, "seed": seed, "timesteps": 20_000, "package": "p 1", "configuration": "{}"}
        | {column: value * percent / 100 for percent, column in outside.CURVE.items()}
        for name, values in returns.items()
        for seed, value in enumerate(values, 1)
    ]
    return pd.DataFrame(curves)


def test_lac_is_compared_with_each_rival_with_bounds():
    compared = outside.comparison(rows(lac=[1, 2, 3, 4, 5], sac=[0, 0, 0, 0, 0], tqc=[3, 3, 3, 3, 3])).set_index("rival")
    assert compared.loc["sac", ["difference", "probability", "probability_low"]].tolist() == [3, 1, 1]
    assert compared.loc["tqc", ["difference", "probability"]].tolist() == [0, 0.5]
    assert -1.5 < compared.loc["tqc", "difference_low"] < -0.5 and 0.5 < compared.loc["tqc", "difference_high"] < 1.5
    of_one = outside.comparison(rows(lac=[1], sac=[2]))
    assert of_one["difference"].notna().all() and of_one["difference_low"].isna().all()


def test_tasks_are_aggregated_by_the_probability_alone():
    of_two = pd.concat([rows(lac=[1, 2], sac=[0, 0]), rows(lac=[1, 1], sac=[2, 2]).assign(task="Reacher-v5")])
    of_all = outside.comparison(of_two).set_index("task").loc["all"]
    assert of_all["probability"] == 0.5 and np.isnan(of_all["difference"])


@pytest.mark.attacks
def test_the_study_trains_writes_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(outside, "EPISODES", 2)
    out, command = tmp_path / "rows", ["--tasks", "Pendulum-v1", "--algos", "lac", "sac", "--timesteps", "40", "--jobs", "1"]
    command += ["--checkpoints", str(tmp_path / "checkpoints"), "--out", str(out)]
    outside.main([*command, "--seeds", "1", "2"])
    done = pd.read_csv(out / "runs.csv")
    assert done[["algorithm", "seed"]].to_numpy().tolist() == [["lac", 1], ["sac", 1], ["lac", 2], ["sac", 2]]
    assert [json.loads(each)["settings"] for each in done["configuration"][:2]] == [{}, {"learning_rate": 1e-3}]
    assert outside.run_of("Hopper-v5", "sac", 1).timesteps == 20_000
    assert done[outside.AT_THE_END].between(-2000, -500).all()
    text = (out / "outside.md").read_text()
    assert "| Pendulum-v1 | 40" in text and "nan" not in text and text in capsys.readouterr().out
    assert (out / "learning.png").stat().st_size > 1000 and len(pd.read_csv(out / "comparison.csv")) == 1
    # rows of another machine, and nothing is trained
    other = tmp_path / "other.csv"
    done.assign(seed=done["seed"] + 2).to_csv(other, index=False)
    outside.main([*command, "--seeds", "1", "2", "3", "--merge", str(other), "--redraw"])
    assert len(Rows(out).read()) == 8 and "| 3 " in (out / "outside.md").read_text()
    # an algorithm that lacks a seed is no part of a table
    Rows(out).add(done[:1].assign(seed=5))
    with pytest.raises(SystemExit, match="No algorithm has all of its seeds"):
        outside.main([*command, "--seeds", "1", "9", "--redraw"])
    outside.main([*command, "--seeds", "1", "5", "--redraw"])
    assert "| LAC " in (text := (out / "outside.md").read_text()) and "SAC" not in text
