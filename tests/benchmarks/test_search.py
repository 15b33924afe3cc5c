"""The search gives every algorithm the same budget, goes on where it was, and reports what it found."""

import json

import numpy as np
import optuna
import pandas as pd
import pytest
from stable_baselines3 import SAC

from battery_env.evaluation import evaluate
from battery_env.policies.estimator import PolicyEstimator
from benchmarks import search
from benchmarks.training import Recipe


@pytest.fixture
def trials(monkeypatch):
    """Scores without training: the learning rate, in per cent; returns the settings that were tried."""
    tried = []

    def score(algo, env_id, updates, folder, trial):
        tried.append((algo, search.sampled(algo, env_id, trial)))
        trial.set_user_attr("median", 1.0)
        trial.set_user_attr("worst", 7.0 + trial.number)
        return 100.0 * trial.params["learning_rate"]

    monkeypatch.setattr(search, "score", score)
    return tried


def test_every_algorithm_gets_the_same_trials_of_as_many_settings(trials, tmp_path, capsys):
    search.main(["--trials", "4", "--updates", "9", "--jobs", "1", "--out", str(tmp_path)])
    # four trials, and the best three of them twice more
    assert [algo for algo, _ in trials] == ["lac"] * 10 + ["sac"] * 10 + ["td3"] * 10
    assert {len(settings) for algo, settings in trials if algo != "td3"} == {5}
    # the clip of TD3's noise follows the noise
    assert {len(settings) for algo, settings in trials if algo == "td3"} == {6}
    table = pd.read_csv(tmp_path / "search.csv")
    assert len(table) == 12 and (table["updates"] == 9).all()
    assert table.groupby("algo")["learning_rate"].first().tolist() == [1e-3] * 3
    text = capsys.readouterr().out
    assert text.count("**, 4 trials") == 3 and (tmp_path / "search.md").read_text() in text
    assert json.loads((tmp_path / "search.json").read_text())["configuration"]["trials"] == 4


def found(algo, count, updates, out):
    return search.part(algo, "BatteryRo-v0", count, updates, 3, 2, {}, out)["search"]


def test_a_search_goes_on_and_is_not_done_twice(trials, tmp_path):
    first = found("sac", 3, 9, tmp_path)
    assert len(trials) == 3 + 3 * 2
    longer = found("sac", 5, 9, tmp_path)
    newcomers = set(longer.sort_values("mean_percent").head(3).index) - set(first.index)
    assert len(trials) == 5 + (3 + len(newcomers)) * 2
    again = found("sac", 5, 9, tmp_path)
    assert len(trials) == 5 + (3 + len(newcomers)) * 2
    pd.testing.assert_frame_equal(longer.head(3)[["learning_rate", "mean_percent"]], first[["learning_rate", "mean_percent"]])
    pd.testing.assert_frame_equal(again, longer)
    # other numbers of updates are another search
    assert len(found("sac", 1, 10, tmp_path)) == 1


def test_a_trial_that_was_interrupted_is_made_again(trials, tmp_path, monkeypatch):
    score = search.score

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "score", interrupted)
    with pytest.raises(KeyboardInterrupt):
        search.part("sac", "BatteryJoint-v0", 3, 9, 1, 1, {}, tmp_path)
    monkeypatch.setattr(search, "score", score)
    rates = search.part("sac", "BatteryJoint-v0", 3, 9, 1, 1, {}, tmp_path)["search"]["learning_rate"].tolist()
    assert len(rates) == 3 and sorted(rates[:2]) == [1e-3, 2.8e-3]


def test_trials_by_hand_are_no_more_than_all(trials, tmp_path):
    search.part("sac", "BatteryJoint-v0", 1, 9, 1, 2, {}, tmp_path)
    assert [settings["learning_rate"] for _, settings in trials] == ["lin_0.0028"] * 3


def test_the_best_three_are_ranked_by_three_seeds(trials, tmp_path):
    trial = found("lac", 6, 9, tmp_path)
    best = trial.sort_values("mean_percent").head(3)
    assert (best["seeds"] == 3).all() and (trial.drop(best.index)["seeds"] == 1).all()
    tried = [settings["learning_rate"] for _, settings in trials]
    # the same settings again, with the numbers of later trials as seeds
    assert sorted(tried[6:]) == sorted(np.repeat([f"lin_{rate:.2g}" for rate in best["learning_rate"]], 2))
    assert set(best["worst_percent"]) == {14.0, 16.0, 18.0} and (trial.drop(best.index)["worst_percent"] < 13.0).all()


def test_with_both_parameters_a_search_begins_with_what_one_needed(trials, tmp_path):
    command = ["--env", "BatteryJoint-v0", "--trials", "2", "--finalists", "1", "--repeats", "1"]
    search.main([*command, "--jobs", "1", "--out", str(tmp_path)])
    begun = dict(reversed(trials))
    assert set(begun) == {"lac", "sac", "td3"}
    for algo, settings in begun.items():
        of_one = Recipe.of(algo, "BatteryQmax-v0", 0).hyperparameters
        rates = [float(each["learning_rate"].removeprefix("lin_")) for each in (settings, of_one)]
        assert rates[0] == rates[1]
        for name in set(settings) - {"learning_rate"}:
            assert settings[name] == (2.0 * of_one[name] if name == "target_entropy" else of_one[name])


def test_with_both_parameters_both_errors_count():
    env_id = "BatteryJoint-v0"
    model = SAC("MlpPolicy", env_id, policy_kwargs={"net_arch": [8]})
    data = PolicyEstimator.environment(env_id).task.dataset
    discharges = data.subset(range(0, len(data), len(data) // 64))
    errors = evaluate(PolicyEstimator(model, env_id), discharges)
    mean = (errors["q_mobile_mape_percent"] + errors["r_o_mape_percent"]) / 2.0
    np.testing.assert_allclose(search.FAMILIES[env_id].scores(model, env_id), mean)


@pytest.mark.parametrize("algo, env_id", [("td3", "BatteryRo-v0"), ("lac", "LinearCost-v0"), ("tqc", "VehicleCost-v0")])
def test_a_trial_is_trained_for_its_updates_and_scored_on_what_no_study_judges(algo, env_id, tmp_path):
    study = optuna.create_study()
    study.enqueue_trial(search.FAMILIES[env_id].first_trials[-1])
    study.optimize(lambda trial: search.score(algo, env_id, 3, tmp_path, trial), n_trials=1)
    (trial,) = study.trials
    assert 3 <= trial.user_attrs["updates"] <= 4
    assert 0.0 < trial.user_attrs["median"] < trial.user_attrs["worst"]
    assert 0.0 < trial.value < trial.user_attrs["worst"]
    if env_id.startswith("Battery"):
        assert trial.user_attrs["worst"] <= 100.0


def test_a_cost_environment_is_searched_by_its_cost(trials, tmp_path, capsys):
    command = ["--env", "PendulumCost-v0", "--algos", "lac", "tqc", "--trials", "3", "--finalists", "1", "--repeats", "1"]
    search.main([*command, "--jobs", "1", "--out", str(tmp_path)])
    assert [algo for algo, _ in trials] == ["lac"] * 4 + ["tqc"] * 4
    first = trials[0][1]
    entropy = {"ent_coef": "auto_0.1", "target_entropy": -2.0}
    assert first == {"learning_rate": 5e-4, "gamma": 0.99, "tau": 0.005, **entropy}
    table = pd.read_csv(tmp_path / "search.csv")
    assert "mean_cost" in table and (table["seeds"] == 2).sum() == 2
    assert "worst_cost" in capsys.readouterr().out


def test_each_algorithm_tries_what_the_others_found_as_often(trials, tmp_path):
    command = ["--env", "QuadrotorCost-v0", "--trials", "4", "--finalists", "2", "--repeats", "1", "--exchange"]
    search.main([*command, "--jobs", "1", "--out", str(tmp_path)])
    own = trials[: 3 * 6]
    assert [algo for algo, _ in own] == ["lac"] * 6 + ["sac"] * 6 + ["td3"] * 6
    adopted = trials[3 * 6 :]
    # two others each, twice
    assert [algo for algo, _ in adopted] == ["lac"] * 4 + ["sac"] * 4 + ["td3"] * 4
    table = pd.read_csv(tmp_path / "search.csv")
    assert (table["settings_of"] != table["algo"]).sum() == 6 and (table["seeds"] == 2).sum() == 3 * 2 + 6
    best = {algo: rows[rows["settings_of"] == algo].sort_values("mean_cost").iloc[0] for algo, rows in table.groupby("algo")}
    for algo, other in [("lac", "sac"), ("sac", "lac"), ("td3", "lac"), ("lac", "td3")]:
        (row,) = table[(table["algo"] == algo) & (table["settings_of"] == other)].to_dict("records")
        shared = ["learning_rate", "gamma", "tau"] + ([] if "td3" in (algo, other) else ["ent_coef", "target_entropy"])
        assert [row[name] for name in shared] == best[other][shared].tolist()
    search.main([*command, "--jobs", "1", "--out", str(tmp_path)])
    assert len(trials) == 3 * 6 + 3 * 4
