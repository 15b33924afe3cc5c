"""Files of what an estimator knows in the middle of a discharge, so that a program can stop and go on: npz without pickle."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.files import DamagedError, npz_path, read_npz, replacing, set_aside

FORMAT_VERSION = 6
_KIND = "state of an estimator"


def save_state(path: str | os.PathLike[str], settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Path:
    """Write a state. It takes the place of an older one, and of no other file; a damaged one is renamed, with a warning."""
    target = npz_path(path)
    if target.exists():
        try:
            read_npz(target, _KIND)
        except DamagedError as error:
            warnings.warn(f"{error}. It is kept as {set_aside(target).name}, and a new one takes its place.", stacklevel=3)
        except ValueError as error:
            raise FileExistsError(f"{target} exists, and is no state of an estimator: choose another name") from error
    metadata = json.dumps({"kind": _KIND, "format": FORMAT_VERSION, "settings": settings})
    with replacing(target) as part:
        np.savez(part, metadata=np.array(metadata), **arrays)  # type: ignore[arg-type]  # none is named allow_pickle
    return target


def load_state(path: str | os.PathLike[str], settings: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Read what :func:`save_state` wrote."""
    arrays, metadata = read_npz(path, _KIND)
    if metadata["format"] != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format {metadata['format']}, this version reads {FORMAT_VERSION}: begin a discharge anew"
        )
    saved, own = metadata["settings"], json.loads(json.dumps(settings))
    different = sorted(name for name in saved.keys() | own.keys() if saved.get(name) != own.get(name))
    if different:
        name = different[0]
        raise ValueError(
            f"{path} is of an estimator with {name} = {saved.get(name)!r}, this one has {own.get(name)!r}: make one with the "
            f"same arguments (different: {', '.join(different)})"
        )
    return arrays


@contextmanager
def refusing(name: str | os.PathLike[str]) -> Iterator[None]:
    """Say of what is refused where it comes from."""
    try:
        yield
    except ValueError as error:
        raise error if str(name) in str(error) else ValueError(f"{name}: {error}") from error


def check_like(arrays: Mapping[str, NDArray[Any]], like: Mapping[str, NDArray[Any]], growing: str = "") -> None:
    """Refuse arrays of other names, kinds and shapes than those that an estimator has itself; one may have grown."""
    if wrong := arrays.keys() ^ like.keys():
        raise ValueError(f"arrays that are missing or unknown: {', '.join(sorted(wrong))}")
    for name, own in like.items():
        found, axes = arrays[name], own.ndim - (name == growing)
        is_kind = found.dtype == own.dtype or (own.dtype.names is None and found.dtype.kind == own.dtype.kind)
        if not is_kind or found.ndim != own.ndim or found.shape[:axes] != own.shape[:axes]:
            raise ValueError(f"{name} is {found.dtype} of shape {found.shape}, and not {own.dtype} of {own.shape}")


def check_all(**conditions: Any) -> None:
    """Refuse contents of which one of these conditions, named after what it is about, does not hold for all."""
    for name, holds in conditions.items():
        if not all(np.all(each) for each in (holds if isinstance(holds, list) else [holds])):
            raise ValueError(f"its {name} is none that a discharge leads to")
