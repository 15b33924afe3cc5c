"""The reward that costs nothing, and what ``L`` is where nothing is ever paid."""

import math
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac.policies import LyapunovPolicy


def reward_scale(vec_normalize: VecNormalize | None) -> float:
    """Return the number that a reward of the environment is divided by before the agent observes it."""
    if vec_normalize is None or not vec_normalize.norm_reward:
        return 1.0
    return math.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)


@dataclass(frozen=True)
class RewardBound:
    """
    The largest reward stated or seen, at least 0, and the offset of the critics that belongs to it. Both are part of the
    policy; this is a view of them, in the units of the rewards that the agent sees.
    """

    policy: LyapunovPolicy
    #: 0 where nothing is stated. It may be larger than the bound in the file of a model
    stated: float
    #: What ``L`` is where each step costs 1
    n_costs: float
    vec_normalize: VecNormalize | None

    @property
    def _in_units_of_the_environment(self) -> th.Tensor:
        return self.policy.reward_bound.clamp(min=self.stated)

    @property
    def value(self) -> th.Tensor:
        """The bound in the units of the rewards that the agent sees, shape (1,)."""
        bound = self._in_units_of_the_environment
        if self.vec_normalize is None or not self.vec_normalize.norm_reward:
            return bound
        return (bound / reward_scale(self.vec_normalize)).clamp(max=self.vec_normalize.clip_reward)

    def raise_to(self, reward: float | th.Tensor) -> None:
        """Let the bound be at least a reward of the environment, and the one that is stated, and tell the critics."""
        self.policy.reward_bound.copy_(self._in_units_of_the_environment.clamp(min=reward))
        # The scale of the rewards may have changed too
        self.update_offset()

    def update_offset(self) -> None:
        """Give the critics the value of ``L`` where nothing is ever paid."""
        bound = self.value
        offset = th.where(bound > 0, bound * self.n_costs, 0.0)
        self.policy.critic.offset.copy_(offset)
        self.policy.critic_target.offset.copy_(offset)

    def costs(self, rewards: th.Tensor, n_rewards: float | th.Tensor) -> th.Tensor:
        """Get the costs of returns of so many rewards, none of them negative. The bound follows larger rewards."""
        largest_reward = (rewards / n_rewards).max()
        self.raise_to(largest_reward * reward_scale(self.vec_normalize))
        # Changes of the units round
        return th.maximum(self.value, largest_reward) * n_rewards - rewards
