"""
The moving picture of the first page: the same episode of one problem under LAC and under SAC, each with its settings of
``zoo_configs``, after equally many steps of training, seed 0. Below, how far off its goal either has been so far.

.. code-block:: bash

  python -m docs.side_by_side
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.type_aliases import PolicyPredictor

from battery_env.plotting import COLOUR_OF
from benchmarks import control
from benchmarks.runs import train_or_load
from benchmarks.study import EVALUATION_SEED
from benchmarks.zoo_runs import zoo_run
from docs.environment_pictures import EPISODES, PICTURES, in_few_colours, save_moving

ENV, START = "VehicleCost-v0", EPISODES["VehicleCost-v0"].start
TIMESTEPS, SEED, EPISODES_BESIDE = 30_000, 0, 50
STEPS, STRIDE, PICTURE_MS = 120, 2, 80
# of a picture of one car, of the part of it that is shown, and of the curves below
_WIDTH, _HEIGHT, _ZOOM, _CURVES_HEIGHT, _LARGEST_M = 320, 170, 2.2, 110, 0.5
_FONT = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 14)


def around_the_car(frame: np.ndarray) -> Image.Image:
    """The car, which is orange, and the road beside it, of what ``render()`` draws."""
    plant = frame[:, : frame.shape[1] // 2].astype(np.int64)
    rows, columns = np.nonzero((plant[..., 0] > 200) & (plant[..., 2] < 80))
    width = plant.shape[1] / _ZOOM
    height = width * _HEIGHT / _WIDTH
    left, top = columns.mean() - 0.3 * width, rows.mean() - 0.5 * height
    box = (round(left), round(top), round(left + width), round(top + height))
    whole = Image.new("RGB", (plant.shape[1], plant.shape[0]), "white")
    whole.paste(Image.fromarray(plant.astype(np.uint8)))
    return whole.crop(box).resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)


def episode(policy: PolicyPredictor, name: str) -> tuple[list[Image.Image], list[float]]:
    """Pictures of an episode of the mean action, and how far off the goal it is at each step."""
    env: Any = gym.make(ENV, render_mode="rgb_array")
    observation, info = env.reset(seed=SEED, options={"state": START})
    pictures, errors_m = [], []
    for step in range(STEPS + 1):
        errors_m.append(info["error"])
        if step % STRIDE == 0:
            pictures.append(around_the_car(env.render()))
            ImageDraw.Draw(pictures[-1]).text((12, 5), f"{name}: {info['error']:.2f} m off", "black", _FONT)
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            raise RuntimeError(f"{name} left the road: choose another start")
    env.close()
    return pictures, errors_m


def curves(errors_m: dict[str, list[float]], steps: int) -> Image.Image:
    """How far off the middle of the road each has been, up to a step."""
    picture = Image.new("RGB", (2 * _WIDTH, _CURVES_HEIGHT), "white")
    pen = ImageDraw.Draw(picture)
    left, bottom, scale_x, scale_y = 12, _CURVES_HEIGHT - 8, (2 * _WIDTH - 90) / STEPS, (_CURVES_HEIGHT - 34) / _LARGEST_M
    pen.text(
        (left, 2), f"distance from the middle of the road, 0 to {_LARGEST_M:g} m, over {STEPS * 0.05:g} s", "black", _FONT
    )
    pen.line((left, bottom, left + STEPS * scale_x, bottom), "black", 1)
    for name, values in errors_m.items():
        colour = COLOUR_OF[name]
        points = [(left + k * scale_x, bottom - min(values[k], _LARGEST_M) * scale_y) for k in range(steps + 1)]
        pen.line(points, colour, 3, joint="curve")
        pen.text((points[-1][0] + 6, min(points[-1][1], bottom - 6) - 8), name, colour, _FONT)
    return picture


def main(arguments: Sequence[str] | None = None) -> None:
    """Train both, or load them, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("results") / "side_by_side", help="where models are kept")
    models = parser.parse_args(arguments).models
    halves, errors_m = [], {}
    for algo in ("lac", "sac"):
        policy = train_or_load(zoo_run(algo, ENV, SEED, TIMESTEPS), models)
        error_m = control.roll_out(policy, lambda: gym.make(ENV), EPISODES_BESIDE, EVALUATION_SEED)["error"]
        print(f"{algo.upper()}: {error_m.median():.2g} m off at the end, median of {EPISODES_BESIDE} starts")
        pictures, errors_m[algo.upper()] = episode(policy, algo.upper())
        halves.append(pictures)
    both = []
    for number, (left, right) in enumerate(zip(*halves, strict=True)):
        picture = Image.new("RGB", (2 * _WIDTH, _HEIGHT + _CURVES_HEIGHT), "white")
        picture.paste(left, (0, 0))
        picture.paste(right, (_WIDTH, 0))
        picture.paste(curves(errors_m, number * STRIDE), (0, _HEIGHT))
        both.append(picture)
    save_moving(in_few_colours(both), PICTURES / "side_by_side.gif", PICTURE_MS)


if __name__ == "__main__":
    main()
