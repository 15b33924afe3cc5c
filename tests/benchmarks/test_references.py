"""Every reference controller is tried under every kind of disturbance, and the published table is that of the pages."""

import json
import re

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from benchmarks import references
from docs.environment_pages import DOCS, environment_page

IDS = list(references.DISTURBANCES)


@pytest.mark.parametrize("env_id", IDS)
def test_conditions_are_disturbances_of_the_environment(env_id):
    tried = references.conditions(env_id)
    assert tried["none"] == {} and len(tried) == 6
    for arguments in tried.values():
        gym.make(env_id, **arguments)
    # The last impulse is no later than 15 steps before the end
    assert gym.spec(env_id).max_episode_steps % references._IMPULSE_INTERVAL >= 15


def test_table_and_picture_say_what_was_measured(tmp_path, monkeypatch, capsys):
    two = {env_id: references.DISTURBANCES[env_id] for env_id in ("LinearCost-v0", "PendulumCost-v0")}
    monkeypatch.setattr(references, "DISTURBANCES", two)
    references.main(["--episodes", "3", "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "references.csv")
    assert len(table) == 12 and json.loads((tmp_path / "references.json").read_text())["configuration"] == {"episodes": 3}
    undisturbed = table[table["disturbance"] == "none"]
    assert (undisturbed["at_goal"] == 1).all() and (undisturbed["died"] == 0).all()
    assert (table["cost"] <= table["cost_worst"]).all() and (table["error_median"] <= table["error_worst"]).all()
    np.testing.assert_allclose(table["at_goal"] * 3, np.round(table["at_goal"] * 3), atol=1e-5)
    text = (tmp_path / "references.md").read_text()
    assert text.count("\n") == 14 and "observation_noise=0.03" in text and text in capsys.readouterr().out
    assert (tmp_path / "references.png").stat().st_size > 1000


def test_shares_are_of_the_way_that_is_left_and_the_dead_have_not_arrived(monkeypatch):
    outcome = {"cost": [1.0] * 4, "error_at_start": [10.0, 2.0, 0.1, 10.0], "error": [0.1, 0.002, 0.09, 0.0]}
    died = [False, False, False, True]
    monkeypatch.setattr(references, "roll_out", lambda *_: pd.DataFrame(outcome | {"died": died}))
    shares = references.tried(None, "LinearCost-v0", 4)[list(references.SHARES)]
    assert shares.drop_duplicates().values.tolist() == [[0.75, 0.5, 0.25]]


def test_zero_episodes_are_refused():
    with pytest.raises(SystemExit):
        references.main(["--episodes", "0"])


@pytest.mark.parametrize("env_id", IDS)
def test_pages_say_what_the_published_table_says(env_id):
    table = pd.read_csv(DOCS / "results/references/references.csv")
    row = table[(table["environment"] == env_id) & (table["disturbance"] == "none")].iloc[0]
    section = re.search(r"## Reference Controller\n(.*?)\n## ", environment_page(env_id), flags=re.DOTALL)[1]
    text = " ".join(section.split())
    assert float(re.search(r"costs? ([\d.]+) per step", text)[1]) == pytest.approx(row["cost"], rel=0.03)
    assert float(re.search(r"the largest is ([\d.e-]*\d)", text)[1]) == pytest.approx(row["error_worst"], rel=0.03)
    assert float(re.search(r"error below ([\d.]*\d)", text)[1]) == row["tolerance"]
    assert "100 of 100 end" in text and row["at_goal"] == 1 and row["died"] == 0
