"""Roll-outs of any policy as tables: one row per transition with ``L``, one row per episode."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_lac.stability.functions import LyapunovFunction, Observations

if TYPE_CHECKING:
    import pandas as pd

#: Transitions whose ``L`` is computed at once
CHUNK_SIZE = 2048
#: Steps after which an episode is suspected to have no end
MANY_STEPS = 10_000


def prepare_evaluation(policy: PolicyPredictor, env: gym.Env | VecEnv, of_the_critic: bool) -> VecEnv:
    """Wrap an evaluation environment as the policy would, and check that they fit together."""
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise ValueError(f"{policy!r} has no method predict(observation, deterministic=...), which every policy needs.")
    check_environment(env)
    if not isinstance(policy, (BaseAlgorithm, BasePolicy)):
        # A controller that knows nothing of images and their channels
        return env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])  # type: ignore[list-item, return-value]
    env = BaseAlgorithm._wrap_env(env, monitor_wrapper=False)
    check_for_correct_spaces(env, policy.observation_space, policy.action_space)
    # A model that was loaded without an environment does not know what it was trained with
    if isinstance(policy, BaseAlgorithm) and policy.get_env() is not None:
        normalized = normalization(unwrap_vec_normalize(env), of_the_critic)
        expected = normalization(policy.get_vec_normalize_env(), of_the_critic)
        if normalized != expected:
            raise ValueError(
                f"The evaluation environment has {normalized}, but the training environment has {expected}: "
                "policy and L would get numbers that they were not trained on. Wrap the evaluation environment "
                "with VecNormalize in the same way, and synchronize its statistics with sync_envs_normalization()."
            )
        if trains_on(policy, env):
            raise ValueError(
                f"The evaluation environment is the training environment: {type(policy).__name__} would go on with an "
                "observation of before the evaluation. Make a second environment for the evaluation."
            )
    return env


def check_environment(env: object) -> None:
    """"""
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(f"{env} is a vector environment of Gymnasium: pass sb3_lac.GymnasiumVecEnv(env).")
    if not isinstance(env, (gym.Env, VecEnv)):
        raise ValueError(f"env={env!r} is no environment: pass that of gym.make(id), or a VecEnv.")


def check_number(name: str, value: int) -> None:
    """"""
    if not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name}={value!r} must be at least 1, and a whole number.")


def known_seed(seed: int | None) -> int:
    """The seed of roll-outs, so that others can be told from them, and so that they can be made again."""
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1)[0] // 2)
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} must be a whole number of at least 0, or None for a random one.")
    return int(seed)


def check_seeds(lyapunov: LyapunovFunction, seed: int, n_envs: int) -> None:
    """Refuse to judge a function on the roll-outs that it was fitted on."""
    if lyapunov.seeds is None:
        return
    if seed < lyapunov.seeds.stop and lyapunov.seeds.start < seed + n_envs:
        raise ValueError(
            f"seed={seed} with {n_envs} environments starts episodes that the Lyapunov function was fitted on (seeds "
            f"{lyapunov.seeds.start} to {lyapunov.seeds.stop - 1}): it would be judged on its own training data. Use another "
            f"seed, from {lyapunov.seeds.stop} on."
        )


def check_training_seeds(policy: PolicyPredictor, seed: int, n_envs: int) -> None:
    """Refuse exact statements of the episodes that a policy was trained on: those of equal seeds begin alike."""
    if not isinstance(policy, BaseAlgorithm) or policy.seed is None:
        return
    if seed < policy.seed + policy.n_envs and policy.seed < seed + n_envs:
        raise ValueError(
            f"seed={seed} with {n_envs} environments starts episodes that {type(policy).__name__} was trained on (seeds "
            f"{policy.seed} to {policy.seed + policy.n_envs - 1}): they say nothing about others. Use another seed, from "
            f"{policy.seed + policy.n_envs} on."
        )


def trains_on(model: BaseAlgorithm, env: VecEnv) -> bool:
    """Whether a model collects its training data in an environment, or in one of those that it consists of."""
    training_env = model.get_env()
    if training_env is None:
        return False
    if env.unwrapped is training_env.unwrapped:
        return True
    first, second = (
        {id(single.unwrapped) for single in getattr(vec_env.unwrapped, "envs", [])} for vec_env in (env, training_env)
    )
    return not first.isdisjoint(second)


def normalization(vec_normalize: VecNormalize | None, with_rewards: bool) -> str:
    """What a ``VecNormalize`` wrapper normalizes."""
    if vec_normalize is None or not (vec_normalize.norm_obs or (with_rewards and vec_normalize.norm_reward)):
        return "no normalization"
    return f"norm_obs={vec_normalize.norm_obs}" + (f" and norm_reward={vec_normalize.norm_reward}" if with_rewards else "")


@contextmanager
def undisturbed(policy: PolicyPredictor, env: VecEnv, seed: int) -> Iterator[None]:
    """
    Let a training go on after an evaluation as if there had been none: its random numbers and its normalization.
    """
    vec_normalize = unwrap_vec_normalize(env)
    env.seed(seed)
    device = str(getattr(policy, "device", "cpu"))
    with th.random.fork_rng(devices=[device] if device.startswith("cuda") else []):
        th.manual_seed(seed)
        # DQN explores with these two
        numpy_state = np.random.get_state()
        np.random.seed(seed % 2**32)
        action_space: Any = getattr(policy, "action_space", None)
        if isinstance(policy, (BaseAlgorithm, BasePolicy)):
            policy.action_space = deepcopy(action_space)
            policy.action_space.seed(seed)
        training = vec_normalize is not None and vec_normalize.training
        try:
            # All costs have the same units
            if vec_normalize is not None:
                vec_normalize.training = False
            yield
        finally:
            if vec_normalize is not None:
                vec_normalize.training = training
            if isinstance(policy, (BaseAlgorithm, BasePolicy)):
                policy.action_space = action_space
            np.random.set_state(numpy_state)


def combine(function: Callable[[list[np.ndarray]], np.ndarray], observations: Sequence[Observations]) -> Observations:
    """Make one batch of several observations or batches, of each key if they are dicts."""
    first = observations[0]
    if isinstance(first, dict):
        return {key: function([observation[key] for observation in observations]) for key in first}
    return function(list(observations))  # type: ignore[arg-type]


def take(observations: Observations, rows: np.ndarray | slice) -> Observations:
    """Choose some observations of a batch."""
    return combine(lambda arrays: arrays[0][rows], [observations])


@dataclass(frozen=True, eq=False)
class RollOuts:
    """
    What a policy did, one episode after the other.

    :param transitions: One row per transition with ``episode``, ``step``, ``reward``, ``truncated`` and ``terminated``
    :param observations: In which the actions were taken
    :param actions: One per transition
    :param last_observations: After the time limits, one per episode that was truncated, or None if none was
    """

    transitions: pd.DataFrame
    observations: Observations
    actions: np.ndarray
    last_observations: Observations | None

    def vectors(self) -> np.ndarray | None:
        """"""
        if isinstance(self.observations, dict) or self.observations.ndim > 2:
            return None
        return self.observations.reshape((len(self.observations), -1))

    def add_values(self, policy: PolicyPredictor, lyapunov: LyapunovFunction, deterministic: bool) -> None:
        """Add the columns ``lyapunov`` and ``next_lyapunov`` to the transitions."""
        # Few passes of a network, but not one huge tensor
        rows = [slice(start, start + CHUNK_SIZE) for start in range(0, len(self.actions), CHUNK_SIZE)]
        values = [lyapunov.values_of_actions(take(self.observations, chunk), self.actions[chunk]) for chunk in rows]
        transitions = self.transitions
        transitions["lyapunov"] = np.concatenate(values, dtype=np.float64)
        # A terminal state has no value
        done = (transitions["truncated"] | transitions["terminated"]).to_numpy()
        transitions["next_lyapunov"] = transitions["lyapunov"].shift(-1).where(~done, np.nan)
        if self.last_observations is not None:
            if lyapunov.of_actions:
                last_actions, _ = policy.predict(self.last_observations, deterministic=deterministic)
                last_values = lyapunov.values_of_actions(self.last_observations, last_actions)
            else:  # a policy with a memory cannot be asked for actions of other times
                last_values = lyapunov.values(self.last_observations)
            transitions.loc[transitions["truncated"], "next_lyapunov"] = np.asarray(last_values, dtype=np.float64)


def _what_it_asks_for(policy: PolicyPredictor, env: VecEnv) -> list[str]:
    """What ``predict`` takes beside observations: controllers without a memory need not know of episodes."""
    parameters = inspect.signature(policy.predict).parameters
    takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    asked = [name for name in ("state", "episode_start") if takes_all or name in parameters]
    return [*asked, "action_masks"] if "action_masks" in parameters and env.has_attr("action_masks") else asked


def roll_out(
    policy: PolicyPredictor,
    env: VecEnv,
    n_eval_episodes: int,
    deterministic: bool,
    normalized_rewards: bool = False,
    starts: np.ndarray | None = None,
) -> RollOuts:
    """Run the policy."""
    import pandas as pd  # slow to import, and only an evaluation needs it

    vec_normalize = None if normalized_rewards else unwrap_vec_normalize(env)
    asks_for = _what_it_asks_for(policy, env)
    n_envs = env.num_envs
    n_rounds = 1 if starts is None else -(-n_eval_episodes // n_envs)
    batches: list[Observations] = []
    steps: list[dict[str, np.ndarray]] = []
    last_observations: list[Observations] = []
    for number in range(n_rounds):
        if starts is None:
            # As in ``evaluate_policy()``
            targets = np.array([(n_eval_episodes + i) // n_envs for i in range(n_envs)])
        else:
            # Those of the last round that are too many are started and not looked at
            chosen = np.arange(number * n_envs, (number + 1) * n_envs)
            targets = (chosen < n_eval_episodes).astype(int)
            of_round = starts[np.minimum(chosen, n_eval_episodes - 1)].tolist()
            env.set_options([{"state": start} for start in of_round])
        counts = np.zeros(n_envs, dtype=int)
        observations = env.reset()
        state: tuple[np.ndarray, ...] | None = None
        beginnings = np.ones(n_envs, dtype=bool)
        lengths = np.zeros(n_envs, dtype=int)
        while (counts < targets).any():
            known = {"state": state, "episode_start": beginnings}
            if "action_masks" in asks_for:
                known["action_masks"] = np.stack(env.env_method("action_masks"))
            given = {name: known[name] for name in asks_for}
            predicted = policy.predict(observations, deterministic=deterministic, **given)  # type: ignore[arg-type]
            if not isinstance(predicted, tuple) or len(predicted) != 2:
                raise ValueError(
                    f"predict() of {type(policy).__name__} returned {type(predicted).__name__}, and must return two things: "
                    "the actions, and the state of the policy or None."
                )
            actions, state = np.asarray(predicted[0]), predicted[1]
            if actions.shape[:1] != (n_envs,):
                raise ValueError(
                    f"predict() of {type(policy).__name__} returned actions of shape {actions.shape}, and must return one for "
                    f"each of {n_envs} environments."
                )
            new_observations, rewards, dones, infos = env.step(actions)
            if vec_normalize is not None:
                rewards = vec_normalize.get_original_reward()
            active = np.flatnonzero(counts < targets)
            truncated = dones & np.array([info.get("TimeLimit.truncated", False) for info in infos])
            batches.append(take(observations, active))  # type: ignore[arg-type]
            columns = {"action": actions, "reward": rewards, "done": dones, "truncated": truncated}
            steps.append({"env": number * n_envs + active, **{name: column[active] for name, column in columns.items()}})
            last_observations += [infos[i]["terminal_observation"] for i in active if truncated[i]]
            counts += dones
            lengths = np.where(dones, 0, lengths + 1)
            if lengths.max() == MANY_STEPS:
                warnings.warn(
                    f"An episode has gone on for {MANY_STEPS} steps. If it never ends, neither does this: give the "
                    "environment a time limit, gym.wrappers.TimeLimit(env, max_episode_steps=...).",
                    stacklevel=2,
                )
            beginnings, observations = dones, new_observations

    all_actions = np.concatenate([step.pop("action") for step in steps])
    transitions = pd.DataFrame({name: np.concatenate([step[name] for step in steps]) for name in steps[0]})
    if not np.isfinite(transitions["reward"]).all():
        raise ValueError("The environment paid a reward that is not finite: its costs cannot be judged.")
    transitions["reward"] = transitions["reward"].astype(np.float64)
    seen = combine(np.concatenate, batches)
    for observed in [seen, *last_observations]:
        if any(np.isnan(array).any() for array in (observed.values() if isinstance(observed, dict) else [observed])):
            raise ValueError("The environment showed an observation that is NaN: nothing can be said of what follows it.")
    last_of = transitions.loc[transitions["truncated"], "env"].to_numpy()
    # From the order of time to one episode after the other
    order = np.argsort(transitions["env"], kind="stable")
    transitions = transitions.iloc[order].reset_index(drop=True)
    done = transitions.pop("done").to_numpy()
    transitions["episode"] = np.cumsum(done) - done
    transitions["step"] = transitions.groupby("episode").cumcount()
    transitions["terminated"] = done & ~transitions["truncated"]
    return RollOuts(
        transitions,
        take(seen, order),
        all_actions[order],
        take(combine(np.stack, last_observations), np.argsort(last_of, kind="stable")) if last_observations else None,
    )


def relative_cost_to_go(transitions: pd.DataFrame, average_cost: float) -> np.ndarray:
    """
    What a function of the average cost estimates, of one roll-out: the sum of the costs to come beyond the average one. What
    follows a time limit is the value of the function there, and so only the first half of each episode is looked at.
    """
    groups = transitions.groupby("episode")
    excess = (transitions["cost"] - average_cost)[::-1]
    to_come = excess.groupby(transitions["episode"][::-1]).cumsum()[::-1]
    seen = ~groups["terminated"].transform("any") & (2 * transitions["step"] < groups["step"].transform("size"))
    return (to_come + groups["next_lyapunov"].transform("last")).where(seen, np.nan).to_numpy()


def cost_to_go(
    transitions: pd.DataFrame, gamma: float, horizon: int | None, max_tail_weight: float, bound: float
) -> np.ndarray:
    """
    What ``L`` estimates, of one roll-out: the discounted sum of the costs to come (in the next ``horizon`` steps).
    After a termination nothing is paid any more, while the costs after a time limit are not seen.
    """
    from scipy.signal import lfilter  # slow to import, and only an evaluation needs it

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
    if bound > 0 and horizon is None and gamma >= 1:
        return np.where(seen & ~terminated, sums, np.nan)
    if bound > 0:
        # Of the steps from now on, those after the termination
        passed = remaining if horizon is None else np.minimum(remaining, horizon)
        weights = np.append(0.0, np.cumsum(gamma ** np.arange(lengths.max())))
        sums = sums + terminated * bound * (1 / (1 - gamma) - weights[passed])
    return np.where(seen | terminated, sums, np.nan)


def summarize_episodes(transitions: pd.DataFrame) -> pd.DataFrame:
    """Summarize each episode."""
    import pandas as pd

    groups = transitions.groupby("episode")
    length = groups["step"].transform("size")
    n_late = np.maximum(length // 5, 1)
    fifths_left = (length - transitions["step"] - 1) // n_late
    means = transitions["cost"].groupby([transitions["episode"], fifths_left]).mean().unstack().reindex(columns=range(4))
    return pd.DataFrame(
        {
            "length": groups.size(),
            "total_cost": groups["cost"].sum(),
            "final_cost": groups["cost"].last(),
            "largest_late_cost": transitions["cost"].where(fifths_left == 0).groupby(transitions["episode"]).max(),
            "late_cost": means[0],
            # A cost that goes up and down, as that of a moving goal, has been as high before
            "late_rise": means[0] - means[[1, 2, 3]].max(axis=1),
            "terminated": groups["terminated"].any(),
        }
    )


def stay_within(episodes: pd.DataFrame, cost_bound: float) -> pd.Series:
    """
    Whether the last fifth of each episode costs no more than a bound. It is a comparison in single precision, in which some
    vector environments hold rewards: there a cost of 0.1 is a little more than 0.1.
    """
    return episodes["largest_late_cost"].astype(np.float32) <= np.float32(cost_bound)
