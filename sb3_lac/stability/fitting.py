"""Learns a Lyapunov function on the roll-outs of any policy."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn
from tqdm import tqdm

from sb3_lac.stability.functions import LyapunovFunction, Observations
from sb3_lac.stability.loop import by_keyword, closed_loop
from sb3_lac.stability.rollout import RollOuts, fifths_left, flatten, mean_reward, summarize_episodes

if TYPE_CHECKING:
    import pandas as pd

#: Widths of the layers; the squares of the outputs of the last one are summed
NET_ARCH = (64, 64, 16)
#: Passes over the data
N_ITERATIONS = 40
#: Transitions of each gradient step
BATCH_SIZE = 512
#: Of Adam at the start, falling to zero
LEARNING_RATE = 3e-3
#: lambda of the returns: 0 looks one step ahead, 1 to the end of the episode
TRACE_DECAY = 0.95
#: Lengths of windows that are tried, in steps
WINDOWS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


class SumOfSquares(nn.Module):
    """A network that is never negative: the sum of the squares of its last layer."""

    def __init__(self, n_inputs: int):
        super().__init__()
        # Smooth, for the slope of L is what a plot shows
        self.features = nn.Sequential(*create_mlp(n_inputs, NET_ARCH[-1], list(NET_ARCH[:-1]), nn.SiLU))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return th.sum(self.features(inputs) ** 2, dim=-1)

    def values(self, inputs: np.ndarray) -> np.ndarray:
        """Evaluate the network without gradients."""
        with th.no_grad():
            return self(th.as_tensor(inputs, dtype=th.float32)).numpy().astype(np.float64)


@dataclass(frozen=True, eq=False)
class InputRange:
    """The numbers that observations were made of on the roll-outs of a fit, each of shape (n_inputs,)."""

    mean: np.ndarray
    #: Standard deviation, infinite for a number that never changed, which nothing is known of
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def scaled(self, inputs: np.ndarray) -> np.ndarray:
        """Scale inputs for a network."""
        return (inputs - self.mean) / self.scale

    def warn_if_far(self, inputs: np.ndarray) -> None:
        """Say which inputs lie further outside the range than that is wide."""
        # And what rounding makes of one that never changed
        margin = self.high - self.low + 1e-6 * np.maximum(np.abs(self.low), np.abs(self.high))
        far = ((inputs < self.low - margin) | (inputs > self.high + margin)).any(axis=0)
        if far.any():
            dimensions = np.flatnonzero(far)[:5]
            warnings.warn(
                f"Observations lie far from those that the Lyapunov function was fitted on: {far.sum()} of their {len(far)} "
                f"numbers, number {dimensions.tolist()} among them, which was within {self.low[dimensions].tolist()} and "
                f"{self.high[dimensions].tolist()}, and is further outside than that is wide. Values there are made up: fit "
                "on roll-outs that go there.",
                stacklevel=2,
            )


class FittedLyapunov(LyapunovFunction):
    """
    A Lyapunov function learned by ``fit_lyapunov()``: a network, and thresholds from its roll-outs. For the episodes without a
    termination, ``ultimate_bound`` is the largest cost in their last fifth, ``level`` the largest value there, and
    ``window_steps`` the shortest window over which the function decreased from every value above that level.

    :param network: Sum of squares of the scaled observations
    :param inputs: The observations of the fit
    :param unit: Costs per output of the network
    :param floor: The smallest value on the roll-outs, subtracted from all values; values below the floor are 0
    :param average_cost: Cost per step of the settled loop
    :param reward_bound: The reward without cost
    :param seeds: Seeds of the environments of the roll-outs
    """

    seeds: range

    def __init__(
        self,
        network: SumOfSquares,
        inputs: InputRange,
        unit: float,
        floor: float,
        average_cost: float,
        reward_bound: float,
        seeds: range,
    ):
        super().__init__(self._of_network, reward_bound=reward_bound)
        self.network = network
        self.inputs = inputs
        self.unit = unit
        self.floor = floor
        self.average_cost = average_cost
        self.seeds = seeds

    def _of_network(self, observations: Observations) -> np.ndarray:
        inputs, n_known = flatten(observations), len(self.inputs.mean)
        if inputs.shape[1] != n_known:
            raise ValueError(f"The observations have {inputs.shape[1]} numbers, the Lyapunov function takes {n_known}.")
        self.inputs.warn_if_far(inputs)
        return np.maximum(self.unit * self.network.values(self.inputs.scaled(inputs)) - self.floor, 0.0)


@by_keyword
def fit_lyapunov(
    policy: PolicyPredictor,
    env: gym.Env | VecEnv,
    *,
    n_episodes: int = 100,
    deterministic: bool = True,
    seed: int | None = None,
    progress_bar: bool = True,
) -> FittedLyapunov:
    """
    Learn a Lyapunov function of a closed loop, on roll-outs of its policy. The policy may be of any algorithm, or a classical
    controller.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import fit_lyapunov
      from sb3_lac.envs import reference_controller

      env = gym.make("LinearCost-v0")
      lyapunov = fit_lyapunov(reference_controller(env), env, n_episodes=20, seed=0)

    Judge it on other episodes, with ``evaluate_lyapunov()`` and ``certify()``.

    The function is the relative value of the average cost, ``L(s) = c - c_bar + E[L(s')]``. Its exact drift is
    ``E[L(s')] - L(s) = -(c - c_bar)``: ``L`` decreases by all of the cost (alpha3 = 1) up to the residual ``b = c_bar``, the
    mean cost of the settled loop, in fast and slow loops alike. (The value of a discounted cost decreases by a share only, and
    the share shrinks in slower loops.) ``L`` is a sum of squares minus its smallest value on the roll-outs, and therefore
    never negative. The fit uses multi-step returns, computed anew before each pass over the data.

    The reward without cost is the largest reward of the roll-outs, and at least 0. A terminal transition has no next value.
    With positive rewards, its cost includes the missed rewards until the end of the longest episode.

    :param policy: A model of Stable-Baselines3, or anything with ``predict(observation, deterministic=...)``
    :param env: The environment, wrapped as that of the training. Costs are of its own rewards, without ``VecNormalize``.
    :param n_episodes: Number of episodes to learn from
    :param deterministic: Whether to use the mean action, as after the training, or sampled actions
    :param seed: Seed of the roll-outs and of the network; drawn if it is None
    :param progress_bar: Whether to show the progress, in a terminal
    :return: The function. Judge it on other roll-outs: ``evaluate_lyapunov()`` and ``certify()`` refuse the seeds of the fit
        (``seeds``).
    :raises ValueError: If an argument is invalid
    :raises NoCostError: If no transition of the roll-outs had a cost
    """
    with closed_loop(policy, env, None, n_episodes, deterministic, seed) as loop:
        roll_outs = loop.roll_out(n_episodes)
        transitions = roll_outs.transitions
        reward_bound = float(max(transitions["reward"].max(), 0.0))
        transitions["cost"] = np.maximum(reward_bound - transitions["reward"], 0.0)
        data = _Data.of(roll_outs, reward_bound)
        network = SumOfSquares(data.scaled.shape[1])
        average_cost = _learn(network, data, reward_bound, loop.seed, progress_bar)
    return _described(network, data, transitions, average_cost, reward_bound, loop.seeds)


class NoCostError(ValueError):
    """
    No transition of the roll-outs had a cost, so that a Lyapunov function has nothing to decrease by.

    :param mean_reward: Mean over episodes of the sum of their rewards
    """

    def __init__(self, mean_reward: float):
        super().__init__(
            "Nothing had a cost on the roll-outs, and no episode died early, so that L has nothing to decrease by: start "
            "further away."
        )
        self.mean_reward = mean_reward


@dataclass(frozen=True, eq=False)
class _Data:
    """Roll-outs as arrays with one entry per transition, and behind the inputs the last ones before the time limits."""

    costs: np.ndarray
    died: np.ndarray
    #: Row of each transition by episode and step, -1 behind the end of an episode
    rows: np.ndarray
    #: Steps that a survivor could still have had
    n_lost: np.ndarray
    #: Row of the input that follows
    following: np.ndarray
    scaled: np.ndarray
    inputs: InputRange
    unit: float

    @classmethod
    def of(cls, roll_outs: RollOuts, reward_bound: float) -> _Data:
        """Arrange roll-outs for the fit."""
        transitions = roll_outs.transitions
        costs = transitions["cost"].to_numpy().copy()
        episode, step = transitions["episode"].to_numpy(), transitions["step"].to_numpy()
        died, truncated = transitions["terminated"].to_numpy(), transitions["truncated"].to_numpy()
        lengths = np.bincount(episode)
        n_lost = np.where(died, lengths.max() - lengths[episode], 0)
        # Not the largest cost, which may be that of a death, unless there is no other
        unit = float(np.quantile(costs, 0.9)) or float(costs.max()) or reward_bound * float(n_lost.max())
        if not unit > 0:
            raise NoCostError(mean_reward(transitions))
        rows = np.full((len(lengths), lengths.max()), -1)
        rows[episode, step] = np.arange(len(costs))
        inputs = flatten(roll_outs.observations)
        mean, scale = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-6)
        # Nothing is learned of a number that is the same in all these states, whatever it is in the last observations
        scale[inputs.min(axis=0) == inputs.max(axis=0)] = np.inf
        if roll_outs.last_observations is not None:
            inputs = np.concatenate([inputs, flatten(roll_outs.last_observations)])
        if not np.isfinite(inputs).all():
            raise ValueError("The environment showed an infinite observation, which no network can learn from: bound it.")
        following = np.arange(1, len(costs) + 1)
        following[truncated] = len(costs) + np.arange(truncated.sum())
        of_inputs = InputRange(mean, scale, inputs.min(axis=0), inputs.max(axis=0))
        return cls(costs, died, rows, n_lost, following, of_inputs.scaled(inputs), of_inputs, unit)


def _learn(network: SumOfSquares, data: _Data, reward_bound: float, seed: int, progress_bar: bool) -> float:
    """Fit a network to the returns, and return the average cost."""
    costs, n = data.costs, len(data.costs)
    rng = np.random.default_rng(seed)
    optimizer = th.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    schedule = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 1e-3, N_ITERATIONS * -(-n // BATCH_SIZE))
    tensor = th.as_tensor(data.scaled[:n], dtype=th.float32)
    average_cost = 0.0
    for _ in tqdm(range(N_ITERATIONS), desc="Lyapunov function", disable=None if progress_bar else True):
        values = data.unit * network.values(data.scaled)
        next_values = np.where(data.died, 0.0, values[np.minimum(data.following, len(values) - 1)])
        if not data.died.all():
            average_cost = float(np.mean((costs + next_values - values[:n])[~data.died]))
            # What diverges has no average, and one that runs away would take the values with it
            average_cost = min(max(average_cost, 0.0), float(costs[~data.died].max()))
        lost = max(reward_bound - average_cost, 0.0) * data.n_lost
        returns = traced_returns(costs + lost, next_values, data.rows, average_cost)
        # The relative value is known up to a constant
        targets = th.as_tensor((returns - returns.min()) / data.unit, dtype=th.float32)
        for batch in th.as_tensor(rng.permutation(n)).split(BATCH_SIZE):
            loss = nn.functional.mse_loss(network(tensor[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return average_cost


def traced_returns(costs: np.ndarray, next_values: np.ndarray, rows: np.ndarray, average_cost: float) -> np.ndarray:
    """
    Sum the relative costs of several steps: ``G = c - c_bar + (1 - lambda) * L(s') + lambda * G'``, and
    ``c - c_bar + L(s')`` at the end of an episode (TD(lambda), Sutton 1988, with the average cost subtracted).
    """
    returns = np.empty(len(costs))
    later = np.zeros(len(rows))
    for step in range(rows.shape[1] - 1, -1, -1):
        row = rows[:, step]
        running = row >= 0
        row = row[running]
        goes_on = np.zeros(len(rows), dtype=bool) if step + 1 == rows.shape[1] else rows[:, step + 1] >= 0
        share = np.where(goes_on, TRACE_DECAY, 0.0)[running]
        later[running] = costs[row] - average_cost + (1 - share) * next_values[row] + share * later[running]
        returns[row] = later[running]
    return returns


def _described(
    network: SumOfSquares, data: _Data, transitions: pd.DataFrame, average_cost: float, reward_bound: float, seeds: range
) -> FittedLyapunov:
    """Add to a network what its own roll-outs say about the loop."""
    n = len(data.costs)
    values = data.unit * network.values(data.scaled)[:n]
    if not np.isfinite(values).all():
        raise ValueError("The fit diverged: its values are not finite.")
    floor = float(values.min())
    values = values - floor
    lyapunov = FittedLyapunov(network, data.inputs, data.unit, floor, average_cost, reward_bound, seeds)
    episodes = summarize_episodes(transitions)
    survived = ~episodes["terminated"].to_numpy()
    if survived.any():
        late = (fifths_left(transitions) == 0).to_numpy() & survived[transitions["episode"]]
        lyapunov.level = float(values[late].max())
        lyapunov.window_steps = shortest_window(values, data.rows[survived], lyapunov.level)
        lyapunov.ultimate_bound = float(episodes["largest_late_cost"][survived].max())
    return lyapunov


def shortest_window(values: np.ndarray, rows: np.ndarray, level: float) -> int | None:
    """Return the shortest window over which a function decreases wherever it starts above a level."""
    along = np.where(rows >= 0, values[rows], np.nan)
    for n_steps in WINDOWS:
        if n_steps >= along.shape[1]:
            break
        before, after = along[:, :-n_steps], along[:, n_steps:]
        counts = (before > level) & ~np.isnan(after)
        if counts.any() and (after < before)[counts].all():
            return n_steps
    return None
