"""
What calibrators from the full state make of discharges that are unlike those they learned from: divisions of the paper's data,
and the scores of one calibrator on the test part of one of them. The study is :mod:`benchmarks.direct_mapping`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from torch import nn

from battery_env.arrays import FloatArray
from battery_env.calibration.full_state import FullStateTask
from battery_env.calibration.full_state_layout import ERROR_SCALE, LITERAL, OBSERVED
from battery_env.calibration.policy import PolicyEstimator
from battery_env.electrochemistry import NEW_CELL, Trajectory, step
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.base import Estimator
from battery_env.estimators.closed_form import ClosedForm
from battery_env.evaluation import evaluate
from battery_env.parameters import PARAMETER_NAMES
from battery_env.trajectories import TrajectoryDataset
from benchmarks.study import Tables
from benchmarks.training import Recipe, timesteps_of, train_or_load

Parameter = Literal["q_mobile", "r_o"]
Parts = tuple[TrajectoryDataset, TrajectoryDataset]

#: Of the eleven loads of the paper, 8 to 16 W, those above are tested in the division by load: four.
HEAVY_LOAD_W = 13.0
#: About how many discharges of a test part are scored, evenly spaced.
TEST_DISCHARGES = 128

ENV_IDS: dict[str, str] = {"q_mobile": "BatteryQmax-v0", "r_o": "BatteryRo-v0"}

# The paper's network and optimizer; it does not name the size of a batch
_LAYERS = (256, 256, 256)
_LEARNING_RATE = 5e-4
_BATCH_SIZE = 64
# Pairs that go through the network at once when it is used
_CHUNK = 8192


def _by_load(data: TrajectoryDataset) -> Parts:
    heavy = data.load_values[data.load_start] > HEAVY_LOAD_W
    return data.subset(np.flatnonzero(~heavy)), data.subset(np.flatnonzero(heavy))


#: How the data are divided into a training and a test part. The first division is that of the registered environments.
DIVISIONS: dict[str, Callable[[TrajectoryDataset], Parts]] = {
    "trajectory": lambda data: data.split(by="trajectory"),
    "load": _by_load,
    "parameter": lambda data: data.split(by="parameter"),
}


def divided(parameter: Parameter, division: str) -> Parts:
    """The paper's data, divided."""
    return DIVISIONS[division](TrajectoryDataset.paper(parameter))


class _Divided(FullStateTask):
    """The task of a registered environment, with the discharges of the training part of a division."""

    division: ClassVar[str]

    def __init__(self, cells: int) -> None:
        super().__init__(cells, dataset=divided(self.parameters[0], self.division)[0])


class QmaxByLoad(_Divided):
    """``BatteryQmax-v0`` without the heavy loads."""

    parameters = ("q_mobile",)
    division = "load"


class QmaxByParameter(_Divided):
    """``BatteryQmax-v0`` without the most aged cells."""

    parameters = ("q_mobile",)
    division = "parameter"


class RoByLoad(_Divided):
    """``BatteryRo-v0`` without the heavy loads."""

    parameters = ("r_o",)
    division = "load"


class RoByParameter(_Divided):
    """``BatteryRo-v0`` without the most aged cells."""

    parameters = ("r_o",)
    division = "parameter"


_TASKS: dict[tuple[str, str], type[_Divided]] = {
    (kind.parameters[0], kind.division): kind for kind in (QmaxByLoad, QmaxByParameter, RoByLoad, RoByParameter)
}


def train_policy(algo: str, parameter: Parameter, division: str, seed: int, updates: int | None, models: Path) -> Any:
    """
    Train a policy on the training part of a division with the settings of ``zoo_configs``, or load it if that has been done.
    """
    env_id = ENV_IDS[parameter]
    recipe = Recipe.of(algo, env_id, seed)
    timesteps = recipe.timesteps if updates is None else timesteps_of(updates, recipe.hyperparameters)
    changed = None
    if (parameter, division) in _TASKS:
        task = _TASKS[parameter, division]
        tuned = recipe.hyperparameters.get("env_kwargs", {})
        changed = {"env_kwargs": {**tuned, "task": f"benchmarks.generalization:{task.__name__}"}}
    return train_or_load(algo, env_id, seed, timesteps, models / f"{env_id}_{division}", changed)


class Pairs(NamedTuple):
    """
    Labelled pairs.

    :param before: x_t, states without the temperature, shape (n, 7)
    :param after: x_{t+1}, shape (n, 7)
    :param load_W: u_{t+1}, the power over that second, shape (n,)
    :param label: the true parameter, C or ohm, shape (n,)
    """

    before: FloatArray
    after: FloatArray
    load_W: FloatArray
    label: FloatArray


def draw_pairs(data: TrajectoryDataset, parameter: Parameter, n: int, seed: int) -> Pairs:
    """Labelled pairs from random seconds of random discharges, as episodes of the environments start."""
    rng = np.random.default_rng(seed)
    discharge = rng.integers(len(data), size=n)
    sample = rng.integers(data.first[discharge], data.stop[discharge] - 1)
    before, after = (data.states_at(discharge, at)[:, OBSERVED] for at in (sample, sample + 1))
    return Pairs(before, after, data.load_values[data.load_start[discharge] + sample], getattr(data, parameter)[discharge])


def _as_given(pairs: Pairs) -> FloatArray:
    # the authors' scales
    columns = [
        pairs.before / LITERAL.state_scale,
        pairs.after / LITERAL.state_scale,
        pairs.load_W[:, None] / LITERAL.load_scale,
    ]
    return np.concatenate(columns, axis=1)


def _with_innovation(pairs: Pairs) -> FloatArray:
    # beside the pair what the registered environments show: how the step differs from that of a new cell
    state = np.full((len(pairs.load_W), OBSERVED.stop), NEW_CELL.Tb0)
    state[:, OBSERVED] = pairs.before
    predicted = step(state, pairs.load_W, NEW_CELL.q_mobile, NEW_CELL.r_o)[:, OBSERVED]
    return np.concatenate([_as_given(pairs), np.arcsinh((pairs.after - predicted) / ERROR_SCALE)], axis=1)


class Mapping(NamedTuple):
    """
    A kind of direct mapping.

    :param label: as shown to readers
    :param inputs: what the network sees of pairs, shape (n, inputs)
    :param normalised: whether inputs and labels are shifted and scaled to mean 0 and standard deviation 1
    """

    label: str
    inputs: Callable[[Pairs], FloatArray]
    normalised: bool


MAPPINGS: dict[str, Mapping] = {
    "raw": Mapping("direct mapping, raw (the paper's)", _as_given, normalised=False),
    "normalised": Mapping("direct mapping, normalised", _as_given, normalised=True),
    "innovation": Mapping("direct mapping, normalised, with the innovation", _with_innovation, normalised=True),
}


class _Scale:
    """Shift and scale of columns, from what they are on the training pairs."""

    def __init__(self, values: FloatArray, used: bool) -> None:
        self.mean = values.mean(axis=0) if used else np.zeros(values.shape[1])
        spread = values.std(axis=0) if used else np.ones(values.shape[1])
        # what does not vary says nothing
        self.spread = np.where(spread > 0.0, spread, 1.0)

    def to_tensor(self, values: FloatArray) -> th.Tensor:
        return th.as_tensor((values - self.mean) / self.spread, dtype=th.float32)


class DirectMapping(Estimator):
    """
    The paper's rival: a network that is taught, with labels, to tell the parameter from two consecutive states and the load
    between them. It has the policy's layers, activations, optimizer and learning rate, and no memory.

    :param kind: one of ``MAPPINGS``
    :param parameter: what it tells; the other one is known
    :param pairs: to learn from
    :param epochs: how often each pair is shown
    :param seed: of first weights and order
    """

    def __init__(self, kind: str, parameter: Parameter, pairs: Pairs, epochs: int, seed: int) -> None:
        self.mapping, self.parameter = MAPPINGS[kind], parameter
        inputs, labels = self.mapping.inputs(pairs), pairs.label[:, None]
        self._inputs, self._labels = (_Scale(values, self.mapping.normalised) for values in (inputs, labels))
        th.manual_seed(seed)
        layers: list[nn.Module] = []
        width = inputs.shape[1]
        for size in _LAYERS:
            layers += [nn.Linear(width, size), nn.LeakyReLU()]
            width = size
        self.network = nn.Sequential(*layers, nn.Linear(width, 1))
        self._fit(self._inputs.to_tensor(inputs), self._labels.to_tensor(labels), epochs)

    def _fit(self, inputs: th.Tensor, labels: th.Tensor, epochs: int) -> None:
        optimizer = th.optim.Adam(self.network.parameters(), lr=_LEARNING_RATE, fused=True)
        for _ in range(epochs):
            for batch in th.randperm(len(inputs)).split(_BATCH_SIZE):
                loss = nn.functional.mse_loss(self.network(inputs[batch]), labels[batch])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()

    def infer(self, pairs: Pairs) -> FloatArray:
        """The parameter of each pair."""
        with th.no_grad():
            told = [self.network(chunk) for chunk in self._inputs.to_tensor(self.mapping.inputs(pairs)).split(_CHUNK)]
        scaled = th.cat(told).numpy().astype(np.float64)
        return (self._labels.mean + self._labels.spread * scaled)[:, 0]

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """One estimate for every step of many discharges."""
        whole = list(records)
        pairs = Pairs(
            np.concatenate([record.state[:-1, OBSERVED] for record in whole]),
            np.concatenate([record.state[1:, OBSERVED] for record in whole]),
            np.concatenate([record.load[:-1] for record in whole]),
            np.empty(0),
        )
        ends = np.cumsum([len(record.time_s) - 1 for record in whole])[:-1]
        traces = []
        for record, told in zip(whole, np.split(self.infer(pairs), ends), strict=True):
            values = {name: np.full(len(told), getattr(record, name)) for name in PARAMETER_NAMES} | {self.parameter: told}
            traces.append(EstimateTrace(record.time_s[1:], values["q_mobile"], values["r_o"]))
        return traces

    def estimate(self, record: Trajectory) -> Estimate:  # type: ignore[override]
        """The estimate from the last two samples of a discharge."""
        trace = self.trace([record])[0]
        return Estimate(q_mobile=float(trace.q_mobile[-1]), r_o=float(trace.r_o[-1]))


def scores(estimator: Estimator, parameter: Parameter, division: str, method: str, seed: int | None) -> Tables:
    """Score a calibrator on the test part of a division."""
    test = divided(parameter, division)[1]
    found = evaluate(estimator, test.subset(range(0, len(test), max(len(test) // TEST_DISCHARGES, 1))))
    columns = {
        "load_W": "load",
        "true": parameter,
        "inferred": f"{parameter}_hat",
        "mape_percent": f"{parameter}_mape_percent",
        "final_error_percent": f"{parameter}_final_error_percent",
        "worst": f"{parameter}_worst",
        "bias": f"{parameter}_bias",
        "spread": f"{parameter}_spread",
        "time_per_estimate_s": "time_per_update_s",
    }
    table = pd.DataFrame({name: found[column] for name, column in columns.items()})
    for name, value in (("seed", seed), ("division", division), ("parameter", parameter), ("method", method)):
        table.insert(0, name, value)
    return {"direct_mapping": table}


def mapping_part(kind: str, parameter: Parameter, division: str, seed: int, pairs: int, epochs: int) -> Tables:
    """Teach one direct mapping, and score it."""
    th.set_num_threads(1)
    drawn = draw_pairs(divided(parameter, division)[0], parameter, pairs, seed)
    mapping = DirectMapping(kind, parameter, drawn, epochs, seed)
    return scores(mapping, parameter, division, MAPPINGS[kind].label, seed)


def policy_part(algo: str, parameter: Parameter, division: str, seed: int, updates: int | None, models: Path) -> Tables:
    """Train one policy, unless that has been done, and score it; the model runs free over whole discharges."""
    policy = train_policy(algo, parameter, division, seed, updates, models)
    estimator = PolicyEstimator(policy, ENV_IDS[parameter])
    return scores(estimator, parameter, division, algo.upper(), seed)


def exact_part(parameter: Parameter, division: str) -> Tables:
    """Score the closed form."""
    return scores(ClosedForm(), parameter, division, "closed form", None)
