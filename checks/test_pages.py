"""Links and commands of the pages exist, tables are those that were published, and the guide keeps to its house style."""

import importlib.util
import re
import shlex

from checks.pages import DOCS, GUIDE, PAGES, REPORTS, ROOT, blocks, prose, published
from docs.conf import TUTORIALS, notebook_of

#: What the changelog tells, and nothing else: a page says what is.
HISTORY = r"\b(before that version|earlier version|earlier update|once had|at first|used to be|no longer|by hand before)\b"
#: Pages that say who is better: each names the rows that it rests on, ``<!-- rests on TABLE: cells of a row; value -->``.
CLAIMING = ("README", "docs/when_to_take_lac", "docs/results_at_a_glance", "docs/faq", "docs/pretrained")


def text_of(page):
    return page.read_text(encoding="utf-8")


def test_commands_in_pages_exist():
    makefile = text_of(ROOT / "Makefile")
    for page in PAGES:
        for line in "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:2] == ["python", "-m"] and words[2] != "pip":
                assert importlib.util.find_spec(words[2]) is not None, f"{page.name}: {line}"
            elif words[:1] == ["make"]:
                assert re.search(rf"^{words[1]}:", makefile, flags=re.MULTILINE), f"{page.name}: {line}"


def test_the_notebook_of_a_tutorial_has_its_python_as_cells_and_its_commands_for_a_shell():
    for name in TUTORIALS:
        page = DOCS / f"{name}.md"
        notebook = notebook_of(text_of(page))
        cells = [cell.source.strip() for cell in notebook.cells if cell.cell_type == "code"]
        commands = [cell for cell in cells if cell.startswith("%%bash")]
        assert [each for each in cells if each not in commands] == [block.strip() for block in blocks(page, "python")]
        assert [each.partition("\n")[2] for each in commands] == [block.strip() for block in blocks(page, "bash")]


def test_pages_agree_on_how_long_the_demo_takes():
    said = [
        re.findall(r"make demo\b[^\n]*: ([^:\n]+ minutes) on two cores", text_of(ROOT / name))
        for name in ("README.md", "docs/install.md")
    ]
    assert said[0] == said[1] and len(said[0]) == 1


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text_of(page)):
            assert "://" in target or (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_published_table_is_in_the_list_of_all_tables():
    page = text_of(DOCS / "results/README.md")
    tables = sorted(path.relative_to(DOCS / "results").as_posix() for path in DOCS.glob("results/*/*.md"))
    assert sorted(re.findall(r"\]\(([^)]+\.md)\)", page)) == tables


def test_every_picture_is_on_a_page():
    text = "".join(text_of(page) for page in (*PAGES, *DOCS.glob("*/*.md")))
    pictures = [path for suffix in ("png", "gif") for path in DOCS.glob(f"*/**/*.{suffix}") if "_build" not in path.parts]
    unused = [path.relative_to(DOCS).as_posix() for path in pictures if path.relative_to(DOCS).as_posix() not in text]
    assert pictures and not unused


def test_every_picture_has_a_caption():
    for page in (*GUIDE, *REPORTS):
        for picture in re.findall(r"^!\[.*\n\n?(?!\n?\*)", text_of(page), flags=re.MULTILINE):
            raise AssertionError(f"{page.name}: a line in italics has to follow {picture.strip()}: what to see, who made it")


def test_pages_of_the_guide_are_short():
    long = [page.name for page in GUIDE if len(text_of(page).splitlines()) >= 150]
    assert not long


def test_sentences_of_the_guide_are_short():
    for page in GUIDE:
        sentences = prose(page)
        words = sum(len(sentence.split()) for sentence in sentences)
        assert words / len(sentences) < 22, f"{page.name}: {max(sentences, key=lambda sentence: len(sentence.split()))}"


def test_pages_of_the_guide_leave_numbers_to_tables():
    for page in GUIDE:
        words = [word for sentence in prose(page) for word in sentence.split()]
        numbers = sum(bool(re.match(r"[-+±(]?\d", word)) for word in words)
        assert numbers < 3 + 0.03 * len(words), f"{page.name}: {numbers} numbers in {len(words)} words: a table says more"


def test_pages_of_the_guide_tell_no_history():
    for page in GUIDE:
        assert not (found := re.search(HISTORY, text_of(page))), f"{page.name}: {found}"


def test_code_of_the_guide_fits_the_column_of_the_site():
    for page in GUIDE:
        wide = [line for block in blocks(page, "python") for line in block.splitlines() if len(line) > 97]
        assert not wide, page.name


def test_tables_of_the_guide_fit_the_column_of_the_site():
    for page in GUIDE:
        for row in published(page):
            assert len(row) <= 6, f"{page.name}: {row}"
            for cell in row:
                words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", cell).split()
                assert len(words) <= 25, f"{page.name}: {len(words)} words: {cell}"


def test_reports_are_short_enough_to_be_read():
    words = 0
    for page in REPORTS:
        words += sum(len(sentence.split()) for sentence in prose(page))
        words += sum(len(cell.split()) for row in published(page) for cell in row if not re.fullmatch(":?-+:?", cell))
    assert words < 12_000


def test_a_report_answers_before_it_details():
    for page in REPORTS:
        text = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
        headings = re.findall(r"^## (.*)", text, flags=re.MULTILINE)
        assert headings == ["Question", "Answer", "How to repeat it", "Details"], page.name
        answer = text[text.index("## Answer") : text.index("## How to repeat it")]
        assert answer.count("\n![") == 1 and answer.count("\n\n|") == 1, page.name


def test_a_claim_of_the_guide_names_the_rows_that_it_rests_on():
    for name in CLAIMING:
        named = re.split(r"<!-- rests on ([^:\s]+): ([^>]+) -->", text_of(ROOT / f"{name}.md"))
        # what is said is the paragraph before
        claims = [
            (said.rpartition("\n\n")[2], *row) for said, *row in zip(named[:-1:3], named[1::3], named[2::3], strict=True)
        ]
        assert claims, name
        for said, source, cells in claims:
            *keys, value = cells.split("; ")
            of_keys = [row for row in published(ROOT / source) if set(keys) <= set(row)]
            assert any(
                value in {part for cell in row for part in (cell, *cell.split(" / "), *cell.split(" "))} for row in of_keys
            ), f"{name}: {cells}"
            assert re.search(rf"(?<![\d.]){re.escape(value)}(?![\d])", said), f"{name}: {value} of {source} is not said"


def test_a_table_that_names_its_source_holds_what_was_published():
    for page in (*GUIDE, *REPORTS):
        tables = re.findall(r"<!-- from ([^>]+) -->\n\n((?:\|.*\n)+)", text_of(page))
        for source, table in tables:
            rows = [row for name in source.split() for row in published(ROOT / name)]
            check_holds(table, rows, f"{page.name}: {source}")


def check_holds(table, rows, where):
    """Check that each cell of a table stands in a published row of the same key."""
    header, _, *lines = ([cell.strip(" *`") for cell in line.strip().strip("|").split("|")] for line in table.splitlines())
    for key, *cells in lines:
        keys = [key, *(cell for cell in cells if re.match("[a-zA-Z]", cell))]
        of_key = [row for row in rows if set(keys) <= set(row)]
        assert of_key, f"{where} has no row of {keys}"
        for name, cell in zip(header[1:], cells, strict=True):
            of_cell = [row for row in of_key if name in row] or of_key
            values = {value for row in of_cell for value in (*row, *(part for whole in row for part in whole.split(" ")[:1]))}
            assert not cell or cell in values, f"{where} has no {cell!r} of {key}, {name}"
