"""Statistics of the decrease condition and of the cost-to-go, with intervals over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """
    A statistic and its 95 % confidence interval, NaN where there is none.

    :param value: Of all roll-outs
    :param low: Lower end of the interval
    :param high: Upper end of the interval
    """

    value: float
    low: float
    high: float


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

    Samples in which a statistic is not defined, as a ratio to a cost of 0, are left out. ``scipy.stats.bootstrap`` would give
    no interval at all.

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
    ) -> Interval:
        """
        Estimate a statistic.

        :param statistic: Function of the sums of the values
        :param episode: Episode that each value belongs to
        :param values: What to sum
        :return: The statistic of all episodes, with its interval
        """
        sums = np.stack([np.bincount(episode, value, minlength=self.n_episodes) for value in values])
        samples = statistic(*(sums @ self.counts.T))
        return percentile_interval(float(statistic(*sums.sum(axis=1))), samples, len(np.unique(episode)))

    def percentile(self, values: np.ndarray, percent: float) -> Interval:
        """
        Estimate a percentile over episodes.

        :param values: One value per episode
        :param percent: Which percentile
        :return: The percentile of all episodes, with its interval
        """
        if len(values) == 0:
            return Interval(math.nan, math.nan, math.nan)
        samples = np.percentile(self.rng.choice(values, size=(self.n_samples, len(values))), percent, axis=1)
        return percentile_interval(float(np.percentile(values, percent)), samples, len(values))


def percentile_interval(value: float, samples: np.ndarray, n_episodes: int) -> Interval:
    """
    Percentile interval of a bootstrap.

    :param value: Of all episodes
    :param samples: Values of the bootstrap samples
    :param n_episodes: Number of episodes with data: one says nothing about the spread between episodes
    :return: The value with its interval
    """
    samples = samples[np.isfinite(samples)]
    if n_episodes < 2 or len(samples) == 0:
        return Interval(value, math.nan, math.nan)
    low, high = np.quantile(samples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high))


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


def estimate_metrics(transitions: pd.DataFrame, episodes: pd.DataFrame, bootstrap: Bootstrap) -> dict[str, Interval]:
    """
    Estimate the metrics that ``evaluate_lyapunov()`` lists.

    :param transitions: One row per transition
    :param episodes: One row per episode
    :param bootstrap: Bootstrap of the episodes
    :return: Values with their intervals, by name
    """
    from scipy.stats import binomtest, rankdata

    # There is no L in a terminal state
    known = transitions[~transitions["terminated"]]
    ones = np.ones(len(known))
    decreases = known["lyapunov"] - known["next_lyapunov"]

    calibrated = transitions[transitions["cost_to_go"].notna()]
    lyapunov, costs_to_go = calibrated["lyapunov"].to_numpy(), calibrated["cost_to_go"].to_numpy()

    def compare(statistic: Callable[..., np.ndarray], x: np.ndarray, y: np.ndarray) -> Interval:
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
        "death_rate": Interval(n_deaths / len(episodes), float(wilson.low), float(wilson.high)),
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
