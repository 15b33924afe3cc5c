"""Contestants take turns and do the same work, the floor is that of the arithmetic that is done, and sections are written."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import SAC

from benchmarks import performance, throughput
from sb3_lac import LAC, compiled


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few transitions, short turns and small networks, and the threads of torch as they were."""
    threads = th.get_num_threads()
    for name in ("_SIMULATED_STEPS", "_SIMULATIONS", "_BATCHED_STEPS", "_ENV_STEPS"):
        monkeypatch.setattr(throughput, name, 3)
    monkeypatch.setattr(throughput, "_ENVIRONMENTS", {"BatteryRo-v0": 3})
    for name, value in {
        "_TRANSITIONS": 32,
        "_LARGE": [16, 16],
        "_SMALL": [8],
        "_COPIED_NUMBERS": 64,
        "_ON_GPU": (([8], 8, 1),),
    }.items():
        monkeypatch.setattr(performance, name, value)
    for name, values in {"_CELLS": (1, 2), "_BATCH_SIZES": (8, 16), "_WIDTHS": (4, 8)}.items():
        monkeypatch.setattr(performance, name, values)
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
    speeds = throughput.race(contestants, 4, lambda: next(clock))
    assert calls == ["LAC", "SAC", "TD3", "TD3", "SAC", "LAC"] * 2
    # work divided by seconds
    pd.testing.assert_frame_equal(speeds, pd.DataFrame({"LAC": [4.0] * 4, "SAC": [2.0] * 4, "TD3": [8.0] * 4}))


def test_the_model_does_the_same_work_as_progpy(monkeypatch):
    models = pytest.importorskip("progpy.models")
    final = {}
    for name, original in (("step_into", throughput.step_into), ("voltage_into", throughput.voltage_into)):

        def recorded(out, *arguments, name=name, original=original):
            original(out, *arguments)
            final[name] = out.copy()

        monkeypatch.setattr(throughput, name, recorded)
    output = models.BatteryElectroChemEOD.output
    monkeypatch.setattr(
        models.BatteryElectroChemEOD, "output", lambda self, x: final.update(progpy=(x, output(self, x))) or output(self, x)
    )
    contestants = throughput.model_contestants(2)
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
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in throughput.report_steps(speeds).splitlines()]
    assert rows[2:] == [
        ["a: ours", "6.0 (5.0 to 7.0)", ""],
        ["a: progpy x", "1.5 (1.2 to 1.8)", "4 (4 to 4)"],
        ["b: ours", "9.0 (9.0 to 9.0)", ""],
        ["b: progpy y", "2.0 (1.5 to 2.5)", "6 (4 to 8)"],
    ]
    assert "faster" not in throughput.report_steps(speeds[["a: ours"]])


def test_environments_and_filters_are_raced_and_written(monkeypatch, tmp_path, capsys):
    pytest.importorskip("progpy")
    pytest.importorskip("onnxruntime")
    contestants = throughput.environment_contestants(4)
    expected = {"BatteryRo-v0, 1 cell": 3, "BatteryRo-v0, 4 cells, NextStep": 12, "BatteryRo-v0, 4 cells, SameStep": 12}
    assert {name: turn() for name, turn in contestants.items()} == expected
    for name, count in (("_SAMPLES", 130), ("_PROGPY_SAMPLES", 2), ("_PARTICLES_SAMPLES", 2), ("_BATCH_SAMPLES", 2)):
        monkeypatch.setattr(throughput, name, count)
    short = ["--only", "environments", "filters", "--rounds", "2", "--cells", "4", "--filtered-cells", "3"]
    throughput.main([*short, "--out", str(tmp_path)])
    for section in ("environments", "filters"):
        assert (pd.read_csv(tmp_path / f"{section}.csv") > 0).all(axis=None)
        assert json.loads((tmp_path / f"{section}.json").read_text())["configuration"]["cells"] == 4
    shown = capsys.readouterr().out
    assert "| batch of 3 cells" in shown and "| progpy, unscented Kalman filter" in shown and "1.00 (1.00 to 1.00)" in shown


def products(env, width):
    """FLOPs of an update with one hidden layer, pass by pass."""
    observation, action = env.observation_space.shape[0], env.action_space.shape[0]
    actor_in, actor_out = observation * width, width * 2 * action
    critic_in, critic_out = (observation + action) * width, width
    actor = 3 * actor_in + 4 * actor_out  # s and s', gradients of weights, and of what comes before the last layer
    # Two of them. LAC: (s, a), (s', a') twice, (s, pi); weights for (s, a); inputs of the last layer twice, and of the first
    # for (s, pi). SAC: target, (s, a), (s, pi); weights for both of the latter; inputs
    critic = 2 * (6 * critic_in + 7 * critic_out)
    return 2 * 8 * (actor + critic)


@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_floating_point_operations_are_those_of_the_passes(algorithm):
    env = performance.many_cells(2)
    model = performance.ready_model(algorithm, [16], env, batch_size=8)
    assert performance.update_flops(model) == products(env, 16)


def test_bytes_are_those_of_adam_and_of_the_target():
    model = performance.ready_model(LAC, [16], performance.many_cells(2), batch_size=8)
    actor, critic = (sum(p.numel() for p in net.parameters()) for net in (model.actor, model.critic))
    assert performance.moved_bytes(model) == 28 * actor + 40 * critic


def test_sections_of_performance_are_written(tmp_path, capsys, monkeypatch):
    # where no GPU is, the processor stands for it
    monkeypatch.setattr(performance, "_GPU", "cpu")
    monkeypatch.setattr(th.cuda, "get_device_name", lambda: "a card")
    short = ["--rounds", "2", "--updates", "1", "--cells", "2", "--threads", "1"]
    performance.main([*short, "--out", str(tmp_path)])
    assert {path.stem for path in tmp_path.iterdir()} == set(performance.SECTIONS)
    assert pd.read_csv(tmp_path / "updates.csv").shape == (2, 12)
    growth = pd.read_csv(tmp_path / "growth.csv")
    assert growth.groupby("over")["value"].unique().map(list).to_dict() == {"batch": [8, 16], "cells": [1, 2], "width": [4, 8]}
    shown = capsys.readouterr().out
    assert all((tmp_path / f"{name}.md").read_text(encoding="utf-8") in shown for name in performance.SECTIONS)
