"""
Loops that settle and loops that do not, to try a certificate on: the reference controllers of the cost environments, and the
same ones with too little gain or with the wrong sign.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_lac.envs import reference_controller

# by what the actions of a reference controller are multiplied, by name of the loop.
_FACTORS = {"reference": 1.0, "weak": 0.5, "too weak": 0.15, "wrong sign": -1.0}
# the linear problem is stable by itself: with 15 % of the gain it settles, and with the wrong sign of -14 % hardly leaves
_FACTORS_OF = {"LinearCost-v0": {"reference": 1.0, "weak": 0.15, "hardly unstable": -0.14, "wrong sign": -1.0}}


class ScaledController:
    """
    A controller whose actions are multiplied by a factor.

    :param controller: the controller
    :param factor: -1 .. 1
    """

    def __init__(self, controller: PolicyPredictor, factor: float) -> None:
        self.controller, self.factor = controller, factor

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions, as Stable-Baselines3 predicts them."""
        actions, state = self.controller.predict(observation, state, episode_start, deterministic)
        return self.factor * actions, state


def factors(env_id: str) -> dict[str, float]:
    """The loops of an environment."""
    return _FACTORS_OF.get(env_id, _FACTORS)


def controllers(env_id: str) -> dict[str, PolicyPredictor]:
    """Controllers that settle, and controllers that do not."""
    reference = reference_controller(gym.make(env_id))
    return {name: ScaledController(reference, factor) for name, factor in factors(env_id).items()}
