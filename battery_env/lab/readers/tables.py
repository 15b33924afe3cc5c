"""Files of measurements as tables: text of any delimiter, Parquet, workbooks, and the binary files of testers."""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import itertools
import lzma
import re
import warnings
import zipfile
import zlib
from codecs import getincrementaldecoder
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
import pandas as pd

from battery_env.files import LARGEST_UNPACKED_BYTES
from battery_env.lab.readers.columns import FileFormat, Recognised, are_units, count_required, has, say
from battery_env.lab.readers.testers import ENCODINGS, REQUIRED

#: Endings of the names of files that can be read, besides those of NASA (.mat); of text also packed (.gz, .bz2, .xz, .zip).
#: Text of Maccor's is numbered.
TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mpt", ".dta", ".bdf")
NUMBERED_SUFFIXES = tuple(f".{number:03d}" for number in range(1000))
BINARY_SUFFIXES = (".parquet", ".nda", ".ndax", ".mpr", ".xlsx", ".xls")
PACKED_SUFFIXES = (".gz", ".bz2", ".xz", ".zip")

_OPENERS: dict[str, Callable[[Path], Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
# Testers write what they know about a test above the table: its header is searched in so many bytes and lines. A table is
# known by so many of its rows.
_HEAD_BYTES, _HEAD_LINES, _FIRST_ROWS = 1 << 18, 2000, 400
# A small file has no more rows and columns, so that all that is made of it fits into 1 GB; a large one a row each 20 bytes.
_MOST_ROWS, _LEAST_ROW_BYTES, _MOST_COLUMNS = 3_000_000, 20, 2000
_BLANKS = r"\s+"
_DELIMITERS = (",", ";", "\t", "|", _BLANKS)
_ITS_COMMA = re.compile(r"^(\s*[-+]?\d*),(?=\d)")
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d+,\d+(?:[eE][-+]?\d+)?\s*$")
_DECIMAL_POINT = re.compile(r"^\s*[-+]?\d*\.\d+(?:[eE][-+]?\d+)?\s*$")
_NUMBER = re.compile(r"^\s*[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?:[;\s]|$)")
# What Excel reads in the first line of a file: the delimiter.
_DELIMITER_LINE = re.compile(r"^\s*sep=([,;\t|])\s*$", flags=re.IGNORECASE)
# Some testers put lines as a whole in quotes.
_QUOTED_LINES = re.compile(rb'^"([^"\n]*)"\s*$', flags=re.MULTILINE)
# What pandas says of quotes that are open at the end of a file.
_OPEN_QUOTES = re.compile(r"EOF inside string starting at row (\d+)")
# How workbooks begin; text is called .xls by some testers.
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
_EXPORT = {".res": "export the channel as CSV in MITS Pro", ".h5": "export the records as CSV"}


class Layout(NamedTuple):
    """How a text file is laid out."""

    encoding: str
    header_line: int
    delimiter: str
    decimal: str
    names: list[str]
    layers: int  # so many columns at the left number what lies above a row, as its cycle and its step
    rows: list[list[str]]  # fields of the first lines below the header


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
    if suffix in _EXPORT:
        raise ValueError(f"{suffix} files cannot be read: {_EXPORT[suffix]}")
    if suffix in (".ndax", ".xlsx", ".xls"):
        _check_archive(path)
    if suffix == ".parquet":
        return _open_parquet(path)
    if suffix in (".nda", ".ndax", ".mpr"):
        return open_frame(_read_biologic(path) if suffix == ".mpr" else _read_neware(path))
    content = _text_of(path, file_format)
    layout = _layout_of(content[:_HEAD_BYTES], file_format)
    return Opened(layout.names, layout.rows, lambda found: _read_text(content, layout, found))


def open_frame(table: pd.DataFrame) -> Opened:
    """A table that is there; an index with a name is a column too."""
    table = table.reset_index(drop=table.index.names == [None])

    def read(found: Recognised) -> pd.DataFrame:
        return pd.DataFrame({key: table.iloc[:, column.position] for key, column in found.columns.items()})

    return Opened([str(name) for name in table.columns], _first_rows(table), read)


def _first_rows(table: pd.DataFrame) -> list[list[str]]:
    first = table.head(_FIRST_ROWS).astype(object)
    return [[str(value) for value in row] for row in first.where(first.notna(), "").to_numpy()]


def _text_of(path: Path, file_format: FileFormat) -> bytes:
    """The content of a text file, unpacked, or of a workbook as text, without what is no character."""
    content = _content(path)
    if path.suffix.lower() in (".xlsx", ".xls") and content.startswith(_WORKBOOKS):
        return _sheet(path, file_format)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", errors="ignore").encode()
    kept = content.rstrip(b"\0")  # what a power cut leaves of the end
    if 10 * kept.count(b"\0") > len(kept):
        raise ValueError("the file is binary, and its ending is none of those that can be read")
    kept = kept.replace(b"\0", b"")
    if len(kept) < len(content):
        say(f"{len(content) - len(kept)} NUL bytes, which are no text, are left out")
    head = kept[:_HEAD_BYTES]
    if b"\n" not in head:  # lines may end as on old computers, too
        kept = kept.replace(b"\r", b"\n")
    if _QUOTED_LINES.search(head):
        kept = _QUOTED_LINES.sub(rb"\1", kept)
    _check_rows(kept.count(b"\n"), len(kept))  # those of old computers, too
    return kept.replace("\u2212".encode(), b"-")  # the sign of typographers


def _check_rows(count: int, size: int) -> None:
    if count > max(_MOST_ROWS, size // _LEAST_ROW_BYTES):
        raise TooLargeError(
            f"{count} rows are more than the {_MOST_ROWS} that are read of a file of {size} bytes: cut it in parts"
        )


def _check_unpacked(count: int) -> None:
    if count > LARGEST_UNPACKED_BYTES:
        raise TooLargeError(
            f"unpacked it has more than the {LARGEST_UNPACKED_BYTES >> 20} MiB that are read: unpack it by hand"
        )


def _read_text(content: bytes, layout: Layout, found: Recognised) -> pd.DataFrame:
    _check_width(layout)
    has_units = bool(layout.rows) and are_units(layout.rows[0])
    width = max(map(len, layout.rows[has_units:]), default=0)
    if not width:
        raise ValueError("there are no rows below the header")
    # one column may serve as two quantities
    positions = sorted({*range(layout.layers), *(each.position for each in found.columns.values())})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of columns that are text in parts, which is seen later
            table = pd.read_csv(
                io.BytesIO(content),
                sep=layout.delimiter,
                decimal=layout.decimal,
                encoding=layout.encoding,
                encoding_errors="replace",  # of remarks; what is no number is seen later
                header=None,
                names=range(width),
                skiprows=layout.header_line + 1 + has_units,
                usecols=[n for n in positions if n < width],
                index_col=False,
                na_values=[*found.tester.missing],
            )
    except Exception as error:  # pandas raises whatever the damage leads it to
        kept, _, last = content.rstrip().rpartition(b"\n")
        if not (quotes := _OPEN_QUOTES.search(str(error))):
            raise found.refusal(f"the file is damaged, or no table: {str(error).strip()}") from error
        if last.count(b'"') % 2 == 0:
            raise found.refusal(f"the quotes that begin in row {int(quotes[1]) + 1} do not end") from error
        say("the last line is cut within quotes, and left out")
        return _read_text(kept, layout, found)
    if layout.decimal == ",":  # words among numbers make text of all
        table = table.replace(_ITS_COMMA, r"\1.", regex=True)
    table = _lowest_layer(table.reindex(columns=positions), layout.layers)
    return pd.DataFrame({key: table[column.position] for key, column in found.columns.items()})


def _content(path: Path) -> bytes:
    """The content of a file, unpacked."""
    parts, count, lines = [], 0, 0
    try:
        with _open(path) as stream:
            while part := stream.read(1 << 20):
                parts.append(part)
                count += len(part)
                lines += part.count(b"\n")
                _check_rows(lines, count)
                if path.suffix.lower() in PACKED_SUFFIXES:
                    _check_unpacked(count)
    except (FileNotFoundError, IsADirectoryError, PermissionError, TooLargeError):
        raise
    except Exception as error:  # the unpackers raise whatever the damage leads them to
        raise ValueError(f"the file is damaged: {str(error).strip() or type(error).__name__}") from error
    return b"".join(parts)


def _open(path: Path) -> IO[bytes]:
    suffix = path.suffix.lower()
    if suffix == ".zip":
        archive = zipfile.ZipFile(path)
        names = archive.namelist()
        if len(names) != 1:
            raise ValueError(f"the archive must hold one file, got {len(names)}")
        return archive.open(names[0])
    return cast(IO[bytes], _OPENERS.get(suffix, open)(path, "rb"))


def _check_archive(path: Path) -> None:
    """Refuse a file that holds an archive of what is far larger, by what the archive says of itself."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for each in archive.infolist():
                # of a text that many cells share each is kept
                _check_unpacked(each.file_size * (8 if each.filename.endswith("sharedStrings.xml") else 1))
            _check_unpacked(sum(each.file_size for each in archive.infolist()))


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
                # numbers may be written in one byte that take eight in memory
                _check_unpacked(8 * count)
            stream.seek(end)


def _lowest_layer(table: pd.DataFrame, layers: int) -> pd.DataFrame:
    """The rows of which no layer above has a number, each with the numbers that were given last."""
    if not layers:
        return table
    numbers = list(range(layers))
    above = table[numbers].notna().any(axis=1)
    table[numbers] = table[numbers].ffill()
    return table[~above]


def _layout_of(head: bytes, file_format: FileFormat) -> Layout:
    """The layout of a text by its beginning; the first encoding is taken in which it has the names of a record."""
    encodings = [file_format.tester.encoding] if file_format.tester and file_format.tester.encoding else ["utf-8", *ENCODINGS]
    layouts = []
    for encoding in encodings:
        try:
            # the head may end within a character
            text = getincrementaldecoder(encoding)().decode(head, final=False).removeprefix("\ufeff")
        except LookupError as error:
            raise ValueError(f"the encoding {encoding!r} is not known") from error
        except UnicodeDecodeError:
            continue
        layouts.append(_layout(text, encoding, file_format))
        if encoding == "utf-8" or count_required(layouts[-1].names, file_format) == len(REQUIRED):
            return layouts[-1]
    if not layouts:
        raise ValueError(f"the file is no text in {encodings[0]}")
    return layouts[0]


def _layout(text: str, encoding: str, file_format: FileFormat) -> Layout:
    lines = io.StringIO(text, newline=None).read().split("\n")[: _HEAD_LINES + _FIRST_ROWS]
    delimiters: tuple[str, ...] = _DELIMITERS
    if stated := _DELIMITER_LINE.match(lines[0]):
        lines[0], delimiters = "", (stated[1],)
    filled = [number for number, line in enumerate(lines) if line.strip()]
    below = {number: lines[after] for number, after in itertools.pairwise(filled)}
    tables = {each: [_fields(line, below.get(number, ""), each) for number, line in enumerate(lines)] for each in delimiters}
    delimiter, number = _find_header(tables, file_format)
    table = tables[delimiter]
    above, names, rows = table[:number], [*table[number]], table[number + 1 :][:_FIRST_ROWS]
    if len(names) > _MOST_COLUMNS:
        raise ValueError(f"{len(names)} columns are more than the {_MOST_COLUMNS} that are read")
    layers = next((n for n, name in enumerate(names) if name), 0)
    is_above = [any(row[:layers]) for row in rows if any(row)]
    if 2 * sum(is_above) >= len(is_above):
        layers = 0
    for n in range(layers):
        names[n] = next((row[n] for row in reversed(above) if any(row[n : n + 1])), "")
    values = [field for row in rows for field in row]
    commas, points = (sum(map(bool, map(mark.match, values))) for mark in (_DECIMAL_COMMA, _DECIMAL_POINT))
    return Layout(encoding, number, delimiter, "," if commas > points and delimiter != _BLANKS else ".", names, layers, rows)


def _check_width(layout: Layout) -> None:
    """Refuse rows of more numbers than names, as nothing tells what is what; remarks behind them change nothing."""
    rows, width = [row for row in layout.rows if any(row)], len(layout.names)
    wider = [row for row in rows if any(row[width:])]
    if 2 * len(wider) > len(rows) and any(_count_numbers(row[width:]) for row in wider):
        raise ValueError(
            f"rows have {len(wider[0])} fields below {width} names, which does not tell what is what: name each column, and "
            "take another delimiter than the decimal comma"
        )


class _Header(NamedTuple):
    """A row that may hold the names of the columns, and what speaks for it, the most telling first."""

    quantities: int  # of a record, so many
    fits: int  # so many of the rows below hold numbers in as many fields
    nearness: int  # to them
    table: str


def _find_header(tables: Mapping[str, Sequence[Sequence[str]]], file_format: FileFormat) -> tuple[str, int]:
    """In which of some tables, by delimiter or by sheet, and in which of its rows the names of the columns are."""
    candidates: dict[tuple[str, ...], _Header] = {}  # by names, which may come again
    numbers: Sequence[str] = ()
    for key, rows in tables.items():
        counts = [_count_numbers(row) for row in rows]
        is_row = np.array(counts) > 1
        numbers = numbers or next((rows[n] for n in np.flatnonzero(is_row).tolist()), ())
        # a delimiter may end each
        widths = np.array([(len(row), len([*filter(None, row)])) for row in rows]).reshape(-1, 2)
        for n in [n for n, row in enumerate(rows[:_HEAD_LINES]) if any(row) and not counts[n]]:
            below = slice(n + 1, n + 1 + _FIRST_ROWS)
            fits = int((is_row[below] & (widths[below] == widths[n]).any(axis=1)).sum())
            found = _Header(count_required(rows[n], file_format), fits, n if fits else -n, key)
            candidates.setdefault(tuple(filter(None, rows[n])), found)
    best = max(candidates.values(), key=lambda each: each[:3], default=_Header(0, 0, 0, ""))
    if numbers and not (best.quantities or best.fits):
        raise ValueError(
            "there is no line with the names of the columns above the numbers. Add one. The first line of numbers: "
            f"{', '.join(numbers)[:99]}"
        )
    if not candidates:
        raise ValueError("the file is empty")
    first = next(each for each in candidates.values() if each.quantities == best.quantities)
    if best.quantities and first != best:
        say(f"the header is line {abs(best.nearness) + 1}; the table of line {abs(first.nearness) + 1} is left out")
    return best.table, abs(best.nearness)


def _count_numbers(fields: Sequence[str]) -> int:
    return sum(bool(_NUMBER.match(field) or _DECIMAL_COMMA.match(field)) for field in fields)


def _fields(line: str, next_line: str, delimiter: str) -> list[str]:
    # numpy writes a header as a comment
    line = line.lstrip("# ")
    if delimiter == _BLANKS:
        fields, below = (each.replace('"', " ").split() for each in (line, next_line))
        # of which two or more part names of several words
        return fields if len(fields) <= len(below) else re.split(r"\s{2,}", line.strip())
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
    except (FileNotFoundError, TooLargeError):
        raise
    except ImportError as error:
        raise ImportError(f"{kind} files need an extra: pip install 'battery_env[{extra}]' ({error})") from error
    except NotImplementedError as error:
        raise ValueError(f"what reads {kind} files does not know all of this one: {error}") from error
    except Exception as error:  # whatever the damage leads to
        raise ValueError(f"the file is damaged, or no {kind} file: {str(error).strip()}") from error


def _sheets(path: Path) -> Iterator[tuple[str, Iterable[Sequence[Any]]]]:
    """Each sheet's title and its rows, as wide as they are filled: a single cell may lie in the last corner of a sheet."""
    if path.read_bytes()[:4] == _WORKBOOKS[0]:
        import openpyxl

        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            for sheet in book.worksheets:
                sheet.reset_dimensions()
                yield sheet.title, sheet.iter_rows(values_only=True)
    else:
        import xlrd

        with xlrd.open_workbook(path, ragged_rows=True, on_demand=True) as book:
            for sheet in book.sheets():
                yield sheet.name, ([_cell_of_xls(cell, book.datemode) for cell in row] for row in sheet.get_rows())


def _cell_of_xls(cell: Any, datemode: int) -> Any:
    import xlrd

    return xlrd.xldate_as_datetime(cell.value, datemode) if cell.ctype == xlrd.XL_CELL_DATE else cell.value


def _sheet(path: Path, file_format: FileFormat) -> bytes:
    """The sheet of a workbook that holds the record, and those that continue it, as text."""
    with _reading("Excel", "excel"):
        sheets = {title: _rows_of_sheet(title, rows) for title, rows in _sheets(path)}
    title, line = _find_header({each: rows[: _HEAD_LINES + _FIRST_ROWS] for each, rows in sheets.items()}, file_format)
    header = sheets[title][line]
    parts = [rows[rows.index(header) + 1 :] for rows in sheets.values() if header in rows[:_HEAD_LINES]]
    # each may be a test of its own
    numbered = len(parts) > 1 and not has("cycle", header)
    text = io.StringIO()
    writer, width = csv.writer(text, lineterminator="\n"), len(header)
    writer.writerows([*sheets[title][:line], [*header, *["Cycle"] * numbered]])
    for number, rows in enumerate(parts, start=1):
        writer.writerows([*row[:width], *[""] * (width - len(row)), *[number] * numbered] for row in rows)
    return text.getvalue().encode()


def _rows_of_sheet(title: str, rows: Iterable[Sequence[Any]]) -> list[list[str]]:
    """The rows of a sheet that are filled; refused where it is too large."""
    kept: list[list[str]] = []
    size = 0
    for row in rows:
        fields = ["" if value is None else " ".join(str(value).split()) for value in row]
        while fields and not fields[-1]:
            fields.pop()
        if len(fields) > _MOST_COLUMNS:
            raise TooLargeError(f"{len(fields)} columns in sheet {title!r} are more than the {_MOST_COLUMNS} that are read")
        if fields:
            kept.append(fields)
            size += sum(map(len, fields)) + 60 * len(fields)  # as Python keeps text
            _check_unpacked(size)
    return kept


def _open_parquet(path: Path) -> Opened:
    """A file whose footer says how large its columns are; text is kept once, however often it comes."""
    with _reading("Parquet", "parquet"):
        from pyarrow import parquet, types

        with parquet.ParquetFile(path) as file:
            metadata, fields = file.metadata, list(file.schema_arrow)
            _check_rows(metadata.num_rows, path.stat().st_size)
            sizes: Counter[str] = Counter()
            for group, n in itertools.product(range(metadata.num_row_groups), range(metadata.num_columns)):
                chunk = metadata.row_group(group).column(n)
                sizes[chunk.path_in_schema.split(".")[0]] += chunk.total_uncompressed_size
    is_text = {each.name: types.is_string(each.type) or types.is_large_string(each.type) for each in fields}
    is_plain = {each.name: not types.is_nested(each.type) and not types.is_binary(each.type) for each in fields}
    counts = Counter(each.name for each in fields)  # of a name that comes twice nothing tells which is meant
    usable = [each.name for each in fields if is_plain[each.name] and counts[each.name] == 1]
    usable = [name for name in usable if sizes[name] <= LARGEST_UNPACKED_BYTES // 8]

    def read(names: Sequence[str], most_rows: int | None = None) -> pd.DataFrame:
        text = [name for name in names if is_text[name]]
        with _reading("Parquet", "parquet"), parquet.ParquetFile(path, read_dictionary=text) as file:
            # the metadata of pandas would make an index of a column
            if most_rows is None:
                return file.read(columns=names).to_pandas(ignore_metadata=True)
            first = next(file.iter_batches(most_rows, columns=names), None)
            return pd.DataFrame(columns=[*names]) if first is None else first.to_pandas(ignore_metadata=True)

    def read_columns_of(found: Recognised) -> pd.DataFrame:
        name_of = {key: fields[column.position].name for key, column in found.columns.items()}
        table = read(sorted({*name_of.values()}))
        return pd.DataFrame({key: table[name] for key, name in name_of.items()})

    names = [each.name if each.name in usable else "" for each in fields]
    head = read(usable, _FIRST_ROWS).reindex(columns=[each.name for each in fields])
    return Opened(names, _first_rows(head), read_columns_of)


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
