"""Training with the hyperparameters of ``zoo_configs``, one run after another or several at the same time."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import torch as th
import yaml
from rl_zoo3 import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import tqdm

from battery_env.files import replacing
from sb3_lac.zoo import LACExperimentManager, find_config

Result = TypeVar("Result")


def set_up(
    algo: str, env_id: str, seed: int, timesteps: int, folder: Path, **options: Any
) -> tuple[LACExperimentManager, OffPolicyAlgorithm, dict[str, Any]]:
    """
    A model with the hyperparameters of ``zoo_configs``, on one thread of the CPU.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of the environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param folder: where the zoo writes what it does
    :param options: other arguments of the zoo's experiment manager
    :return: the manager, the model, and its hyperparameters
    """
    th.set_num_threads(1)
    manager = LACExperimentManager(
        argparse.Namespace(),
        algo,
        env_id,
        log_folder=str(folder),
        n_timesteps=timesteps,
        eval_freq=-1,
        seed=seed,
        verbose=0,
        device="cpu",
        config=str(find_config(algo)),
        **options,
    )
    with contextlib.redirect_stdout(io.StringIO()):  # the zoo prints every hyperparameter, and saves them too
        model, hyperparameters = manager.setup_experiment()  # type: ignore[misc]
    assert isinstance(model, OffPolicyAlgorithm)
    return manager, model, hyperparameters


def train_or_load(
    algo: str, env_id: str, seed: int, timesteps: int, folder: Path, hyperparameters: dict[str, Any] | None = None
) -> BaseAlgorithm:
    """
    Train one policy, or load it if that has been done.

    :param algo: ``lac``, ``sac`` or ``td3``
    :param env_id: id of the environment
    :param seed: seed of everything
    :param timesteps: environment steps
    :param folder: where the model is kept, a folder for this run alone
    :param hyperparameters: what differs from ``zoo_configs``
    :return: the model
    """
    # Named by all that it depends on: with other hyperparameters, a policy is trained anew
    recipe = {**yaml.safe_load(find_config(algo).read_text(encoding="utf-8"))[env_id], **(hyperparameters or {})}
    digest = sha256(json.dumps([recipe, timesteps, seed], sort_keys=True).encode()).hexdigest()[:8]
    file = folder / f"model_{digest}.zip"
    if not file.exists():
        _, model, _ = set_up(algo, env_id, seed, timesteps, folder / "zoo", hyperparams=hyperparameters)
        model.set_logger(configure(str(folder), ["csv"]))
        model.learn(timesteps)
        with replacing(file) as part:
            model.save(part)
    return ALGOS[algo].load(file, device="cpu")


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
