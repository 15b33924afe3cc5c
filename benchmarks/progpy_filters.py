"""
The state estimators of NASA's progpy, with one parameter of its battery model as one more state: what its users would take.

They run in Python and take milliseconds a sample.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from matplotlib import rc_context

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import FULL_CHARGE_SHARES, NEW_CELL, QNB, STATE_SIZE, initial_state
from battery_env.estimators.estimator import Estimate, EstimateTrace, Estimator, Record

with rc_context():  # progpy changes the defaults of matplotlib
    from progpy.models import BatteryElectroChemEOD
    from progpy.state_estimators import ParticleFilter, UnscentedKalmanFilter
    from progpy.uncertain_data import MultivariateNormalDist, UnweightedSamples

# Standard deviation of each state at the start beyond what the parameter explains, and a tenth of it per step: enough to keep
# the covariance positive definite. In the units of the states: K, V, C; last that of the parameter.
_STATE_SD = np.array([1e-4, 1e-6, 1e-7, 1e-7, 1e-3, 1e-4, 1e-3, 1e-4])
_PARAMETER_SD = {"q_mobile": 1e-3, "r_o": 1e-7}
# The particles' random walk, per step; without one they all become copies of one of them
_WALK = {"q_mobile": 2.0, "r_o": 1e-4}
_NAMES = {"q_mobile": "qMobile", "r_o": "Ro"}


class BatteryWithUnknown(BatteryElectroChemEOD):
    """progpy's model; one of its parameters is one more state, and the voltage its only output."""

    states = [*BatteryElectroChemEOD.states, "unknown"]  # noqa: RUF012
    outputs = ["v"]  # noqa: RUF012

    def __init__(self, parameter: str, **options: Any) -> None:
        super().__init__(**options)
        self.inner = BatteryElectroChemEOD(process_noise=0, measurement_noise=0)
        self.parameter = parameter

    def _with(self, x: Any) -> Any:
        unknown = np.asarray(x["unknown"], dtype=np.float64)
        if self.parameter == "q_mobile":
            # all that the equations take from it; setting qMobile itself would change the initial state too
            self.inner.parameters["qSMax"] = unknown / 0.6 * self.inner.parameters["VolSFraction"]
        else:
            self.inner.parameters["Ro"] = unknown
        return self.inner.StateContainer(np.asarray(x.matrix, dtype=np.float64)[:STATE_SIZE])

    def next_state(self, x: Any, u: Any, dt: float) -> Any:
        moved = self.inner.next_state(self._with(x), u, dt).matrix
        return self.StateContainer(np.vstack([moved, np.asarray(x.matrix)[STATE_SIZE:]]).astype(np.float64))

    def output(self, x: Any) -> Any:
        return self.OutputContainer(np.asarray(self.inner.output(self._with(x)).matrix)[1:])


class ProgpyFilter(Estimator):
    """One of progpy's state estimators on the voltage of a discharge of a full cell, new but for one parameter (C or ohm)."""

    def __init__(self, parameter: str, kind: Literal["ukf", "particles"], prior_sd: float, voltage_noise_V: float) -> None:
        self.parameter = parameter
        self.kind = kind
        self.prior_sd = prior_sd
        self.voltage_noise_V = voltage_noise_V

    def estimate(self, record: Record) -> Estimate:
        """The estimate at the last sample of a record."""
        trace = self.trace([record])[0]
        return Estimate(float(trace.q_mobile[-1]), float(trace.r_o[-1]))

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """One estimate for every sample but the first of many discharges."""
        traces = []
        for record in records:
            values: dict[str, Any] = {name: np.full(len(record.time_s) - 1, getattr(NEW_CELL, name)) for name in _NAMES}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                values[self.parameter] = self._run(record)
            traces.append(EstimateTrace(time_s=record.time_s[1:], **values))
        return traces

    def _run(self, record: Record) -> FloatArray:
        noise = dict.fromkeys(BatteryWithUnknown.states, 0.0)
        if self.kind == "particles":
            noise["unknown"] = _WALK[self.parameter]
        model = BatteryWithUnknown(self.parameter, process_noise=noise, measurement_noise=0)
        state = np.append(initial_state(NEW_CELL.q_mobile), getattr(NEW_CELL, self.parameter))
        slope = np.zeros(STATE_SIZE + 1)
        slope[-1] = 1.0
        if self.parameter == "q_mobile":
            slope[QNB:STATE_SIZE] = FULL_CHARGE_SHARES
        start_s = -1e-9  # progpy wants time to move on before the first measurement
        if self.kind == "ukf":
            jitter = np.diag(np.append(_STATE_SD, _PARAMETER_SD[self.parameter]) ** 2)
            x0 = MultivariateNormalDist(model.states, state, self.prior_sd**2 * np.outer(slope, slope) + jitter)
            ukf = UnscentedKalmanFilter(
                model, x0, alpha=0.3, beta=2.0, kappa=0.0, Q=0.01 * jitter, R=np.array([[self.voltage_noise_V**2]]), t0=start_s
            )
            estimator: Any = ukf
        else:
            np.random.seed(0)  # progpy draws from numpy's global generator
            draws = self.prior_sd * np.random.default_rng(0).standard_normal((100, 1))
            particles = np.maximum(state + draws * slope, 1e-3)
            x0 = UnweightedSamples([dict(zip(model.states, particle, strict=True)) for particle in particles])
            estimator = ParticleFilter(model, x0, measurement_noise={"v": self.voltage_noise_V}, t0=start_s)
        estimates = np.full(len(record.time_s) - 1, np.nan)
        for k in range(1, len(record.time_s)):
            current, volts = {"i": record.current_A[k - 1]}, {"v": record.voltage_V[k]}
            try:
                estimator.estimate(float(record.time_s[k] - record.time_s[0]), current, volts)
            except (np.linalg.LinAlgError, ValueError):  # a covariance that is none, or particles without a voltage
                break
            estimates[k - 1] = ukf.filter.x[-1] if self.kind == "ukf" else np.mean(estimator.particles["unknown"])
        return estimates
