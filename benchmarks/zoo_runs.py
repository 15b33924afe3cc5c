"""Runs with the hyperparameters of ``zoo_configs``, or with those of the algorithms themselves."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.runs import RELEASED, Run, registered_id
from sb3_lac.zoo import find_config

#: Environment steps with the algorithms' own hyperparameters, which name none.
DEFAULTS_TIMESTEPS = 20_000
#: Hyperparameters of the RL Zoo that models do not hold.
_OUTSIDE_OF_MODELS = ("normalize", "frame_stack", "vec_env_wrapper")
_LABELS = {"PublishedLAC": "LAC as published"}


def kind_of(algo: str) -> str:
    """The class, ``package:Class``, of an algorithm by its name in the RL Zoo, like ``published_lac``, or by its own."""
    if ":" in algo:
        module, _, name = algo.partition(":")
        try:
            kind = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"{algo} is no algorithm: {error}") from error
        if not (inspect.isclass(kind) and issubclass(kind, BaseAlgorithm)):
            raise ValueError(f"{algo} is no algorithm: it must be a subclass of Stable-Baselines3's BaseAlgorithm")
        return algo
    kinds = {}
    for package in RELEASED:
        for name, member in vars(importlib.import_module(package)).items():
            if inspect.isclass(member) and issubclass(member, BaseAlgorithm):
                kinds[name.lower()] = f"{package}:{name}"
    if (name := algo.replace("_", "")) not in kinds:
        raise ValueError(
            f"{algo} is no algorithm; choose from {', '.join(sorted(kinds))}, or name your own, package.module:Class"
        )
    return kinds[name]


def zoo_run(
    algo: str,
    env_id: str,
    seed: int,
    timesteps: int | None = None,
    *,
    updates: int | None = None,
    differing: Mapping[str, Any] | None = None,
    settings_of: str | None = None,
    defaults: bool = False,
    label: str | None = None,
) -> Run:
    """
    A training with the entry of ``zoo_configs`` for the environment, the ``default`` entry of another algorithm
    (``settings_of``), or as typed (``defaults``); ``updates`` are gradient steps that stand for environment steps.
    """
    if not 0 <= seed < 2**32:
        raise ValueError(f"a seed must lie within 0 .. 2**32 - 1, got {seed}")
    kind = kind_of(algo)
    plain_id, name = registered_id(env_id), kind.partition(":")[2]
    try:
        gym.spec(plain_id)
    except gym.error.Error as error:
        raise ValueError(str(error)) from error
    entry: dict[str, Any] = {}
    label = label or _LABELS.get(name, name) + (" defaults" if defaults else "")
    run = Run(env_id, label, kind, seed, 0)
    if not defaults:
        config = find_config(settings_of or str(getattr(run.type, "zoo_config", name.lower() if ":" in algo else algo)))
        entries = yaml.safe_load(config.read_text(encoding="utf-8"))
        key = plain_id if settings_of is None else "default"
        if key not in entries:
            raise ValueError(f"{config} has no entry for {key}: add one, or train with the defaults of the algorithm")
        entry = entries[key]
    settings = {**entry, **(differing or {})}
    for outside in _OUTSIDE_OF_MODELS:
        if settings.get(outside):
            raise ValueError(f"policies with `{outside}` cannot be scored here: their models do not hold what it does")
    of_entry, environment = int(float(settings.pop("n_timesteps", DEFAULTS_TIMESTEPS))), settings.pop("env_kwargs", {})
    learning_starts = settings.get("learning_starts", run.defaults.get("learning_starts", 0))
    if updates is not None:
        n_envs = settings["n_envs"]
        timesteps = n_envs * (learning_starts // n_envs + -(-updates // settings.get("gradient_steps", 1)))
    timesteps = of_entry if timesteps is None else timesteps
    if timesteps <= learning_starts:
        raise ValueError(
            f"{algo} on {env_id} starts to learn after {learning_starts} steps (learning_starts): "
            f"timesteps={timesteps} must be more"
        )
    return Run(env_id, label, kind, seed, timesteps, settings, environment)
