"""Policies of control problems have the same starts and disturbances, and tables and figures say what came out."""

import json
import re
from argparse import Namespace
from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces

pytest.importorskip("rl_zoo3")

from benchmarks import control, stabilisation
from benchmarks.runs import Run, setting_of_lac, train_or_load
from benchmarks.study import table_file
from docs.environment_pages import DOCS, environment_page
from sb3_lac.stability import fitting
from tests.policies import Always
from tests.sweeps import sweep

IDS = list(control.DISTURBANCES)


class CountdownEnv(gym.Env):
    """The cost is the number of the step; episodes with an odd seed die after three steps, the others run for five."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.dies, self.n_steps = seed % 2 == 1, 0
        return self.np_random.normal(size=2).astype(np.float32), {"error": 10.0}

    def step(self, action):
        self.n_steps += 1
        observation = np.full(2, self.n_steps, np.float32)
        info = {"error": 10.0 - self.n_steps}
        return observation, -float(self.n_steps), self.dies and self.n_steps == 3, self.n_steps == 5, info


def test_costs_lengths_and_deaths_are_those_of_each_episode():
    policy = Always(0.0)
    outcome = control.roll_out(policy, CountdownEnv, 4)
    expected = {"cost": [3.0, 2.0] * 2, "length": [5, 3] * 2, "error_at_start": [10.0] * 4, "error": [5.0, 7.0] * 2}
    pd.testing.assert_frame_equal(outcome, pd.DataFrame(expected | {"died": [False, True] * 2}))
    # the dead are not asked any more
    assert [len(seen) for seen in policy.seen] == [4, 4, 4, 2, 2]


def test_each_policy_has_the_same_starts():
    left, right = Always(-1.0), Always(1.0)
    for policy in (left, right):
        control.roll_out(policy, lambda: gym.make("CartPoleCost-v0"), 3)
    np.testing.assert_array_equal(left.seen[0], right.seen[0])
    assert len(np.unique(left.seen[0], axis=0)) == 3
    # what they do then makes a difference
    assert (left.seen[2] != right.seen[2]).any()


@pytest.mark.parametrize("env_id", IDS)
def test_conditions_are_disturbances_of_the_environment(env_id):
    tried = control.conditions(env_id)
    assert tried["none"] == {} and len(tried) == 6
    for arguments in tried.values():
        gym.make(env_id, **arguments)
    assert gym.spec(env_id).max_episode_steps % control.IMPULSE_INTERVAL >= 15


def test_shares_are_of_the_way_that_is_left_and_the_dead_have_not_arrived():
    outcome = {"error_at_start": [10.0, 2.0, 0.1, 10.0], "error": [0.1, 0.002, 0.09, 0.0], "died": [False] * 3 + [True]}
    assert list(control.shares_of(pd.DataFrame(outcome), 0.1).values()) == [0.75, 0.5, 0.25]


@pytest.mark.parametrize("env_id", sweep(*IDS))
def test_only_some_loops_end_at_the_goal(env_id):
    tolerance = gym.make(env_id).unwrapped.error_tolerance
    at_goal = {
        name: control.shares_of(control.roll_out(controller, partial(gym.make, env_id), 10), tolerance)["at_goal"]
        for name, controller in control.controllers(env_id).items()
    }
    assert at_goal.pop("reference") == 1.0 and at_goal.pop("wrong sign") == 0.0
    # half the gain still reaches the goal in some, and 15 % of it in the linear one
    at_goal.pop("weak")
    assert at_goal and max(at_goal.values()) <= 0.2


@pytest.mark.parametrize("env_id", IDS)
def test_pages_say_what_the_published_table_says(env_id):
    table = pd.read_csv(table_file(DOCS / "results/stabilisation", "stabilisation"))
    table = table.set_index(["environment", "policy", "disturbance"])
    row = table.loc[env_id, "reference", "none"]
    section = re.search(r"## Reference Controller\n(.*?)\n## ", environment_page(env_id), flags=re.DOTALL)[1]
    text = " ".join(section.split())
    assert float(re.search(r"costs? ([\d.]+) per step", text)[1]) == pytest.approx(row["cost"], rel=0.03)
    assert float(re.search(r"the largest is ([\d.e-]*\d)", text)[1]) == pytest.approx(row["error_worst"], rel=0.03)
    assert float(re.search(r"error below ([\d.]*\d)", text)[1]) == row["tolerance"]
    assert "100 of 100 end" in text and row["at_goal"] == 1 and row["died"] == 0


@pytest.fixture
def quick(monkeypatch, train_nothing):
    """Few passes over the data, models that are not trained; returns what was asked for."""
    monkeypatch.setattr(fitting, "N_ITERATIONS", 3)
    return train_nothing(stabilisation)


@pytest.mark.attacks
def test_stabilisation_is_written_and_seeds_can_be_added(tmp_path, quick, capsys):
    command = ["--envs", "LinearCost-v0", "--algos", "lac", "--timesteps", "20000", "--episodes", "3"]
    command += ["--certificate-episodes", "25", "--jobs", "1", "--out", str(tmp_path)]
    stabilisation.main([*command, "--seeds", "0"])
    stabilisation.main([*command, "--seeds", "0", "1"])
    # As long as was asked for, and nothing twice
    assert quick == [("sb3_lac:LAC", "LinearCost-v0", 0, 20_000), ("sb3_lac:LAC", "LinearCost-v0", 1, 20_000)]
    names = ("stabilisation", "certificates", "learning")
    results, certificates, learning = (pd.read_csv(tmp_path / f"{name}.csv") for name in names)
    assert results["policy"].tolist() == 12 * ["LAC (root=4)"] + 6 * ["reference"]
    assert certificates["function"].tolist() == ["fitted", "critic", "fitted", "critic", "fitted"]
    # Statements are made once for each policy
    assert certificates["survives_at_least"].notna().tolist() == [True, False, True, False, True]
    assert (certificates["cost_bound_low"] <= certificates["cost_bound"]).all() and certificates["start_cost"].gt(0).all()
    assert (results["training_minutes"].iloc[:12] == 1.5).all()
    assert learning["policy"].tolist() == ["LAC (root=4)", "LAC (root=4)", "reference"] and learning["cost"].notna().all()
    assert list(learning) == ["environment", "policy", "seed", "timesteps", "updates", "cost", "at_goal"]
    # An untrained policy is no match for the optimum, whose starts it has
    undisturbed = results[results["disturbance"] == "none"].set_index("policy")["cost"]
    assert undisturbed["LAC (root=4)"].gt(undisturbed["reference"]).all()
    record = json.loads((tmp_path / "stabilisation.json").read_text())
    assert record["configuration"]["disturbances"]["LinearCost-v0"]["action delay"] == {"action_delay": 2}
    text = (tmp_path / "stabilisation.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "| LAC (root=4) (critic)" in text and "nan" not in text
    assert (tmp_path / "learning.png").stat().st_size > 1000


def test_without_a_number_of_steps_it_is_that_of_the_zoo():
    chosen = Namespace(envs=["LinearCost-v0"], algos=["sac", "metric_sac"], seeds=[0])
    reference, *parts = stabilisation.parts_of(
        chosen, lambda policy, env_id: stabilisation.CONTENDERS[policy], lambda env_id: None
    )
    assert reference["run"] is None and [each["run"]["timesteps"] for each in parts] == [60_000, 60_000]


@pytest.mark.attacks
def test_controllers_are_judged_without_training_and_weak_ones_leave_the_goal(tmp_path, quick):
    command = ["--envs", "LinearCost-v0", "--algos", "--weak-controllers", "--episodes", "3", "--jobs", "1"]
    stabilisation.main([*command, "--certificate-episodes", "25", "--out", str(tmp_path)])
    results, certificates = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("stabilisation", "certificates"))
    assert not quick and results["seed"].isna().all()
    assert certificates["policy"].tolist() == ["reference", "weak", "wrong sign", "hardly unstable"]
    at_goal = results[results["disturbance"] == "none"].set_index("policy")["at_goal"]
    assert at_goal["reference"] == 1 and at_goal["wrong sign"] == 0
    assert "| hardly unstable" in (tmp_path / "stabilisation.md").read_text(encoding="utf-8")
    assert (tmp_path / "learning.png").stat().st_size > 1000


def test_a_learning_curve_is_evenly_spaced_and_changes_no_training(tmp_path, monkeypatch):
    monkeypatch.setattr(control, "CURVE_EPISODES", 2)
    settings = {"learning_starts": 10, "batch_size": 4, "policy_kwargs": "dict(net_arch=[8])"}
    run = Run("LinearCost-v0", "LAC", "sb3_lac:LAC", 0, 40, settings)
    model, took, learning = stabilisation.trained(run, tmp_path, False)
    without = train_or_load(run, tmp_path / "without")
    for with_curve, other in zip(model.policy.parameters(), without.policy.parameters(), strict=True):
        assert (with_curve == other).all()
    assert learning["timesteps"].tolist() == list(range(4, 41, 4)) and learning["updates"].iloc[-1] == model._n_updates
    assert took["updates"] == model._n_updates and took["training_minutes"] > 0
    assert learning["cost"].iloc[-1] == pytest.approx(control.while_training(model, "LinearCost-v0", {})["cost"])


def test_all_algorithms_have_the_same_budget():
    own_budget = ("published_lac_paper", "lac_as_typed")
    contenders = {name: each for name, each in stabilisation.CONTENDERS.items() if name not in own_budget}
    for env_id in IDS:
        runs = {name: contender.run(env_id, 0, None) for name, contender in contenders.items()}
        of_lac = runs["lac"]
        for name, run in runs.items():
            assert run.timesteps == of_lac.timesteps
            for setting in ("n_envs", "gradient_steps", "learning_starts"):
                assert run.settings[setting] == of_lac.settings[setting]
            assert "net_arch=[64, 64]" in run.settings["policy_kwargs"]
            if name.endswith("_common"):
                assert setting_of_lac().items() <= run.settings.items()
