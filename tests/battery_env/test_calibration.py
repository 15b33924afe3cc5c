"""The calibration task and its environments."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import battery_env
from battery_env.electrochemistry import NEW_CELL, QNB, step
from battery_env.tasks.full_state.layout import ERROR_SCALE, OBSERVED

IDS = ("BatteryQmax-v0", "BatteryRo-v0", "BatteryJoint-v0", "BatteryQmaxPaper-v0", "BatteryRoPaper-v0")


def true_action(env):
    task = env.unwrapped.task
    return task.action_of({"q_mobile": task.now["q_mobile"], "r_o": task.now["r_o"]})[0]


@pytest.mark.parametrize("env_id", IDS)
def test_both_checkers_are_clean(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(env_id, render_mode="rgb_array").unwrapped
        check_env(env)
        check_env_sb3(env)


@pytest.mark.parametrize("env_id", IDS)
def test_the_true_parameter_costs_nothing_and_any_other_does(env_id):
    env = gym.make(env_id)
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(10):
            _, reward, terminated, truncated, info = env.step(true_action(env))
            assert not terminated and not truncated
            assert info["cost"] == pytest.approx(0.0, abs=1e-5)
            assert info["q_mobile"] == pytest.approx(info["q_mobile_hat"]) and info["r_o"] == pytest.approx(info["r_o_hat"])
        _, reward, *_, info = env.step(np.clip(true_action(env) + 0.2, -1.0, 1.0))
        assert info["cost"] > 1e-2 and reward == -info["cost"]


def test_ids_are_registered_once_and_work_from_anywhere():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        battery_env.register_environments()
        env = gym.make("battery_env:BatteryQmax-v0")
    assert env.spec.id == "BatteryQmax-v0"


@pytest.mark.parametrize(("env_id", "steps"), [("BatteryQmax-v0", 64), ("BatteryRo-v0", 64), ("BatteryQmaxPaper-v0", 16)])
def test_episodes_are_truncated_after_their_steps(env_id, steps):
    env = gym.make(env_id)
    env.reset(options={"trajectory": 0, "sample": int(env.unwrapped.dataset.first[0])})
    ends = [env.step(true_action(env))[2:4] for _ in range(steps)]
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
    env = gym.make("BatteryQmax-v0", initial_perturbation=10.0)
    scale = ERROR_SCALE
    draws = []
    for seed in range(20):
        env.reset(seed=seed)
        now = env.unwrapped.task.now
        draws.append((now["model_state"] - now["state"])[0, OBSERVED][:4] / scale[:4])
        assert now["model_state"][0, QNB:].sum() == pytest.approx(now["state"][0, QNB:].sum(), rel=1e-12)
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
