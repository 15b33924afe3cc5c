import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EventCallback


class CalibrationCallback(EventCallback):
    """
    Callback for evaluating a calibrator on held-out trajectories while it learns.
    For each metric, it logs the mean over trajectories as ``calibration/<name>``
    and the worst (largest) value as ``calibration/<name>_worst``: smaller is better.

    .. warning::

      When using multiple environments, each call to  ``env.step()``
      will effectively correspond to ``n_envs`` steps.
      To account for that, you can use ``eval_freq = max(eval_freq // n_envs, 1)``

    :param evaluate: Function that evaluates the model and returns a data frame with one row per held-out trajectory
        and one column per metric.
    :param eval_freq: Evaluate the agent every ``eval_freq`` call of the callback.
    :param metrics: Columns to log, or a mapping from columns to the names to log them under.
        The first one decides which model is the best.
    :param log_path: Path of a CSV file, updated at each evaluation. If it exists already, its evaluations are kept and
        count for the best model, so that the history of a continued training is complete.
    :param best_model_save_path: Path to a folder where the best model (lowest mean of the first metric) will be saved
        as ``best_model.zip``.
    :param callback_on_new_best: Callback to trigger when there is a new best model
    :param callback_after_eval: Callback to trigger after every evaluation
    :param verbose: Verbosity level: 0 for no output, 1 for indicating information about evaluation results
    """

    def __init__(
        self,
        evaluate: Callable[[BaseAlgorithm], pd.DataFrame],
        eval_freq: int = 10_000,
        metrics: Sequence[str] | Mapping[str, str] = ("mape_percent",),
        log_path: str | os.PathLike[str] | None = None,
        best_model_save_path: str | os.PathLike[str] | None = None,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        verbose: int = 1,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        if isinstance(metrics, str) or len(metrics) == 0:
            raise ValueError(f"metrics={metrics!r} must be a sequence of at least one column, like ('mape_percent',).")

        self.callback_on_new_best = callback_on_new_best
        if self.callback_on_new_best is not None:
            # Give access to the parent
            self.callback_on_new_best.parent = self

        self.evaluate = evaluate
        self.eval_freq = eval_freq
        self.metrics = dict(metrics) if isinstance(metrics, Mapping) else {column: column for column in metrics}
        self.log_path = None if log_path is None else Path(log_path)
        self.best_model_save_path = None if best_model_save_path is None else Path(best_model_save_path)
        # Name of the metric that decides which model is the best
        self.objective = next(iter(self.metrics.values()))
        self.best_objective = np.inf
        # One entry per evaluation, sorted by timesteps
        self.history: list[dict[str, float]] = []

    def _init_callback(self) -> None:
        if self.best_model_save_path is not None:
            self.best_model_save_path.mkdir(parents=True, exist_ok=True)
        if self.log_path is not None:
            self.log_path.parent.mkdir(parents=True, exist_ok=True)
            if self.log_path.exists():
                # Continued training
                records = pd.read_csv(self.log_path).to_dict("records")
                self.history = [{str(name): value for name, value in record.items()} for record in records]
                self.best_objective = min((entry.get(self.objective, np.inf) for entry in self.history), default=np.inf)

        # Init callback called on new best model
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(self.model)

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True

        continue_training = True
        entry = self._summarize(self.evaluate(self.model))
        for name, value in entry.items():
            self.logger.record(f"calibration/{name}", value)
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
                temporary_path = self.best_model_save_path / "best_model.tmp.zip"
                self.model.save(temporary_path)
                os.replace(temporary_path, self.best_model_save_path / "best_model.zip")
            # Trigger callback on new best model, if needed
            if self.callback_on_new_best is not None:
                continue_training = self.callback_on_new_best.on_step()

        # Trigger callback after every evaluation, if needed
        return continue_training and self._on_event()

    def _summarize(self, trajectories: pd.DataFrame) -> dict[str, float]:
        """
        Mean and worst value of each metric. A trajectory without a result (NaN) is not left out:
        it makes both of them NaN, and such a model is never the best.

        :param trajectories: One row per held-out trajectory
        :return: The values under the names to log
        """
        missing = [column for column in self.metrics if column not in trajectories.columns]
        if missing:
            raise ValueError(f"The evaluation has no column {missing}, its columns are {list(trajectories.columns)}.")
        summary = {}
        for column, name in self.metrics.items():
            summary[name] = float(trajectories[column].mean(skipna=False))
            summary[f"{name}_worst"] = float(trajectories[column].max(skipna=False))
        return summary

    def _add_to_history(self, entry: dict[str, float]) -> None:
        """
        Add an evaluation, in place of an older one after as many timesteps (when continuing from a checkpoint).

        :param entry: Timesteps and values of the evaluation
        """
        by_timesteps = {int(old["timesteps"]): old for old in self.history}
        by_timesteps[int(entry["timesteps"])] = entry
        self.history = [by_timesteps[timesteps] for timesteps in sorted(by_timesteps)]
        if self.log_path is not None:
            # Renaming is atomic: an interrupted training never leaves half a file
            temporary_path = self.log_path.with_name(f"{self.log_path.name}.tmp")
            pd.DataFrame(self.history).to_csv(temporary_path, index=False)
            os.replace(temporary_path, self.log_path)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """
        Update the references to the local variables.

        :param locals_: the local variables during rollout collection
        """
        super().update_child_locals(locals_)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.update_locals(locals_)
