"""Learns a Lyapunov function on the roll-outs of any policy."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_lac.files import replacing
from sb3_lac.stability.functions import LyapunovFunction, Observations
from sb3_lac.stability.rollout import (
    RollOuts,
    check_number,
    known_seed,
    prepare_evaluation,
    roll_out,
    summarize_episodes,
    undisturbed,
)

#: Outputs whose squares are summed, as in the critic of LAC
N_FEATURES = 16
#: Lengths of windows that are tried, in steps
WINDOWS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


class SumOfSquares(nn.Module):
    """
    A network that is never negative: the sum of the squares of its last layer.

    :param n_inputs: Number of inputs
    :param net_arch: Widths of the hidden layers
    """

    def __init__(self, n_inputs: int, net_arch: Sequence[int]):
        super().__init__()
        # Smooth, for the slope of L is what a plot shows
        self.features = nn.Sequential(*create_mlp(n_inputs, N_FEATURES, list(net_arch), nn.SiLU))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return th.sum(self.features(inputs) ** 2, dim=-1)


def flatten(observations: Observations) -> np.ndarray:
    """Observations as vectors."""
    parts = [observations[key] for key in sorted(observations)] if isinstance(observations, dict) else [observations]
    return np.concatenate([np.asarray(part, dtype=np.float64).reshape(len(part), -1) for part in parts], axis=1)


class NoCostError(ValueError):
    """Nothing had a cost on the roll-outs, so that there is nothing that a Lyapunov function could decrease by."""


class FittedLyapunov(LyapunovFunction):
    """
    A Lyapunov function that ``fit_lyapunov()`` learned: a network, and what its roll-outs say about the loop.

    :param network: Sum of squares of the scaled observations
    :param mean: Subtracted from each input, shape (n_inputs,)
    :param scale: Divides each input, shape (n_inputs,); infinite for one that never changed, which nothing is known of
    :param unit: Costs per output of the network
    :param floor: The least value on the roll-outs, which is subtracted: values below it are 0
    :param ultimate_cost: Largest cost in the last fifth of those episodes that did not terminate, NaN if there are none
    :param level: Largest value in the last fifth of those episodes, NaN if there are none
    :param window_steps: The shortest window over which the function decreased wherever it started above ``level``, in all of
        those episodes; None if there is none
    :param average_cost: Cost per step where the loop settles
    :param reward_bound: The reward that costs nothing
    :param seeds: Seeds of the environments of the roll-outs, None if they are not known (of an earlier version)
    :param low: Least value of each input on the roll-outs, shape (n_inputs,), None if it is not known (of an earlier version)
    :param high: Largest value of each input
    """

    def __init__(
        self,
        network: SumOfSquares,
        mean: np.ndarray,
        scale: np.ndarray,
        unit: float,
        floor: float,
        ultimate_cost: float,
        level: float,
        window_steps: int | None,
        average_cost: float,
        reward_bound: float,
        seeds: range | None,
        low: np.ndarray | None = None,
        high: np.ndarray | None = None,
    ):
        super().__init__(self._of_network, average_cost=average_cost, reward_bound=reward_bound, seeds=seeds)
        self.network = network
        self.mean = mean
        self.scale = scale
        self.unit = unit
        self.floor = floor
        self.ultimate_cost = ultimate_cost
        self.level = level
        self.window_steps = window_steps
        self.low = np.full(len(mean), -np.inf) if low is None else low
        self.high = np.full(len(mean), np.inf) if high is None else high

    def _of_network(self, observations: Observations) -> np.ndarray:
        inputs = flatten(observations)
        if inputs.shape[1] != len(self.mean):
            raise ValueError(f"The observations have {inputs.shape[1]} numbers, the Lyapunov function takes {len(self.mean)}.")
        # And what rounding makes of one that never changed
        margin = self.high - self.low + 1e-6 * np.maximum(np.abs(self.low), np.abs(self.high))
        far = ((inputs < self.low - margin) | (inputs > self.high + margin)).any(axis=0)
        if far.any():
            shown = np.flatnonzero(far)[:5]
            warnings.warn(
                f"Observations lie far from those that the Lyapunov function was fitted on: {far.sum()} of their {len(far)} "
                f"numbers, number {shown.tolist()} among them, which was within {self.low[shown].tolist()} and "
                f"{self.high[shown].tolist()}, and is further outside than that is wide. Values there are made up: fit on "
                "roll-outs that go there.",
                stacklevel=2,
            )
        return np.maximum(network_values(self.network, (inputs - self.mean) / self.scale, self.unit) - self.floor, 0.0)

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Save the function. The file is never there in part.

        :param path: Name of the file
        """
        numbers = ("unit", "floor", "ultimate_cost", "level", "window_steps", "average_cost", "reward_bound")
        content: dict[str, Any] = {name: getattr(self, name) for name in numbers}
        content |= {"seeds": None if self.seeds is None else (self.seeds.start, self.seeds.stop)}
        content |= {name: th.as_tensor(getattr(self, name)) for name in ("mean", "scale", "low", "high")}
        content |= {"network": self.network.state_dict()}
        with replacing(path) as part:
            th.save(content, part)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FittedLyapunov:
        """
        Load a function that was saved. Nothing in the file is executed.

        :param path: Name of the file
        :return: The function
        """
        content = th.load(path, map_location="cpu", weights_only=True)
        weights = content.pop("network")
        widths = [weight.shape for name, weight in weights.items() if name.endswith("weight")]
        network = SumOfSquares(widths[0][1], [n_outputs for n_outputs, _ in widths[:-1]])
        network.load_state_dict(weights)
        seeds = content.pop("seeds")
        content = {name: value.numpy() if isinstance(value, th.Tensor) else value for name, value in content.items()}
        return cls(network, seeds=None if seeds is None else range(*seeds), **content)


def network_values(network: SumOfSquares, inputs: np.ndarray, unit: float) -> np.ndarray:
    """Values of a network."""
    with th.no_grad():
        return unit * network(th.as_tensor(inputs, dtype=th.float32)).numpy().astype(np.float64)


def traced_returns(
    costs: np.ndarray, next_values: np.ndarray, rows: np.ndarray, average_cost: float, trace_decay: float
) -> np.ndarray:
    """
    The generalised multi-step return of the relative cost: ``G = c - c_bar + (1 - lambda) * L(s') + lambda * G'``, and
    ``c - c_bar + L(s')`` at the end of an episode (TD(lambda), Sutton 1988, with the average cost subtracted).
    """
    returns = np.empty(len(costs))
    later = np.zeros(len(rows))
    for step in range(rows.shape[1] - 1, -1, -1):
        here = rows[:, step]
        running = here >= 0
        here = here[running]
        goes_on = np.zeros(len(rows), dtype=bool) if step + 1 == rows.shape[1] else rows[:, step + 1] >= 0
        share = np.where(goes_on, trace_decay, 0.0)[running]
        later[running] = costs[here] - average_cost + (1 - share) * next_values[here] + share * later[running]
        returns[here] = later[running]
    return returns


def shortest_window(values: np.ndarray, rows: np.ndarray, level: float) -> int | None:
    """The shortest window over which a function decreases wherever it starts above a level."""
    along = np.where(rows >= 0, values[rows], np.nan)
    for n_steps in WINDOWS:
        if n_steps >= along.shape[1]:
            break
        before, after = along[:, :-n_steps], along[:, n_steps:]
        counts = (before > level) & ~np.isnan(after)
        if counts.any() and (after < before)[counts].all():
            return n_steps
    return None


def fit_lyapunov(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_episodes: int = 100,
    deterministic: bool = True,
    reward_bound: float | None = None,
    net_arch: Sequence[int] = (64, 64),
    n_iterations: int = 40,
    learning_rate: float = 3e-3,
    batch_size: int = 512,
    trace_decay: float = 0.95,
    seed: int | None = None,
    progress_bar: bool = True,
) -> FittedLyapunov:
    """
    Learn a Lyapunov function of the loop that a policy closes, on roll-outs of that policy. It makes no difference which
    algorithm trained the policy, or whether one did.

    The function is the relative value of the average cost: ``L(s) = c - c_bar + E[L(s')]``, so that its exact drift is
    ``E[L(s')] - L(s) = -(c - c_bar)``: it decreases by all of the cost (alpha3 = 1) up to the residual ``b = c_bar``, the mean
    cost at which the loop settles, however slow the loop is. The value of a discounted cost decreases by a share only, that
    shrinks as the loop gets slower (``docs/stability.md`` compares them). ``L`` and ``c_bar`` are fitted to generalised
    multi-step returns, which are computed anew before each pass over the data. ``L`` is a sum of squares and its least value
    on the roll-outs is subtracted, so that it is never negative.

    A transition that ends in a death has no next value: what it costs is its cost, and with positive rewards also those that a
    survivor could have had until the end of the longest episode.

    :param policy: A model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The environment, wrapped as that of the training. Costs are of its own rewards, without ``VecNormalize``.
    :param n_episodes: Number of episodes to learn from
    :param deterministic: Whether the loop is that of the mean action, as it is used after the training
    :param reward_bound: The reward that costs nothing, the largest one of the roll-outs by default, and at least 0
    :param net_arch: Widths of the hidden layers
    :param n_iterations: Number of passes over the data
    :param learning_rate: Of Adam at the start, falling to zero
    :param batch_size: Transitions of each gradient step
    :param trace_decay: lambda of the returns: 0 looks one step ahead, 1 to the end of the episode
    :param seed: Seed of the roll-outs and of the network; drawn if it is None
    :param progress_bar: Whether to show the progress, in a terminal
    :return: The function. It is to be judged on other roll-outs: ``evaluate_lyapunov()`` and ``certify()`` refuse its seeds,
        which it keeps in ``seeds``.
    :raises ValueError: If the arguments cannot be meant
    :raises NoCostError: If nothing had a cost on the roll-outs, which say nothing about decrease then
    """
    for name, value in {"n_episodes": n_episodes, "n_iterations": n_iterations, "batch_size": batch_size}.items():
        check_number(name, value)
    if not 0 < learning_rate < np.inf:
        raise ValueError(f"learning_rate={learning_rate} must be finite and greater than 0.")
    if not 0 <= trace_decay <= 1:
        raise ValueError(f"trace_decay={trace_decay} must lie between 0 and 1.")
    if reward_bound is not None and not 0 <= reward_bound < np.inf:
        raise ValueError(f"reward_bound={reward_bound} must be finite and at least 0.")
    env = prepare_evaluation(policy, env, of_the_critic=False)
    seed = known_seed(seed)
    with undisturbed(policy, env, seed):
        roll_outs = roll_out(policy, env, n_episodes, deterministic)
        # A float, for a scalar of numpy in the file would keep it from being loaded
        reward_bound = float(max(roll_outs.transitions["reward"].max(), 0.0) if reward_bound is None else reward_bound)
        roll_outs.transitions["cost"] = np.maximum(reward_bound - roll_outs.transitions["reward"], 0.0)
        seeds = range(seed, seed + env.num_envs)
        return _fit(
            roll_outs, reward_bound, seeds, net_arch, n_iterations, learning_rate, batch_size, trace_decay, seed, progress_bar
        )


def _fit(
    roll_outs: RollOuts,
    reward_bound: float,
    seeds: range,
    net_arch: Sequence[int],
    n_iterations: int,
    learning_rate: float,
    batch_size: int,
    trace_decay: float,
    seed: int,
    progress_bar: bool,
) -> FittedLyapunov:
    from tqdm import tqdm  # only a fit needs it

    transitions = roll_outs.transitions
    costs = transitions["cost"].to_numpy().copy()
    episode, step = transitions["episode"].to_numpy(), transitions["step"].to_numpy()
    died, truncated = transitions["terminated"].to_numpy(), transitions["truncated"].to_numpy()
    lengths = np.bincount(episode)
    # Steps that a survivor could still have had
    n_lost = np.where(died, lengths.max() - lengths[episode], 0)
    # Not the largest cost, which may be that of a death, unless there is no other
    unit = float(np.quantile(costs, 0.9)) or float(costs.max()) or reward_bound * float(n_lost.max())
    if not unit > 0:
        raise NoCostError(
            "Nothing had a cost on the roll-outs, and no episode died early, so that L has nothing to decrease by: start "
            "further away."
        )
    rows = np.full((len(lengths), lengths.max()), -1)
    rows[episode, step] = np.arange(len(costs))

    # The last observation of each episode that a time limit ended stands behind those of the transitions
    inputs = flatten(roll_outs.observations)
    mean, scale = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-6)
    if roll_outs.last_observations is not None:
        inputs = np.concatenate([inputs, flatten(roll_outs.last_observations)])
    if not np.isfinite(inputs).all():
        raise ValueError("The environment showed an infinite observation, which no network can learn from: bound it.")
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    scale[low == high] = np.inf
    inputs = (inputs - mean) / scale
    following = np.arange(1, len(costs) + 1)
    following[truncated] = len(costs) + np.arange(truncated.sum())

    rng = np.random.default_rng(seed)
    network = SumOfSquares(inputs.shape[1], net_arch)
    optimizer = th.optim.Adam(network.parameters(), lr=learning_rate)
    n_batches = -(-len(costs) // batch_size)
    schedule = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 1e-3, n_iterations * n_batches)
    tensor = th.as_tensor(inputs[: len(costs)], dtype=th.float32)
    average_cost = 0.0
    for _ in tqdm(range(n_iterations), desc="Lyapunov function", disable=None if progress_bar else True):
        values = network_values(network, inputs, unit)
        next_values = np.where(died, 0.0, values[np.minimum(following, len(values) - 1)])
        if not died.all():
            average_cost = float(np.mean((costs + next_values - values[: len(costs)])[~died]))
            # What diverges has no average, and one that runs away would take the values with it
            average_cost = min(max(average_cost, 0.0), float(costs[~died].max()))
        lost = max(reward_bound - average_cost, 0.0) * n_lost
        returns = traced_returns(costs + lost, next_values, rows, average_cost, trace_decay)
        # The relative value is known up to a constant
        targets = th.as_tensor((returns - returns.min()) / unit, dtype=th.float32)
        order = th.as_tensor(rng.permutation(len(costs)))
        for batch in order.split(batch_size):
            loss = nn.functional.mse_loss(network(tensor[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()

    values = network_values(network, inputs, unit)[: len(costs)]
    if not np.isfinite(values).all():
        raise ValueError(f"The fit diverged: its values are not finite. Lower learning_rate={learning_rate}.")
    floor = float(values.min())
    transitions["lyapunov"] = values - floor
    episodes = summarize_episodes(transitions)
    survivors = ~episodes["terminated"].to_numpy()
    late = step >= (lengths - np.maximum(lengths // 5, 1))[episode]
    late &= survivors[episode]
    level = float(transitions["lyapunov"][late].max()) if late.any() else np.nan
    window_steps = shortest_window(transitions["lyapunov"].to_numpy(), rows[survivors], level) if late.any() else None
    ultimate_cost = float(episodes["largest_late_cost"][survivors].max()) if late.any() else np.nan
    return FittedLyapunov(
        network, mean, scale, unit, floor, ultimate_cost, level, window_steps, average_cost, reward_bound, seeds, low, high
    )
