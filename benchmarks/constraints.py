"""
Constraints for the actor that say something its objective does not: designs of LAC's update that are not in the package,
beside LAC as it is and as it was published, on the cost environments.

.. code-block:: bash

  python -m benchmarks.constraints
  python -m benchmarks.constraints --envs CartPoleCost-v0 --seeds 0 1 2

In all of them the objective is always on, and a decrease condition with a gradient of its own adds to it. Policies are
trained with LAC's settings of ``zoo_configs``, and judged by their mean action as in ``benchmarks.stabilisation``. What is
done is not done again when the command is repeated.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from matplotlib.figure import Figure
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor, create_mlp
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from battery_env.evaluation import over_seeds
from battery_env.plotting import coloured
from benchmarks.references import DISTURBANCES, tried
from benchmarks.study import (
    EVALUATION_SEED,
    Study,
    Tables,
    command_line,
    digits,
    markdown,
    natural,
    new_panels,
    positive,
    share_with_range,
    with_interval,
)
from benchmarks.training import Recipe, set_up
from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.policies import largest_value

_NET_ARCH = [64, 64]  # of networks that LAC does not have, as those that it has on these environments
_LARGEST_MULTIPLIER = 10.0
_N_ENVS = 25


class HingeLAC(LAC):
    """
    LAC whose actor also lowers ``mean max(0, L(s', pi(s')) - L(s, a) + alpha3 * c)``: a constraint that counts the transitions
    which violate it, and those only.
    """

    def _objective(
        self,
        replay_data: ReplayBufferSamples,
        actions: th.Tensor,
        values: th.Tensor,
        costs: th.Tensor,
        difference: th.Tensor,
    ) -> th.Tensor:
        objective = super()._objective(replay_data, actions, values, costs, difference)
        return objective + self._penalty(replay_data, self._violations(replay_data, values, costs))

    def _violations(self, replay_data: ReplayBufferSamples, values: th.Tensor, costs: th.Tensor) -> th.Tensor:
        # of each transition, shape (n, 1), with a gradient through the next action
        next_actions = self.actor(replay_data.next_observations)
        next_values = largest_value(self.critic(replay_data.next_observations, next_actions))
        return (1 - replay_data.dones) * (next_values - values + self.alpha3 * costs)

    def _penalty(self, replay_data: ReplayBufferSamples, violations: th.Tensor) -> th.Tensor:
        return F.relu(violations).mean()


class StateMultiplierLAC(HingeLAC):
    """
    LAC with a multiplier for each state, ``lambda(s) = softplus(network(s))``, which rises where the condition is violated and
    falls where it holds (Ma et al. 2021, Feasible Actor-Critic, arXiv 2105.10682).
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        size = int(np.prod(self.observation_space.shape or ()))
        self.multiplier = nn.Sequential(*create_mlp(size, 1, _NET_ARCH, nn.LeakyReLU), nn.Softplus())
        self.multiplier_optimizer = th.optim.Adam(self.multiplier.parameters(), lr=self.lr_schedule(1))

    def _penalty(self, replay_data: ReplayBufferSamples, violations: th.Tensor) -> th.Tensor:
        multipliers = self.multiplier(replay_data.observations).clamp(max=_LARGEST_MULTIPLIER)
        _descend(self.multiplier_optimizer, -(multipliers * violations.detach()).mean())
        return (multipliers.detach() * violations).mean()


class CertificateLAC(HingeLAC):
    """
    LAC with the hinge of a function of its own, the relative value of the average cost,
    ``W(s, a) = c - average + W(s', pi(s'))``, learned as in differential Q-learning (Wan et al. 2021, arXiv 2006.16318). It
    decreases by all of the cost but the average, at any speed of the loop.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        assert isinstance(self.action_space, spaces.Box)
        extractor = FlattenExtractor(self.observation_space)
        self.certificate = ContinuousCritic(
            self.observation_space,
            self.action_space,
            _NET_ARCH,
            extractor,
            extractor.features_dim,
            nn.LeakyReLU,
            n_critics=1,
        )
        self.certificate_target = copy.deepcopy(self.certificate)
        self.certificate_optimizer = th.optim.Adam(self.certificate.parameters(), lr=self.lr_schedule(1))
        self.average_cost = th.zeros(1)

    def _violations(self, replay_data: ReplayBufferSamples, values: th.Tensor, costs: th.Tensor) -> th.Tensor:
        going_on = 1 - replay_data.dones
        next_actions = self.actor(replay_data.next_observations)
        with th.no_grad():
            (next_targets,) = self.certificate_target(replay_data.next_observations, next_actions)
            targets = costs - self.average_cost + going_on * next_targets
        (present,) = self.certificate(replay_data.observations, replay_data.actions)
        _descend(self.certificate_optimizer, 0.5 * F.mse_loss(present, targets))
        polyak_update(self.certificate.parameters(), self.certificate_target.parameters(), self.tau)
        (next_values,) = self.certificate(replay_data.next_observations, next_actions)
        violations = going_on * (next_values - present.detach() + costs - self.average_cost)
        # by the same network for both values: beside its target it hardly errs, as both drift while the average is wrong
        self.average_cost += self.tau * violations.detach().mean()
        return violations


def _descend(optimizer: th.optim.Optimizer, loss: th.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


class Design(NamedTuple):
    """
    How the actor is constrained.

    :param label: for tables
    :param algo: name of the class in this module, or ``lac``
    :param hyperparameters: what differs from LAC's in ``zoo_configs``
    """

    label: str
    algo: str = "lac"
    hyperparameters: Mapping[str, Any] = MappingProxyType({})


# the objective with its full weight throughout, and a condition that can be met
_ALPHA3 = 0.1
_ALWAYS_ON = MappingProxyType({"lambda_min": 1.0, "alpha3": _ALPHA3})

DESIGNS: dict[str, Design] = {
    "none": Design("LAC: the condition is a weight"),
    "published": Design("published: the condition is the objective", "lac", {"published_update": True}),
    "minimal": Design("alpha3 = 0.3, lambda from 0.1", "lac", {"alpha3": 0.3, "lambda_min": 0.1}),
    "hinge": Design("hinge on L", "HingeLAC", _ALWAYS_ON),
    "state": Design("a multiplier for each state", "StateMultiplierLAC", _ALWAYS_ON),
    "certificate": Design("hinge on a function of its own", "CertificateLAC", _ALWAYS_ON),
}


def recipe_of(design: str, env_id: str, seed: int, timesteps: int | None) -> Recipe:
    """What a policy is trained with: LAC's settings, but for those of the design."""
    of_lac = Recipe.of("lac", env_id, seed)
    steps = min(of_lac.timesteps, timesteps or of_lac.timesteps)
    chosen = DESIGNS[design]
    if chosen.algo == "lac":
        return Recipe.of("lac", env_id, seed, steps, hyperparameters=dict(chosen.hyperparameters))
    settings = {**of_lac.hyperparameters, **chosen.hyperparameters}
    return Recipe.of(f"benchmarks.constraints:{chosen.algo}", env_id, seed, steps, hyperparameters=settings, defaults=True)


def part(design: str, env_id: str, seed: int, timesteps: int, settings: dict[str, Any], episodes: int) -> Tables:
    """Train one policy, and judge it."""
    recipe = recipe_of(design, env_id, seed, timesteps)
    assert recipe.hyperparameters == settings
    with tempfile.TemporaryDirectory() as folder:
        _, model = set_up(recipe, Path(folder))
    model.learn(timesteps)
    assert isinstance(model, LAC)
    judged = evaluate_lyapunov(model, make_vec_env(env_id, n_envs=_N_ENVS), episodes, seed=EVALUATION_SEED)
    described: dict[str, Any] = {
        "environment": env_id,
        "design": design,
        "seed": seed,
        "timesteps": timesteps,
        "updates": model._n_updates,
        "alpha3": model.alpha3,
        "holds": judged.holds,
        "largest_feasible_alpha3": judged.metrics["largest_feasible_alpha3"].value,
        "largest_feasible_alpha3_low": judged.metrics["largest_feasible_alpha3"].low,
    }
    outcomes = tried(model, env_id, episodes).drop(columns="environment")
    return {"constraints": pd.concat([pd.DataFrame([described] * len(outcomes)), outcomes], axis=1)}


def report(results: pd.DataFrame) -> str:
    """
    One row for each environment and design, as Markdown: costs are interquartile means over seeds with their 95 % intervals,
    shares of episodes that die are means (least to most of a seed).
    """
    rows = []
    for (env_id, design), group in results.groupby(["environment", "design"], sort=False):
        by_disturbance = dict(list(group.groupby("disturbance")))
        undisturbed = by_disturbance["none"]
        rows.append(
            {
                "environment": env_id,
                "design": DESIGNS[str(design)].label,
                "seeds": str(len(undisturbed)),
                "cost per step": with_interval(undisturbed["cost"]),
                "at the goal": share_with_range(undisturbed["at_goal"]),
                "die": share_with_range(undisturbed["died"]),
                "die, impulses": share_with_range(by_disturbance["impulses"]["died"]),
                "die, other parameters": share_with_range(by_disturbance["other parameters"]["died"]),
                "largest feasible alpha3, median": digits(undisturbed["largest_feasible_alpha3"].median()),
                "at least 0.1": f"{(undisturbed['largest_feasible_alpha3_low'] >= _ALPHA3).sum()} of {len(undisturbed)}",
                "holds with a residual": f"{undisturbed['holds'].sum()} of {len(undisturbed)}",
            }
        )
    return markdown(rows)


def plot(results: pd.DataFrame) -> Figure:
    """
    The cost of each design, one panel per environment, three in a row: each seed, and the interquartile mean with its 95 %
    interval.
    """
    undisturbed = results[results["disturbance"] == "none"]
    envs, designs = list(undisturbed["environment"].unique()), list(undisturbed["design"].unique())
    figure, panels = new_panels(len(envs), 3, (2.4, 0.9 + 0.3 * len(designs)), margin=(2.6, 0.0), sharey=True)
    for axes, env_id in zip(panels, envs, strict=True):
        of_env = undisturbed.loc[undisturbed["environment"] == env_id, "cost"]
        # only over decades: within one, labels of a logarithmic axis overlap
        axes.set(xscale="log" if of_env.max() > 10 * of_env.min() else "linear", xlabel="cost per step")
        for height, (colour, design) in enumerate(coloured(designs)):
            costs = undisturbed.loc[(undisturbed["environment"] == env_id) & (undisturbed["design"] == design), "cost"]
            if costs.empty:
                continue
            middle, low, high = (float(value) for value in over_seeds(costs))
            axes.scatter(costs, np.full(len(costs), height), s=10, color=colour, alpha=0.4, lw=0)
            axes.plot([low, high], [height, height], color=colour, lw=1.5)
            axes.plot(middle, height, "o", color=colour, ms=6)
        axes.set_title(env_id, fontsize=9)
        axes.grid(axis="x", alpha=0.25)
    panels[0].set_yticks(range(len(designs)), [DESIGNS[design].label for design in designs])
    panels[0].invert_yaxis()
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("constraints", __doc__)
    parser.add_argument("--designs", nargs="+", default=list(DESIGNS), choices=list(DESIGNS))
    parser.add_argument("--envs", nargs="+", default=list(DISTURBANCES), choices=list(DISTURBANCES))
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=positive, default=15_000, help="environment steps at most")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes for each policy and disturbance")
    study = Study(parser, arguments)
    chosen = study.chosen
    parts = []
    # seed by seed, so that an interrupted study has whole seeds
    for seed in chosen.seeds:
        for env_id in chosen.envs:
            for design in chosen.designs:
                try:
                    recipe = recipe_of(design, env_id, seed, chosen.timesteps)
                except ValueError as error:
                    parser.error(str(error))
                of_recipe = {"timesteps": recipe.timesteps, "settings": recipe.hyperparameters}
                parts.append({"design": design, "env_id": env_id, "seed": seed, **of_recipe, "episodes": chosen.episodes})
    results = study.run(part, parts)["constraints"]
    order = [*chosen.envs, *DESIGNS]
    results = results.sort_values(
        ["environment", "design"], key=lambda names: names.map(order.index), kind="stable", ignore_index=True
    )
    study.write({"constraints": results}, {"constraints": plot(results)}, report(results))


if __name__ == "__main__":
    main()
