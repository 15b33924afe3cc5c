"""Small control problems with a cost, to see what LAC learns. Importing this package registers their ids."""

import gymnasium as gym

from sb3_lac.envs.cart_pole import CartPoleCostEnv
from sb3_lac.envs.linear import LinearCostEnv
from sb3_lac.envs.oscillator import OscillatorEnv

for env_id, entry_point, max_episode_steps in (
    ("CartPoleCost-v0", "sb3_lac.envs.cart_pole:CartPoleCostEnv", 250),
    ("LinearCost-v0", "sb3_lac.envs.linear:LinearCostEnv", 100),
    ("Oscillator-v0", "sb3_lac.envs.oscillator:OscillatorEnv", 400),
):
    # A second registration would warn
    if env_id not in gym.registry:
        gym.register(env_id, entry_point=entry_point, max_episode_steps=max_episode_steps)

__all__ = ["CartPoleCostEnv", "LinearCostEnv", "OscillatorEnv"]
