"""Every condition is tried, with the same starts and the same noise for each policy, and the tables say what came out."""

import itertools
import json
from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC

from benchmarks import robustness
from sb3_lac import LAC

SMALL_STUDIES = {
    "impulse": ("CartPoleCost-v0", {"impulse_N": (0.0, 80.0)}, (0.0,)),
    "cart and pole": ("CartPoleCost-v0", {"cart_mass_kg": (1.0, 2.0), "pole_half_length_m": (0.5, 1.0)}, (0.0,)),
    "measurement noise": ("CartPoleCost-v0", {}, (0.0, 0.1)),
    "gene network": ("Oscillator-v0", {"light": (5.0, 10.0), "protein_decay": (0.06, 0.12)}, (0.0,)),
    "process noise": ("Oscillator-v0", {"process_noise": (0.0, 1.0)}, (0.0,)),
}


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
        info = {"cost": float(self.n_steps), "error": 10.0 - self.n_steps}
        return observation, 0.0, self.dies and self.n_steps == 3, self.n_steps == 5, info


class RecordingPolicy:
    """Always the same action; keeps what it was shown."""

    def __init__(self, action):
        self.action, self.seen = action, []

    def predict(self, observations, deterministic):
        assert deterministic
        self.seen.append(np.array(observations))
        return np.full((len(observations), 1), self.action, np.float32), None


def test_all_combinations_of_a_study_are_tried():
    for study, (env_id, arguments, noises) in robustness._STUDIES.items():
        found = [(*values.values(), noise) for values, noise in robustness.conditions(study)]
        assert found == list(itertools.product(*arguments.values(), noises)), study
        # an environment without such an argument would raise
        gym.make(env_id, **robustness.conditions(study)[-1][0])
    assert len(robustness.conditions("cart and pole")) == 16
    assert robustness.conditions("measurement noise") == [({}, 0.0), ({}, 0.01), ({}, 0.03), ({}, 0.1)]


def test_costs_lengths_and_deaths_are_those_of_each_episode():
    policy = RecordingPolicy(0.0)
    outcome = robustness.roll_out(policy, CountdownEnv, 4, 0.0)
    expected = {
        "cost": [3.0, 2.0] * 2,
        "length": [5, 3] * 2,
        "error_at_start": [10.0] * 4,
        "error": [5.0, 7.0] * 2,
        "died": [False, True] * 2,
    }
    pd.testing.assert_frame_equal(outcome, pd.DataFrame(expected))
    # the dead are not asked any more
    assert [len(seen) for seen in policy.seen] == [4, 4, 4, 2, 2]


def test_each_policy_has_the_same_starts():
    left, right = RecordingPolicy(-1.0), RecordingPolicy(1.0)
    for policy in (left, right):
        robustness.roll_out(policy, lambda: gym.make("CartPoleCost-v0"), 3, 0.0)
    np.testing.assert_array_equal(left.seen[0], right.seen[0])
    assert len(np.unique(left.seen[0], axis=0)) == 3
    # what they do then makes a difference
    assert (left.seen[2] != right.seen[2]).any()


def test_noise_is_on_what_the_policy_sees_and_nowhere_else():
    clean, noisy, other = RecordingPolicy(0.1), RecordingPolicy(0.1), RecordingPolicy(0.1)
    outcomes = [
        robustness.roll_out(policy, CountdownEnv, 200, noise_std)
        for policy, noise_std in ((clean, 0.0), (noisy, 0.5), (other, 0.5))
    ]
    # the action does not depend on the observation here: the same happens
    pd.testing.assert_frame_equal(outcomes[0], outcomes[1])
    noise = [shown - true for shown, true in zip(noisy.seen, clean.seen, strict=True)]
    assert noisy.seen[0].dtype == np.float32
    assert np.concatenate(noise).std() == pytest.approx(0.5, rel=0.1)
    # independent in time, and of each other
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.2
    assert abs(np.corrcoef(noise[0].T)[0, 1]) < 0.2
    for seen, again in zip(noisy.seen, other.seen, strict=True):
        np.testing.assert_array_equal(seen, again)


@pytest.fixture
def small(monkeypatch):
    """Few conditions, short episodes, and policies that are not trained; returns what was asked to be trained."""
    trained = []

    def train_or_load(algo, env_id, seed, timesteps, folder):
        trained.append((algo, env_id, seed, timesteps, folder.name))
        return {"lac": LAC, "sac": SAC}[algo](
            "MlpPolicy", env_id, seed=seed, device="cpu", buffer_size=10, policy_kwargs={"net_arch": [8]}
        )

    monkeypatch.setattr(robustness, "train_or_load", train_or_load)
    monkeypatch.setattr(robustness, "_STUDIES", SMALL_STUDIES)
    monkeypatch.setattr(robustness.gym, "make", partial(gym.make, max_episode_steps=20))
    return trained


def test_tables_and_figures_are_written(tmp_path, small, capsys):
    command = ["--algos", "lac", "sac", "--seeds", "5", "--episodes", "1", "--jobs", "1", "--out", str(tmp_path)]
    robustness.main([*command, "--cart-pole-timesteps", "30", "--oscillator-timesteps", "50"])
    assert {entry[:4] for entry in small} == {
        (algo, env_id, 5, timesteps)
        for algo in ("lac", "sac")
        for env_id, timesteps in (("CartPoleCost-v0", 30), ("Oscillator-v0", 50))
    }
    # one folder for each
    assert len({entry[4] for entry in small}) == 4

    table = pd.read_csv(tmp_path / "robustness.csv")
    for study in SMALL_STUDIES:
        of_study = table[table["study"] == study]
        assert len(of_study) == 2 * len(robustness.conditions(study))
        assert set(of_study["algo"]) == {"LAC", "SAC"}
        assert not of_study[robustness.varied(study)].duplicated().all()
    assert table["death_rate"].isin([0.0, 1.0]).all() and (table["cost"] == table["cost_worst"]).all()
    assert table.loc[table["study"] == "measurement noise", "observation_noise"].tolist() == [0.0, 0.1] * 2
    record = json.loads((tmp_path / "robustness.json").read_text())
    assert record["configuration"]["seeds"] == [5] and record["configuration"]["cart_pole_timesteps"] == 30
    assert "out" not in record["configuration"] and "torch" in record["versions"]
    for name in ("disturbances.png", "cart_and_pole.png", "gene_network.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert (tmp_path / "robustness.md").read_text(encoding="utf-8") in capsys.readouterr().out


def test_report_has_one_row_per_condition_with_the_spread_over_seeds(monkeypatch):
    monkeypatch.setattr(robustness, "_STUDIES", SMALL_STUDIES)
    rows = [
        {"study": study, "algo": algo, "seed": seed, **arguments, "observation_noise": noise, "death_rate": rate, "cost": cost}
        for algo, cost in (("LAC", 1.0), ("SAC", 20.0))
        for seed, rate in ((0, 0.25), (1, 0.75))
        for study in ("cart and pole", "measurement noise")
        for arguments, noise in robustness.conditions(study)
    ]
    first, second = robustness.report(pd.DataFrame(rows)).strip().split("\n\n**")
    assert first.startswith("**cart and pole** (CartPoleCost-v0, 2 seeds)\n\n| mass of the cart (kg) ")
    assert second.startswith("measurement noise** (CartPoleCost-v0, 2 seeds)\n\n| noise on each observed variable ")
    header, _, *lines = [line for line in first.splitlines() if line.startswith("|")]
    assert [name.strip() for name in header.strip("|").split("|")] == [
        "mass of the cart (kg)",
        "half length of the pole (m)",
        "LAC, death rate",
        "SAC, death rate",
        "LAC, cost per step",
        "SAC, cost per step",
    ]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [[float(cell) for cell in row[:2]] for row in cells] == [[1, 0.5], [1, 1], [2, 0.5], [2, 1]]
    assert cells[0][2:] == ["0.5 ± 0.4", "0.5 ± 0.4", "1 ± 0", "20 ± 0"]
    # nobody dies: no such column
    alive = robustness.report(pd.DataFrame(rows).assign(death_rate=0.0))
    assert "death" not in alive and "LAC, cost per step" in alive


@pytest.mark.parametrize(
    "command", [["--algos", "ppo"], ["--episodes", "0"], ["--jobs", "0"], ["--oscillator-timesteps", "0"]]
)
def test_nonsense_on_the_command_line_is_refused(command, small):
    with pytest.raises(SystemExit):
        robustness.main(command)
    assert not small
