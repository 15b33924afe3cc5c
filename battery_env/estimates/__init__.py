"""What every calibrator returns, and the findings against it."""

from battery_env.estimates.estimate import Estimate, EstimateTrace, last_estimate
from battery_env.estimates.findings import Finding

__all__ = ["Estimate", "EstimateTrace", "Finding", "last_estimate"]
