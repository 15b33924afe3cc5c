"""The API reference lists what a user can import, and what a call returns; its examples run."""

import ast
import inspect
import pkgutil
import re
import sys
import textwrap
from pathlib import Path

import pytest

import battery_env
import sb3_lac.envs
import sb3_lac.stability
from sb3_lac.stability import fitting

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS.parent / "README.md", *(page for page in sorted(DOCS.rglob("*.md")) if "results" not in page.parts)]
PACKAGES = ("battery_env", "sb3_lac")
LISTED = re.findall(r"^ {3}((?:battery_env|sb3_lac)\.[\w.]+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
OBJECTS = {name: pkgutil.resolve_name(name) for name in LISTED}
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_imports_is_in_the_reference(page):
    missing = [name for name in imported(page) if id(pkgutil.resolve_name(name)) not in IDENTITIES]
    assert not missing, f"list them in docs/api.md: {missing}"


@pytest.mark.parametrize("package", [battery_env, sb3_lac, sb3_lac.envs, sb3_lac.stability], ids=lambda each: each.__name__)
def test_what_a_package_exports_is_in_the_reference(package):
    exported = (name for name in package.__all__ if name != "__version__")
    missing = [name for name in exported if id(getattr(package, name)) not in IDENTITIES]
    assert not missing, f"list them in docs/api.md: {missing}"


def test_what_a_call_returns_is_in_the_reference():
    functions = {path: each for name, value in OBJECTS.items() for path, each in public_functions(name, value).items()}
    missing = {path: kind for path, each in functions.items() for kind in returned(each) if id(kind) not in IDENTITIES}
    assert not missing, f"list them in docs/api.md: {missing}"


def test_nothing_is_listed_twice():
    assert len(LISTED) == len(set(LISTED)) == len(IDENTITIES)


EXAMPLES = {
    name: "\n".join(textwrap.dedent(block) for block in found)
    for name, value in OBJECTS.items()
    if (found := re.findall(r"\.\. code-block:: python\n\n((?: {2,}.*\n|\n)+)", f"{inspect.getdoc(value) or ''}\n"))
}
WITH_EXAMPLE = (
    *("CalibrationCallback", "LAC", "LyapunovFunction", "LyapunovPolicy", "GymnasiumVecEnv", "PolicyEstimator"),
    *("TrajectoryDataset", "certify", "evaluate", "evaluate_lyapunov", "export_onnx", "fit_lyapunov"),
    *("load_nasa_discharges", "simulate"),
)


@pytest.mark.parametrize("name", WITH_EXAMPLE)
def test_what_users_call_first_has_an_example(name):
    assert name in {path.rpartition(".")[2] for path in EXAMPLES}


def tried(name):
    """Examples that train are tried with the attacks, but for that of LAC."""
    trains = ".learn(" in EXAMPLES[name] and name != "sb3_lac.LAC"
    return pytest.param(name, marks=pytest.mark.attacks if trains else ())


@pytest.mark.parametrize("name", [tried(name) for name, example in EXAMPLES.items() if "import " in example])
def test_whole_examples_of_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fitting, "N_ITERATIONS", 20)
    brief = re.sub(r"\.learn\([\d_]+", ".learn(150", EXAMPLES[name])  # a few training steps instead of thousands
    exec(compile(brief, name, "exec"), {})
