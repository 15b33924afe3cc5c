"""Divisions keep apart what they say, mappings learn from the training part alone, and the study says what it compared."""

import json
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from battery_env.trajectories import TrajectoryDataset
from benchmarks import direct_mapping
from benchmarks.direct_mapping import DirectMapping, draw_pairs
from benchmarks.zoo_runs import zoo_run
from tests.policies import Always


@pytest.fixture(scope="module", autouse=True)
def few():
    """Every 150th of the paper's discharges."""
    small = {name: TrajectoryDataset.paper(name).subset(range(0, 5511, 150)) for name in ("q_mobile", "r_o")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(direct_mapping, "TrajectoryDataset", SimpleNamespace(paper=small.__getitem__))
        yield small


def load_W(data):
    return data.load_values[data.load_start]


class TestDivisions:
    @pytest.mark.parametrize("parameter", ["q_mobile", "r_o"])
    @pytest.mark.parametrize("division", list(direct_mapping.DIVISIONS))
    def test_no_discharge_is_on_both_sides_and_none_is_lost(self, few, parameter, division):
        sides = [
            set(zip(load_W(side), side.q_mobile, side.r_o, strict=True))
            for side in direct_mapping.divided(parameter, division)
        ]
        assert not sides[0] & sides[1]
        assert len(sides[0]) + len(sides[1]) == len(few[parameter])

    @pytest.mark.parametrize("parameter", ["q_mobile", "r_o"])
    def test_the_test_part_lies_beyond_the_training_part(self, parameter):
        train, test = direct_mapping.divided(parameter, "load")
        assert load_W(train).max() < direct_mapping.HEAVY_LOAD_W < load_W(test).min()
        train, test = direct_mapping.divided(parameter, "parameter")
        assert (
            (test.q_mobile.max() <= train.q_mobile.min()) if parameter == "q_mobile" else (test.r_o.min() >= train.r_o.max())
        )

    @pytest.mark.parametrize("parameter", ["q_mobile", "r_o"])
    def test_policies_train_on_the_training_part(self, parameter, tmp_path, monkeypatch):
        asked = []
        monkeypatch.setattr(direct_mapping, "train_or_load", lambda *arguments: asked.append(arguments))
        direct_mapping.train_policy("lac", parameter, 3, 10, tmp_path)
        ((run, _),) = asked
        assert (run.kind, run.seed, run.timesteps) == ("sb3_lac:LAC", 3, 1600)
        env = gym.make(run.task, **run.environment).unwrapped
        train, _ = direct_mapping.divided(parameter, "parameter")
        np.testing.assert_array_equal(env.task.dataset.q_mobile, train.q_mobile)
        np.testing.assert_array_equal(env.task.dataset.r_o, train.r_o)
        np.testing.assert_array_equal(load_W(env.task.dataset), load_W(train))
        assert zoo_run("lac", run.task, 3).environment.items() <= run.environment.items()


class TestDirectMapping:
    def test_pairs_are_one_second_apart_and_bear_the_label_of_their_discharge(self, few):
        pairs = draw_pairs(few["r_o"], "r_o", 200, seed=1)
        # the closed form finds the label in every pair: the ohmic drop moves towards i * r_o
        cell, record = few["r_o"].cell, few["r_o"][0]
        assert (np.isin(pairs.label, few["r_o"].r_o)).all() and len(np.unique(pairs.label)) > 20
        moved_C = (pairs.after - pairs.before)[:, [4, 3]].sum(axis=1)  # of the negative electrode: minus i * dt
        ohmic_V = pairs.before[:, 0] + cell.to / record.dt_s * (pairs.after - pairs.before)[:, 0]
        np.testing.assert_allclose(ohmic_V / -moved_C, pairs.label, rtol=1e-6)

    @pytest.mark.parametrize("normalised", [False, True])
    def test_it_tells_every_step_from_that_step_alone(self, few, normalised):
        pairs = draw_pairs(few["q_mobile"], "q_mobile", 64, seed=0)
        mapping = DirectMapping(normalised, "q_mobile", pairs, epochs=1, seed=0)
        records = few["q_mobile"][:2]
        traces = mapping.trace(records)
        for record, trace in zip(records, traces, strict=True):
            np.testing.assert_array_equal(trace.time_s, record.time_s[1:])
            np.testing.assert_array_equal(trace.r_o, record.r_o)
            middle = mapping.trace([record.part(100, 102)])[0]
            assert middle.q_mobile == pytest.approx(trace.q_mobile[[100]], rel=1e-5)
        assert mapping.estimate(records[0]).q_mobile == pytest.approx(traces[0].q_mobile[-1], rel=1e-5)

    @pytest.mark.attacks
    def test_it_learns_and_equal_seeds_make_equal_mappings(self, few):
        data = few["q_mobile"]
        pairs, others = (draw_pairs(data, "q_mobile", 2000, seed) for seed in (0, 1))
        errors = []
        for epochs in (1, 20, 20):
            told = DirectMapping(True, "q_mobile", pairs, epochs, seed=3).infer(others)
            errors.append(100.0 * np.abs(told / others.label - 1.0).mean())
        guess = 100.0 * np.abs(pairs.label.mean() / others.label - 1.0).mean()
        assert errors[1] == errors[2] < 0.2 * guess and errors[1] < errors[0]


@pytest.mark.attacks
def test_the_study_compares_all_on_each_division(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(direct_mapping, "train_or_load", lambda *arguments: Always(0.0))
    monkeypatch.setattr(direct_mapping, "TEST_DISCHARGES", 4)
    command = ["--pairs", "64", "--epochs", "1", "--seeds", "0", "1", "--updates", "10"]
    direct_mapping.main([*command, "--out", str(tmp_path)])
    results = pd.read_csv(tmp_path / "direct_mapping.csv")
    policy = results[(results["method"] == "LAC") & (results["parameter"] == "q_mobile")]
    # the middle of the range is 5800 C
    np.testing.assert_allclose(policy["mape_percent"], 100.0 * np.abs(5800.0 / policy["true"] - 1.0), rtol=1e-3)
    assert results[results["method"] == "closed form"]["mape_percent"].max() < 1e-9
    text = (tmp_path / "direct_mapping.md").read_text(encoding="utf-8")
    # by parameter: three divisions with two mappings and the closed form, one of them with a policy
    assert text in capsys.readouterr().out and text.count("\n| ") == 1 + 2 * (3 * 3 + 1)
    assert json.loads((tmp_path / "direct_mapping.json").read_text())["configuration"]["pairs"] == 64
