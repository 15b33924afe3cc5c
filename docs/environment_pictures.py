"""
Draw the pictures of the control problems, docs/pictures/ID.png: states and costs in an episode of each reference controller.

.. code-block:: bash

  python -m docs.environment_pictures
"""

from __future__ import annotations

import gymnasium as gym
from matplotlib.image import imsave

from battery_env.files import replacing
from docs.environment_pages import CONTROL_IDS, PICTURES
from sb3_lac.envs import reference_controller

_SEED = 3


def main() -> None:
    """Write all of them."""
    for env_id in CONTROL_IDS:
        env = gym.make(env_id, render_mode="rgb_array")
        controller, (observation, _), done = reference_controller(env), env.reset(seed=_SEED), False
        while not done:
            action, _ = controller.predict(observation, deterministic=True)
            observation, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
        with replacing(PICTURES / f"{env_id}.png") as part:
            imsave(part, env.render(), format="png")


if __name__ == "__main__":
    main()
