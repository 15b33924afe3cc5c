"""The tasks with the full state: their environments, their options, and what the joint task shows."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import battery_env
from battery_env.electrochemistry import NEW_CELL, QNB, STATE_NAMES, VO, step
from battery_env.loads import RandomPiecewise, constant
from battery_env.tasks.full_state.full_state_task import BatteryJoint, BatteryQmax, BatteryQmaxPaper, BatteryRo
from battery_env.tasks.full_state.layout import ERROR_SCALE, OBSERVED
from battery_env.tasks.registration import TASKS
from battery_env.trajectories import TrajectoryDataset


@pytest.fixture(scope="module")
def discharges():
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 5, RandomPiecewise(), seed=0, r_o_range=(0.1, 0.2))


def started(task, trajectory=2, sample=300):
    generators = [np.random.default_rng(n) for n in range(task.cells)]
    task.start(np.arange(task.cells), generators, {"trajectory": trajectory, "sample": sample})
    return task


def make(data, kind=BatteryQmax, cells=1, **options):
    return kind(cells, dataset=data, **options)


def action_of(task, values):
    """The actions that stand for parameters by name, beyond [-1, 1] out of their range."""
    wanted = np.stack([values[name] for name in task.parameters], axis=-1)
    lowest, highest = np.array([task.formulation.action_ranges[name] for name in task.parameters]).T
    return 2.0 * (wanted - lowest) / (highest - lowest) - 1.0


def true_action(task):
    return action_of(task, task.cell_records)


def test_the_defaults_disturb_nothing(discharges):
    task = started(make(discharges))
    for k in range(5):
        trajectory = discharges[2]
        np.testing.assert_array_equal(task.cell_records["state"][0], trajectory.state[300 + k])
        np.testing.assert_array_equal(task.cell_records["next_state"][0], trajectory.state[301 + k])
        task.advance(np.zeros((1, 1)))


def test_the_second_innovation_does_not_see_the_drift_of_the_model(discharges):
    task, drifted = started(make(discharges)), started(make(discharges))
    np.testing.assert_array_equal(task.observation()[:, 15:22], task.observation()[:, 22:])  # the model starts as the cell
    task.advance(true_action(task))
    drifted.advance(true_action(drifted) - 0.1)
    np.testing.assert_array_equal(drifted.observation()[:, 22:], task.observation()[:, 22:])
    assert np.abs(drifted.observation()[:, 15:18] - task.observation()[:, 15:18]).max() > 0.01


@pytest.mark.parametrize(
    ("kind", "voltages"), [(BatteryQmax, ["Vsp"]), (BatteryRo, ["Vo"]), (BatteryJoint, ["Vsp", "Vo"])], ids=["q", "r", "both"]
)
def test_a_parameter_is_judged_by_the_voltage_that_shows_it(discharges, kind, voltages):
    task = started(make(discharges, kind, cells=4, initial_perturbation=8.0))
    for _ in range(3):
        measured = task.cell_records["next_state"].copy()
        cost = task.advance(np.zeros((4, len(task.parameters))))
        scaled = np.abs(task.cell_records["model_state"] - measured)[:, OBSERVED] / ERROR_SCALE
        errors = dict(zip(STATE_NAMES[OBSERVED], scaled.T, strict=True))
        np.testing.assert_allclose(cost, sum(np.minimum(errors[name], 5.0) for name in voltages), rtol=1e-9)


def test_the_cost_of_the_paper_counts_all_states(discharges):
    task = started(make(discharges, BatteryQmaxPaper, cells=2, initial_perturbation=3.0))
    measured = task.cell_records["next_state"].copy()
    cost, error = task.advance(true_action(task)), task.cell_records["model_state"] - measured
    half = 0.5 * (np.linalg.norm(error[:, VO:QNB], axis=1) + np.linalg.norm(error[:, QNB:], axis=1))
    np.testing.assert_allclose(cost, half * np.where(half > 1e-4, 50.0, 1.0), rtol=1e-9)


def test_a_cell_whose_data_have_ended_goes_on_without_failing(discharges):
    task = started(make(discharges), sample=int(discharges.stop[2]) - 3)
    assert not task.truncated()
    for _ in range(5):
        task.advance(np.zeros((1, 1)))
        assert task.truncated() and np.isfinite(task.observation()).all()
    assert task.cell_records["load"] == discharges[2].load[-1]


def test_episodes_go_on_with_a_probability(discharges):
    cells, probability = 2000, 0.5
    task = make(discharges, cells=cells, episode_steps=3, continue_probability=probability)
    task.start(np.arange(cells), [np.random.default_rng(n) for n in range(cells)])
    lengths = task.cell_records["steps"] // 3
    assert (task.cell_records["steps"] % 3 == 0).all() and lengths.min() == 1
    # geometric: 4 standard errors around the mean of 1 / (1 - p)
    assert abs(lengths.mean() - 2.0) < 4.0 * np.sqrt(2.0 / cells)
    task.cell_records, task.cells = task.cell_records[lengths == 2], int((lengths == 2).sum())
    data_last = task.cell_records["sample"] + 6 < task.cell_records["last_decision"]
    for k in range(1, 7):
        task.advance(np.zeros((task.cells, 1)))
        assert (task.truncated()[data_last] == (k == 6)).all()


def test_a_share_of_the_episodes_starts_where_the_whole_discharge_does():
    cells, discharges = 400, TrajectoryDataset.generate("q_mobile", 5, RandomPiecewise(), seed=0).trimmed(0.05, 0.95)
    assert (discharges.first > 0).all()
    for probability, low, high in ((0.0, 0, 0), (0.25, 60, 140), (1.0, cells, cells)):
        task = make(discharges, cells=cells, first_sample_probability=probability)
        task.start(np.arange(cells), [np.random.default_rng(n) for n in range(cells)])
        at_rest = task.cell_records["sample"] == 0
        assert low <= at_rest.sum() <= high
    chosen = started(make(discharges, first_sample_probability=1.0))
    assert chosen.cell_records["sample"] == 300  # what is asked for counts


@pytest.mark.parametrize("kind", [BatteryQmax, BatteryRo, BatteryJoint])
def test_actions_reach_beyond_all_cells(kind):
    # or no error of the other sign takes back the charge that an error has moved
    dataset = kind(1, split="all").dataset
    actions = action_of(kind(1), {"q_mobile": dataset.q_mobile, "r_o": dataset.r_o})
    assert np.abs(actions).max() < 0.8


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("episode_steps", 0, "episode_steps must be at least 1, got 0"),
        ("continue_probability", 1.0, "continue_probability must be less than 1, or episodes never end, got 1.0"),
        ("continue_probability", -0.1, "continue_probability must be finite and at least 0, got -0.1"),
        ("first_sample_probability", 1.5, "first_sample_probability must be at most 1, got 1.5"),
        ("first_sample_probability", np.nan, "first_sample_probability must be finite"),
        ("initial_perturbation", -1.0, "initial_perturbation must be finite and at least 0, got -1.0"),
        ("split", "validation", "split must be"),
    ],
)
def test_options_out_of_range_are_refused(option, value, message):
    with pytest.raises(ValueError, match=message):
        BatteryQmax(1, **{option: value})


def test_cells_whose_constants_are_not_the_models_are_refused():
    loads = [constant(12.0)]
    of_rates = TrajectoryDataset.generate("r_o", 2, loads, seed=0, mismatch=0.2)
    of_equilibrium = TrajectoryDataset.simulated(7600.0, 0.15, loads, 0, equilibrium_V=np.full((1, 8), 0.01))
    for data in (of_rates, of_equilibrium):
        with pytest.raises(ValueError, match="constants of their own"):
            make(data, BatteryRo)


IDS = ("BatteryQmax-v0", "BatteryRo-v0", "BatteryJoint-v0", "BatteryQmaxPaper-v0", "BatteryRoPaper-v0")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", TASKS)
def test_both_checkers_are_clean(env_id):
    env = gym.make(env_id, render_mode="rgb_array").unwrapped
    check_env(env)
    check_env_sb3(env)


@pytest.mark.parametrize("env_id", IDS)
def test_the_true_parameter_costs_nothing_and_any_other_does(env_id):
    env = gym.make(env_id)
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(10):
            _, reward, terminated, truncated, info = env.step(true_action(env.unwrapped.task)[0])
            assert not terminated and not truncated
            assert info["cost"] == pytest.approx(0.0, abs=1e-5)
            assert info["q_mobile"] == pytest.approx(info["q_mobile_hat"]) and info["r_o"] == pytest.approx(info["r_o_hat"])
        _, reward, *_, info = env.step(np.clip(true_action(env.unwrapped.task)[0] + 0.2, -1.0, 1.0))
        assert info["cost"] > 1e-2 and reward == -info["cost"]


@pytest.mark.filterwarnings("error")
def test_ids_are_registered_once_and_work_from_anywhere():
    battery_env.register_environments()
    assert gym.make("battery_env:BatteryQmax-v0").spec.id == "BatteryQmax-v0"


@pytest.mark.parametrize(("env_id", "steps"), [("BatteryQmax-v0", 64), ("BatteryRo-v0", 64), ("BatteryQmaxPaper-v0", 16)])
def test_episodes_are_truncated_after_their_steps(env_id, steps):
    env = gym.make(env_id)
    env.reset(options={"trajectory": 0, "sample": int(env.unwrapped.dataset.first[0])})
    ends = [env.step(true_action(env.unwrapped.task)[0])[2:4] for _ in range(steps)]
    assert ends[-1] == (False, True) and not any(t or u for t, u in ends[:-1])


def test_the_observation_is_what_the_documentation_says():
    env = gym.make("BatteryQmax-v0")
    dataset = env.unwrapped.dataset
    trajectory, t = dataset[4], 30
    first, _ = env.reset(options={"trajectory": 4, "sample": int(dataset.first[4]) + t - 1})
    observation, *_ = env.step(np.array([0.5]))
    x, x_next = trajectory.state[t], trajectory.state[t + 1]
    x_hat = step(trajectory.state[t - 1], trajectory.load[t - 1], 6950.0, NEW_CELL.r_o)
    state_scale = np.array([0.5, 0.1, 0.01, 6840.0, 760.0, 11400.0, 1266.0])
    np.testing.assert_allclose(first[7:14] * state_scale, x[OBSERVED], rtol=1e-6)
    error_scale = np.array([0.01, 1e-5, 1e-5, 20.0, 20.0, 20.0, 20.0])
    from_model, from_cell = (step(origin, trajectory.load[t], NEW_CELL.q_mobile, NEW_CELL.r_o) for origin in (x_hat, x))
    expected = np.concatenate(
        [
            x_hat[OBSERVED] / state_scale,
            x_next[OBSERVED] / state_scale,
            [trajectory.load[t] / 16.0],
            np.arcsinh((x_next - from_model)[OBSERVED] / error_scale),
            np.arcsinh((x_next - from_cell)[OBSERVED] / error_scale),
        ]
    )
    np.testing.assert_allclose(observation, expected, rtol=1e-5, atol=1e-5)


def test_the_literal_observation_is_divided_by_the_new_cells_state():
    env = gym.make("BatteryQmaxPaper-v0")
    dataset = env.unwrapped.dataset
    trajectory = dataset[4]
    observation, _ = env.reset(options={"trajectory": 4, "sample": int(dataset.first[4])})
    reference = np.array([1.0, 1.0, 1.0, 6840.0, 760.0, 4560.0, 506.67])
    expected = [*(trajectory.state[0, 1:] / reference), *(trajectory.state[1, 1:] / reference), trajectory.load[0] / 20.0]
    np.testing.assert_allclose(observation, expected, rtol=1e-6)


def test_the_perturbation_stays_in_its_bounds_and_conserves_charge():
    env, draws = gym.make("BatteryQmax-v0", initial_perturbation=10.0), []
    for seed in range(20):
        env.reset(seed=seed)
        cell_records = env.unwrapped.task.cell_records
        draws.append((cell_records["model_state"] - cell_records["state"])[0, OBSERVED][:4] / ERROR_SCALE[:4])
        assert cell_records["model_state"][0, QNB:].sum() == pytest.approx(cell_records["state"][0, QNB:].sum(), rel=1e-12)
    assert np.abs(draws).max() <= 10.0 + 1e-6 and np.abs(draws).max(axis=0).min() > 5.0


def test_wrong_parameters_never_leave_the_finite_numbers():
    for env_id in IDS:
        env = gym.make(env_id, split="all", episode_steps=500)
        n = len(env.unwrapped.dataset) - 11
        for action in (-1.0, 1.0):
            env.reset(seed=0, options={"trajectory": n, "sample": int(env.unwrapped.dataset.first[n])})
            truncated = False
            while not truncated:
                observation, reward, _, truncated, info = env.step(np.full(env.action_space.shape, action))
                assert env.observation_space.contains(observation) and np.isfinite(reward)
                assert all(np.isfinite(value) for value in info.values())


def test_points_outside_the_data_are_refused():
    env = gym.make("BatteryQmax-v0")
    with pytest.raises(ValueError, match=r"options\['trajectory'\] must lie within 0 \.\. 3857, got 9999"):
        env.reset(options={"trajectory": 9999})
    with pytest.raises(ValueError, match=r"options\['sample'\] must lie within"):
        env.reset(options={"trajectory": 0, "sample": 0})
