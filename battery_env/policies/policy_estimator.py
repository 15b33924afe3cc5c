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
from battery_env.tasks.voltage.fit import Fitted
from battery_env.tasks.voltage.voltage_task import VoltageTask

# Steps in which a stream is followed, s
_STEP_S = 1.0


def _unstated(values: FloatArray) -> Estimate:
    """Of a policy without a fit, before its first decision, and of one that is not judged."""
    q_mobile, r_o = values.tolist()
    return Estimate(q_mobile, r_o, settled=False, findings=(Finding.of(Reason.NOTHING_STATED),))


class Predictor(Protocol):
    """Anything with Stable-Baselines3's ``predict``: an algorithm or a policy."""

    def predict(self, observation: Any, /, *, deterministic: bool = False) -> tuple[Any, Any]:
        """Actions for a batch of observations."""
        ...


def _without_data(env_id: str, options: dict[str, Any]) -> dict[str, Any]:
    """Options of an environment that simulates nothing, where it needs no simulation: only its task is asked for."""
    module, _, plain_id = env_id.rpartition(":")
    if module:  # as gym.make has it
        import_module(module)
    task = gym.spec(plain_id).kwargs.get("task")
    kind = None if task is None else task_class(task)
    if kind is None or not issubclass(kind, VoltageTask):
        return options
    reading_s = {**kind.options(), **options}["reading_s"]
    time_s = np.array([0.0, 1.0, 2.0, 3.0]) * np.max(reading_s)
    blank = Samples(time_s, np.full(4, NEW_CELL.VEOD), np.zeros(4))
    return {**options, "cost": "misfit", "dataset": [blank]}


class PolicyEstimator(OnlineEstimator):
    """
    Estimate q_max and R_o with a trained policy, over whole discharges or sample by sample.

    .. code-block:: python

      from battery_env import PolicyEstimator, load_nasa_discharges

      whole = load_nasa_discharges("B0005")[0].loaded_part(cut_off_V=2.7)
      print(PolicyEstimator.pretrained(recorded=True).estimate(whole))  # a policy that comes with the package

    A model of your own is ``PolicyEstimator(model, "BatteryRo-v0")``, with the options of the environment that it was trained
    on. Discharges that are estimated together run as one batch.

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
        self.dt_s = _STEP_S
        self._confidence: Confidence | None = None
        if isinstance(task, VoltageTask) and task.fitted() is not None:
            self._confidence = Confidence(task, self.cell, self.dt_s)
        self.reset()

    @classmethod
    def pretrained(
        cls, env_id: str = "BatteryVoltageJoint-v0", decision_s: float = 60.0, *, recorded: bool = False
    ) -> PolicyEstimator:
        """
        A policy of LAC that comes with the package, with the options of the task that it was trained on. What made it and what
        it is worth says :func:`~battery_env.policies.pretrained.pretrained_card`.

        :param env_id: id of a voltage-only environment
        :param decision_s: time between two estimates, s
        :param recorded: whether for recorded cells: one that has learned along the lives of the bundled cells. By default one
            that has learned on a model with wrong constants, as simulated cells have
        :raises ValueError: for another id, or a time out of range
        :raises ImportError: without the extra ``battery_env[onnx]``
        """
        policy, options = pretrained_policy(env_id, recorded)
        return cls(policy, env_id, decision_s, **options)

    @staticmethod
    def environment(env_id: str, **options: Any) -> CalibrationEnv:
        """A calibration environment, by its id and options, without its wrappers; a ``ValueError`` if it is none."""
        env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
        if not isinstance(env, CalibrationEnv):
            raise ValueError(f"{env_id} is no calibration environment")
        return env

    def reset(self) -> None:
        """
        Forget all samples: the next one is the first of a discharge, of a fully charged cell at rest.
        """
        self._samples: list[tuple[float, float, float]] = []
        self._drawn_C = 0.0
        self._decisions = 0
        self._now = np.array([self.cell.q_mobile, self.cell.r_o])
        self._constants = self._no_constants
        self._fitted: Fitted | None = None
        self._judge()

    def _judge(self) -> None:
        """Tell how sure the estimate is, of the samples up to the last decision."""
        self._estimate = _unstated(self._now)
        if self._confidence is not None and self._fitted is not None:
            samples = with_voltage(self._samples, self._decisions * self.decision_s)
            self._estimate = self._confidence.estimate(self._fitted, 0, self._now, samples, ChargeHistory())

    def check(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> None:
        """Refuse a sample that :meth:`update` would refuse, and change nothing."""
        if not issubclass(self.task_class, VoltageTask):
            raise ValueError(f"a policy of {self.env_id} takes no stream: it needs the full state")
        if temperature_C is not None:
            raise ValueError("a policy takes no temperature: its model is isothermal. Leave temperature_C out.")
        if not self._samples:
            check_sample(voltage_V, current_A, dt_s)
            return
        _, _, before_A = self._samples[-1]
        check_sample(voltage_V, current_A, dt_s, previous_A=before_A)
        check_drawn_charge(self._drawn_C + dt_s * before_A, -SURPLUS_SHARE * self.cell.q_mobile)

    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """
        Take in one sample. The policy decides when ``decision_s`` are over, as it would on the record so far.

        :param voltage_V: terminal voltage, V; NaN where it is missing, but for the first sample
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one
        :param temperature_C: must be ``None``: the model of the environments is isothermal
        :return: the estimate, as of the last decision
        :raises ValueError: for invalid values, a temperature, or a policy that takes no stream
        """
        self.check(voltage_V, current_A, dt_s, temperature_C)
        time_s = self._samples[-1][0] + dt_s if self._samples else 0.0
        self._take(time_s, float(voltage_V), float(current_A))
        return self._estimate

    def _take(self, time_s: float, voltage_V: float, current_A: float) -> None:
        if self._samples:
            before_s, _, before_A = self._samples[-1]
            self._drawn_C += (time_s - before_s) * before_A
        self._samples.append((time_s, voltage_V, current_A))
        due = int(time_s / self.decision_s + 1e-9)
        # two beside the first one
        if due > self._decisions and len(with_voltage(self._samples, due * self.decision_s).time_s) > 2:
            self._decide(due)

    def _follow(self, records: Sequence[Record], decision_s: float) -> CalibrationTask:
        # a data set may know its own constants, of which the policy must not learn
        cell = {"cell": self.cell} if issubclass(self.task_class, VoltageTask) else {}
        return self.task_class.follow(records, decision_s, **{**self.options, **cell})

    def _decide(self, due: int) -> None:
        """One decision, on all readings up to the time when it was due."""
        task = self._follow([on_grid(self._samples, self.dt_s)], due * self.decision_s)
        assert isinstance(task, VoltageTask)  # no other follows a stream
        task.restore(self._now, self._constants)
        self._constants = task.constants[0]
        self._fitted = task.fitted()
        action, _ = self.policy.predict(task.observation(), deterministic=True)
        task.advance(np.asarray(action))
        self._decisions, self._now = due, task.estimate[0]
        self._judge()

    def at_last_sample(self) -> tuple[RecordModel, Cells]:
        """The model that follows the discharge, and its cell at the last sample, with the estimate as its parameters."""
        model = RecordModel(cell_with(self.cell, self._estimate.constants), dt_s=self.dt_s)
        q_mobile, r_o = self._now.tolist()
        state = model.start(q_mobile)
        if self._samples and self._samples[-1][0] > 0.0:
            state = model.simulate(on_grid(self._samples, self.dt_s).current_A, q_mobile, r_o).state[-1]
        return model, Cells(self._now[:1], self._now[1:], state[None], np.zeros(1), np.zeros(1))

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
            self._take(*sample)

    def estimate(self, record: Record) -> Estimate:
        """
        The estimate after one discharge: of a voltage-only policy the last one, of a full-state one, whose estimates are
        independent of each other, the mean.

        :param record: one discharge; with the full state a simulated one, as no recording has it
        :raises ValueError: for an invalid record
        """
        check_drawn_charge(drawn_charge_C(check_record(record)))
        trace = self._traces([record], judge_last_only=True)[0]
        if trace.sd_q_mobile is not None:
            return last_estimate(trace)
        first = 0 if self.task_class.is_averaged else -1
        return _unstated(np.array([trace.q_mobile[first:].mean(), trace.r_o[first:].mean()]))

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """The estimates over time of many discharges, run as one batch, in their order."""
        return self._traces(records)

    def _traces(self, records: Sequence[Record], judge_last_only: bool = False) -> list[EstimateTrace]:
        """Those of :meth:`trace`; a verdict takes longer than a decision, and may be left to the last of each discharge."""
        task = self._follow(records, self.decision_s)
        samples = [] if self._confidence is None else [(Samples.of(record), history_of(record)) for record in records]
        made: list[FloatArray] = []
        judged: list[Estimate] = []
        while (running := ~task.truncated()).any():
            (discharge, time_s, known), fitted = task.seen(), task.fitted()
            action, _ = self.policy.predict(task.observation(), deterministic=True)
            task.advance(np.asarray(action))
            estimate = task.estimate
            if self._confidence is not None and fitted is not None:
                is_left = judge_last_only & ~task.truncated()
                for n in np.flatnonzero(running).tolist():
                    record, history = samples[discharge[n]]
                    seen = record.first(int(known[n]))
                    sure = _unstated(estimate[n])
                    if not is_left[n]:
                        sure = self._confidence.estimate(fitted, n, estimate[n], seen, history)
                    judged.append(sure)
            made.append(np.column_stack([discharge, time_s, estimate])[running])
            task.drop_ended()
        rows = np.concatenate(made)
        in_order = np.argsort(rows[:, 0], kind="stable")
        of_each = np.split(in_order, np.searchsorted(rows[in_order, 0], np.arange(1, len(records))))
        if self._confidence is None:
            return [EstimateTrace(rows[n, 1], rows[n, 2], rows[n, 3]) for n in of_each]
        return [EstimateTrace.of(rows[n, 1], [judged[k] for k in n]) for n in of_each]
