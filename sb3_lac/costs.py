"""Costs in place of rewards. Where no reward is positive, which is most often, a cost is the negated reward."""

import math
import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac.policies import LyapunovPolicy


class CostAlgorithm(OffPolicyAlgorithm):
    """
    Off-policy algorithm that minimises the cost ``bound - reward >= 0``, where ``bound`` is the largest reward stated or seen,
    and at least 0. After a termination nothing is paid, so that each step costs ``bound``. The critics learn
    of ``L - offset``, where ``offset = bound / (1 - gamma)`` is the value of ``L`` where nothing is ever paid: when the bound
    rises, all values of ``L`` rise with it, and there is nothing to learn anew.
    """

    policy: LyapunovPolicy
    #: The largest reward that the environment can pay as the user knows it, before any normalization
    stated_reward_bound: float | None

    @property
    def reward_bound(self) -> th.Tensor:
        """The largest reward stated or seen, before any normalization, shape (1,). It is part of the policy, as ``L`` is."""
        return self.policy.reward_bound

    def cost_bound(self, vec_normalize: VecNormalize | None = None) -> th.Tensor:
        """The reward that costs nothing, in the units of the rewards that the agent sees, shape (1,)."""
        # One that is stated when a model is loaded may be larger than the one in its file
        bound = self.reward_bound.clamp(min=self.stated_reward_bound or 0.0)
        if vec_normalize is None or not vec_normalize.norm_reward:
            return bound
        return (bound / reward_scale(vec_normalize)).clamp(max=vec_normalize.clip_reward)

    def update_offset(self, vec_normalize: VecNormalize | None) -> None:
        """Give the critics the offset of the present bound, and refuse an infinite one."""
        if self.gamma < 1:
            offset = self.cost_bound(vec_normalize) / (1 - self.gamma)
            self.policy.critic.offset.copy_(offset)
            self.policy.critic_target.offset.copy_(offset)
        elif self.reward_bound > 0:
            raise ValueError(
                f"gamma={self.gamma} must be smaller than 1 with rewards up to {self.reward_bound.item():g}: each step below "
                "that reward has a cost, whose sum over all time is infinite. Use for instance gamma=0.99."
            )

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # The largest reward of a step, which n-step returns do not tell
        vec_normalize = self._vec_normalize_env
        largest_reward = float(np.max(reward if vec_normalize is None else vec_normalize.get_original_reward()))
        if largest_reward > 0 and largest_reward > self.reward_bound:
            self.reward_bound.fill_(largest_reward)
            self.update_offset(vec_normalize)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def costs(self, replay_data: ReplayBufferSamples) -> th.Tensor:
        """
        Get the costs of sampled transitions, of which none is negative. The bound follows rewards that are computed only then
        (HER), or that were stored elsewhere; of the latter, n-step returns only tell their mean.
        """
        # How often a reward of each step counts in a return: 1 + gamma + ... + gamma^(n-1)
        n_rewards = 1.0 if replay_data.discounts is None else (1 - replay_data.discounts) / (1 - self.gamma)
        largest_reward = (replay_data.rewards / n_rewards).max()
        vec_normalize = self._vec_normalize_env
        self.reward_bound.copy_(th.maximum(self.cost_bound(), largest_reward * reward_scale(vec_normalize)))
        # The scale of the rewards may have changed too
        self.update_offset(vec_normalize)
        # Changes of the units round
        bound = th.maximum(self.cost_bound(vec_normalize), largest_reward)
        return bound * n_rewards - replay_data.rewards

    def warn_of_free_terminations(self) -> None:
        """Warn if what is stored shows no price of an early end: where that is a failure, it is the cheapest policy of all."""
        buffer = self.replay_buffer
        # A buffer that does not keep time limits apart cannot tell; and where living pays, an end costs the bound
        # for ever. A buffer of somebody else may have arrays of its own
        if buffer is None or self.reward_bound > 0 or not (buffer.handle_timeout_termination and hasattr(buffer, "timeouts")):
            return
        rewards, dones, timeouts = (stored[: buffer.size()] for stored in (buffer.rewards, buffer.dones, buffer.timeouts))
        costs, ends = 0.0 - rewards, dones > timeouts
        if not ends.any() or ends.all() or costs.min() < 0:
            return
        last, cheapest, dearest = costs[ends].mean(), costs[~ends].min(), costs[~ends].max()
        price = costs[~ends].mean() / (1 - self.gamma) if self.gamma < 1 else math.inf
        # An end that costs less than any other step is a goal
        if cheapest <= last <= dearest and price > 0:
            warnings.warn(
                f"The last step before a termination costs {last:.3g} on average, no more than another step does (up to "
                f"{dearest:.3g}). Where the end is the goal, all is well. Where it is a failure, to fail early is the "
                "cheapest policy of any algorithm: give the last step a cost of its own, above that of going on, here about "
                f"{price:.3g} (mean cost per step / (1 - gamma)).",
                stacklevel=2,
            )


def reward_scale(vec_normalize: VecNormalize | None) -> float:
    """What a reward of the environment is divided by before the agent sees it."""
    if vec_normalize is None or not vec_normalize.norm_reward:
        return 1.0
    return math.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)
