"""Is the learned ``L`` a certificate? Statistics of the decrease condition along roll-outs of a policy."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from scipy.signal import lfilter
from scipy.stats import binomtest, rankdata
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_lac.lac import LAC

Observations = np.ndarray | dict[str, np.ndarray]

#: Transitions whose ``L`` is computed at once
CHUNK_SIZE = 2048
CONFIDENCE = 0.95
#: Colours that colour-blind readers can tell apart (Okabe & Ito)
BLUE, VERMILION, GREEN, ORANGE, GREY = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#7f7f7f"


class Estimate(NamedTuple):
    """
    A statistic and its 95 % confidence interval, NaN where there is none.

    :param value: Of all roll-outs
    :param low: Lower end of the interval
    :param high: Upper end of the interval
    """

    value: float
    low: float
    high: float


NO_ESTIMATE = Estimate(math.nan, math.nan, math.nan)


def new_figure(width: float, height: float) -> Figure:
    """
    An empty figure, outside pyplot's global state.

    :param width: In inches
    :param height: In inches
    :return: The figure
    """
    return Figure(figsize=(width, height), dpi=150, layout="constrained")


def is_wide(values: pd.Series | np.ndarray) -> bool:
    """
    Whether values are best shown on a logarithmic scale.

    :param values: The values
    :return: True if they are positive and span more than a decade
    """
    return 0 < 10 * values.min() < values.max()


def set_log_scale(axes: Axes, which: Literal["x", "y"], values: pd.Series | np.ndarray) -> None:
    """
    Make an axis logarithmic if that suits its values.

    :param axes: The panel
    :param which: Which axis
    :param values: Values on this axis
    """
    if is_wide(values):
        axes.set(**{f"{which}scale": "log"})
        format_log_axis(axes.xaxis if which == "x" else axes.yaxis)


def format_log_axis(axis: Axis) -> None:
    """
    Label a logarithmic axis with numbers like 5 instead of powers like 5 * 10^0.

    :param axis: The axis
    """
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(LogFormatter())


def add_legend(axes: Axes) -> None:
    """
    Add a legend with one entry per label, if there are labels.

    :param axes: The panel
    """
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if handles:
        axes.legend(handles.values(), handles.keys(), fontsize=8)


def prepare_evaluation(model: LAC, env: gym.Env | VecEnv, n_eval_episodes: int) -> VecEnv:
    """
    Wrap an evaluation environment as the model would, and check that they fit together.

    :param model: The LAC model to evaluate
    :param env: The evaluation environment
    :param n_eval_episodes: Number of episodes
    :return: The wrapped environment
    """
    if not isinstance(model, LAC):
        raise ValueError(f"The model must be a LAC model, which has a Lyapunov function, and not {model!r}.")
    if n_eval_episodes < 1:
        raise ValueError(f"n_eval_episodes={n_eval_episodes} must be at least 1.")
    env = model._wrap_env(env, monitor_wrapper=False)
    check_for_correct_spaces(env, model.observation_space, model.action_space)
    # A model that was loaded without an environment does not know what it was trained with
    if model.get_env() is not None:
        normalized, expected = normalization(unwrap_vec_normalize(env)), normalization(model.get_vec_normalize_env())
        if normalized != expected:
            raise ValueError(
                f"The evaluation environment has {normalized}, but the training environment has {expected}: "
                "policy and L would get numbers that they were not trained on. Wrap the evaluation environment "
                "with VecNormalize in the same way, and synchronize its statistics with sync_envs_normalization()."
            )
    return env


def normalization(vec_normalize: VecNormalize | None) -> str:
    """
    What a ``VecNormalize`` wrapper normalizes.

    :param vec_normalize: The wrapper, if any
    :return: Description of it
    """
    if vec_normalize is None or not (vec_normalize.norm_obs or vec_normalize.norm_reward):
        return "no normalization"
    return f"norm_obs={vec_normalize.norm_obs} and norm_reward={vec_normalize.norm_reward}"


@contextmanager
def frozen_normalization(vec_normalize: VecNormalize | None) -> Iterator[None]:
    """
    Keep the statistics of a ``VecNormalize`` wrapper as they are, so that all costs have the same units.

    :param vec_normalize: The wrapper, if any
    """
    if vec_normalize is None:
        yield
        return
    training = vec_normalize.training
    vec_normalize.training = False
    try:
        yield
    finally:
        vec_normalize.training = training


def concatenate(batches: Sequence[Observations]) -> Observations:
    """
    Concatenate batches of observations.

    :param batches: At least one batch
    :return: All observations
    """
    first = batches[0]
    if isinstance(first, dict):
        return {key: np.concatenate([batch[key] for batch in batches]) for key in first}
    return np.concatenate(batches)  # type: ignore[arg-type]


def take(observations: Observations, rows: np.ndarray) -> Observations:
    """
    Copy some observations of a batch.

    :param observations: The batch
    :param rows: Indices of the observations
    :return: The chosen ones
    """
    if isinstance(observations, dict):
        return {key: values[rows] for key, values in observations.items()}
    return observations[rows]


def add_batch_dimension(observation: Observations) -> Observations:
    """
    Make a batch of a single observation.

    :param observation: The observation
    :return: A batch of one
    """
    if isinstance(observation, dict):
        return {key: np.asarray(value)[None] for key, value in observation.items()}
    return np.asarray(observation)[None]


def predict_in_chunks(model: LAC, observations: list[Observations], actions: list[np.ndarray]) -> np.ndarray:
    """
    Compute ``L`` of many small batches, with few passes of the critic and without one huge tensor.

    :param model: The model
    :param observations: Batches of observations
    :param actions: Batches of actions
    :return: All values
    """
    chunks = np.cumsum([len(batch) for batch in actions]) // CHUNK_SIZE
    starts = np.append(np.unique(chunks, return_index=True)[1], len(chunks))
    return np.concatenate(
        [
            model.policy.predict_lyapunov(concatenate(observations[start:end]), np.concatenate(actions[start:end]))
            for start, end in pairwise(starts)
        ],
        dtype=np.float64,
    )


def roll_out(model: LAC, env: VecEnv, n_eval_episodes: int, deterministic: bool) -> tuple[pd.DataFrame, np.ndarray | None]:
    """
    Run the policy and compute ``L`` along its trajectories.

    :param model: The model
    :param env: The environment
    :param n_eval_episodes: Number of episodes
    :param deterministic: Whether to use deterministic or stochastic actions
    :return: One row per transition with ``episode``, ``step``, ``reward``, ``lyapunov``, ``next_lyapunov`` and ``terminated``,
        and the observations if they are vectors
    """
    # As in ``evaluate_policy()``: each environment runs a fixed number of episodes,
    # if the first episodes to end were taken, they would be the short ones
    targets = np.array([(n_eval_episodes + i) // env.num_envs for i in range(env.num_envs)])
    counts = np.zeros(env.num_envs, dtype=int)
    batches: list[Observations] = []
    actions_taken: list[np.ndarray] = []
    steps: list[dict[str, np.ndarray]] = []
    last_observations: list[Observations] = []

    observations = env.reset()
    while (counts < targets).any():
        actions, _ = model.predict(observations, deterministic=deterministic)  # type: ignore[arg-type]
        new_observations, rewards, dones, infos = env.step(actions)
        active = np.flatnonzero(counts < targets)
        truncated = dones & np.array([info.get("TimeLimit.truncated", False) for info in infos])
        batches.append(take(observations, active))  # type: ignore[arg-type]
        actions_taken.append(actions[active])
        columns = {"reward": rewards, "done": dones, "truncated": truncated}
        steps.append({"env": active, **{name: column[active] for name, column in columns.items()}})
        last_observations += [add_batch_dimension(infos[i]["terminal_observation"]) for i in active if truncated[i]]
        counts += dones
        observations = new_observations

    transitions = pd.DataFrame({name: np.concatenate([step[name] for step in steps]) for name in steps[0]})
    transitions["reward"] = transitions["reward"].astype(np.float64)
    transitions["lyapunov"] = predict_in_chunks(model, batches, actions_taken)
    # The action in the last state of an episode that goes on is not taken
    transitions["last_lyapunov"] = np.nan
    if last_observations:
        states = concatenate(last_observations)
        last_actions, _ = model.predict(states, deterministic=deterministic)
        transitions.loc[transitions["truncated"], "last_lyapunov"] = model.policy.predict_lyapunov(states, last_actions)

    # From the order of time to one episode after the other
    order = np.argsort(transitions["env"], kind="stable")
    transitions = transitions.iloc[order].reset_index(drop=True)
    done = transitions["done"].to_numpy()
    transitions["episode"] = np.cumsum(done) - done
    transitions["step"] = transitions.groupby("episode").cumcount()
    transitions["next_lyapunov"] = transitions["lyapunov"].shift(-1).where(~done, transitions["last_lyapunov"])
    transitions["terminated"] = done & ~transitions["truncated"]

    space = model.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) > 1:
        return transitions, None
    states = concatenate(batches)
    assert isinstance(states, np.ndarray)
    return transitions, states[order].reshape((len(order), -1))


def cost_to_go(transitions: pd.DataFrame, gamma: float, horizon: int | None, max_tail_weight: float) -> np.ndarray:
    """
    What ``L`` estimates, of one roll-out: the discounted sum of the costs to come (in the next ``horizon`` steps).
    Nothing is to come after a termination, while the costs after a time limit are not seen.

    :param transitions: One row per transition with ``episode``, ``step``, ``cost`` and ``terminated``
    :param gamma: The discount factor
    :param horizon: Number of steps, None for all
    :param max_tail_weight: Largest weight of costs that are not seen, with an infinite horizon
    :return: The sums, NaN where too much is not seen
    """
    episode, step = transitions["episode"].to_numpy(), transitions["step"].to_numpy()
    lengths = np.bincount(episode)
    costs = np.zeros((len(lengths), lengths.max()))
    costs[episode, step] = transitions["cost"]
    # G = c + gamma * G' as a filter that runs back in time
    if horizon is None:
        numerator, denominator = np.ones(1), np.array([1.0, -gamma])
    else:
        numerator, denominator = gamma ** np.arange(min(horizon, costs.shape[1])), np.ones(1)
    sums = lfilter(numerator, denominator, costs[:, ::-1], axis=1)[:, ::-1][episode, step]
    remaining = lengths[episode] - step
    seen = gamma**remaining <= max_tail_weight if horizon is None else remaining >= horizon
    terminated = transitions.groupby("episode")["terminated"].transform("any").to_numpy()
    return np.where(seen | terminated, sums, np.nan)


def summarize_episodes(transitions: pd.DataFrame) -> pd.DataFrame:
    """
    Summarize each episode.

    :param transitions: One row per transition
    :return: One row per episode with ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost`` and ``terminated``
    """
    groups = transitions.groupby("episode")
    length = groups["step"].transform("size")
    late = length - transitions["step"] <= np.maximum(length // 5, 1)
    return pd.DataFrame(
        {
            "length": groups.size(),
            "total_cost": groups["cost"].sum(),
            "final_cost": groups["cost"].last(),
            "largest_late_cost": transitions["cost"].where(late).groupby(transitions["episode"]).max(),
            "terminated": groups["terminated"].any(),
        }
    )


def divide(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """
    Divide where that is possible.

    :param numerator: Any values
    :param denominator: Values that are not negative
    :return: The ratio, NaN where the denominator is 0
    """
    numerator, denominator = np.asarray(numerator), np.asarray(denominator)
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)


class Bootstrap:
    """
    Bootstrap that resamples episodes, for statistics that are functions of sums over all episodes.

    :param n_episodes: Number of episodes
    :param n_samples: Number of bootstrap samples
    """

    def __init__(self, n_episodes: int, n_samples: int):
        self.n_episodes = n_episodes
        self.n_samples = n_samples
        # The same roll-outs always have the same intervals
        self.rng = np.random.default_rng(0)
        # How often each episode is in each sample
        self.counts = self.rng.multinomial(n_episodes, np.full(n_episodes, 1 / n_episodes), size=n_samples)

    def estimate(
        self, statistic: Callable[[np.ndarray], np.ndarray], episode: np.ndarray | pd.Series, *values: np.ndarray | pd.Series
    ) -> Estimate:
        """
        Estimate a statistic.

        :param statistic: Function of the sums of the values, which are in the first dimension of its argument
        :param episode: Episode that each value belongs to
        :param values: What to sum
        :return: The estimate
        """
        sums = np.stack([np.bincount(episode, value, minlength=self.n_episodes) for value in values])
        samples = statistic(sums @ self.counts.T)
        return interval(float(statistic(sums.sum(axis=1))), samples, len(np.unique(episode)))

    def percentile(self, values: np.ndarray, percent: float) -> Estimate:
        """
        Estimate a percentile over episodes.

        :param values: One value per episode
        :param percent: Which percentile
        :return: The estimate
        """
        if len(values) == 0:
            return NO_ESTIMATE
        samples = np.percentile(self.rng.choice(values, size=(self.n_samples, len(values))), percent, axis=1)
        return interval(float(np.percentile(values, percent)), samples, len(values))


def interval(value: float, samples: np.ndarray, n_episodes: int) -> Estimate:
    """
    Percentile interval of a bootstrap.

    :param value: Of all episodes
    :param samples: Values of the bootstrap samples
    :param n_episodes: Number of episodes with data: one says nothing about the spread between episodes
    :return: The estimate
    """
    samples = samples[np.isfinite(samples)]
    if n_episodes < 2 or len(samples) == 0:
        return Estimate(value, math.nan, math.nan)
    low, high = np.quantile(samples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def ratio(sums: np.ndarray) -> np.ndarray:
    """
    Ratio of two sums.

    :param sums: The sums
    :return: The ratio
    """
    return divide(sums[0], sums[1])


def spread(n: np.ndarray, x: np.ndarray, xx: np.ndarray) -> np.ndarray:
    """
    Variance of x, times n^2.

    :param n: Number of values
    :param x: Sum of the values
    :param xx: Sum of their squares
    :return: The spread, 0 if it is no larger than rounding errors
    """
    result = n * xx - x**2
    return np.where(result > 1e-12 * n * xx, result, 0.0)


def slope(sums: np.ndarray) -> np.ndarray:
    """
    Slope of the least squares line.

    :param sums: Sums of 1, x, y, x^2, x * y, y^2
    :return: The slope
    """
    n, x, y, xx, xy, _ = sums
    return divide(n * xy - x * y, spread(n, x, xx))


def intercept(sums: np.ndarray) -> np.ndarray:
    """
    Intercept of the least squares line.

    :param sums: Sums of 1, x, y, x^2, x * y, y^2
    :return: The intercept
    """
    n, x, y, *_ = sums
    return divide(y - slope(sums) * x, n)


def correlation(sums: np.ndarray) -> np.ndarray:
    """
    Pearson's correlation coefficient.

    :param sums: Sums of 1, x, y, x^2, x * y, y^2
    :return: The coefficient
    """
    n, x, y, xx, xy, yy = sums
    return divide(n * xy - x * y, np.sqrt(spread(n, x, xx) * spread(n, y, yy)))


def decrease_metrics(transitions: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Estimate]:
    """
    Statistics of the decrease condition, and the mean cost.

    :param transitions: One row per transition
    :param bootstrap: Bootstrap of the episodes
    :return: Estimates by name
    """
    # There is no L in a terminal state
    known = transitions[~transitions["terminated"]]
    ones = np.ones(len(known))
    decreases = known["lyapunov"] - known["next_lyapunov"]
    return {
        "decrease": bootstrap.estimate(ratio, known["episode"], known["difference"], ones),
        "share_decreasing": bootstrap.estimate(ratio, known["episode"], known["difference"] <= 0, ones),
        "largest_feasible_alpha3": bootstrap.estimate(ratio, known["episode"], decreases, known["cost"]),
        "mean_cost": bootstrap.estimate(ratio, transitions["episode"], transitions["cost"], np.ones(len(transitions))),
    }


def calibration_metrics(transitions: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Estimate]:
    """
    How well ``L`` agrees with the cost-to-go.

    :param transitions: One row per transition
    :param bootstrap: Bootstrap of the episodes
    :return: Estimates by name
    """
    known = transitions[transitions["cost_to_go"].notna()]

    def estimate(statistic: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray) -> Estimate:
        return bootstrap.estimate(statistic, known["episode"], np.ones(len(x)), x, y, x**2, x * y, y**2)

    lyapunov, costs_to_go = known["lyapunov"].to_numpy(), known["cost_to_go"].to_numpy()
    return {
        "calibration_slope": estimate(slope, lyapunov, costs_to_go),
        "calibration_intercept": estimate(intercept, lyapunov, costs_to_go),
        # Spearman's correlation is Pearson's of the ranks, the bootstrap keeps the ranks among all transitions
        "rank_correlation": estimate(correlation, rankdata(lyapunov), rankdata(costs_to_go)),
    }


def episode_metrics(episodes: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Estimate]:
    """
    Where the episodes end.

    :param episodes: One row per episode
    :param bootstrap: Bootstrap of the episodes
    :return: Estimates by name
    """
    n_deaths = int(episodes["terminated"].sum())
    # A bootstrap of no deaths would have no width
    wilson = binomtest(n_deaths, len(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "ultimate_bound": bootstrap.percentile(episodes.loc[~episodes["terminated"], "largest_late_cost"].to_numpy(), 95),
        "death_rate": Estimate(n_deaths / len(episodes), float(wilson.low), float(wilson.high)),
    }


def decrease_by_cost(transitions: pd.DataFrame, n_levels: int, bootstrap: Bootstrap) -> pd.DataFrame:
    """
    Statistics of the decrease condition at each level of the cost.

    :param transitions: One row per transition
    :param n_levels: Number of levels, at quantiles of the cost (fewer if many costs are equal)
    :param bootstrap: Bootstrap of the episodes
    :return: One row per level
    """
    known = transitions[~transitions["terminated"]]
    quantiles = known["cost"].quantile(np.linspace(0, 1, n_levels + 1)[1:-1])
    levels = known.groupby(np.searchsorted(quantiles, known["cost"]))
    decrease = [bootstrap.estimate(ratio, level["episode"], level["difference"], np.ones(len(level))) for _, level in levels]
    table = levels["cost"].agg(cost_low="min", cost_high="max", n_transitions="size")
    table[["decrease", "decrease_low", "decrease_high"]] = np.reshape(decrease, (-1, 3))
    table["share_decreasing"] = (known["difference"] <= 0).groupby(levels.ngroup()).mean().to_numpy()
    return table.reset_index(drop=True)


@dataclass(frozen=True, eq=False)
class LyapunovReport:
    """
    How ``L`` behaves along roll-outs of a policy, see ``evaluate_lyapunov()``.

    :param transitions: One row per transition, episodes one after the other: ``episode``, ``step``, ``reward``, ``cost``,
        ``lyapunov`` (``L(s, a)``), ``next_lyapunov`` (``L(s', a')``, NaN if s' is terminal), ``difference``
        (``L(s', a') - L(s, a) + alpha3 * c``), ``cost_to_go`` (NaN if too much of it was not seen), ``terminated``
    :param episodes: One row per episode: ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost`` (in its last
        fifth), ``terminated``
    :param observations: The observations of the transitions as the policy saw them, or None if they are no vectors
    :param metrics: Estimates by name
    :param by_cost: The decrease condition by level of the cost: ``cost_low``, ``cost_high``, ``n_transitions``, ``decrease``,
        ``decrease_low``, ``decrease_high``, ``share_decreasing``
    :param alpha3: Share of the cost by which ``L`` has to decrease
    :param gamma: The discount factor
    :param horizon: Number of steps whose costs ``L`` estimates, None for all to come
    :param max_tail_weight: Largest weight of the costs to come after the end of an episode, in ``cost_to_go``
    """

    transitions: pd.DataFrame
    episodes: pd.DataFrame
    observations: np.ndarray | None
    metrics: dict[str, Estimate]
    by_cost: pd.DataFrame
    alpha3: float
    gamma: float
    horizon: int | None
    max_tail_weight: float

    @property
    def n_calibrated(self) -> int:
        """Number of transitions with a known cost-to-go, those that ``L`` is compared with."""
        return int(self.transitions["cost_to_go"].notna().sum())

    def to_frame(self) -> pd.DataFrame:
        """
        The metrics as a table.

        :return: One row per metric, with columns ``value``, ``low`` and ``high``
        """
        return pd.DataFrame.from_dict(self.metrics, orient="index", columns=list(Estimate._fields)).rename_axis("metric")

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
        for name, (value, low, high) in self.metrics.items():
            lines.append(f"  {name:<24}{value:>12.4g}   [{low:.4g}, {high:.4g}]")
        lines.append(f"With alpha3={self.alpha3:g} the decrease condition {self._verdict()}.")
        if self.n_calibrated == 0:
            lines.append(f"L could not be compared with the cost-to-go: {self._why_not_calibrated()}")
        else:
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
        if math.isnan(decrease.low):
            return "is undecided: one episode with a decrease gives no interval, use more episodes"
        return "is undecided: the interval of decrease contains 0"

    def _why_not_calibrated(self) -> str:
        longest = f"the longest episode has {self.episodes['length'].max()} steps"
        longer = "use longer episodes in the evaluation environment, like gym.make(id, max_episode_steps=...)"
        if self.horizon is not None:
            return f"no episode terminated or has the {self.horizon} steps of the horizon ({longest}); {longer}."
        if self.gamma >= 1:
            return (
                "no episode terminated, and with gamma=1 the costs after a time limit weigh as much as those before it; "
                "max_tail_weight=1 leaves them out."
            )
        n_steps = math.ceil(math.log(self.max_tail_weight) / math.log(self.gamma))
        return (
            f"the costs to come after the time limit weigh more than max_tail_weight={self.max_tail_weight:g} everywhere. "
            f"It takes {n_steps} steps to forget them, {longest}; {longer}, or a larger max_tail_weight."
        )

    def plot(self) -> Figure:
        """
        Draw four panels: ``L`` along episodes, the decrease condition by level of the cost, ``L`` against the cost-to-go
        and costs over time.

        :return: The figure
        """
        figure = new_figure(9.5, 7.0)
        panels = figure.subplots(2, 2)
        self._plot_episodes(panels[0, 0])
        self._plot_by_cost(panels[0, 1])
        self._plot_calibration(panels[1, 0])
        self._plot_costs(panels[1, 1])
        return figure

    def _plot_episodes(self, axes: Axes) -> None:
        # Few enough that each line can be followed
        chosen = np.unique(np.linspace(0, len(self.episodes) - 1, 8).astype(int))
        for number in chosen:
            episode = self.transitions[self.transitions["episode"] == number]
            axes.plot(episode["step"], episode["lyapunov"], color=BLUE, alpha=0.55, lw=1.1)
            if self.episodes["terminated"].iloc[number]:
                axes.plot(episode["step"].iloc[-1], episode["lyapunov"].iloc[-1], "x", color=VERMILION, label="died")
        set_log_scale(axes, "y", self.transitions["lyapunov"])
        axes.set(xlabel="step", ylabel="$L(s, a)$", title=f"L along {len(chosen)} episodes")
        add_legend(axes)

    def _plot_by_cost(self, axes: Axes) -> None:
        table = self.by_cost
        positions = np.arange(len(table))
        axes.axhline(0, color="0.4", lw=1)
        colours = np.select([table["decrease_high"] < 0, table["decrease_low"] > 0], [GREEN, VERMILION], GREY).tolist()
        axes.vlines(positions, table["decrease_low"], table["decrease_high"], colors=colours, lw=2)
        axes.scatter(positions, table["decrease"], c=colours, s=30, zorder=3)
        labels = [f"{low:.2g}\nto {high:.2g}" for low, high in zip(table["cost_low"], table["cost_high"], strict=True)]
        axes.set_xticks(positions, labels, fontsize=8)
        axes.margins(x=0.1)
        axes.set(
            xlabel="cost of the transition",
            ylabel=r"mean of $L(s', a') - L(s, a) + \alpha_3 c$",
            title=f"Decrease condition by cost, alpha3={self.alpha3:g}",
        )

    def _plot_calibration(self, axes: Axes) -> None:
        axes.set(xlabel="$L(s, a)$", ylabel="cost-to-go", title="L against the cost-to-go")
        known = self.transitions[self.transitions["cost_to_go"].notna()]
        if known.empty:
            axes.text(0.5, 0.5, "no episode is long enough", transform=axes.transAxes, ha="center", color="0.4")
            return
        limits = [
            min(known["lyapunov"].min(), known["cost_to_go"].min()),
            max(known["lyapunov"].max(), known["cost_to_go"].max()),
        ]
        axes.plot(limits, limits, color="0.4", lw=1, label="identity", zorder=3)
        # More points would only cover each other
        shown = known.iloc[:: math.ceil(len(known) / 5000)]
        axes.scatter(shown["lyapunov"], shown["cost_to_go"], s=4, color=BLUE, alpha=0.3, lw=0, rasterized=True)
        set_log_scale(axes, "x", known["lyapunov"])
        set_log_scale(axes, "y", known["cost_to_go"])
        add_legend(axes)

    def _plot_costs(self, axes: Axes) -> None:
        low, median, high = self.transitions.groupby("step")["cost"].quantile(np.array([0.1, 0.5, 0.9])).unstack().to_numpy().T
        steps = np.arange(len(median))
        axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, lw=0, label="10 % to 90 % of the episodes")
        axes.plot(steps, median, color=BLUE, lw=1.4, label="median")
        ultimate_bound = self.metrics["ultimate_bound"].value
        if not math.isnan(ultimate_bound):
            axes.axhline(ultimate_bound, color=ORANGE, ls="--", lw=1.2, label=f"ultimate bound {ultimate_bound:.2g}")
        set_log_scale(axes, "y", low)
        axes.set(xlabel="step", ylabel="cost", title="Costs over time")
        add_legend(axes)

    def plot_phase(self, x: int = 0, y: int = 1, names: Sequence[str] | None = None) -> Figure:
        """
        Draw the trajectories in two dimensions of the observation, coloured by ``L``.

        :param x: Dimension of the observation on the horizontal axis
        :param y: Dimension of the observation on the vertical axis
        :param names: Names of all dimensions
        :return: The figure
        """
        points = self._dimensions(x, y)
        figure = new_figure(6.4, 5.2)
        axes = figure.subplots()
        lyapunov, episode = self.transitions["lyapunov"].to_numpy(), self.transitions["episode"].to_numpy()
        inside = episode[1:] == episode[:-1]
        lines = LineCollection(np.stack([points[:-1], points[1:]], axis=1)[inside], cmap="viridis_r", lw=0.9)
        lines.set_array(lyapunov[:-1][inside])
        if is_wide(lyapunov):
            lines.set_norm(LogNorm())
        axes.add_collection(lines)
        ends = np.append(np.flatnonzero(~inside), len(points) - 1)
        died = self.episodes["terminated"].to_numpy()
        axes.scatter(
            points[ends[~died], 0],
            points[ends[~died], 1],
            s=16,
            color="black",
            zorder=3,
            label=f"end, survived ({np.sum(~died)})",
        )
        axes.scatter(
            points[ends[died], 0],
            points[ends[died], 1],
            s=28,
            color=VERMILION,
            marker="x",
            zorder=3,
            label=f"end, died ({np.sum(died)})",
        )
        bar = figure.colorbar(lines, ax=axes, label="$L(s, a)$")
        if is_wide(lyapunov):
            format_log_axis(bar.ax.yaxis)
        axes.set(title=f"Trajectories of {len(self.episodes)} episodes", **self._labels(x, y, names))
        figure.legend(loc="outside lower center", ncols=2, fontsize=8)
        return figure

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
        points = self._dimensions(x, y)
        if threshold is None:
            threshold = self.metrics["ultimate_bound"].value
        starts = (self.transitions["step"] == 0).to_numpy()
        points, lyapunov = points[starts], self.transitions["lyapunov"].to_numpy()[starts]
        died = self.episodes["terminated"].to_numpy()
        settled = ~died & (self.episodes["largest_late_cost"].to_numpy() <= threshold)

        figure = new_figure(6.4, 5.2)
        axes = figure.subplots()
        # A triangulation needs points that are neither few nor on one line
        distinct, first = np.unique(points, axis=0, return_index=True)
        if len(distinct) >= 10 and np.linalg.matrix_rank(distinct - distinct.mean(axis=0)) == 2:
            levels = axes.tricontourf(distinct[:, 0], distinct[:, 1], lyapunov[first], levels=12, cmap="Blues")
            figure.colorbar(levels, ax=axes, label="$L(s, a)$ at the start")
        for chosen, label, colour, marker in (
            (settled, "settled", GREEN, "o"),
            (~settled & ~died, "not settled", ORANGE, "s"),
            (died, "died", VERMILION, "X"),
        ):
            label = f"{label} ({np.sum(chosen)})"
            axes.scatter(
                points[chosen, 0], points[chosen, 1], s=30, color=colour, marker=marker, edgecolor="white", lw=0.6, label=label
            )
        # Contours end at the outermost points, whose markers would be cut
        axes.use_sticky_edges = False
        axes.set(title=f"What became of {len(points)} start states", **self._labels(x, y, names))
        figure.legend(loc="outside lower center", ncols=3, fontsize=8)
        return figure

    def _dimensions(self, x: int, y: int) -> np.ndarray:
        """
        Two dimensions of the observations.

        :param x: First dimension
        :param y: Second dimension
        :return: Array with two columns
        """
        if self.observations is None:
            raise ValueError("This figure needs observations that are vectors (a Box space with at most one dimension).")
        n_dims = self.observations.shape[1]
        if not (0 <= x < n_dims and 0 <= y < n_dims):
            raise ValueError(
                f"x={x} and y={y} must lie between 0 and {n_dims - 1}, the observations have {n_dims} dimensions."
            )
        return self.observations[:, [x, y]]

    def _labels(self, x: int, y: int, names: Sequence[str] | None) -> dict[str, Any]:
        assert self.observations is not None
        n_dims = self.observations.shape[1]
        if names is None:
            names = [f"observation {k}" for k in range(n_dims)]
        if len(names) != n_dims:
            raise ValueError(f"names={list(names)} must name all {n_dims} dimensions of the observations.")
        return {"xlabel": names[x], "ylabel": names[y]}


def evaluate_lyapunov(
    model: LAC,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = False,
    alpha3: float | None = None,
    max_tail_weight: float = 0.05,
    n_cost_levels: int = 5,
    n_bootstrap: int = 1000,
    seed: int | None = None,
) -> LyapunovReport:
    """
    Run the policy for ``n_eval_episodes`` episodes and check whether the learned ``L`` is a Lyapunov function along them:
    whether it decreases by ``alpha3`` times the cost, ``E[L(s', a')] - L(s, a) <= -alpha3 * c``, and whether it is what it
    should have learned, the discounted sum of costs to come.

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

    Their intervals are percentiles of a bootstrap that resamples episodes (the transitions of an episode depend on each
    other), and Wilson's for ``death_rate``. ``a'`` is the action taken next; after a time limit it is an action of the policy.
    A terminal state has no ``L``: transitions into it do not count for the decrease condition.

    .. note::
        Costs are those that ``L`` was trained on, of rewards and ends of episodes as they appear with ``env.step`` calls:
        wrap ``env`` as the training environment. Unlike in ``evaluate_policy()``, a ``Monitor`` makes no difference.
        With gSDE, the noise matrix of the last roll-out is kept.

    :param model: The LAC model you want to evaluate
    :param env: The gym environment or ``VecEnv`` environment. Its normalization statistics are used as they are:
        call ``sync_envs_normalization()`` before, if it is not the training environment.
    :param n_eval_episodes: Number of episodes, divided onto the elements of a vector env as in ``evaluate_policy()``
    :param deterministic: Whether to use deterministic or stochastic actions
    :param alpha3: Share of the cost by which ``L`` has to decrease, that of the model by default
    :param max_tail_weight: The costs after a time limit are not seen. A transition is used for the comparison of ``L`` with
        the cost-to-go if they weigh at most that much in it, ``gamma ** remaining_steps <= max_tail_weight``.
        With a finite horizon, all of its costs must have been seen instead.
    :param n_cost_levels: Number of levels of the cost, at its quantiles, for which the decrease is reported separately
    :param n_bootstrap: Number of bootstrap samples
    :param seed: Seed for ``env`` and for the actions
    :return: The report
    """
    env = prepare_evaluation(model, env, n_eval_episodes)
    alpha3 = model.alpha3 if alpha3 is None else alpha3
    if not alpha3 > 0:
        raise ValueError(f"alpha3={alpha3} must be greater than 0.")
    if not 0 < max_tail_weight <= 1:
        raise ValueError(f"max_tail_weight={max_tail_weight} must be greater than 0, and at most 1.")
    if n_cost_levels < 1 or n_bootstrap < 1:
        raise ValueError(f"n_cost_levels={n_cost_levels} and n_bootstrap={n_bootstrap} must be at least 1.")

    if seed is not None:
        env.seed(seed)
    # A training goes on as if there had been no evaluation
    with th.random.fork_rng(devices=[model.device] if model.device.type == "cuda" else []):
        if seed is not None:
            th.manual_seed(seed)
        with frozen_normalization(unwrap_vec_normalize(env)):
            transitions, observations = roll_out(model, env, n_eval_episodes, deterministic)

    # A reward above all those of the training would have a negative cost, which L cannot learn
    bound = float(model.cost_bound(unwrap_vec_normalize(env)))
    transitions["cost"] = np.maximum(bound - transitions["reward"], 0.0)
    transitions["difference"] = transitions["next_lyapunov"] - transitions["lyapunov"] + alpha3 * transitions["cost"]
    transitions["cost_to_go"] = cost_to_go(transitions, model.gamma, model.horizon, max_tail_weight)
    columns = ["episode", "step", "reward", "cost", "lyapunov", "next_lyapunov", "difference", "cost_to_go", "terminated"]
    transitions = transitions[columns]

    episodes = summarize_episodes(transitions)
    bootstrap = Bootstrap(len(episodes), n_bootstrap)
    return LyapunovReport(
        transitions=transitions,
        episodes=episodes,
        observations=observations,
        metrics={
            **decrease_metrics(transitions, bootstrap),
            **calibration_metrics(transitions, bootstrap),
            **episode_metrics(episodes, bootstrap),
        },
        by_cost=decrease_by_cost(transitions, n_cost_levels, bootstrap),
        alpha3=alpha3,
        gamma=model.gamma,
        horizon=model.horizon,
        max_tail_weight=max_tail_weight,
    )
