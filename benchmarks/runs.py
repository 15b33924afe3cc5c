"""
Trainings that together take days, none of which may be lost. A training is known by what was run, and not by the code that ran
it: one that is done is a row of a table, or a model with its record beside it; one in progress has a checkpoint. It needs
Stable-Baselines3 and this project, and no RL Zoo, so that a bare machine can make rows, too.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from hashlib import sha256
from inspect import signature
from io import BytesIO
from pathlib import Path
from pydoc import locate
from typing import Any
from zipfile import ZipFile

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
import yaml
from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from battery_env.files import replacing
from benchmarks.study import (
    Study,
    command_line,
    digest_of,
    importable,
    natural,
    own_versions,
    positive,
    recall,
    table_file,
    versions,
    write_csv,
    write_json,
)
from sb3_lac import GymnasiumVecEnv
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.vec_env import steps_as_one_batch

#: A policy is judged so often while it is trained, at even distances, of which the last is the end.
POINTS = 10
#: The column of each time, by percent of the training, and of the last one.
CURVE = {100 * point // POINTS: f"after_{100 * point // POINTS}_percent" for point in range(1, POINTS + 1)}
AT_THE_END = CURVE[100]
#: What is lost at most when a training is killed.
CHECKPOINT_EVERY_S = 120.0
#: Packages that are known by their release, and not by their files.
RELEASED = ("sb3_lac", "stable_baselines3", "sb3_contrib")
_KEY = ["task", "algorithm", "seed", "timesteps", "package", "configuration"]
#: Arguments of algorithms that a run states elsewhere, or that change nothing but rounding.
NOT_LEARNING = {"seed", "verbose", "device", "tensorboard_log", "stats_window_size", "compile_update", "_init_setup_model"}
_SETTING_OF_LAC = Path(__file__).parents[1] / "zoo_configs" / "lac.yml"
_NOISES = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}


def control_networks(root: int | None = None) -> str:
    """Arguments of policies for all control problems, as in a file of ``zoo_configs``; only critics of LAC have a root."""
    of_root = "" if root is None else f", root={root}"
    return f"dict(net_arch=[64, 64], activation_fn=nn.LeakyReLU{of_root})"


def setting_of_lac(root: int | None = None) -> dict[str, Any]:
    """The one setting of LAC for all control problems, without its number of steps, and with a root or none."""
    entry = yaml.safe_load(_SETTING_OF_LAC.read_text(encoding="utf-8"))["default"]
    entry["policy_kwargs"] = control_networks(root)
    return {name: value for name, value in entry.items() if name not in ("policy", "n_timesteps")}


def _evaluated(setting: Any) -> Any:
    """A setting that files of ``zoo_configs`` have as text."""
    return eval(setting, {"nn": th.nn}) if isinstance(setting, str) else setting


def registered_id(env_id: str) -> str:
    """Import the module that registers an environment, where one is named, and return the id alone."""
    module, _, plain_id = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{env_id} is no environment: {error}") from error
    return plain_id


@dataclass(frozen=True)
class Run:
    """One training."""

    task: str  # id of the environment, as module:id if importing that module registers it
    algorithm: str  # the name of class and settings together
    kind: str  # the class, package:Class
    seed: int
    timesteps: int
    settings: Mapping[str, Any] = field(default_factory=dict)  # that are no defaults, as in a file of zoo_configs
    environment: Mapping[str, Any] = field(default_factory=dict)  # arguments of it

    @property
    def key(self) -> dict[str, Any]:
        """Columns that tell its row from other rows."""
        package, name = self.kind.split(":")
        modules = [package, *self.task.split(":")[:-1]]
        configuration = {"class": name, "settings": self.settings, "environment": self.environment, "defaults": self.defaults}
        made_by = ", ".join(_version(module) for module in modules)
        values = (self.task, self.algorithm, self.seed, self.timesteps, made_by, json.dumps(configuration))
        return dict(zip(_KEY, values, strict=True))

    @property
    def defaults(self) -> dict[str, Any]:
        """Defaults of the class where nothing is stated: a change of a default makes another training."""
        critic = getattr(self.type.policy_aliases.get("MlpPolicy"), "critic_class", None)
        parameters = [each for kind in (self.type, critic) if kind for each in signature(kind).parameters.values()]
        stated = NOT_LEARNING | set(self.settings) | set(_evaluated(self.settings.get("policy_kwargs", {})))
        return {
            each.name: each.default
            for each in parameters
            if isinstance(each.default, int | float | str) and each.name not in stated
        }

    @property
    def digest(self) -> str:
        """Names the run but for its seed."""
        return digest_of({name: value for name, value in self.key.items() if name != "seed"})

    @property
    def name(self) -> str:
        """A name for files, that no other run has."""
        name = f"{self.task}_{self.algorithm}_seed{self.seed}_{self.digest}"
        return name.replace(", ", "_").replace(" ", "_").replace(":", "_")

    @property
    def type(self) -> type[BaseAlgorithm]:
        """The class."""
        package, name = self.kind.split(":")
        return getattr(importlib.import_module(package), name)

    @property
    def n_envs(self) -> int:
        """Copies of the environment that it is trained in."""
        return self.settings.get("n_envs", 1)

    def environments(self, n_envs: int | None = None, **options: Any) -> VecEnv:
        """Copies of its environment, with its arguments or others, stepped by one call where that can be done."""
        n_envs, arguments = n_envs or self.n_envs, options or self.environment
        spec, wrapper = gym.spec(registered_id(self.task)), self.settings.get("env_wrapper")
        if wrapper is None and steps_as_one_batch(spec):
            return VecMonitor(GymnasiumVecEnv(gym.make_vec(spec, n_envs, autoreset_mode="SameStep", **arguments)))
        wrapper_class: Any = wrapper and locate(wrapper)
        return make_vec_env(partial(gym.make, self.task, **arguments), n_envs, wrapper_class=wrapper_class)

    def model(self, env: VecEnv, compiled: bool = False) -> BaseAlgorithm:
        """A model that has learned nothing yet."""
        of_dicts = isinstance(env.observation_space, gym.spaces.Dict)
        settings = {"policy": "MultiInputPolicy" if of_dicts else "MlpPolicy", **self.settings}
        for name in ("n_envs", "env_wrapper"):
            settings.pop(name, None)
        for name, value in settings.items():
            if isinstance(value, str) and value.startswith("lin_"):
                settings[name] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
            elif isinstance(value, list):
                settings[name] = tuple(value)  # of steps or episodes between updates
            elif name in ("policy_kwargs", "replay_buffer_kwargs"):
                settings[name] = dict(_evaluated(value))  # algorithms write into it
        if (noise := settings.pop("noise_type", None)) is not None:
            n_actions = gym.spaces.flatdim(env.action_space)
            std = np.full(n_actions, settings.pop("noise_std"))
            settings["action_noise"] = _NOISES[noise](np.zeros(n_actions), std)
        if compiled and issubclass(self.type, CostAlgorithm):
            settings["compile_update"] = True
        if issubclass(self.type, OffPolicyAlgorithm):
            # no larger than it becomes: it lies in each checkpoint
            steps = -(-self.timesteps // env.num_envs) * env.num_envs
            settings["buffer_size"] = min(settings.get("buffer_size", steps), steps)
        return self.type(env=env, seed=self.seed, device="cpu", **settings)


def _version(module: str) -> str:
    """Name a module by its release, or the one to come, and a module of one's own by its source."""
    if module in RELEASED:
        return f"{module} {importlib.import_module(module).__version__.partition('.dev')[0]}"
    try:
        file = Path(inspect.getfile(importlib.import_module(module)))
    except TypeError as error:
        raise ValueError(f"{module} has no file of its own: name the module that defines what you mean") from error
    top, files = file.parent, [file]
    # of the benchmarks one file too: a change of another one must not discard a run
    if (top / "__init__.py").exists() and top != Path(__file__).parent:
        # of a package all files, for the module that is named may only pass on what others define
        while (top.parent / "__init__.py").exists():
            top = top.parent
        files = [path for path in sorted(top.rglob("*.py")) if (path.parent / "__init__.py").exists()]
    digests = {path.relative_to(top).as_posix(): sha256(path.read_bytes()).hexdigest() for path in files}
    return f"{module} {digest_of(digests | own_versions())}"


@dataclass(frozen=True)
class Rows:
    """The trainings that are done, in a table of a folder that several commands may add to."""

    folder: Path

    def read(self, types: Any = None) -> pd.DataFrame:
        """All rows; none if there is no file yet."""
        file = table_file(self.folder, "runs")
        return pd.read_csv(file, dtype=types) if file.exists() else pd.DataFrame(columns=_KEY)

    def of(self, runs: Sequence[Run]) -> pd.DataFrame:
        """The rows of trainings in their order, of the last release that made one."""
        identity = ["task", "algorithm", "seed", "timesteps"]
        last_rows = self.read().drop_duplicates(identity, keep="last").set_index(identity)
        keys = [(run.task, run.algorithm, run.seed, run.timesteps) for run in runs]
        return last_rows.loc[[each for each in keys if each in last_rows.index]].reset_index()

    def has(self, run: Run) -> bool:
        """Tell whether a training is done."""
        rows = self.read()
        return bool((rows[_KEY].astype(str) == pd.Series(run.key).astype(str)).all(axis="columns").any())

    def add(self, rows: pd.DataFrame) -> None:
        """Add rows. Of two of the same training the first stays."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / ".runs.lock"):
            # as texts: no number changes for being read and written
            table = pd.concat([self.read(str), rows.astype({name: str for name in _KEY})])
            write_csv(self.folder, "runs", table.drop_duplicates(_KEY).to_csv(index=False))


class OutOfTimeError(Exception):
    """The time of a training is over before the training is, and what it has learned lies in its checkpoint."""


#: What tells how good the model of a run is, in numbers that JSON can hold.
Judge = Callable[[Any, Run], Any]


class Progress(BaseCallback):
    """Judges a policy while it is trained, and keeps checkpoints; at a deadline, as ``time.time()`` has it, it stops."""

    def __init__(self, run: Run, file: Path, judge: Judge | None = None, deadline: float = np.inf) -> None:
        super().__init__()
        self.run, self.file, self.judge, self.deadline = run, file, judge, deadline
        self.curve: list[Any] = []  # what the judge said, at even distances
        # wall time without that of the judge, and how often the training went on from a checkpoint
        self.seconds, self.resumed = 0.0, 0

    def _on_training_start(self) -> None:
        self._last = self._saved = time.perf_counter()

    def _on_rollout_start(self) -> None:
        # between two calls of train(): in the middle of a roll-out, one would be left out
        self._count_time()
        is_over = time.time() > self.deadline
        if is_over or self._last - self._saved > CHECKPOINT_EVERY_S:
            self._save()
        if is_over:
            raise OutOfTimeError

    def _on_step(self) -> bool:
        if len(self.curve) + 1 < POINTS and self.num_timesteps >= self.run.timesteps * (len(self.curve) + 1) / POINTS:
            self._judge()
        return True

    def _on_training_end(self) -> None:
        self._judge()

    def _count_time(self) -> None:
        now = time.perf_counter()
        self.seconds += now - self._last
        self._last = now

    def _judge(self) -> None:
        self._count_time()
        self.curve.append(None if self.judge is None else self.judge(self.model, self.run))
        self._last = time.perf_counter()

    def _save(self) -> None:
        saves: dict[str, Callable[[BytesIO], None]] = {"model.zip": self.model.save}
        if isinstance(self.model, OffPolicyAlgorithm):
            saves["replay_buffer.pkl"] = self.model.save_replay_buffer
        progress = {"curve": self.curve, "seconds": self.seconds, "resumed": self.resumed}
        with replacing(self.file) as part, ZipFile(part, "w") as archive:
            for name, save in saves.items():
                save(content := BytesIO())
                archive.writestr(name, content.getvalue())
            archive.writestr("progress.json", json.dumps(progress))
        self._saved = time.perf_counter()

    def resume(self, env: VecEnv) -> BaseAlgorithm:
        """The model of the checkpoint."""
        with ZipFile(self.file) as archive:
            model = self.run.type.load(BytesIO(archive.read("model.zip")), env, device="cpu")
            if isinstance(model, OffPolicyAlgorithm):
                model.load_replay_buffer(BytesIO(archive.read("replay_buffer.pkl")))
            progress = json.loads(archive.read("progress.json"))
        self.curve, self.seconds, self.resumed = progress["curve"], progress["seconds"], progress["resumed"] + 1
        # not the starts and the noise of the beginning once more
        model.set_random_seed(self.run.seed + 1_000_000 * self.resumed)
        return model


def train(
    progress: Progress, compiled: bool = False, callbacks: Sequence[BaseCallback] = (), log: Path | None = None
) -> BaseAlgorithm:
    """Train on one thread of the CPU, from the checkpoint if there is one; to compile updates changes nothing but the time."""
    th.set_num_threads(1)
    run = progress.run
    with closing(run.environments()) as env:
        model = progress.resume(env) if progress.file.exists() else run.model(env, compiled)
        for callback in callbacks:
            callback.n_calls = model.num_timesteps // env.num_envs  # their evaluations stay at even distances
        model.set_logger(Logger(None, []) if log is None else configure(str(log), ["tensorboard"]))
        with closing(model.logger):
            model.learn(run.timesteps - model.num_timesteps, [*callbacks, progress], reset_num_timesteps=False)
    return model


def train_or_load(
    run: Run,
    folder: Path,
    judge: Judge | None = None,
    callbacks: Sequence[BaseCallback] = (),
    compiled: bool = False,
    log: Path | None = None,
) -> BaseAlgorithm:
    """Train one policy and keep it in a folder, with what made it beside it, or load it if that has been done."""
    folder.mkdir(parents=True, exist_ok=True)
    record = record_file(run, folder)
    try:
        with FileLock(folder / f".{run.name}.lock", timeout=0):
            if recall(record) is None or not record.with_suffix(".zip").exists():
                progress = Progress(run, checkpoint_file(run, folder), judge)
                model = train(progress, compiled, callbacks, log or folder)
                with replacing(record.with_suffix(".zip")) as part:
                    model.save(part)
                content = {"run": asdict(run), "defaults": run.defaults, "versions": versions(), "resumed": progress.resumed}
                # of all algorithms that count them
                content |= {"updates": getattr(model, "_n_updates", None), "timesteps": model.num_timesteps}
                content |= {"training_minutes": progress.seconds / 60.0, "curve": progress.curve}
                write_json(record, content)
                progress.file.unlink(missing_ok=True)
    except Timeout as error:
        raise RuntimeError(f"another process is busy with {folder}: wait for it, or choose another --out") from error
    return run.type.load(record.with_suffix(".zip"), device="cpu")


def record_file(run: Run, folder: Path) -> Path:
    """File in which :func:`train_or_load` records what made a model."""
    return folder / f"model_{run.name}.json"


def checkpoint_file(run: Run, folder: Path) -> Path:
    """File of the checkpoint of a training."""
    return folder / f"checkpoint_{run.name}.zip"


def made_by(run: Run, folder: Path) -> dict[str, Any]:
    """Read the record of a model that is there."""
    record = recall(record_file(run, folder))
    assert record is not None
    return record


@dataclass(frozen=True)
class Trainer:
    """Makes rows, in any process."""

    folder: Path  # of the table of rows
    checkpoints: Path
    judge: Judge
    describe: Judge | None = None  # more numbers of a model in the end, by name
    deadline: float = np.inf
    compiled: bool = False

    def __call__(self, run: Run) -> None:
        """Make the row of a training, unless it is there, another command is at it, or the time is over."""
        self.checkpoints.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(self.checkpoints / f".{run.name}.lock", timeout=0):
                if time.time() < self.deadline and not Rows(self.folder).has(run):
                    self._train(run)
        except (Timeout, OutOfTimeError):
            return

    def _train(self, run: Run) -> None:
        progress = Progress(run, checkpoint_file(run, self.checkpoints), self.judge, self.deadline)
        model = train(progress, self.compiled)
        machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
        provenance = {"minutes": progress.seconds / 60.0, "resumed": progress.resumed, "machine": machine}
        provenance["versions"] = ", ".join(f"{name} {version}" for name, version in versions().items())
        curve = dict(zip(CURVE.values(), progress.curve, strict=False))
        row = {**run.key, **curve, **(self.describe(model, run) if self.describe else {}), **provenance}
        Rows(self.folder).add(pd.DataFrame([row]))
        progress.file.unlink(missing_ok=True)


def rows_command_line(name: str, document: str | None, timesteps: str) -> argparse.ArgumentParser:
    """Make the command line of a study of such rows, whose folder is that of the published tables."""
    parser = command_line(name, document)
    parser.set_defaults(out=Path("docs/results") / name)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[1, 2, 3, 4, 5])
    parser.add_argument("--timesteps", type=positive, help=f"environment steps of each training; {timesteps} by default")
    parser.add_argument("--compile", action="store_true", help="compile the updates of LAC; minutes are then no comparison")
    parser.add_argument("--minutes", type=positive, help="then trainings stop, with a checkpoint, and none begins")
    parser.add_argument("--checkpoints", type=Path, default=Path("results") / name, help="folder of trainings in progress")
    parser.add_argument("--merge", nargs="+", type=Path, default=[], metavar="CSV", help="tables whose rows are taken in, too")
    return parser


def make_rows(study: Study, runs: Sequence[Run], judge: Judge, describe: Judge | None = None) -> pd.DataFrame:
    """Make the rows of a study that are missing, and return those of each task and algorithm that then has all its seeds."""
    chosen = study.chosen
    for name in ("minutes", "checkpoints", "merge"):
        del study.configuration[name]  # which change no row
    rows = Rows(study.out)
    for file in chosen.merge:
        rows.add(pd.read_csv(file, dtype=str))
    if not study.redraws:
        deadline = time.time() + 60 * chosen.minutes if chosen.minutes else np.inf
        describe = importable(describe) if describe else None
        trainer = Trainer(study.out, chosen.checkpoints, importable(judge), describe, deadline, chosen.compile)
        study.each(trainer, [(run,) for run in runs if not rows.has(run)])
    rows_of_runs = rows.of(runs)
    # fewer seeds would make a table of another kind
    complete = rows_of_runs[rows_of_runs.groupby(["task", "algorithm"])["seed"].transform("nunique") == len(set(chosen.seeds))]
    if complete.empty:
        raise SystemExit("No algorithm has all of its seeds on a task yet: the same command goes on from the checkpoints.")
    return complete
