"""Files of what an estimator knows in the middle of a discharge, so that a program can stop and go on: no pickle."""

from __future__ import annotations

import json
import os
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.files import replacing

FORMAT_VERSION = 10
# A file is a line of JSON that begins like this, arrays as numpy writes them, and the SHA-256 of both.
_BEGINNING = '{"kind": "state of an estimator"'
_DIGEST_SIZE = sha256().digest_size


class Saved:
    """What can be written to a file in the middle of a discharge."""

    def _made_with(self) -> dict[str, Any]:
        """What it was made with, as JSON may hold it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be saved")

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """What it knows of the discharge, by name."""
        raise NotImplementedError(f"{type(self).__name__} cannot be saved")

    def _restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take :meth:`_arrays` of another one for its own."""
        for name, array in self._arrays().items():
            array[...] = arrays[name]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write what is known of the discharge to a file, from which another estimator with the same arguments goes on.

        :param path: where to. An older state there is replaced, any other file is not
        :raises FileExistsError: if there is another file
        """
        target, arrays = Path(path), BytesIO()
        if target.exists():
            with target.open("rb") as stream:
                if stream.read(len(_BEGINNING)) != _BEGINNING.encode():
                    raise FileExistsError(f"{target} exists, and is no state of an estimator: choose another name")
        np.savez(arrays, allow_pickle=False, **self._arrays())
        described = f'{_BEGINNING}, "format": {FORMAT_VERSION}, "settings": {json.dumps(self._made_with())}}}\n'
        content = described.encode() + arrays.getvalue()
        with replacing(target) as file:
            file.write_bytes(content + sha256(content).digest())
        return target

    def load(self, path: str | os.PathLike[str]) -> None:
        """
        Go on from what :meth:`save` wrote.

        :param path: the file
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if it is damaged, of another version, or of an estimator with other arguments; this one is as it
            was then
        """
        data = Path(path).read_bytes()
        content, digest = data[:-_DIGEST_SIZE], data[-_DIGEST_SIZE:]
        if not content.startswith(_BEGINNING.encode()) or sha256(content).digest() != digest:
            raise ValueError(f"{path} is damaged, or no state of an estimator: it is not what was saved")
        line, _, arrays = content.partition(b"\n")
        described = json.loads(line)
        if described["format"] != FORMAT_VERSION:
            raise ValueError(
                f"{path} has format {described['format']}, this version reads {FORMAT_VERSION}: begin a discharge anew"
            )
        saved, own = described["settings"], json.loads(json.dumps(self._made_with()))
        different = sorted(name for name in saved.keys() | own.keys() if saved.get(name) != own.get(name))
        if different:
            name = different[0]
            raise ValueError(
                f"{path} is of an estimator with {name} = {saved.get(name)!r}, this one has {own.get(name)!r}: make one with "
                f"the same arguments (different: {', '.join(different)})"
            )
        with np.load(BytesIO(arrays), allow_pickle=False) as archive:
            self._restore(dict(archive))
