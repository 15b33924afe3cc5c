"""A small environment with costs, and models that are quick to train on it."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_lac import LAC
from sb3_lac.cost_algorithm import CostAlgorithm


class LinearCostEnv(gym.Env):
    """
    Integrator ``s' = s + a / 2`` that has to be driven to zero: the cost is ``|s|^2``, the reward ``offset - cost``.

    :param n_dim: Number of states, and of actions
    :param episode_length: Steps until the end of an episode
    :param terminate: Whether that end is a termination, instead of a time limit
    :param offset: Added to the reward
    """

    def __init__(self, n_dim: int = 2, episode_length: int = 20, terminate: bool = False, offset: float = 0.0):
        self.observation_space = spaces.Box(-10, 10, (n_dim,), np.float32)
        self.action_space = spaces.Box(-1, 1, (n_dim,), np.float32)
        self.episode_length = episode_length
        self.terminate = terminate
        self.offset = offset

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.n_steps = 0
        self.state = self.np_random.uniform(-2, 2, self.observation_space.shape).astype(np.float32)
        return self.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        cost = float(np.sum(self.state**2))
        self.state = np.clip(self.state + 0.5 * action, -10, 10).astype(np.float32)
        end = self.n_steps >= self.episode_length
        return self.state, self.offset - cost, end and self.terminate, end and not self.terminate, {"cost": cost}


@pytest.fixture
def make_env() -> Callable[..., LinearCostEnv]:
    return LinearCostEnv


@pytest.fixture
def make_model() -> Callable[..., CostAlgorithm]:
    def _make_model(
        env: Any = None,
        n_collect: int = 40,
        policy_kwargs: dict[str, Any] | None = None,
        policy: str = "MlpPolicy",
        algorithm: type[CostAlgorithm] = LAC,
        **kwargs: Any
    ) -> CostAlgorithm:
        policy_kwargs = {"net_arch": [16, 16], "activation_fn": nn.LeakyReLU, **(policy_kwargs or {})}
        kwargs = {"learning_starts": 40, "buffer_size": 500, "batch_size": 16, "seed": 0, "device": "cpu", **kwargs}
        kwargs = {"train_freq": 1, "gradient_steps": 1, **kwargs}
        model = algorithm(policy, LinearCostEnv() if env is None else env, policy_kwargs=policy_kwargs, **kwargs)
        model.set_logger(Logger(folder=None, output_formats=[]))
        if n_collect > 0:
            model.learn(n_collect)
        return model

    return _make_model


@pytest.fixture
def n_updates() -> Callable[[LAC], int]:
    def _n_updates(model: LAC) -> int:
        """How often a model has been updated, saved and loaded in between or not."""
        return int(model.lambda_optimizer.state.get(model.log_lambda, {}).get("step", 0))

    return _n_updates


@pytest.fixture
def make_model_without_env(make_model: Callable[..., CostAlgorithm]) -> Callable[..., CostAlgorithm]:
    def _make_model_without_env(n_states: int = 2, n_actions: int = 2, **kwargs: Any) -> CostAlgorithm:
        """A model that never steps its environment, to train on batches of any numbers."""
        env = LinearCostEnv(n_dim=n_actions)
        env.observation_space = spaces.Box(-np.inf, np.inf, (n_states,))
        return make_model(env, n_collect=0, **{"buffer_size": 1, **kwargs})

    return _make_model_without_env


@pytest.fixture
def train_metrics() -> Callable[..., dict[str, float]]:
    def _train_metrics(model: LAC, gradient_steps: int = 1, seed: int = 0) -> dict[str, float]:
        """Train with a reproducible sample of the replay buffer and of the policy."""
        np.random.seed(seed)
        th.manual_seed(seed)
        model.train(gradient_steps=gradient_steps, batch_size=model.batch_size)
        return {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}

    return _train_metrics
