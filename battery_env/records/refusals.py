"""Why a record is refused: what is wrong with it, and what may mend it, as data of which a command is made."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

#: What a table in Python is called, as it has no path.
TABLE = "DataFrame"
# Options of a file that are repeated in a command.
_STATED = ("columns", "units", "ignore", "tester", "discharge_is_negative")


@dataclass(frozen=True)
class Advice:
    """
    What may mend a record that is refused.

    :param text: what to do, without the point at its end
    :param option: the argument of :func:`battery_env.read_discharges`, or of the settings, that does it; the command line has
        the same by its own name. Empty: no argument does
    :param value: of that argument
    :param question: what the argument answers, such as ``voltage`` for its unit. The advice is in vain where the answer is
        known. Empty: it may always help
    """

    text: str
    option: str = ""
    value: Any = None
    question: str = ""


@dataclass(frozen=True)
class Origin:
    """
    The file of a record.

    :param source: as it is named on the command line; empty: not known
    :param open_questions: which the file leaves open, so that an answer may be stated; ``None``: all
    :param stated: the options that it is read with
    """

    source: str = ""
    open_questions: frozenset[str] | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)

    def leaves_open(self, question: str) -> bool:
        """Whether an answer may be stated."""
        return not question or self.open_questions is None or question in self.open_questions

    def command(self, advice: Advice) -> str:
        """What can be pasted: of a file a command, of a table a call in Python."""
        options = {name: self.stated[name] for name in _STATED if self.stated.get(name) not in (None, (), [], {})}
        value, before = advice.value, options.get(advice.option)
        if isinstance(value, Mapping):
            value = {**(before or {}), **value}
        elif isinstance(value, list):
            value = [*(before or []), *value]
        options[advice.option] = value
        if self.source == TABLE:
            if tester := options.get("tester"):
                options["tester"] = str(tester)
            return f"read_discharges(table, {', '.join(f'{name}={each!r}' for name, each in options.items())})"
        words = [word for name, each in options.items() for word in _words(name, each)]
        return shlex.join(["battery-calibrate", self.source, *words])


def _words(option: str, value: Any) -> list[str]:
    """An option on the command line."""
    if option == "discharge_is_negative":
        return ["--discharge-is-negative" if value else "--discharge-is-positive"]
    flag = f"--{option.removesuffix('_V').replace('_', '-')}"
    if isinstance(value, Mapping):
        value = ",".join(f"{key}={each}" for key, each in value.items())
    return [word for each in (value if isinstance(value, list) else [value]) for word in (flag, str(each))]


class RecordError(ValueError):
    """
    A record is refused.

    :param problem: what is wrong, in a sentence with the value and its limit
    :param advice: what may mend it
    :param table: lines that show what was read
    :param origin: the file, whose commands are shown; ``None``: options are named alone
    """

    def __init__(
        self, problem: object, advice: Sequence[Advice] = (), table: Sequence[str] = (), origin: Origin | None = None
    ) -> None:
        super().__init__(problem, advice, table, origin)
        self.problem, self.advice, self.table, self.origin = str(problem).rstrip("."), advice, table, origin

    @classmethod
    def like(cls, error: Exception) -> RecordError:
        """An error of any kind, with its advice if it has some."""
        return error if isinstance(error, RecordError) else cls(error)

    def of(self, origin: Origin, table: Sequence[str] | None = None) -> RecordError:
        """The same with the commands of a file, and without advice on what that file tells itself."""
        advice = [each for each in self.advice if origin.leaves_open(each.question)]
        return RecordError(self.problem, advice, self.table if table is None else table, origin)

    def __str__(self) -> str:
        said = [self.problem, *(each.text for each in self.advice if not each.option)]
        options = [each for each in self.advice if each.option]
        is_known = self.origin is not None and self.origin.source
        if not is_known:
            said += [f"{each.text} (command line: {shlex.join(_words(each.option, each.value))})" for each in options]
        lines = [" ".join(f"{each}." for each in said), *self.table]
        if self.origin is not None and is_known:
            for text, alike in groupby(options, key=lambda each: each.text):
                lines += [f"{text}:", *(f"  {self.origin.command(each)}" for each in alike)]
        return "\n".join(lines)
