"""Policies and reference controllers are judged alike, and the tables and figures say what came out."""

import json

import pandas as pd
import pytest
import yaml

pytest.importorskip("rl_zoo3")

from benchmarks import stabilisation
from benchmarks.references import DISTURBANCES
from sb3_lac.stability import fitting
from sb3_lac.zoo import find_config


@pytest.fixture
def quick(monkeypatch, train_nothing):
    """Few passes over the data, and a model that is not trained; returns what was asked for."""
    asked = train_nothing(stabilisation)
    monkeypatch.setattr(fitting, "N_ITERATIONS", 3)
    return asked


def test_tables_and_figures_are_written_and_seeds_can_be_added(tmp_path, quick, capsys):
    command = ["--envs", "LinearCost-v0", "--algos", "lac", "--timesteps", "20000", "--episodes", "3"]
    command += ["--certificate-episodes", "25", "--jobs", "1", "--out", str(tmp_path)]
    stabilisation.main([*command, "--seeds", "0"])
    stabilisation.main([*command, "--seeds", "0", "1"])
    # No more than zoo_configs has, and nothing twice
    assert quick == [("lac", "LinearCost-v0", 0, 10_000), ("lac", "LinearCost-v0", 1, 10_000)]
    results, certificates = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("stabilisation", "certificates"))
    assert results["policy"].tolist() == 12 * ["LAC"] + 6 * ["reference"]
    assert certificates["function"].tolist() == ["fitted", "critic", "fitted", "critic", "fitted"]
    assert results["training_minutes"].tolist()[:12] == 12 * [1.5]
    reference = results[(results["policy"] == "reference") & (results["disturbance"] == "none")].iloc[0]
    assert reference["at_goal"] == 1.0 and reference["died"] == 0.0
    # An untrained policy is no match for the optimum, whose starts it has
    assert results.loc[(results["policy"] == "LAC") & (results["disturbance"] == "none"), "cost"].gt(reference["cost"]).all()
    record = json.loads((tmp_path / "stabilisation.json").read_text())
    assert record["configuration"]["disturbances"]["LinearCost-v0"]["action delay"] == {"action_delay": 2}
    text = (tmp_path / "stabilisation.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "| LAC (critic)" in text and "nan" not in text
    for name in ("costs.png", "disturbances.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_tables_count_episodes_and_seeds():
    rows = [
        {
            "environment": "LinearCost-v0",
            "policy": "SAC",
            "seed": seed,
            "updates": 10.0,
            "training_minutes": 0.5,
            "disturbance": disturbance,
            "cost": cost,
            "error_median": 0.1,
            "at_goal": at_goal,
            "within_1_percent": at_goal / 2,
            "within_0.1_percent": 0.0,
            "died": 1.0 - at_goal,
        }
        for seed, cost, at_goal in ((0, 1.0, 0.0), (1, 3.0, 0.5))
        for disturbance in ("none", "impulses")
    ]
    row = stabilisation.undisturbed_table(pd.DataFrame(rows)).iloc[0]
    assert (row["cost per step"], row["at the goal"], row["died"]) == ("2 [1, 3]", "25 % (0 to 50)", "75 % (50 to 100)")
    assert (row["within 1 % of the start"], row["within 0.1 %"]) == ("12 % (0 to 25)", "0 % (0 to 0)")
    assert row["seeds"] == "2" and row["updates"] == "10"
    disturbed = stabilisation.disturbed_table(pd.DataFrame(rows)).iloc[0]
    assert disturbed["none"] == disturbed["impulses"] == "25 % (75 %)"


def test_all_algorithms_have_the_same_budget():
    configs = [yaml.safe_load(find_config(algo).read_text(encoding="utf-8")) for algo in stabilisation._ALGORITHMS]
    for env_id in DISTURBANCES:
        budgets = [
            {name: config[env_id][name] for name in ("n_timesteps", "n_envs", "gradient_steps", "learning_starts")}
            for config in configs
        ]
        assert budgets.count(budgets[0]) == 4
        assert all("net_arch=[64, 64]" in config[env_id]["policy_kwargs"] for config in configs)


@pytest.mark.parametrize(
    "command",
    [["--algos", "ppo"], ["--envs", "Pendulum-v1"], ["--timesteps", "0"], ["--timesteps", "900"], ["--episodes", "0"]],
)
def test_nonsense_on_the_command_line_is_refused(command, quick):
    with pytest.raises(SystemExit):
        stabilisation.main(command)
    assert not quick
