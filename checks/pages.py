"""The pages of the documentation, and what stands on them."""

import inspect
import re
import textwrap
from itertools import groupby
from pathlib import Path
from pkgutil import resolve_name

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    *sorted(page for folder in ("", "environments", "reports") for page in (DOCS / folder).glob("*.md")),
]
REPORTS = sorted((DOCS / "reports").glob("*.md"))
#: What an environment, a report, the reference or the changelog says has a form of its own; all other pages are the guide.
OWN_FORM = {"index", "api", "architecture", "contributing", "changelog"}
GUIDE = [page for page in PAGES if page.parent in (ROOT, DOCS) and page.stem not in OWN_FORM]


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def prose(page):
    """Sentences of a page: without code, tables, headings, pictures and comments; of links the text, of code one word."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->|\$\$.*?\$\$", "", text, flags=re.DOTALL)
    text = re.sub(r"`+[^`]*`+", "code", text)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    paragraphs = []
    for shown, lines in groupby(
        text.splitlines(), lambda line: bool(line.strip()) and not re.match(r"\s*(\||#|:|>? ?\|)", line)
    ):
        if shown:
            paragraphs += re.split(r"\n(?=\s*(?:[-*]|\d+\.) )", "\n".join(lines))
    # the number of an item in a list says nothing
    paragraphs = [re.sub(r"^\s*(?:[-*]|\d+\.) ", "", paragraph) for paragraph in paragraphs]
    sentences = [sentence for paragraph in paragraphs for sentence in re.split(r"(?<=[.!?])[*_)\"]*\s+", paragraph)]
    return [sentence for sentence in sentences if len(sentence.split()) > 1]


def published(path):
    """The rows of a published table, a line each, as cells."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]


def listed_objects():
    """What the API reference lists, by name."""
    listed = re.findall(
        r"^ {3}((?:battery_env|sb3_lac)\.[\w.]+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(listed) == len(set(listed))
    return {name: resolve_name(name) for name in listed}


def docstring_examples():
    """The examples in docstrings of what the API reference lists, by name."""
    return {
        name: "\n".join(textwrap.dedent(block) for block in found)
        for name, value in listed_objects().items()
        if (found := re.findall(r"\.\. code-block:: python\n\n((?: {2,}.*\n|\n)+)", f"{inspect.getdoc(value) or ''}\n"))
    }
