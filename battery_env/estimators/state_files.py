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

FORMAT_VERSION = 9
_KIND = "state of an estimator"


class Saved:
    """What can be written to a file in the middle of a discharge: an estimator, or many of them side by side."""

    def _made_with(self) -> dict[str, Any]:
        """What it was made with, as JSON may hold it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be saved")

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """What it knows of the discharge, by name."""
        raise NotImplementedError(f"{type(self).__name__} cannot be saved")

    def _restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take :meth:`_arrays` for its own."""
        for own, saved in [(own, arrays[name]) for name, own in self._arrays().items()]:
            own[...] = saved

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write what is known of the discharge to a file, from which another estimator with the same arguments goes on.

        :param path: where to; ``.npz`` is added if it is missing. An older state there is replaced, any other file is not
        :raises FileExistsError: if there is another file
        """
        target, settings, arrays = npz_path(path), self._made_with(), self._arrays()
        if target.exists():
            try:
                read_npz(target, _KIND)
            except DamagedError as error:
                warnings.warn(f"{error}. It is kept as {set_aside(target).name}, and a new one takes its place.", stacklevel=2)
            except ValueError as error:
                raise FileExistsError(f"{target} exists, and is no state of an estimator: choose another name") from error
        told = {"kind": _KIND, "format": FORMAT_VERSION, "settings": settings, "sha256": _digest(arrays, settings)}
        with replacing(target) as part:
            np.savez(part, metadata=np.array(json.dumps(told)), **arrays)  # type: ignore[arg-type]  # none: allow_pickle
        return target

    def load(self, path: str | os.PathLike[str]) -> None:
        """
        Go on from what :meth:`save` wrote.

        :param path: the file
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if it is damaged, of another version, or of an estimator with other arguments; this one is as it
            was then
        """
        own = json.loads(json.dumps(self._made_with()))
        arrays, metadata = read_npz(path, _KIND)
        if metadata["format"] != FORMAT_VERSION:
            raise ValueError(
                f"{path} has format {metadata['format']}, this version reads {FORMAT_VERSION}: begin a discharge anew"
            )
        saved: Any = metadata.get("settings")
        # compiled code takes the arrays as they are
        if metadata.get("sha256") != _digest(arrays, saved):
            raise ValueError(f"{path} is damaged: it is not what was saved")
        different = sorted(name for name in saved.keys() | own.keys() if saved.get(name) != own.get(name))
        if different:
            name = different[0]
            raise ValueError(
                f"{path} is of an estimator with {name} = {saved.get(name)!r}, this one has {own.get(name)!r}: make one with "
                f"the same arguments (different: {', '.join(different)})"
            )
        self._restore(arrays)


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
