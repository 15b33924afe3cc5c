"""Policies are trained for what is drawn, and judged within the ranges and outside."""

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from benchmarks import changing_plant, control, runs
from benchmarks.control import DISTURBANCES, conditions

IDS = list(changing_plant.PARAMETERS)


@pytest.mark.parametrize("env_id", IDS)
def test_ranges_hold_what_policies_are_tried_with_and_the_plant_as_it_is_known_and_not_what_is_outside(env_id):
    ranges = changing_plant.ranges_of(env_id)
    env = gym.make(env_id, drawn=ranges)
    assert env.reset(seed=0)[1]["drawn"].keys() == ranges.keys()
    name, (low, high), beyond = changing_plant.PARAMETERS[env_id]
    for value in (env.unwrapped.nominal_parameters[name], DISTURBANCES[env_id][1][name]):
        assert low <= value <= high
    assert not low <= beyond <= high
    for inside, outside in zip(list(conditions(env_id).values())[1:], changing_plant.outside(env_id).values(), strict=True):
        gym.make(env_id, **outside)
        assert inside.keys() == outside.keys()
        for option in inside.keys() & ranges.keys():
            assert ranges[option][1] == inside[option] < outside[option]


def test_all_algorithms_have_the_setting_of_lac_and_the_same_plant():
    of_all = [changing_plant.run_of("CartPoleCost-v0", name, 1, last_actions=2) for name in changing_plant.ALGORITHMS]
    assert all(run.environment == of_all[0].environment for run in of_all)
    assert [run.algorithm.removesuffix(", 2 last actions") for run in of_all] == [
        "LAC",
        "LAC (root=2)",
        "LAC (root=4)",
        "SAC",
        "TQC",
    ]
    assert [run.settings for run in of_all] == [runs.setting_of_lac(root) for root in (None, 2, 4, None, None)]
    assert [run.settings["policy_kwargs"].partition("root")[2] for run in of_all] == ["", "=2)", "=4)", "", ""]
    env = of_all[0].environments()
    assert env.observation_space.shape == (6,) and "action_delay" in of_all[0].environment["drawn"]
    env.close()


def row(algorithm, seed, cost, died=0.0):
    names = [*conditions("CartPoleCost-v0"), *(f"outside: {name}" for name in changing_plant.outside("CartPoleCost-v0"))]
    return {"task": "CartPoleCost-v0", "algorithm": algorithm, "seed": seed, **dict.fromkeys(names, cost)} | {
        f"died: {name}": died for name in names
    }


def test_cells_are_counted_where_lac_is_ahead_or_level_with_those_that_saw_the_same():
    def held(rows, ours="LAC"):
        return changing_plant.cells_held(pd.DataFrame(rows), ["none", "impulses"], ours)

    rows = [row(name, seed, cost) for name, cost in (("LAC", 1.01), ("SAC", 1.0), ("TQC", 3.0)) for seed in (1, 2)]
    assert held(rows) == "LAC: 2 of 2"
    rows += [row(f"{name}, 2 last actions", 1, cost) for name, cost in (("LAC", 1.03), ("SAC", 1.0), ("TQC", 3.0))]
    assert held(rows) == "LAC: 2 of 2" and held(rows, "LAC, 2 last actions") == "LAC, 2 last actions: 0 of 2"
    assert held([*rows, row("LAC (root=2)", 1, 0.9)], "LAC (root=2)") == "LAC (root=2): 2 of 2"
    assert held(rows[:4]) == "LAC: 2 of 2"  # of SAC alone
    assert held(rows[:2]) == "LAC: 0 of 0"
    table = changing_plant.cost_table(pd.DataFrame([row("LAC", 1, 2.0, 0.5), row("LAC", 2, 4.0)]), ["outside: impulses"])
    assert table.to_dict("records") == [
        {"environment": "CartPoleCost-v0", "policy": "LAC", "seeds": "2", "impulses": "3 [2, 4] (25 %)"}
    ]


@pytest.mark.attacks
def test_the_study_trains_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(changing_plant, "EPISODES", 2)
    monkeypatch.setattr(control, "CURVE_EPISODES", 2)
    command = ["--envs", "CartPoleCost-v0", "--timesteps", "40", "--seeds", "1", "--last-actions", "0", "2", "--jobs", "1"]
    command += ["--out", str(tmp_path), "--checkpoints", str(tmp_path / "checkpoints"), "--algos", "lac", "sac"]
    changing_plant.main(command)
    done = pd.read_csv(tmp_path / "runs.csv")
    assert done["algorithm"].tolist() == ["LAC", "SAC", "LAC, 2 last actions", "SAC, 2 last actions"]
    assert np.isfinite(done[["none", "action delay", "outside: action delay", "after_100_percent"]].to_numpy()).all()
    text = (tmp_path / "changing_plant.md").read_text()
    assert (
        text.count("| CartPoleCost-v0 | LAC, 2 last actions") == 2
        and "LAC, 2 last actions: " in text
        and text in capsys.readouterr().out
    )
