"""The step of a fit that allows for constants that are wrong, and what a voltage-only task shows of it."""

import numpy as np
import pytest

from battery_env import PolicyEstimator, SensorErrors, TrajectoryDataset, evaluate
from battery_env.electrochemistry import NEW_CELL, UNCERTAIN_CONSTANTS, simulate
from battery_env.loads import RandomPiecewise
from battery_env.records import Samples
from battery_env.tasks.voltage.fit import FitPrior, NuisanceFit
from battery_env.tasks.voltage.readings import Readings
from battery_env.tasks.voltage.voltage_task import VoltageTask
from tests.policies import Step

UNKNOWNS = ("q_mobile", "r_o", "offset_V", *UNCERTAIN_CONSTANTS)
KNOWS_NOTHING = (1e6, 1e3, 1e3, *[100.0] * 4)


@pytest.fixture(scope="module")
def data(aged_both):
    return aged_both[:4]


def found_of(record, q_mobile, r_o, unknown, share, steps):
    """What a fit of one unknown alone finds in the first readings of a record: of parameters the share they are off."""
    readings, estimate, identity = Readings.of([record], 2.0), np.array([[q_mobile, r_o]]), np.eye(len(UNKNOWNS))
    mean = np.array([q_mobile, r_o, *np.zeros(len(UNKNOWNS) - 2)])
    only = np.where(np.array(UNKNOWNS) == unknown, KNOWS_NOTHING, 0.0)
    fit = NuisanceFit(1, readings.model, NEW_CELL, FitPrior(mean, only, identity, identity, np.ones(len(UNCERTAIN_CONSTANTS))))
    for _ in range(steps):
        measurements = np.ascontiguousarray(readings.exact_measurements(0)[:, None])
        fit.step(np.arange(1), (share * readings.count).astype(int), estimate, measurements)
    result = fit.result(estimate)
    return np.array([*(result.estimate / estimate - 1.0)[0], *result.offset_V, *result.constants[0]])


def cell_that_is_off(trajectory, unknown, size):
    """The same discharge, of a cell in which one thing is not what the model says."""
    cell, q_mobile, r_o, offset_V = NEW_CELL, trajectory.q_mobile, trajectory.r_o, 0.0
    if unknown == "q_mobile":
        q_mobile *= 1.0 + size
    elif unknown == "r_o":
        r_o *= 1.0 + size
    elif unknown == "offset_V":
        offset_V = size
    else:
        cell = cell.replace(**{unknown: getattr(cell, unknown) * np.exp(size)})
    current_A = trajectory.current_A
    whole = simulate(current_A, q_mobile, r_o, load_unit="current", cell=cell, cut_off_V=-np.inf, until=len(current_A) - 1)
    return Samples(trajectory.time_s, whole.voltage_V[: len(current_A)] + offset_V, current_A)


@pytest.mark.filterwarnings("ignore:invalid value encountered in divide")  # distances of constants that cannot be off
@pytest.mark.parametrize("unknown", UNKNOWNS)
def test_steps_repeated_find_what_is_off(data, unknown):
    n, is_constant = UNKNOWNS.index(unknown), unknown in UNCERTAIN_CONSTANTS
    size = {"q_mobile": 0.02, "r_o": 0.2, "offset_V": 0.01}.get(unknown, 0.3)
    for trajectory in data:
        record, (share, steps) = cell_that_is_off(trajectory, unknown, size), (1.0, 3) if is_constant else (0.9, 1)
        found = found_of(record, trajectory.q_mobile, trajectory.r_o, unknown, share, steps)
        # where the load changes between two readings the time constant of the ohmic drop is told less exactly
        assert found[n] == pytest.approx(size, rel={"to": 0.15}.get(unknown, 0.04 if is_constant else 0.1))
        assert not np.delete(found, n).any()


def test_it_is_shown_behind_the_rest_of_the_observation(data):
    shown = []
    for nuisance in (0.0, 0.2):
        task = VoltageTask(4, dataset=data, nuisance=nuisance)
        task.start(np.arange(4), [np.random.default_rng(k) for k in range(4)])
        task.advance(np.full((4, 2), 0.1))
        shown.append(task.observation())
    assert shown[1].shape == (4, 112)
    np.testing.assert_array_equal(shown[0], shown[1][:, :102])


@pytest.mark.attacks
def test_the_step_alone_is_a_good_calibrator_of_cells_that_are_not_the_model():
    data = TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=1, r_o_range=(0.1, 0.3), mismatch=0.2)
    estimator = PolicyEstimator(Step(), "BatteryVoltageJoint-v0", nuisance=0.2, reading_s=2.0)
    scores = evaluate(estimator, data, SensorErrors(noise_V=0.005), seed=1)
    assert scores["q_mobile_second_half_mape_percent"].mean() < 1.0
    assert scores["r_o_second_half_mape_percent"].mean() < 0.6
