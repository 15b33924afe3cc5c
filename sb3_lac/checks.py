"""What is refused, and what is warned of, in arguments, environments and samples."""

import math
import warnings
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac.buffers import Samples


def check_arguments(model: Any) -> None:
    """Check the arguments of an algorithm for costs that SAC does not have."""
    needed = model.policy_aliases["MlpPolicy"]
    critics = [getattr(policy, "critic_class", object) for policy in (model.policy_class, needed)]
    if not (issubclass(model.policy_class, needed) and issubclass(*critics)):
        named = model.policy_class.__name__
        raise ValueError(f"{type(model).__name__} needs a policy derived from {needed.__name__}, and this is {named}.")
    with np.errstate(over="ignore"):
        ranges = model.action_space.high - model.action_space.low
    if not (ranges > 0).all():
        raise ValueError(f"The bounds of {model.action_space} must differ: leave out the actions that cannot be chosen.")
    if not np.isfinite(ranges).all():
        raise ValueError(
            f"The bounds of {model.action_space} are so far apart that their difference, which actions are scaled by, is "
            "infinite. State those of the actions that are of use, for instance with gymnasium.wrappers.TransformAction("
            "env, lambda action: action, gymnasium.spaces.Box(-10, 10, env.action_space.shape))."
        )
    if not 0 <= model.gamma <= 1:
        raise ValueError(f"gamma={model.gamma} must lie within 0 .. 1.")
    if not 0 < model.alpha3 < math.inf:
        raise ValueError(f"alpha3={model.alpha3} must be greater than 0, and finite.")
    lambda_max = model.lambda_init if model.lambda_max is None else model.lambda_max
    if not 0 < model.lambda_min <= lambda_max < math.inf or not 0 < model.lambda_init < math.inf:
        limits = f"lambda_min={model.lambda_min}, lambda_init={model.lambda_init} and lambda_max={model.lambda_max}"
        raise ValueError(f"{limits} must be greater than 0 and finite, and the least of them lambda_min.")
    if model.lambda_learning_rate is not None:
        check_rate("lambda_learning_rate", model.lambda_learning_rate)
    if not 0 <= (model.reward_bound or 0.0) < math.inf:
        raise ValueError(f"reward_bound={model.reward_bound} must be finite and at least 0, what a termination pays.")
    if model.reward_bound and model.n_costs == math.inf:
        raise ValueError(
            f"gamma={model.gamma} must be smaller than 1 with rewards up to {model.reward_bound}: each step below that has "
            "a cost, and the sum over all time is infinite. Use for instance gamma=0.99."
        )


def check_rate(name: str, rate: float | Schedule) -> None:
    """Refuse a learning rate of one's own: optimizers only check the one that they are made with, ``learning_rate``."""
    if not 0 <= FloatSchedule(rate)(1) < math.inf:
        raise ValueError(f"{name}={rate} must start at a finite rate of at least 0.")


def refuse_what_spoils_weights(name: str, value: Any, step: int, vec_normalize: VecNormalize | None = None) -> None:
    """Raise a ``ValueError`` that names the number, if it is not finite, or has a square that float32 cannot hold."""
    if isinstance(value, dict):
        for key, part in value.items():
            refuse_what_spoils_weights(f"{name} {key!r}", part, step, vec_normalize)
        return
    numbers = np.asarray(value)
    with np.errstate(over="ignore"):
        sound = (
            np.isfinite(np.square(numbers, dtype=np.float32, casting="same_kind")) if numbers.dtype.kind == "f" else np.True_
        )
    if sound.all():
        return
    remedy, normalized = "Clip or replace it in a wrapper of the environment.", "norm_reward"
    if "observation" in name:
        remedy += " A features extractor that handles such numbers needs check_observations=False."
        normalized = "norm_obs"
    if vec_normalize is not None and vec_normalize.training and getattr(vec_normalize, normalized):
        remedy += " The statistics of VecNormalize have it already: begin with new ones, or with those of an earlier file."
    raise ValueError(
        f"The {name} {numbers[~sound].ravel()[0]!s} at step {step}: all must be finite, and within +-1.8e19, whose square "
        f"float32 holds. {remedy}"
    )


def refuse_samples(replay_data: Samples, step: int, check_observations: bool) -> None:
    """Refuse such samples: rewards may be computed only then (HER), and a buffer may have been filled elsewhere."""
    names = ("actions", "rewards", "observations", "next_observations") if check_observations else ("actions", "rewards")
    named = [(name, getattr(replay_data, name)) for name in names]
    parts = [(name, part) for name, each in named for part in (each.values() if isinstance(each, dict) else [each])]
    # One question for all: a sum of squares is finite only where all of them are
    if not math.isfinite(sum(part.float().square().sum() for _, part in parts if part.is_floating_point())):
        for name, part in parts:
            refuse_what_spoils_weights(f"replay buffer gave {name} with", part.numpy(force=True), step)


def spaces_of(replay_buffer: Any) -> list[spaces.Space]:
    """The spaces of what a replay buffer stores, if it says them."""
    return [getattr(replay_buffer, name) for name in ("observation_space", "action_space") if hasattr(replay_buffer, name)]


def form_of(space: spaces.Space) -> Any:
    """Return what all arrays of a space share: whatever its limits, those of a box have one shape and one kind of numbers."""
    if isinstance(space, spaces.Dict):
        return {name: form_of(part) for name, part in space.spaces.items()}
    return (space.shape, space.dtype.kind) if isinstance(space, spaces.Box) else space


def warn_of_free_terminations(replay_buffer: ReplayBuffer | None, n_costs: float) -> None:
    """Warn if, in what is stored, the last step before a termination costs no more than another step does."""
    # A time limit is no termination, and some buffers cannot tell
    if not isinstance(replay_buffer, ReplayBuffer) or not replay_buffer.handle_timeout_termination:
        return
    # From the oldest step on
    stored = (np.arange(replay_buffer.size()) + (replay_buffer.pos if replay_buffer.full else 0)) % replay_buffer.buffer_size
    costs, dones = 0.0 - replay_buffer.rewards[stored], replay_buffer.dones[stored] > 0
    ends = dones & (replay_buffer.timeouts[stored] == 0)
    if not ends.any() or ends.all():
        return
    running, last = costs[~ends], costs[ends].mean()
    price = running.mean() * n_costs
    # An end that costs less than any other step is a goal
    if running.min() <= last <= running.max() and price > 0:
        # Of a buffer that is full the first episodes have lost their first steps
        lengths = [np.diff(np.flatnonzero(column), prepend=-1)[int(replay_buffer.full) :] for column in dones.T]
        advice = advice_for_a_time_limit(np.concatenate(lengths)) or (
            "Where the end is the goal, all is well. Where it is a failure, to fail early is the cheapest policy of any "
            "algorithm: give the last step a cost of its own, above that of going on, here about "
            f"{price:.3g} (what L is where each step has the mean cost)."
        )
        warnings.warn(
            f"The last step before a termination costs {last:.3g} on average, no more than another step does (up to "
            f"{running.max():.3g}). {advice}",
            stacklevel=3,
        )


def advice_for_a_time_limit(lengths: np.ndarray) -> str:
    """Say what terminations of episodes of so many steps look like, if they are all alike, and otherwise nothing."""
    if len(set(lengths)) != 1:
        return ""
    advice = (
        f"All episodes that ended ({len(lengths)}) have {lengths[0]} steps, as with a time limit. If it is one, return "
        "truncated=True at its end and not terminated=True, as gymnasium.wrappers.TimeLimit(env, max_episode_steps=...) does: "
        "nothing has to be paid where the plant would go on."
    )
    return advice if len(lengths) > 1 else f"{advice} If it is a failure, its last step has to cost more than going on."
