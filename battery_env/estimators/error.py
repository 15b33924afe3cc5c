"""
What a voltage says less than the model expects: an error of the model that drifts along the discharge, and white noise. One
likelihood of both, in whose units residuals are independent and of variance one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, expm1, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.electrochemistry.model_error import memory_share
from battery_env.records import SWITCH_SHARE

# Real ohmic drops follow a current at once in part, where that of the model lags: this share of what lags is in doubt.
_LATE_SHARE = 0.1


@dataclass(frozen=True)
class VoltageError:
    """
    The error of a voltage: a drift with one standard deviation, which loses its memory along the charge drawn and where the
    load changes (an Ornstein-Uhlenbeck process), and white noise.

    :param way: how far each sample lies from the one before, in memories of the drift, shape (T,)
    :param drift_V: standard deviation of the drift; 0: the voltage has noise alone
    :param noise_V: standard deviation of the noise, shape (T,)
    """

    way: FloatArray
    drift_V: float
    noise_V: FloatArray

    def whitened(self, rows: FloatArray) -> FloatArray:
        """
        Make errors independent, and of variance one; linear in them.

        :param rows: errors, or what they depend on, V, shape (T, columns)
        :return: the same, without a unit, shape (T, columns)
        """
        if self.drift_V == 0.0:
            return rows / self.noise_V[:, None]
        return _innovations(np.ascontiguousarray(rows), self.way, self.drift_V, self.noise_V)


@dataclass(frozen=True)
class ErrorModel:
    """
    What error the voltage of a cell is expected to have.

    :param drift_V: standard deviation of the drift; 0: the model is exact
    :param noise_V: standard deviation of the noise of the sensor
    :param r_o: the ohmic resistance, which follows its current late, ohm
    :param to: how late, s
    :param load_on_C: the charge that is in doubt between the first sample, at rest, and the second, under load
    """

    drift_V: float = 0.0
    noise_V: float = 1.0
    r_o: float = 0.0
    to: float = 1.0
    load_on_C: float = 0.0

    def along(self, time_s: FloatArray, current_A: FloatArray, q_mobile_C: float) -> VoltageError:
        """
        The error at samples of a cell with some ``q_mobile``. At rest the model goes wrong as time goes, as fast as under the
        mean load; a load that changes by its largest current is a whole memory away. While the ohmic drop follows a switch, a
        share of what is left of it is in doubt.
        """
        noise_V = np.full(len(time_s), self.noise_V)
        if self.drift_V == 0.0:
            return VoltageError(np.zeros(len(time_s)), 0.0, noise_V)
        size_A, interval_s = np.abs(current_A), np.diff(time_s)
        most_A = max(float(size_A.max()), np.finfo(np.float64).tiny)
        drawn_C = interval_s * np.maximum(size_A[:-1], size_A.mean())
        drawn_C[:1] += self.load_on_C
        changed_A = np.abs(np.diff(current_A))
        way = drawn_C / (memory_share("forecast") * q_mobile_C)
        way += np.where(changed_A > SWITCH_SHARE * most_A, changed_A, 0.0) / most_A
        late_V = _LATE_SHARE * self.r_o * _late_A(interval_s, current_A, self.to)
        return VoltageError(np.append(0.0, way), self.drift_V, np.hypot(noise_V, late_V))


@compiled
def _late_A(interval_s: FloatArray, current_A: FloatArray, to: float) -> FloatArray:
    # the part of the current that the ohmic drop has yet to follow, after a first sample at rest
    late_A, followed_A = np.zeros_like(current_A), 0.0
    for k in range(1, len(current_A)):
        followed_A -= (current_A[k - 1] - followed_A) * expm1(-interval_s[k - 1] / to)
        late_A[k] = current_A[k] - followed_A
    return late_A


@compiled
def _innovations(rows: FloatArray, way: FloatArray, drift_V: float, noise_V: FloatArray) -> FloatArray:
    # a Kalman filter whose only state is the drift: what each row tells beyond the rows before
    white, expected_V, variance_V2 = np.empty_like(rows), np.zeros(rows.shape[1]), drift_V**2
    for k in range(len(rows)):
        kept = exp(-way[k])
        variance_V2 = drift_V**2 + kept * kept * (variance_V2 - drift_V**2)
        total_V2 = variance_V2 + noise_V[k] ** 2
        gain, sd_V = variance_V2 / total_V2, sqrt(total_V2)
        for column in range(rows.shape[1]):
            expected_V[column] *= kept
            innovation_V = rows[k, column] - expected_V[column]
            expected_V[column] += gain * innovation_V
            white[k, column] = innovation_V / sd_V
        variance_V2 *= 1.0 - gain
    return white
