"""The error of a voltage, as one likelihood, and what it is for: worn cells, cells in progress, and rows that were lost."""

import numpy as np
import pytest

from battery_env import NEW_CELL, Discharge, LeastSquares, Settings, calibrate, fit_cell, load_nasa_discharges, simulate
from battery_env.estimators.diagnosis.evidence import dropouts_of
from battery_env.estimators.error import ErrorModel
from battery_env.records import Samples
from tests.records import recorded
from tests.sweeps import sweep


@pytest.mark.parametrize("load", ["constant", "pulses"])
def test_whitened_errors_are_those_of_the_whole_covariance(load):
    time_s = np.cumsum(np.random.default_rng(0).uniform(1.0, 20.0, 80))
    current_A = np.where((load == "pulses") & (time_s % 100.0 < 50.0), 0.2, 2.0)
    error = ErrorModel(drift_V=0.05, noise_V=0.002, r_o=0.1, to=6.0, memory_C=900.0, load_on_C=100.0).along(time_s, current_A)
    place = np.cumsum(error.correlation_lengths)
    covariance = 0.05**2 * np.exp(-np.abs(place[:, None] - place)) + np.diag(error.noise_V**2)
    rows = np.random.default_rng(1).normal(size=(80, 3))
    white = error.whitened(rows)
    np.testing.assert_allclose(white.T @ white, rows.T @ np.linalg.solve(covariance, rows), rtol=1e-9)
    np.testing.assert_array_equal(ErrorModel(noise_V=0.5).along(time_s, current_A).whitened(rows), rows / 0.5)


def test_the_drift_over_a_charge_is_that_of_the_covariance():
    model = ErrorModel(drift_V=0.05, noise_V=0.002, r_o=0.1, to=6.0, memory_C=900.0)
    time_s = np.array([0.0, 60.0])
    (length,) = model.along(time_s, np.array([2.0, 2.0])).correlation_lengths[1:]
    variance_V2 = 2.0 * 0.05**2 * (1.0 - np.exp(-length))
    assert model.drift_after_V(120.0) == pytest.approx(np.sqrt(variance_V2))
    assert model.drift_after_V(0.0) == 0.0 and model.drift_after_V(1e6) == pytest.approx(0.05 * np.sqrt(2.0))


@pytest.mark.parametrize("slower", sweep(3.0, 0.5, 2.0))
@pytest.mark.parametrize("kinetics", sweep(0.3, 1.0))
@pytest.mark.parametrize("prior_C", [None, (5500.0, 55.0)])
def test_slow_diffusion_of_a_worn_cell_is_taken_for_neither_charge_nor_resistance(slower, kinetics, prior_C):
    cell = NEW_CELL.replace(tDiffusion=slower * NEW_CELL.tDiffusion, kn=kinetics * NEW_CELL.kn)
    worn = simulate(2.0, 5500.0, 0.13, load_unit="current", thermal=True, cell=cell, cut_off_V=2.7)
    found = Settings(prior_q_mobile_C=prior_C).calibrator().estimate(recorded(worn, slice(None, None, 10)))
    assert "contradicts" not in found.reason
    assert abs(found.q_mobile - 5500.0) < 3.0 * found.sd_q_mobile and abs(found.r_o - 0.13) < 3.0 * found.sd_r_o


@pytest.mark.parametrize(("cell", "cycle"), sweep(("B0005", 60), ("B0006", 20), ("B0005", 140), ("B0006", 100)))
@pytest.mark.parametrize("share", sweep(0.4, 0.2, 0.6, 0.8))
@pytest.mark.parametrize("rows", sweep(10, 20, 40))
def test_rows_that_are_lost_together_with_their_time_are_seen(cell, cycle, share, rows):
    whole = load_nasa_discharges(cell)[cycle].loaded_part(2.7)
    first = min(int(share * len(whole.time_s)), len(whole.time_s) - rows - 8)
    kept = np.r_[:first, first + rows : len(whole.time_s)]
    late_s = np.where(np.arange(len(whole.time_s)) < first, 0.0, whole.time_s[first + rows - 1] - whole.time_s[first - 1])
    record = Discharge((whole.time_s - late_s)[kept], whole.voltage_V[kept], whole.current_A[kept])
    found, sound = (Settings().calibrator().estimate(each) for each in (record, whole))
    assert not found.settled_q_mobile and "rows are missing together with their time" in found.reason
    assert "rows are missing" not in sound.reason


@pytest.mark.parametrize(("known", "other"), sweep(("B0005", "B0006"), ("B0006", "B0005")))
def test_a_cell_of_a_known_kind_is_settled_before_its_end(known, other):
    fit = fit_cell([load_nasa_discharges(known)[n] for n in (2, 80, 150)], cut_off_V=2.7)
    settings, settled = Settings(cell=fit), 0
    for discharge in load_nasa_discharges(other)[20:160:35]:
        whole = settings.calibrator().estimate(discharge.loaded_part(2.7))
        seen = discharge.until(0.98 * discharge.eod_time_s(2.7)).loaded_part(2.7)
        found = settings.calibrator().estimate(seen)
        settled += found.settled
        assert whole.settled and found.q_mobile == pytest.approx(whole.q_mobile, rel=0.04)
    assert settled >= 3


def test_a_load_that_is_switched_between_samples_says_little_of_the_resistance_until_it_is_followed():
    time_s, near_s = 10.0 * np.arange(40), np.arange(40.0)
    current_A = np.where(np.arange(40) // 10 % 2, 2.0, 1.0)
    model = ErrorModel(drift_V=0.05, noise_V=0.002, r_o=0.1, to=6.0, memory_C=900.0)
    far, near = model.along(time_s, current_A).noise_V, model.along(near_s, current_A).noise_V
    assert far[10] > 3.0 * near[10] and far[19] == pytest.approx(0.002, rel=0.01)


def test_voltages_beside_a_current_that_dropped_out_do_not_count():
    record = simulate(2.0, 6000.0, 0.15, load_unit="current", cut_off_V=3.0)
    current_A = record.current_A.copy()
    current_A[1000:1015] = 0.0
    dropped = Samples(record.time_s, record.voltage_V, current_A)
    (dropout,) = dropouts_of(dropped, NEW_CELL)
    assert dropout.begin_s == 1000.0 and 1015.0 < dropout.end_s < 1040.0 and dropout.charge_C == pytest.approx(30.0)
    found = LeastSquares(mismatch_V=0.02).estimate(dropped)
    assert found.r_o == pytest.approx(0.15, rel=0.02) and found.q_mobile == pytest.approx(6000.0, rel=0.01)


def test_voltages_that_are_left_out_are_named_with_their_time_and_their_charge_is_in_doubt():
    whole = load_nasa_discharges("B0005")[60]
    current_A = whole.current_A.copy()
    current_A[80:83] = 0.0
    with pytest.warns(UserWarning, match=f"changes for a moment at {whole.time_s[80]:.0f} s, and the voltage does not follow"):
        found = calibrate(Discharge(whole.time_s, whole.voltage_V, current_A))
    in_doubt_Ah = 2.0 * (whole.time_s[83] - whole.time_s[80]) / 3600.0
    assert in_doubt_Ah < found.sd_predicted_capacity_Ah < 1.3 * in_doubt_Ah
