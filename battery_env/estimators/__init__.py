"""Calibration without learning."""

from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.cell_fit import CellFit
from battery_env.estimators.closed_form import ClosedForm
from battery_env.estimators.cramer_rao import CramerRaoBound, Sensitivities, cramer_rao_bound, sensitivities
from battery_env.estimators.diagnosis.rest import soc_from_rest
from battery_env.estimators.estimator import Estimator, OnlineEstimator, Remaining
from battery_env.estimators.fit_life import fit_life
from battery_env.estimators.greedy import GreedyOneStep
from battery_env.estimators.joint_fit import fit_cell
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares

__all__ = [
    "CellFit",
    "ClosedForm",
    "CramerRaoBound",
    "Estimate",
    "EstimateTrace",
    "Estimator",
    "ExtendedKalmanFilter",
    "GreedyOneStep",
    "LeastSquares",
    "OnlineEstimator",
    "Remaining",
    "Sensitivities",
    "cramer_rao_bound",
    "fit_cell",
    "fit_life",
    "sensitivities",
    "soc_from_rest",
]
