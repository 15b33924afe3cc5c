"""What TensorBoard needs to show several runs as one comparison: charts that overlay them, and a table of hyperparameters."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams as hparams_summaries

#: Charts by category and title, as ``SummaryWriter.add_custom_scalars()`` takes them: ``["Multiline", tags]``, of which each
#: is a regular expression, or ``["Margin", [value, low, high]]``
Charts = Mapping[str, Mapping[str, list]]

#: What to exclude a figure from: all formats of the logger but TensorBoard
NOT_TENSORBOARD = ("stdout", "log", "json", "csv")

#: The charts of every run. A run that does not log a tag is left out of its chart.
CHARTS: Charts = {
    "Comparison": {
        "cost of an evaluation episode, log10": ["Multiline", ["eval/cost_log10$"]],
        "return of an evaluation": ["Multiline", ["eval/mean_reward$"]],
        "length of an evaluation episode": ["Multiline", ["eval/mean_ep_length$"]],
        "return of the training episodes": ["Multiline", ["rollout/ep_rew_mean$"]],
        "cost per step of the training": ["Multiline", ["rollout/cost_mean$"]],
    },
    "Lyapunov": {
        "lambda": ["Multiline", ["train/lambda$"]],
        "decrease along roll-outs": ["Multiline", ["lyapunov/decrease$"]],
        "decrease in the replay buffer": ["Multiline", ["train/lyapunov_difference$"]],
        "largest feasible alpha3": ["Multiline", ["lyapunov/feasible_alpha3$"]],
    },
}

# Arguments of algorithms that change nothing of what is learned
_NOT_LEARNING = {"device", "tensorboard_log", "verbose", "stats_window_size"}


def tensorboard_writer(logger: Logger) -> SummaryWriter | None:
    """The writer of TensorBoard files behind a logger."""
    return next((output.writer for output in logger.output_formats if isinstance(output, TensorBoardOutputFormat)), None)


def _plain(value: Any) -> Any:
    """A single number of numpy or PyTorch as one of Python, which is what TensorBoard takes; anything else as it is."""
    return value.item() if getattr(value, "shape", None) in ((), (1,)) else value


def hyperparameters_of(model: BaseAlgorithm) -> dict[str, bool | str | float]:
    """
    The hyperparameters of a model that a table can hold: numbers, texts, schedules, and ``net_arch`` of ``policy_kwargs``.
    """
    values: dict[str, Any] = {"algorithm": type(model).__name__, "n_envs": model.n_envs}
    # Those that a class hands on to the one above it as ``**kwargs``, too
    names = {name for kind in type(model).__mro__ for name in inspect.signature(kind).parameters}
    values |= {name: _plain(getattr(model, name, None)) for name in sorted(names)}
    if "net_arch" in model.policy_kwargs:
        values["net_arch"] = str(model.policy_kwargs["net_arch"])
    hyperparameters: dict[str, bool | str | float] = {}
    for name, value in values.items():
        if name in _NOT_LEARNING:
            continue
        if isinstance(value, ConstantSchedule):
            hyperparameters[name] = value.val
        elif isinstance(value, TrainFreq):
            hyperparameters[name] = f"{value.frequency} {value.unit.value}"
        elif isinstance(value, (bool, int, float, str)):
            hyperparameters[name] = value
        elif name.endswith("learning_rate") and callable(value):
            hyperparameters[name] = getattr(value, "__name__", repr(value))
    return hyperparameters


class _LogarithmOfCosts(KVWriter):
    """Writes what an evaluation costs as a logarithm, since returns are negative and have no logarithmic axis."""

    def __init__(self, writer: SummaryWriter):
        self.writer = writer

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        if (cost := -key_values.get("eval/mean_reward", 0.0)) > 0.0:
            self.writer.add_scalar("eval/cost_log10", math.log10(cost), step)
            self.writer.flush()

    def close(self) -> None:
        """Leave the file to the format whose it is."""


class DashboardCallback(BaseCallback):
    """
    Callback that makes TensorBoard show all runs of a folder as one comparison, without an effect on the training. It writes

    - the layout of the Custom Scalars tab: one chart per quantity, with all runs in it
    - the hyperparameters for the HParams tab, next to the last value of each scalar of the run
    - ``rollout/cost_mean``, the mean of finite ``info["cost"]`` over the steps since the last entry, if the environment has
      costs
    - ``eval/cost_log10``, the logarithm of the cost (minus the return) of an episode of ``EvalCallback``

    For evaluations use ``EvalCallback`` (``eval/``), ``LyapunovCallback`` (``lyapunov/``, of LAC's critic) and
    ``CertificateCallback`` (``certificate/``, of any algorithm).

    :param charts: More charts, like ``battery_env.callbacks.CALIBRATION_CHARTS``, shown first. All runs should have the same
        charts.
    :param hparams: More hyperparameters, like the id of the environment, with precedence over those of the model. Values other
        than numbers are written as text.
    :param verbose: Verbosity level, without a meaning here
    """

    def __init__(
        self,
        charts: Charts | None = None,
        hparams: Mapping[str, Any] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.charts: Charts = {**(charts or {}), **CHARTS}
        plain = {name: _plain(value) for name, value in (hparams or {}).items()}
        self.hparams = {
            name: value if isinstance(value, (bool, int, float, str)) else str(value) for name, value in plain.items()
        }

    def _init_callback(self) -> None:
        if tensorboard_writer(self.logger) is None:
            raise ValueError(
                "DashboardCallback has no TensorBoard file to write to: create the model with tensorboard_log, or use "
                'model.set_logger(configure(folder, ["tensorboard"])).'
            )

    def _on_training_start(self) -> None:
        writer = tensorboard_writer(self.logger)
        assert writer is not None and writer.file_writer is not None
        if not any(isinstance(output, _LogarithmOfCosts) for output in self.logger.output_formats):
            self.logger.output_formats.append(_LogarithmOfCosts(writer))
        writer.add_custom_scalars(self.charts)
        # HParam of Stable-Baselines3 declares columns in each run, of which TensorBoard takes those of one run for all
        _, start, end = hparams_summaries({**hyperparameters_of(self.model), **self.hparams}, metric_dict={})
        writer.file_writer.add_summary(start)
        writer.file_writer.add_summary(end)
        writer.flush()

    def _on_step(self) -> bool:
        # not every algorithm hands over what the environment said (ARS does not)
        logged = [_plain(info.get("cost")) for info in self.locals.get("infos", ())]
        # Environments of others use that key for other things, too
        costs = [float(cost) for cost in logged if isinstance(cost, (int, float)) and abs(cost) <= sys.float_info.max]
        if costs:
            self.logger.record_mean("rollout/cost_mean", float(np.mean(costs)))
        return True
