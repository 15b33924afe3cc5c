"""NASA's own files of battery tests (.mat)."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.files import call_in_process
from battery_env.records.discharge import NASA_CITATION


def read_nasa_mat(path: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the unchecked discharges of one of NASA's own files."""
    content: dict[str, Any] = {}
    try:
        content = call_in_process("scipy.io", "loadmat", str(path), simplify_cells=True)
        ((cell, value),) = ((name, value) for name, value in content.items() if isinstance(value, dict) and "cycle" in value)
        return _samples_of_mat(cell, value)
    except Exception as error:  # scipy raises errors of many types, and any field may be missing
        names = ", ".join(name for name in content if not name.startswith("__"))
        problem = f"one of its variables ({names}) must be a cell with its cycles" if content else error
        raise ValueError(f"the file is damaged, or not laid out as NASA's battery files: {problem}") from error


def _samples_of_mat(cell: str, value: dict[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    tests = [(n, test, _start_time(test["time"])) for n, test in enumerate(np.atleast_1d(value["cycle"]))]
    impedances = [(start, test["data"]) for _, test, start in tests if test["type"] == "impedance"]
    discharges = [entry for entry in tests if entry[1]["type"] == "discharge"]
    samples = []
    for cycle, (n, test, start) in enumerate(discharges, start=1):
        data = test["data"]
        meta = {
            "cell": cell,
            "cycle": cycle,
            "source": NASA_CITATION,
            "test_id": n,
            "start_time": start.isoformat(timespec="milliseconds"),
            "ambient_temperature_C": float(test["ambient_temperature"]),
        }
        if np.size(data.get("Capacity", [])) == 1:
            meta["capacity_Ah"] = float(data["Capacity"])
        if impedances:
            impedance = min(impedances, key=lambda entry: abs(entry[0] - start))[1]
            meta.update(Re_ohm=float(np.real(impedance["Re"])), Rct_ohm=float(np.real(impedance["Rct"])))
        arrays = {
            "time_s": data["Time"],
            "voltage_V": data["Voltage_measured"],
            "current_A": -np.asarray(data["Current_measured"], dtype=np.float64),
            "temperature_C": data["Temperature_measured"],
        }
        samples.append((arrays, meta))
    return samples


def _start_time(date_vector: FloatArray) -> datetime:
    year, month, day, hour, minute, second = map(float, date_vector)
    return datetime(int(year), int(month), int(day)) + timedelta(hours=hour, minutes=minute, seconds=second)
