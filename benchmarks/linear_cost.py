"""
Is the learned L right, and is the certificate honest? LAC on ``LinearCost-v0``, where the exact answers are known.

.. code-block:: bash

  python -m benchmarks.linear_cost

The policy is compared with the Riccati solution, in roll-outs that both share, and by the linear policy closest to it; L is
compared with the exact cost-to-go of that linear policy, and with what noise makes of it (that of the steps, that of the
exploration, and the bias of a root of L that both bring), and the largest feasible alpha3 that ``evaluate_lyapunov`` measures
with the exact one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import bootstrap
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.study import EVALUATION_SEED, Study, Tables, command_line, markdown, natural, new_panels, positive
from benchmarks.training import train_or_load
from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.envs import LinearCostEnv

_ENV_ID = "LinearCost-v0"


def linear_gain(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """The linear policy closest to what was done."""
    return -np.linalg.lstsq(states, controls, rcond=None)[0].T


def learned_values(
    states: np.ndarray, controls: np.ndarray, gain: np.ndarray, gamma: float, power: float, control_std: float
) -> np.ndarray:
    """
    What noise makes of L, to second order: the fixed point of its root, in a loop whose controls vary by ``control_std``.

    :param states: Shape (n, 2)
    :param controls: Controls now, shape (n, 1)
    :param gain: K of the policy ``u = -K s``, to whose controls the noise is added from the next step on
    :param gamma: The discount factor, below 1
    :param power: Power of the root
    :param control_std: Standard deviation of the controls
    :return: Shape (n,)
    """
    env = LinearCostEnv()
    # State and control z = (s, u), whose value is z^T H z + const, go to F z + noise of the covariance W
    policy = np.vstack([np.eye(2), -gain])
    step = np.hstack([env.A, env.B])
    loop, covariance = policy @ step, env.noise_std**2 * policy @ policy.T
    covariance[2, 2] += control_std**2
    h = np.diag([*np.diag(env.Q), *np.diag(env.R)]) + gamma * step.T @ env.value_matrix(gain, gamma) @ step
    constant = gamma / (1 - gamma) * np.trace(h @ covariance)
    z = np.hstack([states, controls])
    moments = z[:, :, None] * z[:, None, :]
    values = np.einsum("ij,nij->n", h, moments) + constant
    # b = (1 - p) / 2 Var y / E y + gamma E b', along the loop's second moments. What is left in the end is a fraction
    for weight in gamma ** np.arange(round(10 / (1 - gamma))):
        mean = np.einsum("ij,nij->n", h, moments) + constant
        moments = loop @ moments @ loop.T
        variance = gamma**2 * np.einsum("ij,nij->n", h @ covariance @ h, 4 * moments + 2 * covariance)
        values -= weight * (1 - power) / 2 * variance / mean
        moments += covariance
    return values


def _linear_actions(gain: np.ndarray, observations: np.ndarray) -> np.ndarray:
    return -observations @ gain.T


def episode_costs(act: Callable[[np.ndarray], np.ndarray], episodes: int) -> np.ndarray:
    """The costs of a policy, with the same starts and noise for each."""
    env = make_vec_env(_ENV_ID, n_envs=episodes, seed=EVALUATION_SEED)
    observations, dones, costs = env.reset(), np.zeros(episodes, dtype=bool), []
    while not dones.any():
        assert isinstance(observations, np.ndarray)
        observations, rewards, dones, _ = env.step(act(observations))
        costs.append(-rewards)
    return np.array(costs)


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
    model = train_or_load("lac", _ENV_ID, seed, timesteps, models / f"seed{seed}")
    assert isinstance(model, LAC)
    env = LinearCostEnv()
    measured = evaluate_lyapunov(model, gym.make(_ENV_ID), n_eval_episodes=episodes, deterministic=True, seed=EVALUATION_SEED)
    states = measured.observations
    assert states is not None
    actions, _ = model.predict(states.astype(np.float32), deterministic=True)
    gain, best = linear_gain(states, env.control_max * actions), env.optimal_gain(model.gamma)
    exact = env.cost_to_go(states, env.control_max * actions, gain, model.gamma)
    learned = measured.transitions["lyapunov"].to_numpy()
    slope, intercept = np.polyfit(exact, learned, 1)
    # The policy that L is learned of explores
    explored = model.predict(states.astype(np.float32), deterministic=False)[0] - actions
    spread = env.control_max * float(np.sqrt(np.mean(np.square(explored))))
    predicted = learned_values(states, env.control_max * actions, gain, model.gamma, model.critic.power, spread)
    noise_slope, noise_intercept = np.polyfit(exact, predicted, 1)
    rolled_out = episode_costs(lambda observed: model.predict(observed, deterministic=True)[0], episodes)
    ratios: dict[str, float] = {}
    for name, gamma in (("discounted", model.gamma), ("per_step", 1.0)):
        optimal = episode_costs(partial(_linear_actions, env.optimal_gain(gamma) / env.control_max), episodes)
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
        "control_std": spread,
        "value_slope_by_noise": noise_slope,
        "value_intercept_by_noise": noise_intercept,
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


def plot(values: pd.DataFrame) -> Figure:
    """Learned against exact values, one panel per seed, five in a row."""
    seeds = values["seed"].unique()
    figure, panels = new_panels(len(seeds), 5, (2.8, 2.9), sharex=True, sharey=True)
    top = values[["exact", "learned"]].to_numpy().max()
    for axes, (seed, of_seed) in zip(panels, values.groupby("seed"), strict=True):
        axes.plot([0, top], [0, top], color="0.6", lw=1)
        axes.scatter(of_seed["exact"], of_seed["learned"], s=5, alpha=0.3, lw=0, rasterized=True)
        axes.set_title(f"seed {seed}")
    figure.supxlabel("exact cost-to-go")
    figure.supylabel("learned L(s, a)")
    return figure


def report(table: pd.DataFrame) -> str:
    """Learned and exact values side by side, as Markdown."""
    rows = [
        {
            "seed": f"{row['seed']:.0f}",
            "gain K (exact)": f"{row['gain_position']:.3f}, {row['gain_velocity']:.3f} "
            f"({row['gain_position_exact']:.3f}, {row['gain_velocity_exact']:.3f})",
            "discounted cost / optimum, 95 % interval": f"{row['discounted_over_optimum']:.3f}, "
            f"{row['discounted_over_optimum_low']:.3f} to {row['discounted_over_optimum_high']:.3f}",
            "cost per step / optimum": f"{row['per_step_over_optimum']:.3f}",
            "of the closest linear policy, exactly": f"{row['linear_over_optimum']:.4f}",
            "L against exact: slope, intercept, correlation": f"{row['value_slope']:.3f}, {row['value_intercept']:.3f}, "
            f"{row['value_correlation']:.4f}",
            "as noise predicts: slope, intercept": f"{row['value_slope_by_noise']:.3f}, {row['value_intercept_by_noise']:.3f}",
            "largest feasible alpha3, 95 % interval (exact)": f"{row['alpha3']:.3f}, {row['alpha3_low']:.3f} to "
            f"{row['alpha3_high']:.3f} ({row['alpha3_exact']:.3f}; optimal policy {row['alpha3_optimum']:.3f})",
        }
        for _, row in table.iterrows()
    ]
    return markdown(rows)


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
    table = tables["linear_cost"]
    study.write({"linear_cost": table}, {"linear_cost": plot(tables["values"])}, report(table))


if __name__ == "__main__":
    main()
