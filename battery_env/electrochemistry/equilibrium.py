"""Another equilibrium voltage: what is added to that of a cell, as a polynomial of the charge."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.legendre import legvander

from battery_env.arrays import FloatArray
from battery_env.electrochemistry.cell import CellParameters

# Mole fractions of the positive electrode at full charge and at none.
_FRACTIONS_P = (0.4, 1.0)


def with_equilibrium(cell: CellParameters, coefficients_V: Sequence[float] | FloatArray) -> CellParameters:
    """
    A cell with another equilibrium voltage, which ``U0p`` and ``Ap`` can make exactly. What is added is given by coefficients
    of Legendre polynomials 0, 1, ... over the mole fractions of the positive electrode that a discharge passes through, V.
    """
    # as a polynomial in y = 2x - 1, from the highest power down: term k of the Redlich-Kister sum is
    # A_k / F * ((1 + k / 2) * y^(k + 1) - (k / 2) * y^(k - 1))
    powers = np.asarray(coefficients_V, dtype=np.float64) @ _powers(len(coefficients_V))
    terms = np.zeros(max(len(cell.Ap), len(powers) - 1))
    for k in range(len(powers) - 2, -1, -1):
        terms[k] = powers[k + 1] / (1.0 + k / 2.0)
        if k > 0:
            powers[k - 1] += k / 2.0 * terms[k]
    terms[: len(cell.Ap)] += np.array(cell.Ap) / cell.F
    return cell.replace(U0p=cell.U0p + float(powers[0]), Ap=tuple((cell.F * terms).tolist()))


@cache
def _powers(count: int) -> FloatArray:
    # of y = 2x - 1 in each of the first Legendre polynomials, shape (count, count)
    x = Polynomial([0.5, 0.5])
    rows = [Legendre.basis(k).convert(kind=Polynomial)(on_unit_range(x)).coef for k in range(count)]
    return np.array([np.append(row, np.zeros(count - len(row))) for row in rows])


def equilibrium_slopes(fraction_p: FloatArray, count: int) -> FloatArray:
    """
    The derivatives of the voltage by these coefficients at some mole fractions of the positive electrode, shape (count, K).
    """
    return np.asarray(legvander(on_unit_range(fraction_p), count - 1).T)


def on_unit_range(fraction: Any) -> Any:
    """Mole fractions of the positive electrode as -1 .. 1: numbers, arrays and polynomials alike."""
    low, high = _FRACTIONS_P
    return (fraction - 0.5 * (high + low)) * (2.0 / (high - low))
