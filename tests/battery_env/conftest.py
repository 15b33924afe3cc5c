"""Data that many tests look at."""

import pytest

from battery_env.loads import RandomPiecewise
from battery_env.trajectories import TrajectoryDataset


@pytest.fixture(scope="session")
def aged_both():
    """Eight discharges of cells of which both parameters have aged, under steps of the load."""
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 8, RandomPiecewise(), seed=5, r_o_range=(0.1, 0.3))
