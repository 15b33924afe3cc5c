"""The derivatives of the model are exact, and so is the least q_mobile; forecasts end at the cut-off."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env import Estimate, RecordModel
from battery_env.electrochemistry import NEW_CELL, QNS, QPS, initial_state, simulate
from battery_env.electrochemistry.tangents import RATE_CONSTANTS, TANGENT_NAMES
from battery_env.loads import constant

CURRENT_A = np.repeat(np.random.default_rng(0).uniform(0.5, 2.5, 40), 75)
RECORD = simulate(2.0, 6000.0, 0.15, load_unit="current")
TRUTH = Estimate(6000.0, 0.15)
PARTLY_DISCHARGED = simulate(2.0, 6000.0, 0.15, until=600.0, load_unit="current").state[-1]


MODELS = [
    RecordModel(),
    RecordModel(thermal=True),
    RecordModel(thermal=True, dt_s=2.0),
    RecordModel(initial=PARTLY_DISCHARGED),
    RecordModel(cell=NEW_CELL.replace(VolSFraction=0.2, kn=1000.0)),
    RecordModel(cell=NEW_CELL.replace(mC=2.0, kn=20.0, kp=20.0), thermal=True),
]
MODEL_IDS = ["isothermal", "thermal", "2 s", "partly discharged", "another cell", "a hot cell"]


def with_factor(model, name, factor):
    """The same model with one constant multiplied."""
    cell = model.cell.replace(**{name: factor * getattr(model.cell, name)})
    return RecordModel(cell, model.thermal, model.dt_s, model.initial)


@pytest.mark.parametrize(("load", "unit"), [(2.0, "current"), (0.5, "current"), (7.0, "power")])
def test_a_capacity_is_the_charge_of_a_simulated_discharge(load, unit):
    discharge = simulate(load, 6000.0, 0.15, load_unit=unit, cut_off_V=2.8)
    (capacity_Ah,) = RecordModel().capacity_Ah([constant(load, unit)], 2.8, 6000.0, 0.15)
    # the end lies within the last step
    assert 0.0 < discharge.current_A.sum() / 3600.0 - capacity_Ah < discharge.current_A[-1] / 3600.0


@pytest.mark.parametrize("model", MODELS, ids=MODEL_IDS)
def test_derivatives_are_those_of_the_simulated_voltage(model):
    current_A, q, r_o = CURRENT_A[:1200], 6000.0, 0.15
    tangents, dq, dr, dlog = model.tangents(current_A, q, r_o), 0.03, 1e-5, 1e-4
    np.testing.assert_allclose(tangents.voltage_V, model.simulate(current_A, q, r_o).voltage_V, rtol=1e-13)
    alone = model.sensitivities(current_A, q, r_o)
    for found, expected in zip((tangents.voltage_V, *tangents.by_parameter), alone, strict=False):
        np.testing.assert_array_equal(found, expected)

    def checks(name, step, more, less):
        slope = tangents.by_parameter[TANGENT_NAMES.index(name)]
        difference = (more.voltage_V - less.voltage_V) / (2.0 * step)
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=2e-9, err_msg=name)
        assert np.abs(slope).max() > 1e-5

    checks("q_mobile", dq, *(model.simulate(current_A, q + change, r_o) for change in (dq, -dq)))
    checks("r_o", dr, *(model.simulate(current_A, q, r_o + change) for change in (dr, -dr)))
    for name in RATE_CONSTANTS:
        changed = (with_factor(model, name, np.exp(change)) for change in (dlog, -dlog))
        checks(name, dlog, *(each.simulate(current_A, q, r_o) for each in changed))


@pytest.mark.parametrize("model", [RecordModel(), RecordModel(initial=PARTLY_DISCHARGED)])
def test_the_least_q_mobile_follows_the_time_of_diffusion(model):
    _, by_log_C = model.least_q_mobile_tangent_C(CURRENT_A)
    more_C, less_C = (with_factor(model, "tDiffusion", np.exp(log)).least_q_mobile_C(CURRENT_A) for log in (1e-4, -1e-4))
    assert by_log_C == pytest.approx((more_C - less_C) / 2e-4, rel=1e-5) and by_log_C > 1.0


@pytest.mark.parametrize("model", [RecordModel(), RecordModel(initial=PARTLY_DISCHARGED), RecordModel(dt_s=2.0)])
def test_the_model_lasts_just_as_long_as_the_current_at_the_least_q_mobile(model):
    check_least_q_mobile(model, CURRENT_A)


# In the long run one electrode is empty when the other one is overfull. Within seconds it is the surface that is short of
# charge, or has too much of it.
@pytest.mark.parametrize(
    ("state", "surface", "shift_C", "current_A"),
    [
        (PARTLY_DISCHARGED, QNS, -20.0, 3.0),
        (PARTLY_DISCHARGED, QPS, 20.0, 3.0),
        (initial_state(6000.0), QNS, 20.0, -3.0),
        (initial_state(6000.0), QPS, -20.0, -3.0),
    ],
    ids=["negative empty", "positive overfull", "negative overfull", "positive empty"],
)
def test_either_surface_may_be_the_first(state, surface, shift_C, current_A):
    shifted = state.copy()
    shifted[surface] += shift_C
    shifted[surface - 1] -= shift_C
    check_least_q_mobile(RecordModel(initial=shifted), np.full(5, current_A))


def check_least_q_mobile(model, current_A):
    least_C = model.least_q_mobile_C(current_A)
    assert len(model.simulate(current_A, least_C * (1.0 + 1e-9), 0.1).time_s) == len(current_A)
    assert len(model.simulate(current_A, least_C * (1.0 - 1e-9), 0.1).time_s) < len(current_A)


def test_nothing_is_known_after_the_model_cell_is_empty():
    model = RecordModel()
    columns = model.sensitivities(CURRENT_A, 4000.0, 0.1)
    n = len(model.simulate(CURRENT_A, 4000.0, 0.1).time_s)
    assert n < len(CURRENT_A)
    for column in columns:
        assert np.isfinite(column[:n]).all() and np.isnan(column[n:]).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RecordModel().forecast(RECORD, Estimate(np.nan, 0.1)), "must lie within .* got nan"),
        (lambda: RecordModel().voltage(RECORD, Estimate(6000.0, np.nan)), "must lie within .* got nan"),
    ],
)
def test_what_cannot_be_meant_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


class TestForecast:
    @pytest.mark.parametrize("cut_off_V", [3.2, 3.0, 2.7])
    def test_it_is_the_simulated_one_to_within_a_step(self, cut_off_V):
        record = simulate(2.0, 6000.0, 0.15, load_unit="current", cut_off_V=cut_off_V)
        truth = Estimate(6000.0, 0.15)
        for seen in (record, record.part(0, 900)):
            eod_time_s = RecordModel().forecast(seen, truth, cut_off_V).eod_time_s
            assert record.eod_time_s - 1.0 <= eod_time_s <= record.eod_time_s

    def test_it_follows_the_record_on_its_clock_and_ends_at_the_cut_off(self):
        later = replace(RECORD, time_s=RECORD.time_s + 1000.0)
        forecast = RecordModel().forecast(later.part(0, 900), TRUTH)
        np.testing.assert_allclose(forecast.voltage_V[: len(RECORD.time_s)], RECORD.voltage_V, atol=1e-12)
        assert forecast.voltage_V[-1] == 3.0 and (np.diff(forecast.time_s) > 0.0).all()
        expected_s = RecordModel().forecast(RECORD.part(0, 900), TRUTH).eod_time_s + 1000.0
        assert forecast.eod_time_s == pytest.approx(expected_s)

    def test_it_is_unknown_under_the_current_that_a_sensor_shows_at_rest(self):
        for current_A in (1e-9, 1e-3):  # steps down to the cut-off would not fit in memory, or take minutes
            forecast = RecordModel().forecast(RECORD.part(0, 900), TRUTH, future_current_A=current_A)
            assert np.isnan(forecast.eod_time_s) and len(forecast.time_s) == 900
            assert np.isnan(RecordModel().capacity_Ah([constant(current_A, "current")], 3.0)).all()

    def test_it_follows_a_slow_discharge_for_days(self):
        eod_time_s = RecordModel(dt_s=2.0).forecast(RECORD.part(0, 900), TRUTH, future_current_A=0.02).eod_time_s
        assert eod_time_s == pytest.approx(4200.0 / 0.02, rel=0.1)

    def test_it_holds_the_voltage_at_the_samples_also_below_the_cut_off_and_until_the_cell_is_empty(self):
        model, estimate = RecordModel(), Estimate(5600.0, 0.15)
        forecast = model.forecast(RECORD, estimate, cut_off_V=3.5)
        assert forecast.eod_time_s == forecast.time_s[-1] < RECORD.time_s[-1]
        np.testing.assert_array_equal(forecast.at_samples_V, model.voltage(RECORD, estimate))
        assert np.nanmin(forecast.at_samples_V) < 3.4
        empty_V = model.voltage(RECORD, Estimate(4000.0, 0.15))
        assert np.isnan(empty_V[-1]) and np.isfinite(empty_V[: len(empty_V) // 2]).all()
