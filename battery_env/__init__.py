"""Calibration of Li-ion battery models: the plant, its data, the tasks, and the calibrators that need no learning."""

from importlib.resources import files as _files

from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.registration import register_environments
from battery_env.cells import Discharge, load_nasa_discharges, read_discharge_csv
from battery_env.electrochemistry import NEW_CELL, CellParameters, Trajectory, initial_state, simulate, step, voltage
from battery_env.estimators import (
    ClosedForm,
    Estimate,
    Estimator,
    ExtendedKalmanFilter,
    GreedyOneStep,
    LeastSquares,
    cramer_rao_bound,
)
from battery_env.evaluation import evaluate
from battery_env.sensors import RandomSensorErrors, SensorErrors
from battery_env.trajectories import TrajectoryDataset

__version__ = _files("battery_env").joinpath("version.txt").read_text(encoding="utf-8").strip()

__all__ = [
    "NEW_CELL",
    "CellParameters",
    "ClosedForm",
    "Discharge",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "GreedyOneStep",
    "LeastSquares",
    "PolicyEstimator",
    "RandomSensorErrors",
    "SensorErrors",
    "Trajectory",
    "TrajectoryDataset",
    "cramer_rao_bound",
    "evaluate",
    "initial_state",
    "load_nasa_discharges",
    "read_discharge_csv",
    "register_environments",
    "simulate",
    "step",
    "voltage",
]

register_environments()
