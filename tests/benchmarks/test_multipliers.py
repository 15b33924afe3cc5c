"""Each combination is trained as asked, and what came out is in the table, the figure and the report."""

import json

import pandas as pd
import pytest

from benchmarks import multipliers
from sb3_lac import LAC

ENV_ID = "LinearCost-v0"


@pytest.fixture(autouse=True)
def trained(monkeypatch):
    """Policies that are not trained; returns what was asked to be trained."""
    calls = []

    def train_or_load(algo, env_id, seed, timesteps, folder, hyperparameters):
        calls.append((algo, env_id, seed, timesteps, folder, hyperparameters))
        return LAC(
            "MlpPolicy", env_id, seed=seed, device="cpu", buffer_size=10, policy_kwargs={"net_arch": [8]}, **hyperparameters
        )

    monkeypatch.setattr(multipliers, "train_or_load", train_or_load)
    monkeypatch.setattr(multipliers, "_EPISODES", 2)
    return calls


def made(alpha3, lambda_max, seed, models):
    (row,) = multipliers.part(ENV_ID, alpha3, lambda_max, seed, 50, models)["multipliers"].to_dict("records")
    return row


def test_a_run_trains_with_its_combination(tmp_path, trained):
    row = made(0.3, 4.0, 7, tmp_path)
    ((algo, env_id, seed, timesteps, folder, hyperparameters),) = trained
    assert (algo, env_id, seed, timesteps) == ("lac", ENV_ID, 7, 50)
    assert hyperparameters == {
        "alpha3": 0.3,
        "lambda_min": 4e-4,
        "lambda_max": 4.0,
        "lambda_init": 4.0,
    }
    assert (row["env"], row["alpha3"], row["lambda_max"], row["seed"]) == (ENV_ID, 0.3, 4.0, 7)
    # nothing was learned: lambda is where it started, and nobody dies here
    assert row["lambda"] == pytest.approx(4.0) and row["ent_coef"] == pytest.approx(1.0)
    assert row["death_rate"] == 0 and row["cost"] > 0
    # no two combinations share a folder
    folders = {folder}
    for arguments in ((0.1, 4.0, 7), (0.3, 1.0, 7), (0.3, 4.0, 8)):
        made(*arguments, tmp_path)
        folders.add(trained[-1][4])
    assert len(folders) == 4


def test_the_mean_action_is_judged(tmp_path, monkeypatch):
    judged = []
    evaluate_lyapunov = multipliers.evaluate_lyapunov
    monkeypatch.setattr(
        multipliers, "evaluate_lyapunov", lambda *args, **kwargs: judged.append(kwargs) or evaluate_lyapunov(*args, **kwargs)
    )
    made(0.3, 1.0, 0, tmp_path)
    assert judged[0]["deterministic"] is True


def test_the_same_run_has_the_same_result(tmp_path):
    assert made(0.3, 1.0, 0, tmp_path) == made(0.3, 1.0, 0, tmp_path)


def test_table_figure_and_report_are_written(tmp_path, trained, capsys):
    command = ["--envs", ENV_ID, "--alpha3", "0.1", "1.0", "--lambda-max", "2.0", "--seeds", "0", "1", "--jobs", "1"]
    multipliers.main([*command, "--out", str(tmp_path)])
    assert len(trained) == 4
    table = pd.read_csv(tmp_path / "multipliers.csv")
    assert table[["alpha3", "lambda_max", "seed"]].to_numpy().tolist() == [[0.1, 2, 0], [1, 2, 0], [0.1, 2, 1], [1, 2, 1]]
    record = json.loads((tmp_path / "multipliers.json").read_text())
    assert record["configuration"]["timesteps"] == multipliers._TIMESTEPS and record["configuration"]["alpha3"] == [0.1, 1.0]
    assert (tmp_path / "multipliers.png").stat().st_size > 0
    text = (tmp_path / "multipliers.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and text.count(ENV_ID) == 2


def test_report_has_means_with_intervals_over_seeds():
    results = pd.DataFrame(
        {"env": ENV_ID, "alpha3": 0.1, "lambda_max": 1.0, "seed": [0, 1, 2], "cost": [1.0, 9.0, 2.0], "death_rate": 0.0}
        | {"lambda": [0.25, 0.5, 0.75], "ent_coef": 0.1, "decrease": -3.0, "condition_holds": [True, False, True]}
        | {"largest_feasible_alpha3": [0.1, 0.125, 0.15]}
    )
    _, _, line = multipliers.report(results).strip().splitlines()
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    # the means of three draws of three lie between three times the least and three times the largest
    assert cells == [
        ENV_ID, "0.1", "1", "4 [1, 9]", "0", "0.5", "5", "0.125 [0.1, 0.15]", "2 of 3",
    ]  # fmt: skip


def test_figure_has_one_column_per_environment():
    results = pd.DataFrame(
        [
            {"env": env_id, "alpha3": alpha3, "lambda_max": lambda_max, "seed": seed, "cost": 1.0 + seed, "lambda": lambda_max}
            for env_id in ("LinearCost-v0", "Oscillator-v0")
            for alpha3 in (0.1, 1.0)
            for lambda_max in (0.1, 10.0)
            for seed in (0, 1)
        ]
    )
    figure = multipliers.plot(results)
    assert [axes.get_title() for axes in figure.axes] == ["LinearCost-v0", "Oscillator-v0", "", ""]
    container = figure.axes[0].containers[0]
    assert container.lines[0].get_xydata().tolist() == [[0.1, 1.5], [1.0, 1.5]]
    assert container.get_label() == "lambda_max = 0.1"
    segments = container.lines[2][0].get_segments()
    assert segments[0][:, 1].tolist() == [1.0, 2.0]
    # lambda, relative to its limit
    assert figure.axes[2].get_lines()[1].get_ydata().tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    "command", [["--envs", "Pendulum-v1"], ["--alpha3", "0.5", "0"], ["--lambda-max", "-1"], ["--jobs", "0"]]
)
def test_nonsense_on_the_command_line_is_refused(command, trained):
    with pytest.raises(SystemExit):
        multipliers.main(command)
    assert not trained
