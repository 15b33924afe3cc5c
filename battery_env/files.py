"""Files that are never there in part."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class WrongFormatError(ValueError):
    """A file holds something else than what was asked for."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A place to write a file to, beside where it is to be; it is renamed when the block ends, and removed if it fails."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Of this process, for another one may write the same file; libraries go by the suffix
    part = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        yield part
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


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
    if target.exists():
        raise FileExistsError(f"{target} exists already; delete it or choose another name")
    with replacing(target) as part:
        described = {"format": file_format, "version": version, **content}
        part.write_text(json.dumps(described, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return target


def read_json(path: str | os.PathLike[str], file_format: str, version: int) -> dict[str, Any]:
    """Read what :func:`write_json` wrote."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:  # of the encoding, or of JSON
        raise ValueError(f"{path} is no file in JSON: {error}") from error
    found = content.pop("format", None) if isinstance(content, dict) else None
    if found != file_format:
        raise WrongFormatError(f"{path} holds no {file_format}" + (f" but {found}" if found else ""))
    if (number := content.pop("version", None)) != version:
        raise ValueError(f"{path} is {file_format} of version {number!r}; this program reads version {version}")
    return dict(content)


def save_npz(
    path: str | os.PathLike[str],
    kind: str,
    version: int,
    arrays: Mapping[str, NDArray[Any]],
    settings: Mapping[str, Any],
) -> Path:
    """Write arrays, and settings as JSON, to a new npz file that says what it holds; no pickle."""
    target = npz_path(path)
    if target.exists():
        raise FileExistsError(f"{target} exists already; delete it or choose another name")
    metadata = json.dumps({**settings, "kind": kind, "format": version})
    with replacing(target) as part:
        np.savez_compressed(part, allow_pickle=False, metadata=np.array(metadata), **arrays)
    return target


def npz_path(path: str | os.PathLike[str]) -> Path:
    """The path with the suffix .npz, which is added if it is missing."""
    target = Path(path)
    return target if target.suffix == ".npz" else target.with_name(target.name + ".npz")


def load_npz(path: str | os.PathLike[str], kind: str, version: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read the arrays and the settings that :func:`save_npz` wrote."""
    # data sets of earlier versions do not say what they are
    arrays, settings = read_npz(path, kind, unstated=kind)
    if settings["format"] != version:
        raise ValueError(f"{path} has format {settings['format']}, this version reads {version}: make it again")
    return arrays, settings


def read_npz(
    path: str | os.PathLike[str], kind: str, unstated: str | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read arrays and metadata of any format; refuse a damaged file, and one of another kind."""
    with Path(path).open("rb") as stream:
        try:
            with np.load(stream, allow_pickle=False) as file:
                if damaged := file.zip.testzip():
                    raise ValueError(f"the checksum of {damaged} is wrong")
                metadata = json.loads(str(file["metadata"]))
                if (found := metadata.get("kind", unstated)) != kind or "format" not in metadata:
                    raise ValueError(f"it is a {found}")
                return {name: np.asarray(file[name]) for name in file.files if name != "metadata"}, metadata
        except Exception as error:  # numpy and zipfile raise whatever the damage leads them to
            raise ValueError(f"{path} is damaged, or no {kind}: {error}") from error
