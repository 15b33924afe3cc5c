"""Figures, and the files they go to."""

import pandas as pd
import pytest

from battery_env.files import replacing
from battery_env.plotting import new_figure, plot_learning_curves, plot_true_against_inferred, save_figure


@pytest.fixture
def scores():
    true = pd.Series([0.1, 0.15, 0.2])
    columns = {"r_o": true, "r_o_hat": 1.01 * true, "r_o_spread": 0.01 * true, "r_o_mape_percent": [1.0, 1.0, 2.5]}
    return pd.DataFrame({**columns, "load": [8.0, 12.0, 16.0]})


def test_true_against_inferred_has_a_panel_for_each_calibrator(scores, tmp_path):
    figure = plot_true_against_inferred({"LAC": scores, "SAC": scores}, "r_o")
    panels, errors = figure.axes[:2], figure.axes[2:4]
    assert [axes.get_title().split("\n")[0] for axes in panels] == ["LAC", "SAC"]
    assert "MAPE 1.5 %, worst 2.5 %" in panels[0].get_title()
    points = panels[0].collections[-1].get_offsets()
    assert points[:, 0].tolist() == scores["r_o"].tolist() and points[:, 1].tolist() == scores["r_o_hat"].tolist()
    assert errors[0].collections[-1].get_offsets()[:, 1].tolist() == scores["r_o_mape_percent"].tolist()
    assert save_figure(figure, tmp_path / "folder" / "figure.png").stat().st_size > 0


def test_learning_curves_have_a_line_for_each_seed():
    table = pd.DataFrame({"timesteps": [1000, 2000], "mape_percent": [5.0, 1.0], "mape_percent_worst": [9.0, 2.0]})
    figure = plot_learning_curves({"LAC": [table, table], "TD3": [table]}, "BatteryRo-v0")
    for axes in figure.axes:
        assert len(axes.lines) == 3
        assert [text.get_text() for text in axes.get_legend().get_texts()] == ["LAC", "TD3"]


def test_a_figure_replaces_the_one_before(tmp_path):
    path = tmp_path / "figure.png"
    path.write_bytes(b"old")
    save_figure(new_figure(2.0, 2.0), path)
    assert path.read_bytes().startswith(b"\x89PNG") and list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_what_was_there(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
