"""Importing the packages is quick, needs nothing of the other one, and compiles kernels once."""

import ast
import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import battery_env
from battery_env.compiled import digest_of_kernels, forget_outdated
from tests.sweeps import sweep

ROOT = Path(__file__).parents[1]

# each takes a good part of a second to import
HEAVY = {"matplotlib", "numba", "pandas", "pyarrow", "scipy", "yaml"}


@pytest.mark.parametrize(("package", "base"), sweep(("battery_env", "gymnasium"), ("sb3_lac", "stable_baselines3")))
def test_importing_a_package_registers_its_environments_and_loads_nothing_slow(package, base):
    code = f"import sys, {base}, gymnasium; before = set(sys.modules); import {package}; "
    code += "print(*set(sys.modules) - before); gymnasium.spec('BatteryRo-v0')"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not HEAVY & {name.split(".")[0] for name in result.stdout.split()}


def test_sb3_lac_does_without_batteries(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "sb3_lac"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "battery_env", None)
    assert importlib.import_module("sb3_lac").LAC.__module__ == "sb3_lac.lac"


def test_kernels_are_compiled_where_there_is_no_place_to_keep_them():
    nowhere = "from numba.core import caching; caching.CompileResultCacheImpl._locator_classes = []"
    code = f"{nowhere}; from battery_env.electrochemistry.kernels import logarithm; print(logarithm(1.0))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout == "0.0\n" and not result.stderr


def test_kernels_are_those_of_the_code_that_they_may_call_whatever_its_date(tmp_path):
    package = tmp_path / "battery_env"
    package.mkdir()
    kernels, numbers, plots = (package / name for name in ("kernels.py", "numbers.py", "plots.py"))
    kernels.write_text("from battery_env.compiled import compiled\nfrom battery_env.numbers import (\n    N,\n)\n")
    numbers.write_text("N = 1\n")
    plots.write_text("from battery_env.kernels import N\n")

    def digest():
        digest_of_kernels.cache_clear()
        return digest_of_kernels(package)

    first = digest()
    plots.write_text("")
    for path in (kernels, numbers, plots):
        os.utime(path, (9e9, 9e9))  # a wrong clock
    assert digest() == first
    numbers.write_text("N = 2\n")
    assert digest() not in (first, None)
    digest_of_kernels.cache_clear()


def test_kernels_of_other_code_are_forgotten_and_those_of_this_one_stay(tmp_path):
    for digest, stays in (("a", False), ("a", True), ("b", False)):
        (tmp_path / "kept.nbi").touch()
        forget_outdated.cache_clear()
        forget_outdated(tmp_path, digest)
        assert (tmp_path / "kept.nbi").exists() == stays
    forget_outdated.cache_clear()


def test_whoever_waits_for_the_first_compilation_is_told(tmp_path):
    code = (
        "from battery_env.compiled import announce_compilation\nfrom battery_env.electrochemistry import kernels\n"
        "with announce_compilation():\n    kernels.logarithm(1.0), kernels.logarithm(2)\n"
    )
    said = []
    for _ in range(2):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
        assert result.returncode == 0 and not result.stdout
        said.append(result.stderr)
    assert said == ["compiling, once after an installation or update: half a minute\n", ""]


def test_every_public_name_of_battery_env_is_the_one_that_type_checkers_see():
    tree = ast.parse((ROOT / "battery_env/__init__.py").read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    for node in typed.body:
        for alias in node.names:
            value = getattr(battery_env, alias.name)
            assert value is getattr(sys.modules[node.module], alias.name)
            assert pickle.loads(pickle.dumps(value)) is value or alias.name == "NEW_CELL"
    seen = {alias.name for node in typed.body for alias in node.names}
    assert seen | {"register_environments"} == set(battery_env.__all__) <= set(dir(battery_env))
    with pytest.raises(AttributeError, match="'battery_env' has no attribute 'evalute'"):
        battery_env.evalute  # noqa: B018
