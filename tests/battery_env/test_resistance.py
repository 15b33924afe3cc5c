"""The resistance after ten seconds: what a meter shows of a cell, by the fitted model and as measured."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env import Discharge, calibrate, load_nasa_discharges, simulate
from battery_env.estimators.resistance import later_step, load_on, measured_resistance_ohm
from tests.records import recorded
from tests.sweeps import sweep

SIMULATED = simulate(2.0, 6000.0, 0.15, load_unit="current", thermal=True, cut_off_V=2.69)
FALL_OHM = float(SIMULATED.voltage_V[0] - SIMULATED.voltage_V[10]) / 2.0


def late(time_s, values, constant_s):
    """Values of a sensor that lags."""
    out = np.array(values)
    for k in range(1, len(out)):
        out[k] = out[k - 1] - np.expm1(-(time_s[k] - time_s[k - 1]) / constant_s) * (values[k] - out[k - 1])
    return out


def test_it_is_the_fall_from_rest_to_ten_seconds_over_the_current():
    found = calibrate(recorded(SIMULATED, starts_at_rest=True))
    assert found.settled and found.resistance_10s_ohm == pytest.approx(FALL_OHM, rel=0.01)
    assert found.measured_resistance_10s_ohm == pytest.approx(FALL_OHM, rel=1e-3)
    assert found.sd_resistance_10s_ohm < 0.1 * FALL_OHM
    assert "10 s resistance" in str(found) and f"measured {1e3 * FALL_OHM:.1f} mohm" in str(found)


def test_without_a_rest_it_is_blank_and_that_of_the_model_counts():
    found = calibrate(recorded(SIMULATED))
    assert np.isnan([found.resistance_10s_ohm, found.measured_resistance_10s_ohm]).all()
    assert found.settled and found.settled_r_o and not found.settled_resistance_10s
    assert "10 s resistance" not in str(found)


def test_rows_that_lie_far_apart_show_no_measured_resistance():
    for every_s, is_shown in ((2, True), (30, False)):
        rows = recorded(SIMULATED, slice(None, None, every_s), starts_at_rest=True)
        assert np.isfinite(measured_resistance_ohm(rows, True)) == is_shown
    pulses = simulate(np.tile([2.0] * 5 + [0.0] * 25, 40), 6000.0, 0.15, load_unit="current")
    assert not load_on(recorded(pulses, starts_at_rest=True), True).stays


@pytest.mark.parametrize("number", sweep(49, 1, 121))
def test_a_current_that_lags_settles_no_resistance(number):
    record = load_nasa_discharges("B0005")[number - 1]
    for constant_s in (10.0, 30.0):
        lagging = replace(record, current_A=late(record.time_s, record.current_A, constant_s))
        sound, found = calibrate(record), calibrate(lagging)
        off_ohm = abs(found.resistance_10s_ohm - sound.resistance_10s_ohm)
        assert sound.settled_resistance_10s
        assert not found.settled_resistance_10s or off_ohm < 3.0 * found.sd_resistance_10s_ohm
    assert [each.code for each in found.findings] == ["resistance_differs"] and not found.settled_q_mobile
    assert set(found.findings[0].measured) == {"after_s", "step_s", "measured_ohm", "model_ohm", "apart_sd"}


def test_without_a_rest_a_later_switch_is_compared_whatever_its_moment():
    load_A = np.concatenate([np.full(900, 1.0), np.full(9000, 3.0)])
    trajectory = simulate(load_A, 6000.0, 0.15, load_unit="current", thermal=True, cut_off_V=2.69)
    rows = slice(None, None, 10)
    for constant_s, codes in ((1e-3, []), (20.0, ["resistance_differs"])):
        current_A = late(trajectory.time_s, trajectory.current_A, constant_s)
        record = Discharge(trajectory.time_s[rows], trajectory.voltage_V[rows], current_A[rows])
        assert load_on(record, False) is None and later_step(record).on_s == pytest.approx(900.0, abs=10.0)
        found = calibrate(record, mismatch_V=0.02)
        assert [each.code for each in found.findings if each.code != "imprecise"] == codes
        assert np.isnan(found.resistance_10s_ohm)


def test_what_is_measured_after_another_switch_is_no_resistance_of_the_first():
    record = simulate(np.repeat([1.0, 2.5, 0.8, 2.0] * 60, 60), 6000.0, 0.15, load_unit="current", cut_off_V=2.69)
    rows = recorded(record, slice(None, None, 5))
    step = later_step(rows)
    assert step.is_measured(rows, 10.0) and not step.is_measured(rows, 60.0)
    assert "resistance_differs" not in [each.code for each in calibrate(rows).findings]


def test_it_rises_with_age_as_the_measured_one_does():
    for cell in ("B0005", "B0006"):
        young, old = (calibrate(load_nasa_discharges(cell)[number - 1]) for number in (49, 157))
        rise, measured = (
            getattr(old, f"{name}resistance_10s_ohm") / getattr(young, f"{name}resistance_10s_ohm")
            for name in ("", "measured_")
        )
        assert rise > 1.2 and rise == pytest.approx(measured, abs=0.07)
        assert old.resistance_10s_ohm == pytest.approx(old.measured_resistance_10s_ohm, rel=0.1)
