"""No training is lost: what is done is a row, what is in progress goes on, and nothing but what was run tells rows apart."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from benchmarks import runs
from benchmarks.runs import Rows, Run, Trainer
from sb3_lac.zoo import RL_ZOO_CONFIGS

ROOT = Path(__file__).parents[2]
SETTINGS = {"learning_starts": 10, "batch_size": 4, "policy_kwargs": "dict(net_arch=[4], activation_fn=nn.Tanh)"}
RUN = Run("LinearCost-v0", "lac", "sb3_lac:LAC", 3, 60, SETTINGS)


def steps_so_far(model, task):
    return float(model.num_timesteps)


@pytest.fixture
def trainer(tmp_path):
    return Trainer(tmp_path / "rows", tmp_path / "checkpoints", steps_so_far)


def rows_of(trainer):
    return Rows(trainer.folder).read()


def test_a_training_is_done_once_and_its_row_says_what_was_run(trainer):
    trainer(RUN)
    written = (trainer.folder / "runs.csv").read_text()
    trainer(RUN)
    assert (trainer.folder / "runs.csv").read_text() == written
    (row,) = rows_of(trainer).to_dict("records")
    assert [row[name] for name in ("task", "algorithm", "seed", "timesteps")] == ["LinearCost-v0", "lac", 3, 60]
    assert row["package"].startswith("sb3_lac 0.") and "dev" not in row["package"] and "net_arch" in row["configuration"]
    assert [row[f"after_{percent}_percent"] for percent in range(10, 101, 10)] == list(range(6, 61, 6))
    assert row["resumed"] == 0 and row["minutes"] > 0 and "torch" in row["versions"]
    assert not list(trainer.checkpoints.glob("*.zip"))
    for other in (replace(RUN, seed=4), replace(RUN, timesteps=61), replace(RUN, settings={**SETTINGS, "tau": 0.1})):
        assert not Rows(trainer.folder).has(other) and other.name != RUN.name
    assert not Rows(trainer.folder).has(replace(RUN, environment={"noise_std": 0.0}))


def test_a_class_is_known_by_its_release_and_not_by_its_files():
    key = replace(RUN, kind="stable_baselines3:SAC").key
    assert key["package"].startswith("stable_baselines3 2.") and set(key) == set(runs._KEY)


class Killed(BaseException):
    """The process ends."""


@pytest.mark.parametrize("kind", ["sb3_lac:LAC", "stable_baselines3:SAC"])
@pytest.mark.attacks
def test_a_training_that_was_killed_goes_on_from_its_checkpoint(trainer, monkeypatch, kind):
    monkeypatch.setattr(runs, "CHECKPOINT_EVERY_S", 0.0)
    run, judged = replace(RUN, kind=kind), []

    def judge(model, task):
        judged.append((model.num_timesteps, model.replay_buffer.size(), model._n_updates))
        if len(judged) == 5:
            raise Killed
        return float(model.num_timesteps)

    with pytest.raises(Killed):
        replace(trainer, judge=judge)(run)
    (checkpoint,) = trainer.checkpoints.glob("*.zip")
    assert rows_of(trainer).empty and checkpoint.name == f"checkpoint_{run.name}.zip"
    replace(trainer, judge=judge)(run)
    (row,) = rows_of(trainer).to_dict("records")
    assert row["resumed"] == 1 and not list(trainer.checkpoints.glob("*.zip"))
    # the fifth point is judged anew, and no step, sample or update is left out
    assert judged[4] == judged[5] and [row[f"after_{percent}_percent"] for percent in (10, 40, 50, 100)] == [6, 24, 30, 60]
    assert judged[-1] == (60, 60, 50)


def test_at_the_deadline_a_training_stops_with_a_checkpoint_and_none_begins(trainer, monkeypatch):
    stopping = replace(trainer, deadline=100.0)
    clock = iter([0.0] * 30)
    clocks = SimpleNamespace(time=lambda: next(clock, 200.0), perf_counter=time.perf_counter)
    monkeypatch.setattr(runs, "time", clocks)
    stopping(RUN)
    assert rows_of(trainer).empty and len(list(trainer.checkpoints.glob("*.zip"))) == 1
    stopping(replace(RUN, seed=4))
    assert len(list(trainer.checkpoints.glob("*.zip"))) == 1
    monkeypatch.undo()
    trainer(RUN)
    assert rows_of(trainer)[["seed", "resumed", "after_100_percent"]].to_numpy().tolist() == [[3, 1, 60]]


def test_a_training_that_another_command_is_at_is_left_to_it(trainer):
    trainer.checkpoints.mkdir()
    with runs.FileLock(trainer.checkpoints / f".{RUN.name}.lock"):
        trainer(RUN)
    assert rows_of(trainer).empty


def test_what_is_compiled_and_how_large_the_buffer_is_is_no_part_of_a_run():
    env = RUN.environments()
    model = RUN.model(env, compiled=True)
    assert model.compile_update and model.replay_buffer.buffer_size == 60 and RUN.key == replace(RUN).key
    env.close()


def test_a_run_has_its_name_before_and_after_the_training():
    run = replace(RUN, settings={**SETTINGS, "policy_kwargs": {"net_arch": [4]}})
    name, env = run.name, run.environments()
    run.model(env)
    env.close()
    assert run.name == name and run.settings["policy_kwargs"] == {"net_arch": [4]}


def test_the_setting_of_lac_is_that_of_its_file():
    run = replace(RUN, settings=runs.setting_of_lac(root=4))
    env = run.environments()
    model = run.model(env, compiled=False)
    assert env.num_envs == 4 and (model.gradient_steps, model.learning_starts, model.tau) == (2, 1000, 0.01)
    assert model.policy_kwargs["net_arch"] == [64, 64] and model.lr_schedule(0.5) == pytest.approx(1e-3)
    env.close()


def table(**columns):
    known = {"task": "T", "algorithm": "lac", "timesteps": 10, "package": "sb3_lac 0.6.0", "configuration": "{}"}
    return pd.DataFrame({**known, **columns}, index=range(len(columns["seed"])))


def test_tables_of_two_machines_are_one_and_the_first_row_of_a_training_stays(tmp_path):
    rows = Rows(tmp_path)
    rows.add(table(seed=[1, 2], after_100_percent=[0.1 + 0.2, 2.0]))
    rows.add(table(seed=[2, 3], after_100_percent=[9.0, 3.0], machine="another"))
    together = rows.read()
    assert together["seed"].tolist() == [1, 2, 3] and together["after_100_percent"].tolist() == [0.1 + 0.2, 2.0, 3.0]
    rows.add(table(seed=[1], package="sb3_lac 0.7.0", after_100_percent=[7.0]))
    wanted = [Run("T", "lac", "sb3_lac:LAC", seed, 10) for seed in (3, 1, 4)]
    assert rows.of(wanted)["after_100_percent"].tolist() == [3.0, 7.0]
    assert Rows(tmp_path / "none").of(wanted).empty


@pytest.mark.attacks
def test_rows_can_be_made_without_the_rl_zoo():
    hide = "import sys; sys.modules.update(dict.fromkeys(('rl_zoo3', 'progpy', 'mujoco', 'sb3_contrib')))"
    code = f"{hide}; import benchmarks.outside as o; o.run_of('Pendulum-v1', 'lac_common', 1).key"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_tuned_settings_are_those_of_the_rl_zoo_where_its_budget_is_small():
    from benchmarks.outside import TASKS, TUNED
    from sb3_lac.zoo import yaml

    for algorithm in ("sac", "td3", "tqc"):
        entries = yaml.safe_load((RL_ZOO_CONFIGS / f"{algorithm}.yml").read_text())
        for task in TASKS:
            entry = entries.get(task) or {"n_timesteps": np.inf}
            is_tuned = float(entry.pop("n_timesteps")) <= 50_000
            entry.pop("policy", None)
            assert TUNED.get(task, {}).get(algorithm) == (entry if is_tuned else None)
