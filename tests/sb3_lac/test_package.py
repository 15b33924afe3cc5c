import importlib
import sys
from pathlib import Path

import gymnasium as gym
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


def test_exports():
    assert set(sb3_lac.__all__) == {
        "LAC",
        "CertificateCallback",
        "CnnPolicy",
        "DashboardCallback",
        "FittedLyapunov",
        "GymnasiumVecEnv",
        "LyapunovCallback",
        "LyapunovFunction",
        "LyapunovPolicy",
        "LyapunovReport",
        "MlpPolicy",
        "MultiInputPolicy",
        "__version__",
        "certify",
        "evaluate_lyapunov",
        "fit_lyapunov",
    }
    assert all(hasattr(sb3_lac, name) for name in sb3_lac.__all__)


def test_version_and_type_marker_are_shipped():
    folder = Path(sb3_lac.__file__).parent
    assert sb3_lac.__version__ == (folder / "version.txt").read_text().strip()
    assert (folder / "py.typed").is_file()


def test_battery_env_is_optional(monkeypatch, reload_package):
    monkeypatch.setitem(sys.modules, "battery_env", None)
    assert reload_package().LAC is sb3_lac.LAC


@pytest.mark.parametrize("env_id", ["BatteryQmax-v0", "battery_env:BatteryRo-v0"])
def test_ids_of_batteries_say_what_to_install(monkeypatch, env_id):
    monkeypatch.setitem(sys.modules, "battery_env", None)
    monkeypatch.delitem(gym.registry, env_id, raising=False)
    with pytest.raises(gym.error.NameNotFound, match=rf"'{env_id}'.*pip install ./battery_env"):
        sb3_lac.LAC("MlpPolicy", env_id)


def test_a_folder_without_code_is_no_battery_env(monkeypatch, tmp_path):
    (tmp_path / "battery_env").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "battery_env")
    monkeypatch.delitem(gym.registry, "BatteryRo-v0")
    with pytest.raises(gym.error.NameNotFound, match=r"pip install ./battery_env"):
        sb3_lac.LAC("MlpPolicy", "BatteryRo-v0")


def test_other_missing_ids_are_refused_by_gymnasium():
    with pytest.raises(gym.error.NameNotFound, match="Did you mean: `BatteryQmax`"):
        sb3_lac.LAC("MlpPolicy", "BatteryQmx-v0")


def test_broken_battery_env_is_not_hidden(monkeypatch, reload_package, tmp_path):
    (tmp_path / "battery_env").mkdir()
    (tmp_path / "battery_env" / "__init__.py").write_text("import a_missing_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "battery_env", raising=False)
    with pytest.raises(ModuleNotFoundError, match="a_missing_dependency"):
        reload_package()
