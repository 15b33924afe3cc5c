"""The derivatives of the model are exact, and so is the least q_mobile."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env.electrochemistry import NEW_CELL, QNS, QPS, initial_state, simulate
from battery_env.record_model import RecordModel

CURRENT_A = np.repeat(np.random.default_rng(0).uniform(0.5, 2.5, 40), 75)
PARTLY_DISCHARGED = simulate(2.0, 6000.0, 0.15, until=600.0, load_unit="current").state[-1]


@pytest.mark.parametrize(
    "model",
    [
        RecordModel(),
        RecordModel(thermal=True),
        RecordModel(thermal=True, dt_s=2.0),
        RecordModel(initial=PARTLY_DISCHARGED),
        RecordModel(cell=NEW_CELL.replace(VolSFraction=0.2, kn=1000.0)),
        RecordModel(cell=NEW_CELL.replace(mC=2.0, kn=20.0, kp=20.0), thermal=True),
    ],
    ids=["isothermal", "thermal", "2 s", "partly discharged", "another cell", "a hot cell"],
)
def test_derivatives_are_those_of_the_simulated_voltage(model):
    current_A, q, r_o, dq, dr = CURRENT_A[:1200], 6000.0, 0.15, 0.03, 1e-5
    voltage_V, by_q, by_r = model.sensitivities(current_A, q, r_o)
    np.testing.assert_allclose(voltage_V, model.simulate(current_A, q, r_o).voltage_V, rtol=1e-13)
    more, less = (model.simulate(current_A, q + change, r_o).voltage_V for change in (dq, -dq))
    np.testing.assert_allclose(by_q, (more - less) / (2.0 * dq), rtol=1e-5, atol=1e-11)
    more, less = (model.simulate(current_A, q, r_o + change).voltage_V for change in (dr, -dr))
    np.testing.assert_allclose(by_r, (more - less) / (2.0 * dr), rtol=1e-5, atol=1e-9)


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


def test_a_coarse_look_is_near():
    stride = 6
    fine = RecordModel().sensitivities(CURRENT_A, 7000.0, 0.15)
    coarse = RecordModel().sensitivities(CURRENT_A.reshape(-1, stride).mean(axis=1), 7000.0, 0.15, stride)
    assert np.sqrt(np.mean((coarse[0] - fine[0][::stride]) ** 2)) < 0.02


def test_charges_of_the_start_move_along_with_q_mobile():
    model = RecordModel(initial=PARTLY_DISCHARGED)
    np.testing.assert_allclose(model.start(6000.0), PARTLY_DISCHARGED, rtol=1e-12)
    np.testing.assert_allclose(
        model.start(7000.0) - model.start(6000.0), initial_state(1000.0) * (np.arange(8) > 0), atol=1e-9
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_s": np.zeros(100)}, "time_s must increase"),
        ({"time_s": np.arange(99.0)}, "voltage_V has 100 samples, but time_s has 99"),
        ({"current_A": np.full(100, np.inf)}, "current_A must be finite, got inf at sample 0"),
    ],
)
def test_records_are_checked(changes, message):
    record = replace(simulate(8.0, 6000.0, 0.15, until=99.0), **changes)
    with pytest.raises(ValueError, match=message):
        RecordModel().grid(record)


@pytest.mark.parametrize(
    ("arguments", "message"), [({"dt_s": 20.0}, "dt must"), ({"initial": np.zeros(7)}, "initial must hold 8")]
)
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        RecordModel(**arguments)
