"""
Draw the control problems: what happens in an episode of each reference controller, as ``render()`` shows it. Of each id,
docs/pictures/ID.gif moves and shows the plant, and docs/pictures/ID.png is the picture at the end, with states and costs.

.. code-block:: bash

  python -m docs.environment_pictures
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from battery_env.files import replacing
from sb3_lac.envs import reference_controller

#: Where the pictures are.
PICTURES = Path(__file__).parent / "pictures"
_SEED = 3
_SIZE = (320, 240)
#: Of the drawings: few, so that files are small.
_COLOURS = ("black", "0.2", "0.6", "0.8", "tab:green", "tab:orange", "tab:blue", "#0072b2", "#d55e00")


class Episode(NamedTuple):
    """What is shown of a problem: the start, how many steps, every how many a picture and for how long, and what to see."""

    start: list[float]
    steps: int
    stride: int
    picture_ms: int
    caption: str


#: One of each problem.
EPISODES = {
    "CartPoleCost-v0": Episode(
        [-5.0, 0.0, 0.0, 0.0],
        250,
        4,
        80,
        "The cart first runs away from the green line, so that the pole leans towards it, and then follows the pole. "
        "In real time; the pole is drawn five times as long as it is.",
    ),
    "LinearCost-v0": Episode(
        [-1.0, 1.0],
        30,
        1,
        100,
        "The state goes straight to its goal, the green disc; then only the noise moves it. A dot is a step.",
    ),
    "Oscillator-v0": Episode(
        [1.0, 2.0, 3.0, 4.0, 5.0, 1.0],
        200,
        5,
        100,
        "Light holds the first protein (orange) on its reference (green). Areas are concentrations, and lines are repression.",
    ),
    "PendulumCost-v0": Episode(
        [3.0, 0.0],
        100,
        1,
        50,
        "The motor cannot lift the pendulum; three swings pump in enough energy to reach the green ring. In real time.",
    ),
    "QuadrotorCost-v0": Episode(
        [-1.1, -1.2, -0.3, 0.0, 0.0, 0.0],
        120,
        3,
        60,
        "The quadrotor tilts to fly sideways, tilts back to brake, and hovers in the green ring. The dashed lines end an "
        "episode. In real time.",
    ),
    "VehicleCost-v0": Episode(
        [-1.7, 0.1, 0.0, 0.0, 0.0, 20.0],
        80,
        1,
        50,
        "The car starts at the edge of the road, and then follows its middle (green) through the bends. In real time.",
    ),
}


def draw(env_id: str, episode: Episode) -> tuple[list[Image.Image], Image.Image]:
    """The moving picture and the one at the end."""
    env: Any = gym.make(env_id, render_mode="rgb_array")
    controller, frames = reference_controller(env), []
    observation, _ = env.reset(seed=_SEED, options={"state": episode.start})
    n_steps, done = 0, False
    while not done:
        if n_steps <= episode.steps and n_steps % episode.stride == 0:
            frames.append(env.render())
        observation, _, terminated, truncated, _ = env.step(controller.predict(observation)[0])
        n_steps, done = n_steps + 1, terminated or truncated
    moving = in_few_colours([plant_of(frame) for frame in frames])
    return moving, Image.fromarray(env.render()).quantize(128, Image.Quantize.MAXCOVERAGE)


def plant_of(frame: np.ndarray) -> Image.Image:
    """The plant, which is the left half of what ``render()`` draws."""
    return Image.fromarray(frame[:, : frame.shape[1] // 2]).resize(_SIZE)


def in_few_colours(pictures: Sequence[Image.Image]) -> list[Image.Image]:
    """White, and each colour of the drawings with two tints of it, so that files are small."""
    tints = [value + tint * (1.0 - value) for name in _COLOURS for tint in (0.0, 0.35, 0.7) for value in to_rgb(name)]
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *(round(255 * value) for value in tints)])
    return [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]


def save_moving(pictures: Sequence[Image.Image], path: Path, picture_ms: int) -> None:
    """Write a GIF that rests at its end."""
    first, *others = pictures
    durations_ms = [picture_ms] * len(others) + [1500]
    with replacing(path) as part:
        first.save(part, "GIF", save_all=True, append_images=others, duration=durations_ms, loop=0)


def main() -> None:
    """Write all of them."""
    for env_id, episode in EPISODES.items():
        moving, last = draw(env_id, episode)
        save_moving(moving, PICTURES / f"{env_id}.gif", episode.picture_ms)
        with replacing(PICTURES / f"{env_id}.png") as part:
            last.save(part, "PNG", optimize=True)


if __name__ == "__main__":
    main()
