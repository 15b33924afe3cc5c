from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_lac.dashboard import NOT_TENSORBOARD, tensorboard_writer
from sb3_lac.stability import (
    CertificationReport,
    LyapunovFunction,
    LyapunovReport,
    NoCostError,
    certify,
    evaluate_lyapunov,
    fit_lyapunov,
)
from sb3_lac.stability.certification import check_bound
from sb3_lac.stability.loop import by_keyword, closed_loop, vectorized
from sb3_lac.stability.report import critic_of
from sb3_lac.stability.rollout import mean_reward

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure


class LyapunovCallback(EventCallback):
    """
    Callback for evaluating LAC's learned Lyapunov function along roll-outs of the mean action (see ``evaluate_lyapunov()``),
    without an effect on the training. TensorBoard also gets the figure of each report, CSV and JSON the limits of intervals.

    .. warning::

      When using multiple environments, each call to  ``env.step()``
      will effectively correspond to ``n_envs`` steps.
      To account for that, you can use ``eval_freq = max(eval_freq // n_envs, 1)``

    :param eval_env: The environment used for evaluation, wrapped with ``VecNormalize`` if the training environment is:
        its statistics are synchronized before each evaluation. It cannot be the training environment itself.
    :param callback_after_eval: Callback to trigger after every evaluation, which finds the report in
        ``self.parent.last_report``. ``StopTrainingOnRewardThreshold`` and ``StopTrainingOnNoModelImprovement`` ask for
        ``self.parent.best_mean_reward``, the largest mean return of an evaluation (of the rewards in the report).
    :param n_episodes: Number of episodes of an evaluation
    :param eval_freq: Evaluate the agent every ``eval_freq`` call of the callback.
    :param seed: Seed of each evaluation, for the same initial states in all evaluations; if None, each evaluation draws a seed
    :param verbose: Verbosity level: 0 for no output, 1 for the summary of each evaluation
    :ivar history: The logged values of each evaluation of the training, with all intervals
    """

    #: Before the names of what is logged
    FOLDER: ClassVar[str] = "lyapunov"
    #: Metrics that are logged; SB3 cuts names after 36 characters, and so ``largest_feasible_alpha3`` is ``feasible_alpha3``
    METRICS: ClassVar[tuple[str, ...]] = (
        *("decrease", "share_decreasing", "largest_feasible_alpha3", "mean_cost", "calibration_slope", "rank_correlation"),
        *("ultimate_bound", "death_rate"),
    )

    @by_keyword
    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_after_eval: BaseCallback | None = None,
        n_episodes: int = 20,
        eval_freq: int = 10_000,
        seed: int | None = None,
        verbose: int = 1,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        self.eval_env = vectorized(eval_env)
        self.n_episodes = n_episodes
        self.eval_freq = eval_freq
        self.seed = seed
        self.history: list[dict[str, float]] = []
        self.last_report: LyapunovReport | None = None
        # What the callbacks of Stable-Baselines3 that stop a training ask for
        self.best_mean_reward = -np.inf

    def _init_callback(self) -> None:
        # A mistake is seen before the training, and not at its first evaluation
        with closed_loop(self.model, self.eval_env, self._judged(), self.n_episodes, seed=self.seed) as loop:
            self.eval_env = loop.env
        # Not of another training, nor of steps that are taken again from a checkpoint on
        self.history = [entry for entry in self.history if entry["timesteps"] <= self.model.num_timesteps]

    def _judged(self) -> LyapunovFunction | None:
        """Return the function that is judged, if it is known before the evaluation."""
        return critic_of(self.model)

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True

        # As sync_envs_normalization(), for environments that are not wrapped alike otherwise
        training, evaluation = self.model.get_vec_normalize_env(), unwrap_vec_normalize(self.eval_env)
        if training is not None and evaluation is not None:
            evaluation.ret_rms = deepcopy(training.ret_rms)
            if training.norm_obs:
                evaluation.obs_rms = deepcopy(training.obs_rms)

        self.best_mean_reward = max(self.best_mean_reward, self._evaluate())
        values = self._values()
        self._log(values)
        self.history.append({"timesteps": self.num_timesteps, **values})
        if self.verbose >= 1:
            print(f"Eval num_timesteps={self.num_timesteps}, {self._summary()}")

        # Trigger callback after every evaluation, if needed
        return self._on_event()

    def _log(self, values: dict[str, float]) -> None:
        """Log values; the limits of their intervals in CSV and JSON files alone, and figures in TensorBoard."""
        for name, value in values.items():
            is_limit = name.endswith(("_low", "_high"))
            self.logger.record(f"{self.FOLDER}/{name}", value, exclude=("stdout", "log", "tensorboard") if is_limit else None)
        if tensorboard_writer(self.logger) is not None:
            for name, figure in self._figures().items():
                self.logger.record(f"{self.FOLDER}/{name}", Figure(figure, close=False), exclude=NOT_TENSORBOARD)
        # Dump log so the evaluation results are printed with the correct timestep
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _evaluate(self) -> float:
        """Make the reports of an evaluation, and return the mean reward of an episode."""
        self.last_report = evaluate_lyapunov(self.model, self.eval_env, n_episodes=self.n_episodes, seed=self.seed)
        return mean_reward(self.last_report.transitions)

    def _values(self) -> dict[str, float]:
        """Return what is logged of the last evaluation, NaN if it has no report."""
        values: dict[str, float] = {}
        for metric in self.METRICS:
            name = metric.removeprefix("largest_")
            interval = (np.nan,) * 3 if self.last_report is None else self.last_report.metrics[metric]
            values.update(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))
        return values

    def _figures(self) -> dict[str, MatplotlibFigure]:
        return {} if self.last_report is None else {"report": self.last_report.plot()}

    def _summary(self) -> str:
        return "" if self.last_report is None else self.last_report.summary()


class CertificateCallback(LyapunovCallback):
    """
    Callback for certifying the policy of any algorithm during the training, without an effect on the training. Each evaluation
    fits a Lyapunov function to roll-outs of the mean action (``fit_lyapunov()``), and judges it on new roll-outs
    (``certify()``, ``evaluate_lyapunov()``). Each of the three functions has its own seed, so that all evaluations have the
    same initial states, and no function is judged on its own fit. Without any cost all values are NaN. TensorBoard also gets
    two figures, ``certificate/drift`` and ``certificate/statements``.

    ``LyapunovCallback`` describes the arguments that are not listed here.

    :param callback_after_eval: Callback to trigger after every evaluation, which finds the reports in
        ``self.parent.last_report`` and ``self.parent.last_certification``
    :param n_episodes: Number of episodes for each of the three
    :param ultimate_bound: The cost to stay within, the largest late cost of the roll-outs of the fit by default
    :param seed: Seed of each evaluation, far from those of the training; if None, each evaluation draws a seed
    """

    FOLDER = "certificate"
    METRICS = ("largest_feasible_alpha3", "mean_cost", "start_cost", "cost_bound", "ultimate_bound", "death_rate")
    #: Statements whose bounds are logged
    STATEMENTS: ClassVar[tuple[str, ...]] = ("survives", "stays_within", "decreases")

    @by_keyword
    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_after_eval: BaseCallback | None = None,
        n_episodes: int = 100,
        eval_freq: int = 10_000,
        ultimate_bound: float | None = None,
        seed: int | None = 10_000,
        verbose: int = 1,
    ):
        super().__init__(eval_env, callback_after_eval, n_episodes, eval_freq, seed, verbose)
        check_bound(ultimate_bound)
        self.ultimate_bound = ultimate_bound
        self.last_certification: CertificationReport | None = None

    def _judged(self) -> None:
        return None

    def _evaluate(self) -> float:
        self.last_report = self.last_certification = None
        model, env, n_episodes, bound = self.model, self.eval_env, self.n_episodes, self.ultimate_bound
        try:
            lyapunov = fit_lyapunov(model, env, n_episodes=n_episodes, seed=self.seed, progress_bar=False)
        except NoCostError as nothing:
            return nothing.mean_reward
        seed = lyapunov.seeds.stop
        self.last_report = evaluate_lyapunov(model, env, n_episodes=n_episodes, seed=seed, lyapunov=lyapunov)
        seed += env.num_envs
        self.last_certification = certify(
            model, env, lyapunov=lyapunov, n_episodes=n_episodes, ultimate_bound=bound, seed=seed
        )
        return mean_reward(self.last_report.transitions)

    def _values(self) -> dict[str, float]:
        # NaN for a statement that no episode could make
        holds, at_least = np.nan, dict.fromkeys(self.STATEMENTS, np.nan)
        if self.last_report is not None and self.last_certification is not None:
            holds = float(self.last_report.holds)
            at_least.update(self.last_certification.statements["at_least"])
        statements = {f"{statement}_at_least": float(at_least[statement]) for statement in self.STATEMENTS}
        return {"holds": holds, **statements, **super()._values()}

    def _figures(self) -> dict[str, MatplotlibFigure]:
        if self.last_report is None or self.last_certification is None:
            return {}
        return {"drift": self.last_report.plot_drift(), "statements": self.last_certification.plot()}

    def _summary(self) -> str:
        if self.last_certification is None:
            return "nothing had a cost, and so there is nothing to certify"
        return f"{self.last_certification.summary()}\n{super()._summary()}"
