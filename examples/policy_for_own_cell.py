"""
Train a policy for a cell: on simulations with its fitted constants, under its recorded loads, at all ages. Two minutes.

It writes ``mine.onnx``, its options ``mine.json``, and ``mine_cell.json``, all for ``battery-calibrate --method policy``.
"""

import json
from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
from stable_baselines3.common.vec_env import VecMonitor

from battery_env import PolicyEstimator, TrajectoryDataset, fit_cell, load_nasa_discharges
from battery_env.loads import recorded
from sb3_lac import LAC, GymnasiumVecEnv
from sb3_lac.onnx import export_onnx

discharges = load_nasa_discharges("B0005")
fit = fit_cell([discharges[0], discharges[84], discharges[167]], cut_off_V=2.7)
fit.to_json("mine_cell.json")

loads = [recorded(discharge.loaded_part(cut_off_V=2.7), "power") for discharge in discharges[::24]]
ages = {"q_mobile_range": (4000.0, 8000.0), "r_o_range": (0.06, 0.3)}
dataset = TrajectoryDataset.generate(("q_mobile", "r_o"), 100, loads, seed=0, cell=fit.cell, mismatch=0.2, **ages)
options = {"nuisance": 0.2, "reading_s": 2.0}  # what the policy sees

env = gym.make_vec(
    "BatteryVoltageJoint-v0",
    num_envs=128,
    autoreset_mode="SameStep",
    dataset=dataset,
    cost="state",
    process_noise_V=0.002,  # the error that the fit leaves, as noise that wanders: 29 mV of voltage on the bundled cells
    new_readings=(0, 145),
    **options,
)
model = LAC(
    "MlpPolicy",
    VecMonitor(GymnasiumVecEnv(env)),
    learning_starts=4000,
    gradient_steps=4,
    gamma=0.6,
    ent_coef="auto_0.1",
    target_entropy=-4.0,
    seed=0,
)
model.learn(164_000)

calibrator = PolicyEstimator(model, "BatteryVoltageJoint-v0", cell=fit.cell, **options)
print(calibrator.estimate(load_nasa_discharges("B0006")[60].loaded_part(cut_off_V=2.7)))

export_onnx(model, "mine.onnx")
Path("mine.json").write_text(json.dumps({"options": {**options, "cell": asdict(fit.cell)}}), encoding="utf-8")
