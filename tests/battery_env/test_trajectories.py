"""Data sets of simulated discharges."""

import dataclasses
import json
import pickle
import sys
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from battery_env.dataset_files import described
from battery_env.electrochemistry import NEW_CELL, STATE_NAMES, UNCERTAIN_CONSTANTS, initial_state, simulate
from battery_env.loads import RandomPiecewise, constant
from battery_env.trajectories import _ARRAYS, PAPER_LOADS_W, TrajectoryDataset


@pytest.fixture(scope="module")
def small():
    return TrajectoryDataset.generate("joint", 12, [constant(p) for p in (8.0, 10.0, 12.0)], seed=3, trim=(0.05, 0.95))


@pytest.fixture(scope="module")
def saved(small, tmp_path_factory):
    return small.save(tmp_path_factory.mktemp("saved") / "data.npz")


@pytest.fixture(scope="module")
def wrong():
    return TrajectoryDataset.generate("joint", 12, [constant(8.0), constant(12.0)], seed=3, mismatch=0.2)


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


def test_single_trajectories_keep_what_is_known_of_their_end():
    whole = simulate(8.0, 7600.0, 0.1)
    unknown = simulate(8.0, 7600.0, 0.1, until=500.0)
    data = TrajectoryDataset.from_trajectories([whole, whole.part(100, 200), unknown])
    assert data[0].eod_time_s == whole.eod_time_s and data[1].eod_time_s == whole.eod_time_s - 100.0
    assert np.isnan(data[2].eod_time_s) and np.isnan(data.subset([2]).eod_time_s[0])


def test_single_trajectories_know_how_they_were_made():
    cell = NEW_CELL.replace(to=10.0)
    warm = [simulate(8.0, q_mobile, 0.1, thermal=True, dt=2.0, cell=cell) for q_mobile in (6000.0, 7000.0)]
    data = TrajectoryDataset.from_trajectories(warm)
    assert (data.cell, data.thermal, data.dt_s) == (cell, True, 2.0)
    for again, trajectory in zip(data, warm, strict=True):
        np.testing.assert_array_equal(again.state, trajectory.state)
        assert again.cell == trajectory.cell == cell.replace(q_mobile=trajectory.q_mobile, r_o=0.1)
    for other in (
        simulate(8.0, thermal=True),
        simulate(8.0, dt=2.0),
        simulate(8.0, cell=cell),
        simulate(2.0, load_unit="current"),
    ):
        with pytest.raises(
            ValueError, match="trajectories must share the constants of the cell but for q_mobile and r_o, one load"
        ):
            TrajectoryDataset.from_trajectories([simulate(8.0), other])


def test_a_trajectory_that_does_not_fit_its_states_is_not_made_up(small):
    load_values = np.full_like(small.load_values, 100.0)
    with pytest.raises(ValueError, match="trajectory 0 cannot be simulated again"):
        dataclasses.replace(small, load_values=load_values)[0]


def test_trimming_never_reaches_beyond_the_data():
    data = TrajectoryDataset.simulated(4000.0, 0.2, [constant(16.0)], 0, trim=(0.95, 1.0))
    assert (data.samples[0], data.first[0], data.stop[0]) == (27, 23, 27) and len(data[0].time_s) == 4


def test_what_is_saved_is_loaded(small, tmp_path):
    path = small.save(tmp_path / "folder" / "data")
    assert path.name == "data.npz" and list(path.parent.iterdir()) == [path]
    again = TrajectoryDataset.load(path)
    for n in range(len(small)):
        np.testing.assert_array_equal(again[n].state, small[n].state)
    assert again.cell == small.cell and again.description == small.description
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

    @settings(max_examples=200)
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
            assert again._settings() == small._settings()
            for name in _ARRAYS:
                np.testing.assert_array_equal(getattr(again, name), getattr(small, name))

    @pytest.mark.parametrize("length", [0, 1, 100, 5000])
    def test_a_truncated_file_is_refused(self, saved, tmp_path, length):
        (tmp_path / "cut.npz").write_bytes(saved.read_bytes()[:length])
        with pytest.raises(ValueError, match=r"cut.npz is damaged, or no data set"):
            TrajectoryDataset.load(tmp_path / "cut.npz")

    def test_foreign_files_are_refused(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "zip.npz", "w") as file:
            file.writestr("metadata.npy", b"no array")
        np.savez(tmp_path / "arrays.npz", q_mobile=np.ones(3))
        np.save(tmp_path / "array.npy", np.ones(3))
        (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"format": 2}))
        for name in ("zip.npz", "arrays.npz", "array.npy", "pickle.npz"):
            with pytest.raises(ValueError, match=rf"{name} is damaged, or no data set"):
                TrajectoryDataset.load(tmp_path / name)
        with pytest.raises(FileNotFoundError):
            TrajectoryDataset.load(tmp_path / "none.npz")

    def test_no_pickle_is_ever_run(self, saved, tmp_path):
        class Bomb:
            def __reduce__(self):
                return Path.touch, (tmp_path / "exploded",)

        bomb = np.empty(1, dtype=object)
        bomb[0] = Bomb()
        for name in ("q_mobile", "metadata"):
            with np.load(saved) as file:
                np.savez(tmp_path / "bomb.npz", **{**file, name: bomb})
            with pytest.raises(ValueError, match="allow_pickle=False"):
                TrajectoryDataset.load(tmp_path / "bomb.npz")
        assert not (tmp_path / "exploded").exists()

    def test_version_1_had_no_factors_and_is_refused(self, saved, tmp_path):
        metadata = np.array(json.dumps({"format": 1, "sha256": "0"}))
        old = self.rewritten(saved, tmp_path, metadata=metadata, factors=None, eod_time_s=None)
        with pytest.raises(ValueError, match="has format 1, this version reads 3: generate it again"):
            TrajectoryDataset.load(old)

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("q_mobile", lambda a: a[:-1], r"must be an array of float64 of shape \(11,.*, got float64 \(12,"),
            ("checkpoint", lambda a: a[:, :7], r"checkpoint must be an array of float64 of shape"),
            ("checkpoint", lambda a: a[:-1], "checkpoint_start of trajectory 11 lie outside"),
            ("checkpoint", lambda a: a * np.nan, "checkpoint must be finite"),
            ("load_values", lambda a: a[:-1], "load_start of trajectory .* lie outside"),
            ("load_values", lambda a: a * np.nan, "load must lie within .* got nan"),
            ("load_start", lambda a: a - 1, "load_start of trajectory .* lie outside"),
            ("factors", lambda a: a * 0.0, "factors must be finite and greater than 0, got 0"),
            ("factors", lambda a: a * 0.05, "dt must be"),
            ("first", lambda a: a.astype(np.float64), r"first must be an array of int64 .* got float64"),
            ("stop", lambda a: a + 10_000, "first and stop of trajectory 0 lie outside"),
            ("samples", lambda a: a.astype(np.int32), "samples must be an array of int64 .* got int32"),
            ("r_o", lambda a: a * 1000.0, "r_o must lie within .* Milliohms"),
            ("r_o", lambda a: None, "r_o"),
        ],
    )
    def test_arrays_that_cannot_be_a_data_set_are_refused(self, small, saved, tmp_path, name, change, message):
        with pytest.raises(ValueError, match=rf"changed.npz .*{message}"):
            TrajectoryDataset.load(self.rewritten(saved, tmp_path, **{name: change(getattr(small, name))}))

    def test_settings_that_cannot_be_meant_are_refused(self, small, saved, tmp_path):
        for change, message in (({"load_unit": "kW"}, "load_unit must be"), ({"cell": {"kN": 1.0}}, "kN")):
            metadata = np.array(json.dumps(described(small._settings()) | change))
            with pytest.raises(ValueError, match=rf"changed.npz holds no valid data set: .*{message}"):
                TrajectoryDataset.load(self.rewritten(saved, tmp_path, metadata=metadata))


class TestMismatch:
    def test_only_the_constants_differ_and_by_as_much_as_asked(self):
        exact, wrong = (
            TrajectoryDataset.generate("joint", 300, [constant(14.0)], seed=3, mismatch=mismatch) for mismatch in (0.0, 0.3)
        )
        np.testing.assert_array_equal(exact.q_mobile, wrong.q_mobile)
        np.testing.assert_array_equal(exact.r_o, wrong.r_o)
        assert (exact.factors == 1.0).all()
        np.testing.assert_allclose(np.median(wrong.factors, axis=0), 1.0, atol=0.07)
        np.testing.assert_allclose(wrong.factors.std(axis=0) / wrong.factors.mean(axis=0), 0.3, atol=0.05)
        assert np.abs(np.corrcoef(wrong.factors.T) - np.eye(4)).max() < 0.2

    def test_a_trajectory_is_the_simulation_of_its_own_constants(self, wrong):
        for n in (0, 7):
            kn, t_diffusion, to, tsn = wrong.factors[n]
            cell = NEW_CELL.replace(
                kn=NEW_CELL.kn * kn, tDiffusion=NEW_CELL.tDiffusion * t_diffusion, to=NEW_CELL.to * to, tsn=NEW_CELL.tsn * tsn
            )
            whole = simulate(wrong[n].load[0], wrong.q_mobile[n], wrong.r_o[n], cell=cell)
            nominal = simulate(wrong[n].load[0], wrong.q_mobile[n], wrong.r_o[n])
            np.testing.assert_allclose(wrong[n].state, whole.state, rtol=1e-9)
            assert wrong[n].eod_time_s == whole.eod_time_s
            assert np.abs(wrong[n].voltage_V[:100] - nominal.voltage_V[:100]).max() > 1e-3

    def test_states_between_checkpoints_are_the_same_to_the_bit(self, wrong):
        for index in (np.arange(12), np.array([5])):
            for sample in (0, 63, 200):
                states = wrong.states_at(index, np.full(len(index), sample))
                np.testing.assert_array_equal(states, [wrong[n].state[sample] for n in index])

    def test_constants_are_packed_row_by_row_or_shared(self, small, wrong):
        assert small.packed(np.array([3, 4])) is small.cell.packed
        np.testing.assert_array_equal(
            wrong.packed(np.array([3, 4])).constants, NEW_CELL.packed_with(wrong.factors[[3, 4]]).constants
        )

    def test_subsets_and_files_keep_them(self, wrong, tmp_path):
        part = wrong.subset([7, 2])
        np.testing.assert_array_equal(part[1].state, wrong[2].state)
        again = TrajectoryDataset.load(part.save(tmp_path / "part"))
        np.testing.assert_array_equal(again[0].state, wrong[7].state)
        np.testing.assert_array_equal(again.factors, part.factors)

    def test_cells_of_different_constants_do_not_go_together(self, wrong):
        with pytest.raises(ValueError, match="got 2 sets of constants"):
            TrajectoryDataset.from_trajectories([wrong[0], wrong[1]])
        np.testing.assert_allclose(TrajectoryDataset.from_trajectories([wrong[0]])[0].state, wrong[0].state, rtol=1e-9)

    def test_a_time_step_must_suit_the_fastest_cell(self):
        for dt_s in (6.0, 7.0):
            make = partial(TrajectoryDataset.simulated, 7600.0, 0.1, [constant(8.0)], 0, dt_s=dt_s)
            if dt_s < 6.08671:
                assert len(make(factors=np.array([[1.0, 1.0, 0.5, 1.0]]))) == 1
            else:
                with pytest.raises(ValueError, match=r"at most 6.087 s .* got 7.0"):
                    make(factors=np.array([[1.0, 1.0, 0.5, 1.0]]))


class TestTables:
    def test_a_frame_holds_every_sample(self, small):
        frame = small.to_frame()
        assert list(frame) == [
            *("trajectory", "time_s", "voltage_V", "current_A", "load"),
            *(*STATE_NAMES, "q_mobile", "r_o"),
        ]
        assert len(frame) == (small.stop - small.first).sum()
        for n in (0, 11):
            rows = frame[frame["trajectory"] == n]
            np.testing.assert_array_equal(rows["time_s"], small[n].time_s)
            np.testing.assert_array_equal(rows["voltage_V"], small[n].voltage_V)
            np.testing.assert_array_equal(rows[list(STATE_NAMES)], small[n].state)
            assert (rows["q_mobile"] == small.q_mobile[n]).all()

    def test_the_summary_says_what_each_discharge_was(self):
        data = TrajectoryDataset.generate("r_o", 6, RandomPiecewise(), seed=1, trim=(0.1, 0.7), mismatch=0.1)
        summary = data.summary()
        assert len(summary) == 6
        row, trajectory = summary.iloc[5], data[5]
        assert (row["trajectory"], row["q_mobile"], row["r_o"]) == (5, data.q_mobile[5], data.r_o[5])
        assert [row[f"{name}_factor"] for name in UNCERTAIN_CONSTANTS] == list(data.factors[5])
        assert (row["samples"], row["start_time_s"]) == (len(trajectory.time_s), trajectory.time_s[0])
        loads = trajectory.load
        assert (row["load_mean"], row["load_lowest"], row["load_highest"]) == (loads.mean(), loads.min(), loads.max())
        assert row["eod_time_s"] == trajectory.eod_time_s

    def test_a_parquet_file_holds_the_frame_and_where_it_comes_from(self, small, tmp_path):
        pytest.importorskip("pyarrow")
        path = small.to_parquet(tmp_path / "folder" / "data")
        assert path.name == "data.parquet" and list(path.parent.iterdir()) == [path]
        frame = pd.read_parquet(path)
        pd.testing.assert_frame_equal(frame, small.to_frame())
        assert frame.attrs["description"]["seed"] == 3 and frame.attrs["cell"]["kn"] == 2120.96
        assert set(frame.attrs["versions"]) == {"python", "numpy", "numba"}
        with pytest.raises(FileExistsError, match="exists already"):
            small.to_parquet(path)

    def test_without_pyarrow_the_extra_is_named(self, small, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(ImportError, match=r"battery_env\[parquet\]"):
            small.to_parquet(tmp_path / "data")
        assert not any(tmp_path.iterdir())


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
        ({"q_mobile_range": (7600.0, 4000.0)}, "q_mobile_range must be finite and increasing, got"),
        ({"r_o_range": (0.1, np.nan)}, "r_o_range must be finite"),
        ({"loads": constant(8.0)}, "list of Loads or a sampler of them, got Load"),
        ({"loads": ["8 W"]}, r"loads must be Loads, .* got \['str'\]"),
        ({"loads": lambda rng: 8.0}, r"loads must be Loads, .* got \['float'\]"),
        ({"n": 2.5}, "n must be a whole number, got 2.5"),
        ({"seed": None}, "seed must be a whole number, got None"),
        ({"seed": -1}, "seed = -1"),
        ({"mismatch": -0.1}, r"mismatch .* 0 \.\. 0.5, got -0.1"),
        ({"mismatch": 0.6}, r"mismatch .* 0 \.\. 0.5, got 0.6"),
        ({"mismatch": "10 %"}, "mismatch .* got '10 %'"),
        ({"mismatch": np.nan}, "mismatch .* got nan"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        TrajectoryDataset.generate(**{"parameter": "q_mobile", "n": 2, "loads": [constant(8.0)], "seed": 0} | arguments)


def test_an_initial_state_is_the_first_checkpoint(small):
    np.testing.assert_array_equal(small.checkpoint[small.checkpoint_start], initial_state(small.q_mobile))
