"""A file is there as a whole, the old one or the new one, whichever write, sync or renaming fails. Also of two writers."""

import os
import threading

import numpy as np
import pytest
from matplotlib.figure import Figure

import battery_env.files
import sb3_lac.files
from battery_env import PolicyEstimator, TrajectoryDataset, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.lab.running import read_load
from battery_env.loads import constant
from battery_env.plotting import save_figure
from benchmarks.study import write_text
from sb3_lac import LAC
from tests.faults import Disk, a_full_disk

OLD, NEW = "old", "new"


def of_constants(which, path):
    NEW_CELL.replace(kn=1000.0 if which == OLD else 2000.0).to_json(path)


def of_data(which, path):
    TrajectoryDataset.generate("r_o", 1, [constant(12.0)], seed=which == OLD).save(path)


def of_a_state(which, path):
    estimator = PolicyEstimator.pretrained()
    estimator.update(4.1 if which == OLD else 4.2, 1.0, 0.0)
    estimator.save(path)


def of_a_figure(which, path):
    save_figure(Figure((1, 1 + (which == OLD))), path)


def of_a_table(which, path):
    write_text(path, 10_000 * which)


@pytest.fixture(scope="module")
def models():
    made = {which: LAC("MlpPolicy", "LinearCost-v0", buffer_size=200, seed=which == OLD, device="cpu") for which in (OLD, NEW)}
    made[OLD].learn(50)
    return made


# what writes a file, what reads it, and whether it takes the place of an older one
WRITERS = {
    "cell.json": (of_constants, CellParameters.from_json, False),
    "data.npz": (of_data, TrajectoryDataset.load, False),
    "state": (of_a_state, lambda path: PolicyEstimator.pretrained().load(path), True),
    "figure.png": (of_a_figure, None, True),
    "table.csv": (of_a_table, None, True),
    "model.zip": ("save", lambda path: LAC.load(path, device="cpu"), True),
    "buffer.pkl": ("save_replay_buffer", lambda path: LAC("MlpPolicy", "LinearCost-v0").load_replay_buffer(path), True),
}


# Stable-Baselines3 leaves a file open where a write fails
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("name", WRITERS)
def test_whichever_write_sync_or_renaming_fails_the_file_is_whole(name, tmp_path, request, monkeypatch):
    write, read, replaces = WRITERS[name]
    if isinstance(write, str):
        models, method = request.getfixturevalue("models"), write

        def write(which, path):
            getattr(models[which], method)(path)

    path = tmp_path / name
    write(NEW, path)
    size, new = path.stat().st_size, path.read_bytes()
    path.unlink()
    with monkeypatch.context() as patch:
        disk = Disk(patch)
        write(NEW, path)
    assert disk.calls in (["fsync", "replace", "fsync"], ["fsync", "link", "fsync"])
    path.unlink()
    old = None
    if replaces:
        write(OLD, path)
        old = path.read_bytes()
        assert old != new

    def check_whole(failed):
        found = path.read_bytes() if path.exists() else None
        assert found == old if failed else len(found) == size
        assert [each.name for each in tmp_path.iterdir()] == ([] if found is None else [name])
        if found is not None and read is not None:
            read(path)

    for after_bytes in (0, 1, size // 3, size - 1):
        with a_full_disk(after_bytes), pytest.raises((OSError, RuntimeError)):
            write(NEW, path)
        check_whole(failed=True)
    # the sync of the folder comes last, and the file is whole without it; there may be no links
    fatal = range(2) if replaces else range(1)
    for number in fatal:
        with monkeypatch.context() as patch, pytest.raises(OSError, match="Input/output error"):
            Disk(patch, number)
            write(NEW, path)
        check_whole(failed=True)
    with monkeypatch.context() as patch:
        Disk(patch, 2 if replaces else 1)
        write(NEW, path)
    check_whole(failed=False)


@pytest.mark.skipif(os.name == "nt", reason="modes of files are those of POSIX")
@pytest.mark.parametrize("package", [battery_env.files, sb3_lac.files], ids=["battery_env", "sb3_lac"])
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_who_may_read_a_file_stays_as_it_was_and_a_link_stays_one(package, mode, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    path, link = tmp_path / "elsewhere" / "state.bin", tmp_path / "link.bin"
    path.write_bytes(b"old")
    path.chmod(mode)
    link.symlink_to(path)
    for name in (path, link):
        with package.replacing(name) as part:
            part.write_bytes(b"new")
        assert path.read_bytes() == b"new" and path.stat().st_mode & 0o777 == mode and link.is_symlink()


@pytest.mark.parametrize("package", [battery_env.files, sb3_lac.files], ids=["battery_env", "sb3_lac"])
def test_two_writers_of_one_process_id_disturb_each_other_in_nothing(package, tmp_path):
    both, path, errors = threading.Barrier(2), tmp_path / "new" / "state.bin", []

    def write(content):
        try:
            with package.replacing(path) as part:
                both.wait()
                part.write_bytes(content)
                both.wait()
        except Exception as error:
            errors.append(error)

    writers = [threading.Thread(target=write, args=(bytes([n]) * 1000,)) for n in (1, 2)]
    for each in writers:
        each.start()
    for each in writers:
        each.join()
    assert not errors and len(set(path.read_bytes())) == 1 and list(path.parent.iterdir()) == [path]


def test_of_two_writers_of_a_new_file_one_is_told(tmp_path):
    path = tmp_path / "cell.json"
    with pytest.raises(FileExistsError, match=r"cell\.json exists already"):
        with battery_env.files.replacing(path, new=True) as part:
            NEW_CELL.to_json(path)
            part.write_text("another")
    assert CellParameters.from_json(path) == NEW_CELL and list(tmp_path.iterdir()) == [path]


def test_a_strangers_file_is_left_alone(tmp_path):
    path = tmp_path / "state"
    for content in (b"", b"Dear all", bytes(1000), b'{"kind": "letter"}'):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is damaged, or no state of an estimator"):
            PolicyEstimator.pretrained().load(path)
        with pytest.raises(FileExistsError, match="is no state of an estimator"):
            PolicyEstimator.pretrained().save(path)
        assert path.read_bytes() == content


@pytest.fixture(scope="module")
def streamed():
    """An estimator in the middle of a discharge, and how to make another one."""
    estimator, record = PolicyEstimator.pretrained(), load_nasa_discharges("B0005")[0].loaded_part(2.7)
    for sample in zip(record.voltage_V[:60], record.current_A[:60], np.diff(record.time_s, prepend=0.0)[:60], strict=True):
        estimator.update(*sample)
    return estimator, PolicyEstimator.pretrained


def test_a_state_that_was_changed_is_refused_whole(streamed, tmp_path):
    estimator, make = streamed
    file, rng = estimator.save(tmp_path / "state"), np.random.default_rng(0)
    whole, unchanged = file.read_bytes(), estimator.update(3.9, 2.0, 10.0)
    changed = [whole[:size] for size in (0, 1, 40, 1000, len(whole) - 1)] + [whole + b" ", whole[:-32]]
    for place in (*range(0, 400, 7), *rng.integers(len(whole), size=100)):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        changed.append(bytes(flipped))
    other = make()
    fresh = {name: array.copy() for name, array in other._arrays().items()}
    for content in changed:
        file.write_bytes(content)
        with pytest.raises(ValueError, match="state is damaged, or no state of an estimator"):
            other.load(file)
    for name, array in other._arrays().items():
        np.testing.assert_array_equal(array, fresh[name])
    file.write_bytes(whole)
    other.load(file)
    assert other.update(3.9, 2.0, 10.0) == unchanged


def test_a_state_of_another_version_is_refused(streamed, tmp_path, monkeypatch):
    estimator, make = streamed
    file = estimator.save(tmp_path / "state")
    monkeypatch.setattr("battery_env.estimators.state_files.FORMAT_VERSION", 11)
    with pytest.raises(ValueError, match="state has format 10, this version reads 11: begin a discharge anew"):
        make().load(file)


@pytest.mark.parametrize("content", [b"[" * 3_000, b"\xff", b"PK\3\4" + bytes(100), b"1" + 400 * b"0"])
def test_no_content_of_a_file_of_a_load_is_more_than_an_error(content, tmp_path):
    for suffix in (".csv", ".csv.gz", ".zip"):
        path = tmp_path / f"load{suffix}"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=path.name):
            read_load(path)
