"""The two parameters of the model that age, and that calibrators estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray
from battery_env.checks import check_within


@dataclass(frozen=True)
class Parameter:
    """A parameter of the model."""

    name: str  # in code and in tables
    symbol: str  # as TeX
    unit: str  # in code and in messages
    limits: tuple[float, float]  # least and largest value, to catch wrong units
    hint: str  # a sentence on the usual cause of a value beyond the limits

    @property
    def label(self) -> str:
        """Symbol and unit, for the axis of a figure."""
        return f"{self.symbol} ({_UNIT_SYMBOLS[self.unit]})"

    def check(self, values: ArrayLike) -> FloatArray:
        """Refuse invalid values."""
        return check_within(self.name, values, self.limits, self.unit, self.hint)

    def check_bounds(self, name: str, bounds: tuple[float, float]) -> tuple[float, float]:
        """Refuse invalid bounds of a search."""
        ends = self.check(bounds)
        if ends.shape != (2,) or not ends[0] < ends[1]:
            raise ValueError(f"{name} must be (lower, upper) with lower < upper, got {bounds!r}")
        return bounds


_UNIT_SYMBOLS = {"C": "C", "ohm": r"$\Omega$"}

Q_MOBILE = Parameter("q_mobile", "$q_{max}$", "C", (100.0, 1e7), "Ampere-hours become coulombs times 3600.")
R_O = Parameter("r_o", "$R_o$", "ohm", (0.0, 50.0), "Milliohms become ohms divided by 1000.")

#: The parameters by name.
PARAMETERS: Mapping[str, Parameter] = MappingProxyType({parameter.name: parameter for parameter in (Q_MOBILE, R_O)})
PARAMETER_NAMES: tuple[str, ...] = tuple(PARAMETERS)


def check_parameters(parameters: Sequence[str]) -> tuple[str, ...]:
    """Refuse an invalid choice of parameters."""
    names = tuple(parameters)
    if not names or len(set(names)) < len(names) or set(names) - set(PARAMETERS):
        raise ValueError(f"parameters must be one or both of {PARAMETER_NAMES}, got {parameters!r}")
    return names
