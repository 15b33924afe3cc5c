import warnings
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize


class HorizonReplayBufferSamples(NamedTuple):
    """Transitions with the rewards of the steps that follow them. The first six fields are those of SB3's samples."""

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    #: Discounted sum of the rewards of the next ``horizon`` steps, 0 after a termination
    horizon_returns: th.Tensor


class HorizonReplayBuffer(ReplayBuffer):
    """
    Replay buffer for the finite horizon Lyapunov candidate: each sample comes with the discounted sum of the rewards of its
    ``horizon`` steps, itself included.

    After a termination nothing more is paid, so that its sum is complete. The future of a transition close to a time limit,
    or close to the latest step of an episode that still goes on, is unknown: such transitions are not sampled (an unfinished
    episode's become available as it goes on). A sum of fewer steps in their place would be too small.
    The ``NStepReplayBuffer`` of Stable-Baselines3 cannot express this: it samples all transitions, leaves the unknown rest of
    a sum to a target network, and returns the last of the next states where the decrease condition needs the first one.

    :param buffer_size: Max number of elements in the buffer
    :param observation_space: Observation space
    :param action_space: Action space
    :param device: PyTorch device
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Not supported
    :param handle_timeout_termination: Whether a time limit is told from a termination
    :param horizon: Number of steps that are summed
    :param gamma: Discount factor in the sum, may be 1
    """

    def __init__(self, *args: Any, horizon: int = 5, gamma: float = 0.99, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.optimize_memory_usage:
            raise NotImplementedError("HorizonReplayBuffer doesn't support optimize_memory_usage=True")
        if horizon > self.buffer_size:
            raise ValueError(f"horizon={horizon} must not be larger than the {self.buffer_size} steps of buffer_size per env.")
        self.horizon = horizon
        self.gamma = gamma
        # Whether the sum of each stored transition is known, and how many steps the running episodes have
        self.complete = np.zeros((self.buffer_size, self.n_envs), dtype=bool)
        self.n_complete = 0
        self.episode_lengths = np.zeros(self.n_envs, dtype=np.int64)
        self.warned = False

    def reset(self) -> None:
        super().reset()
        self.complete[:] = False
        self.n_complete = 0
        self.episode_lengths[:] = 0

    def end_episodes(self) -> None:
        """Let no episode go on: the next transitions are the first ones of others."""
        self.episode_lengths[:] = 0

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        pos = self.pos
        self.n_complete -= int(self.complete[pos].sum())
        self.complete[pos] = False
        super().add(obs, next_obs, action, reward, done, infos)

        # The last episode of a buffer that was filled elsewhere does not go on here
        is_next = (self.next_observations[pos - 1] == self.observations[pos]).reshape(self.n_envs, -1).all(axis=1)
        self.episode_lengths = np.where(is_next, self.episode_lengths, 0) + 1
        # The oldest step whose sum may end here, and with a termination all steps after it too
        has_horizon = self.episode_lengths >= self.horizon
        self.complete[(pos - self.horizon + 1) % self.buffer_size, has_horizon] = True
        self.n_complete += int(has_horizon.sum())
        finished = self.dones[pos] > 0
        cut_short = finished & (self.timeouts[pos] > 0) & ~has_horizon
        if cut_short.any() and not self.warned:
            self.warned = True
            warnings.warn(
                f"A time limit ended an episode of {self.episode_lengths[cut_short].min()} steps, which is shorter than "
                f"horizon={self.horizon}: what follows is unknown, and nothing is learned from such an episode. "
                "Use a smaller horizon or longer episodes.",
                stacklevel=2,
            )
        for env_idx in np.flatnonzero(finished & (self.timeouts[pos] == 0)):
            n_steps = min(self.horizon, int(self.episode_lengths[env_idx]))
            ends = (pos - np.arange(n_steps)) % self.buffer_size
            self.n_complete += n_steps - int(self.complete[ends, env_idx].sum())
            self.complete[ends, env_idx] = True
        self.episode_lengths[finished] = 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> HorizonReplayBufferSamples:  # type: ignore[override]
        """"""
        if self.n_complete == 0:
            raise ValueError(
                f"No stored episode is as long as horizon={self.horizon} steps: use a smaller horizon, "
                "or a larger learning_starts (which counts the steps of all environments together)."
            )
        size = self.buffer_size if self.full else self.pos
        rows, envs = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        # Most transitions have a known sum: drawing again is cheaper than listing them
        while len(rows) < batch_size:
            n_candidates = min(10 * batch_size, 1 + (batch_size - len(rows)) * size * self.n_envs // self.n_complete)
            new_rows, new_envs = np.random.randint(0, size, n_candidates), np.random.randint(0, self.n_envs, n_candidates)
            known = self.complete[new_rows, new_envs]
            rows, envs = np.append(rows, new_rows[known]), np.append(envs, new_envs[known])
        return self._get_horizon_samples(rows[:batch_size], envs[:batch_size], env)

    def _get_horizon_samples(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> HorizonReplayBufferSamples:
        """"""
        future = (rows[:, None] + np.arange(self.horizon)) % self.buffer_size
        rewards = self._normalize_reward(self.rewards[future, envs[:, None]], env)
        # Steps after a termination belong to the next episode
        done = self.dones[future, envs[:, None]]
        weights = self.gamma ** np.arange(self.horizon, dtype=np.float32) * (np.cumsum(done, axis=1) - done == 0)
        return HorizonReplayBufferSamples(
            observations=self.to_torch(self._normalize_obs(self.observations[rows, envs], env)),  # type: ignore[arg-type]
            actions=self.to_torch(self.actions[rows, envs]),
            next_observations=self.to_torch(self._normalize_obs(self.next_observations[rows, envs], env)),  # type: ignore[arg-type]
            dones=self.to_torch((self.dones[rows, envs] * (1 - self.timeouts[rows, envs]))[:, None]),
            rewards=self.to_torch(rewards[:, :1]),
            discounts=None,
            horizon_returns=self.to_torch((weights * rewards).sum(axis=1, keepdims=True)),
        )

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        raise NotImplementedError("Use sample(): not all stored transitions have a known sum.")
