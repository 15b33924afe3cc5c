"""Roll-outs of any policy as tables: one row per transition, one row per episode."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_lac.stability.functions import Observations

if TYPE_CHECKING:
    import pandas as pd

#: Steps after which an episode is suspected to have no end
MANY_STEPS = 10_000
#: Share of the cost of the starts, below which a loop is taken to rest at its goal
SETTLED_SHARE = 0.1


def combine(function: Callable[[list[np.ndarray]], np.ndarray], observations: Sequence[Observations]) -> Observations:
    """Make one batch of several observations or batches, of each key if they are dicts."""
    first = observations[0]
    if isinstance(first, dict):
        return {key: function([observation[key] for observation in observations]) for key in first}
    return function(list(observations))  # type: ignore[arg-type]


def take(observations: Observations, rows: np.ndarray | slice) -> Observations:
    """Choose some observations of a batch."""
    return combine(lambda arrays: arrays[0][rows], [observations])


def flatten(observations: Observations) -> np.ndarray:
    """Make a vector of each observation."""
    parts = [observations[key] for key in sorted(observations)] if isinstance(observations, dict) else [observations]
    return np.concatenate([np.asarray(part, dtype=np.float64).reshape(len(part), -1) for part in parts], axis=1)


@dataclass(frozen=True, eq=False)
class RollOuts:
    """Roll-outs of a policy, one episode after the other, with one observation and one action per transition."""

    #: With columns ``episode``, ``step``, ``reward``, ``truncated`` and ``terminated``
    transitions: pd.DataFrame
    observations: Observations
    actions: np.ndarray
    #: After the time limits, one per episode that was truncated, or None if none was
    last_observations: Observations | None

    def vectors(self) -> np.ndarray | None:
        """Return the observations as vectors, or None if they are dicts or images."""
        if isinstance(self.observations, dict) or self.observations.ndim > 2:
            return None
        return self.observations.reshape((len(self.observations), -1))


class _Actor:
    """Asks a policy for actions, as far as it can be asked: controllers without a memory need not know of episodes."""

    def __init__(self, policy: PolicyPredictor, env: VecEnv, deterministic: bool):
        self.policy, self.env, self.deterministic = policy, env, deterministic
        parameters = inspect.signature(policy.predict).parameters
        takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
        self._accepted = [name for name in ("state", "episode_start") if takes_all or name in parameters]
        if not takes_all and "deterministic" not in parameters:
            raise ValueError(
                f"predict() of {type(policy).__name__} must take deterministic, which asks for the mean action. A controller "
                "that knows no other ignores it: def predict(self, observation, deterministic=True)."
            )
        self.masked = "action_masks" in parameters and env.has_attr("action_masks")
        self.state: tuple[np.ndarray, ...] | None = None

    def act(self, observations: Observations, episode_start: np.ndarray) -> np.ndarray:
        """Return an action for each environment."""
        arguments: dict[str, Any] = {"state": self.state, "episode_start": episode_start}
        accepted = {name: arguments[name] for name in self._accepted}
        if self.masked:
            accepted["action_masks"] = np.stack(self.env.env_method("action_masks"))
        predicted = self.policy.predict(observations, deterministic=self.deterministic, **accepted)
        called = f"predict() of {type(self.policy).__name__} returned"
        if not isinstance(predicted, tuple) or len(predicted) != 2:
            raise ValueError(
                f"{called} {type(predicted).__name__}, and must return two things: the actions, and the state of the policy "
                "or None."
            )
        actions, self.state = np.asarray(predicted[0]), predicted[1]
        if actions.shape[:1] != (self.env.num_envs,):
            raise ValueError(
                f"{called} actions of shape {actions.shape}, and must return one for each of {self.env.num_envs} environments."
            )
        return actions


@dataclass(frozen=True, eq=False)
class _Step:
    """One step of those environments that still have episodes to finish."""

    observations: Observations
    columns: dict[str, np.ndarray]
    last_observations: list[Observations]


def _steps(actor: _Actor, targets: np.ndarray, normalized_rewards: bool) -> Iterator[_Step]:
    """Reset the environments, and let each finish so many episodes."""
    env = actor.env
    vec_normalize = None if normalized_rewards else unwrap_vec_normalize(env)
    counts, lengths = np.zeros(env.num_envs, dtype=int), np.zeros(env.num_envs, dtype=int)
    observations, beginnings, actor.state = env.reset(), np.ones(env.num_envs, dtype=bool), None
    while (counts < targets).any():
        active = np.flatnonzero(counts < targets)
        observed = take(observations, active)  # type: ignore[arg-type]
        actions = actor.act(observations, beginnings)  # type: ignore[arg-type]
        observations, rewards, dones, infos = env.step(actions)
        if vec_normalize is not None:
            rewards = vec_normalize.get_original_reward()
        truncated = dones & np.array([info.get("TimeLimit.truncated", False) for info in infos])
        columns = {"env": np.arange(env.num_envs), "action": actions, "reward": rewards, "done": dones, "truncated": truncated}
        last_observations = [infos[i]["terminal_observation"] for i in active if truncated[i]]
        yield _Step(observed, {name: column[active] for name, column in columns.items()}, last_observations)
        beginnings = dones
        counts += dones
        lengths = np.where(dones, 0, lengths + 1)
        if lengths.max() == MANY_STEPS:
            warnings.warn(
                f"An episode has gone on for {MANY_STEPS} steps. If it never ends, neither does this: give the "
                "environment a time limit, gym.wrappers.TimeLimit(env, max_episode_steps=...).",
                stacklevel=2,
            )


def _steps_from(actor: _Actor, starts: np.ndarray, normalized_rewards: bool) -> Iterator[_Step]:
    """Run one episode from each start state, as many at once as there are environments."""
    n_envs = actor.env.num_envs
    for first in range(0, len(starts), n_envs):
        # Those of the last round that are too many are started and not looked at
        chosen = np.arange(first, first + n_envs)
        of_round = starts[np.minimum(chosen, len(starts) - 1)].tolist()
        actor.env.set_options([{"state": start} for start in of_round])
        for step in _steps(actor, (chosen < len(starts)).astype(int), normalized_rewards):
            step.columns["env"] += first
            yield step


def roll_out(
    policy: PolicyPredictor,
    env: VecEnv,
    episodes: int | np.ndarray,
    deterministic: bool,
    normalized_rewards: bool,
) -> RollOuts:
    """Run the policy for so many episodes, divided as in ``evaluate_policy()``, or for one from each of some start states."""
    import pandas as pd  # slow to import, and only an evaluation needs it

    actor = _Actor(policy, env, deterministic)
    if not isinstance(episodes, np.ndarray):
        targets = np.array([(episodes + i) // env.num_envs for i in range(env.num_envs)])
        steps = list(_steps(actor, targets, normalized_rewards))
    else:
        steps = list(_steps_from(actor, episodes, normalized_rewards))

    columns = {name: np.concatenate([step.columns[name] for step in steps]) for name in steps[0].columns}
    actions = columns.pop("action")
    transitions = pd.DataFrame(columns)
    if not np.isfinite(transitions["reward"]).all():
        raise ValueError("The environment paid a reward that is not finite: its costs cannot be judged.")
    transitions["reward"] = transitions["reward"].astype(np.float64)
    observations = combine(np.concatenate, [step.observations for step in steps])
    last = [observation for step in steps for observation in step.last_observations]
    for observed in [observations, *last]:
        if any(np.isnan(array).any() for array in (observed.values() if isinstance(observed, dict) else [observed])):
            raise ValueError("The environment showed an observation that is NaN: nothing can be said of what follows it.")
    last_of = transitions.loc[transitions["truncated"], "env"].to_numpy()
    # From the order of time to one episode after the other
    order = np.argsort(transitions["env"], kind="stable")
    transitions = transitions.iloc[order].reset_index(drop=True)
    dones = transitions.pop("done").to_numpy()
    transitions["episode"] = np.cumsum(dones) - dones
    transitions["step"] = transitions.groupby("episode").cumcount()
    transitions["terminated"] = dones & ~transitions["truncated"]
    return RollOuts(
        transitions,
        take(observations, order),
        actions[order],
        take(combine(np.stack, last), np.argsort(last_of, kind="stable")) if last else None,
    )


def fifths_left(transitions: pd.DataFrame) -> pd.Series:
    """Count how many fifths of its episode follow that of each transition: none in the last one, which is called late."""
    length = transitions.groupby("episode")["step"].transform("size")
    return (length - transitions["step"] - 1) // np.maximum(length // 5, 1)


def mean_reward(transitions: pd.DataFrame) -> float:
    """Return the mean over episodes of the sum of their rewards."""
    return float(transitions["reward"].sum() / transitions["episode"].nunique())


def where_it_rests(late_cost: float, start_cost: float) -> str:
    """Say at which share of the cost of the starts a loop rests, and ask whether that is the goal."""
    share = late_cost / start_cost
    return f"rests at {100 * share:.3g} % of the start's cost{': beside the goal?' if share >= SETTLED_SHARE else '.'}"


def summarize_episodes(transitions: pd.DataFrame) -> pd.DataFrame:
    """Summarize each episode."""
    import pandas as pd

    groups, left = transitions.groupby("episode"), fifths_left(transitions)
    means = transitions["cost"].groupby([transitions["episode"], left]).mean().unstack().reindex(columns=range(4))
    return pd.DataFrame(
        {
            "length": groups.size(),
            "total_cost": groups["cost"].sum(),
            "final_cost": groups["cost"].last(),
            "largest_late_cost": transitions["cost"].where(left == 0).groupby(transitions["episode"]).max(),
            "late_cost": means[0],
            # A cost that goes up and down, as that of a moving goal, has been as high before
            "late_rise": means[0] - means[[1, 2, 3]].max(axis=1),
            "terminated": groups["terminated"].any(),
        }
    )
