"""Estimators with the full state, and the scores of any calibrator."""

import numpy as np
import pytest

from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.full_state import ACTION_RANGES
from battery_env.electrochemistry import simulate
from battery_env.estimators.base import Estimate, EstimateTrace, Estimator
from battery_env.estimators.closed_form import ClosedForm
from battery_env.evaluation import evaluate, summarize
from battery_env.loads import RandomPiecewise, constant
from battery_env.trajectories import TrajectoryDataset


@pytest.fixture(scope="module")
def data():
    return TrajectoryDataset.generate("joint", 8, RandomPiecewise(), seed=0, trim=(0.05, 0.95))


class Constant(Estimator):
    """Always says the same; an estimator that only looks back."""

    def __init__(self, q_mobile, r_o):
        self.answer = Estimate(q_mobile, r_o)

    def estimate(self, record):
        return self.answer


class Sequence(Estimator):
    """Gives a fixed sequence of estimates of q_mobile, as shares of the truth."""

    def __init__(self, shares):
        self.shares = np.array(shares)

    def estimate(self, record):
        raise NotImplementedError

    def trace(self, records):
        return [
            EstimateTrace(
                time_s=np.arange(len(self.shares)) + record.time_s[0] + 1.0,
                q_mobile=self.shares * record.q_mobile,
                r_o=np.full(len(self.shares), record.r_o),
            )
            for record in records
        ]


class FixedPolicy:
    """An SB3-like policy that always takes one action."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, *, deterministic=False):
        assert deterministic
        return np.full((len(observation), 1), self.action, dtype=np.float32), None


def test_the_closed_form_is_exact(data):
    scores = evaluate(ClosedForm(), data)
    for name in ("q_mobile", "r_o"):
        assert summarize(scores, name)["mape_worst_percent"] < 1e-9
    assert (scores["eod_error_s"] == 0.0).all()


def test_the_closed_form_needs_a_current():
    rest = simulate(0.0, 7600.0, 0.1, until=10.0)
    assert np.isnan(ClosedForm().estimate(rest).r_o)
    assert ClosedForm().estimate(rest).q_mobile == pytest.approx(7600.0)


def test_scores_of_known_errors(data):
    scores = evaluate(Sequence([1.2, 1.02, 0.98, 1.004, 0.996]), data)
    row = scores.iloc[0]
    assert row["q_mobile_mape_percent"] == pytest.approx(100 * (0.2 + 0.02 + 0.02 + 0.004 + 0.004) / 5)
    assert row["q_mobile_mae"] == pytest.approx(row["q_mobile"] * row["q_mobile_mape_percent"] / 100)
    assert row["q_mobile_bias"] == pytest.approx(0.04 * row["q_mobile"])
    assert row["q_mobile_spread"] == pytest.approx(row["q_mobile"] * np.std([1.2, 1.02, 0.98, 1.004, 0.996]))
    assert row["q_mobile_settling_time_5_percent_s"] == 2.0
    assert row["q_mobile_settling_time_1_percent_s"] == 4.0
    assert row["q_mobile_final"] == pytest.approx(0.996 * row["q_mobile"])
    assert row["updates"] == 5 and len(scores) == len(data)
    assert row["eod_error_s"] < 0.0


def test_an_estimate_that_ends_outside_has_not_settled(data):
    row = evaluate(Sequence([1.0, 1.0, 1.02]), data).iloc[0]
    assert row["q_mobile_settling_time_1_percent_s"] == np.inf
    assert row["q_mobile_settling_time_5_percent_s"] == 1.0


def test_estimators_that_look_back_are_scored_too(data):
    scores = evaluate(Constant(7600.0, 0.117215), data)
    assert (scores["updates"] == 1).all()
    np.testing.assert_allclose(scores["q_mobile_mape_percent"], 100 * np.abs(7600.0 / data.q_mobile - 1))


def test_a_longer_lasting_estimate_predicts_a_later_end(data):
    late, early = (evaluate(Constant(q, r), data)["eod_error_s"] for q, r in ((7600.0, 0.1), (4000.0, 0.2)))
    assert (late >= 0.0).all() and (early <= 0.0).all()


@pytest.mark.parametrize(("env_id", "parameter"), [("BatteryQmax-v0", "q_mobile"), ("BatteryRoPaper-v0", "r_o")])
def test_a_policy_runs_free_over_whole_trajectories(data, env_id, parameter):
    low, high = ACTION_RANGES[parameter]
    traces = PolicyEstimator(FixedPolicy(0.5), env_id).trace(data)
    other = {"q_mobile": "r_o", "r_o": "q_mobile"}[parameter]
    for trace, trajectory in zip(traces, data, strict=True):
        # T samples hold T - 1 transitions; the observation after the last decision needs one more of them
        assert len(trace.time_s) == len(trajectory.time_s) - 2
        np.testing.assert_array_equal(trace.time_s, trajectory.time_s[1:-1])
        np.testing.assert_allclose(getattr(trace, parameter), low + 0.75 * (high - low))
        np.testing.assert_array_equal(getattr(trace, other), getattr(trajectory, other))


def test_a_policy_may_be_given_single_trajectories():
    trajectory = simulate(8.0, 6000.0, 0.12)
    estimate = PolicyEstimator(FixedPolicy(0.0), "BatteryQmax-v0").estimate(trajectory)
    assert estimate.q_mobile == pytest.approx(6000.0) and estimate.r_o == 0.12


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match="Pendulum-v1 is no calibration environment"):
        PolicyEstimator(FixedPolicy(0.0), "Pendulum-v1")


def test_the_summary_is_over_discharges():
    data = TrajectoryDataset.generate("q_mobile", 4, [constant(8.0)], seed=1)
    scores = evaluate(Constant(6000.0, 0.117215), data)
    summary = summarize(scores, "q_mobile")
    assert summary["mape_worst_percent"] == scores["q_mobile_mape_percent"].max() > summary["mape_percent"]
