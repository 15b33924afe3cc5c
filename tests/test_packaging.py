"""What is installed is what is in the tree."""

import configparser
import importlib.resources
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
    listed = set(read("battery_env/setup.cfg")["options"]["packages"].split())
    found = {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in (ROOT / "battery_env").rglob("__init__.py")}
    assert listed == found


def test_both_distributions_ask_for_the_same_versions():
    inner = set(read("battery_env/setup.cfg")["options"]["install_requires"].split())
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
