"""Is ``L`` a Lyapunov function of the loop that a policy closes? The report of an evaluation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_lac.checks import advice_for_a_time_limit
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.stability.functions import CriticLyapunov, LyapunovFunction
from sb3_lac.stability.loop import by_keyword, closed_loop
from sb3_lac.stability.rollout import summarize_episodes, where_it_rests
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
#: What is said where more episodes may turn a verdict round
SHORT = "short of episodes"


class Reason(Enum):
    """Why a loop is not shown to hold, in words that start a row of remedies in ``docs/judge_any_loop.md``."""

    DIED = "episodes died"
    INFINITE = "L is not finite everywhere"
    FREE = "too few episodes have a cost"
    L_RISES = "L does not fall from the starts on"
    RISES_FAR_OUT = "L does not decrease where the cost is largest"
    COST_RISES = "the cost rises where the roll-outs end"
    UNSETTLED = "the loop is not known to settle below the cost of its first steps"


class _Finding(NamedTuple):
    """A reason against a loop, its measurement, and the number of episodes that would tell, None if these do."""

    reason: Reason
    measured: str
    enough: int | None = None


def _with_interval(interval: Interval) -> str:
    return f"{interval.value:.3g} [{interval.low:.3g}, {interval.high:.3g}]"


@dataclass(frozen=True, eq=False)
class LyapunovReport:
    """
    Result of ``evaluate_lyapunov()``: the metrics of ``L`` along roll-outs of a policy, and their verdict. Read ``summary()``
    first, then ``holds``; ``plot()`` shows where the condition fails.

    :param transitions: One row per transition, episodes one after the other: ``episode``, ``step``, ``reward``, ``cost``,
        ``lyapunov`` (``L(s, a)``), ``next_lyapunov`` (``L(s', a')``, NaN if s' is terminal), ``difference``
        (``L(s', a') - L(s, a) + alpha3 * c``), ``cost_to_go`` (NaN if too much of it was not seen), ``terminated``
    :param episodes: One row per episode: ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost`` and
        ``late_cost`` (the largest and the mean one of its last fifth), ``late_rise`` (by how much that mean is larger than
        those of the three fifths before), ``terminated``
    :param observations: The policy's observations of the transitions, or None if they are not vectors
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
        evidence = f"{episodes} episodes, {transitions} transitions of this policy in this environment"
        verdict = f"{self._verdict_with_residual()}\nSeen in {evidence}: measured, not proved."
        return verdict if not full else f"{verdict}\n\n{self._details()}"

    def _details(self) -> str:
        """The metrics, and what they tell of the decrease condition."""
        lines = [
            f"Lyapunov function along {len(self.episodes)} episodes, {len(self.transitions)} transitions "
            f"(alpha3={self.alpha3:g}, gamma={self.gamma:g})",
            f"  {'metric':<24}{'value':>12}   95 % interval",
        ]
        for name, (value, low, high) in self.metrics.items():
            text = "not available" if math.isnan(value) else f"{value:>12.4g}   [{low:.4g}, {high:.4g}]"
            if math.isnan(low) and not math.isnan(value):
                text = f"{value:>12.4g}   not available: too few episodes have data"
            lines.append(f"  {name:<24}{text}")
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
        Whether these roll-outs show a Lyapunov function with a residual: no episode died, ``L`` falls from the starts on, and
        wherever the cost is larger than ``cost_bound``, which lies below the cost of the first steps, and where the roll-outs
        end, the cost does not rise so that one more such rise exceeds that bound.
        """
        return not self._findings()

    def _findings(self) -> list[_Finding]:
        """Return what speaks against the loop, in the order of the verdict."""
        metrics, n_episodes = self.metrics, len(self.episodes)
        if metrics["death_rate"].value > 0:
            advice = advice_for_a_time_limit(self.episodes["length"].to_numpy())
            return [_Finding(Reason.DIED, f"({self.episodes['terminated'].sum()} of {n_episodes}). {advice}".rstrip(". "))]
        if not np.isfinite(self.transitions["lyapunov"]).all():
            return [_Finding(Reason.INFINITE, "(as with gamma=1 and positive rewards)")]
        alpha3, bound, start = metrics["largest_feasible_alpha3"], metrics["cost_bound"], metrics["start_cost"].value
        if math.isnan(alpha3.low):
            n_costly = (self.episodes["total_cost"] > 0).sum()
            return [_Finding(Reason.FREE, f"({n_costly} of {n_episodes})", self._enough(alpha3) if n_costly > 0 else None)]
        findings = []
        if not alpha3.low > 0:
            findings.append(
                _Finding(Reason.L_RISES, f"(largest_feasible_alpha3 is {_with_interval(alpha3)})", self._enough(alpha3))
            )
        if math.isnan(metrics["cost_bound_alpha3"].value):
            costly = self.by_cost.iloc[-1]
            required = self.alpha3 * costly["cost"]
            drift = Interval(costly["drift"], costly["decrease_low"] - required, costly["decrease_high"] - required)
            findings.append(
                _Finding(Reason.RISES_FAR_OUT, f"(its drift there is {_with_interval(drift)})", self._enough(drift))
            )
        if metrics["late_rise"].low > 0 and self._late_rise_matters():
            rise, late_cost = metrics["late_rise"].value, metrics["late_cost"].value
            late = f"(in the last fifth by {rise:.3g} above the three before, to {late_cost:.3g}, and soon above cost_bound)"
            findings.append(_Finding(Reason.COST_RISES, late))
        if not bound.high < start:
            enough = self._enough(Interval(bound.value - start, bound.low - start, bound.high - start))
            findings.append(_Finding(Reason.UNSETTLED, f"({start:.3g}, and cost_bound is {_with_interval(bound)})", enough))
        return findings

    def _late_rise_matters(self) -> bool:
        """Tell whether the cost exceeds the bound once it rises as in the last fifth again."""
        return sum(self.metrics[name].value for name in ("late_cost", "late_rise")) > self.metrics["cost_bound"].value

    def _enough(self, margin: Interval) -> int | None:
        """
        Return how many episodes are likely to tell on which side of 0 a margin is, if it is as large as it seems, give or take
        its standard deviation: widths fall with the root of their number. None if its interval tells already.
        """
        value, low, high = margin
        if math.isnan(low):  # at least one episode has data, and it takes some four
            return 4 * len(self.episodes)
        if not low < 0 < high:
            return None
        # Half of a 95 % interval is two standard deviations; twice as many as just enough do in four of five cases
        width = value - low if value > 0 else high - value
        return math.ceil(2 * width**2 / (value**2 + (width / 2) ** 2)) * len(self.episodes)

    def _verdict_with_residual(self) -> str:
        findings, metrics, n_episodes = self._findings(), self.metrics, len(self.episodes)
        decided = [each for each in findings if each.enough is None]
        if decided:
            return f"NOT SHOWN: {decided[0].reason.value} {decided[0].measured}."
        if findings:
            n_needed = max(each.enough for each in findings if each.enough is not None)
            why = f"{findings[0].reason.value} {findings[0].measured}"
            return f"NOT SHOWN, and {SHORT}: {why}. {n_episodes} do not tell, n_episodes={n_needed} may."
        start, enough = metrics["start_cost"].value, self._enough(metrics["late_rise"]) if self._late_rise_matters() else None
        rises = "" if enough is None else f" But {SHORT}: whether {Reason.COST_RISES.value}, n_episodes={enough} may tell."
        return (
            f"HOLDS, and {where_it_rests(metrics['late_cost'].value, start)} The mean cost settles below "
            f"{metrics['cost_bound'].high:.3g} (the starts cost {start:.3g}). L decreases wherever it is larger.{rises}"
        )

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


@by_keyword
def evaluate_lyapunov(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    *,
    n_episodes: int = 20,
    deterministic: bool = True,
    seed: int | None = None,
    lyapunov: LyapunovFunction | None = None,
) -> LyapunovReport:
    """
    Measure on roll-outs whether ``L`` is a Lyapunov function of a closed loop: whether ``L`` decreases by ``alpha3`` times the
    cost, ``E[L(s', a')] - L(s, a) <= -alpha3 * c``, at least at costs above a residual.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import evaluate_lyapunov, fit_lyapunov
      from sb3_lac.envs import reference_controller

      env = gym.make("LinearCost-v0")
      controller = reference_controller(env)  # or a model of any algorithm
      lyapunov = fit_lyapunov(controller, env, n_episodes=20, seed=0)
      report = evaluate_lyapunov(controller, env, n_episodes=20, lyapunov=lyapunov, seed=1000)
      print(report.summary())

    Use the function of ``fit_lyapunov()`` for a verdict on the loop. Without ``lyapunov``, LAC's own critic is judged.
    ``docs/stability_metrics.md`` defines each metric.

    ``a'`` is the next action; after a time limit it is an action of the policy. A terminal state has no ``L``: transitions
    into a terminal state count as deaths, and not for the decrease.

    .. note::
        The critic is judged with the costs that it was trained on: wrap ``env`` as the training environment. Any other
        function is judged with the rewards of the environment itself, also under ``VecNormalize``. Unlike in
        ``evaluate_policy()``, a ``Monitor`` makes no difference. With gSDE, the noise matrix of the last roll-out is kept.

    :param policy: The policy: a model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The gym environment or ``VecEnv`` environment, not the one that the policy trains in. Its normalization
        statistics are used as they are: call ``sync_envs_normalization()`` before.
    :param n_episodes: Number of episodes, divided onto the elements of a vector env as in ``evaluate_policy()``
    :param deterministic: Whether to judge the policy's mean action, as after the training, or sampled actions
    :param seed: Seed for ``env`` and for the actions; drawn if it is None, and kept in the report
    :param lyapunov: The function to judge, the critic by default. The roll-outs of its own fit are refused.
    :return: The report
    :raises ValueError: If an argument is invalid, or the policy is not LAC and there is no ``lyapunov``
    """
    if lyapunov is None:
        lyapunov = critic_of(policy)
    with closed_loop(policy, env, lyapunov, n_episodes, deterministic, seed) as loop:
        roll_outs = loop.roll_out(n_episodes)
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
