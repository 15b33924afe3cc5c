"""Readings of discharges, and the model's misfit to them."""

import numpy as np
import pytest

from battery_env import TrajectoryDataset
from battery_env.electrochemistry import NEW_CELL, simulate
from battery_env.loads import RandomPiecewise
from battery_env.tasks.voltage.readings import SENSOR_ROWS, Readings, summarise_residuals


def compare(readings, q_mobile, r_o, count=None, stretches=12):
    """Means of residuals, slopes and ohmic drops, root mean square and last voltage of all discharges."""
    n = len(readings)
    shown = np.zeros((SENSOR_ROWS, n, readings.count.max()))
    for k in range(n):
        shown[:, k, : readings.count[k]] = readings.exact_measurements(k)
    means, rms_V, last_V = np.full((3, n, stretches, 2), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    count = readings.count if count is None else count
    summarise_residuals(np.arange(n), count, np.column_stack([q_mobile, r_o]), shown, readings.model, means, rms_V, last_V)
    return [*means, rms_V, last_V]


def test_misfit_is_that_of_a_whole_simulation(aged_both, readings):
    """Also where the parameters are wrong: against simulations that follow the same current."""
    q_mobile, r_o = np.full(len(readings), 7600.0), np.full(len(readings), 0.15)
    rms_V, last_V = compare(readings, q_mobile, r_o)[3:]
    for n, trajectory in enumerate(aged_both):
        model = simulate(
            trajectory.current_A, 7600.0, 0.15, load_unit="current", cut_off_V=-np.inf, until=len(trajectory.time_s)
        )
        modelled_V = model.voltage_V[10 : 10 * readings.count[n] + 1 : 10]
        exact_V = np.sqrt(np.mean((readings.voltage_V[readings.rows_of(n)] - modelled_V) ** 2))
        assert rms_V[n] == pytest.approx(exact_V, abs=2e-4)
        assert last_V[n] == pytest.approx(modelled_V[-1], abs=1e-3)


@pytest.mark.parametrize("readings_so_far", [1, 7, 8, 9, 63, 64, 65, 127, 128, 129])
def test_later_readings_and_the_blocks_they_come_in_change_nothing(readings, readings_so_far):
    whole, part = (
        compare(readings, readings.q_mobile * 0.95, readings.r_o, np.full(len(readings), count), stretches=count)
        for count in (130, readings_so_far)
    )
    for k in range(3):
        np.testing.assert_array_equal(part[k], whole[k][:, :readings_so_far])
    one_more = compare(readings, readings.q_mobile * 0.95, readings.r_o, np.full(len(readings), readings_so_far + 1))
    assert (one_more[4] != part[4]).all()


@pytest.mark.parametrize("name", ["q_mobile", "r_o"])
def test_sensitivities_are_the_slopes_of_the_residuals(readings, name):
    q_mobile, r_o = readings.q_mobile * 1.1, readings.r_o.copy()
    before = compare(readings, q_mobile, r_o)
    step = {"q_mobile": 1.0, "r_o": 1e-3}[name]
    after = compare(readings, q_mobile + step * (name == "q_mobile"), r_o + step * (name == "r_o"))
    slope = -(after[0] - before[0]) / step
    expected = before[1] if name == "q_mobile" else -before[2]
    np.testing.assert_allclose(slope, expected, rtol=0.05, atol=1e-8)


def test_the_misfit_grows_with_every_coulomb_below_what_was_drawn(readings):
    """Also where the model cell is empty before the readings end: there is no second minimum of such cells."""
    misfits_V = [compare(readings, readings.q_mobile * share, readings.r_o)[3] for share in (0.98, 0.95, 0.9, 0.8, 0.6)]
    assert np.isfinite(misfits_V).all()
    assert (np.diff(misfits_V, axis=0) > 0.0).all()
    assert np.median(misfits_V[-1]) > 0.1


def test_other_intervals_and_time_steps():
    data = TrajectoryDataset.generate(("q_mobile", "r_o"), 3, RandomPiecewise(), seed=3, dt_s=0.5)
    readings = Readings.of(data, interval_s=30.0, dt_s=0.5)
    assert compare(readings, readings.q_mobile, readings.r_o)[3].max() < 1e-3
    with pytest.raises(ValueError, match=r"interval_s must be a multiple of the time step, 1 s, got 2.5"):
        Readings.of(data, interval_s=2.5)
    with pytest.raises(ValueError, match="discharge 0 lasts 2 s, at least two readings 10 s apart"):
        Readings.of([data[0].part(0, 5)], interval_s=10.0, dt_s=0.5)
    with pytest.raises(ValueError, match="at least one discharge"):
        Readings.of([])
    assert NEW_CELL is readings.cell
