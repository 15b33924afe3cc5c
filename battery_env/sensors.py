"""Errors of voltage and current sensors, for training and evaluation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import Trajectory


@dataclass(frozen=True)
class SensorErrors:
    """
    Errors of the sensors in a simulated discharge. A calibrator gets only their readings; state and load stay as they are.

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
        for name in ("noise_V", "offset_V", "current_gain", "current_offset_A"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")
        if self.noise_V < 0.0:
            raise ValueError(f"noise_V is a standard deviation and must be at least 0 V, got {self.noise_V!r}")
        if self.current_gain <= 0.0:
            raise ValueError(f"current_gain must be greater than 0 (1: exact), got {self.current_gain!r}")

    def draw(self, rng: np.random.Generator) -> SensorErrors:
        """Return these errors, for any ``rng``."""
        return self

    def read_voltage_V(self, voltage_V: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the reading of a voltage; ``noise`` is standard normal, any shape."""
        return voltage_V + self.noise_V * noise + self.offset_V

    def apply(self, trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
        """Read the voltage and the current of a discharge with these errors; ``rng`` draws the noise."""
        voltage_V = self.read_voltage_V(trajectory.voltage_V, rng.standard_normal(len(trajectory.voltage_V)))
        current_A = self.current_gain * trajectory.current_A + self.current_offset_A
        return replace(trajectory, voltage_V=voltage_V, current_A=current_A)


@dataclass(frozen=True)
class RandomSensorErrors:
    """
    Draw new sensor errors for each discharge. Gain and offset are constant within a discharge; only the noise varies.

    :param noise_V: least and greatest standard deviation of the noise, drawn log-uniformly, V; (0, 0): none
    :param offset_V: the offset of the voltage is drawn uniformly within this to either side, V
    :param current_gain: limit of the relative error of the current's gain, also uniform
    :param current_offset_A: limit of the offset of the current, also uniform, A
    :raises ValueError: for values that are negative, too large for a sensor, or in the wrong order
    """

    noise_V: tuple[float, float]
    offset_V: float = 0.0
    current_gain: float = 0.0
    current_offset_A: float = 0.0

    def __post_init__(self) -> None:
        least, greatest = self.noise_V
        if not (0.0 < least <= greatest < 1.0 or least == greatest == 0.0):
            raise ValueError(
                f"noise_V must be (least, greatest) in V with 0 < least <= greatest < 1, or (0, 0), got {self.noise_V!r}"
            )
        for name in ("offset_V", "current_gain", "current_offset_A"):
            if not 0.0 <= getattr(self, name) < 0.5:
                raise ValueError(f"{name} must be at least 0 and less than 0.5, got {getattr(self, name)!r}")

    def draw(self, rng: np.random.Generator) -> SensorErrors:
        """Draw the errors of one discharge."""
        return self.draw_biases(rng, self.draw_noise_V(rng))

    def draw_noise_V(self, rng: np.random.Generator) -> float:
        """Draw the standard deviation of the noise of one discharge, V; without noise use no random number."""
        return float(np.exp(rng.uniform(*np.log(self.noise_V)))) if self.noise_V[1] > 0.0 else 0.0

    def draw_biases(self, rng: np.random.Generator, noise_V: float) -> SensorErrors:
        """Draw the errors of one discharge with this noise, V; a bound of 0 uses no random number."""
        offset_V, gain, offset_A = (
            rng.uniform(-bound, bound) if bound > 0.0 else 0.0
            for bound in (self.offset_V, self.current_gain, self.current_offset_A)
        )
        return SensorErrors(noise_V, offset_V, 1.0 + gain, offset_A)
