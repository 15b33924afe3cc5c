"""A trained policy as an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from battery_env.calibration.env import CalibrationEnv
from battery_env.estimators.base import Estimate, EstimateTrace, Estimator, Record


class Predictor(Protocol):
    """Anything with Stable-Baselines3's ``predict``: an algorithm or a policy."""

    def predict(self, observation: Any, /, *, deterministic: bool = False) -> tuple[Any, Any]:
        """
        Actions for a batch of observations.

        :param observation: shape (n, observation_size)
        :param deterministic: the mean instead of a sample
        :return: actions, shape (n, action_size), and a state that is not used
        """
        ...


class PolicyEstimator(Estimator):
    """
    A policy, in closed loop with the model over whole discharges; all discharges run as one batch.

    One of a full-state environment estimates at every step, with the model's state running free from the true state at the
    first sample. One of a voltage-only environment starts with the estimate of a new cell and moves it at a fixed interval;
    it takes any record that starts fully charged, simulated or recorded. One of ``BatteryAging-v0`` takes such records life
    after life, ``cycles`` of them each, and carries its estimate over from one to the next.

    :param policy: what to ask for actions, deterministically
    :param env_id: id of the environment that the policy was trained on
    :param decision_s: time between two estimates of a voltage-only policy, s, a multiple of the interval between its readings
    :param options: of its task, but for its data and the length of its episodes
    :raises ValueError: if the id is not one of a calibration environment
    """

    def __init__(self, policy: Predictor, env_id: str, decision_s: float = 60.0, **options: Any) -> None:
        self.policy = policy
        self.env_id = env_id
        self.options = options
        task = self.environment(env_id, **options).task
        self.task_class = type(task)
        self.parameters = task.parameters
        self._every = task.steps_between(decision_s)

    @staticmethod
    def environment(env_id: str, **options: Any) -> CalibrationEnv:
        """
        A calibration environment without its wrappers.

        :param env_id: id of a calibration environment
        :param options: of the environment
        :return: the environment
        :raises ValueError: if it is none
        """
        env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
        if not isinstance(env, CalibrationEnv):
            raise ValueError(f"{env_id} is no calibration environment")
        return env

    def estimate(self, record: Record) -> Estimate:
        """
        The estimate after one discharge: of a voltage-only policy the last one, of a full-state one, whose estimates are
        independent of each other, the mean.

        :param record: one discharge; with the full state a simulated one, as no recording has it
        :return: the estimate; never settled, as a policy states no uncertainty
        """
        trace = self.trace([record])[0]
        q_mobile, r_o = (self.task_class.conclude(values) for values in (trace.q_mobile, trace.r_o))
        return Estimate(q_mobile, r_o, settled=False, reason="A policy states no uncertainty.")

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        The estimates over time of many discharges.

        :param records: discharges; a :class:`~battery_env.trajectories.TrajectoryDataset` is such a sequence
        :return: one trace per discharge, in the same order
        """
        task = self.task_class.follow(records, self._every, **self.options)
        made = []
        while (running := ~task.truncated()).any():
            discharge, time_s = task.seen()
            action, _ = self.policy.predict(task.observation(), deterministic=True)
            task.advance(np.asarray(action))
            made.append((discharge[running], time_s[running], task.estimate[running]))
            task.drop_ended()
        discharge, time_s, estimate = (np.concatenate(parts) for parts in zip(*made, strict=True))
        in_order = np.argsort(discharge, kind="stable")
        of_each = np.split(in_order, np.searchsorted(discharge[in_order], np.arange(1, len(records))))
        return [EstimateTrace(time_s=time_s[n], q_mobile=estimate[n, 0], r_o=estimate[n, 1]) for n in of_each]
