"""The command judges controllers and models alike, and its tables say what it found."""

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from benchmarks import certificate
from benchmarks.controllers import controllers
from sb3_lac.envs import LinearCostEnv
from sb3_lac.stability import fitting


@pytest.fixture
def quick(monkeypatch, train_nothing):
    """One controller instead of all, few passes over the data, and a model that is not trained; returns what was asked for."""
    asked = train_nothing(certificate)
    monkeypatch.setattr(fitting, "N_ITERATIONS", 3)
    reference = {"reference": controllers("LinearCost-v0")["reference"]}
    monkeypatch.setattr(certificate, "controllers", lambda env_id: reference)
    return asked


def test_tables_and_figures_are_written(tmp_path, quick, capsys):
    command = ["--envs", "LinearCost-v0", "--algos", "lac", "--seeds", "3", "--fractions", "0.1", "--episodes", "25"]
    certificate.main([*command, "--out", str(tmp_path)])
    # A tenth of the updates that follow the first thousand steps
    assert quick == [("lac", "LinearCost-v0", 3, 1900)]
    table = pd.read_csv(tmp_path / "certificates.csv")
    assert table["policy"].tolist() == ["reference"] + 2 * ["LAC, 10 % of the updates"]
    assert table["function"].tolist() == ["fitted", "fitted", "critic"]
    # Statements are made once for each policy
    assert table["survives_at_least"].notna().tolist() == [True, True, False]
    assert (table["cost_bound_low"] <= table["cost_bound"]).all() and table["start_cost"].gt(0).all()
    assert len(list(tmp_path.glob("*_statements.png"))) == 2 and len(list(tmp_path.glob("*_drift.png"))) == 3
    assert (tmp_path / "certificates.png").stat().st_size > 0
    text = (tmp_path / "certificates.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "| LAC, 10 % of the updates (critic)" in text and "nan" not in text


def test_longer_trainings_than_asked_for_are_cut_and_shorter_ones_are_not(tmp_path, quick):
    command = ["--envs", "LinearCost-v0", "--algos", "lac", "--seeds", "3", "--episodes", "25", "--out", str(tmp_path)]
    for timesteps in ("5000", "50000"):
        certificate.main([*command, "--timesteps", timesteps])
    assert [call[-1] for call in quick] == [5000, 10000]


def test_several_seeds_are_shown_from_least_to_most():
    rows = [
        {"env": "LinearCost-v0", "policy": "LAC", "seed": seed, "function": "fitted", "holds": seed > 0, "settles": False}
        | {"start_cost": 2.0, "cost_bound": bound, "cost_bound_low": bound / 2, "cost_bound_high": 2 * bound}
        | {"cost_bound_alpha3": alpha3, "largest_feasible_alpha3": 0.5, "survives_at_least": 0.9}
        | {"stays_within_at_least": np.nan, "decreases_at_least": 0.1 * seed}
        for seed, bound, alpha3 in ((0, 3.0, np.nan), (1, 1.0, 0.25), (2, 1.5, 0.75))
    ]
    of_seeds = certificate.report(pd.DataFrame(rows)).splitlines()[-1]
    cells = [cell.strip() for cell in of_seeds.strip("|").split("|")]
    assert cells[:4] == ["LAC", "2 of 3", "0 of 3", "2"]
    assert cells[4:7] == ["1.5 (1 to 3)", "0.5 (0.25 to 0.75), of 2", "0.5"]
    assert cells[7:] == ["0.9", "-", "0.1 (0 to 0.2)"]
    (single,) = [line for line in certificate.report(pd.DataFrame(rows[1:2])).splitlines() if "LAC" in line]
    assert "| 1 [0.5, 2] " in single


def test_slow_loops_and_short_horizons_leave_little_of_a_discounted_cost():
    table = certificate.feasible_alpha3().set_index("controller")
    assert table.index.tolist() == ["reference", "weak"]
    columns = ["discount 0.6", "discount 0.9", "discount 0.95", "discount 0.99", "average cost"]
    shares = table[columns].map(lambda cell: float(cell.split()[0]))
    np.testing.assert_allclose(shares.loc["reference"], [0.14, 0.60, 0.78, 0.95, 1.0], atol=0.005)
    assert (shares.loc["weak"] <= shares.loc["reference"]).all() and (np.diff(shares, axis=1) > 0).all()


def test_exact_function_decreases_by_that_share_and_by_no_more():
    env, gamma = LinearCostEnv(), 0.9
    gain = env.optimal_gain(gamma)
    p, closed_loop = env.value_matrix(gain, gamma), env.A - env.B @ gain
    share = float(certificate.feasible_alpha3().set_index("controller").loc["reference", "discount 0.9"].split()[0])
    states = np.random.default_rng(0).normal(size=(10_000, 2))
    costs = np.einsum("ni,ij,nj->n", states, env.Q + gain.T @ env.R @ gain, states)
    drift = np.einsum("ni,ij,nj->n", states, closed_loop.T @ p @ closed_loop - p, states)
    assert (-drift / costs).min() == pytest.approx(share, abs=0.006)


@pytest.mark.parametrize(
    "command",
    [
        ["--algos", "llac"],
        ["--models", "model.zip"],
        ["--models", "lac=/no/model.zip"],
        ["--seeds", "-1"],
        ["--episodes", "1"],
        ["--fractions", "0"],
    ],
)
def test_nonsense_on_the_command_line_is_refused(command, quick):
    with pytest.raises(SystemExit):
        certificate.main(command)
    assert not quick
