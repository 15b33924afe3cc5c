"""Data that many tests look at."""

import pytest

from battery_env.loads import RandomPiecewise
from battery_env.tasks.voltage.aging import simulated_lives
from battery_env.trajectories import TrajectoryDataset


@pytest.fixture(scope="session")
def aged_both():
    """Eight discharges of cells of which both parameters have aged, under steps of the load."""
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=5, r_o_range=(0.1, 0.3))


@pytest.fixture(scope="session")
def lives():
    """Three lives of four discharges each."""
    return simulated_lives(3, 4, seed=0)
