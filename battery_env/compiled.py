"""Compilation of kernels (numba), with a cache for later processes where a folder is writable."""

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
    """Return a digest of the modules with kernels and of their imports, whose constants are compiled in."""
    texts: dict[str, str] = {}
    for path in sorted(package.rglob("*.py")):
        name = ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
        texts[name] = path.read_text(encoding="utf-8")
    modules = [name for name, text in texts.items() if "from battery_env.compiled import" in text]
    for name in modules:  # the loop appends to this list
        for module, names in _IMPORT.findall(texts[name]):
            for dependency in (module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))):
                if dependency in texts and dependency not in modules:
                    modules.append(dependency)
    return sha256("".join(f"{name}\n{texts[name]}" for name in sorted(modules)).encode()).hexdigest()


@cache
def forget_outdated(folder: Path, digest: str) -> None:
    """Remove the kernels in a folder that were compiled from other code."""
    # numba compares a kernel only with its module: after an update in place, as by git, it would mix kernels of two versions
    digest_file = folder / "battery_env.sha256"
    with suppress(OSError):  # another process was faster, or the folder is not writable
        if not digest_file.exists() or digest_file.read_text(encoding="utf-8") != digest:
            for index_file in folder.glob("*.nbi"):
                index_file.unlink(missing_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            digest_file.write_text(digest, encoding="utf-8")


def _jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def compiled(function: Callable[..., Any]) -> Any:
        try:
            kernel = njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither the package nor the home folder is writable
            return njit(error_model="numpy", **options)(function)
        forget_outdated(Path(kernel.stats.cache_path), digest_of_kernels())
        return kernel

    return compiled


compiled = _jit()
# the compiler vectorises only loops of inlined functions
inlined = _jit(forceinline=True)
# sums in any order, as vector instructions need
reassociating = _jit(fastmath={"reassoc"})


class _FirstCompilation(event.Listener):
    """Print once, on stderr, that kernels are being compiled."""

    is_announced = False

    def on_start(self, event: event.Event) -> None:
        if not self.is_announced:
            self.is_announced = True
            print("compiling, once after an installation or update: half a minute", file=sys.stderr, flush=True)

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def announce_compilation() -> Iterator[None]:
    """Announce a compilation of kernels within the block."""
    with event.install_listener("numba:compile", _FirstCompilation()):
        yield
