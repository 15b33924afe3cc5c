"""SAC with a learning rate of its own for the critics, as the authors of LAC trained it beside theirs."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate


class TwoRateSAC(SAC):
    """
    SAC of Stable-Baselines3 with one more argument.

    :param args: arguments of SAC
    :param critic_learning_rate: learning rate of the critics, it can be a function of the current progress remaining
    :param kwargs: arguments of SAC
    """

    def __init__(self, *args: Any, critic_learning_rate: float | Schedule = 3e-4, **kwargs: Any) -> None:
        self.critic_learning_rate = critic_learning_rate
        super().__init__(*args, **kwargs)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        schedule = FloatSchedule(self.critic_learning_rate)
        update_learning_rate(self.critic.optimizer, schedule(self._current_progress_remaining))
