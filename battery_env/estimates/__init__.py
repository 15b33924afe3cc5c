"""Estimates, the results of calibrators, and the findings against them."""

from battery_env.estimates.estimate import Estimate, EstimateTrace, last_estimate
from battery_env.estimates.findings import Finding

__all__ = ["Estimate", "EstimateTrace", "Finding", "last_estimate"]
