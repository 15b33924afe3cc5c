"""Data sets of simulated discharges."""

import json
import zipfile

import numpy as np
import pytest

from battery_env.electrochemistry import initial_state, simulate
from battery_env.loads import RandomPiecewise, constant
from battery_env.trajectories import PAPER_LOADS_W, TrajectoryDataset


@pytest.fixture(scope="module")
def small():
    return TrajectoryDataset.generate("joint", 12, [constant(p) for p in (8.0, 10.0, 12.0)], seed=3, trim=(0.05, 0.95))


@pytest.mark.parametrize("parameter", ["q_mobile", "r_o"])
def test_the_papers_data(parameter):
    data = TrajectoryDataset.paper(parameter)
    assert len(data) == 11 * 501
    values = getattr(data, parameter)
    low, high = {"q_mobile": (4000.0, 7000.0), "r_o": (0.1, 0.2)}[parameter]
    assert len(np.unique(values)) == 501 and values.min() == low and values.max() == high
    first = [data.load_values[start] for start in np.unique(data.load_start)]
    np.testing.assert_allclose(first, PAPER_LOADS_W)
    assert data is TrajectoryDataset.paper(parameter)
    shares = np.stack([data.first, data.stop]) / data.samples
    assert (shares[0] >= 0.05).all() and (shares[1] <= 0.95).all()


def test_a_collapsing_discharge_is_a_short_trajectory():
    data = TrajectoryDataset.paper("r_o")
    shortest = data[int(np.argmin(data.samples))]
    assert shortest.r_o == 0.2 and shortest.load[0] == 16.0 and shortest.eod_time_s == 53
    assert np.isfinite(shortest.state).all()


def test_a_trajectory_is_the_simulation_of_its_parameters(small):
    for n in (0, 5, -1):
        trajectory = small[n]
        whole = simulate(trajectory.load[0], trajectory.q_mobile, trajectory.r_o)
        first = int(trajectory.time_s[0])
        np.testing.assert_array_equal(trajectory.state, whole.state[first : first + len(trajectory.time_s)])
        assert trajectory.eod_time_s == whole.eod_time_s


def test_states_between_checkpoints_are_the_same_to_the_bit(small):
    for sample in (0, 1, 63, 64, 65, 200):
        states = small.states_at(np.arange(len(small)), np.full(len(small), sample))
        for n in range(len(small)):
            whole = simulate(small[n].load[0], small.q_mobile[n], small.r_o[n])
            np.testing.assert_array_equal(states[n], whole.state[sample])


def test_same_seed_same_data():
    make = [TrajectoryDataset.generate("r_o", 5, RandomPiecewise(), seed=seed) for seed in (7, 7, 8)]
    np.testing.assert_array_equal(make[0].load_values, make[1].load_values)
    np.testing.assert_array_equal(make[0].checkpoint, make[1].checkpoint)
    assert not np.array_equal(make[0].r_o, make[2].r_o)
    assert (make[0].q_mobile == 7600.0).all()


@pytest.mark.parametrize("by", ["trajectory", "load", "parameter"])
def test_a_split_is_a_partition(small, by):
    train, test = small.split(test=0.3, by=by, seed=1)
    assert len(train) + len(test) == len(small)
    both = np.concatenate([train.q_mobile, test.q_mobile])
    np.testing.assert_array_equal(np.sort(both), np.sort(small.q_mobile))
    loads = [{float(trajectory.load[0]) for trajectory in part} for part in (train, test)]
    if by == "load":
        assert not loads[0] & loads[1]
    if by == "parameter":
        assert test.q_mobile.max() <= train.q_mobile.min()


def test_a_split_follows_its_seed():
    data = TrajectoryDataset.paper("q_mobile")
    train, test = data.split(test=0.3, seed=0)
    assert (len(train), len(test)) == (3858, 1653)
    np.testing.assert_array_equal(test.q_mobile, data.split(test=0.3, seed=0)[1].q_mobile)
    assert not np.array_equal(test.q_mobile, data.split(test=0.3, seed=1)[1].q_mobile)


def test_subsets_hold_the_same_trajectories(small):
    part = small.subset([7, 2])
    for n, m in enumerate((7, 2)):
        np.testing.assert_array_equal(part[n].state, small[m].state)
    np.testing.assert_array_equal(small[2:4][1].state, small[3].state)


def test_single_trajectories_become_a_data_set(small):
    again = TrajectoryDataset.from_trajectories([small[3], small[4]])
    np.testing.assert_array_equal(again[1].state, small[4].state)
    with pytest.raises(ValueError, match="one load unit"):
        TrajectoryDataset.from_trajectories([])


def test_what_is_saved_is_loaded(small, tmp_path):
    path = small.save(tmp_path / "folder" / "data")
    assert path.name == "data.npz" and list(path.parent.iterdir()) == [path]
    again = TrajectoryDataset.load(path)
    for n in range(len(small)):
        np.testing.assert_array_equal(again[n].state, small[n].state)
    assert again.parameters == small.parameters and again.description == small.description
    with pytest.raises(FileExistsError, match="exists already"):
        small.save(path)


def test_damaged_and_foreign_files_are_refused(small, tmp_path):
    path = small.save(tmp_path / "data.npz")
    with np.load(path) as file:
        arrays = dict(file)
    for change, message in (
        ({"q_mobile": arrays["q_mobile"] + 1.0}, "checksum"),
        ({"metadata": np.array(json.dumps({"format": 99}))}, "format 99"),
    ):
        changed = tmp_path / "changed.npz"
        np.savez(changed, **{**arrays, **change})
        with pytest.raises(ValueError, match=message):
            TrajectoryDataset.load(changed)
    (tmp_path / "cut.npz").write_bytes(path.read_bytes()[:500])
    with zipfile.ZipFile(tmp_path / "foreign.npz", "w") as file:
        file.writestr("a.npy", b"")
    for name in ("cut.npz", "foreign.npz"):
        with pytest.raises(ValueError, match="damaged"):
            TrajectoryDataset.load(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        TrajectoryDataset.load(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameter": "capacity"}, "parameter must be"),
        ({"n": 0}, "n must be at least 1"),
        ({"loads": []}, "loads must not be empty"),
        ({"loads": [constant(8.0), constant(2.0, "current")]}, "all in one unit"),
        ({"loads": [constant(60.0)]}, "lower its load"),
        ({"loads": [constant(0.0)]}, "raise its load"),
        ({"trim": (0.9, 0.1)}, "trim"),
        ({"q_mobile_range": (1.0, 2.0)}, "q_mobile"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TrajectoryDataset.generate(**{"parameter": "q_mobile", "n": 2, "loads": [constant(8.0)], "seed": 0} | arguments)


def test_an_initial_state_is_the_first_checkpoint(small):
    np.testing.assert_array_equal(small.checkpoint[small.checkpoint_start], initial_state(small.q_mobile))
