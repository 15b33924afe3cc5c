"""Stretches of a load that were not logged: an estimate is not sure of a charge that nobody saw."""

import numpy as np
import pytest

from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import simulate
from battery_env.estimators import ExtendedKalmanFilter, LeastSquares
from battery_env.estimators.gaps import UNSURE, find_gaps

CALIBRATORS = {
    "least squares": lambda: LeastSquares(thermal=True, mismatch_V=0.05),
    "filter": lambda: ExtendedKalmanFilter(thermal=True, mismatch_V=0.05),
}
NEITHER = "the voltage does not fall by what"


@pytest.fixture(params=CALIBRATORS.values(), ids=list(CALIBRATORS))
def calibrator(request):
    return request.param()


@pytest.fixture(scope="module", params=[("B0005", 20), ("B0006", 100)], ids=["B0005", "B0006"])
def whole(request) -> Discharge:
    cell, n = request.param
    return load_nasa_discharges(cell)[n].loaded_part(2.7)


def changed(record: Discharge, kept=slice(None), late_s=0.0) -> Discharge:
    return Discharge(
        (record.time_s + late_s)[kept], record.voltage_V[kept], record.current_A[kept], starts_at_rest=record.starts_at_rest
    )


def jumped(record: Discharge, at_s: float, by_s: float) -> Discharge:
    return changed(record, late_s=np.where(record.time_s > at_s, by_s, 0.0))


def lost(record: Discharge, from_s: float, to_s: float) -> Discharge:
    return changed(record, (record.time_s <= from_s) | (record.time_s > to_s))


def simulated(load_A=2.0, noise_V=0.003, every_s=1, **more) -> Discharge:
    record = simulate(load_A, 6000.0, 0.15, load_unit="current", thermal=True, cut_off_V=2.6, **more)
    voltage_V = record.voltage_V + np.random.default_rng(0).normal(0.0, noise_V, len(record.voltage_V))
    return Discharge(*(column[::every_s] for column in (record.time_s, voltage_V, record.current_A)), starts_at_rest=True)


class TestRealCells:
    @pytest.mark.parametrize("at_s", [400.0, 1700.0])
    @pytest.mark.parametrize("by_s", [120.0, 600.0, 3600.0])
    def test_a_clock_that_jumps_is_noticed(self, whole, calibrator, at_s, by_s):
        estimate, right = calibrator.estimate(jumped(whole, at_s, by_s)), calibrator.estimate(whole)
        assert right.settled and not estimate.settled
        if by_s == 600.0 or isinstance(calibrator, LeastSquares):
            assert NEITHER in estimate.reason
            start_s = whole.time_s[whole.time_s <= at_s][-1]
            assert estimate.reason.startswith(f"No sample lies between {start_s:.0f} s and ")
        assert estimate.sd_q_mobile > 0.9 * (estimate.q_mobile - right.q_mobile)

    @pytest.mark.parametrize("from_s", [400.0, 1700.0])
    @pytest.mark.parametrize("length_s", [120.0, 600.0])
    def test_rows_that_are_lost_under_load_do_no_harm(self, whole, calibrator, from_s, length_s):
        estimate, right = calibrator.estimate(lost(whole, from_s, from_s + length_s)), calibrator.estimate(whole)
        assert estimate.settled and estimate.q_mobile == pytest.approx(right.q_mobile, rel=0.01)

    def test_no_recorded_discharge_has_a_gap(self, whole):
        columns = whole.time_s, whole.voltage_V, whole.current_A
        assert find_gaps(*columns, whole.voltage_V, 7600.0) == []


class TestSimulated:
    @pytest.mark.parametrize("every_s", [1, 20, 60])
    @pytest.mark.parametrize("pause_s", [300, 600])
    def test_a_pause_that_was_not_logged_is_noticed(self, calibrator, every_s, pause_s):
        load_A = np.concatenate([np.full(1500, 2.0), np.zeros(pause_s), np.full(40_000, 2.0)])
        record = simulated(load_A)
        time_s, end_s = record.time_s, 1500.0 + pause_s
        kept = ((time_s < 1500.0) & (time_s % every_s == 0)) | ((time_s > end_s) & ((time_s - end_s) % every_s == 0))
        estimate = calibrator.estimate(changed(record, kept))
        assert not estimate.settled and estimate.sd_q_mobile > 0.9 * (estimate.q_mobile - 6000.0)

    def test_where_noise_hides_whether_the_load_was_on_its_charge_is_in_doubt(self, calibrator):
        record = lost(simulated(noise_V=0.03, every_s=10), 1200.0, 1280.0)
        estimate = calibrator.estimate(record)
        assert not estimate.settled and "does not tell whether the load was on: " in estimate.reason
        assert 2.0 * 80.0 < estimate.sd_q_mobile < 2.0 * 80.0 + 100.0

    def test_a_logger_that_slows_down_leaves_no_gap(self, calibrator):
        record = simulated(noise_V=0.001)
        estimate = calibrator.estimate(changed(record, (record.time_s < 300.0) | (record.time_s % 60 == 0)))
        assert "No sample lies" not in estimate.reason
        assert abs(estimate.q_mobile - 6000.0) < 3.0 * estimate.sd_q_mobile

    def test_a_long_rest_between_two_samples_is_no_gap(self, calibrator):
        load_A = np.concatenate([np.full(1500, 2.0), np.zeros(4000), np.full(40_000, 2.0)])
        record = simulated(load_A)
        estimate = calibrator.estimate(changed(record, (record.time_s < 1520.0) | (record.time_s > 5480.0)))
        assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.01)

    @pytest.mark.parametrize("later_A", [0.0, 1.0])
    def test_a_load_that_was_switched_meanwhile_is_in_doubt(self, later_A):
        record = simulated(np.where(np.arange(5000) < 1500, 2.0, later_A))
        seen = lost(record, 1400.0, 1700.0)
        gap, *others = find_gaps(seen.time_s, seen.voltage_V, seen.current_A, seen.voltage_V, 6000.0)
        assert not others and gap.verdict == UNSURE and (gap.start_s, gap.end_s) == (1400.0, 1701.0)


def by_voltage(load_A, step_V: float, longest_s: float, noise_V: float) -> Discharge:
    """A record as cyclers write it: a row where the voltage has changed, a time is over, or the load is switched."""
    record = simulated(load_A, noise_V)
    time_s, voltage_V, current_A = record.time_s, record.voltage_V, record.current_A
    kept = [0]
    switches = np.flatnonzero(np.diff(current_A))
    is_switch = np.isin(np.arange(len(time_s)), np.append(switches, switches + 1))
    for n in range(1, len(time_s)):
        late = time_s[n] - time_s[kept[-1]] >= longest_s
        if late or is_switch[n] or abs(voltage_V[n] - voltage_V[kept[-1]]) >= step_V:
            kept.append(n)
    return changed(record, kept)


LOADS_A = {"2 A": 2.0, "1..3 A": np.repeat(np.random.default_rng(0).uniform(1.0, 3.0, 200), 120)}


class TestIrregularLoggers:
    @pytest.mark.parametrize("load_A", LOADS_A.values(), ids=list(LOADS_A))
    @pytest.mark.parametrize(
        ("step_V", "longest_s", "noise_V"),
        [(0.005, 60.0, 0.001), (0.01, 120.0, 0.003), (0.005, 30.0, 0.002)],
    )
    def test_one_that_writes_where_the_voltage_changes_leaves_no_gaps(self, calibrator, load_A, step_V, longest_s, noise_V):
        record = by_voltage(load_A, step_V, longest_s, noise_V)
        step_s = np.diff(record.time_s)
        assert step_s.min() == 1.0 and step_s.max() > 0.7 * longest_s
        estimate = calibrator.estimate(record)
        assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.005)
        assert estimate.sd_q_mobile < 0.018 * 6000.0

    @pytest.mark.parametrize("load_A", LOADS_A.values(), ids=list(LOADS_A))
    def test_its_clock_may_jump_all_the_same(self, calibrator, load_A):
        estimate = calibrator.estimate(jumped(by_voltage(load_A, 0.005, 60.0, 0.001), 1500.0, 300.0))
        assert not estimate.settled and estimate.reason.startswith("No sample lies between 1")
        assert estimate.sd_q_mobile > 0.9 * (estimate.q_mobile - 6000.0)

    @pytest.mark.parametrize("every_s", [1, 10])
    def test_pauses_that_are_never_logged_are_no_habit_of_a_logger(self, calibrator, every_s):
        load_A = np.where(np.arange(40_000) % 600 < 300, 2.0, 0.0)
        record = simulated(load_A, 0.001)
        # the first row after a pause has not seen the load yet
        logged = (record.current_A > 0.0) & ((record.time_s % 600 > 0.0) | (record.time_s == 0.0))
        estimate = calibrator.estimate(changed(record, logged & (record.time_s % every_s == 0)))
        assert not estimate.settled and estimate.sd_q_mobile > 0.9 * (estimate.q_mobile - 6000.0) > 4000.0
