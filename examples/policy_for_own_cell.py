"""
Train a policy for cells that age as a cell of your own did: on simulations along its recorded life. Some minutes.

It needs both packages, and ``pip install '.[onnx]'`` for the file that runs without torch.
It writes ``mine.onnx`` and ``path.json``, for ``PolicyEstimator(OnnxPolicy("mine.onnx"), ..., path="path.json")``.
"""

import gymnasium as gym
from stable_baselines3.common.vec_env import VecMonitor

from battery_env import PolicyEstimator, TrajectoryDataset, fit_life, load_nasa_discharges
from battery_env.loads import constant
from sb3_lac import LAC, GymnasiumVecEnv
from sb3_lac.onnx import export_onnx

path = fit_life(load_nasa_discharges("B0005"))  # your own: read_discharges("life.csv")
loads = [constant(current_A, "current") for current_A in (1.0, 1.5, 2.0, 2.5, 3.0)]
dataset = TrajectoryDataset.along(path, 300, loads, seed=0)
reading_s = (2.0, 20.0)  # s between samples, as testers write them

env = gym.make_vec(
    "BatteryVoltageJoint-v0",
    num_envs=128,
    autoreset_mode="SameStep",
    dataset=dataset,
    path=path,
    reading_s=reading_s,
    cost="state",
    noise_V=(0.0002, 0.010),
    process_noise_V=0.0003,  # the error of the model, as noise that wanders: 7 mV of voltage
)
model = LAC(
    "MlpPolicy",
    VecMonitor(GymnasiumVecEnv(env)),
    learning_starts=4000,
    gradient_steps=4,
    gamma=0.6,
    ent_coef="auto_0.1",
    target_entropy=-4.0,
    policy_kwargs={"net_arch": [64, 64]},
    seed=0,
)
model.learn(84_000)

calibrator = PolicyEstimator(model, "BatteryVoltageJoint-v0", path=path, reading_s=reading_s)
print(calibrator.estimate(load_nasa_discharges("B0006")[60].loaded_part(cut_off_V=2.7)))

export_onnx(model, "mine.onnx")
path.to_json("path.json")
