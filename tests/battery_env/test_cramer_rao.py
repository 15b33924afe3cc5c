"""The bound is the inverse of the information, of simulated discharges and of recorded ones."""

import numpy as np
import pytest

from battery_env import NEW_CELL, Estimate, RecordModel, load_nasa_discharges, simulate
from battery_env.estimators.cramer_rao import cramer_rao_bound, sensitivities

NOISE_V = 0.010


@pytest.fixture(scope="module")
def record():
    return simulate(8.0, 6000.0, NEW_CELL.r_o)


def test_it_is_the_inverse_of_the_information(record):
    slopes = sensitivities(record)
    gradient = np.column_stack([slopes.by_q_mobile_V_per_C, slopes.by_r_o_A, np.ones(len(record.time_s))])
    for n in (100, 1000, len(record.time_s)):
        covariance = NOISE_V**2 * np.linalg.inv(gradient[:n].T @ gradient[:n])
        bound = cramer_rao_bound(record, NOISE_V, offset=True)
        assert bound.sd_q_mobile[n - 1] == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-6)
        assert bound.sd_r_o[n - 1] == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-6)


def test_recorded_discharges_and_other_models():
    record = load_nasa_discharges("B0005")[0].loaded_part(2.7)
    at, model = Estimate(7000.0, 0.11), RecordModel(thermal=True)
    slopes = sensitivities(record, at, model)
    assert slopes.time_s.shape == slopes.by_r_o_A.shape == record.time_s.shape
    np.testing.assert_array_equal(slopes.time_s, record.time_s)
    # once the load has been on for a while; the heat of the resistance raises the voltage a little
    np.testing.assert_allclose(slopes.by_r_o_A[10:], -record.current_A[10:], rtol=0.1)
    np.testing.assert_allclose(slopes.voltage_V, RecordModel(thermal=True).voltage(record, at), rtol=0.0, atol=1e-12)
    assert 0.0 < cramer_rao_bound(record, NOISE_V, at=at, model=model).sd_q_mobile[-1] < 100.0
    with pytest.raises(ValueError, match="give the parameters of a recorded discharge"):
        sensitivities(record)


@pytest.mark.parametrize(
    ("arguments", "message"), [({"parameters": ["kn"]}, "one or both"), ({"voltage_noise_V": 0.0}, "greater than 0 V")]
)
def test_arguments_are_checked(record, arguments, message):
    with pytest.raises(ValueError, match=message):
        cramer_rao_bound(record, **({"voltage_noise_V": NOISE_V} | arguments))
