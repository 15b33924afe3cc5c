"""Trainings that were good once: the line as typed on batteries, and one setting tuned to nothing on control problems."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from benchmarks.control import roll_out
from sb3_lac import LAC


def trained_as_typed(env_id):
    return LAC("MlpPolicy", env_id, seed=11, device="cpu").learn(20_000)


def trained_by_an_untuned_setting(env_id):
    settings = {"learning_rate": 1e-3, "gradient_steps": 2, "learning_starts": 1000, "gamma": 0.99}
    policy_kwargs = {"net_arch": [64, 64], "activation_fn": nn.LeakyReLU}
    env = make_vec_env(env_id, n_envs=4)
    return LAC("MlpPolicy", env, policy_kwargs=policy_kwargs, seed=5, device="cpu", **settings).learn(15_000)


def percent_off(model, env_id):
    """How far off the parameter is, in the mean over held-out discharges, by the mean action in episodes of 400 steps."""
    env = gym.make(env_id, split="test", episode_steps=400)
    (parameter,) = env.unwrapped.task.parameters
    errors = []
    for seed in range(30):
        observation, _ = env.reset(seed=seed)
        is_over = False
        while not is_over:
            observation, _, _, is_over, info = env.step(model.predict(observation, deterministic=True)[0])
            errors.append(abs(info[f"{parameter}_hat"] / info[parameter] - 1.0))
    return 100.0 * np.mean(errors)


def cost_a_step(model, env_id):
    return roll_out(model, partial(gym.make, env_id), episodes=60)["cost"].mean()


def not_yet(*row, reason):
    return pytest.param(*row, marks=pytest.mark.xfail(reason=reason, strict=True))


@pytest.mark.attacks
@pytest.mark.parametrize(
    ("train", "score", "env_id", "most"),
    [
        not_yet(
            *(trained_as_typed, percent_off, "BatteryQmax-v0", 0.5),
            reason="1.5 % with the square root and an entropy coefficient from 0.1; 0.05 % with the fourth root, from 1",
        ),
        (trained_as_typed, percent_off, "BatteryRo-v0", 0.2),
        not_yet(
            *(trained_by_an_untuned_setting, cost_a_step, "VehicleCost-v0", 0.008),
            reason="0.11 with the square root and an entropy coefficient from 0.1; 0.002 with the fourth root",
        ),
        (trained_by_an_untuned_setting, cost_a_step, "QuadrotorCost-v0", 0.06),
    ],
)
def test_a_training_that_was_good_once_is_good(train, score, env_id, most):
    assert score(train(env_id), env_id) <= most
