"""How kernels are compiled (numba): once, and kept for later processes where there is a place to keep them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither the package nor a home can be written to
            return njit(error_model="numpy", **options)(function)

    return compiled


compiled = _kept()
# the compiler makes vector loops only of what is inlined
inlined = _kept(forceinline=True)
# sums in any order, which vector instructions need
reassociating = _kept(fastmath={"reassoc"})
