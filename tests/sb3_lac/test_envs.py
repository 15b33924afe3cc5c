"""The cost environments: their equations written out a second time, limits of parameters, and Gymnasium's contract."""

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env

from sb3_lac.envs import CartPoleCostEnv, LinearCostEnv, OscillatorEnv

IDS = ["CartPoleCost-v0", "LinearCost-v0", "Oscillator-v0"]
GAMMA = 0.95


@pytest.mark.parametrize("env_id", IDS)
def test_both_checkers_find_nothing(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, render_mode="rgb_array"))
        check_gymnasium_env(gym.make(env_id, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_reward_is_minus_the_cost(env_id):
    env = gym.make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        _, reward, _, _, info = env.step(env.action_space.sample())
        assert reward == -info["cost"] <= 0


@pytest.mark.parametrize("env_id", IDS)
def test_episode_ends_by_time_limit(env_id):
    env = gym.make(env_id, **({"noise_std": 0.0} if env_id == "LinearCost-v0" else {}))
    # Balanced, where anything can end before
    env.reset(seed=0, options={"state": np.zeros(len(env.unwrapped.state_names))})
    n_steps, truncated = 0, False
    while not truncated:
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        assert not terminated
        n_steps += 1
    assert n_steps == {"CartPoleCost-v0": 250, "LinearCost-v0": 100, "Oscillator-v0": 400}[env_id]


@pytest.mark.parametrize("make", [CartPoleCostEnv, LinearCostEnv, OscillatorEnv])
def test_same_seed_same_episode_after_pickling_and_copying(make):
    env = make()
    env.reset(seed=3)
    env.action_space.seed(3)
    actions = [env.action_space.sample() for _ in range(20)]
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = [env.step(action)[0] for action in actions]
    for twin in twins:
        np.testing.assert_array_equal([twin.step(action)[0] for action in actions], expected)


@pytest.mark.parametrize("make", [CartPoleCostEnv, LinearCostEnv, OscillatorEnv])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), scale=st.floats(0.0, 100.0))
def test_observations_stay_in_their_space_whatever_the_actions(make, seed, scale):
    env = make()
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(30):
        observation, reward, terminated, _, _ = env.step(scale * rng.standard_normal(env.action_space.shape))
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        if terminated:
            break


def test_cart_pole_accelerations_solve_the_equations_of_motion():
    # Lagrange's equations of cart and pole (a rod about its end), solved here as a linear system
    state, force = np.array([0.3, -0.4, 0.2, 0.7]), 6.0
    env = CartPoleCostEnv(cart_mass_kg=1.3, pole_mass_kg=0.2, pole_half_length_m=0.7)
    env.reset(options={"state": state})
    observation, *_ = env.step(np.array([force / 20.0]))
    m, mass, half, sine, cosine = 0.2, 1.5, 0.7, np.sin(0.2), np.cos(0.2)
    left = np.array([[mass, m * half * cosine], [cosine, 4.0 / 3.0 * half]])
    right = np.array([force + m * half * 0.7**2 * sine, 10.0 * sine])
    accelerations = np.linalg.solve(left, right)
    expected = state + 0.02 * np.array([-0.4, accelerations[0], 0.7, accelerations[1]])
    np.testing.assert_allclose(observation, expected, rtol=1e-6)


def test_cart_pole_costs():
    env = CartPoleCostEnv()
    env.reset(options={"state": [5.0, 0.0, 0.1, 0.0]})
    _, _, terminated, _, info = env.step(np.zeros(1))
    assert not terminated and info["cost"] == pytest.approx(0.25 + 20 * (0.1 / 0.349) ** 2)
    for start in ([9.99, 5.0, 0.0, 0.0], [0.0, 0.0, 0.34, 5.0]):
        env.reset(options={"state": start})
        _, reward, terminated, _, _ = env.step(np.zeros(1))
        assert terminated and reward == -100.0


def test_impulses_come_at_their_interval_in_both_directions():
    pushed = CartPoleCostEnv(impulse_N=100.0, impulse_interval=3)
    jumps = []
    for seed in range(12):
        pushed.reset(seed=seed, options={"state": np.zeros(4)})
        velocities = [pushed.step(np.zeros(1))[0][1] for _ in range(3)]
        assert velocities[:2] == [0.0, 0.0]
        jumps.append(velocities[2])
    assert min(jumps) == -max(jumps) < -1.0


def test_oscillator_follows_its_equations():
    env = OscillatorEnv()
    start = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    env.reset(options={"state": start})
    observation, _, _, _, info = env.step(np.array([-1.0, 0.0, 1.0]))
    # Each messenger is repressed by the protein before it: 3, 1, 2
    messengers = [m + 1.6 / (1 + p**2) - 0.16 * m + 5.0 * u for m, p, u in ((1, 6, 0.0), (2, 4, 0.5), (3, 5, 1.0))]
    proteins = [p + 0.16 * m - 0.06 * p for m, p in ((1, 4), (2, 5), (3, 6))]
    references = [8 + 7 * np.sin(2 * np.pi * t / 200) for t in (1, 2)]
    np.testing.assert_allclose(observation, [*messengers, *proteins, *references], rtol=1e-6)
    assert info["cost"] == pytest.approx((proteins[0] - references[0]) ** 2)


def test_oscillator_of_equal_species_rests_where_making_and_decay_balance():
    env = OscillatorEnv()
    # With equal species; others would oscillate around that
    observation, _ = env.reset(options={"state": [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]})
    for _ in range(3000):
        observation, *_ = env.step(-np.ones(3))
    messengers, proteins = observation[:3], observation[3:6]
    # p solves p = (translation / protein_decay) * (1 / messenger_decay) * 1.6 / (1 + p^2)
    p = np.roots([1.0, 0.0, 1.0, -0.16 / 0.06 * 1.6 / 0.16]).real[-1]
    np.testing.assert_allclose(proteins, p, rtol=1e-4)
    np.testing.assert_allclose(messengers, 0.06 / 0.16 * p, rtol=1e-4)


def linear_roll_outs(env, gain, n_episodes, n_steps):
    """States and costs of many roll-outs of the policy u = -K s, without the environment."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (n_episodes, 2))
    history, costs = [states], []
    for _ in range(n_steps):
        controls = -states @ gain.T
        costs.append(np.sum(states**2, axis=1) + np.sum(controls**2, axis=1))
        noise = env.noise_std * rng.standard_normal(states.shape)
        states = states @ env.A.T + controls @ env.B.T + noise
        history.append(states)
    return np.array(history), np.array(costs)


def test_linear_env_steps_and_costs_like_its_matrices():
    env = LinearCostEnv(noise_std=0.0)
    env.reset(options={"state": [0.5, -1.0]})
    observation, reward, *_ = env.step(np.array([0.5]))
    np.testing.assert_allclose(observation, [0.48 - 0.2, -0.1 - 0.96 + 0.5], rtol=1e-6)
    assert reward == pytest.approx(-(0.25 + 1.0 + 1.0))


def test_exact_value_is_the_mean_discounted_sum_of_costs():
    env = LinearCostEnv(noise_std=0.3)
    gain = np.array([[-0.1, 0.5]])
    states, costs = linear_roll_outs(env, gain, n_episodes=20_000, n_steps=300)
    sums = (GAMMA ** np.arange(300)[:, None] * costs).sum(axis=0)
    exact = env.cost_to_go(states[0], -states[0] @ gain.T, gain, GAMMA)
    for quarter in np.array_split(np.argsort(exact), 4):
        assert exact[quarter].mean() == pytest.approx(sums[quarter].mean(), rel=0.03)


def test_optimal_gain_is_where_the_exact_value_is_least():
    env = LinearCostEnv(noise_std=0.0)
    best = env.optimal_gain(GAMMA)
    values = {
        (i, j): np.trace(env.value_matrix(best + np.array([[i, j]]), GAMMA)) for i in (-0.1, 0, 0.1) for j in (-0.1, 0, 0.1)
    }
    assert min(values, key=values.get) == (0, 0)


def test_largest_feasible_alpha3_is_that_of_roll_outs():
    env = LinearCostEnv(noise_std=0.1)
    gain = env.optimal_gain(GAMMA)
    states, costs = linear_roll_outs(env, gain, n_episodes=5000, n_steps=100)
    values = np.array([env.cost_to_go(s, -s @ gain.T, gain, GAMMA) for s in states])
    expected = (values[:-1] - values[1:]).sum() / costs.sum()
    assert env.largest_feasible_alpha3(gain, GAMMA) == pytest.approx(expected, rel=0.05)


def test_without_noise_and_discount_all_of_the_cost_is_decrease():
    env = LinearCostEnv(noise_std=0.0)
    gamma = 1 - 1e-9
    assert env.largest_feasible_alpha3(env.optimal_gain(gamma), gamma, n_steps=400) == pytest.approx(1.0, abs=1e-5)


def test_value_of_a_gain_that_does_not_stabilise_is_refused():
    env = LinearCostEnv()
    with pytest.raises(ValueError, match="spectral radius"):
        env.value_matrix(np.array([[-5.0, -5.0]]), GAMMA)


@pytest.mark.parametrize(
    ("make", "kwargs", "message"),
    [
        (CartPoleCostEnv, {"cart_mass_kg": 0.0}, "cart_mass_kg=0.0 must be positive"),
        (CartPoleCostEnv, {"pole_half_length_m": np.nan}, "pole_half_length_m=nan must be positive"),
        (CartPoleCostEnv, {"impulse_N": -1.0}, "impulse_N=-1.0 must be finite and at least 0"),
        (OscillatorEnv, {"light": np.inf}, "light=inf must be positive and finite"),
        (OscillatorEnv, {"process_noise": -1.0}, "process_noise=-1.0 must be finite and at least 0"),
        (LinearCostEnv, {"noise_std": np.nan}, "noise_std=nan must be finite and at least 0"),
        (LinearCostEnv, {"control_max": 0.0}, "control_max=0.0 must be positive"),
        (LinearCostEnv, {"render_mode": "human"}, "render_mode='human' must be one of"),
    ],
)
def test_bad_arguments_are_named(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_bad_states_and_actions_are_named():
    env = LinearCostEnv()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1))
    for state in ([1.0], [np.nan, 0.0], [2000.0, 0.0]):
        with pytest.raises(ValueError, match="must hold 2 numbers"):
            env.reset(options={"state": state})
    with pytest.raises(ValueError, match="must hold 6 numbers"):
        OscillatorEnv().reset(options={"state": [-1.0] * 6})
    env.reset(seed=0)
    for action in (np.array([np.nan]), np.zeros(2), 0.5):
        with pytest.raises(ValueError, match="must be finite numbers"):
            env.step(action)


def test_picture_shows_the_episode():
    env = gym.make("Oscillator-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(env.action_space.sample())
    second = env.render()
    assert first.dtype == np.uint8 and first.shape == second.shape == (320, 480, 3)
    assert not np.array_equal(first, second)
