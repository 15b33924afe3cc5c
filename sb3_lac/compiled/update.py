"""The update of a model as one compiled graph. What an update is stands in ``lac.py``."""

import math
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_lac.buffers import Samples
from sb3_lac.compiled.graph import Graph, not_in_a_graph, tensors_of
from sb3_lac.compiled.tracing import TracedOptimizer, teach_the_tracer, traced_optimizers
from sb3_lac.updates import Metrics, actors_of

# The first version that traces gradients within a graph
_OLDEST_TORCH = "2.11"
# The newest one that this was tried with. Much here is private to PyTorch, and may be otherwise in the next one
_NEWEST_TORCH = "2.13"
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


class CompiledUpdate:
    """
    The update of a model as one graph without breaks, compiled at its first call, and again when something has changed that it
    took for constant: that is looked at once in a call of ``train()``.
    """

    def __init__(self, update: Callable[..., Metrics], device: th.device) -> None:
        teach_the_tracer()

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
        self._traced: dict[th.optim.Optimizer, TracedOptimizer] = {}
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

    def check(self) -> None:
        """Compile something, before a model has collected its first transitions."""
        _, device = self._made_from
        try:
            th.compile(th.neg, backend=BACKEND)(th.zeros(8, device=device))
        except Exception as error:
            raise RuntimeError(
                f"compile_update=True needs a working torch.compile, which fails on device={device}: {error}\n"
                "Install a C++ compiler (for a CPU) or triton (for a GPU), or use compile_update=False."
            ) from error

    def _compile(self, traced: th.fx.GraphModule, inputs: list[th.Tensor]) -> Callable[..., Sequence[th.Tensor]]:
        """Make code of an update that was traced."""
        # Takes seconds
        from torch import _dynamo as dynamo

        compile_graph: Callable[..., Any] = dynamo.lookup_backend(BACKEND)
        if BACKEND == "inductor" and not self._on_gpu:
            from sb3_lac.compiled.processor import compile_for_cpu

            compile_graph = compile_for_cpu
        print("sb3_lac compiles the update of LAC: this takes half a minute to minutes.", file=sys.stderr, flush=True)
        graph = Graph(compile_graph(traced, inputs), self._sampled, self._on_gpu)

        def call(*args: th.Tensor) -> Sequence[th.Tensor]:
            self._graph = graph
            return graph(*args)

        return call

    @contextmanager
    def traceable(self, model: Any, optimizers: Sequence[th.optim.Optimizer]) -> Iterator[Callable[..., Metrics]]:
        """
        Have optimizers and networks in a form that can be compiled. All is as it was afterwards, so that models are saved as
        without compilation. What a graph would leave out is looked for each time, and leads to the update as it is.
        """
        from torch import _dynamo as dynamo  # Takes seconds

        policy, space = model.policy, model.policy.observation_space
        networks = [network for network in policy.children() if isinstance(network, BaseModel)]
        reported, self._left_out = self._left_out, not_in_a_graph(networks, optimizers)
        if self._left_out is not None:
            if self._left_out != reported:
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
            traced = traced_optimizers(self._traced, [model, *networks])
            with traced, th.no_grad(), dynamo.config.patch(trace_autograd_ops=True):
                yield update
        finally:
            for network in networks:
                network.observation_space = space
            for group, old in zip(groups, before, strict=True):
                group.update(old)
            # Batches may be large
            self._sampled.clear()


def compiled_update(update: Callable[..., Metrics], device: th.device) -> CompiledUpdate | None:
    """Have an update compiled, or nothing where nobody has tried that with this torch."""
    if th.__version__ < _OLDEST_TORCH:
        raise RuntimeError(
            f"compile_update=True needs torch>={_OLDEST_TORCH}, the first that has gradients within a compiled graph, and "
            f"this is torch {th.__version__}: upgrade it, or use compile_update=False."
        )
    if [int(part) for part in th.__version__.split(".")[:2]] > [int(part) for part in _NEWEST_TORCH.split(".")]:
        warnings.warn(
            f"Updates are not compiled: this is torch {th.__version__}, and compile_update=True was tried up to torch "
            f"{_NEWEST_TORCH}.",
            stacklevel=4,
        )
        return None
    return CompiledUpdate(update, device)
