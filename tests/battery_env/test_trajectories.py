"""Data sets of simulated discharges."""

import dataclasses
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from battery_env.electrochemistry import NEW_CELL, UNCERTAIN_CONSTANTS, simulate
from battery_env.loads import RandomPiecewise, constant
from battery_env.trajectories import PAPER_LOADS_W, TrajectoryDataset

BOTH = ("q_mobile", "r_o")


@pytest.fixture(scope="module")
def small():
    loads = [constant(power) for power in (8.0, 10.0, 12.0)]
    return TrajectoryDataset.generate(BOTH, 12, loads, seed=3).trimmed(0.05, 0.95)


@pytest.fixture(scope="module")
def saved(small, tmp_path_factory):
    return small.save(tmp_path_factory.mktemp("saved") / "data.npz")


@pytest.fixture(scope="module")
def wrong():
    return TrajectoryDataset.generate(BOTH, 12, [constant(8.0), constant(12.0)], seed=3, mismatch=0.2)


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


def whole(data, n):
    """A discharge simulated alone."""
    changes = dict(zip(UNCERTAIN_CONSTANTS, data.factors[n], strict=True))
    cell = NEW_CELL.replace(**{name: factor * getattr(NEW_CELL, name) for name, factor in changes.items()})
    return simulate(data[n].load[0], data.q_mobile[n], data.r_o[n], cell=cell)


def test_a_trajectory_is_the_simulation_of_its_parameters_and_constants(small, wrong):
    # constants are multiplied in another order
    for data, rtol in ((small, 0.0), (wrong, 1e-9)):
        for n in (0, 5, 11):
            trajectory, alone = data[n], whole(data, n)
            first = int(trajectory.time_s[0])
            np.testing.assert_allclose(trajectory.state, alone.state[first : first + len(trajectory.time_s)], rtol=rtol)
            assert trajectory.eod_time_s == alone.eod_time_s


def test_states_between_checkpoints_are_the_same_to_the_bit(small, wrong):
    for index in (np.arange(12), np.array([5])):
        for sample in (0, 63, 64, 65):
            states = small.states_at(index, np.full(len(index), sample))
            np.testing.assert_array_equal(states, [whole(small, n).state[sample] for n in index])
            states = wrong.states_at(index, np.full(len(index), sample))
            np.testing.assert_array_equal(states, [wrong[n].state[sample] for n in index])


def test_same_seed_same_data():
    make = [TrajectoryDataset.generate("r_o", 5, RandomPiecewise(), seed=seed) for seed in (7, 7, 8)]
    np.testing.assert_array_equal(make[0].load_values, make[1].load_values)
    np.testing.assert_array_equal(make[0].checkpoint, make[1].checkpoint)
    assert not np.array_equal(make[0].r_o, make[2].r_o)
    assert (make[0].q_mobile == 7600.0).all()


@pytest.mark.parametrize("by", ["trajectory", "parameter"])
def test_a_split_is_a_partition(small, by):
    train, test = small.split(test=0.3, by=by, seed=1)
    assert len(train) + len(test) == len(small)
    both = np.concatenate([train.q_mobile, test.q_mobile])
    np.testing.assert_array_equal(np.sort(both), np.sort(small.q_mobile))
    assert by == "trajectory" or test.q_mobile.max() <= train.q_mobile.min()
    np.testing.assert_array_equal(test.q_mobile, small.split(test=0.3, by=by, seed=1)[1].q_mobile)


def test_single_trajectories_become_a_data_set_that_knows_how_they_were_made():
    cell = NEW_CELL.replace(to=10.0)
    warm = [simulate(8.0, q_mobile, 0.1, thermal=True, dt=2.0, cell=cell) for q_mobile in (6000.0, 7000.0)]
    data = TrajectoryDataset.from_trajectories(warm)
    assert (data.cell, data.thermal, data.dt_s) == (cell, True, 2.0)
    for again, trajectory in zip(data, warm, strict=True):
        np.testing.assert_array_equal(again.state, trajectory.state)
        assert again.cell == trajectory.cell == cell.replace(q_mobile=trajectory.q_mobile, r_o=0.1)


def test_single_trajectories_keep_what_is_known_of_their_end():
    whole, unknown = simulate(8.0, 7600.0, 0.1), simulate(8.0, 7600.0, 0.1, until=500.0)
    data = TrajectoryDataset.from_trajectories([whole, whole.part(100, 200), unknown])
    assert data[0].eod_time_s == whole.eod_time_s and data[1].eod_time_s == whole.eod_time_s - 100.0
    assert np.isnan(data[2].eod_time_s) and np.isnan(data.subset([2]).eod_time_s[0])


@pytest.mark.parametrize(
    "change", [{"thermal": True}, {"dt": 2.0}, {"cell": NEW_CELL.replace(to=10.0)}, {"load_unit": "current"}]
)
def test_single_trajectories_of_different_settings_do_not_go_together(change):
    with pytest.raises(ValueError, match="must share the constants of the cell but for q_mobile and r_o, one load"):
        TrajectoryDataset.from_trajectories([simulate(2.0), simulate(2.0, **change)])


def test_trimming_never_reaches_beyond_the_data():
    data = TrajectoryDataset.simulated(4000.0, 0.2, [constant(16.0)], 0).trimmed(0.95, 1.0)
    assert (data.samples[0], data.first[0], data.stop[0]) == (27, 23, 27) and len(data[0].time_s) == 4
    with pytest.raises(ValueError, match="two increasing shares"):
        data.trimmed(0.9, 0.1)


def test_what_is_saved_is_loaded_and_not_replaced(small, tmp_path):
    path = small.save(tmp_path / "folder" / "data")
    assert path.name == "data.npz" and list(path.parent.iterdir()) == [path]
    np.testing.assert_array_equal(TrajectoryDataset.load(path)[11].state, small[11].state)
    with pytest.raises(FileExistsError, match="exists already"):
        small.save(path)


class TestFiles:
    @staticmethod
    def rewritten(saved, folder, **changes):
        """The file with other arrays, as a faulty program would have written it."""
        with np.load(saved) as file:
            arrays = dict(file) | changes
        path = folder / "changed.npz"
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
        return path

    @settings(max_examples=60)
    @given(place=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
    def test_a_damaged_byte_is_found_or_does_no_harm(self, small, saved, place, flip):
        contents = bytearray(saved.read_bytes())
        contents[int(place * len(contents))] ^= flip
        damaged = saved.with_name("damaged.npz")
        damaged.write_bytes(contents)
        try:
            again = TrajectoryDataset.load(damaged)
        except ValueError as error:
            assert "damaged.npz" in str(error)
        else:
            for field in dataclasses.fields(small):
                np.testing.assert_array_equal(getattr(again, field.name), getattr(small, field.name))

    def test_foreign_and_truncated_files_are_refused(self, saved, tmp_path):
        with zipfile.ZipFile(tmp_path / "zip.npz", "w") as file:
            file.writestr("metadata.npy", b"no array")
        np.savez(tmp_path / "arrays.npz", q_mobile=np.ones(3))
        (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"format": 2}))
        (tmp_path / "empty.npz").write_bytes(b"")
        (tmp_path / "cut.npz").write_bytes(saved.read_bytes()[:5000])
        for path in tmp_path.iterdir():
            with pytest.raises(ValueError, match=rf"{path.name} is damaged, or no data set of simulated"):
                TrajectoryDataset.load(path)

    @pytest.mark.parametrize("name", ["q_mobile", "metadata"])
    def test_no_pickle_is_ever_run(self, saved, tmp_path, name):
        class Bomb:
            def __reduce__(self):
                return Path.touch, (tmp_path / "exploded",)

        bomb = np.empty(1, dtype=object)
        bomb[0] = Bomb()
        with pytest.raises(ValueError, match="allow_pickle=False"):
            TrajectoryDataset.load(self.rewritten(saved, tmp_path, **{name: bomb}))
        assert not (tmp_path / "exploded").exists()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format": 1}, "has format 1, this version reads 4: make it again"),
            ({"cell": {"kN": 1.0}}, "holds no valid data set: .*kN"),
        ],
    )
    def test_old_versions_and_settings_that_cannot_be_meant_are_refused(self, saved, tmp_path, change, message):
        with np.load(saved) as file:
            metadata = np.array(json.dumps(json.loads(str(file["metadata"])) | change))
        with pytest.raises(ValueError, match=f"changed.npz {message}"):
            TrajectoryDataset.load(self.rewritten(saved, tmp_path, metadata=metadata))

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("q_mobile", lambda a: a[:-1], r"must be an array of float64 of shape \(11,.*, got float64 \(12,"),
            ("checkpoint", lambda a: a[:-1], "checkpoint_start of trajectory 11 lie outside"),
            ("load_values", lambda a: a[:-1], "load_start of trajectory .* lie outside"),
            ("stop", lambda a: a + 10_000, "first and stop of trajectory 0 lie outside"),
            ("samples", lambda a: a.astype(np.int32), "samples must be an array of int64 .* got int32"),
            ("r_o", lambda a: None, "r_o"),
        ],
    )
    def test_arrays_that_cannot_be_a_data_set_are_refused(self, small, saved, tmp_path, name, change, message):
        with pytest.raises(ValueError, match=rf"changed.npz .*{message}"):
            TrajectoryDataset.load(self.rewritten(saved, tmp_path, **{name: change(getattr(small, name))}))


class TestMismatch:
    def test_only_the_constants_differ_and_by_as_much_as_asked(self):
        exact, wrong = (
            TrajectoryDataset.generate(BOTH, 300, [constant(14.0)], seed=3, mismatch=mismatch) for mismatch in (0.0, 0.3)
        )
        np.testing.assert_array_equal(exact.q_mobile, wrong.q_mobile)
        np.testing.assert_array_equal(exact.r_o, wrong.r_o)
        assert (exact.factors == 1.0).all()
        np.testing.assert_allclose(np.median(wrong.factors, axis=0), 1.0, atol=0.07)
        np.testing.assert_allclose(wrong.factors.std(axis=0) / wrong.factors.mean(axis=0), 0.3, atol=0.05)
        assert np.abs(np.corrcoef(wrong.factors.T) - np.eye(4)).max() < 0.2

    def test_a_time_step_must_suit_the_fastest_cell(self):
        fast = {"loads": [constant(8.0)], "load_index": 0, "factors": np.array([[1.0, 1.0, 0.5, 1.0]])}
        assert len(TrajectoryDataset.simulated(7600.0, 0.1, dt_s=6.0, **fast)) == 1
        with pytest.raises(ValueError, match=r"at most 6.087 s .* got 7.0"):
            TrajectoryDataset.simulated(7600.0, 0.1, dt_s=7.0, **fast)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameters": "capacity"}, "parameters must be"),
        ({"n": 0}, "n must be at least 1"),
        ({"n": 2.5}, "n must be a whole number, got 2.5"),
        ({"loads": []}, "loads must not be empty"),
        ({"loads": [constant(8.0), constant(2.0, "current")]}, "all in one unit"),
        ({"loads": [constant(60.0)]}, "lower its load"),
        ({"loads": [constant(0.0)]}, "raise its load"),
        ({"loads": constant(8.0)}, "list of Loads or a sampler of them, got Load"),
        ({"loads": ["8 W"]}, r"loads must be Loads, .* got \['str'\]"),
        ({"q_mobile_range": (1.0, 2.0)}, "q_mobile"),
        ({"q_mobile_range": (7600.0, 4000.0)}, "q_mobile_range must be finite and increasing, got"),
        ({"seed": None}, "seed must be a whole number, got None"),
        ({"mismatch": 0.6}, r"mismatch .* 0 \.\. 0.5, got 0.6"),
        ({"mismatch": "10 %"}, "mismatch .* got '10 %'"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        TrajectoryDataset.generate(**{"parameters": "q_mobile", "n": 2, "loads": [constant(8.0)], "seed": 0} | arguments)
