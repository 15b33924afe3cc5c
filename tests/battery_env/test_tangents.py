"""The tangents of the model are the derivatives of its state and of its voltage, up to the second in q_mobile."""

import numpy as np
import pytest

from battery_env.electrochemistry import FULL_CHARGE_SHARES, NEW_CELL, QNB, QNS, initial_state, voltage
from battery_env.electrochemistry.kernels import MOLE_FRACTION_MARGIN, mole_fraction
from battery_env.electrochemistry.tangents import (
    BY_Q,
    BY_R,
    PolynomialDerivatives,
    least_q,
    step_with_tangents,
    voltage_tangents,
)

CELL = NEW_CELL.replace(mC=10.0)
PACKED = CELL.packed
DERIVATIVES = PolynomialDerivatives.of(PACKED)


def after(steps, q, r_o, thermal, current_A=2.0):
    """State and tangents of one cell."""
    state, tangents = np.zeros((1, 8)), np.zeros((1, 2, 8))
    state[0], tangents[0, BY_Q, QNB:] = initial_state(q, CELL), FULL_CHARGE_SHARES
    for _ in range(steps):
        step_with_tangents(state, tangents, current_A, q, r_o, 1.0, thermal, True, PACKED.constants)
    return state, tangents


@pytest.mark.parametrize("thermal", [False, True])
@pytest.mark.parametrize("steps", [50, 1500, 2800])
class TestOneCell:
    def test_voltage_along_them(self, steps, thermal):
        state, tangents = after(steps, 6000.0, 0.15, thermal)
        dq = 0.5
        more, less = (float(voltage(state[0] + s * dq * tangents[0, BY_Q], 6000.0 + s * dq, cell=CELL)) for s in (1.0, -1.0))
        by_q, by_r_o = voltage_tangents(state, tangents, 6000.0, thermal, PACKED, DERIVATIVES)
        assert by_q == pytest.approx((more - less) / (2.0 * dq), rel=1e-4)
        more, less = (float(voltage(state[0] + s * 1e-4 * tangents[0, BY_R], 6000.0, cell=CELL)) for s in (1.0, -1.0))
        assert by_r_o == pytest.approx((more - less) / 2e-4, rel=1e-6)


def test_at_the_least_q_the_mole_fraction_is_at_the_margin():
    state, tangents = after(2500, 6000.0, 0.15, False)
    charge, slope = state[0, QNS], tangents[0, BY_Q, QNS]
    least = least_q(charge, slope, 6000.0, MOLE_FRACTION_MARGIN, PACKED.constants)
    fraction = mole_fraction(charge + slope * (least - 6000.0), least, False, PACKED.constants)
    assert fraction == pytest.approx(MOLE_FRACTION_MARGIN, rel=1e-9) and 5000.0 < least < 6000.0
