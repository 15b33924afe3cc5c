"""Streams of policies: sample by sample, with gaps and rests, stopped and resumed."""

import numpy as np
import pytest

from battery_env import PolicyEstimator, SensorErrors, simulate
from tests.policies import Always


def follow(estimator, record):
    for voltage_V, current_A in zip(record.voltage_V.tolist(), record.current_A.tolist(), strict=True):
        estimate = estimator.update(voltage_V, current_A, 1.0)
    return estimate


def policy_estimator(**more):
    return PolicyEstimator(Always(-0.2, 0.1), "BatteryVoltageJoint-v0", **more)


@pytest.fixture(scope="module")
def whole():
    record = simulate(2.0, 6000.0, 0.15, load_unit="current", thermal=True)
    return SensorErrors(0.005).apply(record, np.random.default_rng(0))


class TestSamples:
    def test_the_first_voltage_may_not_be_missing(self):
        with pytest.raises(ValueError, match=r"voltage_V must be finite, got nan. .*tells whether the cell is full"):
            policy_estimator().update(np.nan, 2.0, 0.0)

    def test_a_week_of_rest_is_one_sample_and_a_gap_under_load_is_refused(self):
        estimator = policy_estimator()
        estimator.update(4.19, 2.0, 0.0)
        estimator.update(4.0, 2.0, 600.0)
        with pytest.raises(ValueError, match=r"within 0.001 .. 600 s, got 3600"):
            estimator.update(3.9, 2.0, 3600.0)
        estimator.update(3.9, 0.0, 60.0)
        estimator.update(np.nan, 0.0, 604_800.0)
        assert (1.0 - estimator.soc) * estimator.at_last_sample()[1].q_mobile[0] == pytest.approx(2.0 * 660.0)
        with pytest.raises(ValueError, match=r"within 0.001 .. 604800 s"):
            estimator.update(4.0, 0.0, 700_000.0)

    def test_charge_that_was_drawn_may_be_put_back_and_no_more(self):
        estimator = policy_estimator()
        estimator.update(4.19, 2.0, 0.0)
        estimator.update(4.0, -1.0, 600.0)
        for _ in range(2):
            estimator.update(4.1, -1.0, 600.0)  # 1200 C were drawn
        estimator.update(4.19, -2.0, 60.0)
        with pytest.raises(ValueError, match="current_A is positive in discharge, but this record draws -"):
            estimator.update(4.19, -2.0, 600.0)

    @pytest.mark.parametrize(
        ("sample", "error", "message"),
        [
            (("x", 2.0, 1.0), TypeError, "voltage_V must be a number, got 'x'"),
            ((None, 2.0, 1.0), TypeError, r"voltage_V must be a number, got None\. A voltage may be missing \(NaN\)"),
            ((4.1, None, 1.0), TypeError, "current_A must be a number, got None"),
            ((4.1, 2.0, None), TypeError, "dt_s must be a number, got None"),
            ((4.1, 2.0, "1"), TypeError, "dt_s must be a number, got '1'"),
            ((4.1, True, 1.0), TypeError, "current_A must be a number, got True"),
            ((4.1, 2j, 1.0), TypeError, "current_A must be a number, got 2j"),
            ((np.inf, 2.0, 1.0), ValueError, "voltage_V must be finite, got inf"),
            ((3.7, 2000.0, 1.0), ValueError, "current_A must lie within -1000 .. 1000 A, got 2000. .* not in mA"),
            ((3700.0, 2.0, 1.0), ValueError, "voltage_V must lie within -0.1 .. 5.5 V, got 3700. .* not in mV"),
            ((14.8, 2.0, 1.0), ValueError, "voltage_V must lie within -0.1 .. 5.5 V, got 14.8. .* not that of a pack"),
            ((3.7, np.nan, 1.0), ValueError, "current_A must be finite, got nan. .* give the mean current"),
            ((3.7, 2.0, 0.0), ValueError, "dt_s, .* must lie within 0.001 .. 600 s, got 0.0"),
            ((3.7, 2.0, np.nan), ValueError, "dt_s, .* must lie within 0.001 .. 600 s, got nan"),
            ((3.7, 2.0, 1000.0), ValueError, "dt_s, .* got 1000.0. Give it in seconds, not in hours or milliseconds"),
        ],
    )
    def test_what_cannot_be_meant_is_refused_and_changes_nothing(self, sample, error, message):
        estimator, untouched, good = policy_estimator(), policy_estimator(), (4.1, 2.0, 1.0)
        if "dt_s" not in message:  # which the first sample does not need
            with pytest.raises(error, match=f"^{message}"):
                estimator.update(*sample)
        for each in (estimator, untouched):
            each.update(4.19, 2.0, 0.0)
        with pytest.raises(error, match=f"^{message}"):
            estimator.update(*sample)
        assert repr(estimator.update(*good)) == repr(untouched.update(*good))

    def test_a_policy_takes_no_temperature(self):
        with pytest.raises(ValueError, match="a policy takes no temperature"):
            policy_estimator().update(4.19, 2.0, 0.0, 20.0)


class TestModel:
    def test_state_of_charge_voltage_and_time_left(self, whole):
        estimator, half = PolicyEstimator(Always(0.0, 0.0), "BatteryVoltageJoint-v0"), len(whole.time_s) // 2
        estimate = follow(estimator, whole.part(0, half))
        model, cell = estimator.at_last_sample()
        assert (cell.q_mobile[0], cell.r_o[0]) == (estimate.q_mobile, estimate.r_o)
        drawn_C = whole.current_A[: half - 1].sum()
        assert estimator.soc == pytest.approx(1.0 - drawn_C / estimate.q_mobile, rel=1e-6)
        alike = simulate(2.0, estimate.q_mobile, estimate.r_o, load_unit="current", cell=model.cell)
        assert estimator.voltage_V == pytest.approx(alike.voltage_V[half - 1], abs=1e-6)
        left = estimator.remaining(2.0)
        assert left.time_s == pytest.approx(len(alike.time_s) - half, abs=1.5) and np.isnan(left.sd_s)
        assert estimator.remaining(1.0).time_s > 1.9 * left.time_s
        assert estimator.remaining(8.0, load_unit="power").time_s < left.time_s
        assert estimator.remaining(0.0).time_s == np.inf

    def test_an_array_that_ends_before_the_discharge_is_refused(self, whole):
        estimator = policy_estimator()
        follow(estimator, whole.part(0, 600))
        left_s = estimator.remaining(2.0).time_s
        assert estimator.remaining(np.full(int(left_s) + 100, 2.0)).time_s == left_s
        with pytest.raises(ValueError, match=r"load ends after 600 s, before .* a Load of battery_env\.loads"):
            estimator.remaining(np.full(600, 2.0))
        # a week of rest is none
        assert estimator.remaining(np.zeros(604_801)).time_s == np.inf


class TestPolicies:
    @pytest.mark.parametrize("options", [{}, {"nuisance": 0.2, "reading_s": 5.0}])
    def test_a_stream_shows_a_policy_what_a_record_does(self, whole, options):
        estimator = policy_estimator(**options)
        trace = estimator.trace([whole])[0]
        from_record = [seen[0] for seen in estimator.policy.seen]
        estimator.policy.seen.clear()
        last = follow(estimator, whole)
        from_stream = [seen[0] for seen in estimator.policy.seen]
        assert len(from_stream) == int(whole.time_s[-1] // 60.0) > 30
        np.testing.assert_array_equal(from_stream, from_record[: len(from_stream)])
        assert last.q_mobile == trace.q_mobile[len(from_stream) - 1] and not last.settled

    def test_one_with_the_full_state_takes_none(self):
        with pytest.raises(ValueError, match="a policy of BatteryQmax-v0 takes no stream"):
            PolicyEstimator(Always(0.0), "BatteryQmax-v0").update(4.19, 2.0, 0.0)


class TestFiles:
    @pytest.mark.parametrize("options", [{}, {"nuisance": 0.2, "reading_s": 5.0}], ids=["policy", "sure policy"])
    def test_stopping_and_going_on_changes_nothing(self, options, whole, tmp_path):
        one, other = policy_estimator(**options), policy_estimator(**options)
        record = whole.part(0, 800)
        follow(one, record.part(0, 500))
        file = one.save(tmp_path / "state")
        assert file.name == "state" and one.save(file) == file  # an older state is replaced
        other.load(file)
        assert repr(follow(one, record.part(500, 800))) == repr(follow(other, record.part(500, 800)))
        assert one.soc == other.soc and list(tmp_path.iterdir()) == [file]

    def test_what_does_not_fit_is_refused(self, tmp_path):
        file = policy_estimator().save(tmp_path / "state")
        with pytest.raises(ValueError, match=r"is of an estimator with .*make one with the same arguments"):
            PolicyEstimator.pretrained(recorded=True).load(file)
