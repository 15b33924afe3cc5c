"""Faults below Python, for tests: disks that are full or fail, and processes that are killed. Workers import it fast."""

import os
import resource
import signal
import time
from contextlib import contextmanager


def until(is_so, patience_s=60.0):
    """Wait for other processes."""
    ends = time.monotonic() + patience_s
    while not is_so():
        if time.monotonic() > ends:
            raise TimeoutError
        time.sleep(0.02)


@contextmanager
def a_full_disk(after_bytes):
    """No file grows beyond so many bytes, for whoever writes it, compiled code too."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (after_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


class Disk:
    """Counts syncs, renamings and links, and lets one of them fail."""

    def __init__(self, patch, fails_at=None):
        self.calls, self.fails_at = [], fails_at
        for name in ("fsync", "replace", "link"):
            patch.setattr(os, name, self.counting(name, getattr(os, name)))

    def counting(self, name, function):
        def counted(*arguments, **named):
            self.calls.append(name)
            if len(self.calls) - 1 == self.fails_at:
                raise OSError(5, "Input/output error")
            return function(*arguments, **named)

        return counted


def squared_unless_it_ends_its_process(number, ends):
    """A call that may kill the worker that makes it."""
    if number in ends:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def squared_after_ends_of_its_process(number, folder):
    """A call that kills as many workers as its number says before it is made."""
    ends = folder / f"ends_{number}"
    if number > (ends.stat().st_size if ends.exists() else 0):
        with ends.open("ab") as file:
            file.write(b"x")
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def squared_after_a_while(number, log):
    """A call that takes long, and counts how often it is begun."""
    with log.open("ab") as file:
        file.write(b"x")
    time.sleep(2.0)
    return number**2
