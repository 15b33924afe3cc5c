"""Calls side by side: in processes of this machine, or on the machines of a Dask cluster."""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
import os
import pickle
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from hashlib import sha256
from pathlib import Path
from queue import SimpleQueue
from typing import Any

#: Starts a call: a function that can be imported, and its arguments.
Submit = Callable[..., "Future[Any]"]

# how often a call is made whose process was lost
_TRIES = 3
# a scheduler that is there answers within milliseconds
_PATIENCE_S = 5.0


@contextmanager
def processes(jobs: int) -> Iterator[Submit]:
    """
    Processes of this machine. A call whose process is lost, as for want of memory, is made again, three times in all. When the
    block fails, what has not begun is not begun any more; when this process is killed, so are they.

    :yields: what starts a call
    """
    workers = [_Worker() for _ in range(jobs)]
    idle: SimpleQueue[_Worker] = SimpleQueue()
    for worker in workers:
        idle.put(worker)

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        worker = idle.get()
        try:
            return worker.call(function, *arguments)
        finally:
            idle.put(worker)

    threads = ThreadPoolExecutor(jobs)

    def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        return threads.submit(call, function, *arguments)

    try:
        yield submit
        threads.shutdown()
    finally:  # at once, if the block has failed, also of a generator that is closed
        for worker in workers:
            worker.close()
        threads.shutdown(wait=False, cancel_futures=True)


class _Worker:
    """A process of its own, so that one that is lost takes one call with it."""

    def __init__(self) -> None:
        self._closed = False
        self._pool = self._new_pool()

    @staticmethod
    def _new_pool() -> ProcessPoolExecutor:
        # spawn: torch does not survive a fork with threads
        return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_parent)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Make a call, again if the process is lost."""
        for tries_left in reversed(range(_TRIES)):
            try:
                return self._pool.submit(function, *arguments).result()
            except BrokenExecutor:
                if self._closed or not self._is_lost():
                    raise  # an error of the call itself
                self._pool = self._new_pool()
                if tries_left == 0:
                    raise
                warnings.warn("The process of a call was lost; the call is made again.", stacklevel=2)
        raise AssertionError

    def _is_lost(self) -> bool:
        try:
            self._pool.submit(int).result()
        except BrokenExecutor:
            return True
        return False

    def close(self) -> None:
        """Begin no other call."""
        self._closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)


def _end_with_parent() -> None:
    # one that is killed cannot tell its workers, which would compute on, and then wait for ever
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: Any) -> None:
    parent.join()
    os._exit(1)


@contextmanager
def cluster(scheduler: str, packages: Sequence[str], shared: Path | None = None) -> Iterator[Submit]:
    """
    The workers of a Dask cluster. The call of a worker that is lost is made again by another one, three times at most. When
    the block is left, what has not begun is not begun any more.

    :yields: what starts a call
    """
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise ImportError("--scheduler needs Dask: pip install 'battery_env[cluster]'") from error
    with ExitStack() as stack:
        # recordings of a million samples may be sent
        stack.enter_context(dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}))
        try:
            asyncio.run(asyncio.wait_for(_identity(scheduler), _PATIENCE_S))
        except Exception as error:  # what is at the address may answer anything
            why = str(error) or f"no answer within {_PATIENCE_S:g} s"
            raise OSError(f"no Dask scheduler at {scheduler!r}: {why}") from error
        client = stack.enter_context(Client(scheduler, set_as_default=False))
        code = {package: _code(package) for package in packages}
        probe = None
        if shared is not None:
            shared.mkdir(parents=True, exist_ok=True)
            probe = Path(stack.enter_context(tempfile.NamedTemporaryFile(dir=shared, prefix=".shared")).name)
        faults = client.run(_fault, code, probe, on_error="return")
        if not faults:
            warnings.warn(f"{scheduler} has no worker yet; waiting for one", stacklevel=4)
        for worker, fault in faults.items():
            if fault is not None:
                raise RuntimeError(f"Dask's worker {worker}: {fault}")
        executor = client.get_executor(pure=False)
        # as bytes, which Dask does not search for tasks of its own
        yield lambda *call: executor.submit(_checked, code, probe, pickle.dumps(call))


async def _identity(scheduler: str) -> None:
    """Of the scheduler; a client would take long to give up."""
    from distributed import Security, rpc

    async with rpc(scheduler, connection_args=Security().get_connection_args("client")) as remote:
        await remote.identity()


@cache
def _code(package: str) -> str:
    """Of the source as it is when first asked for, which on a worker is when it is imported."""
    folder = Path(str(importlib.import_module(package).__file__)).parent
    files = [path for path in sorted(folder.rglob("*.py")) if "build" not in path.relative_to(folder).parts]
    return sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def _fault(code: Mapping[str, str], probe: Path | None, dask_worker: Any = None) -> str | None:
    """Why the worker that this runs on could not be relied on. Dask passes the worker to what is no task."""
    from distributed import get_worker

    if (dask_worker or get_worker()).state.nthreads > 1:  # torch's seed, warnings and others belong to the process
        return "it makes several calls in one process; start it with --nthreads 1"
    if other := [package for package, digest in code.items() if _code(package) != digest]:
        return f"its {', '.join(other)} is not the one here; bring it up to date and start it again"
    if probe is not None and not probe.exists():
        return f"it does not see {probe.parent}; --out must be a folder that all machines share"
    return None


def _checked(code: Mapping[str, str], probe: Path | None, call: bytes) -> Any:
    if (fault := _fault(code, probe)) is not None:
        raise RuntimeError(f"Dask's worker: {fault}")
    function, *arguments = pickle.loads(call)
    return function(*arguments)
