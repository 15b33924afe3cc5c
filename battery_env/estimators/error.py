"""
The error of a modelled voltage: a drift of the model along the discharge, and white noise of the sensor. One likelihood of
both makes residuals independent, and of variance one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, hypot, inf, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.records import SWITCH_SHARE
from battery_env.records.load import lagged_current_A, switch_time_sd_s, switched_charge

# A part of a real ohmic drop follows the current at once, where the drop of the model lags: the standard deviation of the lag,
# as a share of it.
_LATE_SHARE = 0.1


@dataclass(frozen=True)
class VoltageError:
    """
    The error of a voltage: a drift with one standard deviation, which loses its memory along the charge drawn and where the
    load changes (an Ornstein-Uhlenbeck process), and white noise.

    :param correlation_lengths: distance to the previous sample in correlation lengths of the drift, shape (T,)
    :param drift_V: standard deviation of the drift; 0: the voltage has noise alone
    :param noise_V: standard deviation of the noise, shape (T,)
    """

    correlation_lengths: FloatArray
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
        return _innovations(np.ascontiguousarray(rows), self.correlation_lengths, self.drift_V, self.noise_V)


@dataclass(frozen=True)
class ErrorModel:
    """
    The expected error of the voltage of a cell.

    :param drift_V: standard deviation of the drift; 0: the model is exact
    :param noise_V: standard deviation of the noise of the sensor
    :param r_o: the ohmic resistance, ohm
    :param to: time constant with which the ohmic drop follows the current, s
    :param memory_C: correlation length of the drift, as a charge
    :param load_on_C: uncertainty of the charge between the first sample, at rest, and the second sample, under load
    :param dropouts_s: spans of time since the first sample in which the voltage does not belong to the current, s
    :param first_noise_V: the noise of the first sample; ``None``: as of all samples
    """

    drift_V: float = 0.0
    noise_V: float = 1.0
    r_o: float = 0.0
    to: float = 1.0
    memory_C: float = 1.0
    load_on_C: float = 0.0
    dropouts_s: tuple[tuple[float, float], ...] = ()
    first_noise_V: float | None = None

    def drift_after_V(self, charge_C: float) -> float:
        """Standard deviation of the change of the drift over a charge, V."""
        return self.drift_V * sqrt(2.0 * (1.0 - exp(-charge_C / self.memory_C)))

    def along(self, time_s: FloatArray, current_A: FloatArray) -> VoltageError:
        """
        The error at samples. At rest the drift goes on with time, as fast as under the mean load. A change of the load by its
        largest current counts as one correlation length. While the ohmic drop follows a switch, two errors add to the noise: a
        share of the drop that is still missing, and the unknown moment of the switch between two samples.
        """
        noise_V = np.full(len(time_s), self.noise_V)
        if self.first_noise_V is not None:
            noise_V[0] = self.first_noise_V
        for begin_s, end_s in self.dropouts_s:
            noise_V[(time_s >= begin_s) & (time_s < end_s)] = inf
        if self.drift_V == 0.0:
            return VoltageError(np.zeros(len(time_s)), 0.0, noise_V)
        size_A, interval_s = np.abs(current_A), np.diff(time_s)
        most_A = max(float(size_A.max()), np.finfo(np.float64).tiny)
        drawn_C = interval_s * np.maximum(size_A[:-1], size_A.mean())
        drawn_C[:1] += self.load_on_C
        changed_A = np.abs(np.diff(current_A))
        lengths = drawn_C / self.memory_C
        lengths += np.where(changed_A > SWITCH_SHARE * most_A, changed_A, 0.0) / most_A
        # rows may meet a load that is switched again and again at the same place each time: then these errors go together
        switched = switched_charge(time_s, current_A)
        together = switched.sd_C / switched.independent_sd_C if switched.independent_sd_C else 1.0
        moment_share = np.minimum(together * switch_time_sd_s(interval_s) / self.to, 1.0)
        moment_sd_A = np.where(changed_A > SWITCH_SHARE * most_A, changed_A * moment_share, 0.0)
        # the first sample is at rest, whatever current follows it
        late_A = _LATE_SHARE * (current_A - lagged_current_A(time_s, current_A, self.to))[1:]
        late_V = self.r_o * np.hypot(late_A, _fading(moment_sd_A, np.exp(-interval_s / self.to)))
        return VoltageError(np.append(0.0, lengths), self.drift_V, np.hypot(noise_V, np.append(0.0, late_V)))


@compiled
def _fading(added: FloatArray, remaining_share: FloatArray) -> FloatArray:
    # the standard deviation of errors that are added, and decay to a share of them from each sample to the next
    total, sds = 0.0, np.empty_like(added)
    for k in range(len(added)):
        total = hypot(remaining_share[k] * total, added[k])
        sds[k] = total
    return sds


@compiled
def _innovations(rows: FloatArray, lengths: FloatArray, drift_V: float, noise_V: FloatArray) -> FloatArray:
    # the normalized innovations of a Kalman filter whose only state is the drift
    white, expected_V, variance_V2 = np.empty_like(rows), np.zeros(rows.shape[1]), drift_V**2
    for k in range(len(rows)):
        correlation = exp(-lengths[k])
        variance_V2 = drift_V**2 + correlation * correlation * (variance_V2 - drift_V**2)
        total_V2 = variance_V2 + noise_V[k] ** 2
        gain, sd_V = variance_V2 / total_V2, sqrt(total_V2)
        for column in range(rows.shape[1]):
            expected_V[column] *= correlation
            innovation_V = rows[k, column] - expected_V[column]
            expected_V[column] += gain * innovation_V
            white[k, column] = innovation_V / sd_V
        variance_V2 *= 1.0 - gain
    return white
