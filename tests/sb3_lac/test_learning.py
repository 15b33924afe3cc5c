"""LAC learns what is known exactly: the linear-quadratic regulator."""

import gymnasium as gym
import numpy as np
import pytest
from torch import nn

from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.envs import LinearCostEnv

GAMMA = 0.95


@pytest.mark.slow
def test_policy_value_and_certificate_approach_the_exact_solution():
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
        """Cost relative to the optimum, slope and correlation of L against the exact values, error of alpha3."""
        report = evaluate_lyapunov(model, gym.make("LinearCost-v0"), n_eval_episodes=20, deterministic=True, seed=1)
        controls = env.control_max * model.predict(report.observations, deterministic=True)[0]
        gain = -np.linalg.lstsq(report.observations, controls, rcond=None)[0].T
        ratio = np.trace(env.value_matrix(gain, GAMMA)) / np.trace(env.value_matrix(env.optimal_gain(GAMMA), GAMMA))
        exact, learned = env.cost_to_go(report.observations, controls, gain, GAMMA), report.transitions["lyapunov"]
        alpha3_error = report.metrics["largest_feasible_alpha3"].value - env.largest_feasible_alpha3(gain, GAMMA)
        return ratio, np.polyfit(exact, learned, 1)[0], np.corrcoef(exact, learned)[0, 1], alpha3_error

    before = evaluate()
    assert before[0] > 1.5 and before[1] < 0.2
    model.learn(2500)
    ratio, slope, correlation, alpha3_error = evaluate()
    assert 1.0 <= ratio < 1.3
    assert 0.6 < slope < 1.3
    assert correlation > 0.95
    assert abs(alpha3_error) < 0.4
