"""A trained policy as an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from battery_env.calibration.env import FullStateEnv
from battery_env.calibration.full_state import FullStateTask
from battery_env.electrochemistry import Trajectory
from battery_env.estimators.base import Estimate, EstimateTrace, Estimator
from battery_env.trajectories import TrajectoryDataset


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
    Runs a policy in closed loop with the model over whole discharges: one estimate a step, the model's state running free
    from the true state at the first sample. All discharges run as one batch.

    :param policy: what to ask for actions, deterministically
    :param env_id: id of the environment that the policy was trained on
    :raises ValueError: if the id is not one of a calibration environment with the full state
    """

    def __init__(self, policy: Predictor, env_id: str) -> None:
        self.policy = policy
        self.env_id = env_id
        env = self.environment(env_id)
        self.parameter = env.task.parameter
        self.formulation = env.formulation

    @staticmethod
    def environment(env_id: str, **arguments: Any) -> FullStateEnv:
        """
        A calibration environment without its wrappers.

        :param env_id: id of a calibration environment with the full state
        :param arguments: of the environment
        :return: the environment
        :raises ValueError: if it is none
        """
        env = gym.make(env_id, disable_env_checker=True, **arguments).unwrapped
        if not isinstance(env, FullStateEnv):
            raise ValueError(f"{env_id} is no calibration environment with the full state")
        return env

    def estimate(self, record: Trajectory) -> Estimate:  # type: ignore[override]
        """
        The mean estimate over one discharge.

        :param record: a simulated discharge (no recording has the full state)
        :return: the estimate
        """
        trace = self.trace([record])[0]
        return Estimate(q_mobile=float(trace.q_mobile.mean()), r_o=float(trace.r_o.mean()))

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """
        The estimates over time of many discharges, one a step.

        :param records: simulated discharges; a :class:`~battery_env.trajectories.TrajectoryDataset` is one
        :return: one trace per discharge, in the same order
        """
        dataset = records if isinstance(records, TrajectoryDataset) else TrajectoryDataset.from_trajectories(records)
        # the longest first, so that those still running are always the first rows
        order = np.argsort(dataset.first - dataset.stop, kind="stable")
        task = FullStateTask(dataset, self.parameter, self.formulation, cells=len(dataset))
        task.begin(np.arange(len(dataset)), order, dataset.first[order])
        decisions = task.transitions_left()
        inferred = np.full((decisions[0], len(dataset)), np.nan)
        for step in range(decisions[0]):
            running = int(np.count_nonzero(decisions > step))
            if running < task.cells:
                task.keep(np.arange(task.cells) < running)
            action, _ = self.policy.predict(task.observation(), deterministic=True)
            task.advance(np.asarray(action)[:, 0])
            inferred[step, :running] = task.q_mobile_hat if self.parameter == "q_mobile" else task.r_o_hat
        traces: dict[int, EstimateTrace] = {}
        for column, n in enumerate(order):
            values = inferred[: decisions[column], column]
            # the estimate of step t uses x_{t+1}
            time = (dataset.first[n] + 1 + np.arange(len(values))) * dataset.dt_s
            known = np.full_like(values, dataset.r_o[n] if self.parameter == "q_mobile" else dataset.q_mobile[n])
            q, r = (values, known) if self.parameter == "q_mobile" else (known, values)
            traces[int(n)] = EstimateTrace(time_s=time, q_mobile=q, r_o=r)
        return [traces[n] for n in range(len(dataset))]
