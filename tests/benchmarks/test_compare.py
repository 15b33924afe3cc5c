"""The comparison runs end to end, and an interrupted run goes on where it was."""

import json

import numpy as np
import pandas as pd
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import compare

pytest.importorskip("rl_zoo3")

ENV_ID = "BatteryRo-v0"
CONFIG = """
BatteryRo-v0:
  policy: 'MlpPolicy'
  n_timesteps: 400
  n_envs: 4
  learning_starts: 40
  batch_size: 16
  buffer_size: 1000
  policy_kwargs: "dict(net_arch=[8])"
"""


def patch_held_out_trajectories(monkeypatch):
    data = compare.held_out_trajectories(ENV_ID)
    shortest = data.subset(np.argsort(data.samples)[:6])
    monkeypatch.setattr(compare, "held_out_trajectories", lambda env_id: shortest)


@pytest.fixture(autouse=True)
def small(tmp_path, monkeypatch):
    """Tiny networks, and few test trajectories."""
    (tmp_path / "zoo_configs").mkdir()
    for algo in ("lac", "sac", "td3"):
        (tmp_path / "zoo_configs" / f"{algo}.yml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    patch_held_out_trajectories(monkeypatch)
    monkeypatch.setattr(compare, "_EVALUATION_EPISODES", 2)


def test_a_comparison_writes_table_figures_and_logs(tmp_path, capsys):
    command = ["--envs", ENV_ID, "--timesteps", "400", "--evaluations", "2", "--jobs", "1", "--out", "out"]
    compare.main(command)
    out = tmp_path / "out"
    table = pd.read_csv(out / "compare.csv")
    assert list(table["algo"]) == ["lac", "sac", "td3", "closed form"]
    assert set(table["parameter"]) == {"r_o"}
    assert (table["timesteps"][:3] == 400).all() and table["mape_percent"].iloc[3] < 1e-9
    assert "| BatteryRo-v0  | r_o         | LAC " in capsys.readouterr().out
    for name in ("inferred.png", "inferred.csv", "learning.png", "learning.csv", "learning.json"):
        assert (out / f"{ENV_ID}_{name}").stat().st_size > 0
    record = json.loads((out / "compare.json").read_text())
    assert record["configuration"]["timesteps"] == 400 and "torch" in record["versions"]
    logs = {path.parent.name for path in (out / "tensorboard" / ENV_ID).rglob("events*")}
    assert logs == {"LAC_seed0", "SAC_seed0", "TD3_seed0"}
    assert not (out / ENV_ID / "lac_seed0" / "checkpoint").exists()

    # a second time nothing is trained again, and another number of steps is refused
    before = (out / ENV_ID / "lac_seed0" / "summary.json").stat().st_mtime_ns
    compare.main(command)
    assert (out / ENV_ID / "lac_seed0" / "summary.json").stat().st_mtime_ns == before
    with pytest.raises(ValueError, match="holds a run of 400 steps, not 800"):
        compare.run("lac", ENV_ID, 0, 800, 2, out)


def test_an_interrupted_run_goes_on_from_its_checkpoint(tmp_path, monkeypatch):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 240:
                raise KeyboardInterrupt
            return True

    started_at = []

    class Progress(compare.ProgressCallback):
        def _on_training_start(self):
            started_at.append(self.num_timesteps)
            super()._on_training_start()

    monkeypatch.setattr(compare, "EvalCallback", lambda *args, **kwargs: Interrupt())
    monkeypatch.setattr(compare, "ProgressCallback", Progress)
    with pytest.raises(KeyboardInterrupt):
        compare.run("lac", ENV_ID, 0, 400, 4, tmp_path)
    folder = tmp_path / ENV_ID / "lac_seed0"
    assert (folder / "checkpoint" / "model.zip").exists() and not (folder / "summary.json").exists()

    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "ProgressCallback", Progress)
    patch_held_out_trajectories(monkeypatch)
    compare.run("lac", ENV_ID, 0, 400, 4, tmp_path)
    assert started_at == [0, 200]
    assert list(pd.read_csv(folder / "calibration.csv")["timesteps"]) == [100, 200, 300, 400]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["timesteps"] == 400 and summary["updates"] > 0


def test_a_checkpoint_that_was_set_aside_is_put_back(tmp_path):
    folder, old = tmp_path / "checkpoint", tmp_path / "checkpoint.old"
    old.mkdir()
    (old / "model.zip").write_text("previous")
    compare.CheckpointCallback.recover(folder)
    assert (folder / "model.zip").read_text() == "previous" and not old.exists()
    old.mkdir()
    compare.CheckpointCallback.recover(folder)
    assert (folder / "model.zip").read_text() == "previous"


def test_nonsense_on_the_command_line_is_refused(capsys):
    for command in (["--algos", "ppo"], ["--timesteps", "0"], ["--jobs", "0"]):
        with pytest.raises(SystemExit):
            compare.main(command)
    assert "must be at least 1" in capsys.readouterr().err
