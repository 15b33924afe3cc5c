"""Files that are never there in part."""

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

#: What is packed may become so large, or so many times as large as it is.
LARGEST_UNPACKED_BYTES, MOST_UNPACKED = 1 << 28, 40

# Kinds of files that are no text, or none of numbers, by how they begin, in small letters.
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
    """What a file is, by how it begins; empty if that does not tell."""
    head = content[:64].lstrip().lower()
    return next((kind for kind, heads in _KINDS.items() if head.startswith(heads)), "")


class WrongFormatError(ValueError):
    """A file holds something else than what was asked for."""


@contextmanager
def replacing(path: str | os.PathLike[str], new: bool = False) -> Iterator[Path]:
    """
    A place to write a file to, beside where it is to be. When the block ends the content goes to the disk, and then the file
    takes its name; what is new takes none that another file has. If anything fails, all is as it was before.
    """
    if new:
        _refuse_if_there(Path(path))
    # A link stays one, and what it leads to is replaced
    target = Path(os.path.realpath(path))
    _make_folder(target.parent)
    # A name that no process, thread or machine has but this; libraries go by the suffix
    part = target.with_name(f".{secrets.token_hex(8)}.part{target.suffix}")
    try:
        yield part
        with part.open("rb+") as stream:
            os.fsync(stream.fileno())
        if target.exists():  # what only its owner may read stays so
            shutil.copymode(target, part)
        if new:
            _take_new_name(part, target)
        else:
            os.replace(part, target)
        _sync_folder(target.parent)
    finally:
        part.unlink(missing_ok=True)


def _take_new_name(part: Path, target: Path) -> None:
    try:
        os.link(part, target)
    except OSError:  # it was taken meanwhile; or a file system without links, as of memory sticks
        _refuse_if_there(target)
        os.replace(part, target)


def _refuse_if_there(target: Path) -> None:
    if os.path.lexists(target):
        raise FileExistsError(f"{target} exists already; delete it or choose another name")


def _make_folder(folder: Path) -> None:
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for each in missing:
        _sync_folder(each.parent)


def _sync_folder(folder: Path) -> None:
    """Bring the names of files to the disk. Some systems cannot, and the files are whole all the same."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def set_aside(path: Path) -> Path:
    """Rename what cannot be used, so that nothing is lost and its name is free."""
    aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.damaged")
    os.replace(path, aside)
    return aside


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a file, which need not exist, against other commands; the system lets go of it when the process is gone."""
    from filelock import FileLock, Timeout

    _make_folder(path.parent)
    try:
        with FileLock(path.with_name(f".{path.name}.lock"), timeout=0):
            yield
    except Timeout:
        raise FileExistsError(f"{path} is being written by another command: wait for it, or choose another --out") from None


def check_folder(folder: Path) -> None:
    """Refuse a folder that results cannot be written to, before they are there to be lost."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir():
        raise FileExistsError(f"{there} is a file: choose another --out")
    if not os.access(there, os.W_OK):
        raise PermissionError(f"{there} cannot be written to: choose another --out")


def check_new(*paths: Path) -> None:
    """Refuse to write files where some are, or to a folder that cannot be written to."""
    check_folder(paths[0].parent)
    existing = [str(path) for path in paths if path.exists()]
    if existing:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; choose another --out, or delete what is there")


def finite_or_none(value: Any) -> Any:
    """JSON has no NaN and no infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: str | os.PathLike[str], file_format: str, version: int, content: Mapping[str, Any]) -> Path:
    """Write a new file in JSON that says what it holds."""
    target = Path(path)
    with replacing(target, new=True) as part:
        described = {"format": file_format, "version": version, **content}
        part.write_text(json.dumps(described, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return target


def read_json(path: str | os.PathLike[str], file_format: str, version: int) -> dict[str, Any]:
    """Read what :func:`write_json` wrote."""
    try:
        # a whole number of hundreds of digits is none of ours, and no float can hold it
        content = json.loads(
            Path(path).read_text(encoding="utf-8"), parse_int=lambda text: int(text) if len(text) < 300 else math.inf
        )
    except (ValueError, RecursionError) as error:  # of the encoding, of JSON, or of its depth
        raise ValueError(f"{path} is no file in JSON: {error}") from error
    found = content.pop("format", None) if isinstance(content, dict) else None
    if found != file_format:
        raise WrongFormatError(f"{path} holds no {file_format}" + (f" but {found}" if found else ""))
    if (number := content.pop("version", None)) != version:
        raise ValueError(f"{path} is {file_format} of version {number!r}; this program reads version {version}")
    return dict(content)


def npz_path(path: str | os.PathLike[str]) -> Path:
    """The path with the suffix .npz, which is added if it is missing."""
    target = Path(path)
    return target if target.suffix == ".npz" else target.with_name(target.name + ".npz")


def read_npz(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read arrays and metadata of any format; refuse a damaged file, and one of another kind."""
    with Path(path).open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        try:
            with np.load(stream, allow_pickle=False) as file:
                check_unpacked(size, sum(each.file_size for each in file.zip.infolist()))
                if damaged := file.zip.testzip():
                    raise ValueError(f"the checksum of {damaged} is wrong")
                metadata = json.loads(str(file["metadata"]))
                if metadata["kind"] != kind or "format" not in metadata:
                    raise ValueError(f"it is a {metadata['kind']}")
                return {name: np.asarray(file[name]) for name in file.files if name != "metadata"}, metadata
        except Exception as error:  # numpy and zipfile raise whatever the damage leads them to
            raise ValueError(f"{path} is damaged, or no {kind}: {error}") from error


def check_unpacked(packed_bytes: int, unpacked_bytes: int) -> None:
    """Refuse what would become far larger than it is, as no file of measurements does."""
    if unpacked_bytes > max(LARGEST_UNPACKED_BYTES, MOST_UNPACKED * packed_bytes):
        raise ValueError(f"{packed_bytes} bytes would become more than {unpacked_bytes >> 20} MiB: unpack it by hand")


def call_alone(module: str, name: str, *arguments: Any, **options: Any) -> Any:
    """
    Call a function that damaged files may lead to end its process, in a process of its own.

    :param module: where it is, found as here
    :param name: what it is called there
    :param arguments: that have literals, and return what can be pickled, likewise ``options``
    :raises ValueError: with what the process says last, or how it ended
    """
    code = f"import sys; sys.path[:] = {sys.path!r}\nimport pickle, {module}\n"
    code += f"pickle.dump({module}.{name}(*{arguments!r}, **{options!r}), sys.stdout.buffer)"
    process = subprocess.run([sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True)
    if process.returncode:
        lines = process.stderr.decode(errors="replace").splitlines()
        raise ValueError(lines[-1] if lines else f"{module}.{name} ended its process with {process.returncode}")
    return pickle.loads(process.stdout)
