"""
In which metric LAC's critic should learn, and how many critics there should be: designs beside each other on the six cost
environments, all with one common setting that was tuned for none of them.

.. code-block:: bash

  python -m benchmarks.critics --designs quarter_two half_two --seeds 100 101 102 103 104

Policies are judged by their mean action, from other starts than those of the published tables. The update is compiled once for
each environment and design, and serves all seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn

from benchmarks.control import DISTURBANCES, roll_out, shares_of
from benchmarks.study import Study, Tables, command_line, markdown, natural, positive, with_interval
from sb3_lac import LAC
from sb3_lac.envs import CostEnv

_STARTS = 20_000  # seed of the episodes that designs are judged by


#: Algorithm, arguments of its policy and its own.
DESIGNS: dict[str, tuple[type[OffPolicyAlgorithm], dict[str, Any], dict[str, Any]]] = {
    "LAC": (LAC, {}, {}),
    "SAC": (SAC, {}, {}),
    "alpha3_0.3": (LAC, {}, {"alpha3": 0.3}),
    "alpha3_0.03": (LAC, {}, {"alpha3": 0.03}),
    "alpha3_0.003": (LAC, {}, {"alpha3": 0.003}),
}


def _set_back(model: LAC, fresh: LAC, seed: int) -> None:
    """Give a model, in place, the parameters that another one starts with, so that its compiled update serves both."""
    model.policy.load_state_dict(fresh.policy.state_dict())
    with th.no_grad():
        model.log_lambda.copy_(fresh.log_lambda)
        assert model.log_ent_coef is not None and fresh.log_ent_coef is not None
        model.log_ent_coef.copy_(fresh.log_ent_coef)
    optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer, model.lambda_optimizer)
    for optimizer in optimizers:
        for state in optimizer.state.values():
            for value in state.values():
                value.zero_()
    model.replay_buffer.reset()
    model._n_updates = 0
    model.env.seed(seed)
    model.action_space.seed(seed)


def _in_units(env_id: str, factor: float) -> gym.Env[Any, Any]:
    """An environment whose rewards have another unit."""
    return gym.wrappers.TransformReward(gym.make(env_id), lambda reward: factor * float(reward))


def part(design: str, env_id: str, seeds: list[int], timesteps: int, episodes: int, factor: float) -> Tables:
    """Train a design with several seeds on one problem, and judge it."""
    th.set_num_threads(1)
    kind, policy_kwargs, arguments = DESIGNS[design]
    if issubclass(kind, LAC):
        arguments = {**arguments, "compile_update": True}
    make_env, rows = partial(gym.make, env_id), []
    model: Any = None
    for seed in seeds:
        fresh = kind(
            "MlpPolicy",
            make_vec_env(partial(_in_units, env_id, factor), 4, seed=seed),
            gamma=0.99,
            learning_starts=1000,
            buffer_size=200_000,
            gradient_steps=2,
            seed=seed,
            device="cpu",
            policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.LeakyReLU, **policy_kwargs},
            **{"learning_rate": 1e-3, **arguments},
        )
        if model is None or kind is SAC:
            model = fresh
        else:
            _set_back(model, fresh, seed)
        model.learn(timesteps)
        outcome = roll_out(model, make_env, episodes, seed=_STARTS)
        problem = make_env().unwrapped
        assert isinstance(problem, CostEnv)
        rows.append(
            {
                "design": design,
                "environment": env_id,
                "seed": seed,
                "timesteps": timesteps,
                "updates": model._n_updates,
                "factor": factor,
                "lambda": float(model.log_lambda.exp()) if kind is LAC else np.nan,
                "ent_coef": float(model.log_ent_coef.exp()),
                "cost": outcome["cost"].mean(),
                "error_median": outcome["error"].median(),
                "died": outcome["died"].mean(),
                **shares_of(outcome, problem.error_tolerance),
            }
        )
    return {"critics": pd.DataFrame(rows)}


def report(results: pd.DataFrame) -> str:
    """Costs, and shares that die."""
    rows = []
    for (design, factor), of_design in results.groupby(["design", "factor"], sort=False):
        row: dict[str, str] = {"design": str(design), "costs times": f"{factor:g}"}
        for env_id, group in of_design.groupby("environment", sort=False):
            died = f", {100 * group['died'].mean():.1f} % die" if group["died"].any() else ""
            row[str(env_id)] = f"{with_interval(group['cost'])} (worst {group['cost'].max():.2g}{died})"
        rows.append(row)
    return markdown(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("critics", __doc__)
    parser.add_argument("--designs", nargs="+", default=list(DESIGNS), choices=list(DESIGNS))
    parser.add_argument("--envs", nargs="+", default=list(DISTURBANCES), choices=list(DISTURBANCES))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[100, 101, 102, 103, 104])
    parser.add_argument("--factors", nargs="+", type=float, default=[1.0], help="of the rewards")
    parser.add_argument("--timesteps", type=positive, default=15_000)
    parser.add_argument("--episodes", type=positive, default=60)
    study = Study(parser, arguments)
    chosen = study.chosen
    parts = [
        {
            "design": design,
            "env_id": env_id,
            "seeds": chosen.seeds,
            "timesteps": chosen.timesteps,
            "episodes": chosen.episodes,
            "factor": factor,
        }
        for design in chosen.designs
        for factor in chosen.factors
        for env_id in chosen.envs
    ]
    results = study.run(part, parts)["critics"]
    study.write({"critics": results}, {}, report(results))


if __name__ == "__main__":
    main()
