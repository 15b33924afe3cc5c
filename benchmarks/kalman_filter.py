"""
A plain extended Kalman filter on the model of ``battery_env``, as textbooks have it: a baseline beside least squares and
policies.

One filter with one prior, no second order, no gate and no verdict. It takes what the model does not explain for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.electrochemistry import (
    QNB,
    QNS,
    QPS,
    STATE_SIZE,
    CellParameters,
    PackedConstants,
    check_cell,
    check_dt,
    initial_state,
    rest_shares,
)
from battery_env.electrochemistry.kernels import MOLE_FRACTION_MARGIN, cell_voltage
from battery_env.electrochemistry.tangents import (
    BY_Q,
    BY_R,
    PolynomialDerivatives,
    least_q,
    step_with_tangents,
    voltage_tangents,
)
from battery_env.estimates import Estimate, Finding
from battery_env.estimators.estimator import OnlineEstimator
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, R_O, check_parameters
from battery_env.records import check_sample

#: Standard deviations before a discharge: of ``q_mobile`` as a share of the cell's, of ``r_o`` (ohm), and of an offset (V).
PRIOR_SD_SHARE_Q, PRIOR_SD_R_OHM, OFFSET_SD_V = 0.25, 0.15, 0.005
_NO_VERDICT = (Finding("other", measured={"message": "This filter has no verdict."}),)


class PlainKalmanFilter(OnlineEstimator):
    """
    Follows ``q_mobile``, ``r_o`` and an offset of the voltage along a discharge of a cell that was full and at rest; the state
    is a function of these, and moves along with them by its tangents.
    """

    def __init__(
        self,
        parameters: Sequence[str] = PARAMETER_NAMES,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        voltage_noise_V: float = 0.005,
        prior_q_mobile_C: tuple[float, float] | None = None,
        prior_r_o_ohm: tuple[float, float] | None = None,
    ) -> None:
        self.parameters = check_parameters(parameters)
        self.cell, self.thermal = check_cell(cell, thermal), thermal
        self.dt_s, self.voltage_noise_V = check_dt(dt_s, self.cell), voltage_noise_V
        q_mobile, sd_q = prior_q_mobile_C or (self.cell.q_mobile, PRIOR_SD_SHARE_Q * self.cell.q_mobile)
        r_o, sd_r_o = prior_r_o_ohm or (self.cell.r_o, PRIOR_SD_R_OHM)
        sd_q, sd_r_o = sd_q * ("q_mobile" in self.parameters), sd_r_o * ("r_o" in self.parameters)
        self._prior = np.array([q_mobile, r_o, 0.0]), np.diag(np.square([sd_q, sd_r_o, OFFSET_SD_V]))
        self._derivatives = PolynomialDerivatives.of(self.cell.packed)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._before_A: float | None = None
        self._mean, self._covariance = (each.copy() for each in self._prior)
        self._state, self._tangents = np.zeros((1, STATE_SIZE)), np.zeros((1, 2, STATE_SIZE))
        self._state[0] = initial_state(self._mean[0], self.cell)
        self._tangents[0, BY_Q, QNB:] = rest_shares(1.0)

    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """Take in one sample; a temperature counts for nothing."""
        check_sample(voltage_V, current_A, dt_s, temperature_C, self._before_A)
        _take(
            (self._state, self._tangents, self._mean, self._covariance),
            (voltage_V, self._before_A or 0.0, 0.0 if self._before_A is None else dt_s),
            (self.dt_s, self.thermal, self.voltage_noise_V**2),
            (Q_MOBILE.limits, R_O.limits),
            self.cell.packed,
            self._derivatives,
        )
        self._before_A = current_A
        (q_mobile, r_o, _), (sd_q, sd_r_o, _) = self._mean.tolist(), np.sqrt(np.diag(self._covariance)).tolist()
        return Estimate(q_mobile, r_o, sd_q, sd_r_o, settled=False, findings=_NO_VERDICT)


@compiled
def _move(state: FloatArray, tangents: FloatArray, mean: FloatArray, q_change: float, r_change: float) -> None:
    for j in range(STATE_SIZE):
        state[0, j] += tangents[0, BY_Q, j] * q_change + tangents[0, BY_R, j] * r_change
    mean[0] += q_change
    mean[1] += r_change


@compiled
def _take(
    filter_: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    sample: tuple[float, float, float],
    known: tuple[float, bool, float],
    bounds: tuple[tuple[float, float], tuple[float, float]],
    packed: PackedConstants,
    derivatives: PolynomialDerivatives,
) -> None:
    # one step of the model and one measurement; where no cell of the least q_mobile has a voltage, the estimate stays
    (state, tangents, mean, covariance), (voltage, current, duration), (dt_s, thermal, noise_V2) = filter_, sample, known
    steps = int(np.ceil(duration / dt_s - 1e-6))
    for _ in range(steps):
        q, r_o = mean[0], mean[1]
        step_with_tangents(state, tangents, current, q, r_o, duration / steps, thermal, True, packed.constants)
    for surface in (QNS, QPS):
        least = least_q(state[0, surface], tangents[0, BY_Q, surface], mean[0], MOLE_FRACTION_MARGIN, packed.constants)
        if least > mean[0]:
            if covariance[0, 0] == 0.0:
                return
            _move(state, tangents, mean, least - mean[0], 0.0)
    if isnan(voltage):
        return
    by_q, by_r = voltage_tangents(state, tangents, mean[0], thermal, packed, derivatives)
    slopes = np.array([by_q, by_r, 1.0])
    explained = covariance @ slopes
    gain = explained / (slopes @ explained + noise_V2)
    innovation = voltage - cell_voltage(state, 0, mean[0], True, packed) - mean[2]
    # Joseph's form, which stays positive
    reduction = np.eye(3) - np.outer(gain, slopes)
    covariance[:] = reduction @ covariance @ reduction.T + noise_V2 * np.outer(gain, gain)
    to_q = min(max(mean[0] + gain[0] * innovation, bounds[0][0]), bounds[0][1])
    to_r_o = min(max(mean[1] + gain[1] * innovation, bounds[1][0]), bounds[1][1])
    mean[2] += gain[2] * innovation
    _move(state, tangents, mean, to_q - mean[0], to_r_o - mean[1])
