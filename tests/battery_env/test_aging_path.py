"""Cells that age along a path: how it is found, drawn from, saved, and used as a prior."""

import json
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from battery_env import AgingPath, LeastSquares, PolicyEstimator, TrajectoryDataset, calibrate, evaluate, fit_life
from battery_env.electrochemistry import NEW_CELL, UNCERTAIN_CONSTANTS, simulate
from battery_env.electrochemistry.aging_path import PATH_NAMES, SPREAD_SD, cell_with
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.estimates import last_estimate
from battery_env.lab.life import track_life
from battery_env.lab.settings import Settings
from battery_env.loads import RandomPiecewise, constant
from battery_env.records import Samples
from battery_env.records.discharge import load_nasa_discharges
from battery_env.records.model import RecordModel
from battery_env.records.samples import Stream
from battery_env.sensors import SensorErrors
from battery_env.tasks.voltage.voltage_task import ESTIMATE_RANGES, VoltageTask
from tests.policies import Always
from tests.sweeps import sweep
from tests.terminal import write

AGES = 5
LOAD = constant(2.0, "current")


def every_tenth(made):
    """Samples of a simulated discharge, down to its last one."""
    kept = np.unique(np.append(np.arange(0, len(made.time_s), 10), len(made.time_s) - 1))
    return Samples(made.time_s[kept], made.voltage_V[kept], made.current_A[kept])


def life(cell=NEW_CELL, q_from=7200.0, q_to=5000.0):
    """Discharges of a simulated cell whose kn and r_o age with its q_mobile."""
    records = []
    for share in np.linspace(0.0, 1.0, AGES):
        aged = cell.replace(kn=1000.0 * np.exp(-2.0 * share))
        q_mobile, r_o = q_from + share * (q_to - q_from), 0.11 + 0.06 * share
        made = simulate(LOAD, q_mobile, r_o, load_unit="current", cell=aged, cut_off_V=2.7)
        records.append(every_tenth(made))
    return records


@pytest.fixture(scope="module")
def path():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return fit_life(life())


@pytest.fixture(scope="module")
def b0006():
    return fit_life(load_nasa_discharges("B0006")[::4])


def until(record, share):
    n = int(share * len(record.time_s))
    return Samples(*(column[:n] for column in record))


class TestFit:
    def test_the_path_goes_through_the_cells_that_were_discharged(self, path):
        (rows,) = np.array(path.lives)
        np.testing.assert_allclose(np.exp(rows[:, -2]), np.linspace(7200.0, 5000.0, AGES), rtol=0.02)
        assert path.mismatch_V < 0.005
        (kn,) = rows[:, [PATH_NAMES.index("kn")]].T
        assert (np.diff(kn) < 0.0).all() and (np.diff(rows[:, -1]) > 0.0).all()

    def test_several_cells_have_a_life_each(self, path):
        assert len(path.lives) == 1
        both = fit_life([life(), life(q_from=6000.0, q_to=4500.0)])
        assert [len(each) for each in both.lives] == [AGES, AGES]
        assert np.exp(both.lives[1][0][-2]) == pytest.approx(6000.0, rel=0.03)

    def test_real_ages_are_followed_to_some_millivolts_and_keep_their_q_mobile(self, b0006):
        assert b0006.mismatch_V < 0.005
        whole = load_nasa_discharges("B0006")[0].loaded_part(2.7)
        assert np.exp(b0006.lives[0][0][-2]) == pytest.approx(LeastSquares().estimate(whole).q_mobile, rel=0.005)

    @pytest.mark.parametrize(
        ("discharges", "error", "message"),
        [
            (lambda: life()[:1], ValueError, "at least two discharges"),
            (lambda: [life(), life()[:1]], ValueError, "at least two discharges"),
            (lambda: [*life(), life()], TypeError, "both at once"),
            (lambda: load_nasa_discharges("B0005")[0], TypeError, "must be a list"),
            (lambda: [until(each, 0.5) for each in life()], ValueError, "in progress"),
        ],
    )
    def test_what_is_no_life_is_refused(self, discharges, error, message):
        with pytest.raises(error, match=message):
            fit_life(discharges())

    def test_cells_that_the_equations_cannot_describe_are_refused(self):
        flat = with_equilibrium(NEW_CELL, [-0.35, 0.33, -0.05, 0.05])
        with pytest.raises(ValueError, match="do not describe this cell"):
            fit_life([each._replace(voltage_V=each.voltage_V**3 / 14.0) for each in life(flat)], limit_V=0.002)


class TestDraw:
    def test_cells_lie_along_the_path_and_a_little_beyond_and_beside_it(self, path):
        cells = path.draw(4000, seed=0)
        assert cells.place.min() == pytest.approx(-0.2, abs=0.01)
        assert cells.place.max() == pytest.approx(1.2, abs=0.01)
        middle = np.abs(cells.place - 0.5) < 0.02
        rows = np.array(path.lives[0])
        assert np.log(cells.q_mobile[middle]).mean() == pytest.approx(rows[AGES // 2, -2], abs=0.02)
        assert np.log(cells.q_mobile[middle]).std() == pytest.approx(SPREAD_SD[-2], rel=0.3)
        assert np.corrcoef(cells.place, cells.q_mobile)[0, 1] < -0.9

    def test_the_same_seed_draws_the_same_cells(self, path):
        for name in ("q_mobile", "factors", "equilibrium_V"):
            first, again, other = (getattr(path.draw(5, seed), name) for seed in (1, 1, 2))
            np.testing.assert_array_equal(first, again)
            assert (first != other).all()

    @pytest.mark.parametrize(("n", "seed"), [(0, 0), (1, -1), (1.5, 0)])
    def test_wrong_numbers_are_refused(self, path, n, seed):
        with pytest.raises((TypeError, ValueError)):
            path.draw(n, seed)


class TestDataset:
    def test_a_trajectory_is_the_simulation_of_its_cell(self, path):
        data, cells = TrajectoryDataset.along(path, 6, [LOAD], seed=3), path.draw(6, 3)
        np.testing.assert_array_equal(data.q_mobile, cells.q_mobile)
        for n in (0, 5):
            known = dict(zip(UNCERTAIN_CONSTANTS, np.log(cells.factors[n]), strict=True))
            known |= dict(zip(PATH_NAMES[4:12], cells.equilibrium_V[n], strict=True))
            cell = cell_with(path.cell, known)
            alone = simulate(LOAD, cells.q_mobile[n], cells.r_o[n], load_unit="current", cell=cell)
            np.testing.assert_allclose(data[n].voltage_V, alone.voltage_V, rtol=1e-9)
            assert data[n].cell.Ap == pytest.approx(cell.Ap)

    def test_states_subsets_and_files_keep_the_cells(self, path, tmp_path):
        data = TrajectoryDataset.along(path, 6, RandomPiecewise(), seed=3)
        states = data.states_at(np.array([1, 4]), np.array([70, 65]))
        np.testing.assert_array_equal(states, [data[1].state[70], data[4].state[65]])
        again = TrajectoryDataset.load(data.subset([4, 2]).save(tmp_path / "part"))
        np.testing.assert_array_equal(again[0].voltage_V, data[4].voltage_V)
        np.testing.assert_array_equal(again.equilibrium_V, data.equilibrium_V[[4, 2]])

    def test_the_tasks_draw_from_it(self, path):
        data = TrajectoryDataset.along(path, 4, [LOAD], seed=3)
        env = gym.make("BatteryVoltageJoint-v0", dataset=data, cost="state")
        observation, _ = env.reset(seed=0)
        assert np.isfinite(observation).all()
        _, reward, *_, info = env.step(env.action_space.sample())
        assert reward < 0.0 and info["q_mobile"] in data.q_mobile

    def test_what_is_no_path_is_refused(self):
        with pytest.raises(TypeError, match="must be an AgingPath"):
            TrajectoryDataset.along(NEW_CELL, 4, [LOAD], seed=0)


class TestFile:
    def test_round_trip(self, path, tmp_path):
        file = path.to_json(tmp_path / "path.json")
        assert AgingPath.from_json(file) == path
        with pytest.raises(FileExistsError):
            path.to_json(file)

    @pytest.mark.parametrize(
        "change",
        [
            {"names": ["kn"]},
            {"lives": []},
            {"lives": [[[0.0] * 14]]},
            {"lives": [[[0.0] * 3] * 2]},
            {"lives": [[[0.0] * 14] * 2]},
            {"lives": "none"},
            {"mismatch_V": 0.0},
            {"cell": {}},
            {"more": 1},
        ],
    )
    def test_damaged_files_are_refused(self, path, tmp_path, change):
        content = json.loads(path.to_json(tmp_path / "path.json").read_text())
        (tmp_path / "damaged.json").write_text(json.dumps(content | change))
        with pytest.raises(ValueError, match=r"damaged\.json is damaged"):
            AgingPath.from_json(tmp_path / "damaged.json")


class TestPrior:
    def test_before_the_knee_it_tells_what_the_voltage_alone_does_not(self, path):
        record = until(life()[3], 0.5)
        estimate, alone = LeastSquares(path=path).estimate(record), LeastSquares(mismatch_V=path.mismatch_V).estimate(record)
        assert estimate.q_mobile == pytest.approx(5550.0, rel=0.05)
        assert abs(estimate.q_mobile - 5550.0) < 0.5 * abs(alone.q_mobile - 5550.0)
        assert abs(estimate.q_mobile - 5550.0) < 3.0 * estimate.sd_q_mobile

    def test_an_estimate_that_rests_on_the_path_is_not_settled_and_a_whole_discharge_is(self, b0006):
        whole = load_nasa_discharges("B0005")[100].loaded_part(2.7)
        part = until(Samples.of(whole), 0.5)
        found, early = (LeastSquares(path=b0006).estimate(record) for record in (whole, part))
        assert found.settled and not early.settled
        assert found.q_mobile == pytest.approx(LeastSquares(mismatch_V=0.05).estimate(whole).q_mobile, rel=0.015)

    @pytest.mark.filterwarnings("error::RuntimeWarning")
    @pytest.mark.parametrize("share", sweep(1.0, 0.3))
    @pytest.mark.parametrize("size", sweep(2.8, 0.3, 1.0, 4.0, 10.0))
    def test_a_cell_of_any_size_has_an_answer_and_of_another_one_it_is_not_settled(self, b0006, size, share):
        made = simulate(2.0 * size, 6000.0 * size, 0.0, load_unit="current", cut_off_V=2.7)
        estimate = LeastSquares(path=b0006).estimate(until(every_tenth(made), share))
        assert np.isfinite(estimate.q_mobile) and not estimate.settled

    @pytest.mark.parametrize("share", sweep(0.5, 0.1, 0.9))
    def test_what_the_cell_itself_was_found_to_hold_counts_as_it_is_stated(self, b0006, share):
        whole = load_nasa_discharges("B0005")[80].loaded_part(2.7)
        known, record = LeastSquares(path=b0006).estimate(whole), until(Samples.of(whole), share)
        mean_C, sd_C = known.q_mobile, 0.01 * known.q_mobile
        alone = LeastSquares(path=b0006).estimate(record)
        both = LeastSquares(path=b0006, prior_q_mobile_C=(mean_C, sd_C)).estimate(record)
        # as two that do not know of each other, of which that of the path has the spread that is stated
        weights = np.array([alone.sd_q_mobile, sd_C]) ** -2.0
        assert both.sd_q_mobile == pytest.approx(weights.sum() ** -0.5, rel=0.3)
        assert both.q_mobile == pytest.approx(weights @ [alone.q_mobile, mean_C] / weights.sum(), abs=0.5 * sd_C)
        wrong = LeastSquares(path=b0006, prior_q_mobile_C=(0.7 * mean_C, sd_C)).estimate(record)
        assert not wrong.settled_q_mobile

    def test_the_more_lives_the_surer_what_they_tell_of_another_cell(self, b0006):
        part = until(Samples.of(load_nasa_discharges("B0005")[80].loaded_part(2.7)), 0.5)
        (life,) = b0006.lives
        paths = [AgingPath(b0006.cell, (life,) * n, b0006.mismatch_V) for n in (1, 2, 20)]
        sd_C = [LeastSquares(path=each).estimate(part).sd_q_mobile for each in paths]
        assert sd_C[0] == pytest.approx(3.0 / 2.0 * sd_C[1], rel=0.1)
        assert sd_C[1] == pytest.approx(2.0 / 1.1 * sd_C[2], rel=0.1)

    @pytest.mark.parametrize("others", [{"nuisance": {"kn": 0.2}}, {"parameters": ("q_mobile",)}])
    def test_it_knows_all_at_once(self, path, others):
        with pytest.raises(ValueError, match="path is of both parameters"):
            LeastSquares(path=path, **others)


class TestCalibrations:
    """The commands and their Python door, of which a path is the cell."""

    def test_they_say_what_least_squares_say(self, b0006, tmp_path, terminal):
        file, running = b0006.to_json(tmp_path / "path.json"), load_nasa_discharges("B0005")[80].until(1500.0)
        found = calibrate(running, cell=b0006)
        estimate = LeastSquares(path=b0006, current_gain_sd=0.005).estimate(running.loaded_part(2.7))
        assert (found.q_mobile_C, found.sd_q_mobile_C) == (estimate.q_mobile, estimate.sd_q_mobile)
        # with the constants that were found
        assert found.voltage_rmse_V < 0.005 and found.method == "least-squares"
        measured_s = load_nasa_discharges("B0005")[80].eod_time_s(2.7)
        assert abs(found.predicted_eod_time_s - measured_s) < 1.64 * found.sd_predicted_eod_time_s
        told = terminal.row("forecast", write(running, tmp_path / "running.csv"), "--cell", file)  # nothing contradicts it
        assert told["eod_time_s"][1] == pytest.approx(found.predicted_eod_time_s, rel=0.01)

    def test_a_gain_that_may_be_off_is_the_sensors_and_not_one_of_unlike_cells(self, b0006):
        for n in (0, 40, 100):
            assert calibrate(load_nasa_discharges("B0005")[n], cell=b0006).settled

    def test_the_life_of_the_cell_itself_goes_with_it(self, b0006):
        discharges, settings = load_nasa_discharges("B0005")[76:81], Settings(cell=b0006, cut_off_V=2.7)
        before = track_life(discharges[:-1], 2.7, settings.calibrator())
        # the model of each discharge is that with the constants that were found
        assert before.table["lasted_share"].to_numpy() == pytest.approx(1.0, abs=0.01)
        end_s = discharges[-1].eod_time_s(2.7)
        for known, most in ((settings, 0.06), (replace(settings, prior_q_mobile_C=before.prior_q_mobile_C), 0.02)):
            found = calibrate(discharges[-1].until(1500.0), known)
            assert abs(found.predicted_eod_time_s - end_s) < most * end_s

    def test_a_path_is_for_least_squares(self, path):
        with pytest.raises(ValueError, match="is for least squares"):
            Settings(cell=path, method="policy")


#: It leaves the estimate where the fit in its observation puts it.
FIT = Always(0.0, 0.0)


@pytest.fixture(scope="module")
def whole():
    return [each.loaded_part(2.7) for each in load_nasa_discharges("B0005")[2::80]]


@pytest.fixture(scope="module")
def along(b0006):
    return PolicyEstimator(FIT, "BatteryVoltageJoint-v0", path=b0006)


class TestTask:
    """The voltage-only task along a path."""

    def test_the_fit_in_the_observation_says_what_least_squares_say(self, b0006, along, whole):
        for trace, record in zip(along.trace(whole), whole, strict=True):
            estimate, found = last_estimate(trace), LeastSquares(path=b0006).estimate(record)
            assert estimate.settled and found.settled
            assert estimate.q_mobile == pytest.approx(found.q_mobile, rel=0.005)
            assert estimate.r_o == pytest.approx(found.r_o, rel=0.08)
            assert estimate.sd_q_mobile == pytest.approx(found.sd_q_mobile, rel=0.3)
            shown_V = RecordModel(b0006.cell).voltage(record, estimate)
            assert np.sqrt(np.mean((shown_V - record.voltage_V)[1:] ** 2)) < 0.012
            # what rests on the path is not settled
            assert not trace.settled_q_mobile[: len(trace.time_s) * 3 // 4].any()

    def test_a_stream_ends_as_its_record_does(self, along, whole):
        stream = Stream.of(whole[1], 1.0)
        along.reset()
        for sample in zip(stream.voltage_V.tolist(), stream.current_A.tolist(), stream.dt_s.tolist(), strict=True):
            streamed = along.update(*sample)
        # without the last decision, which comes after the last sample
        assert streamed.q_mobile == pytest.approx(along.trace([whole[1]])[0].q_mobile[-2], rel=1e-3)
        assert set(streamed.constants) == set(PATH_NAMES[:-2])

    def test_an_action_goes_beside_the_fit_in_its_standard_deviations(self, path):
        data = TrajectoryDataset.along(path, 4, [LOAD], seed=3)
        task = VoltageTask(4, dataset=data, path=path, cost="state", new_readings=(0, 0))
        task.start(np.arange(4), [np.random.default_rng(k) for k in range(4)])
        assert task.observation().shape == (4, 120)
        fit, (low, high) = task.fit(), np.transpose(list(ESTIMATE_RANGES.values()))
        task.advance(np.tile([0.25, -0.5], (4, 1)))
        np.testing.assert_allclose(task.estimate, np.clip(fit.estimate + [0.5, -1.0] * fit.sd, low, high))

    @pytest.mark.attacks
    def test_intervals_along_the_path_hold(self, path):
        data = TrajectoryDataset.along(path, 60, [constant(1.5, "current"), LOAD], seed=7)
        estimator = PolicyEstimator(FIT, "BatteryVoltageJoint-v0", path=path)
        scores = evaluate(estimator, data, SensorErrors(0.002), seed=1)
        # of cells of the path itself the double of what the fit states holds nearly always
        assert scores["q_mobile_coverage_percent"].mean() > 97.0

    def test_cells_of_another_kind_are_not_settled(self, along, path):
        large = simulate(4.0, 15000.0, 0.06, load_unit="current", cut_off_V=2.7)
        flat = with_equilibrium(NEW_CELL, [-0.35, 0.33, -0.05, 0.05])
        phosphate = simulate(2.0, 6000.0, 0.12, load_unit="current", cell=flat, cut_off_V=2.5)
        for made in (large, phosphate):
            for estimator in (along, LeastSquares(path=path)):
                assert not estimator.estimate(every_tenth(made)).settled

    def test_it_knows_all_at_once(self, path):
        for others in ({"nuisance": 0.2}, {"mismatch": 0.2}):
            with pytest.raises(ValueError, match="path says how far constants are off"):
                VoltageTask(1, path=path, **others)

    def test_irregular_readings_are_drawn(self, path):
        data = TrajectoryDataset.along(path, 4, [LOAD], seed=3)
        steps = np.diff(VoltageTask(1, dataset=data, path=path, reading_s=(2.0, 20.0)).readings.time_s)
        steps = steps[steps > 0.0]
        assert steps.min() >= 1.0 and steps.max() <= 30.0 and len(np.unique(steps)) > 10
        with pytest.raises(ValueError, match=r"interval_s must be \(least, most\)"):
            VoltageTask(1, dataset=data, path=path, reading_s=(20.0, 2.0))
