"""Calls side by side: in this process, in others of this machine, or on a cluster."""

from __future__ import annotations

import multiprocessing
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

# A scheduler that is there answers within milliseconds.
_PATIENCE_S = 5


class InThisProcess(Executor):
    """Makes each call at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make a call."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """
    What makes calls side by side, in processes of this machine or on a Dask cluster. When the block is left, what has not
    begun is not begun any more.
    """
    if scheduler is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError("--scheduler needs Dask: pip install 'battery_env[cluster]'") from error
        try:
            client = Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(f"no Dask scheduler at {scheduler!r}: {error}") from error
        with client:
            yield client.get_executor(pure=False)
    elif jobs == 1:
        yield InThisProcess()
    else:
        # spawn: torch does not survive a fork with threads
        pool = ProcessPoolExecutor(None if jobs == -1 else jobs, mp_context=multiprocessing.get_context("spawn"))
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


class Attempt(NamedTuple):
    """What became of a call: its result, ``None`` after an error, its warnings, and the error, empty if there is none."""

    result: Any
    notes: list[str]
    error: str


def attempt(function: Callable[..., Any], *arguments: Any) -> Attempt:
    """Make a call that stops no others, whatever becomes of it."""
    result, error = None, ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = function(*arguments)
        except Exception as problem:
            error = _message(problem)
    return Attempt(result, [str(each.message) for each in caught], error)


def in_order(
    executor: Executor, ahead: int, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Attempt]]:
    """Each call with what became of it, in their order; so many are under way at most beyond the one that is waited for."""
    started: deque[tuple[tuple[Any, ...], Future[Attempt]]] = deque()

    def first() -> tuple[tuple[Any, ...], Attempt]:
        call, future = started.popleft()
        made = attempt(future.result)  # which fails where the worker did
        return call, made.result or made

    for call in calls:
        started.append((call, executor.submit(attempt, function, *call)))
        while started and (len(started) > ahead or started[0][1].done()):
            yield first()
    while started:
        yield first()


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    expected = (ValueError, TypeError, OSError, ImportError)
    return text if isinstance(error, expected) and text else f"{type(error).__name__}: {text}"
