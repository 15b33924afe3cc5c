"""The examples of the documentation run, and the commands it names exist."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from battery_env.__main__ import calibrate, main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    *sorted(page for folder in ("", "environments", "reports") for page in (DOCS / folder).glob("*.md")),
]
# What an example needs that no installation for the tests has: it is skipped there.
OPTIONAL = {"compare_with_pybop.py": ("pybop",)}
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def run_briefly(source, name, folder, monkeypatch):
    """Run an example in an empty folder, with a few training steps instead of thousands."""
    monkeypatch.chdir(folder)
    source = re.sub(r"\.learn\((total_timesteps=)?[\d_.e]+", r".learn(\g<1>150", source)
    exec(compile(source, name, "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_examples_in_pages_run(page, tmp_path, monkeypatch):
    run_briefly("\n".join(blocks(page, "python")), str(page), tmp_path, monkeypatch)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_example_files_run(example, tmp_path, monkeypatch):
    for package in OPTIONAL.get(example.name, ()):
        pytest.importorskip(package)
    run_briefly(example.read_text(encoding="utf-8"), str(example), tmp_path, monkeypatch)


def test_commands_of_the_calibrator_run_and_exit_as_their_page_says(tmp_path, monkeypatch):
    page = ROOT / "docs/command_line.md"
    run_briefly("\n".join(blocks(page, "python")), str(page), tmp_path, monkeypatch)
    lines = list(filter(None, "\n".join(blocks(page, "bash")).splitlines()))
    assert len(lines) > 5
    for line in lines:
        words = shlex.split(line, comments=True)
        status = re.search(r"# exits (\d)", line)
        command, arguments = (calibrate, words[1:]) if words[0] == "battery-calibrate" else (main, words[3:])
        assert words[0] == "battery-calibrate" or words[:3] == ["python", "-m", "battery_env"], line
        assert command(arguments) == int(status[1] if status else 0), line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_pages_exist(page):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for line in "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:2] == ["python", "-m"] and words[2] != "pip":
            assert importlib.util.find_spec(words[2]) is not None, line
        elif words[:1] == ["make"]:
            assert re.search(rf"^{words[1]}:", makefile, flags=re.MULTILINE), line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_published_table_is_on_the_page_of_all_tables():
    page = (DOCS / "all_tables.md").read_text(encoding="utf-8")
    tables = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.glob("results/*/*.md"))
    assert sorted(re.findall(r"\]\((results/[^)]+)\)", page)) == tables
