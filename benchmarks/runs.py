"""
Trainings that together take days, none of which may be lost. One that is done is a row of a table, known by what was run and
not by the code that ran it; one in progress has a checkpoint. It needs Stable-Baselines3 and this project, and no RL Zoo, so
that a bare machine can make rows, too.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from inspect import signature
from io import BytesIO
from pathlib import Path
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
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from battery_env.files import replacing
from benchmarks.study import Study, command_line, digest_of, importable, natural, positive, table_file, versions, write_csv

#: A policy is judged so often while it is trained, at even distances, of which the last is the end.
POINTS = 10
#: The column of the last time.
AT_THE_END = "after_100_percent"
#: What is lost at most when a training is killed.
CHECKPOINT_EVERY_S = 120.0
_KEY = ["task", "algorithm", "seed", "timesteps", "package", "configuration"]
#: Arguments of algorithms that a run states elsewhere, or that change nothing but rounding.
NOT_LEARNING = {"seed", "verbose", "device", "tensorboard_log", "stats_window_size", "compile_update", "_init_setup_model"}
_SETTING_OF_LAC = Path(__file__).parents[1] / "zoo_configs" / "lac.yml"


def setting_of_lac(root: int | None = 4) -> dict[str, Any]:
    """The one setting of LAC for all control problems, without its number of steps; other algorithms have no root."""
    entry = yaml.safe_load(_SETTING_OF_LAC.read_text(encoding="utf-8"))["default"]
    entry["policy_kwargs"] = entry["policy_kwargs"].replace(", root=4", "" if root is None else f", root={root}")
    return {name: value for name, value in entry.items() if name not in ("policy", "n_timesteps")}


@dataclass(frozen=True)
class Run:
    """
    One training.

    :param task: id of the environment
    :param algorithm: the name of class and settings together
    :param kind: the class, ``package:Class``
    :param seed: seed of everything
    :param timesteps: environment steps
    :param settings: what differs from the defaults of the class, as in a file of ``zoo_configs``
    :param environment: arguments of the environment
    """

    task: str
    algorithm: str
    kind: str
    seed: int
    timesteps: int
    settings: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> dict[str, Any]:
        """What tells its row from others. A class is known by its package and the release, or the one to come."""
        package, name = self.kind.split(":")
        release = importlib.import_module(package).__version__.partition(".dev")[0]
        configuration = {"class": name, "settings": self.settings, "environment": self.environment, "defaults": self.defaults}
        values = (self.task, self.algorithm, self.seed, self.timesteps, f"{package} {release}", json.dumps(configuration))
        return dict(zip(_KEY, values, strict=True))

    @property
    def defaults(self) -> dict[str, Any]:
        """What the class has where nothing is stated: a change of a default makes another training."""
        critic = getattr(self.type.policy_aliases["MlpPolicy"], "critic_class", None)
        parameters = [each for kind in (self.type, critic) if kind for each in signature(kind).parameters.values()]
        networks = eval(self.settings.get("policy_kwargs", "dict()"), {"nn": th.nn})
        stated = NOT_LEARNING | set(self.settings) | set(networks)
        return {
            each.name: each.default
            for each in parameters
            if isinstance(each.default, int | float | str) and each.name not in stated
        }

    @property
    def name(self) -> str:
        """A name for files, that no other run has."""
        return f"{self.task}_{self.algorithm}_seed{self.seed}_{digest_of(self.key)}".replace(", ", "_").replace(" ", "_")

    def environments(self) -> VecEnv:
        """What it is trained in."""
        return make_vec_env(partial(gym.make, self.task, **self.environment), self.settings.get("n_envs", 1))

    @property
    def type(self) -> type[OffPolicyAlgorithm]:
        """The class."""
        package, name = self.kind.split(":")
        return getattr(importlib.import_module(package), name)

    def model(self, env: VecEnv, compiled: bool) -> OffPolicyAlgorithm:
        """A model that has learned nothing yet."""
        settings = dict(self.settings)
        settings.pop("n_envs", None)
        for name, value in settings.items():
            if isinstance(value, str) and value.startswith("lin_"):
                settings[name] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
        if isinstance(networks := settings.get("policy_kwargs"), str):
            settings["policy_kwargs"] = eval(networks, {"nn": th.nn})
        if settings.pop("noise_type", None) == "normal":
            n_actions = gym.spaces.flatdim(env.action_space)
            settings["action_noise"] = NormalActionNoise(np.zeros(n_actions), np.full(n_actions, settings.pop("noise_std")))
        if compiled:
            settings["compile_update"] = True
        # no larger than it becomes: it lies in each checkpoint
        settings["buffer_size"] = min(settings.get("buffer_size", self.timesteps), self.timesteps)
        return self.type("MlpPolicy", env, seed=self.seed, device="cpu", **settings)


class Rows:
    """
    The trainings that are done, in a table that several commands may add to.

    :param folder: where the table lies, ``runs.csv`` or, of many rows, ``runs.csv.gz``
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, types: Any = None) -> pd.DataFrame:
        """All rows; none if there is no file yet."""
        file = table_file(self.folder, "runs")
        return pd.read_csv(file, dtype=types) if file.exists() else pd.DataFrame(columns=_KEY)

    def of(self, runs: Sequence[Run]) -> pd.DataFrame:
        """The rows of trainings in their order, of the last release that made one."""
        who = ["task", "algorithm", "seed", "timesteps"]
        known = self.read().drop_duplicates(who, keep="last").set_index(who)
        wanted = [(run.task, run.algorithm, run.seed, run.timesteps) for run in runs]
        return known.loc[[each for each in wanted if each in known.index]].reset_index()

    def has(self, run: Run) -> bool:
        """Whether a training is done."""
        rows = self.read()
        return bool((rows[_KEY].astype(str) == pd.Series(run.key).astype(str)).all(axis="columns").any())

    def add(self, rows: pd.DataFrame) -> None:
        """Add rows. Of two of the same training the first stays."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / ".runs.lock"):
            # as texts: no number changes for being read and written
            together = pd.concat([self.read(str), rows.astype({name: str for name in _KEY})])
            write_csv(self.folder, "runs", together.drop_duplicates(_KEY).to_csv(index=False))


def save_checkpoint(model: BaseAlgorithm, file: Path, progress: Mapping[str, Any]) -> None:
    """Write all that a training needs to go on as one file, which takes the place of the one before as a whole."""
    saves: dict[str, Callable[[BytesIO], None]] = {"model.zip": model.save}
    if isinstance(model, OffPolicyAlgorithm):
        saves["replay_buffer.pkl"] = model.save_replay_buffer
    with replacing(file) as part, ZipFile(part, "w") as archive:
        for name, save in saves.items():
            save(content := BytesIO())
            archive.writestr(name, content.getvalue())
        archive.writestr("progress.json", json.dumps(progress))


class OutOfTimeError(Exception):
    """The time of a training is over before the training is, and what it has learned lies in its checkpoint."""


class Progress(BaseCallback):
    """
    Judges a policy while it is trained, and keeps checkpoints.

    :param timesteps: environment steps of the whole training
    :param judge: gives a model a number
    :param file: the checkpoint
    :param deadline: when to stop, as ``time.time()`` has it
    """

    def __init__(self, timesteps: int, judge: Callable[[OffPolicyAlgorithm], float], file: Path, deadline: float) -> None:
        super().__init__()
        self.timesteps, self.judge, self.file, self.deadline = timesteps, judge, file, deadline
        #: What the judge said after some percent of the training
        self.curve: dict[str, float] = {}
        #: Wall time without that of the judge, and how often the training went on from a checkpoint
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
        if len(self.curve) + 1 < POINTS and self.num_timesteps >= self.timesteps * (len(self.curve) + 1) / POINTS:
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
        assert isinstance(self.model, OffPolicyAlgorithm)
        self.curve[f"after_{100 * (len(self.curve) + 1) // POINTS}_percent"] = self.judge(self.model)
        self._last = time.perf_counter()

    def _save(self) -> None:
        save_checkpoint(self.model, self.file, {"curve": self.curve, "seconds": self.seconds, "resumed": self.resumed})
        self._saved = time.perf_counter()

    def resume(self, run: Run, env: VecEnv) -> OffPolicyAlgorithm:
        """The model of the checkpoint."""
        with ZipFile(self.file) as archive:
            model = run.type.load(BytesIO(archive.read("model.zip")), env, device="cpu")
            model.load_replay_buffer(BytesIO(archive.read("replay_buffer.pkl")))
            progress = json.loads(archive.read("progress.json"))
        self.curve, self.seconds, self.resumed = progress["curve"], progress["seconds"], progress["resumed"] + 1
        # not the starts and the noise of the beginning once more
        model.set_random_seed(run.seed + 1_000_000 * self.resumed)
        return model


@dataclass(frozen=True)
class Trainer:
    """
    Makes rows, in any process.

    :param folder: where the table of rows lies
    :param checkpoints: folder of the trainings in progress
    :param judge: gives the model of a training a number, while it is trained
    :param describe: gives it more of them in the end, by name
    :param deadline: when trainings stop, with a checkpoint, as ``time.time()`` has it
    :param compiled: whether updates are compiled where they can be, which changes no result but the time
    """

    folder: Path
    checkpoints: Path
    judge: Callable[[OffPolicyAlgorithm, Run], float]
    describe: Callable[[OffPolicyAlgorithm, Run], Mapping[str, float]] | None = None
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
        th.set_num_threads(1)
        file = self.checkpoints / f"{run.name}.zip"
        progress = Progress(run.timesteps, lambda model: self.judge(model, run), file, self.deadline)
        env = run.environments()
        try:
            compiled = self.compiled and run.kind.startswith("sb3_lac:")
            model = progress.resume(run, env) if file.exists() else run.model(env, compiled)
            model.learn(run.timesteps - model.num_timesteps, progress, reset_num_timesteps=False)
        finally:
            env.close()
        machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
        made = {"minutes": progress.seconds / 60.0, "resumed": progress.resumed, "machine": machine}
        made["versions"] = ", ".join(f"{name} {version}" for name, version in versions().items())
        described = self.describe(model, run) if self.describe else {}
        row = {**run.key, **progress.curve, **described, **made}
        Rows(self.folder).add(pd.DataFrame([row]))
        file.unlink(missing_ok=True)


def rows_command_line(name: str, document: str | None, timesteps: str) -> argparse.ArgumentParser:
    """What studies of such rows have in common: their folder is that of what is published."""
    parser = command_line(name, document)
    parser.set_defaults(out=Path("docs/results") / name)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[1, 2, 3, 4, 5])
    parser.add_argument("--timesteps", type=positive, help=f"environment steps of each training; {timesteps} by default")
    parser.add_argument("--compile", action="store_true", help="compile the updates of LAC; minutes are then no comparison")
    parser.add_argument("--minutes", type=positive, help="then trainings stop, with a checkpoint, and none begins")
    parser.add_argument("--checkpoints", type=Path, default=Path("results") / name, help="folder of trainings in progress")
    parser.add_argument("--merge", nargs="+", type=Path, default=[], metavar="CSV", help="tables whose rows are taken in, too")
    return parser


def make_rows(
    study: Study,
    runs: Sequence[Run],
    judge: Callable[[OffPolicyAlgorithm, Run], float],
    describe: Callable[[OffPolicyAlgorithm, Run], Mapping[str, float]] | None = None,
) -> pd.DataFrame:
    """
    Make the rows of ``<out>/runs.csv`` that are missing, in their order, and return those of each task and algorithm that then
    has all of its seeds: fewer would make a table of another kind.

    :raises SystemExit: if none has them yet
    """
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
    done = rows.of(runs)
    whole = done[done.groupby(["task", "algorithm"])["seed"].transform("nunique") == len(set(chosen.seeds))]
    if whole.empty:
        raise SystemExit("No algorithm has all of its seeds on a task yet: the same command goes on from the checkpoints.")
    return whole
