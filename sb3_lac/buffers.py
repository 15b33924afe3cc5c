"""The replay buffer of a finite horizon, and batches of any."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import BaseBuffer, DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

# Memory of what is sampled at once
_CHUNK_BYTES = 64 * 2**20


class Samples(NamedTuple):
    """
    What an update needs to know of transitions: samples of Stable-Baselines3 and, with a horizon, the undiscounted sums of the
    rewards from them on.
    """

    observations: th.Tensor | TensorDict
    actions: th.Tensor
    next_observations: th.Tensor | TensorDict
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None = None
    horizon_rewards: th.Tensor | None = None

    @classmethod
    def of(cls, sampled: Any) -> "Samples":
        """What there is of it in any object that has these names. It may have others, of any type."""
        values: dict[str, Any] = {name: getattr(sampled, name) for name in cls._fields if name not in cls._field_defaults}
        values |= {name: getattr(sampled, name, None) for name in cls._field_defaults}
        return cls(**values)


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

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
        n_known = max(self.size() - self.horizon + 1, min(self.size(), 1))
        oldest = self.pos if self.full else 0
        return self._get_samples((oldest + np.random.randint(0, n_known, size=batch_size)) % self.buffer_size, env)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
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
        return Samples(
            observations=self.to_torch(self._normalize_obs(self.observations[batch_inds, env_indices], env)),  # type: ignore[arg-type]
            actions=self.to_torch(self.actions[batch_inds, env_indices]),
            next_observations=self.to_torch(
                self._normalize_obs(self.next_observations[batch_inds, env_indices], env)  # type: ignore[arg-type]
            ),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(rewards[:, :1]),
            discounts=None,
            horizon_rewards=self.to_torch(rewards.sum(axis=1, keepdims=True)),
        )


# Nothing that an update does changes what these give next. One with priorities is sampled before each update
_SAMPLED_AT_ONCE = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer, HorizonReplayBuffer)


def batches_at_once(buffer: BaseBuffer, batch_size: int) -> int:
    """Number of batches that may be sampled from a replay buffer in one call."""
    # A method may have been replaced on the instance alone, as ``sample`` by one that adds demonstrations
    replaced = any(callable(getattr(type(buffer), name, None)) for name in vars(buffer))
    if replaced or type(buffer) not in _SAMPLED_AT_ONCE:
        return 1
    space = buffer.observation_space
    observed = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    observed_bytes = sum(math.prod(part.shape or ()) * max(part.dtype.itemsize if part.dtype else 0, 4) for part in observed)
    return max(1, _CHUNK_BYTES // (2 * observed_bytes * batch_size))


def split(samples: Any, n_batches: int) -> list[Any]:
    """
    Split a tensor, or what consists of tensors, into batches of as many rows. Rows that follow one another go to different
    batches, because not all buffers give them in random order: HER has those with goals of its own last.
    """
    if samples is None:
        return n_batches * [None]
    if isinstance(samples, dict):
        by_key = {key: split(part, n_batches) for key, part in samples.items()}
        return [{key: parts[batch] for key, parts in by_key.items()} for batch in range(n_batches)]
    if isinstance(samples, tuple):
        by_name = [split(part, n_batches) for part in samples]
        return [Samples(*(parts[batch] for parts in by_name)) for batch in range(n_batches)]
    return list(samples.unflatten(0, (-1, n_batches)).transpose(0, 1).contiguous().unbind())
