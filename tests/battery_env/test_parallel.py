"""Workers of a cluster are asked before any work whether they can be relied on."""

import time
from types import SimpleNamespace

import pytest

from battery_env import parallel

distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")


def test_calls_are_made_on_the_cluster_with_arguments_as_they_are(dask_cluster, tmp_path):
    with parallel.cluster(dask_cluster.scheduler_address, ["battery_env"], tmp_path / "new") as submit:
        # what Dask would take for a task of its own
        assert submit(list, [(sum, [1, 2])]).result() == [(sum, [1, 2])]
        with pytest.raises(ZeroDivisionError):
            submit(divmod, 1, 0).result()
    assert list((tmp_path / "new").iterdir()) == []


def test_what_has_not_begun_is_not_begun_when_the_block_is_left(dask_cluster, tmp_path):
    names = [tmp_path / str(number) for number in range(20)]
    with pytest.raises(KeyboardInterrupt), parallel.cluster(dask_cluster.scheduler_address, []) as submit:
        [submit(slow_touch, name) for name in names]
        raise KeyboardInterrupt
    with parallel.cluster(dask_cluster.scheduler_address, []) as submit:
        submit(slow_touch, tmp_path / "later").result()
    assert len(list(tmp_path.iterdir())) < len(names)


def slow_touch(path):
    time.sleep(0.1)
    path.touch()


def test_workers_with_other_code_are_refused(dask_cluster, monkeypatch):
    monkeypatch.setattr(parallel, "_code", {"battery_env": "another"}.get)
    with pytest.raises(RuntimeError, match="its battery_env is not the one here"):
        with parallel.cluster(dask_cluster.scheduler_address, ["battery_env"]):
            pass


def test_workers_must_see_the_folder_and_make_one_call_at_a_time(tmp_path):
    worker = SimpleNamespace(state=SimpleNamespace(nthreads=1))
    assert parallel._fault({}, tmp_path, worker) is None
    assert str(tmp_path) in parallel._fault({}, tmp_path / "probe", worker)
    worker.state.nthreads = 2
    assert "--nthreads 1" in parallel._fault({}, None, worker)


def test_what_does_not_answer_is_given_up_soon(monkeypatch):
    monkeypatch.setattr(parallel, "_PATIENCE_S", 0.1)
    with pytest.raises(OSError, match=r"no Dask scheduler at 'tcp://127.0.0.1:1': no answer within 0.1 s"):
        with parallel.cluster("tcp://127.0.0.1:1", []):
            pass
