"""Data that many tests look at."""

import http.client
import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from battery_env import __file__ as package
from battery_env.loads import RandomPiecewise
from battery_env.tasks.voltage.readings import Readings
from battery_env.trajectories import TrajectoryDataset
from tests.faults import until
from tests.terminal import Terminal


@pytest.fixture(scope="session")
def aged_both():
    """Eight discharges of cells of which both parameters have aged, under steps of the load."""
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=5, r_o_range=(0.1, 0.3))


@pytest.fixture(scope="session")
def readings(aged_both):
    return Readings.of(aged_both)


@pytest.fixture
def terminal(capsys):
    return Terminal(capsys)


class StartedPage:
    """
    The command ``page`` at a terminal and a display, in an empty home and a folder that would open it to everybody. What it
    opens in the browser is noted, and no browser starts.
    """

    def __init__(self, folder, port):
        self.home, self.temporary, self._noted = (folder / name for name in ("home", "temporary", "opened"))
        there, openers = folder / "there", folder / "openers"
        for each in (self.home, self.temporary, openers, there, there / ".streamlit"):
            each.mkdir(parents=True)
        config = there / ".streamlit" / "config.toml"
        config.write_text(
            "[server]\naddress = '0.0.0.0'\nbaseUrlPath = ''\nenableCORS = false\nenableXsrfProtection = false\n"
            "allowedHosts = ['*']\n[global]\ndevelopmentMode = true\n"
        )
        for name in ("xdg-open", "open"):
            (openers / name).write_text(f'#!/bin/sh\necho "$1" > {self._noted}\n')
            (openers / name).chmod(0o755)
        import pty  # not on Windows

        self._terminal, terminal = pty.openpty()
        places = {"HOME": self.home, "TMPDIR": self.temporary, "PATH": f"{openers}:{os.environ['PATH']}", "DISPLAY": ":99"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "battery_env", "page", "--port", str(port)],
            env={**os.environ, "PYTHONPATH": str(Path(package).parents[1]), **{name: str(at) for name, at in places.items()}},
            cwd=there,
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
        )
        os.close(terminal)
        said = ""
        while "Ctrl-C" not in said:
            said += os.read(self._terminal, 4096).decode()
        self.address, self.port, self.token = re.search(r"(http://127\.0\.0\.1:(\d+)/(\w+)/)", said).groups()
        self.port = int(self.port)
        until(lambda: self.answer("/_stcore/health", self.token) == 200)

    def answer(self, path, token="", headers={}):  # noqa: B006
        """The status of what is asked for."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request("GET", f"/{token}{path}" if token else path, headers=headers)
            return connection.getresponse().status
        except ConnectionError:
            return None
        finally:
            connection.close()

    def opened(self):
        until(self._noted.exists)
        return self._noted.read_text().strip()

    def leave_a_file(self):
        """As while it reads one."""
        (folder,) = self.temporary.iterdir()
        (folder / "dropped.csv").write_text("1,2")

    def ends_by(self, number):
        self.process.send_signal(number)
        self.process.wait(60)
        os.close(self._terminal)
        assert self.answer("/") is None

    def left(self):
        """The files in its places when all is over."""
        with suppress(TimeoutError):
            until(lambda: not list(self.temporary.iterdir()), 10)
        return [str(each) for place in (self.home, self.temporary) for each in place.rglob("*")]


@pytest.fixture
def start_page(tmp_path):
    """Starts pages, which end with the test."""
    pytest.importorskip("pty", reason="no terminals here")
    started = []

    def start(port=8501):
        started.append(StartedPage(tmp_path / str(len(started)), port))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.wait()
