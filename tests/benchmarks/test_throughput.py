"""The models take turns, the shares of a profile are complete, and both are written."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest
import torch as th

from benchmarks import throughput
from sb3_lac import LAC

ENV_ID = "LinearCost-v0"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few transitions, and the threads of torch as they were."""
    threads = th.get_num_threads()
    monkeypatch.setattr(throughput, "_TRANSITIONS", 40)
    monkeypatch.setattr(throughput, "_WARM_UP_UPDATES", 1)
    yield
    th.set_num_threads(threads)


def test_models_take_turns_in_alternating_order(monkeypatch):
    clock, calls = itertools.count(), []
    monkeypatch.setattr(throughput.time, "perf_counter", lambda: clock.__next__())

    class Model:
        def __init__(self, name, seconds):
            self.name, self.seconds = name, seconds

        def train(self, gradient_steps, batch_size):
            calls.append((self.name, gradient_steps, batch_size))
            for _ in range(self.seconds - 1):
                next(clock)

    models = {"LAC": Model("LAC", 2), "SAC": Model("SAC", 4), "TD3": Model("TD3", 1)}
    speeds = throughput.measure(models, 4, 8, 16)
    assert [name for name, _, _ in calls] == ["LAC", "SAC", "TD3", "TD3", "SAC", "LAC"] * 2
    assert {call[1:] for call in calls} == {(8, 16)}
    # updates divided by seconds
    pd.testing.assert_frame_equal(speeds, pd.DataFrame({"LAC": [4.0] * 4, "SAC": [2.0] * 4, "TD3": [8.0] * 4}))


@pytest.mark.parametrize("algo", list(throughput._ALGORITHMS))
def test_models_are_ready_for_updates_and_equal_in_size(algo):
    model = throughput.filled_model(throughput._ALGORITHMS[algo], ENV_ID, [8, 4], 16, 40)
    assert type(model).__name__ == algo and model.replay_buffer.full and model._n_updates == 1
    for network in (model.actor, model.critic):
        # the first layer of each network
        assert any(isinstance(layer, th.nn.Linear) and layer.out_features == 8 for layer in network.modules())


def test_shares_of_the_time_are_complete():
    model = throughput.filled_model(LAC, ENV_ID, [8], 16, 40)
    shares = throughput.profile(model, 2, 16)
    assert list(shares) == [*throughput._PARTS, "Python"]
    assert sum(shares.values()) == pytest.approx(1.0)
    assert all(0 <= share <= 1 for share in shares.values())
    assert shares["matrix products"] > 0 and shares["autograd"] > 0 and shares["optimizers and target networks"] > 0
    assert model._n_updates == 3


def test_report_compares_within_each_round():
    # the machine is half as fast in the second round: the ratio does not care
    speeds = pd.DataFrame({"LAC": [100.0, 50.0], "SAC": [50.0, 25.0], "TD3": [200.0, 100.0]})
    parts = pd.DataFrame({"Python": [0.25, 0.5], "autograd": [0.75, 0.5]}, index=["LAC", "SAC"])
    text = throughput.report(speeds, parts)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line]
    assert rows[2:5] == [
        ["LAC", "75.0 (62.5 to 87.5)", "1.00 (1.00 to 1.00)"],
        ["SAC", "37.5 (31.2 to 43.8)", "2.00 (2.00 to 2.00)"],
        ["TD3", "150.0 (125.0 to 175.0)", "0.50 (0.50 to 0.50)"],
    ]
    assert rows[5] == ["share of the time", "Python", "autograd"] and rows[7:] == [
        ["LAC", "25 %", "75 %"],
        ["SAC", "50 %", "50 %"],
    ]


def test_tables_are_written(tmp_path, capsys):
    command = ["--only", "updates", "--rounds", "2", "--updates", "1", "--env", ENV_ID, "--net-arch", "8", "--batch-size", "8"]
    throughput.main([*command, "--out", str(tmp_path)])
    speeds = pd.read_csv(tmp_path / "updates.csv")
    assert list(speeds) == ["LAC", "SAC", "TD3"] and len(speeds) == 2 and (speeds > 0).all(axis=None)
    profile = pd.read_csv(tmp_path / "updates_profile.csv", index_col="algorithm")
    assert list(profile.index) == ["LAC", "SAC", "TD3"]
    np.testing.assert_allclose(profile.sum(axis=1), 1.0, atol=1e-4)
    record = json.loads((tmp_path / "updates.json").read_text())
    assert record["configuration"]["net_arch"] == [8] and record["configuration"]["threads"] == 1
    assert (tmp_path / "updates.md").read_text(encoding="utf-8") in capsys.readouterr().out


@pytest.fixture
def short(monkeypatch):
    """Turns of a few steps."""
    for name in ("_SIMULATED_STEPS", "_SIMULATIONS", "_BATCHED_STEPS", "_ENV_STEPS"):
        monkeypatch.setattr(throughput, name, 3)


def test_the_model_does_the_same_work_as_progpy(short, monkeypatch):
    pytest.importorskip("progpy")
    final = {}
    for name, module in (("step_into", throughput), ("voltage_into", throughput)):
        original = getattr(module, name)

        def recorded(out, *arguments, name=name, original=original):
            original(out, *arguments)
            final[name] = out.copy()

        monkeypatch.setattr(module, name, recorded)
    from progpy.models import BatteryElectroChemEOD

    output = BatteryElectroChemEOD.output
    monkeypatch.setattr(
        BatteryElectroChemEOD, "output", lambda self, x: final.update(progpy=(x, output(self, x))) or output(self, x)
    )
    contestants = throughput.model_contestants(2)
    assert [turn() for turn in contestants.values()] == [9, 3, 3, 6, 6, 6, 6, 6]
    both = [turn for name, turn in contestants.items() if name.startswith("2 cells, step and voltage")]
    assert len(both) == 2
    for turn in both:
        turn()
    state, outputs = final["progpy"]
    np.testing.assert_allclose(final["voltage_into"], outputs["v"], rtol=1e-9)
    np.testing.assert_allclose(final["step_into"][:, 0], state["tb"], rtol=1e-9)


def test_environments_are_raced_for_one_cell_and_for_many(short, monkeypatch):
    monkeypatch.setattr(throughput, "_ENVIRONMENTS", {"BatteryRo-v0": 3})
    contestants = throughput.environment_contestants(4)
    expected = {"BatteryRo-v0, 1 cell": 3, "BatteryRo-v0, 4 cells, NextStep": 12, "BatteryRo-v0, 4 cells, SameStep": 12}
    assert {name: turn() for name, turn in contestants.items()} == expected


def test_steps_are_compared_with_those_of_the_same_work():
    speeds = pd.DataFrame({"a: ours": [8e3, 4e3], "a: progpy x": [2e3, 1e3], "b: ours": [9e3, 9e3], "b: progpy y": [3e3, 1e3]})
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in throughput.report_steps(speeds).splitlines()]
    assert rows[2:] == [
        ["a: ours", "6.0 (5.0 to 7.0)", ""],
        ["a: progpy x", "1.5 (1.2 to 1.8)", "4 (4 to 4)"],
        ["b: ours", "9.0 (9.0 to 9.0)", ""],
        ["b: progpy y", "2.0 (1.5 to 2.5)", "6 (4 to 8)"],
    ]
    assert "faster" not in throughput.report_steps(speeds[["a: ours"]])


def test_sections_are_chosen_and_written(short, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(throughput, "_ENVIRONMENTS", {"BatteryRo-v0": 3})
    throughput.main(["--only", "environments", "--rounds", "2", "--cells", "4", "--out", str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["environments.csv", "environments.json", "environments.md"]
    speeds = pd.read_csv(tmp_path / "environments.csv")
    assert speeds.shape == (2, 3) and (speeds > 0).all(axis=None)
    assert json.loads((tmp_path / "environments.json").read_text())["configuration"]["cells"] == 4
    assert (tmp_path / "environments.md").read_text(encoding="utf-8") in capsys.readouterr().out
    with pytest.raises(SystemExit):
        throughput.main(["--only", "everything"])


@pytest.mark.parametrize("option", ["--rounds", "--updates", "--net-arch", "--batch-size", "--cells", "--threads"])
def test_nonsense_on_the_command_line_is_refused(option, capsys):
    with pytest.raises(SystemExit):
        throughput.main([option, "0"])
    assert "must be at least 1" in capsys.readouterr().err


def test_filters_take_their_turns(short, monkeypatch, tmp_path, capsys):
    pytest.importorskip("progpy")
    pytest.importorskip("onnxruntime")
    for name, count in (("_SAMPLES", 130), ("_PROGPY_SAMPLES", 2), ("_PARTICLES_SAMPLES", 2), ("_BATCH_SAMPLES", 2)):
        monkeypatch.setattr(throughput, name, count)
    throughput.main(["--only", "filters", "--rounds", "2", "--filtered-cells", "3", "--out", str(tmp_path)])
    speeds = pd.read_csv(tmp_path / "filters.csv")
    assert len(speeds) == 2 and (speeds > 0).all(axis=None) and "batch of 3 cells" in speeds
    shown = capsys.readouterr().out
    assert "| progpy, unscented Kalman filter" in shown and "1.00 (1.00 to 1.00)" in shown
