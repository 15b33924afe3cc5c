"""The greedy optimum of the one-step cost is the true parameter, unless the model has drifted."""

from dataclasses import replace

import numpy as np
import pytest

from battery_env import TrajectoryDataset
from battery_env.electrochemistry import QNS, VO, simulate, step
from battery_env.loads import RandomPiecewise
from benchmarks.greedy import GreedyOneStep


@pytest.fixture(scope="module")
def discharges():
    return list(TrajectoryDataset.generate(("q_mobile", "r_o"), 3, RandomPiecewise(), seed=0).trimmed(0.4, 0.9))


def errors_percent(estimator, record):
    trace = estimator.trace([record])[0]
    np.testing.assert_array_equal(trace.time_s, record.time_s[1:])
    return 100.0 * np.abs(getattr(trace, estimator.parameter) / getattr(record, estimator.parameter) - 1.0)


@pytest.mark.parametrize("resync", [True, False])
def test_r_o_is_exact_at_every_step(discharges, resync):
    for record in discharges:
        assert errors_percent(GreedyOneStep("r_o", resync=resync), record).max() < 1e-9


@pytest.mark.parametrize("resync", [True, False])
def test_q_mobile_is_exact_but_for_a_few_steps(discharges, resync):
    for record in discharges:
        errors = errors_percent(GreedyOneStep("q_mobile", resync=resync), record)
        # those where two minima of the cost nearly meet
        assert np.mean(errors > 1e-4) < 0.01 and errors.max() < 0.5
        assert errors[-1] < 1e-6


def test_the_deepest_of_three_minima_is_found():
    record = simulate(12.0, 6000.0, 0.117215)
    values = np.linspace(5300.0, 6200.0, 901)
    costs = np.linalg.norm(step(record.state[900], 12.0, values, 0.117215)[:, VO:] - record.state[901, VO:], axis=1)
    minima = values[1:-1][(costs[1:-1] < costs[:-2]) & (costs[1:-1] < costs[2:])]
    np.testing.assert_allclose(minima, [5480.0, 5730.0, 6000.0], atol=25.0)
    assert GreedyOneStep("q_mobile").estimate(record.part(900, 902)).q_mobile == pytest.approx(6000.0, rel=1e-9)


def test_a_model_that_has_drifted_misleads_it_unless_it_is_resynchronized():
    record = simulate(12.0, 6000.0, 0.12).part(900, 1000)
    state = record.state.copy()
    state[0, QNS] += 0.05
    drifted = replace(record, state=state)
    free, resynchronized = (errors_percent(GreedyOneStep("q_mobile", resync=resync), drifted) for resync in (False, True))
    # the step from the wrong state misleads both
    assert free[0] > 5.0 and resynchronized[0] > 5.0
    assert free[1:10].min() > 0.1 and resynchronized[1:].max() < 1e-6
    # r_o forgets
    state[0, VO] += 0.01
    assert errors_percent(GreedyOneStep("r_o", resync=False), replace(record, state=state))[50:].max() < 0.2


def test_other_steps_temperatures_and_currents():
    for arguments in ({"dt": 2.0}, {"thermal": True}, {"load_unit": "current"}):
        record = simulate(3.0, 6000.0, 0.15, **arguments).part(800, 1000)
        for parameter in ("q_mobile", "r_o"):
            estimator = GreedyOneStep(parameter, thermal=arguments.get("thermal", False))
            estimate = estimator.estimate(record)
            assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=1e-4)


def test_the_search_stays_in_its_range():
    record = simulate(8.0, 6000.0, 0.15, until=60.0)
    trace = GreedyOneStep("r_o", search_range=(0.2, 0.3)).trace([record])[0]
    np.testing.assert_allclose(trace.r_o, 0.2, rtol=1e-9)
    np.testing.assert_array_equal(trace.q_mobile, 6000.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("kn",), "parameter must be one of"),
        (("r_o", (0.3, 0.2)), "lower < upper"),
        (("q_mobile", (1.0, 2.1)), "Ampere-hours"),
    ],
)
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        GreedyOneStep(*arguments)
