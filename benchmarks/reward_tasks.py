"""
Four small tasks that pay rewards, which LAC was not made for: a sparse reward, a bonus, a reward for living, and goals that
change. Importing this module registers them.

.. code-block:: bash

  python -m benchmarks.compare --defaults --envs benchmarks.reward_tasks:SparseGoal-v0 --out results/reward_tasks
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_lac.envs import CartPoleCostEnv


class PointMass(gym.Env[Any, np.ndarray]):
    """
    A mass on a square of 2 m x 2 m, which two forces push and friction slows down; walls stop it. It starts at rest, anywhere.
    What it observes is its position and velocity. A step is 0.1 s.
    """

    GOAL_RADIUS_M = 0.1

    def __init__(self) -> None:
        high = np.array([1.0, 1.0, 2.0, 2.0], dtype=np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Box(-high, high)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.goal = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.velocity = self.np_random.uniform(-1.0, 1.0, 2), np.zeros(2)
        return self._observation(), {}

    def _move(self, action: np.ndarray) -> None:
        self.velocity = 0.9 * self.velocity + 0.2 * np.clip(action, -1.0, 1.0)
        moved = self.position + 0.1 * self.velocity
        self.position = np.clip(moved, -1.0, 1.0)
        self.velocity[moved != self.position] = 0.0

    def _observation(self) -> Any:
        return np.concatenate([self.position, self.velocity]).astype(np.float32)


class CentreEnv(PointMass):
    """
    The mass is to come to the centre, where the episode ends.

    :param at_goal: reward of the step that arrives
    :param elsewhere: reward of every other step
    """

    def __init__(self, at_goal: float, elsewhere: float) -> None:
        super().__init__()
        self.at_goal, self.elsewhere = at_goal, elsewhere

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._move(action)
        arrived = bool(np.linalg.norm(self.position - self.goal) <= self.GOAL_RADIUS_M)
        return self._observation(), self.at_goal if arrived else self.elsewhere, arrived, False, {}


class AnyGoalEnv(PointMass):
    """The mass is to come to a place that each episode draws, and to stay: a step pays 0 there and -1 elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        place = spaces.Box(-1.0, 1.0, (2,), np.float32)
        parts = {"observation": self.observation_space, "achieved_goal": place, "desired_goal": place}
        self.observation_space = spaces.Dict(parts)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._move(action)
        observed = self._observation()
        reward = self.compute_reward(observed["achieved_goal"], observed["desired_goal"], {})
        return observed, float(reward), False, False, {}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """The reward at one place, or at many, as HerReplayBuffer asks for it."""
        return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > self.GOAL_RADIUS_M).astype(np.float32)

    def _observation(self) -> dict[str, np.ndarray]:
        places = {"achieved_goal": self.position.astype(np.float32), "desired_goal": self.goal.astype(np.float32)}
        return {"observation": super()._observation(), **places}


class StayAliveEnv(CartPoleCostEnv):
    """The cart and pole of ``CartPoleCost-v0``, where each step pays 1, also the one that falls."""

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        return -1.0, super()._cost(state, action, next_state)[1]


for env_id, entry_point, max_episode_steps, kwargs in (
    ("SparseGoal-v0", "CentreEnv", 50, {"at_goal": 1.0, "elsewhere": 0.0}),
    ("BonusGoal-v0", "CentreEnv", 50, {"at_goal": 100.0, "elsewhere": -1.0}),
    ("StayAlive-v0", "StayAliveEnv", 250, {}),
    ("AnyGoal-v0", "AnyGoalEnv", 50, {}),
):
    gym.register(env_id, f"{__name__}:{entry_point}", max_episode_steps=max_episode_steps, kwargs=kwargs)
