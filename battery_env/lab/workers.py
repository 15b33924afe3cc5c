"""Calls side by side: in this process, in others of this machine, or on a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from types import FrameType
from typing import Any, NamedTuple

# A scheduler that is there answers within milliseconds.
_PATIENCE_S = 5
# Warnings belong to the process: threads that catch them take turns.
_CATCHING = threading.RLock()


class Terminated(KeyboardInterrupt):
    """The process is asked to end: by a scheduler, a service, or a terminal that goes."""

    def __init__(self, number: int) -> None:
        super().__init__()
        #: What a shell says of a process that this signal ended
        self.status = 128 + number


@contextmanager
def interruptible() -> Iterator[None]:
    """Let the signals that ask a process to end do what Ctrl-C does; those that somebody else handles are left to it."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Terminated(number)

    is_main = threading.current_thread() is threading.main_thread()
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if is_main and hasattr(signal, name)]
    ours = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


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


class Processes(Executor):
    """Makes calls in processes of this machine, which end with this one. Others take the place of those that are lost."""

    def __init__(self, count: int | None) -> None:
        self._count, self._others = count, set(multiprocessing.active_children())
        self._pool = self._new(count)

    @staticmethod
    def _new(count: int | None) -> ProcessPoolExecutor:
        # spawn: torch does not survive a fork with threads
        return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_end_with_parent)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make a call as soon as a process is free."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenExecutor:
            self._pool = self._new(self._count)
            return self._pool.submit(fn, *args, **kwargs)

    def alone(self, fn: Callable[..., Any], /, *args: Any) -> Any:
        """The result of a call that is made in a process of its own, so that no other call can be why it is lost."""
        with self._new(1) as pool:
            try:
                return pool.submit(fn, *args).result()
            except KeyboardInterrupt:
                self.end()
                raise

    def end(self) -> None:
        """Stop what is under way."""
        for process in set(multiprocessing.active_children()) - self._others:
            process.terminate()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for what is under way."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, however that went."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """
    What makes calls side by side, in processes of this machine or on a Dask cluster. When the block is left, what has not
    begun is not begun any more, and after an interruption what has begun is not waited for.
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
        pool = Processes(None if jobs == -1 else jobs)
        try:
            yield pool
        except (KeyboardInterrupt, GeneratorExit):
            pool.end()
            raise
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
    with _CATCHING, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")  # those for developers
        warnings.simplefilter("always", UserWarning)
        try:
            result = function(*arguments)
        except Exception as problem:
            error = _message(problem)
    return Attempt(result, [str(each.message) for each in caught], error)


def in_order(
    executor: Executor, ahead: int, function: Callable[..., Any], calls: Iterable[Any]
) -> Iterator[tuple[Any, Attempt | None]]:
    """
    Each call with what became of it, in their order; so many are under way at most beyond the one that is waited for. What is
    no tuple is passed on in its place.
    """
    started: deque[tuple[Any, Future[Attempt] | None]] = deque()

    def first() -> tuple[Any, Attempt | None]:
        call, future = started.popleft()
        if future is None:
            return call, None
        if _is_lost(future) and isinstance(executor, Processes):
            # Those beside it are asked for again, and it as well, once, by itself
            for n, (other, its) in enumerate(started):
                if its is not None and its.done() and _is_lost(its):
                    started[n] = other, executor.submit(attempt, function, *other)
            future = InThisProcess().submit(executor.alone, attempt, function, *call)
        try:
            return call, future.result()
        except Exception as error:  # the worker's
            return call, Attempt(None, [], _message(error))

    for call in calls:
        started.append((call, executor.submit(attempt, function, *call) if isinstance(call, tuple) else None))
        while started and (len(started) > ahead or started[0][1] is None or started[0][1].done()):
            yield first()
    while started:
        yield first()


def _is_lost(future: Future[Any]) -> bool:
    return isinstance(future.exception(), BrokenExecutor)


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    expected = (ValueError, TypeError, OSError, ImportError)
    return text if isinstance(error, expected) and text else f"{type(error).__name__}: {text}"
