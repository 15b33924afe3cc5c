"""The extended Kalman filter: filter.py is what users call, bank.py its filters, and state.py what they remember."""

from battery_env.estimators.kalman.filter import ExtendedKalmanFilter as ExtendedKalmanFilter
