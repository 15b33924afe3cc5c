"""
What each choice of the q^max task is worth: LAC with the hyperparameters of ``zoo_configs`` on the task as it is registered,
and with one thing changed at a time, the starts and lengths of episodes of ``zoo_configs`` among them.

.. code-block:: bash

  python -m benchmarks.ablations --seeds 0 1 2 --updates 2400

Every policy is scored on whole held-out discharges, the model running free. A run that is finished is not run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd

from battery_env.evaluation import evaluate
from battery_env.policies.estimator import PolicyEstimator, Predictor
from battery_env.tasks.data import standard_dataset
from benchmarks.study import Study, Tables, command_line, markdown, natural, positive, side_by_side
from benchmarks.training import Recipe, timesteps_of, train_or_load

_ENV_ID = "BatteryQmax-v0"
_DISCHARGES = 64  # of the test part, evenly spaced
_FROM_MODEL, _FROM_CELL = tuple(range(15, 22)), tuple(range(22, 29))  # columns of the two innovations


class Variant(NamedTuple):
    """
    One thing that is changed.

    :param label: what, for the table
    :param hyperparameters: in place of those of ``zoo_configs``, arguments of the environment (``env_kwargs``; none by
        default) among them
    :param hidden: columns of the observation that the agent does not see
    """

    label: str
    hyperparameters: Mapping[str, Any] = MappingProxyType({})
    hidden: tuple[int, ...] = ()


VARIANTS: dict[str, Variant] = {
    "published": Variant("nothing"),
    "from_model": Variant("innovation from the model's state only", hidden=_FROM_CELL),
    "from_cell": Variant("innovation from the measured state only", hidden=_FROM_MODEL),
    "none": Variant("no innovation", hidden=_FROM_MODEL + _FROM_CELL),
    "gamma": Variant("discount 0.9", {"gamma": 0.9}),
    "entropy": Variant("target entropy -1, SAC's default", {"target_entropy": -1.0}),
    "alpha3": Variant("alpha3 0.1", {"alpha3": 0.1}),
    "limit": Variant("cost limit 100", {"env_kwargs": {"cost_limit": 100.0}}),
    "short": Variant("episodes of 16 steps, the paper's", {"env_kwargs": {"episode_steps": 16}}),
    "long": Variant("episodes of 256 steps", {"env_kwargs": {"episode_steps": 256}}),
    "starts": Variant(
        "starts and lengths of zoo_configs",
        {"env_kwargs": {"continue_probability": 0.5, "first_sample_probability": 0.3, "initial_perturbation": 1.0}},
    ),
    "perturbed": Variant("starts up to 2 error scales off", {"env_kwargs": {"initial_perturbation": 2.0}}),
    "resync": Variant("model set to the measured state every 16 steps", {"env_kwargs": {"resync": 16}}),
    "consistency": Variant("changes of the action cost 1 per unit", {"env_kwargs": {"consistency": 1.0}}),
}


def shown_columns(size: int, hidden: Sequence[int]) -> np.ndarray:
    """What is left of an observation."""
    return np.setdiff1d(np.arange(size), hidden)


class HideColumns(gym.ObservationWrapper):
    """
    Leaves numbers out of the observation.

    :param env: the environment
    :param hidden: their columns
    """

    def __init__(self, env: gym.Env, hidden: Sequence[int]) -> None:
        super().__init__(env)
        assert isinstance(env.observation_space, gym.spaces.Box)
        self.columns = shown_columns(env.observation_space.shape[0], hidden)
        low, high = env.observation_space.low[self.columns], env.observation_space.high[self.columns]
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """The rest of an observation."""
        return observation[self.columns]


class _Blinkered:
    # a policy that does not see the hidden columns
    def __init__(self, policy: Predictor, hidden: Sequence[int]) -> None:
        self.policy, self.hidden = policy, hidden

    def predict(self, observation: np.ndarray, deterministic: bool = False) -> tuple[Any, Any]:
        columns = shown_columns(observation.shape[1], self.hidden)
        return self.policy.predict(observation[:, columns], deterministic=deterministic)


def part(name: str, seed: int, updates: int, models: Path) -> Tables:
    """Train one policy, unless that has been done, and score it."""
    variant = VARIANTS[name]
    hyperparameters = {"env_kwargs": {}, **variant.hyperparameters}
    if variant.hidden:
        hyperparameters["env_wrapper"] = [{"benchmarks.ablations.HideColumns": {"hidden": list(variant.hidden)}}]
    timesteps = timesteps_of(updates, Recipe.of("lac", _ENV_ID, seed).hyperparameters)
    model = train_or_load("lac", _ENV_ID, seed, timesteps, models / name, hyperparameters)
    test = standard_dataset("q_mobile", "paper", "test")
    test = test.subset(range(0, len(test), len(test) // _DISCHARGES))
    # of the arguments of the environment the only one that the observation depends on
    consistency = hyperparameters["env_kwargs"].get("consistency", 0.0)
    scores = evaluate(PolicyEstimator(_Blinkered(model, variant.hidden), _ENV_ID, consistency=consistency), test)
    errors = scores["q_mobile_mape_percent"]
    row = {
        "variant": name,
        "changed": variant.label,
        "seed": seed,
        "mean_percent": errors.mean(),
        "median_percent": errors.median(),
        "worst_percent": errors.max(),
        "spread_percent": (100.0 * scores["q_mobile_spread"] / scores["q_mobile"]).mean(),
    }
    return {"ablations": pd.DataFrame([row])}


def report(results: pd.DataFrame) -> str:
    """Errors of all seeds side by side, as Markdown."""
    rows = [
        {
            "changed": str(label),
            "mean over discharges (%)": side_by_side(of_variant["mean_percent"]),
            "median (%)": side_by_side(of_variant["median_percent"]),
            "worst (%)": side_by_side(of_variant["worst_percent"]),
            "spread within a discharge (%)": side_by_side(of_variant["spread_percent"]),
        }
        for label, of_variant in results.groupby("changed", sort=False)
    ]
    return markdown(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("ablations", __doc__)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS), metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2])
    parser.add_argument("--updates", type=positive, default=2400, help="gradient steps of each training")
    study = Study(parser, arguments)
    chosen = study.chosen
    parts = [{"name": name, "seed": seed, "updates": chosen.updates} for name in chosen.variants for seed in chosen.seeds]
    tables = study.run(part, parts, models=study.out / "models")
    study.write(tables, {}, report(tables["ablations"]))


if __name__ == "__main__":
    main()
