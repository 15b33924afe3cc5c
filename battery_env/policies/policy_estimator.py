"""A trained policy as an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.checks import check_positive
from battery_env.electrochemistry import NEW_CELL
from battery_env.electrochemistry.aging_path import cell_with
from battery_env.electrochemistry.ends import SURPLUS_SHARE, Cells
from battery_env.estimates import last_estimate
from battery_env.estimates.findings import Finding, Reason
from battery_env.estimators.estimator import Estimate, EstimateTrace, OnlineEstimator, Record
from battery_env.policies.confidence import Confidence
from battery_env.policies.pretrained import pretrained_policy
from battery_env.policies.stream import columns, on_grid, with_voltage
from battery_env.records import (
    ChargeHistory,
    Samples,
    check_drawn_charge,
    check_record,
    check_sample,
    drawn_charge_C,
    history_of,
)
from battery_env.records.model import RecordModel
from battery_env.tasks.base import CalibrationTask
from battery_env.tasks.env import CalibrationEnv, task_class
from battery_env.tasks.voltage.fit import FitResult
from battery_env.tasks.voltage.voltage_task import VoltageTask


def _estimate_without_sd(values: FloatArray) -> Estimate:
    """Return an estimate without standard deviations or verdict."""
    q_mobile, r_o = values.tolist()
    return Estimate(q_mobile, r_o, settled=False, findings=(Finding.of(Reason.NOTHING_STATED),))


class Predictor(Protocol):
    """Anything with Stable-Baselines3's ``predict``: an algorithm or a policy."""

    def predict(self, observation: Any, /, *, deterministic: bool = False) -> tuple[Any, Any]:
        """Actions for a batch of observations."""
        ...


def _without_data(env_id: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return options with a placeholder for the data of a voltage-only task, so that making the task simulates nothing."""
    module, _, plain_id = env_id.rpartition(":")
    if module:  # as gym.make does
        import_module(module)
    task = gym.spec(plain_id).kwargs.get("task")
    task_type = None if task is None else task_class(task)
    if task_type is None or not issubclass(task_type, VoltageTask):
        return options
    reading_s = {**task_type.options(), **options}["reading_s"]
    time_s = np.array([0.0, 1.0, 2.0, 3.0]) * np.max(reading_s)
    placeholder = Samples(time_s, np.full(4, NEW_CELL.VEOD), np.zeros(4))
    return {**options, "cost": "misfit", "dataset": [placeholder]}


class PolicyEstimator(OnlineEstimator):
    """
    Estimate q_max and R_o with a trained policy, over whole discharges or sample by sample.

    .. code-block:: python

      from battery_env import PolicyEstimator, load_nasa_discharges

      whole = load_nasa_discharges("B0005")[0].loaded_part(cut_off_V=2.7)
      print(PolicyEstimator.pretrained(recorded=True).estimate(whole))  # a policy that comes with the package

    For your model use ``PolicyEstimator(model, "BatteryRo-v0")``, with the options of its training environment. Discharges
    that are estimated together run as one batch.

    - A policy of a full-state environment estimates at every step, from the true state at the first sample on.
    - A policy of a voltage-only environment starts with the estimate of a new cell, and moves it every ``decision_s``. It
      takes any record that starts fully charged, simulated or recorded, or a stream (:meth:`update`).

    A policy states standard deviations if its observation has a fit (options ``nuisance`` and ``path``): the fit's under its
    priors, widened by the distance of the estimate from the fit. The estimate is settled if the standard deviations are as
    small as for least squares, the fit explains the record, and nothing in the record contradicts the estimate. Other policies
    state no standard deviations, and never settle.

    :meth:`load` refuses a file from another :class:`~battery_env.OnnxPolicy`, but cannot distinguish models of
    Stable-Baselines3.

    :param policy: the policy, asked for deterministic actions
    :param env_id: id of the environment that the policy was trained on
    :param decision_s: time between two estimates of a voltage-only policy, s
    :param options: options of the task except data and length of episodes; also ``cell``, the constants in the training of a
        voltage-only policy, if not the new cell's
    :raises ValueError: if the id is not a calibration environment
    """

    dt_s = 1.0  # time step of the model of a stream

    def __init__(self, policy: Predictor, env_id: str, decision_s: float = 60.0, **options: Any) -> None:
        self.policy = policy
        self.env_id = env_id
        self.options = options
        task = self.environment(env_id, **_without_data(env_id, options)).task
        self.task_class = type(task)
        self.parameters = task.parameters
        self.cell = task.readings.cell if isinstance(task, VoltageTask) else NEW_CELL
        check_positive("decision_s", decision_s)
        self.decision_s = decision_s
        self._no_constants = task.constants[0] if isinstance(task, VoltageTask) else np.zeros(0)
        self._confidence: Confidence | None = None
        if isinstance(task, VoltageTask) and task.fit() is not None:
            self._confidence = Confidence(task, self.cell)
        self.reset()

    @classmethod
    def pretrained(
        cls, env_id: str = "BatteryVoltageJoint-v0", decision_s: float = 60.0, *, recorded: bool = False
    ) -> PolicyEstimator:
        """
        Load a policy of LAC that comes with the package, with the options of its training task. For its training and its
        scores see :func:`~battery_env.policies.pretrained.pretrained_card`.

        :param env_id: id of a voltage-only environment
        :param decision_s: time between two estimates, s
        :param recorded: whether for recorded cells, trained along the lives of the bundled cells; otherwise for simulated
            cells, trained on a model with wrong constants
        :raises ValueError: for another id, or a time out of range
        :raises ImportError: without the extra ``battery_env[onnx]``
        """
        policy, options = pretrained_policy(env_id, recorded)
        return cls(policy, env_id, decision_s, **options)

    @staticmethod
    def environment(env_id: str, **options: Any) -> CalibrationEnv:
        """Make a calibration environment without its wrappers; a ``ValueError`` for the id of another environment."""
        env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
        if not isinstance(env, CalibrationEnv):
            raise ValueError(f"{env_id} is no calibration environment")
        return env

    def reset(self) -> None:
        """Forget all samples: the next sample is the first of a discharge, of a fully charged cell at rest."""
        self._samples: list[tuple[float, float, float]] = []
        self._drawn_C = 0.0
        self._decisions = 0
        self._values = np.array([self.cell.q_mobile, self.cell.r_o])
        self._constants = self._no_constants
        self._fit: FitResult | None = None
        self._update_estimate()

    def _update_estimate(self) -> None:
        """Compute the estimate of the last decision, with its standard deviations and its verdict."""
        self._estimate = _estimate_without_sd(self._values)
        if self._confidence is not None and self._fit is not None:
            samples = with_voltage(self._samples, self._decisions * self.decision_s)
            self._estimate = self._confidence.estimate(self._fit, 0, self._values, samples, ChargeHistory())

    def check(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> None:
        """Refuse a sample that :meth:`update` would refuse, and change nothing."""
        if not issubclass(self.task_class, VoltageTask):
            raise ValueError(f"a policy of {self.env_id} takes no stream: it needs the full state")
        if temperature_C is not None:
            raise ValueError("a policy takes no temperature: its model is isothermal. Leave temperature_C out.")
        if not self._samples:
            check_sample(voltage_V, current_A, dt_s)
            return
        _, _, previous_A = self._samples[-1]
        check_sample(voltage_V, current_A, dt_s, previous_A=previous_A)
        check_drawn_charge(self._drawn_C + dt_s * previous_A, -SURPLUS_SHARE * self.cell.q_mobile)

    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """
        Add one sample. The policy decides every ``decision_s``, as on the record so far.

        :param voltage_V: terminal voltage, V; NaN where it is missing, but for the first sample
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one
        :param temperature_C: must be ``None``: the model of the environments is isothermal
        :return: the estimate, as of the last decision
        :raises ValueError: for invalid values, a temperature, or a policy that takes no stream
        """
        self.check(voltage_V, current_A, dt_s, temperature_C)
        time_s = self._samples[-1][0] + dt_s if self._samples else 0.0
        self._add_sample(time_s, float(voltage_V), float(current_A))
        return self._estimate

    def _add_sample(self, time_s: float, voltage_V: float, current_A: float) -> None:
        if self._samples:
            previous_s, _, previous_A = self._samples[-1]
            self._drawn_C += (time_s - previous_s) * previous_A
        self._samples.append((time_s, voltage_V, current_A))
        decisions = int(time_s / self.decision_s + 1e-9)
        # a decision needs two voltages after the first one
        if decisions > self._decisions and len(with_voltage(self._samples, decisions * self.decision_s).time_s) > 2:
            self._decide(decisions)

    def _task_of(self, records: Sequence[Record], decision_s: float) -> CalibrationTask:
        # a data set may have the true constants, which the policy must not use
        cell = {"cell": self.cell} if issubclass(self.task_class, VoltageTask) else {}
        return self.task_class.of_records(records, decision_s, **{**self.options, **cell})

    def _decide(self, decisions: int) -> None:
        """Take one decision, on all readings up to the time of decision number ``decisions``."""
        task = self._task_of([on_grid(self._samples, self.dt_s)], decisions * self.decision_s)
        assert isinstance(task, VoltageTask)  # only this task takes a stream
        task.restore(self._values, self._constants)
        self._constants = task.constants[0]
        self._fit = task.fit()
        action, _ = self.policy.predict(task.observation(), deterministic=True)
        task.advance(np.asarray(action))
        self._decisions, self._values = decisions, task.estimate[0]
        self._update_estimate()

    def at_last_sample(self) -> tuple[RecordModel, Cells]:
        """Return the model with the estimate as its parameters, and its cell at the last sample."""
        model = RecordModel(cell_with(self.cell, self._estimate.constants), dt_s=self.dt_s)
        q_mobile, r_o = self._values.tolist()
        state = model.start(q_mobile)
        if self._samples and self._samples[-1][0] > 0.0:
            state = model.simulate(on_grid(self._samples, self.dt_s).current_A, q_mobile, r_o).state[-1]
        return model, Cells(self._values[:1], self._values[1:], state[None], np.zeros(1), np.zeros(1))

    def _made_with(self) -> dict[str, Any]:
        return {
            "estimator": type(self).__name__,
            "env_id": self.env_id,
            "policy": getattr(self.policy, "sha256", None),
            "decision_s": self.decision_s,
            "cell": asdict(self.cell),
            "options": {name: repr(value) for name, value in self.options.items() if name != "cell"},
        }

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"samples": columns(self._samples)}

    def _restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.reset()
        for sample in arrays["samples"].T.tolist():
            self._add_sample(*sample)

    def estimate(self, record: Record) -> Estimate:
        """
        Estimate from one discharge: the last estimate of a voltage-only policy, and the mean of the independent estimates of a
        full-state policy.

        :param record: one discharge; for a full-state policy a simulated one
        :raises ValueError: for an invalid record
        """
        check_drawn_charge(drawn_charge_C(check_record(record)))
        trace = self._traces([record], judge_last_only=True)[0]
        if trace.sd_q_mobile is not None:
            return last_estimate(trace)
        first = 0 if self.task_class.is_averaged else -1
        return _estimate_without_sd(np.array([trace.q_mobile[first:].mean(), trace.r_o[first:].mean()]))

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """Return the estimates over time of many discharges, run as one batch, in their order."""
        return self._traces(records)

    def _traces(self, records: Sequence[Record], judge_last_only: bool = False) -> list[EstimateTrace]:
        """Return :meth:`trace`; verdicts, which are slow, may be limited to the last decision of each discharge."""
        task = self._task_of(records, self.decision_s)
        samples = [] if self._confidence is None else [(Samples.of(record), history_of(record)) for record in records]
        rows: list[FloatArray] = []
        estimates: list[Estimate] = []
        while (running := ~task.truncated()).any():
            (discharge, time_s, counts), fit = task.available_data(), task.fit()
            action, _ = self.policy.predict(task.observation(), deterministic=True)
            task.advance(np.asarray(action))
            estimate = task.estimate
            if self._confidence is not None and fit is not None:
                is_skipped = judge_last_only & ~task.truncated()
                for n in np.flatnonzero(running).tolist():
                    record, history = samples[discharge[n]]
                    available = record.first(int(counts[n]))
                    decision = _estimate_without_sd(estimate[n])
                    if not is_skipped[n]:
                        decision = self._confidence.estimate(fit, n, estimate[n], available, history)
                    estimates.append(decision)
            rows.append(np.column_stack([discharge, time_s, estimate])[running])
            task.drop_truncated()
        table = np.concatenate(rows)
        in_order = np.argsort(table[:, 0], kind="stable")
        record_rows = np.split(in_order, np.searchsorted(table[in_order, 0], np.arange(1, len(records))))
        if self._confidence is None:
            return [EstimateTrace(table[n, 1], table[n, 2], table[n, 3]) for n in record_rows]
        return [EstimateTrace.of(table[n, 1], [estimates[k] for k in n]) for n in record_rows]
