"""What an estimate means on a test bench."""

import numpy as np
import pytest

from battery_env import NEW_CELL, Estimate, LeastSquares, RecordModel, capacity_Ah, dc_resistance_ohm, load_nasa_discharges
from battery_env.electrochemistry import initial_state, simulate

ESTIMATE = Estimate(6000.0, 0.15, 60.0, 0.01)


@pytest.mark.parametrize(("load", "load_unit"), [(2.0, "current"), (0.5, "current"), (7.0, "power")])
def test_capacity_is_the_charge_of_a_simulated_discharge(load, load_unit):
    discharge = simulate(load, 6000.0, 0.15, load_unit=load_unit, cut_off_V=2.8)
    step_Ah = discharge.current_A[-1] / 3600.0
    converted = capacity_Ah(ESTIMATE, load, 2.8, load_unit=load_unit)
    # the end lies within the last step
    assert 0.0 < discharge.current_A.sum() / 3600.0 - converted.value < step_Ah


def test_resistance_is_that_of_a_simulated_pulse():
    rest = initial_state(6000.0, soc=0.6)
    pulse = simulate(3.0, 6000.0, 0.15, load_unit="current", initial=rest, until=20.0)
    for duration_s in (5, 20):
        expected_ohm = (pulse.voltage_V[0] - pulse.voltage_V[duration_s]) / 3.0
        assert dc_resistance_ohm(ESTIMATE, 3.0, duration_s, 0.6).value == pytest.approx(expected_ohm, rel=1e-9)


@pytest.mark.parametrize("load_unit", ["current", "power"])
def test_standard_deviations_are_those_of_drawn_parameters(load_unit):
    rng = np.random.default_rng(0)
    drawn = [Estimate(*rng.normal([6000.0, 0.15], [60.0, 0.01])) for _ in range(200)]
    for convert in (lambda each: capacity_Ah(each, 2.0, load_unit=load_unit), lambda each: dc_resistance_ohm(each, 2.0)):
        spread = np.std([convert(each).value for each in drawn])
        assert convert(ESTIMATE).sd == pytest.approx(spread, rel=0.15)
        assert np.isnan(convert(Estimate(6000.0, 0.15)).sd)


def test_a_discharge_to_one_voltage_tells_the_capacity_to_another():
    model = RecordModel(NEW_CELL.replace(Tb0=297.15), thermal=True)
    fit = LeastSquares(cell=model.cell, thermal=True, mismatch_V=0.05)
    for discharge in load_nasa_discharges("B0006")[::56]:
        estimate = fit.estimate(discharge.loaded_part(2.7))
        to_3_V = discharge.loaded_part(3.0)
        converted = capacity_Ah(estimate, float(np.median(to_3_V.current_A)), 3.0, model=fit.model)
        assert abs(converted.value - to_3_V.charge_C / 3600.0) < 2.0 * converted.sd < 0.06 * converted.value


def test_a_cell_that_is_empty_before_has_no_value():
    assert np.isnan(dc_resistance_ohm(ESTIMATE, 2.0, 600.0, soc=0.1).value)
    assert np.isnan(capacity_Ah(ESTIMATE, 0.005).value)


@pytest.mark.parametrize(
    ("convert", "message"),
    [
        (lambda: capacity_Ah(ESTIMATE, 0.0), "load must be a positive"),
        (lambda: capacity_Ah(ESTIMATE, 2000.0), "load must lie within"),
        (lambda: capacity_Ah(ESTIMATE, 2.0, -1.0), "cut_off_V must be a positive"),
        (lambda: capacity_Ah(ESTIMATE, 2.0, load_unit="A"), "load_unit must be"),
        (lambda: capacity_Ah(Estimate(1.6, 0.15), 2.0), "q_mobile must lie within"),
        (lambda: dc_resistance_ohm(ESTIMATE, -2.0), "current_A must be a positive"),
        (lambda: dc_resistance_ohm(ESTIMATE, 2.0, 0.0), "duration_s must be a positive"),
        (lambda: dc_resistance_ohm(ESTIMATE, 2.0, soc=50.0), "state of charge must lie within"),
    ],
)
def test_what_cannot_be_meant_is_refused(convert, message):
    with pytest.raises(ValueError, match=message):
        convert()
