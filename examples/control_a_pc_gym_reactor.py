"""
Train LAC and SAC on a control problem of another package: the stirred tank reactor of pc-gym (MIT licence).

A cooling jacket keeps the concentration of a substance at a set point, which changes once. Both classes train with the same
learning rate and networks, and otherwise with their defaults. pc-gym needs Python 3.11 or newer, and brings JAX, CasADi and
do-mpc: install it with ``pip install pcgym`` into an environment of its own that has this package, too. The example takes
some five minutes of a core.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import pcgym
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_lac import LAC

# The reactor of pc-gym's quick start, with 26 minutes instead of 25, noise of 0.1 % and a factor of the reward
REACTOR = {
    "model": "cstr",
    "N": 100,
    "tsim": 26,
    "x0": np.array([0.8, 330.0, 0.8]),  # concentration (mol/L), temperature (K), set point (mol/L)
    "SP": {"Ca": [0.85] * 50 + [0.9] * 50},
    "a_space": {"low": np.array([295.0]), "high": np.array([302.0])},  # temperature of the jacket (K)
    "o_space": {"low": np.array([0.7, 300.0, 0.8]), "high": np.array([1.0, 350.0, 0.9])},
    "r_scale": {"Ca": 1e3},  # the reward of a step is -1000 times the squared error
    "noise": True,
    "noise_percentage": 0.001,
}


class CostOfPcGym(gym.Wrapper):
    """End episodes of pc-gym by time, and name their cost and error: pc-gym returns its time limit as a termination."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, time_is_up, _, info = self.env.step(action)
        concentration, _, set_point = self.unwrapped.state
        return observation, reward, False, time_is_up, {**info, "cost": -reward, "error": abs(concentration - set_point)}


def evaluate(model, env, n_episodes=5):
    """Return the mean cost of an episode under the mean action, and the mean error at its end."""
    costs, errors = [], []
    for _ in range(n_episodes):
        observation, _ = env.reset()
        costs.append(0.0)
        ended = False
        while not ended:
            observation, _, _, ended, info = env.step(model.predict(observation, deterministic=True)[0])
            costs[-1] += info["cost"]
        errors.append(info["error"])
    return np.mean(costs), np.mean(errors)


env = Monitor(CostOfPcGym(pcgym.make_env(REACTOR)))
print("class, seed: cost of an episode before and after the training, error at the end (mol/L)")
for algorithm in (LAC, SAC):
    for seed in range(3):
        model = algorithm("MlpPolicy", env, learning_rate=1e-3, policy_kwargs={"net_arch": [64, 64]}, seed=seed)
        before, _ = evaluate(model, env)
        model.learn(4_000)
        after, error = evaluate(model, env)
        print(f"{algorithm.__name__}, {seed}: {before:.1f} -> {after:.2f}, {error:.5f}", flush=True)
