"""The command judges controllers and models alike, and its tables say what it found."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from benchmarks import certificate
from benchmarks.controllers import reference_controllers
from sb3_lac import LAC, fit_lyapunov


@pytest.fixture
def quick(monkeypatch):
    """One controller instead of all, few passes over the data, and a model that is not trained; returns what was asked for."""
    asked = []

    def train_or_load(algo, env_id, seed, timesteps, folder):
        asked.append((algo, env_id, seed, timesteps))
        return LAC("MlpPolicy", env_id, device="cpu", buffer_size=10, seed=seed, policy_kwargs={"net_arch": [8]})

    monkeypatch.setattr(certificate, "train_or_load", train_or_load)
    monkeypatch.setattr(certificate, "fit_lyapunov", partial(fit_lyapunov, n_iterations=3, progress_bar=False))
    optimal = {"optimal": reference_controllers("LinearCost-v0")["optimal"]}
    monkeypatch.setattr(certificate, "reference_controllers", lambda env_id: optimal)
    return asked


def test_tables_and_figures_are_written(tmp_path, quick, capsys):
    command = ["--envs", "LinearCost-v0", "--algos", "lac", "--seeds", "3", "--fractions", "0.1", "--episodes", "25"]
    certificate.main([*command, "--out", str(tmp_path)])
    # A tenth of the updates that follow the first thousand steps
    assert quick == [("lac", "LinearCost-v0", 3, 1900)]
    table = pd.read_csv(tmp_path / "certificates.csv")
    assert table["policy"].tolist() == ["optimal"] + 2 * ["LAC, 10 % of the updates"]
    assert table["function"].tolist() == ["fitted", "fitted", "critic"]
    # Statements are made once for each policy
    assert table["survives_at_least"].notna().tolist() == [True, True, False]
    assert (table["cost_bound_low"] <= table["cost_bound"]).all() and table["start_cost"].gt(0).all()
    assert len(list(tmp_path.glob("*_statements.png"))) == 2 and len(list(tmp_path.glob("*_drift.png"))) == 3
    assert (tmp_path / "certificates.png").stat().st_size > 0
    text = (tmp_path / "certificates.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out and "| LAC, 10 % of the updates (critic)" in text and "nan" not in text


def test_slow_loops_leave_little_of_a_discounted_cost():
    table = certificate.feasible_alpha3().set_index("controller")
    assert table.index.tolist() == ["optimal", "weak"]
    shares = table[["discount 0.9", "discount 0.95", "discount 0.99", "average cost"]].astype(float)
    np.testing.assert_allclose(shares.loc["optimal"], [0.60, 0.78, 0.95, 1.0], atol=0.03)
    assert (shares.loc["weak"] <= shares.loc["optimal"]).all() and (np.diff(shares, axis=1) > 0).all()


@pytest.mark.parametrize(
    "command", [["--algos", "llac"], ["--models", "model.zip"], ["--episodes", "1"], ["--fractions", "0"]]
)
def test_nonsense_on_the_command_line_is_refused(command, quick):
    with pytest.raises(SystemExit):
        certificate.main(command)
    assert not quick


def test_other_environments_have_no_reference():
    with pytest.raises(ValueError, match="Oscillator-v0 has no reference controllers"):
        reference_controllers("Oscillator-v0")
