"""
Training with the hyperparameters of ``zoo_configs``, or with those of the algorithms themselves. What a policy depends on is
its recipe, and every result is named by it.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import inspect
import io
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import gymnasium as gym
import torch as th
import yaml
from filelock import FileLock, Timeout
from rl_zoo3 import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from battery_env.files import replacing
from benchmarks.runs import NOT_LEARNING, save_checkpoint
from benchmarks.study import digest_of, own_versions, recall, versions, write_json, write_text
from sb3_lac.discounts import DEFAULT_DISCOUNT
from sb3_lac.zoo import LACExperimentManager, find_config

#: Environment steps with the algorithms' own hyperparameters, which name none.
DEFAULTS_TIMESTEPS = 20_000
_LABELS = {"published_lac": "LAC as published"}


@dataclass(frozen=True)
class Recipe:
    """
    All that a trained policy depends on: what was chosen and, where nothing was, what the code says. Two trainings with equal
    recipes are the same training. A change of the code that changes results is known by the version of the package. Versions
    of PyTorch and other packages are left out, as an update would discard every run; results record them beside the recipe.

    :param algo: name of an algorithm in the RL Zoo, like ``lac``, or where the class of another one is,
        ``package.module:Class``
    :param env_id: id of the environment, as ``module:id`` if importing that module registers it
    :param seed: seed of everything
    :param timesteps: environment steps
    :param source: where the hyperparameters are from, ``zoo_configs`` or ``defaults``
    :param hyperparameters: as in a file of ``zoo_configs``
    :param arguments: defaults of the algorithm's other arguments
    :param environment: how the environment is registered, and its spaces
    :param packages: versions of the packages of this project; of modules of the user's own, what their source is
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
        updates: int | None = None,
        hyperparameters: dict[str, Any] | None = None,
        settings: str | None = None,
        defaults: bool = False,
        evaluations: int | None = None,
    ) -> Recipe:
        """
        The recipe of a training: with the entry of ``zoo_configs`` for the environment, the ``default`` entry of the algorithm
        that ``settings`` names, or ``defaults``. In place of steps it may be told gradient steps, with one call of ``train()``
        per step of all environments.
        """
        kind = algorithm(algo)
        if not 0 <= seed < 2**32:
            raise ValueError(f"a seed must lie within 0 .. 2**32 - 1, got {seed}")
        environment, metadata = _environment(env_id)
        entry: dict[str, Any]
        if defaults:
            of_dicts = environment["observation_space"].startswith("Dict(")
            source, entry = "defaults", {"policy": "MultiInputPolicy" if of_dicts else "MlpPolicy"}
        else:
            own = getattr(kind, "zoo_config", kind.__name__.lower() if ":" in algo else algo)
            source, config = "zoo_configs", find_config(own if settings is None else settings)
            entries = yaml.safe_load(config.read_text(encoding="utf-8"))
            key = registered_id(env_id) if settings is None else "default"
            if key not in entries:
                raise ValueError(f"{config} has no entry for {key}: add one, or train with the defaults of the algorithm")
            entry = entries[key]
        entry = {**entry, **(hyperparameters or {})}
        in_entry = int(float(entry.pop("n_timesteps", DEFAULTS_TIMESTEPS)))
        if updates is not None:
            n_envs = entry["n_envs"]
            calls = entry["learning_starts"] // n_envs + -(-updates // entry.get("gradient_steps", 1))
            timesteps = n_envs * calls
        timesteps = in_entry if timesteps is None else timesteps
        arguments = {
            name: parameter.default
            for name, parameter in inspect.signature(kind).parameters.items()
            if parameter.default is not parameter.empty and name not in NOT_LEARNING | set(entry)
        }
        if arguments.get("gamma") == "auto":
            arguments["gamma"] = metadata.get("discount", DEFAULT_DISCOUNT)
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
            own_versions() | _own_modules(algo.partition(":"), env_id.rpartition(":")),
            evaluations,
        )

    @property
    def digest(self) -> str:
        """Names the recipe but for its seed."""
        return digest_of({name: value for name, value in asdict(self).items() if name != "seed"})

    @property
    def evaluation_freq(self) -> int:
        """Calls of a callback between two evaluations; 0 if there are none."""
        if self.evaluations is None:
            return 0
        return max(self.timesteps // (self.evaluations * self.hyperparameters.get("n_envs", 1)), 1)

    @property
    def label(self) -> str:
        """What the policy is called in tables and figures."""
        name = self.algo.rpartition(":")[2] if ":" in self.algo else _LABELS.get(self.algo, self.algo.upper())
        return name if self.source == "zoo_configs" else f"{name} {self.source}"

    @property
    def name(self) -> str:
        """A name for files and folders, that no other recipe has."""
        return f"{self.label.replace(' ', '_').lower()}_seed{self.seed}_{self.digest}"


def algorithm(algo: str) -> type[BaseAlgorithm]:
    """Find an algorithm, and let the RL Zoo know one that is not of its own."""
    if algo not in ALGOS and ":" in algo:
        module, _, name = algo.partition(":")
        try:
            found = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"{algo} is no algorithm: {error}") from error
        if not (inspect.isclass(found) and issubclass(found, BaseAlgorithm)):
            raise ValueError(f"{algo} is no algorithm: it must be a subclass of Stable-Baselines3's BaseAlgorithm")
        ALGOS[algo] = found
    if algo not in ALGOS:
        raise ValueError(
            f"{algo} is no algorithm of the RL Zoo; choose from {', '.join(sorted(ALGOS))}, or name a class of your own, "
            "package.module:Class"
        )
    return ALGOS[algo]


def _own_modules(*named: tuple[str, str, str]) -> dict[str, str]:
    return {module: _digest_of_source(module) for module, colon, _ in named if colon}


def _digest_of_source(module: str) -> str:
    try:
        file = Path(inspect.getfile(importlib.import_module(module)))
    except TypeError as error:
        raise ValueError(f"{module} has no file of its own: name the module that defines what you mean") from error
    top = file.parent
    # of the benchmarks one file too: a change of another one must not discard a run
    if not (top / "__init__.py").exists() or top == Path(__file__).parent:
        return digest_of({file.name: sha256(file.read_bytes()).hexdigest()})
    # of a package all files, for the module that is named may only pass on what others define
    while (top.parent / "__init__.py").exists():
        top = top.parent
    files = [path for path in sorted(top.rglob("*.py")) if (path.parent / "__init__.py").exists()]
    return digest_of({path.relative_to(top).as_posix(): sha256(path.read_bytes()).hexdigest() for path in files})


def registered_id(env_id: str) -> str:
    """Import the module that registers an environment, where one is named."""
    module, _, plain_id = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{env_id} is no environment: {error}") from error
    return plain_id


@cache
def _environment(env_id: str) -> tuple[dict[str, Any], dict[str, Any]]:
    plain_id = registered_id(env_id)
    try:
        spec = gym.spec(plain_id)
        env = gym.make(plain_id, disable_env_checker=True)
    except gym.error.Error as error:
        raise ValueError(str(error)) from error
    spaces = {"observation_space": str(env.observation_space), "action_space": str(env.action_space)}
    env.close()
    # which task it is, the id says
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "task"}
    kwargs = json.loads(json.dumps(kwargs, default=str))
    return {"kwargs": kwargs, "max_episode_steps": spec.max_episode_steps, **spaces}, env.metadata


def set_up(recipe: Recipe, folder: Path, **options: Any) -> tuple[LACExperimentManager, BaseAlgorithm]:
    """A model that is ready to learn, on one thread of the CPU."""
    if recipe.hyperparameters.get("normalize"):
        raise ValueError("policies with `normalize` cannot be scored here: their models do not hold the statistics")
    th.set_num_threads(1)
    algorithm(recipe.algo)
    plain_id = registered_id(recipe.env_id)
    # not zoo_configs itself, which may have changed since
    config = folder / f"{recipe.name}.yml"
    write_text(config, yaml.safe_dump({plain_id: {**recipe.hyperparameters, "n_timesteps": recipe.timesteps}}))
    manager = LACExperimentManager(
        argparse.Namespace(),
        recipe.algo,
        plain_id,
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
    return manager, model


class Training:
    """
    One training, ready to begin or, where the recipe has evaluations, to go on from the checkpoint at the last of them.

    :param recipe: what it is made by
    :param folder: where the model is saved, and beside it what made it
    :param options: of the manager of the RL Zoo
    """

    def __init__(self, recipe: Recipe, folder: Path, **options: Any) -> None:
        self.recipe, self.folder = recipe, folder
        self.checkpoint = CheckpointCallback(folder / f"checkpoint_{recipe.name}.zip", recipe.evaluation_freq)
        with tempfile.TemporaryDirectory() as unpacked:
            if self.checkpoint.resumed:
                with ZipFile(self.checkpoint.file) as archive:
                    archive.extractall(unpacked)
                options["trained_agent"] = f"{unpacked}/model.zip"
            self.manager, self.model = set_up(recipe, folder / "zoo", **options)

    def evaluation_env(self) -> VecEnv:
        """One more environment."""
        with contextlib.redirect_stdout(io.StringIO()):
            return self.manager.create_envs(n_envs=1, eval_env=True, no_log=True)

    def run(self, callbacks: Sequence[BaseCallback], log: Path | None = None) -> None:
        """
        Train, and save the model and what made it.

        :param callbacks: of the training
        :param log: folder for TensorBoard; that of the model by default, with a table beside it
        """
        model, record = self.model, record_file(self.recipe, self.folder)
        model.set_logger(configure(str(log or self.folder), ["tensorboard"] if log else ["csv", "tensorboard"]))
        steps = self.recipe.timesteps - model.num_timesteps
        model.learn(steps, [*callbacks, self.checkpoint], reset_num_timesteps=False)
        with replacing(record.with_suffix(".zip")) as part:
            model.save(part)
        made_by = {
            "recipe": asdict(self.recipe),
            "versions": versions(),
            "resumed": self.checkpoint.resumed,
            # of all algorithms that count them
            "updates": getattr(model, "_n_updates", None),
            "timesteps": model.num_timesteps,
            "training_minutes": self.checkpoint.seconds / 60.0,
        }
        write_json(record, made_by)
        self.checkpoint.file.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the environments of the model and its log, however the training went."""
        assert self.model.env is not None
        self.model.env.close()
        self.model.logger.close()


def finished_model(recipe: Recipe, folder: Path) -> BaseAlgorithm | None:
    """The model of a training that is done."""
    record = record_file(recipe, folder)
    if recall(record) is None or not record.with_suffix(".zip").exists():
        return None
    return algorithm(recipe.algo).load(record.with_suffix(".zip"), device="cpu")


def train_or_load(
    recipe: Recipe, folder: Path, callbacks: Sequence[BaseCallback] = (), compile_update: bool = False
) -> BaseAlgorithm:
    """
    Train one policy, or load it if that has been done. Callbacks that change nothing, and whether updates are compiled, are no
    part of the recipe.
    """
    with alone(recipe, folder):
        model = finished_model(recipe, folder)
        if model is None:
            options = {"hyperparams": {"compile_update": True}} if compile_update else {}
            with contextlib.closing(Training(recipe, folder, **options)) as training:
                training.run(callbacks)
            model = finished_model(recipe, folder)
    assert model is not None
    return model


@contextlib.contextmanager
def alone(recipe: Recipe, folder: Path) -> Iterator[None]:
    """Refuse a training that another process is busy with; that it is no more is known when it ends, however it does."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / f".{recipe.name}.lock", timeout=0):
            yield
    except Timeout as error:
        raise RuntimeError(f"another process is busy with {folder}: wait for it, or choose another --out") from error


def training_minutes(recipe: Recipe, folder: Path) -> float:
    """How long :func:`train_or_load` took to train a model."""
    return float(made_by(recipe, folder)["training_minutes"])


def made_by(recipe: Recipe, folder: Path) -> dict[str, Any]:
    """What made a model that is there."""
    record = recall(record_file(recipe, folder))
    assert record is not None
    return record


def record_file(recipe: Recipe, folder: Path) -> Path:
    """Where :func:`train_or_load` says what made a model."""
    return folder / f"model_{recipe.name}.json"


class CheckpointCallback(BaseCallback):
    """
    Keeps a checkpoint of a training, so that it can be resumed whenever it is interrupted; and counts interruptions and time.

    :param file: the checkpoint, of an earlier part of the same training if it exists
    :param save_freq: calls between checkpoints; 0 for none
    """

    def __init__(self, file: Path, save_freq: int) -> None:
        super().__init__()
        self.file, self.save_freq = file, save_freq
        #: How often the training was continued from a checkpoint, and its wall time, evaluations included.
        self.resumed, self.seconds = 0, 0.0
        if save_freq and file.exists():
            with ZipFile(file) as archive:
                before = json.loads(archive.read("progress.json"))
            self.resumed, self.seconds = before["resumed"] + 1, before["seconds"]

    def _on_training_start(self) -> None:
        self._start = time.perf_counter() - self.seconds

    def _on_training_end(self) -> None:
        self.seconds = time.perf_counter() - self._start

    def _on_step(self) -> bool:
        if self.save_freq and self.n_calls % self.save_freq == 0:
            progress = {"resumed": self.resumed, "seconds": time.perf_counter() - self._start}
            save_checkpoint(self.model, self.file, progress)
        return True
