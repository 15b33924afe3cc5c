"""The replay buffer of a finite horizon."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize


class HorizonReplayBufferSamples(NamedTuple):
    """Samples of a replay buffer, and the undiscounted sums of the rewards from them on."""

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    horizon_rewards: th.Tensor


class HorizonReplayBuffer(ReplayBuffer):
    """
    Replay buffer that tells the sum of the rewards of ``horizon`` steps, from that of the transition on. Behind the end of an
    episode, a time limit or a termination, its last reward goes on, as in the code of Han et al. (2020). The latest
    transitions, whose horizon is not over yet, are not sampled. While fewer steps than a horizon are stored it is the oldest
    transition that is, and the latest reward that goes on.

    :param args: Arguments of ``ReplayBuffer``
    :param horizon: Number of steps whose rewards are summed
    :param kwargs: Arguments of ``ReplayBuffer``. ``optimize_memory_usage`` is not supported.
    """

    def __init__(self, *args: Any, horizon: int = 5, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.horizon = horizon
        if self.optimize_memory_usage:
            raise NotImplementedError("HorizonReplayBuffer doesn't support optimize_memory_usage=True")

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> HorizonReplayBufferSamples:  # type: ignore[override]
        n_known = max(self.size() - self.horizon + 1, min(self.size(), 1))
        oldest = self.pos if self.full else 0
        return self._get_samples((oldest + np.random.randint(0, n_known, size=batch_size)) % self.buffer_size, env)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> HorizonReplayBufferSamples:
        # Sample randomly the env idx
        env_indices = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        n_stored = min(self.horizon, self.size())
        steps = (batch_inds[:, None] + np.arange(n_stored)) % self.buffer_size
        # The step itself or, behind the end of its episode, the last one
        ends = self.dones[steps, env_indices[:, None]] > 0
        last = np.where(ends.any(axis=1), ends.argmax(axis=1), n_stored - 1)
        steps = (batch_inds[:, None] + np.minimum(np.arange(self.horizon), last[:, None])) % self.buffer_size
        rewards = self._normalize_reward(self.rewards[steps, env_indices[:, None]], env)
        dones = self.dones[batch_inds, env_indices] * (1 - self.timeouts[batch_inds, env_indices])
        return HorizonReplayBufferSamples(
            observations=self.to_torch(self._normalize_obs(self.observations[batch_inds, env_indices], env)),  # type: ignore
            actions=self.to_torch(self.actions[batch_inds, env_indices]),
            next_observations=self.to_torch(
                self._normalize_obs(self.next_observations[batch_inds, env_indices], env)  # type: ignore[arg-type]
            ),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(rewards[:, :1]),
            discounts=None,
            horizon_rewards=self.to_torch(rewards.sum(axis=1, keepdims=True)),
        )
