"""What is settled, and what is said when an estimate is not: no calibrator is sure of what its record contradicts."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate
from battery_env.estimators import Estimate, ExtendedKalmanFilter, LeastSquares
from battery_env.estimators.settling import start_reason
from battery_env.record_model import RecordModel
from battery_env.records import expected_current

CALIBRATORS = {
    "least squares": lambda **more: LeastSquares(thermal=True, mismatch_V=0.05, **more),
    "filter": lambda **more: ExtendedKalmanFilter(thermal=True, **more),
    "filter, mismatch": lambda **more: ExtendedKalmanFilter(thermal=True, mismatch_V=0.05, **more),
}
SECONDS = np.arange(60_000)


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


def stuck(record: Discharge, from_s: float, until_s: float) -> Discharge:
    """Its voltage sensor fails for a while."""
    failed = (record.time_s >= from_s) & (record.time_s < until_s)
    return replace(record, voltage_V=np.where(failed, record.voltage_V[failed.argmax()], record.voltage_V))


class TestStart:
    @pytest.mark.parametrize("times", [1.0, 5.0])
    @pytest.mark.parametrize("share", [0.05, 0.3, 0.5])
    def test_a_record_that_starts_late_is_never_settled_whatever_the_size_of_the_cell(self, whole, calibrator, share, times):
        late = cut(whole, round(share * len(whole.time_s)))
        estimate = calibrator().estimate(replace(late, current_A=times * late.current_A))
        assert not estimate.settled and estimate.reason.startswith("The record starts under load at 3.")

    def test_a_cell_that_was_not_full_at_rest_is_noticed_before_and_after_the_rest_is_cut_off(self, calibrator):
        raw = load_nasa_discharges("B0005")[60]
        low = Discharge(raw.time_s, raw.voltage_V - 0.2, raw.current_A)
        for record in (low, low.loaded_part(2.7)):
            estimate = calibrator().estimate(record)
            assert not estimate.settled and estimate.reason.startswith("The record starts at rest at 4.00 V")

    @pytest.mark.parametrize("soc", [0.9, 0.5])
    def test_so_is_a_large_cell_that_rested_with_less_charge(self, calibrator, soc):
        rest_and_load_A = np.append(np.zeros(300), np.full(40_000, 5.0))
        raw = simulated(rest_and_load_A, 18_000.0, 0.03, initial=initial_state(18_000.0, soc=soc))
        part = raw.loaded_part(2.8)
        for record in (raw, part, part.averaged(5.0), part.until(part.time_s[-2])):
            estimate = calibrator().estimate(record)
            assert not estimate.settled and estimate.reason.startswith("The record starts at rest at ")

    @pytest.mark.parametrize("cell", ["B0005", "B0006"])
    def test_every_recorded_discharge_starts_full_with_its_rest_and_a_fresh_one_without(self, cell):
        for n, discharge in enumerate(load_nasa_discharges(cell)):
            part = discharge.loaded_part(2.7)
            for record in (discharge, part) if n else (discharge, part, cut(part, 1)):
                assert start_reason(record.time_s, record.voltage_V, record.current_A, NEW_CELL) == ""

    def test_a_loaded_part_knows_whether_the_cell_rested_before_it(self):
        raw = load_nasa_discharges("B0005")[60]
        part = raw.loaded_part(2.7)
        for record in (part, part.until(1000.0), part.averaged(30.0), part.loaded_part(2.8)):
            assert record.starts_at_rest
        trickle = replace(raw, current_A=np.where(raw.current_A < 0.1, 0.1, raw.current_A))
        for record in (raw, cut(part, 5), trickle.loaded_part(2.7)):
            assert not record.starts_at_rest

    def test_a_voltage_above_that_of_a_full_cell_is_not_one(self, calibrator):
        whole = load_nasa_discharges("B0005")[60]
        estimate = calibrator().estimate(replace(whole, voltage_V=whole.voltage_V + 0.15))
        assert not estimate.settled and "above the 4.19 V of a full cell" in estimate.reason

    def test_who_gives_the_first_state_is_not_asked(self):
        full = simulate(2.0, 6000.0, 0.15, load_unit="current", thermal=True)
        late = full.part(600, len(full.time_s))
        assert LeastSquares(thermal=True, initial=late.state[0]).estimate(late).settled


class TestContradictions:
    @pytest.mark.parametrize("prior", [(8000.0, 80.0), (4000.0, 40.0)])
    def test_a_prior_far_off_is_not_settled_by_a_whole_discharge(self, whole, calibrator, prior):
        assert not calibrator(prior_q_mobile_C=prior).estimate(whole).settled

    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            ({"prior_q_mobile_C": (8000.0, 80.0)}, "The record falls to 2.80 V at 28"),
            ({"prior_q_mobile_C": (5400.0, 20.0)}, "The prior of q_mobile contradicts what the record says."),
            ({"r_o_bounds_ohm": (0.0, 0.14)}, "r_o is at a bound"),
        ],
    )
    def test_what_contradicts_is_named(self, arguments, reason):
        estimate = LeastSquares(thermal=True, mismatch_V=0.05, **arguments).estimate(simulated())
        assert not estimate.settled and estimate.reason.startswith(reason)

    @pytest.mark.parametrize("make", [LeastSquares, ExtendedKalmanFilter])
    def test_a_prior_that_agrees_leaves_a_whole_discharge_settled(self, make):
        estimate = make(thermal=True, mismatch_V=0.02, prior_q_mobile_C=(6050.0, 60.0)).estimate(simulated())
        assert estimate.settled and estimate.reason == ""

    def test_minutes_taken_for_seconds_make_no_cell(self, calibrator):
        record = simulated()
        estimate = calibrator().estimate(replace(record, time_s=record.time_s / 60.0))
        assert not estimate.settled
        if isinstance(calibrator(), LeastSquares):
            assert estimate.reason.startswith("No cell of this kind has such a q_mobile. Check that time is in s")

    @pytest.mark.parametrize("make", [LeastSquares, ExtendedKalmanFilter])
    @pytest.mark.parametrize("cell", ["B0005", "B0006"])
    def test_the_error_of_a_model_that_is_taken_for_exact_is_no_noise(self, cell, make):
        record = load_nasa_discharges(cell)[60].loaded_part(2.7)
        estimate = make(thermal=True).estimate(record)
        assert estimate.sd_q_mobile < 0.02 * estimate.q_mobile  # what white residuals would tell
        assert not estimate.settled and "larger mismatch_V" in estimate.reason

    @pytest.mark.parametrize("name", ["filter", "filter, mismatch"])
    def test_a_forgotten_reset_is_noticed(self, name):
        record, filter_ = simulated(), CALIBRATORS[name]()
        for voltage_V, current_A in [*zip(record.voltage_V, record.current_A, strict=True)] * 2:
            estimate = filter_.update(voltage_V, current_A, dt_s=1.0)
        assert not estimate.settled

    @pytest.mark.parametrize("rest_s", [0, 40])
    def test_a_pulse_of_charge_in_a_discharge_is_none(self, rest_s):
        rest_A = np.zeros(rest_s)
        cycle_A = np.concatenate([np.full(10, 4.0), rest_A, np.full(10, -3.0), rest_A, np.full(280, 2.0), np.zeros(300)])
        self.check_settled(simulated(np.tile(cycle_A, 40), noise_V=1e-6))

    def check_settled(self, record, q_mobile=6000.0, r_o=0.15):
        cell = NEW_CELL.replace(q_mobile=q_mobile, r_o=r_o)
        for estimator in (
            LeastSquares(thermal=True, mismatch_V=0.01),
            ExtendedKalmanFilter(cell=cell, thermal=True, mismatch_V=0.01),
        ):
            estimate = estimator.estimate(record)
            assert estimate.settled and estimate.q_mobile == pytest.approx(q_mobile, rel=0.01)

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
        record = simulated(rest_A + np.where(SECONDS[:20_000] % 60 < 30, 2.0, 0.0))
        late_V = np.append(record.voltage_V[[0, 0]], record.voltage_V[:-2])
        # the lowest voltage is at rest, and the record ends there
        pulses = cut(replace(record, voltage_V=late_V), 0, len(late_V) // 60 * 60)
        assert np.isclose(pulses.current_A[pulses.voltage_V.argmin()], rest_A, rtol=0.0, atol=1e-5)
        estimate = LeastSquares(thermal=True, mismatch_V=0.02).estimate(pulses)
        assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.01)

    @pytest.mark.parametrize(("q_mobile", "r_o", "load_A"), [(18_900.0, 0.02, 5.0), (6000.0, 0.04, 2.0)])
    def test_a_small_resistance_is_no_failed_sensor_and_no_charge(self, q_mobile, r_o, load_A):
        self.check_settled(simulated(np.where(SECONDS % 120 < 60, load_A, 0.2 * load_A), q_mobile, r_o), q_mobile, r_o)
        self.check_settled(simulated(load_A, q_mobile, r_o), q_mobile, r_o)

    def test_a_sensor_of_a_cell_of_small_resistance_is_still_watched(self):
        record = stuck(simulated(np.where(SECONDS % 120 < 60, 5.0, 1.0), 18_900.0, 0.02), 1800.0, np.inf)
        assert not LeastSquares(thermal=True, mismatch_V=0.01).estimate(record.until(2400.0)).settled

    def test_a_stuck_current_shows_in_a_voltage_that_rises(self, calibrator):
        record = simulated(np.where(SECONDS[:20_000] % 400 < 200, 2.0, 0.2))
        stuck_A = np.where(record.time_s > 1300.0, 2.0, record.current_A)
        estimate = calibrator(voltage_noise_V=1.0).estimate(replace(record, current_A=stuck_A))
        assert estimate.reason.startswith("The voltage rises by 0.")

    @pytest.mark.parametrize("r_o", [0.1, 0.15])
    @pytest.mark.parametrize("length", [1, 3, 8])
    def test_a_pulse_that_ends_before_the_voltage_has_followed_is_no_failed_sensor(self, length, r_o):
        since = SECONDS - 100
        record = simulated(np.where((since >= 0) & (since % 60 < length), 5.0, 1.0), r_o=r_o, noise_V=0.002)
        for estimator in (LeastSquares(thermal=True), ExtendedKalmanFilter(thermal=True)):
            estimate = estimator.estimate(record)
            assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.005)

    @pytest.mark.parametrize("length", [20, 30])
    def test_a_voltage_that_is_stuck_under_longer_ones_still_is(self, calibrator, length):
        record = simulated(np.where(SECONDS % 60 < length, 5.0, 1.0), noise_V=0.002)
        estimate = calibrator(voltage_noise_V=1.0).estimate(stuck(record, 605.0, np.inf).until(900.0))
        assert estimate.reason.startswith("The current changes by -4.00 A at 6")

    @pytest.mark.parametrize("make", [LeastSquares, ExtendedKalmanFilter])
    def test_times_are_those_of_the_clock_of_the_record(self, make):
        record = stuck(simulated(np.where(SECONDS < 100, 0.0, np.where(SECONDS % 200 < 100, 1.0, 3.0))), 1190.0, 1270.0)
        estimate = make(thermal=True, mismatch_V=0.05).estimate(replace(record, time_s=record.time_s + 50_000.0))
        assert estimate.reason == "The current changes by -2.00 A at 51200 s, and the voltage does not follow."


class TestPrecision:
    def test_half_a_discharge_does_not_tell_the_charge(self, whole):
        for name in ("least squares", "filter, mismatch"):
            estimate = CALIBRATORS[name]().estimate(cut(whole, 0, len(whole.time_s) // 2))
            assert not estimate.settled and estimate.reason.startswith("q_mobile is not known to 2 % yet")

    def test_beside_a_prior_it_is_said_what_the_record_lacks(self):
        record = load_nasa_discharges("B0006")[101].loaded_part(3.0)
        alone, carried = (CALIBRATORS["least squares"](**more) for more in ({}, {"prior_q_mobile_C": (5300.0, 50.0)}))
        assert carried.estimate(record).reason == (
            "q_mobile rests on its prior: the record alone does not determine it yet. "
            f"Without it {alone.estimate(record).reason}"
        )

    def test_a_small_current_does_not_tell_the_resistance_and_that_is_the_reason(self):
        estimate = LeastSquares(thermal=True, mismatch_V=0.05).estimate(simulated(0.5))
        assert not estimate.settled and estimate.sd_q_mobile < 0.02 * estimate.q_mobile
        assert estimate.reason.startswith("r_o is not known to 30 %") and "larger current" in estimate.reason

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


class TestForecasts:
    truth, model = Estimate(6500.0, 0.12), RecordModel(thermal=True)

    @pytest.mark.parametrize("low_A", [0.0, 0.5])
    @pytest.mark.parametrize("period", [60, 300])
    def test_pulses_go_on_at_their_mean_whatever_the_last_current(self, low_A, period):
        current_A = np.where(SECONDS % period < period // 2, 3.0, low_A)
        record = simulated(current_A, *(self.truth.q_mobile, self.truth.r_o), noise_V=1e-6)
        half, errors = len(record.time_s) // 2, []
        for stop in range(half, half + period, period // 4):
            seen = cut(record, 0, stop)
            assert expected_current(seen.time_s, seen.current_A).varied
            errors.append(self.model.forecast(seen, self.truth, 2.8).eod_time_s / record.time_s[-1] - 1.0)
        assert 0.0 < np.mean(errors) < 0.1  # under pulses the cut-off is reached earlier than under their mean
        assert np.max(errors) < 0.15

    def test_a_future_current_takes_the_place_of_the_assumption(self):
        record = simulated(np.where(SECONDS < 1000, 3.0, 1.0), 6500.0, 0.12, noise_V=1e-6)
        assert self.model.forecast(cut(record, 0, 900), self.truth, 2.8).eod_time_s < 0.6 * record.time_s[-1]
        known = self.model.forecast(cut(record, 0, 1001), self.truth, 2.8, future_current_A=1.0)
        assert known.eod_time_s == pytest.approx(record.time_s[-1], abs=2.0)
        with pytest.raises(ValueError, match="future_current_A must be finite and at least 0 A, got nan"):
            self.model.forecast(record, self.truth, future_current_A=np.nan)

    @pytest.mark.parametrize(
        ("current_A", "mean_A", "sd_limits_A"),
        [
            (np.full(3000, 2.0), 2.0, (0.0, 0.0)),
            (np.where(SECONDS[:3000] < 10, 0.0, 2.0), 2.0, (0.0, 0.0)),
            (np.where(SECONDS[:3000] < 2000, 2.0, 0.0), 0.0, (0.0, 0.0)),
            (np.where(SECONDS[:3000] % 60 < 30, 2.0, 0.0), 1.0, (0.0, 0.1)),
            (np.linspace(1.0, 3.0, 3000), 2.5, (0.5, 1.0)),
        ],
        ids=["constant", "after a rest", "switched off", "pulses", "drift"],
    )
    def test_what_a_record_lets_expect_of_its_load(self, current_A, mean_A, sd_limits_A):
        found = expected_current(SECONDS[:3000], current_A)
        assert found.mean_A == pytest.approx(mean_A, abs=0.02)
        assert sd_limits_A[0] <= found.sd_A <= sd_limits_A[1]
