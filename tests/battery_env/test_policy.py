"""Voltage-only policies as estimators."""

from dataclasses import asdict

import numpy as np
import pytest

from battery_env import NEW_CELL, CellParameters, PolicyEstimator, TrajectoryDataset, evaluate
from battery_env.loads import RandomPiecewise
from battery_env.records import Samples
from battery_env.sensors import SensorErrors
from battery_env.tasks.voltage.voltage_task import LARGEST_STEPS
from tests.policies import Always


@pytest.fixture(scope="module")
def data(aged_both):
    return aged_both[:5]


def test_one_estimate_at_each_decision_of_each_discharge(data):
    policy = Always(-0.1, 0.1)
    traces = PolicyEstimator(policy, "BatteryVoltageJoint-v0", decision_s=60.0).trace(data)
    for trace, trajectory in zip(traces, data, strict=True):
        readings = int(trajectory.time_s[-1] // 10)
        expected_s = np.append(np.arange(60.0, 10.0 * readings, 60.0), 10.0 * readings)
        np.testing.assert_array_equal(trace.time_s, expected_s)
        moved_C = 0.01 * LARGEST_STEPS["q_mobile"] * np.arange(1, len(expected_s) + 1)
        np.testing.assert_allclose(trace.q_mobile, np.maximum(NEW_CELL.q_mobile - moved_C, 3500.0))
    assert policy.seen[0].shape == (5, 102)


def test_it_sees_what_the_sensors_show_and_nothing_more(data):
    exact, noisy = Always(0.0, 0.0), Always(0.0, 0.0)
    evaluate(PolicyEstimator(exact, "BatteryVoltageJoint-v0"), data)
    scores = evaluate(PolicyEstimator(noisy, "BatteryVoltageJoint-v0"), data, SensorErrors(offset_V=0.05))
    shift = np.sinh(noisy.seen[0][:, 98].astype(np.float64)) - np.sinh(exact.seen[0][:, 98].astype(np.float64))
    np.testing.assert_allclose(shift, 5.0, rtol=1e-4)  # the mean residual in units of 10 mV
    assert scores["q_mobile_final"].tolist() == [NEW_CELL.q_mobile] * 5


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match=r"decision_s must be a positive, finite number, got 0\.0"):
        PolicyEstimator(Always(0.0), "BatteryVoltageJoint-v0", decision_s=0.0)
    with pytest.raises(ValueError, match="CartPole-v1 is no calibration environment"):
        PolicyEstimator(Always(0.0), "CartPole-v1")


class Last:
    """A policy whose action depends on the residuals that it sees."""

    def predict(self, observation, deterministic=False):
        return np.clip(0.1 * observation[:, [98, 31]].astype(np.float64), -1.0, 1.0), None


@pytest.fixture(scope="module")
def own():
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 2, RandomPiecewise(), seed=3, cell=TestOwnCell.CELL)


class TestOwnCell:
    CELL = NEW_CELL.replace(to=1.5 * NEW_CELL.to, U0p=NEW_CELL.U0p + 0.03, q_mobile=7000.0, r_o=0.14)

    def estimator(self, **cell):
        return PolicyEstimator(Last(), "BatteryVoltageJoint-v0", **cell)

    def test_a_stream_is_followed_with_its_constants(self, own, tmp_path):
        (trajectory, _), stream = own, self.estimator(cell=self.CELL)
        cell = stream.at_last_sample()[1]
        assert (cell.q_mobile[0], cell.r_o[0]) == (self.CELL.q_mobile, self.CELL.r_o)
        for sample in zip(trajectory.voltage_V[:181].tolist(), trajectory.current_A[:181].tolist(), strict=True):
            estimate = stream.update(*sample, 1.0)
        part = Samples(*(column[:181] for column in (trajectory.time_s, trajectory.voltage_V, trajectory.current_A)))
        assert estimate.q_mobile == pytest.approx(self.estimator(cell=self.CELL).estimate(part).q_mobile, rel=1e-9)
        assert estimate.q_mobile != pytest.approx(self.estimator().estimate(part).q_mobile, rel=1e-3)
        saved, again = stream.save(tmp_path / "stream.npz"), self.estimator(cell=CellParameters.of_mapping(asdict(self.CELL)))
        again.load(saved)
        (model, cell), (_, before) = again.at_last_sample(), stream.at_last_sample()
        assert model.cell == self.CELL and cell.state.tolist() == before.state.tolist()
        with pytest.raises(ValueError, match="cell"):
            self.estimator().load(saved)

    def test_it_knows_no_constants_but_its_own_however_the_records_come(self, own):
        for cell in ({}, {"cell": self.CELL}):
            of_set, of_list = (self.estimator(**cell).trace(records) for records in (own, list(own)))
            for one, other in zip(of_set, of_list, strict=True):
                np.testing.assert_array_equal(one.q_mobile, other.q_mobile)
