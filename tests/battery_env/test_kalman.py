"""The Kalman filter: accurate, honest about its uncertainty, and hard to lose; and the interface of online calibrators."""

from dataclasses import fields, replace

import numpy as np
import pytest

from battery_env import NEW_CELL, Discharge, ExtendedKalmanFilter, SensorErrors, TrajectoryDataset, simulate
from battery_env.estimates import EstimateTrace
from battery_env.estimators.estimator import OnlineEstimator
from battery_env.estimators.reasons import SETTLED_SHARES
from battery_env.evaluation import evaluate, summarize
from battery_env.loads import RandomPiecewise
from tests.sweeps import sweep

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

    @pytest.mark.parametrize("size", sweep(30.0, 0.02, 0.3))
    def test_of_a_cell_of_any_size_it_says_the_same(self, size):
        def found(size):
            cell = NEW_CELL.replace(
                q_mobile=size * NEW_CELL.q_mobile, r_o=NEW_CELL.r_o / size, kn=size * NEW_CELL.kn, kp=size * NEW_CELL.kp
            )
            record = measured(6000.0 * size, 0.15 / size, 2.0 * size, load_unit="current", cell=cell)
            estimate = ExtendedKalmanFilter(cell=cell).estimate(record)
            return [estimate.q_mobile / size, estimate.sd_q_mobile / size, estimate.r_o * size, estimate.sd_r_o * size]

        assert found(size) == pytest.approx(found(1.0), rel=1e-3)

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


class TestUncertainty:
    def test_a_full_cell_says_nothing_about_charge_and_a_whole_discharge_all(self):
        (trace,) = ExtendedKalmanFilter().trace([measured()])
        assert trace.sd_q_mobile[10] > 0.1 * trace.q_mobile[10]
        assert not trace.settled[:60].any() and trace.settled[-1]
        for name, share in SETTLED_SHARES.items():
            is_known = getattr(trace, f"sd_{name}") < share * getattr(trace, name)
            np.testing.assert_array_equal(getattr(trace, f"settled_{name}"), is_known)
        np.testing.assert_array_equal(trace.settled, trace.settled_q_mobile & trace.settled_r_o)


class TestGuards:
    def test_a_prior_far_below_is_pushed_up_by_the_charge_drawn(self):
        record = measured()
        drawn_C = np.append(0.0, np.cumsum(record.current_A)[:-1])
        (trace,) = ExtendedKalmanFilter(prior_q_mobile_C=(3000.0, 100.0)).trace([record])
        assert np.isfinite(trace.q_mobile).all() and np.isfinite(trace.sd_q_mobile).all()
        assert (trace.q_mobile > drawn_C).all()
        assert trace.q_mobile[-1] == pytest.approx(6000.0, rel=0.03)

    def test_collapse_of_the_voltage_is_survived(self):
        # 16 W at 0.2 ohm: half a minute
        estimate = ExtendedKalmanFilter().estimate(measured(6000.0, 0.2, 16.0))
        assert abs(estimate.q_mobile - 6000.0) < 3.0 * estimate.sd_q_mobile and not estimate.settled
        assert estimate.r_o == pytest.approx(0.2, rel=0.02)


class TestOnline:
    def test_updates_and_traces_agree(self):
        records = [measured(seed=n, q_mobile=q).part(0, 700) for n, q in enumerate((7000.0, 4000.0))]
        # and in a cold room that is heated, which tells the temperature around the cell
        part, warming_C = records[0], np.linspace(5.0, 30.0, 700)
        records.append(Discharge(part.time_s, part.voltage_V, part.current_A, warming_C, starts_at_rest=True))
        filter_ = ExtendedKalmanFilter(thermal=True)
        batch, single = filter_.trace(records), [OnlineEstimator.follow(filter_, record) for record in records]
        for one, other in zip(batch, single, strict=True):
            for name in (field.name for field in fields(EstimateTrace)):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert filter_.estimate(records[1]).q_mobile == batch[1].q_mobile[-1]
        assert abs(batch[2].r_o[-1] / batch[0].r_o[-1] - 1.0) > 1e-4
