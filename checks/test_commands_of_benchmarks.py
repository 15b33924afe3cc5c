"""Every command of the benchmarks explains itself, and refuses with a sentence what it cannot do, before it does anything."""

from importlib import import_module
from pathlib import Path

import pytest

import benchmarks
from benchmarks import calibrators, cells

STUDIES = {"calibrators": calibrators.COMPARISONS, "cells": cells.STUDIES}
MODULES = sorted(path.stem for path in Path(benchmarks.__path__[0]).glob("*.py") if "\ndef main(" in path.read_text("utf-8"))
COMMANDS = [f"{module} {study}".strip() for module in MODULES for study in ("", *STUDIES.get(module, ()))]


def call(command, *arguments):
    """What a command ends with, which takes no time."""
    module, *words = command.split()
    with pytest.raises(SystemExit) as ended:
        import_module(f"benchmarks.{module}").main([*words, *arguments])
    return ended.value.code


def test_help_says_how_a_command_is_called(capsys):
    for command in COMMANDS:
        assert call(command, "--help") == 0
        assert f"usage: python -m benchmarks.{command}" in capsys.readouterr().out


def test_an_argument_that_there_is_not_is_refused(capsys):
    for command in COMMANDS:
        assert call(command, "--no-such-option") == 2
        assert f"python -m benchmarks.{command}: error: " in capsys.readouterr().err


def test_a_folder_that_cannot_be_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for command in (command for command in COMMANDS if command not in (*STUDIES, "demo")):
        for out in ("file", "file/below"):
            assert call(command, "--out", str(tmp_path / out)) == 2
            assert "is a file: choose another --out" in capsys.readouterr().err, command


#: What all commands say of a number that is none, by what was given, and where
REFUSED = {
    "must be at least 1, got": [
        *("compare --timesteps 0", "compare --jobs nan", "compare --jobs inf", "compare --evaluations two"),
        *("cells fit_cell --every 0", "direct_mapping --updates 0.5", "direct_mapping --pairs many", "forecasts --every 0"),
    ],
    "must be a whole number of at least 0, got": [
        *("compare --seeds -1", "outside --seeds 0.5", "direct_mapping --seeds first"),
    ],
    "must lie within 1 .. 300, got": [
        *("calibrators peers --discharges 0", "calibrators mismatch --discharges 301", "pretrained --discharges 301"),
    ],
    "invalid choice:": [
        *("calibrators everything", "direct_mapping --algos ppo", "cells real_cells --cells B0007"),
    ],
}


def test_what_a_study_cannot_use_is_refused(tmp_path, capsys):
    for words, line in [(words, line) for words, lines in REFUSED.items() for line in lines]:
        assert call(line, "--out", str(tmp_path / "out")) == 2, line
        *_, option, given = line.split()
        error = capsys.readouterr().err
        assert f"{words} {given}" in error or f"{words} '{given}'" in error
        assert not option.startswith("-") or f"argument {option}: " in error
        assert not (tmp_path / "out").exists()
