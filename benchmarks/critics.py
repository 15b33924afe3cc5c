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
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from benchmarks.control import DISTURBANCES, roll_out, shares_of
from benchmarks.study import Study, Tables, command_line, markdown, natural, positive, with_interval
import sb3_lac.lac as lac_module
from sb3_lac import LAC
from sb3_lac.policies import largest_value
from sb3_lac.envs import CostEnv
from sb3_lac.policies import LyapunovCritic, LyapunovPolicy

_STARTS = 20_000  # seed of the episodes that designs are judged by
N_QUANTILES = 25


class LogCritic(LyapunovCritic):
    """Learns the logarithm of one plus the value over a scale."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.scale: th.Tensor
        self.register_buffer("scale", th.ones(1))

    def root(self, values: th.Tensor) -> th.Tensor:
        return values.sign() * (values.abs() / self.scale).log1p()

    def value(self, roots: th.Tensor) -> th.Tensor:
        return roots.sign() * roots.abs().clamp(max=40.0).expm1() * self.scale


class LogPolicy(LyapunovPolicy):
    """With the logarithm."""

    def make_critic(self, features_extractor: Any = None) -> LyapunovCritic:
        return LogCritic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)


class LogLAC(LAC):
    """Takes a hundredth of the median cost of the first transitions for the scale."""

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self._n_updates == 0:
            costs = -self.replay_buffer.rewards[: self.replay_buffer.pos]
            for critic in (self.critic, self.critic_target):
                critic.scale.fill_(max(0.01 * float(np.median(costs)), 1e-9))
        super().train(gradient_steps, batch_size)


class QuantileCritic(LyapunovCritic):
    """Quantiles of the root."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        kinds = (kwargs["features_dim"] + self.action_space.shape[0], N_QUANTILES, kwargs["net_arch"], kwargs["activation_fn"])
        for idx in range(self.n_critics):
            self.lyapunov_networks[idx] = nn.Sequential(*create_mlp(*kinds))
            self.add_module(f"lf{idx}", self.lyapunov_networks[idx])


class QuantilePolicy(LyapunovPolicy):
    """With quantiles."""

    def make_critic(self, features_extractor: Any = None) -> LyapunovCritic:
        return QuantileCritic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)


class QuantileLAC(LAC):
    """The mean of L has no bias: quantiles commute with the root."""

    def _critic_loss(self, current_values: Any, target_values: th.Tensor) -> Any:
        levels = (th.arange(N_QUANTILES) + 0.5) / N_QUANTILES
        error = target_values[:, None, :] - current_values[0][:, :, None]
        huber = th.where(error.abs() > 1, error.abs() - 0.5, 0.5 * error.square())
        return ((levels[None, :, None] - (error.detach() < 0).float()).abs() * huber).sum(dim=1).mean()

    def _objective(self, roots: th.Tensor) -> th.Tensor:
        # a root has no slope at 0
        means = self.critic.value(roots).mean(dim=1)
        return (means.sign() * (means.abs() + 1e-8).pow(self.critic.power)).mean()


class ValueLAC(LAC):
    """The actor lowers L."""

    def _objective(self, roots: th.Tensor) -> th.Tensor:
        return self.critic.value(roots).mean()


class MeanTargetLAC(LAC):
    """The target has the mean of the critics, and the actor lowers the larger one."""

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            roots = sum(self.critic_target(replay_data.next_observations, next_actions)) / self.critic_target.n_critics
            values = th.maximum(self.critic_target.value(roots), -self.critic_target.offset)
            return self.critic.root(-replay_data.rewards + (1 - replay_data.dones) * self.gamma * values)


class OwnTargetLAC(LAC):
    """Each critic learns from its own target network, and the actor lowers the larger one."""

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            roots = th.hstack(self.critic_target(replay_data.next_observations, next_actions))
            values = th.maximum(self.critic_target.value(roots), -self.critic_target.offset)
            return self.critic.root(-replay_data.rewards + (1 - replay_data.dones) * self.gamma * values)

    def _critic_loss(self, current_values: Any, target_values: th.Tensor) -> Any:
        return 0.5 * th.nn.functional.mse_loss(th.hstack(current_values), target_values) * len(current_values)


class MetricSAC(ValueLAC):
    """SAC in the metric: entropy in the target too."""

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            next_actions, log_prob = self.actor.action_log_prob(replay_data.next_observations)
            assert self.log_ent_coef is not None
            roots = th.maximum(*self.critic_target(replay_data.next_observations, next_actions))
            soft = self.critic_target.value(roots) + th.exp(self.log_ent_coef) * log_prob.reshape(-1, 1)
            return self.critic.root(-replay_data.rewards + (1 - replay_data.dones) * self.gamma * soft)


#: Algorithm, policy, its arguments and those of the algorithm.
DESIGNS: dict[str, tuple[type[LAC], Any, dict[str, Any], dict[str, Any]]] = {
    "quarter_two": (LAC, "MlpPolicy", {"power": 0.25, "n_critics": 2}, {}),
    "quarter_one": (LAC, "MlpPolicy", {"power": 0.25, "n_critics": 1}, {}),
    "half_two": (LAC, "MlpPolicy", {"power": 0.5, "n_critics": 2}, {}),
    "half_one": (LAC, "MlpPolicy", {"power": 0.5, "n_critics": 1}, {}),
    "quarter_two_falling_rate": (
        LAC,
        "MlpPolicy",
        {"power": 0.25, "n_critics": 2},
        {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0)},
    ),
    "half_two_falling_rate": (
        LAC,
        "MlpPolicy",
        {"power": 0.5, "n_critics": 2},
        {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0)},
    ),
    "log_two": (LogLAC, LogPolicy, {"n_critics": 2}, {}),
    "quantiles_half_one": (QuantileLAC, QuantilePolicy, {"power": 0.5, "n_critics": 1}, {}),
    "quarter_two_actor_on_L": (ValueLAC, "MlpPolicy", {"power": 0.25, "n_critics": 2}, {}),
    "quarter_two_SAC": (MetricSAC, "MlpPolicy", {"power": 0.25, "n_critics": 2}, {"lambda_min": 1.0}),
    "quarter_lin2_tau": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01}),
    "half_lin2_tau": (LAC, "MlpPolicy", {"power": 0.5}, {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01}),
    "quarter_lin1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "tau": 0.005}),
    "quarter_lin1_tau": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "tau": 0.01}),
    "half_lin1_tau": (LAC, "MlpPolicy", {"power": 0.5}, {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "tau": 0.01}),
    "half_lin1": (LAC, "MlpPolicy", {"power": 0.5}, {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "tau": 0.005}),
    "quarter_lin3_tau": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(3e-3, 0.0, 1.0), "tau": 0.01}),
    "third_lin2_tau": (LAC, "MlpPolicy", {"power": 1 / 3}, {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01}),
    "quarter_lin2_tau2": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.02}),
    "quarter_lin3_tau1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(3e-3, 0.0, 1.0), "tau": 0.01}),
    "quarter_lin3_tau2": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": LinearSchedule(3e-3, 0.0, 1.0), "tau": 0.02}),
    "quarter_lin2_tau2_ent2": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.02, "target_entropy": -2.0},
    ),
    "quarter_2_tau2": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 2e-3, "tau": 0.02}),
    "mean_quarter_lin2_tau2": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.02},
    ),
    "mean_quarter_lin2_tau1": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "min_quarter_lin2_tau2": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.02},
    ),
    "min_quarter_lin2_tau1": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "quarter_lin2_tau1_g98": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "gamma": 0.98},
    ),
    "quarter_2_tau1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 2e-3, "tau": 0.01}),
    "quarter_2_tau1_g98": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 2e-3, "tau": 0.01, "gamma": 0.98}),
    "quarter_1_tau1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 1e-3, "tau": 0.01}),
    "mean_quarter_1_tau1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 1e-3, "tau": 0.01}),
    "mean_quarter_1": (LAC, "MlpPolicy", {"power": 0.25}, {"learning_rate": 1e-3, "tau": 0.005}),
    "quarter_lin2_tau1_ent3": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "entropies": 3},
    ),
    "quarter_lin2_tau1_ent2": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "entropies": 2},
    ),
    "half_lin2_tau1_ent3": (
        LAC,
        "MlpPolicy",
        {"power": 0.5},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "entropies": 3},
    ),
    "quarter_lin2_tau1_n3": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "n_steps": 3},
    ),
    "quarter_lin2_tau1_n5": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "n_steps": 5},
    ),
    "min_quarter_lin2_tau1_n3": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "n_steps": 3},
    ),
    "quarter_lin2_tau1_g95": (
        LAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01, "gamma": 0.95},
    ),
    "mean_target_lin2_tau1": (
        MeanTargetLAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "mean_target_half_lin2_tau1": (
        MeanTargetLAC,
        "MlpPolicy",
        {"power": 0.5},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "own_lin2_tau1": (
        OwnTargetLAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "tmean_lin2_tau1": (
        MeanTargetLAC,
        "MlpPolicy",
        {"power": 0.25},
        {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0), "tau": 0.01},
    ),
    "value_two": (LAC, "MlpPolicy", {"power": 1.0, "n_critics": 2}, {}),
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


def part(design: str, env_id: str, seeds: list[int], timesteps: int, episodes: int) -> Tables:
    """Train a design with several seeds on one problem, and judge it."""
    th.set_num_threads(1)
    kind, policy, policy_kwargs, arguments = DESIGNS[design]
    pooled = {"mean": lambda roots: sum(roots) / len(roots), "min": lambda roots: th.minimum(*roots)}
    lac_module.largest_value = pooled.get(design.split("_")[0], largest_value)
    make_env, rows = partial(gym.make, env_id), []
    arguments = dict(arguments)
    if "entropies" in arguments:
        arguments["target_entropy"] = -float(arguments.pop("entropies") * make_env().action_space.shape[0])
    model: LAC | None = None
    for seed in seeds:
        fresh = kind(
            policy,
            make_vec_env(env_id, 4, seed=seed),
            learning_starts=1000,
            buffer_size=200_000,
            gradient_steps=2,
            seed=seed,
            device="cpu",
            compile_update=True,
            policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.LeakyReLU, **policy_kwargs},
            **{"learning_rate": 1e-3, "gamma": 0.99, **arguments},
        )
        if model is None:
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
                "least_L": float(
                    model.critic.lyapunov(
                        *(
                            th.as_tensor(a[-1000:].reshape(-1, a.shape[-1]))
                            for a in (
                                model.replay_buffer.observations[: model.replay_buffer.pos],
                                model.replay_buffer.actions[: model.replay_buffer.pos],
                            )
                        )
                    ).quantile(0.05)
                ),
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
    for design, of_design in results.groupby("design", sort=False):
        row: dict[str, str] = {"design": str(design)}
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
        }
        for design in chosen.designs
        for env_id in chosen.envs
    ]
    results = study.run(part, parts)["critics"]
    study.write({"critics": results}, {}, report(results))


if __name__ == "__main__":
    main()
