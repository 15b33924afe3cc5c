"""Refusals of a record: the problem, and the advice, as data from which a command is rendered."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

#: Name of a table in Python, which has no path.
TABLE = "DataFrame"
# Options of a file that are repeated in a command.
_STATED = ("columns", "units", "ignore", "tester", "discharge_is_negative")


@dataclass(frozen=True)
class Advice:
    """
    A way to mend a record that is refused.

    :param text: what to do, without a full stop
    :param option: the argument of :func:`battery_env.read_discharges`, or of the settings, that does it, also on the command
        line; empty: none
    :param value: value of the argument
    :param question: the question that the argument answers, such as ``voltage`` for its unit. The advice is omitted where the
        file answers the question; empty: never
    """

    text: str
    option: str = ""
    value: Any = None
    question: str = ""


@dataclass(frozen=True)
class Origin:
    """
    The file of a record.

    :param source: name on the command line; empty: unknown
    :param open_questions: questions that the file does not answer; ``None``: all
    :param stated: the options with which the file is read
    """

    source: str = ""
    open_questions: frozenset[str] | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)

    def leaves_open(self, question: str) -> bool:
        """Whether the file leaves a question open."""
        return not question or self.open_questions is None or question in self.open_questions

    def command(self, advice: Advice) -> str:
        """Render the command for a file, or the call in Python for a table, ready to paste."""
        options = {name: self.stated[name] for name in _STATED if self.stated.get(name) not in (None, (), [], {})}
        value, previous = advice.value, options.get(advice.option)
        if isinstance(value, Mapping):
            value = {**(previous or {}), **value}
        elif isinstance(value, list):
            value = [*(previous or []), *value]
        options[advice.option] = value
        if self.source == TABLE:
            if tester := options.get("tester"):
                options["tester"] = str(tester)
            return f"read_discharges(table, {', '.join(f'{name}={entry!r}' for name, entry in options.items())})"
        words = [word for name, entry in options.items() for word in _words(name, entry)]
        return shlex.join(["battery-calibrate", self.source, *words])


def _words(option: str, value: Any) -> list[str]:
    """Return the words of an option on the command line."""
    if option == "discharge_is_negative":
        return ["--discharge-is-negative" if value else "--discharge-is-positive"]
    flag = f"--{option.removesuffix('_V').replace('_', '-')}"
    if isinstance(value, Mapping):
        value = ",".join(f"{key}={entry}" for key, entry in value.items())
    return [word for entry in (value if isinstance(value, list) else [value]) for word in (flag, str(entry))]


class RecordError(ValueError):
    """
    A record is refused.

    :param problem: a sentence with the value and its limit
    :param advice: ways to mend it
    :param table: lines of what was read
    :param origin: the file, for the commands; ``None``: the message names options without a command
    """

    def __init__(
        self, problem: object, advice: Sequence[Advice] = (), table: Sequence[str] = (), origin: Origin | None = None
    ) -> None:
        super().__init__(problem, advice, table, origin)
        self.problem, self.advice, self.table, self.origin = str(problem).rstrip("."), advice, table, origin

    @classmethod
    def like(cls, error: Exception) -> RecordError:
        """Return an error of any kind as a :class:`RecordError`."""
        return error if isinstance(error, RecordError) else cls(error)

    def of(self, origin: Origin, table: Sequence[str] | None = None) -> RecordError:
        """Return the error of a file, without advice on questions that the file answers."""
        advice = [entry for entry in self.advice if origin.leaves_open(entry.question)]
        return RecordError(self.problem, advice, self.table if table is None else table, origin)

    def __str__(self) -> str:
        sentences = [self.problem, *(entry.text for entry in self.advice if not entry.option)]
        options = [entry for entry in self.advice if entry.option]
        has_file = self.origin is not None and self.origin.source
        if not has_file:
            sentences += [f"{entry.text} (command line: {shlex.join(_words(entry.option, entry.value))})" for entry in options]
        lines = [" ".join(f"{entry}." for entry in sentences), *self.table]
        if self.origin is not None and has_file:
            for text, same_text in groupby(options, key=lambda entry: entry.text):
                lines += [f"{text}:", *(f"  {self.origin.command(entry)}" for entry in same_text)]
        return "\n".join(lines)
