"""Files of measurements as tables: text of any delimiter, Parquet, workbooks, and the binary files of testers."""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import itertools
import lzma
import operator
import re
import warnings
import zipfile
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
import pandas as pd

from battery_env.files import check_unpacked
from battery_env.lab.readers.columns import REQUIRED, Column, FileFormat, are_units, count_required, find_columns, has

#: Endings of the names of files that can be read, besides those of NASA (.mat); of text also packed (.gz, .bz2, .xz, .zip).
#: Text of Maccor's is numbered.
TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mpt", ".dta", ".bdf")
NUMBERED_SUFFIXES = tuple(f".{number:03d}" for number in range(1000))
BINARY_SUFFIXES = (".parquet", ".nda", ".ndax", ".mpr", ".xlsx", ".xls")
PACKED_SUFFIXES = (".gz", ".bz2", ".xz", ".zip")

_OPENERS: dict[str, Callable[[Path], Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
# Testers write what they know about a test above the table: so many bytes are searched for its header.
_HEAD_BYTES = 1 << 18
_BLANKS = r"\s+"
_DELIMITERS = (",", ";", "\t", "|", _BLANKS)
_ITS_COMMA = re.compile(r"^(\s*[-+]?\d*),(?=\d)")
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d+,\d+(?:[eE][-+]?\d+)?\s*$")
_NUMBER = re.compile(r"^\s*[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?:[;\s]|$)")
_DATE, _CLOCK = re.compile(r"\d+([-./])\d+\1\d+$"), re.compile(r"\d+:\d\d")
_DECIMAL_POINT = re.compile(r"^\s*[-+]?\d*\.\d+(?:[eE][-+]?\d+)?\s*$")
# What Excel reads in the first line of a file: the delimiter.
_DELIMITER_LINE = re.compile(r"^\s*sep=([,;\t|])\s*$", flags=re.IGNORECASE)
# Some testers put lines as a whole in quotes.
_QUOTED_LINES = re.compile(rb'^"([^"\n]*)"\s*$', flags=re.MULTILINE)
# What is packed is read in parts of so many bytes, or rows.
_CHUNK_BYTES, _BATCH_ROWS = 1 << 20, 1 << 16
# A table is known by so many of its first rows.
_FIRST_ROWS = 400
# How workbooks begin; text is called .xls by some testers.
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
_EXPORT = {".res": "export the channel as CSV in MITS Pro", ".h5": "export the records as CSV"}


class _Layout(NamedTuple):
    """How a text file is laid out."""

    encoding: str
    header_line: int
    delimiter: str
    decimal: str
    names: list[str]
    layers: int  # so many columns at the left number what lies above a row, as its cycle and its step
    rows: list[list[str]]  # fields of the first lines below the header
    clock: int | None  # the column that goes on a date in the one before


def read_columns(path: Path, file_format: FileFormat) -> tuple[pd.DataFrame, dict[str, Column]]:
    """Read the columns of a record, and no others."""
    suffix = path.suffix.lower()
    if suffix in _EXPORT:
        raise ValueError(f"{suffix} files cannot be read: {_EXPORT[suffix]}")
    if suffix in (".ndax", ".xlsx", ".xls"):
        _check_archive(path)
    if suffix == ".parquet":
        return _read_parquet(path, file_format)
    if suffix in (".nda", ".ndax"):
        return columns_of(_read_neware(path), file_format)
    if suffix == ".mpr":
        return columns_of(_read_biologic(path), file_format)
    head = _content(path, _HEAD_BYTES)
    if suffix in (".xlsx", ".xls") and head.startswith(_WORKBOOKS):
        return _read_text(_sheet(path, file_format), file_format)
    is_odd = b"\n" not in head or _QUOTED_LINES.search(head)
    if not is_odd and suffix not in PACKED_SUFFIXES:
        return _read_text(path, file_format)
    content = _content(path)
    if is_odd:  # lines may end as on old computers, too
        content = _QUOTED_LINES.sub(rb"\1", content if b"\n" in head else content.replace(b"\r", b"\n"))
    return _read_text(content, file_format)


def columns_of(table: pd.DataFrame, file_format: FileFormat) -> tuple[pd.DataFrame, dict[str, Column]]:
    """The columns of a record, of a table; an index with a name is a column too."""
    table = table.reset_index(drop=table.index.names == [None])
    columns = find_columns([str(name) for name in table.columns], file_format, _first_rows(table))
    return pd.DataFrame({quantity: table.iloc[:, column.position] for quantity, column in columns.items()}), columns


def _first_rows(table: pd.DataFrame) -> list[list[str]]:
    first = table.head(_FIRST_ROWS).astype(object)
    return [[str(value) for value in row] for row in first.where(first.notna(), "").to_numpy()]


def _read_text(source: Path | bytes, file_format: FileFormat) -> tuple[pd.DataFrame, dict[str, Column]]:
    layout = _layout(source[:_HEAD_BYTES] if isinstance(source, bytes) else _content(source, _HEAD_BYTES), file_format.columns)
    columns, header_lines = find_columns(layout.names, file_format, layout.rows), layout.header_line + 1
    header_lines += bool(layout.rows) and are_units(layout.rows[0])
    # one column may serve as two quantities
    positions = sorted({*range(layout.layers), *filter(None, [layout.clock]), *(each.position for each in columns.values())})

    def read() -> pd.DataFrame:
        try:
            found = pd.read_csv(
                io.BytesIO(source) if isinstance(source, bytes) else source,
                sep=layout.delimiter,
                decimal=layout.decimal,
                encoding=layout.encoding,
                header=None,
                names=range(len(layout.names)) if layout.layers else None,
                skiprows=header_lines,
                usecols=positions,
                index_col=False,
                low_memory=False,
            )
        except pd.errors.EmptyDataError as error:
            raise ValueError("there are no rows below the header") from error
        except Exception as error:  # pandas raises whatever the damage leads it to
            raise ValueError(f"the file is damaged, or no table: {str(error).strip()}") from error
        # words among numbers make text of all, as do signs of typographers
        for column in {columns[quantity].position for quantity in ("voltage", "current") if quantity in columns}:
            found[column] = found[column].replace("\u2212", "-", regex=True)
        return found if layout.decimal == "." else found.replace(_ITS_COMMA, r"\1.", regex=True)

    try:
        table = read()
    except ValueError as error:
        if "EOF inside string" not in str(error):
            raise
        content = source if isinstance(source, bytes) else _content(source)
        kept, _, last = content.decode(layout.encoding, errors="ignore").rstrip().rpartition("\n")
        if last.count('"') % 2 == 0:
            raise
        warnings.warn("the last line is cut within quotes, and left out", stacklevel=2)
        return _read_text(kept.encode(layout.encoding), file_format)
    table = _lowest_layer(table, layout.layers)
    if layout.clock and layout.clock - 1 in table:
        date, clock = (table[place].astype("string") for place in (layout.clock - 1, layout.clock))
        table[layout.clock - 1] = date.str.cat(clock, sep=" ").astype(object)
    return pd.DataFrame({quantity: table[column.position] for quantity, column in columns.items()}), columns


def _content(path: Path, most_bytes: int | None = None) -> bytes:
    """The content of a file, or its beginning, unpacked; refused where it becomes far larger than it was."""
    parts, count = [], 0
    try:
        with _open(path) as stream:
            while part := stream.read(most_bytes or _CHUNK_BYTES):
                parts.append(part)
                count += len(part)
                if most_bytes:
                    break
                check_unpacked(path.stat().st_size, count)
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # the unpackers raise whatever the damage leads them to
        raise ValueError(f"the file is damaged: {str(error).strip() or type(error).__name__}") from error
    return b"".join(parts)


def _lowest_layer(table: pd.DataFrame, layers: int) -> pd.DataFrame:
    """The rows of which no layer above has a number, each with the numbers that were given last."""
    if not layers:
        return table
    numbers = list(range(layers))
    above = table[numbers].notna().any(axis=1)
    table[numbers] = table[numbers].ffill()
    return table[~above]


def _check_archive(path: Path) -> None:
    """Refuse a file that holds an archive of what is far larger."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_unpacked(path.stat().st_size, sum(each.file_size for each in archive.infolist()))


def _open(path: Path) -> IO[bytes]:
    suffix = path.suffix.lower()
    if suffix == ".zip":
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
        if len(names) != 1:
            raise ValueError(f"the archive must hold one file, got {len(names)}")
        return archive.open(names[0])
    return cast(IO[bytes], _OPENERS.get(suffix, open)(path, "rb"))


def _layout(head: bytes, chosen: Mapping[str, str] | None) -> _Layout:
    encoding, text = _decoded(head)
    lines = io.StringIO(text, newline=None).read().split("\n")
    delimiters: tuple[str, ...] = _DELIMITERS
    if stated := _DELIMITER_LINE.match(lines[0]):
        lines[0], delimiters = "", (stated[1],)
    number, delimiter = _header(lines, delimiters, chosen)
    rows = [_fields(line, delimiter) for line in lines[number + 1 :][:_FIRST_ROWS]]
    names, clock = _names(_fields(lines[number], delimiter, len(next(filter(None, rows), lines))), rows)
    layers = next((n for n, name in enumerate(names) if name), 0) if delimiter != _BLANKS else 0
    below = [any(row[:layers]) for row in rows if any(row)]
    if sum(below) >= 0.5 * len(below):
        layers = 0
    for n in range(layers):
        above = [fields[n] for fields in (_fields(line, delimiter) for line in lines[:number]) if any(fields[n : n + 1])]
        names[n] = above[-1] if above else ""
    values = [field for row in rows for field in row]
    commas, points = (sum(map(bool, map(mark.match, values))) for mark in (_DECIMAL_COMMA, _DECIMAL_POINT))
    return _Layout(
        encoding, number, delimiter, "," if commas > points and delimiter != _BLANKS else ".", names, layers, rows, clock
    )


def _names(names: list[str], rows: Sequence[Sequence[str]]) -> tuple[list[str], int | None]:
    """The names with an empty one where most rows have one field more, of their number or of a clock, whose column is told."""
    filled = [[*itertools.dropwhile(operator.not_, row[::-1])][::-1] for row in rows if any(row)]
    wider = [row for row in filled if len(row) > len(names)]
    if len(wider) <= 0.5 * len(filled):
        return names, None
    if all(len(row) == len(names) + 1 for row in wider):
        if [row[0] for row in wider] == [*map(str, range(1, len(wider) + 1))]:
            return ["", *names], None
        for n, fields in enumerate(itertools.pairwise(zip(*wider, strict=True)), start=1):
            if all(map(_DATE.match, fields[0])) and all(map(_CLOCK.match, fields[1])):
                return [*names[:n], "", *names[n:]], n
    if not any(_count_numbers(row[len(names) :]) for row in wider):  # remarks
        return names, None
    raise ValueError(
        f"rows have {len(wider[0])} fields below {len(names)} names, which does not tell what is what: name each column, and "
        "take another delimiter than the decimal comma"
    )


def _header(lines: Sequence[str], delimiters: Sequence[str], chosen: Mapping[str, str] | None) -> tuple[int, str]:
    """The line with the names of the columns, and the delimiter."""
    filled = [number for number, line in enumerate(lines) if line.strip()]
    if not filled:
        raise ValueError("the file is empty")
    best: dict[tuple[str, ...], tuple[int, str]] = {}
    found = 1
    for number, below in itertools.pairwise([*filled, filled[-1]]):
        for delimiter in delimiters:
            most = len(_fields(lines[below], delimiter)) if delimiter == _BLANKS else np.inf
            names = _fields(lines[number], delimiter, most)
            has_numbers = _count_numbers(names) > 0
            # blanks within names, or in a sentence
            if (delimiter == _BLANKS and len(names) > most) or (
                has_numbers and (delimiter == _BLANKS or found == len(REQUIRED))
            ):
                continue
            count = count_required(names, chosen)
            if count > found:
                best, found = {}, count
            if count == found and (not best or not has_numbers):
                best.setdefault(tuple(filter(None, names)), (number, delimiter))
            if found == len(REQUIRED):
                delimiters = (delimiter,)
                break
    if best:
        first, *others = best.values()
        header = max([first, *others], key=lambda each: _fit(lines, *each)) if others else first
        if header != first:
            warnings.warn(f"the header is line {header[0] + 1}; the table of line {first[0] + 1} is left out", stacklevel=2)
        return header
    # names come apart as often as the first numbers below them
    for above, number in itertools.pairwise([-1, *filled]):
        apart = [each for each in delimiters if _count_numbers(_fields(lines[number], each)) > 1]
        alike = [
            each for each in apart if above >= 0 and len(_fields(lines[above], each)) == len(_fields(lines[number], each))
        ]
        if alike:
            return above, alike[0]
        if apart:
            raise ValueError("there is no line with the names of the columns above the numbers. Add one")
    return filled[0], delimiters[0]


def _fit(lines: Sequence[str], number: int, delimiter: str) -> int:
    """How well the lines below a header hold numbers in as many fields as it has names; a delimiter may end each."""
    rows = [_fields(line, delimiter) for line in lines[number + 1 :]]
    width = len(_fields(lines[number], delimiter, max(map(len, rows), default=0)))
    filled = [len([*filter(None, row)]) if _count_numbers(row) > 1 else -1 for row in rows]
    return sum(2 * (count >= 0 and len(row) == width) or count == width for row, count in zip(rows, filled, strict=True))


def _count_numbers(fields: Sequence[str]) -> int:
    return sum(bool(_NUMBER.match(field) or _DECIMAL_COMMA.match(field)) for field in fields)


def _decoded(head: bytes) -> tuple[str, str]:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if head.startswith(mark):
            return encoding, head.decode(encoding, errors="ignore")
    if b"\0" in head:
        raise ValueError("the file is binary, and its ending is none of those that can be read")
    try:
        # the head may end within a character
        return "utf-8", getincrementaldecoder("utf-8")().decode(head, final=len(head) < _HEAD_BYTES)
    except UnicodeDecodeError:
        encoding = "gb18030" if "电压".encode("gb18030") in head else "latin-1"
        return encoding, head.decode(encoding, errors="ignore")


def _fields(line: str, delimiter: str, most: float = np.inf) -> list[str]:
    # numpy writes a header as a comment
    line = line.lstrip("# ")
    if delimiter == _BLANKS:  # of which two or more part names of several words
        return fields if len(fields := line.replace('"', " ").split()) <= most else re.split(r"\s{2,}", line.strip())
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


@contextmanager
def _reading(kind: str, extra: str) -> Iterator[None]:
    """Of what others read: their own warnings are not passed on, and what is missing, or not as it should be, is named."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except FileNotFoundError:
        raise
    except ImportError as error:
        raise ImportError(f"{kind} files need an extra: pip install 'battery_env[{extra}]' ({error})") from error
    except NotImplementedError as error:
        raise ValueError(f"what reads {kind} files does not know all of this one: {error}") from error
    except Exception as error:  # whatever the damage leads to
        raise ValueError(f"the file is damaged, or no {kind} file: {str(error).strip()}") from error


def _sheet(path: Path, file_format: FileFormat) -> bytes:
    """The sheet of a workbook that holds the record, and those that continue it, as text."""
    with _reading("Excel", "excel"):
        sheets = pd.read_excel(path, sheet_name=None, header=None, dtype=object)
    found = []
    for sheet in sheets.values():
        head = [[str(name) for name in row] for row in sheet.head(_FIRST_ROWS).to_numpy()]
        known = [count_required(names, file_format.columns) for names in head] or [0]
        line = int(np.argmax(known))
        found.append((known[line], len(sheet), head[line : line + 1], line, sheet))
    names = max(found, key=lambda each: each[:2])[2]
    (top, first), *others = [(line, sheet) for *_, each, line, sheet in found if each == names]
    parts, header = [first, *(sheet.iloc[line + 1 :] for line, sheet in others)], [name for row in names for name in row]
    if others and not has("cycle", header):  # each may be a test of its own
        parts = [part.assign(cycle=str(number)) for number, part in enumerate(parts, start=1)]
        parts[0].iloc[top, -1] = "Cycle"
    elif others and not has("cell", header):  # each whose clock and cycles do not go on is a cell of its own
        columns = find_columns(header, file_format, ())
        places = [columns[each].position for each in ("time", "cycle") if each in columns]
        counts = [part.iloc[:, places].apply(pd.to_numeric, errors="coerce").dropna() for part in parts]
        if all(len(each) and each.iloc[:, 0].is_monotonic_increasing for each in counts):
            anew = [True, *((after.iloc[0] <= before.iloc[-1]).all() for before, after in itertools.pairwise(counts))]
            titles = pd.Series([title for title, each in zip(sheets, found, strict=True) if each[2] == names])
            cells = titles.where(pd.Series(anew)).ffill()
            parts = [part.assign(cell=cell) for part, cell in zip(parts, cells, strict=True)]
            parts[0].iloc[top, -1] = "Cell"
    return pd.concat(parts).to_csv(header=False, index=False).encode()


def _read_parquet(path: Path, file_format: FileFormat) -> tuple[pd.DataFrame, dict[str, Column]]:
    with _reading("Parquet", "parquet"):
        from pyarrow import parquet

        file = parquet.ParquetFile(path)
    with file:
        first = [batch.to_pandas() for batch in itertools.islice(file.iter_batches(_FIRST_ROWS), 1)]
        columns = find_columns(file.schema_arrow.names, file_format, _first_rows(first[0]) if first else ())
        # the metadata of pandas would make an index of a column
        table = _read_batches(file, path.stat().st_size, sorted({column.name for column in columns.values()}))
    return pd.DataFrame({quantity: table[column.name] for quantity, column in columns.items()}), columns


def _read_batches(file: Any, packed_bytes: int, names: list[str]) -> pd.DataFrame:
    from pyarrow import Table

    batches, count = [], 0
    try:
        for batch in file.iter_batches(_BATCH_ROWS, columns=names):
            count += batch.nbytes
            check_unpacked(packed_bytes, count)
            batches.append(batch)
    except OSError as error:  # what pyarrow calls damage
        raise ValueError(f"the file is damaged: {str(error).strip()}") from error
    return Table.from_batches(batches, batches[0].schema if batches else file.schema_arrow).to_pandas(ignore_metadata=True)


def _read_neware(path: Path) -> pd.DataFrame:
    with path.open("rb"), _reading("Neware", "cyclers"):
        import NewareNDA

        return NewareNDA.read(str(path), log_level="ERROR")


def _read_biologic(path: Path) -> pd.DataFrame:
    with path.open("rb") as stream, _reading("BioLogic", "cyclers"):
        from galvani.BioLogic import MPRfile

        return pd.DataFrame(MPRfile(stream).data)


def is_readable(path: Path, more: Sequence[str] = ()) -> bool:
    """Whether the name of a file ends as that of a record may."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes and suffixes[-1] in PACKED_SUFFIXES:
        return len(suffixes) > 1 and suffixes[-2] in TEXT_SUFFIXES
    return bool(suffixes) and suffixes[-1] in (*TEXT_SUFFIXES, *NUMBERED_SUFFIXES, *BINARY_SUFFIXES, *more)
