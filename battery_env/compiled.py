"""How kernels are compiled (numba): once, and kept for later processes where there is a place to keep them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import njit


def forget_outdated(package: Path) -> None:
    """
    Remove kept kernels that are older than any module that they may depend on, all but those of the lab. Numba compares each
    with its own module alone: after an update in place, as by git, it would mix kernels of two versions.
    """
    modules = (module for module in package.rglob("*.py") if package / "lab" not in module.parents)
    newest_s = max(module.stat().st_mtime for module in modules)
    for kept in package.rglob("*.nbi"):
        with suppress(OSError):  # another process is as fast, or nothing may be written here
            if kept.stat().st_mtime < newest_s:
                kept.unlink()


forget_outdated(Path(__file__).parent)


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
