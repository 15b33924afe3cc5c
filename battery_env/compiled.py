"""How kernels are compiled (numba): once, and kept for later processes where there is a place to keep them."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(r"^from (battery_env[\w.]*) import (\([^)]*\)|.*)$", re.MULTILINE)


@cache
def digest_of_kernels(package: Path = _PACKAGE) -> str:
    """Of the modules that hold kernels, and of those that these import from: their numbers are compiled in."""
    texts: dict[str, str] = {}
    for path in sorted(package.rglob("*.py")):
        name = ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
        texts[name] = path.read_text(encoding="utf-8")
    needed = [name for name, text in texts.items() if "from battery_env.compiled import" in text]
    for name in needed:  # which grows meanwhile
        for module, names in _IMPORT.findall(texts[name]):
            for each in (module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))):
                if each in texts and each not in needed:
                    needed.append(each)
    return sha256("".join(f"{name}\n{texts[name]}" for name in sorted(needed)).encode()).hexdigest()


@cache
def forget_outdated(folder: Path, digest: str) -> None:
    """
    Remove the kernels in a folder if they were compiled from other code. Numba compares each with its own module alone: after
    an update in place, as by git, it would mix kernels of two versions.
    """
    compiled_from = folder / "battery_env.sha256"
    with suppress(OSError):  # another process is as fast, or nothing may be written here
        if not compiled_from.exists() or compiled_from.read_text(encoding="utf-8") != digest:
            for kept in folder.glob("*.nbi"):
                kept.unlink(missing_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            compiled_from.write_text(digest, encoding="utf-8")


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def compiled(function: Callable[..., Any]) -> Any:
        try:
            kernel = njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither the package nor a home can be written to
            return njit(error_model="numpy", **options)(function)
        forget_outdated(Path(kernel.stats.cache_path), digest_of_kernels())
        return kernel

    return compiled


compiled = _kept()
# the compiler makes vector loops only of what is inlined
inlined = _kept(forceinline=True)
# sums in any order, which vector instructions need
reassociating = _kept(fastmath={"reassoc"})


class _FirstCompilation(event.Listener):
    """Says on stderr, once, that kernels are compiled."""

    has_spoken = False

    def on_start(self, event: event.Event) -> None:
        if not self.has_spoken:
            self.has_spoken = True
            print("compiling, once after an installation or update: half a minute", file=sys.stderr, flush=True)

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def saying_that_it_compiles() -> Iterator[None]:
    """Whoever waits is told why, where kernels are not kept from an earlier process."""
    with event.install_listener("numba:compile", _FirstCompilation()):
        yield
