"""Contestants take turns and do the same work, and sections are written."""

import itertools

import pandas as pd
import pytest
import torch as th

from benchmarks import speed
from sb3_lac.compiled import update as compiled


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few transitions, short turns and small networks, and the threads of torch as they were."""
    threads = th.get_num_threads()
    for name, value in {"_TRANSITIONS": 32, "_UPDATES": (([8], 2, 1),), "_ON_GPU": (([8], 8, 2, 1),)}.items():
        monkeypatch.setattr(speed, name, value)
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    yield
    th.set_num_threads(threads)


def test_contestants_take_turns_in_alternating_order():
    clock, calls = itertools.count(), []

    def contestant(name, seconds):
        def turn():
            calls.append(name)
            for _ in range(seconds - 1):
                next(clock)
            return 8

        return turn

    contestants = {name: contestant(name, seconds) for name, seconds in {"LAC": 2, "SAC": 4, "TD3": 1}.items()}
    speeds = speed.race(contestants, 4, lambda: next(clock))
    assert calls == ["LAC", "SAC", "TD3", "TD3", "SAC", "LAC"] * 2
    # work divided by seconds
    pd.testing.assert_frame_equal(speeds, pd.DataFrame({"LAC": [4.0] * 4, "SAC": [2.0] * 4, "TD3": [8.0] * 4}))


@pytest.mark.attacks
def test_filters_are_raced_and_written(monkeypatch, tmp_path, capsys):
    pytest.importorskip("progpy")
    pytest.importorskip("onnxruntime")
    for name, count in (("_SAMPLES", 130), ("_PROGPY_SAMPLES", 2), ("_PARTICLES_SAMPLES", 2)):
        monkeypatch.setattr(speed, name, count)
    speed.main(["--only", "filters", "--rounds", "2", "--out", str(tmp_path)])
    assert (pd.read_csv(tmp_path / "filters.csv") > 0).all(axis=None)
    shown = capsys.readouterr().out
    assert "| progpy, unscented Kalman filter" in shown and "1.00 (1.00 to 1.00)" in shown


@pytest.mark.attacks
def test_updates_are_raced_and_written(tmp_path, capsys, monkeypatch):
    pytest.importorskip("sbx")
    # where no GPU is, the processor stands for it
    monkeypatch.setattr(speed, "_GPU", "cpu")
    monkeypatch.setattr(th.cuda, "get_device_name", lambda: "a card")
    speed.main(["--only", "updates", "gpu", "--rounds", "2", "--out", str(tmp_path)])
    updates, gpu = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("updates", "gpu"))
    assert updates["updates in a call"].tolist() == [2, 2] and (gpu["GPU"] == "a card").all()
    assert (updates.select_dtypes("number") > 0).all(axis=None) and len(gpu) == 2
    shown = capsys.readouterr().out
    assert all((tmp_path / f"{name}.md").read_text(encoding="utf-8") in shown for name in ("updates", "gpu"))


def test_a_turn_is_as_many_updates_as_it_says(monkeypatch):
    calls = []
    train = speed.LAC.train
    monkeypatch.setattr(
        speed.LAC,
        "train",
        lambda self, gradient_steps, batch_size: calls.append(gradient_steps) or train(self, gradient_steps, batch_size),
    )
    turn = speed.updates_of(speed.LAC, [8], 8, 3, 2, device="cpu")
    calls.clear()
    assert turn() == 6 and calls == [3, 3]
