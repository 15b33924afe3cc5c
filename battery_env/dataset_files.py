"""
Files of data sets: npz, and Parquet for other programs. Each is written beside its place and renamed, so that it is never
there in part.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from battery_env.files import replacing

FORMAT_VERSION = 3


def described(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What goes with the numbers of a data set."""
    versions = {"python": platform.python_version(), "numpy": np.__version__, "numba": version("numba")}
    return {"format": FORMAT_VERSION, **settings, "versions": versions}


def save_npz(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], settings: Mapping[str, Any]) -> Path:
    """Write arrays and settings."""
    target = _new_file(path, ".npz")
    with replacing(target) as part:
        np.savez_compressed(part, allow_pickle=False, metadata=np.array(json.dumps(described(settings))), **arrays)
    return target


def load_npz(path: str | os.PathLike[str], names: Iterable[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what :func:`save_npz` wrote."""
    with Path(path).open("rb") as stream:
        try:
            with np.load(stream, allow_pickle=False) as file:
                if damaged := file.zip.testzip():
                    raise ValueError(f"the checksum of {damaged} is wrong")
                settings = json.loads(str(file["metadata"]))
                found = settings["format"]
                arrays = {name: np.asarray(file[name]) for name in names} if found == FORMAT_VERSION else {}
        except Exception as error:  # numpy and zipfile raise whatever the damage leads them to
            raise ValueError(f"{path} is damaged, or no data set saved by TrajectoryDataset.save: {error}") from error
    if found != FORMAT_VERSION:
        raise ValueError(f"{path} has format {found}, this version reads {FORMAT_VERSION}: generate it again")
    return arrays, settings


def save_parquet(path: str | os.PathLike[str], frame: pd.DataFrame) -> Path:
    """Write a table."""
    target = _new_file(path, ".parquet")
    with replacing(target) as part:
        try:
            frame.to_parquet(part, engine="pyarrow", index=False)
        except ImportError as error:
            raise ImportError("to_parquet needs pyarrow: pip install 'battery_env[parquet]'") from error
    return target


def _new_file(path: str | os.PathLike[str], suffix: str) -> Path:
    target = Path(path)
    target = target if target.suffix == suffix else target.with_name(target.name + suffix)
    if target.exists():
        raise FileExistsError(f"{target} exists already; delete it or choose another name")
    return target
