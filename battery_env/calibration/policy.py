"""A trained policy as an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from battery_env.calibration.aging import BatteryAging
from battery_env.calibration.env import CalibrationEnv
from battery_env.calibration.full_state import FullStateTask
from battery_env.calibration.task import Parameter
from battery_env.calibration.voltage import VoltageTask
from battery_env.estimators.base import Estimate, EstimateTrace, Estimator, Record
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
    A policy, in closed loop with the model over whole discharges; all discharges run as one batch.

    One of a full-state environment estimates at every step, with the model's state running free from the true state at the
    first sample. One of a voltage-only environment starts with the estimate of a new cell and moves it at a fixed interval;
    it takes any record that starts fully charged, simulated or recorded.

    :param policy: what to ask for actions, deterministically
    :param env_id: id of the environment that the policy was trained on
    :param decision_s: time between two estimates of a voltage-only policy, s, a multiple of the interval between its readings
    :param moves: how often such a policy moves the estimate each time, with the same readings
    :param options: of its task, but for its data and the length of its episodes
    :raises ValueError: if the id is not one of a calibration environment, or of one over several discharges
    """

    def __init__(self, policy: Predictor, env_id: str, decision_s: float = 60.0, moves: int = 1, **options: Any) -> None:
        self.policy = policy
        self.env_id = env_id
        self.options = options
        if moves < 1:
            raise ValueError(f"moves must be at least 1, got {moves!r}")
        self.moves = moves
        env = self.environment(env_id, **options)
        self.make_task: Any = type(env.task)
        self.parameters = env.task.parameters
        self.voltage_only = isinstance(env.task, VoltageTask)
        if self.voltage_only:
            assert isinstance(env.task, VoltageTask)
            interval_s = env.task.readings.interval_s
            self._every = round(decision_s / interval_s)
            if self._every < 1 or abs(self._every * interval_s - decision_s) > 1e-9 * interval_s:
                raise ValueError(
                    f"decision_s must be a multiple of the interval between readings, {interval_s:g} s, got {decision_s!r}"
                )

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
        if not isinstance(env, CalibrationEnv) or isinstance(env.task, BatteryAging):
            raise ValueError(f"{env_id} is no calibration environment of single discharges")
        return env

    def estimate(self, record: Record) -> Estimate:
        """
        The estimate after one discharge: of a voltage-only policy the last one, of a full-state one, whose estimates are
        independent of each other, the mean.

        :param record: one discharge; with the full state a simulated one, as no recording has it
        :return: the estimate; never settled, as a policy states no uncertainty
        """
        trace = self.trace([record])[0]
        if self.voltage_only:
            q_mobile, r_o = float(trace.q_mobile[-1]), float(trace.r_o[-1])
        else:
            q_mobile, r_o = float(trace.q_mobile.mean()), float(trace.r_o.mean())
        return Estimate(q_mobile, r_o, settled=False, reason="A policy states no uncertainty.")

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        The estimates over time of many discharges.

        :param records: discharges; a :class:`~battery_env.trajectories.TrajectoryDataset` is such a sequence
        :return: one trace per discharge, in the same order
        """
        return self._follow_readings(records) if self.voltage_only else self._follow_states(records)

    def _follow_readings(self, records: Sequence[Record]) -> list[EstimateTrace]:
        task = self.make_task(len(records), **{"start": "new_cell", **self.options, "dataset": records})
        assert isinstance(task, VoltageTask)
        task.follow(self._every)
        seen, estimates = [], []
        for _ in range(-(-int(task.readings.count.max()) // self._every)):
            seen.append(task.count)
            for move in range(self.moves):
                action, _ = self.policy.predict(task.observation(), deterministic=True)
                task.advance(np.asarray(action), arriving=move == self.moves - 1)
            estimates.append(task.estimate.copy())
        counts, found = np.array(seen), np.array(estimates)
        traces = []
        for n, record in enumerate(records):
            decisions = 1 + int(np.argmax(counts[:, n] == task.readings.count[n]))
            time_s = record.time_s[0] + counts[:decisions, n] * task.readings.interval_s
            traces.append(EstimateTrace(time_s=time_s, q_mobile=found[:decisions, n, 0], r_o=found[:decisions, n, 1]))
        return traces

    def _follow_states(self, records: Sequence[Any]) -> list[EstimateTrace]:
        dataset = records if isinstance(records, TrajectoryDataset) else TrajectoryDataset.from_trajectories(records)
        # the longest first, so that those still running are always the first rows
        order = np.argsort(dataset.first - dataset.stop, kind="stable")
        longest = int((dataset.stop - dataset.first).max())
        task = self.make_task(len(dataset), **{**self.options, "dataset": dataset, "episode_steps": longest})
        assert isinstance(task, FullStateTask)
        for row, n in enumerate(order):
            point = {"trajectory": n, "sample": dataset.first[n]}
            task.start(np.array([row]), [np.random.default_rng(n)], point)
        decisions = task.transitions_left()
        names: tuple[Parameter, ...] = ("q_mobile", "r_o")
        inferred = {name: np.full((decisions[0], len(dataset)), np.nan) for name in names}
        for step in range(decisions[0]):
            running = int(np.count_nonzero(decisions > step))
            if running < task.cells:
                task.keep(np.arange(task.cells) < running)
            action, _ = self.policy.predict(task.observation(), deterministic=True)
            task.advance(np.asarray(action))
            inferred["q_mobile"][step, :running], inferred["r_o"][step, :running] = task.q_mobile_hat, task.r_o_hat
        traces: dict[int, EstimateTrace] = {}
        for column, n in enumerate(order):
            # the estimate of step t uses x_{t+1}
            time = (dataset.first[n] + 1 + np.arange(decisions[column])) * dataset.dt_s
            found = {name: values[: decisions[column], column] for name, values in inferred.items()}
            traces[int(n)] = EstimateTrace(time_s=time, **found)
        return [traces[n] for n in range(len(dataset))]
