"""The comparison runs end to end, an interrupted run goes on where it was, and each result is named by what made it."""

import json
import re
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from battery_env import ClosedForm, evaluate
from benchmarks import compare, contests, runs
from benchmarks.runs import Run, made_by, record_file
from benchmarks.study import table_file, write_json
from benchmarks.zoo_runs import zoo_run
from sb3_lac import LAC
from tests.sweeps import sweep

ENV_ID = "BatteryRo-v0"
ROOT = Path(__file__).parents[2]
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


@pytest.fixture(autouse=True)
def small(tmp_path, monkeypatch):
    """Tiny networks, and few test trajectories."""
    (tmp_path / "zoo_configs").mkdir()
    for algo in ("lac", "sac", "td3"):
        (tmp_path / "zoo_configs" / f"{algo}.yml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    held_out = contests.held_out_trajectories

    def shortest(env_id):
        data = held_out(env_id)
        return data.subset(np.argsort(data.samples)[:6])

    monkeypatch.setattr(contests, "held_out_trajectories", shortest)
    for module in (compare, contests):
        monkeypatch.setattr(module, "EVALUATION_EPISODES", 2)
    monkeypatch.setattr(contests, "_SCORED_EPISODES", 3)
    monkeypatch.setattr(contests, "_VOLTAGE_TRAJECTORIES", 2)
    monkeypatch.setattr(contests, "_BRIEF_VOLTAGE_TRAJECTORIES", 1)


def run_of(algo="lac", timesteps=400, **others):
    return zoo_run(algo, ENV_ID, 0, timesteps, **others)


def command(*others):
    return ["--envs", ENV_ID, "--evaluations", "2", "--jobs", "1", "--out", "out", *others]


@pytest.mark.attacks
def test_a_comparison_writes_table_figures_and_logs(tmp_path, capsys):
    compare.main(command())
    out = tmp_path / "out"
    table = pd.read_csv(out / "compare.csv")
    assert list(table["algo"]) == ["lac", "sac", "td3", "closed form"]
    assert set(table["parameter"]) == {"r_o"}
    # as many steps as zoo_configs says
    assert (table["timesteps"][:3] == 400).all() and table["mape_percent"].iloc[3] < 1e-9
    assert (table["resumed"][:3] == 0).all()
    shown = capsys.readouterr().out
    assert re.search(rf"\| BatteryRo-v0 +\| r_o +\| LAC +\| {run_of().digest} +\| 400 +\| 1 ", shown)
    assert "Interrupted" not in shown
    for name in ("inferred.png", "inferred.csv", "scores.csv", "learning.png", "learning.csv", "learning.json"):
        assert (out / f"{ENV_ID}_{name}").stat().st_size > 0
    scores = pd.read_csv(out / f"{ENV_ID}_scores.csv")
    assert (scores["start_off_r_o_mape_percent"] != scores["r_o_mape_percent"]).all()
    logs = {path.parent.name for path in (out / "tensorboard" / ENV_ID).rglob("events*")}
    assert logs == {f"{algo.upper()}_seed0_{run_of(algo).digest}" for algo in ("lac", "sac", "td3")}
    assert {path.name for path in (out / ENV_ID).iterdir()} == {run_of(algo).name for algo in ("lac", "sac", "td3")}
    assert not list(out.rglob("checkpoint*"))

    for log in (out / "tensorboard" / ENV_ID).iterdir():
        tags = EventAccumulator(str(log)).Reload().Tags()
        of_lac = {"lyapunov/report"} if log.name.startswith("LAC") else set()
        assert set(tags["images"]) == {"calibration/r_o_inferred"} | of_lac
        assert "custom_scalars__config__" in tags["tensors"] and "eval/mean_reward" in tags["scalars"]

    record = json.loads((out / "compare.json").read_text())
    made_by = record["configuration"]["recipes"][run_of("sac").digest]
    assert (made_by["kind"], made_by["task"], made_by["timesteps"]) == ("stable_baselines3:SAC", ENV_ID, 400)
    assert made_by["settings"]["batch_size"] == 16 and made_by["defaults"]["tau"] == 0.005
    (run,) = made_by["runs"]
    assert (run["seed"], run["resumed"]) == (0, 0) and {"torch", "sb3_lac"} <= set(run["versions"])


@pytest.fixture
def finished(monkeypatch):
    """Runs that only leave what a training would have left."""
    trained = []

    def part(algo, source, run, out, evaluations):
        chosen = Run(**run)
        trained.append(chosen)
        record = {"run": run, "defaults": {}, "versions": {"torch": "2"}, "resumed": 2 * chosen.seed, "updates": 3}
        record |= {"timesteps": chosen.timesteps, "training_minutes": 0.5}
        write_json(record_file(chosen, out / chosen.task / chosen.name), record)
        scores = evaluate(ClosedForm(), contests.held_out_trajectories(chosen.task))
        scores["start_off_r_o_mape_percent"] = scores["r_o_mape_percent"]
        history = {"timesteps": [chosen.timesteps], "mape_percent": [1.0], "mape_percent_worst": [2.0]}
        return {"scores": scores, "learning": pd.DataFrame(history)}

    monkeypatch.setattr(compare, "part", part)
    # drawn by another test
    for name in ("plot_true_against_inferred", "plot_learning_curves", "save_figure"):
        monkeypatch.setattr(contests, name, lambda *args: None)
    return trained


def test_a_finished_run_stands_for_its_own_recipe_only(tmp_path, finished, capsys):
    compare.main(command("--algos", "lac"))
    compare.main(command("--algos", "lac"))
    assert len(finished) == 1
    before = run_of().digest
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG.replace("batch_size: 16", "batch_size: 32"))
    differing = ["--hyperparams", "lac.n_envs:2", "n_envs:1", "learning_rate:1e-3", f"{ENV_ID}.learning_rate:lin_1e-3"]
    for changed in ([], differing, ["--timesteps", "500"], ["--defaults", "--timesteps", "300"], ["--evaluations", "1"]):
        compare.main([*command("--algos", "lac"), *changed])
    # how often a policy is evaluated meanwhile makes no other one
    assert len(finished) == 5
    expected = {**finished[1].settings, "learning_rate": "lin_1e-3", "n_envs": 2}
    assert expected == finished[2].settings
    table = pd.read_csv(tmp_path / "out" / "compare.csv", dtype={"recipe": str})[:-1]
    assert table["recipe"].is_unique and before in set(table["recipe"])
    assert sorted(table["timesteps"]) == [300, 400, 400, 400, 500]
    assert list(table["hyperparameters"]) == ["zoo_configs"] * 4 + ["defaults"]
    recipes = json.loads((tmp_path / "out" / "compare.json").read_text())["configuration"]["recipes"]
    assert [recipes[digest]["timesteps"] for digest in table["recipe"]] == list(table["timesteps"])
    assert recipes[before]["settings"]["batch_size"] == 16
    assert recipes[run_of().digest]["settings"]["batch_size"] == 32
    # in tables and figures each has a name of its own
    names = set(pd.read_csv(tmp_path / "out" / f"{ENV_ID}_learning.csv")["algo"])
    assert names == {"LAC defaults", *(f"LAC {digest}" for digest in table["recipe"][:4])}
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)


def test_seeds_are_one_row_and_continued_runs_are_named(tmp_path, finished, capsys):
    compare.main(command("--algos", "lac", "sac", "lac", "--seeds", "0", "1", "1"))
    # two seeds of two algorithms
    assert len(finished) == 4
    shown = capsys.readouterr().out
    assert re.search(r"\| LAC +\| \w{8} +\| 400 +\| 2 ", shown)
    assert "- LAC on BatteryRo-v0, seed 1: 2 times\n- SAC on BatteryRo-v0, seed 1: 2 times\n" in shown
    assert (tmp_path / "out" / "compare.md").read_text(encoding="utf-8") in shown
    assert list(pd.read_csv(tmp_path / "out" / "compare.csv")["resumed"][:4]) == [0, 2, 0, 2]
    # errors of all discharges of all seeds
    errors = pd.read_csv(tmp_path / "out" / f"{ENV_ID}_scores.csv")
    errors = errors[errors["seed"].notna()]
    assert errors.groupby(["calibrator", "seed"]).size().to_dict() == {
        (who, seed): 6 for who in ("LAC", "SAC") for seed in (0, 1)
    }


def part(run, out, evaluations):
    return compare.part(run.algorithm, "zoo_configs", asdict(run), out, evaluations)


@pytest.mark.parametrize("algo", sweep(LAC, TD3))
def test_defaults_are_the_line_as_typed(algo, tmp_path, monkeypatch):
    captured = []
    monkeypatch.setattr(
        contests, "evaluate", lambda estimator, data: captured.append(estimator.policy) or evaluate(estimator, data)
    )
    chosen = run_of(algo.__name__.lower(), timesteps=110, defaults=True)
    assert chosen.algorithm == f"{algo.__name__} defaults"
    part(chosen, tmp_path, 1)
    typed = algo("MlpPolicy", ENV_ID, seed=0, device="cpu").learn(110)
    assert typed._n_updates == captured[-1]._n_updates == 10
    for ours, expected in zip(captured[-1].policy.parameters(), typed.policy.parameters(), strict=True):
        assert th.equal(ours, expected)


@pytest.mark.attacks
def test_an_interrupted_run_goes_on_from_its_checkpoint_and_says_so(tmp_path, monkeypatch):
    started_at = []

    class Interrupt(BaseCallback):
        def __init__(self, at):
            super().__init__()
            self.at = at

        def _on_training_start(self):
            started_at.append(self.num_timesteps)

        def _on_step(self):
            if self.num_timesteps == self.at:
                raise KeyboardInterrupt
            return True

    monkeypatch.setattr(runs, "CHECKPOINT_EVERY_S", 0.0)
    chosen = run_of()
    folder = tmp_path / ENV_ID / chosen.name
    # what is lost is what came after the last roll-out
    for at in (4, 240, 340, None):
        with monkeypatch.context() as patch:
            patch.setattr(compare, "EvalCallback", lambda *args, at=at, **kwargs: Interrupt(at))
            with nullcontext() if at is None else pytest.raises(KeyboardInterrupt):
                found = part(chosen, tmp_path, 4)
        assert record_file(chosen, folder).exists() == (at is None)
    assert started_at == [0, 0, 236, 336]
    assert list(found["learning"]["timesteps"]) == [100, 200, 300, 400]
    record = made_by(chosen, folder)
    assert record["timesteps"] == 400 and record["updates"] > 0 and record["training_minutes"] > 0
    assert record["resumed"] == 3 and Run(**record["run"]) == chosen


VOLTAGE_CONFIG = """
BatteryVoltageJoint-v0: {policy: MlpPolicy, n_timesteps: 96, n_envs: 16, learning_starts: 32, batch_size: 16, buffer_size: 200}
"""


@pytest.mark.attacks
def test_voltage_only_tasks_are_compared_under_sensors_beside_their_peers(tmp_path, capsys):
    for algo in ("lac", "sac"):
        (tmp_path / "zoo_configs" / f"{algo}.yml").write_text(VOLTAGE_CONFIG)
    chosen = ["--envs", "BatteryVoltageJoint-v0", "--algos", "lac", "sac", "--evaluations", "1", "--jobs", "1", "--out", "out"]
    compare.main(chosen)
    out = tmp_path / "out"
    table = pd.read_csv(out / "BatteryVoltageJoint-v0.csv")
    calibrators = ["LAC", "SAC", "least squares", "Kalman filter"]
    assert table["sensor"].tolist() == [sensor for sensor in contests.SENSORS for _ in calibrators]
    assert table["calibrator"].tolist() == 2 * calibrators
    assert table["training_minutes"].notna().tolist() == 2 * [True, True, False, False]
    # untrained policies are bad, least squares are good, and the noisy sensor makes them worse
    least_squares = table[table["calibrator"] == "least squares"].set_index("sensor")["r_o_second_half_percent"]
    assert (least_squares < table.loc[table["calibrator"] == "LAC", "r_o_second_half_percent"].min()).all()
    assert least_squares.iloc[1] > least_squares.iloc[0]
    assert re.search(r"\| BatteryVoltageJoint-v0 +\| 5 mV noise +\| LAC ", capsys.readouterr().out)
    published = table_file(ROOT / "docs" / "results" / "voltage", "BatteryVoltageJoint-v0_scores")
    assert set(pd.read_csv(out / "BatteryVoltageJoint-v0_scores.csv")) <= set(pd.read_csv(published, nrows=1))
    assert len(pd.read_csv(out / "BatteryVoltageJoint-v0_r_o_learning.csv")) == 2
    assert json.loads((out / "BatteryVoltageJoint-v0.json").read_text())["configuration"]["recipes"]
    for figure in ("", "_r_o_learning"):
        assert (out / f"BatteryVoltageJoint-v0{figure}.png").stat().st_size > 0
    times = {path: path.stat().st_mtime_ns for path in [*out.rglob("model_*.zip"), *out.rglob("parts/*")]}
    assert len(times) == 6
    compare.main(chosen)
    assert {path: path.stat().st_mtime_ns for path in times} == times


@pytest.mark.attacks
def test_algorithms_of_the_zoo_and_ones_own_are_compared_in_any_environment(tmp_path, capsys, monkeypatch):
    pages = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("own_problem.md", "own_algorithm.md")]
    environment, algorithm = (re.search(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)[1] for page in pages)
    (tmp_path / "tank.py").write_text(environment + algorithm)
    monkeypatch.syspath_prepend(str(tmp_path))
    common = "--envs tank:Tank-v0 --defaults --timesteps 132 --evaluations 2 --jobs 1 --out out".split()
    compare.main(["--algos", "tqc", *common])
    compare.main(["--algos", "a2c", "tank:AnnealedSAC", *common])
    table = pd.read_csv(tmp_path / "out" / "Tank-v0.csv").set_index("algo")
    assert set(table.index) == {"a2c", "tank:AnnealedSAC", "tqc"} and (table["length"] == 100.0).all()
    assert (0.0 < table["cost"]).all() and (table["cost"] < table["cost_worst"]).all()
    # A2C makes five at a time
    assert table["timesteps"].to_dict() == {"a2c": 135, "tank:AnnealedSAC": 132, "tqc": 132}
    curves = pd.read_csv(tmp_path / "out" / "Tank-v0_learning.csv")
    assert set(curves["algo"]) == {"A2C defaults", "AnnealedSAC defaults", "TQC defaults"}
    assert (tmp_path / "out" / "Tank-v0_learning.png").stat().st_size > 0
    assert re.search(r"\| Tank-v0 +\| TQC defaults +\|", capsys.readouterr().out)


# The RL Zoo leaves the files of its monitors open where a model is refused
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--algos", "lack"], "lack is no algorithm; choose from"),
        (["--algos", "no_such_module:Mine"], "No module named 'no_such_module'"),
        (["--algos", "benchmarks.runs:Mine"], "has no attribute 'Mine'"),
        (["--algos", "benchmarks.runs:Run"], "must be a subclass of Stable-Baselines3's BaseAlgorithm"),
        (["--algos", "dqn", "--defaults"], "DQN defaults on BatteryRo-v0: The algorithm only supports"),
        (["--algos", "recurrent_ppo", "--defaults"], "policies with a memory cannot be scored here"),
        (["--algos", "tqc"], "tqc.yml"),
        (["--envs", "BatteryR-v0"], "Environment `BatteryR` doesn't exist"),
        (["--envs", "no_such_module:Mine-v0"], "no_such_module:Mine-v0 is no environment: No module named"),
        (["--envs", "BatteryQmax-v0"], "lac.yml has no entry for BatteryQmax-v0"),
        (["--seeds", str(2**32)], "a seed must lie within 0 .. 2**32 - 1, got 4294967296"),
        (["--hyperparams", "n_envs=1"], "--hyperparams takes NAME:VALUE, like n_envs:1, got n_envs=1"),
        (["--hyperparams", "tqc.n_envs:1"], "--hyperparams has some of tqc, which is not compared"),
        (["--hyperparams", "n_env:1"], "LAC on BatteryRo-v0: LAC.__init__() got an unexpected keyword argument 'n_env'"),
        (["--hyperparams", "gamma:2"], "LAC on BatteryRo-v0: gamma=2.0 must lie within 0 .. 1"),
        (["--timesteps", "40"], "starts to learn after 40 steps (learning_starts): timesteps=40 must be more"),
    ],
)
def test_nonsense_on_the_command_line_is_refused_before_any_training(wrong, message, capsys, finished):
    with pytest.raises(SystemExit):
        compare.main([*command(), *wrong])
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("python -m benchmarks.compare: error: ") and message in last
    assert finished == []


def test_one_that_fails_costs_the_others_no_table(tmp_path, finished, monkeypatch):
    finish = compare.part

    def part(algo, source, run, out, evaluations):
        if algo == "sac":
            raise ZeroDivisionError
        return finish(algo, source, run, out, evaluations)

    monkeypatch.setattr(compare, "part", part)
    with pytest.raises(ZeroDivisionError):
        compare.main(command("--algos", "sac"))
    assert not (tmp_path / "out" / "compare.csv").exists()
    with pytest.raises(ZeroDivisionError):
        compare.main(command("--algos", "sac", "td3"))
    assert list(pd.read_csv(tmp_path / "out" / "compare.csv")["algo"]) == ["td3", "closed form"]
