"""
What a voltage says less than the model expects: an error of the model that drifts along the discharge, and white noise. One
likelihood of both, in whose units residuals are independent and of variance one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, hypot, inf, sqrt

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.records import SWITCH_SHARE
from battery_env.records.load import lagged_current_A, switch_time_sd_s, switched_charge

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
    :param memory_C: the charge along which the drift loses its memory
    :param load_on_C: the charge that is in doubt between the first sample, at rest, and the second, under load
    :param dropouts_s: spans of time since the first sample in which the voltage is not that of the current, s
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

    def along(self, time_s: FloatArray, current_A: FloatArray) -> VoltageError:
        """
        The error at samples. At rest the model goes wrong as time goes, as fast as under the mean load; a load that changes by
        its largest current is a whole memory away. While the ohmic drop follows a switch, a share of what is left of it is in
        doubt, and what the moment of the switch, between two samples, makes of it.
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
        way = drawn_C / self.memory_C
        way += np.where(changed_A > SWITCH_SHARE * most_A, changed_A, 0.0) / most_A
        # rows may meet a load that is switched again and again at the same place each time: then these errors go together
        switched = switched_charge(time_s, current_A)
        together = switched.sd_C / switched.independent_sd_C if switched.independent_sd_C else 1.0
        moment_share = np.minimum(together * switch_time_sd_s(interval_s) / self.to, 1.0)
        moment_sd_A = np.where(changed_A > SWITCH_SHARE * most_A, changed_A * moment_share, 0.0)
        # the first sample is at rest, whatever current follows it
        late_A = _LATE_SHARE * (current_A - lagged_current_A(time_s, current_A, self.to))[1:]
        late_V = self.r_o * np.hypot(late_A, _fading(moment_sd_A, np.exp(-interval_s / self.to)))
        return VoltageError(np.append(0.0, way), self.drift_V, np.hypot(noise_V, np.append(0.0, late_V)))


@compiled
def _fading(added: FloatArray, left: FloatArray) -> FloatArray:
    # the standard deviation of errors that are added, of which a share is left from each sample to the next
    total, sds = 0.0, np.empty_like(added)
    for k in range(len(added)):
        total = hypot(left[k] * total, added[k])
        sds[k] = total
    return sds


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
