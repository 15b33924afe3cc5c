"""
RL Zoo with LAC: training, continuing, hyperparameter search and evaluation from the command line.

.. code-block:: bash

  python -m sb3_lac.zoo train --env Pendulum-v1
  python -m sb3_lac.zoo train --env Pendulum-v1 -i logs/lac/Pendulum-v1_1/Pendulum-v1.zip
  python -m sb3_lac.zoo enjoy --env Pendulum-v1 -f logs --no-render
  python -m sb3_lac.zoo optimize --env Pendulum-v1 --n-trials 50

Options are those of ``rl_zoo3.train`` and ``rl_zoo3.enjoy``, with two other defaults: the algorithm is LAC,
and hyperparameters come from ``zoo_configs/<algo>.yml``.
"""

import argparse
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

try:
    import optuna
    import rl_zoo3.enjoy
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import (
        HYPERPARAMS_CONVERTER,
        HYPERPARAMS_SAMPLER,
        convert_offpolicy_params,
        sample_her_params,
    )
except ImportError as error:
    raise ImportError("sb3_lac.zoo needs the RL Zoo, install it with: pip install 'sb3_lac[zoo]'") from error

from sb3_lac import LAC, GymnasiumVecEnv


def convert_lac_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Convert sampled values to the hyperparameters of LAC.

    :param sampled_params: See ``sample_lac_params()``
    :return: Keyword arguments of ``LAC``
    """
    hyperparams = convert_offpolicy_params(sampled_params)
    hyperparams["policy_kwargs"]["output_dim"] = hyperparams.pop("output_dim")
    # Start with the full weight on the cost, as in the paper
    hyperparams["lambda_init"] = hyperparams["lambda_max"]
    return hyperparams


def sample_lac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sampler for LAC hyperparams.

    :param trial: Optuna trial
    :param n_actions: Number of actions, not needed
    :param n_envs: Number of environments, not needed
    :param additional_args: Whether hindsight experience replay is used, and its arguments
    :return: Keyword arguments of ``LAC``
    """
    sampled_params: dict[str, Any] = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
        # From 2**5=32 to 2**10=1024
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 10),
        "learning_rate": trial.suggest_float("learning_rate", 1e-5, 0.002, log=True),
        "lambda_learning_rate": trial.suggest_float("lambda_learning_rate", 1e-5, 0.002, log=True),
        "train_freq": trial.suggest_int("train_freq", 1, 10),
        # Polyak coeff
        "tau": trial.suggest_float("tau", 0.001, 0.08, log=True),
        # Up to 1, from where the decrease condition cannot hold and lambda stays at lambda_max
        "alpha3": trial.suggest_float("alpha3", 0.01, 1.0, log=True),
        # Weight of the cost relative to the entropy
        "lambda_max": trial.suggest_float("lambda_max", 0.1, 10.0, log=True),
        "output_dim": trial.suggest_categorical("output_dim", [8, 16, 32, 64]),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
        "activation_fn": trial.suggest_categorical("activation_fn", ["relu", "leaky_relu"]),
    }

    # Display true values
    trial.set_user_attr("gamma", 1 - sampled_params["one_minus_gamma"])
    trial.set_user_attr("batch_size", 2 ** sampled_params["batch_size_pow"])

    if additional_args["using_her_replay_buffer"]:
        sampled_params = sample_her_params(trial, sampled_params, additional_args["her_kwargs"])

    return convert_lac_params(sampled_params)


def steps_as_one_batch(spec: EnvSpec) -> bool:
    """
    Whether all copies of an environment can be stepped by one call: it is registered with a vector environment that lets
    Stable-Baselines3 say when episodes start anew, and without wrappers that a vector environment would go without.

    :param spec: How the environment is registered
    :return: Whether it is
    """
    if spec.vector_entry_point is None or spec.max_episode_steps is not None or spec.additional_wrappers:
        return False
    entry_point = spec.vector_entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return "autoreset_mode" in inspect.signature(creator).parameters


class LACExperimentManager(ExperimentManager):
    """
    Experiment manager that steps all copies of an environment by one call where it can, and understands schedules like
    ``lin_5e-5`` for the learning rate of lambda.
    """

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        spec = gym.spec(self.env_name.gym_id)
        asked_otherwise = self.env_wrapper is not None or self.frame_stack is not None or self.vec_env_class is not DummyVecEnv
        if asked_otherwise or not steps_as_one_batch(spec):
            return super().create_envs(n_envs, eval_env, no_log)
        env_kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
        env: VecEnv = GymnasiumVecEnv(gym.make_vec(spec, n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **env_kwargs))
        env.seed(self.seed)
        log_file = None if eval_env or no_log else str(Path(self.save_path) / "0")
        env = VecMonitor(env, log_file, **self.monitor_kwargs)
        if self.vec_env_wrapper is not None:
            env = self.vec_env_wrapper(env)
        return self._maybe_normalize(env, eval_env)

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        hyperparams = ExperimentManager._preprocess_schedules(hyperparams)
        if hyperparams.get("lambda_learning_rate") is not None:
            schedule = ExperimentManager._preprocess_schedules({"learning_rate": hyperparams["lambda_learning_rate"]})
            hyperparams["lambda_learning_rate"] = schedule["learning_rate"]
        return hyperparams


rl_zoo3.ALGOS["lac"] = LAC
HYPERPARAMS_SAMPLER["lac"] = sample_lac_params
HYPERPARAMS_CONVERTER["lac"] = convert_lac_params
rl_zoo3.train.ExperimentManager = LACExperimentManager  # type: ignore[misc]


def find_config(algo: str) -> Path:
    """
    Find the tuned hyperparameters of an algorithm.

    :param algo: Name of the algorithm in the RL Zoo
    :return: ``zoo_configs/<algo>.yml`` of the current directory, or else of this package
    :raises FileNotFoundError: If neither has one
    """
    package = Path(__file__).resolve().parent
    # In a source checkout, which an editable installation is too, the folder lies beside the package
    candidates = [folder / "zoo_configs" / f"{algo}.yml" for folder in (Path.cwd(), package, package.parent)]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"No hyperparameters for '{algo}': there is no {candidates[0]}, and sb3_lac brings none. "
        "Run from a folder with zoo_configs, or pass a YAML file with -conf."
    )


def main(args: Sequence[str] | None = None) -> None:
    """
    Run a command of the RL Zoo, with LAC and its hyperparameters as default.

    :param args: Command and options, those of the command line by default
    """
    prog = "python -m sb3_lac.zoo"
    parser = argparse.ArgumentParser(prog=prog, description="RL Zoo with LAC")
    parser.add_argument("command", choices=["train", "enjoy", "optimize"], help="what to do")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="options of the RL Zoo, add --help to see them")
    parsed = parser.parse_args(args)

    # Only the options with another default are read here, the RL Zoo reads all of them from sys.argv
    defaults = argparse.ArgumentParser(prog=prog, add_help=False)
    defaults.add_argument("--algo", default="lac")
    if parsed.command != "enjoy":
        defaults.add_argument("-conf", "--conf-file")
    known, options = defaults.parse_known_args(parsed.options)
    options += ["--algo", known.algo]
    if parsed.command != "enjoy":
        try:
            options += ["--conf-file", known.conf_file or str(find_config(known.algo))]
        except FileNotFoundError as error:
            parser.error(str(error))
    if parsed.command == "optimize":
        options += ["--optimize-hyperparameters"]

    sys.argv = [f"{prog} {parsed.command}", *options]
    if parsed.command == "enjoy":
        rl_zoo3.enjoy.enjoy()
    else:
        rl_zoo3.train.train()


if __name__ == "__main__":
    main()
