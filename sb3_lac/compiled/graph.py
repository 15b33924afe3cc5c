"""Compiled code that runs on other samples, and what it would leave out."""

import inspect
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch as th
from stable_baselines3.common.policies import BaseModel
from torch.nn.modules.module import _has_any_global_hook
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks


def modules_of(network: th.nn.Module) -> list[th.nn.Module]:
    """List ``network.modules()`` in a tenth of the time."""
    modules = [network]
    for module in modules:
        modules += [part for part in module._modules.values() if part is not None]
    return modules


def not_in_a_graph(networks: Sequence[BaseModel], optimizers: Sequence[th.optim.Optimizer]) -> str | None:
    """Name what an update has beside the code of networks and the optimizers of PyTorch, as hooks: no graph would call it."""
    if _has_any_global_hook():
        return "hooks of all modules"
    if _global_optimizer_pre_hooks or _global_optimizer_post_hooks:
        return "hooks of all optimizers"
    for optimizer in optimizers:
        if optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks:
            return f"hooks of the optimizer {type(optimizer).__name__}"
        if "step" in vars(optimizer) or not inspect.unwrap(type(optimizer).step).__module__.startswith("torch.optim."):
            return f"a step() that is not that of torch.optim ({type(optimizer).__name__})"
    optimized = {
        id(parameter) for optimizer in optimizers for group in optimizer.param_groups for parameter in group["params"]
    }
    for network, module in [(owner, part) for owner in networks for part in modules_of(owner)]:
        if module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks:
            return f"hooks of the network {type(module).__name__}"
        if "forward" in vars(module):
            return f"a forward() that was replaced ({type(module).__name__})"
        for name, parameter in module._parameters.items():
            if parameter is None or not parameter.requires_grad:
                continue
            if parameter._backward_hooks or parameter._post_accumulate_grad_hooks:
                return f"hooks of the gradient of {name} ({type(module).__name__})"
            # Target networks have no optimizer
            if id(parameter) not in optimized and hasattr(network, "optimizer"):
                return f"the gradient of {name} ({type(module).__name__}), which is in no optimizer of the model"
    return None


def tensors_of(*values: Any) -> list[th.Tensor]:
    """The tensors in samples, in their order."""
    tensors = []
    for value in values:
        if isinstance(value, th.Tensor):
            tensors.append(value)
        elif value is not None:
            tensors += tensors_of(*(value.values() if isinstance(value, dict) else value))
    return tensors


class Graph:
    """
    Compiled code, as a function of all tensors that an update reads, which a GPU replays at one launch (CUDA graph) as soon as
    it has run once on tensors that are still where they were, apart from samples.
    """

    def __init__(self, function: Callable[..., Sequence[th.Tensor]], sampled: Sequence[th.Tensor], on_gpu: bool) -> None:
        self._function = function
        self._sampled = sampled
        self._on_gpu = on_gpu
        # All but parts of samples, and where those are among them
        self._inputs: list[th.Tensor | None] = []
        self._parts: dict[int, int] = {}
        self._addresses: list[int] = []
        self._cuda_graph: th.cuda.CUDAGraph | None = None
        self._copies: list[th.Tensor] = []
        self._outputs: Sequence[th.Tensor] = ()
        self.is_metrics_alone = False

    def __call__(self, *inputs: th.Tensor) -> Sequence[th.Tensor]:
        """Run as PyTorch calls it, after it has checked that the code is still that of the update."""
        index_of_sample = {id(part): index for index, part in enumerate(self._sampled)}
        self._parts = {at: index_of_sample[id(tensor)] for at, tensor in enumerate(inputs) if id(tensor) in index_of_sample}
        self._inputs = [None if at in self._parts else tensor for at, tensor in enumerate(inputs)]
        # A number that is read from the processor would be the same in each replay
        self._on_gpu = self._on_gpu and all(tensor.is_cuda for tensor in inputs)
        outputs = self._run(inputs)
        self.is_metrics_alone = len(outputs) == 1
        return outputs

    def again(self, sampled: Sequence[th.Tensor]) -> th.Tensor:
        """Run on other samples of the same form, without that check, and return the one output, the metrics."""
        inputs: list[Any] = self._inputs.copy()
        for at, index in self._parts.items():
            inputs[at] = sampled[index]
        (metrics,) = self._run(inputs)
        return metrics

    def _run(self, inputs: Sequence[th.Tensor]) -> Sequence[th.Tensor]:
        if not self._on_gpu:
            return self._function(*inputs)
        addresses = [tensor.data_ptr() for at, tensor in enumerate(inputs) if at not in self._parts]
        if addresses != self._addresses:
            self._addresses, self._cuda_graph = addresses, None
            return self._function(*inputs)
        if self._cuda_graph is None:
            try:
                self._cuda_graph = self._capture(inputs)
            except RuntimeError as error:
                warnings.warn(f"The update is not replayed as a CUDA graph, and slower: {error}", stacklevel=2)
                self._on_gpu = False
                return self._function(*inputs)
        th._foreach_copy_(self._copies, [inputs[at] for at in self._parts])
        self._cuda_graph.replay()
        # The next replay overwrites them
        return [output.clone() for output in self._outputs]

    def _capture(self, inputs: Sequence[th.Tensor]) -> th.cuda.CUDAGraph:
        """Record what the GPU is to do, without doing it."""
        static = [tensor.clone() if at in self._parts else tensor for at, tensor in enumerate(inputs)]
        self._copies = [static[at] for at in self._parts]
        cuda_graph = th.cuda.CUDAGraph()
        with th.cuda.graph(cuda_graph):
            self._outputs = self._function(*static)
        return cuda_graph
