"""
RL Zoo with LAC: training, continuing, hyperparameter search and evaluation from the command line.

.. code-block:: bash

  python -m sb3_lac.zoo train --env Pendulum-v1
  python -m sb3_lac.zoo train --env Pendulum-v1 -i logs/lac/Pendulum-v1_1/Pendulum-v1.zip
  python -m sb3_lac.zoo enjoy --env Pendulum-v1 -f logs --no-render
  python -m sb3_lac.zoo optimize --env Pendulum-v1 --n-trials 50

Options are those of the RL Zoo's modules of these names, with three other defaults: the algorithm is LAC, its environment
Pendulum-v1, and the hyperparameters of ``train`` and ``optimize`` are those of ``find_config()``.
"""

import argparse
import inspect
import runpy
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

try:
    import optuna
    import rl_zoo3.enjoy
    import rl_zoo3.train
    import yaml
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import (
        HYPERPARAMS_CONVERTER,
        HYPERPARAMS_SAMPLER,
        convert_offpolicy_params,
        sample_her_params,
    )
except ImportError as error:
    raise ImportError("sb3_lac.zoo needs the RL Zoo, install it with: pip install 'sb3_lac[zoo]'") from error

from sb3_lac import LAC, DashboardCallback, GymnasiumVecEnv, PublishedLAC
from sb3_lac.vec_env import steps_as_one_batch

#: The algorithms that the RL Zoo gets from this package
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"lac": LAC, "published_lac": PublishedLAC}

_RL_ZOO = Path(rl_zoo3.__file__).parent
#: Where the RL Zoo has its hyperparameters; in a source checkout of it they lie beside the package
RL_ZOO_CONFIGS = (_RL_ZOO if (_RL_ZOO / "hyperparams").is_dir() else _RL_ZOO.parent) / "hyperparams"

# What a sampler of the RL Zoo returns, and what it gets: see ``HYPERPARAMS_SAMPLER``
Hyperparams = dict[str, Any]


def sample_lac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> Hyperparams:
    """Sampler for LAC hyperparams."""
    # n_envs, train_freq and gradient_steps stay those of the configuration: they belong together
    sampled_params: Hyperparams = {
        # gamma from 0.5 to 0.9999
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.5, log=True),
        # From 2**5=32 to 2**10=1024
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 10),
        "learning_rate": trial.suggest_float("learning_rate", 1e-5, 0.005, log=True),
        # Linearly to zero, or not at all
        "learning_rate_falls": trial.suggest_categorical("learning_rate_falls", [False, True]),
        # Polyak coeff
        "tau": trial.suggest_float("tau", 0.001, 0.08, log=True),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
        "activation_fn": trial.suggest_categorical("activation_fn", ["relu", "leaky_relu"]),
        "ent_coef_init": trial.suggest_float("ent_coef_init", 0.001, 100.0, log=True),
        # -n_actions is the default
        "target_entropy": trial.suggest_float("target_entropy", -5.0 * n_actions, 0.0),
        "n_critics": trial.suggest_categorical("n_critics", [1, 2]),
    }
    # Display true values
    trial.set_user_attr("gamma", 1 - sampled_params["one_minus_gamma"])
    trial.set_user_attr("batch_size", 2 ** sampled_params["batch_size_pow"])
    if additional_args["using_her_replay_buffer"]:
        sampled_params = sample_her_params(trial, sampled_params, additional_args["her_kwargs"])
    hyperparams = convert_lac_params(sampled_params)
    # The RL Zoo reads schedules from configurations only
    rate = hyperparams["learning_rate"]
    if isinstance(rate, str):
        hyperparams["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
    return hyperparams


def convert_lac_params(sampled_params: Hyperparams) -> Hyperparams:
    """Convert sampled values to the hyperparameters of LAC, as they stand in a configuration of the RL Zoo."""
    hyperparams = convert_offpolicy_params(sampled_params)
    # Trials of a study of an earlier version do not say
    if hyperparams.pop("learning_rate_falls", False):
        hyperparams["learning_rate"] = f"lin_{hyperparams['learning_rate']}"
    hyperparams["ent_coef"] = f"auto_{hyperparams.pop('ent_coef_init')}"
    hyperparams["policy_kwargs"]["n_critics"] = hyperparams.pop("n_critics")
    return hyperparams


class LACExperimentManager(ExperimentManager):
    """
    Experiment manager that steps all copies of an environment by one call where it can, understands schedules like
    ``lin_5e-5`` for all learning rates, and refuses trainings without an update. It says which file hyperparameters are from:
    for the algorithms of this package that of ``find_config()`` by default. The entry ``default`` of a file knows nothing of
    the environment, and so has the discount that the environment states, if it states one. Logs for TensorBoard are a
    comparison (see ``DashboardCallback``). Trials of a search are scored on held-out discharges where the environment is one
    of battery_env.
    """

    def __init__(self, args: argparse.Namespace, algo: str, env_id: str, *others: Any, **options: Any) -> None:
        if algo in ALGORITHMS and options.get("config") is None:
            options["config"] = str(find_config(algo, env_id))
        super().__init__(args, algo, env_id, *others, **options)
        if self.optimize_hyperparameters and "battery_env." in self.entry_point(env_id) and self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self._eval_env_kwargs_args = {**self.env_kwargs, "split": "test"}

    def read_hyperparameters(self) -> tuple[Hyperparams, Hyperparams]:
        env_id, entries = self.env_name.gym_id, _entries(self.config)
        source = f"the RL Zoo's ({self.config})" if Path(self.config).parent == RL_ZOO_CONFIGS else self.config
        if env_id not in entries and not self._is_atari:
            source += ", entry 'default'"
            custom, discount = self.custom_hyperparams or {}, self._stated_discount(entries.get("default", {}))
            # A trial of a search has a discount of its own
            if discount is not None and "gamma" not in custom and not self.trial_id:
                source += f", with the discount that the environment states, {discount}"
                self.custom_hyperparams = {**custom, "gamma": discount}
        print(f"hyperparameters of {self.algo} on {env_id}: {source}")
        return super().read_hyperparameters()

    def _stated_discount(self, entry: Hyperparams) -> float | None:
        """The discount of the environment, None if it states none, or if the algorithm has none."""
        if "gamma" not in inspect.signature(rl_zoo3.ALGOS[self.algo]).parameters:
            return None
        spec = gym.spec(self.env_name.gym_id)
        make: Callable[..., Any] = gym.make_vec if spec.entry_point is None else gym.make
        env = make(spec, **(self.env_kwargs or entry.get("env_kwargs", {})))
        env.close()
        return env.metadata.get("discount")

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

    def create_callbacks(self) -> None:
        super().create_callbacks()
        if self.tensorboard_log is not None:
            self.callbacks.append(DashboardCallback(hparams={"env": self.env_name}))

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable | None, list[BaseCallback], Callable | None]:
        # Before anything is written
        processed = super()._preprocess_hyperparams(hyperparams)
        signature = inspect.signature(rl_zoo3.ALGOS[self.algo]).parameters
        if "learning_starts" in signature:
            learning_starts = processed[0].get("learning_starts", signature["learning_starts"].default)
            if self.n_timesteps <= learning_starts:
                raise ValueError(
                    f"n_timesteps={self.n_timesteps} must be more than learning_starts={learning_starts}, or nothing is "
                    "learned. Train longer (-n), or start earlier (-params learning_starts:100)."
                )
        return processed

    def _preprocess_normalization(self, hyperparams: dict[str, Any]) -> dict[str, Any]:
        hyperparams = super()._preprocess_normalization(hyperparams)
        # The environment knows the discount and VecNormalize cannot ask it: it takes its default, as where no gamma is given
        if self.normalize_kwargs.get("gamma") == "auto":
            del self.normalize_kwargs["gamma"]
        return hyperparams

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        hyperparams = ExperimentManager._preprocess_schedules(hyperparams)
        # Those of single networks and multipliers
        for name, rate in hyperparams.items():
            if name.endswith("_learning_rate") and rate is not None:
                hyperparams[name] = ExperimentManager._preprocess_schedules({"learning_rate": rate})["learning_rate"]
        return hyperparams


rl_zoo3.ALGOS.update(ALGORITHMS)
HYPERPARAMS_SAMPLER.update(dict.fromkeys(ALGORITHMS, sample_lac_params))
HYPERPARAMS_CONVERTER.update(dict.fromkeys(ALGORITHMS, convert_lac_params))
rl_zoo3.train.ExperimentManager = LACExperimentManager  # type: ignore[misc]


def _entries(config: str | Path) -> dict[str, Hyperparams]:
    """The entries of a configuration, which is one of those that the RL Zoo reads."""
    name = str(config)
    if name.endswith((".yml", ".yaml")):
        return yaml.safe_load(Path(name).read_text(encoding="utf-8")) or {}
    return runpy.run_path(name)["hyperparams"] if name.endswith(".py") else import_module(name).hyperparams


def find_config(algo: str, env_id: str | None = None) -> Path:
    """
    Find the file of hyperparameters of an algorithm: the first one with an entry for the environment, or else the first one
    with the entry ``default``, of ``zoo_configs/<algo>.yml`` in the current folder, that of this package, and that of the RL
    Zoo. Without an id of an environment it is the first one of the former two.
    """
    package = Path(__file__).resolve().parent
    # In a source checkout, which an editable installation is too, the folder lies beside the package
    folders = [folder / "zoo_configs" for folder in (Path.cwd(), package, package.parent)]
    if env_id is not None:
        folders.append(RL_ZOO_CONFIGS)
    files = [path for folder in folders if (path := folder / f"{algo}.yml").is_file()]
    if not files:
        raise FileNotFoundError(
            f"No hyperparameters for '{algo}': there is no {folders[0] / algo}.yml, and sb3_lac brings none. "
            "Run from a folder with zoo_configs, or pass a YAML file with -conf."
        )
    names = () if env_id is None else (env_id, "default")
    return next((path for name in names for path in files if name in _entries(path)), files[0])


def main(args: Sequence[str] | None = None) -> None:
    """Run a command of the RL Zoo, with LAC and its hyperparameters as default."""
    prog = "python -m sb3_lac.zoo"
    parser = argparse.ArgumentParser(prog=prog, description="RL Zoo with LAC")
    parser.add_argument("command", choices=("train", "enjoy", "optimize"), help="what to do")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="options of the RL Zoo, add --help to see them")
    parsed = parser.parse_args(args)
    trains = parsed.command in ("train", "optimize")

    # Only the options with another default are read here, the RL Zoo reads all of them from sys.argv
    defaults = argparse.ArgumentParser(prog=prog, add_help=False)
    defaults.add_argument("--algo", default="lac")
    defaults.add_argument("--env")
    if trains:
        defaults.add_argument("-conf", "--conf-file")
    defaulted, options = defaults.parse_known_args(parsed.options)
    # That of the RL Zoo has discrete actions
    defaulted.env = defaulted.env or ("Pendulum-v1" if defaulted.algo in ALGORITHMS else "CartPole-v1")
    options += ["--algo", defaulted.algo, "--env", defaulted.env]
    if trains:
        # The RL Zoo says which algorithms there are
        with suppress(FileNotFoundError):
            options += ["--conf-file", defaulted.conf_file or str(find_config(defaulted.algo, defaulted.env))]
    if parsed.command == "optimize":
        options += ["--optimize-hyperparameters"]
    sys.argv = [f"{prog} {parsed.command}", *options]
    if trains:
        rl_zoo3.train.train()
    else:
        rl_zoo3.enjoy.enjoy()


if __name__ == "__main__":
    main()
