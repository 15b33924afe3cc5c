"""LAC solves what is known exactly, the linear-quadratic regulator: its losses to rounding, its networks nearly."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.envs import LinearCostEnv
from sb3_lac.lac import lyapunov_actor_loss, lyapunov_critic_loss, lyapunov_difference, lyapunov_target

GAMMA = 0.95


@pytest.fixture
def env():
    return LinearCostEnv(noise_std=0.0)


@pytest.fixture
def transitions(env):
    """States, controls, costs and next states of steps in the environment, with any controls."""
    rng = np.random.default_rng(0)
    rows = []
    for state, action in zip(rng.uniform(-1, 1, (100, 2)), rng.uniform(-1, 1, (100, 1)), strict=True):
        env.reset(options={"state": state})
        _, _, _, _, info = env.step(action)
        rows.append([*state, *(env.control_max * action), info["cost"], *env.state])
    return th.tensor(rows, dtype=th.float64).split([2, 1, 1, 2], dim=1)


def exact_value(env, gain):
    """L of the policy u = -K s, differentiable."""
    p, a, b = (th.as_tensor(matrix) for matrix in (env.value_matrix(gain, GAMMA), env.A, env.B))

    def value(states, controls):
        next_states = states @ a.T + controls @ b.T
        squares = (states**2).sum(dim=1) + (controls**2).sum(dim=1) + GAMMA * ((next_states @ p) * next_states).sum(dim=1)
        return squares[:, None]

    return value


def test_exact_value_is_the_fixed_point_of_the_critic(env, transitions):
    states, controls, costs, next_states = transitions
    for gain in (np.array([[-0.1, 0.5]]), env.optimal_gain(GAMMA)):
        value = exact_value(env, gain)
        np.testing.assert_allclose(
            value(states, controls)[:, 0], env.cost_to_go(states.numpy(), controls.numpy(), gain, GAMMA), rtol=1e-12
        )
        next_values = value(next_states, -next_states @ th.as_tensor(gain).T)
        targets = lyapunov_target(costs, th.zeros_like(costs), GAMMA, next_values)
        assert lyapunov_critic_loss([value(states, controls)], targets) < 1e-20
        assert lyapunov_critic_loss([1.01 * value(states, controls)], targets) > 1e-4


@pytest.mark.parametrize(("alpha3", "lambda_coef"), [(0.1, 1.0), (1.0, 0.3)])
def test_critic_and_actor_in_turns_end_at_the_optimal_policy(env, transitions, alpha3, lambda_coef):
    states, controls, costs, next_states = transitions
    gain, optimum = np.zeros((1, 2)), env.optimal_gain(GAMMA)
    traces = [np.trace(env.value_matrix(gain, GAMMA))]
    for _ in range(7):
        # The critic as exact as can be, then the actor that is best by its loss, which is quadratic in the gain
        value = exact_value(env, gain)

        def loss(flat_gain, value=value):
            difference = lyapunov_difference(
                value(next_states, -next_states @ flat_gain[:, None]), value(states, controls), costs, alpha3
            )
            return lyapunov_actor_loss(difference, th.zeros(1), th.tensor(lambda_coef), th.tensor(1.0))

        at = th.as_tensor(gain[0])
        gradient, curvature = th.autograd.functional.jacobian(loss, at), th.autograd.functional.hessian(loss, at)
        assert (th.linalg.eigvalsh(curvature) > 0).all()
        gain = (at - th.linalg.solve(curvature, gradient))[None].numpy()
        traces.append(np.trace(env.value_matrix(gain, GAMMA)))
    assert traces[0] > 1.5 * traces[-1]
    assert (np.diff(traces) < 1e-9).all()
    np.testing.assert_allclose(gain, optimum, rtol=1e-9)
    # where the actor has nothing left to gain
    assert gradient.abs().max() < 1e-9


@pytest.mark.slow
def test_networks_approach_the_exact_solution():
    model = LAC(
        "MlpPolicy",
        "LinearCost-v0",
        learning_rate=1e-3,
        learning_starts=500,
        gamma=GAMMA,
        target_entropy=-3.0,
        policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.LeakyReLU},
        device="cpu",
        seed=0,
    )
    env = LinearCostEnv()

    def evaluate():
        """Cost relative to the optimum, slope and correlation of L against the exact values."""
        report = evaluate_lyapunov(model, gym.make("LinearCost-v0"), n_eval_episodes=20, deterministic=True, seed=1)
        controls = env.control_max * model.predict(report.observations, deterministic=True)[0]
        gain = -np.linalg.lstsq(report.observations, controls, rcond=None)[0].T
        ratio = np.trace(env.value_matrix(gain, GAMMA)) / np.trace(env.value_matrix(env.optimal_gain(GAMMA), GAMMA))
        exact, learned = env.cost_to_go(report.observations, controls, gain, GAMMA), report.transitions["lyapunov"]
        return ratio, np.polyfit(exact, learned, 1)[0], np.corrcoef(exact, learned)[0, 1]

    ratio, slope, _ = evaluate()
    assert ratio > 2.5 and slope < 0.2
    model.learn(2500)
    ratio, slope, correlation = evaluate()
    # What one seed learns differs from processor to processor as from seed to seed. Five seeds reached 1.01 to 1.30,
    # 0.80 to 0.89 and 0.970 to 0.998: the limits are twice that range beyond the worst.
    assert 1.0 <= ratio < 2.0
    assert 0.6 < slope < 1.3
    assert correlation > 0.9
