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
from battery_env.lab.readers.columns import FileFormat, Recognised, are_units, count_required, say
from battery_env.lab.readers.testers import ENCODINGS, REQUIRED
from battery_env.records.refusals import Advice, RecordError

Key = TypeVar("Key")

#: Endings of the names of files that can be read, besides those of NASA (.mat); of text also packed (.gz, .zip). Text of
#: Maccor's is numbered, and some call theirs .xls.
TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mpt", ".dta", ".bdf", ".xls")
NUMBERED_SUFFIXES = tuple(f".{number:03d}" for number in range(1000))
BINARY_SUFFIXES = (".parquet", ".nda", ".ndax", ".mpr", ".xlsx")
PACKED_SUFFIXES = (".gz", ".zip")

# Testers write what they know about a test above the table: its header is searched in so many lines of so many bytes each. A
# table is known by so many of its rows.
_HEAD_LINES, _LINE_BYTES, _FIRST_ROWS = 2000, 128, 400
# A small file has no more rows and columns, so that all that is made of it fits into 1 GB; a large one a row each 20 bytes.
_MOST_ROWS, _LEAST_ROW_BYTES, _MOST_COLUMNS = 3_000_000, 20, 2000
_BLANKS = r"\s+"
_DELIMITERS = (",", ";", "\t", "|", _BLANKS)
_NUMBER = re.compile(r"[-+]?[\d.,]*\d[.,]?(?:[eE][-+]?\d+)?$")
_ITS_COMMA = re.compile(r"^(\s*[-+]?\d*),(?=\d)")


class TooLargeError(ValueError):
    """A file, or what is packed in it, is beyond a bound."""


class Opened(NamedTuple):
    """A table of which the header and the first rows are read."""

    names: list[str]
    rows: list[list[str]]
    read: Callable[[Recognised], pd.DataFrame]  # the columns of a record, by quantity, and no others


def open_file(path: Path, file_format: FileFormat) -> Opened:
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


def open_frame(table: pd.DataFrame) -> Opened:
    """A table that is there; an index with a name is a column too."""
    table = table.reset_index(drop=table.index.names == [None])

    def read(found: Recognised) -> pd.DataFrame:
        return pd.DataFrame({key: table.iloc[:, column.position] for key, column in found.columns.items()})

    first = table.head(_FIRST_ROWS).astype(object)
    rows = [[str(value) for value in row] for row in first.where(first.notna(), "").to_numpy()]
    return Opened([str(name) for name in table.columns], rows, read)


def _check(count: int, most: int, what: str) -> None:
    if count > most:
        raise TooLargeError(f"{count} {what} are more than the {most} that are read: cut it in parts, or unpack it by hand")


def _check_rows(count: int, size: int) -> None:
    _check(count, max(_MOST_ROWS, size // _LEAST_ROW_BYTES), "rows")


def _check_unpacked(count: int) -> None:
    _check(count, LARGEST_UNPACKED_BYTES, "bytes unpacked")


def _content(path: Path) -> bytes:
    """The content of a file, unpacked."""
    parts, count, lines = [], 0, 0
    with _reading("packed text"), _open(path) as stream:
        while part := stream.read(1 << 20):
            parts.append(part)
            count += len(part)
            lines += max(part.count(b"\n"), part.count(b"\r"))  # as on old computers, too
            _check_rows(lines, count)
            if path.suffix.lower() in PACKED_SUFFIXES:
                _check_unpacked(count)
    return b"".join(parts)


def _open(path: Path) -> IO[bytes]:
    if path.suffix.lower() == ".zip":
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
        if len(names) != 1:
            raise ValueError(f"the archive must hold one file, got {len(names)}")
        return archive.open(names[0])
    return cast(IO[bytes], gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb"))


def _check_archive(path: Path) -> None:
    """Refuse a file that holds an archive of what is far larger, by what the archive says of itself."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            # of a text that many cells share each is kept
            sizes = [each.file_size * (8 if "sharedStrings" in each.filename else 1) for each in archive.infolist()]
        _check_unpacked(sum(sizes))


def check_mat(path: Path) -> None:
    """Refuse a MATLAB file whose packed variables become far larger, before they are read."""
    count = 0
    with path.open("rb") as stream:
        stream.seek(128)
        while len(tag := stream.read(8)) == 8:
            kind, size = np.frombuffer(tag, dtype="<u4").tolist()
            end = stream.tell() + size
            unpacker = zlib.decompressobj()
            while kind == 15 and stream.tell() < end and (part := stream.read(min(1 << 14, end - stream.tell()))):
                try:
                    count += len(unpacker.decompress(part))
                except zlib.error:
                    return  # which what reads it says
                _check_unpacked(8 * count)  # numbers may be written in one byte that take eight in memory
            stream.seek(end)


def _text_of(path: Path) -> bytes:
    """The text of a file without what is no character."""
    content = _content(path)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", errors="ignore").encode()
    kept = content.rstrip(b"\0")  # what a power cut leaves of the end
    if kind := kind_of(content) or "binary" * (10 * kept.count(b"\0") > len(kept)):
        raise RecordError(f"the file is {kind}, and no table", [Advice("Export the records as CSV, a workbook as .xlsx")])
    kept = kept.replace(b"\0", b"")
    if len(kept) < len(content):
        say(f"{len(content) - len(kept)} NUL bytes, which are no text, are left out")
    return kept.replace("\u2212".encode(), b"-")  # the sign of typographers


def _open_text(content: bytes, file_format: FileFormat) -> Opened:
    """In UTF-8, or in the encoding in which the beginning of the text has the names of a record."""
    stated = file_format.tester and file_format.tester.encoding
    tables: dict[tuple[str, str], list[list[str]]] = {}
    for encoding in [stated] if stated else ["utf-8", *ENCODINGS]:
        try:
            # the head may end within a character
            head = getincrementaldecoder(encoding)().decode(content[: _HEAD_LINES * _LINE_BYTES], final=False)
        except (LookupError, UnicodeDecodeError) as error:
            if stated:
                raise ValueError(f"the file is no text in {stated}: {error}") from error
            continue
        lines = io.StringIO(head.removeprefix("\ufeff"), newline=None).read().split("\n")[: _HEAD_LINES + _FIRST_ROWS]
        tables |= {(encoding, delimiter): [_fields(line, delimiter) for line in lines] for delimiter in _DELIMITERS}
        if encoding == "utf-8":
            break
    (encoding, delimiter), number, names = _find_header(tables, file_format)
    below = tables[encoding, delimiter][number + 1 : number + 1 + _FIRST_ROWS]
    rows = [*map(_filled, below)]
    _check(len(names), _MOST_COLUMNS, "columns")
    has_units = bool(rows) and are_units(rows[0])
    values = [row for row in rows[has_units:] if row]
    if not values:
        raise ValueError("there are no rows below the header")
    if not names[0] and 0 < 2 * sum(row[0] != "" for row in values) < len(values):
        raise ValueError("rows of cycles, steps and records are in one table: export the records alone")
    # a name may hold blanks
    odd = [len(row) for row in values if len(row) > len(names) or (len(row) < len(names) and delimiter == _BLANKS)]
    if 2 * len(odd) > len(values):
        raise ValueError(
            f"rows have {odd[0]} fields below {len(names)} names, which does not tell what is what: name each column, and "
            "take another delimiter than the decimal comma, or than the blanks in names"
        )
    width = max(map(len, below[has_units:]))
    if names[width:]:
        say(f"the header is longer than the rows: {', '.join(names[width:])} left out")
    numbers = [field for row in values for field in row if _NUMBER.match(field)]
    options: dict[str, Any] = {
        "sep": delimiter,
        "decimal": "," if 2 * sum("," in field for field in numbers) > len(numbers) else ".",
        "encoding": encoding,
        "skiprows": number + 1 + has_units,
        "names": range(width),
    }
    return Opened(names[:width], rows, lambda found: _read_text(content, options, found))


def _read_text(content: bytes, options: dict[str, Any], found: Recognised) -> pd.DataFrame:
    positions = sorted({column.position for column in found.columns.values()})  # one may serve as two quantities
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of columns that are text in parts, which is seen later
            table = pd.read_csv(
                io.BytesIO(content),
                encoding_errors="replace",  # of remarks; what is no number is seen later
                header=None,
                usecols=[n for n in positions if n in options["names"]],
                index_col=False,
                na_values=[*found.tester.missing],
                **options,
            )
    except Exception as error:  # pandas raises whatever the damage leads it to
        raise RecordError(f"the file is damaged, or no table: {str(error).strip()}") from error
    table = table.reindex(columns=positions)
    if options["decimal"] == ",":  # words among numbers make text of all
        table = table.replace(_ITS_COMMA, r"\1.", regex=True)
    return pd.DataFrame({key: table[column.position] for key, column in found.columns.items()})


def _find_header(tables: Mapping[Key, Sequence[Sequence[str]]], file_format: FileFormat) -> tuple[Key, int, list[str]]:
    """
    In which of some tables, by delimiter or by sheet, and in which of its rows the names of the columns are: above rows of
    numbers in as many fields, or in fewer below names of a whole record, those of most quantities. Where there are none the
    row is that above the numbers, and the names are places.
    """
    candidates: dict[tuple[str, ...], tuple[bool, int, int, int, Key]] = {}  # by names, which may come again
    most, first, of_most = 0, 0, next(iter(tables))  # numbers in rows of them, the first of these rows, and their table
    for key, rows in tables.items():
        counts = np.array([sum(bool(_NUMBER.match(field)) for field in row) for row in rows], dtype=np.int64)
        are_numbers = counts > 1
        # a delimiter may end each
        widths = np.array([(len(row), len(_filled(row))) for row in rows]).reshape(-1, 2)
        if (count := int(counts[are_numbers].sum())) > most:
            usual = np.bincount(widths[are_numbers, 1]).argmax()  # a title may hold numbers, too
            most, first, of_most = count, int((are_numbers & (widths[:, 1] == usual)).argmax()), key
        for n, row in enumerate(rows[:_HEAD_LINES]):
            if any(row) and not counts[n]:
                below, quantities = slice(n + 1, n + 1 + _FIRST_ROWS), count_required(row, file_format)
                fits = int(((widths[below] == widths[n]).any(axis=1) & are_numbers[below]).sum())
                is_longer = quantities == len(REQUIRED) and bool((widths[below] < widths[n]).all(axis=1) @ are_numbers[below])
                candidates.setdefault(tuple(_filled(row)), (fits > 0 or is_longer, quantities, fits, n, key))
    if not candidates and not most:
        raise ValueError("the file is empty")
    best = max(candidates.values(), key=lambda each: each[:4], default=(False, 0, 0, 0, of_most))
    is_header, quantities, _, number, key = best
    if most and not is_header and quantities < len(REQUIRED):
        if not (file_format.columns or file_format.tester):
            say("no line names the columns: state places, --columns time=1,voltage=2,current=3 (and --units current=0.01A)")
        width = max(len(_filled(row)) for row in tables[of_most][first:])
        return of_most, first - 1, [str(n + 1) for n in range(width)]
    first = next(each[3] for each in candidates.values() if each[:2] == best[:2])
    if quantities and first != number:
        say(f"the header is line {number + 1}; the table of line {first + 1} is left out")
    return key, number, _filled(tables[key][number])


def _fields(line: str, delimiter: str) -> list[str]:
    line = line.lstrip("# ")  # numpy writes a header as a comment
    try:
        fields = line.split() if delimiter == _BLANKS else next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return []
    return [field.strip().strip('"') for field in fields]


def _filled(fields: Sequence[str]) -> list[str]:
    """Without what is empty at the end."""
    most = max((n for n, field in enumerate(fields, start=1) if field), default=0)
    return list(fields[:most])


@contextmanager
def _reading(kind: str, extra: str = "") -> Iterator[None]:
    """Of what others read: their own warnings are not passed on, and what is missing, or not as it should be, is named."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (FileNotFoundError, IsADirectoryError, PermissionError, TooLargeError):
        raise
    except ImportError as error:
        raise ImportError(f"{kind} files need an extra: pip install './battery_env[{extra}]' ({error})") from error
    except Exception as error:  # whatever the damage leads to
        raise ValueError(f"the file is damaged, or no {kind} file: {str(error).strip() or type(error).__name__}") from error


def _read_workbook(path: Path, file_format: FileFormat) -> pd.DataFrame:
    """The sheet of a workbook that holds the record, and those that continue it."""
    with _reading("Excel", "excel"):
        import openpyxl

        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # which a single cell in the last corner makes
            sheets = {sheet.title: _rows_of_sheet(sheet.title, sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
    beginnings = {title: rows[: _HEAD_LINES + _FIRST_ROWS] for title, rows in sheets.items()}
    title, line, header = _find_header(beginnings, file_format)
    parts = [rows[rows.index(header) + 1 :] for rows in sheets.values() if header in rows[:_HEAD_LINES]]
    parts, width = parts or [sheets[title][line + 1 :]], len(header)
    return pd.DataFrame([[*row, *[""] * width][:width] for rows in parts for row in rows], columns=header)


def _rows_of_sheet(title: object, rows: Iterable[Sequence[Any]]) -> list[list[str]]:
    """The rows of a sheet as far as they are filled; refused where it is too large."""
    kept: list[list[str]] = []
    size = 0
    for row in rows:
        fields = _filled(["" if value is None else " ".join(str(value).split()) for value in row])
        _check(len(fields), _MOST_COLUMNS, f"columns in sheet {title!r}")
        if fields:
            kept.append(fields)
            size += sum(map(len, fields)) + 60 * len(fields)  # as Python keeps text
            _check_unpacked(size)
    return kept


def _read_parquet(path: Path) -> pd.DataFrame:
    """A table whose footer says how large it is; text is kept once, however often it comes."""
    with _reading("Parquet", "parquet"):
        from pyarrow import parquet, types

        with parquet.ParquetFile(path) as file:
            metadata, fields = file.metadata, list(file.schema_arrow)
        _check_rows(metadata.num_rows, path.stat().st_size)
        _check(metadata.num_rows * len(fields), max(LARGEST_UNPACKED_BYTES // 8, path.stat().st_size), "values")
        _check_unpacked(sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups)))
        counts = Counter(each.name for each in fields)  # of a name that comes twice nothing tells which is meant
        names = [each.name for each in fields if counts[each.name] == 1 and not types.is_nested(each.type)]
        text = [each.name for each in fields if types.is_string(each.type) or types.is_large_string(each.type)]
        # the metadata of pandas would make an index of a column
        return parquet.read_table(path, columns=names, read_dictionary=text).to_pandas(ignore_metadata=True)


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
