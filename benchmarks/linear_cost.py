"""
Is the learned L right, and is the certificate honest? LAC on ``LinearCost-v0``, where the exact answers are known.

.. code-block:: bash

  python -m benchmarks.linear_cost

The policy is compared with the Riccati solution, in roll-outs that both share, and by the linear policy closest to it; L is
compared with the exact cost-to-go of that linear policy without noise, and the largest feasible alpha3 that
``evaluate_lyapunov`` measures with the exact one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from scipy.stats import bootstrap
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PolicyPredictor

from benchmarks.study import (
    EVALUATION_SEED,
    Cell,
    Study,
    Tables,
    command_line,
    markdown,
    natural,
    positive,
    row_by_row,
)
from benchmarks.training import Recipe, train_or_load
from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.envs import LinearCostEnv
from sb3_lac.stability.loop import closed_loop

_ENV_ID = "LinearCost-v0"


def linear_gain(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """The linear policy closest to what was done."""
    return -np.linalg.lstsq(states, controls, rcond=None)[0].T


def noise_cost(gain: np.ndarray, gamma: float) -> float:
    """
    What noise adds to the exact value of every state and control, under the policy ``u = -K s``.

    :param gain: K
    :param gamma: The discount factor, below 1
    """
    env = LinearCostEnv()
    return gamma / (1 - gamma) * env.noise_std**2 * np.trace(env.value_matrix(gain, gamma))


class LinearPolicy:
    """The policy ``u = -K s``."""

    def __init__(self, gain: np.ndarray) -> None:
        self.gain = gain

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        """Predict actions as Stable-Baselines3 does."""
        return -observation @ self.gain.T, None


def episode_costs(policy: PolicyPredictor, episodes: int) -> np.ndarray:
    """The costs of a policy, a column for each episode, with the same starts and noise for each policy."""
    with closed_loop(policy, make_vec_env(_ENV_ID, n_envs=episodes), None, episodes, seed=EVALUATION_SEED) as loop:
        transitions = loop.roll_out(episodes).transitions
    return transitions.pivot(index="step", columns="episode", values="cost").to_numpy()


def over_optimum(costs: np.ndarray, optimal: np.ndarray, gamma: float) -> tuple[float, float, float]:
    """What a policy costs over what the best one does."""
    weights = gamma ** np.arange(len(costs))

    def ratio(policy: np.ndarray, best: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean(policy, axis=axis) / np.mean(best, axis=axis)

    sums = (weights @ costs, weights @ optimal)
    resampled = bootstrap(
        sums, ratio, paired=True, vectorized=True, method="percentile", random_state=np.random.default_rng(0)
    ).confidence_interval
    return float(ratio(*sums)), float(resampled.low), float(resampled.high)


def part(seed: int, timesteps: int, episodes: int, models: Path) -> Tables:
    """Train one policy, and compare it with the exact solution."""
    model = train_or_load(Recipe.of("lac", _ENV_ID, seed, timesteps), models / f"seed{seed}")
    assert isinstance(model, LAC)
    env = LinearCostEnv()
    measured = evaluate_lyapunov(model, gym.make(_ENV_ID), n_episodes=episodes, deterministic=True, seed=EVALUATION_SEED)
    states = measured.observations
    assert states is not None
    actions, _ = model.predict(states.astype(np.float32), deterministic=True)
    gain, best = linear_gain(states, env.control_max * actions), env.optimal_gain(model.gamma)
    exact = env.cost_to_go(states, env.control_max * actions, gain, model.gamma)
    learned = measured.transitions["lyapunov"].to_numpy()
    slope, intercept = np.polyfit(exact, learned, 1)
    # What the noise of the steps adds to all values
    intercept_exact = noise_cost(gain, model.gamma)
    rolled_out = episode_costs(model, episodes)
    ratios: dict[str, float] = {}
    for name, gamma in (("discounted", model.gamma), ("per_step", 1.0)):
        optimal = episode_costs(LinearPolicy(env.optimal_gain(gamma) / env.control_max), episodes)
        ratio, low, high = over_optimum(rolled_out, optimal, gamma)
        ratios |= {f"{name}_over_optimum": ratio, f"{name}_over_optimum_low": low, f"{name}_over_optimum_high": high}
    row = {
        "seed": seed,
        # of the policies as they are, in roll-outs
        **ratios,
        "gain_position": gain[0, 0],
        "gain_velocity": gain[0, 1],
        "gain_position_exact": best[0, 0],
        "gain_velocity_exact": best[0, 1],
        # of the linear policies closest to them, exactly, from the start distribution of the environment
        "linear_over_optimum": np.trace(env.value_matrix(gain, model.gamma)) / np.trace(env.value_matrix(best, model.gamma)),
        "value_slope": slope,
        "value_intercept": intercept,
        "value_intercept_exact": intercept_exact,
        "value_correlation": np.corrcoef(exact, learned)[0, 1],
        "calibration_slope": measured.to_frame().loc["calibration_slope", "value"],
        "alpha3": measured.to_frame().loc["largest_feasible_alpha3", "value"],
        "alpha3_low": measured.to_frame().loc["largest_feasible_alpha3", "low"],
        "alpha3_high": measured.to_frame().loc["largest_feasible_alpha3", "high"],
        "alpha3_exact": env.largest_feasible_alpha3(gain, model.gamma),
        "alpha3_optimum": env.largest_feasible_alpha3(best, model.gamma),
    }
    values = pd.DataFrame({"seed": seed, "exact": exact, "learned": learned})
    return {"linear_cost": pd.DataFrame([row]), "values": values}


def report(table: pd.DataFrame) -> str:
    """Learned and exact values side by side, as Markdown."""
    cells: dict[str, Cell] = {
        "seed": "{seed:.0f}",
        "gain K (exact)": "{gain_position:.3f}, {gain_velocity:.3f} " "({gain_position_exact:.3f}, {gain_velocity_exact:.3f})",
        "discounted cost / optimum, 95 % interval": "{discounted_over_optimum:.3f}, "
        "{discounted_over_optimum_low:.3f} to {discounted_over_optimum_high:.3f}",
        "cost per step / optimum": "{per_step_over_optimum:.3f}",
        "of the closest linear policy, exactly": "{linear_over_optimum:.4f}",
        "L against exact: slope, intercept, correlation": "{value_slope:.3f}, {value_intercept:.3f}, {value_correlation:.4f}",
        "exact intercept": "{value_intercept_exact:.3f}",
        "largest feasible alpha3, 95 % interval (exact)": "{alpha3:.3f}, {alpha3_low:.3f} to {alpha3_high:.3f} "
        "({alpha3_exact:.3f}; optimal policy {alpha3_optimum:.3f})",
    }
    return markdown(row_by_row(table, cells))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("linear_cost", __doc__)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=positive, default=15_000, help="environment steps of each training")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes of the evaluation")
    study = Study(parser, arguments)
    chosen = study.chosen
    parts = [{"seed": seed, "timesteps": chosen.timesteps, "episodes": chosen.episodes} for seed in chosen.seeds]
    tables = study.run(part, parts, models=study.out / "models")
    study.write(tables, {}, report(tables["linear_cost"]))


if __name__ == "__main__":
    main()
