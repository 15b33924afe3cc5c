"""What every benchmark writes: tables with the configuration and the versions that made them beside them."""

from __future__ import annotations

import json
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pandas as pd

import battery_env
import sb3_lac
from battery_env.files import replacing

_PACKAGES = ("torch", "stable_baselines3", "gymnasium", "numpy", "numba", "scipy", "pandas", "rl_zoo3", "progpy")


def versions() -> dict[str, str]:
    """
    The versions that a result depends on.

    :return: by package, with Python and the processor
    """
    found = {"sb3_lac": sb3_lac.__version__, "battery_env": battery_env.__version__}
    found |= {"python": platform.python_version(), "processor": platform.machine()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def write_text(path: Path, text: str) -> None:
    """
    Write a file beside its place and rename it, so that it is never there in part.

    :param path: where to
    :param text: its contents
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def write_csv(path: Path, table: pd.DataFrame, configuration: dict[str, Any]) -> None:
    """
    Write a table as CSV, and beside it as JSON what made it: command, configuration, versions.

    :param path: where to, ``.csv``
    :param table: the table
    :param configuration: what the caller chose
    """
    record: dict[str, Any] = {"command": f"python -m benchmarks.{Path(sys.argv[0]).stem} {' '.join(sys.argv[1:])}".strip()}
    record |= {"configuration": configuration, "versions": versions()}
    write_text(path.with_suffix(".json"), json.dumps(record, indent=2, default=str) + "\n")
    write_text(path, table.to_csv(index=False, float_format="%.6g"))
