"""Figures, and the files they go to."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from battery_env import RecordModel, SensorErrors, forecast, simulate
from battery_env.estimators import Estimate
from battery_env.plotting import (
    COLOUR_OF,
    COLOURS,
    coloured,
    plot_discharge,
    plot_learning_curves,
    plot_life,
    plot_true_against_inferred,
)
from battery_env.records import Samples


@pytest.fixture
def scores():
    true = pd.Series([0.1, 0.15, 0.2])
    columns = {"r_o": true, "r_o_hat": 1.01 * true, "r_o_spread": 0.01 * true, "r_o_mape_percent": [1.0, 1.0, 2.5]}
    return pd.DataFrame({**columns, "load": [8.0, 12.0, 16.0]})


def test_true_against_inferred_has_a_panel_for_each_calibrator(scores):
    figure = plot_true_against_inferred({"LAC": scores, "SAC": scores}, "r_o")
    panels, errors = figure.axes[:2], figure.axes[2:4]
    assert [axes.get_title().split("\n")[0] for axes in panels] == ["LAC", "SAC"]
    assert "MAPE 1.5 %, worst 2.5 %" in panels[0].get_title()
    points = panels[0].collections[-1].get_offsets()
    assert points[:, 0].tolist() == scores["r_o"].tolist() and points[:, 1].tolist() == scores["r_o_hat"].tolist()
    assert errors[0].collections[-1].get_offsets()[:, 1].tolist() == scores["r_o_mape_percent"].tolist()


def test_learning_curves_have_a_line_for_each_algorithm_and_a_band_for_several_seeds():
    table = pd.DataFrame({"timesteps": [1000, 2000], "mape_percent": [5.0, 1.0], "mape_percent_worst": [9.0, 2.0]})
    better = table.assign(mape_percent=[3.0, 0.5])
    figure = plot_learning_curves({"LAC": [table, better], "TD3": [table]}, "BatteryRo-v0")
    for axes in figure.axes:
        assert len(axes.lines) == 2 and len(axes.collections) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["LAC", "TD3"]
    lac, td3 = figure.axes[0].lines
    assert lac.get_xydata().tolist() == [[1.0, 4.0], [2.0, 0.75]] and td3.get_ydata().tolist() == [5.0, 1.0]


@pytest.fixture
def record():
    return simulate(2.0, 6000.0, 0.15, load_unit="current")


def test_discharge_shows_the_measured_voltage_the_model_and_its_error(record):
    offset = SensorErrors(offset_V=0.010).apply(record, np.random.default_rng(0))
    forecast = RecordModel().forecast
    estimates = {"true": Estimate(6000.0, 0.15), "aged": Estimate(5000.0, 0.15)}
    figure = plot_discharge(offset, {name: forecast(offset, estimate) for name, estimate in estimates.items()})
    voltage, current, error = figure.axes
    measured, model, _ = voltage.lines
    np.testing.assert_array_equal(current.lines[0].get_ydata(), offset.current_A)
    np.testing.assert_array_equal(measured.get_ydata(), offset.voltage_V)
    np.testing.assert_allclose(model.get_ydata()[: len(record.time_s)], record.voltage_V, atol=1e-9)
    assert model.get_ydata()[-1] == 3.0
    np.testing.assert_allclose(error.lines[1].get_ydata(), -10.0, atol=1e-6)
    # the aged cell is empty before the record ends
    aged = error.lines[2].get_ydata()
    assert np.isnan(aged[-1]) and not np.isnan(aged[: len(aged) // 2]).any()
    assert [text.get_text() for text in voltage.get_legend().get_texts()] == ["measured", "true", "aged"]


def life(cells):
    rows = [{"cell": cell, "cycle": cycle, "q_mobile_C": 7000.0 - 100.0 * cycle} for cell in cells for cycle in (2, 5, 9)]
    return pd.DataFrame(rows).assign(sd_q_mobile_C=50.0, r_o_ohm=0.1, sd_r_o_ohm=0.02, drawn_Ah=1.8, settled=True)


def points_of(figure):
    return [line for line in figure.axes[0].lines if line.get_marker() == "o" and len(line.get_xdata())]


def test_a_life_is_drawn_over_the_numbers_of_its_discharges_with_a_colour_a_cell():
    figure = plot_life(life(["A", "B"]))
    assert [line.get_xdata().tolist() for line in points_of(figure)] == [[2.0, 5.0, 9.0]] * 2
    assert [line.get_color() for line in points_of(figure)] == list(COLOURS[:2])
    assert [text.get_text() for text in figure.legends[0].texts] == ["A", "B"]


def test_files_of_one_discharge_each_are_a_life_in_their_order_and_unsettled_ones_are_hollow():
    table = life(["A"]).assign(settled=[True, False, True], cell=["a", "b", "c"], cycle=pd.array([None] * 3, dtype="Int64"))
    hollow, settled = points_of(plot_life(table))
    assert settled.get_xdata().tolist() == [1.0, 3.0] and hollow.get_xdata().tolist() == [2.0]
    assert hollow.get_markerfacecolor() == "white"


def test_what_is_settled_has_bars_of_two_standard_deviations():
    upper, middle, lower = plot_life(life(["A"]).assign(settled=[True, True, False])).axes
    for axes, last, reach in ((upper, 6500.0 / 3600.0, 100.0 / 3600.0), (middle, 100.0, 40.0)):
        (bars,) = (each.get_segments() for each in axes.collections)
        assert len(bars) == 2
        np.testing.assert_allclose(bars[-1][:, 1], [last - reach, last + reach])
    assert not lower.collections


def test_the_cycles_of_files_are_the_axis_and_one_method_is_drawn():
    table = life(["A"]).assign(cell=["a", "b", "c"])
    figure = plot_life(table)
    assert points_of(figure)[0].get_xdata().tolist() == [2.0, 5.0, 9.0] and figure.axes[-1].get_xlabel() == "cycle"
    assert plot_life(table.drop(columns="cell").assign(cycle=None)).axes[-1].get_xlabel() == "discharge"
    with pytest.raises(ValueError, match="one method, got policy and least-squares"):
        plot_life(table.assign(method=["policy", "policy", "least-squares"]))


def test_a_name_has_one_colour_in_all_figures():
    names = ["SAC", "least squares, prior 2 %", "mine", "LAC", ("Kalman filter, no prior", "data")]
    colours = [colour for colour, _ in coloured(names)]
    assert colours[0] == COLOUR_OF["SAC"] and colours[1] == COLOUR_OF["least squares"] and len(set(colours)) == 5
    assert colours[4] == COLOUR_OF["Kalman filter"] and colours[3] == next(coloured(["a policy"]))[0]
    assert not {colours[2]} & set(COLOUR_OF.values())
    # a second one of a name is told apart, and what only sounds alike has no name
    (first, _), (second, _) = coloured(["least squares", "least squares, prior 2 %"])
    assert first == COLOUR_OF["least squares"] != second
    assert [colour for colour, _ in coloured(["replaced", 0.01])] == list(COLOURS[:2])


def test_a_discharge_in_progress_ends_in_a_band(record):
    seen = Samples.of(record).first(1000)
    expected = forecast(seen, Estimate(6000.0, 0.15), samples=3)
    ends = replace(expected, eod_time_s=np.array([999.0, 2500.0, 9000.0]))
    (voltage,) = ends.plot().axes
    band, end = voltage.patches[0], voltage.lines[1]
    # from the end of the record, which has not reached it, to what can be shown
    assert (band.get_x(), band.get_x() + band.get_width()) == (999.0, 3750.0) and set(end.get_xdata()) == {2500.0}
    assert not replace(expected, eod_time_s=np.full(3, np.inf)).plot().axes[0].patches
