from __future__ import annotations

import os
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_lac.dashboard import NOT_TENSORBOARD, tensorboard_writer
from sb3_lac.files import replacing
from sb3_lac.lac import LAC
from sb3_lac.stability import (
    CertificationReport,
    Interval,
    LyapunovReport,
    NoCostError,
    certify,
    evaluate_lyapunov,
    fit_lyapunov,
)
from sb3_lac.stability.certification import check_questions
from sb3_lac.stability.rollout import (
    check_environment,
    check_number,
    check_training_seeds,
    known_seed,
    prepare_evaluation,
    trains_on,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure


class LyapunovCallback(EventCallback):
    """
    Callback for evaluating the learned Lyapunov function along roll-outs of the policy (see ``evaluate_lyapunov()``).
    The training is not changed by it. TensorBoard also gets the limits of the confidence intervals (``lyapunov/<name>_low``,
    ``lyapunov/<name>_high``) and the figure of each report (``lyapunov/report``).

    .. warning::

      When using multiple environments, each call to  ``env.step()``
      will effectively correspond to ``n_envs`` steps.
      To account for that, you can use ``eval_freq = max(eval_freq // n_envs, 1)``

    :param eval_env: The environment used for evaluation, wrapped with ``VecNormalize`` if the training environment is:
        its statistics are synchronized before each evaluation. It cannot be the training environment itself, whose episodes
        the evaluation would end.
    :param callback_after_eval: Callback to trigger after every evaluation, which finds the report in
        ``self.parent.last_report``
    :param n_eval_episodes: The number of episodes to test the agent
    :param eval_freq: Evaluate the agent every ``eval_freq`` call of the callback.
    :param deterministic: Whether the evaluation should use stochastic or deterministic actions
    :param seed: Seed of each evaluation, so that all of them have the same start states; if it is None, each draws its own
    :param log_path: Path of a CSV file with the metrics and their confidence intervals, updated at each evaluation.
        If it exists already, its evaluations are kept, so that the history of a continued training is complete
        (``learn(..., reset_num_timesteps=False)``). A training that starts anew is refused, whose evaluations it would mix in.
    :param verbose: Verbosity level: 0 for no output, 1 for the summary of each evaluation
    """

    #: Metrics that are logged, with their names in the log
    METRICS: ClassVar[dict[str, str]] = {
        "decrease": "decrease",
        "share_decreasing": "share_decreasing",
        "largest_feasible_alpha3": "feasible_alpha3",
        "mean_cost": "mean_cost",
        "calibration_slope": "calibration_slope",
        "rank_correlation": "rank_correlation",
        "ultimate_bound": "ultimate_bound",
        "death_rate": "death_rate",
    }
    #: Whether values of the critic are judged
    OF_THE_CRITIC: ClassVar[bool] = True

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 20,
        eval_freq: int = 10_000,
        deterministic: bool = True,
        seed: int | None = None,
        log_path: str | os.PathLike[str] | None = None,
        verbose: int = 1,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        check_environment(eval_env)
        # Convert to VecEnv for consistency
        if not isinstance(eval_env, VecEnv):
            eval_env = DummyVecEnv([lambda: eval_env])  # type: ignore[list-item, return-value]
        self.eval_env = eval_env
        self.n_eval_episodes = n_eval_episodes
        self.eval_freq = eval_freq
        self.deterministic = deterministic
        self.seed = seed
        self.log_path = None if log_path is None else Path(log_path)
        # One entry per evaluation, sorted by timesteps
        self.history: list[dict[str, float]] = []
        self.last_report: LyapunovReport | None = None

    def _init_callback(self) -> None:
        # A mistake is seen before the training, and not at its first evaluation
        if self.OF_THE_CRITIC and not isinstance(self.model, LAC):
            raise ValueError(
                f"The model must be a LAC model, which has a Lyapunov function, and not {self.model!r}. CertificateCallback "
                "learns one for any other model."
            )
        known_seed(self.seed)
        check_number("n_eval_episodes", self.n_eval_episodes)
        self.eval_env = prepare_evaluation(self.model, self.eval_env, self.OF_THE_CRITIC)
        if trains_on(self.model, self.eval_env):
            raise ValueError(
                "The evaluation environment is the training environment: an evaluation would end its episodes, and the "
                "replay buffer would join them with others. Make a second environment for the evaluation."
            )
        if self.model.num_timesteps == 0:
            # Of another training
            self.history = []
        if self.log_path is not None:
            import pandas as pd  # slow to import, and only an evaluation needs it

            if self.log_path.is_dir():
                raise ValueError(f"log_path={self.log_path} is a folder: give the path of a CSV file.")
            self.log_path.parent.mkdir(parents=True, exist_ok=True)
            if self.log_path.exists() and self.log_path.stat().st_size > 0:
                if self.model.num_timesteps == 0:
                    raise ValueError(
                        f"log_path={self.log_path} holds the evaluations of another training, and this one starts anew: move "
                        "the file away, give another path, or continue with learn(..., reset_num_timesteps=False)."
                    )
                records = pd.read_csv(self.log_path).to_dict("records")
                self.history = [{str(name): value for name, value in record.items()} for record in records]

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True

        # As sync_envs_normalization(), for environments that are not wrapped alike otherwise
        training, evaluation = self.model.get_vec_normalize_env(), unwrap_vec_normalize(self.eval_env)
        if training is not None and evaluation is not None:
            evaluation.ret_rms = deepcopy(training.ret_rms)
            if training.norm_obs:
                evaluation.obs_rms = deepcopy(training.obs_rms)

        entry = {"timesteps": self.num_timesteps, **self._evaluate()}
        # Dump log so the evaluation results are printed with the correct timestep
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

        self._add_to_history(entry)
        if self.verbose >= 1:
            print(f"Eval num_timesteps={self.num_timesteps}, {self._summary()}")

        # Trigger callback after every evaluation, if needed
        return self._on_event()

    def _evaluate(self) -> dict[str, float]:
        """Evaluate, and log what was found."""
        assert isinstance(self.model, LAC)
        self.last_report = evaluate_lyapunov(
            self.model, self.eval_env, self.n_eval_episodes, deterministic=self.deterministic, seed=self.seed
        )
        return self._log("lyapunov", self._metrics(self.last_report), {"report": self.last_report.plot})

    def _metrics(self, report: LyapunovReport | None) -> dict[str, float]:
        """The metrics that are logged."""
        values: dict[str, float] = {}
        for metric, name in self.METRICS.items():
            found = Interval(np.nan, np.nan, np.nan) if report is None else report.metrics[metric]
            values.update({name: found.value, f"{name}_low": found.low, f"{name}_high": found.high})
        return values

    def _log(
        self, folder: str, values: dict[str, float], figures: dict[str, Callable[[], MatplotlibFigure]]
    ) -> dict[str, float]:
        """Log values everywhere; the limits of their intervals, and figures, in TensorBoard only."""
        in_tensorboard = tensorboard_writer(self.logger) is not None
        for name, value in values.items():
            if not name.endswith(("_low", "_high")):
                self.logger.record(f"{folder}/{name}", value)
            elif in_tensorboard:
                self.logger.record(f"{folder}/{name}", value, exclude=NOT_TENSORBOARD)
        if in_tensorboard:
            for name, draw in figures.items():
                self.logger.record(f"{folder}/{name}", Figure(draw(), close=False), exclude=NOT_TENSORBOARD)
        return values

    def _summary(self) -> str:
        assert self.last_report is not None
        return self.last_report.summary()

    def _add_to_history(self, entry: dict[str, float]) -> None:
        """Keep an evaluation, in place of an older one after as many timesteps (when continuing from a checkpoint)."""
        others = [old for old in self.history if old["timesteps"] != entry["timesteps"]]
        self.history = sorted([*others, entry], key=lambda evaluation: evaluation["timesteps"])
        if self.log_path is not None:
            import pandas as pd

            with replacing(self.log_path) as part:
                pd.DataFrame(self.history).to_csv(part, index=False)


class CertificateCallback(LyapunovCallback):
    """
    Callback for certifying the policy of any algorithm while it trains: a Lyapunov function is fitted to roll-outs of the mean
    action (see ``fit_lyapunov()``) and judged on others (see ``evaluate_lyapunov()``), about which exact statements are made
    (see ``certify()``). The training is not changed by it. Each of the three takes its own seed, so that all evaluations have
    the same start states and none is judged on what it was fitted on. Where nothing has a cost there is nothing to certify:
    all values are then NaN. TensorBoard also gets the limits of the confidence intervals (``certificate/<name>_low``,
    ``certificate/<name>_high``) and two figures, ``certificate/drift`` and ``certificate/statements``.

    :param eval_env: The environment used for evaluation, as for ``LyapunovCallback``
    :param callback_after_eval: Callback to trigger after every evaluation, which finds the reports in
        ``self.parent.last_report`` and ``self.parent.last_certification``
    :param n_eval_episodes: Number of episodes for each of the three
    :param eval_freq: Evaluate the agent every ``eval_freq`` call of the callback.
    :param confidence: Of all statements of one evaluation together; it is not corrected for the number of evaluations
    :param cost_bound: The cost to stay within, the largest late cost of the roll-outs of the fit by default
    :param seed: Seed of each evaluation, far from those of the training; if it is None, each draws its own
    :param log_path: Path of a CSV file, as for ``LyapunovCallback``
    :param verbose: Verbosity level: 0 for no output, 1 for the summary of each evaluation
    """

    #: Metrics that are logged beside the statements, with their names in the log
    METRICS: ClassVar[dict[str, str]] = {
        "largest_feasible_alpha3": "feasible_alpha3",
        "mean_cost": "mean_cost",
        "start_cost": "start_cost",
        "cost_bound": "cost_bound",
        "ultimate_bound": "ultimate_bound",
        "death_rate": "death_rate",
    }
    #: Bounds of the statements that are logged, with their names in the log
    BOUNDS: ClassVar[dict[str, str]] = {
        "survives": "survives_at_least",
        "stays_within": "stays_within_at_least",
        "decreases": "decreases_at_least",
    }
    OF_THE_CRITIC: ClassVar[bool] = False

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 100,
        eval_freq: int = 10_000,
        confidence: float = 0.95,
        cost_bound: float | None = None,
        seed: int | None = 10_000,
        log_path: str | os.PathLike[str] | None = None,
        verbose: int = 1,
    ):
        super().__init__(eval_env, callback_after_eval, n_eval_episodes, eval_freq, True, seed, log_path, verbose)
        self.confidence = confidence
        self.cost_bound = cost_bound
        self.last_certification: CertificationReport | None = None

    def _init_callback(self) -> None:
        check_questions(None, self.confidence, self.cost_bound, None, None)
        super()._init_callback()
        if self.seed is not None:
            check_training_seeds(self.model, self.seed, 3 * self.eval_env.num_envs)

    def _evaluate(self) -> dict[str, float]:
        first, n_envs, n_episodes = known_seed(self.seed), self.eval_env.num_envs, self.n_eval_episodes
        self.last_report = self.last_certification = None
        try:
            lyapunov = fit_lyapunov(self.model, self.eval_env, n_episodes, seed=first, progress_bar=False)
        except NoCostError:
            nothing = dict.fromkeys(("holds", *self.BOUNDS.values()), np.nan)
            return self._log("certificate", {**nothing, **self._metrics(None)}, {})
        self.last_report = evaluate_lyapunov(self.model, self.eval_env, n_episodes, seed=first + n_envs, lyapunov=lyapunov)
        self.last_certification = certify(
            self.model, self.eval_env, lyapunov, n_episodes, self.confidence, self.cost_bound, seed=first + 2 * n_envs
        )
        values = {"holds": float(self.last_report.holds)}
        for statement, name in self.BOUNDS.items():
            # A statement that no episode could make
            values[name] = float(self.last_certification.statements["at_least"].get(statement, np.nan))
        figures = {"drift": self.last_report.plot_drift, "statements": self.last_certification.plot}
        return self._log("certificate", {**values, **self._metrics(self.last_report)}, figures)

    def _summary(self) -> str:
        if self.last_certification is None:
            return "nothing had a cost, and so there is nothing to certify"
        return "\n".join([super()._summary(), self.last_certification.summary()])
