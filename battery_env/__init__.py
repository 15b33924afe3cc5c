"""
Calibration of Li-ion battery models: the plant, its data, the tasks, and the calibrators that need no learning.

Importing this package registers the environments and loads nothing else: each name below is imported when it is first used.
"""

from importlib import import_module
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from battery_env.calibration.registration import register_environments

if TYPE_CHECKING:
    from battery_env.calibration.onnx_policy import OnnxPolicy
    from battery_env.calibration.policy import PolicyEstimator
    from battery_env.cells import Discharge, load_nasa_discharges, read_discharge_csv
    from battery_env.electrochemistry import NEW_CELL, CellParameters, Trajectory, initial_state, simulate, step, voltage
    from battery_env.estimates import Estimate
    from battery_env.estimators import (
        CellFit,
        ClosedForm,
        Estimator,
        ExtendedKalmanFilter,
        GreedyOneStep,
        LeastSquares,
        cramer_rao_bound,
        fit_cell,
        soc_from_rest,
    )
    from battery_env.evaluation import evaluate
    from battery_env.forecasts import Forecast, forecast
    from battery_env.life import Life, track_life
    from battery_env.record_files import read_discharges
    from battery_env.record_model import RecordModel
    from battery_env.sensors import RandomSensorErrors, SensorErrors
    from battery_env.trajectories import TrajectoryDataset

# Where each name comes from: numba, pandas and scipy take seconds to import, and an environment by its id needs none of them
_MODULES = {
    "NEW_CELL": "battery_env.electrochemistry",
    "CellFit": "battery_env.estimators",
    "CellParameters": "battery_env.electrochemistry",
    "ClosedForm": "battery_env.estimators",
    "Discharge": "battery_env.cells",
    "Estimate": "battery_env.estimates",
    "Estimator": "battery_env.estimators",
    "ExtendedKalmanFilter": "battery_env.estimators",
    "Forecast": "battery_env.forecasts",
    "GreedyOneStep": "battery_env.estimators",
    "LeastSquares": "battery_env.estimators",
    "Life": "battery_env.life",
    "OnnxPolicy": "battery_env.calibration.onnx_policy",
    "PolicyEstimator": "battery_env.calibration.policy",
    "RandomSensorErrors": "battery_env.sensors",
    "RecordModel": "battery_env.record_model",
    "SensorErrors": "battery_env.sensors",
    "Trajectory": "battery_env.electrochemistry",
    "TrajectoryDataset": "battery_env.trajectories",
    "cramer_rao_bound": "battery_env.estimators",
    "evaluate": "battery_env.evaluation",
    "fit_cell": "battery_env.estimators",
    "forecast": "battery_env.forecasts",
    "initial_state": "battery_env.electrochemistry",
    "load_nasa_discharges": "battery_env.cells",
    "read_discharge_csv": "battery_env.cells",
    "read_discharges": "battery_env.record_files",
    "simulate": "battery_env.electrochemistry",
    "soc_from_rest": "battery_env.estimators",
    "step": "battery_env.electrochemistry",
    "track_life": "battery_env.life",
    "voltage": "battery_env.electrochemistry",
}

__version__ = files("battery_env").joinpath("version.txt").read_text(encoding="utf-8").strip()

__all__ = [
    "NEW_CELL",
    "CellFit",
    "CellParameters",
    "ClosedForm",
    "Discharge",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "Forecast",
    "GreedyOneStep",
    "LeastSquares",
    "Life",
    "OnnxPolicy",
    "PolicyEstimator",
    "RandomSensorErrors",
    "RecordModel",
    "SensorErrors",
    "Trajectory",
    "TrajectoryDataset",
    "cramer_rao_bound",
    "evaluate",
    "fit_cell",
    "forecast",
    "initial_state",
    "load_nasa_discharges",
    "read_discharge_csv",
    "read_discharges",
    "register_environments",
    "simulate",
    "soc_from_rest",
    "step",
    "track_life",
    "voltage",
]


if not TYPE_CHECKING:  # a type checker would take every name for one that exists

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_MODULES[name]), name)
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
