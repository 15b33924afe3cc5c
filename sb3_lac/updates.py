"""What an update is made of, beside its losses."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3.sac.policies import Actor

# Names and values of what is logged
Metrics = tuple[tuple[str, ...], th.Tensor]


def backward(loss: th.Tensor, parameters: Sequence[th.Tensor]) -> None:
    """Let parameters have the gradient of a loss, and nothing else that it depends on. None may be trained: all are frozen."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    if trained:
        loss.backward(inputs=trained)


def actors_of(model: Any) -> list[Actor]:
    """The actors whose distributions an update changes."""
    return [module for module in model.policy.children() if isinstance(module, Actor)]


@contextmanager
def same_distributions(model: Any) -> Iterator[None]:
    """Leave action distributions as they are: what an update samples hangs on a graph, which no model can be copied with."""
    distributions = [vars(actor.action_dist) for actor in actors_of(model)]
    before = [values.copy() for values in distributions]
    try:
        yield
    finally:
        for values, old in zip(distributions, before, strict=True):
            values.update(old)
