"""Is ``L`` a Lyapunov function of the loop that a policy closes? The report of an evaluation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_lac.checks import advice_for_a_time_limit
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.stability.functions import CriticLyapunov, LyapunovFunction
from sb3_lac.stability.loop import closed_loop
from sb3_lac.stability.rollout import summarize_episodes
from sb3_lac.stability.statistics import (
    Bootstrap,
    Interval,
    cost_to_go,
    decrease_by_cost,
    estimate_metrics,
    relative_cost_to_go,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Columns of the transitions of a report
_COLUMNS = ["episode", "step", "reward", "cost", "lyapunov", "next_lyapunov", "difference", "cost_to_go", "terminated"]


@dataclass(frozen=True, eq=False)
class LyapunovReport:
    """
    What ``evaluate_lyapunov()`` returns: the metrics of ``L`` along roll-outs of a policy, and their verdict. Read
    ``summary()`` first, then ``holds``; ``plot()`` shows where the condition fails.

    :param transitions: One row per transition, episodes one after the other: ``episode``, ``step``, ``reward``, ``cost``,
        ``lyapunov`` (``L(s, a)``), ``next_lyapunov`` (``L(s', a')``, NaN if s' is terminal), ``difference``
        (``L(s', a') - L(s, a) + alpha3 * c``), ``cost_to_go`` (NaN if too much of it was not seen), ``terminated``
    :param episodes: One row per episode: ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost`` and
        ``late_cost`` (the largest and the mean one of its last fifth), ``late_rise`` (by how much that mean is larger than
        those of the three fifths before), ``terminated``
    :param observations: The observations of the transitions as the policy saw them, or None if they are no vectors
    :param metrics: Values with their 95 % intervals, by name
    :param by_cost: The decrease condition by level of the cost: ``cost_low``, ``cost_high``, ``cost`` (mean),
        ``n_transitions``, ``drift`` (mean of ``L(s', a') - L(s, a)``), ``decrease``, ``decrease_low``, ``decrease_high``,
        ``share_decreasing``
    :param alpha3: Share of the cost by which ``L`` has to decrease
    :param gamma: The discount factor
    :param seed: Seed of the roll-outs
    """

    transitions: pd.DataFrame
    episodes: pd.DataFrame
    observations: np.ndarray | None
    metrics: dict[str, Interval]
    by_cost: pd.DataFrame
    alpha3: float
    gamma: float
    seed: int

    @property
    def n_calibrated(self) -> int:
        """Number of transitions with a known cost-to-go, those that ``L`` is compared with."""
        return int(self.transitions["cost_to_go"].notna().sum())

    def to_frame(self) -> pd.DataFrame:
        """
        Return the metrics as a table.

        :return: One row per metric, with columns ``value``, ``low`` and ``high``
        """
        import pandas as pd

        return pd.DataFrame.from_dict(self.metrics, orient="index", columns=["value", "low", "high"]).rename_axis("metric")

    def summary(self, full: bool = False) -> str:
        """
        Say in a line whether the loop settles, and on what that rests.

        :param full: Also say the metrics, with their intervals, and what they tell of the decrease condition
        :return: A text of some lines
        """
        episodes, transitions = len(self.episodes), len(self.transitions)
        verdict = (
            f"{'HOLDS' if self.holds else 'NOT SHOWN'}: {self._verdict_with_residual()}\n"
            f"Seen in {episodes} episodes, {transitions} transitions of this policy in this environment: measured, not proved."
        )
        return verdict if not full else f"{verdict}\n\n{self._details()}"

    def _details(self) -> str:
        """The metrics, and what they tell of the decrease condition."""
        lines = [
            f"Lyapunov function along {len(self.episodes)} episodes, {len(self.transitions)} transitions "
            f"(alpha3={self.alpha3:g}, gamma={self.gamma:g})",
            f"  {'metric':<24}{'value':>12}   95 % interval",
        ]
        for name, (value, low, high) in self.metrics.items():
            shown = "not available" if math.isnan(value) else f"{value:>12.4g}   [{low:.4g}, {high:.4g}]"
            if math.isnan(low) and not math.isnan(value):
                shown = f"{value:>12.4g}   not available: too few episodes have data"
            lines.append(f"  {name:<24}{shown}")
        if any(math.isnan(value) for value, _, _ in self.metrics.values()):
            lines.append(
                "What is not available takes what these roll-outs do not have, like a survivor or costs that fade before the "
                "time limit."
            )
        lines.append(f"With alpha3={self.alpha3:g} the decrease condition {self._verdict()}.")
        if self.n_calibrated > 0:
            lines.append(f"L was compared with the cost-to-go of {self.n_calibrated} transitions.")
        return "\n".join(lines)

    def _verdict(self) -> str:
        decrease = self.metrics["decrease"]
        if decrease.high < 0:
            return "holds on average: the interval of decrease lies below 0"
        if decrease.low > 0:
            return "is violated on average: the interval of decrease lies above 0"
        if math.isnan(decrease.low):
            return "is undecided: too few episodes have a decrease for an interval, use more"
        return "is undecided: the interval of decrease contains 0"

    @property
    def holds(self) -> bool:
        """
        Whether these roll-outs show a Lyapunov function with a residual: no episode died, ``L`` falls from the starts on (the
        interval of ``largest_feasible_alpha3`` lies above 0), and it decreases wherever the cost is larger than
        ``cost_bound``, whose interval lies below the mean cost of the first steps. Where the roll-outs end, the cost must not
        rise (the interval of ``late_rise`` lies above 0) so that one more such rise exceeds the bound.
        """
        return self._why_not() is None

    def _why_not(self) -> str | None:
        metrics = self.metrics
        if metrics["death_rate"].value > 0:
            died = f"{self.episodes['terminated'].sum()} of {len(self.episodes)} episodes died"
            return f"{died}. {advice_for_a_time_limit(self.episodes['length'].to_numpy())}".rstrip(". ")
        if not np.isfinite(self.transitions["lyapunov"]).all():
            return "L is not finite everywhere, as with gamma=1 and positive rewards"
        if math.isnan(metrics["largest_feasible_alpha3"].low) and metrics["largest_feasible_alpha3"].value > 0:
            return "too few episodes have a cost for an interval, use more"
        if not metrics["largest_feasible_alpha3"].low > 0:
            return "L does not fall from the starts on (the interval of largest_feasible_alpha3 is not above 0)"
        if math.isnan(metrics["cost_bound_alpha3"].value):
            return "L does not decrease where the cost is largest"
        late_cost, late_rise = metrics["late_cost"].value, metrics["late_rise"].value
        if metrics["late_rise"].low > 0 and late_cost + late_rise > metrics["cost_bound"].value:
            return (
                f"the cost rises where the roll-outs end, in the last fifth by {late_rise:.3g} above the three before, to "
                f"{late_cost:.3g}: it would soon be above cost_bound"
            )
        if not metrics["cost_bound"].high < metrics["start_cost"].value:
            return (
                "the interval of cost_bound is not below the cost of the first steps, and so the loop is not known to settle "
                "there"
            )
        return None

    def _verdict_with_residual(self) -> str:
        reason = self._why_not()
        if reason is not None:
            return f"{reason}."
        bound, start = self.metrics["cost_bound"].high, self.metrics["start_cost"].value
        return f"the mean cost settles below {bound:.3g} (the starts cost {start:.3g}). L decreases wherever it is larger."

    def plot(self) -> Figure:
        """
        Draw four panels: ``L`` along episodes, the decrease condition by level of the cost, ``L`` against the cost-to-go
        and costs over time.

        :return: The figure
        """
        from sb3_lac.stability import plots  # matplotlib is slow to import, and only a figure needs it

        ultimate_bound = self.metrics["ultimate_bound"].value
        return plots.plot_report(self.transitions, self.by_cost, self.alpha3, ultimate_bound)

    def plot_drift(self) -> Figure:
        """
        Draw the decrease condition with a residual: the drift of ``L`` at each level of the cost, and the line
        ``-alpha3 * c + b`` above it whose zero, ``cost_bound``, bounds the mean cost in the long run.

        :return: The figure
        """
        from sb3_lac.stability import plots

        bound, alpha3 = self.metrics["cost_bound"].value, self.metrics["cost_bound_alpha3"].value
        return plots.plot_drift(self.by_cost, bound, alpha3, self.metrics["start_cost"].value)


def evaluate_lyapunov(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = True,
    seed: int | None = None,
    lyapunov: LyapunovFunction | None = None,
) -> LyapunovReport:
    """
    Measure on roll-outs whether ``L`` is a Lyapunov function of the loop that a policy closes: whether it decreases by
    ``alpha3`` times the cost, ``E[L(s', a')] - L(s, a) <= -alpha3 * c``, at least where the cost is above a residual.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import evaluate_lyapunov, fit_lyapunov
      from sb3_lac.envs import reference_controller

      env = gym.make("LinearCost-v0")
      controller = reference_controller(env)  # or a model of any algorithm
      lyapunov = fit_lyapunov(controller, env, n_episodes=20, seed=0)
      report = evaluate_lyapunov(controller, env, n_eval_episodes=20, lyapunov=lyapunov, seed=1000)
      print(report.summary())

    Take the function of ``fit_lyapunov()`` for a verdict on the loop. Without ``lyapunov``, the critic of LAC is judged, which
    tells what was learned. ``docs/stability_metrics.md`` says what each metric means.

    ``a'`` is the action taken next; after a time limit it is an action of the policy. A terminal state has no ``L``:
    transitions into it are counted as deaths, and do not count for the decrease.

    .. note::
        The critic is judged with the costs that it was trained on: wrap ``env`` as the training environment. Any other
        function is judged with the rewards of the environment itself, also under ``VecNormalize``. Unlike in
        ``evaluate_policy()``, a ``Monitor`` makes no difference. With gSDE, the noise matrix of the last roll-out is kept.

    :param policy: The policy: a model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The gym environment or ``VecEnv`` environment, not the one that the policy trains in. Its normalization
        statistics are used as they are: call ``sync_envs_normalization()`` before.
    :param n_eval_episodes: Number of episodes, divided onto the elements of a vector env as in ``evaluate_policy()``
    :param deterministic: Whether to judge the policy's mean action, as it is used after the training, or sampled actions
    :param seed: Seed for ``env`` and for the actions; drawn if it is None, and kept in the report
    :param lyapunov: The function to judge, the critic by default. It cannot be judged on roll-outs that it was fitted on.
    :return: The report
    :raises ValueError: If an argument is invalid, or the policy is not LAC and there is no ``lyapunov``
    """
    if lyapunov is None:
        lyapunov = critic_of(policy)
    with closed_loop(policy, env, lyapunov, n_eval_episodes, deterministic, seed) as loop:
        roll_outs = loop.roll_out(n_eval_episodes)
        transitions = roll_outs.transitions
        loop.check_costs(transitions["reward"])
    transitions["difference"] = transitions["next_lyapunov"] - transitions["lyapunov"] + lyapunov.alpha3 * transitions["cost"]
    if lyapunov.average_cost is None:
        transitions["cost_to_go"] = cost_to_go(transitions, lyapunov.gamma, loop.reward_bound)
    else:
        transitions["cost_to_go"] = relative_cost_to_go(transitions, lyapunov.average_cost)
    transitions = transitions[_COLUMNS]
    episodes = summarize_episodes(transitions)
    bootstrap = Bootstrap(len(episodes))
    return LyapunovReport(
        transitions=transitions,
        episodes=episodes,
        observations=roll_outs.vectors(),
        metrics=estimate_metrics(transitions, episodes, bootstrap),
        by_cost=decrease_by_cost(transitions, bootstrap),
        alpha3=lyapunov.alpha3,
        gamma=lyapunov.gamma,
        seed=loop.seed,
    )


def critic_of(policy: PolicyPredictor) -> CriticLyapunov:
    """Return the Lyapunov function that LAC has learned, and refuse any other policy."""
    if not isinstance(policy, CostAlgorithm):
        raise ValueError(
            "The model must be a LAC or PublishedLAC, which has a Lyapunov function. For any other policy, learn one with "
            f"fit_lyapunov(policy, env), and pass it as lyapunov=... (CertificateCallback does so). This is {policy!r}."
        )
    return CriticLyapunov(policy)
