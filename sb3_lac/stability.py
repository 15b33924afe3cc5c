"""Is the learned ``L`` a certificate? Statistics of the decrease condition along roll-outs of a policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_lac.lac import LAC, sum_of_discounts, time_limits

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Observations = np.ndarray | dict[str, np.ndarray]

#: Transitions whose ``L`` is computed at once
CHUNK_SIZE = 2048
CONFIDENCE = 0.95


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


def trains_on(model: LAC, env: VecEnv) -> bool:
    """
    Whether a model collects its training data in an environment, or in one of those that it consists of.

    :param model: The model
    :param env: The environment, wrapped or not
    :return: True if stepping the one steps the other
    """
    training_env = model.get_env()
    if training_env is None:
        return False
    if env.unwrapped is training_env.unwrapped:
        return True
    first, second = (
        {id(single.unwrapped) for single in getattr(vec_env.unwrapped, "envs", [])} for vec_env in (env, training_env)
    )
    return not first.isdisjoint(second)


def normalization(vec_normalize: VecNormalize | None) -> str:
    """
    What a ``VecNormalize`` wrapper normalizes.

    :param vec_normalize: The wrapper, if any
    :return: Description of it
    """
    if vec_normalize is None or not (vec_normalize.norm_obs or vec_normalize.norm_reward):
        return "no normalization"
    return f"norm_obs={vec_normalize.norm_obs} and norm_reward={vec_normalize.norm_reward}"


def combine(function: Callable[[list[np.ndarray]], np.ndarray], observations: Sequence[Observations]) -> Observations:
    """
    Make one batch of several observations or batches, of each key if they are dicts.

    :param function: What to do with the arrays, like ``np.concatenate``
    :param observations: At least one
    :return: The batch
    """
    first = observations[0]
    if isinstance(first, dict):
        return {key: function([observation[key] for observation in observations]) for key in first}
    return function(list(observations))  # type: ignore[arg-type]


def take(observations: Observations, rows: np.ndarray | slice) -> Observations:
    """
    Choose some observations of a batch.

    :param observations: The batch
    :param rows: Which ones
    :return: The chosen ones
    """
    return combine(lambda arrays: arrays[0][rows], [observations])


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
    # Slow to import like scipy and matplotlib below, and only an evaluation needs them
    import pandas as pd

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
        last_observations += [infos[i]["terminal_observation"] for i in active if truncated[i]]
        counts += dones
        observations = new_observations

    transitions = pd.DataFrame({name: np.concatenate([step[name] for step in steps]) for name in steps[0]})
    transitions["reward"] = transitions["reward"].astype(np.float64)
    states, all_actions = combine(np.concatenate, batches), np.concatenate(actions_taken)
    # Few passes of the critic, but not one huge tensor
    chunks = [slice(start, start + CHUNK_SIZE) for start in range(0, len(all_actions), CHUNK_SIZE)]
    values = [model.policy.predict_lyapunov(take(states, chunk), all_actions[chunk]) for chunk in chunks]
    transitions["lyapunov"] = np.concatenate(values, dtype=np.float64)
    # The action in the last state of an episode that goes on is not taken
    transitions["last_lyapunov"] = np.nan
    if last_observations:
        last_states = combine(np.stack, last_observations)
        last_actions, _ = model.predict(last_states, deterministic=deterministic)
        transitions.loc[transitions["truncated"], "last_lyapunov"] = model.policy.predict_lyapunov(last_states, last_actions)

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
    assert isinstance(states, np.ndarray)
    return transitions, states[order].reshape((len(order), -1))


def cost_to_go(
    transitions: pd.DataFrame, gamma: float, horizon: int | None, max_tail_weight: float, bound: float
) -> np.ndarray:
    """
    What ``L`` estimates, of one roll-out: the discounted sum of the costs to come (in the next ``horizon`` steps).
    After a termination nothing is paid any more, while the costs after a time limit are not seen.

    :param transitions: One row per transition with ``episode``, ``step``, ``cost`` and ``terminated``
    :param gamma: The discount factor
    :param horizon: Number of steps, None for all
    :param max_tail_weight: Largest weight of costs that are not seen, with an infinite horizon
    :param bound: Cost of each step after a termination, 0 with an infinite horizon that is not discounted
    :return: The sums, NaN where too much is not seen
    """
    episode, step = transitions["episode"].to_numpy(), transitions["step"].to_numpy()
    lengths = np.bincount(episode)
    costs = np.zeros((len(lengths), lengths.max()))
    costs[episode, step] = transitions["cost"]
    from scipy.signal import lfilter

    # G = c + gamma * G' as a filter that runs back in time
    if horizon is None:
        numerator, denominator = np.ones(1), np.array([1.0, -gamma])
    else:
        numerator, denominator = gamma ** np.arange(min(horizon, costs.shape[1])), np.ones(1)
    sums = lfilter(numerator, denominator, costs[:, ::-1], axis=1)[:, ::-1][episode, step]
    remaining = lengths[episode] - step
    seen = gamma**remaining <= max_tail_weight if horizon is None else remaining >= horizon
    terminated = transitions.groupby("episode")["terminated"].transform("any").to_numpy()
    if bound > 0:
        # Of the steps from now on, those after the termination
        passed = remaining if horizon is None else np.minimum(remaining, horizon)
        weights = np.array([sum_of_discounts(gamma, int(steps)) for steps in range(lengths.max() + 1)])
        sums = sums + terminated * bound * (sum_of_discounts(gamma, horizon) - weights[passed])
    return np.where(seen | terminated, sums, np.nan)


def summarize_episodes(transitions: pd.DataFrame) -> pd.DataFrame:
    """
    Summarize each episode.

    :param transitions: One row per transition
    :return: One row per episode with ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost`` and ``terminated``
    """
    import pandas as pd

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


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
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
        self, statistic: Callable[..., np.ndarray], episode: np.ndarray | pd.Series, *values: np.ndarray | pd.Series
    ) -> Estimate:
        """
        Estimate a statistic.

        :param statistic: Function of the sums of the values
        :param episode: Episode that each value belongs to
        :param values: What to sum
        :return: The estimate
        """
        sums = np.stack([np.bincount(episode, value, minlength=self.n_episodes) for value in values])
        samples = statistic(*(sums @ self.counts.T))
        return interval(float(statistic(*sums.sum(axis=1))), samples, len(np.unique(episode)))

    def percentile(self, values: np.ndarray, percent: float) -> Estimate:
        """
        Estimate a percentile over episodes.

        :param values: One value per episode
        :param percent: Which percentile
        :return: The estimate
        """
        if len(values) == 0:
            return Estimate(math.nan, math.nan, math.nan)
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


def slope(n: np.ndarray, x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> np.ndarray:
    """
    Slope of the least squares line, of sums as ``intercept()`` and ``correlation()``.

    :param n: Number of values
    :param x: Sum of x
    :param y: Sum of y
    :param xx: Sum of x^2
    :param xy: Sum of x * y
    :param yy: Sum of y^2
    :return: The slope
    """
    return ratio(n * xy - x * y, spread(n, x, xx))


def intercept(n: np.ndarray, x: np.ndarray, y: np.ndarray, *squares: np.ndarray) -> np.ndarray:
    """
    Intercept of the least squares line.

    :param n: Number of values
    :param x: Sum of x
    :param y: Sum of y
    :param squares: Sums of x^2, x * y and y^2
    :return: The intercept
    """
    return ratio(y - slope(n, x, y, *squares) * x, n)


def correlation(n: np.ndarray, x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> np.ndarray:
    """
    Pearson's correlation coefficient.

    :param n: Number of values
    :param x: Sum of x
    :param y: Sum of y
    :param xx: Sum of x^2
    :param xy: Sum of x * y
    :param yy: Sum of y^2
    :return: The coefficient
    """
    return ratio(n * xy - x * y, np.sqrt(spread(n, x, xx) * spread(n, y, yy)))


def estimate_metrics(transitions: pd.DataFrame, episodes: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Estimate]:
    """
    Estimate the metrics that ``evaluate_lyapunov()`` lists.

    :param transitions: One row per transition
    :param episodes: One row per episode
    :param bootstrap: Bootstrap of the episodes
    :return: Estimates by name
    """
    from scipy.stats import binomtest, rankdata

    # There is no L in a terminal state
    known = transitions[~transitions["terminated"]]
    ones = np.ones(len(known))
    decreases = known["lyapunov"] - known["next_lyapunov"]

    calibrated = transitions[transitions["cost_to_go"].notna()]
    lyapunov, costs_to_go = calibrated["lyapunov"].to_numpy(), calibrated["cost_to_go"].to_numpy()

    def compare(statistic: Callable[..., np.ndarray], x: np.ndarray, y: np.ndarray) -> Estimate:
        return bootstrap.estimate(statistic, calibrated["episode"], np.ones(len(x)), x, y, x**2, x * y, y**2)

    n_deaths = int(episodes["terminated"].sum())
    # A bootstrap of no deaths would have no width
    wilson = binomtest(n_deaths, len(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "decrease": bootstrap.estimate(ratio, known["episode"], known["difference"], ones),
        "share_decreasing": bootstrap.estimate(ratio, known["episode"], known["difference"] <= 0, ones),
        "largest_feasible_alpha3": bootstrap.estimate(ratio, known["episode"], decreases, known["cost"]),
        "mean_cost": bootstrap.estimate(ratio, transitions["episode"], transitions["cost"], np.ones(len(transitions))),
        "calibration_slope": compare(slope, lyapunov, costs_to_go),
        "calibration_intercept": compare(intercept, lyapunov, costs_to_go),
        # Spearman's correlation is Pearson's of the ranks, the bootstrap keeps the ranks among all transitions
        "rank_correlation": compare(correlation, rankdata(lyapunov), rankdata(costs_to_go)),
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
    :param max_episode_steps: Gymnasium's time limit of the environment, None if it ends its episodes itself
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
    max_episode_steps: int | None

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
        missing: dict[str, list[str]] = {}
        for name, (value, low, high) in self.metrics.items():
            if math.isnan(value):
                missing.setdefault(self._why_not_available(name), []).append(name)
                lines.append(f"  {name:<24}not available")
            elif math.isnan(low):
                lines.append(f"  {name:<24}{value:>12.4g}   not available: it takes two episodes with data")
            else:
                lines.append(f"  {name:<24}{value:>12.4g}   [{low:.4g}, {high:.4g}]")
        lines += [f"Not available: {', '.join(names)}. {reason}" for reason, names in missing.items()]
        lines.append(f"With alpha3={self.alpha3:g} the decrease condition {self._verdict()}.")
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
            return "is undecided: one episode with a decrease gives no interval, use more episodes"
        return "is undecided: the interval of decrease contains 0"

    def _why_not_available(self, name: str) -> str:
        if name == "ultimate_bound":
            return "Every episode terminated: train longer, or start closer to the goal."
        if name in ("decrease", "share_decreasing") or (
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
        if self.horizon is None and self.gamma >= 1:
            return (
                "no episode terminated, and with gamma=1 the costs after a time limit weigh as much as those before it; "
                "max_tail_weight=1 leaves them out."
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
        from sb3_lac import stability_plots

        return stability_plots.plot_report(self)

    def plot_phase(self, x: int = 0, y: int = 1, names: Sequence[str] | None = None) -> Figure:
        """
        Draw the trajectories in two dimensions of the observation, coloured by ``L``.

        :param x: Dimension of the observation on the horizontal axis
        :param y: Dimension of the observation on the vertical axis
        :param names: Names of all dimensions
        :return: The figure
        """
        from sb3_lac import stability_plots

        return stability_plots.plot_phase(self, x, y, names)

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
        from sb3_lac import stability_plots

        return stability_plots.plot_region_of_attraction(self, x, y, names, threshold)


def evaluate_lyapunov(
    model: LAC,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 20,
    deterministic: bool = True,
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
        The training environment (``model.get_env()``) may be used between two calls of ``learn()``: the next one then starts
        with a reset, and the unfinished episodes in the replay buffer end as by a time limit.

    :param model: The LAC model you want to evaluate
    :param env: The gym environment or ``VecEnv`` environment. Its normalization statistics are used as they are:
        call ``sync_envs_normalization()`` before, if it is not the training environment.
    :param n_eval_episodes: Number of episodes, divided onto the elements of a vector env as in ``evaluate_policy()``
    :param deterministic: Whether to judge the policy's mean action, as it is used after the training, or sampled actions
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

    vec_normalize = unwrap_vec_normalize(env)
    # The scale of normalized rewards may have changed since the last update
    model.update_offset(vec_normalize)
    if seed is not None:
        env.seed(seed)
    # A training goes on as if there had been no evaluation
    with th.random.fork_rng(devices=[model.device] if model.device.type == "cuda" else []):
        if seed is not None:
            th.manual_seed(seed)
        training = vec_normalize is not None and vec_normalize.training
        try:
            # All costs have the same units
            if vec_normalize is not None:
                vec_normalize.training = False
            transitions, observations = roll_out(model, env, n_eval_episodes, deterministic)
        finally:
            if trains_on(model, env):
                model.end_episodes()
            if vec_normalize is not None:
                vec_normalize.training = training

    # A reward above all those of the training would have a negative cost, which L cannot learn
    bound = model.cost_bound(vec_normalize).item()
    transitions["cost"] = np.maximum(bound - transitions["reward"], 0.0)
    transitions["difference"] = transitions["next_lyapunov"] - transitions["lyapunov"] + alpha3 * transitions["cost"]
    transitions["cost_to_go"] = cost_to_go(transitions, model.gamma, model.horizon, max_tail_weight, bound)
    columns = ["episode", "step", "reward", "cost", "lyapunov", "next_lyapunov", "difference", "cost_to_go", "terminated"]
    transitions = transitions[columns]

    episodes = summarize_episodes(transitions)
    bootstrap = Bootstrap(len(episodes), n_bootstrap)
    return LyapunovReport(
        transitions=transitions,
        episodes=episodes,
        observations=observations,
        metrics=estimate_metrics(transitions, episodes, bootstrap),
        by_cost=decrease_by_cost(transitions, n_cost_levels, bootstrap),
        alpha3=alpha3,
        gamma=model.gamma,
        horizon=model.horizon,
        max_tail_weight=max_tail_weight,
        max_episode_steps=max((limit for limit in time_limits(env) if limit is not None), default=None),
    )
