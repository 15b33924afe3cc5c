"""The step of a fit that allows for constants that are wrong, and what a voltage-only task shows of it."""

import numpy as np
import pytest

from battery_env import PolicyEstimator, SensorErrors, TrajectoryDataset, evaluate
from battery_env.electrochemistry import NEW_CELL, UNCERTAIN_CONSTANTS, simulate
from battery_env.electrochemistry.cell import POLYNOMIAL_SIZE
from battery_env.loads import RandomPiecewise
from battery_env.records import Samples
from battery_env.tasks.vector_env import CalibrationVectorEnv
from battery_env.tasks.voltage.fit import StepPrior, nuisance_step, solution_size
from battery_env.tasks.voltage.readings import Readings
from battery_env.tasks.voltage.voltage_task import VoltageTask
from tests.policies import Step

UNKNOWNS = ("q_mobile", "r_o", "offset_V", *UNCERTAIN_CONSTANTS)
KNOWS_NOTHING = (1e6, 1e3, 1e3, *[100.0] * 4)


@pytest.fixture(scope="module")
def data(aged_both):
    return aged_both[:4]


def step(record, q_mobile, r_o, logarithms=(0.0, 0.0, 0.0, 0.0), prior_sd=KNOWS_NOTHING, count=None):
    """One step for one record, read every two seconds."""
    readings, solution = Readings.of([record], 2.0), np.full((1, solution_size(len(UNKNOWNS))), np.nan)
    identity = np.eye(len(UNKNOWNS))
    nuisance_step(
        np.arange(1),
        readings.count if count is None else np.array([count]),
        np.array([[q_mobile, r_o]]),
        np.ascontiguousarray(readings.exact_measurements(0)[:, None]),
        readings.model,
        np.array([logarithms]),
        np.zeros((0, 1 + POLYNOMIAL_SIZE)),
        StepPrior(
            np.array([[q_mobile, r_o, 0.0, 0.0, 0.0, 0.0, 0.0]]),
            np.array([prior_sd], dtype=np.float64),
            precision=identity,
            flat_precision=identity,
            mismatch_V=0.0,
            errors_per_C=0.0,
        ),
        solution,
    )
    return solution[0]


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


@pytest.mark.parametrize("unknown", UNKNOWNS)
def test_steps_repeated_find_what_is_off(data, unknown):
    n, is_constant = UNKNOWNS.index(unknown), unknown in UNCERTAIN_CONSTANTS
    size = {"q_mobile": 0.02, "r_o": 0.2, "offset_V": 0.01}.get(unknown, 0.3)
    only = [sd * (name == unknown) for name, sd in zip(UNKNOWNS, KNOWS_NOTHING, strict=True)]
    for trajectory in data:
        record, logarithms = cell_that_is_off(trajectory, unknown, size), np.zeros(4)
        count = None if is_constant else int(0.9 * (len(trajectory.time_s) - 1) / 2)
        for _ in range(3 if is_constant else 1):
            found = step(record, trajectory.q_mobile, trajectory.r_o, logarithms, only, count)
            logarithms += found[3:7]
        scale = {"q_mobile": trajectory.q_mobile, "r_o": trajectory.r_o}.get(unknown, 1.0)
        total = logarithms[n - 3] if is_constant else found[n] / scale
        # where the load changes between two readings the time constant of the ohmic drop is told less exactly
        assert total == pytest.approx(size, rel={"to": 0.15}.get(unknown, 0.04 if is_constant else 0.1))
        assert not np.delete(found[: len(UNKNOWNS)], n).any()


class TestTask:
    def test_it_is_shown_behind_the_rest_of_the_observation(self, data):
        shown = []
        for nuisance in (0.0, 0.2):
            task = VoltageTask(4, dataset=data, nuisance=nuisance)
            task.start(np.arange(4), [np.random.default_rng(k) for k in range(4)])
            task.advance(np.full((4, 2), 0.1))
            shown.append(task.observation())
        assert shown[1].shape == (4, 112)
        np.testing.assert_array_equal(shown[0], shown[1][:, :102])

    def test_a_cell_is_the_same_alone_and_among_others(self, data):
        many = CalibrationVectorEnv(VoltageTask, 3, nuisance=0.2, dataset=data)
        one = CalibrationVectorEnv(VoltageTask, 1, nuisance=0.2, dataset=data)
        together, alone = many.reset(seed=3)[0], one.reset(seed=5)[0]
        for _ in range(20):  # beyond the end of an episode
            np.testing.assert_array_equal(together[2], alone[0])
            together, alone = many.step(np.full((3, 2), 0.05))[0], one.step(np.full((1, 2), 0.05))[0]


@pytest.mark.attacks
def test_the_step_alone_is_a_good_calibrator_of_cells_that_are_not_the_model():
    data = TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=1, r_o_range=(0.1, 0.3), mismatch=0.2)
    estimator = PolicyEstimator(Step(), "BatteryVoltageJoint-v0", nuisance=0.2, reading_s=2.0)
    scores = evaluate(estimator, data, SensorErrors(noise_V=0.005), seed=1)
    assert scores["q_mobile_second_half_mape_percent"].mean() < 1.0
    assert scores["r_o_second_half_mape_percent"].mean() < 0.6
