"""
Files as testers and loggers write them: what was right of them once stays right. README.md of this folder says how to read
the table.
"""

import csv
import json
import re
import shlex
from pathlib import Path

import pytest

from battery_env.lab.command_line import REFUSED, calibrate

FOLDER = Path(__file__).parent
INPUTS = FOLDER / "inputs"
CHARGE_SHARE, Q_MAX_SHARE, REMAINING_SHARE = 3e-3, 3e-2, 5e-2
#: What is settled, by the word of the table: of q_max and R_o each must be, must not be, or may be.
SETTLED = {
    "both": (True, True),
    "not q_max": (False, None),
    "neither": (False, False),
    "": (None, None),
}


def rows():
    """The rows of the table, each marked with why it is not right yet, if it is not."""
    with (FOLDER / "table.csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            why = row["not_yet"]
            tried = not why.startswith("not tried: ")
            marks = [pytest.mark.xfail(reason=why, strict=True, run=tried)] if why else []
            yield pytest.param(row, marks=marks, id=row["command"])


@pytest.fixture
def answer(tmp_path, monkeypatch, capsys):
    """Make commands in a folder of their own; of the last one return the exit status, the rows and the text."""
    monkeypatch.chdir(tmp_path)

    def ask(commands):
        *before, last = (shlex.split(command) for command in commands.split(";"))
        for words in before:
            assert calibrate(of_inputs(words)) != REFUSED
        capsys.readouterr()
        status = calibrate([*of_inputs(last), "--json"])
        said = capsys.readouterr()
        found = [json.loads(line) for line in said.out.splitlines()]
        return status, found, " ".join(f"{said.out} {said.err}".split())

    return ask


def of_inputs(words):
    """The words of a command, in which inputs are named by their paths."""
    return [str(INPUTS / word) if (INPUTS / word).exists() else word for word in words]


@pytest.mark.parametrize("row", [*rows()])
def test_what_was_right_once_is_right(row, answer):
    status, found, said = answer(row["command"])
    assert re.search(row["says"], said), said
    if row["advised"] or not (row["charges_Ah"] or row["remaining_s"]):
        assert status == REFUSED, said
    if row["advised"]:
        _, found, said = answer(row["advised"])
    if row["charges_Ah"]:
        assert_as_in_the_table(found, row)
    if row["remaining_s"]:
        (forecast,) = found
        low_s, median_s, high_s = forecast["remaining_s"]
        assert low_s <= float(row["remaining_s"]) <= high_s
        assert median_s == pytest.approx(float(row["remaining_s"]), rel=REMAINING_SHARE)


def assert_as_in_the_table(found, row):
    """Compare what discharges say with a row of the table."""
    charges = row["charges_Ah"].split()
    assert len(found) == len(charges)
    for each, charge_Ah in zip(found, charges, strict=True):
        assert bool(each["error"]) == (charge_Ah == "refused")
        if charge_Ah == "refused":
            continue
        assert each["drawn_Ah"] == pytest.approx(float(charge_Ah), rel=CHARGE_SHARE)
        for name, expected in zip(("settled_q_mobile", "settled_r_o"), SETTLED[row["settled"]], strict=True):
            assert expected in (None, each[name]), name
        if row["q_max_Ah"]:
            assert each["q_mobile_C"] / 3600.0 == pytest.approx(float(row["q_max_Ah"]), rel=Q_MAX_SHARE)


def test_each_input_is_in_the_table():
    named = (FOLDER / "table.csv").read_text(encoding="utf-8")
    files = [path.relative_to(INPUTS) for path in INPUTS.rglob("*") if path.is_file()]
    assert files and not [path.as_posix() for path in files if path.as_posix() not in named and path.parts[0] not in named]
