"""Names that have moved to :mod:`battery_env.estimators.diagnosis`."""

from battery_env.estimators.diagnosis import FULL_REST_V, MISMATCH_MARGIN, rest_voltage_V

__all__ = ["FULL_REST_V", "MISMATCH_MARGIN", "rest_voltage_V"]
