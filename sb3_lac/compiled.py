"""Steps of an update, and all of it as one compiled graph. What an update is stands in ``lac.py``."""

import inspect
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.sac.policies import Actor
from torch.nn.modules.module import _has_any_global_hook
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from sb3_lac.buffers import Samples

# The first version that traces gradients within a graph
_OLDEST_TORCH = "2.11"
#: Backend of ``torch.compile``. Tests have a quicker one
BACKEND = "inductor"
# In place of a learning rate of 0: with Adam's epsilon of 1e-8, no weight changes by it
_SMALLEST_RATE = 1e-30
# What networks take in a graph. What the space of the environment needs, as to make images of bytes, no graph goes through
_NUMBERS = spaces.Box(-math.inf, math.inf, (1,))
# What sampling leaves behind in an action distribution. The graphs that it belongs to are gone after an update
_LEFT_BEHIND = ("distribution", "gaussian_actions", "weights_dist", "exploration_mat", "exploration_matrices", "_latent_sde")

# What PyTorch would ask before each use of a graph, and what only changes where code is rewritten while a model trains
_UNASKED = ("CLOSURE_MATCH", "DICT_NOT_CONTAINS", "DUPLICATE_INPUT", "HASATTR", "NOT_PRESENT_IN_GENERIC_DICT")

# Names and values of what is logged
Metrics = tuple[tuple[str, ...], th.Tensor]


def set_gradients(*losses: tuple[BaseModel, th.Tensor]) -> None:
    """
    Let each network have the gradient of its loss, and nothing else that the loss depends on. Parameters that none of the
    optimizers holds, as of an encoder that somebody else steps, add it to the gradient that they have.
    """
    held = [[each for group in network.optimizer.param_groups for each in group["params"]] for network, _ in losses]
    of_all = {id(parameter) for parameters in held for parameter in parameters}
    for (network, loss), parameters in zip(losses, held, strict=True):
        trained = [parameter for parameter in parameters if parameter.requires_grad]
        if th.compiler.is_compiling():
            # All that is trained is held, see ``not_in_a_graph()``
            gradients = th.autograd.grad(loss, trained, materialize_grads=True) if trained else ()
            for parameter, gradient in zip(trained, gradients, strict=True):
                set_gradient(parameter, gradient)
            continue
        # Without ``zero_grad()``, whose records for the profiler take longer than its work
        for parameter in parameters:
            parameter.grad = None
        trained += [each for each in network.parameters() if each.requires_grad and id(each) not in of_all]
        # The whole network may be frozen, as an actor whose values are to be learned
        if trained:
            loss.backward(inputs=trained)


def set_gradient(parameter: th.Tensor, gradient: th.Tensor) -> None:
    """Let a parameter have a gradient, for the next step of its optimizer."""
    if th.compiler.is_compiling():
        # A compiled step reads the tensors that it was compiled with
        assert parameter.grad is not None
        parameter.grad.copy_(gradient)
    else:
        parameter.grad = gradient


def step(optimizer: th.optim.Optimizer) -> None:
    """Let an optimizer take a step with the gradients of its parameters."""
    if th.compiler.is_compiling():
        # Without the wrappers for hooks and profiler, which no graph goes through
        with th.no_grad():
            inspect.unwrap(type(optimizer).step)(optimizer)
    else:
        optimizer.step()


def polyak_update(tensors: Iterable[th.Tensor], targets: Iterable[th.Tensor], tau: float) -> None:
    """Let targets follow by a share ``tau``. No graph goes through that of Stable-Baselines3 2.7.1."""
    with th.no_grad():
        for tensor, target in zip(tensors, targets, strict=True):
            target.data.mul_(1 - tau)
            th.add(target.data, tensor.data, alpha=tau, out=target.data)


def update_multiplier(log_multiplier: th.Tensor, optimizer: th.optim.Optimizer, violation: th.Tensor) -> th.Tensor:
    """
    Step of a Lagrange multiplier in log space, which grows while its constraint is violated
    (see https://github.com/rail-berkeley/softlearning/issues/37 for the logarithm).
    """
    violation = violation.detach()
    loss = -log_multiplier.detach() * violation
    # The loss is linear in the logarithm: autograd would only find the same number again
    set_gradient(log_multiplier, -violation.reshape(1))
    step(optimizer)
    return loss


def modules_of(network: th.nn.Module) -> list[th.nn.Module]:
    """As ``network.modules()``, in a tenth of the time."""
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
    held = {id(parameter) for optimizer in optimizers for group in optimizer.param_groups for parameter in group["params"]}
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
            if id(parameter) not in held and hasattr(network, "optimizer"):
                return f"the gradient of {name} ({type(module).__name__}), which is in no optimizer of the model"
    return None


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


def tensors_of(*values: Any) -> list[th.Tensor]:
    """The tensors in samples, in their order."""
    found = []
    for value in values:
        if isinstance(value, th.Tensor):
            found.append(value)
        elif value is not None:
            found += tensors_of(*(value.values() if isinstance(value, dict) else value))
    return found


def check_compiler(device: th.device) -> None:
    """Compile something, before a model has collected its first transitions."""
    try:
        th.compile(th.neg, backend=BACKEND)(th.zeros(8, device=device))
    except Exception as error:
        raise RuntimeError(
            f"compile_update=True needs a working torch.compile, which fails on device={device}: {error}\n"
            "Install a C++ compiler (for a CPU) or triton (for a GPU), or use compile_update=False."
        ) from error


class Graph:
    """
    Compiled code, as a function of all tensors that an update reads. A GPU replays it at one launch (CUDA graph) as soon as it
    has run once on tensors that are still where they were, apart from samples.

    :param function: The code
    :param sampled: The parts of samples that the update is made with
    :param on_gpu: Whether it runs there
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
        """As PyTorch calls it, after it has checked that the code is still that of the update."""
        known = {id(part): index for index, part in enumerate(self._sampled)}
        self._parts = {at: known[id(each)] for at, each in enumerate(inputs) if id(each) in known}
        self._inputs = [None if at in self._parts else each for at, each in enumerate(inputs)]
        # A number that is read from the processor would be the same in each replay
        self._on_gpu = self._on_gpu and all(each.is_cuda for each in inputs)
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
        addresses = [each.data_ptr() for at, each in enumerate(inputs) if at not in self._parts]
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
        static = [each.clone() if at in self._parts else each for at, each in enumerate(inputs)]
        self._copies = [static[at] for at in self._parts]
        cuda_graph = th.cuda.CUDAGraph()
        with th.cuda.graph(cuda_graph):
            self._outputs = self._function(*static)
        return cuda_graph


class CompiledUpdate:
    """
    The update of a model as one graph without breaks. It is compiled at its first call, and again when something has changed
    that it took for constant. That is looked at once in a call of ``train()``.

    :param update: The update, a function of the model, of samples, and of what else changes from one to the next
    :param device: Device of the model
    """

    def __init__(self, update: Callable[..., Metrics], device: th.device) -> None:
        if th.__version__ < _OLDEST_TORCH:
            raise RuntimeError(
                f"compile_update=True needs torch>={_OLDEST_TORCH}, the first that has gradients within a compiled graph, and "
                f"this is torch {th.__version__}: upgrade it, or use compile_update=False."
            )

        def run(model: Any, *args: Any) -> Metrics:
            with th.enable_grad():
                metrics = update(model, *args)
            for actor in actors_of(model):
                for name in _LEFT_BEHIND:
                    if name in vars(actor.action_dist):
                        setattr(actor.action_dist, name, None)
            return metrics

        # PyTorch limits how often a code object is compiled: each model has its own
        run.__code__ = run.__code__.replace()
        self._made_from = update, device
        self._on_gpu = device.type == "cuda"
        options: dict[str, Any] = {
            "guard_filter_fn": lambda guards: [not (each.is_global or each.guard_type in _UNASKED) for each in guards]
        }
        self._run = th.compile(run, fullgraph=True, dynamic=False, backend=self._compile, options=options)
        # One per group of parameters. A number would be a constant of the graph
        self._learning_rates: list[th.Tensor] = []
        self._space: spaces.Space = _NUMBERS
        self._left_out: str | None = None
        # The parts of the samples at hand, and the code that PyTorch has chosen for them
        self._sampled: list[th.Tensor] = []
        self._graph: Graph | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # A graph belongs to this process and its model
        return type(self), self._made_from

    def _compile(self, traced: th.fx.GraphModule, inputs: list[th.Tensor]) -> Callable[..., Sequence[th.Tensor]]:
        """Make code of an update that was traced."""
        # Takes seconds
        from torch import _dynamo as dynamo

        compile_graph: Callable[..., Any] = dynamo.lookup_backend(BACKEND)
        if BACKEND == "inductor" and not self._on_gpu:
            from sb3_lac.inductor import compile_for_cpu

            compile_graph = compile_for_cpu
        print("sb3_lac compiles the update of LAC: this takes half a minute to minutes.", file=sys.stderr, flush=True)
        graph = Graph(compile_graph(traced, inputs), self._sampled, self._on_gpu)

        def call(*args: th.Tensor) -> Sequence[th.Tensor]:
            self._graph = graph
            return graph(*args)

        return call

    @contextmanager
    def ready(self, model: Any, optimizers: Sequence[th.optim.Optimizer]) -> Iterator[Callable[..., Metrics]]:
        """
        Have optimizers and networks in a form that can be compiled. All is as it was afterwards, so that models are saved as
        without compilation. What a graph would leave out is looked for each time, and leads to the update as it is.
        """
        from torch import _dynamo as dynamo  # Takes seconds

        policy, space = model.policy, model.policy.observation_space
        networks = [network for network in policy.children() if isinstance(network, BaseModel)]
        known, self._left_out = self._left_out, not_in_a_graph(networks, optimizers)
        if self._left_out is not None:
            if self._left_out != known:
                warnings.warn(f"Updates are not compiled: a graph would leave out {self._left_out}.", stacklevel=3)
            yield model._update
            return
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        before = [group.copy() for group in groups]
        if len(self._learning_rates) != len(groups):
            if isinstance(space, spaces.Dict):
                self._space = spaces.Dict(dict.fromkeys(space.spaces, _NUMBERS))
            self._learning_rates = [th.zeros((), device=model.device) for _ in groups]
        for group, learning_rate in zip(groups, self._learning_rates, strict=True):
            # Adam divides by a rate that is a tensor
            learning_rate.fill_(max(group["lr"], _SMALLEST_RATE))
            # The compiler fuses the operations of a step by itself
            form = {"lr": learning_rate, "capturable": self._on_gpu, "foreach": None, "fused": None}
            group.update({name: value for name, value in form.items() if name in group})
            for parameter in group["params"]:
                if not parameter.requires_grad:
                    parameter.grad = None
                elif parameter.grad is None:
                    parameter.grad = th.zeros_like(parameter)
        # Code for samples of a form, and whether targets are updated, that was checked in this call
        checked: dict[Any, tuple[Graph, tuple[str, ...]]] = {}

        def update(replay_data: Samples, costs: th.Tensor, update_targets: bool) -> Metrics:
            parts = {name: getattr(replay_data, name) for name in ("observations", "next_observations")}
            parts = {name: preprocess_obs(part, space, policy.normalize_images) for name, part in parts.items()}
            replay_data = replay_data._replace(**parts)
            self._sampled[:] = tensors_of(replay_data, costs)
            form = update_targets, *((part.shape, part.stride(), part.dtype) for part in self._sampled)
            if form in checked:
                graph, names = checked[form]
                return names, graph.again(self._sampled)
            names, values = self._run(model, replay_data, costs, update_targets)
            assert self._graph is not None
            # Code that has made something beside the metrics, as a momentum at its first step, is that of one update
            if self._graph.is_metrics_alone:
                checked[form] = self._graph, names
            return names, values

        try:
            for network in networks:
                network.observation_space = self._space
            with th.no_grad(), dynamo.config.patch(trace_autograd_ops=True):
                yield update
        finally:
            for network in networks:
                network.observation_space = space
            for group, old in zip(groups, before, strict=True):
                group.update(old)
            # Batches may be large
            self._sampled.clear()
