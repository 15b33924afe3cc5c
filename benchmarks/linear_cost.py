"""
Is the learned L right, and is the certificate honest? LAC on ``LinearCost-v0``, where the exact answers are known.

.. code-block:: bash

  python -m benchmarks.linear_cost

The policy is compared with the Riccati solution; L with the exact cost-to-go of the policy that was learned; and the largest
feasible alpha3 that ``evaluate_lyapunov`` measures with the exact one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.plotting import new_figure
from benchmarks.study import EVALUATION_SEED, Study, Tables, command_line, markdown, natural, positive
from benchmarks.training import train_or_load
from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.envs import LinearCostEnv

_ENV_ID = "LinearCost-v0"


def linear_gain(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """
    The linear policy closest to what was done.

    :param states: shape (n, 2)
    :param controls: shape (n, 1)
    :return: K of ``u = -K s`` by least squares, shape (1, 2)
    """
    return -np.linalg.lstsq(states, controls, rcond=None)[0].T


def part(seed: int, timesteps: int, episodes: int, models: Path) -> Tables:
    """
    Train one policy, and compare it with the exact solution.

    :param seed: seed of the training
    :param timesteps: environment steps
    :param episodes: episodes of the evaluation
    :param models: where trained policies are kept
    :return: ``linear_cost``: what was learned and what is exact; ``values``: L and the exact cost-to-go of visited states
    """
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
    row = {
        "seed": seed,
        "gain_position": gain[0, 0],
        "gain_velocity": gain[0, 1],
        "gain_position_exact": best[0, 0],
        "gain_velocity_exact": best[0, 1],
        # of the policies themselves, from the start distribution of the environment
        "cost_over_optimum": np.trace(env.value_matrix(gain, model.gamma)) / np.trace(env.value_matrix(best, model.gamma)),
        "value_slope": slope,
        "value_intercept": intercept,
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
    """
    Learned against exact values, one panel per seed.

    :param values: columns seed, exact, learned
    :return: the figure
    """
    seeds = values["seed"].unique()
    figure = new_figure(2.8 * len(seeds), 2.9)
    top = values[["exact", "learned"]].to_numpy().max()
    for axes, (seed, of_seed) in zip(
        figure.subplots(1, len(seeds), squeeze=False, sharey=True)[0], values.groupby("seed"), strict=True
    ):
        axes.plot([0, top], [0, top], color="0.6", lw=1)
        axes.scatter(of_seed["exact"], of_seed["learned"], s=5, alpha=0.3, lw=0, rasterized=True)
        axes.set(title=f"seed {seed}", xlabel="exact cost-to-go")
    figure.axes[0].set_ylabel("learned L(s, a)")
    return figure


def report(table: pd.DataFrame) -> str:
    """
    Learned and exact values side by side, as Markdown.

    :param table: one row per seed, see :func:`part`
    :return: one table
    """
    rows = [
        {
            "seed": f"{row['seed']:.0f}",
            "gain K (exact)": f"{row['gain_position']:.3f}, {row['gain_velocity']:.3f} "
            f"({row['gain_position_exact']:.3f}, {row['gain_velocity_exact']:.3f})",
            "cost / optimum": f"{row['cost_over_optimum']:.4f}",
            "L against exact: slope, intercept, correlation": f"{row['value_slope']:.3f}, {row['value_intercept']:.3f}, "
            f"{row['value_correlation']:.4f}",
            "largest feasible alpha3, 95 % interval (exact)": f"{row['alpha3']:.3f}, {row['alpha3_low']:.3f} to "
            f"{row['alpha3_high']:.3f} ({row['alpha3_exact']:.3f}; optimal policy {row['alpha3_optimum']:.3f})",
        }
        for _, row in table.iterrows()
    ]
    return markdown(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = command_line("linear_cost", __doc__)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=positive, default=10_000, help="environment steps of each training")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes of the evaluation")
    study = Study(parser, arguments)
    chosen = study.chosen
    parts = [{"seed": seed, "timesteps": chosen.timesteps, "episodes": chosen.episodes} for seed in chosen.seeds]
    tables = study.run(part, parts, models=study.out / "models")
    table = tables["linear_cost"]
    study.write({"linear_cost": table}, {"linear_cost": plot(tables["values"])}, report(table))


if __name__ == "__main__":
    main()
