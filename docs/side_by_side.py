"""
The moving picture of the first page: the same episode of one problem under LAC and under SAC, each with its settings of
``zoo_configs``, after equally many steps of training, seed 0.

.. code-block:: bash

  python -m docs.side_by_side
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.type_aliases import PolicyPredictor

from benchmarks import control
from benchmarks.study import EVALUATION_SEED
from benchmarks.training import train_or_load
from docs.environment_pictures import EPISODES, PICTURES, in_few_colours, plant_of, save_moving

ENV, START = "VehicleCost-v0", EPISODES["VehicleCost-v0"].start
TIMESTEPS, SEED, EPISODES_BESIDE = 30_000, 0, 50
STEPS, STRIDE, PICTURE_MS = 120, 2, 80
_TITLE_HEIGHT = 26


def pictures_of(policy: PolicyPredictor, name: str) -> list[Image.Image]:
    """Pictures of an episode of the mean action, each under its name and how far off the goal it is."""
    env: Any = gym.make(ENV, render_mode="rgb_array")
    observation, info = env.reset(seed=SEED, options={"state": START})
    pictures = []
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 15)
    for step in range(STEPS + 1):
        if step % STRIDE == 0:
            plant = plant_of(env.render())
            picture = Image.new("RGB", (plant.width, plant.height + _TITLE_HEIGHT), "white")
            picture.paste(plant, (0, _TITLE_HEIGHT))
            ImageDraw.Draw(picture).text((12, 5), f"{name}: {info['error']:.2f} m off", "black", font)
            pictures.append(picture)
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            raise RuntimeError(f"{name} left the road: choose another start")
    env.close()
    return pictures


def main(arguments: Sequence[str] | None = None) -> None:
    """Train both, or load them, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("results") / "side_by_side", help="where models are kept")
    models = parser.parse_args(arguments).models
    halves = []
    for algo in ("lac", "sac"):
        policy = train_or_load(algo, ENV, SEED, TIMESTEPS, models)
        error_m = control.roll_out(policy, lambda: gym.make(ENV), EPISODES_BESIDE, EVALUATION_SEED)["error"]
        print(f"{algo.upper()}: {error_m.median():.2g} m off at the end, median of {EPISODES_BESIDE} starts")
        halves.append(pictures_of(policy, algo.upper()))
    both = []
    for left, right in zip(*halves, strict=True):
        picture = Image.new("RGB", (left.width + right.width, left.height), "white")
        picture.paste(left, (0, 0))
        picture.paste(right, (left.width, 0))
        both.append(picture)
    save_moving(in_few_colours(both), PICTURES / "side_by_side.gif", PICTURE_MS)


if __name__ == "__main__":
    main()
