"""Changes of a cell's equilibrium voltage: a polynomial of the charge that is added to it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.legendre import legvander

from battery_env.arrays import FloatArray
from battery_env.electrochemistry.cell import CellParameters

# Mole fractions of the positive electrode at full charge and at zero charge.
_FRACTIONS_P = (0.4, 1.0)


def with_equilibrium(cell: CellParameters, coefficients_V: Sequence[float] | FloatArray) -> CellParameters:
    """
    Add Legendre polynomials 0, 1, ... with these coefficients, V, exactly to the equilibrium voltage of a cell: by ``U0p`` and
    ``Ap``. Their variable spans the mole fractions of the positive electrode in a discharge.
    """
    # the sum as a polynomial in y = 2x - 1, from the highest power down, as terms of the Redlich-Kister sum
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
    # coefficients of the powers of y = 2x - 1 in each of the first Legendre polynomials, shape (count, count)
    x = Polynomial([0.5, 0.5])
    rows = [Legendre.basis(k).convert(kind=Polynomial)(on_unit_range(x)).coef for k in range(count)]
    return np.array([np.append(row, np.zeros(count - len(row))) for row in rows])


def equilibrium_slopes(fraction_p: FloatArray, count: int) -> FloatArray:
    """Return the derivatives of the voltage by these coefficients at K mole fractions, shape (count, K)."""
    return np.asarray(legvander(on_unit_range(fraction_p), count - 1).T)


def on_unit_range(fraction: Any) -> Any:
    """Scale mole fractions of the positive electrode (numbers, arrays or polynomials) to -1 .. 1."""
    low, high = _FRACTIONS_P
    return (fraction - 0.5 * (high + low)) * (2.0 / (high - low))
