"""Cells of other curves: a record that ends above its knee does not say what the cell holds."""

import numpy as np
import pytest

from battery_env import NEW_CELL, Settings, simulate
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.estimators.diagnosis.knee import knee_sd_C
from battery_env.records import CUT_OFF_V, Samples
from tests.records import recorded
from tests.sweeps import sweep

# As of nickel-rich cells with silicon: at a fifth of its charge the voltage at rest is 0.3 V lower, so that it falls slowly
# from there on.
LATE_KNEE = with_equilibrium(NEW_CELL, [-0.077, -0.136, -0.028, 0.115, 0.135, 0.039, -0.054, -0.06])
Q_MOBILE_C = 9000.0


@pytest.mark.parametrize("voltage_V", sweep(3.3, 3.5, 3.45, 3.4, 3.35, 3.25, 3.2, 3.15, 3.1, 3.05, 3.0))
def test_another_cells_curve_above_its_knee_settles_at_no_wrong_charge(voltage_V):
    whole = simulate(2.0, Q_MOBILE_C, 0.05, load_unit="current", cell=LATE_KNEE, cut_off_V=voltage_V)
    stopped = recorded(whole, slice(None, None, 10), noise_V=0.001, starts_at_rest=True)
    estimate = Settings(method="least-squares").calibrator().estimate(stopped)
    assert not estimate.settled_q_mobile or abs(estimate.q_mobile / Q_MOBILE_C - 1.0) < 0.03


#: Of the charge of a record, what is left at each sample.
LEFT = np.linspace(1.0, 0.0, 401)


def of_voltage(voltage_V) -> Samples:
    """A record under 2 A, which draws 5000 C."""
    return Samples(2500.0 * (1.0 - LEFT), voltage_V, np.full(len(LEFT), 2.0))


def test_what_the_record_lasts_longer_is_half_in_doubt():
    measured = of_voltage(3.0 + 3.0 * LEFT)  # another 0.3 V take a tenth of the charge
    model_V = 3.0 + 6.0 * LEFT  # and half as much in the model
    assert knee_sd_C(measured, model_V, 3.0) == pytest.approx(0.5 * (500.0 - 250.0), rel=1e-3)
    # a bend counts: 0.3 = 3 x + 60 x^2
    bent = of_voltage(3.0 + 3.0 * LEFT - 60.0 * LEFT**2)
    assert knee_sd_C(bent, model_V, 3.0) == pytest.approx(0.5 * (5000.0 * 0.05 - 250.0), abs=1.0)


def test_nothing_is_in_doubt_beyond_a_record_that_goes_down_to_an_empty_cell_or_falls_more_steeply():
    whole = of_voltage(CUT_OFF_V + 3.0 * LEFT)
    steep_V = CUT_OFF_V + 6.0 * LEFT
    assert knee_sd_C(whole, steep_V, 3.0) == 0.0
    assert knee_sd_C(whole, steep_V, 2.0) > 0.0  # of constants whose cell is empty at 2 V
    steeper = of_voltage(3.0 + 12.0 * LEFT)
    assert knee_sd_C(steeper, 3.0 + 6.0 * LEFT, 3.0) == 0.0


def test_a_voltage_that_does_not_fall_leaves_at_most_as_much_again_in_doubt():
    flat = of_voltage(np.full_like(LEFT, 3.6))
    assert knee_sd_C(flat, 3.6 + 9.0 * LEFT, 3.0) == pytest.approx(0.5 * (5000.0 - 500.0), rel=0.01)


def test_voltages_are_compared_under_the_load_of_the_end():
    steady = of_voltage(3.0 + 3.0 * LEFT)
    model_V = 3.0 + 6.0 * LEFT
    pulsed_A = np.where(np.arange(401) % 4 == 1, 4.0, steady.current_A)
    pulsed = Samples(steady.time_s, np.where(pulsed_A > 2.0, steady.voltage_V - 0.2, steady.voltage_V), pulsed_A)
    charge_C = float(np.dot(pulsed_A[:-1], np.diff(pulsed.time_s)))
    assert knee_sd_C(pulsed, model_V, 3.0) == pytest.approx(0.5 * 0.05 * charge_C, rel=0.02)
