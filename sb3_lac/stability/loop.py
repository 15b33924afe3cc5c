"""The one door to the roll-outs of a policy: what is asked is checked, seeds are kept apart, a training is not disturbed."""

from __future__ import annotations

import functools
import inspect
import random
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
)

from sb3_lac.stability.functions import LyapunovFunction
from sb3_lac.stability.rollout import RollOuts, roll_out, take
from sb3_lac.vec_env import env_specs

if TYPE_CHECKING:
    import pandas as pd

#: Transitions whose ``L`` is computed at once
CHUNK_SIZE = 2048

Function = TypeVar("Function", bound=Callable[..., Any])


def by_keyword(function: Function) -> Function:
    """Accept keyword-only arguments, in the order of their old places, by places and names of 0.6 too, with a warning."""
    parameters = inspect.signature(function).parameters.values()
    names = [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]
    n_places = len(parameters) - len(names)

    @functools.wraps(function)
    def of_both_forms(*arguments: Any, **named: Any) -> Any:
        old = dict(zip(names, arguments[n_places:], strict=False))
        if "n_eval_episodes" in named:
            old["n_episodes"] = named.pop("n_eval_episodes")
        if old:
            written = ", ".join(f"{name}=..." for name in old)
            warnings.warn(
                f"{function.__qualname__}: write {written}. Another name, or none, is an error from 0.8 on.",
                DeprecationWarning,
                stacklevel=2,
            )
        # What is one too many stays where it is, and is refused
        return function(*arguments[:n_places], *arguments[n_places + len(names) :], **old, **named)

    return of_both_forms  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A policy in an environment as it sees it, ready to be rolled out, and the function whose values are of interest."""

    policy: PolicyPredictor
    env: VecEnv
    lyapunov: LyapunovFunction | None
    #: The reward that costs nothing, in the units of the rewards that are judged
    reward_bound: float
    #: Whether the loop is that of the mean action
    deterministic: bool
    #: Of the first environment; the second one has the next one
    seed: int

    @property
    def seeds(self) -> range:
        """Seeds of the environments."""
        return range(self.seed, self.seed + self.env.num_envs)

    @property
    def description(self) -> str:
        """The policy, the environment and the seed."""
        ids = {getattr(spec, "id", None) for spec in env_specs(self.env)}
        name = ids.pop() if len(ids) == 1 else None
        where = "an environment without a known id" if name is None else name
        actions = "mean" if self.deterministic else "sampled"
        return f"{type(self.policy).__name__} ({actions} actions) in {where}, seed {self.seed}"

    def roll_out(self, episodes: int | np.ndarray, with_values: bool = True) -> RollOuts:
        """Run the policy for so many episodes, or for one from each start state, and add costs and values of the function."""
        normalized = self.lyapunov is not None and self.lyapunov.normalized_rewards
        roll_outs = roll_out(self.policy, self.env, episodes, self.deterministic, normalized)
        # A reward above all those of the training would have a negative cost, which L cannot learn
        roll_outs.transitions["cost"] = np.maximum(self.reward_bound - roll_outs.transitions["reward"], 0.0)
        if with_values and self.lyapunov is not None:
            self._add_values(roll_outs, self.lyapunov)
        return roll_outs

    def _add_values(self, roll_outs: RollOuts, lyapunov: LyapunovFunction) -> None:
        # Few passes of a network, but not one huge tensor
        rows = [slice(start, start + CHUNK_SIZE) for start in range(0, len(roll_outs.actions), CHUNK_SIZE)]
        observations, actions, transitions = roll_outs.observations, roll_outs.actions, roll_outs.transitions
        values = [lyapunov.values_of_actions(take(observations, chunk), actions[chunk]) for chunk in rows]
        transitions["lyapunov"] = np.concatenate(values, dtype=np.float64)
        # A terminal state has no value
        ends = (transitions["truncated"] | transitions["terminated"]).to_numpy()
        transitions["next_lyapunov"] = transitions["lyapunov"].shift(-1).where(~ends, np.nan)
        if roll_outs.last_observations is not None:
            if lyapunov.of_actions:
                last_actions, _ = self.policy.predict(roll_outs.last_observations, deterministic=self.deterministic)
                last_values = lyapunov.values_of_actions(roll_outs.last_observations, last_actions)
            else:  # a policy with a memory cannot be asked for actions of other times
                last_values = lyapunov.values(roll_outs.last_observations)
            transitions.loc[transitions["truncated"], "next_lyapunov"] = np.asarray(last_values, dtype=np.float64)

    def check_costs(self, rewards: pd.Series) -> None:
        """Refuse positive rewards if it is not known which reward costs nothing."""
        if rewards.max() > 0 and (self.lyapunov is None or self.lyapunov.reward_bound is None):
            raise ValueError(
                f"A reward of {rewards.max():g} is positive, and it is not known which reward costs nothing: pass "
                "LyapunovFunction(..., reward_bound=...) or that of fit_lyapunov(policy, env)."
            )


@contextmanager
def closed_loop(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    lyapunov: LyapunovFunction | None,
    n_episodes: int,
    deterministic: bool = True,
    seed: int | None = None,
) -> Iterator[ClosedLoop]:
    """Check what everyone asks, draw a seed if there is none, and leave the policy and its environment as they were."""
    if not isinstance(n_episodes, (int, np.integer)) or n_episodes < 1:
        raise ValueError(f"The number of episodes must be a whole number of at least 1, and not {n_episodes!r}.")
    if lyapunov is not None and not isinstance(lyapunov, LyapunovFunction):
        raise ValueError(
            "lyapunov must be a LyapunovFunction: that of fit_lyapunov(policy, env), or LyapunovFunction(function) for a "
            f"function of observations. This is {lyapunov!r}."
        )
    vec_env = _evaluation_env(policy, env, lyapunov is not None and lyapunov.normalized_rewards)
    if seed is None:
        # Known, so that others can be told from it, and the roll-outs made again
        seed = int(np.random.SeedSequence().generate_state(1)[0] // 2)
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} must be a whole number of at least 0, or None for a random one.")
    seed = int(seed)
    seeds = range(seed, seed + vec_env.num_envs)
    fitted = None if lyapunov is None else lyapunov.seeds
    if fitted is not None and seeds.start < fitted.stop and fitted.start < seeds.stop:
        raise ValueError(
            f"seed={seed} with {len(seeds)} environments starts episodes that the Lyapunov function was fitted on (seeds "
            f"{fitted.start} to {fitted.stop - 1}): they say nothing about others. Use another seed, from {fitted.stop} on."
        )
    units = nullcontext(0.0) if lyapunov is None else lyapunov.in_units_of(unwrap_vec_normalize(vec_env))
    with _undisturbed(policy, vec_env, seed), units as reward_bound:
        yield ClosedLoop(policy, vec_env, lyapunov, reward_bound, deterministic, seed)


def _evaluation_env(policy: PolicyPredictor, env: gym.Env | VecEnv, with_rewards: bool) -> VecEnv:
    """Wrap an environment as the policy would, and check that they fit together."""
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise ValueError(f"Every policy needs a method predict(observation, deterministic=...). None has this: {policy!r}.")
    vec_env = vectorized(env)
    if not isinstance(policy, (BaseAlgorithm, BasePolicy)):
        # A controller that knows nothing of images and their channels
        return vec_env
    space = vec_env.observation_space
    parts: list[Any] = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    channels_last = any(is_image_space(part) and not is_image_space_channels_first(part) for part in parts)
    if channels_last and not is_vecenv_wrapped(vec_env, VecTransposeImage):
        vec_env = VecTransposeImage(vec_env)
    check_for_correct_spaces(vec_env, policy.observation_space, policy.action_space)
    training_env = policy.get_env() if isinstance(policy, BaseAlgorithm) else None
    # A model that was loaded without an environment does not know what it was trained with
    if training_env is not None:
        normalized = _normalization(unwrap_vec_normalize(vec_env), with_rewards)
        expected = _normalization(unwrap_vec_normalize(training_env), with_rewards)
        if normalized != expected:
            raise ValueError(
                f"The evaluation environment has {normalized}, but the training environment has {expected}: "
                "policy and L would get numbers that they were not trained on. Wrap the evaluation environment "
                "with VecNormalize in the same way, and synchronize its statistics with sync_envs_normalization()."
            )
        if _share_environments(vec_env, training_env):
            raise ValueError(
                "The evaluation environment is the training environment, whose episodes an evaluation would end: make a "
                "second one."
            )
    return vec_env


def vectorized(env: gym.Env | VecEnv) -> VecEnv:
    """Make a vector environment of any environment."""
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(f"{env} is a vector environment of Gymnasium: pass sb3_lac.GymnasiumVecEnv(env).")
    if not isinstance(env, (gym.Env, VecEnv)):
        raise ValueError(f"env={env!r} is no environment: pass that of gym.make(id), or a VecEnv.")
    return env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])


def _share_environments(env: VecEnv, eval_env: VecEnv) -> bool:
    """Tell whether two environments are one, or have a single one in common."""
    if env.unwrapped is eval_env.unwrapped:
        return True
    # Those of a vector environment of somebody else may be anything
    inner = [getattr(each.unwrapped, "envs", []) for each in (env, eval_env)]
    singles = [{id(getattr(single, "unwrapped", single)) for single in envs} for envs in inner]
    return not singles[0].isdisjoint(singles[1])


def _normalization(vec_normalize: VecNormalize | None, with_rewards: bool) -> str:
    """Say what a ``VecNormalize`` wrapper normalizes."""
    if vec_normalize is None or not (vec_normalize.norm_obs or (with_rewards and vec_normalize.norm_reward)):
        return "no normalization"
    return f"norm_obs={vec_normalize.norm_obs}" + (f" and norm_reward={vec_normalize.norm_reward}" if with_rewards else "")


@contextmanager
def _undisturbed(policy: PolicyPredictor, env: VecEnv, seed: int) -> Iterator[None]:
    """Let a training go on after an evaluation as if there had been none: its random numbers and its normalization."""
    vec_normalize = unwrap_vec_normalize(env)
    env.seed(seed)
    device = str(getattr(policy, "device", "cpu"))
    with th.random.fork_rng(devices=[device] if device.startswith("cuda") else []):
        th.manual_seed(seed)
        # Environments may draw from these two, and DQN explores with the second
        python_state, numpy_state = random.getstate(), np.random.get_state()
        random.seed(seed)
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
            random.setstate(python_state)
            np.random.set_state(numpy_state)
