"""The examples of the documentation run, the commands it names exist, and the guide keeps to its house style."""

import importlib.util
import re
import shlex
from itertools import groupby
from pathlib import Path

import pytest

from battery_env.__main__ import calibrate
from battery_env.estimators.reasons import Doubt, Reason
from battery_env.parameters import PARAMETER_NAMES
from sb3_lac.stability import fitting

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    *sorted(page for folder in ("", "environments", "reports") for page in (DOCS / folder).glob("*.md")),
]
# What an example needs that no installation for the tests has: it is skipped there.
OPTIONAL = {"compare_with_pybop.py": ("pybop",)}
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))

#: What an environment, a report, the reference or the changelog says has a form of its own; all other pages are the guide.
OWN_FORM = {"index", "api", "architecture", "contributing", "changelog"}
STYLED = ["README", *(f"docs/{page.stem}" for page in sorted(DOCS.glob("*.md")) if page.stem not in OWN_FORM)]
REPORTS = sorted((DOCS / "reports").glob("*.md"))
#: What the changelog tells, and nothing else: a page says what is.
HISTORY = r"\b(before that version|earlier version|earlier update|once had|at first|used to be|no longer|by hand before)\b"


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def examples(page):
    """The Python of a page in parts that run alone: a block after ``<!-- continued -->`` goes on from the one before."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"(<!-- continued -->\s*)?^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    parts = []
    for continued, block in found:
        if parts and continued:
            parts[-1] += "\n" + block
        else:
            parts.append(block)
    return parts


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


def run_briefly(source, name, folder, monkeypatch):
    """Run an example in an empty folder, with few training steps, episodes, discharges and cells instead of thousands."""
    monkeypatch.chdir(folder)
    if ".learn(" in source:  # then it prints other numbers anyway
        monkeypatch.setattr(fitting, "N_ITERATIONS", 20)
        source = re.sub(r"(fit_life\(load_nasa_discharges\(\"\w+\"\))\)", r"\1[::20])", source)
        source = re.sub(r"\.along\(path, \d+", ".along(path, 20", source)
    source = re.sub(r"\.learn\((total_timesteps=)?[\d_.e]+", r".learn(\g<1>150", source)
    source = re.sub(r"\beval_freq=[\d_]+", "eval_freq=100", source)
    source = re.sub(r"\bfor seed in range\(\d+\)", "for seed in range(1)", source)
    source = re.sub(r"\bn_steps: int = [\d_]+", "n_steps: int = 520", source)
    source = re.sub(r"\b(n_envs|n_episodes|n_eval_episodes)=\d+", r"\1=10", source)
    source = re.sub(r"\bn_episodes_per_start=\d+", "n_episodes_per_start=2", source)
    exec(compile(source, name, "exec"), {"__name__": "__main__"})


LONG = {"cell_life.md", "compare_calibrators.md", "fit_own_cell.py", "forecasts.md", "lac_single_file.py", "own_cell.md"}


def tried(files):
    """Files with examples. Those that train or take long are tried with the attacks, but for README."""
    attacks = [pytest.mark.attacks]
    trains = {file for file in files if ".learn(" in file.read_text(encoding="utf-8") and file.name != "README.md"}
    return [pytest.param(file, marks=attacks if file in trains or file.name in LONG else [], id=file.name) for file in files]


#: Lines of output that a training of some steps does not reach
LEARNED = r"HOLDS|NOT SHOWN|  decreases "


def form(line):
    """A line of output without its numbers, which are others after a short training."""
    return " ".join(re.sub(r"\d[\d.e+-]*", "#", line).split())


@pytest.mark.parametrize("page", tried([page for page in PAGES if blocks(page, "python")]))
def test_examples_in_pages_run_and_print_what_they_show(page, tmp_path, monkeypatch, capsys):
    for source in examples(page):
        run_briefly(source, str(page), tmp_path, monkeypatch)
    printed = capsys.readouterr().out
    shown = re.findall(r"^```python\n(?:(?!^```).)*^```\n\n```text\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    for text in shown:
        if ".learn(" in page.read_text(encoding="utf-8"):
            forms = {form(line) for line in printed.splitlines()}
            assert not [line for line in text.splitlines() if not re.match(LEARNED, line) and form(line) not in forms]
        else:
            assert text in printed


@pytest.mark.parametrize("example", tried(EXAMPLES))
def test_example_files_run(example, tmp_path, monkeypatch):
    for package in OPTIONAL.get(example.name, ()):
        pytest.importorskip(package)
    run_briefly(example.read_text(encoding="utf-8"), str(example), tmp_path, monkeypatch)


@pytest.mark.attacks
def test_commands_of_the_calibrator_run_and_exit_as_their_page_says(tmp_path, monkeypatch):
    page = ROOT / "docs/command_line.md"
    run_briefly("\n".join(blocks(page, "python")), str(page), tmp_path, monkeypatch)
    lines = list(filter(None, "\n".join(blocks(page, "bash")).splitlines()))
    assert len(lines) > 5
    for line in lines:
        words = shlex.split(line, comments=True)
        status = re.search(r"# exits (\d)", line)
        assert words[0] == "battery-calibrate", line
        assert calibrate(words[1:]) == int(status[1] if status else 0), line


def test_the_first_page_shows_what_the_calibrator_prints(capsys):
    text = (DOCS / "first_discharge.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```(?:text)?\n(B0005_100: .*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    assert calibrate(["B0005:100"]) == 0
    assert capsys.readouterr().out.strip() == shown.strip()


def test_reasons_can_be_looked_up_by_their_own_words():
    text = (DOCS / "real_cells.md").read_text(encoding="utf-8")
    named = [words for row in re.findall(r"^\| (\".*?) \|", text, flags=re.MULTILINE) for words in re.findall('"(.*?)"', row)]
    texts = [row.text for row in (*Reason, *Doubt)] + [Reason.IMPRECISE.said(number, {}) for number in PARAMETER_NAMES]
    assert named and not [words for words in named if not any(words in text for text in texts)]


def test_the_first_screen_names_the_interval_that_the_tutorial_of_a_life_shows():
    (shown,) = re.findall(r"end of discharge \(s\) +(\d+) +\d+ +(\d+)", (DOCS / "cell_life.md").read_text(encoding="utf-8"))
    assert f"lies within {shown[0]} to {shown[1]} s" in (ROOT / "README.md").read_text(encoding="utf-8")


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


def test_every_published_table_is_in_the_list_of_all_tables():
    page = (DOCS / "results/README.md").read_text(encoding="utf-8")
    tables = sorted(path.relative_to(DOCS / "results").as_posix() for path in DOCS.glob("results/*/*.md"))
    assert sorted(re.findall(r"\]\(([^)]+\.md)\)", page)) == tables


def test_every_picture_is_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in (*PAGES, *DOCS.glob("*/*.md")))
    pictures = [path for suffix in ("png", "gif") for path in DOCS.glob(f"*/**/*.{suffix}") if "_build" not in path.parts]
    unused = [path.relative_to(DOCS).as_posix() for path in pictures if path.relative_to(DOCS).as_posix() not in text]
    assert pictures and not unused


@pytest.mark.parametrize("name", STYLED)
def test_a_page_of_the_guide_keeps_to_the_house_style(name):
    page = ROOT / f"{name}.md"
    text = page.read_text(encoding="utf-8")
    sentences = prose(page)
    words = [word for sentence in sentences for word in sentence.split()]
    numbers = sum(bool(re.match(r"[-+±(]?\d", word)) for word in words)
    assert len(text.splitlines()) < 150
    assert len(words) / len(sentences) < 22, max(sentences, key=lambda sentence: len(sentence.split()))
    assert numbers < 3 + 0.03 * len(words), f"{numbers} numbers in {len(words)} words: a table says more"
    assert not (found := re.search(HISTORY, text)), found


@pytest.mark.parametrize("page", [ROOT / f"{name}.md" for name in STYLED] + REPORTS, ids=lambda page: page.name)
def test_every_picture_has_a_caption(page):
    for picture in re.findall(r"^!\[.*\n\n?(?!\n?\*)", page.read_text(encoding="utf-8"), flags=re.MULTILINE):
        pytest.fail(f"a line in italics has to follow {picture.strip()}: what to see, who made it, how many seeds")


@pytest.mark.parametrize("name", STYLED)
def test_tables_and_code_of_the_guide_fit_the_column_of_the_site(name):
    wide = [line for block in blocks(ROOT / f"{name}.md", "python") for line in block.splitlines() if len(line) > 97]
    assert not wide
    for row in published(ROOT / f"{name}.md"):
        assert len(row) <= 6, row
        for cell in row:
            words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", cell).split()
            assert len(words) <= 25, f"{len(words)} words: {cell}"


def test_reports_are_short_enough_to_be_read():
    words = 0
    for page in REPORTS:
        words += sum(len(sentence.split()) for sentence in prose(page))
        words += sum(len(cell.split()) for row in published(page) for cell in row if not re.fullmatch(":?-+:?", cell))
    assert words < 12_000


@pytest.mark.parametrize("page", REPORTS, ids=lambda page: page.name)
def test_a_report_answers_before_it_details(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"^## (.*)", text, flags=re.MULTILINE) == ["Question", "Answer", "How to repeat it", "Details"]
    answer = text[text.index("## Answer") : text.index("## How to repeat it")]
    assert answer.count("\n![") == 1 and answer.count("\n\n|") == 1


#: Pages that say who is better: each names the rows that it rests on, ``<!-- rests on TABLE: cells of a row; value -->``.
CLAIMING = ("README", "docs/when_to_take_lac", "docs/results_at_a_glance", "docs/faq", "docs/pretrained")


@pytest.mark.parametrize("name", CLAIMING)
def test_a_claim_of_the_guide_names_the_rows_that_it_rests_on(name):
    text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
    named = re.split(r"<!-- rests on ([^:\s]+): ([^>]+) -->", text)
    # what is said is the paragraph before
    claims = [(said.rpartition("\n\n")[2], *row) for said, *row in zip(named[:-1:3], named[1::3], named[2::3], strict=True)]
    assert claims
    for said, source, cells in claims:
        *keys, value = cells.split("; ")
        of_keys = [row for row in published(ROOT / source) if set(keys) <= set(row)]
        assert any(
            value in {part for cell in row for part in (cell, *cell.split(" / "), *cell.split(" "))} for row in of_keys
        ), cells
        assert re.search(rf"(?<![\d.]){re.escape(value)}(?![\d])", said), f"{value} is not said where {source} is named"


@pytest.mark.parametrize("page", [ROOT / f"{name}.md" for name in STYLED] + REPORTS, ids=lambda page: page.name)
def test_a_table_that_names_its_source_holds_what_was_published(page):
    tables = re.findall(r"<!-- from ([^>]+) -->\n\n((?:\|.*\n)+)", page.read_text(encoding="utf-8"))
    for source, table in tables:
        rows = [row for name in source.split() for row in published(ROOT / name)]
        header, _, *lines = ([cell.strip(" *`") for cell in line.strip().strip("|").split("|")] for line in table.splitlines())
        for key, *cells in lines:
            keys = [key, *(cell for cell in cells if re.match("[a-zA-Z]", cell))]
            of_key = [row for row in rows if set(keys) <= set(row)]
            assert of_key, f"{source} has no row of {keys}"
            for name, cell in zip(header[1:], cells, strict=True):
                of_cell = [row for row in of_key if name in row] or of_key
                values = {
                    value for row in of_cell for value in (*row, *(part for whole in row for part in whole.split(" ")[:1]))
                }
                assert not cell or cell in values, f"{source} has no {cell!r} of {key}, {name}"
