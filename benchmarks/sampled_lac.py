"""LAC with sampled actions in its targets, the control that tells what the mean action does there."""

from __future__ import annotations

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_lac import LAC


class SampledLAC(LAC):
    """LAC whose targets take an action that the actor samples, as SAC's do, and no entropy. Its arguments are LAC's."""

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            sampled, _ = self.actor.action_log_prob(replay_data.next_observations)
        return super()._target_values(replay_data, sampled)
