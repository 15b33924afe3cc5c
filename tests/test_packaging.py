"""What is installed is what is in the tree."""

import configparser
import importlib.resources
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import pytest

import sb3_lac  # noqa: F401  (registers all environments)

ROOT = Path(__file__).parents[1]


def read(file):
    config = configparser.ConfigParser()
    config.read(ROOT / file, encoding="utf-8")
    return config


def test_the_list_of_packages_matches_the_tree():
    found = {
        package: {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in (ROOT / package).rglob("__init__.py")}
        for package in ("battery_env", "sb3_lac")
    }
    assert set(read("battery_env/setup.cfg")["options"]["packages"].split()) == found["battery_env"]
    everything = found["battery_env"] | found["sb3_lac"] | {"sb3_lac.zoo_configs"}
    assert set(read("setup.cfg")["options"]["packages"].split()) == everything


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in ("sb3_lac", "battery_env", "zoo_configs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    for file in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    code = f"from setuptools.build_meta import build_wheel; build_wheel({str(target)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, check=True)
    (file,) = target.glob("*.whl")
    return file


def test_the_wheel_brings_the_hyperparameters_and_the_data(wheel):
    packaged = set(zipfile.ZipFile(wheel).namelist())
    assert {f"sb3_lac/zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").iterdir()} <= packaged
    assert {f"battery_env/nasa_cells/{path.name}" for path in (ROOT / "battery_env/nasa_cells").glob("*.*")} <= packaged


def test_what_the_wheel_installs_finds_its_hyperparameters_from_any_folder(wheel, tmp_path):
    pytest.importorskip("rl_zoo3")
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    (tmp_path / "elsewhere").mkdir()
    result = subprocess.run(
        [sys.executable, "-c", "from sb3_lac.zoo import find_config; print(find_config('td3'))"],
        cwd=tmp_path / "elsewhere",
        env={**os.environ, "PYTHONPATH": str(tmp_path / "installed")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.strip() == str(tmp_path / "installed" / "sb3_lac" / "zoo_configs" / "td3.yml")


def test_logging_and_progress_bars_need_no_extra():
    required = read("setup.cfg")["options"]["install_requires"]
    assert all(f"\n{name}>=" in required for name in ("tensorboard", "tqdm", "rich"))


def test_both_distributions_ask_for_the_same_versions():
    inner = set(read("battery_env/setup.cfg")["options"]["install_requires"].split())
    inner |= set(read("battery_env/setup.cfg")["options.extras_require"]["sb3"].split())
    assert inner <= set(read("setup.cfg")["options"]["install_requires"].split())
    assert read("battery_env/setup.cfg")["options"]["python_requires"] == read("setup.cfg")["options"]["python_requires"]


def test_versions_agree():
    assert (ROOT / "sb3_lac/version.txt").read_text() == (ROOT / "battery_env/version.txt").read_text()
    version = (ROOT / "sb3_lac/version.txt").read_text().strip()
    assert f"version: {version}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert version in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", ["sb3_lac", "battery_env"])
def test_packages_are_typed(package):
    assert importlib.resources.files(package).joinpath("py.typed").is_file()


@pytest.mark.parametrize("algo", ["lac", "sac", "td3"])
def test_every_environment_has_tuned_hyperparameters(algo):
    yaml = pytest.importorskip("yaml")
    config = yaml.safe_load((ROOT / "zoo_configs" / f"{algo}.yml").read_text(encoding="utf-8"))
    packages = ("battery_env.", "sb3_lac.envs.")
    ids = {env_id for env_id, spec in gym.registry.items() if str(spec.entry_point).startswith(packages)}
    assert ids and ids | {"default"} <= set(config)
