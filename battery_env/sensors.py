"""Errors of voltage and current sensors, for simulated discharges."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from battery_env.electrochemistry import Trajectory


@dataclass(frozen=True)
class SensorErrors:
    """
    What sensors make of a simulated discharge. A calibrator sees nothing else; state and load remain as they are.

    :param noise_V: standard deviation of white normal noise on the voltage, V
    :param offset_V: constant error of the voltage, V
    :param current_gain: reading of the current sensor per true current; 1.01 reads 1 % too much
    :param current_offset_A: constant error of the current, A
    :raises ValueError: for a value that is not finite, or negative noise, or a gain that is not positive
    """

    noise_V: float = 0.0
    offset_V: float = 0.0
    current_gain: float = 1.0
    current_offset_A: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not np.isfinite(getattr(self, field.name)):
                raise ValueError(f"{field.name} must be finite, got {getattr(self, field.name)!r}")
        if self.noise_V < 0.0:
            raise ValueError(f"noise_V is a standard deviation and must be at least 0 V, got {self.noise_V!r}")
        if self.current_gain <= 0.0:
            raise ValueError(f"current_gain must be greater than 0 (1: exact), got {self.current_gain!r}")

    def draw(self, rng: np.random.Generator) -> SensorErrors:
        """
        The errors of one discharge: these, whatever ``rng``.

        :param rng: source of randomness
        :return: itself
        """
        return self

    def apply(self, trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
        """
        A discharge as the sensors show it.

        :param trajectory: as it is
        :param rng: source of the noise
        :return: the same with measured voltage and current
        """
        noise_V = self.noise_V * rng.standard_normal(len(trajectory.voltage_V))
        return replace(
            trajectory,
            voltage_V=trajectory.voltage_V + self.offset_V + noise_V,
            current_A=self.current_gain * trajectory.current_A + self.current_offset_A,
        )


@dataclass(frozen=True)
class RandomSensorErrors:
    """
    A voltmeter that is another one in each discharge.

    :param noise_V: least and greatest standard deviation of the noise, drawn log-uniformly, V
    :param offset_V: the offset is drawn uniformly within this to either side, V
    :raises ValueError: for values that are not finite, negative, or in the wrong order
    """

    noise_V: tuple[float, float]
    offset_V: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.noise_V[0] <= self.noise_V[1] < np.inf:
            raise ValueError(f"noise_V must be (least, greatest) in V with 0 < least <= greatest, got {self.noise_V!r}")
        if not 0.0 <= self.offset_V < np.inf:
            raise ValueError(f"offset_V must be finite and at least 0 V, got {self.offset_V!r}")

    def draw(self, rng: np.random.Generator) -> SensorErrors:
        """
        The errors of one discharge.

        :param rng: source of randomness
        :return: the errors
        """
        noise_V = float(np.exp(rng.uniform(*np.log(self.noise_V))))
        return SensorErrors(noise_V=noise_V, offset_V=float(rng.uniform(-self.offset_V, self.offset_V)))
