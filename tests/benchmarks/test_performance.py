"""The floor is that of the arithmetic that is done, the parts of a profile are complete, and all sections are written."""

import itertools
import json

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import SAC

from benchmarks import performance
from sb3_lac import LAC, compiled


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few transitions and small networks, and the threads of torch as they were."""
    threads = th.get_num_threads()
    for name, value in {
        "_TRANSITIONS": 32,
        "_LARGE": [16, 16],
        "_SMALL": [8],
        "_CELLS": (1, 2),
        "_BATCH_SIZES": (8, 16),
        "_WIDTHS": (4, 8),
        "_COPIED_NUMBERS": 64,
    }.items():
        monkeypatch.setattr(performance, name, value)
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    yield
    th.set_num_threads(threads)


def products(env, width, algorithm):
    """FLOPs of an update with one hidden layer, pass by pass."""
    observation, action = env.observation_space.shape[0], env.action_space.shape[0]
    actor_in, actor_out = observation * width, width * 2 * action
    critic_in, critic_out = (observation + action) * width, width * (17 if algorithm is LAC else 1)
    actor = 3 * actor_in + 4 * actor_out  # s and s', gradients of weights, and of what comes before the last layer
    if algorithm is LAC:
        # (s, a), (s', a') twice, (s, pi); weights for (s, a); inputs of the last layer twice, and of the first for (s, pi)
        critic = 6 * critic_in + 7 * critic_out
    else:
        # twice: target, (s, a), (s, pi); weights for both of the latter; inputs
        critic = 2 * (6 * critic_in + 7 * critic_out)
    return 2 * 8 * (actor + critic)


@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_floating_point_operations_are_those_of_the_passes(algorithm):
    env = performance.many_cells(2)
    model = performance.ready_model(algorithm, [16], env, batch_size=8)
    assert performance.update_flops(model) == products(env, 16, algorithm)


def test_bytes_are_those_of_adam_and_of_the_target():
    model = performance.ready_model(LAC, [16], performance.many_cells(2), batch_size=8)
    actor, critic = (sum(p.numel() for p in net.parameters()) for net in (model.actor, model.critic))
    assert performance.moved_bytes(model) == 28 * actor + 40 * critic


def test_stopwatch_counts_each_second_once():
    clock = itertools.count()
    watch = performance.Stopwatch(lambda: next(clock))
    inner = watch.watched("inner", lambda x: x + 1)
    with watch.part("outer"):
        assert inner(1) == 2
        with pytest.raises(ZeroDivisionError):
            watch.watched("failing", lambda: 1 / 0)()
    # one second from each reading of the clock to the next
    assert watch.seconds == {"outer": 3.0, "inner": 1.0, "failing": 1.0}


def test_profile_of_learn_leaves_the_model_as_it_was():
    model = performance.ready_model(LAC, [8], performance.many_cells(4), batch_size=8)
    updates = model._n_updates
    seconds = performance.profile_learn(model, 3)
    assert all(value > 0 for name, value in seconds.items() if name != "logging") and list(seconds)[-1] == "loop"
    assert model._n_updates == updates + 3
    assert "train" not in vars(model) and "step" not in vars(model.actor.optimizer)


def test_memory_of_a_transition_is_what_the_replay_buffer_allocates(monkeypatch):
    monkeypatch.setattr(performance, "own_env_ids", lambda: ["LinearCost-v0", "BatteryQmaxPaper-v0"])
    table = performance.measure_memory(10_000)
    np.testing.assert_allclose(table["MB allocated"].astype(float), table["MB computed"].astype(float), atol=0.1)


def test_all_environments_of_the_project_are_listed():
    ids = performance.own_env_ids()
    assert {"BatteryQmax-v0", "BatteryAging-v0", "LinearCost-v0", "VehicleCost-v0"} <= set(ids)
    assert not any("Pendulum-v1" in name for name in ids) and all(name in gym.registry for name in ids)


def test_sections_are_written(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(performance, "own_env_ids", lambda: ["LinearCost-v0"])
    short = ["--rounds", "2", "--updates", "1", "--cells", "2", "--threads", "1", "--transitions", "100"]
    performance.main([*short, "--out", str(tmp_path)])
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {"growth.png", *(f"{name}.{end}" for name in performance.SECTIONS for end in ("csv", "json", "md"))} | {
        "learn_profile.csv",
        "learn_profile.json",
    }
    assert pd.read_csv(tmp_path / "updates.csv").shape == (2, 10)
    assert pd.read_csv(tmp_path / "learn_profile.csv")["share"].sum() == pytest.approx(1.0, abs=1e-4)
    growth = pd.read_csv(tmp_path / "growth.csv")
    assert growth.groupby(["over", "value"]).size().to_dict() == dict.fromkeys(
        [("batch", 8), ("batch", 16), ("cells", 1), ("cells", 2), ("width", 4), ("width", 8)], 1
    )
    assert json.loads((tmp_path / "memory.json").read_text())["configuration"]["transitions"] == 100
    shown = capsys.readouterr().out
    assert all((tmp_path / f"{name}.md").read_text(encoding="utf-8") in shown for name in performance.SECTIONS)


@pytest.mark.parametrize("option", ["--rounds", "--updates", "--cells", "--threads", "--transitions"])
def test_nonsense_on_the_command_line_is_refused(option, capsys):
    with pytest.raises(SystemExit):
        performance.main([option, "0"])
    assert "must be at least 1" in capsys.readouterr().err
