"""Files that are complete or absent."""

from __future__ import annotations

import json
import math
import os
import pickle
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Largest size of unpacked content, and largest ratio to its packed size.
LARGEST_UNPACKED_BYTES, MOST_UNPACKED = 1 << 28, 40

# Kinds of files that are no table, by their first bytes in small letters.
_KINDS = {
    "a picture": (b"\x89png", b"\xff\xd8\xff", b"gif8", b"ii*\0", b"mm\0*", b"<svg"),
    "a PDF": (b"%pdf",),
    "a page of the web": (b"<!doctype html", b"<html"),
    "a picture, a workbook or a page in XML": (b"<?xml",),
    "a workbook, a document or an archive, of which its name says nothing": (b"pk\x03\x04", b"\x1f\x8b"),
    "a binary workbook or document of old Office": (b"\xd0\xcf\x11\xe0",),
    "a binary file of HDF5": (b"\x89hdf",),
    "a database": (b"sqlite format 3",),
    "a pointer of Git LFS, whose content git lfs pull fetches": (b"version https://git-lfs",),
}


def kind_of(content: bytes) -> str:
    """Return the kind of a file by its first bytes; empty if unknown."""
    head = content[:64].lstrip().lower()
    return next((kind for kind, heads in _KINDS.items() if head.startswith(heads)), "")


class WrongFormatError(ValueError):
    """A file has another format."""


@contextmanager
def replacing(path: str | os.PathLike[str], new: bool = False) -> Iterator[Path]:
    """
    Yield a temporary path to write to. At the end of the block the file goes to the disk, and then takes its name; a ``new``
    file replaces no other. If anything fails, all files stay as they were.
    """
    if new:
        _refuse_if_there(Path(path))
    # a link stays a link; its target is replaced
    target = Path(os.path.realpath(path))
    _make_folder(target.parent)
    # a name that no other process, thread or machine uses; libraries need the suffix
    temporary = target.with_name(f".{secrets.token_hex(8)}.part{target.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        if target.exists():  # keep its permissions
            shutil.copymode(target, temporary)
        if new:
            _take_new_name(temporary, target)
        else:
            os.replace(temporary, target)
        _sync_folder(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _take_new_name(temporary: Path, target: Path) -> None:
    try:
        os.link(temporary, target)
    except OSError:  # another process has taken the name, or the file system has no links, as on memory sticks
        _refuse_if_there(target)
        os.replace(temporary, target)


def _refuse_if_there(target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(f"{target} exists already; delete it or choose another name")


def _make_folder(folder: Path) -> None:
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Write the names of files to the disk; on systems that cannot, the files are complete nevertheless."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file, which need not exist, against other commands; the lock ends with the process."""
    from filelock import FileLock, Timeout

    _make_folder(path.parent)
    try:
        with FileLock(path.with_name(f".{path.name}.lock"), timeout=0):
            yield
    except Timeout:
        raise FileExistsError(f"{path} is being written by another command: wait for it, or choose another --out") from None


def check_folder(folder: Path) -> None:
    """Refuse a folder that is not writable, before results could be lost."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise FileExistsError(f"{existing} is a file: choose another --out")
    if not os.access(existing, os.W_OK):
        raise PermissionError(f"{existing} cannot be written to: choose another --out")


def check_new(*paths: Path) -> None:
    """Refuse to replace files, or to write to a folder that is not writable."""
    check_folder(paths[0].parent)
    existing = [str(path) for path in paths if path.exists()]
    if existing:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; choose another --out, or delete what is there")


def finite_or_none(value: Any) -> Any:
    """Return ``None`` for NaN and infinity, which JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: str | os.PathLike[str], file_format: str, version: int, content: Mapping[str, Any]) -> Path:
    """Write a new JSON file with its format and version."""
    target = Path(path)
    with replacing(target, new=True) as temporary:
        document = {"format": file_format, "version": version, **content}
        temporary.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return target


def read_json(path: str | os.PathLike[str], file_format: str, version: int) -> dict[str, Any]:
    """Read a file of :func:`write_json`."""
    try:
        # a float cannot hold a whole number of hundreds of digits
        content = json.loads(
            Path(path).read_text(encoding="utf-8"), parse_int=lambda text: int(text) if len(text) < 300 else math.inf
        )
    except (ValueError, RecursionError) as error:  # wrong encoding, invalid JSON, or too deep
        raise ValueError(f"{path} is no file in JSON: {error}") from error
    stored_format = content.pop("format", None) if isinstance(content, dict) else None
    if stored_format != file_format:
        raise WrongFormatError(f"{path} holds no {file_format}" + (f" but {stored_format}" if stored_format else ""))
    if (number := content.pop("version", None)) != version:
        raise ValueError(f"{path} is {file_format} of version {number!r}; this program reads version {version}")
    return dict(content)


def read_npz(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read arrays and metadata; refuse a damaged file, or another kind of file."""
    with Path(path).open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        try:
            with np.load(stream, allow_pickle=False) as file:
                unpacked = sum(entry.file_size for entry in file.zip.infolist())
                if unpacked > max(LARGEST_UNPACKED_BYTES, MOST_UNPACKED * size):  # unlike measurements
                    raise ValueError(f"{size} bytes would become more than {unpacked >> 20} MiB: unpack it by hand")
                if damaged_name := file.zip.testzip():
                    raise ValueError(f"the checksum of {damaged_name} is wrong")
                metadata = json.loads(str(file["metadata"]))
                if metadata["kind"] != kind or "format" not in metadata:
                    raise ValueError(f"it is a {metadata['kind']}")
                return {name: np.asarray(file[name]) for name in file.files if name != "metadata"}, metadata
        except Exception as error:  # numpy and zipfile raise errors of many types
            raise ValueError(f"{path} is damaged, or no {kind}: {error}") from error


def call_in_process(module: str, name: str, *arguments: Any, **options: Any) -> Any:
    """Call a function of literals in a separate process, because a damaged file may end its process."""
    code = f"import sys; sys.path[:] = {sys.path!r}\nimport pickle, {module}\n"
    code += f"pickle.dump({module}.{name}(*{arguments!r}, **{options!r}), sys.stdout.buffer)"
    process = subprocess.run([sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True)
    if process.returncode:
        lines = process.stderr.decode(errors="replace").splitlines()
        raise ValueError(lines[-1] if lines else f"{module}.{name} ended its process with {process.returncode}")
    return pickle.loads(process.stdout)
