"""Is ``L`` a Lyapunov function of the loop that a policy closes? The report of an evaluation."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_lac.lac import LAC
from sb3_lac.stability.functions import CriticLyapunov, LyapunovFunction, check_function, check_rewards
from sb3_lac.stability.rollout import (
    check_number,
    check_seeds,
    cost_to_go,
    known_seed,
    prepare_evaluation,
    relative_cost_to_go,
    roll_out,
    stay_within,
    summarize_episodes,
    undisturbed,
)
from sb3_lac.stability.statistics import Bootstrap, Interval, decrease_by_cost, estimate_metrics
from sb3_lac.vec_env import env_specs

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class LyapunovReport:
    """
    How ``L`` behaves along roll-outs of a policy, see ``evaluate_lyapunov()``.

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
    :param horizon: Number of steps whose costs ``L`` estimates, None for all to come
    :param max_tail_weight: Largest weight of the costs to come after the end of an episode, in ``cost_to_go``
    :param max_episode_steps: Gymnasium's time limit of the environment, None if it ends its episodes itself
    :param seed: Seed of the roll-outs
    :param settled_share: Share of the cost of the first steps that ``cost_bound`` has to lie below
    """

    transitions: pd.DataFrame
    episodes: pd.DataFrame
    observations: np.ndarray | None
    metrics: dict[str, Interval]
    by_cost: pd.DataFrame
    alpha3: float
    gamma: float
    horizon: int | None
    max_tail_weight: float
    max_episode_steps: int | None
    seed: int
    settled_share: float = 1.0

    @property
    def n_calibrated(self) -> int:
        """Number of transitions with a known cost-to-go, those that ``L`` is compared with."""
        return int(self.transitions["cost_to_go"].notna().sum())

    def to_frame(self) -> pd.DataFrame:
        """
        The metrics as a table.

        :return: One row per metric, with columns ``value``, ``low`` and ``high``
        """
        import pandas as pd

        return pd.DataFrame.from_dict(self.metrics, orient="index", columns=list(Interval._fields)).rename_axis("metric")

    def summary(self) -> str:
        """
        The metrics in a readable form, and what they say about the decrease condition.

        :return: A text of several lines
        """
        horizon = "infinite horizon" if self.horizon is None else f"horizon of {self.horizon} steps"
        lines = [
            f"Lyapunov function along {len(self.episodes)} episodes, {len(self.transitions)} transitions "
            f"(alpha3={self.alpha3:g}, gamma={self.gamma:g}, {horizon})",
            f"  {'metric':<24}{'value':>12}   95 % interval",
        ]
        missing: dict[str, list[str]] = {}
        for name, (value, low, high) in self.metrics.items():
            if math.isnan(value):
                missing.setdefault(self._why_not_available(name), []).append(name)
                lines.append(f"  {name:<24}not available")
            elif math.isnan(low):
                lines.append(f"  {name:<24}{value:>12.4g}   not available: too few episodes have data")
            else:
                lines.append(f"  {name:<24}{value:>12.4g}   [{low:.4g}, {high:.4g}]")
        lines += [f"Not available: {', '.join(names)}. {reason}" for reason, names in missing.items()]
        lines.append(f"With alpha3={self.alpha3:g} the decrease condition {self._verdict()}.")
        lines.append(self._verdict_with_residual())
        if not self.lyapunov_over_cost.empty:
            quantiles = ", ".join(f"{value:.3g}" for value in self.lyapunov_over_cost)
            lines.append(f"L is {quantiles} times the cost (5th, 50th and 95th percentile of the transitions).")
        if not math.isnan(self.alpha3_by_discount):
            share = "no share" if self.alpha3_by_discount <= 0 else f"at most {self.alpha3_by_discount:.3g}"
            lines.append(f"If L is exact, gamma={self.gamma:g} lets it decrease by {share} of the cost in 95 % of them.")
        if self.n_calibrated > 0:
            lines.append(f"L was compared with the cost-to-go of {self.n_calibrated} transitions.")
        lines.append(
            "This is an empirical statement about these roll-outs of this policy in this environment, "
            "and no proof of stability."
        )
        return "\n".join(lines)

    def _verdict(self) -> str:
        decrease = self.metrics["decrease"]
        if decrease.high < 0:
            return "holds on average: the interval of decrease lies below 0"
        if decrease.low > 0:
            return "is violated on average: the interval of decrease lies above 0"
        if math.isnan(decrease.value):
            return "is undecided: no transition ends in a state that has an L"
        if math.isnan(decrease.low):
            return "is undecided: too few episodes have a decrease for an interval, use more"
        return "is undecided: the interval of decrease contains 0"

    @property
    def lyapunov_over_cost(self) -> pd.Series:
        """``L / c`` of the transitions with a cost, at its 5th, 50th and 95th percentile: how far ``L`` lies above it."""
        with_cost = self.transitions[self.transitions["cost"] > 0]
        ratios = with_cost["lyapunov"] / with_cost["cost"]
        return ratios.quantile([0.05, 0.5, 0.95]) if len(ratios) > 0 else ratios

    @property
    def alpha3_by_discount(self) -> float:
        """
        The largest ``alpha3`` for which an exact ``L`` decreases in 95 % of the transitions with a cost: what follows from the
        discount and from how slowly costs fade, ``(1 - (1 - gamma) * kappa) / gamma`` with ``kappa`` the 95th percentile of
        ``L / c``. Not positive where no ``alpha3`` is feasible; NaN where ``L`` is no discounted sum of all costs to come.
        """
        if self.horizon is not None or not 0 < self.gamma < 1 or self.lyapunov_over_cost.empty:
            return math.nan
        return float((1 - (1 - self.gamma) * self.lyapunov_over_cost.iloc[-1]) / self.gamma)

    @property
    def holds(self) -> bool:
        """
        Whether these roll-outs show a Lyapunov function with a residual: no episode died, ``L`` falls from the starts on (the
        interval of ``largest_feasible_alpha3`` lies above 0), and it decreases wherever the cost is larger than
        ``cost_bound``, whose interval lies below ``settled_share`` of the mean cost of the first steps. Where the roll-outs
        end, the cost must not rise (the interval of ``late_rise`` lies above 0) so that one more such rise exceeds the bound.
        """
        return self._why_not() is None

    def _why_not(self) -> str | None:
        metrics = self.metrics
        if metrics["death_rate"].value > 0:
            return f"{self.episodes['terminated'].sum()} of {len(self.episodes)} episodes died"
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
        if not metrics["cost_bound"].high < self.settled_share * metrics["start_cost"].value:
            share = "" if self.settled_share == 1 else f"{self.settled_share:g} of "
            below = f"below {share}the cost of the first steps"
            return f"the interval of cost_bound is not {below}, and so the loop is not known to settle there"
        return None

    def _verdict_with_residual(self) -> str:
        reason = self._why_not()
        if reason is not None:
            return f"With a residual it does not hold: {reason}."
        _, low, high = self.metrics["cost_bound"]
        return (
            f"With a residual it holds: L decreases where the cost is larger than cost_bound [{low:.3g}, {high:.3g}], "
            f"which bounds the mean cost in the long run; the starts cost {self.metrics['start_cost'].value:.3g}."
        )

    def _why_not_available(self, name: str) -> str:
        if name == "cost_bound_alpha3" and not self.by_cost.empty:
            return "L does not decrease where the cost is largest: cost_bound is no more than the mean cost there."
        if name == "ultimate_bound":
            return "Every episode terminated: train longer, or start closer to the goal."
        if name == "decrease_rate" and not self.by_cost.empty:
            return "L is 0 everywhere."
        if name in ("decrease", "share_decreasing", "decrease_rate", "residual", "cost_bound", "cost_bound_alpha3") or (
            name == "largest_feasible_alpha3" and self.metrics["mean_cost"].value > 0
        ):
            return "Every episode terminated in its first step, or without a cost before its last one: train longer."
        if name == "largest_feasible_alpha3":
            return "Nothing had a cost, so that L has nothing to decrease by: start further away from the goal."
        if self.n_calibrated > 0:
            return (
                f"L or the cost-to-go is the same in all {self.n_calibrated} transitions that can be compared: "
                "use more episodes, with other start states."
            )
        return f"L could not be compared with the cost-to-go: {self._why_not_calibrated()}"

    def _why_not_calibrated(self) -> str:
        length = int(self.episodes["length"].max())
        longest = f"the longest episode has {length} steps"
        if self.episodes["terminated"].all():
            return "every episode terminated, and without a discount it is not known what follows."
        if self.horizon is None and self.gamma >= 1:
            return (
                "with gamma=1 the costs after a time limit weigh as much as those before it (max_tail_weight=1 leaves them "
                "out), and those after a termination have no sum."
            )
        n_steps = self.horizon or math.ceil(math.log(self.max_tail_weight) / math.log(self.gamma))
        # As many transitions that can be compared as cannot
        if self.max_episode_steps is not None and length >= self.max_episode_steps:
            longer = f"evaluate with longer episodes, gym.make(id, max_episode_steps={2 * n_steps})"
        else:
            longer = (
                f"evaluate with episodes of {2 * n_steps} steps. The environment ends them itself, where max_episode_steps "
                "changes nothing: use its own argument for their length, like episode_steps"
            )
        if self.horizon is not None:
            return f"no episode terminated or has the {self.horizon} steps of the horizon ({longest}); {longer}."
        return (
            f"the costs to come after the time limit weigh more than max_tail_weight={self.max_tail_weight:g} everywhere. "
            f"It takes {n_steps} steps to forget them, {longest}; {longer}, or set a larger max_tail_weight."
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

    def plot_phase(self, x: int = 0, y: int = 1, names: Sequence[str] | None = None) -> Figure:
        """
        Draw the trajectories in two dimensions of the observation, coloured by ``L``.

        :param x: Dimension of the observation on the horizontal axis
        :param y: Dimension of the observation on the vertical axis
        :param names: Names of all dimensions
        :return: The figure
        """
        from sb3_lac.stability import plots

        return plots.plot_phase(self.transitions, self.episodes, self.observations, x, y, names)

    def plot_region_of_attraction(
        self, x: int = 0, y: int = 1, names: Sequence[str] | None = None, threshold: float | None = None
    ) -> Figure:
        """
        Draw the start states of all episodes in two dimensions of the observation, marked by what became of them, over the
        level sets of ``L`` interpolated between them (with more than two dimensions these are a projection).

        :param x: Dimension of the observation on the horizontal axis
        :param y: Dimension of the observation on the vertical axis
        :param names: Names of all dimensions
        :param threshold: An episode has settled if no cost in its last fifth is larger, ``ultimate_bound`` by default
        :return: The figure
        """
        from sb3_lac.stability import plots

        if threshold is None:
            threshold = self.metrics["ultimate_bound"].value
        settled = stay_within(self.episodes, threshold).to_numpy()
        return plots.plot_region_of_attraction(self.transitions, self.episodes, self.observations, settled, x, y, names)


def evaluate_lyapunov(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = True,
    alpha3: float | None = None,
    max_tail_weight: float = 0.05,
    n_cost_levels: int = 5,
    n_bootstrap: int = 1000,
    seed: int | None = None,
    lyapunov: LyapunovFunction | None = None,
    settled_share: float = 1.0,
) -> LyapunovReport:
    """
    Run the policy for ``n_eval_episodes`` episodes and check whether ``L`` is a Lyapunov function along them: whether it
    decreases by ``alpha3`` times the cost, ``E[L(s', a')] - L(s, a) <= -alpha3 * c``, where it does so up to a residual, and
    whether it is what it should have learned, the sum of costs to come. ``L`` is the critic of LAC, or for any policy the
    function ``lyapunov``, like that of ``fit_lyapunov()``.

    The metrics of the report are

    - ``decrease``: mean of ``L(s', a') - L(s, a) + alpha3 * c``, negative when the decrease condition holds on average
    - ``share_decreasing``: share of the transitions in which that is not positive
    - ``largest_feasible_alpha3``: mean of ``L(s, a) - L(s', a')`` divided by the mean of ``c``, the largest ``alpha3`` for
      which the condition holds on average. A negative value means that there is none.
    - ``mean_cost``
    - ``calibration_slope`` and ``calibration_intercept``: line fitted to the cost-to-go as a function of ``L`` (1 and 0 when
      ``L`` is exact), and ``rank_correlation``, Spearman's
    - ``ultimate_bound``: 95th percentile, over the episodes that did not terminate, of the largest cost in their last fifth
    - ``death_rate``: share of the episodes that terminated
    - ``decrease_rate``: ``1 - E[L(s', a')] / E[L(s, a)]``, per step
    - ``start_cost``: mean cost of the first steps
    - ``residual``: the least b with which ``E[L(s', a')] - L(s, a) <= -alpha3 * c + b`` holds at each level of the cost, on
      average over the transitions of the level. It bounds the mean cost in the long run by ``b / alpha3`` (Foster-Lyapunov).
    - ``cost_bound``: the least ``b / alpha3`` of all alpha3, and ``cost_bound_alpha3``, where that is. ``L`` decreases at the
      levels whose cost is larger. It is never less than ``late_cost``: roll-outs that have not settled do not say where they
      will.
    - ``late_cost``: mean cost in the last fifth of the episodes that did not terminate, and ``late_rise``, by how much it is
      larger than those of the three fifths before

    Their intervals are percentiles of a bootstrap that resamples episodes (the transitions of an episode depend on each
    other). With few episodes such intervals are too narrow: those of a mean of normal numbers contain the true one in 85 % of
    all cases with five, in 90 % with ten, and in 93 % with twenty. The interval of ``death_rate`` is Wilson's, and that of
    ``ultimate_bound`` lies between order statistics, with no upper end if there are less than 72 episodes. ``a'`` is the
    action taken next; after a time limit it is an action of the policy.
    A terminal state has no ``L``: transitions into it do not count for the decrease condition, but as deaths.

    .. note::
        The critic is judged with the costs that it was trained on, of rewards and ends of episodes as they appear with
        ``env.step`` calls: wrap ``env`` as the training environment. Any other function is judged with the rewards of the
        environment itself, whether ``VecNormalize`` normalizes them or not. Unlike in ``evaluate_policy()``, a ``Monitor``
        makes no difference. With gSDE, the noise matrix of the last roll-out is kept.
        The training environment (``model.get_env()``) of LAC may be used between two calls of ``learn()``: the next one then
        starts with a reset, and the unfinished episodes in the replay buffer end as by a time limit. Its random numbers go on
        from the seed of the evaluation.

    :param policy: The policy: a model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The gym environment or ``VecEnv`` environment. Its normalization statistics are used as they are:
        call ``sync_envs_normalization()`` before, if it is not the training environment.
    :param n_eval_episodes: Number of episodes, divided onto the elements of a vector env as in ``evaluate_policy()``
    :param deterministic: Whether to judge the policy's mean action, as it is used after the training, or sampled actions
    :param alpha3: Share of the cost by which ``L`` has to decrease, that of the model or of ``lyapunov`` by default
    :param max_tail_weight: The costs after a time limit are not seen. A transition is used for the comparison of ``L`` with
        the cost-to-go if they weigh at most that much in it, ``gamma ** remaining_steps <= max_tail_weight``.
        With a finite horizon, all of its costs must have been seen instead. A function of the average cost is compared in the
        first half of each episode, with ``L`` at the end of the episode in place of the costs that follow it.
    :param n_cost_levels: Number of levels of the cost, at its quantiles, for which the decrease is reported separately
    :param n_bootstrap: Number of bootstrap samples
    :param seed: Seed for ``env`` and for the actions; drawn if it is None, and kept in the report
    :param lyapunov: The function to judge, the critic by default. It cannot be judged on roll-outs that it was fitted on.
    :param settled_share: What the report calls settled: the mean cost in the long run is known to lie below this share of the
        mean cost of the first steps. 1 only asks that costs fall, 0.01 that they nearly vanish
    :return: The report
    :raises ValueError: If the arguments cannot be meant, or the policy is not LAC and there is no ``lyapunov``
    """
    if lyapunov is None:
        if not isinstance(policy, LAC):
            raise ValueError(
                f"The model must be a LAC model, which has a Lyapunov function, and not {policy!r}. For any other policy, "
                "learn one with fit_lyapunov(policy, env), and pass it as lyapunov=..."
            )
        lyapunov = CriticLyapunov(policy)
    check_function(lyapunov)
    check_number("n_eval_episodes", n_eval_episodes)
    env = prepare_evaluation(policy, env, lyapunov.normalized_rewards)
    seed = known_seed(seed)
    check_seeds(lyapunov, seed, env.num_envs)
    alpha3 = lyapunov.alpha3 if alpha3 is None else alpha3
    if not alpha3 > 0:
        raise ValueError(f"alpha3={alpha3} must be greater than 0.")
    if not 0 < max_tail_weight <= 1:
        raise ValueError(f"max_tail_weight={max_tail_weight} must be greater than 0, and at most 1.")
    check_number("n_cost_levels", n_cost_levels)
    check_number("n_bootstrap", n_bootstrap)
    if not isinstance(settled_share, numbers.Real) or not 0 < settled_share <= 1:
        raise ValueError(f"settled_share={settled_share!r} must be greater than 0, and at most 1.")

    vec_normalize = unwrap_vec_normalize(env)
    # Asked for before the work: not every environment answers
    limits = [getattr(spec, "max_episode_steps", None) for spec in env_specs(env)]
    bound = lyapunov.cost_bound(vec_normalize)
    with undisturbed(policy, env, seed), lyapunov.in_units_of(vec_normalize):
        roll_outs = roll_out(policy, env, n_eval_episodes, deterministic, lyapunov.normalized_rewards)
        roll_outs.add_values(policy, lyapunov, deterministic)

    transitions = roll_outs.transitions
    check_rewards(lyapunov, transitions["reward"])
    # A reward above all those of the training would have a negative cost, which L cannot learn
    transitions["cost"] = np.maximum(bound - transitions["reward"], 0.0)
    transitions["difference"] = transitions["next_lyapunov"] - transitions["lyapunov"] + alpha3 * transitions["cost"]
    if lyapunov.average_cost is None:
        transitions["cost_to_go"] = cost_to_go(transitions, lyapunov.gamma, lyapunov.horizon, max_tail_weight, bound)
    else:
        transitions["cost_to_go"] = relative_cost_to_go(transitions, lyapunov.average_cost)
    columns = ["episode", "step", "reward", "cost", "lyapunov", "next_lyapunov", "difference", "cost_to_go", "terminated"]
    transitions = transitions[columns]

    episodes = summarize_episodes(transitions)
    bootstrap = Bootstrap(len(episodes), n_bootstrap)
    return LyapunovReport(
        transitions=transitions,
        episodes=episodes,
        observations=roll_outs.vectors(),
        metrics=estimate_metrics(transitions, episodes, n_cost_levels, bootstrap),
        by_cost=decrease_by_cost(transitions, n_cost_levels, bootstrap),
        alpha3=alpha3,
        gamma=lyapunov.gamma,
        horizon=lyapunov.horizon,
        max_tail_weight=max_tail_weight,
        max_episode_steps=max((limit for limit in limits if limit is not None), default=None),
        seed=seed,
        settled_share=settled_share,
    )
