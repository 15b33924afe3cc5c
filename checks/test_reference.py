"""The API reference lists what a user can import, and what a call returns, with examples of what users call first."""

import ast
import inspect
import re
import sys
from pkgutil import resolve_name

import battery_env
import sb3_lac.envs
import sb3_lac.stability
from checks.pages import PAGES, docstring_examples, listed_objects

PACKAGES = ("battery_env", "sb3_lac")
OBJECTS = listed_objects()
IDENTITIES = {id(value) for value in OBJECTS.values()}


def imported(page):
    """The names that the Python blocks of a page import from the packages."""
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def returned(function):
    """The classes of the packages that a function is annotated to return."""
    named = re.findall(r"\b[A-Z]\w+", str(inspect.get_annotations(function).get("return", "")))
    found = [getattr(sys.modules[function.__module__], name, None) for name in named]
    return [each for each in found if inspect.isclass(each) and each.__module__.split(".")[0] in PACKAGES]


def public_functions(name, value):
    if inspect.isclass(value):
        members = {f"{name}.{member}": getattr(value, member) for member in vars(value) if not member.startswith("_")}
        return {path: member for path, member in members.items() if inspect.isfunction(member) or inspect.ismethod(member)}
    return {name: value} if inspect.isfunction(value) else {}


def test_what_a_page_imports_is_in_the_reference():
    for page in PAGES:
        missing = [name for name in imported(page) if id(resolve_name(name)) not in IDENTITIES]
        assert not missing, f"{page.name}: list them in docs/api.md: {missing}"


def test_what_a_package_exports_is_in_the_reference():
    for package in (battery_env, sb3_lac, sb3_lac.envs, sb3_lac.stability):
        exported = (name for name in package.__all__ if name != "__version__")
        missing = [name for name in exported if id(getattr(package, name)) not in IDENTITIES]
        assert not missing, f"{package.__name__}: list them in docs/api.md: {missing}"


def test_what_a_call_returns_is_in_the_reference():
    functions = {path: each for name, value in OBJECTS.items() for path, each in public_functions(name, value).items()}
    missing = {path: kind for path, each in functions.items() for kind in returned(each) if id(kind) not in IDENTITIES}
    assert not missing, f"list them in docs/api.md: {missing}"


def test_nothing_is_listed_twice():
    assert len(OBJECTS) == len(IDENTITIES)


WITH_EXAMPLE = (
    *("CalibrationCallback", "LAC", "LyapunovFunction", "LyapunovPolicy", "GymnasiumVecEnv", "PolicyEstimator"),
    *("TrajectoryDataset", "certify", "evaluate", "evaluate_lyapunov", "export_onnx", "fit_lyapunov"),
    *("load_nasa_discharges", "simulate"),
)


def test_what_users_call_first_has_an_example():
    assert set(WITH_EXAMPLE) <= {path.rpartition(".")[2] for path in docstring_examples()}
