"""
Calibration of Li-ion battery models: the plant, its data, the tasks, and the calibrators that need no learning.

Importing this package registers the environments and loads nothing else: each name below is imported when it is first used.
"""

# ruff: noqa: F401

from importlib import import_module
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from battery_env.tasks.registration import register_environments

if TYPE_CHECKING:
    from battery_env.electrochemistry import NEW_CELL, CellParameters, Trajectory, initial_state, simulate, step, voltage
    from battery_env.electrochemistry.aging_path import AgingPath
    from battery_env.estimates import Estimate
    from battery_env.estimators import (
        CellFit,
        ClosedForm,
        Estimator,
        LeastSquares,
        cramer_rao_bound,
        fit_cell,
        fit_life,
        soc_from_rest,
    )
    from battery_env.evaluation import evaluate
    from battery_env.lab.calibrate import calibrate
    from battery_env.lab.forecast import Forecast, forecast
    from battery_env.lab.life import Life, track_life
    from battery_env.lab.readers.discharges import read_discharge_csv, read_discharges
    from battery_env.lab.report import Calibration
    from battery_env.lab.settings import Settings
    from battery_env.policies.onnx import OnnxPolicy
    from battery_env.policies.policy_estimator import PolicyEstimator
    from battery_env.records.discharge import Discharge, load_nasa_discharges
    from battery_env.records.model import RecordModel
    from battery_env.sensors import RandomSensorErrors, SensorErrors
    from battery_env.trajectories import TrajectoryDataset

# Where each name comes from: numba, pandas and scipy take seconds to import, and an environment by its id needs none of them.
# Type checkers see the imports above instead; a test holds the two together.
_MODULES = {
    "electrochemistry": ("NEW_CELL", "CellParameters", "Trajectory", "initial_state", "simulate", "step", "voltage"),
    "electrochemistry.aging_path": ("AgingPath",),
    "estimates": ("Estimate",),
    "estimators": (
        *("CellFit", "ClosedForm", "Estimator", "LeastSquares"),
        *("cramer_rao_bound", "fit_cell", "fit_life", "soc_from_rest"),
    ),
    "evaluation": ("evaluate",),
    "lab.calibrate": ("calibrate",),
    "lab.forecast": ("Forecast", "forecast"),
    "lab.life": ("Life", "track_life"),
    "lab.readers.discharges": ("read_discharge_csv", "read_discharges"),
    "lab.report": ("Calibration",),
    "lab.settings": ("Settings",),
    "policies.policy_estimator": ("PolicyEstimator",),
    "policies.onnx": ("OnnxPolicy",),
    "records.discharge": ("Discharge", "load_nasa_discharges"),
    "records.model": ("RecordModel",),
    "sensors": ("RandomSensorErrors", "SensorErrors"),
    "trajectories": ("TrajectoryDataset",),
}
_MODULE_OF = {name: f"battery_env.{module}" for module, names in _MODULES.items() for name in names}

__version__ = files("battery_env").joinpath("version.txt").read_text(encoding="utf-8").strip()
__all__ = sorted([*_MODULE_OF, "register_environments"])


if not TYPE_CHECKING:  # a type checker would take every name for one that exists

    def __getattr__(name: str) -> Any:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
