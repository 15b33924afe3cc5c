"""
What studies of control problems share: disturbances, roll-outs that all policies are judged by, loops that settle and loops
that do not, and certificates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PolicyPredictor

from benchmarks.study import EVALUATION_SEED
from sb3_lac import certify, evaluate_lyapunov, fit_lyapunov
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.envs import CostEnv, reference_controller
from sb3_lac.stability import CriticLyapunov
from sb3_lac.stability.rollout import SETTLED_SHARE

#: By environment: its impulse, parameters that are not as they should be, noise on states, noise on observations, delay.
DISTURBANCES: dict[str, tuple[float, dict[str, float], float, float, int]] = {
    "LinearCost-v0": (5.0, {"control_max": 1.0}, 0.03, 0.1, 2),
    "CartPoleCost-v0": (100.0, {"pole_half_length_m": 1.0}, 0.01, 0.02, 2),
    "Oscillator-v0": (3.0, {"protein_decay": 0.05}, 0.1, 0.1, 1),
    "PendulumCost-v0": (10.0, {"mass_kg": 1.4}, 0.01, 0.03, 2),
    "QuadrotorCost-v0": (50.0, {"mass_kg": 1.2}, 0.01, 0.03, 2),
    "VehicleCost-v0": (20_000.0, {"friction": 0.5}, 0.01, 0.03, 2),
}
#: Steps between impulses: no episode ends within 15 steps after one.
IMPULSE_INTERVAL = 85
#: Shares of episodes, with their titles in tables: the error at the end is within the tolerance, or within a part of that at
#: the start.
SHARES = {
    "at_goal": "at the goal",
    "within_1_percent": "within 1 % of the start",
    "within_0.1_percent": "within 0.1 %",
}
#: Factors of the actions of a reference controller, by name of the loop.
FACTORS = {"reference": 1.0, "weak": 0.5, "too weak": 0.15, "wrong sign": -1.0}
#: The linear problem is stable by itself: with 15 % of the gain it settles, and with the wrong sign of -14 % hardly leaves.
LINEAR_FACTORS = {"reference": 1.0, "weak": 0.15, "hardly unstable": -0.14, "wrong sign": -1.0}
#: What is certified, see ``sb3_lac.certify``.
STATEMENTS = ("survives", "stays_within", "decreases")
#: Environments of a certificate, which an equal number of episodes each start in.
CERTIFICATE_ENVS = 25
#: Episodes of a point of a learning curve.
CURVE_EPISODES = 30
# no training seed comes close; environments count up from each
_FIT_SEED, _JUDGE_SEED, _CERTIFICATION_SEED, _CURVE_SEED = 10_000, 20_000, 30_000, 40_000


def conditions(env_id: str) -> dict[str, dict[str, Any]]:
    """The disturbances that a controller is tried with, one at a time, and none."""
    return {"none": {}, **one_at_a_time(*DISTURBANCES[env_id])}


def one_at_a_time(
    impulse: float, changed: dict[str, float], process_noise: float, observation_noise: float, delay: int
) -> dict[str, dict[str, Any]]:
    """Arguments of an environment for each of its disturbances by itself."""
    return {
        "impulses": {"impulse": impulse, "impulse_interval": IMPULSE_INTERVAL},
        "other parameters": {"changed_parameters": changed},
        "process noise": {"process_noise": process_noise},
        "observation noise": {"observation_noise": observation_noise},
        "action delay": {"action_delay": delay},
    }


def roll_out(
    policy: PolicyPredictor,
    make_env: Callable[[], gym.Env[Any, Any]],
    episodes: int,
    seed: int = EVALUATION_SEED,
) -> pd.DataFrame:
    """Run the mean action of a policy in all episodes at once, one row each; a cost is minus the mean reward of a step."""
    envs = [make_env() for _ in range(episodes)]
    starts = [env.reset(seed=seed + episode) for episode, env in enumerate(envs)]
    observations = np.array([observation for observation, _ in starts])
    errors_at_start = [info.get("error", np.nan) for _, info in starts]
    costs, errors = np.zeros(episodes), np.zeros(episodes)
    lengths, died = np.zeros(episodes, dtype=int), np.zeros(episodes, dtype=bool)
    running = np.arange(episodes)
    while len(running) > 0:
        actions, _ = policy.predict(observations[running], deterministic=True)
        going_on = []
        for episode, action in zip(running, actions, strict=True):
            observations[episode], reward, terminated, truncated, info = envs[episode].step(action)
            costs[episode] -= float(reward)
            errors[episode] = info.get("error", np.nan)
            lengths[episode] += 1
            died[episode] = terminated
            if not (terminated or truncated):
                going_on.append(episode)
        running = np.array(going_on, dtype=int)
    return pd.DataFrame(
        {"cost": costs / lengths, "length": lengths, "error_at_start": errors_at_start, "error": errors, "died": died}
    )


def shares_of(outcome: pd.DataFrame, tolerance: float) -> dict[str, float]:
    """The shares of the episodes of a roll-out that end at the goal, and that go a part of the way; the dead have not."""
    remaining = (outcome["error"] / outcome["error_at_start"]).where(~outcome["died"], np.inf)
    return {
        "at_goal": ((outcome["error"] <= tolerance) & ~outcome["died"]).mean(),
        "within_1_percent": (remaining <= 0.01).mean(),
        "within_0.1_percent": (remaining <= 0.001).mean(),
    }


def summary(outcome: pd.DataFrame, tolerance: float) -> dict[str, float]:
    """Summarise the costs of the episodes of a roll-out, and where they end."""
    return {
        "cost": outcome["cost"].mean(),
        "cost_worst": outcome["cost"].max(),
        "error_median": outcome["error"].median(),
        "error_worst": outcome["error"].max(),
        "tolerance": tolerance,
        **shares_of(outcome, tolerance),
        "died": outcome["died"].mean(),
    }


def tried_with(
    policy: PolicyPredictor,
    env_id: str,
    episodes: int,
    arguments: Mapping[str, Any],
    make: Callable[..., Any] = gym.make,
    seed: int = EVALUATION_SEED,
) -> dict[str, float]:
    """Try a policy in an environment that is made with some arguments."""
    problem = gym.make(env_id).unwrapped
    assert isinstance(problem, CostEnv)
    return summary(roll_out(policy, partial(make, env_id, **arguments), episodes, seed), problem.error_tolerance)


def while_training(policy: PolicyPredictor, env_id: str, arguments: Mapping[str, Any]) -> dict[str, float]:
    """Judge a policy for its learning curve, in episodes with other starts than those of all other judgements."""
    outcome = tried_with(policy, env_id, CURVE_EPISODES, arguments, seed=_CURVE_SEED)
    return {name: outcome[name] for name in ("cost", "at_goal")}


def tried(policy: PolicyPredictor, env_id: str, episodes: int) -> pd.DataFrame:
    """Try a policy under all conditions, and return one row each."""
    rows = []
    for condition, arguments in conditions(env_id).items():
        text = ", ".join(f"{name}={value}" for name, value in arguments.items())
        described = {"disturbance": condition, "arguments": text}
        rows.append(described | tried_with(policy, env_id, episodes, arguments))
    return pd.DataFrame(rows)


class ScaledController:
    """A controller whose actions are multiplied by a factor of -1 .. 1."""

    def __init__(self, controller: PolicyPredictor, factor: float) -> None:
        self.controller, self.factor = controller, factor

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Predict actions as Stable-Baselines3 does."""
        actions, state = self.controller.predict(observation, state, episode_start, deterministic)
        return self.factor * actions, state


def controllers(env_id: str) -> dict[str, PolicyPredictor]:
    """Controllers that settle, and controllers that do not."""
    reference = reference_controller(gym.make(env_id))
    factors = LINEAR_FACTORS if env_id == "LinearCost-v0" else FACTORS
    return {name: ScaledController(reference, factor) for name, factor in factors.items()}


def judge(policy: PolicyPredictor, env_id: str, episodes: int) -> pd.DataFrame:
    """Fit, evaluate and certify one policy; for LAC, the critic beside the fitted function."""
    env = make_vec_env(env_id, n_envs=CERTIFICATE_ENVS)
    fitted = fit_lyapunov(policy, env, n_episodes=episodes, seed=_FIT_SEED, progress_bar=False)
    certification = certify(policy, env, lyapunov=fitted, n_episodes=episodes, seed=_CERTIFICATION_SEED)
    functions = {"fitted": fitted} | ({"critic": CriticLyapunov(policy)} if isinstance(policy, CostAlgorithm) else {})
    rows = []
    for function, lyapunov in functions.items():
        report = evaluate_lyapunov(policy, env, n_episodes=episodes, seed=_JUDGE_SEED, lyapunov=lyapunov)
        row: dict[str, Any] = {"function": function, "holds": report.holds}
        settled_below = SETTLED_SHARE * report.metrics["start_cost"].value
        row["settles"] = report.holds and report.metrics["cost_bound"].high < settled_below
        for metric, (value, low, high) in report.metrics.items():
            row |= {metric: value, f"{metric}_low": low, f"{metric}_high": high}
        if function == "fitted":
            bounds = certification.statements["at_least"]
            row |= {f"{statement}_at_least": bounds.get(statement, np.nan) for statement in STATEMENTS}
            row |= {"settles_within": certification.ultimate_bound, "window_steps": certification.window_steps}
        rows.append(row)
    env.close()
    return pd.DataFrame(rows)
