"""The Kalman filter: accurate, honest about its uncertainty, and hard to lose; and the interface of online calibrators."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env.cells import Discharge, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, simulate
from battery_env.estimators.base import OnlineEstimator
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.settling import SETTLED_SHARES
from battery_env.evaluation import evaluate, summarize
from battery_env.loads import RandomPiecewise
from battery_env.records import Stream
from battery_env.sensors import SensorErrors
from battery_env.trajectories import TrajectoryDataset

NOISE_V = 0.005


def measured(q_mobile=6000.0, r_o=0.15, load=8.0, seed=0, noise_V=NOISE_V, **more):
    return SensorErrors(noise_V=noise_V).apply(simulate(load, q_mobile, r_o, **more), np.random.default_rng(seed))


def steps(seed):
    return np.repeat(np.random.default_rng(seed).uniform(2.0, 8.0, 120), 100)


@pytest.fixture(scope="module")
def joint():
    """Ten discharges of cells with both parameters aged, as measured, and their traces."""
    data = TrajectoryDataset.generate(("q_mobile", "r_o"), 10, RandomPiecewise(), seed=3, r_o_range=(0.117, 0.35))
    records = [SensorErrors(noise_V=NOISE_V).apply(record, np.random.default_rng(n)) for n, record in enumerate(data)]
    return records, ExtendedKalmanFilter().trace(records)


class TestAccuracy:
    @pytest.mark.parametrize(("parameter", "r_o_range"), [("q_mobile", (0.1, 0.2)), ("r_o", (0.117, 0.35))])
    def test_one_parameter(self, parameter, r_o_range):
        data = TrajectoryDataset.generate(parameter, 8, RandomPiecewise(), seed=1, r_o_range=r_o_range)
        estimator = ExtendedKalmanFilter([parameter], offset_sd_V=0.0)
        summary = summarize(evaluate(estimator, data, SensorErrors(noise_V=NOISE_V)), parameter)
        assert summary["final_error_percent"] < 1.5 * summary["bound_percent"] < 0.06
        assert summary["second_half_mape_percent"] < 0.06

    def test_both_parameters_and_no_discharge_is_lost(self, joint):
        for record, trace in zip(*joint, strict=True):
            assert trace.q_mobile[-1] == pytest.approx(record.q_mobile, rel=0.005)
            assert trace.r_o[-1] == pytest.approx(record.r_o, rel=0.003)

    def test_two_standard_deviations_cover_the_truth(self, joint):
        for name in ("q_mobile", "r_o"):
            deviations = np.concatenate(
                [(getattr(t, name) - getattr(r, name)) / getattr(t, f"sd_{name}") for r, t in zip(*joint, strict=True)]
            )
            assert 0.9 < np.mean(np.abs(deviations) <= 2.0) < 0.999
            assert np.sqrt(np.mean(deviations**2)) > 0.4  # not by stating too much

    def test_noise_that_was_not_stated_is_noticed(self):
        data = TrajectoryDataset.generate(("q_mobile", "r_o"), 6, RandomPiecewise(), seed=2, r_o_range=(0.117, 0.35))
        scores = evaluate(ExtendedKalmanFilter(voltage_noise_V=0.005), data, SensorErrors(noise_V=0.02))
        assert scores["q_mobile_final_error_percent"].max() < 2.0
        assert scores["q_mobile_coverage_percent"].mean() > 70.0

    def test_an_offset_does_no_harm_unless_it_is_ruled_out(self):
        record = SensorErrors(noise_V=NOISE_V, offset_V=0.01).apply(simulate(steps(0), 5000.0, 0.2), np.random.default_rng(0))
        default, exact = ExtendedKalmanFilter().estimate(record), ExtendedKalmanFilter(offset_sd_V=0.0).estimate(record)
        assert abs(default.r_o - 0.2) < 3.0 * default.sd_r_o < 0.001
        assert abs(default.q_mobile - 5000.0) < 3.0 * default.sd_q_mobile < 20.0
        assert abs(exact.r_o - 0.2) > 0.001
        far = ExtendedKalmanFilter().estimate(replace(record, voltage_V=record.voltage_V + 0.025))
        assert default.settled and not far.settled and "mismatch_V" in far.reason

    @pytest.mark.parametrize(("thermal", "dt_s"), [(True, 0.5), (False, 2.0)])
    def test_thermal_model_and_other_time_steps(self, thermal, dt_s):
        record = measured(load=2.0, load_unit="current", thermal=thermal, dt=dt_s)
        estimate = ExtendedKalmanFilter(thermal=thermal, dt_s=dt_s).estimate(record)
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=5e-3)

    def test_the_model_follows_a_current_whose_samples_are_far_apart(self):
        whole = measured(load=2.0, load_unit="current", noise_V=0.001)
        seldom = Discharge(whole.time_s[::13], whole.voltage_V[::13], whole.current_A[::13])
        estimate = ExtendedKalmanFilter(voltage_noise_V=0.001).estimate(seldom)
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=2e-3)


class TestUncertainty:
    def test_a_full_cell_says_nothing_about_charge_and_a_whole_discharge_all(self):
        (trace,) = ExtendedKalmanFilter().trace([measured()])
        assert trace.sd_q_mobile[10] > 0.1 * trace.q_mobile[10]
        assert not trace.settled[:60].any() and trace.settled[-1]
        settled = trace.sd_q_mobile < SETTLED_SHARES["q_mobile"] * trace.q_mobile
        settled &= trace.sd_r_o < SETTLED_SHARES["r_o"] * trace.r_o
        np.testing.assert_array_equal(trace.settled, settled)

    def test_what_is_held_has_no_uncertainty(self):
        cell = NEW_CELL.replace(r_o=0.15)
        estimate = ExtendedKalmanFilter(["q_mobile"], cell=cell).estimate(measured())
        assert estimate.r_o == 0.15 and np.isnan(estimate.sd_r_o)
        assert estimate.q_mobile == pytest.approx(6000.0, rel=1e-3)

    def test_a_prior_decides_before_the_data_do(self):
        record = measured()
        early, late = (
            ExtendedKalmanFilter(prior_q_mobile_C=(6100.0, 60.0)).estimate(part) for part in (record.part(0, 60), record)
        )
        assert early.q_mobile == pytest.approx(6100.0, abs=60.0) and not early.settled
        assert early.reason == "q_mobile rests on its prior: the record alone does not determine it yet."
        assert late.settled and late.reason == ""
        assert 50.0 < early.sd_q_mobile <= 60.0
        assert abs(late.q_mobile - 6000.0) < 3.0 * late.sd_q_mobile < 15.0

    def test_mismatch_of_the_model_widens_the_deviations(self):
        half = measured().part(0, 1200)
        exact, doubtful = (ExtendedKalmanFilter(mismatch_V=mismatch_V).estimate(half) for mismatch_V in (0.0, 0.05))
        assert doubtful.sd_q_mobile > 3.0 * exact.sd_q_mobile


class TestGuards:
    def test_wild_samples_move_nothing_far(self):
        record = measured()
        voltage_V = record.voltage_V.copy()
        voltage_V[200::250] = 0.0
        estimate = ExtendedKalmanFilter().estimate(replace(record, voltage_V=voltage_V))
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=5e-3)

    def test_a_prior_far_below_is_pushed_up_by_the_charge_drawn(self):
        record = measured()
        drawn_C = np.append(0.0, np.cumsum(record.current_A)[:-1])
        (trace,) = ExtendedKalmanFilter(prior_q_mobile_C=(3000.0, 100.0)).trace([record])
        assert np.isfinite(trace.q_mobile).all() and np.isfinite(trace.sd_q_mobile).all()
        assert (trace.q_mobile > drawn_C).all()
        assert trace.q_mobile[-1] == pytest.approx(6000.0, rel=0.03)

    def test_estimates_stay_within_their_bounds_and_do_not_settle_there(self):
        filter_ = ExtendedKalmanFilter(
            prior_q_mobile_C=(7000.0, 300.0), q_mobile_bounds_C=(6500.0, 8000.0), r_o_bounds_ohm=(0.05, 0.14)
        )
        (trace,) = filter_.trace([measured()])
        assert trace.q_mobile.min() >= 6500.0 and trace.r_o.max() <= 0.14
        assert not trace.settled[-1]

    def test_a_held_charge_that_is_drawn_freezes_the_estimate(self):
        (trace,) = ExtendedKalmanFilter(["r_o"], cell=NEW_CELL.replace(q_mobile=3000.0)).trace([measured()])
        assert not trace.settled[-1]
        assert (trace.r_o[-500:] == trace.r_o[-1]).all() and trace.reason[-1].startswith("The model cell is empty")

    def test_collapse_of_the_voltage_is_survived(self):
        # 16 W at 0.2 ohm: half a minute
        estimate = ExtendedKalmanFilter().estimate(measured(6000.0, 0.2, 16.0))
        assert abs(estimate.q_mobile - 6000.0) < 3.0 * estimate.sd_q_mobile and not estimate.settled
        assert estimate.r_o == pytest.approx(0.2, rel=0.02)


class TestOnline:
    def test_updates_and_traces_agree(self):
        records = [measured(seed=n, q_mobile=q).part(0, 700) for n, q in enumerate((7000.0, 4000.0))]
        filter_ = ExtendedKalmanFilter()
        batch, single = filter_.trace(records), OnlineEstimator.trace(filter_, records)
        for one, other in zip(batch, single, strict=True):
            for name in ("time_s", "q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled", "reason"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert filter_.estimate(records[1]).q_mobile == batch[1].q_mobile[-1]

    def test_reset_starts_anew(self):
        record, filter_ = measured().part(0, 50), ExtendedKalmanFilter()
        samples = list(Stream.of(record, 1.0).samples())
        first = [filter_.update(*sample) for sample in samples]
        assert filter_.update(*samples[1]) != first[1]
        filter_.reset()
        assert [filter_.update(*sample) for sample in samples] == first

    def test_between_recorded_samples_the_current_is_its_mean(self):
        time_s = np.array([0.0, 10.0, 30.0, 60.0, 70.0])
        record = Discharge(time_s, np.full(5, 3.7), np.array([2.0, 2.1, 2.1, 0.0, 0.0]))
        samples = Stream.of(record, 1.0)
        np.testing.assert_allclose(samples.current_A, [2.05, 2.1, 1.05, 0.0, 0.0])
        np.testing.assert_array_equal(samples.dt_s, [0.0, 10.0, 20.0, 30.0, 10.0])

    def test_a_current_of_the_wrong_sign_is_refused(self):
        filter_ = ExtendedKalmanFilter()
        with pytest.raises(ValueError, match="this record draws -76 C in total"):
            for _ in range(60):
                filter_.update(4.0, -2.0, 1.0)
        record = measured()
        with pytest.raises(ValueError, match="current_A is positive in discharge"):
            filter_.trace([replace(record, current_A=-record.current_A)])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"parameters": ["q"]}, "one or both of"),
            *(
                ({"initial_soc": soc}, r"initial_soc is a state of charge within .*soc_from_rest")
                for soc in (0.0, np.nan, "rest")
            ),
            ({"voltage_noise_V": 0.0}, "voltage_noise_V must be greater than 0 V, got 0.0"),
            ({"mismatch_V": 0.05, "voltage_noise_V": 0.005}, "voltage_noise_V must be at least mismatch_V, 0.05 V, got 0.005"),
            ({"current_gain_sd": -0.1}, "current_gain_sd is a share within 0 .. 1"),
            ({"mismatch_V": -1.0}, "mismatch_V must be finite and at least 0, got -1.0"),
            ({"dt_s": 20.0}, "dt must be greater than 0"),
            ({"r_o_bounds_ohm": (0.2, 0.1)}, "bounds of r_o must be"),
            ({"prior_q_mobile_C": (50.0, 10.0)}, "prior of q_mobile is .mean within 100 .. 100000"),
            ({"prior_r_o_ohm": (0.1, 0.0)}, "prior of r_o"),
            ({"parameters": ["r_o"], "prior_q_mobile_C": (7000.0, 10.0)}, "a prior of q_mobile needs 'q_mobile' among"),
        ],
    )
    def test_arguments_out_of_range_are_refused(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            ExtendedKalmanFilter(**arguments)


class TestRealCells:
    def test_it_finds_the_charge_of_a_real_cell_over_its_life(self):
        discharges = load_nasa_discharges("B0005")[::12]
        records = [discharge.loaded_part(2.7) for discharge in discharges]
        traces = ExtendedKalmanFilter(thermal=True, mismatch_V=0.05).trace(records)
        final = np.array([trace.q_mobile[-1] for trace in traces])
        capacity_Ah = np.array([discharge.meta["capacity_Ah"] for discharge in discharges])
        assert np.corrcoef(final, capacity_Ah)[0, 1] > 0.999
        np.testing.assert_allclose(final / (3600.0 * capacity_Ah), 1.055, atol=0.03)
        assert all(trace.settled[-1] for trace in traces)
        # honest half-way, where the voltage determines little
        for trace, q_mobile in zip(traces, final, strict=True):
            middle = len(trace.time_s) // 2
            assert abs(trace.q_mobile[middle] - q_mobile) < 2.0 * trace.sd_q_mobile[middle]
            assert not trace.settled[middle]
