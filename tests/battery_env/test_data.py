"""The data sets that the calibration tasks draw from."""

from typing import get_args

import numpy as np
import pytest

from battery_env.tasks.data import LoadKind, standard_dataset
from battery_env.trajectories import TrajectoryDataset

BOTH = ("q_mobile", "r_o")


def keys(data):
    return set(zip(data.q_mobile, data.r_o, data.load_values[data.load_start], strict=True))


@pytest.mark.parametrize("load", get_args(LoadKind))
def test_a_split_is_seven_to_three_and_shares_nothing(load):
    train, test = standard_dataset(BOTH, load, "train"), standard_dataset(BOTH, load, "test")
    assert (len(train), len(test)) == (700, 300)
    assert train is standard_dataset(BOTH, load, "train", 1.0, mismatch=0.0)
    assert keys(train) | keys(test) == keys(standard_dataset(BOTH, load, "all")) and not keys(train) & keys(test)


def test_the_papers_data_are_the_papers():
    assert standard_dataset("r_o", "paper", "all") is TrajectoryDataset.paper("r_o")
    assert [len(standard_dataset("r_o", "paper", split)) for split in ("train", "test")] == [3858, 1653]
    # a mismatch or another time step is not in the paper: as many cells as elsewhere, in the paper's ranges
    for arguments in ({"mismatch": 0.1}, {"dt_s": 2.0}):
        other = standard_dataset("r_o", "paper", "all", **arguments)
        assert len(other) == 1000 and other.r_o.max() <= 0.2 and other.load_values.max() == 16.0
        assert (other.q_mobile == 7600.0).all() and other.first.min() > 0


def test_ages_span_their_ranges():
    data = standard_dataset(BOTH, "constant", "all")
    assert 4000.0 <= data.q_mobile.min() < 4100.0 and 7500.0 < data.q_mobile.max() <= 7600.0
    assert 0.1 <= data.r_o.min() < 0.105 and 0.295 < data.r_o.max() <= 0.3
    assert set(data.load_values) == set(np.linspace(2.0, 8.0, 13))


@pytest.mark.parametrize("load", ["piecewise", "random_walk"])
def test_changing_loads_change_within_their_bounds(load):
    values = standard_dataset(BOTH, load, "all")[0].load
    held = np.diff(np.flatnonzero(np.diff(values)))
    low, high = {"piecewise": (60, 140), "random_walk": (60, 60)}[load]
    assert held.min() >= low and held.max() <= high and values.min() >= 2.0 and values.max() <= 8.0
