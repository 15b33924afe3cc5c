"""Statistics of the decrease condition and of the cost-to-go, with intervals over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

#: Of all intervals, and of all exact statements of one certification together
CONFIDENCE = 0.95
#: Number of bootstrap samples
N_BOOTSTRAP = 1000
#: Number of levels of the cost, at its quantiles, at each of which L has to decrease
N_COST_LEVELS = 5
#: Largest weight of the costs that follow a time limit, and were not seen, in a cost-to-go
MAX_TAIL_WEIGHT = 0.05


class Interval(NamedTuple):
    """
    A statistic and its 95 % confidence interval; NaN without an interval, infinite on an unlimited side.

    :param value: Value over all roll-outs
    :param low: Lower end of the interval
    :param high: Upper end of the interval
    """

    value: float
    low: float
    high: float


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Divide where that is possible."""
    numerator, denominator = np.asarray(numerator), np.asarray(denominator)
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)


class Bootstrap:
    """
    Bootstrap that resamples episodes, for statistics that are functions of sums over all episodes.

    Samples in which a statistic is not defined, as a ratio to a cost of 0, are left out, and if they are more than the 2.5 %
    beyond an end of the interval, there is none: it takes some four episodes with data. ``scipy.stats.bootstrap`` would give
    no interval wherever one sample is not defined.
    """

    def __init__(self, n_episodes: int):
        self.n_episodes = n_episodes
        # How often each episode is in each sample. The same roll-outs always have the same intervals.
        self.counts = np.random.default_rng(0).multinomial(n_episodes, np.full(n_episodes, 1 / n_episodes), size=N_BOOTSTRAP)

    def estimate(
        self, statistic: Callable[..., np.ndarray], episode: np.ndarray | pd.Series, *values: np.ndarray | pd.Series
    ) -> Interval:
        """Estimate a statistic."""
        sums = np.stack([np.bincount(episode, value, minlength=self.n_episodes) for value in values])
        # No sample has a value where a sum is infinite
        with np.errstate(invalid="ignore"):
            samples = statistic(*(sums @ self.counts.T))
        return self._interval(float(statistic(*sums.sum(axis=1))), samples)

    def estimate_levels(
        self,
        statistic: Callable[..., np.ndarray],
        level: np.ndarray,
        episode: np.ndarray | pd.Series,
        *values: np.ndarray,
        of_episodes: Sequence[np.ndarray] = (),
    ) -> Interval:
        """Estimate a statistic of several levels."""
        n_levels = int(level.max()) + 1
        sums = np.zeros((len(values), self.n_episodes, n_levels))
        for total, value in zip(sums, values, strict=True):
            np.add.at(total, (np.asarray(episode), level), value)
        totals = [*sums.sum(axis=1), *(np.sum(value) for value in of_episodes)]
        samples = [*(self.counts @ sums), *(self.counts @ value for value in of_episodes)]
        return self._interval(float(statistic(*totals)), statistic(*samples))

    def _interval(self, value: float, samples: np.ndarray) -> Interval:
        defined = samples[np.isfinite(samples)]
        # With few episodes that have data, a sample often has none of them, and the others are more alike than episodes are:
        # with a single one, all of them are equal
        too_few = self.n_episodes < 2 or len(defined) < (1 + CONFIDENCE) / 2 * len(samples)
        if too_few or math.isnan(value):
            return Interval(value, math.nan, math.nan)
        low, high = np.quantile(defined, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        return Interval(value, float(low), float(high))


def spread(n: np.ndarray, x: np.ndarray, xx: np.ndarray) -> np.ndarray:
    """Variance of x, times n^2."""
    result = n * xx - x**2
    return np.where(result > 1e-12 * n * xx, result, 0.0)


def slope(n: np.ndarray, x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> np.ndarray:
    """Slope of the least squares line, of sums as ``correlation()``."""
    return ratio(n * xy - x * y, spread(n, x, xx))


def correlation(n: np.ndarray, x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> np.ndarray:
    """Pearson's correlation coefficient."""
    return ratio(n * xy - x * y, np.sqrt(spread(n, x, xx) * spread(n, y, yy)))


def largest_mean(n: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The largest mean of all levels."""
    return np.where(n > 0, ratio(x, n), -np.inf).max(axis=-1)


def tightest_drift(n: np.ndarray, drift: np.ndarray, cost: np.ndarray, late_cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The Foster-Lyapunov condition ``E[L' - L] <= -alpha3 * c + b`` at each level of the cost, with the alpha3 and b that say
    most: those with the least ``b / alpha3``, which bounds the mean cost in the long run.
    """
    occupied, late_cost = np.asarray(n) > 0, np.asarray(late_cost)
    # With t = 1 / alpha3 it is the largest of straight lines, whose least value is at t = 0, or where
    # two of them meet, or where the last one reaches that cost, or 0
    with np.errstate(divide="ignore", invalid="ignore"):
        m, c = drift / n, cost / n
        least = np.where(np.isnan(late_cost), np.where(occupied, c, np.inf).min(axis=-1), late_cost)[..., None]
        of_pairs = (c[..., :, None] - c[..., None, :]) / (m[..., None, :] - m[..., :, None])
        meetings = np.concatenate([of_pairs.reshape((*occupied.shape[:-1], -1)), (least - c) / m, -c / m], axis=-1)
        meetings = np.sort(np.where(np.isfinite(meetings) & (meetings > 0), meetings, np.inf))
        # where L falls at the largest cost, an infinite alpha3 says no more than others
        falls = ((m < 0) | (c != np.where(occupied, c, -np.inf).max(axis=-1, keepdims=True))).all(axis=-1, keepdims=True)
        t = np.concatenate([np.where(falls & np.isfinite(meetings[..., :1]), np.inf, 0.0), meetings], axis=-1)
        lines = np.where(occupied[..., None, :], t[..., None] * m[..., None, :] + c[..., None, :], -np.inf)
        of_t = np.where(np.isfinite(t), np.maximum(lines.max(axis=-1), least), np.inf)
        # The largest alpha3 of those that say as much
        best = np.argmax(of_t <= of_t.min(axis=-1, keepdims=True) * (1 + 1e-12), axis=-1, keepdims=True)
        bounds, t_best = (np.take_along_axis(values, best, axis=-1)[..., 0] for values in (of_t, t))
        defined = occupied.any(axis=-1) & np.isfinite(np.where(occupied, m + c, 0.0)).all(axis=-1)
        return np.where(defined, bounds, np.nan), np.where(defined & (t_best > 0), 1 / t_best, np.nan)


def levels_of_cost(transitions: pd.DataFrame) -> np.ndarray:
    """Return the level of the cost that each transition belongs to."""
    quantiles = transitions["cost"].quantile(np.linspace(0, 1, N_COST_LEVELS + 1)[1:-1])
    return np.unique(np.searchsorted(quantiles, transitions["cost"]), return_inverse=True)[1]


def estimate_drift(transitions: pd.DataFrame, episodes: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Interval]:
    """Estimate the metrics of the decrease condition with a residual."""
    names = ("residual", "cost_bound", "cost_bound_alpha3")
    if transitions.empty:
        return {name: Interval(math.nan, math.nan, math.nan) for name in names}
    level, episode, ones = levels_of_cost(transitions), transitions["episode"], np.ones(len(transitions))
    drift, cost = (transitions["next_lyapunov"] - transitions["lyapunov"]).to_numpy(), transitions["cost"].to_numpy()
    survived = (~episodes["terminated"]).to_numpy(dtype=np.float64)
    late = (survived * episodes["late_cost"].to_numpy(), survived)

    def estimate(index: int) -> Interval:
        def statistic(*sums: np.ndarray) -> np.ndarray:
            n, of_drift, of_cost, of_late, n_late = sums
            return tightest_drift(n, of_drift, of_cost, ratio(of_late, n_late))[index]

        return bootstrap.estimate_levels(statistic, level, episode, ones, drift, cost, of_episodes=late)

    return {
        "residual": bootstrap.estimate_levels(largest_mean, level, episode, ones, transitions["difference"].to_numpy()),
        "cost_bound": estimate(0),
        "cost_bound_alpha3": estimate(1),
    }


def exact_lower_bound(n_true: int, n: int, confidence: float) -> float:
    """Lower bound of a probability, from independent trials (Clopper and Pearson, 1934)."""
    from scipy.stats import binomtest

    return float(binomtest(n_true, n, alternative="greater").proportion_ci(confidence, method="exact").low)


def exact_interval(n_true: int, n: int) -> Interval:
    """Interval of a probability, from independent trials (Clopper and Pearson, 1934)."""
    from scipy.stats import binomtest

    interval = binomtest(n_true, n).proportion_ci(CONFIDENCE, method="exact")
    return Interval(n_true / n, float(interval.low), float(interval.high))


def exact_percentile(values: np.ndarray, percent: float) -> Interval:
    """
    A percentile with its interval between order statistics, which needs no assumption of how the values are distributed
    (Conover, 1999, Practical Nonparametric Statistics, section 3.2). A bootstrap has no sample above the largest value.
    """
    from scipy.stats import quantile_test

    value = float(np.percentile(values, percent)) if len(values) > 0 else math.nan
    if len(values) < 2:
        return Interval(value, math.nan, math.nan)
    interval: Any = quantile_test(values, p=percent / 100).confidence_interval(CONFIDENCE)
    # scipy says NaN where no order statistic is a limit
    low, high = np.nan_to_num(interval.low, nan=-math.inf), np.nan_to_num(interval.high, nan=math.inf)
    return Interval(value, float(low), float(high))


def estimate_metrics(transitions: pd.DataFrame, episodes: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Interval]:
    """Estimate the metrics that ``evaluate_lyapunov()`` lists."""
    from scipy.stats import binomtest, rankdata

    # There is no L in a terminal state
    running = transitions[~transitions["terminated"]]
    starts = transitions[transitions["step"] == 0]
    survivors = episodes[~episodes["terminated"]]
    long = survivors[survivors["late_rise"].notna()]
    ones = np.ones(len(running))
    decreases = running["lyapunov"] - running["next_lyapunov"]

    calibrated = transitions[transitions["cost_to_go"].notna()]
    lyapunov, costs_to_go = calibrated["lyapunov"].to_numpy(), calibrated["cost_to_go"].to_numpy()

    def compare(statistic: Callable[..., np.ndarray], x: np.ndarray, y: np.ndarray) -> Interval:
        return bootstrap.estimate(statistic, calibrated["episode"], np.ones(len(x)), x, y, x**2, x * y, y**2)

    n_deaths = int(episodes["terminated"].sum())
    # A bootstrap of no deaths would have no width
    wilson = binomtest(n_deaths, len(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "decrease": bootstrap.estimate(ratio, running["episode"], running["difference"], ones),
        "share_decreasing": bootstrap.estimate(ratio, running["episode"], running["difference"] <= 0, ones),
        "largest_feasible_alpha3": bootstrap.estimate(ratio, running["episode"], decreases, running["cost"]),
        "mean_cost": bootstrap.estimate(ratio, transitions["episode"], transitions["cost"], np.ones(len(transitions))),
        "calibration_slope": compare(slope, lyapunov, costs_to_go),
        # Spearman's correlation is Pearson's of the ranks, the bootstrap keeps the ranks among all transitions
        "rank_correlation": compare(correlation, rankdata(lyapunov), rankdata(costs_to_go)),
        "ultimate_bound": exact_percentile(episodes.loc[~episodes["terminated"], "largest_late_cost"].to_numpy(), 95),
        "death_rate": Interval(n_deaths / len(episodes), float(wilson.low), float(wilson.high)),
        "start_cost": bootstrap.estimate(ratio, starts["episode"], starts["cost"], np.ones(len(starts))),
        "late_cost": bootstrap.estimate(ratio, survivors.index, survivors["late_cost"], np.ones(len(survivors))),
        "late_rise": bootstrap.estimate(ratio, long.index, long["late_rise"], np.ones(len(long))),
        **estimate_drift(running, episodes, bootstrap),
    }


def decrease_by_cost(transitions: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Statistics of the decrease condition at each level of the cost."""
    running = transitions[~transitions["terminated"]]
    levels = running.groupby(levels_of_cost(running))
    decrease = [bootstrap.estimate(ratio, level["episode"], level["difference"], np.ones(len(level))) for _, level in levels]
    table = levels["cost"].agg(cost_low="min", cost_high="max", cost="mean", n_transitions="size")
    table["drift"] = (running["next_lyapunov"] - running["lyapunov"]).groupby(levels.ngroup()).mean().to_numpy()
    table[["decrease", "decrease_low", "decrease_high"]] = np.reshape(decrease, (-1, 3))
    table["share_decreasing"] = (running["difference"] <= 0).groupby(levels.ngroup()).mean().to_numpy()
    return table.reset_index(drop=True)


def relative_cost_to_go(transitions: pd.DataFrame, average_cost: float) -> np.ndarray:
    """
    Sum the costs to come beyond the average one, which a function of the average cost estimates. What follows a time limit is
    the value of the function there, and so only the first half of each episode is looked at.
    """
    groups = transitions.groupby("episode")
    excess = (transitions["cost"] - average_cost)[::-1]
    to_come = excess.groupby(transitions["episode"][::-1]).cumsum()[::-1]
    within_half = ~groups["terminated"].transform("any") & (2 * transitions["step"] < groups["step"].transform("size"))
    return (to_come + groups["next_lyapunov"].transform("last")).where(within_half, np.nan).to_numpy()


def cost_to_go(transitions: pd.DataFrame, gamma: float, reward_bound: float) -> np.ndarray:
    """
    Sum the discounted costs to come, which ``L`` estimates. After a death nothing is paid any more, so that each step costs
    what the bound is, while the costs after a time limit are not seen.
    """
    from scipy.signal import lfilter  # slow to import, and only an evaluation needs it

    episode, step = transitions["episode"].to_numpy(), transitions["step"].to_numpy()
    lengths = np.bincount(episode)
    costs = np.zeros((len(lengths), lengths.max()))
    costs[episode, step] = transitions["cost"]
    # G = c + gamma * G' as a filter that runs back in time
    sums = lfilter(np.ones(1), np.array([1.0, -gamma]), costs[:, ::-1], axis=1)[:, ::-1][episode, step]
    remaining = lengths[episode] - step
    terminated = transitions.groupby("episode")["terminated"].transform("any").to_numpy()
    if reward_bound > 0:
        weights = np.append(0.0, np.cumsum(gamma ** np.arange(lengths.max())))
        # Without a discount these costs have no sum
        after = 1 / (1 - gamma) - weights[remaining] if gamma < 1 else np.nan
        sums = np.where(terminated, sums + reward_bound * after, sums)
    return np.where((gamma**remaining <= MAX_TAIL_WEIGHT) | terminated, sums, np.nan)
