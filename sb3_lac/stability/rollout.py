"""Roll-outs of a policy as tables: one row per transition with ``L``, one row per episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_lac.lac import LAC, sum_of_discounts

if TYPE_CHECKING:
    import pandas as pd

Observations = np.ndarray | dict[str, np.ndarray]

#: Transitions whose ``L`` is computed at once
CHUNK_SIZE = 2048


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
    # Slow to import like scipy below, and only an evaluation needs them
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
