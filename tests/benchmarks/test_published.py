"""The experiments of Han et al. are trained and judged as they say, and the baseline has the rates that they gave it."""

from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from benchmarks import control, published, stabilisation
from benchmarks.two_rate_sac import TwoRateSAC
from sb3_lac.envs import reference_controller
from tests.sweeps import sweep


@pytest.mark.attacks
def test_trained_policies_are_judged(tmp_path, monkeypatch, train_nothing, capsys):
    asked = train_nothing(stabilisation)
    # the last of each disturbance
    few = {
        env_id: {name: dict(list(settings.items())[-1:]) for name, settings in disturbances.items()}
        for env_id, disturbances in published.DISTURBANCES.items()
    }
    monkeypatch.setattr(published, "DISTURBANCES", few)
    command = ["--timesteps", "2000", "--episodes", "1", "--jobs", "1", "--out", str(tmp_path)]
    published.main([*command, "--seeds", "0"])
    algos = ("sb3_lac:PublishedLAC", "benchmarks.two_rate_sac:TwoRateSAC")
    assert asked == [(algo, env_id, 0, 2000) for env_id in published.TIMESTEPS for algo in algos]
    results, learning = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("published", "learning"))
    for env_id, disturbances in published.DISTURBANCES.items():
        settings = [setting for of_disturbance in disturbances.values() for setting in of_disturbance]
        of_env = results[results["environment"] == env_id]
        assert of_env["setting"].tolist() == 3 * settings
    assert set(learning["policy"]) == {"LAC as published", "SAC"} and learning["cost"].notna().all()
    text = (tmp_path / "published.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "nan" not in text and "| constant 16 " in text
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("learning.png", "impulses.png", "changes.png"))


@pytest.mark.parametrize("policy", sweep("lac", "sac"))
def test_settings_are_those_of_the_paper_and_rates_fall_apart(policy):
    run = published.contender(policy, "Oscillator-v0").run("Oscillator-v0", 0, 1100)
    model = run.model(run.environments())
    model.learn(1100)
    assert model._n_updates == 80 and (model.gamma, model.tau, model.batch_size) == (0.995, 0.005, 256)
    assert model.ent_coef == {"lac": "auto_2", "sac": "auto_1.0"}[policy]
    # episodes end with a step that costs more than 100
    ends = model.replay_buffer.dones[:1100].ravel() > 0
    np.testing.assert_array_equal(ends, model.replay_buffer.rewards[:1100].ravel() < -100)
    assert ends.any() and not model.replay_buffer.timeouts.any()
    model._current_progress_remaining = 0.5
    model.train(1, model.batch_size)
    assert [optimizer.param_groups[0]["lr"] for optimizer in (model.actor.optimizer, model.critic.optimizer)] == [5e-5, 1.5e-4]
    model.env.close()


def test_two_rates_are_kept_in_files(tmp_path):
    model = TwoRateSAC("MlpPolicy", "LinearCost-v0", critic_learning_rate=1e-2, device="cpu", buffer_size=10)
    model.save(tmp_path / "model")
    assert TwoRateSAC.load(tmp_path / "model", device="cpu").critic_learning_rate == 1e-2


def test_other_references_are_nearly_followed_by_who_knows_the_model():
    # and takes the reference for that of the training
    controller = reference_controller(gym.make("Oscillator-v0"))
    for setting, arguments in published.DISTURBANCES["Oscillator-v0"]["other reference"].items():
        env = published.make_env("Oscillator-v0", **arguments)
        env.reset(seed=0)
        assert env.unwrapped.reference(0) == (16.0 if setting == "constant 16" else 8.0)
        outcome = control.roll_out(controller, partial(published.make_env, "Oscillator-v0", **arguments), 3)
        assert (outcome["length"] == 400).all() and (outcome["error"] < 0.5).all()
