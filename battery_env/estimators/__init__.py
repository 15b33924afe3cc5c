"""Calibration without learning."""

from battery_env.estimators.base import Estimate, EstimateTrace, Estimator, Record
from battery_env.estimators.closed_form import ClosedForm
from battery_env.estimators.least_squares import LeastSquares

__all__ = ["ClosedForm", "Estimate", "EstimateTrace", "Estimator", "LeastSquares", "Record"]
