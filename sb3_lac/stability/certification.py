"""Exact statements about a closed loop, from finitely many independent episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_lac.checks import advice_for_a_time_limit
from sb3_lac.stability.functions import LyapunovFunction
from sb3_lac.stability.loop import ClosedLoop, by_keyword, closed_loop
from sb3_lac.stability.rollout import flatten, summarize_episodes, where_it_rests
from sb3_lac.stability.statistics import CONFIDENCE, exact_interval, exact_lower_bound

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: What is said of a bound that brings its own measure
OWN_BOUND = "The bound is this loop's own. To compare loops, state one for all of them: ultimate_bound=..."
#: What it takes to make a statement that not every certification makes
NEEDS = {
    "stays_within": "an ultimate_bound: give one, or a fitted function, whose roll-outs have one",
    "decreases": "a function with a level and window_steps, as that of fit_lyapunov(policy, env) if it falls, and an episode "
    "that starts above that level and is longer than that",
}

# The interval of a start state lies above one half if all of so many episodes are attracted
_LEAST_PER_START = math.ceil(math.log((1 - CONFIDENCE) / 2, 0.5))


@dataclass(frozen=True, eq=False)
class CertificationReport:
    """
    Result of ``certify()``: statements about a closed loop that hold together with 95 % confidence. Read ``summary()`` first;
    ``statements`` has its numbers.

    :param statements: One row per statement, by name: the number ``n_episodes`` of counted episodes, the number ``n_true`` of
        true ones, their ``share``, and ``at_least``, the lower bound of the probability
    :param transitions: One row per transition of those episodes: ``episode``, ``step``, ``reward``, ``cost``, ``terminated``,
        ``lyapunov`` if there is a function, and others
    :param episodes: One row per episode, as in ``LyapunovReport``, and one column per statement: 1 if true, 0 if not, NaN if
        the episode does not count
    :param starts: One row per initial state on the grid: ``state_0`` and so on, ``n_episodes``, ``n_attracted``, their
        ``share`` with its exact interval ``low`` and ``high``; None without given initial states
    :param ultimate_bound: The cost to stay within, None if there is none
    :param own_bound: Whether this cost is the function's own bound, which no other loop is measured by
    :param level: Value of the function above which the function has to decrease, None if there is none
    :param window_steps: Number of steps of this decrease, None if there is none
    :param description: The policy, the environment and the seed
    """

    statements: pd.DataFrame
    transitions: pd.DataFrame
    episodes: pd.DataFrame
    starts: pd.DataFrame | None
    ultimate_bound: float | None
    own_bound: bool
    level: float | None
    window_steps: int | None
    description: str

    @property
    def confidence_of_each(self) -> float:
        """Confidence of a single statement, with which all of them hold together (Bonferroni's inequality)."""
        return _of_each(len(self.statements))

    def summary(self) -> str:
        """
        Say the statements in a readable form.

        :return: A text of several lines
        """
        lines = [
            f"Certification of {self.description}: {len(self.episodes)} episodes of up to "
            f"{self.episodes['length'].max()} steps",
            f"  {'statement':<14}{'true in':>14}   probability, at least",
        ]
        for name, row in self.statements.iterrows():
            counts = f"{row['n_true']:.0f} of {row['n_episodes']:.0f}"
            at_least = math.floor(1e4 * row["at_least"]) / 1e4  # a lower bound is not rounded up
            lines.append(f"  {name:<14}{counts:>14}   {at_least:.4f}   {self._meaning(str(name))}")
        for name, needs in NEEDS.items():
            if name not in self.statements.index:
                lines.append(f"  {name:<14}{'not made':>14}   it takes {needs}")
        start_cost, late_cost = self._start_cost(), self.episodes.loc[self.episodes["survives"] == 1, "late_cost"].mean()
        if self.ultimate_bound is not None and late_cost < start_cost:
            lines.append(f"Where it survives, the loop {where_it_rests(late_cost, start_cost)}")
        if self.own_bound:
            lines.append(OWN_BOUND)
        lines.append(
            f"Together with {100 * CONFIDENCE:g} % confidence: each bound is that of Clopper and Pearson with "
            f"{100 * self.confidence_of_each:.4g} % (Bonferroni)."
        )
        if self.starts is not None:
            attracted = (self.starts["low"] >= 0.5).sum()
            lines.append(
                f"Region of attraction: {attracted} of {len(self.starts)} start states are attracted with a probability of at "
                f"least one half, each by its own {100 * CONFIDENCE:g} % interval of "
                f"{self.starts['n_episodes'].iloc[0]} episodes."
            )
        lines.append(
            "Exact for independent episodes with the starts, the disturbances and the length of these. It says nothing about "
            "other starts, later times or another plant, and is no proof of stability."
        )
        return "\n".join(lines)

    def _start_cost(self) -> float:
        return float(self.transitions.loc[self.transitions["step"] == 0, "cost"].mean())

    def _meaning(self, name: str) -> str:
        if name == "survives":
            advice = advice_for_a_time_limit(self.episodes["length"].to_numpy()) if self.episodes["terminated"].any() else ""
            return f"no termination. {advice}".rstrip(". ")
        if name == "stays_within":
            bound, start_cost = self.ultimate_bound, self._start_cost()
            return f"survives, and no cost in the last fifth is above {bound:.3g} (first steps: {start_cost:.3g})"
        return f"L falls over every {self.window_steps} steps that begin with L above {self.level:.3g}"

    def plot(self) -> Figure:
        """
        Draw two panels: the statements with their bounds, and the costs over time.

        :return: The figure
        """
        from sb3_lac.stability import plots  # matplotlib is slow to import, and only a figure needs it

        return plots.plot_certification(self.statements, self.transitions, self.ultimate_bound, self.own_bound)

    def plot_region_of_attraction(self, x: int = 0, y: int = 1, names: Sequence[str] | None = None) -> Figure:
        """
        Draw for each start state how probable it is, at least, that it is attracted.

        :param x: Dimension of the start state on the horizontal axis
        :param y: Dimension of the start state on the vertical axis
        :param names: Names of all dimensions
        :return: The figure
        """
        from sb3_lac.stability import plots

        if self.starts is None:
            raise ValueError("There are no start states: certify(..., starts=...) tries those of an array.")
        return plots.plot_region_of_attraction(self.starts, x, y, names)


@by_keyword
def certify(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    *,
    lyapunov: LyapunovFunction | None = None,
    n_episodes: int = 300,
    ultimate_bound: float | None = None,
    starts: np.ndarray | None = None,
    n_episodes_per_start: int = 10,
    deterministic: bool = True,
    seed: int | None = None,
) -> CertificationReport:
    """
    Bound from below, with 95 % confidence, the probability that an episode survives, settles, and decreases ``L``.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import certify, fit_lyapunov
      from sb3_lac.envs import reference_controller

      env = gym.make("LinearCost-v0")
      controller = reference_controller(env)  # or a model of any algorithm
      lyapunov = fit_lyapunov(controller, env, n_episodes=20, seed=0)
      print(certify(controller, env, lyapunov=lyapunov, n_episodes=100, seed=1000).summary())

    Each statement is a yes-or-no question for an episode. The bound of Clopper and Pearson (1934) only assumes independent
    episodes: 300 of 300 means at least 99 % for one statement, and 98.6 % for each of three. The statements are

    - ``survives``: no termination
    - ``stays_within``: survives, and no cost in the last fifth of the episode is above ``ultimate_bound``
    - ``decreases``: survives, and ``L`` is lower ``lyapunov.window_steps`` later wherever ``L`` is above ``lyapunov.level``.
      Only episodes with such a window, and terminated episodes, count.

    Do not choose thresholds on the counted episodes. A fitted function brings the thresholds of its own roll-outs: the largest
    late cost, the largest late value, and the shortest window of a decrease.

    :param policy: A model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The environment, wrapped as that of the training. Several environments at once are faster.
    :param lyapunov: The function, if decrease is to be certified
    :param n_episodes: Number of episodes
    :param ultimate_bound: The cost to stay within, by default that of ``lyapunov``. Each fit has another bound: to compare
        loops, state one bound for all.
    :param starts: Initial states on a grid, shape (n, n_states), each passed to ``env.reset(options={"state": ...})``
    :param n_episodes_per_start: Number of episodes from each initial state, at least 6
    :param deterministic: Whether to certify the mean action or sampled actions
    :param seed: Seed of the episodes, not a seed of the fit (refused) or of the training; drawn if None, and named in the
        report's description
    :return: The report
    :raises ValueError: If an argument is invalid
    """
    check_bound(ultimate_bound)
    if starts is not None:
        starts = np.asarray(starts, dtype=np.float64)
        if starts.ndim != 2 or len(starts) == 0 or not np.isfinite(starts).all():
            raise ValueError(f"starts of shape {starts.shape} must be finite numbers of shape (n_starts, n_states).")
        if n_episodes_per_start < _LEAST_PER_START:
            raise ValueError(
                f"n_episodes_per_start={n_episodes_per_start} must be at least {_LEAST_PER_START}: fewer episodes show no "
                "start state to be attracted with a probability of one half, even if all of them are."
            )
    with closed_loop(policy, env, lyapunov, n_episodes, deterministic, seed) as loop:
        own_bound = ultimate_bound is None and lyapunov is not None and lyapunov.ultimate_bound is not None
        if ultimate_bound is None and lyapunov is not None:
            ultimate_bound = lyapunov.ultimate_bound
        attraction = None
        if starts is not None:
            attraction = _attraction(loop, starts, n_episodes_per_start, ultimate_bound)
            loop.env.seed(loop.seed)
        transitions = loop.roll_out(n_episodes).transitions
        if ultimate_bound is not None:
            loop.check_costs(transitions["reward"])
        description = loop.description

    level, window_steps = (None, None) if lyapunov is None else (lyapunov.level, lyapunov.window_steps)
    episodes = _testimonies(transitions, ultimate_bound, level, window_steps)
    return CertificationReport(
        statements=_statements(episodes),
        transitions=transitions,
        episodes=episodes,
        starts=attraction,
        ultimate_bound=ultimate_bound,
        own_bound=own_bound,
        level=level,
        window_steps=window_steps,
        description=description,
    )


def check_bound(ultimate_bound: float | None) -> None:
    """Refuse what is no cost to stay within."""
    if ultimate_bound is not None and not (isinstance(ultimate_bound, (float, int, np.number)) and ultimate_bound >= 0):
        raise ValueError(f"ultimate_bound={ultimate_bound!r} must be a number of at least 0, or None.")


def _check_starts(env: VecEnv, starts: np.ndarray) -> None:
    """Check that an environment starts in the stated states."""
    # Not every vector environment takes options for each of its elements
    env.set_options([{"state": starts[k % len(starts)].tolist()} for k in range(env.num_envs)])
    env.reset()
    # With the same random numbers: one that differs, or from what the environment does by itself. The observation need not
    # show all of the state.
    first = None
    for options in [*({"state": start} for start in starts.tolist()), None]:
        env.seed(0)
        env.set_options(options)
        # Copied, for wrappers that stack frames return the same array again
        observation = flatten(env.reset())  # type: ignore[arg-type]
        first = observation if first is None else first
        if not np.array_equal(observation, first):
            return
    raise ValueError(
        "The environment ignores reset(options={'state': ...}). Let its reset() start in options['state'], or wrap it so. "
        "Without a choice of initial states, leave starts out."
    )


def _stay_within(episodes: pd.DataFrame, ultimate_bound: float) -> pd.Series:
    """
    Tell whether episodes survive, and the last fifth of each costs no more than a bound. It compares in single precision, in
    which some vector environments hold rewards: there a cost of 0.1 is a little more than 0.1.
    """
    within = episodes["largest_late_cost"].astype(np.float32) <= np.float32(ultimate_bound)
    return ~episodes["terminated"] & within


def _testimonies(
    transitions: pd.DataFrame, ultimate_bound: float | None, level: float | None, window_steps: int | None
) -> pd.DataFrame:
    """Summarize the episodes, with a column for what each says to each statement."""
    episodes = summarize_episodes(transitions)
    alive = ~episodes["terminated"]
    episodes["survives"] = alive.astype(float)
    if ultimate_bound is not None:
        episodes["stays_within"] = _stay_within(episodes, ultimate_bound).astype(float)
    if level is not None and window_steps is not None:
        later = transitions.groupby("episode")["lyapunov"].shift(-window_steps)
        windows = (transitions["lyapunov"] > level) & later.notna()
        falls = (later < transitions["lyapunov"]).where(windows).groupby(transitions["episode"]).min()
        # A death is no decrease, whatever came before it
        episodes["decreases"] = falls.astype(float).where(alive, 0.0)
    return episodes


def _of_each(n_statements: int) -> float:
    return 1 - (1 - CONFIDENCE) / n_statements


def _statements(episodes: pd.DataFrame) -> pd.DataFrame:
    """Count the testimonies, and bound the probability of each statement."""
    import pandas as pd

    names = [name for name in ("survives", "stays_within", "decreases") if name in episodes and episodes[name].notna().any()]
    counts = {name: (int(episodes[name].notna().sum()), int(episodes[name].sum())) for name in names}
    rows = {
        name: {
            "n_episodes": n,
            "n_true": n_true,
            "share": n_true / n,
            "at_least": exact_lower_bound(n_true, n, _of_each(len(names))),
        }
        for name, (n, n_true) in counts.items()
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("statement")


def _attraction(loop: ClosedLoop, starts: np.ndarray, n_episodes: int, ultimate_bound: float | None) -> pd.DataFrame:
    """Count the episodes that are attracted from each start state."""
    import pandas as pd

    if ultimate_bound is None:
        raise ValueError("A start is attracted if its episode ends within ultimate_bound: give one, or a fitted lyapunov.")
    _check_starts(loop.env, starts)
    # Other episodes than those of the statements
    loop.env.seed(int(np.random.SeedSequence(loop.seed).generate_state(1)[0] // 2))
    transitions = loop.roll_out(np.repeat(starts, n_episodes, axis=0), with_values=False).transitions
    loop.check_costs(transitions["reward"])
    attracted = _stay_within(summarize_episodes(transitions), ultimate_bound).to_numpy()
    # In the order of the starts: each episode had a number of its own
    counts = attracted.reshape(len(starts), n_episodes).sum(axis=1)
    table = pd.DataFrame(starts, columns=[f"state_{k}" for k in range(starts.shape[1])])
    table["n_episodes"], table["n_attracted"] = n_episodes, counts
    table[["share", "low", "high"]] = np.array([exact_interval(int(count), n_episodes) for count in counts])
    return table
