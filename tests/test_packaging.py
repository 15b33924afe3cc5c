"""What is installed is what is in the tree."""

import email
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def build_wheel(folder, target):
    code = f"from setuptools.build_meta import build_wheel; print(build_wheel({str(target)!r}))"
    result = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return target / result.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheels")
    for folder in ("sb3_lac", "battery_env", "zoo_configs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    for file in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    built = {"battery_env": build_wheel(source / "battery_env", target), "sb3_lac": build_wheel(source, target)}
    # a copy of a package within it would be one of its parts
    assert not list(source.glob("*/build"))
    return built


def test_each_wheel_owns_its_files_and_brings_its_data_and_license(wheels):
    packaged = {package: set(zipfile.ZipFile(wheel).namelist()) for package, wheel in wheels.items()}
    for package, names in packaged.items():
        modules = {str(path.relative_to(ROOT)) for path in (ROOT / package).rglob("*.py")}
        assert modules | {f"{package}/py.typed", f"{package}/version.txt"} <= names
        assert {name.split("/")[0].split("-")[0] for name in names} == {package}
        assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert {f"sb3_lac/zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").iterdir()} <= packaged["sb3_lac"]
    data = {f"battery_env/records/nasa_cells/{path.name}" for path in (ROOT / "battery_env/records/nasa_cells").glob("*.*")}
    assert data <= packaged["battery_env"]


def test_the_example_that_a_registry_shows_of_battery_env_runs():
    (example,) = re.findall("^```python\n(.*?)^```", (ROOT / "battery_env/README.md").read_text("utf-8"), re.M | re.S)
    exec(compile(example, "battery_env/README.md", "exec"), {})


def test_the_calibrator_is_a_command(wheels):
    with zipfile.ZipFile(wheels["battery_env"]) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
        assert "battery-calibrate = battery_env.__main__:calibrate" in wheel.read(name).decode()


@pytest.mark.attacks
def test_what_the_wheels_install_registers_the_batteries_and_finds_hyperparameters_from_any_folder(wheels, tmp_path):
    pytest.importorskip("rl_zoo3")
    installed = tmp_path / "installed"
    for wheel in wheels.values():
        zipfile.ZipFile(wheel).extractall(installed)
    code = (
        "import sys, sb3_lac, gymnasium\ngymnasium.spec('BatteryQmax-v0')\nprint(sys.modules['battery_env'].__file__)\n"
        "from sb3_lac.zoo import find_config\nprint(find_config('td3'))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    of_package = ("battery_env/__init__.py", "sb3_lac/zoo_configs/td3.yml")
    assert result.stdout.split() == [str(installed / name) for name in of_package]


@pytest.mark.parametrize("package", ["battery_env", "sb3_lac"])
def test_each_wheel_says_what_it_is(wheels, package):
    with zipfile.ZipFile(wheels[package]) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = email.message_from_bytes(wheel.read(name))
    assert metadata["Description-Content-Type"] == "text/markdown" and len(metadata.get_payload()) > 500
    assert metadata["License"] == "MIT" and metadata["Author"] and metadata["Summary"] and metadata["Keywords"]
    assert "Typing :: Typed" in metadata.get_all("Classifier") and metadata.get_all("Project-URL")
