"""The comparison with peers on little work, and progpy's filters on little data."""

import json
import subprocess
import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("progpy")

from battery_env.electrochemistry import NEW_CELL, simulate, step, voltage
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.loads import RandomPiecewise
from battery_env.sensors import SensorErrors
from benchmarks import peers, progpy_filters


class TestProgpyFilters:
    @pytest.mark.parametrize(("parameter", "value"), [("q_mobile", 6000.0), ("r_o", 0.2)])
    def test_their_model_is_ours_with_one_more_state(self, parameter, value):
        parameters = {"q_mobile": 7600.0, "r_o": NEW_CELL.r_o} | {parameter: value}
        record = simulate(2.0, **parameters, load_unit="current", thermal=True)
        state = record.state[[5, 500, 2000]]
        model = progpy_filters._BatteryWithUnknown(parameter, process_noise=0, measurement_noise=0)
        x = model.StateContainer(np.vstack([state.T, np.full(3, value)]))
        moved = np.asarray(model.next_state(x, {"i": 2.0}, 1.0).matrix, dtype=float)
        np.testing.assert_allclose(moved[:-1].T, step(state, 2.0, **parameters, load_unit="current", thermal=True), rtol=1e-9)
        np.testing.assert_array_equal(moved[-1], value)
        np.testing.assert_allclose(np.asarray(model.output(x)["v"], dtype=float), voltage(state, parameters["q_mobile"]))

    @pytest.mark.parametrize("kind", ["ukf", "particles"])
    def test_they_find_r_o_within_a_minute(self, kind):
        record = SensorErrors(noise_V=0.005).apply(
            simulate(6.0, NEW_CELL.q_mobile, 0.2, until=60.0, thermal=True), np.random.default_rng(0)
        )
        filters = [progpy_filters.ProgpyFilter("r_o", kind, 0.15, 0.005, seed=seed) for seed in (0, 0)]
        first, again = (estimator.trace([record])[0] for estimator in filters)
        np.testing.assert_array_equal(first.time_s, record.time_s[1:])
        assert first.r_o[-1] == pytest.approx(0.2, rel=0.03)
        np.testing.assert_array_equal(first.r_o, again.r_o)
        np.testing.assert_array_equal(first.q_mobile, NEW_CELL.q_mobile)

    def test_the_unscented_filter_approaches_q_mobile(self):
        record = simulate(8.0, 6000.0, NEW_CELL.r_o, until=60.0, thermal=True)
        estimate = progpy_filters.ProgpyFilter("q_mobile", "ukf", 1900.0, 0.001).estimate(record)
        assert estimate.q_mobile == pytest.approx(6000.0, rel=0.05)

    def test_progpy_leaves_the_style_of_figures_as_it_is(self):
        check = "from matplotlib import rcParams, rcParamsDefault as d; assert rcParams['font.size'] == d['font.size']"
        subprocess.run([sys.executable, "-c", f"import benchmarks.progpy_filters; {check}"], check=True)


@pytest.fixture
def quick(monkeypatch):
    """progpy's filters replaced, and discharges in half the time; returns for how many discharges each part was made."""
    calls, work = [], peers.work
    monkeypatch.setattr(peers, "_progpy", lambda parameter, kind: ExtendedKalmanFilter([parameter], thermal=True))
    monkeypatch.setattr(peers, "RandomPiecewise", partial(RandomPiecewise, (7.0, 9.0)))
    monkeypatch.setattr(peers, "WINDOW_EVERY_S", 400.0)

    monkeypatch.setattr(peers, "work", lambda case, unknown, n: calls.append(n) or work(case, unknown, n))
    return calls


def test_tables_and_figures_are_written(tmp_path, quick, capsys):
    peers.main(["--discharges", "2", "--progpy-discharges", "1", "--out", str(tmp_path)])
    # eight calibrators alone on either parameter, and two of them under four conditions on either and one on both
    assert len(quick) == 8 * 2 + 2 * (4 * 2 + 1) and quick.count(1) == 2 * 2
    results = pd.read_csv(tmp_path / "peers.csv")
    last = results.set_index(["method", "case", "parameter"])["final_error_percent"].groupby(level=[0, 1, 2]).max()
    for parameter, limits in {"q_mobile": (1e-9, 1e-4, 0.02, 0.1), "r_o": (1e-9, 1e-9, 0.1, 0.5)}.items():
        names = ("closed form", "greedy one-step cost", "least squares, whole discharge", "extended Kalman filter")
        for name, limit in zip(names, limits, strict=True):
            assert last[name, "5 mV noise", parameter] < limit
        assert last["least squares, whole discharge", "+1 % current", parameter] > 0.5
        assert last["least squares, whole discharge", "both unknown", parameter] < 1.0
    record = json.loads((tmp_path / "peers.json").read_text())
    assert record["configuration"]["discharges"] == 2 and "progpy" in record["versions"]
    for name in ("peers.png", "limits.png"):
        assert (tmp_path / name).stat().st_size > 0
    text = (tmp_path / "peers.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out
    assert text.count("\n| ") == (1 + len(peers.METHODS) + 1) + (1 + len(peers.CASES))


def test_the_held_parameter_is_the_new_cells():
    case = next(case for case in peers.CASES.values() if case.other_worn)
    data = peers.work(case, ["q_mobile"], 3)
    assert (data.r_o == 1.1 * NEW_CELL.r_o).all() and len(set(data.q_mobile)) == 3
    data = peers.work(peers.BASE, ["r_o"], 3)
    assert (data.q_mobile == NEW_CELL.q_mobile).all() and data.thermal and data.load_unit == "power"


def test_the_bound_is_shown_as_the_mean_error_of_normal_errors():
    columns = {
        "method": peers.TRIED[0],
        "case": peers.BASE.name,
        "parameter": "r_o",
        "true": [0.1, 0.2],
        "bound": [0.001, 0.004],
    }
    normal = np.abs(np.random.default_rng(0).standard_normal(100_000)).mean()
    assert peers.bound_percent(pd.DataFrame(columns), peers.BASE, "r_o") == pytest.approx(1.5 * normal, rel=0.01)


@pytest.mark.parametrize("command", [["--discharges", "0"], ["--progpy-discharges", "0"]])
def test_nonsense_on_the_command_line_is_refused(command, quick):
    with pytest.raises(SystemExit):
        peers.main(command)
    assert not quick
