"""Estimators with the full state, and the scores of any calibrator."""

import numpy as np
import pytest

from battery_env import ClosedForm, RandomSensorErrors, SensorErrors, TrajectoryDataset, cramer_rao_bound, simulate
from battery_env.estimators.estimator import Estimate, EstimateTrace, Estimator
from battery_env.evaluation import evaluate, over_seeds, summarize
from battery_env.loads import RandomPiecewise, constant


@pytest.fixture(scope="module")
def data():
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=0).trimmed(0.05, 0.95)


class Constant(Estimator):
    """Always says the same; an estimator that only looks back."""

    def __init__(self, q_mobile, r_o):
        self.answer = Estimate(q_mobile, r_o)

    def estimate(self, record):
        return self.answer


class Sequence(Estimator):
    """Gives a fixed sequence of estimates of q_mobile, as shares of the truth, one a second or at given shares of the time."""

    def __init__(self, shares, at=None, sd_share=None, settled=None):
        self.shares, self.at, self.sd_share, self.settled = np.array(shares), at, sd_share, settled

    def estimate(self, record):
        raise NotImplementedError

    def trace(self, records):
        return [
            EstimateTrace(
                time_s=(
                    np.arange(len(self.shares)) + record.time_s[0] + 1.0
                    if self.at is None
                    else np.array(self.at) * record.eod_time_s
                ),
                q_mobile=self.shares * record.q_mobile,
                r_o=np.full(len(self.shares), record.r_o),
                sd_q_mobile=None if self.sd_share is None else np.full(len(self.shares), self.sd_share * record.q_mobile),
                settled=None if self.settled is None else np.array(self.settled),
            )
            for record in records
        ]


class Reader(Estimator):
    """Says what it was shown last."""

    def estimate(self, record):
        return Estimate(1000.0 * record.voltage_V[-1], record.current_A[-1])


def test_the_closed_form_is_exact(data):
    scores = evaluate(ClosedForm(), data)
    for name in ("q_mobile", "r_o"):
        assert summarize(scores, name)["mape_worst_percent"] < 1e-9
    assert (scores["eod_error_s"] == 0.0).all()


def test_scores_of_known_errors(data):
    scores = evaluate(Sequence([1.2, 1.02, 0.98, 1.004, 0.996]), data)
    row = scores.iloc[0]
    assert row["q_mobile_mape_percent"] == pytest.approx(100 * (0.2 + 0.02 + 0.02 + 0.004 + 0.004) / 5)
    assert row["q_mobile_bias"] == pytest.approx(0.04 * row["q_mobile"])
    assert row["q_mobile_spread"] == pytest.approx(row["q_mobile"] * np.std([1.2, 1.02, 0.98, 1.004, 0.996]))
    assert row["q_mobile_settling_time_1_percent_s"] == 4.0
    assert row["q_mobile_final"] == pytest.approx(0.996 * row["q_mobile"])
    assert row["q_mobile_final_error_percent"] == pytest.approx(0.4)
    assert row["q_mobile_worst"] == pytest.approx(0.2 * row["q_mobile"])
    assert row["updates"] == 5 and len(scores) == len(data)
    assert row["eod_error_s"] < 0.0
    # an estimate that ends outside has not settled
    row = evaluate(Sequence([1.0, 1.0, 1.02]), data).iloc[0]
    assert row["q_mobile_settling_time_1_percent_s"] == np.inf


def test_estimators_that_look_back_are_scored_too(data):
    late, early = (evaluate(Constant(q, r), data) for q, r in ((7600.0, 0.1), (4000.0, 0.2)))
    assert (late["updates"] == 1).all()
    np.testing.assert_allclose(late["q_mobile_mape_percent"], 100 * np.abs(7600.0 / data.q_mobile - 1))
    # a longer lasting cell predicts a later end, and one that cannot be predicts none
    assert (late["eod_error_s"] >= 0.0).all() and (early["eod_error_s"] <= 0.0).all()
    assert evaluate(Constant(6000.0, -0.1), data)["eod_error_s"].isna().all()


def test_what_cannot_be_evaluated_is_refused():
    for trajectories in ("B0005", [1.0]):
        with pytest.raises(TypeError, match="trajectories must hold Trajectory, got"):
            evaluate(ClosedForm(), trajectories)


def test_the_second_half_is_that_of_the_discharge(data):
    scores = evaluate(Sequence([1.2, 1.1, 1.04, 0.98], at=[0.1, 0.45, 0.55, 0.9]), data)
    np.testing.assert_allclose(scores["q_mobile_second_half_mape_percent"], 3.0)
    early = evaluate(Sequence([1.2, 1.1], at=[0.1, 0.45]), data)
    assert early["q_mobile_second_half_mape_percent"].isna().all()


def test_forecasts_hold_the_estimate_of_the_time():
    data = TrajectoryDataset.generate("q_mobile", 2, [constant(8.0)], seed=1)
    scores = evaluate(Sequence([0.8, 0.9, 1.1], at=[0.3, 0.5, 0.7]), data)
    for row, truth in zip(scores.itertuples(), data, strict=True):
        assert np.isnan(row.eod_error_at_25_percent_s)
        for share, error_s in ((0.9, row.eod_error_at_50_percent_s), (1.1, row.eod_error_at_75_percent_s)):
            assert error_s == simulate(8.0, share * truth.q_mobile, truth.r_o).eod_time_s - truth.eod_time_s != 0.0
        assert row.eod_error_s == row.eod_error_at_75_percent_s
    summary = summarize(scores, "q_mobile")
    assert summary["mape_worst_percent"] == scores["q_mobile_mape_percent"].max() > summary["mape_percent"]
    late = scores["eod_error_at_50_percent_s"].abs() / scores["eod_time_s"]
    assert summary["eod_error_percent_at_50_percent"] == pytest.approx(100.0 * late.mean())


def test_coverage_is_the_share_within_two_stated_deviations(data):
    scores = evaluate(Sequence([1.025, 0.99, 1.015, 1.0], sd_share=0.01), data)
    np.testing.assert_allclose(scores["q_mobile_coverage_percent"], 75.0)
    assert scores["r_o_coverage_percent"].isna().all()
    assert summarize(scores, "q_mobile")["coverage_percent"] == pytest.approx(75.0)


def test_the_calibrator_is_asked_when_it_has_settled(data):
    shares = [1.0, 1.0, 1.0, 1.0]
    assert (evaluate(Sequence(shares, settled=[True, False, True, True]), data)["settled_time_s"] == 3.0).all()
    assert (evaluate(Sequence(shares, settled=[True, True, True, False]), data)["settled_time_s"] == np.inf).all()
    assert evaluate(Sequence(shares), data)["settled_time_s"].isna().all()


def test_the_calibrator_sees_what_the_sensors_show(data):
    errors = SensorErrors(noise_V=0.01, offset_V=0.1, current_gain=1.02, current_offset_A=0.5)
    scores = evaluate(Reader(), data, errors, seed=3)
    truth = [(record.voltage_V[-1], record.current_A[-1]) for record in data]
    voltage_V, current_A = np.array(truth).T
    np.testing.assert_allclose(scores["r_o_final"], 1.02 * current_A + 0.5)
    noise_V = scores["q_mobile_final"] / 1000.0 - voltage_V - 0.1
    assert 0.0 < noise_V.abs().min() and noise_V.abs().max() < 0.05
    np.testing.assert_array_equal(scores["q_mobile"], data.q_mobile)
    # reproducible, and one discharge does not depend on those after it
    few = evaluate(Reader(), data[:3], errors, seed=3)
    np.testing.assert_array_equal(few["q_mobile_final"], scores["q_mobile_final"][:3])
    assert (evaluate(Reader(), data, errors, seed=4)["q_mobile_final"] != scores["q_mobile_final"]).all()


def test_noise_bounds_the_error():
    whole = TrajectoryDataset.generate("q_mobile", 3, [constant(8.0)], seed=1)
    scores = evaluate(Sequence([1.0], sd_share=0.01), whole, SensorErrors(noise_V=0.005))
    joint = evaluate(Sequence([1.0]), whole, SensorErrors(noise_V=0.005, offset_V=0.01))
    for n, record in enumerate(whole):
        bound = cramer_rao_bound(record, 0.005, ["q_mobile"])
        assert scores["q_mobile_bound"][n] == pytest.approx(bound.sd_q_mobile[-1]) and np.isnan(scores["r_o_bound"][n])
        assert joint["r_o_bound"][n] == pytest.approx(cramer_rao_bound(record, 0.005, offset=True).sd_r_o[-1])
    assert evaluate(Sequence([1.0]), whole)["q_mobile_bound"].isna().all()


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ({"noise_V": -0.1}, "noise_V is a standard deviation and must be at least 0 V, got -0.1"),
        ({"offset_V": np.nan}, "offset_V must be finite, got nan"),
        ({"current_gain": 0.0}, "current_gain must be greater than 0 .1: exact., got 0.0"),
    ],
)
def test_sensor_errors_that_cannot_be_meant_are_refused(errors, message):
    with pytest.raises(ValueError, match=message):
        SensorErrors(**errors)


def test_random_sensors_draw_each_fault_within_its_bound():
    rng = np.random.default_rng(0)
    sensors = RandomSensorErrors((0.001, 0.03), offset_V=0.01, current_gain=0.02, current_offset_A=0.05)
    drawn = [sensors.draw(rng) for _ in range(300)]
    noise_V = np.array([errors.noise_V for errors in drawn])
    assert 0.001 <= noise_V.min() < 0.0012 and 0.025 < noise_V.max() <= 0.03 and np.median(noise_V) < 0.008
    for name, middle, bound in (("offset_V", 0.0, 0.01), ("current_gain", 1.0, 0.02), ("current_offset_A", 0.0, 0.05)):
        errors = np.array([getattr(each, name) for each in drawn]) - middle
        assert 0.9 * bound < np.abs(errors).max() <= bound and abs(errors.mean()) < 0.15 * bound


def test_over_seeds_one_failure_of_eight_does_not_move_the_interquartile_mean():
    scores = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])
    middle, low, high = over_seeds(scores)
    assert middle == 4.5 and 1.0 < low < 4.5 < high < 8.0
    failed = np.append(scores[:-1], 1e6)
    assert over_seeds(failed)[0] == 4.5
    # each point of a curve by itself
    for curve, point in zip(over_seeds(np.column_stack([scores, failed])), over_seeds(failed), strict=True):
        assert curve.shape == (2,) and curve[1] == point


def test_over_seeds_a_single_seed_has_no_interval():
    middle, low, high = over_seeds([[3.0, 4.0]])
    assert middle.tolist() == [3.0, 4.0] and np.isnan([low, high]).all()
