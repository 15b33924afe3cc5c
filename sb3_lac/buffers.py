"""Batches of any replay buffer."""

import math
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import BaseBuffer, DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict

# Memory of what is sampled at once
_CHUNK_BYTES = 64 * 2**20


class Samples(NamedTuple):
    """
    Sampled transitions for an update: samples of Stable-Baselines3 and, with a horizon, the undiscounted sums of the rewards
    from each transition on.
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
        """Take these fields from any object that has some of them. It may have other fields, of any type."""
        values: dict[str, Any] = {name: getattr(sampled, name) for name in cls._fields if name not in cls._field_defaults}
        values |= {name: getattr(sampled, name, None) for name in cls._field_defaults}
        return cls(**values)


#: Nothing that an update does changes what these give next. One with priorities is sampled before each update
SAMPLED_AT_ONCE: set[type[BaseBuffer]] = {ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer}


def batches_at_once(buffer: BaseBuffer, batch_size: int) -> int:
    """Number of batches that may be sampled from a replay buffer in one call."""
    # A method may have been replaced on the instance alone, as ``sample`` by one that adds demonstrations
    replaced = any(callable(getattr(type(buffer), name, None)) for name in vars(buffer))
    if replaced or type(buffer) not in SAMPLED_AT_ONCE:
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


def __getattr__(name: str) -> Any:
    """Find what files of earlier models name here."""
    if name != "HorizonReplayBuffer":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_lac.published_lac import HorizonReplayBuffer  # which imports this module

    return HorizonReplayBuffer
