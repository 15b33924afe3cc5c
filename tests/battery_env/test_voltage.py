"""The voltage-only tasks."""

import os

import numpy as np
import pytest

from battery_env import NEW_CELL, RandomSensorErrors, TrajectoryDataset, load_nasa_discharges
from battery_env.loads import RandomPiecewise
from battery_env.tasks.env import CalibrationEnv
from battery_env.tasks.full_state.full_state_task import BatteryQmax
from battery_env.tasks.voltage.voltage_task import ESTIMATE_RANGES, LARGEST_STEPS, VoltageTask
from tests.records import recorded

BOTH = ("q_mobile", "r_o")
LOW, HIGH = np.array([ESTIMATE_RANGES[name] for name in BOTH]).T
EXACT = {"noise_V": (0.0, 0.0), "offset_V": 0.0}


@pytest.fixture(scope="module")
def data(aged_both):
    return aged_both


def generators(n, seed=0):
    return [np.random.default_rng(seed + k) for k in range(n)]


def started(data, cells=4, seed=0, **options):
    task = VoltageTask(cells, dataset=data, **options)
    task.start(np.arange(cells), generators(cells, seed))
    return task


class TestTask:
    def test_the_true_estimate_costs_nothing_and_stays(self, data):
        task = started(data, start="true", **EXACT)
        for _ in range(8):
            cost = task.advance(np.zeros((4, 2)))
            assert (cost < 0.1).all()  # 0.2 mV of 2
        report = task.report()
        for name in BOTH:
            np.testing.assert_array_equal(report[name], report[f"{name}_hat"])
        np.testing.assert_allclose(report["voltage"], report["voltage_hat"], atol=1e-3)

    def test_actions_move_the_estimate_within_its_range(self, data):
        task = started(data, start="true")
        before, step = task.estimate, 0.25 * np.array([LARGEST_STEPS[name] for name in BOTH])
        task.advance(np.full((4, 2), -0.5))
        np.testing.assert_allclose(task.estimate, np.clip(before - step, LOW, HIGH), rtol=1e-12)
        for _ in range(8):
            task.advance(np.full((4, 2), 7.0))  # beyond the range it counts as 1
        np.testing.assert_allclose(task.estimate, np.tile(HIGH, (4, 1)))

    @pytest.mark.parametrize("offset_V", [0.0, 0.01])
    def test_cost_is_the_misfit_of_all_data_at_the_new_estimate(self, data, offset_V):
        options = {"noise_V": (0.0, 0.0), "offset_V": offset_V}
        task = started(data, **options)
        cost = task.advance(np.array([[0.1, 0.2], [-0.3, 0.1], [0.05, -0.1], [0.0, 0.0]]))
        # observed are the misfit, and the residuals over it, less the offset that explains them best
        observed = task.observation().astype(np.float64)
        misfit_V = 0.01 * np.exp(observed[:, 96]) - 1e-4
        np.testing.assert_allclose(cost, np.arcsinh(misfit_V / 0.002), rtol=1e-4)
        residual_V = observed[:, :32] * (misfit_V[:, None] + 1e-3)
        np.testing.assert_allclose(misfit_V, np.sqrt(np.mean(residual_V**2, axis=1)), rtol=1e-4)
        explained_V = np.clip(0.01 * np.sinh(observed[:, 98]), -offset_V, offset_V)
        np.testing.assert_allclose(residual_V.mean(axis=1) + explained_V, 0.01 * np.sinh(observed[:, 98]), atol=1e-6)
        # they are those of the new estimate and of all readings, the new ones too
        again = started(data, **options)
        for row in range(4):
            point = {"discharge": task.discharge[row], "reading": task.count[row]}
            q_mobile, r_o = task.estimate[row]
            generator = np.random.default_rng(row)
            again.start(np.array([row]), [generator], {**point, "q_mobile_hat": q_mobile, "r_o_hat": r_o})
        if offset_V == 0.0:
            np.testing.assert_array_equal(again.observation(), task.observation())

    def test_the_observation_knows_no_truth(self, data):
        """The same discharges without their true parameters look the same."""
        one, other = started(data), started([recorded(each) for each in data])
        for _ in range(3):
            np.testing.assert_array_equal(one.observation(), other.observation())
            np.testing.assert_array_equal(one.advance(np.full((4, 2), 0.1)), other.advance(np.full((4, 2), 0.1)))
        assert np.isnan(other.report()["q_mobile"]).all()

    def test_noise_and_offset_are_those_asked_for(self, data, readings):
        def errors_V(**sensors):
            """Of the last readings, for each decision of 200 episodes."""
            task = started(data, cells=200, **sensors)
            found = []
            for _ in range(8):
                true_V = readings.voltage_V[readings.start[task.discharge] + task.count - 1]
                found.append(task.report()["voltage"] - true_V)
                task.advance(np.zeros((200, 2)))
            return np.array(found)

        assert np.std(errors_V(noise_V=(0.005, 0.005), offset_V=0.0)) == pytest.approx(0.005, rel=0.06)
        offsets_V = errors_V(noise_V=(0.0, 0.0), offset_V=0.01)
        assert np.ptp(offsets_V, axis=0).max() < 1e-12 and np.abs(offsets_V).max() <= 0.01
        assert np.std(offsets_V[0]) == pytest.approx(0.01 / np.sqrt(3.0), rel=0.15)
        # the noise of the process adds up as the overpotentials of the model decay
        variance = sum(1e-8 / (1.0 - (1.0 - 1.0 / tau) ** 2) for tau in (NEW_CELL.to, NEW_CELL.tsn, NEW_CELL.tsp))
        assert np.std(errors_V(process_noise_V=1e-4, **EXACT)) == pytest.approx(np.sqrt(variance), rel=0.3)

    @pytest.mark.parametrize("fault", [{"current_gain": 0.1}, {"current_offset_A": 0.3}, {"offset_V": 0.3}])
    def test_training_sees_what_evaluation_shows(self, data, fault):
        """An episode looks like a record to which the same errors were applied."""
        sensors = {**EXACT, **fault}
        task = VoltageTask(1, dataset=data, start="true", **sensors)
        task.start(np.zeros(1, dtype=int), generators(1, seed=7), {"discharge": 3, "reading": 150})
        (generator,) = generators(1, seed=7)
        generator.integers(0, 30, size=8)  # how many readings arrive
        shown = RandomSensorErrors(**sensors).draw(generator).apply(data[3], generator)
        evaluated = VoltageTask.of_records([shown], 1500.0, start="true", **sensors)
        exact = VoltageTask.of_records([data[3]], 1500.0, start="true", **sensors)
        np.testing.assert_allclose(task.observation(), evaluated.observation(), atol=0.05)
        assert np.abs(exact.observation() - evaluated.observation()).max() > 0.2

    def test_the_error_of_the_state_is_that_of_the_parameters(self, data):
        task, by_misfit = (started(data, cost=cost) for cost in ("state", "misfit"))
        np.testing.assert_array_equal(task.observation(), by_misfit.observation())
        for _ in range(8):
            action = np.random.default_rng(0).uniform(-1.0, 1.0, (4, len(task.parameters)))
            cost, misfit = task.advance(action), by_misfit.advance(action)
            report = task.report()
            percent = [100.0 * (report[f"{name}_hat"] - report[name]) / report[name] for name in task.parameters]
            np.testing.assert_allclose(cost, np.arcsinh(np.sqrt(np.sum(np.square(percent), axis=0))), rtol=1e-12)
            assert (cost != misfit).all()
            # nothing else knows of it
            np.testing.assert_array_equal(task.observation(), by_misfit.observation())

    def test_a_recording_does_not_know_its_state(self, data):
        of_cells = [discharge.loaded_part(3.0) for discharge in load_nasa_discharges("B0005")[:2]]
        with pytest.raises(ValueError, match="and 2 of 10 discharges are not simulated: take cost='misfit'"):
            VoltageTask(1, dataset=[*data, *of_cells], cost="state")
        # a policy that was trained with it can be asked about one
        task = VoltageTask.of_records(of_cells, 30, cost="state")
        assert np.isfinite(task.advance(np.zeros((2, 2)))).all()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"episode_steps": 0}, "episode_steps must be at least 1, got 0"),
            ({"new_readings": (3, 1)}, r"new_readings must be .*, got \(3, 1\)"),
            ({"noise_V": (0.0, 0.03)}, r"noise_V must be .*, got \(0.0, 0.03\)"),
            ({"noise_V": (5.0, 30.0)}, r"noise_V must be .*, got \(5.0, 30.0\)"),
            ({"offset_V": -0.01}, "offset_V must be at least 0 and less than 0.5, got -0.01"),
            ({"process_noise_V": np.nan}, "process_noise_V must be .*, got nan"),
            ({"start": "new"}, "start must be one of .*, got 'new'"),
            ({"nuisance": -0.1}, "nuisance must be finite and at least 0, got -0.1"),
            ({"cell": {"kn": 1.0}}, "cell must be CellParameters or None"),
            ({"load": "constant"}, "dataset stands in place of load"),
            ({"cost": "label"}, "cost must be one of .*, got 'label'"),
        ],
    )
    def test_bad_options_are_refused(self, data, options, message):
        with pytest.raises((TypeError, ValueError), match=message):
            VoltageTask(1, dataset=data, **options)

    def test_discharges_without_their_start_are_refused(self, data):
        with pytest.raises(ValueError, match="dataset leaves out the start of discharges"):
            VoltageTask(1, dataset=data.trimmed(0.05, 0.95))


class TestEnvironments:
    @pytest.mark.parametrize(("name", "value"), [("q_mobile", 5000.0), ("r_o", 0.2)])
    def test_reset_options(self, name, value, data):
        env = CalibrationEnv(VoltageTask, dataset=data)
        _, info = env.reset(seed=0, options={"discharge": 3, "reading": 40, f"{name}_hat": value})
        assert info[f"{name}_hat"] == value
        assert info["q_mobile"] == data.q_mobile[3]
        for options, message in (
            ({"discharge": 8}, r"options\['discharge'\] must lie within 0 .. 7, got 8"),
            ({"discharge": 0, "reading": 9999}, r"options\['reading'\] must lie within 1 .. \d+ for discharge 0, got 9999"),
            ({"trajectory": 1}, "unknown reset options"),
            ({f"{name}_hat": 0.0}, f"{name}_hat"),
        ):
            with pytest.raises(ValueError, match=message):
                env.reset(options=options)


@pytest.fixture(scope="module")
def own():
    cell = TestOwnCell.CELL
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 4, RandomPiecewise(), seed=5, r_o_range=(0.1, 0.3), cell=cell)


class TestOwnCell:
    CELL = NEW_CELL.replace(kn=0.5 * NEW_CELL.kn, to=1.2 * NEW_CELL.to, U0p=NEW_CELL.U0p + 0.02, q_mobile=7000.0, r_o=0.15)

    def test_its_constants_are_those_of_its_data_or_those_that_are_given(self, own, data):
        assert started(own).readings.cell == self.CELL
        as_recorded = [recorded(each, starts_at_rest=True) for each in own]
        for discharges, cell in ((as_recorded, self.CELL), (as_recorded, None), (own, NEW_CELL), (data, None)):
            task = started(discharges, start="new_cell", cell=cell, **EXACT)
            model = NEW_CELL if cell is None else cell
            assert task.readings.cell == model
            np.testing.assert_array_equal(task.estimate, [[model.q_mobile, model.r_o]] * 4)

    def test_with_them_the_truth_explains_a_recording_and_with_others_it_does_not(self, own):
        as_recorded = [recorded(each) for each in own]
        for cell, explained in ((self.CELL, True), (None, False)):
            task = VoltageTask(1, dataset=as_recorded, cell=cell, **EXACT)
            for discharge, trajectory in enumerate(own):
                true = {"q_mobile_hat": trajectory.q_mobile, "r_o_hat": trajectory.r_o}
                task.start(np.array([0]), generators(1), {"discharge": discharge, "reading": 20, **true})
                cost = task.advance(np.zeros((1, 2)))[0]
                assert (cost < 0.2) == explained  # asinh of 0.4 mV over 2 mV

    @pytest.mark.parametrize("changed", [{"q_mobile": 20_000.0}, {"r_o": 0.01}])
    def test_cells_that_no_estimate_reaches_are_refused(self, changed):
        (name,) = changed
        with pytest.raises(ValueError, match=f"{name} of cell must lie within .*, where the task looks for it, got"):
            VoltageTask(1, cell=self.CELL.replace(**changed))

    def test_a_saved_data_set_is_named_by_its_file_and_read_anew_when_it_has_changed(self, own, data, tmp_path):
        file = tmp_path / "own.npz"
        own.save(file)
        task = VoltageTask(2, dataset=str(file))
        assert task.readings.cell == self.CELL and task.dataset is VoltageTask(1, dataset=file).dataset
        np.testing.assert_array_equal(task.dataset.q_mobile, own.q_mobile)
        file.unlink()
        data.save(file)
        os.utime(file, ns=(0, 0))
        assert VoltageTask(2, dataset=str(file)).readings.cell == NEW_CELL
        np.testing.assert_array_equal(BatteryQmax(1, dataset=file).dataset.q_mobile, data.q_mobile)
        with pytest.raises(FileNotFoundError, match=r"none\.npz"):
            VoltageTask(1, dataset=tmp_path / "none.npz")
