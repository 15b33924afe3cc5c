"""Evaluation of a calibrator while Stable-Baselines3 trains it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from battery_env.files import replacing
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import plot_true_against_inferred

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback, EventCallback
    from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat
except ImportError as error:
    raise ImportError(
        "battery_env.callbacks needs Stable-Baselines3, install it with: pip install './battery_env[sb3]'"
    ) from error

#: Charts of the errors for TensorBoard's Custom Scalars tab, as ``SummaryWriter.add_custom_scalars()`` takes them.
CALIBRATION_CHARTS = {
    "Calibration": {
        "MAPE (%)": ["Multiline", ["calibration/(.*_)?mape_percent$"]],
        "MAPE of the worst discharge (%)": ["Multiline", ["calibration/(.*_)?mape_percent_worst$"]],
    }
}


class CalibrationCallback(EventCallback):
    """
    Callback for evaluating a calibrator on held-out trajectories while it learns.

    .. code-block:: python

      from battery_env import PolicyEstimator, TrajectoryDataset, evaluate
      from battery_env.callbacks import CalibrationCallback
      from sb3_lac import LAC

      _, test = TrajectoryDataset.paper("r_o").split(test=0.3, seed=0)
      held_out = test[::160]
      callback = CalibrationCallback(lambda model: evaluate(PolicyEstimator(model, "BatteryRo-v0"), held_out), eval_freq=5_000)
      LAC("MlpPolicy", "BatteryRo-v0", tensorboard_log="runs").learn(10_000, callback)

    For each metric, it logs the mean over trajectories as ``calibration/<name>``
    and the worst (largest) value as ``calibration/<name>_worst``: smaller is better.
    TensorBoard also gets a figure for each parameter with a metric, ``calibration/<parameter>_inferred``
    (:func:`battery_env.plotting.plot_true_against_inferred`), if the data frame is one of :func:`battery_env.evaluate`.

    .. warning::

      When using multiple environments, each call to  ``env.step()``
      will effectively correspond to ``n_envs`` steps.
      To account for that, you can use ``eval_freq = max(eval_freq // n_envs, 1)``

    :param evaluate: Function that evaluates the model and returns a data frame with one row per held-out trajectory
        and one column per metric, for instance ``lambda model: battery_env.evaluate(PolicyEstimator(model, env_id), test)``.
        It is also called once before the training, to see that it works and has the columns; those results are not logged.
    :param eval_freq: Evaluate the agent every ``eval_freq`` call of the callback.
    :param metrics: Columns to log, or a mapping from columns to the names to log them under.
        The first one decides which model is the best. By default ``<parameter>_mape_percent`` for each parameter that the
        training environment finds (its ``task.parameters``), the mean errors in ``battery_env.evaluate()``.
    :param log_path: Path of a CSV file, updated at each evaluation. If it exists already, its evaluations are kept and
        count for the best model, so that the history of a continued training is complete
        (``learn(..., reset_num_timesteps=False)``). A training that starts anew is refused, whose evaluations it would mix in.
    :param best_model_save_path: Path to a folder where the best model (lowest mean of the first metric) will be saved
        as ``best_model.zip``.
    :param callback_after_eval: Callback to trigger after every evaluation. ``StopTrainingOnNoModelImprovement`` asks for
        ``self.parent.best_mean_reward``, minus the lowest mean of the first metric: ``StopTrainingOnRewardThreshold(-1.0)``
        stops at 1.
    :param verbose: Verbosity level: 0 for no output, 1 for indicating information about evaluation results
    """

    def __init__(
        self,
        evaluate: Callable[[BaseAlgorithm], pd.DataFrame],
        eval_freq: int = 10_000,
        metrics: Sequence[str] | Mapping[str, str] | None = None,
        log_path: str | os.PathLike[str] | None = None,
        best_model_save_path: str | os.PathLike[str] | None = None,
        callback_after_eval: BaseCallback | None = None,
        verbose: int = 1,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        if metrics is not None and (isinstance(metrics, str) or len(metrics) == 0):
            raise ValueError(f"metrics={metrics!r} must be a sequence of at least one column, like ('r_o_mape_percent',).")

        self.evaluate = evaluate
        self.eval_freq = eval_freq
        # Names in the log by column; without a choice the training environment names them
        self.metrics = dict(metrics) if isinstance(metrics, Mapping) else {column: column for column in metrics or ()}
        self.log_path = None if log_path is None else Path(log_path)
        self.best_model_save_path = None if best_model_save_path is None else Path(best_model_save_path)
        self.best_objective = np.inf
        # One entry per evaluation, sorted by timesteps
        self.history: list[dict[str, float]] = []

    @property
    def objective(self) -> str:
        """Name of the metric that decides which model is the best."""
        return next(iter(self.metrics.values()))

    def _default_metrics(self) -> dict[str, str]:
        if not self.training_env.has_attr("task"):
            raise ValueError(
                "metrics must be given: the training environment has no task whose parameters name the default ones."
            )
        columns = [f"{parameter}_mape_percent" for parameter in self.training_env.get_attr("task", indices=0)[0].parameters]
        return {column: column for column in columns}

    @property
    def best_mean_reward(self) -> float:
        """The score for callbacks of Stable-Baselines3 that stop a training: the higher, the better."""
        return -self.best_objective

    def _init_callback(self) -> None:
        if self.log_path is not None:
            self._continue_log(self.log_path)
        if not self.metrics:
            self.metrics = self._default_metrics()
        if self.eval_freq > 0:
            # A mistake shows before the training, instead of at its first evaluation
            self._summarize(self.evaluate(self.model))
        if self.best_model_save_path is not None:
            self.best_model_save_path.mkdir(parents=True, exist_ok=True)
        # An evaluation without a result (NaN) is never the best
        self.best_objective = float(np.nanmin([np.inf, *(entry.get(self.objective, np.inf) for entry in self.history)]))

    def _continue_log(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.stat().st_size == 0:
            return
        if self.model.num_timesteps == 0:
            raise ValueError(
                f"log_path={path} holds the evaluations of another training, and this one starts anew: move the file away, "
                "give another path, or continue with learn(..., reset_num_timesteps=False)."
            )
        records = pd.read_csv(path).to_dict("records")
        self.history = [{str(name): value for name, value in record.items()} for record in records]

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True

        trajectories = self.evaluate(self.model)
        entry = self._summarize(trajectories)
        for name, value in entry.items():
            self.logger.record(f"calibration/{name}", value)
        if any(isinstance(output, TensorBoardOutputFormat) for output in self.logger.output_formats):
            self._record_figures(trajectories)
        # Dump log so the evaluation results are printed with the correct timestep
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

        self._add_to_history({"timesteps": self.num_timesteps, **entry})

        objective = entry[self.objective]
        if self.verbose >= 1:
            print(f"Eval num_timesteps={self.num_timesteps}, {self.objective}={objective:.4g}")
        if objective < self.best_objective:
            if self.verbose >= 1:
                print(f"New best {self.objective}!")
            self.best_objective = objective
            if self.best_model_save_path is not None:
                with replacing(self.best_model_save_path / "best_model.zip") as temporary:
                    self.model.save(temporary)
        # Trigger callback after every evaluation, if needed
        return self._on_event()

    def _add_to_history(self, entry: dict[str, float]) -> None:
        """Add an evaluation, in place of an older one at the same timestep (when continuing from a checkpoint)."""
        history = [evaluation for evaluation in self.history if evaluation["timesteps"] != entry["timesteps"]]
        self.history = sorted([*history, entry], key=lambda evaluation: evaluation["timesteps"])
        if self.log_path is not None:
            with replacing(self.log_path) as temporary:
                pd.DataFrame(self.history).to_csv(temporary, index=False)

    def _record_figures(self, trajectories: pd.DataFrame) -> None:
        for parameter in PARAMETER_NAMES:
            required = {parameter, "load", *(f"{parameter}_{column}" for column in ("hat", "spread", "mape_percent"))}
            if required <= set(trajectories.columns) and any(column.startswith(f"{parameter}_") for column in self.metrics):
                figure = plot_true_against_inferred({f"{self.num_timesteps} steps": trajectories}, parameter)
                self.logger.record(
                    f"calibration/{parameter}_inferred",
                    Figure(figure, close=False),
                    exclude=("stdout", "log", "json", "csv"),
                )

    def _summarize(self, trajectories: pd.DataFrame) -> dict[str, float]:
        """Return mean and worst value of each metric, NaN if a trajectory has no result: then the model is never the best."""
        missing = [column for column in self.metrics if column not in trajectories.columns]
        if missing:
            raise ValueError(
                f"The evaluation has no column {missing}, its columns are {list(trajectories.columns)}: choose from them."
            )
        summary = {}
        for column, name in self.metrics.items():
            summary[name] = float(trajectories[column].mean(skipna=False))
            summary[f"{name}_worst"] = float(trajectories[column].max(skipna=False))
        return summary
