"""Control problems with a cost, to see what an algorithm learns. Importing this package registers their ids."""

import gymnasium as gym

from sb3_lac.envs.base import CostEnv
from sb3_lac.envs.cart_pole import CartPoleCostEnv
from sb3_lac.envs.linear import LinearCostEnv
from sb3_lac.envs.oscillator import OscillatorEnv
from sb3_lac.envs.pendulum import PendulumCostEnv
from sb3_lac.envs.quadrotor import QuadrotorCostEnv
from sb3_lac.envs.randomisation import DomainRandomization
from sb3_lac.envs.references import ReferenceController, reference_controller
from sb3_lac.envs.vehicle import VehicleCostEnv

for env_id, entry_point, max_episode_steps in (
    ("CartPoleCost-v0", "sb3_lac.envs.cart_pole:CartPoleCostEnv", 250),
    ("LinearCost-v0", "sb3_lac.envs.linear:LinearCostEnv", 100),
    ("Oscillator-v0", "sb3_lac.envs.oscillator:OscillatorEnv", 400),
    ("PendulumCost-v0", "sb3_lac.envs.pendulum:PendulumCostEnv", 200),
    ("QuadrotorCost-v0", "sb3_lac.envs.quadrotor:QuadrotorCostEnv", 300),
    ("VehicleCost-v0", "sb3_lac.envs.vehicle:VehicleCostEnv", 300),
):
    # A second registration would warn
    if env_id not in gym.registry:
        gym.register(env_id, entry_point=entry_point, max_episode_steps=max_episode_steps)

__all__ = [
    "CartPoleCostEnv",
    "CostEnv",
    "DomainRandomization",
    "LinearCostEnv",
    "OscillatorEnv",
    "PendulumCostEnv",
    "QuadrotorCostEnv",
    "ReferenceController",
    "VehicleCostEnv",
    "reference_controller",
]
