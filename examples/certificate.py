"""Train LAC to balance a pole, and look at what its Lyapunov function is worth as a certificate."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_lac import LAC, certify, evaluate_lyapunov

model = LAC(
    "MlpPolicy",
    "CartPoleCost-v0",
    learning_starts=1000,
    policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.LeakyReLU},
    seed=0,
)
model.learn(8_000)

folder = Path("results/certificate")
folder.mkdir(parents=True, exist_ok=True)
names = ["x (m)", "dx/dt (m/s)", "theta (rad)", "dtheta/dt (rad/s)"]

# Episodes of 600 steps: with a discount of 0.99, costs beyond them count for little
report = evaluate_lyapunov(model, gym.make("CartPoleCost-v0", max_episode_steps=600), n_episodes=50, seed=1)
print(report.summary())
report.plot().savefig(folder / "certificate.png")

# On a grid, with some noise so that no two episodes are alike: an exact interval for each start
angles, rates = np.meshgrid(np.linspace(-0.3, 0.3, 13), np.linspace(-3.0, 3.0, 13))
starts = np.column_stack([np.zeros((angles.size, 2)), angles.ravel(), rates.ravel()])
noisy = make_vec_env("CartPoleCost-v0", n_envs=len(starts), env_kwargs={"process_noise": 0.01})
grid = certify(model, noisy, n_episodes=300, ultimate_bound=1.0, starts=starts, n_episodes_per_start=20, seed=1)
print(grid.summary())
grid.plot_region_of_attraction(2, 3, names).savefig(folder / "attraction.png")
