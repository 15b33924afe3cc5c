"""An ablation changes one thing, hides what it says, and is scored on what the policy sees."""

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from battery_env.tasks.data import standard_dataset
from benchmarks import ablations


@pytest.fixture
def trained(monkeypatch):
    """A policy that holds its first action, in place of training; returns what was asked to be trained."""
    calls = []

    class Middle:
        def predict(self, observation, deterministic=False):
            calls[-1]["seen"] = observation.shape[1]
            return np.zeros((len(observation), 1)), None

    def train_or_load(algo, env_id, seed, timesteps, folder, hyperparameters):
        calls.append({"seed": seed, "timesteps": timesteps, "folder": folder.name, **hyperparameters})
        return Middle()

    monkeypatch.setattr(ablations, "train_or_load", train_or_load)
    return calls


@pytest.mark.parametrize(
    ("name", "seen"),
    [("published", 29), ("from_model", 22), ("from_cell", 22), ("none", 15), ("gamma", 29), ("consistency", 30)],
)
def test_a_policy_sees_in_its_test_what_it_saw_in_its_training(trained, tmp_path, monkeypatch, name, seen):
    test = standard_dataset("q_mobile", "paper", "test").subset([0, 900])
    monkeypatch.setattr(ablations, "standard_dataset", lambda *which: test)
    monkeypatch.setattr(ablations, "_DISCHARGES", 2)
    row = ablations.part(name, 3, 10, tmp_path)["ablations"].iloc[0]
    (call,) = trained
    assert call["seen"] == seen and call["timesteps"] == 960 + 10 * 64
    # the middle of the range is 5800 C
    expected = 100.0 * np.abs(5800.0 / test.q_mobile - 1.0)
    np.testing.assert_allclose([row["mean_percent"], row["worst_percent"]], [expected.mean(), expected.max()], rtol=1e-6)
    assert row["spread_percent"] == pytest.approx(0.0, abs=1e-9)
    wrappers = call.get("env_wrapper", [])
    env = gym.make("BatteryQmax-v0", **call["env_kwargs"])
    for wrapper in wrappers:
        env = ablations.HideColumns(env, **wrapper["benchmarks.ablations.HideColumns"])
    assert env.observation_space.shape == (seen,) == env.reset(seed=0)[0].shape


def test_hidden_columns_are_the_innovations():
    env = gym.make("BatteryQmax-v0")
    hidden = ablations.HideColumns(gym.make("BatteryQmax-v0"), range(15, 22))
    whole, part = env.reset(seed=4)[0], hidden.reset(seed=4)[0]
    np.testing.assert_array_equal(part, np.concatenate([whole[:15], whole[22:]]))
    assert hidden.observation_space.contains(part)


def test_tables_name_what_was_changed_with_all_seeds(trained, tmp_path, capsys):
    ablations.main(
        ["--variants", "gamma", "short", "--seeds", "5", "6", "--updates", "7", "--jobs", "1", "--out", str(tmp_path)]
    )
    assert [(call["folder"], call["seed"]) for call in trained] == [("gamma", 5), ("gamma", 6), ("short", 5), ("short", 6)]
    table = pd.read_csv(tmp_path / "ablations.csv")
    assert table["changed"].tolist() == ["discount 0.9"] * 2 + ["episodes of 16 steps, the paper's"] * 2
    text = (tmp_path / "ablations.md").read_text()
    assert text in capsys.readouterr().out and len(text.splitlines()) == 4 and text.count(" / ") == 8
