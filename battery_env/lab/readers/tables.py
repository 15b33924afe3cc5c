"""Files of measurements as tables: text of any delimiter, Parquet, workbooks, and the binary files of testers."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
import zipfile
import zlib
from codecs import getincrementaldecoder
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar, cast

import numpy as np
import pandas as pd

from battery_env.files import LARGEST_UNPACKED_BYTES, kind_of
from battery_env.lab.readers.columns import FileFormat, TableHeader, are_units, count_required, notify
from battery_env.lab.readers.testers import ENCODINGS, REQUIRED
from battery_env.records.refusals import Advice, RecordError

Key = TypeVar("Key")

#: Suffixes of readable files, besides NASA's .mat; packed text (.gz, .zip) is readable too. Maccor's text has numbered
#: suffixes, and some testers name text .xls.
TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mpt", ".dta", ".bdf", ".xls")
NUMBERED_SUFFIXES = tuple(f".{number:03d}" for number in range(1000))
BINARY_SUFFIXES = (".parquet", ".nda", ".ndax", ".mpr", ".xlsx")
PACKED_SUFFIXES = (".gz", ".zip")

# Testers write notes on a test above its table: limits of the search for the header, in lines, and in bytes a line. Number of
# first rows that identify a table.
_HEAD_LINES, _LINE_BYTES, _FIRST_ROWS = 2000, 128, 400
# Limits that keep the memory below 1 GB: rows, or in a large file least bytes a row, and columns.
_MOST_ROWS, _LEAST_ROW_BYTES, _MOST_COLUMNS = 3_000_000, 20, 2000
_BLANKS = r"\s+"
_DELIMITERS = (",", ";", "\t", "|", _BLANKS)
_NUMBER = re.compile(r"[-+]?[\d.,]*\d[.,]?(?:[eE][-+]?\d+)?$")
_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d*),(?=\d)")


class TooLargeError(ValueError):
    """A file, or its unpacked content, exceeds a limit."""


class OpenTable(NamedTuple):
    """A table whose header and first rows are read."""

    names: list[str]
    rows: list[list[str]]
    read: Callable[[TableHeader], pd.DataFrame]  # reads the recognised columns, by quantity


def open_file(path: Path, file_format: FileFormat) -> OpenTable:
    """Read the beginning of a file."""
    suffix = path.suffix.lower()
    if suffix in (".ndax", ".xlsx"):
        _check_archive(path)
    if suffix == ".parquet":
        return open_frame(_read_parquet(path))
    if suffix in (".nda", ".ndax", ".mpr"):
        return open_frame(_read_biologic(path) if suffix == ".mpr" else _read_neware(path))
    if suffix == ".xlsx":
        return open_frame(_read_workbook(path, file_format))
    return _open_text(_text_of(path), file_format)


def open_frame(table: pd.DataFrame) -> OpenTable:
    """Return a DataFrame as a table; an index with a name is a column too."""
    table = table.reset_index(drop=table.index.names == [None])

    def read(header: TableHeader) -> pd.DataFrame:
        return pd.DataFrame({key: table.iloc[:, column.position] for key, column in header.columns.items()})

    beginning = table.head(_FIRST_ROWS).astype(object)
    rows = [[str(value) for value in row] for row in beginning.where(beginning.notna(), "").to_numpy()]
    return OpenTable([str(name) for name in table.columns], rows, read)


def _check(count: int, limit: int, unit: str) -> None:
    if count > limit:
        raise TooLargeError(f"{count} {unit} are more than the {limit} that are read: cut it in parts, or unpack it by hand")


def _check_rows(count: int, size: int) -> None:
    _check(count, max(_MOST_ROWS, size // _LEAST_ROW_BYTES), "rows")


def _check_unpacked(count: int) -> None:
    _check(count, LARGEST_UNPACKED_BYTES, "bytes unpacked")


def _content(path: Path) -> bytes:
    """Return the unpacked content of a file."""
    chunks, count, lines = [], 0, 0
    with _reading("packed text"), _open(path) as stream:
        while chunk := stream.read(1 << 20):
            chunks.append(chunk)
            count += len(chunk)
            lines += max(chunk.count(b"\n"), chunk.count(b"\r"))  # old computers end lines with \r
            _check_rows(lines, count)
            if path.suffix.lower() in PACKED_SUFFIXES:
                _check_unpacked(count)
    return b"".join(chunks)


def _open(path: Path) -> IO[bytes]:
    if path.suffix.lower() == ".zip":
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
        if len(names) != 1:
            raise ValueError(f"the archive must hold one file, got {len(names)}")
        return archive.open(names[0])
    return cast(IO[bytes], gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb"))


def _check_archive(path: Path) -> None:
    """Refuse an archive with a far larger content, by the sizes in its directory."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            # each cell keeps a copy of a shared text
            sizes = [entry.file_size * (8 if "sharedStrings" in entry.filename else 1) for entry in archive.infolist()]
        _check_unpacked(sum(sizes))


def check_mat(path: Path) -> None:
    """Refuse a MATLAB file whose packed variables are far larger, before reading them."""
    count = 0
    with path.open("rb") as stream:
        stream.seek(128)
        while len(tag := stream.read(8)) == 8:
            kind, size = np.frombuffer(tag, dtype="<u4").tolist()
            end = stream.tell() + size
            unpacker = zlib.decompressobj()
            while kind == 15 and stream.tell() < end and (chunk := stream.read(min(1 << 14, end - stream.tell()))):
                try:
                    count += len(unpacker.decompress(chunk))
                except zlib.error:
                    return  # the reader refuses it
                _check_unpacked(8 * count)  # a number of one byte takes eight in memory
            stream.seek(end)


def _text_of(path: Path) -> bytes:
    """Return the text of a file without bytes that are no characters."""
    content = _content(path)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", errors="ignore").encode()
    text = content.rstrip(b"\0")  # a power cut may leave NUL bytes at the end
    if kind := kind_of(content) or "binary" * (10 * text.count(b"\0") > len(text)):
        raise RecordError(f"the file is {kind}, and no table", [Advice("Export the records as CSV, a workbook as .xlsx")])
    text = text.replace(b"\0", b"")
    if len(text) < len(content):
        notify(f"{len(content) - len(text)} NUL bytes, which are no text, are left out")
    return text.replace("\u2212".encode(), b"-")  # the typographic minus sign


def _open_text(content: bytes, file_format: FileFormat) -> OpenTable:
    """Read text in UTF-8, or in the encoding in which its beginning has the names of a record."""
    stated_encoding = file_format.tester and file_format.tester.encoding
    tables: dict[tuple[str, str], list[list[str]]] = {}
    for encoding in [stated_encoding] if stated_encoding else ["utf-8", *ENCODINGS]:
        try:
            # the head may cut a character
            head = getincrementaldecoder(encoding)().decode(content[: _HEAD_LINES * _LINE_BYTES], final=False)
        except (LookupError, UnicodeDecodeError) as error:
            if stated_encoding:
                raise ValueError(f"the file is no text in {stated_encoding}: {error}") from error
            continue
        lines = io.StringIO(head.removeprefix("\ufeff"), newline=None).read().split("\n")[: _HEAD_LINES + _FIRST_ROWS]
        tables |= {(encoding, delimiter): [_fields(line, delimiter) for line in lines] for delimiter in _DELIMITERS}
        if encoding == "utf-8":
            break
    (encoding, delimiter), number, names = _find_header(tables, file_format)
    lines_below = tables[encoding, delimiter][number + 1 : number + 1 + _FIRST_ROWS]
    rows = [*map(_strip_empty, lines_below)]
    _check(len(names), _MOST_COLUMNS, "columns")
    has_units = bool(rows) and are_units(rows[0])
    values = [row for row in rows[has_units:] if row]
    if not values:
        raise ValueError("there are no rows below the header")
    if not names[0] and 0 < 2 * sum(row[0] != "" for row in values) < len(values):
        raise ValueError("rows of cycles, steps and records are in one table: export the records alone")
    # a name may hold blanks
    widths = [len(row) for row in values if len(row) > len(names) or (len(row) < len(names) and delimiter == _BLANKS)]
    if 2 * len(widths) > len(values):
        raise ValueError(
            f"rows have {widths[0]} fields below {len(names)} names, which does not tell what is what: name each column, and "
            "take another delimiter than the decimal comma, or than the blanks in names"
        )
    width = max(map(len, lines_below[has_units:]))
    if names[width:]:
        notify(f"the header is longer than the rows: {', '.join(names[width:])} left out")
    numbers = [field for row in values for field in row if _NUMBER.match(field)]
    options: dict[str, Any] = {
        "sep": delimiter,
        "decimal": "," if 2 * sum("," in field for field in numbers) > len(numbers) else ".",
        "encoding": encoding,
        "skiprows": number + 1 + has_units,
        "names": range(width),
    }
    return OpenTable(names[:width], rows, lambda header: _read_text(content, options, header))


def _read_text(content: bytes, options: dict[str, Any], header: TableHeader) -> pd.DataFrame:
    positions = sorted({column.position for column in header.columns.values()})  # one column may serve two quantities
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pandas warns of columns that are partly text, which is checked later
            table = pd.read_csv(
                io.BytesIO(content),
                encoding_errors="replace",  # in remarks; numbers are checked later
                header=None,
                usecols=[n for n in positions if n in options["names"]],
                index_col=False,
                na_values=[*header.tester.missing],
                **options,
            )
    except Exception as error:  # pandas raises errors of many types
        raise RecordError(f"the file is damaged, or no table: {str(error).strip()}") from error
    table = table.reindex(columns=positions)
    if options["decimal"] == ",":  # a column with words is text
        table = table.replace(_DECIMAL_COMMA, r"\1.", regex=True)
    return pd.DataFrame({key: table[column.position] for key, column in header.columns.items()})


def _find_header(tables: Mapping[Key, Sequence[Sequence[str]]], file_format: FileFormat) -> tuple[Key, int, list[str]]:
    """Return the table with the header, by delimiter or by sheet, the row of the header, and the names in it."""
    # the header is above rows of numbers in equally many fields, or, if it names a whole record, in fewer fields, and names
    # most quantities; without a header the names are numbers of columns
    candidates: dict[tuple[str, ...], tuple[bool, int, int, int, Key]] = {}  # by names, which may repeat
    largest_count, first, number_table = 0, 0, next(iter(tables))
    for key, rows in tables.items():
        counts = np.array([sum(bool(_NUMBER.match(field)) for field in row) for row in rows], dtype=np.int64)
        are_numbers = counts > 1
        # each row may end with a delimiter
        widths = np.array([(len(row), len(_strip_empty(row))) for row in rows]).reshape(-1, 2)
        if (count := int(counts[are_numbers].sum())) > largest_count:
            usual_width = np.bincount(widths[are_numbers, 1]).argmax()  # a title may hold numbers, too
            largest_count, first, number_table = count, int((are_numbers & (widths[:, 1] == usual_width)).argmax()), key
        for n, row in enumerate(rows[:_HEAD_LINES]):
            if any(row) and not counts[n]:
                below, quantities = slice(n + 1, n + 1 + _FIRST_ROWS), count_required(row, file_format)
                fit_count = int(((widths[below] == widths[n]).any(axis=1) & are_numbers[below]).sum())
                is_longer = quantities == len(REQUIRED) and bool((widths[below] < widths[n]).all(axis=1) @ are_numbers[below])
                candidates.setdefault(tuple(_strip_empty(row)), (fit_count > 0 or is_longer, quantities, fit_count, n, key))
    if not candidates and not largest_count:
        raise ValueError("the file is empty")
    best = max(candidates.values(), key=lambda candidate: candidate[:4], default=(False, 0, 0, 0, number_table))
    is_header, quantities, _, number, key = best
    if largest_count and not is_header and quantities < len(REQUIRED):
        if not (file_format.columns or file_format.tester):
            notify("no line names the columns: state places, --columns time=1,voltage=2,current=3 (and --units current=0.01A)")
        width = max(len(_strip_empty(row)) for row in tables[number_table][first:])
        return number_table, first - 1, [str(n + 1) for n in range(width)]
    first = next(candidate[3] for candidate in candidates.values() if candidate[:2] == best[:2])
    if quantities and first != number:
        notify(f"the header is line {number + 1}; the table of line {first + 1} is left out")
    return key, number, _strip_empty(tables[key][number])


def _fields(line: str, delimiter: str) -> list[str]:
    line = line.lstrip("# ")  # numpy writes a header as a comment
    try:
        fields = line.split() if delimiter == _BLANKS else next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return []
    return [field.strip().strip('"') for field in fields]


def _strip_empty(fields: Sequence[str]) -> list[str]:
    """Return the fields without empty ones at the end."""
    length = max((n for n, field in enumerate(fields, start=1) if field), default=0)
    return list(fields[:length])


@contextmanager
def _reading(kind: str, extra: str = "") -> Iterator[None]:
    """Run a reader of another package without its warnings, and name a missing extra or damage in its errors."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (FileNotFoundError, IsADirectoryError, PermissionError, TooLargeError):
        raise
    except ImportError as error:
        raise ImportError(f"{kind} files need an extra: pip install './battery_env[{extra}]' ({error})") from error
    except Exception as error:  # the packages raise errors of many types
        raise ValueError(f"the file is damaged, or no {kind} file: {str(error).strip() or type(error).__name__}") from error


def _read_workbook(path: Path, file_format: FileFormat) -> pd.DataFrame:
    """Read the sheet of a workbook with the record, and the sheets that continue it."""
    with _reading("Excel", "excel"):
        import openpyxl

        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # a single cell in the last corner makes these huge
            sheets = {sheet.title: _rows_of_sheet(sheet.title, sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
    heads = {title: rows[: _HEAD_LINES + _FIRST_ROWS] for title, rows in sheets.items()}
    title, line, header = _find_header(heads, file_format)
    tables = [rows[rows.index(header) + 1 :] for rows in sheets.values() if header in rows[:_HEAD_LINES]]
    tables, width = tables or [sheets[title][line + 1 :]], len(header)
    return pd.DataFrame([[*row, *[""] * width][:width] for rows in tables for row in rows], columns=header)


def _rows_of_sheet(title: object, rows: Iterable[Sequence[Any]]) -> list[list[str]]:
    """Return the filled fields of the rows of a sheet; refuse a sheet that is too large."""
    filled_rows: list[list[str]] = []
    size = 0
    for row in rows:
        fields = _strip_empty(["" if value is None else " ".join(str(value).split()) for value in row])
        _check(len(fields), _MOST_COLUMNS, f"columns in sheet {title!r}")
        if fields:
            filled_rows.append(fields)
            size += sum(map(len, fields)) + 60 * len(fields)  # memory of Python's text
            _check_unpacked(size)
    return filled_rows


def _read_parquet(path: Path) -> pd.DataFrame:
    """Read a table, after its footer has given its size; repeated text takes memory once."""
    with _reading("Parquet", "parquet"):
        from pyarrow import parquet, types

        with parquet.ParquetFile(path) as file:
            metadata, fields = file.metadata, list(file.schema_arrow)
        _check_rows(metadata.num_rows, path.stat().st_size)
        _check(metadata.num_rows * len(fields), max(LARGEST_UNPACKED_BYTES // 8, path.stat().st_size), "values")
        _check_unpacked(sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups)))
        counts = Counter(field.name for field in fields)  # a repeated name is ambiguous
        names = [field.name for field in fields if counts[field.name] == 1 and not types.is_nested(field.type)]
        text_names = [field.name for field in fields if types.is_string(field.type) or types.is_large_string(field.type)]
        # the metadata of pandas would turn a column into an index
        return parquet.read_table(path, columns=names, read_dictionary=text_names).to_pandas(ignore_metadata=True)


def _read_neware(path: Path) -> pd.DataFrame:
    with path.open("rb"), _reading("Neware", "cyclers"):
        import NewareNDA

        return NewareNDA.read(str(path), log_level="ERROR")


def _read_biologic(path: Path) -> pd.DataFrame:
    with path.open("rb") as stream, _reading("BioLogic", "cyclers"):
        from galvani.BioLogic import MPRfile

        return pd.DataFrame(MPRfile(stream).data)


def is_readable(path: Path, further_suffixes: Sequence[str] = ()) -> bool:
    """Whether a file has the suffix of a record."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes and suffixes[-1] in PACKED_SUFFIXES:
        return len(suffixes) > 1 and suffixes[-2] in TEXT_SUFFIXES
    return bool(suffixes) and suffixes[-1] in (*TEXT_SUFFIXES, *NUMBERED_SUFFIXES, *BINARY_SUFFIXES, *further_suffixes)
