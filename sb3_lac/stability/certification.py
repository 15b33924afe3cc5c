"""Exact statements about a closed loop, from finitely many independent episodes."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_lac.stability.fitting import FittedLyapunov, flatten
from sb3_lac.stability.functions import LyapunovFunction, check_function, check_rewards
from sb3_lac.stability.rollout import (
    check_number,
    check_seeds,
    check_training_seeds,
    known_seed,
    prepare_evaluation,
    roll_out,
    stay_within,
    summarize_episodes,
    undisturbed,
)
from sb3_lac.stability.statistics import exact_interval, exact_lower_bound, percent
from sb3_lac.vec_env import env_specs

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class CertificationReport:
    """
    What is known of a closed loop with a given confidence, see ``certify()``.

    :param statements: One row per statement, by name: ``n_episodes`` that testify, ``n_true`` of them for it, their ``share``,
        and ``at_least``, which the probability is not below with the confidence
    :param transitions: One row per transition of those episodes: ``episode``, ``step``, ``reward``, ``cost``, ``terminated``,
        and ``lyapunov`` if there is a function
    :param episodes: One row per episode: ``length``, ``total_cost``, ``final_cost``, ``largest_late_cost``, ``terminated``,
        and one column per statement: 1 if it was true, 0 if not, NaN if the episode does not testify
    :param starts: One row per start state on the grid: ``state_0`` and so on, ``n_episodes``, ``n_attracted``, their ``share``
        with its exact interval ``low`` and ``high``; None if no start states were given
    :param confidence: Of all statements together; of the interval of each start state by itself
    :param cost_bound: The cost to stay within, None if there is none
    :param level: Value of the function above which it has to decrease, None if there is none
    :param window_steps: Over how many steps, None if there is none
    :param description: The policy, the environment and the seed
    """

    statements: pd.DataFrame
    transitions: pd.DataFrame
    episodes: pd.DataFrame
    starts: pd.DataFrame | None
    confidence: float
    cost_bound: float | None
    level: float | None
    window_steps: int | None
    description: str

    @property
    def confidence_of_each(self) -> float:
        """Confidence of a single statement, with which all of them hold together (Bonferroni's inequality)."""
        return 1 - (1 - self.confidence) / len(self.statements)

    def to_frame(self) -> pd.DataFrame:
        """
        The statements as a table.

        :return: One row per statement, with columns ``n_episodes``, ``n_true``, ``share`` and ``at_least``
        """
        return self.statements.copy()

    def summary(self) -> str:
        """
        The statements in a readable form.

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
        for name, reason in self._not_made().items():
            lines.append(f"  {name:<14}{'not made':>14}   {reason}")
        n_statements = len(self.statements)
        lines.append(
            f"All {n_statements} hold together with {percent(self.confidence)} % confidence: each bound is that of Clopper "
            f"and Pearson with {percent(self.confidence_of_each)} % (Bonferroni)."
            if n_statements > 1
            else f"The bound is that of Clopper and Pearson with {percent(self.confidence)} % confidence."
        )
        if self.starts is not None:
            attracted = (self.starts["low"] >= 0.5).sum()
            lines.append(
                f"Region of attraction: {attracted} of {len(self.starts)} start states are attracted with a probability of at "
                f"least one half, each by its own {percent(self.confidence)} % interval of "
                f"{self.starts['n_episodes'].iloc[0]} episodes."
            )
        lines.append(
            "Exact for independent episodes with the starts, the disturbances and the length of these. It says nothing about "
            "other starts, later times or another plant, and is no proof of stability."
        )
        return "\n".join(lines)

    def _meaning(self, name: str) -> str:
        if name == "survives":
            return "no termination"
        if name == "stays_within":
            start_cost = self.transitions.loc[self.transitions["step"] == 0, "cost"].mean()
            return f"survives, and no cost in the last fifth is above {self.cost_bound:.3g} (first steps: {start_cost:.3g})"
        return f"L falls over every {self.window_steps} steps that begin with L above {self.level:.3g}"

    def _not_made(self) -> dict[str, str]:
        reasons = {}
        if "stays_within" not in self.statements.index:
            reasons["stays_within"] = "there is no cost_bound: give one, or a fitted function, whose roll-outs have one"
        if "decreases" not in self.statements.index:
            if "lyapunov" not in self.transitions:
                reasons["decreases"] = "there is no Lyapunov function: pass that of fit_lyapunov(policy, env)"
            elif self.level is None or self.window_steps is None:
                reasons["decreases"] = (
                    "there is no level and window: on the roll-outs of the fit L did not fall from its starts to where it ends"
                )
            else:
                reasons["decreases"] = (
                    f"no episode is above the level {self.level:.3g} for a window of {self.window_steps} steps: none starts "
                    "further away than where the loop settles, if it settles"
                )
        return reasons

    def plot(self) -> Figure:
        """
        Draw two panels: the statements with their bounds, and the costs over time.

        :return: The figure
        """
        from sb3_lac.stability import plots  # matplotlib is slow to import, and only a figure needs it

        return plots.plot_certification(self.statements, self.transitions, percent(self.confidence), self.cost_bound)

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
        return plots.plot_attraction(self.starts, percent(self.confidence), x, y, names)


def certify(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    lyapunov: LyapunovFunction | None = None,
    n_episodes: int = 300,
    confidence: float = 0.95,
    cost_bound: float | None = None,
    level: float | None = None,
    window_steps: int | None = None,
    starts: np.ndarray | None = None,
    n_episodes_per_start: int = 10,
    deterministic: bool = True,
    seed: int | None = None,
) -> CertificationReport:
    """
    State what finitely many episodes say about the loop that a policy closes. Each statement is a question that an episode
    answers with yes or no, so that the exact bound of Clopper and Pearson (1934) holds for its probability, without any
    assumption but that episodes are independent: 300 of 300 means at least 99 % with 95 % confidence, of one statement, and
    98.6 % of each of three. The statements are

    - ``survives``: no termination
    - ``stays_within``: survives, and no cost in the last fifth of the episode is above ``cost_bound``
    - ``decreases``: survives, and ``L`` is lower ``window_steps`` later wherever it is above ``level``. Only episodes with
      such a window testify, and those that died.

    They hold together with the ``confidence`` (Bonferroni). What they are about (``cost_bound``, ``level``, ``window_steps``)
    must not be chosen by the episodes that testify; a fitted function brings those of its own roll-outs, the largest late cost
    and the largest late value there, and the shortest window over which it decreased there.

    :param policy: A model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The environment, wrapped as that of the training. Several at once are faster.
    :param lyapunov: The function, if decrease is to be certified
    :param n_episodes: Number of episodes
    :param confidence: Of all statements together, and of the interval of each start state by itself
    :param cost_bound: The cost to stay within, that of ``lyapunov`` by default
    :param level: Value above which ``lyapunov`` has to decrease, that of its fit by default
    :param window_steps: Number of steps over which it has to, that of its fit by default
    :param starts: Start states on a grid, shape (n, n_states), each handed to ``env.reset(options={"state": ...})``
    :param n_episodes_per_start: Number of episodes from each of them
    :param deterministic: Whether to certify the mean action or sampled actions
    :param seed: Seed of the episodes, which cannot be one that ``lyapunov`` was fitted on, or the policy trained; drawn if it
        is None, and named in the description of the report
    :return: The report
    :raises ValueError: If the arguments cannot be meant
    """
    check_questions(lyapunov, confidence, cost_bound, level, window_steps)
    check_number("n_episodes", n_episodes)
    env = prepare_evaluation(policy, env, lyapunov is not None and lyapunov.normalized_rewards)
    check_number("n_episodes_per_start", n_episodes_per_start)
    if starts is not None:
        starts = np.asarray(starts, dtype=np.float64)
        if starts.ndim != 2 or len(starts) == 0 or not np.isfinite(starts).all():
            raise ValueError(f"starts of shape {starts.shape} must be finite numbers of shape (n_starts, n_states).")
    if isinstance(lyapunov, FittedLyapunov):
        cost_bound = _chosen(cost_bound, lyapunov.ultimate_cost)
        level, window_steps = _chosen(level, lyapunov.level), window_steps or lyapunov.window_steps
    if starts is not None and cost_bound is None:
        raise ValueError("A start state is attracted if its episode ends within cost_bound: give one, or a fitted lyapunov.")
    seed = known_seed(seed)
    check_training_seeds(policy, seed, env.num_envs)
    if lyapunov is not None:
        check_seeds(lyapunov, seed, env.num_envs)
    # Asked for before the work: not every environment answers
    description = _description(policy, env, seed, deterministic)

    normalized = lyapunov is not None and lyapunov.normalized_rewards
    vec_normalize = unwrap_vec_normalize(env)
    bound = 0.0 if lyapunov is None else lyapunov.cost_bound(vec_normalize)
    of_starts = None
    with undisturbed(policy, env, seed), nullcontext() if lyapunov is None else lyapunov.in_units_of(vec_normalize):
        if starts is not None:
            _check_starts(env, starts)
            env.seed(seed)
        roll_outs = roll_out(policy, env, n_episodes, deterministic, normalized)
        if lyapunov is not None:
            roll_outs.add_values(policy, lyapunov, deterministic)
        if starts is not None:
            # Other episodes than those above
            env.seed(int(np.random.SeedSequence(seed).generate_state(1)[0] // 2))
            repeated = np.repeat(starts, n_episodes_per_start, axis=0)
            of_starts = roll_out(policy, env, len(repeated), deterministic, normalized, repeated).transitions

    transitions = roll_outs.transitions
    if cost_bound is not None:
        for rewards in [transitions["reward"]] + ([] if of_starts is None else [of_starts["reward"]]):
            check_rewards(lyapunov, rewards)
    transitions["cost"] = np.maximum(bound - transitions["reward"], 0.0)
    episodes = summarize_episodes(transitions)
    alive = ~episodes["terminated"]
    episodes["survives"] = alive.astype(float)
    if cost_bound is not None:
        episodes["stays_within"] = (alive & stay_within(episodes, cost_bound)).astype(float)
    if lyapunov is not None and level is not None and window_steps is not None:
        later = transitions.groupby("episode")["lyapunov"].shift(-window_steps)
        windows = (transitions["lyapunov"] > level) & later.notna()
        falls = (later < transitions["lyapunov"]).where(windows).groupby(transitions["episode"]).min()
        # A death is no decrease, whatever came before it
        episodes["decreases"] = falls.astype(float).where(alive, 0.0)

    import pandas as pd

    columns = [name for name in ("survives", "stays_within", "decreases") if name in episodes and episodes[name].notna().any()]
    of_each = 1 - (1 - confidence) / len(columns)
    counts = {name: (int(episodes[name].notna().sum()), int(episodes[name].sum())) for name in columns}
    statements = pd.DataFrame(
        {
            name: {"n_episodes": n, "n_true": n_true, "share": n_true / n, "at_least": exact_lower_bound(n_true, n, of_each)}
            for name, (n, n_true) in counts.items()
        }
    ).T.rename_axis("statement")
    return CertificationReport(
        statements=statements.astype({"n_episodes": int, "n_true": int}),
        transitions=transitions,
        episodes=episodes,
        starts=(
            None if of_starts is None else _attraction(of_starts, starts, n_episodes_per_start, bound, cost_bound, confidence)
        ),
        confidence=confidence,
        cost_bound=cost_bound,
        level=level,
        window_steps=window_steps,
        description=description,
    )


def check_questions(
    lyapunov: LyapunovFunction | None,
    confidence: float,
    cost_bound: float | None,
    level: float | None,
    window_steps: int | None,
) -> None:
    """Check what is asked of the episodes, see ``certify()``."""
    if lyapunov is not None:
        check_function(lyapunov)
    if not isinstance(confidence, numbers.Real) or not 0 < confidence < 1:
        raise ValueError(f"confidence={confidence!r} must be a number between 0 and 1.")
    for name, value in {"cost_bound": cost_bound, "level": level}.items():
        if value is not None and (not isinstance(value, numbers.Real) or math.isnan(value)):
            raise ValueError(f"{name}={value!r} must be a number, or None for that of a fitted function.")
    if window_steps is not None:
        check_number("window_steps", window_steps)


def _chosen(given: float | None, of_the_fit: float) -> float | None:
    if given is not None:
        return given
    return None if math.isnan(of_the_fit) else of_the_fit


def _description(policy: PolicyPredictor, env: VecEnv, seed: int, deterministic: bool) -> str:
    ids = {getattr(spec, "id", None) for spec in env_specs(env)}
    name = ids.pop() if len(ids) == 1 else None
    where = "an environment without a known id" if name is None else name
    return f"{type(policy).__name__} ({'mean' if deterministic else 'sampled'} actions) in {where}, seed {seed}"


def _check_starts(env: VecEnv, starts: np.ndarray) -> None:
    """Check that an environment starts where it is told to."""
    if len(starts) > 1:
        # Not every vector environment takes options for each of its elements
        env.set_options([{"state": starts[k % len(starts)].tolist()} for k in range(env.num_envs)])
        env.reset()
    distinct = np.unique(starts, axis=0)
    # With the same random numbers: one that differs, or from the only one what the environment does by itself. The
    # observation need not show all of the state.
    asked = [{"state": start.tolist()} for start in distinct] if len(distinct) > 1 else [{"state": starts[0].tolist()}, None]
    first = None
    for options in asked:
        env.seed(0)
        env.set_options(options)
        # Copied, for wrappers that stack frames return the same array again
        seen = flatten(env.reset())  # type: ignore[arg-type]
        first = seen if first is None else first
        if not np.array_equal(seen, first):
            break
    else:
        raise ValueError(
            "The environment starts in the same state whatever reset(options={'state': ...}) says: it needs a wrapper that "
            "puts it into the state that it is given. (If it starts in the only one of starts anyway, leave starts out.)"
        )


def _attraction(
    transitions: pd.DataFrame,
    starts: np.ndarray | None,
    n_episodes: int,
    reward_bound: float,
    cost_bound: float | None,
    confidence: float,
) -> pd.DataFrame:
    """What became of the start states."""
    import pandas as pd

    assert starts is not None and cost_bound is not None
    transitions["cost"] = np.maximum(reward_bound - transitions["reward"], 0.0)
    # Environment by environment in the order of the starts: each episode had a number of its own
    episodes = summarize_episodes(transitions)
    attracted = (~episodes["terminated"] & stay_within(episodes, cost_bound)).to_numpy()
    counts = attracted.reshape(len(starts), n_episodes).sum(axis=1)
    table = pd.DataFrame(starts, columns=[f"state_{k}" for k in range(starts.shape[1])])
    table["n_episodes"], table["n_attracted"] = n_episodes, counts
    intervals = [exact_interval(int(count), n_episodes, confidence) for count in counts]
    table[["share", "low", "high"]] = np.reshape(intervals, (-1, 3))
    return table
