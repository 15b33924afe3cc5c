"""What PyTorch's compiler is told about the small networks of an update on a CPU, where it would take them for large ones."""

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from torch._inductor.compile_fx import compile_fx
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch._inductor.pattern_matcher import Arg, CallFunction, Match, PatternMatcherPass, register_graph_pattern

_aten = th.ops.aten
_passes = PatternMatcherPass(pass_name="sb3_lac")
# MKL is slow where the columns of a product, as those of an observation, are no multiple of this
_BLOCK = 16


def _product(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """A product of matrices. Those of one column or row are sums, which become part of the loops around them."""
    if right.shape[1] == 1:
        return (left * right.t()).sum(dim=1, keepdim=True)
    if left.shape[0] == 1:
        return (left.t() * right).sum(dim=0, keepdim=True)
    if left.shape[1] == 1:
        return left * right
    if right.shape[1] % _BLOCK and right.shape[1] < left.shape[0]:
        return (right.t() @ left.t()).t()
    return left @ right


def _is_number(match: Match) -> bool:
    base, exponent = match.args
    return base > 0 and exponent.meta["val"].dim() == 0


@register_graph_pattern(CallFunction(_aten.mm.default, Arg(), Arg()), pass_dict=_passes)
def _replace_product(match: Match, left: th.fx.Node, right: th.fx.Node) -> None:
    match.replace_by_example(_product, [left, right])


@register_graph_pattern(CallFunction(_aten.addmm.default, Arg(), Arg(), Arg()), pass_dict=_passes)
def _replace_layer(match: Match, bias: th.fx.Node, left: th.fx.Node, right: th.fx.Node) -> None:
    """The bias is added in the loop of the activation, in place of one that copies it first."""
    match.replace_by_example(lambda bias, left, right: _product(left, right) + bias, [bias, left, right])


@register_graph_pattern(CallFunction(_aten.pow.Scalar, Arg(), Arg()), extra_check=_is_number, pass_dict=_passes)
def _replace_power(match: Match, base: float, exponent: th.fx.Node) -> None:
    """Powers of Adam's bias correction are found once, and not for each weight anew: a maximum is a result of its own."""
    match.replace_by_example(lambda exponent: th.exp(exponent.expand(16) * math.log(base)).amax(), [exponent])


class _SmallNetworks(CustomGraphPass):
    """Replaces all of them."""

    def __call__(self, graph: th.fx.Graph) -> None:
        _passes.apply(graph)

    def uuid(self) -> Any:
        """Return the cache key of these graph passes."""
        return get_hash_for_files((__file__,))


def compile_for_cpu(traced: th.fx.GraphModule, inputs: Sequence[th.Tensor]) -> Any:
    """Make code of a graph, with a loop of calls in C++."""
    # Shapes are those that the update was traced with: to ask all of them anew takes longer than a layer
    options = {"cpp_wrapper": True, "size_asserts": False, "post_grad_custom_post_pass": _SmallNetworks()}
    return compile_fx(traced, inputs, config_patches=options)
