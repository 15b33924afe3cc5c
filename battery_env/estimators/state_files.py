"""Files of what an estimator knows in the middle of a discharge, so that a program can stop and go on: npz without pickle."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.files import DamagedError, npz_path, read_npz, replacing, set_aside

FORMAT_VERSION = 7
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
    metadata = json.dumps({"kind": _KIND, "format": FORMAT_VERSION, "settings": settings, "sha256": _digest(arrays, settings)})
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
    saved: Any = metadata.get("settings")
    own = json.loads(json.dumps(settings))
    # compiled code takes the arrays as they are
    if metadata.get("sha256") != _digest(arrays, saved):
        raise ValueError(f"{path} is damaged: it is not what was saved")
    different = sorted(name for name in saved.keys() | own.keys() if saved.get(name) != own.get(name))
    if different:
        name = different[0]
        raise ValueError(
            f"{path} is of an estimator with {name} = {saved.get(name)!r}, this one has {own.get(name)!r}: make one with the "
            f"same arguments (different: {', '.join(different)})"
        )
    return arrays


def _digest(arrays: Mapping[str, NDArray[Any]], settings: Any) -> str:
    """Of settings, and names, types, shapes and contents of arrays; between the fields of records lies what nobody wrote."""
    digest, parts = sha256(json.dumps(settings, sort_keys=True).encode()), sorted(arrays.items())
    while parts:
        name, array = parts.pop()
        if array.dtype.names:
            parts += [(f"{name}.{field}", array[field]) for field in array.dtype.names]
        else:
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()
