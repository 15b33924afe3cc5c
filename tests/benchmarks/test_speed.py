"""Contestants take turns and do the same work, and sections are written."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest
import torch as th

from benchmarks import speed
from sb3_lac import compiled


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few transitions, short turns and small networks, and the threads of torch as they were."""
    threads = th.get_num_threads()
    for name in ("_SIMULATED_STEPS", "_SIMULATIONS", "_BATCHED_STEPS", "_ENV_STEPS"):
        monkeypatch.setattr(speed, name, 3)
    monkeypatch.setattr(speed, "_ENVIRONMENTS", {"BatteryRo-v0": 3})
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


def test_the_model_does_the_same_work_as_progpy(monkeypatch):
    models = pytest.importorskip("progpy.models")
    final = {}
    for name, original in (("step_into", speed.step_into), ("voltage_into", speed.voltage_into)):

        def recorded(out, *arguments, name=name, original=original):
            original(out, *arguments)
            final[name] = out.copy()

        monkeypatch.setattr(speed, name, recorded)
    output = models.BatteryElectroChemEOD.output
    monkeypatch.setattr(
        models.BatteryElectroChemEOD, "output", lambda self, x: final.update(progpy=(x, output(self, x))) or output(self, x)
    )
    contestants = speed.model_contestants(2)
    assert [turn() for turn in contestants.values()] == [9, 3, 3, 6, 6, 6, 6, 6]
    for name, turn in contestants.items():
        if name.startswith("2 cells, step and voltage"):
            turn()
    state, outputs = final["progpy"]
    np.testing.assert_allclose(final["voltage_into"], outputs["v"], rtol=1e-9)
    np.testing.assert_allclose(final["step_into"][:, 0], state["tb"], rtol=1e-9)


def test_steps_are_compared_with_those_of_the_same_work_within_each_round():
    # the machine is half as fast in the second round: the ratio does not care
    speeds = pd.DataFrame({"a: ours": [8e3, 4e3], "a: progpy x": [2e3, 1e3], "b: ours": [9e3, 9e3], "b: progpy y": [3e3, 1e3]})
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in speed.report_steps(speeds).splitlines()]
    assert rows[2:] == [
        ["a: ours", "6.0 (5.0 to 7.0)", ""],
        ["a: progpy x", "1.5 (1.2 to 1.8)", "4 (4 to 4)"],
        ["b: ours", "9.0 (9.0 to 9.0)", ""],
        ["b: progpy y", "2.0 (1.5 to 2.5)", "6 (4 to 8)"],
    ]
    assert "faster" not in speed.report_steps(speeds[["a: ours"]])


def test_environments_and_filters_are_raced_and_written(monkeypatch, tmp_path, capsys):
    pytest.importorskip("progpy")
    pytest.importorskip("onnxruntime")
    contestants = speed.environment_contestants(4)
    expected = {"BatteryRo-v0, 1 cell": 3, "BatteryRo-v0, 4 cells, NextStep": 12, "BatteryRo-v0, 4 cells, SameStep": 12}
    assert {name: turn() for name, turn in contestants.items()} == expected
    for name, count in (("_SAMPLES", 130), ("_PROGPY_SAMPLES", 2), ("_PARTICLES_SAMPLES", 2)):
        monkeypatch.setattr(speed, name, count)
    short = ["--only", "environments", "filters", "--rounds", "2", "--cells", "4"]
    speed.main([*short, "--out", str(tmp_path)])
    for section in ("environments", "filters"):
        assert (pd.read_csv(tmp_path / f"{section}.csv") > 0).all(axis=None)
        assert json.loads((tmp_path / f"{section}.json").read_text())["configuration"]["cells"] == 4
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
