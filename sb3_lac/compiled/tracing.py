"""How what an update does is written in a graph, which changes tensors where they are."""

import inspect
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch as th
from stable_baselines3.common.utils import polyak_update

from sb3_lac.updates import backward


class TracedOptimizer:
    """An optimizer whose gradients stay, without wrappers for hooks and profiler, which no graph goes through."""

    def __init__(self, optimizer: th.optim.Optimizer) -> None:
        self._optimizer = optimizer

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        return self._optimizer.param_groups

    def zero_grad(self) -> None:
        """Nothing to do: gradients are overwritten."""

    def step(self) -> None:
        with th.no_grad():
            inspect.unwrap(type(self._optimizer).step)(self._optimizer)


@contextmanager
def traced_optimizers(traced: dict[th.optim.Optimizer, TracedOptimizer], owners: list[Any]) -> Iterator[None]:
    """Have the optimizers of a model and of its networks in a form that can be traced, that of ``traced`` if there is one."""
    named = [(owner, name, value) for owner in owners for name, value in vars(owner).items()]
    optimizers = [place for place in named if isinstance(place[2], th.optim.Optimizer)]
    try:
        for owner, name, optimizer in optimizers:
            setattr(owner, name, traced.setdefault(optimizer, TracedOptimizer(optimizer)))
        yield
    finally:
        for owner, name, optimizer in optimizers:
            setattr(owner, name, optimizer)


@cache
def teach_the_tracer() -> None:
    """Tell PyTorch what to trace in place of functions that no graph goes through."""

    @th.compiler.substitute_in_graph(backward)
    def _backward(loss: th.Tensor, parameters: Sequence[th.Tensor]) -> None:
        trained = [parameter for parameter in parameters if parameter.requires_grad]
        gradients = th.autograd.grad(loss, trained, materialize_grads=True) if trained else ()
        for parameter, gradient in zip(trained, gradients, strict=True):
            # A compiled step reads the tensors that it was compiled with
            assert parameter.grad is not None
            parameter.grad.copy_(gradient)

    @th.compiler.substitute_in_graph(polyak_update)
    def _polyak_update(params: Iterable[th.Tensor], target_params: Iterable[th.Tensor], tau: float) -> None:
        with th.no_grad():
            for param, target_param in zip(params, target_params, strict=True):
                target_param.data.mul_(1 - tau)
                th.add(target_param.data, param.data, alpha=tau, out=target_param.data)
