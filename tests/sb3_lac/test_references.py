"""The reference controllers: a yardstick must be right before anything is measured with it."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_lac.envs import LinearCostEnv, OscillatorEnv, PendulumCostEnv, VehicleCostEnv, reference_controller

IDS = ["CartPoleCost-v0", "LinearCost-v0", "Oscillator-v0", "PendulumCost-v0", "QuadrotorCost-v0", "VehicleCost-v0"]


@pytest.mark.parametrize("env_id", IDS)
@settings(max_examples=10)
@given(seed=st.integers(0, 1000))
def test_a_batch_is_its_rows(env_id, seed):
    env = gym.make(env_id)
    controller = reference_controller(env)
    rng = np.random.default_rng(seed)
    observations = np.array([env.reset(seed=int(rng.integers(2**31)))[0] for _ in range(3)])
    actions, state = controller.predict(observations)
    assert state is None and actions.dtype == np.float32 and actions.shape == (3, *env.action_space.shape)
    for observation, action in zip(observations, actions, strict=True):
        assert env.action_space.contains(action)
        np.testing.assert_allclose(controller.predict(observation, deterministic=False)[0], action, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(controller)).predict(observations)[0], actions)


def test_on_the_linear_problem_it_is_the_exact_optimum():
    env = LinearCostEnv(noise_std=0.0)
    controller = reference_controller(env)
    start = np.array([0.3, -0.4])
    p = env.value_matrix(env.optimal_gain(), 1.0)
    env.reset(options={"state": start})
    observation, total = start, 0.0
    for _ in range(300):
        observation, reward, *_ = env.step(controller.predict(observation)[0])
        total -= reward
    assert total == pytest.approx(start @ p @ start, rel=1e-5)


def test_the_first_protein_meets_its_reference_as_soon_as_light_can_reach_it():
    env = OscillatorEnv()
    controller = reference_controller(env)
    # Repressed by the third protein, and with light enough
    observation, _ = env.reset(options={"state": [3.0, 0.0, 5.0, 8.0, 0.0, 50.0]})
    for _ in range(2):
        observation, *_, info = env.step(controller.predict(observation)[0])
    assert info["error"] < 1e-4


def test_the_car_stays_on_its_path_once_it_is_there():
    env = TimeLimit(VehicleCostEnv(), 300)
    controller = reference_controller(env)
    start = [0.0, *(controller.on_path.T @ [0.0, 1.0])[1:], 0.0]
    observation, _ = env.reset(options={"state": start})
    errors = []
    for _ in range(300):
        observation, *_, info = env.step(controller.predict(observation)[0])
        errors.append(info["error"])
    # A hundredth of what the same car does with the regulator alone
    controller.command = 0.0 * controller.command
    controller.on_path = 0.0 * controller.on_path
    observation, _ = env.reset(options={"state": start})
    worst = 0.0
    for _ in range(300):
        observation, *_, info = env.step(controller.predict(observation)[0])
        worst = max(worst, info["error"])
    assert max(errors) < 0.01 and worst > 10 * max(errors)


def test_it_knows_the_parameters_and_not_their_changes():
    usual = reference_controller(PendulumCostEnv())
    known = reference_controller(PendulumCostEnv(mass_kg=2.0))
    surprised = reference_controller(PendulumCostEnv(changed_parameters={"mass_kg": 2.0}, impulse=1.0))
    np.testing.assert_array_equal(surprised.gain, usual.gain)
    assert not np.allclose(known.gain, usual.gain, rtol=0.1)


def test_other_environments_and_observations_are_refused():
    with pytest.raises(ValueError, match="has no reference controller: it must be one of"):
        reference_controller(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="wrapper that changes observations or actions"):
        reference_controller(NormalizeObservation(gym.make("PendulumCost-v0")))
    controller = reference_controller(gym.make("PendulumCost-v0"))
    for observation in (np.zeros(2), np.zeros((4, 2)), np.zeros((2, 2, 3)), 0.0):
        with pytest.raises(ValueError, match="observation has shape"):
            controller.predict(observation)
    with pytest.raises(ValueError, match="observation is a dict"):
        controller.predict({"theta": np.zeros(3)})
