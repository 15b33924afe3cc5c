"""The examples of pages and docstrings run, and print what is shown."""

import ast
import re
import shlex

import numpy as np
import pytest
from PIL import Image

from battery_env.__main__ import calibrate
from battery_env.estimates.findings import CODES, Finding
from battery_env.estimators.verdict import NUMBERS
from checks.pages import DOCS, PAGES, ROOT, blocks, docstring_examples
from sb3_lac.checks import advice_for_a_time_limit
from sb3_lac.stability import NoCostError, fitting, report
from sb3_lac.stability.certification import NEEDS, OWN_BOUND
from sb3_lac.stability.rollout import where_it_rests
from tests.sweeps import sweep

# What an example needs that no installation for the tests has: it is skipped there.
OPTIONAL = {"compare_with_pybop.py": ("pybop",), "control_a_pc_gym_reactor.py": ("pcgym",)}
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
OF_DOCSTRINGS = docstring_examples()


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
    source = re.sub(r"\b(n_envs|n_episodes)=\d+", r"\1=10", source)
    source = re.sub(r"\bn_episodes_per_start=\d+", "n_episodes_per_start=6", source)
    exec(compile(source, name, "exec"), {"__name__": "__main__"})


LONG = {"cell_life.md", "compare_calibrators.md", "fit_own_cell.py", "forecasts.md", "lac_single_file.py", "own_cell.md"}


def tried(files):
    """Files with examples. Those that train or take long are tried with the attacks, but for README."""
    attacks = [pytest.mark.attacks]
    trains = {file for file in files if ".learn(" in file.read_text(encoding="utf-8") and file.name != "README.md"}
    return [pytest.param(file, marks=attacks if file in trains or file.name in LONG else [], id=file.name) for file in files]


#: A number of an output: after a short training it is another one, which may have another notation
NUMBER = r"(?<![\w.])[-+]?(\d[\d.]*(e[-+]?\d+)?|nan|inf)(?!\w)"
#: Texts of the package that trains. A shorter one says little of every word: it could be part of any line.
TEXTS = {
    re.sub(NUMBER, "#", each.value)
    for file in (ROOT / "sb3_lac").rglob("*.py")
    for each in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    if isinstance(each, ast.Constant) and isinstance(each.value, str) and not re.fullmatch(r"\w{0,3}", each.value)
}


def form(line):
    """A line of output without its numbers."""
    return " ".join(re.sub(NUMBER, "#", line).split())


def can_be_said(line):
    """Whether texts of the package and numbers, one after the other, are this line: a short training may say another one."""
    line, reached = form(line), {0}
    for start in range(len(line)):
        if start in reached:
            reached |= {start + len(text) for text in (*TEXTS, "#", " ") if line.startswith(text, start)}
    return len(line) in reached


@pytest.mark.parametrize("page", tried([page for page in PAGES if blocks(page, "python")]))
def test_examples_in_pages_run_and_print_what_they_show(page, tmp_path, monkeypatch, capsys):
    for source in examples(page):
        run_briefly(source, str(page), tmp_path, monkeypatch)
    printed = capsys.readouterr().out
    shown = re.findall(r"^```python\n(?:(?!^```).)*^```\n\n```text\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    for text in shown:
        if ".learn(" in page.read_text(encoding="utf-8"):
            forms = {form(line) for line in printed.splitlines()}
            assert not [line for line in text.splitlines() if form(line) not in forms and not can_be_said(line)]
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


def test_each_finding_has_a_row_of_remedies_by_its_code_and_its_own_words():
    rows = re.findall(r"^\| (`.*?) \| (.*?) \|", (DOCS / "findings.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    codes = [re.findall("`(.*?)`", first) for first, _ in rows]
    assert sorted(code for of_row in codes for code in of_row) == sorted(CODES)
    for of_row, (_, says) in zip(codes, rows, strict=True):
        texts = [CODES[code].text for code in of_row]
        if of_row == ["imprecise"]:
            texts = [str(Finding("imprecise", number)) for number in NUMBERS]
        words = re.findall('"(.*?)"', says)
        assert of_row == ["other"] or [len([each for each in words if each in text]) for text in texts] == [1] * len(texts)
        assert all(any(each in text for text in texts) for each in words), words


def test_what_the_summaries_of_a_loop_say_against_it_has_a_row_of_remedies_each():
    text = (DOCS / "judge_any_loop.md").read_text(encoding="utf-8")
    rows = re.findall(r'^\| "(.*?)"(.*?) \|', text, flags=re.MULTILINE)
    said = [reason.value for reason in report.Reason] + [report.SHORT, str(NoCostError(0.0)), OWN_BOUND, *NEEDS]
    said += [advice_for_a_time_limit(np.array([5, 5])), where_it_rests(late_cost=0.5, start_cost=1.0)]
    assert [sum(words in each for words, _ in rows) for each in said] == [1] * len(said)
    assert [sum(words in each for each in said) for words, _ in rows] == [1] * len(rows)
    assert {words for words, rest in rows if rest == ", not made"} == set(NEEDS)


def test_the_first_screen_names_the_interval_that_its_block_prints(capsys):
    page = ROOT / "README.md"
    (block,) = (block for block in blocks(page, "python") if "track_life" in block)
    exec(compile(block, str(page), "exec"), {})
    (shown,) = re.findall(r"end of discharge \(s\) +(\d+) +\d+ +(\d+)", capsys.readouterr().out)
    assert f"lies within {shown[0]} to {shown[1]} s" in page.read_text(encoding="utf-8")


#: Figures with numbers in their titles: the page that shows each, what its command writes, and whether the page has the text.
FIGURES = sweep(
    ("first_discharge.png", "first_discharge.md", "results/B0005_100_voltage.png", True),
    ("own_cell.png", "own_cell.md", "my_cell_fit.png", False),
)


def title_of(path):
    with Image.open(path) as picture:
        return picture.text["Title"]


@pytest.mark.parametrize(("figure", "page", "written", "is_printed"), FIGURES)
def test_the_command_of_a_page_prints_what_it_shows_and_writes_its_figure(
    figure, page, written, is_printed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    command = next(block for block in blocks(DOCS / page, "bash") if "battery-calibrate" in block).splitlines()[0]
    calibrate(shlex.split(command, comments=True)[1:])
    assert title_of(DOCS / "pictures" / figure) == title_of(written)
    assert not is_printed or blocks(DOCS / page, "text")[0].strip() in capsys.readouterr().out


@pytest.mark.attacks
def test_runs_of_another_page_do_not_disturb_the_comparison_of_runs(tmp_path, monkeypatch):
    for name in ("judge_any_loop.md", "tensorboard.md"):
        for source in examples(DOCS / name):
            run_briefly(source, name, tmp_path, monkeypatch)
    assert {path.name for path in (tmp_path / "bands").iterdir()} == {"LAC", "PublishedLAC", "SAC", "TD3"}


def tried_of_docstrings():
    """Whole examples of docstrings. Those that train are tried with the attacks, but for that of LAC."""
    for name, example in OF_DOCSTRINGS.items():
        if "import " in example:
            trains = ".learn(" in example and name != "sb3_lac.LAC"
            yield pytest.param(name, marks=pytest.mark.attacks if trains else ())


@pytest.mark.parametrize("name", [*tried_of_docstrings()])
def test_whole_examples_of_docstrings_run(name, tmp_path, monkeypatch):
    run_briefly(OF_DOCSTRINGS[name], name, tmp_path, monkeypatch)
