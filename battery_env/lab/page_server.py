"""The server of the page for the bench: for this machine, for whoever has its address, and with nothing left on the disk."""

import secrets
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Ports that are tried, one after the other.
_PORTS = 100
# The program that removes a folder as soon as the process that started it is gone.
_REMOVE = """\
import shutil, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.stdin.read()
shutil.rmtree(sys.argv[1], ignore_errors=True)
"""


@contextmanager
def temporary_files_that_go() -> Iterator[None]:
    """Keep all temporary files of this process in a folder, which another process removes, however this one ends."""
    folder, before = tempfile.mkdtemp(prefix="battery-calibrate-"), tempfile.tempdir
    remover = [sys.executable, "-I", "-c", _REMOVE, folder]
    # in a session of its own, so that no Ctrl-C and no end of a group of processes reaches it
    with subprocess.Popen(remover, stdin=subprocess.PIPE, start_new_session=True):
        tempfile.tempdir = folder
        try:
            yield
        finally:
            tempfile.tempdir = before


def free_port(first: int, host: str) -> int:
    """The first port from one on that no other program has."""
    for port in range(first, min(first + _PORTS, 1 << 16)):
        try:
            socket.create_server((host, port)).close()
        except OSError:
            continue
        return port
    raise OSError(f"none of the ports from {first} on is free: give another --port")


def serve(page: Path, first_port: int) -> None:
    """Serve a page at an address with a token, without which there is nothing, until the process is asked to end."""
    from streamlit.web import cli  # slow to import

    host, token = "127.0.0.1", secrets.token_hex(16)
    port = free_port(first_port, host)
    # all that matters is stated, whatever a file .streamlit/config.toml of the folder says
    options = {
        "server.address": host,
        "server.port": port,
        "server.baseUrlPath": token,
        "server.allowedHosts": host,
        "server.enableCORS": True,
        "server.corsAllowedOrigins": f"http://{host}:{port}",
        "server.enableXsrfProtection": True,
        "server.enableStaticServing": False,
        "server.fileWatcherType": "none",
        "server.showEmailPrompt": False,
        "browser.gatherUsageStats": False,
        "client.toolbarMode": "minimal",
        "global.developmentMode": False,
        "logger.hideWelcomeMessage": True,
        "logger.level": "warning",
    }
    print(f"the page is http://{host}:{port}/{token}/ until Ctrl-C", flush=True)
    stated = [f"--{name}={value}" for name, value in options.items()]
    with temporary_files_that_go():
        cli.main(["run", str(page), "--server.allowedHosts=localhost", *stated], "streamlit", standalone_mode=False)
