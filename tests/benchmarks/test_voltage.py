"""The comparison on voltage-only tasks runs end to end."""

import json

import pandas as pd
import pytest

from benchmarks import voltage

pytest.importorskip("rl_zoo3")

CONFIG = """
BatteryVoltageRo-v0:
  policy: 'MlpPolicy'
  n_timesteps: 96
  n_envs: 16
  learning_starts: 32
  batch_size: 16
  buffer_size: 200
  policy_kwargs: "dict(net_arch=[8])"
"""


@pytest.fixture(autouse=True)
def small(tmp_path, monkeypatch):
    """Tiny networks."""
    (tmp_path / "zoo_configs").mkdir()
    for algo in ("lac", "sac", "td3"):
        (tmp_path / "zoo_configs" / f"{algo}.yml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)


COMMAND = ["--env", "BatteryVoltageRo-v0", "--seeds", "0", "--discharges", "2", "--jobs", "1", "--out", "out"]


@pytest.mark.slow
def test_a_comparison_writes_table_and_figure(tmp_path, capsys):
    voltage.main(COMMAND)
    out = tmp_path / "out"
    table = pd.read_csv(out / "BatteryVoltageRo-v0.csv")
    calibrators = ["LAC", "SAC", "TD3", *voltage.peers("BatteryVoltageRo-v0")]
    assert sorted(zip(table["sensor"], table["calibrator"], strict=True)) == sorted(
        (sensor, calibrator) for sensor in voltage.SENSORS for calibrator in calibrators
    )
    assert table["training_minutes"].notna().tolist() == table["calibrator"].isin(["LAC", "SAC", "TD3"]).tolist()
    # untrained policies are bad, least squares are good, and the noisy sensor makes them worse
    least_squares = table[table["calibrator"] == "least squares"].set_index("sensor")["r_o_second_half_percent"]
    assert (least_squares < table.loc[table["calibrator"] == "LAC", "r_o_second_half_percent"].min()).all()
    assert least_squares.iloc[1] > least_squares.iloc[0]
    assert "| LAC " in capsys.readouterr().out
    scores = pd.read_csv(out / "BatteryVoltageRo-v0_scores.csv")
    assert len(scores) == 2 * 2 * 5
    record = json.loads((out / "BatteryVoltageRo-v0.json").read_text())
    assert record["configuration"]["seeds"] == [0] and "torch" in record["versions"]
    assert (out / "BatteryVoltageRo-v0.png").stat().st_size > 0

    models = {path: path.stat().st_mtime_ns for path in out.rglob("model_*.zip")}
    assert len(models) == 3
    voltage.main(COMMAND)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("model_*.zip")} == models


@pytest.mark.parametrize("extra", [["--discharges", "0"], ["--timesteps", "0"], ["--jobs", "0"]])
def test_bad_numbers_are_refused(extra, capsys):
    with pytest.raises(SystemExit):
        voltage.main([*COMMAND, *extra])
    assert "--discharges within 1 .. 300" in capsys.readouterr().err


def test_an_unknown_algorithm_is_refused_before_any_training(tmp_path, capsys):
    with pytest.raises(SystemExit):
        voltage.main([*COMMAND, "--algos", "lac", "lack"])
    assert "error: lack is no off-policy algorithm of the RL Zoo" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
