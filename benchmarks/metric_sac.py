"""SAC in LAC's metric, the control that tells what of LAC's results is LAC's, and what is that of the roots it learns."""

from __future__ import annotations

from typing import ClassVar

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_lac import LAC
from sb3_lac.policies import largest_value


class MetricSAC(LAC):
    """
    SAC whose critics learn the root that LAC's do: the entropy is part of the value, the actor lowers the value itself, and
    there is no decrease condition (``lambda`` is 1). Its arguments are LAC's.
    """

    #: The algorithm whose file of ``zoo_configs`` it is trained with.
    zoo_config: ClassVar[str] = "lac"

    def _setup_model(self) -> None:
        self.lambda_min = self.lambda_init = self.lambda_max = 1.0
        super()._setup_model()

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        with th.no_grad():
            next_actions, log_prob = self.actor.action_log_prob(replay_data.next_observations)
            ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef)
            next_roots = largest_value(self.critic_target.outputs(replay_data.next_observations, next_actions))
            next_values = self.critic_target.value(next_roots) + ent_coef * log_prob.reshape(-1, 1)
            return -replay_data.rewards + (1 - replay_data.dones) * discounts * next_values

    def _objective(self, roots: th.Tensor) -> th.Tensor:
        return self.critic.value(roots).mean()
