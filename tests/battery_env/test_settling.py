"""What is settled, and what is said when an estimate is not: no calibrator is sure of what its record contradicts."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate
from battery_env.estimators import Estimate, ExtendedKalmanFilter, LeastSquares
from battery_env.estimators.settling import sensor_reason, start_reason, white_noise_V
from battery_env.records import expected_current

CALIBRATORS = {
    "least squares": lambda **more: LeastSquares(thermal=True, mismatch_V=0.05, **more),
    "filter": lambda **more: ExtendedKalmanFilter(thermal=True, **more),
    "filter, mismatch": lambda **more: ExtendedKalmanFilter(thermal=True, mismatch_V=0.05, **more),
}


@pytest.fixture(params=CALIBRATORS.values(), ids=list(CALIBRATORS))
def calibrator(request):
    return request.param


def simulated(current_A=2.0, q_mobile=6000.0, r_o=0.15, noise_V=0.005, **more) -> Discharge:
    record = simulate(current_A, q_mobile, r_o, load_unit="current", thermal=True, cut_off_V=2.8, **more)
    voltage_V = record.voltage_V + np.random.default_rng(0).normal(0.0, noise_V, len(record.voltage_V))
    return Discharge(record.time_s, voltage_V, record.current_A)


@pytest.fixture(scope="module", params=["simulated", "B0005", "B0006"])
def whole(request) -> Discharge:
    if request.param == "simulated":
        return simulated()
    return load_nasa_discharges(request.param)[60].loaded_part(2.7)


def cut(record: Discharge, start: int, stop: int | None = None) -> Discharge:
    return Discharge(record.time_s[start:stop], record.voltage_V[start:stop], record.current_A[start:stop])


class TestStart:
    @pytest.mark.parametrize("share", [0.05, 0.1, 0.3, 0.5])
    def test_a_record_that_starts_late_is_never_settled(self, whole, calibrator, share):
        estimate = calibrator().estimate(cut(whole, round(share * len(whole.time_s))))
        assert not estimate.settled and estimate.reason.startswith("The record starts under load at 3.")

    def test_nor_is_a_stream(self):
        record, filter_ = simulated(), ExtendedKalmanFilter(thermal=True)
        for voltage_V, current_A in zip(record.voltage_V[400:], record.current_A[400:], strict=True):
            estimate = filter_.update(voltage_V, current_A, dt_s=1.0)
        assert not estimate.settled and estimate.reason.startswith("The record starts under load")

    def test_a_cell_that_was_not_full_at_rest_is_noticed_before_and_after_the_rest_is_cut_off(self, calibrator):
        raw = load_nasa_discharges("B0005")[60]
        low = Discharge(raw.time_s, raw.voltage_V - 0.2, raw.current_A)
        for record in (low, low.loaded_part(2.7)):
            estimate = calibrator().estimate(record)
            assert not estimate.settled and estimate.reason.startswith("The record starts at rest at 4.00 V")

    @pytest.mark.parametrize("cell", ["B0005", "B0006"])
    def test_every_recorded_discharge_starts_full_with_its_rest_and_a_fresh_one_without(self, cell):
        discharges = load_nasa_discharges(cell)
        for n, discharge in enumerate(discharges):
            part = discharge.loaded_part(2.7)
            for record in (discharge, part) if n else (discharge, part, cut(part, 1)):
                assert start_reason(record.time_s, record.voltage_V, record.current_A, NEW_CELL) == ""

    @pytest.mark.parametrize("soc", [0.9, 0.7, 0.5])
    def test_nor_is_a_large_cell_that_rested_with_less_charge(self, calibrator, soc):
        rest_and_load_A = np.append(np.zeros(300), np.full(40_000, 5.0))
        raw = simulated(rest_and_load_A, 18_000.0, 0.03, initial=initial_state(18_000.0, soc=soc))
        part = raw.loaded_part(2.8)
        for record in (raw, part, part.averaged(5.0), part.until(part.time_s[-2])):
            estimate = calibrator().estimate(record)
            assert not estimate.settled and estimate.reason.startswith("The record starts at rest at ")

    @pytest.mark.parametrize("times", [4.0, 5.0])
    @pytest.mark.parametrize("share", [0.05, 0.3])
    def test_nor_is_one_that_starts_late(self, calibrator, times, share):
        real = load_nasa_discharges("B0006")[100].loaded_part(2.7)
        late = cut(real, round(share * len(real.time_s)))
        estimate = calibrator().estimate(replace(late, current_A=times * late.current_A))
        assert not estimate.settled and estimate.reason.startswith("The record starts ")

    def test_a_loaded_part_knows_whether_the_cell_rested_before_it(self):
        raw = load_nasa_discharges("B0005")[60]
        part = raw.loaded_part(2.7)
        assert not raw.starts_at_rest and part.starts_at_rest
        assert part.until(1000.0).starts_at_rest and part.averaged(30.0).starts_at_rest
        assert part.loaded_part(2.8).starts_at_rest and not cut(part, 5).starts_at_rest
        trickle_A = np.where(raw.current_A < 0.1, 0.1, raw.current_A)
        assert not replace(raw, current_A=trickle_A).loaded_part(2.7).starts_at_rest

    def test_a_voltage_above_that_of_a_full_cell_is_not_one(self):
        assert "above the 4.19 V of a full cell" in start_reason(np.zeros(1), np.array([4.35]), np.zeros(1), NEW_CELL)

    def test_who_gives_the_first_state_is_not_asked(self):
        full = simulate(2.0, 6000.0, 0.15, load_unit="current", thermal=True)
        late = full.part(600, len(full.time_s))
        assert LeastSquares(thermal=True, initial=late.state[0]).estimate(late).settled


class TestContradictions:
    @pytest.mark.parametrize("prior", [(8000.0, 80.0), (4000.0, 40.0)])
    def test_a_prior_far_off_is_not_settled_by_a_whole_discharge(self, whole, calibrator, prior):
        estimate = calibrator(prior_q_mobile_C=prior).estimate(whole)
        assert not estimate.settled

    def test_the_contradicting_end_and_prior_are_named(self):
        far = LeastSquares(thermal=True, mismatch_V=0.05, prior_q_mobile_C=(8000.0, 80.0)).estimate(simulated())
        assert far.reason.startswith("The record falls to 2.80 V at 28") and "where this estimate says 3" in far.reason
        near = LeastSquares(thermal=True, mismatch_V=0.05, prior_q_mobile_C=(5400.0, 20.0)).estimate(simulated())
        assert near.reason == "The prior of q_mobile contradicts what the record says."

    @pytest.mark.parametrize("make", [LeastSquares, ExtendedKalmanFilter])
    def test_a_prior_that_agrees_leaves_a_whole_discharge_settled(self, make):
        estimate = make(thermal=True, mismatch_V=0.02, prior_q_mobile_C=(6050.0, 60.0)).estimate(simulated())
        assert estimate.settled and estimate.reason == ""

    def test_minutes_taken_for_seconds_make_no_cell(self, calibrator):
        record = simulated()
        estimate = calibrator().estimate(Discharge(record.time_s / 60.0, record.voltage_V, record.current_A))
        assert not estimate.settled
        if isinstance(calibrator(), LeastSquares):
            assert estimate.reason.startswith("No cell of this kind has such a q_mobile. Check that time is in s")

    def test_each_bound_is_named(self):
        estimate = LeastSquares(thermal=True, r_o_bounds_ohm=(0.0, 0.14)).estimate(simulated())
        assert estimate.reason.startswith("r_o is at a bound")

    def test_residuals_of_a_model_that_is_taken_for_exact_are_no_noise(self):
        estimate = LeastSquares(thermal=True).estimate(load_nasa_discharges("B0005")[60].loaded_part(2.7))
        assert estimate.sd_q_mobile < 0.01 * estimate.q_mobile  # what white residuals would tell
        assert not estimate.settled and "larger mismatch_V" in estimate.reason

    @pytest.mark.parametrize("share", [0.5, 0.75, 1.0])
    @pytest.mark.parametrize("cell", ["B0005", "B0006"])
    def test_nor_are_the_innovations_of_a_filter(self, cell, share):
        record = load_nasa_discharges(cell)[60].loaded_part(2.7)
        estimate = ExtendedKalmanFilter(thermal=True).estimate(cut(record, 0, round(share * len(record.time_s))))
        assert estimate.sd_q_mobile < 0.02 * estimate.q_mobile
        assert not estimate.settled and "larger mismatch_V" in estimate.reason

    @pytest.mark.parametrize("make", [CALIBRATORS["filter"], CALIBRATORS["filter, mismatch"]])
    def test_a_forgotten_reset_is_noticed(self, make):
        record, filter_ = simulated(), make()
        for voltage_V, current_A in [*zip(record.voltage_V, record.current_A, strict=True)] * 2:
            estimate = filter_.update(voltage_V, current_A, dt_s=1.0)
        assert not estimate.settled

    @pytest.mark.parametrize("length", [30, 200])
    def test_a_current_that_drops_out_is_noticed(self, calibrator, length):
        record = simulated()
        current_A = record.current_A.copy()
        current_A[1500 : 1500 + length] = 0.0
        assert not calibrator().estimate(replace(record, current_A=current_A)).settled

    def test_one_wild_sample_is_forgiven_by_the_filter(self):
        record = simulated()
        voltage_V = record.voltage_V.copy()
        voltage_V[1500] = 0.0
        assert ExtendedKalmanFilter(thermal=True).estimate(replace(record, voltage_V=voltage_V)).settled

    @pytest.mark.parametrize("rest_A", [0.0, 1e-6])
    def test_the_current_that_a_sensor_shows_at_rest_is_none(self, rest_A):
        record = simulated(rest_A + np.where(np.arange(20_000) % 60 < 30, 2.0, 0.0))
        late_V = np.append(record.voltage_V[[0, 0]], record.voltage_V[:-2])
        # the lowest voltage is at rest, and the record ends there
        pulses = cut(replace(record, voltage_V=late_V), 0, len(late_V) // 60 * 60)
        assert np.isclose(pulses.current_A[pulses.voltage_V.argmin()], rest_A, rtol=0.0, atol=1e-5)
        estimate = LeastSquares(thermal=True, mismatch_V=0.02).estimate(pulses)
        assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.01)

    @pytest.mark.parametrize(("q_mobile", "r_o", "load_A"), [(18_900.0, 0.02, 5.0), (6000.0, 0.04, 2.0)])
    def test_a_small_resistance_is_no_voltage_that_does_not_follow(self, q_mobile, r_o, load_A):
        pulses_A = np.where(np.arange(60_000) % 120 < 60, load_A, 0.2 * load_A)
        record = simulated(pulses_A, q_mobile, r_o)
        estimate = LeastSquares(thermal=True, mismatch_V=0.01).estimate(record)
        assert estimate.settled and estimate.q_mobile == pytest.approx(q_mobile, rel=0.01)
        cell = NEW_CELL.replace(q_mobile=q_mobile, r_o=r_o)
        estimate = ExtendedKalmanFilter(cell=cell, thermal=True, mismatch_V=0.01).estimate(record)
        assert estimate.settled and estimate.q_mobile == pytest.approx(q_mobile, rel=0.01)

    @pytest.mark.parametrize("load_A", [5.0, 10.0])
    def test_nor_is_its_constant_discharge_a_charge(self, load_A):
        cell = NEW_CELL.replace(q_mobile=18_000.0, r_o=0.03)
        estimate = ExtendedKalmanFilter(cell=cell, thermal=True, mismatch_V=0.01).estimate(simulated(load_A, 18_900.0, 0.02))
        assert estimate.settled and estimate.q_mobile == pytest.approx(18_900.0, rel=0.01)

    def test_a_sensor_of_a_cell_of_small_resistance_is_still_watched(self):
        record = simulated(np.where(np.arange(60_000) % 120 < 60, 5.0, 1.0), 18_900.0, 0.02)
        stuck_V = np.where(record.time_s < 1800.0, record.voltage_V, record.voltage_V[1800])
        part = replace(record, voltage_V=stuck_V).until(2400.0)
        estimate = LeastSquares(thermal=True, mismatch_V=0.01).estimate(part)
        assert not estimate.settled

    def test_a_stuck_current_shows_in_a_voltage_that_rises(self):
        record = simulated(np.where(np.arange(20_000) % 400 < 200, 2.0, 0.2))
        arrays = record.time_s, record.voltage_V
        assert sensor_reason(*arrays, record.current_A) == ""
        stuck_A = np.where(record.time_s > 1300.0, 2.0, record.current_A)
        assert sensor_reason(*arrays, stuck_A).startswith("The voltage rises by 0.30 V at 45")

    @pytest.mark.parametrize("r_o", [0.1, 0.15])
    @pytest.mark.parametrize("length", [1, 2, 3, 4, 8])
    def test_a_pulse_that_ends_before_the_voltage_has_followed_is_no_failed_sensor(self, length, r_o):
        since = np.arange(60_000) - 100
        record = simulated(np.where((since >= 0) & (since % 60 < length), 5.0, 1.0), r_o=r_o, noise_V=0.002)
        for calibrator in (LeastSquares(thermal=True), ExtendedKalmanFilter(thermal=True)):
            estimate = calibrator.estimate(record)
            assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.005)

    @pytest.mark.parametrize("length", [20, 30])
    def test_a_voltage_that_is_stuck_under_longer_ones_still_is(self, length):
        record = simulated(np.where(np.arange(60_000) % 60 < length, 5.0, 1.0), noise_V=0.002)
        stuck_V = np.where(record.time_s < 605.0, record.voltage_V, record.voltage_V[605])
        part = replace(record, voltage_V=stuck_V).until(900.0)
        assert sensor_reason(part.time_s, part.voltage_V, part.current_A).startswith("The current changes by -4.00 A at 6")
        filtered = ExtendedKalmanFilter(thermal=True).estimate(part)
        assert filtered.reason.startswith("The current changes by -4.00 A at 6")

    @pytest.mark.parametrize("rest_s", [0, 40])
    def test_a_pulse_of_charge_in_a_discharge_is_no_forgotten_reset(self, rest_s):
        rest_A = np.zeros(rest_s)
        cycle_A = np.concatenate([np.full(10, 4.0), rest_A, np.full(10, -3.0), rest_A, np.full(280, 2.0), np.zeros(300)])
        record = simulated(np.tile(cycle_A, 40), noise_V=1e-6)
        for calibrator in (LeastSquares(thermal=True), ExtendedKalmanFilter(thermal=True)):
            estimate = calibrator.estimate(record)
            assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.005)

    def test_times_are_those_of_the_clock_of_the_record(self):
        whole = simulated(np.where(np.arange(60_000) < 100, 0.0, np.where(np.arange(60_000) % 200 < 100, 1.0, 3.0)))
        stuck_V = np.where(abs(whole.time_s - 1230.0) > 40.0, whole.voltage_V, whole.voltage_V[1190])
        record = replace(whole, time_s=whole.time_s + 50_000.0, voltage_V=stuck_V)
        for make in (LeastSquares, ExtendedKalmanFilter):
            reason = make(thermal=True, mismatch_V=0.05).estimate(record).reason
            assert reason == "The current changes by -2.00 A at 51200 s, and the voltage does not follow."
        # a stream has no clock but that of its samples
        filter_ = ExtendedKalmanFilter(thermal=True, mismatch_V=0.05)
        filter_.estimate(record)
        for voltage_V, current_A in zip(record.voltage_V[:1400], record.current_A[:1400], strict=True):
            estimate = filter_.update(voltage_V, current_A, dt_s=1.0)
        assert estimate.reason == "The current changes by -2.00 A at 1200 s, and the voltage does not follow."


class TestPrecision:
    def test_half_a_discharge_does_not_tell_the_charge(self, whole):
        for name in ("least squares", "filter, mismatch"):
            estimate = CALIBRATORS[name]().estimate(cut(whole, 0, len(whole.time_s) // 2))
            assert not estimate.settled and estimate.reason.startswith("q_mobile is not known to 2 % yet")

    def test_beside_a_prior_it_is_said_what_the_record_lacks(self):
        record = load_nasa_discharges("B0006")[101].loaded_part(3.0)
        alone = LeastSquares(thermal=True, mismatch_V=0.05).estimate(record)
        carried = LeastSquares(thermal=True, mismatch_V=0.05, prior_q_mobile_C=(5300.0, 50.0)).estimate(record)
        assert carried.reason == (
            f"q_mobile rests on its prior: the record alone does not determine it yet. Without it {alone.reason}"
        )

    def test_a_small_current_does_not_tell_the_resistance_and_that_is_the_reason(self):
        estimate = LeastSquares(thermal=True, mismatch_V=0.05).estimate(simulated(0.5))
        assert estimate.sd_q_mobile < 0.02 * estimate.q_mobile
        assert (
            not estimate.settled
            and estimate.reason.startswith("r_o is not known to 30 %")
            and "larger current" in estimate.reason
        )

    @pytest.mark.parametrize("name", ["least squares", "filter, mismatch"])
    @pytest.mark.parametrize("cell", ["B0005", "B0006"])
    def test_whole_discharges_settle(self, cell, name):
        for record in load_nasa_discharges(cell)[::24]:
            estimate = CALIBRATORS[name]().estimate(record.loaded_part(2.7))
            assert estimate.settled and estimate.reason == ""

    def test_the_gain_of_the_current_sensor_is_covered_where_it_is_stated(self, calibrator):
        record = simulated()
        for gain in (0.97, 1.03):
            seen = replace(record, current_A=gain * record.current_A)
            stated, unstated = calibrator(current_gain_sd=0.015).estimate(seen), calibrator().estimate(seen)
            assert stated.q_mobile == unstated.q_mobile == pytest.approx(gain * 6000.0, rel=0.005)
            assert abs(stated.q_mobile - 6000.0) < 3.0 * stated.sd_q_mobile
            assert stated.sd_r_o == pytest.approx(np.hypot(unstated.sd_r_o, 0.015 * stated.r_o))

    def test_the_noise_of_residuals_is_told_from_their_drift(self):
        drift_V = 0.1 * np.sin(np.linspace(0.0, 6.0, 2000))
        residual_V = drift_V + np.random.default_rng(0).normal(0.0, 0.004, 2000)
        assert white_noise_V(residual_V) == pytest.approx(0.004, rel=0.1)

    @pytest.mark.parametrize(("cell", "index"), [("B0005", 80), ("B0006", 85), ("B0006", 160)])
    def test_the_filter_states_what_the_error_of_its_model_leaves_open(self, cell, index):
        record = load_nasa_discharges(cell)[index].loaded_part(2.7)
        filtered, fitted = (CALIBRATORS[name]().estimate(record) for name in ("filter, mismatch", "least squares"))
        assert abs(filtered.q_mobile - fitted.q_mobile) < 1.5 * filtered.sd_q_mobile
        assert filtered.settled and 0.005 < filtered.sd_q_mobile / filtered.q_mobile < 0.011

    @pytest.mark.parametrize("factor", [0.8, 1.2])
    @pytest.mark.parametrize("every", [1, 10])
    def test_so_does_it_where_a_constant_is_wrong_however_many_samples_there_are(self, factor, every):
        record = simulated(cell=NEW_CELL.replace(tDiffusion=factor * NEW_CELL.tDiffusion))
        seen = Discharge(*(column[::every] for column in (record.time_s, record.voltage_V, record.current_A)))
        estimate = CALIBRATORS["filter, mismatch"]().estimate(seen)
        assert 0.0 < abs(estimate.q_mobile - 6000.0) < 2.0 * estimate.sd_q_mobile < 0.03 * 6000.0

    def test_one_setting_tells_the_filter_of_the_error_of_its_model(self):
        record = simulated()
        derived = ExtendedKalmanFilter(mismatch_V=0.05).estimate(record)
        assert derived == ExtendedKalmanFilter(mismatch_V=0.05, voltage_noise_V=0.05, offset_sd_V=0.05).estimate(record)
        plain = ExtendedKalmanFilter().estimate(record)
        assert plain == ExtendedKalmanFilter(voltage_noise_V=0.005, offset_sd_V=0.005).estimate(record)


class TestForecasts:
    truth = Estimate(6500.0, 0.12)

    @pytest.mark.parametrize("low_A", [0.0, 0.5])
    @pytest.mark.parametrize("period", [60, 300])
    def test_pulses_go_on_at_their_mean_whatever_the_last_current(self, low_A, period):
        current_A = np.where(np.arange(40_000) % period < period // 2, 3.0, low_A)
        record = simulated(current_A, *(self.truth.q_mobile, self.truth.r_o), noise_V=1e-6)
        fit, half = LeastSquares(thermal=True), len(record.time_s) // 2
        errors = []
        for stop in range(half, half + period, period // 4):
            seen = cut(record, 0, stop)
            assert expected_current(seen.time_s, seen.current_A).varied
            errors.append(fit.model.forecast(seen, self.truth, 2.8).eod_time_s / record.time_s[-1] - 1.0)
        assert 0.0 < np.mean(errors) < 0.1  # under pulses the cut-off is reached earlier than under their mean
        assert np.max(errors) < 0.15

    def test_a_future_current_takes_the_place_of_the_assumption(self):
        record = simulated(np.where(np.arange(40_000) < 1000, 3.0, 1.0), 6500.0, 0.12, noise_V=1e-6)
        seen, fit = cut(record, 0, 900), LeastSquares(thermal=True)
        assert fit.model.forecast(seen, self.truth, 2.8).eod_time_s < 0.6 * record.time_s[-1]
        later = cut(record, 0, 1001)
        assert fit.model.forecast(later, self.truth, 2.8, future_current_A=1.0).eod_time_s == pytest.approx(
            record.time_s[-1], abs=2.0
        )
        with pytest.raises(ValueError, match="future_current_A must be finite and at least 0 A, got nan"):
            fit.model.forecast(seen, self.truth, future_current_A=np.nan)

    def test_a_constant_load_goes_on_and_one_that_was_switched_off_does_not(self):
        time_s = np.arange(100.0)
        assert expected_current(time_s, np.full(100, 2.0)) == (2.0, False, 0.0)
        assert expected_current(time_s, np.where(time_s < 60.0, 2.0, 0.0)).mean_A == 0.0
        assert expected_current(time_s, np.where(time_s < 10.0, 0.0, 2.0)) == (2.0, False, 0.0)

    def test_a_wandering_load_is_less_sure_than_pulses(self):
        time_s = np.arange(3000.0)
        pulses = expected_current(time_s, np.where(time_s % 60.0 < 30.0, 2.0, 0.0))
        drift = expected_current(time_s, np.linspace(1.0, 3.0, 3000))
        assert pulses.mean_A == pytest.approx(1.0, abs=0.02) and pulses.sd_A < 0.1
        assert drift.mean_A == pytest.approx(2.5, abs=0.01) and drift.sd_A > 0.5
