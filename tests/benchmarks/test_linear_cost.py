"""A policy and an L that are exact are found to be exact, and the tables say so."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks import linear_cost
from sb3_lac import LAC
from sb3_lac.envs import LinearCostEnv


@pytest.fixture
def exact_model(monkeypatch):
    """LAC with the optimal policy and its cost-to-go, in place of training; returns what was asked to be trained."""
    calls, env = [], LinearCostEnv()

    def train_or_load(algo, env_id, seed, timesteps, folder):
        calls.append((algo, env_id, seed, timesteps, folder))
        model = LAC("MlpPolicy", env_id, gamma=0.95, device="cpu", buffer_size=10, policy_kwargs={"net_arch": [8]})
        gain = env.optimal_gain(model.gamma)

        def predict(observations, deterministic):
            return (-observations @ gain.T / env.control_max).astype(np.float32), None

        def predict_lyapunov(observations, actions):
            return env.cost_to_go(observations, env.control_max * actions, gain, model.gamma)

        monkeypatch.setattr(model, "predict", predict)
        monkeypatch.setattr(model.policy, "predict_lyapunov", predict_lyapunov)
        return model

    monkeypatch.setattr(linear_cost, "train_or_load", train_or_load)
    return calls


def test_gain_of_a_linear_policy_is_found():
    rng = np.random.default_rng(0)
    gain, states = np.array([[0.3, -1.2]]), rng.normal(size=(50, 2))
    np.testing.assert_allclose(linear_cost.linear_gain(states, -states @ gain.T), gain, rtol=1e-12)
    # and the closest one, if it is not linear
    noisy = -states @ gain.T + 0.01 * rng.normal(size=(50, 1))
    np.testing.assert_allclose(linear_cost.linear_gain(states, noisy), gain, atol=0.01)


def test_the_exact_solution_is_recognized(tmp_path, exact_model):
    tables = linear_cost.part(4, 123, 20, tmp_path)
    row, values = tables["linear_cost"].iloc[0], tables["values"]
    assert exact_model == [("lac", "LinearCost-v0", 4, 123, tmp_path / "seed4")]
    assert row["seed"] == 4 and set(values["seed"]) == {4} and len(values) == 20 * 100
    assert row["gain_position"] == pytest.approx(row["gain_position_exact"], rel=1e-5)
    assert row["gain_velocity"] == pytest.approx(row["gain_velocity_exact"], rel=1e-5)
    assert row["linear_over_optimum"] == pytest.approx(1.0, abs=1e-9)
    for end in ("", "_low", "_high"):
        assert row[f"discounted_over_optimum{end}"] == pytest.approx(1.0, abs=1e-6)
    # the best gain of the discounted cost is not that of the mean over an episode
    assert 1.0 < row["per_step_over_optimum"] < 1.05
    assert (row["value_slope"], row["value_intercept"], row["value_correlation"]) == pytest.approx((1, 0, 1), abs=1e-4)
    assert row["calibration_slope"] == pytest.approx(1.0, abs=0.02)
    assert row["alpha3_exact"] == pytest.approx(row["alpha3_optimum"], rel=1e-5)
    assert row["alpha3_low"] < row["alpha3_exact"] < row["alpha3_high"]
    np.testing.assert_allclose(values["learned"], values["exact"], rtol=1e-3)


def test_what_a_policy_costs_too_much_is_seen_in_roll_outs():
    env = LinearCostEnv()
    gain = env.optimal_gain(0.95) / env.control_max
    # an action that is off by a constant: no linear policy close to it shows that
    optimal = linear_cost.episode_costs(lambda observed: -observed @ gain.T, 40)
    biased = linear_cost.episode_costs(lambda observed: -observed @ gain.T + 0.1, 40)
    assert optimal.shape == (100, 40)
    discounted, per_step = (linear_cost.over_optimum(biased, optimal, gamma) for gamma in (0.95, 1.0))
    for ratio, low, high in (discounted, per_step):
        assert 1.0 < low < ratio < high < 10.0
    assert discounted[0] < per_step[0]
    # the same episodes are paired: their starts do not widen the interval
    assert linear_cost.over_optimum(2 * optimal, optimal, 0.95) == pytest.approx((2.0, 2.0, 2.0))


def test_tables_and_figure_are_written(tmp_path, exact_model, capsys):
    linear_cost.main(["--seeds", "1", "2", "--timesteps", "50", "--episodes", "3", "--jobs", "1", "--out", str(tmp_path)])
    assert [call[2:4] for call in exact_model] == [(1, 50), (2, 50)]
    table = pd.read_csv(tmp_path / "linear_cost.csv")
    assert table["seed"].tolist() == [1, 2] and table.notna().all(axis=None)
    record = json.loads((tmp_path / "linear_cost.json").read_text())
    assert record["configuration"] == {"seeds": [1, 2], "timesteps": 50, "episodes": 3}
    assert (tmp_path / "linear_cost.png").stat().st_size > 0
    text = (tmp_path / "linear_cost.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and len(text.splitlines()) == 4
    assert "| 1.000, 1.000 to 1.000 " in text and "| 1.0000 " in text


def test_figure_has_one_panel_per_seed():
    values = pd.DataFrame({"seed": [3, 3, 8], "exact": [1.0, 2.0, 3.0], "learned": [1.5, 2.5, 4.0]})
    figure = linear_cost.plot(values)
    assert [axes.get_title() for axes in figure.axes] == ["seed 3", "seed 8"]
    assert figure.axes[0].collections[0].get_offsets().tolist() == [[1.0, 1.5], [2.0, 2.5]]


@pytest.mark.parametrize("command", [["--timesteps", "0"], ["--episodes", "0"], ["--jobs", "0"], ["--seeds", "one"]])
def test_nonsense_on_the_command_line_is_refused(command, exact_model):
    with pytest.raises(SystemExit):
        linear_cost.main(command)
    assert not exact_model
