"""
Training with the hyperparameters of ``zoo_configs``, or with those of the algorithms themselves, one run after another or
several at the same time. What a policy depends on is its recipe, and every result is named by it.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import torch as th
import yaml
from rl_zoo3 import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import tqdm

import battery_env
import sb3_lac
from battery_env.files import replacing
from benchmarks.reporting import versions, write_text
from sb3_lac.zoo import LACExperimentManager, find_config

Result = TypeVar("Result")

#: Environment steps with the algorithms' own hyperparameters, which name none.
DEFAULTS_TIMESTEPS = 20_000
# arguments of algorithms that the recipe states elsewhere, or that change nothing
_NOT_LEARNING = {"seed", "verbose", "device", "tensorboard_log", "stats_window_size", "_init_setup_model"}


@dataclass(frozen=True)
class Recipe:
    """
    All that a trained policy depends on: what was chosen and, where nothing was, what the code says. Two trainings with equal
    recipes are the same training. A change of the code that changes results is known by the version of the package. Versions
    of PyTorch and other packages are left out, as an update would discard every run; results record them beside the recipe.

    :param algo: name of an off-policy algorithm in the RL Zoo, like ``lac``
    :param env_id: id of the environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param source: where the hyperparameters are from, ``zoo_configs`` or ``defaults``
    :param hyperparameters: as in a file of ``zoo_configs``
    :param arguments: defaults of the algorithm's other arguments
    :param environment: how the environment is registered, and its spaces
    :param packages: versions of the packages of this project
    :param evaluations: how often the training is interrupted by an evaluation, if at all
    """

    algo: str
    env_id: str
    seed: int
    timesteps: int
    source: str
    hyperparameters: dict[str, Any]
    arguments: dict[str, Any]
    environment: dict[str, Any]
    packages: dict[str, str]
    evaluations: int | None = None

    @classmethod
    def of(
        cls,
        algo: str,
        env_id: str,
        seed: int,
        timesteps: int | None = None,
        *,
        hyperparameters: dict[str, Any] | None = None,
        defaults: bool = False,
        evaluations: int | None = None,
    ) -> Recipe:
        """
        The recipe of a training.

        :param algo: name of an off-policy algorithm in the RL Zoo, like ``lac``
        :param env_id: id of the environment
        :param seed: seed of everything
        :param timesteps: environment steps; ``n_timesteps`` of ``zoo_configs`` by default, or ``DEFAULTS_TIMESTEPS``
        :param hyperparameters: what differs from ``zoo_configs``
        :param defaults: the hyperparameters of ``ALGO("MlpPolicy", env_id)`` instead of those of ``zoo_configs``
        :param evaluations: how often the training is interrupted by an evaluation, if at all
        :return: the recipe
        :raises ValueError: if the algorithm, the environment or its entry in ``zoo_configs`` does not exist, for a seed out of
            range, or if so few steps would train nothing
        :raises FileNotFoundError: if ``zoo_configs`` has no file for the algorithm
        """
        if not (algo in ALGOS and issubclass(ALGOS[algo], OffPolicyAlgorithm)):
            known = sorted(name for name, kind in ALGOS.items() if issubclass(kind, OffPolicyAlgorithm))
            raise ValueError(f"{algo} is no off-policy algorithm of the RL Zoo; choose from {', '.join(known)}")
        if not 0 <= seed < 2**32:
            raise ValueError(f"a seed must lie within 0 .. 2**32 - 1, got {seed}")
        environment = _environment(env_id)
        if defaults:
            source, entry = "defaults", {"policy": "MlpPolicy"}
        else:
            source, config = "zoo_configs", find_config(algo)
            entries = yaml.safe_load(config.read_text(encoding="utf-8"))
            if env_id not in entries:
                raise ValueError(f"{config} has no entry for {env_id}: add one, or train with the defaults of the algorithm")
            entry = entries[env_id]
        entry = {**entry, **(hyperparameters or {})}
        in_entry = int(float(entry.pop("n_timesteps", DEFAULTS_TIMESTEPS)))
        timesteps = in_entry if timesteps is None else timesteps
        arguments = {
            name: parameter.default
            for name, parameter in inspect.signature(ALGOS[algo]).parameters.items()
            if parameter.default is not parameter.empty and name not in _NOT_LEARNING | set(entry)
        }
        learning_starts = entry.get("learning_starts", arguments.get("learning_starts", 0))
        if timesteps <= learning_starts:
            raise ValueError(
                f"{algo} on {env_id} starts to learn after {learning_starts} steps (learning_starts): "
                f"timesteps={timesteps} must be more"
            )
        return cls(
            algo,
            env_id,
            seed,
            timesteps,
            source,
            entry,
            json.loads(json.dumps(arguments, default=str)),
            environment,
            {"sb3_lac": sb3_lac.__version__, "battery_env": battery_env.__version__},
            evaluations,
        )

    @property
    def digest(self) -> str:
        """Names the recipe but for its seed."""
        but_seed = {name: value for name, value in asdict(self).items() if name != "seed"}
        return sha256(json.dumps(but_seed, sort_keys=True, default=str).encode()).hexdigest()[:8]

    @property
    def label(self) -> str:
        """What the policy is called in tables and figures."""
        return self.algo.upper() if self.source == "zoo_configs" else f"{self.algo.upper()} {self.source}"

    @property
    def name(self) -> str:
        """A name for files and folders, that no other recipe has."""
        return f"{self.label.replace(' ', '_').lower()}_seed{self.seed}_{self.digest}"


@cache
def _environment(env_id: str) -> dict[str, Any]:
    try:
        spec = gym.spec(env_id)
        env = gym.make(env_id, disable_env_checker=True)
    except gym.error.Error as error:
        raise ValueError(str(error)) from error
    spaces = {"observation_space": str(env.observation_space), "action_space": str(env.action_space)}
    env.close()
    # which task it is, the id says
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "task"}
    return {"kwargs": json.loads(json.dumps(kwargs, default=str)), "max_episode_steps": spec.max_episode_steps, **spaces}


def set_up(recipe: Recipe, folder: Path, **options: Any) -> tuple[LACExperimentManager, OffPolicyAlgorithm]:
    """
    A model that is ready to learn, on one thread of the CPU.

    :param recipe: what the model depends on
    :param folder: where the zoo writes what it does
    :param options: other arguments of the zoo's experiment manager
    :return: the manager and the model
    """
    th.set_num_threads(1)
    # not zoo_configs itself, which may have changed since
    config = folder / f"{recipe.name}.yml"
    write_text(config, yaml.safe_dump({recipe.env_id: {**recipe.hyperparameters, "n_timesteps": recipe.timesteps}}))
    manager = LACExperimentManager(
        argparse.Namespace(),
        recipe.algo,
        recipe.env_id,
        log_folder=str(folder),
        n_timesteps=recipe.timesteps,
        eval_freq=-1,
        seed=recipe.seed,
        verbose=0,
        device="cpu",
        config=str(config),
        **options,
    )
    with contextlib.redirect_stdout(io.StringIO()):  # the zoo prints every hyperparameter, and saves them too
        model, _ = manager.setup_experiment()  # type: ignore[misc]
    assert isinstance(model, OffPolicyAlgorithm)
    return manager, model


def train_or_load(
    algo: str, env_id: str, seed: int, timesteps: int, folder: Path, hyperparameters: dict[str, Any] | None = None
) -> BaseAlgorithm:
    """
    Train one policy, or load it if that has been done.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of the environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param folder: where the model is kept, with its recipe and the duration of its training beside it (see
        :func:`record_file`)
    :param hyperparameters: what differs from ``zoo_configs``
    :return: the model
    """
    recipe = Recipe.of(algo, env_id, seed, timesteps, hyperparameters=hyperparameters)
    record = record_file(recipe, folder)
    file = record.with_suffix(".zip")
    if not file.exists():
        start = time.perf_counter()
        _, model = set_up(recipe, folder / "zoo")
        model.set_logger(configure(str(folder), ["csv"]))
        model.learn(timesteps)
        minutes = (time.perf_counter() - start) / 60.0
        described = {"recipe": asdict(recipe), "training_minutes": minutes, "versions": versions()}
        write_text(record, json.dumps(described, indent=2, default=str) + "\n")
        with replacing(file) as part:
            model.save(part)
    return ALGOS[algo].load(file, device="cpu")


def timesteps_of(updates: int, hyperparameters: dict[str, Any]) -> int:
    """
    How long to train for a number of updates, with one call of ``train()`` per step of all environments.

    :param updates: gradient steps
    :param hyperparameters: as in a file of ``zoo_configs``, with ``learning_starts`` and ``n_envs``
    :return: environment steps
    """
    n_envs, starts = hyperparameters["n_envs"], hyperparameters["learning_starts"]
    return n_envs * (starts // n_envs + -(-updates // hyperparameters.get("gradient_steps", 1)))


def record_file(recipe: Recipe, folder: Path) -> Path:
    """
    Where :func:`train_or_load` says what made a model: ``recipe``, ``training_minutes``, ``versions``.

    :param recipe: of the model
    :param folder: where the model is kept
    :return: a JSON file
    """
    return folder / f"model_{recipe.name}.json"


def run_all(function: Callable[..., Result], runs: Sequence[tuple[Any, ...]], jobs: int) -> list[Result]:
    """
    Call a function with each of several arguments, with a progress bar.

    :param function: importable, since it is pickled
    :param runs: positional arguments of each call
    :param jobs: processes at the same time; with one, everything stays in this process
    :return: the results, in the order of the runs
    """
    if jobs == 1:
        return [function(*run) for run in tqdm(runs, desc="runs", disable=None)]
    # spawn: torch does not survive a fork with threads
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(function, *run) for run in runs]
        try:
            for future in tqdm(as_completed(futures), desc="runs", total=len(futures), disable=None):
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]
