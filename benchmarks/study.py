"""
What all studies share: a command line, parts that run side by side and are never done twice, files that say what made them,
and numbers as readers see them. A study itself keeps its configuration, the function that makes one part, and its figures.
"""

from __future__ import annotations

import argparse
import gzip
import importlib
import inspect
import json
import os
import platform
import secrets
import shlex
import sys
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from functools import partial
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

import battery_env
import sb3_lac
from battery_env.evaluation import over_seeds
from battery_env.files import check_folder, replacing
from battery_env.lab.batch import interruptible, workers
from battery_env.plotting import new_figure, save_figure

Result = TypeVar("Result")
#: What a part makes: tables by name.
Tables = Mapping[str, pd.DataFrame]

#: How readers know the parameters.
SYMBOLS = {"q_mobile": "q_max", "r_o": "R_o"}
#: Seed of evaluations; no training seed comes close.
EVALUATION_SEED = 10_000
#: Larger tables are packed with gzip.
LARGEST_PLAIN_TABLE_BYTES = 100_000

_PACKAGES = (
    *("torch", "stable_baselines3", "sb3_contrib", "gymnasium", "mujoco"),
    *("numpy", "numba", "scipy", "pandas", "rl_zoo3", "progpy"),
)


def own_versions() -> dict[str, str]:
    """The versions of the packages of this project."""
    return {"sb3_lac": sb3_lac.__version__, "battery_env": battery_env.__version__}


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    by_package = {
        **own_versions(),
        "python": platform.python_version(),
        "system": platform.platform(),
        "processor": platform.machine(),
    }
    for package in _PACKAGES:
        try:
            by_package[package] = version(package)
        except PackageNotFoundError:
            continue
    return by_package


def write_text(path: Path, text: str) -> None:
    """Write a file beside its place and rename it, so that it is never there in part."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file; what is no JSON is written as text."""
    write_text(path, json.dumps(content, indent=2, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else str(value)


def table_file(folder: Path, name: str) -> Path:
    """The file of a table, ``NAME.csv.gz`` if that is there and ``NAME.csv`` otherwise; ``pandas.read_csv`` reads both."""
    packed = folder / f"{name}.csv.gz"
    return packed if packed.exists() else folder / f"{name}.csv"


def read_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """All tables of a folder, by name."""
    names = sorted({path.name.partition(".csv")[0] for path in folder.glob("*.csv*")})
    return {name: pd.read_csv(table_file(folder, name)) for name in names}


def write_csv(folder: Path, name: str, text: str) -> None:
    """Write the text of a table in place of what it was before: packed if it is large, with equal bytes for equal text."""
    packed, plain = folder / f"{name}.csv.gz", folder / f"{name}.csv"
    content = text.encode()
    file, other = (packed, plain) if len(content) > LARGEST_PLAIN_TABLE_BYTES else (plain, packed)
    with replacing(file) as part, part.open("wb") as stream:
        if file is packed:
            with gzip.GzipFile("", "wb", fileobj=stream, mtime=0) as compressed:
                compressed.write(content)
        else:
            stream.write(content)
    other.unlink(missing_ok=True)


def digest_of(content: Mapping[str, Any]) -> str:
    """A short name for what something was made from."""
    return sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:8]


def new_panels(
    n: int,
    most_columns: int,
    panel: tuple[float, float],
    margin: tuple[float, float] = (0.0, 0.0),
) -> tuple[Figure, list[Axes]]:
    """A figure of panels in rows."""
    n_columns = min(n, most_columns)
    n_rows = -(-n // n_columns)
    figure = new_figure(margin[0] + panel[0] * n_columns, margin[1] + panel[1] * n_rows)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel().tolist()
    for axes in panels[n:]:
        axes.remove()
    return figure, panels[:n]


def add_legend(figure: Figure, panels: Iterable[Axes], columns: int, order: Iterable[str] | None = None) -> None:
    """A legend below all panels, with one entry for each name that any of them has."""
    handles = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    labels = list(handles) if order is None else [name for name in order if name in handles]
    entries = [handles[name] for name in labels]
    figure.legend(entries, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def digits(value: float, significant: int = 2) -> str:
    """A number as readers see it: rounded, and never in powers of ten because it is large."""
    if not np.isfinite(value):
        return "-" if np.isnan(value) else "never"
    return f"{value:.{significant}g}" if abs(value) < 10**significant - 0.5 else f"{value:.0f}"


def duration(seconds: float) -> str:
    """A short time as readers see it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{digits(seconds / size)} {unit}"
    return f"{digits(seconds / 1e-6)} µs"


def with_spread(values: pd.Series) -> str:
    """Mean and standard deviation over seeds."""
    return digits(values.mean()) + (f" ± {digits(values.std(), 1)}" if len(values) > 1 else "")


def with_interval(values: pd.Series) -> str:
    """Interquartile mean over seeds, with the 95 % interval of a bootstrap."""
    middle, low, high = (digits(float(value)) for value in over_seeds(values))
    return middle if len(values) == 1 else f"{middle} [{low}, {high}]"


def share_with_range(values: pd.Series) -> str:
    """Mean over seeds of a share, with the least and the most of a seed."""
    percent = 100 * values
    spread = f" ({percent.min():.0f} to {percent.max():.0f})" if len(values) > 1 else ""
    return f"{percent.mean():.0f} %{spread}"


def share_in_percent(values: pd.Series) -> str:
    """Share that is true, in percent."""
    return f"{100 * values.mean():.0f}"


def count_of(values: pd.Series) -> str:
    """Number of a few that are true."""
    return f"{values.sum()} of {len(values)}"


def side_by_side(values: Iterable[float]) -> str:
    """Each of a few numbers."""
    return " / ".join(digits(value) for value in values)


def markdown(rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> str:
    """A table for readers."""
    return pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True) + "\n"


#: What a cell says of rows of results, or of one of their columns.
Cell = tuple[str, Callable[[Any], Any]] | Callable[[Any], Any]


def table_of(rows: pd.DataFrame, by: Sequence[str] | Mapping[str, str], cells: Mapping[str, Cell]) -> pd.DataFrame:
    """Tabulate groups of rows, by columns and what readers call them where that is another name, one row a group."""

    def said_of(group: pd.DataFrame, cell: Cell) -> Any:
        return cell[1](group[cell[0]]) if isinstance(cell, tuple) else cell(group)

    titles = by if isinstance(by, Mapping) else dict(zip(by, by, strict=True))
    return pd.DataFrame(
        [
            dict(zip(titles.values(), keys, strict=True)) | {title: said_of(group, cell) for title, cell in cells.items()}
            for keys, group in rows.groupby(list(titles), sort=False, dropna=False)
        ]
    )


def of_trained(cell: Callable[[pd.DataFrame], str]) -> Callable[[pd.DataFrame], str]:
    """A cell that says nothing of rows without a seed, as of a calibrator or a controller that nobody trained."""
    return lambda group: "" if group["seed"].isna().all() else cell(group)


def natural(text: str) -> int:
    """A type of arguments of the command line, as of seeds."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 0, got {text}")
    return int(text)


def positive(text: str) -> int:
    """A type of arguments of the command line."""
    try:
        number = int(float(text))
    except (ValueError, OverflowError):
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return number


def at_most(most: int) -> Callable[[str], int]:
    """A type of arguments of the command line, as of discharges that are held out."""

    def number(text: str) -> int:
        if not text.isdecimal() or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"must lie within 1 .. {most}, got {text}")
        return int(text)

    return number


def run_named(
    module: str, document: str | None, studies: Mapping[str, Callable[[Sequence[str]], None]], arguments: Sequence[str] | None
) -> None:
    """Run the study of a module that the first argument names, with the other arguments."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{module}", description=document, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=studies, help="with --help: what it can be told")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="of the study")
    chosen = parser.parse_args(arguments)
    studies[chosen.study](chosen.options)


def command_line(name: str, document: str | None, jobs: int | None = 2) -> argparse.ArgumentParser:
    """Make the command line of a study by the name of its module (and its own), with the options that all have in common."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}", description=document, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if jobs is not None:
        jobs = min(jobs, os.cpu_count() or 1)
        parser.add_argument("--jobs", type=positive, default=jobs, help="parts at the same time, one core each")
        parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster that makes the parts, tcp://host:port")
        parser.add_argument("--redraw", action="store_true", help="figures and text once more, from the tables in --out")
    parser.add_argument("--out", type=Path, default=Path("results") / name.split()[-1], help="folder of all results")
    return parser


class Study:
    """One call of a study: what was chosen, its parts, its files."""

    def __init__(self, parser: argparse.ArgumentParser, arguments: Sequence[str] | None = None) -> None:
        words = sys.argv[1:] if arguments is None else list(arguments)
        self.chosen = parser.parse_args(words)
        for name, value in vars(self.chosen).items():
            if isinstance(value, list):  # a seed that is named twice is one seed
                setattr(self.chosen, name, list(dict.fromkeys(value)))
        self.command = f"{parser.prog} {shlex.join(words)}".strip()
        self.name = parser.prog.replace(".", " ").split()[-1]
        self.out: Path = self.chosen.out
        try:
            check_folder(self.out)
        except OSError as error:
            parser.error(str(error))
        self.scheduler: str | None = vars(self.chosen).get("scheduler")
        self.redraws: bool = vars(self.chosen).get("redraw", False)
        # what results depend on, written beside them: not where and how parts are made
        self.configuration: dict[str, Any] = {
            name: value for name, value in vars(self.chosen).items() if name not in ("jobs", "scheduler", "redraw", "out")
        }
        if self.scheduler is not None:
            self.out = self.out.absolute()  # workers are elsewhere
            try:
                with workers(1, self.scheduler):
                    pass
            except (ImportError, OSError) as error:
                parser.error(str(error))

    def run(self, part: Callable[..., Tables], parts: Sequence[Mapping[str, Any]], **places: Any) -> dict[str, pd.DataFrame]:
        """Make all parts that have no file in ``<out>/parts``; to redraw none, as the tables are those that are written."""
        if self.redraws:
            written = read_tables(self.out)
            # a text that is empty comes back as one
            texts = {name: table.select_dtypes(exclude=["number", "bool"]).columns for name, table in written.items()}
            return {name: table.fillna(dict.fromkeys(texts[name], "")) for name, table in written.items()}
        files = [self._file_of(part, arguments) for arguments in parts]
        missing = {file: dict(arguments) for file, arguments in zip(files, parts, strict=True) if recall(file) is None}
        where = list(missing)
        runs = [(partial(importable(part), **places), arguments) for arguments in missing.values()]
        self.each(_make, runs, lambda number, content: write_json(where[number], content))
        made_tables = [_tables_of(recall(file)) for file in files]
        names = dict.fromkeys(name for tables in made_tables for name in tables)
        return {
            name: pd.concat([tables[name] for tables in made_tables if name in tables], ignore_index=True) for name in names
        }

    def done(self, part: Callable[..., Tables]) -> list[tuple[dict[str, Any], Tables]]:
        """The arguments and the tables of all parts that lie in ``<out>/parts``, whichever command made them."""
        records = {file: recall(file) for file in sorted((self.out / "parts").glob(f"{part.__name__}_*.json"))}
        return [
            (content["arguments"], _tables_of(content))
            for file, content in records.items()
            if content and file == self._file_of(part, content["arguments"])  # not of another version
        ]

    def _file_of(self, part: Callable[..., Tables], arguments: Mapping[str, Any]) -> Path:
        """The file that stands for a part: for its arguments, the module of its function, and this project's versions."""
        module = Path(inspect.getfile(part)).read_text(encoding="utf-8")
        made_from = {"part": part.__name__, "arguments": arguments, "module": module, "versions": own_versions()}
        return self.out / "parts" / f"{part.__name__}_{digest_of(made_from)}.json"

    def each(
        self,
        function: Callable[..., Result],
        runs: Sequence[tuple[Any, ...]],
        keep: Callable[[int, Result], None] | None = None,
    ) -> list[Result]:
        """Call a function with each of several arguments; an error is raised when all others are done."""
        results: dict[int, Result] = {}
        errors = []
        goes_on = f"what is done lies in {self.out}, and the same command goes on from there."
        try:
            with interruptible(), closing(self._calls(function, runs)) as calls:
                for number, result in tqdm(calls, desc="parts", total=len(runs), disable=None):
                    try:
                        results[number] = result()
                        if keep is not None:
                            keep(number, results[number])
                    except Exception as error:
                        tqdm.write(f"part {number + 1} of {len(runs)} failed: {error!r}", file=sys.stderr)
                        errors.append(error)
        except KeyboardInterrupt:
            sys.exit(f"\nInterrupted; {goes_on}")
        if errors:
            print(f"{len(errors)} of {len(runs)} parts failed; {goes_on}", file=sys.stderr)
            raise errors[0]
        return [results[number] for number in range(len(runs))]

    def _calls(
        self, function: Callable[..., Result], runs: Sequence[tuple[Any, ...]]
    ) -> Generator[tuple[int, Callable[[], Result]]]:
        """The number of each run with what gives its result: on the cluster, in processes, or in this one if one at a time."""
        if self.scheduler is None and self.chosen.jobs == 1:
            yield from ((number, partial(function, *run)) for number, run in enumerate(runs))
        elif runs:
            with workers(self.chosen.jobs, self.scheduler) as executor:
                started = {executor.submit(importable(function), *run): number for number, run in enumerate(runs)}
                for future in as_completed(started):
                    yield started[future], future.result

    def write_table(self, name: str, table: pd.DataFrame, configuration: Mapping[str, Any] | None = None) -> None:
        """Write a table, and beside it as JSON what made it: command, configuration, versions."""
        configuration = self.configuration if configuration is None else configuration
        write_json(
            self.out / f"{name}.json", {"command": self.command, "configuration": configuration, "versions": versions()}
        )
        write_csv(self.out, name, table.to_csv(index=False, float_format="%.6g"))

    def write(self, tables: Tables, figures: Mapping[str, Figure], text: str, name: str | None = None) -> None:
        """Write what came out, and show the text."""
        for table_name, table in tables.items() if not self.redraws else ():
            self.write_table(table_name, table)
        for figure_name, figure in figures.items():
            save_figure(figure, self.out / f"{figure_name}.png")
        write_text(self.out / f"{name or self.name}.md", text)
        sys.stdout.write("\n" + text)


def importable(function: Callable[..., Result]) -> Callable[..., Result]:
    """The function of its module instead of that of the program, which is all that ``python -m`` makes of the module."""
    program = sys.modules["__main__"].__spec__
    if function.__module__ != "__main__" or program is None:
        return function
    return getattr(importlib.import_module(program.name), function.__name__)


def recall(file: Path) -> dict[str, Any] | None:
    """Read the file that is written last of something that is done; None if there is none, or a damaged one, set aside."""
    if not file.exists():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return {**content, "versions": content["versions"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        damaged = file.replace(file.with_name(f"{file.name}.{secrets.token_hex(4)}.damaged"))
        print(f"{file} is damaged ({error!r}): it is kept as {damaged.name}, and made again", file=sys.stderr)
        return None


def _tables_of(content: Mapping[str, Any] | None) -> dict[str, pd.DataFrame]:
    assert content is not None
    return {name: pd.DataFrame(table) for name, table in content["tables"].items()}


def _make(part: Callable[..., Tables], arguments: dict[str, Any]) -> dict[str, Any]:
    # floats in JSON are exact, and NaN and infinity are themselves
    tables = {name: table.to_dict("list") for name, table in part(**arguments).items()}
    return {"arguments": arguments, "versions": versions(), "tables": tables}
