"""Discharges that do not start full: the charge is stated, or told from the rest before the load."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env import Discharge, LeastSquares, RecordModel, fit_cell, load_nasa_discharges, soc_from_rest, track_life
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate
from battery_env.lab.command_line import NOT_SETTLED, SETTLED
from battery_env.loads import constant
from battery_env.sensors import SensorErrors
from tests.sweeps import sweep
from tests.terminal import write

REST_S = 200


def partly_charged(soc: float, noise_V: float = 0.002):
    current_A = np.append(np.zeros(REST_S), np.full(20_000, 2.0))
    start = initial_state(6000.0, soc=soc)
    record = simulate(current_A, 6000.0, 0.15, load_unit="current", thermal=True, initial=start, cut_off_V=2.8)
    return SensorErrors(noise_V).apply(record, np.random.default_rng(0))


@pytest.fixture(scope="module")
def record():
    return partly_charged(0.8)


class TestRest:
    @pytest.mark.parametrize("soc", sweep(0.5, 0.15, 0.97))
    def test_it_tells_the_charge_within_its_error(self, soc):
        found = soc_from_rest(partly_charged(soc, noise_V=0.005))
        assert found.samples == REST_S and found.reason == ""
        assert abs(found.soc - soc) < 2.0 * found.sd_soc < 0.3

    def test_errors_of_sensor_and_model_widen_it(self, record):
        exact, noisy, mismatched = (
            soc_from_rest(record, **errors) for errors in ({}, {"voltage_noise_V": 0.05}, {"mismatch_V": 0.05})
        )
        assert exact.sd_soc < 0.2 * noisy.sd_soc and noisy.sd_soc < 0.8 * mismatched.sd_soc
        assert exact.soc == noisy.soc == mismatched.soc

    def test_a_voltage_that_still_relaxes_says_less(self, record):
        relaxing = replace(record, voltage_V=record.voltage_V - 0.05 * np.exp(-record.time_s / 100.0))
        steady, moving = soc_from_rest(record), soc_from_rest(relaxing)
        assert abs(moving.soc - 0.8) < 2.0 * moving.sd_soc and moving.sd_soc > 2.0 * steady.sd_soc

    @pytest.mark.parametrize("samples_at_rest", [0, 30])
    def test_less_than_a_minute_does_not_tell_it(self, record, samples_at_rest):
        found = soc_from_rest(record.part(REST_S - samples_at_rest, len(record.time_s)))
        assert found.samples == samples_at_rest and found.reason.startswith("The record does not start with a minute at rest")


class TestLeastSquares:
    @pytest.mark.parametrize("soc", sweep(0.7, 0.3, 0.95))
    def test_a_charge_that_is_known_gives_both_parameters(self, soc):
        estimate = LeastSquares(thermal=True, initial_soc=soc).estimate(partly_charged(soc, noise_V=0.0))
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=1e-6) and estimate.settled

    def test_a_doubt_moves_the_parameters_as_far_as_it_says(self, record):
        stated, off = (
            LeastSquares(thermal=True, voltage_noise_V=0.002, initial_soc=soc).estimate(record)
            for soc in ((0.8, 0.005), (0.805, 0.005))
        )
        assert off.q_mobile - 6000.0 == pytest.approx(-stated.sd_q_mobile, rel=0.1)
        assert abs(off.r_o - 0.15) == pytest.approx(stated.sd_r_o, rel=0.25)
        assert stated.settled
        doubtful = LeastSquares(thermal=True, voltage_noise_V=0.002, initial_soc=(0.8, 0.05)).estimate(record)
        assert not doubtful.settled and "the charge at the start" in doubtful.reason


def test_constants_whose_rest_does_not_rise_with_the_charge_do_not_tell_it():
    discharges = load_nasa_discharges("B0005")
    # at one load the voltage at rest and the drop under load are not told apart
    cell = fit_cell([discharges[n] for n in (0, 84, 167)]).cell
    found = soc_from_rest(partly_charged(0.8), cell)
    assert "whose voltage tells the charge with these constants" in found.reason and found.sd_soc >= 0.0


class TestCommandLine:
    def test_a_stated_charge(self, record, tmp_path, terminal):
        options = [write(record, tmp_path / "record.csv"), "--mismatch", "0.02", "--nominal", "2"]
        row = terminal.row(*options, "--initial-soc", "0.8", status=NOT_SETTLED)
        assert row["initial_soc"] == 0.8
        assert row["q_mobile_C"] == pytest.approx(6000.0, rel=0.02)
        # the capacity is that of a full cell
        full = RecordModel(NEW_CELL.replace(q_mobile=6000.0, r_o=0.15), thermal=True)
        (full,) = full.capacity_Ah([constant(2.0, "current")], 2.8)
        assert row["capacity_Ah"] is None and row["predicted_capacity_Ah"] == pytest.approx(full, rel=0.03)
        assert row["state_of_health"] == pytest.approx(full / 2.0, rel=0.03)
        assert "state initial_soc (--initial-soc)" in terminal.row(*options, status=NOT_SETTLED)["reason"]
        assert terminal.row(*options, "--initial-soc", "0.8,0.05", status=NOT_SETTLED)["sd_initial_soc"] == 0.05

    def test_a_rest(self, record, tmp_path, terminal):
        path, options = tmp_path / "record.csv", ["--mismatch", "0.001", "--initial-soc", "rest"]
        row = terminal.row(write(record, path), *options, status=SETTLED)
        assert row["initial_soc"] == pytest.approx(0.8, abs=0.02) and 0.0 < row["sd_initial_soc"] < 0.02
        assert abs(row["q_mobile_C"] - 6000.0) < 3.0 * row["sd_q_mobile_C"] < 500.0
        row = terminal.row(write(record.part(REST_S - 20, len(record.time_s)), path), *options, status=NOT_SETTLED)
        assert "The record does not start with a minute at rest" in row["reason"]


class TestOthers:
    def test_constants_are_not_fitted_to_full_cells_and_others(self):
        record = load_nasa_discharges("B0005")[0]
        low = Discharge(record.time_s, record.voltage_V - 0.2, record.current_A)
        with pytest.raises(ValueError, match=r"discharge 2 starts at rest at 3.99 V, discharge B0005:1 at 4.19 V"):
            fit_cell([record, low])

    def test_a_life_is_of_full_cells(self):
        with pytest.raises(ValueError, match="must take discharges to start full"):
            track_life(load_nasa_discharges("B0005")[:2], 2.7, LeastSquares(initial_soc=0.8))
