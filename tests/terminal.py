"""``battery-calibrate`` as its users call it: files of records, arguments, and what it prints."""

import json
from pathlib import Path

import pytest

from battery_env.lab.command_line import calibrate
from battery_env.records.samples import Record
from tests.records import table_of


def write(record: Record, path: str | Path) -> str:
    """A table of a record, with the names of this package."""
    table_of(record).to_csv(path, index=False)
    return str(path)


class Terminal:
    """``battery-calibrate`` with its arguments, and what it prints."""

    def __init__(self, capsys: pytest.CaptureFixture):
        self.capsys = capsys

    def shows(self, *arguments: object, status: int = 0) -> str:
        self.capsys.readouterr()
        assert calibrate([*map(str, arguments)]) == status
        return self.capsys.readouterr().out

    def row(self, *arguments: object, status: int = 0) -> dict:
        return json.loads(self.shows(*arguments, "--json", status=status))

    def refuses(self, *arguments: object) -> str:
        self.capsys.readouterr()
        assert calibrate([*map(str, arguments)]) == 2
        captured = self.capsys.readouterr()
        *_, error = captured.err.partition("error: ")
        assert captured.out == "" and error
        return f"error: {' '.join(error.split())}"
