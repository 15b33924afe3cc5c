"""Train LAC to find R_o from the state of a cell, and see how well it does on discharges that it has not seen."""

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from battery_env import PolicyEstimator, evaluate
from battery_env.callbacks import CalibrationCallback
from sb3_lac import LAC

ENV_ID = "BatteryRo-v0"

# 64 of the test discharges, which no training environment draws from
test_discharges = gym.make(ENV_ID, split="test").unwrapped.dataset[::26]

model = LAC(
    "MlpPolicy",
    make_vec_env(ENV_ID, n_envs=16, seed=0),
    learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
    gamma=0.6,
    ent_coef="auto_0.02",
    target_entropy=-4.0,
    buffer_size=200_000,
    policy_kwargs={"net_arch": [256, 256, 256], "activation_fn": nn.LeakyReLU},
    seed=0,
)
callback = CalibrationCallback(
    lambda candidate: evaluate(PolicyEstimator(candidate, ENV_ID), test_discharges),
    eval_freq=1000,
)
model.learn(50_000, callback=callback)

scores = evaluate(PolicyEstimator(model, ENV_ID), test_discharges)
print(scores[["load", "r_o", "r_o_hat", "r_o_mape_percent"]].describe())
