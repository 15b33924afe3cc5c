import importlib
import sys

import pytest

import sb3_lac


@pytest.fixture
def reload_package(monkeypatch):
    """Import the package again, with another battery_env."""

    def _reload_package():
        return importlib.reload(sb3_lac)

    yield _reload_package
    monkeypatch.undo()
    importlib.reload(sb3_lac)


def test_battery_env_is_optional(monkeypatch, reload_package):
    monkeypatch.setitem(sys.modules, "battery_env", None)
    assert reload_package().LAC is sb3_lac.LAC
