"""The cell: the layout of its state and its constants."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from math import isfinite
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.files import read_json, write_json
from battery_env.parameters import Q_MOBILE, R_O

STATE_NAMES: tuple[str, ...] = ("Tb", "Vo", "Vsn", "Vsp", "qnB", "qnS", "qpB", "qpS")
STATE_SIZE = len(STATE_NAMES)
#: Columns of a state.
TB, VO, VSN, VSP, QNB, QNS, QPB, QPS = range(STATE_SIZE)

#: Charges at full charge and rest, as shares of ``q_mobile``, in the order of the state (qnB, qnS, qpB, qpS). At a
#: fixed history of the current the charges are linear in ``q_mobile`` with this slope, at all times.
FULL_CHARGE_SHARES: FloatArray = np.array([0.9, 0.1, 0.6, 1.0 / 15.0])
# Decrease of these charges per share of q_mobile drawn, once the cell rests
_DISCHARGE_SHARES: FloatArray = np.array([0.9, 0.1, -0.9, -0.1])

CONSTANTS_SIZE, POLYNOMIAL_SIZE = 13, 14
# Columns of ``PackedConstants.constants``, in SI units
(
    FRACTION_PER_SHARE,  # mole fraction per share of q_mobile in a surface
    BULK_RATE,  # flow from the bulk to the surface of an electrode per charge of the bulk
    SURFACE_RATE,  # flow from the surface to the bulk per charge of the surface
    R_OVER_F,
    PER_CURRENT_N,  # negative electrode, Butler-Volmer: argument of asinh per current, without the mole fraction
    PER_CURRENT_P,  # positive electrode, likewise
    TO_RATE,  # relaxation rate of Vo
    TSN_RATE,  # relaxation rate of Vsn
    TSP_RATE,  # relaxation rate of Vsp
    U0,  # reference potential of the cell
    WARMING,  # inverse of the thermal mass
    COOLING,  # cooling rate
    SURROUNDINGS,  # temperature of the surroundings
) = range(CONSTANTS_SIZE)

#: Constants that are hard to measure, in the order of the factors of :meth:`CellParameters.packed_with`.
UNCERTAIN_CONSTANTS: tuple[str, ...] = ("kn", "tDiffusion", "to", "tsn")

_FORMAT, _FORMAT_VERSION = "battery_env.CellParameters", 1
_SIX_TENTHS = 0.6  # xnMax - xnMin: the share of all lithium sites that a full discharge uses


class PackedConstants(NamedTuple):
    """
    Input of the kernels: constants of the equations, and both equilibrium-potential polynomials in y = 2x - 1.

    :param constants: one row for all cells or one row a cell, shape (1, 13) or (n, 13); its columns have names,
        ``FRACTION_PER_SHARE`` and so on
    :param polynomial_n: of the negative electrode, V, lowest power first, shape (14,)
    :param polynomial_p: of the positive electrode, V, shape (14,)
    """

    constants: FloatArray
    polynomial_n: FloatArray
    polynomial_p: FloatArray


def _redlich_kister_polynomial(coefficients: tuple[float, ...], faraday: float) -> FloatArray:
    """Return the Redlich-Kister sum of the equilibrium potential as a polynomial in y = 2x - 1, without its singularity."""
    # term k is A_k / F * ((1 + k / 2) * y^(k + 1) - (k / 2) * y^(k - 1))
    polynomial = np.zeros(POLYNOMIAL_SIZE)
    for k, coefficient in enumerate(coefficients):
        polynomial[k + 1] += coefficient / faraday * (1.0 + k / 2.0)
        if k > 0:
            polynomial[k - 1] -= coefficient / faraday * (k / 2.0)
    return polynomial


# Largest ratio of a constant to that of a new 18650: R and F are physical constants, other constants may be of a large cell.
_LARGEST_FACTORS = {"R": 1.01, "F": 1.01, "Tb0": 2.0, "VEOD": 10.0}
_LARGEST_FACTOR = 1e9


@dataclass(frozen=True)
class CellParameters:
    """
    Constants of the model, in SI units, under progpy's names; the defaults are NASA's 18650 cell when new.

    Source: Daigle & Kulkarni 2013; the values agree in NASA's MATLAB library, progpy and the seed paper's code.

    :param q_mobile: charge that can move, C (progpy's ``qMobile``, the paper's q^max)
    :param r_o: ohmic resistance, ohm (progpy's ``Ro``)
    :param R: gas constant, J/mol/K
    :param F: Faraday's constant, C/mol
    :param Sn: surface of the negative electrode, m^2
    :param Sp: surface of the positive electrode, m^2
    :param kn: lumped rate constant of the negative electrode, A/m^2
    :param kp: lumped rate constant of the positive electrode, A/m^2
    :param Vol: volume of one electrode, m^3
    :param VolSFraction: share of that volume which counts as surface
    :param tDiffusion: time constant of diffusion between surface and bulk, s/m^3
    :param to: time constant of the ohmic voltage drop, s
    :param tsn: time constant of the negative surface overpotential, s
    :param tsp: time constant of the positive surface overpotential, s
    :param U0n: reference potential of the negative electrode, V
    :param U0p: reference potential of the positive electrode, V
    :param An: Redlich-Kister coefficients of the negative electrode, J/mol
    :param Ap: Redlich-Kister coefficients of the positive electrode, J/mol
    :param Tb0: temperature of cell and surroundings at the start, K
    :param mC: thermal mass of the cell, J/K
    :param tau: time constant of its cooling, s
    :param VEOD: voltage at which the cell counts as discharged, V
    :raises ValueError: if a value is not finite, or so far from that of a new cell that no cell has it
    """

    q_mobile: float = 7600.0
    r_o: float = 0.117215
    R: float = 8.3144621
    F: float = 96487.0
    Sn: float = 0.000437545
    Sp: float = 0.00030962
    kn: float = 2120.96
    kp: float = 248898.0
    Vol: float = 2e-5
    VolSFraction: float = 0.1
    tDiffusion: float = 7e6
    to: float = 6.08671
    tsn: float = 1001.38
    tsp: float = 46.4311
    U0n: float = 0.01
    U0p: float = 4.03
    An: tuple[float, ...] = (86.19,)
    Ap: tuple[float, ...] = (
        -31593.7,
        0.106747,
        24606.4,
        -78561.9,
        13317.9,
        307387.0,
        84916.1,
        -1.07469e6,
        2285.04,
        990894.0,
        283920.0,
        -161513.0,
        -469218.0,
    )
    Tb0: float = 292.1
    mC: float = 37.04
    tau: float = 100.0
    VEOD: float = 3.0

    def __post_init__(self) -> None:
        Q_MOBILE.check(self.q_mobile)
        R_O.check(self.r_o)
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if field.name in ("An", "Ap") and isinstance(value, tuple) else (value,)
            if not all(isinstance(number, Real) and not isinstance(number, bool) for number in numbers):
                raise TypeError(f"CellParameters: {field.name} must be {field.type}, got {value!r}")
            if not all(map(isfinite, numbers)):
                raise ValueError(f"CellParameters: {field.name} must be finite, got {value!r}")
            if field.name not in ("U0n", "U0p", "An", "Ap", "r_o") and not value > 0.0:
                raise ValueError(f"CellParameters: {field.name} must be greater than 0, got {value!r}")
            typical = max(map(abs, field.default if isinstance(field.default, tuple) else (field.default,)))
            factor = _LARGEST_FACTORS.get(field.name, _LARGEST_FACTOR)
            smallest = 0.0 if field.name in ("U0n", "U0p", "An", "Ap", "r_o") else typical / factor
            if not all(smallest <= abs(number) <= factor * typical for number in numbers):
                problem = f"is more than {factor:g} times off the {typical:g} of a new 18650"
                raise ValueError(f"CellParameters: {field.name} {problem}, got {value!r}")
        for name in ("An", "Ap"):
            if not 1 <= len(getattr(self, name)) < POLYNOMIAL_SIZE:
                raise ValueError(
                    f"CellParameters: {name} must hold 1 to {POLYNOMIAL_SIZE - 1} coefficients, got {getattr(self, name)!r}"
                )
        if not self.VolSFraction < 1.0:
            raise ValueError(f"CellParameters: VolSFraction is a share and must be less than 1, got {self.VolSFraction!r}")

    def replace(self, **changes: Any) -> CellParameters:
        """A copy with some constants changed."""
        return replace(self, **changes)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """Save the constants to a new file; a ``FileExistsError`` if it exists already."""
        return write_json(path, _FORMAT, _FORMAT_VERSION, {"constants": asdict(self)})

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> CellParameters:
        """Load a file of :meth:`to_json`; a ``ValueError`` for any other file, a damaged one, or another format version."""
        content = read_json(path, _FORMAT, _FORMAT_VERSION)
        try:
            return cls.of_mapping(content["constants"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged, or was not saved by CellParameters.to_json: {error}") from error

    @classmethod
    def of_mapping(cls, constants: Mapping[str, Any]) -> CellParameters:
        """
        Make the constants from a mapping, as JSON holds them.

        :param constants: all constants, by name
        :raises TypeError: if ``constants`` is no mapping, or a value has another type
        :raises ValueError: for a constant that is missing, unknown or out of range
        """
        if not isinstance(constants, Mapping):
            raise TypeError(f"constants must be given by name, got {type(constants).__name__}")
        mismatched = {field.name for field in fields(cls)} ^ set(constants)
        if mismatched:
            raise ValueError(f"constants that are missing or unknown: {', '.join(sorted(map(str, mismatched)))}")
        coefficients = {name: tuple(constants[name]) for name in ("An", "Ap")}
        return cls(**{**constants, **coefficients})

    @cached_property
    def packed(self) -> PackedConstants:
        """Return the input of the compiled kernels, with one row of constants."""
        volume_surface = self.VolSFraction * self.Vol
        constants = np.empty((1, CONSTANTS_SIZE))
        row = constants[0]
        row[FRACTION_PER_SHARE] = _SIX_TENTHS / self.VolSFraction
        row[BULK_RATE] = 1.0 / ((self.Vol - volume_surface) * self.tDiffusion)
        row[SURFACE_RATE] = 1.0 / (volume_surface * self.tDiffusion)
        row[R_OVER_F] = self.R / self.F
        row[PER_CURRENT_N] = 1.0 / (2.0 * self.Sn * self.kn)
        row[PER_CURRENT_P] = 1.0 / (2.0 * self.Sp * self.kp)
        row[TO_RATE], row[TSN_RATE], row[TSP_RATE] = 1.0 / self.to, 1.0 / self.tsn, 1.0 / self.tsp
        row[U0] = self.U0p - self.U0n
        row[WARMING], row[COOLING], row[SURROUNDINGS] = 1.0 / self.mC, 1.0 / self.tau, self.Tb0
        return PackedConstants(
            constants,
            _redlich_kister_polynomial(self.An, self.F),
            _redlich_kister_polynomial(self.Ap, self.F),
        )

    def packed_with(self, factors: FloatArray) -> PackedConstants:
        """Return one row a cell: this cell's constants, ``UNCERTAIN_CONSTANTS`` multiplied by ``factors``, shape (n, 4)."""
        packed = self.packed
        constants = np.repeat(packed.constants, len(factors), axis=0)
        kn, t_diffusion, to, tsn = factors.T
        constants[:, PER_CURRENT_N] /= kn
        constants[:, BULK_RATE] /= t_diffusion
        constants[:, SURFACE_RATE] /= t_diffusion
        constants[:, TO_RATE] /= to
        constants[:, TSN_RATE] /= tsn
        return packed._replace(constants=constants)


#: The new cell: every constant at its default.
NEW_CELL = CellParameters()
#: Ratio of the charge that can move to the charge that a discharge delivers, roughly.
Q_MOBILE_PER_CAPACITY = 1.05
# A cell is of another size if its charge differs from the new cell's by more than this factor.
_SAME_SIZE_FACTOR = 2.0


def rest_shares(soc: float = 1.0) -> FloatArray:
    """Return the charges of a cell at rest, as shares of ``q_mobile``."""
    if not isinstance(soc, Real) or not 0.0 <= soc <= 1.0:
        raise ValueError(f"a state of charge must lie within 0 .. 1, got {soc!r}")
    return FULL_CHARGE_SHARES - (1.0 - float(soc)) * _DISCHARGE_SHARES


def check_cell(cell: CellParameters | None, thermal: bool = False) -> CellParameters:
    """Refuse a ``cell`` that is no :class:`CellParameters`."""
    if cell is not None and not isinstance(cell, CellParameters):
        raise TypeError(f"cell must be CellParameters or None, got {cell!r}")
    if not isinstance(thermal, (bool, np.bool_)):
        raise TypeError(f"thermal must be True or False, got {thermal!r}")
    return NEW_CELL if cell is None else cell


def check_dt(dt: float, cell: CellParameters) -> float:
    """Refuse time steps for which explicit Euler is unstable."""
    limit = 2.0 * min(cell.to, cell.tsn, cell.tsp)
    if not isinstance(dt, Real) or not 0.0 < dt <= limit:
        raise ValueError(
            f"dt must be greater than 0 and at most {limit:.4g} s (twice the fastest time constant: explicit Euler is "
            f"unstable beyond), got {dt!r}. Use a smaller dt."
        )
    return float(dt)


def new_cell_of(q_mobile_C: float) -> CellParameters:
    """Return a new cell of this charge: an 18650 within a factor of two; otherwise surfaces and mass scale with the charge."""
    size = q_mobile_C / NEW_CELL.q_mobile
    if 1.0 / _SAME_SIZE_FACTOR < size < _SAME_SIZE_FACTOR:
        return NEW_CELL
    surfaces = {name: size * getattr(NEW_CELL, name) for name in ("Sn", "Sp", "mC")}
    return NEW_CELL.replace(q_mobile=q_mobile_C, r_o=NEW_CELL.r_o / size, **surfaces)
